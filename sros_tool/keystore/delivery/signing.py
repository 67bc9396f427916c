"""Answers to signing requests: all files that an enclave on a robot needs, except its key."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from shlex import quote
from typing import Annotated, NamedTuple

from cryptography import x509

from sros_tool.dds.decision.vendors import Vendor
from sros_tool.dds.permissions import name_notes
from sros_tool.errors import DocumentError, KeystoreError, Note, PkiError, SrosError
from sros_tool.files import staged_file
from sros_tool.fleet.enclaves import robot_of
from sros_tool.fleet.expansion import FleetPolicy
from sros_tool.folders import Folder
from sros_tool.keystore.delivery.archive import pack
from sros_tool.keystore.delivery.robot import RequestAnswer, check_answer, seal
from sros_tool.keystore.fleet import (
    EnclaveDomains,
    refuse_stale_domains,
)
from sros_tool.keystore.issuing.enclave import (
    Issuance,
    Issued,
    NewIdentity,
    StatedRights,
    default_rights,
    link_shared_files,
    present_files,
    shared_files,
    stated_enclave,
)
from sros_tool.keystore.issuing.keyring import IN_KEYSTORE, Keyring
from sros_tool.keystore.known_keys import KnownKeys
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    GOVERNANCE_FILE,
    GOVERNANCE_P7S,
    KEY_FILE,
    KEY_URI_FILE,
    PERMISSIONS_FILE,
    REQUEST,
    SEAL,
    ZENOH_FILES,
    enclave_folder,
)
from sros_tool.keystore.ledger import document_entry
from sros_tool.keystore.lifecycle.change import Changed, KeystoreChange
from sros_tool.keystore.lifecycle.governed import refuse_less_protected
from sros_tool.keystore.lifecycle.replaced import (
    EarlierPermissions,
    earlier_permissions,
    lasting_text,
    replaced_rights,
)
from sros_tool.keystore.lifecycle.shown import enclave_results, shown
from sros_tool.keystore.outcomes import (
    AuthorityFacts,
    EnclaveResult,
    KeptZenoh,
    changes_below,
    trusted_authorities,
)
from sros_tool.keystore.reader import Keystore
from sros_tool.keystore.rights import SignedRights
from sros_tool.names import check_enclave_name
from sros_tool.pki.certificates import (
    SigningRequest,
    enclave_subject,
    has_unique_part,
    key_digest,
    load_request,
    pem,
    validity_of,
)
from sros_tool.pki.certificates import subject_text as text_of
from sros_tool.pki.keys import holds_private_key, load_key
from sros_tool.policy.model import Enclave, Policy, stated_protections
from sros_tool.policy.placeholders import has_placeholder
from sros_tool.validity import iso
from sros_tool.values import DryRun, FileChange, FileChanges, NamedKeystore, Notes, Words, shows


@dataclass(frozen=True, slots=True, kw_only=True)
class Signed(Changed):
    """Signed requests.

    ``keys`` maps each enclave to the SHA-256 of its public key.  ``outcomes`` has the enclaves that
    were created, renewed, and kept because their key had a certificate already.  ``identity_ca``
    and ``permissions_ca`` are the CAs that robots will trust.  ``archive`` is the answer for the
    robot (``.tar.gz``), if one was made.
    """

    keys: Mapping[str, str]
    identity_ca: x509.Certificate
    permissions_ca: x509.Certificate
    archive: bytes = b""


def sign_request(
    root: Path,
    data: bytes,
    *,
    now: datetime,
    policy: Policy | FleetPolicy | None = None,
    only: Sequence[str] = (),
    refuse_revoked: bool = False,
    renew: bool = False,
    answer: Path | None = None,
    force: bool = False,
    domain: int | None = None,
    allow_refusal: Sequence[Vendor] = (),
    keyring: Keyring = IN_KEYSTORE,
    dry_run: bool = False,
) -> Signed:
    """Certify the key of a request, sign the permissions, and make the answer for the robot.

    The keystore gets all files of the enclave except the key.  The rights come from ``policy``.
    Without a policy they come from the present permissions if ``renew`` is set, otherwise from the
    keystore's template.  If the policy is for a fleet, that of the keystore records the path.

    Args:
        data: the request (PEM).
        only: the enclave that the request has to be for, if it is known: a robot chooses what its
            request says.
        refuse_revoked: refuse a revoked enclave also if ``only`` names it.
        answer: the path for the answer, which is put in place after the keystore has changed.
        force: replace ``answer`` if it exists.
        domain: refuse a keystore that is not made for this domain.
        allow_refusal: vendors on which nodes may stop.

    Raises:
        PkiError: the request is not valid.
        KeystoreError: the enclave exists (without ``renew``) or does not (with it), it was revoked
            and ``only`` does not name it, it is another one than ``only`` says, its key was revoked
            or belongs to another enclave, ``answer`` exists, the keystore cannot issue, no vendor
            would accept the enclave, or one would not that does today.
    """
    request = load_request(data, "that was given")
    if only:
        _check_asked([request], only)
    name = check_enclave_name(request.name)
    stated = _stated(policy, [name])
    if answer is not None:
        _check_free(answer, force)
    change = KeystoreChange(
        root, now=now, keyring=keyring, allow_refusal=allow_refusal, dry_run=dry_run
    )
    with change:
        signer = _Signer(change, domain, stated)
        issued = signer.certify(request, renew=renew, named=bool(only) and not refuse_revoked)
        signer.keep_zenoh()
        files = _answer_files(root, issued, change.zenoh)
        number = change.ledger.next_number()
        sealed = seal(files, number, change.permissions)
        _check_result(RequestAnswer(name, files, sealed), request, now)
        archive = pack({SEAL: sealed, **files})
        change.entries.append(document_entry(now, "answer", sealed, enclave=name, number=number))
        change.record()
        staged = staged_file(answer, archive) if answer and not dry_run else nullcontext()
        with staged as put_in_place:
            change.finish()
            if put_in_place:
                put_in_place()
    return signer.result([request], renew=renew, archive=archive)


class _Stated(NamedTuple):
    """What a policy states for an enclave; ``path`` has its placeholders, or is ""."""

    enclave: Enclave | None = None
    path: str = ""


def _stated(policy: Policy | FleetPolicy | None, names: Sequence[str]) -> dict[str, _Stated]:
    """Map enclaves to what a policy states for them; raise `PolicyError` if it lacks one."""
    if policy is None:
        return dict.fromkeys(names, _Stated())
    expanded = policy.policy() if isinstance(policy, FleetPolicy) else policy
    found = {name: _Stated(stated_enclave(expanded, name)) for name in names}
    if isinstance(policy, FleetPolicy):
        paths = {name: policy.stated(name)[0].path for name in names}
        found = {
            name: each._replace(path=paths[name] if has_placeholder(paths[name]) else "")
            for name, each in found.items()
        }
    return found


def certify_requests(
    root: Path,
    data: bytes,
    *,
    now: datetime,
    policy: Policy | FleetPolicy | None = None,
    only: Sequence[str] = (),
    refuse_revoked: bool = False,
    renew: bool = False,
    domain: int | None = None,
    allow_refusal: Sequence[Vendor] = (),
    keyring: Keyring = IN_KEYSTORE,
    dry_run: bool = False,
) -> Signed:
    """Certify the keys of several requests (PEM, one after the other), all or none.

    As `sign_request`, but no answers are made: an export without keys brings the enclaves to their
    robots.  Unless ``renew`` is set, an enclave whose key is certified already stays as it is.
    With ``only``, these are the enclaves that the requests have to be for, in their order: a robot
    chooses what its request says.

    Raises:
        PkiError: a request is not valid.
        KeystoreError: as for `sign_request`, two requests are for one enclave or one key, or one is
            for another enclave than ``only`` says.
    """
    requests = [load_request(each, f"number {at}") for at, each in enumerate(_each(data), 1)]
    if not requests:
        raise DocumentError("there is no signing request", "", "Give the request.pem of enclaves.")
    if only:
        _check_asked(requests, only)
    _check_distinct(requests)
    stated = _stated(policy, [check_enclave_name(each.name) for each in requests])
    change = KeystoreChange(
        root, now=now, keyring=keyring, allow_refusal=allow_refusal, dry_run=dry_run
    )
    kept: tuple[str, ...] = ()
    with change:
        if not renew:
            existing = frozenset(change.names)
            kept = tuple(
                each.name for each in requests if _is_certified(change.keystore, each, existing)
            )
        signer = _Signer(change, domain, stated)
        for request in requests:
            if request.name not in kept:
                signer.certify(request, renew=renew, named=bool(only) and not refuse_revoked)
        if len(kept) < len(requests):
            signer.keep_zenoh()
            change.record()
            change.finish()
        else:
            change.notes += signer.name_notes()
    return signer.result(requests, renew=renew, kept=kept)


_END = b"-----END CERTIFICATE REQUEST-----"


def _each(data: bytes) -> list[bytes]:
    """Return the requests in a series of them; what is no request is left to the reader."""
    *parts, rest = data.split(_END)
    return [part + _END + b"\n" for part in parts] + ([rest] if rest.strip() else [])


def _check_asked(requests: Sequence[SigningRequest], only: Sequence[str]) -> None:
    """Refuse a request that is for another enclave than the one in its place of ``only``."""
    if len(requests) != len(only):
        raise KeystoreError(
            f"there are {len(requests)} requests for {len(only)} enclaves",
            "",
            "Name the enclave of each request with --enclave, in their order.",
        )
    for number, (request, name) in enumerate(zip(requests, only, strict=True), 1):
        if request.name != name:
            raise KeystoreError(
                f"request number {number} is for enclave {request.name}, and should be for {name}",
                "Whoever made it asks for the identity of another enclave. Nothing was signed.",
                "Look at the robot that it comes from.",
            )


def _check_distinct(requests: Sequence[SigningRequest]) -> None:
    names = Counter(each.name for each in requests)
    keys = Counter(key_digest(each.public_key) for each in requests)
    for request in requests:
        if names[request.name] > 1:
            raise KeystoreError(
                f"two requests are for enclave {request.name}", "", "Give only one of them."
            )
        if keys[key_digest(request.public_key)] > 1:
            raise KeystoreError(
                f"the key for enclave {request.name} is in another request, too",
                "Two enclaves with one key are one identity: each can act as the other.",
                "Create a key for each enclave with `sros create_request`.",
            )


def _is_certified(keystore: Keystore, request: SigningRequest, existing: Collection[str]) -> bool:
    """Return whether the enclave of a request has a certificate for its key."""
    if request.name not in existing:
        return False
    return keystore.certificate_of(request.name).public_key() == request.public_key


class _Signer:
    """The certification of requests in one change."""

    def __init__(
        self, change: KeystoreChange, domain: int | None, stated: Mapping[str, _Stated]
    ) -> None:
        self._change = change
        self._root = change.root
        change.open_authorities()
        change.check_domain(domain)
        self._stated = stated
        self._record_paths()
        self._domains = EnclaveDomains(change.domains, change.fleet)
        self._writer = change.writer()
        self._certified: dict[str, Enclave | None] = {}
        self._new: list[str] = []

    def _record_paths(self) -> None:
        """Add the paths of what is stated to the fleet of the keystore.

        Its robots stay the same, whatever fleet the policy was filled in for.
        """
        change, root, stated = self._change, self._root, self._stated
        fleet = change.fleet
        paths = {each.path for each in stated.values() if each.path}
        if fleet and not paths <= set(fleet.enclaves):
            before = EnclaveDomains(change.domains, fleet)
            fleet = change.write_fleet(fleet, paths)
            refuse_stale_domains(root, before, fleet, stated)
        for name, each in stated.items():
            if each.path and not (fleet and robot_of(fleet, name)):
                lacks = "its fleet does not have the robot" if fleet else "it has no fleet for that"
                change.notes.append(
                    Note(
                        "fleet.unrecorded-enclaves",
                        f"The keystore does not record whose enclave {name} is: {lacks} of enclave "
                        f"{name}. `--robot` chooses it, and revokes it, after `sros "
                        f"generate_artifacts -k {quote(str(root))} -p POLICY_FILE --fleet "
                        "FLEET_FILE`.",
                    )
                )

    def certify(self, request: SigningRequest, *, renew: bool, named: bool) -> Issued:
        """Write all files of an enclave except its key; its rights are stated, or kept.

        ``named`` is whether the enclave was named at home, and not by the request alone.
        """
        change, root, name = self._change, self._root, request.name
        known, authority = change.known, change.permissions.certificate
        stated = self._stated[name].enclave
        _check_name(root, name, renew, name in change.names)
        if stated is not None:
            refuse_less_protected(root, change.governance, stated_protections([stated]))
        present = change.keystore.certificate_of(name) if renew else None
        _check_key(change.keystore, request, known, present)
        if not renew and not named and name in known.revoked_enclaves:
            raise KeystoreError(
                f"enclave {name} was revoked in keystore '{root}'",
                "Whoever has the revoked key could have made this request, to be let in again.",
                f"If the robot is yours again and shall have the enclave, add --enclave {name}.",
            )
        if present:
            note = _new_key_note(present, request)
            change.notes += note or [*known.shared_notes([name])]
        else:
            self._new.append(name)
            change.notes += known.revoked_before_notes([name])
        rights: SignedRights | StatedRights
        if present and stated is None:
            rights = _earlier_rights(change, name, present)
        else:
            enclave = stated or default_rights(change.template, name)
            rights = StatedRights(enclave, self._domains.of(name))
        unique = change.template.unique_subject or (
            present is not None and has_unique_part(present.subject)
        )
        identity = NewIdentity(enclave_subject(name, unique=unique), request.public_key)
        earlier = (
            earlier_permissions(change.keystore, name, authority, present) if present else None
        )
        issued = self._writer.write(Issuance(name, identity, rights))
        if earlier:
            change.notes += _lost_rights(root, earlier, issued, change.now)
        change.transaction.write(f"{enclave_folder(name)}/{REQUEST}", request.pem)
        link_shared_files(change.transaction, name, present_files(root, name))
        change.notes += issued.notes()
        self._certified[name] = stated
        return issued

    def keep_zenoh(self) -> None:
        """Write what follows for the files of Zenoh, after all requests."""
        change = self._change
        change.notes += [*self._writer.notes, *change.edit_notes()]
        change.keep_zenoh(self._writer.signed, stated=self._certified)
        change.notes += self.name_notes()
        change.entries += self._writer.entries

    def name_notes(self) -> Iterator[Note]:
        """Yield notes on names of new enclaves."""
        return name_notes({*self._change.names, *self._new}, self._new)

    def result(
        self,
        requests: Sequence[SigningRequest],
        *,
        renew: bool,
        kept: Collection[str] = (),
        archive: bytes = b"",
    ) -> Signed:
        """Return what was done with requests, of which ``kept`` had a certificate already."""
        done = "renewed" if renew else "created"
        return self._change.result(
            Signed,
            outcomes={each.name: "kept" if each.name in kept else done for each in requests},
            keys={each.name: key_digest(each.public_key) for each in requests},
            identity_ca=self._change.identity.certificate,
            permissions_ca=self._change.permissions.certificate,
            archive=archive,
        )


def _check_free(answer: Path, force: bool) -> None:
    if answer.exists() and not answer.is_file():
        raise KeystoreError(
            f"'{answer}' is in the way",
            "It is not a regular file.",
            "Choose another name with -o.",
        )
    if answer.exists() and not force:
        raise KeystoreError(
            f"'{answer}' already exists",
            "Nothing was changed.",
            "Add --force to replace it, or choose another name with -o.",
        )


def _check_name(root: Path, name: str, renew: bool, exists: bool) -> None:
    if exists and not renew:
        raise KeystoreError(
            f"enclave {name} exists already in keystore '{root}'",
            "The sender of the request would get the rights of this enclave.",
            "If that is intended, add --renew; otherwise create the request for another name.",
        )
    if renew and not exists:
        raise KeystoreError(
            f"enclave {name} does not exist in keystore '{root}'",
            "Only an existing enclave can be renewed.",
            "Leave --renew out.",
        )


def _check_key(
    keystore: Keystore, request: SigningRequest, known: KnownKeys, present: x509.Certificate | None
) -> None:
    """Refuse a revoked key, the key of another enclave, and a key that does not fit the keystore.

    An enclave that already shares its key with another one is renewed with a note.
    """
    remedy = "Create a new key on the robot, with `sros create_request` in another folder."
    same = present if present and present.public_key() == request.public_key else None
    known.refuse_revoked(request.public_key, f"the request for {request.name}", remedy, same)
    if not same:
        known.refuse_second(request.public_key, request.name, remedy)
    root, folder = keystore.root, keystore.folder(request.name)
    path, fits = folder / KEY_FILE, True
    if path.exists():
        key = load_key(keystore.read(path, "private key"), f"'{path}'")
        fits = key.public_key() == request.public_key
    elif (path := folder / KEY_URI_FILE).exists():
        fits = same is not None
    if not fits:
        raise KeystoreError(
            f"enclave {request.name} has another key in keystore '{root}'",
            f"Its {path.name} would not fit a certificate for the key in the request.",
            f"Revoke the enclave first, with `sros revoke {quote(str(root))} {request.name}`.",
        )


def _check_result(answer: RequestAnswer, request: SigningRequest, now: datetime) -> None:
    """Raise `KeystoreError` if the robot would reject the answer."""
    try:
        check_answer(answer, request.public_key, now=now)
    except SrosError as error:
        raise KeystoreError(
            f"the robot would reject the answer for {answer.name}: {error.what}",
            error.why,
            "Nothing was changed. See `sros inspect` of the keystore.",
        ) from error


def _new_key_note(old: x509.Certificate, request: SigningRequest) -> list[Note]:
    """Return a note if the request's key is not the key of the present certificate."""
    if old.public_key() == request.public_key:
        return []
    until = iso(validity_of(old).not_after)
    return [
        Note(
            "request.new-key",
            f"{request.name}: the request has a new key. The certificate of the old key "
            f"stays valid until {until} for anyone who has that key.",
        )
    ]


