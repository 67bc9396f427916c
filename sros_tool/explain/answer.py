"""A question of ``sros explain``, and its answer: outcome, deciding rule, and policy lines.

Nodes speak of calling and serving; a policy says request and reply for services, and call and
execute for actions.  Mapping of names: ROS 2 design "Topic and Service name mapping to DDS".

``--json`` prints the classes in this module; their docstrings are the descriptions in the schema.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from enum import StrEnum
from shlex import quote
from typing import Annotated, NamedTuple

from sros_tool.dds.decision.access import (
    Access,
    AccessVerb,
    Decision,
    Outcome,
    OutcomeWord,
    ReasonWord,
)
from sros_tool.dds.decision.grants import read_date
from sros_tool.dds.decision.vendors import Vendor
from sros_tool.dds.governance import DomainRule, ProtectionKind, TopicRule
from sros_tool.dds.permissions import Grant
from sros_tool.errors import UsageError
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    CLOSED_POLICY,
    CRL_FILE,
    FLEET,
    IDENTITY_CA_FILE,
    KEY_FILE,
    KEY_URI_FILE,
    folder_of_closed_robot,
    is_original_keystore,
)
from sros_tool.keystore.loading import starts_without_security
from sros_tool.keystore.participant import JoinContext, LoadedEnclave, VendorParticipant
from sros_tool.keystore.reader import OpenedKeystore, Problem
from sros_tool.names import (
    ACTION_PARTS,
    ACTION_SEPARATOR,
    ROS_DISCOVERY_TOPIC,
    dds_names,
    expression_problem,
    is_expression,
    service_of,
)
from sros_tool.policy.model import ALLOW, DENY, Enclave, Group, Profile, Qualifier, Source
from sros_tool.policy.rights import PlacedRight, Right, placed_rights
from sros_tool.values import Words, shows

_JOIN = "join"
TYPES = ("topic", "service", "action")
_RIGHT_OF_WORD_AND_TYPE = {
    ("publish", "topic"): "publish",
    ("subscribe", "topic"): "subscribe",
    ("call", "service"): "request",
    ("serve", "service"): "reply",
    ("call", "action"): "call",
    ("execute", "action"): "execute",
    ("request", "service"): "request",
    ("reply", "service"): "reply",
}
WORDS = (*dict.fromkeys(word for word, _ in _RIGHT_OF_WORD_AND_TYPE), _JOIN)
"""The words of questions; in policies, request and reply stand for call and serve of services."""

_ROLES = {"rq": "requests", "rr": "replies"}


@shows("verb", "topic", "role", null_if_empty=("role",))
class Part(NamedTuple):
    """A DDS endpoint that a right needs; ``role`` names it in ROS terms, "" for a topic."""

    verb: AccessVerb
    """What the endpoint does; ``join`` for the participant that joins the domain."""
    topic: str
    """DDS topic of the endpoint."""
    role: str = ""
    """Role of the endpoint in ROS terms, such as ``requests``; empty (null in JSON) for a topic."""

    def __str__(self) -> str:
        """Return text like ``publish its requests (rq/addRequest)``."""
        return f"{self.verb.value} its {self.role} ({self.topic})" if self.role else self.topic


_OWN_PARTS = (
    Part(AccessVerb.PUBLISH, ROS_DISCOVERY_TOPIC, "node names"),
    Part(AccessVerb.SUBSCRIBE, ROS_DISCOVERY_TOPIC, "node names"),
)
"""The endpoints that every ROS 2 process needs to start."""


@shows("word", "type", "right", "name", null_if_empty=("type", "right", "name"))
class Question(NamedTuple):
    """A question about an enclave, such as ``publish topic /chatter``.

    The question is whether the enclave may do ``word`` with ``name``, an absolute ROS name; if
    ``name`` is "", whether the enclave may join.  ``only`` replaces the endpoints that the right
    needs.
    """

    word: str
    """The operation, such as `publish`."""
    type: str = ""
    """`topic`, `service` or `action`; empty (null in JSON) for ``join``."""
    right: str = ""
    """The right of the policy language; empty (null in JSON) for ``join``."""
    name: str = ""
    """The ROS name; empty (null in JSON) for ``join``."""
    only: tuple[Part, ...] = ()

    @property
    def parts(self) -> tuple[Part, ...]:
        """The endpoints that the right needs; empty for joining."""
        if self.only or not self.right:
            return self.only
        names = dds_names(self.right, self.name)
        # A reader expects the goal of an action first.
        written = sorted(
            names.publish, key=lambda topic: f"{ACTION_SEPARATOR}send_goal" not in topic
        )
        published = (Part(AccessVerb.PUBLISH, topic, _role(topic, self.type)) for topic in written)
        read = (
            Part(AccessVerb.SUBSCRIBE, topic, _role(topic, self.type)) for topic in names.subscribe
        )
        return (*published, *read)

    def needed_right(self, enclave: str) -> Right:
        """Return the right that an enclave needs for the access."""
        return Right(enclave, ALLOW, self.right, self.name)

    def __str__(self) -> str:
        """Return text like ``call service /add``."""
        return f"{self.word} {self.type} {self.name}" if self.right else "join the domain"


def ask(word: str, name: str = "", kind: str | None = None) -> Question:
    """Return the question for words of the command line such as ``call /add``.

    Args:
        word: One of `WORDS`.
        name: An absolute ROS name; "" for joining.
        kind: The type of the name: topic, service or action. By default, call means a service.

    Raises:
        UsageError: No node can do ``word`` with this kind of name, or no node could use the name.
    """
    if word not in WORDS:
        raise UsageError(
            f"unknown action {word!r}",
            "",
            f"Ask for {', '.join(WORDS[:-1])} or {WORDS[-1]}.",
        )
    if word == _JOIN:
        if name or kind:
            raise UsageError(
                "join takes no name and no type",
                "The question is whether the enclave may join the domain.",
            )
        return Question(_JOIN)
    fitting = [
        kind_of_name for kind_of_name in TYPES if (word, kind_of_name) in _RIGHT_OF_WORD_AND_TYPE
    ]
    chosen = kind or fitting[0]
    if chosen not in fitting:
        verbs = " or ".join(verb for verb, right in _RIGHT_OF_WORD_AND_TYPE if right == chosen)
        raise UsageError(
            f"nobody can {word} {with_article(chosen)}",
            f"A node can {word} {' or '.join(map(with_article, fitting))}, and "
            f"{verbs} {with_article(chosen)}.",
            f"Leave --type out, or write --type {fitting[0]}.",
        )
    return Question(
        word, chosen, _RIGHT_OF_WORD_AND_TYPE[word, chosen], _checked_name(name, word, chosen)
    )


_WORDS_FOR_ACTIONS = {"call": "call", "serve": "execute"}


def question_about_action(question: Question, rights: Iterable[Right]) -> Question | None:
    """Return the question about an action with the same name, if rights show such an action.

    "call" and "serve" are for services and actions, whose names look the same.  Returns None if
    ``rights`` do not show an action, or if the question is about something else.
    """
    if question.type != "service" or question.word not in _WORDS_FOR_ACTIONS:
        return None
    kinds = {right.kind for right in rights if right.name == question.name}
    if "actions" not in kinds or "services" in kinds:
        return None
    return ask(_WORDS_FOR_ACTIONS[question.word], question.name, "action")


_COMMANDING_SERVICES = ("send_goal", "cancel_goal")
"""The services of an action that command its server; get_result only reads."""


def influencing_parts(question: Question) -> dict[str, Question]:
    """Return a question for each part of an action that is enough to influence the other side.

    An enclave that may only send or cancel goals can already command the server, without the right
    to call the whole action.  An enclave that may only reply or publish for the server can already
    inform the clients.  The result is empty if the question is not about an action.
    """
    if question.type != "action":
        return {}
    parts = {}
    for right, inside in reversed(ACTION_PARTS[question.right]):
        part = inside.removeprefix(ACTION_SEPARATOR)
        if question.right == "execute" or part in _COMMANDING_SERVICES:
            name = question.name + inside
            kind = "topic" if right == "publish" else "service"
            written = (Part(AccessVerb.PUBLISH, t) for t in dds_names(right, name).publish)
            parts[part] = Question(right, kind, right, name, tuple(written))
    return parts


def text_of_parts(question: Question, parts: Iterable[str]) -> str:
    """Return a sentence on what an enclave can do by ``parts`` of an action."""
    does = "command the server" if question.right == "call" else "inform the clients"
    return (
        f"the enclave may do a part of the action, which is enough to {does}: {', '.join(parts)}."
    )


def _checked_name(name: str, word: str, kind: str) -> str:
    """Return the name; raise UsageError if no node can use it."""
    if not name:
        raise UsageError(
            f"{word} needs the name of {with_article(kind)}", "", f"Write `{word} /NAME`."
        )
    problem = expression_problem(name)
    remedy = ""
    if not problem and is_expression(name):
        problem = "It has a wildcard, but a node uses one exact name."
        remedy = "Write one name, as the running robot shows it."
    elif not problem and not name.startswith("/"):
        problem = "It is relative to a node, and an enclave may have nodes of many namespaces."
        full = f"/NODE/{name[1:].lstrip('/') or 'NAME'}"
        remedy = f"Write {full if name.startswith('~') else f'/{name}'}, or /NAMESPACE/... in full."
    elif not problem and name == "/":
        problem = "It is a namespace."
    if problem:
        raise UsageError(f"the name {name!r} is not valid in a question", problem, remedy)
    return name


def with_article(kind: str) -> str:
    """Return text such as ``an action``."""
    return f"an {kind}" if kind[0] in "aeiou" else f"a {kind}"


def _role(topic: str, kind: str) -> str:
    """Return the role of a DDS topic in a service or action, such as ``send_goal requests``.

    The result is "" for a topic of neither.
    """
    if kind == "topic":
        return ""
    service, begin = service_of(topic)
    word = _ROLES.get(begin, "")
    last = (service or topic).rpartition("/")[2]
    return f"{last} {word}".rstrip() if kind == "action" else word


ADDITION = "allow.xml"
"""Name of the file with the rights to add, in proposed commands."""


class Provenance(StrEnum):
    """Whether signed permissions were made from a policy file."""

    SAME = "same"
    """The permissions were made from the policy file as it is now."""
    EQUAL = "equal"
    """The permissions were made from another version or file, which states the same rights."""
    CHANGED = "changed"
    """The policy file states other rights than the permissions have."""
    UNKNOWN = "unknown"
    """No ledger says from which policy the permissions were made."""
    PLANNED = "planned"
    """The answer is about the policy; nothing is signed yet."""


@shows("source", "qualifier", "right", "name", "protection", spread=("source",))
class PolicyLine(NamedTuple):
    """A line of a policy that states a right or a denial.

    ``group`` and ``profile`` are the parts of the policy with the line; ``right`` is the word of
    the policy language.
    """

    source: Source
    qualifier: Qualifier
    """Whether the line allows or denies."""
    right: str
    """The right, such as ``publish``."""
    name: str
    """The name, as written in the policy."""
    group: Group
    profile: Profile

    @property
    def protection(self) -> Annotated[str, Words(("sign", "encrypt"))] | None:
        """The minimum protection that the line demands; null if it demands none."""
        return self.group.protect.lower() if self.group.protect else None

    def __str__(self) -> str:
        """Return text like ``robot.xml:12: ALLOW publish chatter``."""
        return f"{self.source}: {self.stated}"

    @property
    def stated(self) -> str:
        """The qualifier, right and name, like ``ALLOW publish chatter``."""
        return f"{self.qualifier.value} {self.right} {self.name}"


@shows("source", "xml", spread=("source",))
class GroupEdit(NamedTuple):
    """An element of a policy, such as ``<topics>``, that a change replaces or removes."""

    source: Source
    xml: str
    """New XML of the element; empty to remove the element."""


@shows(null_if_empty=("document",))
class PolicyChange(NamedTuple):
    """A change of the policy that would allow the denied access.

    If ``add`` and ``lift`` are empty, the policy needs no change.
    """

    add: tuple[Right, ...]
    """Rights to add."""
    lift: tuple[Right, ...]
    """Denials to remove."""
    document: str
    """A policy with the rights to add, for ``sros merge_policy``; empty (null in JSON) if there are
    none.
    """
    edits: tuple[GroupEdit, ...]
    """Elements of the policy to replace or remove, such as ``<topics publish="ALLOW">``."""


# ── what JSON shows of an answer ───────────────────────────────────────────────────────────


class DecidingRule(NamedTuple):
    """The rule of the permissions that decided the answer."""

    grant: int | None
    """Index of the grant with the rule, from 0."""
    grant_name: str
    """Name of the grant with the rule."""
    rule: int
    """Index of the rule in the grant, from 0."""
    allow: bool
    """Whether the rule allows."""
    expression: str | None
    """The expression that matched, or null."""


class StatedInPolicy(NamedTuple):
    """The part of a policy file that the answer concerns."""

    file: str
    """Path of the policy file."""
    provenance: Provenance
    """Whether the permissions were made from the policy file. ``same``: from this file as it is
    now; ``equal``: from another version or file with the same rights; ``changed``: the file states
    other rights; ``unknown``: no ledger shows it; ``planned``: nothing is signed yet, and the
    answer is about the policy.
    """
    lines: tuple[PolicyLine, ...]
    """The policy lines that the deciding rule comes from."""
    would_allow: bool
    """Whether the policy allows the access once it is signed."""


class AppliedProtection(NamedTuple):
    """The protection that the governance demands for the topic."""

    rtps: ProtectionKind
    """Protection of RTPS messages."""
    discovery: ProtectionKind
    """Protection of discovery."""
    liveliness: ProtectionKind
    """Protection of liveliness messages."""
    topic_expression: str | None
    """The expression of the topic rule that applies; null if none applies: then the following keys
    are also null.
    """
    data: ProtectionKind | None
    """Protection of the payload."""
    metadata: ProtectionKind | None
    """Protection of submessages."""
    read_access_control: bool | None
    """Whether permissions decide who may read."""
    write_access_control: bool | None
    """Whether permissions decide who may write."""


@shows("part", "decision", spread=("part", "decision"))
class DecidedPart(NamedTuple):
    """A DDS endpoint, and the decision about it."""

    part: Part
    decision: Decision


@shows(
    *("vendor", "vendor_title", "documented_only", "allowed", "outcome", "reason", "text"),
    *("denied_by", "rule", "wildcard", "policy", "policy_sha256", "protection", "until"),
    *("until_file", "problems", "parts", "remedy", "change", "commands", "counts_key"),
    null_if_empty=("denied_by", "wildcard", "policy_sha256", "until_file", "remedy"),
)
class Answer(NamedTuple):
    """The decision of a DDS vendor on a question.

    ``decision`` has the outcome; ``part`` is the endpoint that was decided on, or None for joining.
    ``grant`` and ``domain_rule`` are the parts of the documents that apply in the ROS ``domain``.

    `sros_tool.explain.explanation` fills in the other fields.  ``lines`` are the lines of the
    policy file from which the deciding rule comes, and ``provenance`` says whether the permissions
    were made from that file.  ``sign`` says that the current policy file would allow the access
    once it is signed.
    """

    vendor: Vendor
    """The DDS vendor, as `--vendor` takes it."""
    enclave: LoadedEnclave
    question: Question
    outcome: OutcomeWord
    decision: Decision
    part: Part | None = None
    parts: tuple[DecidedPart, ...] = ()
    """The DDS endpoints that the access needs."""
    problems: tuple[Problem, ...] = ()
    """Faults that keep the vendor from loading the enclave."""
    grant: Grant | None = None
    domain_rule: DomainRule | None = None
    domain: int = 0
    until: datetime | None = None
    """The earliest expiry of the enclave's files, in UTC, or null."""
    until_file: str = ""
    """The file that expires first; empty (null in JSON) if no expiry is known."""
    lines: tuple[PolicyLine, ...] = ()
    provenance: Provenance | None = None
    policy_sha256: str = ""
    """SHA-256 of the policy that the permissions were made from; empty (null in JSON) if it is
    unknown.
    """
    change: PolicyChange | None = None
    """The smallest change of the policy that would allow the access, or null."""
    remedy: str = ""
    """What to do if no change of the policy helps; otherwise empty (null in JSON)."""
    sign: bool = False

    @property
    def counts_key(self) -> bool:
        """Whether the answer assumes that the enclave has its key, which is not here."""
        return self.enclave.key_elsewhere

    @property
    def vendor_title(self) -> str:
        """Name and version of the vendor."""
        return self.vendor.title

    @property
    def documented_only(self) -> bool:
        """Whether the vendor's behavior is known only from its documentation, not from tests."""
        return self.vendor.documented_only

    @property
    def as_documented(self) -> bool:
        """Whether this answer relies only on the vendor's documentation, not on tests."""
        return self.vendor.documented_only and not self.problems

    @property
    def allowed(self) -> bool:
        """Whether data can flow."""
        return self.outcome.ok

    @property
    def reason(self) -> ReasonWord:
        """Reason of the decision, as a stable word such as `no-rule`."""
        return self.decision.reason

    @property
    def text(self) -> str:
        """Reason of the decision, as a sentence."""
        return self.decision.text

    @property
    def denied_by(self) -> str:
        """What denies the access: DDS in the process, peers, or a crash.

        If the access is allowed, the text is empty (null in JSON).

        For a crash, the text begins with "nobody".
        """
        match self.outcome:
            case Outcome.ALLOWED:
                return ""
            case Outcome.PEER_DENIES:
                return "the peers: the node starts, and no peer talks to it"
            case Outcome.CRASHES if self.decision.hits_peers:
                return "nobody: the node starts, and the processes of its peers crash"
            case Outcome.CRASHES:
                return "nobody: the process crashes when it starts"
            case Outcome.DENIED if self.part in self.question.parts:
                entity = _CREATED_OBJECTS.get(self.question.word, "it")
                return f"DDS in the process itself: {entity} is not created"
            case _:
                text = "DDS in the process itself: no node of the enclave starts"
                if not starts_without_security(self.problems):
                    return text
                return f"{text} with the strategy Enforce; with Permissive, every node starts open"

    @property
    def rule(self) -> DecidingRule | None:
        """The rule of the permissions that decided the answer; null if no rule decided it."""
        decision, grant = self.decision, self.grant
        if decision.rule is None or grant is None:
            return None
        allow = grant.rules[decision.rule].allow
        return DecidingRule(decision.grant, grant.name, decision.rule, allow, decision.expression)

    @property
    def wildcard(self) -> str:
        """The expression that matched, if it is a wildcard; otherwise empty (null in JSON)."""
        expression = self.decision.expression or ""
        return expression if is_expression(expression) else ""

    @property
    def policy(self) -> StatedInPolicy | None:
        """The lines of the file of `--policy` that matter, or null without `--policy`."""
        if self.provenance is None:
            return None
        file = str(self.enclave.policy_file)
        return StatedInPolicy(file, self.provenance, self.lines, self.sign)

    @property
    def topic_rule(self) -> TopicRule | None:
        """The governance's rule for the topic, or None if it is not known."""
        decisions = (self.decision, *(part.decision for part in self.parts))
        return next((decision.topic_rule for decision in decisions if decision.topic_rule), None)

    @property
    def protection(self) -> AppliedProtection | None:
        """The protection that the governance demands for the topic; null if no domain rule
        applies.
        """
        topic, domain = self.topic_rule, self.domain_rule
        if domain is None:
            return None
        return AppliedProtection(
            rtps=domain.rtps_protection_kind,
            discovery=domain.discovery_protection_kind,
            liveliness=domain.liveliness_protection_kind,
            topic_expression=topic.topic_expression if topic else None,
            data=topic.data_protection_kind if topic else None,
            metadata=topic.metadata_protection_kind if topic else None,
            read_access_control=topic.enable_read_access_control if topic else None,
            write_access_control=topic.enable_write_access_control if topic else None,
        )

    @property
    def is_of_export(self) -> bool:
        """Whether the enclave was exported, so that its keystore may have later permissions."""
        return self.enclave.root is not None and not is_original_keystore(self.enclave.root)

    @property
    def commands(self) -> list[str]:
        """The commands that apply the change of the policy."""
        if not self.change and not self.sign:
            return []
        keystore = self.enclave.root
        robot = folder_of_closed_robot(keystore) if keystore else None
        file = quote(
            str(self.enclave.policy_file or (robot / CLOSED_POLICY if robot else "POLICY"))
        )
        root = quote(str(keystore if keystore and not self.is_of_export else "KEYSTORE"))
        if self.enclave.has_placeholders:
            recorded = keystore and (keystore / FLEET).exists()
            robots = f"{root}/{FLEET}" if recorded else "FLEET_FILE"
            sign = f"sros generate_artifacts -k {root} -p {file} --fleet {robots}"
            return [sign, *self._export_commands(root)]
        commands = []
        if self.change and self.change.document:
            commands.append(f"sros merge_policy {file} {ADDITION} --in-place")
        if robot:
            return [*commands, f"sros close {quote(str(robot))}"]
        sign = f"sros create_permission {root} {self.enclave.name} {file}"
        return [*commands, sign, *self._export_commands(root)]

    def _export_commands(self, root: str) -> list[str]:
        """Return the command that exports an exported enclave again; none for other enclaves."""
        export = f"sros distribute_key {root} {self.enclave.name} TARGET --force"
        return [export] if self.is_of_export else []


