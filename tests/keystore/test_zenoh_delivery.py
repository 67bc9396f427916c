"""Exports and answers carry the Zenoh configurations, and a robot uses only those that fit."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import pytest

from sros_tool.errors import PkiError
from sros_tool.keystore.delivery.archive import pack, unpack
from sros_tool.keystore.delivery.robot import RequestAnswer, check_answer, seal
from sros_tool.keystore.issuing.authority import load_authority
from sros_tool.keystore.issuing.keyring import IN_KEYSTORE
from sros_tool.keystore.layout import PERMISSIONS, SEAL
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.pki.keys import load_key
from tests.support.harness import Ended, copy_of, policy_text, publish, snapshot, sros
from tests.support.long_form import sometimes

SESSION, SIGNED = "session.json5", "session.p7s"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a keystore that has a Zenoh network; only to be copied."""
    folder = tmp_path_factory.mktemp("zenoh")
    (folder / "p.xml").write_text(policy_text({"/a": publish("/x"), "/b": publish("/y")}))
    (folder / "more.xml").write_text(policy_text({"/a": publish("/x", "/more")}))
    (folder / "far.xml").write_text(policy_text({"/far": publish("/f")}))
    (folder / "farther.xml").write_text(policy_text({"/far": publish("/f", "/g")}))
    sros("generate_artifacts", "-k", "ks", "-p", "p.xml", cwd=folder).ok()
    sros("zenoh", "ks", cwd=folder).ok()
    sros("create_request", "/far", "robot", cwd=folder).ok()
    return folder


@pytest.fixture
def folder(made: Path, tmp_path: Path) -> Path:
    return copy_of(made, tmp_path / "w")


def runs(folder: Path, root: str, name: str) -> Ended:
    """What `sros env` says for a process of rmw_zenoh_cpp."""
    return sros("env", root, name, "--rmw", "rmw_zenoh_cpp", cwd=folder)


# ── exports ────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("mode", ["client", "peer"])
def test_an_export_runs_alone(mode: str, folder: Path) -> None:
    sros("zenoh", "ks", "--mode", mode, cwd=folder).ok()
    sros("distribute_key", "ks", "/a", "/router", "out", cwd=folder).ok()
    sros("distribute_key", "ks", "/a", "out.tar.gz", cwd=folder).ok()
    packed = unpack((folder / "out.tar.gz").read_bytes())
    shutil.rmtree(folder / "ks")
    for file in (SESSION, SIGNED):
        assert packed[f"enclaves/a/{file}"] == (folder / "out/enclaves/a" / file).read_bytes()
    sros("verify", "out", cwd=folder).ok()
    for name, file in (("/a", SESSION), ("/router", "router.json5")):
        assert str(folder / "out/enclaves") + f"{name}/{file}" in runs(folder, "out", name).ok().out


def test_an_export_without_a_network_takes_the_files_away(folder: Path) -> None:
    sros("distribute_key", "ks", "/a", "out", cwd=folder).ok()
    sros("zenoh", "ks", "--off", cwd=folder).ok()
    before = snapshot(folder / "out")
    refused = sros("distribute_key", "ks", "/a", "out", cwd=folder)
    assert refused.status == 2
    assert f"enclaves/a/{SESSION}" in refused.err
    assert snapshot(folder / "out") == before
    ended = sros("distribute_key", "ks", "/a", "out", "--force", cwd=folder).ok()
    assert f"removed enclaves/a/{SESSION}" in ended.err
    assert not list((folder / "out").rglob("session.*"))
    assert "has no configuration for rmw_zenoh_cpp" in runs(folder, "out", "/a").err
    sros("verify", "out", cwd=folder).ok()  # for DDS


def test_an_enclave_that_became_the_router_leaves_no_session_behind(folder: Path) -> None:
    sros("distribute_key", "ks", "/b", "out", cwd=folder).ok()
    sros("zenoh", "ks", "--router", "/c", cwd=folder).ok()
    sros("create_permission", "ks", "/a", "more.xml", cwd=folder).ok()
    sros("distribute_key", "ks", "/router", "/c", "out", cwd=folder).ok()
    found = {each.name for each in (folder / "out/enclaves/router").iterdir()}
    assert "router.json5" not in found
    assert SESSION in found
    sros("zenoh", "ks", "--router", "/router", cwd=folder).ok()
    sros("distribute_key", "ks", "/router", "/c", "out", "--force", cwd=folder).ok()
    found = {each.name for each in (folder / "out/enclaves/router").iterdir()}
    assert not found & {SESSION, SIGNED}


def test_files_that_no_robot_could_use_are_not_exported(folder: Path) -> None:
    path = folder / "ks/enclaves/a" / SESSION
    path.write_bytes(path.read_bytes().replace(b"deny", b"allow"))
    refused = sros("distribute_key", "ks", "/a", "out", cwd=folder)
    assert refused.status == 2
    assert "could not be used on a robot" in refused.err
    assert not (folder / "out").exists()
    sros("zenoh", "ks", cwd=folder).ok()
    sros("distribute_key", "ks", "/a", "out", cwd=folder).ok()


# ── answers ────────────────────────────────────────────────────────────────────────────────


def answered(folder: Path, *words: str) -> None:
    request = "robot/enclaves/far/request.pem"
    sros("sign_request", "ks", request, *words, "-o", "far.tgz", "--force", cwd=folder).ok()


def imported(folder: Path, *words: str) -> dict[str, object]:
    value: dict[str, object] = json.loads(
        sros("import", "far.tgz", "robot", "--json", *words, cwd=folder).ok().out
    )
    return value


