"""Reads SROS2 policy XML 0.2.0 into the policy model, strictly.

The grammar is that of the schema of ros2/sros2, and beyond it every name is checked: a rule that
can never match anything is an error, for it is a right or a denial that somebody relies on.
"""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path

from lxml import etree

from sros_tool.errors import InvalidNameError, PolicyError
from sros_tool.names import check_enclave_name, check_namespace, expression_problem
from sros_tool.policy.include import Includer, Place
from sros_tool.policy.model import (
    RIGHTS,
    VERSION,
    Enclave,
    Group,
    Policy,
    Profile,
    Profiles,
    Qualifier,
    Source,
)
from sros_tool.xml import tag_of

_XML_ATTRIBUTES = ("{http://www.w3.org/XML/1998/namespace}",)
_VERSION = re.compile(r"0\.2\.[0-9]+\Z")
_QUALIFIERS = {qualifier.value: qualifier for qualifier in Qualifier}


def read_policy(path: Path, content: bytes | None = None) -> Policy:
    """Read a policy file and its includes, which must lie in its folder or below.

    With ``content``, read that in place of what the file holds; the file need not exist.
    Raises `PolicyError` (or another `DocumentError`) with file and line for anything that the
    format does not have, for names that ROS does not have, and for an enclave given twice.
    """
    return _Reader(path, content).policy()


