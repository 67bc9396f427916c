"""Keystores that are drawn, and changed by verbs, with what live Cyclone DDS nodes then hear.

A life begins with CAs of its own or given ones, of many kinds, and ends after some verbs.  After a
verb that succeeded, nodes are to be started with a copy of the keystore (`Scene`).  Scenes are
played at once, each in a domain of its own and each node in a process of its own.
"""

from __future__ import annotations

import re
import shutil
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from random import Random

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec, padding, rsa
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from sros_tool.files import templates_dir
from sros_tool.pki.certificates import pem
from sros_tool.pki.keys import PrivateKey, key_pem
from sros_tool.runtime.events import EventKind
from tests.integration.converse import SILENCE, Node, Party
from tests.integration.vendor_oracle import cyclone_vendor
from tests.support.children import LATE, PATIENCE, apart
from tests.support.harness import Ended, copy_of, sros

LOST, A, B = "/lost", "/a", "/b"
ENOUGH = 3
"""Messages after which somebody is heard."""
BUSY = 2 * LATE
"""Seconds after which who is expected is not heard any more, with many nodes at once."""

# ── CAs as companies have them ─────────────────────────────────────────────────────────────

_NAMES = (
    (),
    ((NameOID.COUNTRY_NAME, "DE"), (NameOID.ORGANIZATION_NAME, "Robots, Inc.")),
    ((NameOID.ORGANIZATION_NAME, "Bürotechnik"), (NameOID.ORGANIZATIONAL_UNIT_NAME, "IT+OT")),
    ((NameOID.DOMAIN_COMPONENT, "example"), (NameOID.DOMAIN_COMPONENT, "corp")),
    ((NameOID.EMAIL_ADDRESS, "pki@corp.example"), (NameOID.LOCALITY_NAME, "Köln")),
)


@dataclass(frozen=True)
class Given:
    """A CA that is given to `create_keystore`: its certificates and its key, as PEM."""

    kind: str
    certificates: bytes
    key: bytes


def draw_authority(random: Random, role: str) -> Given:
    """Return a CA of a drawn kind; most kinds are sound."""
    kind = random.choice(
        ("plain", "plain", "plain", "policies", "long path", "no keyUsage", "purposes", "SHA-384")
        + ("no cRLSign",) * (2 if role == "identity" else 1)
        + (random.choice(("intermediate", "P-384", "RSA 3072", "PSS", "no digitalSignature")),)
    )
    key = _key(random, kind)
    name = x509.Name(
        [
            *(x509.NameAttribute(oid, text) for oid, text in random.choice(_NAMES)),
            x509.NameAttribute(NameOID.COMMON_NAME, f"Corp {role} CA {random.randrange(1000)}"),
        ]
    )
    if kind != "intermediate":
        return Given(kind, pem(_certificate(random, kind, name, key, name, key)), key_pem(key))
    root, above = _key(random, ""), x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "Root")])
    chain = (
        _certificate(random, "plain", name, key, above, root),
        _certificate(random, "plain", above, root, above, root),
    )
    return Given(kind, b"".join(map(pem, chain)), key_pem(key))


def _key(random: Random, kind: str) -> PrivateKey:
    if kind == "P-384":
        return ec.generate_private_key(ec.SECP384R1())
    if kind in ("RSA 3072", "PSS") or random.random() < 0.4:
        return rsa.generate_private_key(65537, 3072 if kind == "RSA 3072" else 2048)
    return ec.generate_private_key(ec.SECP256R1())


def _certificate(
    random: Random,
    kind: str,
    subject: x509.Name,
    key: PrivateKey,
    issuer: x509.Name,
    by: PrivateKey,
) -> x509.Certificate:
    now = datetime.now(UTC)
    public = key.public_key()
    builder = x509.CertificateBuilder(
        issuer,
        subject,
        public,
        random.getrandbits(random.choice((32, 64, 158))) + 1,
        now - timedelta(days=30),
        now + timedelta(days=random.choice((400, 4000))),
    ).add_extension(x509.BasicConstraints(True, 3 if kind == "long path" else None), critical=True)
    if kind != "no keyUsage":
        signs, lists = kind != "no digitalSignature", kind != "no cRLSign"
        usage = x509.KeyUsage(signs, False, False, False, False, True, lists, False, False)
        builder = builder.add_extension(usage, critical=random.random() < 0.7)
    if kind == "policies":
        policy = x509.PolicyInformation(x509.ObjectIdentifier("1.3.6.1.4.1.99999.1"), None)
        builder = builder.add_extension(x509.CertificatePolicies([policy]), critical=False)
    if kind == "purposes":
        purposes = [ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.EMAIL_PROTECTION]
        builder = builder.add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
    if random.random() < 0.8 or kind == "intermediate" or issuer != subject:
        identifier = x509.SubjectKeyIdentifier.from_public_key(public)
        builder = builder.add_extension(identifier, critical=False)
    padded = padding.PSS(padding.MGF1(hashes.SHA256()), 32) if kind == "PSS" else None
    digest = hashes.SHA384() if kind == "SHA-384" else hashes.SHA256()
    return builder.sign(by, digest, rsa_padding=padded)


