"""Exports read as untrusted input on a robot, and what a robot confirms."""

from __future__ import annotations

import gzip
import io
import tarfile
from datetime import UTC, datetime
from pathlib import Path

import pytest

from ansible_collections.sros.fleet.plugins.module_utils.exports import (
    MOST_OF_FILE,
    RefusedError,
    authorities,
    changed_enclaves,
    check_enclave,
    confirmation,
    enclaves_in,
    read_archive,
)
from sros_tool.keystore.delivery.export import pack_enclaves
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.names import check_enclave_name

NOW = datetime.now(UTC)


def packed(*entries: tuple[str, bytes | str], after: bytes = b"") -> bytes:
    """Return an archive; a text stands for a link with this target."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as tar:
        for name, content in entries:
            entry = tarfile.TarInfo(name)
            if isinstance(content, str):
                entry.type, entry.linkname = tarfile.SYMTYPE, content
                tar.addfile(entry)
            else:
                entry.size = len(content)
                tar.addfile(entry, io.BytesIO(content))
    return gzip.compress(buffer.getvalue(), mtime=0) + after


def test_what_sros_packs_is_read(made_keystore: Path) -> None:
    data = pack_enclaves(OpenedKeystore(made_keystore), ["/a", "/b"], now=NOW).data
    files = read_archive(data)
    assert enclaves_in(files) == ["/a", "/b"]
    assert len(authorities(files)) == 2
    assert changed_enclaves({}, files) == ["/a", "/b"]
    other = {**files, "enclaves/b/cert.pem": b"other"}
    assert changed_enclaves(files, other) == ["/b"]
    without = {path: files[path] for path in files if not path.endswith("b/permissions.p7s")}
    assert changed_enclaves(files, without) == ["/b"]
    said = confirmation("r1", files, NOW.timestamp(), ["/r1/a"], [])
    assert (said["restart"], said["crl_restart"]) == (["/r1/a"], [])
    assert not [path for path in said["files"] if path.endswith("key.pem")]
    assert len(said["files"]) == 10


GOOD = "enclaves/a/cert.pem"


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"", "damaged"),
        (b"junk", "damaged"),
        (packed((GOOD, b"x"))[:-9], "damaged"),
        (packed((GOOD, b"x"), after=b"more"), "damaged"),
        (packed(), "empty"),
        (packed((GOOD, b"x")), "lacks identity_ca.cert.pem"),
        (packed((GOOD, "/etc/shadow")), "does not belong"),
        (packed((GOOD, b"x"), (GOOD, b"y")), "does not belong"),
        (packed(("../cert.pem", b"x")), "does not belong"),
        (packed(("/enclaves/a/cert.pem", b"x")), "does not belong"),
        (packed(("enclaves/../cert.pem", b"x")), "does not belong"),
        (packed(("enclaves/a b/cert.pem", b"x")), "does not belong"),
        (packed(("enclaves//cert.pem", b"x")), "does not belong"),
        (packed((f"enclaves/{'a' * 65}/cert.pem", b"x")), "does not belong"),
        (packed(("enclaves/a/authorized_keys", b"x")), "does not belong"),
        (packed(("enclaves/a/request.pem", b"x")), "does not belong"),
        (packed(("private/identity_ca.key.pem", b"x")), "does not belong"),
    ],
    ids=lambda each: each if isinstance(each, str) else f"{len(each)} bytes",
)
def test_whatever_is_no_export_is_refused(data: bytes, why: str) -> None:
    with pytest.raises(RefusedError, match=why):
        read_archive(data)


def test_a_large_file_in_an_export_is_refused() -> None:
    with pytest.raises(RefusedError, match="larger than"):
        read_archive(packed((GOOD, bytes(MOST_OF_FILE + 1))))


@pytest.mark.parametrize("name", ["/", "/a", "/a_b/C9", f"/{'a' * 63}"])
def test_names_of_enclaves(name: str) -> None:
    assert check_enclave(name) == name == check_enclave_name(name)


@pytest.mark.parametrize("name", ["", "a", "/a/", "//", "/9", "/a\n", "/a/../b", f"/{'a' * 64}"])
def test_names_of_no_enclave(name: str) -> None:
    with pytest.raises(RefusedError):
        check_enclave(name)