class _Reader:
    def __init__(self, path: Path, content: bytes | None) -> None:
        self._shown = path
        self._file = Path(os.path.realpath(path))
        self._includer = Includer(self._file.parent)
        if content is not None:
            self._includer.hold(self._file, content)
        elif not self._file.exists():
            raise PolicyError(f"the policy file '{path}' does not exist")

    def policy(self) -> Policy:
        root = self._includer.load(self._file)
        place = Place(self._file)
        where = self._where(root, place)
        if root.tag != "policy":
            raise PolicyError(
                f"{where}: the file is not a policy",
                f"Its root element is <{tag_of(root)}>, not <policy>.",
                "" if root.tag != "profile" else "It is a fragment for other policies to include.",
            )
        self._attributes(root, place, required=("version",))
        version = root.get("version", "")
        if not _VERSION.match(version):
            raise PolicyError(
                f"{where}: the policy has version {version!r}",
                f"sros reads version {VERSION} of the SROS2 policy format.",
                "Version 0.1.0 says contexts and context for enclaves and enclave."
                if version.startswith("0.1")
                else "",
            )
        enclaves: dict[str, Enclave] = {}
        blocks = [self._expect(child, at, "enclaves") for child, at in self._children(root, place)]
        if len(blocks) != 1:
            raise PolicyError(f"{where}: <policy> must hold exactly one <enclaves>")
        for child, at in self._children(*blocks[0]):
            enclave = self._enclave(*self._expect(child, at, "enclave"))
            if enclave.path in enclaves:
                raise PolicyError(
                    f"{enclave.source}: the enclave {enclave.path} is given twice",
                    f"It stands at {enclaves[enclave.path].source} already, and it would not be "
                    "clear which one counts.",
                    "Join the two into one <enclave>.",
                )
            enclaves[enclave.path] = enclave
        if not enclaves:
            raise PolicyError(f"{where}: the policy has no enclave")
        digest = self._includer.digest()
        read = tuple(replace(enclave, digest=digest) for enclave in enclaves.values())
        return Policy(read, version, str(self._shown))

    def _enclave(self, element: etree._Element, place: Place) -> Enclave:
        self._attributes(element, place, required=("path",))
        try:
            path = check_enclave_name(element.get("path", ""))
        except InvalidNameError as error:
            raise PolicyError(
                f"{self._where(element, place)}: {error.what}", error.why, error.remedy
            ) from error
        blocks = tuple(
            self._profiles(*self._expect(child, at, "profiles"))
            for child, at in self._children(element, place)
        )
        if not blocks:
            raise PolicyError(
                f"{self._where(element, place)}: the enclave {path} has no <profiles>"
            )
        return Enclave(path, blocks, self._source(element, place))

    def _profiles(self, element: etree._Element, place: Place) -> Profiles:
        self._attributes(element, place, optional=("type",))
        profiles: list[Profile] = []
        metadata = ""
        for child, at in self._children(element, place):
            if metadata:
                raise PolicyError(f"{self._where(child, at)}: nothing may follow <metadata>")
            if child.tag == "metadata":
                metadata = etree.tostring(child, encoding="unicode", with_tail=False)
            else:
                profiles.append(self._profile(*self._expect(child, at, "profile")))
        if not profiles:
            raise PolicyError(f"{self._where(element, place)}: <profiles> holds no <profile>")
        return Profiles(tuple(profiles), element.get("type", ""), metadata)

    def _profile(self, element: etree._Element, place: Place) -> Profile:
        self._attributes(element, place, required=("ns", "node"))
        node = element.get("node", "")
        try:
            ns = check_namespace(element.get("ns", ""))
        except InvalidNameError as error:
            raise PolicyError(
                f"{self._where(element, place)}: {error.what}", error.why, error.remedy
            ) from error
        if node and ("/" in node or "~" in node or expression_problem(node)):
            raise PolicyError(
                f"{self._where(element, place)}: {node!r} is not a valid node name",
                expression_problem(node)
                or "A node name has no '/' and no '~'; its namespace stands in ns=.",
            )
        groups = tuple(self._group(child, at, node) for child, at in self._children(element, place))
        return Profile(ns, node, groups, self._source(element, place))

    def _group(self, element: etree._Element, place: Place, node: str) -> Group:
        kind = tag_of(element)
        if kind not in RIGHTS:
            raise PolicyError(
                f"{self._where(element, place)}: <profile> cannot hold <{kind}>",
                f"It holds {', '.join(f'<{each}>' for each in RIGHTS)} only.",
            )
        self._attributes(element, place, optional=RIGHTS[kind])
        rights = []
        for right in RIGHTS[kind]:
            value = element.get(right)
            if value is None:
                continue
            if value not in _QUALIFIERS:
                raise PolicyError(
                    f"{self._where(element, place)}: {right}={value!r} is not understood",
                    "A right is ALLOW or DENY.",
                )
            rights.append((right, _QUALIFIERS[value]))
        if not rights:
            raise PolicyError(
                f"{self._where(element, place)}: the <{kind}> neither allow nor deny anything",
                f"They lack {' and '.join(RIGHTS[kind])}.",
                f'Write for example <{kind} {RIGHTS[kind][0]}="ALLOW">, or remove them.',
            )
        item = kind.removesuffix("s")
        items = self._children(element, place)
        names = tuple(self._name(*self._expect(child, at, item), node) for child, at in items)
        if not names:
            raise PolicyError(f"{self._where(element, place)}: the <{kind}> name no {item}")
        lines: tuple[int, ...] = ()
        if all(at.file == place.file for _, at in items):  # names can be included one by one
            lines = tuple(child.sourceline or 0 for child, _ in items)
        return Group(kind, tuple(rights), names, self._source(element, place), lines)

    def _name(self, element: etree._Element, place: Place, node: str) -> str:
        name = element.text or ""
        problem = expression_problem(name)
        if not problem and name.startswith("~") and not node:
            problem = "It is private to a node, and the profile has an empty node name."
        if not problem and name == "/":
            problem = "It is a namespace, not a name."
        if not problem and len(element):
            problem = "It holds other elements."
        if problem:
            raise PolicyError(
                f"{self._where(element, place)}: {name!r} is not a valid {tag_of(element)} name",
                problem,
            )
        self._attributes(element, place)
        return name

    def _children(
        self, element: etree._Element, place: Place
    ) -> list[tuple[etree._Element, Place]]:
        for text in (element.text, *(child.tail for child in element)):
            if text and not text.isspace():
                raise PolicyError(
                    f"{self._where(element, place)}: <{tag_of(element)}> holds loose text",
                    f"{text.strip()[:40]!r} stands between its elements.",
                )
        return list(self._includer.children(element, place))

    def _expect(
        self, element: etree._Element, place: Place, tag: str
    ) -> tuple[etree._Element, Place]:
        if element.tag != tag:
            raise PolicyError(
                f"{self._where(element, place)}: <{tag_of(element)}> stands where <{tag}> must"
            )
        return element, place

    def _attributes(
        self,
        element: etree._Element,
        place: Place,
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
                raise PolicyError(
                    f"{self._where(element, place)}: <{tag_of(element)}> has no attribute {name!r}"
                )
        for name in required:
            if name not in present:
                raise PolicyError(
                    f"{self._where(element, place)}: <{tag_of(element)}> lacks its {name}="
                )

    def _source(self, element: etree._Element, place: Place) -> Source:
        file = place.file
        shown = str(self._shown) if file == self._file else str(file)
        return Source(shown, element.sourceline or 0)

    def _where(self, element: etree._Element, place: Place) -> str:
        return str(self._source(element, place))
