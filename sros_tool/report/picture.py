"""The picture of a robot's rights as plain values: the input of all output formats.

Everything is sorted and contains neither paths of the machine nor a time of creation, so the same
sources always give the same picture.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Annotated, NamedTuple

from sros_tool.names import only_reads
from sros_tool.policy.model import ALLOW, RIGHTS, Qualifier
from sros_tool.policy.rights import RIGHT_ORDER
from sros_tool.values import Words, shows
from sros_tool.wording import counted, first_few

SENDS = {"publish": True, "request": True, "call": True} | dict.fromkeys(
    ("subscribe", "reply", "execute"), False
)
"""Right → whether its holder sends, so that the arrow points to the name."""

_KINDS = (*RIGHTS, "dds")
"""Kinds of names in display order; ``dds`` is a topic without a ROS name."""


class OverlaySide(StrEnum):
    """The source of an overlay that has a right: the first, the second, or BOTH.

    In a picture without an overlay, every right has BOTH.
    """

    BOTH = "both"
    FIRST = "first"
    SECOND = "second"


class WireLevel(StrEnum):
    """Minimum protection of messages on the wire, from weakest to strongest."""

    UNKNOWN = "unknown"
    NONE = "none"
    SIGN = "sign"
    ENCRYPT = "encrypt"


@dataclass(frozen=True, slots=True)
class Protection:
    """Protection of a name by governance: the weakest protection among its DDS topics.

    ``data``, ``metadata`` and ``rtps`` are protection kinds of DDS-Security 1.1.  Without
    ``read_control``, every authenticated participant may read, whatever its permissions; without
    ``write_control``, every authenticated participant may write.  With ``strangers``, this also
    applies to participants without an identity.
    """

    level: WireLevel
    """The minimum protection of messages on the wire."""
    data: str = ""
    """Protection kind of the payload, or an empty string."""
    metadata: str = ""
    """Protection kind of submessages, or an empty string."""
    rtps: str = ""
    """Protection kind of RTPS messages, or an empty string."""
    read_control: bool = True
    """Whether permissions control who may read."""
    write_control: bool = True
    """Whether permissions control who may write."""
    strangers: bool = False
    """Whether participants without an identity may use the name."""

    @property
    def everybody(self) -> str:
        """Words for the participants that may use a name without a right because access is open."""
        return (
            "everybody, even without an identity"
            if self.strangers
            else "everybody with an identity"
        )

    def open_access_text(self, kind: str) -> str:
        """Return a clause on open access, such as "everybody may publish", or ""."""
        sends, receives = _VERBS[kind]
        sides = [sends] * (not self.write_control) + [receives] * (not self.read_control)
        even = ", even without an identity" if self.strangers else ""
        return f"everybody may {' and '.join(sides)}{even}" if sides else ""


UNKNOWN = Protection(WireLevel.UNKNOWN)
"""The protection without a known governance, such as for a policy without a keystore."""


@shows(
    *("enclave", "kind", "name", "right", "qualifier"),
    *("by", "parts", "mark", "common", "violates", "direction"),
)
@dataclass(frozen=True, slots=True, order=True)
class Edge:
    """A right or denial of one enclave for one name, drawn as an arrow.

    ``by`` are the wildcards that match the name; empty if the right has the exact name.  ``parts``
    are the parts of an action, such as feedback, if the right is not for the whole action.
    ``common`` says that every node needs the right to start, ``violates`` that the right breaks a
    requirement, ``differs`` that similar robots, namespaces or enclaves lack the right.
    """

    enclave: str
    """Path of the enclave."""
    kind: str
    """Kind of the name, such as ``topics``."""
    name: str
    """The absolute ROS name, or the wildcard."""
    right: str
    """The right, such as ``publish``."""
    qualifier: Qualifier
    """Whether the rule allows or denies the right."""
    by: tuple[str, ...] = ()
    """Wildcards that give the right; empty if the rule has the exact name."""
    parts: tuple[str, ...] = ()
    """Parts of the action that the right covers; empty for the whole action."""
    mark: OverlaySide = OverlaySide.BOTH
    """The side of the comparison that has the right."""
    common: bool = False
    """Whether every node needs the right to start."""
    violates: bool = False
    """Whether the right breaks a requirement."""
    differs: bool = False

    @property
    def sends(self) -> bool:
        """Whether the enclave sends to the name."""
        return SENDS[self.right]

    @property
    def direction(self) -> Annotated[str, Words(("to the name", "from the name"))]:
        """Direction of the arrow."""
        return "to the name" if self.sends else "from the name"


class Lack(StrEnum):
    """The side of a name, senders or receivers, on which no enclave is allowed."""

    NOTHING = ""
    SENDER = "sender"
    RECEIVER = "receiver"


class Spelling(StrEnum):
    """How a policy writes a name; relative names move with the namespace of their node."""

    UNKNOWN = ""
    ABSOLUTE = "absolute"
    RELATIVE = "relative"
    BOTH = "relative for some nodes"


@shows("kind", "name", "namespace", "protection", "wildcard", "lacks")
@dataclass(frozen=True, slots=True)
class Name:
    """A topic, service or action, or a ``wildcard`` that is drawn as a name.

    ``lacks`` is the side (senders or receivers) without an allowed enclave. The server of a service
    is its receiver. ``spelling`` is known in the picture of one policy.
    """

    kind: str
    """Kind of the name: topics, services, actions, or ``dds``."""
    name: str
    """The absolute name."""
    namespace: str
    """Namespace of the name."""
    protection: Protection
    """Protection of the name by the governance."""
    wildcard: bool = False
    """Whether the name is a wildcard. A wildcard is drawn as arrows to the known names that it
    matches, and as a name of its own only if there is no such arrow.
    """
    lacks: Lack = Lack.NOTHING
    """The side (senders or receivers) on which no enclave has a right to the name; empty if no
    side is missing. The server of a service is its receiver.
    """
    spelling: Spelling = Spelling.UNKNOWN


_VERBS = {
    "topics": ("publish", "subscribe"),
    "dds": ("publish", "subscribe"),
    "services": ("call", "serve"),
    "actions": ("call", "execute"),
}


def lack_text(kind: str, lacks: Lack) -> str:
    """Return a clause on the use that no enclave is allowed, such as ``nobody may publish``."""
    sends, receives = _VERBS[kind]
    return f"nobody may {sends if lacks is Lack.SENDER else receives}"


def is_question(name: Name | Edge) -> bool:
    """Return whether a name is a service whose requests change nothing (`QUESTIONS` of reach)."""
    return name.kind == "services" and only_reads(name.name)


class Statement(NamedTuple):
    """A right as written in the source, with the number of known names that it matches."""

    qualifier: Qualifier
    """Whether the rule allows or denies the right."""
    right: str
    """The right, such as ``publish``."""
    kind: str
    """Kind of the name, such as ``topics``."""
    name: str
    """The absolute ROS name, perhaps with wildcards."""
    reaches: int
    """Number of known names that the right matches."""
    mark: OverlaySide = OverlaySide.BOTH
    """The side of the comparison that has the right."""


@shows(
    *("path", "group", "nodes", "statements", "subject", "issuer", "serial", "key"),
    *("problems", "observed"),
)
@dataclass(frozen=True, slots=True)
class PicturedEnclave:
    """An enclave in a picture; ``group`` is its host or its namespace.

    ``subject``, ``issuer``, ``serial`` and ``key`` describe the certificate; "" without a
    certificate. ``problems`` keep a process from using the enclave. In a picture of used rights,
    the rights of an enclave that was not ``observed`` count as neither used nor unused. ``note`` is
    text on the card.
    """

    path: str
    """Path of the enclave."""
    group: str
    """Host of the enclave, or its namespace if the host is not known."""
    nodes: tuple[str, ...] = ()
    """Names of the enclave's nodes."""
    statements: tuple[Statement, ...] = ()
    """Rights of the enclave, as written in the source."""
    subject: str = ""
    """Subject name of the enclave's certificate, or an empty string."""
    issuer: str = ""
    """Issuer name of the certificate, or an empty string."""
    serial: str = ""
    """Serial number of the certificate in hexadecimal, or an empty string."""
    key: str = ""
    """Kind of the certificate's key, or an empty string."""
    problems: tuple[str, ...] = ()
    """Faults that keep a process from using the enclave."""
    observed: bool = True
    """With ``--observed``: whether the enclave was observed, or may have been: the observation has
    nodes whose enclaves it does not show.
    """
    domains: str = ""
    """ROS domains of the enclave's rights, such as ``10`` or ``10,20``; empty for every domain."""
    note: str = ""


