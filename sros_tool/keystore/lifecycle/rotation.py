"""The state of a CA rotation: its stage, the replaced CAs, and how many enclaves each CA has.

This module only reads; `sros_tool.keystore.lifecycle.rotate` makes the changes.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from pathlib import Path
from typing import Annotated

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec

from sros_tool.errors import KeystoreError, SrosError
from sros_tool.keystore.expiry import ONE_BY_ONE
from sros_tool.keystore.fleet import deliver_first_sentence
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    IDENTITY,
    PERMISSIONS,
    PERMISSIONS_FILE,
    RETIRED,
    ROLES,
    ROTATION,
)
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.pki.certificates import digest, issued_by, subject_text, validity_of
from sros_tool.validity import AUTHORITY_SOON, Window, iso
from sros_tool.values import Words, as_plain, parse_json, shows


class RotationStage(StrEnum):
    """The stages of a rotation, in order; NONE is the stage of a keystore without a rotation."""

    NONE = "none"
    DISTRIBUTE = "distribute"
    """Both CAs are trusted; the old CA issues."""
    REISSUE = "reissue"
    """Both CAs are trusted; the new CA issues, and has already issued everything again."""
    RETIRE = "retire"
    """The old CA is no longer trusted; the rotation is complete."""


@dataclass(frozen=True, slots=True)
class Replacement:
    """An old CA, and the new CA that replaces it.

    ``file`` is the name of the CA file without suffixes ("identity_ca", "permissions_ca", or "ca"
    for both roles).  ``old`` and ``new`` are the SHA-256 fingerprints of the certificates.  ``key``
    is the place of the new key: a URI, or a path in the keystore.  ``old_key`` is the place of the
    old key, or "" if it is in `RETIRED`.
    """

    file: str
    old: str
    new: str
    key: str
    old_key: str = ""

    def old_key_place(self, certificate: x509.Certificate) -> str:
        """Return where the key of the old CA (with ``certificate``) is from REISSUE on."""
        return self.old_key or retired_key_path(certificate)


@dataclass(frozen=True, slots=True)
class Rotation:
    """A rotation: the stage of the keystore, and the CAs that are replaced."""

    stage: RotationStage = RotationStage.NONE
    replacements: tuple[Replacement, ...] = ()

    def next_stage(self) -> RotationStage:
        """Return the stage after the current one."""
        order = list(RotationStage)
        return order[order.index(self.stage) + 1]


@shows(
    *("roles", "state", "subject", "serial", "sha256", "validity", "enclaves"), spread=("validity",)
)
@dataclass(frozen=True, slots=True)
class AuthorityStatus:
    """A trusted CA, and its state in the rotation."""

    file: str
    roles: tuple[Annotated[str, Words(ROLES)], ...]
    """Roles of the CA."""
    state: Annotated[str, Words(("issuing", "next", "old"))]
    """Whether the CA issues now (``issuing``), will issue in the next stage, or issued before
    (``old``).
    """
    subject: str
    """Subject of the CA."""
    serial: str
    """Serial number of the CA's certificate, in hexadecimal."""
    sha256: str
    """SHA-256 of the CA's certificate (DER), in hexadecimal; two CAs can have the same subject."""
    validity: Window
    enclaves: int
    """Number of enclaves whose certificate or permissions this CA signed."""


@dataclass(frozen=True, slots=True)
class RotationStatus:
    """The rotation of a keystore, its CAs, the number of its enclaves, and the next steps."""

    root: Path
    rotation: Rotation
    authorities: tuple[AuthorityStatus, ...]
    enclaves: int
    remarks: tuple[str, ...]


def retired_key_path(certificate: x509.Certificate) -> str:
    """Return the path in the keystore for the key of a replaced CA."""
    return f"{RETIRED}/{certificate.serial_number:x}.key.pem"


