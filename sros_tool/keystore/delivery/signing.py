"""Signing the requests of robots, and making the answers: an enclave's files except its key."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from shlex import quote
from types import MappingProxyType
from typing import Annotated, NamedTuple, Unpack

from cryptography import x509

from sros_tool.dds.permissions import name_notes
from sros_tool.errors import DocumentError, KeystoreError, Note, PkiError, SrosError
from sros_tool.files import staged_file
from sros_tool.fleet.expansion import FleetPolicy
from sros_tool.fleet.robots import Fleet, Robot, robot_of
from sros_tool.folders import Folder
from sros_tool.keystore.delivery.archive import pack
from sros_tool.keystore.delivery.robot import RequestAnswer, check_answer, seal
from sros_tool.keystore.fleet import EnclaveDomains, refuse_stale_domains
from sros_tool.keystore.issuing.enclave import (
    Issuance,
    IssuedEnclave,
    NewIdentity,
    StatedRights,
    default_rights,
    link_shared_files,
    present_files,
    shared_files,
    stated_enclave,
)
from sros_tool.keystore.known_keys import KnownKeys, revoked_serials
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
from sros_tool.keystore.lifecycle.change import Changed, ChangeOptions, KeystoreChange
from sros_tool.keystore.lifecycle.create import refuse_less_protected
from sros_tool.keystore.lifecycle.replaced import (
    EarlierPermissions,
    lasting_text,
    permissions_to_replace,
    replaced_rights,
    with_expiries_in_ledger,
)
from sros_tool.keystore.lifecycle.shown import enclave_results, shown
from sros_tool.keystore.outcomes import (
    AuthorityFacts,
    EnclaveResult,
    StagedZenoh,
    changes_below,
    trusted_authorities,
)
from sros_tool.keystore.reader import OpenedKeystore
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
from sros_tool.validity import iso
from sros_tool.values import DryRun, FileChange, FileChanges, NamedKeystore, Notes, Words, shows
from sros_tool.wording import counted, first_few

_MOST_NAMED = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class SignedRequests(Changed):
    """The result of signing requests.

    ``keys`` maps each enclave to the SHA-256 of its public key (DER, hexadecimal).  ``outcomes``
    maps each enclave to "created", "renewed", or "kept" (its key already had a certificate).
    ``identity_ca`` and ``permissions_ca`` are the CAs that robots will trust.  ``archive`` is the
    answer for the robot (``.tar.gz``); empty if no answer was made.
    """

    keys: Mapping[str, str]
    identity_ca: x509.Certificate
    permissions_ca: x509.Certificate
    archive: bytes = b""


def sign_request(
    root: Path,
    data: bytes,
    *,
    policy: Policy | FleetPolicy | None = None,
    only_enclaves: Sequence[str] = (),
    refuse_revoked: bool = False,
    renew: bool = False,
    answer: Path | None = None,
    force: bool = False,
    domain: int | None = None,
    **options: Unpack[ChangeOptions],
) -> SignedRequests:
    """Certify the key of a request, sign the permissions, and make the answer for the robot.

    The keystore gets all files of the enclave except the key.  The rights come from ``policy``;
    without a policy, from the current permissions if ``renew`` is set, otherwise from the
    keystore's template.  If ``policy`` is for a fleet, the enclave's path with placeholders is
    recorded in the keystore's fleet, and the permissions are for the domain of the enclave's robot.

    Args:
        root: the keystore.
        data: the request (PEM).
        only_enclaves: the only enclave for which a request is accepted; empty for any.  A robot can
            write any name into its request.
        refuse_revoked: refuse a revoked enclave, or an earlier key of an enclave, even if
            ``only_enclaves`` names the enclave.
        renew: the enclave must exist, and gets a new certificate.
        answer: the path for the answer, which is written after the keystore has changed.
        force: replace ``answer`` if it exists.
        domain: a ROS domain that the keystore must have.
        options: the options of every change of a keystore.

    Raises:
        PkiError: the request is not valid.
        KeystoreError: the enclave exists (without ``renew``) or does not exist (with ``renew``);
            the enclave was revoked and ``only_enclaves`` does not name it; the request is for
            another enclave than ``only_enclaves``; the key was revoked or belongs to another
            enclave; the enclave has a later key and ``only_enclaves`` does not name it; ``answer``
            exists; the keystore cannot issue; no vendor would accept the enclave, or a vendor that
            accepts it today would no longer do so; the fleet of the policy and the keystore's
            fleet have the enclave's robot in different domains.
    """
    if data.count(_REQUEST_END) > 1:
        raise DocumentError(
            "there are several requests, but an answer is for one request",
            "",
            "Give the request of one enclave, or add --no-answer.",
        )
    request = load_request(data, "that was given")
    if only_enclaves:
        _check_requested_enclaves([request], only_enclaves)
    name = check_enclave_name(request.name)
    stated = _stated_rights(policy, [name])
    if answer is not None:
        _check_answer_is_new(answer, force)
    change = KeystoreChange(root, **options)
    with change:
        signer = _RequestCertifier(change, domain, stated)
        issued = signer.certify(
            request, renew=renew, named=bool(only_enclaves) and not refuse_revoked
        )
        signer.stage_zenoh()
        files = _answer_files(change.keystore, issued, change.zenoh)
        number = change.keystore.ledger_file.next_number()
        sealed = seal(files, number, change.permissions)
        unsigned = change.dry_run and change.zenoh.written  # a dry run signs no configurations
        if not (unsigned or change.has_placeholder_certificates):
            _check_answer_usable(RequestAnswer(name, files, sealed), request, change.moment)
        archive = pack({SEAL: sealed, **files})
        change.entries.append(
            document_entry(change.now, "answer", sealed, enclave=name, number=number)
        )
        change.record()
        staged = staged_file(answer, archive) if answer and not change.dry_run else nullcontext()
        with staged as put_in_place:
            change.finish()
            if put_in_place:
                put_in_place()
    return signer.result([request], renew=renew, archive=archive)


class _StatedRights(NamedTuple):
    """The rights that a policy states for an enclave.

    ``enclave`` is None without a policy.  If the policy names the enclave by a path with
    placeholders of a fleet, ``path`` is this path, and ``robot`` the enclave's robot; otherwise,
    they are "" and None.  ``robots`` are all robots of the policy's fleet.
    """

    enclave: Enclave | None = None
    path: str = ""
    robot: Robot | None = None
    robots: Collection[Robot] = ()


def _stated_rights(
    policy: Policy | FleetPolicy | None, names: Sequence[str]
) -> dict[str, _StatedRights]:
    """Map enclaves to the rights that a policy states for them.

    Raises:
        PolicyError: the policy lacks an enclave.
    """
    if policy is None:
        return dict.fromkeys(names, _StatedRights())
    expanded = policy.policy() if isinstance(policy, FleetPolicy) else policy
    stated = {name: _StatedRights(stated_enclave(expanded, name)) for name in names}
    if isinstance(policy, FleetPolicy):
        for name in names:
            enclave, robot = policy.stated_enclave(name)
            stated[name] = stated[name]._replace(robots=policy.fleet.robots.values())
            if robot:
                stated[name] = stated[name]._replace(path=enclave.path, robot=robot)
    return stated


def certify_requests(
    root: Path,
    data: bytes,
    *,
    policy: Policy | FleetPolicy | None = None,
    only_enclaves: Sequence[str] = (),
    refuse_revoked: bool = False,
    renew: bool = False,
    replace_keys: bool = False,
    vouching: Mapping[str, Collection[int]] = MappingProxyType({}),
    domain: int | None = None,
    **options: Unpack[ChangeOptions],
) -> SignedRequests:
    """Certify the keys of several requests (PEM, one after the other), all or none.

    The arguments are the same as for `sign_request`.  But no answers are made: an export without
    keys brings the enclaves to their robots.  Unless ``renew`` is set, an enclave whose key is
    already certified stays as it is.  ``only_enclaves`` are the enclaves for which there must be
    requests; empty for any.  With ``replace_keys``, an enclave's private key in the keystore is
    removed if the request has another key: from then on, the enclave's key is on its robot.
    ``vouching`` maps enclaves to the serial numbers of the certificates that vouch for their
    requests: the enclave must still have one of them, and none of them may be revoked.

    Raises:
        PkiError: a request is not valid.
        KeystoreError: as for `sign_request`, or two requests are for the same enclave or key.
    """
    requests = [
        load_request(request, f"number {number}")
        for number, request in enumerate(_split_requests(data), 1)
    ]
    if not requests:
        raise DocumentError(
            "the input has no signing request", "", "Give the request.pem files of enclaves."
        )
    if only_enclaves:
        _check_requested_enclaves(requests, only_enclaves)
    _check_distinct(requests)
    stated = _stated_rights(policy, [check_enclave_name(request.name) for request in requests])
    change = KeystoreChange(root, **options)
    kept: tuple[str, ...] = ()
    with change:
        _check_vouching(change.keystore, vouching)
        if not renew:
            kept = tuple(
                request.name for request in requests if _is_certified(change.keystore, request)
            )
        signer = _RequestCertifier(change, domain, stated, replace_keys=replace_keys)
        for request in requests:
            if request.name not in kept:
                signer.certify(
                    request, renew=renew, named=bool(only_enclaves) and not refuse_revoked
                )
        if len(kept) < len(requests):
            signer.stage_zenoh()
            change.record()
            change.finish()
        else:
            change.notes += signer.name_notes()
    return signer.result(requests, renew=renew, kept=kept)


def _check_vouching(keystore: OpenedKeystore, vouching: Mapping[str, Collection[int]]) -> None:
    """Raise `KeystoreError` if a certificate that vouches for a request was replaced or revoked."""
    revoked = revoked_serials(keystore) if vouching else frozenset()
    for name, serials in vouching.items():
        present = keystore.certificate_of(name) if keystore.has_enclave(name) else None
        if not present or present.serial_number not in serials or not revoked.isdisjoint(serials):
            raise KeystoreError(
                f"enclave {name} was changed while its request was examined",
                "The certificate that vouches for the request may have been revoked. Nothing was "
                "signed.",
                "Repeat the command: it examines the request again.",
            )


_REQUEST_END = b"-----END CERTIFICATE REQUEST-----"


def _split_requests(data: bytes) -> list[bytes]:
    """Return the PEM requests in ``data``; text after the last one counts as a request, too.

    `load_request` reports parts that are not requests.
    """
    *parts, rest = data.split(_REQUEST_END)
    return [part + _REQUEST_END + b"\n" for part in parts] + ([rest] if rest.strip() else [])


def _check_requested_enclaves(
    requests: Sequence[SigningRequest], only_enclaves: Sequence[str]
) -> None:
    """Raise `KeystoreError` unless the requests are for exactly ``only_enclaves``, in any order."""
    if len(requests) != len(only_enclaves):
        raise KeystoreError(
            f"the input has {counted(len(requests), 'request')} for "
            f"{counted(len(only_enclaves), 'enclave')}",
            "",
            "Name the enclaves with --enclave, one for each request.",
        )
    for number, request in enumerate(requests, 1):
        if request.name not in only_enclaves:
            raise KeystoreError(
                f"request number {number} is for enclave {request.name}, not for "
                f"{first_few(only_enclaves, 3)}",
                "The request asks for the identity of another enclave. Nothing was signed.",
                "Examine the robot that the request comes from.",
            )


def _check_distinct(requests: Sequence[SigningRequest]) -> None:
    """Raise `KeystoreError` if two requests are for the same enclave or for the same key."""
    names = Counter(request.name for request in requests)
    keys = Counter(key_digest(request.public_key) for request in requests)
    for request in requests:
        if names[request.name] > 1:
            raise KeystoreError(
                f"two requests are for enclave {request.name}", "", "Give only one request for it."
            )
        if keys[key_digest(request.public_key)] > 1:
            raise KeystoreError(
                f"the key for enclave {request.name} is in another request, too",
                "Two enclaves with one key are one identity: each can act as the other.",
                "Create a key for each enclave with `sros create_request`.",
            )


def _is_certified(keystore: OpenedKeystore, request: SigningRequest) -> bool:
    """Return whether the enclave of a request already has a certificate for the request's key."""
    if not keystore.has_enclave(request.name):
        return False
    return keystore.certificate_of(request.name).public_key() == request.public_key


