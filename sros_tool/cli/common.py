"""Parts shared by several verbs: options, safe output, progress, times, secrets and logs."""

from __future__ import annotations

import errno
import os
import re
import select
import signal
import stat
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import wraps
from inspect import cleandoc
from itertools import chain
from pathlib import Path
from shlex import quote
from types import FrameType
from typing import TYPE_CHECKING, Any, TypeVar, cast

import click
from click.core import ParameterSource

from sros_tool.errors import DocumentError, Note, PkiError, SrosError, UsageError
from sros_tool.terminal import (
    Colored,
    ask_secret,
    echo,
    echo_lines,
    redraw,
    visible_json,
    visible_line,
)
from sros_tool.wording import counted, first_few

if TYPE_CHECKING:
    from datetime import datetime, tzinfo

    from click.shell_completion import CompletionItem

    from sros_tool.checks.kind import Finding
    from sros_tool.dds.advisories import Advisory
    from sros_tool.dds.decision.vendors import Vendor
    from sros_tool.distributions import Distribution
    from sros_tool.enclave_environment import EnclaveEnvironment
    from sros_tool.fleet.expansion import FleetPolicy
    from sros_tool.fleet.robots import Fleet
    from sros_tool.keystore.issuing.keyring import Keyring
    from sros_tool.keystore.lifecycle.change import ChangeOptions
    from sros_tool.keystore.reader import OpenedKeystore
    from sros_tool.parallel import Tally

# ── arguments ───────────────────────────────────────────────────────────────────────────


Decorated = TypeVar("Decorated", bound=Callable[..., Any])
KEYSTORE_VARIABLE = "ROS_SECURITY_KEYSTORE"


