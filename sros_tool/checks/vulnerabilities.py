"""Checks for known vulnerabilities of the DDS of this machine's processes, and of robots."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

from sros_tool.checks.kind import NOTE, WARNING, Finding, FindingKind, names_text
from sros_tool.dds.advisories import (
    Advisory,
    known_vulnerabilities,
    shipped_advisories,
    version_numbers,
)
from sros_tool.keystore.confirmation import LibraryUse, RobotDds, RobotLibrary
from sros_tool.names import DISTRIBUTIONS
from sros_tool.prometheus import Metric, Sample
from sros_tool.runtime.processes import MappedLibrary, RunningProcesses, plain
from sros_tool.wording import counted

KNOWN_VULNERABILITIES = FindingKind(
    "runtime.known-vulnerabilities",
    WARNING,
    "a DDS with known vulnerabilities",
    "Through some vulnerabilities, anyone on the network can crash a process with one packet, even "
    "on a secured robot. The version is from the library that the process has loaded.",
    "Advisories in the OSV format, which ship with sros or are in --advisories FILE.",
    "Upgrade the package of the library to a release with the fixes, and restart the processes. "
    "Against vulnerabilities that no release fixes, keep strangers out of the network.",
)
PACKAGE_VULNERABILITIES = FindingKind(
    "runtime.package-vulnerabilities",
    NOTE,
    "a DDS with known vulnerabilities, unless the installed package fixes them",
    "Packages of Debian and Ubuntu can have fixes of later releases under an earlier version "
    "number, so the version does not show whether the library is vulnerable.",
    "Advisories in the OSV format; Debian's changelog of fastdds 2.9.1+ds-1+deb12u2, which names "
    "eight numbers of 2023.",
    "Compare the CVE numbers with the changelog of the package (`apt changelog`) or the security "
    "tracker of the distribution.",
    prominent=True,
)
UNCLEAR_VULNERABILITIES = FindingKind(
    "runtime.vulnerabilities-unclear",
    NOTE,
    "a DDS without known vulnerabilities, but with advisories that do not mention its release line",
    "If an advisory does not mention a release line, either the line is not affected, or the "
    "vulnerability is not fixed there.",
    "Advisories in the OSV format, which ship with sros or are in --advisories FILE.",
    "Look the numbers up in the advisories of the product.",
)
VERSION_UNKNOWN = FindingKind(
    "runtime.dds-version-unknown",
    NOTE,
    "a DDS of unknown version",
    "sros cannot tell which known vulnerabilities it has.",
    "The name of the library that a process has loaded.",
    "Look for the version in the package that the library belongs to; if the library was replaced, "
    "restart the processes.",
    prominent=True,
)
_UNSEEN_REMEDY = (
    'Run `sudo "$(command -v sros)" check runtime` on the robot: it names the processes that '
    "even root cannot examine, and the reason."
)
ROBOTS_UNKNOWN = FindingKind(
    "runtime.robots-dds-unknown",
    NOTE,
    "robots whose DDS libraries are not known",
    "sros cannot tell which known vulnerabilities these robots have.",
    "The last confirmations of the robots.",
    "If no library was reported or seen, confirm again with this version of sros (`sros fleet "
    "report` on the robot), while the nodes run. If sros could not examine some processes, "
    f"{_UNSEEN_REMEDY[:1].lower()}{_UNSEEN_REMEDY[1:]}",
    prominent=True,
)
NOTES_ON_LIBRARIES = (PACKAGE_VULNERABILITIES, VERSION_UNKNOWN, ROBOTS_UNKNOWN)
"""Notes that are shown among warnings: they say that a library may be vulnerable."""
_ROS_PACKAGES = "/opt/ros/"
_FASTRTPS_DISTRIBUTIONS = ("foxy", "galactic", "humble", "iron", "jazzy")
"""Distributions whose package of Fast DDS is named fastrtps; later ones have fastdds."""


def vulnerability_findings(
    running: RunningProcesses,
    libraries: Iterable[MappedLibrary] = (),
    advisories: Sequence[Advisory] | None = None,
) -> Iterator[Finding]:
    """Yield one finding for each DDS library of the processes, and of ``libraries``.

    ``advisories`` are the known vulnerabilities; None means the advisories that ship with sros.
    """
    users = _users_by_library(running, libraries)
    by = {library: [f"loaded by {names_text(of)}"] if of else [] for library, of in users.items()}
    yield from _library_findings(by, advisories)


def robot_findings(
    robots: Mapping[str, RobotDds | None],
    advisories: Sequence[Advisory] | None = None,
    names_as_text: Callable[[Sequence[str]], str] = names_text,
) -> Iterator[Finding]:
    """Yield a finding for each DDS library of robots, and a finding on robots with unknown DDS.

    ``robots`` maps names of robots to the DDS that they reported, or to None.  ``names_as_text``
    returns names of robots as a text.  ``advisories`` are as for `vulnerability_findings`.
    """
    seen: dict[MappedLibrary, dict[LibraryUse, list[str]]] = {}
    lacking: dict[str, list[str]] = {}
    for robot, dds in robots.items():
        if dds is None:
            lacking.setdefault("not reported by {}", []).append(robot)
            continue
        for library in dds.libraries:
            where = seen.setdefault(_as_mapped(library), {})
            where.setdefault(library.seen, []).append(robot)
        if not dds.libraries:
            lacking.setdefault("none seen on {}", []).append(robot)
        if dds.unseen:
            lacking.setdefault(_UNSEEN_TEXT, []).append(robot)
    by = {
        library: [
            f"{_SEEN_TEXTS[how]} {names_as_text(where[how])}" for how in LibraryUse if how in where
        ]
        for library, where in seen.items()
    }
    yield from _library_findings(by, advisories)
    if lacking:
        parts = (template.format(names_as_text(robots)) for template, robots in lacking.items())
        remedy = _UNSEEN_REMEDY if lacking.keys() == {_UNSEEN_TEXT} else ""
        yield ROBOTS_UNKNOWN.found("DDS of robots", "; ".join(parts), remedy=remedy)


_UNSEEN_TEXT = "some processes of {} could not be examined"
_SEEN_TEXTS = {
    LibraryUse.PROCESS: "loaded by processes of",
    LibraryUse.INSTALLED: "installed, but not loaded, on",
}


def is_fixed_later(library: RobotLibrary, advisories: Sequence[Advisory] | None = None) -> bool:
    """Return whether a later release of the same major version fixes a known vulnerability.

    False for packages of Debian and Ubuntu, whose version does not tell which fixes they have.
    ``advisories`` are as for `vulnerability_findings`.
    """
    known = known_vulnerabilities(library.product, library.version, advisories)
    numbers = version_numbers(library.version)
    if known is None or numbers is None or _as_mapped(library).is_packaged:
        return False
    return any(advisory.fixed_in(numbers) for advisory in known.known)


def _as_mapped(library: RobotLibrary) -> MappedLibrary:
    return MappedLibrary(library.product, library.version, library.path)


def _library_findings(
    users: Mapping[MappedLibrary, Sequence[str]], advisories: Sequence[Advisory] | None
) -> Iterator[Finding]:
    """Yield a finding for each library; ``users`` maps libraries to clauses on their users."""
    used = shipped_advisories() if advisories is None else advisories
    place_by_text: dict[str, str] = {}
    for library, clauses in users.items():
        if not any(advisory.product == library.product for advisory in used):
            continue
        name = f"{library.product} {library.version}"
        place = f"'{plain(library.path, _LONGEST_PATH)}'"
        by = "".join(f", {clause}" for clause in clauses)
        known = known_vulnerabilities(library.product, library.version, used)
        if known is None:
            text = f"the name of {place} does not show the version{by}"
            yield VERSION_UNKNOWN.found(library.product, text)
        elif known.known:
            kind = KNOWN_VULNERABILITIES
            if library.is_packaged:
                kind = PACKAGE_VULNERABILITIES
            number = _vulnerability_counts_clause(known.known, library.version)
            ids = f": {', '.join(advisory.id for advisory in known.known)}"
            if known.unclear:
                ids += f". {_unclear_text(known.unclear)}"
            if (first := place_by_text.setdefault(f"{name}: {number}{ids}", place)) != place:
                number, ids = f"the same known vulnerabilities as {first}", ""
            text = f"{'; '.join((number, *clauses))}; in {place}{ids}"
            yield kind.found(name, text, remedy=_remedy(kind, library))
        elif known.unclear:
            text = f"{place}{by}. {_unclear_text(known.unclear)}"
            yield UNCLEAR_VULNERABILITIES.found(name, text)


_LONGEST_PATH = 200


def vulnerability_metrics(
    running: RunningProcesses, advisories: Sequence[Advisory] | None = None
) -> tuple[Metric, Metric]:
    """Return metrics: how many vulnerabilities each DDS has, and how many releases are unknown.

    The version is not a label: hostile processes or robots could make up any number of versions.
    """
    most: dict[str, int] = {}
    unknown: Counter[str] = Counter()
    for library in _users_by_library(running):
        known = known_vulnerabilities(library.product, library.version, advisories)
        if known is None:
            unknown[library.product] += 1
        else:
            most[library.product] = max(most.get(library.product, 0), len(known.known))
    return (
        Metric(
            "sros_dds_known_vulnerabilities",
            "Number of vulnerabilities known for the version of a DDS that processes have loaded. "
            "They count even if the package has fixes for them without a new version. If several "
            "releases are loaded, the number for the most vulnerable release.",
            tuple(Sample(number, {"product": name}) for name, number in sorted(most.items())),
        ),
        Metric(
            "sros_dds_unknown_versions",
            "Number of DDS libraries that processes have loaded and whose known vulnerabilities "
            "cannot be determined: their version is unknown, or no advisory is about the product.",
            tuple(Sample(number, {"product": name}) for name, number in sorted(unknown.items())),
        ),
    )


def _users_by_library(
    running: RunningProcesses, libraries: Iterable[MappedLibrary] = ()
) -> Mapping[MappedLibrary, list[str]]:
    """Map libraries to the labels of the processes that have mapped them.

    The result also has ``libraries``, which perhaps no process has mapped.
    """
    users: dict[MappedLibrary, list[str]] = {library: [] for library in libraries}
    for process in running.processes:
        for library in process.dds:
            users.setdefault(library._replace(replaced=False), []).append(process.label)
    return users


def _vulnerability_counts_clause(advisories: Sequence[Advisory], version: str) -> str:
    """Return a clause with numbers of vulnerabilities: in all, by precondition, and by fix."""
    secured = sum("security" in advisory.needs for advisory in advisories)
    of_all = len(advisories) - secured
    needs = [f"{of_all} {'affects' if of_all == 1 else 'affect'} all processes"] if of_all else []
    needs += [f"{secured} only those with DDS Security"] if secured else []
    needs = ["only with DDS Security"] if secured == len(advisories) else needs
    numbers = version_numbers(version)
    major = numbers[0] if numbers else ""
    releases = Counter(advisory.fixed_in(numbers) if numbers else "" for advisory in advisories)
    fixes = [
        f"{number} fixed in {release}"
        if release
        else f"{number} not fixed in any known release {major}.x"
        for release, number in sorted(releases.items(), reverse=True)
    ]
    count = counted(len(advisories), "known vulnerability", "known vulnerabilities")
    return f"{count} ({'; '.join(needs)}), {', '.join(fixes)}"


def _unclear_text(advisories: Sequence[Advisory]) -> str:
    return (
        "Advisories that do not mention this release line: "
        f"{', '.join(advisory.id for advisory in advisories)}"
    )


def _remedy(kind: FindingKind, library: MappedLibrary) -> str:
    """Return a remedy that names the ROS package to upgrade, or "" for the remedy of ``kind``.

    "" if the path of the library does not show the package, or for `PACKAGE_VULNERABILITIES`.
    """
    if kind is PACKAGE_VULNERABILITIES or not library.path.startswith(_ROS_PACKAGES):
        return ""
    distribution = library.path.removeprefix(_ROS_PACKAGES).partition("/")[0]
    if distribution not in DISTRIBUTIONS:  # the process chose the path
        return ""
    package = "cyclonedds"
    if library.product == "Fast DDS":
        package = "fastrtps" if distribution in _FASTRTPS_DISTRIBUTIONS else "fastdds"
    return (
        f"Upgrade the package ros-{distribution}-{package}, and restart the processes. "
        "Against vulnerabilities that no release fixes, keep strangers out of the network."
    )
