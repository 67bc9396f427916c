"""Prove that a robot is closed."""

from __future__ import annotations

import json
import os
import shlex
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
from itertools import chain
from pathlib import Path
from typing import Any

from sros_tool.checks.connections import (
    CONNECTING_TIME,
    PROCESS_LOST_MEMORY,
    PROCESS_NOT_CONNECTED,
    connections_between,
    not_connected_text,
    process_name,
)
from sros_tool.checks.environment import is_zenoh
from sros_tool.checks.keystores.issued import STALE
from sros_tool.checks.kind import NOTE, Finding
from sros_tool.checks.processes import (
    PROCESS_NOT_SEEN,
    further_domains_text,
    group_by_authorities,
    process_findings,
)
from sros_tool.checks.requirements import MISSPELLED_ENCLAVE, VACUOUS
from sros_tool.close.nodes import ObservedNodes, nodes_text
from sros_tool.close.overrides import overrides
from sros_tool.close.processes import ObservedProcesses, is_in_domain
from sros_tool.close.robot import MOST_NAMES, OBSERVER, TEMPLATE, LocalRobot
from sros_tool.close.state import (
    ACCEPTED,
    ALONE,
    CONNECTED,
    KNOWN,
    REQUIRED,
    SILENCE,
    STARTED,
    CloseState,
    Proof,
    RunningRobot,
    current_state,
    earlier_files_until,
    keystore_text,
    wait_until,
)
from sros_tool.close.talk import UnitRestarts, proof_of_talk
from sros_tool.errors import SrosError, UnavailableError
from sros_tool.graph.observation import PROFILE_VARIABLES, Observation
from sros_tool.keystore.expiry import renewal_command, survey
from sros_tool.keystore.layout import KEY_FILES, enclave_path, list_enclaves
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.proof.requirements import Must, read_requirements
from sros_tool.runtime.processes import Process, RunningProcesses, user_text
from sros_tool.runtime.variables import ENCLAVE
from sros_tool.validity import iso
from sros_tool.wording import counted, enumerated, first_few

_NOT_PROVED = (
    "sros cannot see whether two nodes hear each other: look at what the nodes receive now, and "
    "restart a node that receives nothing"
)

_NOT_LOOKED_AT = (
    "because of this, the proof did not look whether everything can still talk, and what an open "
    "listener finds"
)

_START_SECONDS = 3.0
"""How long processes that were restarted by hand may take until they run in their enclaves."""

_OTHERS_SEEN = {
    "graph.ended": "nodes that ended while it listened:",
    "graph.silent": "nodes without endpoints:",
    "graph.stray": "topics with writers or readers that belong to no ROS node:",
    "graph.tool-writes": "nodes that write, although they have names of the command `ros2`:",
}
"""The notes of `generate_policy` on what it sees besides the nodes of its result, as words."""

_KINDS_OF_CONNECTIONS = (PROCESS_LOST_MEMORY, PROCESS_NOT_CONNECTED)
"""The findings on processes that only concern the proof of connections."""


def prove(robot: LocalRobot) -> CloseState:
    """Prove that the robot is closed; return its state with the proofs."""
    robot.shell.check_open()
    robot.check_rmw()
    state = current_state(robot, robot.read_policy())
    proofs = proofs_of(robot, state, _START_SECONDS)
    return state._replace(proofs=proofs, denied=[*chain(*(proof.denied for proof in proofs))])