def _not_recorded_clause(recorded: Fleet | None, stated: Robot | None) -> str:
    """Return why a keystore's fleet, if there is one, does not give an enclave to its robot.

    ``stated`` is the robot by the fleet file of the command.
    """
    if recorded is None:
        return "it has no fleet"
    robot = recorded.robots.get(stated.name) if stated else None
    if stated is None or robot is None:
        return "its fleet does not have the robot"
    other = "in other groups" if robot.groups != stated.groups else "with another namespace"
    return f"its fleet has the robot {other}"


class _RequestCertifier:
    """The certification of requests within one change of a keystore."""

    def __init__(
        self,
        change: KeystoreChange,
        domain: int | None,
        stated: Mapping[str, _StatedRights],
        *,
        replace_keys: bool = False,
    ) -> None:
        self._change = change
        self._replace_keys = replace_keys
        self._root = change.root
        change.open_authorities()
        change.check_domain(domain)
        self._stated_rights = stated
        self._record_paths()
        robots = {name: rights.robot for name, rights in stated.items() if rights.robot}
        self._domains = EnclaveDomains(change.domains, change.fleet, robots)
        self._writer = change.writer()
        self._certified: dict[str, Enclave | None] = {}
        self._new: list[str] = []
        self._earlier: dict[str, x509.Certificate] = {}
        """Maps enclaves that get a new key to their certificates for the old key."""

    def _record_paths(self) -> None:
        """Add the policy's paths with placeholders to the fleet of the keystore.

        The robots of the keystore's fleet stay, even if the policy was expanded for another fleet.
        """
        change, root, stated = self._change, self._root, self._stated_rights
        fleet = change.fleet
        paths = {of_enclave.path for of_enclave in stated.values() if of_enclave.path}
        if fleet and not paths <= set(fleet.enclaves):
            before = EnclaveDomains(change.domains, fleet)
            fleet = change.write_fleet(fleet, paths)
            refuse_stale_domains(change.keystore, before, fleet, stated)
        unrecorded: dict[str, list[str]] = {}
        for name, of_enclave in stated.items():
            if of_enclave.path and not (fleet and robot_of(fleet, name)):
                why = _not_recorded_clause(fleet, of_enclave.robot)
                unrecorded.setdefault(why, []).append(name)
        for why, names in unrecorded.items():
            change.notes.append(
                Note(
                    "fleet.unrecorded-enclaves",
                    f"the keystore does not know which robot has {first_few(names, 3)}: {why}. "
                    "So `--robot`, as in `sros renew KEYSTORE --robot ROBOT`, does not choose such "
                    "an enclave until you run `sros generate_artifacts -k "
                    f"{quote(str(root))} -p POLICY_FILE --fleet FLEET_FILE`.",
                )
            )

    def certify(self, request: SigningRequest, *, renew: bool, named: bool) -> IssuedEnclave:
        """Write all files of the request's enclave except its key.

        Args:
            request: the request whose key is certified.
            renew: the enclave exists, and keeps its current rights unless the policy states others.
            named: whether the operator named the enclave, not only the request.
        """
        change, root, name = self._change, self._root, request.name
        known, authority = change.known, change.permissions.certificate
        stated = self._stated_rights[name].enclave
        _check_requested_name(change.keystore, known, request, renew)
        if stated is not None:
            refuse_less_protected(change.keystore, change.governance, stated_protections([stated]))
        present = change.keystore.certificate_of(name) if renew else None
        _check_requested_key(request, known, present)
        if not self._remove_key_other_than(request):
            _check_same_key(change.keystore, request, present)
        if not named:
            if not renew and known.enclaves_revoked_before([name]):
                raise self._revoked_error(name)
            _refuse_earlier_key(request, known)
        if present:
            if present.public_key() == request.public_key:
                change.notes += known.shared_key_notes([name])
            else:
                self._earlier[name] = present
        else:
            self._new.append(name)
            change.notes += known.revoked_before_notes([name])
        rights: SignedRights | StatedRights
        if present and stated is None:
            rights = _earlier_rights(change, name, present)
        else:
            if stated is None:
                change.notes += _default_rights_notes(change, name)
            enclave = stated or default_rights(change.template, name)
            rights = StatedRights(enclave, self._domains.domains_of(name))
            change.notes += self._all_domains_notes(name)
        unique = change.template.unique_subject or (
            present is not None and has_unique_part(present.subject)
        )
        subject = enclave_subject(name, unique=unique)
        identity = NewIdentity(subject, request.public_key, request=request.pem)
        earlier = (
            permissions_to_replace(change.keystore, name, authority, present) if present else None
        )
        issued = self._writer.write(Issuance(name, identity, rights))
        if earlier:
            change.notes += _lost_rights_notes(change, earlier, issued)
        change.transaction.write(f"{enclave_folder(name)}/{REQUEST}", request.pem)
        link_shared_files(change.transaction, name, present_files(root, name))
        change.notes += issued.notes()
        self._certified[name] = stated
        return issued

    def _revoked_error(self, name: str) -> KeystoreError:
        """Return the error for the requests of ``name`` and all other revoked enclaves."""
        requested = self._stated_rights
        revoked = sorted(self._change.known.enclaves_revoked_before([*requested]))
        their = "its request" if len(revoked) == 1 else "their requests"
        add = "add" if len(revoked) == len(requested) else f"give only {their}, and add"
        options = " ".join(f"--enclave {quote(enclave)}" for enclave in revoked)
        these = "the enclave" if len(revoked) == 1 else "these enclaves"
        return KeystoreError(
            f"enclave {name} was revoked in keystore '{self._root}'",
            "Whoever has the revoked key could have made this request to get access again.",
            f"If you have the robot back, and want it to have {these} again, {add} {options}.",
        )

    def _all_domains_notes(self, name: str) -> Iterator[Note]:
        """Yield a note if an enclave of no robot gets rights in the domains of all robots."""
        robots = (*self._domains.robots(), *self._stated_rights[name].robots)
        apart = any(robot.domain is not None for robot in robots)
        domains = self._change.domains
        if self._domains.robot_of(name) or not apart or len([*domains]) == 1:
            return
        yield Note(
            "request.all-domains",
            f"{name} belongs to no robot of the fleet, so its permissions are for all domains of "
            f"the keystore ({domains}). If it belongs to a robot, sign its request again with "
            "--renew, --fleet FLEET_FILE, and a policy in which the path of the enclave has "
            "{robot}.",
        )

    def _remove_key_other_than(self, request: SigningRequest) -> bool:
        """Remove the enclave's private key in the keystore unless it is the key of the request.

        This needs ``replace_keys``, or a restored keystore whose robot has other keys
        (`_is_key_of_robot`).  Returns whether the keystore had a key file that fits the request, or
        that is removed now.
        """
        keystore, name = self._change.keystore, request.name
        path = keystore.folder(name) / KEY_FILE
        if not path.exists():
            return False
        key = load_key(keystore.read(path, "private key"), f"'{path}'")
        if key.public_key() != request.public_key:
            if not (self._replace_keys or _is_key_of_robot(self._change.known, request)):
                return False
            self._change.transaction.remove(f"{enclave_folder(name)}/{KEY_FILE}")
            text = (
                f"{name}: its new key was made on the robot and stays there; its earlier key was "
                "removed from the keystore."
            )
            self._change.notes.append(Note("request.key-on-robot", text))
        return True

    def stage_zenoh(self) -> None:
        """Stage the Zenoh configurations that follow from all certified requests."""
        change = self._change
        change.notes += [
            *_new_key_notes(self._root, self._earlier, change.now),
            *self._writer.notes,
            *change.known.missing_key_notes(),
            *change.edit_notes(),
        ]
        change.stage_zenoh(self._writer.signed, stated=self._certified)
        change.notes += self.name_notes()
        change.entries += self._writer.entries

    def name_notes(self) -> Iterator[Note]:
        """Yield notes on names of new enclaves that vendors or users may confuse."""
        if not self._new or self._change.template.unique_subject:
            return iter(())
        recorded = self._change.keystore.ledger_file.recorded_enclaves()
        names = self._change.names if recorded is None else recorded
        return name_notes({*names, *self._new}, self._new)

    def result(
        self,
        requests: Sequence[SigningRequest],
        *,
        renew: bool,
        kept: Collection[str] = (),
        archive: bytes = b"",
    ) -> SignedRequests:
        """Return the result; the enclaves in ``kept`` already had a certificate for their key."""
        done = "renewed" if renew else "created"
        return self._change.result(
            SignedRequests,
            outcomes={
                request.name: "kept" if request.name in kept else done for request in requests
            },
            keys={request.name: key_digest(request.public_key) for request in requests},
            identity_ca=self._change.identity.certificate,
            permissions_ca=self._change.permissions.certificate,
            archive=archive,
        )


