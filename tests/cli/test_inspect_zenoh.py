"""The verb inspect on Zenoh configurations: what it shows, and when they do not fit."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from tests.support.harness import copy_of, policy_text, publish, sros


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a keystore that has a Zenoh network; only to be copied."""
    folder = tmp_path_factory.mktemp("zenoh")
    rights = (
        publish("/x", "/cam*") + '\n<services request="ALLOW"><service>/add</service></services>'
    )
    (folder / "p.xml").write_text(policy_text({"/a": rights, "/b": publish("/y")}))
    (folder / "more.xml").write_text(policy_text({"/a": publish("/x", "/more")}))
    sros("generate_artifacts", "-k", "ks", "-p", "p.xml", cwd=folder).ok()
    sros("zenoh", "ks", cwd=folder).ok()
    return folder


@pytest.fixture
def folder(made: Path, tmp_path: Path) -> Path:
    return copy_of(made, tmp_path / "w")


def shown(folder: Path, path: str, status: int = 0) -> dict[str, Any]:
    text = sros("inspect", path, cwd=folder)
    ended = sros("inspect", path, "--json", cwd=folder)
    assert text.status == ended.status == status, (text, ended)
    value: dict[str, Any] = json.loads(ended.out)
    return value


RIGHTS = {
    "services": {"request": ["/add"]},
    "topics": {"publish": ["/cam$*/**", "/x"]},
}


@pytest.mark.parametrize("file", ["session.json5", "session.p7s"])
def test_a_session_shows_its_own_rights(file: str, folder: Path) -> None:
    found = shown(folder, f"ks/enclaves/a/{file}")
    assert (found["kind"], found["mode"], found["made_by_sros"]) == (
        "Zenoh configuration", "client", True,
    )  # fmt: skip
    assert found["connect"] == ["tls/localhost:7447"]
    assert found["access_control"]["default"] == "deny"
    assert found["rights"] == [{"enclave": "/router", "own_rights_by_router": True, "may": RIGHTS}]
    assert (found["signed"], found["signature_verified"], found["problems"]) == (True, True, [])
    assert found["domains"] == [0]
    said = sros("inspect", f"ks/enclaves/a/{file}", cwd=folder).ok().out
    assert "through the router /router this enclave may" in said
    assert "publish topics: /cam$*/**, /x" in said


@pytest.mark.parametrize("path", ["router/router.json5", "router/router.p7s"])
def test_a_router_shows_the_rights_of_all(path: str, folder: Path) -> None:
    found = shown(folder, f"ks/enclaves/{path}")
    assert found["mode"] == "router"
    assert {each["enclave"]: each["may"] for each in found["rights"]} == {
        "/a": RIGHTS,
        "/b": {"topics": {"publish": ["/y"]}},
    }
    said = sros("inspect", f"ks/enclaves/{path}", cwd=folder).ok().out
    assert "processes of /a may request 1 service, publish 2 topics\n" in said


def test_an_enclave_shows_its_files(folder: Path) -> None:
    assert shown(folder, "ks/enclaves/a")["zenoh"] == {
        "files": [{"file": "session.json5", "mode": "client"}],
        "problems": [],
    }
    sros("zenoh", "ks", "--off", cwd=folder).ok()
    assert shown(folder, "ks/enclaves/a")["zenoh"] is None


def test_a_configuration_that_is_not_the_signed_one(folder: Path) -> None:
    path = folder / "ks/enclaves/a/session.json5"
    path.write_bytes(path.read_bytes().replace(b'"deny"', b'"allow"'))
    found = shown(folder, "ks/enclaves/a/session.json5", 1)
    assert found["signature_verified"] is False
    assert found["signature_problem"] == "session.json5 is not the document that session.p7s signs"
    assert found["made_by_sros"] is False
    found = shown(folder, "ks/enclaves/a/session.p7s", 1)
    assert found["signature_verified"] is True
    assert found["problems"] == [
        "session.json5: it is not the document that the permissions CA signed in session.p7s"
    ]
    assert shown(folder, "ks/enclaves/a", 1)["zenoh"]["files"] == []


def test_a_signed_configuration_of_earlier_permissions(folder: Path) -> None:
    earlier = shutil.copytree(folder / "ks/enclaves/a", folder / "earlier")
    sros("create_permission", "ks", "/a", "more.xml", cwd=folder).ok()
    for file in ("session.json5", "session.p7s"):
        shutil.copy(earlier / file, folder / "ks/enclaves/a" / file)
        found = shown(folder, f"ks/enclaves/a/{file}", 1)
    assert found["problems"] == ["session.json5: it does not state the rights of permissions.p7s"]


def test_a_configuration_without_its_signature(folder: Path) -> None:
    (folder / "ks/enclaves/a/session.p7s").unlink()
    assert shown(folder, "ks/enclaves/a/session.json5")["signed"] is False
    ca = folder / "ks/public/permissions_ca.cert.pem"
    ended = sros("inspect", "ks/enclaves/a/session.json5", "--ca", ca, cwd=folder)
    assert ended.status == 1
    assert "not signed" in ended.out


def test_a_configuration_of_another_ca(folder: Path) -> None:
    sros("create_keystore", "other", cwd=folder).ok()
    ca = folder / "other/public/permissions_ca.cert.pem"
    for file in ("session.json5", "session.p7s"):
        ended = sros("inspect", f"ks/enclaves/a/{file}", "--ca", ca, cwd=folder)
        assert ended.status == 1
        assert "SIGNATURE DOES NOT VERIFY" in ended.out


def test_a_configuration_that_sros_did_not_write(tmp_path: Path) -> None:
    (tmp_path / "my.json5").write_text(
        """{mode: "peer", listen: {endpoints: ["tcp/[::]:0"]}, // a comment
        access_control: {enabled: false}}"""
    )
    found = shown(tmp_path, "my.json5")
    assert (found["mode"], found["listen"]) == ("peer", ["tcp/[::]:0"])
    assert (found["made_by_sros"], found["rights"]) == (False, [])
    assert "access control: OFF: 0 rules" in sros("inspect", "my.json5", cwd=tmp_path).ok().out


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "[]",
        "{" * 100_000,
        '{mode: "x\\u001b[2J"}',
        "{connect: {endpoints: [1]}}",
        "{a:" * 5000,
    ],
)
def test_what_is_no_configuration_is_refused_in_a_line(text: str, tmp_path: Path) -> None:
    (tmp_path / "my.json5").write_text(text)
    ended = sros("inspect", "my.json5", cwd=tmp_path)
    assert (ended.status, ended.out) == (2, "")
    assert len(ended.err.splitlines()) == 1
    assert "\x1b" not in ended.err


def test_hostile_names_stay_on_their_line(tmp_path: Path) -> None:
    (tmp_path / "my.json5").write_text(
        '{connect: {endpoints: ["tls/a\\u001b[2J\\nsigned by the CA: signature verified"]}}'
    )
    ended = sros("inspect", "my.json5", cwd=tmp_path)
    assert "\x1b" not in ended.out
    assert not any(line.startswith("signed by") for line in ended.out.splitlines())
