"""Of many forged certificates, sros accepts no chain that OpenSSL rejects."""

from __future__ import annotations

import os
import random
from collections import Counter
from datetime import UTC, datetime, timedelta

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding

from sros_tool.errors import PkiError
from sros_tool.pki.certificates import common_name, load_der_certificate
from sros_tool.pki.chains import Checks, chain_fault
from tests.integration.forged_signatures import VALUES, Node, raw
from tests.integration.libcrypto import (
    CHECK_SS_SIGNATURE,
    POLICY_CHECK,
    STRICT,
    Libcrypto,
    libcrypto,
)
from tests.support.children import LONG

DRAWN = 20_000 if LONG else 100
SEED = int(os.environ.get("SROS_DIFFERENTIAL_SEED", "5"))
UNREADABLE = "it cannot be read"
DAMAGED_FIRST = "a damaged certificate of the issuer's name stands before the right one"
EMPTY_NAME = "a certificate has an empty subject or issuer"
STRICTER = {UNREADABLE, DAMAGED_FIRST, EMPTY_NAME}
"""Why sros refuses, on purpose, what OpenSSL accepts; and whatever sros says not to know.

OpenSSL accepts an empty subject next to critical alternative names, in a certificate of no CA.
"""
NOW = datetime.now(UTC).replace(microsecond=0)
DAY = timedelta(days=1)
KEYS = [ec.generate_private_key(ec.SECP256R1()) for _ in range(4)]

# By an OID, values as DER: sound ones first.
EXTENSIONS = {
    "2.5.29.19": ["30030101ff", "3000", "30060101ff020100", "30060101ff020101", "3003020100",
                  "30060101ff0201ff", "3003010101", "30030101ff00", "0400"],
    "2.5.29.15": ["03020106", "03020186", "03020780", "03020700", "030100", "0303070080",
                  "03020106ff", "0400"],
    "2.5.29.37": ["300a06082b06010505070304", "300a06082b06010505070301", "3000",
                  "30060604551d2500", "0400"],
    "2.5.29.17": ["3006820461622e63", "3000", "30038201ff", "0400", "300681046140622e"],
    "2.5.29.30": ["300ea00c300a8208726f626f742e6363", "300aa0083006820461622e63",
                  "3015a0133011a40f300d310b300906035504030c024c45",
                  "3017a0153013a411300f310d300b06035504030c044c454146",
                  "3017a1153013a411300f310d300b06035504030c044c454146", "300aa1083006820461622e63",
                  "3000", "300aa008300682046f2e6f72", "300aa0083006810461402e62", "0400", "a000"],
    "2.5.29.36": ["3003800100", "3003800101", "3000", "0400"],
    "2.5.29.54": ["020100", "0400"],
    "2.5.29.32": ["3006300406022a03", "300830060604551d2000", "3006300406022a04", "3000", "0400",
                  "300c300406022a03300406022a03"],
    "2.5.29.31": ["3000", "0400", "300c300aa008a006860461623a63"],
    "2.16.840.1.113730.1.1": ["03020106", "03020520", "0400"],
    "1.3.6.1.5.5.7.1.14": ["300c300a06082b06010505071501", "0400"],
    "1.3.6.1.5.5.7.1.7": ["3000", "300e300c04020001300603040001ff00", "0400"],
    "1.3.6.1.5.5.7.1.8": ["3000", "a0023000", "0400"],
    "1.3.6.1.5.5.7.1.1": ["3000", "0400"],
    "1.3.6.1.5.5.7.48.1.5": ["0500"],
    "1.2.3.4": ["0500"],
}  # fmt: skip


def extension(oid: str, data: bytes) -> x509.UnrecognizedExtension:
    return x509.UnrecognizedExtension(x509.ObjectIdentifier(oid), data)


