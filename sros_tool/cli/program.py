"""The program ``sros``: its verbs, imported only when used for a fast start, and its errors."""

from __future__ import annotations

import importlib
import os
import re
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import click

from sros_tool import __version__
from sros_tool.errors import NOT_DONE, SrosError
from sros_tool.terminal import echo, echo_lines

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem


class VerbEntry(NamedTuple):
    """A verb: its module, one line of help, aliases, and its name in the module if different.

    The line says what the verb does, or which question it answers.
    """

    module: str
    help: str
    aliases: tuple[str, ...] = ()
    attribute: str = ""


FAMILIES: dict[str, dict[str, VerbEntry]] = {
    "Start here": {
        "demo": VerbEntry("demo", "Show on a real DDS that secured nodes are isolated."),
        "close": VerbEntry("close", "Close the robot that runs open here, step by step."),
    },
    "Keystore": {
        "create_keystore": VerbEntry("keystore", "Create a keystore."),
        "create_enclave": VerbEntry("keystore", "Create enclaves in a keystore.", ("create_key",)),
        "create_permission": VerbEntry("keystore", "Give an enclave the permissions of a policy."),
        "generate_artifacts": VerbEntry(
            "keystore", "Create enclaves and permissions from policies."
        ),
        "update_keystore": VerbEntry("keystore", "Change the settings of a keystore."),
        "list_enclaves": VerbEntry("keystore", "List the enclaves of a keystore.", ("list_keys",)),
        "inspect": VerbEntry("inspect", "What is in this keystore, enclave or file?"),
    },
    "Life of keys": {
        "renew": VerbEntry("life", "Renew certificates and permissions of enclaves."),
        "revoke": VerbEntry("life", "Revoke enclaves."),
        "rotate_ca": VerbEntry("life", "Replace the CAs, stage by stage."),
        "crl": VerbEntry("life", "Who is revoked? Show the revocation list, or sign it again."),
    },
    "Deployment": {
        "distribute_key": VerbEntry(
            "deployment", "Export enclaves for the robot they run on.", ("export_enclave",)
        ),
        "verify": VerbEntry("deployment", "On a robot: can nodes start in its enclaves?"),
        "create_request": VerbEntry(
            "deployment", "Create keys on the robot, and signing requests."
        ),
        "sign_request": VerbEntry("deployment", "Sign the request of a robot."),
        "import": VerbEntry(
            "deployment", "Install a signed answer on the robot.", attribute="import_verb"
        ),
        "fleet": VerbEntry("fleet", "Which files do robots have? Publish files to them."),
        "agent": VerbEntry("agent", "On a robot: fetch and install releases, report the files."),
        "zenoh": VerbEntry("zenoh", "Write the files that make Zenoh enforce policies."),
    },
    "Policy": {
        "generate_policy": VerbEntry("observing", "Learn a policy from the running robot."),
        "merge_policy": VerbEntry("policy", "Add the rights of policies to a policy file."),
        "diff_policy": VerbEntry(
            "policy", "How do the rights of two policies or keystores differ?"
        ),
        "minimize_policy": VerbEntry("policy", "Remove unused rights from a policy."),
        "explain": VerbEntry("explain", "May an enclave do this? By which rule?"),
        "view": VerbEntry("view", "Who may do what? Draw it."),
        "policies": VerbEntry("policy", "List or copy the policies that ship with sros."),
    },
    "Checks": {
        "check": VerbEntry(
            "check", "What is wrong in this policy, in this keystore, or in what runs here?"
        ),
        "review": VerbEntry("review", "May this change of policies and keystores be merged?"),
        "metrics": VerbEntry("check", "What should Prometheus alert on?"),
        "audit": VerbEntry("audit", "What would a policy deny to the robot that runs now?"),
        "doctor": VerbEntry("check", "Does the DDS on this machine enforce security?"),
    },
    "Running": {
        "env": VerbEntry("running", "Print the environment of an enclave."),
        "run": VerbEntry("running", "Run a command in an enclave."),
        "units": VerbEntry("running", "Write systemd units for nodes in enclaves, and timers."),
        "completion": VerbEntry("running", "Print the completion script of a shell."),
    },
}
_VERBS = {name: verb for family in FAMILIES.values() for name, verb in family.items()}
_VERB_OF_ALIAS = {alias: name for name, verb in _VERBS.items() for alias in (name, *verb.aliases)}


