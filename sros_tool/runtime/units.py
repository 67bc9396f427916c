"""systemd units for nodes that run in their enclaves, and for regular work on a keystore.

A node gets only what a ROS node over DDS or Zenoh needs: sockets of IP, the list of network
interfaces (netlink), shared memory, devices, and its own enclave, but no other enclaves.

Sources: systemd.exec(5), systemd.service(5), systemd.unit(5) of systemd 247 and later.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping, Sequence
from datetime import timedelta
from enum import StrEnum
from pathlib import Path
from typing import NamedTuple

from sros_tool.errors import UsageError
from sros_tool.files import new_files, replace_file, write_new_folder
from sros_tool.owners import other_writers_clause, replaceable_on_the_way
from sros_tool.runtime.environment import render_environment
from sros_tool.runtime.variables import DOMAIN, ENABLE, KEYSTORE, STRATEGY
from sros_tool.validity import duration_text
from sros_tool.values import DryRun, FileChanges, NamedKeystore, Notes
from sros_tool.xml import read_bytes


class WrittenUnits(NamedTuple):
    """The systemd units that were written."""

    keystore: NamedKeystore
    dry_run: DryRun
    enclaves: Sequence[str]
    """The enclaves of the nodes."""
    changes: FileChanges
    notes: Notes


TEMPLATE = "sros@.service"
"""The unit of all nodes; its instance name is an enclave, in the form of `unit_instance`."""

_NODES_FOLDER = "/etc/sros/nodes"
"""Folder with a program for each enclave; the program runs if no command is named."""

METRICS_FILE = "/var/lib/sros-metrics/sros.prom"
FLEET_FILE = "/var/lib/sros-metrics/fleet.prom"

_ORIGIN_COMMENT = (
    "# Made by `sros units`. Change it with `systemctl edit`, which leaves this file as it is."
)
_PLAIN_PATH = re.compile(r"(/(?!\.\.?(/|\Z))[A-Za-z0-9_.][A-Za-z0-9._+-]*)+\Z")
_USER = re.compile(r"[A-Za-z_][A-Za-z0-9_-]{0,30}\Z")

_SANDBOX_SETTINGS = """\
# The process can neither change the system nor gain privileges.
NoNewPrivileges=yes
CapabilityBoundingSet=
ProtectSystem=strict
ProtectHome=read-only
PrivateTmp=yes
ProtectClock=yes
ProtectControlGroups=yes
ProtectHostname=yes
ProtectKernelLogs=yes
ProtectKernelModules=yes
ProtectKernelTunables=yes
LockPersonality=yes
RestrictNamespaces=yes
RestrictSUIDSGID=yes
SystemCallArchitectures=native
SystemCallFilter=@system-service
SystemCallErrorNumber=EPERM
"""


class Job(StrEnum):
    """Work for a keystore or a robot: a guard that always runs, and jobs that timers start."""

    RENEW = "renew"
    CHECK = "check"
    METRICS = "metrics"
    FLEET = "fleet"
    STATUS = "status"
    COLLECT = "collect"
    GUARD = "guard"
    AGENT = "agent"


_OFTEN_SCHEDULE = "*:0/15"
_SCHEDULES = {
    Job.RENEW: "daily",
    Job.CHECK: "daily",
    Job.METRICS: _OFTEN_SCHEDULE,
    Job.FLEET: _OFTEN_SCHEDULE,
    Job.STATUS: "07:00",
    Job.COLLECT: "*:0/5",
}
_RANDOM_DELAYS = {
    Job.RENEW: "1h",
    Job.CHECK: "1h",
    Job.METRICS: "30s",
    Job.FLEET: "30s",
    Job.STATUS: "30s",
    Job.COLLECT: "30s",
}
FLEET_STATUS_JOBS = frozenset({Job.FLEET, Job.STATUS})
"""The jobs that run `sros fleet status`."""
SIGNING_JOBS = frozenset({Job.RENEW, Job.COLLECT})
"""The jobs that need the keys of the CAs."""


def unit_instance(enclave: str) -> str:
    """Return the instance name of an enclave, as `systemd-escape --path` does.

    Of the characters in enclave names (letters, digits, "_" and "/"), only "/" has to be escaped.
    """
    return enclave.strip("/").replace("/", "-") or "-"


def _check_path(path: str, kind: str, option: str = "") -> str:
    """Return ``path`` if all directives of a unit read it in the same way.

    ``option`` is the command-line option that sets the path.

    Raises:
        UsageError: the path is not absolute, or has characters with a meaning in some directives.
    """
    if not _PLAIN_PATH.match(path):
        raise UsageError(
            f"{kind} {path!r} cannot be written in a systemd unit",
            "systemd reads spaces, '%', '$', ':' and quotes in paths in several ways.",
            f"{f'With {option}, name' if option else 'Name'} an absolute path of letters, digits "
            "and /._+- only, without '.' and '..' as parts.",
        )
    return path


def _check_program(path: str) -> str:
    return _check_path(path, "the program", "--sros FILE")


def _check_user(name: str) -> str:
    """Return ``name`` if it is a valid user name.

    Raises:
        UsageError: ``name`` is not a valid user name.
    """
    if not _USER.match(name):
        raise UsageError(f"{name!r} is not the name of a user", "", "Name a user such as ros.")
    return name


def node_template(user: str) -> str:
    """Return the text of `TEMPLATE`, the unit of all nodes.

    Without `node_settings`, which contain the command, the unit starts nothing for an enclave.
    """
    return f"""\
