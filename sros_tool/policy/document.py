"""Policy files (SROS2 policy XML 0.2.0): reading them with their includes, and writing them.

The grammar follows the schema of ros2/sros2.  In addition, every name is checked: a name that ROS
does not allow is an error, because the author of the policy relies on the right or the denial.

Includes (``xi:include``) are read only from the folder of the policy and the folders below.  An
include is resolved as by libxml2 (XInclude), or refused.  Nodes of included documents are never
moved into another document: a moved lxml node can crash Python.

A processing instruction after a name states how the messages of the name must be protected:
``<topic>scan<?sros protect="encrypt"?></topic>``.  The schema of ros2/sros2 allows neither
attributes nor elements there, but it allows processing instructions everywhere, and the XSLT of
ros2/sros2 ignores their meaning.
"""

from __future__ import annotations

import hashlib
import os
import re
import stat
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from shlex import quote
from typing import NamedTuple
from urllib.parse import unquote

from lxml import etree

from sros_tool.errors import DocumentError, InvalidNameError, PolicyError, UsageError
from sros_tool.names import (
    check_enclave_name,
    check_namespace,
    expression_problem,
    node_name_problem,
)
from sros_tool.policy.model import (
    PROTECT,
    RIGHTS,
    VERSION,
    Enclave,
    Group,
    Level,
    Policy,
    Profile,
    Profiles,
    Qualifier,
    Source,
)
from sros_tool.policy.placeholders import (
    Parts,
    check_name,
    check_path,
    has_placeholder,
    parts_of,
    sample,
)
from sros_tool.values import DryRun, FileChange, FileChanges, Notes
from sros_tool.wording import shortened
from sros_tool.xml import parse, read_bytes, tag_of

_NAMESPACES = ("http://www.w3.org/2001/XInclude", "http://www.w3.org/2003/XInclude")
INCLUDES = frozenset(f"{{{ns}}}include" for ns in _NAMESPACES)
FALLBACKS = frozenset(f"{{{ns}}}fallback" for ns in _NAMESPACES)
_XML_BASE = "{http://www.w3.org/XML/1998/namespace}base"
# libxml2 evaluates any XPath, even one that is made to take minutes, during which no signal ends
# it.
_XPOINTER_STEP = re.compile(
    r"/(?P<tag>\*|[A-Za-z_][\w.-]*)"
    r"(?:\[@(?P<attribute>[A-Za-z_][\w.-]*)(?:=(?P<value>'[^']*'|\"[^\"]*\"))?\])?",
    re.ASCII,
)
_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*:")
NAME_THE_FLEET = (
    "Name the fleet's file with --fleet FILE. If the verb has no --fleet, copy the policy, and "
    "write a robot's name in place of the placeholder. `merge_policy` does not change a policy "
    "with placeholders: write placeholders in the other policy, too, and use both files unmerged."
)
"""The remedy for reading a policy with placeholders without a fleet."""
_MAX_INCLUDES = 10_000
_MAX_DEPTH = 32
_MAX_ELEMENTS = 200_000
_MAX_BYTES = 32 * 1024 * 1024
_MAX_LENGTH = 1000  # characters of a href or an xpointer


class IncludedFile(NamedTuple):
    """A policy file with the includes that lead to it, as pairs of file and xpointer.

    ``linked`` says that the last include names the file by a symbolic link.
    """

    file: Path
    trail: tuple[tuple[Path, str], ...] = ()
    linked: bool = False


class MissingFileError(DocumentError):
    """The policy, or a file that a policy includes, does not exist."""


PolicyFiles = Callable[[Path], bytes]
"""A function that returns the content of a policy file, given the file's path.

The function raises `MissingFileError` if there is no such file, and `DocumentError` if its
existence is not known.
"""


