"""Oddities of signed documents."""

from __future__ import annotations

import re
from dataclasses import replace

from tests.integration.trust.certificates import (
    KEYS,
    PURPOSE_IDS,
    SIGNATURES,
    Dice,
    authorities,
    rekey,
)
from tests.integration.trust.files import add_list, add_stranger
from tests.integration.trust.trusts import (
    CERTIFIES,
    EVERYTHING,
    ISSUER,
    LEAF,
    SIGNING_CA,
    MessagePlan,
    SignerPlan,
    Trust,
    authority,
)
from tests.support.raw_pki import basic_constraints, purposes


def _plans(trust: Trust, dice: Dice) -> list[tuple[str, MessagePlan]]:
    files = dice.choice(
        (["governance.p7s"], ["permissions.p7s"], ["governance.p7s", "permissions.p7s"])
    )
    return [(each, trust.messages.setdefault(each, MessagePlan())) for each in files]


def message_signers(trust: Trust, dice: Dice) -> str:
    """Who signs: several signers, a leaf, an intermediate, a stranger."""
    chosen = []
    for _ in range(dice.choice((1, 1, 2, 2, 3))):
        kind = dice.choice(
            (
                "CA",
                "CA",
                "leaf of the CA",
                "CA below",
                "stranger",
                "wrong key",
                "enclave",
                "renewed",
                "identity CA",
            )
        )
        chosen.append(_signer(trust, dice, kind))
    inside = [each.certificate for each in chosen]
    how = dice.choice(("signers", "signers", "signers", "none", "CA", "all"))
    certificates = {
        "signers": inside, "none": [], "CA": [SIGNING_CA], "all": [*inside, *authorities(trust)],
    }[how]  # fmt: skip
    plans = _plans(trust, dice)
    for _, plan in plans:
        plan.signers = chosen
        plan.certificates = list(dict.fromkeys(certificates))
        if not certificates:
            plan.certificates = []
    who = ", ".join(f"{each.certificate}{' (wrong key)' if each.key else ''}" for each in chosen)
    return f"{'+'.join(file for file, _ in plans)} signed by {who}; inside: {how}"


def _signer(trust: Trust, dice: Dice, kind: str) -> SignerPlan:
    ca = trust.certificates[SIGNING_CA]
    if kind == "wrong key":
        return SignerPlan(key="p256 28" if ca.key.startswith("p256") else "rsa2048 5")
    if kind == "enclave":
        return SignerPlan(LEAF)
    if kind == "identity CA":
        return SignerPlan(ISSUER)
    if kind in ("leaf of the CA", "CA below"):
        label = f"below {kind} {len(trust.certificates)}"
        usages = dice.choice(
            (
                ("digitalSignature",),
                ("nonRepudiation",),
                ("keyAgreement",),
                CERTIFIES,
                EVERYTHING,
                (),
            )
        )
        made = authority("CN=signer below", "p256 31", 801, *usages, above=ca)
        if kind == "leaf of the CA":
            made = made.with_extension(basic_constraints(False))
        if dice.random() < 0.4:
            purpose = dice.choice(sorted(PURPOSE_IDS))
            made = made.with_extension(purposes(PURPOSE_IDS[purpose], critical=dice.random() < 0.5))
        trust.certificates[label], trust.above[label] = made, SIGNING_CA
        return SignerPlan(label)
    if kind == "stranger":
        return SignerPlan(add_stranger(trust, dice))
    if kind == "renewed":
        label = f"renewed {len(trust.certificates)}"
        same = dice.random() < 0.5
        trust.certificates[label] = replace(ca, serial=ca.serial if same else 802, days=(-3, 40))
        trust.above[label] = label
        return SignerPlan(label)
    return SignerPlan()


