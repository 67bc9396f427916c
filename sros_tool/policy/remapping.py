"""Remapping of the names in a policy, as ROS remaps the names of nodes.

A rule has the form of ``--ros-args -r`` (ROS 2 design, "Static Remapping"): ``[NODE:]FROM:=TO``,
where ``__node`` and ``__ns`` stand for the name and the namespace of a node.  FROM and TO are
relative to the node unless they are absolute, and the first rule that fits a name applies.  NODE is
the name of a node after rules for ``__node`` were applied, except in these rules themselves (rcl,
node.c).  The name of an action is remapped since rcl_action 10.0.2, and on Jazzy since 9.2.8 (but
not in each build that states this version); otherwise, only the names of the action's topics and
services are remapped (rcl, pull request 1170), which every version does.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from shlex import quote
from typing import NamedTuple

from sros_tool.errors import Note, UsageError
from sros_tool.names import ACTION_PARTS, check_namespace, expand, expression_problem, is_expression
from sros_tool.policy.model import ALLOW, DENY, PEER_RIGHT, Group, Policy, Profile, Qualifier
from sros_tool.policy.patterns import Names, literal_prefix, matches, renamed_matches
from sros_tool.policy.rights import (
    NodeName,
    Right,
    Rules,
    is_of_every_node,
    node_of,
    placed_rights,
    policy_rights,
    profile_rights,
)
from sros_tool.wording import enumerated, first_few

_RULE = re.compile(r"(?:([A-Za-z_]\w*):)?([^:=]+):=([^:=]+)")
_NODE_NAME = re.compile(r"[A-Za-z_]\w*", re.ASCII)
_NODE, _NAMESPACE = "__node", "__ns"
_EMPTY_POLICY = Policy(())
_MOST_SHOWN = 3
_MOST_OWN_NAMES = 8


class Remapping(NamedTuple):
    """A rule that remaps a name for the nodes named ``node``; "" stands for all nodes."""

    node: str
    old: str
    new: str

    @property
    def renames_node(self) -> bool:
        """Whether the rule changes the name of a node."""
        return self.old == _NODE

    @property
    def depends_on_node(self) -> bool:
        """Whether the rule has names that differ from node to node."""
        return self.renames_node or "~" in (self.old[0], self.new[0])

    def __str__(self) -> str:
        return f"{self.node}{':' * bool(self.node)}{self.old}:={self.new}"


class UsedRule(NamedTuple):
    """A use of a rule: it changed the name of ``node``, or a name in a group of the node.

    ``kind`` is the kind of the group, or "" if the name of the node changed.  ``old`` and ``new``
    are the full names before and after the change.  If the name of the node changes, so do all
    names below it, which have no uses of their own.
    """

    rule: Remapping
    node: str
    kind: str = ""
    old: str = ""
    new: str = ""

    def names_denied_by(self, denied: str, kind: str) -> Iterator[tuple[str, str]]:
        """Yield the changed names that a DENY of ``denied`` matches, each with its new name."""
        if not self.kind:
            yield from _renamed_with_node(denied, self.old, self.new)
        elif self.kind == kind:
            yield from renamed_matches(denied, self.old, self.new)


def _renamed_with_node(names: str, old: str, new: str) -> Iterator[tuple[str, str]]:
    """Yield the ``names`` that change if the node ``old`` is ``new``, each with its new name."""
    yield from renamed_matches(names, old, new)
    yield from renamed_matches(names, f"{old}/*", f"{new}/*")


def parse_remapping(text: str) -> Remapping:
    """Return the rule in a text such as ``image:=/left/image`` or ``driver:__node:=left_driver``.

    Raises:
        UsageError: the text is not a rule.
        InvalidNameError: the rule has a namespace that is not valid.
    """
    rule = _RULE.fullmatch(text)
    if not rule:
        raise UsageError(
            f"'{text}' is not a remapping", "", "Write it as [NODE:]FROM:=TO, such as image:=/cam."
        )
    node, old, new = rule[1] or "", rule[2], rule[3]
    if old == _NODE:
        problem = "" if _NODE_NAME.fullmatch(new) else f"'{new}' is not the name of a node."
    elif old == _NAMESPACE:
        problem = "It has a wildcard." if is_expression(new) else ""
        new = check_namespace(new)
    else:
        problem = next(filter(None, map(expression_problem, (old, new))), "")
        if not problem and (is_expression(old) or is_expression(new)):
            problem = "A name has a wildcard."
    if problem:
        raise UsageError(f"'{text}' is not a remapping", problem, "Write it as image:=/left/image.")
    return Remapping(node, old, new)


def parse_remapping_of_names(text: str) -> Remapping:
    """Return the remapping rule in a text, for names that belong to no node.

    The names in requirements are such names.

    Raises:
        UsageError: (or another error of `parse_remapping`) the text is not such a rule.
    """
    rule = parse_remapping(text)
    problem = remedy = ""
    if rule.old == _NAMESPACE:
        problem = "It moves names, but not their enclaves."
        remedy = _namespace_advice(rule)
    elif rule.depends_on_node:
        if not rule.node:
            problem, remedy = "It does not say for which node.", f"Write it as NODE:{rule}."
    elif rule.node:
        problem = f"Other nodes than {rule.node} may keep the name."
        remedy = f"For all nodes, write {rule._replace(node='')}; otherwise edit the requirements."
    if problem:
        raise UsageError(f"requirements cannot be remapped by {rule}", problem, remedy)
    return rule


def _namespace_advice(rule: Remapping) -> str:
    """Return what to do about requirements after a rule for a namespace."""
    return (
        f"Merge the policy with --namespace {quote(rule.new)} in place of this rule, and check "
        "with the same option; or change the names in a copy of the requirements."
    )


def remapped_name(name: str, ns: str, rules: Iterable[Remapping]) -> list[str]:
    """Return the full names that ``rules`` give to the full name ``name``, for nodes in ``ns``.

    The ``rules`` are results of `parse_remapping_of_names`.  A wildcard that matches an old name
    stays, and the new name is added.
    """
    rules = tuple(rules)
    names = [name]
    for rule in rules:
        own, new = expand("~", ns, rule.node), expand("~", ns, rule.new)
        if rule.old != _NODE:
            continue
        if f"{name}/".startswith(f"{own}/"):
            names = [new + name.removeprefix(own)]
            break
        added = [new_name for _, new_name in _renamed_with_node(name, own, new)]
        names += [new_name for new_name in added if not Names(names).cover(new_name)]
    result = []
    for full in names:
        new_names: dict[str, str] = {}
        for rule in rules:
            if rule.old != _NODE and matches(full, old := expand(rule.old, ns, rule.node)):
                new_names.setdefault(old, expand(rule.new, ns, rule.node))
        kept = [full] if is_expression(full) or not new_names else []
        result += [*kept, *new_names.values()]
    return list(dict.fromkeys(result))


def has_new_name(rule: Remapping, names: Iterable[str], namespaces: Iterable[str]) -> bool:
    """Return whether full ``names`` contain the new name of a rule, in any of ``namespaces``.

    The name of a node counts as contained if a name is below it.
    """
    of_node = rule.old == _NODE
    new = {
        expand("~" if of_node else rule.new, ns, rule.new if of_node else rule.node)
        for ns in namespaces
    }
    return any(
        name == there or (of_node and name.startswith(f"{there}/"))
        for name in names
        for there in new
    )


def renamed_action_text(rule: Remapping) -> str:
    """Return a clause on how every release of ROS starts a node with a renamed action."""
    parts = (
        f"-r {quote(str(rule._replace(old=rule.old + part, new=rule.new + part)))}"
        for _, part in ACTION_PARTS["call"]
    )
    return (
        f"start its nodes with `--ros-args {' '.join(parts)}`, which works with every release of "
        f"ROS. `-r {quote(str(rule))}` works only since Kilted, and with late updates of Jazzy."
    )


def remapped_policies(
    policies: Iterable[Policy],
    texts: Iterable[str],
    file: Policy = _EMPTY_POLICY,
    left_out: Iterable[Policy] = (),
) -> tuple[list[Policy], list[Note]]:
    """Return remapped policies, and notes on changes of the nodes' rights.

    ``texts`` are rules.  There is also a note for each DENY in ``file``, the policy to merge into,
    that denies an old name but not its new name, and for each node that keeps other names there.
    ``left_out`` are policies with nodes that --node leaves out, for the error.

    Raises:
        UsageError: (or another error of `parse_remapping`) a text is not a rule, or a rule changes
            nothing.
    """
    rules = [parse_remapping(text) for text in texts]
    policies = tuple(policies)
    first_pass = [remapped_policy(policy, rules) for policy in policies]
    moved = {use for _, uses in first_pass for use in uses}
    stated = {right for policy, _ in first_pass for right in policy_rights(policy)}
    remapped = [remapped_policy(policy, rules, moved, stated) for policy in policies]
    notes = []
    for rule in rules:
        uses = {use for _, of_policy in remapped for use in of_policy if use.rule == rule}
        if not uses:
            raise _unused_rule_error(rule, rules, policies, file, left_out)
        nodes = sorted({use.node for use in uses})
        if rule.old == _NODE and len(nodes) > 1:
            text = (
                f"--remap {rule} gives the same name to the nodes {enumerated(nodes)}. Choose the "
                f"node with --node, or write its name, as in {nodes[0]}:{rule}."
            )
            notes.append(Note("merge.remapped-nodes", text))
        if rule.old != _NAMESPACE and any(use.kind == "actions" for use in uses):
            text = f"--remap {rule} renames an action: {renamed_action_text(rule)}"
            notes.append(Note("merge.remapped-action", text))
    result = [policy for policy, _ in remapped]
    notes += _notes_on_requirements(policies, rules, file)
    notes += _notes_on_old_names(file, result, moved)
    return result, [*notes, *_notes_on_earlier_names(file, result, moved)]


def _unused_rule_error(
    rule: Remapping,
    rules: Sequence[Remapping],
    policies: Iterable[Policy],
    file: Policy,
    left_out: Iterable[Policy],
) -> UsageError:
    """Return the error for a rule that changes nothing, with the reason."""

    def users(of: Iterable[Policy], rules: Sequence[Remapping]) -> list[str]:
        uses = {use for policy in of for use in remapped_policy(policy, rules)[1]}
        return sorted({use.node for use in uses if use.rule == rule})

    policies = tuple(policies)
    for other in rules:
        if users(policies, [each for each in rules if each != other]):
            example = f", as in {rule._replace(node=other.new)}" if other.old == _NODE else ""
            return UsageError(
                f"--remap {rule} changes nothing",
                f"The rule {other} applies first.",
                f"Write the node and the name as they are after that rule{example}, or leave out "
                "one of the two rules.",
            )
    if nodes := users(left_out, rules):
        return UsageError(
            f"--remap {rule} changes nothing",
            f"It is for {enumerated(nodes)}, which --node leaves out.",
            f"Add --node {nodes[0]}, or leave out the rule.",
        )
    if rule.renames_node and (below := _names_below(rule.node, policies)):
        options = (f"--remap {name}:={_with_node(name, rule)}" for name in below)
        return UsageError(
            f"--remap {rule} matches no node in the policies to merge",
            f"They have no node {rule.node}, and only use names below it: {enumerated(below)}.",
            f"Remap each name: `{' '.join(options)}`.",
        )
    renamed = {(u.kind, u.old) for each in policies for u in remapped_policy(each, rules)[1]}
    from difflib import get_close_matches  # imported only for this error

    nodes = sorted({profile.node for profile in _profiles(policies)})
    if rule.node and rule.node not in nodes:
        similar, own = get_close_matches(rule.node, nodes, _MOST_SHOWN), nodes
    else:
        known = {*((right.kind, right.name) for right in policy_rights(file)), *renamed}
        similar = _similar_names(rule, policies, file, known)
        own = _own_names(rule, policies, file, known)
    if similar:
        names = " or ".join(similar)
        reason = f"Perhaps the right name is {names}, for example after an update of a package."
    else:
        names = first_few(own, _MOST_OWN_NAMES) or "no names"
        reason = f"They have {names}. Perhaps an update of a package changed the name."
    return UsageError(
        f"--remap {rule} matches no name or node in the policies to merge",
        reason,
        "Write the name, and the node if you state one, as in the policy.",
    )


def _names_below(node: str, policies: Iterable[Policy]) -> list[str]:
    """Return the names in policies, as written and without wildcards, below the name of a node."""
    names = {
        name
        for policy in policies
        for enclave in policy.enclaves
        for profile in enclave.all_profiles()
        for group in profile.groups
        for name in group.names
        if f"/{node}/" in f"/{name}" and not is_expression(name)
    }
    return sorted(names)


def _with_node(name: str, rule: Remapping) -> str:
    """Return a name below the old node of a rule with the rule's new node."""
    return f"/{name}".replace(f"/{rule.node}/", f"/{rule.new}/", 1)[1:]


