"""Forged permissions: copied, edited, signed by the wrong one, borrowed, outdated."""

from __future__ import annotations

import re
from dataclasses import replace
from datetime import timedelta

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.permissions import Grant, Permissions, parse_permissions, render_permissions
from sros_tool.demo.bench import (
    GOVERNANCE,
    IDENTITY_CA,
    PERMISSIONS,
    PERMISSIONS_CA,
    Bench,
    Forge,
)
from sros_tool.errors import DocumentError
from sros_tool.keystore.renew import renew
from sros_tool.pki import smime
from sros_tool.pki.certificates import pem
from sros_tool.validity import Window

_DAY = timedelta(days=1)


def _wanted(bench: Bench) -> bytes:
    return bench.wanted("guest", publish=[bench.dds_topic])


def of_another(bench: Bench) -> None:
    """The guest's certificate with the talker's permissions."""
    bench.put("guest", PERMISSIONS, bench.read("talker", PERMISSIONS))


def edited(bench: Bench) -> None:
    """The guest's permissions with one more topic, written into the signed document."""
    signed = bench.read("guest", PERMISSIONS)
    topic = f"<topics>\r\n            <topic>{bench.dds_topic}</topic>".encode()
    edited = re.sub(rb"(<publish>\s*)<topics>", lambda found: found[1] + topic, signed, count=1)
    if edited == signed:
        raise DocumentError(
            "the signed permissions cannot be edited", "They allow to publish nothing."
        )
    bench.put("guest", PERMISSIONS, edited)


def unsigned(bench: Bench) -> None:
    """The guest's permissions with one more topic, as plain XML."""
    bench.put("guest", PERMISSIONS, _wanted(bench))


def signed_by_another_ca(bench: Bench) -> None:
    """The guest's permissions with one more topic, signed by a stranger's CA."""
    bench.put("guest", PERMISSIONS, bench.sign(_wanted(bench), bench.foreign))


def own_permissions_ca(bench: Bench, part: str = "guest") -> None:
    """Everything that the permissions CA signs, by another one, which its own DDS trusts."""
    certificate = bench.authorities(bench.foreign).permissions.certificate
    document = _wanted(bench) if part == "guest" else render_permissions(bench.permissions(part))
    bench.put(part, PERMISSIONS, bench.sign(document, bench.foreign))
    bench.put(part, GOVERNANCE, bench.sign(bench.governance(), bench.foreign))
    bench.put(part, PERMISSIONS_CA, pem(certificate))


def trusted_by_the_listener_too(bench: Bench) -> None:
    """The listener trusts the stranger's permissions CA as well."""
    for part in ("guest", "listener"):
        own_permissions_ca(bench, part)


def signed_by_itself(bench: Bench) -> None:
    """The guest's permissions with one more topic, signed with the guest's own key."""
    signed = smime.sign(_wanted(bench), bench.certificate("guest"), bench.key("guest"))
    bench.put("guest", PERMISSIONS, signed)


def signed_by_itself_and_trusting_itself(bench: Bench) -> None:
    """Its own DDS then has nothing against it; its peers decide.

    Its certificate ends at the identity CA, for vendors that follow a chain, and is itself in the
    file, for those that ask for the signer alone.
    """
    certificate, key = bench.certificate("guest"), bench.key("guest")
    governance = bench.governance()
    signed_by_itself(bench)
    bench.put("guest", GOVERNANCE, smime.sign(governance, certificate, key))
    bench.put("guest", PERMISSIONS_CA, bench.read("guest", IDENTITY_CA) + pem(certificate))


def trusted_as_signer(bench: Bench) -> None:
    """As `signed_by_itself`, and guest and listener have its certificate among the signers."""
    signed_by_itself(bench)
    trusted = bench.read("guest", PERMISSIONS_CA) + pem(bench.certificate("guest"))
    for part in ("guest", "listener"):
        bench.put(part, PERMISSIONS_CA, trusted)


def borrowed(bench: Bench) -> None:
    """The guest's certificate with the permissions of an enclave whose name contains its own."""
    bench.put("guest", PERMISSIONS, bench.read("admin", PERMISSIONS))


def borrowed_with_the_subject(bench: Bench) -> None:
    """As `borrowed`, and the CA gave both enclaves certificates of one subject."""
    borrowed(bench)
    bench.reissue("guest", Window(bench.now - _DAY, bench.now + _DAY), subject_of="admin")


def signed_by_the_ca(bench: Bench) -> None:
    """The guest's permissions with one more topic, signed by the CA, as they once were."""
    bench.put("guest", PERMISSIONS, bench.sign(_wanted(bench)))


def old_permissions_after_renewal(bench: Bench) -> None:
    """The guest was renewed, and its permissions from before are put back."""
    old = bench.sign(_wanted(bench))
    renew(bench.root, [bench.cast["guest"]], now=bench.now, keyring=bench.keyring)
    bench.put("guest", PERMISSIONS, old)


def for_another_domain(bench: Bench) -> None:
    """The guest's permissions with one more topic, signed by the CA for another domain."""
    document = bench.wanted("guest", publish=[bench.dds_topic])
    permissions = Permissions(_only_elsewhere(document, bench.domain))
    bench.put("guest", PERMISSIONS, bench.sign(render_permissions(permissions)))


def _only_elsewhere(document: bytes, domain: int) -> tuple[Grant, ...]:
    elsewhere = DomainSet.of((0, 0) if domain else (1, 1))
    return tuple(
        replace(grant, rules=tuple(replace(rule, domains=elsewhere) for rule in grant.rules))
        for grant in parse_permissions(document).grants
    )


def file_missing(bench: Bench) -> None:
    """The talker without its permissions."""
    (bench.folder("talker") / PERMISSIONS).unlink()


def every_topic(part: str) -> Forge:
    """Permissions with a wildcard, as ros2/sros2 gives them to an enclave without a policy."""

    def forge(bench: Bench) -> None:
        wide = bench.wanted(part, publish=["*"], subscribe=["*"])
        bench.put(part, PERMISSIONS, bench.sign(wide))

    return forge
