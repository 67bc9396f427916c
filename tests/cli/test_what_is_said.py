"""What was taken away, or is still open, is said at once, with what ends it."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import pytest

from sros_tool.keystore.expiry import IF_EXPIRED
from sros_tool.keystore.layout import enclave_path
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.pki.certificates import validity_of
from tests.support.harness import (
    Ended,
    certificate,
    policy_text,
    publish,
    snapshot,
    sros,
    subscribe,
    topics_of,
)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A keystore in which /robot may publish /scan and /secret, and /free everything."""
    (tmp_path / "wide.xml").write_text(policy_text({"/robot": publish("/scan", "/secret")}))
    (tmp_path / "narrow.xml").write_text(policy_text({"/robot": publish("/scan")}))
    sros("generate_artifacts", "-k", "ks", "-e", "/free", "-p", "wide.xml", cwd=tmp_path).ok()
    return tmp_path / "ks"


def commands(text: str) -> list[list[str]]:
    """The commands that a text names."""
    return [shlex.split(each)[1:] for each in re.findall(r"`(sros [^`]+)`", text)]


TAKES_AWAY = {
    "create_permission": "create_permission ks /robot narrow.xml",
    "generate_artifacts": "generate_artifacts -k ks -p narrow.xml",
}
OLD_PROGRAM = "a program that still uses a lost right may fail to start with the new files"


@pytest.mark.parametrize("verb", TAKES_AWAY)
def test_what_still_works_after_taking_a_right_away(verb: str, root: Path) -> None:
    folder = enclave_path(root, "/robot")
    before = certificate(folder / "cert.pem")
    ended = sros(*TAKES_AWAY[verb].split(), cwd=root.parent).ok()
    assert "/robot loses: publish topic /secret" in ended.err
    (line,) = [each for each in ended.err.splitlines() if "it lost still work until" in each]
    assert f"{validity_of(before).not_after:%Y-%m-%d}" in line
    assert "have these rights until they are restarted" in line
    assert OLD_PROGRAM in ended.err
    # What it names as the remedy runs, and ends it.
    (command,) = commands(line)
    sros(*command, cwd=root.parent).ok()
    crl = OpenedKeystore(root).revocation_list
    assert crl
    assert before.serial_number in {each.serial for each in crl.revoked}
    assert certificate(folder / "cert.pem").subject != before.subject


@pytest.mark.parametrize("verb", TAKES_AWAY)
def test_taking_a_right_away_at_once(verb: str, root: Path) -> None:
    folder, free = (enclave_path(root, each) for each in ("/robot", "/free"))
    before, other = certificate(folder / "cert.pem"), certificate(free / "cert.pem")
    words = [*TAKES_AWAY[verb].split(), "--revoke-old"]
    state = snapshot(root)
    would = sros(*words, "--dry-run", cwd=root.parent).ok()
    assert snapshot(root) == state
    assert "/robot would lose: publish topic /secret" in would.err
    ended = sros(*words, cwd=root.parent).ok()
    assert "work until" not in ended.err
    assert "restart the processes of 2 enclaves" in ended.err
    crl = OpenedKeystore(root).revocation_list
    assert crl
    assert [each.serial for each in crl.revoked] == [before.serial_number]
    assert "rt/secret" not in topics_of(folder)
    assert certificate(folder / "cert.pem").subject != before.subject
    assert certificate(free / "cert.pem") == other
    no_node = ("--exclude", "enclave.node-cannot-start")
    assert sros("check", root, "--severity", "error", *no_node).status == 0
    # A renewal does not make the permissions of before fit again.
    sros("renew", root, "/robot").ok()
    assert certificate(folder / "cert.pem").subject != before.subject


def test_a_request_that_is_answered_with_less(root: Path) -> None:
    work = root.parent
    for name, topics in (("more", ("/scan", "/secret")), ("less", ("/scan",))):
        (work / f"{name}.xml").write_text(policy_text({"/remote": publish(*topics)}))
    sros("create_request", "/remote", "robot", cwd=work).ok()
    words = ("sign_request", "ks", "robot/enclaves/remote/request.pem", "--renew", "-p")
    first = [word for word in words if word != "--renew"]
    sros(*first, "more.xml", "-o", "one.tar.gz", cwd=work).ok()
    assert "rights-lost" not in sros(*words, "more.xml", "-o", "two.tar.gz", cwd=work).ok().err
    ended = sros(*words, "less.xml", "-o", "three.tar.gz", cwd=work).ok()
    (line,) = [each for each in ended.err.splitlines() if "rights-lost" in each]
    assert (
        "/remote loses: publish topic /secret. /remote: the rights that it lost still work until"
        in line
    )
    sros(*commands(line)[0], cwd=work).ok()


def test_processes_whose_files_have_expired_are_restarted_together(root: Path) -> None:
    renewed = sros("renew", root, "--all").ok()
    assert "before these files expire; if some of these files have expired, restart" in renewed.err
    for stage in ("--same-key", "--next", "--next", "--next"):
        assert IF_EXPIRED in sros("rotate_ca", root, stage).ok().err