def proofs_of(robot: LocalRobot, state: CloseState, patience: float) -> list[Proof]:
    """Wait until each process runs in its enclave, and return the proofs that the robot is closed.

    Waits for at most ``patience`` seconds.  If a process is then missing, the only proofs are that
    it was not started, and, if so, that a process has a revoked certificate, that the files are not
    accepted or that a requirement is violated.
    If the enclave of the observer has expired, only the files are examined.
    """
    expired = expired_enclaves(robot, robot.export)
    unsigned_text = cache(partial(_unsigned_policy_text, robot))
    if OBSERVER in expired:
        return [_proof_of_files(robot, expired, unsigned_text)]
    expected = state.observed.enclaves | {*state.new}
    if not expected:
        return [Proof(STARTED, False, "no process of the robot is known")]
    running = wait_until(robot, lambda seen: seen.current_enclaves >= expected, patience)
    missing = sorted(expected - running.current_enclaves)
    running_now = {enclave.name for _, enclave in running.secured}
    needed = {*missing}.difference(robot.without) | running_now.intersection(missing)
    if needed or expected == {*missing}:
        observed = state.observed.with_current_pids(running.processes, robot.export)
        why = _why_missing(running, sorted(needed) or missing, observed)
        proofs = (
            *_proof_of_observed_processes([running]),  # first, because a stranger may be at work
            Proof(STARTED, False, why, details=[_NOT_LOOKED_AT]),
            _proof_of_files(robot, expired, unsigned_text),
            _proof_of_requirements(robot, unsigned_text),
        )
        return [proof for proof in proofs if proof.fails]
    nodes, not_here = ObservedNodes(robot), robot.not_here
    restarts = UnitRestarts(robot, state.observed)
    # A laptop may be away; a computer whose nodes were seen has to be seen again.
    may_be_away = not_here - {node.enclaves[0] for node in nodes.nodes_to_compare(()).nodes}
    away = {*missing} | may_be_away | not_here.intersection(robot.without)
    files = _proof_of_files(robot, expired, unsigned_text)
    required = _proof_of_requirements(robot, unsigned_text)
    talk = proof_of_talk(running, nodes, away, restarts)
    silence = _proof_of_silence(robot, nodes.nodes_to_compare(away), hears=talk.holds is not None)
    connected = [*_proof_of_connections(robot)]
    if talk.holds and not connected:
        talk = talk._replace(details=[*talk.details, _NOT_PROVED])
    looks = (running, RunningRobot(robot))  # again: the observers took up to a minute
    proof = _proof_of_processes(looks, state.observed, expected.difference(missing))
    absence = "not seen" if running.processes.unseen or running.processes.hidden else "not running"
    for names, where in ((missing, absence), (sorted(not_here), "on other machines")):
        if names:
            proof = proof._replace(
                reason=f"{proof.reason}; not counted: {', '.join(names)} ({where})"
            )
    return [
        proof,
        *_proof_of_observed_processes(looks),
        *_proof_of_domains(looks),
        files,
        required,
        talk,
        *connected,
        _with_possible_cause(silence, connected),
    ]


def _proof_of_files(
    robot: LocalRobot, expired: Sequence[str], unsigned_text: Callable[[], str]
) -> Proof:
    """Return the proof that `check` finds no error in the used files, or in the keystore.

    The enclaves ``expired`` of the export have expired. ``unsigned_text`` returns a clause if the
    signed permissions differ from the policy, or "".
    """
    status = robot.shell.check(str(robot.export))
    holds = {0: True, 1: False}.get(status)
    reason = "sros check finds no error" if holds else "sros could not check them"
    if expired:
        holds, reason = False, expired_text(robot, expired)
    elif holds is False:
        reason = _errors_text(robot, str(robot.export))
    if holds and robot.keystore.exists():  # an outdated export has no error of its own
        try:
            _, value = robot.shell.read_json((*robot.export_words(), "--dry-run", "--json"))
            changes = [change["path"] for change in value["changes"]]
        except UnavailableError as error:
            holds, reason = (
                None,
                f"they cannot be compared with the keystore: {f'{error}'.removesuffix('.')}",
            )
        except SrosError as error:  # for example, an older revocation list
            holds, reason = (
                False,
                f"the keystore does not export them: {f'{error}'.removesuffix('.')}",
            )
        else:
            if outside := robot.enclaves_outside_policy():
                reason = f"the keystore has {first_few(outside, MOST_NAMES)}, and the policy does "
                reason += f"not; {robot.revoking_advice}"
                holds = False
            elif changes:
                number = counted(len(changes), "file")
                reason = f"exporting '{robot.keystore}' would change {number}, such as {changes[0]}"
                holds, reason = False, f"{reason}; `{robot.close_command}` exports them"
    examined = f"{robot.export}"
    if robot.keystore.exists() and not expired:
        examined += f", and the CAs and settings of {robot.keystore}"
        # An expired enclave of another machine does not make this robot less closed.
        words = (str(robot.keystore), "--include", "keystore.*")
        if status_there := robot.shell.check(*words):
            fails = status_there == 1
            told = _errors_text(robot, *words) if fails else "sros could not check the keystore"
            reason = told if holds else f"{reason}; {told}"
            holds = False if fails or holds is False else None
    if misplaced := _misplaced_keys_text(robot):
        reason = misplaced if holds else f"{reason}; {misplaced}"
        holds = False
    return Proof(ACCEPTED, holds, f"{reason}: {examined}{unsigned_text() if status == 0 else ''}")


