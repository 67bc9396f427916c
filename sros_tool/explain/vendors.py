"""The decisions of DDS vendors on one enclave, or on all enclaves of a keystore."""

from __future__ import annotations

import stat
from collections.abc import Callable, Iterable, Iterator, Sequence
from enum import Enum, auto
from fnmatch import fnmatchcase
from shlex import quote
from typing import NamedTuple

from sros_tool.dds.decision.access import AccessVerb, Outcome, OutcomeWord, ReasonWord
from sros_tool.dds.decision.grants import other_fitting_enclaves
from sros_tool.dds.decision.vendors import DEFAULT_RELEASES, Vendor
from sros_tool.dds.domains import DomainSet
from sros_tool.distributions import SUPPORTED, Shipped
from sros_tool.errors import Note, SrosError
from sros_tool.explain.answer import (
    Answer,
    Evaluator,
    Provenance,
    Question,
    influencing_parts,
    text_of_parts,
)
from sros_tool.explain.asking import (
    AskedEnclave,
    AskedQuestion,
    AskingContext,
    ZenohInBrief,
    domains_decided_alike,
    note_on_action,
    note_on_lacking_keys,
    planned_enclave,
    question_meant,
    rights_naming,
)
from sros_tool.explain.explanation import (
    explain,
    lacking_part,
    likely_actions,
    likely_names,
    named_rights,
    remapping_clause,
)
from sros_tool.faults import REFUSE_STRANGERS, Fault
from sros_tool.keystore.layout import (
    KEY_FILE,
    SETTINGS,
    ZENOH_SIGNED,
    has_zenoh_files,
    is_keystore,
    is_original_keystore,
    remedy_in_keystore,
)
from sros_tool.keystore.participant import (
    JoinContext,
    LoadedEnclave,
    deciding_enclave,
    load_enclave_of,
)
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.names import is_expression, node_of_service
from sros_tool.owners import is_for_root_alone
from sros_tool.policy.model import ALLOW, OFFERING_RIGHT, PEER_RIGHT, Policy
from sros_tool.policy.rights import Right, is_of_every_node, policy_rights
from sros_tool.values import shows
from sros_tool.wording import enumerated, first_few, perhaps_meant


@shows("zenoh")
class ZenohNextToDds(NamedTuple):
    """The decision of Zenoh, shown next to the decision of DDS.

    ``problem`` is the reason that the decision is not known, or "".
    """

    zenoh: ZenohInBrief | None
    """Decision of Zenoh with the files of the keystore, or null if it is not known; present only if
    the keystore has Zenoh files."""
    problem: str = ""


@shows(
    "asked",
    "answer",
    "vendor_why",
    "zenoh_next_to_dds",
    spread=("asked", "answer", "zenoh_next_to_dds"),
)
class VendorExplanation(NamedTuple):
    """The decision of one DDS vendor."""

    asked: AskedQuestion
    answer: Answer
    vendor_why: str
    """Reason for the choice of this vendor."""
    zenoh_next_to_dds: ZenohNextToDds | None
    notes: tuple[Note, ...]

    @property
    def allowed(self) -> bool:
        """Whether the vendor allows the access."""
        return self.answer.allowed


@shows("distribution", "release", "measured", "decided_as", "outcome", "reason", "text")
class DistributionAnswer(NamedTuple):
    """The decision of a DDS that a ROS 2 distribution ships."""

    shipped: Shipped
    answer: Answer

    @property
    def distribution(self) -> str:
        """Name of the distribution, such as ``jazzy``."""
        return self.shipped.distribution.name

    @property
    def release(self) -> str:
        """DDS product and release that the distribution ships."""
        return self.shipped.release

    @property
    def measured(self) -> bool:
        """Whether the deciding rules were tested with this release of the DDS."""
        return self.shipped.tested

    @property
    def decided_as(self) -> Vendor:
        """The DDS vendor by whose rules sros decides."""
        return self.answer.vendor

    @property
    def outcome(self) -> OutcomeWord:
        """Decision of the vendor."""
        return self.answer.outcome

    @property
    def reason(self) -> ReasonWord:
        """Id of the reason for the decision."""
        return self.answer.reason

    @property
    def text(self) -> str:
        """The decision and its reason, as a sentence."""
        return self.answer.text