def _check_answer_is_new(answer: Path, force: bool) -> None:
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


def _is_key_of_robot(known: KnownKeys, request: SigningRequest) -> bool:
    """Return whether a restored keystore certified the key of a request after its last backup.

    If only a certificate of another enclave shows that the robot has its own keys, any request
    counts whose enclave has a key that the restored keystore made.
    """
    name, key = request.name, key_digest(request.public_key)
    if shown := known.certificates_shown_after_restore([name]):
        return any(entry.key == key for entry in shown)
    return name in known.made_unknowing([name]).values()


def _check_requested_name(
    keystore: OpenedKeystore, known: KnownKeys, request: SigningRequest, renew: bool
) -> None:
    name = request.name
    exists = keystore.has_enclave(name)
    if exists and not renew:
        intended = (
            "add --renew"
            if _is_certified(keystore, request) or _is_key_of_robot(known, request)
            else "for example because the robot has new hardware, first "
            + _revocation_advice(keystore, name)
        )
        raise KeystoreError(
            f"enclave {name} already exists in keystore '{keystore.root}'",
            "The sender of the request would get the rights of this enclave.",
            f"If that is intended, {intended}. Otherwise, create the request for another name.",
        )
    if renew and not exists:
        raise KeystoreError(
            f"enclave {name} does not exist in keystore '{keystore.root}'",
            "Only an existing enclave can be renewed.",
            "Leave --renew out.",
        )


