"""PKCS#11 URIs (RFC 7512) that name the key of a CA or enclave; none may contain a PIN."""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote, unquote

from sros_tool.errors import PkiError, UsageError

_SCHEME = "pkcs11:"
# RFC 7512, 2.3.  ``pin-value`` is missing on purpose, see `refuse_pin`.
_PATH_ATTRIBUTES = frozenset(
    {"id", "library-description", "library-manufacturer", "library-version", "manufacturer"}
    | {"model", "object", "serial", "slot-description", "slot-id", "slot-manufacturer"}
    | {"token", "type"}
)
_QUERY_ATTRIBUTES = frozenset({"module-name", "module-path", "pin-source"})
_OF_ENCLAVE = (frozenset({"token", "object", "type"}), frozenset({"module-path", "pin-source"}))
_OF_FILE = (_OF_ENCLAVE[0], frozenset({"pin-source"}))
_MOST_BYTES = 2000
_LONGEST_TOKEN, _LONGEST_OBJECT = 32, 128  # bytes; CK_TOKEN_INFO of PKCS#11, and enough


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


def parse_enclave_uri(uri: str, name: str) -> TokenUri:
    """Parse the URI of an enclave's key; without ``object``, it is ``name``, the enclave.

    Only what sros uses and Fast DDS reads is accepted, so that both find the same key.

    Raises:
        UsageError: the URI is not valid, or has another attribute.
    """
    if is_token_uri(uri) and "object=" not in uri:
        path, query, options = uri.partition("?")
        uri = f"{path};object={quote(name, safe='')}{query}{options}"
    parsed = parse_token_uri(uri)
    path, _, query = uri[len(_SCHEME) :].partition("?")
    kind = _attributes(path.split(";"), _OF_ENCLAVE[0]).get("type", "private")
    _attributes(query.split("&"), _OF_ENCLAVE[1])
    too_long = (
        len(parsed.token.encode()) > _LONGEST_TOKEN or len(parsed.object.encode()) > _LONGEST_OBJECT
    )
    texts = (parsed.token, parsed.object, parsed.module, parsed.pin_source)
    if kind != "private" or too_long or not all(map(str.isprintable, texts)):
        raise UsageError(
            "the PKCS#11 URI cannot name the key of an enclave",
            f"A token has at most {_LONGEST_TOKEN} bytes, an object {_LONGEST_OBJECT}, its type is "
            "private, and nothing in it is a control character.",
            "Write pkcs11:token=NAME;object=LABEL?pin-source=FILE.",
        )
    return parsed


def token_file(parsed: TokenUri) -> bytes:
    """Return the content of a ``key.p11``: one line, which Fast DDS gives to OpenSSL.

    The module is not in it: libp11 0.4.12 refuses the attribute, and takes the module from
    ``PKCS11_MODULE_PATH`` (libp11, eng_parse.c and eng_back.c).
    """
    uri = f"{_SCHEME}token={_encoded(parsed.token)};object={_encoded(parsed.object)};type=private"
    if parsed.pin_source:
        uri += f"?pin-source=file:{quote(parsed.pin_source, safe='/')}"
    return f"{uri}\n".encode()


def read_token_file(data: bytes) -> TokenUri:
    """Return the key that a ``key.p11`` names; an error shows nothing of it, as it may have a PIN.

    The RMWs read its first word, so nothing may follow.

    Raises:
        PkiError: it is not one PKCS#11 URI that sros and Fast DDS read alike.
    """
    text = data.decode("utf-8", "replace").removesuffix("\n")
    if len(data) > _MOST_BYTES or not text.startswith(_SCHEME) or len(text.split()) != 1:
        raise PkiError(
            "it is not a PKCS#11 URI",
            "It has to be one line that begins with pkcs11: and has no spaces",
        )
    try:
        path, _, query = text[len(_SCHEME) :].partition("?")
        refuse_pin(text)
        named = _attributes(path.split(";"), _OF_FILE[0])
        _attributes(query.split("&"), _OF_FILE[1])
        if not (named.get("token") and named.get("object")):
            raise UsageError("it names no token, or no object of one")
        return parse_enclave_uri(text, "")
    except UsageError as error:
        raise PkiError(error.what, error.what) from error


def _encoded(text: str) -> str:
    return quote(text, safe="")


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
