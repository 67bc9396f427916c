"""The ways to sign a document with openssl: which of them the vendors take, and sros with them."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import pytest

from sros_tool.dds.decision.vendors import TESTED, Signers, Vendor
from sros_tool.errors import PkiError
from sros_tool.keystore.participant import load_enclave
from sros_tool.pki import smime
from sros_tool.pki.certificates import pem
from sros_tool.pki.keys import key_pem
from tests.dds.decision_documents import allow, grant, permissions, publish
from tests.integration.fastdds import fastdds_vendor
from tests.integration.vendor_oracle import (
    PEER,
    PEER_PERMISSIONS,
    Pair,
    Reply,
    Workshop,
    ask_cyclone_folders,
    ask_fastdds_folders,
    cyclone_vendor,
    with_patience,
)
from tests.integration.vendor_rows import OPEN
from tests.support.children import run

pytestmark = pytest.mark.dds

FORMS = {
    "-text": ("smime -sign -text", True),
    "-text, opaque": ("smime -sign -text -nodetach", True),
    "cms -text": ("cms -sign -text", True),
    "-text, SHA-1": ("smime -sign -text -md sha1", True),
    "-text, SHA-512": ("smime -sign -text -md sha512", True),
    "without -text": ("smime -sign", False),
    "-text -binary": ("smime -sign -text -binary", False),
    "-text -nocerts": ("smime -sign -text -nocerts", False),
}
"""By a name: how openssl signs, and whether Fast DDS 2.9.1 and Cyclone DDS 0.10.2 take it."""

TAKEN_LATER = {"-text -nocerts"}
"""What Fast DDS 2.14.5 and Cyclone DDS 11.0 take as well."""

READ_BY_SROS = {"-text", "-text, opaque", "cms -text", "-text, SHA-1", "-text, SHA-512"}


@pytest.fixture(scope="module")
def workshop(tmp_path_factory: pytest.TempPathFactory) -> Workshop:
    return Workshop(tmp_path_factory.mktemp("workshop"))


@pytest.fixture(scope="module")
def enclaves(workshop: Workshop) -> dict[str, Path]:
    """An enclave for each form, whose permissions are signed like that."""
    document = permissions(grant(allow(publish("rt/a"), domains="<id>0</id>")))
    signer, key = workshop.root / "signer.pem", workshop.root / "signer.key"
    signer.write_bytes(pem(workshop.authorities["permissions"]))
    key.write_bytes(key_pem(workshop.keys["permissions"]))
    (workshop.root / "permissions.xml").write_bytes(document)
    made = {}
    for number, (name, (way, _)) in enumerate(FORMS.items()):
        made[name] = enclave(workshop, f"form {number}", "CN=/t", document)
        files = ["-signer", signer, "-inkey", key, "-in", workshop.root / "permissions.xml"]
        out = made[name] / "permissions.p7s"
        out.unlink()
        command = ["openssl", *way.split(), *map(str, files), "-out", str(out)]
        run(command)
    return made


def enclave(workshop: Workshop, name: str, subject: str, document: bytes) -> Path:
    folder = Path(shutil.copytree(workshop.identity(subject), workshop.root / name))
    shutil.copytree(workshop.documents(OPEN, document), folder, dirs_exist_ok=True)
    return folder


def takes(vendor: Vendor, form: str) -> bool:
    later = vendor.traits.signers is Signers.LISTED
    return FORMS[form][1] or (later and form in TAKEN_LATER)


@pytest.mark.parametrize("vendor", ["Cyclone DDS", "Fast DDS"])
def test_what_the_vendors_take(vendor: str, workshop: Workshop, enclaves: dict[str, Path]) -> None:
    peer = enclave(workshop, f"peer for {vendor}", PEER, PEER_PERMISSIONS)

    def ask(some: Sequence[Pair], seconds: float) -> list[Reply]:
        if vendor == "Cyclone DDS":
            return ask_cyclone_folders(some, "rt/a", peer, seconds=seconds)
        return ask_fastdds_folders(some, "rt/a", workshop.root, seconds=seconds)

    asked = cyclone_vendor() if vendor == "Cyclone DDS" else fastdds_vendor()
    expected = [takes(asked, name) for name in FORMS]
    pairs = [(enclaves[name], peer, "UTC") for name in FORMS]
    replies = with_patience(ask, pairs, lambda place, _: expected[place])
    assert [reply.answers == ("matched",) for reply in replies] == expected, replies


@pytest.mark.parametrize("name", FORMS)
def test_sros_explains_what_the_vendors_do(name: str, enclaves: dict[str, Path]) -> None:
    material = load_enclave("/t", enclaves[name], moment=datetime.now(UTC))
    taken = {vendor: takes(vendor, name) for vendor in TESTED}
    found = {vendor: not material.problems(vendor.traits) for vendor in taken}
    assert found == taken


@pytest.mark.parametrize("name", FORMS)
def test_sros_takes_nothing_that_a_vendor_refuses(
    name: str, workshop: Workshop, enclaves: dict[str, Path]
) -> None:
    data = (enclaves[name] / "permissions.p7s").read_bytes()
    try:
        smime.parse(data).verify(workshop.authorities["permissions"])
    except PkiError:
        assert name not in READ_BY_SROS
    else:
        assert name in READ_BY_SROS
        assert FORMS[name][1]
