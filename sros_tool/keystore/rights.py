"""The rights that a policy, permissions, an enclave, a keystore or a Zenoh configuration gives.

The rights of enclaves and keystores are read from ``permissions.p7s``, the file that DDS loads. The
signature of the file is verified with the permissions CA next to it.  A Zenoh configuration gives
rights to other enclaves by its access control.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, NamedTuple

from cryptography import x509

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import Governance, parse_governance
from sros_tool.dds.permissions import Grant, Permissions, parse_permissions
from sros_tool.errors import DocumentError, KeystoreError, Note, SrosError
from sros_tool.fleet.expansion import FleetPolicy, read_policy_for
from sros_tool.fleet.robots import Fleet, robot_of
from sros_tool.keystore.fleet import load_fleet
from sros_tool.keystore.layout import (
    CLOSED_OBSERVER,
    GOVERNANCE_FILE,
    GOVERNANCE_P7S,
    PERMISSIONS_CA_FILE,
    PERMISSIONS_FILE,
    ROUTER_FILE,
    SESSION_FILE,
    enclave_names,
    enclave_path,
    folder_of_closed_robot,
    hidden_enclaves,
    is_keystore,
    permissions_ca_for,
    refuse_flat_keystore,
    remedy_in_keystore,
)
from sros_tool.keystore.ledger import Entry, Ledger
from sros_tool.keystore.reader import FilesReadOnce, OpenedKeystore
from sros_tool.names import ROS_DISCOVERY_TOPIC
from sros_tool.pki import smime
from sros_tool.pki.certificates import load_certificate
from sros_tool.policy.document import files_of_policies, read_policy
from sros_tool.policy.model import Policy, StatedProtection, stated_protections
from sros_tool.policy.namespaces import ChangedForm, changed_forms
from sros_tool.policy.node_basics import are_basic
from sros_tool.policy.patterns import matches
from sros_tool.policy.rights import (
    Right,
    RightsDifference,
    Rules,
    compare,
    new_names_in_wildcards,
    policy_rights,
    rights_without_counterpart,
)
from sros_tool.translate import grant_rights
from sros_tool.values import Words, shows
from sros_tool.wording import counted, first_few
from sros_tool.xml import parse, read_bytes

if TYPE_CHECKING:
    from sros_tool.keystore.template import Template
    from sros_tool.translate_zenoh.rights import RouterLinks
    from sros_tool.zenoh.access import Enforcement
    from sros_tool.zenoh.document import ConfigurationDocument

_COMMON_NAME = re.compile(r"(?:^|[,/])\s*CN\s*=\s*(/[^,]*?)\s*(?:,|$)")


SourceKind = Annotated[str, Words(("policy", "permissions", "enclave", "keystore", "zenoh"))]


@shows("path", "kind", "enclaves", "sound", "notes")
@dataclass(frozen=True, slots=True)
class RightsSource:
    """The rights that a file or folder gives.

    ``kind`` is "policy", "permissions", "enclave", "keystore" or "zenoh".  ``scope`` are the
    enclaves to which the source can give rights, such as those of an export; None for all.
    ``sound`` is False if DDS would refuse a part of the source, because a signature does not
    verify, or because permissions are missing or malformed, or if enclaves are left out.  ``fleet``
    is the fleet for which the source is, or None.  ``protections`` are a policy's statements about
    the protection of names; None for anything else.  ``documents`` are the permissions of enclaves.
    ``enforcers`` are the access control of each Zenoh process that checks other processes.
    ``routers`` are the enclaves of a keystore's routers, and ``links`` describes the names that
    pass between several routers.
    ``configurations`` are the Zenoh configurations that were read, including those of clients.
    ``key_domains`` maps the rights in these configurations to the ROS domains in their keys, where
    None stands for a wildcard.  ``policy`` is the policy in a policy file.
    """

    path: Path
    """Path of the file or folder, as given on the command line."""
    kind: SourceKind
    """Kind of the file or folder."""
    rights: frozenset[Right]
    scope: frozenset[str] | None
    sound: bool
    """Whether DDS would accept all files of the source, and sros left no enclave out."""
    notes: tuple[Note, ...]
    """Notes on the file or folder."""
    fleet: Fleet | None = None
    protections: tuple[StatedProtection, ...] | None = None
    documents: Mapping[str, Permissions] = field(default_factory=dict)
    enforcers: tuple[Enforcement, ...] = ()
    routers: tuple[str, ...] = ()
    links: RouterLinks | None = None
    configurations: Mapping[Path, ConfigurationDocument] = field(default_factory=dict)
    key_domains: Mapping[Right, frozenset[int | None]] = field(default_factory=dict)
    policy: Policy | None = None

    def enclaves_without_rights(self) -> set[str]:
        """Return the enclaves of a policy or of permissions that have no rights at all."""
        return self.stated_enclaves() - {right.enclave for right in self.rights}

    def stated_enclaves(self) -> set[str]:
        """Return the enclaves of a policy or of permissions, including those without rights."""
        policy = self.policy.enclaves if self.policy else ()
        return {*self.documents, *(enclave.path for enclave in policy)}

    @property
    def enclaves(self) -> list[str] | None:
        """Enclaves to which the file or folder can give rights; null for all."""
        return None if self.scope is None else sorted(self.scope)


def load_rights(
    path: Path | OpenedKeystore,
    fleet: Fleet | None = None,
    *,
    hidden: bool = False,
    only_enclaves: Sequence[str] | None = None,
) -> RightsSource:
    """Return the rights that ``path`` gives; a policy with placeholders is expanded for ``fleet``.

    ``path`` is a policy file, a folder of policies, ``permissions.p7s`` or ``permissions.xml``, an
    enclave folder, a keystore, or a Zenoh configuration such as ``router.json5``.  With ``hidden``,
    the enclaves of a keystore in folders whose names begin with a dot are included.
    ``only_enclaves`` are the enclaves of a keystore that are read; None for all.

    Raises:
        DocumentError: ``path`` is something else, or is malformed.
    """
    if isinstance(path, OpenedKeystore):
        return _keystore_rights(path, hidden=hidden, only_enclaves=only_enclaves)
    if path.is_dir():
        if is_keystore(path):
            return _keystore_rights(OpenedKeystore(path), hidden=hidden)
        if (path / PERMISSIONS_FILE).exists():
            return _document_rights(path, "enclave", path / PERMISSIONS_FILE)
        refuse_flat_keystore(path)
        if any(files_of_policies(path)):
            return _policy_rights(path, fleet)
        raise DocumentError(
            f"'{path}' is neither a keystore nor an enclave, and holds no policy",
            f"It has no enclaves folder, and no {PERMISSIONS_FILE}.",
        )
    data = read_bytes(path, "file")
    if is_zenoh(data, path):
        from sros_tool.zenoh.document import parse_configuration

        return _zenoh_rights(path, parse_configuration(data, str(path), lines=False))
    signed = b"multipart/signed" in data[:1000].lower()
    # An earlier format has <profiles> at the top; read_policy says how it differs.
    if not signed and parse(data, f"'{path}'").tag in ("policy", "profiles"):
        return _policy_rights(path, fleet)
    return _document_rights(path, "permissions", path)


def _policy_rights(path: Path, fleet: Fleet | None) -> RightsSource:
    policy = read_policy_for(path, fleet)
    if fleet:
        written = read_policy(path, placeholders=True)
        fleet = fleet.with_enclaves(FleetPolicy(written, fleet).patterns)
    stated = stated_protections(policy.enclaves)
    rights = policy_rights(policy)
    return RightsSource(path, "policy", rights, None, True, (), fleet, stated, policy=policy)


def rights_by_domains(source: RightsSource) -> dict[DomainSet | None, set[Right]]:
    """Map sets of ROS domains to the rights that a source gives in them; None means every domain.

    A policy is for every domain, except for enclaves of robots whose domain the fleet states.
    """
    return rights_grouped_by_domains(
        source.rights, source.documents, source.key_domains, source.fleet
    )


def rights_grouped_by_domains(
    rights: Iterable[Right],
    documents: Mapping[str, Permissions],
    key_domains: Mapping[Right, frozenset[int | None]],
    fleet: Fleet | None = None,
) -> dict[DomainSet | None, set[Right]]:
    """Map sets of ROS domains to the rights that apply in them; None means every domain.

    ``documents`` are the permissions of enclaves, whose rules name domains.  ``key_domains`` is as
    in `RightsSource`.  An enclave without permissions is for the domain that ``fleet`` states for
    its robot.
    """
    by_enclave: dict[str, list[Right]] = {}
    for right in rights:
        by_enclave.setdefault(right.enclave, []).append(right)
    result: dict[DomainSet | None, set[Right]] = {}
    for enclave, own_rights in by_enclave.items():
        if key_domains:
            divided = _divide_by_keys(own_rights, key_domains)
        elif enclave in documents:
            divided = _divide_by_rules(own_rights, enclave, documents[enclave])
        else:
            robot = robot_of(fleet, enclave) if fleet else None
            domain = robot.domain if robot else None
            divided = iter(
                [(None if domain is None else DomainSet.of((domain, domain)), own_rights)]
            )
        for domains, group in divided:
            result.setdefault(domains, set()).update(group)
    return result


_RightsByDomains = Iterator[tuple[DomainSet | None, Collection[Right]]]


def _divide_by_keys(
    rights: Collection[Right], domains_of: Mapping[Right, frozenset[int | None]]
) -> _RightsByDomains:
    """Yield the rights of an enclave on Zenoh, divided by the ROS domains of their keys."""
    domains = {domain for right in rights for domain in domains_of[right]}
    for domain in domains:
        group = [right for right in rights if not domains_of[right].isdisjoint((domain, None))]
        yield None if domain is None else DomainSet.of((domain, domain)), group


def _divide_by_rules(
    rights: Collection[Right], enclave: str, permissions: Permissions
) -> _RightsByDomains:
    """Yield the rights of an enclave, divided by the ROS domains of the rules of its grant."""
    grant = _first_grants(permissions).get(enclave, permissions.grants[0])
    listed = [rule.domains.closed() for rule in grant.rules]
    if len(set(listed)) == 1:
        yield listed[0], rights
        return
    stated: set[Right] = set()
    for domains in DomainSet.partition(listed):
        rules = (rule for rule in grant.rules if (rule.domains.closed() & domains).ranges)
        granted_rights = grant_rights(enclave, grant._replace(rules=tuple(rules)))
        yield domains, granted_rights
        stated |= granted_rights
    yield None, [right for right in rights if right not in stated]


def load_zenoh_rights(keystore: OpenedKeystore, *, hidden: bool = False) -> RightsSource:
    """Return the rights that all Zenoh configurations of a keystore together give its enclaves.

    The configurations of routers count, and those of peers, which also connect without a router.
    ``hidden`` is as in `load_rights`.

    Raises:
        KeystoreError: no router has a configuration, or there are several routers that are not
            connected.
        DocumentError: Zenoh would refuse a configuration.
    """
    from sros_tool.zenoh.configuration import Mode
    from sros_tool.zenoh.document import parse_configuration

    root = keystore.root
    files = {name: keystore.folder(name) for name in enclave_names(root, hidden=hidden)}
    routers = [name for name, folder in files.items() if (folder / ROUTER_FILE).is_file()]
    if not routers:
        raise KeystoreError(
            f"keystore '{root}' has no {ROUTER_FILE}",
            "Only this file shows which rights Zenoh enforces.",
            remedy_in_keystore(root, "Write the file with `sros zenoh KEYSTORE`."),
        )
    sources = []
    configurations: dict[Path, ConfigurationDocument] = {}
    for name, folder in files.items():
        for file in (folder / ROUTER_FILE, folder / SESSION_FILE):
            if not file.is_file():
                continue
            data = keystore.read(file, "Zenoh configuration")
            document = parse_configuration(data, str(file), lines=False)
            configurations[file] = document
            # the router filters the messages of clients
            if file.name == ROUTER_FILE or (
                name not in routers and document.mode is not Mode.CLIENT
            ):
                sources.append(_zenoh_rights(file, document))
    check_routers(
        keystore,
        {router: configurations[files[router] / ROUTER_FILE].access.names() for router in routers},
    )
    # Peers state the rights that both ends of a link have, which are parts of those that the router
    # states.
    of_router = frozenset(
        right for source in sources if source.path.name == ROUTER_FILE for right in source.rights
    )
    stated = Rules(of_router)
    rights = (right for source in sources for right in source.rights)
    domains: dict[Right, frozenset[int | None]] = {}
    for source in sources:
        for right, of_right in source.key_domains.items():
            domains[right] = domains.get(right, frozenset()) | of_right
    return RightsSource(
        root,
        "zenoh",
        frozenset(
            right
            for right in rights
            if right.enclave not in routers and (right in of_router or not stated.cover(right))
        ),
        None,
        True,
        tuple(dict.fromkeys(note for source in sources for note in source.notes)),
        enforcers=tuple(item for source in sources for item in source.enforcers),
        routers=tuple(routers),
        links=_router_links({source.path.parent: source for source in sources}, files, routers),
        configurations=configurations,
        key_domains=domains,
    )


def _router_links(
    sources: Mapping[Path, RightsSource], files: Mapping[str, Path], routers: Sequence[str]
) -> RouterLinks | None:
    """Return the links between routers: the names that pass, and the router of each enclave.

    The result is None for a single router.

    ``files`` maps enclaves to their folders.  ``sources`` maps these folders to the rights in their
    configurations.
    """
    from sros_tool.translate_zenoh.rights import RouterLinks

    if len(routers) == 1:
        return None
    router_of = dict(zip(routers, routers, strict=True))
    passing = {}
    for router in routers:
        rights = sources[files[router]].rights
        passing[router] = frozenset(right for right in rights if right.enclave in routers)
        for right in rights:
            router_of.setdefault(right.enclave, router)
    return RouterLinks(router_of, passing)


def check_routers(keystore: OpenedKeystore, known: Mapping[str, Collection[str]]) -> None:
    """Raise `KeystoreError` if a router has no rules for another router of the keystore.

    ``known`` maps the enclave of each router to the names for which the router's configuration has
    rules.  A router without rules for any enclave forwards nothing.
    """
    routing = [name for name, names in known.items() if not known.keys() >= {*names}]
    for name in routing:
        if strangers := sorted({*routing} - {name, *known[name]}):
            raise KeystoreError(
                f"keystore '{keystore.root}' has the files of several routers that are not "
                "connected",
                f"{ROUTER_FILE} of {name} has no rules for {', '.join(strangers[:5])}, so sros "
                "cannot tell which of these files are in use.",
                "Remove the files that no process uses, or write all files again: "
                f"`sros zenoh {quote(str(keystore.root))}`.",
            )


def is_zenoh(data: bytes, path: Path) -> bool:
    """Return whether a file is a Zenoh configuration, by its name or its access control."""
    return path.suffix in (".json5", ".yaml", ".yml") or (
        data.lstrip()[:1] in (b"{", b"/") and b"access_control" in data
    )


def _zenoh_rights(path: Path, document: ConfigurationDocument) -> RightsSource:
    from sros_tool.translate_zenoh.rights import rights_in_rules

    access = document.access
    rules = rights_in_rules(access)
    notes = []
    if not access.enabled or access.allows_by_default:
        text = "its access control is off, so it denies nothing."
        if access.enabled:
            text = "it allows everything that no rule denies, to everybody."
        notes.append(Note("rights.zenoh-open", f"{path}: {text}"))
    if any(subject.cert_common_names is None for subject in access.subjects):
        text = "this answer leaves out its rules for subjects without certificate common names"
        notes.append(Note("rights.zenoh-nameless", f"{path}: {text}; `sros check` shows them."))
    if unclear := document.open_link_clause():
        text = (
            f"{path}: {unclear}: a process that connects there shows no certificate, so no rule "
            "can name it."
        )
        notes.append(Note("rights.zenoh-strangers", text))
    if unclear := access.unclear_reason():
        notes.append(Note("rights.zenoh-conditions", f"{path}: {unclear}."))
    if document.namespace:
        text = (
            f"{path}: it puts a namespace before all Zenoh keys; this answer ignores the namespace."
        )
        notes.append(Note("rights.zenoh-namespace", text))
    if rules.left_out:
        number = counted(len(rules.left_out), "key expression")
        text = f"{path}: this answer leaves out {number} without a ROS name, "
        text += f"for example {rules.left_out[0][:80]}."
        notes.append(Note("rights.zenoh-no-name", text))
    return RightsSource(
        path,
        "zenoh",
        frozenset(rules.domains),
        rules.enclaves,
        True,
        tuple(notes),
        enforcers=(access,),
        configurations={path: document},
        key_domains=rules.domains,
    )


def _document_rights(path: Path, kind: str, file: Path) -> RightsSource:
    reader = _Reader(FilesReadOnce())
    rights, scope = reader.permissions(file, str(path))
    return RightsSource(
        path,
        kind,
        rights,
        frozenset(scope),
        reader.sound,
        tuple(reader.unverified + reader.notes),
        documents=reader.documents,
    )


FOREIGN_GRANT = "rights.foreign-grant"
"""The id of the note on permissions that have a grant for another enclave."""
RELAY = "rights.relay"
"""The id of the note on permissions that allow or deny topics in ``<relay>``."""


def _keystore_rights(
    keystore: OpenedKeystore, *, hidden: bool, only_enclaves: Sequence[str] | None = None
) -> RightsSource:
    root, reader = keystore.root, _Reader(keystore.files)
    rights: set[Right] = set()
    names = enclave_names(root, hidden=hidden) if only_enclaves is None else only_enclaves
    enclaves = set(names)
    for name in names:
        file = enclave_path(root, name) / PERMISSIONS_FILE
        try:
            granted, scope = reader.permissions(file, name)
        except SrosError as error:
            reader.sound = False
            reader.notes.append(Note("rights.unreadable", f"{name}: {error}"))
            continue
        rights |= granted
        enclaves.update(scope)
        if foreign := sorted(set(scope) - {name}):
            also, verdict = (
                ("also ", "which can use them")
                if name in scope
                else ("", "so DDS refuses them here")
            )
            text = f"{name}: its permissions are {also}for {', '.join(foreign)}, {verdict}."
            reader.sound = False
            reader.notes.append(Note(FOREIGN_GRANT, text))
    if not hidden and only_enclaves is None and (left_out := notes_on_hidden_enclaves(root)):
        reader.sound = False
        reader.notes += left_out
    return RightsSource(
        root,
        "keystore",
        frozenset(rights),
        None if keystore.has_all_enclaves else frozenset(enclaves),
        reader.sound,
        tuple(reader.unverified[:1] + reader.notes),
        load_fleet(keystore),
        documents=reader.documents,
    )


def notes_on_hidden_enclaves(root: Path) -> tuple[Note, ...]:
    """Return a note on the enclaves in hidden folders, which answers leave out."""
    if not (names := hidden_enclaves(root)):
        return ()
    text = f"left out, although DDS loads enclaves in hidden folders: {first_few(names, 5)}."
    return (Note("rights.hidden-enclave", text),)


@dataclass(slots=True)
class _Reader:
    """A reader of permissions documents, which collects notes about them.

    ``unverified`` are notes on documents whose signature is missing or was not verified.  ``sound``
    and ``documents`` are as in `RightsSource`.
    """

    files: FilesReadOnce
    sound: bool = True
    unverified: list[Note] = field(default_factory=list)
    notes: list[Note] = field(default_factory=list)
    documents: dict[str, Permissions] = field(default_factory=dict)

    def permissions(self, file: Path, label: str) -> tuple[frozenset[Right], tuple[str, ...]]:
        """Return the rights in a permissions document, and the enclaves of its grants."""
        data = self.files.read(file, "permissions document")
        if b"multipart/signed" in data[:1000].lower():
            try:
                signed = self.files.signed_document(data)
            except SrosError as error:
                raise DocumentError(f"'{file}' cannot be read: {error.what}", error.why) from error
            self._verify(signed, file, label)
            data = signed.document
        else:
            text = f"{label}: the file is not signed; DDS loads {PERMISSIONS_FILE} instead."
            self.unverified.append(Note("rights.unsigned", text))
        permissions = parse_permissions(data, f"'{file}'")
        self.notes += [
            Note(note.id, f"{label}: {note.text}")
            for note in (*_left_out_notes(permissions.grants), *_discovery_notes(permissions))
        ]
        grants = _first_grants(permissions)
        self.documents.update(dict.fromkeys(grants, permissions))
        rights = (right for name, grant in grants.items() for right in grant_rights(name, grant))
        return frozenset(rights), tuple(grants)

    def _verify(self, signed: smime.SignedDocument, file: Path, label: str) -> None:
        try:
            authority = self._authority_for(file)
            if authority is None:
                text = f"{label}: the signature was not verified, because there is no "
                text += f"{PERMISSIONS_CA_FILE} next to the file."
                self.unverified.append(Note("rights.not-verified", text))
                return
            signed.verify(authority)
        except SrosError as error:
            self.sound = False
            text = f"{label}: THE SIGNATURE DOES NOT VERIFY, and DDS refuses the file: {error}"
            self.notes.append(Note("rights.bad-signature", text.rstrip(".") + "."))

    def _authority_for(self, file: Path) -> x509.Certificate | None:
        path = permissions_ca_for(file)
        if path is None:
            return None
        return load_certificate(self.files.read(path, "certificate"), f"'{path}'")


def _first_grants(permissions: Permissions) -> dict[str, Grant]:
    """Map each enclave to its first grant, the only grant that DDS reads."""
    grants: dict[str, Grant] = {}
    for grant in permissions.grants:
        grants.setdefault(_enclave_of(grant), grant)
    return grants


def _enclave_of(grant: Grant) -> str:
    """Return the enclave of a grant: the common name in its subject, or the grant's name."""
    match = _COMMON_NAME.search(grant.subject)
    return match[1] if match else grant.name or grant.subject


