"""Checks for topics in permissions that no ROS topic, service or action can have."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache

from sros_tool.checks.keystores.opened import CheckedEnclave
from sros_tool.checks.kind import NOTE, WARNING, Finding, FindingKind, names_text
from sros_tool.dds.permissions import Criteria, Grant
from sros_tool.names import ROS_DISCOVERY_TOPIC, is_expression
from sros_tool.policy.patterns import overlap
from sros_tool.wording import first_few

_MAPPING_SOURCE = 'ROS 2 design "Topic and Service name mapping to DDS"; rmw_dds_common; tested.'

NO_ROS_NAME = FindingKind(
    "permissions.no-ros-name",
    WARNING,
    "names that no ROS topic, service or action has",
    "The DDS names of ROS topics begin with rt/, and the DDS names of services with rq/ and rr/. A "
    "rule with another name matches no endpoint of a node: access that the rule should allow is "
    "denied, and access that it should deny may be allowed.",
    _MAPPING_SOURCE,
    "Write the DDS name, such as rt/chatter, rq/addRequest and rr/addReply, or let sros write it: "
    "`sros create_permission KEYSTORE ENCLAVE POLICY_FILE`. The current name is right only for a "
    "program that uses DDS without ROS.",
)
NOT_FOR_ROS = FindingKind(
    "permissions.not-for-ros",
    NOTE,
    "permissions without any ROS 2 name",
    "No ROS 2 node can run in this enclave: a node needs ros_discovery_info, and DDS names that "
    "begin with rt/ (topics) or with rq/ and rr/ (services).",
    _MAPPING_SOURCE,
    "Nothing to do if a program uses DDS without ROS. Otherwise give the enclave a policy: `sros "
    "create_permission KEYSTORE ENCLAVE POLICY_FILE`.",
    prominent=True,
)
RELAY_ONLY = FindingKind(
    "permissions.relay-only",
    WARNING,
    "topics that only <relay> allows",
    "No RMW relays data: a node publishes and subscribes, which the permissions deny.",
    "DDS-Security 1.1, 9.4.1.3.2.3; tested.",
    "Write the topics into <publish> or <subscribe>.",
)
CAPITALS = FindingKind(
    "permissions.only-capitals-differ",
    WARNING,
    "two names that differ only in capitals",
    "The two names are two topics: nodes on one topic do not communicate with nodes on the other.",
    _MAPPING_SOURCE,
    "If one topic is meant, write its name in the same way in the permissions of all enclaves.",
)

_PREFIXES = ("ra", "rp", "rq", "rr", "rs", "rt")
_ROS_TOPICS = (ROS_DISCOVERY_TOPIC, "rq/*Request", "rr/*Reply", "ra/*", "rp/*", "rs/*", "rt/*")
_SERVICE_SUFFIXES = {"rq/": "Request", "rr/": "Reply"}
_TOKENS = r"(?:/[A-Za-z_][A-Za-z0-9_]*)+"
_ROS_NAME = re.compile(
    rf"(?:r[apst]{_TOKENS}|rq{_TOKENS}(?<=Request)|rr{_TOKENS}(?<=Reply)|{ROS_DISCOVERY_TOPIC})\Z"
)
_BUILT_IN_TOPIC = re.compile(r"DCPS[A-Z]\w*\Z")
"""Built-in topics of DDS, which need no right but appear in some permissions."""
_ROS_TYPE = re.compile(r"[a-z][a-z0-9_]*/(?:msg|srv|action)/[A-Z][A-Za-z0-9]*\Z")
_WILDCARD = re.compile(r"\[[^\]]*\]|[*?]")
_INVALID_CHARACTER = re.compile(r"[^A-Za-z0-9_/]")
_MOST_SHOWN = 3


def check_topic_names(enclave: CheckedEnclave, grant: Grant, file: str) -> Iterator[Finding]:
    """Yield findings about topic names in the rules of a grant."""
    if not is_for_ros(grant):
        names = [repr(topic) for topic in dict.fromkeys(_rule_topics(grant, allow=True))]
        yield NOT_FOR_ROS.found(enclave.name, f"they name only {names_text(names)}", file)
        return
    named = dict.fromkeys((*_rule_topics(grant, allow=True), *_rule_topics(grant, allow=False)))
    problems = [text for name in named if (text := ros_name_problem(name))]
    if problems:
        text = first_few(problems, _MOST_SHOWN, "; ", "; and ")
        yield NO_ROS_NAME.found(enclave.name, text, file)
    relayed = {topic for rule in grant.rules for topic in _topics(rule.relay) if rule.allow}
    if relayed and (only := sorted(relayed.difference(_rule_topics(grant, allow=True)))):
        text = f"{names_text(only)} {'is' if len(only) == 1 else 'are'} allowed only in <relay>"
        yield RELAY_ONLY.found(enclave.name, text, file)


def check_capitals(enclaves: Mapping[str, frozenset[str]]) -> Iterator[Finding]:
    """Yield a finding for topic names in a robot's enclaves that differ only in capitals.

    ``enclaves`` maps each enclave to its `names_without_wildcards`.
    """
    spelled: dict[str, dict[str, str]] = {}
    for enclave, names in sorted(enclaves.items()):
        for name in sorted(names):
            spelled.setdefault(name.lower(), {}).setdefault(name, enclave)
    for spellings in spelled.values():
        if len(spellings) > 1:
            text = " and ".join(f"{name} (in {enclave})" for name, enclave in spellings.items())
            yield CAPITALS.found(next(iter(spellings.values())), f"{text} differ only in capitals")


def names_without_wildcards(grant: Grant) -> frozenset[str]:
    """Return the topics that the rules of a grant allow by name, without wildcards."""
    return frozenset(topic for topic in _rule_topics(grant, allow=True) if not is_expression(topic))


def is_for_ros(grant: Grant) -> bool:
    """Return whether a grant allows a ROS name, or has no allow rule with a name at all."""
    named = tuple(_rule_topics(grant, allow=True))
    return not named or any(
        overlap(wanted, name.strip())
        for name in named
        for wanted in (ROS_DISCOVERY_TOPIC, *(f"{prefix}/*" for prefix in _PREFIXES))
    )


@lru_cache(maxsize=8192)
def ros_name_problem(text: str) -> str:
    """Return a clause on why the expression ``text`` matches no ROS name; "" if it matches one.

    Blanks around the text are ignored.
    """
    name = text.strip()
    if not name or _ROS_NAME.match(name) or _BUILT_IN_TOPIC.match(name):
        return ""
    if has_invalid_characters(name):
        return _character_problem(name)
    if is_expression(name):
        possible = "//" not in name and any(overlap(name, known) for known in _ROS_TOPICS)
        return "" if possible else f"{name!r} matches no valid ROS name{_intended_name_hint(name)}"
    if _ROS_TYPE.match(name):
        return f"{name!r} is the name of a type: write the name of the topic"
    return f"{name!r} is not a valid ROS name{_intended_name_hint(name)}"


def has_invalid_characters(name: str) -> bool:
    """Return whether an expression has characters outside [sets] that no ROS name can have."""
    return bool(_INVALID_CHARACTER.search(_WILDCARD.sub("", name.strip())))


def _character_problem(name: str) -> str:
    letters = dict.fromkeys(_INVALID_CHARACTER.findall(_WILDCARD.sub("", name)))
    shown = " ".join("a blank" if letter.isspace() else letter for letter in letters)
    advice = ""
    if "{" in name or "$(" in name:
        advice = ": write the value in place of the placeholder"
    elif "," in letters or ";" in letters or any(map(str.isspace, letters)):
        advice = ": write a <topic> for every name"
    elif "~" in letters:
        advice = ": write the name of the node in place of ~"
    elif "\\" in letters:
        advice = f": write {name.replace(chr(92), '/')}"
    elif ".*" in name:
        advice = f": write {name.replace('.*', '*')}"
    elif "%" in letters:
        advice = f": write {name.replace('%', '*')}"
    return f"{name!r} has characters that no ROS name has ({shown}){advice}"


def _intended_name_hint(name: str) -> str:
    """Return a hint with the probably intended name, such as ``: write rt/chatter``, or ""."""
    begin, slash, rest = name.partition("/")
    parts = [part for part in (rest if begin in _PREFIXES else name).split("/") if part]
    prefix = begin if slash and begin in _PREFIXES else "rt"
    meant = "/".join((prefix, *parts))
    end = _SERVICE_SUFFIXES.get(f"{prefix}/", "")
    if end and not meant.endswith(end):
        meant += end
    plain = _WILDCARD.sub("x", meant)
    return f": write {meant}" if parts and _ROS_NAME.match(plain) else ""


def _rule_topics(grant: Grant, *, allow: bool) -> Iterator[str]:
    """Yield the published and subscribed topics of the allow rules, or of the deny rules."""
    for rule in grant.rules:
        if rule.allow is allow:
            yield from _topics((*rule.publish, *rule.subscribe))


def _topics(criteria: Sequence[Criteria]) -> Iterator[str]:
    for criterion in criteria:
        yield from criterion.topics
