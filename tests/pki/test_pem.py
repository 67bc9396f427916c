"""PEM files are read as OpenSSL reads them."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable

import pytest
from cryptography.hazmat.primitives.serialization import Encoding

from sros_tool.errors import PkiError
from sros_tool.pki.certificates import load_certificate, load_certificates, pem
from sros_tool.pki.crl import read_list, sign_crl
from sros_tool.pki.keys import generate_key, key_pem, load_key
from sros_tool.validity import Window
from tests.dds.signer_rows import DAY, NOW, authority
from tests.integration.libcrypto import Libcrypto, libcrypto
from tests.support.children import LONG

DRAWN = 20_000 if LONG else 250
FIRST, SECOND = pem(authority("first")[0]), pem(authority("second")[0])
KEY = key_pem(generate_key())
BEGIN = b"-----BEGIN CERTIFICATE-----\n"


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"  " + FIRST, "'-----BEGIN' is not at the start of its line"),
        (b"certificate: " + FIRST, "'-----BEGIN' is not at the start of its line"),
        (KEY, "It is not a PEM certificate: it is a private key"),
        (b"x", "it has no line '-----BEGIN CERTIFICATE-----'"),
        (FIRST.replace(BEGIN, BEGIN + b"Subject: x\n\n"), "It has PEM headers ('Subject: x')"),
        (FIRST[:-30], "The block CERTIFICATE in it is cut short"),
        (FIRST.replace(b"END C", b"END X"), "does not end with '-----END CERTIFICATE-----'"),
        (FIRST.replace(BEGIN, BEGIN + b"?"), "is not valid base64"),
        (FIRST.replace(BEGIN, BEGIN.replace(b"-\n", b"-\xc2\xa0\n")), "a non-ASCII byte"),
        (FIRST.replace(BEGIN, BEGIN + b"\0"), "in it has a zero byte"),
    ],
)
def test_what_openssl_does_not_read_is_refused_with_its_reason(data: bytes, why: str) -> None:
    with pytest.raises(PkiError) as caught:
        load_certificate(data, "x")
    assert why.lower() in caught.value.why.lower()


def test_a_damaged_second_certificate_hides_the_file_but_not_the_first() -> None:
    data = FIRST + SECOND.replace(BEGIN, BEGIN + b"MIIB\n")
    assert pem(load_certificate(data, "x")) == FIRST
    with pytest.raises(PkiError):
        load_certificates(data, "x")


def test_a_list_with_headers_is_refused_as_a_certificate_with_headers() -> None:
    pair = authority("CA")
    at = Window(NOW - DAY, NOW + DAY)
    made = sign_crl(*pair, [], number=1, this_update=at.not_before, next_update=at.not_after)
    assert read_list(made, "x").issuer == pair[0].subject
    with pytest.raises(PkiError):
        read_list(made.replace(b" CRL-----\n", b" CRL-----\nSubject: x\n\n", 1), "x")


def test_a_trusted_certificate_is_passed_over_where_asked() -> None:
    trusted = FIRST.replace(b" CERTIFICATE", b" TRUSTED CERTIFICATE")
    assert pem(load_certificate(trusted + SECOND, "x")) == FIRST
    assert pem(load_certificate(trusted + SECOND, "x", trusted=False)) == SECOND


# ── drawn damage ───────────────────────────────────────────────────────────────────────────


def _at_a_line(change: Callable[[random.Random, bytes], bytes]) -> Callable[..., bytes]:
    def edit(dice: random.Random, data: bytes) -> bytes:
        lines = data.split(b"\n")
        place = dice.randrange(len(lines))
        lines[place] = change(dice, lines[place])
        return b"\n".join(lines)

    return edit


def _character(dice: random.Random, data: bytes) -> bytes:
    place = dice.randrange(len(data))
    return data[:place] + dice.choice((b"", b"A", b"=", b"-", b":", b" ", b"\n")) + data[place:]


EDITS: tuple[Callable[[random.Random, bytes], bytes], ...] = (
    _character,
    _at_a_line(lambda dice, line: dice.choice((b" ", b"\t", b"x", b'"')) + line),
    _at_a_line(lambda dice, line: line + dice.choice((b" ", b"\r", b"\v", b"\n", b"\n\n"))),
    _at_a_line(lambda _, line: line + b"\n" + line),
    _at_a_line(lambda _, line: line[: len(line) // 2] + b"\n" + line[len(line) // 2 :]),
    lambda _, data: data.replace(b"\n", b"\r\n"),
    lambda _, data: data.replace(b"\n", b" "),
    lambda _, data: b"\xef\xbb\xbf" + data,
    lambda dice, data: data.replace(BEGIN, BEGIN + dice.choice((b"X: y\n", b"X: y\n\n", b"\n"))),
    lambda dice, data: data.replace(b" CERT", dice.choice((b" X509 CERT", b" TRUSTED CERT")), 1),
    lambda dice, data: b"x" * dice.choice((253, 254, 255, 508)) + data,
    lambda _, data: KEY + data,
)


def test_drawn_files_are_read_as_by_openssl() -> None:
    library = libcrypto() or pytest.skip("there is no libcrypto.so.3")
    dice, count = random.Random(11), Counter[tuple[bool, bool]]()
    for _ in range(DRAWN):
        data = dice.choice((FIRST, FIRST + SECOND, KEY))
        for _ in range(dice.choice((1, 1, 2))):
            data = dice.choice(EDITS)(dice, data)
        for theirs, ours in zip(_theirs(library, data), _ours(data), strict=True):
            assert ours == theirs or not ours, data
            count[bool(theirs), bool(ours)] += 1
    assert count[True, True] > DRAWN / 4
    assert count[False, False] > DRAWN / 4
    assert count[True, False] < DRAWN / 20  # damaged in what is decoded


def _theirs(library: Libcrypto, data: bytes) -> tuple[object, ...]:
    first = library.certificate(data, trusted=False)
    return first, library.authorities(data) or None, library.reads_key(data)


def _ours(data: bytes) -> tuple[object, ...]:
    def read(load: Callable[[], object]) -> object:
        try:
            return load()
        except PkiError:
            return None

    first = read(lambda: load_certificate(data, "x", trusted=False).public_bytes(Encoding.DER))
    every = read(lambda: [each.public_bytes(Encoding.DER) for each in load_certificates(data, "x")])
    return first, every, read(lambda: bool(load_key(data, "x"))) or False
