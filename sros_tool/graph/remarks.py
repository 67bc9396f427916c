"""What is said of an observation beside its policy: what is left out, and what is worth a look."""

from __future__ import annotations

from sros_tool.notes import Note

_SHOWN = 5

_TEXTS = {
    "ambiguous": "the graph does not tell in which enclave each of these nodes of the same name "
    "runs, so their rights stand in all of them; start them one at a time under --watch to tell "
    "them apart: {}",
    "changing-name": "nodes that get another name each time they start have a profile with a "
    "wildcard: {}",
    "half-service": "left out, as only one half of a service was seen (look again with a longer "
    "--spin-time): {}",
    "no-ros-name": "left out, as a policy has no words for topics outside of ROS's naming: {}",
    "odd-name": "left out, as these are no names that ROS gives; somebody may be trying to get a "
    "wildcard into your policy: {}",
    "odd-node": "left out, as no policy can name these nodes or their enclaves: {}",
    "partial-action": "only parts of an action are used, and stand as what they are: {}",
    "root-enclave": "all {} nodes run in the enclave /, and share all rights; start each process "
    "with `--ros-args --enclave /its/name` and learn again to tell them apart",
    "service-event": "service introspection is on: what these services are asked is readable by "
    "every subscriber; take the topics out if that is for debugging only: {}",
    "sets-clock": "may set the clock of every node that uses simulated time; meant for a simulator "
    "or a player: {}",
    "silent": "left out, as they were announced and had no endpoint: {}",
    "stray": "left out, as the writers or readers of these topics belong to no ROS node: {}",
    "unknown-enclave": "left out, as the graph does not tell in which enclaves these nodes run: "
    "theirs was set by ROS_SECURITY_ENCLAVE_OVERRIDE, and the observer's keystore has no "
    "certificate of theirs; observe with the keystore that has their enclaves (--keystore), or "
    "start them with `--ros-args --enclave /its/name`: {}",
    "tool": "left out, as they are tools that look at the robot: {}",
}


class Remarks:
    """Collects remarks of a kind, and says each kind once."""

    def __init__(self) -> None:
        self._found: dict[str, set[str]] = {}

    def add(self, kind: str, subject: str) -> None:
        """Remark on a node, a topic, or a number."""
        self._found.setdefault(kind, set()).add(subject)

    def notes(self) -> tuple[Note, ...]:
        """One note for each kind, in the order of their ids."""
        return tuple(
            Note(f"graph.{kind}", _TEXTS[kind].format(_listed(sorted(subjects))))
            for kind, subjects in sorted(self._found.items())
        )


def _listed(subjects: list[str]) -> str:
    more = len(subjects) - _SHOWN
    return ", ".join(subjects[:_SHOWN]) + (f" and {more} more" if more > 0 else "")
