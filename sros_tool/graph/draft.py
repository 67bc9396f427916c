"""Write a learned policy: as a new file, or as additions to an existing one.

Names need no escaping: only plain ROS names are learned, and those contain no markup.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Annotated, NamedTuple

from sros_tool.errors import DocumentError, PolicyError
from sros_tool.files import new_files, replace_file
from sros_tool.graph.learn import CommonParts, Learned, LearnedProfile, RightsFound
from sros_tool.graph.observation import PUBLISH, SUBSCRIBE, Observation
from sros_tool.names import check_namespace
from sros_tool.policy.document import read_policy
from sros_tool.policy.merge import Contradiction, EditedText, PlacedElement, merge_into
from sros_tool.policy.model import VERSION
from sros_tool.policy.rights import Right, Rules, order, policy_rights, profile_rights
from sros_tool.values import DryRun, FileChanges, Notes, Words, shows
from sros_tool.xml import read_bytes

_XINCLUDE = "http://www.w3.org/2001/XInclude"
_UNIT = "  "
_DECLARATION = """<?xml version="1.0" encoding="UTF-8"?>\n"""
_HEADERS = {
    RightsFound.GRAPH: """\
<!-- Written by sros generate_policy: rights that the robot was observed to use.
     Review it before you enforce it: rights that were not observed are not allowed, and rights
     that were observed may be unwanted. -->
""",
    RightsFound.LOG: """\
<!-- Written by sros generate_policy: rights that were denied, by the lines of logs.
     Review it before you enforce it: a process can print any line, also one that looks like a
     denial, to get a right that it should not have. -->
""",
    RightsFound.AUDIT: """\
<!-- Written by sros audit: rights that nodes were observed to use, and that the policy or keystore
     denies. Review it before you add it (sros merge_policy): rights that were observed may be
     unwanted. -->
