"""Ask Cyclone DDS whether the enclave of a folder may have endpoints.

Reads a JSON list of [verb, DDS topic] from standard input, and prints a JSON list of booleans.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from sros_tool.runtime.cyclone import Participant, SecurityRefusedError
from sros_tool.runtime.netns import enter_isolation, try_isolation

asked = json.load(sys.stdin)
if try_isolation().isolated:
    enter_isolation()
with Participant(0, Path(sys.argv[1])) as participant:
    answers = []
    for verb, topic in asked:
        try:
            (participant.writer if verb == "publish" else participant.reader)(topic)
        except SecurityRefusedError:
            answers.append(False)
        else:
            answers.append(True)
json.dump(answers, sys.stdout)
