"""The verbs `env` and `run`, for processes in an enclave, and `completion`, for shells."""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from sros_tool.cli.common import (
    PATH,
    check_one_format,
    complete_keystore_and_enclave,
    json_option,
    print_json,
    print_notes,
    split_root,
)
from sros_tool.cli.containers import INSTALLED, container_text, target_path
from sros_tool.cli.enclave_environment import RMWS, loadable_environment
from sros_tool.errors import Note, UnavailableError, UsageError
from sros_tool.runtime.containers import COMPOSE, KUBERNETES
from sros_tool.runtime.containers import FORMS as CONTAINER_FORMS
from sros_tool.terminal import echo, echo_document, echo_lines

COMMAND = "sros.command"
"""The key of ``ctx.meta`` with the words after ``--`` of a `WithCommand`."""
_FAST_DDS_PIN = "FASTDDS_PKCS11_PIN"
"""The variable from which Fast DDS takes the PIN of a token (Pkcs11Provider.cpp)."""
_NO_PIN = (
    f"no file has the PIN of the token (pin-source), so Fast DDS takes it from ${_FAST_DDS_PIN}, "
    "which root and this user can read in /proc."
)
_WORDS = click.argument(
    "words",
    metavar="[ROOT] NAME",
    nargs=-1,
    required=True,
    shell_complete=complete_keystore_and_enclave,
)
DOMAIN = click.option(
    "--domain", metavar="ID", help="The ROS domain. [default: $ROS_DOMAIN_ID, or the keystore's]"
)


def _complete_rmw(_ctx: click.Context, _parameter: click.Parameter, incomplete: str) -> list[str]:
    """Complete the RMWs that sros knows to secure."""
    return [each for each in RMWS if each.startswith(incomplete)]


RMW = click.option(
    "--rmw",
    metavar="NAME",
    shell_complete=_complete_rmw,
    help="The RMW of the process, such as rmw_zenoh_cpp. [default: $RMW_IMPLEMENTATION]",
)
ACCEPT_KEY = click.option(
    "--accept-readable-key",
    is_flag=True,
    help="Accept a private key, or the PIN of its token, that other users can read, and folders in "
    "which they can write, as on a file system without modes.",
)


class _FailingClosed(click.Command):
    """A verb whose output is evaluated: if it fails in any way, no node starts with its output.

    That includes wrong options: a shell evaluates whatever is printed, and ignores the exit status.
    """

    def make_context(
        self,
        info_name: str | None,
        args: list[str],
        parent: click.Context | None = None,
        **more: Any,
    ) -> click.Context:
        """Parse the arguments."""
        if more.get("resilient_parsing"):  # completion
            return super().make_context(info_name, args, parent, **more)
        with _refusal_printed(_form_of(args), "--json" in args):
            return super().make_context(info_name, args, parent, **more)

    def invoke(self, ctx: click.Context) -> Any:
        """Run the verb."""
        with _refusal_printed(ctx.params["form"], ctx.params["as_json"]):
            return super().invoke(ctx)


@contextmanager
def _refusal_printed(form: str, as_json: bool) -> Iterator[None]:
    """Print what starts no node if an error or a signal ends the context."""
    try:
        yield
    except click.exceptions.Exit:  # --help
        raise
    except BaseException:
        from sros_tool.runtime.environment import REFUSING, PrintedEnvironment, render_refusal

        if as_json:
            print_json(PrintedEnvironment(None, None, REFUSING, ()))
        else:
            echo_document(render_refusal(form))
        raise


_FORMS = ("sh", "fish", "json", "systemd", "docker", *CONTAINER_FORMS)


def _form_of(arguments: Sequence[str]) -> str:
    """Return the form that arguments ask for which could not be parsed."""
    named = (
        each.removeprefix("--format=")
        for each, before in zip(arguments, ["", *arguments], strict=False)
        if each.startswith("--format=") or before == "--format"
    )
    return next((each for each in named if each in _FORMS), _FORMS[0])


