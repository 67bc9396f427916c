"""Certificates, requests, lists and keys that `cryptography` loads, and whose parts it cannot read.

Each is an error of ours where it is read, and in a keystore a problem of one enclave: what can be
said of the others is said.
"""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec, ed25519

from sros_tool.errors import PkiError, UsageError
from sros_tool.pki.certificates import (
    load_certificate,
    load_certificates,
    load_request,
    make_request,
    pem,
)
from sros_tool.pki.crl import load_crl
from sros_tool.pki.keys import generate_key, key_pem, load_key
from sros_tool.pki.tolerant import is_tolerated
from sros_tool.validity import iso, parse_iso, window
from tests.fuzz.mutations import BIT_STRING, Value, decoded
from tests.support.harness import sros
from tests.support.long_form import some

Change = Callable[[list[Value]], object]


def changed(pem: bytes, change: Change) -> bytes:
    """Return a PEM file whose DER was changed; the lengths fit again."""
    kind, encoded = re.findall(rb"-----BEGIN ([A-Z0-9 ]+)-----(.*?)-----END", pem, re.DOTALL)[0]
    values = decoded(base64.b64decode(encoded))
    change(values)
    der = b"".join(value.encoded() for value in values)
    return b"-----BEGIN %s-----\n%s-----END %s-----\n" % (kind, base64.encodebytes(der), kind)


def every(tags: tuple[int, ...], **fields: object) -> Change:
    """Return a change of all values with one of these tags."""

    def change(values: list[Value]) -> None:
        found = [each for value in values for each in value.all() if each.tag in tags]
        assert found
        for each in found:
            for name, new in fields.items():
                setattr(each, name, new)

    return change


def first_version(number: int) -> Change:
    def change(values: list[Value]) -> None:
        versions = [v for value in values for v in value.all() if v.tag == 0x02]
        versions[0].content = bytes([number])

    return change


def twice(oid: bytes) -> Change:
    """Return a change that repeats the extension with this identifier."""

    def change(values: list[Value]) -> None:
        for above in [each for value in values for each in value.all()]:
            inside = above.content if not isinstance(above.content, bytes) else []
            for each in inside[:]:
                inner = each.content
                if not isinstance(inner, bytes) and inner and inner[0].content == oid:
                    inside.append(each)

    return change


def valid(begin: bytes, end: bytes) -> Change:
    def change(values: list[Value]) -> None:
        times = [v for value in values for v in value.all() if v.tag in (0x17, 0x18)]
        for each, text in zip(times, (begin, end), strict=False):
            each.tag, each.content = 0x18, text

    return change


STRINGS = (0x0C, 0x13)
CERTIFICATES: dict[str, Change] = {
    "BIT STRING in a name": every(STRINGS, tag=BIT_STRING, content=b"\0x"),
    "INTEGER in a name": every(STRINGS, tag=0x02, content=b"\1"),
    "name that is not UTF-8": every(STRINGS, tag=0x0C, content=b"\xff\xfe"),
    "version 7": first_version(7),
    "repeated extension": twice(b"\x55\x1d\x0f"),
    "damaged extension": every((0x01,), content=b""),
    "key on no curve": every((0x06,), content=b"\x2a\x03"),
    "year 0": valid(b"00000101000000Z", b"00010101000000Z"),
    "year 10000": valid(b"20260101000000Z", b"100000101000000Z"),
    "30 February": valid(b"20260230000000Z", b"20270101000000Z"),
    "expiry before its begin": valid(b"20270101000000Z", b"20260101000000Z"),
}
LOOKS = (
    "list_enclaves {0} --json",
    "inspect {0} --json",
    "explain {0} --who publish /old_b --json",
    "view {0} --json",
)


READ_BY_OPENSSL = (
    "version 7",
    "repeated extension",
    "key on no curve",
    "year 10000",
    "30 February",
)
"""What OpenSSL reads, and may refuse when it verifies a chain."""


@pytest.mark.parametrize("case", some([*CERTIFICATES], 5))
def test_a_broken_enclave_does_not_stop_what_is_said_of_others(case: str, keystore: Path) -> None:
    path = keystore / "enclaves/a/cert.pem"
    hostile = changed(path.read_bytes(), CERTIFICATES[case])
    if case in READ_BY_OPENSSL:
        certificate = load_certificate(hostile, "drawn")
        assert is_tolerated(certificate)
        assert load_certificate(pem(certificate), "drawn") == certificate
    else:
        with pytest.raises(PkiError, match=r"Restore it from a backup, or issue it again"):
            load_certificate(hostile, "drawn")
        with pytest.raises(PkiError):
            load_certificates(path.read_bytes() + hostile, "drawn")
    for line in LOOKS:
        whole = sros(*line.format(keystore).split())
        path_before = path.read_bytes()
        path.write_bytes(hostile)
        broken = sros(*line.format(keystore).split())
        path.write_bytes(path_before)
        assert "defect" not in broken.err, broken
        assert _said_of_b(json.loads(broken.out)) == _said_of_b(json.loads(whole.out)) != []
    path.write_bytes(hostile)
    for words in (("--json",), ("--needs-renewal", "100y")):
        found = sros("check", keystore, *words)
        assert "defect" not in found.err
        assert "/a" in found.out + found.err


