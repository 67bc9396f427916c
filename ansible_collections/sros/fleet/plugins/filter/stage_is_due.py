"""The filter that tells which stages of a CA rotation are to be done."""

from __future__ import annotations

import re
from typing import Any

from ansible.errors import AnsibleFilterError

DOCUMENTATION = r"""
name: stage_is_due
short_description: Whether a stage of a CA rotation is to be done
description:
  - Tells it from what C(sros rotate_ca --status --json) prints, so that a rotation that was
    interrupted goes on, and one that is complete does not begin again.
options:
  _input:
    description: What C(sros rotate_ca --status --json) prints.
    type: dict
    required: true
  stage:
    description: The stage.
    type: str
    choices: [distribute, reissue, retire]
    required: true
  replaced:
    description: The SHA-256 of the CA certificates that are to be replaced, in hexadecimal.
    type: raw
    required: true
positional: stage, replaced
author:
  - The authors of sros
"""

EXAMPLES = r"""
due: "{{ status.answer | sros.fleet.stage_is_due('distribute', sros_replace_ca) }}"
"""

RETURN = r"""
_value:
  description: Whether the stage is to be done.
  type: bool
"""

_DIGEST = re.compile(r"[0-9a-fA-F]{64}")


def stage_is_due(status: dict[str, Any], stage: str, replaced: Any) -> bool:
    """Return whether a stage is to be done, to replace the CAs with the digests ``replaced``."""
    digests = [replaced] if isinstance(replaced, str) else list(replaced)
    if not digests or not all(_DIGEST.fullmatch(str(digest)) for digest in digests):
        raise AnsibleFilterError(
            "sros_replace_ca has to be the SHA-256 of the CA certificate that is to be replaced, 64"
            " hexadecimal digits. See `sros rotate_ca KEYSTORE --status --json`."
        )
    wanted = {str(digest).lower() for digest in digests}
    issuing = {
        authority["sha256"]
        for authority in status["authorities"]
        if authority["state"] == "issuing"
    }
    now = status["stage"]
    if stage == "distribute":
        return now == stage or (now == "none" and bool(wanted & issuing))
    if stage == "reissue":
        return now in ("distribute", stage)
    return now == "reissue" or (now == "none" and not wanted & issuing)


class FilterModule:
    """The filters of this file."""

    def filters(self) -> dict[str, Any]:
        """Return the filters by their names."""
        return {"stage_is_due": stage_is_due}
