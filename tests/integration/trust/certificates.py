"""Oddities of certificates: extensions, signatures, keys, dates, issuer names."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import replace

from sros_tool.pki.der import encode
from tests.integration.trust.trusts import IDENTITY, ISSUER, LEAF, PERMISSIONS, SIGNING_CA, Trust
from tests.support.raw_pki import (
    ALTERNATIVE,
    AUTHORITY_KEY,
    BASIC,
    BMP,
    IA5,
    PRINTABLE,
    PURPOSES,
    SUBJECT_KEY,
    TELETEX,
    UNIVERSAL,
    USAGE,
    USAGES,
    UTF8,
    Attribute,
    Extension,
    Name,
    basic_constraints,
    bits,
    integer,
    key_identifier,
    key_usage,
    name,
    name_der,
    octets,
    oid,
    purposes,
    sequence,
    tagged,
)

Dice = random.Random
PURPOSE_IDS = {
    "serverAuth": "1.3.6.1.5.5.7.3.1", "clientAuth": "1.3.6.1.5.5.7.3.2",
    "codeSigning": "1.3.6.1.5.5.7.3.3", "emailProtection": "1.3.6.1.5.5.7.3.4",
    "timeStamping": "1.3.6.1.5.5.7.3.8", "OCSPSigning": "1.3.6.1.5.5.7.3.9",
    "any": "2.5.29.37.0", "msSmartcard": "1.3.6.1.4.1.311.20.2.2", "unknown": "1.2.3.4.5",
}  # fmt: skip


def draw_extension(dice: Dice, trust: Trust, who: str) -> tuple[str, Extension | None, str]:
    """Return a description, the extension or None (to be taken out), and its identifier."""
    kind = dice.choices(
        ("basic", "usage", "purposes", "policies", "policy", "names", "keys", "alternative",
         "other", "unknown", "malformed", "absent"),
        (16, 22, 14, 8, 6, 10, 8, 4, 8, 5, 7, 8),
    )[0]  # fmt: skip
    critical = dice.random() < 0.5
    mark = " critical" if critical else ""
    if kind == "basic":
        ca, length = dice.random() < 0.6, dice.choice((None, None, 0, 1, 2, -1))
        found = basic_constraints(ca, length, critical=critical)
        return f"basicConstraints CA:{ca} pathlen:{length}{mark}", found, BASIC
    if kind == "usage":
        chosen = [each for each in USAGES if dice.random() < 0.4]
        return f"keyUsage {','.join(chosen)}{mark}", key_usage(*chosen, critical=critical), USAGE
    if kind == "purposes":
        some = dice.sample(sorted(PURPOSE_IDS), dice.choice((1, 1, 2, 3)))
        ids = [PURPOSE_IDS[each] for each in some]
        return (
            f"extendedKeyUsage {','.join(some)}{mark}",
            purposes(*ids, critical=critical),
            PURPOSES,
        )
    if kind == "absent":
        dotted = dice.choice((BASIC, USAGE, SUBJECT_KEY, AUTHORITY_KEY, PURPOSES))
        return f"without {dotted}", None, dotted
    if kind == "policies":
        policies = dice.choice(
            (("2.5.29.32.0",), ("1.2.3.4",), ("1.2.3.4", "1.2.3.5"), ("1.2.3", "1.2.3"))
        )
        inner = sequence(*(sequence(oid(each)) for each in policies))
        return (
            f"certificatePolicies {policies}{mark}",
            Extension("2.5.29.32", inner, critical),
            "2.5.29.32",
        )
    if kind == "policy":
        which = dice.choice(("constraints", "inhibit", "mappings", "inhibit mapping"))
        value, dotted = {
            "constraints": (sequence(encode(0x80, bytes([dice.randrange(3)]))), "2.5.29.36"),
            "inhibit mapping": (sequence(encode(0x81, bytes([dice.randrange(3)]))), "2.5.29.36"),
            "inhibit": (integer(dice.randrange(3)), "2.5.29.54"),
            "mappings": (sequence(sequence(oid("1.2.3.4"), oid("1.2.3.5"))), "2.5.29.33"),
        }[which]
        return f"policy {which} {value.hex()}{mark}", Extension(dotted, value, critical), dotted
    if kind == "names":
        return _draw_name_constraints(dice, trust, critical, mark)
    if kind == "keys":
        return _draw_key_identifier(dice, trust, who, critical, mark)
    if kind == "alternative":
        names = {
            "dns": encode(0x82, b"robot.example.com"), "email": encode(0x81, b"a@example.com"),
            "directory": tagged(4, name_der(name("CN=x"))), "none": b"",
            "uri": encode(0x86, b"urn:robot:1"), "ip": encode(0x87, b"\x7f\0\0\1"),
            "bad ip": encode(0x87, b"\x7f"), "bad dns": encode(0x82, b"a b\xff"),
            "other": tagged(0, oid("1.2.3.4"), tagged(0, encode(UTF8, b"x"))),
        }  # fmt: skip
        which = dice.choice(sorted(names))
        dotted = dice.choice((ALTERNATIVE, ALTERNATIVE, "2.5.29.18"))
        return (
            f"{dotted} {which}{mark}",
            Extension(dotted, sequence(names[which]), critical),
            dotted,
        )
    if kind == "other":
        others = {
            "crlDistributionPoints": (
                "2.5.29.31",
                sequence(sequence(tagged(0, tagged(0, encode(0x86, b"http://x/crl"))))),
            ),
            "freshestCRL": (
                "2.5.29.46",
                sequence(sequence(tagged(0, tagged(0, encode(0x86, b"http://x/d"))))),
            ),
            "authorityInfoAccess": (
                "1.3.6.1.5.5.7.1.1",
                sequence(sequence(oid("1.3.6.1.5.5.7.48.1"), encode(0x86, b"http://x"))),
            ),
            "nsCertType server": ("2.16.840.1.113730.1.1", bits(b"\x40", 6)),
            "nsCertType email": ("2.16.840.1.113730.1.1", bits(b"\x20", 5)),
            "nsCertType CA": ("2.16.840.1.113730.1.1", bits(b"\x07", 0)),
            "nsComment": ("2.16.840.1.113730.1.13", encode(IA5, b"OpenSSL Generated Certificate")),
            "proxyCertInfo": ("1.3.6.1.5.5.7.1.14", sequence(sequence(oid("1.3.6.1.5.5.7.21.1")))),
            "ipAddrBlocks": ("1.3.6.1.5.5.7.1.7", sequence(sequence(octets(b"\0\1"), b"\x05\x00"))),
            "asIdentifiers": ("1.3.6.1.5.5.7.1.8", sequence(tagged(0, b"\x05\x00"))),
            "OCSP no check": ("1.3.6.1.5.5.7.48.1.5", b"\x05\x00"),
            "TLS feature": ("1.3.6.1.5.5.7.1.24", sequence(integer(5))),
            "template": ("1.3.6.1.4.1.311.20.2", encode(BMP, "Robot".encode("utf-16-be"))),
            "template 2": (
                "1.3.6.1.4.1.311.21.7",
                sequence(oid("1.3.6.1.4.1.311.21.8.1"), integer(100)),
            ),
            "CA version": ("1.3.6.1.4.1.311.21.1", integer(0)),
            "directory attributes": (
                "2.5.29.9",
                sequence(sequence(oid("2.5.4.6"), encode(0x31, encode(PRINTABLE, b"DE")))),
            ),
            "private key usage": ("2.5.29.16", sequence(encode(0x80, b"20200101000000Z"))),
            "qualified": ("1.3.6.1.5.5.7.1.3", sequence(sequence(oid("0.4.0.1862.1.1")))),
        }
        which = dice.choice(sorted(others))
        dotted, value = others[which]
        return f"{which}{mark}", Extension(dotted, value, critical), dotted
    if kind == "unknown":
        dotted = dice.choice(("1.2.3.4.5.6", "1.3.6.1.4.1.99999.7"))
        return f"unknown extension{mark}", Extension(dotted, octets(b"x"), critical), dotted
    dotted = dice.choice(
        (
            BASIC,
            USAGE,
            PURPOSES,
            SUBJECT_KEY,
            AUTHORITY_KEY,
            ALTERNATIVE,
            "2.5.29.30",
            "2.5.29.32",
            "2.5.29.31",
        )
    )
    value = dice.choice(
        (
            b"",
            b"\x05\x00",
            b"\x30\x00",
            b"\x04\x00",
            b"\x03\x01\x00",
            b"\x30\x03\x02\x01\x01",
            b"xyz",
        )
    )
    return f"malformed {dotted} {value.hex()}{mark}", Extension(dotted, value, critical), dotted


def _draw_name_constraints(
    dice: Dice, trust: Trust, critical: bool, mark: str
) -> tuple[str, Extension, str]:
    leaf = trust.certificates[LEAF].subject
    bases = {
        "the leaf's name": tagged(4, name_der(leaf)),
        "the leaf's first part": tagged(4, name_der(leaf[:1])),
        "another name": tagged(4, name_der(name("O=Elsewhere"))),
        "any name": tagged(4, name_der(())),
        "example.com": encode(0x82, b"example.com"),
        "mail of example.com": encode(0x81, b"example.com"),
        "URI": encode(0x86, b"example.com"),
        "addresses": encode(0x87, b"\x0a\0\0\0\xff\0\0\0"),
        "other names": tagged(0, oid("1.2.3.4"), tagged(0, encode(UTF8, b"x"))),
    }
    parts, words = [], []
    for number, word in ((0, "permitted"), (1, "excluded")):
        if dice.random() < 0.6:
            which = dice.choice(sorted(bases))
            parts.append(tagged(number, sequence(bases[which])))
            words.append(f"{word} {which}")
    text = f"nameConstraints {', '.join(words)}{mark}"
    return text, Extension("2.5.29.30", sequence(*parts), critical), "2.5.29.30"


def _draw_key_identifier(
    dice: Dice, trust: Trust, who: str, critical: bool, mark: str
) -> tuple[str, Extension, str]:
    above = trust.certificates[trust.above[who]]
    if dice.random() < 0.3:
        value = dice.choice((b"\1" * 20, b"", b"\2", key_identifier(above.key)))
        return (
            f"subjectKeyIdentifier {value.hex()}{mark}",
            Extension(SUBJECT_KEY, octets(value), critical),
            SUBJECT_KEY,
        )
    key, issuer = (
        dice.choice(("right", "wrong", "none")),
        dice.choice(("right", "wrong", "none", "none")),
    )
    parts = []
    if key != "none":
        found = key_identifier(above.key) if key == "right" else b"\3" * 20
        parts.append(tagged(0, found, constructed=False))
    if issuer != "none":
        serial = above.serial if issuer == "right" else above.serial + 1
        named = tagged(1, tagged(4, name_der(above.issuer)))
        parts += [named, tagged(2, integer(serial)[2:], constructed=False)]
    text = f"authorityKeyIdentifier key {key}, issuer {issuer}{mark}"
    return text, Extension(AUTHORITY_KEY, sequence(*parts), critical), AUTHORITY_KEY


def authorities(trust: Trust, role: str | None = None) -> list[str]:
    return [
        each for each in trust.certificates
        if each.split()[0] in ((role,) if role else (IDENTITY, PERMISSIONS))
    ]  # fmt: skip


def _apply_extension(dice: Dice, trust: Trust, who: str) -> str:
    text, found, dotted = draw_extension(dice, trust, who)
    if found is None:
        trust.certificates[who] = trust.certificates[who].without(dotted)
    elif dice.random() < 0.04:
        trust.change(who, extensions=(*trust.certificates[who].extensions, found, found))
        text += " twice"
    else:
        trust.certificates[who] = trust.certificates[who].with_extension(found)
    keep_one_authority(trust, who)
    return f"{who}: {text}"


def keep_one_authority(trust: Trust, who: str) -> None:
    """Where one CA has both jobs, it is the same certificate."""
    if who in (ISSUER, SIGNING_CA) and trust.one_authority:
        other = SIGNING_CA if who == ISSUER else ISSUER
        trust.certificates[other] = trust.certificates[who]


def ca_extension(trust: Trust, dice: Dice) -> str:
    who = dice.choice(authorities(trust))
    return "; ".join(_apply_extension(dice, trust, who) for _ in range(dice.choice((1, 1, 2))))


def leaf_extension(trust: Trust, dice: Dice) -> str:
    return "; ".join(_apply_extension(dice, trust, LEAF) for _ in range(dice.choice((1, 1, 2))))


SIGNATURES = (
    "md5", "sha1", "sha224", "sha384", "sha512", "sha512-256", "sha3-256", "pss sha256 sha256 32",
    "pss sha256 sha256 20", "pss sha256 sha1 32", "pss sha384 sha384 48", "pss sha512 sha256 64",
    "pss sha1 sha1 20", "pss sha256 sha256 222", "pss sha256 sha256 0",
)  # fmt: skip
KEYS = (
    "p384 0", "p521 0", "p224 0", "k256 0", "bp256 0", "rsa1024 0", "rsa2048 5", "rsa3072 0",
    "rsa4096 0", "rsa2048e3 0", "ed25519 0", "ed448 0", "dsa 0", "p192 0", "rsa2047 0", "rsa2056 0",
    "p256 20",
)  # fmt: skip


def certificate_signature(trust: Trust, dice: Dice) -> str:
    """Another algorithm; where it is RSA's, the signing CA gets an RSA key first."""
    who = dice.choice((LEAF, *authorities(trust)))
    algorithm = dice.choice(SIGNATURES)
    above = trust.above[who]
    if algorithm.startswith(("pss", "md5", "sha512-256")) and not trust.certificates[
        above
    ].key.startswith("rsa"):
        rekey(trust, above, f"rsa2048 {dice.choice((6, 7))}")
    trust.change(who, algorithm=algorithm)
    keep_one_authority(trust, who)
    return f"{who} signed with {algorithm} by {trust.certificates[above].key}"


