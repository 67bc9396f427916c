"""Reduce a policy to observed rights, and propose wildcards that make a large policy smaller.

The over-privilege of an enclave is the number of allowed pairs (right, name), divided by the number
of observed pairs.  The right of a pair is publish, subscribe, request, reply, call or execute, and
the name is exact.  A wildcard counts as the known names that it matches: the exact names of its
kind (topics, services or actions) in the policy, in the observations of all enclaves, and among the
names that every node needs.  Pairs that a DENY removes do not count.  Observed pairs that are not
allowed do not count either, because they cannot have worked.
"""

from __future__ import annotations

import re
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from itertools import chain
from typing import NamedTuple

from sros_tool.errors import PolicyError
from sros_tool.names import expand, is_expression
from sros_tool.policy.model import (
    ALLOW,
    DENY,
    Enclave,
    Group,
    Level,
    Policy,
    Profile,
    Profiles,
    Qualifier,
    only_denials,
    stated_protections,
    with_groups,
)
from sros_tool.policy.patterns import Names, compiled, covers, literal_prefix, matches
from sros_tool.policy.rights import (
    KIND_OF,
    GroupRights,
    Right,
    Rules,
    group_rights,
    is_of_one_node,
    join_actions,
    order,
    parts,
    policy_rights,
    split_actions,
)
from sros_tool.values import shows

_Pair = tuple[str, str]


def enclaves_of_nodes(
    observed: Iterable[str], nodes: Mapping[str, Iterable[str]]
) -> dict[str, str]:
    """Map observed enclaves that are named like nodes to the enclaves of these nodes in a policy.

    ``generate_policy --enclave-per-node`` names enclaves like nodes.  Left out are nodes in several
    enclaves, and observed enclaves that are in the policy.

    Args:
        observed: the enclaves that were observed.
        nodes: the full names of the nodes in each enclave of the policy.
    """
    homes = defaultdict(list)
    for enclave, names in nodes.items():
        for name in names:
            homes[name].append(enclave)
    return {
        path: homes[path][0]
        for path in observed
        if path not in nodes and len(homes.get(path, ())) == 1
    }


def moved_to_enclaves(
    observed: Policy, stated: Mapping[str, Collection[str]]
) -> tuple[Policy, dict[str, dict[str, str]]]:
    """Return ``observed`` with nodes moved to their enclaves in a policy, and the moved nodes.

    ``stated`` maps enclaves of the policy to the full names of their nodes.  The second value maps
    observed enclaves to their nodes, and each node to its enclave in the policy.  Only enclaves
    with the name of one of their nodes change, as ``generate_policy --enclave-per-node`` gives a
    process the name of one of its nodes.  Nodes that the policy has in several enclaves, or in
    none, do not move.
    """
    moves: dict[str, dict[str, str]] = {}
    profiles: dict[str, list[Profile]] = defaultdict(list)
    for enclave in observed.enclaves:
        homes: dict[str, str] = {}
        names = sorted({profile.full_name for profile in enclave.all_profiles()})
        for node in names if enclave.path in names else ():
            exact = [path for path, nodes in stated.items() if node in nodes]
            if any(covers(wide, node) for wide in stated.get(enclave.path, ())):
                homes[node] = enclave.path
            elif len(exact) == 1:
                homes[node] = exact[0]
        is_divided = len({*homes.values()}) > 1
        rest = enclave.path
        if is_divided or (homes and enclave.path not in stated):
            moves[enclave.path] = homes
            rest = enclave.path if is_divided else next(iter(homes.values()))
        else:
            homes = {}
        for profile in enclave.all_profiles():
            profiles[homes.get(profile.full_name, rest)].append(profile)
    enclaves = (Enclave(path, (Profiles(tuple(own)),)) for path, own in profiles.items())
    return Policy(tuple(enclaves)), moves


class WideRule(NamedTuple):
    """A wildcard that matches more names than were used."""

    rule: Right
    """The rule with the wildcard."""
    used: tuple[Right, ...]
    """Observed rights that the wildcard allows."""
    replacement: tuple[Right, ...]
    """Exact rights that replace the wildcard, if no other rule of the enclave states them."""


