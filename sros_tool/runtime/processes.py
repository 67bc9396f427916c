"""The running processes that use ROS 2, DDS or Zenoh, as /proc shows them, and their files.

A process is recognized by the libraries that it has mapped, by ``--ros-args``, or by its program. A
process itself chooses the texts that /proc shows (its command, environment, and mapped files), even
after its start. So the length of every text is limited, and texts are read through a handle of the
process's folder, which never becomes a handle of another process's folder.  A process that links
its DDS statically and has no arguments of ROS is not recognized; a process that cannot be examined
is reported.

If a process has its own root directory or mounts, as in a container, the paths that it names can
mean other files for sros. So paths are resolved below the root directory of the process, part by
part, and no link can lead out of this directory.  Only regular files are opened for reading, never
pipes or devices.  The time of a file's last status change (st_ctime) shows that it was replaced:
the kernel sets this time by its own clock, and copying programs can preserve other times, but not
this time.
"""

from __future__ import annotations

import errno
import os
import re
import stat
import struct
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from functools import cache, partial
from itertools import pairwise, takewhile
from pathlib import Path
from typing import NamedTuple

from sros_tool.owners import link_of_stranger, other_writers_clause
from sros_tool.runtime.cyclone import ENCLAVE_FILES
from sros_tool.runtime.environment import (
    NO_CONFIGURATION,
    RMW_ZENOH,
    ROS_ARGS,
    ROUTER_URI,
    SESSION_URI,
    enclave_argument,
)
from sros_tool.runtime.rmw import DEFAULT_RMW, RMW, middleware_of
from sros_tool.runtime.variables import DOMAIN, ENABLE, ENCLAVE, KEYSTORE

_LIBRARIES = re.compile(
    rb"/(lib(?:rcl|rmw_[a-z0-9_]+?|ddsc|dds_security_auth|fastrtps|fastdds|nddsc|nddscore"
    rb"|OpenDDS_Dcps|zenohc|zenohpico)|zenoh)(?:-[0-9a-f]{6,40})?(?:\.abi3|\.cpython-[\w-]+)?\.so"
)
_DDS_LIBRARIES = re.compile(
    rb"^[^/\n]*(/(?:[^\n]*/)?lib(fastrtps|fastdds|ddsc)(?:-[0-9a-f]{6,40})?"
    rb"(?:\.abi3|\.cpython-[\w-]+)?\.so[^/\n]*?)( \(deleted\))?$",
    re.MULTILINE,
)
"""Matches a mapped DDS library at a line's start: a process may map thousands of files."""
_MEMORY_PORTS = re.compile(
    rb"^\S+ \S+ \S+ (\S+) (\d+) +/[^\n]*/fast(?:rtps|dds)_port(\d{1,5})$", re.MULTILINE
)
"""Matches a port of Fast DDS in shared memory that is mapped, and not deleted."""
_DELETED_MEMORY = re.compile(
    rb"/fast(?:rtps|dds)_(port\d{1,5}|[0-9a-f]{16}) \(deleted\)$", re.MULTILINE
)
"""Matches a port, or a segment with messages, of Fast DDS that is mapped and was deleted."""
_OWN_MEMORY = re.compile(r"/fast(?:rtps|dds)_(port\d{1,5}|[0-9a-f]{16})_el(?: \(deleted\))?\Z")
"""Matches the file that a process keeps locked while only it uses a port or segment."""
_FIRST_PORT, _PORTS_OF_DOMAIN, _FIRST_OF_PARTICIPANT = 7400, 250, 11
"""The port for user data of participant N in domain D is 7400 + 250 * D + 11 + 2 * N; the port for
discovery by multicast is 7400 + 250 * D (DDSI-RTPS 2.5, 9.6.2.3)."""
_LAST_DOMAIN = 101
"""Linux gives any program the ports above this domain's (ip_local_port_range)."""
_PRODUCTS = {b"fastrtps": "Fast DDS", b"fastdds": "Fast DDS", b"ddsc": "Cyclone DDS"}
_THREE_NUMBERS = re.compile(r"\.so\.(\d+\.\d+\.\d+)(?:\.\d+)?\Z", re.ASCII)
_MOST_ENTRIES = 10_000
_MOST_COPIES_SOUGHT = 20
"""Maximum number of libraries of a process for which copies are searched to find the version."""
_DAEMON, _DAEMON_MODULE = "_ros2_daemon", "ros2cli.daemon"
"""The script of the ros2 daemon in ROS 2 Foxy, and the module that later releases run."""
_ZENOHD = "zenohd"
"""The Zenoh router without rmw_zenoh, which does not read the variables of rmw_zenoh."""
_ROUTERS = ("rmw_zenohd", _ZENOHD)
_BRIDGES = ("zenoh-bridge-ros2dds", "zenoh-bridge-dds")
_DEMO_MODULE = re.compile(r"sros_tool\.demo\.(?:cyclone|ros|zenoh)_node")
_DEMO_TYPE = "std_msgs/msg/String"
"""The type of messages without --type (an option that only some nodes of the demo take)."""
_INTERPRETER = re.compile(r"(?:python[\d.]*|sh|bash|dash|perl|ruby|node)\Z")
_PYTHON_FLAGS = re.compile(r"-[BEIOPbdiqsuvx]+\Z")
"""Python options without a value (such as -u); some of them are also options of shells."""
_SCRIPTS_OF_SROS = ("sros", "sros_tool")

_SHORTEST_LOADING_TIME = timedelta(milliseconds=20)
"""Shortest time from a process's start (known in steps of 10 ms) to loading its enclave."""
_CLOCK_TOLERANCE = timedelta(seconds=1)
"""Maximum time by which a process's folder can seem older than the process, if no clock was set."""
_LONGEST_TIME_TO_FIRST_LOOK = timedelta(minutes=1)
"""Maximum time from the start to the first look, for the process that was seen soonest."""
_MOST_BYTES = 4 * 1024 * 1024
_MOST_MAPS = 32 * 1024 * 1024
_MOST_TRIES = 3
_KERNEL_THREAD = 0x00200000
_DOMAIN_NUMBER = re.compile(r"\s*([+-]?)(0[xX][0-9a-fA-F]+|0[0-7]*|[1-9][0-9]*)", re.ASCII)
_LONGEST_NUMBER = 100
_LONGEST_TEXT = 40


class MappedLibrary(NamedTuple):
    """A DDS library that a process has mapped.

    ``version`` has three numbers, or is "" if the file's name does not show it.  ``path`` is the
    path as the process sees it.  ``replaced`` says that the path now has another file or no file.
    """

    product: str
    version: str
    path: str
    replaced: bool = False

    @property
    def is_packaged(self) -> bool:
        """Whether the library is from a Debian or Ubuntu package, which can have later fixes."""
        return self.path.startswith(("/usr/lib/", "/lib/"))


class MemoryPort(NamedTuple):
    """A port of Fast DDS in shared memory.

    ``number`` is its port number. ``memory`` is the file system of the shared memory, and ``file``
    is the inode there: after a process opens the port again, the inode is another one.
    """

    number: int
    memory: str
    file: int

    @property
    def domain(self) -> int | None:
        """The ROS domain whose data a process receives on the port; None for other ports."""
        domain, offset = divmod(self.number - _FIRST_PORT, _PORTS_OF_DOMAIN)
        is_for_data = offset >= _FIRST_OF_PARTICIPANT and offset % 2
        return domain if domain >= 0 and is_for_data else None


