"""The part of the module restart that runs at home: take nothing else from the answer."""

from __future__ import annotations

from ansible_collections.sros.fleet.plugins.plugin_utils.answers import list_of, name
from ansible_collections.sros.fleet.plugins.plugin_utils.robot_action import RobotAction


class ActionModule(RobotAction):
    """Run the module on the robot."""

    readers = {"restarted": list_of(name)}  # noqa: RUF012 - as above
