"""Actions whose module runs on a robot, which can answer anything."""

from __future__ import annotations

import re
from collections.abc import Mapping
from difflib import unified_diff
from typing import Any, ClassVar

from ansible.errors import AnsibleConnectionFailure, AnsibleError
from ansible.plugins.action import ActionBase

from ansible_collections.sros.fleet.plugins.module_utils.exports import RefusedError
from ansible_collections.sros.fleet.plugins.module_utils.home import harmless
from ansible_collections.sros.fleet.plugins.plugin_utils.answers import Reader, read_answer
from ansible_collections.sros.fleet.plugins.plugin_utils.facts import check_facts

_INTERPRETER = re.compile(r"(ansible_)?discovered_interpreter_\w+")
_PROGRAM = re.compile(r"/[A-Za-z0-9_./+-]{1,200}")
_FOLDER = re.compile(r"/[\w./+=@:,~-]{1,250}")
_MOST_OF_DIFFERENCES = 200_000
_LONGEST_SHOWN = 100


class LeftOutError(RefusedError):
    """There is nothing to do on this robot, which is no failure."""


class RobotAction(ActionBase):  # type: ignore[misc]
    """Run a module on a robot, and return of its answer only what is in ``readers``.

    Ansible itself acts on what a module returns (facts, ``add_host``, ``add_group``), and prints
    warnings, tracebacks and differences as they are.
    """

    readers: ClassVar[Mapping[str, Reader]] = {}
    _supports_check_mode = True
    _supports_async = False

    def arguments(self) -> dict[str, Any]:
        """Return the arguments of the module.

        Raises:
            RefusedError: something on the keystore machine is missing, or refused.
        """
        return dict(self._task.args)

    def run(self, tmp: str | None = None, task_vars: dict[str, Any] | None = None) -> Any:
        """Return the result of the module."""
        variables = task_vars or {}
        lost = ""
        try:
            result = super().run(tmp, variables)
            check_facts(variables)
            self._keep_the_agent()
            returned = self._execute_module(
                module_name=self._task.action, module_args=self.arguments(), task_vars=variables
            )
            returned = self.shown(returned)
        except AnsibleConnectionFailure as error:
            lost = harmless(str(error))
        except LeftOutError as error:
            return {"skipped": True, "skip_reason": str(error)}
        except (AnsibleError, RefusedError) as error:
            return {"failed": True, "msg": harmless(str(error))}
        if lost:  # raised out of the handler, so that no cause is printed with it
            raise AnsibleConnectionFailure(lost)
        return {**result, **_presented(returned, str(variables.get("inventory_hostname", "")))}

    def shown(self, returned: dict[str, Any]) -> dict[str, Any]:
        """Return a result whose differences are text already.

        Ansible would compare them after the timeout of the task, and a robot can choose texts that
        take hours.
        """
        differences = returned.pop("diff", None)
        if differences and self._task.diff:
            text = _compared(differences)
            returned["diff"] = [{"prepared": text}]
        return returned

    def _keep_the_agent(self) -> None:
        """Forward neither an agent nor ports to a robot, whatever the configuration of ssh says."""
        if self._connection.transport == "ssh":
            words = self._connection.get_option("ssh_extra_args") or ""
            own = f"{words} -a -x -o ClearAllForwardings=yes".strip()
            self._connection.set_option("ssh_extra_args", own)

    def _make_tmp_path(self, *words: Any, **options: Any) -> str:
        """Return the folder for a module, which a robot names where pipelining is off.

        sftp reads it as a part of its commands: what is long becomes another command, and one that
        begins with an exclamation mark is run on the keystore machine.
        """
        made = str(super()._make_tmp_path(*words, **options))
        if not _FOLDER.fullmatch(made):
            self._connection._shell.tmpdir = None
            raise RefusedError(
                f"This robot named no folder for files of Ansible, but {made[:_LONGEST_SHOWN]!r}."
                " Look at the robot."
            )
        return made

    def _low_level_execute_command(self, *words: Any, **options: Any) -> Any:
        """Return what a command on the robot printed, without what would steer a terminal."""
        done = super()._low_level_execute_command(*words, **options)
        for key in ("stdout", "stderr", "stdout_lines", "stderr_lines"):
            value = done.get(key)
            if isinstance(value, str):
                done[key] = harmless(value, most=None, lines=True)
            elif value:
                done[key] = [harmless(str(item), most=None) for item in value]
        return done

    def _parse_returned_data(self, res: Mapping[str, Any], *_profile: Any) -> dict[str, Any]:
        try:
            found = read_answer(res.get("stdout", ""), res.get("stderr", ""), self.readers)
        except RefusedError as error:
            return {"failed": True, "msg": str(error), "_ansible_parsed": True}
        return {**found, "_ansible_parsed": True}


def _compared(differences: list[dict[str, Any]]) -> str:
    """Return the differences as `diff -u` shows them."""
    text = ""
    for difference in differences:
        before, after = (difference.get(which, "").splitlines() for which in ("before", "after"))
        old, new = (
            f"{which}: {difference.get(f'{which}_header', '')}" for which in ("before", "after")
        )
        compared = unified_diff(before, after, old, new, lineterm="")
        text += "".join(f"{line}\n" for line in compared)
        if len(text) > _MOST_OF_DIFFERENCES:
            return f"{text[:_MOST_OF_DIFFERENCES]}...\n"
    return text


def _presented(returned: Mapping[str, Any], host: str) -> dict[str, Any]:
    """Return a result as Ansible takes it: with its remarks as warnings, and who says so."""
    result = {key: value for key, value in returned.items() if key not in ("warnings", "remarks")}
    facts = result.pop("ansible_facts", None) or {}
    known = {
        key: value
        for key, value in facts.items()
        if _INTERPRETER.fullmatch(str(key)) and _PROGRAM.fullmatch(str(value))
    }
    if known:
        result["ansible_facts"] = known
    if "msg" in result:
        result["msg"] = f"{host}: {result['msg']}"
    said = [*returned.get("remarks", ()), *map(harmless, returned.get("warnings", ()))]
    if said:
        result["warnings"] = [f"{host}: {text}" for text in said]
    return result
