"""Writes a policy as SROS2 policy XML 0.2.0, in one file without includes."""

from __future__ import annotations

from lxml import etree

from sros_tool.policy.model import Policy, Profile
from sros_tool.xml import parse, serialize


def write_policy(policy: Policy) -> bytes:
    """The policy as XML in UTF-8; `read_policy` gives the same value back."""
    root = etree.Element("policy", version=policy.version)
    enclaves = etree.SubElement(root, "enclaves")
    metadata: list[tuple[etree._Element, str]] = []
    for enclave in policy.enclaves:
        element = etree.SubElement(enclaves, "enclave", path=enclave.path)
        for block in enclave.profiles:
            profiles = etree.SubElement(element, "profiles")
            if block.type:
                profiles.set("type", block.type)
            for profile in block.profiles:
                _write_profile(profiles, profile)
            if block.metadata:
                metadata.append((profiles, block.metadata))
    etree.indent(root, space="  ")
    for profiles, text in metadata:  # after the indentation, which would change what it holds
        last, element = profiles[-1], parse(text.encode(), "metadata")
        last.tail, element.tail = profiles.text, last.tail
        profiles.append(element)
    return serialize(root, indent=False)


def _write_profile(parent: etree._Element, profile: Profile) -> None:
    element = etree.SubElement(parent, "profile", ns=profile.ns, node=profile.node)
    for group in profile.groups:
        child = etree.SubElement(element, group.kind)
        for right, qualifier in group.rights:
            child.set(right, qualifier)
        for name in group.names:
            etree.SubElement(child, group.kind.removesuffix("s")).text = name
