"""Private keys on PKCS#11 tokens, named by URIs; the token signs, and keys never leave it."""

from __future__ import annotations

import importlib.util
import os
import secrets as random
import stat
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from pathlib import Path
from shlex import quote as shell_quote
from typing import Any, NamedTuple
from urllib.parse import quote, unquote

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.utils import Prehashed, encode_dss_signature
from cryptography.hazmat.primitives.serialization import load_der_public_key

from sros_tool.errors import DocumentError, Note, PkiError, UnavailableError, UsageError
from sros_tool.owners import file_of_root
from sros_tool.xml import read_bytes

MODULE_VARIABLE = "PKCS11_MODULE_PATH"
"""The environment variable that names the PKCS#11 module, for sros and for the engine of libp11."""
Secrets = Callable[[str], str]
"""A function that returns a secret for a prompt, such as "the PIN of the token X"."""


def _module_to_load(parsed: TokenUri, *, is_from_user: bool) -> str:
    """Return the path of the PKCS#11 library to load; ``is_from_user``: the user gave the URI.

    If the URI comes from elsewhere, for instance from the settings of a received keystore, the
    library is loaded only if root owns the file, because loading a library runs its code.

    Raises:
        UsageError: no library is named, or the library must not be loaded.
    """
    chosen_module = os.environ.get(MODULE_VARIABLE, "")
    path = Path(parsed.module)
    if parsed.module and is_from_user:
        return parsed.module
    if path.is_absolute() and (real := file_of_root(path)):
        return str(real)
    if chosen_module:
        return chosen_module
    if not parsed.module and (proxy := _find_proxy()):
        return proxy
    if parsed.module:
        raise UsageError(
            f"the PKCS#11 module '{parsed.module}' is not loaded",
            "Its path comes only from the keystore, and users other than root can change the "
            "module. Its code would run in this process.",
            f"If you trust it, set {MODULE_VARIABLE} to its path.",
        )
    raise UsageError(
        f"no PKCS#11 module is known for the token {parsed.token!r}",
        "",
        f"Add ?module-path=FILE to the URI, or set {MODULE_VARIABLE}.",
    )


def _find_proxy() -> str:
    """Return the path of p11-kit's proxy, which loads all registered libraries; "" if missing.

    libp11, too, loads the proxy if no other library is named (Debian and Ubuntu,
    libengine-pkcs11-openssl).
    """
    paths = sorted(path for folder in _PROXIES for path in Path("/").glob(folder))
    return next((str(real) for path in paths if (real := file_of_root(path))), "")


_PROXIES = ("usr/lib/*/p11-kit-proxy.so", "usr/lib64/p11-kit-proxy.so", "usr/lib/p11-kit-proxy.so")


class TokenKey(ec.EllipticCurvePrivateKey):
    """A private key on a token, of the curve prime256v1.

    `cryptography` signs certificates, documents and revocation lists with this key as with any
    other.  ``place`` names the key.  ``private`` is None for a key that is only planned; such a
    key cannot sign.
    """

    def __init__(self, private: Any, public: ec.EllipticCurvePublicKey, place: TokenUri) -> None:
        self._private = private
        self._public = public
        self.place = place

    @property
    def file(self) -> bytes:
        """The content of a ``key.p11`` that names this key."""
        return token_file_content(self.place)

    @property
    def never_left(self) -> bool:
        """Whether the key was made on the token and cannot be exported, as the token states.

        True for a key that a dry run only plans.
        """
        if self._private is None:
            return True  # a planned key, perhaps without the package for tokens
        from pkcs11 import Attribute, PKCS11Error

        try:
            return bool(
                self._private[Attribute.NEVER_EXTRACTABLE]
                and self._private[Attribute.ALWAYS_SENSITIVE]
            )
        except PKCS11Error:
            return False

    def public_key(self) -> ec.EllipticCurvePublicKey:
        """Return the public key."""
        return self._public

    @property
    def curve(self) -> ec.EllipticCurve:
        """The curve of the key."""
        return self._public.curve

    @property
    def key_size(self) -> int:
        """The size of the key in bits."""
        return self._public.key_size

    def sign(self, data: Any, signature_algorithm: ec.EllipticCurveSignatureAlgorithm) -> bytes:
        """Return a DER signature made by the token (CKM_ECDSA); the digest is computed here."""
        import pkcs11

        if self._private is None:
            raise PkiError("a key that is only planned cannot sign")
        algorithm = signature_algorithm.algorithm
        if isinstance(algorithm, Prehashed):
            digest = bytes(data)
        else:
            hasher = hashes.Hash(algorithm)
            hasher.update(data)
            digest = hasher.finalize()
        try:
            raw = self._private.sign(digest, mechanism=pkcs11.Mechanism.ECDSA)
        # Such as after the token was removed.
        except (pkcs11.PKCS11Error, RuntimeError, OSError) as error:
            raise _unusable_token_error(self.place, error) from error
        half = len(raw) // 2
        return encode_dss_signature(
            int.from_bytes(raw[:half], "big"), int.from_bytes(raw[half:], "big")
        )

    def signs_for(self, public: object) -> bool:
        """Return whether ``public``, a certificate's key, verifies signatures of the token."""
        if not isinstance(public, ec.EllipticCurvePublicKey):
            return False
        message, algorithm = random.token_bytes(32), ec.ECDSA(hashes.SHA256())
        try:
            public.verify(self.sign(message, algorithm), message, algorithm)
        except InvalidSignature:
            return False
        return True

    def exchange(self, algorithm: ec.ECDH, peer_public_key: ec.EllipticCurvePublicKey) -> bytes:
        """Refuse key agreement: raise `PkiError`, because this key can only sign."""
        raise PkiError("a key on a token cannot be used for key agreement")

    def private_numbers(self) -> ec.EllipticCurvePrivateNumbers:
        """Raise `PkiError`: the key never leaves the token."""
        raise PkiError("a key on a token cannot be read")

    def private_bytes(self, *_args: Any, **_options: Any) -> bytes:
        """Raise `PkiError`: the key never leaves the token."""
        raise PkiError("a key on a token cannot be read")

    def __copy__(self) -> TokenKey:
        return self

    def __deepcopy__(self, _memo: Any) -> TokenKey:
        return self


