"""Find the rights that observed ROS nodes use and that a policy or keystore denies.

DDS Security has no mode that only logs denials: either its rules are enforced, or there is no
security. So an audit enforces nothing: the decision engine decides on each endpoint in the ROS
graph, in the enclave in which its process would run, and the audit reports the denials that a
secured robot would log.

On a robot without security, the graph shows the enclave / for most processes.  In this case, the
enclave follows from the name of the node: by the profiles of the policy, or by the services of
nodes that permissions of a keystore name.

Nodes that were not observed are not judged: the result names the nodes of the policy or keystore
that did not appear, and everything in the graph that belongs to no enclave.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple

from sros_tool.dds.decision.access import AccessVerb
from sros_tool.dds.decision.vendors import Vendor
from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import Governance
from sros_tool.errors import Note, PolicyError, UsageError
from sros_tool.explain.answer import Evaluator, Part, Question
from sros_tool.explain.explanation import likely_meaning, named_rights, unused_name_clause
from sros_tool.fleet.expansion import read_policy_for
from sros_tool.fleet.robots import Fleet
from sros_tool.graph.learn import (
    UNSHOWN,
    Learned,
    RightsOrigin,
    enclave_per_node,
    first_subjects,
    is_tool_name,
    learn,
    rights_of_endpoints,
    tool_nodes,
    writing_rights,
)
from sros_tool.graph.observation import (
    PUBLISH,
    SUBSCRIBE,
    Endpoint,
    Observation,
    ObservedNode,
    make_observation,
)
from sros_tool.keystore.layout import enclave_names, enclave_path
from sros_tool.keystore.participant import JoinContext, LoadedEnclave, load_enclave, plan_enclave
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.rights import RightsSource, load_rights
from sros_tool.keystore.template import DEFAULT_TEMPLATE, load_template
from sros_tool.keystore.zenoh_files import router_enclaves
from sros_tool.names import dds_names, expand, is_expression, nodes_served
from sros_tool.policy.document import join_policies
from sros_tool.policy.model import ALLOW, PEER_RIGHT, Policy
from sros_tool.policy.patterns import matches
from sros_tool.policy.rights import Right, order, policy_rights
from sros_tool.translate import governance_for
from sros_tool.values import DryRun, FileChanges, Notes, Words, shows
from sros_tool.wording import counted, enumerated, first_few

if TYPE_CHECKING:
    from sros_tool.explain.zenoh import ZenohEvaluator

_DENY_RULE = "deny-rule"
_USE_WORD = "use"
BY_VENDOR_ON_ZENOH = Note(
    "audit.on-zenoh",
    "these nodes run on Zenoh, and sros decided by the rules of a DDS vendor. On Zenoh, the files "
    "of `sros zenoh` decide: to ask them, audit the keystore without --vendor",
)

# ── the enclaves to audit ──────────────────────────────────────────────────────────────────


@dataclass(frozen=True, slots=True)
class EnclaveNodes:
    """The names of the nodes of each enclave, perhaps with wildcards."""

    by_enclave: Mapping[str, tuple[str, ...]]

    def enclaves_for(self, node: str) -> frozenset[str]:
        """Return the enclaves for the node with this full name.

        Enclaves with exactly this name are preferred to enclaves with a matching wildcard.
        """
        return self.enclaves_naming(node) or frozenset(
            name
            for name, nodes in self.by_enclave.items()
            if any(_matches_node_name(node, named_node) for named_node in nodes)
        )

    def enclaves_naming(self, node: str) -> frozenset[str]:
        """Return the enclaves that have exactly this full name of a node, without wildcards."""
        return frozenset(name for name, nodes in self.by_enclave.items() if node in nodes)

    @property
    def expected(self) -> frozenset[EnclaveNode]:
        """The nodes that should run on the robot, without tools that observe the robot."""
        return frozenset(
            EnclaveNode(enclave, node)
            for enclave, nodes in self.by_enclave.items()
            for node in nodes or ("",)
            if not is_tool_name(node.rpartition("/")[2])
        )


@dataclass(frozen=True, slots=True, order=True)
class EnclaveNode:
    """A node that an enclave should have; ``node`` is "" if the enclave's nodes are not known."""

    enclave: str
    """The enclave of the node."""
    node: str
    """Full name of the node, perhaps with wildcards; empty if the nodes of the enclave are not
    known, and no node of the enclave was seen.
    """

    def __str__(self) -> str:
        """Return text like ``node /talker of enclave /robot/talker``."""
        return f"{f'node {self.node}' if self.node else 'every node'} of enclave {self.enclave}"


