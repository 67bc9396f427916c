"""Forgeries: change a keystore as an attacker would, or remove a defense.

Rows of scenarios refer to these functions. A row that names only a function applies it to a copy of
the keystore, with all defenses in place. A row that names an `Undefended` applies its function to a
new keystore without one of the defenses, to show that the attack works there.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import NamedTuple

from cryptography import x509

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import (
    DomainRule,
    Governance,
    TopicRule,
    attribute_values,
    parse_governance,
    render_governance,
)
from sros_tool.dds.permissions import (
    Criteria,
    Grant,
    Permissions,
    Rule,
    parse_permissions,
    render_permissions,
)
from sros_tool.errors import DocumentError, KeystoreError, UnavailableError
from sros_tool.keystore.issuing.authority import Authorities, load_authorities
from sros_tool.keystore.issuing.keyring import IN_KEYSTORE, Keyring
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    CRL,
    CRL_FILE,
    GOVERNANCE_FILE,
    IDENTITY_CA_FILE,
    KEY_FILE,
    PERMISSIONS_CA_FILE,
    PERMISSIONS_FILE,
    REQUIRED_FILES,
    enclave_path,
)
from sros_tool.keystore.lifecycle.renew import renew
from sros_tool.keystore.lifecycle.revoke import revoke
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.template import EVERYTHING, Template
from sros_tool.pki import smime
from sros_tool.pki.certificates import load_certificate, pem, validity_of
from sros_tool.pki.keys import PrivateKey, generate_key, key_pem, load_key
from sros_tool.policy.model import Level, TopicProtection
from sros_tool.validity import Window

_DAY, _MINUTE = timedelta(days=1), timedelta(minutes=1)
_NOBODY_USER_ID = 65534

STOLEN = "/stolen"
"""Name of the copy of a revoked enclave, made before its revocation."""


@dataclass(frozen=True)
class KeystoreCopy:
    """A keystore to forge; ``foreign`` is another keystore with the same enclaves.

    ``cast`` maps each part, such as "talker", to the enclave that plays the part; ``topic`` is the
    attacked ROS topic, ``domain`` a domain of the keystore; ``keyring`` finds the keys of the
    keystore's CAs.  ``router`` is the enclave of the Zenoh router ("": none), which listens at
    ``endpoint``.
    """

    root: Path
    foreign: Path
    cast: Mapping[str, str]
    topic: str
    domain: int
    now: datetime
    keyring: Keyring = IN_KEYSTORE
    router: str = ""
    endpoint: str = ""

    @property
    def dds_topic(self) -> str:
        """The DDS name of the attacked topic."""
        return f"rt{self.topic}"

    def enclave(self, part: str) -> str:
        """Return the path of the enclave that plays a part.

        Raises:
            KeystoreError: no enclave plays the part.
        """
        if part not in self.cast:
            raise UncastError(part)
        return self.cast[part]

    def folder(self, part: str) -> Path:
        """Return the folder of the enclave that plays a part."""
        return enclave_path(self.root, self.enclave(part))

    def authorities(self, root: Path | None = None) -> Authorities:
        """Return the CAs of this keystore, or of the keystore ``root``, with their keys.

        Raises:
            SrosError: a key of a CA cannot be loaded.
        """
        keyring = IN_KEYSTORE if root else self.keyring
        root = root or self.root
        keystore = OpenedKeystore(root)
        return load_authorities(keystore, keystore.template, keyring, self.now)

    def put(self, part: str, name: str, data: bytes) -> None:
        """Replace the file ``name`` of the enclave that plays a part; a link is not followed."""
        file = self.folder(part) / name
        file.unlink(missing_ok=True)
        file.touch(0o600)
        file.write_bytes(data)

    def read(self, part: str, name: str) -> bytes:
        """Return the content of the file ``name`` of the enclave that plays a part."""
        return (self.folder(part) / name).read_bytes()

    def certificate(self, part: str) -> x509.Certificate:
        """Return the certificate of the enclave that plays a part."""
        return load_certificate(self.read(part, CERTIFICATE_FILE), self.enclave(part))

    def key(self, part: str) -> PrivateKey:
        """Return the private key of the enclave that plays a part."""
        return load_key(self.read(part, KEY_FILE), self.enclave(part))

    def permissions(self, part: str) -> Permissions:
        """Return the permissions of the enclave that plays a part, with any signature."""
        return parse_permissions(smime.parse(self.read(part, PERMISSIONS_FILE)).document)

    def governance(self) -> bytes:
        """Return the signed governance of the keystore, as XML."""
        part = next(iter(self.cast))
        return smime.parse(self.read(part, GOVERNANCE_FILE)).document

    def widened_permissions(
        self, part: str, publish: Sequence[str] = (), subscribe: Sequence[str] = ()
    ) -> bytes:
        """Return an enclave's permissions as XML, with more DDS topics in the first allow rule."""
        permissions = self.permissions(part)
        grant = permissions.grants[0]
        place = next((place for place, rule in enumerate(grant.rules) if rule.allow), None)
        if place is None:
            raise DocumentError(
                f"the permissions of {self.enclave(part)} cannot be widened",
                "They have no rule that allows anything.",
            )
        rules = list(grant.rules)
        rules[place] = _with_topics(rules[place], publish, subscribe)
        grants = (grant._replace(rules=tuple(rules)), *permissions.grants[1:])
        return render_permissions(Permissions(grants))

    def sign(self, document: bytes, root: Path | None = None) -> bytes:
        """Sign a document with the permissions CA of this keystore, or of the keystore ``root``."""
        authority = self.authorities(root).permissions
        return smime.sign(document, authority.certificate, authority.key)

    def reissue(
        self, part: str, validity: Window, *, new_key: bool = False, subject_of: str = ""
    ) -> None:
        """Issue another certificate for the enclave that plays a part, and perhaps a new key.

        The subject stays the same, or becomes the subject of the part ``subject_of``.
        """
        subject = self.certificate(subject_of or part).subject
        key = generate_key() if new_key else self.key(part)
        issuer = self.authorities().identity.issuer()
        self.put(part, CERTIFICATE_FILE, pem(issuer.issue(subject, key.public_key(), validity)))
        if new_key:
            self.put(part, KEY_FILE, key_pem(key))


