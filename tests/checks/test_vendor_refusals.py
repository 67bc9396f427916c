"""`check` finds what `explain` says that a vendor refuses, in a keystore and in an export of it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass

import pytest
from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID

from sros_tool.checks.keystores.keystore import keystore_findings
from sros_tool.checks.kind import ERROR, WARNING, Finding
from tests.checks.bench import Bench
from tests.checks.keystore_cases import IS_CA

pytest_plugins = ["tests.checks.sound_keystore"]

OPEN = tuple(
    (f"{name}>{kind}", f"{name}>NONE")
    for name, kind in (
        ("rtps_protection_kind", "ENCRYPT"),
        ("metadata_protection_kind", "ENCRYPT"),
        ("data_protection_kind", "ENCRYPT"),
        ("discovery_protection_kind", "ENCRYPT"),
        ("liveliness_protection_kind", "ENCRYPT"),
    )
) + tuple(
    (f"{name}>true", f"{name}>false")
    for name in ("enable_read_access_control", "enable_write_access_control")
)
"""The changes of a governance after which nothing is protected, and access to nothing is."""


def code_signing(bench: Bench) -> None:
    usage = x509.ExtendedKeyUsage([ExtendedKeyUsageOID.CODE_SIGNING])
    bench.adopt("permissions", bench.new_authority(IS_CA, (usage, False)))


def large_key(bench: Bench) -> None:
    bench.adopt("identity", bench.new_authority(IS_CA, curve=ec.SECP384R1()))


@dataclass(frozen=True)
class Row:
    """A way to break a keystore, and the worst finding: in it, and in an export of it.

    ``says`` is in the text of the finding in the export.
    """

    name: str
    work: Callable[[Bench], object]
    home: str
    export: str
    says: str = ""


ROWS = (
    Row(
        "a protection kind that is none",
        lambda b: b.governance(("data_protection_kind>ENCRYPT", "data_protection_kind>SIGNED")),
        "enclave.governance-malformed",
        "enclave.governance-malformed",
    ),
    Row(
        "a protection kind that data cannot have",
        lambda b: b.governance(
            ("data_protection_kind>ENCRYPT", "data_protection_kind>SIGN_WITH_ORIGIN_AUTHENTICATION")
        ),
        "enclave.refused",
        "enclave.refused",
        "Cyclone DDS 0.10.2 refuses it (governance.p7s: ",
    ),
    Row(
        "an open domain",
        lambda b: b.governance(*OPEN),
        "governance.no-authenticity",
        "governance.no-authenticity",
    ),
    Row(
        "no rule for all topics",
        lambda b: b.governance(("expression>*<", "expression>rt/status<")),
        "governance.no-topic-rule",
        "governance.no-topic-rule",
    ),
    Row(
        "a permissions CA for code signing",
        code_signing,
        "portable.ca-purpose",
        "portable.refused",
        "Fast DDS 2.9.1 and Cyclone DDS 0.10.2 refuse it (governance.p7s: ",
    ),
    Row(
        "an identity CA of P-384",
        large_key,
        "portable.key-algorithm",
        "portable.refused",
        "Cyclone DDS 0.10.2 refuses it (identity_ca.cert.pem: it has a key of ",
    ),
)

ABOUT_VENDORS = {"enclave.refused", "portable.refused"}


def worst(bench: Bench, **options: object) -> list[Finding]:
    """The errors, or else the warnings, about what DDS loads, which the keystore did not issue."""
    found = [
        each
        for each in keystore_findings(bench.checked, now=bench.now, **options)  # type: ignore[arg-type]
        if each.severity >= WARNING
        and not each.id.startswith("keystore.")
        and each.id != "governance.not-as-settings"
    ]
    return [each for each in found if each.severity is ERROR] or found


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_the_cause_is_found_once_wherever_the_files_lie(row: Row, bench: Bench) -> None:
    row.work(bench)
    for place, wanted in (("keystore", row.home), ("export", row.export)):
        if place == "export":
            bench.export()
        found = worst(bench)
        assert wanted in {each.id for each in found}
        about_vendors = [each for each in found if each.id in ABOUT_VENDORS]
        assert [each.id for each in about_vendors] == [wanted] * (wanted in ABOUT_VENDORS)
        if place == "export":
            assert any(row.says in each.text for each in found if each.id == wanted)
            assert not any("ROOT" in each.remedy for each in found)


@pytest.mark.parametrize(
    ("vendor", "ids"),
    [
        ("fastdds", set()),
        ("fastdds-2.9", {"enclave.refused"}),
        ("cyclonedds", {"enclave.refused"}),
        ("zenoh", set()),
    ],
)
def test_a_refusal_by_the_only_vendor_that_is_used_is_an_error(
    vendor: str, ids: set[str], bench: Bench
) -> None:
    code_signing(bench)
    bench.export()
    assert {each.id for each in worst(bench, vendor=vendor)} == ids


def test_the_governance_of_every_exported_enclave_is_judged(bench: Bench) -> None:
    robot = bench.export()
    kept = robot.with_name("kept.p7s")
    shutil.copy(robot / "enclaves/base/governance.p7s", kept)
    bench.governance(*OPEN)
    for opened in ("base", "arm"):
        for name in ("base", "arm"):
            source = bench.path("enclaves/governance.p7s") if name == opened else kept
            shutil.copy(source, robot / f"enclaves/{name}/governance.p7s")
        assert {each.id for each in worst(bench)} == {
            "governance.differs",
            "governance.no-authenticity",
        }
