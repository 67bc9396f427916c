"""Creation of keystores and enclaves: CAs, governance, settings, keys and permissions."""

from __future__ import annotations

import difflib
import hashlib
import os
from collections import ChainMap
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from enum import Enum
from pathlib import Path
from shlex import quote
from types import MappingProxyType

from cryptography import x509

from sros_tool.dds.decision.vendors import Vendor
from sros_tool.dds.domains import DomainSet
from sros_tool.dds.permissions import parse_permissions
from sros_tool.dds.portable import name_notes
from sros_tool.errors import KeystoreError, Note, PolicyError, SrosError, UsageError
from sros_tool.fleet.expansion import FleetPolicy
from sros_tool.fleet.robots import Fleet
from sros_tool.keystore.authorities.authority import (
    Authorities,
    create_authorities,
    load_authorities,
)
from sros_tool.keystore.authorities.keyring import IN_KEYSTORE, Keyring
from sros_tool.keystore.fleet import (
    EnclaveDomains,
    checked_fleet,
    left_enclaves,
    load_fleet,
    refuse_stale_domains,
    write_fleet,
)
from sros_tool.keystore.issuing.acceptance import imported_notes, refuse_stopping
from sros_tool.keystore.issuing.enclave import (
    EnclaveWriter,
    Issuance,
    NewIdentity,
    StatedRights,
    default_rights,
    link_shared_files,
    present_files,
    stated_enclave,
)
from sros_tool.keystore.issuing.governance import write_governance
from sros_tool.keystore.issuing.tokens import EnclaveTokens, place_in, token_notes, token_places
from sros_tool.keystore.issuing.zenoh import KeptZenoh, keep_zenoh
from sros_tool.keystore.known_keys import KnownKeys
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    ENCLAVES,
    KEY_FILE,
    KEY_FILES,
    PERMISSIONS_FILE,
    PRIVATE,
    PUBLIC,
    REQUEST,
    check_keystore,
    enclave_names,
    enclave_path,
    is_keystore,
    refuse_earlier,
)
from sros_tool.keystore.ledger import Entry, append, certificate_entry
from sros_tool.keystore.lifecycle.governed import Governed, protected_as_stated
from sros_tool.keystore.lifecycle.replaced import (
    ReplacedRights,
    earlier_permissions,
    replaced_rights,
)
from sros_tool.keystore.lifecycle.revoke import Superseded, another_ca, revoke_superseded
from sros_tool.keystore.missing import no_such_enclave
from sros_tool.keystore.protection import with_stated
from sros_tool.keystore.reader import (
    check_domain,
    load_governance,
    load_settings,
    read_certificate,
)
from sros_tool.keystore.recorded import RecordedRights
from sros_tool.keystore.settings import (
    edit_notes,
    with_places,
    write_settings,
)
from sros_tool.keystore.template import NODE_BASICS, Template, template_names
from sros_tool.keystore.transaction.recovery import tidy
from sros_tool.keystore.transaction.stage import Change
from sros_tool.keystore.transaction.transaction import Transaction
from sros_tool.keystore.zenoh.wanted import ZenohChange
from sros_tool.names import check_enclave_name
from sros_tool.owners import other_writers, replaceable_on_the_way
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
from sros_tool.pki.keys import PublicKey, generate_key, load_key
from sros_tool.pki.token import TokenKey, TokenUri, open_enclave_key
from sros_tool.policy.model import Enclave, Policy, StatedProtection, stated_protections
from sros_tool.translate import governance_for
from sros_tool.validity import Window, iso, parse_iso, window
from sros_tool.xml import read_bytes

_NONE_IMPORTED: Mapping[str, bytes] = MappingProxyType({})
_OF_KEY = {*KEY_FILES, REQUEST}


