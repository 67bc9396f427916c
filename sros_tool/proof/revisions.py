"""Policies as they were at a revision of git, read without checking anything out.

Nothing in a repository is trusted: git only reads objects here.  No program that the repository
configures is run (hooks, filters, textconv, fsmonitor, transports), nothing is fetched, and
replaced objects are not taken.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sros_tool.errors import DocumentError, UnavailableError, UsageError
from sros_tool.policy.document import MissingFileError
from sros_tool.policy.model import Source

PREFIX = "git:"
_MOST_BYTES = 32 * 1024 * 1024
_MOST_FILES = 300  # of a folder
_WAIT = 60  # seconds
_FILE_MODES = (b"100644", b"100755", b"100664")
_FOLDER_MODE, _LINK_MODE = b"040000", b"120000"
_NOWHERE = Path("/dev/null/git")
"""No file can be there, so that no link or file of the disk is taken for one of a revision."""
_SAFE = ("--no-pager", "-c", "core.fsmonitor=false", "-c", "core.hooksPath=/dev/null")
_ENVIRONMENT = {
    "GIT_ALLOW_PROTOCOL": "",
    "GIT_NO_LAZY_FETCH": "1",
    "GIT_NO_REPLACE_OBJECTS": "1",
    "GIT_OPTIONAL_LOCKS": "0",
    "GIT_TERMINAL_PROMPT": "0",
    "LC_ALL": "C",
}


@dataclass(frozen=True, slots=True)
class Revision:
    """A file or folder of a revision: ``path`` is relative to the top of the repository.

    ``commit`` is the full id that ``name`` stood for when it was read.
    """

    name: str
    commit: str
    path: str

    def __str__(self) -> str:
        return f"{PREFIX}{self.name}:{self.path}"

    @property
    def place(self) -> Path:
        """A path for the policy reader, which exists nowhere."""
        return _NOWHERE / self.path

    def files(self) -> tuple[Revision, ...]:
        """Return the files whose names end with ``.xml`` if this is a folder, else this file."""
        spec = f"{self.commit}:{self.path}"
        if _git(["cat-file", "-t", spec]).strip() != b"tree":
            return (self,)
        self._check_size(spec, str(self))
        listed = _git(["ls-tree", "--full-tree", "-z", "--name-only", spec]).decode(
            errors="replace"
        )
        names = sorted(each for each in listed.split("\0") if each.endswith(".xml"))
        if len(names) > _MOST_FILES:
            raise DocumentError(
                f"'{self}' has more than {_MOST_FILES} files", "", "Name one of them."
            )
        below = f"{self.path}/" if self.path else ""
        return tuple(Revision(self.name, self.commit, below + each) for each in names)

    def read(self, file: Path) -> bytes:
        """Return the content of a file that has a `place` in this revision.

        Raises:
            MissingFileError: the revision has no such file.
            DocumentError: it is too large, or no file but for instance a link: where a link leads
                to is not followed, so that what is there is not certain.
        """
        path, shown = str(file.relative_to(_NOWHERE)), self.shown(str(file))
        words = ["ls-tree", "--full-tree", "-z", self.commit, "--", path]
        mode = _git(words, "--literal-pathspecs").partition(b" ")[0]
        if not mode:
            self._check_folders(path)
            raise MissingFileError(f"'{shown}' does not exist")
        if mode not in _FILE_MODES:
            what = "a symbolic link" if mode == _LINK_MODE else "no file"
            raise DocumentError(f"'{shown}' is {what}", "", "Name a file of the revision itself.")
        spec = f"{self.commit}:{path}"
        self._check_size(spec, shown)
        return _git(["cat-file", "blob", spec])

    def _check_folders(self, path: str) -> None:
        """Raise `DocumentError` if a missing path leads through what is no folder, such as a link.

        On disk there could be a file.
        """
        for parent in reversed(Path(path).parents[:-1]):
            words = ["ls-tree", "--full-tree", "-z", self.commit, "--", str(parent)]
            mode = _git(words, "--literal-pathspecs").partition(b" ")[0]
            if not mode:
                return
            if mode != _FOLDER_MODE:
                raise DocumentError(f"'{PREFIX}{self.name}:{parent}' is no folder of the revision")

    @staticmethod
    def _check_size(spec: str, shown: str) -> None:
        if int(_git(["cat-file", "-s", spec])) > _MOST_BYTES:
            raise DocumentError(f"'{shown}' is larger than {_MOST_BYTES} bytes")

    def shown(self, text: str) -> str:
        """Return a text with the places of this revision as a user would name them."""
        return text.replace(f"{_NOWHERE}/", f"{PREFIX}{self.name}:").replace(
            str(_NOWHERE), f"{PREFIX}{self.name}:"
        )

    def source(self, source: Source) -> Source:
        """Return a source of this revision as a user would name it."""
        return Source(self.shown(source.file), source.line)


def find_revision(text: str) -> Revision:
    """Return what ``git:REVISION:PATH`` names, in the repository of the working directory.

    As for git, ``PATH`` is relative to the top of the repository, or to the working directory if it
    begins with ``./`` or ``../``.

    Raises:
        UsageError: the text has another form.
        DocumentError: git finds no such revision or path.
    """
    name, colon, path = text.removeprefix(PREFIX).partition(":")
    if not name or not colon or not path or any(ord(each) < 32 for each in text):
        raise UsageError(
            f"'{text}' names no policy at a revision",
            "",
            "Write git:REVISION:PATH, such as git:main:policies/robot.xml.",
        )
    commit = _git(["rev-parse", "--verify", "--quiet", "--end-of-options", f"{name}^{{commit}}"])
    found = commit.decode("ascii", errors="replace").strip()
    if not found:
        raise DocumentError(
            f"git finds no revision '{name}'",
            "",
            "`git log --oneline` and `git branch` show what there is. In a shallow clone, such as "
            "on a server for tests, fetch it first.",
        )
    if path.startswith(("./", "../")):
        prefix = _git(["rev-parse", "--show-prefix"]).decode(errors="surrogateescape").strip("\n")
        path = os.path.normpath(prefix + path)
    else:
        path = os.path.normpath(path)
    if path.startswith(("../", "/")) or path == "..":
        raise DocumentError(f"'{text}' is outside of the repository")
    listed = ["ls-tree", "--full-tree", "-z", found, "--", path]
    if path != "." and not _git(listed, "--literal-pathspecs"):
        raise DocumentError(
            f"'{PREFIX}{name}:{path}' does not exist",
            "",
            "A path is from the top of the repository, or from here with ./ before it.",
        )
    return Revision(name, found, "" if path == "." else path)


def _git(arguments: Sequence[str], *options: str) -> bytes:
    """Return what git prints.

    Raises:
        DocumentError: git fails; of a command that is asked to be quiet only if it says why.
        UnavailableError: git is not installed.
    """
    try:
        done = subprocess.run(
            ["git", *_SAFE, *options, *arguments],
            env={**os.environ, **_ENVIRONMENT},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=_WAIT,
            check=False,
        )
    except FileNotFoundError as error:
        raise UnavailableError("git is not installed", "", "Install git.") from error
    except subprocess.TimeoutExpired as error:
        raise DocumentError(f"git does not answer within {_WAIT} seconds") from error
    said = done.stderr[:500].decode(errors="replace").strip()
    if done.returncode and (said or "--quiet" not in arguments):
        why = said.removeprefix("fatal: ") or f"it ended with status {done.returncode}"
        raise DocumentError(f"git cannot read it: {why}")
    return done.stdout
