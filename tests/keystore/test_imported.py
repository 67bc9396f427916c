"""Keystores with imported CAs, and validities with dates."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography.x509.oid import ExtendedKeyUsageOID

from sros_tool.dds.decision.vendors import TESTED, Signers, Vendor, joined_titles
from sros_tool.errors import UsageError
from sros_tool.pki.certificates import pem
from sros_tool.pki.keys import key_pem
from sros_tool.validity import Lifespan, Span, Window, parse_span, span_text, window
from tests.dds.signer_rows import CERTIFIES, SIGNS, authority
from tests.support.children import run
from tests.support.harness import sros

CA = "basicConstraints=critical,CA:TRUE"
USAGE = "keyUsage=critical,keyCertSign,cRLSign,digitalSignature"
NOW = datetime(2026, 6, 1, 12, tzinfo=UTC)


def openssl(folder: Path, *words: str) -> None:
    run(["openssl", *words], cwd=folder)


@pytest.fixture(scope="module")
def pki(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A root CA, an intermediate CA, their chain, and CAs that only some vendors accept."""
    folder = tmp_path_factory.mktemp("pki")
    curve = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")
    root = ("-x509", "-days", "900", "-addext", CA, "-addext", USAGE)
    for name, kind, extra in (
        ("root", curve, ()),
        ("permissions", curve, ()),
        ("sha384", curve, ("-sha384",)),
        ("rsa3072", ("-newkey", "rsa:3072", "-nodes"), ()),
        ("rsa1024", ("-newkey", "rsa:1024", "-nodes"), ()),
        ("p192", (*curve[:3], "ec_paramgen_curve:prime192v1", "-nodes"), ()),
        ("p224", (*curve[:3], "ec_paramgen_curve:secp224r1", "-nodes"), ()),
        ("sha1", curve, ("-sha1",)),
        ("sha224", curve, ("-sha224",)),
    ):
        out = ("-keyout", f"{name}.key", "-out", f"{name}.pem", "-subj", f"/CN=corp {name}")
        openssl(folder, "req", *kind, *root, *extra, *out)
    out = ("-keyout", "leaf.key", "-out", "leaf.pem", "-subj", "/CN=leaf")
    openssl(folder, "req", "-x509", *curve, *out, "-addext", "basicConstraints=CA:FALSE")
    openssl(folder, "req", *curve, "-keyout", "sub.key", "-out", "sub.csr", "-subj", "/CN=sub")
    (folder / "ext").write_text(
        f"{CA}\n{USAGE}\nsubjectKeyIdentifier=hash\nauthorityKeyIdentifier=keyid\n"
    )
    issued = ("-CA", "root.pem", "-CAkey", "root.key", "-CAcreateserial", "-days", "500")
    openssl(folder, "x509", "-req", "-in", "sub.csr", *issued, "-extfile", "ext", "-out", "sub.pem")
    chain = (folder / "root.pem").read_bytes() + (folder / "sub.pem").read_bytes()
    (folder / "chain.pem").write_bytes(chain)
    return folder


def test_both_cas_can_be_imported(pki: Path, tmp_path: Path) -> None:
    root = tmp_path / "ks"
    made = sros(
        "create_keystore", root, "--template", "production",
        "--identity-ca", pki / "root.pem", "--identity-key", pki / "root.key",
        "--permissions-ca", pki / "permissions.pem", "--permissions-key", pki / "permissions.key",
    ).ok()  # fmt: skip
    assert "separate; certificates 365d" in made.out  # without a validity for the imported CAs
    assert made.out.count("    imported, valid until ") == 2
    assert not (root / "private").exists()
    sros("create_enclave", root, "/a").ok()
    folder = root / "enclaves/a"
    openssl(folder, "verify", "-x509_strict", "-CAfile", str(pki / "root.pem"), "cert.pem")
    verify = ("smime", "-verify", "-text", "-CAfile", str(pki / "permissions.pem"))
    openssl(folder, *verify, "-in", "permissions.p7s")
    assert sros("inspect", root).status == 0