def _matches_node_name(node: str, name: str) -> bool:
    """Return whether the full name of a node matches ``name``, which may have wildcards."""
    return node == name or (is_expression(name) and matches(name, node))


@dataclass(frozen=True)
class AuditedEnclaves:
    """The enclaves of a policy or keystore; ``load`` loads an enclave by its name.

    ``what`` is "policy" or "keystore".
    With ``zenoh``, a right has to be in the Zenoh files of ``keystore``, and in the permissions if
    these load.  ``changed_since`` says that the policy changed after the nodes were observed.
    ``rights`` are the rights of all enclaves.
    """

    what: str
    nodes: EnclaveNodes
    load: Callable[[str], LoadedEnclave]
    vendor: Vendor
    context: JoinContext
    keystore: OpenedKeystore | None = None
    zenoh: ZenohEvaluator | None = None
    changed_since: bool = False
    rights: frozenset[Right] = frozenset()
    _evaluators: dict[str, Evaluator] = field(default_factory=dict)

    def on_zenoh(self) -> AuditedEnclaves:
        """Return the same enclaves of a keystore, for the decisions of Zenoh.

        Raises:
            KeystoreError: sros cannot know what the router enforces (`ZenohEvaluator`).
        """
        from sros_tool.explain.zenoh import ZenohEvaluator  # DDS does not need it

        assert self.keystore
        at, domain = self.context.at, self.context.domain
        zenoh = ZenohEvaluator(self.keystore, moment=at, domain=domain)
        return replace(self, vendor=Vendor.STANDARD, zenoh=zenoh, _evaluators={})

    def has_other_side(self, right: Right) -> bool:
        """Return whether an enclave has, by exact name, the right that peers of ``right`` need."""
        return (PEER_RIGHT.get(right.right, ""), right.name) in self._allowed_names

    @cached_property
    def _allowed_names(self) -> frozenset[tuple[str, str]]:
        allowed = (right for right in self.rights if right.qualifier is ALLOW)
        return frozenset((right.right, right.name) for right in allowed)

    def evaluator(self, enclave: str) -> Evaluator:
        """Return the evaluator for an enclave; an enclave is loaded only once."""
        if enclave not in self._evaluators:
            loaded = self.load(enclave)
            self._evaluators[enclave] = Evaluator(self.vendor, loaded, self.context)
        return self._evaluators[enclave]


def audited_enclaves(
    paths: Sequence[Path], vendor: Vendor, context: JoinContext, fleet: Fleet | None = None
) -> AuditedEnclaves:
    """Return the enclaves of a keystore, or of the policies of a robot, with a vendor's decisions.

    A policy counts as signed, with the governance of the default template; ``fleet`` has the robots
    that fill in the policy's placeholders.

    Raises:
        UsageError: a path is neither a policy nor a keystore; or a keystore is given together with
            other paths or with ``fleet``.
        PolicyError: two policies state the same enclave.
    """
    path, *other_paths = paths
    rights = load_rights(path, fleet)
    if fleet and rights.kind != "policy":
        raise UsageError(
            "--fleet is for the placeholders of a policy",
            f"'{path}' is not a policy.",
            "Omit --fleet.",
        )
    if rights.kind == "keystore":
        if other_paths:
            raise UsageError(
                "a keystore cannot be audited together with other paths",
                "",
                f"Leave '{other_paths[0]}' out.",
            )
        keystore = OpenedKeystore(path)
        routers = router_enclaves(keystore, context.at)
        with_nodes = [name for name in enclave_names(path) if name not in routers]
        return replace(keystore_enclaves(rights, with_nodes, vendor, context), keystore=keystore)
    if rights.kind != "policy":
        raise UsageError(
            f"'{path}' is neither a policy nor a keystore",
            "An audit needs the rights of all enclaves of the robot.",
            "Name the policy, or the folder of the keystore.",
        )
    protection = load_template(DEFAULT_TEMPLATE).protection
    governance = governance_for(protection, DomainSet.of((context.domain, context.domain)))
    policy = join_policies([read_policy_for(path, fleet) for path in paths])
    return policy_enclaves(policy, governance, vendor, context)


