"""Merge policies into a policy file: find the missing rights, and the edits that add them.

A merge never weakens a denial, and adds a right only in the requested direction.  All other text of
the file, including comments and line ends, stays unchanged byte for byte.

A name is added to a group with exactly the name's rights, in the profile of the name's namespace
and node.  A missing group or profile is added; included files do not change. The result is read
again, to prove that the file then states exactly the old and the added rights.
"""

from __future__ import annotations

import codecs
import re
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import groupby
from pathlib import Path
from shlex import quote
from typing import NamedTuple

from lxml import etree

from sros_tool.errors import DocumentError, Note, PolicyError
from sros_tool.names import GLOBAL_TOPICS, check_namespace, expand, is_expression, only_reads
from sros_tool.policy.document import instruction_text, read_policy
from sros_tool.policy.model import (
    ALLOW,
    DENY,
    RIGHTS,
    Enclave,
    Level,
    Policy,
    Profile,
    Qualifier,
    nodes_in_several_enclaves,
    nodes_in_several_namespaces,
    stated_protections,
)
from sros_tool.policy.rights import (
    RIGHT_ORDER,
    GroupRights,
    Right,
    Rules,
    compare,
    group_rights,
    is_of_every_node,
    join_actions,
    lost_counterparts_text,
    order,
    parts,
    policy_rights,
    profile_rights,
    rights_without_counterpart,
    split_actions,
)
from sros_tool.values import DryRun, FileChanges, Notes, shows
from sros_tool.wording import first_few
from sros_tool.xml import parse, read_bytes, tag_of

_MOST_SHOWN = 3


@dataclass(frozen=True, slots=True)
class Contradiction:
    """A right that the policy file allows and a merged policy denies, or the reverse.

    Other cases are a merged policy that allows the right to a node, and denies the right to another
    node of the same enclave, and a right that its own policy denies only since names moved (by
    --remap, for example).  The denial may concern only a part of the right.  The denial always
    decides.
    """

    denied: Right
    """The rule that denies the right."""
    allowed: Right
    """The rule that allows the right."""
    new: bool
    """Whether the merge adds the denial to the policy file, which did not have it before."""


@dataclass(frozen=True, slots=True)
class AddedName:
    """A name to add to a profile, in the form for the profile, with rights and protection level."""

    kind: str
    name: str
    rights: GroupRights
    protect: Level | None = None


@dataclass(frozen=True, slots=True)
class ProfileKey:
    """The enclave, namespace and node that identify a profile."""

    enclave: str
    ns: str
    node: str


@dataclass(frozen=True, slots=True)
class MergePlan:
    """The plan of a merge: names to add to each profile, the added rights, and contradictions."""

    entries: dict[ProfileKey, tuple[AddedName, ...]]
    added: tuple[Right, ...]
    contradictions: tuple[Contradiction, ...]


def plan_merge(before: Policy, additions: Policy, undenied: Collection[Right] = ()) -> MergePlan:
    """Return the plan for adding the rights of ``additions`` that ``before`` lacks.

    Left out are rights that any profile or wildcard of the enclave already allows, and rights that
    the enclave completely denies.  A denial of ``additions`` itself contradicts the rights in
    ``undenied``: it denied them only since names moved.
    """
    return _Planner(before, additions, undenied).plan()