def _misplaced_keys_text(robot: LocalRobot) -> str:
    """Return which private keys of other machines' enclaves are in the export, or ""."""
    folders = {name: enclave_path(robot.export, name) for name in sorted(robot.not_here)}
    names = [
        name
        for name, folder in folders.items()
        if any(os.path.lexists(folder / file) for file in KEY_FILES)
    ]
    if not names:
        return ""
    text = f"{robot.export} has the private keys of {first_few(names, MOST_NAMES)}, which belong "
    text += "to other machines; "
    if robot.keystore.exists():
        return f"{text}`{robot.close_command}` removes them"
    remove = shlex.join(("rm", "-r", *(str(folders[name]) for name in names)))
    return f"{text}run `{remove}`, and export the enclaves of this robot by name, not with --all"


def expired_enclaves(robot: LocalRobot, root: Path) -> list[str]:
    """Return the enclaves below ``root`` whose certificate or permissions have expired."""
    lifetimes, _ = survey(OpenedKeystore(root)) if root.exists() else ((), ())
    now = robot.shell.now()
    return [lifetime.name for lifetime in lifetimes if lifetime.first_expiry() < now]


def expired_text(robot: LocalRobot, expired: Sequence[str]) -> str:
    """Return text on expired enclaves of the export, and on how to renew them."""
    text = f"the files of {first_few(expired, MOST_NAMES)} have expired; "
    if not robot.keystore.exists():
        return (
            f"{text}renew them where the keystore is (`{renewal_command(Path('KEYSTORE'))}`), "
            f"export them again, and restart all processes together"
        )
    if to_renew := [name for name in expired_enclaves(robot, robot.keystore) if name in expired]:
        words = ("sros", "renew", str(robot.keystore), *to_renew)
        text += f"run `{shlex.join(words)}`"
        if earlier := earlier_files_until(robot, to_renew):
            text += (
                f" (with --revoke-old, because earlier files of {', '.join(earlier)} still work "
            )
            text += f"for whoever kept them, until {iso(max(earlier.values()))})"
        text += ", and then "
    return f"{text}run `{robot.close_command}`, and restart all processes together"


def _unsigned_policy_text(robot: LocalRobot) -> str:
    """Return a clause on the enclaves whose signed rights differ from the policy; "" if none do."""
    if not robot.policy.exists():
        return ""
    has_keystore = robot.keystore.exists()
    signed = robot.keystore if has_keystore else robot.export
    only = ("--include", STALE.id, "--json")
    words = ("check", str(signed), "--policy", str(robot.policy), *only)
    _, output, _ = robot.shell.run(words, False)
    stale = [finding["subject"] for finding in json.loads(output)["findings"]]
    unsigned = robot.policy_enclaves().difference(list_enclaves(signed))
    unsigned = unsigned if has_keystore else unsigned - robot.not_here
    clauses = []
    if changed := sorted({*stale} - unsigned):
        names = first_few(changed, MOST_NAMES)
        clauses.append(f"differs from the signed permissions of {names}, which the processes use")
    if unsigned:
        clauses.append(f"has {first_few(sorted(unsigned), MOST_NAMES)}, without signed permissions")
    if not clauses:
        return ""
    remedy = f"`{robot.close_command}` checks and signs it"
    if not has_keystore:
        remedy = "bring the signed policy here, or sign this policy where the keystore is"
    return f"; '{robot.policy}' {' and '.join(clauses)}: {remedy}"


