"""Find out which installed DDS stacks enforce security, by trying them with an enclave.

The name or version of a library does not show how it was built, so each stack is tried in a
separate process.  Only two results mean "does not enforce": the stack reports that security is not
built in, or creates an endpoint that the permissions deny.  Any other failure means "could not be
tried".

The separate process runs this module: it joins with the enclave that the environment names, creates
endpoints that the enclave's permissions allow and endpoints that they deny, and reports the
results. The parent judges the results, so that a crash of the process does not count as a refusal.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import logging
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, NamedTuple

from sros_tool.errors import SrosError
from sros_tool.parallel import end_with_parent
from sros_tool.runtime.cyclone import (
    INSTALL_ADVICE,
    Participant,
    SecurityRefusedError,
    loaded_libraries,
    plugins_next_to,
    security_properties,
    version_of,
)
from sros_tool.runtime.events import (
    Event,
    EventKind,
    EventWriter,
    ProcessStage,
    read_events,
    signal_name,
)
from sros_tool.runtime.netns import enter_isolation, try_isolation
from sros_tool.runtime.rmw import (
    MIDDLEWARE,
    RMW,
    middleware_of,
    package_version,
    rmw_implementations,
)
from sros_tool.runtime.variables import choose_enclave, domain_of
from sros_tool.runtime.vendor_log import (
    endpoint_refusal,
    missing_security,
    participant_refusal,
    plain_text,
)
from sros_tool.values import Words
from sros_tool.zenoh.releases import release_of, version_text, why_too_old

_LOG = logging.getLogger(__name__)

_PROBE_SECONDS = 60.0

ROS_ADVICE = (
    "Use the ROS 2 packages of Ubuntu (such as ros-jazzy-ros-base or ros-kilted-ros-base): they "
    "have DDS Security built in, and the wheels on PyPI do not."
)
_ZENOH_ADVICE = (
    "It enforces the files that `sros zenoh KEYSTORE` writes, not those of DDS Security."
)
_EXIT_SECONDS = 5.0


class ProbeEnclave(NamedTuple):
    """The secured environment of a probe, with an allowed and a denied ROS topic.

    ``environment`` has the ROS_SECURITY_* variables and ROS_DOMAIN_ID of an enclave that may
    publish ``allowed``, and neither publish nor subscribe to ``denied``.
    """

    environment: Mapping[str, str]
    allowed: str
    denied: str


class Stack(NamedTuple):
    """An installed or missing DDS stack, and whether it enforces security."""

    name: str
    """Name of the stack."""
    kind: Annotated[str, Words(("cyclone", "rmw", "cyclonedds"))]
    """Kind of the stack: libddsc, an RMW of rclpy, or the Python package ``cyclonedds``."""
    dds: str
    """Name of the DDS."""
    version: str = ""
    """Version of the DDS; empty if unknown."""
    where: str = ""
    """Path of the DDS library; empty if unknown."""
    present: bool = True
    """Whether the stack is installed."""
    enforces: bool | None = None
    """Whether the stack enforces security; null if it could not be tried."""
    evidence: str = ""
    """Description of the attempt and the observed result."""
    advice: str = ""
    """What to do, or an empty string."""
    rmw: str = ""
    """Name of the RMW; empty if the stack is not an RMW."""


# ── the stacks ──────────────────────────────────────────────────────────────────────────


def survey(probe: ProbeEnclave) -> tuple[Stack, ...]:
    """Return all stacks that sros knows, after trying them; also stacks that are not installed."""
    return (*rclpy_stacks(probe), cyclone_stack(probe), _cyclonedds_package_stack(probe))


def rclpy_stacks(probe: ProbeEnclave) -> Iterator[Stack]:
    """Try all installed RMWs of rclpy in turn, the default first, and yield the results."""
    if importlib.util.find_spec("rclpy") is None:
        yield _without_rclpy()
        return
    for name in rmw_implementations(os.environ) or ("",):
        yield _probe_rmw(probe, name)


def cyclone_stack(probe: ProbeEnclave) -> Stack:
    """Try the libddsc that sros uses (`sros_tool.runtime.cyclone`), and return the result."""
    stack = _with_probe_result(
        Stack("Cyclone DDS (libddsc)", "cyclone", "Cyclone DDS"), "cyclone", probe
    )
    if not stack.version and "cannot find Cyclone DDS" in stack.evidence:
        evidence = stack.evidence.removeprefix(_UNTRIED)
        stack = stack._replace(present=False, enforces=None, evidence=evidence)
    return stack._replace(advice="" if stack.enforces else INSTALL_ADVICE)


def _cyclonedds_package_stack(probe: ProbeEnclave) -> Stack:
    """Try the Python package ``cyclonedds``, which contains a libddsc, and return the result."""
    stack = Stack("cyclonedds (Python package)", "cyclonedds", "Cyclone DDS")
    spec = importlib.util.find_spec("cyclonedds")
    if spec is None:
        return stack._replace(present=False)
    stack = _with_probe_result(stack, "cyclonedds", probe)
    if stack.enforces is None and stack.where and not _has_plugins(Path(stack.where)):
        evidence = (
            "a secured participant fails, and the package has no libdds_security_*.so."
            f" {stack.evidence.partition(': ')[2]}"
        )
        stack = stack._replace(enforces=False, evidence=evidence)
    needless = "sros does not need this package: it uses libddsc directly."
    return stack._replace(
        version=stack.version or _package_version("cyclonedds"),
        where=stack.where or str(spec.origin or ""),
        advice="" if stack.enforces else needless,
    )


def _probe_rmw(probe: ProbeEnclave, rmw: str) -> Stack:
    variables = {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}  # no files in shared memory
    if rmw:
        variables[RMW] = rmw
    if below := middleware_of(rmw):
        variables |= below.trace_variables
    stack = Stack(f"rclpy with {rmw or 'its default RMW'}", "rmw", "", rmw=rmw)
    stack = _with_probe_result(stack, "rclpy", probe, variables)
    if below and below.name == "Zenoh":
        return _with_release(stack)
    return stack._replace(advice="" if stack.enforces else ROS_ADVICE)


def _with_release(stack: Stack) -> Stack:
    """Return an RMW on Zenoh with its installed release, and a note on its security."""
    version = package_version(stack.rmw, os.environ)
    if version is None:
        return stack._replace(advice=_ZENOH_ADVICE)
    text = f"({stack.rmw} {version_text(version)}, as in ROS 2 {release_of(version).distribution})"
    return stack._replace(
        dds="Zenoh",
        version=f"{stack.version} {text}".lstrip(),
        advice=why_too_old(version) or _ZENOH_ADVICE,
    )


def _without_rclpy() -> Stack:
    advice = ""
    if installed := sorted(Path("/opt/ros").glob("*/setup.sh")):
        advice = f"ROS 2 is installed but not set up in this shell: run `. {installed[-1]}` first."
    return Stack("rclpy", "rmw", "", present=False, advice=advice)


def _with_probe_result(
    stack: Stack, kind: str, probe: ProbeEnclave, variables: Mapping[str, str] | None = None
) -> Stack:
    """Return ``stack`` with the result of a probe of the given kind."""
    run = _run_probe(kind, probe, variables or {})
    verdict = judge(run, probe.allowed, probe.denied)
    dds, version, where = _identity(run)
    return stack._replace(
        dds=dds or stack.dds,
        version=version,
        where=where,
        enforces=verdict.enforces,
        evidence=verdict.evidence,
    )


def _identity(run: ProbeRun) -> tuple[str, str, str]:
    for event in run.events:
        if event.kind is EventKind.SEEN and event.text.count("\n") == 2:
            name, version, where = event.text.split("\n")
            return name, version, where
    return "", "", ""


def _has_plugins(library: Path) -> bool:
    return any(library.parent.glob("**/libdds_security_auth*.so*"))


def _package_version(name: str) -> str:
    with suppress(importlib.metadata.PackageNotFoundError):
        return importlib.metadata.version(name)
    return ""


# ── trying one ──────────────────────────────────────────────────────────────────────────


class ProbeRun(NamedTuple):
    """The reports, the output and the exit status of a probe process.

    ``status`` is negative for a signal, and None if the process had to be stopped.
    """

    events: tuple[Event, ...]
    output: str
    status: int | None


def _run_probe(kind: str, probe: ProbeEnclave, extra_variables: Mapping[str, str]) -> ProbeRun:
    with TemporaryDirectory(prefix="sros-probe-") as folder:
        report, log = Path(folder, "report.jsonl"), Path(folder, "log.txt")
        environment = {
            name: value
            for name, value in os.environ.items()
            if not name.startswith("ROS_SECURITY_")
        }
        environment |= {**probe.environment, **extra_variables, "ROS_LOG_DIR": folder}
        # -P: never import modules from the current folder.
        command = [sys.executable, "-P", "-m", "sros_tool.runtime.stacks", kind, str(report)]
        with log.open("wb") as output:
            process = subprocess.Popen(
                [*command, probe.allowed, probe.denied],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                env=environment,
                start_new_session=True,
                preexec_fn=end_with_parent,
            )
            _LOG.info("started process %d: %s", process.pid, shlex.join(command))
            status = _wait(process)
            _LOG.info("process %d ended with status %s", process.pid, status)
        printed = plain_text(log.read_text(encoding="utf-8", errors="replace"))
        return ProbeRun(tuple(read_events(report)), printed, status)


def _wait(process: subprocess.Popen[bytes]) -> int | None:
    try:
        return process.wait(_PROBE_SECONDS)
    except subprocess.TimeoutExpired:
        return None
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait(_EXIT_SECONDS)


# ── judging what was seen ───────────────────────────────────────────────────────────────


class ProbeVerdict(NamedTuple):
    """The result of a probe: whether a DDS enforces security (None: not tried), with evidence."""

    enforces: bool | None
    evidence: str


def judge(run: ProbeRun, allowed: str, denied: str) -> ProbeVerdict:
    """Return the verdict on a run with a writer on ``allowed`` and endpoints on ``denied``."""
    text = "\n".join([run.output, *(event.text for event in run.events)])
    if lacking := missing_security(text):
        return ProbeVerdict(False, f"a secured participant fails: {lacking}")
    if not _has_event(run.events, EventKind.READY, ProcessStage.PARTICIPANT):
        return _untried_verdict(_why_not_joined(run, text))
    answers = {
        event.text.partition("\n")[0]: event
        for event in run.events
        if event.stage is ProcessStage.ENDPOINT
    }
    wanted = answers.get(f"writer {allowed}")
    if wanted is None or wanted.kind is not EventKind.READY:
        return _untried_verdict(
            f"even the allowed writer on {allowed} failed. {_reason(wanted, run)}"
        )
    asked = [f"writer {denied}", f"reader {denied}"]
    for question in asked:
        answer = answers.get(question)
        if answer is None:
            return _untried_verdict(f"no answer about the {question}. {_exit_text(run)}")
        if answer.kind is EventKind.READY:
            return ProbeVerdict(
                False, f"it created a {question}, which its permissions do not allow"
            )
    refusals = [_refusal(answers[question], run, denied) for question in asked]
    if not all(refusals):
        reason = _reason(answers[asked[0]], run)
        return _untried_verdict(
            f"endpoints on {denied} failed, but not because security refused them. {reason}"
        )
    return ProbeVerdict(
        True,
        f"with an enclave made by sros, it created the allowed writer on {allowed} and refused the"
        f" denied writer and reader on {denied}: {refusals[0]}",
    )


def _refusal(answer: Event, run: ProbeRun, topic: str) -> str:
    if answer.kind is EventKind.REFUSED:
        return answer.text.partition("\n")[2]
    lines = [line for line in run.output.splitlines() if topic in line or "SECURITY" in line]
    return endpoint_refusal("\n".join([answer.text, *lines]))


def _why_not_joined(run: ProbeRun, text: str) -> str:
    failed = _first(run.events, EventKind.FAILED) or _first(run.events, EventKind.REFUSED)
    refusal = participant_refusal(text) or endpoint_refusal(text)
    if refusal:
        return f"the participant itself was refused: {refusal}"
    return _reason(failed, run)


def _reason(event: Event | None, run: ProbeRun) -> str:
    if event is None:
        return _exit_text(run)
    return " ".join(event.text.split())


def _exit_text(run: ProbeRun) -> str:
    if run.status is None:
        return "The probe process gave no answer in time."
    if run.status < 0:
        return f"The probe process was ended by {signal_name(-run.status)}."
    last = run.output.strip().splitlines()[-1:]
    return f"The probe process ended with status {run.status}. {' '.join(last)}".strip()


def _has_event(events: Sequence[Event], kind: EventKind, stage: ProcessStage) -> bool:
    return any(event.kind is kind and event.stage is stage for event in events)


def _first(events: Sequence[Event], kind: EventKind) -> Event | None:
    return next((event for event in events if event.kind is kind), None)


_UNTRIED = "could not be tried: "


def _untried_verdict(why: str) -> ProbeVerdict:
    return ProbeVerdict(None, f"{_UNTRIED}{why}")


_LOG_FLUSH_SECONDS = 0.3

CreateEndpoint = Callable[[str, str], None]
"""A function that creates an endpoint ("writer" or "reader") on a ROS topic ("/chatter")."""

Close = Callable[[], None]
"""A function that leaves the domain."""


def _join_rclpy() -> tuple[CreateEndpoint, Close]:
    """Join as a node of rclpy with the RMW of ``RMW_IMPLEMENTATION``, or rclpy's default.

    Return a function that creates an endpoint, and a function that leaves.
    """
    import rclpy
    from std_msgs.msg import String

    rclpy.init()
    node = rclpy.create_node("talker")

    def create_endpoint(kind: str, topic: str) -> None:
        if kind == "writer":
            node.create_publisher(String, topic, 10)
        else:
            node.create_subscription(String, topic, lambda _message: None, 10)

    def close() -> None:
        node.destroy_node()
        rclpy.try_shutdown()

    return create_endpoint, close


def _join_cyclone() -> tuple[CreateEndpoint, Close]:
    """Join as a participant with the libddsc that `sros_tool.runtime.cyclone` loads.

    The result is as for `_join_rclpy`.
    """
    participant = Participant(domain_of(os.environ), choose_enclave(os.environ).enclave)

    def create_endpoint(kind: str, topic: str) -> None:
        if kind == "writer":
            participant.writer(f"rt{topic}")
        else:
            participant.reader(f"rt{topic}")

    return create_endpoint, participant.close


def _join_with_cyclonedds_package() -> tuple[CreateEndpoint, Close]:
    """Join as a participant of the Python package ``cyclonedds``, with its own libddsc.

    The result is as for `_join_rclpy`.
    """
    core, domain, idl, pub, sub, topics = (
        importlib.import_module(f"cyclonedds.{name}")
        for name in ("core", "domain", "idl", "pub", "sub", "topic")
    )
    enclave = choose_enclave(os.environ).enclave
    properties = {} if enclave is None else security_properties(enclave, _package_plugins())
    qos = core.Qos(*(core.Policy.Property(name, value) for name, value in properties.items()))
    participant = domain.DomainParticipant(domain_of(os.environ), qos)
    string = idl.make_idl_struct("String_", "std_msgs.msg.dds_.String_", {"data": str})

    def create_endpoint(kind: str, topic: str) -> None:
        made = topics.Topic(participant, f"rt{topic}", string)
        (pub.DataWriter if kind == "writer" else sub.DataReader)(participant, made)

    return create_endpoint, lambda: None


_JOINS: dict[str, Callable[[], tuple[CreateEndpoint, Close]]] = {
    "rclpy": _join_rclpy,
    "cyclone": _join_cyclone,
    "cyclonedds": _join_with_cyclonedds_package,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Join, then create endpoints on two topics; arguments are ``KIND REPORT ALLOWED DENIED``.

    KIND is a key of `_JOINS`, REPORT the file for the events, ALLOWED and DENIED are ROS topics.
    Returns the exit status.
    """
    kind, report, allowed, denied = sys.argv[1:] if arguments is None else arguments
    if try_isolation().isolated:
        enter_isolation()
    events = EventWriter(Path(report))
    try:
        create_endpoint, close = _JOINS[kind]()
    except Exception as error:
        stage = ProcessStage.IMPORT if isinstance(error, ImportError) else ProcessStage.PARTICIPANT
        events.report(EventKind.SEEN, _dds_in_memory())
        _report_failure(events, error, stage, "")
        return 1
    events.report(EventKind.SEEN, _dds_in_memory())
    events.report(EventKind.READY, stage=ProcessStage.PARTICIPANT)
    for what, topic in (("writer", allowed), ("writer", denied), ("reader", denied)):
        try:
            create_endpoint(what, topic)
        except Exception as error:
            _report_failure(events, error, ProcessStage.ENDPOINT, f"{what} {topic}")
        else:
            events.report(EventKind.READY, f"{what} {topic}", stage=ProcessStage.ENDPOINT)
    time.sleep(_LOG_FLUSH_SECONDS)
    events.report(EventKind.DONE)
    close()
    return 0


def _report_failure(
    events: EventWriter, error: Exception, stage: ProcessStage, asked_endpoint: str
) -> None:
    refused = isinstance(error, SecurityRefusedError)
    reason = f"{type(error).__name__}: {error}"
    if isinstance(error, SrosError):
        # The remedy is left out: it depends on the results of all stacks.
        reason = str(SrosError(error.what, error.why)).rstrip(".")
    if stage is not ProcessStage.ENDPOINT:
        time.sleep(_LOG_FLUSH_SECONDS)
    text = f"{asked_endpoint}\n{reason}" if asked_endpoint else reason
    events.report(EventKind.REFUSED if refused else EventKind.FAILED, text, stage=stage)


def _dds_in_memory() -> str:
    """Return name, version and file of the DDS in this process, as lines; "" without a DDS."""
    for middleware in MIDDLEWARE:
        for prefix in middleware.libraries:
            for file in loaded_libraries(prefix):
                return f"{middleware.name}\n{version_of(file)}\n{file}"
    return ""


def _package_plugins() -> Path | None:
    folders = (plugins_next_to(file) for file in loaded_libraries("libddsc"))
    return next((folder for folder in folders if folder is not None), None)


if __name__ == "__main__":
    sys.exit(main())