def read_rotation(keystore: OpenedKeystore) -> Rotation:
    """Return the rotation in progress; an empty `Rotation` if there is none.

    Raises:
        KeystoreError: the rotation file is damaged, or contradicts the CA certificates.
    """
    path = keystore.root / ROTATION
    if not path.exists():
        return Rotation()
    try:
        read = parse_json(keystore.read(path, "file of the rotation"))
        replacements = tuple(_replacement_from(replacement) for replacement in read["replacements"])
        rotation = Rotation(RotationStage(read["stage"]), replacements)
        for replacement in replacements:
            issuing = (
                replacement.old if rotation.stage is RotationStage.DISTRIBUTE else replacement.new
            )
            digests = [*map(digest, keystore.certificates_of(replacement.file))]
            if digests[0] != issuing or not {replacement.old, replacement.new} <= set(digests):
                raise ValueError
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise KeystoreError(
            f"the rotation of keystore '{keystore.root}' cannot be continued",
            f"'{path}' does not fit the CA certificates, or is damaged.",
            "Restore the folders 'public' and 'private' and this file from one backup.",
        ) from error
    return rotation


def _replacement_from(values: dict[str, str]) -> Replacement:
    """Return the replacement that a JSON object describes.

    Raises:
        ValueError, TypeError: ``values`` does not describe a replacement.
    """
    if not all(isinstance(value, str) for value in values.values()) or "/" in values.get(
        "file", ""
    ):
        raise ValueError
    return Replacement(**values)


def render_rotation(rotation: Rotation) -> bytes:
    """Return the content of the rotation file: JSON for `read_rotation`."""
    content = {
        "stage": rotation.stage.value,
        "replacements": as_plain(rotation.replacements),
    }
    return json.dumps(content, indent=2).encode() + b"\n"


def rotation_status(keystore: OpenedKeystore, *, now: datetime) -> RotationStatus:
    """Return the stage of a keystore, its trusted CAs with their validity, and remarks."""
    keystore.check()
    names = keystore.names
    rotation = read_rotation(keystore)
    by_file = {replacement.file: replacement for replacement in rotation.replacements}
    states = []
    for file, roles in keystore.authority_files.items():
        certificates = keystore.certificates_of(file)
        counts = _count_enclaves(keystore, roles[0], certificates)
        for index, certificate in enumerate(certificates):
            replaced = by_file.get(file)
            state = "issuing" if index == 0 else "old"
            if replaced and index and digest(certificate) == replaced.new:
                state = "next"
            states.append(
                AuthorityStatus(
                    file,
                    roles,
                    state,
                    subject_text(certificate.subject),
                    f"{certificate.serial_number:x}",
                    digest(certificate),
                    validity_of(certificate),
                    counts[index],
                )
            )
    remarks = (
        _expiry_remarks(states, now)
        if rotation.stage is RotationStage.NONE
        else _restart_remarks(keystore, rotation)
    )
    return RotationStatus(keystore.root, rotation, tuple(states), len(names), tuple(remarks))


def _count_enclaves(
    keystore: OpenedKeystore, role: str, authorities: tuple[x509.Certificate, ...]
) -> Counter[int]:
    """Return the number of enclaves of each CA, by the CA's index in ``authorities``.

    An enclave belongs to the identity CA that issued its certificate, and to the permissions CA
    that signed its permissions.  A folder without a certificate belongs to no CA: it waits for a
    certificate, or is left from an interrupted removal.
    """
    counts: Counter[int] = Counter()
    for name in keystore.names:
        folder = keystore.folder(name)
        if not (folder / CERTIFICATE_FILE).exists():
            continue
        try:
            if role == IDENTITY:
                own_certificate = keystore.certificate_of(name)
                fits = [issued_by(own_certificate, authority) for authority in authorities]
            else:
                message = keystore.read(folder / PERMISSIONS_FILE, "permissions")
                signer = keystore.files.signed_document(message).signer()
                fits = [signer == authority for authority in authorities]
        except SrosError:  # `sros inspect` reports the error
            continue
        if True in fits:
            counts[fits.index(True)] += 1
    return counts


