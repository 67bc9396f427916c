"""Oddities of subjects, and of the subjects that grants name."""

from __future__ import annotations

import re
from collections.abc import Callable
from datetime import datetime

from tests.integration.trust.certificates import NAME_CHANGES, Dice, authorities
from tests.integration.trust.trusts import (
    ESCAPES_MSB,
    ISSUER,
    LEAF,
    ONELINE,
    RFC2253,
    SIGNING_CA,
    Trust,
    openssl_text,
)
from tests.support.raw_pki import (
    ATTRIBUTES,
    BMP,
    IA5,
    PRINTABLE,
    TELETEX,
    UNIVERSAL,
    UTF8,
    Attribute,
    Certificate,
    Name,
    basic_constraints,
    name,
)

WORDS = (
    "x",
    "Example GmbH",
    "a,b",
    "a, b",
    "a+b",
    "a=b",
    "a\\b",
    'a"b',
    "a<b>c",
    "a;b",
    "#a",
    " a",
    "a ",
    "größe",
    "名前",
    "a/b",
    "a|b",
    "a  b",
    "a\tb",
    "a\nb",
    "",
    "a&b",
    "0x1F",
    "*",
    "A" * 64,
    "A" * 65,
    "A" * 300,
    "ﬁ",
    "😀",
    "a,",
    ",a",
    "\\,",
    "e\u0301",
    "a#b",
    "12345",
    "ß",
    "/t",
)


def draw_attribute(dice: Dice) -> Attribute:
    kind = dice.choice(("CN", "O", "OU", "L", "ST", *sorted(ATTRIBUTES)))
    value = dice.choice(WORDS) if dice.random() < 0.6 else dice.choice(("x", "Example", "b1"))
    tag = dice.choice(
        (
            UTF8,
            UTF8,
            UTF8,
            PRINTABLE,
            PRINTABLE,
            TELETEX,
            IA5,
            BMP,
            UNIVERSAL,
            0x12,
            0x1A,
            0x1B,
            0x04,
        )
    )
    if kind in ("C", "jurisdictionC", "dnQualifier", "serialNumber") and dice.random() < 0.7:
        value, tag = "DE", PRINTABLE
    if dice.random() < 0.04:
        return Attribute(kind, "", tag, dice.choice((b"\xff\xfe", b"a\0b", b"\xc3", b"\0")))
    return Attribute(kind, value, tag)


SUBJECT_FORMS: dict[str, Callable[[Name], str]] = {
    "RFC 2253": openssl_text,
    "RFC 2253 in UTF-8": lambda of: openssl_text(of, RFC2253 & ~ESCAPES_MSB),
    "RFC 2253, not reversed": lambda of: openssl_text(of, RFC2253 & ~(1 << 20)),
    "RFC 2253 with blanks": lambda of: openssl_text(of, (RFC2253 & ~0xF0000) | (2 << 16)),
    "one line": lambda of: openssl_text(of, ONELINE),
    "slashes": lambda of: openssl_text(of, 0),
    "as sros writes it": lambda of: sros_text(of),
}


def sros_text(of: Name) -> str:
    """The subject as `sros` writes it into permissions."""
    from cryptography import x509

    from sros_tool.pki.certificates import subject_text

    made = Certificate(of, name("CN=x"), "p256 8", "p256 0", 5, (basic_constraints(False),))
    try:
        found = x509.load_der_x509_certificate(made.der(datetime(2026, 1, 1)))
        return re.sub(r"[\0-\x08\x0b\x0c\x0e-\x1f]", "?", subject_text(found.subject))
    except Exception:  # whatever it says of such a subject, this is about its peers
        return openssl_text(of)