@dataclass(slots=True)
class Includer:
    """A reader of policy files in the folder ``root`` and below.

    A file is read once, but counts for the size limit at every include, because a few small files
    could expand to gigabytes.
    """

    root: Path
    read: PolicyFiles | None = None
    """A function that returns a file's content; None stands for the file system."""
    fallbacks: list[tuple[Source, str]] = field(default_factory=list)
    """The includes that used their fallback, with the path of the missing file."""
    _documents: dict[Path, etree._Element] = field(default_factory=dict)
    _sizes: dict[Path, int] = field(default_factory=dict)
    _real_paths: dict[tuple[Path, str], Path] = field(default_factory=dict)
    """Folder and path in an include → real path of the file; many profiles repeat includes."""
    _includes: int = 0
    _elements: int = 0
    _bytes: int = 0
    _digests: list[bytes] = field(default_factory=list)

    def digest(self) -> str:
        """Return the SHA-256 (hexadecimal) of all files read so far, whatever their order."""
        return hashlib.sha256(b"".join(sorted(self._digests))).hexdigest()

    def load(self, file: Path) -> etree._Element:
        """Return the root element of a policy file; ``file`` is the file's real path."""
        if file not in self._documents:
            read = self.read or (lambda file: read_bytes(file, "policy file"))
            self.use_content(file, read(file))
        self._bytes += self._sizes[file]
        if self._bytes > _MAX_BYTES:
            raise _too_large_error(f"'{file}'", f"{_MAX_BYTES // 1024**2} MiB")
        return self._documents[file]

    def use_content(self, file: Path, content: bytes) -> None:
        """Use ``content`` for the file with this real path, also in includes."""
        root = parse(content, f"the policy file '{file}'", instructions=True)
        _check_instructions(root, file)
        self._documents[file] = root
        self._sizes[file] = len(content)
        self._digests.append(hashlib.sha256(content).digest())

    def children(
        self, parent: etree._Element, place: IncludedFile
    ) -> Iterator[tuple[etree._Element, IncludedFile]]:
        """Yield each child of ``parent`` with its file; included elements replace includes."""
        return self._expanded(parent, place)

    def target(self, element: etree._Element, place: IncludedFile) -> Path:
        """Return the real path of the file that an include names; the file may be missing.

        Raises:
            PolicyError: the file is outside of the policy's folder, or other XInclude processors
                would search for the file in another place.
        """
        where = _line(element, place)
        href = element.get("href", "")
        path = unquote(href, errors="surrogateescape")
        if "\0" in path or len(href) > _MAX_LENGTH:
            raise PolicyError(f"{where}: the include of {shortened(href)} is not a valid path")
        if any(child.get(_XML_BASE) is not None for child in (element, *element.iterancestors())):
            raise PolicyError(
                f"{where}: the include of {shortened(href)} is below an xml:base",
                "sros resolves an include from the folder of the file that contains it.",
                f"Remove the xml:base, and write the path from '{place.file.parent}'.",
            )
        if place.linked and href:
            raise PolicyError(
                f"{where}: the include of {shortened(href)} is in a file that is included by a "
                "link",
                "It is unclear whether the path starts at the link or at the file.",
                f"Include '{place.file}' itself instead of the link.",
            )
        names = path.split("/")
        up = next((index for index, name in enumerate(names) if name not in ("..", ".")), 0)
        if "#" in href or "?" in href or ".." in names[up:]:
            raise PolicyError(
                f"{where}: the include of {shortened(href)} is not a plain path",
                "'#', '?', and '..' after the name of a folder can be understood in two ways.",
                "Write the shortest path to the file, with %23 and %3F for '#' and '?' in names.",
            )
        if not href:
            return place.file
        folder = place.file.parent
        file = self._real_paths.get((folder, path))
        if file is None:
            # Unlike Path.resolve, realpath does not fail on circular links.
            file = self._real_paths[folder, path] = Path(os.path.realpath(folder / path))
        if _SCHEME.match(href) or not file.is_relative_to(self.root):
            raise PolicyError(
                f"{where}: the include of {shortened(href)} leaves the folder of the policy",
                f"Includes are read only from '{self.root}' and the folders below it.",
                "Copy the file there, or move the policy to a folder above both files.",
            )
        return file

    def _expanded(
        self, elements: Iterable[etree._Element], place: IncludedFile
    ) -> Iterator[tuple[etree._Element, IncludedFile]]:
        for child in elements:
            if isinstance(child, etree._ProcessingInstruction):
                continue
            if child.tag in INCLUDES:
                yield from self._included(child, place)
                continue
            self._elements += 1
            if self._elements > _MAX_ELEMENTS:
                raise _too_large_error(_line(child, place), f"{_MAX_ELEMENTS} elements")
            yield child, place

    def _included(
        self, element: etree._Element, place: IncludedFile
    ) -> Iterator[tuple[etree._Element, IncludedFile]]:
        where = _line(element, place)
        self._includes += 1
        if self._includes > _MAX_INCLUDES or len(place.trail) >= _MAX_DEPTH:
            raise PolicyError(
                f"{where}: there are too many includes, or they are nested too deeply",
                f"At most {_MAX_INCLUDES} are read, and they may be nested {_MAX_DEPTH} deep.",
                "Write the rights themselves in place of some includes.",
            )
        if element.get("parse", "xml") != "xml":
            raise PolicyError(
                f"{where}: an include of plain text is not accepted",
                "It could put any readable file into a signed document.",
                "Include policy XML, without parse=.",
            )
        inside = [child for child in element if isinstance(child.tag, str)]
        if len(inside) > 1 or (inside and inside[0].tag not in FALLBACKS):
            raise PolicyError(
                f"{where}: an include can contain only one <fallback>", "", "Remove the rest."
            )
        for part in (element, *inside):
            _refuse_loose_text(part, where)
        href, pointer = element.get("href", ""), element.get("xpointer", "")
        file = self.target(element, place)
        if inside and not self._exists(file):
            self.fallbacks.append((Source(str(place.file), element.sourceline or 0), str(file)))
            yield from self.children(inside[0], place)
            return
        step = (file, pointer)
        if step in place.trail:
            raise PolicyError(f"{where}: the include of {shortened(href)} leads back to itself")
        try:
            target = self.load(file)
        except DocumentError as error:
            remedy = error.remedy or ("" if _file_exists(file) else _missing_remedy(file))
            raise PolicyError(f"{where}: {error.what}", error.why, remedy) from error
        parent = element.getparent()
        if not pointer and href and parent is not None and parent.tag == target.tag:
            include = f"{element.prefix}:include" if element.prefix else "include"
            selected = f'xpointer="xpointer(/{tag_of(target)}/*)"'
            raise PolicyError(
                f"{where}: the include of {shortened(href)} lacks {selected}",
                f"Without xpointer, a <{tag_of(target)}> would be in a <{tag_of(target)}>.",
                f'Write <{include} href="{href}" {selected}/>.',
            )
        linked = bool(href) and Path(os.path.normpath(place.file.parent / unquote(href))) != file
        inner = IncludedFile(file, (*place.trail, step), linked)
        included = self._expanded([target], inner)
        yield from self._selected(included, pointer, where) if pointer else included

    def _exists(self, file: Path) -> bool:
        if self.read is None:
            return _file_exists(file)
        try:
            self.load(file)
        except MissingFileError:
            return False
        return True

    def _selected(
        self, roots: Iterator[tuple[etree._Element, IncludedFile]], pointer: str, where: str
    ) -> list[tuple[etree._Element, IncludedFile]]:
        """Return the elements, with their files, that an xpointer selects in expanded documents."""
        path = pointer.removeprefix("xpointer(").removesuffix(")")
        steps = list(_XPOINTER_STEP.finditer(path[:_MAX_LENGTH]))
        if f"xpointer({''.join(step[0] for step in steps)})" != pointer or not steps:
            raise PolicyError(
                f"{where}: the xpointer {shortened(pointer)} is not accepted",
                "It can be a path of elements, each a name or *, with [@attribute] or "
                "[@attribute='value'] after it.",
                "Write for example xpointer(/profile/*), xpointer(/policy/enclaves/*) or "
                "xpointer(/policy/enclaves/enclave[@path='/talker']).",
            )
        selected: Iterable[tuple[etree._Element, IncludedFile]] = roots
        for depth, step in enumerate(steps):
            if depth:
                for parent, at in selected:
                    if tag_of(parent) not in _NAME_TAGS:
                        _refuse_loose_text(parent, _line(parent, at))
                selected = (child for parent in selected for child in self.children(*parent))
            selected = [child for child in selected if _matches_step(child[0], step)]
        if not selected:
            raise PolicyError(
                f"{where}: the xpointer {shortened(pointer)} selects nothing",
                "The included file has no element at this path.",
                "Write the path from the root element of the included file.",
            )
        return list(selected)


