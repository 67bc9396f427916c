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
