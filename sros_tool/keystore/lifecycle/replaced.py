"""The rights that an enclave gains and loses when its permissions are replaced.

DDS Security 1.1 cannot revoke permissions: whoever kept replaced permissions and a certificate with
the same subject can use them until they expire (ros2/sros2 issue 275).
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from shlex import quote

from cryptography import x509

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.permissions import Grant
from sros_tool.errors import Note, SrosError
from sros_tool.fleet.robots import Fleet, folded_lines
from sros_tool.keystore.delivery.published import may_have_later_releases
from sros_tool.keystore.known_keys import IssuedCredentials, restored_at
from sros_tool.keystore.layout import PERMISSIONS_FILE
from sros_tool.keystore.ledger import Entry, certificate_entry
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.rights import load_rights
from sros_tool.keystore.template import Template
from sros_tool.names import is_expression
from sros_tool.pki.certificates import key_digest, subject_text, validity_of
from sros_tool.policy.model import ALLOW, DENY, Enclave, Policy
from sros_tool.policy.rights import (
    Right,
    Rules,
    compare,
    lost_counterparts_text,
    policy_rights,
    rights_without_counterpart,
)
from sros_tool.translate import grant_rights
from sros_tool.validity import iso
from sros_tool.wording import first_few


@dataclass(frozen=True, slots=True)
class EarlierPermissions:
    """The permissions of an enclave before their replacement, and the enclave's certificate."""

    certificate: x509.Certificate
    grant: Grant


@dataclass(frozen=True, slots=True)
class ReplacedRights:
    """The rights that an enclave gains and loses with its new permissions.

    A new denial counts as lost, a removed denial as gained, if it denies an allowed name.
    """

    enclave: str
    """The enclave."""
    lost: tuple[Right, ...]
    """Rights that were taken away, and denials that were added."""
    gained: tuple[Right, ...]
    """Rights that were added, and denials that were taken away."""
    works_until: datetime | None
    """Expiry, in UTC, of the enclave's last permissions in the ledger: until then, anyone who kept
    these permissions with their certificate can use them. Null if no permissions work any more.
    """
    lost_domains: str = ""
    """ROS domains, such as 0,7, for which the enclave has no permissions any more."""
    gained_domains: str = ""
    """ROS domains for which the enclave has permissions now, but had none before."""
    may_work_longer: bool = False
    """Whether permissions that the ledger lacks may work longer, because the keystore is an old
    copy, or was restored from a backup.
    """

    def after_revocation(self) -> ReplacedRights:
        """Return the same rights after the revocation of the enclave's earlier certificate."""
        return replace(self, works_until=None)

    def lost_text(self, fleet: Fleet | None = None) -> str:
        """Return the lost rights and domains as text; "" if there are none.

        Rights to names that differ only in the robot of ``fleet`` share an entry.
        """
        return self._text(_described_rights(self.lost), self.lost_domains, fleet)

    def gained_text(self, fleet: Fleet | None = None) -> str:
        """Return the gained rights and domains as text, like `lost_text`; "" if there are none."""
        return self._text(_described_gains(self.gained), self.gained_domains, fleet)

    def _text(self, described: Sequence[str], domains: str, fleet: Fleet | None) -> str:
        folded = folded_lines(fleet, ((self.enclave, text) for text in described))
        texts = (
            first_few(list(folded), _RIGHTS_SHOWN),
            f"domain {domains}" if domains else "",
        )
        return ", ".join(filter(None, texts))


def permissions_to_replace(
    keystore: OpenedKeystore,
    name: str,
    authority: x509.Certificate,
    certificate: x509.Certificate | None = None,
) -> EarlierPermissions | None:
    """Return the permissions that an enclave has now; None if DDS would refuse them.

    ``authority`` is the permissions CA.  ``certificate`` is the enclave's certificate, if the
    caller has already read it.
    """
    with suppress(SrosError):
        certificate = certificate or keystore.certificate_of(name)
        granted = keystore.signed_grant(name, subject_text(certificate.subject))
        granted.signed.verify(authority)
        if granted.grant:
            return EarlierPermissions(certificate, granted.grant)
    return None


