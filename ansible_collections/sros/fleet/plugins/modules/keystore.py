#!/usr/bin/python
"""Run a verb of sros on the keystore machine."""

# SPDX-License-Identifier: Apache-2.0

from __future__ import annotations

DOCUMENTATION = r"""
module: keystore
short_description: Run a verb of sros that changes the keystore
description:
  - Runs C(sros VERB --json) where the keystore is, and reports a change if files of the keystore
    changed. In check mode C(--dry-run) is added.
  - Passphrases and PINs come from the environment of C(ansible-playbook), as always with sros.
options:
  verb:
    description: The verb and its arguments.
    type: list
    elements: str
    required: true
  program:
    description: The command that runs sros.
    type: list
    elements: str
    default: [sros]
  reads:
    description: Whether the verb only reads, so that it runs without C(--dry-run) in check mode.
    type: bool
    default: false
  said:
    description: Text for the verb to read on its standard input.
    type: str
    default: ""
  ok_statuses:
    description: Exit statuses that are no failure.
    type: list
    elements: int
    default: [0]
attributes:
  check_mode:
    support: full
    description: Runs the verb with C(--dry-run).
author:
  - The authors of sros
"""

EXAMPLES = r"""
- name: Renew what expires within 30 days
  sros.fleet.keystore:
    verb: [renew, /home/me/keystore, --all-expiring, 30d]
  delegate_to: localhost
  run_once: true
"""

RETURN = r"""
answer:
  description: The JSON that sros printed, see its docs/json.md.
  type: dict
  returned: success
status:
  description: The exit status.
  type: int
  returned: success
"""

import json
from typing import Any

from ansible.module_utils.basic import AnsibleModule

from ansible_collections.sros.fleet.plugins.module_utils.exports import RefusedError
from ansible_collections.sros.fleet.plugins.module_utils.home import ask, decoded, harmless


def main() -> None:
    """Run the module."""
    arguments = {
        "verb": {"type": "list", "elements": "str", "required": True},
        "program": {"type": "list", "elements": "str", "default": ["sros"]},
        "reads": {"type": "bool", "default": False},
        "said": {"type": "str", "default": ""},
        "ok_statuses": {"type": "list", "elements": "int", "default": [0]},
    }
    module = AnsibleModule(argument_spec=arguments, supports_check_mode=True)
    command = [*module.params["program"], *module.params["verb"], "--json"]
    if module.check_mode and not module.params["reads"]:
        command.append("--dry-run")
    try:
        done = ask(command, module.params["said"].encode())
    except RefusedError as error:
        module.fail_json(msg=str(error))
    try:
        answer: Any = json.loads(done.stdout) if done.stdout.strip() else {}
    except ValueError:
        answer = None
    if done.returncode not in module.params["ok_statuses"] or not isinstance(answer, dict):
        module.fail_json(msg=decoded(done.stderr or done.stdout), status=done.returncode)
    for note in answer.get("notes", []):
        module.warn(harmless(note["text"]))
    changed = bool(answer.get("changes")) and not module.params["reads"]
    module.exit_json(changed=changed, answer=answer, status=done.returncode)


if __name__ == "__main__":
    main()