def _check_requested_key(
    request: SigningRequest, known_keys: KnownKeys, present_certificate: x509.Certificate | None
) -> None:
    """Raise `KeystoreError` if a request's key was revoked, or if another enclave has it.

    An enclave that already shares its key with another enclave is renewed, with a note.
    """
    remedy = (
        "On the robot, remove the enclave's folder, and create a new key with `sros "
        "create_request`."
    )
    certificate = (
        present_certificate
        if present_certificate and present_certificate.public_key() == request.public_key
        else None
    )
    holder = f"the request for {request.name}"
    known_keys.refuse_revoked_key(request.public_key, holder, remedy, certificate)
    if not certificate:
        known_keys.refuse_shared_key(request.public_key, request.name, remedy)


def _refuse_earlier_key(request: SigningRequest, known: KnownKeys) -> None:
    """Raise `KeystoreError` if the enclave of a request has got a later key than the request's."""
    later = known.later_key(request.name, key_digest(request.public_key))
    if later:
        raise KeystoreError(
            f"the request for {request.name} is for an earlier key",
            f"It is for the key {key_digest(request.public_key)}; the newest key that the keystore "
            f"knows for this enclave is {later.key}.",
            "Let the robot's agent run once (`sros agent run DIR --once`), take request.pem of "
            "the enclave again, and repeat the command. If the newest key is lost, create a new "
            "key on the robot, with `sros create_request` in another folder. If the robot is to "
            f"use the earlier key again, add --enclave {quote(request.name)}.",
        )


