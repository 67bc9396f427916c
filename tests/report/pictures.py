"""What the tests of pictures share: sources from text, and large and hostile ones."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.sax.saxutils import escape

from sros_tool.files import policies_dir
from sros_tool.policy.document import read_policy
from sros_tool.policy.rights import policy_rights
from sros_tool.report.compose import PictureSource, compose
from sros_tool.report.picture import Edge, Picture, SourceTitle
from tests.support.children import PATIENCE
from tests.support.harness import policy_text

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

NOW = datetime(2027, 1, 1, tzinfo=UTC)
WEB = Path(__file__).resolve().parents[2] / "web"
MOBILE_ROBOT = policies_dir() / "mobile_robot.xml"

HOSTILE = (
    "<script>window.broken=1</script>",
    "</script><script>window.broken=2</script>",
    "<img src=x onerror=window.broken=3>",
    "\"'><svg onload=window.broken=4>",
    "javascript:window.broken=5",
    "-->\u2028\u2029\u202e]]>&lt;\\u003cscript>",
    "${window.broken=6}`$title%s\\n",
    '#lt;script#gt;end end["x"]',
)
"""Names that are markup somewhere; the last ones for templates, JSON and Mermaid."""


def group(kind: str, right: str, *names: str, qualifier: str = "ALLOW") -> str:
    """A group of a policy as XML."""
    item = kind.removesuffix("s")
    listed = "".join(f"<{item}>{escape(name)}</{item}>" for name in names)
    return f'<{kind} {right}="{qualifier}">{listed}</{kind}>'


def source_of(folder: Path, enclaves: dict[str, str], name: str = "policy.xml") -> PictureSource:
    """A source from groups by enclave."""
    path = folder / name
    path.write_text(policy_text(enclaves))
    return PictureSource(SourceTitle(name, "policy"), policy_rights(read_policy(path)))


def picture_of(folder: Path, enclaves: dict[str, str]) -> Picture:
    """A picture of a policy from groups by enclave."""
    return compose(source_of(folder, enclaves))


def mobile_robot() -> Picture:
    """The picture of the mobile robot."""
    rights = policy_rights(read_policy(MOBILE_ROBOT))
    return compose(PictureSource(SourceTitle("mobile_robot.xml", "policy"), rights))


def edges(picture: Picture, enclave: str) -> set[tuple[str, str, str]]:
    """What an enclave may do, as (right, name, qualifier)."""
    return {(e.right, e.name, str(e.qualifier)) for e in picture.edges if e.enclave == enclave}


def edge(picture: Picture, enclave: str, right: str, name: str) -> Edge:
    """The one edge of that kind."""
    edges = [e for e in picture.edges if (e.enclave, e.right, e.name) == (enclave, right, name)]
    assert len(edges) == 1, edges
    return edges[0]


def large_policy(robots: int, parts: int, topics: int) -> str:
    """Robots of many enclaves: each writes topics, reads those of others, and all are recorded."""
    enclaves = {}
    for robot in range(robots):
        for part in range(parts):
            own = [f"/robot{robot}/part{part}/t{n}" for n in range(topics)]
            read = [
                f"/robot{robot}/part{(part + step) % parts}/t{n}"
                for step in (1, 3)
                for n in range(topics // 2)
            ]
            if part < 3:
                read.append(f"/robot{(robot + 1) % robots}/part{part}/t0")
            enclaves[f"/robot{robot}/part{part}"] = group("topics", "publish", *own) + group(
                "topics", "subscribe", *read
            )
    enclaves["/fleet/recorder"] = group("topics", "subscribe", "/*") + group(
        "topics", "subscribe", "/robot3/*", qualifier="DENY"
    )
    return policy_text(enclaves)


def hostile_permissions() -> str:
    """Permissions of a vendor's tool, in which names are whatever somebody wrote."""
    grants = "".join(
        f'<grant name="{escape(text, {chr(34): "&quot;"})}"><subject_name>CN=/{escape(text)}'
        "</subject_name><validity><not_before>2026-01-01T00:00:00</not_before>"
        "<not_after>2036-01-01T00:00:00</not_after></validity>"
        "<allow_rule><domains><id>0</id></domains>"
        f"<publish><topics><topic>rt/{escape(text)}</topic><topic>{escape(text)}</topic></topics>"
        "</publish><subscribe><topics><topic>rt/*</topic></topics></subscribe></allow_rule>"
        "<default>DENY</default></grant>"
        for text in HOSTILE
    )
    return f'<?xml version="1.0" encoding="UTF-8"?><dds><permissions>{grants}</permissions></dds>'


def new_page(browser: Browser, **options: Any) -> Page:
    """A page that waits for what it is told to wait for, however busy the machine is."""
    page = browser.new_page(**options)
    page.set_default_timeout(PATIENCE * 1000)
    return page
