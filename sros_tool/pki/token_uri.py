"""PKCS#11 URIs (RFC 7512) that name the key of a CA; none of them may contain a PIN."""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote

from sros_tool.errors import UsageError

_SCHEME = "pkcs11:"
# RFC 7512, 2.3.  ``pin-value`` is missing on purpose, see `refuse_pin`.
_PATH_ATTRIBUTES = frozenset(
    {"id", "library-description", "library-manufacturer", "library-version", "manufacturer"}
    | {"model", "object", "serial", "slot-description", "slot-id", "slot-manufacturer"}
    | {"token", "type"}
)
_QUERY_ATTRIBUTES = frozenset({"module-name", "module-path", "pin-source"})


@dataclass(frozen=True, slots=True)
class TokenUri:
    """The parts of a ``pkcs11:`` URI that sros uses.

    ``object`` is the label of the key, ``module`` the path of the PKCS#11 library, or "", and
    ``pin_source`` the path of a file with the PIN, or "".
    """

    token: str
    object: str
    module: str
    pin_source: str = ""


def is_token_uri(place: str) -> bool:
    """Return whether the place of a key is a ``pkcs11:`` URI, in letters of any case (RFC 3986)."""
    return place[: len(_SCHEME)].lower() == _SCHEME


def refuse_pin(place: str) -> None:
    """Raise `UsageError` if the place of a key contains a PIN: places are written into files.

    The attribute ``pin-value`` is found in every part of a URI, and percent-encoded, too.
    """
    plain = place
    while (decoded := unquote(plain)) != plain:
        plain = decoded
    if "pin-value" in "".join(plain.split()).lower():
        raise UsageError(
            "a PKCS#11 URI with pin-value is not accepted",
            "The PIN would be written into the keystore's settings, which others may read.",
            "Remove pin-value, and give the PIN by a prompt, SROS_PKCS11_PIN or pin-source=FILE.",
        )


def parse_token_uri(uri: str) -> TokenUri:
    """Parse ``pkcs11:token=NAME;object=LABEL?module-path=FILE`` (RFC 7512).

    Raises:
        UsageError: a part is missing, an attribute is not of RFC 7512, or there is a ``pin-value``.
    """
    refuse_pin(uri)
    path, _, query = uri[len(_SCHEME) :].partition("?")
    parts = _attributes(path.split(";"), _PATH_ATTRIBUTES)
    options = _attributes(query.split("&"), _QUERY_ATTRIBUTES)
    token, label = parts.get("token", ""), parts.get("object", "")
    if not is_token_uri(uri) or not token or not label:
        raise UsageError(
            f"{uri!r} does not name a key on a token",
            "The URI has to name a token and an object.",
            "Write pkcs11:token=NAME;object=LABEL?module-path=FILE.",
        )
    pin_source = options.get("pin-source", "").removeprefix("file:")
    if pin_source and not Path(pin_source).is_absolute():
        raise UsageError(
            "the pin-source of a PKCS#11 URI is not the path of a file",
            "sros reads the PIN from a file with an absolute path.",
            "Write pin-source=/PATH/OF/FILE.",
        )
    return TokenUri(token, label, options.get("module-path", ""), pin_source)


def _attributes(parts: Sequence[str], known: Set[str]) -> dict[str, str]:
    """Return the attributes of one part of a URI, decoded; an error does not show their values."""
    found: dict[str, str] = {}
    for part in filter(None, parts):
        name, _, value = part.partition("=")
        if name not in known or name in found:
            shown = f" {name!r}" if name.replace("-", "").isalpha() else ""
            raise UsageError(
                f"the attribute{shown} of a PKCS#11 URI is not accepted",
                "RFC 7512 does not have it, not in this part of the URI, or not twice.",
                "Write pkcs11:token=NAME;object=LABEL?module-path=FILE&pin-source=FILE.",
            )
        found[name] = unquote(value)
    return found
