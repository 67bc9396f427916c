"""The readers of sros, each with the documents that are mutated for it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import cached_property
from pathlib import Path

from cryptography import x509

from sros_tool.checks.zenoh import document_findings
from sros_tool.dds.decision.documents import read_governance_as, read_permissions_as
from sros_tool.dds.decision.vendors import Vendor
from sros_tool.dds.governance import parse_governance
from sros_tool.dds.permissions import parse_permissions
from sros_tool.demo.scenarios import read_scenario
from sros_tool.errors import SrosError
from sros_tool.explain.denials import propose, read_denials
from sros_tool.explain.log import explain_log
from sros_tool.keystore.confirmation import (
    last_confirmation,
    locked_confirmations,
    receive,
    store_confirmation,
)
from sros_tool.keystore.delivery.robot import import_answer
from sros_tool.keystore.describe import describe, history
from sros_tool.keystore.fleet_metrics import fleet_metrics
from sros_tool.keystore.fleet_status import fleet_status
from sros_tool.keystore.issuing.authority import check_imported_ca
from sros_tool.keystore.ledger import certificate_entry
from sros_tool.keystore.lifecycle.rotation import read_rotation, rotation_status
from sros_tool.keystore.participant import JoinContext
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.rights import load_rights
from sros_tool.keystore.template import parse_template, read_template, render_template
from sros_tool.names import check_enclave_name
from sros_tool.pki import smime
from sros_tool.pki.certificates import (
    Issuer,
    common_name,
    common_name_of,
    digest,
    enclave_subject,
    issued_by,
    key_digest,
    load_certificates,
    load_request,
    pem,
    subject_text,
)
from sros_tool.pki.chains import Checks, chain_fault
from sros_tool.pki.crl import load_crl, signed_by
from sros_tool.pki.keys import load_key
from sros_tool.policy.document import policy_xml, read_policy
from sros_tool.policy.rights import policy_rights
from sros_tool.prometheus import render_metrics
from sros_tool.report.sources import read_source
from sros_tool.translate import ros_rights
from sros_tool.translate_zenoh.rights import policy_of, rights_of_subjects
from sros_tool.validity import Window, iso
from sros_tool.zenoh.document import parse_configuration
from tests.fuzz.corpus import PASSPHRASE, Corpus
from tests.support.harness import copy_of

NOW = datetime(2026, 12, 1, tzinfo=UTC)
WINDOW = Window(NOW, NOW + timedelta(days=1))


class Place:
    """Where a reader finds and leaves files: the corpus, and a folder of its own."""

    def __init__(self, corpus: Corpus, folder: Path) -> None:
        self.corpus = corpus
        self.folder = folder
        (folder / "policy.xml").write_bytes((corpus.root / "policy.xml").read_bytes())

    @cached_property
    def keystore(self) -> Path:
        """A copy of the keystore of the corpus."""
        return copy_of(self.corpus.keystore, self.folder / "ks")

    @cached_property
    def authority(self) -> x509.Certificate:
        return load_certificates(self.corpus.read(CA)[0], "of the corpus")[0]

    @cached_property
    def permissions_ca(self) -> x509.Certificate:
        path = "ks/public/permissions_ca.cert.pem"
        return load_certificates(self.corpus.read(path)[0], "of the corpus")[0]

    def put(self, name: str, data: bytes) -> Path:
        """Write a file of the folder, and return its path."""
        path = self.folder / name
        path.write_bytes(data)
        return path

    def replace(self, name: str, data: bytes) -> None:
        """Write a file of the keystore."""
        (self.keystore / name).write_bytes(data)


Read = Callable[[bytes, Place], object]


@dataclass(frozen=True)
class Reader:
    """A reader; ``corpus`` are the paths, in the corpus, of the documents that are mutated."""

    read: Read
    corpus: tuple[str, ...]
    weight: int = 1
    """How many inputs it gets, relative to other readers."""


# ── keys and certificates ──────────────────────────────────────────────────────────────────


def _certificate(data: bytes, place: Place) -> None:
    """Read a certificate, and use it for everything that certificates are used for."""
    authority = place.authority
    chain = load_certificates(data, "drawn")
    first = chain[0]
    for each in chain:
        assert issued_by(each, each) in (True, False)
        _ = subject_text(each.subject), common_name_of(each.issuer), digest(each), pem(each)
        certificate_entry(NOW, "certificate", each)
    for checks in (Checks.NONE, ~Checks.NONE):
        chain_fault(first, chain, [authority], moment=NOW, checks=checks)
        chain_fault(first, [authority], chain, moment=NOW, checks=checks)
    describe(place.put("cert.pem", data), now=NOW)
    key = place.corpus.key
    Issuer(first, key).issue(common_name("x"), key.public_key(), WINDOW)


def _imported(data: bytes, place: Place) -> None:
    check_imported_ca("identity", data, place.corpus.key, NOW)


def _request(data: bytes, place: Place) -> None:
    request = load_request(data, "drawn")
    check_enclave_name(request.name)
    key_digest(request.public_key)
    Issuer(place.authority, place.corpus.key).issue(
        enclave_subject(request.name, unique=True), request.public_key, WINDOW
    )


def _crl(data: bytes, place: Place) -> None:
    crl = load_crl(data, "drawn")
    signed_by(crl.list, place.authority)
    crl.revokes(1)
    describe(place.put("crl.pem", data), now=NOW)


def _key(data: bytes, place: Place) -> None:
    key = load_key(data, "drawn", lambda: PASSPHRASE)
    key_digest(key.public_key())
    with suppress(SrosError):  # it is encrypted
        describe(place.put("key.pem", data), now=NOW)


def _smime(data: bytes, place: Place) -> None:
    signed = smime.parse(data)
    signer = signed.signer()
    signed.digest_matches()
    if signer:
        signed.signatures[0].is_intact(signed.content, signer)
    describe(place.put("permissions.p7s", data), now=NOW)
    signed.verify(place.permissions_ca)


# ── documents ──────────────────────────────────────────────────────────────────────────────


def _permissions(data: bytes, place: Place) -> None:
    for vendor in Vendor:
        read_permissions_as(vendor, data)
    path = place.put("permissions.xml", data)
    for use in (lambda: describe(path, now=NOW), lambda: load_rights(path)):
        with suppress(SrosError):
            use()
    for grant in parse_permissions(data, "drawn").grants:
        with suppress(SrosError):
            iso(grant.validity.not_after)
        for rule in grant.rules:
            ros_rights(rule)
            str(rule.domains.closed())


def _governance(data: bytes, place: Place) -> None:
    for vendor in Vendor:
        read_governance_as(vendor, data)
    with suppress(SrosError):
        describe(place.put("governance.xml", data), now=NOW)
    str(parse_governance(data, "drawn").domains().closed())


def _policy(data: bytes, place: Place) -> None:
    policy = read_policy(place.put("drawn.xml", data))
    written = place.put("written.xml", policy_xml(policy))
    assert policy_rights(read_policy(written)) == policy_rights(policy)
    load_rights(place.folder / "drawn.xml")


def _template(data: bytes, place: Place) -> None:
    template = read_template(place.put("template.toml", data))
    parse_template(render_template(template), "rendered")


def _scenario(data: bytes, place: Place) -> None:
    read_scenario(place.put("scenario.toml", data))


def _observation(data: bytes, place: Place) -> None:
    read_source(place.put("observation.json", data), now=NOW)


def _log(data: bytes, _place: Place) -> None:
    text = data.decode("utf-8", "replace")
    explain_log(text, lambda _: None, lambda _: JoinContext(0, NOW), "ks")
    propose(read_denials(text))


# ── files of a keystore ────────────────────────────────────────────────────────────────────


def _ledger(data: bytes, place: Place) -> None:
    place.replace("ledger.jsonl", data)
    _ = OpenedKeystore(place.keystore).ledger
    history(OpenedKeystore(place.keystore), now=NOW)


def _zenoh(data: bytes, place: Place) -> None:
    document = parse_configuration(data, "drawn", [("scouting/multicast", "{enabled:true}")])
    for each in document_findings(document):
        str(each)
    policy_xml(policy_of(rights_of_subjects(document)))


def _rotation(data: bytes, place: Place) -> None:
    place.replace("rotation.json", data)
    read_rotation(OpenedKeystore(place.keystore))
    rotation_status(OpenedKeystore(place.keystore), now=NOW)


def _answer(data: bytes, place: Place) -> None:
    import_answer(place.corpus.robot, data, now=NOW, dry_run=True)


def _confirmation(data: bytes, place: Place) -> None:
    """Receive what a robot says that it has, keep it, and compare it with the keystore."""
    received = receive(data, "r7", "drawn", now=NOW)
    (place.keystore / "fleet.toml").write_text('enclaves = ["/{robot}"]\n[robots.r7]\n')
    with locked_confirmations(place.keystore):
        store_confirmation(OpenedKeystore(place.keystore), received)
    kept = last_confirmation(OpenedKeystore(place.keystore), "r7")
    assert kept and kept.confirmation == received.confirmation
    found = fleet_status(OpenedKeystore(place.keystore)).with_overdue(NOW, timedelta(days=1))
    assert [each.robot for each in found.robots] == ["r7"]
    assert "r7" in render_metrics(fleet_metrics(found, now=NOW))


CA = "ks/public/identity_ca.cert.pem"
READERS: dict[str, Reader] = {
    "certificate": Reader(
        _certificate,
        (CA, "ks/enclaves/a/cert.pem", "rsa.cert.pem", "ed25519.cert.pem"),
        4,
    ),
    "imported CA": Reader(_imported, (CA,)),
    "request": Reader(_request, ("request.pem", "rsa.csr"), 2),
    "revocation list": Reader(_crl, ("ks/public/identity_ca.crl.pem",), 3),
    "key": Reader(
        _key,
        ("sec1.pem", "rsa.pem", "ed25519.pem", "old.pem", "ks/private/identity_ca.key.pem"),
        2,
    ),
    "encrypted key": Reader(_key, ("encrypted.pem",)),
    "S/MIME": Reader(
        _smime,
        ("ks/enclaves/a/permissions.p7s", "ks/enclaves/governance.p7s"),
        3,
    ),
    "permissions": Reader(
        _permissions, ("ks/enclaves/a/permissions.xml", "ks/enclaves/r/permissions.xml"), 3
    ),
    "governance": Reader(_governance, ("ks/enclaves/governance.xml",), 2),
    "policy": Reader(_policy, ("policy.xml", "shipped.xml"), 3),
    "template": Reader(_template, ("ks/sros.toml",), 2),
    "scenario": Reader(_scenario, ("scenario.toml",), 2),
    "ledger": Reader(_ledger, ("ks/ledger.jsonl",)),
    "Zenoh": Reader(
        _zenoh,
        ("ks/enclaves/a/session.json5", "ks/enclaves/router/router.json5", "by_hand.json5"),
        3,
    ),
    "confirmation": Reader(_confirmation, ("confirmation.json",), 2),
    "rotation": Reader(_rotation, ("ks/rotation.json",)),
    "answer": Reader(_answer, ("answer.tar.gz",)),
    "log": Reader(_log, ("log",), 2),
    "observation": Reader(_observation, ("observation.json",), 2),
}
