"""The verbs `env` and `run`, for processes in an enclave, and `completion`, for shells."""

from __future__ import annotations

import os
import pwd
import shlex
import shutil
import signal
import stat
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import timedelta
from io import UnsupportedOperation
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sros_tool.cli.common import (
    PATH,
    Verb,
    check_one_format,
    chosen_enclaves,
    domain_of,
    dry_run_option,
    enclave_environment,
    json_option,
    keystore_arguments,
    now,
    passphrase_file_notes,
    print_json,
    print_notes,
    progress,
    several_enclaves_options,
    split_root,
    verb,
)
from sros_tool.enclave_environment import (
    INSTALLED,
    RMWS,
    container_text,
    enclave_of_node,
    node_units,
    other_node_notes,
    target_path,
)
from sros_tool.errors import Note, UnavailableError, UsageError
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.runtime.environment import COMPOSE, CONTAINER_FORMS, KUBERNETES, SECRET
from sros_tool.runtime.units import Job
from sros_tool.terminal import echo, echo_document, echo_lines
from sros_tool.values import FileChange
from sros_tool.wording import first_few

if TYPE_CHECKING:
    from sros_tool.enclave_environment import EnclaveEnvironment

_COMMAND_KEY = "sros.command"
"""The key in ``ctx.meta`` for the words that a `_VerbWithCommand` gets after ``--``."""
_FAST_DDS_PIN = "FASTDDS_PKCS11_PIN"
"""The variable from which Fast DDS takes the PIN of a token (Pkcs11Provider.cpp)."""
_NO_PIN = (
    f"no file has the PIN of the token (pin-source), so Fast DDS takes it from ${_FAST_DDS_PIN}, "
    "which root and this user can read in /proc."
)
_ENCLAVE_ARGUMENTS = keystore_arguments("[KEYSTORE] ENCLAVE")
_DOMAIN_OPTION = click.option(
    "--domain", metavar="ID", help="The ROS domain. [default: $ROS_DOMAIN_ID, or the keystore's]"
)


def _complete_rmw(_ctx: click.Context, _parameter: click.Parameter, incomplete: str) -> list[str]:
    """Complete the RMWs that sros knows to secure."""
    return [rmw for rmw in RMWS if rmw.startswith(incomplete)]


_RMW_OPTION = click.option(
    "--rmw",
    metavar="NAME",
    shell_complete=_complete_rmw,
    help="The RMW of the process, such as rmw_zenoh_cpp. [default: $RMW_IMPLEMENTATION]",
)
_ACCEPT_KEY_OPTION = click.option(
    "--accept-readable-key",
    is_flag=True,
    help="Start even if other users can read the private key or its token's PIN, or write "
    "to the enclave's folders, as on a file system without permission bits.",
)


