"""Creation of keystores and enclaves: CAs, governance, settings, keys and permissions.

Existing enclaves get their missing files and the permissions of new policies.  A policy can demand
a stricter governance than the keystore has.
"""

from __future__ import annotations

import hashlib
import os
from collections import ChainMap
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from shlex import quote
from types import MappingProxyType
from typing import Unpack

from cryptography import x509

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import Governance, parse_governance, render_governance
from sros_tool.dds.permissions import name_notes, parse_permissions
from sros_tool.errors import KeystoreError, Note, PolicyError, SrosError, UsageError, check_meaning
from sros_tool.fleet.expansion import FleetPolicy
from sros_tool.fleet.robots import Fleet, Robot, robot_of
from sros_tool.keystore.comparison import Mismatch, compare_governance, mismatch
from sros_tool.keystore.delivery.published import may_have_later_releases, read_published
from sros_tool.keystore.delivery.restored import (
    has_unpublished_restore,
    restores_after_last_release,
)
from sros_tool.keystore.expiry import IF_EXPIRED, ONE_BY_ONE
from sros_tool.keystore.fleet import (
    EnclaveDomains,
    enclaves_of_robot,
    fleet_before_change,
    fleet_edits_clause,
    former_robots_notes,
    left_enclaves,
    load_fleet,
    lost_enclaves,
    publish_command,
    refuse_stale_domains,
    revoke_command,
    unrecorded_notes,
)
from sros_tool.keystore.issuing.acceptance import imported_ca_notes
from sros_tool.keystore.issuing.authority import create_authorities, write_copies
from sros_tool.keystore.issuing.enclave import (
    EnclaveTokens,
    EnclaveWriter,
    Issuance,
    NewIdentity,
    StatedRights,
    default_rights,
    link_shared_files,
    present_files,
    stated_enclave,
)
from sros_tool.keystore.known_keys import (
    restored_at,
    revoked_serials,
    subjects_since_restore,
    without_policy_since_restore,
)
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    ENCLAVES,
    GOVERNANCE_FILE,
    GOVERNANCE_P7S,
    GOVERNANCE_XML,
    IDENTITY,
    KEY_FILE,
    KEY_FILES,
    PERMISSIONS_FILE,
    PRIVATE,
    PUBLIC,
    REQUEST,
    REVOKED,
    SETTINGS,
    enclave_path,
    is_keystore,
    key_on_robot,
    keystore_around,
    refuse_flat_keystore,
    remedy_in_closed_robot,
    similar_keystores,
)
from sros_tool.keystore.ledger import (
    BY_POLICY,
    ON_ROBOT_ONLY,
    PUBLISHING,
    RESTORED,
    Entry,
    certificate_entry,
    document_entry,
)
from sros_tool.keystore.lifecycle.change import Changed, ChangeOptions, KeystoreChange
from sros_tool.keystore.lifecycle.replaced import (
    ReplacedRights,
    SupersededCertificate,
    counterpart_notes,
    permissions_to_replace,
    replaced_rights,
    with_expiries_in_ledger,
)
from sros_tool.keystore.protection import unfulfilled_protections, with_stated_protections
from sros_tool.keystore.reader import OpenedKeystore, check_domain
from sros_tool.keystore.selection import missing_enclave_error
from sros_tool.keystore.settings import edit_remedy, find_edits, with_key_places, write_settings
from sros_tool.keystore.template import NODE_BASICS, Template, template_names
from sros_tool.keystore.transaction import recover_keystore
from sros_tool.names import check_enclave_name
from sros_tool.owners import closing_command, other_writers_clause, replaceable_on_the_way
from sros_tool.parallel import Progress
from sros_tool.pki import smime
from sros_tool.pki.certificates import (
    common_name_of,
    enclave_subject,
    has_unique_part,
    issued_by,
    other_issuer_text,
    parse_subject,
    subject_text,
    validity_of,
)
from sros_tool.pki.keys import generate_key, load_key
from sros_tool.pki.token import (
    TokenKey,
    TokenUri,
    open_enclave_key,
    place_in_file,
    token_notes,
    token_places,
)
from sros_tool.policy.model import Enclave, Level, Policy, StatedProtection, stated_protections
from sros_tool.translate import governance_for
from sros_tool.validity import Window, iso, parse_iso, window
from sros_tool.wording import first_few
from sros_tool.xml import read_bytes
from sros_tool.zenoh.configuration import check_network

_NONE_IMPORTED: Mapping[str, bytes] = MappingProxyType({})


@dataclass(frozen=True, slots=True, kw_only=True)
class Creation(Changed):
    """The result of creating a keystore or enclaves.

    ``outcomes`` has enclaves that were created, changed (with new permissions), completed (with
    missing files) and kept.  ``restart`` are the enclaves whose processes still trust revoked
    certificates, or still use the old governance or old Zenoh rules.
    """

    template: Template = field(repr=False)
    domains: DomainSet = field(repr=False)
    new_keystore: bool = False

    @property
    def created(self) -> tuple[str, ...]:
        """The new enclaves."""
        return self.names("created")

    @property
    def changed(self) -> tuple[str, ...]:
        """The enclaves with new permissions."""
        return self.names("changed")

    @property
    def completed(self) -> tuple[str, ...]:
        """The enclaves that got missing files."""
        return self.names("completed")

    @property
    def kept(self) -> tuple[str, ...]:
        """The enclaves without changes."""
        return self.names("kept")


def create_keystore(
    root: Path,
    *,
    template: Template,
    domains: DomainSet | None = None,
    imported_cas: Mapping[str, bytes] = _NONE_IMPORTED,
    **options: Unpack[ChangeOptions],
) -> Creation:
    """Create a keystore for ``domains`` (default: 0) from ``template``.

    ``imported_cas`` maps roles ("identity", "permissions") to the PEM certificates of existing CAs,
    whose keys are opened with the keyring in ``options``.

    Raises:
        KeystoreError: ``root`` has a keystore or parts of a keystore, because enclaves of an older
            CA would not work with a new CA.
    """
    if not options.get("dry_run"):
        recover_keystore(root)
    _check_not_keystore(root)
    with KeystoreChange(root, new_keystore=True, **options) as change:
        domains = domains or DomainSet.of((0, 0))
        _write_keystore(change, template, domains, imported_cas)
        change.record()
        change.notes += change.authorities.notes
        # A CA service would issue a certificate for the example.
        if imported_cas and not change.identity.service:
            change.notes += imported_ca_notes(
                change.transaction, template, change.authorities, domains, change.now
            )
            if IDENTITY in imported_cas:
                change.notes.append(_OWN_LIST_NOTE)
        change.transaction.commit()
    change.notes += _folder_owner_notes(root)
    return change.result(Creation, template=template, domains=domains, new_keystore=True)


