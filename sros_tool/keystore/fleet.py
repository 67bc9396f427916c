"""The fleet that a keystore records: its robots, their enclaves, and their ROS domains.

The ledger has the SHA-256 of the fleet file that sros wrote last, so that edits are noticed.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from shlex import quote
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

from sros_tool.dds.domains import DomainSet
from sros_tool.errors import KeystoreError, Note, SrosError
from sros_tool.fleet.robots import (
    Fleet,
    Robot,
    enclaves_of,
    former_robot_of,
    robot_of,
    router_enclave_of,
    size_problem,
    unrecorded_enclaves,
)
from sros_tool.keystore.layout import FLEET, FLEET_ROOT, remedy_in_closed_robot
from sros_tool.keystore.ledger import LEDGER_REMEDY, LEFT, Entry, Ledger
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.pki.certificates import subject_text, validity_of
from sros_tool.pki.crl import SUPERSEDED
from sros_tool.policy.placeholders import has_placeholder
from sros_tool.validity import iso
from sros_tool.wording import first_few

if TYPE_CHECKING:
    from sros_tool.keystore.transaction import Transaction
    from sros_tool.zenoh.configuration import ZenohNetwork

_FLEET_COMMENT = """\
# The robots of this keystore; sros wrote them from a fleet file, and knows by them which enclave
# belongs to which robot. To change them, edit that file and run `sros generate_artifacts --fleet`.
"""
FLEET_REMEDY = (
    "Take revoked robots out of the fleet file, and write the keystore's copy again from it, with "
    "all policies of the fleet: `sros generate_artifacts -k KEYSTORE -p POLICY_FILE --fleet "
    "FLEET_FILE`."
)
_DAMAGED_LEDGER = "the ledger has lines that are missing or were changed"
_MOST_SHOWN = 5


def load_fleet(keystore: OpenedKeystore) -> Fleet | None:
    """Return the fleet of a keystore; None if the keystore has no fleet.

    Raises:
        DocumentError: the fleet file cannot be read, or is not a fleet.
    """

    def read() -> Fleet | None:
        data = _read_fleet_file(keystore)
        return None if data is None else _parse_fleet_file(keystore.root, data)

    return keystore.once("fleet", read)


def stated_distributions(keystore: OpenedKeystore, enclave: str) -> tuple[str, ...]:
    """Return the ROS 2 distributions of an enclave; () if none are stated.

    The fleet file can state the distribution of the enclave's robot.  If it does not, the
    distributions in the keystore's settings apply.

    Raises:
        SrosError: the fleet or the settings cannot be read.
    """
    fleet = load_fleet(keystore)
    robot = robot_of(fleet, enclave) if fleet else None
    if robot and robot.distribution:
        return (robot.distribution,)
    return keystore.template.distributions


def enclaves_of_several_distributions(keystore: OpenedKeystore) -> dict[tuple[str, ...], list[str]]:
    """Map tuples of several ROS 2 distributions to the enclaves that are for all of them.

    Enclaves whose settings or fleet cannot be read are left out; another finding reports them.
    """
    enclaves: dict[tuple[str, ...], list[str]] = {}
    for name in keystore.names:
        with suppress(SrosError):
            if len(stated := stated_distributions(keystore, name)) > 1:
                enclaves.setdefault(stated, []).append(name)
    return enclaves


def checked_fleet(
    keystore: OpenedKeystore, advice_without_fleet: Callable[[], str] = str
) -> Fleet | None:
    """Return the fleet, or None, as `load_fleet` does, after checking that nobody edited its file.

    Verbs that issue or send files by the fleet use this function.  ``advice_without_fleet`` returns
    the beginning of the error's remedy: sentences on how to go on without the fleet.

    Raises:
        KeystoreError: the fleet file is not the file that sros wrote last.
    """
    if problem := fleet_edits_clause(keystore, keystore.ledger_with("what", "fleet")):
        raise KeystoreError(
            f"'{keystore.root / FLEET}' {problem}",
            "It decides which enclaves belong to a robot, and which domains they may join.",
            advice_without_fleet() + fleet_edits_remedy(keystore.root, problem),
        )
    return load_fleet(keystore)


def fleet_before_change(keystore: OpenedKeystore) -> Fleet | None:
    """Return the fleet as `load_fleet` does, or None if an edit made its file unreadable.

    Raises:
        DocumentError: the fleet file cannot be read, although nobody edited it.
    """
    try:
        return load_fleet(keystore)
    except SrosError:
        if fleet_edits_clause(keystore, keystore.ledger_with("what", "fleet")):
            return None
        raise


def fleet_edits_clause(keystore: OpenedKeystore, ledger: Ledger) -> str:
    """Return a clause on manual edits of the fleet file; "" if there are none."""
    return _edit_text(ledger, _read_fleet_file(keystore))


def is_of_damaged_ledger(clause: str) -> bool:
    """Return whether the cause of a clause of `fleet_edits_clause` is a damaged ledger."""
    return clause.endswith(_DAMAGED_LEDGER)


def fleet_edits_remedy(root: Path, clause: str) -> str:
    """Return what to do about a clause of `fleet_edits_clause`."""
    remedy = FLEET_REMEDY
    if is_of_damaged_ledger(clause):
        remedy = LEDGER_REMEDY.replace("POLICY_FILE", "POLICY_FILE --fleet FLEET_FILE")
    return remedy.replace("KEYSTORE", quote(str(root)))


def _edit_text(ledger: Ledger, data: bytes | None) -> str:
    # Only certain entries count, because others may have been added by somebody else.
    last = next((entry for entry in reversed(ledger.certain) if entry.what == "fleet"), None)
    if last is None and any(entry.what == "fleet" for entry in ledger.entries):
        state = "is missing" if data is None else "is perhaps not the file that sros wrote"
        why = _DAMAGED_LEDGER if ledger.gaps else "the ledger had missing or changed lines"
        return f"{state}: {why}"
    if last is None:
        return "" if data is None else "was not written by sros"
    if data is None:
        return f"is missing, although sros wrote it at {last.time}"
    is_unedited = hashlib.sha256(data).hexdigest() == last.sha256
    return "" if is_unedited else f"is not the file that sros wrote at {last.time}"


def _read_fleet_file(keystore: OpenedKeystore) -> bytes | None:
    path = keystore.root / FLEET
    if not os.path.lexists(path):
        return None
    from sros_tool.fleet.fleet_file import MAX_BYTES  # most keystores have no fleet

    return keystore.files.read(path, "fleet file", max_bytes=MAX_BYTES)


def _parse_fleet_file(root: Path, data: bytes) -> Fleet:
    from sros_tool.fleet.fleet_file import parse_fleet  # most keystores have no fleet

    return parse_fleet(data, f"the fleet file '{root / FLEET}'")


def recorded_fleet(keystore: OpenedKeystore) -> Fleet:
    """Return the fleet of a keystore, which has to have one.

    Raises:
        KeystoreError: the folder is not a keystore, or the keystore has no fleet.
        DocumentError: the fleet file cannot be read, or is not a fleet.
    """
    keystore.check()
    fleet = load_fleet(keystore)
    if fleet is None:
        raise KeystoreError(
            f"keystore '{keystore.root}' has no fleet",
            "",
            f"Name its robots with `sros generate_artifacts -k {quote(str(keystore.root))} -p "
            "POLICY_FILE --fleet FLEET_FILE`.",
        )
    return fleet


def enclaves_of_robot(keystore: OpenedKeystore, fleet: Fleet, robot: Robot) -> tuple[str, ...]:
    """Return the names of the robot's enclaves that exist in the keystore, sorted."""
    return tuple(name for name in enclaves_of(fleet, robot) if keystore.has_enclave(name))


