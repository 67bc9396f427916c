"""Resolves the ``xi:include`` elements of a policy without ever leaving its root folder.

Included documents are read into the model where they lie; their nodes are never moved into
another document (a moved node of lxml can crash the interpreter).
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import unquote

from lxml import etree

from sros_tool.errors import DocumentError, PolicyError
from sros_tool.xml import parse, read_bytes, tag_of

_NAMESPACES = ("http://www.w3.org/2001/XInclude", "http://www.w3.org/2003/XInclude")
_INCLUDES = frozenset(f"{{{ns}}}include" for ns in _NAMESPACES)
_FALLBACKS = frozenset(f"{{{ns}}}fallback" for ns in _NAMESPACES)
_XPOINTER = re.compile(r"xpointer\((.+)\)\Z", re.DOTALL)
_MAX_INCLUDES = 10_000
_MAX_DEPTH = 32
_MAX_BYTES = 64 * 1024 * 1024


@dataclass(frozen=True, slots=True)
class Place:
    """A document, and the includes through which it was reached."""

    file: Path
    trail: tuple[tuple[Path, str], ...] = ()


@dataclass(slots=True)
class Includer:
    """Reads documents below ``root``, each of them once."""

    root: Path
    _documents: dict[Path, etree._Element] = field(default_factory=dict)
    _count: int = 0
    _bytes: int = 0
    _digests: list[bytes] = field(default_factory=list)

    def digest(self) -> str:
        """The SHA-256, hexadecimal, of all documents read so far, whatever their order."""
        return hashlib.sha256(b"".join(sorted(self._digests))).hexdigest()

    def load(self, file: Path) -> etree._Element:
        """The root element of a document (its real path)."""
        if file not in self._documents:
            self.hold(file, read_bytes(file, "policy file"))
        return self._documents[file]

    def hold(self, file: Path, content: bytes) -> None:
        """Take ``content`` for what the file (its real path) holds, wherever it is included."""
        self._bytes += len(content)
        if self._bytes > _MAX_BYTES:
            raise PolicyError(
                f"the policy and its includes are too large at '{file}'",
                f"Together they have more than {_MAX_BYTES // 1024**2} MiB.",
            )
        self._documents[file] = parse(content, f"the policy file '{file}'")
        self._digests.append(hashlib.sha256(content).digest())

    def children(
        self, parent: etree._Element, place: Place
    ) -> Iterator[tuple[etree._Element, Place]]:
        """The child elements of ``parent`` with includes replaced by what they stand for."""
        for child in parent:
            if child.tag in _INCLUDES:
                yield from self._included(child, place)
            else:
                yield child, place

    def _included(
        self, element: etree._Element, place: Place
    ) -> Iterator[tuple[etree._Element, Place]]:
        where = f"{place.file}:{element.sourceline}"
        self._count += 1
        if self._count > _MAX_INCLUDES or len(place.trail) >= _MAX_DEPTH:
            raise PolicyError(f"{where}: there are too many includes, or they are nested too deep")
        if element.get("parse", "xml") != "xml":
            raise PolicyError(
                f"{where}: an include of plain text is not accepted",
                "It would put any readable file into a signed document.",
                "Include policy XML, without parse=.",
            )
        href, pointer = element.get("href", ""), element.get("xpointer", "")
        fallback = next((each for each in element if each.tag in _FALLBACKS), None)
        file = self._resolve(href, place, where)
        if fallback is not None and not file.exists():
            yield from self.children(fallback, place)
            return
        step = (file, pointer)
        if step in place.trail:
            raise PolicyError(f"{where}: the include of '{href}' leads back to itself")
        try:
            target = self.load(file)
        except DocumentError as error:
            raise PolicyError(f"{where}: {error.what}", error.why, error.remedy) from error
        inner = Place(file, (*place.trail, step))
        found = [target] if not pointer else _point(target, pointer, where)
        for each in found:
            # What an xpointer selects may itself be an include.
            if each.tag in _INCLUDES:
                yield from self._included(each, inner)
            else:
                yield each, inner

    def _resolve(self, href: str, place: Place, where: str) -> Path:
        if not href:
            return place.file
        path = Path(unquote(href))
        try:
            # Unlike Path.resolve, realpath does not fail at links that lead in a circle.
            file = Path(os.path.realpath(place.file.parent / path))
        except (OSError, ValueError) as error:
            raise PolicyError(f"{where}: the include of {href!r} names no file") from error
        if "://" in href or href.startswith("file:") or not file.is_relative_to(self.root):
            raise PolicyError(
                f"{where}: the include of '{href}' leaves the folder of the policy",
                f"Includes are read from '{self.root}' and the folders below it only.",
                "Copy the file there, or put the policy at the top of both.",
            )
        return file


def _point(target: etree._Element, pointer: str, where: str) -> list[etree._Element]:
    match = _XPOINTER.match(pointer)
    try:
        found = target.getroottree().xpath(match[1]) if match else None
    except etree.XPathError:
        found = None
    if not isinstance(found, list) or not all(isinstance(e, etree._Element) for e in found):
        raise PolicyError(
            f"{where}: the xpointer {pointer!r} is not understood",
            "It must select elements by an XPath.",
            'Write for example xpointer="xpointer(/profile/*)".',
        )
    if not found:
        raise PolicyError(
            f"{where}: the xpointer {pointer!r} selects nothing",
            f"The root element of the included file is <{tag_of(target)}>.",
        )
    return found