_OWN_LIST_NOTE = Note(
    "keystore.own-list",
    "this keystore has its own revocation list, which lacks the revocations of other keystores or "
    "programs with the same identity CA; their lists lack the revocations of this keystore",
)


def create_enclaves(
    root: Path,
    names: Sequence[str],
    *,
    domain: int | None = None,
    key: str = "",
    progress: Progress | None = None,
    **options: Unpack[ChangeOptions],
) -> Creation:
    """Create enclaves with the default permissions of the keystore's template.

    An existing enclave keeps its key and its permissions, and gets its missing files.  ``domain``
    is the caller's ROS_DOMAIN_ID; the governance must name it.  ``key`` is the ``pkcs11:`` URI of
    the key, which is created on the token if it does not exist.  If the URI has no ``object``, the
    key's label is the name of the enclave.
    """
    return generate_artifacts(
        root,
        enclaves=names,
        domain=domain,
        key=key,
        progress=progress,
        **options,
    )


def create_permission(
    root: Path,
    names: Sequence[str],
    policy: Policy | FleetPolicy,
    *,
    domain: int | None = None,
    revoke_old: bool = False,
    keep_same: bool = False,
    **options: Unpack[ChangeOptions],
) -> Creation:
    """Replace the permissions of existing enclaves with their rights in ``policy``, all or none.

    Whoever kept the replaced permissions can use them until they expire, unless ``revoke_old`` is
    set: then the enclaves get new certificates for the same keys, and all earlier certificates are
    revoked.  With ``keep_same``, permissions that state the same rights are kept, as by
    `generate_artifacts`.  If ``policy`` is for a fleet, the permissions are for the domains of the
    enclaves' robots.  ``domain`` is as for `create_enclaves`.

    Raises:
        KeystoreError: an enclave does not exist; the fleet of the policy and the keystore's fleet
            have a robot in different domains.
    """
    for name in names:
        check_enclave_name(name)
    change = KeystoreChange(root, **options)
    with change:
        existing = frozenset(change.names)
        for name in names:
            if name not in existing:
                raise missing_enclave_error(change.keystore, name, existing)
        stated: Mapping[str, Enclave]
        robots: dict[str, Robot] = {}
        if isinstance(policy, FleetPolicy):
            stated = policy
            for name in names:
                if name in policy and (robot := policy.stated_enclave(name)[1]):
                    robots[name] = robot
            policy = policy.policy()
        else:
            stated = {enclave.path: enclave for enclave in policy.enclaves}
        wanted = {name: stated.get(name) or stated_enclave(policy, name) for name in names}
        _prepare_change(change, domain, protections=stated_protections(wanted.values()))
        rights = write_enclaves(
            change,
            wanted,
            revoke_old=revoke_old,
            keep_same=keep_same,
            stated_robots=robots,
        )
    return creation(change, rights)


def generate_artifacts(
    root: Path,
    *,
    enclaves: Sequence[str] = (),
    policies: Sequence[Policy | FleetPolicy] = (),
    domain: int | None = None,
    create: Template | None = None,
    domains: DomainSet | None = None,
    revoke_old: bool = False,
    key: str = "",
    progress: Progress | None = None,
    **options: Unpack[ChangeOptions],
) -> Creation:
    """Create the named enclaves and the enclaves of policies, with permissions, all or nothing.

    If a policy names an existing enclave, the enclave's permissions are replaced, and with
    ``revoke_old`` also its certificate, as by `create_permission`.  Permissions that state the same
    rights and do not expire soon are kept (`EnclaveWriter.would_change_only_dates`).  With
    ``revoke_old``, this requires that no other permissions fit the certificate.  ``domain`` and
    ``key`` are as for `create_enclaves`.  The protection of
    each name is raised to the level that the policies demand.  If the keystore does not exist and
    ``create`` is given, it is created from that template.

    All policies for a fleet must be for the same fleet, which the keystore records.  A new keystore
    is for ``domains``, or else for the domains of the robots.

    Raises:
        KeystoreError: a policy names a revoked enclave that ``enclaves`` does not name, or a robot
            is in a domain that the keystore does not have.
    """
    wanted = _rights_by_enclave(enclaves, policies)
    protections = stated_protections(_enclaves_with_protection(policies))
    for_fleet = [policy for policy in policies if isinstance(policy, FleetPolicy)]
    fleet = for_fleet[0].fleet if for_fleet else None
    patterns = [pattern for policy in for_fleet for pattern in policy.patterns]
    places = token_places(key, list(wanted)) if key else {}
    if not options.get("dry_run"):
        recover_keystore(root)
    new_keystore = create is not None and not is_keystore(root)
    if new_keystore:
        _check_typo(root)
        _check_not_keystore(root)
    change = KeystoreChange(root, new_keystore=new_keystore, **options)
    if create is None or not new_keystore:
        with change:
            _prepare_change(change, domain, fleet, patterns, wanted, protections)
            notes = _revoked_before_notes(change, wanted, enclaves, fleet)
            ended = dict(_expired_enclaves(change, wanted.keys() - {*enclaves}))
            notes = [*notes, *ended.values()]
            if ended:
                wanted = {name: wanted[name] for name in wanted if name not in ended}
            rights = write_enclaves(
                change,
                wanted,
                revoke_old=revoke_old,
                keep_same=True,
                places=places,
                progress=progress,
            )
        change.notes = [*notes, *change.notes]
        return creation(change, rights)
    domains = domains or _domains_of(fleet, domain)
    check_domain(domains, domain, root)
    create = replace(create, protection=with_stated_protections(create.protection, protections))
    with change:
        _write_keystore(change, create, domains, _NONE_IMPORTED)
        if fleet:
            change.write_fleet(fleet, patterns)
        write_enclaves(change, wanted, places=places, progress=progress)
    change.notes += _folder_owner_notes(root)
    return creation(change, ())


def _expired_enclaves(change: KeystoreChange, names: Iterable[str]) -> Iterator[tuple[str, Note]]:
    """Yield expired, short-lived enclaves, each with a note that nobody has to renew it."""
    for name in sorted(names):
        path = change.keystore.folder(name) / CERTIFICATE_FILE
        if change.template.longest_validity(name) is None or not path.exists():
            continue
        end = validity_of(change.keystore.certificate(path)).not_after
        if end < change.now:
            text = (
                f"{name} does not change: it is short-lived ([[enclaves]] in sros.toml), and "
                f"expired at {iso(end)}. First renew it with `sros renew "
                f"{quote(str(change.root))} {quote(name)}`, then repeat this command."
            )
            yield name, Note("enclave.expired-short-lived", text)