@dataclass(frozen=True, slots=True, order=True)
class Validity:
    """Validity period of a certificate, a CA, a permissions document, or a CRL.

    ``not_before`` and ``not_after`` are CCYY-MM-DDThh:mm:ssZ in UTC.
    """

    not_after: str
    """End of the validity, in UTC."""
    not_before: str
    """Start of the validity, in UTC."""
    kind: str
    """Kind of the document, such as ``permissions`` or ``revocation list``."""
    title: str
    """Title of the document."""
    enclave: str = ""
    """Path of the enclave, or an empty string for CAs and revocation lists."""


@dataclass(frozen=True, slots=True)
class PicturedFinding:
    """A finding of ``sros check``; ``severity`` is error, warning or note."""

    id: str
    """Identifier of the kind of finding."""
    severity: Annotated[str, Words(("error", "warning", "note"))]
    """Severity: error, warning or note."""
    text: str
    """Text of the finding."""
    remedy: str = ""
    """What to do about the finding."""
    enclave: str = ""
    """Path of the enclave, or another subject of the finding."""


class SourceTitle(NamedTuple):
    """Title of a source in the picture: its file name, and its kind."""

    title: str
    """File name of the source; with folders only if two sources have the same file name."""
    kind: str
    """Kind of the source, such as ``policy``."""


