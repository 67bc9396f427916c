"""Makes text of others safe to show: what would steer a terminal is shown, and not obeyed."""

from __future__ import annotations

import json
import os
import re
import stat
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime, timedelta, timezone, tzinfo
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar
from zoneinfo import ZoneInfo

import click

from sros_tool.errors import DocumentError, PkiError, UsageError

_CONTROLS = [
    *(code for code in range(0x20) if chr(code) not in "\n\t"),
    *range(0x7F, 0xA0),  # DEL, and C1, which holds CSI as one character
    *(0x061C, 0x200E, 0x200F, *range(0x202A, 0x202F), *range(0x2066, 0x206A)),  # bidirectional
]
_SHOWN = {code: f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}" for code in _CONTROLS}
_IN_JSON = {code: f"\\u{code:04x}" for code in _CONTROLS}


def visible(text: str) -> str:
    """``text`` with its control characters, but newline and tab, spelled as escapes.

    Names of files, certificates and logs are chosen by others, who could otherwise clear the
    screen, hide a denial, or let a name read backwards.
    """
    return text.translate(_SHOWN)


def visible_json(document: str) -> str:
    """The same for a JSON document, which goes on to mean the same."""
    return document.translate(_IN_JSON)


if TYPE_CHECKING:
    from click.shell_completion import CompletionItem

    from sros_tool.errors import Note
    from sros_tool.keystore.transaction.stage import Change

Decorated = TypeVar("Decorated", bound=Callable[..., Any])

KEYSTORE_VARIABLE = "ROS_SECURITY_KEYSTORE"


class NamedPath(click.Path):
    """A path that has to be named: "" is an unset variable of a script, and not this folder."""

    def __init__(self) -> None:
        super().__init__(path_type=Path)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The path; refuses the empty one."""
        if value == "":
            self.fail("the path is empty.", param, ctx)
        return super().convert(value, param, ctx)


PATH = NamedPath()


def now() -> datetime:
    """The present moment: the only place where the command line asks the clock."""
    return datetime.now(UTC)


_YEARS = 1970, 2999


def moment_of(text: str | None) -> datetime:
    """The moment that ``--at`` names: a date, or a duration from now; the present one by default.

    Raises `UsageError`.
    """
    from sros_tool.validity import parse_duration, parse_iso

    if text is None:
        return now()
    try:
        moment = parse_iso(text)
        if _YEARS[0] <= moment.year <= _YEARS[1]:
            return moment
    except ValueError:
        with suppress(UsageError):
            return now() + parse_duration(text)
    raise UsageError(
        f"--at {text!r} is no moment",
        f"It is neither a date of {_YEARS[0]} to {_YEARS[1]} nor a duration.",
        "Write 2027-06-01, 2027-06-01T12:00:00Z, or 90d from now.",
    )


def domain_of(text: str | None) -> int | None:
    """The domain that ``--domain`` names, or None without the option.  Raises `UsageError`."""
    from sros_tool.runtime.environment import DOMAIN, domain_from

    if text == "":
        raise UsageError("--domain is empty", "", "Name a domain, or leave the option out.")
    return None if text is None else domain_from({DOMAIN: text})


def json_option(function: Decorated) -> Decorated:
    """``--json`` for a verb that reads."""
    return click.option("--json", "as_json", is_flag=True, help="Print JSON.")(function)


def dry_run_option(function: Decorated) -> Decorated:
    """``--dry-run`` for a verb that writes."""
    return click.option(
        "--dry-run", is_flag=True, help="Say what would change, and change nothing."
    )(function)


def print_json(value: object) -> None:
    """Print a value as JSON, on stdout."""
    click.echo(visible_json(json.dumps(value, indent=2, ensure_ascii=False)))


def print_notes(notes: Sequence[Note]) -> None:
    """Print remarks, on stderr."""
    for note in notes:
        click.echo(visible(f"note [{note.id}]: {note.text}"), err=True)


def print_plan(root: Path, changes: Sequence[Change]) -> None:
    """Print what a dry run would have changed."""
    for change in changes:
        click.echo(f"would {change.action} {root / change.path}")
    if not changes:
        click.echo("nothing would change")


def keystore_from_environment() -> Path:
    """The keystore that $ROS_SECURITY_KEYSTORE names."""
    root = os.environ.get(KEYSTORE_VARIABLE)
    if not root:
        raise UsageError(
            "no keystore is named",
            f"Neither is one given, nor is {KEYSTORE_VARIABLE} set.",
            "Name the folder of the keystore.",
        )
    return Path(root)


def ros_domain() -> int | None:
    """The domain of $ROS_DOMAIN_ID, or None where it is not set."""
    from sros_tool.runtime.environment import domain_from

    return domain_from(os.environ)


def split_root(words: Sequence[str]) -> tuple[Path, tuple[str, ...]]:
    """Take the keystore from the front of the arguments, or else from the environment.

    The first word is the keystore, unless it can only be the name of an enclave: it starts with
    "/", is no folder, and $ROS_SECURITY_KEYSTORE is set.
    """
    first = words[0] if words else ""
    only_a_name = first.startswith("/") and not Path(first).is_dir()
    if not first or (only_a_name and os.environ.get(KEYSTORE_VARIABLE)):
        return keystore_from_environment(), tuple(words)
    return Path(first), tuple(words[1:])


class SeveralValues(click.Command):
    """Lets ``-e A B -e C`` mean A, B and C, as ros2/sros2 users write it; every value counts.

    ``several`` are the options that take values so.
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