def _check_same_key(
    keystore: OpenedKeystore, request: SigningRequest, present_certificate: x509.Certificate | None
) -> None:
    """Raise `KeystoreError` if the keystore has another private key for a request's enclave."""
    root, folder = keystore.root, keystore.folder(request.name)
    path, fits = folder / KEY_FILE, True
    if path.exists():
        key = load_key(keystore.read(path, "private key"), f"'{path}'")
        fits = key.public_key() == request.public_key
    elif (path := folder / KEY_URI_FILE).exists():
        fits = bool(present_certificate and present_certificate.public_key() == request.public_key)
    if not fits:
        raise KeystoreError(
            f"enclave {request.name} has another key in keystore '{root}'",
            f"Its {path.name} would not fit a certificate for the key in the request.",
            f"First {_revocation_advice(keystore, request.name)}. Leave --renew out.",
        )


def _revocation_advice(keystore: OpenedKeystore, name: str) -> str:
    """Return advice, as a clause, on how an enclave gets a key made on its robot."""
    return (
        f"revoke the old key with `sros revoke {quote(str(keystore.root))} {name}` (or, with "
        f"--robot, all keys of its robot). Then repeat this command with --enclave {name} and with "
        "the policy, which states the enclave's rights: -p POLICY_FILE, for a fleet also --fleet "
        "FLEET_FILE"
    )