class _NamedPath(click.Path):
    """A path type that rejects "", which mostly comes from an unset shell variable."""

    def __init__(self) -> None:
        super().__init__(path_type=Path)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the path; fail if it is empty."""
        if value == "":
            self.fail("the path is empty.", param, ctx)
        return super().convert(value, param, ctx)


PATH = _NamedPath()


def relative_path(path: Path) -> Path:
    """Return an absolute path below the working directory as a relative path."""
    folder = Path.cwd()
    below = path.is_absolute() and path.is_relative_to(folder)
    return path.relative_to(folder) if below else path


def json_option(function: Decorated) -> Decorated:
    """Add ``--json`` to a verb."""
    return click.option("--json", "as_json", is_flag=True, help="Print JSON.")(function)


def check_one_format() -> None:
    """Raise `UsageError` if the verb that runs got --json and another format, too."""
    context = click.get_current_context()
    named = context.get_parameter_source("form") is ParameterSource.COMMANDLINE
    form = context.params["form"] if named else "json"
    if context.params.get("as_sarif"):
        form = "sarif"
    if context.params["as_json"] and form != "json":
        raise UsageError(f"--json and the format {form} exclude each other", "", "Choose one.")


def refuse_git_revision(paths: Iterable[Path], remedy: str) -> None:
    """Raise `UsageError` if a path is ``git:REVISION:PATH``, which most verbs cannot read."""
    if any(str(path).startswith("git:") and not path.exists() for path in paths):
        raise UsageError(
            "git:REVISION:PATH works only with `sros diff_policy --no-new-access`", "", remedy
        )


def dry_run_option(function: Decorated) -> Decorated:
    """Add ``--dry-run`` to a verb that writes."""
    return click.option(
        "--dry-run", is_flag=True, help="Show what would change, and change nothing."
    )(function)


class _TestedVendors(click.Choice):  # type: ignore[type-arg]  # generic from click 8.2 on
    """An option type: tested DDS vendors and products, imported only when the option is used."""

    def __init__(self) -> None:
        self.case_sensitive = True

    def __getattr__(self, name: str) -> tuple[str, ...]:
        if name != "choices":
            raise AttributeError(name)
        from sros_tool.dds.decision.vendors import TESTED, WHOLE_PRODUCTS

        self.choices = (*WHOLE_PRODUCTS, *(vendor.value for vendor in TESTED))
        return self.choices


def _as_vendors(_ctx: click.Context, _option: click.Parameter, words: tuple[str, ...]) -> object:
    if not words:
        return ()
    from sros_tool.dds.decision.vendors import WHOLE_PRODUCTS, Vendor

    named = (WHOLE_PRODUCTS.get(word) or (Vendor(word),) for word in words)
    return tuple(dict.fromkeys(chain.from_iterable(named)))


def allow_refusal_option(function: Decorated) -> Decorated:
    """Add ``--allow-refusal VENDOR`` to a verb that changes what enclaves load."""
    return click.option(
        "--allow-refusal",
        multiple=True,
        type=_TestedVendors(),
        metavar="VENDOR",
        callback=_as_vendors,
        help="Make the change even if this DDS vendor (fastdds-2.6, ...; all-fastdds for all of "
        "Fast DDS) will then refuse enclaves that it accepts now.  Can be repeated.",
    )(function)


def _complete_distribution(
    _ctx: click.Context, _parameter: click.Parameter, incomplete: str
) -> list[str]:
    """Complete the supported ROS 2 distributions."""
    from sros_tool.distributions import SUPPORTED

    return [known.name for known in SUPPORTED if known.name.startswith(incomplete)]


def _as_distribution(
    _ctx: click.Context, _option: click.Parameter, name: str | None
) -> Distribution | None:
    if name is None:
        return None
    from sros_tool.distributions import find_distribution

    return find_distribution(name)


def distro_option(help_text: str, option: str = "--distro") -> Callable[[Decorated], Decorated]:
    """Add ``--distro NAME``, or a similar option, to a verb that decides as a DDS vendor does."""
    return click.option(
        option,
        metavar="NAME",
        shell_complete=_complete_distribution,
        callback=_as_distribution,
        help=help_text,
    )


def all_distros_option(help_text: str) -> Callable[[Decorated], Decorated]:
    """Add ``--all-distros`` to a verb that decides as a DDS vendor does."""
    return click.option("--all-distros", is_flag=True, help=help_text)


advisories_option = click.option(
    "--advisories",
    metavar="FILE",
    type=PATH,
    help="Also look for the DDS vulnerabilities that FILE lists, in the OSV format (JSON).",
)


def advisories_of(file: Path | None) -> tuple[Advisory, ...] | None:
    """Return the shipped advisories and the advisories in a file; None without --advisories.

    Prints a note on versions in the file that cannot be read.
    """
    if file is None:
        return None
    from sros_tool.dds.advisories import read_advisories

    advisories = read_advisories(file)
    unread = list(dict.fromkeys(text for advisory in advisories for text in advisory.unread))
    if unread:
        names = first_few(unread, 3)
        text = f"sros ignores versions in '{file}' that do not consist of three numbers: {names}"
        print_notes([Note("check.advisory-versions", text)])
    return advisories


def check_one_decider() -> None:
    """Raise `UsageError` if the verb that runs got --all-distros and another choice of vendors."""
    parameters = click.get_current_context().params
    for parameter in ("vendor", "all_vendors", "distro"):
        if parameters["all_distros"] and parameters.get(parameter):
            option = f"--{parameter.replace('_', '-')}"
            raise UsageError(f"--all-distros and {option} exclude each other", "", "Choose one.")


def robot_option(help_text: str) -> Callable[[Decorated], Decorated]:
    """Add ``--robot NAME`` to a verb that chooses enclaves of a keystore."""
    return click.option(
        "--robot",
        "robots",
        multiple=True,
        metavar="NAME",
        shell_complete=complete_robot,
        help=f"{help_text}  Can be repeated.",
    )


def fleet_option(help_text: str) -> Callable[[Decorated], Decorated]:
    """Add ``--fleet FILE`` to a verb that reads policies with placeholders."""
    return click.option("--fleet", "fleet_file", type=PATH, metavar="FILE", help=help_text)


def fleets_option(function: Decorated) -> Decorated:
    """Add ``--fleet FILE`` to a verb that reads two policies with placeholders."""
    return click.option(
        "--fleet",
        "fleet_files",
        type=PATH,
        multiple=True,
        metavar="FILE",
        help="Fleet file whose robots replace the placeholders of the policies; give the "
        "option twice if the first and the second policy are for different fleets.",
    )(function)


def fleets_of(files: Sequence[Path]) -> tuple[Fleet | None, Fleet | None]:
    """Read the files that --fleet names; return the fleet of the first and of the second policy."""
    from sros_tool.fleet.fleet_file import read_fleet

    if len(files) > 2:
        raise UsageError("there are more than two fleets", "", "Name one, or one for each policy.")
    fleets = [read_fleet(file) for file in files]
    return (fleets[0], fleets[-1]) if fleets else (None, None)


def fleet_policies(
    files: Sequence[Path], fleet_file: Path, robots: Sequence[str] = ()
) -> list[FleetPolicy]:
    """Return the policies in files, expanded for the fleet in the --fleet file.

    With ``robots``, only the enclaves of these robots are kept; each of these robots has to have
    one.
    """
    from sros_tool.fleet.expansion import FleetPolicy, check_chosen_robots
    from sros_tool.fleet.fleet_file import read_fleet
    from sros_tool.policy.document import read_policy

    fleet = read_fleet(fleet_file)
    policies = [FleetPolicy(read_policy(file, placeholders=True), fleet, robots) for file in files]
    if robots:
        check_chosen_robots(policies, fleet, robots)
    return policies


def enclave_filter_options(help_begin: str = "Only") -> Callable[[Decorated], Decorated]:
    """Add ``--match PATTERN`` and ``--robot NAME`` to a verb whose default is all enclaves.

    ``help_begin`` begins the helps of both options, before "the enclaves ...".
    """

    def add(function: Decorated) -> Decorated:
        function = robot_option(f"{help_begin} the enclaves of this robot of the fleet.")(function)
        return click.option(
            "--match",
            "patterns",
            multiple=True,
            metavar="PATTERN",
            help=f"{help_begin} enclaves that match PATTERN, for example '/arm/*'.  Can be "
            "repeated.",
        )(function)

    return add


def several_enclaves_options(function: Decorated) -> Decorated:
    """Add ``--all``, ``--match PATTERN`` and ``--robot NAME`` to a verb for several enclaves.

    ``--all`` is the pattern ``*``.
    """
    function = robot_option("All enclaves of this robot of the fleet.")(function)
    function = click.option(
        "--match",
        "patterns",
        multiple=True,
        metavar="PATTERN",
        help="Enclaves that match PATTERN, for example '/arm/*'; * also matches '/'.  Can be "
        "repeated.",
    )(function)

    @wraps(function)
    def with_all(*, all_enclaves: bool, patterns: Sequence[str], **more: Any) -> Any:
        return function(patterns=("*",) if all_enclaves else patterns, **more)

    return click.option(
        "--all", "all_enclaves", is_flag=True, help="All enclaves of the keystore."
    )(cast("Decorated", with_all))


def check_chosen(names: Sequence[str], patterns: Sequence[str], robots: Sequence[str]) -> None:
    """Raise `UsageError` if neither arguments nor `several_enclaves_options` name an enclave."""
    if not (names or patterns or robots):
        raise UsageError(
            "no enclave is named",
            "",
            "Name one or more, such as /talker, or give --match PATTERN, --robot NAME or --all.",
        )


def chosen_enclaves(
    keystore: OpenedKeystore,
    names: Sequence[str],
    patterns: Sequence[str],
    robots: Sequence[str],
) -> tuple[str, ...]:
    """Return the enclaves that the arguments and the options of `several_enclaves_options` name.

    Raises:
        UsageError: no enclave is named.
        KeystoreError: a pattern matches no enclave, or a robot has none.
    """
    check_chosen(names, patterns, robots)
    if not (patterns or robots):
        return tuple(names)  # the verb says what is wrong with a name
    from sros_tool.keystore.selection import select_enclaves

    return select_enclaves(keystore, names, patterns, robots=robots, checked=True)


def output_option(help_text: str) -> Callable[[Decorated], Decorated]:
    """Add ``-o FILE`` to a verb that writes a policy."""
    return click.option("-o", "--output", type=PATH, metavar="FILE", help=help_text)


force_option = click.option("--force", is_flag=True, help="Replace FILE if it exists.")


class Verb(click.Command):
    """A command whose help is the docstring of its function, with an example at its end.

    The example begins with ``Example``, and is shown as it is written.
    """

    def __init__(self, *arguments: Any, **more: Any) -> None:
        text, mark, example = cleandoc(more.get("help") or "").partition("\n\nExample")
        if mark:
            more |= {"help": text, "epilog": f"\b\nExample{example}"}
        super().__init__(*arguments, **more)

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Refuse an option that is given twice and takes one value: click drops all but the last.

        Nothing is refused next to ``--help``.

        Raises:
            UsageError: there is such an option.
        """
        if not ctx.resilient_parsing:  # as for completion
            _, _, given = self.make_parser(ctx).parse_args(list(args))
            asks_for_help = any(option.is_eager for option in given)
            for option, times in Counter(given).items():
                if (
                    isinstance(option, click.Option)
                    and times > 1
                    and not asks_for_help
                    and not (option.multiple or option.is_flag or option.count)
                ):
                    name = max(option.opts, key=len)
                    raise UsageError(f"{name} is given twice", "It takes one value.", "Choose one.")
        return super().parse_args(ctx, args)


