"""The part of module reach that runs on the keystore machine: use nothing else of the answer."""

from __future__ import annotations

from typing import Any

from ansible_collections.sros.fleet.plugins.plugin_utils.answers import flag
from ansible_collections.sros.fleet.plugins.plugin_utils.robot_action import (
    LeftOutError,
    RobotAction,
)


class ActionModule(RobotAction):
    """Run the module on the robot."""

    readers = {"reached": flag}  # noqa: RUF012 - as above

    def arguments(self) -> dict[str, Any]:
        """Return no arguments: which robots are being revoked is looked at here."""
        arguments = self._task.args
        if arguments.get("robot") in arguments.get("revoked", []):
            raise LeftOutError(f"{arguments['robot']} is being revoked.")
        return {}