class UncastError(KeystoreError):
    """Raised if the keystore has no enclave for a part of the row."""

    def __init__(self, part: str) -> None:
        needed = _NEEDED_ENCLAVES.get(part, f"an enclave for the {part}")
        super().__init__("no enclave of the keystore fits this row", f"The row needs {needed}.")


_SERVICE_OF_TWO = (
    "an enclave that offers a service that not every node has, and another enclave that may call"
    " this service"
)
_NEEDED_ENCLAVES = {
    "guest": "a third enclave, next to the enclaves of the talker and the listener",
    "admin": "two more enclaves, such as /arm and /arm/tool: the first may not publish the topic,"
    " and the second may; the second path has all parts of the first",
    "server": _SERVICE_OF_TWO,
    "client": _SERVICE_OF_TWO,
    "newcomer": "an enclave without a policy, which only the demo's own keystores have",
}
"""Part → the enclave that a keystore needs, if no enclave fits the part."""


Forge = Callable[[KeystoreCopy], None]
"""A function that changes a keystore as an attacker would."""


def _forge_nothing(_copy: KeystoreCopy) -> None:
    """Leave the keystore unchanged."""


def _same_template(template: Template) -> Template:
    """Return the template unchanged."""
    return template


class Undefended(NamedTuple):
    """A forgery in a new keystore that lacks a defense, because its template is changed first."""

    forge: Forge = _forge_nothing
    template: Callable[[Template], Template] = _same_template


def folder_name_of(forgery: Forge | Undefended) -> str:
    """Return the folder name for a forgery's keystore, unique among forgeries."""
    if isinstance(forgery, Undefended):
        return f"undefended_{forgery.template.__name__}_{forgery.forge.__name__}"
    return forgery.__name__