@shows(
    *("enclave", "observed_at_all", "allowed", "observed", "remaining", "ratio"),
    *("never_observed", "kept_for_every_node", "wildcards", "in_part", "not_allowed"),
)
@dataclass(frozen=True, slots=True)
class EnclaveUse:
    """The comparison of an enclave's rights with its observed rights."""

    enclave: str
    """Path of the enclave."""
    observed_at_all: bool
    """Whether the enclave was observed; an enclave that was not observed does not change."""
    never_observed: tuple[Right, ...]
    """Rights that were never observed and are therefore removed."""
    kept_for_every_node: tuple[Right, ...]
    """Rights that were not observed, but stay because every node needs them."""
    wildcards: tuple[WideRule, ...]
    """Wildcards that match more names than were used."""
    in_part: tuple[Right, ...]
    """Rights that stay although only a part of them was observed, such as the feedback of an
    action, and observed wildcards that the policy allows only in part."""
    not_allowed: tuple[Right, ...]
    """Rights that were observed, but that the policy does not allow."""
    allowed: int
    """Number of pairs (right, name) that the policy allows."""
    observed: int
    """Number of allowed pairs that were observed."""
    remaining: int
    """Number of allowed pairs that the narrowed policy keeps."""

    @property
    def ratio(self) -> float | None:
        """Over-privilege: allowed pairs divided by observed pairs; null without observed pairs."""
        return self.allowed / self.observed if self.observed else None

    @property
    def is_as_observed(self) -> bool:
        """Whether the enclave was observed, and its use does not differ from its rights."""
        return self.observed_at_all and not self.differing()

    def differing(self) -> tuple[Right, ...]:
        """Return the rights whose observed use differs: unused, used in part, or not allowed."""
        wide = (wildcard.rule for wildcard in self.wildcards)
        return (*self.never_observed, *wide, *self.in_part, *self.not_allowed)


@dataclass(frozen=True, slots=True)
class MinimizedPolicy:
    """The narrowed policy without includes, and a comparison for each enclave."""

    policy: Policy
    uses: tuple[EnclaveUse, ...]


def minimize(
    policy: Policy, observed: Iterable[Right], common: Sequence[Group] = ()
) -> MinimizedPolicy:
    """Return ``policy``, narrowed to the ALLOW rights in ``observed``.

    Every DENY stays.  ``common`` are the rights that every node needs.  If the policy allows these
    rights to a node with a profile, they stay even if they were not observed.
    """
    observed = frozenset(observed)
    used = join_actions(right for right in observed if right.qualifier is ALLOW)
    observed_denials = Rules(right for right in observed if right.qualifier is DENY)
    by_enclave: dict[str, set[Right]] = defaultdict(set)
    for right in used:
        by_enclave[right.enclave].add(right)
    needed = (
        right for enclave in policy.enclaves for right in _common_rights_of_nodes(enclave, common)
    )
    names = _KnownNames((policy_rights(policy), used, needed))
    enclaves, uses = [], []
    for enclave in policy.enclaves:
        enclave, use = _Narrowing(
            enclave, frozenset(by_enclave.get(enclave.path, ())), observed_denials, common, names
        ).result()
        enclaves.append(enclave)
        uses.append(use)
    narrowed = replace(policy, enclaves=tuple(enclaves))
    return MinimizedPolicy(_protected_as_before(policy, narrowed), tuple(uses))


