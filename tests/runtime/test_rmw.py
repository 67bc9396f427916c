"""The RMW that is installed here, and what its files say about security."""

from __future__ import annotations

from pathlib import Path

import pytest

from sros_tool.dds.decision.vendors import Vendor
from sros_tool.runtime.rmw import RMW, built_without_security, vendor_here

FAST = "rmw_fastrtps_cpp"


def _prefix(root: Path, library: bytes) -> dict[str, str]:
    index = root / "share/ament_index/resource_index/rmw_typesupport"
    index.mkdir(parents=True)
    (index / FAST).touch()
    (root / "lib").mkdir()
    (root / "lib/librmw_fastrtps_shared_cpp.so").write_bytes(library)
    return {"AMENT_PREFIX_PATH": str(root)}


@pytest.mark.parametrize("named", [False, True])
@pytest.mark.parametrize("secured", [False, True])
def test_an_rmw_without_security_is_said(named: bool, secured: bool, tmp_path: Path) -> None:
    message = b"" if secured else b"This Fast DDS version doesn't have the security libraries"
    here = _prefix(tmp_path, b"\x7fELF" + message + b"\0")
    if named:
        here[RMW] = FAST
    vendor, why = vendor_here(here)
    assert vendor is Vendor.FAST
    assert ("built without security" in why) is not secured
    assert built_without_security(FAST, here) is not secured


def test_without_its_files_nothing_is_said_of_an_rmw(tmp_path: Path) -> None:
    here = _prefix(tmp_path, b"have the security libraries")
    assert not built_without_security("rmw_cyclonedds_cpp", here)
    (tmp_path / "lib/librmw_fastrtps_shared_cpp.so").unlink()
    assert not built_without_security(FAST, here)
