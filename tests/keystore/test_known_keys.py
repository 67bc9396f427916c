"""A revoked key is not certified again, nor the key of one enclave for another."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from sros_tool.errors import KeystoreError
from sros_tool.keystore.delivery.robot import import_answer
from sros_tool.keystore.delivery.signing import SignedRequests, sign_request
from sros_tool.keystore.layout import enclave_folder
from sros_tool.keystore.lifecycle.create import create_enclaves
from sros_tool.keystore.lifecycle.renew import renew
from sros_tool.keystore.lifecycle.revoke import revoke
from sros_tool.keystore.lifecycle.rotate import rotate_ca
from sros_tool.pki.certificates import make_request
from sros_tool.pki.keys import load_key
from tests.support.harness import certificate, copy_of, create_request, snapshot

NOW = datetime.now(UTC) + timedelta(hours=1)  # later than the keystore that is copied


LEDGER = ("ledger.jsonl", "ledger.p7s")


def sign(keystore: Path, key: bytes, name: str, *, again: bool = False) -> SignedRequests:
    return sign_request(
        keystore, make_request(load_key(key, "of the test"), name), now=NOW, renew=again
    )


def put_key(keystore: Path, name: str, key: bytes) -> None:
    folder = keystore / f"enclaves{name}"
    folder.mkdir()
    (folder / "key.pem").write_bytes(key)


def create_around(keystore: Path, name: str, key: bytes) -> None:
    put_key(keystore, name, key)
    create_enclaves(keystore, [name], now=NOW)


def replaced(keystore: Path) -> None:
    renew(keystore, ["/a"], now=NOW, new_key=True, revoke_old=True)


def replaced_before(keystore: Path) -> None:
    renew(keystore, ["/a"], now=NOW, new_key=True)
    revoke(keystore, ["/a"], now=NOW)


def forgotten_by_the_list(keystore: Path) -> None:
    replaced_before(keystore)
    rotate_ca(keystore, now=NOW, finish=True)


REVOKED: dict[str, Callable[[Path], object]] = {
    "revoked": lambda keystore: revoke(keystore, ["/a"], now=NOW),
    "replaced": replaced,
    "replaced, then revoked": replaced_before,
    "revoked by an earlier CA": forgotten_by_the_list,
}
CERTIFIED: dict[str, Callable[[Path, bytes], object]] = {
    "for a request": lambda keystore, key: sign(keystore, key, "/new"),
    "for a request of an enclave": lambda keystore, key: sign(keystore, key, "/b", again=True),
    "for a key that is there": lambda keystore, key: create_around(keystore, "/new", key),
}


@pytest.mark.parametrize("put_back", [True, False], ids=["older", "none"])
def test_a_revoked_key_is_known_without_the_ledger(put_back: bool, keystore: Path) -> None:
    key = (keystore / "enclaves/a/key.pem").read_bytes()
    older = {keystore / file: (keystore / file).read_bytes() for file in LEDGER}
    revoke(keystore, ["/a"], now=NOW)
    for file, content in older.items():
        file.write_bytes(content) if put_back else file.unlink()
    if put_back:  # the list has the certificate, and the ledger its key
        shutil.rmtree(keystore / "revoked")
    with pytest.raises(KeystoreError, match="was revoked"):
        sign(keystore, key, "/new")


@pytest.mark.parametrize("way", CERTIFIED)
@pytest.mark.parametrize("state", REVOKED)
def test_a_revoked_key_is_not_certified_again(state: str, way: str, keystore: Path) -> None:
    key = (keystore / "enclaves/a/key.pem").read_bytes()
    (keystore / "enclaves/b/key.pem").unlink()  # as if it were on a robot
    REVOKED[state](keystore)
    with pytest.raises(KeystoreError, match="was revoked"):
        CERTIFIED[way](keystore, key)
    create_request(keystore.parent / "robot", "/robot")
    other = (keystore.parent / "robot/enclaves/robot/key.pem").read_bytes()
    shutil.rmtree(keystore / "enclaves/new", ignore_errors=True)
    CERTIFIED[way](keystore, other)


@pytest.mark.parametrize("verb", ["renew", "rotate_ca"])
@pytest.mark.parametrize("name", ["/a", "/b"])
def test_an_enclave_with_a_revoked_key_is_not_certified_again(
    verb: str, name: str, keystore: Path, tmp_path: Path
) -> None:
    """The enclave came back from a backup, or had the same key as the revoked one."""
    copy_of(keystore / "enclaves/a", tmp_path / "backup")
    if name == "/b":
        share_key(keystore)
    revoke(keystore, ["/a"], now=NOW)
    if name == "/a":
        copy_of(tmp_path / "backup", keystore / "enclaves/a")
        shutil.rmtree(keystore / "revoked")
    before = snapshot(keystore)

    def refused() -> str:
        with pytest.raises(KeystoreError, match=f"key of enclave {name} was revoked") as caught:
            renew(keystore, [name], now=NOW) if verb == "renew" else rotate_ca(
                keystore, now=NOW, finish=True
            )
        return caught.value.remedy

    assert f"`sros renew {keystore} {name} --new-key --revoke-old`." in refused()
    assert snapshot(keystore) == before
    key = keystore / enclave_folder(name) / "key.pem"
    key.rename(key.with_name("request.pem"))  # as if a robot had made it
    assert "--new-key" not in refused() and "make a new key on its robot" in refused()
    key.with_name("request.pem").rename(key)
    renew(keystore, [name], now=NOW, new_key=True)
    rotate_ca(keystore, now=NOW, finish=True)


def share_key(keystore: Path) -> None:
    """Give /b the key of /a, and a certificate for it."""
    folder = keystore / "enclaves/b"
    for file in ("cert.pem", "key.pem"):
        (folder / file).unlink()
    shutil.copy(keystore / "enclaves/a/key.pem", folder)
    hidden = keystore.parent / "hidden"
    (keystore / "enclaves/a").rename(hidden)
    create_enclaves(keystore, ["/b"], now=NOW)
    hidden.rename(keystore / "enclaves/a")


def test_the_key_of_a_renewed_certificate_stays_in_use(keystore: Path) -> None:
    key = (keystore / "enclaves/a/key.pem").read_bytes()
    for _ in range(2):
        renew(keystore, ["/a"], now=NOW, revoke_old=True)
    rotate_ca(keystore, now=NOW, finish=True)
    sign(keystore, key, "/a", again=True)
    found = load_key(key, "").public_key()
    assert certificate(keystore / "enclaves/a/cert.pem").public_key() == found


def test_the_key_of_another_enclave_is_refused(keystore: Path) -> None:
    key = (keystore / "enclaves/a/key.pem").read_bytes()
    (keystore / "enclaves/b/key.pem").unlink()
    for way in CERTIFIED.values():
        with pytest.raises(KeystoreError, match="is the key of enclave /a"):
            way(keystore, key)


def test_a_shared_key_is_told_when_it_is_certified_again(keystore: Path) -> None:
    share_key(keystore)
    key = (keystore / "enclaves/a/key.pem").read_bytes()
    for notes in (
        renew(keystore, ["/a"], now=NOW).notes,
        sign(keystore, key, "/a", again=True).notes,
        rotate_ca(keystore, now=NOW, finish=True).notes,
    ):
        assert "/a has the same key as /b" in notes[0].text
    renew(keystore, ["/b"], now=NOW, new_key=True)
    assert renew(keystore, ["/a"], now=NOW).notes == ()


def test_a_robot_refuses_a_key_twice(keystore: Path, tmp_path: Path) -> None:
    robot = tmp_path / "robot"
    create_request(robot, "/one")
    key = (robot / "enclaves/one/key.pem").read_bytes()
    import_answer(robot, sign(keystore, key, "/one").archive, now=NOW)
    put_key(robot, "/two", key)
    (keystore / "enclaves/one").rename(tmp_path / "hidden")
    archive = sign(keystore, key, "/two").archive
    with pytest.raises(KeystoreError, match="is the key of enclave /one"):
        import_answer(robot, archive, now=NOW)
    shutil.rmtree(robot / "enclaves/one")
    assert import_answer(robot, archive, now=NOW).changes


def test_a_robot_refuses_a_key_that_the_answer_revokes(keystore: Path, tmp_path: Path) -> None:
    robot = tmp_path / "robot"
    create_request(robot, "/one")
    key = (robot / "enclaves/one/key.pem").read_bytes()
    import_answer(robot, sign(keystore, key, "/one").archive, now=NOW)
    spare = Path(shutil.copytree(robot, tmp_path / "spare"))
    renew(keystore, ["/one"], now=NOW, revoke_old=True)
    import_answer(spare, sign(keystore, key, "/one", again=True).archive, now=NOW)
    revoke(keystore, ["/one"], now=NOW)
    for forgotten in ("revoked", "ledger.jsonl"):
        path = keystore / forgotten
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    archive = sign(keystore, key, "/one").archive
    with pytest.raises(KeystoreError, match="key of enclave /one was revoked"):
        import_answer(spare, archive, now=NOW)
