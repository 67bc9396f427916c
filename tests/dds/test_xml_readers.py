"""What the XML parsers of Fast DDS and Cyclone DDS find in a text, well-formed or not."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from sros_tool.dds.decision import cyclone as cyclone_xml
from sros_tool.dds.decision import fastdds
from sros_tool.dds.decision.elements import NodeMark, UnreadableError, XmlElement

REFUSED = None

TABLE = [
    # the content of <a>, what TinyXML-2 finds in it, what Cyclone DDS does
    ("x", ["x"], ["x"]),
    (" x ", [" x "], ["x"]),
    ("<!-- -- -->x", [NodeMark.COMMENT, "x"], ["x"]),
    ("x<!-- c -->y", ["x", NodeMark.COMMENT, "y"], ["xy"]),
    ("\n<![CDATA[x]]>", ["x"], ["x"]),
    ("x<![CDATA[<y>]]>", ["x", "<y>"], ["x<y>"]),
    ("<![CDATA[x]]><![CDATA[y]]>", ["x", "y"], REFUSED),
    ("x]]>", ["x]]>"], ["x]]>"]),
    ("x&y", ["x&y"], REFUSED),
    ("&x;", ["&x;"], REFUSED),
    ("&lt;&#65;&#x42;", ["<AB"], ["<AB"]),
    ("x&#0;y", ["x"], ["x"]),
    ("x\x01", ["x\x01"], ["x\x01"]),
    ("x\r\ny\rz", ["x\ny\nz"], ["x\r\ny\rz"]),
    ("\n&x", ["\n\nx"], REFUSED),  # it writes into what it reads, and of & nothing
    ("<?pi?>x", REFUSED, REFUSED),
    ("x<?pi?>", REFUSED, ["x"]),
    ("<!x>y", [NodeMark.OTHER, "y"], REFUSED),
    ("<b/>x", [XmlElement("b"), "x"], REFUSED),
    ("<b/> ", [XmlElement("b")], [XmlElement("b")]),
    ("< b/>", [XmlElement("b")], REFUSED),
    ("<b></b >", [XmlElement("b")], REFUSED),
    ("<b c='1' c='2'/>", REFUSED, [XmlElement("b", {"c": "2"})]),
    ("<b c='<&lt;'/>", [XmlElement("b", {"c": "<<"})], [XmlElement("b", {"c": "<<"})]),
    ("<d:b/>", [XmlElement("d:b")], [XmlElement("d:b")]),
    ("<_b/>", [XmlElement("_b")], REFUSED),
    ("<b></c>", REFUSED, REFUSED),
    ('"x', ['"x'], REFUSED),
]
READERS = {"Fast DDS": fastdds.read, "Cyclone DDS": cyclone_xml.read}


def content(
    read: Callable[[bytes], XmlElement], xml: str
) -> list[XmlElement | str | NodeMark] | None:
    try:
        return read(xml.encode()).children
    except UnreadableError:
        return REFUSED


@pytest.mark.parametrize(("text", "fast", "cyclone"), TABLE)
def test_content(text: str, fast: object, cyclone: object) -> None:
    # Behind a comment Cyclone DDS looks for text only where seven characters are left.
    xml = f"<a>{text}</a>\n\n\n\n"
    assert content(fastdds.read, xml) == fast
    assert content(cyclone_xml.read, xml) == cyclone


@pytest.mark.parametrize(
    ("xml", "fast", "cyclone"),
    [
        ("", False, False),
        ("<a/>", True, True),
        ("\ufeff<a/>", True, False),
        (" \n<?xml?><a/>", True, True),
        ("<?xml?><?pi?><a/>", True, True),
        ("<!-- c --><?xml?><a/>", False, True),
        ("<a/><b/>", True, False),
        ("<a/>x", False, False),
        ("x<a/>", True, False),
        ("<a></a></b> and more", True, False),
        ("<a></a/></a>", True, False),
        ("<a>", False, False),
        ("<a", False, False),
        ("<a x>", False, False),
        ("<!DOCTYPE a><a/>", True, True),
        ("<!DOCTYPE a [<!ENTITY b 'c'>]><a/>", True, False),
        ("<a/>\0x", True, True),
        ("<a>" * 98 + "</a>" * 98, True, True),
        ("<a>" * 99 + "</a>" * 99, False, True),
        ("<a>" * 5000 + "</a>" * 5000, False, False),
    ],
)
def test_documents(xml: str, fast: bool, cyclone: bool) -> None:
    assert (content(fastdds.read, xml) is not REFUSED) == fast
    assert (content(cyclone_xml.read, xml) is not REFUSED) == cyclone


@pytest.mark.parametrize("read", READERS.values(), ids=READERS)
def test_bytes_that_are_no_utf_8_stay_apart(read: Callable[[bytes], XmlElement]) -> None:
    assert read("<a>ö</a>".encode()).children == ["ö"]
    assert read(b"<a>\xff</a>").children == ["\udcff"]