def policy_enclaves(
    policy: Policy, governance: Governance, vendor: Vendor, context: JoinContext
) -> AuditedEnclaves:
    """Return the enclaves of a policy, as if the policy were signed now with ``governance``."""
    nodes = {
        enclave.path: tuple(p.full_name for p in enclave.all_profiles())
        for enclave in policy.enclaves
    }

    def load(name: str) -> LoadedEnclave:
        enclave = policy.enclave(name)
        if enclave is None:
            raise PolicyError(f"unable to find enclave {name} in the policy '{policy.file}'")
        return plan_enclave(enclave, governance, moment=context.at)

    rights = frozenset(policy_rights(policy))
    return AuditedEnclaves("policy", EnclaveNodes(nodes), load, vendor, context, rights=rights)


def keystore_enclaves(
    source: RightsSource, names: Iterable[str], vendor: Vendor, context: JoinContext
) -> AuditedEnclaves:
    """Return the enclaves ``names`` of a keystore, with the rights in ``source``.

    Permissions name no nodes, so an enclave counts as the enclave of the nodes whose parameter
    services it may offer.
    """
    replies: dict[str, list[tuple[str, str]]] = {name: [] for name in names}
    for right in source.rights:
        if right.qualifier is ALLOW and right.enclave in replies:
            replies[right.enclave].append((right.right, right.name))
    nodes = {name: nodes_served(reply) for name, reply in replies.items()}

    def load(name: str) -> LoadedEnclave:
        return load_enclave(name, enclave_path(source.path, name), moment=context.at)

    rights = source.rights
    return AuditedEnclaves("keystore", EnclaveNodes(nodes), load, vendor, context, rights=rights)


# ── the audit ──────────────────────────────────────────────────────────────────────────────


@shows(spread=("right",))
@dataclass(frozen=True, slots=True)
class DeniedRight:
    """A right that nodes of an enclave use, and that DDS would deny.

    ``nodes`` are the full names of the nodes.  ``right.name`` is a DDS topic if the topic has no
    ROS name.  With ``by_rule``, a deny rule
    denies the right, so that a new allow rule would not help.  With ``new_enclave``, the node has
    no enclave yet, and the enclave of ``right`` is a proposal.
    """

    right: Right
    """The right in the words of the policy language."""
    nodes: tuple[str, ...]
    """The nodes that use the right."""
    reason: str
    """Reason of the denial, as a sentence."""
    by_rule: bool
    """Whether a deny rule denies the right, so that adding a right does not help."""
    new_enclave: bool
    """Whether the policy does not have the enclave yet."""
    endpoints: tuple[Endpoint, ...]
    """The denied DDS endpoints."""
    by_files: bool = False
    """Whether the permissions allow the right, but the Zenoh files of the keystore do not."""

    @property
    def can_be_added(self) -> bool:
        """Whether an additional right in the policy would allow the access."""
        return not (self.by_rule or self.by_files)

    def __str__(self) -> str:
        """Return text like ``/robot publish topic /chatter (/talker): no rule allows it``."""
        nodes = ", ".join(self.nodes)
        return f"{self.right.enclave} {self.right.describe()} ({nodes}): {self.reason}"


class RefusedEnclave(NamedTuple):
    """An enclave in which no process would start."""

    enclave: str
    """Name of the enclave."""
    reason: str
    """Reason of the refusal, as a sentence."""


