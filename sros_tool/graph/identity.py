"""Finds the enclave of a secured participant by its identifier, which a graph shows of each.

The graph shows the enclave of ``--ros-args --enclave``, and "/" of a process that has it from
ROS_SECURITY_ENCLAVE_OVERRIDE.  But a secured participant's identifier begins with a digest of the
subject of its certificate (DDS-Security 1.1, 9.3.3), which its peers check when it comes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from hashlib import sha256

from sros_tool.graph.observation import Observation, make_observation

_DIGITS = 12
_FIRST_BIT = 1 << (4 * _DIGITS - 1)
_SECURED = tuple("89abcdef")
"""How identifiers of secured participants begin, in hex: with the first bit set."""
_NOT_SAID = ("/",)


def identity_of(subject: bytes) -> str:
    """The first 6 bytes, in hex, of the participants whose certificate has this subject (DER)."""
    digest = int(sha256(subject).hexdigest()[:_DIGITS], 16)
    return f"{_FIRST_BIT | digest >> 1:x}"


def identified(observation: Observation, enclaves: Mapping[str, str]) -> Observation:
    """The observation with the enclaves that the certificates of its participants tell.

    ``enclaves`` are by `identity_of`.  A secured node of which neither they nor the graph tell the
    enclave has none.
    """
    nodes = []
    for node in observation.nodes:
        told = enclaves.get(node.participant[:_DIGITS])
        if told is not None:
            node = replace(node, enclaves=(told,))
        elif node.participant.startswith(_SECURED) and node.enclaves == _NOT_SAID:
            node = replace(node, enclaves=())
        nodes.append(node)
    return make_observation(nodes, observation.silent, observation.strays)
