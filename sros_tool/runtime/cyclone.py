"""Cyclone DDS from Python: participants, writers and readers of strings, with DDS Security.

A refusal by DDS Security raises a `SecurityRefusedError`, every other failure a `DdsError`, so that
a crash is never mistaken for a refusal.  A process must not have two participants with different
enclaves in one domain: in Cyclone DDS 0.10, the second participant gets the permissions of the
first.

libddsc is not loaded at import: `load_cyclone` finds and loads it on the first call.  The functions
that sros calls are declared here as in ``dds/dds.h`` of Cyclone DDS 0.10 and 11.0, which agree.

``python -P -m sros_tool.runtime.cyclone DOMAIN PID...`` prints a JSON object that maps participants
of Cyclone DDS on this machine to the ids of their processes.  The participants themselves state
these ids.  The search takes three seconds at most.
"""

from __future__ import annotations

import ctypes
import fcntl
import functools
import json
import os
import re
import socket
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from sros_tool.errors import SrosError, UnavailableError
from sros_tool.files import unpacked_dds_dir
from sros_tool.terminal import echo

_Value = TypeVar("_Value")

FOLDER_VARIABLE = "SROS_CYCLONEDDS_DIR"
"""Environment variable with the only folder to search for libddsc.

The folder may also contain unpacked Debian packages.
"""

_SYSTEM_NAMES = ("libddsc.so.0debian", "libddsc.so.0t64", "libddsc.so.0", "libddsc.so.11")
"""The shared object names of Debian 12, of Debian 13, and of an installation from source or ROS.

ROS 2 Lyrical uses the last name.
"""

INSTALL_ADVICE = (
    "Install Cyclone DDS with `apt-get install libddsc0debian` (Debian 12; newer releases call it"
    " libddsc0t64), or unpack the package and its dependencies into a folder and name the folder"
    f" in {FOLDER_VARIABLE}."
)

_SUPPORTED = ("0.10", "11.0")
_NEEDED_FIRST = ("_platform", "_hoofs", "_posh.", "_posh_roudi", "_posh", "_binding_c")
_KEPT_LOG_MESSAGES = 200
_LOG_HEADER = re.compile(r"^ *\d+\.\d{6} \[\d*\] .*?: ", re.MULTILINE)
"""Matches the time, domain and thread that libddsc writes before a message."""

STRING_TYPE = "std_msgs::msg::dds_::String_"

_NOT_ALLOWED_BY_SECURITY = -13
_ANY_STATE = 0x7F
_BUILTIN_PARTICIPANTS, _BUILTIN_PUBLICATIONS = 0x7FFF0000 + 1, 0x7FFF0000 + 3
_BUILTIN_SUBSCRIPTIONS = 0x7FFF0000 + 4
_KEEP_LAST, _BEST_EFFORT, _RELIABLE, _XCDR1, _XCDR2 = 0, 0, 1, 0, 2
_STRING_OPS = (ctypes.c_uint32 * 3)(0x01 << 24 | 0x05 << 16, 0, 0)
_OCTET_OPS = (ctypes.c_uint32 * 3)(0x01 << 24 | 0x01 << 16, 0, 0)
"""Serialization operations that read only the first byte of a message."""
_NO_OPTIMIZE = 1

_FILE_PROPERTIES = {
    "dds.sec.auth.identity_ca": "identity_ca.cert.pem",
    "dds.sec.auth.identity_certificate": "cert.pem",
    "dds.sec.auth.private_key": "key.pem",
    "dds.sec.access.permissions_ca": "permissions_ca.cert.pem",
    "dds.sec.access.governance": "governance.p7s",
    "dds.sec.access.permissions": "permissions.p7s",
}
"""The properties of a participant that name the files of its enclave."""
ENCLAVE_FILES = tuple(_FILE_PROPERTIES.values())
"""The files that an enclave must have."""
_PLUGINS = {  # part of the property name → library, and the name in its functions
    "auth": ("dds_security_auth", "authentication"),
    "access": ("dds_security_ac", "access_control"),
    "crypto": ("dds_security_crypto", "crypto"),
}
_CRL_PROPERTY = "org.eclipse.cyclonedds.sec.auth.crl"


# ── participants, writers and readers ──────────────────────────────────────────────────────


