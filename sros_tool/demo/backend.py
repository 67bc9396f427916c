"""The library that runs the demo's nodes: rclpy, Cyclone DDS, or Zenoh.

A single node can also be run by hand, in the current environment, such as that of ``sros run``.
"""

from __future__ import annotations

import importlib.util
import os
import re
import select
import shlex
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import timedelta
from functools import cache
from importlib import metadata
from pathlib import Path

from sros_tool.dds.decision.vendors import Vendor
from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import ProtectionKind
from sros_tool.demo.casting import naming_arguments
from sros_tool.demo.nodes import STRING, NodeOptions
from sros_tool.demo.scenarios.model import DEFAULT_TOPIC, Condition, Role
from sros_tool.errors import SrosError, UnavailableError, UsageError
from sros_tool.keystore.template import EVERYTHING, Template
from sros_tool.parallel import end_with_starter
from sros_tool.policy.patterns import matches
from sros_tool.runtime.cyclone import INSTALL_ADVICE, MORE_PARTICIPANTS, load_cyclone
from sros_tool.runtime.events import Event, EventKind, ProcessStage, parse_event
from sros_tool.runtime.rmw import (
    RMW,
    built_without_security,
    denial_trace_variables,
    middleware_of,
    rmw_implementations,
    vendor_of,
)
from sros_tool.runtime.stacks import ProbeEnclave, Stack, cyclone_stack, rclpy_stacks
from sros_tool.runtime.variables import ENABLE, ENCLAVE, KEYSTORE, choose_loadable, domain_of
from sros_tool.translate import governance_for
from sros_tool.wording import counted

AUTO, RCLPY, CYCLONE, ZENOH = "auto", "rclpy", "cyclone", "zenoh"

_CHOSEN_BY_USER = "chosen with --backend"
_NO_RCLPY = (
    "Source a ROS 2 installation from packages (its Fast DDS has DDS Security built in), or use"
    " `--backend cyclone`."
)
_PYTHON = (sys.executable, "-P")  # never import modules from the current folder
_LEAN_PYTHON = (*_PYTHON, "-S")
"""Python without site packages: their start-up files can take longer than a node."""
_WITHOUT_SHARED_MEMORY = {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}
"""Environment variable that keeps Fast DDS from using shared memory.

Packets in shared memory cannot be captured, and do not pass between processes of different users.
"""


@cache
def _module_path_variable() -> Mapping[str, str]:
    """Return the environment variable with which `_LEAN_PYTHON` finds the nodes' modules."""
    modules = map(importlib.util.find_spec, ("sros_tool", "lxml", "zenoh"))
    folders = (Path(module.origin).parents[1] for module in modules if module and module.origin)
    return {"PYTHONPATH": os.pathsep.join(dict.fromkeys(map(str, folders)))}