@pytest.mark.parametrize("mode", ["client", "peer"])
def test_an_answer_brings_new_rights_and_names_what_to_restart(mode: str, folder: Path) -> None:
    sros("zenoh", "ks", "--mode", mode, cwd=folder).ok()
    answered(folder, "-p", "far.xml")
    assert imported(folder)["restart_zenoh"] == []  # nothing ran before
    sros("verify", "robot", cwd=folder).ok()
    first = runs(folder, "robot", "/far").ok().out
    before = (folder / "robot/enclaves/far" / SESSION).read_bytes()
    answered(folder, "--renew")
    assert imported(folder)["restart_zenoh"] == []  # the certificate is new, the rules are not
    answered(folder, "--renew", "-p", "farther.xml")
    assert imported(folder, "--dry-run")["restart_zenoh"] == ["/far"]
    assert (folder / "robot/enclaves/far" / SESSION).read_bytes() == before
    ended = sros("import", "far.tgz", "robot", cwd=folder).ok()
    assert "restart the processes of 1 enclave for the change to take effect: /far" in ended.err
    assert (folder / "robot/enclaves/far" / SESSION).read_bytes() != before
    sros("verify", "robot", cwd=folder).ok()
    assert runs(folder, "robot", "/far").ok().out == first  # the same paths
    assert imported(folder)["restart_zenoh"] == []


def test_an_answer_without_a_network_takes_the_files_away(folder: Path) -> None:
    answered(folder, "-p", "far.xml")
    imported(folder)
    sros("zenoh", "ks", "--off", cwd=folder).ok()
    answered(folder, "--renew")
    assert imported(folder)["restart_zenoh"] == ["/far"]
    assert not list((folder / "robot").rglob("session.*"))
    assert "has no configuration for rmw_zenoh_cpp" in runs(folder, "robot", "/far").err


def test_a_change_of_other_enclaves_reaches_a_robot_with_the_next_answer(folder: Path) -> None:
    sros("zenoh", "ks", "--mode", "peer", cwd=folder).ok()
    answered(folder, "-p", "far.xml")
    imported(folder)
    sros("create_permission", "ks", "/a", "more.xml", cwd=folder).ok()
    answered(folder, "--renew")
    assert imported(folder)["restart_zenoh"] == ["/far"]
    assert "/%more/" in (folder / "robot/enclaves/far" / SESSION).read_text()  # in the graph


def test_an_answer_with_another_file_than_the_sealed_one(folder: Path) -> None:
    answered(folder, "-p", "far.xml")
    files = unpack((folder / "far.tgz").read_bytes())
    path = f"enclaves/far/{SESSION}"
    files[path] = files[path].replace(b"deny", b"allow")
    (folder / "far.tgz").write_bytes(pack(files))
    before = snapshot(folder / "robot")
    refused = sros("import", "far.tgz", "robot", cwd=folder)
    assert refused.status == 2
    assert "the files differ from the signed list" in refused.err
    assert snapshot(folder / "robot") == before


Files = dict[str, bytes]
FAR = "enclaves/far"


def other_document(files: Files, _: Path) -> Files:
    return files | {f"{FAR}/{SESSION}": b"{}\n"}


def without_signature(files: Files, _: Path) -> Files:
    return {path: data for path, data in files.items() if not path.endswith(SIGNED)}


def of_another_enclave(files: Files, root: Path) -> Files:
    both = (SESSION, SIGNED)
    return files | {f"{FAR}/{each}": (root / "enclaves/a" / each).read_bytes() for each in both}


@pytest.mark.parametrize(
    ("spoil", "why"),
    [
        (lambda files, _: files, ""),
        (other_document, "it is not the document that the permissions CA signed"),
        (without_signature, "session.p7s: missing"),
        (of_another_enclave, "it does not state the rights of permissions.p7s"),
    ],
)
def test_a_sealed_answer_with_files_that_do_not_fit(
    spoil: Callable[[Files, Path], Files], why: str, folder: Path
) -> None:
    """Not even the keystore itself can send a robot what `sros run` would refuse there."""
    answered(folder, "-p", "far.xml")
    root, now = folder / "ks", datetime.now(UTC)
    files = unpack((folder / "far.tgz").read_bytes())
    del files[SEAL]
    files = spoil(files, root)
    authority = load_authority(
        OpenedKeystore(root), PERMISSIONS, OpenedKeystore(root).template, IN_KEYSTORE, now
    )
    key = load_key((folder / "robot/enclaves/far/key.pem").read_bytes(), "key").public_key()
    answer = RequestAnswer("/far", files, seal(files, 9, authority))
    if not why:
        check_answer(answer, key, now=now)
        return
    with pytest.raises(PkiError, match=why):
        check_answer(answer, key, now=now)


@sometimes("an answer with the rights of a large robot")
def test_an_answer_with_the_rights_of_a_large_robot(folder: Path) -> None:
    """In peer mode each file has the rights of all enclaves, so it may be larger than a MiB."""
    names = [f"/{'part' * 5}/n{number}" for number in range(4)]
    rights = {each: publish(*(f"{each}/{'topic' * 40}{i}" for i in range(1100))) for each in names}
    (folder / "large.xml").write_text(policy_text(rights))
    sros("generate_artifacts", "-k", "ks", "-p", "large.xml", cwd=folder).ok()
    sros("zenoh", "ks", "--mode", "peer", cwd=folder).ok()
    answered(folder, "-p", "far.xml")
    imported(folder)
    assert (folder / "robot/enclaves/far" / SESSION).stat().st_size > 1024**2
    sros("verify", "robot", cwd=folder).ok()