@shows(
    *("asked", "vendors", "distributions", "differ", "zenoh_next_to_dds"),
    optional=("vendors", "distributions"),
    spread=("asked", "zenoh_next_to_dds"),
)
class Comparison(NamedTuple):
    """The decisions of all DDS vendors, or of the DDS of all supported distributions.

    ``allowed`` says whether the chosen vendor allows the access.
    """

    asked: AskedQuestion
    vendors: Sequence[Answer] | None
    """The decision of each vendor; present only with ``--all-vendors``."""
    distributions: Sequence[DistributionAnswer] | None
    """The decision for each DDS of each distribution, the earliest distribution first; present
    only with ``--all-distros``.
    """
    zenoh_next_to_dds: ZenohNextToDds | None
    allowed: bool
    notes: tuple[Note, ...]

    @property
    def differ(self) -> bool:
        """Whether the decisions differ."""
        return len({answer.outcome for answer in self.vendors or self.distributions or ()}) > 1

    @property
    def sentence(self) -> str:
        """A sentence on the vendors or distributions that decide differently than the first."""
        if self.vendors:
            return _vendor_differences_sentence(self.vendors)
        decided = [(answer.shipped.title, answer.outcome) for answer in self.distributions or ()]
        return _differences_clause("distributions", decided)


DdsExplanation = VendorExplanation | Comparison


class ComparedDecisions(Enum):
    """The deciders whose decisions are compared: all vendors, or all distributions."""

    VENDORS = auto()
    DISTRIBUTIONS = auto()


def explain_on_dds(
    asked_enclave: AskedEnclave,
    question: Question,
    chosen_vendor: tuple[Vendor, str],
    context: JoinContext,
    *,
    kind: str | None = None,
    compared: ComparedDecisions | None = None,
) -> DdsExplanation:
    """Return the decision of the chosen vendor, or of all vendors or distributions.

    ``chosen_vendor`` is the vendor and the reason to choose it; ``kind`` is the kind of the name
    (topic, service or action) if the user gave it; ``compared`` selects the decisions to compare.
    """
    vendor, why = chosen_vendor
    enclave = asked_enclave.enclave
    if question.word == "join":
        enclave = enclave.on_this_machine
    evaluator = Evaluator(vendor, enclave, context)
    question, taken = question_meant(evaluator, asked_enclave, question, kind)
    answer = explain(evaluator, question)
    zenoh_next_to_dds = _zenoh_decision(enclave, question, context)
    is_on_robot = enclave.state is not None and enclave.state.key_on_robot
    copied = enclave.keystore if answer.counts_key and not is_on_robot else None
    refuse = f"Run {REFUSE_STRANGERS}."
    if enclave.keystore:
        refuse = remedy_in_keystore(enclave.keystore.root, refuse)
    notes = (
        *taken,
        *_provenance_notes(answer),
        *_export_notes(answer),
        *_note_on_action(evaluator, answer, kind),
        *_note_on_parts(evaluator, answer),
        *_not_a_topic_notes(answer, asked_enclave),
        *_other_name_notes(answer, asked_enclave),
        *_note_on_fitting_permissions(evaluator, answer),
        *(note_on_lacking_keys(copied) if copied else ()),
        *_notes_on_files(enclave),
        *_earlier_permissions_notes(answer, context),
        *_note_on_anybody([_access_without_identity(evaluator, question)], refuse),
    )
    asked = AskedQuestion(enclave.name, question, context)
    if compared is ComparedDecisions.VENDORS:
        evaluators = {v: Evaluator(v, enclave, context) for v in Vendor if v is not vendor}
        answers = [answer if v is vendor else explain(evaluators[v], question) for v in Vendor]
        return Comparison(asked, answers, None, zenoh_next_to_dds, answer.allowed, notes)
    if compared is ComparedDecisions.DISTRIBUTIONS:
        deciding = {v for distribution in SUPPORTED for v in distribution.vendors}
        by_vendor = {v: Evaluator(v, enclave, context).answer(question) for v in deciding}
        by_distribution = [
            DistributionAnswer(shipped, by_vendor[shipped.vendor])
            for distribution in SUPPORTED
            for shipped in distribution.shipped
        ]
        return Comparison(asked, None, by_distribution, zenoh_next_to_dds, answer.allowed, notes)
    tested = [
        answer if v is vendor else Evaluator(v, enclave, context).answer(question)
        for v in DEFAULT_RELEASES
    ]
    if len({tested_answer.outcome for tested_answer in tested}) > 1:
        notes = (*notes, Note("explain.vendors-differ", f"{_vendor_differences_sentence(tested)}."))
    return VendorExplanation(asked, answer, why, zenoh_next_to_dds, notes)


