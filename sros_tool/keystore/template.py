"""Keystore templates: named settings for new keystores, as TOML files.

A keystore keeps a copy of its settings (``sros.toml``), which apply to enclaves added later.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from datetime import timedelta
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from sros_tool.dds.domains import MAX_DOMAIN
from sros_tool.errors import DocumentError, SrosError, UsageError
from sros_tool.files import parse_toml, templates_dir, toml_error
from sros_tool.keystore.layout import IDENTITY
from sros_tool.names import (
    DISTRIBUTIONS,
    check_enclave_name,
    distribution_problem,
    expand,
    expression_problem,
)
from sros_tool.pki.token import refuse_pin
from sros_tool.policy.model import DomainProtection, Level, NamedProtection, TopicProtection
from sros_tool.policy.patterns import covers, matches
from sros_tool.validity import Span, duration_text, parse_duration, parse_span, span_text
from sros_tool.xml import read_bytes

if TYPE_CHECKING:
    from sros_tool.zenoh.configuration import ZenohNetwork, ZenohRouter

DEFAULT_TEMPLATE = "development"
EVERYTHING, NODE_BASICS = "everything", "node_basics"
CA_SERVICE_SCHEME = "issuer:"
"""The prefix of a key's place that stands for a CA service, such as issuer:NAME."""
_LONGEST_AUTHORITY_NAME = 40  # in characters; a common name also has the role and a number
_DATA_LEVELS = (Level.NONE, Level.SIGN, Level.ENCRYPT)
_PLURAL_KINDS: dict[str, str] = {"topic": "topics", "service": "services", "action": "actions"}
_TYPE_TEXTS: dict[type, str] = {str: "a string", bool: "a boolean", list: "a list"}


class ShortLivedEnclaves(NamedTuple):
    """The validity of the enclaves whose names match ``name``, which may have wildcards."""

    name: str
    validity: timedelta


@dataclass(frozen=True, slots=True)
class Template:
    """The settings of a keystore.

    ``authority_name`` is the beginning of the CAs' common names.  Durations count from the creation
    of a certificate or document.  ``default_permissions`` is `EVERYTHING` or `NODE_BASICS`.
    ``identity_key`` and ``permissions_key`` are the URIs of CA keys outside of the keystore.  With
    ``unique_subject``, the subject of every certificate has a unique part.  ``short_lived`` are
    enclaves whose certificates and permissions expire earlier than the others.  ``zenoh`` is the
    network for which enclaves get Zenoh configurations, or None.  ``distributions`` are the ROS 2
    distributions for which the keystore must work; () if the template states none.
    """

    name: str
    description: str
    separate_authorities: bool
    authority_name: str
    authority_validity: Span
    certificate_validity: Span
    permissions_validity: Span
    default_permissions: str
    protection: DomainProtection
    identity_key: str = ""
    permissions_key: str = ""
    unique_subject: bool = False
    revocation_validity: timedelta = timedelta(days=3650)
    short_lived: tuple[ShortLivedEnclaves, ...] = ()
    zenoh: ZenohNetwork | None = None
    distributions: tuple[str, ...] = ()

    def key_place(self, role: str) -> str:
        """Return the URI of the identity or permissions CA's key; "" for a key in the keystore."""
        return self.identity_key if role == IDENTITY else self.permissions_key

    def longest_validity(self, enclave: str) -> timedelta | None:
        """Return the longest validity of a short-lived enclave; None for other enclaves."""
        validities = (
            short_lived.validity
            for short_lived in self.short_lived
            if matches(short_lived.name, enclave)
        )
        return min(validities, default=None)


def template_names() -> tuple[str, ...]:
    """Return the names of the templates that ship with sros."""
    return tuple(sorted(path.stem for path in templates_dir().glob("*.toml")))


def is_ca_service(place: str) -> bool:
    """Return whether the place of a CA's key stands for a CA service."""
    return place.startswith(CA_SERVICE_SCHEME)


