"""What the verbs that observe the ROS graph share: options, the observer, its failures."""

from __future__ import annotations

import os
import re
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from sros_tool.cli.common import PATH, Decorated, keystore_from_environment
from sros_tool.errors import SrosError, UnavailableError, UsageError
from sros_tool.terminal import echo

if TYPE_CHECKING:
    from sros_tool.graph.observation import Observation
    from sros_tool.graph.observe import ObserverError, RosGraph, Snapshot


# ── options ─────────────────────────────────────────────────────────────────────────────


_FOREVER = "until Ctrl-C"
_DURATION = re.compile(r"\d+[smhdwy]\Z", re.ASCII)


class Watching(click.Command):
    """A command whose ``--watch`` needs no value."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments, with a value after each ``--watch`` that has none."""
        words: list[str] = []
        for index, word in enumerate(args):
            words.append(word)
            follows = args[index + 1] if index + 1 < len(args) else ""
            if word == "--watch" and not _DURATION.match(follows):
                words.append(_FOREVER)
        return super().parse_args(ctx, words)


def observing_options(enclave_help: str) -> Callable[[Decorated], Decorated]:
    """Add the options that choose how long to observe, in which domain and in which enclave."""

    def add(function: Decorated) -> Decorated:
        for option in (
            click.option(
                "--keystore",
                type=PATH,
                metavar="ROOT",
                help="The keystore of that enclave. [default: $ROS_SECURITY_KEYSTORE]",
            ),
            click.option("--enclave", metavar="NAME", help=enclave_help),
            click.option(
                "--domain", metavar="ID", help="The ROS domain. [default: $ROS_DOMAIN_ID, or 0]"
            ),
            click.option(
                "--spin-time",
                type=click.FloatRange(0.1, 86400),
                metavar="S",
                help="Observe for S seconds.",
            ),
            click.option(
                "--watch",
                metavar="[DURATION]",
                help="Collect all observations for DURATION, such as 10m, or until Ctrl-C.",
            ),
        ):
            function = option(function)
        return function

    return add


def check_duration(watch: str | None, spin_time: float | None) -> None:
    """Raise `UsageError` if both ways to say how long to observe are given."""
    if watch is not None and spin_time is not None:
        raise UsageError("--watch and --spin-time exclude each other", "", "Choose one.")


# ── observing ───────────────────────────────────────────────────────────────────────────


def observer_environment(
    enclave: str | None, keystore: Path | None, domain: str | None
) -> dict[str, str]:
    """Return the environment variables to set for the observer: its domain, its enclave if any."""
    from sros_tool.runtime.variables import DOMAIN, domain_from

    if enclave is None:
        if keystore is not None:
            raise UsageError(
                "--keystore is given without --enclave", "", "Name the observer's enclave."
            )
        if domain is None:
            domain_from(os.environ)
            return {}
        return {DOMAIN: str(domain_from({DOMAIN: domain}) or 0)}
    from sros_tool.cli.enclave_environment import loadable_environment

    return loadable_environment(keystore or keystore_from_environment(), enclave, domain).variables


def observe(
    environment: dict[str, str],
    watch: str | None,
    spin_time: float | None,
    report: Callable[[Observation], None],
    *,
    secured: bool,
    then: str,
) -> tuple[Snapshot, str]:
    """Observe the ROS graph; return the result and the RMW in use.

    ``watch`` is the value of --watch; None observes for ``spin_time`` seconds, or until the graph
    stops changing.  While watching, ``report`` gets everything seen so far whenever it has grown;
    ``then`` tells the user what happens at the end.
    """
    from sros_tool.graph.observe import (
        SECURED,
        ObserverError,
        RosGraph,
        Settling,
        identified,
        look_for,
        settle,
    )
    from sros_tool.validity import parse_duration

    seconds = None
    enclaves = _enclaves_by_identity({**os.environ, **environment})

    def identify(observation: Observation) -> Observation:
        return identified(observation, enclaves)

    if watch not in (None, _FOREVER):
        seconds = parse_duration(watch).total_seconds()
    try:
        with RosGraph(environment) as graph:
            if watch is not None:
                snapshot = _watch(graph, seconds, lambda seen: report(identify(seen)), then)
            elif spin_time is not None:
                snapshot = look_for(graph, spin_time, time.monotonic)
            else:
                settling = SECURED if secured else Settling()
                snapshot = settle(graph, settling, time.monotonic)
            return replace(
                snapshot,
                observation=identify(snapshot.observation),
                everything=identify(snapshot.everything),
            ), graph.rmw
    except ObserverError as error:
        raise _explained(error, environment) from error


