"""What renewing and revoking do to those who talk, asked of two DDS that enforce security."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import pytest

from sros_tool.dds.decision.vendors import Signers
from sros_tool.dds.domains import DomainSet
from sros_tool.keystore.issuing.keyring import Keyring
from sros_tool.keystore.layout import enclave_path
from sros_tool.keystore.lifecycle.create import create_enclaves, create_keystore, generate_artifacts
from sros_tool.keystore.lifecycle.renew import renew
from sros_tool.keystore.lifecycle.revoke import revoke
from sros_tool.keystore.template import Template, load_template
from sros_tool.pki.certificates import (
    Issuer,
    common_name,
    issue_ca,
    load_certificate,
    pem,
    validity_of,
)
from sros_tool.pki.keys import generate_key, key_pem
from sros_tool.policy.document import read_policy
from sros_tool.validity import window
from tests.integration.converse import ENOUGH, converse, listener, talker
from tests.integration.fastdds import build, fastdds_stack, fastdds_vendor, run_isolated_program
from tests.integration.kept.forms import form_of
from tests.integration.kept.replies import answered
from tests.integration.vendor_oracle import MATCH_SECONDS, cyclone_stack, cyclone_vendor
from tests.support.children import LATE, run
from tests.support.harness import certificate, copy_of, policy_text, publish
from tests.support.long_form import ONLY_LONG

pytestmark = pytest.mark.dds

DOMAIN = 121
HEARD, SILENT, REFUSED = "heard", "silent", "refused"
NOT_HEARD = f"{SILENT} or {REFUSED}"
ANY = f"{HEARD} or {NOT_HEARD}"


@dataclass(frozen=True)
class Question:
    """Whether an enclave of one keystore hears one of another on a topic."""

    talker: tuple[Path, str]
    listener: tuple[Path, str]
    topic: str = "/chatter"


Expected = Mapping[Question, str]
"""The answer to each question: heard, silent, refused (the talker, by its own DDS), or several."""

Ask = Callable[[Expected], None]
"""Asserts that these are the answers; those that are to be heard are waited for."""


# ── the two vendors ────────────────────────────────────────────────────────────────────────


def ask_cyclone(questions: Expected) -> list[str]:
    """Who hears whom on Cyclone DDS: the replies that are kept, and those to what is asked."""
    return kept_or_asked(cyclone_stack(), questions, converse_all)


def kept_or_asked(
    stack: str, questions: Expected, ask: Callable[[Expected], list[str]], domain: int = DOMAIN
) -> list[str]:
    """The answers; a kept reply that is not the expected one is asked for again."""
    now, listed = datetime.now(UTC), list(questions.items())

    def form(question: Question) -> str:
        folders = enclave_path(*question.talker), enclave_path(*question.listener)
        return f"{question.topic} {domain}\n{form_of(folders, now)}"

    replies = answered(
        stack,
        [form(question) for question, _ in listed],
        lambda places: [(each,) for each in ask(dict(listed[place] for place in places))],
        believe=lambda place, reply: reply[0] in listed[place][1].split(" or "),
    )
    return [reply for (reply,) in replies]


def converse_all(questions: Expected) -> list[str]:
    """All at once, each on a topic of its own: every node is a process."""
    nodes = []
    for number, (question, expected) in enumerate(questions.items()):
        text = f"text {number}"
        name, topic, hears = str(number), question.topic, expected == HEARD
        nodes.append(talker(*question.talker, f"talker {name}", topic=topic, text=text))
        nodes.append(listener(*question.listener, f"listener {name}", topic=topic, hears=hears))
    said = converse(DOMAIN, *nodes).nodes
    answers = []
    for number in range(len(questions)):
        talks, listens = said[f"talker {number}"], said[f"listener {number}"]
        assert "ready" in listens.kinds, listens
        if talks.sent == 0:
            assert talks.kinds == ["refused"], talks
            answers.append(REFUSED)
        else:
            assert talks.sent >= ENOUGH, talks
            answers.append(HEARD if f"text {number}" in str(listens.heard) else SILENT)
    return answers


@pytest.fixture(scope="session")
def probe(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The program that asks Fast DDS."""
    return build("fastdds_oracle.cpp", tmp_path_factory.mktemp("probe"))


def ask_fast(program: Path, questions: Expected, domain: int = DOMAIN) -> list[str]:
    """Who hears whom on Fast DDS: the replies that are kept, and those to what is asked."""
    return kept_or_asked(
        fastdds_stack(), questions, lambda some: probe_all(program, some, domain), domain
    )


def probe_all(program: Path, questions: Expected, domain: int) -> list[str]:
    """One after the other; who is not heard at once gets longer if that is what is expected."""
    lines = [
        f"{enclave_path(*question.talker)} {enclave_path(*question.listener)} rt{question.topic} "
        f"{LATE if expected == HEARD else MATCH_SECONDS}\n"
        for question, expected in questions.items()
    ]
    done = run_isolated_program(program, domain, said="".join(lines))
    answers = done.stdout.splitlines()
    assert len(answers) == len(questions), done
    assert not [answer for answer in answers if answer.startswith("reader")], answers
    return [REFUSED if answer.startswith("writer") else answer for answer in answers]