def test_gaining_a_right_leaves_nothing_behind(root: Path) -> None:
    sros("create_permission", "ks", "/robot", "narrow.xml", cwd=root.parent).ok()
    ended = sros("create_permission", "ks", "/robot", "wide.xml", cwd=root.parent).ok()
    assert "/robot gains: publish topic /secret" in ended.err
    assert "work until" not in ended.err and OLD_PROGRAM not in ended.err


def test_a_denial_takes_a_right_away(root: Path) -> None:
    denied = '<topics publish="DENY"><topic>/secret</topic></topics>'
    (root.parent / "denied.xml").write_text(
        policy_text({"/robot": publish("/scan", "/secret") + denied})
    )
    words = ("create_permission", "ks", "/robot", "denied.xml")
    ended = sros(*words, cwd=root.parent).ok()
    assert "/robot loses: publish topic /secret (by a DENY)" in ended.err
    # A protective DENY of a name that was never allowed takes nothing away.
    also = denied.replace("/secret", "/*other")
    (root.parent / "denied.xml").write_text(
        policy_text({"/robot": publish("/scan", "/secret") + denied + also})
    )
    ended = sros(*words, cwd=root.parent).ok()
    assert "/robot" in ended.out and "loses" not in ended.err and "work until" not in ended.err
    (root.parent / "denied.xml").write_text(
        policy_text({"/robot": publish("/scan", "/secret") + also})
    )
    ended = sros(*words, cwd=root.parent).ok()
    gain = "/robot gains: publish topic /secret (where allowed: a DENY is gone)"
    assert gain in ended.err


# ── templates ──────────────────────────────────────────────────────────────────────────────


def generate(root: Path, template: str) -> Ended:
    words = ("generate_artifacts", "-k", root, "-e", "/new", "--template", template)
    return sros(*words, cwd=root.parent)


def test_another_template_for_an_existing_keystore_is_refused(root: Path) -> None:
    """It was ignored, so who named production had an open keystore."""
    before = snapshot(root)
    ended = generate(root, "production")
    assert ended.status == 2
    assert snapshot(root) == before
    assert "already exists, with the template development" in ended.err
    (command,) = commands(ended.err)
    sros(*command).ok()
    sros(*command[:-1]).ok()  # without --dry-run
    generate(root, "production").ok()
    assert generate(root, "development").status == 2


@pytest.mark.parametrize("same", ["development", "copy.toml"])
def test_its_own_template_is_accepted(same: str, root: Path) -> None:
    text = (root / "sros.toml").read_text()
    (root.parent / "copy.toml").write_text(text.replace('name = "development"', 'name = "mine"'))
    generate(root, same).ok()


def test_what_a_new_keystore_leaves_open_is_said(tmp_path: Path) -> None:
    ended = sros("generate_artifacts", "-k", tmp_path / "ks", "-e", "/a").ok()
    assert "still open: with the template development, an enclave without a policy" in ended.err
    (_, command) = commands(ended.err)
    sros(*command).ok()
    words = ("generate_artifacts", "-k", tmp_path / "other", "-e", "/a")
    assert "still open" not in sros(*words, "--template", "production").ok().err


def test_what_a_template_accepts_is_counted_and_fails_in_ci(tmp_path: Path) -> None:
    sros("generate_artifacts", "-k", tmp_path / "ks", "-e", "/a").ok()
    ended = sros("check", tmp_path / "ks")
    assert ended.status == 1
    assert "an enclave that may do everything [keystore.allow-everything]" in ended.out
    assert "1 warning, and 1 weakness that the template accepts (--strict counts it" in ended.err
    assert sros("check", tmp_path / "ks", "--strict").status == 1


def test_a_keystore_that_is_not_here_is_not_taken_for_the_word(tmp_path: Path) -> None:
    ended = sros("check", "keystore", cwd=tmp_path, env={"ROS_SECURITY_KEYSTORE": None})
    assert ended.status == 2
    assert "there is no folder 'keystore' here" in ended.err


def test_a_policy_without_the_common_part_says_how_to_get_it(tmp_path: Path) -> None:
    policy = tmp_path / "robot.xml"
    policy.write_text(
        '<policy version="0.2.0" xmlns:xi="http://www.w3.org/2001/XInclude"><enclaves>'
        '<enclave path="/a"><profiles><profile ns="/" node="a">'
        '<xi:include href="common/node.xml" xpointer="xpointer(/profile/*)"/>'
        "</profile></profiles></enclave></enclaves></policy>"
    )
    said = sros("check", policy).out
    assert f"`sros policies --copy {tmp_path}/common`" in said
    sros("policies", "--copy", tmp_path / "common").ok()
    assert sros("check", policy).status == 0


# ── small things that misled ───────────────────────────────────────────────────────────────


def test_a_keystore_with_another_number_is_no_typing_error(tmp_path: Path) -> None:
    sros("create_keystore", tmp_path / "ks").ok()
    sros("generate_artifacts", "-k", tmp_path / "ks2", "-e", "/a").ok()
    assert "typo" in sros("generate_artifacts", "-k", tmp_path / "kss", "-e", "/a").err
    sros("create_keystore", tmp_path / "arm2").ok()
    sros("generate_artifacts", "-k", tmp_path / "leg2", "-e", "/a").ok()


