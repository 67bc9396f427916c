"""Chooses the scenes of a picture: an overview that stays readable, and all that lies behind it."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import replace

from sros_tool.report.picture import Edge, Picture
from sros_tool.report.placing import Placing
from sros_tool.report.scene import Scene

_MOST_ENCLAVES = 40


def scenes_of(picture: Picture) -> tuple[Scene, ...]:
    """The scenes of a picture, the one to begin with first.

    Of a robot with few enclaves: all but what every node needs, and then everything.  Of many:
    groups with what passes between them, and then each group with its neighbours.
    """
    groups = {each.path: each.group for each in picture.enclaves}
    titles = sorted(set(groups.values()))
    essential = [edge for edge in picture.edges if not edge.common]
    if len(groups) <= _MOST_ENCLAVES or len(titles) < 2 or len(titles) > len(groups) // 2:
        scenes = [_scene(picture, "essential", "Overview", essential, str)]
        if len(essential) < len(picture.edges):
            title = "With what every node needs"
            scenes.append(_scene(picture, "all", title, picture.edges, str))
        return tuple(scenes)
    # The mark of a group is a letter that no enclave begins with.
    outside = {path: f":{group}" for path, group in groups.items()}
    scenes = [_scene(picture, "essential", "Overview", essential, outside.__getitem__)]
    for title in titles:

        def owner(path: str, title: str = title) -> str:
            return path if groups[path] == title else outside[path]

        touched = {(e.kind, e.name) for e in essential if groups[e.enclave] == title}
        edges = [edge for edge in essential if (edge.kind, edge.name) in touched]
        scenes.append(_scene(picture, f"group {title}", title, edges, owner))
    return tuple(scenes)


def _scene(
    picture: Picture,
    name: str,
    title: str,
    edges: Sequence[Edge],
    owner: Callable[[str], str],
) -> Scene:
    members: dict[str, list[str]] = defaultdict(list)
    for enclave in picture.enclaves:
        members[owner(enclave.path)].append(enclave.path)
    everybody: dict[tuple[str, str], set[str]] = defaultdict(set)
    for edge in picture.edges:
        everybody[edge.kind, edge.name].add(owner(edge.enclave))
    scene = Placing(picture, edges, owner, members, everybody).scene(name, title)
    shown = len({(edge.kind, edge.name) for edge in edges})
    return replace(scene, hidden=len(picture.names) - shown, shown=shown)
