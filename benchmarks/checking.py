"""Benchmarks of checking a keystore of many enclaves, and its policy."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

from benchmarks.inputs import enclaves_policy

Figure = tuple[str, float, str, bool]
"""The task, its seconds, the limit, and whether it is kept."""


def checking(folder: Path, enclaves: int, rules: int, rounds: int) -> list[Figure]:
    """Measure the checks of a keystore with this number of enclaves, and of rules in each."""
    from sros_tool.checks.keystores.keystore import keystore_findings
    from sros_tool.checks.keystores.opened import Circumstances
    from sros_tool.checks.kind import WARNING
    from sros_tool.checks.policies.policy import policy_file_findings
    from sros_tool.keystore.lifecycle.create import create_keystore, generate_artifacts
    from sros_tool.keystore.reader import OpenedKeystore
    from sros_tool.keystore.template import load_template
    from sros_tool.policy.document import read_policy

    now = datetime.now(UTC)
    root, file = folder / "checked", folder / "checked.xml"
    file.write_text(enclaves_policy(enclaves, rules))
    policy = read_policy(file)
    create_keystore(root, template=load_template("production"), now=now)
    generate_artifacts(root, policies=[policy], now=now)

    def keystore() -> None:
        found = keystore_findings(OpenedKeystore(root), Circumstances(now))
        assert not [each for each in found if each.severity >= WARNING]

    def with_policy() -> None:
        found = keystore_findings(OpenedKeystore(root), Circumstances(now, policies=(policy,)))
        assert not [each for each in found if each.severity >= WARNING]

    measured = (
        (f"sros check: a keystore of {enclaves} enclaves", keystore),
        ("... compared with the policy that it was made from", with_policy),
        (f"sros check: a policy of {enclaves} enclaves", lambda: list(policy_file_findings(file))),
    )
    figures = []
    for name, work in measured:
        taken = statistics.median(_seconds(work) for _ in range(rounds))
        figures.append((name, taken, "2 s", taken < 2))
    return figures


def _seconds(work: Callable[[], object]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin
