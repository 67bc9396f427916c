"""The values that ``--json`` prints for changes of a keystore.

`shown` makes these values from the result of a change: creation, renewal, revocation, update,
rotation.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Generic, NamedTuple, TypeVar

from sros_tool.errors import Note
from sros_tool.keystore.describe import RouterFacts, router_facts
from sros_tool.keystore.layout import ROLES
from sros_tool.keystore.lifecycle.replaced import ReplacedRights
from sros_tool.keystore.outcomes import (
    AuthorityFacts,
    EnclaveResult,
    Outcome,
    Restart,
    RestartZenoh,
    authority_facts,
    changes_below,
    enclave_result,
)
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.pki.certificates import load_certificate, subject_text
from sros_tool.values import DryRun, FileChanges, NamedKeystore, Notes, Words, shows

if TYPE_CHECKING:
    from sros_tool.keystore.comparison import SettingChange
    from sros_tool.keystore.lifecycle.change import Changed
    from sros_tool.keystore.lifecycle.create import Creation
    from sros_tool.keystore.lifecycle.rotation import AuthorityStatus, RotationStage, RotationStatus
    from sros_tool.keystore.lifecycle.update import UpdateStage
    from sros_tool.zenoh.configuration import ZenohNetwork

Rights = Annotated[
    Sequence[ReplacedRights],
    "The rights that enclaves gain and lose with their new permissions; enclaves without a change "
    "are left out.",
]
TrustRevoked = Annotated[
    Sequence[str],
    "Enclaves whose processes trust the revoked certificates until they are restarted.",
]


Form = TypeVar("Form", bound=tuple[Any, ...])


def shown(result: Changed, form: type[Form], **more: Any) -> Form:
    """Return the result of a change as an instance of ``form``, the class that ``--json`` prints.

    The value of a field comes from ``more``, or else from the result.  ``notes`` in ``more`` are
    added to the notes of the result.
    """
    root = result.root
    known: dict[str, Callable[[], Any]] = {
        "keystore": lambda: root,
        "folder": lambda: root,
        "enclaves": lambda: enclave_results(result),
        "restart_zenoh": lambda: result.zenoh.restart,
        "replaced_work_until": lambda: result.works_until,
        "changes": lambda: changes_below(root, result.changes),
        "notes": lambda: (*result.notes, *result.remarks, *more.get("notes", ())),
    }
    values = {}
    for key in form._fields:  # type: ignore[attr-defined]
        if key in known and (key == "notes" or key not in more):
            values[key] = known[key]()
        else:
            values[key] = more[key] if key in more else getattr(result, key)
    return form(**values)


def enclave_results(result: Changed) -> list[EnclaveResult[str]]:
    """Return the outcomes of enclaves; in a dry run, new enclaves have no certificate yet."""
    keystore = OpenedKeystore(result.root)
    return [
        enclave_result(keystore, name, done, written=not result.dry_run or done == "kept")
        for name, done in result.outcomes.items()
    ]


# ── create_keystore, create_enclave, create_permission, generate_artifacts ──────────────────


class _EnclaveCreation(NamedTuple, Generic[Outcome]):
    """The enclaves that were created or got new permissions."""

    keystore: NamedKeystore
    dry_run: DryRun
    new_keystore: bool
    """Whether the keystore itself was also created."""
    enclaves: Sequence[EnclaveResult[Outcome]]
    """The enclaves of the command, with their outcomes."""
    rights: Rights
    restart: Restart
    restart_zenoh: RestartZenoh
    changes: FileChanges
    notes: Notes


CreatedEnclaves = Annotated[
    _EnclaveCreation[
        Annotated[
            str,
            Words(("created", "completed", "kept")),
            "`created`; `completed`: missing files were added; `kept`: nothing changed.",
        ]
    ],
    "The enclaves that were created or already existed.",
]
ChangedEnclave = Annotated[
    _EnclaveCreation[Annotated[str, Words(("changed",)), "The enclave got new permissions."]],
    "The enclaves with new permissions.",
]
MadeEnclaves = _EnclaveCreation[
    Annotated[
        str,
        Words(("created", "changed", "completed", "kept")),
        "`created`; `changed`: new permissions; `completed`: missing files were added; `kept`: "
        "nothing changed.",
    ]
]


@shows(spread=("facts",))
class KeystoreAuthority(NamedTuple):
    """A CA of a new keystore."""

    facts: AuthorityFacts
    imported: bool
    """Whether an existing CA is used (``--identity-ca``, ``--permissions-ca``)."""


class NewKeystore(NamedTuple):
    """The new keystore."""

    keystore: NamedKeystore
    dry_run: DryRun
    template: str
    """Name of the template."""
    domains: str
    """The ROS domains of the keystore, such as ``0`` or ``10-19``."""
    authorities: Sequence[KeystoreAuthority]
    """CAs of the keystore; with ``--ca-layout single``, one CA with both roles."""
    changes: FileChanges
    notes: Notes


def shown_keystore(
    result: Creation, imported_cas: Mapping[str, bytes], notes: Sequence[Note]
) -> NewKeystore:
    """Return what `create_keystore --json` prints.

    ``imported_cas`` maps roles to existing CAs (PEM).
    """
    authorities = []
    separate = result.template.separate_authorities
    for roles in [(role,) for role in ROLES] if separate else [ROLES]:
        role, certificate = roles[0], None
        if not result.dry_run:
            certificate = OpenedKeystore(result.root).ca_certificate(role)
        elif role in imported_cas:
            certificate = load_certificate(imported_cas[role], f"of the {role} CA")
        authorities.append(
            KeystoreAuthority(authority_facts(roles, certificate), role in imported_cas)
        )
    return shown(
        result,
        NewKeystore,
        template=result.template.name,
        domains=str(result.domains),
        authorities=authorities,
        notes=notes,
    )


# ── zenoh ───────────────────────────────────────────────────────────────────────────────────


class NetworkSettings(NamedTuple):
    """The network in the keystore's settings after the change."""

    router: str
    """The enclave of the router."""
    endpoints: Sequence[str]
    """Endpoints at which sessions connect to the router, as HOST:PORT."""
    listen: Sequence[str]
    """Endpoints at which the router listens, as HOST:PORT."""
    mode: Annotated[str, Words(("client", "peer"))]
    """Whether sessions also connect to each other (``peer``), or only to the router."""
    domains: Sequence[int]
    """The ROS domains of the network."""
    routers: Sequence[RouterFacts]
    """Further routers, on robots or other hosts."""
    crossing: Sequence[str]
    """The names that may pass between routers; empty if all names to which enclaves have rights may
    pass.
    """