def publish_command(root: Path) -> str:
    """Return the command that gives new files to robots that fetch; "" if nothing is published."""
    return f"`sros fleet publish {quote(str(root))} PUB`" if (root / FLEET_ROOT).exists() else ""


def unrecorded_notes(
    keystore: OpenedKeystore, fleet: Fleet | None, names: Collection[str]
) -> Iterator[Note]:
    """Yield a note for each robot whose folder has enclaves that the fleet does not record.

    Neither ``--robot`` nor the robot's release includes these enclaves.
    """
    robots = fleet.robots if fleet else {}
    found = unrecorded_enclaves(fleet, names, robots.keys()) if fleet else {}
    for robot, (below, _) in found.items():
        if below:
            belong, them = ("belong", "them") if len(below) > 1 else ("belongs", "it")
            yield Note(
                "fleet.unrecorded",
                f"{first_few(below, _MOST_SHOWN)} {belong} to no robot, because no policy of the "
                f"fleet has a path with {{robot}} for {them}. `--robot {robot}` does not select "
                "such an enclave, no release includes it, and an agent removes it. To make it an "
                "enclave of the robot, run `sros generate_artifacts -k "
                f"{quote(str(keystore.root))} -p POLICY --fleet FILE --robot {robot}` with a "
                f"policy that has {{robot}} in the path.",
            )


