"""Damaged keys, certificates and documents are errors that are told, wherever the damage is."""

from __future__ import annotations

import base64
import random
import re
import shutil
import subprocess
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.serialization import Encoding
from hypothesis import given
from hypothesis import strategies as st

from sros_tool.errors import PkiError, SrosError
from sros_tool.keystore.describe import describe
from sros_tool.keystore.lifecycle.create import create_enclaves
from sros_tool.keystore.reader import open_enclave
from sros_tool.pki import der
from sros_tool.pki.certificates import load_certificate, load_der_certificate
from tests.support.children import LONG
from tests.support.long_form import some

FILES = (
    "public/identity_ca.cert.pem",
    "public/permissions_ca.cert.pem",
    "private/identity_ca.key.pem",
    "enclaves/a/cert.pem",
    "enclaves/a/key.pem",
    "enclaves/a/permissions.p7s",
    "enclaves/governance.p7s",
    "sros.toml",
)
ROUNDS = 150 if LONG else 20
_BASE64 = re.compile(rb"(?:-----BEGIN [A-Z ]+-----\n|smime\.p7s\"\r\n\r\n)([A-Za-z0-9+/=\s]+)")


def damage(data: bytearray, dice: random.Random) -> None:
    for _ in range(dice.choice((1, 1, 1, 2, 4))):
        place = dice.randrange(len(data))
        how = dice.randrange(3)
        if how == 0:
            data[place] = dice.randrange(256)
        elif how == 1:
            del data[place : place + dice.randrange(1, 4)]
        else:
            data[place:place] = dice.randbytes(dice.randrange(1, 4))


def damaged(data: bytes, dice: random.Random) -> bytes:
    """The file with some bytes changed, half of the time inside of what base64 carries."""
    found = list(_BASE64.finditer(data))
    if not found or dice.random() < 0.3:
        changed = bytearray(data)
        damage(changed, dice)
        return bytes(changed)
    inside = bytearray(base64.b64decode(found[-1][1]))
    damage(inside, dice)
    return data[: found[-1].start(1)] + base64.encodebytes(inside) + data[found[-1].end(1) :]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", some(FILES, 2))
def test_damage(name: str, keystore: Path) -> None:
    dice = random.Random(name)
    path, now = keystore / name, datetime.now(UTC)
    whole = path.read_bytes()
    looks: dict[str, Callable[[], object]] = {
        "describe the file": lambda: describe(path, now=now),
        "describe the keystore": lambda: describe(keystore, now=now),
        "check": lambda: open_enclave(keystore / "enclaves/a", now=now, domain=0),
        "add": lambda: create_enclaves(keystore, ["/a", "/new"], now=now, dry_run=True),
    }
    if name == "sros.toml":
        del looks["describe the file"]
    told = 0
    for number in range(ROUNDS):
        path.write_bytes(damaged(whole, dice))
        for what, look in looks.items():
            try:
                look()
            except SrosError:
                told += 1
            except Exception as error:
                shutil.copy(path, keystore.parent / "culprit")
                raise AssertionError(f"{what}, damage {number}: {error!r}") from error
    assert told > ROUNDS / 8
    path.write_bytes(whole)
    for look in looks.values():
        look()


@given(st.binary(max_size=40))
def test_any_bytes_are_der_or_an_error(data: bytes) -> None:
    try:
        values = der.children(data)
    except PkiError:
        return
    assert b"".join(value.whole for value in values) == data
    assert all(value.whole.endswith(value.content) for value in values)
    if values:
        assert der.first_value(data) == values[0]
    else:
        with pytest.raises(PkiError):
            der.first_value(data)


@pytest.mark.parametrize(
    "data",
    [
        "30",
        "3001",
        "3080",
        "3085000000000100",
        "1f0100",
        "bf0100",
        "30820001",
        "3003020100ff",
        "308100",
        "30810100",
    ],
)
def test_der_that_is_cut_short_or_of_another_form(data: str) -> None:
    with pytest.raises(PkiError):
        der.children(bytes.fromhex(data))


@pytest.mark.parametrize(
    ("content", "number"),
    [("00", 0), ("7f", 127), ("80", -128), ("0080", 128), ("ff", -1), ("", None), ("0001", None),
     ("ff80", None)],
)  # fmt: skip
def test_numbers_have_one_form(content: str, number: int | None) -> None:
    value = der.Value(der.INTEGER, bytes.fromhex(content), b"")
    if number is not None:
        assert der.integer(value) == number
        return
    with pytest.raises(PkiError):
        der.integer(value)


@pytest.mark.parametrize(
    ("dotted", "content"),
    [
        ("1.2.840.113549.1.7.2", "2a864886f70d010702"),
        ("2.16.840.1.101", "6086480165"),
        ("2.5.4", "5504"),
    ],
)
def test_object_identifiers(dotted: str, content: str) -> None:
    assert der.encode_oid(dotted).hex() == content


DAMAGED_PARTS = {
    "the signature algorithm": ("2a8648ce3d040302", "2a8648ce3d040382"),
    "no signature algorithm": ("300a06082a8648ce3d040302", "300a04082a8648ce3d040302"),
    "the type of an attribute of a name": ("0603550403", "0603550483"),
    "an extension": ("0603551d13", "0603551d93"),
    "the algorithm of the key": ("2a8648ce3d0201", "2a8648ce3d0281"),
    "the curve of the key": ("2a8648ce3d030107", "2a8648ce3d030187"),
    "unused bits of the key": ("034200", "034245"),
    "the tag of the version": ("a003020102", "a003040102"),
    "the tag of the extensions": ("a366", "a466"),
    "the tag of the list of extensions": ("a3663064", "a3663164"),
    "the tag of the type of an attribute": ("0603550403", "0403550403"),
}


@pytest.mark.parametrize("part", DAMAGED_PARTS)
def test_a_certificate_that_openssl_cannot_read_is_refused(part: str, keystore: Path) -> None:
    """It makes a document that embeds it unreadable, also if it is not the signer's."""
    pem = (keystore / "public/permissions_ca.cert.pem").read_bytes()
    whole = load_certificate(pem, "a CA").public_bytes(Encoding.DER)
    before, after = map(bytes.fromhex, DAMAGED_PARTS[part])
    assert before in whole
    with pytest.raises(PkiError, match="a certificate in it cannot be read"):
        load_der_certificate(whole.replace(before, after, 1))
    assert subprocess.run(
        ["openssl", "x509", "-inform", "DER", "-noout"],
        input=whole.replace(before, after, 1),
        capture_output=True,
    ).returncode