class _FailingClosed(Verb):
    """A verb whose output a shell evaluates; on failure the output keeps nodes from starting.

    Wrong options count as a failure, too: a shell evaluates whatever is printed, and ignores the
    exit status.
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
        with _print_refusal_on_failure(_form_of(args), "--json" in args):
            return super().make_context(info_name, args, parent, **more)

    def invoke(self, ctx: click.Context) -> Any:
        """Run the verb."""
        with _print_refusal_on_failure(ctx.params["form"], ctx.params["as_json"]):
            return super().invoke(ctx)


@contextmanager
def _print_refusal_on_failure(form: str, as_json: bool) -> Iterator[None]:
    """Print output that keeps nodes from starting if an error or a signal ends the context."""
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
    """Return the --format in arguments that click could not parse."""
    named = (
        word.removeprefix("--format=")
        for word, before in zip(arguments, ["", *arguments], strict=False)
        if word.startswith("--format=") or before == "--format"
    )
    return next((form for form in named if form in _FORMS), _FORMS[0])


@verb("env", cls=_FailingClosed)
@_ENCLAVE_ARGUMENTS
@click.option(
    "--format",
    "form",
    metavar="FORM",
    type=click.Choice(_FORMS),
    default=_FORMS[0],
    show_default=True,
    help="Output format: shell (sh, fish), json, systemd, docker (an env file), or container "
    "definitions: compose, kubernetes, and kubernetes-secret, which contains the "
    "private key.",
)
@click.option(
    "--target",
    "target_dir",
    metavar="DIR",
    help="The path of the keystore where the process runs: on the robot or in the container. "
    f"[default: KEYSTORE; for containers {INSTALLED}]",
)
@click.option(
    "--name",
    "container",
    metavar="NAME",
    help="Name of the Compose service or Kubernetes Deployment. [default: from the enclave]",
)
@click.option("--image", metavar="IMAGE", help="The image of the container.")
@_DOMAIN_OPTION
@_RMW_OPTION
@_ACCEPT_KEY_OPTION
@json_option
def env(
    arguments: tuple[str, ...],
    form: str,
    target_dir: str | None,
    container: str | None,
    image: str | None,
    domain: str | None,
    rmw: str | None,
    accept_readable_key: bool,
    as_json: bool,
) -> None:
    r"""Print the environment variables that make a process run in ENCLAVE.

    The strategy is Enforce: a process that cannot run in the enclave does not start. If the enclave
    cannot be used, sros prints variables that keep every node from starting. With rmw_zenoh_cpp,
    which ignores ROS_SECURITY_*, the variables also name the configuration that `sros zenoh` wrote,
    and override Zenoh variables that are already set.

    A container gets the files of the enclave from an export in DIR (Compose), or from a Secret
    (Kubernetes). Without --image, merge the output with a definition that names an image.

    Example:
      $ eval "$(sros env keystore /talker)"
      $ sros env keystore /talker
      export ROS_SECURITY_KEYSTORE=/home/robot/keystore
      export ROS_SECURITY_ENABLE=true
      export ROS_SECURITY_STRATEGY=Enforce
      export ROS_SECURITY_ENCLAVE_OVERRIDE=/talker
      export ROS_DOMAIN_ID=0
      $ sros env keystore /talker --format compose > secured.yaml
      $ sros env keystore /talker --format kubernetes-secret | \
            kubectl apply --server-side -f -
      $ sros env keystore /talker --format kubernetes --image talker:1 | \
            kubectl apply -f -
    """
    from sros_tool.runtime.environment import PrintedEnvironment, render_environment

    check_one_format()
    root, rest = split_root(arguments)
    if len(rest) != 1:
        raise UsageError("env takes a keystore and one enclave")
    for option, value in (("--name", container), ("--image", image)):
        if value is not None and (form not in (COMPOSE, KUBERNETES) or not value):
            if not value:
                raise UsageError(f"{option} is empty", "", "Give it a value, or leave it out.")
            fault = f"the format {form} has no {option}"
            raise UsageError(fault, "", f"Leave it out: it is for {COMPOSE} and {KUBERNETES}.")
    in_container = form in CONTAINER_FORMS
    if target_dir is None and in_container:
        target_dir = INSTALLED
    target = None if target_dir is None else target_path(target_dir)
    keystore = OpenedKeystore(root)
    secured = enclave_environment(
        keystore, rest[0], domain, rmw, accept_key=accept_readable_key, target=target
    )
    if target and in_container:
        if form == SECRET:
            _refuse_open_output()
        text = container_text(
            keystore,
            rest[0],
            form,
            target=target,
            variables=secured.variables,
            name=container or "",
            image=image or "",
            now=now(),
        )
    else:
        text = render_environment(secured.variables, "json" if as_json else form)
    notes = [*secured.notes, *secured.enclave_notes]
    if secured.needs_pin:
        notes.append(Note("token.no-pin", _NO_PIN))
    if as_json:
        print_json(PrintedEnvironment(root, rest[0], secured.variables, notes))
    else:
        echo_document(text)
        print_notes(notes)


def _refuse_open_output() -> None:
    """Raise `UsageError` if standard output is a terminal, or a file that others can read."""
    command = "Use a pipe, `| kubectl apply --server-side -f -`, or a file after `umask 077`."
    if sys.stdout is not None and sys.stdout.isatty():
        raise UsageError(
            "a private key would be written to this terminal", "A Secret is not encrypted.", command
        )
    with suppress(UnsupportedOperation):
        state = os.fstat(sys.stdout.fileno())
        if stat.S_ISREG(state.st_mode) and state.st_mode & 0o077:
            raise UsageError(
                "a private key would be written to a file that others can read",
                f"The mode of the file is {stat.S_IMODE(state.st_mode):04o}.",
                command,
            )


class _VerbWithCommand(Verb):
    """A verb with a command as argument, whose options it does not parse.

    The command is all words after ``--``; without it, if ``needs_no_dashes``, parsing of options
    stops at the first word that is not an option.
    """

    needs_no_dashes = True

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments of sros, and keep the command to run in ``ctx.meta``."""
        own_arguments, command = args, []
        if "--" in args:
            own_arguments, command = args[: args.index("--")], args[args.index("--") + 1 :]
        elif self.needs_no_dashes:
            ctx.allow_interspersed_args = False
        ctx.meta[_COMMAND_KEY] = command
        return super().parse_args(ctx, own_arguments)