class _Planner:
    def __init__(self, before: Policy, additions: Policy, undenied: Collection[Right]) -> None:
        self._additions = additions
        self._undenied = frozenset(undenied)
        self._file = Rules(policy_rights(before))
        self._asked = Rules(policy_rights(additions))
        self._wanted: dict[Right, bool] = {}
        self._contradictions: list[Contradiction] = []

    def plan(self) -> MergePlan:
        names: dict[ProfileKey, dict[tuple[str, str], _NewName]] = {}
        for enclave in self._additions.enclaves:
            for profile in enclave.all_profiles():
                place = ProfileKey(enclave.path, profile.ns, profile.node)
                here = names.setdefault(place, {})
                for group in profile.groups:
                    for name in group.names:
                        fqn = expand(name, profile.ns, profile.node)
                        for right, qualifier in group.rights:
                            if self._is_wanted(Right(enclave.path, qualifier, right, fqn)):
                                entry = here.setdefault((group.kind, fqn), _NewName(name, {}))
                                entry.protect = entry.protect or group.protect
                                entry.rights[right, qualifier] = None
            self._contradictions += self._contradictions_between_nodes(enclave)
        entries = {
            place: tuple(sorted(_entries(place_names), key=_entry_order))
            for place, place_names in sorted(
                names.items(), key=lambda item: _profile_order(item[0])
            )
            if place_names
        }
        added = [right for right, wanted in self._wanted.items() if wanted]
        contradictions = tuple(dict.fromkeys(self._contradictions))
        return MergePlan(entries, tuple(sorted(added, key=order)), contradictions)

    def _is_wanted(self, right: Right) -> bool:
        known = self._wanted.get(right)
        if known is None:
            known = self._wanted[right] = self._decide(right)
        return known

    def _decide(self, right: Right) -> bool:
        if right.qualifier is DENY:
            if self._file.cover(right):
                return False
            for allowed in join_actions(self._file.overlapping(right._replace(qualifier=ALLOW))):
                self._contradictions.append(Contradiction(right, allowed, True))
            return True
        denial = right._replace(qualifier=DENY)
        for denied in join_actions(self._file.overlapping(denial)):
            # A denial that both policies state is no contradiction.
            if not self._asked.cover(denied):
                self._contradictions.append(Contradiction(denied, right, False))
        if right in self._undenied:
            for denied in join_actions(_denials_of_a_part(self._asked, right)):
                is_new = not self._file.cover(denied)
                self._contradictions.append(Contradiction(denied, right, is_new))
        return not (self._file.cover(right) or self._file.cover(denial))

    def _contradictions_between_nodes(self, enclave: Enclave) -> Iterator[Contradiction]:
        """Yield contradictions between nodes of an enclave, because a denial applies to all nodes.

        There is no contradiction if every node with the right states the same denial, as an
        exception from its own right.
        """
        of_nodes = defaultdict[tuple[str, str], set[Right]](set)
        for profile in enclave.all_profiles():
            of_nodes[profile.ns, profile.node].update(profile_rights(enclave.path, profile))
        stated = frozenset[Right]().union(*of_nodes.values())
        denials = sorted(right for right in stated if right.qualifier is DENY)
        if not denials:
            return
        stating = defaultdict[Right, list[Rules]](list)
        for rights in of_nodes.values():
            rules = Rules(rights)
            for part in split_actions(rights):
                stating[part].append(rules)
        for denied in denials:
            overridden = {
                allowed
                for allowed in self._asked.overlapping(denied._replace(qualifier=ALLOW))
                if not all(rules.cover(denied) for rules in stating[allowed])
            }
            for allowed in join_actions(overridden):
                yield Contradiction(denied, allowed, self._is_wanted(denied))


def _denials_of_a_part(rules: Rules, right: Right) -> Iterator[Right]:
    """Yield the denials that deny an ALLOW, or one of the parts of an action, for all its names."""
    for part in parts(right):
        yield from rules.covering_rights(part._replace(qualifier=DENY))


def undenied_rights(policy: Policy, move: Callable[[Policy], Policy]) -> frozenset[Right]:
    """Return the ALLOW rights that ``policy`` does not itself deny, with the names after ``move``.

    If ``policy`` denies nothing, the result is empty.  For a right with wildcards, ``move`` may add
    new names; these are left out.
    """
    stated = policy_rights(policy)
    if not any(right.qualifier is DENY for right in stated):
        return frozenset()
    rules = Rules(stated)
    rights = set[Right]()
    for with_wildcards in (False, True):

        def of_profile(enclave: str, profile: Profile, wildcards: bool) -> Profile:
            groups = (
                replace(group, rights=((right, qualifier),), names=(name,), lines=())
                for group in profile.groups
                for right, qualifier in group.rights
                if qualifier is ALLOW
                for name in group.names
                if (full := expand(name, profile.ns, profile.node))
                and is_expression(full) is wildcards
                and not any(_denials_of_a_part(rules, Right(enclave, ALLOW, right, full)))
            )
            return replace(profile, groups=tuple(groups))

        enclaves = (
            enclave.with_profiles(partial(of_profile, enclave.path, wildcards=with_wildcards))
            for enclave in policy.enclaves
        )
        moved = policy_rights(move(replace(policy, enclaves=tuple(enclaves))))
        rights |= {e for e in moved if is_expression(e.name) is with_wildcards}
    return frozenset(rights)


@dataclass(slots=True)
class _NewName:
    """A name to add, in the form of its first occurrence, with rights and protection level."""

    written: str
    rights: dict[tuple[str, Qualifier], None]
    protect: Level | None = None


def _entries(names: dict[tuple[str, str], _NewName]) -> Iterable[AddedName]:
    for (kind, _), name in names.items():
        for qualifiers in group_rights(name.rights):
            yield AddedName(kind, name.written, qualifiers, name.protect)


def _profile_order(key: ProfileKey) -> tuple[str, str, str]:
    return key.enclave, key.ns, key.node


def _entry_order(entry: AddedName) -> tuple[int, GroupRights, str]:
    return RIGHT_ORDER[entry.rights[0][0]], entry.rights, entry.name