@dataclass(frozen=True, slots=True)
class Process:
    """A running process that uses ROS 2, DDS or Zenoh.

    ``started`` is the earliest moment at which the process can have loaded its files, by the clock
    of that moment; ``clock_advance`` is the time by which the clock was set forward since then,
    which makes ``started`` too early by a minute or more. ``libraries`` are the names of mapped
    libraries of ROS 2, DDS and Zenoh, such as "libddsc", and ``dds`` the DDS libraries with their
    versions.
    ``network`` names the network namespace; "" is the namespace of sros. ``enclave`` is the enclave
    that the process names, if it asks for security, and ``configuration`` the Zenoh configuration
    that the process names. ``forked_by`` are the id and command of the first process of the same
    program, if that process started this one. ``own_pid`` is the id that the process itself sees;
    in a container, this id differs from ``pid``. ``user`` is the id of the user who runs the
    process; for a set-user-ID program, of the user who started it; `SEVERAL_USERS` if several users
    can control the process. ``own_ports`` are the ports of Fast DDS that only this process reads,
    and ``mapped_ports`` also those to which it has sent. ``lost_memory`` says that files of its own
    shared memory were deleted, so that no other process of Fast DDS can open them. ``is_stopped``
    says that it was stopped, as by SIGSTOP, and does nothing until it continues. ``domains`` are
    the ROS domains that its ports show, which may be more than the domain that it names: a program
    can join others, and need not secure itself there.
    """

    pid: int
    command: tuple[str, ...]
    environment: Mapping[str, str]
    started: datetime
    libraries: frozenset[str] = frozenset()
    user: int = 0
    network: str = ""
    enclave: ProcessEnclave | None = None
    configuration: LoadedFile | None = None
    dds: tuple[MappedLibrary, ...] = ()
    forked_by: tuple[int, tuple[str, ...]] = (0, ())
    own_pid: int = 0
    clock_advance: timedelta = timedelta()
    own_ports: frozenset[MemoryPort] = frozenset()
    mapped_ports: frozenset[MemoryPort] = frozenset()
    lost_memory: bool = False
    is_stopped: bool = False
    domains: frozenset[int] = frozenset()

    @property
    def program(self) -> tuple[int, tuple[str, ...]]:
        """The id and the command of the process that somebody has to start to get this process."""
        return self.forked_by if self.forked_by[0] else (self.pid, self.command)

    @property
    def label(self) -> str:
        """The name of the process in messages, such as "process 4711 (talker)"."""
        return f"process {self.pid} ({program_of(self.command)})"

    @property
    def asks_for_security(self) -> bool:
        """Whether the process runs with ROS_SECURITY_ENABLE=true."""
        return self.environment.get(ENABLE) == "true"

    @property
    def domain(self) -> str:
        """The ROS domain that the process names, as a number; see `domain_text`."""
        return domain_text(self.environment.get(DOMAIN, ""))

    @property
    def further_domains(self) -> Sequence[int]:
        """The ROS domains in which the process is, besides the domain that it names."""
        return sorted(number for number in self.domains if str(number) != self.domain)

    @property
    def rmw(self) -> str:
        """The RMW of the process.

        A mapped RMW that sros does not know comes first, then the RMW of the mapped middleware,
        then the RMW that the process names.
        """
        named = self.environment.get(RMW, "")
        for library in sorted(self.libraries):
            name = library.removeprefix("lib")
            is_rmw = name.startswith("rmw_") and not name.startswith(_PARTS_OF_RMWS)
            if is_rmw and not middleware_of(name):
                return name
        mapped = {rmw for library, rmw in _RMW_OF.items() if library in self.libraries}
        if len(mapped) == 1 and not any(named.startswith(path) for path in mapped):
            return f"{mapped.pop()}_cpp"
        return named or DEFAULT_RMW

    @property
    def is_zenoh(self) -> bool:
        """Whether the process uses Zenoh, by rmw_zenoh or without an RMW."""
        return self.rmw.startswith(RMW_ZENOH) or self.is_router

    @property
    def is_router(self) -> bool:
        """Whether the process is a Zenoh router, by its program or by its environment.

        In the environment that ``sros run`` gives a router, no session of rmw_zenoh starts.
        """
        uris = self.environment.get(SESSION_URI), self.environment.get(ROUTER_URI, "")
        is_no_session = uris[0] == NO_CONFIGURATION and uris[1] not in ("", NO_CONFIGURATION)
        return (
            self.demo_command[2:] == ("router",)
            or (is_no_session and self.rmw.startswith(RMW_ZENOH))
            or not _programs_in(self.command).isdisjoint(_ROUTERS)
        )

    @property
    def is_without_rcl(self) -> bool:
        """Whether the process uses DDS without rcl, which reads the variables of security.

        The nodes of the demo read these variables themselves, so the result is False for them.  A
        process counts as such a node only if Python itself runs the node's module.
        """
        flags = list(takewhile(lambda word: word.startswith("-"), self.command[1:]))
        module = "".join(self.command[len(flags) + 1 : len(flags) + 2])
        is_python = Path(self.command[0] if self.command else "").name.startswith("python")
        is_demo = is_python and flags[-1:] == ["-m"] and bool(_DEMO_MODULE.fullmatch(module))
        return bool(self.libraries & _DDS_NAMES) and "librcl" not in self.libraries and not is_demo

    @property
    def other_dds(self) -> Sequence[str]:
        """The paths of the DDS libraries that a process of rcl has mapped, except that of its RMW.

        The program itself uses these libraries, as SDKs of robots do, and rcl does not secure them.
        """
        own = middleware_of(self.rmw)
        if own is None or "librcl" not in self.libraries:
            return ()
        of_rcl = next((library for library in self.dds if library.product == own.name), None)
        return [library.path for library in self.dds if library is not of_rcl]

    @property
    def demo_command(self) -> tuple[str, ...]:
        """The `sros demo` command that started this node or router; () for other processes.

        The node's own command cannot be used again, because it names an open file descriptor.
        """
        words = self.command
        for flag, module, role in zip(words, words[1:], words[2:], strict=False):
            if flag == "-m" and _DEMO_MODULE.fullmatch(module):
                is_by_hand = role == "router" or "--by-hand" in words
                options = [
                    word
                    for pair in pairwise(words)
                    if pair[0] in ("--topic", "--type") and pair[1] != _DEMO_TYPE
                    for word in pair
                ]
                return ("sros", "demo", role, *options) if is_by_hand else ()
        return ()

    @property
    def is_daemon(self) -> bool:
        """Whether the process is the ros2 daemon."""
        return _is_daemon(self.command)


def domain_text(variable: str) -> str:
    """Return the ROS domain that ``variable``, a value of ROS_DOMAIN_ID, names, in digits.

    rcl reads the value with strtoul(3), which accepts 0x39, and ignores what follows a number other
    than 0. DDS keeps 32 bits of the number. A value that rcl refuses is returned in quotes, safe to
    print.
    """
    number = _DOMAIN_NUMBER.match(variable or "0", 0, _LONGEST_NUMBER)
    if number is not None:
        digits = number[2].lower()
        base = 16 if digits.startswith("0x") else 8 if digits.startswith("0") else 10
        value = int(digits, base)
        if value < _NUMBERS and (value or not variable[number.end() :]):
            value = -value % _NUMBERS if number[1] == "-" else value
            # The highest number stands for the default domain.
            return str(value % 2**32 if value != _NUMBERS - 1 else 0)
    return f"'{plain(variable)}'"