@dataclass(frozen=True)
class Backend:
    """The library that the demo's nodes use; ``why`` is the reason for the choice, in one line.

    ``name`` is `RCLPY`, `CYCLONE` or `ZENOH`.  ``dds`` is the name and version of the DDS, or of
    Zenoh.  With ``ros_observer``, an unsecured
    observer of Cyclone nodes is an rclpy node; ``rmw`` is the RMW of rclpy.
    """

    name: str
    dds: str
    why: str
    rmw: str = ""
    ros_observer: bool = False

    @property
    def rows_at_once(self) -> int:
        """The number of rows to run in parallel; starting an rclpy node takes 0.6 s of CPU."""
        return {RCLPY: 4, ZENOH: 8}.get(self.name, 16)

    @property
    def on_zenoh(self) -> bool:
        """Whether the nodes run on Zenoh, and not on a DDS."""
        return self.name == ZENOH

    @property
    def checks_signers(self) -> bool:
        """Whether the DDS accepts only the permissions CA as signer of permissions.

        An unknown version of Fast DDS counts as recent.
        """
        if not self.dds.startswith("Fast DDS"):
            return self.dds.startswith("Cyclone DDS 11.")
        parts = self.dds.rpartition(" ")[2].split(".")
        version = tuple(int(part) for part in parts if part.isdigit())
        if len(version) < 3 or version >= (2, 10):
            return True
        return any(version[:2] == first[:2] and version >= first for first in _SIGNERS_CHECKED)

    @property
    def seconds_until_forgotten(self) -> float:
        """Seconds for which peers still know a secured node that has ended.

        Cyclone DDS 11 announces the end of a participant only unencrypted. Peers do not believe
        that, and keep the participant until its lease expires (tested).
        """
        return 10.0 if self.dds.startswith("Cyclone DDS 11.") else 0.0

    def wire_name(self, topic: str, domain: int) -> str:
        """Return the name of a ROS topic as packets have it."""
        return f"{domain}{topic}/" if self.on_zenoh else f"rt{topic}"

    @property
    def vendor(self) -> Condition | None:
        """The condition for results of Cyclone DDS or of Fast DDS; None for other middleware."""
        if self.dds.startswith("Cyclone DDS"):
            return Condition.CYCLONE
        return Condition.FAST if self.dds.startswith("Fast DDS") else None

    def library(self, role: Role, *, secured: bool = False) -> str:
        """Return the library that a node in a role uses."""
        if self.name == RCLPY or (role is Role.OBSERVER and self.ros_observer and not secured):
            return RCLPY
        return self.dds

    def command(
        self, role: Role, options: Sequence[str], names: Sequence[str], *, secured: bool = False
    ) -> list[str]:
        """Return the command line of a process in a role.

        ``names`` are the absolute names of the role's ROS nodes, from `node_names`.
        """
        if self.library(role, secured=secured) == RCLPY:
            program = [*_PYTHON, "-m", "sros_tool.demo.ros_node", role.value]
            return [*program, *options, *naming_arguments(role, names)]
        return [*_LEAN_PYTHON, "-m", "sros_tool.demo.cyclone_node", role.value, *options]

    def zenoh_command(self, role: Role, options: Sequence[str], enclave: str) -> list[str]:
        """Return the command line of a process on Zenoh, with the enclave that it announces."""
        named = ["--ros-args", "--enclave", enclave, "--"] if enclave else []
        program = [*_LEAN_PYTHON, "-m", "sros_tool.demo.zenoh_node", role.value]
        return [*program, *options, *named]

    def environment(
        self, role: Role, *, wire: bool = False, denied: bool = False, secured: bool = False
    ) -> Mapping[str, str]:
        """Return the environment variables that a node needs besides its security variables.

        ``wire`` keeps messages out of shared memory; ``denied`` makes the node log why it is
        denied.
        """
        if self.on_zenoh:
            return _module_path_variable()
        on_ros = self.library(role, secured=secured) == RCLPY
        variables = {} if on_ros else {**_module_path_variable()}
        if on_ros and self.rmw:
            variables[RMW] = self.rmw
        if on_ros and wire:
            variables |= _WITHOUT_SHARED_MEMORY
        if denied and not on_ros:
            # Traced to stdout, because `CycloneLog` takes the stderr of the C library.
            variables |= denial_trace_variables("stdout")
        elif denied and (below := middleware_of(self.rmw)):
            variables |= below.trace_variables
        return variables


def choose_backend(wished_backend: str, probe: ProbeEnclave) -> Backend:
    """Try the backends that ``wished_backend`` allows, and return the first that enforces security.

    ``wished_backend`` is `AUTO`, `RCLPY` or `CYCLONE`.

    Raises:
        UnavailableError: no such backend enforces security here.
    """
    if wished_backend == CYCLONE:
        return _cyclone(cyclone_stack(probe), _CHOSEN_BY_USER)
    stacks = []
    for stack in rclpy_stacks(probe):
        stacks.append(stack)
        if stack.enforces:
            why = (
                _CHOSEN_BY_USER
                if wished_backend == RCLPY
                else f"{stack.name} enforces security here"
            )
            return Backend(RCLPY, f"{stack.dds} {stack.version}".strip(), why, stack.rmw)
    reason = _why_not(stacks)
    if wished_backend == RCLPY:
        raise UnavailableError(
            "rclpy has no RMW here that is known to enforce security", reason, _NO_RCLPY
        )
    return _cyclone(cyclone_stack(probe), reason)


