"""What ``--json`` prints of changes of a keystore: creation, renewal, revocation, update, rotation.

`shown` turns the result of a change into what is printed of it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Generic, NamedTuple, TypeVar

from sros_tool.errors import Note
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
from sros_tool.keystore.reader import Keystore
from sros_tool.pki.certificates import load_certificate, subject_text
from sros_tool.values import DryRun, FileChanges, NamedKeystore, Notes, Words, shows

if TYPE_CHECKING:
    from sros_tool.keystore.comparison import SettingChange
    from sros_tool.keystore.lifecycle.change import Changed
    from sros_tool.keystore.lifecycle.create import Creation
    from sros_tool.keystore.lifecycle.revoke import Revocation
    from sros_tool.keystore.lifecycle.rotation import (
        AuthorityStatus,
        RotationStage,
        RotationStatus,
    )
    from sros_tool.keystore.lifecycle.update import UpdateStage
    from sros_tool.pki.crl import RevocationList
    from sros_tool.zenoh.configuration import ZenohNetwork

Rights = Annotated[
    Sequence[ReplacedRights],
    "What enclaves gain and lose with their new permissions; enclaves without a change are left "
    "out.",
]
TrustRevoked = Annotated[
    Sequence[str],
    "Enclaves whose processes trust the revoked certificates until they are restarted.",
]


Form = TypeVar("Form", bound=tuple[Any, ...])


def shown(result: Changed, form: type[Form], **more: Any) -> Form:
    """Return what ``--json`` prints of a change: the keys of ``form``, from the result or ``more``.

    ``notes`` among ``more`` are added to those of the result.
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
    """Return what was done with enclaves; those that a dry run would write are not there yet."""
    keystore = Keystore(result.root)
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
    """Whether the keystore was created, too."""
    enclaves: Sequence[EnclaveResult[Outcome]]
    """The enclaves that were named, by what was done."""
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
    "The enclaves that were created, or existed.",
]
ChangedEnclave = Annotated[
    _EnclaveCreation[Annotated[str, Words(("changed",)), "Its permissions were replaced."]],
    "The enclave with its new permissions.",
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
    """Whether the CA existed before (``--identity-ca``, ``--permissions-ca``)."""


class NewKeystore(NamedTuple):
    """The new keystore."""

    keystore: NamedKeystore
    dry_run: DryRun
    template: str
    """Name of the template."""
    domains: str
    """The ROS domains of the keystore, such as ``0`` or ``10-19``."""
    authorities: Sequence[KeystoreAuthority]
    """Its CAs; one of both roles with ``--ca-layout single``."""
    changes: FileChanges
    notes: Notes


def shown_keystore(
    result: Creation, imported: Mapping[str, bytes], notes: Sequence[Note]
) -> NewKeystore:
    """Return what is printed of a new keystore; ``imported`` are certificates of CAs by role."""
    authorities = []
    separate = result.template.separate_authorities
    for roles in [(role,) for role in ROLES] if separate else [ROLES]:
        role, certificate = roles[0], None
        if not result.dry_run:
            certificate = Keystore(result.root).ca_certificate(role)
        elif role in imported:
            certificate = load_certificate(imported[role], f"of the {role} CA")
        authorities.append(KeystoreAuthority(authority_facts(roles, certificate), role in imported))
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
    """The network, as the keystore's settings have it afterwards."""

    router: str
    """The enclave of the router."""
    endpoints: Sequence[str]
    """Where sessions connect to the router."""
    listen: Sequence[str]
    """Where the router listens."""
    mode: Annotated[str, Words(("client", "peer"))]
    """Whether sessions also connect to each other (``peer``), or only to the router."""
    domains: Sequence[int]
    """The ROS domains."""


class ZenohFileState(NamedTuple):
    """A configuration."""

    enclave: str
    """The enclave."""
    path: Path
    """The file; the signed document is next to it."""
    current: bool
    """Whether it was there before with the same content and a valid signature."""


class KeystoreZenoh(NamedTuple):
    """The configurations of Zenoh of a keystore's enclaves."""

    keystore: NamedKeystore
    dry_run: DryRun
    network: NetworkSettings | None
    """The network, as the keystore's settings have it afterwards; null after ``--off``."""
    files: Sequence[ZenohFileState]
    """The file of the router, and one for each other enclave with rights."""
    created: Sequence[str]
    """Enclaves that were created: that of the router, if it did not exist."""
    restart: Sequence[str]
    """The enclaves whose processes have to be restarted, because their rules changed."""
    changes: FileChanges
    """The files that were written or, with ``--dry-run`` or ``--check``, would be."""
    notes: Notes


def shown_zenoh(
    result: Creation, network: ZenohNetwork | None, changed: Collection[str]
) -> KeystoreZenoh:
    """Return what is printed of the files of Zenoh; ``changed`` are the paths of new ones."""
    settings = None
    if network:
        settings = NetworkSettings(
            network.router,
            network.endpoints,
            network.listening(),
            network.mode.value,
            network.domains or tuple(result.domains),
        )
    files = [
        ZenohFileState(name, result.root / path, path not in changed)
        for name, path in result.zenoh.files.items()
    ]
    return shown(result, KeystoreZenoh, network=settings, files=files)


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
    """Last expiry of the replaced certificates, in UTC; null if they have expired or were
    revoked."""
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
    """The reason, as RFC 5280 spells it."""
    next_update: datetime
    """Expiry of the revocation list, in UTC."""
    restart: TrustRevoked
    restart_zenoh: RestartZenoh
    changes: FileChanges
    notes: Notes


class TemplateChange(NamedTuple):
    """The name of the template."""

    before: str
    """The one before."""
    after: str
    """The one after all stages."""


class UpdatedKeystore(NamedTuple):
    """What changed in the keystore."""

    keystore: NamedKeystore
    dry_run: DryRun
    needs_allow_looser: bool
    """Whether something becomes possible that was not, which ``--allow-looser`` has to allow."""
    template: TemplateChange
    """The name of the template."""
    done: Sequence[UpdateStage]
    """The stages that were carried out; empty if nothing was left to do."""
    left: Sequence[UpdateStage]
    """The stages that are left."""
    settings: Sequence[SettingChange]
    """The settings that change."""
    rights: Rights
    looser: Sequence[str]
    """Everything that becomes possible, settings and rights."""
    enclaves: Sequence[
        EnclaveResult[
            Annotated[
                str,
                Words(("renewed", "signed")),
                "`renewed`: a new certificate and new permissions; `signed`: new permissions only.",
            ]
        ]
    ]
    """The enclaves that were issued something."""
    replaced_work_until: datetime | None
    """Last expiry of the replaced certificates with their permissions, in UTC; null if none was
    replaced or all were revoked."""
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
    """Its serial number, in hexadecimal."""
    enclave: str | None
    """Its enclave, as the ledger has it; null if the ledger does not have it."""
    date: datetime
    """When it was revoked, in UTC."""
    reason: str
    """The reason, as RFC 5280 spells it."""


class OtherList(NamedTuple):
    """A revocation list of another CA."""

    issuer: str
    """The CA that signed it."""
    number: int
    """Its number."""
    this_update: datetime
    """Begin of its validity, in UTC."""
    next_update: datetime
    """End of its validity, in UTC."""
    revoked: Sequence[str]
    """Serial numbers of the revoked certificates, in hexadecimal."""


class KeystoreLists(NamedTuple):
    """The revocation lists of a keystore, after ``--refresh`` if it is given."""

    keystore: NamedKeystore
    dry_run: DryRun
    number: int | None
    """Number of the list; null if nothing was ever revoked."""
    this_update: datetime | None
    """Begin of its validity, in UTC; null as above."""
    next_update: datetime | None
    """End of its validity, in UTC; null as above."""
    expires_soon: bool
    """Whether it expires within 30 days: the exit status is 1."""
    revoked: Sequence[RevokedCertificate]
    """The revoked certificates."""
    other_lists: Sequence[OtherList]
    """The list of the other identity CA during a rotation."""
    restart: Sequence[str]
    """With ``--refresh``: enclaves whose processes have the earlier list until they are
    restarted."""
    changes: FileChanges
    notes: Notes


def shown_lists(
    root: Path,
    lists: Sequence[RevocationList],
    refreshed: Revocation | None,
    enclaves: Mapping[str, str],
    *,
    expires_soon: bool,
    dry_run: bool,
) -> KeystoreLists:
    """Return what is printed of revocation lists; ``enclaves`` names them by serial number."""
    first = lists[0] if lists else None
    return KeystoreLists(
        root,
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
                subject_text(other.list.issuer),
                other.number,
                other.this_update,
                other.next_update,
                [f"{entry.serial:x}" for entry in other.revoked],
            )
            for other in lists[1:]
        ],
        restart=refreshed.restart if refreshed else (),
        changes=changes_below(root, refreshed.changes) if refreshed else (),
        notes=(*refreshed.notes, *refreshed.remarks) if refreshed else (),
    )