def holds_token_key(uri: str, secrets: Secrets, *, is_from_user: bool) -> bool:
    """Return whether the token has the key that ``uri`` names.

    Args:
        uri: the URI of the key.
        secrets: returns the PIN.
        is_from_user: whether the user of this process gave the URI, and so chose the library.  The
            library of any other URI, such as in a keystore's settings, is loaded only if root owns
            the file.

    Raises:
        UsageError: the URI is not valid, or its library must not be loaded.
        PkiError: the token cannot be used.
    """
    return _holds_key(_usable_uri(uri, is_from_user=is_from_user), secrets)


def _holds_key(parsed: TokenUri, secrets: Secrets) -> bool:
    import pkcs11

    try:
        session = _open_session(parsed, secrets, write=False)
        return any(True for _ in session.get_objects({pkcs11.Attribute.LABEL: parsed.object}))
    except (pkcs11.PKCS11Error, RuntimeError, OSError) as error:
        raise _unusable_token_error(parsed, error) from error


def open_token_key(uri: str, secrets: Secrets, *, is_from_user: bool) -> TokenKey:
    """Return the key that ``uri`` names.

    Arguments and errors are those of `holds_token_key`.
    """
    return _open_key(_usable_uri(uri, is_from_user=is_from_user), secrets, create=False)


def create_token_key(uri: str, secrets: Secrets, *, is_from_user: bool) -> TokenKey:
    """Generate a key on the token, and return it; arguments as for `holds_token_key`.

    Raises:
        PkiError: the token has a key with this label, or cannot be used.
    """
    return _open_key(_usable_uri(uri, is_from_user=is_from_user), secrets, create=True)


def make_enclave_key(place: TokenUri, secrets: Secrets) -> TokenKey:
    """Return the key that the user named; generate the key if it is not on the token.

    Raises:
        UsageError: no library is named.
        PkiError: the token cannot be used.
    """
    usable = _with_library(place, is_from_user=True)
    return _open_key(usable, secrets, create=not _holds_key(usable, secrets))


def open_enclave_key(place: TokenUri, secrets: Secrets) -> TokenKey:
    """Return the key that a ``key.p11`` names.

    Raises:
        UsageError: no library is named.
        PkiError: the token cannot be used.
    """
    return _open_key(_with_library(place, is_from_user=False), secrets, create=False)


def planned_key(place: TokenUri) -> TokenKey:
    """Return a placeholder for a key that a dry run would create; no token is opened."""
    return TokenKey(None, ec.generate_private_key(ec.SECP256R1()).public_key(), place)


def _usable_uri(uri: str, *, is_from_user: bool) -> TokenUri:
    return _with_library(parse_token_uri(uri), is_from_user=is_from_user)