def _errors_text(robot: LocalRobot, *words: str) -> str:
    """Return how many errors ``sros check WORDS`` finds, and how to mend the first."""
    _, output, _ = robot.shell.run(("check", *words, "--fail-on", "error", "--json"), False)
    findings = json.loads(output)["findings"]
    errors = [finding for finding in findings if finding["severity"] == "error"]
    if not errors:  # the files changed since `check` found some
        return "sros check found an error, and then none: run the proof again"
    first = "{file}: {text}. {remedy}".format_map(errors[0]).rstrip(".")
    text = f"sros check finds {counted(len(errors), 'error')}, the first in {first}"
    if robot.close_command in text:
        return text
    return f"{text}; then run `{robot.close_command}`, and restart the processes"


def _proof_of_requirements(robot: LocalRobot, unsigned_text: Callable[[], str]) -> Proof:
    """Return the proof that the requirements hold for the enclaves that the processes use.

    ``unsigned_text`` is as in `_proof_of_files`.
    They are also decided for the enclaves of the keystore (or policy) if processes run on other
    machines, or a requirement names an enclave that the export does not have.
    """
    if not robot.requirements.exists():
        missing = f"{robot.requirements} is missing; restore it, or run `{robot.close_command}`, "
        return Proof(REQUIRED, None, f"{missing}which writes the requirements that hold now")
    needed = ("--requirements", str(robot.requirements), "--include", "requirement.*")
    statuses = [robot.shell.check(str(robot.export), *needed)]
    if robot.not_here or (statuses != [2] and _demands_more_enclaves(robot)):
        statuses.append(robot.shell.check(str(robot.rights_source), *needed))
    status = 1 if 1 in statuses else max(statuses)
    reasons = {0: "all of them", 1: "at least one is violated", 2: "sros could not check them"}
    holds = {0: True, 1: False}.get(status)
    more = _unsigned_violation_text(robot, *needed) if holds and unsigned_text() else ""
    more += _weak_requirements_text(robot) if holds else ""
    return Proof(REQUIRED, holds, f"{reasons[status]}: {robot.requirements}{more}")


def _unsigned_violation_text(robot: LocalRobot, *needed: str) -> str:
    """Return a clause which says that the policy, which is not signed yet, breaks a requirement.

    The result is "" if it breaks none. ``needed`` are the options of `check` that name the
    requirements.
    """
    words = ("check", str(robot.policy), "--template", TEMPLATE, *needed, "--fail-on", "error")
    status, _, _ = robot.shell.run(words, False)
    if status != 1:
        return ""
    return f"; '{robot.policy}', which is not signed yet, violates at least one requirement"


def _weak_requirements_text(robot: LocalRobot) -> str:
    """Return a clause on requirements that protect less than they state; "" if there are none."""
    required = ("--requirements", str(robot.requirements), "--json")
    only = ("--include", VACUOUS.id, "--include", MISSPELLED_ENCLAVE.id)
    try:
        _, output, _ = robot.shell.run(("check", str(robot.rights_source), *required, *only), False)
    except SrosError as error:
        return f"; sros cannot say whether they protect all that they state: {error.what}"
    findings = json.loads(output)["findings"]
    if not findings:
        return ""
    number = counted(len(findings), "warning")
    first = "line {line}: {text}".format_map(findings[0])
    return (
        f"; but with {number} that a requirement protects less than it states, the first: {first}"
    )


def _demands_more_enclaves(robot: LocalRobot) -> bool:
    required = read_requirements(robot.requirements)
    demanded = {requirement.enclave for requirement in required if isinstance(requirement, Must)}
    return not demanded.issubset(list_enclaves(robot.export))


