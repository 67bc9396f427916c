"""Who talks with whom while a keystore changes, asked of two DDS that enforce security."""

from __future__ import annotations

import shutil
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path

import pytest

from sros_tool.dds.decision.vendors import Signers
from sros_tool.dds.domains import DomainSet
from sros_tool.keystore.comparison import mismatch
from sros_tool.keystore.layout import enclave_path
from sros_tool.keystore.lifecycle.create import create_enclaves, create_keystore, generate_artifacts
from sros_tool.keystore.lifecycle.rotate import rotate_ca
from sros_tool.keystore.lifecycle.update import update_keystore
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.settings import present_settings
from sros_tool.keystore.template import NamedValues, load_template, with_values
from sros_tool.pki import smime
from sros_tool.pki.certificates import load_certificate
from sros_tool.pki.keys import load_key
from sros_tool.policy.document import read_policy
from tests.integration.fastdds import fastdds_vendor
from tests.integration.test_life_on_dds import (
    DOMAIN,
    HEARD,
    NOT_HEARD,
    REFUSED,
    SILENT,
    Ask,
    Question,
    ask,
    ask_fast,
    compare,
    copy,
    probe,
)
from tests.integration.test_rotate_on_dds import ALL, TOGETHER, restarts
from tests.integration.test_rotate_on_dds import DOMAIN as LIVE
from tests.support.harness import policy_text
from tests.support.long_form import ONLY_LONG

__all__ = ["ask", "probe"]

pytestmark = pytest.mark.dds

POLICY = policy_text(
    {
        f"/{role}": f'<{kind} {right}="ALLOW"><{item}>{name}</{item}></{kind}>'
        for role, kind, right, item, name in (
            ("talker", "topics", "publish", "topic", "/*"),
            ("listener", "topics", "subscribe", "topic", "/*"),
            ("server", "services", "reply", "service", "/*"),
            ("client", "services", "request", "service", "/*"),
        )
    }
)


def make(root: Path, template: str, domain: int = DOMAIN) -> Path:
    """A keystore with a policy for four enclaves, and none for /free."""
    now = datetime.now(UTC)
    domains = DomainSet.of((domain, domain))
    create_keystore(root, template=load_template(template), domains=domains, now=now)
    file = root.with_suffix(".xml")
    file.write_text(POLICY)
    generate_artifacts(root, policies=[read_policy(file)], now=now)
    create_enclaves(root, ["/free"], now=now)
    return root


# ── what does not communicate while only one process has the new governance ────────────────

CAMERA = NamedValues("topic", "/camera", (("data", "NONE"), ("metadata", "SIGN")))
CHANGES: dict[str, tuple[list[tuple[str, str]], list[NamedValues], int | None, str, str]] = {
    # values, rules, another domain, the topic that is asked, and what comes of it
    "messages": ([("protection.rtps", "ENCRYPT")], [], None, "/a", SILENT),
    "discovery": ([("protection.discovery", "SIGN")], [], None, "/b", SILENT),
    "every topic": ([("protection.default.data", "NONE")], [], None, "/c", SILENT),
    "one topic": ([], [CAMERA], None, "/camera", SILENT),
    "the others": ([], [CAMERA], None, "/d", HEARD),
    "joining": ([("protection.join_access_control", "false")], [], None, "/e", HEARD),
    "domains": ([], [], 7, "/f", HEARD),
}


def test_which_governance_disturbs(ask: Ask, tmp_path: Path) -> None:
    """As `mismatch` says, by which the verb says what to restart together."""
    root = make(tmp_path / "ks", "development")
    questions = {}
    for number, (values, rules, domain, topic, expected) in enumerate(CHANGES.values()):
        other = copy(root, f"other{number}")
        target = with_values(present_settings(OpenedKeystore(root)).settings, values, rules)
        domains = DomainSet.of((DOMAIN, DOMAIN), (domain, domain)) if domain else None
        update_keystore(other, target, domains, now=datetime.now(UTC), allow_looser=True)
        found = mismatch(OpenedKeystore(root).governance, OpenedKeystore(other).governance)
        disturbed = found.everything or f"topic {topic}" in found.names
        assert disturbed == (expected == SILENT)
        one, two = (root, other) if number % 2 else (other, root)
        questions[Question((one, "/talker"), (two, "/listener"), topic)] = expected
    ask(questions)


# ── the stages ─────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("template", "other"),
    [
        ("development", "production"),
        pytest.param("production", "development", marks=ONLY_LONG),
    ],
)
def test_the_stages_on_cyclone(template: str, other: str, tmp_path: Path) -> None:
    """Talker, listener, server and client: only the governance needs a common restart."""
    root = make(tmp_path / "ks", template, LIVE)
    restarts(root, {f"{other} credentials": ALL, f"{other} governance": TOGETHER})


