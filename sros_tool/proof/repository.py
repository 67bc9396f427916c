"""Read objects and references of a git repository that need not be trusted.

Git only reads objects, and sros verifies the hash of each object. So the returned content of a
commit is right, whatever replacements, grafts, alternates, attributes or settings the repository
has.  No program that the repository configures is run (hooks, filters, textconv, fsmonitor,
transports), only `Repository.fetch_missing` fetches anything, and no file of the work tree is read.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from sros_tool.errors import DocumentError, UnavailableError, UsageError
from sros_tool.wording import capitalized

FOLDER, LINK, SUBMODULE = "40000", "120000", "160000"
FILES = ("100644", "100755")
"""File modes of the entries of a git tree, in octal digits."""

_MOST_BYTES = 32 * 1024 * 1024
"""Size in bytes of the largest object that is read."""
_BATCH_BYTES = 64 * 1024 * 1024
_MAX_DEPTH = 200
_MOST_TAGS = 10
_CACHE_SIZE = 1024
_MOST_KNOWN_BYTES = 16 * 1024
_WAIT_SECONDS = 60  # seconds
_WAIT_FOR_SERVER = 600
_SAFE_OPTIONS = (
    "--no-pager",
    "--no-replace-objects",
    *("-c", "core.fsmonitor=false"),
    *("-c", "core.hooksPath=/dev/null"),
    *("-c", "core.alternateRefsCommand=:"),
)
_READING_VARIABLES = {"GIT_ALLOW_PROTOCOL": "", "GIT_NO_LAZY_FETCH": "1"}
_FETCHING_VARIABLES = {"GIT_ALLOW_PROTOCOL": "file:git:http:https:ssh"}
_COMMON_VARIABLES = {
    "GIT_NO_REPLACE_OBJECTS": "1",
    "GIT_OPTIONAL_LOCKS": "0",
    "GIT_TERMINAL_PROMPT": "0",
    **dict.fromkeys(("GIT_TRACE", "GIT_TRACE2", "GIT_TRACE2_EVENT", "GIT_TRACE2_PERF"), "0"),
    "LC_ALL": "C",
}
_REPOSITORY_VARIABLES = (
    *("GIT_ALTERNATE_OBJECT_DIRECTORIES", "GIT_COMMON_DIR", "GIT_CONFIG", "GIT_DIR"),
    *("GIT_GRAFT_FILE", "GIT_INDEX_FILE", "GIT_NAMESPACE", "GIT_OBJECT_DIRECTORY", "GIT_PREFIX"),
    *("GIT_REPLACE_REF_BASE", "GIT_SHALLOW_FILE", "GIT_WORK_TREE"),
)
"""Environment variables that make git read another repository than the given folder."""
_SETTINGS_VARIABLES = ("HOME", "XDG_CONFIG_HOME", "GIT_CONFIG_GLOBAL", "GIT_CONFIG_SYSTEM")
"""Environment variables that tell git where it finds settings outside of the repository."""
_NO_BASE = "none"
_FIRST_PARENT = "^1"
_HASH = re.compile(r"[0-9a-f]{40}(?:[0-9a-f]{24})?\Z")
_ABBREVIATED = re.compile(r"[0-9a-fA-F]{4,64}\Z")
_NO_REFERENCE = re.compile(r"[\x00-\x20\x7f*?\[\\~^:]|\A-|\A\Z")
_EXPRESSION = re.compile(r"(?P<name>(?:[^~^@:]|@(?!\{))+|@)(?P<rest>.*)\Z", re.DOTALL)

_known: dict[tuple[Path, str], tuple[str, bytes]] = {}
"""Small commits and trees that were read and verified, by repository and id."""


@dataclass(frozen=True, slots=True)
class TreeEntry:
    """An entry of a git tree: a file, link, folder or submodule."""

    mode: str
    id: str

    @property
    def kind(self) -> str:
        """The kind of the entry, in words, such as "a folder"."""
        kinds = {FOLDER: "a folder", LINK: "a symbolic link", SUBMODULE: "a submodule"}
        return kinds.get(self.mode, "a file" if self.mode in FILES else "no file")


@dataclass(frozen=True, slots=True)
class Repository:
    """The git repository that contains the folder ``folder``."""

    folder: Path

    # ── references ─────────────────────────────────────────────────────────────────────────

    def exact_commit(self, name: str, option: str = "") -> str:
        """Return the full id of the commit that a full id or a full reference (refs/…) names.

        Shorter names are refused: git looks them up in several places, and whoever may push a tag
        can create one that git finds first.  ``option`` is the option of sros that has the name.

        Raises:
            UsageError: the name has another form.
            DocumentError: the repository has no such commit.
        """
        if not _HASH.match(name) and not name.startswith("refs/"):
            why = "Whoever can create a tag or branch of that name could choose another commit."
            full = "write the full id of the commit, or a name such as refs/remotes/origin/main."
            try:
                found = " ".join(filter(None, (option, self.commit(name))))
                remedy = f"If git finds the right commit now, write `{found}`; otherwise {full}"
            except DocumentError as error:
                why = f"{why} {capitalized(error.what)}. {error.why}".rstrip()
                remedy = f"Do not shorten the name: {full}"
            raise UsageError(
                f"'{name}' is neither the full id of a commit nor a full reference", why, remedy
            )
        digits = name if _HASH.match(name) else self._target(name)
        if not digits:
            raise DocumentError(
                f"git finds no reference '{name}'",
                "",
                "Fetch the reference first; `git for-each-ref` shows the existing ones.",
            )
        return self._commit_id(digits, name)

    def commit(self, name: str) -> str:
        """Return the full commit id for a name such as ``main`` or ``HEAD~2``.

        Raises:
            DocumentError: git finds no such commit, or the name is ambiguous.
        """
        expression = _EXPRESSION.match(name)
        if not expression or name.startswith("-"):
            raise _unknown_revision_error(name)
        base, rest = expression["name"], expression["rest"]
        if _HASH.match(base):
            object_id = base
        elif base in ("HEAD", "@"):
            base, object_id = "HEAD", self._ask("rev-parse", "--verify", "--quiet", "HEAD")
        else:
            candidates = self._candidates(base)
            if len(candidates) > 1:
                raise DocumentError(
                    f"the name '{base}' is ambiguous",
                    f"It stands for {_candidates_text(candidates)}.",
                    "Write the full name, such as refs/remotes/origin/main.",
                )
            base, object_id = next(iter(candidates.items()), (base, ""))
        if object_id and rest:
            start = base if rest.startswith("@") else object_id
            words = ("--verify", "--quiet", "--end-of-options", f"{start}{rest}^{{commit}}")
            object_id = self._ask("rev-parse", *words)
        if not object_id:
            raise _unknown_revision_error(name)
        return self._commit_id(object_id, name)

    def _candidates(self, name: str) -> dict[str, str]:
        """Return the ids of all references that a short name can stand for, by reference.

        Raises:
            DocumentError: the name looks like a branch of a remote, but is a local tag or branch.
        """
        if name.startswith("refs/"):
            target = self._target(name)
            return {name: target} if target else {}
        candidates = self._references(name)
        remote, slash, _ = name.partition("/")
        if slash and remote in self._ask("remote").split():
            wanted = f"refs/remotes/{name}"
            if candidates and wanted not in candidates:
                raise DocumentError(
                    f"'{name}' is {_candidates_text(candidates)}, but no branch of the remote "
                    f"'{remote}'",
                    "Anybody who may push tags or branches can create one with this name.",
                    f"Fetch '{wanted}', or write the full reference name.",
                )
        described = name.rpartition("-g")[2]
        if _ABBREVIATED.match(name) or (_ABBREVIATED.match(described) and not candidates):
            digits = name if _ABBREVIATED.match(name) else described
            ids = self._ask("rev-parse", f"--disambiguate={digits.lower()}").split()
            kinds = {object_id: kind for object_id, (kind, _) in self._types_and_sizes(ids).items()}
            candidates |= {
                object_id: object_id
                for object_id in ids
                if kinds.get(object_id) in ("commit", "tag")
            }
        return candidates

    def _references(self, name: str) -> dict[str, str]:
        """Return the references that git looks up for a short name, with their ids."""
        places = ("refs/", "refs/tags/", "refs/heads/", "refs/remotes/")
        names = [f"{place}{name}" for place in places] + [f"refs/remotes/{name}/HEAD"]
        commits = self._targets(names)
        if re.fullmatch(r"[A-Z_]+", name):  # a reference such as FETCH_HEAD
            target = self._ask("rev-parse", "--verify", "--quiet", "--end-of-options", name)
            commits |= {name: target} if target and target not in commits.values() else {}
        return commits

    def _target(self, reference: str) -> str:
        """Return the id that a reference points to, or "" if the reference does not exist."""
        return self._targets([reference]).get(reference, "")

    def _targets(self, references: Sequence[str]) -> dict[str, str]:
        """Return the ids of references by name, without references that do not exist."""
        wanted = [reference for reference in references if not _NO_REFERENCE.search(reference)]
        if not wanted:
            return {}
        lines = self._ask("for-each-ref", "--format=%(objectname) %(refname)", "--", *wanted)
        targets = {name: digits for digits, _, name in map(_split_at_blank, lines.splitlines())}
        return {reference: targets[reference] for reference in wanted if reference in targets}

    def _commit_id(self, digits: str, name: str) -> str:
        """Return the id of the commit that an object id names, directly or by annotated tags.

        ``name`` is the name that the user gave, for errors.

        Raises:
            DocumentError: the object is missing, or is not a commit.
        """
        for _ in range(_MOST_TAGS):
            kind, content = self._objects([digits]).get(digits, ("", b""))
            if kind == "commit":
                return digits
            if kind != "tag":
                break
            digits = _header(content, b"object")
        if not kind:
            raise DocumentError(
                f"the commit of '{name}' is not in the repository",
                "" if digits == name else f"It is {digits}.",
                "In a shallow clone, as in CI, fetch it first: `git fetch "
                "origin`, or `--fetch origin` of sros review.",
            )
        raise DocumentError(f"'{name}' is not a commit", f"It is a {kind}.")

    # ── objects ────────────────────────────────────────────────────────────────────────────

    def tree(self, commit: str) -> str:
        """Return the id of a commit's root tree."""
        return _header(self._objects([commit])[commit][1], b"tree")

    def parents(self, commit: str) -> tuple[str, ...]:
        """Return the ids of a commit's parents; a merge commit has several."""
        head = self._objects([commit])[commit][1].partition(b"\n\n")[0]
        lines = head.decode(errors="replace").split("\n")
        return tuple(line.removeprefix("parent ") for line in lines if line.startswith("parent "))

    def base_commit(self, name: str, remote: str | None) -> str:
        """Return the full id of the base commit to compare with, or "" for the name ``none``.

        The name has a form that `exact_commit` accepts. With ``^1`` behind such a name of a merge
        commit, the base is the first parent. With a ``remote``, a missing commit is fetched from
        the remote.
        """
        if name == _NO_BASE:
            return ""
        if (merge := name.removesuffix(_FIRST_PARENT)) != name:
            if remote:
                self.fetch_missing(merge, remote)
            name = self.first_parent(merge)
        if remote and not name.startswith("refs/") and len(name) in (40, 64):
            self.fetch_missing(name, remote)
        return self.exact_commit(name, "--base")

    def head_commit(self, name: str) -> str:
        """Return the full id of the commit to review: ``HEAD``, a full id or a full reference."""
        return self.commit(name) if name == "HEAD" else self.exact_commit(name, "--head")

    def first_parent(self, merge: str) -> str:
        """Return the id of a merge commit's first parent: the target branch before the merge.

        Raises:
            UsageError: ``merge`` is not a full id.
            DocumentError: the commit is not a merge, or not in the repository.
        """
        if not _HASH.match(merge):
            raise UsageError(f"'{merge}' is not the full id of a commit")
        parents = self.parents(self._commit_id(merge, merge))
        if len(parents) < 2:
            raise DocumentError(
                f"the commit {merge} is not a merge",
                "Only the parents of a merge commit show which base it has.",
                "Name the base itself, or check out the merge commit of the code host.",
            )
        return parents[0]

    def folders(self, ids: Iterable[str]) -> dict[str, dict[str, TreeEntry]]:
        """Return the entries of git trees, as a map from tree id to entries by name.

        Raises:
            DocumentError: a tree is missing or malformed, or has a name that no file system allows.
        """
        wanted = list(dict.fromkeys(ids))
        trees = _contents_of_kind("tree", wanted, self._objects(wanted))
        return {object_id: _entries(data, len(object_id) // 2) for object_id, data in trees.items()}

    def contents(self, ids: Iterable[str]) -> dict[str, bytes]:
        """Return the contents of files, by id.

        Raises:
            DocumentError: a file is missing, damaged, or larger than `_MOST_BYTES`.
        """
        wanted = list(dict.fromkeys(ids))
        return _contents_of_kind("blob", wanted, self._objects(wanted))

    def sizes(self, ids: Iterable[str]) -> dict[str, int]:
        """Return the sizes of objects in bytes, by id; missing objects are left out."""
        return {object_id: size for object_id, (_, size) in self._types_and_sizes(ids).items()}

    def _types_and_sizes(self, ids: Iterable[str]) -> dict[str, tuple[str, int]]:
        """Return the type and the size in bytes of objects, by id, as git reports them."""
        asked = "".join(f"{object_id}\n" for object_id in ids).encode()
        lines = self._git(["cat-file", "--batch-check"], stdin=asked).decode().splitlines()
        fields = (line.split() for line in lines)
        return {words[0]: (words[1], int(words[2])) for words in fields if len(words) == 3}

    def find(self, commit: str, path: str) -> TreeEntry | None:
        """Return the entry at a path of a commit ("" is the root), or None for a missing path.

        Raises:
            DocumentError: a parent in the path is not a folder, but for instance a link.
        """
        entry = _top_folder(self, commit)
        gone: list[str] = []
        for part in path.split("/") if path else ():
            if entry.mode != FOLDER:
                raise DocumentError(f"'{'/'.join(gone)}' is not a folder in the commit")
            tree_entry = _entries_of_folder(self, entry.id).get(part)
            if tree_entry is None:
                return None
            entry = tree_entry
            gone.append(part)
        return entry

    def contents_in_batches(
        self, ids: Iterable[str], maximum: int, *, largest: int | None = None
    ) -> Iterator[tuple[str, bytes]]:
        """Yield ids and contents of files, which are read in batches that fit into memory.

        Files of more than ``largest`` bytes are left out.

        Raises:
            DocumentError: a file is missing, damaged or too large, or all files together have more
                than ``maximum`` bytes.
        """
        known = self.sizes(wanted := dict.fromkeys(ids))
        # A missing object raises an error below.
        sizes = {object_id: known.get(object_id, 0) for object_id in wanted}
        if largest is not None:
            sizes = {object_id: size for object_id, size in sizes.items() if size <= largest}
        if sum(sizes.values()) > maximum:
            raise DocumentError(f"the files of the commit have more than {maximum} bytes")
        part: list[str] = []
        room = _BATCH_BYTES
        for object_id, size in sizes.items():
            if part and size > room:
                yield from _contents_of_kind("blob", part, self._read(part, sizes)).items()
                part, room = [], _BATCH_BYTES
            part.append(object_id)
            room -= size
        yield from _contents_of_kind("blob", part, self._read(part, sizes)).items()

    def content(self, digits: str) -> bytes:
        """Return the content of one file, by its id; repeated calls use a cache.

        Raises:
            DocumentError: the file is missing, damaged, or larger than `_MOST_BYTES`.
        """
        return _content_of_file(self, digits)

    def _objects(self, ids: Sequence[str]) -> dict[str, tuple[str, bytes]]:
        """Return type and content of objects, by id; missing objects are left out.

        The content is verified by its hash.

        Raises:
            DocumentError: an object is damaged, or larger than `_MOST_BYTES`.
        """
        known = {object_id: _known.get((self.folder, object_id)) for object_id in ids}
        objects = {object_id: value for object_id, value in known.items() if value}
        unknown = [object_id for object_id in ids if object_id not in objects]
        if unknown:
            objects |= self._read(unknown, self.sizes(unknown))
        return objects

    def _read(self, ids: Sequence[str], sizes: Mapping[str, int]) -> dict[str, tuple[str, bytes]]:
        """Return type and content of objects as git reads them; see `_objects`."""
        for object_id in ids:
            if sizes.get(object_id, 0) > _MOST_BYTES:
                raise DocumentError(f"the object {object_id} is larger than {_MOST_BYTES} bytes")
        asked = "".join(f"{object_id}\n" for object_id in ids).encode()
        data = self._git(["cat-file", "--batch"], stdin=asked)
        objects: dict[str, tuple[str, bytes]] = {}
        at = 0
        for object_id in ids:
            end = data.find(b"\n", at)
            line, at = data[at:end], end + 1
            words = line.decode(errors="replace").split()
            if words[-1:] == ["missing"]:
                continue
            if len(words) != 3 or not words[2].isdecimal():
                raise DocumentError(
                    f"unexpected answer of git: {line[:200].decode(errors='replace')}"
                )
            content = data[at : at + int(words[2])]
            at += len(content) + 1
            if _object_id(words[1], content, len(object_id)) != object_id:
                raise DocumentError(
                    f"the object {object_id} of the repository is damaged",
                    "Its content does not have this hash.",
                    "Clone the repository again.",
                )
            objects[object_id] = words[1], content
            if words[1] != "blob" and len(content) <= _MOST_KNOWN_BYTES:
                if len(_known) >= _CACHE_SIZE:
                    _known.clear()
                _known[self.folder, object_id] = objects[object_id]
        return objects

    # ── fetching ───────────────────────────────────────────────────────────────────────────

    def fetch_missing(self, digits: str, remote: str) -> None:
        """Fetch a missing commit from a remote, without its history.

        The git settings of the clone, the user and the machine apply, because a fetch may need
        credentials from these settings.

        Raises:
            UsageError: ``digits`` is not a full id, ``remote`` is not a remote of the repository,
                or git would read settings in the work tree.
            DocumentError: the commit cannot be fetched.
        """
        if not _HASH.match(digits):
            raise UsageError(f"'{digits}' is not the full id of a commit")
        if remote not in self._ask("remote").split():
            raise UsageError(
                f"'{remote}' is not a remote of the repository", "", "See `git remote`."
            )
        if self.sizes([digits]):
            return
        self._refuse_settings_inside()
        options = (
            *("--quiet", "--depth=1", "--no-tags", "--no-prune", "--no-recurse-submodules"),
            *("--no-auto-maintenance", "--no-write-fetch-head", "--refmap="),
            *("--upload-pack=git-upload-pack", "--", remote, digits),
        )
        self._git(["fetch", *options], environment=_FETCHING_VARIABLES, wait=_WAIT_FOR_SERVER)

    def _refuse_settings_inside(self) -> None:
        """Raise if git would read settings from the work tree.

        Anybody may have written files in the work tree, and a fetch runs programs that settings
        name.

        Raises:
            UsageError: an environment variable names such a file or folder.
        """
        top = self.top()
        if top is None:
            return
        inside = os.path.realpath(top)
        for name in _SETTINGS_VARIABLES:
            place = os.environ.get(name, "")
            if place and Path(os.path.realpath(self.folder / place)).is_relative_to(inside):
                raise UsageError(
                    f"{name} is '{place}', inside of the work tree '{top}'",
                    "Git reads settings there, and a fetch runs programs that they name.",
                    f"Set {name} to a path outside of the work tree, or fetch the commit before "
                    "the review.",
                )

    # ── git ────────────────────────────────────────────────────────────────────────────────

    def top(self) -> Path | None:
        """The top folder of the work tree; None for a repository without work tree."""
        bare = self._ask("rev-parse", "--is-inside-work-tree") != "true"
        shown = b"" if bare else self._git(["rev-parse", "--show-toplevel"]).removesuffix(b"\n")
        return Path(os.fsdecode(shown)) if shown else None

    def prefix(self) -> str:
        """The path from the top of the work tree to the folder, with "/" at its end."""
        return os.fsdecode(self._git(["rev-parse", "--show-prefix"]).removesuffix(b"\n"))

    def _ask(self, *words: str) -> str:
        """Run git and return its output, or "" if git fails."""
        return self._git(words, quiet=True).decode(errors="replace").strip()

    def _git(
        self,
        words: Sequence[str],
        *,
        stdin: bytes = b"",
        quiet: bool = False,
        environment: dict[str, str] | None = None,
        wait: int = _WAIT_SECONDS,
    ) -> bytes:
        """Run git and return its output.

        Args:
            words: the arguments of git.
            stdin: the input of git.
            quiet: do not raise if git fails without a message.
            environment: the environment variables; None for the usual ones.
            wait: the time after which git is ended, in seconds.

        Raises:
            DocumentError: git fails, warns, or does not end in time.
            UnavailableError: git is not installed.
        """
        variables = {
            name: text for name, text in os.environ.items() if name not in _REPOSITORY_VARIABLES
        }
        try:
            done = subprocess.run(
                [_program(variables.get("PATH", os.defpath)), *_SAFE_OPTIONS, *words],
                cwd=self.folder,
                env={**variables, **_COMMON_VARIABLES, **(environment or _READING_VARIABLES)},
                input=stdin,
                capture_output=True,
                timeout=wait,
                check=False,
            )
        except subprocess.TimeoutExpired as error:
            raise DocumentError(f"git does not answer within {wait} seconds") from error
        error_text = done.stderr[:500].decode(errors="replace").strip()
        if done.returncode and (error_text or not quiet):
            why = error_text.removeprefix("fatal: ") or f"exit status {done.returncode}"
            outside = why.startswith("not a git repository")
            remedy = "Start sros in a folder of the repository." if outside else ""
            raise DocumentError(f"git failed: {why}", "", remedy)
        if error_text and not done.returncode and environment is None:
            raise DocumentError(f"git warns: {error_text}", "Its answer may be incomplete.")
        return done.stdout


@lru_cache(maxsize=64)
def _top_folder(repository: Repository, commit: str) -> TreeEntry:
    return TreeEntry(FOLDER, repository.tree(commit))


@lru_cache(maxsize=1024)  # an object with a given id never changes
def _entries_of_folder(repository: Repository, digits: str) -> dict[str, TreeEntry]:
    return repository.folders([digits])[digits]


@lru_cache(maxsize=256)
def _content_of_file(repository: Repository, digits: str) -> bytes:
    return repository.contents([digits])[digits]


def _contents_of_kind(
    kind: str, ids: Sequence[str], objects: Mapping[str, tuple[str, bytes]]
) -> dict[str, bytes]:
    """Return the contents of objects, by id.

    Raises:
        DocumentError: an object is missing, or of another kind.
    """
    for object_id in ids:
        if object_id not in objects:
            raise DocumentError(
                f"the object {object_id} is not in the repository",
                "",
                "Fetch the whole commit, not a partial clone: `git fetch --refetch`.",
            )
        if objects[object_id][0] != kind:
            raise DocumentError(
                f"the object {object_id} is not a {kind}, but a {objects[object_id][0]}"
            )
    return {object_id: objects[object_id][1] for object_id in ids}


def walk(
    repository: Repository, tree: str, *, maximum: int, other: str = ""
) -> Iterator[tuple[str, TreeEntry]]:
    """Yield path and entry of all files, links and submodules below a folder, level by level.

    With ``other``, the id of another folder, entries are left out that both folders have at the
    same path with the same content.

    Raises:
        DocumentError: there are more than ``maximum`` entries (a few objects can stand for
            millions), or too many levels of folders (git has to be asked again for each level).
    """
    level = [("", tree, other)]
    count = depth = 0
    while level:
        depth += 1
        if depth > _MAX_DEPTH:
            raise DocumentError(f"the commit has more than {_MAX_DEPTH} levels of folders")
        ids = [object_id for _, *pair in level for object_id in pair if object_id]
        folders = repository.folders(ids)
        below = []
        for path, here, other_tree in level:
            before = folders[other_tree] if other_tree else {}
            for name, entry in folders[here].items():
                count += 1
                if count > maximum:
                    raise DocumentError(f"there are more than {maximum} files in the commit")
                old = before.get(name)
                if old == entry:
                    continue
                if entry.mode == FOLDER:
                    matching = old.id if old and old.mode == FOLDER else ""
                    below.append((f"{path}{name}/", entry.id, matching))
                else:
                    yield path + name, entry
        level = below


@lru_cache(maxsize=8)
def _program(path: str) -> str:
    """Return the path of the program git, looked up in ``path`` without its relative folders.

    Raises:
        UnavailableError: git is not installed.
    """
    folders = [folder for folder in path.split(os.pathsep) if folder.startswith("/")]
    program = shutil.which("git", path=os.pathsep.join(folders)) if folders else None
    if not program:
        raise UnavailableError("git is not installed", "", "Install git.")
    return program


def _unknown_revision_error(name: str) -> DocumentError:
    return DocumentError(
        f"git finds no revision '{name}'",
        "",
        "`git log --oneline` and `git branch` list revisions. In a shallow clone, as "
        "in CI, first fetch the revision.",
    )


def _candidates_text(candidates: Iterable[str]) -> str:
    return " and ".join(f"'{candidate}'" for candidate in candidates)


def _split_at_blank(line: str) -> tuple[str, str, str]:
    return line.partition(" ")


def _object_id(kind: str, content: bytes, digits: int) -> str:
    git_object = b"%s %d\0%s" % (kind.encode(), len(content), content)
    if digits == 40:
        return hashlib.sha1(git_object, usedforsecurity=False).hexdigest()
    return hashlib.sha256(git_object).hexdigest()


def _header(content: bytes, key: bytes) -> str:
    """Return the object id that follows ``key`` in the first line of a commit or tag.

    Raises:
        DocumentError: the object is malformed.
    """
    first, _, digits = content.partition(b"\n")[0].partition(b" ")
    object_hash = digits.decode(errors="replace")
    if first != key or not _HASH.match(object_hash):
        raise DocumentError("an object of the repository is malformed")
    return object_hash


def _entries(data: bytes, id_length: int) -> dict[str, TreeEntry]:
    """Return the entries of a git tree, by name; ids have ``id_length`` bytes.

    Raises:
        DocumentError: the tree is malformed, has a name twice, or a name that no file can have.
    """
    entries: dict[str, TreeEntry] = {}
    while data:
        head, _, rest = data.partition(b"\0")
        mode, _, raw = head.partition(b" ")
        name, data = os.fsdecode(raw), rest[id_length:]
        if name in entries or name in ("", ".", "..") or "/" in name or name.lower() == ".git":
            raise DocumentError(
                f"a folder of the commit has '{name}' twice, or '{name}' is no valid file name",
                "Programs interpret such a folder in different ways.",
            )
        entries[name] = TreeEntry(_mode_on_checkout(mode), rest[:id_length].hex())
    return entries


_OCTAL = re.compile(rb"[0-7]{1,11}")
_TYPE_BITS, _EXECUTABLE = 0o170000, 0o100


def _mode_on_checkout(mode: bytes) -> str:
    """Return the file mode that git uses when it checks out an entry of a tree.

    ``mode`` is octal.  An entry that is no file, link or folder counts as a submodule. Source: git
    2.39, cache.h (canon_mode).

    Raises:
        DocumentError: the mode is not an octal number.
    """
    if not _OCTAL.fullmatch(mode):
        raise DocumentError("an object of the repository is malformed", "Its file mode is unknown.")
    bits = int(mode, 8)
    file = FILES[bool(bits & _EXECUTABLE)]
    kinds = {0o100000: file, 0o120000: LINK, 0o040000: FOLDER}
    return kinds.get(bits & _TYPE_BITS, SUBMODULE)
