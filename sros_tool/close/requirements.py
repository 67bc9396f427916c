"""The requirements of a closed robot, and which of them more rights would break."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

from sros_tool.close.robot import REQUIREMENTS, TEMPLATE
from sros_tool.errors import SrosError
from sros_tool.keystore.layout import CLOSED_POLICY
from sros_tool.keystore.template import load_template
from sros_tool.policy.document import read_policy
from sros_tool.policy.merge import merge_into
from sros_tool.policy.model import Policy
from sros_tool.proof.findings import decide_all
from sros_tool.proof.requirements import Requirement, read_requirements
from sros_tool.proof.system import policy_system


def requirements_broken_by(robot: Path, addition: str, moment: datetime) -> list[Requirement]:
    """Return the requirements in the folder of a closed robot that more rights would break.

    ``addition`` is the policy document with these rights.  None if the folder has no requirements,
    or the policy with the addition cannot be decided.
    """
    file, path = robot / REQUIREMENTS, robot / CLOSED_POLICY
    if not file.exists():
        return []
    try:
        needed, template = read_requirements(file), load_template(TEMPLATE)
        merged = merge_into(path, read_policy(path, addition.encode())).document

        def broken_requirements(policy: Policy) -> dict[Requirement, None]:
            decided = decide_all(needed, policy_system(policy, moment=moment, template=template))
            return dict.fromkeys(violation.requirement for violation in decided.violations)

        if after := broken_requirements(read_policy(path, merged)):
            before = broken_requirements(read_policy(path))
            return [requirement for requirement in after if requirement not in before]
    except SrosError:
        pass
    return []