def creation(change: KeystoreChange, rights: tuple[ReplacedRights, ...]) -> Creation:
    """Return the result of a change that created or changed enclaves."""
    change.notes += unrecorded_notes(change.keystore, change.fleet, change.outcomes)
    change.notes += _keys_made_here_notes(change)
    return change.result(
        Creation,
        rights=rights,
        template=change.template,
        domains=change.domains,
        new_keystore=change.is_new,
    )


def _keys_made_here_notes(change: KeystoreChange) -> Iterator[Note]:
    """Yield a note on new keys for robots whose other keys were all made on the robot."""
    fleet, keystore = change.fleet, change.keystore
    if not fleet:
        return
    created: dict[str, list[str]] = {}
    for name, outcome in change.outcomes.items():
        if outcome == "created" and (robot := robot_of(fleet, name)):
            created.setdefault(robot.name, []).append(name)
    made_here: list[str] = []
    for robot_name, names in created.items():
        existing = enclaves_of_robot(keystore, fleet, fleet.robots[robot_name])
        others = [keystore.folder(name) for name in existing if name not in names]
        if others and all(map(key_on_robot, others)):
            made_here += names
    if made_here:
        is_one = len(made_here) == 1
        key, its, it = ("key", "its robot", "it") if is_one else ("keys", "their robots", "them")
        yield Note(
            "enclave.key-made-here",
            f"the keystore machine makes the {key} of {first_few(sorted(made_here), _MOST_SHOWN)}, "
            f"but {its} made all other keys. To have {it} made there, too, revoke "
            f"{it} with {revoke_command(keystore, sorted(made_here))}, run `sros create_request` "
            "on the robot, and pass the request to `sros sign_request "
            f"{quote(str(keystore.root))} REQUEST --no-answer -p POLICY_FILE --fleet FLEET_FILE "
            f"--enclave {made_here[0] if is_one else 'ENCLAVE'}` (docs/howto/own_keys.md: New "
            "enclaves).",
        )


def _enclaves_with_protection(policies: Sequence[Policy | FleetPolicy]) -> Iterator[Enclave]:
    """Yield the enclaves of the policies; fleet policies count only if they state protection."""
    for policy in policies:
        if not isinstance(policy, FleetPolicy):
            yield from policy.enclaves
        elif policy.protects:
            yield from policy.values()


def _domains_of(fleet: Fleet | None, domain: int | None) -> DomainSet:
    """Return the domains of a new keystore.

    These are the stated domains of the robots, and ``domain`` if it is given.  If a robot states no
    domain, or if there are no robots, the domain 0 is added unless ``domain`` is given.
    """
    robots = fleet.robots.values() if fleet else ()
    named = {robot.domain for robot in robots if robot.domain is not None}
    if not named or domain is not None or any(robot.domain is None for robot in robots):
        named.add(domain or 0)
    return DomainSet.of(*((number, number) for number in named))


def _revoked_before_notes(
    change: KeystoreChange, wanted_names: Iterable[str], named: Collection[str], fleet: Fleet | None
) -> list[Note]:
    """Return a note for each revoked enclave that is created again because it is ``named``.

    Raises:
        KeystoreError: an enclave is not named, but still in a policy, and was revoked, or got a
            certificate after the backup from which the keystore was restored, or may have got one.
    """
    existing, known, root = frozenset(change.names), change.known, change.root
    missing = [name for name in wanted_names if name not in existing]
    revoked = known.enclaves_revoked_before(missing) if missing else ()
    revoked_before = [name for name in missing if name in revoked]

    def command(names: Sequence[str]) -> str:
        return (
            f"`sros generate_artifacts -k {quote(str(root))} -e {' '.join(names)} -p POLICY_FILE"
            f"{' --fleet FLEET_FILE' if fleet else ''}`"
        )

    if unasked := [name for name in revoked_before if name not in named]:
        them, keys = ("it", "a new key") if len(unasked) == 1 else ("them", "new keys")
        on_robots = _names_with_keys_made_on_robots(change, unasked)
        steps = []
        if here := [name for name in unasked if name not in on_robots]:
            named = "them" if len(here) > 1 else here[0] if on_robots else "it"
            steps.append(f"name {named} with -e: {command(here)}")
        if on_robots:
            options = " ".join(f"--enclave {quote(name)}" for name in on_robots)
            steps.append(
                f"for {first_few(on_robots, 3)}, whose keys were made on the robot, remove the "
                "folder of each enclave on the robot (its key is revoked), run `sros "
                "create_request` there, and pass all these requests to `sros sign_request "
                f"{quote(str(root))} - --no-answer -p POLICY_FILE"
                f"{' --fleet FLEET_FILE' if fleet else ''} {options}`"
            )
        raise KeystoreError(
            f"a policy names {', '.join(unasked)}, revoked in keystore '{root}'",
            f"The policy would create {them} again, and `distribute_key --all` would export "
            f"{them}.",
            f"Remove {them} from the policy{' or the robot from the fleet file' if fleet else ''}; "
            f"or, to create {them} again with {keys} and the rights of the policy, "
            f"{'; '.join(steps)}.",
        )
    routers = _missing_routers(change).difference(missing)
    missing += sorted(routers)
    later = _enclaves_certified_after_backup(change, missing) - {*revoked_before, *named}
    if unasked := [name for name in missing if name in later]:
        raise KeystoreError(
            f"the keystore '{root}' lacks {first_few(unasked, 3)}, which got certificates after "
            "the last backup",
            "If a robot made its own key for such an enclave, it could not use files for a new key "
            "from here.",
            "For keys that robots made, sign the requests again, with `sros sign_request "
            f"{quote(str(root))} REQUEST --no-answer -p POLICY_FILE"
            f"{' --fleet FLEET_FILE' if fleet else ''}`"
            f"{' (for a router, without -p and --fleet)' * bool(routers.intersection(unasked))}. "
            "For keys that were made here, name the "
            f"enclaves with -e, so that they get new keys: {command(unasked)}. Then repeat this "
            "command.",
        )
    if unasked := [name for name in missing if name not in named]:
        _refuse_before_restored(change.keystore, unasked, command(unasked))
    return list(known.revoked_before_notes(revoked_before))


def _missing_routers(change: KeystoreChange) -> set[str]:
    """Return the enclaves of the Zenoh network's routers that the keystore lacks."""
    network = change.template.zenoh
    return {*(network.router_names() if network else ())}.difference(change.names)


