"""A finding about a file names the cause: what the file is, or who signed it, and nothing else."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path

import pytest
from cryptography import x509

from sros_tool.checks.keystores.keystore import keystore_findings
from sros_tool.checks.keystores.opened import Circumstances
from sros_tool.explain.explanation import remedy
from sros_tool.faults import Fault
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.pki import smime
from sros_tool.pki.certificates import make_request, pem
from sros_tool.pki.keys import key_pem
from tests.checks.bench import Bench, name_of, new_key
from tests.checks.keystore_cases import IS_CA
from tests.support.harness import sros
from tests.support.long_form import some

pytest_plugins = ["tests.checks.sound_keystore"]
PERMISSIONS = "enclaves/base/permissions.p7s"
NO_SIGNING = x509.KeyUsage(True, False, False, False, False, False, False, False, False)
ONLY_LEAVES = (x509.BasicConstraints(True, 0), True)
Break = Callable[[Bench], object]
CAUSES: dict[str, tuple[str, Break]] = {}


def cause(finding: str, *texts: str) -> Callable[[Break], Break]:
    def add(work: Break) -> Break:
        for text in texts:
            CAUSES[text] = (finding, work)
        return work

    return add


@cause("enclave.certificate-malformed", "it is a signing request")
def _(bench: Bench) -> None:
    bench.path("enclaves/base/cert.pem").write_bytes(make_request(new_key(), "/base"))


@cause("enclave.signature", "an empty line before its headers")
def _(bench: Bench) -> None:
    path = bench.path(PERMISSIONS)
    path.write_bytes(b"\n" + path.read_bytes())


@cause("enclave.permissions-malformed", "its signed content is an S/MIME signed message")
def _(bench: Bench) -> None:
    path = bench.path(PERMISSIONS)
    signer = bench.authority("permissions"), bench.key("permissions")
    path.write_bytes(smime.sign(path.read_bytes(), *signer))


@cause("enclave.permissions-malformed", "its signed content is a text in UTF-16")
def _(bench: Bench) -> None:
    """Opaque, as OpenSSL signs it: the signed part of other messages has no zero byte."""
    folder = bench.root.parent
    text = bench.document(PERMISSIONS).encode("utf-16")
    (folder / "permissions.xml").write_bytes(b"Content-Type: text/plain\r\n\r\n" + text)
    (folder / "key.pem").write_bytes(key_pem(bench.key("permissions")))
    words = "smime -sign -nodetach -binary -in permissions.xml -inkey key.pem -signer"
    signer = bench.path("public/permissions_ca.cert.pem")
    out = ("-out", bench.path(PERMISSIONS))
    subprocess.run(["openssl", *words.split(), signer, *out], cwd=folder, check=True)


@cause("enclave.governance-malformed", "its elements have the prefix dds:")
def _(bench: Bench) -> None:
    space = 'xmlns:dds="http://www.omg.org/spec/DDS-Security"'
    bench.governance(("</", "@"), ("<", "<dds:"), ("@", "</dds:"), ("<dds:?", "<?"))
    bench.governance(("<dds:dds ", f"<dds:dds {space} "))


@cause("enclave.permissions-malformed", "it begins with <policy>")
def _(bench: Bench) -> None:
    bench.permissions(("<dds ", "<policy "), ("</dds>", "</policy>"))


@cause("enclave.refused", "has <enable_key_revision> where")
def _(bench: Bench) -> None:
    new = "<enable_key_revision>true</enable_key_revision>"
    bench.governance(("<topic_access_rules>", f"{new}<topic_access_rules>"))


@cause("enclave.certificate-issuer", "is not a CA: its keyUsage lacks keyCertSign")
def _(bench: Bench) -> None:
    bench.adopt("identity", bench.new_authority(IS_CA, (NO_SIGNING, True)))


@cause(
    "enclave.certificate-issuer",
    "identity_ca.cert.pem also has this issuer, but the chain is longer than the",
)
def _(bench: Bench) -> None:
    root, key = bench.new_authority(ONLY_LEAVES, common_name="root")
    middle, below = bench.new_authority(IS_CA, issuer=(root.subject, key), common_name="middle")
    last = bench.new_authority(IS_CA, issuer=(middle.subject, below), common_name="last")
    bench.adopt("identity", last)
    chain = b"".join(map(pem, (root, middle, last[0])))
    bench.path("public/identity_ca.cert.pem").write_bytes(chain)


@cause("enclave.signature", "it is signed by another CA named CN=")
def _(bench: Bench) -> None:
    name = bench.authority("permissions").subject.rfc4514_string()
    other, _ = bench.new_authority(IS_CA, common_name=name.removeprefix("CN="))
    bench.trust("permissions", other)


@cause("enclave.signature", "an earlier or later certificate of the permissions CA named CN=")
def _(bench: Bench) -> None:
    ca, key = bench.authority("permissions"), bench.key("permissions")
    later = (
        x509.CertificateBuilder(
            ca.subject, ca.subject, ca.public_key(), 7, bench.now, bench.now + timedelta(900)
        )
        .add_extension(*IS_CA)
        .sign(key, ca.signature_hash_algorithm)  # type: ignore[arg-type]
    )
    bench.trust("permissions", later)


@pytest.mark.parametrize("text", some([*CAUSES], 5))
def test_the_cause_is_said(text: str, bench: Bench) -> None:
    finding, work = CAUSES[text]
    assert not any(
        text in each.text
        for each in keystore_findings(OpenedKeystore(bench.root), Circumstances(bench.now))
    )
    work(bench)
    found = keystore_findings(OpenedKeystore(bench.root), Circumstances(bench.now))
    assert [each for each in found if each.id == finding and text in each.text], found


@pytest.mark.parametrize(
    ("said", "wrong"), [("/arm", True), ("arm", True), ("/gone", True), ("robot 7", False)]
)
def test_only_the_name_of_another_enclave_is_a_wrong_name(
    said: str, wrong: bool, bench: Bench
) -> None:
    """Other PKIs name enclaves in their own way, which no vendor compares with anything."""
    bench.issue(subject=name_of(("CN", said), ("OU", "1f")))
    found = {
        each.id for each in keystore_findings(OpenedKeystore(bench.root), Circumstances(bench.now))
    }
    assert ("enclave.name-mismatch" in found) == wrong


def test_a_copy_of_the_governance_is_replaced_by_the_link(bench: Bench) -> None:
    """The file that all enclaves depend on is intact: `explain` gives the same remedy."""
    path, edited = (
        bench.path("enclaves/base/governance.p7s"),
        bench.document("enclaves/governance.p7s"),
    )
    path.unlink()
    path.write_text(edited.replace("_control>true", "_control>false"))
    found = keystore_findings(OpenedKeystore(bench.root), Circumstances(bench.now))
    (said,) = {each.remedy for each in found if each.id == "enclave.not-signed"}
    assert said == remedy(Fault.NOT_SIGNED, str(bench.root), "/base", "governance.p7s")
    assert f"`rm {path} && sros create_enclave {bench.root} /base`" in said


@pytest.mark.parametrize(
    "file", ["backup.tar.gz", "ca.p12", "CA.PFX", "ca.key.pem.bak", "ks.zip", "ca.cert.pem~"]
)
def test_an_archive_where_others_read_is_named(file: str, bench: Bench) -> None:
    """Twin: in the folder of the keys of CAs, a copy of them is where it belongs."""
    for folder, named in (("public", True), ("private", False)):
        bench.path(f"{folder}/{file}").write_bytes(b"\x1f\x8b")
        found = keystore_findings(OpenedKeystore(bench.root), Circumstances(bench.now))
        assert any(each.id == "keystore.archive" and folder in each.file for each in found) == named
    (bench.export() / file).write_bytes(b"\x1f\x8b")
    found = keystore_findings(OpenedKeystore(bench.checked), Circumstances(bench.now))
    assert "keystore.archive" in {each.id for each in found}


def test_one_authority_is_named_where_no_file_of_a_ca_is(bench: Bench) -> None:
    """Someone else's export, in whose folder something of a CA lies, too."""
    bench.trust("permissions", bench.authority("identity"))
    (bench.export() / "private").mkdir(mode=0o700)
    found = [
        each
        for each in keystore_findings(OpenedKeystore(bench.checked), Circumstances(bench.now))
        if each.id == "keystore.one-authority" and not each.accepted
    ]
    assert found and all("In the keystore that has the CA keys" in each.remedy for each in found)


def test_a_folder_of_an_enclave_alone_can_be_checked_as_the_message_says(
    bench: Bench, tmp_path: Path
) -> None:
    alone = tmp_path / "robot7"
    shutil.copytree(bench.path("enclaves/base"), alone)
    ended = sros("check", alone)
    assert ended.status == 2
    steps = re.search(r"`mkdir -p robot/enclaves && cp -a (\S+) robot/enclaves/ && ", ended.err)
    assert steps and steps[1] == str(alone)
    shutil.copytree(alone, tmp_path / "robot/enclaves/robot7")
    assert sros("check", tmp_path / "robot").status in (0, 1)


def test_enclaves_without_the_revocation_list_share_one_finding(bench: Bench) -> None:
    bench.revoke(linked=False)
    found = keystore_findings(OpenedKeystore(bench.root), Circumstances(bench.now))
    assert [finding.subject for finding in found if finding.id == "enclave.crl-missing"] == [
        "/arm, /base"
    ]