def _with_topics(rule: Rule, publish: Sequence[str], subscribe: Sequence[str]) -> Rule:
    return rule._replace(
        publish=_widened_criteria(rule.publish, publish),
        subscribe=_widened_criteria(rule.subscribe, subscribe),
    )


def _widened_criteria(
    criteria: tuple[Criteria, ...], topics: Sequence[str]
) -> tuple[Criteria, ...]:
    if not topics:
        return criteria
    if not criteria:
        return (Criteria(tuple(topics)),)
    first = criteria[0]
    return (first._replace(topics=(*first.topics, *topics)), *criteria[1:])


def _weak_governance(copy: KeystoreCopy) -> bytes:
    """Return a governance, as XML, that admits every participant and protects nothing."""
    governance = parse_governance(copy.governance())
    return render_governance(
        Governance(
            tuple(
                replace(
                    rule,
                    **attribute_values(DomainRule, protect=False),
                    topic_access_rules=tuple(
                        replace(topic, **attribute_values(TopicRule, protect=False))
                        for topic in rule.topic_access_rules
                    ),
                )
                for rule in governance.domain_access_rules
            )
        )
    )


def edited_governance(copy: KeystoreCopy) -> None:
    """Replace the XML inside the listener's signed governance by a weak governance."""
    signed = copy.read("listener", GOVERNANCE_FILE)
    kept = copy.governance().replace(b"\r\n", b"\n")
    # The comment ensures a difference, even if the governance was already as weak.
    weak = _weak_governance(copy) + b"<!-- edited -->\n"
    edited = signed.replace(kept.replace(b"\n", b"\r\n"), weak.replace(b"\n", b"\r\n"))
    if edited == signed:
        raise DocumentError(
            "the signed governance cannot be edited", "Its XML was not found in the signed message."
        )
    copy.put("listener", GOVERNANCE_FILE, edited)


def governance_of_another_ca(copy: KeystoreCopy) -> None:
    """Give the listener a weak governance, signed by another CA."""
    copy.put("listener", GOVERNANCE_FILE, copy.sign(_weak_governance(copy), copy.foreign))


def weaker_governance(copy: KeystoreCopy) -> None:
    """Give talker and listener a weak governance signed by the CA, like an old document."""
    signed = copy.sign(_weak_governance(copy))
    for part in ("talker", "listener"):
        copy.put(part, GOVERNANCE_FILE, signed)


def _wider_permissions(copy: KeystoreCopy) -> bytes:
    """Return the guest's permissions with the right to publish the topic, as XML."""
    return copy.widened_permissions("guest", publish=[copy.dds_topic])


def permissions_of_another(copy: KeystoreCopy) -> None:
    """Give the guest the talker's permissions."""
    copy.put("guest", PERMISSIONS_FILE, copy.read("talker", PERMISSIONS_FILE))


def edited_permissions(copy: KeystoreCopy) -> None:
    """Write one more topic into the guest's signed permissions."""
    signed = copy.read("guest", PERMISSIONS_FILE)
    topic = f"<topics>\r\n            <topic>{copy.dds_topic}</topic>".encode()
    edited = re.sub(rb"(<publish>\s*)<topics>", lambda match: match[1] + topic, signed, count=1)
    if edited == signed:
        raise DocumentError(
            "the signed permissions cannot be edited", "They do not allow publishing anything."
        )
    copy.put("guest", PERMISSIONS_FILE, edited)


def unsigned_permissions(copy: KeystoreCopy) -> None:
    """Give the guest permissions with one more topic, as plain XML."""
    copy.put("guest", PERMISSIONS_FILE, _wider_permissions(copy))


def permissions_of_another_ca(copy: KeystoreCopy) -> None:
    """Give the guest permissions with one more topic, signed by another CA."""
    copy.put("guest", PERMISSIONS_FILE, copy.sign(_wider_permissions(copy), copy.foreign))


def own_permissions_ca(copy: KeystoreCopy) -> None:
    """Sign the guest's documents with another permissions CA, which only the guest trusts."""
    _trust_another_permissions_ca(copy, "guest")