def _refuse_before_restored(keystore: OpenedKeystore, missing: Sequence[str], command: str) -> None:
    """Raise `KeystoreError` if robots may have made the keys of the enclaves ``missing``.

    Once ``--restored`` has read the later releases, the ledger has their certificates.  If no
    folder has later releases any more, nothing shows these certificates.  ``command`` creates the
    enclaves all the same.
    """
    restores = restores_after_last_release(keystore)
    has_later_releases = may_have_later_releases(keystore)
    is_settled = PUBLISHING in restores if has_later_releases else not restores
    if is_settled:
        return
    policy_clause = (
        f"The policy would create {first_few(missing, 3)} with new keys, but a robot may have made "
        "the keys of such an enclave after the backup."
    )
    root, folder = quote(str(keystore.root)), read_published(keystore).folder
    if has_later_releases:
        raise KeystoreError(
            f"'{folder}' has later metadata than the keystore '{keystore.root}' knows",
            f"The keystore was restored from a backup, or is a copy. {policy_clause}",
            f"First run `sros fleet publish {root} {quote(folder)}`, which puts altered metadata "
            "right, or says what to do after a restore.",
        )
    # Without publishing, nothing would ever end this refusal.
    if folder or has_unpublished_restore(keystore):
        raise KeystoreError(
            f"the keystore '{keystore.root}' is older than its robots",
            f"Robots have files that it signed but does not know. {policy_clause}",
            f"For keys that robots made, sign the requests again, with `sros sign_request {root} "
            "REQUEST --no-answer -p POLICY_FILE --fleet FLEET_FILE`. For keys that are to be made "
            f"here, name the enclaves with -e: {command}. Then repeat this command.",
        )


def _names_with_keys_made_on_robots(change: KeystoreChange, names: Sequence[str]) -> list[str]:
    """Return the revoked enclaves in ``names`` whose last key was made on the robot."""
    entries = change.keystore.ledger_file.with_values("enclave", names).entries
    serials = {entry.enclave: entry.serial for entry in entries if entry.what == "certificate"}
    return [
        name
        for name in names
        if name in serials and key_on_robot(change.root / REVOKED / serials[name])
    ]


def _enclaves_certified_after_backup(
    change: KeystoreChange, missing: Sequence[str]
) -> frozenset[str]:
    """Return the enclaves in ``missing`` that got a valid certificate after the last backup.

    The ledger does not record certificates of a CA that the keystore has lost, only their enclaves.
    """
    if not missing:
        return frozenset()
    marks = change.keystore.entries_of(RESTORED)
    on_robots = {mark.enclave for mark in marks if mark.reason == ON_ROBOT_ONLY}
    certified = on_robots.intersection(missing)
    if restored_at(change.keystore):
        shown = change.known.certificates_shown_after_restore(missing)
        certified |= {entry.enclave for entry in shown if entry.not_after > iso(change.now)}
    return frozenset(certified)


def refuse_other_template(root: Path, template: Template) -> None:
    """Raise `UsageError` if the existing keystore ``root`` was made from another template."""
    present = OpenedKeystore(root).template
    named = template.name == present.name and template.name in template_names()
    plain = replace(template, name=present.name, description=present.description)
    if not (named or with_key_places(plain, present) == present):
        where = quote(str(root))
        raise UsageError(
            f"keystore '{root}' already exists, with the template {present.name}",
            f"--template {template.name} would have no effect on it.",
            f"Leave --template out, or run `sros update_keystore {where} --template "
            f"{quote(template.name)} --dry-run`, which shows the changes, and run it again without "
            "--dry-run.",
        )


class _StatedEnclaves(Mapping[str, Enclave | None]):
    """Maps enclaves to their rights in policies; policies for a fleet are expanded when needed."""

    def __init__(self, sources: Mapping[str, Mapping[str, Enclave] | None]) -> None:
        self._sources = sources

    def __getitem__(self, name: str) -> Enclave | None:
        source = self._sources[name]
        return source[name] if source is not None else None

    def __contains__(self, name: object) -> bool:
        return name in self._sources

    def __iter__(self) -> Iterator[str]:
        return iter(self._sources)

    def __len__(self) -> int:
        return len(self._sources)


def _rights_by_enclave(
    names: Sequence[str], policies: Sequence[Policy | FleetPolicy]
) -> Mapping[str, Enclave | None]:
    """Map enclaves to their rights in the policies; None for an enclave without a policy.

    Raises:
        PolicyError: two policies state different rights for an enclave.
    """
    sources: dict[str, Mapping[str, Enclave] | None] = {
        check_enclave_name(name): None for name in names
    }
    for policy in policies:
        stated: Mapping[str, Enclave] = (
            policy
            if isinstance(policy, FleetPolicy)
            else {enclave.path: enclave for enclave in policy.enclaves}
        )
        for name in stated:
            other = sources.get(name)
            if other is not None and (first := other[name]) != (second := stated[name]):
                raise PolicyError(
                    f"the enclave {name} is in two policies that differ",
                    f"It is at {first.source} and at {second.source}.",
                    "Merge them into one policy, for example with `sros merge_policy`.",
                )
            sources[name] = stated
    return _StatedEnclaves(sources)


# ── the keystore ───────────────────────────────────────────────────────────────────────────


def _prepare_change(
    change: KeystoreChange,
    domain: int | None,
    fleet: Fleet | None = None,
    patterns: Sequence[str] = (),
    stated: Collection[str] = (),
    protections: Sequence[StatedProtection] = (),
) -> None:
    """Prepare an existing keystore for new enclaves and permissions.

    Args:
        change: the change of the keystore.
        domain: a domain that the governance must name; None for any.
        fleet: the fleet to stage as the keystore's fleet; None for no change.
        patterns: the paths of enclaves in policies for the fleet.
        stated: the enclaves that get the permissions of a policy.
        protections: the protection that policies demand; a governance with less protection is
            changed.
    """
    change.begin_issuing(domain)
    if fleet is not None:
        before = fleet_before_change(change.keystore)
        recorded = change.write_fleet(fleet, patterns)
        refuse_stale_domains(
            change.keystore, EnclaveDomains(change.domains, before), recorded, stated
        )
        entries: list[Entry] = []
        if before:
            notes, entries = lost_enclaves(change.keystore, before, recorded, change.now)
            change.notes += notes
            change.entries += entries
        if fleet_edits_clause(change.keystore, change.keystore.ledger_with("what", "fleet")):
            noted = {entry.enclave for entry in entries}
            if before:
                noted |= left_enclaves(change.keystore, recorded, change.now).keys()
            change.notes += former_robots_notes(change.keystore, recorded, noted)
    if protections:
        _raise_protection(change, protections)


def _write_keystore(
    change: KeystoreChange,
    template: Template,
    domains: DomainSet,
    imported_cas: Mapping[str, bytes],
) -> None:
    """Stage a new keystore: its CAs, its governance and its settings."""

    _check_not_keystore(change.root)  # another process may have created it in the meantime
    if template.zenoh:
        check_network(template.zenoh)
    for span in (template.certificate_validity, template.permissions_validity):
        window(change.now, span)  # raises an error if the CAs could not issue anything
    change.template, change.domains, change.fleet = template, domains, None
    authorities = create_authorities(
        change.transaction, template, change.keyring, change.now, imported_cas
    )
    change.authorities = authorities
    change.identity, change.permissions = authorities.identity, authorities.permissions
    distinct = dict.fromkeys((authorities.identity, authorities.permissions))
    change.entries += (certificate_entry(change.now, "ca", ca.certificate) for ca in distinct)
    write_governance(change, governance_for(template.protection, domains), names=())
    settings = change.keyring.settings_with_places(template)
    change.entries.append(write_settings(change.transaction, settings, change.now))