# ── remarks ────────────────────────────────────────────────────────────────────────────────


def _expiry_remarks(authority_states: Sequence[AuthorityStatus], now: datetime) -> list[str]:
    """Return remarks on CAs that expire soon, or have expired."""
    remarks = []
    for state in authority_states:
        expires_soon = state.validity.expires_soon_from(AUTHORITY_SOON) < now
        if state.state != "issuing" or not expires_soon:
            continue
        name = "CA" if len(state.roles) > 1 else f"{state.roles[0]} CA"
        end = iso(state.validity.not_after)
        if state.validity.not_after < now:
            remarks.append(
                f"The {name} expired at {end}, and processes no longer start: replace it now with "
                "--finish."
            )
        elif state.roles == (IDENTITY,):
            remarks.append(
                f"The {name} expires at {end}: extend it with --same-key, which interrupts no "
                "process; or begin to replace it with --next."
            )
        else:
            remarks.append(
                f"The {name} expires at {end}: begin to replace it with --next. With Fast DDS, "
                "robots keep running; with Cyclone DDS, plan to restart all processes together."
            )
    return remarks


def _restart_remarks(keystore: OpenedKeystore, rotation: Rotation) -> list[str]:
    """Return remarks, by vendor, on which processes to restart at DISTRIBUTE or REISSUE."""
    files = [replacement.file for replacement in rotation.replacements]
    if rotation.stage is RotationStage.DISTRIBUTE:
        return [
            deliver_first_sentence(keystore.root),
            f"All vendors: {ONE_BY_ONE} Continue when all have been restarted.",
        ]
    hindrance = _fast_dds_hindrance(keystore, files)
    remarks = [
        deliver_first_sentence(keystore.root),
        f"Fast DDS: {hindrance} Restart all processes together."
        if hindrance
        else f"Fast DDS: {ONE_BY_ONE} Continue when all have been restarted.",
        "Cyclone DDS: it trusts one CA at a time, so restart all processes together; restarted "
        "processes do not communicate with processes that were not restarted.",
    ]
    with suppress(SrosError):  # `check` reports settings that cannot be read
        if keystore.template.zenoh:
            remarks.append(f"Zenoh: {ONE_BY_ONE} Continue when all have been restarted.")
    if any(file != "permissions_ca" for file in files):
        remarks.append(
            "At this stage, both CAs sign revocation lists, if the key of the old CA is available."
        )
    return remarks


def are_crls_confusable(old: x509.Certificate, new: x509.Certificate) -> bool:
    """Return whether OpenSSL may mistake the revocation list of one CA for the list of the other.

    OpenSSL finds a list by name and key identifier.  If both CAs have the same name and the old CA
    has no key identifier, Fast DDS 2.9.1 uses the wrong list, and no process starts (tested).
    """
    return old.subject == new.subject and not _has_identifier(old)


def _has_identifier(certificate: x509.Certificate) -> bool:
    try:
        certificate.extensions.get_extension_for_class(x509.SubjectKeyIdentifier)
    except x509.ExtensionNotFound:
        return False
    return True


def _fast_dds_hindrance(keystore: OpenedKeystore, files: Sequence[str]) -> str:
    """Return why Fast DDS cannot trust both the old and the new CA, as a sentence; "" if it can.

    Fast DDS 2.9.1 (tested) distinguishes two CAs of the same name by their key identifiers, and
    refuses a peer whose permissions CA has another name or key algorithm.
    """
    for file in files:
        if file == "identity_ca":
            continue
        for certificate in keystore.certificates_of(file):
            if not isinstance(certificate.public_key(), ec.EllipticCurvePublicKey):
                return "the old permissions CA has another key algorithm than the new CA."
            if not _has_identifier(certificate):
                return (
                    f"the old {'CA' if file == 'ca' else f'{PERMISSIONS} CA'} has no key "
                    "identifier (ros2/sros2 created it), so it cannot be distinguished from the "
                    "new CA."
                )
    return ""