def _left_out_notes(grants: Iterable[Grant]) -> Iterator[Note]:
    """Yield notes on the parts of grants that cannot be expressed as rights in ROS terms."""
    seen: set[str] = set()
    for grant in grants:
        name = _enclave_of(grant)
        if name in seen:
            text = (
                f"this answer ignores another grant for {grant.subject}: a process has only one, "
                "the first (on Fast DDS, the first that is valid now)."
            )
            yield Note("rights.later-grant", text)
            continue
        seen.add(name)
        if grant.default_allow:
            text = "<default> allows all topics that no rule names, except with Fast DDS."
            yield Note("rights.default-allow", text)
        if any(c.partitions for r in grant.rules for c in (*r.publish, *r.subscribe)):
            yield Note("rights.partitions", "this answer ignores its partitions.")
        if any(rule.relay for rule in grant.rules):
            text = (
                "this answer ignores its <relay>: by this rule, a process that does not apply its "
                "own permissions can subscribe to peers on Fast DDS."
            )
            yield Note(RELAY, text)
        if len({rule.domains for rule in grant.rules}) > 1:
            text = "its rules are for different domains; this answer ignores the domains."
            yield Note("rights.domains", text)
        kinds = [rule.allow for rule in grant.rules]
        if False in kinds[kinds.index(True) if True in kinds else len(kinds) :]:
            text = "a deny_rule after an allow_rule may have no effect: the first match decides."
            yield Note("rights.rule-order", text)


