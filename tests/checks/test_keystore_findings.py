"""Each finding about keystores comes about where it should, and not in a sound keystore."""

from __future__ import annotations

import pytest

from sros_tool.checks.keystores.keystore import keystore_findings
from sros_tool.pki.certificates import pem
from sros_tool.policy.document import read_policy
from tests.checks.bench import Bench
from tests.checks.keystore_cases import CASES

pytest_plugins = ["tests.checks.sound_keystore"]


def ids(bench: Bench) -> set[str]:
    options = {"now": bench.now, **bench.options}
    return {each.id for each in keystore_findings(bench.checked, **options)}


def test_nothing_in_a_sound_keystore(bench: Bench) -> None:
    assert ids(bench) == set()
    bench.options["policies"] = (read_policy(bench.root.with_name("policy.xml")),)
    bench.options["domain"] = 0
    assert ids(bench) == set()


def test_nothing_in_a_sound_export(bench: Bench) -> None:
    bench.export()
    assert ids(bench) == set()


def test_nothing_in_a_sound_list(bench: Bench) -> None:
    bench.revoke(99)
    assert ids(bench) <= {"keystore.not-in-ledger"}


def test_permissions_of_another_enclave_are_no_earlier_ones(bench: Bench) -> None:
    CASES["enclave.permissions-subject"](bench)
    assert "enclave.old-permissions" not in ids(bench)


def test_exported_enclaves_of_two_keystores(bench: Bench) -> None:
    robot = bench.export()
    assert "keystore.authorities-differ" not in ids(bench)
    authority, _ = bench.foreign()
    (robot / "enclaves/arm/permissions_ca.cert.pem").write_bytes(pem(authority))
    assert "keystore.authorities-differ" in ids(bench)


@pytest.mark.parametrize("expected", CASES)
def test_found(expected: str, bench: Bench) -> None:
    assert expected not in ids(bench)
    CASES[expected](bench)
    assert expected in ids(bench)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ((), "Fast DDS 2.14 refuses the document"),
        ((("rtps_protection_kind>ENCRYPT", "rtps_protection_kind>NONE"),), "they reach no topic"),
        (
            (
                ("rtps_protection_kind>ENCRYPT", "rtps_protection_kind>NONE"),
                ("read_access_control>true", "read_access_control>false"),
                ("write_access_control>true", "write_access_control>false"),
                ("metadata_protection_kind>ENCRYPT", "metadata_protection_kind>NONE"),
                ("data_protection_kind>ENCRYPT", "data_protection_kind>NONE"),
                ("discovery_protection_kind>ENCRYPT", "discovery_protection_kind>NONE"),
            ),
            "on Fast DDS 2.14 anybody can read and write *",
        ),
    ],
)
def test_what_strangers_reach_is_said(
    changes: tuple[tuple[str, str], ...], words: str, bench: Bench
) -> None:
    bench.governance(("participants>false", "participants>true"))
    bench.sign("enclaves/governance.p7s", lambda text: _present(text, changes))
    found = keystore_findings(bench.checked, now=bench.now)
    assert words in next(each.text for each in found if each.id == "governance.unauthenticated")


def _present(text: str, changes: tuple[tuple[str, str], ...]) -> str:
    for old, new in changes:
        text = text.replace(old, new)
    return text
