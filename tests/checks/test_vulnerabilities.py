"""Findings about DDS libraries with known vulnerabilities."""

from __future__ import annotations

import os
from datetime import UTC, datetime
from pathlib import Path

import pytest

from sros_tool.checks.vulnerabilities import vulnerability_findings, vulnerability_metrics
from sros_tool.prometheus import Sample
from sros_tool.runtime.processes import (
    FileReader,
    MappedLibrary,
    Process,
    ProcessRoot,
    RunningProcesses,
    _mapped_dds,
    with_files,
)


def running(*libraries: MappedLibrary) -> RunningProcesses:
    """Return two processes with the same libraries."""
    started = datetime.now(UTC)
    return RunningProcesses(
        tuple(
            Process(pid, (name,), {}, started, dds=libraries) for pid, name in ((7, "a"), (8, "b"))
        )
    )


@pytest.mark.parametrize(
    ("path", "version", "identity"),
    [
        ("/opt/ros/jazzy/lib/libfastrtps.so.2.14.5", "2.14.5", "runtime.known-vulnerabilities"),
        (
            "/usr/lib/x86_64-linux-gnu/libfastrtps.so.2.9.1",
            "2.9.1",
            "runtime.package-vulnerabilities",
        ),
        ("/ws/lib/libfastdds.so.3.6", "", "runtime.dds-version-unknown"),
    ],
)
def test_one_finding_for_each_library(path: str, version: str, identity: str) -> None:
    (finding,) = vulnerability_findings(running(MappedLibrary("Fast DDS", version, path)))
    assert finding.id == identity
    assert "process 7 (a)" in finding.text
    assert "process 8 (b)" in finding.text
    assert "ros-jazzy-fastrtps" in finding.remedy or "/opt" not in path


def test_vulnerabilities_of_a_release_are_listed_once() -> None:
    paths = ("/opt/ros/jazzy/lib/libfastrtps.so.2.14.5", "/venv/lib/libfastrtps.so.2.14.5")
    libraries = [MappedLibrary("Fast DDS", "2.14.5", path) for path in paths]
    first, second = vulnerability_findings(running(), libraries)
    assert "CVE-2025-62599" in first.text
    assert second.text == f"the same known vulnerabilities as '{paths[0]}'; in '{paths[1]}'"


def test_a_mended_release_has_no_known_vulnerability() -> None:
    library = MappedLibrary("Fast DDS", "3.2.5", "/opt/ros/kilted/lib/libfastdds.so.3.2.5")
    (finding,) = vulnerability_findings(running(library))
    assert finding.id == "runtime.vulnerabilities-unclear"
    assert finding.text.endswith(
        "Advisories that do not mention this release line: CVE-2024-30258, CVE-2024-30259"
    )
    (finding,) = vulnerability_findings(running(library._replace(version="3.2.4")))
    assert finding.id == "runtime.known-vulnerabilities"
    fixed = MappedLibrary("Cyclone DDS", "11.0.1", "/opt/ros/lyrical/lib/libddsc.so.11.0.1")
    assert not list(vulnerability_findings(running(fixed)))
    assert list(vulnerability_findings(running(fixed._replace(version="0.10.5"))))


def test_a_path_names_no_package_that_is_none() -> None:
    path = "/opt/ros/{}/lib/libfastrtps.so.2.14.5"
    for distribution, named in (("jazzy", True), ("jazzy-desktop from elsewhere", False)):
        library = MappedLibrary("Fast DDS", "2.14.5", path.format(distribution))
        (finding,) = vulnerability_findings(running(library))
        assert ("package ros-" in finding.remedy) is named


def test_installed_and_loaded_library_have_one_finding() -> None:
    library = MappedLibrary("Fast DDS", "2.14.5", "/opt/ros/jazzy/lib/libfastrtps.so.2.14.5")
    (finding,) = vulnerability_findings(running(library._replace(replaced=True)), [library])
    assert finding.text.startswith("27 known vulnerabilities (15 affect all processes; ")
    assert f"; loaded by process 7 (a), process 8 (b); in '{library.path}': CVE-" in finding.text