def _proof_of_connections(robot: LocalRobot) -> Iterator[Proof]:
    """Yield a proof whether all processes have connected to each other (None: not known).

    Yields nothing if at most one process has shared memory ports of Fast DDS that sros sees.
    Waits until all processes have connected, or had enough time. Processes that may not belong to
    the robot leave the claim untested if they have not connected, as do processes that use ROS 2
    and cannot be examined.
    """
    own, others = _connecting_processes(RunningRobot(robot))
    started = [process.started for process in (*own, *others)]
    now = robot.shell.now()
    patience = min(max(started, default=now) + CONNECTING_TIME - now, CONNECTING_TIME)
    running = wait_until(
        robot,
        lambda seen: connections_between(chain(*_connecting_processes(seen))).are_settled,
        patience.total_seconds(),
    )
    own, others = _connecting_processes(running)
    connections = connections_between([*own, *others])
    if text := not_connected_text(connections_between(own)):
        yield Proof(CONNECTED, False, text)
    elif text := not_connected_text(connections):
        names = first_few([process.label for process in others], MOST_NAMES)
        yield Proof(CONNECTED, None, f"{names} may also belong to the robot: {text}")
    elif connections.compared and (unknown := connections.unknown):
        names = first_few([*map(process_name, unknown)], MOST_NAMES)
        is_one = len(unknown) == 1
        hear, they, share = ("hears", "it", "shares") if is_one else ("hear", "they", "share")
        yield Proof(
            CONNECTED,
            None,
            f"sros cannot see whether {names} {hear} the others, because {they} {share} no memory "
            "of Fast DDS with them: look at what each process receives now, and restart a process "
            "that receives nothing",
        )
    elif connections.compared and (text := _unexamined_text(running.processes, own)):
        yield Proof(CONNECTED, None, text, unexamined=True)
    elif len(connections.compared) > 1:
        number = counted(len(connections.compared), "process", "processes")
        reason = f"{number} of Fast DDS, each with all others"
        reason += "; sros cannot see processes on other machines" * bool(robot.not_here)
        # Their commands do not show whether they use ROS 2.
        reason += "; without processes that sros could not examine" * bool(running.processes.unseen)
        yield Proof(CONNECTED, True, reason)


_SHARED_MEMORY = Path("/dev/shm")  # noqa: S108 - only the owners of its files are read
"""The folder of Fast DDS's shared memory."""


def _other_users_of_fastdds(processes: Iterable[Process]) -> list[str]:
    """Return the users who have shared memory of Fast DDS, other than those of ``processes``."""
    users = set[int]()
    with suppress(OSError), os.scandir(_SHARED_MEMORY) as entries:
        for entry in entries:
            if entry.name.startswith("fastrtps_"):
                with suppress(OSError):  # it was removed meanwhile
                    users.add(entry.stat(follow_symlinks=False).st_uid)
    return [user_text(user) for user in sorted(users.difference(e.user for e in processes))]


def _unexamined_text(running: RunningProcesses, own: Iterable[Process]) -> str:
    """Return text on the processes that may be deaf and cannot be examined; "" without any.

    If their commands do not show ROS 2, the shared memory of other users than those of the robot's
    ``own`` processes shows it.
    """
    unseen = [process.label for process in running.unseen if process.uses_ros]
    names = [first_few(unseen, MOST_NAMES)] * bool(unseen)
    if running.unseen and not unseen and (users := _other_users_of_fastdds(own)):
        names = [f"processes of {enumerated(users)} with shared memory of Fast DDS"]
    names += ["processes that /proc hides"] * bool(running.hidden)
    if not names:
        return ""
    is_one = len(unseen) == 1 and not running.hidden
    hear, they = ("hears", "it") if is_one else ("hear", "they")
    return (
        f"sros cannot see whether {enumerated(names)} {hear} the others, because {they} could not "
        "be examined: "
        "run the proof as root, outside of containers"
    )


def _connecting_processes(running: RunningRobot) -> tuple[list[Process], list[Process]]:
    """Return the robot's processes, and further processes of its domain that trust the same CA.

    The latter have other files, or only claim to run in an enclave; those with a revoked
    certificate are left out, as is the observer.
    """
    own = [
        process
        for process, enclave in running.secured
        if enclave.name != OBSERVER and running.may_use_files(process)
    ]
    pids = {process.pid for process in own}
    others = [
        process
        for _, group in group_by_authorities(
            process
            for process in running.in_domain
            if process.enclave and process.enclave.name != OBSERVER and not process.is_daemon
        )
        for process in group
        if process.pid not in pids and any(member.pid in pids for member in group)
        # Others rightly refuse a revoked certificate.
        if process.enclave and not running.revokes(process.enclave)
    ]
    return own, others


