"""What vendors of DDS decide for one enclave, and which enclaves of a keystore may do something."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from sros_tool.dds.decision.answers import Outcome, OutcomeWord, ReasonWord
from sros_tool.dds.decision.vendors import NEWEST, Vendor
from sros_tool.errors import Note, SrosError
from sros_tool.explain.answer import Answer, Evaluator, Provenance
from sros_tool.explain.asking import Asked, AskedEnclave, AskingContext, ZenohInBrief, meant
from sros_tool.explain.explanation import explain, likely_names
from sros_tool.explain.question import Question, ask
from sros_tool.keystore.layout import (
    SETTINGS,
    ZENOH_SIGNED,
    has_zenoh_files,
    is_keystore,
)
from sros_tool.keystore.participant import JoinContext, LoadedEnclave, load_enclave_of
from sros_tool.keystore.reader import Keystore
from sros_tool.names import is_expression
from sros_tool.values import shows


@shows("zenoh")
class ZenohBeside(NamedTuple):
    """What Zenoh decides next to DDS.

    ``problem`` says why that is not known, if so.
    """

    zenoh: ZenohInBrief | None
    """What Zenoh does with the files of the keystore, or null if that is not known; only if it has
    any."""
    problem: str = ""


@shows("asked", "answer", "vendor_why", "beside", spread=("asked", "answer", "beside"))
class VendorExplanation(NamedTuple):
    """The decision of one vendor."""

    asked: Asked
    answer: Answer
    vendor_why: str
    """Why this vendor was chosen."""
    beside: ZenohBeside | None
    notes: tuple[Note, ...]

    @property
    def allowed(self) -> bool:
        """Whether the vendor allows it."""
        return self.answer.allowed


@shows("asked", "vendors", "differ", "beside", spread=("asked", "beside"))
class VendorComparison(NamedTuple):
    """The decisions of all vendors.

    ``allowed`` is that of the one that was chosen.
    """

    asked: Asked
    vendors: Sequence[Answer]
    """The decisions."""
    beside: ZenohBeside | None
    allowed: bool
    notes: tuple[Note, ...]

    @property
    def differ(self) -> bool:
        """Whether they differ."""
        return len({vendor.outcome for vendor in self.vendors}) > 1


def explain_on_dds(
    asked: AskedEnclave,
    question: Question,
    chosen: tuple[Vendor, str],
    context: JoinContext,
    *,
    kind: str | None = None,
    every: bool = False,
) -> VendorExplanation | VendorComparison:
    """Return what a vendor decides, or what all decide if ``every``.

    ``chosen`` is the vendor with the reason to choose it; ``kind`` is the type of the name if the
    user said it.
    """
    vendor, why = chosen
    enclave = asked.enclave
    evaluator = Evaluator(vendor, enclave, context)
    question, taken = meant(evaluator, asked, question, kind)
    answer = explain(evaluator, question)
    beside = _beside(enclave, question, context)
    notes = (
        *taken,
        *_provenance_notes(answer),
        *_other_type(evaluator, answer, kind),
        *_no_topic(answer, asked),
        *_other_name(answer),
    )
    what = Asked(enclave.name, question, context)
    if every:
        others = {v: Evaluator(v, enclave, context) for v in Vendor if v is not vendor}
        answers = [answer if v is vendor else explain(others[v], question) for v in Vendor]
        return VendorComparison(what, answers, beside, answer.allowed, notes)
    measured = [
        answer if v is vendor else Evaluator(v, enclave, context).answer(question) for v in NEWEST
    ]
    if len({each.outcome for each in measured}) > 1:
        notes = (*notes, Note("explain.vendors-differ", f"{differences(measured)}."))
    return VendorExplanation(what, answer, why, beside, notes)


def differences(answers: Sequence[Answer]) -> str:
    """Return a sentence that names the vendors whose outcome differs from the first one's."""
    first = answers[0]
    others = [answer for answer in answers if answer.outcome is not first.outcome]
    if not others:
        return "all vendors decide alike"
    listed = ", ".join(f"{each.vendor.title} ({each.outcome})" for each in others)
    return f"VENDORS DIFFER: {first.vendor.title} ({first.outcome}), but {listed}"


# ── notes ──────────────────────────────────────────────────────────────────────────────────


def _provenance_notes(answer: Answer) -> Iterator[Note]:
    policy = answer.enclave.policy_file
    match answer.provenance:
        case Provenance.CHANGED:
            text = (
                f"the permissions were not made from '{policy}' in its current form: it states "
                "other rights than they have. The lines are from the current file."
            )
        case Provenance.UNKNOWN:
            text = f"whether the permissions were made from '{policy}' is not recorded."
        case _:
            return
    yield Note(f"explain.policy-{answer.provenance}", text)


def _other_type(evaluator: Evaluator, answer: Answer, kind: str | None) -> Iterator[Note]:
    """Yield a note if the enclave may not call a service, but may call an action of this name."""
    question = answer.question
    if question.word == "call" and question.type == "service" and not kind and not answer.allowed:
        action = ask("call", question.name, "action")
        if evaluator.answer(action).allowed:
            text = f"it may {action}: add --type action if {question.name} is an action."
            yield Note("explain.an-action", text)