# ── notes ──────────────────────────────────────────────────────────────────────────────────


def merge_notes(contradictions: Sequence[Contradiction]) -> tuple[Note, ...]:
    """Return a note for each denial that overrides a right: one that is added, or that stays."""
    by_denial: dict[tuple[Right, bool], list[Right]] = {}
    for contradiction in contradictions:
        by_denial.setdefault((contradiction.denied, contradiction.new), []).append(
            contradiction.allowed
        )
    notes = []
    for (denied, new), allowed in by_denial.items():
        shown = [right.describe() for right in dict.fromkeys(sorted(allowed, key=order))]
        shown_text = first_few(shown, _MOST_SHOWN)
        if new:
            text = f"{denied} was added, and overrides rights of the enclave: {shown_text}."
            notes.append(Note("merge.newly-denied", text))
        else:
            text = f"{denied} stays, and overrides requested rights: {shown_text}."
            notes.append(Note("merge.still-denied", text))
    return tuple(notes)


def counterpart_notes(
    before: Policy, additions: Iterable[Policy], merged: Collection[Right]
) -> Iterator[Note]:
    """Yield notes on ``merged`` rights whose counterpart ``before`` or ``additions`` have.

    The counterpart of a right to subscribe is a right to publish, for instance.  It is gone because
    of a DENY of another policy, or because ``additions`` are merged under other names.
    """
    gone, missing = (
        {
            right
            for rights in map(policy_rights, policies)
            for right in rights_without_counterpart(rights, merged, compare(rights, merged))
        }
        for policies in ((before,), additions)
    )
    if gone:
        yield Note("merge.no-counterpart", lost_counterparts_text(gone))
    if missing := missing - gone:
        text = (
            f"{lost_counterparts_text(missing, 'in the result of this merge')} If a --remap moved "
            "the name, nodes that are to use the new name need the same remapping."
        )
        yield Note("merge.no-counterpart", text)


def kept_rights_notes(
    before: Policy, additions: Iterable[Policy], added: Collection[Right]
) -> Iterator[Note]:
    """Yield a note on rights that nodes keep in ``before``, although ``additions`` lack them.

    Another version of the nodes had these rights, or other nodes with the same names.  Only nodes
    count that get a right, and that already have one of the rights of ``additions``.  A policy with
    only missing rights, as `sros explain --log` prints it, is thus no reason for a note.
    """
    requested = defaultdict[tuple[str, str], set[Right]](set)
    source: dict[tuple[str, str], Policy] = {}
    for addition in additions:
        for enclave in addition.enclaves:
            for node, rights in _rights_of_nodes(enclave).items():
                requested[enclave.path, node] |= rights
                source.setdefault((enclave.path, node), addition)
    is_added, kept, remedies = {*added}, set[Right](), list[str]()
    for enclave in before.enclaves:
        for node, rights in _rights_of_nodes(enclave).items():
            asked = requested.get((enclave.path, node), set())
            own = {right for right in rights if not _is_of_any_node(right)}
            if asked.isdisjoint(is_added) or asked.isdisjoint(own):
                continue
            asked_rules = Rules(asked)
            if keeps := {right for right in own if not asked_rules.overlaps(right)}:
                kept |= keeps
                remedies.append(_apart(source[enclave.path, node], enclave.path, node))
    if kept:
        shown = (f"{right.enclave} {right.describe()}" for right in sorted(kept, key=order))
        text = (
            f"rights stay that the merged policy does not give: {first_few([*shown], _MOST_SHOWN)}."
            " If they are of a later version of the program, keep them. If they are of an earlier "
            "version that no longer runs, take them out, or merge into the policy without this "
            "package. If they are of another program with this node name, merge with another "
            f"--namespace, or with {remedies[0]}."
        )
        yield Note("merge.kept-rights", text)


_MARKUP = re.compile(
    r"<!--.*?-->|<\?.*?\?>|<!\[CDATA\[.*?\]\]>"
    r"|</(?P<close>[^ \t\r\n>]+)[ \t\r\n]*>"
    r"|<(?P<open>[^ \t\r\n/>!?]+)(?:[^>\"']|\"[^\"]*\"|'[^']*')*?(?P<empty>/?)>",
    re.DOTALL,
)
_COMMENTS_OF_THE_LINE = re.compile(r"(?>[ \t]*<!--.*?-->)++(?=[ \t]*(?:\r?\n|\Z))", re.DOTALL)


