"""A reader of Zenoh configurations that sros did not write: JSON5, or YAML in JSON syntax.

Zenoh chooses the language by the ending of the file name, and reads no files with other endings.

Only settings that matter for security become values.  `ConfigurationDocument.unknown` names
settings that do not exist in any version up to 1.10.  A file that Zenoh refuses is an error,
because no process starts with it.  Source: commons/zenoh-config of zenoh 1.9; compared with the
wheel 1.10.2.
"""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from enum import StrEnum
from math import prod
from typing import TypeVar

from sros_tool.errors import DocumentError
from sros_tool.zenoh.access import (
    PROPERTIES,
    AclPolicy,
    AclRule,
    AclSubject,
    Enforcement,
    Flow,
    Message,
)
from sros_tool.zenoh.configuration import Mode
from sros_tool.zenoh.json5 import MOST_BYTES, Json5Error, Json5Object, parse_json, parse_json5
from sros_tool.zenoh.key_expressions import expression_problem

_E = TypeVar("_E", bound=StrEnum)

_SECTIONS = frozenset(
    {"id", "metadata", "mode", "region_name", "gateway", "connect", "listen", "open", "scouting"}
    | {"timestamping", "queries_default_timeout", "routing", "aggregation", "qos", "transport"}
    | {"adminspace", "namespace", "downsampling", "access_control", "low_pass_filter", "stats"}
    | {"plugins_loading", "plugins"}
)
_TLS_FILES = (
    "root_ca_certificate",
    "listen_private_key",
    "listen_certificate",
    "connect_private_key",
    "connect_certificate",
)
_TLS_SETTINGS = frozenset(
    {*_TLS_FILES, *(f"{name}_base64" for name in _TLS_FILES), "enable_mtls"}
    | {"verify_name_on_connect", "close_link_on_expiration", "so_sndbuf", "so_rcvbuf"}
)
_DEFAULT_ENDPOINTS: Mapping[Mode, tuple[str, ...]] = {
    Mode.ROUTER: ("tcp/[::]:7447",),
    Mode.PEER: ("tcp/[::]:0",),
    Mode.CLIENT: (),
}
"""Mode → endpoints at which a process listens if its configuration names none."""
ENCRYPTED = frozenset({"tls", "quic"})
"""The protocols that encrypt messages, and authenticate processes by certificates."""
_LINK_PROTOCOLS = frozenset(
    {"tcp", "udp", "tls", "quic", "serial", "unixpipe", "unixsock-stream", "vsock", "ws"}
)
_YAML_ENDINGS = (".yaml", ".yml")
_TOML_ENDINGS = (".toml",)
ENDINGS = (".json5", ".json", *_YAML_ENDINGS, *_TOML_ENDINGS)
"""Endings of file names that Zenoh reads (tested with 1.10.2)."""
_DIFFERENT_IN_YAML = re.compile(r"\\u|[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u2028\u2029\ufeff]")
"""Characters and escapes that YAML refuses, or reads differently from JSON."""
_MOST_MEANT = 1_000_000
_MOST_PARTS = 10
_ZID = re.compile(r"[1-9a-f][0-9a-f]{0,31}", re.ASCII)


@dataclass(frozen=True, slots=True)
class ZenohEndpoint:
    """An address to listen at or to connect to: ``PROTOCOL/ADDRESS?METADATA#OPTIONS``."""

    text: str

    @property
    def protocol(self) -> str:
        """The text before the first slash, such as "tls"."""
        return self.text.partition("/")[0]

    @property
    def address(self) -> str:
        """The address without metadata and options, such as "localhost:7447"."""
        return self.text.partition("/")[2].partition("#")[0].partition("?")[0]

    def is_encrypted(self) -> bool:
        """Return whether the protocol encrypts and authenticates by certificates."""
        return self.protocol in ENCRYPTED

    @property
    def options(self) -> Mapping[str, str]:
        """The options of the endpoint, which override the ``tls`` section of the configuration."""
        stated = self.text.partition("#")[2].split(";")
        pairs = (option.partition("=") for option in stated if option)
        return {name: value for name, _, value in pairs}

    def option(self, name: str, otherwise: bool) -> bool:
        """Return a boolean TLS option, or ``otherwise`` if the endpoint does not state it."""
        option_value = self.options.get(name)
        return otherwise if option_value is None else option_value == "true"


