"""Asks Cyclone DDS what an enclave may do: ``ask_cyclone.py ENCLAVE_DIR DOMAIN``.

Reads from stdin a JSON list of ``[direction, DDS topic]`` (publish or subscribe), and prints as
JSON, in the same order, ``allowed`` or ``refused``.  Anything else is a crash, not an answer.
One participant in one process, for Cyclone 0.10 lets a second borrow the rights of the first.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from sros_tool.runtime.cyclone import Participant, SecurityRefusedError
from sros_tool.runtime.netns import enter_isolation, try_isolation


def ask(participant: Participant, direction: str, topic: str) -> str:
    try:
        participant.writer(topic) if direction == "publish" else participant.reader(topic)
    except SecurityRefusedError:
        return "refused"
    return "allowed"


def main() -> None:
    questions = json.load(sys.stdin)
    if try_isolation().isolated:
        enter_isolation()
    with Participant(int(sys.argv[2]), Path(sys.argv[1])) as participant:
        print(json.dumps([ask(participant, *question) for question in questions]))


if __name__ == "__main__":
    main()
