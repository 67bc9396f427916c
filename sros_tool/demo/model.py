"""What a demo is made of, as plain data: parties, claims about them, rows, scenarios.

A row is one line of the table: processes that start together, what is claimed of them, and the
controls that make a silence believable.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum

from sros_tool.policy import Policy


class Role(StrEnum):
    """What a process does."""

    TALKER = "talker"
    LISTENER = "listener"
    OBSERVER = "observer"
    SERVER = "server"
    CLIENT = "client"
    ACTION_SERVER = "action_server"
    ACTION_CLIENT = "action_client"
    COMPOSED = "composed"
    """Several nodes in one process and one enclave: a talker, a listener and a server."""


SPEAKING = frozenset({Role.TALKER, Role.SERVER, Role.ACTION_SERVER, Role.COMPOSED})
"""The roles that send something by which they are recognised."""


class Status(StrEnum):
    """What was expected or observed of a row."""

    HEARD = "heard"
    NOT_HEARD = "not heard"
    HEARD_AGAIN = "heard again"
    NOT_HEARD_AGAIN = "not heard again"
    DECEIVED = "deceived"
    NOT_DECEIVED = "not deceived"
    ANSWERED = "answered"
    NOT_ANSWERED = "not answered"
    REFUSED = "refused"
    NOT_LET_IN = "not let in"
    STARTED = "started"
    UNDISTURBED = "undisturbed"
    DISTURBED = "disturbed"
    VISIBLE = "visible"
    NOT_VISIBLE = "not visible"
    READABLE = "readable"
    NOT_READABLE = "not readable"
    CRASHED = "crashed"
    NOT_STARTED = "not started"
    UNDECIDED = "undecided"
    SKIPPED = "skipped"


DENIALS = (Status.REFUSED, Status.NOT_LET_IN)
"""Security says no to a topic, or already to the whole process."""


class Relation(StrEnum):
    """What can be claimed of a party, or of a party and another one."""

    HEARS = "hears"
    HEARS_AGAIN = "hears replayed packets of"
    BELIEVES = "believes changed packets of"
    IS_ANSWERED = "is answered by"
    IS_REFUSED = "is refused"
    STARTS = "starts"
    SEES = "sees"
    READABLE = "is readable on the wire"


STATUS_OF: dict[tuple[Relation, bool], Status] = {
    (Relation.HEARS, True): Status.HEARD,
    (Relation.HEARS, False): Status.NOT_HEARD,
    (Relation.HEARS_AGAIN, True): Status.HEARD_AGAIN,
    (Relation.HEARS_AGAIN, False): Status.NOT_HEARD_AGAIN,
    (Relation.BELIEVES, True): Status.DECEIVED,
    (Relation.BELIEVES, False): Status.NOT_DECEIVED,
    (Relation.IS_ANSWERED, True): Status.ANSWERED,
    (Relation.IS_ANSWERED, False): Status.NOT_ANSWERED,
    (Relation.IS_REFUSED, True): Status.REFUSED,
    (Relation.IS_REFUSED, False): Status.STARTED,
    (Relation.STARTS, True): Status.STARTED,
    (Relation.STARTS, False): Status.REFUSED,
    (Relation.SEES, True): Status.VISIBLE,
    (Relation.SEES, False): Status.NOT_VISIBLE,
    (Relation.READABLE, True): Status.READABLE,
    (Relation.READABLE, False): Status.NOT_READABLE,
}


class Wire(StrEnum):
    """What is looked for in the packets of a party."""

    TEXT = "text"
    TOPIC = "topic name"
    CERTIFICATE = "certificate"


@dataclass(frozen=True)
class Identity:
    """With which security a process runs.

    ``keystore`` is the label of a keystore of the scenery ("" for none), ``enclave`` a part of its
    cast ("talker") or the name of an enclave ("/arm/camera").  ``variables`` replace those of a
    secured process.
    """

    keystore: str = ""
    enclave: str = ""
    variables: tuple[tuple[str, str], ...] = ()


UNSECURED = Identity()
OWN, FOREIGN = "own", "foreign"


@dataclass(frozen=True)
class Party:
    """One process of a row.

    ``topic`` is what it speaks on: "" is the topic of the demo, another name a topic, service or
    action of its own.  ``aside`` puts a talker on a topic that nobody else uses.  An ``intruder``
    may be kept out without ending the row.
    """

    name: str
    role: Role
    identity: Identity = UNSECURED
    topic: str = ""
    aside: bool = False
    intruder: bool = False


@dataclass(frozen=True)
class Claim:
    """``subject`` hears, sees ... ``talker``, or, where not ``holds``, does not.

    ``denied`` is the denial by which it must already end, if any: a status of `DENIALS`.
    """

    relation: Relation
    subject: str
    talker: str = ""
    holds: bool = True
    denied: Status | None = None
    wire: Wire = Wire.TEXT

    @property
    def expected(self) -> Status:
        """The status that this claim expects."""
        return self.denied or STATUS_OF[self.relation, self.holds]

    def expecting(self, status: Status) -> Claim:
        """The same claim, with another outcome.  Raises `ValueError` if it cannot have that."""
        if status in DENIALS:
            return replace(self, holds=False, denied=status)
        for holds in (True, False):
            if STATUS_OF[self.relation, holds] is status:
                return replace(self, holds=holds, denied=None)
        raise ValueError(f"{self.relation} does not end as {status}")


class Condition(StrEnum):
    """What of a keystore's template or of a vendor decides how a row ends."""

    ONE_CA = "one CA for identity and permissions"
    SHARED_SUBJECTS = "subjects without a part of their own"
    OPEN_DEFAULT = "an enclave without a policy may do everything"
    IN_CLEAR = "payload is not encrypted"
    STRANGERS = "unauthenticated participants are allowed, and the topic is not protected"
    STRANGERS_SEE = "unauthenticated participants are allowed, and discovery is not protected"
    UNCONTROLLED = "access to the topic is not controlled"
    OPEN_JOIN = "joining the domain is not controlled"
    CYCLONE = "Cyclone DDS 0.10"
    FAST = "Fast DDS"
    EXACT_SIGNER = "only who is in the file of the permissions CA may sign (Fast DDS since 2.10)"


