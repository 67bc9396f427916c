"""Attacks on the files and environment variables with which a process starts."""

from __future__ import annotations

from sros_tool.demo import forger
from sros_tool.demo.forger import Undefended
from sros_tool.demo.scenarios.attacks.kinds import open_to
from sros_tool.demo.scenarios.model import (
    OWN,
    Claim,
    Identity,
    Party,
    Relation,
    Role,
    Row,
    RowStatus,
)

_ENABLE, _STRATEGY = "ROS_SECURITY_ENABLE", "ROS_SECURITY_STRATEGY"
_PERMISSIVE = (_STRATEGY, "Permissive")


def _misconfigured(
    name: str,
    identity: Identity,
    expected: RowStatus,
    mechanism: str,
    *,
    attack: str,
    removed: str = "",
    open_because: str = "",
    remedy: str = "",
) -> Row:
    """Return a row that shows whether a misconfigured talker is heard by an unsecured listener."""
    parties = (
        Party("misconfigured talker", Role.TALKER, identity, intruder=True),
        Party("unsecured listener", Role.LISTENER),
        Party("unsecured talker", Role.TALKER),
    )
    claim = Claim(Relation.HEARS, "unsecured listener", "misconfigured talker").expecting(expected)
    return Row(
        name,
        expected,
        mechanism,
        parties,
        (claim,),
        (Claim(Relation.HEARS, "unsecured listener", "unsecured talker"),),
        brief=True,
        variants=open_to(RowStatus.HEARD, expected),
        attack=attack,
        removed=removed,
        open_because=open_because,
        remedy=remedy,
    )


ROWS: tuple[Row, ...] = (
    _misconfigured(
        "a file of the enclave missing, Enforce",
        Identity(forger.missing_permissions, "talker"),
        RowStatus.NOT_LET_IN,
        "with Enforce, a node does not start if a file of its enclave is missing",
        attack="a file of the enclave missing",
    ),
    _misconfigured(
        "a file of the enclave missing, Permissive",
        Identity(Undefended(forger.missing_permissions), "talker", (_PERMISSIVE,)),
        RowStatus.HEARD,
        "with Permissive, the talker runs unsecured, and everybody hears it",
        attack="a file of the enclave missing",
        removed="ROS_SECURITY_STRATEGY=Enforce",
    ),
    _misconfigured(
        "variables spelt right",
        Identity(OWN, "talker"),
        RowStatus.NOT_HEARD,
        "the talker runs secured, and sends nothing to unsecured nodes",
        attack="misspelt security variables",
    ),
    *(
        _misconfigured(
            f"{variable}={value}{' and a file missing' if variable == _STRATEGY else ''}",
            Identity(
                forger.missing_permissions if variable == _STRATEGY else OWN,
                "talker",
                ((variable, value),),
            ),
            RowStatus.HEARD,
            mechanism,
            attack="misspelt security variables",
            open_because="rcl ignores every other spelling, and the node does not warn",
            remedy="start nodes with `sros run`, which sets the variables; `sros doctor` finds"
            " misspelt ones",
        )
        for variable, value, mechanism in (
            (
                _ENABLE,
                "True",
                "every value but 'true' switches security off: the talker runs unsecured",
            ),
            (
                _STRATEGY,
                "enforce",
                "every value but 'Enforce' means Permissive: the talker runs unsecured",
            ),
        )
    ),
)