def _vendor_differences_sentence(answers: Sequence[Answer]) -> str:
    """Return a sentence that names the vendors whose outcome differs from the first vendor's."""
    return _differences_clause(
        "vendors", [(answer.vendor.title, answer.outcome) for answer in answers]
    )


def _differences_clause(who: str, decided: Sequence[tuple[str, Outcome]]) -> str:
    """Return a clause that names whose outcome differs from the first one's.

    ``who`` is a plural, such as "vendors"; ``decided`` has a title and an outcome for each of them.
    If all outcomes are equal, the clause says that all decide alike.
    """
    title, first = decided[0]
    differing = [f"{other} ({outcome})" for other, outcome in decided if outcome != first]
    if not differing:
        return f"all {who} decide alike"
    return f"{who.upper()} DIFFER: {title} ({first}), but {', '.join(differing)}"


# ── notes ──────────────────────────────────────────────────────────────────────────────────


def _provenance_notes(answer: Answer) -> Iterator[Note]:
    policy = answer.enclave.policy_file
    match answer.provenance:
        case Provenance.CHANGED:
            text = (
                f"the permissions were not made from the current '{policy}', which states other "
                "rights. The lines shown are from the current file."
            )
        case Provenance.UNKNOWN:
            why = (
                "an export has no ledger, so sros cannot"
                if answer.is_of_export
                else "the ledger does not"
            )
            text = f"{why} say whether the permissions were made from '{policy}'."
            if answer.sign:
                text = f"'{policy}' allows this: the permissions are older, or from another policy."
        case _:
            return
    yield Note(f"explain.policy-{answer.provenance}", text)


def _export_notes(answer: Answer) -> Iterator[Note]:
    """Yield a note if an export denies an access that its keystore may already allow."""
    if answer.change and answer.is_of_export:
        text = (
            "these files are from an export. If the policy of the keystore already allows this, "
            f"the export is older than that policy: then `{answer.commands[-1]}` alone is enough."
        )
        yield Note("explain.exported", text)


def _earlier_permissions_notes(answer: Answer, context: JoinContext) -> Iterator[Note]:
    """Yield a note if earlier permissions of the enclave may allow what is denied."""
    if (keystore := answer.enclave.keystore) and not answer.allowed:
        from sros_tool.explain.earlier import note_on_earlier_permissions  # only for denials

        denied = {answer.enclave.name}
        stopped = denied if _is_stopped(answer.outcome) else ()
        asking = AskingContext(context.at, context.zone, context.domain)
        yield from note_on_earlier_permissions(
            keystore, denied, stopped, answer.question, answer.vendor, asking
        )


def _is_stopped(outcome: Outcome) -> bool:
    """Return whether no process runs in the enclave, whatever its permissions allow."""
    return outcome in (Outcome.REFUSED, Outcome.CRASHES)


def _note_on_action(evaluator: Evaluator, answer: Answer, kind: str | None) -> Iterator[Note]:
    """Yield a note if the enclave may call an action with the name of the denied service."""

    def decide(action: Question) -> tuple[bool, Sequence[str]]:
        decided = evaluator.answer(action)
        return decided.allowed, _allowed_parts(evaluator, decided)

    if not answer.allowed:
        yield from note_on_action(answer.question, kind, decide)


def _note_on_parts(evaluator: Evaluator, answer: Answer) -> Iterator[Note]:
    """Yield a note if the enclave is denied an action as a whole, but may use a part of it."""
    if parts := _allowed_parts(evaluator, answer):
        yield Note("explain.in-part", text_of_parts(answer.question, parts))


def _allowed_parts(evaluator: Evaluator, answer: Answer) -> tuple[str, ...]:
    """Return the `influencing_parts` of a denied action that the enclave may use."""
    questions = {} if answer.allowed else influencing_parts(answer.question)
    return tuple(part for part, asked in questions.items() if evaluator.answer(asked).allowed)