def _protected_as_before(before: Policy, after: Policy) -> Policy:
    """Return ``after`` with the protection levels that ``before`` stated only at removed names.

    A level that one enclave states applies to all enclaves.  So other enclaves that keep a right to
    the name now have to state this level.
    """
    known = {(e.kind, e.name, e.level) for e in stated_protections(after.enclaves)}
    gone = {(e.kind, e.name, e.level) for e in stated_protections(before.enclaves)} - known
    if not gone:
        return after
    names = Names.by_key((right.kind, right.name) for right in policy_rights(after))
    levels: dict[tuple[str, str], Level] = {}
    for kind, name, level in sorted(gone):
        met = list(names[kind].overlapping(name)) if kind in names else []
        # A wildcard gets the level only if no right to the name itself is left.
        for kept in [e for e in met if covers(name, e)] or met:
            levels[kind, kept] = max(level, levels.get((kind, kept), level), key=list(Level).index)

    def groups(group: Group, profile: Profile) -> Iterator[Group]:
        by_level: dict[Level | None, list[str]] = {}
        for name in group.names:
            fqn = expand(name, profile.ns, profile.node)
            level = group.protect or levels.get((group.kind, fqn))
            by_level.setdefault(level, []).append(name)
        for level, names in by_level.items():
            yield replace(group, names=tuple(names), protect=level, lines=())

    return with_groups(after, groups)


def nodes_not_as_observed(
    policy: Policy, observed: Iterable[Policy], common: Sequence[Group] = ()
) -> dict[str, list[EnclaveUse]]:
    """Return the nodes of each enclave whose rights differ from what these nodes were seen to use.

    All nodes of an enclave have its rights, so in the comparison of whole enclaves, the rights of
    one node hide those of another.  The denials of all nodes of the enclave apply to each node.
    A wildcard for nodes states rights of every node that it matches.  It is compared with what all
    observed nodes that it matches used.  Left out are enclaves without an observed node.
    """
    nodes = policy.nodes()
    seen: dict[str, dict[str, list[Profile]]] = defaultdict(lambda: defaultdict(list))
    for enclave in (enclave for source in observed for enclave in source.enclaves):
        for profile in enclave.all_profiles():
            seen[enclave.path][profile.full_name].append(profile)
    differing = {}
    for enclave in policy.enclaves:
        of_enclave = seen[enclave.path]
        names = sorted({*nodes[enclave.path], *of_enclave})
        if len(names) == 1 or not of_enclave:
            continue
        matching = {name: [node for node in of_enclave if covers(name, node)] for name in names}
        stating = {name: [wide for wide in names if covers(wide, name)] for name in names}
        itself = {name: [name] for name in names}
        own_uses, allowed_uses = (
            _uses_of_nodes(enclave, stated, of_enclave, used, common)
            for stated, used in ((itself, matching), (stating, itself))
        )
        uses = [
            replace(own, not_allowed=allowed.not_allowed)
            for own, allowed in zip(own_uses, allowed_uses, strict=True)
        ]
        differing[enclave.path] = [use for use in uses if not use.is_as_observed]
    return differing


def _uses_of_nodes(
    enclave: Enclave,
    stated: Mapping[str, Sequence[str]],
    seen: Mapping[str, Sequence[Profile]],
    used: Mapping[str, Sequence[str]],
    common: Sequence[Group],
) -> tuple[EnclaveUse, ...]:
    """Return a comparison of the rights of each node with its use.

    ``stated`` and ``used`` map each node to the profiles in the policy that state its rights, and
    to the observed nodes whose use counts for it.
    """
    policy = Policy(tuple(_enclave_of_node(enclave, *item) for item in stated.items()))
    observed = (
        Enclave(name, (Profiles(tuple(chain.from_iterable(seen.get(n, ()) for n in nodes))),))
        for name, nodes in used.items()
    )
    return minimize(policy, policy_rights(Policy(tuple(observed))), common).uses


def _enclave_of_node(enclave: Enclave, node: str, stated: Sequence[str]) -> Enclave:
    """Return an enclave named like a node, with the rights in some profiles, and all denials."""
    profiles = (
        profile if profile.full_name in stated else only_denials(profile)
        for profile in enclave.all_profiles()
    )
    return Enclave(node, (Profiles(tuple(profiles)),))


