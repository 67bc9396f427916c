"""The fixture that runs sros beside a ROS graph that is made up."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from tests.graph.fake_graph import Beside
from tests.support.harness import Ended, sros

FAKE = Path(__file__).with_name("fake_rclpy.py")


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

    def run(verb: str, graph: dict[str, Any], *words: object, **environment: str) -> Ended:
        env = {"PYTHONPATH": str(place), "FAKE_GRAPH": json.dumps(graph), **environment}
        return sros(verb, *words, env=env, cwd=tmp_path)

    return run
