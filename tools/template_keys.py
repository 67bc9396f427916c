"""The keys of keystore templates, with what each means, for docs/reference/template.md."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from sros_tool.errors import SrosError
from sros_tool.keystore.template import EVERYTHING, NODE_BASICS, parse_template, settings_values
from sros_tool.policy.model import Level
from sros_tool.zenoh.configuration import Mode

_DATA_LEVELS = (Level.NONE, Level.SIGN, Level.ENCRYPT)
_FLAG = ("true", "false")
_VALIDITY = "validity"
DEFAULT = "[protection.default]"


OF_ROUTER = '[zenoh.routers."/r1/router"]'


class Key(NamedTuple):
    """A key of a table: an example of its value, its values or their kind, and its meaning."""

    table: str
    name: str
    example: str
    values: str | tuple[str, ...]
    meaning: str
    default: str = ""
    """What holds without the key, where the program has no value to show."""

    @property
    def path(self) -> str:
        """The key as `sros update_keystore --set` names it, such as ``protection.rtps``."""
        return f"{self.table.strip('[]')}.{self.name}".lstrip(".")


_PROTECTION: tuple[tuple[str, str, tuple[str, ...], str], ...] = (
    (
        "data",
        '"ENCRYPT"',
        _DATA_LEVELS,
        "the payload (`data_protection_kind`); not `SIGN` with Fast DDS, which loses such messages",
    ),
    (
        "metadata",
        '"ENCRYPT"',
        tuple(Level),
        "the submessages, in which the payload is (`metadata_protection_kind`)",
    ),
    (
        "read_access_control",
        "true",
        _FLAG,
        "subscribing needs permission (`enable_read_access_control`)",
    ),
    (
        "write_access_control",
        "true",
        _FLAG,
        "publishing needs permission (`enable_write_access_control`)",
    ),
    (
        "discovery",
        "true",
        _FLAG,
        "the topic's discovery is protected, at the level of `[protection]` "
        "(`enable_discovery_protection`)",
    ),
    (
        "liveliness",
        "true",
        _FLAG,
        "the topic's signs of life are protected, at the level of `[protection]` "
        "(`enable_liveliness_protection`)",
    ),
)

KEYS: tuple[Key, ...] = (
    Key("", "name", '"ours"', "text", "what `sros inspect` shows", "the file's name"),
    Key("", "description", '"our robots"', "text", "what `sros create_keystore` prints", "none"),
    Key(
        "",
        "distributions",
        '["jazzy", "lyrical"]',
        "names of ROS 2 distributions",
        "the distributions that the keystore is for; `sros check` decides like the DDS of "
        "each distribution",
        "any of them",
    ),
    Key(
        "[authorities]",
        "layout",
        '"separate"',
        ("separate", "single"),
        "two CAs, one for identities and one for permissions; or one CA for both, as in "
        "ros2/sros2: with Cyclone DDS 0.10.2 and Fast DDS 2.9.1, any enclave can then sign its own "
        "permissions",
    ),
    Key("[authorities]", "name", '"ours"', "1 to 40 characters", "the beginning of the CAs' names"),
    Key("[authorities]", _VALIDITY, '"5y"', _VALIDITY, "validity of the CAs"),
    Key(
        "[authorities]",
        "identity_key",
        '"file:/media/stick/identity.pem"',
        "a URI, `file:` or `pkcs11:`, or `issuer:NAME`",
        "where the key of the identity CA is; `issuer:NAME` for a "
        "[CA service](../howto/ca_service.md)",
        "`private/` of the keystore",
    ),
    Key(
        "[authorities]",
        "permissions_key",
        '"file:/media/stick/permissions.pem"',
        "a URI, `file:` or `pkcs11:`",
        "where the key of the permissions CA is",
        "`private/` of the keystore",
    ),
    Key("[certificates]", _VALIDITY, '"365d"', _VALIDITY, "validity of enclaves' certificates"),
    Key(
        "[certificates]",
        "unique_subject",
        "true",
        _FLAG,
        "the subject of each certificate has a unique part, so that permissions of an earlier "
        "certificate do not fit this certificate",
    ),
    Key("[permissions]", _VALIDITY, '"180d"', _VALIDITY, "validity of signed permissions"),
    Key(
        "[permissions]",
        "default",
        f'"{NODE_BASICS}"',
        (EVERYTHING, NODE_BASICS),
        "what an enclave may do as long as it has no policy: everything, or only what every ROS 2 "
        "node needs to start",
    ),
    Key("[revocation]", _VALIDITY, '"10y"', "a duration", "validity of the revocation list"),
    Key("[[enclaves]]", "names", '["/operator/*"]', "names of enclaves", "the enclaves"),
    Key(
        "[[enclaves]]",
        _VALIDITY,
        '"1d"',
        "a duration",
        "validity of their certificates and permissions, if shorter than the other validities",
    ),
    Key(
        "[protection]",
        "rtps",
        '"SIGN"',
        tuple(Level),
        "whole messages (`rtps_protection_kind`)",
    ),
    Key(
        "[protection]",
        "discovery",
        '"ENCRYPT"',
        tuple(Level),
        "discovery of topics with `discovery = true` (`discovery_protection_kind`)",
    ),
    Key(
        "[protection]",
        "liveliness",
        '"ENCRYPT"',
        tuple(Level),
        "signs of life of topics with `liveliness = true` (`liveliness_protection_kind`)",
    ),
    Key(
        "[protection]",
        "allow_unauthenticated_participants",
        "false",
        _FLAG,
        "processes without security may join; needs `rtps = NONE`",
    ),
    Key(
        "[protection]",
        "join_access_control",
        "true",
        _FLAG,
        "joining the domain needs permission (`enable_join_access_control`)",
    ),
    *(Key(DEFAULT, *each) for each in _PROTECTION),
    Key("[[protection.topic]]", "names", '["/camera/*"]', "names", "to which topics this applies"),
    *(Key("[[protection.topic]]", *each, f"as in `{DEFAULT}`") for each in _PROTECTION),
    Key("[zenoh]", "router", '"/router"', "the name of an enclave", "the enclave of the router"),
    Key(
        "[zenoh]",
        "endpoints",
        '["robot:7447"]',
        "a list of `HOST:PORT`",
        "where sessions connect to the router",
    ),
    Key(
        "[zenoh]",
        "listen",
        '["[::]:7447"]',
        "a list of `HOST:PORT`",
        "where the router listens",
        "at `endpoints`",
    ),
    Key(
        "[zenoh]",
        "mode",
        '"client"',
        (Mode.CLIENT, Mode.PEER),
        "sessions connect only to the router, or (`peer`) also to each other",
    ),
    Key(
        "[zenoh]",
        "domains",
        "[0]",
        "a list of ROS domain ids",
        "the domains of the sessions",
        "the domains of the keystore",
    ),
    Key(
        "[zenoh]",
        "crossing",
        '["/fleet/*"]',
        "a list of names",
        "the topics and services that may pass from one router to another",
        "all names for which enclaves at both ends have rights",
    ),
    Key(
        OF_ROUTER,
        "endpoints",
        '["r1.local:7447"]',
        "a list of `HOST:PORT`",
        "where sessions and other routers connect to this router",
    ),
    Key(
        OF_ROUTER,
        "listen",
        '["[::]:7447"]',
        "a list of `HOST:PORT`",
        "where this router listens",
        "at these ports of all addresses",
    ),
    Key(
        OF_ROUTER,
        "enclaves",
        '["/r1/*"]',
        "a list of names of enclaves",
        "the enclaves whose sessions connect to this router",
    ),
    Key(
        OF_ROUTER,
        "crossing",
        '["/fleet/*"]',
        "a list of names of topics and services",
        "the names that may pass between this router and other routers",
        "all names that `crossing` of `[zenoh]` lets pass",
    ),
)

ABOUT = {
    "[[enclaves]]": "Enclaves that expire earlier than the others; the table can be repeated.",
    DEFAULT: "Topics, services and actions without a separate table.",
    "[[protection.topic]]": "Topics with a separate protection; the table can be repeated. "
    "`[[protection.service]]` and `[[protection.action]]` have the same keys.",
    "[zenoh]": "Only in a keystore with a [network of Zenoh](../zenoh.md); `sros zenoh` adds it.",
    OF_ROUTER: "An additional router, such as a robot's, named by its enclave; the table can be "
    "repeated. If two routers name the same enclave, the first router serves it.",
}
"""What is said of a table before its keys."""


def template_text(keys: Sequence[Key] = KEYS) -> str:
    """Return a template that has ``keys``, each with the value of its example."""
    lines = [f"{key.name} = {key.example}" for key in keys if not key.table]
    for table in dict.fromkeys(key.table for key in keys if key.table):
        lines += [f"\n{table}", *(f"{k.name} = {k.example}" for k in keys if k.table == table)]
    return "\n".join(lines) + "\n"


def without(key: Key) -> str:
    """Return what holds in a template that lacks ``key``: its default, or "refused"."""
    others = [each for each in KEYS if each != key]
    try:
        template = parse_template(template_text(others), "")
    except (SrosError, ValueError):
        return "refused"
    return key.default or f"`{settings_values(template)[key.path]}`"
