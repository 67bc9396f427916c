"""Add policy lines to an answer, and for a denial the smallest change or the remedy.

The smallest change of the policy adds a right only if no right covers the question, and removes a
denial only if the denial prevents the access; the decision engine checks the change.

If the policy is not the cause, the command in the remedy repairs the fault in the keystore.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterable, Iterator
from collections.abc import Set as AbstractSet
from contextlib import suppress
from functools import cache
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, NamedTuple

from lxml import etree

from sros_tool.dds.decision.access import AccessVerb
from sros_tool.dds.governance import parse_governance
from sros_tool.dds.permissions import parse_permissions
from sros_tool.errors import SrosError
from sros_tool.explain.answer import (
    Answer,
    Evaluator,
    GroupEdit,
    PolicyChange,
    Provenance,
    Question,
    deciding_lines,
    lines_of_right,
    recorded_policy_digest,
)
from sros_tool.faults import FAULTS, NOT_IN_THE_FILE, REPLACE, Fault, remedy_in_original_keystore
from sros_tool.files import policies_dir
from sros_tool.keystore.layout import (
    GOVERNANCE_FILE,
    IDENTITY_CA_FILE,
    LEDGER,
    PERMISSIONS_FILE,
    enclave_path,
    is_original_keystore,
    is_own_copy,
    key_on_robot,
    remedy_in_closed_robot,
)
from sros_tool.keystore.participant import LoadedEnclave, plan_enclave
from sros_tool.names import GLOBAL_TOPICS, NODE_SERVICES, is_expression, nodes_served
from sros_tool.policy.model import ALLOW, DENY, Enclave, Group, Policy, Profile, Profiles, Source
from sros_tool.policy.rights import Right, action_right, order, profile_rights
from sros_tool.spelling import is_spelled_alike
from sros_tool.terminal import log_step

if TYPE_CHECKING:
    from sros_tool.graph.learn import CommonParts


def explain(evaluator: Evaluator, question: Question) -> Answer:
    """Return the answer with policy lines and, for a denial, a change of the policy or a remedy."""
    answer, enclave = evaluator.answer(question), evaluator.enclave
    log_step(
        "INFO",
        __name__,
        "asked %s: %s of enclave %s: %s",
        evaluator.vendor.title,
        " ".join(filter(None, (question.word, question.name))),
        enclave.name,
        answer.outcome,
    )
    keystore = enclave.keystore
    known = keystore is not None and keystore.has(LEDGER)
    recorded = recorded_policy_digest(keystore, enclave.signed) if keystore and known else ""
    answer = answer._replace(
        lines=deciding_lines(enclave.policy, answer) if enclave.policy else (),
        provenance=_provenance(enclave, recorded),
        policy_sha256=recorded,
    )
    if answer.allowed:
        return answer
    if not answer.problems and (changed := _with_policy_change(evaluator, answer)):
        return changed
    faulty = (problem.file for problem in answer.problems if problem.fault.id == answer.reason)
    text = remedy(answer.reason, str(enclave.root or ""), enclave.name, next(faulty, ""))
    return answer._replace(remedy=text)


def _provenance(enclave: LoadedEnclave, recorded: str) -> Provenance | None:
    """Return how the ledger relates the permissions to the policy; None without a policy."""
    if enclave.policy is None:
        return None
    if not enclave.signed:
        return Provenance.PLANNED
    if not recorded:
        return Provenance.UNKNOWN
    if not _has_rules_of_policy(enclave):
        return Provenance.CHANGED
    return Provenance.SAME if recorded == enclave.policy.digest else Provenance.EQUAL


def _has_rules_of_policy(enclave: LoadedEnclave) -> bool:
    """Return whether the grant that DDS reads has exactly the rules that the policy states."""
    from sros_tool.translate import permissions_for

    assert enclave.policy
    with suppress(SrosError):
        grant = parse_permissions(enclave.permissions).grant_of(enclave.subject)
        if grant and grant.rules and not grant.default_allow:
            permissions = permissions_for(
                enclave.policy,
                subject=grant.subject,
                validity=grant.validity,
                domains=grant.rules[0].domains,
            )
            return permissions.grants[0].rules == grant.rules
    return False


def _with_policy_change(evaluator: Evaluator, answer: Answer) -> Answer | None:
    """Return the answer with the change of the policy that would allow the access, or None."""

    change = _smallest_change(evaluator, answer)
    if change is None:
        return None
    if change.add or change.lift:
        return answer._replace(change=change)
    # The policy allows the access already; it only has to be signed.
    other = answer.provenance in (Provenance.CHANGED, Provenance.UNKNOWN)
    return answer._replace(sign=True) if other else None


# ── remedies ───────────────────────────────────────────────────────────────────────────────

_ROTATION_REMEDY = (
    "The CAs of this keystore are being replaced: do the next stage with `sros rotate_ca {root} "
    "--next`, and then restart the processes."
)
_RIGHTS_REMEDY = (
    "Sign the intended permissions: `sros create_permission {root} {enclave} POLICY`; `sros renew` "
    "refuses the present permissions, because the ledger has later ones."
)
_VENDOR_REMEDY = (
    "Write the permissions in the form that all vendors read alike: `sros create_permission "
    "{root} {enclave} POLICY`."
)

_FAULT_OF_REASON: dict[str, str | Fault] = {
    "expired": Fault.PERMISSIONS_EXPIRED,
    "not-yet-valid": Fault.PERMISSIONS_NOT_YET_VALID,
    "no-grant": Fault.PERMISSIONS_SUBJECT,
    "domain-not-in-governance": Fault.GOVERNANCE_DOMAIN,
    "peer-refuses-participant": Fault.PERMISSIONS_SUBJECT,
    "unauthenticated-with-rtps-protection": Fault.GOVERNANCE_MALFORMED,
    "malformed": _VENDOR_REMEDY,
    "open-range": _VENDOR_REMEDY,
    "empty-topic": _VENDOR_REMEDY,
    "long-name": "Use a shorter name: on DDS at most 251 characters, prefix and suffix included.",
    "no-topic-rule": "Make a keystore from a template: its governance has a rule for every topic.",
    "empty-subject": "Issue a certificate with a common name: `sros renew {root} {enclave}`.",
    "blank-subject": Fault.PERMISSIONS_SUBJECT,
    "invalid-name": "Use a name of letters, digits, '_' and '/'.",
    "partition": "Leave partitions out of permissions; sros never writes them.",
}
"""Reason of a denial that no change of the policy can resolve → the fault, or a remedy."""

_NOT_VALID_NOW = ("expired", "not-yet-valid")
"""Reasons of a denial that only the validity of the grant causes."""
_VALIDITY_FAULTS = (Fault.PERMISSIONS_EXPIRED, Fault.PERMISSIONS_NOT_YET_VALID)
_GOVERNANCE_FAULTS = (Fault.GOVERNANCE_MALFORMED, Fault.GOVERNANCE_DOMAIN)


def remedy(cause: Fault | str, root: str, enclave: str, file: str = "") -> str:
    """Return the remedy for ``cause``, or "" if only a change of the policy can help.

    Args:
        cause: a fault of the enclave's files, its id, or the reason of a decision.
        root: the keystore, or "". An export, without CA keys, can only be repaired in the
            original keystore.
        enclave: the name of the enclave.
        file: the enclave's file that has the fault, if known.
    """
    known = (
        cause if isinstance(cause, Fault) else FAULTS.get(cause, _FAULT_OF_REASON.get(cause, ""))
    )
    fault, text = (known, "") if isinstance(known, Fault) else (None, known)
    if fault:
        file = file or (GOVERNANCE_FILE if fault in _GOVERNANCE_FAULTS else "")
        text = fault.remedy_in(file)
    keystore = Path(root) if root and Path(root).is_dir() else None
    if keystore and not is_original_keystore(keystore):
        if fault:
            is_done_here = "`" not in text or fault is Fault.GOVERNANCE_DOMAIN
            where = root if is_done_here else "KEYSTORE"
            made_here = key_on_robot(enclave_path(keystore, enclave))
            text = fault.remedy_in_export(file, key_made_here=made_here)
            text = _filled_remedy(text, where, enclave, file)
            return remedy_in_closed_robot(keystore, text)
        if "`" not in text:
            return _filled_remedy(text, root, enclave, file)
        text = remedy_in_original_keystore(_filled_remedy(text, "KEYSTORE", enclave, file))
        return remedy_in_closed_robot(keystore, text)
    if keystore and fault:
        wrong_issuer = fault is Fault.CERTIFICATE_ISSUER
        if wrong_issuer and is_own_copy(keystore, enclave, IDENTITY_CA_FILE):
            return _filled_remedy(REPLACE, root, enclave, IDENTITY_CA_FILE)
        if (wrong_issuer or fault is Fault.CA_EXPIRED) and _is_rotating(keystore):
            text = _ROTATION_REMEDY
        elif fault in _VALIDITY_FAULTS and not _is_latest(keystore, enclave):
            text = _RIGHTS_REMEDY
        elif fault not in NOT_IN_THE_FILE and is_own_copy(keystore, enclave, file):
            text = REPLACE
    return _filled_remedy(text, root or "KEYSTORE", enclave, file)


def _filled_remedy(text: str, root: str, enclave: str, file: str) -> str:
    path = enclave_path(Path(root), enclave) / (file or "cert.pem")
    # Quoted, so that copied text cannot become another command in a shell.
    return text.format(root=quote(root), enclave=quote(enclave), path=quote(str(path)))


def _is_rotating(keystore: Path) -> bool:
    from sros_tool.keystore.lifecycle.rotation import RotationStage, read_rotation
    from sros_tool.keystore.reader import OpenedKeystore

    try:
        return read_rotation(OpenedKeystore(keystore)).stage is not RotationStage.NONE
    except SrosError:
        return False


def _is_latest(keystore: Path, enclave: str) -> bool:
    """Return whether an enclave has the permissions that the ledger records as signed last.

    True if this is not known.
    """
    from sros_tool.keystore.reader import OpenedKeystore

    try:
        signed = (enclave_path(keystore, enclave) / PERMISSIONS_FILE).read_bytes()
        entries = reversed(OpenedKeystore(keystore).ledger_with("enclave", enclave).entries)
    except (SrosError, OSError):
        return True
    last = (entry for entry in entries if (entry.what, entry.enclave) == ("permissions", enclave))
    digest = next((entry.sha256 for entry in last), "")
    return not digest or digest == hashlib.sha256(signed).hexdigest()


# ── the smallest change of a policy ────────────────────────────────────────────────────────

_NO_RULE = frozenset({"no-rule", "default"})


def _smallest_change(evaluator: Evaluator, answer: Answer) -> PolicyChange | None:
    """Return the smallest change of the policy that makes the vendor allow a denied question.

    The change is for the enclave's policy or, without a policy, for the rights in the permissions.
    Returns None if no policy could allow the question.
    """
    enclave, question = evaluator.enclave, answer.question
    if not question.right:
        return None
    try:
        governance = enclave.plain_governance or parse_governance(enclave.governance)
    except SrosError:
        return None
    wanted = Right(enclave.name, ALLOW, *action_right(question.right, question.name))
    present = _present_rights(enclave.policy, enclave.name, answer)
    add: list[Right] = []
    lift: list[Right] = []
    while True:
        planned = plan_enclave(
            policy_of(enclave.name, present), governance, moment=evaluator.context.at
        )
        tried = Evaluator(evaluator.vendor, planned, evaluator.context).answer(question)
        if tried.allowed:
            return PolicyChange(
                tuple(add),
                tuple(lift),
                _added_xml(add[0], _node_names(enclave.policy, answer)) if add else "",
                tuple(_group_edits(lift, enclave.policy)) if enclave.policy else (),
            )
        if tried.reason in _NO_RULE and wanted not in present:
            present.add(wanted)
            add.append(wanted)
            continue
        blocking = _blocking_denials(present, tried) if tried.reason == "deny-rule" else []
        if not blocking:
            return None
        present.difference_update(blocking)
        lift += sorted(blocking)


def policy_of(enclave: str, rights: Iterable[Right]) -> Enclave:
    """Return a policy of an enclave with these rights, in one profile without a node name."""
    groups = tuple(
        Group(right.kind, ((right.right, right.qualifier),), (right.name,))
        for right in sorted(rights)
    )
    return Enclave(enclave, (Profiles((Profile("/", "", groups),)),))


def _present_rights(policy: Enclave | None, enclave: str, answer: Answer) -> set[Right]:
    """Return the rights that an enclave has now, except those that no policy can state."""
    rights: Iterable[Right] = ()
    if policy:
        rights = (r for profile in policy.all_profiles() for r in profile_rights(enclave, profile))
    else:
        rights = _granted_rights(enclave, answer)
    return {right for right in rights if right.kind != "dds"}


def _blocking_denials(rights: Iterable[Right], answer: Answer) -> list[Right]:
    """Return the denials from which the deciding expression of an answer comes.

    Denials of the other direction count only if no other denials exist: Cyclone DDS denies a whole
    topic because of a denial in either direction.
    """
    expression = answer.decision.expression or ""
    publishes = answer.part is not None and answer.part.verb is AccessVerb.PUBLISH
    in_direction: list[Right] = []
    other: list[Right] = []
    for right in rights:
        if right.qualifier is DENY:
            names = right.topics
            if expression in (names.publish if publishes else names.subscribe):
                in_direction.append(right)
            elif expression in names.publish + names.subscribe:
                other.append(right)
    return in_direction or other


_ANY_NODE = ("/", "*")
"""Namespace and name of a profile for any node, because DDS only checks the enclave."""


def _added_xml(right: Right, places: Iterable[tuple[str, str]]) -> str:
    """Return the XML of a policy with one right, in the profile of the closest node.

    ``places`` are namespaces and names of nodes; the closest node has the longest namespace that
    contains the right's name.  Without places, the profile is for any node.
    """
    known = list(places)
    fitting = [place for place in known if right.name.startswith(place[0].rstrip("/") + "/")]
    ns, node = max(fitting or known, key=lambda pair: len(pair[0]), default=_ANY_NODE)
    from sros_tool.graph.learn import name_as_written  # only denied questions need both
    from sros_tool.policy.document import policy_xml

    name = name_as_written(right.name, ns, node) if known else right.name
    group = Group(right.kind, ((right.right, right.qualifier),), (name,))
    enclave = Enclave(right.enclave, (Profiles((Profile(ns, node, (group,)),)),))

    return policy_xml(Policy((enclave,))).decode().rstrip()


def _node_names(policy: Enclave | None, answer: Answer) -> Iterator[tuple[str, str]]:
    """Yield namespace and name of an enclave's nodes.

    Without a policy, these are the nodes whose standard services the permissions allow.
    """
    if policy:
        yield from ((profile.ns, profile.node) for profile in policy.all_profiles())
        return
    for node in nodes_served((right.right, right.name) for right in _granted_rights("", answer)):
        ns, _, name = node.rpartition("/")
        yield ns or "/", name


def _granted_rights(name: str, answer: Answer) -> Iterator[Right]:
    """Yield the rights in the grant of an enclave, even if the grant is not valid now."""
    from sros_tool.translate import grant_rights  # only denied questions need it

    grant, enclave = answer.grant, answer.enclave
    if answer.reason in _NOT_VALID_NOW:
        with suppress(SrosError):
            grant = parse_permissions(enclave.permissions).grant_of(enclave.subject)
    if grant:
        yield from grant_rights(name, grant)


_LEAST_SIMILARITY = 0.9
"""Lowest similarity (`difflib` ratio, 0 to 1) that counts as a typing error in a ROS name."""


def likely_names(answer: Answer) -> tuple[str, ...]:
    """Return at most three allowed names that may be meant instead of the denied name.

    For a service that every node offers, these are the same services of the enclave's nodes. For
    any other name, these are names with the same last part (a forgotten remapping), or else names
    with a similar spelling.
    """
    question = answer.question
    names = {right.name for right in named_rights(answer) if right.right == question.right}
    return _similar_names(question.name, names - {question.name}, question.type == "service")


def likely_actions(answer: Answer) -> tuple[str, ...]:
    """Return at most three allowed actions that may be meant instead of a denied service."""
    right = {"request": "call", "reply": "execute"}.get(answer.question.right)
    names = {held.name for held in named_rights(answer) if held.right == right}
    return _similar_names(answer.question.name, names, is_service=False)


def likely_meaning(
    right: Right, used: Collection[Right], named: Iterable[Right], *, is_renamed: bool = False
) -> str:
    """Return a clause on the name that a policy may mean instead of a denied right, or "".

    For a right that a common part gives, the clause names the part instead.

    ``used`` are rights that the node uses, and that are therefore no mistakes; ``named`` are the
    `named_rights` of the node's enclave. With ``is_renamed``, the policy has new names on purpose,
    so the clause proposes no remapping.
    """
    if right.kind == "dds":
        return ""
    named = tuple(named)
    if part := lacking_part(right, named):
        return part.advice
    unused = [other for other in named if other not in used]
    if of_other_kind := meaning_of_other_kind(right, unused):
        return of_other_kind
    names = {other.name for other in unused if other.right == right.right}
    similar = _similar_names(right.name, names, right.kind == "services")
    meaning = f"perhaps the policy means {' or '.join(similar)}" if similar else ""
    if len(similar) == 1 and right.kind != "actions" and not is_renamed:
        meaning += f" ({remapping_clause(right.name, similar[0])})"
    return meaning


def likely_unused_name(name: str, unused: Iterable[str]) -> str:
    """Return the allowed name that is probably meant in place of a denied name, or "".

    ``unused`` are the names that the enclave may use in the same way, and does not use.  The result
    is the only one of them whose last part shares a word with the last part of the denied name; if
    there is no such name, the only one.
    """

    def last_part(name: str) -> str:
        return name.rpartition("/")[2]

    def is_of_every_node(name: str) -> bool:
        return name in GLOBAL_TOPICS or last_part(name) in NODE_SERVICES

    if is_of_every_node(name):
        return ""
    own = [other for other in unused if not is_of_every_node(other)]
    words = {*last_part(name).split("_")}
    likely = [other for other in own if words.intersection(last_part(other).split("_"))] or own
    return likely[0] if len(likely) == 1 else ""


def unused_name_clause(right: Right, used: Collection[Right], named: Iterable[Right]) -> str:
    """Return a clause on the only name that fits a denied right, and that is not used; or "".

    ``used`` and ``named`` are as in `likely_meaning`.
    """
    if right.kind not in ("topics", "services"):
        return ""
    names = [other.name for other in named if other.right == right.right and other not in used]
    name = likely_unused_name(right.name, names)
    may = f"the enclave may {right.right} {name}, which the process does not use"
    return f"{may}: perhaps a remapping or a parameter is missing or wrong" if name else ""


_PARTS_OF_NODES = {
    "common/lifecycle_node.xml": "lifecycle node",
    "common/component_container.xml": "component container",
}
"""Common parts of policies with more private names of a node than ``common/node.xml`` has."""


class PartOfNode(NamedTuple):
    """A common part of policies that the profile of a node probably lacks."""

    reason: str
    advice: str


@cache  # an audit asks for each denied right
def _shipped_parts() -> CommonParts:
    from sros_tool.graph.learn import common_parts  # imported only for denied rights

    return common_parts(policies_dir(), policies_dir())


def lacking_part(denied: Right, named: Iterable[Right]) -> PartOfNode | None:
    """Return the common part that gives a node the denied right; None if no part does.

    ``named`` are the `named_rights` of the enclave: the nodes whose standard services they serve
    are the nodes of the enclave.
    """
    parts = _shipped_parts()
    for node in nodes_served((right.right, right.name) for right in named):
        ns, _, name = node.rpartition("/")
        for part, kind in _PARTS_OF_NODES.items():
            rights = parts.included_rights([part], ns or "/", name)
            rights -= parts.included_rights(["common/node.xml"], ns or "/", name)
            if (denied.right, denied.name) in rights:
                return PartOfNode(
                    f"every {kind} needs this right",
                    f"if {node} is a {kind}, include {part} in its profile, in place of "
                    "common/node.xml",
                )
    return None


def remapping_clause(name: str, meant: str) -> str:
    """Return why a node may use ``name`` in place of ``meant``, the policy's name, as a clause."""
    return (
        f"the node may lack the remapping -r {name}:={meant}, or the policy may lack "
        f"--remap {meant}:={name}, or a remapping or parameter makes the node use the wrong {name}"
    )