@shows(spread=("observation",))
class AuditResult(NamedTuple):
    """The rights that a policy or keystore would deny to the running nodes."""

    source: Path
    """Path of the policy or keystore."""
    others: Sequence[Path]
    """Paths of other policies that were audited together with ``source``."""
    kind: Annotated[str, Words(("policy", "keystore"))]
    """Whether the source is a policy or a keystore."""
    vendor: Vendor | Literal["zenoh"]
    """The DDS vendor, as ``--vendor`` takes it; ``zenoh`` if the Zenoh files of the keystore
    decided.
    """
    domain: int
    """The ROS domain."""
    allowed: bool
    """Whether the exit status is 0: nothing would be denied, and ``--partial``, ``--unjudged`` and
    ``--unsettled`` accept everything that was left out.
    """
    denied: Sequence[DeniedRight]
    """The rights that would be denied."""
    refused: Sequence[RefusedEnclave]
    """Enclaves in which no process would start."""
    unseen: Sequence[EnclaveNode]
    """The nodes of the policy or keystore that were not seen, so that their rights were not
    judged.
    """
    unjudged: Sequence[str]
    """Parts of the observed graph that were not judged, as texts with a number and some names;
    ``notes`` has more.
    """
    tools: Sequence[ObservedNode]
    """The nodes of tools, such as `ros2 topic echo`, which were not judged."""
    observation: Observation
    settled: bool
    """Whether the ROS graph stopped changing, or was watched without a gap and did not grow any
    more at the end.
    """
    partial: bool
    """Whether ``--partial`` accepted nodes that were not seen."""
    unjudged_accepted: bool
    """Whether ``--unjudged`` accepted parts that were not judged."""
    unsettled_accepted: bool
    """Whether ``--unsettled`` accepted a graph that kept changing."""
    patch: Path | None
    """Path of the policy that ``--patch`` wrote, with the missing rights; or null."""
    dry_run: DryRun
    changes: FileChanges
    notes: Notes


@dataclass(frozen=True)
class Audit:
    """The result of an audit of observed nodes.

    ``refused`` maps enclaves to the reason why no process could start there, or find peers.
    ``observation`` has the judged nodes, with the enclaves in which they were judged. ``unseen``
    are the ``expected`` nodes of the policy or keystore that did not appear.  ``unjudged`` are
    clauses on what was observed but not judged.  ``tools`` are the nodes of tools.
    """

    denied: tuple[DeniedRight, ...]
    refused: Mapping[str, str]
    observation: Observation
    notes: tuple[Note, ...]
    expected: frozenset[EnclaveNode]
    unseen: tuple[EnclaveNode, ...]
    unjudged: tuple[str, ...]
    tools: tuple[ObservedNode, ...]
    misplaced: frozenset[EnclaveNode]

    @property
    def allowed(self) -> bool:
        """Whether every judged node would be allowed everything."""
        return not (self.denied or self.refused)

    def lines(self) -> dict[str, str]:
        """Return lines on refused enclaves, denied rights and nodes without enclave, by key.

        The key of a line does not change when more rights of a node without an enclave are seen.
        """
        lines = {name: f"{name}: every process: {why}" for name, why in self.refused.items()}
        lines = dict(sorted(lines.items()))
        lines |= {str(right): str(right) for right in self.denied if not right.new_enclave}
        rights_without_enclave: dict[tuple[str, ...], list[DeniedRight]] = {}
        for right in self.denied:
            if right.new_enclave:
                rights_without_enclave.setdefault(right.nodes, []).append(right)
        nodes_without_enclave = {node for nodes in rights_without_enclave for node in nodes}
        names = Counter(map(_base_name, nodes_without_enclave))
        unseen_names = Counter(_base_name(unseen.node) for unseen in self.unseen)
        unseen_by_name = {
            name: str(unseen)
            for unseen in self.unseen
            if names[name := _base_name(unseen.node)] == unseen_names[name] == 1
        }
        for nodes, rights in rights_without_enclave.items():
            meant = [unseen_by_name.get(_base_name(node), "") for node in nodes]
            hint = ""
            if all(meant):
                they, were = ("it is", "was") if len(nodes) == 1 else ("they are", "were")
                hint = f"; perhaps {they} {enumerated(meant)}, which {were} not seen"
            shown = ", ".join(nodes)
            used = first_few([right.right.describe() for right in rights], 3)
            text = f"{shown}: {rights[0].reason}: {counted(len(rights), 'right')} ({used}){hint}"
            lines[shown] = text
        return lines

    @cached_property
    def missing(self) -> Learned:
        """The rights to add to the policy, without those of nodes that have another enclave."""
        addable = [denied for right in self.denied if (denied := self._without_misplaced(right))]
        learned = learn(_nodes_using_denied(addable, self.observation), of_tools=True)
        return replace(learned, source=RightsOrigin.AUDIT)

    def _without_misplaced(self, denied: DeniedRight) -> DeniedRight | None:
        """Return a denied right without misplaced nodes; None if no node is left."""
        enclave = denied.right.enclave
        nodes = [node for node in denied.nodes if EnclaveNode(enclave, node) not in self.misplaced]
        return replace(denied, nodes=tuple(nodes)) if nodes else None


