"""The verbs of ``sros``; each is imported when it is used, so that help is instant."""

from __future__ import annotations

import importlib
from dataclasses import dataclass

import click

from sros_tool import __version__


@dataclass(frozen=True, slots=True)
class Verb:
    """A verb: the module that holds it, what it does, other names, and its name in the module."""

    module: str
    help: str
    aliases: tuple[str, ...] = ()
    attribute: str = ""


FAMILIES: dict[str, dict[str, Verb]] = {
    "Keystore": {
        "create_keystore": Verb("create_keystore", "Create a keystore."),
        "create_enclave": Verb("keystore", "Create enclaves in a keystore.", ("create_key",)),
        "create_permission": Verb("keystore", "Give an enclave the permissions of a policy."),
        "generate_artifacts": Verb("keystore", "Create enclaves and permissions from policies."),
        "list_enclaves": Verb("keystore", "List the enclaves of a keystore.", ("list_keys",)),
        "inspect": Verb("inspect", "Show what a keystore, certificate or document says."),
    },
    "Life of keys": {
        "renew": Verb("life", "Renew certificates and permissions of enclaves."),
        "revoke": Verb("life", "Revoke enclaves."),
        "rotate_ca": Verb("rotate", "Replace the CAs, stage by stage."),
        "crl": Verb("life", "Show the revocation list, or sign it anew."),
    },
    "Deployment": {
        "distribute_key": Verb(
            "deploy", "Export enclaves for the robot they run on.", ("export_enclave",)
        ),
        "verify": Verb("deploy", "Say whether what arrived on a robot can be used."),
        "create_request": Verb(
            "request", "Make a key on the robot, and the request to certify it."
        ),
        "sign_request": Verb("request", "Answer the request of a robot."),
        "import": Verb("request", "Put an answer beside its key.", attribute="import_verb"),
    },
    "Policy": {
        "generate_policy": Verb("generate_policy", "Learn a policy from the running robot."),
        "merge_policy": Verb("policy", "Add the rights of policies to a policy file."),
        "diff_policy": Verb("policy", "Compare the rights of policies, permissions, keystores."),
        "minimize_policy": Verb("minimize", "Narrow a policy to what was observed."),
        "explain": Verb("explain", "Say what DDS will decide, by which rule, and why."),
        "view": Verb("view", "Draw who may do what, as a page, SVG, DOT, Mermaid or JSON."),
        "policies": Verb("policies", "List or copy the policies that ship with sros."),
    },
    "Running": {
        "env": Verb("running", "Print the environment of an enclave."),
        "run": Verb("running", "Run a command in an enclave."),
        "check": Verb("check", "Find what is wrong or weak in policies, keystores, the runtime."),
        "doctor": Verb("doctor", "Find out which DDS here enforces security."),
        "demo": Verb("demo", "Show on a real DDS that secured nodes are isolated."),
        "completion": Verb("completion", "Print the completion script of a shell."),
    },
}
_VERBS = {name: verb for family in FAMILIES.values() for name, verb in family.items()}
_NAMES = {alias: name for name, verb in _VERBS.items() for alias in (name, *verb.aliases)}


class Program(click.Group):
    """A group whose commands are found by table; hyphen and underscore are the same letter."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """All verbs, without their aliases."""
        return list(_VERBS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import and return a verb, by its name or an alias."""
        name = _NAMES.get(cmd_name.replace("-", "_"))
        if name is None:
            return None
        module = importlib.import_module(f"sros_tool.cli.{_VERBS[name].module}")
        command = getattr(module, _VERBS[name].attribute or name)
        assert isinstance(command, click.Command)
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """As click does, but an alias shows the verb's own name."""
        name, command, rest = super().resolve_command(ctx, args)
        return (command.name if command else name), command, rest

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """The verbs by family, without importing any."""
        for family, verbs in FAMILIES.items():
            with formatter.section(family):
                formatter.write_dl(
                    [
                        (name, verb.help + (f" Also {verb.aliases[0]}." if verb.aliases else ""))
                        for name, verb in verbs.items()
                    ]
                )


EPILOG = """\b
Example:
  $ sros create_keystore keystore
  $ sros create_enclave keystore /talker
  $ sros run keystore /talker -- ros2 run demo_nodes_cpp talker

Where a verb takes a keystore, $ROS_SECURITY_KEYSTORE is the default.
Exit status: 0 yes or done; 1 no, denied or failed; 2 wrong usage."""


@click.group(
    cls=Program,
    epilog=EPILOG,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    no_args_is_help=True,
)
@click.version_option(__version__, "--version", "-V", message="sros %(version)s")
def program() -> None:
    """Secure ROS 2 robots: keystores, enclaves and permissions from policies in ROS terms."""