@dataclass(frozen=True, slots=True)
class TlsOptions:
    """The TLS options that decide which processes are accepted, with Zenoh's defaults.

    ``mutual`` says that a connecting process must show a certificate.  ``verifies_name`` says that
    the certificate of a listening process must have the host of the endpoint.
    ``closes_on_expiration`` says that a connection ends when the certificate of the other side
    expires.  ``named`` are the names of the settings for certificates and keys in the file, such as
    "root_ca_certificate".
    """

    mutual: bool = False
    verifies_name: bool = True
    closes_on_expiration: bool = False
    named: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class ConfigurationDocument:
    """The configuration of a Zenoh process: settings for security, with Zenoh's defaults.

    ``protocols`` are the protocols that endpoints may have; None allows all.  ``namespace`` is put
    before every key of the process.  ``lines`` maps paths of settings, such as "transport/link", to
    line numbers; ``unknown`` are paths that no version of Zenoh up to 1.10 knows.  ``settings`` are
    all settings of the file, as JSON, except access control.
    """

    name: str
    mode: Mode = Mode.PEER
    listen: tuple[ZenohEndpoint, ...] = ()
    connect: tuple[ZenohEndpoint, ...] = ()
    protocols: tuple[str, ...] | None = None
    tls: TlsOptions = TlsOptions()
    shared_memory: bool = True
    multicast: bool = True
    gossip: bool = True
    adminspace: bool = False
    adminspace_readable: bool = True
    adminspace_writable: bool = False
    namespace: str | None = None
    access: Enforcement = field(default_factory=Enforcement)
    unknown: tuple[str, ...] = ()
    settings: Mapping[str, str] = field(default_factory=dict, compare=False, repr=False)
    lines: Mapping[str, int] = field(default_factory=dict, compare=False, repr=False)

    def open_link_clause(self) -> str:
        """Return a clause on how a process without a certificate can connect, or ""."""
        for endpoint in (*self.listen, *self.connect):
            if self.protocols is not None and endpoint.protocol not in self.protocols:
                continue  # Zenoh refuses this endpoint
            if not endpoint.is_encrypted():
                return f"it has the endpoint {endpoint.text[:80]!r} without TLS"
        for endpoint in self.listen:
            if endpoint.is_encrypted() and not endpoint.option("enable_mtls", self.tls.mutual):
                return f"it asks for no certificate at {endpoint.text[:80]!r}"
        return ""

    def line_of(self, path: str) -> int:
        """Return the line of a setting, or of the smallest section that contains it, or 1."""
        while path and path not in self.lines:
            path = path.rpartition("/")[0]
        return self.lines.get(path, 1)


class UnreadConfigurationError(DocumentError):
    """Raised for a configuration that sros cannot read but Zenoh may; its rules are unknown."""


def parse_configuration(
    data: bytes, name: str, overrides: Iterable[tuple[str, str]] = (), *, lines: bool = True
) -> ConfigurationDocument:
    """Return the configuration in a file; ``name`` is the file's name in errors.

    ``overrides`` are pairs of a path of a setting and a JSON5 value that replaces the value in the
    file, as in ZENOH_CONFIG_OVERRIDE.  Without ``lines``, every line number is 1, and large files
    are read faster.

    Raises:
        UnreadConfigurationError: sros cannot read the file, but Zenoh may.  Such a file has more
            than 16 MiB, is TOML, is YAML that is not also JSON, or has lists in place of objects,
            whose meaning depends on the version.
        DocumentError: the file is not JSON5, or Zenoh would not accept it.
    """
    root = _root(data, name, lines=lines)
    for path, value in overrides:
        _override(root, path, value)
    return _configuration(root, name)