@pytest.fixture(params=["Cyclone DDS", "Fast DDS"])
def ask(request: pytest.FixtureRequest) -> Ask:
    if request.param == "Cyclone DDS":
        return lambda questions: compare(questions, ask_cyclone(questions))
    program: Path = request.getfixturevalue("probe")
    return lambda questions: compare(questions, ask_fast(program, questions))


def compare(questions: Expected, answers: Sequence[str]) -> None:
    wrong = [
        f"{question}: {answer}, and not {expected}"
        for (question, expected), answer in zip(questions.items(), answers, strict=True)
        if answer not in expected.split(" or ")
    ]
    assert not wrong, "\n".join(wrong)


# ── what is asked ──────────────────────────────────────────────────────────────────────────


def open_template(name: str) -> Template:
    """A template in which an enclave without a policy may do everything."""
    return replace(load_template(name), default_permissions="everything")


def make(root: Path, template: Template, policies: dict[str, str], *names: str) -> None:
    now = datetime.now(UTC)
    create_keystore(root, template=template, domains=DomainSet.of((DOMAIN, DOMAIN)), now=now)
    create_enclaves(root, names, now=now)
    permit(root, policies)


def permit(root: Path, policies: dict[str, str]) -> None:
    file = root.with_suffix(".xml")
    file.write_text(policy_text(policies))
    if policies:
        generate_artifacts(root, policies=[read_policy(file)], now=datetime.now(UTC))


def copy(root: Path, name: str) -> Path:
    return copy_of(root, root.with_name(name))


@pytest.mark.parametrize("template", [pytest.param("development", marks=ONLY_LONG), "production"])
def test_a_renewed_enclave_talks_with_one_not_yet_renewed(
    template: str, ask: Ask, tmp_path: Path
) -> None:
    root = tmp_path / "ks"
    make(root, open_template(template), {}, "/old", "/same", "/new")
    before = {name: (enclave_path(root, name) / "cert.pem").read_bytes() for name in ("/old",)}
    renew(root, ["/same"], now=datetime.now(UTC))
    renew(root, ["/new"], now=datetime.now(UTC), new_key=True)
    assert (enclave_path(root, "/old") / "cert.pem").read_bytes() == before["/old"]
    pairs = [("/same", "/old"), ("/old", "/same"), ("/new", "/old"), ("/old", "/new")]
    ask(
        {
            Question((root, one), (root, other), f"/topic{number}"): HEARD
            for number, (one, other) in enumerate(pairs)
        }
    )


@pytest.mark.parametrize("template", [pytest.param("development", marks=ONLY_LONG), "production"])
def test_a_revoked_enclave_is_no_longer_heard(template: str, ask: Ask, tmp_path: Path) -> None:
    """Neither with its last certificate nor with an earlier one; one made anew is."""
    root = tmp_path / "ks"
    make(root, open_template(template), {}, "/bad", "/good", "/listener")
    first = copy(root, "first")
    renew(root, ["/bad"], now=datetime.now(UTC))
    last = copy(root, "last")

    def to_listener(who: tuple[Path, str], topic: str) -> Question:
        return Question(who, (root, "/listener"), topic)

    stolen = [to_listener((first, "/bad"), "/first"), to_listener((last, "/bad"), "/last")]
    good = to_listener((root, "/good"), "/good")
    ask({good: HEARD, **dict.fromkeys(stolen, HEARD)})
    revoke(root, ["/bad"], now=datetime.now(UTC))
    create_enclaves(root, ["/bad"], now=datetime.now(UTC))
    again = to_listener((root, "/bad"), "/again")
    ask({good: HEARD, again: HEARD, **dict.fromkeys(stolen, SILENT)})


@pytest.mark.parametrize(
    ("template", "expected"), [("development", HEARD), ("production", REFUSED)]
)
def test_old_permissions_put_back(template: str, expected: str, ask: Ask, tmp_path: Path) -> None:
    """sros2#275: without a unique subject they are as good as new."""
    root = tmp_path / "ks"
    policies = {"/robot": publish("/secret", "/chatter"), "/listener": LISTENS}
    make(root, load_template(template), policies)
    old = (enclave_path(root, "/robot") / "permissions.p7s").read_bytes()
    permit(root, {"/robot": publish("/chatter")})
    renew(root, ["/robot"], now=datetime.now(UTC))
    rogue = copy(root, "rogue")
    (enclave_path(rogue, "/robot") / "permissions.p7s").write_bytes(old)
    ask(
        {
            Question((rogue, "/robot"), (root, "/listener"), "/secret"): expected,
            Question((root, "/robot"), (root, "/listener"), "/secret"): REFUSED,
            Question((root, "/robot"), (root, "/listener"), "/chatter"): HEARD,
        }
    )


LISTENS = (
    '<topics subscribe="ALLOW"><topic>/secret</topic><topic>/chatter</topic></topics>'
    '<topics publish="ALLOW"><topic>/other</topic></topics>'
)