def replaced_rights(
    name: str, earlier_permissions: EarlierPermissions, grant: Grant, now: datetime
) -> ReplacedRights:
    """Return the rights gained and lost when ``grant`` replaces ``earlier_permissions``.

    Other permissions of the enclave may work longer than ``earlier_permissions``;
    `with_expiries_in_ledger` adds their expiry.
    """
    earlier = earlier_permissions.grant
    rights_before, rights_after = grant_rights(name, earlier), grant_rights(name, grant)
    difference = compare(rights_before, rights_after)
    rules = Rules(rights_before | rights_after)
    all_allowed = earlier.default_allow or grant.default_allow
    lost: list[Right] = []
    gained: list[Right] = []
    for sign, right in difference.lines():
        # A denial changes nothing unless something it denies is allowed before or after.
        matters = all_allowed or rules.overlaps(right._replace(qualifier=ALLOW))
        if matters and right not in difference.covered:
            taken = (sign == "-") == (right.qualifier is ALLOW)
            (lost if taken else gained).append(right)
    end = validity_of(earlier_permissions.certificate).not_after
    with suppress(SrosError):  # the expiry is before the beginning
        end = min(end, earlier.validity.not_after)
    before, after = earlier.domains().closed(), grant.domains().closed()
    lost_domains, gained_domains = (
        str(DomainSet.of(*((domain, domain) for domain in here if domain not in there)))
        for here, there in ((before, after), (after, before))
    )
    works_until = end if end >= now else None
    return ReplacedRights(
        name, tuple(lost), tuple(gained), works_until, lost_domains, gained_domains
    )


def counterpart_notes(
    keystore: OpenedKeystore, replaced_rights: Iterable[ReplacedRights], created: Iterable[Enclave]
) -> Iterator[Note]:
    """Yield a note on rights that are useless after the change, as nobody has their counterpart.

    An example is the right to publish a topic to which no enclave may subscribe any more.
    ``keystore`` is the keystore before the change, and ``created`` are the new enclaves.  There is
    no note if permissions of the keystore cannot be read.
    """
    removed: set[Right] = set()
    added: set[Right] = set()
    for replaced in replaced_rights:
        for rights, of_allow, of_deny in (
            (replaced.lost, removed, added),
            (replaced.gained, added, removed),
        ):
            for right in rights:
                (of_allow if right.qualifier is ALLOW else of_deny).add(right)
    names = {right.name for right in removed if right.qualifier is ALLOW}
    names |= {right.name for right in added if right.qualifier is DENY}
    if not names:
        return
    with suppress(SrosError):  # a hint, without which the change is right, too
        source = load_rights(keystore, only_enclaves=_enclaves_naming(keystore, names))
        before = source.rights
        after = before.difference(removed).union(added, policy_rights(Policy(tuple(created))))
        lost = rights_without_counterpart(before, after, compare(removed, added))
        if lost and source.sound:
            yield Note("permissions.no-counterpart", lost_counterparts_text(lost))


def _enclaves_naming(keystore: OpenedKeystore, names: Collection[str]) -> list[str]:
    """Return the enclaves whose permissions may have one of ``names``, perhaps by a wildcard.

    The files are searched for the text of the names, so that most need not be parsed.
    """
    if len(names) > _MOST_SEARCHED_NAMES or any(map(is_expression, names)):
        return list(keystore.names)
    texts = re.compile(b"|".join([_WILDCARD_BYTES, *(re.escape(name.encode()) for name in names)]))
    return [
        enclave
        for enclave in keystore.names
        if texts.search(keystore.read(keystore.folder(enclave) / PERMISSIONS_FILE, "permissions"))
    ]


_MOST_SEARCHED_NAMES = 20
_WILDCARD_BYTES = rb"[*\[&]|\?(?!xml |>)"
"""A character in permissions that may belong to a wildcard, or to an escape."""


def with_expiries_in_ledger(
    keystore: OpenedKeystore, replaced_rights: Collection[ReplacedRights], now: datetime
) -> tuple[ReplacedRights, ...]:
    """Return the replaced rights with the latest expiry that the ledger has for their enclave.

    The ledger may have permissions that work longer than the replaced ones: a robot has them if the
    keystore was restored from a backup.
    """
    if not replaced_rights:
        return ()
    issued = IssuedCredentials(keystore, {rights.enclave for rights in replaced_rights})
    may_work_longer = may_lack_entries(keystore)
    return tuple(
        replace(
            rights,
            works_until=until if until and until >= now else None,
            may_work_longer=may_work_longer,
        )
        for rights in replaced_rights
        for until in (
            max(
                filter(None, (rights.works_until, issued.permissions_until(rights.enclave))),
                default=None,
            ),
        )
    )