# ── lives ──────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class Scene:
    """Nodes that talk in one domain: what the listener should hear, and what it should not."""

    title: str
    nodes: tuple[Node, ...]
    heard: tuple[str, ...]
    silent: tuple[str, ...] = ()


@dataclass
class Life:
    """A drawn keystore: the verbs that were run, and the scenes that show what became of it.

    ``refused`` are the verbs that did not succeed, with what they said.
    """

    title: str
    folder: Path
    random: Random
    kinds: dict[str, str] = field(default_factory=dict)
    verbs: list[str] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)
    scenes: list[Scene] = field(default_factory=list)
    lost: bool = False
    """Whether the enclave /lost was revoked."""

    @property
    def root(self) -> Path:
        return self.folder / "ks"

    @property
    def robot(self) -> Path:
        return self.folder / "robot"

    def live(self) -> None:
        """Create the keystore, and change it by some verbs."""
        cyclone = self._create()
        if cyclone is None:
            return
        self._show("new", () if cyclone else None)
        verbs = [self._renew, self._refresh, self._rotate, self._update, self._request, self._more]
        chosen = [self._revoke, *self.random.sample(verbs, self.random.choice((2, 3)))]
        self.random.shuffle(chosen)
        for verb in chosen if cyclone else ():
            verb()

    # ── verbs ──────────────────────────────────────────────────────────────────────────────

    def _create(self) -> bool | None:
        """Create keystore and enclaves; return whether sros says that Cyclone DDS takes them."""
        random = self.random
        self.folder.mkdir()
        name = random.choice(("development", "sros2", "production", "production"))
        text = (templates_dir() / f"{name}.toml").read_text()
        template = self.folder / "template.toml"
        template.write_text(re.sub(r'(?m)^default = "\w+"', 'default = "everything"', text))
        words: list[object] = ["--template", template, "--domain", "1-100"]
        roles = [each for each in ("identity", "permissions") if random.random() < 0.6]
        if name == "sros2":
            roles = roles and ["identity"]
        for role in roles:
            given = draw_authority(random, role)
            self.kinds[role] = given.kind
            file = self.folder / f"{role}.pem"
            file.write_bytes(given.certificates)
            file.with_suffix(".key").write_bytes(given.key)
            key = f"file:{file.with_suffix('.key')}"
            words += [f"--{role}-ca", file, f"--{role}-key", key]
            words += ["--permissions-key", key] * (name == "sros2")  # one CA for both roles
        self.title += f" {name} {self.kinds or ''}"
        if self._run("create_keystore", self.root, *words).status:
            return None
        if self._run("create_enclave", self.root, A, B, LOST, "/spare").status:
            return None
        asked = ("join", "--vendor", cyclone_vendor().value, "--domain", "1")
        joins = [sros("explain", self.root, name, *asked).status for name in (A, B, LOST)]
        assert joins in ([0] * 3, [1] * 3), (self.title, joins)
        return not joins[0]

    def _revoke(self) -> None:
        self.lost = self._did("revoke", self.root, LOST)
        self._show(f"revoke, done: {self.lost}")

    def _renew(self) -> None:
        words = self.random.choice(
            ((A,), (A, B), (A, "--new-key"), (B, "--revoke-old"), ("--all-expiring", "90%"))
        )
        self._show_after("renew", self.root, *words)

    def _refresh(self) -> None:
        self._show_after("crl", self.root, "--refresh")

    def _rotate(self) -> None:
        words = ["--finish"] if self.random.random() < 0.3 else ["--next"]
        for role in ("identity", "permissions"):
            key = self.folder / ("new.key" if "sros2" in self.title else f"new_{role}.key")
            if self.kinds and (role in self.kinds or "sros2" in self.title):
                words += [f"--{role}-key", f"file:{key}"]
        if not self._did("rotate_ca", self.root, *words):
            return
        self._show(" ".join(words[:1]))
        if words[0] == "--next":
            for _ in range(self.random.choice((0, 1, 2, 2))):
                if self.random.random() < 0.3:
                    self._run("create_enclave", self.root, f"/later{self.random.randrange(99)}")
                self._show_after("rotate_ca", self.root, "--next")

    def _update(self) -> None:
        value = self.random.choice(
            (
                "protection.rtps=SIGN",
                "protection.rtps=NONE",
                "permissions.validity=100d",
                "certificates.validity=200d",
            )
        )
        old = ("--revoke-old",) * (self.random.random() < 0.3)
        words = ("--set", value, "--allow-looser", *old)
        self._show_after("update_keystore", self.root, *words)

    def _request(self) -> None:
        """Have the key of /robot made on a robot, and everything else sent to it."""
        self.robot.mkdir(exist_ok=True)
        again = ("--again",) * (self.robot / "enclaves").exists()
        if self._run("create_request", "/robot", self.robot, *again).status:
            return
        answer = self.folder / "answer.tar.gz"
        request = self.robot / "enclaves/robot/request.pem"
        signed = self._did("sign_request", self.root, request, "-o", answer, "--force")
        if signed and self._did("import", answer, self.robot):
            self._show("import", ("robot",))

    def _more(self) -> None:
        self._show_after("create_enclave", self.root, "/more")

    def _show_after(self, *words: object) -> None:
        if self._did(*words):
            self._show(" ".join(map(str, (words[0], *words[2:]))))

    def _did(self, *words: object) -> bool:
        return self._run(*words).status == 0

    def _run(self, *words: object) -> Ended:
        ended = sros(*words, env={"ROS_DOMAIN_ID": None, "ROS_SECURITY_KEYSTORE": None})
        assert ended.status in (0, 2) or words[0] == "crl", (self.title, words, ended)
        self.verbs.append(str(words[0]))
        if ended.status == 2:
            self.refused.append(f"{self.title}: {words[0]}: {ended.err}")
        return ended

    # ── scenes ─────────────────────────────────────────────────────────────────────────────

    def _show(self, what: str, others: tuple[str, ...] | None = ()) -> None:
        """Add a scene in which /a and ``others`` talk to /b; with None, nobody is expected.

        /lost talks before anything is changed, and with the same files after it was revoked.
        """
        number = len(self.scenes)
        copy = self.folder / f"copy{number}"
        for part in ("enclaves", "public"):
            copy_of(self.root / part, copy / part)
        told = [(A, copy)]
        if others:
            told.append(("/robot", Path(shutil.copytree(self.robot, copy / "robot"))))
        if number == 0 or self.lost:
            told.append((LOST, self.folder / "copy0"))
        title = f"{self.title}, {number}: {what}"
        talkers = [
            Node("talker", f"talker {name[1:]}", str(root), name, text=f"from {name};")
            for name, root in told
        ]
        silent = (LOST,) if self.lost else ()
        names = tuple(name for name, _ in told if name not in silent)
        self.scenes.append(
            Scene(
                title,
                (*talkers, Node("listener", "listener", str(copy), B)),
                () if others is None else names,
                silent if others is not None else names,
            )
        )