# Runs a node. The instance name is the node's enclave; sros@NAME.service.d/enclave.conf has the
# settings of the enclave, and the command.
{_ORIGIN_COMMENT}
[Unit]
Description=ROS node in enclave %f
# Before the clock is set, a certificate may seem not valid yet. DDS looks for network interfaces
# only once.
Wants=network-online.target time-sync.target
After=network-online.target time-sync.target

[Service]
Type=exec
User={_check_user(user)}
Restart=on-failure
RestartSec=5
UMask=0077
LogsDirectory=sros/%i
LogsDirectoryMode=0700
Environment=ROS_LOG_DIR=%L/sros/%i

{_SANDBOX_SETTINGS}
# DDS lists network interfaces through netlink. /dev stays: it has shared memory, and the devices
# of drivers. Real-time scheduling, which controllers use, is not restricted.
RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_NETLINK

[Install]
WantedBy=multi-user.target
"""


def node_settings(
    enclave: str,
    variables: Mapping[str, str],
    keystore: str,
    *,
    command: Sequence[str] = (),
    below: Iterable[str] = (),
    sros: str = "",
) -> str:
    """Return the settings that an enclave adds to `TEMPLATE`: environment, files and command.

    Args:
        enclave: the name of the enclave.
        variables: the environment variables of the enclave.
        keystore: the path of the keystore.
        command: the command with its arguments; if empty, the program in `_NODES_FOLDER`
            with the path of the enclave.
        below: the enclaves in subfolders of this enclave's folder.
        sros: the path of the program sros, which verifies the enclave before the start; "" for no
            verification.

    Raises:
        UsageError: a path, a word of the command or a variable cannot be written in a systemd unit.
    """
    folder = _check_path(keystore, "the keystore") + "/enclaves"
    place = folder + enclave.rstrip("/")
    program = (
        " ".join(unit_words(command))
        if command
        else f"{_NODES_FOLDER}{enclave.rstrip('/') or '/root'}"
    )
    lines = [
        f"# Enclave {enclave} for {TEMPLATE}.",
        _ORIGIN_COMMENT,
        "[Service]",
        *render_environment(variables, "systemd").splitlines(),
        "# The node sees neither the keys of other enclaves nor the keys of CAs.",
        f"InaccessiblePaths=-{keystore}/private",
    ]
    if place != folder:
        lines += [
            f"TemporaryFileSystem={folder}:ro",
            f"BindReadOnlyPaths=-{folder}/governance.p7s",
            f"BindReadOnlyPaths={place}",
        ]
    lines += [
        f"InaccessiblePaths=-{_check_path(folder + folder_below, 'the folder of an enclave')}"
        for folder_below in below
    ]
    if sros:
        verify = (
            _check_program(sros),
            "verify",
            keystore,
            "--match",
            enclave,
        )
        lines.append(f"ExecStartPre={' '.join(unit_words(verify))}")
    return "\n".join((*lines, f"ExecStart={program}")) + "\n"


def job_units(
    job: Job,
    keystore: str,
    *,
    user: str,
    sros: str,
    passphrase: str = "",
    domain: int = 0,
    writable: Sequence[str] = (),
    inbox: str = "",
    publishing: str = "",
    max_age: timedelta | None = None,
) -> dict[str, str]:
    """Map file names to the texts of a job's service and timer; the guard has no timer.

    Args:
        job: the job.
        keystore: the path of the keystore.
        user: the owner of the keystore.
        sros: the path of the program sros.
        passphrase: the path of the file with the passphrase of the CA keys, or "".
        domain: the ROS domain in which the guard reports open nodes as mistakes.
        writable: folders besides the keystore in which the agent writes.
        inbox: the path of the folder with the messages of robots, for `Job.COLLECT`.
        publishing: the path of the folder in which `Job.COLLECT` publishes releases.
        max_age: the age of a confirmation from which a robot is offline for `Job.FLEET` and
            `Job.STATUS`; None for the default of `sros fleet status`.

    Raises:
        UsageError: a path cannot be written in a systemd unit.
    """
    if job is Job.GUARD:
        return {f"sros-{job}.service": _guard_service(keystore, sros, domain)}
    if job is Job.AGENT:
        return _agent_units(keystore, user=user, sros=sros, writable=writable)
    name = f"sros-{job}"
    root, program = (
        _check_path(keystore, "the keystore"),
        _check_program(sros),
    )
    oldest = ("--max-age", duration_text(max_age)) if max_age else ()
    description, words, own_lines = {
        Job.RENEW: (
            f"Renew the enclaves of {root} that expire soon",
            ("renew", root, "--all-expiring", "soon"),
            [f"ReadWritePaths={root}", "UMask=0077"],
        ),
        Job.CHECK: (
            f"Check the keystore {root}",
            ("check", "keystore", root),
            ["PrivateNetwork=yes"],
        ),
        Job.METRICS: (
            f"Write the metrics of the keystore {root}",
            ("metrics", root, "-o", METRICS_FILE),
            ["PrivateNetwork=yes", "StateDirectory=sros-metrics", "UMask=0022"],
        ),
        Job.FLEET: (
            f"Write the metrics of the fleet of {root}",
            ("fleet", "status", root, *oldest, "--prometheus", "-o", FLEET_FILE),
            [
                "PrivateNetwork=yes",
                "StateDirectory=sros-metrics",
                "UMask=0022",
                "# Status 1: some robots lack the current files. The metrics show this.",
                "SuccessExitStatus=1",
            ],
        ),
        Job.STATUS: (
            f"Fail if something has to be done for the fleet of {root}",
            ("fleet", "status", root, *oldest, "--fail-on", "unmended"),
            ["PrivateNetwork=yes"],
        ),
        Job.COLLECT: (
            f"Collect the messages of the fleet of {root}, and publish its releases",
            ("fleet", "collect", root, inbox, "--publish", publishing),
            [f"ReadWritePaths={root} {publishing}", "UMask=0022"],
        ),
    }[job]
    if job is Job.COLLECT:
        _check_path(inbox, "the inbox")
        _check_path(publishing, "the publishing folder")
    if passphrase and job in SIGNING_JOBS:
        _check_path(passphrase, "the file")
        own_lines += [
            f"LoadCredential=ca-passphrase:{passphrase}",
            f"Environment=SROS_CA_PASSPHRASE_FILE=/run/credentials/{name}.service/ca-passphrase",
        ]
    service = f"""\
{_ORIGIN_COMMENT}
[Unit]
Description={description}
Wants=time-sync.target
After=time-sync.target

