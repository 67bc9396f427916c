"""OpenSSL as the verifier of a robot without sros finds what sros finds."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path

import pytest

from ansible_collections.sros.fleet.plugins.module_utils.exports import RefusedError
from ansible_collections.sros.fleet.plugins.module_utils.verification import (
    check_authorities,
    check_lists,
    clock_remark,
    same_trust,
    verify,
)
from sros_tool.checks.keystores.arrival import verify_arrival
from sros_tool.keystore.delivery.export import distribute
from sros_tool.keystore.lifecycle.create import create_enclaves, create_keystore
from sros_tool.keystore.lifecycle.revoke import refresh_crl, revoke
from sros_tool.keystore.lifecycle.rotate import rotate_ca
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.template import load_template
from sros_tool.pki.crl import load_crl
from sros_tool.wording import serial_text
from tests.support.harness import copy_of

pytestmark = pytest.mark.skipif(not shutil.which("openssl"), reason="the program openssl is needed")

NONE = ["no-such-program"]
STAGES = ("ks", "revoked", "refreshed", "distribute", "reissue", "retire")
OF_IDENTITY = (
    "refreshed",
    *(f"identity {stage}" for stage in ("distribute", "reissue", "revoked", "retire")),
)
"""What a robot gets in turn: in a rotation of both CAs, and of the identity CA."""


@pytest.fixture(scope="module")
def exports(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Exports of one keystore, by the moment or by what is special about them."""
    folder = tmp_path_factory.mktemp("exports")
    now, long_ago = datetime.now(UTC), datetime.now(UTC) - timedelta(days=360)
    made = {}

    def export(what: str, *names: str, keystore: str = "ks", at: datetime = now) -> None:
        made[what] = folder / "exports" / what
        distribute(OpenedKeystore(folder / keystore), names, made[what], now=at)

    for name, moment in (("ks", now), ("other", now), ("old", long_ago - timedelta(days=30))):
        create_keystore(folder / name, template=load_template("production"), now=moment)
        create_enclaves(folder / name, ["/a", "/b"], now=moment)
        export(name, "/a", "/b", keystore=name, at=moment)
    create_enclaves(folder / "ks", ["/c"], now=now)
    export("c", "/c")
    copy_of(folder / "ks", folder / "restored")
    revoke(folder / "ks", ["/c"], now=now)
    export("revoked", "/a", "/b")
    refresh_crl(folder / "ks", now=now + timedelta(minutes=1))
    export("refreshed", "/a", "/b")
    create_enclaves(folder / "restored", ["/d"], now=now)
    for which, name in (("restored", "/d"), ("restored twice", "/b")):
        revoke(folder / "restored", [name], now=now)
        export(which, "/a", keystore="restored")
    copy_of(folder / "ks", folder / "identity")
    for each in ("distribute", "reissue", "retire"):
        rotate_ca(folder / "ks", now=now)
        export(each, "/a", "/b")
    later = now + timedelta(hours=1)
    for each in ("distribute", "reissue", "revoked", "retire"):
        if each == "revoked":
            revoke(folder / "identity", ["/b"], now=later)
        else:
            rotate_ca(folder / "identity", roles=("identity",), now=later)
        export(f"identity {each}", "/a", keystore="identity", at=later)
    return made


def spoil(file: str, change: Callable[[bytes], bytes]) -> Callable[[Path, dict[str, Path]], None]:
    def do(folder: Path, _: dict[str, Path]) -> None:
        path = folder / "enclaves/a" / file
        path.write_bytes(change(path.read_bytes()))

    return do


def take(file: str, source: str, name: str = "a") -> Callable[[Path, dict[str, Path]], None]:
    def do(folder: Path, exports: dict[str, Path]) -> None:
        shutil.copy(exports[source] / "enclaves" / name / file, folder / "enclaves/a" / file)

    return do


def revoked_one(folder: Path, exports: dict[str, Path]) -> None:
    shutil.rmtree(folder / "enclaves/a")
    shutil.copytree(exports["c"] / "enclaves/c", folder / "enclaves/c")
    shutil.copy(exports["revoked"] / "enclaves/a/crl.pem", folder / "enclaves/c")


