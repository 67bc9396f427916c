"""What attackers make of files that they have, by name; and what is left when a defence is gone.

Each works on a copy of a keystore.  Those of `FORGERIES` leave the defences of the keystore as
they are; those of `REMOVALS` take one away, and show that the attack works then.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from datetime import timedelta
from pathlib import Path

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import (
    Governance,
    Protection,
    parse_governance,
    render_governance,
)
from sros_tool.dds.permissions import Grant, Permissions, parse_permissions, render_permissions
from sros_tool.demo.bench import (
    GOVERNANCE,
    IDENTITY_CA,
    KEY,
    PERMISSIONS,
    PERMISSIONS_CA,
    Bench,
    Forge,
)
from sros_tool.errors import UnavailableError
from sros_tool.keystore.enclave import enclave_path
from sros_tool.keystore.layout import CRL, REQUIRED_FILES
from sros_tool.keystore.renew import renew
from sros_tool.keystore.revoke import revoke
from sros_tool.keystore.template import EVERYTHING, Template
from sros_tool.pki import smime
from sros_tool.pki.certificates import pem, validity_of
from sros_tool.policy.protection import Level, TopicProtection
from sros_tool.validity import Window

_NOBODY = 65534
_DAY, _MINUTE = timedelta(days=1), timedelta(minutes=1)
STOLEN = "/stolen"
"""Where a copy of an enclave from before its revocation is kept."""


@dataclass(frozen=True)
class Removal:
    """A forgery on a keystore whose template was ``weakened`` first."""

    forge: Forge
    weakened: Callable[[Template], Template] = lambda template: template


# ── identities ─────────────────────────────────────────────────────────────────────────────


def _in_date(bench: Bench) -> None:
    bench.reissue("talker", Window(bench.now - _DAY, bench.now + _DAY))


def _expired(bench: Bench) -> None:
    """An authority issues nothing from before its own time: the first minute that it may."""
    start = validity_of(bench.authorities().identity.certificate).not_before
    bench.reissue("talker", Window(start, start + _MINUTE))


def _not_yet_valid(bench: Bench) -> None:
    bench.reissue("talker", Window(bench.now + _DAY, bench.now + 2 * _DAY))


def _key_of_another(bench: Bench) -> None:
    bench.put("talker", KEY, bench.read("guest", KEY))


def _revoke(bench: Bench, part: str) -> None:
    """Revoke an enclave, and issue it anew for the same subject, as its owner would go on."""
    folder = bench.folder(part)
    before = {name: bench.read(part, name) for name in REQUIRED_FILES}
    revoke(bench.root, [bench.cast[part]], now=bench.now, keyring=bench.keyring)
    folder.mkdir(mode=0o700, exist_ok=True)
    for name, data in before.items():
        bench.put(part, name, data)
    bench.reissue(part, Window(bench.now - _DAY, bench.now + _DAY), new_key=True)
    bench.put(part, "crl.pem", (bench.root / CRL).read_bytes())


def _talker_revoked(bench: Bench) -> None:
    _revoke(bench, "talker")


def _guest_revoked(bench: Bench) -> None:
    _revoke(bench, "guest")


def _not_delivered_of_the_talker(bench: Bench) -> None:
    _revocation_not_delivered(bench, "talker")


def _not_delivered_of_the_guest(bench: Bench) -> None:
    """The copy has permissions from before rights were taken away."""
    now = bench.read("guest", PERMISSIONS)
    _signed_by_the_ca(bench)
    before = bench.read("guest", PERMISSIONS)
    bench.put("guest", PERMISSIONS, now)
    _revocation_not_delivered(bench, "guest")
    (enclave_path(bench.root, STOLEN) / PERMISSIONS).write_bytes(before)


def _revocation_not_delivered(bench: Bench, part: str) -> None:
    before = {name: bench.read(part, name) for name in REQUIRED_FILES}
    _revoke(bench, part)
    copy = enclave_path(bench.root, STOLEN)
    copy.mkdir(mode=0o700)
    for name, data in before.items():
        (copy / name).touch(0o600)
        (copy / name).write_bytes(data)
    (bench.folder("listener") / "crl.pem").unlink()


def _stolen(bench: Bench) -> None:
    """Another user of the machine copies the files that he can read, and no others."""
    if os.geteuid() != 0:
        raise UnavailableError("only root can try it as another user of this machine")
    folder = bench.folder("talker")
    inside = str(folder.relative_to(bench.root))
    names = [file.name for file in folder.iterdir()]
    copied = _read_as_nobody(bench.root, [f"{inside}/{name}" for name in names])
    for name, data in zip(names, copied, strict=True):
        if data is None:
            (folder / name).unlink()
        else:
            bench.put("talker", name, data)


def _read_as_nobody(root: Path, files: list[str]) -> list[bytes | None]:
    """What a user without any rights can read below a folder, by the modes that lie below it."""
    kept: list[bytes | None] = []
    place = os.open(root, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        for file in files:
            read_end, write_end = os.pipe()
            child = os.fork()
            if child == 0:
                status = 1
                try:
                    os.setgroups([])
                    os.setgid(_NOBODY)
                    os.setuid(_NOBODY)
                    descriptor = os.open(file, os.O_RDONLY, dir_fd=place)
                    with os.fdopen(write_end, "wb") as answer:
                        answer.write(os.read(descriptor, 1 << 20))
                    status = 0
                finally:
                    os._exit(status)
            os.close(write_end)
            with os.fdopen(read_end, "rb") as answer_of_child:
                data = answer_of_child.read()
            _, ended = os.waitpid(child, 0)
            kept.append(data if ended == 0 else None)
    finally:
        os.close(place)
    return kept


def _readable_for_all(bench: Bench) -> None:
    """What a careless copy leaves behind, and what was standard with ros2/sros2."""
    for path in [bench.root, *bench.root.rglob("*")]:
        if not path.is_symlink():
            path.chmod(0o755 if path.is_dir() else 0o644)
    _stolen(bench)


# ── permissions ────────────────────────────────────────────────────────────────────────────


def _wanted(bench: Bench) -> bytes:
    return bench.wanted("guest", publish=[bench.dds_topic])


def _of_another(bench: Bench) -> None:
    bench.put("guest", PERMISSIONS, bench.read("talker", PERMISSIONS))


def _edited(bench: Bench) -> None:
    signed = bench.read("guest", PERMISSIONS)
    topic = f"<topics>\r\n            <topic>{bench.dds_topic}</topic>".encode()
    edited = re.sub(rb"(<publish>\s*)<topics>", lambda found: found[1] + topic, signed, count=1)
    assert edited != signed
    bench.put("guest", PERMISSIONS, edited)


def _unsigned(bench: Bench) -> None:
    bench.put("guest", PERMISSIONS, _wanted(bench))


def _signed_by_another_ca(bench: Bench) -> None:
    bench.put("guest", PERMISSIONS, bench.sign(_wanted(bench), bench.foreign))


def _own_permissions_ca(bench: Bench, part: str = "guest") -> None:
    """Everything that the permissions CA signs, by another one, which its own DDS trusts."""
    certificate = bench.authorities(bench.foreign).permissions.certificate
    document = _wanted(bench) if part == "guest" else render_permissions(bench.permissions(part))
    bench.put(part, PERMISSIONS, bench.sign(document, bench.foreign))
    bench.put(part, GOVERNANCE, bench.sign(bench.governance(), bench.foreign))
    bench.put(part, PERMISSIONS_CA, pem(certificate))


def _trusted_by_the_listener_too(bench: Bench) -> None:
    for part in ("guest", "listener"):
        _own_permissions_ca(bench, part)


def _signed_by_itself(bench: Bench) -> None:
    signed = smime.sign(_wanted(bench), bench.certificate("guest"), bench.key("guest"))
    bench.put("guest", PERMISSIONS, signed)


def _signed_by_itself_and_trusting_the_identity_ca(bench: Bench) -> None:
    """Its own DDS then has nothing against it; its peers decide."""
    certificate, key = bench.certificate("guest"), bench.key("guest")
    governance = bench.governance()
    _signed_by_itself(bench)
    bench.put("guest", GOVERNANCE, smime.sign(governance, certificate, key))
    bench.put("guest", PERMISSIONS_CA, bench.read("guest", IDENTITY_CA))


def _borrowed(bench: Bench) -> None:
    bench.put("guest", PERMISSIONS, bench.read("admin", PERMISSIONS))


def _signed_by_the_ca(bench: Bench) -> None:
    bench.put("guest", PERMISSIONS, bench.sign(_wanted(bench)))


def _old_permissions_after_renewal(bench: Bench) -> None:
    old = bench.sign(_wanted(bench))
    renew(bench.root, [bench.cast["guest"]], now=bench.now, keyring=bench.keyring)
    bench.put("guest", PERMISSIONS, old)


def _for_another_domain(bench: Bench) -> None:
    document = bench.wanted("guest", publish=[bench.dds_topic])
    permissions = Permissions(_only_elsewhere(document, bench.domain))
    bench.put("guest", PERMISSIONS, bench.sign(render_permissions(permissions)))


def _only_elsewhere(document: bytes, domain: int) -> tuple[Grant, ...]:
    elsewhere = DomainSet.of((0, 0) if domain else (1, 1))
    return tuple(
        replace(grant, rules=tuple(replace(rule, domains=elsewhere) for rule in grant.rules))
        for grant in parse_permissions(document).grants
    )


def _file_missing(bench: Bench) -> None:
    (bench.folder("talker") / PERMISSIONS).unlink()


def _every_topic(part: str) -> Forge:
    """Permissions with a wildcard, as ros2/sros2 gives them to an enclave without a policy."""

    def forge(bench: Bench) -> None:
        wide = bench.wanted(part, publish=["*"], subscribe=["*"])
        bench.put(part, PERMISSIONS, bench.sign(wide))

    return forge


# ── governance ─────────────────────────────────────────────────────────────────────────────


def _weak(bench: Bench) -> bytes:
    """A governance that lets everybody in and protects nothing."""
    governance = parse_governance(bench.governance())
    return render_governance(
        Governance(
            tuple(
                replace(
                    rule,
                    allow_unauthenticated_participants=True,
                    enable_join_access_control=False,
                    discovery_protection_kind=Protection.NONE,
                    liveliness_protection_kind=Protection.NONE,
                    rtps_protection_kind=Protection.NONE,
                    topic_access_rules=tuple(
                        replace(
                            topic,
                            enable_discovery_protection=False,
                            enable_liveliness_protection=False,
                            enable_read_access_control=False,
                            enable_write_access_control=False,
                            metadata_protection_kind=Protection.NONE,
                            data_protection_kind=Protection.NONE,
                        )
                        for topic in rule.topic_access_rules
                    ),
                )
                for rule in governance.domain_access_rules
            )
        )
    )


def _governance_edited(bench: Bench) -> None:
    """As `_weak`, written over the signed document."""
    signed = bench.read("listener", GOVERNANCE)
    kept = bench.governance().replace(b"\r\n", b"\n")
    crlf, weak = (text.replace(b"\n", b"\r\n") for text in (kept, _weak(bench)))
    edited = signed.replace(crlf, weak)
    assert edited != signed
    bench.put("listener", GOVERNANCE, edited)


def _governance_of_another_ca(bench: Bench) -> None:
    bench.put("listener", GOVERNANCE, bench.sign(_weak(bench), bench.foreign))


def _weaker_governance(bench: Bench) -> None:
    signed = bench.sign(_weak(bench))
    for part in ("talker", "listener"):
        bench.put(part, GOVERNANCE, signed)


# ── templates ──────────────────────────────────────────────────────────────────────────────


def _as_it_is(_bench: Bench) -> None:
    pass


def _one_ca(template: Template) -> Template:
    return replace(template, separate_authorities=False)


def _shared_subjects(template: Template) -> Template:
    return replace(template, unique_subject=False)


def _open_default(template: Template) -> Template:
    return replace(template, default_permissions=EVERYTHING)


def protected(level: Level) -> Callable[[Template], Template]:
    """Templates with access control, and with messages protected by that level everywhere."""
    discovered = level is not Level.NONE

    def change(template: Template) -> Template:
        topics = TopicProtection(level, level, discovery=discovered, liveliness=discovered)
        protection = replace(
            template.protection,
            rtps=level,
            discovery=level,
            liveliness=level,
            default=topics,
            named=(),
        )
        return replace(template, protection=protection)

    return change


in_clear = protected(Level.NONE)


FORGERIES: Mapping[str, Forge] = {
    "expired": _expired,
    "not yet valid": _not_yet_valid,
    "key of another": _key_of_another,
    "talker revoked": _talker_revoked,
    "guest revoked": _guest_revoked,
    "stolen": _stolen,
    "permissions of another": _of_another,
    "permissions edited": _edited,
    "permissions unsigned": _unsigned,
    "permissions of another CA": _signed_by_another_ca,
    "own permissions CA": _own_permissions_ca,
    "signed by itself": _signed_by_itself,
    "signed by itself, own trust": _signed_by_itself_and_trusting_the_identity_ca,
    "borrowed": _borrowed,
    "old permissions": _signed_by_the_ca,
    "old permissions after renewal": _old_permissions_after_renewal,
    "permissions for another domain": _for_another_domain,
    "file missing": _file_missing,
    "governance edited": _governance_edited,
    "governance of another CA": _governance_of_another_ca,
    "old governance": _weaker_governance,
}

REMOVALS: Mapping[str, Removal] = {
    "made": Removal(_as_it_is),
    "in date": Removal(_in_date),
    "revocation not delivered": Removal(_not_delivered_of_the_talker),
    "guest's revocation not delivered": Removal(_not_delivered_of_the_guest),
    "keys readable for all": Removal(_readable_for_all),
    "signed by the CA": Removal(_signed_by_the_ca),
    "guest may do everything": Removal(_every_topic("guest")),
    "talker may do everything": Removal(_every_topic("talker")),
    "listener may do everything": Removal(_every_topic("listener")),
    "client may do everything": Removal(_every_topic("client")),
    "another CA trusted": Removal(_trusted_by_the_listener_too),
    "one CA": Removal(_signed_by_itself, _one_ca),
    "borrowed with shared subjects": Removal(_borrowed, _shared_subjects),
    "renewed with shared subjects": Removal(_old_permissions_after_renewal, _shared_subjects),
    "open default": Removal(_as_it_is, _open_default),
    "in clear": Removal(_as_it_is, in_clear),
    "strangers allowed": Removal(_weaker_governance),
    "file missing, permissive": Removal(_file_missing),
    "protection none": Removal(_as_it_is, in_clear),
    "protection sign": Removal(_as_it_is, protected(Level.SIGN)),
    "protection encrypt": Removal(_as_it_is, protected(Level.ENCRYPT)),
}