class ZenohFileState(NamedTuple):
    """A Zenoh configuration file."""

    enclave: str
    """The enclave."""
    path: Path
    """Path of the file; the signed document is next to it."""
    current: bool
    """Whether the file already had this content and a valid signature."""


class EnclaveWithoutZenoh(NamedTuple):
    """An enclave without a Zenoh configuration, and so without rights on Zenoh."""

    enclave: str
    """The enclave."""
    why: str
    """Why the enclave has no configuration, as a clause."""


class KeystoreZenoh(NamedTuple):
    """The Zenoh configurations of a keystore's enclaves."""

    keystore: NamedKeystore
    dry_run: DryRun
    network: NetworkSettings | None
    """The network in the keystore's settings after the change; null after ``--off``."""
    files: Sequence[ZenohFileState]
    """The file of the router, and a file for each other enclave with rights."""
    left_out: Sequence[EnclaveWithoutZenoh]
    """The enclaves without a file; with ``--check``, the exit status is 1 if there are any."""
    created: Sequence[str]
    """Enclaves that were created: the router's enclave, if it was missing."""
    restart: Sequence[str]
    """The enclaves whose processes have to be restarted, because their rules changed."""
    changes: FileChanges
    """The files that were written, or would be without ``--dry-run`` or ``--check``."""
    notes: Notes


def shown_zenoh(
    result: Creation, network: ZenohNetwork | None, changed: Collection[str]
) -> KeystoreZenoh:
    """Return what `zenoh --json` prints; ``changed`` are the paths of changed files."""
    settings = None
    if network:
        settings = NetworkSettings(
            network.router,
            network.endpoints,
            network.listening(),
            network.mode.value,
            network.domains or tuple(result.domains),
            [router_facts(router) for router in network.routers],
            network.crossing,
        )
    files = [
        ZenohFileState(name, result.root / path, path not in changed)
        for name, path in result.zenoh.files.items()
    ]
    left_out = [EnclaveWithoutZenoh(name, why) for name, why in result.zenoh.left_out.items()]
    return shown(result, KeystoreZenoh, network=settings, files=files, left_out=left_out)