@dataclass(frozen=True, slots=True)
class Creation:
    """The result of creating a keystore or enclaves; with ``dry_run``, the result it would have.

    ``created`` are the new enclaves, ``changed`` the enclaves with new permissions, ``completed``
    the enclaves that got missing files, and ``kept`` the enclaves without changes.  ``replaced``
    are the rights that changed with the permissions.  ``restart`` are the enclaves whose processes
    have to be restarted: they trust revoked certificates, or have other rules for Zenoh.
    ``remarks`` are notes about open tasks; ``zenoh`` are the configurations for Zenoh.
    """

    root: Path
    template: Template
    domains: DomainSet
    new_keystore: bool = False
    created: tuple[str, ...] = ()
    changed: tuple[str, ...] = ()
    completed: tuple[str, ...] = ()
    kept: tuple[str, ...] = ()
    changes: Sequence[Change] = ()
    notes: tuple[Note, ...] = ()
    replaced: tuple[ReplacedRights, ...] = ()
    restart: tuple[str, ...] = ()
    remarks: tuple[Note, ...] = ()
    zenoh: KeptZenoh = KeptZenoh()  # noqa: RUF009 - frozen


def create_keystore(
    root: Path,
    *,
    template: Template,
    domains: DomainSet | None = None,
    now: datetime,
    keyring: Keyring = IN_KEYSTORE,
    imported: Mapping[str, bytes] = _NONE_IMPORTED,
    dry_run: bool = False,
) -> Creation:
    """Create a keystore for ``domains`` (default: 0) from ``template``.

    ``imported`` maps roles ("identity", "permissions") to PEM certificates of existing CAs, whose
    keys the ``keyring`` opens.

    Raises:
        KeystoreError: ``root`` holds a keystore or a part of one: enclaves of an older CA would
            not work with a new one.
    """
    if not dry_run:
        tidy(root)
    _check_free(root)
    with Transaction(root, fresh=True, dry_run=dry_run) as transaction:
        domains = domains or DomainSet.of((0, 0))
        keystore = _write_keystore(transaction, template, domains, keyring, now, imported)
        append(transaction, keystore.entries, keystore.authorities.identity, now)
        notes = keystore.authorities.notes
        if imported:
            notes += imported_notes(transaction, template, keystore.authorities, domains, now)
        transaction.commit()
    return Creation(
        root,
        template,
        domains,
        True,
        changes=transaction.changes,
        notes=(*notes, *_place_notes(root)),
    )


def create_enclaves(
    root: Path,
    names: Sequence[str],
    *,
    now: datetime,
    domain: int | None = None,
    key: str = "",
    keyring: Keyring = IN_KEYSTORE,
    dry_run: bool = False,
    progress: Progress | None = None,
) -> Creation:
    """Create enclaves with the default permissions of the keystore's template.

    An existing enclave keeps its key and its permissions, and gets its missing files.  ``domain``
    is the caller's ROS_DOMAIN_ID; the governance must name it.  ``key`` is the ``pkcs11:`` URI of
    the key, which is made on the token if it is not there; without ``object`` in it, the label of
    the key is the name of its enclave.
    """
    return generate_artifacts(
        root,
        enclaves=names,
        now=now,
        domain=domain,
        key=key,
        keyring=keyring,
        dry_run=dry_run,
        progress=progress,
    )


def create_permission(
    root: Path,
    names: Sequence[str],
    policy: Policy,
    *,
    now: datetime,
    domain: int | None = None,
    revoke_old: bool = False,
    allow_refusal: Sequence[Vendor] = (),
    keyring: Keyring = IN_KEYSTORE,
    dry_run: bool = False,
) -> Creation:
    """Replace the permissions of existing enclaves with their rights in ``policy``: all or none.

    The replaced permissions work for whoever kept them, until they expire.  ``revoke_old`` ends
    that: the enclaves get new certificates for the same keys, and all earlier ones are revoked.  On
    the vendors in ``allow_refusal``, nodes may stop.
    """
    for name in names:
        check_enclave_name(name)
    if not dry_run:
        tidy(root)
    check_keystore(root)
    existing = set(enclave_names(root))
    for name in names:
        if name not in existing:
            raise no_such_enclave(root, name, existing)
    stated = {each.path: each for each in policy.enclaves}
    wanted = {name: stated.get(name) or stated_enclave(policy, name) for name in names}
    protections = stated_protections(wanted.values())
    with Transaction(root, dry_run=dry_run) as transaction:
        keystore = open_to_issue(transaction, domain, keyring, now, protections=protections)
        return write_enclaves(
            transaction,
            keystore,
            dict(wanted),
            now,
            revoke_old=revoke_old,
            allow_refusal=allow_refusal,
            keyring=keyring,
        )


