"""What an enclave without a policy may do: the default of the keystore's template."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

from sros_tool.policy import Enclave, read_policy
from sros_tool.resources import policies_dir


@cache
def _default_policy(choice: str) -> Enclave:
    return read_policy(policies_dir() / "defaults" / f"{choice}.xml").enclaves[0]


def default_enclave(choice: str, name: str) -> Enclave:
    """The policy ``defaults/<choice>.xml`` for the enclave ``name``."""
    return replace(_default_policy(choice), path=name)
