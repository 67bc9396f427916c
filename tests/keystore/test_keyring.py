"""The keys of the CAs: encrypted, outside the keystore, and found there again."""

from __future__ import annotations

import errno
import os
import sys
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest

from sros_tool.cli.common import keyring
from sros_tool.errors import KeystoreError, UsageError
from sros_tool.keystore.issuing.keyring import Keyring
from sros_tool.keystore.layout import list_enclaves
from sros_tool.keystore.lifecycle.create import create_enclaves, create_keystore
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.template import load_template
from tests.support.harness import policy_text, publish, sros

NOW = datetime.now(UTC)
RIGHT = "the right passphrase"


def answers(secret: str) -> Keyring:
    return Keyring(lambda _what: secret, encrypt=True)


def test_an_encrypted_key_signs_with_its_passphrase_only(tmp_path: Path) -> None:
    root = tmp_path / "ks"
    create_keystore(root, template=load_template("production"), now=NOW, keyring=answers(RIGHT))
    for key in root.glob("private/*.pem"):
        assert key.read_bytes().startswith(b"-----BEGIN ENCRYPTED PRIVATE KEY-----")
        assert key.stat().st_mode & 0o777 == 0o600
    with pytest.raises(KeystoreError, match="passphrase is wrong"):
        create_enclaves(root, ["/a"], now=NOW, keyring=answers("wrong"))
    with pytest.raises(KeystoreError, match="passphrase of the identity CA key is needed"):
        create_enclaves(root, ["/a"], now=NOW)
    assert list_enclaves(root) == ()
    create_enclaves(root, ["/a"], now=NOW, keyring=answers(RIGHT))
    assert list_enclaves(root) == ("/a",)


def test_a_passphrase_is_asked_for_once_per_key(tmp_path: Path) -> None:
    asked: list[str] = []

    def handler(what: str) -> str:
        asked.append(what)
        return RIGHT

    root = tmp_path / "ks"
    keyring = Keyring(handler, encrypt=True)
    create_keystore(root, template=load_template("production"), now=NOW, keyring=keyring)
    asked.clear()
    create_enclaves(root, [f"/e{i}" for i in range(250)], now=NOW, keyring=keyring)
    assert sorted(asked) == [
        "the passphrase of the identity CA key",
        "the passphrase of the permissions CA key",
    ]


def test_keys_away_from_the_keystore(tmp_path: Path) -> None:
    root, away = tmp_path / "ks", tmp_path / "stick"
    away.mkdir()
    places = {role: f"file:{away / role}.pem" for role in ("identity", "permissions")}
    template = load_template("production")
    create_keystore(root, template=template, now=NOW, keyring=Keyring(places=places))
    assert not (root / "private").exists()
    assert {key.stat().st_mode & 0o777 for key in away.iterdir()} == {0o600}
    assert OpenedKeystore(root).template.identity_key == places["identity"]
    create_enclaves(root, ["/a"], now=NOW)  # finds the keys by the settings
    away.rename(tmp_path / "drawer")
    with pytest.raises(KeystoreError, match="SROS_IDENTITY_KEY"):
        create_enclaves(root, ["/b"], now=NOW)
    moved = {role: f"file:{tmp_path / 'drawer' / role}.pem" for role in places}
    create_enclaves(root, ["/b"], now=NOW, keyring=Keyring(places=moved))
    assert list_enclaves(root) == ("/a", "/b")


def test_a_template_takes_no_key_that_exists(tmp_path: Path) -> None:
    """With the name of that CA, too, its certificates would be those of the other keystore."""
    single = load_template("sros2")
    create_keystore(tmp_path / "one", template=single, now=NOW)
    place = f"file:{tmp_path / 'one/private/ca.key.pem'}"
    hostile = replace(single, identity_key=place, permissions_key=place)
    for dry_run in (False, True):
        with pytest.raises(KeystoreError, match=r"names an existing key.*--identity-key file:"):
            create_keystore(tmp_path / "two", template=hostile, now=NOW, dry_run=dry_run)
    assert not (tmp_path / "two").exists()
    named = Keyring(places={"identity": place, "permissions": place})
    create_keystore(tmp_path / "two", template=hostile, now=NOW, keyring=named)
    new = replace(hostile, identity_key=f"file:{tmp_path / 'new.pem'}", permissions_key="")
    create_keystore(tmp_path / "three", template=new, now=NOW)
    create_enclaves(tmp_path / "three", ["/a"], now=NOW)