def _profiles(policies: Iterable[Policy]) -> list[Profile]:
    return [p for policy in policies for enclave in policy.enclaves for p in enclave.all_profiles()]


def _kinds_of_new_name(rule: Remapping, file: Policy) -> set[str]:
    """Return the kinds that the new name of a rule has in ``file``, the policy to merge into."""
    end = f"/{rule.new.strip('/')}/"
    return {right.kind for right in policy_rights(file) if f"{right.name}/".endswith(end)}


def _names_meant(rule: Remapping, policies: Iterable[Policy]) -> Iterator[tuple[str, str, str]]:
    """Yield the kind, the name as written and the full name of all names that a rule may mean."""
    for profile in _profiles(policies):
        for group in profile.groups if rule.node in ("", profile.node) else ():
            for name in group.names:
                if not is_expression(name):
                    yield group.kind, name, expand(name, profile.ns, profile.node)


def _similar_names(
    rule: Remapping,
    policies: Iterable[Policy],
    file: Policy,
    known: Collection[tuple[str, str]],
) -> list[str]:
    """Return the names in policies that are most similar to the old name of a rule.

    First are names of the kind that the new name has in ``file``, the policy to merge into, then
    names that are not ``known``: those in ``file``, and those that another rule renames.
    """
    from difflib import get_close_matches  # imported only for this error

    kinds = _kinds_of_new_name(rule, file)
    ranks: dict[str, tuple[bool, bool]] = {}
    for kind, name, full in _names_meant(rule, policies):
        rank = (kind not in kinds, (kind, full) in known)
        ranks[name] = min(rank, ranks.get(name, rank))
    similar = get_close_matches(rule.old, ranks, len(ranks) or 1)
    return sorted(similar, key=ranks.__getitem__)[:_MOST_SHOWN]