def draw(
    dice: random.Random, name: str, above: tuple[str, int], own: int, *, ca: bool
) -> bytes | None:
    """A certificate in DER: sound, except for what is drawn; None if it cannot be made."""
    issuer, signing = above
    odd = dice.random
    subject = x509.Name([]) if odd() < 0.03 else common_name(name)
    begin, end = dice.choice([(-9, 9)] * 30 + [(-9, -1), (1, 9)])
    builder = x509.CertificateBuilder(
        x509.Name([]) if odd() < 0.02 else common_name(issuer),
        subject, KEYS[own].public_key(), dice.randrange(1, 99), NOW + begin * DAY, NOW + end * DAY,
    )  # fmt: skip
    chosen: dict[str, tuple[bytes, bool]] = {
        "2.5.29.19": (bytes.fromhex("30030101ff" if ca else "3000"), odd() < 0.9)
    }
    if odd() < 0.9:
        chosen["2.5.29.15"] = (bytes.fromhex("03020186" if ca else "03020780"), odd() < 0.8)
    for oid in dice.sample(sorted(EXTENSIONS), dice.choice((0, 0, 0, 1, 1, 2))):
        if odd() < 0.2:
            chosen.pop(oid, None)
        else:
            chosen[oid] = (bytes.fromhex(dice.choice(EXTENSIONS[oid])), odd() < 0.4)
    for oid, (data, critical) in chosen.items():
        builder = builder.add_extension(extension(oid, data), critical)
    if odd() < 0.9:
        key = KEYS[own if odd() < 0.9 else dice.randrange(4)].public_key()
        identifier = x509.SubjectKeyIdentifier.from_public_key(key)
        builder = builder.add_extension(identifier, odd() < 0.05)
    if odd() < 0.9:
        key = KEYS[signing if odd() < 0.9 else dice.randrange(4)].public_key()
        authority = x509.AuthorityKeyIdentifier.from_issuer_public_key(key)
        if odd() < 0.2:
            names = [x509.DirectoryName(common_name(dice.choice((issuer, name, "x"))))]
            authority = x509.AuthorityKeyIdentifier(
                dice.choice((authority.key_identifier, None)), names, dice.randrange(1, 4)
            )
        builder = builder.add_extension(authority, odd() < 0.05)
    made = builder.sign(KEYS[signing], hashes.SHA256()).public_bytes(Encoding.DER)
    return alter(made, signing, dice) if odd() < 0.25 else made


def alter(made: bytes, signing: int, dice: random.Random) -> bytes | None:
    """Alter a value of the certificate, and sign it again."""
    (root,) = Node.read(made)
    try:
        node = dice.choice([each for each in root.below() if each.tag])
        how = dice.randrange(6)
        if how == 0 and node.content:
            content = bytearray(node.content)
            content[dice.randrange(len(content))] = dice.randrange(256)
            node.content = bytes(content)
        elif how == 1:
            node.length = dice.choice(("long", "indefinite" if node.children else "long"))
        elif how == 2 and node.children:
            node.children.insert(dice.randrange(len(node.children)), raw(dice.choice(VALUES)))
        elif how == 3 and node.children:
            node.children.append(Node.read(dice.choice(node.children).write())[0])
        elif how == 4 and node.children:
            node.children.pop(dice.randrange(len(node.children)))
        else:
            node.tag = dice.choice((0x0C, 0x13, 0x14, 0x16, 0x17, 0x18, 0x1E, 0x30, 0x31, 0x02))
        if dice.random() < 0.9:
            signature = KEYS[signing].sign(root.children[0].write(), ec.ECDSA(hashes.SHA256()))
            root.children[2].content = b"\0" + signature
        return root.write()
    except (IndexError, ValueError):
        return None


def our_fault(start: bytes, trusted: list[bytes], others: list[bytes], checks: Checks) -> str:
    try:
        first, *rest = (load_der_certificate(each) for each in (start, *trusted, *others))
    except PkiError:
        return UNREADABLE
    split = len(trusted)
    return chain_fault(first, rest[:split], rest[split:], moment=NOW, checks=checks)