def generate_artifacts(
    root: Path,
    *,
    enclaves: Sequence[str] = (),
    policies: Sequence[Policy | FleetPolicy] = (),
    now: datetime,
    domain: int | None = None,
    create: Template | None = None,
    domains: DomainSet | None = None,
    revoke_old: bool = False,
    allow_refusal: Sequence[Vendor] = (),
    key: str = "",
    keyring: Keyring = IN_KEYSTORE,
    dry_run: bool = False,
    progress: Progress | None = None,
) -> Creation:
    """Create the named enclaves and the enclaves of policies, with permissions, all or nothing.

    If a policy names an existing enclave, the enclave's permissions are replaced, and with
    ``revoke_old`` its certificate, as by `create_permission`.  Without it, permissions are kept
    that state the same and do not expire soon (`EnclaveWriter.would_only_date`).  The keystore
    protects each name at least as the policies say.  If the keystore does not exist and ``create``
    is given, it is created from that template.

    With policies for a fleet, which have to be for the same one, the keystore records it, and a
    keystore that is created is for the domains of the robots.

    Raises:
        KeystoreError: a policy names a revoked enclave that ``enclaves`` does not name, or a robot
            is in a domain that the keystore is not for.
    """
    wanted = _rights_by_enclave(enclaves, policies)
    protections = stated_protections(_protecting(policies))
    of_fleet = [each for each in policies if isinstance(each, FleetPolicy)]
    fleet = of_fleet[0].fleet if of_fleet else None
    patterns = [pattern for each in of_fleet for pattern in each.patterns]
    places = token_places(key, list(wanted)) if key else {}
    if not dry_run:
        tidy(root)
    if create is None or is_keystore(root):
        check_keystore(root)
        with Transaction(root, dry_run=dry_run) as transaction:
            keystore = open_to_issue(
                transaction, domain, keyring, now, fleet, patterns, wanted, protections
            )
            again = _revoked_before(keystore, wanted, enclaves, root, fleet)
            creation = write_enclaves(
                transaction,
                keystore,
                wanted,
                now,
                progress,
                revoke_old=revoke_old,
                allow_refusal=allow_refusal,
                keyring=keyring,
                places=places,
            )
        return replace(creation, notes=(*again, *creation.notes))
    _check_typo(root)
    _check_free(root)
    domains = domains or _domains_of(fleet, domain)
    check_domain(domains, domain, root)
    create = replace(create, protection=with_stated(create.protection, protections))
    with Transaction(root, fresh=True, dry_run=dry_run) as transaction:
        keystore = _write_keystore(transaction, create, domains, keyring, now, _NONE_IMPORTED)
        if fleet:
            recorded, entries = write_fleet(transaction, fleet, patterns, now)
            keystore = replace(keystore, fleet=recorded, entries=(*keystore.entries, *entries))
        creation = write_enclaves(
            transaction, keystore, wanted, now, progress, keyring=keyring, places=places
        )
    return replace(creation, notes=(*creation.notes, *_place_notes(root)))


def _protecting(policies: Sequence[Policy | FleetPolicy]) -> Iterator[Enclave]:
    """Yield the enclaves of the policies that say something about protection."""
    for policy in policies:
        if not isinstance(policy, FleetPolicy):
            yield from policy.enclaves
        elif policy.protects:
            yield from policy.values()


def _domains_of(fleet: Fleet | None, domain: int | None) -> DomainSet:
    """Return the domains of a new keystore: those of the robots, and ``domain`` or 0 for others."""
    robots = fleet.robots.values() if fleet else ()
    named = {robot.domain for robot in robots if robot.domain is not None}
    if not named or domain is not None or any(robot.domain is None for robot in robots):
        named.add(domain or 0)
    return DomainSet.of(*((each, each) for each in named))


