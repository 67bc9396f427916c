"""The workbench of a forger: a copy of a keystore, and the moves that forgeries are made of.

Each works on a copy of a keystore.  Those of `FORGERIES` leave the defences of the keystore as
they are; those of `REMOVALS` take one away, and show that the attack works then.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path

from cryptography import x509

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import (
    DomainRule,
    Governance,
    TopicRule,
    parse_governance,
    render_governance,
    settings,
)
from sros_tool.dds.permissions import (
    Criteria,
    Grant,
    Permissions,
    Rule,
    parse_permissions,
    render_permissions,
)
from sros_tool.errors import DocumentError, UnavailableError
from sros_tool.keystore.authorities.authority import Authorities, load_authorities
from sros_tool.keystore.authorities.keyring import IN_KEYSTORE, Keyring
from sros_tool.keystore.layout import CRL, REQUIRED_FILES, enclave_path
from sros_tool.keystore.lifecycle.renew import renew
from sros_tool.keystore.lifecycle.revoke import revoke
from sros_tool.keystore.reader import load_settings
from sros_tool.keystore.template import EVERYTHING, Template
from sros_tool.pki import smime
from sros_tool.pki.certificates import load_certificate, pem, validity_of
from sros_tool.pki.keys import PrivateKey, generate_key, key_pem, load_key
from sros_tool.policy.protection import Level, TopicProtection
from sros_tool.validity import Window

PERMISSIONS, GOVERNANCE = "permissions.p7s", "governance.p7s"
CERTIFICATE, KEY = "cert.pem", "key.pem"
PERMISSIONS_CA, IDENTITY_CA = "permissions_ca.cert.pem", "identity_ca.cert.pem"


@dataclass(frozen=True)
class Bench:
    """``root`` is the copy that is worked on, ``foreign`` another keystore with the same names.

    ``cast`` has the enclave of each part; ``topic`` is the ROS topic that attackers are after,
    ``domain`` one of the keystore's; ``keyring`` says where the keys of the copy's CAs are.
    """

    root: Path
    foreign: Path
    cast: Mapping[str, str]
    topic: str
    domain: int
    now: datetime
    keyring: Keyring = IN_KEYSTORE

    def folder(self, part: str) -> Path:
        """The folder of the enclave that plays a part.  Raises `KeyError`."""
        return enclave_path(self.root, self.cast[part])

    def authorities(self, root: Path | None = None) -> Authorities:
        """The CAs, with their keys, of the copy or of another keystore.

        Raises `SrosError` where the keys are not there.
        """
        keyring = IN_KEYSTORE if root else self.keyring
        root = root or self.root
        return load_authorities(root, load_settings(root), keyring, self.now)

    def put(self, part: str, name: str, data: bytes) -> None:
        """Replace a file of an enclave; a link is replaced, not followed."""
        file = self.folder(part) / name
        file.unlink(missing_ok=True)
        file.touch(0o600)
        file.write_bytes(data)

    def read(self, part: str, name: str) -> bytes:
        """A file of an enclave."""
        return (self.folder(part) / name).read_bytes()

    def certificate(self, part: str) -> x509.Certificate:
        """The certificate of an enclave."""
        return load_certificate(self.read(part, CERTIFICATE), self.cast[part])

    def key(self, part: str) -> PrivateKey:
        """The key of an enclave."""
        return load_key(self.read(part, KEY), self.cast[part])

    def permissions(self, part: str) -> Permissions:
        """What the permissions of an enclave say."""
        return parse_permissions(smime.parse(self.read(part, PERMISSIONS)).document)

    def governance(self) -> bytes:
        """The signed governance of the keystore, as XML."""
        part = next(iter(self.cast))
        return smime.parse(self.read(part, GOVERNANCE)).document

    def wanted(
        self, part: str, publish: Sequence[str] = (), subscribe: Sequence[str] = ()
    ) -> bytes:
        """The permissions of an enclave with more DDS topics in its first allow rule, as XML."""
        permissions = self.permissions(part)
        grant = permissions.grants[0]
        place = next(place for place, rule in enumerate(grant.rules) if rule.allow)
        rules = list(grant.rules)
        rules[place] = _with(rules[place], publish, subscribe)
        grants = (replace(grant, rules=tuple(rules)), *permissions.grants[1:])
        return render_permissions(Permissions(grants))

    def sign(self, document: bytes, root: Path | None = None) -> bytes:
        """A document signed by the permissions CA of this keystore, or of another one."""
        authority = self.authorities(root).permissions
        return smime.sign(document, authority.certificate, authority.key)

    def reissue(
        self, part: str, validity: Window, *, new_key: bool = False, subject_of: str = ""
    ) -> None:
        """Give an enclave another certificate, and perhaps a new key.

        Its subject stays, or becomes that of the part ``subject_of``.
        """
        subject = self.certificate(subject_of or part).subject
        key = generate_key() if new_key else self.key(part)
        issuer = self.authorities().identity.issuer()
        self.put(part, CERTIFICATE, pem(issuer.issue(subject, key.public_key(), validity)))
        if new_key:
            self.put(part, KEY, key_pem(key))

    @property
    def dds_topic(self) -> str:
        """The DDS name of the topic that attackers are after."""
        return f"rt{self.topic}"


Forge = Callable[[Bench], None]
"""Turns the copy on the bench into what an attacker would use."""


def copy_keystore(source: Path, target: Path) -> None:
    """A copy with its links as they are."""
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copytree(source, target, symlinks=True)


def _with(rule: Rule, publish: Sequence[str], subscribe: Sequence[str]) -> Rule:
    return replace(
        rule,
        publish=_more(rule.publish, publish),
        subscribe=_more(rule.subscribe, subscribe),
    )


def _more(criteria: tuple[Criteria, ...], topics: Sequence[str]) -> tuple[Criteria, ...]:
    if not topics:
        return criteria
    if not criteria:
        return (Criteria(tuple(topics)),)
    first = criteria[0]
    return (replace(first, topics=(*first.topics, *topics)), *criteria[1:])


def _weak(bench: Bench) -> bytes:
    """A governance that lets everybody in and protects nothing."""
    governance = parse_governance(bench.governance())
    return render_governance(
        Governance(
            tuple(
                replace(
                    rule,
                    **settings(DomainRule, protect=False),
                    topic_access_rules=tuple(
                        replace(topic, **settings(TopicRule, protect=False))
                        for topic in rule.topic_access_rules
                    ),
                )
                for rule in governance.domain_access_rules
            )
        )
    )


def governance_edited(bench: Bench) -> None:
    """As `_weak`, written over the signed document."""
    signed = bench.read("listener", GOVERNANCE)
    kept = bench.governance().replace(b"\r\n", b"\n")
    # The comment changes also what is as weak already.
    weak = _weak(bench) + b"<!-- edited -->\n"
    edited = signed.replace(kept.replace(b"\n", b"\r\n"), weak.replace(b"\n", b"\r\n"))
    if edited == signed:
        raise DocumentError("the signed governance cannot be edited", "Its XML is not found in it.")
    bench.put("listener", GOVERNANCE, edited)


def governance_of_another_ca(bench: Bench) -> None:
    """A weak governance for the listener, signed by a stranger's CA."""
    bench.put("listener", GOVERNANCE, bench.sign(_weak(bench), bench.foreign))