def leaf_subject(trust: Trust, dice: Dice) -> str:
    old = trust.certificates[LEAF].subject
    rdns = [
        tuple(draw_attribute(dice) for _ in range(dice.choice((1, 1, 1, 1, 2, 3))))
        for _ in range(dice.choice((0, 1, 1, 2, 3)))
    ]
    if dice.random() < 0.85:
        rdns.insert(dice.randrange(len(rdns) + 1), old[-1])
    if dice.random() < 0.1 and rdns:
        rdns.append(rdns[0])
    subject: Name = tuple(rdns)
    trust.rename(LEAF, subject)
    form = dice.choice(("RFC 2253", "RFC 2253", "as sros writes it", *SUBJECT_FORMS))
    trust.grants = [SUBJECT_FORMS[form](subject)]
    shown = f"{openssl_text(subject)!r} ({_tags(subject)})"
    return f"leaf subject {shown}, granted as {form}: {trust.grants[0]!r}"


def _tags(of: Name) -> str:
    return ",".join("+".join(f"{each.type}:{each.tag:x}" for each in rdn) for rdn in of)


def grant_subject(trust: Trust, dice: Dice) -> str:
    """A grant whose subject is written in another way, or is another one."""
    subject = trust.certificates[LEAF].subject
    if dice.random() < 0.5:
        trust.rename(LEAF, (*name("O=a b,OU=c"), *subject))
        subject = trust.certificates[LEAF].subject
    text = SUBJECT_FORMS[dice.choice(sorted(SUBJECT_FORMS))](subject)
    changes: dict[str, Callable[[str], str]] = {
        "lower case types": lambda each: re.sub(r"[A-Z]+(?==)", lambda m: m[0].lower(), each),
        "blanks around =": _swap("=", " = "),
        "blanks after ,": _swap(",", ", "),
        "blanks before ,": _swap(",", " ,"),
        "quotes": lambda each: re.sub(r"=([^,]*)", r'="\1"', each),
        "OID types": _swap("CN=", "2.5.4.3="),
        "OID. types": _swap("CN=", "OID.2.5.4.3="),
        "semicolons": _swap(",", ";"),
        "an escaped slash": _swap("/", "\\/"),
        "hex escapes": _swap("/", "\\2F"),
        "a longer value": lambda each: each + "x",
        "one more": lambda each: each + ",O=y",
        "one fewer": lambda each: each.split(",", 1)[-1],
        "a blank first": lambda each: " " + each,
        "a blank last": lambda each: each + " ",
        "reversed": lambda each: ",".join(each.split(",")[::-1]),
        "doubled": lambda each: each + "," + each,
        "upper case": str.upper,
        "a hash": lambda each: re.sub(r"CN=[^,]*", "CN=#0C022F74", each),
        "same": lambda each: each,
        "plus": _swap(",", "+"),
        "a line end": _swap(",", ",\n"),
        "two grants": lambda each: each,
    }
    how = dice.choice(sorted(changes))
    trust.grants = [changes[how](text)]
    if how == "two grants":
        trust.grants = [dice.choice(("CN=/other", "O=", "CN=/t/x", "CN=")), text]
    return f"granted to {trust.grants!r} ({how}), the subject is {openssl_text(subject)!r}"


def _swap(old: str, new: str) -> Callable[[str], str]:
    return lambda each: each.replace(old, new)


def ca_subject(trust: Trust, dice: Dice) -> str:
    who = dice.choice(authorities(trust))
    old = trust.certificates[who].subject
    kind = dice.choice(("drawn", "drawn", "changed", "empty", "same as another"))
    if kind == "drawn":
        subject: Name = tuple((draw_attribute(dice),) for _ in range(dice.choice((1, 2, 3))))
        if dice.random() < 0.2:
            subject = (tuple(draw_attribute(dice) for _ in range(2)), *subject)
    elif kind == "changed":
        subject = NAME_CHANGES[dice.choice(sorted(NAME_CHANGES))](old)
    elif kind == "empty":
        subject = ()
    else:
        subject = trust.certificates[dice.choice([LEAF, *authorities(trust)])].subject
    one = trust.one_authority and who in (ISSUER, SIGNING_CA)
    for each in (ISSUER, SIGNING_CA) if one else (who,):
        trust.rename(each, subject)
    return f"{who} has the subject {openssl_text(subject)!r} ({_tags(subject)})"
