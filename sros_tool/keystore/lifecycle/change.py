"""The steps that every change of a keystore shares, and the base class of the results.

The order is the same for every verb: lock and recover, open the keystore once, note files that were
edited by hand, determine the new state, prove, sign and stage it, update Zenoh configurations,
write the ledger, check that vendors accept the enclaves, and put everything in place in one step.
A verb determines the new state; this module does the rest.  Because Zenoh configurations are
updated in the same transaction, DDS and Zenoh enforce the same rights at any moment.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from functools import cached_property
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any, Required, Self, TypedDict, TypeVar

from cryptography import x509

from sros_tool.dds.decision.vendors import Vendor
from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import Governance
from sros_tool.errors import KeystoreError, Note, SrosError
from sros_tool.fleet.changes import renewal_notes
from sros_tool.fleet.robots import Fleet, enclaves_of, similar_names_notes
from sros_tool.keystore.fleet import (
    checked_fleet,
    fleet_before_change,
    with_routers_of_robots,
    write_fleet,
)
from sros_tool.keystore.issuing.acceptance import refuse_stopping_nodes
from sros_tool.keystore.issuing.authority import Authorities, Authority, load_authority
from sros_tool.keystore.issuing.enclave import EnclaveTokens, EnclaveWriter
from sros_tool.keystore.issuing.keyring import IN_KEYSTORE, Keyring
from sros_tool.keystore.known_keys import (
    KnownKeys,
    new_key_clause,
    other_keys_remedy,
    restored_at,
    unknown_authorities,
    unlisted_revocations,
)
from sros_tool.keystore.layout import (
    GOVERNANCE_P7S,
    IDENTITY,
    PERMISSIONS,
    PERMISSIONS_FILE,
    PUBLIC,
    ROLES,
    check_keystore,
)
from sros_tool.keystore.ledger import (
    BY_POLICY,
    Entry,
    Ledger,
    append,
    certificate_entry,
    document_entry,
)
from sros_tool.keystore.lifecycle.replaced import ReplacedRights, SupersededCertificate
from sros_tool.keystore.outcomes import StagedZenoh
from sros_tool.keystore.reader import OpenedKeystore, check_domain
from sros_tool.keystore.rights import RecordedRights, SignedRights
from sros_tool.keystore.settings import (
    edit_notes,
    edit_remedy,
    find_edits,
    present_settings,
    write_settings,
)
from sros_tool.keystore.template import Template
from sros_tool.keystore.transaction import Change, Transaction, recover_keystore
from sros_tool.keystore.zenoh_files import (
    Drift,
    DriftedConfiguration,
    ZenohChange,
    drifted_configurations,
    signed_path,
    stale_files,
    zenoh_documents,
)
from sros_tool.pki.certificates import authority_text, validity_of
from sros_tool.pki.keys import PublicKey
from sros_tool.pki.token import TokenUri
from sros_tool.policy.model import Enclave
from sros_tool.translate import protection_for
from sros_tool.validity import iso, parse_iso, window
from sros_tool.wording import counted, first_few
from sros_tool.zenoh.configuration import ZenohNetwork, check_network

if TYPE_CHECKING:
    from sros_tool.keystore.lifecycle.revocation_list import RevocationListSigner


Result = TypeVar("Result", bound="Changed")


class ChangeOptions(TypedDict, total=False):
    """The options of every change of a keystore; `KeystoreChange` has their defaults."""

    now: Required[datetime]
    """Time of the change."""
    keyring: Keyring
    """The keyring with which the keys of the CAs are opened."""
    allow_refusal: Sequence[Vendor]
    """Vendors whose nodes may stop working."""
    dry_run: bool
    """Change nothing, and return the result that the change would have."""


_LEAST_NOTED_LOSS = timedelta(days=1)
"""How much earlier than requested a CA service's certificate may expire without a note."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Changed:
    """The result of a change of a keystore, or the result that a dry run would have.

    ``outcomes`` maps enclaves to outcomes such as ``created`` or ``renewed``.  ``rights`` are the
    rights that enclaves gain and lose.  ``works_until`` is the latest expiry of replaced files, or
    None if no replaced file works any more.  ``may_work_longer`` says that replaced files which the
    ledger lacks may work longer, because the keystore was restored from a backup.  ``revoked`` is
    the number of revoked certificates.  ``restart`` are the enclaves whose processes have to be
    restarted, ``zenoh`` are the Zenoh configurations.  ``remarks`` are notes on open tasks.
    """

    root: Path
    dry_run: bool = False
    outcomes: Mapping[str, str] = field(default_factory=dict)
    changes: Sequence[Change] = field(default=(), repr=False)
    rights: tuple[ReplacedRights, ...] = field(default=(), repr=False)
    works_until: datetime | None = None
    may_work_longer: bool = False
    revoked: int = 0
    restart: tuple[str, ...] = ()
    zenoh: StagedZenoh = field(default_factory=StagedZenoh, repr=False)
    remarks: tuple[Note, ...] = field(default=(), repr=False)
    notes: tuple[Note, ...] = ()

    def names(self, outcome: str) -> tuple[str, ...]:
        """Return the names of the enclaves with an outcome."""
        return tuple(name for name, done in self.outcomes.items() if done == outcome)