def _base_name(node: str) -> str:
    """Return the name of a node without its namespace."""
    return node.rpartition("/")[2]


def audit(observation: Observation, enclaves: AuditedEnclaves, observer: str = "") -> Audit:
    """Return the rights that observed nodes use and that their enclaves would be denied.

    If the nodes of a process match several enclaves, all these enclaves are judged, with a note.
    ``observer`` is the enclave of the process that observed, or ""; this enclave counts as seen if
    it names no nodes.
    """
    tools = tool_nodes(observation.nodes)
    unjudged = _unjudged_notes(observation, tools)
    notes = [note for note, _ in unjudged]
    processes: dict[str, list[ObservedNode]] = {}
    for node in observation.nodes:
        if node not in tools:
            processes.setdefault(node.participant, []).append(node)
    expected = frozenset(
        node
        for node in enclaves.nodes.expected
        if node.enclave != observer or (node.node and not is_expression(node.node))
    )
    observed_nodes: set[EnclaveNode] = set()
    denied: list[DeniedRight] = []
    refused: dict[str, str] = {}
    judged: list[ObservedNode] = []
    unclear, divided, without_enclave = [], [], []
    misplaced: set[EnclaveNode] = set()
    moved: list[str] = []
    undecided: set[str] = set()
    for nodes in processes.values():
        names = ", ".join(sorted(node.fqn for node in nodes))
        candidates, together = _enclaves_of(nodes, enclaves.nodes)
        if not candidates:
            without_enclave += nodes
            continue
        observed_nodes |= {
            enclave_node
            for enclave_node in expected
            if enclave_node.enclave in candidates
            and (
                not enclave_node.node
                or any(_matches_node_name(node.fqn, enclave_node.node) for node in nodes)
            )
        }
        answers = {name: _judge(nodes, name, enclaves) for name in candidates}
        chosen = sorted(candidates)
        if not together:
            chosen = [min(chosen, key=lambda name: (len(answers[name].denied), name))]
            divided.append(f"{names} (judged in {chosen[0]})")
        elif len(chosen) > 1:
            unclear.append(f"{names} in {' or '.join(chosen)}")
        elsewhere = {
            EnclaveNode(name, node): homes
            for name in chosen
            for right in answers[name].denied
            for node in right.nodes
            if (homes := enclaves.nodes.enclaves_naming(node)) and name not in homes
        }
        misplaced |= elsewhere.keys()
        if together:
            moved += (
                f"{place.node} in {place.enclave} (its enclave: {' or '.join(sorted(homes))})"
                for place, homes in elsewhere.items()
            )
        for name in chosen:
            denied += answers[name].denied
            undecided |= answers[name].undecided
            if answers[name].refused:
                refused[name] = answers[name].refused
        judged += (replace(node, enclaves=tuple(chosen)) for node in nodes)
    if without_enclave:
        named = enclave_per_node(make_observation(without_enclave), of_tools=True)
        for node in named.observation.nodes:
            judged.append(node)
            denied += _rights_without_enclave(node, enclaves.what)
    if note := _note_on_subjects("undecided", _UNDECIDED_TEXT, undecided):
        notes.append(note)
        topics = counted(len(undecided), "topic")
        unjudged.append(
            (note, f"{topics} without a ROS name ({first_few(sorted(undecided), _MOST_NAMES)})")
        )
    if divided:
        notes.append(
            Note(
                "audit.divided-process", f"{_DIVIDED_TEXT}: {first_subjects(sorted(divided), '; ')}"
            )
        )
    if note := _note_on_subjects("other-enclave", _MISPLACED_TEXT, moved):
        notes.append(note)
    if unclear:
        notes.append(
            Note(
                "audit.several-enclaves",
                f"{_UNCLEAR_TEXT}: {first_subjects(sorted(unclear), '; ')}",
            )
        )
    return Audit(
        _group_by_right(denied),
        refused,
        make_observation(judged),
        tuple(notes),
        expected,
        tuple(sorted(expected - observed_nodes)),
        tuple(words for _, words in unjudged if words),
        tuple(sorted(tools)),
        frozenset(misplaced),
    )


