#!/usr/bin/python
"""See whether a robot can be reached."""

# SPDX-License-Identifier: Apache-2.0

from __future__ import annotations

DOCUMENTATION = r"""
module: reach
short_description: See whether a robot can be reached, and has Python
description:
  - Unlike M(ansible.builtin.ping), it takes no facts and nothing else from what the robot answers.
options: {}
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
    AnsibleModule(argument_spec={}, supports_check_mode=True).exit_json(changed=False, reached=True)


if __name__ == "__main__":
    main()
