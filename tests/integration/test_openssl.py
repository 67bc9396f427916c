"""OpenSSL, which every DDS vendor uses, accepts what sros makes; and sros what OpenSSL signs."""

from __future__ import annotations

import base64
import random
import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from lxml import etree

from sros_tool.errors import SrosError
from sros_tool.files import policies_dir
from sros_tool.keystore.template import template_names
from sros_tool.pki import smime
from sros_tool.pki.certificates import load_certificate
from tests.support.harness import sros
from tests.support.long_form import some

SCHEMAS = Path(__file__).parents[1] / "schemas"


def openssl(*words: object, accept: bool = True) -> bytes:
    """Run openssl; what it printed."""
    ended = subprocess.run(["openssl", *map(str, words)], capture_output=True)
    assert (ended.returncode == 0) is accept, (words, ended.stderr.decode())
    return ended.stdout


def schema(name: str) -> etree.XMLSchema:
    return etree.XMLSchema(etree.parse(SCHEMAS / f"{name}.xsd", etree.XMLParser(no_network=True)))


# ── what sros makes ────────────────────────────────────────────────────────────────────────


@pytest.fixture(scope="module", params=some(template_names(), 1))
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A keystore by each template, with enclaves of policies, without one, and exported ones."""
    folder = tmp_path_factory.mktemp(f"openssl-{request.param}")
    root = folder / "ks"
    sros("create_keystore", root, "--template", request.param, "--domain", "0,7,10-19").ok()
    sros(
        *("generate_artifacts", "-k", root, "-e", "/", "/plain", "/" + "n" * 63),
        *("-p", *sorted(policies_dir().glob("*.xml"))),
    ).ok()
    sros("distribute_key", root, "/plain", folder / "out").ok()
    return folder


def test_every_certificate_is_accepted_strictly(made: Path) -> None:
    public = made / "ks/public"
    identity = public / "identity_ca.cert.pem"
    for authority in public.glob("*.pem"):
        openssl("verify", "-x509_strict", "-CAfile", authority, authority)
    certificates = sorted(made.glob("ks/enclaves/**/cert.pem"))
    assert len(certificates) > 15
    openssl("verify", "-x509_strict", "-purpose", "any", "-CAfile", identity, *certificates)
    exported = made / "out/enclaves/plain"
    ca = exported / "identity_ca.cert.pem"
    openssl("verify", "-x509_strict", "-CAfile", ca, exported / "cert.pem")


def test_every_signed_document_is_accepted_and_valid(made: Path) -> None:
    permissions, governance = schema("dds_permissions"), schema("dds_governance")
    documents = [path for path in sorted(made.glob("**/*.p7s")) if not path.is_symlink()]
    assert len(documents) > 15
    permissions_of_enclaves = [path for path in documents if path.name == "permissions.p7s"]
    others = [path for path in documents if path.name != "permissions.p7s"]
    for path in [*others, *some(permissions_of_enclaves, 8)]:
        if path.name == "ledger.p7s":
            authorities = made / "authorities.pem"  # either CA may sign it
            found = made.glob("ks/public/*_ca.cert.pem")
            authorities.write_bytes(b"".join(each.read_bytes() for each in found))
            assert openssl("smime", "-verify", "-text", "-in", path, "-CAfile", authorities)
            continue
        beside = path.with_name("permissions_ca.cert.pem")
        authority = beside if beside.exists() else made / "ks/public/permissions_ca.cert.pem"
        content = openssl("smime", "-verify", "-text", "-in", path, "-CAfile", authority)
        checked = governance if path.name == "governance.p7s" else permissions
        checked.assertValid(etree.fromstring(content))
        readable = path.with_suffix(".xml")
        if "out" not in path.parts:
            assert content.replace(b"\r\n", b"\n") == readable.read_bytes()


def test_every_key_belongs_to_its_certificate(made: Path) -> None:
    of_enclaves = some(sorted(made.glob("ks/enclaves/**/key.pem")), 6)
    for key in [*of_enclaves, *made.glob("ks/private/*.pem")]:
        public = openssl("pkey", "-in", key, "-pubout")
        beside = key.with_name("cert.pem")
        name = key.name.replace(".key.", ".cert.")
        certificate = beside if beside.exists() else made / "ks/public" / name
        assert openssl("x509", "-in", certificate, "-pubkey", "-noout") == public


# ── what OpenSSL signs ─────────────────────────────────────────────────────────────────────


@pytest.fixture(scope="module")
def signers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with authorities, an enclave's certificate, and a document."""
    folder = tmp_path_factory.mktemp("signers")
    kinds = {"ca": ["ec", "-pkeyopt", "ec_paramgen_curve:P-256"], "rsa": ["rsa:2048"]}
    kinds["other"] = kinds["ca"]
    for name, kind in kinds.items():
        openssl(
            *("req", "-x509", "-newkey", *kind, "-nodes", "-days", "9", "-subj", f"/CN={name}"),
            *("-keyout", folder / f"{name}.key", "-out", folder / f"{name}.pem"),
        )
    openssl(
        *("req", "-new", "-newkey", *kinds["ca"], "-nodes", "-subj", "/CN=enclave"),
        *("-keyout", folder / "leaf.key", "-out", folder / "leaf.csr"),
    )
    openssl(
        *("x509", "-req", "-in", folder / "leaf.csr", "-CA", folder / "ca.pem"),
        *("-CAkey", folder / "ca.key", "-days", "9", "-out", folder / "leaf.pem"),
    )
    (folder / "document").write_text("<dds>\n  <permissions/>\r\n</dds>\n")
    return folder