class DdsError(SrosError):
    """A DDS call that failed for a reason other than security."""


class SecurityRefusedError(DdsError):
    """A refusal of a participant, topic, writer or reader by DDS Security."""


class DiscoveredEndpoint(NamedTuple):
    """The DDS topic name and DDS type name of a discovered writer or reader."""

    topic: str
    type_name: str


class Participant:
    """A DDS participant in ``domain`` (0 to 230), secured by the files of ``enclave`` if given.

    Raises:
        SecurityRefusedError: DDS Security refuses the participant.
        DdsError: DDS cannot create the participant for another reason.
        UnavailableError: Cyclone DDS or its security plugins are missing.
    """

    def __init__(self, domain: int, enclave: Path | None = None) -> None:
        self._library = load_cyclone()
        properties = {} if enclave is None else _security_qos(self._library, enclave)
        with _qos(self._library) as qos:
            for name, value in properties.items():
                self._library.api.dds_qset_prop(qos, name.encode(), value.encode())
            self._library.log.clear()
            handle = self._library.api.dds_create_participant(domain, qos, None)
        if handle < 0:
            raise self._dds_error(
                handle, f"cannot join domain {domain}", secured=enclave is not None
            )
        self.handle: int = handle
        self.domain = domain

    def writer(self, topic: str) -> Writer:
        """Return a reliable DataWriter of strings on the DDS topic ``topic`` ("rt/chatter").

        Raises:
            SecurityRefusedError: the permissions deny the writer.
            DdsError: DDS cannot create the writer for another reason.
        """
        return Writer(self._library, self._endpoint("writer", topic))

    def reader(self, topic: str, *, reliable: bool = True) -> Reader:
        """Return a DataReader of strings on the DDS topic ``topic`` ("rt/chatter").

        Only a reader that is not reliable receives from best-effort writers.

        Raises:
            SecurityRefusedError: the permissions deny the reader.
            DdsError: DDS cannot create the reader for another reason.
        """
        handle = self._endpoint("reader", topic, reliable=reliable)
        return Reader(self._library, handle, self.handle)

    def counter(self, topic: str, type_name: str) -> Reader:
        """Return a best-effort DataReader of any DDS type, which can only count messages.

        Raises:
            SecurityRefusedError: the permissions deny the reader.
            DdsError: DDS cannot create the reader for another reason.
        """
        handle = self._endpoint("reader", topic, type_name, reliable=False)
        return Reader(self._library, handle, self.handle)

    def publications(self) -> tuple[DiscoveredEndpoint, ...]:
        """Return the writers of this participant and all discovered writers, sorted by topic."""
        return tuple(sorted(self._discovered(_BUILTIN_PUBLICATIONS, _publication_of)))

    def subscriptions(self) -> tuple[DiscoveredEndpoint, ...]:
        """Return the readers of this participant and all discovered readers, sorted by topic."""
        return tuple(sorted(self._discovered(_BUILTIN_SUBSCRIPTIONS, _publication_of)))

    def process_ids(self) -> dict[str, int]:
        """Map discovered participants on this machine to their stated process ids.

        A participant is the first 12 bytes of its identifier, in hexadecimal.
        """
        qget = self._library.api.dds_qget_prop

        def participant_and_process(address: int) -> tuple[str, int]:
            sample = ctypes.cast(address, ctypes.POINTER(_ParticipantSample)).contents
            values = []
            for name in (b"__Hostname", b"__Pid"):
                value = ctypes.c_char_p()
                is_present = sample.qos and qget(sample.qos, name, ctypes.byref(value))
                values.append(_text(value.value) if is_present else "")
            is_here = values[0] == socket.gethostname() and values[1].isdecimal()
            return bytes(sample.key[:12]).hex(), int(values[1]) if is_here else 0

        return {
            of: pid
            for of, pid in self._discovered(_BUILTIN_PARTICIPANTS, participant_and_process)
            if pid
        }

    def _discovered(self, topic: int, copy: Callable[[int], _Value]) -> list[_Value]:
        """Return the samples of a built-in topic that lists discovered objects."""
        reader = self._library.api.dds_create_reader(self.handle, topic, None, None)
        if reader < 0:
            raise self._dds_error(
                reader, "cannot read the participants or endpoints that were discovered"
            )
        try:
            return _take_samples(self._library, reader, 1000, copy)
        finally:
            self._library.api.dds_delete(reader)

    def close(self) -> None:
        """Leave the domain, and close the writers and readers of this participant."""
        self._library.api.dds_delete(self.handle)

    def __enter__(self) -> Participant:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def _endpoint(
        self, kind: str, topic: str, type_name: str = STRING_TYPE, *, reliable: bool = True
    ) -> int:
        api = self._library.api
        self._library.log.clear()
        sample: type[StringSample | ctypes.c_uint8] = StringSample
        ops, forms = _STRING_OPS, [_XCDR1]
        if type_name != STRING_TYPE:
            sample, ops, forms = ctypes.c_uint8, _OCTET_OPS, [_XCDR1, _XCDR2]
        descriptor = TopicDescriptor(
            size=ctypes.sizeof(sample),
            align=ctypes.alignment(sample),
            flags=_NO_OPTIMIZE,
            type_name=type_name.encode(),
            op_count=2,
            ops=ops,
            meta=b"",
        )
        with _qos(self._library) as qos:
            api.dds_qset_reliability(qos, _RELIABLE if reliable else _BEST_EFFORT, 100_000_000)
            api.dds_qset_history(qos, _KEEP_LAST, 10)
            api.dds_qset_data_representation(qos, len(forms), (ctypes.c_int16 * len(forms))(*forms))
            # Without QoS, because topics of one name must not differ in QoS, even if their types
            # differ.
            made = api.dds_create_topic(
                self.handle, ctypes.byref(descriptor), topic.encode(), None, None
            )
            if made < 0:
                raise self._dds_error(made, f"cannot create topic {topic}")
            create = api.dds_create_writer if kind == "writer" else api.dds_create_reader
            handle: int = create(self.handle, made, qos, None)
        if handle < 0:
            api.dds_delete(made)
            raise self._dds_error(handle, f"cannot create a {kind} on {topic}")
        return handle

    def _dds_error(self, code: int, fault: str, *, secured: bool = False) -> DdsError:
        from sros_tool.runtime.vendor_log import participant_refusal

        messages = self._library.log.messages()
        reason = ". ".join([_return_code_text(self._library, code), *messages[-3:]])
        refused = code == _NOT_ALLOWED_BY_SECURITY or (
            secured and bool(participant_refusal("\n".join(messages)))
        )
        if refused:
            return SecurityRefusedError(fault, reason)
        return DdsError(
            fault, reason, _TOO_MANY_PARTICIPANTS if "participant index" in reason else ""
        )


