"""The data model of scenarios: parties, claims about them, rows, and the policies of enclaves.

A row is one line of the table: processes that start together, claims about them, and controls,
which prove that silence is not caused by a crash.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Final

from sros_tool.demo.forger import Forge, Undefended
from sros_tool.errors import UsageError
from sros_tool.files import policies_dir
from sros_tool.names import node_of_service
from sros_tool.policy.document import read_policy
from sros_tool.policy.model import Enclave, Group, Policy, Profile


class Role(StrEnum):
    """The role of a process."""

    TALKER = "talker"
    LISTENER = "listener"
    OBSERVER = "observer"
    SERVER = "server"
    CLIENT = "client"
    ACTION_SERVER = "action_server"
    ACTION_CLIENT = "action_client"
    COMPOSED = "composed"
    """Several nodes in one process and one enclave: a talker, a listener and a server."""
    ROUTER = "router"
    """The router of a Zenoh network."""
    RELAY = "relay"
    """A talker and a listener in one node."""
    FLOODER = "flooder"
    """A program that opens useless connections to the router."""
    ERASER = "eraser"
    """A node that removes the nodes of talkers from the graph of Zenoh."""

    @property
    def uses(self) -> str:
        """The kind of name that the role's ``topic`` is: topic, service or action."""
        if self in (Role.SERVER, Role.CLIENT):
            return "service"
        return "action" if self in (Role.ACTION_SERVER, Role.ACTION_CLIENT) else "topic"


SPEAKING = frozenset({Role.TALKER, Role.RELAY, Role.SERVER, Role.ACTION_SERVER, Role.COMPOSED})
"""Roles whose messages contain a text that identifies the process."""

CALLING = frozenset({Role.CLIENT, Role.ACTION_CLIENT})
"""Roles whose requests, on Zenoh, contain a text that identifies the process."""


class RowStatus(StrEnum):
    """The expected or observed outcome of a row."""

    HEARD = "heard"
    NOT_HEARD = "not heard"
    HEARD_AGAIN = "heard again"
    NOT_HEARD_AGAIN = "not heard again"
    DECEIVED = "deceived"
    NOT_DECEIVED = "not deceived"
    ANSWERED = "answered"
    NOT_ANSWERED = "not answered"
    EXECUTED = "executed"
    NOT_EXECUTED = "not executed"
    STILL_HEARD = "still heard"
    CUT_OFF = "cut off"
    REFUSED = "refused"
    NOT_LET_IN = "not let in"
    STARTED = "started"
    UNDISTURBED = "undisturbed"
    DISTURBED = "disturbed"
    VISIBLE = "visible"
    NOT_VISIBLE = "not visible"
    ERASED = "erased"
    NOT_ERASED = "not erased"
    READABLE = "readable"
    NOT_READABLE = "not readable"
    CRASHED = "crashed"
    NOT_STARTED = "not started"
    UNDECIDED = "undecided"
    SKIPPED = "skipped"


DENIALS = (RowStatus.REFUSED, RowStatus.NOT_LET_IN)
"""Statuses of a denial: of a topic, or of the whole process."""


class Relation(StrEnum):
    """A relation between two parties, or a state of one party."""

    HEARS = "hears"
    HEARS_AGAIN = "hears replayed packets of"
    BELIEVES = "believes changed packets of"
    HEARS_EXPIRED = "still hears, after certificate expiry, the"
    IS_ANSWERED = "is answered by"
    EXECUTES = "executes a call of"
    IS_REFUSED = "is refused"
    STARTS = "starts"
    SEES = "sees"
    LOSES = "loses a node because of"
    READABLE = "is readable"


OUTCOMES: Mapping[Relation, tuple[RowStatus, RowStatus]] = {
    Relation.HEARS: (RowStatus.NOT_HEARD, RowStatus.HEARD),
    Relation.HEARS_AGAIN: (RowStatus.NOT_HEARD_AGAIN, RowStatus.HEARD_AGAIN),
    Relation.BELIEVES: (RowStatus.NOT_DECEIVED, RowStatus.DECEIVED),
    Relation.HEARS_EXPIRED: (RowStatus.CUT_OFF, RowStatus.STILL_HEARD),
    Relation.EXECUTES: (RowStatus.NOT_EXECUTED, RowStatus.EXECUTED),
    Relation.IS_ANSWERED: (RowStatus.NOT_ANSWERED, RowStatus.ANSWERED),
    Relation.IS_REFUSED: (RowStatus.STARTED, RowStatus.REFUSED),
    Relation.STARTS: (RowStatus.REFUSED, RowStatus.STARTED),
    Relation.SEES: (RowStatus.NOT_VISIBLE, RowStatus.VISIBLE),
    Relation.LOSES: (RowStatus.NOT_ERASED, RowStatus.ERASED),
    Relation.READABLE: (RowStatus.NOT_READABLE, RowStatus.READABLE),
}
"""Relation → status of a relation that does not hold, and status of a relation that holds."""

