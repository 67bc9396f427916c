"""The type of the Fibonacci action, from whichever package of ROS 2 is here."""

from __future__ import annotations

import importlib
from typing import Any

ORDER = 5
_PACKAGES = ("example_interfaces", "test_msgs", "action_tutorials_interfaces")


def fibonacci_type() -> Any:
    """The class ``Fibonacci``.  Raises `ImportError` where no package has it."""
    reasons = []
    for package in _PACKAGES:
        try:
            return importlib.import_module(f"{package}.action").Fibonacci
        except (ImportError, AttributeError) as error:
            reasons.append(str(error))
    raise ImportError(f"no package has the action Fibonacci: {'; '.join(reasons)}")


def sequence_of(message: Any) -> list[int]:
    """The numbers of a result or of feedback; the packages name the field differently."""
    return list(getattr(message, "sequence", None) or getattr(message, "partial_sequence", []))