def load_template(choice: str) -> Template:
    """Return the shipped template named ``choice``, or the template in the TOML file ``choice``.

    Raises:
        DocumentError: the template does not exist, or is malformed.
    """
    if choice in template_names():
        return read_template(templates_dir() / f"{choice}.toml")
    path = Path(choice)
    if "/" not in choice and not path.suffix and not path.exists():
        raise DocumentError(
            f"there is no template {choice!r}",
            f"sros has {', '.join(template_names())}.",
            "Name one of them, or a TOML file.",
        )
    return read_template(path)


def read_template(path: Path) -> Template:
    """Return the template in the file at ``path``.

    Raises:
        DocumentError: the file cannot be read, or is malformed.
    """
    return decode_template(read_bytes(path, "template"), path, "template", "")


def decode_template(data: bytes, path: Path, kind: str, remedy: str) -> Template:
    """Return the template in ``data``; the other arguments are for errors."""
    try:
        return parse_template(data.decode(), path.stem)
    except _TemplateError as error:
        raise DocumentError(f"the {kind} '{path}' is not valid", f"{error}.", remedy) from error
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise toml_error(error, f"the {kind} '{path}'", remedy) from error


class _TemplateError(ValueError):
    """A key of a template is missing, unknown, or has an invalid value."""


@lru_cache(maxsize=16)
def parse_template(text: str, name: str) -> Template:
    """Return the template in TOML text; ``name`` is its name if the text states none.

    Results are cached, because most verbs read the settings several times.

    Raises:
        tomllib.TOMLDecodeError: the text is not TOML.
        _TemplateError: a key is missing, unknown (it may be a typo), or has a wrong value.
    """
    return _template_from(parse_toml(text), name)


def _template_from(values: object, name: str) -> Template:
    table = _Table(values, "")
    authorities = table.table("authorities")
    certificates = table.table("certificates")
    permissions = table.table("permissions")
    revocation = table.table("revocation")
    template = Template(
        name=table.text("name", name),
        description=table.text("description", ""),
        separate_authorities=authorities.one_of("layout", ("separate", "single")) == "separate",
        authority_name=_read_authority_name(authorities),
        authority_validity=authorities.span("validity"),
        certificate_validity=certificates.span("validity"),
        permissions_validity=permissions.span("validity"),
        default_permissions=permissions.one_of("default", (EVERYTHING, NODE_BASICS)),
        protection=_read_protection(table.table("protection")),
        identity_key=_read_key_place(authorities, "identity_key"),
        permissions_key=_read_key_place(authorities, "permissions_key"),
        unique_subject=certificates.flag("unique_subject", False),
        revocation_validity=revocation.duration("validity", "10y"),
        short_lived=tuple(_read_short_lived(table)),
        zenoh=_read_zenoh(table.table("zenoh")) if table.has("zenoh") else None,
        distributions=_read_distributions(table),
    )
    for part in (authorities, certificates, permissions, revocation, table):
        part.finish()
    return template


