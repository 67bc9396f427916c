#!/usr/bin/python
"""Install the enclaves of a robot, or look at them, on the robot."""

# SPDX-License-Identifier: Apache-2.0

from __future__ import annotations

DOCUMENTATION = r"""
module: enclaves
short_description: Install the enclaves of a robot from a keystore of sros
description:
  - Exports the enclaves of the robot on the keystore machine with C(sros distribute_key), and
    installs them on the robot, all of them or, if anything fails, none.
  - The new files are verified next to the current ones, and only then take their place; who is
    interrupted in between ends it at the next run. Folders stay the same folders, so that units and
    containers that mounted them still have them.
  - Enclaves that the keystore does not have any more are removed. An enclave that waits for the
    answer to its signing request stays.
  - A revocation list that is older than the one on the robot is refused, since it would let revoked
    enclaves be trusted again.
  - A key that was made on the robot stays where it is; the other files have to fit it.
  - Returns what the robot then has, without secrets, so that C(sros fleet confirm) can record it.
  - The robot needs Python 3.8 and OpenSSL (the program C(openssl)), not sros. Where it has sros,
    C(sros verify) checks the enclaves.
options:
  keystore:
    description:
      - The keystore. Without it nothing is installed, and the current enclaves are
        verified.
    type: path
  robot:
    description: The name of the robot in the fleet of the keystore.
    type: str
    required: true
  patterns:
    description:
      - Patterns of the enclaves of this robot, such as V(/r7/*), for a keystore without a fleet.
    type: list
    elements: str
    default: []
  program:
    description: The command that runs sros on the keystore machine.
    type: list
    elements: str
    default: [sros]
  dest:
    description:
      - The folder of the enclaves on the robot, which has nothing else. Only root and the
        connected user may be able to change the folders above it.
    type: path
    default: /etc/sros/keystore
  owner:
    description:
      - The user who runs the nodes and becomes the owner of the files. The default is the
        connected user.
    type: str
  replace_authorities:
    description:
      - Also install enclaves of another keystore, which share no CA with the current ones, and
        enclaves that trust an earlier CA again.
    type: bool
    default: false
  allow_older_lists:
    description: Install also revocation lists that are older than those on the robot.
    type: bool
    default: false
  verifier:
    description: The command that runs sros on the robot, where it is installed.
    type: list
    elements: str
    default: [sros]
  longest_clock_difference:
    description: Warn if the clocks of keystore machine and robot differ by more, in seconds.
    type: int
    default: 300
  archive:
    description: Filled in by the action on the keystore machine. The export (C(.tar.gz)) in base64.
    type: str
  home_time:
    description: Filled in by the action on the keystore machine. Seconds since 1970 by its clock.
    type: float
attributes:
  check_mode:
    support: full
    description: Says what would change; new files are not verified.
  diff_mode:
    support: full
    description: Shows SHA-256 of files, and the text of governance and permissions; keys never.
author:
  - The authors of sros
"""

EXAMPLES = r"""
- name: Install the enclaves of this robot
  sros.fleet.enclaves:
    keystore: /home/me/keystore
    robot: "{{ inventory_hostname }}"
    owner: ros

- name: Look at what the robot has, and verify it
  sros.fleet.enclaves:
    robot: "{{ inventory_hostname }}"
"""

RETURN = r"""
changed_enclaves:
  description: Enclaves of which a file changed, or would in check mode.
  type: list
  elements: str
  returned: always
removed_enclaves:
  description: Enclaves that were removed, because the keystore does not have them.
  type: list
  elements: str
  returned: always
restart:
  description: Enclaves whose processes still have earlier files, of this change or before.
  type: list
  elements: str
  returned: always
routers:
  description: Enclaves with the configuration of a Zenoh router.
  type: list
  elements: str
  returned: always
verification:
  description: By which program the enclaves were verified, and what it found.
  type: dict
  returned: unless something would change in check mode
confirmation:
  description: What the robot has, as SHA-256, and its DDS, for C(sros fleet confirm).
  type: dict
  returned: always
remarks:
  description: What is worth knowing, which the action on the keystore machine shows as warnings.
  type: list
  elements: str
  returned: always
clock_difference:
  description: Seconds that the clock of the robot is ahead.
  type: int
  returned: when installing
"""

import base64
import binascii
import contextlib
import hashlib
import re
import tempfile
import time

from ansible.module_utils.basic import AnsibleModule

from ansible_collections.sros.fleet.plugins.module_utils.exports import (
    CERTIFICATE_FILE,
    KEY_FILE,
    KEY_FILES,
    REQUEST_FILE,
    Files,
    RefusedError,
    authorities,
    changed_enclaves,
    confirmation,
    enclave_of,
    enclaves_in,
    folder_of,
    read_archive,
    trust_digest,
)
from ansible_collections.sros.fleet.plugins.module_utils.places import Place
from ansible_collections.sros.fleet.plugins.module_utils.verification import (
    check_authorities,
    check_lists,
    clock_remark,
    same_trust,
    verify,
)

