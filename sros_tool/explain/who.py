"""Turns the question round: which enclaves of a keystore may do something with a name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from sros_tool.dds.decision.answers import Outcome
from sros_tool.dds.decision.vendors import Vendor
from sros_tool.dds.domains import DomainSet
from sros_tool.explain.answer import Judge, Setting
from sros_tool.explain.material import Material, from_folder
from sros_tool.explain.question import Question
from sros_tool.keystore.layout import enclave_names, enclave_path
from sros_tool.names import is_expression
from sros_tool.parallel import map_slices


@dataclass(frozen=True, slots=True)
class Standing:
    """What one enclave may do: the outcome, why, and by which expression of its permissions."""

    enclave: str
    outcome: Outcome
    reason: str
    text: str
    expression: str
    topic: str

    @property
    def wildcard(self) -> str:
        """The expression, if it is a wildcard, or ""."""
        return self.expression if is_expression(self.expression) else ""


def who(
    root: Path,
    question: Question,
    vendor: Vendor,
    setting: Callable[[DomainSet | None], Setting],
    *,
    at: datetime,
) -> tuple[Standing, ...]:
    """How every enclave of a keystore stands to a question, sorted by name.

    ``setting`` tells where the question is asked of an enclave made for these domains.
    """

    def work(names: Sequence[str]) -> list[Standing]:
        return [
            standing(from_folder(name, enclave_path(root, name), at=at), question, vendor, setting)
            for name in names
        ]

    found = [each for _, share in map_slices(list(enclave_names(root)), work) for each in share]
    return tuple(sorted(found, key=lambda each: each.enclave))


def standing(
    material: Material,
    question: Question,
    vendor: Vendor,
    setting: Callable[[DomainSet | None], Setting],
) -> Standing:
    """How one enclave stands to a question."""
    answer = Judge(vendor, material, setting(material.domains)).answer(question)
    deciding = answer.deciding
    return Standing(
        material.enclave,
        answer.outcome,
        deciding.decision.reason,
        deciding.decision.text,
        deciding.decision.expression or "",
        deciding.part.topic if deciding.part else "",
    )
