"""Founds a keystore: authorities, governance, settings, at a place where nothing is in the way."""

from __future__ import annotations

import difflib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from types import MappingProxyType

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import parse_governance, render_governance
from sros_tool.dds.portable import name_notes
from sros_tool.errors import KeystoreError, Note, PolicyError, UsageError
from sros_tool.keystore.authorities.authority import (
    Authorities,
    Authority,
    create_authorities,
    load_authorities,
)
from sros_tool.keystore.authorities.keyring import IN_KEYSTORE, Keyring
from sros_tool.keystore.issuing.enclave import Fate, Registrar
from sros_tool.keystore.layout import (
    ENCLAVES,
    GOVERNANCE_P7S,
    GOVERNANCE_XML,
    PRIVATE,
    PUBLIC,
    SETTINGS,
    check_keystore,
    enclave_names,
    is_keystore,
)
from sros_tool.keystore.ledger import Entry, append, certificate_entry, document_entry
from sros_tool.keystore.missing import no_such_enclave
from sros_tool.keystore.reader import check_domain, load_governance, load_settings
from sros_tool.keystore.template import Template, render_template
from sros_tool.keystore.transaction.recovery import tidy
from sros_tool.keystore.transaction.stage import Change
from sros_tool.keystore.transaction.transaction import Transaction
from sros_tool.names import check_enclave_name
from sros_tool.parallel import Progress
from sros_tool.policy.model import Enclave, Policy
from sros_tool.translate import governance_for
from sros_tool.validity import window

NOTHING: Mapping[str, bytes] = MappingProxyType({})


def write_keystore(
    transaction: Transaction,
    template: Template,
    domains: DomainSet,
    keyring: Keyring,
    now: datetime,
    imported: Mapping[str, bytes] = NOTHING,
) -> tuple[Authorities, list[Entry]]:
    """Stage a new keystore: its authorities, its governance and its settings."""
    for span in (template.certificate_validity, template.permissions_validity):
        window(now, span)  # what could not issue anything is no keystore
    authorities = create_authorities(transaction, template, keyring, now, imported)
    distinct = dict.fromkeys((authorities.identity, authorities.permissions))
    entries = [certificate_entry(now, "ca", each.certificate) for each in distinct]
    message = _write_governance(transaction, authorities.permissions, template, domains)
    entries.append(document_entry(now, "governance", message))
    transaction.write(
        SETTINGS,
        b"# The choices by which sros made this keystore; what is added later follows them.\n"
        + render_template(keyring.remembered(template)).encode(),
    )
    return authorities, entries


def _write_governance(
    transaction: Transaction, authority: Authority, template: Template, domains: DomainSet
) -> bytes:
    """Stage the governance document of a keystore, with its readable form; the signed one."""
    governance = governance_for(template.protection, domains)
    document = render_governance(governance)
    message = authority.sign(document, governance, parse_governance, "the governance document")
    transaction.write(GOVERNANCE_XML, document)
    transaction.write(GOVERNANCE_P7S, message)
    return message


def check_free(root: Path) -> None:
    """Raise `KeystoreError` where something is in the way of a new keystore."""
    if is_keystore(root):
        raise _exists(root)
    if root.resolve() == Path("/"):
        raise KeystoreError("the root of the file system is no place for a keystore")
    if os.path.lexists(root) and not root.is_dir():
        raise KeystoreError(f"'{root}' is in the way", "It is not a folder.")
    remains = [part for part in (PUBLIC, PRIVATE, ENCLAVES) if (root / part).exists()]
    if remains:
        if is_keystore(root):  # another process has completed it between the two looks
            raise _exists(root)
        raise KeystoreError(
            f"'{root}' holds parts of a keystore already",
            f"There are {', '.join(remains)}; a new CA beside them would lock out every enclave "
            "that trusts the old one.",
            "Restore what is missing, or choose another path.",
        )


def _exists(root: Path) -> KeystoreError:
    return KeystoreError(
        f"keystore '{root}' already exists",
        "",
        "Nothing was changed. Add to it with `sros create_enclave`, or choose another path.",
    )


def check_typo(root: Path) -> None:
    """Refuse to make a keystore whose name is all but that of one beside it."""
    try:
        beside = [p.name for p in root.absolute().parent.iterdir() if p.is_dir()]
    except OSError:
        return
    close = difflib.get_close_matches(root.name, beside, n=3, cutoff=0.5)
    for name in close:
        if is_keystore(root.absolute().parent / name):
            raise UsageError(
                f"'{root}' does not exist, and '{name}' beside it is a keystore",
                "This may be a typing error, so no second keystore is made.",
                f"Name '{root.with_name(name)}', or run `sros create_keystore {root}` first.",
            )


@dataclass(frozen=True, slots=True)
class Result:
    """What a verb did, or with ``dry_run`` would do.

    ``created`` are new enclaves, ``changed`` those whose permissions were replaced, ``completed``
    those of which a missing file was added, ``kept`` those that were left as they are.
    """

    root: Path
    template: Template
    domains: DomainSet
    new_keystore: bool = False
    created: tuple[str, ...] = ()
    changed: tuple[str, ...] = ()
    completed: tuple[str, ...] = ()
    kept: tuple[str, ...] = ()
    changes: tuple[Change, ...] = ()
    notes: tuple[Note, ...] = ()