def test_the_metric_has_the_largest_number_of_each_product() -> None:
    library = MappedLibrary("Fast DDS", "2.14.5", "/a/libfastrtps.so.2.14.5")
    unknown = MappedLibrary("Fast DDS", "", "/b/libfastrtps.so")
    mended = library._replace(version="2.14.6")
    known, hidden = vulnerability_metrics(running(library, mended, unknown))
    (sample,) = known.samples
    assert (sample.value, sample.labels) == (27, {"product": "Fast DDS"})
    assert hidden.samples == (Sample(1, {"product": "Fast DDS"}),)
    assert vulnerability_metrics(running(library))[1].samples == ()


def test_versions_are_read_from_the_mapped_files() -> None:
    maps = (
        b"7f0 r-xp 0 08:01 12  /x y/libfastrtps.so.2.14.5\n"
        b"7f1 r--p 0 08:01 12  /x y/libfastrtps.so.2.14.5\n"
        b"7f2 r-xp 0 08:01 13  /a/libfastdds.so.3.6.2.0\n"
        b"7f3 r-xp 0 08:01 14  /a/libddsc.so.0.10.2 (deleted)\n"
        b"7f4 r-xp 0 08:01 15  /libfastrtps.so.2.6.9\n"
        b"7f5 r-xp 0 08:01 16  /a/libfastrtps.so.2.14.5-patched\n"
        b"7f6 r-xp 0 08:01 17  /a/libddsc.so.0.10.5\\012x (deleted)\n"
        b"7f7 r-xp 0 08:01 18  /a/libddsc.so.0.10.5/data\n"
    )
    assert set(_mapped_dds(maps)) == {
        MappedLibrary("Fast DDS", "2.14.5", "/x y/libfastrtps.so.2.14.5"),
        MappedLibrary("Fast DDS", "3.6.2", "/a/libfastdds.so.3.6.2.0"),
        MappedLibrary("Cyclone DDS", "0.10.2", "/a/libddsc.so.0.10.2", replaced=True),
        MappedLibrary("Fast DDS", "2.6.9", "/libfastrtps.so.2.6.9"),
        MappedLibrary("Fast DDS", "", "/a/libfastrtps.so.2.14.5-patched"),
        MappedLibrary("Cyclone DDS", "", "/a/libddsc.so.0.10.5\\012x", replaced=True),
    }


def test_each_line_of_the_maps_is_tried_once() -> None:
    lines = b"7f0 r-xp 0 08:01 12  " + b"/a" * 50_000 + b"\n7f1 r-xp 0 08:01 12  /libddsc.so.0.10.2"
    assert [library.version for library in _mapped_dds(lines)] == ["0.10.2"]


def test_a_copy_next_to_a_library_shows_its_version(tmp_path: Path) -> None:
    library = MappedLibrary("Fast DDS", "", "/lib/libfastrtps.so.2.14")
    process = Process(7, ("a",), {}, datetime.now(UTC), dds=(library,))
    (tmp_path / "lib").mkdir()
    (tmp_path / "lib/libfastrtps.so.2.14").write_bytes(b"ELF")
    os.mkfifo(tmp_path / "lib/libfastrtps.so.2.14.7")
    (tmp_path / "lib/libfastrtps.so.2.14.6").write_bytes(b"another")
    handle = os.open(tmp_path, os.O_PATH | os.O_DIRECTORY)
    try:
        root = ProcessRoot(handle, FileReader())
        assert with_files(process, root, "/").dds == (library,)
        (tmp_path / "lib/libfastrtps.so.2.14.5").write_bytes(b"ELF")
        assert with_files(process, root, "/").dds == (library._replace(version="2.14.5"),)
        (tmp_path / "lib/libfastrtps.so.2.14.9").write_bytes(b"ELF")
        assert with_files(process, root, "/").dds == (library,), "two copies tell nothing"
    finally:
        os.close(handle)