def render_template(template: Template) -> str:
    """Return the template as TOML, from which `parse_template` returns an equal template."""
    protection = template.protection
    lines = [
        f"name = {_toml_value(template.name)}",
        f"description = {_toml_value(template.description)}",
        *(
            [f"distributions = [{', '.join(map(_toml_value, template.distributions))}]"]
            if template.distributions
            else []
        ),
        "\n[authorities]",
        f'layout = "{"separate" if template.separate_authorities else "single"}"',
        f"name = {_toml_value(template.authority_name)}",
        f"validity = {_toml_value(span_text(template.authority_validity))}",
        *(
            f"{name} = {_toml_value(place)}"
            for name in ("identity_key", "permissions_key")
            if (place := getattr(template, name))
        ),
        "\n[certificates]",
        f"validity = {_toml_value(span_text(template.certificate_validity))}",
        f"unique_subject = {_toml_value(template.unique_subject)}",
        "\n[permissions]",
        f"validity = {_toml_value(span_text(template.permissions_validity))}",
        f"default = {_toml_value(template.default_permissions)}",
        "\n[revocation]",
        f"validity = {_toml_value(duration_text(template.revocation_validity))}",
        "\n[protection]",
        *(f"{name} = {_toml_value(getattr(protection, name))}" for name in _DOMAIN_KEYS),
        "\n[protection.default]",
        *_topic_lines(protection.default),
    ]
    for short_lived in template.short_lived:
        lines += ["\n[[enclaves]]", f"names = [{_toml_value(short_lived.name)}]"]
        lines.append(f"validity = {_toml_value(duration_text(short_lived.validity))}")
    items = {kind: item for item, kind in _PLURAL_KINDS.items()}
    for named in protection.named:
        lines += [f"\n[[protection.{items[named.kind]}]]", f"names = [{_toml_value(named.name)}]"]
        lines += _topic_lines(named.protection)
    if template.zenoh:
        lines += ["\n[zenoh]", *_zenoh_lines(template.zenoh)]
    return "\n".join(lines) + "\n"


def _read_distributions(table: _Table) -> tuple[str, ...]:
    """Return the distributions that a template names, in the order of their release."""
    named = table.texts("distributions", [])
    for name in named:
        if problem := distribution_problem(name):
            raise _TemplateError(f"distributions has {name!r}: {problem}".removesuffix("."))
    return tuple(name for name in DISTRIBUTIONS if name in named)


def _read_short_lived(table: _Table) -> Iterator[ShortLivedEnclaves]:
    for entry in table.tables("enclaves"):
        validity = entry.duration("validity")
        for name in entry.texts("names"):
            problem = expression_problem(name)
            if problem or not name.startswith("/"):
                why = (problem or "It does not start with '/'.").removesuffix(".")
                raise _TemplateError(
                    f"{entry.path}.names has {name!r}, which is not the name of an enclave: {why}"
                )
            yield ShortLivedEnclaves(name, validity)
        entry.finish()


def _read_zenoh(table: _Table) -> ZenohNetwork:
    from sros_tool.zenoh.configuration import (  # most keystores have no Zenoh network
        Mode,
        ZenohNetwork,
        is_endpoint,
    )

    usual = ZenohNetwork()
    network = ZenohNetwork(
        table.text("router", usual.router),
        tuple(table.texts("endpoints", list(usual.endpoints))),
        tuple(table.texts("listen", [])),
        Mode(table.one_of("mode", (Mode.CLIENT.value, Mode.PEER.value), usual.mode.value)),
        tuple(sorted(set(table.numbers("domains", MAX_DOMAIN)))),
        tuple(_read_zenoh_routers(table.table("routers"))),
        tuple(_read_crossing(table)),
    )
    names = network.router_names()
    for name in names:
        try:
            check_enclave_name(name)
        except SrosError as error:
            raise _TemplateError(f"{table.path}.router: {error}".removesuffix(".")) from error
        if names.count(name) > 1:
            raise _TemplateError(
                f"{table.path}.routers has {name}, which is also {table.path}.router"
            )
    for router in (network, *network.routers):
        for key in ("endpoints", "listen"):
            for endpoint in getattr(router, key):
                if not is_endpoint(endpoint):
                    raise _TemplateError(
                        f"{table.path}.{key} has {endpoint!r}, which is not HOST:PORT, such as "
                        "localhost:7447 or [::1]:7447; names of hosts have only letters, digits, "
                        "- and ."
                    )
    table.finish()
    return network


