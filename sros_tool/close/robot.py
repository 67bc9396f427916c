"""The robot of this machine, the folder into which it is closed, and its observed processes."""

from __future__ import annotations

import fcntl
import json
import os
import shlex
from collections.abc import Callable, Collection, Iterable, Iterator, MutableMapping, Sequence
from contextlib import contextmanager
from datetime import datetime, tzinfo
from pathlib import Path
from typing import Any, NamedTuple

from sros_tool.checks.environment import security_clauses
from sros_tool.close.processes import ROUTER, ObservedProcesses, read_processes
from sros_tool.enclave_environment import loadable_environment
from sros_tool.errors import SrosError, UnavailableError, UsageError
from sros_tool.files import replace_file
from sros_tool.folders import make_folders, remove_folders
from sros_tool.keystore.layout import (
    CLOSED_KEYSTORE,
    CLOSED_OBSERVATION,
    CLOSED_OBSERVER,
    CLOSED_POLICY,
    CLOSED_PROCESSES,
    ENCLAVES,
    PRIVATE,
    enclave_path,
    list_enclaves,
)
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.owners import other_writers_clause, replaceable_on_the_way, user_name
from sros_tool.policy.document import read_policy
from sros_tool.policy.model import Policy
from sros_tool.runtime.environment import RMW_ZENOH
from sros_tool.runtime.rmw import RMW, built_without_security, default_rmw
from sros_tool.runtime.unit_properties import log_file_of_unit
from sros_tool.runtime.variables import domain_of
from sros_tool.validity import time_of_file
from sros_tool.values import as_plain
from sros_tool.wording import first_few

REQUIREMENTS, TEMPLATE, OBSERVER = "requirements.toml", "production", CLOSED_OBSERVER
MOST_NAMES = 3
"""Number of names that a text lists before it counts the others."""


class Shell(NamedTuple):
    """The functions and values of the command line that closing a robot needs.

    ``run`` runs a verb of sros, and returns its status, its output and its messages; if its second
    argument is True, the verb prints output and messages itself.  ``say`` shows progress.
    ``environment`` has the variables of the shell, and ``zone`` is the time zone of this machine.
    """

    run: Callable[[Sequence[str], bool], tuple[int, str, str]]
    say: Callable[[str], None]
    environment: MutableMapping[str, str]
    now: Callable[[], datetime]
    zone: tzinfo

    def say_lines(self, text: str) -> None:
        """Show the lines of a text."""
        for line in text.splitlines():
            self.say(line)

    def read_json(self, words: Sequence[str], without: Collection[str] = ()) -> tuple[int, Any]:
        """Show and run a verb ``without`` variables; return its status and the JSON it prints."""
        unset = "".join(f"-u {name} " for name in without)
        self.say(f"+ {f'env {unset}' if unset else ''}sros {shlex.join(words)}")
        removed = {name: self.environment.pop(name) for name in without}
        try:
            status, output, _ = self.run(words, False)
        finally:
            self.environment.update(removed)
        return status, json.loads(output)

    def check(self, *words: str) -> int:
        """Run `check`, show what it says if it finds an error, and return its status."""
        command = ("check", *words, "--fail-on", "error")
        self.say(f"+ sros {shlex.join(command)}")
        status, output, messages = self.run(command, False)
        self.say_lines(f"{output}{messages}" if status else "")
        return status

    def check_open(self) -> None:
        """Raise `UsageError` if an observer that this shell starts might run secured."""
        if secured := [*security_clauses(self.environment, Path.cwd())]:
            raise UsageError(
                f"{' and '.join(secured)}, so this shell does not see an open robot",
                "sros looks for open nodes with an observer that is open itself.",
                "Unset the variables in this message, for example with `env -u NAME sros close "
                "...`; if the message names a file in this folder, run sros in another folder.",
            )


