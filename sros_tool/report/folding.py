"""Draw equal robots, namespaces and enclaves of a picture as one.

Units are the robots of a fleet; without one, namespaces or enclaves next to each other that hold
the same enclaves, or nearly.  They are equal if all that is drawn of them is equal but for their
own names: each right and denial of their enclaves, and of others to their names.  Of units that
they name themselves, such as the robots whose poses each robot reads, the number has to be equal.

A label such as ``{r01…r50}`` stands for each of them: ``/{r01…r50}/base`` may publish
``/{r01…r50}/odom``, each robot its own.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import (
    Callable,
    Collection,
    Container,
    Iterable,
    Iterator,
    Mapping,
    Sequence,
    Set,
)
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple

from sros_tool.fleet.robots import Robot
from sros_tool.policy.model import ALLOW
from sros_tool.report.compose import edge_order, namespace_of
from sros_tool.report.focus import HOPS, flow_scene
from sros_tool.report.layout import Frame, Scene, scenes_of
from sros_tool.report.picture import (
    DifferentUnit,
    Edge,
    EqualUnits,
    Focus,
    Influence,
    Name,
    Picture,
    PicturedEnclave,
)
from sros_tool.wording import counted

_MARKS = "{}…"
"""Characters of labels; no ROS name has them. A picture that has them is not folded."""
_WORD = re.compile(r"[A-Za-z0-9_]+")
_MOST_PIECES = 16
"""Most pieces of a word (split at underscores) that are searched for names of units."""
_SELF = -1
_TITLE_LETTERS = 30
"""Longest title of a frame, in characters; a frame is as wide as a card of enclaves."""
_ENCLAVE = "enclave"


class Folding(NamedTuple):
    """A picture with equal units drawn as one, and the real names behind its labels."""

    picture: Picture
    equal: tuple[EqualUnits, ...]
    different: tuple[DifferentUnit, ...]
    enclaves: Mapping[str, tuple[str, ...]]
    names: Mapping[tuple[str, str], tuple[str, ...]]

    @classmethod
    def of(cls, picture: Picture, robots: Mapping[str, Robot] | None = None) -> Folding:
        """Return the folding of a picture.

        Args:
            picture: any picture, also with a focus or of two sources.
            robots: the robots of a fleet, by their enclaves.
        """
        return _Draft(picture, robots or {}).folding()

    def scenes(self, *, placed: bool = True, hops: int = 0) -> tuple[Scene, ...]:
        """Return the scenes, whose cards list the real enclaves and names.

        Args:
            placed: for formats that place cards themselves, False: without y and frames.
            hops: with a focus, how far enclaves are drawn; 0 for the default.
        """
        scenes = scenes_of(self.picture, placed=placed, drawn_as=self.names)
        if self.picture.focus:
            scenes = (flow_scene(self.picture, hops or HOPS, placed=placed), *scenes)
        return tuple(map(self._scene, scenes))

    def _scene(self, scene: Scene) -> Scene:
        cards = []
        for card in scene.cards:
            if card.kind:
                found = [self.names.get((card.kind, member), (member,)) for member in card.members]
            else:
                found = [self.enclaves.get(member, (member,)) for member in card.members]
            members = tuple(dict.fromkeys(each for one in found for each in one))
            cards.append(replace(card, members=members))
        return replace(
            scene,
            cards=tuple(cards),
            frames=tuple(self._titled(frame) for frame in scene.frames),
        )

    def _titled(self, frame: Frame) -> Frame:
        equal = next((units for units in self.equal if units.label in frame.title), None)
        if equal is None:
            return frame
        whole, short = equal.title, f"{len(equal.members)} equal {equal.what}s"
        return replace(frame, title=whole if len(whole) <= _TITLE_LETTERS else short)


class _Unit(NamedTuple):
    """A robot, a namespace or an enclave that can be equal to others of its ``family``.

    ``values`` are the words by which names name it: its name, and its namespace if that differs.
    """

    name: str
    what: str
    family: int
    enclaves: tuple[str, ...]
    values: tuple[str, ...]

    @property
    def alone(self) -> bool:
        """Whether the unit is a single enclave, not a robot or namespace."""
        return self.what == _ENCLAVE


@dataclass(frozen=True)
class _Text:
    """A text split where units are named; a unit is stored with the number of its value."""

    parts: tuple[str, ...]
    named: tuple[tuple[int, int], ...] = ()

    @cached_property
    def units(self) -> tuple[int, ...]:
        """The units named in the text, in order."""
        return tuple(unit for unit, _ in self.named)

    @cached_property
    def form(self) -> tuple[object, ...]:
        """The text without the units: equal for texts that differ in units alone."""
        return self.parts, tuple(number for _, number in self.named)

    def fill(self, word: Callable[[int, int], str]) -> str:
        """Return the text with units replaced: ``word`` gets unit and value number."""
        named = (word(*each) for each in self.named)
        first, *rest = self.parts
        return first + "".join(value + part for value, part in zip(named, rest, strict=True))

    def only(self, unit: int | None, word: Callable[[int, int], str]) -> _Text:
        """Return the text in which units other than ``unit`` are plain text."""
        parts, named = [self.parts[0]], []
        for each, part in zip(self.named, self.parts[1:], strict=True):
            if each[0] == unit:
                named.append(each)
                parts.append(part)
            else:
                parts[-1] += word(*each) + part
        return _Text(tuple(parts), tuple(named))


class _Draft:
    """The builder of a folding: first units, then classes of equal units, then the picture."""

    def __init__(self, picture: Picture, robots: Mapping[str, Robot]) -> None:
        self._picture = picture
        self._units = list(_robots(picture, robots) if robots else _guessed(picture))
        self._names_of = {(name.kind, name.name): name for name in picture.names}
        self._find_words()

    def _find_words(self) -> None:
        """Find the words that name units, and the enclaves of all units.

        An enclave belongs to the only unit that its path names, also outside of its namespace.  A
        unit that is not named in the path of each of its enclaves cannot be folded.
        """
        number = Counter(value for unit in self._units for value in unit.values)
        dropped: set[int] = set()
        while True:
            self._words = {
                value: (n, position)
                for n, unit in enumerate(self._units)
                for position, value in enumerate(unit.values)
                if number[value] == 1 and n not in dropped
            }
            self._texts: dict[str, _Text] = {}
            self._of: dict[str, int] = {
                path: n
                for n, unit in enumerate(self._units)
                if n not in dropped
                for path in unit.enclaves
            }
            unnamed = {n for path, n in self._of.items() if n not in self._text(path).units}
            if not unnamed:
                break
            dropped |= unnamed
        for enclave in self._picture.enclaves:
            if enclave.path not in self._of:
                found = set(self._text(enclave.path).units)
                if len(found) == 1:
                    self._of[enclave.path] = found.pop()

    def folding(self) -> Folding:
        """Return the folding; its picture is unchanged if nothing can be folded."""
        if self._of and not self._has_marks():
            self._kinds: dict[object, int] = {}
            self._seen = tuple(self._sightings())
            classes = self._find_classes()
            if self._picture.focus:
                # What goes from one robot to another one is at two stages of the flow.
                classes = {n: found for n, found in classes.items() if self._apart(found[0])}
            if classes:
                self._classes = classes
                return self._folded()
        return _as_it_is(self._picture)

    def _has_marks(self) -> bool:
        texts = (
            *(enclave.path for enclave in self._picture.enclaves),
            *(enclave.group for enclave in self._picture.enclaves),
            *(name.name for name in self._picture.names),
        )
        return any(mark in text for text in texts for mark in _MARKS)

    # ── what is seen of each unit ──────────────────────────────────────────────────────────

    def _text(self, text: str) -> _Text:
        found = self._texts.get(text)
        if found is None:
            found = self._texts[text] = self._read(text)
        return found

    def _read(self, text: str) -> _Text:
        """Return a text split at the units that it names, as words or between underscores."""
        parts, named = [""], []
        end = 0
        for match in _WORD.finditer(text):
            parts[-1] += text[end : match.start()]
            end = match.end()
            pieces = match[0].split("_")
            at = 0
            while at < len(pieces):
                parts[-1] += "_" if at else ""
                value, size = self._longest(pieces, at)
                if value:
                    named.append(value)
                    parts.append("")
                else:
                    parts[-1] += pieces[at]
                at += size
        parts[-1] += text[end:]
        return _Text(tuple(parts), tuple(named))

    def _longest(self, pieces: Sequence[str], at: int) -> tuple[tuple[int, int] | None, int]:
        """Return the unit with the longest name from piece ``at``, and its number of pieces."""
        for size in range(min(len(pieces) - at, _MOST_PIECES), 0, -1):
            found = self._words.get("_".join(pieces[at : at + size]))
            if found:
                return found, size
        return None, 1

    def _word(self, unit: int, position: int) -> str:
        return self._units[unit].values[position]

    def _owner(self, enclave: str) -> _Text:
        """Return the path of an enclave, split at its own unit only."""
        return self._text(enclave).only(self._of.get(enclave), self._word)

    def _sightings(self) -> Iterator[tuple[int, tuple[int, ...], Edge | str]]:
        """Yield everything drawn of units: a number for the kind, the units, the edge or enclave.

        Two that have the same kind are the same but for the units.
        """
        alarming = {
            finding.enclave for finding in self._picture.findings if finding.severity == "error"
        } | {each.path for each in self._picture.enclaves if each.problems}
        roles = _roles(self._picture)
        targets = {(each.kind, each.name) for each in self._picture.focus}
        owners = {each.path: self._owner(each.path) for each in self._picture.enclaves}
        for enclave in self._picture.enclaves:
            if enclave.path in self._of:
                owner, group = owners[enclave.path], self._text(enclave.group)
                drawn = (
                    *(owner.form, group.form, enclave.observed),
                    *(enclave.path in alarming, roles.get(enclave.path)),
                )
                yield self._kind(drawn), (*owner.units, *group.units), enclave.path
        for edge in self._picture.edges:
            owner, name = owners[edge.enclave], self._text(edge.name)
            by = tuple(map(self._text, edge.by))
            units = (*owner.units, *name.units, *(unit for each in by for unit in each.units))
            if not units:
                continue
            used = self._names_of.get((edge.kind, edge.name))
            drawn = (
                *(owner.form, edge.kind, name.form, edge.right, edge.qualifier),
                *(tuple(each.form for each in by), edge.parts, edge.mark, edge.common),
                *(edge.violates, (edge.kind, edge.name) in targets),
                *((used.protection, used.wildcard) if used else ()),
            )
            yield self._kind(drawn), units, edge

    def _kind(self, drawn: object) -> int:
        return self._kinds.setdefault(drawn, len(self._kinds))

    def _find_classes(self) -> dict[int, list[int]]:
        """Return the classes of equal units, sorted by name.

        First, units of a family are told apart only by what is their own.  Those that are unlike
        the rest of their family, or that most of it names (such as a leader), are then told apart
        wherever they are named.
        """
        self._symbols = [unit.family for unit in self._units]
        views = self._views()
        classes = _classes(views, [0] * len(views))
        usual: dict[int, int] = {}
        for found in sorted(classes.values(), key=lambda each: (-len(each), each)):
            if len(found) > 1:
                usual.setdefault(self._units[found[0]].family, found[0])
        self._usual = usual
        sizes = Counter(unit.family for unit in self._units)
        named = self._named_by(usual)
        for unit, *others in classes.values():
            family = self._units[unit].family
            near = family in usual and _alike(views[unit], views[usual[family]])
            if not others and not (near and 2 * named[unit] <= sizes[family]):
                self._symbols[unit] = -unit - 2
        before = [0] * len(views)
        for number, found in classes.items():
            for unit in found:
                before[unit] = number
        classes = _classes(self._views(), before)
        return {
            number: sorted(found, key=self._by_name)
            for number, found in classes.items()
            if len(found) > 1
        }

    def _by_name(self, unit: int) -> tuple[object, ...]:
        """Return a natural sort key: r2 comes before r10."""
        parts = re.split(r"(\d+)", self._units[unit].name)
        return tuple(
            (len(part.lstrip("0")), part) if number % 2 else part
            for number, part in enumerate(parts)
        )

    def _views(self) -> list[Counter[object]]:
        """Return what is drawn of each unit, with other units of its family made the same."""
        found: list[Counter[object]] = [Counter() for _ in self._units]
        for kind, units, _what in self._seen:
            for unit in set(units):
                found[unit][kind, self._around(units, unit)] += 1
        return found

    def _around(self, units: Sequence[int], unit: int) -> tuple[int, ...]:
        return tuple(_SELF if each == unit else self._symbols[each] for each in units)

    def _named_by(self, families: Container[int]) -> Counter[int]:
        """Return how many other units of its family name a unit."""
        pairs = {
            (unit, owner)
            for _kind, units, what in self._seen
            if isinstance(what, Edge) and (owner := self._of.get(what.enclave)) is not None
            for unit in units
            if unit != owner
            and self._units[unit].family == self._units[owner].family
            and self._units[unit].family in families
        }
        return Counter(each for each, _ in pairs)

    # ── the picture ────────────────────────────────────────────────────────────────────────

    def _folded(self) -> Folding:
        self._inside = {n: number for number, found in self._classes.items() for n in found}
        self._enclaves: dict[str, tuple[str, ...]] = {}
        self._names: dict[tuple[str, str], tuple[str, ...]] = {}
        self._alike: dict[object, list[str]] | None = None
        different, odd = self._differing()
        edges = tuple(sorted(set(self._edges(odd)), key=edge_order))
        picture = replace(
            self._picture,
            enclaves=tuple(self._folded_enclaves(odd)),
            names=tuple(self._folded_names(edges)),
            edges=edges,
            focus=tuple(map(self._focus, self._picture.focus)),
        )
        units = sorted(
            EqualUnits(
                self._label(found[0]),
                self._units[found[0]].what,
                tuple(self._units[n].name for n in found),
            )
            for found in self._classes.values()
        )
        return Folding(picture, tuple(units), different, self._enclaves, self._names)

    def _apart(self, unit: int) -> bool:
        """Return whether a unit may not be drawn together with others."""
        symbol = self._symbols[unit]
        return not any(
            len({each for each in units if self._symbols[each] == symbol}) > 1
            for _kind, units, _what in self._seen
        )

    def _label(self, unit: int, position: int = 0) -> str:
        """Return the label of a unit's class, or the unit's own word if no other unit is equal."""
        if unit not in self._inside:
            return self._word(unit, position)
        first, *_, last = self._classes[self._inside[unit]]
        return f"{{{self._word(first, position)}…{self._word(last, position)}}}"

    def _is_drawn(self, unit: int) -> bool:
        """Return whether a unit is drawn: only the first of a class of equal units is."""
        return unit not in self._inside or self._classes[self._inside[unit]][0] == unit

    def _path(self, enclave: str) -> str:
        """Return the path that is drawn for an enclave."""
        text, unit = self._owner(enclave), self._of.get(enclave)
        path = text.fill(self._label)
        if unit in self._inside and path not in self._enclaves:
            self._enclaves[path] = tuple(self._each(text, self._inside[unit]))
        return path

    def _each(self, text: _Text, colour: int) -> Iterator[str]:
        """Yield a text once for each unit of the class that it names."""
        for unit in self._classes[colour]:
            yield text.fill(partial(self._instead, unit))

    def _instead(self, unit: int, _each: int, position: int) -> str:
        return self._word(unit, position)

    def _edges(self, odd: Set[Edge | str]) -> Iterator[Edge]:
        """Yield the edges to draw: of the drawn units, and of all enclaves outside of units."""
        others = self._others()
        for edge in self._picture.edges:
            unit = self._of.get(edge.enclave)
            if unit is not None and not self._is_drawn(unit):
                continue
            name = self._text(edge.name)

            def word(each: int, at: int, edge: Edge = edge, unit: int | None = unit) -> str:
                if unit is None or not self._is_counted(unit, each):
                    return self._label(each, at)
                return others(edge, unit, each, at)

            shown = name.fill(word)
            if shown != edge.name and (edge.kind, shown) not in self._names:
                self._names[edge.kind, shown] = tuple(self._named(edge.kind, name))
            by = tuple(dict.fromkeys(self._text(each).fill(word) for each in edge.by))
            path = self._path(edge.enclave)
            yield replace(edge, enclave=path, name=shown, by=by, differs=edge in odd)

    def _is_counted(self, unit: int, each: int) -> bool:
        """Return whether other units that a unit names are drawn only as a number."""
        if each == unit or self._symbols[each] < 0:
            return False
        return each in self._inside or unit in self._inside

    def _others(self) -> Callable[[Edge, int, int, int], str]:
        """Return the text for other units that a unit names: their number."""
        number: dict[object, set[int]] = defaultdict(set)
        families: dict[int, list[int]] = defaultdict(list)
        for n in sorted(set(self._of.values()), key=self._by_name):
            families[self._units[n].family].append(n)

        def key(edge: Edge, unit: int, each: int) -> object:
            name = self._text(edge.name)
            rest = replace(edge, name="", by=())
            return rest, name.form, self._around(name.units, unit), self._units[each].family

        for edge in self._picture.edges:
            unit = self._of.get(edge.enclave)
            if unit is not None and self._is_drawn(unit):
                for each in self._text(edge.name).units:
                    if self._is_counted(unit, each):
                        number[key(edge, unit, each)].add(each)

        def several(edge: Edge, unit: int, each: int, position: int) -> str:
            family = self._units[each].family
            found, all_of = number[key(edge, unit, each)], families[family]
            if not found or sorted(found) == sorted(
                self._classes.get(self._inside.get(each, -1), ())
            ):
                return self._label(each, position)
            ends = f"{self._word(all_of[0], position)}…{self._word(all_of[-1], position)}"
            kin = family == self._units[unit].family
            return f"{{{counted(len(found), 'other') if kin else len(found)} of {ends}}}"

        return several

    def _named(self, kind: str, name: _Text) -> Iterable[str]:
        """Return the real names behind a drawn name."""
        if len(name.named) == 1:
            return self._each(name, self._inside[name.units[0]])
        if self._alike is None:
            self._alike = defaultdict(list)
            for each in self._picture.names:
                if len((text := self._text(each.name)).named) > 1:
                    self._alike[each.kind, self._form(text)].append(each.name)
        return self._alike[kind, self._form(name)]

    def _form(self, text: _Text) -> object:
        return text.form, tuple(self._symbols[unit] for unit in text.units)

    def _folded_names(self, edges: Sequence[Edge]) -> Iterator[Name]:
        for kind, shown in sorted({(edge.kind, edge.name) for edge in edges}):
            real = self._names.get((kind, shown), (shown,))[0]
            if found := self._names_of.get((kind, real)):
                yield replace(found, name=shown, namespace=namespace_of(shown))

    def _folded_enclaves(self, odd: Set[Edge | str]) -> Iterator[PicturedEnclave]:
        differing = {each if isinstance(each, str) else each.enclave for each in odd}
        for enclave in self._picture.enclaves:
            unit = self._of.get(enclave.path)
            if unit is None:
                yield enclave
            elif self._is_drawn(unit):
                note = "differs" if enclave.path in differing else ""
                if unit in self._inside and self._units[unit].alone:
                    note = f"{len(self._classes[self._inside[unit]])} equal enclaves"
                path, group = self._path(enclave.path), self._text(enclave.group).fill(self._label)
                yield replace(enclave, path=path, group=group, note=note)

    def _focus(self, focus: Focus) -> Focus:
        def paths(found: Iterable[str]) -> tuple[str, ...]:
            return tuple(dict.fromkeys(map(self._path, found)))

        def influences(found: Iterable[Influence]) -> tuple[Influence, ...]:
            one = {self._path(each.enclave): each for each in found}
            return tuple(replace(each, enclave=path) for path, each in one.items())

        return replace(
            focus,
            senders=paths(focus.senders),
            receivers=paths(focus.receivers),
            influencing=influences(focus.influencing),
            influenced=influences(focus.influenced),
        )

    # ── what differs ───────────────────────────────────────────────────────────────────────

    def _differing(self) -> tuple[tuple[DifferentUnit, ...], Set[Edge | str]]:
        """Return the units that differ slightly from most of their family, with the differences."""
        near = {
            n: usual
            for n in set(self._of.values())
            if (usual := self._usual.get(self._units[n].family)) is not None
            and usual in self._inside
            and self._is_drawn(n)
            and self._inside.get(n) != self._inside[usual]
        }
        seen: dict[int, dict[object, Edge | str]] = {n: {} for n in (*near.keys(), *near.values())}
        for kind, units, what in self._seen:
            for unit in seen.keys() & set(units):
                seen[unit].setdefault((kind, self._around(units, unit)), what)
        different: list[DifferentUnit] = []
        odd: set[Edge | str] = set()
        for n in sorted(near, key=self._by_name):
            own, other = seen[n], seen[near[n]]
            if _alike(own, other):
                more = [what for key, what in own.items() if key not in other]
                fewer = [what for key, what in other.items() if key not in own]
                odd.update(more)
                different.append(
                    DifferentUnit(
                        self._label(n),
                        self._label(near[n]),
                        tuple(self._said(more, n)),
                        tuple(self._said(fewer, n, near[n])),
                    )
                )
        return tuple(different), odd

    def _said(
        self, found: Sequence[Edge | str], unit: int, instead: int | None = None
    ) -> Iterator[str]:
        """Yield enclaves and rights in words, as ``unit`` would have them."""

        def word(each: int, position: int) -> str:
            return self._label(unit if each == instead else each, position)

        enclaves = {each for each in found if isinstance(each, str)}
        for each in found:
            if isinstance(each, str):
                yield f"enclave {self._owner(each).fill(word)}"
            elif each.enclave not in enclaves:
                deny = "" if each.qualifier is ALLOW else "DENY "
                enclave = self._owner(each.enclave).fill(word)
                yield f"{enclave} {deny}{each.right} {self._text(each.name).fill(word)}"


def _classes(views: Sequence[Counter[object]], before: Sequence[int]) -> dict[int, list[int]]:
    """Return classes of units with equal views, as a subdivision of the earlier classes."""
    numbers: dict[object, int] = {}
    found: dict[int, list[int]] = defaultdict(list)
    for unit, view in enumerate(views):
        if view:
            key = before[unit], frozenset(view.items())
            found[numbers.setdefault(key, len(numbers))].append(unit)
    return found


def _alike(one: Collection[object], other: Collection[object]) -> bool:
    """Return whether two views have at least half of their content in common."""
    return 2 * len(set(one).intersection(other)) >= max(len(one), len(other))


def _as_it_is(picture: Picture) -> Folding:
    return Folding(picture, (), (), {}, {})


# ── units ──────────────────────────────────────────────────────────────────────────────────


def _robots(picture: Picture, robots: Mapping[str, Robot]) -> Iterator[_Unit]:
    """Yield the robots of a fleet, with their enclaves in the picture."""
    enclaves: dict[str, list[str]] = defaultdict(list)
    named = {}
    for enclave in picture.enclaves:
        if robot := robots.get(enclave.path):
            named[robot.name] = robot
            enclaves[robot.name].append(enclave.path)
    for name, robot in named.items():
        space = robot.namespace.rpartition("/")[2]
        values = (name, space) if space not in ("", name) else (name,)
        yield _Unit(name, "robot", 0, tuple(enclaves[name]), values)


def _guessed(picture: Picture) -> Iterator[_Unit]:
    """Yield sibling namespaces or enclaves that contain nearly the same enclaves."""
    waiting = [_by_first((enclave.path[1:], enclave.path) for enclave in picture.enclaves)]
    family = 0
    while waiting:
        children = waiting.pop()
        number = Counter(frozenset(below) for below in children.values())
        for usual, most in sorted(number.items(), key=lambda each: (-each[1], sorted(each[0]))):
            if most < 2:
                break
            family += 1
            for name, below in sorted(children.items()):
                if 2 * len(usual & below.keys()) >= max(len(usual), len(below)):
                    what = _ENCLAVE if below.keys() == {""} else "namespace"
                    yield _Unit(name, what, family, tuple(sorted(below.values())), (name,))
                    del children[name]
        waiting += [
            _by_first((rest, path) for rest, path in below.items() if rest)
            for _, below in sorted(children.items())
        ]


def _by_first(paths: Iterable[tuple[str, str]]) -> dict[str, dict[str, str]]:
    """Group paths by their first part: map it to the rest of the path and to the enclave."""
    found: dict[str, dict[str, str]] = defaultdict(dict)
    for path, enclave in paths:
        first, _, rest = path.partition("/")
        found[first][rest] = enclave
    return found


def _roles(picture: Picture) -> Mapping[str, tuple[object, ...]]:
    """Map enclaves to their roles in the focus of a picture."""
    found: dict[str, list[object]] = defaultdict(list)
    for number, focus in enumerate(picture.focus):
        found[focus.name].append((number, "focus"))
        for role, paths in (("sends", focus.senders), ("receives", focus.receivers)):
            for path in paths:
                found[path].append((number, role))
        for role, far in (("before", focus.influencing), ("after", focus.influenced)):
            for each in far:
                found[each.enclave].append((number, role, each.hops))
    return {path: tuple(roles) for path, roles in found.items()}