class KeystoreChange:
    """A change of a keystore: a context manager, from the lock to the commit.

    Every part of the keystore is read once, when it is first needed.  A verb may set ``template``,
    ``domains``, ``fleet`` and the CAs to their new state; everything is then signed and recorded
    with these.  Nothing changes before `finish`.

    ``entries`` are for the ledger.  ``notes``, ``remarks``, ``revoked`` (number of revoked
    certificates) and ``restart`` (enclaves whose processes have to be restarted) are for the
    result.  ``crl`` is the revocation list (PEM) that a CA service signed.
    """

    def __init__(
        self,
        root: Path,
        *,
        now: datetime,
        keyring: Keyring = IN_KEYSTORE,
        allow_refusal: Sequence[Vendor] = (),
        dry_run: bool = False,
        new_keystore: bool = False,
    ) -> None:
        """Prepare the change, without reading or writing anything.

        Args:
            root: the keystore.
            now: the time of the change.
            keyring: the keyring for the keys of the CAs.
            allow_refusal: vendors whose nodes may stop working.
            dry_run: change nothing.
            new_keystore: the keystore does not exist yet.
        """
        self.root = root
        self.now = now
        self.keyring = keyring
        self.dry_run = dry_run
        self.is_new = new_keystore
        self.transaction = Transaction(root, new_keystore=new_keystore, dry_run=dry_run)
        self.keystore = OpenedKeystore(root)
        self.entries: list[Entry] = []
        self.notes: list[Note] = []
        self.remarks: list[Note] = []
        self.outcomes: Mapping[str, str] = {}
        self.revoked = 0
        self.restart: tuple[str, ...] = ()
        self.zenoh = StagedZenoh()
        self.crl = b""
        self._allowed = allow_refusal

    def __enter__(self) -> Self:
        """Recover and lock the keystore; a dry run does neither.

        Raises:
            KeystoreError: the folder is not a keystore, is busy, or cannot be read.
        """
        if not self.dry_run:
            recover_keystore(self.root)
        if not self.is_new:
            check_keystore(self.root)
        self.transaction.__enter__()
        self.keystore = OpenedKeystore(self.root, locked=not self.dry_run)
        return self

    def __exit__(self, *error: object) -> None:
        self.transaction.__exit__(*error)

    # ── the present and the new state ──────────────────────────────────────────────────────

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the enclaves before the change, sorted."""
        return self.transaction.enclaves

    @cached_property
    def template(self) -> Template:
        """The template in the keystore's settings; a verb may replace it."""
        return self.keystore.template

    @cached_property
    def identity(self) -> Authority:
        """The identity CA, with its key."""
        return self._authority(IDENTITY)

    @cached_property
    def permissions(self) -> Authority:
        """The permissions CA, with its key."""
        return self._authority(PERMISSIONS)

    @cached_property
    def authorities(self) -> Authorities:
        """Both CAs, with their keys."""
        return Authorities(self.identity, self.permissions)

    def open_authorities(self) -> None:
        """Open both CAs now, at the key places in the settings."""
        self.authorities  # noqa: B018 - read once

    def _authority(self, role: str) -> Authority:
        return load_authority(self.keystore, role, self.template, self.keyring, self.now)

    @cached_property
    def governance(self) -> Governance:
        """The signed governance before the change."""
        return self.keystore.governance

    @cached_property
    def domains(self) -> DomainSet:
        """The ROS domains of the keystore."""
        return self.governance.domains().closed()

    @cached_property
    def fleet(self) -> Fleet | None:
        """The fleet of the keystore, or None; raises an error if the fleet file was edited."""
        return checked_fleet(self.keystore)

    @cached_property
    def ledger(self) -> Ledger:
        """The ledger before the change."""
        return self.keystore.ledger

    @cached_property
    def known(self) -> KnownKeys:
        """The keys of enclaves, present and revoked."""
        return KnownKeys(self.keystore)

    @cached_property
    def recorded_rights(self) -> RecordedRights:
        """The rights of enclaves that the ledger records."""
        return RecordedRights(self.keystore)

    def begin_issuing(self, domain: int | None) -> None:
        """Open the CAs and the governance before enclaves are issued, and note manual edits.

        Raises:
            KeystoreError: a CA or the governance cannot be used, or the governance is not for
                ``domain``.
        """
        self.open_authorities()
        self.check_domain(domain)
        self.notes += self.edit_notes()

    def check_domain(self, domain: int | None) -> None:
        """Raise `KeystoreError` if ``domain`` is given and the governance is not for it."""
        check_domain(self.domains, domain, self.root)

    def write_fleet(self, fleet: Fleet, patterns: Collection[str]) -> Fleet:
        """Stage ``fleet``, with ``patterns`` added, as the keystore's fleet, and return it.

        If there is a Zenoh network, it gets the routers of the fleet's robots.
        """
        before = None if self.is_new else fleet_before_change(self.keystore)
        fleet, entries = write_fleet(self.transaction, self.keystore, fleet, patterns, self.now)
        self.fleet = fleet
        self.entries += entries
        self.notes += (*_short_lived_notes(fleet, self.template), *similar_names_notes(fleet))
        self.notes += renewal_notes(before, fleet)
        if self.template.zenoh:
            self.set_network(self.with_routers_of_robots(self.template.zenoh, before))
        elif any(robot.router for robot in fleet.robots.values()):
            self.notes.append(_no_network_note(self.keystore))
        return fleet

    def with_routers_of_robots(
        self, network: ZenohNetwork, before: Fleet | None = None
    ) -> ZenohNetwork:
        """Return a network with the routers of the fleet's robots, except those that are revoked.

        ``before`` is the previous fleet, whose routers are in the network.
        """
        if self.fleet is None:
            return network
        before = before or self.fleet
        wanted = with_routers_of_robots(network, before, self.fleet)
        missing = {*wanted.router_names()}.difference(self.names)
        gone = set() if self.is_new else self.known.enclaves_revoked_before(missing)
        if not gone:
            return wanted
        return with_routers_of_robots(network, before, self.fleet, gone)

    def set_network(self, network: ZenohNetwork) -> None:
        """Stage settings with another Zenoh network, if it differs from the present one.

        Raises:
            KeystoreError: the settings or other files were edited by hand.
            UsageError: the network cannot work.
        """
        if network == self.template.zenoh:
            return
        check_network(network)
        if not self.is_new and (edits := find_edits(self.keystore, self.governance)):
            raise KeystoreError(
                f"the settings of keystore '{self.root}' would get other Zenoh routers, but its "
                f"files were edited by hand: {'; '.join(edits.clauses())}",
                "Writing the settings would undo the edit, or apply it unnoticed.",
                f"First apply or undo the edit: {edit_remedy(self.root)}",
            )
        self.template = replace(self.template, zenoh=network)
        self.entries.append(write_settings(self.transaction, self.template, self.now))

    def edit_notes(self) -> tuple[Note, ...]:
        """Return notes on edited files, and on a revocation list that lacks revocations.

        This change does not carry out the edits.
        """
        return (*self._lacking_list_notes(), *edit_notes(self.keystore, self.governance))

    def _lacking_list_notes(self) -> Iterator[Note]:
        names: Sequence[str] = ()
        with suppress(SrosError):  # a list that cannot be read is refused where it is needed
            names = unlisted_revocations(self.keystore, self.now)
        if names:
            yield Note(
                "keystore.revocation-list-lacks",
                f"the revocation list lacks revoked certificates of {first_few(names, 5)}: "
                "processes that start now accept these certificates. Find out who put an earlier "
                f"list back, and run `sros crl {quote(str(self.root))} --refresh`.",
            )

    def unrevoked_key(self, name: str, certificate: x509.Certificate) -> PublicKey:
        """Return the public key of an enclave's ``certificate``, to certify it again.

        Raises:
            KeystoreError: the key was revoked.
        """
        public: PublicKey = certificate.public_key()  # type: ignore[assignment]
        remedy = f"Give the enclave another key: {new_key_clause(self.keystore, name)}."
        self.known.refuse_revoked_key(public, f"enclave {name}", remedy, certificate)
        return public

    def tokens(self, places: Mapping[str, TokenUri]) -> EnclaveTokens:
        """Return the keys of enclaves on tokens; ``places`` maps enclaves to the keys' places."""
        return EnclaveTokens(
            places, self.keyring.secrets, self.known, self.authorities, self.dry_run
        )

    def writer(self, *, keys_on_token: bool = False, revoke_old: bool = False) -> EnclaveWriter:
        """Return a writer of enclaves that uses the new settings and CAs.

        Raises:
            KeystoreError: ``revoke_old`` is set, but only a CA service can sign the revocation
                list.
        """
        if revoke_old and self.identity.service:
            raise KeystoreError(
                "a CA service cannot revoke earlier certificates while it issues new ones",
                "It signs its revocation list only after the keystore has the new certificates.",
                "Leave --revoke-old out, revoke the earlier certificates at the service, and give "
                f"its list: `sros crl {quote(str(self.root))} --refresh --crl FILE`.",
            )
        return EnclaveWriter(
            self.transaction,
            self.template,
            self.now,
            identity=self.identity,
            permissions=self.permissions,
            keys_on_token=keys_on_token,
            secrets=self.keyring.secrets,
            reason_of_stated=BY_POLICY if not self.is_new and restored_at(self.keystore) else "",
        )

    # ── consequences of the new state ──────────────────────────────────────────────────────

    def revocation_lists(self) -> RevocationListSigner:
        """Return the signer of the revocation lists."""
        from sros_tool.keystore.lifecycle.revocation_list import RevocationListSigner

        return RevocationListSigner(
            self.transaction,
            self.keystore,
            authority=self.identity,
            template=self.template,
            keyring=self.keyring,
            now=self.now,
            list_of_service=self.crl,
        )

    def revoke_superseded(
        self,
        superseded: Sequence[SupersededCertificate],
        *,
        recipients: Sequence[str] | None = None,
    ) -> None:
        """Revoke all earlier certificates of the enclaves whose certificates are ``superseded``.

        The enclaves ``recipients`` get the revocation list, and their processes must be restarted.
        The default is `RevocationListSigner.recipients`.

        Raises:
            KeystoreError: the keystore was restored, and this would revoke the key of a robot.
        """
        if not superseded:
            return
        self._refuse_revoking_keys_of_robots(superseded)
        lists = self.revocation_lists()
        revocations = lists.superseded_revocations(superseded)
        if recipients is None:
            recipients = lists.recipients()
        self.restart = self.names if recipients is None else tuple(recipients)
        self.entries += lists.sign(revocations, self.restart, incomplete=False)[1]
        self.remarks += lists.remarks
        self.revoked = len(revocations)

    def _refuse_revoking_keys_of_robots(self, superseded: Sequence[SupersededCertificate]) -> None:
        """Raise `KeystoreError` if only a key would stay valid that the robot does not have.

        The keystore was restored, and publishing or a message showed it the robot's key.
        """
        unknowing = self.known.made_unknowing([certificate.name for certificate in superseded])
        others = [
            name
            for name, key in ((each.name, each.new_key) for each in superseded)
            if key in unknowing or self.known.later_key(name, key)
        ]
        if others:
            of_enclaves = f"{first_few(others, 3)} than their robots"
            if len(others) == 1:
                of_enclaves = f"enclave {others[0]} than its robot"
            raise KeystoreError(
                f"the keystore has another key of {of_enclaves}",
                "After the backup of the keystore, the robot got a certificate for its key. "
                "--revoke-old would revoke this key.",
                other_keys_remedy(self.root, others),
            )

    def stage_zenoh(
        self,
        issued: Mapping[str, SignedRights],
        *,
        revoked_enclaves: frozenset[str] = frozenset(),
        replaced: Sequence[str] = (),
        stated: Mapping[str, Enclave | None] | None = None,
        created: Sequence[str] = (),
    ) -> None:
        """Stage the Zenoh configurations that the change requires.

        Args:
            issued: the new permissions of enclaves.
            revoked_enclaves: the enclaves that are revoked.
            replaced: the enclaves whose earlier certificates are revoked.
            stated: the policies of enclaves, for the lines that errors name.
            created: new enclaves, which have no running processes yet.

        Raises:
            PolicyError: Zenoh cannot express the rights of an enclave.
            KeystoreError: the enclave of the router is missing.
        """
        if self.template.zenoh is None:
            return
        change = ZenohChange(
            issued,
            revoked=revoked_enclaves,
            replaced=replaced,
            stated=stated or {},
            recorded=self.entries,
        )
        authority, existing = self._permissions_certificate(), self.transaction.enclaves
        wanted = zenoh_documents(
            *(self.keystore, self.template.zenoh, self.domains, authority, self.now, change),
            existing=existing,
        )
        drifts = [*drifted_configurations(self.keystore, wanted, authority, revoked_enclaves)]
        drifts = [drift for drift in drifts if drift.kind is not Drift.FOREIGN]
        for drift in drifts:
            if drift.kind is Drift.STALE:
                _remove_configuration(self.transaction, drift.path)
        changed = [drift for drift in drifts if drift.kind is not Drift.STALE]
        written = (
            _stage_configurations(self.transaction, wanted.files, changed, self.permissions)
            if changed
            else {}
        )
        names = tuple(wanted.enclaves.values())
        self.zenoh = StagedZenoh(
            {name: path for path, name in wanted.enclaves.items()},
            wanted.nodes,
            {name: why.rstrip(".") for name, why in wanted.left_out.items()},
            written,
            tuple(sorted({drift.enclave for drift in drifts if drift.kind is not Drift.UNSIGNED})),
            (
                *_left_out_notes(wanted.left_out),
                *_revoked_name_notes(wanted.ledger, names, self.now, replaced),
            ),
        ).without_restart_of(created)
        self.notes += self.zenoh.notes

    def _permissions_certificate(self) -> x509.Certificate:
        """Return the permissions CA's certificate; its key is opened only if it is needed."""
        if "permissions" in self.__dict__:
            return self.permissions.certificate
        return self.keystore.ca_certificate(PERMISSIONS)

    # ── ledger and commit ──────────────────────────────────────────────────────────────────────

    def record(self, signer: Authority | None = None) -> None:
        """Stage the ledger with the new entries, signed by the identity CA or by ``signer``.

        If the identity CA is a CA service, the permissions CA signs.  In a keystore of ros2/sros2,
        entries for its existing files come first.
        """
        if not self.entries:
            return
        if signer is None:
            signer = self.permissions if self.identity.service else self.identity
            self._check_certificates_of_service()
        if behind := self.keystore.ledger_file.clock_clause(self.now):
            text = (
                f"{behind}. If the clock is wrong, set it: files that are made now are valid for "
                "too short a time. If it is right, it was ahead at the last change: the ledger "
                "now has an entry with the right time, but certificates and permissions that were "
                "made with the wrong time may not be valid yet. "
                f"`sros check {quote(str(self.keystore.root))}` names them; renew them."
            )
            self.notes.append(Note("keystore.clock", text))
        if faults := self.keystore.ledger_file.reading_for_append().unrecorded:
            text = (
                f"the ledger is damaged ({'; '.join(fault.text for fault in faults)}), and this "
                "change records that: the damage then stays visible until the CAs are replaced. If "
                "a backup has the ledger, restore ledger.jsonl and ledger.p7s from it, and repeat "
                "the change."
            )
            self.notes.append(Note("keystore.ledger-damaged", text))
        self.entries = _take_over_records(self.transaction, self.keystore, self.now, self.entries)
        append(
            self.transaction,
            self.entries,
            signer.sign,
            self.now,
            self.keystore.ledger_file,
        )

    @property
    def has_placeholder_certificates(self) -> bool:
        """Whether certificates are only placeholders, as in a dry run with a CA service."""
        return self.dry_run and bool(self._entries_of_ca_service())

    @property
    def moment(self) -> datetime:
        """The time of the change, or later: when certificates of a CA service become valid."""
        return max(
            [self.now, *(parse_iso(entry.not_before) for entry in self._entries_of_ca_service())]
        )

    def _entries_of_ca_service(self) -> list[Entry]:
        """Return the ledger entries of the certificates that a CA service issued."""
        # Only a CA that was already opened counts.
        identity: Authority | None = self.__dict__.get("identity")
        if identity is None or identity.service is None:
            return []
        return [entry for entry in self.entries if entry.what == "certificate"]

    def _check_certificates_of_service(self) -> None:
        """Add notes on certificates of a CA service that expire earlier than requested.

        Raises:
            KeystoreError: a serial number was used before, so that a revocation would revoke both
                certificates.
        """
        if not (issued := self._entries_of_ca_service()):
            return
        serials = [entry.serial for entry in issued]
        known = self.keystore.ledger_file.with_values("serial", serials).entries
        counts = Counter([*serials, *(entry.serial for entry in known)])
        if equal := [entry for entry in issued if counts[entry.serial] > 1]:
            raise KeystoreError(
                f"the CA service issued a certificate for {equal[0].enclave} with a serial number "
                "that another certificate has",
                f"It is {equal[0].serial}; no revocation list could tell the two certificates "
                "apart. Nothing was changed.",
            )
        asked = window(self.now, self.template.certificate_validity)
        end = iso(
            asked.intersection(validity_of(self.identity.certificate)).not_after - _LEAST_NOTED_LOSS
        )
        usual = [e for e in issued if self.template.longest_validity(e.enclave) is None]
        if early := [entry for entry in usual if entry.not_after < end]:
            text = (
                f"the CA service lets the certificates of {counted(len(early), 'enclave')} expire "
                f"earlier than the keystore asks, the first at "
                f"{min(entry.not_after for entry in early)}."
            )
            self.notes.append(Note("service.expires-early", text))

    def finish(self, *, command: str = "", revoked_before: Collection[int] = ()) -> None:
        """Commit the change, unless vendors would refuse enclaves that they accept today.

        ``command`` is the command that needs a revocation list, such as ``revoke``, for error
        messages.  ``revoked_before`` are serial numbers that an earlier list already revoked.

        Raises:
            KeystoreError: nodes of a vendor would stop working.
        """
        if self.has_placeholder_certificates:
            text = (
                "the CA service was not asked in this dry run, so it is unknown whether it would "
                "issue the certificates, and whether DDS would accept them."
            )
            self.notes.append(Note("service.not-asked", text))
        else:
            self.notes += refuse_stopping_nodes(
                self.transaction,
                self.moment,
                keystore=self.keystore,
                allowed=self._allowed,
                revoked_before=revoked_before,
                remedy=lambda: self._another_ca_remedy(command) if command else "",
            )
        self._note_unknown_authorities()
        self.transaction.commit()

    def _note_unknown_authorities(self) -> None:
        """Add a note if the ledger has no gaps, but lacks a CA that is in a CA file."""
        written = (change.path for change in self.transaction.changes)
        replaced = any(path.startswith(f"{PUBLIC}/") and "_ca.cert" in path for path in written)
        if replaced or self.keystore.ledger_with("what", "ca").gaps:
            return
        strangers = [ca for role in ROLES for ca in unknown_authorities(self.keystore, role)]
        if strangers:
            text = (
                f"every process also trusts a CA that the keystore does not know, "
                f"{authority_text(strangers[0])}: find out who added it, with `sros check "
                f"{quote(str(self.root))}`."
            )
            self.notes.append(Note("keystore.unknown-authority", text))

    def _another_ca_remedy(self, command: str) -> str:
        from sros_tool.keystore.lifecycle.revocation_list import another_ca_remedy

        return another_ca_remedy(self.keystore, command)

    def result(self, kind: Callable[..., Result], **more: Any) -> Result:
        """Return the result as an instance of the class ``kind``.

        ``more`` are the fields that only this verb has.
        """
        shared: dict[str, Any] = {
            "root": self.root,
            "dry_run": self.dry_run,
            "outcomes": self.outcomes,
            "changes": self.transaction.changes,
            "revoked": self.revoked,
            "restart": self.restart or self.zenoh.restart,
            "zenoh": self.zenoh,
            "remarks": tuple(self.remarks),
            "notes": tuple(self.notes),
        }
        return kind(**shared | more)


