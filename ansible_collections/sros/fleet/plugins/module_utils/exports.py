"""Exports of enclaves as `sros distribute_key` packs them, read as untrusted input.

Like everything that runs on a robot, this needs Python 3.8 and its standard library, not sros.
"""

from __future__ import annotations

import base64
import binascii
import datetime
import glob
import hashlib
import io
import os
import re
import tarfile
import zlib
from typing import Dict, Iterator

KEY_FILE = "key.pem"
KEY_URI_FILE = "key.p11"
"""In place of the key: the PKCS#11 URI of a key on a token of the robot."""
KEY_FILES = (KEY_FILE, KEY_URI_FILE)
REQUEST_FILE = "request.pem"
CERTIFICATE_FILE = "cert.pem"
AUTHORITY_FILES = ("identity_ca.cert.pem", "permissions_ca.cert.pem")
SIGNED_FILES = ("governance.p7s", "permissions.p7s")
ZENOH_FILES = ("session.json5", "session.p7s", "router.json5", "router.p7s")
REQUIRED_FILES = (CERTIFICATE_FILE, *AUTHORITY_FILES, *SIGNED_FILES)
CONFIRMED_FILES = (*REQUIRED_FILES, "crl.pem", *ZENOH_FILES)
"""The files of an enclave that an export has besides the key, and that a confirmation names."""
TRUST_FILES = (*AUTHORITY_FILES, "crl.pem", *ZENOH_FILES)
"""The files that decide which other enclaves a process accepts."""
_LOCAL_FILES = (*KEY_FILES, REQUEST_FILE, "answer.p7s", "permissions.xml", "governance.xml")
"""Other files that an enclave on a robot may have."""

MOST_PACKED = 64 * 1024 * 1024
MOST_UNPACKED = 256 * 1024 * 1024
MOST_FILES = 20_000
MOST_OF_FILE = 17 * 1024 * 1024
"""Largest sizes in bytes: of an archive, of its content, of one file; and number of entries."""

_TOP = "enclaves"
_TOKEN = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_LONGEST_NAME = 64
_MOST_CERTIFICATES = 32
_CERTIFICATE = re.compile(
    rb"-----BEGIN CERTIFICATE-----\s+([A-Za-z0-9+/=\s]+?)-----END CERTIFICATE-----"
)

Files = Dict[str, bytes]
"""The content of files by their paths in a keystore, such as ``enclaves/r7/base/cert.pem``."""


class RefusedError(Exception):
    """Something cannot be done; the text says what, why and what to do."""


def folder_of(enclave: str) -> str:
    """Return the path of an enclave's folder in a keystore."""
    return _TOP + enclave.rstrip("/")


def enclave_of(path: str) -> str:
    """Return the name of the enclave that a file belongs to, by its path in a keystore."""
    return path.rpartition("/")[0][len(_TOP) :] or "/"


def check_enclave(name: str) -> str:
    """Return ``name`` if it can be that of an enclave.

    Raises:
        RefusedError: it cannot.
    """
    parts = name[1:].split("/") if name != "/" else []
    if (
        not name.startswith("/")
        or len(name) > _LONGEST_NAME
        or not all(_TOKEN.fullmatch(part) for part in parts)
    ):
        raise RefusedError(
            f"{name[:200]!r} is not the name of an enclave. It has letters, digits and underscores,"
            f" such as /robot/camera, and at most {_LONGEST_NAME} characters."
        )
    return name


def is_enclave_path(path: str) -> bool:
    """Return whether ``path`` is that of a file that an enclave on a robot may have."""
    folder, _, file = path.rpartition("/")
    name = folder[len(_TOP) :] or "/"
    try:
        return folder == folder_of(check_enclave(name)) and file in (
            *CONFIRMED_FILES,
            *_LOCAL_FILES,
        )
    except RefusedError:
        return False


