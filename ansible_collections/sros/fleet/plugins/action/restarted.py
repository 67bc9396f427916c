"""The part of module restarted for the keystore machine: use nothing else of the answer."""

from __future__ import annotations

from ansible_collections.sros.fleet.plugins.plugin_utils.answers import enclave, list_of
from ansible_collections.sros.fleet.plugins.plugin_utils.robot_action import RobotAction


class ActionModule(RobotAction):
    """Run the module on the robot."""

    readers = {"restart": list_of(enclave)}  # noqa: RUF012 - as above
