"""The RMW that is installed here, and what its files say about security."""

from __future__ import annotations

from pathlib import Path

import pytest

from sros_tool.runtime.rmw import RMW, built_without_security, vendor_here, vendor_of

FAST, CYCLONE = "rmw_fastrtps_cpp", "rmw_cyclonedds_cpp"
OPEN_BUILDS = {
    FAST: (
        "librmw_fastrtps_shared_cpp.so",
        b"This Fast DDS version doesn't have the security libraries",
    ),
    CYCLONE: (
        "librmw_cyclonedds_cpp.so",
        b"the Cyclone DDS being used does not have security support enabled. Recompile",
    ),
}


def _prefix(root: Path, rmw: str, *, secured: bool) -> dict[str, str]:
    index = root / "share/ament_index/resource_index/rmw_typesupport"
    index.mkdir(parents=True)
    (index / rmw).touch()
    (root / "lib").mkdir()
    library, message = OPEN_BUILDS[rmw]
    (root / "lib" / library).write_bytes(b"\x7fELF" + (b"" if secured else message) + b"\0")
    return {"AMENT_PREFIX_PATH": str(root)}


@pytest.mark.parametrize("rmw", OPEN_BUILDS)
@pytest.mark.parametrize("named", [False, True])
@pytest.mark.parametrize("secured", [False, True])
def test_an_rmw_without_security_is_said(
    rmw: str, named: bool, secured: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.prefix", "")  # this Python may have wheels with an RMW
    here = _prefix(tmp_path, rmw, secured=secured)
    if named:
        here[RMW] = rmw
    vendor, why = vendor_here(here)
    assert vendor is vendor_of(rmw)
    assert ("built without security" in why) is not secured
    assert built_without_security(rmw, here) is not secured


def test_without_its_files_nothing_is_said_of_an_rmw(tmp_path: Path) -> None:
    here = _prefix(tmp_path, FAST, secured=False)
    assert not built_without_security(CYCLONE, here)
    (tmp_path / "lib/librmw_fastrtps_shared_cpp.so").unlink()
    assert not built_without_security(FAST, here)