def _no_topic(answer: Answer, asked: AskedEnclave) -> Iterator[Note]:
    """Yield a note if a denied topic has the name of a service or an action."""
    name = answer.question.name
    if answer.question.type != "topic" or answer.allowed or answer.problems:
        return
    kinds = {right.kind for right in asked.other_rights(name) if right.name == name}
    if kinds & {"services", "actions"} and "topics" not in kinds:
        what, word = ("an action", "execute") if "actions" in kinds else ("a service", "serve")
        text = f"{name} is {what} in the rights here, and no topic: ask about call or {word}."
        yield Note("explain.no-topic", text)


def _other_name(answer: Answer) -> Iterator[Note]:
    """Yield a note with the names that may be meant, if the enclave has rights to such names."""
    if answer.allowed or answer.problems or not answer.question.right:
        return
    if names := likely_names(answer):
        text = f"the enclave may {answer.question.word} {' and '.join(names)}: perhaps that is "
        yield Note("explain.likely-name", f"{text}meant.")


# ── Zenoh, next to it ──────────────────────────────────────────────────────────────────────


def _beside(enclave: LoadedEnclave, question: Question, context: JoinContext) -> ZenohBeside | None:
    """Return what Zenoh decides next to DDS, or why that is not known; None without its files."""
    keystore = enclave.keystore
    if keystore is None or enclave.state is None or not is_keystore(keystore.root):
        return None
    if not _runs_on_zenoh(keystore, enclave.name):
        return None
    from sros_tool.explain.zenoh import ZenohEvaluator  # many keystores have no Zenoh

    try:
        evaluator = ZenohEvaluator(keystore, at=context.at, domain=context.domain)
        answer = evaluator.answer(enclave.name, question, reach=False, brief=True)
    except SrosError as error:
        return ZenohBeside(None, error.what)
    return ZenohBeside(answer.in_brief)


def _runs_on_zenoh(keystore: Keystore, name: str) -> bool:
    """Return whether an enclave has a configuration of Zenoh, or others where settings name Zenoh.

    Without such settings the other enclaves are not looked at: there may be very many.
    """
    if any((keystore.folder(name) / file).is_file() for file in ZENOH_SIGNED):
        return True
    try:
        named = b"zenoh" in keystore.read(SETTINGS, "settings file")
    except SrosError:
        named = keystore.has(SETTINGS)
    return named and has_zenoh_files(keystore.root)


# ── many enclaves ──────────────────────────────────────────────────────────────────────────


@shows(
    *("enclave", "allowed", "outcome", "reason", "expression", "wildcard"),
    null_if_empty=("expression", "wildcard"),
)
class VendorOutcome(NamedTuple):
    """An enclave."""

    enclave: str
    """The enclave."""
    outcome: OutcomeWord
    reason: ReasonWord
    text: str
    expression: str
    """The expression that decided, or null."""

    @property
    def allowed(self) -> bool:
        """Whether it may."""
        return self.outcome.ok

    @property
    def wildcard(self) -> str:
        """The expression, if it is a wildcard, or null."""
        return self.expression if is_expression(self.expression) else ""

    @property
    def stopped(self) -> str:
        """Why no process of it runs with the files as they are, or ""."""
        runs = self.outcome not in (Outcome.REFUSED, Outcome.CRASHES)
        return "" if runs else self.text.partition(": ")[2]


@shows("question", "vendor", "vendor_why", "documented_only", "enclaves")
class WhoByVendor(NamedTuple):
    """The enclaves that may do it."""

    question: str
    """The question."""
    vendor: Vendor
    """The DDS vendor, as `--vendor` takes it."""
    vendor_why: str
    """Why this vendor was chosen."""
    enclaves: Sequence[VendorOutcome]
    """All enclaves."""

    @property
    def documented_only(self) -> bool:
        """Whether the decision is by its documentation, not by tests."""
        return self.vendor.documented_only


class VendorOfKeystore(NamedTuple):
    """A vendor that is asked about the enclaves of a keystore; all of them without ``names``."""

    keystore: Keystore
    vendor: Vendor
    why: str
    asking: AskingContext
    names: Sequence[str] | None = None

    @property
    def title(self) -> str:
        """Its name, and the reason to ask it."""
        documented = ", as documented" if self.vendor.documented_only else ""
        return f"{self.vendor.title} ({self.why}{documented})"

    def outcomes(self, question: Question) -> tuple[VendorOutcome, ...]:
        """Return the outcome for each enclave, sorted by name."""
        from sros_tool.explain.who import of_each  # a question about one enclave needs none

        def outcome(name: str) -> VendorOutcome:
            enclave = load_enclave_of(self.keystore, name, at=self.asking.at)
            context = self.asking.context(enclave.joined_domains)
            answer = Evaluator(self.vendor, enclave, context).answer(question)
            expression = answer.decision.expression or ""
            return VendorOutcome(name, answer.outcome, answer.reason, answer.text, expression)

        return of_each(self.keystore.names if self.names is None else self.names, outcome)

    def printed(self, question: Question, outcomes: Sequence[VendorOutcome]) -> WhoByVendor:
        """Return what ``--json`` prints of its outcomes."""
        return WhoByVendor(str(question), self.vendor, self.why, outcomes)

    def notes(self, _outcomes: Sequence[VendorOutcome]) -> Iterator[Note]:
        """Yield notes on its outcomes: none."""
        return iter(())