@dataclass(slots=True)
class PlacedElement:
    """An XML element with its offsets in the text, in characters from the start of the document.

    ``inner`` is the start of the element's content, ``close`` the start of its end tag.  In an
    element without an end tag (``<a/>``), both are equal to ``end``.
    """

    xml: etree._Element
    start: int
    inner: int
    close: int = 0
    end: int = 0
    children: list[PlacedElement] = field(default_factory=list)

    @property
    def tag(self) -> str:
        """The tag, with a namespace in braces."""
        return tag_of(self.xml)

    def get(self, attribute: str) -> str:
        """Return the value of an attribute, or ""."""
        return self.xml.get(attribute, "")

    def named(self, tag: str) -> Iterator[PlacedElement]:
        """Yield the child elements with this tag, except those from includes."""
        return (child for child in self.children if child.tag == tag)


class EditedText:
    """The text of a policy file with collected edits, which `document` applies."""

    def __init__(self, data: bytes, name: str) -> None:
        self._name = name
        root = parse(data, name)
        self._encoding = _encoding(data, root)
        try:
            self.text = data.decode(self._encoding)
            faithful = self.text.encode(self._encoding) == data
        except (UnicodeError, LookupError):
            faithful = False
        if not faithful:
            raise self._unsuitable_encoding_error()
        self.root = self._elements(root)
        self.newline = "\r\n" if "\r\n" in self.text else "\n"
        self.indentation = self._one_indentation()
        self._edits: list[tuple[int, int, str]] = []

    def _unsuitable_encoding_error(self) -> PolicyError:
        return PolicyError(
            f"{self._name} cannot be edited in place",
            f"Its encoding {self._encoding} cannot be kept exactly.",
            "Save it as UTF-8.",
        )

    def _elements(self, root: etree._Element) -> PlacedElement:
        """Return the tree of elements with their positions, which lxml does not know.

        Raises:
            PolicyError: lxml reads other elements, because it decodes the document differently.
        """
        nodes = root.iter()
        top: PlacedElement | None = None
        stack: list[PlacedElement] = []
        for mark in _MARKUP.finditer(self.text):
            if mark["close"]:
                stack[-1].close, stack[-1].end = mark.start(), mark.end()
                stack.pop()
            elif mark["open"]:
                node = next(nodes, None)
                if node is None or etree.QName(node).localname != mark["open"].split(":")[-1]:
                    raise self._unsuitable_encoding_error()
                end = mark.end()
                element = PlacedElement(node, mark.start(), end, end, end)
                if stack:
                    stack[-1].children.append(element)
                top = top or element
                if not mark["empty"]:
                    stack.append(element)
        if top is None or stack or next(nodes, None) is not None:
            raise self._unsuitable_encoding_error()
        return top

    # ── layout of the text ────────────────────────────────────────────────────────────────

    def indent_of(self, element: PlacedElement) -> str | None:
        """Return the indent of an element; None if the element does not begin its line."""
        line = max(self.text.rfind("\n", 0, element.start), self.text.rfind("\r", 0, element.start))
        before = self.text[line + 1 : element.start].removeprefix("\ufeff")
        if before.strip(" \t") or (line < 0 and element is not self.root):
            return None
        return before

    def _one_indentation(self) -> str:
        """Return the white space of one indentation level."""
        stack = [self.root]
        while stack:
            parent = stack.pop()
            outer = self.indent_of(parent)
            for child in parent.children[:1]:
                inner = self.indent_of(child)
                if outer is not None and inner is not None and inner.startswith(outer):
                    return inner[len(outer) :]
            stack += parent.children[:1]
        return "  "

    def position_after(self, element: PlacedElement) -> int:
        """Return the position after an element and after comments that follow on its last line."""
        comments = _COMMENTS_OF_THE_LINE.match(self.text, element.end)
        if comments and self.indent_of(element) is not None:
            return comments.end()
        return element.end

    # ── edits ───────────────────────────────────────────────────────────────────────────

    def insert(self, place: int, text: str, until: int | None = None) -> None:
        """Insert ``text`` at the offset ``place``; with ``until``, replace the text up to it."""
        self._edits.append((place, place if until is None else until, text))

    def document(self) -> bytes:
        """Return the document with all edits applied."""
        pieces, done = [], 0
        for start, end, text in sorted(self._edits, key=lambda edit: edit[0]):
            pieces += [self.text[done:start], text]
            done = end
        return "".join((*pieces, self.text[done:])).encode(self._encoding)


def _encoding(data: bytes, root: etree._Element) -> str:
    """Return an encoding that decodes a document with its byte order mark as a character."""
    declared = root.getroottree().docinfo.encoding or "utf-8"
    if data.startswith(codecs.BOM_UTF32_LE):  # it begins with the one of UTF-16
        return declared
    if data.startswith(codecs.BOM_UTF16_LE):
        return "utf-16-le"
    if data.startswith(codecs.BOM_UTF16_BE):
        return "utf-16-be"
    return declared