def _proof_of_silence(robot: LocalRobot, before: Observation, *, hears: bool) -> Proof:
    """Return the proof that an open listener sees no node of the robot.

    Before the robot was closed, the listener saw the nodes ``before``. Seeing none now proves
    something only if the observer ``hears`` the robot in its enclave.
    """
    unwritten, domain = str(robot.folder / "open.xml"), str(robot.domain)
    words = ("generate_policy", unwritten, "--domain", domain, "--dry-run", "--json")
    try:
        values = [robot.shell.read_json(words)[1]]
        # A listener without these variables may not see the nodes that have them.
        if narrow := _narrow_discovery(robot.shell.environment):
            values.append(robot.shell.read_json(words, without=narrow)[1])
    except UnavailableError as error:
        return Proof(SILENCE, None, f"{error}")
    if seen := [*dict.fromkeys(chain(*map(_seen_by_listener, values)))]:
        text = f"it sees {enumerated(seen)}; stop what runs open, or start it in its enclave"
        return Proof(SILENCE, False, text)
    if not all(value["settled"] for value in values):
        why = "the ROS graph kept changing, or could not be read in time, so the listener may have "
        why += "missed nodes; run the proof again"
        return Proof(SILENCE, None, why)
    if not hears:
        why = "this proves nothing, because the observer in its enclave does not see the robot now"
        return Proof(SILENCE, None, why)
    number = nodes_text(before.nodes)
    reason = f"the listener saw {number} before (without removed ones), and sees none now"
    return Proof(SILENCE, True, reason)


def _with_possible_cause(silence: Proof, connected: Iterable[Proof]) -> Proof:
    """Return the proof of silence; if it fails, with the processes that may run open."""
    if silence.fails and any(proof.fails for proof in connected):
        cause = "a process that has not connected may be what the listener sees: its program may "
        cause += "turn security off by itself, or have another context without security"
        return silence._replace(details=[*silence.details, cause])
    return silence


def _seen_by_listener(value: Mapping[str, Any]) -> Iterator[str]:
    """Yield what the JSON of `generate_policy` shows: nodes, and what belongs to no ROS node."""
    nodes = {f"{node['namespace'].rstrip('/')}/{node['name']}" for node in value["nodes"]}
    if nodes:
        yield first_few(sorted(nodes), MOST_NAMES)
    # Nodes that ended, nodes without endpoints, and programs without ROS are only in notes.
    for note in value["notes"]:
        if note["id"] in _OTHERS_SEEN:
            yield f"{_OTHERS_SEEN[note['id']]} {note['text'].partition(': ')[2]}"


def _narrow_discovery(environment: Mapping[str, str]) -> Collection[str]:
    """Return the variables that may keep the listener from seeing other machines.

    rmw_zenoh ignores these variables. Sources: rcl/src/rcl/discovery_options.c and localhost.c; the
    manuals of Cyclone DDS and Fast DDS.
    """
    if is_zenoh(environment):
        return []
    wide_values = {
        "ROS_AUTOMATIC_DISCOVERY_RANGE": ("", "SUBNET", "SYSTEM_DEFAULT"),
        "ROS_LOCALHOST_ONLY": ("", "0"),
        "ROS_DISCOVERY_SERVER": ("",),
        "FASTDDS_ENVIRONMENT_FILE": ("",),  # it may set the variables of Fast DDS
        **dict.fromkeys(("CYCLONEDDS_URI", *PROFILE_VARIABLES), ("",)),
    }
    return [name for name, wide in wide_values.items() if environment.get(name, "") not in wide]


