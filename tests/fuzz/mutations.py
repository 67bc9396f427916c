"""Mutations of real documents: of bytes, of words, and of the DER inside of PEM and S/MIME."""

from __future__ import annotations

import base64
import gzip
import io
import random
import re
import tarfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass

from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec

SEQUENCE, BIT_STRING, OCTET_STRING = 0x30, 0x03, 0x04
TAGS = (*range(0x01, 0x1F), 0x30, 0x31, *range(0x80, 0x86), *range(0xA0, 0xA5), 0x1F, 0x00)
LARGEST = 200_000
"""Largest mutated document, in bytes."""


# ── DER ────────────────────────────────────────────────────────────────────────────────────


@dataclass
class Value:
    """A DER value; the content of a constructed value is a list."""

    tag: int
    content: bytes | list[Value]

    def encoded(self) -> bytes:
        content = self.content
        body = content if isinstance(content, bytes) else b"".join(v.encoded() for v in content)
        size = len(body)
        if size < 0x80:
            return bytes((self.tag, size)) + body
        length = size.to_bytes((size.bit_length() + 7) // 8, "big")
        return bytes((self.tag, 0x80 | len(length))) + length + body

    def all(self) -> Iterator[Value]:
        """Yield this value and all below it."""
        yield self
        if not isinstance(self.content, bytes):
            for each in self.content:
                yield from each.all()


def decoded(data: bytes) -> list[Value]:
    """Return the DER values in ``data``; raise `ValueError` if it is not DER."""
    values, position = [], 0
    while position < len(data):
        tag, length = data[position], data[position + 1 : position + 2]
        if not length or tag & 0x1F == 0x1F:
            raise ValueError
        size, position = length[0], position + 2
        if size >= 0x80:
            width = size & 0x7F
            size = int.from_bytes(data[position : position + width], "big")
            position += width
            if not 1 <= width <= 3:
                raise ValueError
        content = data[position : position + size]
        if len(content) != size:
            raise ValueError
        position += size
        value = Value(tag, content)
        if tag & 0x20 or (tag == OCTET_STRING and content[:1] in (b"\x30", b"\x03", b"\x04")):
            with suppress(ValueError, IndexError):
                value.content = decoded(content)
        values.append(value)
    return values


_TIMES = (
    *(b"%sZ" % time for time in (b"000101000000", b"500101000000", b"491231235959")),
    *(b"%04d0101000000Z" % year for year in (0, 1, 1899, 1949, 1950, 2049, 2050, 2999, 9999)),
    b"99991231235959Z",
    b"20260229000000Z",
    b"20261301000000Z",
    b"20260101240000Z",
    b"202601010000Z",
    b"20260101000000+0100",
    b"20260101000000.5Z",
    b"",
)
_CONTENTS = (
    b"",
    b"\x00",
    b"\x01",
    b"\x02",
    b"\x03",
    b"\x05",
    b"\xff",
    b"\xff" * 8,
    b"\x7f" * 21,
    b"\x00" * 40,
    b"\x80" * 9,
    b"\xc3\x28",
    b"\xed\xa0\x80",
    b"a\x00b",
    b"\x1b[2J",
    "‮x".encode(),
    b"x" * 70_000,
    b"*",
    b"/" + b"a/" * 500,
)


def _mutate_value(values: list[Value], dice: random.Random) -> None:
    """Change one value below ``values`` in place."""
    everything = [each for value in values for each in value.all()]
    parents = [each.content for each in everything if not isinstance(each.content, bytes)]
    siblings = dice.choice([values, *parents])
    target = dice.choice(everything)
    times = [each for each in everything if each.tag in (0x17, 0x18)]
    how = dice.randrange(11)
    if how == 0 and times:
        time = dice.choice(times)
        time.content = dice.choice(_TIMES)
        time.tag = 0x17 if len(time.content) == 13 else 0x18
        if dice.random() < 0.1:
            time.tag ^= 0x0F
    elif how in (1, 2):
        target.tag = dice.choice(TAGS)
        if target.tag & 0x20 and isinstance(target.content, bytes):
            target.content = [Value(0x0C, target.content)]
    elif how in (3, 4):
        target.content = dice.choice(_CONTENTS)
    elif how == 5 and siblings:
        del siblings[dice.randrange(len(siblings))]
    elif how == 6 and siblings:
        siblings.insert(dice.randrange(len(siblings) + 1), dice.choice(siblings))
    elif how == 7 and len(siblings) > 1:
        dice.shuffle(siblings)
    elif how == 8 and isinstance(target.content, bytes):
        changed = bytearray(target.content)
        damage(changed, dice)
        target.content = bytes(changed)
    elif how == 9 and siblings:
        siblings.append(Value(dice.choice(TAGS), dice.choice(_CONTENTS)))
    elif how == 10:
        other = dice.choice(everything)
        with suppress(ValueError):  # a copy, so that no value contains itself
            (copy,) = decoded(other.encoded())
            target.tag, target.content = copy.tag, copy.content


def _signed_again(values: list[Value], key: ec.EllipticCurvePrivateKey) -> None:
    """Replace the signature of a certificate, request or revocation list by a valid one."""
    match values:
        case [Value(tag=0x30, content=[body, Value(tag=0x30), Value(tag=0x03) as signature])]:
            signature.content = b"\0" + key.sign(body.encoded(), ec.ECDSA(hashes.SHA256()))


# ── bytes and words ────────────────────────────────────────────────────────────────────────


_WORDS = (
    b"",
    b"0",
    b"-1",
    b"1e999",
    b"NaN",
    b"9" * 30,
    b"9" * 5000,
    b"true",
    b"null",
    b"[]",
    b"{}",
    b'""',
    b"0001-01-01T00:00:00Z",
    b"1949-12-31T23:59:59Z",
    b"9999-12-31T23:59:59Z",
    b"9999-12-31T23:59:59-23:59",
    b"10000-01-01T00:00:00",
    b"2026-02-30",
    b"100y",
    b"999999999y",
    b"/",
    b"//",
    b"../../etc/passwd",
    b"/a/../b",
    b"~",
    b"~/x",
    b"*" * 200,
    b"[" * 3000,
    b"{" * 3000,
    b"<a>" * 300,
    b"(" * 3000,
    b"x" * 5000,
    b"\x00",
    b"\xff\xfe",
    b"\xed\xa0\x80",
    b"\\ud800",
    b"\x1b[2J",
    "‮".encode(),
    b"&#0;",
    b"&#x10FFFF;",
    b"&lol;",
    b"<!DOCTYPE a [<!ENTITY b 'c'>]>",
    b"<![CDATA[",
    b"]]>",
    b"<?x ?>",
    b"CN=x",
    b"CN=x+O=y",
    b"CN=#0302",
    b"pkcs11:token=x",
    b"file:",
    b"rt/",
    b"rq/xRequest",
    b"ENCRYPT",
    b"4294967296",
    b"0-4294967295",
)
_TOKEN = re.compile(rb"[\w.:/*+-]+|<[^<>]*>|\"[^\"]*\"|[^\w\s]")


def damage(data: bytearray, dice: random.Random) -> None:
    """Change, remove or insert some bytes in place."""
    for _ in range(dice.choice((1, 1, 1, 2, 4))):
        place = dice.randrange(len(data) + 1)
        how = dice.randrange(3)
        if how == 0 and place < len(data):
            data[place] = dice.randrange(256)
        elif how == 1:
            del data[place : place + dice.randrange(1, 4)]
        else:
            data[place:place] = dice.randbytes(dice.randrange(1, 4))


def _bytes(data: bytes, dice: random.Random) -> bytes:
    changed = bytearray(data)
    damage(changed, dice)
    return bytes(changed)


def _cut(data: bytes, dice: random.Random) -> bytes:
    begin, end = sorted(dice.randrange(len(data) + 1) for _ in range(2))
    return dice.choice((data[:begin], data[begin:], data[:begin] + data[end:]))


def _word(data: bytes, dice: random.Random) -> bytes:
    """Replace a word by another word of the document, or by a hostile one."""
    found = list(_TOKEN.finditer(data[: LARGEST // 4]))
    if not found:
        return dice.choice(_WORDS)
    place = dice.choice(found)
    new = dice.choice(found)[0] if dice.random() < 0.3 else dice.choice(_WORDS)
    if place[0][:1] == b'"' and dice.random() < 0.7:
        new = b'"' + new.strip(b'"') + b'"'
    return data[: place.start()] + new + data[place.end() :]


def _lines(data: bytes, dice: random.Random) -> bytes:
    lines = data.splitlines(keepends=True)
    if not lines:
        return data
    how, place = dice.randrange(4), dice.randrange(len(lines))
    if how == 0:
        del lines[place]
    elif how == 1:
        lines.insert(dice.randrange(len(lines)), lines[place])
    elif how == 2:
        dice.shuffle(lines)
    else:
        lines[place] *= dice.choice((2, 50, 1000))
    return b"".join(lines)


# ── documents ──────────────────────────────────────────────────────────────────────────────


_BASE64 = re.compile(rb"(?:-----BEGIN [A-Z0-9 ]+-----\n|smime\.p7s\"\r\n\r\n)([A-Za-z0-9+/=\s]+)")


class Mutator:
    """Mutates documents of a corpus by the dice it is given; ``key`` signs what was signed."""

    def __init__(
        self,
        corpus: Sequence[bytes],
        key: ec.EllipticCurvePrivateKey,
        sign: Callable[[bytes], bytes],
    ) -> None:
        self._corpus = corpus
        self._key = key
        self._sign = sign

    def draw(self, dice: random.Random) -> bytes:
        """Return a mutated document of the corpus."""
        return self.mutated(dice.choice(self._corpus), dice)

    def mutated(self, data: bytes, dice: random.Random) -> bytes:
        """Return ``data`` with one to three mutations."""
        for _ in range(dice.choice((1, 1, 1, 2, 3))):
            data = self._once(data, dice)[:LARGEST]
        return data

    def _once(self, data: bytes, dice: random.Random) -> bytes:
        if dice.random() < 0.75:
            if data[:2] == b"\x1f\x8b":
                return self._archive(data, dice)
            if blocks := list(_BASE64.finditer(data)):
                return self._inside(data, dice.choice(blocks), dice)
        if dice.random() < 0.05:
            other = dice.choice(self._corpus)
            place = dice.randrange(len(data) + 1)
            return data[:place] + dice.choice((other, other[place:]))
        return dice.choice((_bytes, _cut, _word, _word, _word, _lines))(data, dice)

    def _inside(self, data: bytes, block: re.Match[bytes], dice: random.Random) -> bytes:
        """Mutate what base64 carries; of a signed document sometimes the content, signed again."""
        if data[:4] == b"MIME" and dice.random() < 0.6:
            document = data.partition(b"text/plain\r\n\r\n")[2].partition(b"\r\n------")[0]
            return self._sign(dice.choice((_word, _word, _bytes, _lines))(document, dice))
        try:
            der = base64.b64decode(block[1])
        except ValueError:  # damaged already
            return _bytes(data, dice)
        with suppress(ValueError, IndexError):
            values = decoded(der)
            for _ in range(dice.choice((1, 1, 2, 3))):
                _mutate_value(values, dice)
            if dice.random() < 0.6:
                _signed_again(values, self._key)
            der = b"".join(value.encoded() for value in values)
        encoded = base64.encodebytes(der)
        if data[:4] == b"MIME":
            encoded = encoded.replace(b"\n", b"\r\n")
        return data[: block.start(1)] + encoded + data[block.end(1) :]

    def _archive(self, data: bytes, dice: random.Random) -> bytes:
        """Mutate a file in an archive, the entries of the archive, or its bytes before packing."""
        try:
            plain = gzip.decompress(data)
            if dice.random() < 0.3:
                return gzip.compress(_bytes(plain, dice), 1)
            with tarfile.open(fileobj=io.BytesIO(plain)) as tar:
                entries = [(each, tar.extractfile(each)) for each in tar if each.isfile()]
                files = {each.name: file.read() for each, file in entries if file}
        except (tarfile.TarError, zlib.error, EOFError, OSError, ValueError):
            return data
        if not files:
            return data
        path = dice.choice(list(files))
        how = dice.randrange(6)
        if how == 0:
            name = _word(path.encode(), dice).decode(errors="replace")
            files[name] = files.pop(path)
        elif how == 1:
            del files[path]
        else:
            files[path] = self.mutated(files[path], dice)
        buffer = io.BytesIO()
        with (
            gzip.GzipFile(fileobj=buffer, mode="wb", compresslevel=1) as packed,
            tarfile.open(fileobj=packed, mode="w") as new,
        ):
            for name, content in files.items():
                entry = tarfile.TarInfo(name)
                entry.size = len(content)
                if dice.random() < 0.02:
                    entry.type = dice.choice((tarfile.SYMTYPE, tarfile.FIFOTYPE, tarfile.DIRTYPE))
                with suppress(ValueError, UnicodeError):
                    new.addfile(entry, io.BytesIO(content))
        return buffer.getvalue()
