"""Oddities of CA files, cert.pem and key.pem, and of PEM."""

from __future__ import annotations

import re
from base64 import b64decode, b64encode
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime
from functools import cache

from sros_tool.pki.der import encode
from tests.integration.trust.certificates import PURPOSE_IDS, Dice, authorities, keep_one_authority
from tests.integration.trust.trusts import (
    EVERYTHING,
    IDENTITY,
    IDENTITY_FILE,
    ISSUER,
    LEAF,
    PEER,
    PERMISSIONS,
    PERMISSIONS_FILE,
    SIGNING_CA,
    Edit,
    Trust,
    authority,
    list_of,
)
from tests.support.raw_pki import (
    USAGE,
    UTF8,
    integer,
    key,
    key_usage,
    name,
    octets,
    oid,
    pem,
    private_der,
    public_info,
    sequence,
    tagged,
)

# ── CA files ───────────────────────────────────────────────────────────────────────────────


def add_stranger(trust: Trust, dice: Dice) -> str:
    """Add an unrelated certificate to the trust, sometimes an odd one, and return its name."""
    which = dice.choice((
        "sound", "sound", "expired", "future", "sha384", "rsa", "pss", "same name", "same key",
        "leaf", "not self-signed", "no cRLSign", "same serial", "ed25519", "damaged signature",
    ))  # fmt: skip
    number = dice.randrange(22, 26)
    made = authority("CN=stranger", f"p256 {number}", 900 + number, *EVERYTHING)
    if which == "expired":
        made = replace(made, days=(-30, -1))
    elif which == "future":
        made = replace(made, days=(1, 30))
    elif which == "sha384":
        made = replace(made, algorithm="sha384")
    elif which in ("rsa", "pss"):
        made = authority("CN=stranger", "rsa2048 9", 900, *EVERYTHING)
        if which == "pss":
            made = replace(made, algorithm="pss sha256 sha256 32")
    elif which == "ed25519":
        made = authority("CN=stranger", "ed25519 1", 900, *EVERYTHING)
    elif which == "same name":
        subject = trust.certificates[dice.choice((ISSUER, SIGNING_CA))].subject
        made = replace(made, subject=subject, issuer=subject)
    elif which == "same key":
        model = trust.certificates[dice.choice((ISSUER, SIGNING_CA))]
        made = replace(model, serial=model.serial + 500, days=(-40, 20))
    elif which == "same serial":
        made = replace(made, serial=trust.certificates[ISSUER].serial)
    elif which == "leaf":
        made = trust.certificates[LEAF]
    elif which == "not self-signed":
        made = replace(made, issuer=name("CN=nobody"), signing="p256 30")
    elif which == "no cRLSign":
        made = made.with_extension(key_usage("keyCertSign", "digitalSignature"))
    elif which == "damaged signature":
        made = replace(made, spoil="signature")
    label = f"stranger, {which}"
    trust.certificates[label] = made
    trust.above[label] = label
    return label


def add_list(trust: Trust, dice: Dice, who: str) -> tuple[str, str]:
    """Add a revocation list of a CA to the trust; return its name and what it says."""
    serials = dice.choice(((), (5,), (trust.certificates[LEAF].serial,), (5, 6, 7)))
    made = list_of(trust, who, *serials)
    text = f"list of {who} with {serials}"
    if dice.random() < 0.3:
        days = dice.choice(((-20, -1), (1, 20), (-1, None)))
        made = replace(made, days=days)
        text += f" from day {days[0]} to {days[1]}"
    label = f"list {len(trust.lists)}"
    trust.lists[label] = made
    return label, text


STRAY = (
    b"# corporate CA, do not edit\n", b"\n\n\n", b"subject=CN = x\nissuer=CN = y\n",
    b"Bag Attributes\n    friendlyName: robot\n    localKeyID: 01 02\n", b"-----\n",
    b"-----BEGIN\n", b"--- BEGIN CERTIFICATE ---\n", b"\xff\xfe\x00garbage\n", b"x" * 300 + b"\n",
    b"x" * 3000, b"\0\0\0\n", b"-----END CERTIFICATE-----\n", b"text without a line end",
)  # fmt: skip


