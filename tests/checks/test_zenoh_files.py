"""What is found in the Zenoh configurations of a keystore, of an enclave and of an export."""

from __future__ import annotations

import json
import shutil
from datetime import UTC, datetime
from pathlib import Path

import pytest

from sros_tool.dds.decision.vendors import Vendor
from sros_tool.explain.audit import audited_enclaves
from sros_tool.keystore.participant import JoinContext
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.zenoh_files import router_enclaves
from tests.support.harness import copy_of, policy_text, publish, sros


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a keystore that has a Zenoh network, and an export; only to be copied."""
    folder = tmp_path_factory.mktemp("zenoh")
    policy = policy_text({"/a": publish("/x"), "/b": publish("/y")})
    # Each enclave has a node of another name.
    (folder / "p.xml").write_text('node="m"'.join(policy.rsplit('node="n"', 1)))
    (folder / "more.xml").write_text(policy_text({"/a": publish("/x", "/more")}))
    sros("generate_artifacts", "-k", "ks", "-p", "p.xml", cwd=folder).ok()
    sros("zenoh", "ks", cwd=folder).ok()
    sros("distribute_key", "ks", "/a", "/router", "robot", cwd=folder).ok()
    return folder


@pytest.fixture
def folder(made: Path, tmp_path: Path) -> Path:
    return copy_of(made, tmp_path / "w")


def found(folder: Path, *words: str) -> list[tuple[str, str]]:
    """The ids of the findings about Zenoh, with the files."""
    shown = json.loads(sros("check", *words, "--json", "--include", "zenoh.*", cwd=folder).out)
    return [(each["id"], each["file"]) for each in shown["findings"]]


@pytest.mark.parametrize("mode", ["client", "peer"])
def test_nothing_where_the_files_are_in_step(mode: str, folder: Path) -> None:
    sros("zenoh", "ks", "--mode", mode, cwd=folder).ok()
    sros("create_permission", "ks", "/a", "more.xml", cwd=folder).ok()
    sros("distribute_key", "ks", "/a", "/router", "robot", "--force", cwd=folder).ok()
    for place in ("ks", "ks/enclaves/a", "ks/enclaves/router", "robot", "robot/enclaves/router"):
        assert found(folder, place) == [], place
    sros("verify", "robot", cwd=folder).ok()


def test_a_keystore_without_a_network_needs_no_files(folder: Path) -> None:
    sros("zenoh", "ks", "--off", cwd=folder).ok()
    assert found(folder, "ks") == []
    sros("distribute_key", "ks", "/a", "other", cwd=folder).ok()
    for place in ("ks", "other"):
        missing = [("zenoh.missing", f"{place}/enclaves/a/session.json5")]
        assert found(folder, place, "--vendor", "zenoh") == missing


def test_a_change_that_is_also_signed_is_found_by_comparison_with_the_keystore(
    folder: Path,
) -> None:
    """A file of the router of earlier rights is signed, and no permissions of its own tell."""
    router = folder / "ks/enclaves/router"
    earlier = shutil.copytree(router, folder / "earlier")
    sros("create_permission", "ks", "/a", "more.xml", cwd=folder).ok()
    for file in ("router.json5", "router.p7s"):
        shutil.copy(earlier / file, router / file)
    wanted = [("zenoh.out-of-date", "ks/enclaves/router/router.json5")]
    assert found(folder, "ks") == found(folder, "ks/enclaves/router") == wanted
    assert found(folder, "ks/enclaves/a") == []
    sros("zenoh", "ks", cwd=folder).ok()
    assert found(folder, "ks") == []


def test_a_file_of_the_router_makes_no_router(folder: Path) -> None:
    """Nobody takes the nodes of an enclave out of an audit by a file that he puts there."""
    file = "enclaves/a/router.json5"
    shutil.copy(folder / "ks/enclaves/router/router.json5", folder / "ks" / file)
    assert found(folder, "ks") == [("zenoh.unsigned", f"ks/{file}")]
    sros("zenoh", "ks", cwd=folder).ok()
    assert (folder / "ks" / file).exists()  # it may be the user's
    shutil.copy(folder / "ks" / file, folder / "robot" / file)
    for place in ("ks", "robot"):
        keystore = OpenedKeystore(folder / place)
        assert router_enclaves(keystore, datetime.now(UTC)) == {"/router"}, place
        context = JoinContext(0, datetime.now(UTC))
        expected = audited_enclaves([folder / place], Vendor.FAST, context).nodes.expected
        assert "/a" in {node.enclave for node in expected}, place


DAMAGE = {
    "session.p7s": "zenoh.unsigned",
    "session.json5": "zenoh.missing",
}


@pytest.mark.parametrize("file", DAMAGE)
def test_what_is_missing_on_a_robot(file: str, folder: Path) -> None:
    (folder / "robot/enclaves/a" / file).unlink()
    assert found(folder, "robot") == [(DAMAGE[file], f"robot/enclaves/a/{file}")]
    ended = sros("verify", "robot", cwd=folder)
    assert ended.status == 1
    assert f"{file} is missing" in ended.err + ended.out
    assert (
        "In the keystore that has the CA keys: run `sros zenoh KEYSTORE`" in ended.err + ended.out
    )


def test_a_session_of_earlier_permissions_on_a_robot(folder: Path) -> None:
    sros("create_permission", "ks", "/a", "more.xml", cwd=folder).ok()
    shutil.copy(folder / "ks/enclaves/a/permissions.p7s", folder / "robot/enclaves/a")
    wanted = [("zenoh.out-of-date", "robot/enclaves/a/session.json5")]
    assert found(folder, "robot") == found(folder, "robot/enclaves/a") == wanted
    shown = json.loads(sros("verify", "robot", "--json", cwd=folder).out)
    assert not shown["ok"]
    assert [(each["enclave"], each["file"]) for each in shown["findings"]] == [
        ("/a", "session.json5")
    ]


def test_an_enclave_with_the_files_of_another(folder: Path) -> None:
    """All of them fit together; the node would have the rights of the other enclave."""
    sros("distribute_key", "ks", "/b", "robot", cwd=folder).ok()
    enclaves = folder / "robot/enclaves"
    shutil.copytree(enclaves / "a", enclaves / "b", dirs_exist_ok=True)
    checked = json.loads(sros("check", "robot", "--json", cwd=folder).out)["findings"]
    remedies = {each["id"]: each["remedy"] for each in checked if each["severity"] != "note"}
    again = {
        "keystore.key-twice": "Export these enclaves again.",
        "enclave.name-mismatch": "Export the enclave again.",
    }
    assert remedies.items() & again.items() == again.items()
    assert remedies.keys().isdisjoint({"keystore.serial-twice", "zenoh.out-of-date"})
    other = (
        "a process in enclave /b has the rights of /a, because the folder of /b has the files of /a"
    )
    assert [other in sros("env", "robot", name, cwd=folder).ok().err for name in ("/a", "/b")] == [
        False,
        True,
    ]
    sros("distribute_key", "ks", "/b", "robot", "--force", cwd=folder).ok()
    assert other not in sros("env", "robot", "/b", cwd=folder).err


def test_a_configuration_of_another_keystore(folder: Path) -> None:
    sros("generate_artifacts", "-k", "foreign", "-p", "p.xml", cwd=folder).ok()
    sros("zenoh", "foreign", cwd=folder).ok()
    for file in ("session.json5", "session.p7s"):
        shutil.copy(folder / "foreign/enclaves/a" / file, folder / "robot/enclaves/a" / file)
    assert found(folder, "robot") == [("zenoh.unsigned", "robot/enclaves/a/session.p7s")]


def test_hostile_configurations_are_findings(folder: Path) -> None:
    for text in (b"", b"[" * 100_000, b"\xff\x00", b'{"access_control": {}}', b"\x1b[2J"):
        (folder / "robot/enclaves/a/session.json5").write_bytes(text)
        ended = sros("verify", "robot", cwd=folder)
        assert ended.status == 1
        assert "\x1b" not in ended.out + ended.err
        assert found(folder, "robot") == [
            ("zenoh.other-document", "robot/enclaves/a/session.json5")
        ]