def _revoked_before(
    keystore: _Keystore,
    wanted: Iterable[str],
    named: Collection[str],
    root: Path,
    fleet: Fleet | None,
) -> list[Note]:
    """Return a note for each revoked enclave that is created again because it is ``named``.

    Raises:
        KeystoreError: a revoked enclave is only in a policy, from which nobody removed it.
    """
    existing = frozenset(keystore.names)
    missing = [name for name in wanted if name not in existing]
    again = [name for name in missing if name in keystore.known.revoked_enclaves]
    if unasked := [name for name in again if name not in named]:
        raise KeystoreError(
            f"a policy names {', '.join(unasked)}, revoked in keystore '{root}'",
            "Its policy would create it again, and `distribute_key --all` would export it.",
            f"Remove it from the policy{' or its robot from the fleet file' if fleet else ''}; or, "
            "to have it again with another key and the rights of the policy, name it, too: "
            f"`sros generate_artifacts -k {quote(str(root))} -e {' '.join(unasked)} -p POLICY_FILE"
            f"{' --fleet FLEET_FILE' if fleet else ''}`.",
        )
    return list(keystore.known.revoked_before_notes(again))


def refuse_other_template(root: Path, template: Template) -> None:
    """Raise `UsageError` if the existing keystore ``root`` was made from another template."""
    present = load_settings(root)
    named = template.name == present.name and template.name in template_names()
    plain = replace(template, name=present.name, description=present.description)
    if not (named or with_places(plain, present) == present):
        where = quote(str(root))
        raise UsageError(
            f"keystore '{root}' exists already, with the template {present.name}",
            f"The template {template.name} would change nothing in it.",
            f"Leave --template out, or first run `sros update_keystore {where} --template "
            f"{quote(template.name)} --dry-run`, which shows what it changes, and then without "
            "--dry-run.",
        )


class _StatedEnclaves(Mapping[str, Enclave | None]):
    """Enclaves with their rights in policies, or None: those of a fleet as they are asked for."""

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
    """Map enclaves to their rights in the policies, or None; raise if two policies differ."""
    sources: dict[str, Mapping[str, Enclave] | None] = {
        check_enclave_name(name): None for name in names
    }
    for policy in policies:
        stated: Mapping[str, Enclave] = (
            policy
            if isinstance(policy, FleetPolicy)
            else {each.path: each for each in policy.enclaves}
        )
        for name in stated:
            other = sources.get(name)
            if other is not None and (one := other[name]) != (enclave := stated[name]):
                raise PolicyError(
                    f"the enclave {name} is in two policies that differ",
                    f"It is at {one.source} and at {enclave.source}.",
                    "Merge them into one policy, for example with `sros merge_policy`.",
                )
            sources[name] = stated
    return _StatedEnclaves(sources)


# ── the keystore ───────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, slots=True)
class _Keystore:
    """A keystore that enclaves are added to; ``names`` are the existing enclaves.

    ``known`` are its keys.  ``entries`` are the ledger entries of what is staged already, ``notes``
    remarks on files that were edited by hand and on the fleet.  ``is_new`` says that all of it is
    staged.  With ``recorded``, permissions that state the rights of a policy already are kept.
    ``restart`` and ``remarks`` are of a governance that changes.
    """

    authorities: Authorities
    template: Template
    domains: DomainSet
    known: KnownKeys
    names: tuple[str, ...] = ()
    entries: tuple[Entry, ...] = ()
    notes: tuple[Note, ...] = ()
    fleet: Fleet | None = None
    is_new: bool = False
    recorded: RecordedRights | None = None
    restart: tuple[str, ...] = ()
    remarks: tuple[Note, ...] = ()