def verb(name: str, cls: type[Verb] = Verb) -> Callable[[Callable[..., Any]], Verb]:
    """Return a decorator that makes a verb of a function."""
    return click.command(name, cls)


class SeveralValues(Verb):
    """A command in which ``-e A B -e C`` means A, B and C, as users of ros2/sros2 write it.

    ``several`` are the options that take several values.
    """

    several: tuple[str, ...] = ()

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Repeat the option before each of its values."""
        spread: list[str] = []
        option, values = "", 0
        for word in args:
            if word.startswith("-") and word != "-":
                option = word if word in self.several else ""
                values = 0
                spread.append(word)
                continue
            if option and values:
                spread.append(option)
            spread.append(word)
            values += 1
        return super().parse_args(ctx, spread)


def split_root(arguments: Sequence[str]) -> tuple[Path, tuple[str, ...]]:
    """Return the keystore (the first argument or from the environment) and the other arguments.

    The first argument is the keystore, unless it can only be the name of an enclave: it starts with
    "/", is not a folder, and $ROS_SECURITY_KEYSTORE is set.
    """
    first = arguments[0] if arguments else ""
    only_a_name = first.startswith("/") and not Path(first).is_dir()
    if not first or (only_a_name and os.environ.get(KEYSTORE_VARIABLE)):
        return keystore_from_environment(), tuple(arguments)
    return Path(first), tuple(arguments[1:])


def root_and_file(arguments: Sequence[str], usage: str) -> tuple[Path, Path]:
    """Return keystore and file from one or two arguments; a single argument is the file.

    Raises `UsageError` with ``usage`` if there are other arguments.
    """
    root, rest = (
        split_root(arguments) if len(arguments) > 1 else (keystore_from_environment(), arguments)
    )
    if len(rest) != 1:
        raise UsageError(usage)
    return root, PATH.convert(rest[0], None, None)


def keystore_from_environment() -> Path:
    """Return the keystore that $ROS_SECURITY_KEYSTORE names.  Raises `UsageError`."""
    root = os.environ.get(KEYSTORE_VARIABLE)
    if not root:
        raise UsageError(
            "no keystore is named",
            f"The command has no keystore argument, and {KEYSTORE_VARIABLE} is not set.",
            f"Name the keystore's folder, or set {KEYSTORE_VARIABLE}.",
        )
    return Path(root)


def keystore_argument(
    name: str = "root", metavar: str = "[KEYSTORE]"
) -> Callable[[Decorated], Decorated]:
    """Add a keystore as argument to a verb; the default is the keystore of the environment."""

    def or_environment(
        context: click.Context, _argument: click.Parameter, path: Path | None
    ) -> Path | None:
        return path if path or context.resilient_parsing else keystore_from_environment()

    return click.argument(name, metavar=metavar, type=PATH, required=False, callback=or_environment)


def complete_keystore_and_enclave(
    ctx: click.Context, _parameter: click.Parameter, incomplete: str
) -> list[CompletionItem | str]:
    """Complete folders first, then the enclaves of the given keystore."""
    from click.shell_completion import CompletionItem

    from sros_tool.keystore.layout import is_keystore, search_enclaves

    path = ctx.params.get("path")
    given = ctx.params.get("arguments") or ((path,) if path else ())
    root = Path(given[0]) if given else Path(os.environ.get(KEYSTORE_VARIABLE, ""))
    if given or (os.environ.get(KEYSTORE_VARIABLE) and incomplete.startswith("/")):
        names = search_enclaves(root)[0] if is_keystore(root) else ()
        return [*completions(names, incomplete)]
    return [CompletionItem(incomplete, type="dir")]


def keystore_arguments(metavar: str, **more: Any) -> Callable[[Decorated], Decorated]:
    """Add a keystore and enclaves as arguments to a verb, for `split_root`."""
    return click.argument(
        "arguments",
        metavar=metavar,
        nargs=-1,
        **{"required": True, "shell_complete": complete_keystore_and_enclave, **more},
    )


def completions(names: Iterable[str], incomplete: str) -> list[str]:
    """Return the names that start with ``incomplete`` and that a shell need not quote.

    Bash inserts a completion unquoted, so it would run a command that the name of a folder or topic
    contains, such as ``$(...)``.
    """
    return [name for name in names if name.startswith(incomplete) and quote(name) == name]


def complete_robot(ctx: click.Context, _parameter: click.Parameter, incomplete: str) -> list[str]:
    """Complete the robots of the given keystore's fleet."""
    from sros_tool.keystore.fleet import load_fleet
    from sros_tool.keystore.reader import OpenedKeystore

    words = ctx.params.get("arguments") or ctx.params.get("sources")
    words = words or (ctx.params.get("root") or ctx.params.get("folder"),)
    keystore = words[0] or os.environ.get(KEYSTORE_VARIABLE)
    fleet = None
    with suppress(SrosError):
        fleet = load_fleet(OpenedKeystore(Path(keystore))) if keystore else None
    return completions(fleet.robots if fleet else (), incomplete)