def deliver_first_sentence(root: Path) -> str:
    """Return a sentence on how to deliver new files to robots before restarting processes."""
    published = publish_command(root)
    before = f"For robots that fetch, first publish the files: {published}. " if published else ""
    text = "If processes run from an export, first export the enclaves again."
    return f"{before}{remedy_in_closed_robot(root, text)}"


class EnclaveDomains(NamedTuple):
    """The ROS domains of enclaves: the domain of their robot, or all domains of the keystore.

    ``fleet`` is the keystore's fleet.  ``stated_robots`` maps enclaves to their robots in the fleet
    file of a command that does not record this file as the keystore's fleet.
    """

    keystore: DomainSet
    fleet: Fleet | None = None
    stated_robots: Mapping[str, Robot] = MappingProxyType({})

    def robots(self) -> Collection[Robot]:
        """Return the robots of the fleet."""
        return self.fleet.robots.values() if self.fleet else ()

    def robot_of(self, enclave: str) -> Robot | None:
        """Return the robot of an enclave; None if the enclave belongs to no robot.

        The values of the robot come from the keystore's fleet, or else from ``stated_robots``.
        """
        stated = self.stated_robots.get(enclave)
        robot = robot_of(self.fleet, enclave) if self.fleet else None
        if self.fleet and stated and robot is None:
            robot = self.fleet.robots.get(stated.name)
        return robot or stated

    def domains_of(self, enclave: str) -> DomainSet:
        """Return the ROS domains for which an enclave gets permissions.

        Raises:
            KeystoreError: the enclave's robot is in a domain that the keystore does not have, or
                the fleet file of the command and the keystore's fleet have it in different domains.
        """
        stated, robot = self.stated_robots.get(enclave), self.robot_of(enclave)
        if robot and stated and self._domains_with(robot) != self._domains_with(stated):
            raise _moved_robot_error(robot, stated)
        if robot is None or robot.domain is None:
            return self.keystore
        if robot.domain not in self.keystore:
            raise KeystoreError(
                f"the robot {robot.name} is in domain {robot.domain}, but the keystore is for "
                f"domain {self.keystore}",
                "An enclave can communicate only in the domains that the governance names.",
                f"Add domain {robot.domain} with `sros update_keystore KEYSTORE --domain "
                f"{self.keystore},{robot.domain} --allow-looser`, or give the robot another "
                "domain in the fleet file.",
            )
        return self._domains_with(robot)

    def _domains_with(self, robot: Robot) -> DomainSet:
        if robot.domain is None:
            return self.keystore
        return DomainSet.of((robot.domain, robot.domain))


def _moved_robot_error(recorded: Robot, stated: Robot) -> KeystoreError:
    """Return the error for a robot that the command's fleet file has in another domain."""

    def place(robot: Robot) -> str:
        return "all domains" if robot.domain is None else f"domain {robot.domain}"

    return KeystoreError(
        f"the fleet file has the robot {stated.name} in {place(stated)}, but the keystore's fleet "
        f"has it in {place(recorded)}",
        "This command would move only some enclaves of the robot, which could then no longer "
        "communicate with the others.",
        f"Sign for the recorded domain, with `--fleet KEYSTORE/{FLEET}`. Then move all enclaves of "
        "the robot with `sros generate_artifacts -k KEYSTORE -p POLICY_FILE --fleet FLEET_FILE`.",
    )