""",
}
"""The comment at the head of a learned policy."""


class AskingLine(NamedTuple):
    """A line of a log."""

    log: Path
    """The log."""
    line: int
    """The line, from 1."""
    process: str | None
    """The process that printed it, or null."""
    enclave: str | None
    """The enclave that it names, or null."""
    direction: Annotated[str, Words((PUBLISH, SUBSCRIBE))]
    """What was denied."""
    topic: str
    """The DDS topic."""


@shows(optional=("accepted", "denials"), spread=("observation",))
class LearnedPolicy(NamedTuple):
    """What was learned, and how the policy changes."""

    file: Path | None
    """The policy, or null without FILE."""
    source: RightsFound
    """Where the rights come from."""
    created: bool
    """Whether the policy is a new file, or would be with `--accept`."""
    changed: bool
    """Whether the policy changes, or would with `--accept`."""
    dry_run: DryRun
    observation: Observation
    """The nodes that were observed; empty for a log."""
    added: Sequence[Right]
    """The rights that are added."""
    copied: Sequence[str]
    """Common parts that are copied next to the policy."""
    accepted: bool | None
    """For a log: whether `--accept` was given; if not, no right is written."""
    denials: Sequence[AskingLine] | None
    """For a log: the lines that ask for the rights."""
    changes: FileChanges
    notes: Notes


class Draft(NamedTuple):
    """A change of the policy at ``path`` that is not written yet.

    ``before`` is the present content of the policy, None if there is no file; ``document`` is the
    new content.  ``copies`` are files to create, by their paths relative to the policy's folder.
    ``document`` must have all rights in ``least`` and none outside of ``most``.
    """

    path: Path
    before: bytes | None
    document: bytes
    copies: Mapping[str, bytes]
    added: tuple[Right, ...]
    contradictions: tuple[Contradiction, ...]
    least: frozenset[Right]
    most: frozenset[Right]

    @property
    def changes(self) -> bool:
        """Whether writing the draft would change the policy."""
        return self.document != self.before


def draft(path: Path, learned: Learned, common: CommonParts | None) -> Draft:
    """Return how ``learned`` changes the policy file at ``path``; nothing is written.

    ``common`` are the parts that ``learned`` may include (None: one file without includes).  Raises
    `PolicyError` (or another `DocumentError`) if the file is not a policy, or if nothing can be
    added to it.
    """
    additions = learned.policy()
    rights = policy_rights(additions)
    if not os.path.lexists(path):
        copies = common.to_copy(learned.includes) if common else {}
        added = tuple(sorted(rights, key=order))
        return Draft(path, None, render(learned), copies, added, (), rights, rights)
    before = read_bytes(path, "policy file")
    merged = merge_into(path, additions)
    document, included = merged.document, tuple[str, ...]()
    if common and document != before:
        by_name, shown = _parted(path, before, merged.document, learned, common)
        document = merge_into(path, by_name.policy()).document
        document, included = _with_includes(path, before, document, shown)
    least = policy_rights(read_policy(path, merged.document))
    return Draft(
        path,
        before,
        document,
        common.to_copy(included) if common else {},
        merged.added,
        merged.contradictions,
        least,
        least | rights,
    )


def _parted(
    path: Path, before: bytes, merged: bytes, learned: Learned, common: CommonParts
) -> tuple[Learned, list[LearnedProfile]]:
    """Return the rights to write name by name, and the profiles that get includes.

    An existing profile gets an include only if it neither has nor denies any right of the include.
    """
    known = _profiles_of(path, before)
    rules = Rules(policy_rights(read_policy(path, merged)))
    says: dict[tuple[str, str, str], set[tuple[str, str]]] = {}
    for enclave in read_policy(path, before).enclaves:
        for profile in enclave.all_profiles():
            rights = says.setdefault((enclave.path, profile.ns, profile.node), set())
            rights |= {(each.right, each.name) for each in profile_rights(enclave.path, profile)}
    by_name, shown = [], []
    for each in learned.profiles:
        place = each.enclave, each.ns, each.node
        given = common.given(each.includes, each.ns, each.node)
        if place not in known:
            shown.append(each)
        elif given and not any(
            (right.right, right.name) in says[place]
            or not rules.allow(each.enclave, right.right, right.name)
            for right in given
        ):
            shown.append(each)
            each = replace(each, rights=each.rights - given)
        by_name.append(each)
    return Learned(tuple(by_name)), shown


def write(plan: Draft) -> None:
    """Write a draft; after a failure, no file is changed.

    Raises `PolicyError` if the new policy, read again, would not have the expected rights.
    """
    if not plan.changes:
        return
    with new_files(plan.path.parent, plan.copies):
        _check(plan)
        replace_file(plan.path, plan.document)


def _check(plan: Draft) -> None:
    try:
        found = policy_rights(read_policy(plan.path, plan.document))
        if plan.least <= found <= plan.most:
            return
        why = f"The written policy would differ in {min(found ^ plan.least, key=order)}."
    except DocumentError as error:
        why = f"{error}"
    raise PolicyError(
        f"the learned rights cannot be written to '{plan.path}'", why, "Add --flat: no includes."
    )


# ── text ────────────────────────────────────────────────────────────────────────────────


def render(learned: Learned) -> bytes:
    """Return a policy file with the learned profiles; the same profiles give the same bytes."""
    declared = f' xmlns:xi="{_XINCLUDE}"' if learned.includes else ""
    lines = [f'<policy version="{VERSION}"{declared}>', "  <enclaves>"]
    for path, found in groupby(learned.profiles, key=lambda each: each.enclave):
        lines += [f'    <enclave path="{path}">', "      <profiles>"]
        for each in found:
            lines.append(f'        <profile ns="{each.ns}" node="{each.node}">')
            lines += [f"          {line}" for line in _content(each, "xi:include", _UNIT)]
            lines.append("        </profile>")
        lines += ["      </profiles>", "    </enclave>"]
    lines += ["  </enclaves>", "</policy>", ""]
    header = _DECLARATION + _HEADERS[learned.source]
    return (header + "\n".join(lines)).encode()


def _content(profile: LearnedProfile, include: str, unit: str) -> Iterator[str]:
    """Yield the lines inside a profile; ``include`` is the tag name of an include element."""
    yield from _includes(profile, include)
    for group in profile.groups:
        item = group.kind.removesuffix("s")
        rights = "".join(f' {right}="{said}"' for right, said in group.rights)
        yield f"<{group.kind}{rights}>"
        yield from (f"{unit}<{item}>{name}</{item}>" for name in group.names)
        yield f"</{group.kind}>"


def _includes(profile: LearnedProfile, include: str) -> Iterator[str]:
    for part in profile.includes:
        yield f'<{include} href="{part}" xpointer="xpointer(/profile/*)"/>'


def _with_includes(
    path: Path, before: bytes, merged: bytes, profiles: Iterable[LearnedProfile]
) -> tuple[bytes, tuple[str, ...]]:
    """Return ``merged`` (``before`` with the learned rights) with includes, and the included parts.

    A profile that ``before`` already had gets its includes in front of its content.  A new profile
    gets none if the policy denies one of its rights.
    """
    name = f"the policy file '{path}'"
    known = _profiles(EditedText(before, name))
    text = EditedText(merged, name)
    rules = Rules(policy_rights(read_policy(path, merged)))
    wanted = {(each.enclave, each.ns, each.node): each for each in profiles if each.includes}
    included: set[str] = set()
    for place, element in _profiles(text).items():
        profile = wanted.get(place)
        if profile is None:
            continue
        if place in known:
            text.put(element.inner, _in_front(profile, element, text))
        elif all(rules.allow(profile.enclave, right.right, right.name) for right in profile.rights):
            text.put(element.inner, _inside(profile, element, text), element.close)
        else:
            continue
        included.update(profile.includes)
    if included and _prefix(text) is None:
        text.put(text.root.inner - len(">"), f' xmlns:xi="{_XINCLUDE}"')
    return text.document(), tuple(sorted(included))


def _profiles(text: EditedText) -> dict[tuple[str, str, str], PlacedElement]:
    return {
        (enclave.get("path"), check_namespace(profile.get("ns")), profile.get("node")): profile
        for block in text.root.named("enclaves")
        for enclave in block.named("enclave")
        for profiles in enclave.named("profiles")
        for profile in profiles.named("profile")
    }


def _profiles_of(path: Path, document: bytes) -> frozenset[tuple[str, str, str]]:
    """Return enclave, namespace and node of each profile in the file, without its includes."""
    return frozenset(_profiles(EditedText(document, f"the policy file '{path}'")))


def _in_front(profile: LearnedProfile, element: PlacedElement, text: EditedText) -> str:
    """Return the includes of a profile as text to insert before its content."""
    include = f"{_prefix(text) or 'xi'}:include"
    outer = text.indent_of(element)
    lead = "" if outer is None else text.newline + outer + text.unit
    return "".join(lead + line for line in _includes(profile, include))


def _inside(profile: LearnedProfile, element: PlacedElement, text: EditedText) -> str:
    """Return the content of a profile as text, indented like its neighbours."""
    include = f"{_prefix(text) or 'xi'}:include"
    outer = text.indent_of(element)
    if outer is None:
        return "".join(_content(profile, include, ""))
    lines = [text.unit + line for line in _content(profile, include, text.unit)]
    return "".join(text.newline + outer + line for line in (*lines, ""))


def _prefix(text: EditedText) -> str | None:
    """Return the prefix of the XInclude namespace; None if the document declares none."""
    return next((p for p, uri in text.root.xml.nsmap.items() if p and uri == _XINCLUDE), None)