class Overlay(NamedTuple):
    """The kind of an overlay of two sources.

    ``kind`` is use (allowed and observed), change (before and after), drift (policy and keystore)
    or worlds (rights and Zenoh rules); ``first`` and ``second`` label a right that only the
    first or second side has.
    """

    kind: Annotated[str, Words(("use", "change", "drift", "worlds"))]
    """What is compared: ``use``: rights with observed rights; ``change``: an earlier with a later
    policy; ``drift``: a policy with a keystore; ``worlds``: rights with Zenoh rules."""
    first: str
    """Label of rights that only the first source has."""
    second: str
    """Label of rights that only the second source has."""


class OverlayDifference(NamedTuple):
    """A right that only one side has, with ``notes``.

    In an overlay of the kind change, the notes are the wildcards of the other side that cover the
    right.  In the kind use, a note is the number of names that a wildcard matches and that were
    never observed.
    """

    mark: OverlaySide
    """The side that has the right."""
    text: str
    """The right, as text."""
    notes: tuple[str, ...] = ()
    """Notes on the right."""


@dataclass(frozen=True, slots=True)
class Influence:
    """An enclave that influences an enclave or a name, or that an enclave influences.

    An influence goes over names: an enclave sends to a name, and another enclave receives from it.
    """

    enclave: str
    """Path of the enclave."""
    hops: int
    """Number of hops: the names on the path."""
    path: str
    """A shortest path."""


@dataclass(frozen=True, slots=True)
class Focus:
    """The answer to a question about a name or an enclave.

    The answer holds for all names that rights allow, even for names that the picture does not have.
    """

    kind: Annotated[str, Words((*_KINDS, "enclave"))]
    """Kind of the name, or ``enclave``."""
    name: str
    """The name, or the path of the enclave."""
    sentence: str
    """The answer in one sentence."""
    senders: tuple[str, ...]
    """Enclaves that may publish, call or write to the name."""
    receivers: tuple[str, ...]
    """Enclaves that may subscribe to, serve, execute or read the name."""
    influencing: tuple[Influence, ...]
    """Enclaves that influence a sender of the name, or that influence the enclave in the focus.
    The sender, or the enclave in the focus, counts as hop 1, so `hops` is 2 for a direct influence.
    """
    influenced: tuple[Influence, ...] = ()
    """Enclaves that the enclave in the focus influences; `hops` is 1 if it does so directly."""