def _read_zenoh_routers(tables: _Table) -> Iterator[ZenohRouter]:
    """Yield the further routers of a Zenoh network, each with its enclaves."""
    from sros_tool.zenoh.configuration import ZenohRouter

    for name in tables.names():
        table = tables.table(name)
        router = ZenohRouter(
            name,
            tuple(table.texts("endpoints")),
            tuple(table.texts("listen", [])),
            tuple(table.texts("enclaves")),
            tuple(_read_crossing(table)),
        )
        for pattern in router.enclaves:
            if not pattern.startswith("/") or set(pattern) & set("?[]"):
                raise _TemplateError(
                    f"{table.path}.enclaves has {pattern!r}, which is neither an enclave nor a "
                    "pattern such as /r1/*"
                )
        table.finish()
        yield router


def _read_crossing(table: _Table) -> Iterator[str]:
    for name in table.texts("crossing", []):
        if not name.startswith("/") or expression_problem(name):
            raise _TemplateError(
                f"{table.path}.crossing has {name!r}, which is not a name such as /fleet/*"
            )
        yield name


def _zenoh_lines(network: ZenohNetwork) -> Iterator[str]:
    yield f"router = {_toml_value(network.router)}"
    for key in ("endpoints", "listen"):
        if texts := getattr(network, key):
            yield f"{key} = [{', '.join(map(_toml_value, texts))}]"
    yield f"mode = {_toml_value(network.mode)}"
    if network.domains:
        yield f"domains = {list(network.domains)}"
    if network.crossing:
        yield f"crossing = [{', '.join(map(_toml_value, network.crossing))}]"
    for router in network.routers:
        yield f"\n[zenoh.routers.{_toml_value(router.name)}]"
        for key in ("endpoints", "listen", "enclaves", "crossing"):
            if texts := getattr(router, key):
                yield f"{key} = [{', '.join(map(_toml_value, texts))}]"


def settings_values(template: Template) -> dict[str, str]:
    """Map the keys of a template, such as ``protection.rtps``, to their values as text.

    The protection of names has keys such as ``protection.topic /camera/*.data``.
    """
    values: dict[str, str] = {}

    def add(key: str, value: object) -> None:
        if isinstance(value, dict):
            for name, inner in value.items():
                add(f"{key}.{name}" if key else name, inner)
        elif isinstance(value, list):
            if not all(isinstance(entry, dict) for entry in value):
                values[key] = ",".join(map(str, value))
                return
            for entry in value:
                for name in entry["names"]:
                    add(f"{key} {name}", {k: v for k, v in entry.items() if k != "names"})
        else:
            values[key] = json.dumps(value) if isinstance(value, bool) else str(value)

    add("", parse_toml(render_template(template)))
    return values


def with_values(
    template: Template,
    values: Sequence[tuple[str, str]] = (),
    rules: Sequence[NamedValues] = (),
    dropped: Sequence[tuple[str, str]] = (),
) -> Template:
    """Return ``template`` with changed values.

    Args:
        template: the template.
        values: keys, such as ``protection.rtps``, with their new values as text.
        rules: protection of names, which replaces the present protection of these names.
        dropped: kinds and names (``topic``, ``/camera/*``) whose own protection is removed.  As in
            a template, names without a leading / begin at the root.

    Raises:
        UsageError: templates do not have the key or value, or a dropped name has no own protection.
    """
    table = parse_toml(render_template(template))
    protection = table["protection"]
    for kind, name in [*dropped, *((rule.kind, rule.name) for rule in rules)]:
        entries = protection.get(kind, [])
        left = [entry for entry in entries if not _match_same_names(entry["names"][0], name)]
        if (kind, name) in dropped and len(left) == len(entries):
            raise UsageError(
                f"no rule of the settings is for the {kind} {name}",
                "--drop-rule removes a `[[protection...]]` table of the settings.",
                "See the tables in sros.toml of the keystore.",
            )
        protection[kind] = left
    for rule in rules:
        typed = {key: _typed_value("", value) for key, value in rule.values}
        name = rule.name if rule.name.startswith("~") else expand(rule.name, "/", "")
        protection.setdefault(rule.kind, []).append({"names": [name], **typed})
    for key, value in values:
        *path, last = key.split(".")
        inner: Any = table
        for part in path:
            inner = inner.get(part) if isinstance(inner, dict) else None
        if path == ["zenoh"] and inner is None:
            raise UsageError(
                "the keystore has no Zenoh files yet, and therefore no settings for Zenoh",
                "",
                "Write them first, for example with `sros zenoh KEYSTORE --mode peer`.",
            )
        if key == "distributions":
            inner[last] = value.split(",") if value else []
            continue
        if not path or not isinstance(inner, dict) or isinstance(inner.get(last), dict):
            raise UsageError(
                f"{key!r} is not a setting of a keystore",
                "",
                "Name a setting, such as protection.rtps, permissions.validity or "
                "permissions.default.",
            )
        inner[last] = _typed_value(key, value)
    try:
        return _template_from(table, template.name)
    except _TemplateError as error:
        raise UsageError(f"the settings would not be valid: {error}") from error


