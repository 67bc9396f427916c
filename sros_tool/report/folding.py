"""Draw robots, namespaces or enclaves that differ only in their names once, with a label.

A unit is a robot of a fleet.  Without a fleet, units are sibling namespaces or enclaves that
contain nearly the same enclaves.  Two units are equal if their drawings differ only in the names of
the units.  The drawing of a unit has the rights and denials of the unit's enclaves, and the rights
and denials of other enclaves to the unit's names.  It also has the wildcards that the picture shows
only at known names. If a unit has rights to names of other units, such as the robots whose poses a
robot reads, only the number of these units has to be equal.

A label such as ``{r01…r50}`` stands for each equal unit: ``/{r01…r50}/base`` may publish
``/{r01…r50}/odom`` means that each robot may publish its own topic.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import chain
from typing import NamedTuple

from sros_tool.fleet.robots import Robot
from sros_tool.names import is_expression
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

_LABEL_CHARACTERS = "{}…"
"""Characters of labels that ROS names cannot have; pictures with these are not folded."""
_WORD = re.compile(r"[A-Za-z0-9_]+")
_MAX_PIECES = 16
"""Maximum number of pieces of a word (split at underscores) that are compared with unit names."""
_OWN_SYMBOL = -1
_TITLE_LETTERS = 30
"""Maximum length of the title of a frame, in characters; a frame is as wide as a card."""
_ENCLAVE = "enclave"
_Part = tuple[int, tuple[int, ...]]
"""A part of the picture about a unit: a number for its kind, and the units in it."""


class Folding(NamedTuple):
    """A picture in which equal units are drawn once, and the real names behind the labels.

    ``equal`` describes the equal units, and ``different`` units that differ slightly from them.
    ``enclaves`` maps drawn paths to the real paths; ``names`` maps a kind and a drawn name to the
    real names.
    """

    picture: Picture
    equal: tuple[EqualUnits, ...]
    different: tuple[DifferentUnit, ...]
    enclaves: Mapping[str, tuple[str, ...]]
    names: Mapping[tuple[str, str], tuple[str, ...]]

    @classmethod
    def of(cls, picture: Picture, robots: Mapping[str, Robot] | None = None) -> Folding:
        """Return a picture with equal units drawn once, with a label.

        Args:
            picture: any picture, even one with a focus or of two sources.
            robots: the robots of a fleet, by their enclaves.
        """
        return _Draft(picture, robots or {}).folding()

    def scenes(self, *, with_places: bool = True, hops: int = 0) -> tuple[Scene, ...]:
        """Return the scenes, whose cards list the real enclaves and names.

        Args:
            with_places: whether cards get a y and groups get frames; formats with a layout engine
                need neither.
            hops: with a focus, the number of hops to draw; 0 for the default.
        """
        scenes = scenes_of(self.picture, with_places=with_places, drawn_as=self.names)
        if self.picture.focus:
            scenes = (flow_scene(self.picture, hops or HOPS, with_places=with_places), *scenes)
        return tuple(map(self._with_real_members, scenes))

    def _with_real_members(self, scene: Scene) -> Scene:
        """Return a scene whose cards list the enclaves and names that they stand for."""
        cards = []
        for card in scene.cards:
            if card.kind:
                real = [self.names.get((card.kind, member), (member,)) for member in card.members]
            else:
                real = [self.enclaves.get(member, (member,)) for member in card.members]
            members = tuple(dict.fromkeys(chain.from_iterable(real)))
            cards.append(replace(card, members=members))
        return replace(
            scene,
            cards=tuple(cards),
            frames=tuple(self._with_folded_title(frame) for frame in scene.frames),
        )

    def _with_folded_title(self, frame: Frame) -> Frame:
        equal = next((units for units in self.equal if units.label in frame.title), None)
        if equal is None:
            return frame
        whole, short = equal.title, f"{len(equal.members)} equal {equal.what}s"
        return replace(frame, title=whole if len(whole) <= _TITLE_LETTERS else short)


class DrawnUnit(NamedTuple):
    """A robot, namespace or enclave (``what``) that can be equal to other units of its family.

    ``family`` is the number of the family.  ``values`` are the words that stand for the unit in
    names: its name, and its namespace if that differs. ``group`` are the groups and the domain of a
    robot: only robots with the same groups and domain are expected to be alike.
    """

    name: str
    what: str
    family: int
    enclaves: tuple[str, ...]
    values: tuple[str, ...]
    group: tuple[object, ...] = ()

    @property
    def is_single_enclave(self) -> bool:
        """Whether the unit is a single enclave, not a robot or namespace."""
        return self.what == _ENCLAVE


@dataclass(frozen=True)
class UnitText:
    """A text that is split at names of units.

    ``parts`` are the texts between the names.  In ``named``, each name of a unit is stored as two
    numbers: the index of the unit, and the index of the word in the unit's ``values``.
    """

    parts: tuple[str, ...]
    named: tuple[tuple[int, int], ...] = ()

    @cached_property
    def units(self) -> tuple[int, ...]:
        """The indices of the units named in the text, in order."""
        return tuple(unit for unit, _ in self.named)

    @cached_property
    def form(self) -> tuple[object, ...]:
        """The text without the names of units; equal for texts that differ only in units."""
        return self.parts, tuple(number for _, number in self.named)

    def fill(self, word: Callable[[int, int], str]) -> str:
        """Return the text with ``word(unit, index)`` in place of each name of a unit.

        ``index`` is the index of the name in the unit's ``values``.
        """
        named = (word(*named_unit) for named_unit in self.named)
        first, *rest = self.parts
        return first + "".join(value + part for value, part in zip(named, rest, strict=True))

    def with_only_unit(self, unit: int | None, word: Callable[[int, int], str]) -> UnitText:
        """Return the text split only at names of ``unit``; other names become plain text."""
        parts, named = [self.parts[0]], []
        for named_unit, part in zip(self.named, self.parts[1:], strict=True):
            if named_unit[0] == unit:
                named.append(named_unit)
                parts.append(part)
            else:
                parts[-1] += word(*named_unit) + part
        return UnitText(tuple(parts), tuple(named))


class UnitNames:
    """The names of units in texts, and the unit of each enclave.

    ``unit_of`` maps enclaves to the numbers of their units.  An enclave belongs to the unit whose
    name is in the enclave's path, even outside of the unit's namespace.  If the path has the names
    of several units, the enclave belongs to no unit. A unit can be folded only if the paths of all
    its enclaves have the unit's name.
    """

    def __init__(self, units: Sequence[DrawnUnit], paths: Iterable[str]) -> None:
        """Find the words for units in the paths of all enclaves."""
        number = Counter(value for unit in units for value in unit.values)
        dropped: set[int] = set()
        while True:
            self.words = {
                value: (n, position)
                for n, unit in enumerate(units)
                for position, value in enumerate(unit.values)
                if number[value] == 1 and n not in dropped
            }
            self._texts: dict[str, UnitText] = {}
            self.unit_of: dict[str, int] = {
                path: n
                for n, unit in enumerate(units)
                if n not in dropped
                for path in unit.enclaves
            }
            unnamed = {n for path, n in self.unit_of.items() if n not in self.text(path).units}
            if not unnamed:
                break
            dropped |= unnamed
        for path in paths:
            if path not in self.unit_of:
                named_units = set(self.text(path).units)
                if len(named_units) == 1:
                    self.unit_of[path] = named_units.pop()

    def text(self, text: str) -> UnitText:
        """Return a text split at the names of units: whole words, or parts between underscores."""
        split = self._texts.get(text)
        if split is None:
            split = self._texts[text] = self._split_at_units(text)
        return split

    def _split_at_units(self, text: str) -> UnitText:
        parts, named = [""], []
        end = 0
        for match in _WORD.finditer(text):
            parts[-1] += text[end : match.start()]
            end = match.end()
            pieces = match[0].split("_")
            at = 0
            while at < len(pieces):
                parts[-1] += "_" if at else ""
                value, size = self._longest_unit_name(pieces, at)
                if value:
                    named.append(value)
                    parts.append("")
                else:
                    parts[-1] += pieces[at]
                at += size
        parts[-1] += text[end:]
        return UnitText(tuple(parts), tuple(named))

    def _longest_unit_name(
        self, pieces: Sequence[str], at: int
    ) -> tuple[tuple[int, int] | None, int]:
        """Return the unit with the longest name that begins at piece ``at``, and the name's length.

        The first result is None if no name begins there; otherwise it is the number of the unit,
        and the number of the word in the unit's ``values``.  The length is a number of pieces.
        """
        for size in range(min(len(pieces) - at, _MAX_PIECES), 0, -1):
            unit = self.words.get("_".join(pieces[at : at + size]))
            if unit:
                return unit, size
        return None, 1


class _Draft:
    """The builder of a folding: first units, then classes of equal units, then the picture."""

    def __init__(self, picture: Picture, robots: Mapping[str, Robot]) -> None:
        paths = [enclave.path for enclave in picture.enclaves]
        self._picture = picture
        self._units = units_of(paths, robots)
        self._names_of = {(name.kind, name.name): name for name in picture.names}
        names = UnitNames(self._units, paths)
        self._unit_of, self._text = names.unit_of, names.text
        self._unread = {units.like: units.members for units in picture.unread}
        self._domains_of = {enclave.path: enclave.domains for enclave in picture.enclaves}

    def folding(self) -> Folding:
        """Return the folding; its picture is unchanged if nothing can be folded."""
        if self._unit_of and not self._has_marks():
            self._kinds: dict[object, int] = {}
            self._common_kinds: set[int] = set()
            self._seen = tuple(self._parts_with_unit_names())
            classes = self._find_classes()
            if self._picture.focus:
                # A name from one robot to another robot appears at two stages of the flow.
                classes = {
                    n: units for n, units in classes.items() if self._is_kept_apart(units[0])
                }
            if classes:
                self._classes = classes
                return self._make_folding()
        return Folding(self._picture, (), (), {}, {})

    def _has_marks(self) -> bool:
        texts = (
            *(enclave.path for enclave in self._picture.enclaves),
            *(enclave.group for enclave in self._picture.enclaves),
            *(name.name for name in self._picture.names),
        )
        return any(mark in text for text in texts for mark in _LABEL_CHARACTERS)

    # ── what is seen of each unit ──────────────────────────────────────────────────────────

    def _word(self, unit: int, position: int) -> str:
        return self._units[unit].values[position]

    def _path_split_at_own_unit(self, enclave: str) -> UnitText:
        """Return the path of an enclave, split only at the name of the enclave's own unit."""
        return self._text(enclave).with_only_unit(self._unit_of.get(enclave), self._word)

    def _parts_with_unit_names(self) -> Iterator[tuple[int, tuple[int, ...], Edge | str]]:
        """Yield each enclave and drawn right whose texts have names of units.

        Yields triples: a number, the units, and the enclave or right. Triples with the same number
        differ only in their units.
        """
        alarming = {
            finding.enclave for finding in self._picture.findings if finding.severity == "error"
        } | {enclave.path for enclave in self._picture.enclaves if enclave.problems}
        roles = _roles(self._picture)
        targets = {(focus.kind, focus.name) for focus in self._picture.focus}
        owners = {e.path: self._path_split_at_own_unit(e.path) for e in self._picture.enclaves}
        for enclave in self._picture.enclaves:
            if enclave.path in self._unit_of:
                owner, group = owners[enclave.path], self._text(enclave.group)
                drawn = (
                    *(owner.form, group.form, enclave.observed, enclave.note, enclave.domains),
                    *(enclave.path in alarming, roles.get(enclave.path)),
                )
                yield self._kind_number(drawn), (*owner.units, *group.units), enclave.path
        for edge in chain(self._picture.edges, self._stated_edges()):
            owner, name = owners[edge.enclave], self._text(edge.name)
            by = tuple(map(self._text, edge.by))
            units = (
                *owner.units,
                *name.units,
                *(unit for wildcard in by for unit in wildcard.units),
            )
            if not units:
                continue
            used = self._names_of.get((edge.kind, edge.name))
            drawn = (
                *(owner.form, edge.kind, name.form, edge.right, edge.qualifier),
                *(tuple(wildcard.form for wildcard in by), edge.parts, edge.mark, edge.common),
                *(edge.violates, (edge.kind, edge.name) in targets),
                *((used.protection, used.wildcard) if used else ()),
            )
            kind = self._kind_number(drawn)
            if edge.common:
                self._common_kinds.add(kind)
            yield kind, units, edge

    def _stated_edges(self) -> Iterator[Edge]:
        """Yield, in their original form, rights that the picture changes or does not show.

        These are wildcards; in a picture with a focus, all rights.
        """
        for enclave in self._picture.enclaves:
            for stated in enclave.statements:
                if self._picture.focus or is_expression(stated.name):
                    right = stated.kind, stated.name, stated.right, stated.qualifier
                    yield Edge(enclave.path, *right, mark=stated.mark)

    def _kind_number(self, drawn: object) -> int:
        return self._kinds.setdefault(drawn, len(self._kinds))

    def _find_classes(self) -> dict[int, list[int]]:
        """Map numbers to the classes of equal units; each class is sorted by name.

        First, units of a family are compared without regard to the names of other units. Then the
        names of some units count: the names of units that are unlike the rest of their family, and
        of units, such as a leader, to whose names most of the family has rights.
        """
        self._symbols = [unit.family for unit in self._units]
        parts = self._parts_by_unit()
        classes = _classes(parts, [0] * len(parts))
        usual: dict[int, int] = {}
        for members in sorted(classes.values(), key=lambda members: (-len(members), members)):
            if len(members) > 1:
                usual.setdefault(self._units[members[0]].family, members[0])
        sizes = Counter(unit.family for unit in self._units)
        named = self._number_of_users(usual)
        for unit, *later_units in classes.values():
            family = self._units[unit].family
            near = family in usual and self._are_alike(parts[unit], parts[usual[family]])
            if not later_units and not (near and 2 * named[unit] <= sizes[family]):
                self._symbols[unit] = -unit - 2
        before = [0] * len(parts)
        for number, members in classes.items():
            for unit in members:
                before[unit] = number
        classes = _classes(self._parts_by_unit(), before)
        return {
            number: sorted(class_units, key=self._unit_name_order)
            for number, class_units in classes.items()
            if len(class_units) > 1
        }

    def _unit_name_order(self, unit: int) -> tuple[object, ...]:
        return name_order(self._units[unit].name)

    def _unit_names(self, units: Iterable[int]) -> tuple[str, ...]:
        """Return the names of equal units, including units that were not read in full."""
        names = [self._units[unit].name for unit in units]
        unread = (self._unread.get(name, ()) for name in names)
        return tuple(sorted([*names, *chain.from_iterable(unread)], key=name_order))

    def _parts_by_unit(self) -> list[Counter[_Part]]:
        """Return, for each unit, the parts of the picture with its name, as symbols."""
        parts: list[Counter[_Part]] = [Counter() for _ in self._units]
        for kind, units, _what in self._seen:
            for unit in set(units):
                parts[unit][kind, self._symbols_around(units, unit)] += 1
        return parts

    def _symbols_around(self, units: Sequence[int], unit: int) -> tuple[int, ...]:
        return tuple(
            _OWN_SYMBOL if other_unit == unit else self._symbols[other_unit] for other_unit in units
        )

    def _are_alike(self, view: Iterable[_Part], other_view: Iterable[_Part]) -> bool:
        """Return whether two drawings of units have at least half of their content in common.

        Rights that every node needs do not count, because they would make any two enclaves alike.
        """
        own, others = (
            {part for part in parts if part[0] not in self._common_kinds}
            for parts in (view, other_view)
        )
        return 2 * len(own & others) >= max(len(own), len(others))

    def _number_of_users(self, families: Container[int]) -> Counter[int]:
        """Map each unit to how many other units of its family have rights to its names.

        Only units of ``families`` are counted.
        """
        pairs = {
            (unit, owner)
            for _kind, units, part in self._seen
            if isinstance(part, Edge) and (owner := self._unit_of.get(part.enclave)) is not None
            for unit in units
            if unit != owner
            and self._units[unit].family == self._units[owner].family
            and self._units[unit].family in families
        }
        return Counter(named_unit for named_unit, _ in pairs)

    # ── the picture ────────────────────────────────────────────────────────────────────────

    def _make_folding(self) -> Folding:
        self._inside = {n: number for number, members in self._classes.items() for n in members}
        self._enclaves: dict[str, tuple[str, ...]] = {}
        self._names: dict[tuple[str, str], tuple[str, ...]] = {}
        self._names_of_form: dict[object, list[str]] | None = None
        different, differing_parts = self._differing_units()
        edges = tuple(sorted(set(self._edges(differing_parts)), key=edge_order))
        picture = replace(
            self._picture,
            enclaves=tuple(self._folded_enclaves(differing_parts)),
            names=tuple(self._folded_names(edges)),
            edges=edges,
            focus=tuple(map(self._folded_focus, self._picture.focus)),
        )
        shown_domains = {self._domains(unit) for unit in self._unit_of.values()} - {""}
        units = sorted(
            EqualUnits(
                self._label(members[0]),
                self._units[members[0]].what,
                self._unit_names(members),
                self._domains(members[0]) if len(shown_domains) > 1 else "",
            )
            for members in self._classes.values()
        )
        return Folding(picture, tuple(units), different, self._enclaves, self._names)

    def _domains(self, unit: int) -> str:
        """Return the ROS domains of a unit's enclaves as text; "" if they differ."""
        enclaves = self._units[unit].enclaves
        domains = {self._domains_of[enclave] for enclave in enclaves if enclave in self._domains_of}
        return domains.pop() if len(domains) == 1 else ""

    def _is_kept_apart(self, unit: int) -> bool:
        """Return whether a unit has to be drawn separately from equal units."""
        symbol = self._symbols[unit]
        return not any(
            len({other_unit for other_unit in units if self._symbols[other_unit] == symbol}) > 1
            for _kind, units, _what in self._seen
        )

    def _label(self, unit: int, position: int = 0) -> str:
        """Return the label for a unit's class; for a unit without equal units, its own word."""
        if unit not in self._inside:
            return self._word(unit, position)
        first, *_, last = self._classes[self._inside[unit]]
        return f"{{{self._word(first, position)}…{self._word(last, position)}}}"

    def _is_drawn(self, unit: int) -> bool:
        """Return whether a unit is drawn: true for the first of a class of equal units only."""
        return unit not in self._inside or self._classes[self._inside[unit]][0] == unit

    def _path(self, enclave: str) -> str:
        """Return the path that is drawn for an enclave, with labels for units."""
        text, unit = self._path_split_at_own_unit(enclave), self._unit_of.get(enclave)
        path = text.fill(self._label)
        if unit in self._inside and path not in self._enclaves:
            self._enclaves[path] = tuple(self._per_unit(text, self._inside[unit]))
        return path

    def _per_unit(self, text: UnitText, number: int) -> Iterator[str]:
        """Yield the text once for each unit of a class, with the name of this unit."""
        for unit in self._classes[number]:
            yield text.fill(partial(self._plain_word, unit))

    def _plain_word(self, unit: int, _unit: int, position: int) -> str:
        return self._word(unit, position)

    def _edges(self, differing_parts: Set[Edge | str]) -> Iterator[Edge]:
        """Yield the rights to draw: rights of drawn units, and of enclaves without a unit."""
        count_text = self._other_units_text()
        for edge in self._picture.edges:
            unit = self._unit_of.get(edge.enclave)
            if unit is not None and not self._is_drawn(unit):
                continue
            name = self._text(edge.name)

            def unit_label(named: int, at: int, edge: Edge = edge, unit: int | None = unit) -> str:
                if unit is None or not self._is_counted(unit, named):
                    return self._label(named, at)
                return count_text(edge, unit, named, at)

            shown = name.fill(unit_label)
            if shown != edge.name and (edge.kind, shown) not in self._names:
                self._names[edge.kind, shown] = tuple(self._real_names(edge.kind, name))
            by = tuple(dict.fromkeys(self._text(wildcard).fill(unit_label) for wildcard in edge.by))
            path = self._path(edge.enclave)
            yield replace(edge, enclave=path, name=shown, by=by, differs=edge in differing_parts)

    def _is_counted(self, unit: int, other: int) -> bool:
        """Return whether ``unit`` shows only the number of units such as ``other``."""
        if other == unit or self._symbols[other] < 0:
            return False
        return other in self._inside or unit in self._inside

    def _other_units_text(self) -> Callable[[Edge, int, int, int], str]:
        """Return a function that returns the text for another unit in the name of a right.

        The text is the label of the unit's class, or, if only some units of its family are named,
        their number, such as ``{3 others of r1…r9}``.
        """
        units_by_key: dict[object, set[int]] = defaultdict(set)
        families: dict[int, list[int]] = defaultdict(list)
        for n in sorted(set(self._unit_of.values()), key=self._unit_name_order):
            families[self._units[n].family].append(n)

        def key(edge: Edge, unit: int, other_unit: int) -> object:
            name = self._text(edge.name)
            rest = replace(edge, name="", by=())
            return (
                rest,
                name.form,
                self._symbols_around(name.units, unit),
                self._units[other_unit].family,
            )

        for edge in self._picture.edges:
            unit = self._unit_of.get(edge.enclave)
            if unit is not None and self._is_drawn(unit):
                for other_unit in self._text(edge.name).units:
                    if self._is_counted(unit, other_unit):
                        units_by_key[key(edge, unit, other_unit)].add(other_unit)

        def unit_text(edge: Edge, unit: int, other_unit: int, position: int) -> str:
            family = self._units[other_unit].family
            named, all_of = units_by_key[key(edge, unit, other_unit)], families[family]
            if not named or sorted(named) == sorted(
                self._classes.get(self._inside.get(other_unit, -1), ())
            ):
                return self._label(other_unit, position)
            ends = f"{self._word(all_of[0], position)}…{self._word(all_of[-1], position)}"
            is_same_family = family == self._units[unit].family
            return f"{{{counted(len(named), 'other') if is_same_family else len(named)} of {ends}}}"

        return unit_text

    def _real_names(self, kind: str, name: UnitText) -> Iterable[str]:
        """Yield the real names for which a drawn name with labels stands."""
        if len(name.named) == 1 and name.units[0] in self._inside:
            return self._per_unit(name, self._inside[name.units[0]])
        if self._names_of_form is None:
            self._names_of_form = defaultdict(list)
            for real in self._picture.names:
                if (text := self._text(real.name)).named:
                    self._names_of_form[real.kind, self._text_form(text)].append(real.name)
        return self._names_of_form[kind, self._text_form(name)]

    def _text_form(self, text: UnitText) -> object:
        return text.form, tuple(self._symbols[unit] for unit in text.units)

    def _folded_names(self, edges: Sequence[Edge]) -> Iterator[Name]:
        for kind, shown in sorted({(edge.kind, edge.name) for edge in edges}):
            real = self._names.get((kind, shown), (shown,))[0]
            if name := self._names_of.get((kind, real)):
                yield replace(name, name=shown, namespace=namespace_of(shown))

    def _folded_enclaves(self, differing_parts: Set[Edge | str]) -> Iterator[PicturedEnclave]:
        differing = {part if isinstance(part, str) else part.enclave for part in differing_parts}
        for enclave in self._picture.enclaves:
            unit = self._unit_of.get(enclave.path)
            if unit is None:
                yield enclave
            elif self._is_drawn(unit):
                note = "differs" if enclave.path in differing else ""
                if unit in self._inside and self._units[unit].is_single_enclave:
                    equal = self._unit_names(self._classes[self._inside[unit]])
                    note = f"{len(equal)} equal enclaves"
                path, group = self._path(enclave.path), self._text(enclave.group).fill(self._label)
                note = ", ".join(filter(None, (note, enclave.note)))
                yield replace(enclave, path=path, group=group, note=note)

    def _folded_focus(self, focus: Focus) -> Focus:
        def paths(enclaves: Iterable[str]) -> tuple[str, ...]:
            return tuple(dict.fromkeys(map(self._path, enclaves)))

        def influences(stated: Iterable[Influence]) -> tuple[Influence, ...]:
            by_path = {self._path(influence.enclave): influence for influence in stated}
            return tuple(replace(influence, enclave=path) for path, influence in by_path.items())

        return replace(
            focus,
            senders=paths(focus.senders),
            receivers=paths(focus.receivers),
            influencing=influences(focus.influencing),
            influenced=influences(focus.influenced),
        )

    # ── what differs ───────────────────────────────────────────────────────────────────────

    def _differing_units(self) -> tuple[tuple[DifferentUnit, ...], Set[Edge | str]]:
        """Return the units that differ slightly from most units of their family.

        Also returns the drawn enclaves and rights in which they differ.
        """
        usual_of: dict[object, int] = {}
        for members in sorted(self._classes.values(), key=lambda members: (-len(members), members)):
            for n in members:
                usual_of.setdefault((self._units[n].family, self._units[n].group), members[0])
        near = {
            n: usual
            for n in set(self._unit_of.values()) - self._units_in_focus()
            if (usual := usual_of.get((self._units[n].family, self._units[n].group))) is not None
            and self._is_drawn(n)
            and self._inside.get(n) != self._inside[usual]
        }
        parts_of: dict[int, dict[_Part, Edge | str]] = {
            n: {} for n in (*near.keys(), *near.values())
        }
        for kind, units, part in self._seen:
            for unit in parts_of.keys() & set(units):
                parts_of[unit].setdefault((kind, self._symbols_around(units, unit)), part)
        different: list[DifferentUnit] = []
        differing_parts: set[Edge | str] = set()
        for n in sorted(near, key=self._unit_name_order):
            own_parts, near_parts = parts_of[n], parts_of[near[n]]
            if self._are_alike(own_parts, near_parts):
                more = [part for key, part in own_parts.items() if key not in near_parts]
                fewer = [part for key, part in near_parts.items() if key not in own_parts]
                differing_parts.update(more)
                only = dict.fromkeys(self._texts_of_parts(more, n))
                missing = dict.fromkeys(self._texts_of_parts(fewer, n, near[n]))
                # An enclave that both units have differs in something else, such as a fault.
                has = tuple(text for text in only if text not in missing)
                lacks = tuple(text for text in missing if text not in only)
                if has or lacks:
                    different.append(
                        DifferentUnit(self._label(n), self._label(near[n]), has, lacks)
                    )
        return tuple(different), differing_parts

    def _units_in_focus(self) -> set[int]:
        """Return the units in the focus, which are not equal to units outside of the focus."""
        names = (focus.name for focus in self._picture.focus)
        return {unit for name in names for unit in self._text(name).units}

    def _texts_of_parts(
        self, drawn: Sequence[Edge | str], unit: int, replaced: int | None = None
    ) -> Iterator[str]:
        """Yield enclaves and rights in words, with the name of ``unit`` instead of ``replaced``."""

        def unit_label(named: int, position: int) -> str:
            return self._label(unit if named == replaced else named, position)

        enclaves = {part for part in drawn if isinstance(part, str)}
        for part in drawn:
            if isinstance(part, str):
                yield f"enclave {self._path_split_at_own_unit(part).fill(unit_label)}"
            elif part.enclave not in enclaves:
                deny = "" if part.qualifier is ALLOW else "DENY "
                enclave = self._path_split_at_own_unit(part.enclave).fill(unit_label)
                yield f"{enclave} {deny}{part.right} {self._text(part.name).fill(unit_label)}"


