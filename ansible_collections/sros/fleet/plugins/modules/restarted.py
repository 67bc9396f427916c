#!/usr/bin/python
"""Record on a robot that processes were restarted."""

# SPDX-License-Identifier: Apache-2.0

from __future__ import annotations

DOCUMENTATION = r"""
module: restarted
short_description: Record on a robot that the processes of enclaves were restarted
description:
  - M(sros.fleet.enclaves) remembers on the robot which enclaves changed, so that a restart is not
    forgotten if a play is interrupted. This module takes enclaves off that list.
options:
  enclaves:
    description: The enclaves whose processes were restarted.
    type: list
    elements: str
    required: true
  dest:
    description: The folder of the enclaves on the robot.
    type: path
    default: /etc/sros/keystore
attributes:
  check_mode:
    support: full
    description: Says what would change.
author:
  - The authors of sros
"""

EXAMPLES = r"""
- name: The camera was restarted
  sros.fleet.restarted:
    enclaves: [/r7/camera]
"""

RETURN = r"""
restart:
  description: Enclaves whose processes still have to be restarted.
  type: list
  elements: str
  returned: always
"""

from ansible.module_utils.basic import AnsibleModule

from ansible_collections.sros.fleet.plugins.module_utils.exports import RefusedError
from ansible_collections.sros.fleet.plugins.module_utils.places import Place


def main() -> None:
    """Run the module."""
    arguments = {
        "enclaves": {"type": "list", "elements": "str", "required": True},
        "dest": {"type": "path", "default": "/etc/sros/keystore"},
    }
    module = AnsibleModule(argument_spec=arguments, supports_check_mode=True)
    done = set(module.params["enclaves"])
    try:
        place = Place(module.params["dest"])
        if module.check_mode:
            due = place.due.read()
        else:
            with place.locked():
                due = place.due.read()
                if done & set(due):
                    place.set_due([enclave for enclave in due if enclave not in done])
    except (RefusedError, OSError) as error:
        module.fail_json(msg=str(error))
    module.exit_json(
        changed=bool(done & set(due)), restart=[enclave for enclave in due if enclave not in done]
    )


if __name__ == "__main__":
    main()
