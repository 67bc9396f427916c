"""Starts secured processes by ``sros run`` and learns a policy of them, until it says enough.

Reads from stdin ``{"keystore", "folder", "processes", "learn", "until", "patience"}``.  A process
is ``{"enclave", "nodes" (as in run_nodes.py), "named"}``: ``named`` puts its enclave on its command
line, where the graph shows it.  ``learn`` are the words after ``sros`` that write ``learned.xml``
in ``folder``; they are repeated until that file says all the rights of ``until`` (as text), or for
``patience`` seconds.  Prints as JSON how the last of them ended, and what each process wrote.  Runs
in a network of its own where the kernel allows it.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from sros_tool.errors import SrosError
from sros_tool.parallel import end_with_parent
from sros_tool.policy.document import read_policy
from sros_tool.policy.rights import policy_rights
from sros_tool.runtime.netns import enter_isolation, try_isolation
from tests.support.children import run

RUN_NODES = Path(__file__).with_name("run_nodes.py")
SROS = (sys.executable, "-m", "sros_tool")


def start(task: dict[str, Any], process: dict[str, Any], log: Path) -> subprocess.Popen[bytes]:
    named = () if process["named"] else ("--no-ros-args",)
    node = (sys.executable, str(RUN_NODES), json.dumps(process["nodes"]))
    return subprocess.Popen(
        [
            *(*SROS, "run", *named, task["keystore"], process["enclave"], "--"),
            *(*node, "--ros-args", "-p", "use_sim_time:=true"),
        ],
        stdout=log.open("wb"),
        stderr=subprocess.STDOUT,
        preexec_fn=end_with_parent,
    )


def wait_until_ready(running: dict[str, subprocess.Popen[bytes]], logs: dict[str, Path]) -> None:
    while not all(b"ready\n" in log.read_bytes() for log in logs.values()):
        for enclave, process in running.items():
            if process.poll() is not None:
                raise SystemExit(f"{enclave} ended: {logs[enclave].read_text()}")
        time.sleep(0.2)


def learned(path: Path) -> set[str]:
    try:
        return {str(each) for each in policy_rights(read_policy(path))}
    except SrosError:
        return set()


def main() -> None:
    task = json.load(sys.stdin)
    if try_isolation().isolated:
        enter_isolation()
    folder = Path(task["folder"])
    logs = {
        each["enclave"]: folder / (each["enclave"].strip("/").replace("/", "_") + ".log")
        for each in task["processes"]
    }
    running = {
        each["enclave"]: start(task, each, logs[each["enclave"]]) for each in task["processes"]
    }
    try:
        wait_until_ready(running, logs)
        deadline = time.monotonic() + task["patience"]
        while True:
            done = run([*SROS, *task["learn"]], status=None, cwd=folder)
            said = learned(folder / "learned.xml") >= set(task["until"])
            if said or time.monotonic() > deadline:
                break
        ended = [enclave for enclave, each in running.items() if each.poll() is not None]
    finally:
        for process in running.values():
            process.kill()
            process.wait()
    texts = {enclave: log.read_text(errors="replace") for enclave, log in logs.items()}
    last = {"status": done.returncode, "out": done.stdout, "err": done.stderr}
    print(json.dumps({"learned": last, "logs": texts, "ended": ended}))


if __name__ == "__main__":
    main()
