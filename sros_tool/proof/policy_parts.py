"""Which files could be policies, or parts of them, and which of these a policy uses as a whole."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from urllib.parse import unquote

from lxml import etree

from sros_tool.errors import DocumentError
from sros_tool.policy.document import FALLBACKS, INCLUDES
from sros_tool.policy.model import RIGHTS
from sros_tool.xml import parse

_OF_POLICIES = (
    *((b"<policy", b"version"), (b"<enclaves", b"path"), (b"<profile", b" ns=")),
    *((b"<topics", b"ALLOW"), (b"<services", b"ALLOW"), (b"<actions", b"ALLOW")),
)
"""What an XML file that is a policy, or a part of one, has, and what follows in it."""
_EBCDIC = b"\x4c\x6f\xa7\x94"
"""The beginning of an XML file in EBCDIC (XML 1.0, appendix F)."""
_ENCODING = re.compile(rb"encoding ?= ?[\"']([^\"']*)")
_READABLE = (b"utf-8", b"utf8", b"utf-16", b"us-ascii", b"ascii", b"iso-8859-", b"windows-125")
_BEFORE = b"\xef\xbb\xbf\xfe\xff \t\r\n"
"""Bytes of byte order marks and white space, which can stand before the first element."""
_BEGIN = 4096
_NAMES = frozenset(kind.removesuffix("s") for kind in RIGHTS)
_WITH_PARTS = ("policy", "enclaves", "enclave", "profiles", "profile", *RIGHTS)
_WHOLE = re.compile(r"(?:xpointer\(/(?:\*|[\w.-]+)(?P<below>/\*)?\))?")
"""An xpointer that selects all of a file, or all below its root element."""


def may_be_policy(content: bytes) -> bool:
    """Return whether a file could be a policy, or a part of one, whatever its name is."""
    text = content.replace(b"\0", b"")  # UTF-16 has a zero in each letter
    if text.startswith(_EBCDIC):
        return True
    if not text.lstrip(_BEFORE).startswith(b"<"):
        return False
    text = b" ".join(text.split())
    encoding = _ENCODING.search(text.partition(b"?>")[0])
    if encoding and not encoding[1].lower().startswith(_READABLE):
        return True  # such as UTF-7, in which no element is readable here
    if any(second in text.partition(first)[2] for first, second in _OF_POLICIES):
        return True
    try:
        return _is_part(parse(content, "the file"))
    except DocumentError:
        return False


def _is_part(root: etree._Element) -> bool:
    """Return whether a document has what policies include, however it is written."""
    below = list(root.iter(etree.Element))
    only_names = below[0] if root.tag in _NAMES else below[1:]
    return (
        any(each.keys() and _gives_access(each) for each in below)
        or (root.tag in _WITH_PARTS and any(each.tag in INCLUDES for each in below))
        or (
            (bool(below[1:]) or root.tag in _NAMES)
            and all(e.tag in _NAMES and e.text for e in only_names)
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
            return any(element.get(each) in ("ALLOW", "DENY") for each in RIGHTS.get(str(kind), ()))


def is_whole_policy(content: bytes) -> bool:
    """Return whether a file is a whole policy, or may be one."""
    if not may_be_policy(content):
        return False
    try:
        return parse(content, "the file").tag in ("policy", "profiles")
    except DocumentError:
        return True


def used_whole(policies: Iterable[str], content: Callable[[str], bytes | None]) -> dict[str, bool]:
    """Map the files that policies use with all that is in them, to whether with the root element.

    Args:
        policies: the paths of the policies.
        content: returns the content of the file at a path; None if there is none.
    """
    found = dict.fromkeys(policies, True)
    left = list(found)
    while left:
        path = left.pop()
        for target, pointer in _includes(path, content(path)):
            whole = _WHOLE.fullmatch(pointer)
            if whole and (target not in found or (not found[target] and not whole["below"])):
                found[target] = not whole["below"]
                left.append(target)
    return found


def includes_files(content: bytes) -> bool:
    """Return whether a file may be XML, which can include others."""
    begin = content[:_BEGIN].replace(b"\0", b"").lstrip(_BEFORE)
    return not begin or begin.startswith((b"<", _EBCDIC))


def users_of(parts: Iterable[str], files: Mapping[str, bytes]) -> set[str]:
    """Return those of some files that include some of the parts, or one that does."""
    includes = {
        path: {target for target, _ in _includes(path, data)} for path, data in files.items()
    }
    found = set(parts)
    while more := {path for path, targets in includes.items() if targets & found} - found:
        found |= more
    return found.difference(parts)


def _includes(path: str, content: bytes | None) -> Iterator[tuple[str, str]]:
    """Yield file and xpointer of the includes of a file that count."""
    try:
        root = parse(content, "the file", instructions=True) if content is not None else None
    except DocumentError:
        return
    for each in root.iter(*INCLUDES) if root is not None else ():
        above = {str(other.tag) for other in each.iterancestors()}
        if not above & {"metadata", *FALLBACKS}:
            name = unquote(each.get("href", ""), errors="surrogateescape")
            target = os.path.normpath(Path(path).parent / name) if name else path
            yield target, each.get("xpointer", "")


def same_root(one: bytes, other: bytes) -> bool:
    """Return whether the root elements of two files have the same name and attributes."""
    try:
        first, second = (parse(each, "the file") for each in (one, other))
    except DocumentError:
        return False
    return first.tag == second.tag and first.items() == second.items()
