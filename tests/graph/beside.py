"""The fixture that runs sros beside a ROS graph that is made up."""

from __future__ import annotations

import gc
import importlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any

import pytest

from sros_tool.graph import observe
from tests.graph.fake_graph import Beside
from tests.support.children import Forked
from tests.support.harness import Ended, sros

FAKE = Path(__file__).with_name("fake_rclpy.py")


class ForkedObserver(Forked):
    """The observer process, forked: Python and its modules are not started again for each graph.

    That it is a Python of its own shows wherever a real graph is observed (tests/integration).
    """

    def __init__(
        self,
        command: Sequence[str],
        *,
        stdout: IO[bytes],
        pass_fds: Sequence[int],
        env: Mapping[str, str],
        **_: object,
    ) -> None:
        module, report, *_more = arguments = command[command.index("-m") + 1 :]
        read_end, write_end = os.pipe()
        self.stdin = os.fdopen(write_end, "wb")

        def work() -> int:
            gc.freeze()  # files of the tests, collected here, would close those below by number
            os.setpgid(0, 0)
            for descriptor, source in enumerate((read_end, stdout.fileno(), stdout.fileno())):
                os.dup2(source, descriptor)
            os.closerange(3, int(report))
            os.closerange(int(report) + 1, 1024)
            sys.stdin, sys.stdout, sys.stderr = os.fdopen(0), os.fdopen(1, "w"), os.fdopen(2, "w")
            for name in [each for each in sys.modules if each.partition(".")[0] == "rclpy"]:
                del sys.modules[name]
            sys.argv = list(arguments)
            try:
                status: int = importlib.import_module(module).main()
            finally:
                sys.stdout.flush()
                sys.stderr.flush()
            return status

        assert pass_fds == [int(report)]
        super().__init__(work, env=env, errors=Path(os.devnull))
        os.close(read_end)


@pytest.fixture
def beside_graph(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> Beside:
    """Runs a verb of sros in ``tmp_path`` beside the graph that it is given."""
    place = tmp_path_factory.mktemp("fake")
    for module in ("__init__", "parameter", "signals"):
        (place / "rclpy").mkdir(exist_ok=True)
        shutil.copy(FAKE, place / "rclpy" / f"{module}.py")
    monkeypatch.syspath_prepend(str(place))
    names = ("PIPE", "STDOUT", "TimeoutExpired")
    forking = SimpleNamespace(**{name: getattr(subprocess, name) for name in names})
    monkeypatch.setattr(observe, "subprocess", forking)
    forking.Popen = ForkedObserver

    def run(verb: str, graph: dict[str, Any], *words: object, **environment: str) -> Ended:
        env = {"PYTHONPATH": str(place), "FAKE_GRAPH": json.dumps(graph), **environment}
        return sros(verb, *words, env=env, cwd=tmp_path)

    return run