def another_permissions_ca_trusted(copy: KeystoreCopy) -> None:
    """Make both guest and listener trust another permissions CA, which signs their documents."""
    for part in ("guest", "listener"):
        _trust_another_permissions_ca(copy, part)


def _trust_another_permissions_ca(copy: KeystoreCopy, part: str) -> None:
    """Let the enclave that plays ``part`` trust another permissions CA, which signs its files."""
    certificate = copy.authorities(copy.foreign).permissions.certificate
    document = (
        _wider_permissions(copy) if part == "guest" else render_permissions(copy.permissions(part))
    )
    copy.put(part, PERMISSIONS_FILE, copy.sign(document, copy.foreign))
    copy.put(part, GOVERNANCE_FILE, copy.sign(copy.governance(), copy.foreign))
    copy.put(part, PERMISSIONS_CA_FILE, pem(certificate))


def permissions_signed_by_itself(copy: KeystoreCopy) -> None:
    """Give the guest permissions with one more topic, signed with the guest's key."""
    signed = smime.sign(_wider_permissions(copy), copy.certificate("guest"), copy.key("guest"))
    copy.put("guest", PERMISSIONS_FILE, signed)


def permissions_and_governance_signed_by_itself(copy: KeystoreCopy) -> None:
    """Sign permissions and governance with the guest's key, so that the guest's DDS accepts them.

    The guest's permissions CA file gets the identity CA, for vendors that check a chain, and the
    guest's certificate, for vendors that check only the signer.
    """
    certificate, key = copy.certificate("guest"), copy.key("guest")
    governance = copy.governance()
    permissions_signed_by_itself(copy)
    copy.put("guest", GOVERNANCE_FILE, smime.sign(governance, certificate, key))
    copy.put("guest", PERMISSIONS_CA_FILE, copy.read("guest", IDENTITY_CA_FILE) + pem(certificate))


def enclave_among_the_signers(copy: KeystoreCopy) -> None:
    """Sign permissions with the guest's key; guest and listener trust the guest's certificate."""
    permissions_signed_by_itself(copy)
    trusted = copy.read("guest", PERMISSIONS_CA_FILE) + pem(copy.certificate("guest"))
    for part in ("guest", "listener"):
        copy.put(part, PERMISSIONS_CA_FILE, trusted)


def borrowed_permissions(copy: KeystoreCopy) -> None:
    """Give the guest the permissions of the admin, whose name contains the guest's name."""
    copy.put("guest", PERMISSIONS_FILE, copy.read("admin", PERMISSIONS_FILE))


def borrowed_permissions_and_subject(copy: KeystoreCopy) -> None:
    """Give the guest the admin's permissions, and a new certificate with the admin's subject."""
    borrowed_permissions(copy)
    validity = Window(copy.now - _DAY, copy.now + _DAY)
    copy.reissue("guest", validity, subject_of="admin")


def permissions_signed_by_the_ca(copy: KeystoreCopy) -> None:
    """Give the guest permissions with one more topic, signed by the CA, like an old document."""
    copy.put("guest", PERMISSIONS_FILE, copy.sign(_wider_permissions(copy)))


def old_permissions_after_renewal(copy: KeystoreCopy) -> None:
    """Renew the guest, then restore its earlier permissions."""
    old = copy.sign(_wider_permissions(copy))
    renew(copy.root, [copy.enclave("guest")], now=copy.now, keyring=copy.keyring)
    copy.put("guest", PERMISSIONS_FILE, old)


def permissions_for_another_domain(copy: KeystoreCopy) -> None:
    """Give the guest permissions with one more topic but for another domain, signed by the CA."""
    permissions = Permissions(_for_another_domain(_wider_permissions(copy), copy.domain))
    copy.put("guest", PERMISSIONS_FILE, copy.sign(render_permissions(permissions)))


def _for_another_domain(document: bytes, domain: int) -> tuple[Grant, ...]:
    elsewhere = DomainSet.of((0, 0) if domain else (1, 1))
    return tuple(
        grant._replace(rules=tuple(rule._replace(domains=elsewhere) for rule in grant.rules))
        for grant in parse_permissions(document).grants
    )