BROKEN = {
    "permissions of another enclave": take("permissions.p7s", "ks", "b"),
    "the key of another enclave": take("key.pem", "ks", "b"),
    "the certificate of another enclave": take("cert.pem", "ks", "b"),
    "another identity CA": take("identity_ca.cert.pem", "other"),
    "another permissions CA": take("permissions_ca.cert.pem", "other"),
    "another governance": take("governance.p7s", "other"),
    "changed permissions": spoil(
        "permissions.p7s", lambda b: b.replace(b"allow_rule", b"deny_rule")
    ),
    "changed governance": spoil("governance.p7s", lambda b: b.replace(b"true", b"false")),
    "an empty file": spoil("cert.pem", lambda _: b""),
    "junk for a key": spoil("key.pem", lambda _: b"junk"),
    "a revoked enclave": revoked_one,
}


def names_in(folder: Path) -> list[str]:
    return [f"/{each.name}" for each in sorted((folder / "enclaves").iterdir())]


@pytest.mark.parametrize("what", ["ks", "revoked", "distribute", "reissue", "retire"])
def test_what_is_good(what: str, exports: dict[str, Path]) -> None:
    found = verify(str(exports[what]), ["/a", "/b"], NONE)
    assert (found["by"], found["ok"], found["problems"]) == ("openssl", True, [])


@pytest.mark.parametrize("what", BROKEN)
def test_what_is_broken(what: str, exports: dict[str, Path], tmp_path: Path) -> None:
    folder = Path(shutil.copytree(exports["ks"], tmp_path / "robot"))
    BROKEN[what](folder, exports)
    names = names_in(folder)
    found = verify(str(folder), names, NONE)
    assert not found["ok"]
    arrived = verify_arrival(folder, now=datetime.now(UTC)).enclaves
    broken = [each.name for each in arrived if not each.loadable]
    assert {each.partition(":")[0] for each in found["problems"]} == set(broken) == {names[-1]} or (
        set(broken) == {"/a"} and all(each.startswith("/a:") for each in found["problems"])
    )


def test_what_has_expired(exports: dict[str, Path]) -> None:
    found = verify(str(exports["old"]), ["/a", "/b"], NONE)
    assert any("certificate has expired" in each for each in found["problems"])
    assert any("permissions.p7s: it expired at" in each for each in found["problems"])


