"""``--match`` and ``--all`` of the verbs that take several enclaves."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.support.harness import policy_text, publish, snapshot, sros
from tests.support.long_form import some

ENCLAVES = ("/arm/gripper", "/arm/wrist", "/base")


@pytest.fixture
def ks(tmp_path: Path) -> Path:
    (tmp_path / "p.xml").write_text(policy_text({name: publish("x") for name in ENCLAVES}))
    sros("create_keystore", tmp_path / "ks", "--template", "production").ok()
    sros("generate_artifacts", "-k", tmp_path / "ks", "-p", tmp_path / "p.xml").ok()
    return tmp_path / "ks"


VERBS = {
    "renew {}": "renewed enclave ",
    "revoke {}": "revoked enclave ",
    "create_permission {} p.xml": "replaced the permissions of enclave ",
    "distribute_key {} robot": "exported enclave ",
}
CHOICES = {
    "--match /arm/*": ENCLAVES[:2],
    "--match /base --match *wrist": ("/base", "/arm/wrist"),
    "--match *": ENCLAVES,
    "--all": ENCLAVES,
    "/base --match /arm/*": ("/base", *ENCLAVES[:2]),
    "/arm/wrist --match /arm/*": ("/arm/wrist", "/arm/gripper"),
}


@pytest.mark.parametrize("choice", some(list(CHOICES), 3))
@pytest.mark.parametrize("verb", VERBS)
def test_the_chosen_enclaves_and_no_others_are_meant(verb: str, choice: str, ks: Path) -> None:
    words = verb.replace("{}", f"ks {choice}").split()
    (ks.parent / "p.xml").write_text(policy_text(dict.fromkeys(ENCLAVES, publish("other"))))
    ended = sros(*words, cwd=ks.parent).ok()
    said = [line for line in ended.out.splitlines() if line.startswith(VERBS[verb])]
    named = {line.removeprefix(VERBS[verb]).split()[0] for line in said}
    assert named == set(CHOICES[choice])
    assert len(said) == len(named)


def test_permissions_that_are_the_same_are_kept_unless_the_enclave_is_named(ks: Path) -> None:
    words = ("create_permission", "ks", "--match", "/arm/*", "p.xml")
    assert "unchanged: 2 enclaves: /arm/" in sros(*words, cwd=ks.parent).ok().err
    again = sros("create_permission", "ks", "/base", "p.xml", cwd=ks.parent).ok()
    assert again.out.startswith("signed the permissions of enclave /base again")


@pytest.mark.parametrize("verb", VERBS)
def test_a_pattern_that_matches_nothing_changes_nothing(verb: str, ks: Path) -> None:
    before = snapshot(ks.parent)
    ended = sros(*verb.replace("{}", "ks /base --match /leg/*").split(), cwd=ks.parent)
    assert ended.status == 2
    assert "no enclave of keystore 'ks' matches '/leg/*'" in ended.err
    assert snapshot(ks.parent) == before


@pytest.mark.parametrize("verb", ["renew {}", "revoke {}"])
def test_no_enclave_named_is_a_wrong_usage(verb: str, ks: Path) -> None:
    ended = sros(*verb.replace("{}", "ks").split(), cwd=ks.parent)
    assert ended.status == 2
    assert "--match PATTERN" in ended.err


def test_one_enclave_without_rights_in_the_policy_leaves_all_as_they_were(ks: Path) -> None:
    (ks.parent / "p.xml").write_text(policy_text({ENCLAVES[0]: publish("y")}))
    before = snapshot(ks)
    ended = sros("create_permission", "ks", "--all", "p.xml", cwd=ks.parent)
    assert ended.status
    assert ENCLAVES[1] in ended.err
    assert snapshot(ks) == before


def test_who_asks_the_matching_enclaves_only(ks: Path) -> None:
    ask = ("explain", "ks", "--who", "publish", "/x", "--json")
    everybody = json.loads(sros(*ask, cwd=ks.parent).ok().out)
    found = json.loads(sros(*ask, "--match", "/arm/*", cwd=ks.parent).ok().out)
    assert [each["enclave"] for each in everybody["enclaves"]] == list(ENCLAVES)
    assert [each["enclave"] for each in found["enclaves"]] == list(ENCLAVES[:2])
    ended = sros("explain", "ks", "/base", "publish", "/x", "--match", "*", cwd=ks.parent)
    assert ended.status == 2
    assert "--match goes with --who only" in ended.err


def test_verify_looks_at_the_matching_enclaves_only(ks: Path) -> None:
    sros("distribute_key", "ks", "--all", "robot", cwd=ks.parent).ok()
    (ks.parent / "robot/enclaves/base/cert.pem").write_text("damaged")
    assert sros("verify", "robot", cwd=ks.parent).status == 1
    found = sros("verify", "robot", "--match", "/arm/*", "--json", cwd=ks.parent).ok()
    assert [each["name"] for each in json.loads(found.out)["enclaves"]] == list(ENCLAVES[:2])
    assert sros("verify", "robot", "--match", "/base", cwd=ks.parent).status == 1
