"""Benchmarks of decisions for all names, on a policy of many enclaves."""

from __future__ import annotations

import statistics
import time
from datetime import UTC, datetime
from pathlib import Path

Figure = tuple[str, float, str, bool]
"""The task, its seconds of CPU, the limit, and whether it is kept."""
LIMIT = 5.0


def requiring(folder: Path, enclaves: int, rounds: int) -> list[Figure]:
    """Measure the decision on 50 requirements, with as many names as enclaves."""
    from sros_tool.checks.keystores.opened import Circumstances
    from sros_tool.proof.findings import decide_all
    from sros_tool.proof.requirements import parse_requirements
    from sros_tool.proof.system import load_system

    policy = folder / "required.xml"
    policy.write_text(required_policy(enclaves))
    text = requirements(enclaves).encode()

    def work() -> float:
        begin = time.process_time()
        found = decide_all(
            parse_requirements(text, "required.toml"),
            load_system(policy, Circumstances(datetime.now(UTC))),
        )
        taken = time.process_time() - begin
        assert len(found.violations) == 1
        return taken

    taken = statistics.median(work() for _ in range(rounds))
    name = f"sros check: 50 requirements, {enclaves} enclaves and names: CPU"
    return [(name, taken, f"{LIMIT:g} s", taken < LIMIT), _comparing(policy, enclaves, rounds)]


def _comparing(policy: Path, enclaves: int, rounds: int) -> Figure:
    """Measure finding the one right that a changed policy adds."""
    from sros_tool.proof.growth import compare_access
    from sros_tool.proof.sources import load_side

    changed = policy.with_name("changed.xml")
    changed.write_text(policy.read_text().replace("/own_0/*", "/own_[0x]/*"))

    def work() -> float:
        begin = time.process_time()
        found = compare_access(load_side(policy), load_side(changed))
        taken = time.process_time() - begin
        assert len(found.added) == 1
        return taken

    name = f"sros diff_policy --no-new-access, {enclaves} enclaves: CPU"
    return name, statistics.median(work() for _ in range(rounds)), "-", True


def required_policy(count: int) -> str:
    """Return a policy of this number of enclaves, and of names; each has ten of them.

    Each enclave publishes one topic and reads those of others; every tenth one has wildcards.
    """
    lines = []
    for i in range(count):
        names = [f"/area_{(i * k) % count % 50}/topic_{(i * k) % count}" for k in (1, 3, 7, 11, 13)]
        heard = "".join(f"<topic>{each}</topic>" for each in names[1:])
        wide = f'<topics publish="ALLOW"><topic>/own_{i}/*</topic></topics>' if i % 10 == 0 else ""
        wide += '<topics subscribe="ALLOW"><topic>/*</topic></topics>' if i % 100 == 0 else ""
        deny = '<topics subscribe="DENY"><topic>/own_*</topic></topics>' if i % 100 == 0 else ""
        lines.append(
            f'<enclave path="/robot_{i}/part"><profiles><profile ns="/robot_{i}" node="part">'
            f'<topics publish="ALLOW"><topic>{names[0]}</topic><topic>/rosout</topic></topics>'
            f'<topics subscribe="ALLOW">{heard}</topics>'
            '<services reply="ALLOW"><service>~/set_parameters</service></services>'
            f'<services request="ALLOW"><service>/robot_{(i + 1) % count}/part/get_state</service>'
            f"</services>{wide}{deny}</profile></profiles></enclave>"
        )
    return f'<policy version="0.2.0"><enclaves>{"".join(lines)}</enclaves></policy>'


def requirements(count: int) -> str:
    """Return fifty requirements of all kinds, of which one does not hold."""
    found = []
    for i in range(10):
        topic = f"/area_{i}/topic_{i}"
        part = f"/robot_{i}/part"
        found += [
            f'[[only]]\npublish = ["{topic}"]\nenclaves = ["{part}"]',
            f'[[must]]\nenclave = "{part}"\npublish = ["{topic}"]',
            f'[[at_most]]\npublish = ["/area_{i}/*"]\nenclaves = 1',
            f'[[protected]]\ntopics = ["/area_{i}/*"]\nlevel = "encrypt"',
        ]
    found += [f'[[widest]]\npublish = ["/own_*"]\nenclaves = ["/robot_{i}*"]' for i in range(1, 5)]
    found += ['[[nobody]]\nrequest = ["*/set_parameters"]'] * 2
    # The wildcards below /own_ are read by nobody, so these follow all flows to their end.
    found += [
        f'[[apart]]\nfrom = ["/robot_{i}/part"]\nto = ["/robot_{i + 50}/part"]\nthrough = ["*"]'
        for i in range(3)
    ]
    found.append(f'[[apart]]\nfrom = ["/robot_1/part"]\nto = ["/robot_{count // 2 + 1}/part"]')
    return "\n\n".join(found)
