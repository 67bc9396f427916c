"""The only XML reader and writer of sros: no entities, no network access, limited size."""

from __future__ import annotations

import errno
import os
import re
import stat
from functools import cache
from pathlib import Path
from typing import BinaryIO

from lxml import etree

from sros_tool.errors import DocumentError
from sros_tool.terminal import log_step

MAX_BYTES = 16 * 1024 * 1024
"""Largest document that is read, in bytes."""
_MAX_MARKUP = 400_000
"""Limit on tags and attributes: even a short one takes libxml2 over 100 bytes of memory."""


@cache
def _parser(instructions: bool) -> etree.XMLParser:
    return etree.XMLParser(
        resolve_entities=False,
        no_network=True,
        load_dtd=False,
        dtd_validation=False,
        huge_tree=False,
        remove_comments=True,
        remove_pis=not instructions,
    )


def read_bytes(
    path: Path, label: str, *, owner: int | None = None, max_bytes: int = MAX_BYTES
) -> bytes:
    """Return the content of a regular file of at most ``max_bytes`` bytes (default: 16 MiB).

    ``label`` describes the file in errors, such as "policy".  A file whose size is 0 counts as
    empty, also a file of the kernel (proc(5)), which may have no end.  With ``owner``, a user id,
    the file has to belong to that user.

    Raises:
        DocumentError: the file does not exist, cannot be read, is too large or not a regular file.
    """
    return read_file(path, label, owner=owner, max_bytes=max_bytes)[1]


def read_file(
    path: Path, label: str, *, owner: int | None = None, max_bytes: int = MAX_BYTES
) -> tuple[os.stat_result, bytes]:
    """Return the fstat(2) of a regular file, and its content as `read_bytes` does."""
    try:
        # The file type is checked first, because opening a pipe would wait for its writer.
        state, data = path.stat(), b""
        if stat.S_ISREG(state.st_mode) and 0 < state.st_size <= max_bytes:
            state, data = _stat_and_read(path, max_bytes)
        if not stat.S_ISREG(state.st_mode):
            raise DocumentError(f"the {label} '{path}' is not a regular file")
        if owner not in (None, state.st_uid):
            raise DocumentError(
                f"the {label} '{path}' belongs to another user",
                f"It belongs to user {state.st_uid}, not to user {owner}.",
            )
    except (OSError, ValueError) as error:
        number = getattr(error, "errno", errno.ENOENT)  # ValueError: the path contains a NUL
        if number in (errno.ENOENT, errno.ENOTDIR, errno.ELOOP):
            raise DocumentError(f"the {label} '{path}' does not exist") from error
        why = why_unreadable(path, number)
        raise DocumentError(f"the {label} '{path}' cannot be read", why) from error
    if max(state.st_size, len(data)) > max_bytes:
        limit = f"{max_bytes >> 20} MiB" if max_bytes >> 20 else f"{max_bytes} bytes"
        raise DocumentError(
            f"the {label} '{path}' is too large",
            f"It has more than {limit}.",
        ) from OSError(errno.EFBIG, os.strerror(errno.EFBIG), str(path))
    log_step("DEBUG", __name__, "read the %s '%s', %d bytes", label, path, len(data))
    return state, data


def why_unreadable(path: Path, number: int | None) -> str:
    """Return a sentence on why a file cannot be read; ``number`` is the errno(3) of the attempt."""
    barred = [folder for folder in path.absolute().parents if not os.access(folder, os.X_OK)]
    if number == errno.EACCES and barred:
        return f"The folder '{barred[-1]}' cannot be entered: {os.strerror(number)}."
    return f"{os.strerror(number or errno.EIO)}."


def _stat_and_read(path: Path, max_bytes: int) -> tuple[os.stat_result, bytes]:
    """Return the fstat(2) of a file, and its first ``max_bytes`` + 1 bytes.

    The content is empty for anything but a regular file, such as a pipe that just replaced the
    file.
    """
    descriptor = _nonblocking_descriptor(path)
    try:
        state = os.fstat(descriptor)
        if not stat.S_ISREG(state.st_mode):
            return state, b""
        parts, left = [], max_bytes + 1
        while left and (part := os.read(descriptor, min(left, max(state.st_size + 1, 4096)))):
            parts.append(part)
            left -= len(part)
        return state, b"".join(parts)
    finally:
        os.close(descriptor)


def open_without_waiting(path: Path) -> BinaryIO:
    """Open a file for reading without waiting, even a pipe without a writer."""
    return open(_nonblocking_descriptor(path), "rb")