_MOST_PROBLEMS = 3
_ARGUMENTS = {
    "keystore": {"type": "path"},
    "robot": {"type": "str", "required": True},
    "patterns": {"type": "list", "elements": "str", "default": []},
    "program": {"type": "list", "elements": "str", "default": ["sros"]},
    "dest": {"type": "path", "default": "/etc/sros/keystore"},
    "owner": {"type": "str"},
    "replace_authorities": {"type": "bool", "default": False},
    "allow_older_lists": {"type": "bool", "default": False},
    "verifier": {"type": "list", "elements": "str", "default": ["sros"]},
    "longest_clock_difference": {"type": "int", "default": 300},
    "archive": {"type": "str", "no_log": True},
    "home_time": {"type": "float"},
}


def main() -> None:
    """Run the module."""
    module = AnsibleModule(argument_spec=_ARGUMENTS, supports_check_mode=True)
    now = time.time()
    remark = clock_remark(
        now, module.params["home_time"], module.params["longest_clock_difference"]
    )
    try:
        result = _run(module, now)
    except (RefusedError, OSError) as error:
        module.fail_json(msg="{}{}".format(error, " " + remark if remark else ""))
    said = result.get("verification", {}).get("remarks", [])
    remarks = [*([remark] if remark else []), *result.pop("about_change", []), *said]
    module.exit_json(remarks=remarks, **result)


def _run(module: AnsibleModule, now: float) -> dict:
    asked = module.params
    place = Place(asked["dest"], asked["owner"])
    if asked["keystore"] and not asked["archive"]:
        raise RefusedError("The action that exports the enclaves did not run.")
    if not asked["archive"]:
        return _look(place, asked, now)
    try:
        sent = read_archive(base64.b64decode(asked["archive"], validate=True))
    except binascii.Error as error:
        raise RefusedError("The export was damaged on its way.") from error
    difference = {"clock_difference": int(now - asked["home_time"])} if asked["home_time"] else {}
    with contextlib.nullcontext() if module.check_mode else place.locked():
        before = place.read()
        after = _after(before, sent)
        # The folder of this user alone.
        with tempfile.TemporaryDirectory(dir=module.tmpdir) as spare:
            if not asked["replace_authorities"]:
                check_authorities(before, after, spare)
            remarks = [] if asked["allow_older_lists"] else check_lists(before, after, spare)
            same = same_trust(before, after, spare)
        result = _install(place, before, after, asked, now, same=same, check=module.check_mode)
    with_key = [
        name
        for name in result["removed_enclaves"]
        if any(folder_of(name) + "/" + file in before for file in KEY_FILES)
    ]
    if with_key:
        more = len(with_key) - _MOST_PROBLEMS
        remarks.append(
            "This robot had keys of {}{}, which are not its enclaves in the keystore; they {}"
            " removed. If they are enclaves of another robot, give that robot new keys: `sros renew"
            " KEYSTORE --robot ROBOT --new-key --revoke-old`.".format(
                ", ".join(with_key[:_MOST_PROBLEMS]),
                f" and {more} more" if more > 0 else "",
                "would be" if module.check_mode else "were",
            )
        )
    return {**result, **difference, "about_change": remarks}


def _look(place: Place, asked: dict, now: float) -> dict:
    """Return what is there, verified."""
    if place.is_pending():
        with place.locked():  # ends a change that was interrupted
            pass
    present = place.read()
    names = [
        enclave
        for enclave in enclaves_in(present)
        if folder_of(enclave) + "/" + CERTIFICATE_FILE in present
    ]
    found = verify(place.path, names, asked["verifier"])
    return {
        "changed": False,
        "changed_enclaves": [],
        "removed_enclaves": [],
        "restart": place.due.read(),
        "routers": _routers(present),
        "verification": found,
        "confirmation": _confirmation(place, asked, present, now),
    }


def _after(before: Files, sent: Files) -> Files:
    """Return the files after the installation: those that were sent, and the robot's own.

    Raises:
        RefusedError: the key of an enclave is neither sent nor here.
    """
    after = dict(sent)
    for name in enclaves_in(sent):
        keys = [folder_of(name) + "/" + file for file in KEY_FILES]
        if not any(path in sent for path in keys):
            if not any(path in before for path in keys):
                raise RefusedError(
                    f"The key of enclave {name} is neither on the keystore machine nor on this"
                    " robot. Make another one on the robot with the play sros.fleet.requests."
                )
            own = (*keys, folder_of(name) + "/" + REQUEST_FILE)
            after.update((path, before[path]) for path in own if path in before)
    for name in set(enclaves_in(before)) - set(enclaves_in(sent)):
        waits = folder_of(name) + "/" + REQUEST_FILE in before
        if waits and folder_of(name) + "/" + CERTIFICATE_FILE not in before:
            after.update((path, before[path]) for path in before if enclave_of(path) == name)
    return after


