"""Writes a learned policy: as a new file or into an existing one, whole or not at all."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from sros_tool.atomic import replace_file
from sros_tool.errors import DocumentError, PolicyError
from sros_tool.graph.common import CommonParts
from sros_tool.graph.document import profiles_of, render, with_includes
from sros_tool.graph.learn import Learned, LearnedProfile
from sros_tool.policy.edit import merge_into
from sros_tool.policy.merge import Contradiction
from sros_tool.policy.reader import read_policy
from sros_tool.policy.rights import Right, Rules, order, policy_rights, profile_rights
from sros_tool.xml import read_bytes


@dataclass(frozen=True, slots=True)
class Draft:
    """What would be written, and where: the policy ``path``, and ``copies`` beside it.

    ``before`` is the present content of the policy, or None; ``copies`` are paths relative to the
    folder of the policy.  The rights of ``document`` lie between ``least`` and ``most``.
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
        """Whether anything would change."""
        return self.document != self.before


def draft(path: Path, learned: Learned, common: CommonParts | None) -> Draft:
    """What ``learned`` makes of the policy file at ``path``; nothing is written.

    ``common`` are the parts with which it was learned (None: one file without includes).  Raises
    `PolicyError` (or another `DocumentError`) where the file is no policy, or nothing can be
    added to it.
    """
    additions = learned.policy()
    rights = policy_rights(additions)
    if not os.path.lexists(path):
        copies = common.to_copy(learned.includes) if common else {}
        added = tuple(sorted(rights, key=order))
        return Draft(path, None, render(learned.profiles), copies, added, (), rights, rights)
    before = read_bytes(path, "policy file")
    merged = merge_into(path, additions)
    document, included = merged.document, tuple[str, ...]()
    if common and document != before:
        by_name, shown = _parted(path, before, merged.document, learned, common)
        document = merge_into(path, by_name.policy()).document
        document, included = with_includes(path, before, document, shown)
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
    """What goes into the file by its names, and the profiles that get includes.

    A profile that is there gets an include only of what it has nothing of, and is denied none of.
    """
    known = profiles_of(path, before)
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
    """Put a draft in place; what fails leaves every file as it was.

    Raises `PolicyError` if the result, read again, would not say what it should.
    """
    if not plan.changes:
        return
    copied: list[Path] = []
    try:
        for path, data in plan.copies.items():
            copied += _put_new(plan.path.parent / path, data)
        _check(plan)
        replace_file(plan.path, plan.document)
    except BaseException:
        for made in reversed(copied):
            with contextlib.suppress(OSError):
                made.rmdir() if made.is_dir() else made.unlink()
        raise


def _check(plan: Draft) -> None:
    try:
        found = policy_rights(read_policy(plan.path, plan.document))
        if plan.least <= found <= plan.most:
            return
        why = f"It would differ in {min(found ^ plan.least, key=order)}."
    except DocumentError as error:
        why = f"{error}"
    raise PolicyError(
        f"what was learned cannot be written to '{plan.path}'", why, "Try --flat, without includes."
    )


def _put_new(path: Path, data: bytes) -> list[Path]:
    """Create a file with the folders that it lacks; returns all of them, the folders first."""
    made = [each for each in reversed(path.parents) if not each.exists()]
    path.parent.mkdir(parents=True, exist_ok=True)
    replace_file(path, data)
    return [*made, path]