_ONE_ENCLAVE = (
    "give these nodes one enclave (`sros merge_policy POLICY OTHER --enclave ENCLAVE`, with --node "
    "for each, and a POLICY without these nodes), and audit the new policy"
)
_DIVIDED_TEXT = (
    "no single enclave has all nodes of these processes, but a process runs in one enclave; sros "
    "judged the enclave with the fewest denials, and leaves the nodes of other enclaves out of a "
    f"patch; {_ONE_ENCLAVE}"
)
_MISPLACED_TEXT = (
    "left out of a patch, because these nodes have another enclave, and a node belongs in only "
    "one; start each process in its enclave, or, if one process runs nodes of several enclaves, "
    f"{_ONE_ENCLAVE}"
)
_UNCLEAR_TEXT = (
    "several enclaves have these nodes, and the graph does not show in which of them they run; "
    "sros judged all of them; start each process with `--ros-args --enclave /its/name` to "
    "distinguish them"
)
_TOOLS_TEXT = (
    "left out, because these nodes are tools that only observe the robot; on the secured robot "
    "they need an enclave such as the one in operator_look.xml (`sros policies --copy`)"
)
_WRITING_TOOLS_TEXT = (
    "not judged, because these nodes have names of the command `ros2`; since they write, on the "
    "secured robot they need an enclave such as the one in operator_drive.xml (`sros policies "
    "--copy`)"
)
_ENDED_TEXT = (
    "judged as well, although these nodes ended while the graph was observed; on a robot without "
    "security, anyone on the network can show such nodes"
)
_SILENT_TEXT = "not judged, because these nodes were announced but had no endpoint"
_UNDECIDED_TEXT = (
    "not judged, because these topics have no ROS name, and the permissions that decide on them do "
    "not load (`sros check` on the keystore says why)"
)
_STRAYS_TEXT = "not judged, because the writers or readers of these topics belong to no ROS node"


def _unjudged_notes(
    observation: Observation, tools: frozenset[ObservedNode]
) -> list[tuple[Note, str]]:
    """Return notes on what was not judged, each with a text that has the number and the names.

    The text is "" for tools that only observe.
    """
    silent = {(expand("~", ns, name), is_tool_name(name)) for _, ns, name in observation.silent}
    observing = {node.fqn for node in tools if not writing_rights(node)}
    observing |= {name for name, tool in silent if tool}
    silent_nodes = {name for name, tool in silent if not tool}
    strays = {endpoint.topic for _, endpoint in observation.strays}
    writing = {
        f"{node.fqn} {first_few(rights, _MOST_NAMES)}"
        for node in tools
        if (rights := writing_rights(node))
    }
    notes = [
        (_note_on_subjects("tool", _TOOLS_TEXT, observing), "", observing),
        (
            _note_on_subjects("tool-writes", _WRITING_TOOLS_TEXT, writing),
            f"{counted(len(writing), 'node')} with a tool's name",
            writing,
        ),
        (
            _note_on_subjects("silent", _SILENT_TEXT, silent_nodes),
            f"{counted(len(silent_nodes), 'node')} without endpoints",
            silent_nodes,
        ),
        (
            _note_on_subjects("stray", _STRAYS_TEXT, strays),
            f"{counted(len(strays), 'topic')} without a node",
            strays,
        ),
    ]
    return [
        (note, f"{words} ({first_few(sorted(names), _MOST_NAMES)})" if words else "")
        for note, words, names in notes
        if note
    ]