[Service]
Type=oneshot
User={_check_user(user)}
ExecStart={" ".join((program, *words))}
{_lines(own_lines)}
{_SANDBOX_SETTINGS}
PrivateDevices=yes
RestrictAddressFamilies=AF_UNIX
"""
    timer = f"""\
{_ORIGIN_COMMENT}
[Unit]
Description={description}

[Timer]
OnCalendar={_SCHEDULES[job]}
RandomizedDelaySec={_RANDOM_DELAYS[job]}
Persistent=yes

[Install]
WantedBy=timers.target
"""
    return {f"{name}.service": service, f"{name}.timer": timer}


def _guard_service(keystore: str, sros: str, domain: int) -> str:
    """Return the service that watches the processes of a machine while the machine runs."""
    root = _check_path(keystore, "the keystore")
    variables = {KEYSTORE: root, ENABLE: "true", STRATEGY: "Enforce", DOMAIN: str(domain)}
    # Only the two capabilities of root that are needed to look at all processes.
    rights = "CapabilityBoundingSet=CAP_SYS_PTRACE CAP_DAC_READ_SEARCH"
    return f"""\
{_ORIGIN_COMMENT}
[Unit]
Description=Watch the ROS processes that the keystore {root} secures on this machine

[Service]
Type=exec
User=root
Restart=always
RestartSec=5
Nice=10
ExecStart={" ".join((_check_program(sros), "check", "runtime", "--watch"))}
{_lines(render_environment(variables, "systemd").splitlines())}
{_SANDBOX_SETTINGS.replace("CapabilityBoundingSet=", rights)}
PrivateDevices=yes
RestrictAddressFamilies=AF_UNIX