_NUMBERS = 2**64
"""Number of the values of strtoul(3)."""
_RMW_OF = {
    "libddsc": "rmw_cyclonedds",
    "libfastrtps": "rmw_fastrtps",
    "libfastdds": "rmw_fastrtps",
    "libnddsc": "rmw_connextdds",
    "libOpenDDS_Dcps": "rmw_opendds",
    "libzenohc": "rmw_zenoh",
    "zenoh": "rmw_zenoh",
    "libzenohpico": "rmw_zenoh",
}
_PARTS_OF_RMWS = ("rmw_implementation", "rmw_dds_common", "rmw_security_common")
"""Beginnings of the names of libraries that belong to no RMW, or to several."""
_DDS_NAMES = frozenset(library for library, rmw in _RMW_OF.items() if rmw != "rmw_zenoh")


class UnseenProcess(NamedTuple):
    """A process that could not be examined; ``why`` is a clause.

    ``uses_ros`` is true if the command shows that the process uses ROS 2 or Zenoh; false means
    unknown.
    """

    pid: int
    command: tuple[str, ...]
    why: str
    uses_ros: bool

    @property
    def label(self) -> str:
        """The name of the process in messages, such as "process 4711 (talker)"."""
        return f"process {self.pid} ({program_of(self.command)})"


@dataclass(frozen=True, slots=True)
class RunningProcesses:
    """The processes that use ROS 2, and the processes that could not be examined.

    Processes that only wait for another process are left out.  ``hidden`` is a clause on the
    processes that /proc does not show, or "".  ``is_in_container`` says that sros can see only the
    processes of its container, and ``is_run_by_root`` that sros runs as root.
    """

    processes: tuple[Process, ...] = ()
    unseen: tuple[UnseenProcess, ...] = ()
    hidden: str = ""
    is_in_container: bool = False
    is_run_by_root: bool = False


def boot_id(proc: Path = Path("/proc")) -> str:
    """Return the random id of this boot of the machine; "" if the kernel shows no id."""
    try:
        return (
            (proc / "sys/kernel/random/boot_id").read_text(errors="replace").strip()[:_LONGEST_TEXT]
        )
    except OSError:
        return ""


def start_of(pid: int) -> str:
    """Return the id of this boot, and the clock ticks from the boot to the start of a process.

    Together with the id of the process, this identifies the process.  The result is "" if no such
    process runs, or sros cannot see it.
    """
    with suppress(OSError), _opened(f"/proc/{pid}") as folder:
        return f"{boot_id()} {_stat(folder).ticks}"
    return ""


def plain(text: str, longest: int = _LONGEST_TEXT) -> str:
    """Return a text that a process chose, shortened and escaped for messages."""
    return re.sub(r"[^\w.+/ -]", "?", text[:longest])


def program_of(command: tuple[str, ...]) -> str:
    """Return the name of a command's program, or of the script or module that the program runs.

    The result is "?" for an empty command.
    """
    name, *words = (Path(command[0]).name, *command[1:]) if command else ("",)
    if _INTERPRETER.match(name):
        while words and _PYTHON_FLAGS.match(words[0]):
            del words[0]
        if words[:1] == ["-m"] and len(words) > 1:
            name = words[1]
        elif words and not words[0].startswith("-"):
            name = Path(words[0]).name
    return plain(name or "?")


class _Stat(NamedTuple):
    """Values in /proc/PID/stat.

    ``parent`` is the id of the parent process, ``ticks`` the start of the process in clock ticks
    after the start of the machine, and ``size`` the size of the virtual memory in bytes.
    ``identity`` changes when the process runs another program.  ``is_idle`` is true for a process
    that has ended and for a part of the kernel, and ``is_stopped`` for a process that a signal
    stopped.
    """

    parent: int
    ticks: int
    identity: tuple[str, ...]
    size: str
    is_idle: bool
    is_stopped: bool


class _ProcessData(NamedTuple):
    """The data read of a process, which is valid as long as ``stat`` does not change."""

    stat: _Stat
    process: Process | None
    unseen: UnseenProcess | None


class ProcessTable:
    """A reader of the processes in /proc, which reads a process again only after a change."""

    def __init__(self, proc: Path = Path("/proc")) -> None:
        self._proc = proc
        self._looked: dict[int, _ProcessData] = {}
        self._reader = FileReader()
        self._ticks = os.sysconf("SC_CLK_TCK")

    def look(self, now: datetime) -> RunningProcesses:
        """Return the running processes, except this process.

        ``now`` is the time on the clock of this machine.
        """
        begin = now - timedelta(seconds=time.clock_gettime(time.CLOCK_BOOTTIME))
        longest_advance = cache(partial(self._longest_clock_advance, begin))
        self._reader.forget_unread()
        before, self._looked = self._looked, {}
        processes: list[Process] = []
        closed: list[UnseenProcess] = []
        pids = [int(entry) for entry in os.listdir(self._proc) if entry.isdigit()]
        for pid in sorted(pids):
            if pid == os.getpid():
                continue
            try:
                with _opened(self._proc / str(pid)) as folder:
                    looked = self._look(pid, folder, before.get(pid), begin, longest_advance)
                    if looked is None:
                        continue
                    self._looked[pid] = looked
                    if looked.process:
                        processes.append(self._with_files(looked.process, folder))
            except PermissionError:
                closed.append(UnseenProcess(pid, (), "/proc hides it", uses_ros=False))
            except OSError:  # it has ended
                continue
        waiting = self._waiting_processes(processes)
        return RunningProcesses(
            tuple(process for process in processes if process.pid not in waiting),
            (
                *(looked_at.unseen for looked_at in self._looked.values() if looked_at.unseen),
                *closed,
            ),
            "" if (self._proc / "1").exists() else "those of other users, which /proc hides",
            _namespace(self._proc / "self/ns/pid") not in ("", _FIRST_PID_NAMESPACE),
            os.geteuid() == 0,
        )

    def _look(
        self,
        pid: int,
        folder: int,
        before: _ProcessData | None,
        begin: datetime,
        longest_advance: Callable[[], timedelta],
    ) -> _ProcessData | None:
        """Return the data of a process; None if it has ended or runs no program.

        ``before`` is the data from the last look, if any.  ``begin`` is the moment when the machine
        started, from which the kernel counts the start times of processes; ``longest_advance``
        returns the time by which the clock was set forward since then.
        """
        for _ in range(_MOST_TRIES):
            stat = _stat(folder)
            if stat.is_idle:
                return None
            if before and before.stat == stat:
                return before
            command: tuple[str, ...] = ()
            try:
                command = tuple(_words(folder, "cmdline"))
                started = (
                    begin + timedelta(seconds=stat.ticks / self._ticks) + _SHORTEST_LOADING_TIME
                )
                advanced = _clock_advance(folder, started)
                if advanced:
                    advanced = max(advanced, longest_advance())
                    started -= advanced + _LONGEST_TIME_TO_FIRST_LOOK
                if before and before.process and before.stat.identity == stat.identity:
                    # Kept from the last look, because the clock may have been set since.
                    started, advanced = before.process.started, before.process.clock_advance
                process = _examine(pid, folder, command, started)
                process = process and replace(
                    process, clock_advance=advanced, is_stopped=stat.is_stopped
                )
                unseen = None
            except (PermissionError, _TooLongError) as error:
                why = error.strerror or "the operating system refuses it"
                unseen = UnseenProcess(pid, command, why, _uses_ros_or_zenoh(command))
                process = None
            if _stat(folder).identity == stat.identity:
                return _ProcessData(stat, process, unseen)
        why = "it keeps starting other programs"
        return _ProcessData(
            stat, None, UnseenProcess(pid, command, why, _uses_ros_or_zenoh(command))
        )

    def _longest_clock_advance(self, begin: datetime) -> timedelta:
        """Return the longest time by which /proc shows that the clock was set forward.

        ``begin`` is the moment when the machine started, by the present clock. A process shows only
        changes of the clock before somebody first looked at the process in /proc.
        """
        longest = timedelta()
        for pid in filter(str.isdigit, os.listdir(self._proc)):
            with suppress(OSError), _opened(self._proc / pid) as folder:
                started = begin + timedelta(seconds=_stat(folder).ticks / self._ticks)
                longest = max(longest, _clock_advance(folder, started))
        return longest

    def _with_files(self, process: Process, folder: int) -> Process:
        """Return the process with the state of its files, resolved as the process sees them."""
        try:
            working_folder = os.readlink("cwd", dir_fd=folder)
            root = _open_root(folder)
        except OSError as error:
            problem = f"its root directory cannot be examined ({error.strerror})"
            enclave = ProcessEnclave("", "", problem=problem) if process.asks_for_security else None
            return replace(process, enclave=enclave, configuration=_configuration_of(process))
        try:
            return with_files(process, ProcessRoot(root, self._reader), working_folder)
        finally:
            os.close(root)

    def _waiting_processes(self, processes: list[Process]) -> set[int]:
        """Return the ids of processes that only wait for a process which uses ROS 2 or DDS.

        An example is ``timeout 60 sros run KEYSTORE ENCLAVE -- talker --ros-args``, which has
        mapped no library of ROS 2 or DDS, unlike its child process.
        """
        parents = {pid: looked_at.stat.parent for pid, looked_at in self._looked.items()}
        above: set[int] = set()
        for process in processes:
            pid = parents.get(process.pid, 0)
            while pid in parents and pid not in above:
                above.add(pid)
                pid = parents[pid]
        return {
            process.pid
            for process in processes
            if not process.libraries and (process.pid in above or _is_sros_run(process.command))
        }


