"""Keys of enclaves on PKCS#11 tokens: their places, and what is to be known of them."""

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
    """Return the place of the key of each enclave: ``uri``, with the name as label if it has none.

    Raises:
        UsageError: it is not a PKCS#11 URI, or gives several enclaves one key.
    """
    if not is_token_uri(uri):
        raise UsageError(
            "--key takes a key on a PKCS#11 token",
            "Without it, the key is made in a file.",
            "Write --key 'pkcs11:token=NAME;object=LABEL', or leave it out.",
        )
    places = {name: parse_enclave_uri(uri, name) for name in names}
    if len({each.object for each in places.values()}) < len(places):
        raise UsageError(
            "one key is named for several enclaves",
            "Two enclaves with one key are one identity: each can act as the other.",
            "Leave object= out, and the label of each key is the name of its enclave.",
        )
    return places


def place_in(path: Path) -> TokenUri:
    """Return the place of the key that a ``key.p11`` names.

    Raises:
        SrosError: it cannot be read, or names none.
    """
    try:
        return read_token_file(read_bytes(path, "place of the key"))
    except PkiError as error:
        raise PkiError(f"'{path}' names no key on a token", error.why, "Write it again.") from error


@dataclass(frozen=True, slots=True)
class EnclaveTokens:
    """The ``places`` of new keys on tokens, by enclave, and what they are compared with."""

    places: Mapping[str, TokenUri]
    secrets: Secrets
    known: KnownKeys
    authorities: Authorities
    dry_run: bool = False

    def key(self, name: str) -> TokenKey:
        """Return the key at an enclave's place, made there if it is missing.

        Raises:
            KeystoreError: it was revoked, or is the key of another enclave or of a CA.
            PkiError: the token cannot be used.
        """
        place = self.places[name]
        if self.dry_run:
            return planned_key(place)
        key = make_enclave_key(place, self.secrets)
        public, remedy = key.public_key(), "Name another object of the token."
        for each in (self.authorities.identity, self.authorities.permissions):
            if each.certificate.public_key() == public:
                raise KeystoreError(
                    f"the key for enclave {name} is the key of a CA",
                    "Whoever has the robot could issue any identity, or sign any rights.",
                    remedy,
                )
        self.known.refuse_revoked(public, f"enclave {name}", remedy)
        self.known.refuse_second(public, name, remedy)
        return key

    def check_present(self, name: str, root: Path) -> None:
        """Raise `KeystoreError` if an enclave that has a key has another than the chosen one."""
        path = enclave_path(root, name) / KEY_URI_FILE
        if not path.exists() or read_bytes(path, "place of the key") != token_file(
            self.places[name]
        ):
            where = quote(str(root))
            raise KeystoreError(
                f"enclave {name} of keystore '{root}' has another key already",
                "",
                f"To replace it: `sros renew {where} {name} --key 'pkcs11:...' --revoke-old`.",
            )


def token_notes(key: TokenKey) -> Iterator[Note]:
    """Yield what can go wrong with a key on a token, and with the file of its PIN."""
    place = key.place
    if not key.never_left:
        yield Note(
            "token.key-can-be-copied",
            f"the token {place.token!r} does not say that the key {place.object!r} was made on it "
            "and never left it: there may be a copy, or one can be made.",
        )
    yield from pin_notes(place)


def pin_notes(place: TokenUri) -> Iterator[Note]:
    """Yield why Fast DDS may not use the file that has the PIN of a token, or others may."""
    for problem in filter(None, (pin_file_problem(place), pin_line_break(place))):
        yield Note("token.pin-file", f"{problem}.")