_OLDEST_ZENOH = (1, 10)
"""The oldest supported version: rows rely on its log texts."""


def zenoh_backend() -> Backend:
    """Return the backend that runs the nodes on Zenoh.

    Raises:
        UnavailableError: the package eclipse-zenoh is not installed, or too old.
    """
    try:
        version = metadata.version("eclipse-zenoh")
    except metadata.PackageNotFoundError:
        version = ""
    if not version or importlib.util.find_spec("zenoh") is None:
        raise UnavailableError(
            "the demo on Zenoh needs the package eclipse-zenoh",
            "It is not installed in this Python.",
            "Install it with `pip install 'eclipse-zenoh>=1.10.1'`.",
        )
    numbers = tuple(int(part) for part in version.split(".")[:2] if part.isdigit())
    if numbers < _OLDEST_ZENOH:
        raise UnavailableError(
            f"the demo on Zenoh needs eclipse-zenoh {'.'.join(map(str, _OLDEST_ZENOH))} or newer",
            f"Version {version} is installed in this Python.",
            "Upgrade it with `pip install --upgrade 'sros_tool[zenoh]'`.",
        )
    return Backend(ZENOH, f"Zenoh {version}", _CHOSEN_BY_USER)


def _cyclone(stack: Stack, why: str) -> Backend:
    if not stack.enforces:
        raise UnavailableError(
            "no DDS here is known to enforce security",
            f"{stack.name}: {stack.evidence}. {'' if why == _CHOSEN_BY_USER else why}",
            INSTALL_ADVICE,
        )
    rmw = _observing_rmw()
    dds = f"{stack.dds} {stack.version}".strip()
    return Backend(CYCLONE, dds, why, rmw or "", ros_observer=rmw is not None)


def _observing_rmw() -> str | None:
    """Return an RMW that discovers unsecured Cyclone nodes ("": rclpy's default), or None."""
    if importlib.util.find_spec("rclpy") is None:
        return None
    names = rmw_implementations(os.environ)
    fitting = [name for name in names if vendor_of(name)]
    return fitting[0] if fitting else (None if names else "")


def _why_not(stacks: Sequence[Stack]) -> str:
    present = [stack for stack in stacks if stack.present]
    if not present:
        return "rclpy is not installed here"
    clauses = []
    for was_tried, what in ((True, "does not enforce security"), (False, "could not be tried")):
        of_it = [stack for stack in present if (stack.enforces is not None) is was_tried]
        names = " and ".join(stack.rmw or "its RMW" for stack in of_it)
        clauses += [f"rclpy with {names} {what} here"] if names else []
    return f"{', and '.join(clauses)} (`sros doctor` shows why)"


_SIGNERS_CHECKED = ((2, 1, 4), (2, 6, 5), (2, 8, 2), (2, 9, 2))
"""First release of older branches of Fast DDS that accepts only signers in the permissions CA file.

These releases, and all since 2.10, fix CVE-2023-24010. Source: tags of the repository.
"""

_ENCRYPTING_KINDS = (ProtectionKind.ENCRYPT, ProtectionKind.ENCRYPT_WITH_ORIGIN_AUTHENTICATION)


def conditions(backend: Backend, template: Template, topic: str) -> frozenset[Condition]:
    """Return the conditions that hold for a DDS topic with this backend and template.

    On Zenoh, the conditions do not depend on the template.
    """
    if backend.on_zenoh:
        return frozenset()
    (domain,) = governance_for(template.protection, DomainSet.of((0, 0))).domain_access_rules
    rule = next(rule for rule in domain.topic_access_rules if matches(rule.topic_expression, topic))
    kinds = (
        domain.rtps_protection_kind,
        rule.metadata_protection_kind,
        rule.data_protection_kind,
    )
    unauthenticated = domain.allow_unauthenticated_participants
    is_unprotected = all(kind is ProtectionKind.NONE for kind in kinds)
    uncontrolled = not (rule.enable_read_access_control or rule.enable_write_access_control)
    holding = {
        Condition.ONE_CA: not template.separate_authorities,
        Condition.SHARED_SUBJECTS: not template.unique_subject,
        Condition.OPEN_DEFAULT: template.default_permissions == EVERYTHING,
        Condition.IN_CLEAR: not any(kind in _ENCRYPTING_KINDS for kind in kinds),
        Condition.UNSIGNED: is_unprotected,
        Condition.UNAUTHENTICATED: unauthenticated and is_unprotected and uncontrolled,
        Condition.UNAUTHENTICATED_SEE: unauthenticated and not rule.enable_discovery_protection,
        Condition.UNCONTROLLED: uncontrolled,
        Condition.OPEN_JOIN: not domain.enable_join_access_control,
        Condition.EXACT_SIGNER: backend.checks_signers,
    }
    vendor = {backend.vendor} if backend.vendor else set()
    return frozenset(name for name, holds in holding.items() if holds) | vendor