def _short_lived_notes(fleet: Fleet, template: Template) -> Iterator[Note]:
    """Yield a note on enclaves of robots that the keystore's settings make short-lived."""
    short_lived = [
        name
        for robot in fleet.robots.values()
        for name in (enclaves_of(fleet, robot) if template.short_lived else ())
        if template.longest_validity(name) is not None
    ]
    if short_lived:
        text = (
            f"the settings of the keystore make {first_few(short_lived, 3)} short-lived, so `sros "
            "renew --all-expiring` leaves them out (it renews the robots' other enclaves). This is "
            "right for enclaves of people: renew these by name. For a process that always runs, "
            "choose an enclave with another path in the policy (if it begins with the name of the "
            "robot, another name), or change `[[enclaves]]` in the settings."
        )
        yield Note("fleet.short-lived", text)


def _no_network_note(keystore: OpenedKeystore) -> Note:
    text = (
        "the fleet names Zenoh routers of robots, but the keystore has no Zenoh network yet; "
        f"create it with `sros zenoh {quote(str(keystore.root))}`."
    )
    return Note("fleet.no-zenoh-network", text)


_REASON_TAKEN_OVER = "taken over"
"""The ``reason`` of ledger entries for files that existed before the ledger."""


def _take_over_records(
    transaction: Transaction, keystore: OpenedKeystore, now: datetime, entries: Iterable[Entry]
) -> list[Entry]:
    """Return ``entries`` preceded by entries for the files of ros2/sros2, and stage settings.

    When sros first writes to a keystore of ros2/sros2, it creates settings with the values in
    force, and a ledger that begins with the existing files.  Nothing shows whether files were
    removed before, so the recorded files are trusted as they are, and the entries and the message
    say so.

    Only certificates and permissions that the keystore's CAs signed are recorded.  For a keystore
    of sros, the result is ``entries``.
    """
    added = list(entries)
    if not keystore.was_written_only_by_sros2:
        return added
    before = list(_entries_for_ros2_files(keystore, transaction.enclaves, now))
    transaction.note_adoption()
    if not any(entry.what == "settings" for entry in added):
        before += _settings_of_ros2(transaction, keystore, now)
    return [*before, *added]


