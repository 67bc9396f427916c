"""No spelling of a PIN in a PKCS#11 URI is accepted, written, or shown."""

from __future__ import annotations

from pathlib import Path

import pytest

from sros_tool.errors import UsageError
from sros_tool.files import templates_dir
from sros_tool.keystore.issuing.keyring import Keyring
from sros_tool.pki.token import TokenUri, parse_token_uri
from tests.support.harness import sros

PIN = "98765432"
WITH_A_PIN = (
    "pkcs11:token=t;object=o;pin-value=98765432?module-path=/m",
    "pkcs11:pin-value=98765432;token=t;object=o?module-path=/m",
    "pkcs11:token=t;object=o?module-path=/m&pin-value=98765432",
    "pkcs11:token=t;object=o;pin%2Dvalue=98765432?module-path=/m",
    "pkcs11:token=t;object=o;%70in%252dvalue%3D98765432?module-path=/m",
    "pkcs11:token=t;object=o%3Bpin-value=98765432?module-path=/m",
    "pkcs11:token=t;object=o;PIN-Value=98765432?module-path=/m",
    "pkcs11:token=t;object=o;pin-\nvalue=98765432?module-path=/m",
    "PKCS11:token=t;object=o;pin-value=98765432?module-path=/m",
    " pkcs11:token=t;object=o;pin-value=98765432?module-path=/m",
    "pkcs11:token=t;object=o;pin=98765432?module-path=/m",
    "pkcs11:token=t;object=o;98765432?module-path=/m",
    "pkcs11:token=t;object=o;pin-source=98765432?module-path=/m",
    "pkcs11:token=t;object=o?module-path=/m&pin-source=98765432",
    "pkcs11:token=t;object=o?module-path=/m&pin-source=file:98765432",
    "pkcs11:token=t;object=o?module-path=/m&pin-source=data:,98765432",
    "pkcs11:token=t;object=o?pin-source=/a&pin-source=98765432&module-path=/m",
)


@pytest.mark.parametrize("uri", WITH_A_PIN)
def test_a_pin_is_refused_before_anything_is_written(uri: str, tmp_path: Path) -> None:
    (tmp_path / "t.toml").write_text(
        (templates_dir() / "production.toml")
        .read_text()
        .replace("[authorities]", f"[authorities]\nidentity_key = {uri!r}".replace("'", '"'))
    )
    for words, env in (
        (("--identity-key", uri, "--permissions-key", "p.pem"), {}),
        (("--permissions-key", "p.pem"), {"SROS_IDENTITY_KEY": uri}),
        (("--permissions-key", uri, "--dry-run"), {}),
        (("--template", "t.toml"), {}),
    ):
        ended = sros("create_keystore", "ks", "-vv", *words, env=env, cwd=tmp_path)
        assert ended.status in (1, 2), ended
        assert PIN not in ended.out + ended.err
        assert [path.name for path in tmp_path.iterdir()] == ["t.toml"]


def test_a_pin_in_settings_is_reported_by_check_but_not_shown(tmp_path: Path) -> None:
    root = tmp_path / "ks"
    sros("create_keystore", root).ok()
    settings = root / "sros.toml"
    text = settings.read_text()
    for key, reported in (("pkcs11:token=t;object=o", False), (WITH_A_PIN[0], True)):
        settings.write_text(text.replace("[authorities]", f'[authorities]\nidentity_key = "{key}"'))
        ended = sros("check", root, "-vv")
        assert ended.status == 1, ended  # the settings were edited by hand
        assert ("Remove pin-value" in ended.out) is reported, ended
        assert PIN not in ended.out + ended.err


@pytest.mark.parametrize(
    ("uri", "wanted"),
    [
        ("pkcs11:token=t;object=o", TokenUri("t", "o", "")),
        ("PKCS11:object=o;token=t;type=private", TokenUri("t", "o", "")),
        (
            "pkcs11:token=a%20b;object=o%3Bo?pin-source=file:/p%20q&module-path=/c++/m",
            TokenUri("a b", "o;o", "/c++/m", "/p q"),
        ),
    ],
)
def test_other_uris_are_read(uri: str, wanted: TokenUri) -> None:
    assert parse_token_uri(uri) == wanted
    assert Keyring(places={"identity": uri}).places


@pytest.mark.parametrize("uri", ["pkcs11:token=t", "pkcs11:object=o", "token=t;object=o", "x"])
def test_a_uri_without_a_key_is_refused(uri: str) -> None:
    with pytest.raises(UsageError):
        parse_token_uri(uri)
