"""A launch action of ROS 2 that starts each node in the enclave that its policy names.

A launch file has the action before its nodes: in Python as ``SecuredNodes(keystore="keystore",
policy="policy.xml")`` from this module, in XML as ``<secured_nodes keystore="keystore"
policy="policy.xml"/>``.  The action applies to the nodes that follow in the same launch file and
group, also in included files.  ``ros2 launch --secured KEYSTORE POLICY_FILE`` puts the action
before a launch file.

This is the only module that imports ``launch``, and only ``launch`` and ``ros2 launch`` import it,
by the entry points ``launch.frontend.launch_extension`` and ``ros2launch.option``.
"""

from __future__ import annotations

import shlex
import sys
from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from launch import Action, LaunchContext, LaunchDescription, SomeSubstitutionsType
from launch.descriptions import Executable
from launch.frontend import Entity, Parser, expose_action
from launch.utilities import normalize_to_list_of_substitutions, perform_substitutions

from sros_tool.runtime.environment import REFUSING

if TYPE_CHECKING:
    from sros_tool.enclave_environment import EnclaveEnvironment

_PREFIX, _FILTER = "launch-prefix", "launch-prefix-filter"
"""Launch configurations: a prefix, and a pattern of the commands that get it."""
_RUN_COMMAND = [sys.executable, "-P", "-m", "sros_tool", "run"]
_prepare_without_label = Executable.prepare


def _prepare_labeled(self: Any, context: LaunchContext, action: Action) -> None:
    """Prepare a process, with the label that its output would have without the prefix of sros.

    Launch labels a process by the first word of its command line, the prefix included.
    """
    _prepare_without_label(self, context, action)
    command = self.final_cmd
    if self.name is None and command[: len(_RUN_COMMAND)] == _RUN_COMMAND:
        number = self.final_name.rpartition("-")[2]
        program_name = Path(command[command.index("--") + 1]).name
        self._Executable__final_name = f"{program_name}-{number}"


@expose_action("secured_nodes")
class SecuredNodes(Action):  # type: ignore[misc]  # launch has no types where it is missing
    """Launch action that starts every later process with ``sros run --policy``, in its enclave.

    The action sets the prefix of commands, in front of an existing prefix, such as a debugger.
    Processes with a prefix of their own get environment variables with which no node starts.
    Launch itself has a node if it talks to other nodes, such as lifecycle nodes and composable
    nodes: this node starts in ``enclave``, by default the enclave in which the policy has the node
    ``launch_ros_*``.
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
        """Set the prefix and the variables, and start the node of launch if it has an enclave.

        Raises:
            RuntimeError: a path is empty, a filter would keep the prefix from some processes, the
                policy cannot be read, or no process can run in the enclave of launch.
        """
        keystore, policy, enclave = (
            perform_substitutions(context, substitutions) for substitutions in self._given
        )
        if not keystore or not policy:
            raise RuntimeError(
                "secured_nodes needs a keystore and a policy: at least one is empty."
            )
        if context.launch_configurations.get(_FILTER):
            raise RuntimeError(
                f"secured_nodes cannot be used with {_FILTER}: the processes that the filter "
                "excludes would run in no enclave. Remove the filter."
            )
        secured = _launch_node_environment(Path(keystore), Path(policy), enclave)
        if secured:
            from launch_ros.ros_adapters import get_ros_adapter

            before = dict(context.environment)
            context.environment.update({**REFUSING, **secured.variables})
            try:
                get_ros_adapter(context)
            finally:
                context.environment.clear()
                context.environment.update(before)
        context.environment.update(REFUSING)
        root, file = (str(Path(path).absolute()) for path in (keystore, policy))
        run_command = [*_RUN_COMMAND, root, "--policy", file, "--"]
        prefix = context.launch_configurations.get(_PREFIX, "")
        context.launch_configurations[_PREFIX] = f"{shlex.join(run_command)} {prefix}".rstrip()
        # Set here, so that merely loading this module changes nothing.
        Executable.prepare = _prepare_labeled


def _launch_node_environment(
    keystore: Path, policy: Path, enclave: str
) -> EnclaveEnvironment | None:
    """Return the environment of the node of launch, or None if that node has no enclave.

    Raises:
        RuntimeError: the policy cannot be read, or has the node in several enclaves, or no process
            can run in the enclave.
    """
    from sros_tool.cli.common import enclave_environment
    from sros_tool.errors import SrosError
    from sros_tool.keystore.reader import OpenedKeystore
    from sros_tool.policy.document import read_policy
    from sros_tool.terminal import visible_line

    try:
        enclaves = read_policy(policy).enclaves_of_node("/", "launch_ros_*")
        if not enclave and len(enclaves) > 1:
            raise RuntimeError(
                f"the policy has the node launch_ros_* in {len(enclaves)} enclaves: name one of "
                "them with the argument enclave of secured_nodes."
            )
        name = enclave or next((named.path for named in enclaves), "")
        return enclave_environment(OpenedKeystore(keystore), name) if name else None
    except SrosError as error:
        raise RuntimeError(visible_line(str(error))) from error


class SecuredOption:
    """The option ``--secured`` of ``ros2 launch``.

    ros2launch calls only these methods of an option, and needs no base class (ros2launch 0.26,
    ``ros2launch/option/__init__.py``).
    """

    NAME = "secured"

    def add_arguments(self, parser: ArgumentParser, _cli_name: str) -> None:
        """Add the option."""
        parser.add_argument(
            "--secured",
            nargs=2,
            metavar=("KEYSTORE", "POLICY_FILE"),
            help="Start each node in the enclave of KEYSTORE that POLICY_FILE names for this node.",
        )

    def prestart(self, args: Namespace) -> None:
        """Raise `RuntimeError` if a prefix of the command line would replace the prefix of sros."""
        if args.secured and (args.launch_prefix or args.launch_prefix_filter):
            raise RuntimeError(
                "--secured cannot be used with --launch-prefix or --launch-prefix-filter."
            )

    def prelaunch(self, description: LaunchDescription, args: Namespace) -> tuple[Any]:
        """Return the launch description, with `SecuredNodes` in front if the option was given."""
        if args.secured:
            keystore, policy = args.secured
            secured = SecuredNodes(keystore=keystore, policy=policy)
            description = LaunchDescription([secured, *description.entities])
        return (description,)

    def postlaunch(self, _status: int, _args: Namespace) -> None:
        """Do nothing: all processes have ended."""