def signed(folder: Path, *options: str, signer: str = "ca", command: str = "smime") -> bytes:
    return openssl(
        *(command, "-sign", "-in", folder / "document", *options),
        *("-signer", folder / f"{signer}.pem", "-inkey", folder / f"{signer}.key"),
    )


def our_verdict(message: bytes, authority: Path) -> bytes | None:
    """The document, if sros accepts the message."""
    try:
        parsed = smime.parse(message)
        parsed.verify(load_certificate(authority.read_bytes(), "the authority"))
    except SrosError:
        return None
    return parsed.document


def openssl_verdict(message: bytes, authority: Path, *options: object) -> bytes | None:
    """The document, if OpenSSL accepts the message as the vendors call it."""
    words = ("smime", "-verify", "-text", "-CAfile", authority, "-purpose", "any", *options)
    ended = subprocess.run(["openssl", *map(str, words)], input=message, capture_output=True)
    return ended.stdout if ended.returncode == 0 else None


ECDSA_WITH_SHA = bytes.fromhex("2a8648ce3d0403")


def algorithm(message: bytes, digest: bytes) -> bytes:
    """The message, whose SignerInfo names ECDSA with another digest: the last byte of an OID."""
    encoded = re.search(rb"(?<=\n\n)(?:[A-Za-z0-9+/=]+\r?\n){5,}", message)
    assert encoded
    before, oid, after = base64.b64decode(encoded[0]).rpartition(ECDSA_WITH_SHA)
    return message.replace(encoded[0], base64.encodebytes(before + oid + digest + after[1:]))


def ended_early(message: bytes) -> bytes:
    """The message, with the end boundary also in place of the one before the signature."""
    mark = re.search(rb"\n------[0-9A-F]+", message)
    assert mark
    before, content, signature, _ = message.split(mark[0])
    return mark[0].join((before, content, b"--" + signature, b"--\n"))


Make = Callable[[Path], bytes]

