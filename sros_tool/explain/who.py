"""Ask all enclaves of a keystore the same question, whoever decides: a vendor of DDS, or Zenoh."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, Protocol, TypeVar

from sros_tool.errors import Note
from sros_tool.explain.asking import rights_naming, taken_for_action
from sros_tool.explain.question import Question, about_action, ask
from sros_tool.keystore.reader import Keystore


class EnclaveOutcome(Protocol):
    """What is decided for one enclave."""

    @property
    def enclave(self) -> str:
        """The enclave."""

    @property
    def allowed(self) -> bool:
        """Whether it may."""

    @property
    def wildcard(self) -> str:
        """The expression that allows it, if it is a wildcard, or ""."""

    @property
    def stopped(self) -> str:
        """Why no process of it runs with the files as they are, or ""."""


_Outcome = TypeVar("_Outcome", bound=EnclaveOutcome)


class Decider(Protocol):
    """A vendor of DDS, or Zenoh, that is asked about the enclaves of a keystore."""

    @property
    def keystore(self) -> Keystore:
        """The keystore."""

    @property
    def title(self) -> str:
        """Its name, and the reason to ask it."""

    def outcomes(self, question: Question) -> Sequence[EnclaveOutcome]:
        """Return what it decides for each enclave, sorted by name."""

    def printed(self, question: Question, outcomes: Sequence[Any], /) -> NamedTuple:
        """Return what ``--json`` prints of its outcomes."""

    def notes(self, outcomes: Sequence[Any]) -> Iterator[Note]:
        """Yield notes on its outcomes."""


class Everybody(NamedTuple):
    """The question as it was meant, what is decided for each enclave, and notes."""

    question: Question
    outcomes: Sequence[Any]
    """Each one is an `EnclaveOutcome` of what decided."""
    notes: tuple[Note, ...]

    @property
    def allowed(self) -> bool:
        """Whether any enclave may do it."""
        return any(outcome.allowed for outcome in self.outcomes)


def ask_everybody(decider: Decider, question: Question, kind: str | None) -> Everybody:
    """Return what is decided for enclaves of a keystore about a service, or about an action.

    ``kind`` is the type of the name if the user said it.
    """
    outcomes = decider.outcomes(question)
    taken: tuple[Note, ...] = ()
    # A name that an enclave has as a service is one; a wildcard shows nothing about it.
    unclear = all(each.wildcard for each in outcomes if each.allowed)
    if not kind and unclear and question.type == "service":
        rights = rights_naming(decider.keystore, question.name)
        if action := about_action(question, rights):
            taken = (taken_for_action(question, action),)
            question, outcomes = action, decider.outcomes(action)
    return Everybody(question, outcomes, (*taken, *decider.notes(outcomes)))


def callable_action(decider: Decider, question: Question) -> Note | None:
    """Return a note if enclaves may call an action that has the name of a service."""
    if (question.word, question.type) == ("call", "service"):
        action = ask("call", question.name, "action")
        if any(each.allowed for each in decider.outcomes(action)):
            text = f"enclaves may {action}: add --type action if it is an action."
            return Note("explain.an-action", text)
    return None


def of_each(names: Sequence[str], decide: Callable[[str], _Outcome]) -> tuple[_Outcome, ...]:
    """Return what is decided for each of many enclaves, on all cores, sorted by name."""
    from sros_tool.parallel import map_slices, tick  # a question about one enclave needs none

    def work(part: Sequence[str]) -> list[_Outcome]:
        outcomes = []
        for name in part:
            outcomes.append(decide(name))
            tick()
        return outcomes

    outcomes = [outcome for _, part in map_slices(names, work) for outcome in part]
    return tuple(sorted(outcomes, key=lambda outcome: outcome.enclave))