def weaker_governance(bench: Bench) -> None:
    """A weak governance for talker and listener, signed by the CA, as it once was."""
    signed = bench.sign(_weak(bench))
    for part in ("talker", "listener"):
        bench.put(part, GOVERNANCE, signed)


_FORGED_PERMISSIONS_DAY = timedelta(days=1)


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
    bench.reissue(
        "guest",
        Window(bench.now - _FORGED_PERMISSIONS_DAY, bench.now + _FORGED_PERMISSIONS_DAY),
        subject_of="admin",
    )


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


_NOBODY = 65534
_DAY, _MINUTE = timedelta(days=1), timedelta(minutes=1)
STOLEN = "/stolen"
"""Where a copy of an enclave from before its revocation is kept."""


def in_date(bench: Bench) -> None:
    """The talker's certificate issued anew, from yesterday to tomorrow."""
    bench.reissue("talker", Window(bench.now - _DAY, bench.now + _DAY))


def expired(bench: Bench) -> None:
    """An authority issues nothing from before its own time: the first minute that it may."""
    start = validity_of(bench.authorities().identity.certificate).not_before
    bench.reissue("talker", Window(start, start + _MINUTE))


def not_yet_valid(bench: Bench) -> None:
    """The talker's certificate issued anew, from tomorrow on."""
    bench.reissue("talker", Window(bench.now + _DAY, bench.now + 2 * _DAY))


def key_of_another(bench: Bench) -> None:
    """The talker's certificate with the guest's key."""
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