_CREATED_OBJECTS = {
    "publish": "the publisher",
    "subscribe": "the subscription",
    "call": "the client",
    "request": "the client",
    "serve": "the server",
    "reply": "the server",
    "execute": "the action server",
}


# ── the policy behind an answer ────────────────────────────────────────────────────────────


def recorded_policy_digest(keystore: OpenedKeystore, signed: bytes) -> str:
    """Return the SHA-256 (hexadecimal) of the policy from which permissions were made, or "".

    The SHA-256 is in the ledger of the keystore; without a ledger or an entry, the result is "".
    """
    digest = hashlib.sha256(signed).hexdigest()
    ledger = keystore.ledger_with("sha256", digest)
    policies = (e.policy for e in reversed(ledger.certain) if e.sha256 == digest)
    return next(policies, "")


def template_default(digest: str) -> str:
    """Return the default policy of keystore templates that has this digest, or "".

    ``digest`` is from `recorded_policy_digest`.  The result is "everything" or "node_basics", as in
    ``permissions.default`` of a template.
    """
    from sros_tool.files import policies_dir
    from sros_tool.policy.document import read_policy

    files = sorted((policies_dir() / "defaults").glob("*.xml"))
    return next((f.stem for f in files if read_policy(f).enclaves[0].digest == digest), "")


