"""Of many forged documents, sros accepts none that OpenSSL rejects."""

from __future__ import annotations

from collections import Counter
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec, rsa
from cryptography.x509.name import _ASN1Type
from cryptography.x509.oid import NameOID

from sros_tool.pki.certificates import common_name, issue_ca, pem
from sros_tool.pki.keys import PrivateKey, key_pem
from sros_tool.validity import Window
from tests.integration.forged_signatures import Forger, Libcrypto, Original, Signer
from tests.integration.test_openssl import openssl_verdict, our_verdict
from tests.support.children import LONG, run

FORGERIES = 80_000 if LONG else 300
ASKED = 400 if LONG else 20
"""How many forgeries the openssl program judges as well."""

WAYS = (
    "smime -sign -text",
    "smime -sign -text -nodetach",
    "smime -sign -text -noattr",
    "smime -sign -text -md sha512",
    "smime -sign -text -md sha1",
    "smime -sign -text -nosmimecap",
    "cms -sign -text",
)
DOCUMENT = b"<dds>\n  <permissions>\n    <grant name='/a'/>\n  </permissions>\n</dds>\n"


def authority(name: x509.Name, key: PrivateKey, serial: int = 0) -> x509.Certificate:
    """A CA; with ``serial``, one that has little else than this serial number."""
    now = datetime.now(UTC)
    window = Window(now - timedelta(days=1), now + timedelta(days=9))
    if not serial:
        return issue_ca(key, name, window)
    return x509.CertificateBuilder(
        name, name, key.public_key(), serial, window.not_before, window.not_after
    ).sign(key, hashes.SHA256())


@pytest.fixture(scope="module")
def originals(tmp_path_factory: pytest.TempPathFactory) -> dict[Original, Path]:
    """Valid messages, with the file of the CA that signed each."""
    folder = tmp_path_factory.mktemp("originals")
    (folder / "document").write_bytes(DOCUMENT)
    found = {}
    other = ec.generate_private_key(ec.SECP256R1())
    for kind, key in (
        ("ec", ec.generate_private_key(ec.SECP256R1())),
        ("rsa", rsa.generate_private_key(65537, 2048)),
    ):
        name = f"CA {kind}"
        certificate = authority(common_name(name), key)
        file = folder / f"{kind}.pem"
        file.write_bytes(pem(certificate))
        (folder / f"{kind}.key").write_bytes(key_pem(key))
        printable = x509.NameAttribute(NameOID.COMMON_NAME, name, _ASN1Type.PrintableString)
        others = (
            authority(common_name(name), other),
            authority(common_name(name), other, certificate.serial_number),
            authority(common_name(name.lower()), other, certificate.serial_number),
            authority(x509.Name([printable]), other, certificate.serial_number),
            authority(common_name("another"), other, certificate.serial_number),
            certificate,
        )
        for way in WAYS:
            files = ("-signer", file, "-inkey", folder / f"{kind}.key", "-in", folder / "document")
            out = folder / "message"
            run(["openssl", *way.split(), *files, "-out", out])
            found[Original(out.read_bytes(), Signer(certificate, key), others)] = file
    return found


def test_no_forgery_is_accepted_that_openssl_rejects(
    originals: dict[Original, Path], tmp_path: Path
) -> None:
    try:
        libcrypto = Libcrypto(tmp_path)
    except OSError:
        pytest.skip("there is no libcrypto.so.3")
    for original, file in originals.items():
        assert our_verdict(original.message, file) == DOCUMENT.replace(b"\n", b"\r\n")
        assert libcrypto.verdict(original.message, file) == DOCUMENT.replace(b"\n", b"\r\n")
    forger, count, wrong = Forger(list(originals), seed=11), Counter[str](), []
    for number in range(FORGERIES):
        original, message, altered = forger.forge()
        file = originals[original]
        theirs = libcrypto.verdict(message, file)
        ours = our_verdict(message, file)
        if number % (FORGERIES // ASKED) == 0:
            assert openssl_verdict(message, file) == theirs, (altered, message)
            count["asked of openssl itself"] += 1
        if message == original.message:
            count["unaltered"] += 1
            continue
        count[f"sros {ours is not None}, OpenSSL {theirs is not None}"] += 1
        if ours is not None and ours != theirs:
            wrong.append((altered, message, ours, theirs))
    print(f"{FORGERIES} forgeries: {dict(count)}")
    assert not wrong, f"{len(wrong)} forgeries accepted by sros alone, the first: {wrong[0]}"
    # Twins: forgeries that both accept, and those that OpenSSL rejects.
    assert count["sros True, OpenSSL True"] > FORGERIES / 50
    assert count["sros False, OpenSSL False"] > FORGERIES / 5
