"""What differs between the releases of OpenSSL 3.0 that the tests meet."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.serialization import Encoding

from sros_tool.pki.certificates import Issuer, authority_identifier, common_name, issue_ca, pem
from sros_tool.pki.keys import generate_key
from sros_tool.validity import Window
from tests.support.children import run


@cache
def takes_changes_for_lists() -> bool:
    """Return whether this OpenSSL takes a list that has only changes (a delta CRL) for a whole one.

    Then a process starts, and all that the whole list revoked is valid.  sros says of such a list
    what the other releases do: that it is refused.  3.0.20 was seen to take it, 3.0.22 refuses it;
    so OpenSSL is asked, and not its number.
    """
    now, day = datetime.now(UTC), timedelta(days=1)
    key, window = generate_key(), Window(now - day, now + day)
    ca = issue_ca(key, common_name("CA"), window)
    leaf = Issuer(ca, key).issue(common_name("/a"), generate_key().public_key(), window)
    whole = (
        x509.CertificateRevocationListBuilder(ca.subject, window.not_before, window.not_after)
        .add_extension(authority_identifier(ca), critical=False)
        .add_extension(x509.CRLNumber(2), critical=False)
    )
    changes = whole.add_extension(x509.DeltaCRLIndicator(1), critical=True)
    statuses = []
    with TemporaryDirectory() as folder:
        for name, data in (("ca", pem(ca)), ("leaf", pem(leaf))):
            Path(folder, name).write_bytes(data)
        for crl in (whole, changes):
            signed = crl.sign(key, hashes.SHA256()).public_bytes(Encoding.PEM)
            Path(folder, "crl").write_bytes(signed)
            words = ("openssl", "verify", "-crl_check", "-CAfile", "ca", "-CRLfile", "crl", "leaf")
            statuses.append(run(words, cwd=Path(folder), status=None).returncode)
    assert statuses[0] == 0, "a whole list has to be taken"
    return statuses[1] == 0
