"""Ways to weaken the keystore of a robot, and the rows of its demo that each of them must fail."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any

from sros_tool.dds.governance import Governance, ProtectionKind, parse_governance, render_governance
from sros_tool.dds.permissions import render_permissions
from sros_tool.demo import forger
from sros_tool.demo.backend import Backend
from sros_tool.demo.forger import KeystoreCopy
from sros_tool.demo.scenarios.model import Condition
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    GOVERNANCE_P7S,
    KEY_FILE,
    PERMISSIONS_FILE,
    enclave_path,
    list_enclaves,
)
from sros_tool.keystore.lifecycle.revoke import revoke
from sros_tool.validity import Window
from tests.support.harness import copy_of

_DAY = timedelta(days=1)
_NONE = ProtectionKind.NONE
_BARE = {
    "rtps_protection_kind": _NONE,
    "discovery_protection_kind": _NONE,
    "liveliness_protection_kind": _NONE,
}
_BARE_TOPIC = {
    "enable_discovery_protection": False,
    "enable_liveliness_protection": False,
    "metadata_protection_kind": _NONE,
    "data_protection_kind": _NONE,
}
_FREE_TOPIC = {"enable_read_access_control": False, "enable_write_access_control": False}
_OPEN_TOPIC = _BARE_TOPIC | _FREE_TOPIC

OTHERS = "joins the other enclaves"
GIVEN = (
    "an enclave publishes a topic that it was not given",
    "an enclave hears a topic that it was not given",
    "an enclave calls a service that it was not given",
)
WIDEST = (
    "the widest enclave publishes a topic that it was not given",
    "the widest enclave hears a topic that it was not given",
    "the widest enclave calls a service that it was not given",
    "the widest enclave poses as the server",
)
SIGNED_BY_ITSELF = "permissions and governance signed by the enclave"
"""A row that needs a DDS that accepts an enclave as signer, even as the attacker's own."""
OWN_PART = ("a listener publishes", "a talker listens", "a client poses as the server")


@dataclass(frozen=True)
class Place:
    """A keystore to weaken: ``victim`` and ``other`` are two of its enclaves without other parts.

    ``foreign`` is a keystore of other CAs with the same enclaves.
    """

    root: Path
    foreign: Path
    victim: str
    other: str

    def copy(self, enclave: str = "") -> KeystoreCopy:
        """The keystore for the forger; ``enclave`` (the victim) has the part of the guest."""
        cast = {"guest": enclave or self.victim}
        return KeystoreCopy(self.root, self.foreign, cast, "/x", 0, datetime.now(UTC))

    @property
    def folder(self) -> Path:
        """The folder of the victim."""
        return enclave_path(self.root, self.victim)


def _governed(domain: Mapping[str, Any], topic: Mapping[str, Any], place: Place) -> None:
    """Sign another governance for all enclaves, as nobody does who uses sros."""
    copy = place.copy()
    rules = parse_governance(copy.governance()).domain_access_rules
    changed = (
        replace(
            rule,
            **domain,
            topic_access_rules=tuple(replace(each, **topic) for each in rule.topic_access_rules),
        )
        for rule in rules
    )
    document = render_governance(Governance(tuple(changed)))
    (place.root / GOVERNANCE_P7S).write_bytes(copy.sign(document))


def _one_wild(place: Place) -> None:
    forger.guest_may_do_everything(place.copy())


def _all_wild(place: Place) -> None:
    for name in list_enclaves(place.root):
        forger.guest_may_do_everything(place.copy(name))


def _certificate_of_another_ca(place: Place) -> None:
    for file in (CERTIFICATE_FILE, KEY_FILE):
        shutil.copy(enclave_path(place.foreign, place.victim) / file, place.folder / file)


def _enclave_of_another_keystore(place: Place) -> None:
    """All files of the enclave agree with each other, and with nobody else's."""
    shutil.rmtree(place.folder)
    place.folder.mkdir(mode=0o700)
    for file in enclave_path(place.foreign, place.victim).iterdir():
        if file.exists():
            shutil.copy(file, place.folder / file.name)


def _permissions_of_another_ca(place: Place) -> None:
    copy = place.copy()
    document = render_permissions(copy.permissions("guest"))
    copy.put("guest", PERMISSIONS_FILE, copy.sign(document, place.foreign))