class LocalRobot:
    """The robot of this machine, with the folder into which it is closed.

    ``without``, ``elsewhere``, ``here`` and ``brought`` are the enclaves that these options name.

    Raises:
        SrosError: other users can change the files in the folder, which say what systemd starts; or
            a file in the folder is broken.
    """

    def __init__(
        self,
        folder: Path,
        domain: int | None,
        shell: Shell,
        without: Iterable[str] = (),
        elsewhere: Iterable[str] = (),
        here: Iterable[str] = (),
        brought: Iterable[str] = (),
    ) -> None:
        self.folder, self.shell, self.without = folder, shell, sorted({*without})
        self.named_elsewhere, self.named_here = sorted({*elsewhere}), sorted({*here})
        self.named_brought = sorted({*brought})
        self.close_command = f"sros close {shlex.quote(str(folder))}"
        self.policy, self.observer = folder / CLOSED_POLICY, folder / "observer.xml"
        self.requirements = folder / REQUIREMENTS
        self.keystore, self.export = folder / CLOSED_KEYSTORE, folder / "export"
        self.start, self.page = folder / "start", folder / "rights.html"
        self.commands_file = self.start / "commands.txt"
        self.observation_file = folder / CLOSED_OBSERVATION
        self.processes_file = folder / CLOSED_PROCESSES
        self.observed_policy = folder / "seen.xml"
        self._chosen_domain = domain
        self._check_writers()
        self._read_processes()

    def _read_processes(self) -> None:
        """Set the observed processes (None if the robot was not watched), and the ROS domain.

        Raises:
            UsageError: the robot was watched in another domain than the chosen one.
        """
        is_watched, chosen = self.processes_file.exists(), self._chosen_domain
        self.observed = read_processes(self.processes_file) if is_watched else None
        default = domain_of(self.shell.environment) if chosen is None else chosen
        self.domain = self.observed.domain if self.observed else default
        if chosen not in (None, self.domain):
            raise UsageError(
                f"the robot was watched in domain {self.domain}, not {chosen}",
                "",
                "Close each domain into a folder of its own.",
            )

    def _check_writers(self) -> None:
        """Raise `SrosError` if other users can change the files in the folder.

        Whoever runs sros by sudo is trusted, as root is.
        """
        sudo = self.shell.environment.get("SUDO_UID", "") if os.geteuid() == 0 else ""
        trusted = frozenset({0, os.geteuid(), *([int(sudo)] if sudo.isdecimal() else [])})
        policies = (self.policy, self.observer, self.requirements)
        files = (*policies, self.observation_file, self.processes_file)
        for path in (self.folder, self.start, self.start / "units", *files):
            ways = [*replaceable_on_the_way(path, trusted)]
            if path.exists() and (why := other_writers_clause(path.stat(), trusted)):
                ways.insert(0, (path, why))
            for place, why in ways:
                raise SrosError(
                    f"others can change '{path}'",
                    f"'{place}': {why}.",
                    "Give `sros close` a folder that only you and root can change.",
                )

    def check_units_folder(self) -> None:
        """Raise `SrosError` if others, also the user of sudo, can change the drop-ins of units."""
        trusted = frozenset({0, os.geteuid()})
        for place, why in replaceable_on_the_way(self.start / "units/UNIT", trusted):
            remedy = "Choose a folder that only root can change, such as /opt/robot."
            if self.policy.exists():
                old, new = shlex.quote(str(self.folder)), "/opt/robot"
                remedy = (
                    f"Move '{self.folder}' into a folder that only root can change, such as /opt: "
                    f"`sudo cp -a {old} {new}`, `sudo chown -R root: {new}`; then run "
                    f"`sros close {new}` as root, and delete {old}, which has the keys, too."
                )
            raise SrosError(
                f"others can change '{self.folder}'",
                f"'{place}': {why}. Root would let systemd run what they write there.",
                remedy,
            )

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Let only one run at a time write into the folder, which is made if it is missing.

        A new folder that stays empty is removed again.

        Raises:
            UnavailableError: another run writes into the folder.
        """
        made = make_folders(self.folder)
        handle = os.open(self.folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise UnavailableError(
                    f"another `{self.close_command}` is at work",
                    "The other command would overwrite what this command writes.",
                    "Wait for it, or end it. --proof and --dry-run work meanwhile.",
                ) from None
            except OSError:  # a file system without locks
                pass
            self._read_processes()  # another run may have written them meanwhile
            yield
        finally:
            os.close(handle)
            remove_folders(made)

    @property
    def processes(self) -> ObservedProcesses:
        """The observed processes; none if the robot was not watched."""
        return self.observed or ObservedProcesses(self.domain)

    @property
    def not_here(self) -> set[str]:
        """The enclaves that belong to other machines."""
        return {*self.named_elsewhere, *self.processes.not_here}.difference(self.named_here)

    def rmws_without_security(self) -> list[str]:
        """Return the RMWs that the observed processes use and that were built without security."""
        environment = self.shell.environment
        default = default_rmw(environment)
        rmws = sorted({process.rmw or default for process in self.processes.processes})
        return [rmw for rmw in rmws if built_without_security(rmw, environment)]

    @property
    def rights_source(self) -> Path:
        """The keystore, or the policy if the keystore was brought to another machine."""
        return self.keystore if self.keystore.exists() else self.policy

    @property
    def revoking_advice(self) -> str:
        """A clause on enclaves of the keystore that the policy does not have."""
        return f"`{self.close_command}` says how to revoke or keep such an enclave"

    def log_command(self, unit: str = "") -> str:
        """Return the command that explains the log of a unit, or of a process without a unit."""
        explain = f"sros explain {shlex.quote(str(self.export))} --log"
        if file := log_file_of_unit(unit) if unit else "ITS_LOG":
            return f"`{explain} {shlex.quote(file)}`"
        return f"`journalctl -n 100 -u {shlex.quote(unit)} | {explain} -`"

    def read_policy(self) -> Policy | None:
        """Return the policy; None if there is none yet."""
        return read_policy(self.policy) if self.policy.exists() else None

    def policy_enclaves(self) -> set[str]:
        """Return the names of the enclaves in the policy; none without a policy."""
        policy = self.read_policy()
        return {enclave.path for enclave in policy.enclaves} if policy else set()

    def keystore_enclaves(self) -> set[str]:
        """Return the names of the enclaves in the keystore; none without a keystore."""
        return {*(list_enclaves(self.keystore) if self.keystore.exists() else ())}

    def enclaves_outside_policy(self) -> list[str]:
        """Return the enclaves of the keystore, of any machine, that the policy does not have.

        Without a policy file, the result is empty.
        """
        if not self.policy.exists():
            return []
        known = {OBSERVER, ROUTER, *self.policy_enclaves()}
        return sorted(self.keystore_enclaves() - known)

    def export_words(self) -> Sequence[str]:
        """Return the verb, with its arguments, that exports the enclaves of this machine."""
        enclaves = ["--all"]
        if self.not_here:
            names = {OBSERVER} | self.keystore_enclaves() | self.policy_enclaves()
            enclaves = sorted(names - self.not_here)
        return ("distribute_key", str(self.keystore), *enclaves, str(self.export), "--force")

    def write_processes(self, observed: ObservedProcesses) -> None:
        """Write the observed processes into the folder."""
        self.observed = observed
        content = f"{json.dumps(as_plain(observed), indent=2)}\n"
        replace_file(self.processes_file, content.encode())

    def as_root(self, option: str) -> str:
        """Return how root runs `sros close` with ``option``, from the beginning if need be.

        Root goes on in this folder only if the folder belongs to root.
        """
        shell = "in a root shell (`sudo -s`) in which ROS 2 and sros are set up"
        if self.folder.exists() and self.folder.stat().st_uid == 0:
            return f"`{self.close_command}{option and f' {option}'}` {shell}"
        other = "or another folder of root that the users of the nodes can enter"
        return f"`sros close /opt/robot` ({other}) {shell}"

    def check_keystore(self, option: str) -> None:
        """Raise `UnavailableError`, with the command to run, if this user cannot read the keystore.

        ``option`` is the option of `sros close`, or "".
        """
        folders = (self.keystore, self.keystore / PRIVATE, self.keystore / ENCLAVES)
        if not any(path.exists() and not os.access(path, os.R_OK | os.X_OK) for path in folders):
            return
        if owner := self.keystore.stat().st_uid:
            how = f"`{self.close_command}{option and f' {option}'}` as {user_name(owner)}"
        else:
            how = self.as_root(option)
        raise UnavailableError(
            f"this user cannot read the keystore '{self.keystore}'",
            f"It belongs to {user_name(owner)}, and has the CA keys: do not give it to the user of "
            "the nodes.",
            f"Run {how}.",
        )

    def check_machines(self) -> None:
        """Raise `UsageError` if --elsewhere or --here names an enclave that is not to be moved.

        Such an enclave is unknown, is named by both options, or already belongs to this machine.
        """
        known = (self.keystore_enclaves() - {OBSERVER}) | self.policy_enclaves()
        check_enclaves(self.named_elsewhere, known, "--elsewhere")
        check_enclaves(self.named_here, known, "--here")
        if both := {*self.named_here}.intersection(self.named_elsewhere):
            raise UsageError(f"--elsewhere and --here both name {min(both)}", "", "Choose one.")
        if already := sorted({*self.named_here}.difference(self.processes.not_here)):
            raise UsageError(
                f"{already[0]} already belongs to this machine",
                "",
                f"Leave --here out; `{self.close_command}` exports the enclave.",
            )

    def changed_at(self, enclave: str) -> datetime | None:
        """Return when an enclave's files in the keystore last changed; None without files."""
        folder = enclave_path(self.keystore, enclave)
        times = [file.stat().st_mtime for file in folder.glob("*") if file.is_file()]
        return time_of_file(max(times)) if times else None

    def brought_now(self) -> dict[str, str]:
        """Map the enclaves of --brought to when their files in the keystore changed last.

        Raises:
            UsageError: an enclave belongs to this machine, or the keystore has no files of it.
        """
        brought = {}
        for name in self.named_brought:
            changed = self.changed_at(name) if name in self.not_here else None
            if changed is None:
                raise UsageError(
                    f"--brought cannot name {name}",
                    f"Either it belongs to this machine, or '{self.keystore}' has no files of it.",
                    f"First run `{self.close_command} --elsewhere {name}`, and bring the files.",
                )
            brought[name] = changed.isoformat()
        return brought

    def check_rmw(self) -> None:
        """Raise `UsageError` if the robot runs on Zenoh and this shell uses DDS, or the reverse."""
        rmws = {process.rmw for process in self.processes.processes}
        is_on_zenoh, shell_is = RMW_ZENOH in rmws, self.shell.environment.get(RMW) == RMW_ZENOH
        if rmws and is_on_zenoh != shell_is:
            used, other = (RMW_ZENOH, "DDS") if is_on_zenoh else ("DDS", RMW_ZENOH)
            rmw = RMW_ZENOH if is_on_zenoh else min(rmws - {""}, default="")
            raise UsageError(
                f"this robot runs on {used}",
                f"An observer that this shell starts would look for it on {other}.",
                f"Set {RMW}={rmw}." if rmw else f"Unset {RMW}, as when the robot was watched.",
            )

    def variables(self, enclave: str, rmw: str = "") -> dict[str, str]:
        """Return the environment of an enclave of the export."""
        shell, domain = self.shell, str(self.domain)
        return loadable_environment(
            OpenedKeystore(self.export),
            enclave,
            domain,
            rmw or None,
            environment=shell.environment,
            now=shell.now(),
            zone=shell.zone,
        ).variables


def check_enclaves(names: Iterable[str], known: Collection[str], option: str) -> None:
    """Raise `UsageError` if ``names``, from an ``option``, has an enclave that is not ``known``."""
    if unknown := sorted({*names}.difference(known)):
        raise UsageError(
            f"the robot has no enclave {unknown[0]}",
            f"It has {first_few(sorted(known), MOST_NAMES)}.",
            f"Correct {option}.",
        )