def _check_not_keystore(root: Path) -> None:
    """Raise `KeystoreError` if a new keystore cannot be created at ``root``."""
    if is_keystore(root):
        raise _already_exists_error(root)
    refuse_flat_keystore(root)
    # Unlike Path.resolve, realpath does not fail for circular links.
    if os.path.realpath(root) == "/":
        raise KeystoreError(
            "the root of the file system cannot be a keystore", "", "Choose another path."
        )
    if around := keystore_around(root):
        raise KeystoreError(
            f"'{root}' is in the keystore '{around}'",
            "Two keystores would share a folder.",
            "Choose another path.",
        )
    if os.path.lexists(root) and not root.is_dir():
        raise KeystoreError(
            f"'{root}' is in the way", "It is not a folder.", "Choose another path."
        )
    remains = [part for part in (PUBLIC, PRIVATE, ENCLAVES) if (root / part).exists()]
    if remains:
        if is_keystore(root):  # another process has just created it
            raise _already_exists_error(root)
        raise KeystoreError(
            f"'{root}' already contains parts of a keystore",
            f"It has {', '.join(remains)}; with a new CA, every enclave that trusts the old CA "
            "would be locked out.",
            "Restore the missing files, or choose another path.",
        )


def _folder_owner_notes(root: Path) -> Iterator[Note]:
    """Yield a note if users other than the present one and root can replace a new keystore."""
    trusted = frozenset({0, os.geteuid()})
    replaceable = list(replaceable_on_the_way(root, trusted))
    if root.exists() and (why := other_writers_clause(root.stat(), trusted)):
        replaceable.append((root, why))
    for folder, why in replaceable[-1:]:
        yield Note(
            "keystore.replaceable",
            f"other users can put another keystore in the place of '{root}', because they can "
            f"change '{folder}': {why}. Run `{closing_command(folder, trusted)}`, or move the "
            "keystore to a folder that only you and root can change.",
        )


def _already_exists_error(root: Path) -> KeystoreError:
    return KeystoreError(
        f"keystore '{root}' already exists",
        "",
        "Nothing was changed. Add to it with `sros create_enclave`, or choose another path.",
    )


def _check_typo(root: Path) -> None:
    """Raise `UsageError` if a keystore's name looks like a typo of a sibling keystore's name."""
    for similar in similar_keystores(root):
        raise UsageError(
            f"'{root}' does not exist, and '{similar.name}' next to it is a keystore",
            "The name may be a typo, so no second keystore is created.",
            f"Name '{similar}', or run `sros create_keystore {quote(str(root))}` first.",
        )


_MOST_SHOWN = 5


def write_governance(
    change: KeystoreChange, governance: Governance, *, names: Sequence[str]
) -> None:
    """Sign, stage and record ``governance``, which was made from the keystore's settings.

    Enclaves in ``names`` that have a copy of the document instead of a link also get the new
    document.
    """
    document, label = render_governance(governance), "the governance document"
    check_meaning(parse_governance(document), governance, label)
    message = change.permissions.sign(document, label)
    change.transaction.write(GOVERNANCE_XML, document)
    change.transaction.write(GOVERNANCE_P7S, message)
    # The folder of the enclave / has the governance of the keystore itself.
    below = [name for name in names if name != "/"]
    write_copies(change.transaction, below, GOVERNANCE_FILE, message)
    change.entries.append(document_entry(change.now, "governance", message))


def _raise_protection(
    change: KeystoreChange, stated_protections: Sequence[StatedProtection]
) -> None:
    """Stage a governance and settings with more protection, if policies demand more.

    ``stated_protections`` is the protection of names that policies state.

    Raises:
        PolicyError: the statements contradict each other, or contradict the settings.
        KeystoreError: the keystore has no settings for the protection, or its files were edited by
            hand.
    """
    root, template, governance = change.root, change.template, change.governance
    protection = with_stated_protections(template.protection, stated_protections)
    less = [demanded for demanded, _ in unfulfilled_protections(governance, stated_protections)]
    if not less:
        return
    demand = f"{less[0].source} demands that {less[0]} has protect={less[0].word!r}"
    if not (root / SETTINGS).exists():
        raise KeystoreError(
            f"{demand}, and keystore '{root}' has no settings for that",
            f"A keystore of ros2/sros2 has no {SETTINGS}.",
            f"Give it settings first: `sros update_keystore {quote(str(root))} --template "
            "NAME|FILE --dry-run` shows what they would change.",
        )
    if edits := find_edits(change.keystore, governance):
        raise KeystoreError(
            f"{demand}, and files of keystore '{root}' were edited by hand: "
            f"{'; '.join(edits.clauses())}",
            "It is unclear which governance to start from.",
            f"First apply or undo the edit: {edit_remedy(root)}",
        )
    change.template = replace(template, protection=protection)
    after = governance_for(protection, governance.domains().closed())
    write_governance(change, after, names=change.names)
    change.entries.append(write_settings(change.transaction, change.template, change.now))
    demanded = [f"{name} {name.word} ({name.source})" for name in less]
    changes = compare_governance(governance, after)
    text = (
        f"The governance of the keystore changes, because policies demand it: "
        f"{first_few(demanded, _MOST_SHOWN)}. "
        f"Changes: {'; '.join(dict.fromkeys(change.meaning for change in changes[:_MOST_SHOWN]))}."
    )
    change.restart = change.names
    change.remarks += (
        Note("keystore.governance-by-policy", text),
        restart_note(mismatch(governance, after)),
        exports_note(change.keystore, change.names),
        Note(
            "keystore.earlier-governance",
            "The signature of the former governance stays valid: anyone who can change the files "
            "of a robot can put this governance back there, until the CA that signed it is "
            "replaced (`sros rotate_ca --help`).",
        ),
        *_zenoh_notes(template),
    )


def refuse_less_protected(
    keystore: OpenedKeystore, governance: Governance, stated_protections: Sequence[StatedProtection]
) -> None:
    """Raise `KeystoreError` if a policy demands more protection than the governance gives.

    This check is for signing requests, where the governance must not change, because all robots
    would need the new governance.
    """
    root = keystore.root
    for name, level in unfulfilled_protections(governance, stated_protections):
        kinds = "data=ENCRYPT" if name.level is Level.ENCRYPT else "metadata=SIGN"
        raise KeystoreError(
            f"{name.source} demands that {name} has protect={name.word!r}, and keystore '{root}' "
            f"protects it with {level}",
            "Its governance has to change first, and with it the files of all enclaves.",
            f"Run `sros update_keystore {quote(str(root))} --rule "
            f"{quote(f'{name} {kinds}')} --dry-run`, and then without --dry-run.",
        )


