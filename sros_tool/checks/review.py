"""Kinds of findings about a change in git; `sros_tool.proof.review` decides them."""

from __future__ import annotations

from sros_tool.checks.kind import ERROR, FindingKind

NEW_ACCESS = FindingKind(
    "review.new-access",
    ERROR,
    "access that the base of the change does not give",
    "After the change, somebody may do more, or something is protected less. A reviewer has to "
    "agree to it.",
    "The policies and keystores of both commits.",
    "Take the access out of the change, or let a reviewer allow it: `--new-access allow`.",
)
DROPPED_DENIAL = FindingKind(
    "review.dropped-denial",
    ERROR,
    "a DENY that the change drops",
    "The dropped DENY gives no access by itself, but other policies that are merged with this "
    "one may now allow what it denied.",
    "The policies of both commits.",
    "Restore the DENY, or let a reviewer allow it: `--new-access allow`.",
)
NOT_REVIEWED = FindingKind(
    "review.file",
    ERROR,
    "a file of the change that the review does not cover",
    "The file may be a policy, or part of a policy, and give access that nobody reviewed.",
    "The files of both commits.",
    "Name the file with --policy, leave it out with --leave-out, or take it out of the change.",
)
PRIVATE_KEY = FindingKind(
    "review.private-key",
    ERROR,
    "a private key in the commit",
    "Whoever can read the repository has the key, even after the file is deleted.",
    "The files of the commit.",
    "Replace the key, and keep keys out of repositories.",
)
EXPIRY = FindingKind(
    "review.expiry",
    ERROR,
    "an enclave that has to be renewed",
    "Vendors refuse an enclave whose certificate or permissions expired.",
    "The keystore of the commit, and --renew-within.",
    "Renew it: `sros renew KEYSTORE --all-expiring DURATION`.",
)
UNDECIDED = FindingKind(
    "review.undecided",
    ERROR,
    "a part of the review that could not be decided",
    "An undecided part counts as neither passed nor failed.",
    "The files of both commits.",
    "Correct the problem that the message names, and review again.",
)