def talker_revoked(bench: Bench) -> None:
    """The talker was revoked, and issued anew."""
    _revoke(bench, "talker")


def guest_revoked(bench: Bench) -> None:
    """The guest was revoked, and issued anew."""
    _revoke(bench, "guest")


def not_delivered_of_the_talker(bench: Bench) -> None:
    """The talker was revoked, and the listener was not told."""
    _revocation_not_delivered(bench, "talker")


def not_delivered_of_the_guest(bench: Bench) -> None:
    """The copy has permissions from before rights were taken away."""
    now = bench.read("guest", PERMISSIONS)
    signed_by_the_ca(bench)
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


def stolen(bench: Bench) -> None:
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


def readable_for_all(bench: Bench) -> None:
    """What a careless copy leaves behind, and what was standard with ros2/sros2."""
    for path in [bench.root, *bench.root.rglob("*")]:
        if not path.is_symlink():
            path.chmod(0o755 if path.is_dir() else 0o644)
    stolen(bench)


@dataclass(frozen=True)
class Removal:
    """A forgery on a keystore whose template was ``weakened`` first."""

    forge: Forge
    weakened: Callable[[Template], Template] = lambda template: template


def _as_it_is(_bench: Bench) -> None:
    pass


def _one_ca(template: Template) -> Template:
    return replace(template, separate_authorities=False)


def _shared_subjects(template: Template) -> Template:
    return replace(template, unique_subject=False)


def _open_default(template: Template) -> Template:
    return replace(template, default_permissions=EVERYTHING)


def protected(level: Level) -> Callable[[Template], Template]:
    """Templates with access control, and with messages protected by that level everywhere.

    A payload is signed with the submessage that it is in: Fast DDS loses payloads that are signed
    by themselves (`governance.signed-payload`).
    """
    discovered = level is not Level.NONE
    payload = level if level is Level.ENCRYPT else Level.NONE

    def change(template: Template) -> Template:
        topics = TopicProtection(payload, level, discovery=discovered, liveliness=discovered)
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
    "expired": expired,
    "not yet valid": not_yet_valid,
    "key of another": key_of_another,
    "talker revoked": talker_revoked,
    "guest revoked": guest_revoked,
    "stolen": stolen,
    "permissions of another": of_another,
    "permissions edited": edited,
    "permissions unsigned": unsigned,
    "permissions of another CA": signed_by_another_ca,
    "own permissions CA": own_permissions_ca,
    "signed by itself": signed_by_itself,
    "signed by itself, own trust": signed_by_itself_and_trusting_itself,
    "borrowed": borrowed,
    "old permissions": signed_by_the_ca,
    "old permissions after renewal": old_permissions_after_renewal,
    "permissions for another domain": for_another_domain,
    "file missing": file_missing,
    "governance edited": governance_edited,
    "governance of another CA": governance_of_another_ca,
    "old governance": weaker_governance,
}

REMOVALS: Mapping[str, Removal] = {
    "made": Removal(_as_it_is),
    "in date": Removal(in_date),
    "revocation not delivered": Removal(not_delivered_of_the_talker),
    "guest's revocation not delivered": Removal(not_delivered_of_the_guest),
    "keys readable for all": Removal(readable_for_all),
    "signed by the CA": Removal(signed_by_the_ca),
    "guest may do everything": Removal(every_topic("guest")),
    "talker may do everything": Removal(every_topic("talker")),
    "listener may do everything": Removal(every_topic("listener")),
    "client may do everything": Removal(every_topic("client")),
    "another CA trusted": Removal(trusted_by_the_listener_too),
    "one CA": Removal(signed_by_itself, _one_ca),
    "trusted as signer": Removal(trusted_as_signer),
    "borrowed with the subject": Removal(borrowed_with_the_subject),
    "borrowed with shared subjects": Removal(borrowed, _shared_subjects),
    "renewed with shared subjects": Removal(old_permissions_after_renewal, _shared_subjects),
    "open default": Removal(_as_it_is, _open_default),
    "in clear": Removal(_as_it_is, in_clear),
    "strangers allowed": Removal(weaker_governance),
    "file missing, permissive": Removal(file_missing),
    "protection none": Removal(_as_it_is, in_clear),
    "protection sign": Removal(_as_it_is, protected(Level.SIGN)),
    "protection encrypt": Removal(_as_it_is, protected(Level.ENCRYPT)),
}
