"""Find what changes for a keystore or policy with another ROS 2 distribution.

The signed files stay the same, but another release of DDS reads the files. For each enclave, the
rules of both releases decide whether the enclave joins and which topics it may use, for all names
together.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC
from pathlib import Path
from typing import NamedTuple

from sros_tool.checks.keystores.enclaves import fault_remedy
from sros_tool.checks.keystores.keystore import with_joined_findings
from sros_tool.checks.keystores.opened import CheckedEnclave, CheckedKeystore, Circumstances
from sros_tool.checks.keystores.topic_names import names_without_wildcards
from sros_tool.checks.keystores.vendors import (
    evaluate,
    example_domains,
    refusal_clause,
    with_start_finding,
)
from sros_tool.checks.kind import Finding, FindingKind
from sros_tool.checks.targets import policy_findings
from sros_tool.checks.upgrade import (
    ACCEPTED,
    BUFFERS,
    CLOSES,
    DIFFER,
    DISTRIBUTION_REFUSES,
    EXPIRED_PEERS,
    NO_NODE,
    NOT_MEASURED,
    OPENS,
    REFUSED,
    VULNERABILITIES,
    ZENOH,
)
from sros_tool.dds.advisories import Advisory, known_vulnerabilities
from sros_tool.dds.decision.access import Access, Outcome
from sros_tool.dds.decision.grants import other_fitting_enclaves
from sros_tool.dds.decision.vendors import Vendor
from sros_tool.distributions import Distribution, Shipped, find_distribution
from sros_tool.errors import UsageError
from sros_tool.faults import FAULTS
from sros_tool.fleet.expansion import read_policy_for
from sros_tool.keystore.fleet import enclaves_of_several_distributions, stated_distributions
from sros_tool.keystore.layout import PERMISSIONS_FILE, enclave_names, has_zenoh_files, is_keystore
from sros_tool.keystore.participant import (
    JoinContext,
    LoadedEnclave,
    RefusalCause,
    VendorParticipant,
    deciding_enclave,
    plan_enclave,
)
from sros_tool.keystore.protection import governance_with_stated_protections
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.rights import load_rights, load_zenoh_rights
from sros_tool.keystore.template import DEFAULT_TEMPLATE, load_template
from sros_tool.names import has_type_descriptions, is_expression
from sros_tool.policy.model import ALLOW, Policy, stated_protections
from sros_tool.policy.rights import Right, policy_rights
from sros_tool.proof.growth import AccessByVendors, Gain
from sros_tool.proof.sources import AccessSource
from sros_tool.proof.worlds import domains_of, zenoh_messages
from sros_tool.wording import counted, first_few
from sros_tool.zenoh.access import Enforcement, Remote
from sros_tool.zenoh.releases import version_text

_MOST_SHOWN = 4
_ZENOH = "zenoh"


@dataclass(frozen=True, slots=True)
class DecidedFiles:
    """The enclaves of a keystore or policy, with all that decisions need.

    Without a ROS domain in ``at``, example domains from the documents of each enclave count.
    ``keystore`` is None for a policy, whose file is ``file``.  ``chosen`` are the
    enclaves to decide on; None for all.  ``unique_subjects`` says that the subject of every
    certificate has a unique part.
    """

    file: str
    enclaves: Mapping[str, LoadedEnclave]
    source: AccessSource
    at: Circumstances
    keystore: OpenedKeystore | None = None
    unique_subjects: bool = False
    chosen: frozenset[str] | None = None

    def domains(self, enclave: LoadedEnclave) -> tuple[int, ...]:
        """Return the ROS domains for which to decide on an enclave."""
        if self.at.domain is not None:
            return (self.at.domain,)
        return example_domains(enclave.state) if enclave.state else (0,)

    def fitting_others(self, vendor: Vendor) -> Mapping[str, tuple[str, ...]]:
        """Map each enclave to the other enclaves whose permissions fit its certificate."""
        if self.unique_subjects:
            return {}
        subjects = {
            name: enclave.subject for name, enclave in self.enclaves.items() if enclave.subject
        }
        granted = {
            name: [grant.subject for grant in permissions.grants]
            for name, permissions in self.source.permissions.items()
        }
        return other_fitting_enclaves(vendor.traits, subjects, granted)

    def loaded_enclaves(self) -> Iterator[tuple[str, LoadedEnclave]]:
        """Yield names and files of the enclaves to decide on."""
        for name, enclave in self.enclaves.items():
            if self.chosen is None or name in self.chosen:
                yield name, enclave

    def only_for(self, enclaves: Iterable[str]) -> DecidedFiles:
        """Return the same files, to decide only on ``enclaves``.

        The permissions of other enclaves still count.
        """
        return replace(self, chosen=frozenset(enclaves))

    def path_of(self, enclave: str, file: str) -> str:
        """Return the path of a file of an enclave; for a policy, the path of the policy."""
        return f"{self.keystore.folder(enclave)}/{file}" if self.keystore else self.file


def signed_files(keystore: OpenedKeystore, at: Circumstances) -> DecidedFiles:
    """Return the enclaves of a keystore with their signed files.

    Raises:
        KeystoreError: the folder is not a keystore.
        DocumentError: rights in the keystore cannot be read.
    """
    keystore.check()
    names = enclave_names(keystore.root, hidden=True)
    source = load_rights(keystore, hidden=True)
    enclaves = {name: deciding_enclave(keystore, name, moment=at.now) for name in names}
    side = AccessSource(str(keystore.root), "keystore", source.rights, source.documents)
    return DecidedFiles(str(keystore.root), enclaves, side, at, keystore)


def _planned_files(policy: Policy, at: Circumstances) -> DecidedFiles:
    """Return the enclaves of a policy as they would be signed, with the default template."""
    template = load_template(DEFAULT_TEMPLATE)
    stated = stated_protections(policy.enclaves)
    governance = governance_with_stated_protections(template.protection, stated, at.domain or 0)
    enclaves = {
        enclave.path: plan_enclave(enclave, governance, moment=at.now)
        for enclave in policy.enclaves
    }
    permissions = {name: loaded.portable for name, loaded in enclaves.items() if loaded.portable}
    side = AccessSource(policy.file, "policy", policy_rights(policy), permissions)
    at = replace(at, zone=UTC)
    return DecidedFiles(policy.file, enclaves, side, at, unique_subjects=template.unique_subject)


# ── the update ─────────────────────────────────────────────────────────────────────────────


class UpgradeFindings(NamedTuple):
    """The findings on an update, and numbers of enclaves.

    ``compared`` is the number of compared enclaves; ``enclaves`` also counts enclaves that are for
    the later distribution already.
    """

    findings: list[Finding]
    compared: int
    enclaves: int


def check_upgrade(
    path: Path,
    later: Distribution,
    circumstances: Circumstances,
    *,
    present: Distribution | None = None,
    here: Distribution | None = None,
    vendor: str = "",
) -> UpgradeFindings:
    """Return findings on what the update to ``later`` changes for a policy or a keystore.

    Args:
        path: the policy or keystore.
        later: the distribution after the update.
        circumstances: the moment, the ROS domain, and other conditions.
        present: the distribution before the update; by default, the distributions that the keystore
            states.
        here: the distribution that is sourced, if the keystore states none.
        vendor: the only DDS vendor that is used, of any release, or ``zenoh``; "" for all.

    Raises:
        UsageError: the distribution before the update is not known, or is the same.
        DocumentError: a file cannot be read, or there are too many wildcards to decide.
    """
    if is_keystore(path):
        files = signed_files(circumstances.keystore(path), circumstances)
    else:
        files = _planned_files(read_policy_for(path, circumstances.fleet), circumstances)
    findings: list[Finding] = []
    by_distribution = _present_distributions(files, present, here, later)
    for before, enclaves in by_distribution.items():
        findings += _upgrade_findings(files.only_for(enclaves), before, later, vendor)
        findings += _vulnerability_findings(before, later, vendor, circumstances.advisories)
        if not files.keystore:
            findings += _newly_needed_right_findings(path, circumstances, before, later)
    compared = {name for enclaves in by_distribution.values() for name in enclaves}
    joined_findings = with_joined_findings(list(dict.fromkeys(findings)))
    return UpgradeFindings(joined_findings, len(compared), len(files.enclaves))


def _present_distributions(
    files: DecidedFiles,
    named: Distribution | None,
    here: Distribution | None,
    later: Distribution,
) -> Mapping[Distribution, list[str]]:
    """Map each distribution that is in use before the update to its enclaves."""
    by_distribution: dict[Distribution, list[str]] = {}
    unknown: list[str] = []
    for name in files.enclaves:
        stated = stated_distributions(files.keystore, name) if files.keystore and not named else ()
        if not (stated or named or here):
            unknown.append(name)
        for distribution in map(find_distribution, stated) if stated else (named or here,):
            if distribution and distribution != later:
                by_distribution.setdefault(distribution, []).append(name)
    if unknown or (files.enclaves and not by_distribution):
        source = first_few(unknown, _MOST_SHOWN) if by_distribution else f"'{files.file}'"
        raise UsageError(
            f"it is not known from which distribution {source} is updated to {later.title}",
            "Neither --distro, nor $ROS_DISTRO, nor the keystore names another distribution.",
            "Name the current distribution, for example with --distro jazzy.",
        )
    return by_distribution


def _upgrade_findings(
    files: DecidedFiles, before: Distribution, after: Distribution, vendor: str
) -> Iterator[Finding]:
    for distribution in (before, after):
        if distribution.assumption:
            yield NOT_MEASURED.found(f"ROS 2 {distribution.title}", distribution.assumption)
    for old, new in _products(before, after, vendor):
        yield from _untested_findings(old, new)
        yield from _expired_peers_findings(old, new)
        for change in changes(files, old, new):
            kind = _KINDS[change.kind]
            yield kind.found(change.enclave, change.text, change.file, remedy=change.remedy)
    yield from _node_start_findings(files, before, after)
    if vendor in ("", _ZENOH):
        yield from _zenoh_findings(files, before, after)


def _products(
    before: Distribution, after: Distribution, vendor: str
) -> Iterator[tuple[Shipped, Shipped]]:
    """Yield, for each DDS product, its releases in the earlier and in the later distribution.

    With ``vendor``, yields only the product of this vendor.
    """
    product = Vendor(vendor).traits.product if vendor not in ("", _ZENOH) else ""
    for old in before.shipped if vendor != _ZENOH else ():
        if (new := after.shipped_product(old.product)) and product in ("", old.product):
            yield old, new


def _vulnerability_findings(
    before: Distribution, after: Distribution, vendor: str, advisories: Sequence[Advisory] | None
) -> Iterator[Finding]:
    """Yield findings on vulnerabilities that the latest release of only one distribution has."""
    for releases in _products(before, after, vendor):
        known = [
            known_vulnerabilities(release.product, release.latest, advisories)
            for release in releases
        ]
        if None in known or releases[0].latest == releases[1].latest:
            continue
        old, new = (
            {advisory.id for advisory in vulnerabilities.known}
            for vulnerabilities in known
            if vulnerabilities
        )
        unclear = {advisory.id for advisory in known[1].unclear} if known[1] else set()
        parts = [counted(len(old & new), "stays", "stay")] if old & new else []
        for ids, status in (
            (old - new - unclear, "fixed"),
            (old & unclear, f"not known for {releases[1].latest}"),
            (new - old, "new"),
        ):
            parts += [f"{status}: {', '.join(sorted(ids))}"] if ids else []
        if old != new:
            title = f"{releases[0].product} {releases[0].latest} to {releases[1].latest}"
            yield VULNERABILITIES.found(title, "; ".join(parts))


def _newly_needed_right_findings(
    path: Path, circumstances: Circumstances, before: Distribution, after: Distribution
) -> Iterator[Finding]:
    """Yield findings on rights that a policy denies and that nodes need only after the update."""
    now, then = (
        policy_findings([path], replace(circumstances, distribution=distribution.given_name))
        for distribution in (before, after)
    )
    yield from (finding for finding in then if finding not in now)


def check_distributions(keystore: OpenedKeystore, at: Circumstances) -> list[Finding]:
    """Return findings on enclaves whose distributions decide differently.

    Raises:
        DocumentError: a file cannot be read, or there are too many wildcards to decide.
    """
    if not (of_several := enclaves_of_several_distributions(keystore)):
        return []
    files = signed_files(keystore, at)
    findings = []
    for names, enclaves in of_several.items():
        for before, after in _pairs_of_releases([find_distribution(name) for name in names]):
            for change in changes(files.only_for(enclaves), before, after):
                kind = DISTRIBUTION_REFUSES if change.kind in (_LOSES, _JOINS) else DIFFER
                findings.append(
                    kind.found(change.enclave, change.text, change.file, remedy=change.remedy)
                )
    return with_joined_findings(findings)


def _pairs_of_releases(distributions: Sequence[Distribution]) -> Iterator[tuple[Shipped, Shipped]]:
    """Yield pairs of releases of one product in different distributions that decide differently."""
    by_product: dict[str, dict[Vendor, Shipped]] = {}
    for distribution in distributions:
        for shipped in distribution.shipped:
            releases = by_product.setdefault(shipped.product, {})
            releases.setdefault(shipped.vendor, shipped)
    for first, *later_releases in (list(releases.values()) for releases in by_product.values()):
        yield from ((first, second) for second in later_releases)


_MORE, _LESS, _LOSES, _JOINS = "opens", "closes", "refused", "accepted"
_KINDS: Mapping[str, FindingKind] = {
    _MORE: OPENS,
    _LESS: CLOSES,
    _LOSES: REFUSED,
    _JOINS: ACCEPTED,
}


class DecisionChange(NamedTuple):
    """A decision on an enclave that differs between two ROS 2 distributions.

    ``kind`` says which decision differs, as a key of `_KINDS`. ``file`` is the path of the file on
    which the decision depends.
    """

    kind: str
    enclave: str
    text: str
    file: str
    remedy: str = ""


def changes(files: DecidedFiles, before: Shipped, after: Shipped) -> Iterator[DecisionChange]:
    """Yield the decisions that differ between two releases.

    For each enclave, these are the decisions in the first domain with a difference.

    Raises:
        DocumentError: there are too many wildcards to decide.
    """
    if before.vendor is after.vendor:
        return
    by_vendors = AccessByVendors(files.source)
    fitting_others = {
        shipped.vendor: files.fitting_others(shipped.vendor) for shipped in (before, after)
    }
    for name, enclave in files.loaded_enclaves():
        numbers = files.domains(enclave)
        for number in numbers:
            context = JoinContext(number, files.at.now, files.at.zone)
            where = f"in domain {number}, " if len(numbers) > 1 else ""
            sides = [
                _ReleaseDecision(
                    shipped, files, name, context, fitting_others[shipped.vendor].get(name, ())
                )
                for shipped in (before, after)
            ]
            if changes := list(_changes_of_enclave(files, name, sides, number, where, by_vendors)):
                yield from changes
                break


class _ReleaseDecision:
    """The decision of one release of DDS on an enclave: causes of a refusal, and access.

    The access includes access by permissions of other enclaves (``fitting_others``) that fit the
    enclave's certificate.
    """

    def __init__(
        self,
        shipped: Shipped,
        files: DecidedFiles,
        name: str,
        context: JoinContext,
        fitting_others: Sequence[str],
    ) -> None:
        own_enclave = files.enclaves[name]
        self.shipped = shipped
        participant = VendorParticipant(shipped.vendor, own_enclave, context)
        self.causes = participant.causes()
        presented = (
            own_enclave._replace(
                permissions=files.enclaves[holder].permissions,
                portable=files.enclaves[holder].portable,
                state=None,
            )
            for holder in fitting_others
        )
        other_accesses = (
            VendorParticipant(shipped.vendor, loaded, context).access for loaded in presented
        )
        usable = (participant.access, *other_accesses) if participant.access else ()
        self.access: tuple[Access, ...] = tuple(filter(None, usable))

    @property
    def crashes(self) -> bool:
        """Whether the process, or its peers, crash."""
        return any(cause.outcome is Outcome.CRASHES for cause in self.causes)


def _changes_of_enclave(
    files: DecidedFiles,
    enclave: str,
    sides: Sequence[_ReleaseDecision],
    domain: int,
    where: str,
    by_vendors: AccessByVendors,
) -> Iterator[DecisionChange]:
    old, new = sides
    if new.causes and (not old.causes or (new.crashes and not old.crashes)):
        text = f"{where}{_verdict_text(new)}; {_verdict_text(old)}"
        yield _refusal_change(_LOSES, files, enclave, new.causes[0], text)
    elif old.causes and not new.causes:
        text = f"{where}{_verdict_text(old)}; {_verdict_text(new)}"
        yield DecisionChange(_JOINS, enclave, text, files.path_of(enclave, old.causes[0].file))
    if old.causes or new.causes:
        return
    permissions = files.source.permissions.get(enclave)
    names = {
        topic
        for grant in (permissions.grants if permissions else ())
        for topic in names_without_wildcards(grant)
    }
    file = files.path_of(enclave, PERMISSIONS_FILE)
    for kind, first, second in ((_MORE, old, new), (_LESS, new, old)):
        gains = list(
            by_vendors.gained_topics(
                enclave, first.access, second.access, second.shipped.vendor, domain, names
            )
        )
        if gains:
            accesses = first_few(
                list(dict.fromkeys(map(_gain_text, gains))), _MOST_SHOWN, "; ", "; and "
            )
            closed = first.shipped.title
            opened = f"{where}{accesses}: open on {second.shipped.title}, closed on {closed}"
            yield DecisionChange(kind, enclave, opened, file)


def _gain_text(gain: Gain) -> str:
    """Return an access in words, such as ``publish topic /cmd_vel``."""
    if gain.right is None:
        return f"{gain.action} DDS topic {gain.topic}"
    return gain.right._replace(name=gain.name).describe()


def _verdict_text(side: _ReleaseDecision) -> str:
    clauses = [refusal_clause(cause, [side.shipped.title]) for cause in side.causes]
    return "; ".join(clauses) or f"{side.shipped.title} accepts it"


def _refusal_change(
    kind: str, files: DecidedFiles, enclave: str, cause: RefusalCause, text: str
) -> DecisionChange:
    remedy = ""
    state, fault = files.enclaves[enclave].state, FAULTS.get(cause.reason)
    if files.keystore and state and fault:
        view = CheckedKeystore(files.keystore, files.at)
        remedy = fault_remedy(CheckedEnclave(view, enclave, state), fault, cause.file)
    return DecisionChange(kind, enclave, text, files.path_of(enclave, cause.file), remedy)


def _untested_findings(before: Shipped, after: Shipped) -> Iterator[Finding]:
    for shipped in dict.fromkeys((before, after)):
        if not shipped.tested:
            same_vendor = before.vendor is after.vendor
            text = f"sros was not tested with {shipped}"
            if same_vendor:
                text += ", so it sees no difference between the two releases"
            yield NOT_MEASURED.found(f"ROS 2 {shipped.distribution.title}", text)


def _expired_peers_findings(before: Shipped, after: Shipped) -> Iterator[Finding]:
    """Yield a finding if only one of two releases separates running processes at an expiry."""
    drops_before, drops_after = (shipped.vendor.traits.drops_expired for shipped in (before, after))
    if drops_before != drops_after:
        does = "lose each other" if drops_after else "keep communicating"
        text = (
            f"with the new release, running processes {does} when the certificate of one of them "
            "expires"
        )
        yield EXPIRED_PEERS.found(f"{before.release} to {after.release}", text)


def _node_start_findings(
    files: DecidedFiles, before: Distribution, after: Distribution
) -> Iterator[Finding]:
    """Yield a finding for each enclave in which nodes start on ``before``, but not on ``after``."""
    if has_type_descriptions(before.name) or files.keystore is None:
        return
    for name, enclave in files.loaded_enclaves():
        if enclave.state is None or not has_type_descriptions(after.name):
            continue
        starting = []
        for distribution in (before, after):
            at = replace(files.at, distribution=distribution.name)
            view = CheckedKeystore(files.keystore, at)
            checked = CheckedEnclave(view, name, enclave.state)
            starting.append(
                with_start_finding(evaluate(checked, after.vendors, files.at.domain), ())
            )
        if not starting[0]:
            for finding in starting[1]:
                text = f"in ROS 2 {after.title}, {finding.text}"
                yield NO_NODE.found(name, text, finding.file)


# ── Zenoh ──────────────────────────────────────────────────────────────────────────────────


def _zenoh_findings(
    files: DecidedFiles, before: Distribution, after: Distribution
) -> Iterator[Finding]:
    """Yield findings on what another rmw_zenoh release changes for a keystore's Zenoh files."""
    old, new = before.zenoh, after.zenoh
    if old == new or not files.keystore or not has_zenoh_files(files.keystore.root, hidden=True):
        return
    text = (
        f"ROS 2 {before.title} has rmw_zenoh {version_text(old.begin)} or later, {after.title} "
        f"{version_text(new.begin)} or later; the keystore's Zenoh files need at least "
        f"{version_text(new.least)}"
    )
    yield ZENOH.found(files.file, text)
    more = [key for key in new.below_topics if key not in (*old.below_topics, _SUBSCRIPTION_KEYS)]
    source = load_zenoh_rights(files.keystore, hidden=True)
    domains = domains_of(source.enforcers)
    dropped = {
        right.name
        for right in source.rights
        if right.right == "publish" and right.qualifier is ALLOW and not is_expression(right.name)
        for domain in domains
        if any(_drops_below_name(source.enforcers, right, domain, key) for key in more)
    }
    if dropped:
        yield BUFFERS.found(files.file, f"for {first_few(sorted(dropped), _MOST_SHOWN)}")


_SUBSCRIPTION_KEYS = "_buf/*"
"""Keys that rmw_zenoh uses for single subscriptions; only a wildcard can name them."""


def _drops_below_name(
    enforcers: Sequence[Enforcement], right: Right, domain: int, below: str
) -> bool:
    """Return whether messages of a right pass on the key of its name, but not on keys below it."""
    remote = Remote(right.enclave)
    messages = [
        message
        for topic in right.topics.publish
        for message in zenoh_messages(topic, domain, writes=True)
    ]
    return bool(messages) and any(
        enforcer.decide(remote, flow, message, key).allowed
        and not enforcer.decide(remote, flow, message, f"{key}/{below}").allowed
        for enforcer in enforcers
        for flow, message, key in messages
    )
