"""How each finding about keystores comes about: one way to break a sound one for each id."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
from collections.abc import Callable
from datetime import timedelta, timezone
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID

from sros_tool.keystore.ledger import LATER_RELEASE, RESTORED
from sros_tool.pki import smime
from sros_tool.pki.certificates import pem
from sros_tool.pki.keys import key_pem, load_key
from sros_tool.policy.document import read_policy
from tests.checks.bench import DAY, SECRET, Bench, name_of, new_key
from tests.support.harness import policy_text, publish, sros

Break = Callable[[Bench], object]
CASES: dict[str, Break] = {}
STRANGER = 65532


def case(*ids: str) -> Callable[[Break], Break]:
    def add(work: Break) -> Break:
        for each in ids:
            assert each not in CASES, each
            CASES[each] = work
        return work

    return add


def also_trusted(bench: Bench, file: str) -> None:
    """Add another CA to a file of CAs, as the file of this enclave or keystore alone."""
    path, (stranger, _) = bench.path(file), bench.new_authority(IS_CA)
    data = path.read_bytes() + pem(stranger)
    path.unlink()
    path.write_bytes(data)


def at(bench: Bench, days: float) -> None:
    bench.options["now"] = bench.now + days * DAY


def _replace(bench: Bench, file: str, old: str, new: str) -> None:
    text = bench.path(file).read_text()
    assert old in text
    bench.path(file).write_text(text.replace(old, new))


def give_away(path: Path) -> None:
    if os.geteuid() != 0:
        pytest.skip("only root can give a folder to another user")
    os.chown(path, STRANGER, STRANGER, follow_symlinks=False)


def weakly_encrypted(bench: Bench) -> None:
    """As OpenSSL and the library `cryptography` encrypt a key unless told otherwise."""
    path = bench.path("private/identity_ca.key.pem")
    pem_of = bench.key("identity").private_bytes
    secret = serialization.BestAvailableEncryption(SECRET.encode())
    form = serialization.PrivateFormat.PKCS8
    path.write_bytes(pem_of(serialization.Encoding.PEM, form, secret))


def on_token(bench: Bench, *attributes: str) -> None:
    """Give an enclave a key on a token, which nobody opens."""
    bench.unlink("enclaves/base/key.pem")
    uri = ";".join(("pkcs11:token=robot", *attributes))
    bench.path("enclaves/base/key.p11").write_text(f"{uri}\n")


IS_CA = (x509.BasicConstraints(True, None), True)
IS_NO_CA = (x509.BasicConstraints(False, None), True)


def root_enclave(bench: Bench) -> None:
    """Leave an enclave / with the rights of /arm behind."""
    policy = bench.root.with_name("root.xml")
    text = bench.root.with_name("policy.xml").read_text()
    policy.write_text(
        re.sub('<enclave path="/base">.*?</enclave>', "", text).replace('"/arm"', '"/"')
    )
    words = ("generate_artifacts", "-k", bench.root, "-p", policy)
    sros(*words, env={"SROS_CA_PASSPHRASE": SECRET}).ok()


# ── files ──────────────────────────────────────────────────────────────────────────────────

CASES |= {
    "keystore.key-readable": lambda b: b.path("enclaves/base/key.pem").chmod(0o640),
    "keystore.world-writable": lambda b: b.path("public/identity_ca.cert.pem").chmod(0o646),
    "keystore.others-write": lambda b: give_away(b.path("public")),
    "keystore.replaceable": lambda b: b.root.parent.chmod(0o777),
    "keystore.foreign-owner": lambda b: give_away(b.root),
    "keystore.folder-open": lambda b: b.path("private").chmod(0o755),
    "keystore.link-dangling": lambda b: b.path("public/old.cert.pem").symlink_to("gone.pem"),
    "keystore.transaction-left": lambda b: b.path(".sros-transaction").mkdir(0o700),
    "keystore.transaction-not-ours": lambda b: b.path(".sros-transaction").mkdir(0o755),
    "keystore.unknown-file": lambda b: b.path("notes.txt").write_text("call Bob"),
    "keystore.hidden-enclave": lambda b: shutil.copytree(
        b.path("enclaves/base"), b.path("enclaves/.base"), symlinks=True
    ),
    "keystore.stray-key": lambda b: shutil.copy(
        b.path("enclaves/base/key.pem"), b.path("enclaves/base/key.pem.bak")
    ),
    "keystore.archive": lambda b: b.path("public/backup.tar.gz").write_bytes(b"\x1f\x8b"),
    "keystore.ca-key-on-robot": lambda b: (b.export() / "ca.key.pem").write_bytes(
        key_pem(new_key())
    ),
    "keystore.home-or-robot": lambda b: shutil.copytree(b.path("private"), b.export() / "private"),
}


@case("keystore.link-absolute")
def _(bench: Bench) -> None:
    bench.unlink("enclaves/base/governance.p7s").symlink_to(bench.path("enclaves/governance.p7s"))


@case("keystore.link-outside")
def _(bench: Bench) -> None:
    shutil.copy(bench.path("enclaves/governance.p7s"), bench.root.with_name("elsewhere.p7s"))
    bench.unlink("enclaves/base/governance.p7s").symlink_to("../../../elsewhere.p7s")


# ── authorities ────────────────────────────────────────────────────────────────────────────

CASES |= {
    "keystore.file-unreadable": lambda b: b.path("sros.toml").write_text("nonsense\n"),
    "keystore.ledger-damaged": lambda b: b.path("ledger.jsonl").write_text("nonsense\n"),
    "keystore.settings-edited": lambda b: _replace(b, "sros.toml", "180d", "181d"),
    "keystore.fleet-edited": lambda b: b.path("fleet.toml").write_text("[robots.base]\n"),
    "keystore.left-enclaves": lambda b: b.path("fleet.toml").write_text(
        'enclaves = ["/{robot}"]\n[robots.r1]\n'
    ),
    "governance.not-as-settings": lambda b: b.governance(
        ("<rtps_protection_kind>ENCRYPT", "<rtps_protection_kind>SIGN")
    ),
    "keystore.settings-missing": lambda b: b.unlink("sros.toml"),
    "keystore.ledger-missing": lambda b: b.unlink("ledger.jsonl"),
    "keystore.one-authority": lambda b: b.trust("permissions", b.authority("identity")),
    "keystore.root-enclave": root_enclave,
    "keystore.ca-ends-soon": lambda b: at(b, 5 * 365 - 89),
    "keystore.ca-expired": lambda b: at(b, 5 * 365 + 1),
    "keystore.ca-missing": lambda b: b.unlink("public/permissions_ca.cert.pem"),
    "keystore.ca-key-mismatch": lambda b: b.path("private/identity_ca.key.pem").write_bytes(
        key_pem(new_key())
    ),
    "keystore.ca-key-plain": lambda b: b.path("private/identity_ca.key.pem").write_bytes(
        key_pem(b.key("identity"))
    ),
    "keystore.ca-key-few-rounds": lambda b: weakly_encrypted(b),
    "keystore.not-a-ca": lambda b: b.trust("identity", b.new_authority(IS_NO_CA)[0]),
    "keystore.ca-extensions": lambda b: b.trust("identity", b.new_authority(IS_CA)[0]),
    "portable.intermediate": lambda b: b.trust(
        "identity",
        b.new_authority(IS_CA, issuer=(b.authority("identity").subject, b.key("identity")))[0],
    ),
    "portable.ca-purpose": lambda b: b.trust(
        "permissions",
        b.new_authority(IS_CA, (x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), False))[
            0
        ],
    ),
    "portable.key-algorithm": lambda b: b.trust(
        "identity", b.new_authority(IS_CA, curve=ec.SECP384R1())[0]
    ),
    "keystore.weak-cryptography": lambda b: b.trust(
        "identity", b.new_authority(IS_CA, curve=ec.SECP224R1())[0]
    ),
    "portable.signature-hash": lambda b: b.trust(
        "identity", b.new_authority(IS_CA, digest=hashes.SHA384())[0]
    ),
    "keystore.clock-behind": lambda b: at(b, -0.5),
    "keystore.revocation-list-ends": lambda b: b.revoke(end=b.now + DAY / 4),
    "keystore.revocation-list-issuer": lambda b: b.revoke(by=b.foreign()),
    "keystore.enclave-removed": lambda b: shutil.rmtree(b.path("enclaves/base")),
    "keystore.unknown-authority": lambda b: also_trusted(b, "public/permissions_ca.cert.pem"),
}

# ── what DDS refuses ───────────────────────────────────────────────────────────────────────

CASES |= {
    "enclave.file-missing": lambda b: b.unlink("enclaves/base/permissions.p7s"),
    "enclave.link-dangling": lambda b: b.unlink("public/identity_ca.cert.pem"),
    "enclave.file-unreadable": lambda b: os.truncate(b.path("enclaves/base/key.pem"), 1 << 25),
    "enclave.file-no-file": lambda b: b.unlink("enclaves/base/key.pem").mkdir(),
    "enclave.file-empty": lambda b: b.path("enclaves/base/key.pem").write_bytes(b""),
    "enclave.certificate-malformed": lambda b: b.path("enclaves/base/cert.pem").write_text("x"),
    "enclave.certificate-expired": lambda b: at(b, 366),
    "enclave.certificate-not-yet-valid": lambda b: at(b, -2),
    "enclave.ca-expired": lambda b: at(b, 5 * 365 + 1),
    "enclave.ca-not-yet-valid": lambda b: at(b, -2),
    "enclave.certificate-issuer": lambda b: b.issue(by=b.foreign()),
    "enclave.key-malformed": lambda b: b.path("enclaves/base/key.pem").write_text("x"),
    "enclave.key-encrypted": lambda b: b.path("enclaves/base/key.pem").write_bytes(
        key_pem(new_key(), "secret")
    ),
    "enclave.key-mismatch": lambda b: b.path("enclaves/base/key.pem").write_bytes(
        key_pem(new_key())
    ),
    "enclave.token-uri": lambda b: on_token(b, "object=base?pin-value=1234"),
    "portable.key-on-token": lambda b: on_token(b, "object=base"),
    "enclave.pin-file": lambda b: on_token(
        b, f"object=base?pin-source=file:{b.path('enclaves/base/cert.pem')}"
    ),
    "enclave.crl-left-out": lambda b: b.path("enclaves/base/crl.pem").mkdir(),
    "enclave.crl-malformed": lambda b: b.path("enclaves/base/crl.pem").write_text("x"),
    "enclave.crl-issuer": lambda b: b.revoke(by=b.foreign()),
    "enclave.crl-partial": lambda b: b.revoke(scope="http://example.org/crl"),
    "enclave.crl-not-yet-valid": lambda b: b.revoke(begin=b.now + DAY),
    "enclave.crl-expired": lambda b: b.revoke(begin=b.now - 9 * DAY, end=b.now - DAY),
    "enclave.revoked": lambda b: b.revoke(b.certificate().serial_number),
    "enclave.not-signed": lambda b: b.path("enclaves/base/permissions.p7s").write_text(
        b.document("enclaves/base/permissions.p7s")
    ),
    "enclave.signature": lambda b: _tamper(b, "enclaves/base/permissions.p7s"),
    "enclave.governance-malformed": lambda b: b.governance(("domain_access_rules>", "rules>")),
    "enclave.permissions-malformed": lambda b: b.permissions(("validity>", "window>")),
    "enclave.governance-domain": lambda b: b.options.update(domain=7),
    "enclave.permissions-expired": lambda b: at(b, 181),
    "enclave.permissions-not-yet-valid": lambda b: b.permissions(
        ("<not_before>", "<not_before>2027-01-01T00:00:00Z</not_before><!--"),
        ("</not_before>\n", "</not_before>-->\n"),
    ),
    "enclave.permissions-subject": lambda b: shutil.copy(
        b.path("enclaves/arm/permissions.p7s"), b.path("enclaves/base/permissions.p7s")
    ),
}


@case("enclave.signer-no-ca")
def _(bench: Bench) -> None:
    """Everything of one CA, and permissions that an enclave signed with its own certificate."""
    usage = x509.KeyUsage(True, False, False, False, False, True, True, False, False)
    both = bench.new_authority(IS_CA, (usage, True))
    for role in ("identity", "permissions"):
        bench.adopt(role, both)
    own_signature(bench)


def own_signature(bench: Bench) -> None:
    """Have an enclave sign its own permissions, with what it says in them now."""
    path = bench.path("enclaves/base/permissions.p7s")
    key = load_key(bench.path("enclaves/base/key.pem").read_bytes(), "key.pem")
    document = bench.document("enclaves/base/permissions.p7s").encode()
    path.write_bytes(smime.sign(document, bench.certificate(), key))


@case("enclave.key-twice")
def _(bench: Bench) -> None:
    on_token(bench, "object=base")
    shutil.copy(bench.path("enclaves/arm/key.pem"), bench.path("enclaves/base"))


@case("zenoh.key-on-token")
def _(bench: Bench) -> None:
    on_token(bench, "object=base")
    bench.path("enclaves/base/session.json5").write_text("{}")


@case("enclave.permissions-domain")
def _(bench: Bench) -> None:
    bench.permissions(("<id>0</id>", "<id>5</id>"))
    bench.options["domain"] = 0


@case("enclave.permissions-local-time")
def _(bench: Bench) -> None:
    at(bench, -1 + 0.2)
    bench.options["zone"] = timezone(timedelta(hours=-8))


@case("enclave.crl-usage")
def _(bench: Bench) -> None:
    usage = x509.KeyUsage(False, False, False, False, False, True, False, False, False)
    is_ca = (x509.BasicConstraints(True, None), True)
    bench.adopt("identity", bench.new_authority(is_ca, (usage, True)))
    bench.revoke()


def _tamper(bench: Bench, file: str) -> None:
    data = bench.path(file).read_bytes()
    assert b"rosout" in data
    bench.path(file).write_bytes(data.replace(b"rosout", b"rosoot"))


# ── enclaves ───────────────────────────────────────────────────────────────────────────────

CASES |= {
    "enclave.ends-soon": lambda b: at(b, 151),
    "enclave.outlives-ca": lambda b: b.issue(after=b.now + 9999 * DAY),
    "enclave.permissions-outlive": lambda b: b.issue(after=b.now + 40 * DAY),
    "enclave.name-mismatch": lambda b: b.issue(subject=name_of(("CN", "/other"), ("OU", "1f"))),
    "enclave.certificate-is-ca": lambda b: b.issue(is_ca=True),
    "enclave.subject-not-unique": lambda b: b.issue(subject=name_of(("CN", "/base"))),
    "keystore.allow-everything": lambda b: b.permissions(
        ("<topic>ros_discovery_info</topic>", "<topic>*</topic>")
    ),
    "enclave.any-node": lambda b: b.permissions(
        ("rr/base/set_parametersReply", "rr/*/set_parametersReply")
    ),
    "keystore.only-denials": lambda b: b.permissions(
        (ALLOW, DENY_ALL.replace("rt/*", "rt/stop") + ALLOW),
        ("<topic>ros_discovery_info</topic>", "<topic>*</topic>"),
    ),
    "enclave.node-cannot-start": lambda b: b.permissions(("rt/parameter_events", "rt/events")),
    "enclave.xml-differs": lambda b: b.permissions(("rosout", "rosoot"), xml=False),
    "enclave.crl-missing": lambda b: b.revoke(linked=False),
}


@case("enclave.long-permissions")
def _(bench: Bench) -> None:
    bench.issue(subject=name_of(("CN", "/base")), after=bench.now + 3000 * DAY)
    year = bench.now.year
    text = bench.document("enclaves/base/permissions.p7s")
    end = text[text.index("<not_after>") : text.index("</not_after>")]
    bench.permissions((end, f"<not_after>{year + 8}-01-01T00:00:00Z"))


@case("keystore.revocation-list-lacks")
def _(bench: Bench) -> None:
    """Whoever had a copy puts the files of a revoked enclave back, and the list from before."""
    words = ("create_enclave", "/gone", "/before"), ("revoke", "/before"), ("revoke", "/gone")
    for verb, *names in words:
        if names == ["/gone"]:
            kept = bench.root.with_name("kept")
            shutil.copytree(bench.root, kept, symlinks=True)
        sros(verb, bench.root, *names, env={"SROS_CA_PASSPHRASE": SECRET}).ok()
    shutil.copytree(kept / "enclaves/gone", bench.path("enclaves/gone"), symlinks=True)
    shutil.copy(kept / "public/identity_ca.crl.pem", bench.path("public/identity_ca.crl.pem"))


@case("enclave.crl-older", "keystore.enclave-revoked")
def _(bench: Bench) -> None:
    """A robot got all enclaves; /gone was revoked, and of the others one was exported again."""
    bench.checked = bench.root.with_name("robot")
    for line in (
        "create_enclave KEYSTORE /gone /kept",
        "distribute_key KEYSTORE --all ROBOT",
        "revoke KEYSTORE /gone",
        "distribute_key KEYSTORE /base ROBOT --force",
    ):
        line = line.replace("KEYSTORE", str(bench.root)).replace("ROBOT", str(bench.checked))
        words = line.split()
        sros(*words, env={"SROS_CA_PASSPHRASE": SECRET}).ok()


@case("enclave.waits-for-answer")
def _(bench: Bench) -> None:
    folder = bench.path("enclaves/new")
    folder.mkdir(mode=0o700)
    shutil.copy(bench.path("enclaves/base/key.pem"), folder / "key.pem")
    (folder / "request.pem").write_text("a request")


# ── permissions documents ──────────────────────────────────────────────────────────────────

ALLOW = "      <allow_rule>"
DENY_ALL = """      <deny_rule>
        <domains><id>0</id></domains>
        <publish><topics><topic>rt/*</topic></topics></publish>
      </deny_rule>
"""
LEFT = "<partitions><partition>left</partition></partitions>"
SECOND = """      <allow_rule>
        <domains><id>0</id></domains>
        <publish><topics><topic>rt/extra</topic></topics></publish>
      </allow_rule>
      <default>"""


def _second_grant(text: str) -> str:
    begin, end = text.index("    <grant"), text.index("</grant>") + len("</grant>\n")
    return text[:end] + text[begin:end] + text[end:]


def _many_topics(text: str) -> str:
    topics = "".join(f"<topic>rt/{'long_' * 8}{index}</topic>" for index in range(1500))
    return text.replace("<topics>", f"<topics>{topics}", 1)


def names_of_dds(text: str) -> str:
    """Permissions with a name that is not of ROS in place of every name."""
    return re.sub(r"<topic>[^<]*<", "<topic>Square<", text)


def names_in_capitals(bench: Bench) -> None:
    """Another enclave of the same robot has the same name with a capital."""
    bench.permissions(("rt/status<", "rt/Status<"))
    bench.export()


def _fewer_domains(bench: Bench) -> None:
    bench.options["on_robot"] = True
    bench.governance(("<id>0</id>", "<id>0</id><id>1</id>"))


CASES |= {
    "portable.several-grants": lambda b: b.sign("enclaves/base/permissions.p7s", _second_grant),
    "portable.default-allow": lambda b: b.permissions(("<default>DENY", "<default>ALLOW")),
    "portable.several-allow-rules": lambda b: b.permissions(("      <default>", SECOND)),
    "portable.partitions": lambda b: b.permissions(
        ("      <default>", SECOND.replace("</topics>", f"</topics>{LEFT}"))
    ),
    "portable.default-first": lambda b: b.permissions(
        ("      <default>DENY</default>\n", ""),
        (ALLOW, f"      <default>DENY</default>\n{ALLOW}"),
    ),
    "portable.domain-range": lambda b: b.permissions(
        ("<id>0</id>", "<id_range><min>0</min></id_range>")
    ),
    "portable.grant-name": lambda b: b.permissions(('<grant name="/base">', "<grant>")),
    "portable.subject": lambda b: b.permissions(("CN=/base", "CN = /base")),
    "portable.time-format": lambda b: b.permissions(("Z</not_after>", "+00:00</not_after>")),
    "portable.validity-window": lambda b: at(b, -1 + 0.4),
    "portable.character-class": lambda b: b.permissions(("rt/rosout<", "rt/[^a]osout<")),
    "portable.blanks": lambda b: b.permissions(("rt/rosout<", " rt/rosout<")),
    "portable.empty-topic": lambda b: b.permissions(("rt/rosout<", "<")),
    "portable.character-set": lambda b: b.permissions(("rt/rosout<", "rt/[rs]osout<")),
    "portable.long-name": lambda b: b.permissions(("rt/rosout<", f"rt/{'n' * 249}<")),
    "portable.document-size": lambda b: b.sign("enclaves/base/permissions.p7s", _many_topics),
    "portable.deny-blocks-topic": lambda b: b.permissions(
        (ALLOW, DENY_ALL.replace("publish", "subscribe").replace("rt/*", "rt/rosout") + ALLOW)
    ),
    "permissions.deny-without-effect": lambda b: b.permissions(
        ("      <default>", DENY_ALL + "      <default>")
    ),
    "permissions.unreachable-rule": lambda b: b.permissions(
        (ALLOW, DENY_ALL.replace("rt/*", "rt/s*") + ALLOW)
    ),
    "permissions.no-ros-name": lambda b: b.permissions(("rt/status<", "status<")),
    "permissions.not-for-ros": lambda b: b.sign(
        "enclaves/base/permissions.p7s",
        lambda text: re.sub(r"<topic>[^<]*<", "<topic>Square<", text),
    ),
    "permissions.only-capitals-differ": names_in_capitals,
    "permissions.relay-only": lambda b: b.permissions(
        ("      <default>", SECOND.replace("publish>", "relay>"))
    ),
    "enclave.permissions-domains": lambda b: b.permissions(("<id>0</id>", "<id>0</id><id>1</id>")),
    "enclave.fewer-domains": _fewer_domains,
    "enclave.refused": lambda b: b.governance(
        ("data_protection_kind>ENCRYPT", "data_protection_kind>ENCRYPT_WITH_ORIGIN_AUTHENTICATION")
    ),
    "portable.refused": lambda b: b.permissions(("<id>0</id>", "<id><!-- -->0</id>")),
    "portable.vendors-differ": lambda b: b.permissions(("<default>DENY", "<default>ALLOW")),
}

# ── governance ─────────────────────────────────────────────────────────────────────────────

TOPIC_RULE = "          <topic_expression>*</topic_expression>"


def _narrow_rule_last(text: str) -> str:
    begin = text.index("        <topic_rule>")
    end = text.index("</topic_rule>") + len("</topic_rule>\n")
    rule = text[begin:end].replace("<topic_expression>*<", "<topic_expression>rt/a<")
    return text[:end] + rule + text[end:]


def _topic_rules_of_ros(text: str) -> str:
    begin = text.index("        <topic_rule>")
    end = text.index("</topic_rule>") + len("</topic_rule>\n")
    rules = [
        text[begin:end].replace("<topic_expression>*<", f"<topic_expression>{each}<")
        for each in ("ros_discovery_info", "rt/*", "rq/*", "rr/*")
    ]
    return text[:begin] + "".join(rules) + text[end:]


def unauthenticated_on_fast_dds_2_9(bench: Bench) -> None:
    bench.options["vendors"] = ("fastdds-2.9",)
    bench.governance(("participants>false", "participants>true"))


CASES |= {
    "governance.unauthenticated": lambda b: b.governance(
        ("participants>false", "participants>true")
    ),
    "governance.unauthenticated-kept-out": unauthenticated_on_fast_dds_2_9,
    "governance.no-join-control": lambda b: b.governance(
        ("join_access_control>true", "join_access_control>false")
    ),
    "governance.no-access-control": lambda b: b.governance(
        ("read_access_control>true", "read_access_control>false")
    ),
    "governance.no-encryption": lambda b: b.governance(("ENCRYPT", "SIGN")),
    "governance.signed-payload": lambda b: b.governance(
        ("<data_protection_kind>ENCRYPT", "<data_protection_kind>SIGN")
    ),
    "governance.no-authenticity": lambda b: b.governance(("ENCRYPT", "NONE")),
    "governance.discovery-open": lambda b: b.governance(
        ("<discovery_protection_kind>ENCRYPT", "<discovery_protection_kind>NONE")
    ),
    "governance.liveliness-open": lambda b: b.governance(
        ("<liveliness_protection_kind>ENCRYPT", "<liveliness_protection_kind>NONE")
    ),
    "governance.no-topic-rule": lambda b: b.governance(
        (TOPIC_RULE, TOPIC_RULE.replace(">*<", ">rt/*<"))
    ),
    "governance.only-ros-topics": lambda b: b.sign("enclaves/governance.p7s", _topic_rules_of_ros),
    "governance.unreachable-rule": lambda b: b.sign("enclaves/governance.p7s", _narrow_rule_last),
    "governance.domain-range": lambda b: b.governance(
        ("<id>0</id>", "<id_range><max>3</max></id_range>")
    ),
    "governance.open-range": lambda b: b.governance(
        ("<id>0</id>", "<id_range><min>0</min></id_range>")
    ),
    "governance.xml-differs": lambda b: b.path("enclaves/governance.xml").write_text("<dds/>"),
}


@case("governance.differs")
def _(bench: Bench) -> None:
    own = bench.path("enclaves/base/governance.p7s")
    data = own.read_bytes()
    bench.governance(("ENCRYPT", "SIGN"))
    own.unlink()
    own.write_bytes(data)


# ── the ledger, and policies ───────────────────────────────────────────────────────────────


@case("keystore.authorities-differ")
def _(bench: Bench) -> None:
    authority = bench.foreign()
    bench.issue("base", by=authority)
    path = bench.unlink("enclaves/base/identity_ca.cert.pem")
    path.write_bytes(pem(authority[0]))


@case("keystore.serial-twice")
def _(bench: Bench) -> None:
    bench.issue("base")
    bench.issue("arm")


@case("keystore.key-twice")
def _(bench: Bench) -> None:
    key = new_key()
    bench.issue("base", key=key, serial=1)
    bench.issue("arm", key=key, serial=2)


@case("keystore.older-than-robots")
def _(bench: Bench) -> None:
    ledger = bench.path("ledger.jsonl")
    lines = ledger.read_text().splitlines()
    time = json.loads(lines[-1])["time"]
    restored = {"time": time, "what": RESTORED, "number": 2, "reason": LATER_RELEASE}
    ledger.write_text("\n".join([*lines, json.dumps(restored)]) + "\n")


@case("keystore.robot-left")
def _(bench: Bench) -> None:
    bench.path("fleet.toml").write_text('enclaves = ["/{robot}"]\n[robots.r1]\n')
    ledger = bench.path("ledger.jsonl")
    left = {"time": json.loads(ledger.read_text().splitlines()[-1])["time"], "what": "left"}
    with ledger.open("a") as file:
        file.write(json.dumps(left | {"enclave": "/base", "reason": "base"}) + "\n")


@case("keystore.publication-unseen")
def _(bench: Bench) -> None:
    bench.path("published.json").write_text("damaged")


@case("enclave.old-permissions")
def _(bench: Bench) -> None:
    path = bench.path("enclaves/base/permissions.p7s")
    before = path.read_bytes()
    bench.permissions(("rosout", "rosoot"))
    ledger = bench.path("ledger.jsonl")
    lines = ledger.read_text().splitlines()
    old, new = (hashlib.sha256(data).hexdigest() for data in (before, path.read_bytes()))
    entry = next(line for line in lines if old in line)
    ledger.write_text("\n".join([*lines, entry.replace(old, new)]) + "\n")
    path.write_bytes(before)
    bench.path("enclaves/base/permissions.xml").write_text(
        bench.document("enclaves/base/permissions.p7s")
    )


@case("portable.enclave-names")
def _(bench: Bench) -> None:
    bench.issue("base", subject=name_of(("CN", "/base")))
    os.rename(bench.path("enclaves/arm"), bench.path("enclaves/base/arm"))
    for name, target in {
        "identity_ca.cert.pem": "../../../public/identity_ca.cert.pem",
        "permissions_ca.cert.pem": "../../../public/permissions_ca.cert.pem",
        "governance.p7s": "../../governance.p7s",
    }.items():
        bench.unlink(f"enclaves/base/arm/{name}").symlink_to(target)


def _policy(bench: Bench, *changes: tuple[str, str]) -> None:
    text = bench.root.with_name("policy.xml").read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    file = bench.root.with_name("changed.xml")
    file.write_text(text)
    bench.options["policies"] = (read_policy(file),)


def _policy_of_more_than_an_export(bench: Bench) -> None:
    shutil.rmtree(bench.export() / "enclaves/arm")
    _policy(bench)


def _demanding_policy(bench: Bench) -> None:
    _policy(bench, ("status</topic>", 'status<?sros protect="encrypt"?></topic>'))
    bench.governance(("ENCRYPT", "SIGN"))


CASES |= {
    "governance.less-than-policy": _demanding_policy,
    "keystore.not-in-ledger": lambda b: b.issue(),
    "enclave.stale-permissions": lambda b: _policy(b, ("status", "state")),
    "enclave.not-in-policy": lambda b: _policy(b, ('path="/arm"', 'path="/other"')),
    "keystore.not-in-export": _policy_of_more_than_an_export,
    "keystore.enclave-missing": lambda b: _policy(b, ('path="/arm"', 'path="/other"')),
}


# ── Zenoh ──────────────────────────────────────────────────────────────────────────────────

_SESSION, _SIGNED = "enclaves/base/session.json5", "enclaves/base/session.p7s"


def with_zenoh(bench: Bench) -> Path:
    """Give the keystore a Zenoh network, and return the configuration of an enclave."""
    sros("zenoh", bench.root, env={"SROS_CA_PASSPHRASE": SECRET}).ok()
    return bench.path(_SESSION)


@case("zenoh.missing")
def _(bench: Bench) -> None:
    with_zenoh(bench).unlink()


@case("zenoh.unsigned")
def _(bench: Bench) -> None:
    with_zenoh(bench)
    bench.path(_SIGNED).unlink()


@case("zenoh.other-document")
def _(bench: Bench) -> None:
    document = with_zenoh(bench)
    document.write_bytes(document.read_bytes().replace(b"deny", b"allow"))


@case("zenoh.out-of-date")
def _(bench: Bench) -> None:
    with_zenoh(bench)
    for file in (_SESSION, _SIGNED):
        shutil.copy(bench.path(file.replace("base", "arm")), bench.path(file))


@case("zenoh.left-over")
def _(bench: Bench) -> None:
    with_zenoh(bench)
    for file in (_SESSION, _SIGNED):
        shutil.copy(bench.path(file), bench.path(file.replace("base", "router")))


@case("zenoh.left-out")
def _(bench: Bench) -> None:
    with_zenoh(bench)
    bench.path("enclaves/base/permissions.p7s").unlink()


@case("zenoh.other-domain")
def _(bench: Bench) -> None:
    fleet, policy = bench.root.with_name("fleet.toml"), bench.root.with_name("fleet.xml")
    fleet.write_text("[robots]\nbase = { domain = 0 }\narm = { domain = 5 }\n")
    policy.write_text(policy_text({"/{robot}": publish("status")}))
    for words in (
        ("update_keystore", bench.root, "--domain", "0,5", "--allow-looser"),
        ("generate_artifacts", "-k", bench.root, "-p", policy, "--fleet", fleet),
        ("zenoh", bench.root, "--domain", "5"),
    ):
        sros(*words, env={"SROS_CA_PASSPHRASE": SECRET}).ok()


@case("zenoh.shared-node")
def _(bench: Bench) -> None:
    with_zenoh(bench)
    # Without a policy, each may be any node.
    sros("create_enclave", bench.root, "/one", "/two", env={"SROS_CA_PASSPHRASE": SECRET}).ok()


@case("zenoh.cannot-be-made")
def _(bench: Bench) -> None:
    with_zenoh(bench)
    shutil.rmtree(bench.path("enclaves/router"))
