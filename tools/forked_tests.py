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
from typing import Self

import pytest

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
    left = {item.nodeid for item in session.items}
    with _Processes(session, option.processes) as processes:
        for report in processes.reports():
            hook.pytest_runtest_logreport(report=report)
            if report.when == "teardown":
                left.discard(report.nodeid)
                hook.pytest_runtest_logfinish(nodeid=report.nodeid, location=report.location)
            if session.shouldfail:
                raise session.Failed(session.shouldfail)
            if session.shouldstop:
                raise session.Interrupted(session.shouldstop)
    if left:
        raise session.Interrupted(f"{len(left)} tests have not ended, such as {min(left)}")
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
                    _separate(self._session, folder / f"process{number}", sender)
                    _run(self._session, _taken(queue, self._files), sender)
                    status = 0
                except BaseException:
                    traceback.print_exc()
                finally:
                    os._exit(status)
            sender.close()
            self._pids[receiver] = pid
        os.close(queue)
        return self

    def reports(self) -> Iterator[pytest.TestReport]:
        """Yield the reports of all processes, and a failure for a test that ends its process."""
        config = self._session.config
        begun: dict[Connection, tuple[str, tuple[str, int | None, str]]] = {}
        while self._pids:
            for receiver in wait(list(self._pids)):
                assert isinstance(receiver, Connection)
                try:
                    message = receiver.recv()
                except EOFError:
                    _, status = os.waitpid(self._pids.pop(receiver), 0)
                    if status:
                        text = f"its process ended: {_status_text(status)}"
                        yield pytest.TestReport(*begun[receiver], {}, "failed", text, "call")
                    continue
                if isinstance(message, tuple):
                    begun[receiver] = message
                else:
                    yield config.hook.pytest_report_from_serializable(config=config, data=message)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for pid in self._pids.values():  # after an error
            os.kill(pid, signal.SIGTERM)
            os.waitpid(pid, 0)


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


def _separate(session: pytest.Session, folder: os.PathLike[str], sender: Connection) -> None:
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
    plugins.register(_Sender(config, sender))


def _run(session: pytest.Session, items: Iterator[pytest.Item], sender: Connection) -> None:
    """Run tests; what they share is kept as long as the next one needs it."""
    item = next(items, None)
    while item:
        following = next(items, None)
        sender.send((item.nodeid, item.location))
        session.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
        item = following


class _Sender:
    """A plugin that sends the reports of tests."""

    def __init__(self, config: pytest.Config, sender: Connection) -> None:
        self._config = config
        self._sender = sender

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Send a report to the process that shows it."""
        data = self._config.hook.pytest_report_to_serializable(config=self._config, report=report)
        self._sender.send(data)