def message_algorithms(trust: Trust, dice: Dice) -> str:
    """Digests and signatures of the signer, and of the CA's key for that."""
    digest = dice.choice(
        ("md5", "sha1", "sha224", "sha384", "sha512", "sha3-256", "sha512-256", "sha256")
    )
    algorithm = dice.choice(("", "", "", *SIGNATURES))
    if (
        algorithm.startswith("pss")
        and dice.random() < 0.6
        and not trust.certificates[SIGNING_CA].key.startswith("rsa")
    ):
        rekey(trust, SIGNING_CA, "rsa2048 6")
    elif dice.random() < 0.15:
        rekey(trust, SIGNING_CA, dice.choice(KEYS))
    options: dict[str, object] = {"digest": digest, "algorithm": algorithm}
    if dice.random() < 0.3:
        options["plain_algorithm"] = True
    plans = _plans(trust, dice)
    for _, plan in plans:
        plan.signers = [SignerPlan(options=options)]
    files = "+".join(file for file, _ in plans)
    return f"{files} with {options} by {trust.certificates[SIGNING_CA].key}"


def message_attributes(trust: Trust, dice: Dice) -> str:
    options: dict[str, object] = {}
    if dice.random() < 0.7:
        options["attributes"] = dice.choice(
            (
                "none",
                "no content type",
                "no digest",
                "no time",
                "capabilities",
                "future",
                "twice",
                "unknown",
                "other type",
                "unsorted",
            )
        )
    if dice.random() < 0.35:
        options["spoil"] = dice.choice(("digest", "signature", "named digest"))
    if dice.random() < 0.2:
        options["identified"] = "key"
    if not options:
        options["attributes"] = "none"
    plans = _plans(trust, dice)
    for _, plan in plans:
        plan.signers = [SignerPlan(options=options)]
    return f"{'+'.join(file for file, _ in plans)} with {options}"


def message_structure(trust: Trust, dice: Dice) -> str:
    """Certificates and lists inside, forms, versions, digestAlgorithms."""
    options: dict[str, object] = {}
    plans = _plans(trust, dice)
    inside = [SIGNING_CA]
    words = []
    if dice.random() < 0.5:
        kind = dice.choice(
            (
                "none",
                "twice",
                "chain",
                "stranger first",
                "leaf first",
                "stranger only",
                "renewed first",
            )
        )
        if kind == "none":
            inside = []
        elif kind == "twice":
            inside = [SIGNING_CA, SIGNING_CA]
        elif kind == "chain":
            inside = authorities(trust)
        elif kind == "leaf first":
            inside = [LEAF, SIGNING_CA]
        elif kind == "renewed first":
            inside = [_signer(trust, dice, "renewed").certificate, SIGNING_CA]
        else:
            label = add_stranger(trust, dice)
            inside = [label] if "only" in kind else [label, SIGNING_CA]
            kind = f"{kind}, {label}"
        words.append(f"certificates {kind}")
    if dice.random() < 0.3:
        options["form"] = "opaque"
    elif dice.random() < 0.15:
        options["both"] = True
    if dice.random() < 0.2:
        options["version"] = dice.choice((0, 2, 3, 4, 9))
    if dice.random() < 0.25:
        options["digests"] = dice.choice(
            ((), ("sha1",), ("sha256", "sha512"), ("sha512",), ("sha256", "sha256"))
        )
    if dice.random() < 0.1:
        options["text"] = False
    lists = []
    if dice.random() < 0.25 or not (words or options):
        label, text = add_list(trust, dice, SIGNING_CA)
        lists = [label]
        words.append(text)
    for _, plan in plans:
        plan.certificates, plan.options, plan.lists = inside, options, lists
    return f"{'+'.join(file for file, _ in plans)}: {'; '.join(words)} {options or ''}"


_EXPRESSION = re.compile(rb"<topic_expression>[^<]*<")


def documents(trust: Trust, dice: Dice) -> str:
    """Faults of governance and permissions that meet."""
    governance = dice.choice(("as it is", "an empty expression", "no expression", "malformed"))
    if governance == "malformed":
        trust.governance = b"<x/>"
    elif governance != "as it is":
        empty = b"<topic_expression><" if governance == "an empty expression" else b"<x><"
        trust.governance = _EXPRESSION.sub(empty, trust.governance)
    wrong = {"as they are": [], "governance.p7s": ["governance.p7s"]}
    wrong |= {"permissions.p7s": ["permissions.p7s"], "both": ["governance.p7s", "permissions.p7s"]}
    files, how = dice.choice(sorted(wrong)), dice.choice(("not signed", "changed"))
    for file in wrong[files]:
        trust.edit(file, lambda data: data.replace(b"dds", b"DDS") if how == "changed" else b"x\n")
    return f"governance with {governance}, {files} {how}"