def _enclaves_by_identity(environment: Mapping[str, str]) -> dict[str, str]:
    """Return the enclaves by the identities of their participants, if the observer is secured."""
    from sros_tool.keystore.known_keys import enclaves_by_identity
    from sros_tool.keystore.layout import is_keystore
    from sros_tool.runtime.variables import ENABLE, KEYSTORE

    root = Path(environment.get(KEYSTORE, ""))
    if environment.get(ENABLE) != "true" or not is_keystore(root):
        return {}
    return enclaves_by_identity(root)


def _watch(
    graph: RosGraph, seconds: float | None, report: Callable[[Observation], None], then: str
) -> Snapshot:
    from sros_tool.graph.observe import watch

    with _until_signalled() as stopped:
        until = f"for {seconds:.0f} s, or {_FOREVER}" if seconds else _FOREVER
        echo(f"watching {until}; then {then}", err=True)
        return watch(graph, seconds, time.monotonic, stop=stopped, report=report)


@contextmanager
def _until_signalled() -> Iterator[Callable[[], bool]]:
    """Catch Ctrl-C and SIGTERM; yield a function that returns whether one was received."""
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
    """Return the observer's failure as the error that its DDS output explains."""
    from sros_tool.runtime.variables import ENCLAVE
    from sros_tool.runtime.vendor_log import (
        endpoint_refusal,
        missing_security,
        participant_refusal,
        plain_text,
    )

    said = f"{error.output}\n{error.reason}"
    if line := missing_security(said):
        return UnavailableError(
            "the DDS of this rclpy was built without DDS Security, so it cannot observe a secured "
            "robot",
            f"DDS says: {line}",
            "Use a ROS 2 whose DDS has it, such as the packages of Ubuntu; `sros doctor` shows "
            "which DDS here enforces security.",
        )
    name = environment.get(ENCLAVE) or os.environ.get(ENCLAVE) or "/"
    if line := endpoint_refusal(said):
        return SrosError(
            f"the enclave {name} does not permit an observer",
            f"DDS says: {line}",
            "The rights that an observer needs are in policies/observer.xml (see `sros "
            "policies`), for an "
            "enclave named /sros_observer.",
        )
    if line := participant_refusal(said):
        return SrosError(
            f"DDS refuses the enclave {name}",
            f"DDS says: {line}",
            "Run `sros inspect` on the enclave.",
        )
    last = [line for line in plain_text(error.output).splitlines() if line.strip()][-1:]
    why = error.reason + (f" Its last message: {last[0].strip()}" if last else "")
    return UnavailableError(error.what, why, "`sros doctor` shows what works here.")


def why_empty(environment: Mapping[str, str], seconds: float, rmw: str, enclave: str | None) -> str:
    """Return the likely reasons why no node was observed, and a remedy."""
    from sros_tool.runtime.variables import DOMAIN, ENABLE, KEYSTORE

    merged = {**os.environ, **environment}
    looked = f"Observed domain {merged.get(DOMAIN) or 0} for {seconds:.0f} s with {rmw}. "
    if enclave is not None:
        return looked + (
            f"The observer ran secured, in enclave {enclave}: it does not see nodes that are "
            "unsecured, have a certificate of another CA, or use another DDS."
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
