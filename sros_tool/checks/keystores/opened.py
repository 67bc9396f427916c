"""A view of a keystore for checks: its readable parts, and the unreadable ones."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime, tzinfo
from functools import cache, cached_property
from pathlib import Path
from typing import NamedTuple, TypeVar

from cryptography import x509

from sros_tool.checks.kind import ERROR, FindingKind
from sros_tool.dds.advisories import Advisory
from sros_tool.dds.governance import Governance
from sros_tool.errors import SrosError
from sros_tool.fleet.robots import Fleet
from sros_tool.keystore.fleet import fleet_edits_clause, left_enclaves, load_fleet
from sros_tool.keystore.layout import (
    CRL,
    FLEET,
    GOVERNANCE_P7S,
    LEDGER,
    PUBLIC,
    ROLES,
    SETTINGS,
    ca_certificate_path,
    search_enclaves,
)
from sros_tool.keystore.ledger import Ledger
from sros_tool.keystore.reader import OpenedEnclave, OpenedKeystore
from sros_tool.keystore.settings import HandEdits, hand_edits
from sros_tool.keystore.template import Template, load_template, template_names
from sros_tool.pki.crl import RevocationList
from sros_tool.policy.model import Policy
from sros_tool.xml import why_unreadable

_Part = TypeVar("_Part")


_load_shipped = cache(load_template)


def _shipped_template(name: str) -> Template | None:
    """Return the template with this name that ships with sros, or None."""
    return _load_shipped(name) if name in template_names() else None


class UnreadablePart(NamedTuple):
    """A file that exists but cannot be read; ``path`` is relative to the keystore."""

    path: str
    error: SrosError


@dataclass(frozen=True, slots=True)
class Circumstances:
    """The moment, time zone and other conditions of a check."""

    now: datetime
    """The moment to check for."""
    zone: tzinfo = UTC
    """Time zone of the host on which enclaves run."""
    domain: int | None = None
    """The ROS domain that enclaves have to join."""
    policies: tuple[Policy, ...] = ()
    """Policies with which permissions are compared."""
    distribution: str = ""
    """ROS 2 distribution of the nodes, such as ``humble``; "" is the latest."""
    vendors: tuple[str, ...] = ()
    """DDS vendors of the nodes, or ``zenoh``; () if they may use any."""
    fleet: Fleet | None = None
    """The robots that placeholders in policies stand for, whose domains are compared, too."""
    advisories: tuple[Advisory, ...] | None = None
    """Known DDS vulnerabilities; None means the advisories that ship with sros."""
    sample: Sequence[str] | None = None
    """Names of the enclaves to check together with the keystore itself; None for all."""
    on_robot: bool = False
    """Whether a keystore is on a robot, where it must not have a CA key."""
    opened: dict[Path, OpenedKeystore] = field(default_factory=dict, repr=False, compare=False)
    """The keystores that are already open, by path."""

    def keystore(self, root: Path) -> OpenedKeystore:
        """Return the keystore at a path; it is opened once for all checks."""
        return self.opened.setdefault(root, OpenedKeystore(root))


@dataclass(frozen=True)
class CheckedKeystore:
    """A keystore, or an export for a robot, as checks read it.

    ``at`` has the moment and the other conditions of the check.  A file that exists and cannot be
    read counts as missing, and is listed in ``unread``.
    """

    opened: OpenedKeystore
    at: Circumstances
    _unread: dict[str, UnreadablePart] = field(default_factory=dict)

    def _part(self, path: str, read: Callable[[], _Part], otherwise: _Part) -> _Part:
        try:
            return read()
        except SrosError as error:
            self._unread[path] = UnreadablePart(path, error)
        except OSError as error:
            why = SrosError(
                f"'{path}' cannot be read", why_unreadable(self.root / path, error.errno)
            )
            self._unread[path] = UnreadablePart(path, why)
        return otherwise

    @property
    def unread(self) -> tuple[UnreadablePart, ...]:
        """The files that exist but cannot be read."""
        _ = self.settings, self.ledger, self.crl, self.authorities
        _ = self.governance, self.fleet, self.fleet_edits
        return tuple(self._unread.values())

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the enclaves; `check_files` reports folders that cannot be read."""
        return search_enclaves(self.root)[0]

    @cached_property
    def settings(self) -> Template | None:
        """The settings of the keystore; None if ros2/sros2 made the keystore."""
        return self._part(SETTINGS, lambda: self.opened.settings, None)

    @cached_property
    def ledger(self) -> Ledger:
        """The ledger of all issued files."""
        return self._part(LEDGER, lambda: self.opened.ledger, Ledger())

    @cached_property
    def crl(self) -> RevocationList | None:
        """The revocation list of the identity CA; None if it is missing or cannot be read."""
        return self._part(CRL, lambda: self.opened.revocation_list, None)

    @cached_property
    def authorities(self) -> dict[str, tuple[x509.Certificate, ...]]:
        """The certificates in the CA files by role, the issuing certificate first."""

        def chain(role: str) -> tuple[x509.Certificate, ...]:
            return self._part(ca_certificate_path(role), lambda: self.opened.authority(role), ())

        return {role: certificates for role in ROLES if (certificates := chain(role))}

    @cached_property
    def governance(self) -> bytes:
        """The signed governance that the enclaves share, or b""."""
        exists = (self.root / GOVERNANCE_P7S).is_file()

        def read() -> bytes:
            return self.opened.read(GOVERNANCE_P7S, "governance document") if exists else b""

        return self._part(GOVERNANCE_P7S, read, b"")

    @cached_property
    def edits(self) -> HandEdits:
        """Edits by hand in the settings and in the fleet file."""
        signed: Governance | None = None
        with suppress(SrosError):  # a faulty settings file is a finding of each enclave
            signed = self.opened.governance
        return hand_edits(self.opened, self.ledger, self.settings, signed)

    @cached_property
    def fleet(self) -> Fleet | None:
        """The robots of the keystore, or None if it has no fleet."""
        return self._part(FLEET, lambda: load_fleet(self.opened), None)

    @cached_property
    def left_enclaves(self) -> dict[str, str]:
        """The enclaves of robots that left the fleet, or their group, with these robots."""
        return left_enclaves(self.opened, self.fleet, self.at.now) if self.fleet else {}

    @cached_property
    def fleet_edits(self) -> str:
        """A clause that says how the fleet file was changed by hand, or ""."""
        return self._part(FLEET, lambda: fleet_edits_clause(self.opened, self.ledger), "")

    @property
    def looks_like_original(self) -> bool:
        """Whether the folder has the layout of a keystore with CAs, even on a robot."""
        return self.opened.is_original

    @property
    def is_original(self) -> bool:
        """Whether this is the original keystore, with its CAs, and does not lie on a robot."""
        return self.looks_like_original and not self.at.on_robot

    @property
    def root(self) -> Path:
        """Folder of the keystore."""
        return self.opened.root

    def enclave(self, name: str) -> OpenedEnclave:
        """Return an enclave of the keystore at the moment of the check."""
        return self.opened.enclave(name, now=self.at.now)

    @property
    def can_issue(self) -> bool:
        """Whether the keystore has its CAs, so that sros commands can issue and sign in it."""
        return self.is_original and any(
            (self.root / folder).exists() for folder in (PUBLIC, SETTINGS)
        )

    def accepted_by(self, kind: FindingKind, accepts_weakness: Callable[[Template], bool]) -> str:
        """Return text that names the template or keystore which accepts a weakness, or "".

        ``accepts_weakness`` returns whether settings choose the weakness.  Its argument is the
        template as sros ships it, so a changed setting of this keystore accepts nothing.  Without
        settings (keystores of ros2/sros2) no weakness is accepted.

        An export has no settings, so it is compared with all templates.  If no template chooses the
        weakness, the original keystore must have chosen it, and counts as accepting it, unless the
        finding is an error.
        """
        if self.settings:
            name = self.settings.name
            template = _shipped_template(name) or self.settings
            return f"template {name}" if accepts_weakness(template) else ""
        if self.is_original:
            return ""
        for name in template_names():
            if accepts_weakness(_load_shipped(name)):
                return f"template {name}"
        return "" if kind.severity is ERROR else "keystore whose CA signed the file"

    def shown_path(self, path: str | Path) -> str:
        """Return the path of a file below the root in the form that findings show."""
        return os.path.join(self.root, path)


@dataclass(frozen=True)
class CheckedEnclave:
    """An enclave as checks read it: its name, its files, and its keystore."""

    keystore: CheckedKeystore
    name: str
    state: OpenedEnclave

    @cached_property
    def folder(self) -> Path:
        """Folder of the enclave."""
        return self.keystore.opened.folder(self.name)

    @property
    def expiry_accepted_by(self) -> str:
        """Text that names the template which accepts this enclave's early expiry, or ""."""
        settings = self.keystore.settings
        # Imported here, because it reads all about renewals.
        from sros_tool.keystore.expiry import enclaves_renewed_by_name

        opened, names = self.keystore.opened, [self.name]
        accepts = settings and enclaves_renewed_by_name(opened, settings, names)
        return f"template {settings.name}" if settings and accepts else ""

    def file(self, name: str) -> str:
        """Return the path of a file of the enclave in the form that findings show."""
        return f"{self.folder}/{name}"
