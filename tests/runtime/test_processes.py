"""What /proc says is chosen by processes: it is bounded, and taken for nothing else."""

from __future__ import annotations

import os
import shlex
import struct
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from unittest.mock import Mock

import pytest

from sros_tool.runtime import processes
from sros_tool.runtime.environment import NO_CONFIGURATION, ROUTER_URI, enclave_argument
from sros_tool.runtime.processes import (
    SEVERAL_USERS,
    FileReader,
    LoadedFile,
    Process,
    ProcessRoot,
    ProcessTable,
    RunningProcesses,
    _Stat,
    with_files,
)
from sros_tool.runtime.variables import ENABLE, ENCLAVE, KEYSTORE

NOW = datetime(2026, 11, 23, tzinfo=UTC)
ROS = ("talker", "--ros-args")


@dataclass
class Proc:
    """A folder such as /proc."""

    path: Path

    def add(
        self,
        pid: int,
        *command: str,
        environment: bytes = b"",
        maps: str = "",
        parent: int = 1,
        flags: int = 0,
        state: str = "S",
        start: str = "100",
    ) -> Path:
        folder = self.path / str(pid)
        for name in ("ns", "fd", "net"):
            (folder / name).mkdir(parents=True, exist_ok=True)
        numbers = [
            state,
            str(parent),
            *"0000",
            str(flags),
            *"000000000000",
            start,
            "4096",
            *"00000",
        ]
        (folder / "stat").write_text(f"{pid} (a) b) {' '.join(numbers)}\n")
        (folder / "cmdline").write_bytes("\0".join((*command, "")).encode())
        (folder / "environ").write_bytes(environment)
        (folder / "maps").write_text(f"7f00-7f01 r-xp 0 08:01 7 {maps}\n" if maps else "")
        (folder / "auxv").write_bytes(struct.pack("QQQQ", 11, 7, 12, 7))
        (folder / "status").write_text("Name:\ta\nUid:\t8\t8\t8\t8\nNSpid:\t70\t7\n")
        for link, target in (("ns/net", "net:[1]"), ("cwd", "/"), ("root", str(self.path))):
            (folder / link).unlink(missing_ok=True)
            (folder / link).symlink_to(target)
        return folder

    def look(self, table: ProcessTable | None = None) -> RunningProcesses:
        return (table or ProcessTable(self.path)).look(NOW)

    def labels(self) -> list[str]:
        return [each.label for each in self.look().processes]


@pytest.fixture
def proc(tmp_path: Path) -> Proc:
    (tmp_path / "1").mkdir()
    return Proc(tmp_path)


@pytest.mark.parametrize(
    ("command", "maps", "found"),
    [
        (ROS, "", True),
        (("editor",), "", False),
        (("editor",), "/usr/lib/librcl.so", True),
        (("a",), "/opt/ros/jazzy/lib/librmw_zenoh_cpp.so", True),
        (("a",), "/usr/lib/x86_64-linux-gnu/libddsc.so.0debian.10.2 (deleted)", True),
        (("a",), "/v/cyclonedds.libs/libddsc-4d7a8b3c.so.11", True),
        (("a",), "/v/site-packages/zenoh/zenoh.abi3.so", True),
        (("a",), "/usr/lib/libfastrtps.so.2.14", True),
        (("a",), "/opt/opendds/lib/libOpenDDS_Dcps.so.3.28.1", True),
        (("a",), "/home/u/notes about librcl.txt", False),
        (("/usr/bin/zenohd",), "", True),
        (("python3", "-c", "from ros2cli.daemon import main"), "", True),
        (("python3", "/opt/_ros2_daemon"), "", True),
        (("/opt/ros2-daemon/editor",), "", False),
    ],
)
def test_who_speaks(command: tuple[str, ...], maps: str, found: bool, proc: Proc) -> None:
    proc.add(7, *command, maps=maps)
    assert bool(proc.labels()) is found


