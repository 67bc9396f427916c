"""Policies at a git revision, read without checking out files."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from sros_tool.errors import DocumentError, UsageError
from sros_tool.policy.document import MissingFileError, is_policy
from sros_tool.policy.model import Source
from sros_tool.proof.repository import FILES, FOLDER, Repository, walk

PREFIX = "git:"
_MOST_FILES = 300  # of a folder
_MOST_BYTES = 64 * 1024 * 1024  # of its files
_MOST_ENTRIES = 100_000
_NOWHERE = Path("/dev/null/git")
"""A path that never exists on disk, so that files of a revision are not mixed up with others."""


@dataclass(frozen=True, slots=True)
class Revision:
    """A file or folder at a git revision; ``path`` is relative to the top of the repository.

    ``commit`` is the full id that ``name`` stood for when the revision was read.
    """

    repository: Repository
    name: str
    commit: str
    path: str

    def __str__(self) -> str:
        return f"{PREFIX}{self.name}:{self.path}"

    @property
    def place(self) -> Path:
        """The path of the file or folder for the policy reader; it does not exist on disk."""
        return _NOWHERE / self.path

    def policies(self) -> tuple[Revision, ...]:
        """Return the policies in this folder and below, or this file.

        Raises:
            DocumentError: a file may be a policy but is unreadable (`policy_files`), or there is a
                link or a submodule, which are not followed.
        """
        entry = self.repository.find(self.commit, self.path)
        if entry is None or entry.mode != FOLDER:
            return (self,)
        below = f"{self.path}/" if self.path else ""
        files = [
            (Revision(self.repository, self.name, self.commit, below + name), tree_entry)
            for name, tree_entry in walk(self.repository, entry.id, most=_MOST_ENTRIES)
        ]
        for file, tree_entry in files:
            if tree_entry.mode not in FILES:
                raise DocumentError(
                    f"'{file}' is {tree_entry.kind}", "", "Name a policy in the folder."
                )
        ids = dict.fromkeys(tree_entry.id for _, tree_entry in files)
        sizes = self.repository.sizes(ids)
        if sum(sizes.get(tree_entry.id, 0) for _, tree_entry in files) > _MOST_BYTES:
            raise DocumentError(
                f"'{self}' has more than {_MOST_BYTES} bytes", "", "Name a policy in it."
            )
        contents = self.repository.contents(ids)
        policies = [
            file
            for file, tree_entry in files
            if is_policy(file.path, contents[tree_entry.id], f"'{file}'")
        ]
        if len(policies) > _MOST_FILES:
            raise DocumentError(
                f"'{self}' has more than {_MOST_FILES} policies", "", "Name one of them."
            )
        return tuple(sorted(policies, key=lambda revision: revision.path))

    def read(self, file: Path) -> bytes:
        """Return the content of a file of this revision; ``file`` is a path below `place`.

        Raises:
            MissingFileError: the revision has no such file.
            DocumentError: the file is too large, or is no file but for instance a link, which is
                not followed.
        """
        path, shown = str(file.relative_to(_NOWHERE)), self.shown(str(file))
        entry = self.repository.find(self.commit, path)
        if entry is None:
            raise MissingFileError(f"'{shown}' does not exist")
        if entry.mode not in FILES:
            raise DocumentError(
                f"'{shown}' is {entry.kind}", "", "Name a file of the revision itself."
            )
        return self.repository.content(entry.id)

    def shown(self, text: str) -> str:
        """Return a text in which ``git:REVISION:PATH`` replaces paths below `place`."""
        return text.replace(f"{_NOWHERE}/", f"{PREFIX}{self.name}:").replace(
            str(_NOWHERE), f"{PREFIX}{self.name}:"
        )

    def source(self, source: Source) -> Source:
        """Return a source whose path reads ``git:REVISION:PATH``."""
        return Source(self.shown(source.file), source.line)


def find_revision(text: str) -> Revision:
    """Return the revision that ``git:REVISION:PATH`` names in the current repository.

    As for git, ``PATH`` is relative to the top of the repository, or to the working directory if it
    begins with ``./`` or ``../``.

    Raises:
        UsageError: the text has another form.
        DocumentError: git finds no such revision or path, or the revision is ambiguous.
    """
    name, colon, path = text.removeprefix(PREFIX).partition(":")
    if not name or not colon or not path or any(ord(each) < 32 for each in text):
        raise UsageError(
            f"'{text}' is not a policy in a revision",
            "",
            "Write git:REVISION:PATH, such as git:main:policies/robot.xml.",
        )
    repository = Repository(Path.cwd())
    commit = repository.commit(name)
    if path.startswith(("./", "../")):
        path = repository.prefix() + path
    path = os.path.normpath(path)
    if path.startswith(("../", "/")) or path == "..":
        raise DocumentError(f"'{text}' is outside of the repository")
    path = "" if path == "." else path
    if repository.find(commit, path) is None:
        raise DocumentError(
            f"'{PREFIX}{name}:{path}' does not exist",
            "",
            "A path starts at the top of the repository; with ./, it starts at the working "
            "directory.",
        )
    return Revision(repository, name, commit, path)