_SECONDS_TO_START = 60.0
_SECONDS_TO_STOP = 5.0
_SILENCE_SECONDS = 5.0
"""Seconds without a message or connection after which a node reports silence."""

_LIBRARIES = {CYCLONE: "Cyclone DDS", RCLPY: "rclpy", ZENOH: "Zenoh"}
_MODULES = {CYCLONE: "cyclone", RCLPY: "ros", ZENOH: "zenoh"}
_MAX_EVENT_BYTES = 1 << 20
"""Maximum size of an event in bytes; after a longer event, the reports of a process are ignored."""


@dataclass(frozen=True)
class HandNode:
    """A node to run by hand, with its absolute ROS topic and the ROS type of its messages."""

    role: Role
    backend: str
    topic: str
    type: str = STRING

    def __post_init__(self) -> None:
        if self.role is Role.ROUTER and self.backend != ZENOH:
            raise UsageError(
                "only Zenoh has routers",
                "Nodes on DDS find each other without a router.",
                "Add --backend zenoh.",
            )
        if self.type != STRING and (self.role is not Role.TALKER or self.backend != RCLPY):
            raise UsageError(
                "--type is only for a talker on rclpy",
                "Only rclpy has the types of your ROS packages, and a listener needs no --type.",
                "Use `sros demo talker --backend rclpy` in an environment of ROS 2.",
            )
        if re.fullmatch(r"[A-Za-z]\w*/msg/[A-Za-z]\w*", self.type, re.ASCII) is None:
            raise UsageError(
                f"{self.type!r} is not a message type",
                "",
                "Write PACKAGE/msg/NAME, such as geometry_msgs/msg/Twist.",
            )
        if self.backend == ZENOH:
            zenoh_backend()


def security_line(node: HandNode, environment: Mapping[str, str]) -> str:
    """Return a line that names the library on which the node runs, and says whether it is secured.

    Raises:
        SrosError: The environment demands security, and the enclave cannot be loaded.
    """
    if node.backend == ZENOH:
        kind = "ROUTER" if node.role is Role.ROUTER else "SESSION"
        uri = environment.get(f"ZENOH_{kind}_CONFIG_URI", "")
        security = f"configured by {uri}" if uri else "WITHOUT security"
        if not uri and environment.get(ENABLE) == "true":
            security += (
                ", because Zenoh ignores ROS_SECURITY_*: add --rmw rmw_zenoh_cpp to `sros run`"
            )
    else:
        choice = choose_loadable(environment)
        name = environment.get(ENCLAVE) or "/"
        security = f"secured, in the enclave {name}" if choice.enclave else "WITHOUT security"
    topic = "" if node.role is Role.ROUTER else f", topic {node.topic}"
    if node.role is Role.LISTENER and node.topic == DEFAULT_TOPIC:
        topic += " (--topic names another one)"
    domain = domain_of(environment)
    return f"{node.role} on {_LIBRARIES[node.backend]}{topic}, domain {domain}: {security}"


def backend_by_hand(role: Role, environment: Mapping[str, str]) -> str:
    """Return the backend of a node run by hand, for a user who names no backend.

    Secured nodes of Fast DDS and of Cyclone DDS do not hear each other (tested: 2.14.5 and 0.10.2),
    but open nodes do.
    """
    if role is Role.ROUTER or environment.get(RMW) == "rmw_zenoh_cpp":
        return ZENOH
    rmw = _rmw_here(environment)
    on_cyclone = vendor_of(rmw) is Vendor.CYCLONE or built_without_security(rmw, environment)
    if importlib.util.find_spec("rclpy") is None:
        return CYCLONE
    if environment.get(ENABLE) == "true":
        return RCLPY if vendor_of(rmw) and not on_cyclone else CYCLONE
    try:
        load_cyclone()
    except UnavailableError:
        return RCLPY
    return CYCLONE