def _check_answer_usable(answer: RequestAnswer, request: SigningRequest, now: datetime) -> None:
    """Raise `KeystoreError` if the robot would reject the answer."""
    try:
        check_answer(answer, request.public_key, now=now)
    except SrosError as error:
        raise KeystoreError(
            f"the robot would reject the answer for {answer.name}: {error.what}",
            error.why,
            "Nothing was changed. To find the fault, run `sros inspect KEYSTORE`.",
        ) from error


def _new_key_notes(
    root: Path, earlier: Mapping[str, x509.Certificate], now: datetime
) -> Iterator[Note]:
    """Yield a note on the certificates for the old keys of enclaves that get new keys."""
    if not earlier:
        return
    ends = {name: validity_of(certificate).not_after for name, certificate in earlier.items()}
    valid = [name for name in earlier if ends[name] > now]
    old = "the old key" if len(ends) == 1 else "each old key"
    rest = f"The certificate of {old} has expired."
    if valid:
        names = " ".join(map(quote, valid)) if len(valid) <= _MOST_NAMED else "ENCLAVE..."
        until = iso(max(ends.values())) + " at the latest" * (len({*ends.values()}) > 1)
        rest = (
            f"The certificate of {old} stays valid until {until} for anyone who has that key. To "
            f"revoke it: `sros renew {quote(str(root))} {names} --revoke-old`."
        )
    yield Note("request.new-key", f"{first_few([*ends], _MOST_NAMED)}: requested a new key. {rest}")


