"""Cyclone DDS participants, writers and readers of strings, secured by an enclave or not.

A refusal by DDS Security is a `SecurityRefusedError`; everything else that fails is a `DdsError`,
so that nobody takes a crash for a closed door.  One process must not hold two participants with
different enclaves in one domain: Cyclone 0.10 lets the second borrow the first one's permissions.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

from sros_tool.errors import SrosError, UnavailableError
from sros_tool.runtime.cyclone_library import (
    INSTALL_ADVICE,
    CycloneLibrary,
    EndpointSample,
    SampleInfo,
    StringSample,
    TopicDescriptor,
    describe_return,
    load_cyclone,
)
from sros_tool.runtime.security_log import participant_refusal

_Value = TypeVar("_Value")

STRING_TYPE = "std_msgs::msg::dds_::String_"

_NOT_ALLOWED_BY_SECURITY = -13
_ANY_STATE = 0x7F
_BUILTIN_PUBLICATIONS = 0x7FFF0000 + 3
_KEEP_LAST, _RELIABLE, _XCDR1 = 0, 1, 0
_STRING_OPS = (ctypes.c_uint32 * 3)(0x01 << 24 | 0x05 << 16, 0, 0)
_NO_OPTIMIZE = 1

_FILE_PROPERTIES = {
    "dds.sec.auth.identity_ca": "identity_ca.cert.pem",
    "dds.sec.auth.identity_certificate": "cert.pem",
    "dds.sec.auth.private_key": "key.pem",
    "dds.sec.access.permissions_ca": "permissions_ca.cert.pem",
    "dds.sec.access.governance": "governance.p7s",
    "dds.sec.access.permissions": "permissions.p7s",
}
ENCLAVE_FILES = tuple(_FILE_PROPERTIES.values())
"""The files that an enclave must have."""
_PLUGINS = {
    "auth": ("dds_security_auth", "authentication"),
    "access": ("dds_security_ac", "access_control"),
    "crypto": ("dds_security_crypto", "crypto"),
}
_CRL_PROPERTY = "org.eclipse.cyclonedds.sec.auth.crl"


class DdsError(SrosError):
    """A DDS call that failed for a reason other than security."""


class SecurityRefusedError(DdsError):
    """DDS Security refused a participant, a topic, a writer or a reader."""


@dataclass(frozen=True, order=True)
class Publication:
    """A writer that discovery has found: its DDS topic name and DDS type name."""

    topic: str
    type_name: str


class Participant:
    """A DDS participant in ``domain`` (0 to 230), secured by the files of ``enclave`` if given.

    Raises `SecurityRefusedError`, `DdsError`, and `UnavailableError` where Cyclone DDS or its
    security plugins are missing.
    """

    def __init__(self, domain: int, enclave: Path | None = None) -> None:
        self._library = load_cyclone()
        properties = {} if enclave is None else _secured(self._library, enclave)
        with _qos(self._library) as qos:
            for name, value in properties.items():
                self._library.api.dds_qset_prop(qos, name.encode(), value.encode())
            self._library.log.clear()
            handle = self._library.api.dds_create_participant(domain, qos, None)
        if handle < 0:
            raise self._failure(handle, f"cannot join domain {domain}", secured=enclave is not None)
        self.handle: int = handle
        self.domain = domain

    def writer(self, topic: str) -> Writer:
        """A reliable writer of strings on the DDS topic ``topic`` ("rt/chatter")."""
        return Writer(self._library, self._endpoint("writer", topic))

    def reader(self, topic: str) -> Reader:
        """A reliable reader of strings on the DDS topic ``topic`` ("rt/chatter")."""
        return Reader(self._library, self._endpoint("reader", topic), self.handle)

    def publications(self) -> tuple[Publication, ...]:
        """The writers that this participant knows of, its own among them, sorted."""
        api = self._library.api
        reader = api.dds_create_reader(self.handle, _BUILTIN_PUBLICATIONS, None, None)
        if reader < 0:
            raise self._failure(reader, "cannot read the discovered publications")
        try:
            return tuple(sorted(_take(self._library, reader, 1000, _publication_of)))
        finally:
            api.dds_delete(reader)

    @property
    def log(self) -> tuple[str, ...]:
        """The newest warnings and errors that Cyclone DDS logged in this process."""
        return tuple(self._library.log)

    def close(self) -> None:
        """Leave the domain; writers and readers of this participant end with it."""
        self._library.api.dds_delete(self.handle)

    def __enter__(self) -> Participant:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _endpoint(self, kind: str, topic: str) -> int:
        api = self._library.api
        self._library.log.clear()
        descriptor = TopicDescriptor(
            size=ctypes.sizeof(StringSample),
            align=ctypes.alignment(StringSample),
            flags=_NO_OPTIMIZE,
            type_name=STRING_TYPE.encode(),
            op_count=2,
            ops=_STRING_OPS,
            meta=b"",
        )
        with _qos(self._library) as qos:
            api.dds_qset_reliability(qos, _RELIABLE, 100_000_000)
            api.dds_qset_history(qos, _KEEP_LAST, 10)
            api.dds_qset_data_representation(qos, 1, (ctypes.c_int16 * 1)(_XCDR1))
            made = api.dds_create_topic(
                self.handle, ctypes.byref(descriptor), topic.encode(), qos, None
            )
            if made < 0:
                raise self._failure(made, f"cannot create topic {topic}")
            create = api.dds_create_writer if kind == "writer" else api.dds_create_reader
            handle: int = create(self.handle, made, qos, None)
        if handle < 0:
            api.dds_delete(made)
            raise self._failure(handle, f"cannot create a {kind} on {topic}")
        return handle

    def _failure(self, code: int, what: str, *, secured: bool = False) -> DdsError:
        lines = tuple(self._library.log)
        reason = ". ".join([describe_return(self._library, code), *lines[-3:]])
        refused = code == _NOT_ALLOWED_BY_SECURITY or (
            secured and bool(participant_refusal("\n".join(lines)))
        )
        return SecurityRefusedError(what, reason) if refused else DdsError(what, reason)


class Writer:
    """Writes strings; made by `Participant.writer`."""

    def __init__(self, library: CycloneLibrary, handle: int) -> None:
        self._library = library
        self.handle = handle

    def write(self, text: str) -> None:
        """Send one message.  Raises `DdsError`."""
        sample = StringSample(text.encode())
        code = self._library.api.dds_write(self.handle, ctypes.byref(sample))
        if code < 0:
            raise DdsError("cannot write", describe_return(self._library, code))

    def matched(self) -> int:
        """How many readers this writer sends to."""
        return max(0, int(self._library.api.dds_get_matched_subscriptions(self.handle, None, 0)))


class Reader:
    """Reads strings; made by `Participant.reader`."""

    def __init__(self, library: CycloneLibrary, handle: int, participant: int) -> None:
        self._library = library
        self._participant = participant
        self._waitset = 0
        self.handle = handle

    def wait(self, seconds: float) -> bool:
        """Sleep until there is something to take, but no longer than ``seconds``."""
        api = self._library.api
        if not self._waitset:
            condition = api.dds_create_readcondition(self.handle, _ANY_STATE)
            waitset = api.dds_create_waitset(self._participant)
            if condition < 0 or waitset < 0:
                raise DdsError(
                    "cannot wait", describe_return(self._library, min(condition, waitset))
                )
            api.dds_waitset_attach(waitset, condition, 0)
            self._waitset = waitset
        return bool(api.dds_waitset_wait(self._waitset, None, 0, int(seconds * 1e9)) > 0)

    def take(self) -> tuple[str, ...]:
        """The messages that have come since the last call, oldest first."""
        return tuple(_take(self._library, self.handle, 64, _string_of))

    def matched(self) -> int:
        """How many writers this reader hears."""
        return max(0, int(self._library.api.dds_get_matched_publications(self.handle, None, 0)))


def security_properties(enclave: Path, plugins: Path | None) -> dict[str, str]:
    """The participant properties that make Cyclone DDS load ``enclave``, as rmw_cyclonedds does.

    ``plugins`` is the folder of libdds_security_*.so; without one the dynamic loader looks for
    them.  Raises `DdsError` where the enclave lacks a file.
    """
    folder = enclave.absolute()
    for name in ENCLAVE_FILES:
        if not (folder / name).is_file():
            raise DdsError(
                f"cannot load the enclave {folder}",
                f"It has no file {name}.",
                "Make the enclave again with `sros create_enclave`.",
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


def _secured(library: CycloneLibrary, enclave: Path) -> dict[str, str]:
    if library.plugins is None:
        raise UnavailableError(
            "cannot secure a participant with Cyclone DDS",
            f"Its security plugins (libdds_security_*.so) do not lie beside {library.path}.",
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


def _take(
    library: CycloneLibrary, handle: int, limit: int, copy: Callable[[int], _Value]
) -> list[_Value]:
    """Take up to ``limit`` samples; ``copy`` makes a value of each while it is on loan."""
    samples = (ctypes.c_void_p * limit)()
    infos = (SampleInfo * limit)()
    count = library.api.dds_take(handle, samples, infos, limit, limit)
    if count < 0:
        raise DdsError("cannot read", describe_return(library, count))
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


def _publication_of(address: int) -> Publication:
    found = ctypes.cast(address, ctypes.POINTER(EndpointSample)).contents
    return Publication(_text(found.topic_name), _text(found.type_name))


def _text(raw: bytes | None) -> str:
    return (raw or b"").decode("utf-8", "replace")