def create_keystore(
    root: Path,
    *,
    template: Template,
    domains: DomainSet | None = None,
    now: datetime,
    keyring: Keyring = IN_KEYSTORE,
    imported: Mapping[str, bytes] = NOTHING,
    dry_run: bool = False,
) -> Result:
    """Make a new keystore for ``domains`` (default: 0) by the choices of ``template``.

    Raises `KeystoreError` if ``root`` is a keystore, or holds any part of one: a CA is never made
    anew beside the remains of an older one.  ``imported`` are PEM certificates of existing CAs by
    role ("identity", "permissions"), whose keys the ``keyring`` has.
    """
    if not dry_run:
        tidy(root)
    check_free(root)
    with Transaction(root, fresh=True, dry_run=dry_run) as transaction:
        check_free(root)  # another process may have been faster
        domains = domains or DomainSet.of((0, 0))
        authorities, entries = write_keystore(
            transaction, template, domains, keyring, now, imported
        )
        append(transaction, entries)
        transaction.commit()
    return Result(
        root,
        template,
        domains,
        True,
        changes=tuple(transaction.changes),
        notes=authorities.notes,
    )


def create_enclaves(
    root: Path,
    names: Sequence[str],
    *,
    now: datetime,
    domain: int | None = None,
    keyring: Keyring = IN_KEYSTORE,
    dry_run: bool = False,
    progress: Progress | None = None,
) -> Result:
    """Make enclaves; what they may do is the default of the keystore's template.

    An enclave that exists is left as it is, and completed where a file is missing: neither its
    key nor its permissions are ever replaced.  ``domain`` is the one that the caller will use
    (its ROS_DOMAIN_ID); it must be among those of the keystore.
    """
    return generate_artifacts(
        root,
        enclaves=names,
        now=now,
        domain=domain,
        keyring=keyring,
        dry_run=dry_run,
        progress=progress,
    )


def create_permission(
    root: Path,
    name: str,
    policy: Policy,
    *,
    now: datetime,
    domain: int | None = None,
    keyring: Keyring = IN_KEYSTORE,
    dry_run: bool = False,
) -> Result:
    """Give an existing enclave the permissions that ``policy`` states for it."""
    check_enclave_name(name)
    if not dry_run:
        tidy(root)
    check_keystore(root)
    existing = set(enclave_names(root))
    if name not in existing:
        raise no_such_enclave(root, name, existing)
    enclave = policy.enclave(name)
    if enclave is None:
        there = ", ".join(each.path for each in policy.enclaves)
        raise PolicyError(
            f"unable to find enclave {name} in the policy '{policy.file}'", f"It has {there}."
        )
    return _produce(root, {name: enclave}, now, domain, keyring, dry_run)


def generate_artifacts(
    root: Path,
    *,
    enclaves: Sequence[str] = (),
    policies: Sequence[Policy] = (),
    now: datetime,
    domain: int | None = None,
    create: Template | None = None,
    domains: DomainSet | None = None,
    keyring: Keyring = IN_KEYSTORE,
    dry_run: bool = False,
    progress: Progress | None = None,
) -> Result:
    """Make the named enclaves and those of the policies, with their permissions, all or nothing.

    Permissions that a policy states replace those that an enclave had.  Where there is no
    keystore, one is made by the template ``create``, if that is given.
    """
    wanted: dict[str, Enclave | None] = {check_enclave_name(name): None for name in enclaves}
    for policy in policies:
        for enclave in policy.enclaves:
            other = wanted.get(enclave.path)
            if other is not None and other != enclave:
                raise PolicyError(
                    f"the enclave {enclave.path} is given by two policies",
                    f"It stands at {other.source} and at {enclave.source}, and they differ.",
                    "Join the two.",
                )
            wanted[enclave.path] = enclave
    if not dry_run:
        tidy(root)
    if not is_keystore(root) and create is not None:
        check_typo(root)
        check_free(root)
    else:
        check_keystore(root)
        create = None
    return _produce(root, wanted, now, domain, keyring, dry_run, progress, create, domains)


# ── the work ───────────────────────────────────────────────────────────────────────────────


def _produce(
    root: Path,
    wanted: dict[str, Enclave | None],
    now: datetime,
    domain: int | None,
    keyring: Keyring,
    dry_run: bool,
    progress: Progress | None = None,
    create: Template | None = None,
    domains: DomainSet | None = None,
) -> Result:
    fresh = create is not None
    with Transaction(root, fresh=fresh, dry_run=dry_run) as transaction:
        if create is not None:
            check_free(root)  # another process may have been faster
            template = create
            domains = domains or DomainSet.of((0 if domain is None else domain,) * 2)
            check_domain(domains, domain, root)
            authorities, entries = write_keystore(transaction, template, domains, keyring, now)
            existing: tuple[str, ...] = ()
        else:
            template = load_settings(root)
            authorities = load_authorities(root, template, keyring, now)
            domains = load_governance(root, authorities.permissions.certificate).domains().closed()
            check_domain(domains, domain, root)
            existing = tuple(enclave_names(root))
            entries = []
        registrar = Registrar(transaction, authorities, template, domains, now)
        fates = registrar.register_all(list(wanted.items()), progress)
        append(transaction, [*entries, *registrar.entries])
        transaction.commit()
    of = {fate: tuple(name for name in fates if fates[name] is fate) for fate in Fate}
    return Result(
        root,
        template,
        domains,
        fresh,
        of[Fate.CREATED],
        of[Fate.CHANGED],
        of[Fate.COMPLETED],
        of[Fate.KEPT],
        tuple(transaction.changes),
        (*registrar.notes, *name_notes({*existing, *of[Fate.CREATED]}, of[Fate.CREATED])),
    )
