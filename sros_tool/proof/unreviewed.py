"""Files of a commit that a review does not cover, private keys, and files that git converts.

The review fails for some of them, and only names others.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from shlex import quote

from sros_tool.errors import DocumentError, SrosError
from sros_tool.files import policies_dir
from sros_tool.fleet.expansion import read_policy_for
from sros_tool.fleet.robots import Fleet
from sros_tool.keystore.layout import (
    CRL,
    ENCLAVES,
    KEY_FILE,
    OPTIONAL_FILES,
    PUBLIC,
    REQUIRED_FILES,
    ROLES,
    ZENOH_FILES,
    ca_certificate_path,
)
from sros_tool.keystore.template import template_names
from sros_tool.policy.rights import policy_rights
from sros_tool.proof.commit_files import (
    ATTRIBUTES_FILE,
    EXPORT_IGNORE,
    CommitFiles,
    converting_patterns,
    files_including,
    files_used_whole,
    have_same_root,
    is_whole_policy,
    may_be_policy,
    may_include_files,
    may_match,
)
from sros_tool.proof.repository import FILES, LINK, SUBMODULE, TreeEntry
from sros_tool.proof.requirements import KINDS
from sros_tool.proof.review_request import ReviewRequest
from sros_tool.wording import first_few

_Entries = Iterable[tuple[str, TreeEntry]]
_Lines = Iterator[tuple[str, str]]
"""Findings as pairs of a sentence and a path."""
_MOST_CHANGED = 20_000
_MOST_BYTES = 1024 * 1024 * 1024
_MAX_SEARCHED_BYTES = 32 * 1024 * 1024  # of one file; no policy is larger than that
_SIGNATURES = (b"\x1f\x8b", b"PK\x03\x04", b"\xfd7zXZ", b"BZh", b"\x28\xb5\x2f\xfd", b"7z\xbc\xaf")
"""First bytes of files of gzip, ZIP, xz, bzip2, Zstandard and 7z."""
_LONGEST_TARGET_SHOWN = 200  # characters that are shown of a link's target
_PRIVATE_KEY = re.compile(rb"-----BEGIN (?:[A-Z0-9]+ )*PRIVATE KEY-----(?:\s|\\[nr])+[\w+/]")
"""A private key in PEM; a text that only mentions the first line does not match."""
_TEMPLATE_TABLES = ("authorities", "certificates", "permissions", "protection")
_SETTINGS_TABLE = re.compile(
    rf"^[ \t]*\[+(?:{'|'.join((*_TEMPLATE_TABLES, *KINDS, 'robots'))})\b".encode(), re.MULTILINE
)
"""A table of a keystore template, of requirements or of a fleet file."""
_LARGEST_SETTINGS = 1024 * 1024
_VARIABLE_FOLDERS = frozenset({"group_vars", "host_vars"})
"""Folders next to an inventory from which only Ansible reads variables."""
_PRIVATE_KEY_FOUND = (
    "has a private key, which everybody who can read the repository has now: replace it, because "
    "the history of the repository keeps it"
)
_FILES_OF_ENCLAVES = (*REQUIRED_FILES, *OPTIONAL_FILES, *ZENOH_FILES)
_TRUSTED_FILES = (CRL, *map(ca_certificate_path, ROLES))
"""The files of a keystore that all enclaves trust."""


@dataclass(frozen=True)
class UnreviewedFiles:
    """The files of HEAD that a review does not cover; ``base`` is None without a comparison.

    The files that it covers are those that were written for ``head``.
    """

    request: ReviewRequest
    head: CommitFiles
    base: CommitFiles | None

    @cached_property
    def _changed(self) -> Sequence[tuple[str, TreeEntry]]:
        """Paths and entries that HEAD adds or changes; none without BASE."""
        return [*self.head.entries(unlike=self.base)] if self.base else []

    @cached_property
    def _earlier(self) -> Sequence[tuple[str, TreeEntry]]:
        """Paths and entries of BASE that HEAD changes or lacks; none without BASE."""
        return [*self.base.entries(unlike=self.head)] if self.base else []

    @cached_property
    def _excluded(self) -> tuple[str, ...]:
        """Files and folders that are left out, and keystores, of which all files are reviewed."""
        return (*self.request.left_out, *self.request.keystores)

    def is_changed(self, path: str) -> bool:
        """Return whether a file of HEAD differs from BASE, or may differ."""
        try:
            return not self.base or self.base.entry(path) != self.head.entry(path)
        except DocumentError:  # a link is on the path, perhaps only in BASE
            return True

    def converted_by_git(self) -> _Lines:
        """Yield findings on reviewed files that git may change or drop on checkout."""
        for folder in sorted({parent for path in self.head.files for parent in Path(path).parents}):
            path = str(folder / ATTRIBUTES_FILE)
            entry = self.head.entry(path)
            if entry is None or entry.mode not in FILES:
                continue
            patterns = converting_patterns(self.head.repository.content(entry.id))
            below = sorted(file for file in self.head.files if Path(file).is_relative_to(folder))
            for file in below if patterns else ():
                relative = Path(file).relative_to(folder)
                matching = (
                    used
                    for pattern, used in patterns.items()
                    for place in (relative, *(relative.parents if used == EXPORT_IGNORE else ()))
                    if may_match(pattern, str(place))
                )
                if attribute := next(matching, ""):
                    does = "change it in a checkout or archive"
                    # For example, an include may then use its fallback.
                    if attribute == EXPORT_IGNORE:
                        does = "leave it out of an archive"
                    yield f"git may {does} ({attribute} in {path})", file

    def private_keys(self) -> tuple[_Lines, _Lines]:
        """Return findings on private keys in HEAD, in two parts.

        The first part has keys in changed files and in reviewed keystores, the second part has keys
        of other keystores, which were there before.
        """
        entries = dict(self._changed) | {
            path: entry
            for path, entry in self.head.files.items()
            if _is_below(path, self.request.keystores)
        }
        earlier: dict[str, TreeEntry] = {}
        with suppress(SrosError):  # `clauses` says that keys were not searched for
            earlier = {path: e for path, e in self.head.entries() if path.endswith(KEY_FILE)}
        key_files = {**earlier, **entries}
        files = {path: entry.id for path, entry in key_files.items() if entry.mode in FILES}
        paths = [
            path
            for path in self._files_with(_PRIVATE_KEY.search, files)
            if not _is_below(path, self.request.left_out)
        ]
        return (
            ((_PRIVATE_KEY_FOUND, path) for path in paths if path in entries),
            ((_PRIVATE_KEY_FOUND, path) for path in paths if path not in entries),
        )

    def changes_to_review(
        self, reviewed: Sequence[Path], fleet: Fleet | None, *, all_read: bool
    ) -> _Lines:
        """Yield findings on changed policies and keystores that have to be reviewed or left out.

        ``reviewed`` and ``fleet`` are the reviewed policies and the fleet of HEAD. ``all_read``
        says whether all policies that the request names could be read.

        Raises:
            DocumentError: the change has too many files.
        """
        if len(self._changed) > _MOST_CHANGED:
            raise DocumentError(f"the change has more than {_MOST_CHANGED} files")
        common = (policies_dir() / "common").rglob("*.xml")
        shipped = {(part.name, part.read_bytes()) for part in common}
        ids = self._ids((path, e) for path, e in self._changed if path not in self.head.files)
        for path in self._files_with(may_be_policy, ids):
            if (Path(path).name, self.head.repository.content(ids[path])) in shipped:
                continue
            text = (
                "changes and is not reviewed: no reviewed policy uses it. Name it with --policy, "
                f"leave it out with --leave-out {quote(path)}, or delete it"
            )
            if not all_read and any(map(Path(path).is_relative_to, self.request.policies)):
                text = "changes and is not reviewed, because a policy could not be read"
            yield text, path
        for path in self._unreviewed_keystores([*self._changed, *self._earlier]):
            if not self._is_in_head(str(Path(path) / ENCLAVES)):
                continue  # deleted by the change, or without enclaves
            is_top = path == "."  # all files of the repository would belong to it
            review = "move it into a folder" if is_top else "name it with --keystore"
            place = f"{ENCLAVES} --leave-out {PUBLIC}" if is_top else quote(path)
            text = f"is a keystore that changes and is not reviewed: {review}, or leave it out with"
            yield f"{text} --leave-out {place}", path
        for path in self._policies_used_in_part(reviewed, fleet):
            yield "changes and is used only in part: the rest is not reviewed", path
        for path in self._unreviewed_policies_including_changes():
            yield "is not reviewed, and includes a file that changes", path
        for path, entry in self._changed:
            if clause := self._hidden_entry_clause(path, entry):
                yield f"changes and is not reviewed: it is {clause}", path

    def changes_only_named(self) -> _Lines:
        """Yield findings on changed files that do not make the review fail.

        These are files that are too large or packed, and policies that are deleted or renamed.
        """
        names = {entry.id: path for path, entry in self._changed}
        sizes = self.head.repository.sizes(names)
        for path, entry in self._changed:
            if sizes.get(entry.id, 0) > _MAX_SEARCHED_BYTES and entry.mode in FILES:
                yield "changes and is too large to be reviewed", path
        for path in self._files_with(_is_packed, self._ids(self._changed)):
            yield "changes and is an archive, or compressed: the review does not look into it", path
        gone = self._ids((path, e) for path, e in self._earlier if not self._is_in_head(path))
        for path in self._files_with(may_be_policy, gone):
            new = names.get(gone[path])
            yield f"is renamed to '{new}'" if new else "is deleted", path

    def clauses(self) -> Iterator[str]:
        """Yield clauses on the files that were not reviewed, and on a checkout that differs."""
        asked = self.request
        for path in asked.left_out:
            named = [f"'{policy}'" for policy in asked.policies if _is_below(policy, (path,))]
            but = f", except {first_few(named, 3)}," if named else ""
            yield f"policies in '{path}'{but} are not reviewed, as the options say"
        if asked.keystores:
            yield "private keys of keystores are not reviewed"
        try:
            for path in self._unreviewed_keystores(self.head.entries()):
                yield f"'{path}' is a keystore and is not reviewed"
        except SrosError as error:
            yield f"keystores that did not change were not looked for: {error.what}"
        own_template = asked.template and asked.template not in template_names()
        if own_template and self.base and self.is_changed(asked.template):
            yield f"'{asked.template}' changes, and the access that it gives is not compared"
        for path in self._changed_settings():
            yield f"'{path}' changes and is not reviewed"
        for side in filter(None, (self.head, self.base)):
            for path in dict.fromkeys(side.used_fallbacks):
                yield f"'{path}' is not in {side.name}, so the fallback of its include is used"
        parents = asked.repository.parents(asked.head)
        if asked.base and len(parents) > 1 and asked.base not in parents:
            yield (
                "access that a merged branch lost since BASE, and that the merge restores, is not "
                "reported"
            )
        top = asked.repository.top()
        if top and asked.repository.commit("HEAD") != asked.head:
            yield "the commit that is checked out is not the reviewed commit"
        elif top and (differing := self.head.differing_files(top)):
            files = first_few([f"'{path}'" for path in differing], 3)
            yield f"the checkout differs from the reviewed commit: {files}"

    def _policies_used_in_part(
        self, reviewed: Sequence[Path], fleet: Fleet | None
    ) -> Iterator[str]:
        """Yield changed policies that reviewed policies or keystores include only in part."""
        named = {str(path.relative_to(self.head.folder)) for path in reviewed}
        known = {
            path: self.head.written_content(path)
            for path, _ in self._changed
            if path in self.head.files and path not in named
        }
        policies = [path for path, data in known.items() if is_whole_policy(data)]
        yield from self._parts_used_in_part(
            {k: v for k, v in known.items() if k not in policies}, named
        )
        if not policies:
            return
        rights = {r for file in reviewed for r in policy_rights(read_policy_for(file, fleet))}
        for path in policies:
            with suppress(SrosError):
                (file,) = self.head.write_policies(path, placeholders=fleet is not None)
                if rights.issuperset(policy_rights(read_policy_for(file, fleet))):
                    continue
            yield path

    def _parts_used_in_part(
        self, parts: Mapping[str, bytes], named: Iterable[str]
    ) -> Iterator[str]:
        """Yield changed files that the reviewed policies include only in part."""
        files = self.head.files
        whole = files_used_whole(
            named, lambda path: self.head.written_content(path) if path in files else None
        )
        for path, data in parts.items():
            with suppress(SrosError):
                if not may_be_policy(data) or whole.get(path):
                    continue
                before = self.base.entry(path) if self.base else None
                earlier = self.head.repository.content(before.id) if before else data
                if path in whole and have_same_root(earlier, data):
                    continue
            yield path

    def _unreviewed_policies_including_changes(self) -> list[str]:
        """Return policies that are not reviewed and include a file that changes.

        A policy includes only files in its own folder and below.  If no reviewed policy includes
        the file, only policies whose names end with ``.xml`` are found.
        """
        repository, files = self.head.repository, self.head.files
        parts = [
            path
            for path, entry in self._changed
            if (
                may_be_policy(self.head.written_content(path))
                if path in files
                else entry.mode in FILES and not _is_below(path, self.request.left_out)
            )
        ]
        reviewed = {parent for part in parts if part in files for parent in Path(part).parents}
        ids: dict[str, str] = {}
        for folder in sorted({parent for part in parts for parent in Path(part).parents}):
            entry = self.head.entry("" if folder == Path() else str(folder))
            assert entry
            for name, tree_entry in repository.folders([entry.id])[entry.id].items():
                path = str(folder / name)
                may_include = folder in reviewed or name.lower().endswith(".xml")
                if may_include and tree_entry.mode in FILES and not _is_below(path, self._excluded):
                    ids[path] = tree_entry.id
        contents = {
            digits: data for digits, data in self._contents(ids.values()) if may_include_files(data)
        }
        contents_by_path = {
            path: contents[object_id] for path, object_id in ids.items() if object_id in contents
        }
        users = files_including(parts, contents_by_path)
        return sorted(e for e in users if e not in files and is_whole_policy(contents_by_path[e]))

    def _hidden_entry_clause(self, path: str, entry: TreeEntry) -> str:
        """Return a clause on a link or submodule of HEAD that may hide policies, or ""."""
        if entry.mode not in (LINK, SUBMODULE) or _is_below(path, self._excluded):
            return ""
        if entry.mode == SUBMODULE:
            return entry.kind
        repository = self.head.repository
        target = os.fsdecode(repository.content(entry.id))
        with suppress(SrosError):
            place = os.path.normpath(Path(path).parent / target)
            linked = None if _is_below(place, self.request.left_out) else self.head.entry(place)
            if linked and linked.mode in FILES and not may_be_policy(repository.content(linked.id)):
                return ""
        return f"a symbolic link to '{target[:_LONGEST_TARGET_SHOWN]}'"

    def _is_in_head(self, path: str) -> bool:
        with suppress(DocumentError):
            return self.head.entry(path) is not None
        return False

    def _unreviewed_keystores(self, entries: _Entries) -> list[str]:
        """Return keystores and exports with ``entries`` that are neither reviewed nor left out."""
        paths = (path for path, _ in entries if not _is_below(path, self._excluded))
        folders = set(map(_keystore_of_file, paths))
        return sorted(folder or "." for folder in folders if folder is not None)

    def _changed_settings(self) -> list[str]:
        """Return changed files with settings that are not read.

        These are variables of an inventory, and TOML files that have a `_SETTINGS_TABLE`.
        """
        with suppress(SrosError):  # the step on changed files reports the error
            variables = {
                path
                for path, _ in (*self._changed, *self._earlier)
                if self.request.fleet and not _VARIABLE_FOLDERS.isdisjoint(Path(path).parts)
            }
            files = {
                path: entry.id
                for path, entry in self._changed
                if path.endswith(".toml") and path not in self.head.files and entry.mode in FILES
            }
            settings = self._files_with(_SETTINGS_TABLE.search, files, _LARGEST_SETTINGS)
            return sorted(variables.union(settings))
        return []

    def _ids(self, entries: _Entries) -> dict[str, str]:
        """Map the paths of entries that are files, and are not left out, to their ids."""
        return {
            path: entry.id
            for path, entry in entries
            if entry.mode in FILES and not _is_below(path, self.request.left_out)
        }

    def _files_with(
        self,
        fits: Callable[[bytes], object],
        ids: Mapping[str, str],
        largest: int = _MAX_SEARCHED_BYTES,
    ) -> list[str]:
        """Return the sorted paths of the files whose content ``fits``; ``ids`` has all by path."""
        contents = self._contents(ids.values(), largest)
        fitting = {digits for digits, content in contents if fits(content)}
        return sorted(path for path in ids if ids[path] in fitting)

    def _contents(
        self, ids: Iterable[str], largest: int = _MAX_SEARCHED_BYTES
    ) -> Iterator[tuple[str, bytes]]:
        """Yield ids and contents of files that need not be policies; large files are left out."""
        return self.head.repository.contents_in_batches(ids, _MOST_BYTES, largest=largest)


def _keystore_of_file(path: str) -> str | None:
    """Return the keystore or export that a file belongs to, by its path; None for other files."""
    keystore, enclaves, file = f"/{path}".partition(f"/{ENCLAVES}/")
    if enclaves and Path(file).name in _FILES_OF_ENCLAVES:
        return keystore[1:]
    trusted = next((name for name in _TRUSTED_FILES if f"/{path}".endswith(f"/{name}")), "")
    return f"/{path}".removesuffix(f"/{trusted}")[1:] if trusted else None


def _is_packed(content: bytes) -> bool:
    """Return whether a file is an archive, or compressed."""
    return content.startswith(_SIGNATURES) or content[257:262] == b"ustar"


def _is_below(path: str, folders: Iterable[str]) -> bool:
    return any(f"{path}/".startswith(f"{folder}/") for folder in folders)
