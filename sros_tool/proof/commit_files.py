"""Files of a commit, without a checkout: policies at a git revision, and files in a private folder.

Only requested files are written into the folder, with the content that the commit has: filters,
conversions of line ends and other settings of the repository do not apply.  Symbolic links of the
commit are neither followed nor created, except links inside a keystore that stay in the keystore.
"""

from __future__ import annotations

import codecs
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

from lxml import etree

from sros_tool.errors import DocumentError, SrosError, UsageError
from sros_tool.folders import Folder
from sros_tool.names import has_parts
from sros_tool.policy.document import FALLBACKS, INCLUDES, MissingFileError, is_policy, read_policy
from sros_tool.policy.model import RIGHTS, Source
from sros_tool.proof.repository import FILES, FOLDER, LINK, Repository, TreeEntry, walk
from sros_tool.xml import parse

PREFIX = "git:"
_MOST_FILES = 300  # of a folder
_MOST_POLICY_BYTES = 64 * 1024 * 1024  # of its files
_MOST_POLICY_ENTRIES = 100_000
_NOWHERE = Path("/dev/null/git")
"""A path that never exists on disk, under which files of a revision are known to the policy reader.
"""


@dataclass(frozen=True, slots=True)
class PathAtRevision:
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
        """The path of the file or folder for the policy reader; nothing has this path on disk."""
        return _NOWHERE / self.path

    def policies(self) -> tuple[PathAtRevision, ...]:
        """Return the policies in this folder and below, or this file.

        Raises:
            DocumentError: a file may be a policy but is unreadable (`policy_files`), or there is a
                link or a submodule; sros follows neither.
        """
        entry = self.repository.find(self.commit, self.path)
        if entry is None or entry.mode != FOLDER:
            return (self,)
        below = f"{self.path}/" if self.path else ""
        files = [
            (PathAtRevision(self.repository, self.name, self.commit, below + name), tree_entry)
            for name, tree_entry in walk(self.repository, entry.id, maximum=_MOST_POLICY_ENTRIES)
        ]
        for file, tree_entry in files:
            if tree_entry.mode not in FILES:
                raise DocumentError(
                    f"'{file}' is {tree_entry.kind}", "", "Name a policy in the folder."
                )
        ids = dict.fromkeys(tree_entry.id for _, tree_entry in files)
        sizes = self.repository.sizes(ids)
        if sum(sizes.get(tree_entry.id, 0) for _, tree_entry in files) > _MOST_POLICY_BYTES:
            raise DocumentError(
                f"'{self}' has more than {_MOST_POLICY_BYTES} bytes",
                "",
                "Name a policy in the folder.",
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
        path, shown = str(file.relative_to(_NOWHERE)), self.with_git_paths(str(file))
        entry = self.repository.find(self.commit, path)
        if entry is None:
            raise MissingFileError(f"'{shown}' does not exist")
        if entry.mode not in FILES:
            raise DocumentError(
                f"'{shown}' is {entry.kind}", "", "Name a regular file in the commit."
            )
        return self.repository.content(entry.id)

    def with_git_paths(self, text: str) -> str:
        """Return a text in which ``git:REVISION:PATH`` replaces paths below `place`."""
        return text.replace(f"{_NOWHERE}/", f"{PREFIX}{self.name}:").replace(
            str(_NOWHERE), f"{PREFIX}{self.name}:"
        )

    def error(self, error: SrosError) -> DocumentError:
        """Return an error whose paths read ``git:REVISION:PATH``."""
        return DocumentError(*map(self.with_git_paths, (error.what, error.why, error.remedy)))

    def source(self, source: Source) -> Source:
        """Return a source whose path reads ``git:REVISION:PATH``."""
        return Source(self.with_git_paths(source.file), source.line)


def find_path_at_revision(text: str) -> PathAtRevision:
    """Return the path at a revision that ``git:REVISION:PATH`` names in the current repository.

    As for git, ``PATH`` is relative to the top of the repository, or to the working directory if it
    begins with ``./`` or ``../``.

    Raises:
        UsageError: the text has another form.
        DocumentError: git finds no such revision or path, or the revision is ambiguous.
    """
    name, colon, path = text.removeprefix(PREFIX).partition(":")
    if not name or not colon or not path or any(ord(character) < 32 for character in text):
        raise UsageError(
            f"'{text}' does not name a policy at a git revision",
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
    return PathAtRevision(repository, name, commit, path)


_MOST_ENTRIES = 200_000
_MOST_BYTES = 512 * 1024 * 1024  # that differ
_MOST_WRITTEN = 1024 * 1024 * 1024  # with those that are the same under several names
_LONGEST_TARGET = 4095  # bytes of a symbolic link (Linux, PATH_MAX)


def checked_path(text: str) -> str:
    """Return a path from the top of a repository in its shortest form.

    Raises:
        UsageError: the path is empty, absolute, or leads out of the repository.
    """
    path = os.path.normpath(text) if text else ""
    if not text or path.startswith(("/", "../")) or path in ("..", ".") or not path.isprintable():
        raise UsageError(
            f"'{text}' is not a path from the top of the repository",
            "",
            "Write a path such as robot/robot.policy.xml.",
        )
    return path


@dataclass(slots=True)
class CommitFiles:
    """The requested files of a commit, which are written to the private folder ``folder``.

    ``name`` is the commit's name in messages.  ``used_fallbacks`` has the includes whose fallback
    is used because the commit lacks the included file; ``refused`` has the reasons why files were
    not read.
    """

    repository: Repository
    name: str
    commit: str
    folder: Path
    files: dict[str, TreeEntry] = field(default_factory=dict)
    used_fallbacks: list[str] = field(default_factory=list)
    refused: list[SrosError] = field(default_factory=list)

    def entry(self, path: str) -> TreeEntry | None:
        """Return the tree entry at a path of the commit; None if the path does not exist."""
        return self.repository.find(self.commit, path)

    def entries(self, *, unlike: CommitFiles | None = None) -> Iterator[tuple[str, TreeEntry]]:
        """Yield paths and entries (`walk`), without those that are the same in ``unlike``."""
        before = unlike.repository.tree(unlike.commit) if unlike else ""
        tree = self.repository.tree(self.commit)
        return walk(self.repository, tree, maximum=_MOST_ENTRIES, other=before)

    def write_file(self, path: str) -> Path | None:
        """Write the file at a path of the commit; return its new path, or None for a missing path.

        Raises:
            DocumentError: the path is no regular file: for instance, it is a link.
        """
        entry = self.entry(path)
        if entry is None:
            return None
        if entry.mode not in FILES:
            raise self._not_a_file_error(path, entry)
        return self._write(path, entry, self.repository.content(entry.id))

    def write_policies(self, path: str, *, placeholders: bool) -> list[Path]:
        """Write the policies at a path, which is a file or a folder; return their new paths.

        Included files are written, too.  If the path does not exist, the result is empty.

        Raises:
            DocumentError: the path is no file or folder, a file that may be a policy is damaged, or
                the folder has links, submodules, or too many files.
        """
        entry = self.entry(path)
        if entry is None:
            return []
        if entry.mode in FILES:
            return [self._policy(path, placeholders)]
        if entry.mode != FOLDER:
            raise self._not_a_file_error(path, entry)
        folder = PathAtRevision(self.repository, self.name, self.commit, path)
        try:
            return [self._policy(policy.path, placeholders) for policy in folder.policies()]
        except SrosError as error:
            raise folder.error(error) from error

    def write_tree(self, path: str) -> Path | None:
        """Write a folder with all its content, such as a keystore; return its new path, or None.

        Raises:
            DocumentError: the path is no folder, or the folder is too large, has a submodule, or
                has a link that leads out.
        """
        entry = self.entry(path)
        if entry is None:
            return None
        if entry.mode != FOLDER:
            raise self._not_a_file_error(path, entry)
        links: dict[str, TreeEntry] = {}
        plain: dict[str, TreeEntry] = {}
        for name, tree_entry in walk(self.repository, entry.id, maximum=_MOST_ENTRIES):
            where = f"{path}/{name}"
            if tree_entry.mode not in (*FILES, LINK):
                raise self._not_a_file_error(where, tree_entry)
            (links if tree_entry.mode == LINK else plain)[where] = tree_entry
        of_all = (tree_entry.id for tree_entry in (*plain.values(), *links.values()))
        sizes = self.repository.sizes(dict.fromkeys(of_all))
        if sum(sizes.get(tree_entry.id, 0) for tree_entry in plain.values()) > _MOST_WRITTEN:
            raise DocumentError(f"'{path}' has more than {_MOST_WRITTEN} bytes")
        # Checked before reading, because many links together may be too large.
        for where, link in links.items():
            if not 0 < sizes.get(link.id, 1) <= _LONGEST_TARGET:
                raise DocumentError(
                    f"the target of the link '{where}' is not a valid path: it is empty, or longer "
                    f"than {_LONGEST_TARGET} bytes"
                )
        places: dict[str, list[str]] = {}
        for where, tree_entry in plain.items():
            places.setdefault(tree_entry.id, []).append(where)
        for digits, content in self.repository.contents_in_batches(places, _MOST_BYTES):
            for where in places[digits]:
                self._write(where, plain[where], content)
        contents = self.repository.contents(link.id for link in links.values())
        for where, link in links.items():
            if b"\0" in contents[link.id]:
                raise DocumentError(
                    f"the target of the link '{where}' is not a valid path: it contains a zero byte"
                )
        top = self.folder / path
        with Folder(self.folder) as folder:
            _make_folders(folder, path)
            # Links come last, so that no file is written through a link.
            for where, link in links.items():
                _make_folders(folder, str(PurePosixPath(where).parent))
                folder.symlink(os.fsdecode(contents[link.id]), where)
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

    def written_content(self, path: str) -> bytes:
        """Return the content of a file that was written, without asking git again."""
        return (self.folder / path).read_bytes()

    def differing_files(self, work_tree: Path) -> list[str]:
        """Return the written files that a work tree lacks, or has with other content."""
        paths = []
        with Folder(work_tree) as folder:
            for path in self.files:
                content = None
                with suppress(SrosError, OSError):
                    content = folder.read(path)
                if content != self.written_content(path):
                    paths.append(path)
        return paths

    def _policy(self, path: str, placeholders: bool) -> Path:
        path_at_revision = PathAtRevision(self.repository, self.name, self.commit, path)
        place = self._place_of_missing(path)

        def read(file: Path) -> bytes:
            where = str(file.relative_to(self._place_of_missing("")))
            try:
                content = path_at_revision.read(file)
            except MissingFileError:
                self.used_fallbacks.append(where)
                raise
            except SrosError as error:
                if where not in self.files:  # so that the file does not count as missing
                    with Folder(self.folder) as folder:
                        _make_folders(folder, where)
                self.refused.append(path_at_revision.error(error))
                raise
            entry = self.entry(where)
            assert entry
            self._write(where, entry, content)
            return content

        with suppress(SrosError):  # every later reader of the files reports the error
            read_policy(place, placeholders=placeholders, policy_files=read)
        return self.folder / path

    def _place_of_missing(self, path: str) -> Path:
        return PathAtRevision(self.repository, self.name, self.commit, path).place

    def _write(self, path: str, entry: TreeEntry, content: bytes) -> Path:
        if path not in self.files:
            with Folder(self.folder) as folder:
                _make_folders(folder, str(PurePosixPath(path).parent))
                folder.write(path, content, 0o600)
            self.files[path] = entry
        return self.folder / path

    def _not_a_file_error(self, path: str, entry: TreeEntry) -> DocumentError:
        return DocumentError(
            f"'{path}' of {self.name} is {entry.kind}",
            "Links and submodules of a commit are not followed.",
            "Name the file or folder itself.",
        )


def _make_folders(folder: Folder, path: str) -> None:
    """Create the folder at a path, with its missing parents."""
    for folder_path in reversed((PurePosixPath(path), *PurePosixPath(path).parents[:-1])):
        if str(folder_path) != "." and not folder.is_folder(str(folder_path)):
            folder.mkdir(str(folder_path), 0o700)


# ── attributes of git ──────────────────────────────────────────────────────────────────────

ATTRIBUTES_FILE = ".gitattributes"
EXPORT_IGNORE = "export-ignore"
"""The attribute by which git leaves a file or folder out of archives."""
_CONVERTING = (EXPORT_IGNORE, "working-tree-encoding", "ident", "export-subst", "filter")
"""Attributes by which git changes or drops files in a checkout or archive."""
_MOST_PATTERNS = 100


def converting_patterns(content: bytes) -> dict[str, str]:
    """Map patterns in a .gitattributes file to an attribute by which git changes or drops files.

    Lines that unset an attribute do not count.
    """
    patterns: dict[str, str] = {}
    for line in content.removeprefix(codecs.BOM_UTF8).split(b"\n"):
        pattern, *attributes = map(os.fsdecode, line.split() or [b""])
        named = {attribute.partition("=")[0] for attribute in attributes}
        converting = next((attribute for attribute in _CONVERTING if attribute in named), "")
        if converting and not pattern.startswith("#") and patterns.get(pattern) != EXPORT_IGNORE:
            # Kept, because only export-ignore applies to all files of a folder.
            patterns[pattern] = converting
        if len(patterns) > _MOST_PATTERNS:
            return {"*": converting}
    return patterns


def may_match(pattern: str, path: str) -> bool:
    """Return whether a pattern in .gitattributes may match ``path``, relative to the same folder.

    Characters that git reads in a special way stand for any text, and a pattern for folders matches
    files, too.
    """
    if pattern.startswith('"'):
        return True  # a quoted pattern may have spaces and escapes
    pattern = pattern.removesuffix("/")
    wanted = (path if "/" in pattern else PurePosixPath(path).name).lower()
    parts = re.split(r"[*?]+/?|[\[\\].*", pattern.removeprefix("/").lower(), flags=re.DOTALL)
    return has_parts(wanted, parts) if len(parts) > 1 else wanted == parts[0]


# ── policies, and their parts ──────────────────────────────────────────────────────────────

_POLICY_TEXTS = (
    *((b"<policy", b"version"), (b"<enclaves", b"path"), (b"<profile", b" ns=")),
    *((b"<topics", b"ALLOW"), (b"<services", b"ALLOW"), (b"<actions", b"ALLOW")),
)
"""Texts that mark an XML file as a policy, or as a part of a policy."""
_EBCDIC = b"\x4c\x6f\xa7\x94"
"""The beginning of an XML file in EBCDIC (XML 1.0, appendix F)."""
_ENCODING = re.compile(rb"encoding ?= ?[\"']([^\"']*)")
_READABLE_ENCODINGS = (
    b"utf-8",
    b"utf8",
    b"utf-16",
    b"us-ascii",
    b"ascii",
    b"iso-8859-",
    b"windows-125",
)
_LEADING_BYTES = b"\xef\xbb\xbf\xfe\xff \t\r\n"
"""Byte order marks and white space, which may precede the first XML element."""
_BEGIN_BYTES = 4096
_NAME_TAGS = frozenset(kind.removesuffix("s") for kind in RIGHTS)
_TAGS_WITH_PARTS = ("policy", "enclaves", "enclave", "profiles", "profile", *RIGHTS)
_WHOLE_FILE_POINTER = re.compile(r"(?:xpointer\(/(?:\*|[\w.-]+)(?P<below>/\*)?\))?")
"""An xpointer that selects a whole file, or everything below its root element."""


def may_be_policy(content: bytes) -> bool:
    """Return whether a file, whatever its name, may be a policy or a part of a policy."""
    text = content.replace(b"\0", b"")  # in UTF-16, ASCII letters have a zero byte
    if text.startswith(_EBCDIC):
        return True
    if not text.lstrip(_LEADING_BYTES).startswith(b"<"):
        return False
    text = b" ".join(text.split())
    encoding = _ENCODING.search(text.partition(b"?>")[0])
    if encoding and not encoding[1].lower().startswith(_READABLE_ENCODINGS):
        return True  # such as UTF-7, in which no element is readable here
    if any(second in text.partition(first)[2] for first, second in _POLICY_TEXTS):
        return True
    try:
        return _is_part(parse(content, "the file"))
    except DocumentError:
        return False


def _is_part(root: etree._Element) -> bool:
    """Return whether an XML document has elements that policies can include."""
    below = list(root.iter(etree.Element))
    only_names = below[0] if root.tag in _NAME_TAGS else below[1:]
    return (
        any(element.keys() and _gives_access(element) for element in below)
        or (root.tag in _TAGS_WITH_PARTS and any(element.tag in INCLUDES for element in below))
        or (
            (bool(below[1:]) or root.tag in _NAME_TAGS)
            and all(e.tag in _NAME_TAGS and e.text for e in only_names)
        )
    )


def _gives_access(element: etree._Element) -> bool:
    keys = set(element.keys())
    match element.tag:
        case "enclave":
            return "path" in keys
        case "profile":
            return {"ns", "node"} <= keys
        case kind:
            return any(
                element.get(right) in ("ALLOW", "DENY") for right in RIGHTS.get(str(kind), ())
            )


def is_whole_policy(content: bytes) -> bool:
    """Return whether a file is a whole policy, or may be one."""
    if not may_be_policy(content):
        return False
    try:
        return parse(content, "the file").tag in ("policy", "profiles")
    except DocumentError:
        return True


def files_used_whole(
    policies: Iterable[str], content: Callable[[str], bytes | None]
) -> dict[str, bool]:
    """Map each file of which all content is used to whether its root element is used, too.

    Args:
        policies: the paths of the policies.
        content: returns the content of the file at a path; None without a file.
    """
    used = dict.fromkeys(policies, True)
    left = list(used)
    while left:
        path = left.pop()
        for target, pointer in _includes(path, content(path)):
            whole = _WHOLE_FILE_POINTER.fullmatch(pointer)
            if whole and (target not in used or (not used[target] and not whole["below"])):
                used[target] = not whole["below"]
                left.append(target)
    return used


def may_include_files(content: bytes) -> bool:
    """Return whether a file may be XML, and so may include other files."""
    begin = content[:_BEGIN_BYTES].replace(b"\0", b"").lstrip(_LEADING_BYTES)
    return not begin or begin.startswith((b"<", _EBCDIC))


def files_including(parts: Iterable[str], files: Mapping[str, bytes]) -> set[str]:
    """Return the paths of files that include one of ``parts``, directly or through other files.

    ``files`` maps paths to contents.
    """
    includes = {
        path: {target for target, _ in _includes(path, data)} for path, data in files.items()
    }
    users = set(parts)
    while more := {path for path, targets in includes.items() if targets & users} - users:
        users |= more
    return users.difference(parts)


def _includes(path: str, content: bytes | None) -> Iterator[tuple[str, str]]:
    """Yield the included file and the xpointer of each include in a file.

    Includes in fallbacks and in metadata are left out. An unreadable file has no includes.
    """
    try:
        root = parse(content, "the file", instructions=True) if content is not None else None
    except DocumentError:
        return
    for element in root.iter(*INCLUDES) if root is not None else ():
        above = {str(ancestor.tag) for ancestor in element.iterancestors()}
        if not above & {"metadata", *FALLBACKS}:
            name = unquote(element.get("href", ""), errors="surrogateescape")
            target = os.path.normpath(Path(path).parent / name) if name else path
            yield target, element.get("xpointer", "")


def have_same_root(first_content: bytes, second_content: bytes) -> bool:
    """Return whether the root elements of two files have the same name and attributes.

    False if a file cannot be read as XML.
    """
    try:
        first, second = (parse(content, "the file") for content in (first_content, second_content))
    except DocumentError:
        return False
    return first.tag == second.tag and first.items() == second.items()