def _entries_for_ros2_files(
    keystore: OpenedKeystore, names: Iterable[str], now: datetime
) -> Iterator[Entry]:
    authorities = dict.fromkeys(keystore.ca_certificate(role) for role in ROLES)
    for authority in authorities:
        yield certificate_entry(now, "ca", authority, reason=_REASON_TAKEN_OVER)
    with suppress(SrosError):  # the verb reports a missing one
        message = keystore.read(GOVERNANCE_P7S, "governance document")
        yield document_entry(now, "governance", message)._replace(reason=_REASON_TAKEN_OVER)
    for name in names:
        state = keystore.enclave(name, now=now)
        files = {problem.file for problem in state.problems_in_keystore}
        if state.certificate and "cert.pem" not in files:
            yield certificate_entry(now, "certificate", state.certificate, name, _REASON_TAKEN_OVER)
        message = state.files.get(PERMISSIONS_FILE, b"")
        if message and state.permissions_document and PERMISSIONS_FILE not in files:
            entry = document_entry(now, "permissions", message, enclave=name)
            yield entry._replace(reason=_REASON_TAKEN_OVER)


def _settings_of_ros2(
    transaction: Transaction, keystore: OpenedKeystore, now: datetime
) -> Iterator[Entry]:
    present = present_settings(keystore)
    if protection_for(present.governance):  # otherwise the settings would state another protection
        yield write_settings(transaction, present.settings, now)