def complete_file(
    _ctx: click.Context, _parameter: click.Parameter, incomplete: str
) -> list[CompletionItem | str]:
    """Complete files and folders, as the shell does."""
    from click.shell_completion import CompletionItem

    return [CompletionItem(incomplete, type="file")]


def complete_template(
    _ctx: click.Context, _parameter: click.Parameter, incomplete: str
) -> list[str]:
    """Complete the names of templates."""
    from sros_tool.keystore.template import template_names

    return completions(template_names(), incomplete)


# ── output ──────────────────────────────────────────────────────────────────────────────


def json_text(value: object) -> str:
    """Return a value as the text of a JSON document."""
    import json

    return visible_json(json.dumps(value, indent=2, ensure_ascii=False))


def print_json(value: object) -> None:
    """Print ``value`` as a verb's ``--json`` output on stdout; its type defines the keys."""
    from sros_tool.values import versioned

    echo_lines(json_text(versioned(value)))


def print_notes(notes: Sequence[Note]) -> None:
    """Print notes on stderr."""
    for note in notes:
        echo(f"note [{note.id}]: {note.text}", err=True)


def check_output(output: Path, *, force: bool) -> None:
    """Check that ``output`` can be written.

    Devices and pipes need no ``force``, because writing does not replace them.

    Raises:
        UsageError: ``output`` is ``-`` or a folder, its folder is missing, or it exists without
            ``force``.
    """
    if str(output) == "-":
        raise UsageError("'-' is not a file name here", "", "Name a file.")
    if not output.absolute().parent.is_dir():
        raise UsageError(
            f"cannot write '{output}'", "Its folder does not exist.", "Create the folder first."
        )
    if output.is_dir():
        raise UsageError(f"cannot write '{output}'", "It is a folder.", "Name a file.")
    if output.is_file() and not force:
        raise UsageError(f"'{output}' already exists", "", "Name another file, or add --force.")


_METRICS_SUFFIX = ".prom"
"""The only suffix of files that the textfile collector of node_exporter reads."""


def check_metrics_file(output: Path) -> None:
    """Raise `UsageError` for a file that node_exporter would not read."""
    if output.suffix != _METRICS_SUFFIX and (output.is_file() or not output.exists()):
        raise UsageError(
            f"'{output}' does not end in {_METRICS_SUFFIX}",
            "node_exporter would not read it.",
            f"Name it for example '{output.with_suffix(_METRICS_SUFFIX)}'.",
        )


def save(output: Path, document: bytes) -> str:
    """Write a document atomically; return a message for the user."""
    from sros_tool.files import replace_file

    verb = "replaced" if output.exists() else "wrote"
    replace_file(output, document)
    return f"{verb} '{output}'"


# ── moments, zones and domains ──────────────────────────────────────────────────────────


def now() -> datetime:
    """Return the current time in UTC; verbs pass it to the functions that they call."""
    return _clock()


def _clock() -> datetime:
    from datetime import UTC, datetime

    return datetime.now(UTC)


_ALLOWED_YEARS = 1970, 2999


