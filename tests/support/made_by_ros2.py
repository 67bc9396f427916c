"""A keystore laid out as ros2/sros2 makes it: what it writes, with its modes, and nothing else.

One CA for both jobs, behind links; certificates of ten years with BasicConstraints
alone, so without key identifiers; documents signed with the clear text beside; files as open as the
umask lets them be; no settings and no ledger.
"""

from __future__ import annotations

import os
import subprocess
from dataclasses import dataclass
from datetime import datetime, timedelta
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import pkcs7
from cryptography.x509.oid import NameOID

XML = '<?xml version="1.0" encoding="UTF-8"?>\n'
SCHEMA = (
    'xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance" xsi:noNamespaceSchemaLocation='
    '"http://www.omg.org/spec/DDS-SECURITY/20170901/omg_shared_ca_{}.xsd"'
)
GOVERNANCE = """<dds {schema}>
  <domain_access_rules>
    <domain_rule>
      <domains><id>{domain}</id></domains>
      <allow_unauthenticated_participants>false</allow_unauthenticated_participants>
      <enable_join_access_control>true</enable_join_access_control>
      <discovery_protection_kind>ENCRYPT</discovery_protection_kind>
      <liveliness_protection_kind>ENCRYPT</liveliness_protection_kind>
      <rtps_protection_kind>SIGN</rtps_protection_kind>
      <topic_access_rules>
        <topic_rule>
          <topic_expression>*</topic_expression>
          <enable_discovery_protection>true</enable_discovery_protection>
          <enable_liveliness_protection>true</enable_liveliness_protection>
          <enable_read_access_control>true</enable_read_access_control>
          <enable_write_access_control>true</enable_write_access_control>
          <metadata_protection_kind>ENCRYPT</metadata_protection_kind>
          <data_protection_kind>ENCRYPT</data_protection_kind>
        </topic_rule>
      </topic_access_rules>
    </domain_rule>
  </domain_access_rules>
</dds>
"""
_PERMISSIONS = """<dds {schema}>
  <permissions>
    <grant name="{name}">
      <subject_name>CN={name}</subject_name>
      <validity>
        <not_before>{begin:%Y-%m-%dT%H:%M:%S}</not_before>
        <not_after>{end:%Y-%m-%dT%H:%M:%S}</not_after>
      </validity>
      <allow_rule>
        <domains><id>{domain}</id></domains>
        <publish><topics>{topics}</topics></publish>
        <subscribe><topics>{topics}</topics></subscribe>
      </allow_rule>
      <default>DENY</default>
    </grant>
  </permissions>
</dds>
"""
_OF_ROS = "".join(f"<topic>{each}</topic>" for each in ("rq/*Request", "rr/*Reply", "rt/*"))
_TOPICS = f"{_OF_ROS}<topic>ros_discovery_info</topic><topic>*</topic>"
VALIDITY = timedelta(days=3650)
"""How long its certificates are valid."""


@dataclass(frozen=True)
class Release:
    """What differs between the releases of ros2/sros2 since Foxy (its branches of these names).

    ``authority`` is the name of the CA.  With ``openssl`` documents are signed by that library, and
    not by cryptography's own PKCS#7.  ``discovery`` says whether the RMW that was installed had
    ``ros_discovery_info`` allowed, in a rule of its own.
    """

    authority: str = "sros2CA"
    openssl: bool = False
    discovery: bool | None = None


RELEASES = {
    "foxy": Release("sros2testCA", openssl=True, discovery=True),
    "foxy with Connext": Release("sros2testCA", openssl=True, discovery=False),
    "galactic to iron": Release(openssl=True, discovery=True),
    "jazzy and rolling": Release(discovery=True),
}
_DISCOVERY = """<allow_rule>
        <domains><id>{domain}</id></domains>
        <publish><topics><topic>ros_discovery_info</topic></topics></publish>
        <subscribe><topics><topic>ros_discovery_info</topic></topics></subscribe>
      </allow_rule>
      <default>DENY</default>"""


