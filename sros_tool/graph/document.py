"""The text of a learned policy: a new file, or its new profiles within an existing one.

Names need no escaping: what is learned are plain ROS names, of which nothing is markup.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import groupby
from pathlib import Path

from sros_tool.graph.learn import LearnedProfile
from sros_tool.names import check_namespace
from sros_tool.policy.model import VERSION
from sros_tool.policy.reader import read_policy
from sros_tool.policy.rights import Rules, policy_rights
from sros_tool.policy.text import Element, Text

XINCLUDE = "http://www.w3.org/2001/XInclude"
_UNIT = "  "
_HEADER = """\
<?xml version="1.0" encoding="UTF-8"?>
<!-- What the robot was seen to do, or what it was denied, by sros generate_policy. Read it before
     you enforce it: what was not seen is not allowed, and what was seen need not be meant. -->
"""


def render(profiles: Iterable[LearnedProfile]) -> bytes:
    """A policy file with these profiles, which come sorted; always the same for the same ones."""
    profiles = tuple(profiles)
    declared = f' xmlns:xi="{XINCLUDE}"' if any(each.includes for each in profiles) else ""
    lines = [f'<policy version="{VERSION}"{declared}>', "  <enclaves>"]
    for path, found in groupby(profiles, key=lambda each: each.enclave):
        lines += [f'    <enclave path="{path}">', "      <profiles>"]
        for each in found:
            lines.append(f'        <profile ns="{each.ns}" node="{each.node}">')
            lines += [f"          {line}" for line in _content(each, "xi:include", _UNIT)]
            lines.append("        </profile>")
        lines += ["      </profiles>", "    </enclave>"]
    lines += ["  </enclaves>", "</policy>", ""]
    return (_HEADER + "\n".join(lines)).encode()


def _content(profile: LearnedProfile, include: str, unit: str) -> Iterator[str]:
    """The lines of a profile's content; ``include`` is the start of the tag of an include."""
    yield from _includes(profile, include)
    for group in profile.groups:
        item = group.kind.removesuffix("s")
        rights = "".join(f' {right}="{said}"' for right, said in group.rights)
        yield f"<{group.kind}{rights}>"
        yield from (f"{unit}<{item}>{name}</{item}>" for name in group.names)
        yield f"</{group.kind}>"


def _includes(profile: LearnedProfile, include: str) -> Iterator[str]:
    for part in profile.includes:
        yield f'<{include} href="{part}" xpointer="xpointer(/profile/*)"/>'


def with_includes(
    path: Path, before: bytes, merged: bytes, profiles: Iterable[LearnedProfile]
) -> tuple[bytes, tuple[str, ...]]:
    """``merged`` (the file ``before`` with learned rights), its new profiles with their includes.

    Also tells what is now included.  A profile of which the policy denies something stays as the
    merge left it; one that ``before`` had gets its includes in front of what it says.
    """
    name = f"the policy file '{path}'"
    known = _profiles(Text(before, name))
    text = Text(merged, name)
    rules = Rules(policy_rights(read_policy(path, merged)))
    wanted = {(each.enclave, each.ns, each.node): each for each in profiles if each.includes}
    included: set[str] = set()
    for place, element in _profiles(text).items():
        profile = wanted.get(place)
        if profile is None:
            continue
        if place in known:
            text.put(element.inner, _in_front(profile, element, text))
        elif all(rules.allow(profile.enclave, each.right, each.name) for each in profile.rights):
            text.put(element.inner, _inside(profile, element, text), element.close)
        else:
            continue
        included.update(profile.includes)
    if included and _prefix(text) is None:
        text.put(text.root.inner - len(">"), f' xmlns:xi="{XINCLUDE}"')
    return text.document(), tuple(sorted(included))


def _profiles(text: Text) -> dict[tuple[str, str, str], Element]:
    return {
        (enclave.get("path"), check_namespace(profile.get("ns")), profile.get("node")): profile
        for block in text.root.named("enclaves")
        for enclave in block.named("enclave")
        for profiles in enclave.named("profiles")
        for profile in profiles.named("profile")
    }


def profiles_of(path: Path, document: bytes) -> frozenset[tuple[str, str, str]]:
    """The enclave, namespace and node of each profile that stands in the file itself."""
    return frozenset(_profiles(Text(document, f"the policy file '{path}'")))


def _in_front(profile: LearnedProfile, element: Element, text: Text) -> str:
    """The includes of a profile as text, to stand before its content."""
    include = f"{_prefix(text) or 'xi'}:include"
    outer = text.indent_of(element)
    lead = "" if outer is None else text.newline + outer + text.unit
    return "".join(lead + line for line in _includes(profile, include))


def _inside(profile: LearnedProfile, element: Element, text: Text) -> str:
    """The content of a profile as text, indented as its neighbours are."""
    include = f"{_prefix(text) or 'xi'}:include"
    outer = text.indent_of(element)
    if outer is None:
        return "".join(_content(profile, include, ""))
    lines = [text.unit + line for line in _content(profile, include, text.unit)]
    return "".join(text.newline + outer + line for line in (*lines, ""))


def _prefix(text: Text) -> str | None:
    """What the document calls the namespace of includes; None if it does not, and xi is free."""
    return next((p for p, uri in text.root.xml.nsmap.items() if p and uri == XINCLUDE), None)