def damaged_block(trust: Trust, dice: Dice) -> tuple[str, bytes]:
    whole = pem("CERTIFICATE", some_der())
    kinds = {
        "an empty certificate": pem("CERTIFICATE", b""),
        "random bytes as a certificate": pem("CERTIFICATE", bytes(range(100))),
        "a truncated certificate": pem("CERTIFICATE", some_der()[:-40]),
        "a certificate with bytes behind": pem("CERTIFICATE", some_der() + b"abc"),
        "a certificate without its end": whole[: whole.index(b"-----END")],
        "a certificate cut in a line": whole[: len(whole) // 2] + b"\n",
        "base64 with a wrong letter": whole.replace(b"\nM", b"\n*", 1),
        "base64 without a letter": whole[:100] + whole[101:],
        "a public key": pem("PUBLIC KEY", bytes.fromhex("3000")),
        "a private key": pem(*private_der("p256 26")),
        "EC parameters": pem("EC PARAMETERS", oid("1.2.840.10045.3.1.7")),
        "DH parameters": pem("DH PARAMETERS", sequence(integer(23), integer(5))),
        "a request": pem("CERTIFICATE REQUEST", sequence()),
        "PKCS #7": pem("PKCS7", sequence(oid("1.2.840.113549.1.7.2"))),
        "an encrypted key": pem("ENCRYPTED PRIVATE KEY", sequence(octets(b"x"))),
        "a damaged list": pem("X509 CRL", b"\x30\x03abc"),
        "an unknown block": pem("SOMETHING", b"abc"),
        "a damaged unknown block": pem("SOMETHING", b"abc").replace(b"YWJj", b"*!"),
    }
    which = dice.choice(sorted(kinds))
    return which, kinds[which]


@cache
def some_der() -> bytes:
    made = authority("CN=damaged", "p256 27", 99, *EVERYTHING)
    return made.der(datetime(2026, 1, 1))  # nobody looks at its dates: it is never read


def ca_file(trust: Trust, dice: Dice) -> str:
    """Several certificates, order, lists, stray text, damaged parts."""
    role, file = dice.choice(((IDENTITY, IDENTITY_FILE), (PERMISSIONS, PERMISSIONS_FILE)))
    done = []
    for _ in range(dice.choice((1, 1, 1, 2, 2, 3))):
        parts = trust.files[file]
        place = dice.choice((0, len(parts), dice.randrange(len(parts) + 1)))
        at = "first" if place == 0 else "last" if place == len(parts) else "between"
        kind = dice.choices(
            ("stranger", "list", "text", "damaged", "again", "order", "drop", "chain", "own leaf"),
            (6, 5, 5, 6, 1, 2, 1, 1, 1),
        )[0]
        if kind == "stranger":
            label = add_stranger(trust, dice)
            parts.insert(place, label)
            done.append(f"{label} {at}")
        elif kind == "list":
            who = dice.choice(authorities(trust, role))
            label, text = add_list(trust, dice, who)
            parts.insert(place, label)
            done.append(f"{text} {at}")
        elif kind == "text":
            text_part = dice.choice(STRAY)
            parts.insert(place, text_part)
            done.append(f"text {text_part[:30]!r} {at}")
        elif kind == "damaged":
            which, data = damaged_block(trust, dice)
            parts.insert(place, data)
            done.append(f"{which} {at}")
        elif kind == "again":
            parts.insert(place, parts[0])
            done.append(f"its first part again {at}")
        elif kind == "order":
            dice.shuffle(parts)
            done.append(f"order {[str(each)[:20] for each in parts]}")
        elif kind == "drop" and len(parts) > 1:
            done.append(f"without {str(parts.pop(dice.randrange(len(parts))))[:20]}")
        elif kind == "chain":
            other = PERMISSIONS_FILE if role == IDENTITY else IDENTITY_FILE
            parts.insert(place, trust.files[other][0])
            done.append(f"the other CA {at}")
        else:
            parts.insert(place, LEAF)
            done.append(f"the leaf {at}")
    return f"{file}: {'; '.join(done)}"


def trusted_certificate(trust: Trust, dice: Dice) -> str:
    """A CA file, or cert.pem, in OpenSSL's form TRUSTED CERTIFICATE, and other labels."""
    who = dice.choice((ISSUER, SIGNING_CA, LEAF))
    label = dice.choice(
        ("TRUSTED CERTIFICATE",) * 4
        + ("X509 CERTIFICATE", "CERTIFICATE CHAIN", "CA CERTIFICATE", "certificate", "PKCS7", "")
    )
    trust.labels[who] = label
    text = f"{who} as {label!r}"
    if label == "TRUSTED CERTIFICATE" and dice.random() < 0.8:
        parts, words = [], []
        for number, word in ((None, "trusted for"), (0, "rejected for")):
            if dice.random() < 0.5:
                some = dice.sample(sorted(PURPOSE_IDS), dice.choice((1, 1, 2)))
                ids = b"".join(oid(PURPOSE_IDS[each]) for each in some)
                parts.append(sequence(ids) if number is None else tagged(number, ids))
                words.append(f"{word} {','.join(some)}")
        if dice.random() < 0.3:
            parts.append(encode(UTF8, b"an alias"))
            words.append("alias")
        trust.aliases[who] = sequence(*parts)
        text += f" {'; '.join(words)}"
    return text


# ── PEM ────────────────────────────────────────────────────────────────────────────────────


def _lines(change: Callable[[bytes], bytes]) -> Edit:
    return lambda data: b"".join(map(change, data.splitlines(keepends=True)))


def _body(change: Callable[[bytes], bytes]) -> Edit:
    return _lines(lambda line: line if line.startswith(b"--") else change(line))


def _rewrap(width: int) -> Edit:
    def edit(data: bytes) -> bytes:
        def wrap(match: re.Match[bytes]) -> bytes:
            text = match[2].replace(b"\n", b"")
            lines = (text[start : start + width] for start in range(0, len(text), width))
            return match[1] + b"\n".join(lines) + b"\n" + match[3]

        pattern = rb"(-----BEGIN [^\n]*-----\n)([A-Za-z0-9+/=\n]+?)(-----END )"
        return re.sub(pattern, wrap, data)

    return edit


def _der_of(data: bytes) -> bytes:

    found = re.search(rb"-----BEGIN [^\n]*-----\n([A-Za-z0-9+/=\n]+?)-----END ", data)
    return b64decode(found[1]) if found else data


def _once(old: bytes, new: bytes) -> Edit:
    return lambda data: data.replace(old, new, 1)


def _everywhere(old: bytes, new: bytes) -> Edit:
    return lambda data: data.replace(old, new)


def _after_begin(text: bytes) -> Edit:
    return lambda data: re.sub(rb"(-----BEGIN [^\n]*-----\n)", rb"\1" + text, data)


PEM_EDITS: dict[str, Edit] = {
    "CRLF": _everywhere(b"\n", b"\r\n"),
    "CR": _everywhere(b"\n", b"\r"),
    "CR CR LF": _everywhere(b"\n", b"\r\r\n"),
    "a byte order mark": lambda data: b"\xef\xbb\xbf" + data,
    "a byte order mark and a line": lambda data: b"\xef\xbb\xbf\n" + data,
    "no final line end": lambda data: data.rstrip(b"\n"),
    "empty lines before": lambda data: b"\n\n" + data,
    "empty lines behind": lambda data: data + b"\n\n\n",
    "an empty line after BEGIN": _after_begin(b"\n"),
    "two empty lines after BEGIN": _after_begin(b"\n\n"),
    "an empty line within": lambda data: re.sub(
        rb"(\n[A-Za-z0-9+/]{64}\n)", rb"\1\n", data, count=1
    ),
    "an empty line before END": _everywhere(b"-----END", b"\n-----END"),
    "a blank line before END": _everywhere(b"-----END", b"  \n-----END"),
    "indented by 2": _lines(lambda line: b"  " + line),
    "indented by a tab": _lines(lambda line: b"\t" + line),
    "the body indented": _body(lambda line: b"    " + line),
    "the first line not indented": lambda data: data.replace(b"\n", b"\n  ").rstrip(b" "),
    "only END indented": _everywhere(b"-----END", b" -----END"),
    "only BEGIN indented": _once(b"-----BEGIN", b" -----BEGIN"),
    "blanks at all line ends": _everywhere(b"\n", b"  \n"),
    "a blank after BEGIN": lambda data: re.sub(rb"(-----BEGIN [^\n]*-----)\n", rb"\1 \n", data),
    "a tab after END": lambda data: re.sub(rb"(-----END [^\n]*-----)\n", rb"\1\t\n", data),
    "text before": lambda data: b"a line of text\n" + data,
    "text glued before": lambda data: b"text" + data,
    "a quote before": lambda data: b'"' + data,
    "text behind": lambda data: data + b"some text\n",
    "text glued behind": lambda data: data.rstrip(b"\n") + b"text\n",
    "text glued after BEGIN": lambda data: re.sub(
        rb"(-----BEGIN [^\n]*-----)\n", rb"\1text\n", data
    ),
    "a comment": lambda data: b"# a comment\n" + data,
    "a comment within": _after_begin(b"# a comment\n"),
    "Proc-Type CLEAR": _after_begin(b"Proc-Type: 4,CLEAR\n\n"),
    "Proc-Type ENCRYPTED": _after_begin(
        b"Proc-Type: 4,ENCRYPTED\nDEK-Info: AES-256-CBC,00112233445566778899AABBCCDDEEFF\n\n"
    ),
    "MIC-ONLY": _after_begin(b"Proc-Type: 4,MIC-ONLY\nContent-Domain: RFC822\n\n"),
    "a header": _after_begin(b"Comment: made by us\n\n"),
    "a header without empty line": _after_begin(b"Comment: made by us\n"),
    "headers in two lines": _after_begin(b"Comment: made\n by us\nVersion: 1\n\n"),
    "lines of 76": _rewrap(76),
    "lines of 80": _rewrap(80),
    "lines of 60": _rewrap(60),
    "lines of 63": _rewrap(63),
    "lines of 4": _rewrap(4),
    "lines of 1": _rewrap(1),
    "lines of 253": _rewrap(253),
    "lines of 254": _rewrap(254),
    "lines of 256": _rewrap(256),
    "one line": _rewrap(100000),
    "lower case begin": _everywhere(b"BEGIN", b"begin"),
    "four dashes": _everywhere(b"-----", b"----"),
    "six dashes": _everywhere(b"-----", b"------"),
    "four dashes behind BEGIN": lambda data: re.sub(
        rb"(-----BEGIN [^\n]*-----)\n", lambda m: m[1][:-1] + b"\n", data
    ),
    "dashes of Unicode": _everywhere(b"-----", "–––––".encode()),
    "another END": lambda data: re.sub(rb"-----END [^\n]*-----", b"-----END OTHER-----", data),
    "no END": lambda data: re.sub(rb"-----END [^\n]*-----\n", b"", data),
    "no BEGIN": lambda data: re.sub(rb"-----BEGIN [^\n]*-----\n", b"", data),
    "two blanks in BEGIN": _everywhere(b"-----BEGIN ", b"-----BEGIN  "),
    "a blank before the last dashes": lambda data: re.sub(
        rb"(-----BEGIN [^\n]*?)-----\n", rb"\1 -----\n", data
    ),
    "no padding": _everywhere(b"=", b""),
    "more padding": lambda data: re.sub(rb"\n-----END", b"==\n-----END", data),
    "padding in the middle": lambda data: re.sub(
        rb"(\n[A-Za-z0-9+/]{60})....\n", rb"\1AA==\n", data, count=1
    ),
    "a wrong letter": lambda data: re.sub(rb"(\n[A-Za-z0-9+/]{20}).", rb"\1*", data, count=1),
    "a minus for a plus": _everywhere(b"+", b"-"),
    "a blank within a line": lambda data: re.sub(rb"(\n[A-Za-z0-9+/]{20})", rb"\1 ", data, count=1),
    "a missing letter": lambda data: re.sub(rb"(\n[A-Za-z0-9+/]{20}).", rb"\1", data, count=1),
    "a missing line": lambda data: re.sub(rb"\n[A-Za-z0-9+/]{64}\n", b"\n", data, count=1),
    "NUL before": lambda data: b"\0" + data,
    "NUL behind": lambda data: data + b"\0",
    "NUL line behind": lambda data: data + b"\0\n",
    "NUL within": lambda data: re.sub(rb"(\n[A-Za-z0-9+/]{20})", b"\\1\0", data, count=1),
    "Ctrl-Z behind": lambda data: data + b"\x1a",
    "DER": _der_of,
    "UTF-16": lambda data: data.decode("latin-1").encode("utf-16"),
    "base64 alone": lambda data: b64encode(_der_of(data)) + b"\n",
    "line ends written as backslash n": _everywhere(b"\n", b"\\n"),
    "in quotes": lambda data: b'"' + data.rstrip(b"\n") + b'"\n',
    "a key of YAML before": lambda data: (
        b"ca: |\n" + b"".join(b"  " + line for line in data.splitlines(keepends=True))
    ),
    "empty": lambda _: b"",
    "an empty line alone": lambda _: b"\n",
    "a form feed before": lambda data: b"\f\n" + data,
    "a form feed glued": lambda data: b"\f" + data,
    "a no-break space glued": lambda data: b"\xc2\xa0" + data,
    "a line of 300 letters before": lambda data: b"y" * 300 + b"\n" + data,
    "a line of 254 letters before": lambda data: b"y" * 254 + b"\n" + data,
    "a line of 255 letters before": lambda data: b"y" * 255 + b"\n" + data,
    "254 letters glued before": lambda data: b"y" * 254 + data,
    "255 letters glued before": lambda data: b"y" * 255 + data,
    "many lines before": lambda data: b"text: x\n" * 3000 + data,
    "a colon line before": lambda data: b"Subject: CN=x\n" + data,
    "the same again": lambda data: data + data,
    "END first": lambda data: b"-----END CERTIFICATE-----\n" + data,
    "BEGIN twice": lambda data: re.sub(rb"(-----BEGIN [^\n]*-----\n)", rb"\1\1", data, count=1),
    "a half block before": lambda data: b"-----BEGIN CERTIFICATE-----\nMIIB\n" + data,
    "lines joined by blanks": lambda data: re.sub(
        rb"(?<=[A-Za-z0-9+/])\n(?=[A-Za-z0-9+/=])", b" ", data
    ),
    "high bytes before": lambda data: "größe\n".encode("latin-1") + data,
}


def pem_form(trust: Trust, dice: Dice) -> str:
    file = dice.choice(
        (IDENTITY_FILE, PERMISSIONS_FILE, "cert.pem", "key.pem", "key.pem", "crl.pem")
    )
    done = []
    if file == "crl.pem" and file not in trust.files:
        trust.lists["list 0"] = list_of(trust, ISSUER, 5)
        trust.files[file] = ["list 0"]
        if trust.certificates[ISSUER].without(USAGE) != trust.certificates[ISSUER]:
            trust.certificates[ISSUER] = trust.certificates[ISSUER].with_extension(
                key_usage(*EVERYTHING)
            )
            keep_one_authority(trust, ISSUER)
    for _ in range(dice.choice((1, 1, 1, 2))):
        how = dice.choice(sorted(PEM_EDITS))
        parts = trust.files.get(file, [])
        if len(parts) > 1 and dice.random() < 0.5:
            place = dice.randrange(len(parts))
            trust.part_edits.setdefault((file, place), []).append(PEM_EDITS[how])
            done.append(f"{how} in part {place}")
        else:
            trust.edit(file, PEM_EDITS[how])
            done.append(how)
    return f"{file}: {' + '.join(done)}"


ZEROS = (
    b"\0\0\0\n", b"\0-----BEGIN CERTIFICATE-----\n", b"text\0\0\n", b"text\0", b"x" * 253 + b"\0\n",
    b"x" * 254 + b"\0\n", b"x" * 300 + b"\0\n", b"\n\0", b"# \0 # \0\n",
)  # fmt: skip


def zero_bytes(trust: Trust, dice: Dice) -> str:
    """Zero bytes between the blocks of a PEM file."""
    choices = (IDENTITY_FILE, PERMISSIONS_FILE, "cert.pem", "key.pem", "crl.pem")
    file = dice.choice([each for each in choices if each == "key.pem" or each in trust.files])
    zeros, first = dice.choice(ZEROS), dice.random() < 0.6
    behind = dice.choice((b"", damaged_block(trust, dice)[1]))
    trust.edit(file, lambda data: zeros + data if first else data + zeros + behind)
    place = "before" if first else f"behind, then {len(behind)} bytes"
    return f"{file}: {zeros[:10]!r}..., {len(zeros)} bytes, {place}"


def certificate_file(trust: Trust, dice: Dice) -> str:
    """More than the certificate in cert.pem."""
    parts = trust.files["cert.pem"]
    done = []
    for _ in range(dice.choice((1, 1, 2))):
        place = dice.choice((0, len(parts)))
        at = "last" if place else "first"
        kind = dice.choice(("chain", "stranger", "text", "damaged", "list", "peer", "key"))
        if kind == "chain":
            parts.insert(place, ISSUER)
        elif kind == "stranger":
            kind = add_stranger(trust, dice)
            parts.insert(place, kind)
        elif kind == "text":
            text = dice.choice(STRAY)
            parts.insert(place, text)
            kind = f"text {text[:30]!r}"
        elif kind == "damaged":
            kind, data = damaged_block(trust, dice)
            parts.insert(place, data)
        elif kind == "list":
            label, kind = add_list(trust, dice, ISSUER)
            parts.insert(place, label)
        elif kind == "peer":
            parts.insert(place, PEER)
        else:
            parts.insert(place, pem(*private_der(trust.certificates[LEAF].key)))
        done.append(f"{kind} {at}")
    return f"cert.pem: {'; '.join(done)}"


def key_file(trust: Trust, dice: Dice) -> str:
    """Forms of the private key, and what else stands in its file."""
    if trust.on_token:
        return "no key.pem: the key is on a token"  # key.p11 is read by the RMW, not by DDS
    leaf = trust.certificates[LEAF].key
    done = []
    if dice.random() < 0.6:
        trust.key_form = dice.choice(
            ("pkcs8", "traditional", "explicit", "traditional explicit", "pss")
        )
        done.append(f"form {trust.key_form}")
    if dice.random() < 0.25:
        trust.key = dice.choice(("p256 28", "rsa2048 5", "p384 0", "ed25519 0"))
        done.append(f"another key, {trust.key}")
    if dice.random() < 0.6 or not done:
        label, der = private_der(leaf, trust.key_form)
        extra = {
            "EC parameters": pem("EC PARAMETERS", oid("1.2.840.10045.3.1.7")),
            "EC parameters of P-384": pem("EC PARAMETERS", oid("1.3.132.0.34")),
            "another key": pem(*private_der("p256 29")),
            "an RSA key": pem(*private_der("rsa2048 5", "traditional")),
            "a certificate": pem("CERTIFICATE", some_der()),
            "a public key": pem("PUBLIC KEY", _public(leaf)),
            "an encrypted key": encrypted(leaf, dice),
            "a damaged key": pem(label, der[:-9]),
            "a damaged PKCS #8 key": pem("PRIVATE KEY", b"\x30\x03abc"),
            "DSA parameters": pem("DSA PARAMETERS", sequence(integer(23), integer(11), integer(5))),
            "text": dice.choice(STRAY),
            "Bag Attributes": STRAY[3] + b"Key Attributes: <No Attributes>\n",
            "an OpenSSH key": pem("OPENSSH PRIVATE KEY", b"openssh-key-v1\0"),
        }
        which = dice.choice(sorted(extra))
        first = dice.random() < 0.7
        found = extra[which]
        trust.edit("key.pem", (lambda data: found + data) if first else (lambda data: data + found))
        done.append(f"{which} {'before' if first else 'behind'}")
    elif dice.random() < 0.3:
        secret = encrypted(leaf, dice)
        trust.edit("key.pem", lambda _: secret)
        done.append("encrypted")
    if dice.random() < 0.15:
        old = dice.choice((b"EC PRIVATE KEY", b"RSA PRIVATE KEY", b"PRIVATE KEY"))
        new = dice.choice(
            (b"PRIVATE KEY", b"EC PRIVATE KEY", b"RSA PRIVATE KEY", b"ANY PRIVATE KEY")
        )
        trust.edit("key.pem", _everywhere(old, new))
        done.append(f"{old!r} called {new!r}")
    return f"key.pem: {'; '.join(done)}"


def _public(label: str) -> bytes:

    return public_info(label)


def encrypted(label: str, dice: Dice) -> bytes:
    from cryptography.hazmat.primitives.serialization import (
        BestAvailableEncryption,
        Encoding,
        PrivateFormat,
    )

    kind = key(label)
    wanted = dice.choice((PrivateFormat.PKCS8, PrivateFormat.TraditionalOpenSSL))
    if label.startswith("ed"):
        wanted = PrivateFormat.PKCS8
    password = BestAvailableEncryption(b"secret")
    made: bytes = kind.private_bytes(Encoding.PEM, wanted, password)
    return made