def meaning_of_other_kind(right: Right, named: Iterable[Right]) -> str:
    """Return a clause if ``named`` has a service as an action, or an action as a service; or ""."""
    for other in named:
        if other.name == right.name and {other.kind, right.kind} == {"services", "actions"}:
            kind = "an action" if other.kind == "actions" else "a service"
            return f"the policy has it as {kind} ({other.right})"
    return ""


def named_rights(answer: Answer) -> tuple[Right, ...]:
    """Return the rights without wildcards that the enclave of an answer has now, sorted."""
    present = _present_rights(answer.enclave.policy, answer.enclave.name, answer)
    named = (r for r in present if r.qualifier is ALLOW and not is_expression(r.name))
    return tuple(sorted(named, key=order))


def _similar_names(name: str, names: AbstractSet[str], is_service: bool) -> tuple[str, ...]:
    last = name.rpartition("/")[2]
    same_last = sorted(other for other in names if other.rpartition("/")[2] == last)
    if (is_service and last in NODE_SERVICES) or 0 < len(same_last) <= _MAX_PROPOSED_NAMES:
        return tuple(same_last) if len(same_last) <= _MAX_PROPOSED_NAMES else ()
    if alike := sorted(other for other in names if is_spelled_alike(name, other)):
        return tuple(alike[:_MAX_PROPOSED_NAMES])
    if not names:
        return ()
    from difflib import get_close_matches  # imported only for this last search

    return tuple(
        get_close_matches(name, sorted(names), n=_MAX_PROPOSED_NAMES, cutoff=_LEAST_SIMILARITY)
    )