def moment_of(text: str | None) -> datetime:
    """Return the moment that ``--at`` names: a date, or a duration from now; now by default.

    Raises:
        UsageError: ``text`` is neither a date nor a duration, or the year of the date is out of
        range.
    """
    from sros_tool.validity import parse_duration, parse_iso

    if text is None:
        return now()
    try:
        moment = parse_iso(text)
        if _ALLOWED_YEARS[0] <= moment.year <= _ALLOWED_YEARS[1]:
            return moment
    except ValueError:
        with suppress(UsageError):
            return now() + parse_duration(text)
    raise UsageError(
        f"--at {text!r} is not a date",
        f"It is neither a duration nor a date from {_ALLOWED_YEARS[0]} to {_ALLOWED_YEARS[1]}.",
        "Write 2027-06-01, 2027-06-01T12:00:00Z, or 90d for 90 days from now.",
    )


_UTC_OFFSET = re.compile(r"([+-])(\d\d):?(\d\d)\Z")
_LOCALTIME = Path("/etc/localtime")


def named_zone(name: str) -> tzinfo:
    """Return the time zone with an IANA name (``Asia/Tokyo``) or offset (``+09:00``).

    Raises `UsageError`.
    """
    from datetime import timedelta, timezone
    from zoneinfo import ZoneInfo

    if match := _UTC_OFFSET.match(name):
        offset = timedelta(hours=int(match[2]), minutes=int(match[3]))
        if offset < timedelta(hours=24):
            return timezone(-offset if match[1] == "-" else offset)
    try:
        return ZoneInfo(name)
    except (ValueError, OSError, LookupError) as error:
        raise UsageError(
            f"{name!r} is not a time zone", "", "Write for example Asia/Tokyo, UTC or +09:00."
        ) from error


def local_zone(environment: Mapping[str, str]) -> tzinfo:
    """Return the time zone of $TZ or /etc/localtime, or the current UTC offset as a fixed zone."""
    from datetime import UTC, datetime

    name = environment.get("TZ", "").removeprefix(":")
    if not name and _LOCALTIME.exists():
        _, marker, name = str(_LOCALTIME.resolve()).partition("zoneinfo/")
        name = name if marker else ""
    if name in ("UTC", "Etc/UTC"):  # most robots: no time zone data is read
        return UTC
    if name:
        from zoneinfo import ZoneInfo

        with suppress(ValueError, OSError, LookupError):
            return ZoneInfo(name)
    return datetime.now().astimezone().tzinfo or UTC


def enclave_environment(
    keystore: OpenedKeystore,
    name: str,
    domain: str | None = None,
    rmw: str | None = None,
    *,
    accept_key: bool | None = None,
    target: Path | None = None,
) -> EnclaveEnvironment:
    """Return the environment of an enclave, after checking that a process can start in it now.

    The arguments are those of `loadable_environment`.
    """
    from sros_tool.enclave_environment import loadable_environment

    return loadable_environment(
        keystore,
        name,
        domain,
        rmw,
        environment=os.environ,
        now=now(),
        zone=local_zone(os.environ),
        accept_key=accept_key,
        target=target,
    )


def ros_domain() -> int | None:
    """Return the domain ID in $ROS_DOMAIN_ID, or None if it is not set."""
    from sros_tool.runtime.variables import domain_from

    return domain_from(os.environ)


def domain_of(text: str | None) -> int | None:
    """Return the domain ID in ``text``, the value of --domain; None for None.

    Raises `UsageError`.
    """
    if text is None:
        return None
    if text == "":
        raise UsageError("--domain is empty", "", "Name a domain, or leave the option out.")
    from sros_tool.runtime.variables import DOMAIN, domain_from

    return domain_from({DOMAIN: text})


# ── secrets ─────────────────────────────────────────────────────────────────────────────


_PASSPHRASE, _PASSPHRASE_FILE = "SROS_CA_PASSPHRASE", "SROS_CA_PASSPHRASE_FILE"
_PIN_VARIABLE = "SROS_PKCS11_PIN"
_taken: dict[str, str] = {}
_printed_notes: set[Note] = set()
"""Notes on secrets that were printed already."""
_KEY_PLACE_VARIABLES = {"identity": "SROS_IDENTITY_KEY", "permissions": "SROS_PERMISSIONS_KEY"}


@contextmanager
def without_secrets() -> Iterator[None]:
    """Remove secrets from this process's environment, so that child processes do not get them.

    Commands that replace this process, as with ``sros run``, do not get them either.
    """
    for name in (_PASSPHRASE, _PASSPHRASE_FILE, _PIN_VARIABLE):
        if name in os.environ:
            _taken[name] = os.environ.pop(name)
    try:
        yield
    finally:
        os.environ.update(_taken)
        _taken.clear()
        _printed_notes.clear()


def removed_secrets() -> tuple[str, ...]:
    """Return the values of the secrets that were removed from the environment, for redaction."""
    return tuple(_taken.values())


key_option = click.option(
    "--key",
    metavar="URI",
    default="",
    help="URI of the private key on a PKCS#11 token, pkcs11:token=NAME;object=LABEL; the "
    "key is created if missing. Only Fast DDS can use it.",
)


