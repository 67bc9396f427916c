"""Encrypted keys, written so that guessing is slow, and read in every form that OpenSSL writes."""

from __future__ import annotations

import base64
import re
import subprocess
from pathlib import Path

import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import rsa

from sros_tool.errors import PkiError
from sros_tool.pki import der, keys
from sros_tool.pki.keys import (
    PrivateKey,
    few_rounds_clause,
    generate_key,
    holds_private_key,
    key_pem,
    load_key,
)
from tests.support.long_form import some

PASSPHRASE = "Öffne dich, Sesam"
REPEATED = keys._P  # as it is before the tests begin, which need it less often
KEYS: dict[str, PrivateKey] = {"EC": generate_key(), "RSA": rsa.generate_private_key(65537, 2048)}


def openssl(*words: object, data: bytes = b"", accept: bool = True) -> bytes:
    ended = subprocess.run(["openssl", *map(str, words)], input=data, capture_output=True)
    assert (ended.returncode == 0) is accept, ended.stderr
    return ended.stdout


def plain(key: PrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.DER,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )


@pytest.mark.parametrize("kind", some([*KEYS], 1))
def test_openssl_reads_an_encrypted_key(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    key = KEYS[kind]
    monkeypatch.setattr(keys, "_P", REPEATED)
    pem = key_pem(key, PASSPHRASE)
    right, wrong = (("-passin", f"pass:{word}") for word in (PASSPHRASE, "another"))
    read = openssl("pkcs8", "-topk8", "-nocrypt", "-outform", "DER", *right, data=pem)
    assert read == plain(key)
    openssl("pkey", "-noout", *wrong, data=pem, accept=False)
    said = openssl("asn1parse", data=pem).decode()
    # scrypt with N = 2^14, r = 8, p = 5, and AES-256
    for part in (":scrypt\n", "INTEGER           :4000\n", ":05\n", ":aes-256-cbc\n"):
        assert part in said
    assert max(map(len, pem.splitlines())) == 64


def test_sros_reads_it_with_its_passphrase_alone() -> None:
    key = KEYS["EC"]
    pem = key_pem(key, PASSPHRASE)
    assert plain(load_key(pem, "k", lambda: PASSPHRASE)) == plain(key)
    with pytest.raises(PkiError, match="passphrase is wrong"):
        load_key(pem, "k", lambda: "another")
    assert key_pem(key, PASSPHRASE) != pem  # salt and initialization vector are drawn


@pytest.mark.parametrize(
    "words",
    [
        "pkcs8 -topk8 -v2 aes-256-cbc -iter 2048",
        "pkcs8 -topk8 -v2 aes-128-cbc -v2prf hmacWithSHA1",
        "pkcs8 -topk8 -scrypt",
        "ec -aes256",
        "pkey -aes256",
    ],
)
def test_keys_that_others_encrypted_are_read(words: str) -> None:
    key = KEYS["EC"]
    pem = openssl(*words.split(), "-passout", f"pass:{PASSPHRASE}", data=key_pem(key))
    assert b"ENCRYPTED" in pem
    assert plain(load_key(pem, "k", lambda: PASSPHRASE)) == plain(key)


@pytest.mark.parametrize("cipher", ["aes128", "aes256", "des3"])
@pytest.mark.parametrize("digits", [0, 1, 15])
def test_a_key_with_too_short_an_initial_value_is_damaged(cipher: str, digits: int) -> None:
    """`cryptography` would panic, past every handler of errors."""
    words = f"ec -{cipher} -passout pass:{PASSPHRASE}".split(" ", 3)
    made = openssl(*words, data=key_pem(KEYS["EC"]))
    assert load_key(made, "drawn", lambda: PASSPHRASE)
    value = re.findall(rb"DEK-Info: \S+,([0-9A-F]+)", made)[0]
    with pytest.raises(PkiError, match="cannot be read"):
        load_key(made.replace(value, value[:digits]), "drawn", lambda: PASSPHRASE)


def test_keys_that_earlier_versions_encrypted_are_read() -> None:
    key = KEYS["EC"]
    before = serialization.BestAvailableEncryption(PASSPHRASE.encode())
    form = serialization.PrivateFormat.PKCS8
    pem = key.private_bytes(serialization.Encoding.PEM, form, before)
    assert plain(load_key(pem, "k", lambda: PASSPHRASE)) == plain(key)


# ── keys that OpenSSL would read for minutes, deaf to signals ──────────────────────────────


def pem_of(kind: str, *parts: bytes) -> bytes:
    body = base64.encodebytes(der.encode(der.SEQUENCE, *parts))
    return f"-----BEGIN {kind}-----\n".encode() + body + f"-----END {kind}-----\n".encode()


def rsa_key_of(bits: int) -> bytes:
    return pem_of(
        "RSA PRIVATE KEY", *map(der.encode_integer, (0, 1 << bits - 1, 3, 1, 1, 1, 1, 1, 1))
    )


def demanding(before: int, after: int, *words: str) -> bytes:
    """A key that openssl encrypted, with one number of its derivation replaced."""
    made = openssl("pkcs8", "-topk8", *words, "-passout", "pass:abc", data=key_pem(KEYS["EC"]))
    content = der.first_value(base64.b64decode(b"".join(made.splitlines()[1:-1]))).content
    scheme, data = der.children(content)

    def replaced(value: der.Value) -> bytes:
        if value.tag == der.SEQUENCE:
            return der.encode(der.SEQUENCE, *map(replaced, der.children(value.content)))
        same = value.whole != der.encode_integer(before)
        return value.whole if same else der.encode_integer(after)

    return pem_of("ENCRYPTED PRIVATE KEY", replaced(scheme), data.whole)


@pytest.mark.parametrize(
    ("pem", "why"),
    [
        (rsa_key_of(16384), "has 16384 bits"),
        (rsa_key_of(1_000_000), "more than 16 KiB"),
        (demanding(2048, 2**31 - 1, "-iter", "2048"), "takes too long"),
        (demanding(16384, 2**30, "-scrypt"), "takes too long"),
        (demanding(1, 2**30, "-scrypt"), "takes too long"),
        (demanding(2048, 2**31 - 1, "-v1", "PBE-SHA1-3DES", "-iter", "2048"), "takes too long"),
    ],
)
def test_a_key_that_takes_long_is_refused(pem: bytes, why: str) -> None:
    with pytest.raises(PkiError, match=why):
        load_key(pem, "k", lambda: "abc")


@pytest.mark.parametrize("words", ["-iter 2048", "-scrypt", "-v1 PBE-SHA1-3DES -iter 2048"])
def test_the_same_key_with_its_own_numbers_is_read(words: str) -> None:
    load_key(demanding(2048, 2048, *words.split()), "k", lambda: "abc")


@pytest.mark.parametrize(
    "words",
    [
        ["pkey"],
        ["pkey", "-traditional"],
        ["pkcs8", "-topk8", "-passout", "pass:twelve chars"],
        ["pkey", "-traditional", "-aes256", "-passout", "pass:twelve chars"],
    ],
    ids=" ".join,
)
@pytest.mark.parametrize("key", KEYS.values(), ids=KEYS)
def test_a_private_key_is_found_in_every_form_of_openssl(key: PrivateKey, words: list[str]) -> None:
    pem = key_pem(key)
    assert holds_private_key(b"other text\n" + openssl(*words, data=pem))
    assert not holds_private_key(openssl("pkey", "-pubout", data=pem))


ROUNDS = {
    "pkcs8 -topk8": "trying a passphrase takes 2048 rounds",
    "pkcs8 -topk8 -iter 1000": "trying a passphrase takes 1000 rounds",
    "pkcs8 -topk8 -iter 600000": "",
    "pkcs8 -topk8 -v1 PBE-SHA1-3DES": "trying a passphrase takes 2048 rounds",
    "pkcs8 -topk8 -scrypt": "",
    "pkcs8 -topk8 -scrypt -scrypt_N 1024": (
        "trying a passphrase takes scrypt with N, r, p = 1024, 8, 1"
    ),
    "pkey -traditional -aes256": "trying a passphrase takes one round of MD5",
    "pkey": "",
}


@pytest.mark.parametrize("form", ROUNDS)
def test_few_rounds_to_try_a_passphrase(form: str) -> None:
    encrypted = [] if form == "pkey" else ["-passout", f"pass:{PASSPHRASE}"]
    pem = openssl(*form.split(), *encrypted, data=key_pem(KEYS["EC"]))
    assert few_rounds_clause(pem) == ROUNDS[form]


def test_sros_and_its_damaged_keys_have_no_few_rounds() -> None:
    pem = key_pem(KEYS["EC"], PASSPHRASE)
    assert few_rounds_clause(pem) == ""
    assert few_rounds_clause(pem.replace(pem[40:80], b"")) == ""