@pytest.mark.parametrize(
    ("maps", "named", "rmw"),
    [
        ("/lib/libfastrtps.so.2.14\n/lib/librmw_fastrtps_shared_cpp.so", "", "rmw_fastrtps_cpp"),
        ("/lib/libddsc.so.0", "rmw_fastrtps_cpp", "rmw_cyclonedds_cpp"),
        ("/lib/librmw_dds_common__rosidl_generator_c.so", "rmw_connextdds", "rmw_connextdds"),
        ("/lib/librmw_implementation.so\n/lib/librmw_email_cpp.so", "", "rmw_email_cpp"),
        ("/lib/librmw_iceoryx2_cxx.so\n/lib/libddsc.so.0", "", "rmw_iceoryx2_cxx"),
    ],
)
def test_the_rmw_is_that_of_the_mapped_libraries(
    maps: str, named: str, rmw: str, proc: Proc
) -> None:
    proc.add(7, *ROS, maps=maps, environment=f"RMW_IMPLEMENTATION={named}".encode())
    assert [process.rmw for process in proc.look().processes] == [rmw]


@pytest.mark.parametrize(
    ("mapped", "locked", "ports", "lost"),
    [
        (["port7411", "port7413"], ["port7411_el"], {7411}, False),
        (["port7411", "port7413 (deleted)"], ["port7411_el"], {7411}, False),  # of an ended peer
        (["port7411 (deleted)"], ["port7411_el (deleted)"], set(), True),
        (["port7411 (deleted)"], ["port7411_el"], set(), True),  # the port is of a later process
        (["port7411", "0123456789abcdef (deleted)"], ["0123456789abcdef_el"], set(), True),
        ([], ["port7411_el (deleted)"], set(), False),  # the parent of the process left it open
    ],
)
def test_the_ports_in_shared_memory_that_only_this_process_reads(
    mapped: list[str], locked: list[str], ports: set[int], lost: bool, proc: Proc
) -> None:
    """Without its files in /dev/shm, no other process reaches it, and nothing logs that."""
    folder = proc.add(7, *ROS)
    lines = [f"7f00-7f01 rw-s 00 00:1b {n} /dev/shm/fastrtps_{m}" for n, m in enumerate(mapped)]
    (folder / "maps").write_text("".join(f"{line}\n" for line in lines))
    for number, name in enumerate(locked):
        (folder / "fd" / str(number)).symlink_to(f"/dev/shm/fastrtps_{name}")
    (process,) = proc.look().processes
    assert {port.number for port in process.own_ports} == ports
    assert process.lost_memory is lost
    assert process.domains == ({0} if ports else set())


@pytest.mark.parametrize(
    ("port", "inode", "further"),
    [
        (7400 + 250 * 92, 5, [92]),
        (7400 + 250 * 90, 5, []),  # the domain that it names
        (7400 + 250 * 101, 5, [101]),
        (7400 + 250 * 102, 5, []),  # any program may get this port
        (7400 + 250 * 92 + 10, 5, []),
        (7150, 5, []),
        (7400 + 250 * 92, 6, []),  # the port of another process
    ],
)
@pytest.mark.parametrize("table", ["udp", "udp6"])
def test_the_domains_that_a_process_joins_by_its_code(
    port: int, inode: int, further: list[int], table: str, proc: Proc
) -> None:
    folder = proc.add(7, *ROS, environment=b"ROS_DOMAIN_ID=90")
    (folder / "fd" / "3").symlink_to("socket:[5]")
    row = f"9: 00000000:{port:04X} 00000000:0000 07 00000000:00000000 00:00000000 00000000 0 0"
    (folder / "net" / table).write_text(f"  sl  local_address\n  {row} {inode} 2 0 0\n")
    assert [process.further_domains for process in proc.look().processes] == [further]


def test_kernel_threads_and_processes_that_wait_for_a_node_are_none(proc: Proc) -> None:
    proc.add(5, *ROS, flags=0x00200000)
    proc.add(7, "timeout", "60", "sros", "run", "ks", "/a", "--", *ROS)
    assert proc.labels() == []  # sros is about to become the node
    proc.add(7, "nice", *ROS)
    proc.add(8, "sh", "-c", "x", parent=7)
    assert proc.labels() == ["process 7 (nice)"]
    proc.add(9, *ROS, parent=8)
    assert proc.labels() == ["process 9 (talker)"]
    proc.add(7, "nice", *ROS, maps="/lib/librcl.so")
    assert proc.labels() == ["process 7 (nice)", "process 9 (talker)"]