class _KnownNames:
    """All exact names in policies and observations, by kind and sorted."""

    def __init__(self, all_rights: Iterable[Iterable[Right]]) -> None:
        by_kind: dict[str, set[str]] = defaultdict(set)
        for rights in all_rights:
            for right in join_actions(rights):
                if not is_expression(right.name):
                    by_kind[right.kind].add(right.name)
        self._names = {kind: sorted(names) for kind, names in by_kind.items()}

    def of(self, kind: str) -> Sequence[str]:
        """Return the known names of a kind (topics, services or actions)."""
        return self._names.get(kind, ())

    def matching_names(self, kind: str, expression: str) -> Iterator[str]:
        """Yield the known names that a wildcard matches."""
        names, prefix = self.of(kind), literal_prefix(expression)
        for name in names[bisect_left(names, prefix) :]:
            if not name.startswith(prefix):
                return
            if matches(expression, name):
                yield name


class _Narrowing:
    """The narrowing of one enclave to its observed rights."""

    def __init__(
        self,
        enclave: Enclave,
        observed: frozenset[Right],
        observed_denials: Rules,
        common: Sequence[Group],
        names: _KnownNames,
    ) -> None:
        self._enclave = enclave
        self._names = names
        self._observed_denials = observed_denials
        stated = policy_rights(Policy((enclave,)))
        self._stated = sorted((r for r in stated if r.qualifier is ALLOW), key=order)
        self._denied = [right for right in stated if right.qualifier is DENY]
        self._rules = Rules(stated)
        self._observed = sorted(observed, key=order)
        observed_parts = split_actions(observed)
        self._in_use = frozenset(part for part in observed_parts if self._is_usable(part))
        self._refused = join_actions(observed_parts - self._in_use)
        self._use = Rules(self._in_use)
        self._common = {
            right
            for right in _common_rights_of_nodes(enclave, common)
            if right in stated or (not is_expression(right.name) and self._is_allowed(right))
        }

    def _is_allowed(self, part: Right) -> bool:
        return self._rules.cover(part) and not self._rules.cover(part._replace(qualifier=DENY))

    def _is_usable(self, part: Right) -> bool:
        """Return whether the enclave allows a right or, if it has a wildcard, a part of it."""
        if self._is_allowed(part):
            return True
        return is_expression(part.name) and self._rules.overlaps(part)

    def result(self) -> tuple[Enclave, EnclaveUse]:
        if not self._observed:
            return self._enclave, self._use_of({*self._stated}, ())
        kept = {right for right in self._stated if self._is_unchanged(right)}
        wide = self._replaced_wildcards(kept)
        self._prove([*kept, *(right for wildcard in wide for right in wildcard.replacement)])
        replacements = {wildcard.rule: wildcard.replacement for wildcard in wide}
        return _narrowed_enclave(self._enclave, kept, replacements), self._use_of(kept, wide)

    def _use_of(self, kept_rights: set[Right], wide: Sequence[WideRule]) -> EnclaveUse:
        is_observed = bool(self._observed)
        unused = [right for right in self._stated if not self._use.overlaps(right)]
        rewritten = {wildcard.rule for wildcard in wide}
        remaining = [*kept_rights, *(right for wildcard in wide for right in wildcard.replacement)]
        in_use = self._pairs(self._in_use)
        return EnclaveUse(
            enclave=self._enclave.path,
            observed_at_all=is_observed,
            never_observed=tuple(
                r
                for r in unused
                if not is_observed or (r not in kept_rights and r not in rewritten)
            ),
            kept_for_every_node=tuple(r for r in unused if is_observed and r in kept_rights),
            wildcards=tuple(wide),
            in_part=tuple(sorted(self._in_part(kept_rights), key=order)) if is_observed else (),
            not_allowed=tuple(sorted(self._refused, key=order)),
            allowed=len(self._pairs(self._stated) | in_use),
            observed=len(in_use),
            remaining=len(self._pairs(remaining) | in_use),
        )

    def _in_part(self, kept_rights: set[Right]) -> Iterator[Right]:
        """Yield rights that were used only in part, and used wildcards allowed only in part."""
        for right in kept_rights - self._common:
            if self._use.overlaps(right) and not all(
                self._use.cover(part) or self._rules.cover(part._replace(qualifier=DENY))
                for part in parts(right)
            ):
                yield right
        for part in self._in_use:
            denials = self._rules.overlapping(part._replace(qualifier=DENY))
            if not (self._rules.cover(part) and all(map(self._observed_denials.cover, denials))):
                yield part

    # ── rules that stay, and replacements of wildcards ─────────────────────────────────────

    def _is_unchanged(self, rule: Right) -> bool:
        """Return whether a rule stays: every node needs it, or it was observed in this form."""
        if rule in self._common:
            return True
        if not is_expression(rule.name):
            return self._use.overlaps(rule)
        return any(
            is_expression(used.name)
            and (used.name == part.name or not covers(part.name, used.name))
            for part in parts(rule)
            for used in self._use.overlapping(part)
        )

    def _replaced_wildcards(self, kept_rights: set[Right]) -> tuple[WideRule, ...]:
        """Return the wildcards to replace, with the rights that replace them."""
        wide = [
            rule for rule in self._stated if is_expression(rule.name) and rule not in kept_rights
        ]
        owners: dict[Right, list[Right]] = defaultdict(list)
        for rule in wide:
            for part in parts(rule):
                owners[part].append(rule)
        rules = Rules(wide)

        def rules_that_state(right: Right) -> list[Right]:
            met = [rule for part in rules.overlapping(right) for rule in owners[part]]
            return sorted(dict.fromkeys(met), key=lambda rule: rule.right != right.right)

        used: dict[Right, list[Right]] = defaultdict(list)
        for right in join_actions(self._in_use):
            for rule in rules_that_state(right):
                used[rule].append(right)
        kept_rules = Rules(kept_rights)
        needed = split_actions((*self._in_use, *self._common))
        replacement: dict[Right, list[Right]] = defaultdict(list)
        for right in join_actions(
            p for p in needed if self._is_allowed(p) and not kept_rules.cover(p)
        ):
            replacement[rules_that_state(right)[0]].append(right)
        return tuple(
            WideRule(
                rule,
                tuple(sorted(used[rule], key=order)),
                tuple(sorted(replacement[rule], key=order)),
            )
            for rule in wide
            if rule in used or rule in replacement
        )

    def _prove(self, remaining_rights: Sequence[Right]) -> None:
        """Raise `PolicyError` if the narrowed enclave has a new right, or lacks an observed one."""
        after = Rules(remaining_rights)
        widened = [right for right in remaining_rights if not self._rules.cover(right)]
        lost = [p for p in self._in_use if self._is_allowed(p) and not after.cover(p)]
        if widened or lost:
            raise PolicyError(
                f"the enclave {self._enclave.path} cannot be narrowed",
                f"{(widened or lost)[0]} would be {'added' if widened else 'lost'}.",
                "This is a defect of sros: please report it with the policy.",
            )

    # ── counting ───────────────────────────────────────────────────────────────────────────

    def _pairs(self, rights: Iterable[Right]) -> set[_Pair]:
        """Return the pairs (right, known name) that ``rights`` allow and no rule denies."""
        rights = join_actions(rights)
        pairs: set[_Pair] = set()
        wild = False
        for right in rights:
            if is_expression(right.name):
                wild = True
                matched = self._names.matching_names(right.kind, right.name)
                pairs.update((right.right, name) for name in matched)
            else:
                pairs.add((right.right, right.name))
        if wild:
            # Wildcards of services and topics can match all parts of an action, or the parts that
            # are missing.
            pairs = self._with_actions(pairs, Rules(rights))
        if not self._denied:
            return pairs
        return {
            pair
            for pair in pairs
            if not self._rules.overlaps(Right(self._enclave.path, DENY, *pair))
        }

    def _with_actions(self, found_pairs: set[_Pair], rules: Rules) -> set[_Pair]:
        """Return the pairs, with one pair in place of all parts of a completely allowed action."""
        pairs = set(found_pairs)
        for action in ("call", "execute"):
            for name in self._names.of(KIND_OF[action]):
                whole_action = Right(self._enclave.path, ALLOW, action, name)
                if rules.cover(whole_action):
                    pairs.difference_update((part.right, part.name) for part in parts(whole_action))
                    pairs.add((action, name))
        return pairs


