"""The kinds of attacks: to publish, subscribe, discover endpoints, call, or pose as a server.

Each function returns a row with the party "attacker".  The victims, and the controls unless noted,
have enclaves in the keystore ``victims``.  ``attack`` names the attack, and ``removed`` the defence
that the row leaves out ("": none).
"""

from __future__ import annotations

from sros_tool.demo.scenarios.model import (
    OWN,
    Claim,
    Condition,
    Identity,
    KeystoreChoice,
    Party,
    Relation,
    Role,
    Row,
    RowStatus,
    Variant,
)
from sros_tool.demo.scenarios.policies import SERVICE

_ATTACKER = "attacker"

_LET_IN = (
    "the template admits unauthenticated participants, and does not protect the topic",
    "remove allow_unauthenticated_participants from the template, and encrypt the topic",
)
_UNCONTROLLED = (
    "the template does not control access to this topic",
    "keep read_access_control and write_access_control on",
)


def open_to(success: RowStatus, expected: RowStatus) -> tuple[Variant, ...]:
    """Return variants that expect ``success`` with templates that do not stop the attack."""
    if expected is RowStatus.REFUSED:
        return (Variant((Condition.UNCONTROLLED,), success, *_UNCONTROLLED),)
    if expected is success or expected is RowStatus.NOT_LET_IN:
        return ()
    return (Variant((Condition.UNAUTHENTICATED,), success, *_LET_IN),)


def injection(
    name: str,
    attacker: Identity,
    expected: RowStatus,
    mechanism: str,
    *,
    attack: str,
    removed: str = "",
    victims: KeystoreChoice = OWN,
    variants: tuple[Variant, ...] = (),
    open_because: str = "",
    remedy: str = "",
    tampered: bool = False,
) -> Row:
    """Return a row that shows whether the attacker is heard on the topic.

    With ``tampered``, the files of the listener were changed: it may fail to start, and the control
    is another listener with unchanged files.  Otherwise, the control is a permitted talker; a row
    with ``removed`` has no control.
    """
    listener = Party("listener", Role.LISTENER, Identity(victims, "listener"), intruder=tampered)
    parties = [Party(_ATTACKER, Role.TALKER, attacker, intruder=True), listener]
    controls: list[Claim] = []
    if tampered:
        parties += [
            Party("untouched listener", Role.LISTENER, Identity(OWN, "listener")),
            Party("talker", Role.TALKER, Identity(OWN, "talker")),
        ]
        controls.append(Claim(Relation.HEARS, "untouched listener", "talker"))
    elif not removed:
        parties.append(Party("talker", Role.TALKER, Identity(victims, "talker")))
        controls.append(Claim(Relation.HEARS, "listener", "talker"))
    return Row(
        name,
        expected,
        mechanism,
        tuple(parties),
        (Claim(Relation.HEARS, "listener", _ATTACKER).expecting(expected),),
        tuple(controls),
        brief=True,
        variants=(*variants, *open_to(RowStatus.HEARD, expected)),
        attack=attack,
        removed=removed,
        open_because=open_because,
        remedy=remedy,
    )


def succeeds(
    name: str, attacker: Identity, *, attack: str, removed: str, victims: KeystoreChoice
) -> Row:
    """Return a row in which the same attacker is heard, because its files are valid."""
    mechanism = "an attacker with valid files is heard"
    return injection(
        name, attacker, RowStatus.HEARD, mechanism, attack=attack, removed=removed, victims=victims
    )