# ── playing ────────────────────────────────────────────────────────────────────────────────


def play(scenes: Sequence[Scene]) -> list[dict[str, str]]:
    """Play scenes at once: map the enclaves that talk to "heard", "silent" or "refused ..."."""
    return apart(partial(_play, scenes))


class _Played:
    """A scene that is being played."""

    def __init__(self, number: int, scene: Scene, folder: Path) -> None:
        self.scene = scene
        folder.mkdir()
        self._parties = {node.enclave: Party(node, number, folder) for node in scene.nodes}

    def settled(self) -> bool:
        return all(party.is_settled() for party in self._parties.values())

    def heard(self) -> dict[str, int]:
        events = self._parties[B].events()
        texts = [event.text for event in events if event.kind is EventKind.HEARD]
        names = (each for each in self._parties if each != B)
        return {name: sum(f"from {name};" in text for text in texts) for name in names}

    def content(self) -> bool:
        heard = self.heard()
        return all(heard[name] >= ENOUGH for name in self.scene.heard)

    def end(self) -> dict[str, str]:
        heard = self.heard()
        told = {name: party.end() for name, party in self._parties.items()}
        answers = {}
        for name, count in heard.items():
            answers[name] = "heard" if count else "silent"
            for who in (B, name):
                if "ready" not in told[who].kinds:
                    answers[name] = f"{who} refused: {told[who].reasons} {told[who].errors[-300:]}"
                elif who == name and told[who].sent < ENOUGH:
                    answers[name] = f"{who} sent nothing: {told[who]}"
        return answers


def _play(scenes: Sequence[Scene]) -> list[dict[str, str]]:
    with tempfile.TemporaryDirectory() as folder:
        played = [
            _Played(number, scene, Path(folder, str(number)))
            for number, scene in enumerate(scenes, 1)
        ]
        hung = time.monotonic() + PATIENCE
        while not all(each.settled() for each in played) and time.monotonic() < hung:
            time.sleep(0.1)
        begin = time.monotonic()
        while not all(each.content() for each in played) and time.monotonic() < begin + BUSY:
            time.sleep(0.1)
        if any(each.scene.silent for each in played):
            needed = time.monotonic() - begin
            time.sleep(max(SILENCE - needed, min(needed, BUSY / 4)))
        return [each.end() for each in played]