def test_a_key_of_another_ca_is_refused(tmp_path: Path) -> None:
    for name in ("one", "two"):
        create_keystore(tmp_path / name, template=load_template("production"), now=NOW)
    other = {"identity": f"file:{tmp_path / 'two/private/identity_ca.key.pem'}"}
    with pytest.raises(KeystoreError, match="do not belong together"):
        create_enclaves(tmp_path / "one", ["/a"], now=NOW, keyring=Keyring(places=other))


def test_a_failed_keystore_leaves_no_key_outside(tmp_path: Path) -> None:
    places = {
        "identity": f"file:{tmp_path / 'identity.pem'}",
        "permissions": f"file:{tmp_path / 'missing' / 'permissions.pem'}",
    }
    with pytest.raises(OSError, match="missing"):
        create_keystore(
            tmp_path / "ks",
            template=load_template("production"),
            now=NOW,
            keyring=Keyring(places=places),
        )
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_leaves_no_part_of_a_key_outside(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def write_half(handle: int, data: bytes) -> None:
        os.write(handle, data[: len(data) // 2])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("sros_tool.files.write_all", write_half)
    places = {"identity": f"file:{tmp_path / 'identity.pem'}"}
    with pytest.raises(OSError, match=os.strerror(errno.ENOSPC)):
        create_keystore(
            tmp_path / "ks",
            template=load_template("production"),
            now=NOW,
            keyring=Keyring(places=places),
        )
    assert list(tmp_path.iterdir()) == []


def test_a_single_ca_has_one_key_place(tmp_path: Path) -> None:
    template = load_template("sros2")
    with pytest.raises(KeystoreError, match="one place"):
        create_keystore(
            tmp_path / "ks",
            template=template,
            now=NOW,
            keyring=Keyring(places={"identity": f"file:{tmp_path / 'ca.pem'}"}),
        )
    places = dict.fromkeys(("identity", "permissions"), f"file:{tmp_path / 'ca.pem'}")
    create_keystore(tmp_path / "ks", template=template, now=NOW, keyring=Keyring(places=places))
    create_enclaves(tmp_path / "ks", ["/a"], now=NOW)


def test_the_program_takes_secrets_from_the_environment_or_a_file(tmp_path: Path) -> None:
    root, file = tmp_path / "ks", tmp_path / "passphrase"
    file.write_text(f"{RIGHT}\nsecond line\n")
    none = {"SROS_CA_PASSPHRASE": None, "SROS_CA_PASSPHRASE_FILE": None}
    by_value = none | {"SROS_CA_PASSPHRASE": RIGHT}
    sros("create_keystore", root, "--encrypt-ca-keys", env=by_value).ok()
    refused = sros("create_enclave", root, "/a", env=none)
    assert refused.status == 2
    assert "SROS_CA_PASSPHRASE" in refused.err
    by_file = none | {"SROS_CA_PASSPHRASE_FILE": str(file)}
    file.chmod(0o644)
    told = sros("create_enclave", root, "/a", env=by_file).ok().err
    assert told.count(f"(mode 0644): run `chmod 600 {file}`") == 1
    words = ("--job", "renew", "--passphrase-file", file, "--sros", "/usr/bin/sros")
    assert "(mode 0644)" in sros("units", root, tmp_path / "units", *words).ok().err
    file.chmod(0o600)
    assert "mode" not in sros("create_enclave", root, "/b", env=by_file).ok().err


def test_a_timer_finds_that_it_cannot_sign_before_something_is_to_sign(tmp_path: Path) -> None:
    root, file = tmp_path / "ks", tmp_path / "passphrase"
    file.write_text(RIGHT)
    file.chmod(0o600)
    env = {"SROS_CA_PASSPHRASE": None, "SROS_CA_PASSPHRASE_FILE": str(file)}
    (tmp_path / "policy.xml").write_text(policy_text({"/{robot}": publish("x")}))
    (tmp_path / "fleet.toml").write_text("[robots]\na = {}\n")
    (tmp_path / "inbox").mkdir()
    sros("create_keystore", root, "--template", "production", "--encrypt-ca-keys", env=env).ok()
    words = ("-p", tmp_path / "policy.xml", "--fleet", tmp_path / "fleet.toml")
    sros("generate_artifacts", "-k", root, *words, env=env).ok()
    timers = (("renew", root, "--all-expiring", "soon"), ("fleet", "collect", root, "inbox"))
    for timer in timers:
        sros(*timer, env=env, cwd=tmp_path).ok()
    file.write_text("another passphrase")
    for timer in timers:
        ended = sros(*timer, env=env, cwd=tmp_path)
        assert (ended.status, "The passphrase is wrong, or" in ended.err) == (2, True), ended
    file.unlink()
    for timer in timers:
        ended = sros(*timer, env=env, cwd=tmp_path)
        why = f"the passphrase file '{file}' cannot be read"
        assert (ended.status, why in ended.err) == (2, True), ended
    del env["SROS_CA_PASSPHRASE_FILE"]
    for timer in timers:
        ended = sros(*timer, env=env, cwd=tmp_path)
        assert (ended.status, "CA key is needed. There is no" in ended.err) == (2, True), ended
    for key in root.glob("private/*_ca.key.pem"):
        key.rename(tmp_path / key.name)
    for timer in timers:  # keys may be elsewhere on purpose until something is to sign
        sros(*timer, env=env, cwd=tmp_path).ok()


@pytest.mark.parametrize(
    ("secret", "insisted", "accepted"),
    [
        ("twelve chars", False, True),
        ("eleven char", False, False),
        ("eleven char ", False, False),
        ("x", False, False),
        ("x", True, True),
        ("", False, False),
    ],
)
def test_a_short_passphrase_needs_insisting(
    secret: str, insisted: bool, accepted: bool, tmp_path: Path
) -> None:
    env = {"SROS_CA_PASSPHRASE": secret, "SROS_SHORT_PASSPHRASE": "1" if insisted else None}
    made = sros("create_keystore", tmp_path / "ks", "--encrypt-ca-keys", env=env)
    assert (made.status == 0) is accepted, made
    assert (tmp_path / "ks").exists() is accepted
    if accepted:
        sros("create_enclave", tmp_path / "ks", "/a", env=env).ok()


def test_an_empty_passphrase_never_leaves_a_key_in_clear(tmp_path: Path) -> None:
    keyring = Keyring(lambda _: "", encrypt=True, short_passphrase=True)
    with pytest.raises(UsageError, match="too short"):
        create_keystore(tmp_path / "ks", template=load_template("sros2"), now=NOW, keyring=keyring)
    assert list(tmp_path.iterdir()) == []


def test_a_passphrase_from_a_pipe_serves_both_cas(tmp_path: Path) -> None:
    """As ``SROS_CA_PASSPHRASE_FILE=<(pass show ca)`` gives it: a pipe can be read once."""
    reading, writing = os.pipe()
    os.write(writing, RIGHT.encode())
    os.close(writing)
    try:
        env = {"SROS_CA_PASSPHRASE": None, "SROS_CA_PASSPHRASE_FILE": f"/dev/fd/{reading}"}
        sros("create_keystore", tmp_path / "ks", "--encrypt-ca-keys", env=env).ok()
    finally:
        os.close(reading)


def test_a_pipe_without_a_writer_is_not_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sros_tool.cli.common._WRITER_TIMEOUT", 0.2)
    os.mkfifo(tmp_path / "pipe")
    env = {"SROS_CA_PASSPHRASE": None, "SROS_CA_PASSPHRASE_FILE": str(tmp_path / "pipe")}
    refused = sros("create_keystore", tmp_path / "ks", "--encrypt-ca-keys", env=env)
    assert refused.status != 0
    assert "nobody writes to" in refused.err
    assert not (tmp_path / "ks").exists()


@pytest.mark.parametrize("where", ["variable", "file"])
def test_a_passphrase_that_is_no_text_is_refused_in_one_line(where: str, tmp_path: Path) -> None:
    secret = b"correct horse \xff battery"
    (tmp_path / "file").write_bytes(secret + b"\n")
    (tmp_path / "file").chmod(0o600)
    env = {"SROS_CA_PASSPHRASE": os.fsdecode(secret)}
    if where == "file":
        env = {"SROS_CA_PASSPHRASE_FILE": str(tmp_path / "file")}
    refused = sros("create_keystore", tmp_path / "ks", "--encrypt-ca-keys", env=env)
    assert (refused.status, refused.err.count("\n")) == (2, 1), refused
    assert "is not UTF-8 text" in refused.err
    assert "horse" not in refused.err


def test_the_name_of_a_token_cannot_control_the_terminal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A keystore from somebody else names the token, in the prompt for its PIN."""
    asked: list[str] = []

    def prompt(text: str, **_: object) -> str:
        asked.append(text)
        return "1234"

    monkeypatch.setattr(sys.stdin, "isatty", lambda: True)
    monkeypatch.setattr("click.prompt", prompt)
    monkeypatch.delenv("SROS_PKCS11_PIN", raising=False)
    assert keyring().secrets("the PIN of the token \x1b[2Jx") == "1234"
    assert asked == ["The PIN of the token \\x1b[2Jx"]
