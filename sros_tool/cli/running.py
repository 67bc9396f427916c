"""The verbs `env` and `run`, for processes in an enclave, and `completion`, for shells."""

from __future__ import annotations

import os
import shutil
import signal
import stat
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from shlex import quote
from typing import Any

import click

from sros_tool.cli.common import (
    check_one_format,
    complete_keystore_and_enclave,
    json_option,
    now,
    print_json,
    split_root,
)
from sros_tool.errors import KeystoreError, UnavailableError, UsageError

_COMMAND = "sros.command"
_WORDS = click.argument(
    "words",
    metavar="[ROOT] NAME",
    nargs=-1,
    required=True,
    shell_complete=complete_keystore_and_enclave,
)
_DOMAIN = click.option(
    "--domain", metavar="ID", help="The ROS domain. [default: $ROS_DOMAIN_ID, or the keystore's]"
)


_ACCEPT_KEY = click.option(
    "--accept-readable-key",
    is_flag=True,
    help="Accept a private key that other users can read, as on a file system without modes.",
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
        from sros_tool.runtime.environment import REFUSING, render_refusal

        if as_json:
            print_json({"keystore": None, "enclave": None, "variables": REFUSING})
        else:
            click.echo(render_refusal(form), nl=False)
        raise


_FORMS = ("sh", "fish", "json", "systemd", "docker")


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
  export ROS_DOMAIN_ID=0""",
)
@_WORDS
@click.option(
    "--format",
    "form",
    type=click.Choice(_FORMS),
    default=_FORMS[0],
    show_default=True,
    help="For a shell, a systemd unit or Docker; json has names and values alone.",
)
@_DOMAIN
@_ACCEPT_KEY
@json_option
def env(
    words: tuple[str, ...],
    form: str,
    domain: str | None,
    accept_readable_key: bool,
    as_json: bool,
) -> None:
    """Print the environment variables that make a process run in the enclave NAME.

    The strategy is Enforce: a process that cannot run in the enclave does not start. If the
    variables cannot be given, those that are printed let no node start.
    """
    from sros_tool.runtime.environment import render_environment

    check_one_format()
    root, rest = split_root(words)
    if len(rest) != 1:
        raise UsageError("env takes a keystore and one enclave")
    variables = loadable_environment(root, rest[0], domain, accept_key=accept_readable_key)
    text = render_environment(variables, "json" if as_json else form)
    if as_json:
        print_json({"keystore": str(root), "enclave": rest[0], "variables": variables})
    else:
        click.echo(text, nl=False)


class _WithCommand(click.Command):
    """A verb with a command as argument, whose options it does not parse.

    The command is all words after ``--``; without it, parsing of options stops at the first word
    that is not an option.
    """

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments of sros, and keep the command to run in ``ctx.meta``."""
        own, command = args, []
        if "--" in args:
            own, command = args[: args.index("--")], args[args.index("--") + 1 :]
        else:
            ctx.allow_interspersed_args = False
        ctx.meta[_COMMAND] = command
        return super().parse_args(ctx, own)


@click.command(
    "run",
    cls=_WithCommand,
    epilog="""\b
Example:
  $ sros run keystore /talker_listener/talker -- \\
        python3 -m sros_tool.demo.nodes.ros talker
  [INFO] [talker]: Publishing: 'Hello World: 1'""",
)
@click.argument(
    "words",
    metavar="[ROOT] NAME -- COMMAND...",
    nargs=-1,
    required=True,
    type=click.UNPROCESSED,
    shell_complete=complete_keystore_and_enclave,
)
@_DOMAIN
@_ACCEPT_KEY
@click.option("--no-ros-args", is_flag=True, help="Add no arguments to COMMAND.")
@click.pass_context
def run(
    ctx: click.Context,
    words: tuple[str, ...],
    domain: str | None,
    accept_readable_key: bool,
    no_ros_args: bool,
) -> None:
    """Run COMMAND in the enclave NAME of the keystore ROOT, or not at all (strategy Enforce).

    The enclave is checked first, so that problems are reported here and not by an obscure message
    of the middleware. A COMMAND that is known to start a ROS node (`ros2 run`, or an executable of
    a ROS package) gets the arguments `--ros-args --enclave NAME`, so that the ROS graph shows the
    enclave.
    """
    from sros_tool.runtime.environment import with_enclave

    root, rest = split_root(words)
    name, command = rest[0] if rest else "", [*rest[1:], *ctx.meta[_COMMAND]]
    if not command:
        raise UsageError("no command is given", "", "Write `sros run ROOT NAME -- COMMAND...`.")
    variables = loadable_environment(root, name, domain, accept_key=accept_readable_key)
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
        click.echo(
            f"added {added}, so that the ROS graph shows the enclave (--no-ros-args: do not)",
            err=True,
        )
    sys.stdout.flush()
    sys.stderr.flush()
    for ignored in (signal.SIGPIPE, signal.SIGXFSZ):  # Python ignores them, and COMMAND would too
        signal.signal(ignored, signal.SIG_DFL)
    os.execve(program, command, {**os.environ, **variables})


def loadable_environment(
    root: Path, name: str, domain_text: str | None, *, accept_key: bool = False
) -> dict[str, str]:
    """Return the environment variables of an enclave after checking that a process can run in it.

    ``domain_text`` is the value of --domain; None stands for $ROS_DOMAIN_ID.  ``accept_key``
    accepts a private key that other users can read.

    Raises:
        UsageError: the domain or the enclave's name is invalid.
        KeystoreError: the enclave does not exist, a process cannot run in it, or others can read
            its private key.
    """
    from sros_tool.keystore.layout import (
        KEY_FILE,
        check_keystore,
        enclave_path,
        has_enclave,
        list_enclaves,
    )
    from sros_tool.keystore.missing import no_such_enclave
    from sros_tool.keystore.reader import open_enclave
    from sros_tool.names import check_enclave_name
    from sros_tool.runtime.environment import (
        DOMAIN,
        choose_domain,
        domain_from,
        secured_environment,
    )

    if domain_text == "":
        raise UsageError("--domain is empty", "", "Name a domain, or leave the option out.")
    wanted = domain_from(os.environ if domain_text is None else {DOMAIN: domain_text})
    check_enclave_name(name)
    check_keystore(root)
    if not has_enclave(root, name):
        raise no_such_enclave(root, name, list_enclaves(root))
    folder = enclave_path(root, name)
    state = open_enclave(folder, now=now())
    domains = state.domains()
    domain = choose_domain(domains, wanted, root) if domains else 0
    state = open_enclave(folder, now=now(), domain=domain)
    if state.problems:
        raise KeystoreError(
            f"a process cannot run in enclave {name}",
            "; ".join(map(str, state.problems)) + ".",
            f"See `sros inspect {folder}`.",
        )
    if not accept_key:
        _check_key_closed(folder / KEY_FILE, root, name)
    return secured_environment(root, name, domain)


def _check_key_closed(key: Path, root: Path, name: str) -> None:
    """Raise `KeystoreError` if users other than the owner can read a private key."""
    mode = stat.S_IMODE(key.stat().st_mode)
    if mode & 0o077:
        raise KeystoreError(
            f"others can read the private key of enclave {name}",
            f"The mode of '{key}' is {mode:04o}: whoever has read the key can act as the enclave.",
            f"Run `chmod 600 {quote(str(key))}`. If others had access, give the enclave another "
            f"key: `sros renew {quote(str(root))} {name} --new-key --revoke-old`. To run it "
            "nevertheless, add --accept-readable-key.",
        )


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
    click.echo(kind(program, {}, "sros", "_SROS_COMPLETE").source())