def with_files(process: Process, root: ProcessRoot, folder: str) -> Process:
    """Return a process with the files that it names; ``folder`` is its working directory."""
    zenoh = _configuration_of(process)
    if zenoh and not zenoh.problem:
        path = zenoh.name if zenoh.name.startswith("/") else f"{folder}/{zenoh.name}"
        zenoh = root.load(zenoh.name, path)
    enclave = _loaded_enclave(
        process.environment, process.command, root, user=process.user, folder=folder
    )
    dds = _with_versions(process.dds, root)
    return replace(process, enclave=enclave, configuration=zenoh, dds=dds)


def dds_of(pid: int) -> tuple[MappedLibrary, ...]:
    """Return the DDS libraries that a process has mapped; empty if these cannot be seen."""
    try:
        with _opened(f"/proc/{pid}") as folder:
            libraries = _mapped_dds(_read(folder, "maps", _MOST_MAPS))
            root = _open_root(folder)
    except OSError:
        return ()
    try:
        return _with_versions(libraries, ProcessRoot(root, FileReader()))
    finally:
        os.close(root)


def _with_versions(
    libraries: tuple[MappedLibrary, ...], root: ProcessRoot
) -> tuple[MappedLibrary, ...]:
    """Return the libraries; versions come from the names of copies in the same folder."""
    unknown = [library for library in libraries if not library.version and not library.replaced]
    named = {library: _with_version(library, root) for library in unknown[:_MOST_COPIES_SOUGHT]}
    return tuple(named.get(library, library) for library in libraries)


def _with_version(library: MappedLibrary, root: ProcessRoot) -> MappedLibrary:
    """Return a library with the version in the name of its only copy, as in Python wheels."""
    versions = {_version(name) for name in root.copies(library.path)} - {""}
    return library._replace(version=versions.pop()) if len(versions) == 1 else library


class _TooLongError(OSError):
    """Raised for a file of /proc that is longer than sros reads."""


def _examine(pid: int, folder: int, command: tuple[str, ...], started: datetime) -> Process | None:
    """Return a process that uses ROS 2, DDS or Zenoh; None for any other process.

    Raises:
        OSError: The process cannot be examined, or has ended.
    """
    environment: dict[str, str] = {}
    for word in _words(folder, "environ"):
        name, mark, value = word.partition("=")
        if mark:
            environment.setdefault(name, value)  # getenv(3) takes the first value
    maps = _read(folder, "maps", _MOST_MAPS)
    libraries = frozenset(library.decode() for library in _LIBRARIES.findall(maps))
    if not libraries and not _uses_ros_or_zenoh(command):
        return None
    network, status = os.readlink("ns/net", dir_fd=folder), _read(folder, "status", _MOST_BYTES)
    ports = frozenset(
        MemoryPort(int(number), memory.decode("utf-8", "replace"), int(file))
        for memory, file, number in _MEMORY_PORTS.findall(maps)
    )
    deleted = {name.decode() for name in _DELETED_MEMORY.findall(maps)}
    opened = _open_files(folder)
    own = {match[1] for match in map(_OWN_MEMORY.search, opened) if match}
    own_ports = frozenset(port for port in ports if f"port{port.number}" in own)
    domains = {port.domain for port in own_ports} | _discovery_domains(folder, opened)
    return Process(
        pid,
        command,
        environment,
        started,
        libraries,
        _user(folder, status),
        "" if network == _namespace(Path("/proc/thread-self/ns/net")) else network,
        dds=_mapped_dds(maps),
        forked_by=_forked_by(folder, command),
        own_pid=_number(_OWN_PID, status) or pid,
        own_ports=own_ports,
        mapped_ports=ports,
        lost_memory=not own.isdisjoint(deleted),
        domains=frozenset(number for number in domains if number is not None),
    )


def _open_files(folder: int) -> list[str]:
    """Return the files and sockets that a process has opened, as /proc/PID/fd names them."""
    names = []
    with _opened("fd", folder) as handle:
        for name in os.listdir(handle)[:_MOST_ENTRIES]:
            with suppress(FileNotFoundError):  # closed since
                names.append(os.readlink(name, dir_fd=handle))
    return names


def _discovery_domains(folder: int, opened: Iterable[str]) -> set[int]:
    """Return the ROS domains on whose port for discovery by multicast a process receives.

    ``opened`` are the files that it has opened. Without multicast (such as with
    ROS_LOCALHOST_ONLY=1), DDS does not open this port.
    """
    sockets = {name[8:-1] for name in opened if name.startswith("socket:[")}
    domains = set[int]()
    for table in ("net/udp", "net/udp6"):
        with suppress(FileNotFoundError):  # a kernel without IPv6
            for line in _read(folder, table, _MOST_MAPS).decode().splitlines()[1:]:
                columns = line.split()
                port = int(columns[1].rpartition(":")[2], 16)
                domain, offset = divmod(port - _FIRST_PORT, _PORTS_OF_DOMAIN)
                is_for_discovery = not offset and 0 <= domain <= _LAST_DOMAIN
                domains |= {domain} if is_for_discovery and columns[9] in sockets else set()
    return domains