def test_there_and_back_on_fast_dds(probe: Path, tmp_path: Path) -> None:
    """A process goes on with what it read, so one not yet restarted is one started with a copy."""
    root = make(tmp_path / "ks", "development")
    moments = [copy(root, "before")]
    for number, template in enumerate(("production", "production", "development", "development")):
        now = datetime.now(UTC)
        target = load_template(template)
        assert update_keystore(root, target, now=now, next_stage=True, allow_looser=True).done
        moments.append(copy(root, f"after{number}"))
    questions = {}
    for number, (one, other) in enumerate(pairwise(moments)):
        expected = SILENT if number % 2 else HEARD
        pairs = [(one, other, expected), (other, one, expected), (other, other, HEARD)]
        for talking, listening, answer in pairs:
            question = Question((talking, "/talker"), (listening, "/listener"))
            questions[question] = answer
    compare(questions, ask_fast(probe, questions))


# ── what is closed, and what still works ───────────────────────────────────────────────────


@pytest.mark.parametrize("revoke_old", [False, True])
def test_what_was_taken_away_works_until_it_is_revoked(
    revoke_old: bool, ask: Ask, tmp_path: Path
) -> None:
    """The files of before, with the new governance beside them, as somebody has who kept them."""
    root = make(tmp_path / "ks", "development")
    before = copy(root, "before")
    done = update_keystore(
        root, load_template("production"), now=datetime.now(UTC), revoke_old=revoke_old
    )
    assert (done.works_until is None) == revoke_old
    kept, mixed = copy(root, "kept"), copy(root, "mixed")
    for file in ("cert.pem", "permissions.p7s"):
        shutil.copy(enclave_path(before, "/free") / file, enclave_path(kept, "/free") / file)
    old = enclave_path(before, "/free") / "permissions.p7s"
    shutil.copy(old, enclave_path(mixed, "/free") / "permissions.p7s")
    if revoke_old:  # who kept the files has no reason to keep the list that revokes them
        (enclave_path(kept, "/free") / "crl.pem").unlink()
    listener = (root, "/listener")
    ask(
        {
            Question((root, "/talker"), listener, "/a"): HEARD,
            Question((root, "/free"), listener, "/b"): REFUSED,
            Question((before, "/free"), listener, "/c"): NOT_HEARD,  # another governance
            Question((kept, "/free"), listener, "/d"): SILENT if revoke_old else HEARD,
            # The permissions of before do not fit the new certificate.
            Question((mixed, "/free"), listener, "/e"): REFUSED,
        }
    )


def test_one_ca_becomes_two(ask: Ask, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    """In files of their own first, which DDS does not notice, and then by a rotation of one."""
    cyclone = request.node.callspec.params["ask"] == "Cyclone DDS"
    root = make(tmp_path / "ks", "sros2")
    moments = [copy(root, "before")]
    target = with_values(load_template("sros2"), [("authorities.layout", "separate")])
    update_keystore(root, target, now=datetime.now(UTC))
    moments.append(copy(root, "parted"))
    for stage in ("distribute", "reissue", "retire"):
        rotate_ca(root, roles=["permissions"] * (stage == "distribute"), now=datetime.now(UTC))
        moments.append(copy(root, stage))
    questions = {}
    for number, (one, other) in enumerate(pairwise(moments)):
        # Cyclone DDS trusts one CA at a time: after reissue, all are restarted together.
        expected = SILENT if cyclone and other.name == "reissue" else HEARD
        questions[Question((one, "/talker"), (other, "/listener"), f"/a{number}")] = expected
        questions[Question((other, "/talker"), (one, "/listener"), f"/b{number}")] = expected
    ask(questions)
    rogues = [sign_itself(copy(moments[index], f"rogue{index}")) for index in (0, -1)]
    ask(
        {
            Question((rogues[0], "/free"), (moments[0], "/listener"), "/secret"): BY_ITSELF,
            Question((rogues[1], "/free"), (root, "/listener"), "/secret"): REFUSED,
            Question((root, "/talker"), (root, "/listener"), "/secret"): HEARD,
        }
    )


BY_ITSELF = HEARD if fastdds_vendor().traits.signers is Signers.CHAIN else f"{HEARD} or {REFUSED}"
"""Fast DDS 2.14 accepts no other signer than the permissions CA, even if there is one CA."""


def sign_itself(root: Path) -> Path:
    """Let the enclave /free sign permissions for itself: everything, as it had."""
    folder = enclave_path(root, "/free")
    document = (folder / "permissions.xml").read_bytes()
    certificate, key = (
        (folder / "cert.pem").read_bytes(),
        (folder / "key.pem").read_bytes(),
    )
    message = smime.sign(document, load_certificate(certificate, ""), load_key(key, ""))
    (folder / "permissions.p7s").write_bytes(message)
    return root