# ── renew, revoke, update_keystore ──────────────────────────────────────────────────────────


class RenewedEnclaves(NamedTuple):
    """The enclaves that were renewed."""

    keystore: NamedKeystore
    dry_run: DryRun
    enclaves: Sequence[
        EnclaveResult[Annotated[str, Words(("renewed",)), "What was done with the enclave."]]
    ]
    """The renewed enclaves."""
    replaced_work_until: datetime | None
    """When the last earlier certificate of these enclaves in the ledger stops working, in UTC: it
    expires, or the last permissions for it expire. Null if all have expired or were revoked.
    """
    may_work_longer: bool
    """Whether earlier certificates that the ledger lacks may work after that time, because the
    keystore is an old copy, or was restored from a backup.
    """
    revoked: int
    """Number of certificates that were revoked (``--revoke-old``)."""
    restart: TrustRevoked
    restart_zenoh: RestartZenoh
    changes: FileChanges
    notes: Notes


class RevokedEnclave(NamedTuple):
    """A revoked enclave."""

    name: str
    """The enclave."""
    outcome: Annotated[str, Words(("revoked",))] = "revoked"
    """What was done with the enclave."""


class RevokedEnclaves(NamedTuple):
    """The enclaves that were revoked."""

    keystore: NamedKeystore
    dry_run: DryRun
    enclaves: Sequence[RevokedEnclave]
    """The revoked enclaves."""
    reason: str
    """The reason, as in RFC 5280."""
    next_update: datetime
    """Expiry of the revocation list, in UTC."""
    restart: TrustRevoked
    restart_zenoh: RestartZenoh
    changes: FileChanges
    notes: Notes


class TemplateChange(NamedTuple):
    """The name of the keystore's template, before and after an update."""

    before: str
    """Name of the template before the update."""
    after: str
    """Name of the template after all stages."""


class UpdatedKeystore(NamedTuple):
    """The changes of the keystore."""

    keystore: NamedKeystore
    dry_run: DryRun
    needs_allow_looser: bool
    """Whether the update allows more than before, which needs ``--allow-looser``."""
    template: TemplateChange
    """The name of the template."""
    done: Sequence[UpdateStage]
    """Stages that were carried out; empty if nothing had to be done."""
    left: Sequence[UpdateStage]
    """Stages that remain."""
    settings: Sequence[SettingChange]
    """The settings that change."""
    rights: Rights
    looser: Sequence[str]
    """What the update newly allows, as clauses."""
    enclaves: Sequence[
        EnclaveResult[
            Annotated[
                str,
                Words(("renewed", "signed")),
                "`renewed`: a new certificate and new permissions; `signed`: new permissions only.",
            ]
        ]
    ]
    """Enclaves that got a certificate or permissions."""
    replaced_work_until: datetime | None
    """When the last replaced certificate stops working, in UTC: it expires, or the last permissions
    for it expire. Null if no certificate was replaced, or all were revoked.
    """
    revoked: int
    """The number of revoked certificates."""
    restart: Restart
    restart_zenoh: RestartZenoh
    changes: FileChanges
    notes: Notes


# ── crl ─────────────────────────────────────────────────────────────────────────────────────


class RevokedCertificate(NamedTuple):
    """A revoked certificate."""

    serial: str
    """Serial number, in hexadecimal."""
    enclave: str | None
    """Enclave of the certificate; null if the certificate is not in the ledger."""
    date: datetime
    """When the certificate was revoked, in UTC."""
    reason: str
    """The reason, as in RFC 5280."""


class OtherList(NamedTuple):
    """A revocation list of another CA."""

    issuer: str
    """Subject of the CA that signed the list."""
    number: int
    """Number of the list."""
    this_update: datetime
    """Start of the validity, in UTC."""
    next_update: datetime
    """Expiry, in UTC."""
    revoked: Sequence[str]
    """Serial numbers of the revoked certificates, in hexadecimal."""