SUCCESSES = frozenset(
    holding
    for relation, (_, holding) in OUTCOMES.items()
    if relation not in (Relation.IS_REFUSED, Relation.STARTS)
)
"""Statuses of an attack that succeeded."""


class Wire(StrEnum):
    """A text to look for in a party's packets, or in shared memory."""

    TEXT = "text"
    TOPIC = "topic name"
    CERTIFICATE = "certificate"
    MEMORY = "shared memory"


class SoundKeystore(StrEnum):
    """A keystore of a scenario that is not forged."""

    OWN = "own"
    FOREIGN = "foreign"
    """A keystore from another CA, with the same enclaves."""


OWN, FOREIGN = SoundKeystore.OWN, SoundKeystore.FOREIGN

KeystoreChoice = SoundKeystore | Forge | Undefended
"""A keystore without forgery, or the forgery that makes the keystore.

A `Forge` changes a copy of the scenario's own keystore, `Undefended` changes a new keystore.
"""


@dataclass(frozen=True)
class Identity:
    """The keystore and the enclave of a process; without a keystore, the process is unsecured.

    ``enclave`` is a part of the scenario's cast ("talker") or the name of an enclave
    ("/arm/camera").  ``variables`` replace environment variables of a secured process.  On Zenoh, a
    process that ``ignores_rules`` switches its own access control off.
    """

    keystore: KeystoreChoice | None = None
    enclave: str = ""
    variables: tuple[tuple[str, str], ...] = ()
    ignores_rules: bool = False


UNSECURED = Identity()


@dataclass(frozen=True)
class Party:
    """One process of a row.

    ``topic`` is the ROS name of the topic, service or action that the process uses ("": the topic
    of the demo).
    ``other_topic`` puts a talker on a topic that nobody else uses.  If an ``intruder`` is refused,
    the row goes on.  A party of a later ``turn`` starts when all parties of earlier turns are
    ready. ``announced`` is the enclave that the party names to others ("": its own), as a part or a
    name; messages of the party have ``size`` bytes or more.
    """

    name: str
    role: Role
    identity: Identity = UNSECURED
    topic: str = ""
    other_topic: bool = False
    intruder: bool = False
    turn: int = 0
    announced: str = ""
    size: int = 0


@dataclass(frozen=True)
class Claim:
    """A claim that ``relation`` holds, or does not hold, between ``subject`` and ``talker``.

    With ``holds`` False, the claim is that the relation does not hold; ``denied`` is then the
    status in `DENIALS` that must be the reason (None: any reason).  ``evidence`` is a text that a
    party of the row must have logged about a process that was refused ("": none).  ``wire`` is the
    text to look for if the relation is about packets or shared memory.
    """

    relation: Relation
    subject: str
    talker: str = ""
    holds: bool = True
    denied: RowStatus | None = None
    evidence: str = ""
    wire: Wire = Wire.TEXT

    @property
    def expected(self) -> RowStatus:
        """The status that the claim expects."""
        return self.denied or OUTCOMES[self.relation][self.holds]

    def expecting(self, status: RowStatus) -> Claim:
        """Return the claim with another expected status.

        Raises:
            ValueError: the relation cannot have that status.
        """
        if status in DENIALS:
            return replace(self, holds=False, denied=status)
        for holds in (True, False):
            if OUTCOMES[self.relation][holds] is status:
                return replace(self, holds=holds, denied=None)
        raise ValueError(f"a claim {self.relation.value!r} cannot have status {status.value!r}")