MORE_PARTICIPANTS = (
    "<CycloneDDS><Domain><Discovery><MaxAutoParticipantIndex>100</MaxAutoParticipantIndex>"
    "</Discovery></Domain></CycloneDDS>"
)
"""The CYCLONEDDS_URI with which Cyclone DDS joins a domain with ten participants and more.

Without multicast, its default allows ten on each host.
"""
_TOO_MANY_PARTICIPANTS = (
    "Without multicast, Cyclone DDS has room for ten participants of a domain on each host. Allow "
    f"more with CYCLONEDDS_URI='{MORE_PARTICIPANTS}', or, for "
    "`sros demo talker` and `listener`, add --backend rclpy."
)


class Writer:
    """A writer of strings, created by `Participant.writer`."""

    def __init__(self, library: CycloneLibrary, handle: int) -> None:
        self._library = library
        self.handle = handle

    def write(self, text: str) -> None:
        """Send a message.

        Raises:
            DdsError: the message could not be written.
        """
        sample = StringSample(text.encode())
        code = self._library.api.dds_write(self.handle, ctypes.byref(sample))
        if code < 0:
            raise DdsError("cannot write", _return_code_text(self._library, code))


class Reader:
    """A reader of strings, created by `Participant.reader`."""

    def __init__(self, library: CycloneLibrary, handle: int, participant: int) -> None:
        self._library = library
        self._participant = participant
        self._waitset = 0
        self.handle = handle

    def wait(self, seconds: float) -> bool:
        """Wait at most ``seconds`` for a message; return whether a message has arrived."""
        api = self._library.api
        if not self._waitset:
            condition = api.dds_create_readcondition(self.handle, _ANY_STATE)
            waitset = api.dds_create_waitset(self._participant)
            if condition < 0 or waitset < 0:
                raise DdsError(
                    "cannot wait", _return_code_text(self._library, min(condition, waitset))
                )
            api.dds_waitset_attach(waitset, condition, 0)
            self._waitset = waitset
        return bool(api.dds_waitset_wait(self._waitset, None, 0, int(seconds * 1e9)) > 0)

    def take(self) -> tuple[str, ...]:
        """Return the messages received since the last call, oldest first."""
        return tuple(_take_samples(self._library, self.handle, 64, _string_of))

    def count(self) -> int:
        """Return the number of messages received since the last call."""
        return len(_take_samples(self._library, self.handle, 64, lambda _: None))