def rekey(trust: Trust, who: str, label: str) -> None:
    one = trust.one_authority and who in (ISSUER, SIGNING_CA)
    for each in (ISSUER, SIGNING_CA) if one else (who,):
        trust.rekey(each, label)


def certificate_key(trust: Trust, dice: Dice) -> str:
    who = dice.choice((LEAF, LEAF, LEAF, *authorities(trust)))
    if dice.random() < 0.2:
        form = dice.choice(("compressed", "explicit", "pss", "no parameters"))
        if form in ("pss", "no parameters"):
            rekey(trust, who, "rsa2048 8")
        else:
            rekey(trust, who, "p256 21")
        trust.change(who, key_form=form)
        keep_one_authority(trust, who)
        if who == LEAF and dice.random() < 0.5:
            trust.key_form = {"explicit": "explicit", "pss": "pss"}.get(form, "pkcs8")
        return f"{who} with a public key in the form {form}, key.pem {trust.key_form}"
    label = dice.choice(KEYS)
    rekey(trust, who, label)
    return f"{who} with the key {label}"


def certificate_dates(trust: Trust, dice: Dice) -> str:
    who = dice.choice((LEAF, *authorities(trust)))
    if dice.random() < 0.6:
        days = dice.choice(
            (
                (-30, -1),
                (1, 30),
                (-0.1, 0.1),
                (30, -30),
                (-20000, 30),
                (-30, 200000),
                (-30, 2900000),
                (-10, 10),
            )
        )
        trust.change(who, days=days)
        text = f"valid from day {days[0]} to day {days[1]}"
    else:
        forms = dice.choice((
            ("generalized", "generalized"), ("generalized", ""), ("", "99991231235959Z"),
            ("20200101000000Z", ""), ("200101000000Z", ""), ("", "4901010000Z"),
            ("", "490101000000+0100"), ("2001010000Z", ""), ("", "20490101000000.5Z"),
            ("", "490101000000"), ("", "20300230000000Z"), ("700101000000Z", "491231235959Z"),
            ("500101000000Z", ""), ("", "xyz"), ("19500101000000Z", ""), ("00000101000000Z", ""),
        ))  # fmt: skip
        trust.change(who, times=forms)
        text = f"with dates {forms}"
    keep_one_authority(trust, who)
    return f"{who} {text}"


