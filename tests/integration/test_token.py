"""CA keys on a PKCS#11 token (SoftHSM), which never touch the disk of the keystore."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from sros_tool import parallel
from sros_tool.keystore.layout import ROLES
from tests.support.children import run
from tests.support.harness import forked, snapshot

MODULES = ("/usr/lib/softhsm/libsofthsm2.so", "/usr/lib/x86_64-linux-gnu/softhsm/libsofthsm2.so")
MODULE = next((path for path in MODULES if Path(path).exists()), "")

pytestmark = pytest.mark.skipif(
    not (shutil.which("softhsm2-util") and MODULE), reason="softhsm2 is not installed"
)


@pytest.fixture
def token(tmp_path: Path) -> dict[str, str]:
    """The environment in which a token named robot is there, with the PIN no-hex-1."""
    (tmp_path / "tokens").mkdir()
    configuration = tmp_path / "softhsm2.conf"
    configuration.write_text(
        f"directories.tokendir = {tmp_path / 'tokens'}\nobjectstore.backend = file\n"
    )
    environment = {**os.environ, "SOFTHSM2_CONF": str(configuration), "SROS_PKCS11_PIN": "no-hex-1"}
    words = "--init-token --free --label robot --pin no-hex-1 --so-pin 5678"
    run(["softhsm2-util", *words.split()], env=environment)
    return environment


def sign_in_several_processes() -> None:
    """Share the work on ten enclaves, as otherwise on two hundred."""
    parallel._SMALLEST_SLICE = 5


def sros(environment: dict[str, str], *words: object) -> subprocess.CompletedProcess[str]:
    """Run the program in a process of its own, in which the token's library is loaded."""
    ended = forked(*words, env=environment, first=sign_in_several_processes)
    return subprocess.CompletedProcess(list(map(str, words)), ended.status, ended.out, ended.err)


def uri(name: str) -> str:
    return f"pkcs11:token=robot;object={name}?module-path={MODULE}"


def make(environment: dict[str, str], root: Path) -> None:
    keys = ["--identity-key", uri("identity"), "--permissions-key", uri("permissions")]
    done = sros(environment, "create_keystore", root, "--template", "production", *keys)
    assert done.returncode == 0, done.stderr


def test_the_keys_stay_on_the_token_and_openssl_agrees(
    token: dict[str, str], tmp_path: Path
) -> None:
    root = tmp_path / "ks"
    make(token, root)
    names = [f"/robot/part_{index}" for index in range(12)]  # enough for several processes
    done = sros(token, "create_enclave", root, *names)
    assert done.returncode == 0, done.stderr
    keys = [p for p in root.rglob("*") if p.is_file() and b"PRIVATE KEY" in p.read_bytes()]
    assert sorted({key.name for key in keys}) == ["key.pem"]  # those of the enclaves alone
    folder = root / "enclaves/robot/part_7"
    identity, permissions = (root / f"public/{r}_ca.cert.pem" for r in ("identity", "permissions"))
    for command in (
        ["verify", "-x509_strict", "-CAfile", identity, folder / "cert.pem"],
        ["smime", "-verify", "-text", "-in", folder / "permissions.p7s", "-CAfile", permissions],
        ["smime", "-verify", "-text", "-in", folder / "governance.p7s", "-CAfile", permissions],
    ):
        checked = subprocess.run(["openssl", *map(str, command)], capture_output=True, text=True)
        assert checked.returncode == 0, checked.stderr


def test_what_is_wrong_with_a_token_is_said(token: dict[str, str], tmp_path: Path) -> None:
    root = tmp_path / "ks"
    make(token, root)
    wrong_pin = sros(token | {"SROS_PKCS11_PIN": "9999"}, "create_enclave", root, "/a")
    assert (wrong_pin.returncode, "PinIncorrect" in wrong_pin.stderr) == (2, True)
    no_pin = sros(token | {"SROS_PKCS11_PIN": ""}, "create_enclave", root, "/a")
    assert (no_pin.returncode, "SROS_PKCS11_PIN" in no_pin.stderr) == (2, True)
    no_token = sros(token | {"SROS_IDENTITY_KEY": uri("nobody")}, "create_enclave", root, "/a")
    assert (no_token.returncode, "has no key 'nobody'" in no_token.stderr) == (2, True)
    leak = sros(
        token, "create_keystore", tmp_path / "x", "--identity-key", uri("i") + "&pin-value=1"
    )
    assert (leak.returncode, "pin-value" in leak.stderr) == (2, True)
    for ended in (wrong_pin, no_pin, no_token, leak):
        assert ended.stderr.count("\n") == 1, ended.stderr
    assert sros(token, "list_enclaves", root).stdout == ""
    assert sros(token, "create_enclave", root, "/a").returncode == 0


def test_everything_but_signing_works_without_the_token(
    token: dict[str, str], tmp_path: Path
) -> None:
    root = tmp_path / "ks"
    make(token, root)
    assert sros(token, "create_enclave", root, "/a").returncode == 0
    without = {**token, "SOFTHSM2_CONF": os.devnull}
    for words in (
        ("list_enclaves", root),
        ("inspect", root),
        ("env", root, "/a"),
        ("run", root, "/a", "--", "true"),
        ("distribute_key", root, "/a", tmp_path / "out"),
    ):
        ended = sros(without, *words)
        assert ended.returncode == 0, (words, ended.stderr)


