"""What renewing and revoking do to those who talk, asked of two DDS that enforce security."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import pytest
from harness import policy_text, publish

from sros_tool.dds.domains import DomainSet
from sros_tool.keystore import create_enclaves, create_keystore, generate_artifacts
from sros_tool.keystore.enclave import enclave_path
from sros_tool.keystore.renew import renew
from sros_tool.keystore.revoke import revoke
from sros_tool.keystore.template import Template, load_template
from sros_tool.policy import read_policy
from sros_tool.runtime.netns import try_isolation

pytestmark = pytest.mark.dds

DOMAIN = 121
HEARD, SILENT, REFUSED = "heard", "silent", "refused"


@dataclass(frozen=True)
class Question:
    """Whether an enclave of one keystore hears one of another on a topic."""

    talker: tuple[Path, str]
    listener: tuple[Path, str]
    topic: str = "/chatter"


Ask = Callable[[Sequence[Question]], list[str]]
"""Answers each question with heard, silent, or refused (of the talker, by its own DDS)."""


# ── the two vendors ────────────────────────────────────────────────────────────────────────


def ask_cyclone(questions: Sequence[Question]) -> list[str]:
    """All at once, each on a topic of its own: every node is a process."""
    nodes = []
    for number, question in enumerate(questions):
        for role, (root, enclave) in (("talker", question.talker), ("listener", question.listener)):
            node = {"role": role, "name": f"{role} {number}", "text": f"text {number}"}
            nodes.append(
                {**node, "keystore": str(root), "enclave": enclave, "topic": question.topic}
            )
    script = Path(__file__).with_name("converse.py")
    done = subprocess.run(
        [sys.executable, str(script), str(DOMAIN)],
        input=json.dumps(nodes),
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    said = {node["name"]: node for node in json.loads(done.stdout)["nodes"]}
    answers = []
    for number in range(len(questions)):
        talker, listener = said[f"talker {number}"], said[f"listener {number}"]
        assert "ready" in listener["kinds"], listener
        if talker["sent"] == 0:
            assert talker["kinds"] == ["refused"], talker
            answers.append(REFUSED)
        else:
            assert talker["sent"] > 10, talker
            answers.append(HEARD if f"text {number}" in str(listener["heard"]) else SILENT)
    return answers


@pytest.fixture(scope="session")
def probe(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The program that asks Fast DDS."""
    if not shutil.which("g++") or not Path("/usr/include/fastdds").is_dir():
        pytest.skip("g++ and libfastrtps-dev are not installed")
    program = tmp_path_factory.mktemp("probe") / "fastdds_probe"
    source = Path(__file__).with_name("fastdds_probe.cpp")
    command = ["g++", "-std=c++17", "-O0", "-o", str(program), str(source), "-lfastrtps"]
    built = subprocess.run(command, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    return program


ISOLATED = """
import os, sys
from sros_tool.runtime.netns import enter_isolation
enter_isolation()
os.execv(sys.argv[1], sys.argv[1:])
"""


def ask_fast(program: Path, questions: Sequence[Question]) -> list[str]:
    lines = [
        f"{enclave_path(*question.talker)} {enclave_path(*question.listener)} rt{question.topic}"
        for question in questions
    ]
    command = [str(program), str(DOMAIN)]
    if try_isolation().isolated:
        command = [sys.executable, "-c", ISOLATED, *command]
    done = subprocess.run(
        command, input="\n".join(lines) + "\n", capture_output=True, text=True, timeout=120
    )
    answers = done.stdout.splitlines()
    assert len(answers) == len(questions), (done.returncode, answers, done.stderr)
    assert not [answer for answer in answers if answer.startswith("reader")], answers
    return [REFUSED if answer.startswith("writer") else answer for answer in answers]


@pytest.fixture(params=["Cyclone DDS", "Fast DDS"])
def ask(request: pytest.FixtureRequest) -> Ask:
    if request.param == "Cyclone DDS":
        return ask_cyclone
    program: Path = request.getfixturevalue("probe")
    return lambda questions: ask_fast(program, questions)


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
    return Path(shutil.copytree(root, root.with_name(name), symlinks=True))


@pytest.mark.parametrize("template", ["development", "production"])
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
    answers = ask(
        [
            Question((root, talker), (root, listener), f"/topic{number}")
            for number, (talker, listener) in enumerate(pairs)
        ]
    )
    assert dict(zip(pairs, answers, strict=True)) == dict.fromkeys(pairs, HEARD)


@pytest.mark.parametrize("template", ["development", "production"])
def test_a_revoked_enclave_is_no_longer_heard(template: str, ask: Ask, tmp_path: Path) -> None:
    """Neither with its last certificate nor with an earlier one; one made anew is."""
    root = tmp_path / "ks"
    make(root, open_template(template), {}, "/bad", "/good", "/listener")
    first = copy(root, "first")
    renew(root, ["/bad"], now=datetime.now(UTC))
    last = copy(root, "last")

    def answers(**talkers: tuple[Path, str]) -> dict[str, str]:
        questions = [
            Question(talker, (root, "/listener"), f"/{name}") for name, talker in talkers.items()
        ]
        return dict(zip(talkers, ask(questions), strict=True))

    stolen = {"first": (first, "/bad"), "last": (last, "/bad")}
    control = {"good": (root, "/good")}
    assert answers(**stolen, **control) == {"first": HEARD, "last": HEARD, "good": HEARD}
    revoke(root, ["/bad"], now=datetime.now(UTC))
    create_enclaves(root, ["/bad"], now=datetime.now(UTC))
    assert answers(**stolen, **control, again=(root, "/bad")) == {
        "first": SILENT,
        "last": SILENT,
        "good": HEARD,
        "again": HEARD,
    }


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
    answers = ask(
        [
            Question((rogue, "/robot"), (root, "/listener"), "/secret"),
            Question((root, "/robot"), (root, "/listener"), "/secret"),
            Question((root, "/robot"), (root, "/listener"), "/chatter"),
        ]
    )
    assert answers == [expected, REFUSED, HEARD]


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
    answers = ask(
        [
            Question((rogue, "/robot"), (root, "/listener"), "/secret"),
            Question((root, "/robot/admin"), (root, "/listener"), "/secret"),
            Question((root, "/robot"), (root, "/listener"), "/chatter"),
        ]
    )
    cyclone = "Cyclone" in request.node.callspec.params["ask"]
    assert answers == [HEARD if cyclone and not unique else REFUSED, HEARD, HEARD]


@pytest.mark.parametrize(("template", "expected"), [("sros2", HEARD), ("production", REFUSED)])
def test_permissions_signed_by_the_enclave_itself(
    template: str, expected: str, ask: Ask, tmp_path: Path
) -> None:
    """Cyclone DDS 0.10.2 and Fast DDS 2.9.1 accept any signer below the permissions CA.

    With one CA for both jobs that is every enclave.
    """
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
    subprocess.run(["openssl", *map(str, [*command, *signer])], check=True, capture_output=True)
    answers = ask(
        [
            Question((rogue, "/robot"), (root, "/listener"), "/secret"),
            Question((root, "/robot"), (root, "/listener"), "/chatter"),
        ]
    )
    assert answers == [expected, HEARD]