@verb("run", cls=_VerbWithCommand)
@keystore_arguments("[KEYSTORE] ENCLAVE -- COMMAND...", required=False, type=click.UNPROCESSED)
@click.option(
    "--policy",
    metavar="FILE",
    type=PATH,
    help="Instead of ENCLAVE: use the enclave that the policy FILE assigns to the node which "
    "COMMAND starts.",
)
@_DOMAIN_OPTION
@_RMW_OPTION
@_ACCEPT_KEY_OPTION
@click.option("--no-ros-args", is_flag=True, help="Do not add --ros-args to COMMAND.")
@click.pass_context
def run(
    ctx: click.Context,
    arguments: tuple[str, ...],
    policy: Path | None,
    domain: str | None,
    rmw: str | None,
    accept_readable_key: bool,
    no_ros_args: bool,
) -> None:
    r"""Run COMMAND in ENCLAVE of KEYSTORE, or not at all (strategy Enforce).

    The enclave is checked first, so that problems are reported here and not by an obscure message
    of the middleware. A COMMAND that is known to start a ROS node (`ros2 run`, or an executable of
    a ROS package) gets the arguments `--ros-args --enclave ENCLAVE`, so that the ROS graph shows
    the enclave. With rmw_zenoh_cpp, other processes do not accept a node without these arguments
    into their graph.

    With --policy, COMMAND has to name its node: `--ros-args -r __node:=NAME -r __ns:=NAMESPACE`, as
    launch files do.

    Example:
      $ sros run keystore /talker_listener/talker -- \
            python3 -m sros_tool.demo.ros_node talker
      [INFO] [talker]: Publishing: 'Hello World: 1'
      $ ros2 launch --launch-prefix 'sros run keystore --policy policy.xml --' \
            demo_nodes_cpp talker_listener_launch.py
    """
    from sros_tool.runtime.environment import (
        enclave_argument,
        named_enclave,
        with_enclave,
        without_own_libraries,
    )

    root, rest = split_root(arguments)
    if policy and rest and ctx.meta[_COMMAND_KEY]:
        raise UsageError(
            f"--policy and the enclave {rest[0]} exclude each other",
            "With --policy, the policy names the enclave of the node.",
            "Leave one of them out.",
        )
    command = [*rest[0 if policy else 1 :], *ctx.meta[_COMMAND_KEY]]
    if not command:
        remedy = "Write `sros run KEYSTORE ENCLAVE -- COMMAND...`."
        raise UsageError("no command is given", "", remedy)
    if not (policy or rest):
        remedy = "Write `sros run KEYSTORE ENCLAVE -- COMMAND...`, or use --policy FILE."
        raise UsageError("no enclave is given", "", remedy)
    name = enclave_of_node(policy, command) if policy else rest[0]
    if (other := named_enclave(command)) and other != name:
        raise UsageError(
            f"the command names the enclave {other}, but sros would run the command in {name}",
            "ROS_SECURITY_ENCLAVE_OVERRIDE, which sros sets, overrides --enclave.",
            f"Leave `--enclave {shlex.quote(other)}` out, or name the same enclave: `sros run "
            f"{shlex.quote(str(root))} {shlex.quote(other)} -- COMMAND`.",
        )
    keystore = OpenedKeystore(root)
    secured = enclave_environment(keystore, name, domain, rmw, accept_key=accept_readable_key)
    program = shutil.which(command[0])
    if program is None:
        raise UsageError(
            f"the command '{command[0]}' is not found",
            "",
            "Name its path, or set up its environment first (ROS: `. /opt/ros/jazzy/setup.sh`).",
        )
    words = tuple(command)
    if not no_ros_args:
        command = list(with_enclave(words, name))
    if (added := " ".join(command[len(words) :])) and not policy:
        echo(
            f"added {added}, so that the ROS graph shows the enclave (--no-ros-args adds nothing)",
            err=True,
        )
    environment = {**without_own_libraries(os.environ), **secured.variables}
    pin = environment.pop(_FAST_DDS_PIN, None)
    if secured.needs_pin and pin is None:
        print_notes([Note("token.no-pin", _NO_PIN)])
    elif secured.needs_pin and pin is not None:
        environment[_FAST_DDS_PIN] = pin
    print_notes(
        [*secured.notes, *(() if policy else other_node_notes(keystore, name, words, now=now()))]
    )
    names_enclave = enclave_argument(command) == name or _is_demo(command)
    if not names_enclave:
        print_notes(secured.enclave_notes)
    sys.stdout.flush()
    sys.stderr.flush()
    for ignored in (signal.SIGPIPE, signal.SIGXFSZ):  # ignored by Python; COMMAND would inherit it
        signal.signal(ignored, signal.SIG_DFL)
    os.execve(program, command, environment)


