"""Join domain 0 by Cyclone DDS in the enclave of a folder; its log goes where DDS sends it."""

from __future__ import annotations

import ctypes
import sys
from pathlib import Path

from sros_tool.runtime.cyclone import DdsError, Participant, load_cyclone
from sros_tool.runtime.netns import enter_isolation, try_isolation

if try_isolation().isolated:
    enter_isolation()
ctypes.CDLL(str(load_cyclone().path)).dds_set_log_sink(None, None)
try:
    Participant(0, Path(sys.argv[1]))
except DdsError as error:
    print(error)
    sys.exit(1)
print("joined")