def _classes(views: Sequence[Counter[_Part]], before: Sequence[int]) -> dict[int, list[int]]:
    """Map new numbers to classes of units that have equal views and the same number ``before``."""
    numbers: dict[object, int] = {}
    classes: dict[int, list[int]] = defaultdict(list)
    for unit, view in enumerate(views):
        if view:
            key = before[unit], frozenset(view.items())
            classes[numbers.setdefault(key, len(numbers))].append(unit)
    return classes


# ── units ──────────────────────────────────────────────────────────────────────────────────


def units_of(paths: Sequence[str], robots: Mapping[str, Robot]) -> list[DrawnUnit]:
    """Return the units of enclaves: ``robots``, or else units with similar paths."""
    return list(_robots(paths, robots) if robots else _guessed_units(paths))


def name_order(name: str) -> tuple[object, ...]:
    """Return the sort key of a unit's name by which r2 comes before r10."""
    parts = re.split(r"(\d+)", name)
    return tuple(
        (len(part.lstrip("0")), part) if number % 2 else part for number, part in enumerate(parts)
    )


def _robots(paths: Iterable[str], robots: Mapping[str, Robot]) -> Iterator[DrawnUnit]:
    """Yield the robots of a fleet that have enclaves in ``paths``."""
    enclaves: dict[str, list[str]] = defaultdict(list)
    named = {}
    for path in paths:
        if robot := robots.get(path):
            named[robot.name] = robot
            enclaves[robot.name].append(path)
    for name, robot in named.items():
        space = robot.namespace.rpartition("/")[2]
        values = (name, space) if space not in ("", name) else (name,)
        group = (robot.groups, robot.domain)
        yield DrawnUnit(name, "robot", 0, tuple(enclaves[name]), values, group)


