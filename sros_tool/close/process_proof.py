"""Prove that every process of a robot was started in its enclave."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import replace

from sros_tool.checks.kind import NOTE
from sros_tool.checks.processes import PROCESS_NOT_SEEN, process_findings
from sros_tool.close.processes import ObservedProcesses
from sros_tool.close.robot import OBSERVER
from sros_tool.close.running import RunningRobot, keystore_text
from sros_tool.close.state import Proof
from sros_tool.runtime.variables import ENCLAVE
from sros_tool.wording import counted

CLAIM = "every process was started in its enclave"


def proof_of_processes(running: RunningRobot, number: int) -> Proof:
    """Look for processes that are open, or that something is wrong with."""
    robot = running.robot
    robot.shell.say(
        f'$ eval "$(sros env {shlex.quote(str(robot.export))} {OBSERVER})"; sros check runtime'
    )
    # This shell starts no node.
    here = {**robot.shell.environment, **robot.variables(OBSERVER), ENCLAVE: ""}
    near = tuple(running.in_domain)
    others = [process for process in running.processes.processes if process not in near]
    examined, now = replace(running.processes, processes=near), robot.shell.now()
    findings = [
        finding
        for finding in process_findings(here, examined, now=now, zone=robot.shell.zone)
        if finding.severity > NOTE
    ]
    closed = {tuple(process.command): process.enclave for process in robot.processes.processes}
    other_remedies = {
        process.label: f"Stop it: another process runs in {closed[process.program[1]]}."
        for process in near
        if not process.asks_for_security
        and closed.get(process.program[1]) in running.current_enclaves
    }
    for finding in findings:
        remedy = other_remedies.get(finding.subject, finding.remedy)
        robot.shell.say(f"{finding.subject}: {finding.text}. {remedy}")
    wrong = [finding for finding in findings if finding.id != PROCESS_NOT_SEEN.id]
    if findings:
        first = (wrong or findings)[0]
        return Proof(CLAIM, False if wrong else None, f"{first.subject}: {first.text}")
    known_pids = {process.pid for process, _ in running.secured}
    guests = [
        f"; {process.label} runs in {process.enclave.name} with the files of "
        f"'{keystore_text(process.enclave)}'"
        for process in near
        if process.enclave and process.pid not in known_pids and not process.is_daemon
    ]
    guests += [
        f"; {process.label} runs open in domain {process.domain}"
        for process in others
        if not (process.enclave or process.network or process.is_daemon)
    ]
    summary = f"{counted(number, 'enclave')}, and no open process in domain {robot.domain}"
    return Proof(CLAIM, True, f"{summary}{''.join(guests)}")


def why_missing(running: RunningRobot, missing: Sequence[str], observed: ObservedProcesses) -> str:
    """Return which enclaves have no process, or an open one, and what the others lack."""
    robot = running.robot
    wrong = {
        enclave.name: (process, running.why_not_current(process, enclave))
        for process, enclave in running.secured
        if enclave.name in missing
    }
    are_open = {process.enclave: process.pid for process in observed.processes if process.pid}
    absent = [name for name in missing if name not in wrong]
    others = {name: f"stop process {pid}, which is open" for name, pid in are_open.items()}
    others |= {
        enclave.name: f"{process.label} has the files of '{keystore_text(enclave)}'"
        for process in running.in_domain
        if (enclave := process.enclave)
    }
    named = ", ".join(f"{name} ({others[name]})" if name in others else name for name in absent)
    reasons = [
        f"no secured process of {named}; start it as {robot.commands_file} says; "
        f"if it ended: sros explain {shlex.quote(str(robot.export))} --log ITS_LOG"
    ] * bool(absent)
    if may_end := [name for name in absent if name not in {*are_open, *robot.without}]:
        options = " ".join(f"--without {name}" for name in may_end)
        reasons.append(f"if it does not always run, add {options}")
    if absent and (in_others := running.in_other_domains()):
        reasons.append(in_others)
    for why in dict.fromkeys(why for _, why in wrong.values()):
        named = ", ".join(
            f"{name} (process {wrong[name][0].pid})"
            for name in missing
            if name in wrong and wrong[name][1] == why
        )
        reasons.append(f"{why} the processes of {named}; restart them")
    return "; ".join(reasons)
