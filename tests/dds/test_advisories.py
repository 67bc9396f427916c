"""The known vulnerabilities of each release, and advisories that others wrote."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from sros_tool.dds.advisories import (
    known_vulnerabilities,
    parse_advisories,
    read_advisories,
    shipped_advisories,
)
from sros_tool.errors import DocumentError

NUMBERS = {
    ("Fast DDS", "2.6.9"): 31,
    ("Fast DDS", "2.6.11"): 18,
    ("Fast DDS", "2.6.12"): 0,
    ("Fast DDS", "2.9.1"): 29,
    ("Fast DDS", "2.14.5"): 27,
    ("Fast DDS", "2.14.6"): 17,
    ("Fast DDS", "3.2.4"): 18,
    ("Fast DDS", "3.2.5"): 0,
    ("Fast DDS", "3.6.1"): 17,
    ("Fast DDS", "3.6.2"): 9,
    ("Cyclone DDS", "0.10.5"): 1,
    ("Cyclone DDS", "11.0.1"): 0,
}


def affected_by(*events: dict[str, str]) -> list[Any]:
    """Return the releases of Fast DDS between events as ``affected``."""
    package = {"ecosystem": "GIT", "name": "https://github.com/eProsima/Fast-DDS"}
    return [{"package": package, "ranges": [{"type": "SEMVER", "events": events}]}]


RECORD: dict[str, Any] = {
    "id": "CVE-2030-12345",
    "affected": affected_by({"introduced": "0"}, {"fixed": "3.6.3"}),
}


def document(**changes: object) -> bytes:
    """Return the record with other members."""
    return json.dumps({**RECORD, **changes}).encode()


def test_each_release_has_the_vulnerabilities_that_are_known() -> None:
    found = {}
    for product, version in NUMBERS:
        known = known_vulnerabilities(product, version)
        assert known is not None
        found[product, version] = len(known.known)
    assert found == NUMBERS


def test_the_first_mended_release_is_that_of_the_line() -> None:
    (advisory,) = (each for each in shipped_advisories() if each.id == "CVE-2025-62599")
    assert advisory.fixed_in((2, 14, 5)) == "2.14.6"
    assert advisory.fixed_in((3, 2, 3)) == "3.2.4"
    assert not advisory.affects((2, 14, 6))
    (advisory,) = (each for each in shipped_advisories() if each.id == "CVE-2025-67108")
    assert advisory.affects((2, 14, 6))
    assert advisory.fixed_in((2, 14, 6)) == ""


def test_silence_about_a_line_is_not_a_mend() -> None:
    known = known_vulnerabilities("Fast DDS", "2.14.6")
    assert known is not None
    assert "CVE-2024-30258" in {advisory.id for advisory in known.unclear}


@pytest.mark.parametrize("version", ["", "3.6", "of unknown version", "2.14.5-rc1", "9" * 5000])
def test_a_version_that_cannot_be_read_is_not_sound(version: str) -> None:
    assert known_vulnerabilities("Fast DDS", version) is None


def test_a_file_adds_advisories(tmp_path: Path) -> None:
    path = tmp_path / "newer.json"
    path.write_bytes(document())
    known = known_vulnerabilities("Fast DDS", "3.6.2", read_advisories(path))
    assert known is not None
    assert len(known.known) == NUMBERS["Fast DDS", "3.6.2"] + 1
    path.write_bytes(document(id="CVE-2025-67108"))  # fixed at last
    known = known_vulnerabilities("Fast DDS", "3.6.3", read_advisories(path))
    assert known is not None
    assert "CVE-2025-67108" not in {advisory.id for advisory in known.known}


def test_a_withdrawn_advisory_affects_nothing(tmp_path: Path) -> None:
    path = tmp_path / "newer.json"
    everything = affected_by({"introduced": "0"})
    for withdrawn, number in ((None, 1), ("2030-01-01T00:00:00Z", 0)):
        path.write_bytes(document(id="CVE-2025-62599", affected=everything, withdrawn=withdrawn))
        known = known_vulnerabilities("Fast DDS", "2.14.5", read_advisories(path))
        assert known is not None
        assert len([each for each in known.known if each.id == "CVE-2025-62599"]) == number


def test_records_of_one_number_are_one_advisory() -> None:
    other = {
        **RECORD,
        "id": "GHSA-aaaa-bbbb-cccc",
        "aliases": [RECORD["id"]],
        "affected": affected_by({"introduced": "3.0.0"}, {"fixed": "3.6.5"}),
    }
    (advisory,) = parse_advisories(json.dumps([RECORD, other]).encode(), "it")
    assert advisory.affects((3, 6, 4))
    assert advisory.fixed_in((3, 6, 2)) == "3.6.5"
    assert advisory.fixed_in((2, 14, 5)) == ""


def test_an_advisory_replaces_only_what_it_names(tmp_path: Path) -> None:
    path = tmp_path / "newer.json"
    path.write_bytes(document(id="CVE-2023-24011"))  # shipped for Cyclone DDS
    known = known_vulnerabilities("Cyclone DDS", "0.10.5", read_advisories(path))
    assert known is not None
    assert "CVE-2023-24011" in {advisory.id for advisory in known.known}


@pytest.mark.parametrize(
    "affected", [[], [{"package": {"ecosystem": "Debian", "name": "fastdds"}}]]
)
def test_advisories_about_nothing_known_are_refused(affected: object, tmp_path: Path) -> None:
    path = tmp_path / "newer.json"
    path.write_bytes(document(affected=affected))
    with pytest.raises(DocumentError, match="no advisory about Fast DDS, Cyclone DDS or Zenoh"):
        read_advisories(path)


def test_releases_can_be_listed_beside_ranges_of_git() -> None:
    repository = {"type": "GIT", "repo": "https://github.com/eProsima/Fast-DDS", "events": []}
    data = document(affected=[{"ranges": [repository], "versions": ["v2.14.5", "v3.0.0-rc1"]}])
    (advisory,) = parse_advisories(data, "it")
    assert advisory.affects((2, 14, 5))
    assert not advisory.affects((2, 14, 6))


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"{",
        b"[" * 100_000,
        b"7",
        b"[[]]",
        document(id=["CVE-2030-1"]),
        document(id="\x1b[2J"),
        document(affected="all"),
        document(affected=[{"package": {"name": "github.com/eProsima/Fast-DDS"}}]),
        document(summary=1),
        document(database_specific=[]),
        document(affected=affected_by({"fixed": "3.6.3"})),
        document(affected=affected_by({"introduced": "3.6.3"}, {"fixed": "3.6.0"})),
        document(affected=RECORD["affected"] + affected_by()),
        document(affected=[{**RECORD["affected"][0], "ranges": [{"type": "semver"}]}]),
        document(affected=[*RECORD["affected"], {**RECORD["affected"][0], "ranges": []}]),
        document(withdrawn=True),
    ],
)
def test_what_is_no_advisory_is_refused(data: bytes) -> None:
    assert parse_advisories(document(), "it")
    with pytest.raises(DocumentError, match="it is not in the OSV format"):
        parse_advisories(data, "it")
