"""The part of the module keystore that runs before it: refuse settings that a robot made up."""

from __future__ import annotations

from typing import Any

from ansible.plugins.action import ActionBase

from ansible_collections.sros.fleet.plugins.module_utils.exports import RefusedError
from ansible_collections.sros.fleet.plugins.plugin_utils.facts import check_facts


class ActionModule(ActionBase):  # type: ignore[misc]
    """Run the module, unless facts of a robot replace variables."""

    _supports_check_mode = True
    _supports_async = False

    def run(self, tmp: str | None = None, task_vars: dict[str, Any] | None = None) -> Any:
        """Return the result of the module."""
        result = super().run(tmp, task_vars)
        try:
            check_facts(task_vars or {})
        except RefusedError as error:
            return {**result, "failed": True, "msg": str(error)}
        # ansible_become is for robots, and its variable goes before the keyword of a task.
        self._connection.set_become_plugin(None)
        return {**result, **self._execute_module(task_vars=task_vars)}