def missing_permissions(copy: KeystoreCopy) -> None:
    """Remove the talker's permissions."""
    (copy.folder("talker") / PERMISSIONS_FILE).unlink()


def guest_may_do_everything(copy: KeystoreCopy) -> None:
    """Give the guest permissions with a wildcard."""
    _allow_everything(copy, "guest")


def talker_may_do_everything(copy: KeystoreCopy) -> None:
    """Give the talker permissions with a wildcard."""
    _allow_everything(copy, "talker")


def listener_may_do_everything(copy: KeystoreCopy) -> None:
    """Give the listener permissions with a wildcard."""
    _allow_everything(copy, "listener")


def client_may_do_everything(copy: KeystoreCopy) -> None:
    """Give the client permissions with a wildcard."""
    _allow_everything(copy, "client")


def _allow_everything(copy: KeystoreCopy, part: str) -> None:
    """Give the enclave that plays ``part`` the permissions of ros2/sros2 without a policy."""
    wide = copy.widened_permissions(part, publish=["*"], subscribe=["*"])
    copy.put(part, PERMISSIONS_FILE, copy.sign(wide))


def identity_in_date(copy: KeystoreCopy) -> None:
    """Issue the talker's certificate again, valid from yesterday to tomorrow."""
    copy.reissue("talker", Window(copy.now - _DAY, copy.now + _DAY))


def expired_identity(copy: KeystoreCopy) -> None:
    """Issue the talker's certificate again, valid only for the first minute of its CA."""
    start = validity_of(copy.authorities().identity.certificate).not_before
    copy.reissue("talker", Window(start, start + _MINUTE))


def identity_not_yet_valid(copy: KeystoreCopy) -> None:
    """Issue the talker's certificate again, valid from tomorrow on."""
    copy.reissue("talker", Window(copy.now + _DAY, copy.now + 2 * _DAY))


def key_of_another_enclave(copy: KeystoreCopy) -> None:
    """Give the talker the guest's key."""
    copy.put("talker", KEY_FILE, copy.read("guest", KEY_FILE))


def _revoke(copy: KeystoreCopy, part: str) -> None:
    """Revoke the enclave that plays ``part``, then certify a new key for the same subject."""
    folder = copy.folder(part)
    before = {name: copy.read(part, name) for name in REQUIRED_FILES}
    lists = _outdated_lists(copy)
    revoke(copy.root, [copy.enclave(part)], now=copy.now, keyring=copy.keyring)
    # A revocation also removes the folder of a namespace that is empty after it.
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    for path, data in lists.items():
        path.unlink(missing_ok=True)
        if data:
            path.write_bytes(data)
    for name, data in before.items():
        copy.put(part, name, data)
    copy.reissue(part, Window(copy.now - _DAY, copy.now + _DAY), new_key=True)
    copy.put(part, CRL_FILE, (copy.root / CRL).read_bytes())


def _outdated_lists(copy: KeystoreCopy) -> dict[Path, bytes]:
    """Return the CRLs (empty: none) of enclaves that lack the keystore's current CRL.

    An enclave that did not get the last list will not get the next list, either.
    """
    newest = copy.root / CRL
    revoked = any(entry.what == "revocation" for entry in OpenedKeystore(copy.root).ledger.entries)
    if not revoked and not newest.exists():
        return {}
    paths = [copy.folder(part) / CRL_FILE for part in copy.cast]
    lists = {path: path.read_bytes() if path.exists() else b"" for path in paths}
    current = newest.read_bytes() if newest.exists() else None
    return {path: data for path, data in lists.items() if not data or data != (current or data)}


def talker_revoked(copy: KeystoreCopy) -> None:
    """Revoke the talker, then issue a new key and certificate for the talker."""
    _revoke(copy, "talker")


def guest_revoked(copy: KeystoreCopy) -> None:
    """Revoke the guest, then issue a new key and certificate for the guest."""
    _revoke(copy, "guest")


