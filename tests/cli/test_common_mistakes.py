"""The commonest mistakes of beginners: the answer is short, and fixes the mistake."""

from __future__ import annotations

import re
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.harness import policy_text, publish, sros

ENOUGH = 60
"""The most words of an answer, without the lines of XML that it says to copy."""
INCLUDE = (
    '<xi:include xmlns:xi="http://www.w3.org/2001/XInclude" href="common/node.xml" '
    'xpointer="xpointer(/profile/*)"/>'
)


def with_common(policy: str) -> str:
    """Return a policy with the common part in each profile."""
    return re.sub(r"(<profile [^>]+>)", rf"\1{INCLUDE}", policy)


def words(text: str) -> int:
    """Return the number of words, without the lines of XML."""
    return sum(len(line.split()) for line in text.splitlines() if not line.strip().startswith("<"))


def fix(text: str, folder: Path) -> None:
    """Do what the answer says: save its XML as allow.xml, and run its commands."""
    if "allow.xml" in text:
        xml = [line.strip() for line in text.splitlines() if line.strip().startswith("<")]
        (folder / "allow.xml").write_text("\n".join(xml))
    inline = re.findall(r"`((?:sros|chmod) [^`]+)`", text)
    lines = re.findall(r"^(?:  run)?\s+(sros .+)$", text, re.MULTILINE)
    for command in [*inline, *lines]:
        program, *rest = shlex.split(command.replace("POLICY", "policy.xml"))
        if program == "sros":
            sros(*rest, cwd=folder).ok()
        else:
            (folder / rest[1]).chmod(int(rest[0], 8))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    sros("policies", "--copy", "common", cwd=tmp_path).ok()
    rights = {"/robot/talker": publish("/chatter")}
    (tmp_path / "policy.xml").write_text(with_common(policy_text(rights)))
    sros("create_keystore", "ks", "--template", "production", cwd=tmp_path).ok()
    sros("generate_artifacts", "-k", "ks", "-p", "policy.xml", cwd=tmp_path).ok()
    return tmp_path


def answer(folder: Path, line: str) -> str:
    """Return what sros answers to a command line with a mistake."""
    done = sros(*shlex.split(line), cwd=folder)
    assert done.status in (1, 2), done
    text = done.out + done.err
    assert words(text) <= ENOUGH, f"{words(text)} words: {text}"
    return text


@pytest.mark.parametrize(
    ("line", "mistake"),
    [
        ("explain ks /robot/talker subscribe /chatter --vendor fastdds", lambda _folder: None),
        (
            "check keystore ks",
            lambda folder: (folder / "ks/enclaves/robot/talker/key.pem").chmod(0o644),
        ),
        ("check keystore ks", lambda folder: (folder / "ks/private").chmod(0o755)),
        ("env ks /robot/talker --domain 7", lambda _folder: None),
        ("env ks /camera", lambda _folder: None),
    ],
    ids=["denied", "open key", "open folder", "other domain", "no enclave"],
)
def test_a_mistake_is_mended_by_the_commands_of_its_answer(
    line: str, mistake: Callable[[Path], None], folder: Path
) -> None:
    mistake(folder)
    fix(answer(folder, line), folder)
    sros(*shlex.split(line), cwd=folder).ok()


@pytest.mark.parametrize(
    ("line", "right"),
    [
        ("env ks /robot/tlaker", "/robot/talker"),
        ("revoke ks /robot/talkr", "/robot/talker"),
        ("create_enclave ks camera", "/robot/camera"),
        ("renw ks --all", "renew"),
        ("explain ks /robot/talker publish /chater --vendor fastdds", "/chatter"),
        ("check misspelt.xml", "ALLOW or DENY"),
        ("verify ks", "`sros check ks`"),
    ],
)
def test_an_answer_says_what_was_meant(line: str, right: str, folder: Path) -> None:
    text = policy_text({"/a": publish("/x")}).replace("ALLOW", "ALOW")
    (folder / "misspelt.xml").write_text(text)
    assert right in answer(folder, line)


def test_nodes_without_the_common_part_get_it(folder: Path) -> None:
    shutil.rmtree(folder / "common")
    policy = folder / "six.xml"
    text = policy_text({f"/{name}": publish("/x") for name in "abcdef"})
    policy.write_text(re.sub(r'(path="/(.)".*?node=)"n"', r'\1"\2"', text))
    text = answer(folder, "check policy six.xml --severity error")
    fix(text, folder)
    assert INCLUDE in text
    policy.write_text(with_common(policy.read_text()))
    sros("check", "policy", "six.xml", "--severity", "error", cwd=folder).ok()
