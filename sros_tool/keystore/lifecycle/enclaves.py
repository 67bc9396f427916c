"""Creating and completing enclaves, and replacing their permissions, within a change."""

from __future__ import annotations

import hashlib
from collections import ChainMap
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from shlex import quote
from types import MappingProxyType

from cryptography import x509

from sros_tool.dds.permissions import name_notes, parse_permissions
from sros_tool.errors import KeystoreError, Note, SrosError
from sros_tool.keystore.fleet import EnclaveDomains
from sros_tool.keystore.issuing.enclave import (
    EnclaveWriter,
    Issuance,
    NewIdentity,
    StatedRights,
    default_rights,
    link_shared_files,
    present_files,
)
from sros_tool.keystore.issuing.tokens import EnclaveTokens, place_in, token_notes
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    KEY_FILE,
    KEY_FILES,
    PERMISSIONS_FILE,
    REQUEST,
    enclave_path,
)
from sros_tool.keystore.lifecycle.change import KeystoreChange
from sros_tool.keystore.lifecycle.replaced import (
    ReplacedRights,
    Superseded,
    earlier_permissions,
    replaced_rights,
    with_ledger,
)
from sros_tool.keystore.template import NODE_BASICS, Template
from sros_tool.parallel import Progress
from sros_tool.pki import smime
from sros_tool.pki.certificates import (
    common_name_of,
    enclave_subject,
    issued_by,
    other_issuer,
    parse_subject,
    validity_of,
)
from sros_tool.pki.keys import generate_key, load_key
from sros_tool.pki.token import TokenKey, TokenUri, open_enclave_key
from sros_tool.policy.model import Enclave
from sros_tool.validity import Window, iso, parse_iso
from sros_tool.xml import read_bytes

_OF_KEY = {*KEY_FILES, REQUEST}


def write_enclaves(
    change: KeystoreChange,
    wanted: Mapping[str, Enclave | None],
    *,
    revoke_old: bool = False,
    keep_same: bool = False,
    places: Mapping[str, TokenUri] = MappingProxyType({}),
    progress: Progress | None = None,
) -> tuple[ReplacedRights, ...]:
    """Create or complete enclaves, sign the permissions of their policies, and commit the change.

    In a keystore with a Zenoh network, the enclaves of its routers are created, too.

    Args:
        change: the change of the keystore.
        wanted: maps enclaves to their policies, or None.
        revoke_old: also replace and revoke the certificates of enclaves that get other permissions.
        keep_same: keep permissions that already state the rights of a policy.
        places: maps enclaves to the places of new keys on tokens; other new keys are in files.
        progress: called with the name of each enclave that is done.

    Returns:
        The rights that enclaves gain and lose with their new permissions.
    """
    network = change.template.zenoh
    if routers := set(network.router_names() if network else ()).difference(change.names):
        wanted = ChainMap(dict.fromkeys(sorted(routers)), wanted)  # type: ignore[arg-type]
    writer = change.writer(keys_on_token=bool(places), revoke_old=revoke_old)
    maker = _EnclaveMaker(change, writer, places, revoke_old=revoke_old, keep_same=keep_same)
    done = writer.for_each(list(wanted), lambda name: maker.make(name, wanted[name]), progress)
    created = tuple(name for name, made in done.items() if made.outcome == "created")
    change.outcomes = {
        name: outcome
        for outcome in ("created", "changed", "completed", "kept")
        for name, made in done.items()
        if made.outcome == outcome
    }
    change.entries += writer.entries
    change.notes = [
        *(note for made in done.values() for note in made.notes),
        *(writer.notes if writer.entries else ()),
        *name_notes({*change.names, *created}, created),
        *change.notes,
    ]
    superseded = [made.superseded for made in done.values() if made.superseded]
    change.revoke(superseded)
    change.keep_zenoh(
        writer.signed, replaced=[old.name for old in superseded], stated=wanted, created=created
    )
    change.record()
    replaced = [made.replaced for made in done.values() if made.replaced]
    if not revoke_old:
        replaced = [*with_ledger(change.keystore, replaced, change.now)]
    change.finish(aim="replace the permissions" if superseded else "")
    return tuple(replaced)