def notes_on_ended_nodes(
    nodes: Iterable[ObservedNode], everything: Observation
) -> tuple[Note, ...]:
    """Return a note on nodes that ended while the graph was observed, without tools.

    ``everything`` has all observed nodes.
    """
    ended = {node.fqn for node in {*nodes} - tool_nodes(everything.nodes)}
    note = _note_on_subjects("ended", _ENDED_TEXT, ended)
    return (note,) if note else ()


def _note_on_subjects(kind: str, text: str, subjects: Iterable[str]) -> Note | None:
    names = sorted(subjects)
    return Note(f"audit.{kind}", f"{text}: {first_subjects(names)}") if names else None


_MOST_NAMES = 3


def _enclaves_of(
    process: Sequence[ObservedNode], known: EnclaveNodes
) -> tuple[frozenset[str], bool]:
    """Return the enclaves in which a process may run, and whether all nodes of the process fit.

    The enclave that the graph shows counts even if it is meant for other nodes.
    """
    shown = process[0].enclaves
    if shown and shown != UNSHOWN:
        return frozenset(shown).intersection(known.by_enclave), True
    each_for = [enclaves for node in process if (enclaves := known.enclaves_for(node.fqn))]
    common = frozenset.intersection(*each_for) if each_for else frozenset[str]()
    if common:
        return common, True
    if each_for:
        return frozenset().union(*each_for), False
    return frozenset(shown).intersection(known.by_enclave), True


@dataclass(frozen=True, slots=True)
class _Judgement:
    """The rights that a process would be denied in an enclave.

    ``refused`` is the reason why the process cannot start in the enclave, or "".  ``undecided`` are
    topics without a ROS name: only permissions decide on these, and the permissions do not load.
    """

    denied: tuple[DeniedRight, ...]
    refused: str = ""
    undecided: frozenset[str] = frozenset()


def _judge(process: Sequence[ObservedNode], enclave: str, enclaves: AuditedEnclaves) -> _Judgement:
    evaluator, zenoh = enclaves.evaluator(enclave), enclaves.zenoh
    join = evaluator.answer(Question("join"))
    refused = "" if join.allowed else join.decision.clause
    if zenoh:
        refused = zenoh.answer(enclave, Question("join"), reach=False, brief=True).why_stopped
    if refused:
        return _Judgement((), refused)
    denied = [
        right
        for node in process
        if join.allowed
        for right in _denied_rights(node, process, enclave, enclaves)
    ]
    if zenoh:
        by_permissions = {denied_right.right for denied_right in denied}
        dropped = (right for node in process for right in _dropped_rights(node, enclave, zenoh))
        denied += (right for right in dropped if right.right not in by_permissions)
    used = () if join.allowed else (right for n in process for right, _ in _rights_of(n, enclave))
    undecided = frozenset(right.name for right in used if right.kind == "dds")
    return _Judgement(tuple(denied), undecided=undecided)