@pytest.mark.parametrize("words", ["8Q", "8I"])
@pytest.mark.parametrize(
    ("ids", "started_by", "started_as", "user"),
    [
        ("8 8 8 8", 65534, 65534, 8),
        ("0 8 0 8", 0, 0, 8),
        # Whoever starts ``su`` chooses its words and environment, and could seem to be root's node.
        ("65534 0 0 0", 65534, 0, 65534),
        ("0 0 0 0", 65534, 0, 65534),
        # A process may replace its auxiliary vector, and so name other users there.
        ("8 8 8 8", 0, 1, 8),
        ("8 8 8 8", 7, 1, SEVERAL_USERS),
        ("8 7 7 7", 8, 7, SEVERAL_USERS),
        ("", 0, 0, SEVERAL_USERS),
    ],
)
def test_the_user_of_a_process_is_whoever_has_a_say_in_it(
    proc: Proc, words: str, ids: str, started_by: int, started_as: int, user: int
) -> None:
    folder = proc.add(7, *ROS)
    values = (6, 4096, 11, started_by, 12, started_as, 13, 65534)
    (folder / "auxv").write_bytes(struct.pack(words, *values))
    ids = "\t".join(["Uid:", *ids.split()])
    (folder / "status").write_text(f"Name:\ta\n{ids}\nNSpid:\t70\t7\n")
    assert [each.user for each in proc.look().processes] == [user]


def test_the_first_of_two_variables_counts_as_for_getenv(proc: Proc) -> None:
    proc.add(7, *ROS, environment=b"ROS_DOMAIN_ID=3\0ROS_DOMAIN_ID=4\0x\0=y\0Z=\xff")
    (process,) = proc.look().processes
    assert process.domain == "3"
    assert process.environment["Z"] == "\udcff"
    assert (process.user, process.own_pid, process.network) == (8, 7, "net:[1]")
    for text, domain in (
        *(("0x0", "0"), ("010", "8"), (" +5", "5"), ("", "0"), ("0XfF", "255")),
        *(("7abc", "7"), ("4294967303", "7"), ("-1", "0"), ("0abc", "'0abc'"), ("08", "'08'")),
        *(("x\n", "'x?'"), ("\u0665", "'\u0665'")),
        *((f"{number}{'1' * 5000}", f"'{number:1<40}'") for number in ("1", "0", "0x")),
    ):
        assert replace(process, environment={"ROS_DOMAIN_ID": text}).domain == domain


@pytest.mark.parametrize(("enable", "loads"), [("true", True), ("True", False), ("", False)])
def test_only_a_process_with_security_loads_an_enclave(
    enable: str, loads: bool, proc: Proc
) -> None:
    variables = f"ROS_SECURITY_ENABLE={enable}", "ROS_SECURITY_KEYSTORE=/k"
    proc.add(5, *ROS, environment="\0".join(variables).encode())
    (process,) = proc.look().processes
    assert (process.enclave is not None) is loads


ZENOH = {"RMW_IMPLEMENTATION": "rmw_zenoh_cpp", "ZENOH_SESSION_CONFIG_URI": "/s.json5"}
FOR_ROUTER = {**ZENOH, "ZENOH_SESSION_CONFIG_URI": NO_CONFIGURATION, ROUTER_URI: "/r.json5"}
FOR_BOTH = {**ZENOH, ROUTER_URI: "/r.json5"}
REFUSED = {**FOR_ROUTER, ROUTER_URI: NO_CONFIGURATION}


@pytest.mark.parametrize(
    ("command", "environment", "library", "loaded"),
    [
        ("talker", ZENOH, "", "/s.json5"),
        ("rmw_zenohd", FOR_BOTH, "", "/r.json5"),
        ("python3 start_router.py", FOR_ROUTER, "zenoh", "/r.json5"),
        ("start_router", FOR_ROUTER, "", "/r.json5"),
        ("start_router", REFUSED, "", ""),
        ("start", FOR_BOTH, "", ""),
        ("start", FOR_BOTH, "librcl", "/s.json5"),
        ("zenohd -c /other.json5", FOR_ROUTER, "", ""),
        ("zenoh-bridge-ros2dds", FOR_ROUTER, "", ""),
        ("start_router", {**FOR_ROUTER, "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp"}, "", None),
    ],
)
def test_the_configuration_of_zenoh_is_that_of_the_environment_whatever_the_program(
    command: str, environment: dict[str, str], library: str, loaded: str | None, root: ProcessRoot
) -> None:
    """An empty name is for what sros cannot know."""
    process = Process(7, tuple(command.split()), environment, NOW, frozenset({library} - {""}))
    configuration = with_files(process, root, "/").configuration
    assert (configuration and configuration.name) == loaded
    if configuration:
        assert bool(configuration.problem) is not bool(loaded)