def _own_names(
    rule: Remapping,
    policies: Iterable[Policy],
    file: Policy,
    known: Collection[tuple[str, str]],
) -> list[str]:
    """Return the names in policies that the old name of a rule may be now, each with its kind.

    Names that every node has are left out.  If the kind of the new name is known from ``file``,
    and there are names of this kind, so are names of other kinds.  Last are names that are
    ``known`` (see `_similar_names`).
    """
    kinds = _kinds_of_new_name(rule, file)
    names = [name for name in _names_meant(rule, policies) if not is_of_every_node(name[2])]
    names = [name for name in names if name[0] in kinds] or names
    names.sort(key=lambda name: (name[0], name[2]) in known)
    return list(dict.fromkeys(f"{kind.removesuffix('s')} {name}" for kind, name, _ in names))


def _moves_with_node(use: UsedRule, old: str, new: str) -> bool:
    """Return whether a name only changes as it does if the node ``old`` is renamed to ``new``."""
    below = use.old.removeprefix(f"{old}/")
    return below != use.old and use.new == f"{new}/{below}"


def _notes_on_requirements(
    policies: Iterable[Policy], rules: Iterable[Remapping], file: Policy
) -> Iterator[Note]:
    """Yield notes on names that no node of the policies to merge has any more.

    A requirement for such a name would hold, regardless of who may use the new name.  `sros check`
    can remap the names in requirements, but not by a rule for a namespace.
    """
    for rule in rules:
        if rule.old == _NAMESPACE:
            text = (
                f"requirements cannot follow --remap {rule}, which moves names, but not their "
                f"enclaves. {_namespace_advice(rule)}"
            )
            yield Note("merge.requirements-of-old-namespace", text)
    of_names = [rule for rule in rules if rule.old != _NAMESPACE]
    policies = tuple(policies)
    remapped = [remapped_policy(policy, of_names) for policy in policies]
    before, after = (
        {
            (right.kind, right.right, right.name)
            for policy in side
            for right in policy_rights(policy)
            if right.qualifier is not DENY
        }
        for side in (policies, [policy for policy, _ in remapped])
    )
    kept = {(kind, name) for kind, _, name in after}
    moved = {name for kind, _, name in before if (kind, name) not in kept}
    nodes = {use.old: use.new for _, uses in remapped for use in uses if not use.kind}
    # A requirement may also name what is below a node's name, but is in no right.
    gone = {
        next((f"{node}/*" for node in nodes if name.startswith(f"{node}/")), name) for name in moved
    }
    if gone:
        # These rules are for `parse_remapping_of_names`, where no node is named.
        options = {
            str(use.rule._replace(node=use.node if use.rule.depends_on_node else ""))
            for _, uses in remapped
            for use in uses
            if f"{use.old}/*" in gone or any(matches(name, use.old) for name in gone)
            if not any(_moves_with_node(use, *node) for node in nodes.items())
        }
        words = " ".join(f"--remap {quote(option)}" for option in sorted(options))
        text = (
            f"requirements that name {first_few(sorted(gone), _MOST_SHOWN)} protect only the old "
            f"name{'s' * (len(gone) > 1)}, unless you check them with the same remapping: `sros "
            f"check POLICY --requirements FILE {words}`, with --namespace as in the merge. "
            f"FILE has only the requirements of {_merged_text(policies, remapped)}: check those of "
            "other packages by a command of their own."
        )
        if users := _users_of(gone, file):
            text += (
                f" In POLICY, {first_few(users, _MOST_SHOWN)} "
                f"keep{'s' * (len(users) == 1)} an old name: also check the requirements "
                f"for {'them' if len(users) > 1 else 'it'}, without this --remap."
            )
        yield Note("merge.requirements-of-old-names", text)
    split = [
        f"{name} ({right})"
        for kind, right, name in sorted(before - after)
        if (kind, PEER_RIGHT[right], name) in after
    ]
    if split:
        text = (
            f"the remapping leaves no right to {first_few(split, _MOST_SHOWN)}, but other nodes "
            "keep the old name, so requirements with the old name may protect nothing. If these "
            "nodes are to use the new name, add a --remap for them, too. Otherwise, write both "
            "names into a copy of the requirements."
        )
        yield Note("merge.requirements-of-split-names", text)