def open_to_issue(
    transaction: Transaction,
    domain: int | None,
    keyring: Keyring,
    now: datetime,
    fleet: Fleet | None = None,
    patterns: Sequence[str] = (),
    stated: Collection[str] = (),
    protections: Sequence[StatedProtection] = (),
) -> _Keystore:
    """Return an existing keystore; ``domain``, if given, has to be one of its governance.

    A ``fleet`` is staged as that of the keystore, with its enclaves' paths ``patterns``; the
    enclaves ``stated`` get the permissions of a policy, unless they have them.  If the keystore
    protects names less than the ``protections`` of policies, a governance that protects them is
    staged.
    """
    root = transaction.root
    template = load_settings(root)
    authorities = load_authorities(root, template, keyring, now)
    governance = load_governance(root, authorities.permissions.certificate)
    domains = governance.domains().closed()
    check_domain(domains, domain, root)
    notes = edit_notes(root, governance)
    entries: tuple[Entry, ...] = ()
    if fleet is None:
        fleet = checked_fleet(root)
    else:
        before = load_fleet(root)
        fleet, entries = write_fleet(transaction, fleet, patterns, now)
        refuse_stale_domains(root, EnclaveDomains(domains, before), fleet, stated)
        notes = (*notes, *(left_enclaves(root, before, fleet) if before else ()))
    names = transaction.enclaves
    governed = Governed(template)
    if protections:
        governed = protected_as_stated(
            transaction, template, governance, protections, authorities.permissions, names, now
        )
    return _Keystore(
        authorities,
        governed.template,
        domains,
        KnownKeys(root),
        names,
        (*entries, *governed.entries),
        notes,
        fleet,
        recorded=RecordedRights(root) if stated else None,
        restart=governed.restart,
        remarks=governed.remarks,
    )


def _write_keystore(
    transaction: Transaction,
    template: Template,
    domains: DomainSet,
    keyring: Keyring,
    now: datetime,
    imported: Mapping[str, bytes],
) -> _Keystore:
    """Stage a new keystore: its CAs, its governance and its settings."""
    _check_free(transaction.root)  # another process may have created it meanwhile
    for span in (template.certificate_validity, template.permissions_validity):
        window(now, span)  # raises if the CAs could not issue anything
    authorities = create_authorities(transaction, template, keyring, now, imported)
    distinct = dict.fromkeys((authorities.identity, authorities.permissions))
    entries = [certificate_entry(now, "ca", each.certificate) for each in distinct]
    governance = governance_for(template.protection, domains)
    entries.append(write_governance(transaction, governance, authorities.permissions, (), now))
    settings = keyring.settings_with_places(template)
    entries.append(write_settings(transaction, settings, now))
    known = KnownKeys(transaction.root)
    return _Keystore(authorities, template, domains, known, entries=tuple(entries), is_new=True)


def _check_free(root: Path) -> None:
    """Raise `KeystoreError` if a new keystore cannot be created at ``root``."""
    if is_keystore(root):
        raise _already_exists(root)
    refuse_earlier(root)
    if os.path.realpath(root) == "/":  # unlike Path.resolve, it does not fail at a loop of links
        raise KeystoreError(
            "the root of the file system cannot be a keystore", "", "Choose another path."
        )
    if os.path.lexists(root) and not root.is_dir():
        raise KeystoreError(
            f"'{root}' is in the way", "It is not a folder.", "Choose another path."
        )
    remains = [part for part in (PUBLIC, PRIVATE, ENCLAVES) if (root / part).exists()]
    if remains:
        if is_keystore(root):  # another process has just completed it
            raise _already_exists(root)
        raise KeystoreError(
            f"'{root}' already holds parts of a keystore",
            f"It has {', '.join(remains)}; with a new CA, every enclave that trusts the old CA "
            "would be locked out.",
            "Restore the missing files, or choose another path.",
        )


def _place_notes(root: Path) -> Iterator[Note]:
    """Note that users other than this one and root can replace a new keystore."""
    trusted = frozenset({0, os.geteuid()})
    found = list(replaceable_on_the_way(root, trusted))
    if root.exists() and (why := other_writers(root.stat(), trusted)):
        found.append((root, why))
    for folder, why in found[-1:]:
        yield Note(
            "keystore.replaceable",
            f"other users can put another keystore in the place of '{root}', because they can "
            f"change '{folder}': {why}. Run `chmod go-w {quote(str(folder))}`, or move the "
            "keystore to a folder that only you and root can change.",
        )


def _already_exists(root: Path) -> KeystoreError:
    return KeystoreError(
        f"keystore '{root}' already exists",
        "",
        "Nothing was changed. Add to it with `sros create_enclave`, or choose another path.",
    )


def _without_digits(name: str) -> str:
    return "".join(each for each in name if not each.isdigit())