@pytest.mark.parametrize(
    ("command", "without"),
    [
        ("python3 -P -m sros_tool.demo.cyclone_node talker", False),
        ("python3 raw.py", True),
        ("/opt/gateway -m sros_tool.demo.cyclone_node", True),
        ("python3 raw.py -m sros_tool.demo.cyclone_node", True),
        ("python3 raw.py sros_tool.demo.cyclone_node", True),
    ],
)
def test_only_the_nodes_of_the_demo_secure_themselves_without_rcl(
    command: str, without: bool
) -> None:
    process = Process(7, tuple(command.split()), {}, NOW, frozenset({"libddsc"}))
    assert process.is_without_rcl is without
    assert not replace(process, libraries=process.libraries | {"librcl"}).is_without_rcl


@pytest.mark.parametrize(
    ("command", "is_daemon"),
    [
        ("python3 -c 'from ros2cli.daemon.daemonize import main' --name ros2-daemon", True),
        ("/usr/bin/python3 /opt/ros/foxy/bin/_ros2_daemon --ros-domain-id 0", True),
        ("/opt/ros/foxy/bin/_ros2_daemon", True),
        ("python3 /srv/ros2-daemon/drive.py", False),
        ("/opt/drive --ros-args -r __node:=_ros2_daemon", False),
        ("python3 drive.py ros2cli.daemon", False),
    ],
)
def test_only_what_ros2_starts_is_its_daemon(command: str, is_daemon: bool) -> None:
    """No finding says that the daemon runs open."""
    assert Process(7, tuple(shlex.split(command)), {}, NOW).is_daemon is is_daemon


def test_endless_texts_are_not_looked_at_and_named(proc: Proc) -> None:
    folder = proc.add(7, *ROS)
    with (folder / "environ").open("wb") as file:
        file.truncate(5 * 1024**2)
    (unseen,) = proc.look().unseen
    assert unseen.uses_ros
    assert unseen.why == "/proc/PID/environ is longer than 4 MiB"


def test_a_process_that_always_starts_another_program_is_named(
    proc: Proc, monkeypatch: pytest.MonkeyPatch
) -> None:
    proc.add(7, *ROS)
    (proc.path / "1").rmdir()
    programs = (_Stat(1, 1, (str(number),), "1", False, False) for number in range(9))
    monkeypatch.setattr(processes, "_stat", lambda _: next(programs))
    (unseen,) = proc.look().unseen
    assert unseen.why == "it keeps starting other programs"


def test_what_proc_hides_is_said(proc: Proc) -> None:
    assert proc.look().hidden == ""
    (proc.path / "1").rmdir()
    assert proc.look().hidden


@pytest.mark.parametrize(("number", "alone"), [(4026531836, False), (4026532311, True)])
def test_a_namespace_of_processes_does_not_show_those_of_others(
    proc: Proc, number: int, alone: bool
) -> None:
    assert not proc.look().is_in_container
    (proc.path / "self/ns").mkdir(parents=True)
    (proc.path / "self/ns/pid").symlink_to(f"pid:[{number}]")
    assert proc.look().is_in_container is alone


@pytest.mark.skipif(os.getuid() != 0, reason="only root can become another user")
def test_processes_of_other_users_are_named_and_not_passed_over() -> None:
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.setgid(65534)
            os.setuid(65534)
            mine = [e for e in ProcessTable().look(NOW).unseen if e.pid == os.getppid()]
            os.write(writing, mine[0].why.encode())
        finally:
            os._exit(0)
    os.close(writing)
    with os.fdopen(reading) as answer:
        assert answer.read() == "Permission denied"
    os.waitpid(child, 0)


def test_only_what_changed_is_read_again_and_another_process_is_another(proc: Proc) -> None:
    table = ProcessTable(proc.path)
    folder = proc.add(7, *ROS)
    first = proc.look(table)
    assert table.look(NOW + timedelta(seconds=9)) == first
    proc.add(7, *ROS, state="T")
    assert proc.look(table).processes[0].is_stopped
    proc.add(7, *ROS)
    assert proc.look(table) == first, "it continues"
    (folder / "environ").write_bytes(b"ROS_DOMAIN_ID=5")
    assert proc.look(table) == first
    proc.add(7, *ROS, start="900", environment=b"ROS_DOMAIN_ID=5")
    (process,) = proc.look(table).processes
    assert process.domain == "5"
    assert process.started > first.processes[0].started


