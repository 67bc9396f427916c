"""Kept replies of vendors: what is made alike has one form, and what differs has another."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from sros_tool.pki import smime
from sros_tool.pki.keys import load_key
from tests.integration.kept import replies
from tests.integration.kept.forms import form_of, form_of_text
from tests.integration.kept.replies import AGAIN, answered
from tests.support.harness import certificate, copy_of, policy_text, publish, sros
from tests.support.long_form import drawn

NOW = datetime.now(UTC)
BOTH = {"/a": publish("old_a"), "/b": publish("old_b")}


def form(root: Path, at: datetime | None = None) -> str:
    return form_of([root / "enclaves/a", root / "enclaves/b"], at or datetime.now(UTC))


def make(root: Path, policy: dict[str, str]) -> Path:
    (root.parent / "policy.xml").write_text(policy_text(policy))
    sros("create_keystore", root, "--template", "production").ok()
    sros("generate_artifacts", "-k", root, "-p", root.parent / "policy.xml").ok()
    return root


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("first") / "ks", BOTH)


def test_what_is_made_alike_has_one_form(
    first: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    made = [make(tmp_path_factory.mktemp("made") / "ks", BOTH) for _ in range(3)]
    # The random part of an enclave's subject consists of digits alone in one of 900 keystores.
    assert len({form(each) for each in (first, *made)}) < 3
    assert "BEGIN CERTIFICATE" in form(first)


def test_the_random_part_of_the_name_of_a_ca_may_be_digits_alone() -> None:
    forms = {form_of_text(f"CN=sros identity CA {part}", NOW) for part in ("12345678", "1234abcd")}
    assert len(forms) == 1


def edit(name: str, old: bytes, new: bytes) -> Callable[[Path], object]:
    def work(root: Path) -> None:
        path = root / "enclaves/a" / name
        data = path.read_bytes()
        assert old in data
        path.unlink()
        path.write_bytes(data.replace(old, new, 1))

    return work


def sign_with_own_key(root: Path) -> None:
    folder = root / "enclaves/a"
    document = (folder / "permissions.xml").read_bytes()
    key = load_key((folder / "key.pem").read_bytes(), "key.pem")
    (folder / "permissions.p7s").write_bytes(
        smime.sign(document, certificate(folder / "cert.pem"), key)
    )


def swap(name: str) -> Callable[[Path], object]:
    def work(root: Path) -> None:
        shutil.copy(root / "enclaves/b" / name, root / "enclaves/a" / name)

    return work


CHANGES: dict[str, Callable[[Path], object]] = {
    "a letter of what is signed": edit("permissions.p7s", b"old_a", b"old_c"),
    "an end of a line": edit("permissions.p7s", b"\r\n", b"\n"),
    "another signer": sign_with_own_key,
    "the key of another enclave": swap("key.pem"),
    "the certificate of another enclave": swap("cert.pem"),
    "a list": lambda root: sros("revoke", root, "/b").ok(),
    "another key": lambda root: sros("rotate_ca", root, "--finish").ok(),
    "no certificate": lambda root: (root / "enclaves/a/cert.pem").unlink(),
}


@pytest.mark.parametrize("change", CHANGES)
def test_what_differs_has_another_form(change: str, first: Path, tmp_path: Path) -> None:
    root = copy_of(first, tmp_path / "ks")
    assert form(root) == form(first)
    CHANGES[change](root)
    assert form(root) != form(first)


@pytest.mark.parametrize("days", [-2, 366])
def test_another_moment_is_another_form(days: int, first: Path) -> None:
    assert form(first, NOW + timedelta(days=days)) != form(first)


def test_only_what_is_new_or_drawn_or_not_believed_is_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(replies, "HERE", tmp_path)
    asked: list[list[int]] = []

    def ask(places: list[int]) -> list[tuple[str, ...]]:
        asked.append(places)
        return [(f"reply {place}", "") for place in places]

    monkeypatch.setattr(replies, "KEEP", True)
    forms = [f"form {number}" for number in range(400)]
    first = answered("stack", forms, ask)
    monkeypatch.setattr(replies, "KEEP", False)
    assert answered("stack", [*forms, "new"], ask)[:-1] == first
    again = asked[1][:-1]
    assert asked[0] == list(range(400))
    assert asked[1][-1] == 400
    if drawn("everything", 0.0):
        assert len(again) == 400  # the long form
    else:
        assert 0 < len(again) < 4 * AGAIN * 400
        answered("stack", forms, ask, believe=lambda place, _: place != 7)
        assert 7 in asked[2]


def test_kept_replies_name_no_folder_of_a_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    error = "Subject name: CN=/t ({}/src/cpp/security/Permissions.cpp:743); rt/x"
    for file in replies.HERE.glob("*.txt"):
        assert not re.search(r"\(/[^()]*\.cpp:", file.read_text(encoding="utf-8")), file.name
    monkeypatch.setattr(replies, "HERE", tmp_path)
    monkeypatch.setattr(replies, "KEEP", True)
    answered("stack", ["form"], lambda places: [("refused", error.format("/build/fast"))])
    assert replies.kept_replies("stack", ["form"]) == [("refused", error.format("."))]