def _discovery_notes(permissions: Permissions) -> Iterator[Note]:
    """Yield a note for each enclave whose grant lacks the topic that every node needs."""
    for name, grant in _first_grants(permissions).items():
        if lacking := _missing_discovery(grant):
            text = (
                f"{name} may not {' or '.join(lacking)} {ROS_DISCOVERY_TOPIC}: its nodes do not "
                "start, or do not see the other nodes, or are not seen. Sign its permissions from "
                "its policy."
            )
            yield Note("rights.discovery", text)


def _missing_discovery(grant: Grant) -> list[str]:
    """Return which of "publish" and "subscribe" a grant does not allow on the discovery topic.

    The first rule that matches the topic decides.
    """

    def is_allowed(verb: str) -> bool:
        matching = (
            rule.allow
            for rule in grant.rules
            for _, criterion in rule.criteria_of((verb,))
            if any(matches(e, ROS_DISCOVERY_TOPIC) for e in criterion.topics)
        )
        return next(matching, grant.default_allow)

    return [verb for verb in ("publish", "subscribe") if not is_allowed(verb)]


# ── the JSON of a comparison ────────────────────────────────────────────────────────────────

OnlySide = Annotated[str, Words(("a", "b"))]


@shows(spread=("right",))
class DifferentRight(NamedTuple):
    """A right that only one side has."""

    only: OnlySide
    """The side that has the right."""
    right: Right
    covered_by: Sequence[Right]
    """Rights of the other side that include this right, such as rights with wildcards."""


