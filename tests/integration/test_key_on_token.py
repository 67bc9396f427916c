"""Keys of enclaves on a PKCS#11 token: never in a file, and enforced by a real Fast DDS."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from sros_tool.keystore.layout import enclave_path
from tests.integration.fastdds import build, run_isolated_program
from tests.integration.test_token import MODULE, sros, token
from tests.support.children import LATE, run
from tests.support.harness import policy_text, publish

__all__ = ["token"]

ENGINE = any(Path("/usr/lib").glob("*/engines-3/pkcs11.so"))
pytestmark = pytest.mark.skipif(not MODULE, reason="softhsm2 is not installed")

DOMAIN = 124
TALKER, OTHER, LISTENER = "/talker", "/other", "/listener"


def secret_files(*folders: Path) -> set[str]:
    """The names of the files with a private key, which another test finds by the same words."""
    files = (path for folder in folders for path in folder.rglob("*") if path.is_file())
    return {path.name for path in files if b"PRIVATE KEY" in path.read_bytes()}


def pin_file(folder: Path) -> Path:
    path = folder / "pin"
    path.write_text("no-hex-1")
    path.chmod(0o600)
    return path


def asked(program: Path, env: dict[str, str], *pairs: tuple[Path, Path]) -> list[str]:
    """Ask Fast DDS which of the pairs of writer and reader communicate."""
    lines = "".join(f"{writer} {reader} rt/chatter {LATE}\n" for writer, reader in pairs)
    return run_isolated_program(program, DOMAIN, said=lines, env=env).stdout.splitlines()


@pytest.mark.dds
@pytest.mark.skipif(not ENGINE, reason="libengine-pkcs11-openssl is not installed")
def test_a_copy_of_the_folder_without_the_token_cannot_talk(
    token: dict[str, str], tmp_path: Path
) -> None:
    """The key is made on the token; the listener hears it, and hears another one at all times."""
    program = build("fastdds_oracle.cpp", tmp_path)
    home, robot, answer = (tmp_path / name for name in ("home", "robot", "answer.tgz"))
    hears = publish("/chatter").replace("publish", "subscribe")
    (at_home := tmp_path / "home.xml").write_text(
        policy_text({OTHER: publish("/chatter"), LISTENER: hears})
    )
    (at_robot := tmp_path / "robot.xml").write_text(policy_text({TALKER: publish("/chatter")}))
    token |= {"PKCS11_MODULE_PATH": MODULE, "ROS_DOMAIN_ID": str(DOMAIN)}
    place = f"pkcs11:token=robot;object=talker?pin-source=file:{pin_file(tmp_path)}"
    made = f"create_keystore {home} --template production --domain {DOMAIN}".split()
    signing = enclave_path(robot, TALKER) / "request.pem"
    for words in (
        made,
        ("generate_artifacts", "-k", home, "-p", at_home),
        ("create_request", TALKER, robot, "--key", place),
        ("sign_request", home, signing, "-p", at_robot, "-o", answer),
        ("import", answer, robot, "--ca", home / "public/permissions_ca.cert.pem"),
        ("verify", robot, "--tokens"),
    ):
        done = sros(token, *words)
        assert done.returncode == 0, done.stderr
    assert secret_files(robot) == set()
    shutil.copytree(robot, stolen := tmp_path / "stolen")
    other, listener = enclave_path(home, OTHER), enclave_path(home, LISTENER)
    both = ((enclave_path(robot, TALKER), listener), (other, listener))
    assert asked(program, token, *both) == ["heard", "heard"]
    thieves = ((enclave_path(stolen, TALKER), listener), (other, listener))
    without = token | {"SOFTHSM2_CONF": os.devnull}
    assert asked(program, without, *thieves) == ["writer joins", "heard"]
    # A token of the thief's own, with the same names and the same PIN, has another key.
    (tmp_path / "own").mkdir()
    own = tmp_path / "own.conf"
    own.write_text(f"directories.tokendir = {tmp_path / 'own'}\nobjectstore.backend = file\n")
    theirs = token | {"SOFTHSM2_CONF": str(own)}
    initialize = "--init-token --free --label robot --pin no-hex-1 --so-pin 5678"
    run(["softhsm2-util", *initialize.split()], env=theirs)
    assert sros(theirs, "create_request", TALKER, tmp_path / "x", "--key", place).returncode == 0
    failed = sros(theirs, "verify", stolen, "--tokens")
    assert (failed.returncode, "is not the key of cert.pem" in failed.stdout) == (1, True)
    assert asked(program, theirs, *thieves) == ["writer joins", "heard"]


def test_the_life_of_a_key_that_is_on_a_token(token: dict[str, str], tmp_path: Path) -> None:
    """Created, renewed, moved there from a file, reissued by a new CA, exported and revoked."""
    root, out = tmp_path / "ks", tmp_path / "out"
    pin = pin_file(tmp_path)
    place = f"pkcs11:token=robot?module-path={MODULE}&pin-source={pin}"
    del token["SROS_PKCS11_PIN"]
    known = token | {"PKCS11_MODULE_PATH": MODULE}

    def done(*words: object, status: int = 0, env: dict[str, str] = token) -> str:
        ended = sros(env, *words)
        assert ended.returncode == status, (words, ended.stdout, ended.stderr)
        assert "no-hex-1" not in ended.stdout + ended.stderr
        return ended.stdout + ended.stderr

    done("create_keystore", root, "--template", "production")
    assert "key.p11" in done("create_enclave", root, "/a", "/b", "--key", place, "--dry-run")
    done("create_enclave", root, "/a", "/b", "--key", place)
    done("create_enclave", root, "/file")
    assert secret_files(root / "enclaves") == {"key.pem"}
    uri = (root / "enclaves/a/key.p11").read_text()
    assert uri == f"pkcs11:token=robot;object=%2Fa;type=private?pin-source=file:{pin}\n"
    assert "unchanged" in done("create_enclave", root, "/a", "--key", place)
    taken = place.replace("robot?", "robot;object=%2Fa?")
    for name in ("/c", "/file"):  # the key of another enclave
        assert "key" in done("create_enclave", root, name, "--key", taken, status=2)
    # Without the token: what does not sign with the enclave's key.
    certificate = (root / "enclaves/a/cert.pem").read_bytes()
    without = token | {"SOFTHSM2_CONF": os.devnull}
    done("renew", root, "/a", env=without)
    assert (root / "enclaves/a/cert.pem").read_bytes() != certificate
    assert "--key" in done("renew", root, "/a", "--new-key", status=2)
    done("rotate_ca", root, "--finish", env=without)
    # At home, nothing replaces a key that is on its robot.
    done("create_request", "/robot", tmp_path / "robot")
    request = tmp_path / "robot/enclaves/robot/request.pem"
    done("sign_request", root, request, "-o", tmp_path / "answer.tgz")
    assert "on the robot" in done("renew", root, "/robot", "--key", place, status=2)
    done("revoke", root, "/robot")
    # From a file to the token, and to another key there.
    assert "made on it" not in done("renew", root, "/file", "--key", place, "--revoke-old")
    other = place.replace("robot?", "robot;object=later?")
    done("renew", root, "/b", "--key", other, "--revoke-old")
    assert secret_files(root / "enclaves") == set()
    assert done("distribute_key", root, "--all", out).count("the key is not exported") == 3
    assert secret_files(out) == set()
    assert done("verify", out, "--tokens", env=known).count("key on the token robot") == 3
    refused = done(
        "verify", out, "--tokens", status=1, env=without | {"PKCS11_MODULE_PATH": MODULE}
    )
    assert refused.count("[enclave.token-key]") == 1
    assert "the same for 2 more enclaves" in refused
    (out / "enclaves/a/key.p11").write_text(uri.replace("%2Fa", "later"))
    assert "not the key of cert.pem" in done("verify", out, "--tokens", status=1, env=known)
    done("revoke", root, "/a", env=without)
    assert not (root / "enclaves/a/key.p11").exists()
    assert "was revoked" in done("create_enclave", root, "/new", "--key", taken, status=2)
    # A lost certificate is issued again for the key on the token.
    (root / "enclaves/b/cert.pem").unlink()
    done("create_enclave", root, "/b", env=known)
    assert "/b  loadable" in done("inspect", root)


def test_a_key_that_was_ever_out_of_its_token_is_noticed(
    token: dict[str, str], tmp_path: Path
) -> None:
    from sros_tool.pki.keys import generate_key, key_pem

    (key := tmp_path / "key.pem").write_bytes(key_pem(generate_key()))
    words = f"--import {key} --token robot --label copied --id 01 --pin no-hex-1"
    run(["softhsm2-util", *words.split()], env=token)
    place = f"pkcs11:token=robot;object=copied?module-path={MODULE}"
    made = sros(token, "create_request", "/a", tmp_path / "robot", "--key", place)
    assert (made.returncode, "token.key-can-be-copied" in made.stderr) == (0, True), made.stderr
    assert "pin-source" not in (tmp_path / "robot/enclaves/a/key.p11").read_text()
    born = sros(
        token, "create_request", "/b", tmp_path / "robot", "--key", place + "&", "--dry-run"
    )
    assert born.returncode == 0, born.stderr
    # The PIN of the URI's file, and no other, is asked for.
    env = token | {"SROS_PKCS11_PIN": "", "PKCS11_MODULE_PATH": MODULE}
    no_pin = sros(env, "create_request", "/a", tmp_path / "robot", "--again")
    assert (no_pin.returncode, "SROS_PKCS11_PIN" in no_pin.stderr) == (2, True)