def _merged_text(
    policies: Iterable[Policy], remapped: Iterable[tuple[Policy, Collection[UsedRule]]]
) -> str:
    """Return a text for the package whose policies have names that changed."""
    changed = [policy for policy, (_, uses) in zip(policies, remapped, strict=True) if uses]
    files = sorted({Path(policy.file).name for policy in changed if policy.file})
    return "the merged package" + (f" ({enumerated(files)})" if files else "")


def _users_of(names: Collection[str], policy: Policy) -> list[str]:
    """Return the nodes of a policy that have one of the names, or a right to exactly one of them.

    A name that ends with ``/*`` stands for a node.
    """
    users = {
        profile.full_name
        for enclave in policy.enclaves
        for profile in enclave.all_profiles()
        if f"{profile.full_name}/*" in names
        or any(
            right.qualifier is not DENY and right.name in names
            for right in profile_rights(enclave.path, profile)
        )
    }
    return sorted(users)


def _notes_on_old_names(
    file: Policy, remapped: Iterable[Policy], moved_names: Iterable[UsedRule]
) -> Iterator[Note]:
    """Yield a note for each DENY in ``file`` of an old name whose new name no policy denies."""
    denials = [
        placed
        for enclave in file.enclaves
        for placed in placed_rights(enclave)
        if placed.right.qualifier is DENY
    ]
    if not denials:
        return
    rules = Rules(right for policy in (file, *remapped) for right in policy_rights(policy))
    for denied in denials:
        right = denied.right
        names = {
            pair for use in moved_names for pair in use.names_denied_by(right.name, right.kind)
        }
        for old, new in sorted(names):
            if not rules.cover(right._replace(name=new)):
                text = (
                    f"{right} at {denied.source} does not change, and does not apply to {new}, "
                    f"the new name of {old}. To deny the new name, too, add it there."
                )
                yield Note("merge.old-name-denied", text)