def test_a_clock_that_was_set_forward_makes_no_process_newer_than_it_is(proc: Proc) -> None:
    """Files have stamps of the old clock, and the kernel tells starts by the new one."""
    table = ProcessTable(proc.path)
    first_look = datetime.fromtimestamp(proc.add(7, *ROS, start="0").stat().st_ctime, UTC)
    begin = first_look + timedelta(seconds=time.clock_gettime(time.CLOCK_BOOTTIME))
    (first,) = table.look(begin - timedelta(seconds=1)).processes
    assert first.clock_advance == timedelta()
    later = begin + timedelta(hours=1)
    assert table.look(later).processes == (first,)
    (process,) = ProcessTable(proc.path).look(later).processes
    assert timedelta(minutes=59) < process.clock_advance < timedelta(minutes=61)
    assert first_look - timedelta(minutes=2) < process.started < first_look
    # Another process started five minutes later, and somebody looked at it at the same moment.
    proc.add(8, "sh", start=f"{300 * os.sysconf('SC_CLK_TCK')}")
    (process,) = ProcessTable(proc.path).look(later).processes
    assert timedelta(minutes=64) < process.clock_advance < timedelta(minutes=66)
    assert first_look - timedelta(minutes=7) < process.started < first_look - timedelta(minutes=5)


