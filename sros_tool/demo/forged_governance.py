"""Forged governance: edited, signed by the wrong one, and weaker than it should be."""

from __future__ import annotations

from dataclasses import replace

from sros_tool.dds.governance import (
    Governance,
    Protection,
    parse_governance,
    render_governance,
)
from sros_tool.demo.bench import GOVERNANCE, Bench
from sros_tool.errors import DocumentError


def _weak(bench: Bench) -> bytes:
    """A governance that lets everybody in and protects nothing."""
    governance = parse_governance(bench.governance())
    return render_governance(
        Governance(
            tuple(
                replace(
                    rule,
                    allow_unauthenticated_participants=True,
                    enable_join_access_control=False,
                    discovery_protection_kind=Protection.NONE,
                    liveliness_protection_kind=Protection.NONE,
                    rtps_protection_kind=Protection.NONE,
                    topic_access_rules=tuple(
                        replace(
                            topic,
                            enable_discovery_protection=False,
                            enable_liveliness_protection=False,
                            enable_read_access_control=False,
                            enable_write_access_control=False,
                            metadata_protection_kind=Protection.NONE,
                            data_protection_kind=Protection.NONE,
                        )
                        for topic in rule.topic_access_rules
                    ),
                )
                for rule in governance.domain_access_rules
            )
        )
    )


def governance_edited(bench: Bench) -> None:
    """As `_weak`, written over the signed document."""
    signed = bench.read("listener", GOVERNANCE)
    kept = bench.governance().replace(b"\r\n", b"\n")
    # The comment changes also what is as weak already.
    weak = _weak(bench) + b"<!-- edited -->\n"
    edited = signed.replace(kept.replace(b"\n", b"\r\n"), weak.replace(b"\n", b"\r\n"))
    if edited == signed:
        raise DocumentError("the signed governance cannot be edited", "Its XML is not found in it.")
    bench.put("listener", GOVERNANCE, edited)


def governance_of_another_ca(bench: Bench) -> None:
    """A weak governance for the listener, signed by a stranger's CA."""
    bench.put("listener", GOVERNANCE, bench.sign(_weak(bench), bench.foreign))


def weaker_governance(bench: Bench) -> None:
    """A weak governance for talker and listener, signed by the CA, as it once was."""
    signed = bench.sign(_weak(bench))
    for part in ("talker", "listener"):
        bench.put(part, GOVERNANCE, signed)
