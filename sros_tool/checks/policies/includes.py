"""Checks of the includes of a policy file."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from lxml import etree

from sros_tool.checks.kind import NOTE, WARNING, Finding, FindingKind
from sros_tool.errors import DocumentError, PolicyError
from sros_tool.policy.document import IncludedFile, Includer

_MOST_FILES = 1000

FALLBACK = FindingKind(
    "policy.include-fallback",
    WARNING,
    "an include whose file does not exist",
    "The <xi:fallback> of the include is used instead, so the rights are not the intended ones.",
    "XInclude 1.0, 4.4.",
    "Put the file there, or remove the include.",
)
REDUNDANT_INCLUDE = FindingKind(
    "policy.redundant-include",
    NOTE,
    "an include that adds nothing",
    "The profile already includes the file, directly or through another file.",
    "XInclude 1.0.",
    "Remove the include.",
)
_INCLUDE_TAGS = tuple(f"{{http://www.w3.org/{year}/XInclude}}include" for year in (2001, 2003))


def include_findings(path: Path) -> Iterator[Finding]:
    """Yield findings about the includes of a file; reads an included file only once."""
    graph = _IncludeGraph(Path(os.path.realpath(path)))
    for includes in graph.includes_by_parent():
        reached = {
            included
            for file in {file for _, file in includes}
            for included in graph.included_files(file)
        }
        steps: set[tuple[Path, str]] = set()
        for element, file in includes:
            href, line = element.get("href", ""), element.sourceline
            step = (file, element.get("xpointer", ""))
            if not file.exists():
                yield FALLBACK.found(str(path), f"'{href}' does not exist", str(path), line)
            elif step in steps or file in reached:
                text = f"'{href}' is already included in the same profile by another include"
                yield REDUNDANT_INCLUDE.found(str(path), text, str(path), line)
            steps.add(step)


class _IncludeGraph:
    """The includes of a policy file, and of the files that are included."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._includer = Includer(file.parent)
        self._direct: dict[Path, frozenset[Path]] = {}
        self._reached: dict[Path, frozenset[Path]] = {}

    def includes_by_parent(self) -> Iterator[list[tuple[etree._Element, Path]]]:
        """Yield lists of sibling include elements of the policy file, with the included files."""
        for parent in self._includer.load(self._file).iter():
            includes = list(parent.iterchildren(*_INCLUDE_TAGS))
            if len(includes) <= _MOST_FILES:
                targets = ((element, self._target(self._file, element)) for element in includes)
                yield [(element, file) for element, file in targets if file]

    def included_files(self, file: Path) -> frozenset[Path]:
        """Return the files that a file includes, directly or through other files."""
        if file not in self._reached:
            paths: set[Path] = set()
            waiting = [file]
            while waiting and len(paths) < _MOST_FILES:
                new = self._files_included_by(waiting.pop()) - paths
                paths |= new
                waiting += new
            self._reached[file] = frozenset(paths - {file})
        return self._reached[file]

    def _files_included_by(self, file: Path) -> frozenset[Path]:
        if file not in self._direct:
            try:
                includes = list(self._includer.load(file).iter(*_INCLUDE_TAGS))
            except DocumentError:
                includes = []  # the file is in an unused fallback, or does not exist
            targets = (self._target(file, element) for element in includes)
            self._direct[file] = frozenset(target for target in targets if target)
        return self._direct[file]

    def _target(self, file: Path, element: etree._Element) -> Path | None:
        try:
            return self._includer.target(element, IncludedFile(file))
        except PolicyError:
            return None  # the include is in <metadata>, or in an unused fallback