def _forked_by(folder: int, command: tuple[str, ...]) -> tuple[int, tuple[str, ...]]:
    """Return the id and command of the process from which the process in ``folder`` was forked.

    After several forks, this is the first process of the program.  The result is (0, ()) if the
    process in ``folder`` itself is the first one.  ``command`` is the command of this process.

    A fork has the command of its parent.  A child of Python's ``multiprocessing`` has a command
    that only its parent can start (CPython, ``multiprocessing/spawn.py`` and ``forkserver.py``).
    """
    first: tuple[int, tuple[str, ...]] = (0, ())
    with suppress(OSError):
        parent = _stat(folder).parent
        while parent > 1:
            with _opened(f"../{parent}", folder) as handle:
                words, above = tuple(_words(handle, "cmdline")), _stat(handle).parent
            is_python = bool(words) and Path(words[0]).name.startswith("python")
            if words != command and not (
                is_python and any(map(_MULTIPROCESSING_CHILD.match, command))
            ):
                break
            first, command, parent = (parent, words), words, above
    return first


_MULTIPROCESSING_CHILD = re.compile(r"from multiprocessing\.(?:spawn|forkserver) import ")


def _mapped_dds(maps: bytes) -> tuple[MappedLibrary, ...]:
    """Return the DDS libraries in /proc/PID/maps, with the versions in their names."""
    return tuple(
        MappedLibrary(_PRODUCTS[name], _version(path), path, replaced)
        for path, name, replaced in sorted(
            {
                (os.fsdecode(path), name, bool(mark))
                for path, name, mark in _DDS_LIBRARIES.findall(maps)
            }
        )
    )


def installed_dds() -> tuple[MappedLibrary, ...]:
    """Return the DDS libraries in the folders of ROS and of packages.

    Environment variables are not used, because they do not name the folder of ROS in a login by
    ssh.
    """
    libraries = (
        (folder / name, _PRODUCTS[match[1].encode()])
        for pattern in _LIBRARY_FOLDERS
        for folder in Path("/").glob(pattern)
        for name in _names_in(folder)
        if (match := _LIBRARY_FILE.match(name))
    )
    files = {(file.resolve(), product) for file, product in libraries if file.is_file()}
    return tuple(
        MappedLibrary(product, _version(str(file)), str(file)) for file, product in sorted(files)
    )


def _names_in(folder: Path) -> list[str]:
    """Return the names of the files in a folder; empty for an unreadable folder or a file."""
    try:
        return os.listdir(folder)
    except OSError:
        return []


_LIBRARY_FOLDERS = (
    *("opt/ros/*/lib", "opt/ros/*/lib/*-linux-gnu*"),
    *("usr/lib", "usr/lib/*-linux-gnu*", "usr/local/lib"),
)
_LIBRARY_FILE = re.compile(rf"lib({'|'.join(map(re.escape, map(bytes.decode, _PRODUCTS)))})\.so")


class ProcessOrigin(NamedTuple):
    """The way in which a process was started; unknown parts are empty.

    ``unit`` is the systemd system service, ``folder`` the working directory, ``launch`` the command
    of the launch that started the process (or that is the process): ``ros2 launch``, or a Python
    program that runs a launch description.  ``container`` is the id of the Docker or Podman
    container in which the process runs.  ``user_unit`` is the service of a user's own systemd:
    this user chose its name.
    """

    unit: str = ""
    folder: str = ""
    launch: tuple[str, ...] = ()
    container: str = ""
    user_unit: str = ""

    @property
    def unit_text(self) -> str:
        """The systemd unit, or the unit of a user's own systemd, as text; "" if there is none."""
        return self.unit or (self.user_unit and f"{self.user_unit} (systemctl --user)")


def process_origin(pid: int, proc: Path = Path("/proc")) -> ProcessOrigin:
    """Return the unit, folder, launch and container in which a process was started."""
    unit = folder = container = user_unit = ""
    with suppress(OSError):
        text = (proc / str(pid) / "cgroup").read_text(errors="surrogateescape")
        unit = service[1] if (service := _SERVICE.search(text)) else ""
        unit = "" if _SERVICE_OF_OTHERS.fullmatch(unit) else unit
        user_unit = service[1] if (service := _SERVICE_OF_USER.search(text)) else ""
        container = named[1][:12] if (named := _CONTAINER.search(text)) else ""
        folder = str((proc / str(pid) / "cwd").readlink())
    child: tuple[str, ...] = ()
    with suppress(OSError, IndexError, ValueError):
        while pid > 1:
            with _opened(proc / str(pid)) as handle:
                command, parent = tuple(_words(handle, "cmdline")), _stat(handle).parent
                is_launch = launch_word_index(command) or _runs_launch(handle, pid, command, child)
            if is_launch:
                return ProcessOrigin(unit, folder, command, container, user_unit)
            child, pid = command, parent
    return ProcessOrigin(unit, folder, (), container, user_unit)


def _runs_launch(folder: int, pid: int, command: Sequence[str], child: Sequence[str]) -> bool:
    """Return whether a Python program runs a launch description, by ``launch.LaunchService``.

    The command of a child process shows this if it names temporary files of launch_ros.  ``child``
    is the command of one child process; the child processes of the main thread are looked up.
    """
    is_python = Path(command[0]).name.startswith("python")
    if not is_python or without_launch_files(command) != tuple(command):
        return False
    children = [tuple(child)]
    with suppress(OSError):  # the kernel may lack the list
        for number in _read(folder, f"task/{pid}/children", _MOST_BYTES).decode().split():
            with suppress(OSError):  # the child has ended
                children.append(tuple(_words(folder, f"../{number}/cmdline")))
    return any(without_launch_files(words) != words for words in children)


def without_launch_files(command: Sequence[str]) -> tuple[str, ...]:
    """Return a command without the names of the temporary files that launch_ros made for it.

    These files have parameters, and each launch makes new ones (launch_ros 0.26,
    ``actions/node.py`` and ``parameter_descriptions.py``).
    """
    return tuple(_LAUNCH_FILE.sub(r"\1*", word) for word in command)


_LAUNCH_FILE = re.compile(r"(/launch_params_)[a-z0-9_]{8}\b")


def launch_word_index(command: Sequence[str]) -> int:
    """Return the index of the word ``launch`` in a command of ``ros2 launch``, else 0."""
    for index in (1, 2):
        if [*command[index : index + 1]] == ["launch"] and Path(command[index - 1]).name == "ros2":
            return index
    return 0


SERVICE_NAME = r"\w[\w:.@\\-]*\.service"
"""The name of a systemd service, as a regular expression."""
_SERVICE_OF_OTHERS = re.compile(
    r"(cron|crond|atd|anacron|sshd?|dropbear|(sshd?|dropbear|getty|serial-getty)@.*"
    r"|docker|containerd|supervisord?"
    r"|NetworkManager-dispatcher|networkd-dispatcher|systemd-udevd|rc-local)\.service",
    re.A,
)
"""Matches services that start programs of their users, such as ``@reboot`` lines of a crontab.

A restart of such a service restarts or ends other programs, too.
"""
_SERVICE = re.compile(
    r"^(?:0:|\d+:name=systemd):/system\.slice/(?:[^/\n]+\.slice/)*(" + SERVICE_NAME + r")$",
    re.M | re.A,
)
"""A line of /proc/PID/cgroup, version 2 or 1 (cgroups(7)), for a system service (not of a user).

Only slices may be above the service: below a service or a container, others choose the names.
"""
_SERVICE_OF_USER = re.compile(
    r"^(?:0:|\d+:name=systemd):/user\.slice/user-\d+\.slice/user@\d+\.service/(?:[^/\n]+\.slice/)*("
    + SERVICE_NAME
    + r")$",
    re.M | re.A,
)
"""A line of /proc/PID/cgroup for a service of a user's own systemd (systemctl --user)."""
_CONTAINER = re.compile(r"/(?:docker|libpod)[-/]([0-9a-f]{64})(?:\.scope)?(?:/|$)", re.M | re.A)
"""A line of /proc/PID/cgroup for a Docker or Podman container, by either cgroup driver."""


