"""Find and load Cyclone DDS 0.10.x, and declare the part of its C interface that sros calls.

Nothing is loaded at import: `load_cyclone` does it on the first call and remembers the answer.
The structures follow ``dds/dds.h`` and ``dds/ddsrt/log.h`` of Cyclone DDS 0.10.
"""

from __future__ import annotations

import ctypes
import functools
import os
import re
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sros_tool.errors import UnavailableError
from sros_tool.resources import unpacked_dds_dir

FOLDER_VARIABLE = "SROS_CYCLONEDDS_DIR"
"""A folder with libddsc, or one in which Debian's packages were unpacked; nothing else is tried."""

SYSTEM_NAMES = ("libddsc.so.0debian", "libddsc.so.0t64", "libddsc.so.0")
"""The shared object names of Debian 12, of Debian 13, and of an installation from source or ROS."""

INSTALL_ADVICE = (
    "Install Cyclone DDS with `apt-get install libddsc0debian` (Debian 12; newer releases call it"
    " libddsc0t64), or unpack the package and those that it depends on into a folder and name that"
    f" in {FOLDER_VARIABLE}."
)

_SUPPORTED = "0.10."
_PLUGINS = ("auth", "ac", "crypto")
_NEEDED_FIRST = ("_platform", "_hoofs", "_posh", "_binding_c")
_KEPT_LOG_LINES = 200


class TopicDescriptor(ctypes.Structure):
    """``dds_topic_descriptor_t``."""

    _fields_ = [
        ("size", ctypes.c_uint32),
        ("align", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("key_count", ctypes.c_uint32),
        ("type_name", ctypes.c_char_p),
        ("keys", ctypes.c_void_p),
        ("op_count", ctypes.c_uint32),
        ("ops", ctypes.POINTER(ctypes.c_uint32)),
        ("meta", ctypes.c_char_p),
        ("type_information", ctypes.c_void_p),
        ("type_information_size", ctypes.c_uint32),
        ("type_mapping", ctypes.c_void_p),
        ("type_mapping_size", ctypes.c_uint32),
        ("data_representations", ctypes.c_uint32),
    ]


class SampleInfo(ctypes.Structure):
    """``dds_sample_info_t``."""

    _fields_ = [
        ("sample_state", ctypes.c_int),
        ("view_state", ctypes.c_int),
        ("instance_state", ctypes.c_int),
        ("valid_data", ctypes.c_bool),
        ("source_timestamp", ctypes.c_int64),
        ("instance_handle", ctypes.c_uint64),
        ("publication_handle", ctypes.c_uint64),
        ("disposed_generations", ctypes.c_uint32),
        ("no_writers_generations", ctypes.c_uint32),
        ("sample_rank", ctypes.c_uint32),
        ("generation_rank", ctypes.c_uint32),
        ("absolute_generation_rank", ctypes.c_uint32),
    ]


class StringSample(ctypes.Structure):
    """The C form of ``std_msgs/msg/String``: one pointer to characters."""

    _fields_ = [("data", ctypes.c_char_p)]


class EndpointSample(ctypes.Structure):
    """``dds_builtintopic_endpoint_t``: a writer or reader that discovery has found."""

    _fields_ = [
        ("key", ctypes.c_uint8 * 16),
        ("participant_key", ctypes.c_uint8 * 16),
        ("participant_handle", ctypes.c_uint64),
        ("topic_name", ctypes.c_char_p),
        ("type_name", ctypes.c_char_p),
        ("qos", ctypes.c_void_p),
    ]


class _LogLine(ctypes.Structure):
    """``dds_log_data_t``."""

    _fields_ = [
        ("priority", ctypes.c_uint32),
        ("domain", ctypes.c_uint32),
        ("file", ctypes.c_char_p),
        ("line", ctypes.c_uint32),
        ("function", ctypes.c_char_p),
        ("message", ctypes.POINTER(ctypes.c_char)),
        ("size", ctypes.c_size_t),
        ("header_size", ctypes.c_size_t),
    ]


_LOG_SINK = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.POINTER(_LogLine))