def _stage_configurations(
    transaction: Transaction,
    files: Mapping[str, bytes],
    changed: Sequence[DriftedConfiguration],
    authority: Authority,
) -> dict[str, bytes]:
    """Stage the ``changed`` Zenoh configurations with signed documents; return content by path.

    ``files`` maps the paths of all configurations to their content.

    All cores sign together.
    """

    def stage(part: Sequence[DriftedConfiguration]) -> list[bytes]:
        documents = [files[drift.path] for drift in part]
        messages = [b""] * len(part)
        if not transaction.dry_run:
            messages = authority.sign_all(documents, "a Zenoh configuration")
        for drift, document, message in zip(part, documents, messages, strict=True):
            if drift.kind is not Drift.UNSIGNED:
                transaction.write(drift.path, document)
            transaction.write(signed_path(drift.path), message)
        return messages

    written: dict[str, bytes] = {}
    for part, signed in transaction.stage_on_all_cores(changed, stage, alone=authority.on_token):
        for drift, message in zip(part, signed, strict=True):
            if drift.kind is not Drift.UNSIGNED:
                written[drift.path] = files[drift.path]
            written[signed_path(drift.path)] = message
    return written


def remove_zenoh(transaction: Transaction) -> tuple[str, ...]:
    """Stage the removal of all Zenoh configurations of a keystore; return their enclaves."""
    present = stale_files(transaction.root, (), transaction.enclaves)
    stale = [drift for drift in present if drift.kind is Drift.STALE]
    for drift in stale:
        _remove_configuration(transaction, drift.path)
    return tuple(dict.fromkeys(drift.enclave for drift in stale))


