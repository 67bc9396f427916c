"""Keys of enclaves on PKCS#11 tokens: their places, checks of new keys, and notes on them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from shlex import quote

from sros_tool.errors import KeystoreError, Note, PkiError, UsageError
from sros_tool.keystore.issuing.authority import Authorities
from sros_tool.keystore.known_keys import KnownKeys
from sros_tool.keystore.layout import KEY_URI_FILE, enclave_path
from sros_tool.pki.token import (
    Secrets,
    TokenKey,
    TokenUri,
    is_token_uri,
    make_enclave_key,
    parse_enclave_uri,
    pin_file_problem,
    pin_line_break,
    planned_key,
    read_token_file,
    token_file,
)
from sros_tool.xml import read_bytes


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


def place_in(path: Path) -> TokenUri:
    """Return the place on a token that the file ``key.p11`` at ``path`` names.

    Raises:
        SrosError: the file cannot be read, or names no key on a token.
    """
    try:
        return read_token_file(read_bytes(path, "place of the key"))
    except PkiError as error:
        raise PkiError(
            f"'{path}' does not name a key on a token", error.why, "Write it again."
        ) from error


@dataclass(frozen=True, slots=True)
class EnclaveTokens:
    """The ``places`` of new keys on tokens, by enclave, and the keys that must not be reused."""

    places: Mapping[str, TokenUri]
    secrets: Secrets
    known: KnownKeys
    authorities: Authorities
    dry_run: bool = False

    def key(self, name: str) -> TokenKey:
        """Return the key at the enclave's place on the token, after creating it if it is missing.

        Raises:
            KeystoreError: the key was revoked, or belongs to another enclave or to a CA.
            PkiError: the token cannot be used.
        """
        place = self.places[name]
        if self.dry_run:
            return planned_key(place)
        key = make_enclave_key(place, self.secrets)
        public, remedy = key.public_key(), "Name another object of the token."
        for authority in (self.authorities.identity, self.authorities.permissions):
            if authority.certificate.public_key() == public:
                raise KeystoreError(
                    f"the key for enclave {name} is the key of a CA",
                    "Whoever has the robot could issue any identity, or sign any rights.",
                    remedy,
                )
        self.known.refuse_revoked(public, f"enclave {name}", remedy)
        self.known.refuse_shared_key(public, name, remedy)
        return key

    def check_present(self, name: str, root: Path) -> None:
        """Raise `KeystoreError` if the key of an existing enclave is not at the chosen place."""
        path = enclave_path(root, name) / KEY_URI_FILE
        if not path.exists() or read_bytes(path, "place of the key") != token_file(
            self.places[name]
        ):
            where = quote(str(root))
            raise KeystoreError(
                f"enclave {name} of keystore '{root}' already has another key",
                "",
                f"To replace it: `sros renew {where} {name} --key 'pkcs11:...' --revoke-old`.",
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
    for problem in filter(None, (pin_file_problem(place), pin_line_break(place))):
        yield Note("token.pin-file", f"{problem}.")