@shows(spread=("protection",))
class DifferentProtection(NamedTuple):
    """A protection of a name that only one side demands."""

    only: OnlySide
    """The side that demands the protection."""
    protection: StatedProtection


class DifferentEnclave(NamedTuple):
    """An enclave that only one side has, and that has no rights there."""

    only: OnlySide
    """The side that has the enclave."""
    enclave: str
    """Name of the enclave."""


class DifferentDomains(NamedTuple):
    """An enclave whose ROS domains differ between A and B."""

    enclave: str
    """Name of the enclave."""
    a: str
    """The domains of the enclave's rights in A, such as ``10`` or ``10,20``."""
    b: str
    """The domains of the enclave's rights in B."""


class PolicyDifference(NamedTuple):
    """The rights that differ between A and B."""

    equal: bool
    """Whether A and B have the same enclaves, give the same rights in the same domains, and demand
    the same protection."""
    a: RightsSource
    """The source A."""
    b: RightsSource
    """The source B."""
    differences: Sequence[DifferentRight]
    """Rights that only one side has."""
    protections: Sequence[DifferentProtection]
    """Protection that only one of two policies demands."""
    unanswered: Sequence[Right]
    """Rights of B whose counterpart only A has, such as a right to publish a topic to which no
    enclave of B may subscribe any more.
    """
    reached: Sequence[Right]
    """Rights to names that only B has, which wildcards that A and B have give to other enclaves;
    rights to subscribe are left out.
    """
    domains: Sequence[DifferentDomains]
    """Enclaves whose ROS domains differ between the sides; only enclaves for which both sides
    state domains.
    """
    enclaves: Sequence[DifferentEnclave]
    """Enclaves that have no rights, and that only one side has."""
    governance_differs: bool
    """Whether the governance of the enclaves differs between A and B, or cannot be read."""
    unclear: Sequence[str]
    """Enclaves whose permissions differ in something that no right states, such as partitions, the
    order of rules, missing rules for `ros_discovery_info`, or a default that allows everything.
    `notes` of A and B name the difference.
    """
    changed_forms: Sequence[ChangedForm]
    """Rights and denials of policy B that differ from A only for users who put the node into
    another namespace, because the name became absolute or relative; empty for a fleet, whose
    namespaces are known.
    """


class SourcesDifference(NamedTuple):
    """The difference between two sources of rights; in a condition, False if they do not differ."""

    scope: frozenset[str] | None
    """The enclaves that were compared; None for all."""
    rights: RightsDifference
    protections: Sequence[tuple[str, StatedProtection]]
    """Protection that only one of two policies states, with "-" for the first, "+" for the second.
    """
    unanswered: Sequence[Right]
    """As in `PolicyDifference`; empty if a source is only for some enclaves."""
    reached: Sequence[Right] = ()
    """As in `PolicyDifference`; empty if a source is only for some enclaves."""
    domains: Sequence[DifferentDomains] = ()
    """As in `PolicyDifference`."""
    enclaves: Sequence[tuple[str, str]] = ()
    """Enclaves without rights that only one side has, with "-" for the first, "+" for the second.
    """
    governance_differs: bool = False
    """As in `PolicyDifference`."""
    unclear: Sequence[str] = ()
    """As in `PolicyDifference`."""
    changed_forms: Sequence[ChangedForm] = ()
    """As in `PolicyDifference`."""

    def __bool__(self) -> bool:
        parts = self.rights, self.protections, self.domains, self.enclaves, self.unclear
        return self.governance_differs or any(map(bool, (*parts, self.changed_forms)))


def compared_enclaves(
    *sides: tuple[SourceKind, frozenset[str] | None],
) -> frozenset[str] | None:
    """Return the enclaves for which two sources are compared; None for all.

    If only one source is limited to some enclaves, these are compared.  For two exports or two
    enclaves, the enclaves of both sources are compared.  For an enclave and an export, only this
    enclave is compared.

    Args:
        sides: the kind and the ``scope`` of each source, as in `RightsSource`.
    """
    partial = [(kind, scope) for kind, scope in sides if scope is not None]
    if len({kind == "keystore" for kind, _ in partial}) > 1:
        partial = [(kind, scope) for kind, scope in partial if kind != "keystore"]
    return partial[0][1] if len(partial) == 1 else None


def compare_sources(
    first_source: RightsSource, second_source: RightsSource, *, governance: bool = False
) -> SourcesDifference:
    """Return the difference between two sources of rights.

    If a source is only for some enclaves, only these are compared.  With ``governance``, the
    governance documents of two keystores are compared, too.
    """
    sides = first_source, second_source
    scope = compared_enclaves(*((side.kind, side.scope) for side in sides))
    difference = compare(first_source.rights, second_source.rights, scope)
    unanswered: Sequence[Right] = ()
    reached: Sequence[Right] = ()
    if all(side.scope is None for side in sides):
        rights = first_source.rights, second_source.rights
        unanswered = rights_without_counterpart(*rights, difference)
        reached = new_names_in_wildcards(*rights, difference)
    protections = _protection_differences(first_source, second_source)
    domains = _domain_differences(first_source, second_source, scope)
    governed = governance and _governance_differs(first_source, second_source)
    enclaves = [
        (sign, enclave)
        for sign, side, other in (("-", *sides), ("+", *sides[::-1]))
        for enclave in sorted(side.enclaves_without_rights() - other.stated_enclaves())
        if other.kind != "zenoh" and (scope is None or enclave in scope)
    ]
    unclear = [*_unclear_enclaves(first_source, second_source, scope)]
    forms: Iterable[ChangedForm] = ()
    if first_source.policy and second_source.policy and not second_source.fleet:
        forms = changed_forms(first_source.policy.enclaves, second_source.policy.enclaves)
    return SourcesDifference(
        scope,
        difference,
        protections,
        unanswered,
        reached,
        domains,
        enclaves,
        governed,
        unclear,
        [*forms],
    )


def _unclear_enclaves(
    first_source: RightsSource, second_source: RightsSource, scope: frozenset[str] | None
) -> Iterator[str]:
    """Yield the enclaves whose permissions differ in something that rights do not tell."""
    for name in sorted({*first_source.documents, *second_source.documents}):
        if scope is not None and name not in scope:
            continue
        documents = (side.documents.get(name) for side in (first_source, second_source))
        sides = [
            [grant for grant in document.grants if _enclave_of(grant) == name] if document else []
            for document in documents
        ]
        first, second = ([(grant.rules, grant.default_allow) for grant in side] for side in sides)
        lacking = [_missing_discovery(side[0]) if side else [] for side in sides]
        left_out = any(any(_left_out_notes(side)) for side in sides)
        if lacking[0] != lacking[1] or (first != second and left_out):
            yield name


def _governance_differs(first_source: RightsSource, second_source: RightsSource) -> bool:
    """Return whether the governance of two keystores or enclaves differs or cannot be read."""
    if not {first_source.kind, second_source.kind} <= {"keystore", "enclave"}:
        return False
    try:
        return _governances(first_source) != _governances(second_source)
    except SrosError:
        return True


def _governances(source: RightsSource) -> set[Governance]:
    """Return the distinct governance documents that enclaves load; signatures are not verified."""
    keystore = OpenedKeystore(source.path)
    if source.kind == "enclave":
        places = {source.path / GOVERNANCE_FILE}
    else:
        places = {keystore.folder(name) / GOVERNANCE_FILE for name in keystore.names}
        places |= {source.path / GOVERNANCE_P7S} if keystore.has(GOVERNANCE_P7S) else set()
    documents = {keystore.read(place, "governance document") for place in places if place.exists()}
    return {
        parse_governance(keystore.files.signed_document(document).document, f"'{source.path}'")
        for document in documents
    }


def without_enclaves_of_sros(source: RightsSource, other: RightsSource) -> RightsSource:
    """Return a source without the enclaves that sros adds to a policy, unless ``other`` has them.

    These are the observer of a closed robot and, if ``other`` is a policy, the `_plain_routers`,
    which a note names.
    """
    observer = {CLOSED_OBSERVER} if folder_of_closed_robot(source.path) else set()
    routers = _plain_routers(source) if other.kind == "policy" else set()
    left_out = observer | routers
    left_out -= other.stated_enclaves() | {right.enclave for right in other.rights}
    if not left_out:
        return source
    notes = source.notes
    if named := sorted(left_out & routers):
        number = counted(
            len(named),
            "Zenoh router that is not in the policy and has",
            "Zenoh routers that are not in the policy and have",
        )
        text = f"left out: {number} only the rights that every node needs"
        notes = (*notes, Note("rights.routers", f"{text}: {first_few(named, 5)}."))
    return replace(
        source,
        rights=frozenset(right for right in source.rights if right.enclave not in left_out),
        scope=None if source.scope is None else source.scope - left_out,
        documents={name: of for name, of in source.documents.items() if name not in left_out},
        notes=notes,
    )


def _plain_routers(source: RightsSource) -> set[str]:
    """Return the routers of a keystore that only have the rights that every node needs."""
    settings = OpenedKeystore(source.path).settings if source.kind == "keystore" else None
    rights = defaultdict(set)
    for right in source.rights:
        rights[right.enclave].add(right)
    return {name for name in source.documents if is_plain_router(settings, name, rights[name])}


def is_plain_router(settings: Template | None, name: str, rights: Iterable[Right]) -> bool:
    """Return whether an enclave is the Zenoh router that sros made, without any other rights."""
    routers = settings.zenoh.router_names() if settings and settings.zenoh else ()
    return name in routers and are_basic(rights)


def _domain_differences(
    first_source: RightsSource, second_source: RightsSource, scope: Collection[str] | None
) -> list[DifferentDomains]:
    """Return the enclaves whose rights in the two sources are for different ROS domains."""
    before, after = _stated_domains(first_source), _stated_domains(second_source)
    return [
        DifferentDomains(enclave, before[enclave], after[enclave])
        for enclave in sorted(before.keys() & after.keys())
        if before[enclave] != after[enclave] and (scope is None or enclave in scope)
    ]


def _stated_domains(source: RightsSource) -> dict[str, str]:
    """Map the enclaves of a source to the ROS domains that the source states for their rights."""
    if source.kind == "zenoh":
        return {}
    ranges: dict[str, list[tuple[int, int]]] = defaultdict(list)
    unlimited = set()
    for domains, rights in rights_by_domains(source).items():
        for enclave in {right.enclave for right in rights}:
            if domains is None:
                unlimited.add(enclave)
            else:
                ranges[enclave] += ((part.first or 0, part.last or 0) for part in domains.ranges)
    return {
        name: str(DomainSet.of(*own_ranges))
        for name, own_ranges in ranges.items()
        if name not in unlimited
    }


def _protection_differences(
    first_source: RightsSource, second_source: RightsSource
) -> list[tuple[str, StatedProtection]]:
    """Return the protection that only one of two policies states.

    Each protection is paired with "-" if the first policy states it, and with "+" if the second
    policy does.
    """
    if first_source.protections is None or second_source.protections is None:
        return []
    protections, other = set(first_source.protections), set(second_source.protections)
    differences = [
        ("-", protection) for protection in first_source.protections if protection not in other
    ]
    differences += [
        ("+", protection)
        for protection in second_source.protections
        if protection not in protections
    ]
    return sorted(differences, key=lambda line: (line[1].enclave, line[1].name, line[0] == "+"))


_SIDE_OF_SIGN = {"-": "a", "+": "b"}


