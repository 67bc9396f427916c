"""A launch action of ROS 2 that starts each node in the enclave that its policy names.

In Python ``SecuredNodes(keystore="keystore", policy="policy.xml")`` from this module, in XML
``<secured_nodes keystore="keystore" policy="policy.xml"/>``, before the nodes: it applies to the
nodes that follow in its launch file and group, also in included files.

This is the only module that imports ``launch``, and only ``launch`` imports it: by the entry point
``launch.frontend.launch_extension`` whenever it reads an XML or YAML file.
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from launch import Action, LaunchContext, SomeSubstitutionsType
from launch.frontend import Entity, Parser, expose_action
from launch.utilities import normalize_to_list_of_substitutions, perform_substitutions

from sros_tool.runtime.environment import REFUSING

_PREFIX, _FILTER = "launch-prefix", "launch-prefix-filter"
"""Launch configurations: a prefix, and a pattern of the commands that get it."""


@expose_action("secured_nodes")
class SecuredNodes(Action):  # type: ignore[misc]  # launch has no types where it is missing
    """Launch action that starts every later process with ``sros run --policy``, in its enclave.

    It sets the prefix of commands, in front of an existing prefix such as a debugger's.  Launch
    itself, and processes with a prefix of their own, get variables with which no node starts, or
    the variables of ``enclave``.  Launch needs an enclave if it talks to nodes, such as lifecycle
    nodes and composable nodes.
    """

    def __init__(
        self,
        *,
        keystore: SomeSubstitutionsType,
        policy: SomeSubstitutionsType,
        enclave: SomeSubstitutionsType = "",
        **more: Any,
    ) -> None:
        """Configure the action with a keystore's folder, and the policy that names the enclaves."""
        super().__init__(**more)
        self._given = tuple(map(normalize_to_list_of_substitutions, (keystore, policy, enclave)))

    @classmethod
    def parse(cls, entity: Entity, parser: Parser) -> tuple[type[SecuredNodes], dict[str, Any]]:
        """Return the class, and its arguments from the attributes of an XML or YAML element."""
        _, arguments = super().parse(entity, parser)
        for name in ("keystore", "policy", "enclave"):
            value = entity.get_attr(name, optional=name == "enclave")
            if value is not None:
                arguments[name] = parser.parse_substitution(value)
        return cls, arguments

    def execute(self, context: LaunchContext) -> None:
        """Set the prefix and the variables.

        Raises:
            RuntimeError: a path is empty, a filter would keep the prefix from some processes, or
                no process can run in ``enclave``.
        """
        keystore, policy, enclave = (
            perform_substitutions(context, substitutions) for substitutions in self._given
        )
        if not keystore or not policy:
            raise RuntimeError("secured_nodes needs a keystore and a policy: one of them is empty.")
        if context.launch_configurations.get(_FILTER):
            raise RuntimeError(
                f"secured_nodes cannot be used with {_FILTER}: the processes that it leaves out "
                "would be in no enclave. Leave the filter out."
            )
        context.environment.update(_environment(Path(keystore), enclave) if enclave else REFUSING)
        before = context.launch_configurations.get(_PREFIX, "")
        own = [sys.executable, "-P", "-m", "sros_tool", "run", keystore, "--policy", policy, "--"]
        context.launch_configurations[_PREFIX] = f"{shlex.join(own)} {before}".rstrip()


def _environment(keystore: Path, enclave: str) -> Mapping[str, str]:
    """Return the variables of an enclave; raise `RuntimeError` if no process can run in it."""
    from sros_tool.cli.common import enclave_environment
    from sros_tool.errors import SrosError
    from sros_tool.terminal import visible_line

    try:
        return {**REFUSING, **enclave_environment(keystore, enclave).variables}
    except SrosError as error:
        raise RuntimeError(visible_line(str(error))) from error
