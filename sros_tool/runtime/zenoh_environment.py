"""The environment variables of rmw_zenoh_cpp: its configuration, and the paths of the enclave.

ZENOH_SESSION_CONFIG_URI names the configuration of nodes, ZENOH_ROUTER_CONFIG_URI that of the
router; without a value the default of rmw_zenoh_cpp is used, which is open.  ZENOH_CONFIG_OVERRIDE
has the form ``KEY=VALUE;KEY=VALUE``, with values in JSON5, and is applied after either file.

Source: rmw_zenoh_cpp, ``zenoh_config.cpp`` and ``zenohd/main.cpp`` (2025).  Earlier versions do not
read ZENOH_CONFIG_OVERRIDE; there, a session with the configuration of an enclave does not open.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path

from sros_tool.errors import KeystoreError, Note
from sros_tool.runtime.rmw import RMW
from sros_tool.wording import first_few

RMW_ZENOH = "rmw_zenoh_cpp"
SESSION_URI, ROUTER_URI = "ZENOH_SESSION_CONFIG_URI", "ZENOH_ROUTER_CONFIG_URI"
OVERRIDE = "ZENOH_CONFIG_OVERRIDE"
_VARIABLES = (SESSION_URI, ROUTER_URI, OVERRIDE)

NO_CONFIGURATION = "/dev/null/refused-by-sros.json5"
"""A path that can never exist: a process that has to read it as its configuration ends."""

_TLS = "transport/link/tls"
_LINE_ENDS = {each: f"\\u{each:04x}" for each in (0x2028, 0x2029)}
"""Characters that JSON allows in a string, and JSON5 does not."""
_MOST_KEYS = 5
_MOST_CHARACTERS = 60


def zenoh_environment(
    configurations: Mapping[str, str], authority: Path, certificate: Path, key: Path
) -> dict[str, str]:
    """Return the variables that make processes of rmw_zenoh_cpp run in an enclave, or not open.

    ``configurations`` maps `SESSION_URI` and `ROUTER_URI` to the absolute path of the file; a
    process of the kind that is left out does not start.  The other paths are absolute, too.

    Raises:
        KeystoreError: a path is not UTF-8, or has a ";" or "?", so that Zenoh would read another.
    """
    files = {"root_ca_certificate": authority}
    for side in ("connect", "listen"):
        files |= {f"{side}_private_key": key, f"{side}_certificate": certificate}
    return {
        RMW: RMW_ZENOH,
        SESSION_URI: configurations.get(SESSION_URI, NO_CONFIGURATION),
        ROUTER_URI: configurations.get(ROUTER_URI, NO_CONFIGURATION),
        OVERRIDE: ";".join(f"{_TLS}/{name}={_text(path)}" for name, path in files.items()),
    }


def _text(path: Path) -> str:
    """Return a path as a JSON string.

    Zenoh puts paths behind "#" into the text of an endpoint, in which ";" and "?" also have a
    meaning (measured with 1.10.2).
    """
    text = str(path)
    if set(text) & set(";?") or any("\ud800" <= each <= "\udfff" for each in text):
        raise KeystoreError(
            f"the path {text!r} cannot be given to Zenoh",
            "Zenoh reads paths as UTF-8 text, in which neither ';' nor '?' can be.",
            "Move the keystore to another path.",
        )
    return json.dumps(text, ensure_ascii=False).translate(_LINE_ENDS)


def override_pairs(text: str) -> Iterator[tuple[str, str]]:
    """Yield the keys and values of ZENOH_CONFIG_OVERRIDE, as rmw_zenoh_cpp divides it.

    A value ends at a line end; what has no key or no value is skipped.
    """
    for pair in text.split(";"):
        key, _, value = pair.partition("=")
        value = value.partition("\n")[0]
        if key and value:
            yield key, value


def replaced_notes(environment: Mapping[str, str], variables: Mapping[str, str]) -> Iterator[Note]:
    """Yield a note for each Zenoh variable of ``environment`` that ``variables`` replace.

    Another value of ZENOH_CONFIG_OVERRIDE could switch access control off, so its keys are named.
    """
    for name in _VARIABLES:
        before = environment.get(name)
        if not before or before == variables.get(name):
            continue
        if name != OVERRIDE:
            yield Note("zenoh.replaced", f"{name} was {_shortened(before)}, and is replaced.")
            continue
        keys = [key.strip().strip("/") for key, _ in override_pairs(before)]
        shown = first_few([_shortened(key) for key in keys], _MOST_KEYS) or "nothing"
        yield Note("zenoh.replaced", f"{OVERRIDE} was set for {shown}, and is replaced.")
        if any(key.partition("/")[0] == "access_control" for key in keys):
            yield Note(
                "zenoh.access-control-override",
                f"WARNING: the replaced {OVERRIDE} changed access_control: with it, this process "
                "would not enforce the rules of its file. Find out what sets it, and remove it "
                "there: nodes that are started without sros still get it.",
            )


def _shortened(text: str) -> str:
    shown = text if len(text) <= _MOST_CHARACTERS else f"{text[:_MOST_CHARACTERS]}..."
    return repr(shown)


REFUSING_ZENOH: Mapping[str, str] = {SESSION_URI: NO_CONFIGURATION, ROUTER_URI: NO_CONFIGURATION}
"""Variables with which neither a node nor a router of rmw_zenoh_cpp opens a session."""