def _guessed_units(paths: Iterable[str]) -> Iterator[DrawnUnit]:
    """Yield sibling namespaces or enclaves, in families that have similar enclaves below them.

    At least half of the relative names of the enclaves are the same as in the most common set of
    the family.
    """
    waiting = [_group_by_first_part((path[1:], path) for path in paths)]
    family = 0
    while waiting:
        children = waiting.pop()
        number = Counter(frozenset(below) for below in children.values())
        for usual, most in sorted(
            number.items(), key=lambda counted: (-counted[1], sorted(counted[0]))
        ):
            if most < 2:
                break
            family += 1
            for name, below in sorted(children.items()):
                if 2 * len(usual & below.keys()) >= max(len(usual), len(below)):
                    kind = _ENCLAVE if below.keys() == {""} else "namespace"
                    yield DrawnUnit(name, kind, family, tuple(sorted(below.values())), (name,))
                    del children[name]
        waiting += [
            _group_by_first_part((rest, path) for rest, path in below.items() if rest)
            for _, below in sorted(children.items())
        ]


def _group_by_first_part(paths: Iterable[tuple[str, str]]) -> dict[str, dict[str, str]]:
    """Map the first part of paths to the rest of these paths, and the rest to the enclave."""
    groups: dict[str, dict[str, str]] = defaultdict(dict)
    for path, enclave in paths:
        first, _, rest = path.partition("/")
        groups[first][rest] = enclave
    return groups


def _roles(picture: Picture) -> Mapping[str, tuple[object, ...]]:
    """Map enclaves to their roles in the focus of a picture: sender, receiver, number of hops."""
    roles_of: dict[str, list[object]] = defaultdict(list)
    for number, focus in enumerate(picture.focus):
        roles_of[focus.name].append((number, "focus"))
        for role, paths in (("sends", focus.senders), ("receives", focus.receivers)):
            for path in paths:
                roles_of[path].append((number, role))
        for role, far in (("before", focus.influencing), ("after", focus.influenced)):
            for influence in far:
                roles_of[influence.enclave].append((number, role, influence.hops))
    return {path: tuple(roles) for path, roles in roles_of.items()}