def with_routers_of_robots(
    network: ZenohNetwork,
    before: Fleet | None,
    fleet: Fleet,
    revoked_enclaves: Collection[str] = (),
) -> ZenohNetwork:
    """Return a network with the routers of ``fleet`` instead of the routers of ``before``.

    ``before`` is the previous fleet. The addresses at which a router listens are kept. Routers
    whose enclaves are in ``revoked_enclaves`` are left out.
    """
    from sros_tool.zenoh.configuration import ZenohRouter  # most fleets name no routers

    known = {router.name: router for router in network.routers}
    for name in _robots_by_router(before) if before else ():
        known.pop(name, None)
    listening = {router.name: router.listen for router in network.routers}
    for name, robot in _robots_by_router(fleet).items():
        if name not in revoked_enclaves:
            own = [enclave for enclave in enclaves_of(fleet, robot) if enclave != name]
            folder = fleet.routers.rpartition("/")[0]
            if has_placeholder(folder):
                siblings = f"{name.rpartition('/')[0]}/"
                own = [f"{siblings}*", *(e for e in own if not e.startswith(siblings))]
            known[name] = ZenohRouter(
                name, (robot.router,), listening.get(name, ()), tuple(own), robot.crossing
            )
    return replace(network, routers=tuple(known.values()))


def robot_of_router(fleet: Fleet | None, name: str) -> Robot | None:
    """Return the robot whose Zenoh router is in the enclave ``name``, or None."""
    return _robots_by_router(fleet).get(name) if fleet else None


def _robots_by_router(fleet: Fleet) -> dict[str, Robot]:
    """Map the enclave of each robot's Zenoh router to the robot."""
    return {
        router_enclave_of(fleet, robot): robot for robot in fleet.robots.values() if robot.router
    }


# ── writing ────────────────────────────────────────────────────────────────────────────────


def write_fleet(
    transaction: Transaction,
    keystore: OpenedKeystore,
    fleet: Fleet,
    patterns: Collection[str],
    now: datetime,
) -> tuple[Fleet, tuple[Entry, ...]]:
    """Stage ``fleet`` as the keystore's fleet, and return it as staged, with ledger entries.

    The staged fleet has the enclave paths of ``fleet``, the paths in ``patterns``, and the paths of
    the keystore's present fleet unless somebody edited the fleet file.  If nothing differs from the
    present fleet, nothing is staged.
    """
    from sros_tool.fleet.fleet_file import render_fleet

    ledger = keystore.ledger_with("what", "fleet")
    before = None if fleet_edits_clause(keystore, ledger) else load_fleet(keystore)
    known = (before.enclaves if before else (), fleet.enclaves, patterns)
    paths = dict.fromkeys(sorted(path for paths in known for path in paths))
    fleet = fleet.with_enclaves(tuple(paths))
    if problem := size_problem(fleet):
        raise KeystoreError(
            f"the fleet of keystore '{transaction.root}' would be too large",
            f"{problem} The paths of earlier policies count, too.",
            "Divide the fleet between keystores.",
        )
    _refuse_shared_enclaves(fleet)
    document = (_FLEET_COMMENT + render_fleet(fleet)).encode()
    if not _edit_text(ledger, document) and _read_fleet_file(keystore):
        return fleet, ()
    transaction.write(FLEET, document)
    digest = hashlib.sha256(document).hexdigest()
    return fleet, (Entry(iso(now), "fleet", sha256=digest),)


def _refuse_shared_enclaves(fleet: Fleet) -> None:
    """Raise `KeystoreError` if two robots have an enclave in common."""
    owners: dict[str, str] = {}
    for robot in fleet.robots.values():
        for name in enclaves_of(fleet, robot):
            if name in owners:
                raise KeystoreError(
                    f"the enclave {name} would belong to two robots, {owners[name]} and "
                    f"{robot.name}",
                    "The keystore has enclaves with the paths "
                    f"{', '.join(fleet.enclaves[:_MOST_SHOWN])}, "
                    "perhaps from an earlier policy. An export for one of the robots would have "
                    "the "
                    "key of the other.",
                    "Give one of the robots another name or namespace in the fleet file.",
                )
            owners[name] = robot.name