def _report_steps(ctx: click.Context, _parameter: click.Parameter, count: int) -> None:
    """Log steps on standard error until the program ends: INFO for one -v, DEBUG for several.

    Only the logger of sros is configured, so that other libraries do not log.
    """
    if not count:
        return
    import logging

    count += ctx.meta.get(_VERBOSITY, 0)
    ctx.meta[_VERBOSITY] = count
    logger = logging.getLogger("sros_tool")
    logger.setLevel(logging.INFO if count == 1 else logging.DEBUG)
    if _HANDLER in ctx.meta:
        return

    class EchoHandler(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            echo(f"{record.name}: {record.getMessage()}", err=True)

    def stop() -> None:
        logger.removeHandler(handler)
        logger.setLevel(logging.NOTSET)

    ctx.meta[_HANDLER] = handler = EchoHandler()
    logger.addHandler(handler)
    ctx.find_root().call_on_close(stop)


_VERBOSITY, _HANDLER = "sros.verbosity", "sros.handler"
_VERBOSE = click.Option(
    ["-v", "--verbose"],
    count=True,
    expose_value=False,
    callback=_report_steps,
    help="Log to standard error what sros does; -vv logs more details.",
)


class VerbGroup(click.Group):
    """A group that, without arguments, prints its help on standard error and ends with status 2.

    From release 8.2 on, click does the same; earlier releases of click end with 0.
    """

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments; without any, print the help and exit."""
        if not args and not ctx.resilient_parsing:
            echo_lines(ctx.get_help(), err=True)
            ctx.exit(NOT_DONE)
        return super().parse_args(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the verbs of the group with whole sentences; click would cut them to one line."""
        verbs = ((name, self.get_command(ctx, name)) for name in self.list_commands(ctx))
        with formatter.section("Verbs"):
            formatter.write_dl(
                [(name, verb.get_short_help_str(limit=200)) for name, verb in verbs if verb]
            )


class _Program(VerbGroup):
    """A command group that imports verbs when used, and accepts "-" for "_" in their names."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of all verbs, without aliases."""
        return list(_VERBS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import and return a verb, by its name or an alias; None for an unknown name."""
        name = _VERB_OF_ALIAS.get(cmd_name.replace("-", "_"))
        if name is None:
            return None
        module = importlib.import_module(f"sros_tool.cli.{_VERBS[name].module}")
        command = getattr(module, _VERBS[name].attribute or name)
        assert isinstance(command, click.Command)
        for subcommand in (command, *getattr(command, "commands", {}).values()):
            if _VERBOSE not in subcommand.params:
                subcommand.params.append(_VERBOSE)
        return command

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Complete verbs and aliases without importing them; with hyphens if the user typed one."""
        from click.shell_completion import CompletionItem

        if incomplete.startswith("-"):
            return super().shell_complete(ctx, incomplete)
        typed = incomplete.replace("-", "_")
        names = [name for name in _VERBS if name.startswith(typed)]
        names = names or [alias for alias in _VERB_OF_ALIAS if alias.startswith(typed)]
        mark = "-" if "-" in incomplete else "_"
        return [
            CompletionItem(name.replace("_", mark), help=_VERBS[_VERB_OF_ALIAS[name]].help)
            for name in names
        ]

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Resolve a verb as click does, also by an alias; suggest a verb for a mistyped one."""
        word = args[0].replace("-", "_")
        if word not in _VERB_OF_ALIAS:
            from difflib import get_close_matches

            if similar := get_close_matches(word, _VERB_OF_ALIAS, n=1):
                ctx.fail(f"No such command '{args[0]}'. Did you mean '{similar[0]}'?")
        name, command, rest = super().resolve_command(ctx, args)
        return (command.name if command else name), command, rest

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the verbs by family, without importing them."""
        for family, verbs in FAMILIES.items():
            with formatter.section(family):
                formatter.write_dl(
                    [
                        (name, verb.help + (f" Also {verb.aliases[0]}." if verb.aliases else ""))
                        for name, verb in verbs.items()
                    ]
                )


_EPILOG = """\b
Example:
  $ sros create_keystore keystore
  $ sros create_enclave keystore /talker
  $ sros run keystore /talker -- ros2 run demo_nodes_cpp talker

Where a verb takes a keystore, $ROS_SECURITY_KEYSTORE is the default.
Exit status: 0 yes or done; 1 no, denied, different or findings; 2 sros could
not answer or do it."""


def _show_version(context: click.Context, _: click.Parameter, asked: bool) -> None:
    if asked and not context.resilient_parsing:
        echo(f"sros {__version__}{_commit_of_checkout()}")
        context.exit()


def _commit_of_checkout() -> str:
    """Return the commit of the git checkout that runs, as a local version (PEP 440), or ""."""
    import subprocess

    from sros_tool.files import policies_dir

    checkout = policies_dir().parent
    if not (checkout / ".git").exists():  # an installed package has the folder inside
        return ""
    describe = ("describe", "--always", "--exclude=*", "--abbrev=10", "--dirty=.dirty")
    environment = {name: text for name, text in os.environ.items() if not name.startswith("GIT_")}
    with suppress(OSError, subprocess.SubprocessError):
        git = subprocess.run(
            ("git", "-C", str(checkout), *describe),
            env=environment,
            capture_output=True,
            text=True,
            timeout=10,
            check=True,
        )
        return f"+g{git.stdout.strip()}"
    return ""


@click.group(
    cls=_Program,
    epilog=_EPILOG,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 80},
)
@click.option(
    *("--version", "-V"),
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_show_version,
    help="Show the version and exit.",
)
def program() -> None:
    """Secure ROS 2 robots: keystores, enclaves and permissions from policies in ROS terms."""


program.params.append(_VERBOSE)


_VERB_PHRASES = {
    "create_keystore": "create keystore",
    "create_enclave": "create enclave",
    "create_permission": "create permission",
    "generate_artifacts": "generate artifacts",
    "update_keystore": "update keystore",
    "list_enclaves": "list enclaves",
    "distribute_key": "distribute key",
    "rotate_ca": "rotate the CA",
    "create_request": "create the request",
    "sign_request": "sign the request",
    "import": "import the answer",
    "generate_policy": "generate policy",
    "merge_policy": "merge policies",
    "diff_policy": "compare",
    "minimize_policy": "minimize the policy",
    "env": "print the environment",
    "run": "run the command",
    "units": "write the units",
    "demo": "run the demo",
    "policies": "show the policies",
    "crl": "show or sign the revocation list",
    "zenoh": "write the Zenoh files",
    "completion": "print the completion script",
    "doctor": "examine this machine",
    "audit": "audit the robot",
    "close": "close the robot",
    "close --proof": "prove that the robot is closed",
    "close --undo": "open the robot",
    "metrics": "give the metrics",
    "review": "review the change",
    "agent init": "set up the agent",
    "agent run": "run the agent",
    "agent status": "show the agent",
    "fleet collect": "finish collecting",
    "fleet confirm": "store the confirmation",
    "fleet inventory": "print the inventory",
    "fleet publish": "publish",
    "fleet report": "report",
    "fleet status": "show the fleet",
}


def report_error(error: BaseException, arguments: Sequence[str], name: str = "sros") -> int:
    """Print an error with its reason and remedy; return the exit status.

    ``arguments`` are the words of the command line: messages begin with the action of its verb.
    ``name`` is the program's name in help.
    """
    if isinstance(error, SystemExit):
        return error.code if isinstance(error.code, int) else 1
    if isinstance(error, click.exceptions.Exit):
        return error.exit_code
    if isinstance(error, (KeyboardInterrupt, click.Abort)):
        echo("sros: interrupted", err=True)
        return 130
    if isinstance(error, click.UsageError):
        where = error.ctx.command_path if error.ctx else _named_command(arguments, name)
        return _print_error(f"{where}: {error.format_message()} See `{where} --help`.")
    if isinstance(error, SrosError):
        return _print_error(_with_usage_prefix(str(error), arguments))
    if isinstance(error, OSError):
        return _print_error(_with_usage_prefix(_os_problem(error), arguments))
    return _report_defect(error, arguments)


def _named_command(arguments: Sequence[str], name: str) -> str:
    """Return the program's ``name`` with the verb in ``arguments``, if there is one.

    It is for errors in which click names no verb.
    """
    command: click.Command | None = program
    for word in arguments:
        if isinstance(command, click.Group) and not word.startswith("-"):
            command = command.get_command(click.Context(command), word)
            name += f" {command.name}" if command else ""
    return name


def _print_error(text: str) -> int:
    echo(" ".join(text.split()), err=True)
    return NOT_DONE


def _with_usage_prefix(text: str, arguments: Sequence[str]) -> str:
    verb = _verb_in(arguments)
    if verb is None:
        return f"sros: {text}"
    words = " ".join([word for word in arguments if not word.startswith("-")][:2])
    named = [words, *(f"{verb} {word}" for word in arguments if word.startswith("--")), verb]
    phrase = next(filter(None, map(_VERB_PHRASES.get, named)), verb.replace("_", " "))
    return f"Unable to {phrase}: {text}"


def _verb_in(arguments: Sequence[str]) -> str | None:
    for word in arguments:
        if not word.startswith("-"):
            return _VERB_OF_ALIAS.get(word.replace("-", "_"))
    return None


def _os_problem(error: OSError) -> str:
    if error.filename is None:  # no file is to blame, perhaps the working directory
        try:
            Path.cwd()
        except OSError:
            return "the working directory no longer exists. Change to another one."
        return f"the operating system refuses: {error.strerror or error}."
    path = os.fsdecode(error.filename)
    return f"the operating system refuses '{path}': {error.strerror or error}."


def _outdated_dependency_advice() -> str:
    """Return which required package is missing or too old, and what to do; "" if none is.

    colcon installs sros next to packages of the system without checking their versions.
    """
    from importlib.metadata import PackageNotFoundError, requires, version

    with suppress(PackageNotFoundError):
        for requirement in requires("sros_tool") or ():
            name, mark, least = requirement.partition(">=")
            if not mark or ";" in requirement:  # of an extra
                continue
            try:
                installed_version = version(name)
            except PackageNotFoundError:
                installed_version = ""
            if not installed_version or _version_numbers(installed_version) < _version_numbers(
                least
            ):
                present = f"version {installed_version} is" if installed_version else "none is"
                return (
                    f"sros needs the Python package {name} {least} or newer, "
                    f"and {present} installed for {sys.executable}. "
                    f"Install version {least} or newer with the pip of that Python."
                )
    return ""


def _version_numbers(version: str) -> list[int]:
    return [int(digits) for digits in re.findall(r"\d+", version)[:2]]


def _report_defect(error: BaseException, arguments: Sequence[str]) -> int:
    if isinstance(error, (ImportError, AttributeError)) and (
        problem := _outdated_dependency_advice()
    ):
        return _print_error(_with_usage_prefix(problem, arguments))
    if os.environ.get("SROS_DEBUG"):
        import traceback

        echo_lines("".join(traceback.format_exception(error)).rstrip("\n"), err=True)
    return _print_error(
        _with_usage_prefix(
            f"this is a defect of sros: {type(error).__name__}: {error}. Please report it; "
            "SROS_DEBUG=1 prints a traceback.",
            arguments,
        )
    )
