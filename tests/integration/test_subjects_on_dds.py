"""Subjects as real PKIs have them: which grants the vendors take for such a certificate."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from xml.sax.saxutils import escape

import pytest
from cryptography import x509
from cryptography.x509.name import _ASN1Type
from cryptography.x509.oid import NameOID

from sros_tool.dds.decision.access import AccessVerb, Outcome, Refusal
from sros_tool.dds.decision.vendors import TESTED, Subjects, Vendor
from sros_tool.pki.certificates import subject_text
from tests.dds.decision_documents import access_of, allow, grant, permissions, publish, subscribe
from tests.dds.signer_rows import NOW, REFUSED, YES, Made, write_enclave
from tests.dds.signer_rows import Row as Files
from tests.integration.fastdds import fastdds_vendor
from tests.integration.vendor_oracle import (
    PEER,
    PEER_PERMISSIONS,
    Pair,
    Reply,
    ask_cyclone_folders,
    ask_fastdds_folders,
    cyclone_vendor,
    with_patience,
)
from tests.integration.vendor_rows import CRASHES, OPEN

pytestmark = pytest.mark.dds
TOPIC = "rt/a"


@dataclass(frozen=True)
class Row:
    """A subject and the subject of the grant, and what three vendors do."""

    name: str
    subject: x509.Name
    fast: str = YES
    later: str = YES
    cyclone: str = YES
    granted: str | None = None
    cyclone_11: str = ""

    def permissions(self) -> bytes:
        granted = subject_text(self.subject) if self.granted is None else self.granted
        rule = allow(publish("*"), subscribe("*"), domains="<id>0</id>")
        return permissions(grant(rule, subject=escape(granted)))


def one(
    value: str | bytes,
    kind: _ASN1Type = _ASN1Type.UTF8String,
    oid: x509.ObjectIdentifier = NameOID.COMMON_NAME,
) -> x509.NameAttribute[str | bytes]:
    with warnings.catch_warnings(action="ignore"):
        return x509.NameAttribute(oid, value, kind, _validate=False)


def named(*attributes: tuple[str, str | bytes, _ASN1Type]) -> x509.Name:
    return x509.Name(
        [one(value, kind, x509.ObjectIdentifier(oid)) for oid, value, kind in attributes]
        + [one("/t")]
    )


TEXT = _ASN1Type.UTF8String
ROWS = [
    Row(
        "attributes that OpenSSL has names for",
        named(
            *(
                (oid, "x", TEXT)
                for oid in (
                    "2.5.4.13", "2.5.4.41", "2.5.4.20", "0.9.2342.19200300.100.1.3",
                    "1.3.6.1.5.5.7.3.1",
                )
            )
        ),
    ),
    Row("an attribute without a name", named(("1.2.3.4", "x", TEXT))),
    Row("a bit string", named(("2.5.4.45", b"\0abc", _ASN1Type.BitString))),
    Row("one #", x509.Name([one("#")])),
    Row("a zero byte and a line", x509.Name([one("a\0b\nc")])),
    Row("escaped blanks at the end", x509.Name([one(" a ")]), cyclone=REFUSED, cyclone_11=YES),
    Row("16 bits for each character", x509.Name([one("/t", _ASN1Type.BMPString)])),
    Row("T61String", x509.Name([one("größe", _ASN1Type.T61String)]), cyclone=REFUSED),
    Row("no value", x509.Name([one("")])),
    Row("no attribute", x509.Name([]), CRASHES, CRASHES, YES, "CN=/t"),
    Row(
        "two of a kind", named(*(("2.5.4.11", each, TEXT) for each in "ab")), YES, REFUSED, REFUSED
    ),
    Row(
        "above 1024 bytes", named(*((f"1.2.3.{each}", "x" * 75, TEXT) for each in range(9))),
        REFUSED, REFUSED,
    ),
    Row(
        "the first 1024 bytes", named(("2.5.4.10", "x" * 1100, TEXT)),
        cyclone=REFUSED, granted="CN=/t,O=" + "x" * 1016,
    ),
]  # fmt: skip


@pytest.mark.parametrize("asked", ["Fast DDS", "Cyclone DDS"])
def test_every_row(asked: str, tmp_path: Path) -> None:
    vendor = cyclone_vendor() if asked == "Cyclone DDS" else fastdds_vendor()
    files, peer = Files("", Made(), "", "", ""), tmp_path / "peer"
    write_enclave(files, peer, PEER, OPEN, PEER_PERMISSIONS)
    pairs: list[Pair] = []
    for number, row in enumerate(ROWS):
        own = tmp_path / str(number)
        write_enclave(files, own, row.subject, OPEN, row.permissions())
        pairs.append((own, peer, "UTC"))

    def ask(some: Sequence[Pair], seconds: float) -> list[Reply]:
        if asked == "Cyclone DDS":
            return ask_cyclone_folders(some, TOPIC, peer, seconds=seconds, made=NOW)
        return ask_fastdds_folders(some, TOPIC, tmp_path, seconds=seconds, made=NOW)

    expected = [answer_of(row, vendor) for row in ROWS]
    replies = with_patience(ask, pairs, lambda place, _: expected[place] == YES)
    wrong = [
        f"{row.name}: {vendor.title} answers {reply}, not {answer}"
        for row, reply, answer in zip(ROWS, replies, expected, strict=True)
        if (reply.answers[0] if reply.end == "joined" else reply.end) != answer
    ]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("vendor", TESTED)
@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_the_engine_says_what_the_rows_say(row: Row, vendor: Vendor) -> None:
    access = access_of(
        vendor,
        OPEN,
        row.permissions(),
        subject_text(row.subject),
        domain=0,
        at=datetime.now(UTC),
    )
    assert not isinstance(access, Refusal)
    decided = access.decide(AccessVerb.PUBLISH, TOPIC)
    outcomes = {YES: Outcome.ALLOWED, REFUSED: Outcome.REFUSED, CRASHES: Outcome.CRASHES}
    assert decided.outcome is outcomes[answer_of(row, vendor)], decided


def answer_of(row: Row, vendor: Vendor) -> str:
    if vendor is Vendor.CYCLONE_11:
        return row.cyclone_11 or row.cyclone
    if vendor is Vendor.CYCLONE:
        return row.cyclone
    return row.later if vendor.traits.subjects is Subjects.ANY_ORDER else row.fast
