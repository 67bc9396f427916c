"""The part of the module enclaves that runs at home: export the enclaves of a robot."""

from __future__ import annotations

import base64
import time
from typing import Any

from ansible.plugins.action import ActionBase

from ansible_collections.sros.fleet.plugins.module_utils.exports import RefusedError
from ansible_collections.sros.fleet.plugins.module_utils.home import (
    ask,
    check_facts,
    decoded,
)


class ActionModule(ActionBase):  # type: ignore[misc]
    """Export the enclaves of a robot, and run the module on the robot with them."""

    _supports_check_mode = True
    _supports_async = False

    def run(self, tmp: str | None = None, task_vars: dict[str, Any] | None = None) -> Any:
        """Return the result of the module, or of a failed export."""
        result = super().run(tmp, task_vars)
        arguments = {
            key: value
            for key, value in self._task.args.items()
            if key not in ("archive", "home_time")
        }
        if arguments.get("keystore"):
            try:
                check_facts(task_vars or {})
                packed = export(arguments)
            except RefusedError as error:
                return {**result, "failed": True, "msg": str(error)}
            arguments["archive"] = base64.b64encode(packed).decode()
        arguments["home_time"] = time.time()
        return {
            **result,
            **self._execute_module(
                module_name="sros.fleet.enclaves", module_args=arguments, task_vars=task_vars
            ),
        }


def export(arguments: dict[str, Any]) -> bytes:
    """Return the export of a robot's enclaves (``.tar.gz``), which holds their keys.

    Raises:
        RefusedError: sros refuses; the text is what it says.
    """
    program = arguments.get("program") or ["sros"]
    words = ["distribute_key", str(arguments["keystore"]), "--keyless"]
    if patterns := arguments.get("patterns"):
        for each in patterns:
            words += ["--match", str(each)]
    else:
        words += ["--robot", str(arguments["robot"])]
    done = ask([*program, *words, "-"])
    if done.returncode:
        raise RefusedError(decoded(done.stderr))
    return bytes(done.stdout)