@dataclass(frozen=True)
class Case:
    """Where all ``conditions`` hold, a row ends as ``expected``.

    ``open_because`` says why that lets an attack through ("": it does not), ``remedy`` what a user
    can do then.  ``instead`` is another row that is played in place of it, for defences that a
    vendor has in another form.
    """

    conditions: tuple[Condition, ...]
    expected: Status
    open_because: str = ""
    remedy: str = ""
    mechanism: str = ""
    instead: Row | None = None


@dataclass(frozen=True)
class Row:
    """One line of the demo's table.

    ``mechanism`` says in a clause what brings the expected outcome about; ``wire`` asks for a
    capture of the packets; ``replay`` names the party whose packets are sent again after it has
    left, ``forge`` the one in whose name changed packets are sent.  A ``brief`` row ends as soon
    as it is decided.  The first of ``cases`` that fits replaces the outcome.  ``attack`` names the
    attack to which the row belongs; with ``removed`` it shows that attack without the defence that
    ``removed`` names.  ``open_because`` and ``remedy`` are as in `Case`.
    """

    name: str
    expected: Status
    mechanism: str
    parties: tuple[Party, ...]
    claims: tuple[Claim, ...]
    controls: tuple[Claim, ...] = ()
    wire: bool = False
    replay: str = ""
    forge: str = ""
    brief: bool = False
    cases: tuple[Case, ...] = ()
    attack: str = ""
    removed: str = ""
    open_because: str = ""
    remedy: str = ""

    @property
    def tapped(self) -> bool:
        """Whether its packets are looked at."""
        return bool(self.wire or self.replay or self.forge)

    def party(self, name: str) -> Party:
        """The party of that name.  Raises `KeyError`."""
        return {party.name: party for party in self.parties}[name]

    @property
    def place(self) -> str:
        """The ROS name that its claim is about: "" is the topic of the demo."""
        return self.party(self.claims[0].subject).topic

    def under(self, conditions: frozenset[Condition]) -> Row:
        """The row as it must end where those conditions hold."""
        for case in self.cases:
            if conditions.issuperset(case.conditions):
                if case.instead is not None:
                    return case.instead.under(conditions)
                claims = tuple(
                    claim.expecting(case.expected) if place == 0 else claim
                    for place, claim in enumerate(self.claims)
                )
                return replace(
                    self,
                    expected=case.expected,
                    claims=claims,
                    open_because=case.open_because,
                    remedy=case.remedy or self.remedy,
                    mechanism=case.mechanism or self.mechanism,
                    cases=(),
                )
        return self


@dataclass(frozen=True)
class Scenario:
    """Rows that belong together, and the policy that their enclaves live by.

    ``cast`` gives the enclave of each part.  ``policy`` makes the policy for the topic of the
    demo.  ``measured`` names the protection kinds whose cost is measured; one with
    ``any_keystore`` can be played in a keystore of the user's.
    """

    name: str
    title: str
    rows: tuple[Row, ...]
    cast: Mapping[str, str] = field(default_factory=dict)
    policy: Callable[[str], Policy] | None = None
    unpermitted: tuple[str, ...] = ()
    measured: tuple[str, ...] = ()
    any_keystore: bool = False