def _notes_on_earlier_names(
    file: Policy, remapped: Iterable[Policy], moved_names: Iterable[UsedRule]
) -> Iterator[Note]:
    """Yield a note for each node with a right that gets new names, but has other names in ``file``.

    An earlier merge with other rules perhaps added the other names: a merge removes no name.
    """
    before, after = (_rights_by_node(side) for side in ([file], remapped))
    new_names = {(use.kind, use.new) for use in moved_names}
    for node in sorted(before.keys() & after.keys()):
        present, merged = Rules(before[node]), Rules(after[node])
        words = {
            right.right
            for right in after[node]
            if right.qualifier is not DENY
            and (right.kind, right.name) in new_names
            and not present.cover(right)
        }
        kept = [
            right.describe()
            for right in sorted(before[node])
            if right.right in words and right.qualifier is not DENY and not merged.cover(right)
        ]
        if kept:
            text = (
                f"the node {expand('~', *node)} keeps rights that it does not have in the "
                f"policies to merge: {first_few(kept, _MOST_SHOWN)}. If a merge with another "
                "--remap added them, remove them by hand."
            )
            yield Note("merge.earlier-names", text)


def _rights_by_node(policies: Iterable[Policy]) -> dict[NodeName, set[Right]]:
    """Map the nodes of policies to their rights, without the enclave."""
    rights: dict[NodeName, set[Right]] = defaultdict(set)
    for policy in policies:
        for enclave in policy.enclaves:
            for profile in enclave.all_profiles():
                rights[node_of(profile)].update(profile_rights("", profile))
    return rights