def refuse_stale_domains(
    keystore: OpenedKeystore, before: EnclaveDomains, fleet: Fleet, stated: Collection[str]
) -> None:
    """Raise `KeystoreError` if an enclave would keep permissions for its former domains.

    Args:
        keystore: the keystore.
        before: the domains of the keystore's enclaves until now.
        fleet: the robots of the keystore from now on.
        stated: the names of enclaves that get new permissions.
    """
    after = EnclaveDomains(before.keystore, fleet)
    if not any(robot.domain is not None for side in (before, after) for robot in side.robots()):
        return
    for name in keystore.names:
        if name in stated or robot_of(fleet, name) is None:
            continue
        former, domains = before.domains_of(name), after.domains_of(name)
        if former == domains:
            continue
        if (signed := _signed_domains(keystore, name) or former) != domains:
            raise KeystoreError(
                f"according to the fleet file, enclave {name} belongs to domain {domains}, but it "
                f"would keep its permissions for domain {signed}",
                "No policy of this command states its rights, so it gets no new permissions.",
                "Name the policies of all enclaves whose robots change their domain.",
            )


def _signed_domains(keystore: OpenedKeystore, name: str) -> DomainSet | None:
    """Return the domains of an enclave's permissions; None if they cannot be read."""
    with suppress(SrosError):
        subject = subject_text(keystore.certificate_of(name).subject)
        if grant := keystore.signed_grant(name, subject).grant:
            return grant.domains().closed()
    return None


def lost_enclaves(
    keystore: OpenedKeystore, before: Fleet, after: Fleet, now: datetime
) -> tuple[list[Note], list[Entry]]:
    """Return notes and ledger entries on enclaves and routers that robots lose.

    ``before`` and ``after`` are the fleet before and after a change.  Only enclaves that the
    keystore still has are included, also if robots lost them earlier.
    """
    notes: list[Note] = []
    lost: dict[str, set[str]] = {}
    # With a path such as {namespace}/base, a new robot can have the enclave of an earlier one.
    kept = {name for robot in after.robots.values() for name in enclaves_of(after, robot)}
    for robot in before.robots.values():
        same_robot, router = after.robots.get(robot.name), ""
        if same_robot and robot.router and not same_robot.router:
            router = router_enclave_of(before, robot)
            if keystore.has_enclave(router):
                notes.append(_lost_router_note(keystore, robot.name, router))
        names = (name for name in enclaves_of(before, robot) if name not in kept and name != router)
        if lost_names := {name for name in names if keystore.has_enclave(name)}:
            lost[robot.name] = lost_names
    # Enclaves that an earlier change of the fleet left without a robot count, too.
    earlier = unrecorded_enclaves(before, keystore.names, lost) if lost else {}
    for name, enclaves in lost.items():
        enclaves.update(enclave for enclave in earlier[name].below if not robot_of(after, enclave))
    robots = {enclave: name for name, enclaves in lost.items() for enclave in enclaves}
    entries = [
        Entry(iso(now), LEFT, enclave=enclave, reason=name)
        for enclave, name in sorted(robots.items())
    ]
    notes += left_enclaves_notes(keystore, after, left_enclaves(keystore, after, now) | robots)
    return notes, entries