def _common_rights_of_nodes(enclave: Enclave, common: Sequence[Group]) -> Iterator[Right]:
    """Yield the ``common`` rights for each node that has a profile in the enclave."""
    for profile in enclave.all_profiles():
        for group in common:
            for name in group.names:
                fqn = expand(name, profile.ns, profile.node)
                for right, _ in group.rights if is_of_one_node(fqn) else ():
                    yield Right(enclave.path, ALLOW, right, fqn)


# ── the enclave with fewer rights ──────────────────────────────────────────────────────────


def _narrowed_enclave(
    enclave: Enclave, kept_rights: Set[Right], replacements: Mapping[Right, Sequence[Right]]
) -> Enclave:
    """Return ``enclave`` with its denials, ``kept_rights``, and exact names in place of wildcards.

    The names that replace a wildcard are written once, at the first occurrence of the wildcard and
    in its form: relative, private or absolute. Profiles without rules stay.
    """
    pending = dict(replacements)
    return enclave.with_profiles(
        lambda profile: _narrowed_profile(enclave.path, profile, kept_rights, pending)
    )


def _narrowed_profile(
    path: str, profile: Profile, kept_rights: Set[Right], pending: dict[Right, Sequence[Right]]
) -> Profile:
    """Return the profile with its denials, ``kept_rights`` and the replacements of other rights.

    ``pending`` maps rights to their replacements; replacements that this profile gets are removed
    from ``pending``.
    """
    statements: dict[tuple[str, str, Level | None], dict[tuple[str, Qualifier], None]] = {}
    for group in profile.groups:
        level = group.protect
        for name in group.names:
            fqn = expand(name, profile.ns, profile.node)
            for right, qualifier in group.rights:
                whole = Right(path, qualifier, right, fqn)
                if qualifier is DENY or whole in kept_rights:
                    statements.setdefault((group.kind, name, level), {})[right, qualifier] = None
                for new in pending.pop(whole, ()):
                    written = _name_written_like(new.name, name, profile)
                    statements.setdefault((new.kind, written, level), {})[new.right, ALLOW] = None
    groups: dict[tuple[str, GroupRights, Level | None], list[str]] = {}
    for (kind, name, level), rights in statements.items():
        for together in group_rights(rights):
            groups.setdefault((kind, together, level), []).append(name)
    return replace(
        profile,
        groups=tuple(
            Group(kind, rights, tuple(dict.fromkeys(names)), level)
            for (kind, rights, level), names in groups.items()
        ),
    )