class KeystoreLists(NamedTuple):
    """The revocation lists of a keystore; with ``--refresh``, the newly signed lists."""

    keystore: NamedKeystore
    dry_run: DryRun
    number: int | None
    """Number of the list; null if the keystore has no list: it knows of no revocation."""
    this_update: datetime | None
    """Start of the list's validity, in UTC; null if there is no list."""
    next_update: datetime | None
    """Expiry of the list, in UTC; null if there is no list."""
    expires_soon: bool
    """Whether the list expires within 30 days, or within a third of its validity if this is
    shorter; then the exit status is 1.
    """
    revoked: Sequence[RevokedCertificate]
    """The revoked certificates."""
    other_lists: Sequence[OtherList]
    """The list of the other identity CA during a rotation."""
    restart: Sequence[str]
    """With ``--refresh``, the enclaves whose processes use the earlier list until they are
    restarted.
    """
    changes: FileChanges
    notes: Notes


def shown_lists(
    keystore: OpenedKeystore,
    refreshed_by: Changed | None,
    enclaves: Mapping[str, str],
    age_notes: Sequence[Note],
    *,
    expires_soon: bool,
    dry_run: bool,
) -> KeystoreLists:
    """Return what `crl --json` prints; ``enclaves`` maps serial numbers to enclaves.

    ``refreshed_by`` is the result of signing the list again, or None.  ``age_notes`` say that the
    keystore is older than its robots.
    """
    lists = keystore.revocation_lists
    first = lists[0] if lists else None
    return KeystoreLists(
        keystore.root,
        dry_run,
        first.number if first else None,
        first.this_update if first else None,
        first.next_update if first else None,
        expires_soon,
        [
            RevokedCertificate(serial, enclaves.get(serial) or None, entry.date, entry.reason)
            for entry in (first.revoked if first else ())
            for serial in (f"{entry.serial:x}",)
        ],
        [
            OtherList(
                subject_text(other_list.list.issuer),
                other_list.number,
                other_list.this_update,
                other_list.next_update,
                [f"{entry.serial:x}" for entry in other_list.revoked],
            )
            for other_list in lists[1:]
        ],
        restart=refreshed_by.restart if refreshed_by else (),
        changes=changes_below(keystore.root, refreshed_by.changes) if refreshed_by else (),
        notes=(*(refreshed_by.notes + refreshed_by.remarks if refreshed_by else ()), *age_notes),
    )


# ── rotate_ca ───────────────────────────────────────────────────────────────────────────────


class RotationState(NamedTuple):
    """The stage of the keystore, and its CAs."""

    stage: RotationStage
    """The stage that was reached."""
    next: RotationStage
    """The next stage."""
    enclaves: int
    """Number of enclaves in the keystore."""
    authorities: Sequence[AuthorityStatus]
    """The CAs that processes trust."""
    unconfirmed: Sequence[str] | None
    """The robots of the fleet that have not confirmed the stage; empty without a rotation or
    without a fleet, null if the fleet file was edited.
    """
    remarks: Sequence[str]
    """Next steps, as sentences."""


def shown_status(status: RotationStatus, unconfirmed: Sequence[str] | None) -> RotationState:
    """Return what `rotate_ca --status --json` prints.

    ``unconfirmed`` is None if the unconfirmed robots are not known.
    """
    return RotationState(
        status.rotation.stage,
        status.rotation.next_stage(),
        status.enclaves,
        status.authorities,
        unconfirmed,
        status.remarks,
    )


class RotationChange(NamedTuple):
    """The result of a rotation step."""

    keystore: NamedKeystore
    dry_run: DryRun
    stage: RotationStage
    """The stage that was reached."""
    authorities: Sequence[Annotated[str, Words(("identity_ca", "permissions_ca", "ca"))]]
    """The replaced CAs, by the names of their files in public/ without suffixes."""
    enclaves: Sequence[
        EnclaveResult[
            Annotated[
                str,
                Words(("reissued", "kept")),
                "`reissued`: its certificate and permissions are of the new CA; `kept`: they did "
                "not change.",
            ]
        ]
    ]
    """All enclaves of the keystore, with their outcomes."""
    old_keys_elsewhere: Sequence[str]
    """Places outside of the keystore with old CA keys; sros never deletes these keys."""
    cut_off: Sequence[str]
    """The robots of the fleet that have not confirmed the previous stage
    (``--allow-unconfirmed``). They cannot communicate with robots that have the files of this
    stage, until they also get these files.
    """
    remarks: Sequence[str]
    """Next steps, as sentences; empty in a dry run."""
    changes: FileChanges
    notes: Notes