def _override(root: _Section, path: str, value: str) -> None:
    """Set the setting with the name ``path`` in ``root`` to ``value``, a JSON5 text.

    Raises:
        DocumentError: Zenoh refuses the path or the value.
    """
    *parents, last = (part for part in path.split("/") if part) if path.strip("/") else [""]
    inner = root.value
    try:
        if not last or len(parents) >= _MOST_PARTS:
            raise _no_setting_error(path)
        for part in parents:
            section = inner.setdefault(part, Json5Object(0))
            if not isinstance(section, Json5Object) or part == "endpoints":
                raise _no_setting_error(path)
            inner = section
        inner[last] = parse_json5(value)
        inner.lines[last] = 0
    except Json5Error as error:
        raise DocumentError(
            f"ZENOH_CONFIG_OVERRIDE sets {path[:80]!r} to a value that Zenoh refuses",
            f"In {value[:80]!r}: {error.problem}.",
        ) from error


def _no_setting_error(path: str) -> DocumentError:
    return DocumentError(
        f"ZENOH_CONFIG_OVERRIDE sets {path[:80]!r}, but Zenoh has no such setting",
        remedy="Correct the name, or take it out of ZENOH_CONFIG_OVERRIDE.",
    )


def _root(data: bytes, name: str, *, lines: bool) -> _Section:
    if len(data) > MOST_BYTES:
        raise UnreadConfigurationError(
            f"the Zenoh configuration '{name}' is too large for sros",
            f"It has more than {MOST_BYTES // 1024**2} MiB.",
        )
    try:
        text = data.decode()
        value = _parse_yaml(text, name) if _has_ending(name) else parse_json5(text, lines=lines)
    except UnicodeDecodeError as error:
        raise _json5_error_class(name)(
            f"the Zenoh configuration '{name}' is not UTF-8",
            f"The byte at position {error.start} is not valid in UTF-8.",
        ) from error
    except Json5Error as error:
        raise _json5_error_class(name)(
            f"the Zenoh configuration '{name}' is not JSON5",
            f"Line {error.line}: {error.problem}.",
        ) from error
    if isinstance(value, list):
        raise UnreadConfigurationError(
            f"the Zenoh configuration '{name}' is a list, which sros does not read",
            "Its meaning depends on the version of Zenoh.",
            "Write it as an object with settings.",
        )
    if not isinstance(value, Json5Object):
        raise DocumentError(
            f"'{name}' is not a Zenoh configuration", "It is not an object with settings."
        )
    return _Section(name, "", value)


def _has_ending(name: str, endings: tuple[str, ...] = (*_YAML_ENDINGS, *_TOML_ENDINGS)) -> bool:
    return name.endswith(endings)


def _parse_yaml(text: str, name: str) -> object:
    """Return the value of a YAML text that is also JSON with the same meaning.

    Raises:
        UnreadConfigurationError: the text is other YAML, or TOML.
    """
    value: object = None
    if not _has_ending(name, _TOML_ENDINGS) and not _DIFFERENT_IN_YAML.search(text):
        with suppress(Json5Error):
            value = parse_json(text)
    if value is None:
        language = "TOML" if _has_ending(name, _TOML_ENDINGS) else "YAML"
        raise UnreadConfigurationError(
            f"the Zenoh configuration '{name}' is in a language that sros does not read",
            f"Zenoh reads it as {language}, because of the ending of its name.",
            "Write it as JSON5 into a file whose name ends with .json5.",
        )
    return value


def _json5_error_class(name: str) -> type[DocumentError]:
    """Return the error class for text that is not JSON5.

    If Zenoh reads a file of this ``name`` as another language, the text may still have a meaning.
    """
    return UnreadConfigurationError if _has_ending(name) else DocumentError