def _lost_rights(
    root: Path, earlier: EarlierPermissions, issued: Issued, now: datetime
) -> list[Note]:
    """Return a note on rights that the enclave loses, and on what still works of them."""
    (grant,) = issued.permissions.grants
    replaced = replaced_rights(issued.issuance.name, earlier, grant, now)
    text = lasting_text(root, replaced)
    if not text:
        return []
    lost = f"{replaced.enclave} loses: {replaced.loses()}."
    again = "Then answer its request again with `sros sign_request --renew`."
    return [Note("request.rights-lost", f"{lost} {text} {again}")]


def _earlier_rights(change: KeystoreChange, name: str, present: x509.Certificate) -> SignedRights:
    """Return the rights in an enclave's present permissions, after verifying their signature."""
    subject = text_of(present.subject)
    old = change.keystore.signed_grant(name, subject)
    old.signed.verify(change.permissions.certificate)
    if old.grant is None:
        raise PkiError(
            f"the permissions of enclave {name} have no grant for {subject}",
            "They belong to another certificate.",
            "State the rights with -p POLICY_FILE.",
        )
    return change.recorded.of(name, old.digest, old.grant)


def _answer_files(root: Path, issued: Issued, zenoh: KeptZenoh) -> dict[str, bytes]:
    """Map the paths of the answer's files to their content, sorted by path."""
    name = issued.issuance.name
    folder = enclave_folder(name)
    files = {
        f"{folder}/{CERTIFICATE_FILE}": pem(issued.certificate),
        f"{folder}/{PERMISSIONS_FILE}": issued.document,
    }
    shared = {GOVERNANCE_FILE: GOVERNANCE_P7S, **shared_files(root, name)}
    for file in ZENOH_FILES if name in zenoh.files else ():
        path = f"{folder}/{file}"
        if path in zenoh.written:
            files[path] = zenoh.written[path]
        elif (root / path).is_file():
            shared[file] = path
    with Folder(root) as opened:
        for file, source in shared.items():
            files[f"{folder}/{file}"] = data = opened.read_inside(source)
            if holds_private_key(data):
                raise KeystoreError(
                    f"'{root / source}' holds a private key",
                    "It would get into the answer, and so to the robot.",
                    "Remove the key from the file.",
                )
    return dict(sorted(files.items()))


