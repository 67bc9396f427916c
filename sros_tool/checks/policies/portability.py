"""What DDS vendors would decide differently on, were a policy signed as it is."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime

from sros_tool.checks.kind import NOTE, WARNING, Finding, Kind, by_id
from sros_tool.checks.policies.stated import CheckedPolicy
from sros_tool.dds.domains import DomainSet
from sros_tool.dds.permissions import MAX_SIGNED_BYTES, Permissions
from sros_tool.dds.portable import mistaken_names, outside, some_pairs
from sros_tool.keystore.measure import Scale, right_bytes
from sros_tool.pki.certificates import common_name, subject_text
from sros_tool.policy.model import Enclave, Policy
from sros_tool.policy.patterns import overlap
from sros_tool.policy.rights import policy_rights
from sros_tool.translate import permissions_for
from sros_tool.validity import Window

DOCUMENT_SIZE = Kind(
    "portable.document-size",
    WARNING,
    "signed permissions of 64 KB or more",
    "The handshake carries them. Fast DDS 2.9 never finishes it, and sometimes aborts; Fast DDS "
    "2.14 and Cyclone DDS take them.",
    "ros2/sros2 issue 228; Fast DDS 2.9.1 (SecurityManager.cpp) and 2.14.5, Cyclone DDS 0.10.2; "
    "measured.",
    "Use wildcards (`sros minimize_policy` proposes them), or split the enclave.",
    vendors=("fastdds-2.9",),
)
LONG_NAME = Kind(
    "portable.long-name",
    WARNING,
    "a topic whose name is too long for Fast DDS",
    "From 252 bytes on (prefix and suffix included) an endpoint is created on Fast DDS, and never "
    "matched; Cyclone DDS takes it.",
    "Fast DDS 2.9.1 and 2.14.5, Cyclone DDS 0.10.2; measured.",
    "Use shorter namespaces and names.",
    vendors=("fastdds", "fastdds-2.9"),
)
DENY_BLOCKS = Kind(
    "portable.deny-blocks-topic",
    WARNING,
    "a denial of one direction of a topic that is allowed in the other",
    "Cyclone DDS asks whether the topic may be made at all, and a denial of either direction "
    "answers no; Fast DDS allows it.",
    "Cyclone DDS 0.10.2 (access_control.c), Fast DDS 2.9.1 and 2.14.5; measured.",
    "Remove the denial: what no rule allows is denied anyway.",
    vendors=("cyclonedds",),
)
CHARACTER_SET = Kind(
    "portable.character-set",
    NOTE,
    "a [set] of characters in a name",
    "Vendors read plain sets alike, but only * and ? are part of the portable profile.",
    "Fast DDS 2.14.5 (fnmatch), Cyclone DDS 0.10.2 (its own matching); measured.",
    "Use * or ?, or write the names out.",
)
ENCLAVE_NAMES = Kind(
    "portable.enclave-names",
    WARNING,
    "an enclave whose name consists of parts of another's",
    "Cyclone DDS compares the parts of two subjects as sets, one way: /robot fits the (public) "
    "permissions of /robot/admin, and gets in with them.",
    "Cyclone DDS 0.10.2 (access_control.c); an enclave did so here and was heard.",
    "Choose names none of which is made of parts of another, such as /robot_admin, or subjects "
    "with a part of their own (template production).",
    vendors=("cyclonedds",),
)
SEVERAL_PROFILES = Kind(
    "policy.several-profiles",
    NOTE,
    "an enclave with several <profiles>",
    "sros joins them. ros2/sros2 makes a grant of each, of which DDS reads only the first.",
    "ros2/sros2 0.13; DDS-Security 1.1, 9.4.1.3; Fast DDS 2.14.5 and Cyclone DDS 0.10.2.",
    "Put all <profile> of an enclave into one <profiles>.",
)

KINDS = by_id(DOCUMENT_SIZE, LONG_NAME, DENY_BLOCKS, CHARACTER_SET, ENCLAVE_NAMES, SEVERAL_PROFILES)

_FROM_ALL_SIZES_ON = MAX_SIGNED_BYTES // 2
_ANY_TIME = Window(datetime(2026, 1, 1, tzinfo=UTC), datetime(2027, 1, 1, tzinfo=UTC))
_DOMAINS = DomainSet.of((0, 0))


def check_portability(checked: CheckedPolicy) -> Iterator[Finding]:
    """Every enclave as its permissions would be signed."""
    for enclave in checked.policy.enclaves:
        source = enclave.source
        permissions = permissions_for(
            enclave,
            subject=subject_text(common_name(enclave.path)),
            validity=_ANY_TIME,
            domains=_DOMAINS,
        )
        size = _signed_bytes(enclave)
        for found in outside_findings(permissions, size, enclave.path, source.file, source.line):
            yield _at_denial(found, checked) if found.kind is DENY_BLOCKS else found
        if len(enclave.profiles) > 1:
            text = f"it has {len(enclave.profiles)} <profiles>"
            yield SEVERAL_PROFILES.found(enclave.path, text, source.file, source.line)
    if pairs := mistaken_names(each.path for each in checked.policy.enclaves):
        text = f"Cyclone DDS takes {some_pairs(pairs)}"
        first = checked.policy.enclave(pairs[0][0])
        line = first.source.line if first else None
        yield ENCLAVE_NAMES.found(pairs[0][0], text, checked.policy.file, line)


def _at_denial(found: Finding, checked: CheckedPolicy) -> Finding:
    """``found``, at the first denial of its enclave."""
    denials = (s for s in checked.statements if s.right.enclave == found.subject and not s.allows)
    source = next(denials).source
    return replace(found, file=source.file, line=source.line)


def outside_findings(
    permissions: Permissions, signed_bytes: int, subject: str, file: str, line: int | None = None
) -> Iterator[Finding]:
    """What of a permissions document lies outside of the portable profile."""
    for identity, fact in outside(permissions, signed_bytes, overlap):
        yield KINDS[identity].found(subject, fact, file, line)


def _signed_bytes(enclave: Enclave) -> int:
    """The size of the signed permissions; small ones are not measured."""
    rights = policy_rights(Policy((enclave,)))
    estimate = sum(map(right_bytes, rights))
    return Scale().signed_bytes(enclave) if estimate > _FROM_ALL_SIZES_ON else estimate