def _lost_rights_notes(
    change: KeystoreChange, earlier_permissions: EarlierPermissions, issued: IssuedEnclave
) -> list[Note]:
    """Return notes on rights that the enclave loses, and on how long its old files still work."""
    (grant,) = issued.permissions.grants
    replaced = replaced_rights(issued.issuance.name, earlier_permissions, grant, change.now)
    (replaced,) = with_expiries_in_ledger(change.keystore, (replaced,), change.now)
    text = lasting_text(change.root, (replaced,))
    if not text:
        return []
    lost = f"{replaced.enclave} loses: {replaced.lost_text()}."
    remedy = "Then answer its request again with `sros sign_request --renew`."
    return [Note("request.rights-lost", f"{lost} {text} {remedy}")]


def _default_rights_notes(change: KeystoreChange, name: str) -> Iterator[Note]:
    """Yield a note if a created enclave would need other rights than the default of the template.

    Such an enclave had other rights before it was revoked or removed, or belongs to a robot of the
    fleet.
    """
    root, fleet, last = (
        quote(str(change.root)),
        change.fleet,
        change.recorded_rights.last_entry(name),
    )
    had_others = last and last.policy != default_rights(change.template, name).digest
    of_robot = bool(fleet and robot_of(fleet, name))
    if had_others or of_robot:
        command = (
            f"sros generate_artifacts -k {root} -p POLICY_FILE --fleet FLEET_FILE"
            if of_robot
            else f"sros create_permission {root} {quote(name)} POLICY_FILE"
        )
        lacks = "not the rights that it had before" if had_others else "not those of a policy"
        yield Note(
            "request.default-rights",
            f"{name}: no policy was given, so it has only the default permissions of the "
            f"keystore's template, and {lacks}. To give it the rights of its policy: `{command}`.",
        )