def keyring(
    identity: str | None = None, permissions: str | None = None, *, encrypt: bool = False
) -> Keyring:
    """Return a keyring for the CA keys at these URIs.

    The defaults are $SROS_IDENTITY_KEY and $SROS_PERMISSIONS_KEY. ``encrypt`` protects new keys
    with a passphrase, which may be short with $SROS_SHORT_PASSPHRASE.
    """
    from sros_tool.keystore.issuing.keyring import Keyring, absolute_place

    named = {"identity": identity, "permissions": permissions}
    places = {
        role: named[role] or os.environ.get(name, "") for role, name in _KEY_PLACE_VARIABLES.items()
    }
    return Keyring(
        _Secrets(encrypt),
        {role: absolute_place(place) for role, place in places.items() if place},
        encrypt,
        bool(os.environ.get("SROS_SHORT_PASSPHRASE")),
    )


def change_options(*, dry_run: bool, allow_refusal: Sequence[Vendor] = ()) -> ChangeOptions:
    """Return the options for changing a keystore now with the user's CA keys."""
    return {
        "now": now(),
        "keyring": keyring(),
        "allow_refusal": allow_refusal,
        "dry_run": dry_run,
    }


def try_passphrase(root: Path, keyring: Keyring) -> None:
    """Check that the CA keys of a keystore can be opened, though nothing is to be signed now.

    So a timer with a wrong passphrase, or without one, fails today, and not when files are about
    to expire. Without a passphrase, keys may be missing, because they are elsewhere on purpose.
    Nothing is checked if the user would have to be asked for a passphrase.

    Raises:
        SrosError: a key cannot be opened.
    """
    from sros_tool.keystore.reader import OpenedKeystore

    is_given = any(map(_taken.get, (_PASSPHRASE, _PASSPHRASE_FILE)))
    if is_given or not sys.stdin.isatty():
        keystore = OpenedKeystore(root)
        keyring.try_files(keystore, keystore.template, missing_ok=not is_given)


def secrets() -> Callable[[str], str]:
    """Return a secrets handler that takes the PINs of tokens from the environment or a prompt."""
    return _Secrets(new=False)


class _Secrets:
    """A secrets handler: takes a passphrase or PIN from the environment, a file, or one prompt.

    ``new`` says that passphrases are for new keys: the prompt then asks for each of them twice.
    """

    def __init__(self, new: bool) -> None:
        self._new = new
        self._known: dict[str, str] = {}
        self._lines: dict[str, str] = {}

    def __call__(self, name: str) -> str:
        if name not in self._known:
            self._known[name] = self._find(name)
        return self._known[name]

    def _find(self, name: str) -> str:
        """Return the secret ``name``, which is a passphrase or a PIN in words for a prompt.

        Raises:
            PkiError: the secret is set nowhere, and there is no terminal to prompt on.
        """
        is_pin = " PIN " in f" {name} "
        value = _taken.get(_PIN_VARIABLE if is_pin else _PASSPHRASE, "")
        file = "" if is_pin else _taken.get(_PASSPHRASE_FILE, "")
        if not value and file:
            if file not in self._lines:  # a pipe can be read once, and two CA keys may need it
                with without_progress():
                    print_notes(_new_notes(passphrase_file_notes(Path(file))))
                self._lines[file] = _first_line(Path(file))
            value = self._lines[file]
        if not value and sys.stdin.isatty():
            confirm = self._new and not is_pin
            with without_progress():
                value = ask_secret(name, confirm=confirm)
        if not value:
            names = _PIN_VARIABLE if is_pin else f"{_PASSPHRASE} or {_PASSPHRASE_FILE}"
            unit = "" if is_pin else "; for units, use `sros units --passphrase-file`"
            raise PkiError(
                f"{name} is needed", "There is no terminal to prompt on.", f"Set {names}{unit}."
            )
        try:
            value.encode()
        except UnicodeEncodeError:
            raise PkiError(f"{name} is not UTF-8 text", "", "Choose another one.") from None
        return value


def passphrase_file_notes(path: Path) -> Iterator[Note]:
    """Yield a note if others can read a passphrase file on this machine."""
    with suppress(OSError):  # reading the file reports the error
        mode = path.stat().st_mode
        if stat.S_ISREG(mode) and mode & 0o077:
            text = (
                f"others can access the passphrase file '{path}' (mode {stat.S_IMODE(mode):04o}): "
                f"run `chmod 600 {quote(str(path))}`. If anybody may have read it, replace the CAs "
                "(`sros rotate_ca`)."
            )
            yield Note("keystore.passphrase-readable", text)


def _new_notes(notes: Iterable[Note]) -> list[Note]:
    new = [note for note in notes if note not in _printed_notes]
    _printed_notes.update(new)
    return new


def _first_line(path: Path) -> str:
    """Return the first line of a passphrase file, or of a pipe such as ``<(pass show ca)``.

    Raises:
        PkiError: the file cannot be read, or its first line is too long.
    """
    from sros_tool.pki.keys import LONGEST_PASSPHRASE

    try:
        line = re.split(rb"[\r\n]", _read_at_most(path, LONGEST_PASSPHRASE + 1))[0]
    except OSError as error:
        raise PkiError(
            f"the passphrase file '{path}' cannot be read",
            f"{error.strerror or error}.",
            f"Name another file in {_PASSPHRASE_FILE}, or set {_PASSPHRASE}.",
        ) from error
    if len(line) > LONGEST_PASSPHRASE:
        raise PkiError(
            f"the passphrase file '{path}' cannot be used",
            f"Its first line is longer than {LONGEST_PASSPHRASE} bytes.",
            f"Write the passphrase alone into the first line, or set {_PASSPHRASE}.",
        )
    return line.decode("utf-8", "surrogateescape")