def _name_written_like(fqn: str, like: str, profile: Profile) -> str:
    """Return an absolute name in the form of ``like`` (relative or private), if possible."""
    if like.startswith("/"):
        return fqn
    prefix = expand("~/" if like.startswith("~") else "", profile.ns, profile.node)
    rest = fqn.removeprefix(prefix)
    if not fqn.startswith(prefix) or not rest:
        return fqn
    return f"~/{rest}" if like.startswith("~") else rest


# ── wildcards in place of names ────────────────────────────────────────────────────────────

_DIGITS = re.compile(r"\d+")
_FEWEST_REPLACED = 3  # minimum number of names that a wildcard must replace


class WildcardProposal(NamedTuple):
    """A wildcard that could replace several names of an enclave."""

    rule: Right
    """The rule with the wildcard."""
    replaces: tuple[Right, ...]
    """Rights that the wildcard makes redundant."""
    adds: tuple[Right, ...]
    """Rights that the wildcard adds, to names in the rights of other enclaves."""
    saves: int
    """Number of bytes by which the permissions document becomes smaller."""


def propose_wildcards(
    enclave: str,
    rights: Iterable[Right],
    known_rights: Iterable[Right],
    *,
    needed: int,
    size: Callable[[Right], int],
) -> tuple[WildcardProposal, ...]:
    """Return wildcards that make an enclave's permissions ``needed`` bytes smaller.

    ``rights`` are the rights of this enclave, ``known_rights`` the rights of all enclaves. ``size``
    returns the size of a right in bytes.  Wildcards that newly allow a known name come last, and
    are used only if other wildcards do not suffice. Larger savings come before smaller ones.
    """
    allowed = [right for right in rights if right.enclave == enclave and right.qualifier is ALLOW]
    rules = Rules(allowed)
    foreign = _names_without_right(enclave, rules, known_rights)
    present = Rules(right for right in allowed if is_expression(right.name))
    # Large permissions leave out names that a wildcard matches, so replacing these names saves
    # nothing.
    listed = (right for right in allowed if not present.cover(right))
    candidates: dict[frozenset[Right], WildcardProposal] = {}
    for rule, listed_rights in _wildcard_candidates(listed).items():
        other = candidates.get(frozenset(listed_rights))
        # Of wildcards for the same names, the longest one allows the least.
        if other is None or len(rule.name) > len(other.rule.name):
            adds = tuple(sorted(_rights_matching(rule, foreign), key=order))
            saves = sum(map(size, listed_rights)) - size(rule)
            names = tuple(sorted(listed_rights, key=order))
            candidates[frozenset(listed_rights)] = WildcardProposal(rule, names, adds, saves)
    best = sorted(
        candidates.values(),
        key=lambda proposal: (len(proposal.adds), -proposal.saves, order(proposal.rule)),
    )
    chosen: list[WildcardProposal] = []
    replaced: set[Right] = set()
    for proposal in best:
        if needed <= 0:
            break
        names = tuple(right for right in proposal.replaces if right not in replaced)
        saves = sum(map(size, names)) - size(proposal.rule)
        if len(names) < _FEWEST_REPLACED or saves <= 0:
            continue
        chosen.append(WildcardProposal(proposal.rule, names, proposal.adds, saves))
        replaced.update(names)
        needed -= saves
    return tuple(chosen)


