#!/usr/bin/python
"""Make keys on a robot, and the signing requests for them."""

# SPDX-License-Identifier: Apache-2.0

from __future__ import annotations

DOCUMENTATION = r"""
module: requests
short_description: Make the keys of enclaves on their robot, with signing requests
description:
  - Makes a key (EC P-256) for each enclave that has none, and a signing request for it. The key
    never leaves the robot; C(sros sign_request) answers the request on the keystore machine.
  - An enclave that has a key keeps it, and its request is returned again.
  - The robot needs OpenSSL (the program C(openssl)), not sros.
options:
  enclaves:
    description: The enclaves whose keys are made on this robot.
    type: list
    elements: str
    required: true
  dest:
    description: The folder of the enclaves on the robot.
    type: path
    default: /etc/sros/keystore
  owner:
    description: The user who runs the nodes and becomes the owner of the files.
    type: str
attributes:
  check_mode:
    support: full
    description: Says what would change.
author:
  - The authors of sros
"""

EXAMPLES = r"""
- name: Make the key of the camera on the robot
  sros.fleet.requests:
    enclaves: [/r7/camera]
    owner: ros
  register: made
"""

RETURN = r"""
made:
  description: Enclaves that got a key.
  type: list
  elements: str
  returned: always
requests:
  description: For each enclave its signing request (PEM), which is no secret.
  type: dict
  returned: always
"""

import os
import re
import shutil
import subprocess
import tempfile

from ansible.module_utils.basic import AnsibleModule

from ansible_collections.sros.fleet.plugins.module_utils.exports import (
    KEY_FILE,
    KEY_FILES,
    REQUEST_FILE,
    Files,
    RefusedError,
    check_enclave,
    folder_of,
)
from ansible_collections.sros.fleet.plugins.module_utils.places import Place

_PEM = re.compile(
    r"-----BEGIN CERTIFICATE REQUEST-----[A-Za-z0-9+/=\s]+-----END CERTIFICATE REQUEST-----"
)


def main() -> None:
    """Run the module."""
    arguments = {
        "enclaves": {"type": "list", "elements": "str", "required": True},
        "dest": {"type": "path", "default": "/etc/sros/keystore"},
        "owner": {"type": "str"},
    }
    module = AnsibleModule(argument_spec=arguments, supports_check_mode=True)
    try:
        names = [check_enclave(name) for name in module.params["enclaves"]]
        place = Place(module.params["dest"], module.params["owner"])
        if module.check_mode:
            lacking = _lacking(place.read(), names)
            module.exit_json(changed=bool(lacking), made=lacking, requests={})
        with place.locked():
            files = place.read()
            made = _lacking(files, names)
            # The folder of this user alone; the umask does not matter.
            with tempfile.TemporaryDirectory(dir=module.tmpdir) as spare:
                new = _with_requests(files, names, spare)
            if new != files:
                try:
                    place.prepare(new)
                    place.replace()
                finally:
                    place.discard()
    except (RefusedError, OSError) as error:
        module.fail_json(msg=str(error))
    requests = {name: new[folder_of(name) + "/" + REQUEST_FILE].decode() for name in names}
    module.exit_json(changed=new != files, made=made, requests=requests)


def _lacking(files: Files, names: list) -> list:
    return [
        name
        for name in names
        if not any(folder_of(name) + "/" + file in files for file in KEY_FILES)
    ]


def _with_requests(files: Files, names: list, spare: str) -> Files:
    """Return ``files`` and the keys and requests that are missing."""
    openssl = shutil.which("openssl")
    new = dict(files)
    for name in names:
        key, request = (folder_of(name) + "/" + file for file in (KEY_FILE, REQUEST_FILE))
        present = files.get(request, b"").decode(errors="replace")
        has_key = not _lacking(files, [name])
        if has_key and _PEM.search(present):
            continue
        if not openssl:
            raise RefusedError("This robot lacks the program openssl. Install the package openssl.")
        if has_key and key not in files:
            raise RefusedError(
                f"The key of enclave {name} is on a token, and its request.pem is missing. Make it"
                " again on the robot with `sros create_request --again`."
            )
        if not has_key:
            command = [openssl, "genpkey", "-algorithm", "EC"]
            new[key] = _run([*command, "-pkeyopt", "ec_paramgen_curve:P-256"], b"")
        settings = os.path.join(spare, "request.cnf")
        with open(settings, "w") as file:
            file.write(f"[req]\nprompt = no\ndistinguished_name = name\n[name]\nCN = {name}\n")
        command = [openssl, "req", "-new", "-key", "/dev/stdin", "-config", settings]
        new[request] = _run(command, new[key])
    return new


def _run(command: list, said: bytes) -> bytes:
    done = subprocess.run(command, input=said, capture_output=True, check=False)
    if done.returncode:
        raise RefusedError("openssl failed: {}".format(done.stderr.decode(errors="replace")[:1000]))
    return done.stdout


if __name__ == "__main__":
    main()
