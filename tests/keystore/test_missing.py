"""What is said of an enclave that is not there: the one that may be meant, or those that are."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from sros_tool.keystore.layout import (
    CLOSED_KEYSTORE,
    CLOSED_POLICY,
    CLOSED_PROCESSES,
    list_enclaves,
)
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.selection import likely_names, missing_enclave_error
from sros_tool.pki.certificates import load_certificate
from tests.support.harness import policy_text, publish, sros

THERE = ("/mobile_robot/base", "/mobile_robot/teleop", "/mobile_robot/velocity_mux", "/arm/base")


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("velocity_mux", ("/mobile_robot/velocity_mux",)),
        ("/velocity_mux", ("/mobile_robot/velocity_mux",)),
        ("mobile_robot/teleop", ("/mobile_robot/teleop",)),
        ("/mobile_robot/telop", ("/mobile_robot/teleop",)),
        ("/telop", ("/mobile_robot/teleop",)),
        ("/base", ("/arm/base", "/mobile_robot/base")),
        ("/MOBILE_ROBOT/TELEOP", ("/mobile_robot/teleop",)),
        ("/mobile_robot_velocity_mux", ("/mobile_robot/velocity_mux",)),
        ("/mobile_robot", ()),
        ("/camera", ()),
        ("/", ()),
        ("", ()),
    ],
)
def test_who_may_be_meant(name: str, meant: tuple[str, ...]) -> None:
    assert likely_names(name, THERE) == meant


def test_the_error_names_who_may_be_meant_and_does_not_say_to_make_it() -> None:
    text = str(missing_enclave_error(OpenedKeystore(Path("robot")), "/telop", THERE))
    assert text == (
        "enclave /telop does not exist in keystore 'robot'. Perhaps you mean /mobile_robot/teleop."
    )


def test_where_nobody_is_meant_the_error_says_who_is_there(tmp_path: Path) -> None:
    (tmp_path / "ks/public").mkdir(parents=True)
    text = str(
        missing_enclave_error(OpenedKeystore(tmp_path / "ks"), "/camera", [*THERE, "/x", "/y"])
    )
    assert (
        "/x and 1 more. If the name is right, create the enclave with `sros create_enclave " in text
    )


def test_a_namespace_is_not_taken_for_an_enclave_that_is_missing() -> None:
    text = str(
        missing_enclave_error(OpenedKeystore(Path("robot")), "/r1", ["/r1/base", "/r1/arm", "/r10"])
    )
    assert text == (
        "enclave /r1 does not exist in keystore 'robot'. There are only enclaves below it: "
        "/r1/arm, /r1/base. Name an enclave; verbs that take several enclaves also have --match "
        "'/r1/*'."
    )


def test_a_topic_service_or_action_is_not_taken_for_an_enclave(tmp_path: Path) -> None:
    groups = (
        '<services request="ALLOW"><service>/add</service></services>'
        '<actions execute="ALLOW"><action>/dock</action></actions>'
    )
    (tmp_path / "p.xml").write_text(policy_text({"/arm": publish("/cmd_vel") + groups}))
    sros("generate_artifacts", "-k", "ks", "-p", "p.xml", cwd=tmp_path).ok()
    for name, kind, verb in (
        ("/cmd_vel", "topic", "publish"),
        ("/add", "service", "call"),
        ("/dock", "action", "call"),
    ):
        err = sros("explain", "ks", "--reach", name, cwd=tmp_path).err
        assert f"{name} is a {kind} in the permissions of /arm. Name an enclave. " in err
        assert "create_enclave" not in err
        (command,) = re.findall(r"`sros (.*)`", err)
        assert command == f"explain ks --who {verb} {name}"
        assert sros(*command.split(), cwd=tmp_path).status < 2


def test_an_export_gets_it_from_its_keystore(tmp_path: Path) -> None:
    text = str(missing_enclave_error(OpenedKeystore(tmp_path), "/camera", THERE))
    assert f"export the enclave with `sros distribute_key KEYSTORE /camera {tmp_path}`." in text


def test_the_user_of_an_export_need_not_look_into_the_keystore_of_the_closed_robot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in (CLOSED_PROCESSES, CLOSED_POLICY):
        (tmp_path / name).touch()
    refused = tmp_path / CLOSED_KEYSTORE
    is_dir = Path.is_dir

    def is_seen(path: Path) -> bool:
        if path.is_relative_to(refused):
            raise PermissionError(13, "Permission denied", str(path))
        return is_dir(path)

    monkeypatch.setattr(Path, "is_dir", is_seen)
    text = str(missing_enclave_error(OpenedKeystore(tmp_path / "export"), "/camera", THERE))
    assert text.startswith(f"enclave /camera does not exist in keystore '{tmp_path}/export'. ")
    assert "write the enclave's rights into" in text


def test_a_name_that_could_not_be_made_is_told_so() -> None:
    error = missing_enclave_error(OpenedKeystore(Path("robot")), "camera", THERE)
    assert "does not start with '/'" in str(error)


def test_of_a_revoked_enclave_it_says_since_when(tmp_path: Path) -> None:
    root = tmp_path / "ks"
    sros("create_keystore", root).ok()
    sros("create_enclave", root, "/camera", "/camera2").ok()
    before = str(missing_enclave_error(OpenedKeystore(root), "/camera3", list_enclaves(root)))
    assert "Perhaps" in before and "was revoked" not in before
    first = _serial(root, "/camera")
    sros("renew", root, "/camera").ok()
    serial = _serial(root, "/camera")
    assert serial != first
    sros("revoke", root, "/camera", "--reason", "keyCompromise").ok()
    (entry, *_) = (
        e
        for e in OpenedKeystore(root).ledger.entries
        if e.what == "revocation" and e.serial == serial
    )
    said = (
        f"enclave /camera of keystore '{root}' was revoked at {entry.time} (keyCompromise). Its "
        f"files are in '{root}/revoked/{serial}'. To use it again, with another key: "
        f"`sros generate_artifacts -k {root} -e /camera -p POLICY_FILE`."
    )
    assert str(missing_enclave_error(OpenedKeystore(root), "/camera", list_enclaves(root))) == said
    for words in (("/camera", "publish", "/x"), ("--reach", "/camera")):
        found = sros("explain", root, *words)
        assert (found.status, found.out) == (2, "")
        assert said in found.err
    # Made anew it is there; and if its files are lost then, that is no revocation.
    sros("create_enclave", root, "/camera").ok()
    assert sros("explain", root, "/camera", "publish", "/x").ok().out.startswith("yes")
    assert "was revoked" not in str(
        missing_enclave_error(OpenedKeystore(root), "/camera", ["/camera2"])
    )


def test_a_broken_ledger_does_not_hide_that_the_enclave_is_missing(tmp_path: Path) -> None:
    (tmp_path / "ledger.jsonl").write_text("no entry\n")
    assert "/camera does not exist" in str(
        missing_enclave_error(OpenedKeystore(tmp_path), "/camera", THERE)
    )


def _serial(root: Path, name: str) -> str:
    certificate = load_certificate((root / "enclaves" / name[1:] / "cert.pem").read_bytes(), "it")
    return f"{certificate.serial_number:x}"