def test_who_verifies(exports: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    """What sros says is taken apart; a program that says nothing is no verification."""
    answer = (
        '{"enclaves": [{"name": "/a", "loadable": false}, {"name": "/b", "loadable": true}],'
        ' "findings": [{"enclave": "/a", "text": "bad"}, {"enclave": "/b", "text": "soon"},'
        ' {"enclave": null, "text": "all"}]}'
    )
    folder = str(exports["ks"])
    found = verify(folder, ["/a", "/b"], ["sh", "-c", f"echo '{answer}'"])
    assert found == {
        "by": "sros",
        "ok": False,
        "problems": ["/a: bad"],
        "remarks": ["all", "/b: soon"],
    }
    assert verify(folder, ["/c"], ["sh", "-c", f"echo '{answer}'"])["problems"] == [
        "/c: it is not loadable"
    ]
    for said in ("", "[]", "{}", "junk"):
        with pytest.raises(RefusedError, match="no answer"):
            verify(folder, ["/a"], ["sh", "-c", f"echo '{said}'; echo why >&2"])
    monkeypatch.setenv("PATH", "/nonexistent")
    with pytest.raises(RefusedError, match="neither sros nor openssl"):
        verify(folder, ["/a"], NONE)


def files_of(folder: Path) -> dict[str, bytes]:
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def test_no_older_list_takes_the_place_of_a_newer_one(
    exports: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A home that was restored from a backup would let revoked enclaves be trusted again."""
    files = {what: files_of(folder) for what, folder in exports.items()}
    for before, after in [*pairwise(STAGES), *pairwise(OF_IDENTITY), ("revoked", "revoked")]:
        assert check_lists(files[before], files[after], str(tmp_path)) == [], (before, after)
    for before, after, number in (
        ("revoked", "ks", "none"),
        ("reissue", "distribute", "the number"),
        ("identity revoked", "identity reissue", "the number"),
        ("identity revoked", "refreshed", "the number 2"),  # the list of the CA that is replaced
        ("revoked", "restored", "the number 1"),  # another list of the same number
        ("restored twice", "restored", "the number 1"),
    ):
        with pytest.raises(RefusedError, match=f"older than .* the keystore has {number}"):
            check_lists(files[before], files[after], str(tmp_path))
    (remark,) = check_lists(files["revoked"], files["restored twice"], str(tmp_path))
    (revoked,) = load_crl(files["revoked"]["enclaves/a/crl.pem"], "it").revoked
    lost = "The current revocation list has 1 serial numbers that the new one lacks, such as {}."
    assert remark.startswith(lost.format(serial_text(revoked.serial))), (
        "as inspect --history shows it"
    )
    assert "`sros inspect KEYSTORE --history` can" in remark
    monkeypatch.setenv("PATH", "/nonexistent")
    with pytest.raises(RefusedError, match="lacks openssl"):
        check_lists(files["revoked"], files["ks"], str(tmp_path))


def test_no_earlier_ca_takes_the_place_of_a_later_one(
    exports: dict[str, Path], tmp_path: Path
) -> None:
    """Also if only one of both CAs was replaced after the backup of a home."""
    files = {what: files_of(folder) for what, folder in exports.items()}
    direct = ("refreshed", OF_IDENTITY[-1])
    for before, after in [*pairwise(STAGES), *pairwise(OF_IDENTITY), direct]:
        check_authorities(files[before], files[after], str(tmp_path))
    for backup in ("refreshed", "identity distribute", "identity reissue"):
        with pytest.raises(RefusedError, match=r"a later CA in identity_ca.cert.pem of /a than"):
            check_authorities(files[OF_IDENTITY[-1]], files[backup], str(tmp_path))


def test_processes_trust_the_same_after_a_list_was_only_signed_again(
    exports: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files, both = {what: files_of(folder) for what, folder in exports.items()}, {"/a", "/b"}
    for before, after, same in (
        ("revoked", "revoked", both),
        ("revoked", "refreshed", both),
        ("refreshed", "revoked", both),
        ("ks", "revoked", set()),
        ("refreshed", "distribute", set()),
        ("restored", "restored twice", set()),
    ):
        assert same_trust(files[before], files[after], str(tmp_path)) == same, (before, after)
    more = {path: data * 2 for path, data in files["revoked"].items() if path.endswith("a/crl.pem")}
    assert same_trust(files["revoked"] | more, files["refreshed"], str(tmp_path)) == {"/b"}
    monkeypatch.setenv("PATH", "/nonexistent")
    assert same_trust(files["revoked"], files["refreshed"], str(tmp_path)) == set()


def test_a_list_that_the_robot_made_itself_holds_up_nothing(
    exports: dict[str, Path], tmp_path: Path
) -> None:
    """Twin: the same list, signed by the CA that the new files trust."""
    forger, now = tmp_path / "forger", datetime.now(UTC)
    create_keystore(forger, template=load_template("production"), now=now)
    create_enclaves(forger, ["/a", "/b"], now=now)
    revoke(forger, ["/b"], now=now)
    distribute(OpenedKeystore(forger), ["/a"], tmp_path / "forged", now=now)
    forged = files_of(tmp_path / "forged")
    before, after = files_of(exports["revoked"]), files_of(exports["ks"])
    path = "enclaves/a/crl.pem"
    for content in (forged[path], b"", b"-----BEGIN X509 CRL-----\n" * 100_000, b"\xff\0"):
        mine = {key: value for key, value in before.items() if not key.startswith("enclaves/b/")}
        assert check_lists({**mine, path: content}, after, str(tmp_path)) == []
        with pytest.raises(RefusedError, match="older"):
            check_lists({**mine, path: content + before[path]}, after, str(tmp_path))


def test_clocks() -> None:
    assert clock_remark(100.0, None, 10) == ""
    assert clock_remark(105.0, 100.0, 10) == ""
    assert "0:01:40 ahead" in clock_remark(200.0, 100.0, 10)
    assert "1 day, 0:00:00 behind" in clock_remark(0.0, 86400.0, 10)