def _check_typo(root: Path) -> None:
    """Refuse a name that looks like a typo of a sibling keystore."""
    try:
        siblings = [p.name for p in root.absolute().parent.iterdir() if p.is_dir()]
    except OSError:
        return
    close = difflib.get_close_matches(root.name, siblings, n=3, cutoff=0.5)
    for name in close:
        if _without_digits(name) == _without_digits(root.name):
            continue  # ks2 next to ks is meant
        if is_keystore(root.absolute().parent / name):
            raise UsageError(
                f"'{root}' does not exist, and '{name}' next to it is a keystore",
                "The name may be a typo, so no second keystore is created.",
                f"Name '{root.with_name(name)}', or run `sros create_keystore "
                f"{quote(str(root))}` first.",
            )


# ── its enclaves ───────────────────────────────────────────────────────────────────────────


class _Outcome(Enum):
    """What happened to an enclave; the members are the fields of `Creation`."""

    CREATED = "created"
    CHANGED = "changed"
    COMPLETED = "completed"
    KEPT = "kept"


def write_enclaves(
    transaction: Transaction,
    keystore: _Keystore,
    wanted: Mapping[str, Enclave | None],
    now: datetime,
    progress: Progress | None = None,
    *,
    revoke_old: bool = False,
    allow_refusal: Sequence[Vendor] = (),
    keyring: Keyring = IN_KEYSTORE,
    places: Mapping[str, TokenUri] = MappingProxyType({}),
) -> Creation:
    """Create or complete the enclaves, sign the permissions of their policies, and commit.

    A keystore with a Zenoh network gets the enclave of its router, too.  ``places`` are those of
    new keys on tokens, by enclave; other new keys are in files.
    """
    network = keystore.template.zenoh
    if network and network.router not in keystore.names:
        wanted = ChainMap({network.router: None}, wanted)  # type: ignore[arg-type]
    writer = EnclaveWriter(
        transaction,
        keystore.template,
        now,
        identity=keystore.authorities.identity,
        permissions=keystore.authorities.permissions,
        keys_on_token=bool(places),
    )
    keys = EnclaveTokens(
        places, keyring.secrets, keystore.known, keystore.authorities, transaction.dry_run
    )

    def write(name: str) -> _Written:
        return _write_enclave(
            writer, transaction, keystore, name, wanted[name], now, keys, revoke_old=revoke_old
        )

    done = writer.for_each(list(wanted), write, progress)
    entries = [*keystore.entries, *writer.entries]
    superseded = [each.superseded for each in done.values() if each.superseded]
    revoked = None
    if superseded:
        revoked = revoke_superseded(
            transaction,
            superseded,
            keystore.authorities.identity,
            keystore.template,
            keyring,
            keystore.names,
            now,
        )
        entries += revoked.entries
    outcomes = {name: each.outcome for name, each in done.items()}
    created = _names_with(outcomes, _Outcome.CREATED)
    permissions = keystore.authorities.permissions
    kept = keep_zenoh(
        transaction,
        network,
        keystore.domains,
        permissions.certificate,
        lambda: permissions,
        now,
        ZenohChange(writer.grants, replaced=[e.name for e in superseded], stated=wanted),
    )
    kept = kept.without(created)  # no process of theirs runs yet
    append(transaction, entries, keystore.authorities.identity, now)
    stopped = refuse_stopping(
        transaction,
        now,
        allowed=allow_refusal,
        remedy=another_ca(transaction.root, "replace the permissions") if revoked else "",
    )
    transaction.commit()
    return Creation(
        transaction.root,
        keystore.template,
        keystore.domains,
        keystore.is_new,
        created,
        _names_with(outcomes, _Outcome.CHANGED),
        _names_with(outcomes, _Outcome.COMPLETED),
        _names_with(outcomes, _Outcome.KEPT),
        transaction.changes,
        (
            *(note for each in done.values() for note in each.notes),
            *(writer.notes if writer.entries else ()),
            *name_notes({*keystore.names, *created}, created),
            *keystore.notes,
            *kept.notes,
        ),
        tuple(each.replaced for each in done.values() if each.replaced),
        keystore.names if revoked else keystore.restart or kept.restart,
        (*(revoked.remarks if revoked else ()), *keystore.remarks, *stopped),
        kept,
    )