def read_archive(packed: bytes) -> Files:
    """Return the files of an export (``.tar.gz``).

    Raises:
        RefusedError: it is damaged, too large, or has anything else than whole enclaves; an enclave
            may lack its key, which then is on the robot.
    """
    try:
        with tarfile.open(fileobj=io.BytesIO(_unzip(packed)), mode="r:") as archive:
            files = dict(_members(archive))
    except (tarfile.TarError, zlib.error, EOFError, OSError, ValueError, OverflowError) as error:
        raise RefusedError(f"The export is damaged or not a .tar.gz archive: {error}.") from error
    for enclave in enclaves_in(files):
        missing = [file for file in REQUIRED_FILES if folder_of(enclave) + "/" + file not in files]
        if missing:
            raise RefusedError(
                "The export of enclave {} lacks {}.".format(enclave, ", ".join(missing))
            )
    if not files:
        raise RefusedError("The export is empty.")
    return files


def _unzip(packed: bytes) -> bytes:
    if len(packed) > MOST_PACKED:
        raise ValueError(f"it is larger than {MOST_PACKED} bytes")
    stream = zlib.decompressobj(16 + zlib.MAX_WBITS)
    plain = stream.decompress(packed, MOST_UNPACKED + 1)
    if len(plain) > MOST_UNPACKED:
        raise ValueError(f"it unpacks to more than {MOST_UNPACKED} bytes")
    if not stream.eof or stream.unused_data:
        raise EOFError("its end is missing, or more follows")
    return plain


def _members(archive: tarfile.TarFile) -> Iterator[tuple]:
    seen: set[str] = set()
    for number, entry in enumerate(archive):
        if number >= MOST_FILES:
            raise ValueError(f"it has more than {MOST_FILES} entries")
        if entry.isdir():
            continue
        if not entry.isreg() or entry.name in seen or not is_enclave_path(entry.name):
            raise ValueError(f"{entry.name[:200]!r} does not belong to an export")
        if entry.name.rpartition("/")[2] not in (*KEY_FILES, *CONFIRMED_FILES):
            raise ValueError(f"{entry.name[:200]!r} does not belong to an export")
        if entry.size > MOST_OF_FILE:
            raise ValueError(f"{entry.name!r} is larger than {MOST_OF_FILE} bytes")
        content = archive.extractfile(entry)
        if content is None:
            raise ValueError(f"{entry.name!r} has no content")
        seen.add(entry.name)
        yield entry.name, content.read()


def enclaves_in(files: Files) -> list[str]:
    """Return the sorted names of the enclaves that have a file."""
    return sorted({enclave_of(path) for path in files})


def changed_enclaves(before: Files, after: Files) -> list[str]:
    """Return the sorted names of the enclaves of ``after`` of which a file changed or went away."""
    different = {path for path in {*before, *after} if before.get(path) != after.get(path)}
    return sorted({enclave_of(path) for path in different} & set(enclaves_in(after)))


def authorities(files: Files) -> frozenset[bytes]:
    """Return the certificates of the CAs (as base64) that the enclaves trust."""
    return frozenset(
        b"".join(block.split())
        for path, content in files.items()
        if path.rpartition("/")[2] in AUTHORITY_FILES
        for block in _CERTIFICATE.findall(content)
    )


def trust_digest(files: Files, enclave: str) -> str:
    """Return the SHA-256 of what decides which others the processes of an enclave accept."""
    parts = [enclave]
    for file in TRUST_FILES:
        content = files.get(folder_of(enclave) + "/" + file)
        parts.append("-" if content is None else hashlib.sha256(content).hexdigest())
    return hashlib.sha256(" ".join(parts).encode()).hexdigest()


def certificate_digests(content: bytes) -> list[str]:
    """Return the SHA-256 of the certificates (DER) in a file, in their order."""
    found = []
    for block in _CERTIFICATE.findall(content)[:_MOST_CERTIFICATES]:
        try:
            found.append(hashlib.sha256(base64.b64decode(b"".join(block.split()))).hexdigest())
        except binascii.Error:
            continue
    return found