def _not_a_topic_notes(answer: Answer, asked_enclave: AskedEnclave) -> Iterator[Note]:
    """Yield a note if a denied topic has the name of a service or an action."""
    name = answer.question.name
    if answer.question.type != "topic" or answer.allowed or answer.problems:
        return
    kinds = {right.kind for right in asked_enclave.other_rights(name) if right.name == name}
    if kinds & {"services", "actions"} and "topics" not in kinds:
        kind, word = ("an action", "execute") if "actions" in kinds else ("a service", "serve")
        text = (
            f"in the policy or keystore, {name} is {kind}, not a topic: ask about call or {word}."
        )
        yield Note("explain.no-topic", text)


def _other_name_notes(answer: Answer, asked_enclave: AskedEnclave) -> Iterator[Note]:
    """Yield a note on names that may be meant, if no peer has a right to the denied name.

    For a right that a common part gives to a node, the note names the part instead. A name
    to which a peer has a right is no mistake.
    """
    question = answer.question
    if answer.allowed or answer.problems or not question.right:
        return
    denied = question.needed_right(answer.enclave.name)
    part = lacking_part(denied, named_rights(answer))
    if part and answer.decision.reason != "deny-rule":
        yield Note("explain.common-part", f"{part.reason}: {part.advice}.")
        return
    needed = PEER_RIGHT[question.right]
    rights = asked_enclave.other_rights(question.name)
    if question.right == "reply" and (node := node_of_service(question.name)):
        wanted = ("reply", ALLOW, question.name)
        own = {each.enclave for each in rights if (each.right, each.qualifier, each.name) == wanted}
        if own:
            text = (
                f"this is a service of the node {node}, for which there is "
                f"{enumerated(sorted(own))}: start the node in that enclave."
            )
            yield Note("explain.other-node", text)
            return
    if any((right.right, right.name) == (needed, question.name) for right in rights):
        return
    if names := likely_names(answer):
        may = f"the enclave may {question.word} {enumerated(names)}"
        text = f"{may}: {perhaps_meant(names)}"
        is_moved = {name.rpartition("/")[2] for name in names} == {question.name.rpartition("/")[2]}
        if len(names) == 1 and is_moved and question.type != "action":
            text += f" ({remapping_clause(question.name, names[0])})"
        yield Note("explain.likely-name", f"{text}.")
    elif names := likely_actions(answer):
        does = "call" if question.right == "request" else "execute"
        text = f"the enclave may {does} action {enumerated(names)}: {perhaps_meant(names)}"
        yield Note("explain.likely-name", f"{text} (add --type action).")
    elif asked_enclave.has_peers and not is_of_every_node(question.name):
        kind, does = ("not-used", "needs")
        if question.right in OFFERING_RIGHT:
            kind, does = ("not-offered", "offers")
        text = f"no enclave that was read has a right to {needed} exactly {question.name}"
        meant = f"perhaps no other node {does} {question.name}, and this node lacks a remapping."
        match asked_enclave.wildcard_matches(needed, question.name):
            case None:
                text += f", but a right with a wildcard may match it. If none does, {meant}"
            case []:
                text += f", nor a wildcard that matches it: {meant}"
            case [right, *_]:
                user = right.enclave
                text += f"; by a wildcard, {user} may {right.describe()}. If {user} does not use "
                text += f"{question.name}, {meant}"
        yield Note(f"explain.{kind}", text)


def _notes_on_files(enclave: LoadedEnclave) -> Iterator[Note]:
    """Yield notes on a key that only root can read, and a revocation list that is left out."""
    for problem in enclave.state.problems if enclave.state else ():
        if problem.fault is Fault.CRL_LEFT_OUT:
            text = f"{problem}: nodes of the enclave continue to communicate with revoked enclaves."
            yield Note("explain.crl-left-out", text)
    key = enclave.folder / KEY_FILE if enclave.folder else None
    if key and key.is_file() and is_for_root_alone(mode := key.stat().st_mode):
        text = (
            f"the mode of '{key}' is {stat.S_IMODE(mode):04o}, so only root can read it: a process "
            f"of another user does not start in the enclave. Run `chmod 600 {quote(str(key))}`."
        )
        yield Note("explain.key-mode", text)