def _rmw_here(environment: Mapping[str, str]) -> str:
    """Return the RMW of this shell, or else an installed RMW that uses DDS, or ""."""
    installed = rmw_implementations(environment)
    return environment.get(RMW) or next(filter(vendor_of, installed), "")


def _vendor_mismatch_clause(node: HandNode, environment: Mapping[str, str]) -> str:
    """Return a clause if secured ROS nodes of this shell and ``node`` do not hear each other."""
    rmw = _rmw_here(environment)
    differs_in_vendor = node.backend == CYCLONE and vendor_of(rmw) not in (None, Vendor.CYCLONE)
    if not differs_in_vendor or environment.get(ENABLE) != "true":
        return ""
    lacks = built_without_security(rmw, environment)
    but = f"{rmw} was built without security here" if lacks else "add --backend rclpy"
    return f"secured nodes on {rmw} and this node do not hear each other: {but}"


def run_by_hand(
    node: HandNode, say: Callable[[str], None], duration: timedelta | None = None
) -> int:
    """Run a node for ``duration``, or until a signal; return the exit status of the node.

    The duration begins when the node is ready, or on Zenoh when the node starts. A node that is not
    ready within a minute is stopped.  ``say`` gets lines about what is sent and heard, without line
    breaks at their ends.

    Raises:
        SrosError: The environment demands security, and the enclave cannot be loaded.
    """
    say(f"{security_line(node, os.environ)} (stop with Ctrl-C)")
    if not_heard := _vendor_mismatch_clause(node, os.environ):
        say(not_heard)
    events, writing = os.pipe()
    module = f"sros_tool.demo.{_MODULES[node.backend]}_node"
    command = [sys.executable, "-P", "-m", module, node.role.value, "--period", "1"]
    if node.role is not Role.ROUTER:
        command += ["--topic", node.topic, "--by-hand", "--type", node.type]
    is_secured = node.backend == ZENOH or os.environ.get(ENABLE) == "true"
    enclave = os.environ.get(ENCLAVE, "") if is_secured else ""
    if enclave and node.role is Role.TALKER:  # so that a listener shows whom it heard
        command += ["--text", f"{NodeOptions.text} from {enclave}"]
    if enclave and node.backend == ZENOH:
        command += ["--ros-args", "--enclave", enclave, "--"]
    if node.backend == RCLPY:  # this process already prints each message
        command += ["--ros-args", "--log-level", "warn", "--"]
    command += ["--report", f"/proc/self/fd/{writing}"]
    stopped, heard, seen = threading.Event(), 0, ""

    def remember(event: Event) -> None:
        nonlocal heard, seen
        heard += event.count if event.kind is EventKind.HEARD else 0
        seen = (event.text if event.kind is EventKind.SEEN else "") or seen

    def stop(*_: object) -> None:
        again = stopped.is_set()
        stopped.set()
        end_within(0 if again else _SECONDS_TO_STOP, process)

    environment = {
        **_WITHOUT_SHARED_MEMORY,
        "CYCLONEDDS_URI": MORE_PARTICIPANTS,
        **os.environ,
    }
    with subprocess.Popen(
        command, pass_fds=[writing], preexec_fn=end_with_starter(), env=environment
    ) as process:
        os.close(writing)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, stop)

        def stop_after(seconds: float) -> threading.Timer:
            timer = threading.Timer(seconds, stop)
            timer.daemon = True
            timer.start()
            return timer

        until_ready = None
        if duration is not None:
            # A node on Zenoh may never connect, which is an answer, too.
            from_start = duration.total_seconds() if node.backend == ZENOH else _SECONDS_TO_START
            until_ready = stop_after(from_start)

        def start_duration() -> None:
            if duration and until_ready and node.backend != ZENOH:
                until_ready.cancel()
                stop_after(duration.total_seconds())

        with open(events, "rb", buffering=0) as pipe:
            try:
                last = _report(node, pipe.fileno(), say, on_ready=start_duration, on_event=remember)
            except BaseException:  # such as nobody who reads the lines any more
                end_within(_SECONDS_TO_STOP, process)
                process.wait()
                raise
        status = process.wait()
    if stopped.is_set():
        by_force = ", by force: it did not end by itself" * (status == -signal.SIGKILL)
        results = {
            Role.LISTENER: f"; heard {counted(heard, 'message')}",
            Role.TALKER: f"; {seen or f'found no subscription of {node.topic}'}",
        }
        result = results.get(node.role, "")
        was_short = duration is not None and duration.total_seconds() < _SILENCE_SECONDS
        done = heard if node.role is Role.LISTENER else seen
        if result and was_short and not done:
            result += ", but the time may be too short to connect to other nodes: use --for 10s"
        say(f"stopped{by_force}{result}")
    elif last and last.stage is ProcessStage.ENDPOINT and os.environ.get(ENABLE) == "true":
        verb = "publish" if node.role is Role.TALKER else "subscribe"
        asked = shlex.join((os.environ.get(KEYSTORE, ""), os.environ.get(ENCLAVE) or "/", verb))
        say(f"to see whether this enclave may do that: sros explain {asked} {node.topic}")
    elif status and node.backend == RCLPY:
        say("`sros doctor` says whether rclpy on this machine can be secured")
    return status