def _with_library(parsed: TokenUri, *, is_from_user: bool) -> TokenUri:
    """Return the URI with the path of its library; ``is_from_user``: the user gave the URI.

    Raises:
        UsageError, UnavailableError: tokens cannot be used on this machine.
    """
    parsed = parsed._replace(module=_module_to_load(parsed, is_from_user=is_from_user))
    if importlib.util.find_spec("pkcs11") is None:
        raise UnavailableError(
            "keys on PKCS#11 tokens need the Python package python-pkcs11",
            "",
            "Install it with `pip install python-pkcs11`.",
        )
    return parsed


def _open_key(parsed: TokenUri, secrets: Secrets, *, create: bool) -> TokenKey:
    import pkcs11
    from pkcs11.util.ec import encode_ec_public_key

    try:
        session = _open_session(parsed, secrets, write=create)
        if create:
            _generate_key_pair(session, parsed)
        private = session.get_key(pkcs11.ObjectClass.PRIVATE_KEY, label=parsed.object)
        public = session.get_key(pkcs11.ObjectClass.PUBLIC_KEY, label=parsed.object)
        assert isinstance(public, pkcs11.PublicKey)
        loaded = load_der_public_key(encode_ec_public_key(public))
    except pkcs11.NoSuchKey as error:
        raise PkiError(
            f"the token {parsed.token!r} has no key {parsed.object!r}",
            "",
            "Name a key of the token in the PKCS#11 URI (object=LABEL).",
        ) from error
    except (pkcs11.PKCS11Error, RuntimeError, OSError) as error:
        raise _unusable_token_error(parsed, error) from error
    if not isinstance(loaded, ec.EllipticCurvePublicKey) or loaded.curve.name != "secp256r1":
        raise PkiError(
            f"the key {parsed.object!r} on the token {parsed.token!r} is not an EC prime256v1 key",
            "Some DDS vendors do not accept keys of other kinds.",
            "Name an EC prime256v1 key of the token (object=LABEL).",
        )
    return TokenKey(private, loaded, parsed)


def _unusable_token_error(parsed: TokenUri, error: Exception) -> PkiError:
    return PkiError(
        f"the token {parsed.token!r} cannot be used",
        f"{type(error).__name__}{f': {error}' if str(error) else ''} ({parsed.module}).",
        "Check that the token is present, and that the module path and the PIN are right.",
    )


# Maps (module, token) to the session and whether the session can write: one login per token and
# process.
_sessions: dict[tuple[str, str], tuple[Any, bool]] = {}


def _open_session(parsed: TokenUri, secrets: Secrets, *, write: bool) -> Any:
    import pkcs11

    place = (parsed.module, parsed.token)
    session, writable = _sessions.get(place, (None, False))
    if session is None or (write and not writable):
        pin = _read_pin(parsed, secrets)
        if session is not None:
            session.close()
        token = pkcs11.lib(parsed.module).get_token(token_label=parsed.token)
        session = token.open(rw=write, user_pin=pin)
        _sessions[place] = (session, write)
    return session


def _generate_key_pair(session: Any, parsed: TokenUri) -> None:
    import pkcs11
    from pkcs11.util.ec import encode_named_curve_parameters

    search = {pkcs11.Attribute.LABEL: parsed.object}
    if any(True for _ in session.get_objects(search)):
        raise PkiError(
            f"the token {parsed.token!r} already has a key {parsed.object!r}",
            "",
            "Choose another object name (object=LABEL).",
        )
    parameters = session.create_domain_parameters(
        pkcs11.KeyType.EC,
        {pkcs11.Attribute.EC_PARAMS: encode_named_curve_parameters("secp256r1")},
        local=True,
    )
    parameters.generate_keypair(
        id=random.token_bytes(16),  # libp11 finds the public key by this id
        label=parsed.object,
        store=True,
        private_template={
            pkcs11.Attribute.SENSITIVE: True,
            pkcs11.Attribute.EXTRACTABLE: False,
        },
    )


def _read_pin(parsed: TokenUri, secrets: Secrets) -> str:
    if parsed.pin_source:
        data = read_bytes(Path(parsed.pin_source), "file with the PIN")
        return data.decode(errors="replace").partition("\n")[0]
    return secrets(f"the PIN of the token {parsed.token}")


# ── URIs of keys (RFC 7512) ───────────────────────────────────────────────────────────────────