@dataclass(frozen=True, slots=True)
class _Made:
    """The outcome for an enclave; ``superseded`` is its old certificate, if it gets revoked."""

    outcome: str
    notes: tuple[Note, ...]
    replaced: ReplacedRights | None = None
    superseded: Superseded | None = None


class _EnclaveMaker:
    """Maker of enclaves, one at a time, within a change."""

    def __init__(
        self,
        change: KeystoreChange,
        writer: EnclaveWriter,
        places: Mapping[str, TokenUri],
        *,
        revoke_old: bool,
        keep_same: bool,
    ) -> None:
        self._change = change
        self._root = change.root
        self._writer = writer
        self._tokens: EnclaveTokens = change.tokens(places)
        self._domains = EnclaveDomains(change.domains, change.fleet)
        self._revoke_old = revoke_old
        self._keep_same = keep_same

    def make(self, name: str, policy: Enclave | None) -> _Made:
        """Stage the missing files of an enclave, and permissions for ``policy`` if not None."""
        change, root = self._change, self._root
        present = present_files(root, name)
        before = len(change.transaction.changes)
        identity = self._identity(name, present, replaced=bool(policy))
        earlier, old = None, None
        certificate = identity if isinstance(identity, x509.Certificate) else None
        rights = None
        if policy or PERMISSIONS_FILE not in present:
            enclave = policy or _default_rights(change.template, name)
            rights = StatedRights(enclave, self._domains.of(name))
        if rights and certificate and PERMISSIONS_FILE in present and not self._revoke_old:
            rights = None if self._is_kept(certificate, rights) else rights
        if rights and PERMISSIONS_FILE in present:
            earlier = earlier_permissions(
                change.keystore, name, change.permissions.certificate, certificate
            )
            if self._revoke_old and certificate:
                old = certificate
                public = change.unrevoked_key(name, old)
                identity = NewIdentity(enclave_subject(name, unique=True), public)
        issued = self._writer.write(Issuance(name, identity, rights))
        link_shared_files(change.transaction, name, present)
        notes = tuple(issued.notes())
        if isinstance(identity, NewIdentity) and isinstance(identity.new_key, TokenKey):
            notes += tuple(token_notes(identity.new_key))
        if not present & _OF_KEY:
            return _Made("created", notes)
        if PERMISSIONS_FILE in present and rights:
            (grant,) = issued.permissions.grants
            replaced = replaced_rights(name, earlier, grant, change.now) if earlier else None
            if old is None:
                return _Made("changed", notes, replaced)
            superseded = Superseded.by(name, old, issued.certificate, change.now)
            return _Made("changed", notes, replaced and replaced.revoked(), superseded)
        completed = len(change.transaction.changes) > before
        return _Made("completed" if completed else "kept", notes)

    def _is_kept(self, certificate: x509.Certificate, rights: StatedRights) -> bool:
        """Return whether an enclave's permissions can stay, because they already state ``rights``.

        Raises:
            KeystoreError: the key of the enclave was revoked, so DDS would not accept the
                permissions.
        """
        if not self._keep_same:
            return False
        change, name = self._change, rights.enclave.path
        change.unrevoked_key(name, certificate)
        folder = enclave_path(self._root, name)
        signed_path, xml = folder / PERMISSIONS_FILE, folder / "permissions.xml"
        if signed_path.is_symlink() or xml.is_symlink():  # to what others may change
            return False
        try:
            message = change.keystore.read(signed_path, "permissions document")
            entry = change.recorded.latest(name, hashlib.sha256(message).hexdigest())
            if entry is None:
                return False
            signed = change.keystore.files.signed(message)
            signed.verify(change.permissions.certificate)
            validity = Window(parse_iso(entry.not_before), parse_iso(entry.not_after))
        except (SrosError, ValueError):  # not what `write` would leave
            return False
        text = signed.text
        return self._writer.would_only_date(rights, certificate, validity, text) and _is_file(
            xml, text
        )

    def _identity(
        self, name: str, present: set[str], *, replaced: bool
    ) -> NewIdentity | x509.Certificate:
        """Return the certificate of an enclave, or the subject and key for a new certificate.

        If the enclave has signed permissions, the new certificate gets their subject, unless they
        are ``replaced`` in this step.

        Raises:
            KeystoreError: the certificate cannot be used, or the present permissions are not the
                latest.
        """
        change, root = self._change, self._root
        folder = enclave_path(root, name)
        if name in self._tokens.places and not present.isdisjoint(_OF_KEY):
            self._tokens.check_present(name, root)
        if CERTIFICATE_FILE in present:
            if not present & _OF_KEY:
                raise KeystoreError(
                    f"enclave {name} has a certificate but no key",
                    f"Its {KEY_FILE} is missing, and the certificate does not work with a new key.",
                    f"Restore the key, or remove '{folder / CERTIFICATE_FILE}' to create both "
                    "again.",
                )
            return self._usable_certificate(name)
        subject = enclave_subject(name, unique=change.template.unique_subject)
        if PERMISSIONS_FILE in present and not replaced:
            subject = self._subject_of_permissions(name, subject)
        if present.isdisjoint(KEY_FILES):
            new_key = self._tokens.key(name) if name in self._tokens.places else generate_key()
            return NewIdentity(subject, new_key.public_key(), new_key)
        path = folder / next(file for file in KEY_FILES if file in present)
        public = (
            load_key(read_bytes(path, "private key"), f"'{path}'")
            if path.name == KEY_FILE
            else open_enclave_key(place_in(path), self._tokens.secrets)
        ).public_key()
        remedy = f"Move '{path}' away: then a new key is created."
        change.known.refuse_revoked(public, f"enclave {name}", remedy)
        change.known.refuse_second(public, name, remedy)
        return NewIdentity(subject, public)

    def _subject_of_permissions(self, name: str, own: x509.Name) -> x509.Name:
        """Return the subject in an enclave's signed permissions, or else ``own``."""
        path = enclave_path(self._root, name) / PERMISSIONS_FILE
        for subject in _permissions_subjects(path, self._change.permissions.certificate):
            if common_name_of(subject) == common_name_of(own):
                message = self._change.keystore.read(path, "permissions document")
                self._change.recorded.policy(name, hashlib.sha256(message).hexdigest())
                return subject
        return own

    def _usable_certificate(self, name: str) -> x509.Certificate:
        """Return the certificate of an enclave, after checking its issuer and validity.

        Raises:
            KeystoreError: DDS would refuse the certificate.
        """
        path = enclave_path(self._root, name) / CERTIFICATE_FILE
        certificate = self._change.keystore.certificate(path)
        authority = self._change.identity.certificate
        if not issued_by(certificate, authority):
            raise KeystoreError(
                f"the certificate of enclave {name} was not issued by the identity CA of this "
                "keystore",
                f"The issuer of '{path}' is {other_issuer(certificate, authority)}; other nodes of "
                "this keystore would refuse the enclave.",
                "Restore the right certificate, or remove the enclave's folder and create it "
                "again.",
            )
        validity = validity_of(certificate)
        if not validity.contains(self._change.now):
            raise KeystoreError(
                f"the certificate of enclave {name} is not valid now",
                f"It is valid from {iso(validity.not_before)} to {iso(validity.not_after)}.",
                f"Renew it with `sros renew {quote(str(self._root))} {name}`.",
            )
        return certificate


def _is_file(path: Path, content: bytes) -> bool:
    """Return whether the file at ``path`` exists and has this content."""
    with suppress(SrosError):
        return read_bytes(path, "permissions document") == content
    return False


def _default_rights(template: Template, name: str) -> Enclave:
    """Return the rights of a new enclave without a policy; the basics for a router."""
    if template.zenoh and name in template.zenoh.router_names():
        template = replace(template, default_permissions=NODE_BASICS)
    return default_rights(template, name)


def _permissions_subjects(path: Path, authority: x509.Certificate) -> Iterator[x509.Name]:
    """Yield the subjects of the grants in signed permissions.

    Yield none if the permissions cannot be read, or if ``authority`` did not sign them.
    """
    try:
        signed = smime.parse(read_bytes(path, "permissions document"))
        signed.verify(authority)
        grants = parse_permissions(signed.document, f"'{path}'").grants
        yield from [parse_subject(grant.subject) for grant in grants]
    except (SrosError, ValueError):
        return