class PicturedUse(NamedTuple):
    """A use of a name that breaks a requirement; ``by`` is the wildcard that allows it, or ""."""

    enclave: str
    """Path of the enclave."""
    right: str
    """The right of the enclave, such as ``publish``."""
    kind: str
    """Kind of the name, such as ``topics``."""
    name: str
    """The absolute ROS name."""
    by: str = ""
    """The wildcard that allows the use, or an empty string."""


class PicturedViolation(NamedTuple):
    """A requirement that does not hold, with the uses of names that break it."""

    text: str
    """The violation, and the demand of the requirement."""
    short: str
    """The violation in short, such as `/teleop may publish /cmd_vel`."""
    uses: tuple[PicturedUse, ...]
    """Uses of names that break the requirement."""


_MOST_IN_HEADLINES = 5  # violations, and differing units, in the headlines; JSON has all
_MOST_SHOWN = 2  # rights of one unit in the headlines


class Requirements(NamedTuple):
    """The results of requirements: the number that hold, and the violations.

    ``assumed`` are the requirements that hold only under an assumption, in words.
    """

    hold: int
    """Number of requirements that hold."""
    violations: tuple[PicturedViolation, ...] = ()
    """Requirements that do not hold."""
    assumed: tuple[str, ...] = ()
    """Requirements that hold only under an assumption, in words."""

    def sentences(self) -> tuple[str, ...]:
        """Return the results as sentences without a full stop."""
        holds = f"{counted(self.hold, 'requirement')} hold{'s' if self.hold == 1 else ''}"
        if self.assumed:
            holds += f", {len(self.assumed)} of them under an assumption: {self.assumed[0]}"
        if not self.violations:
            return (holds,)
        number = len(self.violations)
        more = (
            (f"also violated: {number - _MOST_IN_HEADLINES} more",)
            if number > _MOST_IN_HEADLINES
            else ()
        )
        violated = (
            f"Violated: {violation.text}" for violation in self.violations[:_MOST_IN_HEADLINES]
        )
        return (*violated, *more, *((holds,) if self.hold else ()))


class EqualUnits(NamedTuple):
    """Robots, namespaces or enclaves (``what``) that are equal except for their names.

    ``label`` stands for these units in drawn paths and names, like ``{r01…r50}``.
    """

    label: str
    """Label drawn for the units, such as ``{r01…r50}``."""
    what: Annotated[str, Words(("robot", "namespace", "enclave"))]
    """Kind of the units: robot, namespace or enclave."""
    members: tuple[str, ...]
    """Names of the units."""
    domains: str = ""
    """ROS domains of the units; empty if all units in the picture have the same domains."""

    @property
    def title(self) -> str:
        """The units in words, such as ``r01 … r50: 50 equal robots``."""
        first, last = self.members[0], self.members[-1]
        where = f" in domain {self.domains}" if self.domains else ""
        return f"{first} … {last}: {len(self.members)} equal {self.what}s{where}"


class UnreadUnits(NamedTuple):
    """Units of a large keystore whose permissions were compared as text, but not parsed.

    The text equals the text of the unit ``like``, except for the names. ``what`` is "robot",
    "namespace" or "enclave"; ``enclaves`` is the number of enclaves of the ``members``.
    """

    what: str
    members: tuple[str, ...]
    enclaves: int
    like: str


class DifferentUnit(NamedTuple):
    """A unit that differs slightly from several equal units, whose label is ``usual``.

    ``unit`` may be the label of several units.  ``more`` and ``fewer`` are, in words, the enclaves
    and rights that only this unit has, and that this unit lacks.
    """

    unit: str
    """Name of the unit, or a label in ``equal``."""
    usual: str
    """Label of the equal units from which this unit differs."""
    more: tuple[str, ...]
    """Enclaves and rights that only this unit has."""
    fewer: tuple[str, ...]
    """Enclaves and rights that this unit lacks."""

    def sentence(self) -> str:
        """Return the difference as a sentence without a full stop."""
        parts = []
        for has, rights in (("it has", self.more), ("it lacks", self.fewer)):
            parts += [f"{has} {first_few(rights, _MOST_SHOWN, '; ')}"] if rights else []
        usual = self.usual.strip("{}").replace("…", " … ")
        return f"{self.unit.strip('{}')} differs from {usual}: {', and '.join(parts)}"