@dataclass(frozen=True, slots=True)
class Merged:
    """A policy file after a merge: its new content, the added rights, and the contradictions.

    If no right is added, ``document`` is the unchanged content of the file.  ``rights`` are all
    rights after the merge.  ``notes`` are about denials that win, about enclaves that, since the
    merge, have several nodes, or a node in several namespaces, and about nodes that now have
    several enclaves.
    """

    document: bytes
    added: tuple[Right, ...]
    contradictions: tuple[Contradiction, ...]
    rights: frozenset[Right]
    notes: tuple[Note, ...]


@shows(optional=("document",))
class MergedPolicy(NamedTuple):
    """The result of merging policies into a policy file."""

    policy: Path
    """Path of the policy file, as given on the command line."""
    added: Sequence[Right]
    """Rights that the merge adds to the policy file."""
    contradictions: Sequence[Contradiction]
    """Rights that a policy allows, and another or the same one denies; the DENY wins."""
    output: Path | None
    """Path of the file that was written, or null."""
    document: str | None
    """The merged policy as XML, or null if it was written to a file."""
    dry_run: DryRun
    changes: FileChanges
    notes: Notes


def merge_into(path: Path, additions: Policy) -> Merged:
    """Return the policy file at ``path`` with the rights of ``additions`` merged; write nothing.

    Raises:
        PolicyError: (or another `DocumentError`) the file is not a policy; or a right cannot be
            added, because its enclave is in an included file, or because the part to change is also
            included elsewhere, where the change would add rights that nobody requested.
    """
    return merge_all(path, (additions,))


def merge_all(path: Path, policies: Iterable[Policy], undenied: Collection[Right] = ()) -> Merged:
    """Return the file at ``path`` with several policies merged in order; write nothing.

    For ``undenied``, see `plan_merge`.
    """
    document, policies = read_bytes(path, "policy file"), tuple(policies)
    first = before = read_policy(path, document, may_be_empty=True)
    added: list[Right] = []
    contradictions: list[Contradiction] = []
    shared: list[str] = []
    for additions in policies:
        present = before
        plan = plan_merge(before, additions, undenied)
        contradictions += plan.contradictions
        if plan.added:
            document = _Editor(document, path, before).add(plan.entries)
            before = _checked_policy(path, document, before, plan.added)
            added += plan.added
        alone = f" With --enclave or --remap, merge {additions.file} in a run of its own."
        texts = _texts_on_shared_enclaves(present, additions, before)
        shared += [text + alone * (len(policies) > 1) for text in texts]
        _check_protection(path, before, additions)
    first_nodes = nodes_in_several_namespaces(first.enclaves)
    several = (
        f"{enclave} has the node {node} in {first_few([profile.ns for profile in profiles], 3)}: "
        "each process in this enclave has the rights of the node in all these namespaces. Put the "
        "namespace into path=, too, to give each instance of the node its own enclave."
        for (enclave, node), profiles in nodes_in_several_namespaces(before.enclaves).items()
        if first_nodes.get((enclave, node), ()) != profiles
    )
    first_places = nodes_in_several_enclaves(first.enclaves)
    twice = (
        f"the node {node} is now in {first_few([*places], _MOST_SHOWN)}, but names of nodes are "
        "unique in ROS, and a process runs in one enclave. If these are two programs, merge with "
        f"another --namespace, or with `{_renaming(node)}`. If they are "
        f"one program, merge with {_into(policies, node, next(iter(places)))}."
        for node, places in nodes_in_several_enclaves(before.enclaves).items()
        if first_places.get(node, {}).keys() != places.keys()
    )
    notes = (
        *merge_notes(contradictions),
        *(Note("merge.several-instances", text) for text in several),
        *(Note("merge.shared-enclave", text) for text in shared),
        *(Note("merge.node-in-two-enclaves", text) for text in twice),
    )
    rights = frozenset(policy_rights(before))
    return Merged(document, tuple(added), tuple(contradictions), rights, notes)


def _texts_on_shared_enclaves(before: Policy, additions: Policy, after: Policy) -> Iterator[str]:
    """Yield a text on each enclave of ``before`` that gets nodes of another program.

    These have other names, or the same name, but nothing of their own in common.  Nodes that have
    the same name in other namespaces are instances of a node, for which there is another note.
    """
    now = after.nodes()
    for enclave in additions.enclaves:
        present = before.enclave(enclave.path)
        rights = _rights_of_nodes(present) if present else {}
        new_rights = _rights_of_nodes(enclave)
        nodes, come = sorted(rights), sorted({*now.get(enclave.path, ())} - rights.keys())
        if nodes and come and _names(rights).isdisjoint(_names(new_rights)):
            yield (
                f"{enclave.path} has {_nodes_text(nodes)}, and now also {_nodes_text(come)}: each "
                "process in this enclave has the rights of all these nodes. Unless they run in one "
                "process, give one of them another enclave, in its policy or with "
                f"{_apart(additions, enclave.path)}."
            )
        for node in sorted(new_rights.keys() & rights.keys()):
            if _are_different_programs(rights[node], new_rights[node]):
                yield (
                    f"{enclave.path} already has a node {node}, and the merged policy gives the "
                    "node entirely different rights. If these are two programs, each of them now "
                    "has the rights of both: then merge with another --namespace, or with "
                    f"{_apart(additions, enclave.path, node)}. If they are two versions of one "
                    "program, ignore this note."
                )