def _zenoh_notes(template: Template) -> tuple[Note, ...]:
    """Return a note on protection by Zenoh, if the keystore has a Zenoh network."""
    if template.zenoh is None:
        return ()
    text = (
        "Zenoh has no protection of single names: its links are TLS, so all names are encrypted "
        "on each link, and each router reads what it passes on."
    )
    return (Note("keystore.protection-on-zenoh", text),)


def restart_note(mismatch: Mismatch, *, revoked: bool = False) -> Note:
    """Return a note on which processes to restart, and in which order.

    ``mismatch`` is the communication that fails between old and new processes.  ``revoked`` says
    that certificates were revoked.
    """
    return Note("keystore.restart", _restart_text(mismatch, revoked=revoked))


def _restart_text(mismatch: Mismatch, *, revoked: bool) -> str:
    if revoked and not mismatch.everything:
        return (
            "All vendors: restart all processes together; restarted processes refuse the revoked "
            "certificates of other processes. Until then, running processes communicate as before."
        )
    if mismatch:
        which, where, more = "all processes together", "", ""
        if not mismatch.everything:
            which = f"together the processes that use {', '.join(mismatch.names)}"
            where, more = "on these names, but on no others, ", f" {IF_EXPIRED}"
        return (
            f"Cyclone DDS and Fast DDS: restart {which}; {where}restarted processes do not "
            "communicate with processes that were not restarted. Until then, running processes "
            f"communicate as before.{more}"
        )
    return f"All vendors: {ONE_BY_ONE} Until its restart, a process keeps its former files."


def exports_note(keystore: OpenedKeystore, names: Sequence[str]) -> Note:
    """Return a note that robots need new files, with the commands that deliver them."""
    if published := publish_command(keystore.root):
        text = (
            f"Robots have the former files: publish the new ones ({published}); if nodes run from "
            "an export, export the enclaves again."
        )
        return Note("keystore.export-again", text)
    shown = quote(str(keystore.root))
    text = "Robots have the former files: export the enclaves again (`sros distribute_key "
    text += f"{shown} ENCLAVE TARGET --force`)"
    remote = [name for name in names if key_on_robot(keystore.folder(name))]
    if remote:
        text += f"; if the key was made on the robot, as for {', '.join(remote)}, answer the "
        text += f"request again (`sros sign_request {shown} REQUEST --renew`)"
    return Note("keystore.export-again", remedy_in_closed_robot(keystore.root, f"{text}."))


_KEY_OR_REQUEST_FILES = {*KEY_FILES, REQUEST}


def write_enclaves(
    change: KeystoreChange,
    wanted_enclaves: Mapping[str, Enclave | None],
    *,
    revoke_old: bool = False,
    keep_same: bool = False,
    places: Mapping[str, TokenUri] = MappingProxyType({}),
    stated_robots: Mapping[str, Robot] = MappingProxyType({}),
    progress: Progress | None = None,
) -> tuple[ReplacedRights, ...]:
    """Create or complete enclaves, sign the permissions by their policies, and commit the change.

    In a keystore with a Zenoh network, the enclaves of its routers are created, too.

    Args:
        change: the change of the keystore.
        wanted_enclaves: maps enclaves to their policies, or to None.
        revoke_old: also replace and revoke the certificates of enclaves that get other permissions.
        keep_same: keep permissions that already state the rights of a policy.
        places: maps enclaves to the places of new keys on tokens; other new keys are in files.
        stated_robots: as in `EnclaveDomains`.
        progress: called with the name of each enclave that is done.

    Returns: The rights that enclaves gain and lose with their new permissions.
    """
    if routers := _missing_routers(change):
        wanted_enclaves = ChainMap(dict.fromkeys(sorted(routers)), wanted_enclaves)  # type: ignore[arg-type]
    writer = change.writer(keys_on_token=bool(places), revoke_old=revoke_old)
    maker = _EnclaveMaker(
        change,
        writer,
        change.tokens(places),
        wanted_enclaves,
        EnclaveDomains(change.domains, change.fleet, stated_robots),
        revoke_old=revoke_old,
        keep_same=keep_same,
    )
    done = writer.for_each(
        list(wanted_enclaves), lambda name: maker.make(name, wanted_enclaves[name]), progress
    )
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
        *_other_files_notes(done),
        *(writer.notes if writer.entries else ()),
        *(() if change.template.unique_subject else name_notes({*change.names, *created}, created)),
        *change.notes,
    ]
    superseded = [made.superseded for made in done.values() if made.superseded]
    change.revoke_superseded(superseded)
    change.stage_zenoh(
        writer.signed,
        replaced=[old.name for old in superseded],
        stated=wanted_enclaves,
        created=created,
    )
    change.record()
    replaced = [made.replaced for made in done.values() if made.replaced]
    new = (wanted_enclaves[name] or _default_rights(change.template, name) for name in created)
    change.notes += counterpart_notes(change.keystore, replaced, new)
    if not revoke_old:
        replaced = [*with_expiries_in_ledger(change.keystore, replaced, change.now)]
    change.finish(command="replace the permissions" if superseded else "")
    return tuple(replaced)


@dataclass(frozen=True, slots=True)
class _EnclaveOutcome:
    """The outcome for an enclave; ``superseded`` is the old certificate if it must be revoked.

    ``other_files`` is the reason why the certificate was replaced although the rights stay the
    same: other files of the enclave may still work.  It is "" for any other outcome.
    """

    outcome: str
    notes: tuple[Note, ...]
    replaced: ReplacedRights | None = None
    superseded: SupersededCertificate | None = None
    other_files: str = ""


def _other_files_notes(outcomes: Mapping[str, _EnclaveOutcome]) -> Iterator[Note]:
    """Yield a note for each reason for new certificates of enclaves with unchanged rights."""
    for reason in sorted({made.other_files for made in outcomes.values()} - {""}):
        names = [name for name, made in outcomes.items() if made.other_files == reason]
        text = f"the certificates are new, although the rights are the same: {reason}"
        yield Note("permissions.others-fit", f"{first_few(names, 5)}: {text}.")