def _earlier_rights(
    change: KeystoreChange, name: str, present_certificate: x509.Certificate
) -> SignedRights:
    """Return the rights in an enclave's current permissions, after verifying their signature."""
    subject = text_of(present_certificate.subject)
    earlier = change.keystore.signed_grant(name, subject)
    earlier.signed.verify(change.permissions.certificate)
    if earlier.grant is None:
        raise PkiError(
            f"the permissions of enclave {name} have no grant for {subject}",
            "These permissions belong to another certificate.",
            "State the rights with -p POLICY_FILE.",
        )
    return change.recorded_rights.rights_to_sign(name, earlier.digest, earlier.grant)


def _answer_files(
    keystore: OpenedKeystore, issued: IssuedEnclave, zenoh: StagedZenoh
) -> dict[str, bytes]:
    """Map the paths of the answer's files to their content, sorted by path."""
    name = issued.issuance.name
    folder = enclave_folder(name)
    files = {
        f"{folder}/{CERTIFICATE_FILE}": pem(issued.certificate),
        f"{folder}/{PERMISSIONS_FILE}": issued.document,
    }
    shared = {GOVERNANCE_FILE: GOVERNANCE_P7S, **shared_files(keystore.root, name)}
    for file in ZENOH_FILES if name in zenoh.files else ():
        path = f"{folder}/{file}"
        if path in zenoh.written:
            files[path] = zenoh.written[path]
        elif (keystore.root / path).is_file():
            shared[file] = path
    with Folder(keystore.root) as opened:
        for file, source in shared.items():
            files[f"{folder}/{file}"] = data = opened.read_inside(source)
            if holds_private_key(data):
                raise KeystoreError(
                    f"'{keystore.root / source}' contains a private key",
                    "The key would get into the answer, and so to the robot.",
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
    """The enclaves that were certified, and the answer for the robot."""

    keystore: NamedKeystore
    dry_run: DryRun
    answer: Path | None
    """File with the answer; ``-`` for standard output; null with ``--no-answer``."""
    enclaves: Sequence[CertifiedKey]
    """The certified enclave; with ``--no-answer``, all certified enclaves."""
    authorities: Sequence[AuthorityFacts]
    """The CAs that the robot will trust."""
    changes: FileChanges
    notes: Notes


def shown_signed(
    signed: SignedRequests, answer: Path | None = None, more: Sequence[FileChange] = ()
) -> SignedRequest:
    """Return the value that ``--json`` prints for signed requests.

    ``more`` are changes outside of the keystore.
    """
    keys = [CertifiedKey(enclave, signed.keys[enclave.name]) for enclave in enclave_results(signed)]
    return shown(
        signed,
        SignedRequest,
        answer=answer,
        enclaves=keys,
        authorities=trusted_authorities(signed.identity_ca, signed.permissions_ca),
        changes=(*changes_below(signed.root, signed.changes), *more),
    )