def _proof_of_processes(
    looks: Sequence[RunningRobot], observed: ObservedProcesses, enclaves: Collection[str]
) -> Proof:
    """Return the proof that no process runs open, and that no process has findings.

    ``looks`` are the processes at the beginning and at the end of the proof. At its beginning, each
    of the ``enclaves`` had a process with the current files.
    """
    last, robot = looks[-1], looks[-1].robot
    if not_current := sorted(last.not_current.keys() & enclaves):
        now = observed.with_current_pids(last.processes, robot.export)
        return Proof(STARTED, False, _why_missing(last, not_current, now))
    robot.shell.say(
        f'$ eval "$(sros env {shlex.quote(str(robot.export))} {OBSERVER})"; sros check runtime'
    )
    all_findings = chain(*map(_process_findings, looks))
    # The text about all unseen processes is kept only once, because such processes come and go.
    findings = [
        *{
            (finding.id, finding.subject, finding.subject != "processes" and finding.text): finding
            for finding in all_findings
        }.values()
    ]
    enclave_of = {tuple(process.command): process.enclave for process in robot.processes.processes}
    remedies = {
        process.label: f"Stop it: another process runs in {enclave_of[process.program[1]]}."
        for running in looks
        for process in running.in_domain
        if not process.asks_for_security
        and enclave_of.get(process.program[1]) in running.current_enclaves
    }
    for finding in findings:
        remedy = remedies.get(finding.subject, finding.remedy)
        robot.shell.say(f"{finding.subject}: {finding.text}. {remedy}")
    wrong = [finding for finding in findings if finding.id != PROCESS_NOT_SEEN.id]
    number = counted(len(enclaves), "enclave")
    text = f"{number}, and no open process in domain {robot.domain}"
    if findings:
        texts = [
            finding.text if finding.subject == "processes" else f"{finding.subject}: {finding.text}"
            for finding in wrong or findings
        ]
        text = first_few(texts, MOST_NAMES, "; ")
        if not wrong:
            text = f"true for {number}; {text}: they may run open, or with a copied key"
    else:
        text += "".join(f"; {guest}" for guest in _texts_of_all(_open_in_other_domains, looks))
    holds = False if wrong else None if findings else True
    return Proof(STARTED, holds, text, unexamined=holds is None)


def _texts_of_all(
    texts_of: Callable[[RunningRobot], Iterable[str]], looks: Iterable[RunningRobot]
) -> list[str]:
    """Return the texts about several looks at the processes, each text once."""
    return [*dict.fromkeys(chain(*map(texts_of, looks)))]


def _proof_of_observed_processes(looks: Sequence[RunningRobot]) -> Iterator[Proof]:
    """Yield a proof if enclaves have processes that sros did not see when it watched.

    It fails if one of them has a revoked certificate; otherwise, it is undecided.
    """
    revoked = _texts_of_all(partial(RunningRobot.with_other_files, revoked=True), looks)
    more = _texts_of_all(RunningRobot.not_observed, looks)
    more += _texts_of_all(partial(RunningRobot.with_other_files, revoked=False), looks)
    reasons = []
    if revoked:
        have = "has a revoked certificate" if len(revoked) == 1 else "have revoked certificates"
        names = first_few(revoked, MOST_NAMES)
        reasons.append(f"{names} {have}: stop what is not yours, and export again what is yours")
    if more:
        reasons.append(
            f"sros did not see {first_few(more, MOST_NAMES)} when it watched, and each process has "
            "all rights of its enclave: stop what is not yours"
        )
    if reasons:
        yield Proof(KNOWN, False if revoked else None, "; ".join(reasons))


def _proof_of_domains(looks: Sequence[RunningRobot]) -> Iterator[Proof]:
    """Yield an undecided proof for processes that are also in other domains, and one for networks.

    The latter is for open processes of the domain in another network namespace.
    """
    in_several = {
        process.label: process
        for running in looks
        for process in running.in_domain
        if process.further_domains and not process.is_daemon
    }
    if in_several:
        processes = in_several.values()
        texts = [f"{process.label}: {further_domains_text(process)}" for process in processes]
        numbers = sorted({number for process in processes for number in process.further_domains})
        look = f"`sros generate_policy open.xml --domain {numbers[0]} --dry-run`"
        yield Proof(
            ALONE,
            None,
            f"{first_few(texts, MOST_NAMES, '; ')}; a program can leave out security there: accept "
            f"this if {look} finds no node of it",
        )
    domain = looks[-1].robot.domain
    if others := _texts_of_all(_open_in_other_networks, looks):
        yield Proof(
            ALONE,
            None,
            f"{first_few(others, MOST_NAMES)} in domain {domain} of another network "
            "namespace, where the listener does not look: accept this if no other machine reaches "
            "this domain there, or stop what runs open",
        )


def _process_findings(running: RunningRobot) -> list[Finding]:
    """Return the findings of `check runtime` in the robot's domain and the observer's enclave."""
    robot = running.robot
    # This shell starts no node.
    environment = {**robot.shell.environment, **robot.variables(OBSERVER), ENCLAVE: ""}
    examined = replace(running.processes, processes=tuple(running.in_domain))
    findings = process_findings(environment, examined, now=robot.shell.now(), zone=robot.shell.zone)
    return [
        finding
        for finding in findings
        if finding.severity > NOTE and finding.kind not in _KINDS_OF_CONNECTIONS
    ]


