"""Tells in one line each what a watch has newly seen."""

from __future__ import annotations

from sros_tool.graph.common import CommonParts
from sros_tool.graph.fold import Right
from sros_tool.graph.learn import learn
from sros_tool.graph.naming import written
from sros_tool.graph.observation import Observation

_EVERY_NODE = "common/node.xml"


class News:
    """Remembers what was told.  What every node has is not worth a line."""

    def __init__(self, common: CommonParts) -> None:
        self._ordinary = common.rights.get(_EVERY_NODE, frozenset[Right]())
        self._told: set[tuple[str, str, str]] = set()
        self._rights: set[tuple[str, str, str, Right]] = set()

    def lines(self, observation: Observation) -> list[str]:
        """A line for each node and each right in ``observation`` that was not told before."""
        lines = []
        for each in learn(observation).profiles:
            place = each.enclave, each.ns, each.node
            name = f"{each.ns.rstrip('/')}/{each.node}"
            if place not in self._told:
                self._told.add(place)
                lines.append(f"new: {name} ({each.enclave})")
            for right in sorted(each.rights):
                plain = Right(right.right, written(right.name, each.ns, each.node))
                if plain not in self._ordinary and (*place, right) not in self._rights:
                    self._rights.add((*place, right))
                    lines.append(f"new: {name} ({each.enclave}) {right.right} {right.name}")
        return lines
