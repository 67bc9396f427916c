"""Of drawn revocation lists, sros accepts and refuses what OpenSSL does."""

from __future__ import annotations

import random
from collections import Counter
from datetime import UTC, datetime, timedelta

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding

from sros_tool.pki.certificates import common_name
from sros_tool.pki.crl import Obstacle, list_refusal
from tests.integration.libcrypto import CRL_CHECK, libcrypto
from tests.support.children import LONG
from tests.support.openssl import takes_changes_for_lists

DRAWN = 6000 if LONG else 200
NOW = datetime.now(UTC).replace(microsecond=0)
DAY = timedelta(days=1)
KEYS = [ec.generate_private_key(ec.SECP256R1()) for _ in range(3)]
NAMES = ("root", "CA", "leaf")
PLACE = [x509.UniformResourceIdentifier("http://x")]
OTHER = [x509.UniformResourceIdentifier("http://y")]
KNOWN = {
    3: Obstacle.MISSING, 8: Obstacle.SIGNATURE, 11: Obstacle.NOT_YET_VALID, 12: Obstacle.EXPIRED,
    23: Obstacle.REVOKED, 35: Obstacle.USAGE, 36: Obstacle.CRITICAL, 44: Obstacle.SCOPE,
}  # fmt: skip
"""The errors of OpenSSL (x509_vfy.h)."""


def draw_certificate(
    dice: random.Random, place: int, above: x509.Certificate | None
) -> x509.Certificate:
    ca = place < 2
    builder = x509.CertificateBuilder(
        above.subject if above else common_name(NAMES[place]), common_name(NAMES[place]),
        KEYS[place].public_key(), place + 1, NOW - 9 * DAY, NOW + 9 * DAY,
    ).add_extension(x509.BasicConstraints(ca, None), critical=True)  # fmt: skip
    if dice.random() < 0.7:
        signs = dice.random() < 0.8
        usage = x509.KeyUsage(True, False, False, False, False, ca, ca and signs, False, False)
        builder = builder.add_extension(usage, critical=True)
    if dice.random() < 0.7:
        key = KEYS[place].public_key()
        builder = builder.add_extension(
            x509.SubjectKeyIdentifier.from_public_key(key), critical=False
        )
    if not ca and dice.random() < 0.3:
        reasons = dice.choice((None, None, frozenset({x509.ReasonFlags.key_compromise})))
        issuer = dice.choice((None, None, [x509.DirectoryName(common_name("CA"))]))
        point = x509.DistributionPoint(dice.choice((PLACE, OTHER)), None, reasons, issuer)
        builder = builder.add_extension(x509.CRLDistributionPoints([point]), critical=False)
    signing = KEYS[max(place - 1, 0)] if above else KEYS[place]
    return builder.sign(signing, hashes.SHA256())


def draw_list(dice: random.Random, chain: list[x509.Certificate]) -> x509.CertificateRevocationList:
    mostly = dice.random
    begin, end = dice.choice([(-1, 5)] * 8 + [(-9, -1), (1, 5), (-2, 5)])
    issuer = dice.choice(["CA"] * 8 + ["root", "ca ", "another"])
    builder = x509.CertificateRevocationListBuilder(
        common_name(issuer), NOW + begin * DAY, NOW + end * DAY
    )
    if mostly() < 0.6:
        number = dice.choice((1, 1, 1, 0, 2))
        key = x509.SubjectKeyIdentifier.from_public_key(KEYS[number].public_key()).digest
        names = dice.choice((None, None, [x509.DirectoryName(common_name("root"))]))
        serial = dice.choice((2, 2, 7)) if names else None
        identifier = x509.AuthorityKeyIdentifier(dice.choice((key, key, None)), names, serial)
        if key or names:
            builder = builder.add_extension(identifier, critical=mostly() < 0.2)
    if mostly() < 0.4:
        users, cas, attributes, indirect = dice.choice(
            [(True, False, False, False)] * 3
            + [(False, True, False, False), (False, False, True, False)]
            + [(False, False, False, True), (False, False, False, False)]
        )
        where = dice.choice((None, PLACE, OTHER))
        reasons = dice.choice((None, None, None, frozenset({x509.ReasonFlags.key_compromise})))
        if where or reasons or users or cas or attributes or indirect:
            point = x509.IssuingDistributionPoint(
                where, None, users, cas, reasons, indirect, attributes
            )
            builder = builder.add_extension(point, critical=mostly() < 0.7)
    if mostly() < 0.15:
        builder = builder.add_extension(x509.DeltaCRLIndicator(1), critical=mostly() < 0.7)
    if mostly() < 0.7:
        builder = builder.add_extension(x509.CRLNumber(5), critical=mostly() < 0.1)
    if mostly() < 0.1:
        unknown = x509.UnrecognizedExtension(x509.ObjectIdentifier("1.2.3.4"), b"\5\0")
        builder = builder.add_extension(unknown, critical=mostly() < 0.6)
    for serial in dice.sample((2, 3, 3, 8, 9), dice.choice((0, 0, 1, 2))):
        entry = x509.RevokedCertificateBuilder(serial, NOW - DAY)
        if mostly() < 0.3:
            reason = dice.choice((x509.ReasonFlags.remove_from_crl, x509.ReasonFlags.superseded))
            entry = entry.add_extension(x509.CRLReason(reason), critical=mostly() < 0.3)
        if mostly() < 0.2:
            named = [x509.DirectoryName(common_name(dice.choice(("CA", "root"))))]
            entry = entry.add_extension(x509.CertificateIssuer(named), critical=mostly() < 0.8)
        builder = builder.add_revoked_certificate(entry.build())
    digest = dice.choice((*[hashes.SHA256()] * 8, hashes.SHA512(), hashes.SHA3_256()))
    return builder.sign(KEYS[1 if mostly() < 0.9 else 2], digest)  # type: ignore[arg-type]


def _has_only_changes(crl: x509.CertificateRevocationList) -> bool:
    return any(isinstance(each.value, x509.DeltaCRLIndicator) for each in crl.extensions)


def test_drawn_lists() -> None:
    openssl = libcrypto()
    if openssl is None:
        pytest.skip("there is no libcrypto.so.3")
    dice, count, wrong = random.Random(30), Counter[object](), []
    asked = 0
    for number in range(DRAWN):
        root = draw_certificate(dice, 0, None)
        above = draw_certificate(dice, 1, root)
        chain = [draw_certificate(dice, 2, above), above, root]
        lists = [draw_list(dice, chain) for _ in range(dice.choice((1, 1, 1, 2, 3)))]
        if any(map(_has_only_changes, lists)) and takes_changes_for_lists():
            continue
        asked += 1
        start, *trusted = (each.public_bytes(Encoding.DER) for each in chain)
        written = [each.public_bytes(Encoding.PEM) for each in lists]
        error = openssl.fault(start, trusted, flags=CRL_CHECK, lists=written)
        refusal = list_refusal(chain, lists, moment=NOW)
        found = refusal.obstacle if refusal else None
        theirs = KNOWN.get(error, error) if error else None
        count[theirs] += 1
        if (found is None) is not (theirs is None):
            wrong.append((number, theirs, refusal, [each.extensions for each in lists]))
        count["the same reason"] += found is theirs
    print(dict(count))
    assert not wrong, f"{len(wrong)}: {wrong[0]}"
    assert all(count[each] for each in (None, *KNOWN.values()))
    assert count["the same reason"] > 0.9 * asked
