"""Oddities of revocation lists."""

from __future__ import annotations

from dataclasses import replace

from sros_tool.pki.der import encode
from tests.integration.trust.certificates import (
    NAME_CHANGES,
    SIGNATURES,
    Dice,
    authorities,
    keep_one_authority,
    rekey,
)
from tests.integration.trust.files import STRAY, add_list, some_der
from tests.integration.trust.trusts import (
    EVERYTHING,
    IDENTITY,
    IDENTITY_FILE,
    ISSUER,
    LEAF,
    PERMISSIONS_FILE,
    Trust,
    list_of,
)
from tests.support.raw_pki import (
    AUTHORITY_KEY,
    USAGE,
    USAGES,
    Entry,
    Extension,
    integer,
    key_identifier,
    key_usage,
    name,
    name_der,
    octets,
    pem,
    sequence,
    tagged,
)


def _main_list(trust: Trust, dice: Dice) -> str:
    """Return the name of the list in crl.pem, which is made if there is none."""
    if "crl.pem" not in trust.files:
        trust.lists["list 0"] = list_of(trust, ISSUER, 5, 77)
        trust.files["crl.pem"] = ["list 0"]
        usage = [each for each in trust.certificates[ISSUER].extensions if each.dotted == USAGE]
        if usage and dice.random() < 0.8:
            trust.certificates[ISSUER] = trust.certificates[ISSUER].with_extension(
                key_usage(*EVERYTHING)
            )
            keep_one_authority(trust, ISSUER)
    return next(each for each in trust.files["crl.pem"] if each in trust.lists)


def _change_list(trust: Trust, which: str, **values: object) -> None:
    trust.lists[which] = replace(trust.lists[which], **values)  # type: ignore[arg-type]


def list_issuer(trust: Trust, dice: Dice) -> str:
    """Who signs the list, with what, and whether it may."""
    which = _main_list(trust, dice)
    kind = dice.choice(("usage", "usage", "name", "algorithm", "key", "other", "damaged", "above"))
    if kind == "usage":
        who = dice.choice(authorities(trust, IDENTITY))
        chosen = [each for each in USAGES if dice.random() < 0.4]
        if dice.random() < 0.7 and "keyCertSign" not in chosen:
            chosen.append("keyCertSign")
        critical = dice.random() < 0.5
        found = key_usage(*chosen, critical=critical)
        trust.certificates[who] = trust.certificates[who].with_extension(found)
        keep_one_authority(trust, who)
        return f"a list, and {who} with keyUsage {','.join(chosen)}"
    if kind == "name":
        how = dice.choice(sorted(NAME_CHANGES))
        _change_list(trust, which, issuer=NAME_CHANGES[how](trust.lists[which].issuer))
        return f"the list names its issuer with {how}"
    if kind == "algorithm":
        algorithm = dice.choice(SIGNATURES)
        if algorithm.startswith(("pss", "md5", "sha512-256")) and not trust.certificates[
            ISSUER
        ].key.startswith("rsa"):
            rekey(trust, ISSUER, "rsa2048 6")
        _change_list(trust, which, algorithm=algorithm, signing=trust.certificates[ISSUER].key)
        return f"the list is signed with {algorithm}"
    if kind == "key":
        _change_list(trust, which, signing="p256 28")
        return "the list is signed with a key of nobody"
    if kind == "other":
        who = dice.choice(authorities(trust))
        trust.lists[which] = list_of(trust, who, 5)
        return f"the list is of {who}"
    if kind == "above":
        above = trust.above[ISSUER]
        label = f"list {len(trust.lists)}"
        trust.lists[label] = list_of(
            trust, above, dice.choice((5, trust.certificates[ISSUER].serial))
        )
        trust.files["crl.pem"].insert(dice.choice((0, 1)), label)
        return f"a second list of {above} with {trust.lists[label].entries}"
    _change_list(trust, which, damaged=True)
    return "the list has a damaged signature"


def list_dates(trust: Trust, dice: Dice) -> str:
    which = _main_list(trust, dice)
    days = dice.choice(
        (
            (-20, -1),
            (1, 20),
            (-1, None),
            (-0.05, 0.05),
            (5, -5),
            (-20000, 1),
            (-1, 20000),
            (-20, -0.001),
        )
    )
    _change_list(trust, which, days=days)
    return f"the list is from day {days[0]} to {days[1]}"


def list_entries(trust: Trust, dice: Dice) -> str:
    which = _main_list(trust, dice)
    serials = {
        "the leaf": trust.certificates[LEAF].serial, "the CA": trust.certificates[ISSUER].serial,
        "nobody": 424242, "zero": 0, "minus the leaf": -trust.certificates[LEAF].serial,
        "a long number": 2**180,
    }  # fmt: skip
    entries, words = [], []
    for who in dice.sample(sorted(serials), dice.choice((0, 1, 1, 2, 3))):
        extensions: tuple[Extension, ...] = ()
        text = who
        if dice.random() < 0.6:
            extensions, more = _entry_extension(trust, dice)
            text += f" ({more})"
        days = dice.choice((-2, -2, -2, 3))
        if days > 0:
            text += " in the future"
        entries.append(Entry(serials[who], days, extensions))
        words.append(text)
    _change_list(trust, which, entries=tuple(entries))
    if dice.random() < 0.1:
        _change_list(trust, which, version=None, extensions=())
        words.append("version 1")
    return f"the list names {', '.join(words) or 'nobody at all'}"


