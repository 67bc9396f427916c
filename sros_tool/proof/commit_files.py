"""Files of a commit in a private folder, for readers that need files: nothing is checked out.

Only files that are asked for are written, as the commit has them: without filters, conversions of
line ends or anything else that a repository configures.  No symbolic link of the commit is followed
or made, but those of a keystore that stay in the keystore.
"""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import field
from pathlib import Path, PurePosixPath

from sros_tool.dataclass import dataclass
from sros_tool.errors import DocumentError, SrosError, UsageError
from sros_tool.folders import Folder
from sros_tool.policy.document import MissingFileError, read_policy
from sros_tool.proof.repository import FILES, FOLDER, LINK, Repository, TreeEntry, walk
from sros_tool.proof.revisions import Revision

_MOST_ENTRIES = 200_000
_MOST_BYTES = 512 * 1024 * 1024  # that differ
_MOST_WRITTEN = 1024 * 1024 * 1024  # with those that are the same under several names
_LONGEST_TARGET = 4095  # bytes of a symbolic link (Linux, PATH_MAX)


def checked_path(text: str) -> str:
    """Return a path from the top of a repository in its shortest form.

    Raises:
        UsageError: it is empty, absolute, or leads out of the repository.
    """
    path = os.path.normpath(text) if text else ""
    if not text or path.startswith(("/", "../")) or path in ("..", ".") or not path.isprintable():
        raise UsageError(
            f"'{text}' is no path from the top of the repository",
            "",
            "Write a path such as robot/robot.policy.xml.",
        )
    return path


