"""Enclaves that the settings of a keystore let expire early do so, however they are issued."""

from __future__ import annotations

import json
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from sros_tool.checks.keystores.keystore import keystore_findings
from sros_tool.checks.keystores.opened import Circumstances
from sros_tool.files import policies_dir
from sros_tool.keystore.expiry import survey
from sros_tool.keystore.lifecycle.create import generate_artifacts
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.policy.document import read_policy
from sros_tool.validity import BACKDATE
from tests.support.harness import policy_text, publish, sros

DAY = timedelta(days=1)
SHORT, LONG = "/operator/look", "/robot"
POLICY = policies_dir() / "operator_look.xml"


def create(root: Path) -> None:
    sros("generate_artifacts", "-k", root, "-p", POLICY, "-e", LONG).ok()


def create_without_policy(root: Path) -> None:
    sros("create_enclave", root, SHORT, LONG).ok()


def renew(root: Path) -> None:
    create(root)
    sros("renew", root, SHORT, LONG, "--new-key").ok()


def state_again(root: Path) -> None:
    create_without_policy(root)
    sros("create_permission", root, SHORT, POLICY).ok()


def rotate(root: Path) -> None:
    create(root)
    for stage in ("distribute", "reissue", "retire"):
        sros("rotate_ca", root, "--to", stage).ok()


def sign(root: Path) -> None:
    sros("create_enclave", root, LONG).ok()
    laptop = root.with_name("laptop")
    sros("create_request", SHORT, laptop).ok()
    request = laptop / "enclaves/operator/look/request.pem"
    answer = root.with_name("answer.tar.gz")
    sros("sign_request", root, request, "-p", POLICY, "-o", answer).ok()


@pytest.mark.parametrize("issue", [create, create_without_policy, renew, state_again, rotate, sign])
def test_an_enclave_lives_for_a_day_and_others_for_longer(
    issue: Callable[[Path], None], tmp_path: Path
) -> None:
    root = tmp_path / "ks"
    sros("create_keystore", root, "--template", "production").ok()
    issue(root)
    lifetimes, unreadable = survey(OpenedKeystore(root))
    assert unreadable == ()
    for each in lifetimes:
        for window in (each.certificate, each.permissions):
            length = window.not_after - window.not_before - BACKDATE
            assert (length <= DAY) == (each.name == SHORT), each
    assert {each.name for each in lifetimes} == {SHORT, LONG}


def test_its_expiry_is_said_when_it_is_issued(tmp_path: Path) -> None:
    sros("create_keystore", tmp_path / "ks").ok()
    ended = sros("create_enclave", tmp_path / "ks", SHORT, LONG).ok()
    assert ended.err.count("note [enclave.short-lived]") == 1
    assert f"{SHORT} expires at 20" in ended.err


@pytest.mark.parametrize("days", [0.0, 0.9, 2.0])
def test_its_expiry_is_accepted_and_that_of_others_is_found(days: float, tmp_path: Path) -> None:
    root = tmp_path / "ks"
    sros("create_keystore", root, "--template", "production").ok()
    sros("generate_artifacts", "-k", root, "-p", POLICY).ok()
    at = datetime.now(UTC) + days * DAY

    def ids(*, accepted: bool) -> set[str]:
        found = keystore_findings(OpenedKeystore(root), Circumstances(at))
        return {each.id for each in found if bool(each.accepted) is accepted}

    late = ids(accepted=True)
    assert bool(late) == (days > 0)
    assert not (late | {"enclave.refused"}) & ids(accepted=False)
    # What expired stays as it is, and is no reason to refuse other enclaves.
    stated = generate_artifacts(root, policies=[read_policy(POLICY)], now=at)
    left = [note.text for note in stated.notes if note.id == "enclave.expired-short-lived"]
    assert bool(left) == (days > 1) and (not left or SHORT not in stated.outcomes)
    settings = root / "sros.toml"
    settings.write_text(settings.read_text().replace("/operator/*", "/nobody/*"))
    assert late <= ids(accepted=False)


