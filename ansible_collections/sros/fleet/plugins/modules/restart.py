#!/usr/bin/python
"""Restart units on a robot."""

# SPDX-License-Identifier: Apache-2.0

from __future__ import annotations

DOCUMENTATION = r"""
module: restart
short_description: Restart units on a robot, one after the other
description:
  - Runs C(systemctl restart) for each unit, in their order, and stops at the first that fails.
options:
  units:
    description: The names of the units.
    type: list
    elements: str
    required: true
  systemctl:
    description: The command that restarts a unit, without C(restart) and the unit's name.
    type: list
    elements: str
    default: [systemctl]
attributes:
  check_mode:
    support: full
    description: Restarts nothing.
author:
  - The authors of sros
"""

EXAMPLES = r"""
- name: Restart the camera
  sros.fleet.restart:
    units: [camera.service]
"""

RETURN = r"""
restarted:
  description: The units that were restarted, or would be in check mode.
  type: list
  elements: str
  returned: always
"""

from ansible.module_utils.basic import AnsibleModule


def main() -> None:
    """Run the module."""
    arguments = {
        "units": {"type": "list", "elements": "str", "required": True},
        "systemctl": {"type": "list", "elements": "str", "default": ["systemctl"]},
    }
    module = AnsibleModule(argument_spec=arguments, supports_check_mode=True)
    units = module.params["units"]
    for number, unit in enumerate(units):
        if not module.check_mode:
            status, out, error = module.run_command([*module.params["systemctl"], "restart", unit])
            if status:
                said = (error or out).strip() or f"its exit status is {status}"
                module.fail_json(
                    msg=f"The unit {unit} did not restart: {said}", restarted=units[:number]
                )
    module.exit_json(changed=bool(units), restarted=units)


if __name__ == "__main__":
    main()
