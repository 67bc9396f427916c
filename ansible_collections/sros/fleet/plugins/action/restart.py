"""The part of module restart that runs on the keystore machine: use nothing else of the answer."""

from __future__ import annotations

from ansible_collections.sros.fleet.plugins.plugin_utils.answers import list_of, name
from ansible_collections.sros.fleet.plugins.plugin_utils.robot_action import RobotAction


class ActionModule(RobotAction):
    """Run the module on the robot."""

    readers = {"restarted": list_of(name)}  # noqa: RUF012 - as above