def certificate_fields(trust: Trust, dice: Dice) -> str:
    """Serial numbers, versions, damaged signatures, encodings."""
    who = dice.choice((LEAF, *authorities(trust)))
    kind = dice.choice(("serial", "version", "spoil"))
    if kind == "serial":
        serial = dice.choice((0, -1, -(2**64), 2**159, 2**168 - 1, 2**200, 1, 1001, 1002, 11, 12))
        trust.change(who, serial=serial)
        text = f"serial number {serial}"
    elif kind == "version":
        version = dice.choice((None, 0, 1, 2, 3, 9))
        values: dict[str, object] = {"version": version}
        if dice.random() < 0.6 and version != 2:
            values["extensions"] = ()
        trust.change(who, **values)
        text = f"version {version}, {'no ' if 'extensions' in values else ''}extensions"
    else:
        spoil = dice.choice(
            ("signature", "outer algorithm", "inner algorithm", "trailing data", "long length")
        )
        trust.change(who, spoil=spoil)
        text = f"wrong {spoil}"
    keep_one_authority(trust, who)
    return f"{who}: {text}"


def issuer_name(trust: Trust, dice: Dice) -> str:
    """The issuer that a certificate names differs from the subject of its CA."""
    who = dice.choice([LEAF, *(each for each in authorities(trust))])
    subject = trust.certificates[who].issuer
    how = dice.choice(sorted(NAME_CHANGES))
    trust.change(who, issuer=NAME_CHANGES[how](subject))
    keep_one_authority(trust, who)
    return f"{who} names its issuer with {how}"