def _object_error_class(value: object) -> type[DocumentError]:
    """Return the error class for a value that should be an object; Zenoh accepts some lists."""
    return UnreadConfigurationError if isinstance(value, list) else DocumentError


@dataclass(frozen=True, slots=True)
class _Section:
    """An object at a path of settings in the file ``name``; "" is the path of the whole file."""

    name: str
    path: str
    value: Json5Object

    def invalid_value_error(
        self, member: str, problem: str, error: type[DocumentError] = DocumentError
    ) -> DocumentError:
        line = self.value.lines.get(member, self.value.line)
        path = "/".join(part for part in (self.path, member) if part)
        reader = "that sros reads" if error is UnreadConfigurationError else "that Zenoh accepts"
        return error(
            f"the Zenoh configuration '{self.name}' is not one {reader}",
            f"Line {line}: {path} {problem}.",
        )

    def section(self, member: str) -> _Section:
        value = self.value.get(member, Json5Object(self.value.line))
        if not isinstance(value, Json5Object):
            raise self.invalid_value_error(member, "is not an object", _object_error_class(value))
        return _Section(self.name, f"{self.path}/{member}".lstrip("/"), value)

    def boolean(self, member: str, default: bool, *, nullable: bool = True) -> bool:
        value = self.value.get(member, default)
        if value is None and nullable:
            return default
        if not isinstance(value, bool):
            raise self.invalid_value_error(member, "is neither true nor false")
        return value

    def text(self, member: str) -> str | None:
        value = self.value.get(member)
        if value is not None and not isinstance(value, str):
            raise self.invalid_value_error(member, "is not a text")
        return value

    def choice(self, member: str, enum_class: type[_E]) -> _E | None:
        text = self.text(member)
        return None if text is None else self._chosen(member, text, enum_class)

    def _chosen(self, member: str, text: str, enum_class: type[_E]) -> _E:
        try:
            return enum_class(text)
        except ValueError:
            known = ", ".join(choice.value for choice in enum_class)
            raise self.invalid_value_error(
                member, f"is {text[:40]!r}, which is none of: {known}"
            ) from None

    def texts(self, member: str) -> tuple[str, ...] | None:
        value = self.value.get(member)
        if value is None:
            return None
        if not isinstance(value, list) or not all(isinstance(text, str) for text in value):
            raise self.invalid_value_error(member, "is not a list of texts")
        return tuple(value)

    def needed_texts(self, member: str) -> tuple[str, ...]:
        texts = self.texts(member)
        if not texts:
            raise self.invalid_value_error(member, "is missing or empty")
        return texts

    def choices(self, member: str, enum_class: type[_E]) -> tuple[_E, ...] | None:
        texts = self.texts(member)
        if texts is None:
            return None
        if not texts:
            raise self.invalid_value_error(member, "is empty")
        return tuple(dict.fromkeys(self._chosen(member, text, enum_class) for text in texts))

    def sections(self, member: str) -> tuple[_Section, ...] | None:
        value = self.value.get(member)
        if value is None:
            return None
        if not isinstance(value, list) or not all(
            isinstance(element, Json5Object) for element in value
        ):
            elements = value if isinstance(value, list) else ()
            inner = next((element for element in elements if isinstance(element, list)), None)
            raise self.invalid_value_error(
                member, "is not a list of objects", _object_error_class(inner)
            )
        return tuple(
            _Section(self.name, f"{self.path}/{member}[{number}]", element)
            for number, element in enumerate(value)
        )

    def check_members(self, known: Collection[str]) -> None:
        for member in self.unknown_members(known):
            raise self.invalid_value_error(member[:40], "is not a setting that sros knows")

    def unknown_members(self, known: Collection[str]) -> Iterator[str]:
        return (member for member in self.value if member not in known)