_ENTITY = ctypes.c_int32
_QOS = ctypes.c_void_p
_SIGNATURES: dict[str, tuple[Any, list[Any]]] = {
    "dds_strretcode": (ctypes.c_char_p, [ctypes.c_int32]),
    "dds_create_qos": (_QOS, []),
    "dds_delete_qos": (None, [_QOS]),
    "dds_qset_prop": (None, [_QOS, ctypes.c_char_p, ctypes.c_char_p]),
    "dds_qset_reliability": (None, [_QOS, ctypes.c_int, ctypes.c_int64]),
    "dds_qset_history": (None, [_QOS, ctypes.c_int, ctypes.c_int32]),
    "dds_qset_data_representation": (
        None,
        [_QOS, ctypes.c_uint32, ctypes.POINTER(ctypes.c_int16)],
    ),
    "dds_create_participant": (_ENTITY, [ctypes.c_uint32, _QOS, ctypes.c_void_p]),
    "dds_create_topic": (
        _ENTITY,
        [_ENTITY, ctypes.POINTER(TopicDescriptor), ctypes.c_char_p, _QOS, ctypes.c_void_p],
    ),
    "dds_create_writer": (_ENTITY, [_ENTITY, _ENTITY, _QOS, ctypes.c_void_p]),
    "dds_create_reader": (_ENTITY, [_ENTITY, _ENTITY, _QOS, ctypes.c_void_p]),
    "dds_write": (ctypes.c_int32, [_ENTITY, ctypes.c_void_p]),
    "dds_take": (
        ctypes.c_int32,
        [
            _ENTITY,
            ctypes.POINTER(ctypes.c_void_p),
            ctypes.POINTER(SampleInfo),
            ctypes.c_size_t,
            ctypes.c_uint32,
        ],
    ),
    "dds_return_loan": (
        ctypes.c_int32,
        [_ENTITY, ctypes.POINTER(ctypes.c_void_p), ctypes.c_int32],
    ),
    "dds_get_matched_subscriptions": (
        ctypes.c_int32,
        [_ENTITY, ctypes.c_void_p, ctypes.c_size_t],
    ),
    "dds_get_matched_publications": (
        ctypes.c_int32,
        [_ENTITY, ctypes.c_void_p, ctypes.c_size_t],
    ),
    "dds_create_waitset": (_ENTITY, [_ENTITY]),
    "dds_create_readcondition": (_ENTITY, [_ENTITY, ctypes.c_uint32]),
    "dds_waitset_attach": (ctypes.c_int32, [_ENTITY, _ENTITY, ctypes.c_ssize_t]),
    "dds_waitset_wait": (
        ctypes.c_int32,
        [_ENTITY, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int64],
    ),
    "dds_delete": (ctypes.c_int32, [_ENTITY]),
    "dds_set_log_sink": (None, [_LOG_SINK, ctypes.c_void_p]),
}


@dataclass(frozen=True)
class CycloneLibrary:
    """A loaded libddsc: its functions, where it lies, and what it has logged.

    ``version`` is as in its file name ("0.10.2"); ``plugins`` is the folder of its security
    plugins, None where they are missing.  ``log`` keeps the newest warnings and errors of all
    participants of this process, oldest first.
    """

    api: Any
    path: Path
    version: str
    plugins: Path | None
    log: deque[str]
    sink: Any


def describe_return(library: CycloneLibrary, code: int) -> str:
    """The library's own name of a (negative) return code."""
    return str(library.api.dds_strretcode(code).decode("ascii", "replace"))


@functools.cache
def load_cyclone() -> CycloneLibrary:
    """Load libddsc 0.10.x once per process.

    Raises `UnavailableError` where there is none, or one whose C interface is another.
    """
    api, path = _load_first()
    version = version_of(path)
    if not version.startswith(_SUPPORTED):
        raise UnavailableError(
            f"cannot use {path}: it is Cyclone DDS {version}",
            f"sros speaks the C interface of Cyclone DDS {_SUPPORTED}x only.",
            INSTALL_ADVICE,
        )
    for name, (result, arguments) in _SIGNATURES.items():
        function = getattr(api, name)
        function.restype = result
        function.argtypes = arguments
    log: deque[str] = deque(maxlen=_KEPT_LOG_LINES)

    def keep(_argument: int | None, line: Any) -> None:
        data = line.contents
        log.append(ctypes.string_at(data.message, data.size).decode("utf-8", "replace").rstrip())

    sink = _LOG_SINK(keep)
    api.dds_set_log_sink(sink, None)
    return CycloneLibrary(api, path, version, plugins_beside(path), log, sink)