def _apart(policy: Policy, path: str, renamed: str = "") -> str:
    """Return the options that merge the enclave ``path`` of ``policy`` under another name.

    The node with the full name ``renamed`` gets this name, too.  All other enclaves keep their
    names, which needs a second run.
    """
    name, remaps = _last(renamed), ""
    options = f"--enclave {path.rpartition('/')[0]}/NAME"
    if renamed:
        options += f" {_renaming(renamed)}"
        names = {
            written
            for enclave in policy.enclaves
            for profile in enclave.all_profiles()
            for group in profile.groups
            for written in group.names
            if written.startswith(f"{name}/") and enclave.path != path
        }
        remaps = "".join(
            f" --remap {written}:=NAME{written.removeprefix(name)}"
            for written in sorted(names)
            if not is_expression(written)
        )
    return _with_second_run(policy, {path}, options, remaps)


def _into(policies: Iterable[Policy], node: str, path: str) -> str:
    """Return the options that merge ``node`` into the enclave ``path``, and only this node."""
    for policy in policies:
        if homes := {home for home, nodes in policy.nodes().items() if node in nodes} - {path}:
            return _with_second_run(policy, homes, f"--enclave {path}")
    return f"`--enclave {path}`"


def _with_second_run(policy: Policy, paths: Collection[str], options: str, second: str = "") -> str:
    """Return ``options`` for the nodes of the enclaves ``paths``, and those for all other nodes.

    --enclave moves all nodes of a run, so it needs a --node if ``policy`` has other enclaves.
    """
    own, others = (
        {
            _last(node)
            for path, nodes in policy.nodes().items()
            if (path in paths) is is_own
            for node in nodes
        }
        for is_own in (True, False)
    )
    if not others - own:
        return f"`{options}`"
    chosen, rest = (
        " ".join(f"--node {quote(node)}" for node in sorted(nodes)) for nodes in (own, others - own)
    )
    return (
        f"`{chosen} {options}` (then merge the other nodes into the result in a second run, with "
        f"`{rest}{second}` in place of these options)"
    )


def _last(node: str) -> str:
    return node.rpartition("/")[2]


def _renaming(node: str) -> str:
    """Return the option that gives the node with this full name another name."""
    name = _last(node)
    return f"--remap {'' if is_expression(name) else f'{name}:'}__node:=NAME"


def _names(rights: Mapping[str, Iterable[Right]]) -> set[str]:
    """Return the names of nodes without namespaces; without a component container, if possible."""
    own = [node for node, of_node in rights.items() if not all(_is_of_any_node(r) for r in of_node)]
    return {node.rpartition("/")[2] for node in own or rights}


def _rights_of_nodes(enclave: Enclave) -> dict[str, set[Right]]:
    """Map the full name of each node to its ALLOW rights."""
    rights: dict[str, set[Right]] = {}
    for profile in enclave.all_profiles():
        of_node = rights.setdefault(profile.full_name, set())
        of_node.update(e for e in profile_rights(enclave.path, profile) if e.qualifier is ALLOW)
    return rights


def _are_different_programs(rights: Iterable[Right], others: Iterable[Right]) -> bool:
    """Return whether both nodes have rights of their own, and share only those of any node.

    Rights without those that every node needs, such as a patch of `sros audit`, are no program.
    """
    own, other_own = ({e for e in side if not _is_of_any_node(e)} for side in (rights, others))
    basics = Rules(e for e in rights if is_of_every_node(e.name))
    if not own or not other_own or not any(map(basics.overlaps, others)):
        return False
    return not any(map(Rules(own).overlaps, other_own))


def _is_of_any_node(right: Right) -> bool:
    """Return whether nodes of different programs may have a right, as lifecycle nodes do."""
    name = right.name
    return (
        is_of_every_node(name)
        or name in GLOBAL_TOPICS
        or only_reads(name)
        or name.endswith(_OF_KINDS_OF_NODES)
    )


_OF_KINDS_OF_NODES = (
    *("/change_state", "/transition_event"),
    *("/_container/load_node", "/_container/unload_node"),
)


