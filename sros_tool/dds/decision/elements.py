"""XML as the parsers of the vendors see it: comments, blanks and prefixes in their places."""

from __future__ import annotations

from collections.abc import Iterator

from lxml import etree

from sros_tool.dds.decision.answers import Outcome, Refusal


class UnreadableError(Exception):
    """The vendor does not accept the document; ``outcome`` says whether it crashes over it."""

    def __init__(self, text: str, outcome: Outcome = Outcome.REFUSED) -> None:
        super().__init__(text)
        self.outcome = outcome

    def refusal(self, title: str, document: str) -> Refusal:
        """The same as a value; ``title`` names the vendor."""
        how = "crashes over" if self.outcome is Outcome.CRASHES else "refuses"
        return Refusal("malformed", f"{title} {how} the {document}: {self}.", self.outcome)


def root_of(xml: bytes) -> etree._Element:
    """The root with its comments; raises `UnreadableError` if it is no well-formed XML.

    The vendors let blanks stand before the XML declaration.
    """
    parser = etree.XMLParser(
        remove_pis=True, resolve_entities=False, no_network=True, load_dtd=False, huge_tree=False
    )
    try:
        root: etree._Element = etree.fromstring(xml.lstrip(), parser)
    except (etree.XMLSyntaxError, ValueError) as error:
        raise UnreadableError(f"it is not well-formed XML ({error})") from error
    return root


def name_of(element: etree._Element) -> str:
    """The name as it is written, with its prefix."""
    local = etree.QName(element).localname
    return f"{element.prefix}:{local}" if element.prefix else local


def elements_of(element: etree._Element) -> list[etree._Element]:
    """The child elements."""
    return [child for child in element if isinstance(child.tag, str)]


def texts_of(element: etree._Element) -> Iterator[str]:
    """The pieces of character data directly in ``element``, in order."""
    if element.text:
        yield element.text
    for child in element:
        if child.tail:
            yield child.tail


def attributes_of(element: etree._Element) -> Iterator[str]:
    """The names of its attributes as they are written, declarations of namespaces among them."""
    parent = element.getparent()
    inherited = {} if parent is None else parent.nsmap
    for prefix, address in element.nsmap.items():
        if inherited.get(prefix) != address:
            yield f"xmlns:{prefix}" if prefix else "xmlns"
    prefixes = {address: prefix for prefix, address in element.nsmap.items()}
    for key in element.attrib:
        name = etree.QName(str(key))
        prefix = prefixes.get(name.namespace) if name.namespace else None
        yield f"{prefix}:{name.localname}" if prefix else name.localname
