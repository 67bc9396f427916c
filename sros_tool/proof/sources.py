"""What two sides of a comparison give: policies, keystores, permissions, Zenoh rules, revisions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from shlex import quote

from sros_tool.dds.domains import MAX_DOMAIN, DomainSet
from sros_tool.dds.governance import Governance, parse_governance
from sros_tool.dds.permissions import Permissions
from sros_tool.errors import DocumentError, Note, SrosError
from sros_tool.fleet.expansion import FleetPolicy
from sros_tool.fleet.model import Fleet
from sros_tool.keystore.layout import (
    GOVERNANCE_FILE,
    GOVERNANCE_P7S,
    IDENTITY_CA_FILE,
    PERMISSIONS_CA_FILE,
    PERMISSIONS_FILE,
    enclave_names,
    enclave_path,
    has_zenoh_files,
    is_keystore,
    permissions_ca_for,
)
from sros_tool.keystore.reader import governance_of
from sros_tool.keystore.rights import RightsSource, load_rights, load_zenoh_rights
from sros_tool.names import expand
from sros_tool.pki import smime
from sros_tool.pki.certificates import (
    common_name,
    fingerprints,
    load_certificate,
    subject_text,
)
from sros_tool.policy.document import PolicyFiles, read_policy
from sros_tool.policy.model import Enclave, Policy, Source
from sros_tool.policy.rights import Right, policy_rights
from sros_tool.policy.stated import StatedProtection, stated_protections
from sros_tool.proof.revisions import PREFIX, Revision, find_revision
from sros_tool.translate import permissions_for
from sros_tool.validity import iso, window
from sros_tool.xml import parse, read_bytes
from sros_tool.zenoh.enforcement import Enforcement

UNCERTAIN = {
    "rights.partitions",
    "rights.zenoh-open",
    "rights.zenoh-conditions",
    "rights.zenoh-nameless",
    "rights.zenoh-namespace",
    "rights.zenoh-no-name",
    "rights.zenoh-strangers",
}
"""Notes on what a comparison of rights leaves out: then it cannot say that nothing is added."""


@dataclass(frozen=True, slots=True)
class AccessSource:
    """What a file, a folder or a revision gives.

    ``kind`` is "policy", "permissions", "enclave", "keystore" or "zenoh"; ``shown`` is its name.
    ``permissions`` are what DDS would load for each enclave, or would if it were signed; ``rights``
    are in ROS terms, ``zenoh`` those that rules of Zenoh give, or None without any; ``enforcers``
    are these rules, ``router`` is the enclave of the router.  ``scope`` are the enclaves that it is
    for; None for all.  ``governance`` is None if it has none of its own.  ``authorities`` are the
    CAs that its enclaves trust, pairs of role and fingerprint; None if it does not say.
    """

    shown: str
    kind: str
    rights: frozenset[Right]
    permissions: Mapping[str, Permissions]
    zenoh: frozenset[Right] | None = None
    enforcers: tuple[Enforcement, ...] = ()
    router: str = ""
    governance: Governance | None = None
    authorities: frozenset[tuple[str, str]] | None = None
    scope: frozenset[str] | None = None
    notes: tuple[Note, ...] = ()
    fleet: Fleet | None = None
    protections: tuple[StatedProtection, ...] | None = None
    enclaves: Mapping[str, Enclave] = field(default_factory=dict)
    revision: Revision | None = None

    def source_of(self, right: Right) -> Source | None:
        """Return the file and line that states a right; None unless it is one of a policy."""
        enclave = self.enclaves.get(right.enclave)
        for profile in enclave.all_profiles() if enclave else ():
            for group in profile.groups:
                if (right.right, right.qualifier) not in group.rights:
                    continue
                for index, name in enumerate(group.names):
                    if expand(name, profile.ns, profile.node) == right.name:
                        return self.shown_source(group.source_of(index))
        return None

    def shown_source(self, source: Source) -> Source:
        """Return a source of this side as a user would name it."""
        return self.revision.source(source) if self.revision else source


ALL_DOMAINS = DomainSet.of((0, MAX_DOMAIN))
"""The domains for which the permissions of a policy are compared."""


def load_side(path: Path, fleet: Fleet | None = None) -> AccessSource:
    """Return what ``path`` gives: a path as for `load_rights`, a folder of policies, a revision.

    Raises:
        SrosError: it cannot be read, DDS would refuse a part of it, or a part of it has a meaning
            that is not compared.
    """
    if str(path).startswith(PREFIX):
        return _of_revision(find_revision(str(path)), fleet)
    if path.is_dir() and not is_keystore(path) and not (path / PERMISSIONS_FILE).exists():
        files = [each for each in sorted(path.glob("*.xml")) if _is_policy(each)]
        if files:
            return _of_policies(str(path), [_read(each, fleet) for each in files])
    source = load_rights(path, fleet)
    for note in source.notes:
        if not source.sound or note.id in UNCERTAIN:
            raise DocumentError(
                f"'{path}' cannot be compared: {note.text.rstrip('.')}",
                "What it gives is not certain.",
                f"`sros check {quote(str(path))}` shows what is wrong with it.",
            )
    if source.kind == "policy":
        return _of_policies(str(path), [_read(path, fleet)])
    return _of_source(path, source)


def _of_source(path: Path, source: RightsSource) -> AccessSource:
    side = AccessSource(
        str(path),
        source.kind,
        source.rights,
        {name: _without_dates(each) for name, each in source.documents.items()},
        scope=source.scope,
        notes=source.notes,
        fleet=source.fleet,
    )
    for enclave, each in source.documents.items():
        if len(each.grants) > 1:
            raise DocumentError(
                f"the permissions of {enclave} in '{path}' have several grants",
                "Vendors differ in which one of them counts.",
                "Sign one grant for each enclave.",
            )
    if source.kind == "zenoh":
        return replace(side, zenoh=source.rights, enforcers=source.enforcers)
    if source.kind == "enclave":
        has_one = (path / GOVERNANCE_FILE).exists()
        governance = _governance(path / GOVERNANCE_FILE) if has_one else None
        return replace(side, governance=governance, authorities=_authorities([path]))
    if source.kind != "keystore":
        return side
    folders = [enclave_path(path, name) for name in enclave_names(path)]
    side = replace(side, governance=_of_all(path, folders), authorities=_authorities(folders))
    if not has_zenoh_files(path):
        return side
    found = load_zenoh_rights(path)
    for note in found.notes:
        if note.id in UNCERTAIN:
            raise DocumentError(f"'{path}' cannot be compared: {note.text.rstrip('.')}")
    return replace(side, zenoh=found.rights, enforcers=found.enforcers, router=found.router)


def _of_all(root: Path, folders: Iterable[Path]) -> Governance:
    """Return the governance of a keystore, after a check that each enclave loads the same one.

    Raises:
        DocumentError: an enclave has another one, such as an earlier one with less protection.
    """
    wanted = smime.parse(read_bytes(root / GOVERNANCE_P7S, "governance document")).document
    same: set[bytes] = set()
    for each in folders:
        file = each / GOVERNANCE_FILE
        data = read_bytes(file, "governance document") if file.exists() else b""
        if not data or data in same:
            continue
        if smime.parse(data).document != wanted:
            raise DocumentError(
                f"'{root}' cannot be compared: '{file}' is not the governance of the keystore",
                "What the enclave and its peers protect is not certain.",
                f"`sros check {quote(str(root))}` shows what is wrong with it.",
            )
        same.add(data)
    return governance_of(root)


def _authorities(folders: Iterable[Path]) -> frozenset[tuple[str, str]]:
    """Return role and fingerprint of the CAs that the enclaves in folders trust."""
    found = {
        (role, read_bytes(folder / file, "certificate"))
        for folder in folders
        for role, file in (("identity", IDENTITY_CA_FILE), ("permissions", PERMISSIONS_CA_FILE))
        if (folder / file).exists()
    }
    return frozenset((role, each) for role, pem in found for each in fingerprints(pem))


def _governance(file: Path) -> Governance:
    signed = smime.parse(read_bytes(file, "governance document"))
    if authority := permissions_ca_for(file):
        signed.verify(load_certificate(read_bytes(authority, "certificate"), f"'{authority}'"))
    return parse_governance(signed.document, f"'{file}'")


AT = datetime(2026, 1, 1, tzinfo=UTC)
"""The moment for which all permissions are compared, as if they were valid then."""
_VALID = window(AT - timedelta(days=2), timedelta(days=9))


def _without_dates(permissions: Permissions) -> Permissions:
    """Return permissions that are valid at `AT`: what they give is compared, not until when."""
    begin, end = iso(_VALID.not_before), iso(_VALID.not_after)
    return Permissions(
        tuple(replace(each, not_before=begin, not_after=end) for each in permissions.grants)
    )


def _is_policy(file: Path) -> bool:
    return parse(read_bytes(file, "policy file"), f"'{file}'", instructions=True).tag == "policy"


def _of_revision(revision: Revision, fleet: Fleet | None) -> AccessSource:
    try:
        policies = []
        files = revision.files()
        for each in files:
            content = each.read(each.place)
            tag = parse(content, f"'{each}'", instructions=True).tag
            if len(files) == 1 or tag == "policy":
                policies.append(_read(each.place, fleet, each.read))
        side = _of_policies(str(revision), policies)
    except SrosError as error:
        texts = (revision.shown(each) for each in (error.what, error.why, error.remedy))
        raise DocumentError(*texts) from error
    return replace(side, revision=revision)


_Read = tuple[Policy, Fleet | None]


def _read(path: Path, fleet: Fleet | None, read: PolicyFiles | None = None) -> _Read:
    """Return the policy in a file, and the fleet with the enclaves that it has there."""
    if fleet is None:
        return read_policy(path, read=read), None
    expanded = FleetPolicy(read_policy(path, placeholders=True, read=read), fleet)
    return expanded.policy(), fleet.with_enclaves(expanded.patterns)


def _of_policies(shown: str, policies: list[_Read]) -> AccessSource:
    enclaves: dict[str, Enclave] = {}
    for each in (enclave for policy, _ in policies for enclave in policy.enclaves):
        if each.path in enclaves:
            raise DocumentError(
                f"{each.source}: enclave {each.path} is in another policy, too",
                f"The other one is at {enclaves[each.path].source}.",
                "Compare one policy with another, or name each enclave in one file.",
            )
        enclaves[each.path] = each
    if not policies:
        raise DocumentError(f"'{shown}' has no policies", "", "Name a policy file.")
    permissions = {
        path: permissions_for(
            each, subject=subject_text(common_name(path)), validity=_VALID, domains=ALL_DOMAINS
        )
        for path, each in enclaves.items()
    }
    rights = frozenset(each for policy, _ in policies for each in policy_rights(policy))
    stated = stated_protections(enclaves.values())
    fleet = policies[0][1] if len(policies) == 1 else None
    return AccessSource(
        shown, "policy", rights, permissions, fleet=fleet, protections=stated, enclaves=enclaves
    )