def security_properties(enclave: Path, plugins: Path | None) -> dict[str, str]:
    """Return the properties with which rmw_cyclonedds makes Cyclone DDS load ``enclave``.

    ``plugins`` is the folder of libdds_security_*.so; without this folder, the dynamic loader
    searches for the plugins.

    Raises:
        DdsError: a file of the enclave is missing.
    """
    folder = enclave.absolute()
    for name in ENCLAVE_FILES:
        if not (folder / name).is_file():
            raise DdsError(
                f"cannot load the enclave {folder}",
                f"It has no file {name}.",
                "Create the enclave again with `sros create_enclave`.",
            )
    properties = {key: f"file:{folder / name}" for key, name in _FILE_PROPERTIES.items()}
    if (folder / "crl.pem").is_file():
        properties[_CRL_PROPERTY] = f"file:{folder / 'crl.pem'}"
    for part, (library, function) in _PLUGINS.items():
        file = library if plugins is None else str(plugins / f"lib{library}.so")
        properties[f"dds.sec.{part}.library.path"] = file
        properties[f"dds.sec.{part}.library.init"] = f"init_{function}"
        properties[f"dds.sec.{part}.library.finalize"] = f"finalize_{function}"
    return properties


def _security_qos(library: CycloneLibrary, enclave: Path) -> dict[str, str]:
    if library.plugins is None:
        raise UnavailableError(
            "cannot secure a participant with Cyclone DDS",
            f"Its security plugins (libdds_security_*.so) are not next to {library.path}.",
            INSTALL_ADVICE,
        )
    return security_properties(enclave, library.plugins)


@contextmanager
def _qos(library: CycloneLibrary) -> Iterator[Any]:
    qos = library.api.dds_create_qos()
    try:
        yield qos
    finally:
        library.api.dds_delete_qos(qos)


def _take_samples(
    library: CycloneLibrary, handle: int, limit: int, copy: Callable[[int], _Value]
) -> list[_Value]:
    """Return up to ``limit`` samples; ``copy`` converts a sample before DDS frees its memory."""
    samples = (ctypes.c_void_p * limit)()
    infos = (SampleInfo * limit)()
    count = library.api.dds_take(handle, samples, infos, limit, limit)
    if count < 0:
        raise DdsError("cannot read", _return_code_text(library, count))
    try:
        return [
            copy(address)
            for address, info in zip(samples[:count], infos[:count], strict=True)
            if info.valid_data and address is not None
        ]
    finally:
        if count:
            library.api.dds_return_loan(handle, samples, count)


def _string_of(address: int) -> str:
    return _text(ctypes.cast(address, ctypes.POINTER(StringSample)).contents.data)


def _publication_of(address: int) -> DiscoveredEndpoint:
    sample = ctypes.cast(address, ctypes.POINTER(_EndpointSample)).contents
    return DiscoveredEndpoint(_text(sample.topic_name), _text(sample.type_name))


def _text(raw: bytes | None) -> str:
    return (raw or b"").decode("utf-8", "replace")


# ── the library ────────────────────────────────────────────────────────────────────────────


class CycloneLibrary(NamedTuple):
    """A loaded libddsc: its functions, its file, and its log.

    ``version`` is the version in the file name ("0.10.2"); ``plugins`` is the folder of the
    security plugins, or None.
    """

    api: Any
    path: Path
    version: str
    plugins: Path | None
    log: CycloneLog