def _version(name: str) -> str:
    """Return the three numbers at the end of a library's name, or ""."""
    numbers = _THREE_NUMBERS.search(name)
    return numbers[1] if numbers else ""


_FIRST_PID_NAMESPACE = "pid:[4026531836]"
"""Name of the PID namespace with all processes (PROC_PID_INIT_INO of <linux/proc_ns.h>)."""


def _programs_in(command: tuple[str, ...]) -> set[str]:
    """Return the possible names of a command's program, or of the script that the program runs."""
    return {Path(word).name for word in command[:3]}


def _is_daemon(command: tuple[str, ...]) -> bool:
    """Return whether a command is one with which ros2cli starts its daemon."""
    runs_module = command[1:2] == ("-c",) and any(_DAEMON_MODULE in code for code in command[2:3])
    return runs_module or any(Path(word).name == _DAEMON for word in command[:2])


def _uses_ros_or_zenoh(command: tuple[str, ...]) -> bool:
    """Return whether a command shows that the process uses ROS 2 or Zenoh."""
    is_of_zenoh = not _programs_in(command).isdisjoint((*_ROUTERS, *_BRIDGES))
    return ROS_ARGS in command or is_of_zenoh or _is_daemon(command)


def _is_sros_run(command: tuple[str, ...]) -> bool:
    """Return whether a command is ``sros run``, which later becomes the node itself."""
    names = [Path(word).name for word in command[:4]]
    return "run" in names and any(script in names for script in _SCRIPTS_OF_SROS)


_CHOSEN_BY_PROGRAM = "the program or its arguments choose the file, and sros does not know which"


def _configuration_of(process: Process) -> LoadedFile | None:
    """Return the configuration file of a process, without its content; None if it uses none.

    If the file is unknown, the result has the reason as ``problem``.
    """
    if not process.is_zenoh:
        return None
    by_rmw = RMW in process.environment or "librmw_zenoh_cpp" in process.libraries
    is_of_zenoh = not _programs_in(process.command).isdisjoint((_ZENOHD, *_BRIDGES))
    if is_of_zenoh or not (by_rmw or process.is_router):
        return LoadedFile("", problem=_CHOSEN_BY_PROGRAM)
    session, router = (process.environment.get(name, "") for name in (SESSION_URI, ROUTER_URI))
    is_certain = process.is_router or "librcl" in process.libraries
    if not is_certain and {session, router}.isdisjoint({"", NO_CONFIGURATION}):
        why = f"sros does not know whether the program uses {SESSION_URI} or {ROUTER_URI}"
        return LoadedFile("", problem=why)
    path = router if process.is_router else session
    if path == NO_CONFIGURATION:  # with this path, no process of rmw_zenoh runs
        return LoadedFile("", problem=_CHOSEN_BY_PROGRAM)
    return LoadedFile(path) if path else None


def _stat(folder: int) -> _Stat:
    """Return what /proc/PID/stat says about a process; ``folder`` is its open /proc/PID.

    Raises:
        OSError: The process has ended.
    """
    text = _read(folder, "stat", _MOST_BYTES).decode("utf-8", "surrogateescape")
    # The name may hold spaces and parentheses; numbers follow the last parenthesis.
    name, _, rest = text.rpartition(")")
    numbers = rest.split()
    if len(numbers) < 24:
        raise ProcessLookupError
    is_idle = numbers[0] in "ZX" or bool(int(numbers[6]) & _KERNEL_THREAD)
    identity = (name, numbers[19], numbers[23])
    is_stopped = numbers[0] == "T"
    return _Stat(int(numbers[1]), int(numbers[19]), identity, numbers[20], is_idle, is_stopped)


_USERS = re.compile(rb"^Uid:\s+(\d+)\s+(\d+)\s+(\d+)\s+(\d+)", re.MULTILINE)
"""Matches the real, effective, saved and file system user id in /proc/PID/status."""
SEVERAL_USERS = 0xFFFFFFFF
"""A user id for several users who can control a process; no process has it (setresuid(2))."""


def user_text(user: int) -> str:
    """Return text that names the user who can control a process, such as ``user 1000``."""
    return "several users" if user == SEVERAL_USERS else f"user {user}"


_OWN_PID = re.compile(rb"^NSpid:(?:\s+\d+)*\s+(\d+)$", re.MULTILINE)
"""Matches the process id in the innermost PID namespace, in /proc/PID/status."""


_STARTED_BY, _STARTED_AS = 11, 12
"""AT_UID and AT_EUID in /proc/PID/auxv (getauxval(3)): real and effective user id at the start."""


def _clock_advance(folder: int, started: datetime) -> timedelta:
    """Return by how much the clock was set forward since somebody first looked at a process.

    ``started`` is the start of the process by the present clock. The kernel gives /proc/PID the
    time at which somebody (systemd, ps, sros) first looks at it (Linux, ``fs/proc/base.c``). This
    time is after the start, unless the clock was changed in between. The result is 0 if the clock
    was not changed.
    """
    first_look = _moment(os.fstat(folder).st_ctime_ns)
    advanced = started - first_look
    return advanced if advanced > _CLOCK_TOLERANCE else timedelta()


def _user(folder: int, status: bytes) -> int:
    """Return the id of the only user other than root who can control a process.

    The result is 0 if only root can, and `SEVERAL_USERS` for several users or an unknown user.

    The user who starts a set-user-ID program chooses its command and environment, whatever user ids
    the program takes later.  A process can replace its auxiliary vector, but not its ids in
    ``status`` (PR_SET_MM in prctl(2)).  So the vector can only add a user.

    Raises:
        OSError: The process has ended, or may not be examined.
    """
    auxiliary = _read(folder, "auxv", _MOST_BYTES)
    length = len(auxiliary) - len(auxiliary) % 16
    values = dict(struct.iter_unpack("QQ", auxiliary[:length]))
    if any(name > 0xFFFFFFFF for name in values):  # a 32-bit process has words of half the size
        values = dict(struct.iter_unpack("II", auxiliary[:length]))
    match = _USERS.search(status)
    users = set(map(int, match.groups())) if match else {SEVERAL_USERS}
    started_by = values.get(_STARTED_BY)
    if started_by is not None and started_by != values.get(_STARTED_AS):
        users.add(int(started_by))
    users.discard(0)
    return SEVERAL_USERS if len(users) > 1 else min(users, default=0)


def _number(pattern: re.Pattern[bytes], status: bytes) -> int:
    """Return the number that a pattern finds in /proc/PID/status, or 0."""
    match = pattern.search(status)
    return int(match[1]) if match else 0


def _words(folder: int, name: str) -> list[str]:
    text = _read(folder, name, _MOST_BYTES).rstrip(b"\0")
    return [os.fsdecode(word) for word in text.split(b"\0")] if text else []


def _read(folder: int, name: str, max_bytes: int) -> bytes:
    """Return the content of a file of /proc/PID.

    Raises:
        OSError: The file cannot be read, or is longer than ``max_bytes``.
    """
    parts, length = [], 0
    with _opened(name, folder, is_folder=False) as handle:
        while part := os.read(handle, 1024 * 1024):
            parts.append(part)
            length += len(part)
            if length > max_bytes:
                raise _TooLongError(
                    0, f"/proc/PID/{name} is longer than {max_bytes // 1024**2} MiB"
                )
    return b"".join(parts)