def _confirmation(place: Place, asked: dict, files: Files, now: float) -> dict:
    by_agent = place.agent_due(files)
    due, crl_due = ({*names, *by_agent} for names in (place.due.read(), place.crl_due(files)))
    return confirmation(asked["robot"], files, now, sorted(due), sorted(crl_due))


def _install(
    place: Place,
    before: Files,
    after: Files,
    asked: dict,
    now: float,
    *,
    same: set[str],
    check: bool = False,
) -> dict:
    """Install and verify the new files; the enclaves ``same`` go on to trust the same others."""
    known, new = authorities(before), authorities(after)
    if known and not known & new and not asked["replace_authorities"]:
        raise RefusedError(
            f"This robot has enclaves of another keystore: no CA of '{place.path}' signed the new"
            " enclaves. Nothing was changed. If the robot should get the new keystore,"
            " set replace_authorities (sros_replace_authorities)."
        )
    changed = changed_enclaves(before, after)
    removed = sorted(set(enclaves_in(before)) - set(enclaves_in(after)))
    present = before == after and place.is_closed()
    names = [
        enclave
        for enclave in enclaves_in(after)
        if folder_of(enclave) + "/" + CERTIFICATE_FILE in after
    ]
    result = {
        "changed": not present,
        "changed_enclaves": changed,
        "removed_enclaves": removed,
        "routers": _routers(after),
        "diff": _difference(before, after),
    }
    # In an enclave that never had a certificate no process can run.
    has_certificate = {enclave_of(path) for path in before if path.endswith("/" + CERTIFICATE_FILE)}
    ran = has_certificate.union(place.delivered.read())
    due_before, trusting = set(place.due.read()), set(place.trusting.read())
    due = sorted({*due_before, *(ran & set(changed))} & set(enclaves_in(after)))
    if check and not present:
        confirmed = _confirmation(place, asked, before, now)
        return {**result, "restart": due, "confirmation": confirmed}
    if present:
        found = verify(place.path, names, asked["verifier"])
        if found["ok"] and not check and place.delivered.read() != names:
            place.delivered.write(names)  # an earlier version delivered them
    else:
        try:
            place.prepare(after)
            found = verify(place.stage, names, asked["verifier"])
            if found["ok"]:
                # Recorded first: who is killed in between restarts once too often, not never.
                place.trusting.write(
                    [
                        trust_digest(after, name)
                        for name in due
                        if name in same
                        and (name not in due_before or trust_digest(before, name) in trusting)
                    ]
                )
                place.set_due(due)
                place.replace()
                place.delivered.write(names)
        finally:
            place.discard()
    if not found["ok"]:
        first, more = found["problems"][:_MOST_PROBLEMS], len(found["problems"]) - _MOST_PROBLEMS
        raise RefusedError(
            "The enclaves do not verify on this robot ({}): {}. {}".format(
                found["by"],
                "; ".join([*first, *([f"and {more} more"] if more > 0 else [])]),
                "They are installed already." if present else "The earlier files stay.",
            )
        )
    return {
        **result,
        "restart": place.due.read(),
        "verification": found,
        "confirmation": _confirmation(place, asked, after, now),
    }


def _routers(files: Files) -> list:
    return sorted(enclave_of(path) for path in files if path.endswith("/router.json5"))


_SIGNED_TEXT = re.compile(r"Content-Type: text/plain\n\n(.*?)\n-{6}", re.DOTALL)


def _difference(before: Files, after: Files) -> list:
    """Return the difference for --diff; of keys nothing but that they differ."""
    return [
        {
            "before_header": path,
            "after_header": path,
            "before": _shown(path, before.get(path)),
            "after": _shown(path, after.get(path)),
        }
        for path in sorted({*before, *after})
        if before.get(path) != after.get(path)
    ]


def _shown(path: str, content: bytes | None) -> str:
    if content is None:
        return ""
    if path.endswith("/" + KEY_FILE):
        return "a private key\n"
    signed = _SIGNED_TEXT.search(content.decode(errors="replace").replace("\r\n", "\n"))
    text = signed.group(1) + "\n" if signed and path.endswith(".p7s") else ""
    return f"SHA-256 {hashlib.sha256(content).hexdigest()}\n{text}"


if __name__ == "__main__":
    main()