def test_an_intermediate_ca_is_imported_with_its_chain(pki: Path, tmp_path: Path) -> None:
    root = tmp_path / "ks"
    made = sros(
        "create_keystore", root, "--identity-ca", pki / "chain.pem", "--identity-key",
        pki / "sub.key",
    ).ok()  # fmt: skip
    assert "portable.intermediate" in made.err
    assert "separate, a new one valid for 3650d; " in made.out
    assert made.out.count("    imported, valid until ") == 1
    sros("create_enclave", root, "/a").ok()
    openssl(
        tmp_path, "verify", "-x509_strict", "-CAfile", str(pki / "chain.pem"),
        str(root / "enclaves/a/cert.pem"),
    )  # fmt: skip
    assert sros("inspect", root / "enclaves/a").status == 0


@pytest.mark.parametrize(
    ("certificate", "key", "words"),
    [
        ("root.pem", None, "without its key"),
        ("root.pem", "sub.key", "does not fit its key"),
        ("sub.pem", "sub.key", "has no root"),
        ("leaf.pem", "leaf.key", "cannot be the identity CA"),
        ("root.key", "root.key", "cannot be read"),
        ("nothing.pem", "root.key", "does not exist"),
        ("root.pem", "nothing/x.key", "nothing"),
    ],
)
def test_a_ca_that_cannot_be_imported_changes_nothing(
    certificate: str, key: str | None, words: str, pki: Path, tmp_path: Path
) -> None:
    before = sorted(pki.iterdir())
    more = ["--identity-key", pki / key] if key else []
    ended = sros("create_keystore", tmp_path / "ks", "--identity-ca", pki / certificate, *more)
    assert ended.status == 2, ended
    assert words in ended.err
    assert list(tmp_path.iterdir()) == []
    assert sorted(pki.iterdir()) == before


@pytest.mark.parametrize("role", ["identity", "permissions"])
@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("rsa1024", "a weak key, RSA 1024"),
        ("p192", "a weak key, EC secp192r1"),
        ("p224", "a weak key, EC secp224r1"),
        ("sha1", "a weak signature, with SHA1"),
        ("sha224", "a weak signature, with SHA224"),
    ],
)
def test_a_weak_ca_is_refused(name: str, words: str, role: str, pki: Path, tmp_path: Path) -> None:
    place = (f"--{role}-ca", pki / f"{name}.pem", f"--{role}-key", pki / f"{name}.key")
    ended = sros("create_keystore", tmp_path / "ks", *place)
    assert ended.status == 2, ended
    assert words in ended.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "note"), [("sha384", "portable.signature-hash"), ("rsa3072", "portable.key-algorithm")]
)
def test_a_ca_that_some_vendors_refuse_gets_a_note(
    name: str, note: str, pki: Path, tmp_path: Path
) -> None:
    place = ("--identity-ca", pki / f"{name}.pem", "--identity-key", pki / f"{name}.key")
    assert note in sros("create_keystore", tmp_path / "ks", *place).ok().err
    plain = ("--identity-ca", pki / "root.pem", "--identity-key", pki / "root.key")
    said = sros("create_keystore", tmp_path / "plain", *plain).ok().err
    assert said.count("note [") == said.count("note [keystore.own-list]") == 1


LATER = {vendor for vendor in TESTED if vendor.traits.signers is Signers.LISTED}
"""The vendors that do not ask what the permissions CA may sign."""


@pytest.mark.parametrize(
    ("made", "words", "takes"),
    [
        ("only certifies", "lacks digitalSignature", LATER),
        ("for serverAuth", "lacks emailProtection", LATER),
        ("may sign", "", {*TESTED}),
    ],
)
def test_vendors_that_refuse_a_permissions_ca_are_named(
    made: str, words: str, takes: set[Vendor], tmp_path: Path
) -> None:
    certificate, key = authority(
        "corp CA",
        CERTIFIES if made == "only certifies" else f"{SIGNS} {CERTIFIES}",
        purpose=ExtendedKeyUsageOID.SERVER_AUTH if "serverAuth" in made else None,
    )
    (tmp_path / "ca.pem").write_bytes(pem(certificate))
    (tmp_path / "ca.key").write_bytes(key_pem(key))
    place = ("--permissions-ca", tmp_path / "ca.pem", "--permissions-key", tmp_path / "ca.key")
    root = tmp_path / "ks"
    ended = sros("create_keystore", root, *place)
    assert words in ended.err
    assert ended.status == (0 if takes else 2), ended
    assert root.exists() == bool(takes)
    if not takes:
        return
    assert ("portable.ca-purpose" in ended.err) == bool(words)
    assert {vendor for vendor in TESTED if vendor.title in ended.err} == {*TESTED} - takes
    sros("create_enclave", root, "/a").ok()
    for vendor in TESTED:
        asked = sros("explain", root, "/a", "join", "--vendor", vendor)
        assert asked.status == (0 if vendor in takes else 1), asked
        checked = sros("check", root, "--vendor", vendor, "--include", "portable.ca-purpose")
        assert checked.status == (0 if vendor in takes else 1), checked