class Condition(StrEnum):
    """A condition on keystore template or vendor that changes an expected status."""

    ONE_CA = "one CA for identity and permissions"
    SHARED_SUBJECTS = "subject names without a unique part"
    OPEN_DEFAULT = "an enclave without a policy may do everything"
    IN_CLEAR = "payload is not encrypted"
    UNSIGNED = "messages are neither signed nor encrypted"
    UNAUTHENTICATED = "unauthenticated participants are allowed, and the topic is not protected"
    UNAUTHENTICATED_SEE = "unauthenticated participants are allowed, and discovery is not protected"
    UNCONTROLLED = "access to the topic is not controlled"
    OPEN_JOIN = "joining the domain is not controlled"
    CYCLONE = "Cyclone DDS 0.10"
    FAST = "Fast DDS"
    EXACT_SIGNER = (
        "the certificate of a signer must be in the file of the permissions CA (Fast DDS with the "
        "fix of CVE-2023-24010, Cyclone DDS 11)"
    )


@dataclass(frozen=True)
class Variant:
    """The expected status of a row if all ``conditions`` are true.

    ``open_because`` is the reason why an attack succeeds under these conditions ("": the attack
    fails). ``remedy`` is what a user can do.  ``mechanism`` replaces the reason for the expected
    status ("": the reason of the row).  ``instead`` is a row to run instead, for a vendor
    that implements the defense differently.
    """

    conditions: tuple[Condition, ...]
    expected: RowStatus
    open_because: str = ""
    remedy: str = ""
    mechanism: str = ""
    instead: Row | None = None


@dataclass(frozen=True)
class Row:
    """One line of the demo's table: processes, claims about them, and controls.

    ``mechanism`` is the reason for the expected status, as a clause; ``wire`` requests a capture of
    the packets; ``replay`` names the party whose packets are sent again after its end,
    ``impersonate`` the party whose packets are sent again with changed text.  A ``brief`` row ends
    as soon as it is decided.  ``meanwhile`` changes the keystore of the first claim's subject when
    all processes run; with ``short_lived``, the talker of the first claim gets a certificate that
    expires while the row runs.  Rows of the same ``world`` share processes: a party of two such
    rows is one process.  The first of ``variants`` whose conditions hold replaces the expected
    status.  ``attack`` names the attack to which the row belongs; with ``defence_removed``, the row
    shows that attack without the defense of that name.  ``open_because`` and ``remedy`` are as in
    `Variant`.  ``accepted`` says that the user accepts the success of the attack. ``unaccepted``
    says that the attack succeeds because of the user's keystore, and that the user did not accept
    this.
    """

    name: str
    expected: RowStatus
    mechanism: str
    parties: tuple[Party, ...]
    claims: tuple[Claim, ...]
    controls: tuple[Claim, ...] = ()
    wire: bool = False
    replay: str = ""
    impersonate: str = ""
    brief: bool = False
    meanwhile: Forge | None = None
    short_lived: bool = False
    world: str = ""
    variants: tuple[Variant, ...] = ()
    attack: str = ""
    defence_removed: str = ""
    open_because: str = ""
    remedy: str = ""
    accepted: bool = False
    unaccepted: bool = False

    @property
    def is_captured(self) -> bool:
        """Whether the row's packets are captured."""
        return bool(self.wire or self.replay or self.impersonate)

    def party(self, name: str) -> Party:
        """Return the party with this name.

        Raises:
            KeyError: the row has no such party.
        """
        return {party.name: party for party in self.parties}[name]

    @property
    def ros_name(self) -> str:
        """The topic, service or action of the first claim ("": the demo's topic)."""
        return self.party(self.claims[0].subject).topic

    @property
    def first_talker(self) -> Party:
        """The talker of the first claim."""
        return self.party(self.claims[0].talker)

    def with_expected_status(self, conditions: frozenset[Condition]) -> Row:
        """Return the row with the status that is expected under ``conditions``."""
        for variant in self.variants:
            if conditions.issuperset(variant.conditions):
                if variant.instead is not None:
                    return variant.instead.with_expected_status(conditions)
                claims = tuple(
                    claim.expecting(variant.expected) if place == 0 else claim
                    for place, claim in enumerate(self.claims)
                )
                return replace(
                    self,
                    expected=variant.expected,
                    claims=claims,
                    open_because=variant.open_because,
                    remedy=variant.remedy or self.remedy,
                    mechanism=variant.mechanism or self.mechanism,
                    variants=(),
                )
        return self


def merged_row(rows: Sequence[Row]) -> Row:
    """Merge rows that share processes into one row with all parties, claims and controls.

    Raises:
        ValueError: two parties of one name differ.
    """
    parties: dict[str, Party] = {}
    for party in (party for row in rows for party in row.parties):
        if parties.setdefault(party.name, party) != party:
            raise ValueError(f"world {rows[0].world!r} has two parties {party.name!r}")
    return replace(
        rows[0],
        parties=tuple(parties.values()),
        claims=tuple(claim for row in rows for claim in row.claims),
        controls=tuple(claim for row in rows for claim in row.controls),
        wire=any(row.wire for row in rows),
        brief=all(row.brief for row in rows),
    )


