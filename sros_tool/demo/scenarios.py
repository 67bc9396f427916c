"""What the demo tries: rows of parties, and what is claimed about them, as plain data.

Every row that expects silence carries a control: another listener that must hear the very same
messages, or the same program in an enclave that is permitted.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Role(StrEnum):
    """What a process does."""

    TALKER = "talker"
    LISTENER = "listener"
    OBSERVER = "observer"


class Identity(StrEnum):
    """With which security a process runs: none, or in which enclave of which keystore."""

    NONE = "unsecured"
    TALKER = "may talk"
    LISTENER = "may listen"
    TALKER_DENIED = "may not talk"
    LISTENER_DENIED = "may not listen"
    FOREIGN_TALKER = "may talk in another keystore"
    FOREIGN_LISTENER = "may listen in another keystore"


class Status(StrEnum):
    """What was expected or observed of a row."""

    HEARD = "heard"
    NOT_HEARD = "not heard"
    REFUSED = "refused"
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


class Relation(StrEnum):
    """What can be claimed of a party, or of a party and a talker."""

    HEARS = "hears"
    IS_REFUSED = "is refused"
    STARTS = "starts"
    SEES = "sees"
    READABLE = "is readable on the wire"


STATUS_OF: dict[tuple[Relation, bool], Status] = {
    (Relation.HEARS, True): Status.HEARD,
    (Relation.HEARS, False): Status.NOT_HEARD,
    (Relation.IS_REFUSED, True): Status.REFUSED,
    (Relation.IS_REFUSED, False): Status.STARTED,
    (Relation.STARTS, True): Status.STARTED,
    (Relation.STARTS, False): Status.REFUSED,
    (Relation.SEES, True): Status.VISIBLE,
    (Relation.SEES, False): Status.NOT_VISIBLE,
    (Relation.READABLE, True): Status.READABLE,
    (Relation.READABLE, False): Status.NOT_READABLE,
}


@dataclass(frozen=True)
class Party:
    """One process of a row.  ``aside`` puts a talker on a topic of its own."""

    name: str
    role: Role
    identity: Identity
    aside: bool = False


@dataclass(frozen=True)
class Claim:
    """``subject`` hears, sees ... ``talker``, or, where not ``holds``, does not."""

    relation: Relation
    subject: str
    talker: str = ""
    holds: bool = True

    @property
    def expected(self) -> Status:
        """The status that this claim expects."""
        return STATUS_OF[self.relation, self.holds]


@dataclass(frozen=True)
class Row:
    """One line of the demo's table.

    ``mechanism`` says in a clause what brings the expected outcome about; ``wire`` asks for a
    capture of the packets.
    """

    name: str
    expected: Status
    mechanism: str
    parties: tuple[Party, ...]
    claims: tuple[Claim, ...]
    controls: tuple[Claim, ...] = ()
    wire: bool = False

    def party(self, name: str) -> Party:
        """The party of that name.  Raises `KeyError`."""
        return {party.name: party for party in self.parties}[name]


def _hears(listener: str, talker: str) -> Claim:
    return Claim(Relation.HEARS, listener, talker)


def _hears_not(listener: str, talker: str) -> Claim:
    return Claim(Relation.HEARS, listener, talker, holds=False)


_SECURED_TALKER = Party("secured talker", Role.TALKER, Identity.TALKER)
_SECURED_LISTENER = Party("secured listener", Role.LISTENER, Identity.LISTENER)
_OPEN_TALKER = Party("unsecured talker", Role.TALKER, Identity.NONE)
_OPEN_LISTENER = Party("unsecured listener", Role.LISTENER, Identity.NONE)
_DENIED_TALKER = Party("talker without permission", Role.TALKER, Identity.TALKER_DENIED)
_DENIED_LISTENER = Party("listener without permission", Role.LISTENER, Identity.LISTENER_DENIED)
_FOREIGN_TALKER = Party("foreign talker", Role.TALKER, Identity.FOREIGN_TALKER)
_FOREIGN_LISTENER = Party("foreign listener", Role.LISTENER, Identity.FOREIGN_LISTENER)
_OPEN_TALKER_ASIDE = Party("unsecured talker aside", Role.TALKER, Identity.NONE, aside=True)
_OBSERVER = Party("observer", Role.OBSERVER, Identity.NONE)

ROWS: tuple[Row, ...] = (
    Row(
        "secured talker to secured listener",
        Status.HEARD,
        "each proves its identity by a certificate of the same CA, and has the permission",
        (_SECURED_TALKER, _SECURED_LISTENER),
        (_hears("secured listener", "secured talker"),),
    ),
    Row(
        "unsecured talker to unsecured listener",
        Status.HEARD,
        "no security on either side: the control of all rows below",
        (_OPEN_TALKER, _OPEN_LISTENER),
        (_hears("unsecured listener", "unsecured talker"),),
    ),
    Row(
        "secured talker to unsecured listener",
        Status.NOT_HEARD,
        "a listener that cannot authenticate gets no keys, and is sent nothing",
        (_SECURED_TALKER, _OPEN_LISTENER, _SECURED_LISTENER),
        (_hears_not("unsecured listener", "secured talker"),),
        (_hears("secured listener", "secured talker"),),
    ),
    Row(
        "unsecured talker to secured listener",
        Status.NOT_HEARD,
        "a listener in a closed domain ignores a talker that cannot authenticate",
        (_OPEN_TALKER, _SECURED_LISTENER, _OPEN_LISTENER),
        (_hears_not("secured listener", "unsecured talker"),),
        (_hears("unsecured listener", "unsecured talker"),),
    ),
    Row(
        "secured listener without permission",
        Status.REFUSED,
        "its own DDS refuses the reader: the signed permissions do not allow the topic",
        (_DENIED_LISTENER, _SECURED_LISTENER),
        (Claim(Relation.IS_REFUSED, "listener without permission"),),
        (Claim(Relation.STARTS, "secured listener"),),
    ),
    Row(
        "secured talker without permission",
        Status.REFUSED,
        "its own DDS refuses the writer: the signed permissions do not allow the topic",
        (_DENIED_TALKER, _SECURED_TALKER),
        (Claim(Relation.IS_REFUSED, "talker without permission"),),
        (Claim(Relation.STARTS, "secured talker"),),
    ),
    Row(
        "talker of another keystore to secured listener",
        Status.NOT_HEARD,
        "a certificate of another CA proves nothing here: no handshake, no keys",
        (_FOREIGN_TALKER, _SECURED_LISTENER, _FOREIGN_LISTENER),
        (_hears_not("secured listener", "foreign talker"),),
        (_hears("foreign listener", "foreign talker"),),
    ),
    Row(
        "both pairs side by side on one topic",
        Status.UNDISTURBED,
        "each pair hears its own talker, and nothing of the other one",
        (_SECURED_TALKER, _SECURED_LISTENER, _OPEN_TALKER, _OPEN_LISTENER),
        (
            _hears("secured listener", "secured talker"),
            _hears("unsecured listener", "unsecured talker"),
            _hears_not("secured listener", "unsecured talker"),
            _hears_not("unsecured listener", "secured talker"),
        ),
    ),
    Row(
        "secured talker in an unsecured node's view",
        Status.NOT_VISIBLE,
        "discovery of endpoints is encrypted: it counts no publisher of the secured topic",
        (_SECURED_TALKER, _OPEN_TALKER_ASIDE, _OBSERVER),
        (Claim(Relation.SEES, "observer", "secured talker", holds=False),),
        (Claim(Relation.SEES, "observer", "unsecured talker aside"),),
    ),
    Row(
        "unsecured payload on the wire",
        Status.READABLE,
        "the text lies open in the packets",
        (_OPEN_TALKER, _OPEN_LISTENER),
        (Claim(Relation.READABLE, "unsecured talker"),),
        (_hears("unsecured listener", "unsecured talker"),),
        wire=True,
    ),
    Row(
        "secured payload on the wire",
        Status.NOT_READABLE,
        "every packet with data is encrypted",
        (_SECURED_TALKER, _SECURED_LISTENER),
        (Claim(Relation.READABLE, "secured talker", holds=False),),
        (_hears("secured listener", "secured talker"),),
        wire=True,
    ),
)
