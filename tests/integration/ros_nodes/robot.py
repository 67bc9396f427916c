"""Starts processes of nodes, runs commands of sros beside them, and prints as JSON how they ended.

Reads from stdin ``{"domain": N, "folder": PATH, "processes": [...], "commands": [...]}``.  A
process is ``{"enclave", "nodes" (as in run_nodes.py), "arguments", "after", "lives"}``: it starts
so many seconds after the first command, and is killed when it has lived; without ``after`` it is
ready before.  A command is ``{"words", "signal", "at"}``: the words after ``sros``, and the signal
that it gets so many seconds after its start.  Runs in a network of its own where the kernel allows
it.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

from sros_tool.runtime.netns import end_with_parent, enter_isolation, try_isolation

RUN_NODES = Path(__file__).with_name("run_nodes.py")
PATIENCE_S = 60


def start(process: dict[str, Any]) -> subprocess.Popen[str]:
    command = [sys.executable, str(RUN_NODES), json.dumps(process["nodes"])]
    command += ["--ros-args", "--enclave", process["enclave"], *process.get("arguments", ())]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, preexec_fn=end_with_parent)


def wait_until_ready(running: subprocess.Popen[str]) -> None:
    if running.stdout is None or running.stdout.readline() != "ready\n":
        raise SystemExit("a node did not start")


def run(command: dict[str, Any], folder: str) -> dict[str, Any]:
    begin = time.monotonic()
    process = subprocess.Popen(
        [sys.executable, "-m", "sros_tool", *command["words"]],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=folder,
        preexec_fn=end_with_parent,
    )
    if "signal" in command:
        time.sleep(command["at"])
        process.send_signal(command["signal"])
    out, err = process.communicate(timeout=PATIENCE_S)
    seconds = time.monotonic() - begin
    return {"status": process.returncode, "out": out, "err": err, "seconds": seconds}


def live_later(process: dict[str, Any]) -> None:
    time.sleep(process["after"])
    running = start(process)
    wait_until_ready(running)
    time.sleep(process["lives"])
    running.kill()
    running.wait()


def main() -> None:
    task = json.load(sys.stdin)
    if try_isolation().isolated:
        enter_isolation()
    os.environ["ROS_DOMAIN_ID"] = str(task["domain"])
    steady = [start(each) for each in task["processes"] if "after" not in each]
    try:
        for process in steady:
            wait_until_ready(process)
        for each in task["processes"]:
            if "after" in each:
                threading.Thread(target=live_later, args=(each,), daemon=True).start()
        print(json.dumps([run(each, task["folder"]) for each in task["commands"]]))
    finally:
        for process in steady:
            process.kill()
            process.wait()


if __name__ == "__main__":
    main()
