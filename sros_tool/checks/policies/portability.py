"""Checks of policies that DDS vendors, ros2/sros2 or Zenoh treat in different ways."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from datetime import UTC, datetime

from sros_tool.checks.kind import ERROR, NOTE, WARNING, Finding, FindingKind
from sros_tool.checks.policies.statements import CheckedPolicy, split_place
from sros_tool.dds.decision.vendors import CYCLONE_DDS, FAST_DDS, Vendor
from sros_tool.dds.domains import DomainSet
from sros_tool.dds.permissions import (
    MAX_SIGNED_BYTES,
    Permissions,
    mistaken_names,
    pairs_text,
    portability_problems,
)
from sros_tool.errors import PolicyError
from sros_tool.keystore.issuing.size import SizeEstimator, right_bytes
from sros_tool.keystore.template import Template
from sros_tool.pki.certificates import common_name, subject_text
from sros_tool.policy.model import Enclave, Policy
from sros_tool.policy.patterns import Names
from sros_tool.policy.rights import policy_rights
from sros_tool.translate import permissions_for
from sros_tool.validity import Window

DOCUMENT_SIZE = FindingKind(
    "portable.document-size",
    WARNING,
    "signed permissions of 60 KB or more",
    "Participants send their permissions and certificate together in the handshake. If these "
    "exceed one message of 64 KB, Fast DDS 2.6 and 2.9 never finish the handshake, or abort; later "
    "releases and Cyclone DDS accept them.",
    "ros2/sros2 issue 228; Fast DDS 2.6.12, 2.9.1 (SecurityManager.cpp), 2.14.5, 3.2.5 and "
    "3.6.2, Cyclone DDS 0.10.2; tested.",
    "Remove rights that are never used, or use wildcards (`sros minimize_policy POLICY --observed "
    "OBSERVED` shows such rights and wildcards), or split the enclave.",
    vendors=tuple(vendor for vendor in FAST_DDS if vendor.traits.largest_document),
)
LONG_NAME = FindingKind(
    "portable.long-name",
    WARNING,
    "a topic whose name is too long for Fast DDS",
    "If the DDS topic name has 252 bytes or more (with prefix and suffix), Fast DDS creates the "
    "endpoint and never matches it; Cyclone DDS matches it.",
    "Fast DDS 2.6 to 3.6, Cyclone DDS 0.10 and 11.0; tested.",
    "Use shorter namespaces and names.",
    vendors=FAST_DDS,
)
DENY_BLOCKS = FindingKind(
    "portable.deny-blocks-topic",
    WARNING,
    "a topic that is denied in one direction and allowed in the other: Cyclone DDS 0.10 denies "
    "both",
    "Cyclone DDS 0.10 does not create a topic that is denied in one direction; Fast DDS and "
    "Cyclone DDS 11 create it.",
    "Cyclone DDS 0.10.2 and 11.0.1 (access_control.c), Fast DDS 2.6 to 3.6; tested.",
    "Remove the deny rule (everything that no rule allows is denied anyway), or deny only names "
    "whose other direction the node does not use. Do not deny calls to the parameter services of "
    "all nodes, because every node serves its own.",
    vendors=(Vendor.CYCLONE,),
)
CHARACTER_SET = FindingKind(
    "portable.character-set",
    NOTE,
    "a [set] of characters in a name",
    "Vendors agree on sets such as [ab], but not on all sets. On * and ?, they always agree.",
    "Fast DDS 2.6 to 3.6 (fnmatch), Cyclone DDS 0.10 and 11.0 (its own matching); tested.",
    "Use * or ?, or write the names out.",
)
NOT_ON_ZENOH = FindingKind(
    "policy.not-on-zenoh",
    ERROR,
    "a policy that Zenoh rules cannot express",
    "`sros zenoh` refuses a keystore with such permissions. sros checks this only with --vendor "
    "zenoh.",
    "zenoh.io, Access Control; sros (docs/zenoh.md).",
    "List names in place of wildcards.",
)
ENCLAVE_NAMES = FindingKind(
    "portable.enclave-names",
    WARNING,
    "an enclave whose path consists only of components of another enclave's path",
    "Cyclone DDS checks only that every part of a certificate's subject occurs in the grant's "
    "subject. So /robot can join with the (public) permissions of /robot/admin.",
    "Cyclone DDS 0.10.2 and 11.0.1 (access_control.c); reproduced: readers received data of such "
    "an enclave.",
    "Rename an enclave so that its path has a part that the other path lacks, such as "
    "/robot_admin, or use a keystore with unique subjects, such as one of the template production: "
    "then check the policy with `--template production`.",
    vendors=CYCLONE_DDS,
)
SEVERAL_PROFILES = FindingKind(
    "policy.several-profiles",
    NOTE,
    "an enclave with several <profiles>",
    "sros joins all <profiles>. ros2/sros2 makes one grant from each of them, and DDS uses only "
    "the first grant.",
    "ros2/sros2 0.13; DDS-Security 1.1, 9.4.1.3; Fast DDS 2.14.5 and Cyclone DDS 0.10.2.",
    "Put all <profile> elements of an enclave into one <profiles>.",
)
_PORTABILITY_KINDS = {
    kind.id: kind for kind in (DOCUMENT_SIZE, LONG_NAME, DENY_BLOCKS, CHARACTER_SET)
}
_MEASURED_FROM_BYTES = MAX_SIGNED_BYTES // 2
_ANY_TIME = Window(datetime(2026, 1, 1, tzinfo=UTC), datetime(2027, 1, 1, tzinfo=UTC))
_DOMAIN_0 = DomainSet.of((0, 0))


def check_portability(checked_policy: CheckedPolicy) -> Iterator[Finding]:
    """Yield findings about the permissions that would be signed for each enclave."""
    for enclave in checked_policy.policy.enclaves:
        source = enclave.source
        permissions = permissions_for(
            enclave,
            subject=subject_text(common_name(enclave.path)),
            validity=_ANY_TIME,
            domains=_DOMAIN_0,
        )
        size = _signed_bytes(enclave)
        for finding in portability_findings(
            permissions, size, enclave.path, source.file, source.line
        ):
            yield (
                _with_place_of_denial(finding, checked_policy)
                if finding.kind is DENY_BLOCKS
                else finding
            )
        if len(enclave.profiles) > 1:
            text = f"it has {len(enclave.profiles)} <profiles>"
            yield SEVERAL_PROFILES.found(enclave.path, text, source.file, source.line)
    if pairs := mistaken_names(enclave.path for enclave in checked_policy.policy.enclaves):
        text = f"Cyclone DDS mistakes {pairs_text(pairs)}"
        first = checked_policy.policy.enclave(pairs[0][0])
        line = first.source.line if first else None
        yield ENCLAVE_NAMES.found(pairs[0][0], text, checked_policy.policy.file, line)


def _with_place_of_denial(finding: Finding, checked_policy: CheckedPolicy) -> Finding:
    """Return the finding with the file and line of the first denial in its enclave."""
    denials = (
        s for s in checked_policy.statements if s.right.enclave == finding.subject and not s.allows
    )
    source = next(denials).source
    return finding._replace(file=source.file, line=source.line)


def portability_findings(
    permissions: Permissions, signed_bytes: int, subject: str, file: str, line: int | None = None
) -> Iterator[Finding]:
    """Yield findings about parts of permissions that are outside the portable profile."""
    for identity, fact in portability_problems(
        permissions, signed_bytes, lambda names: Names(names).overlaps
    ):
        yield _PORTABILITY_KINDS[identity].found(subject, fact, file, line)


def _signed_bytes(enclave: Enclave) -> int:
    """Return the size in bytes of an enclave's signed permissions; a small size is estimated."""
    rights = policy_rights(Policy((enclave,)))
    estimate = sum(map(right_bytes, rights))
    return SizeEstimator().signed_bytes(enclave) if estimate > _MEASURED_FROM_BYTES else estimate


def is_mended_by(template: Template | None, finding: Finding) -> bool:
    """Return whether a keystore made from ``template`` would not have the reported weakness."""
    return template is not None and finding.kind is ENCLAVE_NAMES and template.unique_subject


def check_zenoh(enclaves: Iterable[Enclave]) -> Iterator[Finding]:
    """Yield findings about enclaves whose rights Zenoh rules cannot express."""
    from sros_tool.translate_zenoh.rights import remote_rights

    for enclave in enclaves:
        try:
            remote_rights(enclave, domain=0)
        except PolicyError as error:
            file, line, text = split_place(error)
            yield NOT_ON_ZENOH.found(
                enclave.path, f"{text}. {error.why}", file, line, remedy=error.remedy
            )