def _match_same_names(first: str, second: str) -> bool:
    """Return whether two name expressions in settings match the same names."""
    first, second = (expand(expression, "/", "") for expression in (first, second))
    return covers(first, second) and covers(second, first)


class NamedValues(NamedTuple):
    """The protection of a name: kind (topic, service or action), name, and keys with values."""

    kind: str
    name: str
    values: tuple[tuple[str, str], ...]


def _typed_value(key: str, text: str) -> str | bool | list[str] | list[int]:
    if key in ("zenoh.endpoints", "zenoh.listen", "zenoh.crossing") or key.startswith(
        "zenoh.routers."
    ):
        return text.split(",")
    if key == "zenoh.domains":
        return [int(word) if word.isdecimal() else -1 for word in text.split(",")]
    return {"true": True, "false": False}.get(text, text)


def _read_authority_name(table: _Table) -> str:
    name = table.text("name", "sros")
    if not 0 < len(name) <= _LONGEST_AUTHORITY_NAME or not name.isprintable():
        raise _TemplateError(
            f"{table.path}.name is {name!r}, which does not have 1 to "
            f"{_LONGEST_AUTHORITY_NAME} printable characters"
        )
    return name


def _read_key_place(table: _Table, key: str) -> str:
    place = table.text(key, "")
    try:
        refuse_pin(place)
    except SrosError as error:
        raise _TemplateError(f"{table.path}.{key}: {error}".removesuffix(".")) from error
    return place


def _topic_lines(protection: TopicProtection) -> list[str]:
    return [
        f"{field.name} = {_toml_value(getattr(protection, field.name))}"
        for field in fields(TopicProtection)
    ]


def _toml_value(value: str | bool) -> str:
    if isinstance(value, bool):
        return json.dumps(value)
    # A JSON string is a TOML basic string, except that TOML also requires an escape for one
    # character.
    return json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007f")


_DOMAIN_KEYS: dict[str, Any] = {
    field.name: field.default
    for field in fields(DomainProtection)
    if field.name not in ("default", "named")
}
"""Maps the keys of [protection] for the whole domain to their defaults."""


def _read_protection(table: _Table) -> DomainProtection:
    values: dict[str, Any] = {}
    for name, usual in _DOMAIN_KEYS.items():
        is_flag = isinstance(usual, bool)
        values[name] = table.flag(name, usual) if is_flag else table.level(name)
    domain = DomainProtection(**values)
    if domain.allow_unauthenticated_participants and domain.rtps is not Level.NONE:
        raise _TemplateError(
            'protection.allow_unauthenticated_participants needs rtps = "NONE", because Fast DDS '
            "refuses to start otherwise"
        )
    default = _read_topic_protection(table.table("default"), TopicProtection())
    named = []
    for item, kind in _PLURAL_KINDS.items():
        for entry in table.tables(item):
            names = entry.texts("names")
            for name in names:
                problem = expression_problem(name)
                if problem or name.startswith("~"):
                    raise _TemplateError(
                        f"{entry.path}.names has {name!r}, which is not a valid {item} name: "
                        f"{problem or 'it is private to a node.'}".rstrip(".")
                    )
            protection = _read_topic_protection(entry, default)
            named += [NamedProtection(kind, name, protection) for name in names]
    table.finish()
    return replace(domain, default=default, named=tuple(named))


