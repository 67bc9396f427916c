"""Compare two sets of Zenoh configurations: find settings of the new set that permit more.

Access-control rules are compared elsewhere.  A setting with an unknown effect is never ignored, but
reported as not compared, so that the result cannot be "nothing new".  Source of the settings:
DEFAULT_CONFIG.json5 of zenoh 1.9.

This module reads no files.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache

from sros_tool.keystore.comparison import Effect, SettingChange
from sros_tool.zenoh.configuration import Mode, render_configuration
from sros_tool.zenoh.document import ConfigurationDocument, parse_configuration


@dataclass(frozen=True, slots=True)
class SignedConfiguration:
    """A Zenoh configuration with the state of its signature.

    ``signature`` is "holds", "missing", "broken", or "not verified" without a permissions CA.
    """

    document: ConfigurationDocument
    signature: str


SIGNED = "holds"

_Files = Mapping[str, SignedConfiguration]
"""Configurations by enclave and file name, such as "/web session.json5"; a single file by `LONE`.
"""
LONE = "the file"

_TWO_VALUED_SETTINGS: tuple[tuple[str, Callable[[ConfigurationDocument], bool], bool, str], ...] = (
    (
        "transport/link/tls/enable_mtls",
        lambda document: document.tls.mutual,
        False,
        "whoever connects needs no certificate",
    ),
    (
        "transport/link/tls/verify_name_on_connect",
        lambda document: document.tls.verifies_name,
        False,
        "another host with a certificate of the CA can pose as the host at the other end",
    ),
    (
        "transport/link/tls/close_link_on_expiration",
        lambda document: document.tls.closes_on_expiration,
        False,
        "a connection stays when the certificate of the other side expires",
    ),
    (
        "transport/shared_memory/enabled",
        lambda document: document.shared_memory,
        True,
        "processes of the host exchange data unencrypted",
    ),
    (
        "scouting/multicast/enabled",
        lambda document: document.multicast,
        True,
        "it looks for others, and answers them, unencrypted",
    ),
    (
        "scouting/gossip/enabled",
        lambda document: document.gossip,
        True,
        "it tells processes about each other",
    ),
    (
        "adminspace/permissions/read",
        lambda document: document.adminspace and document.adminspace_readable,
        True,
        "others may read its state and its settings",
    ),
    (
        "adminspace/permissions/write",
        lambda document: document.adminspace and document.adminspace_writable,
        True,
        "others may change its settings while it runs",
    ),
    (
        "access_control/enabled",
        lambda document: document.access.enabled,
        False,
        "it lets everything pass",
    ),
    (
        "access_control/default_permission",
        lambda document: document.access.allows_by_default,
        True,
        "it allows what no rule denies",
    ),
)
"""Settings with two values: path, function that reads the value, value that permits more, clause.
"""

_COMPARED_PATHS = re.compile(
    r"mode|namespace|(?:listen|connect)/endpoints(?:/\w+)?|transport/link/protocols"
    r"|adminspace/enabled|adminspace/permissions/(?:read|write)"
    r"|transport/link/tls/(?:enable_mtls|verify_name_on_connect|close_link_on_expiration)"
    r"|transport/shared_memory/enabled|scouting/(?:multicast|gossip)/enabled"
)
"""Paths of the compared settings: `_TWO_VALUED_SETTINGS`, endpoints and access control."""
_HARMLESS_PATHS = re.compile(
    r"metadata(?:/.*)?|timestamping/.*|queries_default_timeout|open/.*|stats/.*"
    r"|transport/unicast/.*|transport/link/[tr]x/.*|transport/link/tls/so_(?:snd|rcv)buf"
    r"|(?:listen|connect)/(?:timeout_ms|exit_on_failure|retry)(?:/.*)?|scouting/(?:timeout|delay)"
    r"|scouting/gossip/autoconnect_strategy/.*|routing/router/peers_failover_brokering"
)
"""Paths of settings that give nobody access: times, sizes, names, order of connecting."""
_PATHS_GIVING_ACCESS = (
    (re.compile(r"plugins(?:/.*)?"), "a plugin answers other processes by its own rules"),
    (re.compile(r"plugins_loading(?:/.*)?"), "it loads plugins, which answer other processes"),
    (
        re.compile(r"transport/auth(?:/.*)?"),
        "anyone with the password or key that it now asks for gets a connection",
    ),
    (
        re.compile(r"transport/link/tls/root_ca_certificate(?:_base64)?"),
        "anyone with a certificate of that CA gets a connection",
    ),
)
"""Patterns of setting paths whose change may give access, with a clause for each pattern."""


def looser_settings(old: _Files, new: _Files) -> Iterator[SettingChange]:
    """Yield the changes of settings that make ``new`` permit more than ``old``.

    A file that ``old`` lacks is compared with a file that sros would write, and the endpoints in it
    with the endpoints of all files of ``old``.
    """
    files: dict[tuple[str, str, str, str], list[str]] = defaultdict(list)
    for place, file in sorted(new.items()):
        for key, before, after, meaning in _changes(old, place, file):
            files[key, before, after, meaning].append(place)
    for (key, before, after, meaning), places in files.items():
        of = places[0] if len(places) == 1 else f"{len(places)} Zenoh files"
        yield SettingChange(Effect.LOOSER, f"{key} of {of}", before, after, meaning)


def unknown_settings(old: _Files, new: _Files) -> Iterator[str]:
    """Yield a clause for each setting that differs and whose effect sros does not know."""
    files: dict[str, list[str]] = defaultdict(list)
    for place, file in sorted(new.items()):
        before = old[place].document if place in old else _default_configuration(file.document.mode)
        old_settings, new_settings = before.settings, file.document.settings
        for path in sorted({*old_settings, *new_settings, *file.document.unknown}):
            known = any(pattern.fullmatch(path) for pattern in (_COMPARED_PATHS, _HARMLESS_PATHS))
            gives = any(pattern.fullmatch(path) for pattern, _ in _PATHS_GIVING_ACCESS)
            if old_settings.get(path) != new_settings.get(path) and not known and not gives:
                files[path].append(place)
    for path, places in files.items():
        of = places[0] if len(places) == 1 else f"{len(places)} Zenoh files"
        yield f"the setting {path[:80]} of {of}, whose effect sros does not know"


def _changes(
    old: _Files, place: str, file: SignedConfiguration
) -> Iterator[tuple[str, str, str, str]]:
    """Yield path, old value, new value and meaning of each setting that makes a file permit more.

    ``place`` is the key of ``file``, by which the old file is looked up in ``old``.
    """
    known = old.get(place)
    before, after = (
        known.document if known else _default_configuration(file.document.mode),
        file.document,
    )
    if file.signature != SIGNED and (known is None or known.signature == SIGNED):
        meaning = "anybody who can write the file states the rights and settings"
        yield "signature", SIGNED, file.signature, meaning
    for path, value, open_value, meaning in _TWO_VALUED_SETTINGS:
        if value(after) is open_value is not value(before):
            old_value, new_value = (str(value(document)).lower() for document in (before, after))
            yield path, old_value, new_value, meaning
    for key, what in (
        ("listen", "it listens there"),
        ("connect", ("it connects to the process there")),
    ):
        old_documents = (
            [before] if known else [configuration.document for configuration in old.values()]
        )
        old_endpoints = {
            endpoint.text for document in old_documents for endpoint in getattr(document, key)
        }
        for endpoint in getattr(after, key):
            if old and endpoint.text not in old_endpoints:
                address = f"{endpoint.protocol}/{endpoint.address}"[:80]
                yield f"{key}/endpoints", "without", f"with {address}", what
    if protocols := _added_protocols_text(before.protocols, after.protocols):
        meaning = "it accepts connections over these protocols"
        yield "transport/link/protocols", "without", f"with {protocols}", meaning
    for path in sorted({*before.settings, *after.settings}):
        values = before.settings.get(path), after.settings.get(path)
        for expression, meaning in _PATHS_GIVING_ACCESS:
            plugin = "/".join(path.split("/")[:2])
            gone = plugin.startswith("plugins") and not any(
                setting == plugin or setting.startswith(f"{plugin}/") for setting in after.settings
            )
            if values[0] != values[1] and not gone and expression.fullmatch(path):
                # The values are not shown, because they may be secrets.
                words = ("missing" if value is None else "stated" for value in values)
                old_word, new_word = words
                yield (
                    path[:80],
                    old_word,
                    "another value (not shown)" if old_word == new_word else new_word,
                    meaning,
                )


def _added_protocols_text(before: tuple[str, ...] | None, after: tuple[str, ...] | None) -> str:
    """Return the protocols that only ``after`` allows, as a list in words; "" if there are none."""
    if before is None:
        return ""
    if after is None:
        return "all"
    return ", ".join(protocol[:20] for protocol in after if protocol not in before)


@lru_cache(maxsize=len(Mode))
def _default_configuration(mode: Mode) -> ConfigurationDocument:
    """Return the configuration that sros writes for a mode, without endpoints and rules."""
    return parse_configuration(render_configuration(mode, (), (), ()), "as sros writes it")
