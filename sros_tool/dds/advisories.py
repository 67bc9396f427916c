"""Known vulnerabilities of DDS products, as advisories in the OSV format.

The advisories that ship with sros are in ``advisories.json`` next to this module: for each release
line of Fast DDS, they repeat the git history of eProsima/Fast-DDS (as of 2026-08-20).  An event
``fixed`` names the first release with the fix.  A release line without a fix has no such event, so
all later releases of the line count as affected until newer advisories name a fix.

``database_specific`` has three members.  ``needs`` is the precondition of an attack: ``security``
(DDS Security is on), ``identity`` (a certificate of the keystore's CA), ``document`` (a document
that the permissions CA signed) or nothing but the network.  ``gives`` is the effect of the attack:
``denial``, ``memory``, ``access`` or ``unclear``.  ``unclear_lines`` are release lines that may be
affected, because the history says nothing about them.

Source: https://ossf.github.io/osv-schema.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from sros_tool.errors import DocumentError
from sros_tool.values import parse_json
from sros_tool.xml import read_bytes

_SHIPPED_FILE = Path(__file__).with_name("advisories.json")
_REPOSITORIES = {
    "github.com/eprosima/fast-dds": "Fast DDS",
    "github.com/eclipse-cyclonedds/cyclonedds": "Cyclone DDS",
    "github.com/eclipse-zenoh/zenoh": "Zenoh",
}
PRODUCTS = tuple(_REPOSITORIES.values())
"""The products that sros knows from advisories."""
_MOST_BYTES = 4 * 1024 * 1024
_MOST_ADVISORIES = 10_000
_ADVISORY_ID = re.compile(r"[A-Za-z][A-Za-z0-9]*(?:-[A-Za-z0-9]+){1,6}", re.ASCII)
_VERSION = re.compile(r"v?(\d{1,6})(?:\.(\d{1,6}))?(?:\.(\d{1,6}))?(?:\.0)?", re.ASCII)
_LONGEST_ID, _LONGEST_SUMMARY = 60, 200

Version = tuple[int, int, int]


class _Range(NamedTuple):
    """The releases from ``introduced`` up to ``end`` (None: all later releases).

    ``inclusive`` says whether ``end`` itself is in the range.
    """

    introduced: Version
    end: Version | None
    inclusive: bool

    def has(self, version: Version) -> bool:
        """Return whether a release is in the range."""
        if version < self.introduced:
            return False
        return self.end is None or version < self.end or (self.inclusive and version == self.end)


class Advisory(NamedTuple):
    """A known vulnerability of one product.

    ``ranges`` and ``versions`` are the affected releases.  ``needs`` and ``gives`` are words of
    ``database_specific``.  ``unclear_lines`` are release
    lines, such as 2.14, that may be affected.  ``unread`` are the listed versions that do not
    consist of three numbers, such as release candidates; `affects` ignores them.
    """

    id: str
    product: str
    summary: str
    needs: tuple[str, ...]
    gives: str
    ranges: tuple[_Range, ...]
    versions: frozenset[Version]
    unclear_lines: tuple[str, ...]
    unread: tuple[str, ...] = ()

    def affects(self, version: Version) -> bool:
        """Return whether a release has the vulnerability."""
        return version in self.versions or any(part.has(version) for part in self.ranges)

    def fixed_in(self, version: Version) -> str:
        """Return the first fixed release of the same major version; "" if there is none."""
        ends = {None if part.inclusive else part.end for part in self.ranges if part.has(version)}
        last = max((end for end in ends if end), default=None)
        if last is None or None in ends or last[0] != version[0] or self.affects(last):
            return ""
        return ".".join(map(str, last))

    def with_releases_of(self, other: Advisory) -> Advisory:
        """Return this advisory with the releases of ``other`` added; both have the same id."""
        return self._replace(
            ranges=self.ranges + other.ranges,
            versions=self.versions | other.versions,
            unclear_lines=self.unclear_lines + other.unclear_lines,
            unread=self.unread + other.unread,
        )


class KnownVulnerabilities(NamedTuple):
    """The advisories about one release of a product.

    ``known`` advisories affect the release; ``unclear`` advisories may affect it.
    """

    known: tuple[Advisory, ...]
    unclear: tuple[Advisory, ...]


def known_vulnerabilities(
    product: str, version: str, advisories: Iterable[Advisory] | None = None
) -> KnownVulnerabilities | None:
    """Return the advisories about a release, such as "2.14.5" of "Fast DDS".

    If ``advisories`` is None, the advisories that ship with sros are used.  Returns None if the
    version cannot be read, or if no advisory is about the product.
    """
    numbers = version_numbers(version)
    advisories_of_library = [
        advisory
        for advisory in (shipped_advisories() if advisories is None else advisories)
        if advisory.product == product
    ]
    if numbers is None or not advisories_of_library:
        return None
    known = tuple(advisory for advisory in advisories_of_library if advisory.affects(numbers))
    unclear = tuple(
        advisory
        for advisory in advisories_of_library
        if not advisory.affects(numbers)
        and _release_line(product, numbers) in advisory.unclear_lines
    )
    return KnownVulnerabilities(known, unclear)


def version_numbers(version: str) -> Version | None:
    """Return the three numbers of a release such as "2.14.5"; None if it has another form."""
    numbers = _VERSION.fullmatch(version)
    if not numbers or numbers[3] is None:
        return None
    return int(numbers[1]), int(numbers[2]), int(numbers[3])


@cache
def shipped_advisories() -> tuple[Advisory, ...]:
    """Return the advisories that ship with sros."""
    return parse_advisories(_SHIPPED_FILE.read_bytes(), "the advisories of sros")


def read_advisories(path: Path) -> tuple[Advisory, ...]:
    """Return the advisories in a file, and the advisories that ship with sros.

    An advisory in the file replaces the shipped advisory with the same id, for the products that
    the file names.

    Raises:
        DocumentError: the file cannot be read, is not in the OSV format, or has no advisory about a
            product that sros knows.
    """
    newer = parse_advisories(read_bytes(path, "advisories", max_bytes=_MOST_BYTES), f"'{path}'")
    if not newer:
        *products, last = _REPOSITORIES.values()
        raise DocumentError(
            f"'{path}' has no advisory about {', '.join(products)} or {last}",
            "sros recognizes these products by their repositories.",
            f"Write a repository such as {next(iter(_REPOSITORIES))} as the name of the package, "
            "or as `repo` of a range.",
        )
    replaced = {(advisory.id, advisory.product) for advisory in newer}
    kept = (old for old in shipped_advisories() if (old.id, old.product) not in replaced)
    return (*kept, *newer)


def parse_advisories(data: bytes, label: str) -> tuple[Advisory, ...]:
    """Return the advisories in OSV records; ``label`` is the name of ``data`` in errors.

    Records with the same id become one advisory, with the releases of all these records.  Withdrawn
    records count as affecting no release.  Products that sros does not know are left out.

    Raises:
        DocumentError: the data is not in the OSV format, or states no releases of a known product.
    """
    try:
        value = parse_json(data)
        records = value if isinstance(value, list) else [value]
        if len(records) > _MOST_ADVISORIES:
            raise ValueError(f"it has more than {_MOST_ADVISORIES} advisories")
        merged: dict[tuple[str, str], Advisory] = {}
        for record in records:
            for advisory in _advisories_of(_object(record, "an advisory")):
                key = advisory.id, advisory.product
                earlier = merged.get(key)
                merged[key] = earlier.with_releases_of(advisory) if earlier else advisory
        return tuple(merged.values())
    except ValueError as error:
        reason = str(error).partition("\n")[0][:_LONGEST_SUMMARY]
        raise DocumentError(
            f"{label} is not in the OSV format: {reason}",
            "",
            "Give a JSON file with an OSV record, or with a list of them.",
        ) from error


def _advisories_of(record: Mapping[str, Any]) -> Iterator[Advisory]:
    identity = record.get("id")
    if (
        not isinstance(identity, str)
        or len(identity) > _LONGEST_ID
        or not _ADVISORY_ID.fullmatch(identity)
    ):
        raise ValueError("an advisory has no id such as CVE-2025-62599")
    is_withdrawn = bool(_text(record.get("withdrawn") or "", "withdrawn"))
    aliases = _list(record.get("aliases", []), "aliases")
    cve = (name for name in aliases if isinstance(name, str) and re.fullmatch(_CVE, name))
    database_data = _object(record.get("database_specific", {}), "database_specific")
    by_product: dict[str, list[Mapping[str, Any]]] = {}
    for part in _objects(record.get("affected", []), "affected"):
        if product := _product(part):
            by_product.setdefault(product, []).append(part)
    name = identity if identity.startswith("CVE-") else next(cve, identity)
    for product, parts in by_product.items():
        ranges: list[_Range] = []
        versions: set[Version] = set()
        unread: list[str] = []
        for part in () if is_withdrawn else parts:
            new_ranges = list(_ranges(part, identity))
            listed = _texts(part.get("versions", []), "versions")
            numbers = {text: version_numbers(text) for text in listed}
            new_versions = set(filter(None, numbers.values()))
            if not new_ranges and not new_versions:
                raise ValueError(f"{identity} does not say which releases of {product} it affects")
            ranges += new_ranges
            versions |= new_versions
            unread += (text for text, version in numbers.items() if version is None)
        yield Advisory(
            name,
            product,
            _text(record.get("summary", ""), "summary"),
            tuple(_texts(database_data.get("needs", []), "needs")),
            _text(database_data.get("gives", "unclear"), "gives"),
            tuple(ranges),
            frozenset(versions),
            tuple(_texts(database_data.get("unclear_lines", []), "unclear_lines")),
            tuple(unread),
        )


_CVE = re.compile(r"CVE-\d{4}-\d{4,9}", re.ASCII)


def _product(affected: Mapping[str, Any]) -> str:
    """Return the product of an OSV ``affected`` entry, by package or repository; "" if unknown."""
    names = [_object(affected.get("package", {}), "package").get("name", "")]
    names += [part.get("repo", "") for part in _objects(affected.get("ranges", []), "ranges")]
    for name in names:
        plain = re.sub(r"^https?://|(?:\.git)?/?$", "", str(name)).lower()
        if plain in _REPOSITORIES:
            return _REPOSITORIES[plain]
    return ""


def _ranges(affected: Mapping[str, Any], identity: str) -> Iterator[_Range]:
    for part in _objects(affected.get("ranges", []), "ranges"):
        kind = part.get("type")
        if kind == "GIT":
            continue  # a range of git commits: the releases are listed in ``versions``
        if kind not in ("SEMVER", "ECOSYSTEM") or not part.get("events"):
            raise ValueError(
                f"a range of {identity} is not of type GIT, SEMVER or ECOSYSTEM, or has no events"
            )
        introduced: Version | None = None
        for event in _objects(part.get("events", []), "events"):
            for name, version in event.items():
                if name == "introduced":
                    introduced = introduced or _numbers(version, identity)
                elif name in ("fixed", "last_affected"):
                    end = _numbers(version, identity)
                    if introduced is None or end < introduced:
                        raise ValueError(f"the events of {identity} are not in order")
                    yield _Range(introduced, end, name == "last_affected")
                    introduced = None
        if introduced is not None:
            yield _Range(introduced, None, inclusive=False)


def _numbers(version: object, identity: str) -> Version:
    numbers = _VERSION.fullmatch(version) if isinstance(version, str) else None
    if not numbers:
        raise ValueError(f"{identity} names a release that is not a number such as 2.14.5")
    return int(numbers[1]), int(numbers[2] or 0), int(numbers[3] or 0)


def _object(value: object, name: str) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"{name} is not an object")
    return value


def _objects(value: object, name: str) -> list[Mapping[str, Any]]:
    return [_object(part, f"an entry of {name}") for part in _list(value, name)]


def _list(value: object, name: str) -> list[Any]:
    if not isinstance(value, list):
        raise ValueError(f"{name} is not a list")
    return value


def _texts(value: object, name: str) -> list[str]:
    return [_text(text, f"an entry of {name}") for text in _list(value, name)]


def _text(value: object, name: str) -> str:
    if not isinstance(value, str):
        raise ValueError(f"{name} is not a string")
    return value[:_LONGEST_SUMMARY]


def _release_line(product: str, version: Version) -> str:
    """Return the release line of a version; Fast DDS 2.7 to 2.14 belong to the line 2.14."""
    if product != "Fast DDS":
        return f"{version[0]}.{version[1]}"
    for first, line in ((3, 3), "3.6"), ((3, 0), "3.2"), ((2, 7), "2.14"):
        if version >= (*first, 0):
            return line
    return "2.6"