def test_enclaves_are_renewed_and_revoked_by_the_token(
    token: dict[str, str], tmp_path: Path
) -> None:
    root = tmp_path / "ks"
    make(token, root)
    names = [f"/robot/part_{index}" for index in range(12)]  # enough for several processes
    assert sros(token, "create_enclave", root, *names).returncode == 0
    old = (root / "enclaves/robot/part_7/cert.pem").read_bytes()
    (tmp_path / "old.pem").write_bytes(old)
    for words in (
        ("renew", root, *names),
        ("renew", root, names[7], "--new-key"),
        ("revoke", root, names[8], "--reason", "key_compromise"),
        ("revoke", root, names[7]),
        ("create_enclave", root, names[7]),
        ("crl", root, "--refresh"),
    ):
        ended = sros(token, *words)
        assert ended.returncode == 0, (words, ended.stderr)
    identity, permissions = (root / f"public/{r}_ca.cert.pem" for r in ("identity", "permissions"))
    crl = ["-crl_check", "-CRLfile", root / "public/identity_ca.crl.pem"]
    verify = ["verify", "-x509_strict", *crl, "-CAfile", identity]
    for name, accepted in (
        (root / "enclaves/robot/part_7/cert.pem", True),
        (root / "enclaves/robot/part_9/cert.pem", True),
        (tmp_path / "old.pem", False),
        *((path, False) for path in sorted(root.glob("revoked/*/cert.pem"))),
    ):
        checked = subprocess.run(
            ["openssl", *map(str, [*verify, name])], capture_output=True, text=True
        )
        assert (checked.returncode == 0) is accepted, (name, checked.stderr)
        assert accepted or "certificate revoked" in checked.stderr
    assert len(list(root.glob("revoked/*"))) == 2
    message = root / "enclaves/robot/part_9/permissions.p7s"
    smime = ["smime", "-verify", "-text", "-in", message, "-CAfile", permissions]
    assert subprocess.run(["openssl", *map(str, smime)], capture_output=True).returncode == 0
    keys = [p for p in root.rglob("*") if p.is_file() and b"PRIVATE KEY" in p.read_bytes()]
    assert {key.name for key in keys} == {"key.pem"}


def test_without_the_token_nothing_is_renewed_or_revoked(
    token: dict[str, str], tmp_path: Path
) -> None:
    root = tmp_path / "ks"
    make(token, root)
    assert sros(token, "create_enclave", root, "/a", "/b").returncode == 0
    assert sros(token, "revoke", root, "/b").returncode == 0
    without = {**token, "SOFTHSM2_CONF": os.devnull}
    before = {path: path.read_bytes() for path in root.rglob("*") if path.is_file()}
    for words in (
        ("renew", root, "/a"),
        ("revoke", root, "/a"),
        ("crl", root, "--refresh"),
    ):
        ended = sros(without, *words)
        assert (ended.returncode, ended.stderr.count("\n")) == (2, 1), (words, ended.stderr)
    assert {path: path.read_bytes() for path in root.rglob("*") if path.is_file()} == before
    for reading in (
        ("crl", root),
        ("check", "keystore", root),
        ("inspect", root, "--history"),
    ):
        assert sros(without, *reading).returncode == 0, reading


def test_the_module_of_a_received_keystore_is_not_loaded(
    token: dict[str, str], tmp_path: Path
) -> None:
    """Its code would run; a module of root (the other tests), or one that the user names, may."""
    root, module = tmp_path / "ks", tmp_path / "module.so"
    shutil.copy(MODULE, module)
    module.chmod(0o755)
    tmp_path.chmod(0o777)
    places = {
        f"SROS_{role.upper()}_KEY": uri(role).replace(MODULE, str(module))
        for role in ("identity", "permissions")
    }
    assert sros(token | places, "create_keystore", root).returncode == 0
    before = snapshot(root)
    for words in (
        ("create_enclave", root, "/a"),
        ("create_enclave", root, "/a", "--dry-run"),
        ("crl", root, "--refresh"),
    ):
        refused = sros(token, *words)
        assert refused.returncode == 2, (words, refused.stderr)
        assert "PKCS11_MODULE_PATH" in refused.stderr
        assert "is not loaded" in refused.stderr
        assert snapshot(root) == before
    template = tmp_path / "template.toml"
    template.write_text((root / "sros.toml").read_text())
    refused = sros(token, "create_keystore", tmp_path / "new", "--template", template)
    assert (refused.returncode, "is not loaded" in refused.stderr) == (2, True)
    for named in ({"PKCS11_MODULE_PATH": str(module)}, {"PKCS11_MODULE_PATH": MODULE}, places):
        done = sros(token | named, "create_enclave", root, "/a")
        assert done.returncode == 0, done.stderr


def test_a_template_takes_no_key_of_the_token(token: dict[str, str], tmp_path: Path) -> None:
    root, new = tmp_path / "ks", tmp_path / "new"
    make(token, root)
    template = tmp_path / "template.toml"
    template.write_text((root / "sros.toml").read_text())
    known = token | {"PKCS11_MODULE_PATH": str(MODULE)}
    refused = sros(known, "create_keystore", new, "--template", template)
    assert (refused.returncode, new.exists()) == (2, False), refused.stderr
    assert "names an existing key" in refused.stderr
    keys = ["--identity-key", uri("identity"), "--permissions-key", uri("permissions")]
    named = sros(known, "create_keystore", new, "--template", template, *keys)
    assert named.returncode == 0, named.stderr


def test_a_dry_run_of_a_new_keystore_opens_no_token(token: dict[str, str], tmp_path: Path) -> None:
    broken = [f"--{role}-key=pkcs11:token=robot;object=o?module-path=/gone.so" for role in ROLES]
    planned = sros(token, "create_keystore", tmp_path / "ks", *broken, "--dry-run")
    assert planned.returncode == 0, planned.stderr
    assert sros(token, "create_keystore", tmp_path / "ks", *broken).returncode == 2