def confirmation(robot: str, files: Files, now: float, due: list, crl_due: list) -> dict:
    """Return what a robot confirms that it has (sros_tool/schemas/confirmation.json), with its DDS.

    Args:
        robot: the name of the robot.
        files: the files of its keystore.
        now: seconds since 1970 by the clock of the robot.
        due: the enclaves whose processes still have earlier files.
        crl_due: those of them whose processes may lack the revocation list, or a CA.
    """
    confirmed = {
        path: content
        for path, content in sorted(files.items())
        if path.rpartition("/")[2] in CONFIRMED_FILES
    }
    moment = datetime.datetime.fromtimestamp(int(now), datetime.timezone.utc)
    return {
        "format": 1,
        "robot": robot,
        "time": moment.strftime("%Y-%m-%dT%H:%M:%SZ"),
        "files": {path: hashlib.sha256(data).hexdigest() for path, data in confirmed.items()},
        "certificates": {
            path: certificate_digests(data)
            for path, data in confirmed.items()
            if path.rpartition("/")[2] in (CERTIFICATE_FILE, *AUTHORITY_FILES)
        },
        "restart": sorted(due),
        "crl_restart": sorted(crl_due),
        "dds": _dds_here(),
    }


_MAPPED = re.compile(
    rb"^[^/\n]*(/(?:[^\n]*/)?lib(?:fastrtps|fastdds|ddsc)(?:-[0-9a-f]{6,40})?"
    rb"(?:\.abi3|\.cpython-[\w-]+)?\.so[^/\n]*?)(?: \(deleted\))?$",
    re.MULTILINE,
)
_FOLDERS = (
    *("/opt/ros/*/lib", "/opt/ros/*/lib/*-linux-gnu*"),
    *("/usr/lib", "/usr/lib/*-linux-gnu*", "/usr/local/lib"),
)
_VERSION = re.compile(r"\.so\.([0-9]{1,6}\.[0-9]{1,6}\.[0-9]{1,6})(?:\.[0-9]+)?\Z")
_MOST_MAPS = 32 * 1024 * 1024
_MOST_LIBRARIES, _LONGEST_PATH = 100, 200


def _dds_here() -> dict:
    """Return the DDS libraries that processes have loaded, or that are installed.

    A wheel's library, whose name does not show its version, is of unknown version.
    """
    loaded: set[str] = set()
    unseen = 0 if os.path.exists("/proc/1") else 1  # /proc hides those of other users
    for pid in filter(str.isdigit, os.listdir("/proc")):
        try:
            with open(f"/proc/{pid}/maps", "rb") as file:
                maps = file.read(_MOST_MAPS)
                unseen += bool(file.read(1))
            loaded.update(map(os.fsdecode, _MAPPED.findall(maps)))
        except (FileNotFoundError, ProcessLookupError):
            continue  # it has ended
        except OSError:
            unseen += 1
    installed = {
        os.path.realpath(path)
        for folder in _FOLDERS
        for name in ("fastrtps", "fastdds", "ddsc")
        for path in glob.glob(f"{folder}/lib{name}.so*")
    }
    seen = [(path, "process") for path in sorted(loaded)]
    seen += [(path, "installed") for path in sorted(installed - loaded)]
    more = max(len(seen) - _MOST_LIBRARIES, 0)
    return {
        "libraries": [_library(path, how) for path, how in seen[:_MOST_LIBRARIES]],
        "unseen": unseen + more,
    }


def _library(path: str, seen: str) -> dict:
    version = _VERSION.search(path)
    return {
        "product": "Cyclone DDS" if "/libddsc" in path else "Fast DDS",
        "version": version.group(1) if version else "",
        "path": re.sub(r"[^\w.+/ -]", "?", path[:_LONGEST_PATH]),
        "seen": seen,
    }