def deciding_lines(policy: Enclave, answer: Answer) -> tuple[PolicyLine, ...]:
    """Return the lines of an enclave's policy from which the deciding rule of an answer comes.

    There may be several lines, because several nodes of an enclave may have the same right.
    """
    expression, part = answer.decision.expression, answer.part
    if part is None or not expression or answer.grant is None:
        return ()
    rule = answer.grant.rules[answer.decision.rule or 0]
    qualifier = ALLOW if rule.allow else DENY
    # Cyclone DDS also denies a topic because of a deny rule for the other direction.
    other = AccessVerb.SUBSCRIBE if part.verb is AccessVerb.PUBLISH else AccessVerb.PUBLISH
    for verb in (part.verb, other):
        lines = tuple(
            _policy_line(placed)
            for placed in placed_rights(policy)
            if placed.right.qualifier is qualifier
            and expression in getattr(placed.right.topics, verb)
        )
        if lines:
            return lines
    return ()


def lines_of_right(policy: Enclave, right: Right) -> tuple[PolicyLine, ...]:
    """Return the lines of an enclave's policy that state a right or denial."""
    stated = (placed for placed in placed_rights(policy) if placed.right[1:] == right[1:])
    return tuple(map(_policy_line, stated))


def _policy_line(placed_right: PlacedRight) -> PolicyLine:
    right, written, source, group, profile = placed_right
    return PolicyLine(source, right.qualifier, right.right, written, group, profile)