COMMON = "common"
"""Name of the folder with the fragments that shipped policies include."""


def _file_exists(file: Path) -> bool:
    """Return whether a file exists; False for a name that is too long for the file system."""
    return os.path.exists(file)  # noqa: PTH110 - Path.exists raises for such a name


def _missing_remedy(file: Path) -> str:
    """Return a sentence on how to get an included file that ships with sros, or ""."""
    # Reading policies must not import modules that write files.
    from sros_tool.files import policies_dir

    tail = file.parts[file.parts.index(COMMON) :] if COMMON in file.parts else ()
    if not tail or not policies_dir().joinpath(*tail).is_file():
        return ""
    place = Path(*file.parts[: len(file.parts) - len(tail) + 1])
    return f"It ships with sros. Put it there: `sros policies --copy {quote(str(place))}`."


_NAME_TAGS = frozenset(kind.removesuffix("s") for kind in RIGHTS)
_INSTRUCTION = "sros"
_PROTECT_EXAMPLE = 'Write for example <topic>scan<?sros protect="encrypt"?></topic>.'
_PROTECT = re.compile(r"""protect\s*=\s*(?:"(?P<double>[^"]*)"|'(?P<single>[^']*)')\s*\Z""")


def _check_instructions(root: etree._Element, file: Path) -> None:
    """Raise `PolicyError` if a processing instruction for sros is not inside a name element."""
    outside = (*root.itersiblings(preceding=True), *root.itersiblings())
    for instruction in (*outside, *root.iter(etree.PI)):
        if not isinstance(instruction, etree._ProcessingInstruction):
            continue
        parent = instruction.getparent()
        named = parent is not None and tag_of(parent) in _NAME_TAGS
        if not named and (instruction.target or "").lower() == _INSTRUCTION:
            raise PolicyError(
                f"{file}:{instruction.sourceline}: <?{_INSTRUCTION} ...?> is not in a name",
                "Protection can be stated only in the element of a topic, service or action.",
                _PROTECT_EXAMPLE,
            )


def _refuse_loose_text(element: etree._Element, where: str) -> None:
    """Raise `PolicyError` if there is text between the elements in ``element``."""
    for text in (element.text, *(child.tail for child in element)):
        if text and not text.isspace():
            raise PolicyError(
                f"{where}: <{etree.QName(element).localname}> contains loose text",
                f"{text.strip()[:40]!r} is between its elements.",
            )


def _matches_step(element: etree._Element, step: re.Match[str]) -> bool:
    if step["tag"] not in ("*", element.tag):
        return False
    value = element.get(step["attribute"]) if step["attribute"] else ""
    return value is not None and step["value"] in (None, f"'{value}'", f'"{value}"')


def _line(element: etree._Element, place: IncludedFile) -> str:
    return f"{place.file}:{element.sourceline}"


def _too_large_error(where: str, limit: str) -> PolicyError:
    return PolicyError(
        f"{where}: the policy and its includes are too large",
        f"They have more than {limit}; a file counts each time it is included.",
        "Divide the policy, or include smaller files.",
    )


_XML_ATTRIBUTES = ("{http://www.w3.org/XML/1998/namespace}",)
_VERSION = re.compile(r"0\.2\.[0-9]+\Z")
_REMEDY_FOR_0_1 = (
    "Version 0.1.0, of ROS 2 Crystal to Eloquent, has nodes in place of enclaves: write each "
    '<profile> into <enclaves><enclave path="/NAME"><profiles>.'
)
_REQUIRED_ATTRIBUTES = {
    "version": '<policy version="0.2.0">',
    "path": 'path="/NAME", with the name of the enclave',
    "ns": 'ns="/", or the namespace of the node',
    "node": 'node="NAME", with the name of the node',
}
"""Required attribute → remedy text that shows what to write."""
_QUALIFIERS = {qualifier.value: qualifier for qualifier in Qualifier}


def read_policy(
    path: Path,
    content: bytes | None = None,
    *,
    placeholders: bool = False,
    policy_files: PolicyFiles | None = None,
    may_be_empty: bool = False,
) -> Policy:
    """Read a policy file with its includes, which must be in its folder or below.

    For a folder, the policies in it are read as one policy.

    Args:
        path: the path of the file, or of a folder of policies.
        content: the content of the file, if it is not to be read from ``path``.
        placeholders: accept placeholders (`sros_tool.policy.placeholders`) in names; they are not
            filled in, so only `sros_tool.fleet.expansion` can use the policy.
        policy_files: returns the content of included files that are not in the file system.
        may_be_empty: accept a file without enclaves, to which the caller adds enclaves.

    Raises:
        PolicyError: (with file and line, if possible) the file cannot be read, is no XML or
            violates the format, a name is not a valid ROS name, or an enclave is defined twice.
    """
    try:
        if content is None and policy_files is None and os.path.isdir(path):  # noqa: PTH112 - as `_file_exists`
            return _read_folder(path, placeholders=placeholders)
        reader = _Reader(path, content, placeholders=placeholders, policy_files=policy_files)
        reader.may_be_empty = may_be_empty
        return reader.policy()
    except PolicyError:
        raise
    except DocumentError as error:
        raise PolicyError(error.what, error.why, error.remedy) from error


def _read_folder(path: Path, *, placeholders: bool) -> Policy:
    files = list(files_of_policies(path))
    if not files:
        raise PolicyError(f"'{path}' holds no policy", "", "Name a policy, or a folder of them.")
    joined = join_policies([read_policy(file, placeholders=placeholders) for file in files])
    return replace(joined, file=str(path))


def refuse_fallbacks(policy: Policy) -> None:
    """Raise `PolicyError` if an include of a policy used its fallback because a file is missing."""
    for source, file in policy.fallbacks:
        raise PolicyError(
            f"{source}: the fallback of the include is used, because '{file}' is absent",
            "On a machine that has the file, the policy may give other rights.",
            "Add the file, or put the rights of the fallback in the place of the include.",
        )


class _Reader:
    may_be_empty = False

    def __init__(
        self,
        path: Path,
        content: bytes | None,
        *,
        placeholders: bool = False,
        policy_files: PolicyFiles | None = None,
    ) -> None:
        self._shown = path
        self._placeholders = placeholders
        self._owner: Parts = ()
        """The path of the current enclave if it contains placeholders."""
        self._file = Path(os.path.realpath(path))
        self._includer = Includer(self._file.parent, policy_files)
        if content is not None:
            self._includer.use_content(self._file, content)
        elif policy_files is None and not os.path.exists(self._file):  # noqa: PTH110 - False for a name that is too long
            raise PolicyError(f"the policy file '{path}' does not exist")

    def policy(self) -> Policy:
        root, place = self._root()
        where = self._place_text(root, place)
        self._check_attributes(root, place, required=("version",))
        version = root.get("version", "")
        if not _VERSION.match(version):
            raise PolicyError(
                f"{where}: the policy has version {shortened(version)}",
                f"sros reads version {VERSION} of the SROS2 policy format.",
                _REMEDY_FOR_0_1
                if version == "0.1.0"
                else f'If the policy has that format, write version="{VERSION}".',
            )
        children = self._read_children(root, place)
        blocks = [self._expect(child, at, "enclaves") for child, at in children]
        if len(blocks) != 1:
            raise PolicyError(f"{where}: <policy> must contain exactly one <enclaves>")
        return self._read_policy(*blocks[0], version)

    def _root(self) -> tuple[etree._Element, IncludedFile]:
        root = self._includer.load(self._file)
        place = IncludedFile(self._file)
        if root.tag != "policy":
            remedies = {
                "profile": "It is a fragment for other policies to include.",
                "profiles": _REMEDY_FOR_0_1,
            }
            raise PolicyError(
                f"{self._place_text(root, place)}: the file is not a policy",
                f"Its root element is <{tag_of(root)}>, not <policy>.",
                remedies.get(tag_of(root), ""),
            )
        return root, place

    def _read_policy(self, element: etree._Element, place: IncludedFile, version: str) -> Policy:
        """Return the policy whose enclaves are the children of ``element``."""
        enclaves: dict[str, Enclave] = {}
        for child, at in self._read_children(element, place):
            enclave = self._read_enclave(*self._expect(child, at, "enclave"))
            if enclave.path in enclaves:
                raise PolicyError(
                    f"{enclave.source}: the enclave {enclave.path} is defined twice",
                    f"It is already defined at {enclaves[enclave.path].source}, so it is "
                    "unclear which definition applies.",
                    "Join the two into one <enclave>.",
                )
            enclaves[enclave.path] = enclave
        if not enclaves and not self.may_be_empty:
            raise PolicyError(f"'{self._shown}': the policy has no enclave")
        digest = self._includer.digest()
        read = tuple(replace(enclave, digest=digest) for enclave in enclaves.values())
        return Policy(read, version, str(self._shown), tuple(self._includer.fallbacks))

    def _read_enclave(self, element: etree._Element, place: IncludedFile) -> Enclave:
        self._check_attributes(element, place, required=("path",))
        path = element.get("path", "")
        self._owner = self._parts(path, element, place) or ()
        try:
            check_enclave_name(sample(self._owner) if self._owner else path)
        except InvalidNameError as error:
            raise self._invalid_name_error(error, path, "enclave name", element, place) from error
        blocks = tuple(
            self._read_profiles(*self._expect(child, at, "profiles"))
            for child, at in self._read_children(element, place)
        )
        if not blocks:
            raise PolicyError(
                f"{self._place_text(element, place)}: the enclave {path} has no <profiles>"
            )
        return Enclave(path, blocks, self._source_of(element, place))

    def _invalid_name_error(
        self,
        error: InvalidNameError,
        written: str,
        label: str,
        element: etree._Element,
        place: IncludedFile,
    ) -> PolicyError:
        """Return the error for a name that is invalid, whatever its placeholders stand for.

        ``written`` is the name as in the file.  ``label`` is "enclave name" or "namespace".
        """
        where = self._place_text(element, place)
        if not has_placeholder(written):
            return PolicyError(f"{where}: {error.what}", error.why, error.remedy)
        remedy = ""
        if written.startswith("{robot"):
            fixes = [written.replace("{robot", "{namespace", 1)] if label == "namespace" else []
            remedy = f"Write {' or '.join(map(shortened, (*fixes, f'/{written}')))}."
        return PolicyError(
            f"{where}: {shortened(written)} is not a valid {label}", error.why, remedy
        )

    def _read_profiles(self, element: etree._Element, place: IncludedFile) -> Profiles:
        self._check_attributes(element, place, optional=("type",))
        profiles: list[Profile] = []
        metadata = ""
        for child, at in self._read_children(element, place):
            if metadata:
                raise PolicyError(f"{self._place_text(child, at)}: nothing may follow <metadata>")
            if child.tag == "metadata":
                etree.strip_tags(child, etree.ProcessingInstruction)
                metadata = etree.tostring(child, encoding="unicode", with_tail=False)
            else:
                profiles += _with_absolute_namespaces(
                    self._read_profile(*self._expect(child, at, "profile"))
                )
        if not profiles:
            raise PolicyError(
                f"{self._place_text(element, place)}: <profiles> contains no <profile>"
            )
        return Profiles(tuple(profiles), element.get("type", ""), metadata)

    def _read_profile(self, element: etree._Element, place: IncludedFile) -> Profile:
        self._check_attributes(element, place, required=("ns", "node"))
        node, ns = element.get("node", ""), element.get("ns", "")
        sampled = self._example_name(node, element, place, several=False)
        try:
            checked = check_namespace(self._example_name(ns, element, place, several=False))
            ns = ns.removesuffix("/") if has_placeholder(ns) else checked
        except InvalidNameError as error:
            raise self._invalid_name_error(error, ns, "namespace", element, place) from error
        if sampled and (problem := node_name_problem(sampled)):
            raise PolicyError(
                f"{self._place_text(element, place)}: {shortened(node)} is not a valid node name",
                problem,
            )
        groups = tuple(
            group
            for child, at in self._read_children(element, place)
            for group in self._read_groups(child, at, node)
        )
        return Profile(ns, node, groups, self._source_of(element, place))

    def _read_groups(
        self, element: etree._Element, place: IncludedFile, node: str
    ) -> Iterator[Group]:
        """Yield the groups for an XML group: a group for each protection level of its names."""
        kind = tag_of(element)
        if kind not in RIGHTS:
            raise PolicyError(
                f"{self._place_text(element, place)}: <profile> cannot contain <{kind}>",
                f"It can contain only {', '.join(f'<{word}>' for word in RIGHTS)}.",
                f'Write it in <{kind}s {RIGHTS[f"{kind}s"][0]}="ALLOW"> or '
                f'<{kind}s {RIGHTS[f"{kind}s"][1]}="ALLOW">.'
                if kind in _NAME_TAGS
                else "",
            )
        self._check_attributes(element, place, optional=RIGHTS[kind])
        rights = []
        for right in RIGHTS[kind]:
            value = element.get(right)
            if value is None:
                continue
            if value not in _QUALIFIERS:
                raise PolicyError(
                    f"{self._place_text(element, place)}: {right}={shortened(value)} is not valid",
                    "A right is ALLOW or DENY.",
                    f"Write {_meant_attribute(right, value)}.",
                )
            rights.append((right, _QUALIFIERS[value]))
        if not rights:
            raise PolicyError(
                f"{self._place_text(element, place)}: <{kind}> neither allows nor denies anything",
                f"It has neither {'= nor '.join(RIGHTS[kind])}=.",
                f'Write for example <{kind} {RIGHTS[kind][0]}="ALLOW">, or remove it.',
            )
        item = kind.removesuffix("s")
        items = self._read_children(element, place)
        by_level: dict[Level | None, list[tuple[str, int]]] = {}
        for child, at in items:
            name = self._name(*self._expect(child, at, item), node)
            by_level.setdefault(self._read_protection(child, at), []).append(
                (name, child.sourceline or 0)
            )
        if not by_level:
            raise PolicyError(
                f"{self._place_text(element, place)}: <{kind}> names no {item}",
                "",
                f"Remove the element, or name one: <{item}>NAME</{item}>.",
            )
        # The names of a group can come from different files by includes.
        is_one_file = all(at.file == place.file for _, at in items)
        for level, members in by_level.items():
            names, lines = tuple(name for name, _ in members), tuple(line for _, line in members)
            source = self._source_of(element, place)
            yield Group(kind, tuple(rights), names, level, source, lines if is_one_file else ())

    def _read_protection(self, element: etree._Element, place: IncludedFile) -> Level | None:
        """Return the protection level stated for a name, or None."""
        if not len(element):
            return None
        where = self._place_text(element, place)
        instruction = element[0]
        if (
            len(element) > 1
            or not isinstance(instruction, etree._ProcessingInstruction)
            or instruction.target != _INSTRUCTION
            or instruction.tail
        ):
            raise PolicyError(
                f"{where}: the processing instructions of a name are not valid",
                "Only one <?sros ...?> is allowed, directly between the name and its end tag. A "
                "misspelled instruction would leave the name without protection.",
                _PROTECT_EXAMPLE,
            )
        stated = _PROTECT.match((instruction.text or "")[:_MAX_LENGTH].lstrip())
        word = (stated["double"] or stated["single"] or "") if stated else ""
        if word not in PROTECT:
            raise PolicyError(
                f"{where}: <?sros {shortened(instruction.text or '')[1:-1]}?> is not a protection",
                "It can be " + " or ".join(f'protect="{known}"' for known in PROTECT) + ".",
                _PROTECT_EXAMPLE,
            )
        return PROTECT[word]

    def _name(self, element: etree._Element, place: IncludedFile, node: str) -> str:
        name = element.text or ""
        sampled = self._example_name(name, element, place, several=True)
        inner = next((child for child in element if isinstance(child.tag, str)), None)
        if inner is None and not name:
            self._read_protection(element, place)  # refuses an instruction before the name
        problem = (
            expression_problem(sampled)
            if inner is None
            else f"It contains <{etree.QName(inner).localname}>, and a name is text."
        )
        if not problem and name.startswith("~") and not node:
            problem = "A name with ~ is private to a node, and the profile has an empty node name."
        if problem:
            where, tag = self._place_text(element, place), tag_of(element)
            written = name.strip()
            meant = [written] if written else [str(value) for value in element.attrib.values()]
            valid = [text for text in meant if text != name and not expression_problem(text)]
            raise PolicyError(
                f"{where}: {shortened(name)} is not a valid {tag} name",
                problem,
                f"Write <{tag}>{valid[0] if valid else 'NAME'}</{tag}>."
                if valid or not written
                else "",
            )
        self._check_attributes(element, place)
        return name

    def _example_name(
        self, text: str, element: etree._Element, place: IncludedFile, *, several: bool
    ) -> str:
        """Return a name with example values for its placeholders, to check its grammar.

        With ``several``, a placeholder may stand for the names of several robots.
        """
        parts = self._parts(text, element, place, several=several)
        return sample(parts) if parts else text

    def _parts(
        self,
        text: str,
        element: etree._Element,
        place: IncludedFile,
        *,
        several: bool | None = None,
    ) -> Parts | None:
        """Return the texts and placeholders of a name; None if it has no placeholder.

        ``several`` says whether a placeholder may stand for the names of several robots; None means
        that the text is the path of an enclave.
        """
        if not has_placeholder(text):
            return None
        where = self._place_text(element, place)
        try:
            parts = parts_of(text)
            if several is None:
                check_path(parts)
            else:
                check_name(parts, self._owner, several=several)
        except ValueError as error:
            raise PolicyError(f"{where}: {shortened(text)} cannot be used", str(error)) from error
        if self._placeholders:
            return parts
        raise PolicyError(
            f"{where}: {shortened(text)} has a placeholder for the robots of a fleet",
            "Without a fleet it has no value.",
            NAME_THE_FLEET,
        )

    def _read_children(
        self, element: etree._Element, place: IncludedFile
    ) -> list[tuple[etree._Element, IncludedFile]]:
        _refuse_loose_text(element, self._place_text(element, place))
        return list(self._includer.children(element, place))

    def _expect(
        self, element: etree._Element, place: IncludedFile, tag: str
    ) -> tuple[etree._Element, IncludedFile]:
        if element.tag != tag:
            actual = tag_of(element)
            elsewhere = f", or move it into <{actual}s>" if actual in _NAME_TAGS else ""
            raise PolicyError(
                f"{self._place_text(element, place)}: <{actual}> found, but <{tag}> expected",
                "",
                f"Write <{tag}> in its place{elsewhere}."
                if tag in _NAME_TAGS
                else f"Write <{tag}> in its place, or around it.",
            )
        return element, place

    def _check_attributes(
        self,
        element: etree._Element,
        place: IncludedFile,
        *,
        required: tuple[str, ...] = (),
        optional: tuple[str, ...] = (),
    ) -> None:
        present = element.keys()
        for name in present:
            if (
                name not in required
                and name not in optional
                and not name.startswith(_XML_ATTRIBUTES)
            ):
                where = self._place_text(element, place)
                known = ", ".join(f"{word}=" for word in (*required, *optional))
                remedy = (
                    f"It has {known}." if known else "Remove the attribute: this element has none."
                )
                if etree.QName(name).localname == "protect":
                    remedy = _PROTECT_EXAMPLE
                what = f"{where}: <{tag_of(element)}> has no attribute {shortened(name)}"
                raise PolicyError(what, "", remedy)
        for name in required:
            if name not in present:
                raise PolicyError(
                    f"{self._place_text(element, place)}: <{tag_of(element)}> lacks its {name}=",
                    "",
                    f"Write {_REQUIRED_ATTRIBUTES[name]}.",
                )

    def _source_of(self, element: etree._Element, place: IncludedFile) -> Source:
        file = place.file
        shown = str(self._shown) if file == self._file else str(file)
        return Source(shown, element.sourceline or 0)

    def _place_text(self, element: etree._Element, place: IncludedFile) -> str:
        return str(self._source_of(element, place))


def _meant_attribute(right: str, value: str) -> str:
    """Return the attribute that was probably meant by an invalid ``value`` such as "allow"."""
    meant = value.strip().upper()
    words = [meant] if meant in _QUALIFIERS else list(_QUALIFIERS)
    return " or ".join(f'{right}="{word}"' for word in words)


def _with_absolute_namespaces(profile: Profile) -> tuple[Profile, ...]:
    """Return equivalent profiles whose namespaces begin with "/".

    Every ROS name begins with "/". So a ``*`` at the beginning of a namespace matches either
    nothing before a "/", or a text that begins with "/".
    """
    below = profile.ns.lstrip("*")
    if below == profile.ns:
        return (profile,)
    wide = replace(profile, ns=f"/*{below}")
    narrow = [replace(profile, ns=below or "/")] if below[:1] in ("", "/") else []
    return (*narrow, wide)


# ── shipped policies ───────────────────────────────────────────────────────────────────────


class PolicyFile(NamedTuple):
    """A policy that ships with sros."""

    file: Path
    """Path of the policy file."""
    enclaves: Sequence[str]
    """Paths of the enclaves in the policy."""


class ShippedPolicies(NamedTuple):
    """The policies that ship with sros."""

    policies: Sequence[PolicyFile]
    """The policies that ship with sros, by file."""