def _read_topic_protection(table: _Table, default: TopicProtection) -> TopicProtection:
    values: dict[str, Any] = {}
    for field in fields(TopicProtection):
        if field.name in ("data", "metadata"):
            allowed = _DATA_LEVELS if field.name == "data" else tuple(Level)
            values[field.name] = table.level(field.name, getattr(default, field.name), allowed)
        else:
            values[field.name] = table.flag(field.name, getattr(default, field.name))
    table.finish()
    return TopicProtection(**values)


class _Table:
    """A reader of a TOML table: each method removes a key, and `finish` refuses remaining keys."""

    def __init__(self, values: object, path: str) -> None:
        if not isinstance(values, dict):
            raise _TemplateError(f"{path} is not a table")
        self._values = dict(values)
        self.path = path

    def _take(self, key: str, kind: type, default: object = None) -> Any:
        value = self._values.pop(key, default)
        if value is None:
            raise _TemplateError(f"{self._at(key)} is missing")
        if not isinstance(value, kind):
            raise _TemplateError(f"{self._at(key)} is {value!r}, not {_TYPE_TEXTS[kind]}")
        return value

    def _at(self, key: str) -> str:
        return f"{self.path}.{key}" if self.path else key

    def has(self, key: str) -> bool:
        return key in self._values

    def names(self) -> list[str]:
        return list(self._values)

    def table(self, key: str) -> _Table:
        return _Table(self._values.pop(key, {}), self._at(key))

    def tables(self, key: str) -> list[_Table]:
        values = self._values.pop(key, [])
        if not isinstance(values, list):
            raise _TemplateError(
                f"{self._at(key)} is not a list of tables; write [[{self._at(key)}]]"
            )
        return [_Table(value, self._at(key)) for value in values]

    def text(self, key: str, default: str | None = None) -> str:
        return str(self._take(key, str, default))

    def texts(self, key: str, default: list[str] | None = None) -> list[str]:
        """Return a list of texts, which must not be empty; ``default`` if there is no such key."""
        values = self._take(key, list, default)
        if not (values or default == []) or not all(isinstance(value, str) for value in values):
            raise _TemplateError(f"{self._at(key)} is not a list of names")
        return list(values)

    def numbers(self, key: str, maximum: int) -> list[int]:
        """Return a list of numbers from 0 to ``maximum``; empty if there is no such key."""
        values = self._take(key, list, [])
        if not all(type(value) is int and 0 <= value <= maximum for value in values):
            raise _TemplateError(f"{self._at(key)} is not a list of numbers from 0 to {maximum}")
        return list(values)

    def flag(self, key: str, default: bool) -> bool:
        return bool(self._take(key, bool, default))

    def one_of(self, key: str, choices: tuple[str, ...], default: str | None = None) -> str:
        value = self.text(key, default)
        if value not in choices:
            raise _TemplateError(f"{self._at(key)} is {value!r}, not one of {', '.join(choices)}")
        return value

    def level(
        self, key: str, default: Level | None = None, allowed: tuple[Level, ...] = tuple(Level)
    ) -> Level:
        return Level(self.one_of(key, allowed, default))

    def span(self, key: str) -> Span:
        value = self.text(key)
        try:
            return parse_span(value)
        except SrosError as error:
            raise _TemplateError(f"{self._at(key)}: {error.what}") from error

    def duration(self, key: str, default: str | None = None) -> timedelta:
        value = self.text(key, default)
        try:
            return parse_duration(value)
        except SrosError as error:
            raise _TemplateError(f"{self._at(key)}: {error.what}") from error

    def finish(self) -> None:
        if self._values:
            raise _TemplateError(f"{self._at(next(iter(self._values)))} is not a known key")