@dataclass(frozen=True)
class Scenario:
    """Rows that belong together, and the policy for their enclaves.

    ``cast`` has the enclave of each part.  ``policy`` returns the policy for the topic of the demo;
    the enclaves ``unpermitted`` have no policy.  With a ``router``, the name of an enclave,
    keystores of the scenario also have the files for Zenoh.  A scenario with ``any_keystore`` can
    also run in a user's keystore.
    """

    name: str
    title: str
    rows: tuple[Row, ...]
    cast: Mapping[str, str] = field(default_factory=dict)
    policy: Callable[[str], Policy] | None = None
    unpermitted: tuple[str, ...] = ()
    router: str = ""
    any_keystore: bool = False


def merged_scenario(scenarios: Sequence[Scenario]) -> Scenario:
    """Merge scenarios with the same enclaves and policy into one scenario with all rows.

    Raises:
        ValueError: their enclaves or policies differ.
    """
    first = scenarios[0]
    if any(
        (scenario.cast, scenario.policy) != (first.cast, first.policy) for scenario in scenarios
    ):
        raise ValueError("scenarios with different enclaves or policies cannot run together")
    return replace(first, rows=tuple(row for scenario in scenarios for row in scenario.rows))


# ── words in which scenarios are written ───────────────────────────────────────────────────


def hears(listener: str, talker: str, *, holds: bool = True) -> Claim:
    """Return the claim that a listener hears a talker, or does not hear the talker."""
    return Claim(Relation.HEARS, listener, talker, holds=holds)


def answered(client: str, server: str, *, holds: bool = True) -> Claim:
    """Return the claim that a server answers a client, or does not answer the client."""
    return Claim(Relation.IS_ANSWERED, client, server, holds=holds)


def talker_and_listener(keystore: KeystoreChoice) -> tuple[Party, Party]:
    """Return a talker and a listener that may use the topic in a keystore."""
    return (
        Party("talker", Role.TALKER, Identity(keystore, "talker")),
        Party("listener", Role.LISTENER, Identity(keystore, "listener")),
    )


def known_open(row: Row, because: str, remedy: str) -> Row:
    """Return the row of an attack that is known to succeed, with the reason and a remedy."""
    return replace(row, open_because=because, remedy=remedy)


def tries(attack: str, *rows: Row) -> tuple[Row, ...]:
    """Return the rows as attempts of ``attack``, and so also the rows that replace them."""
    return tuple(
        replace(
            row,
            attack=attack,
            variants=tuple(
                replace(
                    variant, instead=variant.instead and replace(variant.instead, attack=attack)
                )
                for variant in row.variants
            ),
        )
        for row in rows
    )


DEFAULT_TOPIC: Final = "/chatter"
DENIED_TOPIC: Final = "/sros_not_allowed"
"""A topic that no enclave of the demo may use."""

_POLICY_FILE = "talker_listener.xml"
_POLICY_TOPIC = "chatter"
_TALKER, _LISTENER = "/talker_listener/talker", "/talker_listener/listener"
_DENIED_SUFFIX = "_without_permission"
GUEST: Final = "/talker_listener/guest"
_GUEST_TOPIC: Final = "/guest_book"
SERVICE: Final = "/add_two_ints"
ACTION: Final = "/fibonacci"

_ROS_TOPIC = re.compile(r"/?[A-Za-z_][A-Za-z0-9_]*(?:/[A-Za-z_][A-Za-z0-9_]*)*\Z")
_MAX_TOPIC_LENGTH = 200
_TOPICS_OF_NODES = ("/rosout", "/parameter_events", "/clock", DENIED_TOPIC)


def check_topic(topic: str) -> str:
    """Return the absolute form of a ROS topic name for the demo.

    Raises:
        UsageError: the demo cannot use this topic.
    """
    if len(topic) > _MAX_TOPIC_LENGTH or not _ROS_TOPIC.match(topic):
        raise UsageError(
            f"{topic!r} is not a topic name that the demo can use",
            f"A name has at most {_MAX_TOPIC_LENGTH} characters. Its parts, joined by '/', consist"
            " of letters, digits and underscores, and do not start with a digit.",
            "Use a name such as /chatter or /robot/camera.",
        )
    absolute = topic if topic.startswith("/") else f"/{topic}"
    if is_name_of_demo_nodes(absolute):
        raise UsageError(
            f"the demo cannot use {absolute}",
            "Every ROS 2 node, or the demo itself, uses this topic or service.",
            "Use a name such as /chatter.",
        )
    return absolute