def remapped_policy(
    policy: Policy,
    rules: Sequence[Remapping],
    moved_names: Collection[UsedRule] = (),
    stated: Iterable[Right] = (),
) -> tuple[Policy, set[UsedRule]]:
    """Return a policy with remapped names, and the uses of the rules.

    A wildcard that matches an old name stays, and the new name is added to its group.  The new
    names in ``moved_names``, of any node, are also added to each DENY that matches the old name. An
    old name stays denied if its enclave would allow the name, by the rights ``stated`` by all
    policies after remapping.  A literal right to a new name of some node does not count.
    """
    used: set[UsedRule] = set()
    new_names = {(use.kind, use.new) for use in moved_names}
    new_nodes = tuple(f"{use.new}/" for use in moved_names if not use.kind)
    stated = tuple(stated)
    given = {
        (right.right, right.name)
        for right in stated
        if right.qualifier is ALLOW and (right.kind, right.name) in new_names
    }
    other = Rules(
        right
        for right in stated
        if is_expression(right.name)
        or not ((right.kind, right.name) in new_names or right.name.startswith(new_nodes))
    )

    def remapped(enclave: str, profile: Profile) -> Profile:
        renamed = [rule for rule in rules if rule.old == _NODE and rule.node in ("", profile.node)]
        node = renamed[0].new if renamed else profile.node
        of_node = [rule for rule in rules if rule.old != _NODE and rule.node in ("", node)]
        moved = [rule for rule in of_node if rule.old == _NAMESPACE]
        ns = moved[0].new if moved else profile.ns
        own, new = profile.full_name, expand("~", ns, node)
        used.update(UsedRule(rule, profile.node, "", own, new) for rule in renamed[:1] + moved[:1])
        of_names = [rule for rule in of_node if rule.old != _NAMESPACE]
        new_profile = replace(profile, ns=ns, node=node)
        groups = []
        for group in profile.groups:
            groups.append(_remapped_group(group, of_names, profile, new_profile, used))
            stated_names = _full_names(group, profile)
            present = _full_names(groups[-1], new_profile)
            if ns != profile.ns:
                used.update(
                    UsedRule(moved[0], profile.node, group.kind, old, new)
                    for name, old in zip(group.names, stated_names, strict=True)
                    if name[0] not in "~/" and (new := expand(name, ns, node)) in present
                )
            otherwise_allowed = {
                name
                for name in stated_names
                for right, qualifier in group.rights
                if qualifier is DENY and other.overlaps(Right(enclave, ALLOW, right, name))
            }
            groups += _more_denials(
                group, stated_names, present, moved_names, otherwise_allowed, given
            )
        return replace(new_profile, groups=tuple(groups))

    enclaves = tuple(
        enclave.with_profiles(partial(remapped, enclave.path)) for enclave in policy.enclaves
    )
    return replace(policy, enclaves=enclaves), used