[Install]
WantedBy=multi-user.target
"""


def _agent_units(
    folder: str, *, user: str, sros: str, writable: Sequence[str] = ()
) -> dict[str, str]:
    """Map file names to the texts of service and timer of a robot's agent (`sros agent`)."""
    root, program = (
        _check_path(folder, "the security folder"),
        _check_program(sros),
    )
    places = " ".join((root, *(f"-{_check_path(place, 'the inbox')}" for place in writable)))
    description = f"Keep the enclaves in {root} up to date"
    # The agent asks the kernel whether the clock is set, which ProtectClock would forbid.
    closed = _SANDBOX_SETTINGS.replace("ProtectClock=yes\n", "")
    service = f"""\
{_ORIGIN_COMMENT}
[Unit]
Description={description}
Wants=network-online.target time-sync.target
After=network-online.target time-sync.target

[Service]
Type=oneshot
User={_check_user(user)}
Nice=10
TimeoutStartSec=30min
ExecStart={program} agent run {root} --once
# Status 1: something is wrong. The message of the robot, and `sros agent status`, say what.
SuccessExitStatus=1
ReadWritePaths={places}
UMask=0077
{closed}
PrivateDevices=yes
RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6
"""
    timer = f"""\
{_ORIGIN_COMMENT}
[Unit]
Description={description}

[Timer]
# The timer ignores the date, because the clock of a robot may be wrong, or jump.
OnBootSec=1min
OnUnitInactiveSec=5min
RandomizedDelaySec=1min

[Install]
WantedBy=timers.target
"""
    return {"sros-agent.service": service, "sros-agent.timer": timer}


def _lines(lines: Iterable[str]) -> str:
    return "".join(f"{line}\n" for line in lines)


def unit_words(command: Sequence[str]) -> Iterable[str]:
    """Yield the words of a command, quoted so that systemd passes them on unchanged.

    Raises:
        UsageError: the program is not an absolute path, or a word cannot be printed.
    """
    _check_path(command[0], "the command")
    for word in command:
        if not word.isprintable():
            raise UsageError(
                f"the word {word!r} cannot be written in a systemd unit",
                "systemd ends a line at some characters that cannot be printed.",
                f"Put the command into a program, such as {_NODES_FOLDER}/NAME.",
            )
        if re.fullmatch(r"[A-Za-z0-9_/.,:=+@-]+", word):
            yield word
            continue
        quoted = word.replace("\\", "\\\\").replace('"', '\\"')
        yield '"' + quoted.replace("%", "%%").replace("$", "$$") + '"'


def unit_changes(folder: Path, files: Mapping[str, str], *, force: bool) -> dict[str, str]:
    """Map the names of missing files to `create`, and of different files to `replace`.

    Raises:
        UsageError: a file differs, and ``force`` is not set.
    """
    _refuse_folders_of_others(folder, files)
    changes: dict[str, str] = {}
    for path, text in files.items():
        if not os.path.lexists(folder / path):
            changes[path] = "create"
        elif read_bytes(folder / path, "unit") != text.encode():
            changes[path] = "replace"
    different = [path for path, action in changes.items() if action == "replace"]
    if different and not force:
        raise UsageError(
            f"'{folder}' already has other versions of {', '.join(different[:3])}",
            "Nothing was changed.",
            "Add --force to replace these files, or choose another folder.",
        )
    return changes


def _refuse_folders_of_others(folder: Path, files: Iterable[str]) -> None:
    """Raise `UsageError` if another user could change the units, which systemd would run."""
    trusted = frozenset({0, os.geteuid()})
    for place in dict.fromkeys((folder, *((folder / path).parent for path in files))):
        replaceable = [*replaceable_on_the_way(place, trusted)]
        if os.path.lexists(place):
            replaceable.append((place, other_writers_clause(place.lstat(), trusted)))
        for place, why in replaceable:
            if why:
                raise UsageError(
                    f"the units would be in '{place}', which others can change: {why}",
                    "systemd would run what they write there.",
                    "Choose a folder that only you can change, such as /etc/systemd/system.",
                )


def write_units(folder: Path, files: Mapping[str, str], changes: Mapping[str, str]) -> None:
    """Write the files that `unit_changes` returned; without files, do not touch the folder."""
    if not changes:
        return
    new = {path: files[path].encode() for path, action in changes.items() if action == "create"}
    if not folder.exists():
        write_new_folder(folder, new)
        return
    with new_files(folder, new):
        for path, action in changes.items():
            if action == "replace":
                replace_file(folder / path, files[path].encode())
