"""The part of module requests that runs on the keystore machine: use nothing else of the answer."""

from __future__ import annotations

from ansible_collections.sros.fleet.plugins.plugin_utils.answers import (
    document,
    enclave,
    list_of,
    map_of,
)
from ansible_collections.sros.fleet.plugins.plugin_utils.robot_action import RobotAction


class ActionModule(RobotAction):
    """Run the module on the robot."""

    readers = {"made": list_of(enclave), "requests": map_of(document)}  # noqa: RUF012 - as above