def test_a_look_asks_once_how_far_the_clock_was_set(
    proc: Proc, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a robot without a battery for its clock, all processes are older than the clock shows."""
    clock_advance = Mock(wraps=processes._clock_advance)
    monkeypatch.setattr(processes, "_clock_advance", clock_advance)
    for pid in range(2, 12):
        proc.add(pid, *ROS, start="0")
    boot = datetime.now(UTC) + timedelta(seconds=time.clock_gettime(time.CLOCK_BOOTTIME))
    found = ProcessTable(proc.path).look(boot + timedelta(hours=1)).processes
    assert len(found) == 10 and all(process.clock_advance for process in found)
    assert clock_advance.call_count == 2 * len(found)


@pytest.mark.parametrize(
    ("words", "enclave"),
    [
        ("--ros-args --enclave /a", "/a"),
        ("--ros-args -e /a -e /b", "/b"),
        ("--ros-args -r x:=y -- --enclave /a", "/"),
        ("--ros-args -- x --ros-args -e /a", "/a"),
        ("--enclave /a --ros-args", "/"),
    ],
)
def test_the_enclave_of_a_command(words: str, enclave: str) -> None:
    assert enclave_argument(("talker", *words.split())) == enclave


# ── files ──────────────────────────────────────────────────────────────────────────────────


@pytest.fixture
def root(tmp_path: Path) -> Iterator[ProcessRoot]:
    """The root directory of a process in a container."""
    (tmp_path / "root/etc").mkdir(parents=True)
    (tmp_path / "secret").write_text("outside")
    handle = os.open(tmp_path / "root", os.O_PATH)
    yield ProcessRoot(handle, FileReader())
    os.close(handle)


def test_no_path_of_a_container_leads_out_of_it(root: ProcessRoot, tmp_path: Path) -> None:
    inside = tmp_path / "root"
    (inside / "etc/secret").write_text("inside")
    (inside / "up").symlink_to("../../../../etc")
    (inside / "out").symlink_to(f"{tmp_path}/secret")
    (inside / "circle").symlink_to("/circle")
    for path in ("/etc/secret", "/up/secret", "/../../etc/secret", "/etc/../../etc/./secret"):
        assert root.load("x", path).data == b"inside"
    for path in ("/out", "/secret", "/../secret", f"{tmp_path}/secret", "/etc/\0"):
        assert root.load("x", path) == LoadedFile("x")
    assert root.load("x", "/circle").problem
    assert root.load("x", "/a" * 5000).problem == ""


def test_what_is_no_file_is_not_opened(root: ProcessRoot, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "root/pipe")
    with (tmp_path / "root/endless").open("wb") as file:
        file.truncate(17 * 1024**2)
    for path in ("/pipe", "/etc", "/endless"):
        assert root.load("x", path).problem


def test_an_enclave_is_known_by_whatever_path_a_process_names(
    root: ProcessRoot, tmp_path: Path
) -> None:
    """The same folder has other paths by links, by ``..`` and in a container; a copy has not."""
    export = tmp_path / "root/opt/export"
    for place in (export, tmp_path / "root/copy"):
        (place / "enclaves/a").mkdir(parents=True)
    (tmp_path / "root/link").symlink_to("opt/export")
    # As a bind mount of the folder of the enclave alone: the keystore above it is another folder.
    (tmp_path / "root/etc/enclaves").mkdir()
    (tmp_path / "root/etc/enclaves/a").symlink_to("/opt/export/enclaves/a")
    for path, is_own in {
        "/opt/export": True,
        "/opt/export/": True,
        "/opt/../link": True,
        "etc": True,
        "/opt/export/enclaves/..": True,
        "/copy": False,
        "/gone": False,
        str(export): True,
    }.items():
        environment = {ENABLE: "true", KEYSTORE: path, ENCLAVE: "/a"}
        process = with_files(Process(1, (), environment, datetime.now(UTC)), root, "/")
        assert process.enclave and process.enclave.is_in_keystore(export) == is_own, path
    # Another folder of the same path, as a copy in the image of a container.
    (tmp_path / "root" / export.relative_to("/") / "enclaves/a").mkdir(parents=True)
    other = with_files(process, root, "/").enclave
    assert other and other.is_there and not other.is_in_keystore(export)


def test_a_replaced_link_is_a_change(root: ProcessRoot, tmp_path: Path) -> None:
    (tmp_path / "root/old").mkdir()
    (tmp_path / "root/old/f").write_text("1")
    before = root.load("x", "/old/f").changed
    assert before is not None
    wait_for_tick(before, tmp_path)
    (tmp_path / "root/live").symlink_to("old")
    after = root.load("x", "/live/f").changed
    assert after is not None and after > before


def wait_for_tick(since: datetime, folder: Path) -> None:
    """Wait until the kernel gives files another time than ``since``."""
    while datetime.now(UTC) - since < timedelta(milliseconds=20):
        (folder / "tick").touch()


def test_a_folder_above_the_keystore_that_was_moved_is_a_change(
    root: ProcessRoot, tmp_path: Path
) -> None:
    (tmp_path / "root/new/ks/enclaves/a").mkdir(parents=True)
    environment = {ENABLE: "true", KEYSTORE: "/robot/ks", ENCLAVE: "/a"}
    process = Process(1, (), environment, datetime.now(UTC))
    wait_for_tick(process.started, tmp_path)
    (tmp_path / "root/new").rename(tmp_path / "root/robot")
    enclave = with_files(process, root, "/").enclave
    assert enclave and [*enclave.moved] == ["/robot"] and enclave.moved["/robot"] > process.started


@pytest.mark.parametrize(
    ("folder", "mode", "clause"),
    [
        ("srv", 0o755, ""),
        ("srv", 0o1777, ""),
        ("srv", 0o777, "'/srv': its mode is 0777, so everybody can write"),
        ("srv/ks", 0o1777, "'/srv/ks': its mode is 1777, so everybody can write"),
    ],
)
def test_a_keystore_is_replaceable_in_a_folder_that_others_can_write_to(
    folder: str, mode: int, clause: str, root: ProcessRoot, tmp_path: Path
) -> None:
    (tmp_path / "root/srv/ks/enclaves/a").mkdir(parents=True)
    (tmp_path / "root" / folder).chmod(mode)
    environment = {ENABLE: "true", KEYSTORE: "/srv/ks", ENCLAVE: "/a"}
    enclave = with_files(Process(1, (), environment, NOW), root, "/").enclave
    assert enclave and enclave.writable == clause


@pytest.mark.parametrize(
    ("path", "parent_changed", "own", "moved"),
    [
        ("/robot", 8, "", True),
        ("/robot", 7, "", True),  # the kernel changes the folder and its parent one after the other
        ("/robot", 5, "", False),  # only its mode or its times changed
        ("/robot", 5, "/robot", True),
    ],
)
def test_a_folder_that_changed_after_its_parent_was_not_moved(
    path: str, parent_changed: int, own: str, moved: bool
) -> None:
    second = 10**9
    top = Mock(st_mtime_ns=parent_changed * second, st_ctime_ns=parent_changed * second)
    folder = Mock(st_mtime_ns=second, st_ctime_ns=8 * second)
    assert [*processes._moved_folders([("/", top), (path, folder)], {own})] == [path] * moved