def _remove_configuration(transaction: Transaction, path: str) -> None:
    for file in (path, signed_path(path)):
        if (transaction.root / file).is_file():
            transaction.remove(file)


# ── notes ──────────────────────────────────────────────────────────────────────────────────


def _left_out_notes(left_out: Mapping[str, str]) -> Iterable[Note]:
    """Yield a note for each reason, with all enclaves that have it."""
    names_of: defaultdict[str, list[str]] = defaultdict(list)
    for name, why in left_out.items():
        names_of[why.rstrip(".")].append(name)
    for why, names in names_of.items():
        get, reason = ("gets", "Reason") if len(names) == 1 else ("get", "Reason for each enclave")
        yield Note(
            "zenoh.left-out",
            f"{first_few(names, 5)} {get} no configuration for Zenoh, and may do nothing on Zenoh. "
            f"{reason}: {why}.",
        )


def _revoked_name_notes(
    ledger: Ledger, names: Sequence[str], now: datetime, replaced: Collection[str]
) -> Iterable[Note]:
    """Yield a note on enclaves that have a revoked certificate which has not expired.

    ``replaced`` are enclaves whose earlier certificates are revoked by this change.
    """
    entries = ledger.entries
    revoked = {entry.serial for entry in entries if entry.what == "revocation"}
    revoked_again = sorted(
        {
            entry.enclave
            for entry in entries
            if entry.what == "certificate"
            and entry.serial in revoked
            and entry.enclave in names
            and entry.not_after >= iso(now)
        }
        | {*replaced}
    )
    if revoked_again:
        yield Note(
            "zenoh.revoked-name",
            f"revoked certificates of {', '.join(revoked_again)} have not expired: "
            "Zenoh has no revocation list, so anyone who has such a certificate gets the rights "
            "of its enclave. Give the enclave another name, or replace the identity CA with "
            "`sros rotate_ca`.",
        )