def is_name_of_demo_nodes(name: str) -> bool:
    """Return whether ``name`` is a topic or service of the demo's own nodes: no role can use it."""
    return name in _TOPICS_OF_NODES or bool(node_of_service(name))


def _shipped_policy(file: str) -> Policy:
    """Return a policy that ships with sros."""
    return read_policy(policies_dir() / file)


def talking_policy(topic: str) -> Policy:
    """Return the shipped policy for ``topic``, plus a talker and listener without rights to it."""
    shipped = _shipped_policy(_POLICY_FILE)
    by_path = {enclave.path: enclave for enclave in shipped.enclaves}
    talker, listener = by_path[_TALKER], by_path[_LISTENER]
    return replace(
        shipped,
        enclaves=(
            _with_topic(talker, topic),
            _with_topic(listener, topic),
            replace(_with_topic(talker, None), path=f"{_TALKER}{_DENIED_SUFFIX}"),
            replace(_with_topic(listener, None), path=f"{_LISTENER}{_DENIED_SUFFIX}"),
        ),
    )


def attacked_policy(topic: str) -> Policy:
    """Return a policy with talker, listener, a service, a guest and an admin.

    The guest may use neither the topic nor the service.  The admin may publish the topic.  The
    name of the admin's enclave contains the name of the guest's enclave.
    """
    talking = talking_policy(topic)
    talker = next(
        enclave for enclave in _shipped_policy(_POLICY_FILE).enclaves if enclave.path == _TALKER
    )
    guest = replace(_with_topic(talker, _GUEST_TOPIC), path=GUEST)
    guest_enclaves = (guest, replace(_with_topic(talker, topic), path=f"{GUEST}/admin"))
    service = _shipped_policy("add_two_ints.xml").enclaves
    allowed = tuple(
        enclave for enclave in talking.enclaves if not enclave.path.endswith(_DENIED_SUFFIX)
    )
    return replace(talking, enclaves=(*allowed, *guest_enclaves, *service))


def zenoh_policy(topic: str, *, guest_talks: bool = False, silent: str = "") -> Policy:
    """Return the policy of the demo on Zenoh: `attacked_policy` and an action.

    With ``guest_talks``, the guest may use the topic as talker and as listener; the enclave
    ``silent`` may not use the topic. The guest's node has another name than other nodes.
    """
    attacked = attacked_policy(topic)
    of = {enclave.path: enclave for enclave in attacked.enclaves}
    of[GUEST] = of[GUEST].with_profiles(lambda profile: replace(profile, node="guest"))
    if guest_talks:
        of[GUEST] = replace(of[GUEST], profiles=(*of[_TALKER].profiles, *of[_LISTENER].profiles))
    if silent:
        of[silent] = _with_topic(of[silent], None, topic)
    return replace(attacked, enclaves=(*of.values(), *shipped_action_policy(topic).enclaves))


def shipped_service_policy(_topic: str) -> Policy:
    """Return the shipped policy of a service; the topic does not matter."""
    return _shipped_policy("add_two_ints.xml")


def shipped_action_policy(_topic: str) -> Policy:
    """Return the shipped policy of an action; the topic does not matter."""
    return _shipped_policy("fibonacci.xml")


def composed_policy(topic: str) -> Policy:
    """Return the shipped policies of a container, and of the nodes that it talks to."""
    talking = talking_policy(topic)
    container = (
        _with_topic(enclave, topic) for enclave in _shipped_policy("composition.xml").enclaves
    )
    service = shipped_service_policy(topic).enclaves
    return replace(talking, enclaves=(*talking.enclaves, *container, *service))


def _with_topic(enclave: Enclave, topic: str | None, before: str = _POLICY_TOPIC) -> Enclave:
    """Return the enclave with ``topic`` in place of ``before`` (None: remove ``before``)."""

    def changed_group(group: Group) -> Group | None:
        if group.kind != "topics" or before not in group.names:
            return group
        return None if topic is None else replace(group, names=(topic,))

    def changed_profile(profile: Profile) -> Profile:
        groups = (changed_group(group) for group in profile.groups)
        return replace(profile, groups=tuple(group for group in groups if group is not None))

    return enclave.with_profiles(changed_profile)
