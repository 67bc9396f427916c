"""The part of the module reach that runs at home: take nothing else from the answer."""

from __future__ import annotations

from ansible_collections.sros.fleet.plugins.plugin_utils.answers import flag
from ansible_collections.sros.fleet.plugins.plugin_utils.robot_action import RobotAction


class ActionModule(RobotAction):
    """Run the module on the robot."""

    readers = {"reached": flag}  # noqa: RUF012 - as above