def _names_with(outcomes: Mapping[str, _Outcome], outcome: _Outcome) -> tuple[str, ...]:
    return tuple(name for name, each in outcomes.items() if each is outcome)


@dataclass(frozen=True, slots=True)
class _Written:
    """What was done to an enclave: ``superseded`` is its old certificate, if that is revoked."""

    outcome: _Outcome
    notes: tuple[Note, ...]
    replaced: ReplacedRights | None = None
    superseded: Superseded | None = None


def _write_enclave(
    writer: EnclaveWriter,
    transaction: Transaction,
    keystore: _Keystore,
    name: str,
    policy: Enclave | None,
    now: datetime,
    keys: EnclaveTokens,
    *,
    revoke_old: bool,
) -> _Written:
    """Stage the missing files of an enclave, and permissions that state ``policy`` if given."""
    root = transaction.root
    present = present_files(root, name)
    before = len(transaction.changes)
    identity = _identity(root, keystore, name, present, now, keys, replaced=bool(policy))
    earlier, old = None, None
    certificate = identity if isinstance(identity, x509.Certificate) else None
    rights = None
    if policy or PERMISSIONS_FILE not in present:
        enclave = policy or _default_rights(keystore.template, name)
        rights = StatedRights(enclave, EnclaveDomains(keystore.domains, keystore.fleet).of(name))
    if rights and certificate and PERMISSIONS_FILE in present and not revoke_old:
        rights = None if _is_kept(writer, keystore, root, certificate, rights) else rights
    if rights and PERMISSIONS_FILE in present:
        authority = keystore.authorities.permissions.certificate
        earlier = earlier_permissions(root, name, authority, certificate)
        if revoke_old and certificate:
            old = certificate
            public: PublicKey = old.public_key()  # type: ignore[assignment]
            remedy = f"Give it another key with `sros renew {quote(str(root))} {name} --new-key`."
            keystore.known.refuse_revoked(public, f"enclave {name}", remedy, old)
            identity = NewIdentity(enclave_subject(name, unique=True), public)
    issued = writer.write(Issuance(name, identity, rights))
    link_shared_files(transaction, name, present)
    notes = tuple(issued.notes())
    if isinstance(identity, NewIdentity) and isinstance(identity.new_key, TokenKey):
        notes += tuple(token_notes(identity.new_key))
    if not present & _OF_KEY:
        return _Written(_Outcome.CREATED, notes)
    if PERMISSIONS_FILE in present and rights:
        (grant,) = issued.permissions.grants
        replaced = replaced_rights(name, earlier, grant, now) if earlier else None
        if old is None:
            return _Written(_Outcome.CHANGED, notes, replaced)
        superseded = Superseded.by(name, old, issued.certificate, now)
        replaced = replaced.revoked() if replaced else None
        return _Written(_Outcome.CHANGED, notes, replaced, superseded)
    completed = len(transaction.changes) > before
    return _Written(_Outcome.COMPLETED if completed else _Outcome.KEPT, notes)


def _is_kept(
    writer: EnclaveWriter,
    keystore: _Keystore,
    root: Path,
    certificate: x509.Certificate,
    rights: StatedRights,
) -> bool:
    """Return whether the permissions of an enclave stay as they are, because they state ``rights``.

    Raises:
        KeystoreError: the key of the enclave was revoked, so nobody would accept them.
    """
    name = rights.enclave.path
    if keystore.recorded is None:
        return False
    public: PublicKey = certificate.public_key()  # type: ignore[assignment]
    remedy = f"Give it another key with `sros renew {quote(str(root))} {name} --new-key`."
    keystore.known.refuse_revoked(public, f"enclave {name}", remedy, certificate)
    signed_path, xml = (
        enclave_path(root, name) / file for file in (PERMISSIONS_FILE, "permissions.xml")
    )
    if signed_path.is_symlink() or xml.is_symlink():  # to what others may change
        return False
    try:
        message = read_bytes(signed_path, "permissions document")
        entry = keystore.recorded.latest(name, hashlib.sha256(message).hexdigest())
        if entry is None:
            return False
        signed = smime.parse(message)
        signed.verify(keystore.authorities.permissions.certificate)
        validity = Window(parse_iso(entry.not_before), parse_iso(entry.not_after))
    except (SrosError, ValueError):  # not what `write` would leave
        return False
    text = signed.text
    return writer.would_only_date(rights, certificate, validity, text) and _is_file(xml, text)