@contextmanager
def _opened(
    path: str | Path, folder: int | None = None, *, is_folder: bool = True
) -> Iterator[int]:
    """Open a folder, or a file, for reading in a context; a relative path is below ``folder``."""
    kind = os.O_DIRECTORY if is_folder else 0
    handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC | kind, dir_fd=folder)
    try:
        yield handle
    finally:
        os.close(handle)


def _open_root(folder: int) -> int:
    """Open the root directory of the process whose folder of /proc is ``folder``, with O_PATH."""
    return os.open("root", os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC, dir_fd=folder)


def _namespace(path: Path) -> str:
    try:
        return str(path.readlink())
    except OSError:
        return ""


_CRL = "crl.pem"
_KEY, _KEY_ON_TOKEN = "key.pem", "key.p11"
_KEYS = (_KEY, _KEY_ON_TOKEN)
"""Files that are not read."""
_MOST_FILE_BYTES = 16 * 1024 * 1024
_MOST_BYTES_OF_FILES = 64 * 1024 * 1024
_LAST_SECOND = 253402300799
_MOST_LINKS = 40
_MOST_FOLDERS = 200


@dataclass(frozen=True, slots=True)
class LoadedFile:
    """The current state of a file that a process loads at its start.

    ``changed`` is the time of the last change of the file or of a link to it: of content, mode or
    owner, or a replacement; None if the file does not exist. ``problem`` is a clause on why the
    file could not be examined. ``mode`` are the permission bits of the file.
    """

    name: str
    changed: datetime | None = None
    data: bytes = field(default=b"", repr=False)
    problem: str = ""
    mode: int = 0


@dataclass(frozen=True, slots=True)
class ProcessEnclave:
    """The enclave that a process names, and the current state of the enclave's files.

    ``keystore`` is the path that the process names, and ``local_keystore`` the path by which sros
    reaches this keystore; None if sros sees another folder, or none, at ``keystore``.  ``is_there``
    says that the enclave's folder exists.  ``moved`` maps folders of the keystore whose last change
    was a move or a new mode, without added or removed files, to the time of that change; also
    folders above the keystore that were moved.
    ``writable`` is a clause on a folder or link, of the keystore or above it, that unexpected users
    can change.
    ``folders`` are the device and inode of the keystore and of the enclave, as far as these exist.
    ``problem`` is a clause on why the enclave could not be examined.
    """

    keystore: str
    name: str
    files: tuple[LoadedFile, ...] = ()
    is_there: bool = False
    moved: Mapping[str, datetime] = field(default_factory=dict)
    writable: str = ""
    local_keystore: Path | None = None
    folders: tuple[tuple[int, int], ...] = ()
    problem: str = ""

    def file(self, name: str) -> LoadedFile:
        """Return the file of the enclave with this name."""
        return next((file for file in self.files if file.name == name), LoadedFile(name))

    def is_in_keystore(self, keystore: Path) -> bool:
        """Return whether this is an enclave of a keystore on this machine, also by another path.

        The folder of the enclave decides, or the folder of the keystore: links, ``..`` and the
        mounts of a container give a folder other paths.  For a folder that does not exist, the path
        decides.
        """
        enclave_folder = keystore / "enclaves" / self.name.strip("/")
        for path, folder in zip((keystore, enclave_folder), self.folders, strict=False):
            with suppress(OSError, ValueError):
                state = path.stat()
                if folder == (state.st_dev, state.st_ino):
                    return True
        lost = not self.folders and not self.problem
        return lost and os.path.abspath(self.keystore) == os.path.abspath(keystore)  # noqa: PTH100

    @property
    def missing_files(self) -> tuple[str, ...]:
        """The names of the required files that are missing."""
        present_files = {file.name for file in self.files if file.changed or file.problem}
        present_files |= {_KEY} if _KEY_ON_TOKEN in present_files else set()
        return tuple(file for file in ENCLAVE_FILES if file not in present_files)


class FileReader:
    """A reader of files of processes: at most 64 MiB, and the same file only once."""

    def __init__(self) -> None:
        self._left = _MOST_BYTES_OF_FILES
        self._read: dict[tuple[int, ...], bytes] = {}
        self._before: dict[tuple[int, ...], bytes] = {}

    def read(self, handle: int, state: os.stat_result) -> bytes:
        """Return the content of a regular file that is open with O_PATH.

        Raises:
            OSError: The file cannot be read, is no regular file, or is too large.
        """
        key = (state.st_dev, state.st_ino, state.st_ctime_ns, state.st_size)
        if key not in self._read and key in self._before:
            self._read[key] = self._before[key]
            self._left -= state.st_size
        if key not in self._read:
            if not stat.S_ISREG(state.st_mode):
                raise OSError(errno.EINVAL, "it is not a regular file")
            if state.st_size > min(_MOST_FILE_BYTES, self._left):
                raise OSError(errno.EFBIG, "it is larger than the limit of sros")
            # Opened by the link of the handle, so that it is certainly the same file.
            opened = os.open(f"/proc/self/fd/{handle}", os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
            with open(opened, "rb") as file:
                self._read[key] = file.read(state.st_size)
            self._left -= state.st_size
        return self._read[key]

    def forget_unread(self) -> None:
        """Forget files that were not read since the last call of this method."""
        self._left = _MOST_BYTES_OF_FILES
        self._before, self._read = self._read, {}


class ProcessRoot:
    """The root directory of a process, below which paths of the process are resolved.

    ``handle`` is a folder that is open with O_PATH; the caller has to close it.
    """

    def __init__(self, handle: int, reader: FileReader) -> None:
        self._handle = handle
        self._reader = reader

    def load(self, name: str, path: str, *, read: bool = True) -> LoadedFile:
        """Return the state of a file at an absolute path, with its content if ``read``.

        ``name`` is the name of the file in the result.
        """
        try:
            with self._opened(path) as (handle, way):
                links = [status for _, status in way[:-1] if stat.S_ISLNK(status.st_mode)]
                changed = max(status.st_ctime_ns for status in (*links, way[-1][1]))
                data = self._reader.read(handle, way[-1][1]) if read else b""
        except OSError as error:
            return LoadedFile(name, problem=_reason(error))
        return LoadedFile(name, _moment(changed), data, mode=stat.S_IMODE(way[-1][1].st_mode))

    def copies(self, path: str) -> list[str]:
        """Return the names of files next to a library that have its size, and begin with its name.

        The result is empty if the folder cannot be examined, or has too many entries.
        """
        above, _, name = path.rpartition("/")
        try:
            with self._opened(above) as (folder, _), _opened(f"/proc/self/fd/{folder}") as handle:
                size = os.stat(name, dir_fd=handle, follow_symlinks=False).st_size
                with os.scandir(handle) as entries:
                    names = [
                        entry.name
                        for entry, _ in zip(entries, range(_MOST_ENTRIES + 1), strict=False)
                    ]
                if len(names) > _MOST_ENTRIES:
                    return []
                return [
                    copy
                    for copy in names
                    if copy.startswith(f"{name}.")
                    and _is_of_size(os.stat(copy, dir_fd=handle, follow_symlinks=False), size)
                ]
        except OSError:
            return []

    def steps(self, path: str) -> list[tuple[str, os.stat_result]]:
        """Return the folders and links on the way to a folder, and last the folder itself.

        Raises:
            OSError: The folder does not exist, or cannot be examined.
        """
        with self._opened(path) as (_, way):
            if not stat.S_ISDIR(way[-1][1].st_mode):
                raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR))
            return way

    @contextmanager
    def _opened(self, path: str) -> Iterator[tuple[int, list[tuple[str, os.stat_result]]]]:
        """Open the file or folder at a path with O_PATH, in a context.

        Yields the handle, and the paths and states of all folders and links on the way and of the
        file or folder itself. Every part is opened in its parent folder, and the system follows no
        link, so nothing outside of the root directory is reached.
        """
        parts_left = [part for part in path.split("/")[::-1] if part]
        way = [("/", os.fstat(self._handle))]
        folders: list[tuple[str, int]] = []
        links = 0
        try:
            while parts_left:
                part = parts_left.pop()
                if part == "..":
                    if folders:
                        os.close(folders.pop()[1])
                    continue
                if part == "." or len(folders) > _MOST_FOLDERS:
                    if part == ".":
                        continue
                    raise OSError(errno.ENAMETOOLONG, os.strerror(errno.ENAMETOOLONG))
                above, within = folders[-1] if folders else ("", self._handle)
                handle = _open_path_part(part, within)
                folders.append((f"{above}/{part}", handle))
                state = os.fstat(handle)
                way.append((f"{above}/{part}", state))
                if not stat.S_ISLNK(state.st_mode):
                    continue
                links += 1
                if links > _MOST_LINKS:
                    raise OSError(errno.ELOOP, os.strerror(errno.ELOOP))
                target = os.readlink("", dir_fd=handle)
                os.close(folders.pop()[1])
                if target.startswith("/"):
                    while folders:
                        os.close(folders.pop()[1])
                parts_left += [part for part in target.split("/")[::-1] if part]
            last = folders[-1] if folders else ("/", self._handle)
            way.append((last[0], os.fstat(last[1])))
            yield last[1], way
        finally:
            for _, handle in folders:
                os.close(handle)


