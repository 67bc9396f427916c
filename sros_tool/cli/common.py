"""What the verbs share: the keystore argument, common options, and how results are shown."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from sros_tool.cli.visible import visible, visible_json
from sros_tool.errors import UsageError

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem

    from sros_tool.keystore.transaction import Change
    from sros_tool.notes import Note

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