# ── what a vendor decides ──────────────────────────────────────────────────────────────────

_WORST_FIRST = (
    Outcome.CRASHES,
    Outcome.REFUSED,
    Outcome.DENIED,
    Outcome.PEER_DENIES,
    Outcome.ALLOWED,
)


_CERTIFICATE_FILES = frozenset({CERTIFICATE_FILE, IDENTITY_CA_FILE, CRL_FILE})


class Evaluator:
    """Answers questions to one vendor about one enclave."""

    def __init__(self, vendor: Vendor, enclave: LoadedEnclave, context: JoinContext) -> None:
        self.vendor = vendor
        self.enclave = enclave
        self.context = context
        self._participant = VendorParticipant(vendor, enclave, context)
        self._until_file, self._until = self._first_expiry()

    @property
    def access(self) -> Access | None:
        """Access of a process on this vendor; None if no process starts, or peers refuse each
        process.
        """
        return self._participant.access

    @property
    def has_accepted_certificate(self) -> bool:
        """Whether a process with the key of the enclave can use its certificate."""
        return _CERTIFICATE_FILES.isdisjoint(problem.file for problem in self._participant.problems)

    def for_other_certificates(self) -> Evaluator:
        """Return an evaluator for other certificates that the permissions fit.

        Faults of the enclave's own certificate and key do not count for this evaluator.
        """
        faulty = {problem.file for problem in self._participant.problems}
        if not faulty or faulty - {*_CERTIFICATE_FILES, KEY_FILE, KEY_URI_FILE}:
            return self
        return Evaluator(self.vendor, self.enclave._replace(state=None), self.context)

    def answer(self, question: Question) -> Answer:
        """Return the answer to a question, without policy lines, change and remedy."""
        access = self.access
        own_decisions: list[tuple[Part | None, Decision]] = [(None, self._participant.join())]
        if access is None:
            return self._combined_answer(question, own_decisions)
        if own_decisions[0][1].outcome not in (Outcome.REFUSED, Outcome.CRASHES):
            own_decisions += [(part, access.decide(part.verb, part.topic)) for part in _OWN_PARTS]
        asked = tuple(
            DecidedPart(part, access.decide(part.verb, part.topic)) for part in question.parts
        )
        return self._combined_answer(question, own_decisions, asked)

    def _combined_answer(
        self,
        question: Question,
        own_decisions: Sequence[tuple[Part | None, Decision]],
        asked: tuple[DecidedPart, ...] = (),
    ) -> Answer:
        """Return the answer that follows from the decisions on the process and on its endpoints."""
        decided = [*own_decisions, *asked]
        outcome = min((decision.outcome for _, decision in decided), key=_WORST_FIRST.index)
        # The first topic of the question explains an allowed outcome; any other outcome is
        # explained by the first decision that has it.
        deciding = next(pair for pair in decided if pair[1].outcome is outcome)
        part, decision = asked[0] if asked and outcome.ok else deciding
        grant, permissions = None, self._participant.permissions
        if decision.grant is not None and permissions:
            grant = permissions.grants[decision.grant]
        return Answer(
            vendor=self.vendor,
            enclave=self.enclave,
            question=question,
            outcome=outcome,
            decision=decision,
            part=part,
            parts=asked,
            problems=self._participant.problems,
            grant=grant,
            domain_rule=self._domain_rule(),
            domain=self.context.domain,
            until=self._until,
            until_file=self._until_file,
        )

    def _domain_rule(self) -> DomainRule | None:
        governance = self._participant.governance
        rules = governance.domain_access_rules if governance else ()
        return next((r for r in rules if self.context.domain in r.domains.closed()), None)

    def _first_expiry(self) -> tuple[str, datetime | None]:
        """Return the enclave's file that expires first, and its expiry; or ("", None)."""
        expiries = list(self.enclave.expiries())
        access, permissions = self.access, self._participant.permissions
        if permissions and access:
            index = access.join().grant
            text = "" if index is None else permissions.grants[index].not_after
            moment = read_date(self.vendor.traits.date_rule, text, self.context.zone)
            if self.enclave.signed and moment is not None and 0 < moment < 2**40:
                expiries.append(("permissions.p7s", datetime.fromtimestamp(moment, UTC)))
        return min(expiries, key=lambda pair: pair[1], default=("", None))
