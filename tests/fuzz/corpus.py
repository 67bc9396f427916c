"""Real documents of every kind that sros reads, made at run time by sros itself."""

from __future__ import annotations

import json
import subprocess
from dataclasses import dataclass
from pathlib import Path

from cryptography.hazmat.primitives.asymmetric import ec

from sros_tool.files import policies_dir
from sros_tool.graph.observation import Endpoint, ObservedNode, make_observation
from sros_tool.pki import smime
from sros_tool.pki.certificates import load_certificate
from sros_tool.pki.keys import load_key
from sros_tool.values import as_plain
from tests.support.harness import policy_text, publish, sros

PASSPHRASE = "the passphrase"
_SIGNED = 'chatter<?sros protect="sign"?>'
_POLICY = policy_text({"/a": publish(_SIGNED, "b/*"), "/b/c": publish("~/x")})
_SCENARIO = """\
title = "Camera"
policy = "policy.xml"

[[party]]
name = "camera"
role = "talker"
enclave = "/a"
topic = "/chatter"

[[party]]
name = "viewer"
role = "listener"
enclave = "/b/c"
topic = "/chatter"
variables = { ROS_SECURITY_STRATEGY = "Enforce" }

[[row]]
name = "viewer sees"
claim = { listener = "viewer", talker = "camera", expected = "heard" }

[[row.control]]
listener = "viewer"
talker = "camera"
expected = "heard"
"""
_ZENOH = """\
// as people write it
{
  mode: 'peer', connect: { endpoints: { router: [], peer: ["tls/localhost:7447#iface=lo"] } },
  transport: { link: { tls: { enable_mtls: true, root_ca_certificate: "ca.pem", }, }, },
  access_control: {
    enabled: true, default_permission: 'allow',
    rules: [
      { id: "r", permission: "deny", flows: ["ingress"], messages: ["put"], key_exprs: ["0/a/**"] },
      { id: "s", permission: "allow", messages: ["put", "query"], key_exprs: ["0/*/@adv/**"] },
    ],
    subjects: [{ id: "all" }, { id: "b", cert_common_names: ["/b"], link_protocols: ["tls"] }],
    policies: [{ rules: ["r", "s"], subjects: ["all", "b"] }],
  },
}
"""
_LOG = """\
[INFO] [launch]: process started with pid [4242]
[talker-1] 2026-11-22 08:00:00.000 [SECURITY Error] Error creating \
'publisher' topic rt/chatter: rt/chatter topic not found in allow rule. (/tmp/p.xml:12) \
-> Function check_create_datawriter
[talker-1] [SECURITY Error] Not found the identity subject name in permissions file (CN=/a)
[ERROR] [1763798400.1] [rcl]: Couldn't find all security files! enclave /a
1763798400.1 [0] talker: Error occurred while validating local permission: \
Could not find domain in governance (code: 141)
1763798400.2 [0] talker: CN=/b/c subject name is not found. code 146
"""


@dataclass(frozen=True)
class Corpus:
    """The folder with the documents, and the key of its identity CA."""

    root: Path
    key: ec.EllipticCurvePrivateKey

    @property
    def keystore(self) -> Path:
        """A keystore in the first stage of a rotation, with a revoked enclave, and with Zenoh."""
        return self.root / "ks"

    @property
    def robot(self) -> Path:
        """A folder of a robot, in which a request waits for `answer`."""
        return self.root / "robot"

    def read(self, *paths: str) -> tuple[bytes, ...]:
        """Return the contents of files below the root."""
        return tuple((self.root / path).read_bytes() for path in paths)

    def sign(self, document: bytes) -> bytes:
        """Return ``document`` signed by the permissions CA."""
        public = self.keystore / "public/permissions_ca.cert.pem"
        private = self.keystore / "private/permissions_ca.key.pem"
        authority = load_certificate(public.read_bytes(), "of the corpus")
        return smime.sign(document, authority, load_key(private.read_bytes(), "of the corpus"))


def _openssl(root: Path, *words: str) -> None:
    subprocess.run(["openssl", *words], cwd=root, check=True, capture_output=True)


def make_corpus(root: Path) -> Corpus:
    """Make the documents in the folder ``root``."""
    keystore, robot, policy = root / "ks", root / "robot", root / "policy.xml"
    policy.write_text(_POLICY)
    (root / "scenario.toml").write_text(_SCENARIO)
    (root / "log").write_text(_LOG)
    (root / "by_hand.json5").write_text(_ZENOH)
    sros("create_keystore", keystore, "--template", "production").ok()
    sros("generate_artifacts", "-k", keystore, "-p", policy).ok()
    sros("zenoh", keystore).ok()
    sros("create_enclave", keystore, "/gone").ok()
    sros("revoke", keystore, "/gone").ok()
    sros("create_request", "/r", robot).ok()
    (root / "request.pem").write_bytes(next(robot.rglob("request.pem")).read_bytes())
    sros("sign_request", keystore, root / "request.pem", "-o", root / "answer.tar.gz").ok()
    sros("distribute_key", keystore, "/a", root / "export").ok()
    made = sros("fleet", "report", root / "export", "--robot", "r7").ok()
    (root / "confirmation.json").write_text(made.out)
    sros("rotate_ca", keystore, "--identity", "--to", "distribute").ok()
    _openssl(root, "genpkey", "-algorithm", "ED25519", "-out", "ed25519.pem")
    _openssl(root, "genrsa", "-out", "rsa.pem", "2048")
    ca_key = str(keystore / "private/identity_ca.key.pem")
    secret = f"pass:{PASSPHRASE}"
    _openssl(root, "ec", "-in", ca_key, "-aes128", "-passout", secret, "-out", "old.pem")
    _openssl(root, "pkcs8", "-topk8", "-in", ca_key, "-passout", secret, "-out", "encrypted.pem")
    _openssl(root, "ec", "-in", ca_key, "-out", "sec1.pem")
    for name in ("rsa", "ed25519"):
        subject = ("-subj", "/C=DE/O=x/CN=\N{GREEK SMALL LETTER ALPHA}", "-utf8")
        new = ("req", "-x509", "-new", "-key", f"{name}.pem", "-out", f"{name}.cert.pem")
        _openssl(root, *new, *subject, "-addext", "subjectAltName=DNS:x,IP:::1,email:a@b")
    _openssl(root, "req", "-new", "-key", "rsa.pem", "-subj", "/CN=\\/r", "-out", "rsa.csr")
    node = ObservedNode(
        ("/a",),
        "/",
        "talker",
        "p1",
        frozenset((Endpoint("rt/chatter", "publish"), Endpoint("rq/addRequest", "subscribe"))),
    )
    (root / "observation.json").write_text(json.dumps(as_plain(make_observation([node])), indent=1))
    (root / "shipped.xml").write_bytes((policies_dir() / "mobile_robot.xml").read_bytes())
    key = load_key((keystore / "private/identity_ca.key.pem").read_bytes(), "of the corpus")
    assert isinstance(key, ec.EllipticCurvePrivateKey)
    return Corpus(root, key)