def listening(
    name: str,
    attacker: Identity,
    expected: RowStatus,
    mechanism: str,
    *,
    attack: str,
    removed: str = "",
    victims: KeystoreChoice = OWN,
    variants: tuple[Variant, ...] = (),
) -> Row:
    """Return a row that shows whether the attacker hears the topic."""
    return Row(
        name,
        expected,
        mechanism,
        (
            Party(_ATTACKER, Role.LISTENER, attacker, intruder=True),
            Party("talker", Role.TALKER, Identity(victims, "talker")),
            Party("listener", Role.LISTENER, Identity(victims, "listener")),
        ),
        (Claim(Relation.HEARS, _ATTACKER, "talker").expecting(expected),),
        (Claim(Relation.HEARS, "listener", "talker"),),
        brief=True,
        variants=(*variants, *open_to(RowStatus.HEARD, expected)),
        attack=attack,
        removed=removed,
    )


def discovering(
    name: str,
    attacker: Identity,
    expected: RowStatus,
    mechanism: str,
    *,
    attack: str,
    removed: str = "",
    victims: KeystoreChoice = OWN,
    variants: tuple[Variant, ...] = (),
    open_because: str = "",
    remedy: str = "",
) -> Row:
    """Return a row that shows whether the attacker discovers a publisher of the topic.

    The control is that an unsecured attacker discovers another publisher, or if a secured one has
    to fail, that an enclave which may listen discovers this one.
    """
    others: tuple[Party, ...] = ()
    controls: tuple[Claim, ...] = ()
    if attacker.keystore is None:
        others = (Party("unsecured talker", Role.TALKER, other_topic=True),)
        controls = (Claim(Relation.SEES, _ATTACKER, "unsecured talker"),)
    elif expected is not RowStatus.VISIBLE:
        others = (Party("looking listener", Role.OBSERVER, Identity(OWN, "listener")),)
        controls = (Claim(Relation.SEES, "looking listener", "talker"),)
    return Row(
        name,
        expected,
        mechanism,
        (
            Party(_ATTACKER, Role.OBSERVER, attacker, intruder=True),
            Party("talker", Role.TALKER, Identity(victims, "talker")),
            *others,
        ),
        (Claim(Relation.SEES, _ATTACKER, "talker").expecting(expected),),
        controls,
        brief=True,
        variants=variants,
        attack=attack,
        removed=removed,
        open_because=open_because,
        remedy=remedy,
    )


def calling(
    name: str,
    attacker: Identity,
    expected: RowStatus,
    mechanism: str,
    *,
    attack: str,
    removed: str = "",
    victims: KeystoreChoice = OWN,
) -> Row:
    """Return a row that shows whether the attacker gets answers from a service."""
    return Row(
        name,
        expected,
        mechanism,
        (
            Party(_ATTACKER, Role.CLIENT, attacker, SERVICE, intruder=True),
            Party("server", Role.SERVER, Identity(victims, "server"), SERVICE),
            Party("client", Role.CLIENT, Identity(victims, "client"), SERVICE),
        ),
        (Claim(Relation.IS_ANSWERED, _ATTACKER, "server").expecting(expected),),
        (Claim(Relation.IS_ANSWERED, "client", "server"),),
        brief=True,
        variants=() if removed else open_to(RowStatus.ANSWERED, expected),
        attack=attack,
        removed=removed,
    )


def posing_as_server(
    name: str,
    attacker: Identity,
    expected: RowStatus,
    mechanism: str,
    *,
    attack: str,
    removed: str = "",
    victims: KeystoreChoice = OWN,
) -> Row:
    """Return a row that shows whether a client accepts answers from an attacker as server."""
    rightful = Party("server", Role.SERVER, Identity(victims, "server"), SERVICE)
    return Row(
        name,
        expected,
        mechanism,
        (
            Party(_ATTACKER, Role.SERVER, attacker, SERVICE, intruder=True),
            Party("client", Role.CLIENT, Identity(victims, "client"), SERVICE),
            *(() if removed else (rightful,)),
        ),
        (Claim(Relation.IS_ANSWERED, "client", _ATTACKER).expecting(expected),),
        () if removed else (Claim(Relation.IS_ANSWERED, "client", "server"),),
        brief=True,
        variants=() if removed else open_to(RowStatus.ANSWERED, expected),
        attack=attack,
        removed=removed,
    )