@dataclass(frozen=True)
class _EnclaveMaker:
    """Makes enclaves one at a time, within a change."""

    change: KeystoreChange
    writer: EnclaveWriter
    tokens: EnclaveTokens
    names: Iterable[str]
    domains: EnclaveDomains
    revoke_old: bool
    keep_same: bool

    def make(self, name: str, policy: Enclave | None) -> _EnclaveOutcome:
        """Stage the missing files of an enclave, and if ``policy`` is not None, its permissions."""
        change, root = self.change, self.change.root
        present = present_files(root, name)
        before = len(change.transaction.changes)
        identity = self._identity(name, present, replaced=bool(policy))
        earlier, old, other_files = None, None, ""
        certificate = identity if isinstance(identity, x509.Certificate) else None
        rights = None
        if policy or PERMISSIONS_FILE not in present:
            enclave = policy or _default_rights(change.template, name)
            rights = StatedRights(enclave, self.domains.domains_of(name))
        if (
            rights
            and certificate
            and PERMISSIONS_FILE in present
            and self._is_kept(certificate, rights)
        ):
            other_files = self._why_other_files_work(name, certificate) if self.revoke_old else ""
            if not other_files:
                rights = None
                last = change.recorded_rights.last_entry(name)
                if last and name in self._without_policy:
                    time = iso(change.now)
                    repeated = last._replace(time=time, reason=BY_POLICY, previous="")
                    self.writer.entries.append(repeated)
        if rights and PERMISSIONS_FILE in present:
            earlier = permissions_to_replace(
                change.keystore, name, change.permissions.certificate, certificate
            )
            if self.revoke_old and certificate:
                old = certificate
                public = change.unrevoked_key(name, old)
                identity = NewIdentity(enclave_subject(name, unique=True), public)
        issued = self.writer.write(Issuance(name, identity, rights))
        link_shared_files(change.transaction, name, present)
        notes = tuple(issued.notes())
        if isinstance(identity, NewIdentity) and isinstance(identity.new_key, TokenKey):
            notes += tuple(token_notes(identity.new_key))
        if not present & _KEY_OR_REQUEST_FILES:
            return _EnclaveOutcome("created", notes)
        if PERMISSIONS_FILE in present and rights:
            (grant,) = issued.permissions.grants
            replaced = replaced_rights(name, earlier, grant, change.now) if earlier else None
            if old is None:
                return _EnclaveOutcome("changed", notes, replaced)
            superseded = SupersededCertificate.record(name, old, issued.certificate, change.now)
            revoked = replaced and replaced.after_revocation()
            return _EnclaveOutcome("changed", notes, revoked, superseded, other_files)
        if rights and policy is None:
            notes += tuple(self._lost_rights_notes(rights.enclave, present))
        completed = len(change.transaction.changes) > before
        return _EnclaveOutcome("completed" if completed else "kept", notes)

    def _why_other_files_work(self, name: str, certificate: x509.Certificate) -> str:
        """Return why, by the ledger, other files of an enclave may still work; "" if none do.

        Other files are an earlier certificate, or other permissions for the subject of the present
        certificate.
        """
        missing, recorded, since_restore = self._recorded_credentials
        if missing:
            return f"earlier permissions may fit the present certificates, because {missing}"
        certificates, permissions = recorded.get(name, (set(), []))
        subject = subject_text(certificate.subject)
        if since_restore is not None and subject not in since_restore:
            return (
                "the keystore was restored from a backup, so permissions that its ledger lacks may "
                "fit the present certificates; none of them fits the new certificates"
            )
        if (
            has_unique_part(certificate.subject)
            and certificates == {certificate.serial_number}
            and permissions.count(subject) == 1
        ):
            return ""
        return "earlier certificates or permissions in the ledger may still work"

    @cached_property
    def _recorded_credentials(
        self,
    ) -> tuple[str, Mapping[str, tuple[set[int], list[str]]], frozenset[str] | None]:
        """Return three values: a clause, the ledger's entries, and the subjects since a restore.

        The first value says why the ledger may lack entries ("" if the ledger is complete).  The
        second value maps enclaves to the serial numbers of their certificates and to the subjects
        of their permissions; expired and revoked certificates are left out.  The third value is the
        result of `subjects_since_restore`.
        """
        keystore, now = self.change.keystore, iso(self.change.now)
        working: dict[str, tuple[set[int], list[str]]] = {}
        try:
            ledger = keystore.ledger_file.with_values("enclave", {*self.names})
            is_restored = keystore.entries_of(RESTORED)
            # Only the whole ledger has the order of marks and subjects.
            since = subjects_since_restore(keystore, keystore.ledger) if is_restored else None
        except SrosError:
            return "a sealed part of the ledger is in an archive", working, None
        if ledger.gaps:
            return "entries of the ledger may be missing", working, None
        if may_have_later_releases(keystore):
            return "the published folder has later releases than the keystore knows", working, None
        revoked, digests = revoked_serials(keystore), set[str]()
        for entry in ledger.entries:
            certificates, permissions = working.setdefault(entry.enclave, (set(), []))
            if entry.what == "certificate" and entry.not_after > now:
                certificates |= {int(entry.serial, 16)} - revoked
            elif entry.what == "permissions" and entry.sha256 not in digests:
                digests.add(entry.sha256)  # a policy that changed nothing repeats the line
                permissions.append(entry.subject)
        return "", working, since

    def _lost_rights_notes(
        self, default_enclave: Enclave, existing_files: set[str]
    ) -> Iterator[Note]:
        """Yield a note if an enclave that gets the default permissions had other rights before.

        If the ledger does not record the lost permissions, their unsigned copy shows that the
        enclave had permissions.
        """
        name = default_enclave.path
        last = self.change.recorded_rights.last_entry(name)
        if (
            last.policy == default_enclave.digest
            if last
            else "permissions.xml" not in existing_files
        ):
            return
        text = (
            f"enclave {name} had lost its {PERMISSIONS_FILE}: it now has the default permissions "
            "of the keystore's template, and no longer the rights of its policy. To give it the "
            f"rights of its policy again: `sros create_permission {quote(str(self.change.root))} "
            f"{quote(name)} POLICY`."
        )
        yield Note("keystore.rights-lost", text)

    @cached_property
    def _without_policy(self) -> frozenset[str]:
        """The enclaves that have the rights of the backup from which the keystore was restored."""
        return frozenset(without_policy_since_restore(self.change.keystore, [*self.names]))

    def _is_kept(self, certificate: x509.Certificate, rights: StatedRights) -> bool:
        """Return whether an enclave's permissions can stay because they already state ``rights``.

        Raises:
            KeystoreError: the key of the enclave was revoked, so DDS would not accept the
                permissions.
        """
        if not self.keep_same:
            return False
        change, name = self.change, rights.enclave.path
        change.unrevoked_key(name, certificate)
        folder = enclave_path(self.change.root, name)
        signed_path, xml = folder / PERMISSIONS_FILE, folder / "permissions.xml"
        # A link could lead to a file that others can change.
        if signed_path.is_symlink() or xml.is_symlink():
            return False
        try:
            message = change.keystore.read(signed_path, "permissions document")
            entry = change.recorded_rights.latest_entry(name, hashlib.sha256(message).hexdigest())
            if entry is None:
                return False
            signed = change.keystore.files.signed_document(message)
            signed.verify(change.permissions.certificate)
            validity = Window(parse_iso(entry.not_before), parse_iso(entry.not_after))
        except (SrosError, ValueError):  # these are not files that `write` would leave as they are
            return False
        text = signed.text
        return self.writer.would_change_only_dates(
            rights, certificate, validity, text
        ) and _has_content(xml, text)

    def _identity(
        self, name: str, existing_files: set[str], *, replaced: bool
    ) -> NewIdentity | x509.Certificate:
        """Return an enclave's certificate, or the subject and key for a new one.

        If the enclave has signed permissions, the new certificate gets their subject, unless the
        permissions are ``replaced`` in this step.

        Raises:
            KeystoreError: the certificate cannot be used, or the current permissions are not the
                latest.
        """
        change, root = self.change, self.change.root
        folder = enclave_path(root, name)
        if name in self.tokens.places and not existing_files.isdisjoint(_KEY_OR_REQUEST_FILES):
            self.tokens.check_present(name, root)
        if CERTIFICATE_FILE in existing_files:
            if not existing_files & _KEY_OR_REQUEST_FILES:
                raise KeystoreError(
                    f"enclave {name} has a certificate but no key",
                    f"Its {KEY_FILE} is missing, and the certificate does not work with a new key.",
                    "Restore the key from a backup, or give the enclave another key: `sros renew "
                    f"{quote(str(root))} {quote(name)} --new-key`.",
                )
            return self._usable_certificate(name)
        subject = enclave_subject(name, unique=change.template.unique_subject)
        if PERMISSIONS_FILE in existing_files and not replaced:
            subject = self._subject_of_permissions(name, subject)
        if existing_files.isdisjoint(KEY_FILES):
            new_key = self.tokens.key(name) if name in self.tokens.places else generate_key()
            return NewIdentity(subject, new_key.public_key(), new_key)
        path = folder / next(file for file in KEY_FILES if file in existing_files)
        public = (
            load_key(read_bytes(path, "private key"), f"'{path}'")
            if path.name == KEY_FILE
            else open_enclave_key(place_in_file(path), self.tokens.secrets)
        ).public_key()
        remedy = f"Move '{path}' away: then a new key is created."
        change.known.refuse_revoked_key(public, f"enclave {name}", remedy)
        change.known.refuse_shared_key(public, name, remedy)
        return NewIdentity(subject, public)

    def _subject_of_permissions(self, name: str, own_subject: x509.Name) -> x509.Name:
        """Return the subject in an enclave's signed permissions, or else ``own_subject``."""
        path = enclave_path(self.change.root, name) / PERMISSIONS_FILE
        for subject in _permissions_subjects(path, self.change.permissions.certificate):
            if common_name_of(subject) == common_name_of(own_subject):
                message = self.change.keystore.read(path, "permissions document")
                self.change.recorded_rights.policy(name, hashlib.sha256(message).hexdigest())
                return subject
        return own_subject

    def _usable_certificate(self, name: str) -> x509.Certificate:
        """Return the certificate of an enclave, after checking its issuer and validity.

        Raises:
            KeystoreError: DDS would refuse the certificate.
        """
        path = enclave_path(self.change.root, name) / CERTIFICATE_FILE
        certificate = self.change.keystore.certificate(path)
        authority = self.change.identity.certificate
        if not issued_by(certificate, authority):
            raise KeystoreError(
                f"the certificate of enclave {name} was not issued by the identity CA of this "
                "keystore",
                f"The issuer of '{path}' is {other_issuer_text(certificate, authority)}; other "
                "nodes of this keystore would refuse the enclave.",
                "Restore the right certificate, or remove the enclave's folder and create the "
                "enclave again.",
            )
        if not validity_of(certificate).contains(self.change.now):
            raise self._not_valid_error()
        return certificate

    def _not_valid_error(self) -> KeystoreError:
        """Return the error that names all enclaves whose certificates are not valid now."""
        windows: dict[str, Window] = {}
        for name in self.names:
            with suppress(SrosError):
                path = enclave_path(self.change.root, name) / CERTIFICATE_FILE
                validity = validity_of(self.change.keystore.certificate(path))
                if not validity.contains(self.change.now):
                    windows[name] = validity
        name, validity = next(iter(windows.items()))
        dates = f"is valid from {iso(validity.not_before)} to {iso(validity.not_after)}."
        command = f"`sros renew {quote(str(self.change.root))} {self._robots_or_names(windows)}`"
        if len(windows) == 1:
            return KeystoreError(
                f"the certificate of enclave {name} is not valid now",
                f"It {dates}",
                f"Renew it with {command}.",
            )
        return KeystoreError(
            f"the certificates of {len(windows)} enclaves are not valid now: "
            f"{first_few(list(windows), _MOST_SHOWN)}",
            f"The certificate of {name} {dates}",
            f"Renew them with {command}.",
        )

    def _robots_or_names(self, names: Collection[str]) -> str:
        """Return command line arguments that select the enclaves ``names``.

        A robot stands for its enclaves if all of them are in ``names``.
        """
        words, left = [], list(names)
        fleet = load_fleet(self.change.keystore)
        for robot in fleet.robots.values() if fleet and len(names) > 1 else ():
            own = enclaves_of_robot(self.change.keystore, fleet, robot) if fleet else ()
            if own and {*own} <= {*names}:
                words.append(f"--robot {robot.name}")
                left = [name for name in left if name not in own]
        return " ".join([*map(quote, left), *words])


def _has_content(path: Path, content: bytes) -> bool:
    """Return whether there is a file at ``path`` with this content."""
    with suppress(SrosError):
        return read_bytes(path, "permissions document") == content
    return False


def _default_rights(template: Template, name: str) -> Enclave:
    """Return the rights of a new enclave without a policy; for a router, only the basic rights."""
    if template.zenoh and name in template.zenoh.router_names():
        template = replace(template, default_permissions=NODE_BASICS)
    return default_rights(template, name)


def _permissions_subjects(path: Path, authority: x509.Certificate) -> Iterator[x509.Name]:
    """Yield the subjects of the grants in signed permissions.

    There are none if the permissions cannot be read, or if ``authority`` did not sign them.
    """
    try:
        signed = smime.parse(read_bytes(path, "permissions document"))
        signed.verify(authority)
        grants = parse_permissions(signed.document, f"'{path}'").grants
        yield from [parse_subject(grant.subject) for grant in grants]
    except (SrosError, ValueError):
        return
