"""The input of a review."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, tzinfo

from sros_tool.keystore.expiry import Threshold
from sros_tool.policy.remapping import Remapping
from sros_tool.proof.repository import Repository


@dataclass(frozen=True, slots=True)
class ReviewRequest:
    """The input of a review; paths are relative to the top of the repository.

    ``head`` is the commit to review, ``base`` the commit to compare with ("": none). With
    ``namespaces`` and ``remaps``, the requirements are read for these namespaces and names.  With
    ``allow_new_access``, new access and unreviewed policies are shown but do not make the review
    fail.  With ``allow_dropped_requirements``, requirements that HEAD drops or weakens do not make
    the review fail. The review fails if an enclave expires within ``renew_within``.  ``left_out``
    are files and folders of policies that are not reviewed.  ``template`` is the keystore template
    whose protection is assumed for the policies: a path, the name of a shipped template, or "".
    ``at`` is the time of the review, and ``zone`` the time zone of the robots.
    """

    repository: Repository
    base: str
    head: str
    policies: tuple[str, ...]
    requirements: tuple[str, ...]
    namespaces: tuple[str, ...]
    remaps: tuple[Remapping, ...]
    fleet: str
    keystores: tuple[str, ...]
    allow_new_access: bool
    allow_dropped_requirements: bool
    renew_within: Threshold
    left_out: tuple[str, ...]
    template: str
    at: datetime
    zone: tzinfo = UTC