class CycloneLog:
    """The warnings and errors that Cyclone DDS logs for all participants of this process.

    libddsc writes these messages to ``stderr`` of the C library; Cyclone DDS 11 exports no function
    that receives messages. So this C stream becomes a file in memory, for all C libraries of this
    process; Python's ``sys.stderr`` and the file descriptor 2 stay as they are.
    """

    def __init__(self) -> None:
        """Redirect the stream ``stderr`` of the C library to a file in memory.

        libddsc keeps the stream that exists when the first participant is created.
        """
        self._file = _memory_file()
        self._made = os.fstat(self._file)
        libc = ctypes.CDLL(None)
        libc.fdopen.restype = ctypes.c_void_p
        ctypes.c_void_p.in_dll(libc, "stderr").value = libc.fdopen(self._file, b"a")
        os.register_at_fork(after_in_child=self._use_own_file_after_fork)

    def _use_own_file_after_fork(self) -> None:
        """Write to a new file if this process was forked from the process that opened the log.

        The parent's descriptor stays open, because it may belong to another file if the parent
        closed the log.
        """
        with suppress(OSError):
            if os.path.samestat(os.fstat(self._file), self._made):
                file = _memory_file()
                os.dup2(file, self._file)
                os.close(file)
                self._made = os.fstat(self._file)

    def clear(self) -> None:
        """Discard the messages."""
        os.ftruncate(self._file, 0)

    def messages(self) -> tuple[str, ...]:
        """Return the newest messages since `clear`, oldest first."""
        written = os.pread(self._file, os.fstat(self._file).st_size, 0).decode("utf-8", "replace")
        messages = (message.rstrip() for message in _LOG_HEADER.split(written))
        return tuple(filter(None, messages))[-_KEPT_LOG_MESSAGES:]


def _memory_file() -> int:
    """Return the descriptor of a file in memory to which every write is appended."""
    file = os.memfd_create("cyclonedds")
    fcntl.fcntl(file, fcntl.F_SETFL, os.O_APPEND)
    return file


def _return_code_text(library: CycloneLibrary, code: int) -> str:
    """Return the name of a (negative) return code, as the library gives it."""
    return str(library.api.dds_strretcode(code).decode("ascii", "replace"))


@functools.cache
def load_cyclone() -> CycloneLibrary:
    """Load libddsc 0.10 or 11.0, once per process.

    Raises:
        UnavailableError: there is no libddsc, or its C interface is another one.
    """
    api, path = _load_first()
    version = version_of(path)
    if not version.startswith(tuple(f"{release}." for release in _SUPPORTED)):
        raise UnavailableError(
            f"cannot use {path}: it is Cyclone DDS {version}",
            f"sros supports only the C interface of Cyclone DDS {' and '.join(_SUPPORTED)}.",
            INSTALL_ADVICE,
        )
    for name, (result, arguments) in _SIGNATURES.items():
        function = getattr(api, name)
        function.restype = result
        function.argtypes = arguments
    return CycloneLibrary(api, path, version, plugins_next_to(path), CycloneLog())


def _load_first() -> tuple[Any, Path]:
    named = os.environ.get(FOLDER_VARIABLE)
    if named:
        return _load_from_folder(Path(named))
    unpacked = unpacked_dds_dir()
    if unpacked.is_dir() and _library_files(unpacked):
        return _load_from_folder(unpacked)
    reasons = []
    for name in _SYSTEM_NAMES:
        try:
            api = ctypes.CDLL(name)
            return api, next(iter(loaded_libraries("libddsc")))
        except OSError as error:
            reasons.append(str(error))
    raise UnavailableError(
        f"cannot find Cyclone DDS (libddsc {' or '.join(_SUPPORTED)})",
        f"The dynamic loader says: {reasons[0]}.",
        INSTALL_ADVICE,
    )


def _load_from_folder(folder: Path) -> tuple[Any, Path]:
    files = _library_files(folder)
    if not files:
        raise UnavailableError(
            f"cannot find Cyclone DDS in {folder}",
            "The folder has no libddsc.so.*, neither directly nor under lib or usr/lib.",
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
        for file in sorted(folder.glob(f"{pattern}/libddsc.so.[0-9]*".lstrip("/")))
        if file.is_file()
    ]


