"""Which signed documents `SignedDocument.verify` takes."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import pytest
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec, rsa
from cryptography.hazmat.primitives.serialization import Encoding, pkcs7

from sros_tool.errors import PkiError
from sros_tool.pki import der, smime
from sros_tool.pki.certificates import common_name, issue_ca
from sros_tool.pki.keys import PrivateKey
from sros_tool.validity import window
from tests.dds.signer_rows import authority, signed_by


def test_a_signature_with_md5_is_intact_and_refused() -> None:
    signer = authority("permissions CA", key=rsa.generate_private_key(65537, 2048))
    smime.parse(signed_by(signer, "-md", "sha256")(b"document")).verify(signer[0])
    with pytest.raises(PkiError, match="signed with MD5"):
        smime.parse(signed_by(signer, "-md", "md5")(b"document")).verify(signer[0])


SIGNING_TIME = der.encode(der.OID, der.encode_oid("1.2.840.113549.1.9.5"))


def parts(data: bytes) -> list[object]:
    """Return the values in DER without their lengths."""
    return [
        (each.tag, parts(each.content) if each.tag & 0x20 else each.content)
        for each in der.children(data)
    ]


@pytest.mark.parametrize(
    "key",
    [
        rsa.generate_private_key(65537, 2048),
        ec.generate_private_key(ec.SECP256R1()),
        ec.generate_private_key(ec.SECP384R1()),
    ],
    ids=["RSA", "P-256", "P-384"],
)
def test_signatures_are_as_cryptography_makes_them(
    key: PrivateKey, monkeypatch: pytest.MonkeyPatch
) -> None:
    validity = window(datetime(2026, 1, 1, tzinfo=UTC), timedelta(days=365))
    certificate = issue_ca(key, common_name("a CA"), validity)
    content = b"Content-Type: text/plain\r\n\r\n<dds/>\r\n"
    builder = pkcs7.PKCS7SignatureBuilder().set_data(content)
    options = (pkcs7.PKCS7Options.DetachedSignature, pkcs7.PKCS7Options.Binary)
    made = builder.add_signer(certificate, key, hashes.SHA256()).sign(Encoding.DER, options)
    moment = der.first(der.first(made.partition(SIGNING_TIME)[2]).content).whole
    monkeypatch.setattr(smime, "_encoded_time", lambda _: moment)
    own = smime._signed_data(content, certificate, key)
    if isinstance(key, rsa.RSAPrivateKey):
        assert own == made
    else:  # an ECDSA signature is another one each time; it is the last value
        before, _, _ = repr(parts(made)).rpartition("b'")
        assert repr(parts(own)).startswith(before.rpartition("(4, ")[0])
    document = smime.sign(b"<dds/>\n", certificate, key)
    smime.parse(document).verify(certificate)
    assert smime.parse(document).text == b"<dds/>\n"


@pytest.mark.parametrize(("year", "encoded"), [(2049, b"491231"), (2050, b"20501231")])
def test_the_signing_time_has_the_form_of_its_year(year: int, encoded: bytes) -> None:
    moment = datetime(year, 12, 31, 23, 59, 58, tzinfo=UTC).timetuple()
    assert der.first(smime._encoded_time(moment)).content == encoded + b"235958Z"