def _load_first() -> tuple[Any, Path]:
    named = os.environ.get(FOLDER_VARIABLE)
    if named:
        return _load_from_folder(Path(named))
    unpacked = unpacked_dds_dir()
    if unpacked.is_dir() and _library_files(unpacked):
        return _load_from_folder(unpacked)
    reasons = []
    for name in SYSTEM_NAMES:
        try:
            api = ctypes.CDLL(name)
            return api, next(iter(loaded_libraries("libddsc")))
        except OSError as error:
            reasons.append(str(error))
    raise UnavailableError(
        "cannot find Cyclone DDS (libddsc 0.10)",
        f"The dynamic loader says: {reasons[0]}.",
        INSTALL_ADVICE,
    )


def _load_from_folder(folder: Path) -> tuple[Any, Path]:
    files = _library_files(folder)
    if not files:
        raise UnavailableError(
            f"cannot find Cyclone DDS in {folder}",
            "The folder holds no libddsc.so.0*, neither directly nor under lib or usr/lib.",
            f"Correct or unset {FOLDER_VARIABLE}. {INSTALL_ADVICE}",
        )
    path = files[0]
    _load_all(path.parent.glob("libiceoryx_*.so.*"))
    try:
        return ctypes.CDLL(str(path)), path.resolve()
    except OSError as error:
        raise UnavailableError(
            f"cannot load {path}",
            f"The dynamic loader says: {error}.",
            "Unpack the packages that it depends on (libiceoryx-*2) into the same folder.",
        ) from error


def _library_files(folder: Path) -> list[Path]:
    patterns = ("", "lib", "lib/*", "usr/lib", "usr/lib/*")
    return [
        file
        for pattern in patterns
        for file in sorted(folder.glob(f"{pattern}/libddsc.so.0*".lstrip("/")))
        if file.is_file()
    ]


def _load_all(files: Iterable[Path]) -> None:
    """Load libraries that need each other, in whatever order works; ignore what never loads.

    With them in memory under their own names, libddsc finds them without LD_LIBRARY_PATH.  Those
    that others need come first, or the loader might take the system's copy beside ours.
    """
    waiting = sorted(files, key=_load_order)
    while waiting:
        failed = []
        for file in waiting:
            try:
                ctypes.CDLL(str(file), mode=ctypes.RTLD_GLOBAL)
            except OSError:
                failed.append(file)
        if len(failed) == len(waiting):
            return
        waiting = failed


def _load_order(file: Path) -> tuple[int, str]:
    places = [place for place, part in enumerate(_NEEDED_FIRST) if part in file.name]
    return (places[0] if places else len(_NEEDED_FIRST), file.name)


def loaded_libraries(prefix: str) -> tuple[Path, ...]:
    """The real files of the shared libraries in this process whose names start with ``prefix``."""
    maps = Path("/proc/self/maps").read_text(encoding="utf-8", errors="replace")
    files = {Path("/" + line.partition("/")[2]) for line in maps.splitlines() if "/" in line}
    return tuple(sorted(file.resolve() for file in files if file.name.startswith(prefix)))


def version_of(path: Path) -> str:
    """The version in the name of a shared library: "0.10.2" of libddsc.so.0.10.2.

    Wheels hold copies in place of links, so that the loaded one may have the shortest name.
    """
    copies = [copy for copy in path.parent.glob(f"{path.name}.*") if _same_size(copy, path)]
    name = max([path.name, *(copy.name for copy in copies)], key=len)
    found = re.search(r"\.so\.(\d+(?:\.\d+)+)$", name)
    return found.group(1) if found else "of unknown version"


def _same_size(one: Path, other: Path) -> bool:
    return one.stat().st_size == other.stat().st_size


def plugins_beside(path: Path) -> Path | None:
    """The folder of the security plugins that belong to the libddsc at ``path``, or None."""
    folders = [*sorted(path.parent.glob("libddsc0*/")), path.parent]
    for folder in folders:
        if all((folder / f"libdds_security_{name}.so").is_file() for name in _PLUGINS):
            return folder
    return None