def _denied_rights(
    node: ObservedNode, process: Sequence[ObservedNode], enclave: str, enclaves: AuditedEnclaves
) -> Iterator[DeniedRight]:
    parts = tuple(Part(AccessVerb(e.direction), e.topic) for e in sorted(node.endpoints))
    if not parts:
        return
    answer = enclaves.evaluator(enclave).answer(Question(_USE_WORD, only=parts))
    decisions = {
        Endpoint(part.topic, part.verb.value): decision
        for part, decision in answer.parts
        if not decision.outcome.ok
    }
    if not decisions:
        return
    used = {right for other in process for right, _ in _rights_of(other, enclave)}
    named = named_rights(answer)
    for right, needed in _rights_of(node, enclave):
        endpoints = tuple(endpoint for endpoint in needed if endpoint in decisions)
        if endpoints:
            by_rule = [
                endpoint for endpoint in endpoints if decisions[endpoint].reason == _DENY_RULE
            ]
            reason = decisions[(by_rule or endpoints)[0]].clause
            is_renamed = enclaves.changed_since
            meant = likely_meaning(right, used, named, is_renamed=is_renamed)
            is_its_own = enclave in enclaves.nodes.enclaves_for(node.fqn) and not is_renamed
            if not meant and is_its_own and not enclaves.has_other_side(right):
                meant = unused_name_clause(right, used, named)
            if meant and not by_rule:
                reason = f"{reason}; {meant}"
            yield DeniedRight(right, (node.fqn,), reason, bool(by_rule), False, endpoints)


def _dropped_rights(
    node: ObservedNode, enclave: str, zenoh: ZenohEvaluator
) -> Iterator[DeniedRight]:
    """Yield the rights of a node whose messages a process on Zenoh drops.

    Topics without a ROS name are left out: the files of `sros zenoh` state rights to ROS names.
    """
    for right, needed in _rights_of(node, enclave):
        if right.kind == "dds":
            continue
        question = Question(_USE_WORD, right=right.right, name=right.name)
        answer = zenoh.answer(enclave, question, reach=False)
        if not answer.allowed:
            yield DeniedRight(right, (node.fqn,), answer.text, False, False, needed, by_files=True)


def _rights_of(node: ObservedNode, enclave: str) -> Iterator[tuple[Right, tuple[Endpoint, ...]]]:
    """Yield the rights that a node uses, with the endpoints that need the right."""
    folded = rights_of_endpoints(node.endpoints)
    for right in folded.rights:
        yield (
            Right(enclave, ALLOW, right.right, right.name),
            _endpoints_of_right(right.right, right.name),
        )
    for endpoint in folded.halves | folded.foreign:
        yield Right(enclave, ALLOW, endpoint.direction, endpoint.topic), (endpoint,)


def _endpoints_of_right(right: str, name: str) -> tuple[Endpoint, ...]:
    names = dds_names(right, name)
    return (
        *(Endpoint(topic, PUBLISH) for topic in names.publish),
        *(Endpoint(topic, SUBSCRIBE) for topic in names.subscribe),
    )


def _rights_without_enclave(node: ObservedNode, source: str) -> Iterator[DeniedRight]:
    reason = f"the {source} has no enclave for this node"
    for enclave in node.enclaves:
        for right, needed in _rights_of(node, enclave):
            yield DeniedRight(right, (node.fqn,), reason, False, True, needed)


def _group_by_right(denied: Iterable[DeniedRight]) -> tuple[DeniedRight, ...]:
    """Return the denied rights sorted and without duplicates, with all nodes that use the right."""
    by_right: dict[Right, DeniedRight] = {}
    for right in denied:
        other = by_right.get(right.right, right)
        nodes = tuple(sorted({*other.nodes, *right.nodes}))
        by_right[right.right] = replace(other, nodes=nodes)
    return tuple(by_right[right] for right in sorted(by_right, key=order))


def _nodes_using_denied(denied: Iterable[DeniedRight], observation: Observation) -> Observation:
    """Return the nodes that lack a right, with only the endpoints that need the right.

    Rights that an allow rule would not allow are left out.
    """
    wanted: dict[tuple[str, str], set[Endpoint]] = {}
    for right in denied:
        if not right.can_be_added:
            continue
        needed = set(right.endpoints)
        if right.right.kind != "dds":
            needed.update(_endpoints_of_right(right.right.right, right.right.name))
        for node in right.nodes:
            wanted.setdefault((right.right.enclave, node), set()).update(needed)
    return make_observation(
        replace(
            node,
            enclaves=(enclave,),
            endpoints=node.endpoints.intersection(wanted[enclave, node.fqn]),
        )
        for node in observation.nodes
        for enclave in node.enclaves
        if (enclave, node.fqn) in wanted
    )