def _configuration(root: _Section, name: str) -> ConfigurationDocument:
    mode = root.choice("mode", Mode) or Mode.PEER
    link = root.section("transport").section("link")
    tls = link.section("tls")
    scouting = root.section("scouting")
    multicast, gossip = scouting.section("multicast"), scouting.section("gossip")
    admin = root.section("adminspace")
    permissions = admin.section("permissions")
    shared = root.section("transport").section("shared_memory")
    unknown = [
        *root.unknown_members(_SECTIONS),
        *(f"{tls.path}/{name}" for name in tls.unknown_members(_TLS_SETTINGS)),
    ]
    return ConfigurationDocument(
        name,
        mode,
        _read_endpoints(root.section("listen"), mode, _DEFAULT_ENDPOINTS[mode]),
        _read_endpoints(root.section("connect"), mode, ()),
        link.texts("protocols"),
        TlsOptions(
            tls.boolean("enable_mtls", False),
            tls.boolean("verify_name_on_connect", True),
            tls.boolean("close_link_on_expiration", False),
            tuple(name for name in _TLS_FILES if tls.text(name) or tls.text(f"{name}_base64")),
        ),
        shared.boolean("enabled", True, nullable=False),
        multicast.boolean("enabled", True),
        gossip.boolean("enabled", True),
        admin.boolean("enabled", False, nullable=False),
        permissions.boolean("read", True, nullable=False),
        permissions.boolean("write", False, nullable=False),
        root.text("namespace"),
        _read_enforcement(root.section("access_control")),
        tuple(unknown),
        dict(_settings(root.value, "")),
        dict(_lines(root.value, "")),
    )


def _read_endpoints(
    section: _Section, mode: Mode, default: tuple[str, ...]
) -> tuple[ZenohEndpoint, ...]:
    """Return the endpoints of a section, which may state endpoints for each mode separately."""
    if isinstance(section.value.get("endpoints"), Json5Object):
        section = section.section("endpoints")
        section.check_members([mode.value for mode in Mode])
        endpoints = section.texts(mode.value) or ()
    elif "endpoints" in section.value:
        stated = section.texts("endpoints")
        if stated is None:
            raise section.invalid_value_error("endpoints", "is null")
        endpoints = stated
    else:
        endpoints = default
    for endpoint in endpoints:
        if not all(endpoint.partition("/")):
            raise section.invalid_value_error(
                "", f"has {endpoint[:80]!r}, which is not PROTOCOL/ADDRESS"
            )
    return tuple(map(ZenohEndpoint, endpoints))


class _Permission(StrEnum):
    ALLOW = "allow"
    DENY = "deny"


def _read_enforcement(section: _Section) -> Enforcement:
    section.check_members(("enabled", "default_permission", "rules", "subjects", "policies"))
    enabled = section.boolean("enabled", False, nullable=False)
    default = section.choice("default_permission", _Permission)
    lists = {member: section.sections(member) for member in ("rules", "subjects", "policies")}
    if enabled and (missing := [member for member, value in lists.items() if value is None]):
        raise section.invalid_value_error("", f"is on without the list {missing[0]!r}")
    rules = tuple(map(_read_rule, lists["rules"] or ()))
    subjects = tuple(map(_read_subject, lists["subjects"] or ()))
    policies = tuple(map(_read_policy, lists["policies"] or ()))
    enforcement = Enforcement(enabled, default is _Permission.ALLOW, rules, subjects, policies)
    if enabled:
        _check_ids(section, enforcement)
    _check_size(section, enforcement)
    return enforcement


def _read_id(section: _Section) -> str:
    text = section.text("id")
    if not text or not text.strip():
        raise section.invalid_value_error("id", "is missing or empty")
    return text