def _is_demo(command: Sequence[str]) -> bool:
    """Return whether a command is a node of `sros demo`, which names its enclave itself."""
    return Path(command[0]).name == "sros" and list(command[1:2]) == ["demo"]


@verb("completion")
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def completion(shell: str) -> None:
    """Print the script that makes SHELL complete verbs, options, enclaves and templates.

    Example:
      $ sros completion bash > ~/.local/share/bash-completion/completions/sros
    """
    from click.shell_completion import get_completion_class

    from sros_tool.cli.program import program

    kind = get_completion_class(shell)
    if kind is None:
        raise UnavailableError(
            f"there is no completion for {shell}", "", "Choose bash, zsh or fish."
        )
    echo_lines(kind(program, {}, "sros", "_SROS_COMPLETE").source())


# ── units ─────────────────────────────────────────────────────────────────────────────────────


_NODE_USER = "ros"


class _VerbWithCommandAfterDashes(_VerbWithCommand):
    needs_no_dashes = False


@verb("units", cls=_VerbWithCommandAfterDashes)
@keystore_arguments("[KEYSTORE] [ENCLAVE...] FOLDER [-- COMMAND...]")
@several_enclaves_options
@click.option(
    "--job",
    "jobs",
    multiple=True,
    type=click.Choice([job.value for job in Job]),
    help="renew: renew enclaves that expire soon, daily. check: check the keystore "
    "daily. metrics: write the keystore's metrics every 15 minutes. fleet: write the metrics of "
    "`sros fleet status` every 15 minutes. status: run `sros fleet status` each morning, and "
    "fail if something has to be done. collect: run `sros fleet collect KEYSTORE INBOX "
    "--publish PUB` every 5 minutes. guard: watch all ROS processes of the machine "
    "(runs as root, without a timer). agent: run `sros agent` for the security folder KEYSTORE of "
    "a robot every 5 minutes.  Can be repeated.",
)
@click.option(
    "--inbox",
    type=PATH,
    metavar="INBOX",
    help="With --job collect: folder with the messages of robots.",
)
@click.option(
    "--publish",
    "publishing",
    type=PATH,
    metavar="PUB",
    help="With --job collect: folder in which to publish releases.",
)
@click.option(
    "--max-age",
    metavar="DURATION",
    help="With --job fleet and --job status: robots without a confirmation for longer than this "
    "are offline. [default: 1d for robots that fetch]",
)
@click.option(
    "--target",
    "target_dir",
    metavar="DIR",
    help="Path of the keystore on the machine where the units run. "
    f"[default: {INSTALLED} for nodes, KEYSTORE for jobs]",
)
@click.option(
    "--user",
    metavar="NAME",
    help=f"The user who runs the units. [default: {_NODE_USER}, for jobs the owner of KEYSTORE]",
)
@click.option(
    "--sros",
    "program",
    metavar="FILE",
    help="Path of sros on the machine of the units; sros then verifies each enclave before its "
    "node starts. [default: none for nodes, this program for jobs]",
)
@click.option(
    "--passphrase-file",
    "passphrase",
    metavar="FILE",
    help="With --job renew and --job collect: file with the passphrase of the CA keys, on the "
    "machine that runs the job.",
)
@_DOMAIN_OPTION
@_RMW_OPTION
@_ACCEPT_KEY_OPTION
@click.option("--force", is_flag=True, help="Replace files in FOLDER that differ.")
@dry_run_option
@json_option
@click.pass_context
def units(
    ctx: click.Context,
    arguments: tuple[str, ...],
    patterns: tuple[str, ...],
    robots: tuple[str, ...],
    jobs: tuple[str, ...],
    inbox: Path | None,
    publishing: Path | None,
    max_age: str | None,
    target_dir: str | None,
    user: str | None,
    program: str | None,
    passphrase: str | None,
    domain: str | None,
    rmw: str | None,
    accept_readable_key: bool,
    force: bool,
    dry_run: bool,
    as_json: bool,
) -> None:
    """Write systemd units to FOLDER: for nodes in ENCLAVE..., and for timers (--job).

    A node runs in its enclave or not at all, sees the keys of no other enclave, and gets no
    privilege of the system that a ROS node does not need. COMMAND is the node's program; the
    default is /etc/sros/nodes followed by the path of the enclave, such as
    /etc/sros/nodes/arm/gripper.

    Examples:
      $ sros units keystore /talker units -- /opt/robot/talker.sh
      wrote units/sros@.service
      wrote units/sros@talker.service.d/enclave.conf
      $ sudo cp -r units/* /etc/systemd/system/
      $ sudo systemctl enable --now sros@talker
      $ sros units keystore --match '/arm/*' units  # /etc/sros/nodes/arm/...
      $ sros units keystore --job renew --job check --job metrics units
      $ sros units keystore --job collect --inbox inbox --publish pub units
      $ sros units /etc/sros/keystore --job agent units  # on a robot
    """
    from sros_tool.runtime.units import (
        FLEET_STATUS_JOBS,
        SIGNING_JOBS,
        WrittenUnits,
        job_units,
        unit_changes,
        write_units,
    )
    from sros_tool.validity import parse_duration

    root, rest = split_root(arguments)
    command = tuple(ctx.meta[_COMMAND_KEY])
    several = bool(patterns or robots)
    if not rest or not (rest[1:] or several or jobs):
        raise UsageError("units takes a keystore, enclaves or --job, and a folder")
    folder = PATH.convert(rest[-1], None, None)
    if passphrase is not None and not SIGNING_JOBS.intersection(jobs):
        raise UsageError("--passphrase-file is only for --job renew and --job collect")
    if {inbox is not None, publishing is not None} != {Job.COLLECT in jobs}:
        raise UsageError(
            "--job collect needs --inbox INBOX and --publish PUB; no other job takes them"
        )
    if max_age is not None and not FLEET_STATUS_JOBS.intersection(jobs):
        raise UsageError("--max-age is only for --job fleet and --job status")
    if user is not None and Job.GUARD in jobs:
        raise UsageError(
            "--user is not for --job guard",
            "Only root can examine the processes of all users.",
            "Write the units for guard with a separate command, without --user.",
        )
    if jobs and (rest[1:] or several) and target_dir is None:
        raise UsageError(
            f"the units of nodes are for the keystore {INSTALLED}, but the units of jobs are for "
            f"'{root}'",
            "One folder of units is for one machine.",
            "Run two commands with two folders, or name the keystore with --target.",
        )
    target = None if target_dir is None else target_path(target_dir)
    files: dict[str, str] = {}
    notes: list[Note] = []
    names: Sequence[str] = ()
    keystore = OpenedKeystore(root)
    if rest[1:] or several:
        names = chosen_enclaves(keystore, rest[:-1], patterns, robots)
        place = target or Path(INSTALLED)

        def secure(enclave: str) -> EnclaveEnvironment:
            return enclave_environment(
                keystore, enclave, domain, rmw, accept_key=accept_readable_key, target=place
            )

        with progress("checking"):
            files, notes = node_units(
                keystore,
                names,
                secure,
                target=place,
                user=user or _NODE_USER,
                command=command,
                sros=program or "",
            )
    elif command:
        raise UsageError("COMMAND is for nodes, and no enclave is named")
    if passphrase:
        notes = [*notes, *passphrase_file_notes(Path(passphrase))]
    if signing := SIGNING_JOBS.intersection(jobs):
        _ = keystore.authority_files  # raises an error for an export
        notes = [*notes, *_passphrase_notes(keystore, passphrase, is_here=target is None)]
        if Job.RENEW in signing:
            notes = [*notes, *_late_renewal_notes(keystore)]
    writable, inbox_notes = _agent_inbox(root) if Job.AGENT in jobs else ([], [])
    notes = [*notes, *inbox_notes]
    for job in jobs:
        files |= job_units(
            Job(job),
            str(target or _without_dots(root)),
            user=user or _owner(root),
            sros=program or _this_program(),
            passphrase=_without_dots(Path(passphrase)) if passphrase else "",
            domain=domain_of(domain) or 0,
            writable=writable,
            inbox=_without_dots(inbox) if inbox else "",
            publishing=_without_dots(publishing) if publishing else "",
            max_age=parse_duration(max_age) if max_age is not None else None,
        )
    changes = unit_changes(folder, files, force=force)
    if not dry_run:
        write_units(folder, files, changes)
    if as_json:
        written = [FileChange(action, str(folder / path)) for path, action in changes.items()]
        print_json(WrittenUnits(root, dry_run, names, written, notes))
        return
    for path, action in changes.items():
        word = f"would {action}" if dry_run else {"create": "wrote", "replace": "replaced"}[action]
        echo(f"{word} {folder / path}")
    if not changes:
        echo(f"the units in '{folder}' are already up to date", err=True)
    print_notes(list(dict.fromkeys(notes)))