def test_permissions_of_an_older_certificate_are_short_too(tmp_path: Path) -> None:
    """The entry came later than the certificate, which lives on."""
    root = tmp_path / "ks"
    sros("create_keystore", root, "--template", "production").ok()
    settings = root / "sros.toml"
    text = settings.read_text()
    settings.write_text(text.replace("/operator/*", "/nobody/*"))
    sros("create_enclave", root, SHORT).ok()
    settings.write_text(text)
    sros("create_permission", root, SHORT, POLICY).ok()
    ((found,), _) = survey(OpenedKeystore(root))
    assert found.permissions.not_after - found.permissions.not_before - BACKDATE == DAY
    assert found.certificate.not_after - found.permissions.not_after > 300 * DAY


def test_a_short_lived_enclave_is_renewed_by_its_name_alone(tmp_path: Path) -> None:
    root = tmp_path / "ks"
    sros("create_keystore", root).ok()
    create(root)
    said = sros("check", "keystore", root, "--needs-renewal", "30d").ok().err
    none, left_out = said.splitlines()
    assert none == "no enclave needs to be renewed (30d)"
    assert left_out.startswith(
        f"not counted: 1 short-lived enclave (renewed only by name): {SHORT}"
    )
    due = sros("check", "keystore", root, "--needs-renewal", "99y")
    assert (due.status, SHORT in due.out, LONG in due.out) == (1, False, True)
    renewed = sros("renew", root, "--all-expiring", "99y").ok()
    assert renewed.out == f"renewed enclave {LONG}\n"
    assert f"[renew.short-lived]: not renewed: {SHORT} (enclaves in [[enclaves]]" in renewed.err
    renewed = sros("renew", root, SHORT, "--all-expiring", "30d").ok()
    assert renewed.out == f"renewed enclave {SHORT}\n"


def test_a_process_of_a_closed_robot_is_renewed_with_all_others(tmp_path: Path) -> None:
    """Nobody would name it: its certificate is as short as a person's, but the robot goes on."""
    root = tmp_path / "keystore"
    sros("create_keystore", root, "--template", "production").ok()
    create(root)
    (tmp_path / "policy.xml").write_text(policy_text({SHORT: publish("x")}))
    expired = Circumstances(datetime.now(UTC) + 2 * DAY)
    of_process = [{"enclave": SHORT}]
    for processes, ended, not_here, is_due in (
        (of_process, [], [], True),
        ([], [SHORT], [], True),
        (of_process, [], [SHORT], False),
    ):
        listed = {"processes": processes, "ended": ended, "not_here": not_here}
        (tmp_path / "processes.json").write_text(json.dumps(listed))
        due = sros("check", "keystore", root, "--needs-renewal", "30d")
        assert (due.status, SHORT in due.out) == (int(is_due), is_due), due
        found = keystore_findings(OpenedKeystore(root), expired)
        accepted = {each.accepted != "" for each in found if "expired" in each.id}
        assert accepted == {not is_due}, found
        renewed = sros("renew", root, "--all-expiring", "30d").ok()
        assert (f"renewed enclave {SHORT}\n" in renewed.out) is is_due
        assert ("renew.short-lived" in renewed.err) is not is_due
    (tmp_path / "processes.json").write_text("[]")
    assert sros("check", "keystore", root, "--needs-renewal", "30d").ok()


def test_a_robot_with_a_name_of_people_is_noted(tmp_path: Path) -> None:
    """Or an enclave of people on each robot."""
    for name, path, said_of in (
        ("operator", "/{robot}/base", "/operator/base, /operator/other"),
        ("r1", "/{robot}/base", ""),
        ("r2", "/operator/{robot}/panel", "/operator/r2/panel"),
    ):
        policy = {path: publish("/{robot}/x"), "/{robot}/other": publish("/{robot}/y")}
        (tmp_path / "p.xml").write_text(policy_text(policy))
        (tmp_path / "fleet.toml").write_text(f"[robots.{name}]\n")
        words = ("generate_artifacts", "-k", name, "-p", "p.xml", "--fleet", "fleet.toml")
        said = sros(*words, cwd=tmp_path).ok().err
        note = f"[fleet.short-lived]: the settings of the keystore make {said_of} short-lived"
        assert (note in said) == ("[fleet.short-lived]" in said) == bool(said_of), said
