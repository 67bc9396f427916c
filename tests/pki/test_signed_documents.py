"""Which signed documents `SignedDocument.verify` takes."""

from __future__ import annotations

import pytest
from cryptography.hazmat.primitives.asymmetric import rsa

from sros_tool.errors import PkiError
from sros_tool.pki import smime
from tests.dds.signer_rows import authority, signed_by


def test_a_signature_with_md5_is_intact_and_refused() -> None:
    signer = authority("permissions CA", key=rsa.generate_private_key(65537, 2048))
    smime.parse(signed_by(signer, "-md", "sha256")(b"document")).verify(signer[0])
    with pytest.raises(PkiError, match="signed with MD5"):
        smime.parse(signed_by(signer, "-md", "md5")(b"document")).verify(signer[0])


def test_only_the_authority_itself_may_have_signed() -> None:
    """Another CA of its name may not, nor a certificate below it, whom vendors may accept."""
    signer = authority("permissions CA")
    others = (authority("permissions CA"), authority("leaf", None, by=signer, is_ca=False))
    smime.parse(signed_by(signer)(b"document")).verify(signer[0])
    for other in others:
        document = smime.parse(signed_by(other)(b"document"))
        document.verify(other[0])
        both = smime.parse(signed_by(signer, also=other)(b"document"))
        assert len(both.signatures) == 2
        for signed in (document, both):
            with pytest.raises(PkiError, match="it is signed by"):
                signed.verify(signer[0])


def test_what_was_changed_after_it_was_signed_is_refused() -> None:
    signer = authority("permissions CA")
    message = signed_by(signer)(b"document")
    assert message.count(b"document") == 1
    with pytest.raises(PkiError, match="its signature does not match its content"):
        smime.parse(message.replace(b"document", b"Document")).verify(signer[0])
