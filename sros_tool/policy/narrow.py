"""Rewrites an enclave with fewer rights: rules that go, and names in place of wildcards."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import replace

from sros_tool.names import expand
from sros_tool.policy.model import ALLOW, DENY, Enclave, Group, Profile, Qualifier
from sros_tool.policy.rights import Right, Said, sayable


def narrowed_enclave(
    enclave: Enclave, kept: Set[Right], replacements: Mapping[Right, Sequence[Right]]
) -> Enclave:
    """``enclave`` with its denials, the ALLOW rights in ``kept``, and names for wildcards.

    The names of a wildcard stand once, where it stood first, and are written as it was: relative,
    private or absolute.  Profiles stay, even without a rule.
    """
    pending = dict(replacements)
    blocks = []
    for block in enclave.profiles:
        profiles = tuple(
            _profile(enclave.path, profile, kept, pending) for profile in block.profiles
        )
        blocks.append(replace(block, profiles=profiles))
    return replace(enclave, profiles=tuple(blocks))


def _profile(
    path: str, profile: Profile, kept: Set[Right], pending: dict[Right, Sequence[Right]]
) -> Profile:
    """The profile; what it takes of ``pending`` is removed there."""
    said: dict[tuple[str, str], dict[tuple[str, Qualifier], None]] = {}
    for group in profile.groups:
        for name in group.names:
            fqn = expand(name, profile.ns, profile.node)
            for right, qualifier in group.rights:
                whole = Right(path, qualifier, right, fqn)
                if qualifier is DENY or whole in kept:
                    said.setdefault((group.kind, name), {})[right, qualifier] = None
                for each in pending.pop(whole, ()):
                    written = _written(each.name, name, profile)
                    said.setdefault((each.kind, written), {})[each.right, ALLOW] = None
    groups: dict[tuple[str, Said], list[str]] = {}
    for (kind, name), rights in said.items():
        for together in sayable(rights):
            groups.setdefault((kind, together), []).append(name)
    return replace(
        profile,
        groups=tuple(
            Group(kind, rights, tuple(dict.fromkeys(names)))
            for (kind, rights), names in groups.items()
        ),
    )


def _written(fqn: str, like: str, profile: Profile) -> str:
    """An absolute name as the rule that it comes from was written, where that is possible."""
    if like.startswith("/"):
        return fqn
    prefix = expand("~/" if like.startswith("~") else "", profile.ns, profile.node)
    rest = fqn.removeprefix(prefix)
    if not fqn.startswith(prefix) or not rest:
        return fqn
    return f"~/{rest}" if like.startswith("~") else rest