def _is_of_size(state: os.stat_result, size: int) -> bool:
    return stat.S_ISREG(state.st_mode) and state.st_size == size


def _open_path_part(name: str, folder: int) -> int:
    try:
        return os.open(name, os.O_PATH | os.O_NOFOLLOW | os.O_CLOEXEC, dir_fd=folder)
    except ValueError as error:  # a NUL in the name
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT)) from error


def _loaded_enclave(
    environment: Mapping[str, str],
    command: tuple[str, ...],
    root: ProcessRoot,
    *,
    user: int,
    folder: str = "",
) -> ProcessEnclave | None:
    """Return the enclave that rcl loads for a process, or None if the process asks for none.

    ``user`` is the user id of the process, and ``folder`` its working directory, or "" if that is
    not known.
    """
    keystore = environment.get(KEYSTORE, "")
    if environment.get(ENABLE) != "true" or not keystore:
        return None
    name = environment.get(ENCLAVE) or enclave_argument(command)
    if not keystore.startswith("/") and not folder:
        why = f"{KEYSTORE} is a relative path, and the working directory is not known"
        return ProcessEnclave(keystore, name, problem=why)
    top = keystore if keystore.startswith("/") else f"{folder}/{keystore}"
    place = f"{top}/enclaves/{name.strip('/')}"
    try:
        above = _only_folders(root.steps(top))
    except OSError as error:
        return ProcessEnclave(keystore, name, problem=_reason(error))
    folder_of_keystore, here = _identity(above), _path_if_same_folder(top, above)
    try:
        steps = root.steps(place)
    except OSError as error:
        there = (folder_of_keystore,)
        return ProcessEnclave(
            keystore, name, local_keystore=here, folders=there, problem=_reason(error)
        )
    folders = _only_folders(steps)
    own_folders = [above[-1], *folders[len(above) - 1 :]]
    link = link_of_stranger(steps, frozenset({0, user}))
    return ProcessEnclave(
        keystore,
        name,
        tuple(
            root.load(file, f"{place}/{file}", read=file not in _KEYS)
            for file in (*ENCLAVE_FILES, _KEY_ON_TOKEN, _CRL)
        ),
        is_there=True,
        moved=_moved_folders(folders, {path for path, _ in own_folders}),
        writable=f"'{link}': it is a link of another user"
        if link
        else _writable_folder_clause(own_folders, above[:-1], user),
        local_keystore=here,
        folders=(folder_of_keystore, _identity(folders)),
    )


def _only_folders(
    steps: Sequence[tuple[str, os.stat_result]],
) -> list[tuple[str, os.stat_result]]:
    return [(step, state) for step, state in steps if stat.S_ISDIR(state.st_mode)]


def _moved_folders(
    folders: Sequence[tuple[str, os.stat_result]], own: Set[str]
) -> Mapping[str, datetime]:
    """Return the folders whose last change was a move, with its time.

    For the folders ``own``, a new mode counts as a move. Folders above them often get new modes or
    times, but a move also changes the parent folder: a folder that changed after its parent folder
    was not moved.
    """
    latest = {path: state.st_ctime_ns + _LONGEST_MOVE_NS for path, state in folders}
    return {
        path: _moment(state.st_ctime_ns)
        for path, state in folders
        if state.st_mtime_ns < state.st_ctime_ns
        and (path in own or state.st_ctime_ns <= latest[path.rpartition("/")[0] or "/"])
    }


_LONGEST_MOVE_NS = 1_000_000_000
"""Maximum time by which a moved folder can seem younger than its parent folder."""


def _reason(error: OSError) -> str:
    """Return a clause on why a folder could not be examined; "" if the folder does not exist."""
    if error.errno in (errno.ENOENT, errno.ENOTDIR):
        return ""
    return error.strerror or str(error)


def _writable_folder_clause(
    own: Sequence[tuple[str, os.stat_result]],
    above: Sequence[tuple[str, os.stat_result]],
    user: int,
) -> str:
    """Return a clause on the first folder that unexpected users can change, or "".

    Expected users are root, ``user``, and the owner of the keystore, which is the first of the
    folders ``own``.  For a folder in ``above``, its owner is expected, too; sticky folders there do
    not count.
    """
    trusted = frozenset({0, user, own[0][1].st_uid})
    for path, state in own:
        if why := other_writers_clause(state, trusted):
            return f"'{path}': {why}"
    for path, state in above:
        is_sticky = state.st_mode & stat.S_ISVTX  # nobody can rename what others own there
        if not is_sticky and (why := other_writers_clause(state, trusted | {state.st_uid})):
            return f"'{path}': {why}"
    return ""


def _identity(folders: Sequence[tuple[str, os.stat_result]]) -> tuple[int, int]:
    """Return the device and inode of the last of ``folders``."""
    state = folders[-1][1]
    return state.st_dev, state.st_ino


def _path_if_same_folder(path: str, folders: Sequence[tuple[str, os.stat_result]]) -> Path | None:
    """Return ``path`` if sros and the examined process see the same folder there, or None."""
    with suppress(OSError, ValueError):
        if os.path.samestat(Path(path).stat(), folders[-1][1]):
            return Path(path)
    return None


def _moment(nanoseconds: int) -> datetime:
    # A file system can state any moment; moments after the last datetime count as the last one.
    return datetime.fromtimestamp(min(max(nanoseconds / 1e9, 0), _LAST_SECOND), UTC)
