"""Where secrets come from: the environment, a file, or a person; never an argument."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from sros_tool.errors import PkiError

if TYPE_CHECKING:
    from sros_tool.keystore.keyring import Keyring

PASSPHRASE, PASSPHRASE_FILE = "SROS_CA_PASSPHRASE", "SROS_CA_PASSPHRASE_FILE"
PIN = "SROS_PKCS11_PIN"
PLACES = {"identity": "SROS_IDENTITY_KEY", "permissions": "SROS_PERMISSIONS_KEY"}


def keyring(
    identity: str | None = None, permissions: str | None = None, *, encrypt: bool = False
) -> Keyring:
    """The keys at the places that are given, or that the environment names."""
    from sros_tool.keystore.keyring import Keyring

    given = {"identity": identity, "permissions": permissions}
    places = {role: given[role] or os.environ.get(name, "") for role, name in PLACES.items()}
    return Keyring(
        _Answers(encrypt),
        {role: _absolute(place) for role, place in places.items() if place},
        encrypt,
    )


def _absolute(place: str) -> str:
    if place.startswith("pkcs11:"):
        return place
    return f"file:{Path(place.removeprefix('file:')).absolute()}"


class _Answers:
    """A secrets handler that asks each question once."""

    def __init__(self, new: bool) -> None:
        self._new = new
        self._known: dict[str, str] = {}

    def __call__(self, what: str) -> str:
        if what not in self._known:
            self._known[what] = self._find(what)
        return self._known[what]

    def _find(self, what: str) -> str:
        is_pin = " PIN " in f" {what} "
        value = os.environ.get(PIN if is_pin else PASSPHRASE, "")
        file = "" if is_pin else os.environ.get(PASSPHRASE_FILE, "")
        if not value and file:
            value = Path(file).read_text(encoding="utf-8").partition("\n")[0]
        if not value and sys.stdin.isatty():
            confirm = self._new and not is_pin
            value = click.prompt(
                what.capitalize(), hide_input=True, err=True, confirmation_prompt=confirm
            )
        if not value:
            names = PIN if is_pin else f"{PASSPHRASE} or {PASSPHRASE_FILE}"
            raise PkiError(f"{what} is needed", "There is no terminal to ask at.", f"Set {names}.")
        return value