@click.command(
    "env",
    cls=_FailingClosed,
    epilog="""\b
Example:
  $ eval "$(sros env keystore /talker)"
  $ sros env keystore /talker
  export ROS_SECURITY_KEYSTORE=/home/robot/keystore
  export ROS_SECURITY_ENABLE=true
  export ROS_SECURITY_STRATEGY=Enforce
  export ROS_SECURITY_ENCLAVE_OVERRIDE=/talker
  export ROS_DOMAIN_ID=0
  $ sros env keystore /talker --format compose > secured.yaml
  $ sros env keystore /talker --format kubernetes-secret | \\
        kubectl apply --server-side -f -
  $ sros env keystore /talker --format kubernetes --image talker:1 | \\
        kubectl apply -f -""",
)
@_WORDS
@click.option(
    "--format",
    "form",
    metavar="FORM",
    type=click.Choice(_FORMS),
    default=_FORMS[0],
    show_default=True,
    help="For a shell (sh, fish), a program (json), a unit (systemd), an env-file (docker), or a "
    "container: compose, kubernetes, and kubernetes-secret, which holds the private key.",
)
@click.option(
    "--target",
    "there",
    metavar="DIR",
    help="The path of the keystore where the process runs: on the robot, in the container. "
    f"[default: ROOT; for containers {INSTALLED}]",
)
@click.option(
    "--name",
    "container",
    metavar="NAME",
    help="The name of the service in Compose, or the Deployment. [default: from the enclave]",
)
@click.option("--image", metavar="IMAGE", help="The image of the container.")
@DOMAIN
@RMW
@ACCEPT_KEY
@json_option
def env(
    words: tuple[str, ...],
    form: str,
    there: str | None,
    container: str | None,
    image: str | None,
    domain: str | None,
    rmw: str | None,
    accept_readable_key: bool,
    as_json: bool,
) -> None:
    """Print the environment variables that make a process run in the enclave NAME.

    The strategy is Enforce: a process that cannot run in the enclave does not start. If the
    variables cannot be given, those that are printed let no node start. With rmw_zenoh_cpp, which
    ignores ROS_SECURITY_*, they also name the configuration that `sros zenoh` wrote, and replace
    those of Zenoh that are set.

    A container gets the files of the enclave from an export in DIR (Compose), or from a Secret
    (Kubernetes). Without --image, what is printed is to be merged with a definition that has one.
    """
    from sros_tool.runtime.environment import PrintedEnvironment, render_environment

    check_one_format()
    root, rest = split_root(words)
    if len(rest) != 1:
        raise UsageError("env takes a keystore and one enclave")
    for option, value in (("--name", container), ("--image", image)):
        if value is not None and (form not in (COMPOSE, KUBERNETES) or not value):
            what = f"{option} is empty" if not value else f"the format {form} has no {option}"
            raise UsageError(what, "", f"It is for {COMPOSE} and {KUBERNETES}.")
    in_container = form in CONTAINER_FORMS
    if there is None and in_container:
        there = INSTALLED
    target = None if there is None else target_path(there)
    found = loadable_environment(
        root, rest[0], domain, rmw, accept_key=accept_readable_key, target=target
    )
    if target and in_container:
        text = container_text(
            root, rest[0], form, target, found.variables, container or "", image or ""
        )
    else:
        text = render_environment(found.variables, "json" if as_json else form)
    notes = [*found.notes, *found.enclave_notes]
    if found.needs_pin:
        notes.append(Note("token.no-pin", _NO_PIN))
    if as_json:
        print_json(PrintedEnvironment(root, rest[0], found.variables, notes))
    else:
        echo_document(text)
        print_notes(notes)


class WithCommand(click.Command):
    """A verb with a command as argument, whose options it does not parse.

    The command is all words after ``--``; without it, if ``needs_no_dashes``, parsing of options
    stops at the first word that is not an option.
    """

    needs_no_dashes = True

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments of sros, and keep the command to run in ``ctx.meta``."""
        own, command = args, []
        if "--" in args:
            own, command = args[: args.index("--")], args[args.index("--") + 1 :]
        elif self.needs_no_dashes:
            ctx.allow_interspersed_args = False
        ctx.meta[COMMAND] = command
        return super().parse_args(ctx, own)


@click.command(
    "run",
    cls=WithCommand,
    epilog="""\b
