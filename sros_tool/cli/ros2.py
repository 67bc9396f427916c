"""The verbs of sros as `ros2 security`, a command that the program ``ros2`` of ros2cli loads.

ros2cli loads the class that the entry point ``security`` of the group ``ros2cli.command`` names,
and calls its methods (ros2cli 0.32, ``ros2cli/command/__init__.py``). So this module imports
nothing of ROS.
"""

from __future__ import annotations

from argparse import REMAINDER, ArgumentParser, Namespace
from typing import Any

from sros_tool.cli import main
from sros_tool.cli.program import program

_PROGRAM = "ros2 security"
_NO_PREFIX = "\0"
"""An option prefix that no argument has, so that ros2 parses no argument as its own option."""


class SecurityCommand:
    """Keystores, enclaves, permissions and checks of ROS 2 security, by sros."""

    NAME = "security"
    EXTENSION_POINT_VERSION = "0.1"

    def add_arguments(
        self, parser: ArgumentParser, cli_name: str, *, argv: list[str] | None = None
    ) -> None:
        """Let the parser of ros2 take all words as they are, also ``-h``: sros parses them."""
        parser.prefix_chars = _NO_PREFIX
        words = parser.add_argument("words", nargs=REMAINDER)
        words.completer = _completions  # type: ignore[attr-defined]  # read by argcomplete

    def main(self, *, parser: ArgumentParser, args: Namespace) -> int:
        """Run the verb, and exit with its status."""
        main(args.words, name=_PROGRAM)
        return 0


def _completions(prefix: str, parsed_args: Namespace, **_more: Any) -> list[str]:
    """Return the words that can stand in place of ``prefix``, as completion of ``sros`` does."""
    from argcomplete.completers import DirectoriesCompleter, FilesCompleter
    from click.shell_completion import ShellComplete

    words = list(getattr(parsed_args, "words", None) or ())
    completions: list[str] = []
    for item in ShellComplete(program, {}, _PROGRAM, "").get_completions(words, prefix):
        if item.type == "plain":
            completions.append(item.value)
        else:
            files = DirectoriesCompleter if item.type == "dir" else FilesCompleter
            completions += files()(item.value or prefix)
    return completions
