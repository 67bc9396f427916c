"""The size of signed permissions, measured with a temporary key."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.permissions import render_permissions
from sros_tool.pki import smime
from sros_tool.pki.certificates import common_name, issue_ca, subject_text
from sros_tool.pki.keys import generate_key
from sros_tool.policy.model import Enclave
from sros_tool.policy.rights import Right
from sros_tool.topics import dds_names
from sros_tool.translate import permissions_for
from sros_tool.validity import window

_LINE = len("<topic></topic>\r\n")


class SizeEstimator:
    """Estimator of the size of signed permissions, which signs them with a temporary key.

    The error is below 100 bytes: the name of the CA and the signature vary in length.
    """

    def __init__(self) -> None:
        self._key = generate_key()
        self._validity = window(datetime(2026, 1, 1, tzinfo=UTC), timedelta(days=365))
        self._certificate = issue_ca(
            self._key, common_name("sros permissions CA 00000000"), self._validity
        )

    def signed_bytes(self, enclave: Enclave) -> int:
        """Return the size in bytes of ``permissions.p7s`` for an enclave of a policy."""
        permissions = permissions_for(
            enclave,
            subject=subject_text(common_name(enclave.path)),
            validity=self._validity,
            domains=DomainSet.of((0, 0)),
        )
        return len(smime.sign(render_permissions(permissions), self._certificate, self._key))


def right_bytes(right: Right) -> int:
    """Return the size in bytes of one right in a large permissions document.

    It has one line per DDS topic.  In a smaller document the lines are indented as well.
    """
    names = dds_names(right.right, right.name)
    return sum(_LINE + len(name) for name in (*names.publish, *names.subscribe))
