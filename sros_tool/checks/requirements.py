"""Kinds of findings about requirements; `sros_tool.proof` decides them."""

from __future__ import annotations

from sros_tool.checks.kind import ERROR, NOTE, WARNING, FindingKind

VIOLATED = FindingKind(
    "requirement.violated",
    ERROR,
    "a requirement that does not hold",
    "The access control allows, or does not allow, what the requirements file says otherwise. Each "
    "name that could ever be used counts, not only those in use.",
    "The requirements file.",
    "Change the lines of the policy that are named, or the requirement.",
)
VACUOUS = FindingKind(
    "requirement.vacuous",
    WARNING,
    "a requirement, or a part of one, that cannot fail",
    "It protects nothing: perhaps a name is misspelt or was changed, or everybody is excepted.",
    "The requirements file.",
    "Correct the name or the exceptions, or remove the requirement.",
)
DROPPED = FindingKind(
    "requirement.dropped",
    WARNING,
    "a requirement that is no longer demanded",
    "The earlier file demanded more: what it forbade can now be allowed without a finding.",
    "The requirements file, and the one given as --requirements-before.",
    "Demand it again, or agree that it goes.",
)
ASSUMED = FindingKind(
    "requirement.assumed",
    NOTE,
    "a protection that is assumed, and not demanded",
    "A policy alone has no governance: it becomes that of the keystore, whose template can protect "
    "less than the default one.",
    "The requirements file.",
    "Name the keystore's template with --template, say protect= in the policy, or check the "
    "keystore.",
    prominent=True,
)
NOT_ON_ZENOH = FindingKind(
    "requirement.not-on-zenoh",
    NOTE,
    "requirements were not decided for Zenoh",
    "The policy cannot be carried out on Zenoh, so what it would allow there is not known.",
    "zenoh.io, Access Control.",
    "Ignore this if the robot uses DDS.",
)