def make(
    root: Path, *names: str, now: datetime, domain: int = 0, release: Release | None = None
) -> None:
    """Make the keystore with some enclaves, as ``ros2 security`` would have at ``now``."""
    made = release or Release()
    signed = partial(sign, openssl=made.openssl)
    for part in ("public", "private", "enclaves"):
        (root / part).mkdir(parents=True)
    authority, key = issue(made.authority, now)
    write(root / "public/ca.cert.pem", authority, root / "private/ca.key.pem", key)
    for role in ("permissions", "identity"):
        os.symlink("ca.cert.pem", root / f"public/{role}_ca.cert.pem")
        os.symlink("ca.key.pem", root / f"private/{role}_ca.key.pem")
    text = XML + GOVERNANCE.format(schema=SCHEMA.format("governance"), domain=domain)
    signed(root / "enclaves/governance", text, authority, key)
    for name in names:
        folder = root / f"enclaves{name}"
        folder.mkdir(parents=True)
        for path in ("public/identity_ca.cert.pem", "public/permissions_ca.cert.pem"):
            os.symlink(os.path.relpath(root / path, folder), folder / Path(path).name)
        governance = root / "enclaves/governance.p7s"
        os.symlink(os.path.relpath(governance, folder), folder / "governance.p7s")
        certificate, own = issue(name, now, (authority, key))
        write(folder / "cert.pem", certificate, folder / "key.pem", own)
        text = XML + _PERMISSIONS.format(
            schema=SCHEMA.format("permissions"),
            name=name,
            begin=now - timedelta(days=1),
            end=now + VALIDITY,
            domain=domain,
            topics=_TOPICS if made.discovery is None else _OF_ROS,
        )
        if made.discovery:
            rule = _DISCOVERY.format(domain=domain)
            text = text.replace("<default>DENY</default>", rule)
        signed(folder / "permissions", text, authority, key)


def issue(
    name: str,
    now: datetime,
    issuer: tuple[x509.Certificate, ec.EllipticCurvePrivateKey] | None = None,
) -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey]:
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    constraints = x509.BasicConstraints(ca=issuer is None, path_length=None if issuer else 1)
    builder = x509.CertificateBuilder(
        issuer[0].subject if issuer else subject,
        subject,
        key.public_key(),
        x509.random_serial_number(),
        now - timedelta(days=1),
        now + VALIDITY,
    ).add_extension(constraints, critical=issuer is None)
    return builder.sign(issuer[1] if issuer else key, hashes.SHA256()), key


def write(
    place: Path, certificate: x509.Certificate, key_place: Path, key: ec.EllipticCurvePrivateKey
) -> None:
    place.write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
    key_place.write_bytes(
        key.private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.NoEncryption(),
        )
    )


def sign(
    stem: Path,
    text: str,
    authority: x509.Certificate,
    key: ec.EllipticCurvePrivateKey,
    *,
    openssl: bool = False,
) -> None:
    stem.with_suffix(".xml").write_text(text)
    if openssl:
        with TemporaryDirectory() as folder:
            write(Path(folder, "cert.pem"), authority, Path(folder, "key.pem"), key)
            plain, signed = (str(stem.absolute().with_suffix(end)) for end in (".xml", ".p7s"))
            words = ["smime", "-sign", "-text", "-in", plain, "-out", signed]
            words += ["-signer", "cert.pem", "-inkey", "key.pem"]
            subprocess.run(["openssl", *words], cwd=folder, check=True, capture_output=True)
        return
    builder = pkcs7.PKCS7SignatureBuilder().set_data(text.encode())
    message = builder.add_signer(authority, key, hashes.SHA256()).sign(
        serialization.Encoding.SMIME,
        [pkcs7.PKCS7Options.Text, pkcs7.PKCS7Options.DetachedSignature],
    )
    stem.with_suffix(".p7s").write_bytes(message)