@pytest.fixture
def verifier() -> Libcrypto:
    return libcrypto() or pytest.skip("there is no libcrypto.so.3")


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("tag", range(1, 0x1F))
def test_a_name_of_a_type_that_openssl_cannot_read_is_refused(
    tag: int, verifier: Libcrypto
) -> None:
    root, leaf = (
        x509.CertificateBuilder(
            common_name("root"), common_name(name), KEYS[own].public_key(), 1, NOW - DAY, NOW + DAY
        )
        .add_extension(x509.BasicConstraints(ca=name == "root", path_length=None), critical=True)
        .sign(KEYS[0], hashes.SHA256())
        .public_bytes(Encoding.DER)
        for own, name in enumerate(("root", "leaf"))
    )
    assert not verifier.fault(leaf, [root])
    (certificate,) = Node.read(leaf)
    text = certificate.children[0].children[3].children[0].children[0].children[1]
    text.tag = tag
    text.content = {
        0x03: b"\0root",
        0x1C: "root".encode("utf-32-be"),
        0x1E: "root".encode("utf-16-be"),
    }.get(tag, b"root")
    signature = KEYS[0].sign(certificate.children[0].write(), ec.ECDSA(hashes.SHA256()))
    certificate.children[2].content = b"\0" + signature
    for start, others in ((certificate.write(), []), (root, [certificate.write()])):
        theirs = verifier.fault(start, [root], others)
        ours = our_fault(start, [root], others, Checks.NONE)
        assert not theirs or ours, f"OpenSSL: {theirs}"
        if tag in {0x0C, 0x13, 0x16, 0x1C, 0x1E}:  # the name is the same in another string type
            assert not theirs and not ours


WAYS = {
    "an identity, for Cyclone DDS": (Checks.NONE, 0, False),
    "an identity, for Fast DDS": (
        Checks.ROOT_SIGNATURE | Checks.POLICIES,
        CHECK_SS_SIGNATURE | POLICY_CHECK,
        False,
    ),
    "a CA file, for Fast DDS 2.14": (
        Checks.ROOT_SIGNATURE | Checks.POLICIES | Checks.STRICT,
        CHECK_SS_SIGNATURE | POLICY_CHECK | STRICT,
        False,
    ),
    "the signer of a document": (Checks.DOCUMENTS, 0, True),
}
"""What is verified, with the checks of sros and the flags and purpose of OpenSSL."""


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("way", WAYS)
def test_no_chain_is_accepted_that_openssl_rejects(way: str, verifier: Libcrypto) -> None:
    checks, flags, documents = WAYS[way]
    dice, count, wrong = random.Random(SEED), Counter[str](), []
    refused = Counter[str]()
    for _ in range(DRAWN):
        root = draw(dice, "root", ("root", 0), 0, ca=True)
        middle = draw(dice, "middle", ("root", 0), 1, ca=True)
        twin = draw(dice, "root", ("root", 3), 3, ca=True)
        issuer = dice.choice((("root", 0), ("middle", 1)))
        leaf = draw(dice, "leaf", issuer, 2, ca=False)
        if not (root and middle and leaf and twin):
            continue
        start = dice.choice((leaf, leaf, leaf, root, middle))
        trusted, others = dice.choice((
            ([root], [middle]), ([root, middle], []), ([middle, root], []), ([root], []),
            ([root, twin, middle], []), ([twin, root, middle], []), ([root], [middle, twin, root]),
        ))  # fmt: skip
        theirs = verifier.fault(start, trusted, others, flags=flags, documents=documents)
        ours = our_fault(start, trusted, others, checks)
        count[f"sros {not ours}, OpenSSL {not theirs}"] += 1
        if theirs and not ours:
            wrong.append((theirs, [start.hex(), *(each.hex() for each in trusted + others)]))
        elif ours and not theirs:
            whole = [each for each in trusted if not verifier.has_invalid_extensions(each)]
            if our_fault(start, whole, others, checks):
                refused[ours] += 1
            else:
                refused[DAMAGED_FIRST] += 1
    print(f"{way}: {dict(count)}; {Counter(error for error, _ in wrong)}; {refused}")
    assert not wrong, f"{len(wrong)} chains accepted by sros alone, the first: {wrong[0]}"
    unknown = {
        text for text in refused if text not in STRICTER and "which sros does not know" not in text
    }
    assert not unknown, f"OpenSSL accepts: {unknown}"
    assert count["sros True, OpenSSL True"] > DRAWN / 50
    assert count["sros False, OpenSSL False"] > DRAWN / 5