def _said_of_b(value: object) -> list[object]:
    """Return the parts of a JSON value that are about the enclave /b, except findings.

    A finding in all enclaves is told once, so that it moves when one of them is broken.
    """
    if value == "/b":
        return [value]
    if isinstance(value, dict) and "severity" in value:
        return []
    if isinstance(value, list):
        return [found for each in value for found in _said_of_b(each)]
    if isinstance(value, dict):
        if {value.get(key) for key in ("name", "enclave", "path")} & {"/b"}:
            return [value]
        return [found for each in value.values() for found in _said_of_b(each)]
    return []


LISTS: dict[str, Change] = {
    "BIT STRING in the issuer": every(STRINGS, tag=BIT_STRING, content=b"\0x"),
    "version 9": first_version(9),
    "repeated extension": twice(b"\x55\x1d\x14"),
    "year 0": valid(b"00000101000000Z", b"00000101000000Z"),
}


@pytest.mark.parametrize("case", LISTS)
def test_revocation_list(case: str, keystore: Path) -> None:
    read_by_openssl = case != "BIT STRING in the issuer"
    sros("revoke", keystore, "/b").ok()
    path = keystore / "public/identity_ca.crl.pem"
    load_crl(path.read_bytes(), "whole")
    path.write_bytes(changed(path.read_bytes(), LISTS[case]))
    if read_by_openssl:
        load_crl(path.read_bytes(), "drawn")
    else:
        with pytest.raises(PkiError, match="cannot be read"):
            load_crl(path.read_bytes(), "drawn")
    listed = "{0}/public/identity_ca.crl.pem"
    for line, status in (
        ("inspect {0}", 1),
        (f"inspect {listed}", 2),
        ("check {0}", 1),
        ("crl {0}", 2),
    ):
        ended = sros(*line.format(keystore).split())
        assert read_by_openssl or ended.status == status, ended
        assert "defect" not in ended.err


REQUESTS: dict[str, Change] = {
    "BIT STRING in the subject": every(STRINGS, tag=BIT_STRING, content=b"\0x"),
    "version 9": first_version(9),
    "key on no curve": every((0x06,), content=b"\x2a\x03"),
}


@pytest.mark.parametrize("case", REQUESTS)
def test_request(case: str) -> None:
    request = make_request(generate_key(), "/a")
    assert load_request(request, "whole").name == "/a"
    with pytest.raises(PkiError, match=r"cannot be read.*Create it with"):
        load_request(changed(request, REQUESTS[case]), "drawn")


# ── keys and passphrases ───────────────────────────────────────────────────────────────────


def test_odd_keys() -> None:
    other = ed25519.Ed25519PrivateKey.generate().private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )
    plain = key_pem(ec.generate_private_key(ec.SECP256R1()))
    for damaged in (other, b"", plain[:-60], changed(plain, every((0x06,), content=b"\x2a\x03"))):
        with pytest.raises(PkiError):
            load_key(damaged, "drawn")


PASSPHRASES = {
    "with a carriage return": b"secret\r\n",
    "without an end of line": b"secret",
    "of 1023 bytes": b"x" * 1023,
}


@pytest.mark.parametrize("case", some([*PASSPHRASES], 1))
def test_passphrase_file(case: str, tmp_path: Path) -> None:
    (tmp_path / "secret").write_bytes(PASSPHRASES[case])
    variables = {
        "SROS_CA_PASSPHRASE_FILE": str(tmp_path / "secret"),
        "SROS_SHORT_PASSPHRASE": "1",
    }
    sros("create_keystore", tmp_path / "ks", "--encrypt-ca-keys", env=variables).ok()
    sros("create_enclave", tmp_path / "ks", "/a", env=variables).ok()
    (tmp_path / "secret").write_bytes(b"another")
    refused = sros("create_enclave", tmp_path / "ks", "/b", env=variables)
    assert refused.status == 2
    assert "cannot be decrypted" in refused.err


@pytest.mark.parametrize("file", ["/dev/zero", "long", "/"])
def test_passphrase_file_that_is_none(file: str, tmp_path: Path) -> None:
    (tmp_path / "long").write_bytes(b"x" * 5000)
    variables = {"SROS_CA_PASSPHRASE_FILE": str(tmp_path / file)}
    ended = sros("create_keystore", tmp_path / "ks", "--encrypt-ca-keys", env=variables)
    assert ended.status == 2
    assert "defect" not in ended.err
    assert not (tmp_path / "ks").exists()


# ── clocks ─────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("year", [1, 2, 1949])
def test_nothing_is_signed_at_a_time_that_no_certificate_can_name(year: int) -> None:
    with pytest.raises(UsageError, match=f"at {year:04}-01-01T00:00:00Z .* Set the clock"):
        window(datetime(year, 1, 1, tzinfo=UTC), timedelta(days=1))


def test_the_last_year() -> None:
    now = datetime(9999, 12, 1, tzinfo=UTC)
    assert window(now, timedelta(days=1)).contains(now)
    with pytest.raises(UsageError, match="choose a shorter validity"):
        window(now, timedelta(days=365))


def test_early_years_have_four_digits() -> None:
    moment = datetime(1, 2, 3, tzinfo=UTC)
    assert iso(moment) == "0001-02-03T00:00:00Z"
    assert parse_iso(iso(moment)) == moment
