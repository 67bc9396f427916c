"""A question or a change opens each file of a keystore once, and verifies each signature once."""

from __future__ import annotations

import ctypes
import errno
import re
from collections import Counter
from pathlib import Path

import pytest
from cryptography import x509

from sros_tool.pki import certificates, crl, smime
from tests.support import opens
from tests.support.harness import copy_of, forked, sros
from tests.support.long_form import some
from tests.support.opens import can_count, count_opens

ENCLAVES = [f"/e{number}" for number in range(13)]
POLICY = f"""<policy version="0.2.0"><enclaves>{
    "".join(
        f'<enclave path="{name}"><profiles><profile ns="/" node="n"><topics publish="ALLOW" '
        f'subscribe="ALLOW"><topic>chatter</topic></topics></profile></profiles></enclave>'
        for name in ENCLAVES
    )
}</enclaves></policy>"""
REQUIREMENTS = """[[only]]
publish = ["/chatter"]
enclaves = ["/e1"]
why = "to be decided"
"""
QUESTIONS = {
    "check": ("check", "ks"),
    "check --requirements": ("check", "ks", "--requirements", "requirements.toml"),
    "view": ("view", "ks", "-o", "view.html", "--force"),
    "explain": ("explain", "ks", "/e1", "publish", "/x"),
    "explain --who": ("explain", "ks", "--who", "publish", "/chatter"),
    "env": ("env", "ks", "/e1"),
    "inspect": ("inspect", "ks"),
    "verify": ("verify", "ks"),
    "metrics": ("metrics", "ks", "--policy", "policy.xml"),
}
CHANGES = {
    "generate_artifacts of one": ("generate_artifacts", "-k", "ks", "-e", "/more"),
    "generate_artifacts of a policy": ("generate_artifacts", "-k", "ks", "-p", "more.xml"),
    "generate_artifacts of what is there": ("generate_artifacts", "-k", "ks", "-p", "policy.xml"),
    "create_permission": ("create_permission", "ks", "/e2", "policy.xml"),
    "renew": ("renew", "ks", "/e3"),
    "renew --revoke-old": ("renew", "ks", "/e3", "--revoke-old"),
    "revoke": ("revoke", "ks", "/e4"),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the keystore ``ks`` of thirteen enclaves, revoked ones, and requirements."""
    folder = tmp_path_factory.mktemp("opened")
    (folder / "policy.xml").write_text(POLICY)
    (folder / "requirements.toml").write_text(REQUIREMENTS)
    sros("create_keystore", "ks", "--template", "production", cwd=folder).ok()
    (folder / "fleet.yaml").write_text("all: {hosts: {e1: {}}}")
    artifacts = ("generate_artifacts", "-k", "ks", "-p", "policy.xml")
    sros(*artifacts, "--fleet", "fleet.yaml", cwd=folder).ok()
    sros("create_enclave", "ks", "/gone", cwd=folder).ok()
    sros("revoke", "ks", "/gone", cwd=folder).ok()
    return folder


@pytest.mark.skipif(not can_count(), reason="the system does not count what is opened")
@pytest.mark.parametrize("words", some([*QUESTIONS.values()], 3), ids=" ".join)
def test_a_question_opens_each_file_once(words: tuple[str, ...], folder: Path) -> None:
    def ask() -> None:
        ended = forked(*words, cwd=folder)
        assert ended.status in (0, 1), ended

    opened = count_opens(folder / "ks", ask)
    for file in ("public/permissions_ca.cert.pem", "enclaves/e1/permissions.p7s"):
        assert opened[file] == 1
    assert {file: count for file, count in opened.items() if count > 1} == {}


@pytest.fixture
def changed(folder: Path, tmp_path: Path) -> Path:
    """A folder with a copy of the keystore, to be changed."""
    copy_of(folder, tmp_path / "changed")
    (tmp_path / "changed/more.xml").write_text(POLICY.replace('path="/e', 'path="/more/e'))
    return tmp_path / "changed"


@pytest.mark.skipif(not can_count(), reason="the system does not count what is opened")
@pytest.mark.parametrize("words", some([*CHANGES.values()], 3), ids=" ".join)
def test_a_change_opens_each_file_once(words: tuple[str, ...], changed: Path) -> None:
    def change() -> None:
        forked(*words, cwd=changed).ok()

    opened = count_opens(changed / "ks", change)
    assert opened["ledger.jsonl"] == 1
    # What is new is opened to be written, and may be read once to prove it; options may name robots
    # before the keystore is locked.
    twice = re.compile(r"\.sros-transaction/|fleet\.toml\Z")
    assert {file: n for file, n in opened.items() if n > (2 if twice.match(file) else 1)} == {}


def test_what_is_opened_twice_is_seen(tmp_path: Path) -> None:
    (tmp_path / "inside").mkdir()
    (tmp_path / "inside/file").write_text("content")
    (tmp_path / "link").symlink_to("inside/file")

    def read() -> None:
        for name in ("inside/file", "link"):
            (tmp_path / name).read_bytes()

    assert count_opens(tmp_path, read) == {"inside/file": 2}


def test_a_folder_that_is_gone_at_once_does_not_end_the_counting(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("content")

    def change() -> None:
        for number in range(100):
            (tmp_path / f"staged{number}").mkdir()
            (tmp_path / f"staged{number}").rmdir()
        (tmp_path / "file").read_bytes()

    assert count_opens(tmp_path, change) == {"file": 1}


def test_counting_that_ends_early_is_no_count(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def change() -> None:
        monkeypatch.setattr(opens._LIBC, "inotify_add_watch", fail)
        (tmp_path / "new").mkdir()

    def fail(*_: object) -> int:
        ctypes.set_errno(errno.ENOSPC)
        return -1

    with pytest.raises(AssertionError, match="No space left on device"):
        count_opens(tmp_path, change)


@pytest.mark.parametrize("words", some([*QUESTIONS.values()], 3), ids=" ".join)
def test_a_question_verifies_each_signature_once(
    words: tuple[str, ...], folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    verified = verifications(words, folder, monkeypatch)
    assert len(verified) > 1
    assert max(verified.values()) == 1


@pytest.mark.parametrize("words", some([*CHANGES.values()], 3), ids=" ".join)
def test_a_change_verifies_each_signature_once(
    words: tuple[str, ...], changed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    verified = verifications(words, changed, monkeypatch)
    assert max(verified.values()) == 1


def verifications(
    words: tuple[str, ...], folder: Path, monkeypatch: pytest.MonkeyPatch
) -> Counter[tuple[bytes, x509.Certificate]]:
    """Return how often a verb verifies each signature with each CA."""
    verified: Counter[tuple[bytes, x509.Certificate]] = Counter()
    of_message, of_certificate = smime.Signature._verify, certificates.is_signed

    def verify(self: smime.Signature, content: bytes, signer: x509.Certificate) -> bool:
        verified[self._value, signer] += 1
        return of_message(self, content, signer)

    def is_signed(
        signed_object: x509.Certificate | x509.CertificateRevocationList,
        tbs_bytes: bytes,
        authority: x509.Certificate,
    ) -> bool:
        verified[tbs_bytes, authority] += 1
        return of_certificate(signed_object, tbs_bytes, authority)

    monkeypatch.setattr(smime.Signature, "_verify", verify)
    for module in (certificates, crl):
        monkeypatch.setattr(module, "is_signed", is_signed)
    smime.parse.cache_clear()  # else what the question before has verified may be known
    assert sros(*words, cwd=folder).status in (0, 1)
    return verified