def talker_revocation_not_delivered(copy: KeystoreCopy) -> None:
    """Revoke the talker, keep a copy in `STOLEN`, and remove the listener's CRL."""
    _revocation_not_delivered(copy, "talker")


def guest_revocation_not_delivered(copy: KeystoreCopy) -> None:
    """Revoke the guest, keep a copy with wider permissions, and remove the listener's CRL."""
    now = copy.read("guest", PERMISSIONS_FILE)
    permissions_signed_by_the_ca(copy)
    before = copy.read("guest", PERMISSIONS_FILE)
    copy.put("guest", PERMISSIONS_FILE, now)
    _revocation_not_delivered(copy, "guest")
    (enclave_path(copy.root, STOLEN) / PERMISSIONS_FILE).write_bytes(before)


def _revocation_not_delivered(copy: KeystoreCopy, part: str) -> None:
    """Revoke the enclave that plays ``part``, keep its files, and remove the listener's CRL."""
    before = {name: copy.read(part, name) for name in REQUIRED_FILES}
    _revoke(copy, part)
    keep_stolen(copy, before)
    (copy.folder("listener") / CRL_FILE).unlink()


def keep_stolen(copy: KeystoreCopy, files: Mapping[str, bytes]) -> None:
    """Store the copy that a thief made of an enclave's files, under another name."""
    folder = enclave_path(copy.root, STOLEN)
    folder.mkdir(mode=0o700)
    for name, data in files.items():
        (folder / name).touch(0o600)
        (folder / name).write_bytes(data)


def identity_copied_by_another_user(copy: KeystoreCopy) -> None:
    """Copy the talker's identity as another user: only files that this user can read remain.

    Raises:
        UnavailableError: this process does not run as root.
    """
    if os.geteuid() != 0:
        raise UnavailableError("only root can try to read the files as another user of the machine")
    folder = copy.folder("talker")
    inside = str(folder.relative_to(copy.root))
    names = [file.name for file in folder.iterdir()]
    copied = _read_as_nobody(copy.root, [f"{inside}/{name}" for name in names])
    for name, data in zip(names, copied, strict=True):
        if data is None:
            (folder / name).unlink()
        else:
            copy.put("talker", name, data)


def _read_as_nobody(root: Path, files: list[str]) -> list[bytes | None]:
    """Read files as the user nobody; the content is None for unreadable files."""
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
                    os.setgid(_NOBODY_USER_ID)
                    os.setuid(_NOBODY_USER_ID)
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


def files_readable_for_all(copy: KeystoreCopy) -> None:
    """Make all files world-readable, then copy the talker's identity, acting as another user."""
    for path in [copy.root, *copy.root.rglob("*")]:
        if not path.is_symlink():
            path.chmod(0o755 if path.is_dir() else 0o644)
    identity_copied_by_another_user(copy)


def one_ca(template: Template) -> Template:
    """Return the template changed to one CA for identity and permissions."""
    return replace(template, separate_authorities=False)


def shared_subjects(template: Template) -> Template:
    """Return the template changed to allow shared subject names."""
    return replace(template, unique_subject=False)


def open_default(template: Template) -> Template:
    """Return the template changed to give enclaves without a policy all permissions."""
    return replace(template, default_permissions=EVERYTHING)


def unprotected(template: Template) -> Template:
    """Return the template with access control on and message protection off."""
    return _with_protection(template, Level.NONE)


def signed(template: Template) -> Template:
    """Return the template changed to access control and signed, unencrypted messages."""
    return _with_protection(template, Level.SIGN)


def encrypted(template: Template) -> Template:
    """Return the template changed to access control and encrypted messages."""
    return _with_protection(template, Level.ENCRYPT)


def _with_protection(template: Template, level: Level) -> Template:
    """Return the template changed to the same protection level for all topics.

    A payload is signed as part of its submessage: Fast DDS loses messages with a signed payload
    (`governance.signed-payload`).
    """
    discovered = level is not Level.NONE
    payload = level if level is Level.ENCRYPT else Level.NONE
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