# ── files and pipes that the user names ─────────────────────────────────────────────────────


def read_file_or_stdin(path: Path, kind: str, *, max_bytes: int = 16 * 1024 * 1024) -> bytes:
    """Return the bytes of a file, or of standard input for "-"; errors call the file ``kind``.

    At most one byte more than ``max_bytes`` (16 MiB) is read from standard input.

    Raises:
        DocumentError: the file cannot be read, is too large or is not a regular file, or standard
            input is empty.
    """
    from sros_tool.xml import read_bytes

    if path != Path("-"):
        return read_bytes(path, kind, max_bytes=max_bytes)
    data = sys.stdin.buffer.read(max_bytes + 1) if sys.stdin else b""
    if not data:
        raise DocumentError(
            f"the {kind} is empty",
            "Standard input had no data.",
            "Check the command that writes to the pipe.",
        )
    return data


_WRITER_TIMEOUT = 5.0
"""Seconds to wait for a pipe's writer, which may have been started at the same time."""


def _read_at_most(path: Path, count: int) -> bytes:
    """Return the first ``count`` bytes of a file, or of a pipe that somebody writes to.

    Opening a pipe as usual would wait for a writer forever.

    Raises:
        OSError: the file cannot be read, or is a pipe that nobody writes to.
    """
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        is_pipe = stat.S_ISFIFO(os.fstat(handle).st_mode)
        data = bytearray(_first_byte_of_pipe(handle, path) if is_pipe else b"")
        poll = select.poll()
        poll.register(handle, select.POLLIN)
        while len(data) < count:
            poll.poll(_POLL_MILLISECONDS)
            with suppress(BlockingIOError):
                part = os.read(handle, min(count - len(data), _CHUNK_BYTES))
                if not part:
                    break
                data += part
        return bytes(data)
    except OSError as error:
        error.filename = str(path)  # instead of the descriptor's number
        raise
    finally:
        os.close(handle)


_POLL_MILLISECONDS = 100
"""Milliseconds after which a signal that came just before a wait is noticed."""
_CHUNK_BYTES = 1024 * 1024
"""Number of bytes that are read at a time."""


def _first_byte_of_pipe(handle: int, path: Path) -> bytes:
    """Wait for a writer of a pipe; return the first byte, or b"" if the writer wrote nothing.

    Raises:
        OSError: nobody opens the pipe for writing.
    """
    poll = select.poll()
    poll.register(handle, select.POLLIN)
    deadline = time.monotonic() + _WRITER_TIMEOUT
    while time.monotonic() < deadline:
        with suppress(BlockingIOError):
            if begin := os.read(handle, 1):
                return begin
            if [(handle, select.POLLHUP)] != poll.poll(50):
                continue  # no writer yet, or one that has just come
        return b""
    raise OSError(errno.ENXIO, "it is a pipe that nobody writes to", str(path))


# ── logs ────────────────────────────────────────────────────────────────────────────────


MAX_LOG = 64 * 1024 * 1024
"""Largest log that is read, in bytes."""


def read_log(log: str) -> str:
    """Return the text of a log file, of a pipe (``<(journalctl ...)``), or of stdin for "-".

    Raises:
        DocumentError: the log cannot be read, is a device, is a pipe that nobody writes to, or is
            larger than ``MAX_LOG``.
    """
    try:
        if log == "-":
            data = sys.stdin.buffer.read(MAX_LOG + 1) if sys.stdin else b""
        else:
            kind = Path(log).stat().st_mode
            if not (stat.S_ISREG(kind) or stat.S_ISFIFO(kind) or stat.S_ISDIR(kind)):
                raise DocumentError(f"the log '{log}' is neither a file nor a pipe")
            data = _read_at_most(Path(log), MAX_LOG + 1)
    except FileNotFoundError as error:
        raise DocumentError(f"the log '{log}' does not exist") from error
    except OSError as error:
        why = f"{error.strerror or error}."
        raise DocumentError(f"the log '{log}' cannot be read", why) from error
    except ValueError as error:  # a path with a NUL byte
        raise DocumentError(f"the log '{log}' does not exist") from error
    if len(data) > MAX_LOG:
        raise DocumentError(
            f"the log '{log}' is too large",
            f"It has more than {MAX_LOG // 1024**2} MiB.",
            "Shorten it first, for example: tail -n 100000 LOG.",
        )
    return data.decode("utf-8", "replace")


# ── findings ──────────────────────────────────────────────────────────────────────────────────


def echo_findings(findings: Sequence[Finding], *, err: bool = False) -> None:
    """Print one finding, or findings of one cause; the severity is in color on a terminal."""
    first = findings[0]
    if first.cause and len(findings) > 1:
        place = first.cause.place or first.place
        ids = ", ".join(dict.fromkeys(finding.id for finding in findings))
        lines = [f"{place}: {first.severity.word}: {first.cause.title}"]
        for text in (f"[{ids}]", first.cause.text, first.cause.remedy):
            lines += _wrapped_lines(text, "    ")
    else:
        lines = finding_lines(first)
    word = first.severity.word
    place, _, title = lines[0].partition(f": {word}: ")
    echo(f"{place}: ", Colored(word), f": {title}", err=err)
    for line in lines[1:]:
        echo(line, err=err)