def _open_in_other_domains(running: RunningRobot) -> Iterator[str]:
    """Yield texts on the open processes in other domains of the robot's network namespace."""
    for process in _open_beside(running):
        if not (process.network or process.is_daemon):
            yield f"{process.label} runs open in domain {process.domain}"


def _open_in_other_networks(running: RunningRobot) -> Iterator[str]:
    """Yield texts on the open processes in the robot's domain of another network namespace.

    The daemon of ros2 counts, as in the robot's network: any program can have its name.
    """
    for process in _open_beside(running):
        if process.network and is_in_domain(replace(process, network=""), running.robot.domain):
            yield f"{process.label} runs open"


def _open_beside(running: RunningRobot) -> Iterator[Process]:
    """Yield the open processes that are not in the robot's domain."""
    in_domain = running.in_domain
    for process in running.processes.processes:
        if not (process.enclave or process in in_domain):
            yield process


def _why_missing(running: RunningRobot, missing: Sequence[str], observed: ObservedProcesses) -> str:
    """Return the enclaves without a secured process, and why their other processes do not count."""
    robot = running.robot
    outdated = {name: pairs for name, pairs in running.not_current.items() if name in missing}
    overridden = overrides(running, observed)
    apply = f"`{robot.close_command} --apply`"
    causes = {
        process.enclave: f"{process.unit} does not run it: "
        f"systemctl status {shlex.quote(process.unit)}"
        if process.absent
        else f"{process.pids_text} is open: "
        + (f"{apply} restarts {process.unit}" if process.unit else "stop it")
        for process in observed.processes
        if not process.is_idle
    }
    has_start = {*causes}
    absent = [name for name in missing if name not in outdated]
    causes |= {
        enclave.name: f"{process.label} has the files of '{keystore_text(enclave)}'"
        for process in running.in_domain
        if (enclave := process.enclave)
    }
    causes |= {
        name: f"{overridden[name].process.label}: {overridden[name].text}" for name in overridden
    }
    enclaves = ", ".join(f"{name} ({causes[name]})" if name in causes else name for name in absent)
    reasons = [f"no secured process of this robot runs in {enclaves}"] * bool(absent)
    advice = ""
    units = {process.enclave for process in observed.processes if not process.is_by_hand}
    if any(name not in units for name in absent):
        advice = f". Start each process as {robot.commands_file} says"
    stopped = [
        process.unit
        for process in observed.processes
        if process.absent and process.enclave in absent and process.enclave not in overridden
    ]
    if stopped or advice:
        log = robot.log_command(*stopped[:1])
        advice += f". If a process ended, its log says why: {log}"
    if may_end := [name for name in absent if name not in {*has_start, *robot.without}]:
        options = ", ".join(f"--without {name}" for name in may_end)
        advice += f". For a process that does not always run, add its option: {options}"
    if absent and (in_other_domains := running.other_domains_text()):
        advice += f". Also {in_other_domains}"
    for why in dict.fromkeys(why for processes in outdated.values() for _, why in processes):
        pids = {
            name: [str(process.pid) for process, cause in outdated[name] if cause == why]
            for name in outdated
        }
        names = [name for name in missing if pids.get(name)]
        enclaves = ", ".join(
            f"{name} ({'process' if len(pids[name]) == 1 else 'processes'} "
            f"{first_few(pids[name], MOST_NAMES)})"
            for name in names
        )
        texts = [overridden[name].text for name in names if name in overridden]
        if to_restart := [name for name in names if name not in overridden]:
            of_units = units >= {*to_restart}
            texts.insert(0, f"{apply} restarts them" if of_units else "restart them")
        reasons.append(f"{why} the processes of {enclaves}; {'; '.join(texts)}")
    named = {
        pid
        for process in observed.processes
        if process.enclave in absent
        for pid in (process.pid, *process.alike)
    }
    named |= {override.process.program[0] for override in overridden.values()}
    if others := [
        process.label
        for process in running.open_processes
        if not process.is_daemon and process.program[0] not in named
    ]:
        reasons.append(f"also open: {first_few(others, MOST_NAMES)}; stop these processes, too")
    return f"{'; '.join(reasons)}{advice}"