def _entry_extension(trust: Trust, dice: Dice) -> tuple[tuple[Extension, ...], str]:
    critical = dice.random() < 0.4
    kinds = {
        "removeFromCRL": Extension("2.5.29.21", encode(0x0A, b"\x08"), critical),
        "certificateHold": Extension("2.5.29.21", encode(0x0A, b"\x06"), critical),
        "keyCompromise": Extension("2.5.29.21", encode(0x0A, b"\x01"), critical),
        "reason 7": Extension("2.5.29.21", encode(0x0A, b"\x07"), critical),
        "reason 99": Extension("2.5.29.21", encode(0x0A, b"\x63"), critical),
        "invalidityDate": Extension("2.5.29.24", encode(0x18, b"20300101000000Z"), critical),
        "issuer, the CA": Extension(
            "2.5.29.29", sequence(tagged(4, name_der(trust.certificates[ISSUER].subject))), critical
        ),
        "issuer, another": Extension(
            "2.5.29.29", sequence(tagged(4, name_der(name("CN=x")))), critical
        ),
        "unknown": Extension("1.2.3.4", octets(b"x"), critical),
        "malformed reason": Extension("2.5.29.21", b"\x05\x00", critical),
    }
    which = dice.choice(sorted(kinds))
    return (kinds[which],), f"{which}{' critical' if critical else ''}"


def list_extensions(trust: Trust, dice: Dice) -> str:
    which = _main_list(trust, dice)
    ca = trust.certificates[ISSUER]
    words = []
    found = trust.lists[which]
    if dice.random() < 0.4:
        _change_list(trust, which, entries=(Entry(trust.certificates[LEAF].serial),))
        words.append("naming the leaf")
    extensions = list(found.extensions)
    for _ in range(dice.choice((1, 1, 2))):
        critical = dice.random() < 0.5
        point = {
            "whole": sequence(),
            "users": sequence(encode(0x81, b"\xff")),
            "CAs": sequence(encode(0x82, b"\xff")),
            "indirect": sequence(encode(0x84, b"\xff")),
            "attributes": sequence(encode(0x85, b"\xff")),
            "reasons": sequence(encode(0x83, b"\x04\x40")),
            "place": sequence(tagged(0, tagged(0, encode(0x86, b"http://x")))),
            "users and CAs": sequence(encode(0x81, b"\xff"), encode(0x82, b"\xff")),
        }
        kinds = {
            **{f"issuing point {each}": ("2.5.29.28", value) for each, value in point.items()},
            "delta": ("2.5.29.27", integer(1)),
            "number 0": ("2.5.29.20", integer(0)),
            "number -1": ("2.5.29.20", integer(-1)),
            "a long number": ("2.5.29.20", integer(2**170)),
            "authority key wrong": (AUTHORITY_KEY, sequence(encode(0x80, b"\3" * 20))),
            "authority key right": (AUTHORITY_KEY, sequence(encode(0x80, key_identifier(ca.key)))),
            "authority issuer wrong": (
                AUTHORITY_KEY,
                sequence(tagged(1, tagged(4, name_der(name("CN=x")))), encode(0x82, b"\1")),
            ),
            "freshest": (
                "2.5.29.46",
                sequence(sequence(tagged(0, tagged(0, encode(0x86, b"http://x"))))),
            ),
            "unknown": ("1.2.3.4", octets(b"x")),
            "issuer names": ("2.5.29.18", sequence(encode(0x82, b"example.com"))),
            "malformed number": ("2.5.29.20", b"\x05\x00"),
            "malformed point": ("2.5.29.28", b"xyz"),
            "no number": ("2.5.29.20", b""),
            "no authority key": (AUTHORITY_KEY, b""),
        }
        chosen = dice.choice(sorted(kinds))
        dotted, value = kinds[chosen]
        extensions = [each for each in extensions if each.dotted != dotted]
        if value:
            extensions.append(Extension(dotted, value, critical))
        words.append(f"{chosen}{' critical' if critical else ''}")
    version: int | None = 1
    if dice.random() < 0.08:
        version = dice.choice((None, 0, 2))
        words.append(f"version {version}")
    _change_list(trust, which, extensions=tuple(extensions), version=version)
    return f"the list {', '.join(words)}"


def list_files(trust: Trust, dice: Dice) -> str:
    """Several lists, and where they stand."""
    done = []
    if dice.random() < 0.6:
        _main_list(trust, dice)
    for _ in range(dice.choice((1, 1, 2))):
        who = dice.choice((ISSUER, ISSUER, *authorities(trust)))
        label, text = add_list(trust, dice, who)
        file = dice.choice(("crl.pem", "crl.pem", IDENTITY_FILE, PERMISSIONS_FILE, "cert.pem"))
        parts = trust.files.setdefault(file, [])
        place = dice.choice((0, len(parts)))
        parts.insert(place, label)
        done.append(f"{text} in {file} at {place}")
    if "crl.pem" in trust.files and dice.random() < 0.25:
        kind = dice.choice(("certificate", "text", "damaged"))
        data = {
            "certificate": pem("CERTIFICATE", some_der()), "text": dice.choice(STRAY),
            "damaged": pem("X509 CRL", b"\x30\x03abc"),
        }[kind]  # fmt: skip
        trust.files["crl.pem"].insert(dice.choice((0, len(trust.files["crl.pem"]))), data)
        done.append(f"{kind} in crl.pem")
    return "; ".join(done)
