"""Looks at the ROS graph for a verb: where, how long, and why it failed or saw nothing."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from sros_tool.cli.common import keystore_from_environment
from sros_tool.errors import SrosError, UnavailableError, UsageError

if TYPE_CHECKING:
    from sros_tool.graph.common import CommonParts
    from sros_tool.graph.observation import Observation
    from sros_tool.graph.source import ObserverError, RosGraph
    from sros_tool.graph.watch import Snapshot

FOREVER = "until Ctrl-C"


def observer_environment(
    enclave: str | None, keystore: Path | None, domain: str | None
) -> dict[str, str]:
    """What the observer's environment has more than this one's."""
    from sros_tool.runtime.environment import DOMAIN, domain_from

    if enclave is None:
        if keystore is not None:
            raise UsageError(
                "--keystore is given without --enclave", "", "Name the observer's enclave."
            )
        if domain is None:
            domain_from(os.environ)
            return {}
        return {DOMAIN: str(domain_from({DOMAIN: domain}) or 0)}
    from sros_tool.cli.running import loadable_environment

    return loadable_environment(keystore or keystore_from_environment(), enclave, domain)


def observe(
    environment: dict[str, str],
    watch: str | None,
    spin_time: float | None,
    common: CommonParts,
    *,
    secured: bool,
) -> tuple[Snapshot, str]:
    """What was seen, and by which RMW; ``watch`` is a duration or `FOREVER`, in place of a look."""
    from sros_tool.graph.identity import identified
    from sros_tool.graph.source import ObserverError, RosGraph
    from sros_tool.graph.watch import SECURED, Settling, look_for, settle
    from sros_tool.validity import parse_duration

    seconds = None
    enclaves = _enclaves_by_identity({**os.environ, **environment})

    def identify(observation: Observation) -> Observation:
        return identified(observation, enclaves)

    if watch not in (None, FOREVER):
        seconds = parse_duration(watch).total_seconds()
    try:
        with RosGraph(environment) as graph:
            if watch is not None:
                snapshot = _watch(graph, seconds, common, identify)
            elif spin_time is not None:
                snapshot = look_for(graph, spin_time, time.monotonic)
            else:
                settling = SECURED if secured else Settling()
                snapshot = settle(graph, settling, time.monotonic)
            return replace(snapshot, observation=identify(snapshot.observation)), graph.rmw
    except ObserverError as error:
        raise _explained(error, environment) from error


def _enclaves_by_identity(environment: Mapping[str, str]) -> dict[str, str]:
    """The enclaves of the observer's keystore, by what the identifiers of participants begin with.

    An enclave whose certificate cannot be read is left out.
    """
    from sros_tool.graph.identity import identity_of
    from sros_tool.keystore.enclave import enclave_path
    from sros_tool.keystore.layout import enclave_names, is_keystore
    from sros_tool.pki.certificates import load_certificate
    from sros_tool.runtime.environment import ENABLE, KEYSTORE
    from sros_tool.xml import read_bytes

    root = Path(environment.get(KEYSTORE, ""))
    if environment.get(ENABLE) != "true" or not is_keystore(root):
        return {}
    found = {}
    for name in enclave_names(root):
        with suppress(SrosError):
            data = read_bytes(enclave_path(root, name) / "cert.pem", "certificate")
            subject = load_certificate(data, name).subject
            found[identity_of(subject.public_bytes())] = name
    return found


def _watch(
    graph: RosGraph,
    seconds: float | None,
    common: CommonParts,
    identify: Callable[[Observation], Observation],
) -> Snapshot:
    from sros_tool.graph.news import News
    from sros_tool.graph.watch import watch

    news = News(common)

    def tell(observation: Observation) -> None:
        for line in news.lines(identify(observation)):
            click.echo(line, err=True)

    with _until_signalled() as stopped:
        until = f"for {seconds:.0f} s, or {FOREVER}" if seconds else FOREVER
        click.echo(f"watching {until}; then the policy is written", err=True)
        return watch(graph, seconds, time.monotonic, stop=stopped, tell=tell)


@contextmanager
def _until_signalled() -> Iterator[Callable[[], bool]]:
    """Gives a function that tells whether Ctrl-C or SIGTERM has come, which then end nothing."""
    came: list[int] = []

    def note(number: int, _frame: object) -> None:
        came.append(number)

    before = {each: signal.signal(each, note) for each in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(came)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _explained(error: ObserverError, environment: dict[str, str]) -> SrosError:
    """The failure of the observer, with what its DDS said about security."""
    from sros_tool.runtime.environment import ENCLAVE
    from sros_tool.runtime.security_log import (
        endpoint_refusal,
        missing_security,
        participant_refusal,
        plain_text,
    )

    said = f"{error.output}\n{error.reason}"
    if line := missing_security(said):
        return UnavailableError(
            "the DDS of this rclpy was built without DDS Security, so it cannot look at a secured "
            "robot",
            f"It says: {line}",
            "Use a ROS 2 whose DDS has it, such as the packages of Ubuntu; `sros doctor` tells "
            "which DDS here enforces security.",
        )
    name = environment.get(ENCLAVE) or os.environ.get(ENCLAVE) or "/"
    if line := endpoint_refusal(said):
        return SrosError(
            f"the enclave {name} does not permit an observer",
            f"DDS says: {line}",
            "What an observer needs stands in policies/observer.xml (see `sros policies`), for an "
            "enclave named /sros_observer.",
        )
    if line := participant_refusal(said):
        return SrosError(
            f"DDS refuses the enclave {name}",
            f"It says: {line}",
            "See what `sros inspect` says of the enclave.",
        )
    last = [line for line in plain_text(error.output).splitlines() if line.strip()][-1:]
    why = error.reason + (f" The last that it said: {last[0].strip()}" if last else "")
    return UnavailableError(error.what, why, "`sros doctor` tells what works here.")


def why_empty(environment: dict[str, str], seconds: float, rmw: str, enclave: str | None) -> str:
    """Why there may be nothing to see: a person has to know where to look."""
    from sros_tool.runtime.environment import DOMAIN, ENABLE, KEYSTORE

    merged = {**os.environ, **environment}
    looked = f"Looked at domain {merged.get(DOMAIN) or 0} for {seconds:.0f} s with {rmw}. "
    if enclave is not None:
        return looked + (
            f"The observer ran secured, in enclave {enclave}: it sees no node that runs unsecured, "
            "has a certificate of another CA, or another DDS."
        )
    if merged.get(KEYSTORE) and merged.get(ENABLE) != "true":
        return looked + (
            f"{KEYSTORE} is set, so the robot may be secured, and secured nodes are invisible to "
            "an observer without an enclave. Observe with --enclave /sros_observer, made from "
            "policies/observer.xml (see `sros policies`)."
        )
    return looked + (
        "Nodes may be in another domain (ROS_DOMAIN_ID, --domain), on another network, or secured: "
        "secured nodes are invisible to an observer without --enclave and --keystore."
    )