class CopiedPolicies(NamedTuple):
    """The result of copying policies."""

    folder: Path
    """Path of the folder with the copies."""
    dry_run: DryRun
    changes: FileChanges
    notes: Notes


def copy_policies(source: Path, target: Path, *, dry_run: bool = False) -> list[FileChange]:
    """Copy a folder of policies, or only of common fragments, and return the changed files.

    Existing files stay unchanged.

    Raises:
        UsageError: ``target`` is not a folder, or a file in it differs from the copy; then nothing
            is copied.
    """
    from sros_tool.files import new_files, write_new_folder

    if target.absolute().name == COMMON:
        source = source / COMMON
    shipped = (file for file in sorted(source.rglob("*")) if file.is_file())
    files = {str(file.relative_to(source)): read_bytes(file, "file") for file in shipped}
    exists = os.path.lexists(target)
    if exists and not target.is_dir():
        raise UsageError(
            f"'{target}' is not a folder", "", "Name a new folder, or an existing one."
        )
    present = [name for name in files if os.path.lexists(target / name)]
    for name in present:
        path = target / name
        if not path.is_file() or read_bytes(path, "file") != files[name]:
            raise UsageError(
                f"'{path}' differs from the file that ships with sros",
                "Existing files are not replaced, and nothing was copied.",
                "Name another folder, or move the file away.",
            )
    missing = {name: data for name, data in files.items() if name not in present}
    if missing and not dry_run:
        if exists:
            with new_files(target, missing):
                pass
        else:
            write_new_folder(target, missing)
    return [FileChange("create", str(target / name)) for name in missing]


_PROTECT_WORDS = {level: word for word, level in PROTECT.items()}


def instruction_text(protect: Level | None) -> str:
    """Return the processing instruction for a protection level, or "" for None."""
    return f'<?{_INSTRUCTION} protect="{_PROTECT_WORDS[protect]}"?>' if protect else ""


def policy_xml(policy: Policy) -> bytes:
    """Return the policy as XML (UTF-8) that `read_policy` reads as an equal policy."""
    root = etree.Element("policy", version=policy.version)
    enclaves = etree.SubElement(root, "enclaves")
    metadata: list[tuple[etree._Element, str]] = []
    protected: list[tuple[etree._Element, Level]] = []
    for enclave in policy.enclaves:
        element = etree.SubElement(enclaves, "enclave", path=enclave.path)
        for block in enclave.profiles:
            profiles = etree.SubElement(element, "profiles")
            if block.type:
                profiles.set("type", block.type)
            for profile in block.profiles:
                protected += _write_profile(profiles, profile)
            if block.metadata:
                metadata.append((profiles, block.metadata))
    etree.indent(root, space="  ")
    # The instructions are added after the indentation, which would change texts and names with
    # them.
    for item, level in protected:
        item.append(etree.PI(_INSTRUCTION, f'protect="{_PROTECT_WORDS[level]}"'))
    for profiles, text in metadata:
        last, element = profiles[-1], parse(text.encode(), "metadata")
        last.tail, element.tail = profiles.text, last.tail
        profiles.append(element)
    return etree.tostring(root, xml_declaration=True, encoding="UTF-8") + b"\n"


def checked_text(
    policy: Policy, output: Path | None, label: str, *, placeholders: bool = False
) -> bytes:
    """Return the policy as XML, checked to be read as an equal policy.

    Args:
        policy: the policy.
        output: the file that the caller will write, or None.
        label: the origin of the policy for errors, such as "narrowed".
        placeholders: whether names may have the placeholders of a fleet.

    Raises:
        PolicyError: the XML would be read as a different policy.
    """
    document = policy_xml(policy)
    if output and read_policy(output, document, placeholders=placeholders) != policy:
        raise PolicyError(
            f"the {label} policy changes when it is written and read again",
            "Nothing was written.",
            "This is a defect of sros: please report it with the policy.",
        )
    return document


