"""Messages of robots, as their agents put them into the inbox."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime
from pathlib import Path

from sros_tool.keystore.confirmation import Confirmation, make_confirmation, render_confirmation
from sros_tool.keystore.reader import read_certificate
from sros_tool.pki import smime
from sros_tool.pki.keys import PrivateKey, load_key


def key_of(folder: Path, enclave: str) -> PrivateKey:
    """Return the private key of an enclave in a robot's folder."""
    return load_key((folder / f"enclaves{enclave}/key.pem").read_bytes(), "it")


def said_by(folder: Path, robot: str, now: datetime, **changed: object) -> Confirmation:
    """Return what the agent of a robot confirms, as its first message, with ``changed`` values."""
    made = make_confirmation(folder, robot, now=now)
    return replace(made, **{"sequence": 1, **changed})  # type: ignore[arg-type]


def signed_message(folder: Path, enclave: str, said: Confirmation) -> bytes:
    """Return a message, signed with the key of an enclave in a robot's folder."""
    certificate = read_certificate(folder / f"enclaves{enclave}/cert.pem")
    return smime.sign(render_confirmation(said), certificate, key_of(folder, enclave))
