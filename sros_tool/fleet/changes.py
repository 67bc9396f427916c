"""Changes of a fleet's settings that the rights of its enclaves do not show.

They decide where keys and messages go, and who may request renewal.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from datetime import timedelta
from typing import NamedTuple

from sros_tool.errors import Note
from sros_tool.fleet.robots import RENEWAL_ALLOWED, Fleet, Robot, router_enclave_of
from sros_tool.validity import parse_duration
from sros_tool.wording import first_few

_MOST_SHOWN = 5


class FleetChange(NamedTuple):
    """A changed setting: ``name`` is the robot or the key of the fleet file, ``text`` a clause."""

    name: str
    text: str
    is_access: bool = True


def fleet_changes(
    before: Fleet | None, after: Fleet, known_paths: Collection[str] = ()
) -> Iterator[FleetChange]:
    """Yield changes of settings that are new access, and renewal that becomes tighter.

    ``known_paths`` are enclave paths with placeholders in the policies for ``before``.
    """
    robots = before.robots if before else {}
    for name, robot in after.robots.items():
        old = robots.get(name)
        if old and delivery_place(old) != delivery_place(robot):
            yield FleetChange(name, f"gets its keys at another address: {delivery_place(robot)}")
        if robot.router and robot.router != (old.router if old else ""):
            path = router_enclave_of(after, robot)
            text = f"has its router at another address: {robot.router} ({path})"
            yield FleetChange(name, text)
    has_routers = any(robot.router for robot in after.robots.values())
    if before and has_routers and before.routers != after.routers:
        yield FleetChange("routers", f"makes other enclaves the routers of robots: {after.routers}")
    known = {*(before.enclaves if before else ()), *known_paths, after.routers}
    for path in after.enclaves:
        if path not in known:
            text = f"has the new path {path}, and robots get the keys of enclaves with such a path"
            yield FleetChange("enclaves", text)
    yield from _renewal_changes(before, after)


def renewal_notes(before: Fleet | None, after: Fleet | None) -> Iterator[Note]:
    """Yield a note for each kind of change of the robots' renewal; none without both fleets."""
    robots: dict[str, list[str]] = {}
    for change in _renewal_changes(before, after) if before and after else ():
        robots.setdefault(change.text, []).append(change.name)
    for text, names in robots.items():
        yield Note("fleet.renewal", f"{first_few(names, _MOST_SHOWN)} {text}.")


def _renewal_changes(before: Fleet | None, after: Fleet) -> Iterator[FleetChange]:
    for name, new in after.robots.items():
        old = (before.robots if before else {}).get(name, Robot(name, new.namespace))
        was_allowed, is_allowed = (robot.renewal == RENEWAL_ALLOWED for robot in (old, new))
        if was_allowed != is_allowed:
            text = "may now request" if is_allowed else "may no longer request"
            text += f" renewal (renewal: {old.renewal or 'refused'} -> {new.renewal or 'refused'})"
            yield FleetChange(name, text, is_allowed)
        if _grace(old) != _grace(new):
            longer = _grace(new) > _grace(old)
            text = f"can request renewal for a {'longer' if longer else 'shorter'} time after "
            text += f"the expiry of a certificate (renewal_grace: {old.renewal_grace or 'none'} -> "
            yield FleetChange(name, f"{text}{new.renewal_grace or 'none'})", longer)


def _grace(robot: Robot) -> timedelta:
    return parse_duration(robot.renewal_grace) if robot.renewal_grace else timedelta()


def delivery_place(robot: Robot) -> str:
    """Return the place to which a robot's keys are delivered, as text.

    This is ``user@address``, only the address, or "its name" if the robot has no address.
    """
    return f"{robot.user}@{robot.address}" if robot.user else robot.address or "its name"
