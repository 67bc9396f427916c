#!/usr/bin/python
"""See whether a robot can be reached."""

# SPDX-License-Identifier: Apache-2.0

from __future__ import annotations

DOCUMENTATION = r"""
module: reach
short_description: See whether a robot can be reached, and has Python
description:
  - Unlike M(ansible.builtin.ping), it takes no facts and nothing else from what the robot answers.
options:
  robot:
    description: The name of the robot in the fleet.
    type: str
  revoked:
    description: Robots that are being revoked. They are skipped, and not connected to.
    type: list
    elements: str
    default: []
attributes:
  check_mode:
    support: full
    description: Changes nothing.
author:
  - The authors of sros
"""

EXAMPLES = r"""
- name: See whether the robot can be reached
  sros.fleet.reach:
  ignore_unreachable: true
  register: reached
"""

RETURN = r"""
reached:
  description: That the module ran.
  type: bool
  returned: success
"""

from ansible.module_utils.basic import AnsibleModule


def main() -> None:
    """Run the module."""
    arguments = {
        "robot": {"type": "str"},
        "revoked": {"type": "list", "elements": "str", "default": []},
    }
    module = AnsibleModule(argument_spec=arguments, supports_check_mode=True)
    module.exit_json(changed=False, reached=True)


if __name__ == "__main__":
    main()