def test_what_is_asked_in_vain_names_what_to_ask(tmp_path: Path) -> None:
    policy = tmp_path / "p.xml"
    policy.write_text(policy_text({"/a": publish("/x")}))
    for verb in ("diff_policy", "view"):
        revision = sros(verb, "git:HEAD:p.xml", policy)
        assert revision.status == 2 and "works only with `sros diff_policy --no-new" in revision.err
    asked = ("/a", "publish", "/x", "--vendor", "zenoh")
    assert "after `sros generate_artifacts" in sros("explain", policy, *asked).err
    compared = ("diff_policy", "--no-new-access", "git:HEAD:p.xml", policy)
    outside = {"GIT_CEILING_DIRECTORIES": str(tmp_path.parent)}
    ended = sros(*compared, cwd=tmp_path, env=outside)
    assert "Start sros in a folder of the repository." in ended.err, ended
    for words, able in (("fleet status", "show the fleet"), ("agent run", "run the agent")):
        assert sros(*words.split(), tmp_path).err.startswith(f"Unable to {able}: ")
    policy.write_text("<policy><enclaves/></policy>")
    assert 'Write <policy version="0.2.0">.' in sros("check", "policy", policy).out


def test_nobody_is_advised_to_create_what_is_to_be_revoked(tmp_path: Path) -> None:
    sros("generate_artifacts", "-k", tmp_path / "ks", "-e", "/a").ok()
    said = sros("revoke", tmp_path / "ks", "/nope").err
    assert "create" not in said and "sros list_enclaves" in said


def test_the_router_that_sros_made_is_in_no_policy(tmp_path: Path) -> None:
    policy = tmp_path / "p.xml"
    policy.write_text(policy_text({"/a": publish("x")}))
    sros("generate_artifacts", "-k", "ks", "-p", policy, cwd=tmp_path).ok()
    sros("zenoh", "ks", cwd=tmp_path).ok()
    recipe = ("--include", "enclave.not-in-policy", "--fail-on", "note", "--policy", policy)
    sros("check", "ks", *recipe, cwd=tmp_path).ok()
    sros("create_enclave", "ks", "/other", cwd=tmp_path).ok()
    found = sros("check", "ks", *recipe, cwd=tmp_path)
    assert found.status == 1 and "/other" in found.out and "/router" not in found.out


def test_a_revocation_list_names_the_enclaves(tmp_path: Path) -> None:
    sros("generate_artifacts", "-k", tmp_path / "ks", "-e", "/a", "/b").ok()
    sros("revoke", tmp_path / "ks", "/b").ok()
    assert sros("crl", tmp_path / "ks").ok().out.splitlines()[1].endswith("  /b")
    (found,) = json.loads(sros("crl", tmp_path / "ks", "--json").ok().out)["revoked"]
    assert found["enclave"] == "/b"


@pytest.mark.parametrize(
    ("wrong", "fix"),
    [
        (("services reply", "services publish"), "It has request=, reply=."),
        (('version="0.2.0"', 'version="0.3.0"'), 'write version="0.2.0"'),
    ],
)
def test_a_policy_that_cannot_be_read_says_how_to_mend_it(
    wrong: tuple[str, str], fix: str, tmp_path: Path
) -> None:
    text = policy_text({"/a": '<services reply="ALLOW"><service>x</service></services>'})
    (tmp_path / "p.xml").write_text(text.replace(*wrong))
    assert fix in sros("check", tmp_path / "p.xml").out


def test_signing_says_which_counterpart_is_gone(tmp_path: Path) -> None:
    """Twins: the name moves to a new enclave, or a wildcard gives it."""
    ears = {"/ear": subscribe("/image"), "/all": publish("/map/*"), "/cam": publish("/map/a")}
    policies = {
        "whole": {**ears, "/cam": publish("/image", "/map/a")},
        "moved": {**ears, "/new": publish("/image")},
        "less": ears,
        "deny": {**ears, "/cam": publish("/image").replace("ALLOW", "DENY")},
        "wide": {**ears, "/all": publish("/*")},
    }
    for name, enclaves in policies.items():
        (tmp_path / f"{name}.xml").write_text(policy_text(enclaves))
    sign = ("generate_artifacts", "-k", "ks", "-p")
    sros(*sign, "whole.xml", cwd=tmp_path).ok()
    lost = (
        "note [permissions.no-counterpart]: /ear may subscribe /image, but no enclave may publish"
    )
    for words, said in (
        ((*sign, "less.xml", "--dry-run"), True),
        ((*sign, "deny.xml", "--dry-run"), True),
        ((*sign, "moved.xml", "--dry-run"), False),
        ((*sign, "wide.xml", "--dry-run"), False),
        (("create_permission", "ks", "/cam", "less.xml"), True),
    ):
        assert (lost in sros(*words, cwd=tmp_path).ok().err) == said, words