def _write_profile(
    parent: etree._Element, profile: Profile
) -> Iterator[tuple[etree._Element, Level]]:
    """Append a profile to the XML; yield the elements of names with a protection level."""
    element = etree.SubElement(parent, "profile", ns=profile.ns, node=profile.node)
    for group in profile.groups:
        child = etree.SubElement(element, group.kind)
        for right, qualifier in group.rights:
            child.set(right, qualifier)
        for name in group.names:
            item = etree.SubElement(child, group.kind.removesuffix("s"))
            item.text = name
            if group.protect:
                yield item, group.protect


# ── folders of policies ────────────────────────────────────────────────────────────────────


_MOST_LEVELS = 100
_MOST_FILES = 10_000
_MAX_SEARCHED_BYTES = 256 * 1024
"""Size in bytes of the largest file without the ending ``.xml`` in which a policy is looked for."""


def join_policies(policies: Sequence[Policy]) -> Policy:
    """Return a policy with the enclaves of all ``policies`` (at least one policy).

    Policies may share enclaves by including them from the same place.

    Raises:
        PolicyError: two policies state the same enclave in different places.
    """
    enclaves: dict[str, Enclave] = {}
    for enclave in (enclave for policy in policies for enclave in policy.enclaves):
        earlier = enclaves.setdefault(enclave.path, enclave)
        # The line alone does not tell enclaves apart: it can have several, and libxml2 stops
        # counting at 65,535.
        if earlier.source != enclave.source or earlier != enclave:
            raise PolicyError(
                f"{enclave.source}: enclave {enclave.path} is in another policy, too",
                f"The other enclave is at {earlier.source}.",
                "Name only policies of one robot, and state each enclave in one of them.",
            )
    fallbacks = tuple(fallback for policy in policies for fallback in policy.fallbacks)
    return replace(policies[0], enclaves=tuple(enclaves.values()), fallbacks=fallbacks)


def files_of_policies(folder: Path) -> Iterator[Path]:
    """Yield the paths of the policies in a folder and below it, sorted; for a file, its own path.

    Fragments that policies only include are left out.

    Raises:
        DocumentError: a file that may be a policy cannot be read, is not XML, or has a name without
            the ending ``.xml``; a link leads to a folder; or there are too many files.
    """
    if not folder.is_dir():
        yield folder
        return
    for count, path in enumerate(_files_below(folder)):
        if count >= _MOST_FILES:
            raise DocumentError(
                f"'{folder}' has more than {_MOST_FILES} files", "", "Name a policy in it."
            )
        if is_policy(path.name, _content(path), f"'{path}'"):
            yield path


def is_policy(name: str, content: bytes, shown: str) -> bool:
    """Return whether a file with this name and content is a policy.

    ``shown`` is the name of the file in errors.

    Raises:
        DocumentError: the file looks like a policy, but its name does not end with ``.xml``, or its
            content is not valid XML.
    """
    if name.lower().endswith(".xml"):
        return parse(content, shown, instructions=True).tag == "policy"
    # Without zero bytes, the text can be found in UTF-16, too.
    begin = content[:_MAX_SEARCHED_BYTES].replace(b"\0", b"")
    if begin.lstrip(b"\xef\xbb\xbf\xff\xfe \t\r\n").startswith(b"<") and b"<policy" in begin:
        raise DocumentError(
            f"{shown} looks like a policy, but its name does not end with .xml",
            "In a folder, sros reads only policies whose names end with .xml.",
            "Give it a name that ends with .xml, or move it out of the folder.",
        )
    return False


def _files_below(folder: Path) -> Iterator[Path]:
    """Yield the regular files in a folder and its subfolders, sorted.

    Raises:
        DocumentError: a folder cannot be read, or a link leads to a folder.
    """

    def fail(error: OSError) -> None:
        raise DocumentError(f"'{error.filename}' cannot be read", str(error.strerror)) from error

    for parent, folders, files in os.walk(folder, onerror=fail):
        if len(Path(parent).parts) - len(folder.parts) > _MOST_LEVELS:
            raise DocumentError(
                f"'{folder}' has more than {_MOST_LEVELS} levels of folders",
                "",
                "Name a policy in it.",
            )
        folders[:] = sorted(name for name in folders if name != ".git")  # the files of git itself
        for subfolder in (Path(parent, name) for name in folders):
            if subfolder.is_symlink():
                raise DocumentError(
                    f"'{subfolder}' is a link to a folder, which sros does not follow",
                    "The policies in it would not count.",
                    "Name that folder itself, or remove the link.",
                )
        for path in (Path(parent, name) for name in sorted(files)):
            try:
                mode = path.stat().st_mode
            except OSError as error:
                raise DocumentError(f"'{path}' cannot be read", str(error.strerror)) from error
            if stat.S_ISREG(mode):
                yield path


def _content(path: Path) -> bytes:
    if path.suffix.lower() == ".xml":
        return read_bytes(path, "policy file")
    try:
        with path.open("rb") as file:
            return file.read(_MAX_SEARCHED_BYTES)
    except OSError as error:
        raise DocumentError(f"'{path}' cannot be read", str(error.strerror)) from error