@dataclass(slots=True)
class CommitFiles:
    """The files of a commit that were asked for, below ``folder``, which is new and private.

    ``name`` is what messages call the commit.  ``fell_back`` has the includes whose file is not in
    the commit, so that their fallback counts; ``refused`` why a file was not read.
    """

    repository: Repository
    name: str
    commit: str
    folder: Path
    files: dict[str, TreeEntry] = field(default_factory=dict)
    fell_back: list[str] = field(default_factory=list)
    refused: list[SrosError] = field(default_factory=list)

    def entry(self, path: str) -> TreeEntry | None:
        """Return what is at a path of the commit; None if nothing is."""
        return self.repository.find(self.commit, path)

    def file(self, path: str) -> Path | None:
        """Return the file at a path of the commit, written to its place; None if nothing is there.

        Raises:
            DocumentError: it is no file, but for instance a link.
        """
        entry = self.entry(path)
        if entry is None:
            return None
        if entry.mode not in FILES:
            raise self._no_file(path, entry)
        return self._write(path, entry, self.repository.content(entry.id))

    def policies(self, path: str, *, placeholders: bool) -> list[Path]:
        """Return the policies at a path, a file or a folder, written to their places.

        The files that they include are written, too.  The list is empty if nothing is there.

        Raises:
            DocumentError: it is no file and no folder, a file that could be a policy is damaged, or
                the folder has links, submodules, or too much.
        """
        entry = self.entry(path)
        if entry is None:
            return []
        if entry.mode in FILES:
            return [self._policy(path, placeholders)]
        if entry.mode != FOLDER:
            raise self._no_file(path, entry)
        folder = Revision(self.repository, self.name, self.commit, path)
        try:
            return [self._policy(each.path, placeholders) for each in folder.policies()]
        except SrosError as error:
            texts = (folder.shown(each) for each in (error.what, error.why, error.remedy))
            raise DocumentError(*texts) from error

    def tree(self, path: str) -> Path | None:
        """Return a folder with all that is below it, such as a keystore; None if nothing is there.

        Raises:
            DocumentError: it is no folder, too large, or has a submodule or a link that leads out.
        """
        entry = self.entry(path)
        if entry is None:
            return None
        if entry.mode != FOLDER:
            raise self._no_file(path, entry)
        links: dict[str, TreeEntry] = {}
        plain: dict[str, TreeEntry] = {}
        for name, each in walk(self.repository, entry.id, most=_MOST_ENTRIES):
            where = f"{path}/{name}"
            if each.mode not in (*FILES, LINK):
                raise self._no_file(where, each)
            (links if each.mode == LINK else plain)[where] = each
        of_all = (each.id for each in (*plain.values(), *links.values()))
        sizes = self.repository.sizes(dict.fromkeys(of_all))
        if sum(sizes.get(each.id, 0) for each in plain.values()) > _MOST_WRITTEN:
            raise DocumentError(f"'{path}' has more than {_MOST_WRITTEN} bytes")
        for where, each in links.items():  # before they are read: many are too large together
            if not 0 < sizes.get(each.id, 1) <= _LONGEST_TARGET:
                raise DocumentError(f"'{where}' is a link that no file system can have")
        places: dict[str, list[str]] = {}
        for where, each in plain.items():
            places.setdefault(each.id, []).append(where)
        for part in self.repository.contents_in_parts(places, _MOST_BYTES):
            for digits, content in part.items():
                for where in places[digits]:
                    self._write(where, plain[where], content)
        contents = self.repository.contents(each.id for each in links.values())
        for where, each in links.items():
            if b"\0" in contents[each.id]:
                raise DocumentError(f"'{where}' is a link that no file system can have")
        top = self.folder / path
        with Folder(self.folder) as folder:
            _make_folders(folder, path)
            for where, each in links.items():  # when all files are written: none goes through one
                _make_folders(folder, str(PurePosixPath(where).parent))
                folder.symlink(os.fsdecode(contents[each.id]), where)
        for where in links:
            target = str((self.folder / where).readlink())
            real = Path(os.path.realpath(self.folder / where))
            if target.startswith("/") or not real.is_relative_to(os.path.realpath(top)):
                raise DocumentError(
                    f"'{where}' is a link out of '{path}'",
                    f"It leads to '{target}'.",
                    "Replace the link with the file itself.",
                )
        return top

    def differing(self, work_tree: Path) -> list[str]:
        """Return the files of this snapshot that a work tree has otherwise, or not at all."""
        found = []
        with Folder(work_tree) as folder:
            for path in self.files:
                there = None
                with suppress(SrosError, OSError):
                    there = folder.read(path)
                if there != (self.folder / path).read_bytes():
                    found.append(path)
        return found

    def _policy(self, path: str, placeholders: bool) -> Path:
        revision = Revision(self.repository, self.name, self.commit, path)
        place = self._nowhere(path)

        def read(file: Path) -> bytes:
            where = str(file.relative_to(self._nowhere("")))
            try:
                content = revision.read(file)
            except MissingFileError:
                self.fell_back.append(where)
                raise
            except SrosError as error:
                if where not in self.files:  # so that no reader takes it for missing
                    with Folder(self.folder) as folder:
                        _make_folders(folder, where)
                texts = (revision.shown(each) for each in (error.what, error.why, error.remedy))
                self.refused.append(DocumentError(*texts))
                raise
            entry = self.entry(where)
            assert entry
            self._write(where, entry, content)
            return content

        with suppress(SrosError):  # whoever reads the files finds it, too
            read_policy(place, placeholders=placeholders, read=read)
        return self.folder / path

    def _nowhere(self, path: str) -> Path:
        return Revision(self.repository, self.name, self.commit, path).place

    def _write(self, path: str, entry: TreeEntry, content: bytes) -> Path:
        if path not in self.files:
            with Folder(self.folder) as folder:
                _make_folders(folder, str(PurePosixPath(path).parent))
                folder.write(path, content, 0o600)
            self.files[path] = entry
        return self.folder / path

    def _no_file(self, path: str, entry: TreeEntry) -> DocumentError:
        return DocumentError(
            f"'{path}' of {self.name} is {entry.kind}",
            "Links and submodules of a commit are not followed.",
            "Name the file or folder itself.",
        )


def _make_folders(folder: Folder, path: str) -> None:
    """Make the folder at a path, and those above it, if they are missing."""
    for each in reversed((PurePosixPath(path), *PurePosixPath(path).parents[:-1])):
        if str(each) != "." and not folder.is_folder(str(each)):
            folder.mkdir(str(each), 0o700)
