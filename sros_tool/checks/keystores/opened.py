"""A keystore opened for checks: its readable parts, and the unreadable ones."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime, tzinfo
from functools import cache, cached_property
from pathlib import Path
from typing import TypeVar

from cryptography import x509

from sros_tool.checks.kind import ERROR, FindingKind
from sros_tool.dataclass import dataclass
from sros_tool.dds.governance import Governance
from sros_tool.errors import SrosError
from sros_tool.fleet.robots import Fleet
from sros_tool.keystore.fleet import edited_fleet, load_fleet
from sros_tool.keystore.layout import (
    CRL,
    FLEET,
    GOVERNANCE_P7S,
    LEDGER,
    PUBLIC,
    ROLES,
    SETTINGS,
    ca_certificate,
    enclave_path,
    search_enclaves,
)
from sros_tool.keystore.ledger import Ledger
from sros_tool.keystore.reader import Keystore, OpenedEnclave
from sros_tool.keystore.settings import HandEdits, hand_edits
from sros_tool.keystore.template import Template, load_template, template_names
from sros_tool.pki.crl import RevocationList
from sros_tool.policy.model import Policy

_Part = TypeVar("_Part")


_load_shipped = cache(load_template)


def _shipped(name: str) -> Template | None:
    """Return the template with this name that ships with sros, or None."""
    return _load_shipped(name) if name in template_names() else None


@dataclass(frozen=True, slots=True)
class UnreadablePart:
    """A file that exists but cannot be read; ``path`` is relative to the root."""

    path: str
    error: SrosError


@dataclass(frozen=True, slots=True)
class CheckedKeystore:
    """A keystore, or the part of one that was exported for a robot, as it is checked.

    ``settings`` are None if ros2/sros2 made it.  ``authorities`` maps a role to the certificates of
    its CA file, the issuing one first.  ``governance`` is the signed document that its enclaves
    share, or b"".  ``is_home`` is false on a robot, where no CA key may be;
    ``looks_like_home`` is true there, too, of what has the folders of a keystore.  ``policies`` are
    compared with its permissions; ``zone`` is the time zone of the host on which its enclaves run.
    ``edits`` are what somebody edited by hand; ``fleet`` are its robots, and ``fleet_edited`` says
    how the file of them was, as a clause.  ``distribution`` is the ROS 2 distribution of the nodes;
    "" is the latest.
    """

    opened: Keystore
    now: datetime
    names: tuple[str, ...]
    settings: Template | None
    authorities: dict[str, tuple[x509.Certificate, ...]]
    crl: RevocationList | None
    ledger: Ledger
    governance: bytes = b""
    unread: tuple[UnreadablePart, ...] = ()
    policies: tuple[Policy, ...] = ()
    zone: tzinfo = UTC
    is_home: bool = True
    looks_like_home: bool = True
    edits: HandEdits = HandEdits()
    fleet: Fleet | None = None
    fleet_edited: str = ""
    distribution: str = ""

    @property
    def root(self) -> Path:
        """Its folder."""
        return self.opened.root

    def enclave(self, name: str) -> OpenedEnclave:
        """Return one of its enclaves at the moment of the check."""
        return self.opened.enclave(name, now=self.now)

    @property
    def can_issue(self) -> bool:
        """Whether it is a keystore with CAs, in which verbs can issue and sign."""
        return self.is_home and any((self.root / each).exists() for each in (PUBLIC, SETTINGS))

    def accepts(self, kind: FindingKind, chosen: Callable[[Template], bool]) -> str:
        """Return text naming the template or keystore that accepts a weakness; "" if none does.

        ``chosen`` returns whether settings choose the weakness.  It is asked of the template as it
        ships with sros: what the settings of this keystore changed, the template never accepted.
        Without settings (ros2/sros2) nothing accepts it.

        An export has no settings, so it is compared with all templates.  What none of them chooses
        was chosen where the CA is; an error stays an error nevertheless.
        """
        if self.settings:
            name = self.settings.name
            template = _shipped(name) or self.settings
            return f"template {name}" if chosen(template) else ""
        if self.is_home:
            return ""
        for name in template_names():
            if chosen(_load_shipped(name)):
                return f"template {name}"
        return "" if kind.severity is ERROR else "keystore whose CA signed it"

    def shown(self, path: str | Path) -> str:
        """Return a path below the root as findings show it."""
        return os.path.join(self.root, path)


@dataclass(frozen=True)
class CheckedEnclave:
    """An enclave, the content of its files, and its keystore."""

    keystore: CheckedKeystore
    name: str
    state: OpenedEnclave

    @cached_property
    def folder(self) -> Path:
        """Its folder."""
        return enclave_path(self.keystore.root, self.name)

    @property
    def accepts_expiry(self) -> str:
        """Text naming the template that lets this enclave expire early; "" if none does."""
        settings = self.keystore.settings
        short = settings is not None and settings.longest_validity(self.name) is not None
        return f"template {settings.name}" if settings and short else ""

    def file(self, name: str) -> str:
        """Return the path of one of its files."""
        return f"{self.folder}/{name}"


def read_keystore(
    keystore: Keystore,
    *,
    now: datetime,
    zone: tzinfo = UTC,
    policies: tuple[Policy, ...] = (),
    on_robot: bool = False,
    distribution: str = "",
) -> CheckedKeystore:
    """Return the readable parts of a keystore, and the list of unreadable ones.

    Args:
        keystore: the keystore, or an export of it.
        now: the moment to check for.
        zone: the time zone of the host on which its enclaves run.
        policies: policies with which its permissions are compared.
        on_robot: whether it is on a robot, even if it contains CA keys.
        distribution: the ROS 2 distribution of its nodes; "" is the latest.

    Raises:
        KeystoreError: it is no keystore.
    """
    keystore.check()
    root = keystore.root
    unread: list[UnreadablePart] = []

    def part(path: str, read: Callable[[], _Part], otherwise: _Part) -> _Part:
        try:
            return read()
        except SrosError as error:
            unread.append(UnreadablePart(path, error))
        except OSError as error:
            why = SrosError(f"'{path}' cannot be read", f"{error.strerror}.")
            unread.append(UnreadablePart(path, why))
        return otherwise

    def authority(role: str) -> tuple[x509.Certificate, ...]:
        return part(ca_certificate(role), lambda: keystore.authority(role), ())

    settings = part(SETTINGS, lambda: keystore.settings, None)
    ledger = part(LEDGER, lambda: keystore.ledger, Ledger())
    crl = part(CRL, lambda: keystore.revocation_list, None)
    authorities = {role: chain for role in ROLES if (chain := authority(role))}
    signed = root / GOVERNANCE_P7S
    governance = part(
        GOVERNANCE_P7S,
        lambda: keystore.read(signed, "governance document") if signed.is_file() else b"",
        b"",
    )
    signed_governance: Governance | None = None
    with suppress(SrosError):  # what is wrong with it is a finding of each enclave
        signed_governance = keystore.governance
    edits = hand_edits(keystore, ledger, settings, signed_governance)
    return CheckedKeystore(
        keystore,
        now,
        search_enclaves(root)[0],  # `check_files` reports folders that cannot be read
        settings,
        authorities,
        crl,
        ledger,
        governance,
        tuple(unread),
        policies,
        zone,
        keystore.is_home and not on_robot,
        keystore.is_home,
        edits,
        part(FLEET, lambda: load_fleet(keystore), None),
        part(FLEET, lambda: edited_fleet(keystore, ledger), ""),
        distribution,
    )
