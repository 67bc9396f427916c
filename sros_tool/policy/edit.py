"""Adds the rights of one policy to the text of another: the file stays as its owner wrote it.

Names go into a group that has exactly their rights, of a profile with their namespace and node, in
the file itself and never in what it includes; where there is none, it is made.  What comes out is
read again and proven to hold what was there and what was added, and nothing else.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path

from sros_tool.errors import DocumentError, PolicyError
from sros_tool.names import check_namespace
from sros_tool.policy.merge import Contradiction, Entry, Place, plan_merge
from sros_tool.policy.model import RIGHTS, Policy, Qualifier
from sros_tool.policy.reader import read_policy
from sros_tool.policy.rights import Right, Said, policy_rights
from sros_tool.policy.text import Element, Text
from sros_tool.xml import read_bytes


@dataclass(frozen=True, slots=True)
class Merged:
    """A policy file after a merge: its new bytes, what was added, and what contradicted.

    Without additions ``document`` is the file byte for byte.
    """

    document: bytes
    added: tuple[Right, ...]
    contradictions: tuple[Contradiction, ...]


def merge_into(path: Path, additions: Policy) -> Merged:
    """The policy file at ``path`` with the rights of ``additions``; nothing is written.

    Raises `PolicyError` (or another `DocumentError`) if the file is no policy, or where a right
    has no place: its enclave stands in an included file, or a changed part is included elsewhere
    and would give more than was asked.
    """
    return merge_all(path, (additions,))


def merge_all(path: Path, policies: Iterable[Policy]) -> Merged:
    """As `merge_into`, with one policy after the other."""
    document = read_bytes(path, "policy file")
    before = read_policy(path, document)
    added: list[Right] = []
    contradictions: list[Contradiction] = []
    for additions in policies:
        plan = plan_merge(before, additions)
        contradictions += plan.contradictions
        if not plan.added:
            continue
        document = _Editor(document, path, before).add(plan.entries)
        before = _proven(path, document, before, plan.added)
        added += plan.added
    return Merged(document, tuple(added), tuple(contradictions))


def _proven(path: Path, document: bytes, before: Policy, added: Sequence[Right]) -> Policy:
    """The policy that a document says, if it is ``before`` with ``added``; else an error."""
    try:
        after = read_policy(path, document)
    except DocumentError as error:
        raise PolicyError(
            f"'{path}' with what is to be added would be no valid policy: {error.what}",
            error.why,
            error.remedy,
        ) from error
    expected = policy_rights(before).union(added)
    wrong = sorted(policy_rights(after) ^ expected)
    if wrong:
        raise PolicyError(
            f"the rights cannot be added to '{path}' without changing others",
            f"The result would differ in {wrong[0]}, probably because a part of the file is "
            "included a second time.",
            "Add them by hand, or merge into a file without such an include.",
        )
    return after


# ── new elements ───────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, slots=True)
class _New:
    """An element to be written: its start tag without brackets, and its content."""

    start: str
    content: str = ""
    children: list[_New] = field(default_factory=list)


def _item(kind: str, name: str) -> _New:
    return _New(kind.removesuffix("s"), name)


def _group(kind: str, rights: Said, names: Iterable[str]) -> _New:
    attributes = "".join(f' {right}="{qualifier.value}"' for right, qualifier in rights)
    return _New(kind + attributes, children=[_item(kind, name) for name in names])


def _groups(entries: Sequence[Entry]) -> list[_New]:
    """The groups for names that come sorted by kind and rights."""
    return [
        _group(kind, rights, [entry.name for entry in same])
        for (kind, rights), same in groupby(entries, key=lambda each: (each.kind, each.rights))
    ]


def _profile(place: Place, entries: Sequence[Entry]) -> _New:
    return _New(f'profile ns="{place.ns}" node="{place.node}"', children=_groups(entries))


# ── where they go ──────────────────────────────────────────────────────────────────────────


class _Editor:
    def __init__(self, document: bytes, path: Path, policy: Policy) -> None:
        self._path = path
        self._policy = policy
        self._text = Text(document, f"the policy file '{path}'")

    def add(self, entries: dict[Place, tuple[Entry, ...]]) -> bytes:
        """The document with ``entries``."""
        blocks = list(self._text.root.named("enclaves"))
        own = {each.get("path"): each for block in blocks for each in block.named("enclave")}
        for path, found in groupby(entries.items(), key=lambda item: item[0].enclave):
            places = dict(found)
            if path in own:
                self._add_to_enclave(own[path], places)
                continue
            included = self._policy.enclave(path)
            if included is not None or not blocks:
                raise PolicyError(
                    f"nothing can be added to the enclave {path} in '{self._path}'",
                    f"It is included from {included.source}."
                    if included
                    else "Its <enclaves> are included from another file.",
                    "Merge into the file in which it stands.",
                )
            profiles = _New("profiles", children=[_profile(*each) for each in places.items()])
            self._append(blocks[0], _New(f'enclave path="{path}"', children=[profiles]))
        return self._text.document()

    def _add_to_enclave(self, enclave: Element, places: dict[Place, tuple[Entry, ...]]) -> None:
        own: dict[tuple[str, str], list[Element]] = {}
        blocks = list(enclave.named("profiles"))
        for block in blocks:
            for profile in block.named("profile"):
                key = (check_namespace(profile.get("ns")), profile.get("node"))
                own.setdefault(key, []).append(profile)
        new = []
        for place, entries in places.items():
            if found := own.get((place.ns, place.node)):
                self._add_to_profiles(found, entries)
            else:
                new.append(_profile(place, entries))
        if new and blocks:
            for each in new:
                self._append(blocks[0], each)
        elif new:
            self._append(enclave, _New("profiles", children=new))

    def _add_to_profiles(self, profiles: list[Element], entries: Sequence[Entry]) -> None:
        groups: dict[tuple[str, Said], Element] = {}
        for profile in profiles:
            for child in profile.children:
                if child.tag in RIGHTS:
                    groups.setdefault((child.tag, _rights_of(child)), child)
        for new in _groups([each for each in entries if (each.kind, each.rights) not in groups]):
            self._append(profiles[0], new)
        for (kind, rights), same in groupby(entries, key=lambda each: (each.kind, each.rights)):
            if group := groups.get((kind, rights)):
                self._add_names(group, kind, [entry.name for entry in same])

    def _add_names(self, group: Element, kind: str, names: Sequence[str]) -> None:
        """Put names where they belong in a sorted group, and at the end of any other."""
        present = [child.xml.text or "" for child in group.named(kind.removesuffix("s"))]
        is_sorted = len(present) == len(group.children) and present == sorted(present)
        for name in names:
            new = _item(kind, name)
            place = bisect_left(present, name) if is_sorted else len(present)
            if not is_sorted:
                self._append(group, new)
            elif place:
                self._put_after(group.children[place - 1], new)
            else:
                self._put_first(group, new)

    # ── writing them there ─────────────────────────────────────────────────────────────────

    def _append(self, parent: Element, new: _New) -> None:
        """Write an element behind the last one of ``parent`` that is not its metadata."""
        last = next((each for each in reversed(parent.children) if each.tag != "metadata"), None)
        if last:
            self._put_after(last, new)
        else:
            self._put_into_empty(parent, new)

    def _put_after(self, sibling: Element, new: _New) -> None:
        indent = self._text.indent_of(sibling)
        self._text.put(self._text.after(sibling), self._rendered(new, indent))

    def _put_first(self, parent: Element, new: _New) -> None:
        """Write an element before all others, but not before a comment that may be about all."""
        text, first = self._text, parent.children[0]
        if text.text[parent.inner : first.start].strip():
            self._put_after(first, new)
        else:
            text.put(parent.inner, self._rendered(new, text.indent_of(first)))

    def _put_into_empty(self, parent: Element, new: _New) -> None:
        text, outer = self._text, self._text.indent_of(parent)
        indent = None if outer is None else outer + text.unit
        rendered = self._rendered(new, indent)
        if parent.close == parent.inner == parent.end:  # <profile .../>
            ending = "" if outer is None else text.newline + outer
            tag = text.text[parent.start : parent.end].rstrip("/>").rstrip()
            text.put(parent.start, f"{tag}>{rendered}{ending}</{parent.tag}>", parent.end)
            return
        content = text.text[parent.inner : parent.close]
        place = parent.inner + len(content.rstrip())
        if outer is not None and "\n" not in text.text[place : parent.close]:
            rendered += text.newline + outer
        text.put(place, rendered)

    def _rendered(self, new: _New, indent: str | None) -> str:
        """The text of an element, on lines of its own if its neighbours stand so."""
        tag = new.start.split(" ", 1)[0]
        before = "" if indent is None else self._text.newline + indent
        if not new.children:
            return f"{before}<{new.start}>{new.content}</{tag}>"
        inner = None if indent is None else indent + self._text.unit
        children = "".join(self._rendered(child, inner) for child in new.children)
        return f"{before}<{new.start}>{children}{before}</{tag}>"


def _rights_of(group: Element) -> Said:
    return tuple(
        (right, Qualifier(group.get(right))) for right in RIGHTS[group.tag] if group.get(right)
    )
