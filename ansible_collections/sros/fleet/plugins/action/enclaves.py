"""The part of the module enclaves that runs on the keystore machine: export the enclaves."""

from __future__ import annotations

import base64
import json
import time
from typing import Any

from ansible_collections.sros.fleet.plugins.module_utils.exports import (
    RefusedError,
    enclaves_in,
    read_archive,
)
from ansible_collections.sros.fleet.plugins.module_utils.home import ask, decoded
from ansible_collections.sros.fleet.plugins.plugin_utils.answers import (
    DIFFERENCES,
    enclave,
    flag,
    list_of,
    map_of,
    name,
    number,
    record,
    remarks,
)
from ansible_collections.sros.fleet.plugins.plugin_utils.robot_action import (
    LeftOutError,
    RobotAction,
)


class ActionModule(RobotAction):
    """Export the enclaves of a robot, and run the module on the robot with them."""

    readers = {  # noqa: RUF012 - a ClassVar of the class above
        **dict.fromkeys(
            ("changed_enclaves", "removed_enclaves", "restart", "routers"), list_of(enclave)
        ),
        "verification": record(by=name, ok=flag, problems=remarks, remarks=remarks),
        "confirmation": record(
            format=number,
            robot=name,
            time=name,
            files=map_of(name),
            certificates=map_of(list_of(name)),
            restart=list_of(enclave),
            crl_restart=list_of(enclave),
            dds=record(
                libraries=list_of(record(product=name, version=name, path=name, seen=name)),
                unseen=number,
            ),
        ),
        "clock_difference": number,
        "diff": DIFFERENCES,
    }

    _sent: frozenset[str] | None = None

    def arguments(self) -> dict[str, Any]:
        """Return the arguments of the module, with the export."""
        arguments = {
            key: value
            for key, value in self._task.args.items()
            if key not in ("archive", "home_time")
        }
        if arguments.get("keystore"):
            packed = export(arguments)
            self._sent = frozenset(enclaves_in(read_archive(packed)))
            arguments["archive"] = base64.b64encode(packed).decode()
        arguments["home_time"] = time.time()
        return arguments

    def shown(self, returned: dict[str, Any]) -> dict[str, Any]:
        """Return the result without enclaves to restart that are not of this robot."""
        for key in ("restart", "routers"):
            if self._sent is not None and key in returned:
                returned[key] = [enclave for enclave in returned[key] if enclave in self._sent]
        return super().shown(returned)


def export(arguments: dict[str, Any]) -> bytes:
    """Return the export of a robot's enclaves (``.tar.gz``), which holds their keys.

    Raises:
        LeftOutError: all enclaves of the robot are revoked.
        RefusedError: sros refuses; the text is what it says.
    """
    program = arguments.get("program") or ["sros"]
    words = ["distribute_key", str(arguments["keystore"]), "--keyless"]
    if patterns := arguments.get("patterns"):
        for pattern in patterns:
            words += ["--match", str(pattern)]
    else:
        words += ["--robot", str(arguments["robot"])]
    done = ask([*program, *words, "-"])
    if done.returncode:
        if not patterns and _is_revoked(program, arguments):
            raise LeftOutError(f"All enclaves of {arguments['robot']} are revoked.")
        raise RefusedError(decoded(done.stderr))
    return bytes(done.stdout)


def _is_revoked(program: list[str], arguments: dict[str, Any]) -> bool:
    """Return whether the keystore has no enclave of a robot any more, because they are revoked."""
    words = ["fleet", "status", str(arguments["keystore"]), "--robot", str(arguments["robot"])]
    done = ask([*program, *words, "--json"])
    if done.returncode not in (0, 1):
        return False
    (robot,) = json.loads(done.stdout)["robots"]
    return not robot["enclaves"] and bool(robot["revoked"])
