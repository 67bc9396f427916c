"""`check` finds what `explain` says that a vendor refuses, in a keystore and in an export of it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID

from sros_tool.checks.keystores.keystore import keystore_findings
from sros_tool.checks.keystores.opened import Circumstances
from sros_tool.checks.kind import ERROR, WARNING, Finding
from sros_tool.dds.decision.vendors import TESTED, Signers, joined_titles
from sros_tool.errors import PkiError
from sros_tool.faults import ORIGINAL_KEYSTORE, Fault
from sros_tool.keystore.delivery.robot import RequestAnswer, check_answer, seal
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.pki import smime
from sros_tool.pki.certificates import pem
from sros_tool.pki.keys import load_key
from tests.checks.bench import Bench
from tests.checks.keystore_cases import IS_CA, TOPIC_RULE
from tests.support.harness import sros
from tests.support.long_form import some

(STRICT,) = joined_titles(each.title for each in TESTED if each.traits.verifies_authorities)
"""The vendors that verify a CA file when they load it."""
LISTED = " and ".join(
    joined_titles(each.title for each in TESTED if each.traits.signers is Signers.LISTED)
)
"""The vendors that take signers only from the file of the permissions CA."""

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


def without_constraints(role: str) -> Callable[[Bench], object]:
    """Take a CA whose certificate does not say that it is one, but may sign certificates."""
    usage = x509.KeyUsage(
        digital_signature=True, content_commitment=False, key_encipherment=False,
        data_encipherment=False, key_agreement=False, key_cert_sign=True, crl_sign=True,
        encipher_only=False, decipher_only=False,
    )  # fmt: skip
    return lambda bench: bench.adopt(role, bench.new_authority((usage, True)))


def crashing_first(bench: Bench) -> None:
    """Put a CA that is not signed with SHA-256 before the one that issued."""
    other, _ = bench.new_authority(IS_CA, digest=hashes.SHA384())
    file = bench.path("public/identity_ca.cert.pem")
    file.write_bytes(pem(other) + file.read_bytes())


def damaged_second(bench: Bench) -> None:
    """Put half a certificate behind that of the permissions CA."""
    file = bench.path("public/permissions_ca.cert.pem")
    lines = file.read_bytes().splitlines(keepends=True)
    file.write_bytes(b"".join([*lines, *lines[:3], *lines[-1:]]))


@dataclass(frozen=True)
class Row:
    """A way to break a keystore, and the worst finding: in it, and in an export of it.

    ``says`` is in the text of the finding in the export, ``remedy`` in its remedy.
    """

    name: str
    work: Callable[[Bench], object]
    home: str
    export: str
    says: str = ""
    remedy: str = ""


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
        "Cyclone DDS refuses it (governance.p7s: ",
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
        "Fast DDS 2.9.1 and Cyclone DDS 0.10 refuse it (governance.p7s: ",
    ),
    Row(
        "an identity CA of P-384",
        large_key,
        "portable.key-algorithm",
        "portable.refused",
        "Cyclone DDS refuses it (identity_ca.cert.pem: it has a key of ",
    ),
    Row(
        "an identity CA without basicConstraints",
        without_constraints("identity"),
        "portable.refused",
        "portable.refused",
        f"{STRICT} refuses it (identity_ca.cert.pem: it is refused: CN=new CA has no ",
        Fault.CA_CHAIN.remedy,
    ),
    Row(
        "a permissions CA without basicConstraints",
        without_constraints("permissions"),
        "portable.refused",
        "portable.refused",
        "Fast DDS 2.9.1 and Cyclone DDS accept it",
        Fault.CA_CHAIN.remedy,
    ),
    Row(
        "an identity CA without basicConstraints and keyUsage",
        lambda b: b.adopt("identity", b.new_authority()),
        "enclave.certificate-issuer",
        "enclave.certificate-issuer",
        "CN=new CA is not a CA",
    ),
    Row(
        "a CA first that crashes",
        crashing_first,
        "portable.refused",
        "portable.refused",
        f"{STRICT} crashes on it (identity_ca.cert.pem: CN=new CA is not signed with SHA-256, ",
        Fault.CA_CRASH.remedy,
    ),
    Row(
        "a damaged certificate behind that of a CA",
        damaged_second,
        "portable.refused",
        "portable.refused",
        "Fast DDS refuses it (permissions_ca.cert.pem: ",
        Fault.CERTIFICATE_FILE.remedy,
    ),
)

FREE = (
    "<enable_discovery_protection>true</enable_discovery_protection>"
    "<enable_liveliness_protection>true</enable_liveliness_protection>"
    "<enable_read_access_control>false</enable_read_access_control>"
    "<enable_write_access_control>false</enable_write_access_control>"
    "<metadata_protection_kind>ENCRYPT</metadata_protection_kind>"
    "<data_protection_kind>ENCRYPT</data_protection_kind></topic_rule>"
)
"""The end of a topic rule that leaves a topic to everybody."""
ABOUT_VENDORS = {"enclave.refused", "portable.refused"}


def worst(bench: Bench, **options: object) -> list[Finding]:
    """The errors, or else the warnings, about what DDS loads, which the keystore did not issue."""
    circumstances = Circumstances(bench.now, **options)  # type: ignore[arg-type]
    found = [
        each
        for each in keystore_findings(OpenedKeystore(bench.checked), circumstances)
        if each.severity >= WARNING
        and not each.id.startswith("keystore.")
        and each.id != "governance.not-as-settings"
    ]
    return [each for each in found if each.severity is ERROR] or found


@pytest.mark.parametrize("row", some(ROWS, 4), ids=lambda row: row.name)
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
            named = [each for each in found if each.id == wanted]
            assert any(row.says in each.text and row.remedy in each.remedy for each in named), named
            assert all(
                "KEYSTORE" not in it.remedy or ORIGINAL_KEYSTORE in it.remedy for it in found
            )


def signed_below(bench: Bench) -> None:
    """Sign with an intermediate CA, of which only the root is in the file of the permissions CA."""
    root, key = bench.new_authority(IS_CA, common_name="root CA")
    below = bench.new_authority(IS_CA, issuer=(root.subject, key))
    bench.adopt("permissions", below)
    bench.trust("permissions", root)


def test_what_some_vendors_accept_is_no_error(bench: Bench) -> None:
    """Twin: the same by a CA that has nothing to do with it is an error in everything."""
    signed_below(bench)
    bench.export()
    (found,) = (each for each in worst(bench) if each.file.endswith(".p7s"))
    assert (found.id, found.severity) == ("portable.refused", WARNING)
    assert f"{LISTED} refuse it (governance.p7s: " in found.text
    assert "Fast DDS 2.9.1 and Cyclone DDS 0.10 accept it" in found.text
    assert {each.id for each in worst(bench, vendors=("cyclonedds",))} == set()
    assert {each.id for each in worst(bench, vendors=("fastdds",))} == {"enclave.signature"}
    base = bench.checked / "enclaves/base"
    shutil.copy(base / "identity_ca.cert.pem", base / "permissions_ca.cert.pem")
    assert {each.id for each in worst(bench)} >= {"enclave.signature"}


@pytest.mark.parametrize("other", ["2030-13-45T00:00:00Z", "soon"])
def test_a_date_that_is_none_is_one_error(other: str, bench: Bench) -> None:
    bench.permissions((_not_after(bench), f"<not_after>{other}<"))
    bench.export()
    assert [each.id for each in worst(bench)] == ["enclave.permissions-malformed"]
    assert sros("verify", bench.checked).status == 1


def _not_after(bench: Bench) -> str:
    text = bench.path("enclaves/base/permissions.p7s").read_text()
    return text[text.index("<not_after>") : text.index("</not_after>") + 1]


def test_a_document_that_some_vendors_accept_is_no_error(bench: Bench) -> None:
    """Fast DDS needs the default of a grant, and Cyclone DDS does not."""
    bench.permissions(("<default>DENY</default>", ""))
    bench.export()
    (found,) = worst(bench)
    assert (found.id, found.severity) == ("portable.refused", WARNING)
    assert found.text.startswith("Fast DDS refuses it (permissions.p7s: ")


def test_an_open_domain_is_seen_by_whomever_the_governance_is_signed(bench: Bench) -> None:
    bench.governance(*OPEN)
    signed_below(bench)
    bench.export()
    assert {each.id for each in worst(bench)} == {"governance.no-authenticity"}


def _bad_kind(bench: Bench) -> None:
    kind = "data_protection_kind>"
    bench.governance((f"{kind}ENCRYPT", f"{kind}SIGN_WITH_ORIGIN_AUTHENTICATION"))


@pytest.mark.parametrize(
    ("work", "rmw", "starts", "loadable"),
    [
        (signed_below, "rmw_fastrtps_cpp", False, True),
        (signed_below, "rmw_cyclonedds_cpp", True, True),
        (_bad_kind, "rmw_fastrtps_cpp", False, False),
        (_bad_kind, "rmw_cyclonedds_cpp", False, False),
        (lambda _: None, "rmw_fastrtps_cpp", True, True),
    ],
)
def test_every_verb_starts_what_the_vendor_starts(
    work: Callable[[Bench], object], rmw: str, starts: bool, loadable: bool, bench: Bench
) -> None:
    work(bench)
    robot = bench.export()
    ended = sros("env", "--rmw", rmw, robot, "/base")
    assert ended.status == (0 if starts else 2), ended
    assert ("a process cannot run in enclave /base" in ended.err) is not starts
    found = json.loads(sros("verify", robot, "--json").out)
    assert {each["loadable"] for each in found["enclaves"]} == {loadable}
    for folder in (robot, bench.root):
        shown = json.loads(sros("inspect", folder / "enclaves/base", "--json").out)
        assert (shown["loadable"], not shown["problems"]) == (loadable, loadable)
    for source in (robot, robot / "enclaves/base", bench.root):
        drawn = json.loads(sros("view", source, "--json").out)["enclaves"]
        assert {not each["problems"] for each in drawn} == {loadable}
    for ledger in ("ledger.jsonl", "ledger.p7s"):  # which does not know the CAs of the bench
        bench.unlink(ledger)
    sent = sros("distribute_key", bench.root, "/base", robot.with_name("another robot"))
    assert sent.status == (0 if loadable else 2), sent


@pytest.mark.parametrize(
    ("work", "why"),
    [
        (lambda _: None, ""),
        (lambda b: b.permissions(("<default>DENY</default>", "")), ""),
        (_bad_kind, "Cyclone DDS 0.10 refuses it: governance.p7s: "),
        (lambda b: b.governance(("</dds>", "")), "governance.p7s: "),
    ],
    ids=("sound", "taken by Cyclone DDS alone", "refused by all", "malformed"),
)
def test_an_answer_is_taken_where_a_vendor_takes_it(
    work: Callable[[Bench], object], why: str, bench: Bench
) -> None:
    work(bench)
    folder = bench.export() / "enclaves/base"
    key = load_key((bench.root / "enclaves/base/key.pem").read_bytes(), "key").public_key()
    files = {
        f"enclaves/base/{path.name}": path.read_bytes()
        for path in folder.iterdir()
        if path.name != "key.pem"
    }
    certificate, signing = bench.authority("permissions"), bench.key("permissions")
    signer = SimpleNamespace(sign=lambda data, _: smime.sign(data, certificate, signing))
    answer = RequestAnswer("/base", files, seal(files, 9, signer))  # type: ignore[arg-type]
    if not why:
        check_answer(answer, key, now=bench.now)
        return
    with pytest.raises(PkiError) as refusal:
        check_answer(answer, key, now=bench.now)
    assert why in refusal.value.why


@pytest.mark.parametrize(
    ("vendor", "ids"),
    [
        ("fastdds", set()),
        ("fastdds-2.9", {"enclave.refused"}),
        ("cyclonedds", {"enclave.refused"}),
        ("zenoh", {"zenoh.missing"}),
    ],
)
def test_a_refusal_by_the_only_vendor_that_is_used_is_an_error(
    vendor: str, ids: set[str], bench: Bench
) -> None:
    code_signing(bench)
    bench.export()
    assert {each.id for each in worst(bench, vendors=(vendor,))} == ids


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


def test_a_crash_of_peers_is_said_with_whom_it_hits(bench: Bench) -> None:
    """Twin: where no topic is free, the process itself crashes."""
    bench.permissions(("<id>0</id>", "<id_range><max>5</max></id_range>"))
    asked = (bench.root, "/base", "publish", "/free", "--vendor", "cyclonedds", "--domain", "0")
    said = json.loads(sros("explain", *asked, "--json").out)
    assert (said["outcome"], said["denied_by"]) == (
        "crashes",
        "nobody: the process crashes when it starts",
    )
    free = TOPIC_RULE.replace("*", "rt/free").join(("<topic_rule>", FREE))
    bench.governance(("<topic_access_rules>", f"<topic_access_rules>{free}"))
    said = json.loads(sros("explain", *asked, "--json").out)
    assert (said["outcome"], said["reason"]) == ("crashes", "open-range")
    assert said["denied_by"].endswith("the node starts, and the processes of its peers crash")
    words = ("--who", "publish", "/free", "--vendor", "cyclonedds", "--domain", "0")
    assert "cannot start: /base  " in (listed := sros("explain", bench.root, *words).out)
    assert "crashes the processes of its peers" in listed
    assert "portable.domain-range" in {each.id for each in worst(bench)}
    assert not ABOUT_VENDORS & {each.id for each in worst(bench)}