def _values(of: Name, change: Callable[[Attribute], Attribute]) -> Name:
    return tuple(tuple(change(each) for each in rdn) for rdn in of)


NAME_CHANGES: dict[str, Callable[[Name], Name]] = {
    "PrintableString": lambda of: _values(of, lambda each: replace(each, tag=PRINTABLE)),
    "T61String": lambda of: _values(of, lambda each: replace(each, tag=TELETEX)),
    "BMPString": lambda of: _values(of, lambda each: replace(each, tag=BMP)),
    "UniversalString": lambda of: _values(of, lambda each: replace(each, tag=UNIVERSAL)),
    "IA5String": lambda of: _values(of, lambda each: replace(each, tag=IA5)),
    "upper case": lambda of: _values(of, lambda each: replace(each, value=each.value.upper())),
    "blanks around": lambda of: _values(of, lambda each: replace(each, value=f" {each.value}  ")),
    "doubled blanks": lambda of: _values(
        of, lambda each: replace(each, value=each.value.replace(" ", "  "))
    ),
    "a tab for a blank": lambda of: _values(
        of, lambda each: replace(each, value=each.value.replace(" ", "\t"))
    ),
    "another order": lambda of: of[::-1] if len(of) > 1 else (*of, *name("O=x")),
    "one part fewer": lambda of: of[1:],
    "one part more": lambda of: (*of, *name("OU=more")),
    "another value": lambda of: (
        (*of[:-1], (replace(of[-1][0], value="x"),)) if of else name("CN=x")
    ),
    "all in one RDN": lambda of: (tuple(each for rdn in of for each in rdn),),
    "nothing": lambda of: (),
}