@shows(
    *("title", "origins", "enclaves", "names", "edges", "overlay", "differences", "validities"),
    *("findings", "focus", "requirements", "equal", "different", "exports"),
    "revoked",
)
@dataclass(frozen=True, slots=True)
class Picture:
    """The rights in a system, with protection, validity and findings.

    With a ``focus``, the picture has only the names and enclaves that lead to the focus or from the
    focus. The picture lacks the enclaves of the units in ``unread``.
    """

    title: str
    """Title of the picture."""
    origins: tuple[SourceTitle, ...]
    """The sources of the picture."""
    enclaves: tuple[PicturedEnclave, ...]
    """The enclaves in the picture."""
    names: tuple[Name, ...]
    """Topics, services and actions in the picture."""
    edges: tuple[Edge, ...]
    """Rights and denials, one entry for each enclave, name and right."""
    overlay: Overlay | None = None
    """The comparison; null for a single source."""
    differences: tuple[OverlayDifference, ...] = ()
    """Rights that only one source has."""
    validities: tuple[Validity, ...] = ()
    """Validity of certificates, CAs, permissions documents and revocation lists."""
    findings: tuple[PicturedFinding, ...] = ()
    """Findings of ``sros check``."""
    focus: tuple[Focus, ...] = ()
    """With ``--focus``: an answer for each chosen name and enclave."""
    requirements: Requirements | None = None
    """With ``--requirements``: the requirements that hold, and those that do not; else
    null.
    """
    equal: tuple[EqualUnits, ...] = ()
    """Robots, namespaces or enclaves that are equal except for their names, drawn once."""
    different: tuple[DifferentUnit, ...] = ()
    """Units that differ only slightly from the units of a label in ``equal``."""
    exports: tuple[str, ...] = ()
    """The sources that are exports, which may lack enclaves of their keystore."""
    revoked: tuple[str, ...] = ()
    """Revoked enclaves that a keystore no longer has; they are not drawn."""
    unread: tuple[UnreadUnits, ...] = ()
    join_needs_right: bool = False
    """Whether an enclave can join only the ROS domains in which it has a right."""
    has_least_levels: bool = False
    """Whether levels of protection are the least levels that a policy demands."""

    @property
    def headlines(self) -> tuple[str, ...]:
        """The answers of the picture and its `notes`, as sentences without a full stop."""
        return (*self.answers, *self.notes)

    @property
    def answers(self) -> tuple[str, ...]:
        """The answers of the picture, and its omissions, as sentences without a full stop."""
        requirements = self.requirements.sentences() if self.requirements else ()
        return (*requirements, *self.other_answers)

    @property
    def other_answers(self) -> tuple[str, ...]:
        """All answers except answers about requirements."""
        focus = (focus.sentence for focus in self.focus)
        exports = map(_sentence_on_export, self.exports)
        return (*focus, *exports, *self._unread_sentences())

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences without a full stop: on units drawn once or that differ, and revocations."""
        equal = (f"{units.title} are drawn as one" for units in self.equal)
        more = len(self.different) - _MOST_IN_HEADLINES
        different = [unit.sentence() for unit in self.different[:_MOST_IN_HEADLINES]]
        different += [f"also different: {more} more"] if more > 0 else []
        revoked = [self.revoked_sentence] if self.revoked else []
        return (*equal, *different, *revoked)

    @property
    def revoked_sentence(self) -> str:
        """A sentence without a full stop on revoked enclaves; "" if there are none."""
        names = first_few(self.revoked, _MOST_IN_HEADLINES)
        return f"revoked, and therefore not drawn: {names}" if self.revoked else ""

    def _unread_sentences(self) -> Iterator[str]:
        if not self.unread:
            return
        members = [member for units in self.unread for member in units.members]
        number, enclaves = len(members), sum(units.enclaves for units in self.unread)
        likes = first_few([units.like for units in self.unread], _MOST_SHOWN)
        yield (
            f"{counted(number, self.unread[0].what)} with {counted(enclaves, 'enclave')} "
            f"({first_few(members, _MOST_IN_HEADLINES)}) {'was' if number == 1 else 'were'} only "
            "compared: their permissions "
            f"have the same text as the permissions of {likes}, except for names. This picture "
            "lacks their signatures, certificates, expiry and findings, and the rights of other "
            "enclaves to their names: --robot NAME reads one, `sros check` checks all"
        )


def _sentence_on_export(title: str) -> str:
    return (
        f"'{title}' is an export, which may lack enclaves: statements about one, all or no "
        "enclave are about the enclaves in this export. Draw the keystore that it comes from to "
        "see all"
    )


@dataclass(frozen=True, slots=True, order=True)
class Tie:
    """A right or denial of an enclave, or of a group of enclaves, for all names of a bundle.

    ``node`` is the path of the enclave, or ":" and the group; the other fields are as in `Edge`.
    """

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
    """Return whether a right is allowed, not marked as different, and breaks no requirement."""
    same = tie.mark is OverlaySide.BOTH and not tie.differs
    return tie.qualifier is ALLOW and same and not tie.violates


@dataclass(frozen=True, slots=True)
class Bundle:
    """Sorted names of the same kind and protection, with the same ties.

    In a ``partial`` bundle, every tie is for only some of the names. ``asks`` says that the names
    are services whose requests change nothing. ``lacks`` is the side (senders or receivers) without
    an allowed enclave.
    """

    kind: str
    protection: Protection
    names: tuple[str, ...]
    ties: tuple[Tie, ...]
    partial: bool = False
    asks: bool = False
    lacks: Lack = Lack.NOTHING


def bundled_names(
    names: Iterable[Name],
    edges: Iterable[Edge],
    owner: Callable[[str], str] = str,
    *,
    separate_questions: bool = False,
) -> tuple[Bundle, ...]:
    """Return bundles of names that have the same rights, sorted by kind and first name.

    Args:
        names: the names.
        edges: the rights and denials for the names.
        owner: returns the node that stands for an enclave: the enclave, or its group.
        separate_questions: put services whose requests change nothing into separate bundles.
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
        if name_ties := ties.get((name.kind, name.name)):
            asking = separate_questions and is_question(name)
            bundles[name.kind, name.protection, frozenset(name_ties), asking, name.lacks].append(
                name.name
            )
    folded = (
        Bundle(
            kind,
            protection,
            tuple(sorted(members)),
            tuple(sorted(bundle_ties, key=_tie_order)),
            asks=asking,
            lacks=lacks,
        )
        for (kind, protection, bundle_ties, asking, lacks), members in bundles.items()
    )
    return tuple(sorted(folded, key=lambda bundle: (_KINDS.index(bundle.kind), bundle.names)))