Example:
  $ sros run keystore /talker_listener/talker -- \\
        python3 -m sros_tool.demo.nodes.ros talker
  [INFO] [talker]: Publishing: 'Hello World: 1'
  $ ros2 launch --launch-prefix 'sros run keystore --policy policy.xml --' \\
        demo_nodes_cpp talker_listener_launch.py""",
)
@click.argument(
    "words",
    metavar="[ROOT] NAME -- COMMAND...",
    nargs=-1,
    type=click.UNPROCESSED,
    shell_complete=complete_keystore_and_enclave,
)
@click.option(
    "--policy",
    metavar="FILE",
    type=PATH,
    help="Take the enclave in which FILE has the node that COMMAND starts, in place of NAME.",
)
@DOMAIN
@RMW
@ACCEPT_KEY
@click.option("--no-ros-args", is_flag=True, help="Add no arguments to COMMAND.")
@click.pass_context
def run(
    ctx: click.Context,
    words: tuple[str, ...],
    policy: Path | None,
    domain: str | None,
    rmw: str | None,
    accept_readable_key: bool,
    no_ros_args: bool,
) -> None:
    """Run COMMAND in the enclave NAME of the keystore ROOT, or not at all (strategy Enforce).

    The enclave is checked first, so that problems are reported here and not by an obscure message
    of the middleware. A COMMAND that is known to start a ROS node (`ros2 run`, or an executable of
    a ROS package) gets the arguments `--ros-args --enclave NAME`, so that the ROS graph shows the
    enclave; with rmw_zenoh_cpp nobody accepts a node in the graph without it.

    With --policy, COMMAND gives its node a name: `--ros-args -r __node:=NAME -r __ns:=NAMESPACE`,
    as launch files do.
    """
    from sros_tool.runtime.environment import enclave_argument, named_enclave, with_enclave

    root, rest = split_root(words)
    if policy and rest and ctx.meta[COMMAND]:
        raise UsageError(
            f"--policy and the enclave {rest[0]} exclude each other",
            "The policy says in which enclave the node is.",
            "Leave one of both out.",
        )
    command = [*rest[0 if policy else 1 :], *ctx.meta[COMMAND]]
    if not command:
        raise UsageError("no command is given", "", "Write `sros run ROOT NAME -- COMMAND...`.")
    name = _enclave_of_node(policy, command) if policy else rest[0] if rest else ""
    if (other := named_enclave(command)) and other != name:
        raise UsageError(
            f"the command names the enclave {other}, and sros would run it in {name}",
            "ROS_SECURITY_ENCLAVE_OVERRIDE, which sros sets, counts more than --enclave.",
            f"Leave `--enclave {shlex.quote(other)}` out, or name the same enclave: `sros run "
            f"{shlex.quote(str(root))} {shlex.quote(other)} -- COMMAND`.",
        )
    found = loadable_environment(root, name, domain, rmw, accept_key=accept_readable_key)
    program = shutil.which(command[0])
    if program is None:
        raise UsageError(
            f"the command '{command[0]}' is not found",
            "",
            "Name its path, or set up its environment first (ROS: `. /opt/ros/jazzy/setup.sh`).",
        )
    given = tuple(command)
    if not no_ros_args and (command := list(with_enclave(given, name))) != list(given):
        added = " ".join(command[len(given) :])
        echo(
            f"added {added}, so that the ROS graph shows the enclave (--no-ros-args: do not)",
            err=True,
        )
    environment = {**os.environ, **found.variables}
    pin = environment.pop(_FAST_DDS_PIN, None)
    if found.needs_pin and pin is None:
        print_notes([Note("token.no-pin", _NO_PIN)])
    elif found.needs_pin and pin is not None:
        environment[_FAST_DDS_PIN] = pin
    print_notes(found.notes)
    names_it = enclave_argument(command) == name or _is_demo(command)
    if not names_it:
        print_notes(found.enclave_notes)
    sys.stdout.flush()
    sys.stderr.flush()
    for ignored in (signal.SIGPIPE, signal.SIGXFSZ):  # Python ignores them, and COMMAND would too
        signal.signal(ignored, signal.SIG_DFL)
    os.execve(program, command, environment)


def _is_demo(command: Sequence[str]) -> bool:
    """Return whether a command is a node of `sros demo`, which names its enclave itself."""
    return Path(command[0]).name == "sros" and list(command[1:2]) == ["demo"]


def _enclave_of_node(file: Path, command: Sequence[str]) -> str:
    """Return the enclave in which a policy has the node that a command starts.

    Raises:
        UsageError: the command names no node, or the policy has it in none or several enclaves.
        PolicyError: the policy cannot be read.
    """
    from sros_tool.policy.document import read_policy
    from sros_tool.runtime.environment import node_argument

    node = node_argument(command)
    if node is None:
        raise UsageError(
            f"the command '{command[0]}' names no node",
            "Its enclave is that of the node's name in the policy, which `--ros-args -r "
            "__node:=NAME` gives.",
            "Give the node a name in the launch file, or start this command in an enclave of its "
            "own: `sros run ROOT NAME -- COMMAND`.",
        )
    ns, name = node
    full = f"/{ns.strip('/')}/{name}".replace("//", "/")
    found = read_policy(file).enclaves_of_node(ns, name)
    if len(found) != 1:
        names = ", ".join(each.path for each in found[:3])
        what = f"in {len(found)} enclaves, such as {names}" if found else "in no enclave"
        raise UsageError(
            f"the policy '{file}' has the node {full} {what}",
            "A process runs in one enclave.",
            f'Give it a profile in one enclave: `<profile ns="{ns}" node="{name}">`.',
        )
    return found[0].path


@click.command(
    "completion",
    epilog="""\b
Example:
  $ sros completion bash > ~/.local/share/bash-completion/completions/sros""",
)
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def completion(shell: str) -> None:
    """Print the script that makes SHELL complete verbs, options, enclaves and templates."""
    from click.shell_completion import get_completion_class

    from sros_tool.cli.program import program

    kind = get_completion_class(shell)
    if kind is None:
        raise UnavailableError(
            f"there is no completion for {shell}", "", "Choose bash, zsh or fish."
        )
    echo_lines(kind(program, {}, "sros", "_SROS_COMPLETE").source())