def _wildcard_candidates(rights: Iterable[Right]) -> dict[Right, list[Right]]:
    """Map possible wildcards to the rights that they replace, at least `_FEWEST_REPLACED`."""
    rights_by_wildcard: dict[Right, list[Right]] = defaultdict(list)
    for right in rights:
        if right.name.startswith("/") and not is_expression(right.name):
            for expression in set(_wider_names(right.name)):
                rights_by_wildcard[right._replace(name=expression)].append(right)
    return {
        rule: names for rule, names in rights_by_wildcard.items() if len(names) >= _FEWEST_REPLACED
    }


def _wider_names(name: str) -> Iterator[str]:
    """Yield wildcards for a name: ``*`` after a namespace (not "/"), or in place of numbers."""
    tokens = name.split("/")[1:-1]
    for depth in range(1, len(tokens) + 1):
        yield "/" + "/".join((*tokens[:depth], "*"))
    numbers = list(_DIGITS.finditer(name))
    for number in numbers:
        yield f"{name[: number.start()]}*{name[number.end() :]}"
    if len(numbers) > 1:
        yield _DIGITS.sub("*", name)


def _names_without_right(
    enclave: str, own_rules: Rules, known_rights: Iterable[Right]
) -> dict[str, list[str]]:
    """Map rights to the known names for which the enclave lacks the right.

    An action counts as the services and topics of which it consists.
    """
    by_service: dict[bool, set[str]] = {True: set(), False: set()}
    for part in split_actions(known_rights):
        if not is_expression(part.name):
            by_service[part.right in ("request", "reply")].add(part.name)
    return {
        right: sorted(
            name
            for name in by_service[right in ("request", "reply")]
            if not own_rules.cover(Right(enclave, ALLOW, right, name))
        )
        for right in ("publish", "subscribe", "request", "reply")
    }


def _rights_matching(rule: Right, names_by_right: dict[str, list[str]]) -> Iterator[Right]:
    """Yield the rights to names that a rule with a wildcard matches."""
    for part in parts(rule):
        match = compiled(part.name).match
        for name in names_by_right[part.right]:
            if match(name):
                yield part._replace(name=name)