def complete_keystore_and_enclave(
    ctx: click.Context, _parameter: click.Parameter, incomplete: str
) -> list[CompletionItem | str]:
    """Completes folders first, then the enclaves of the keystore that was given."""
    from click.shell_completion import CompletionItem

    from sros_tool.keystore.layout import enclave_names, is_keystore

    given = ctx.params.get("words") or ()
    root = Path(given[0]) if given else Path(os.environ.get(KEYSTORE_VARIABLE, ""))
    if given or (os.environ.get(KEYSTORE_VARIABLE) and incomplete.startswith("/")):
        names = enclave_names(root) if is_keystore(root) else ()
        return [name for name in names if name.startswith(incomplete)]
    return [CompletionItem(incomplete, type="dir")]


def complete_template(
    _ctx: click.Context, _parameter: click.Parameter, incomplete: str
) -> list[str]:
    """Completes the names of templates."""
    from sros_tool.keystore.template import template_names

    return [name for name in template_names() if name.startswith(incomplete)]


@contextmanager
def progress_bar(total: int) -> Iterator[Callable[[str], None] | None]:
    """A progress bar on a terminal, where there is enough to wait for."""
    if total < 50 or not sys.stderr.isatty():
        yield None
        return
    with click.progressbar(length=total, label="signing", file=sys.stderr) as bar:
        yield lambda _name: bar.update(1)


if TYPE_CHECKING:
    from sros_tool.keystore.authorities.keyring import Keyring

PASSPHRASE, PASSPHRASE_FILE = "SROS_CA_PASSPHRASE", "SROS_CA_PASSPHRASE_FILE"
PIN = "SROS_PKCS11_PIN"
PLACES = {"identity": "SROS_IDENTITY_KEY", "permissions": "SROS_PERMISSIONS_KEY"}


def keyring(
    identity: str | None = None, permissions: str | None = None, *, encrypt: bool = False
) -> Keyring:
    """The keys at the places that are given, or that the environment names."""
    from sros_tool.keystore.authorities.keyring import Keyring

    given = {"identity": identity, "permissions": permissions}
    places = {role: given[role] or os.environ.get(name, "") for role, name in PLACES.items()}
    return Keyring(
        _Answers(encrypt),
        {role: _absolute(place) for role, place in places.items() if place},
        encrypt,
    )


def _absolute(place: str) -> str:
    if place.startswith("pkcs11:"):
        return place
    return f"file:{Path(place.removeprefix('file:')).absolute()}"


class _Answers:
    """A secrets handler that asks each question once."""

    def __init__(self, new: bool) -> None:
        self._new = new
        self._known: dict[str, str] = {}

    def __call__(self, what: str) -> str:
        if what not in self._known:
            self._known[what] = self._find(what)
        return self._known[what]

    def _find(self, what: str) -> str:
        is_pin = " PIN " in f" {what} "
        value = os.environ.get(PIN if is_pin else PASSPHRASE, "")
        file = "" if is_pin else os.environ.get(PASSPHRASE_FILE, "")
        if not value and file:
            value = Path(file).read_text(encoding="utf-8").partition("\n")[0]
        if not value and sys.stdin.isatty():
            confirm = self._new and not is_pin
            value = click.prompt(
                what.capitalize(), hide_input=True, err=True, confirmation_prompt=confirm
            )
        if not value:
            names = PIN if is_pin else f"{PASSPHRASE} or {PASSPHRASE_FILE}"
            raise PkiError(f"{what} is needed", "There is no terminal to ask at.", f"Set {names}.")
        return value


_OFFSET = re.compile(r"([+-])(\d\d):?(\d\d)\Z")
_LOCALTIME = Path("/etc/localtime")


def named_zone(name: str) -> tzinfo:
    """The zone of an IANA name (``Asia/Tokyo``) or an offset (``+09:00``)."""
    if match := _OFFSET.match(name):
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
    """The zone of this machine, with its daylight saving where its name can be found."""
    name = environment.get("TZ", "").removeprefix(":")
    if not name and _LOCALTIME.exists():
        _, found, name = str(_LOCALTIME.resolve()).partition("zoneinfo/")
        name = name if found else ""
    try:
        return ZoneInfo(name)
    except (ValueError, OSError, LookupError):
        return datetime.now().astimezone().tzinfo or UTC


MAX_LOG = 64 * 1024 * 1024
"""Largest log that is read, in bytes."""


def read_log(log: str) -> str:
    """The text of a log, of standard input for "-"; a pipe (``<(journalctl ...)``) is read, too.

    Raises `DocumentError` for what cannot be read, is a device, or is larger than ``MAX_LOG``.
    """
    try:
        if log == "-":
            data = sys.stdin.buffer.read(MAX_LOG + 1) if sys.stdin else b""
        else:
            kind = Path(log).stat().st_mode
            if not (stat.S_ISREG(kind) or stat.S_ISFIFO(kind) or stat.S_ISDIR(kind)):
                raise DocumentError(f"the log '{log}' is neither a file nor a pipe")
            with Path(log).open("rb") as file:
                data = file.read(MAX_LOG + 1)
    except FileNotFoundError as error:
        raise DocumentError(f"the log '{log}' does not exist") from error
    except OSError as error:
        raise DocumentError(f"the log '{log}' cannot be read", f"{error.strerror}.") from error
    except ValueError as error:  # a name that holds NUL is of no file
        raise DocumentError(f"the log '{log}' does not exist") from error
    if len(data) > MAX_LOG:
        raise DocumentError(
            f"the log '{log}' is too large",
            f"More than {MAX_LOG // 1024**2} MiB.",
            "Cut it to what is of interest: tail -n 100000 LOG.",
        )
    return data.decode("utf-8", "replace")