ALL = {*TESTED}
STRICT = {vendor for vendor in TESTED if vendor.traits.verifies_authorities}
"""The vendors that verify a CA file when they load it."""
(STRICT_TITLE,) = joined_titles(vendor.title for vendor in TESTED if vendor in STRICT)


@pytest.mark.parametrize(
    ("role", "usage", "takes", "words"),
    [
        ("identity", f"{SIGNS} {CERTIFIES}", ALL - STRICT, f"{STRICT_TITLE} refuses the encl"),
        ("identity", None, set(), "no DDS vendor would accept an enclave"),
        ("identity", SIGNS, set(), "does not allow it to issue certificates"),
        ("permissions", f"{SIGNS} {CERTIFIES}", ALL - STRICT, f"{STRICT_TITLE} refuses the e"),
        ("permissions", None, ALL, ""),
        ("permissions", SIGNS, set(), "does not allow it to issue certificates"),
    ],
)
def test_a_ca_without_basic_constraints_is_taken_where_vendors_take_it(
    role: str, usage: str | None, takes: set[Vendor], words: str, tmp_path: Path
) -> None:
    """The vendors' own answers are in `tests.integration.test_signers_on_dds`."""
    certificate, key = authority("corp CA", usage, is_ca=None)
    (tmp_path / "ca.pem").write_bytes(pem(certificate))
    (tmp_path / "ca.key").write_bytes(key_pem(key))
    place = (f"--{role}-ca", tmp_path / "ca.pem", f"--{role}-key", tmp_path / "ca.key")
    root = tmp_path / "ks"
    ended = sros("create_keystore", root, *place)
    assert ended.status == (0 if takes else 2), ended
    assert words in ended.err
    assert root.exists() == bool(takes)
    if not takes:
        return
    assert ("portable.imported-ca" in ended.err) == (takes != ALL)
    sros("create_enclave", root, "/a").ok()
    for vendor in ALL:
        asked = sros("explain", root, "/a", "join", "--vendor", vendor)
        assert asked.status == (0 if vendor in takes else 1), asked


@pytest.mark.parametrize(
    ("text", "span", "begin", "end"),
    [
        ("90d", timedelta(days=90), NOW - timedelta(days=1), NOW + timedelta(days=90)),
        ("72h", timedelta(hours=72), NOW - timedelta(days=1), NOW + timedelta(days=3)),
        (
            "2026-07-01",
            Lifespan(end=datetime(2026, 7, 1, tzinfo=UTC)),
            NOW - timedelta(days=1),
            datetime(2026, 7, 1, tzinfo=UTC),
        ),
        (
            "2026-05-01/90d",
            Lifespan(start=datetime(2026, 5, 1, tzinfo=UTC), length=timedelta(days=90)),
            datetime(2026, 5, 1, tzinfo=UTC),
            datetime(2026, 7, 30, tzinfo=UTC),
        ),
        (
            "2026-07-01T06:00:00+02:00/2026-08-01",
            Lifespan(
                start=datetime(2026, 7, 1, 4, tzinfo=UTC), end=datetime(2026, 8, 1, tzinfo=UTC)
            ),
            datetime(2026, 7, 1, 4, tzinfo=UTC),
            datetime(2026, 8, 1, tzinfo=UTC),
        ),
    ],
)
def test_validities_are_parsed(text: str, span: Span, begin: datetime, end: datetime) -> None:
    assert parse_span(text) == span
    assert parse_span(span_text(span)) == span
    assert window(NOW, span) == Window(begin, end)


@pytest.mark.parametrize("text", ["", "x", "90", "0d", "2026-13-01", "/90d", "90d/90d", "a/b/c"])
def test_an_invalid_validity_is_refused(text: str) -> None:
    with pytest.raises(UsageError):
        parse_span(text)


def test_a_validity_in_the_past_creates_no_keystore(tmp_path: Path) -> None:
    ended = sros("create_keystore", tmp_path / "ks", "--validity", "2020-01-01")
    assert ended.status == 2
    assert "expired already, at 2020-01-01" in ended.err
    assert list(tmp_path.iterdir()) == []