def echo_folded(groups: Iterable[tuple[Finding, ...]], fleet: Fleet | None = None) -> None:
    """Print findings; those that differ only in one robot or one enclave are printed once."""
    from sros_tool.checks.formats import folded_findings

    for group, others in folded_findings(groups, fleet):
        echo_findings(group)
        if others:
            echo(f"    {others}")


def finding_lines(finding: Finding) -> list[str]:
    """Return a finding as lines: place and title, reason, remedy, and related places."""
    head = f"{finding.place}: {finding.severity.word}: {finding.kind.title} [{finding.id}]"
    subject = "" if finding.subject in (finding.file, finding.place) else f"{finding.subject}: "
    by = f" (accepted by the {finding.accepted})" if finding.accepted else ""
    related = [f"      {place}: {place.text}" for place in finding.related]
    return [head, f"    {subject}{finding.text}{by}", *related, f"    {finding.remedy}"]


def _wrapped_lines(text: str, indent: str) -> list[str]:
    """Return lines of at most 80 characters; text to copy stays on one line, however long."""
    from textwrap import wrap

    unbreakable = re.sub(
        r"`[^`]+`|<\w[^>]*/>", lambda m: m[0].replace(" ", "\0"), visible_line(text)
    )
    lines = wrap(
        unbreakable,
        80,
        initial_indent=indent,
        subsequent_indent=indent,
        break_long_words=False,
        break_on_hyphens=False,
    )
    return [line.replace("\0", " ") for line in lines]


def print_findings_after_signing(groups: Sequence[Sequence[Finding]], files: Iterable[str]) -> None:
    """Print on stderr the findings about policies whose permissions were just signed.

    ``files`` are the files of the policies, for a command that shows all findings.
    """
    from sros_tool.checks.kind import Severity

    for group in groups[:_MOST_SHOWN]:
        echo_findings(group, err=True)
    hidden = Counter(finding.severity for group in groups[_MOST_SHOWN:] for finding in group)
    hidden_counts = [
        counted(hidden[severity], severity.word)
        for severity in sorted(Severity, reverse=True)
        if hidden[severity]
    ]
    if hidden_counts:
        command = f"sros check {' '.join(map(quote, dict.fromkeys(files)))}"
        echo(f"and {', '.join(hidden_counts)}: see `{command}`", err=True)


_MOST_SHOWN = 3


# ── progress, on a terminal only: one line, which is erased when the work is done ───────────────


_FIRST, _EVERY = 1.0, 0.5  # seconds
_ESTIMATE_AFTER = 3.0
"""Seconds of work after which the remaining time is shown, too."""


class _ProgressLine:
    """A progress line on the terminal that a timer redraws.

    The timer is a signal: unlike a thread, it does not disturb the processes that are forked for
    the work, and forked processes do not inherit the timer.
    """

    def __init__(self, label: str, total: int, tally: Tally) -> None:
        self._label, self._total, self._tally = label, total, tally
        self._done = 0
        self._drawn = False
        self._began = time.monotonic()
        self._before = signal.signal(signal.SIGALRM, self._draw)
        signal.setitimer(signal.ITIMER_REAL, _FIRST, _EVERY)

    def step(self, _name: str) -> None:
        """Count an item as done."""
        self._done += 1

    def pause(self) -> None:
        """Erase the line and draw no more."""
        signal.setitimer(signal.ITIMER_REAL, 0)
        if self._drawn:
            redraw("")

    def go_on(self) -> None:
        """Draw the line again after a pause."""
        signal.setitimer(signal.ITIMER_REAL, _FIRST, _EVERY)

    def end(self) -> None:
        """Erase the line for good."""
        self.pause()
        signal.signal(signal.SIGALRM, self._before)

    def _draw(self, _number: int, _frame: FrameType | None) -> None:
        done, total, left = self._done, self._total, None
        if self._tally.total:
            done, total, left = (
                self._tally.done(),
                self._tally.total,
                self._tally.remaining_seconds(),
            )
        count = f" {done} of {total}" if total and done else ""
        seconds = time.monotonic() - self._began
        time_left = (
            ""
            if left is None or seconds < _ESTIMATE_AFTER
            else f", about {_duration_text(left)} left"
        )
        redraw(f"{self._label}{count} ... {seconds:.0f} s{time_left}")
        self._drawn = True


def _duration_text(seconds: float) -> str:
    """Return a duration as text, in minutes if it is two minutes or longer."""
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"


_lines: list[_ProgressLine] = []


@contextmanager
def progress(label: str, total: int = 0) -> Iterator[Callable[[str], None] | None]:
    """Show ``label`` and the elapsed seconds on the terminal while the body runs.

    Args:
        label: what is done, such as "signing".
        total: number of items, if the body counts them with the yielded function.

    Yields None if nothing is shown because standard error is not a terminal.
    """
    on_terminal = sys.stderr is not None and sys.stderr.isatty()
    if not on_terminal or _lines or threading.current_thread() is not threading.main_thread():
        yield None
        return
    from sros_tool.parallel import tallied

    with tallied() as tally:
        line = _ProgressLine(label, total, tally)
        _lines.append(line)
        try:
            yield line.step
        finally:
            _lines.pop()
            line.end()


@contextmanager
def without_progress() -> Iterator[None]:
    """Keep the terminal free for a question, such as for a passphrase."""
    for line in _lines:
        line.pause()
    try:
        yield
    finally:
        for line in _lines:
            line.go_on()