def joined_by_senders(bundles: Iterable[Bundle]) -> tuple[Bundle, ...]:
    """Return bundles, merged if they have the same senders, even with other receivers.

    Denials and differences stay separate, because users look for them.
    """
    by_senders: dict[tuple[object, ...], list[Bundle]] = defaultdict(list)
    for bundle in bundles:
        plain = all(map(is_plain, bundle.ties))
        senders = frozenset((tie.node, tie.right) for tie in bundle.ties if tie.sends)
        apart = None if plain and senders else bundle.ties
        by_senders[bundle.kind, bundle.protection, senders, apart, bundle.lacks].append(bundle)
    return tuple(_joined_bundles(bundles) for bundles in by_senders.values())


def _joined_bundles(bundles: Sequence[Bundle]) -> Bundle:
    ties = sorted({tie for bundle in bundles for tie in bundle.ties}, key=_tie_order)
    names = sorted(name for bundle in bundles for name in bundle.names)
    partial = any(bundle.ties != bundles[0].ties for bundle in bundles)
    return replace(bundles[0], names=tuple(names), ties=tuple(ties), partial=partial, asks=False)


def _tie_order(tie: Tie) -> tuple[object, ...]:
    right = RIGHT_ORDER[tie.right]
    marks = tie.mark, tie.common, tie.violates, tie.differs
    return right, tie.node, tie.qualifier, tie.by, tie.parts, *marks