_SCHEME = "pkcs11:"
# RFC 7512, 2.3.  ``pin-value`` is left out on purpose, see `refuse_pin`.
_PATH_ATTRIBUTES = frozenset(
    {"id", "library-description", "library-manufacturer", "library-version", "manufacturer"}
    | {"model", "object", "serial", "slot-description", "slot-id", "slot-manufacturer"}
    | {"token", "type"}
)
_QUERY_ATTRIBUTES = frozenset({"module-name", "module-path", "pin-source"})
_ENCLAVE_URI_ATTRIBUTES = (
    frozenset({"token", "object", "type"}),
    frozenset({"module-path", "pin-source"}),
)
_FILE_URI_ATTRIBUTES = (_ENCLAVE_URI_ATTRIBUTES[0], frozenset({"pin-source"}))
_MOST_BYTES = 2000
# In bytes: the limit of CK_TOKEN_INFO in PKCS#11, and a limit that leaves enough room.
_LONGEST_TOKEN, _LONGEST_OBJECT = 32, 128


class TokenUri(NamedTuple):
    """The parts of a ``pkcs11:`` URI that sros uses.

    ``object`` is the label of the key.  ``module`` is the path of the PKCS#11 library, or "".
    ``pin_source`` is the path of a file with the PIN, or "".
    """

    token: str
    object: str
    module: str
    pin_source: str = ""


def is_token_uri(place: str) -> bool:
    """Return whether ``place`` is a ``pkcs11:`` URI, in upper or lower case (RFC 3986)."""
    return place[: len(_SCHEME)].lower() == _SCHEME


def refuse_pin(place: str) -> None:
    """Raise `UsageError` if a URI contains a PIN, because URIs are written into files.

    The attribute ``pin-value`` is found in every part of a URI, even percent-encoded.
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
            "the pin-source of a PKCS#11 URI is not an absolute path",
            "sros reads the PIN from a file with an absolute path.",
            "Write pin-source=/PATH/OF/FILE.",
        )
    return TokenUri(token, label, options.get("module-path", ""), pin_source)


def parse_enclave_uri(uri: str, name: str) -> TokenUri:
    """Parse the URI of an enclave's key; ``object`` defaults to the enclave's name, ``name``.

    Only attributes that both sros and Fast DDS read are accepted, so that both find the same key.

    Raises:
        UsageError: the URI is not valid, or has another attribute.
    """
    if is_token_uri(uri) and "object=" not in uri:
        path, query, options = uri.partition("?")
        uri = f"{path};object={quote(name, safe='')}{query}{options}"
    parsed = parse_token_uri(uri)
    path, _, query = uri[len(_SCHEME) :].partition("?")
    kind = _attributes(path.split(";"), _ENCLAVE_URI_ATTRIBUTES[0]).get("type", "private")
    _attributes(query.split("&"), _ENCLAVE_URI_ATTRIBUTES[1])
    too_long = (
        len(parsed.token.encode()) > _LONGEST_TOKEN or len(parsed.object.encode()) > _LONGEST_OBJECT
    )
    texts = (parsed.token, parsed.object, parsed.module, parsed.pin_source)
    if kind != "private" or too_long or not all(map(str.isprintable, texts)):
        raise UsageError(
            "the PKCS#11 URI cannot name the key of an enclave",
            f"The token name may have at most {_LONGEST_TOKEN} bytes, the object name at most "
            f"{_LONGEST_OBJECT}, and no control characters. If the URI states a type, it has to be "
            "private.",
            "Write pkcs11:token=NAME;object=LABEL?pin-source=FILE.",
        )
    return parsed


def token_places(uri: str, names: Sequence[str]) -> Mapping[str, TokenUri]:
    """Map enclaves to the places of their keys: ``uri``, with the enclave's name as default label.

    Raises:
        UsageError: ``uri`` is not a PKCS#11 URI, or names one key for several enclaves.
    """
    if not is_token_uri(uri):
        raise UsageError(
            "--key has to be the URI of a key on a PKCS#11 token",
            "Without --key, the key is made in a file.",
            "Write --key 'pkcs11:token=NAME;object=LABEL', or leave --key out.",
        )
    places = {name: parse_enclave_uri(uri, name) for name in names}
    if len({place.object for place in places.values()}) < len(places):
        raise UsageError(
            "one key is named for several enclaves",
            "Two enclaves with one key are one identity: each can act as the other.",
            "Leave object= out: then the label of each key is the name of its enclave.",
        )
    return places


def token_file_content(parsed: TokenUri) -> bytes:
    """Return the content of a ``key.p11``: one line, which Fast DDS gives to OpenSSL.

    The line does not name the module: libp11 0.4.12 refuses this attribute, and takes the module
    from ``PKCS11_MODULE_PATH`` (libp11, eng_parse.c and eng_back.c).
    """
    token, label = quote(parsed.token, safe=""), quote(parsed.object, safe="")
    uri = f"{_SCHEME}token={token};object={label};type=private"
    if parsed.pin_source:
        uri += f"?pin-source=file:{quote(parsed.pin_source, safe='/')}"
    return f"{uri}\n".encode()


def parse_token_file(data: bytes) -> TokenUri:
    """Return the URI in a ``key.p11``; errors do not quote the content, which may contain a PIN.

    RMWs read only the first word of the file, so nothing may follow the URI.

    Raises:
        PkiError: the file is not one PKCS#11 URI that sros and Fast DDS read alike.
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
        named = _attributes(path.split(";"), _FILE_URI_ATTRIBUTES[0])
        _attributes(query.split("&"), _FILE_URI_ATTRIBUTES[1])
        if not (named.get("token") and named.get("object")):
            raise UsageError("it does not name both a token and an object")
        return parse_enclave_uri(text, "")
    except UsageError as error:
        raise PkiError(error.what, error.what) from error