def _full_names(group: Group, profile: Profile) -> list[str]:
    return [expand(name, profile.ns, profile.node) for name in group.names]


def _remapped_group(
    group: Group,
    rules: Iterable[Remapping],
    profile: Profile,
    new_profile: Profile,
    used: set[UsedRule],
) -> Group:
    """Return a node's group with remapped names, and add the uses of rules to ``used``.

    The namespace and the node are already the new ones in ``new_profile``.
    """
    ns, node = new_profile.ns, new_profile.node
    by_name: dict[str, Remapping] = {}
    for rule in rules:
        by_name.setdefault(expand(rule.old, ns, node), rule)

    def new_names(name: str) -> Iterator[str]:
        full, before = expand(name, ns, node), expand(name, profile.ns, profile.node)
        begin, begin_before = literal_prefix(full), literal_prefix(before)
        fitting = [rule for old, rule in by_name.items() if matches(full, old)]
        for rule in fitting:
            old = begin_before + expand(rule.old, ns, node).removeprefix(begin)
            used.add(UsedRule(rule, node, group.kind, old, expand(rule.new, ns, node)))
        if not fitting or is_expression(full):
            yield name
        yield from (rule.new for rule in fitting)

    pairs = [
        (new, group.source_of(index).line)
        for index, name in enumerate(group.names)
        for new in new_names(name)
    ]
    names = tuple(name for name, _ in pairs)
    lines = tuple(line for _, line in pairs) if group.lines else ()
    return replace(group, names=names, lines=lines)


def _more_denials(
    group: Group,
    stated: Sequence[str],
    present: Collection[str],
    moved_names: Iterable[UsedRule],
    otherwise_allowed: Collection[str],
    given: Collection[tuple[str, str]],
) -> Iterator[Group]:
    """Yield groups with the additional names, if any, that a DENY of ``group`` must deny.

    These are the new names in ``moved_names``, and the old names in ``otherwise_allowed``.
    An old name is left out for the rights that some node has to it as a new name: ``given`` has
    these rights and names.
    ``stated`` and ``present`` are the full names of the group before and after remapping.
    """
    denials = tuple(right for right in group.rights if right[1] is DENY)
    if not denials:
        return
    denied = Names(present)
    added: dict[tuple[tuple[str, Qualifier], ...], dict[str, int]] = defaultdict(dict)
    for use in sorted(moved_names, key=lambda use: (use.old, use.new)):
        for index, full in enumerate(stated):
            for _, new in use.names_denied_by(full, group.kind):
                if not denied.cover(new):
                    added[denials].setdefault(new, group.source_of(index).line)
    for index, full in enumerate(stated):
        rights = tuple(denial for denial in denials if (denial[0], full) not in given)
        if rights and full in otherwise_allowed and full not in present:
            added[rights].setdefault(full, group.source_of(index).line)
    for rights, lines in added.items():
        yield replace(group, rights=rights, names=tuple(lines), lines=tuple(lines.values()))
