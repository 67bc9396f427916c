"""Random policies for tests of answers about Zenoh, and the questions about their enclaves."""

from __future__ import annotations

import random

from sros_tool.policy.rights import KIND_OF
from tests.support.harness import policy_text, publish

NAMES = ("/a", "/ab", "/a/b", "/b", "/b/a/c")
PATTERNS = (*NAMES, "/*", "/a*", "/a/*", "/*b", "/b/*/c")
OTHER_END = {"publish": "subscribe", "subscribe": "publish", "request": "reply", "reply": "request"}
WORD = {"publish": "publish", "subscribe": "subscribe", "request": "call", "reply": "serve"}


def drawn_policy(draw: random.Random) -> str:
    """Return a policy of five enclaves with random rights, some of them denied."""

    def group(right: str) -> str:
        kind = KIND_OF[right]
        names = draw.sample(PATTERNS, draw.randint(1, 2))
        qualifier = "DENY" if draw.random() < 0.15 else "ALLOW"
        inner = "".join(f"<{kind[:-1]}>{each}</{kind[:-1]}>" for each in names)
        return f'<{kind} {right}="{qualifier}">{inner}</{kind}>'

    return policy_text(
        {
            f"/e{number}": "".join(group(right) for right in OTHER_END if draw.random() < 0.8)
            or publish("/a")
            for number in range(5)
        }
    )