def _is_file(path: Path, content: bytes) -> bool:
    """Return whether there is a file with this content."""
    with suppress(SrosError):
        return read_bytes(path, "permissions document") == content
    return False


def _default_rights(template: Template, name: str) -> Enclave:
    """Return the rights of a new enclave without a policy; the router of Zenoh only routes."""
    if template.zenoh and template.zenoh.router == name:
        template = replace(template, default_permissions=NODE_BASICS)
    return default_rights(template, name)


def _identity(
    root: Path,
    keystore: _Keystore,
    name: str,
    present: set[str],
    now: datetime,
    keys: EnclaveTokens,
    *,
    replaced: bool,
) -> NewIdentity | x509.Certificate:
    """Return the certificate of an enclave, or the subject and key for a new certificate.

    If the enclave has signed permissions, the new certificate gets their subject; if they are
    ``replaced`` in this step, it may have its own.

    Raises:
        KeystoreError: the certificate is not usable, or a new one would fit permissions that are
            not the latest ones.
    """
    folder = enclave_path(root, name)
    if name in keys.places and not present.isdisjoint(_OF_KEY):
        keys.check_present(name, root)
    if CERTIFICATE_FILE in present:
        if not present & _OF_KEY:
            raise KeystoreError(
                f"enclave {name} has a certificate but no key",
                f"Its {KEY_FILE} is missing, and the certificate does not work with a new key.",
                f"Restore the key, or remove '{folder / CERTIFICATE_FILE}' to create both again.",
            )
        return _usable_certificate(root, keystore, name, now)
    subject = enclave_subject(name, unique=keystore.template.unique_subject)
    if PERMISSIONS_FILE in present and not replaced:
        authority = keystore.authorities.permissions.certificate
        own = common_name_of(subject)
        signed_for = _permissions_subjects(folder / PERMISSIONS_FILE, authority)
        if found := next((each for each in signed_for if common_name_of(each) == own), None):
            message = read_bytes(folder / PERMISSIONS_FILE, "permissions document")
            RecordedRights(root).policy(name, hashlib.sha256(message).hexdigest())
            subject = found
    if present.isdisjoint(KEY_FILES):
        new_key = keys.key(name) if name in keys.places else generate_key()
        return NewIdentity(subject, new_key.public_key(), new_key)
    path = folder / next(each for each in KEY_FILES if each in present)
    public = (
        load_key(read_bytes(path, "private key"), f"'{path}'")
        if path.name == KEY_FILE
        else open_enclave_key(place_in(path), keys.secrets)
    ).public_key()
    remedy = f"Move '{path}' away, and a new key is created."
    keystore.known.refuse_revoked(public, f"enclave {name}", remedy)
    keystore.known.refuse_second(public, name, remedy)
    return NewIdentity(subject, public)


def _usable_certificate(
    root: Path, keystore: _Keystore, name: str, now: datetime
) -> x509.Certificate:
    """Return the certificate of an enclave; raise `KeystoreError` if DDS would refuse it."""
    path = enclave_path(root, name) / CERTIFICATE_FILE
    certificate = read_certificate(path)
    authority = keystore.authorities.identity.certificate
    if not issued_by(certificate, authority):
        raise KeystoreError(
            f"the certificate of enclave {name} was not issued by the identity CA of this keystore",
            f"The issuer of '{path}' is {other_issuer(certificate, authority)}; other nodes of "
            "this keystore would refuse the enclave.",
            "Restore the right certificate, or remove the enclave's folder and create it again.",
        )
    validity = validity_of(certificate)
    if not validity.contains(now):
        raise KeystoreError(
            f"the certificate of enclave {name} is not valid now",
            f"It is valid from {iso(validity.not_before)} to {iso(validity.not_after)}.",
            f"Renew it with `sros renew {quote(str(root))} {name}`.",
        )
    return certificate


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
