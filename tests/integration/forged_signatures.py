"""Forged signed documents: valid S/MIME messages, altered in their MIME and in their CMS.

The forger has the key of the CA: it signs again what it altered, because a signature that does not
verify would hide every other difference.
"""

from __future__ import annotations

import base64
import ctypes
import random
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec, padding
from cryptography.hazmat.primitives.serialization import Encoding

from sros_tool.pki.der import encode_oid
from sros_tool.pki.keys import PrivateKey

# ── DER as a tree that can be altered ──────────────────────────────────────────────────────


@dataclass
class Node:
    """A value of DER or BER: with children if it is constructed, else with content."""

    tag: int
    content: bytes = b""
    children: list[Node] = field(default_factory=list)
    length: str = "shortest"
    after: bytes = b""
    """What is put behind it."""

    @staticmethod
    def read(data: bytes) -> list[Node]:
        nodes = []
        while data:
            size, start = data[1], 2
            if size > 0x80:
                start = 2 + size - 0x80
                size = int.from_bytes(data[2:start], "big")
            content, data, node = data[start : start + size], data[start + size :], Node(data[0])
            if node.tag & 0x20:
                node.children = Node.read(content)
            else:
                node.content = content
            nodes.append(node)
        return nodes

    def write(self) -> bytes:
        content = b"".join(each.write() for each in self.children) or self.content
        size = len(content)
        if self.length == "indefinite":
            return bytes([self.tag, 0x80]) + content + b"\0\0" + self.after
        if self.length == "shortest":
            octets = size.to_bytes((size.bit_length() + 7) // 8, "big") if size > 0x7F else b""
        else:
            octets = size.to_bytes(4, "big")
        head = bytes([0x80 + len(octets)]) + octets if octets else bytes([size])
        return bytes([self.tag]) + head + content + self.after

    def below(self) -> list[Node]:
        return [self, *(each for child in self.children for each in child.below())]


def value(tag: int, content: bytes | list[Node] = b"") -> Node:
    if isinstance(content, bytes):
        return Node(tag, content)
    return Node(tag, children=content)


OIDS = [
    encode_oid(each)
    for each in (
        "1.2.840.113549.1.7.1",  # data
        "1.2.840.113549.1.7.2",  # signedData
        "1.2.840.113549.1.9.3",  # contentType
        "1.2.840.113549.1.9.4",  # messageDigest
        "1.2.840.113549.1.9.5",  # signingTime
        "2.16.840.1.101.3.4.2.1",  # SHA-256
        "2.16.840.1.101.3.4.2.2",
        "2.16.840.1.101.3.4.2.3",
        "1.3.14.3.2.26",  # SHA-1
        "1.2.840.113549.2.5",  # MD5
        "1.2.840.113549.1.1.1",  # rsaEncryption
        "1.2.840.113549.1.1.10",  # RSASSA-PSS
        "1.2.840.113549.1.1.11",  # RSA with SHA-256
        "1.2.840.113549.1.1.5",
        "1.2.840.10045.2.1",  # id-ecPublicKey
        "1.2.840.10045.4.3.2",  # ECDSA with SHA-256
        "1.2.840.10045.4.3.3",
        "1.2.840.10045.4.1",
        "1.3.101.112",  # Ed25519
        "1.2.3.4",
    )
]
HASHES = {
    OIDS[5]: hashes.SHA256(),
    OIDS[6]: hashes.SHA384(),
    OIDS[7]: hashes.SHA512(),
    OIDS[8]: hashes.SHA1(),
}
VALUES = (
    b"\x05\x00", b"\x02\x01\x01", b"\x02\x01\x03", b"\x02\x02\x00\x01", b"\x02\x00", b"\x04\x01x",
    b"\x24\x03\x04\x01x", b"\x30\x00", b"\x31\x00", b"\xa0\x00", b"\xa1\x00", b"\x01\x01\x01",
    b"\x17\x0d260101000000Z", b"\x17\x03xyz", b"\x18\x0f20260101000000Z", b"\x05\x01x", b"\x06\x00",
    b"\x06\x02\x80\x01", b"\x1e\x01x", b"\x1c\x03xyz", b"\x03\x01\x09", b"\x03\x00",
    b"\x0a\x01\x01",
    b"\x80\x01x", b"\x0c\x01\xff", b"\x09\x01\x00", b"\x1f\x81\x01\x00", b"\x00\x00",
)  # fmt: skip


@dataclass(frozen=True)
class Signer:
    """A certificate with its key."""

    certificate: x509.Certificate
    key: PrivateKey

    def sign(self, data: bytes, digest: hashes.HashAlgorithm) -> bytes:
        if isinstance(self.key, ec.EllipticCurvePrivateKey):
            return self.key.sign(data, ec.ECDSA(digest))
        return self.key.sign(data, padding.PKCS1v15(), digest)


@dataclass(frozen=True)
class Original:
    """A valid message, who signed it, and certificates that the forger puts next to the signer."""

    message: bytes
    signer: Signer
    others: tuple[x509.Certificate, ...]


class Forger:
    """It alters valid messages at random."""

    def __init__(self, originals: list[Original], seed: int) -> None:
        self._originals = originals
        self._dice = random.Random(seed)

    def forge(self) -> tuple[Original, bytes, str]:
        """Return an original, a forgery of it, and the names of what was altered."""
        dice = self._dice
        original = dice.choice(self._originals)
        message = original.message
        names: list[str] = []
        where = dice.random()
        if where < 0.6:
            message, names = self._forge_cms(original)
        if where > 0.5:
            for _ in range(dice.choice((1, 1, 2, 3))):
                alter = dice.choice(MIME)
                names.append(alter.__name__)
                message = alter(message, dice)
        return original, message, " ".join(names)

    def _forge_cms(self, original: Original) -> tuple[bytes, list[str]]:
        dice = self._dice
        signature = re.search(rb"\n\r?\n((?:[A-Za-z0-9+/=]+\r?\n){5,})", original.message)
        assert signature
        (root,) = Node.read(base64.b64decode(signature[1]))
        content = _content(original.message, root)
        names = []
        for _ in range(dice.choice((1, 1, 2, 3))):
            alter = dice.choice(CMS)
            names.append(alter.__name__)
            try:
                alter(root, original, dice)
            except (IndexError, ValueError, StopIteration):  # the place was altered away
                names.append("(nothing)")
        if dice.random() < 0.7:
            names.append("signed again")
            _sign_again(root, content, original.signer)
        data = root.write()
        wide = dice.choice((48, 57, 48, 48))
        encoded = b"".join(
            base64.b64encode(data[at : at + wide]) + b"\r\n" for at in range(0, len(data), wide)
        )
        return original.message[: signature.start(1)] + encoded + original.message[
            signature.end(1) :
        ], names


def _content(message: bytes, root: Node) -> bytes:
    contained = _signed_data(root).children[2].children[1:]
    if contained:
        return contained[0].children[0].content
    mark = re.search(rb'boundary="([^"]+)"', message)
    assert mark
    part = message.split(b"--" + mark[1])[1]
    content = part.replace(b"\r\n", b"\n").removeprefix(b"\n").removesuffix(b"\n")
    return content.replace(b"\n", b"\r\n")


def _signed_data(root: Node) -> Node:
    return root.children[1].children[0]


def _info(root: Node) -> Node:
    return _signed_data(root).children[-1].children[0]


def _sign_again(root: Node, content: bytes, signer: Signer) -> None:
    """Sign what the message has now, as far as it can still be read."""
    try:
        info = _info(root)
        digest = HASHES[info.children[2].children[0].content]
        signed = content
        if info.children[3].tag == 0xA0:
            hashed = hashes.Hash(digest)
            hashed.update(content)
            for attribute in info.children[3].children:
                if attribute.children and attribute.children[0].content == OIDS[3]:
                    octets = attribute.children[1].children[0]
                    if len(octets.content) >= 16:
                        octets.content = hashed.finalize()
                    break
            signed = b"\x31" + info.children[3].write()[1:]
        octets = next(each for each in info.children[4:] if each.tag == 4)
        octets.content = signer.sign(signed, digest)
    except (IndexError, KeyError, StopIteration, ValueError):
        return


# ── what is altered in the CMS ─────────────────────────────────────────────────────────────

AlterCms = Callable[[Node, Original, random.Random], None]
AlterMime = Callable[[bytes, random.Random], bytes]


def _any_node(root: Node, dice: random.Random) -> Node:
    # Most values are those of the certificates, which are the least interesting.
    fields = _signed_data(root).children
    nodes = dice.choice(
        (_info(root).below(), _info(root).below(), root.below(), *map(Node.below, fields))
    )
    return dice.choice(nodes)


def _any_parent(root: Node, dice: random.Random) -> Node:
    for _ in range(20):
        if (node := _any_node(root, dice)).children:
            return node
    raise IndexError


def drop(root: Node, _: Original, dice: random.Random) -> None:
    node = _any_parent(root, dice)
    del node.children[dice.randrange(len(node.children))]


def double(root: Node, _: Original, dice: random.Random) -> None:
    node = _any_parent(root, dice)
    one = dice.choice(node.children)
    node.children.insert(dice.randrange(len(node.children) + 1), Node.read(one.write())[0])


def swap(root: Node, _: Original, dice: random.Random) -> None:
    node = _any_parent(root, dice)
    dice.shuffle(node.children)


def insert(root: Node, _: Original, dice: random.Random) -> None:
    node = _any_parent(root, dice)
    node.children.insert(dice.randrange(len(node.children) + 1), raw(dice.choice(VALUES)))


def raw(data: bytes) -> Node:
    return Node(data[0], data[2:]) if data[1] == len(data) - 2 else Node(0x04, data)


def replace(root: Node, _: Original, dice: random.Random) -> None:
    node = _any_parent(root, dice)
    node.children[dice.randrange(len(node.children))] = raw(dice.choice(VALUES))


def retag(root: Node, _: Original, dice: random.Random) -> None:
    node = _any_node(root, dice)
    node.tag = dice.choice(
        (node.tag ^ 0x20, 0x30, 0x31, 0xA0, 0xA1, 0x04, 0x02, 0x0C, 0x80, 0x24, 0x17)
    )


def other_oid(root: Node, _: Original, dice: random.Random) -> None:
    node = dice.choice([each for each in _any_parent(root, dice).below() if each.tag == 6])
    node.content = dice.choice(OIDS)


def other_algorithm(root: Node, _: Original, dice: random.Random) -> None:
    """Alter one of the three algorithms, or two of them, to the same."""
    info = _info(root).children
    places = [_signed_data(root).children[1].children[0], info[2], info[-2]]
    oid = dice.choice(OIDS[5:])
    for node in dice.sample(places, dice.choice((1, 1, 2, 3))):
        node.children[0].content = oid


def parameters(root: Node, _: Original, dice: random.Random) -> None:
    info = _info(root).children
    node = dice.choice((_signed_data(root).children[1].children[0], info[2], info[-2]))
    node.children[1:] = [raw(dice.choice(VALUES)) for _ in range(dice.choice((0, 1, 1, 2)))]


def more_digests(root: Node, _: Original, dice: random.Random) -> None:
    algorithm = value(0x30, [value(6, dice.choice(OIDS[5:10])), *dice.choice(([], [value(5)]))])
    algorithms = _signed_data(root).children[1].children
    algorithms.insert(dice.randrange(len(algorithms) + 1), algorithm)


def number(root: Node, _: Original, dice: random.Random) -> None:
    node = dice.choice(
        [each for each in _info(root).below() + _signed_data(root).children if each.tag == 2]
    )
    node.content = dice.choice((
        b"\0" + node.content, b"\xff" + node.content, b"", b"\1", b"\3", b"\0",
        node.content + b"\0",
    ))  # fmt: skip


def byte(root: Node, _: Original, dice: random.Random) -> None:
    node = _any_node(root, dice)
    if node.content:
        content = bytearray(node.content)
        content[dice.randrange(len(content))] = dice.randrange(256)
        node.content = bytes(content)


def ber(root: Node, _: Original, dice: random.Random) -> None:
    node = _any_node(root, dice)
    node.length = dice.choice(("long", "indefinite") if node.children else ("long", "long"))


def in_pieces(root: Node, _: Original, dice: random.Random) -> None:
    """Make an OCTET STRING a constructed one."""
    node = dice.choice([each for each in root.below() if each.tag == 4])
    node.children = [value(4, node.content[:5]), value(4, node.content[5:])]
    node.tag, node.length = 0x24, dice.choice(("shortest", "indefinite"))


def trailing(root: Node, _: Original, dice: random.Random) -> None:
    dice.choice((root, _signed_data(root), _info(root))).after = dice.choice(
        (b"x", b"\0\0", b"\5\0")
    )


def attribute(root: Node, _: Original, dice: random.Random) -> None:
    """Add a signed attribute: another, or one that is there already with another value."""
    attributes = _info(root).children[3].children
    values = [raw(dice.choice(VALUES)) for _ in range(dice.choice((0, 1, 1, 1, 2)))]
    made = value(0x30, [value(6, dice.choice((*OIDS[:5], OIDS[-1]))), value(0x31, values)])
    attributes.insert(dice.randrange(len(attributes) + 1), made)


def attribute_value(root: Node, _: Original, dice: random.Random) -> None:
    values = dice.choice(_info(root).children[3].children).children[1]
    values.children.insert(dice.randrange(2), raw(dice.choice(VALUES)))
    if dice.random() < 0.5:
        values.children.pop()


def unsigned_attribute(root: Node, _: Original, dice: random.Random) -> None:
    values = [raw(dice.choice(VALUES))]
    made = value(0x30, [value(6, dice.choice(OIDS)), value(0x31, values)])
    _info(root).children.append(value(0xA1, dice.choice(([made], [], [raw(dice.choice(VALUES))]))))


def no_attributes(root: Node, _: Original, dice: random.Random) -> None:
    info = _info(root)
    info.children = [each for each in info.children if each.tag != 0xA0]


def no_certificates(root: Node, _: Original, dice: random.Random) -> None:
    fields = _signed_data(root)
    fields.children = [each for each in fields.children if each.tag != 0xA0]


def certificate(root: Node, original: Original, dice: random.Random) -> None:
    """Put another certificate before, behind, or in place of that of the signer."""
    bag = next(each for each in _signed_data(root).children if each.tag == 0xA0)
    made = Node.read(dice.choice(original.others).public_bytes(Encoding.DER))[0]
    if dice.random() < 0.3:
        made = dice.choice((raw(dice.choice(VALUES)), value(0xA1, made.children)))
    bag.children.insert(dice.randrange(len(bag.children) + 1), made)
    if dice.random() < 0.2:
        bag.children.pop()


def damaged_certificate(root: Node, _: Original, dice: random.Random) -> None:
    bag = next(each for each in _signed_data(root).children if each.tag == 0xA0)
    copy = Node.read(bag.children[0].write())[0]
    node = dice.choice(copy.below())
    if node.content:
        content = bytearray(node.content)
        content[dice.randrange(len(content))] = dice.randrange(256)
        node.content = bytes(content)
    else:
        del node.children[dice.randrange(len(node.children))]
    bag.children.insert(dice.randrange(len(bag.children) + 1), copy)


def revocation_lists(root: Node, _: Original, dice: random.Random) -> None:
    fields = _signed_data(root).children
    fields.insert(len(fields) - dice.choice((1, 1, 2)), value(0xA1, [raw(dice.choice(VALUES))]))


def no_revocation_lists(root: Node, _: Original, dice: random.Random) -> None:
    fields = _signed_data(root).children
    fields.insert(len(fields) - 1, value(dice.choice((0xA1, 0xA0)), []))


def second_signer(root: Node, _: Original, dice: random.Random) -> None:
    infos = _signed_data(root).children[-1].children
    copy = Node.read(infos[0].write())[0]
    if dice.random() < 0.7:
        octets = next(each for each in copy.children[4:] if each.tag == 4)
        octets.content = octets.content[:-1] + b"x"
    infos.insert(dice.randrange(2), copy)


def no_signers(root: Node, _: Original, dice: random.Random) -> None:
    _signed_data(root).children[-1].children = []


def contained(root: Node, _: Original, dice: random.Random) -> None:
    """Put a content into the signature, next to the one of the MIME part, or take it out."""
    holder = _signed_data(root).children[2]
    if len(holder.children) > 1:
        holder.children.pop()
    else:
        text = dice.choice((b"", b"Content-Type: text/plain\r\n\r\n<other/>"))
        holder.children.append(value(dice.choice((0xA0, 0xA0, 0xA1)), [value(4, text)]))


def signature_value(root: Node, _: Original, dice: random.Random) -> None:
    octets = next(each for each in _info(root).children[4:] if each.tag == 4)
    octets.content = dice.choice((
        b"", octets.content + b"\0", b"\0" + octets.content, octets.content[:-1],
        octets.content[::-1], b"\x30\x06\x02\x01\x00\x02\x01\x00",
    ))  # fmt: skip


CMS: tuple[AlterCms, ...] = (
    drop, double, swap, insert, replace, retag, other_oid, other_algorithm, parameters,
    more_digests, number, byte, ber, in_pieces, trailing, attribute, attribute_value,
    unsigned_attribute, no_attributes, no_certificates, certificate, damaged_certificate,
    revocation_lists, no_revocation_lists, second_signer, no_signers, contained, signature_value,
)  # fmt: skip


# ── what is altered in the MIME ────────────────────────────────────────────────────────────


def _a_line(
    message: bytes, dice: random.Random, change: Callable[[bytes], bytes], fits: bytes = b""
) -> bytes:
    """Change one line of the message, with its end, among those that have ``fits``."""
    lines = message.splitlines(keepends=True)
    places = [number for number, line in enumerate(lines) if fits.lower() in line.lower()]
    if places:
        # The headers and boundaries are few among the lines.
        short = [each for each in places if b":" in lines[each] or lines[each][:2] == b"--"]
        place = dice.choice(dice.choice((places, short)) or places)
        lines[place] = change(lines[place])
    return b"".join(lines)


def line_end(message: bytes, dice: random.Random) -> bytes:
    end = dice.choice(
        (
            b"\n",
            b"\r\n",
            b"\r",
            b"\r\r\n",
            b"\n\n",
            b" \r\n",
            b"\t\n",
            b"\0\r\n",
            b"\x0b\n",
            b"\x0c\n",
            b"",
        )
    )
    return _a_line(message, dice, lambda line: line.rstrip(b"\r\n") + end)


def line_ends(message: bytes, dice: random.Random) -> bytes:
    end = dice.choice((b"\n", b"\n", b"\r", b"\r\r\n"))
    return message.replace(b"\r\n", end)


HEADERS = (
    b"Content-Type: text/plain", b"Content-Type: text/html", b"content-type: text/plain",
    b"Content-Type: multipart/signed; boundary=x", b"Content-Type: application/pkcs7-mime",
    b"Content-Type: application/x-pkcs7-signature", b"Content-Type:", b"Content-Type",
    b"Content-Type : text/plain", b"Content-Transfer-Encoding: base64",
    b"Content-Transfer-Encoding: quoted-printable", b"Content-Transfer-Encoding: 8bit",
    b"Content-Transfer-Encoding: binary", b"MIME-Version: 2.0", b"X: (comment", b'X: "open',
    b"X: y;z",
    b"X: " + b"y" * 1100, b"X: " + b"y" * 1020 + b"Content-Type: text/plain", b"X", b":", b": y",
    b"",
    b" continued", b"\tboundary=x", b"X: \xff\xfe", b"(X): y", b"X:y", b"To: a@b, \"c\" <d@e>",
)  # fmt: skip


def header(message: bytes, dice: random.Random) -> bytes:
    made = dice.choice(HEADERS) + dice.choice((b"\r\n", b"\n"))
    return _a_line(message, dice, lambda line: dice.choice((made + line, line + made)), b"-")


def header_name(message: bytes, dice: random.Random) -> bytes:
    def change(line: bytes) -> bytes:
        name, colon, rest = line.partition(b":")
        return dice.choice((
            name.upper() + colon + rest, name.lower() + colon + rest, name + b" " + colon + rest,
            b" " + line, name + colon + colon + rest, name + rest, name + colon + rest.lstrip(b" "),
            name + colon + b"  \t" + rest, name + b"(x)" + colon + rest,
            b'"' + name + b'"' + colon + rest,
            name.replace(b"-", b"_") + colon + rest, line + line, name + colon + b" (x)" + rest,
        ))  # fmt: skip

    return _a_line(message, dice, change, b": ")


def header_value(message: bytes, dice: random.Random) -> bytes:
    old, new = dice.choice((
        (b"; ", b";"), (b"; ", b";\r\n\t"), (b"; ", b";\n "), (b"; ", b" ;"), (b"; ", b"\r\n ;"),
        (b"; ", b"; (x) "), (b"; ", b"; x=y; "), (b"; ", b"; ; "), (b"; ", b", "),
        (b"; ", b'; x="a;b"; '), (b"; ", b"; x=a(b); "), (b"; ", b'; x="a(b"; '),
        (b"; ", b"; boundary=x; "), (b"; ", b'; boundary=""; '), (b"; ", b"; Boundary=x; "),
        (b'"\r\n', b'";\r\n'), (b'"\r\n', b'"; boundary=x\r\n'), (b'"\r\n', b'" (x)\r\n'),
        (b'"\r\n', b"\r\n"), (b'"\r\n', b'" \r\n'), (b'="', b'=" '), (b'="', b'= "'),
        (b'="', b'=""'),
        (b'="', b'="\\'), (b'boundary="', b"boundary='"), (b"signed", b"SIGNED"),
        (b"signed", b"mixed"),
        (b"/x-", b"/"), (b"text/plain", b"text/plain; charset=utf-8"),
        (b"text/plain", b"TEXT/plain"),
        (b"text/plain", b"text/plain;"), (b"text/plain", b"text/plain (x)"),
        (b"text/plain", b"text/plainx"), (b"text/plain", b'"text/plain"'),
        (b"text/plain", b"text / plain"), (b"text/plain", b"text/plain\x0b"),
        (b"protocol", b"boundary"), (b'x-pkcs7-signature"', b'x"'), (b"sha-256", b"md5"),
    ))  # fmt: skip
    at = [found.start() for found in re.finditer(re.escape(old), message)]
    if not at:
        return message
    place = dice.choice(at)
    return message[:place] + new + message[place + len(old) :]


def _boundary(message: bytes) -> bytes:
    found = re.search(rb'(?i)boundary="?([^"\r\n;]+)', message)
    return found[1] if found else b"x"


def boundary_line(message: bytes, dice: random.Random) -> bytes:
    mark = b"--" + _boundary(message)

    def change(line: bytes) -> bytes:
        return dice.choice((
            line + line, b"", b" " + line, line.rstrip() + b" \r\n", line.rstrip() + b"x\r\n",
            line.rstrip() + b"--\r\n", mark + b"\r\n", mark + b"--\r\n", mark + b"--x\r\n",
            b"-" + line, line[1:], line.upper(), line.lower(), line.rstrip() + b"\t\r\n",
            b"\r\n" + line, line + b"\r\n", b"\r" + line, mark + b"-\r\n", line.rstrip(),
        ))  # fmt: skip

    return _a_line(message, dice, change, mark)


def boundary_within(message: bytes, dice: random.Random) -> bytes:
    """Put a boundary somewhere else: also where OpenSSL cuts long lines."""
    mark = b"--" + _boundary(message) + dice.choice((b"", b"--", b"x", b" "))
    made = dice.choice((
        mark + b"\r\n", b"x" + mark + b"\r\n", b"y" * 1023 + mark + b"\r\n",
        b"y" * 1022 + mark + b"\r\n", b"y" * 1024 + mark + b"\r\n", b"\0" + mark + b"\r\n",
        b"y" * 2046 + mark + b"\r\n", mark + b"\n", b"\r" + mark + b"\r",
    ))  # fmt: skip
    return _a_line(message, dice, lambda line: made + line)


def other_boundary(message: bytes, dice: random.Random) -> bytes:
    old = _boundary(message)
    new = dice.choice((
        b"x", b"-", b"--", b"a b", b"a ", b" a", b"a(b", b"a;b", b"a=b", b"a\\b", b"a'b",
        b"x" * 300,
        b"(a)", b"a/b:c?d", b"\xe9", b"", old.lower(), b'a"b', b"y" * 1030,
    ))  # fmt: skip
    return message.replace(old, new)


def preamble(message: bytes, dice: random.Random) -> bytes:
    made = dice.choice(
        (b"\r\n", b"\xef\xbb\xbf", b" ", b"\n\n", b"From x\r\n", b"\0", b"\r", b"-\r\n")
    )
    return dice.choice(
        (made + message, message + made, message.replace(b"This is", made + b"This is"))
    )


def part(message: bytes, dice: random.Random) -> bytes:
    """Double, drop or swap the parts."""
    mark = b"--" + _boundary(message)
    head, *parts = message.split(mark)
    if len(parts) < 2:
        return message
    tail = parts.pop()
    made = list(parts)
    how = dice.randrange(4)
    if how == 0:
        made.insert(dice.randrange(len(made) + 1), dice.choice(parts))
    elif how == 1:
        del made[dice.randrange(len(made))]
    elif how == 2:
        made.reverse()
    else:
        made.insert(dice.randrange(len(made) + 1), b"\r\n\r\n<other/>\r\n")
    return mark.join((head, *made, tail))


def base64_line(message: bytes, dice: random.Random) -> bytes:
    def change(line: bytes) -> bytes:
        text, place = line.rstrip(), dice.randrange(1, 40)
        return dice.choice((
            text[:place] + b"\r\n" + text[place:] + b"\r\n", text + b" \r\n", b" " + line, text,
            text[:place] + b" " + text[place:] + b"\r\n",
            text[:place] + b"=" + text[place:] + b"\r\n",
            text[:place] + b"-" + text[place:] + b"\r\n",
            text[:place] + b"_" + text[place:] + b"\r\n",
            text + b"=\r\n", text + b"==\r\n", b"\r\n" + line, b"!!!!\r\n" + line,
            line + b"====\r\n",
            text[:60] + b"\r\n" + text[60:] + b"\r\n", line + b"AAAA\r\n", b"-" + line,
            b"--\r\n" + line,
            text.rstrip(b"=") + b"\r\n", text[:place] + b"\0" + text[place:] + b"\r\n",
        ))  # fmt: skip

    lines = [
        line for line in message.splitlines() if re.fullmatch(rb"[A-Za-z0-9+/]{8,}={0,2}", line)
    ]
    if not lines:
        return message
    line = dice.choice((lines[0], lines[-1], dice.choice(lines)))
    return message.replace(line, change(line + b"\r\n").removesuffix(b"\r\n"), 1)


def base64_width(message: bytes, dice: random.Random) -> bytes:
    found = re.search(rb"(?:[A-Za-z0-9+/]{60,}\r?\n)+[A-Za-z0-9+/]+={0,2}", message)
    if not found:
        return message
    text, wide = (
        re.sub(rb"\s", b"", found[0]),
        dice.choice((1, 2, 3, 4, 60, 72, 76, 80, 100, 1000, 5000)),
    )
    made = b"\r\n".join(text[at : at + wide] for at in range(0, len(text), wide))
    return message[: found.start()] + made + message[found.end() :]


def content_line(message: bytes, dice: random.Random) -> bytes:
    made = dice.choice((
        b"<other/>\r\n", b" ", b"\0", b"\x1a", b"y" * 1023, b"y" * 1024 + b"\r\n", b"\r", b"\t",
        b"\xff",
    ))  # fmt: skip
    return _a_line(message, dice, lambda line: dice.choice((made + line, line + made)), b"<")


def any_byte(message: bytes, dice: random.Random) -> bytes:
    place = dice.randrange(len(message) + 1)
    made = dice.choice(
        (b"\r", b"\n", b"\0", b"-", b" ", b"A", b"=", b";", b'"', bytes([dice.randrange(256)]))
    )
    return message[:place] + made + message[place + dice.randrange(3) :]


MIME: tuple[AlterMime, ...] = (
    line_end, line_ends, header, header, header_name, header_value, header_value, boundary_line,
    boundary_within, other_boundary, preamble, part, base64_line, base64_width, content_line,
    any_byte,
)  # fmt: skip


# ── what OpenSSL says ──────────────────────────────────────────────────────────────────────


class Libcrypto:
    """``openssl smime -verify -text -CAfile`` without a process: the same calls of libcrypto."""

    _TEXT, _INFO = 1, 3

    def __init__(self, place: Path) -> None:
        self._file = place / "forged.p7s"
        self._library = library = ctypes.CDLL("libcrypto.so.3")
        pointer = ctypes.c_void_p
        for name in (
            "X509_STORE_new",
            "BIO_new_file",
            "BIO_new_mem_buf",
            "SMIME_read_PKCS7",
            "BIO_new",
            "BIO_s_mem",
        ):
            getattr(library, name).restype = pointer
        library.PKCS7_verify.argtypes = [*[pointer] * 5, ctypes.c_int]
        library.BIO_ctrl.argtypes = [pointer, ctypes.c_int, ctypes.c_long, pointer]
        library.BIO_ctrl.restype = ctypes.c_long
        library.SMIME_read_PKCS7.argtypes = [pointer, pointer]
        library.BIO_new.argtypes = library.BIO_free.argtypes = library.PKCS7_free.argtypes = [
            pointer
        ]
        library.X509_STORE_load_locations.argtypes = [pointer, ctypes.c_char_p, ctypes.c_char_p]
        self._stores: dict[Path, int] = {}

    def verdict(self, message: bytes, authority: Path) -> bytes | None:
        """Return the document if OpenSSL accepts the message from a file and from memory."""
        self._file.write_bytes(message)
        library = self._library
        found = [
            self._verify(library.BIO_new_file(str(self._file).encode(), b"r"), authority),
            self._verify(library.BIO_new_mem_buf(message, len(message)), authority),
        ]
        return found[0] if found[0] == found[1] else None

    def _verify(self, source: int, authority: Path) -> bytes | None:
        library, content = self._library, ctypes.c_void_p()
        out = library.BIO_new(library.BIO_s_mem())
        read = library.SMIME_read_PKCS7(source, ctypes.byref(content))
        try:
            store = self._store(authority)
            if not read or not library.PKCS7_verify(read, None, store, content, out, self._TEXT):
                return None
            text = ctypes.c_void_p()
            size = library.BIO_ctrl(out, self._INFO, 0, ctypes.byref(text))
            return ctypes.string_at(text, size) if size else b""
        finally:
            library.PKCS7_free(read)
            for each in (source, out, content):
                library.BIO_free(each)
            library.ERR_clear_error()

    def _store(self, authority: Path) -> int:
        if authority not in self._stores:
            store = self._library.X509_STORE_new()
            assert self._library.X509_STORE_load_locations(store, str(authority).encode(), None)
            self._stores[authority] = store
        return self._stores[authority]
