"""A keystore of ros2/sros2 is one finding, is taken over by the first write, and stays sros's."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.pki.certificates import validity_of
from tests.support.harness import copy_of, policy_text, publish, sros
from tests.support.long_form import some
from tests.support.made_by_ros2 import RELEASES, make

NOW = datetime.now(UTC).replace(microsecond=0)
SERVICES = ("--exclude", "keystore.allow-everything")


def made_by_ros2(root: Path, release: str = "jazzy and rolling") -> Path:
    make(root, "/a", "/b/c", now=NOW, release=RELEASES[release])
    for path in root.rglob("*"):
        if not path.is_symlink():
            path.chmod(0o755 if path.is_dir() else 0o644)
    return root


def command_in(said: str) -> list[str]:
    """The words of the first command that a paragraph names."""
    found = re.search("`(sros .+?)`", " ".join(said.split()))
    assert found, said
    return shlex.split(found[1])[1:]


def paragraphs(said: str) -> int:
    """The number of findings that are shown, each with its severity."""
    return len(re.findall(r":\s(?:error|warning):\s", said))


@pytest.mark.parametrize("release", some([*RELEASES], 2))
def test_it_is_one_finding_with_one_command(release: str, tmp_path: Path) -> None:
    """Permissions without ros_discovery_info are another one, before and after."""
    root = made_by_ros2(tmp_path / "ks", release)
    no_node = not RELEASES[release].discovery
    left_out = (*SERVICES, "--exclude", "enclave.node-cannot-start")
    ended = sros("check", root, *SERVICES)
    assert ("no node may publish or subscribe ros_discovery_info" in ended.out) is no_node
    ended = sros("check", root, *left_out)
    assert ended.status == 1
    assert paragraphs(ended.out) == 1, ended.out
    assert f"{root}: error: a keystore that ros2/sros2 made" in " ".join(ended.out.split())
    assert "time-format" in ended.out and "key-readable" in ended.out
    sros(*command_in(ended.out)).ok()
    assert sros("check", root, *SERVICES).status == no_node
    ended = sros("check", root, *left_out).ok()
    for name in ("/a", "/b/c"):
        sros("renew", root, name).ok()


FIRST = (
    ("create_enclave", "{}", "/new"),
    ("renew", "{}", "/a"),
    ("revoke", "{}", "/a"),
    ("rotate_ca", "{}", "--next"),
    ("create_permission", "{}", "/a", "{policy}"),
)


@pytest.mark.parametrize("words", FIRST, ids=lambda words: words[0])
def test_the_first_write_takes_it_over_and_says_so(words: tuple[str, ...], tmp_path: Path) -> None:
    root = made_by_ros2(tmp_path / "ks")
    policy = tmp_path / "policy.xml"
    policy.write_text(policy_text({"/a": publish("x")}))
    words = tuple(each.format(root, policy=policy) for each in words)
    assert "adopt" in str(json.loads(sros(*words, "--dry-run", "--json").ok().out)["changes"])
    ended = sros(*words).ok()
    assert "which ros2/sros2 made" in ended.err and "are trusted" in ended.err
    assert OpenedKeystore(root).template.name == "sros2"
    found = {each["id"] for each in json.loads(sros("check", root, "--json").out)["findings"]}
    assert not found & {"keystore.settings-missing", "keystore.not-in-ledger"}
    assert not OpenedKeystore(root).ledger.gaps
    assert "accepted without proof" not in sros("renew", root, "/b/c").ok().err


def test_an_enclave_that_ros2_adds_later_is_one_finding(tmp_path: Path) -> None:
    root = made_by_ros2(tmp_path / "ks")
    copy_of(root, tmp_path / "with")
    shutil.rmtree(root / "enclaves/b")
    sros("update_keystore", root, "--template", "sros2").ok()
    copy_of(tmp_path / "with/enclaves/b", root / "enclaves/b")
    ended = sros("check", root, "--severity", "warning")
    assert paragraphs(ended.out) == 2, ended.out
    assert "an enclave that the keystore never issued" in " ".join(ended.out.split())
    assert "backup" not in ended.out and "Find out the source" not in ended.out
    policy = tmp_path / "POLICY_FILE"
    policy.write_text(policy_text({"/b/c": publish("x")}))
    said = ended.out[ended.out.index("enclave that the keystore") :]
    sros(*command_in(said), cwd=tmp_path).ok()
    sros("renew", root, "/b/c").ok()
    found = {each["id"] for each in json.loads(sros("check", root, "--json").out)["findings"]}
    assert "keystore.not-in-ledger" not in found


def _ca_without_identifier(root: Path) -> None:
    """Give the identity CA a certificate that anybody can make, because its key signs nothing."""
    path = root / "public/identity_ca.cert.pem"
    real = x509.load_pem_x509_certificate(path.read_bytes())
    builder = x509.CertificateBuilder(real.issuer, real.subject, real.public_key())
    validity = validity_of(real)
    builder = builder.serial_number(real.serial_number)
    builder = builder.not_valid_before(validity.not_before).not_valid_after(validity.not_after)
    builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=1), critical=True)
    forged = builder.sign(ec.generate_private_key(ec.SECP256R1()), hashes.SHA256())
    path.write_bytes(forged.public_bytes(serialization.Encoding.PEM))


def _identity_ca_of_ros2(root: Path) -> None:
    """Give the keystore an identity CA and certificates of somebody else's keystore."""
    other = made_by_ros2(root.parent / "other")
    for file in ("public/identity_ca.cert.pem", "private/identity_ca.key.pem"):
        (root / file).write_bytes((other / file).read_bytes())
    shutil.copy(other / "enclaves/a/cert.pem", root / "enclaves/a/cert.pem")


_NOT_CERTAIN = "not certain that enclave"


@pytest.mark.parametrize(
    ("forge", "template", "why"),
    [
        (None, "development", _NOT_CERTAIN),
        (_ca_without_identifier, "development", _NOT_CERTAIN),
        (_ca_without_identifier, "sros2", "signed by an earlier or later certificate"),
        (_identity_ca_of_ros2, "development", _NOT_CERTAIN),
    ],
)
def test_a_keystore_of_sros_without_its_records_is_not_one_of_ros2(
    forge: Callable[[Path], None] | None, template: str, why: str, tmp_path: Path
) -> None:
    """Whoever removes settings and ledger would have older permissions signed again."""
    root, policy = tmp_path / "ks", tmp_path / "policy.xml"
    sros("create_keystore", root, "--template", template).ok()
    for names in (("x", "wide"), ("x",)):
        policy.write_text(policy_text({"/a": publish(*names), "/b": publish("y")}))
        sros("generate_artifacts", "-k", root, "-p", policy).ok()
        if "wide" in names:
            older = (root / "enclaves/a/permissions.p7s").read_bytes()
    (root / "enclaves/a/permissions.p7s").write_bytes(older)
    for file in ("sros.toml", "ledger.jsonl", "ledger.p7s"):
        (root / file).unlink()
    if forge:
        forge(root)
    ended = sros("renew", root, "/a")
    assert ended.status == 2
    assert why in ended.err
    assert "ros2/sros2 made" not in sros("check", root).out
    if forge:
        return
    # The lines that one enclave gets in the ledger vouch for no other.
    sros("create_permission", root, "/b", policy).ok()
    separate = ("--set", "authorities.layout=separate")
    ended = sros("update_keystore", root, "--discard-edits", *separate)
    assert ended.status == 2
    assert "not certain that enclave /a has its" in ended.err
    assert (root / "enclaves/a/permissions.p7s").read_bytes() == older