@pytest.mark.parametrize("unique", [False, True])
def test_borrowed_permissions(
    unique: bool, ask: Ask, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    """Cyclone DDS compares parts of names, so those of /robot/admin fit /robot."""
    root = tmp_path / "ks"
    template = replace(load_template("production"), unique_subject=unique)
    policies = {
        "/robot": publish("/chatter"),
        "/robot/admin": publish("/secret"),
        "/listener": LISTENS,
    }
    make(root, template, policies)
    rogue = copy(root, "rogue")
    shutil.copy(
        enclave_path(root, "/robot/admin") / "permissions.p7s",
        enclave_path(rogue, "/robot") / "permissions.p7s",
    )
    cyclone = "Cyclone" in request.node.callspec.params["ask"]
    borrowed = HEARD if cyclone and not unique else REFUSED
    ask(
        {
            Question((rogue, "/robot"), (root, "/listener"), "/secret"): borrowed,
            Question((root, "/robot/admin"), (root, "/listener"), "/secret"): HEARD,
            Question((root, "/robot"), (root, "/listener"), "/chatter"): HEARD,
        }
    )


@pytest.mark.parametrize("template", ["sros2", "production"])
def test_permissions_signed_by_the_enclave_itself(
    template: str, ask: Ask, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    """Cyclone DDS 0.10.2 and Fast DDS 2.9.1 accept any signer below the permissions CA.

    With one CA for both jobs that is every enclave.  Fast DDS 2.14 accepts the CA itself only.
    """
    cyclone = request.node.callspec.params["ask"] == "Cyclone DDS"
    vendor = cyclone_vendor() if cyclone else fastdds_vendor()
    any_signer = vendor.traits.signers is Signers.CHAIN
    expected = HEARD if template == "sros2" and any_signer else REFUSED
    root = tmp_path / "ks"
    make(root, load_template(template), {"/robot": publish("/chatter"), "/listener": LISTENS})
    rogue = copy(root, "rogue")
    folder = enclave_path(rogue, "/robot")
    wanted = tmp_path / "wanted.xml"
    text = (folder / "permissions.xml").read_text()
    assert "rt/chatter" in text
    wanted.write_text(text.replace("rt/chatter", "rt/secret"))
    (folder / "permissions.p7s").unlink()
    signer = ["-signer", folder / "cert.pem", "-inkey", folder / "key.pem"]
    command = ["smime", "-sign", "-text", "-in", wanted, "-out", folder / "permissions.p7s"]
    run(["openssl", *command, *signer])
    ask(
        {
            Question((rogue, "/robot"), (root, "/listener"), "/secret"): expected,
            Question((root, "/robot"), (root, "/listener"), "/chatter"): HEARD,
        }
    )


@pytest.mark.parametrize(
    "ask", ["Cyclone DDS", pytest.param("Fast DDS", marks=ONLY_LONG)], indirect=True
)
def test_sites_with_one_identity_ca_are_apart_by_their_permissions_cas(
    ask: Ask, tmp_path: Path
) -> None:
    """Berlin and Kyoto each have their own permissions CA; Hamburg has that of Berlin."""
    now, template = datetime.now(UTC), open_template("production")
    key = generate_key()
    (tmp_path / "office.key").write_bytes(key_pem(key))
    office = pem(issue_ca(key, common_name("office"), window(now, template.authority_validity)))
    berlin, kyoto, hamburg = (tmp_path / name for name in ("berlin", "kyoto", "hamburg"))
    for root in (berlin, kyoto, hamburg):
        places, imported = {"identity": f"file:{tmp_path}/office.key"}, {"identity": office}
        if root is hamburg:
            places["permissions"] = f"file:{berlin}/private/permissions_ca.key.pem"
            imported["permissions"] = (berlin / "public/permissions_ca.cert.pem").read_bytes()
        create_keystore(
            root,
            template=template,
            domains=DomainSet.of((DOMAIN, DOMAIN)),
            now=now,
            keyring=Keyring(places=places),
            imported_cas=imported,
        )
        create_enclaves(root, [f"/{root.name}/talker", f"/{root.name}/listener"], now=now)
    # Whoever gets a certificate of the office for any name can show that robot's permissions.
    forged = copy(berlin, "forged")
    folder, forged_key = forged / "enclaves/berlin/talker", generate_key()
    earlier = certificate(folder / "cert.pem")
    (folder / "key.pem").write_bytes(key_pem(forged_key))
    issuer = Issuer(load_certificate(office, "of the office"), key)
    made = issuer.issue(earlier.subject, forged_key.public_key(), validity_of(earlier))
    (folder / "cert.pem").write_bytes(pem(made))
    ask(
        {
            Question((one, f"/{one.name}/talker"), (other, f"/{other.name}/listener")): expected
            for one, other, expected in (
                (kyoto, kyoto, HEARD),
                (berlin, hamburg, HEARD),
                (berlin, kyoto, SILENT),
            )
        }
        | {Question((forged, "/berlin/talker"), (berlin, "/berlin/listener")): HEARD}
    )