def _permissions_of_another_enclave(place: Place) -> None:
    found = enclave_path(place.root, place.other) / PERMISSIONS_FILE
    place.copy().put("guest", PERMISSIONS_FILE, found.read_bytes())


def _expired(place: Place) -> None:
    now = datetime.now(UTC)
    place.copy().reissue("guest", Window(now - 2 * _DAY, now - _DAY))


def _without_lists(place: Place) -> None:
    revoke(place.root, [place.other], now=datetime.now(UTC))
    for file in place.root.glob("enclaves/**/crl.pem"):
        file.unlink()


def _revoked_and_back(place: Place) -> None:
    """What a thief kept of a revoked enclave is in its place again, and no list tells of it."""
    kept = place.root.parent / "kept"
    copy_of(place.folder, kept)
    revoke(place.root, [place.victim], now=datetime.now(UTC))
    shutil.rmtree(place.folder, ignore_errors=True)
    copy_of(kept, place.folder)
    for file in place.root.glob("enclaves/**/crl.pem"):
        file.unlink()


@dataclass(frozen=True)
class WeakRobot:
    """A way to weaken a keystore, and the rows that must fail for it, on Cyclone DDS."""

    weaken: Callable[[Place], None]
    broken: tuple[str, ...]
    joins: bool = False
    """Whether also the row of the victim fails that looks whether it joins the others."""
    on_fast: tuple[str, ...] | None = None
    """The rows that must fail on Fast DDS, where they differ."""

    def broken_on(self, backend: Backend) -> set[str]:
        """The rows that must fail on a backend, without those of `joins`."""
        if backend.vendor is Condition.FAST and self.on_fast is not None:
            return set(self.on_fast)
        return set(self.broken) - ({SIGNED_BY_ITSELF} if backend.checks_signers else set())


_ELSEWHERE = "permissions for another domain"
_LOOKS = "an enclave of another domain lists topics"
_REVOKED = ("revoked identity", "old permissions put back after revocation")
_OPEN = (
    *GIVEN,
    *WIDEST,
    *OWN_PART,
    *_REVOKED,
    "payload read on the wire",
    "packets of a secured talker changed",
    "an unsecured node listens",
    "an unsecured node lists topics",
    "an unsecured node injects",
    "variables spelt right",
)
_UNCHECKED = (
    _ELSEWHERE,
    _LOOKS,
    "packets of a secured talker sent again",
    "certificate with the key of another enclave",
    "the attacker's own permissions CA",
    SIGNED_BY_ITSELF,
)
"""What whom peers refuse can do as if it were unsecured: on Cyclone DDS, not on Fast DDS."""
WEAK: Mapping[str, WeakRobot] = {
    "one enclave that may do everything": WeakRobot(_one_wild, WIDEST),
    "enclaves that may all do everything": WeakRobot(_all_wild, (*GIVEN, *WIDEST, *OWN_PART)),
    "nothing protected": WeakRobot(
        partial(_governed, _BARE, _BARE_TOPIC),
        ("payload read on the wire", "packets of a secured talker changed"),
    ),
    "unauthenticated participants admitted": WeakRobot(
        partial(_governed, _BARE | {"allow_unauthenticated_participants": True}, _OPEN_TOPIC),
        (*_OPEN, *_UNCHECKED),
        on_fast=_OPEN,
    ),
    "joining not controlled": WeakRobot(
        partial(_governed, {"enable_join_access_control": False}, {}),
        (_ELSEWHERE, _LOOKS),
        on_fast=(_LOOKS,),
    ),
    "topics not controlled": WeakRobot(
        partial(_governed, {}, _FREE_TOPIC),
        (*GIVEN, *WIDEST, *OWN_PART, _ELSEWHERE, _LOOKS),
        on_fast=(*GIVEN, *WIDEST, *OWN_PART),
    ),
    "a certificate of another CA": WeakRobot(_certificate_of_another_ca, (), joins=True),
    "an enclave of another keystore": WeakRobot(_enclave_of_another_keystore, (), joins=True),
    "permissions of another CA": WeakRobot(_permissions_of_another_ca, (), joins=True),
    "permissions of another enclave": WeakRobot(_permissions_of_another_enclave, (), joins=True),
    "an expired certificate": WeakRobot(_expired, (), joins=True),
    "revocation lists not delivered": WeakRobot(_without_lists, _REVOKED),
    "a revoked enclave put back": WeakRobot(_revoked_and_back, _REVOKED, joins=True),
}