# How a message is made; whether OpenSSL accepts it, and whether sros does.
MESSAGES: dict[str, tuple[Make, bool, bool]] = {
    "as DDS wants it": (lambda f: signed(f, "-text"), True, True),
    "by cms": (lambda f: signed(f, "-text", command="cms"), True, True),
    "without attributes": (lambda f: signed(f, "-text", "-noattr"), True, True),
    "without capabilities": (lambda f: signed(f, "-text", "-nosmimecap"), True, True),
    "SHA-1": (lambda f: signed(f, "-text", "-md", "sha1"), True, True),
    "SHA-384": (lambda f: signed(f, "-text", "-md", "sha384"), True, True),
    "SHA-512": (lambda f: signed(f, "-text", "-md", "sha512"), True, True),
    "LF line ends": (lambda f: signed(f, "-text").replace(b"\r\n", b"\n"), True, True),
    "without text header": (lambda f: signed(f), False, False),
    "binary": (lambda f: signed(f, "-binary"), False, False),
    "another type": (
        lambda f: signed(f, "-text").replace(b"text/plain", b"text/other"),
        False,
        False,
    ),
    "by a stranger": (lambda f: signed(f, "-text", signer="other"), False, False),
    "changed content": (
        lambda f: signed(f, "-text").replace(b"<permissions/>", b"<permissions />"),
        False,
        False,
    ),
    "added line": (
        lambda f: signed(f, "-text").replace(b"</dds>", b"</dds>\n<dds/>"),
        False,
        False,
    ),
    "cut short": (lambda f: signed(f, "-text")[:-200], False, False),
    "garbage": (lambda f: b"MIME-Version: 1.0\n\n" + bytes(range(256)), False, False),
    "an OID that does not end": (lambda f: algorithm(signed(f, "-text"), b"\x82"), False, False),
    "two types": (
        lambda f: signed(f, "-text").replace(
            b"Content-Type:", b"Content-Type: text/x\nContent-Type:", 1
        ),
        False,
        False,
    ),
    "ended before the signature": (lambda f: ended_early(signed(f, "-text")), False, False),
    "without the signer": (lambda f: signed(f, "-text", "-nocerts"), False, False),
    "nothing": (lambda f: b"", False, False),
    # Stricter than OpenSSL, on purpose: the first is the hole of CVE-2023-24011.
    "by an enclave of the authority": (lambda f: signed(f, "-text", signer="leaf"), True, False),
    "another algorithm": (lambda f: algorithm(signed(f, "-text"), b"\x03"), True, True),
    "opaque": (lambda f: signed(f, "-text", "-nodetach"), True, True),
    "by key identifier": (lambda f: signed(f, "-text", "-keyid", command="cms"), False, False),
    "by two": (
        lambda f: signed(f, "-text", "-signer", str(f / "leaf.pem"), "-inkey", str(f / "leaf.key")),
        True,
        False,
    ),
}


@pytest.mark.parametrize("case", MESSAGES)
def test_verdicts(case: str, signers: Path) -> None:
    make, theirs, ours = MESSAGES[case]
    message = make(signers)
    document = openssl_verdict(message, signers / "ca.pem")
    assert (document is not None) is theirs
    found = our_verdict(message, signers / "ca.pem")
    assert (found is not None) is ours
    if found is not None and document is not None:
        assert found == document


@pytest.mark.parametrize("options", [(), ("-md", "sha384"), ("-noattr",)])
def test_an_authority_with_an_rsa_key(options: tuple[str, ...], signers: Path) -> None:
    message = signed(signers, "-text", *options, signer="rsa")
    assert our_verdict(message, signers / "rsa.pem") is not None
    assert our_verdict(message, signers / "ca.pem") is None
    broken = message.replace(b"<dds>", b"<DDS>")
    assert our_verdict(broken, signers / "rsa.pem") is None


def test_what_sros_accepts_openssl_accepts(signers: Path) -> None:
    """With bytes of the message changed at random, the same document comes out, or none."""
    authority = signers / "ca.pem"
    message = signed(signers, "-text")
    good = openssl_verdict(message, authority)
    moments = random.Random(7)
    accepted = 0
    for _ in range(400):
        changed = bytearray(message)
        for _ in range(moments.choice((1, 1, 2, 8))):
            place = moments.randrange(len(changed))
            how = moments.randrange(3)
            if how == 0:
                changed[place] = moments.choice(b"\r\n\0-=Aa ") if how else moments.randrange(256)
            elif how == 1:
                del changed[place : place + moments.randrange(1, 4)]
            else:
                changed[place:place] = moments.choice((b"\r\n", b"\n\n", b"-", b"A"))
        found = our_verdict(bytes(changed), authority)
        if found is not None:
            accepted += 1
            assert found == good
            assert openssl_verdict(bytes(changed), authority) == good, bytes(changed)
    assert accepted < 300