def _passphrase_notes(
    keystore: OpenedKeystore, passphrase: str | None, *, is_here: bool
) -> Iterator[Note]:
    """Yield a note if the jobs lack the passphrase of the CA keys.

    ``is_here`` says whether the units are for this machine.
    """
    from sros_tool.keystore.issuing.keyring import IN_KEYSTORE
    from sros_tool.keystore.layout import ROLES

    if passphrase and is_here:
        try:
            Path(passphrase).stat()
        except FileNotFoundError:
            text = f"'{passphrase}' does not exist: systemd does not start the jobs without it"
            yield Note("units.no-passphrase", text)
        except OSError:  # only root may look there, and starts the jobs
            pass
    elif not passphrase and any(
        IN_KEYSTORE.is_encrypted(keystore, role, keystore.template) for role in ROLES
    ):
        text = (
            "the CA keys are encrypted, so the jobs fail when they have to sign: write the units "
            "with --passphrase-file FILE"
        )
        yield Note("units.no-passphrase", text)


def _late_renewal_notes(keystore: OpenedKeystore) -> Iterator[Note]:
    """Yield a note if files expire so fast that the daily job may renew them too late."""
    from sros_tool.validity import elapsed, soon_limit

    for what, validity in _validities(keystore):
        # The job runs once a day; the timer's delay and the delivery add to this.
        if soon_limit(validity) < timedelta(days=2):
            text = (
                f"{what} are valid for {elapsed(validity)}, and count as expiring soon only "
                f"in the last {elapsed(soon_limit(validity))}: the daily job `renew` may come "
                "too late. Choose a validity of 6 days or more, or run the job more often "
                "(`systemctl edit sros-renew.timer`: [Timer], OnCalendar=hourly)"
            )
            yield Note("units.renewal-late", text)


