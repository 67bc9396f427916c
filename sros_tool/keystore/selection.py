"""The enclaves that a verb works on: named ones, those that match a pattern, those of a robot."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from shlex import quote
from typing import NamedTuple

from sros_tool.errors import KeystoreError, Note
from sros_tool.fleet.enclaves import Unrecorded, robot_of, unrecorded_enclaves
from sros_tool.keystore.fleet import checked_fleet, enclaves_of_robot, load_fleet, words_for
from sros_tool.keystore.layout import PRIVATE, SETTINGS, check_keystore, list_enclaves
from sros_tool.values import NamedKeystore, shows
from sros_tool.wording import first_few


@shows(optional=("robots",))
class EnclaveList(NamedTuple):
    """The enclaves of a keystore."""

    keystore: NamedKeystore
    enclaves: Sequence[str]
    """Their names, sorted."""
    hidden: Sequence[str]
    """Enclaves in hidden folders, which DDS loads and the verbs of sros leave out, sorted."""
    robots: Mapping[str, str] | None
    """The robots of those that belong to one, in a keystore with a fleet."""


def robots_of(root: Path, names: Sequence[str]) -> dict[str, str] | None:
    """Return the robots of the enclaves that belong to one; None without a fleet."""
    fleet = load_fleet(root)
    if fleet is None:
        return None
    owners = ((name, robot_of(fleet, name)) for name in names)
    return {name: robot.name for name, robot in owners if robot}


def select_enclaves(
    root: Path,
    names: Sequence[str],
    patterns: Sequence[str] = (),
    *,
    robots: Sequence[str] = (),
    every: bool = False,
    checked: bool = False,
) -> tuple[str, ...]:
    """Return ``names``, then the enclaves that match ``patterns``, those of ``robots``; each once.

    In a pattern ``*`` stands for any part of a name, "/" included, as in policies.  ``every`` means
    all enclaves.  The enclaves of robots are found without a list of all; with ``checked``, only if
    the fleet is what sros wrote.

    Raises:
        KeystoreError: a pattern matches no enclave, a robot has none, or ``every`` is given and
            there is none.
        DocumentError: the fleet of the keystore has no such robot; the error names near ones.
    """
    check_keystore(root)
    chosen = dict.fromkeys(names)
    patterns = ("*",) if every else patterns
    existing = list_enclaves(root) if patterns else ()
    for pattern in patterns:
        fitting = [name for name in existing if fnmatchcase(name, pattern)]
        if not fitting:
            raise KeystoreError(
                f"no enclave of keystore '{root}' matches {pattern!r}",
                "",
                f"See `sros list_enclaves {quote(str(root))}`.",
            )
        chosen |= dict.fromkeys(fitting)
    return tuple(chosen | dict.fromkeys(_of_robots(root, robots, checked, {})))


def select_to_revoke(
    root: Path, names: Sequence[str], patterns: Sequence[str], robots: Sequence[str], *, every: bool
) -> tuple[tuple[str, ...], tuple[Note, ...]]:
    """Return the enclaves to revoke, and notes on what the fleet does not record of ``robots``.

    As `select_enclaves`, but a robot also has what lies in its folder, such as ``/r3/spare``.

    Raises:
        KeystoreError: as `select_enclaves`.
        DocumentError: as `select_enclaves`.
    """
    if not (patterns or robots or every):
        return tuple(names), ()  # the verb says what is wrong with a name
    chosen = dict.fromkeys(select_enclaves(root, names, patterns, every=every))
    unrecorded: dict[str, Unrecorded] = {}
    if fleet := checked_fleet(root) if robots else None:
        unrecorded = unrecorded_enclaves(fleet, list_enclaves(root), set(robots))
    chosen |= dict.fromkeys(_of_robots(root, robots, True, unrecorded))
    below = [name for each in unrecorded.values() for name in each.below]
    left = {name for each in unrecorded.values() for name in each.naming} - chosen.keys()
    return tuple(chosen), tuple(_unrecorded_notes(root, sorted(below), sorted(left)))


def _unrecorded_notes(root: Path, below: list[str], left: list[str]) -> Iterator[Note]:
    if below:
        yield Note(
            "fleet.revoked-unrecorded",
            f"The fleet does not record {_some(below)}: revoked, too, as in the folder of a robot "
            "that you revoke.",
        )
    if left:
        yield Note(
            "fleet.unrecorded-enclaves",
            f"The fleet does not record whose {_some(left)} is: still valid, with the name of a "
            "robot that you revoke in the path. If the key was on that robot, run `sros revoke "
            f"{quote(str(root))} {words_for(root, left)}`.",
        )


def _some(names: list[str]) -> str:
    return first_few(names, _SHOWN)


def _of_robots(
    root: Path, robots: Sequence[str], checked: bool, unrecorded: Mapping[str, Unrecorded]
) -> list[str]:
    if not robots:
        return []
    fleet = checked_fleet(root) if checked else load_fleet(root)
    if fleet is None and not any((root / each).exists() for each in (PRIVATE, SETTINGS)):
        raise KeystoreError(
            f"'{root}' is no keystore with a fleet, so it has no robot {robots[0]!r}",
            "An export for a robot has the enclaves of that robot alone, and not the fleet.",
            "Leave --robot out, choose enclaves with --match, or name the keystore at home.",
        )
    if fleet is None:
        raise KeystoreError(
            f"keystore '{root}' has no fleet, so it has no robot {robots[0]!r}",
            "",
            f"Name the fleet's file with `sros generate_artifacts -k {quote(str(root))} -p "
            "POLICY_FILE --fleet FILE`, or the enclaves with --match.",
        )
    found: list[str] = []
    for name in robots:
        own = enclaves_of_robot(root, fleet, fleet.robots[name]) if name in fleet.robots else ()
        own += unrecorded[name].below if name in unrecorded else ()
        if not own:
            if left := _named_after(root, name):
                raise KeystoreError(
                    f"by its fleet, keystore '{root}' has no enclave of a robot {name}",
                    f"It has {_some(left)}: perhaps the robot left the fleet, or a group.",
                    f"Name the enclaves themselves: {words_for(root, left)}.",
                )
            fleet.robot(name)
            raise KeystoreError(
                f"the robot {name} has no enclave in keystore '{root}'",
                "",
                f"See `sros list_enclaves {quote(str(root))}`.",
            )
        found += own
    return found


_SHOWN = 5


def _named_after(root: Path, robot: str) -> list[str]:
    """Return the enclaves with the name of a robot as a part of their paths."""
    return [name for name in list_enclaves(root) if robot in name.split("/")[1:]]
