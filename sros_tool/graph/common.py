"""The common parts of nodes: which includes say together what a node was seen to have.

A part is chosen only where the node has everything in it, so that an include grants nothing that
was not seen.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from sros_tool.errors import DocumentError
from sros_tool.graph.fold import Right
from sros_tool.names import expand
from sros_tool.policy.include import Includer, Place
from sros_tool.policy.model import ALLOW
from sros_tool.xml import read_bytes, tag_of

PARTS = (
    "common/lifecycle_node.xml",
    "common/component_container.xml",
    "common/node.xml",
    "common/rclcpp_node.xml",
    "common/rclpy_node.xml",
    "common/transform_listener.xml",
    "common/node/logging.xml",
    "common/node/parameters.xml",
    "common/node/time.xml",
    "common/node/types.xml",
)
"""The parts that a learned policy includes, relative to its folder; the widest first."""


@dataclass(frozen=True, slots=True)
class CommonParts:
    """The parts that can be included beside a policy.

    ``rights`` are those of each part, with names as it writes them; ``missing`` are the files
    that have to be copied for a part: their paths beside the policy, and their content.
    """

    rights: Mapping[str, frozenset[Right]] = field(default_factory=dict)
    missing: Mapping[str, Mapping[str, bytes]] = field(default_factory=dict)

    def choose(
        self, rights: frozenset[Right], ns: str, node: str
    ) -> tuple[tuple[str, ...], frozenset[Right]]:
        """The parts for a node with these rights (absolute names), and the rights that remain."""
        chosen, rest = [], rights
        for part, names in self.rights.items():
            given = _expanded(names, ns, node)
            if given <= rights and given & rest:
                chosen.append(part)
                rest -= given
        return tuple(chosen), rest

    def given(self, parts: Iterable[str], ns: str, node: str) -> frozenset[Right]:
        """What these parts give to a node, by absolute names."""
        return frozenset().union(*(_expanded(self.rights[part], ns, node) for part in parts))

    def to_copy(self, parts: Iterable[str]) -> dict[str, bytes]:
        """The files that these parts need and that are not beside the policy yet."""
        return {path: data for part in parts for path, data in self.missing[part].items()}


def common_parts(folder: Path, shipped: Path) -> CommonParts:
    """What a policy in ``folder`` can include, from there or copied from ``shipped``.

    A file of the user is taken as it is; what it would silently mix with ours is left out.
    """
    rights, missing = {}, {}
    for part in PARTS:
        needed = _closure(shipped, part)
        if (folder / part).exists():
            found, copies = _rights(folder, part), dict[str, bytes]()
        else:
            copies = {path: data for path, data in needed.items() if not (folder / path).exists()}
            other = [
                path for path in needed if path not in copies and _differs(folder, path, needed)
            ]
            found = None if other else _rights(shipped, part)
        if found:
            rights[part], missing[part] = found, copies
    return CommonParts(rights, missing)


def _expanded(rights: Iterable[Right], ns: str, node: str) -> frozenset[Right]:
    return frozenset(Right(each.right, expand(each.name, ns, node)) for each in rights)


def _differs(folder: Path, path: str, needed: Mapping[str, bytes]) -> bool:
    try:
        return read_bytes(folder / path, "policy file") != needed[path]
    except DocumentError:
        return True


def _rights(root: Path, part: str) -> frozenset[Right] | None:
    """What a part grants; None if it cannot be read, or denies something."""
    includer = Includer(root.resolve())
    file = (root / part).resolve()
    rights = set()
    try:
        for group, _ in includer.children(includer.load(file), Place(file)):
            for right, qualifier in group.attrib.items():
                if qualifier != ALLOW:
                    return None
                rights |= {Right(str(right), (name.text or "").strip()) for name in group}
    except DocumentError:
        return None
    return frozenset(rights)


def _closure(root: Path, part: str) -> dict[str, bytes]:
    """A shipped part and everything that it includes: path below ``root``, content."""
    found: dict[str, bytes] = {}
    waiting = [(root / part).resolve()]
    includer = Includer(root.resolve())
    while waiting:
        file = waiting.pop()
        path = file.relative_to(root.resolve()).as_posix()
        if path in found:
            continue
        found[path] = read_bytes(file, "policy file")
        waiting += [
            (file.parent / each.get("href", "")).resolve()
            for each in includer.load(file)
            if tag_of(each).endswith("}include")
        ]
    return found
