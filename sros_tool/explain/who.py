"""Find the enclaves of a keystore that may do something with a ROS name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from sros_tool.dds.decision.answers import Outcome
from sros_tool.dds.decision.vendors import Vendor
from sros_tool.dds.domains import DomainSet
from sros_tool.explain.evaluator import Evaluator
from sros_tool.explain.question import Question
from sros_tool.keystore.layout import enclave_names, enclave_path
from sros_tool.keystore.participant import JoinContext, load_enclave
from sros_tool.names import is_expression
from sros_tool.parallel import map_slices, tick


@dataclass(frozen=True, slots=True)
class EnclaveOutcome:
    """The outcome for one enclave, with the reason and the expression of its permissions."""

    enclave: str
    outcome: Outcome
    reason: str
    text: str
    expression: str

    @property
    def wildcard(self) -> str:
        """The expression, if it is a wildcard, or ""."""
        return self.expression if is_expression(self.expression) else ""


def who(
    root: Path,
    question: Question,
    vendor: Vendor,
    context: Callable[[DomainSet | None], JoinContext],
    *,
    at: datetime,
    names: Sequence[str] | None = None,
) -> tuple[EnclaveOutcome, ...]:
    """Return the outcome of a question for enclaves of a keystore, sorted by name.

    ``context`` gives domain and time for an enclave by its domains; ``at`` is the time at which
    the files are checked.  Without ``names``, the question is asked for every enclave.
    """

    def work(names: Sequence[str]) -> list[EnclaveOutcome]:
        found = []
        for name in names:
            found.append(_outcome(name))
            tick()
        return found

    def _outcome(name: str) -> EnclaveOutcome:
        enclave = load_enclave(name, enclave_path(root, name), at=at)
        answer = Evaluator(vendor, enclave, context(enclave.joined_domains)).answer(question)
        decision = answer.decision
        return EnclaveOutcome(
            name, answer.outcome, decision.reason, decision.text, decision.expression or ""
        )

    names = enclave_names(root) if names is None else names
    found = [each for _, part in map_slices(names, work) for each in part]
    return tuple(sorted(found, key=lambda each: each.enclave))