def _nodes_text(nodes: Sequence[str]) -> str:
    return f"the node{'s' * (len(nodes) > 1)} {first_few(nodes, _MOST_SHOWN)}"


def _checked_policy(path: Path, document: bytes, before: Policy, added: Sequence[Right]) -> Policy:
    """Return the policy in ``document``.

    Raises:
        PolicyError: the rights are not exactly the rights of ``before`` and ``added``.
    """
    try:
        after = read_policy(path, document)
    except DocumentError as error:
        raise PolicyError(
            f"'{path}' with the added rights would not be a valid policy: {error.what}",
            error.why,
            error.remedy,
        ) from error
    expected = policy_rights(before).union(added)
    wrong = sorted(policy_rights(after) ^ expected)
    if wrong:
        raise PolicyError(
            f"the rights cannot be added to '{path}' without changing other rights",
            f"The result would differ in {wrong[0]}, probably because a part of the file is "
            "also included elsewhere.",
            "Add the rights by hand, or merge into a file without such an include.",
        )
    return after


def _check_protection(path: Path, merged: Policy, additions: Policy) -> None:
    """Raise `PolicyError` unless ``merged`` protects names as ``additions`` require.

    A name that the file already has may lack the protection, because a merge does not change such a
    name: the author has to choose the occurrence of the name that states the protection.
    """
    present = {(e.kind, e.name): e for e in stated_protections(merged.enclaves)}
    for protection in stated_protections(additions.enclaves):
        old = present.get((protection.kind, protection.name))
        if old is None or old.level is not protection.level:
            says = (
                f'says protect="{old.word}" at {old.source}'
                if old
                else "states no protection of it"
            )
            raise PolicyError(
                f'{protection.source}: {protection} has protect="{protection.word}", and '
                f"'{path}' {says}",
                "A merge adds rights, and does not change existing names.",
                "State the same protection in both files, and merge again"
                + (f", or merge '{path}' into the policy that states it." if old is None else "."),
            )


# ── new elements ───────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, slots=True)
class _NewElement:
    """An XML element to write: the start tag without brackets, and the content."""

    start: str
    content: str = ""
    children: list[_NewElement] = field(default_factory=list)


def _item(entry: AddedName) -> _NewElement:
    return _NewElement(entry.kind.removesuffix("s"), entry.name + instruction_text(entry.protect))


def _group(kind: str, rights: GroupRights, entries: Iterable[AddedName]) -> _NewElement:
    attributes = "".join(f' {right}="{qualifier.value}"' for right, qualifier in rights)
    return _NewElement(kind + attributes, children=[_item(entry) for entry in entries])


def _groups(entries: Sequence[AddedName]) -> list[_NewElement]:
    """Return groups for names that are sorted by kind and rights."""
    return [
        _group(kind, rights, names)
        for (kind, rights), names in groupby(entries, key=lambda entry: (entry.kind, entry.rights))
    ]


def _profile(key: ProfileKey, entries: Sequence[AddedName]) -> _NewElement:
    return _NewElement(f'profile ns="{key.ns}" node="{key.node}"', children=_groups(entries))


# ── positions ──────────────────────────────────────────────────────────────────────────────