def _note_on_fitting_permissions(evaluator: Evaluator, answer: Answer) -> Iterator[Note]:
    """Yield a note if permissions of another enclave fit a denied enclave, and allow the access."""
    if answer.allowed or not answer.question.right:
        return
    holders = [
        holder.enclave.name
        for holder in _enclaves_with_fitting_permissions(evaluator)
        if holder.for_other_certificates().answer(answer.question).allowed
    ]
    if holders:
        text = (
            f"whoever has the key of {evaluator.enclave.name} may do it with the permissions of "
            f"{first_few(holders, 3)}: they fit the certificate of this enclave, and are not "
            "secret. Choose names that do not consist of parts of another name, or unique "
            "subjects (template production)."
        )
        yield Note("explain.fitting-permissions", text)


def _enclaves_with_fitting_permissions(evaluator: Evaluator) -> Iterator[Evaluator]:
    """Yield evaluators of other enclaves whose permissions also fit this enclave's certificate.

    Reads only enclaves whose paths have all parts of the enclave's path.
    """
    enclave, keystore = evaluator.enclave, evaluator.enclave.keystore
    own_parts, certified = {*enclave.name.split("/")}, {enclave.name: enclave.subject}
    if keystore is None or enclave.state is None or not evaluator.has_accepted_certificate:
        return
    for name in keystore.names:
        if name == enclave.name or not own_parts <= {*name.split("/")}:
            continue
        holder = deciding_enclave(keystore, name, moment=evaluator.context.at)
        grant = holder.state.grant if holder.state else None
        granted = {name: [grant.subject] if grant else []}
        if other_fitting_enclaves(evaluator.vendor.traits, certified, granted):
            yield Evaluator(evaluator.vendor, holder, evaluator.context)


# ── Zenoh, next to it ──────────────────────────────────────────────────────────────────────


def _zenoh_decision(
    enclave: LoadedEnclave, question: Question, context: JoinContext
) -> ZenohNextToDds | None:
    """Return Zenoh's decision, or the reason that it is unknown; None without Zenoh files."""
    keystore = enclave.keystore
    if keystore is None or enclave.state is None or not is_keystore(keystore.root):
        return None
    if not _runs_on_zenoh(keystore, enclave.name):
        return None
    from sros_tool.explain.zenoh import ZenohEvaluator  # many keystores are not for Zenoh

    try:
        evaluator = ZenohEvaluator(keystore, moment=context.at, domain=context.domain)
        answer = evaluator.answer(enclave.name, question, reach=False, brief=True)
    except SrosError as error:
        return ZenohNextToDds(None, error.what)
    return ZenohNextToDds(answer.in_brief)


def _runs_on_zenoh(keystore: OpenedKeystore, enclave: str) -> bool:
    """Return whether an enclave has Zenoh files, or the keystore is set up for Zenoh.

    If the settings have no [zenoh] part, other enclaves are not examined, because there may be
    thousands.
    """
    if any((keystore.folder(enclave) / file).is_file() for file in ZENOH_SIGNED):
        return True
    try:
        named = b"zenoh" in keystore.read(SETTINGS, "settings file")
    except SrosError:
        named = keystore.has(SETTINGS)
    return named and has_zenoh_files(keystore.root)


# ── many enclaves ──────────────────────────────────────────────────────────────────────────


class AccessWithoutIdentity(NamedTuple):
    """The access of processes without an identity: a right, or else its `influencing_parts`."""

    whole: bool = False
    parts: tuple[str, ...] = ()

    @staticmethod
    def joined(opened: Iterable[AccessWithoutIdentity]) -> AccessWithoutIdentity:
        """Return the access in several enclaves or domains together."""
        known = tuple(opened)
        if any(opened_parts.whole for opened_parts in known):
            return AccessWithoutIdentity(whole=True)
        return AccessWithoutIdentity(
            parts=tuple(dict.fromkeys(part for some in known for part in some.parts))
        )


@shows(
    *("enclave", "allowed", "in_part", "by_permissions_of", "outcome", "reason", "expression"),
    *("wildcard", "domains"),
    null_if_empty=("expression", "wildcard", "domains"),
)
class VendorOutcome(NamedTuple):
    """The decision for one enclave."""

    enclave: str
    """Name of the enclave."""
    outcome: OutcomeWord
    reason: ReasonWord
    text: str
    expression: str
    """The expression that decided; empty (null in JSON) if none did."""
    domains: str = ""
    """The ROS domains in which the enclave has the right, such as ``10`` or ``10,20``.

    Empty (null in JSON) if the enclave has the right in no domain, or if no keystore was asked.
    """
    opened: AccessWithoutIdentity = AccessWithoutIdentity()
    """The rights that the enclave's governance gives to processes without an identity."""
    in_part: Sequence[str] = ()
    """If the enclave has only a part of a right to an action: the parts, such as ``send_goal``,
    with which it can command the server (for ``call``) or inform the clients (for ``execute``).
    """
    by_permissions_of: Sequence[str] = ()
    """The other enclaves whose permissions fit the certificate of this enclave and allow the
    access. So a process with the key of this enclave has the right, too.
    """
    subject: str = ""
    """Subject of the enclave's certificate; empty if the vendor does not accept the certificate."""
    granted: str = ""
    """Subject of a grant that would allow the access to another certificate; empty without one."""

    @property
    def allowed(self) -> bool:
        """Whether the enclave has the right in question."""
        return self.outcome.ok

    @property
    def anybody(self) -> bool:
        """Whether the governance also gives the right to processes without an identity."""
        return self.opened.whole

    @property
    def wildcard(self) -> str:
        """The deciding expression, if it is a wildcard; otherwise empty (null in JSON)."""
        return self.expression if is_expression(self.expression) else ""

    @property
    def why_stopped(self) -> str:
        """The reason that no process can run in the enclave with its current files, or ""."""
        return self.text.partition(": ")[2] if _is_stopped(self.outcome) else ""


@shows(
    *("question", "vendor", "vendor_why", "documented_only", "domain", "enclaves", "anybody"),
    *("anybody_in_part", "export"),
)
class WhoByVendor(NamedTuple):
    """The decision of a vendor for every enclave of a keystore."""

    question: str
    """The question, such as ``publish topic /chatter``."""
    vendor: Vendor
    """The DDS vendor, as `--vendor` takes it."""
    vendor_why: str
    """Reason for the choice of this vendor."""
    domain: int | None
    """The ROS domain of ``--domain``; null for every domain."""
    enclaves: Sequence[VendorOutcome]
    """All enclaves, with the vendor's decision for each."""
    export: bool = False
    """Whether the question was about an export, which may lack enclaves of its keystore."""

    @property
    def anybody(self) -> bool:
        """Whether the governance also gives the right to processes without an identity."""
        return any(outcome.anybody for outcome in self.enclaves)

    @property
    def anybody_in_part(self) -> tuple[str, ...]:
        """If processes without an identity have only a part of a right to an action: the parts
        with which they can command the server or inform the clients.
        """
        return AccessWithoutIdentity.joined(outcome.opened for outcome in self.enclaves).parts

    @property
    def documented_only(self) -> bool:
        """Whether the vendor's behavior is known only from its documentation, not from tests."""
        return self.vendor.documented_only


def _title_with_reason(vendor: Vendor, why: str) -> str:
    documented = ", as documented" if vendor.documented_only else ""
    return f"{vendor.title} ({why}{documented})"


def _outcome(evaluator: Evaluator, enclave: str, question: Question) -> VendorOutcome:
    answer = evaluator.answer(question)
    others = evaluator.for_other_certificates()
    of_others = answer if others is evaluator else others.answer(question)
    expression = answer.decision.expression or ""
    return VendorOutcome(
        enclave,
        answer.outcome,
        answer.reason,
        answer.text,
        expression,
        opened=_access_without_identity(evaluator, question),
        in_part=_allowed_parts(evaluator, answer),
        subject=evaluator.enclave.subject if evaluator.has_accepted_certificate else "",
        granted=of_others.grant.subject if of_others.allowed and of_others.grant else "",
    )


def _access_without_identity(evaluator: Evaluator, question: Question) -> AccessWithoutIdentity:
    """Return the access that the enclave's governance gives to processes without an identity."""
    access = evaluator.access
    opened = access.topics_of_unauthenticated() if access else None
    if opened is None or not question.parts:
        return AccessWithoutIdentity()
    if all(part.topic in opened for part in question.parts):
        return AccessWithoutIdentity(whole=True)
    sent = {part: asked.parts for part, asked in influencing_parts(question).items()} or {
        part.role: (part,) for part in question.parts if part.verb is AccessVerb.PUBLISH
    }
    return AccessWithoutIdentity(
        parts=tuple(n for n, parts in sent.items() if all(part.topic in opened for part in parts))
    )


def _note_on_anybody(opened_parts: Iterable[AccessWithoutIdentity], remedy: str) -> Iterator[Note]:
    opened = AccessWithoutIdentity.joined(opened_parts)
    if opened.whole:
        text = (
            "processes without an identity may do it, too: the governance admits them, and does "
            f"not protect the name. {remedy}"
        )
        yield Note("explain.anybody", text)
    elif opened.parts:
        text = (
            "processes without an identity may do a part of it, which is enough to act on the "
            f"other side: {', '.join(opened.parts)}. The governance admits them, and does not "
            f"protect the topics of this part. {remedy}"
        )
        yield Note("explain.anybody", text)


class VendorOfPolicy(NamedTuple):
    """The decisions of a vendor on the enclaves of a policy, as if the policy were signed.

    With ``patterns``, only enclaves that match a pattern are decided on.
    """

    policy: Policy
    vendor: Vendor
    why: str
    asking: AskingContext
    patterns: Sequence[str] = ("*",)

    @property
    def title(self) -> str:
        """Name of the vendor, and the reason to choose it."""
        return _title_with_reason(self.vendor, self.why)

    def rights_naming(self, name: str) -> Iterator[Right]:
        """Return the rights of the policy to names that contain ``name``."""
        return (right for right in policy_rights(self.policy) if name in right.name)

    def outcomes(self, question: Question) -> tuple[VendorOutcome, ...]:
        """Return the outcome for each enclave, sorted by name."""
        outcomes = []
        for policy_enclave in self.policy.enclaves:
            if any(fnmatchcase(policy_enclave.path, pattern) for pattern in self.patterns):
                enclave = planned_enclave(policy_enclave, None, self.asking)
                context = self.asking.context(enclave.joined_domains)
                evaluator = Evaluator(self.vendor, enclave, context)
                outcomes.append(_outcome(evaluator, policy_enclave.path, question))
        return tuple(sorted(outcomes, key=lambda outcome: outcome.enclave))

    def printed(self, question: Question, outcomes: Sequence[VendorOutcome]) -> WhoByVendor:
        """Return the outcomes in the form that ``--json`` prints."""
        return WhoByVendor(str(question), self.vendor, self.why, self.asking.domain, outcomes)

    def notes(self, _: Question, outcomes: Sequence[VendorOutcome]) -> Iterator[Note]:
        """Yield a note if processes without an identity have the right, too."""
        opened = (outcome.opened for outcome in outcomes)
        return _note_on_anybody(opened, f"Change the template, or run {REFUSE_STRANGERS}.")


_MAX_DECIDED_ALONE = 100
"""If more enclaves than this are asked about, sros decides on all enclaves of the keystore.

For fewer, it decides on these and on enclaves whose permissions may also fit.
"""


class VendorOfKeystore(NamedTuple):
    """The decisions of a vendor on the enclaves ``names`` of a keystore, or on all enclaves."""

    keystore: OpenedKeystore
    vendor: Vendor
    why: str
    asking: AskingContext
    names: Sequence[str] | None = None
    stated: Callable[[str], Vendor | None] = lambda _: None
    """Function that returns the vendor of the distribution that is stated for an enclave."""

    @property
    def title(self) -> str:
        """Name of the vendor, and the reason to choose it."""
        return _title_with_reason(self.vendor, self._reason_for_vendor)

    @property
    def _reason_for_vendor(self) -> str:
        names = self.keystore.names if self.names is None else self.names
        titles = {vendor.title for name in names if (vendor := self.stated(name))}
        if not (titles := titles - {self.vendor.title}):
            return self.why
        return (
            f"{self.why}; {' and '.join(sorted(titles))} for enclaves whose distribution is stated"
        )

    def rights_naming(self, name: str) -> Iterator[Right]:
        """Return the rights in all permissions whose text contains ``name``."""
        return rights_naming(self.keystore, name)

    def outcomes(self, question: Question) -> tuple[VendorOutcome, ...]:
        """Return the outcome for each enclave, sorted by name."""
        # Imported here, because a question about one enclave does not need them.
        from sros_tool.explain.who import decide_each, first_allowing_domain

        def outcome(name: str) -> VendorOutcome:
            load = load_enclave_of if question.word == "join" else deciding_enclave
            enclave = load(self.keystore, name, moment=self.asking.at)

            def decided(domain: int) -> VendorOutcome:
                context = self.asking._replace(domain=domain).context(None)
                return _outcome(Evaluator(vendor, enclave, context), name, question)

            vendor = self.stated(name) or self.vendor
            state, joined = enclave.state, enclave.joined_domains or DomainSet.of((0, 0))
            governance, grant = (state.governance, state.grant) if state else (None, None)
            parts = domains_decided_alike(joined, governance, grant, self.asking.domain)
            decisions = {domains: decided(next(iter(domains))) for domains in parts}
            decision, domains, in_part = first_allowing_domain(decisions)
            opened = AccessWithoutIdentity.joined(outcome.opened for outcome in decisions.values())
            return decision._replace(domains=domains, in_part=in_part, opened=opened)

        every_name = self.keystore.names
        names = every_name if self.names is None else self.names
        holders: Sequence[str] = ()
        if len(names) > _MAX_DECIDED_ALONE:
            holders = every_name
        elif names != every_name:
            own_parts = [{*name.split("/")} for name in names]
            holders = [
                n for n in every_name if any(parts <= {*n.split("/")} for parts in own_parts)
            ]
        outcomes = decide_each([*dict.fromkeys((*names, *holders))], outcome)
        asked = {*names}
        return tuple(o for o in self._with_holders(outcomes) if o.enclave in asked)

    def _with_holders(self, outcomes: Sequence[VendorOutcome]) -> tuple[VendorOutcome, ...]:
        """Return the outcomes; a denial names other enclaves whose permissions allow the access.

        Only permissions that fit the certificate of the denied enclave count.
        """
        certified = {o.enclave: o.subject for o in outcomes if o.subject and not o.allowed}
        granted = {o.enclave: [o.granted] for o in outcomes if o.granted}
        vendors = {self.vendor, *(self.stated(o.enclave) or self.vendor for o in outcomes)}
        holders: dict[str, tuple[str, ...]] = {}
        for vendor in vendors if granted else ():
            holders |= other_fitting_enclaves(vendor.traits, certified, granted)
        return tuple(o._replace(by_permissions_of=holders.get(o.enclave, ())) for o in outcomes)

    def printed(self, question: Question, outcomes: Sequence[VendorOutcome]) -> WhoByVendor:
        """Return the outcomes in the form that ``--json`` prints."""
        return WhoByVendor(
            str(question),
            self.vendor,
            self._reason_for_vendor,
            self.asking.domain,
            outcomes,
            not is_original_keystore(self.keystore.root),
        )

    def notes(self, question: Question, outcomes: Sequence[VendorOutcome]) -> Iterator[Note]:
        """Yield notes on enclaves and processes that perhaps have the right, too.

        They are enclaves that the answer perhaps lacks, and processes without an identity, with
        earlier permissions, or with a revoked certificate.
        """
        # As in `outcomes`.
        from sros_tool.explain.earlier import note_on_earlier_permissions, note_on_revoked_enclaves
        from sros_tool.explain.who import notes_on_enclaves_left_out

        yield from notes_on_enclaves_left_out(self.keystore)
        refuse = remedy_in_keystore(self.keystore.root, f"Run {REFUSE_STRANGERS}.")
        yield from _note_on_anybody((outcome.opened for outcome in outcomes), refuse)
        denied = {outcome.enclave for outcome in outcomes if not outcome.allowed}
        stopped = {outcome.enclave for outcome in outcomes if outcome.why_stopped}
        yield from note_on_earlier_permissions(
            self.keystore, denied, stopped, question, self.vendor, self.asking
        )
        if self.names is None:
            allowed = {outcome.enclave for outcome in outcomes if outcome.allowed}
            yield from note_on_revoked_enclaves(
                self.keystore, question, self.vendor, self.asking, allowed
            )
        if not all(outcome.why_stopped for outcome in outcomes):
            yield from note_on_lacking_keys(self.keystore)
