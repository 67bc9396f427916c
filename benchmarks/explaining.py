"""Benchmarks of ``sros explain`` on keystores of many enclaves, and of proving permissions."""

from __future__ import annotations

import os
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

from benchmarks.inputs import enclaves_policy

_COMPILES_NOTHING = "PYTHONDONTWRITEBYTECODE"

Figure = tuple[str, float, str, bool]
"""The task, its seconds, the limit, and whether it is kept."""


def explaining(folder: Path, enclaves: int, rules: int, rounds: int) -> list[Figure]:
    """Measure ``sros explain --who`` and ``--reach``, and the proof of permissions to sign."""
    from sros_tool.dds.decision.vendors import Vendor
    from sros_tool.dds.domains import DomainSet
    from sros_tool.explain.answer import ask
    from sros_tool.explain.asking import AskingContext
    from sros_tool.explain.vendors import VendorOfKeystore
    from sros_tool.keystore.issuing.proof import prove
    from sros_tool.keystore.lifecycle.create import create_keystore, generate_artifacts
    from sros_tool.keystore.reader import OpenedKeystore
    from sros_tool.keystore.rights import load_rights
    from sros_tool.keystore.template import load_template
    from sros_tool.policy.document import read_policy
    from sros_tool.reach import Network
    from sros_tool.translate import permissions_for
    from sros_tool.validity import window

    now = datetime.now(UTC)
    root, file = folder / "explained", folder / "explained.xml"
    file.write_text(enclaves_policy(enclaves, rules))
    policy = read_policy(file)
    template = load_template("production")
    create_keystore(root, template=template, now=now)
    generate_artifacts(root, policies=[policy], now=now)
    domains = DomainSet.parse("0")
    validity = window(now, template.permissions_validity)
    signed = [
        permissions_for(each, subject="CN=/x", validity=validity, domains=domains)
        for each in policy.enclaves
    ]

    def ask_all() -> None:
        asked = VendorOfKeystore(OpenedKeystore(root), Vendor.FAST, "", AskingContext(now, UTC, 0))
        outcomes = asked.outcomes(ask("publish", "/robot7/topic_0"))
        assert [each.enclave for each in outcomes if each.allowed] == ["/robot7/part"]

    def follow() -> None:
        Network(load_rights(root).rights).reach("/robot7/part")

    def prove_all() -> None:
        for each, permissions in zip(policy.enclaves, signed, strict=True):
            prove(each, permissions, domains)

    measured = (
        (f"sros explain --who: {enclaves} enclaves asked", ask_all, 2.0),
        (f"sros explain --reach among {enclaves} enclaves", follow, 2.0),
        (f"proving that permissions of {enclaves} match their policy", prove_all, 0.15),
    )
    figures = []
    for name, work, limit in measured:
        taken = statistics.median(_seconds(work) for _ in range(rounds))
        figures.append((name, taken, f"{limit:g} s", taken < limit))
    return figures


def explaining_zenoh(folder: Path, enclaves: int, rules: int, rounds: int) -> list[Figure]:
    """Measure the seconds of CPU of ``sros explain --vendor zenoh``, the start included."""
    from sros_tool.keystore.lifecycle.create import create_keystore, generate_artifacts
    from sros_tool.keystore.lifecycle.update import set_zenoh
    from sros_tool.keystore.template import load_template
    from sros_tool.policy.document import read_policy
    from sros_tool.zenoh.configuration import Mode, ZenohNetwork

    now = datetime.now(UTC)
    question = ("publish", "/robot7/topic_0", "--vendor", "zenoh")
    peers = enclaves // 5
    tasks = (
        (f"explain --who on Zenoh, {enclaves} clients: CPU", Mode.CLIENT, enclaves, ("--who",), 2),
        (f"explain on Zenoh, {peers} peers: CPU", Mode.PEER, peers, ("/robot7/part",), 1),
    )
    figures = []
    for name, mode, count, asked, limit in tasks:
        root, file = folder / f"explained_{mode}", folder / f"explained_{mode}.xml"
        file.write_text(enclaves_policy(count, rules))
        create_keystore(root, template=load_template("production"), now=now)
        generate_artifacts(root, policies=[read_policy(file)], now=now)
        set_zenoh(root, ZenohNetwork(mode=mode), now=now)
        program = str(Path(sys.executable).with_name("sros"))
        command = (program, "explain", str(root), *asked, *question)
        _cpu_seconds(command)  # compiles the modules
        taken = statistics.median(_cpu_seconds(command) for _ in range(rounds))
        figures.append((name, taken, f"{limit} s", taken < limit))
    return figures


def _cpu_seconds(command: tuple[str, ...]) -> float:
    # An installed program is compiled: without this, each run would compile its modules again.
    compiled = {name: value for name, value in os.environ.items() if name != _COMPILES_NOTHING}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(
        command, check=True, env=compiled, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def _seconds(work: Callable[[], object]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin
