"""Choose enclaves of a keystore for the parts of a scenario, by their signed permissions.

The files of all enclaves decide.  An enclave that has only the rights of a part is preferred,
because its row shows whether other rights are denied. The enclave with the widest permissions gets
an extra part, so that it is tried even among many enclaves with few rights.  Enclaves with faulty
or revoked files play no part, and get separate rows.
"""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from itertools import permutations
from pathlib import Path
from typing import NamedTuple

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import Governance
from sros_tool.dds.permissions import Grant, Rule, parse_permissions
from sros_tool.demo.scenarios.attacks import (
    WIDEST,
    WIDEST_CLIENT,
    WIDEST_PUBLISHER,
    WIDEST_SERVER,
    WIDEST_SUBSCRIBER,
    faulty_enclave_row,
    revoked_enclave_row,
)
from sros_tool.demo.scenarios.model import (
    DEFAULT_TOPIC,
    DENIED_TOPIC,
    OUTCOMES,
    OWN,
    SERVICE,
    Party,
    Role,
    Row,
    RowStatus,
    Scenario,
    is_name_of_demo_nodes,
)
from sros_tool.errors import KeystoreError, SrosError
from sros_tool.faults import Fault
from sros_tool.keystore.issuing.keyring import Keyring, Secrets, no_secrets
from sros_tool.keystore.known_keys import revoked_serials
from sros_tool.keystore.layout import (
    CRL,
    CRL_FILE,
    ENCLAVES,
    IDENTITY,
    IDENTITY_CA_FILE,
    KEY_FILE,
    PERMISSIONS,
    PERMISSIONS_CA_FILE,
    PERMISSIONS_FILE,
    PRIVATE,
    ROLES,
    ca_key_path,
    enclave_path,
)
from sros_tool.keystore.reader import OpenedEnclave, OpenedKeystore
from sros_tool.keystore.template import Template
from sros_tool.names import ACTION_SEPARATOR, NODE_SERVICES, dds_names, service_of
from sros_tool.pki import smime
from sros_tool.pki.certificates import digest, fingerprints
from sros_tool.policy.patterns import matches
from sros_tool.wording import counted, first_few
from sros_tool.xml import read_bytes

_RIGHT_OF_ROLE = {
    Role.TALKER: "publish",
    Role.LISTENER: "subscribe",
    Role.SERVER: "reply",
    Role.CLIENT: "request",
}
_UNREADABLE = (Fault.FILE_UNREADABLE, Fault.FILE_NO_FILE, Fault.CRL_LEFT_OUT)
_MOST_FAULTY = 8
"""Maximum number of enclaves with faulty or revoked files that get a row."""


class CastMember(NamedTuple):
    """An enclave that plays a part in a scenario."""

    part: str
    """Name of the part, such as ``talker``."""
    enclave: str
    """Path of the enclave."""
    nodes: tuple[str, ...] = ()
    """Names of the enclave's ROS nodes."""
    why: str = ""
    """Reason for the choice of the enclave, or an empty string."""


class UserKeystore(NamedTuple):
    """A user's keystore to attack, with its template, domains, and cast.

    ``topic`` is the attacked ROS topic, ``service`` the attacked ROS service ("": none). ``grants``
    has the grant of each enclave of the cast, ``why`` the reasons for the choice of some parts.
    ``rows`` are for the enclaves with the widest permissions, and for enclaves with faulty or
    revoked files. ``enclaves`` is the number of all enclaves, ``elsewhere`` the number of enclaves
    whose key is not in the keystore.  ``not_tried`` lists tests that a proof needs and that cannot
    run. ``secrets`` returns the passphrases of the CA keys.
    """

    root: Path
    template: Template
    domains: DomainSet
    cast: Mapping[str, str]
    topic: str
    service: str
    grants: Mapping[str, Grant]
    why: Mapping[str, str]
    rows: tuple[Row, ...]
    enclaves: int
    elsewhere: int
    not_tried: tuple[str, ...]
    secrets: Secrets = no_secrets

    def copy(self, target: Path) -> None:
        """Copy the keystore with modes and links, but only the enclaves of rows and no CA keys."""
        of_rows = {party.identity.enclave for row in self.rows for party in row.parties}
        names = {*self.cast.values(), *(part for part in of_rows if part.startswith("/"))}
        folders = {f"{ENCLAVES}{name}" for name in names}
        shutil.copytree(self.root, target, symlinks=True, ignore=_copy_filter(self.root, folders))

    def keyring(self) -> Keyring:
        """Return a keyring for the CA keys, which are in the keystore or where its settings say."""
        inside = {role: self.root.absolute() / ca_key_path(role) for role in ROLES}
        places = {role: f"file:{path}" for role, path in inside.items() if path.exists()}
        return Keyring(self.secrets, places)

    def topic_of(self, party: Party, topic: str) -> str:
        """Return the topic or service of a party; ``topic`` is the attacked ROS topic."""
        name = party.topic or topic
        return (self.service or SERVICE) if name == SERVICE else name

    def permitted_enclave(self, row: Row) -> str:
        """Return the enclave that is both attacker and permitted party of a row, or ""."""
        attackers, other_enclaves = (
            {
                (party.role, self.cast.get(party.identity.enclave, ""))
                for party in row.parties
                if party.identity.keystore is OWN and party.intruder is intruder
            }
            for intruder in (True, False)
        )
        return next((enclave for _, enclave in attackers & other_enclaves), "")

    def row_if_allowed(self, row: Row, topic: str) -> Row:
        """Return the row; if the attacker's permissions allow the attack, the row expects success.

        ``topic`` is the attacked ROS topic.  A row that expects success has no parties except the
        parties of its claim: success needs no control, and another server could answer in place of
        the attacker.
        """
        attacker = next((party for party in row.parties if party.intruder), None)
        if row.expected is not RowStatus.REFUSED or attacker is None:
            return row
        enclave = self.cast.get(attacker.identity.enclave, "")
        if attacker.identity.keystore is not OWN or enclave not in self.grants:
            return row
        if self.permitted_enclave(row):
            return row
        right, name = _RIGHT_OF_ROLE[attacker.role], self.topic_of(attacker, topic)
        expressions = _expressions_of(self.grants[enclave], right, name)
        if not all(expressions):
            return row
        wild = next(
            (
                f" (by the wildcard {expression})"
                for expression in expressions
                if _has_wildcard(expression)
            ),
            "",
        )
        claim = row.claims[0]
        success = OUTCOMES[claim.relation][True]
        return replace(
            row,
            expected=success,
            mechanism="the attacker's signed permissions allow the attack",
            parties=tuple(
                party for party in row.parties if party.name in (claim.subject, claim.talker)
            ),
            claims=(claim.expecting(success),),
            controls=(),
            open_because=f"the permissions of {enclave} allow it to {right} {name}{wild}",
            remedy="give the enclave a policy without this right, or accept the row "
            "(--accept-open)",
        )


def open_user_keystore(root: Path, topic: str, scenario: Scenario, now: datetime) -> UserKeystore:
    """Return a user's keystore, with enclaves chosen for the ROS topic ``topic`` ("": any topic).

    Raises:
        KeystoreError: ``root`` is not a keystore, or no two enclaves may talk to each other.
    """
    keystore = OpenedKeystore(root)
    keystore.check()
    domains = keystore.governance.domains()
    read = _read_enclaves(keystore, now, next(iter(domains)))
    template = keystore.template
    # A keystore that is created from this template gets new CA keys instead of the user's keys.
    template = replace(template, identity_key="", permissions_key="")
    wanted = f"rt{topic}" if topic else ""
    rights = read.rights
    if set(scenario.cast.values()) <= set(rights):
        cast = dict(scenario.cast)
        chosen = wanted or _first_topic(rights, cast)
    else:
        cast, chosen = _best_cast(rights, wanted, read.without_list)
    if not chosen:
        raise KeystoreError(
            f"no two enclaves of keystore '{root}' may talk on {topic or 'a topic'}",
            "An attack needs an enclave that may publish a topic (named without wildcards), and"
            " another enclave that may subscribe to it." + read.faults_text(),
            "With --topic, name a topic that two enclaves may use, or attack a keystore that"
            " `sros demo --keep` made.",
        )
    service = _service(rights, cast) if "server" in cast else ""
    attacked = chosen.removeprefix("rt")
    widest = dict(_widest_enclaves(rights, cast, attacked, service))
    cast |= {part: enclave for part, (enclave, _) in widest.items()}
    return UserKeystore(
        root=root,
        template=template,
        domains=domains,
        cast=cast,
        topic=attacked,
        service=service,
        grants={name: rights[name] for name in cast.values()},
        why={part: why for part, (_, why) in widest.items()},
        rows=(*(row for part, row in WIDEST.items() if part in widest), *read.rows()),
        enclaves=len(keystore.names),
        elsewhere=len(read.elsewhere),
        not_tried=tuple(read.not_tried(cast)),
    )


class _Enclaves(NamedTuple):
    """The enclaves of a keystore, sorted by what their files allow the demo to do.

    ``rights`` are the grants of sound enclaves.  ``faulty`` maps enclaves that other enclaves do
    not accept to their first fault; ``revoked`` maps each revoked enclave to whether its own
    revocation list names it. ``unreadable`` enclaves have files that are not safe to read, such as
    an endless file of the kernel. ``elsewhere`` are enclaves whose key is not in the keystore.
    ``without_list`` are enclaves without the newest revocation list of their keystore;
    ``other_governance`` are enclaves with another governance than the rest; ``other_domain`` are
    enclaves that may not join ``domain``, the ROS domain of the demo.
    """

    rights: Mapping[str, Grant]
    faulty: Mapping[str, str]
    revoked: Mapping[str, bool]
    unreadable: tuple[str, ...]
    elsewhere: tuple[str, ...]
    without_list: frozenset[str]
    other_governance: tuple[str, ...]
    other_domain: tuple[str, ...]
    domain: int

    def rows(self) -> Iterator[Row]:
        """Yield a row for each enclave with faulty or revoked files, up to `_MOST_FAULTY`."""
        rows = [revoked_enclave_row(name, has_list) for name, has_list in self.revoked.items()]
        rows += [faulty_enclave_row(name, why) for name, why in self.faulty.items()]
        yield from rows[:_MOST_FAULTY]

    def not_tried(self, cast: Mapping[str, str]) -> Iterator[str]:
        """Yield the tests that a proof of the keystore needs and this cast cannot run."""
        more = len(self.revoked) + len(self.faulty) - _MOST_FAULTY
        if more > 0:
            yield f"{counted(more, 'more enclave')} with faulty files or revoked certificates"
        if self.unreadable:
            yield f"{first_few(sorted(self.unreadable), 1)} with files that cannot be read"
        if self.without_list and cast["listener"] not in self.without_list:
            yield f"{first_few(sorted(self.without_list), 1)} without the newest revocation list"
        if self.other_governance:
            names = first_few(sorted(self.other_governance), 1)
            yield f"{names} with another governance than the other enclaves"
        if self.other_domain:
            yield f"{first_few(sorted(self.other_domain), 1)} outside domain {self.domain}"

    def faults_text(self) -> str:
        """Return a sentence on the first enclave left out because of its files, or ""."""
        for name, why in self.faulty.items():
            return f" {name} is left out: {why}."
        return ""


def _read_enclaves(keystore: OpenedKeystore, now: datetime, domain: int) -> _Enclaves:
    """Read the files of all enclaves; ``domain`` is the ROS domain of the demo."""
    rights: dict[str, Grant] = {}
    faulty: dict[str, str] = {}
    revoked: dict[str, bool] = {}
    unreadable: list[str] = []
    elsewhere: list[str] = []
    without_list: list[str] = []
    other_domain: list[str] = []
    governances: dict[str, Governance | None] = {}
    serials = revoked_serials(keystore)
    newest = _content(keystore.root / CRL)
    for name in keystore.names:
        state = keystore.enclave(name, now=now, domain=domain)
        faults = [problem for problem in state.problems if problem.fault is not Fault.REVOKED]
        by_own_list = len(faults) < len(state.problems)
        if any(fault.fault in _UNREADABLE for fault in faults):
            unreadable.append(name)
        elif KEY_FILE not in state.files and (state.key_on_robot or state.token):
            elsewhere.append(name)
        elif by_own_list or (state.certificate and state.certificate.serial_number in serials):
            revoked[name] = by_own_list
        elif faults and all(fault.fault is Fault.PERMISSIONS_DOMAIN for fault in faults):
            other_domain.append(name)
        elif reason := str(faults[0]) if faults else _fault_of_ca_file(keystore, state):
            faulty[name] = reason
        elif grant := state.grant:
            rules = tuple(rule for rule in grant.rules if domain in rule.domains.closed())
            rights[name] = grant._replace(rules=rules)
            governances[name] = state.governance
            if newest or serials:
                revocations = _content(keystore.folder(name) / CRL_FILE)
                without_list += (
                    [name] if not revocations or revocations != (newest or revocations) else []
                )
    usual = Counter(governances.values()).most_common(1)
    return _Enclaves(
        rights=rights,
        faulty=faulty,
        revoked=revoked,
        unreadable=tuple(unreadable),
        elsewhere=tuple(elsewhere),
        without_list=frozenset(without_list),
        other_governance=tuple(
            name for name, governance in governances.items() if governance != usual[0][0]
        ),
        other_domain=tuple(other_domain),
        domain=domain,
    )


def _content(path: Path) -> bytes:
    """Return the content of a file; empty if the file is missing or cannot be read."""
    try:
        return read_bytes(path, "revocation list") if path.exists() else b""
    except SrosError:
        return b""


def _fault_of_ca_file(keystore: OpenedKeystore, state: OpenedEnclave) -> str:
    """Return a clause if a CA file of an enclave has no CA of the keystore, or else ""."""
    for file, role in ((IDENTITY_CA_FILE, IDENTITY), (PERMISSIONS_CA_FILE, PERMISSIONS)):
        known = {digest(certificate) for certificate in keystore.authority(role)}
        if fingerprints(state.files[file]).isdisjoint(known):
            return f"{file}: it has no certificate of the keystore's {role} CA"
    return ""


def _best_cast(
    rights: Mapping[str, Grant], wanted: str, without_list: frozenset[str]
) -> tuple[dict[str, str], str]:
    """Return the best enclaves for talker, listener and guest, and their DDS topic.

    ``wanted`` is the only DDS topic to consider; "" stands for all topics.  An enclave that may
    only publish, or only subscribe, is better than an enclave that may do both.  The best listener
    is an enclave in ``without_list``: it lacks the newest revocation list, so perhaps it does not
    know that an enclave was revoked.
    """
    best: tuple[int, dict[str, str], str] = (-1, {}, "")
    serving = _service_cast(rights)
    named = sorted(topic for topic in _topics(rights) if "rt/" in topic)
    for topic in [wanted] if wanted else [*named, f"rt{DEFAULT_TOPIC}"]:
        talkers = {name for name in rights if allows(rights[name], "publish", topic)}
        listeners = {name for name in rights if allows(rights[name], "subscribe", topic)}
        pair = next(
            (
                (talker, listener)
                for talker in _sorted_by_fitness(rights, "publish", talkers, listeners, topic)
                for listener in sorted(
                    _sorted_by_fitness(rights, "subscribe", listeners, talkers, topic),
                    key=lambda name: name not in without_list,
                )
                if talker != listener
            ),
            None,
        )
        if pair is None:
            continue
        cast = dict(zip(("talker", "listener"), pair, strict=True))
        unpaired = [name for name in rights if name not in pair]
        unpaired.sort(
            key=lambda name: ((name in talkers) + (name in listeners), name in serving.values())
        )
        if unpaired:
            cast["guest"] = unpaired[0]
        nested = [(g, a) for g, a in permutations(rights, 2) if _has_only_parts_of(g, a)]
        guest_and_admin = next(
            ((g, a) for g, a in nested if a in talkers and g not in talkers), None
        )
        if guest_and_admin and not set(guest_and_admin) & set(pair):
            cast["guest"], cast["admin"] = guest_and_admin
        talking_listeners = talkers & listeners
        score = len(cast) + (cast.get("guest") not in talkers) - len(talking_listeners & set(pair))
        score += 10 * (cast["listener"] in without_list)
        if score > best[0]:
            best = (score, cast, topic)
    _, cast, topic = best
    return (cast | serving if cast else cast), topic


def _sorted_by_fitness(
    rights: Mapping[str, Grant], right: str, chosen: set[str], other_enclaves: set[str], topic: str
) -> list[str]:
    """Return ``chosen`` sorted by how well an enclave suits a demo of the ``right`` to ``topic``.

    Enclaves that are not in ``other_enclaves`` come first.  Then come enclaves whose permissions
    name the topic.  Last are enclaves with a rule that denies the other direction, because Cyclone
    DDS 0.10 then denies both directions.
    """
    return sorted(
        (name for name in rights if name in chosen),
        key=lambda name: (
            _is_denied(rights[name], topic),
            name in other_enclaves,
            not _allows_name(rights[name], right, topic.removeprefix("rt"), named=True),
        ),
    )


def _service_cast(rights: Mapping[str, Grant]) -> dict[str, str]:
    """Return the cast of a server and a client of one service; empty if there is none.

    Clients that may not serve are preferred, and clients whose permissions name the service.
    """
    cast: dict[str, str] = {}
    best = -1
    for server, client in permutations(rights, 2):
        for topic in _application_topics(rights[server]):
            service, begin = service_of(topic)
            if begin != "rr":
                continue
            if not allows(rights[client], "publish", dds_names("request", service).publish[0]):
                continue
            score = 2 * (not allows(rights[client], "publish", topic))
            score += _allows_name(rights[client], "request", service, named=True)
            if score > best:
                best, cast = score, {"server": server, "client": client}
            if best == 3:
                return cast
    return cast


def _service(rights: Mapping[str, Grant], cast: Mapping[str, str]) -> str:
    """Return the service that the server of a cast offers and the client calls.

    The result is `SERVICE` if the server's permissions name no such service.
    """
    for topic in _application_topics(rights[cast["server"]]):
        name, begin = service_of(topic)
        requests = dds_names("request", name).publish[0]
        if begin == "rr" and allows(rights[cast["client"]], "publish", requests):
            return name
    return SERVICE


def _widest_enclaves(
    rights: Mapping[str, Grant], cast: Mapping[str, str], topic: str, service: str
) -> Iterator[tuple[str, tuple[str, str]]]:
    """Yield part, enclave and reason for the enclaves with the widest permissions.

    An enclave whose permissions name the topic or service counts only if it may also use names that
    no permissions state.  An enclave gets no part if another row tries it with the same attack.
    """
    for part, right, name, competing_parts in (
        (WIDEST_PUBLISHER, "publish", topic, ("talker", "listener", "guest")),
        (WIDEST_SUBSCRIBER, "subscribe", topic, ("talker", "listener", "guest")),
        (WIDEST_CLIENT, "request", service, ("server", "client", "guest")),
        (WIDEST_SERVER, "reply", service, ("server", "client")),
    ):
        if not name:
            continue
        unnamed = [
            enclave
            for enclave, grant in rights.items()
            if not _allows_name(grant, right, name, named=True)
            or _allows_name(grant, right, DENIED_TOPIC)
        ]
        tried = {cast[other] for other in competing_parts if other in cast}
        width = {enclave: _width_key(rights[enclave], right, name) for enclave in unnamed}
        free = [enclave for enclave in unnamed if enclave not in tried]
        if not free:
            continue
        widest = max(free, key=width.__getitem__)
        if any(width[widest][:2]):
            why = f"may {right} {name if width[widest][0] else 'any other name'} by a wildcard"
        else:
            why = f"has the most rights among enclaves that may not {right} {name}"
        yield part, (widest, why)


def _width_key(grant: Grant, right: str, name: str) -> tuple[bool, bool, int]:
    """Return a sort key that puts wider grants last."""
    size = sum(
        len(criteria.topics)
        for rule in grant.rules
        for criteria in (*rule.publish, *rule.subscribe)
    )
    return _allows_name(grant, right, name), _allows_name(grant, right, DENIED_TOPIC), size


def _first_topic(rights: Mapping[str, Grant], cast: Mapping[str, str]) -> str:
    own_topics = [
        topic for topic in _application_topics(rights[cast["talker"]]) if topic[:3] == "rt/"
    ]
    return next((t for t in own_topics if allows(rights[cast["listener"]], "subscribe", t)), "")


def _has_only_parts_of(short: str, long: str) -> bool:
    """Return whether the path ``long`` has all parts of the path ``short``, and further parts.

    Cyclone DDS 0.10 compares the parts of subjects in this way, whatever their order.
    """
    return set(short.strip("/").split("/")) < set(long.strip("/").split("/"))


def _topics(rights: Mapping[str, Grant]) -> set[str]:
    return {topic for grant in rights.values() for topic in _application_topics(grant)}


def _copy_filter(root: Path, folders: set[str]) -> Callable[[str, list[str]], set[str]]:
    """Return an ``ignore`` function for `shutil.copytree` that skips CA keys and other enclaves."""
    wanted = {root / folder for folder in folders}
    kept = {parent for folder in wanted for parent in folder.parents} | wanted

    def left_out_names(parent: str, names: list[str]) -> set[str]:
        if Path(parent) == root:
            return {name for name in names if name == PRIVATE or name.startswith(".")}
        inside = Path(parent).relative_to(root).parts[0] == ENCLAVES
        paths = {name: Path(parent, name) for name in names}
        return {
            name for name, path in paths.items() if inside and path.is_dir() and path not in kept
        }

    return left_out_names


_WILDCARDS = set("*?[")


def enclave_grant(root: Path, enclave: str) -> Grant | None:
    """Return the first grant of an enclave, or None if its permissions cannot be read."""
    try:
        signed = read_bytes(enclave_path(root, enclave) / PERMISSIONS_FILE, "permissions document")
        grants = parse_permissions(smime.parse(signed).document).grants
    except (SrosError, OSError):
        return None
    return grants[0] if grants else None


def allows(grant: Grant, direction: str, topic: str) -> bool:
    """Return whether a grant allows ``direction`` (publish or subscribe) on a DDS topic."""
    return bool(_allowing_expression(grant, direction, topic))


def _allowing_expression(grant: Grant, direction: str, topic: str) -> str:
    """Return the expression by which a grant allows ``direction`` on a DDS topic; "" if denied.

    As with the vendors, the first rule that names the topic decides; of several matching
    expressions in this rule, the exact name is returned.  A topic that no rule names is denied.
    """
    for rule in grant.rules:
        fitting = [
            expression for expression in _expressions(rule, direction) if matches(expression, topic)
        ]
        if fitting:
            return (topic if topic in fitting else fitting[0]) if rule.allow else ""
    return ""


def _is_denied(grant: Grant, topic: str) -> bool:
    """Return whether a rule denies publishing or subscribing to a DDS topic."""
    return any(
        matches(expression, topic)
        for rule in grant.rules
        for direction in ("publish", "subscribe")
        for expression in (() if rule.allow else _expressions(rule, direction))
    )


def _expressions_of(grant: Grant, right: str, name: str) -> tuple[str, ...]:
    """Return the expressions that allow a right on a ROS name, for each DDS topic ("": denied)."""
    topics = dds_names(right, name)
    return (
        *(_allowing_expression(grant, "publish", topic) for topic in topics.publish),
        *(_allowing_expression(grant, "subscribe", topic) for topic in topics.subscribe),
    )


def _allows_name(grant: Grant, right: str, name: str, *, named: bool = False) -> bool:
    """Return whether a grant allows a right on a ROS name; with ``named``, by exact name only."""
    return all(
        expression and not (named and _has_wildcard(expression))
        for expression in _expressions_of(grant, right, name)
    )


def _has_wildcard(expression: str) -> bool:
    """Return whether a topic expression has wildcards."""
    return bool(set(expression) & _WILDCARDS)


def _application_topics(grant: Grant) -> Iterator[str]:
    """Yield the DDS topics of the application that a grant allows to publish by exact name.

    Topics and services of nodes, hidden topics and topics of actions are left out.
    """
    for topic in _topics_to_publish(grant):
        name = service_of(topic)[0] or topic.removeprefix("rt")
        if not (
            is_name_of_demo_nodes(name) or topic.startswith("rt/_") or ACTION_SEPARATOR in topic
        ):
            yield topic


def _topics_to_publish(grant: Grant) -> Iterator[str]:
    """Yield the DDS topics that a grant allows to publish by exact name."""
    for rule in grant.rules:
        for topic in _expressions(rule, "publish") if rule.allow else ():
            if not _has_wildcard(topic):
                yield topic


def _expressions(rule: Rule, direction: str) -> Iterator[str]:
    for criteria in rule.publish if direction == "publish" else rule.subscribe:
        yield from criteria.topics


# ── names of nodes ───────────────────────────────────────────────────────────────────────────────

_NODE_MARK = ("rr", f"/{NODE_SERVICES[0]}Reply")


def is_node_allowed(grant: Grant, node: str) -> bool:
    """Return whether a grant allows all standard services of ``node``, an absolute name."""
    names = (dds_names("reply", f"{node}/{service}") for service in NODE_SERVICES)
    return all(
        all(allows(grant, "publish", topic) for topic in name.publish)
        and all(allows(grant, "subscribe", topic) for topic in name.subscribe)
        for name in names
    )


def nodes_named(grant: Grant) -> Iterator[str]:
    """Yield the absolute names of nodes whose standard services a grant allows by exact name."""
    kind, service = _NODE_MARK
    for topic in _topics_to_publish(grant):
        if topic.startswith(kind) and topic.endswith(service):
            node = topic.removeprefix(kind).removesuffix(service)
            if is_node_allowed(grant, node):
                yield node


DEFAULT_NODE_NAMES: Mapping[Role, tuple[str, ...]] = {
    Role.TALKER: ("talker",),
    Role.LISTENER: ("listener",),
    Role.OBSERVER: ("observer",),
    Role.SERVER: ("server",),
    Role.CLIENT: ("client",),
    Role.ACTION_SERVER: ("action_server",),
    Role.ACTION_CLIENT: ("action_client",),
    Role.COMPOSED: ("talker", "listener", "server"),
}
"""Default node names of the roles, in the namespace "/"."""


def node_names(role: Role, grant: Grant | None) -> tuple[str, ...]:
    """Return the absolute names of a role's nodes under a grant (None: unsecured).

    A node keeps its default name if the grant allows it.  Otherwise it gets the most similar node
    name in the grant; if there is no such name, it keeps its default name.
    """
    wanted = [f"/{name}" for name in DEFAULT_NODE_NAMES[role]]
    if grant is None:
        return tuple(wanted)
    allowed = {name for name in wanted if is_node_allowed(grant, name)}
    granted = [*dict.fromkeys(nodes_named(grant))]
    free = [name for name in granted if name not in allowed]
    return tuple(_allowed_or_similar_names(wanted, allowed, free, granted))


def _allowed_or_similar_names(
    wanted_names: Sequence[str],
    allowed_names: set[str],
    free_names: list[str],
    granted_names: Sequence[str],
) -> Iterator[str]:
    for name in wanted_names:
        if name in allowed_names or not granted_names:
            yield name
            continue
        # With more nodes than names, two nodes share a name: DDS allows that in a process.
        similar_names = [enclave for enclave in free_names if name[1:] in enclave.lower()]
        chosen = (similar_names or free_names or granted_names)[0]
        if chosen in free_names:
            free_names.remove(chosen)
        yield chosen


def naming_arguments(role: Role, names: Sequence[str]) -> list[str]:
    """Return ``--ros-args`` that give the nodes of a role these absolute names."""
    rules: list[str] = []
    for default, name in zip(DEFAULT_NODE_NAMES[role], names, strict=True):
        namespace, _, node = name.rpartition("/")
        if node != default:
            rules += ["-r", f"{default}:__node:={node}"]
        if namespace:
            # rcl looks up the rule for the namespace by the node's new name.
            rules += ["-r", f"{node}:__ns:={namespace}"]
    return ["--ros-args", *rules, "--"] if rules else []