_MAX_PROPOSED_NAMES = 3
"""Maximum number of names that are proposed."""


def _group_edits(lifted_rights: list[Right], policy: Enclave) -> Iterator[GroupEdit]:
    """Yield a replacement for each group of the policy that has denials of ``lifted_rights``."""
    groups: dict[Source, Group] = {}
    lifted: dict[Source, set[tuple[str, str]]] = {}
    for right in lifted_rights:
        for line in lines_of_right(policy, right):
            groups[line.group.source] = line.group
            lifted.setdefault(line.group.source, set()).add((line.name, line.right))
    for source, group in groups.items():
        kept: dict[tuple[tuple[str, str], ...], list[str]] = {}
        for name in group.names:
            rights = tuple(
                right for right in group.rights if (name, right[0]) not in lifted[source]
            )
            if rights:
                kept.setdefault(rights, []).append(name)
        yield GroupEdit(source, "\n".join(_xml_element(group.kind, *item) for item in kept.items()))


def _xml_element(kind: str, rights: tuple[tuple[str, str], ...], names: list[str]) -> str:
    element = etree.Element(kind, dict(rights))
    for name in names:
        etree.SubElement(element, kind.removesuffix("s")).text = name
    etree.indent(element, space="  ")
    return etree.tostring(element, encoding="unicode")