def certificates_until(
    keystore: OpenedKeystore, superseded: Collection[SupersededCertificate], template: Template
) -> datetime | None:
    """Return when the last replaced certificate stops working; None if none was replaced.

    A certificate needs permissions for its subject.  If an enclave's new certificate has another
    subject, no more permissions are signed for the replaced certificate, which therefore works
    until its last permissions expire.  In Zenoh, and in a domain that everybody may join, a
    certificate needs no permissions.
    """
    needs_permissions = False
    with suppress(SrosError):
        rules = keystore.governance.domain_access_rules
        needs_permissions = template.zenoh is None and all(
            rule.enable_join_access_control for rule in rules
        )
    issued = IssuedCredentials(keystore, {replaced.name for replaced in superseded})
    ends = (
        issued.certificates_until(replaced.old, replaced.new_subject if needs_permissions else None)
        for replaced in superseded
    )
    return max(ends, default=None)


def may_lack_entries(keystore: OpenedKeystore) -> bool:
    """Return whether the ledger may lack certificates and permissions that the keystore issued.

    If so, the keystore is an old copy, or was restored from a backup.
    """
    return bool(restored_at(keystore) or may_have_later_releases(keystore))


@dataclass(frozen=True, slots=True)
class SupersededCertificate:
    """A replaced certificate, with the key digest and the subject of the new certificate.

    ``name`` is the enclave, and ``old`` the ledger entry of the replaced certificate.
    """

    name: str
    old: Entry
    new_key: str
    new_subject: str

    @classmethod
    def record(
        cls, name: str, old: x509.Certificate, new: x509.Certificate, now: datetime
    ) -> SupersededCertificate:
        """Return the record that the certificate ``new`` replaced ``old`` at the time ``now``."""
        entry = certificate_entry(now, "certificate", old, name)
        key = key_digest(new.public_key())  # type: ignore[arg-type]
        return cls(name, entry, key, subject_text(new.subject))


_RIGHTS_SHOWN = 6
_ENCLAVES_SHOWN = 3


def gained_rights_text(rights: Sequence[Right]) -> str:
    """Return gained rights as text, such as ``publish topic /a, call action /b``."""
    return first_few(_described_gains(rights), _RIGHTS_SHOWN)


def _described_gains(rights: Sequence[Right]) -> list[str]:
    return _described_rights(rights, " (where allowed: a DENY is gone)")


def _described_rights(rights: Sequence[Right], of_denial: str = " (by a DENY)") -> list[str]:
    """Return each right as text, that of an added or removed denial with ``of_denial``."""
    return [right.describe() + ("" if right.qualifier is ALLOW else of_denial) for right in rights]


def old_program_text(replaced_rights: Iterable[ReplacedRights]) -> str:
    """Return a sentence on programs that still use lost rights; "" if no rights were lost."""
    if not any(rights.lost_text() for rights in replaced_rights):
        return ""
    return (
        "a program that still uses a lost right may fail to start with the new files: start a "
        "version that does not use the right, or sign the earlier policy again"
    )


def lasting_text(root: Path, replaced_rights: Sequence[ReplacedRights]) -> str:
    """Return sentences on lost rights that still work, and on how to end them; "" if none works."""
    lasting = [
        rights
        for rights in replaced_rights
        if rights.lost_text() and (rights.works_until or rights.may_work_longer)
    ]
    if not lasting:
        return ""
    ends = [rights.works_until for rights in lasting if rights.works_until]
    at_least = "at least " if any(rights.may_work_longer for rights in lasting) else ""
    latest = " at the latest" if len({*ends}) > 1 and not at_least else ""
    work = f"still work {at_least}until {iso(max(ends))}{latest}" if ends else "may still work"
    names = [rights.enclave for rights in lasting]
    if len(names) == 1:
        lost, kept = f"{names[0]}: the rights that it lost", "its earlier permissions and its key"
        owner = "this enclave"
    else:
        lost = f"{first_few(names, _ENCLAVES_SHOWN)}: the rights that they lost"
        kept, owner = "earlier permissions and keys", "these enclaves"
    which = " ".join(map(quote, names)) if len(names) <= _ENCLAVES_SHOWN else "ENCLAVE..."
    others = "" if len(names) <= _ENCLAVES_SHOWN else " (or with --robot NAME, or --all)"
    return (
        f"{lost} {work} for whoever kept {kept}; running processes have these rights until they "
        f"are restarted. To end these rights, run `sros renew {quote(str(root))} {which} "
        f"--revoke-old`{others}, and restart all processes, first those of {owner}."
    )