def policy_difference(
    first_source: RightsSource, second_source: RightsSource, difference: SourcesDifference
) -> PolicyDifference:
    """Return the value that ``--json`` prints for a comparison."""
    return PolicyDifference(
        not difference,
        first_source,
        second_source,
        [
            DifferentRight(_SIDE_OF_SIGN[sign], right, difference.rights.covered.get(right, ()))
            for sign, right in difference.rights.lines()
        ],
        [
            DifferentProtection(_SIDE_OF_SIGN[sign], stated)
            for sign, stated in difference.protections
        ],
        difference.unanswered,
        difference.reached,
        difference.domains,
        [DifferentEnclave(_SIDE_OF_SIGN[sign], enclave) for sign, enclave in difference.enclaves],
        difference.governance_differs,
        difference.unclear,
        difference.changed_forms,
    )


class SignedRights(NamedTuple):
    """The rights in signed permissions.

    ``policy`` is the SHA-256 of the policy from which they were made; "" if the ledger lacks it.
    ``nodes`` are nodes of the policy that the permissions do not show, in the text form of the
    ledger.
    """

    grant: Grant
    policy: str
    nodes: str = ""


_MOST_LOOKUPS = 200
"""Number of enclaves up to which the ledger is searched for each enclave.

For more enclaves, the whole ledger is read.
"""


class _LedgerPermissions:
    """The permissions in the ledger, or in the part of the ledger about some enclaves.

    ``last`` maps enclaves to their last permissions.  ``certain`` are the enclaves with
    permissions after the last gap.
    """

    def __init__(self, ledger: Ledger, keystore: OpenedKeystore) -> None:
        self.gaps = ledger.gaps
        # The first write of sros records the files of ros2/sros2.
        self.complete = not keystore.was_written_only_by_sros2
        self.last = {
            entry.enclave: entry for entry in ledger.entries if entry.what == "permissions"
        }
        self.certain = {entry.enclave for entry in ledger.certain if entry.what == "permissions"}


class RecordedRights:
    """The rights that were last signed for each enclave, by the ledger.

    The signatures of older permissions stay valid.  So present permissions are compared with the
    ledger before their rights are signed again.  Without this comparison, whoever puts older
    permissions back could get their rights signed with a new date.
    """

    def __init__(self, keystore: OpenedKeystore, ledger: Ledger | None = None) -> None:
        self._keystore = keystore
        self._root = keystore.root
        self._whole = ledger
        self._looked_up: dict[str, _LedgerPermissions] = {}

    @cached_property
    def _whole_ledger(self) -> _LedgerPermissions:
        return _LedgerPermissions(
            self._whole or self._keystore.ledger_with("what", "permissions"), self._keystore
        )

    def _ledger_part(self, name: str) -> _LedgerPermissions:
        """Return a part of the ledger with all lines about an enclave, and perhaps other lines."""
        file, are_few = self._keystore.ledger_file, len(self._looked_up) < _MOST_LOOKUPS
        if self._whole or "_whole_ledger" in self.__dict__ or not file.is_indexed:
            return self._whole_ledger
        if not are_few and file.is_complete:
            return self._whole_ledger
        if name not in self._looked_up:
            if not are_few:
                self._looked_up.clear()
            ledger = self._keystore.ledger_with("enclave", name)
            self._looked_up[name] = _LedgerPermissions(ledger, self._keystore)
        return self._looked_up[name]

    def rights_to_sign(self, name: str, digest: str, grant: Grant) -> SignedRights:
        """Return the rights in an enclave's permissions, for signing them again.

        ``grant`` has the rights; ``name``, ``digest`` and errors are as for `policy`.
        """
        return SignedRights(grant, self.policy(name, digest), self.nodes(name))

    def nodes(self, name: str) -> str:
        """Return the ledger's text with the nodes of an enclave's last permissions, or ""."""
        last = self.last_entry(name)
        return last.nodes if last else ""

    def last_entry(self, name: str) -> Entry | None:
        """Return the ledger entry of an enclave's last permissions, or None."""
        return self._ledger_part(name).last.get(name)

    def latest_entry(self, name: str, digest: str) -> Entry | None:
        """Return the last ledger entry of an enclave if it records these permissions, else None.

        ``name`` and ``digest`` are as for `policy`.
        """
        with suppress(KeystoreError):
            self.policy(name, digest)
            return self.last_entry(name)
        return None

    def policy(self, name: str, digest: str) -> str:
        """Return the SHA-256 of the policy of an enclave's permissions; "" if the ledger lacks it.

        Args:
            name: the enclave.
            digest: the SHA-256 of the enclave's present permissions document, in hexadecimal.

        Raises:
            KeystoreError: the document is not the last one that the ledger records for the enclave.
        """
        recorded = self._ledger_part(name)
        last, more = recorded.last.get(name), ""
        if last and last.sha256 != digest:
            why = (
                f"The ledger has other permissions, signed at {last.time}. Perhaps older "
                "permissions were put back, with rights that were removed since."
            )
        elif recorded.gaps and name not in recorded.certain:
            why = (
                f"The ledger has gaps ({'; '.join(recorded.gaps)}), so later permissions may be "
                "missing."
            )
            more = f" With --all in place of {name}, the command states the rights of all enclaves."
        elif not last and recorded.complete:
            why = "The ledger has no permissions for this enclave."
        else:
            return last.policy if last else ""
        raise KeystoreError(
            f"it is not certain that enclave {name} has its latest permissions",
            why,
            f"State its rights with `sros create_permission {quote(str(self._root))} {name} "
            "POLICY_FILE`, and "
            f"try again.{more}",
        )