class _Editor:
    def __init__(self, document: bytes, path: Path, policy: Policy) -> None:
        self._path = path
        self._policy = policy
        self._text = EditedText(document, f"the policy file '{path}'")

    def add(self, entries: dict[ProfileKey, tuple[AddedName, ...]]) -> bytes:
        """Return the document with ``entries`` added."""
        blocks = list(self._text.root.named("enclaves"))
        enclave_elements = {
            element.get("path"): element for block in blocks for element in block.named("enclave")
        }
        new = []
        for path, enclave_entries in groupby(entries.items(), key=lambda item: item[0].enclave):
            places = dict(enclave_entries)
            if path in enclave_elements:
                self._add_to_enclave(enclave_elements[path], places)
                continue
            included = self._policy.enclave(path)
            if included is not None or not blocks:
                raise PolicyError(
                    f"rights of the enclave {path} cannot be added to '{self._path}'",
                    f"The enclave is included from {included.source}."
                    if included
                    else "The <enclaves> of this file are included from another file.",
                    "Merge into the file that contains this part.",
                )
            profiles = _NewElement(
                "profiles", children=[_profile(*profile) for profile in places.items()]
            )
            new.append(_NewElement(f'enclave path="{path}"', children=[profiles]))
        if new:
            self._append(blocks[0], new)
        return self._text.document()

    def _add_to_enclave(
        self, enclave: PlacedElement, places: dict[ProfileKey, tuple[AddedName, ...]]
    ) -> None:
        profiles_by_node: dict[tuple[str, str], list[PlacedElement]] = {}
        blocks = list(enclave.named("profiles"))
        for block in blocks:
            for profile in block.named("profile"):
                key = (check_namespace(profile.get("ns")), profile.get("node"))
                profiles_by_node.setdefault(key, []).append(profile)
        new = []
        for place, entries in places.items():
            if profiles := profiles_by_node.get((place.ns, place.node)):
                self._add_to_profiles(profiles, entries)
            else:
                new.append(_profile(place, entries))
        if new and blocks:
            self._append(blocks[0], new)
        elif new:
            self._append(enclave, [_NewElement("profiles", children=new)])

    def _add_to_profiles(self, profiles: list[PlacedElement], entries: Sequence[AddedName]) -> None:
        groups: dict[tuple[str, GroupRights], PlacedElement] = {}
        for profile in profiles:
            for child in profile.children:
                if child.tag in RIGHTS:
                    groups.setdefault((child.tag, _rights_of(child)), child)
        new = [entry for entry in entries if (entry.kind, entry.rights) not in groups]
        if new:
            self._append(profiles[0], _groups(new))
        for (kind, rights), names in groupby(entries, key=lambda entry: (entry.kind, entry.rights)):
            if group := groups.get((kind, rights)):
                self._add_names(group, kind, list(names))

    def _add_names(self, group: PlacedElement, kind: str, entries: Sequence[AddedName]) -> None:
        """Insert names into a group: in order if the group is sorted, or else at the end."""
        present = [child.xml.text or "" for child in group.named(kind.removesuffix("s"))]
        is_sorted = len(present) == len(group.children) and present == sorted(present)
        for entry in entries:
            new = _item(entry)
            place = bisect_left(present, entry.name) if is_sorted else len(present)
            if not is_sorted:
                self._append(group, [new])
            elif place:
                self._put_after(group.children[place - 1], new)
            else:
                self._put_first(group, new)

    # ── writing elements ───────────────────────────────────────────────────────────────────

    def _append(self, parent: PlacedElement, new: Sequence[_NewElement]) -> None:
        """Insert elements after the last child of ``parent`` that is not metadata."""
        last = next((child for child in reversed(parent.children) if child.tag != "metadata"), None)
        if last:
            for element in new:
                self._put_after(last, element)
        else:
            self._put_into_empty(parent, new)

    def _put_after(self, sibling: PlacedElement, new: _NewElement) -> None:
        text = self._text
        indent = text.indent_of(sibling)
        if indent is None and sibling.tag == "enclave" and "\n" in text.text[text.root.start :]:
            indent = text.indentation  # otherwise, many new enclaves would be on one line
        text.insert(text.position_after(sibling), self._rendered(new, indent))

    def _put_first(self, parent: PlacedElement, new: _NewElement) -> None:
        """Insert an element as the first child, after text or a comment at the beginning."""
        text, first = self._text, parent.children[0]
        if text.text[parent.inner : first.start].strip():
            self._put_after(first, new)
        else:
            text.insert(parent.inner, self._rendered(new, text.indent_of(first)))

    def _put_into_empty(self, parent: PlacedElement, new: Iterable[_NewElement]) -> None:
        text, outer = self._text, self._text.indent_of(parent)
        if parent.tag == "enclaves" and outer is None:
            outer = ""  # otherwise, a policy that begins empty would stay on one line
        indent = None if outer is None else outer + text.indentation
        rendered = "".join(self._rendered(element, indent) for element in new)
        # An element without end tag, such as <profile .../>.
        if parent.close == parent.inner == parent.end:
            ending = "" if outer is None else text.newline + outer
            tag = text.text[parent.start : parent.end].rstrip("/>").rstrip()
            text.insert(parent.start, f"{tag}>{rendered}{ending}</{parent.tag}>", parent.end)
            return
        content = text.text[parent.inner : parent.close]
        place = parent.inner + len(content.rstrip())
        if outer is not None and "\n" not in text.text[place : parent.close]:
            rendered += text.newline + outer
        text.insert(place, rendered)

    def _rendered(self, new: _NewElement, indent: str | None) -> str:
        """Return the XML of an element; with ``indent``, every child is on its own line."""
        tag = new.start.split(" ", 1)[0]
        before = "" if indent is None else self._text.newline + indent
        if not new.children:
            return f"{before}<{new.start}>{new.content}</{tag}>"
        inner = None if indent is None else indent + self._text.indentation
        children = "".join(self._rendered(child, inner) for child in new.children)
        return f"{before}<{new.start}>{children}{before}</{tag}>"


def _rights_of(group: PlacedElement) -> GroupRights:
    return tuple(
        (right, Qualifier(group.get(right))) for right in RIGHTS[group.tag] if group.get(right)
    )