# ── as JSON ────────────────────────────────────────────────────────────────────────────────


@shows(spread=("enclave",))
class CertifiedKey(NamedTuple):
    """An enclave whose key was certified."""

    enclave: EnclaveResult[
        Annotated[
            str,
            Words(("created", "renewed", "kept")),
            "What was done with the enclave; `kept` if its key has a certificate already.",
        ]
    ]
    key_sha256: str
    """SHA-256 of the enclave's public key (DER), in hexadecimal, to compare on both sides."""


class SignedRequest(NamedTuple):
    """The enclave that was certified, and the answer for its robot."""

    keystore: NamedKeystore
    dry_run: DryRun
    answer: Path | None
    """The file with the answer; ``-`` is standard output; null with ``--no-answer``."""
    enclaves: Sequence[CertifiedKey]
    """The enclave; with ``--no-answer``, all of them."""
    authorities: Sequence[AuthorityFacts]
    """The CAs that the robot will trust."""
    changes: FileChanges
    notes: Notes


def shown_signed(
    signed: Signed, answer: Path | None = None, more: Sequence[FileChange] = ()
) -> SignedRequest:
    """Return what is printed of signed requests; ``more`` are changes outside of the keystore."""
    keys = [CertifiedKey(enclave, signed.keys[enclave.name]) for enclave in enclave_results(signed)]
    return shown(
        signed,
        SignedRequest,
        answer=answer,
        enclaves=keys,
        authorities=trusted_authorities(signed.identity_ca, signed.permissions_ca),
        changes=(*changes_below(signed.root, signed.changes), *more),
    )