def _validities(keystore: OpenedKeystore) -> Iterator[tuple[str, timedelta]]:
    """Yield the validities in the settings, and the shortest validity of files that need renewal.

    A CA service, or the expiry of a CA, can make a validity shorter than the settings choose.
    """
    from sros_tool.keystore.expiry import enclaves_renewed_by_name, survey

    template = keystore.template
    least = timedelta.max
    for what, validity in (
        ("certificates", template.certificate_validity),
        ("permissions", template.permissions_validity),
    ):
        if isinstance(validity, timedelta):
            least = min(least, validity)
            yield what, validity
    lifetimes, _ = survey(keystore) if keystore.names else ((), ())
    by_name = enclaves_renewed_by_name(keystore, template, keystore.names)
    validities = {
        lifetime.name: min(lifetime.certificate.lifetime(), lifetime.permissions.lifetime())
        for lifetime in lifetimes
        if lifetime.name not in by_name
    }
    shortest = min(validities.values(), default=least)
    if shortest < least:
        names = [name for name, validity in validities.items() if validity == shortest]
        yield f"files of {first_few(names, 3)}", shortest


def _agent_inbox(root: Path) -> tuple[list[str], list[Note]]:
    """Return the inbox of the agent of a security folder if it is a local folder, and notes."""
    from sros_tool.agent.settings import SETTINGS_FILE, agent_folder, read_settings

    if not os.access(agent_folder(root) / SETTINGS_FILE, os.R_OK):
        text = (
            f"sros cannot read the settings of an agent in '{root}' (`sros agent init` writes "
            "them, for the owner alone). If the agent's inbox is a folder, not a URL, write the "
            "units again as the owner once the settings exist: the unit lets the agent write only "
            "into folders that the unit names"
        )
        return [], [Note("units.no-agent", text)]
    inbox = read_settings(root, to_run=False).inbox
    return ([] if "://" in inbox else [inbox]), []


def _owner(root: Path) -> str:
    """Return the name of the owner of a keystore.  Raises `UsageError`."""
    try:
        number = root.stat().st_uid
    except FileNotFoundError:
        what = f"keystore '{root}' does not exist here, so that its owner is not known"
        raise UsageError(what, "", "Name the user of the units with --user NAME.") from None
    try:
        return pwd.getpwuid(number).pw_name
    except KeyError:
        raise UsageError(
            f"the owner of keystore '{root}', user {number}, has no name", "", "Add --user NAME."
        ) from None


def _without_dots(path: Path) -> str:
    """Return an absolute path that can be written in a unit, where ``..`` is refused."""
    absolute = path.absolute()
    # A link is followed only if a ".." may follow it.
    return str(absolute.resolve() if ".." in absolute.parts else absolute)


def _this_program() -> str:
    """Return the absolute path of the running sros program.  Raises `UsageError`."""
    path = shutil.which(sys.argv[0]) or shutil.which("sros")
    if path is None or not os.access(path, os.X_OK):
        raise UsageError("the path of the running sros program is unknown", "", "Add --sros FILE.")
    return str(Path(path).absolute())