def _load_all(files: Iterable[Path]) -> None:
    """Load libraries that depend on each other; ignore libraries that cannot be loaded.

    After that, libddsc finds the libraries by name, without LD_LIBRARY_PATH. Dependencies are
    loaded first, because the dynamic loader might otherwise load the system's copies.
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
    """Return the shared libraries loaded in this process whose names start with ``prefix``."""
    maps = Path("/proc/self/maps").read_text(encoding="utf-8", errors="replace")
    files = {Path("/" + line.partition("/")[2]) for line in maps.splitlines() if "/" in line}
    return tuple(sorted(file.resolve() for file in files if file.name.startswith(prefix)))


def version_of(path: Path) -> str:
    """Return the version in a shared library's name: "0.10.2" of libddsc.so.0.10.2.

    Wheels contain copies instead of links, so the loaded file may have the shortest name; then the
    names of its copies count.  Without a version, the result is "of unknown version".
    """
    copies = [copy for copy in path.parent.glob(f"{path.name}.*") if _same_size(copy, path)]
    name = max([path.name, *(copy.name for copy in copies)], key=len)
    version = re.search(r"\.so\.(\d+(?:\.\d+)+)$", name)
    return version.group(1) if version else "of unknown version"


def _same_size(path: Path, other: Path) -> bool:
    return path.stat().st_size == other.stat().st_size


def plugins_next_to(path: Path) -> Path | None:
    """Return the folder of the security plugins that belong to the libddsc at ``path``, or None."""
    folders = [*sorted(path.parent.glob("libddsc0*/")), path.parent]
    for folder in folders:
        if all((folder / f"lib{library}.so").is_file() for library, _ in _PLUGINS.values()):
            return folder
    return None


# ── the C interface of libddsc ────────────────────────────────────────────────────────────


class TopicDescriptor(ctypes.Structure):
    """The C struct ``dds_topic_descriptor_t`` of Cyclone DDS."""

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
    """The C struct ``dds_sample_info_t`` of Cyclone DDS."""

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
    """The C form of ``std_msgs/msg/String``: a pointer to characters."""

    _fields_ = [("data", ctypes.c_char_p)]


class _EndpointSample(ctypes.Structure):
    """The C struct ``dds_builtintopic_endpoint_t``: a discovered writer or reader."""

    _fields_ = [
        ("key", ctypes.c_uint8 * 16),
        ("participant_key", ctypes.c_uint8 * 16),
        ("participant_handle", ctypes.c_uint64),
        ("topic_name", ctypes.c_char_p),
        ("type_name", ctypes.c_char_p),
        ("qos", ctypes.c_void_p),
    ]


class _ParticipantSample(ctypes.Structure):
    """The C struct ``dds_builtintopic_participant_t``: a discovered participant."""

    _fields_ = [("key", ctypes.c_uint8 * 16), ("qos", ctypes.c_void_p)]


_ENTITY = ctypes.c_int32
_QOS = ctypes.c_void_p
_SIGNATURES: dict[str, tuple[Any, list[Any]]] = {
    "dds_strretcode": (ctypes.c_char_p, [ctypes.c_int32]),
    "dds_create_qos": (_QOS, []),
    "dds_delete_qos": (None, [_QOS]),
    "dds_qset_prop": (None, [_QOS, ctypes.c_char_p, ctypes.c_char_p]),
    "dds_qget_prop": (
        ctypes.c_bool,
        [_QOS, ctypes.c_char_p, ctypes.POINTER(ctypes.c_char_p)],
    ),
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
    "dds_create_waitset": (_ENTITY, [_ENTITY]),
    "dds_create_readcondition": (_ENTITY, [_ENTITY, ctypes.c_uint32]),
    "dds_waitset_attach": (ctypes.c_int32, [_ENTITY, _ENTITY, ctypes.c_ssize_t]),
    "dds_waitset_wait": (
        ctypes.c_int32,
        [_ENTITY, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int64],
    ),
    "dds_delete": (ctypes.c_int32, [_ENTITY]),
}


_LOOK_SECONDS = 3.0


def main() -> int:
    """Print the process ids of participants; return the exit status."""
    domain, wanted = int(sys.argv[1]), {int(pid) for pid in sys.argv[2:]}
    with Participant(domain) as participant:
        end = time.monotonic() + _LOOK_SECONDS
        while not wanted <= {*(process_ids := participant.process_ids()).values()}:
            if time.monotonic() > end:
                break
            time.sleep(0.05)
    echo(json.dumps(process_ids))
    return 0


if __name__ == "__main__":
    sys.exit(main())