def _read_rule(section: _Section) -> AclRule:
    section.check_members(("id", "permission", "flows", "messages", "key_exprs"))
    permission = section.choice("permission", _Permission)
    messages = section.choices("messages", Message)
    if permission is None or messages is None:
        raise section.invalid_value_error(
            "", f"has no {'messages' if permission else 'permission'!r}"
        )
    keys = section.needed_texts("key_exprs")
    for key in keys:
        if problem := expression_problem(key):
            raise section.invalid_value_error("key_exprs", f"has {key[:80]!r}: {problem}")
    return AclRule(
        _read_id(section),
        permission is _Permission.ALLOW,
        section.choices("flows", Flow) or tuple(Flow),
        messages,
        keys,
        section.value.line,
    )


def _read_subject(section: _Section) -> AclSubject:
    section.check_members(("id", *PROPERTIES))
    values = {name: section.texts(name) for name in PROPERTIES}
    for member, value in values.items():
        if value is not None and not all(text.strip() for text in value or ("",)):
            raise section.invalid_value_error(member, "is empty, or has an empty value")
    for protocol in values["link_protocols"] or ():
        if protocol not in _LINK_PROTOCOLS:
            raise section.invalid_value_error(
                "link_protocols", f"has the unknown protocol {protocol[:40]!r}"
            )
    for zid in values["zids"] or ():
        if not _ZID.fullmatch(zid):
            raise section.invalid_value_error(
                "zids", f"has {zid[:40]!r}, which is not a session id"
            )
    return AclSubject(_read_id(section), **values, line=section.value.line)


def _read_policy(section: _Section) -> AclPolicy:
    section.check_members(("id", "rules", "subjects"))
    section.text("id")
    return AclPolicy(section.needed_texts("rules"), section.needed_texts("subjects"))


def _check_ids(section: _Section, enforcement: Enforcement) -> None:
    """Raise for duplicate ids, and for policies that name a missing rule or subject."""
    for member, elements in (("rules", enforcement.rules), ("subjects", enforcement.subjects)):
        ids = [element.id for element in elements]
        if twice := next(_repeated(ids), None):
            raise section.invalid_value_error(member, f"has the id {twice[:80]!r} twice")
        for policy in enforcement.policies:
            named: tuple[str, ...] = getattr(policy, member)
            for missing in set(named) - set(ids):
                text = f"names {missing[:80]!r}, which is not in {member}"
                raise section.invalid_value_error("policies", text)


def _check_size(section: _Section, enforcement: Enforcement) -> None:
    """Raise if access control would need many millions of decisions.

    Even a small file can state that many rules.
    """
    values = {
        subject.id: prod(len(getattr(subject, name) or (None,)) for name in PROPERTIES)
        for subject in enforcement.subjects
    }
    places = {rule.id: len(rule.flows) * len(rule.messages) for rule in enforcement.rules}
    meant = sum(values.values()) + sum(
        sum(places.get(rule, 0) for rule in policy.rules)
        * sum(values.get(subject, 0) for subject in policy.subjects)
        for policy in enforcement.policies
    )
    if meant > _MOST_MEANT:
        raise UnreadConfigurationError(
            f"the access control of '{section.name}' is too large",
            f"Its subjects and policies combine to {meant:.0e} rules; sros reads at most "
            f"{_MOST_MEANT:.0e}.",
        )


def _repeated(ids: Iterable[str]) -> Iterator[str]:
    seen: set[str] = set()
    for name in ids:
        if name in seen:
            yield name
        seen.add(name)


def _settings(value: Json5Object, path: str) -> Iterator[tuple[str, str]]:
    for name, inner in value.items():
        if isinstance(inner, Json5Object) and inner:
            if path or name != "access_control":
                yield from _settings(inner, f"{path}{name}/")
        else:
            yield path + name, json.dumps(inner, sort_keys=True)


def _lines(value: Json5Object, path: str) -> Iterator[tuple[str, int]]:
    for name, line in value.lines.items():
        yield path + name, line
        inner = value[name]
        if isinstance(inner, Json5Object) and not path.startswith("access_control"):
            yield from _lines(inner, f"{path}{name}/")