def _attributes(parts: Sequence[str], known: Set[str]) -> dict[str, str]:
    """Map the attributes in ``parts`` of a URI to their decoded values.

    Attributes that are not in ``known`` are refused. Errors do not quote values, which may be
    secret.
    """
    attributes: dict[str, str] = {}
    for part in filter(None, parts):
        name, _, value = part.partition("=")
        if name not in known or name in attributes:
            shown = f" {name!r}" if name.replace("-", "").isalpha() else ""
            raise UsageError(
                f"the attribute{shown} of a PKCS#11 URI is not accepted",
                "sros does not support it here, or it is repeated or in the wrong part of the URI.",
                "Write pkcs11:token=NAME;object=LABEL?module-path=FILE&pin-source=FILE.",
            )
        attributes[name] = unquote(value)
    return attributes


def place_in_file(path: Path) -> TokenUri:
    """Return the place on a token that the file ``key.p11`` at ``path`` names.

    Raises:
        SrosError: the file cannot be read, or names no key on a token.
    """
    try:
        return parse_token_file(read_bytes(path, "place of the key"))
    except PkiError as error:
        raise PkiError(
            f"'{path}' does not name a key on a token", error.why, "Write it again."
        ) from error


# ── the file with a PIN ────────────────────────────────────────────────────────────────────

_LONGEST_PIN = 256  # in bytes; CK_TOKEN_INFO of PKCS#11 says which lengths a token accepts


def pin_file_problem(place: TokenUri) -> str:
    """Return a clause that says why the PIN file of a token cannot be used; "" if it can."""
    if not place.pin_source:
        return ""
    path = Path(place.pin_source)
    try:
        read_bytes(path, "file with the PIN", max_bytes=_LONGEST_PIN)
        mode = stat.S_IMODE(path.stat().st_mode)
    except (DocumentError, OSError) as error:
        return str(error).rstrip(".")
    if mode & 0o077:
        return (
            f"others can access the file with the PIN, '{path}' (mode {mode:04o}): run `chmod 600 "
            f"{shell_quote(str(path))}`"
        )
    return ""


def pin_line_break_clause(place: TokenUri) -> str:
    """Return a clause about the effect of a line break after the PIN; "" if there is none."""
    try:
        pin = read_bytes(Path(place.pin_source), "file with the PIN", max_bytes=_LONGEST_PIN)
    except DocumentError:
        return ""
    if not pin.endswith((b"\n", b"\r")):
        return ""
    return (
        f"the file with the PIN, '{place.pin_source}', ends with a line break. libp11 before "
        "0.4.17 takes it for a part of the PIN, and no node starts: write the file with `printf "
        "%s PIN`"
    )


def token_notes(key: TokenKey) -> Iterator[Note]:
    """Yield notes on a token's key that may have been copied, and on the PIN file."""
    place = key.place
    if not key.never_left:
        yield Note(
            "token.key-can-be-copied",
            f"the token {place.token!r} does not say that the key {place.object!r} was made on it "
            "and never left it: there may be a copy, or one can be made.",
        )
    yield from pin_notes(place)


def pin_notes(place: TokenUri) -> Iterator[Note]:
    """Yield notes on a PIN file that Fast DDS cannot use, or that other users can read."""
    for problem in filter(None, (pin_file_problem(place), pin_line_break_clause(place))):
        yield Note("token.pin-file", f"{problem}.")