def left_enclaves(
    keystore: OpenedKeystore, fleet: Fleet, now: datetime | None = None
) -> dict[str, str]:
    """Map the enclaves of robots that left the fleet or their group to these robots.

    Only enclaves that the ledger records as left are known.  A line that is not certain counts
    until the rights of the enclave are stated again: robots may have left before a gap.  With
    ``now``, enclaves whose certificates have expired are left out.
    """
    names = {
        entry.enclave
        for entry in keystore.ledger_file.with_values("what", (LEFT,)).entries
        if entry.what == LEFT and keystore.has_enclave(entry.enclave)
    }
    ledger = keystore.ledger_file.with_values("enclave", names) if names else Ledger()
    uncertain = ledger.entries[: len(ledger.entries) - len(ledger.certain)]
    robots = {entry.enclave: entry.reason for entry in uncertain if entry.what == LEFT}
    unproven = {*robots}
    for entry in ledger.certain:
        if entry.what == LEFT:
            robots[entry.enclave] = entry.reason
            unproven.discard(entry.enclave)
        elif (entry.what == "revocation" and entry.reason != SUPERSEDED) or (
            entry.what == "permissions" and entry.enclave in unproven
        ):
            robots.pop(entry.enclave, None)  # it was made again, not for the robot
    left: dict[str, str] = {}
    for name, robot in sorted(robots.items()):
        with suppress(SrosError):  # without a certificate, nobody can use the enclave
            until = validity_of(keystore.certificate_of(name)).not_after
            if (now is None or until > now) and not robot_of(fleet, name):
                left[name] = robot
    return left


def left_enclaves_notes(
    keystore: OpenedKeystore, fleet: Fleet, left: Mapping[str, str], *, recorded: bool = True
) -> Iterator[Note]:
    """Yield a note for each robot that ``left`` (as of `left_enclaves`) names.

    ``recorded`` says whether the ledger records that the robots left; otherwise, only the paths of
    the enclaves show it.
    """
    enclaves: dict[str, list[str]] = {}
    for name, robot in sorted(left.items()):
        enclaves.setdefault(robot, []).append(name)
    for robot, names in enclaves.items():
        why = (
            "has other enclave paths now" if robot in fleet.robots else "is no longer in the fleet"
        )
        s, stay, them, belong = (
            ("", "stays", "it", "belongs") if len(names) == 1 else ("s", "stay", "them", "belong")
        )
        shown, revoke = first_few(names, _MOST_SHOWN), revoke_command(keystore, names)
        text = (
            f"the robot {robot} {why}, but its earlier enclave{s} {shown} {stay} valid. To revoke "
            f"{them}, run {revoke}."
        )
        if not recorded:
            text = (
                f"{shown} {belong} to no robot of the fleet, but to a robot {robot} by the path. "
                f"If there was such a robot, revoke {them} with {revoke}. Until then, `sros renew "
                f"--all-expiring` renews {them}."
            )
        yield Note("fleet.left-enclaves", text)


def former_robots_notes(
    keystore: OpenedKeystore, fleet: Fleet, noted: Collection[str]
) -> Iterator[Note]:
    """Yield notes, as `left_enclaves_notes`, on robots that only the paths of enclaves show.

    If the fleet file was edited, nothing else shows that such a robot left.  This is no proof: the
    path ``/{robot}`` also fits ``/dispatcher``, so a timer has to go on renewing these enclaves.
    Enclaves in ``noted`` are left out.
    """
    former = {name: former_robot_of(fleet, name) for name in keystore.names if name not in noted}
    robots = {name: robot for name, robot in former.items() if robot}
    yield from left_enclaves_notes(keystore, fleet, robots, recorded=False)


def revoke_command(keystore: OpenedKeystore, names: Sequence[str]) -> str:
    """Return the command, in backticks, that revokes the enclaves ``names``, which are sorted."""
    return f"`sros revoke {quote(str(keystore.root))} {arguments_for(keystore, names)}`"


def _lost_router_note(keystore: OpenedKeystore, robot: str, router: str) -> Note:
    text = (
        f"the robot {robot} has no Zenoh router any more: its enclave {router} stays valid. Stop "
        "the router, and revoke its enclave: `sros revoke "
        f"{quote(str(keystore.root))} {router}`."
    )
    return Note("fleet.left-router", text)


def arguments_for(keystore: OpenedKeystore, names: Sequence[str]) -> str:
    """Return the command line arguments that select exactly the enclaves ``names``.

    These are ``--match 'PREFIX*'`` if this pattern matches no other enclaves, or else the names.
    """
    begin = f"{os.path.commonpath(names).rstrip('/')}/"
    if len(names) > 1 and begin != "/":
        fitting = [name for name in keystore.names if name.startswith(begin)]
        if fitting == sorted(names):
            return f"--match {quote(f'{begin}*')}"
    return " ".join(names)