# ── rotate_ca ───────────────────────────────────────────────────────────────────────────────


class RotationState(NamedTuple):
    """The stage of the keystore, and its CAs."""

    stage: RotationStage
    """The stage that was reached."""
    next: RotationStage
    """The next stage."""
    enclaves: int
    """Number of enclaves."""
    authorities: Sequence[AuthorityStatus]
    """The CAs that processes trust."""
    unconfirmed: Sequence[str] | None
    """The robots of the fleet that have not confirmed the stage; empty without a rotation or a
    fleet, null if the file of the fleet was edited."""
    remarks: Sequence[str]
    """What to do next."""


def shown_status(status: RotationStatus, unconfirmed: Sequence[str] | None) -> RotationState:
    """Return what is printed of a rotation; ``unconfirmed`` are robots, None if it is unknown."""
    return RotationState(
        status.rotation.stage,
        status.rotation.next_stage(),
        status.enclaves,
        status.authorities,
        unconfirmed,
        status.remarks,
    )


class RotationChange(NamedTuple):
    """What was done."""

    keystore: NamedKeystore
    dry_run: DryRun
    stage: RotationStage
    """The stage that was reached."""
    authorities: Sequence[Annotated[str, Words(("identity_ca", "permissions_ca", "ca"))]]
    """The CAs that are replaced: names of files in public/."""
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
    """All enclaves."""
    old_keys_elsewhere: Sequence[str]
    """Places of old CA keys outside of the keystore, which sros does not delete."""
    cut_off: Sequence[str]
    """The robots of the fleet that have not confirmed the stage before, and so cannot talk to the
    others until they get its files (``--allow-unconfirmed``)."""
    remarks: Sequence[str]
    """What to do next; empty in a dry run."""
    changes: FileChanges
    notes: Notes
