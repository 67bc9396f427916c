"""A plugin with which pytest runs tests in several processes, forked when all are collected.

A process takes one file of tests after the other, or all files with the same ``TAKEN_TOGETHER``.
So every file is imported once, every test collected once, and what their tests share is made once.
"""

from __future__ import annotations

import os
import signal
import traceback
from collections.abc import Iterator, Sequence
from multiprocessing.connection import Connection, Pipe, wait
from types import TracebackType
from typing import Any, Self

import pytest

_Location = tuple[str, int | None, str]
_Data = float | str | dict[str, Any]
"""A report: the seconds of a test that passed, what ended its process, or what pytest makes."""

_NUMBER_BYTES = 2
"""Bytes of a file's number in the pipe from which the processes take files."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option --processes."""
    parser.addoption("--processes", type=int, default=1, help="run tests in so many processes")


@pytest.hookimpl(tryfirst=True)
def pytest_runtestloop(session: pytest.Session) -> bool | None:
    """Run the tests in processes, and report here what they report; None for a single process."""
    option = session.config.option
    if option.processes < 2 or option.collectonly or not session.items or session.testsfailed:
        return None
    hook = session.config.hook
    left = {item.nodeid: item.location for item in session.items}
    with _Processes(session, option.processes) as processes:
        for nodeid, reports in processes.ended_tests():
            location = left.pop(nodeid)
            for data in reports:
                hook.pytest_runtest_logreport(report=_report(session, nodeid, location, data))
            hook.pytest_runtest_logfinish(nodeid=nodeid, location=location)
            if session.shouldfail:
                raise session.Failed(session.shouldfail)
            if session.shouldstop:
                raise session.Interrupted(session.shouldstop)
    if left:
        number = f"{len(left)} of {len(session.items)} tests"
        raise session.Interrupted(f"{number} have not ended, such as {min(left)}")
    return True


class _Processes:
    """The processes that run the tests of a session, until the end of the ``with`` block."""

    def __init__(self, session: pytest.Session, number: int) -> None:
        self._session = session
        files: dict[object, list[pytest.Item]] = {}
        for item in session.items:
            files.setdefault(_file(item), []).append(item)
        self._files = list(files.values())
        self._number = min(number, len(self._files))
        self._pids: dict[Connection, int] = {}

    def __enter__(self) -> Self:
        queue, end = os.pipe()
        for file in range(len(self._files)):
            os.write(end, file.to_bytes(_NUMBER_BYTES))
        os.close(end)
        folder = self._session.config._tmp_path_factory.getbasetemp()  # type: ignore[attr-defined]
        for number in range(self._number):
            receiver, sender = Pipe(duplex=False)
            pid = os.fork()
            if pid == 0:
                status = 1
                try:
                    sending = _separate(self._session, folder / f"process{number}", sender)
                    _run(self._session, _taken(queue, self._files), sending)
                    status = 0
                except BaseException:
                    traceback.print_exc()
                finally:
                    os._exit(status)
            sender.close()
            self._pids[receiver] = pid
        os.close(queue)
        return self

    def ended_tests(self) -> Iterator[tuple[str, list[_Data]]]:
        """Yield each test that has ended, with its reports; a test that ends its process fails."""
        begun: dict[Connection, str] = {}
        while self._pids:
            for receiver in wait(list(self._pids)):
                assert isinstance(receiver, Connection)
                test = begun.get(receiver, "")
                try:
                    reports, begun[receiver] = receiver.recv()
                except EOFError:
                    _, status = os.waitpid(self._pids.pop(receiver), 0)
                    reports = [f"its process ended: {_status_text(status)}"] if status else []
                if test and reports:
                    yield test, reports

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for pid in self._pids.values():  # after an error
            os.kill(pid, signal.SIGTERM)
            os.waitpid(pid, 0)


def _report(session: pytest.Session, nodeid: str, location: _Location, data: _Data) -> Any:
    """Return a report that a process has sent."""
    if isinstance(data, dict):
        config = session.config
        return config.hook.pytest_report_from_serializable(config=config, data=data)
    if isinstance(data, str):
        return pytest.TestReport(nodeid, location, {}, "failed", data, "call")
    return pytest.TestReport(nodeid, location, {}, "passed", None, "call", duration=data)


def _file(item: pytest.Item) -> object:
    """Return what is equal for tests that one process takes: those of a file, or with a browser."""
    browsing = getattr(item.getparent(pytest.Module), "obj", None)
    return getattr(browsing, "TAKEN_TOGETHER", item.path)


def _status_text(status: int) -> str:
    code = os.waitstatus_to_exitcode(status)
    return signal.Signals(-code).name if code < 0 else f"exit status {code}"


def _taken(queue: int, files: Sequence[list[pytest.Item]]) -> Iterator[pytest.Item]:
    """Yield the tests of one file after the other that no other process has taken."""
    while number := os.read(queue, _NUMBER_BYTES):
        yield from files[int.from_bytes(number)]


def _separate(session: pytest.Session, folder: os.PathLike[str], sender: Connection) -> _Sender:
    """Give this process output and folders of its own, and have it send reports, not show them."""
    config, plugins = session.config, session.config.pluginmanager
    capture = plugins.getplugin("capturemanager")
    capture.stop_global_capturing()
    capture.start_global_capturing()
    os.mkdir(folder, 0o700)  # noqa: PTH102 - what pytest gives is a path, too
    config._tmp_path_factory._basetemp = folder  # type: ignore[attr-defined]
    for name in ("terminalreporter", "terminalprogress"):
        if plugins.has_plugin(name):
            plugins.unregister(name=name)
    sending = _Sender(config, sender)
    plugins.register(sending)
    return sending


def _run(session: pytest.Session, items: Iterator[pytest.Item], sender: _Sender) -> None:
    """Run tests; what they share is kept as long as the next one needs it."""
    item = next(items, None)
    while item:
        following = next(items, None)
        sender.begin(item.nodeid)
        session.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
        item = following
    sender.begin("")


class _Sender:
    """A plugin that sends the reports of tests, those of a test in one message."""

    def __init__(self, config: pytest.Config, sender: Connection) -> None:
        self._config = config
        self._sender = sender
        self._reports: list[_Data] = []

    def begin(self, nodeid: str) -> None:
        """Send the reports of the test that has ended, with the id of the next one, or ""."""
        self._sender.send((self._reports, nodeid))
        self._reports = []

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Keep a report; of what passed, only how long the test took."""
        if not report.passed or hasattr(report, "wasxfail"):
            hook = self._config.hook
            self._reports.append(
                hook.pytest_report_to_serializable(config=self._config, report=report)
            )
        elif report.when == "call":
            self._reports.append(report.duration)