def _nonblocking_descriptor(path: Path) -> int:
    return os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)


_UTF_8_NAMES = ("UTF-8", "UTF8", "US-ASCII", "ASCII")


def parse(
    data: bytes, name: str, *, as_bytes: bool = False, instructions: bool = False
) -> etree._Element:
    """Return the root element of an XML document, without comments and processing instructions.

    ``name`` names the document in errors.  ``as_bytes`` is for documents that DDS reads: vendors
    read bytes whatever the declared encoding is, so that only UTF-8 means the same to all.  With
    ``instructions``, the document keeps its processing instructions.

    Raises:
        DocumentError: the document is not well-formed or is too large; it has a document type
        declaration (entities could read other files); or, with ``as_bytes``, it has another
        encoding.
    """
    if not data.strip():
        raise DocumentError(f"{name} is empty", "An XML document was expected.")
    if data.count(b"<") + (data.count(b'"') + data.count(b"'")) // 2 > _MAX_MARKUP:
        raise DocumentError(
            f"{name} is too large", f"It has more than {_MAX_MARKUP} tags and attributes."
        )
    try:
        root = etree.fromstring(data, _parser(instructions))
    except (etree.XMLSyntaxError, ValueError) as error:
        why = getattr(error, "msg", "") or str(error)
        raise DocumentError(f"{name} is not well-formed XML", f"{why}.") from error
    if root is None:
        raise DocumentError(f"{name} has no element", "An XML document was expected.")
    if root.getroottree().docinfo.doctype:
        raise DocumentError(
            f"{name} has a document type declaration",
            "It is not accepted, because entities could pull other files into a signed document.",
            "Remove the <!DOCTYPE ...> line.",
        )
    encoding = root.getroottree().docinfo.encoding or "UTF-8"
    # The library libxml2 before 2.14 returns the declared encoding.
    if b"\0" in data and encoding.upper() in _UTF_8_NAMES:
        encoding = "UTF-16"
    if as_bytes and encoding.upper() not in _UTF_8_NAMES:
        raise DocumentError(
            f"{name} is not in UTF-8",
            f"It has the encoding {encoding}, but DDS vendors read all documents as UTF-8, so "
            "they could read other rights than you wrote.",
            "Write it in UTF-8.",
        )
    return root


def require_child(root: etree._Element, tag: str, name: str, label: str) -> etree._Element:
    """Return the child ``tag`` of the root ``<dds>`` of a document.

    In errors, ``name`` names the document, and ``label`` its kind.

    Raises:
        DocumentError: the root has another name, or no such child.  DDS vendors compare names
            literally, so a name with a prefix or in a namespace is a different name.
    """
    child = root.find(tag)
    if root.tag == "dds" and child is not None:
        return child
    space = etree.QName(root).namespace
    why = f"<dds><{tag}> is missing."
    if space and root.prefix:
        prefix = f"the prefix {root.prefix}: (as <{root.prefix}:dds>)"
        why = f"Its elements have {prefix}, which DDS does not know."
    elif space:
        why = (
            f"Its elements are in the namespace {space} (xmlns), but elements of DDS have no "
            "namespace."
        )
    elif root.tag != "dds":
        why = f"It begins with <{tag_of(root)}>, and not with <dds><{tag}>."
    raise DocumentError(f"{name} is not a {label} document", why)


def tag_of(element: etree._Element) -> str:
    """Return the tag of an element as a string."""
    return str(element.tag)


# `xml.sax.saxutils` has these, too, but imports an HTTP client: a fifth of a node's start.


_NOT_IN_XML = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]")


def escape(text: str) -> str:
    """Escape a text for use as the content of an XML element.

    Raises:
        DocumentError: the text has a character that no XML document can have.
    """
    if match := _NOT_IN_XML.search(text):
        raise DocumentError(
            f"{text!a} cannot be written in XML",
            f"It has the character U+{ord(match[0]):04X}, which no XML document can have.",
            "Choose another name.",
        )
    return text.replace("&", "&amp;").replace(">", "&gt;").replace("<", "&lt;")


def quoted(text: str) -> str:
    """Escape a text as the value of an XML attribute, including the quotation marks."""
    text = escape(text).replace("\n", "&#10;").replace("\r", "&#13;").replace("\t", "&#9;")
    if '"' in text and "'" not in text:
        return f"'{text}'"
    return '"' + text.replace('"', "&quot;") + '"'
