"""An enclave whose key is on a token, without the token: what is read, refused, run and said."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path

import pytest

from sros_tool.dds.decision.vendors import CYCLONE_DDS, TESTED
from sros_tool.errors import PkiError, UsageError
from sros_tool.keystore.layout import list_enclaves
from sros_tool.keystore.participant import load_enclave
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.pki.token import TokenUri, parse_enclave_uri, parse_token_file, token_file_content
from tests.support.harness import Ended, copy_of, forked, sros

PIN = "98765432"
URI = "pkcs11:token=robot;object=arm;type=private"
FAST = {"RMW_IMPLEMENTATION": "rmw_fastrtps_cpp"}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("token") / "ks"
    sros("create_keystore", root).ok()
    sros("create_enclave", root, "/arm", "/file").ok()
    (root / "enclaves/arm/key.pem").unlink()
    (root / "enclaves/arm/key.p11").write_text(f"{URI}\n")
    return root


@pytest.fixture
def root(made: Path, tmp_path: Path) -> Path:
    return copy_of(made, tmp_path / "ks")


def place(root: Path, uri: str) -> None:
    (root / "enclaves/arm/key.p11").write_text(uri)


@pytest.mark.parametrize(
    "place",
    [
        TokenUri("robot", "arm", ""),
        TokenUri("a b;c?d&e=%", "/ärm/ ½", "", "/etc/sros/the pin&%"),
        TokenUri("r" * 32, "o" * 128, "", "/p"),
    ],
)
def test_what_is_written_is_read_and_has_no_separator_in_a_name(place: TokenUri) -> None:
    line = token_file_content(place)
    assert parse_token_file(line) == place
    assert len(line.split()) == 1
    path, _, query = line.decode().strip().partition("?")
    assert [len(path.split(";")), path.count("="), query.count("=")] == [3, 3, bool(query)]
    module = TokenUri(place.token, place.object, "/m.so", place.pin_source)
    assert token_file_content(module) == line  # libp11 0.4.12 takes no URI with a module


HOSTILE = (
    f"{URI}?pin-value={PIN}",
    f"{URI};pin-value={PIN}",
    f"{URI}?pin%2Dvalue={PIN}",
    f"{URI}?pin-source={PIN}",
    f"{URI}?pin-source=|{PIN}",
    f"{URI}?pin-source=/a&pin-source=/{PIN}",
    f"{URI}?module-path=/{PIN}.so",
    f"{URI};{PIN}=1",
    f"{URI};object={PIN}",
    f"pkcs11:object={PIN}",
    f"pkcs11:token={PIN}",
    f"pkcs11:token={PIN};object=o;type=cert",
    f"pkcs11:token={PIN};object=%00",
    f"pkcs11:token={PIN};object=a%0Ab",
    f"pkcs11:token={PIN};object=%E2%80%AE",
    f"pkcs11:token={PIN};object=" + "o" * 129,
    f"pkcs11:token={PIN * 5};object=o",
    f"PKCS11:token={PIN};object=o",
    f"{URI}\n{PIN}",
    f"{URI} {PIN}",
    f" {URI}#{PIN}",
    f"file:/{PIN}",
    f"{PIN}\0",
    URI + "?pin-source=/" + PIN * 300,
)


def test_a_hostile_place_is_refused_and_not_shown() -> None:
    """Whatever it says, nothing of it is in the error: it may have a PIN."""
    for data in HOSTILE:
        with pytest.raises(PkiError) as error:
            parse_token_file(data.encode())
        assert PIN not in f"{error.value} {error.value.why} {error.value.remedy}", data


@pytest.mark.parametrize("data", [HOSTILE[0], HOSTILE[9], HOSTILE[18]])
def test_verbs_refuse_a_hostile_place_and_show_nothing_of_it(data: str, root: Path) -> None:
    place(root, data)
    shown = sros("inspect", root)
    assert (shown.status, "/arm  NOT LOADABLE" in shown.out) == (1, True), shown
    refused = sros("run", root, "/arm", "--", "true", env={**os.environ, **FAST})
    assert refused.status == 2, refused
    for ended in (shown, refused, sros("inspect", root / "enclaves/arm/key.p11")):
        assert PIN not in ended.out + ended.err
        assert "traceback" not in (ended.out + ended.err).lower()
    assert "[enclave.token-uri]" in sros("check", "keystore", root).out


def test_a_place_that_is_no_text_or_no_file(root: Path) -> None:
    for data in (b"\xff\xfe", b"pkcs11:\xff=1", b"x" * 5_000_000):
        with pytest.raises(PkiError):
            parse_token_file(data)
    path = root / "enclaves/arm/key.p11"
    path.unlink()
    os.mkfifo(path)
    assert "it is not a regular file" in sros("inspect", root).out
    path.unlink()
    path.symlink_to("gone")
    assert sros("inspect", root).out.count("key.p") == 1
    path.unlink()
    path.write_text("")
    assert "key.p11: it is empty" in sros("inspect", root).out


@pytest.mark.parametrize(
    "uri",
    [
        "file:key.pem",
        "pkcs11:token=t;object=o?pin-value=1234",
        "pkcs11:token=t;object=o;serial=1",
        "pkcs11:object=o",
        "pkcs11:token=t;object=a%0A",
    ],
)
def test_a_place_that_cannot_be_used_is_refused_before_anything_is_made(
    uri: str, root: Path, tmp_path: Path
) -> None:
    for words in (
        ("create_enclave", root, "/new"),
        ("create_request", "/new", tmp_path / "robot"),
        ("renew", root, "/file"),
    ):
        ended = sros(*words, "--key", uri)
        assert (ended.status, ended.err.count("\n")) == (2, 1), ended
    assert (OpenedKeystore(root).has_enclave("/new"), (tmp_path / "robot").exists()) == (
        False,
        False,
    )


def test_one_key_is_not_given_to_two_enclaves(root: Path) -> None:
    ended = sros("create_enclave", root, "/x", "/y", "--key", "pkcs11:token=t;object=o")
    assert (ended.status, "several enclaves" in ended.err) == (2, True)
    with pytest.raises(UsageError, match="at most 32 bytes"):
        parse_enclave_uri(f"pkcs11:token={'t' * 33}", "/a")
    assert parse_enclave_uri("pkcs11:token=t?pin-source=/p", "/a/b") == TokenUri(
        "t", "/a/b", "", "/p"
    )


# ── running ────────────────────────────────────────────────────────────────────────────────


def started(root: Path, name: str, tmp_path: Path, **variables: str) -> Mapping[str, str]:
    """Return the environment of what `sros run` starts."""
    seen = tmp_path / "seen"
    script = f"env -0 > {seen}"
    env = {**os.environ, **FAST, **variables}
    ended: Ended = forked("run", root, name, "--", "sh", "-c", script, env=env)
    assert ended.status == 0, ended
    assert PIN not in ended.out + ended.err
    found = dict(each.partition("=")[::2] for each in seen.read_text().split("\0"))
    return {**found, "": ended.err}


def test_the_pin_reaches_the_node_of_its_token_and_no_other(root: Path, tmp_path: Path) -> None:
    pin = {"FASTDDS_PKCS11_PIN": PIN, "SROS_PKCS11_PIN": "1"}
    node = started(root, "/arm", tmp_path, **pin, PKCS11_MODULE_PATH="/m.so")
    assert (node["FASTDDS_PKCS11_PIN"], node["PKCS11_MODULE_PATH"]) == (PIN, "/m.so")
    assert "SROS_PKCS11_PIN" not in node
    assert "FASTDDS_PKCS11_PIN" not in started(root, "/file", tmp_path, **pin)
    assert "[token.no-pin]" in started(root, "/arm", tmp_path)[""]
    file = tmp_path / "pin"
    file.write_text(PIN)
    file.chmod(0o600)
    place(root, f"{URI}?pin-source=file:{file}\n")
    node = started(root, "/arm", tmp_path, **pin)
    assert ("FASTDDS_PKCS11_PIN" in node, node[""]) == (False, "")
    for form in ("sh", "json", "systemd"):
        env = {**os.environ, **FAST, **pin, "PKCS11_MODULE_PATH": "/m.so"}
        printed = sros("env", root, "/arm", "--format", form, env=env).ok().out
        assert (PIN in printed, "/m.so" in printed) == (False, True)
    words = ("env", root, "/arm", "--format", "kubernetes", "--target", "/etc/sros/keystore")
    told = sros(*words, "--image", "robot:1", env={**os.environ, **FAST}).ok().err
    assert f"the token's PKCS #11 module, and the PIN in '{file}'" in told
    file.write_text(f"{PIN}\n")
    assert "line break" in started(root, "/arm", tmp_path)[""]
    file.chmod(0o644)
    refused = sros("run", root, "/arm", "--", "true", env={**os.environ, **FAST})
    assert (refused.status, "chmod 600" in refused.err) == (2, True)
    assert "is missing or not protected" in refused.err
    assert "[enclave.pin-file]" in sros("check", "keystore", root).out
    file.unlink()
    refused = sros("run", root, "/arm", "--", "true", env={**os.environ, **FAST})
    assert (refused.status, "does not exist" in refused.err) == (2, True)


@pytest.mark.parametrize("rmw", ["rmw_cyclonedds_cpp", "rmw_connextdds", "rmw_zenoh_cpp"])
def test_no_process_of_another_rmw_starts(rmw: str, root: Path) -> None:
    for words in (("run", root, "/arm", "--", "true"), ("env", root, "/arm")):
        refused = sros(*words, env={**os.environ, "RMW_IMPLEMENTATION": rmw})
        assert (refused.status, f"a process of {rmw} cannot run" in refused.err) == (2, True)
        assert "ROS_SECURITY_KEYSTORE=/" not in refused.out
    sros("env", root, "/arm", env={**os.environ, **FAST}).ok()  # the same, with Fast DDS


def test_each_vendor_is_asked_whether_it_uses_the_key(root: Path) -> None:
    enclave = load_enclave("/arm", root / "enclaves/arm", moment=datetime.now(UTC))
    refusing = {each for each in TESTED if enclave.problems(each.traits)}
    assert refusing == {*CYCLONE_DDS}
    explained = sros("explain", root, "/arm", "join", "--all-vendors")
    assert "key.p11" in explained.out, explained
    listed = sros("check", "keystore", root, "--severity", "note").out
    assert "its key is 'arm' on the token 'robot'" in listed
    place(root, f"{URI}\n")
    shutil.copy(root / "enclaves/file/key.pem", root / "enclaves/arm/key.pem")
    both = sros("inspect", root)
    assert (both.status, "key.p11: the folder also has key.pem" in both.out) == (1, True), both


def test_a_folder_with_only_the_place_of_a_key_is_an_enclave(root: Path) -> None:
    for path in (root / "enclaves/arm").iterdir():
        if path.name != "key.p11":
            path.unlink()
    assert list_enclaves(root) == ("/arm", "/file")


def test_a_key_on_a_token_is_planned_without_the_package_for_tokens(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pkcs11", None)
    words = ("create_enclave", root, "/new", "--key", "pkcs11:token=robot;object=new")
    planned = sros(*words, "--dry-run").ok()
    assert "enclaves/new/key.p11" in planned.out
    assert "pip install" in sros(*words).err