def end_within(seconds: float, process: subprocess.Popen[bytes]) -> None:
    """Ask a process to end, and kill it after ``seconds``.

    A node that waits in its library, such as for a router that is gone, handles no signal.
    """
    process.terminate()
    timer = threading.Timer(seconds, process.kill)
    timer.daemon = True
    timer.start()


def _report(
    node: HandNode,
    pipe: int,
    say: Callable[[str], None],
    *,
    on_ready: Callable[[], None],
    on_event: Callable[[Event], None],
) -> Event | None:
    """Pass the node's reports to ``say`` until the node ends, and return the last report or None.

    ``on_event`` gets all reports. ``on_ready`` is called when the node is ready. Before that
    moment, the node hears nothing in any case.

    Raises:
        SrosError: a report is too long.
    """
    data, seen, event = b"", "", None
    is_ready = False
    while len(data) < _MAX_EVENT_BYTES:
        ready, _, _ = select.select([pipe], [], [], _SILENCE_SECONDS)
        if not ready:
            if not is_ready and node.backend != ZENOH:
                say(f"not ready after {_SILENCE_SECONDS:.0f} s: the node is still starting")
            elif not is_ready:
                say(
                    f"not connected for {_SILENCE_SECONDS:.0f} s: no router runs (`sros demo "
                    "router` starts one), or the router refuses this node"
                )
            elif node.role is Role.LISTENER:
                none = f": no publisher of {node.topic} is visible"
                why = f", although {seen}" if seen else none * (node.backend != ZENOH)
                say(f"heard nothing for {_SILENCE_SECONDS:.0f} s{why}")
            continue
        if not (more := os.read(pipe, 65536)):
            return event
        *lines, data = (data + more).split(b"\n")
        for line in lines:
            event = parse_event(line, Path("the node's report"))
            on_event(event)
            if event.kind is EventKind.READY and not is_ready:
                is_ready = True
                on_ready()
            seen = event.text if event.kind is EventKind.SEEN else seen
            if text := _line(event, node.type):
                say(text)
    raise SrosError(
        "a node reported a message that is too long", f"It is over {_MAX_EVENT_BYTES} bytes long."
    )


def _line(event: Event, own_type: str) -> str:
    match event.kind:
        case EventKind.SENT:
            return f"sent   {event.text}"
        case EventKind.HEARD:
            return f"heard  {event.text}"
        case EventKind.REFUSED | EventKind.FAILED:
            return f"{event.kind}: {' '.join(event.text.split())}"
        case EventKind.READY:
            return "ready"
        case EventKind.SEEN if not event.text.endswith(f"of {own_type}"):
            return event.text
        case _:
            return ""
