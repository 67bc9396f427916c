"""The picture of a robot's rights as plain values, the input of every output format.

Everything is sorted and contains neither paths of the machine nor a time of creation, so the same
sources always give the same picture.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Annotated, NamedTuple

from sros_tool.names import READING_SERVICES
from sros_tool.policy.model import ALLOW, RIGHTS, Qualifier
from sros_tool.policy.rights import RIGHT_ORDER
from sros_tool.values import Words, shows
from sros_tool.wording import counted, first_few

SENDS = {"publish": True, "request": True, "call": True} | dict.fromkeys(
    ("subscribe", "reply", "execute"), False
)
"""Whether the arrow of a right points to the name, because the enclave sends first."""

_ASKED = tuple(f"/{name}" for name in READING_SERVICES)
_KINDS = (*RIGHTS, "dds")
"""The kinds of names in display order; dds is a topic without a ROS name."""


class OverlaySide(StrEnum):
    """The side of an overlay that has a right; always BOTH without an overlay."""

    BOTH = "both"
    FIRST = "first"
    SECOND = "second"


class WireLevel(StrEnum):
    """The minimum protection of messages on the wire, from the weakest to the strongest."""

    UNKNOWN = "unknown"
    NONE = "none"
    SIGN = "sign"
    ENCRYPT = "encrypt"


@dataclass(frozen=True, slots=True)
class Protection:
    """The protection of a name by governance: the weakest of all its DDS topics.

    ``data``, ``metadata`` and ``rtps`` are protection kinds of DDS-Security 1.1.  Without
    ``read_control``, every authenticated participant may read, whatever its permissions; without
    ``write_control``, every authenticated participant may write.
    """

    level: WireLevel
    """The least protection on the wire."""
    data: str = ""
    """Protection of the payload, or an empty string."""
    metadata: str = ""
    """Protection of submessages."""
    rtps: str = ""
    """Protection of RTPS messages."""
    read_control: bool = True
    """Whether permissions decide who may read."""
    write_control: bool = True
    """Whether permissions decide who may write."""


UNKNOWN = Protection(WireLevel.UNKNOWN)
"""The protection if no governance is known, such as for a policy alone."""


@shows(
    *("enclave", "kind", "name", "right", "qualifier"),
    *("by", "parts", "mark", "common", "violates", "direction"),
)
@dataclass(frozen=True, slots=True, order=True)
class Edge:
    """A right or denial of one enclave for one name.

    ``by`` are the expressions that match the name, empty if the right has the exact name.
    ``parts`` are the parts of an action, such as feedback, if the right is not for the whole
    action.  ``common`` marks rights that every node needs to start, ``violates`` those by which a
    requirement does not hold, ``differs`` those that units like this one do not have.
    """

    enclave: str
    """The enclave."""
    kind: str
    """The kind of the name."""
    name: str
    """The name."""
    right: str
    """The right."""
    qualifier: Qualifier
    """Whether it is a right or a denial."""
    by: tuple[str, ...] = ()
    """The wildcards that give it."""
    parts: tuple[str, ...] = ()
    """The parts of an action, if it is not for the whole."""
    mark: OverlaySide = OverlaySide.BOTH
    """The side that has it, in a comparison."""
    common: bool = False
    """Whether every node needs it."""
    violates: bool = False
    """Whether a requirement does not hold because of it."""
    differs: bool = False

    @property
    def sends(self) -> bool:
        """Whether the arrow points from the enclave to the name."""
        return SENDS[self.right]

    @property
    def direction(self) -> Annotated[str, Words(("to the name", "from the name"))]:
        """Where the arrow points."""
        return "to the name" if self.sends else "from the name"


class Lack(StrEnum):
    """The side of a name that no enclave may take, although one may take the other side."""

    NOTHING = ""
    SENDER = "sender"
    RECEIVER = "receiver"


@dataclass(frozen=True, slots=True)
class Name:
    """A topic, service or action; or a ``wildcard`` without any known name.

    ``lacks`` is the side that nobody may take: of a service, who serves it is the receiver.
    """

    kind: str
    """Its kind."""
    name: str
    """The name."""
    namespace: str
    """Its namespace."""
    protection: Protection
    """Protection by the governance."""
    wildcard: bool = False
    """Whether it is a wildcard that matches no known name."""
    lacks: Lack = Lack.NOTHING
    """The side that no enclave may take, though one may take the other, or an empty string; who
    serves a service is its receiver."""


_LACKING = {
    "topics": ("publish", "subscribe"),
    "dds": ("publish", "subscribe"),
    "services": ("call", "serve"),
    "actions": ("call", "execute"),
}


def lack_text(kind: str, lacks: Lack) -> str:
    """Return what nobody may do with a name of this kind, such as ``nobody may publish``."""
    sends, receives = _LACKING[kind]
    return f"nobody may {sends if lacks is Lack.SENDER else receives}"


def asks(name: Name | Edge) -> bool:
    """Return whether a name is a service whose requests change nothing (`QUESTIONS` of reach)."""
    return name.kind == "services" and name.name.endswith(_ASKED)


class Statement(NamedTuple):
    """A right as written in the source, and the number of known names that it matches."""

    qualifier: Qualifier
    """Whether it is a right or a denial."""
    right: str
    """The right."""
    kind: str
    """The kind of the name."""
    name: str
    """The name, perhaps with wildcards."""
    reaches: int
    """Number of known names that it matches."""
    mark: OverlaySide = OverlaySide.BOTH
    """The side that has it, in a comparison."""


@shows(
    *("path", "group", "nodes", "statements", "subject", "issuer", "serial", "key"),
    *("problems", "observed"),
)
@dataclass(frozen=True, slots=True)
class PicturedEnclave:
    """An enclave in a picture; ``group`` is its host or its namespace.

    ``subject``, ``issuer``, ``serial`` and ``key`` describe its certificate; "" without one.
    ``problems`` keep a process from using it.  In an overlay of use, an enclave that was not
    ``observed`` counts as neither used nor unused.  ``note`` stands on its card.
    """

    path: str
    """The enclave."""
    group: str
    """Its host, or its namespace."""
    nodes: tuple[str, ...] = ()
    """Its nodes."""
    statements: tuple[Statement, ...] = ()
    """Its rights, as written in the source."""
    subject: str = ""
    """Subject of its certificate, or an empty string; so for the next three."""
    issuer: str = ""
    """Its issuer."""
    serial: str = ""
    """Its serial number, in hexadecimal."""
    key: str = ""
    """The kind of its key."""
    problems: tuple[str, ...] = ()
    """What keeps a process from using it."""
    observed: bool = True
    """With ``--observed``: whether it was observed."""
    note: str = ""


@dataclass(frozen=True, slots=True, order=True)
class Validity:
    """The validity of a certificate, a CA, a permissions document, or a CRL.

    ``not_before`` and ``not_after`` are CCYY-MM-DDThh:mm:ssZ in UTC.
    """

    not_after: str
    """Its end, in UTC."""
    not_before: str
    """Its begin, in UTC."""
    kind: str
    """What is valid."""
    title: str
    """Its name."""
    enclave: str = ""
    """The enclave, or an empty string."""


@dataclass(frozen=True, slots=True)
class PicturedFinding:
    """A fault or weakness; ``severity`` is error, warning or note."""

    id: str
    """The kind of finding."""
    severity: Annotated[str, Words(("error", "warning", "note"))]
    """Its severity."""
    text: str
    """What was found."""
    remedy: str = ""
    """What to do."""
    enclave: str = ""
    """The enclave, or another subject."""


class SourceTitle(NamedTuple):
    """The title of a source in the picture: its base name, and its kind."""

    title: str
    """Its base name."""
    kind: str
    """What it is, such as ``policy``."""


class Overlay(NamedTuple):
    """The kind of an overlay of two sources.

    ``kind`` is use (allowed and observed), change (before and after), drift (policy and keystore)
    or worlds (rights and rules of Zenoh); ``first`` and ``second`` label a right that only the
    first or second side has.
    """

    kind: Annotated[str, Words(("use", "change", "drift", "worlds"))]
    """What is compared."""
    first: str
    """What only the first side has, in words."""
    second: str
    """What only the second side has, in words."""


class OverlayDifference(NamedTuple):
    """A right that only one side has, with ``notes``.

    For a change, the notes are the wildcards of the other side that cover the right; for use, the
    number of names that a wildcard matches and that were never observed.
    """

    mark: OverlaySide
    """The side that has it, in a comparison."""
    text: str
    """The right."""
    notes: tuple[str, ...] = ()
    """Notes on it."""


@dataclass(frozen=True, slots=True)
class Influence:
    """An enclave that influences, or is influenced, over ``hops``, by a shortest ``path``."""

    enclave: str
    """The enclave."""
    hops: int
    """Number of hops: names on the way."""
    path: str
    """A shortest way."""


@dataclass(frozen=True, slots=True)
class Focus:
    """The answer about one name or enclave, which is true for all names, known or not.

    ``kind`` is the kind of the name, or enclave.  ``senders`` and ``receivers`` may use the name.
    ``influencing`` influence the senders, or the enclave: with two hops, a sender directly.
    ``influenced`` are influenced by the enclave; empty for a name.
    """

    kind: Annotated[str, Words((*_KINDS, "enclave"))]
    """The kind of the name, or ``enclave``."""
    name: str
    """The name, or the enclave."""
    sentence: str
    """The answer in one sentence."""
    senders: tuple[str, ...]
    """Enclaves that may publish, call or write it."""
    receivers: tuple[str, ...]
    """Enclaves that may subscribe, serve, execute or read it."""
    influencing: tuple[Influence, ...]
    """Enclaves that influence the senders, or the enclave; with 2 hops directly."""
    influenced: tuple[Influence, ...] = ()
    """Enclaves that the enclave influences; with 1 hop directly."""


class PicturedUse(NamedTuple):
    """A use of a name that breaks a requirement; ``by`` is the wildcard that allows it, or ""."""

    enclave: str
    """The enclave."""
    right: str
    """Its right."""
    kind: str
    """The kind of the name."""
    name: str
    """The name."""
    by: str = ""
    """The wildcard that allows it, or an empty string."""


class PicturedViolation(NamedTuple):
    """A requirement that does not hold, in words, and the uses that break it."""

    text: str
    """What breaks it, and what it demands."""
    uses: tuple[PicturedUse, ...]
    """The uses of names that break it."""


_SAID = 5  # violations, and units that differ, that the headlines say; JSON has all
_SHOWN = 2  # rights that they say of one unit


class Requirements(NamedTuple):
    """The number of requirements that hold, and those that do not.

    ``assumed`` are those that hold by an assumption, in words.
    """

    hold: int
    """Number of requirements that hold."""
    violations: tuple[PicturedViolation, ...] = ()
    """Those that do not."""
    assumed: tuple[str, ...] = ()
    """Those that hold by an assumption, in words."""

    def sentences(self) -> tuple[str, ...]:
        """Return the result in sentences without a full stop."""
        holds = f"{counted(self.hold, 'requirement')} hold{'s' if self.hold == 1 else ''}"
        if self.assumed:
            holds += f", {len(self.assumed)} of them by an assumption: {self.assumed[0]}"
        if not self.violations:
            return (holds,)
        number = len(self.violations)
        more = (f"{number - _SAID} more do not hold",) if number > _SAID else ()
        said = (f"Violated: {violation.text}" for violation in self.violations[:_SAID])
        return (*said, *more, *((holds,) if self.hold else ()))


class EqualUnits(NamedTuple):
    """Robots, namespaces or enclaves (``what``) that are equal but for their names.

    ``label`` stands for each of them in the paths and names that are drawn, like ``{r01…r50}``.
    """

    label: str
    """What stands for each of them in the picture, such as ``{r01…r50}``."""
    what: Annotated[str, Words(("robot", "namespace", "enclave"))]
    """What they are."""
    members: tuple[str, ...]
    """Their names."""

    @property
    def title(self) -> str:
        """The units in words, like ``r01 … r50: 50 equal robots``."""
        first, last = self.members[0], self.members[-1]
        return f"{first} … {last}: {len(self.members)} equal {self.what}s"


class DifferentUnit(NamedTuple):
    """A unit, or the label of several, that is nearly equal to those of the label ``usual``.

    ``more`` and ``fewer`` are the enclaves and rights that it has and lacks, in words.
    """

    unit: str
    """Its name, or a label in ``equal``."""
    usual: str
    """The label of those that it differs from."""
    more: tuple[str, ...]
    """Enclaves and rights that only it has."""
    fewer: tuple[str, ...]
    """Enclaves and rights that it lacks."""

    def sentence(self) -> str:
        """Return what differs in a sentence without a full stop."""
        parts = []
        for has, found in (("it has", self.more), ("it lacks", self.fewer)):
            parts += [f"{has} {first_few(found, _SHOWN, '; ')}"] if found else []
        usual = self.usual.strip("{}").replace("…", " … ")
        return f"{self.unit.strip('{}')} differs from {usual}: {', and '.join(parts)}"


@dataclass(frozen=True, slots=True)
class Picture:
    """The rights in a system, with their protection, validity and findings.

    With a ``focus``, only what leads to it and from it.
    """

    title: str
    """Its title."""
    origins: tuple[SourceTitle, ...]
    """The sources."""
    enclaves: tuple[PicturedEnclave, ...]
    """The enclaves."""
    names: tuple[Name, ...]
    """The topics, services and actions."""
    edges: tuple[Edge, ...]
    """The rights, one for each enclave and name."""
    overlay: Overlay | None = None
    """The comparison, or null."""
    differences: tuple[OverlayDifference, ...] = ()
    """Rights that only one side has."""
    validities: tuple[Validity, ...] = ()
    """Validity of certificates, CAs, permissions and revocation lists."""
    findings: tuple[PicturedFinding, ...] = ()
    """Findings of ``sros check``."""
    focus: tuple[Focus, ...] = ()
    """With ``--focus``: an answer for each name and enclave."""
    requirements: Requirements | None = None
    """With ``--requirements``: what holds and what does not; else null."""
    equal: tuple[EqualUnits, ...] = ()
    """Robots, namespaces or enclaves that are equal but for their names, drawn as one."""
    different: tuple[DifferentUnit, ...] = ()
    """Those that differ a little from equal ones."""

    @property
    def headlines(self) -> tuple[str, ...]:
        """The answers that the picture gives, as sentences without a full stop."""
        found = self.requirements.sentences() if self.requirements else ()
        equal = (f"{units.title} are drawn as one" for units in self.equal)
        more = len(self.different) - _SAID
        different = [unit.sentence() for unit in self.different[:_SAID]]
        different += [f"{more} more differ"] if more > 0 else []
        return (*(each.sentence for each in self.focus), *found, *equal, *different)


@dataclass(frozen=True, slots=True, order=True)
class Tie:
    """A right or denial of one enclave, or one group of enclaves, for all names of a bundle."""

    node: str
    right: str
    qualifier: Qualifier
    by: tuple[str, ...]
    parts: tuple[str, ...]
    mark: OverlaySide
    common: bool
    violates: bool = False
    differs: bool = False

    @property
    def sends(self) -> bool:
        """Whether the arrow points from the enclave to the names."""
        return SENDS[self.right]


def is_plain(tie: Tie) -> bool:
    """Return whether a tie is neither denied, nor different, nor against a requirement."""
    same = tie.mark is OverlaySide.BOTH and not tie.differs
    return tie.qualifier is ALLOW and same and not tie.violates


@dataclass(frozen=True, slots=True)
class Bundle:
    """Sorted names of the same kind and protection, with the same ties.

    In a ``partial`` bundle, each tie is for only some of the names.  ``asks`` are services whose
    requests change nothing.  ``lacks`` is the side that nobody may take.
    """

    kind: str
    protection: Protection
    names: tuple[str, ...]
    ties: tuple[Tie, ...]
    partial: bool = False
    asks: bool = False
    lacks: Lack = Lack.NOTHING


def fold(
    names: Iterable[Name],
    edges: Iterable[Edge],
    owner: Callable[[str], str] = str,
    *,
    apart: bool = False,
) -> tuple[Bundle, ...]:
    """Return the names that have an edge in bundles, sorted by kind and first name.

    ``owner`` maps an enclave to the node that represents it: itself, or its group.  With ``apart``,
    services whose requests change nothing have bundles of their own.
    """
    ties: dict[tuple[str, str], set[Tie]] = defaultdict(set)
    for edge in edges:
        ties[edge.kind, edge.name].add(
            Tie(
                owner(edge.enclave),
                edge.right,
                edge.qualifier,
                edge.by,
                edge.parts,
                edge.mark,
                edge.common,
                edge.violates,
                edge.differs,
            )
        )
    bundles: dict[tuple[str, Protection, frozenset[Tie], bool, Lack], list[str]]
    bundles = defaultdict(list)
    for name in names:
        if found := ties.get((name.kind, name.name)):
            asking = apart and asks(name)
            bundles[name.kind, name.protection, frozenset(found), asking, name.lacks].append(
                name.name
            )
    folded = (
        Bundle(
            kind,
            protection,
            tuple(sorted(members)),
            tuple(sorted(found, key=_order)),
            asks=asking,
            lacks=lacks,
        )
        for (kind, protection, found, asking, lacks), members in bundles.items()
    )
    return tuple(sorted(folded, key=lambda each: (_KINDS.index(each.kind), each.names)))


def coarsened(bundles: Iterable[Bundle]) -> tuple[Bundle, ...]:
    """Return bundles with the same senders joined; they do not show who receives which name.

    Denials and differences stay separate, because users look for them.
    """
    found: dict[tuple[object, ...], list[Bundle]] = defaultdict(list)
    for bundle in bundles:
        plain = all(map(is_plain, bundle.ties))
        senders = frozenset((tie.node, tie.right) for tie in bundle.ties if tie.sends)
        apart = None if plain and senders else bundle.ties
        found[bundle.kind, bundle.protection, senders, apart, bundle.lacks].append(bundle)
    return tuple(_joined(each) for each in found.values())


def _joined(bundles: Sequence[Bundle]) -> Bundle:
    ties = sorted({tie for bundle in bundles for tie in bundle.ties}, key=_order)
    names = sorted(name for bundle in bundles for name in bundle.names)
    partial = any(bundle.ties != bundles[0].ties for bundle in bundles)
    return replace(bundles[0], names=tuple(names), ties=tuple(ties), partial=partial, asks=False)


def _order(tie: Tie) -> tuple[object, ...]:
    right = RIGHT_ORDER[tie.right]
    marks = tie.mark, tie.common, tie.violates, tie.differs
    return right, tie.node, tie.qualifier, tie.by, tie.parts, *marks
