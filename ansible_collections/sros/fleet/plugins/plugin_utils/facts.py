"""Facts of robots, which must not replace variables."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ansible import constants

from ansible_collections.sros.fleet.plugins.module_utils.exports import RefusedError
from ansible_collections.sros.fleet.plugins.module_utils.home import harmless

_SETTINGS = "sros_"
"""How the names of all variables of this collection begin."""
_OF_ANSIBLE = ("ansible_", "discovered_interpreter_")
_OF_SETUP = frozenset({"gather_subset", "module_setup"})
"""Names under which the modules of Ansible itself return facts."""
_MOST_SHOWN = 200


def check_facts(variables: Mapping[str, Any]) -> None:
    """Refuse to do anything for a robot whose facts replace variables.

    The plays of this collection take no facts from robots. But facts of other plays, or of a cache,
    replace variables of the inventory unless ``inject_facts_as_vars`` is off: so a robot
    could choose the command that runs on the keystore machine, or whose keys it gets.

    Args:
        variables: the variables of a task, with the facts of its robot.

    Raises:
        RefusedError: the robot has such facts.
    """
    if found := _replacing(variables):
        shown = harmless(", ".join(found), most=_MOST_SHOWN)
        raise RefusedError(
            f"This robot has facts that replace variables ({shown}). With them, it could choose"
            " the commands that run on the keystore machine, or get the keys of another robot."
            " Nothing was done for it. Set inject_facts_as_vars = false in ansible.cfg, or delete"
            " the facts if they are cached (ansible-playbook --flush-cache). If they are named as"
            " settings of sros, look at the robot."
        )


def _replacing(variables: Mapping[str, Any]) -> list[str]:
    """Return the names of facts that are variables, sorted."""
    facts = [str(fact) for fact in variables.get("ansible_facts") or {}]
    if not constants.INJECT_FACTS_AS_VARS:
        return sorted(fact for fact in facts if fact.startswith(_SETTINGS))
    # Ansible takes the prefix ansible_ off the names of facts, and not off those of variables.
    options = _options()
    steering = {fact for fact in facts if {fact, f"ansible_{fact}"} & options}
    return sorted(
        fact
        for fact in facts
        if fact in steering
        or (fact in variables and fact not in _OF_SETUP and not fact.startswith(_OF_ANSIBLE))
    )


def _options() -> set[str]:
    """Return the names of variables by which ssh, the shell and become are set, where Ansible runs.

    Ansible takes only some of them out of the facts of a robot, which could choose by the others
    the path of the socket of ssh, or the program that copies files.
    """
    plugins = (
        options
        for kind in ("connection", "shell", "become")
        for options in (constants.config.get_configuration_definitions(kind) or {}).values()
    )
    return {
        variable["name"]
        for options in plugins
        for option in options.values()
        for variable in option.get("vars") or ()
    }
