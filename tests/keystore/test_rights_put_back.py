"""Older permissions that were put back are never signed again, whatever the clocks say."""

from __future__ import annotations

import json
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from sros_tool.errors import KeystoreError
from sros_tool.keystore.delivery.robot import import_answer
from sros_tool.keystore.delivery.signing import SignedRequests, sign_request
from sros_tool.keystore.layout import LEDGER, LEDGER_HEAD
from sros_tool.keystore.lifecycle.create import create_enclaves, create_keystore, create_permission
from sros_tool.keystore.lifecycle.renew import renew
from sros_tool.keystore.lifecycle.rotate import rotate_ca
from sros_tool.keystore.template import load_template
from sros_tool.policy.document import read_policy
from sros_tool.policy.model import Policy
from tests.support.harness import create_request, policy_text, publish, snapshot, topics_of

NOW = datetime.now(UTC)
FILES = ("permissions.p7s", "permissions.xml")


def policy(tmp_path: Path, *topics: str) -> Policy:
    file = tmp_path / "policy.xml"
    file.write_text(policy_text({"/a": publish(*topics)}))
    return read_policy(file)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A keystore in which the enclave /a lost the topic /wide, and no subject tells."""
    root = tmp_path / "ks"
    create_keystore(root, template=load_template("development"), now=NOW)
    create_enclaves(root, ["/a"], now=NOW)
    create_permission(root, ["/a"], policy(tmp_path, "rosout", "wide"), now=NOW)
    for file in FILES:
        (tmp_path / file).write_bytes((root / "enclaves/a" / file).read_bytes())
    create_permission(root, ["/a"], policy(tmp_path, "rosout"), now=NOW)
    return root


def put_back(root: Path) -> None:
    for file in FILES:
        (root / "enclaves/a" / file).write_bytes((root.parent / file).read_bytes())


def _renew(root: Path) -> object:
    return renew(root, ["/a"], now=NOW)


def _rotate(root: Path) -> object:
    return rotate_ca(root, now=NOW, finish=True)


def _answer(root: Path) -> object:
    robot = root.parent / "robot"
    create_request(robot, "/a")
    (root / "enclaves/a/key.pem").unlink()
    request = (robot / "enclaves/a/request.pem").read_bytes()
    return sign_request(root, request, now=NOW, renew=True)


@pytest.mark.parametrize("work", [_renew, _rotate, _answer])
def test_older_permissions_are_not_signed_again(work: Callable[[Path], object], root: Path) -> None:
    put_back(root)
    before = snapshot(root / "public"), (root / "enclaves/a/cert.pem").read_bytes()
    with pytest.raises(KeystoreError, match="not certain that") as caught:
        work(root)
    assert "older permissions were put back" in caught.value.why
    assert "create_permission" in caught.value.remedy
    assert before == (snapshot(root / "public"), (root / "enclaves/a/cert.pem").read_bytes())


@pytest.mark.parametrize("work", [_renew, _rotate, _answer])
def test_the_latest_permissions_are_signed_again(
    work: Callable[[Path], object], root: Path
) -> None:
    work(root)
    assert "wide" not in str(topics_of(root / "enclaves/a"))


def _cut(root: Path) -> None:
    ledger = root / LEDGER
    ledger.write_bytes(b"".join(ledger.read_bytes().splitlines(keepends=True)[:-1]))


def _cut_with_head(root: Path) -> None:
    _cut(root)
    (root / LEDGER_HEAD).unlink()


def _no_ledger(root: Path) -> None:
    (root / LEDGER).unlink()
    (root / LEDGER_HEAD).unlink()


@pytest.mark.parametrize("hide", [_cut, _cut_with_head, _no_ledger])
def test_a_cut_ledger_does_not_vouch_for_them(
    hide: Callable[[Path], None], root: Path, tmp_path: Path
) -> None:
    put_back(root)
    hide(root)
    with pytest.raises(KeystoreError, match="not certain that"):
        renew(root, ["/a"], now=NOW)
    # The way out that the error names.
    create_permission(root, ["/a"], policy(tmp_path, "rosout"), now=NOW)
    renew(root, ["/a"], now=NOW)
    assert "wide" not in str(topics_of(root / "enclaves/a"))


def test_no_new_certificate_is_made_for_older_permissions(tmp_path: Path) -> None:
    """Where subjects are unique, older permissions need a certificate of their subject."""
    root = tmp_path / "unique"
    create_keystore(root, template=load_template("production"), now=NOW)
    create_enclaves(root, ["/a"], now=NOW)
    message, certificate = (root / "enclaves/a" / file for file in (FILES[0], "cert.pem"))
    older = message.read_bytes()
    renew(root, ["/a"], now=NOW)
    latest = message.read_bytes()
    certificate.unlink()
    message.write_bytes(older)
    with pytest.raises(KeystoreError, match="not certain that"):
        create_enclaves(root, ["/a"], now=NOW)
    assert not certificate.exists()
    message.write_bytes(latest)
    create_enclaves(root, ["/a"], now=NOW)
    assert certificate.exists()


# ── answers ────────────────────────────────────────────────────────────────────────────────


def answer(root: Path, tmp_path: Path, *topics: str, now: datetime = NOW) -> SignedRequests:
    request = (tmp_path / "robot/enclaves/arm/request.pem").read_bytes()
    file = tmp_path / "arm.xml"
    file.write_text(policy_text({"/arm": publish(*topics)}))
    again = (root / "enclaves/arm").exists()
    return sign_request(root, request, now=now, policy=read_policy(file), renew=again)


@pytest.mark.parametrize("later", [timedelta(0), timedelta(days=-1)], ids=["same", "clock back"])
def test_the_number_of_an_answer_orders_it(later: timedelta, root: Path, tmp_path: Path) -> None:
    robot = tmp_path / "robot"
    create_request(robot, "/arm")
    older = answer(root, tmp_path, "rosout", "wide").archive
    newer = answer(root, tmp_path, "rosout", now=NOW + later).archive
    import_answer(robot, older, now=NOW)
    import_answer(robot, newer, now=NOW)
    before = snapshot(robot)
    with pytest.raises(KeystoreError, match="older than the installed one"):
        import_answer(robot, older, now=NOW)
    assert not import_answer(robot, newer, now=NOW).changes
    assert snapshot(robot) == before
    import_answer(robot, older, now=NOW, force=True)


def test_a_number_is_never_given_twice(root: Path, tmp_path: Path) -> None:
    """Two answers with one number are the sign of a ledger that was set back."""
    robot = tmp_path / "robot"
    create_request(robot, "/arm")
    kept = {file: (root / file).read_bytes() for file in (LEDGER, LEDGER_HEAD)}
    import_answer(robot, answer(root, tmp_path, "rosout").archive, now=NOW)
    for file, data in kept.items():
        (root / file).write_bytes(data)
    again = answer(root, tmp_path, "rosout", "wide").archive
    with pytest.raises(KeystoreError, match="older than the installed one") as caught:
        import_answer(robot, again, now=NOW)
    assert "reset in between" in caught.value.why


def test_a_ledger_without_a_chain_vouches_for_no_rights(root: Path, tmp_path: Path) -> None:
    """Whoever takes the chain away can take out the line of the latest permissions, too."""
    lines = [json.loads(line) for line in (root / LEDGER).read_text().splitlines()]
    last = max(number for number, line in enumerate(lines) if line["what"] == "permissions")
    del lines[last]
    for line in lines:
        line.pop("previous", "")
    (root / LEDGER).write_text("".join(json.dumps(line) + "\n" for line in lines))
    (root / LEDGER_HEAD).unlink()
    put_back(root)
    create_enclaves(root, ["/b"], now=NOW)  # the lines that follow are chained
    with pytest.raises(KeystoreError, match="not certain that") as caught:
        renew(root, ["/a"], now=NOW)
    assert "The ledger has gaps" in caught.value.why
    create_permission(root, ["/a"], policy(tmp_path, "rosout"), now=NOW)
    renew(root, ["/a"], now=NOW)
