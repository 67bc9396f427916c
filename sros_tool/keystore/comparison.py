"""What becomes looser and what tighter between two governances, or two keystore settings."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from itertools import combinations

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import DomainRule, Governance, ProtectionKind, TopicRule, attributes
from sros_tool.errors import UsageError
from sros_tool.keystore.template import EVERYTHING, Template
from sros_tool.names import is_expression, service_of
from sros_tool.policy.patterns import common_name, covers, overlap
from sros_tool.validity import Span, duration_text, span_text, window
from sros_tool.zenoh.configuration import ZenohNetwork


class Effect(StrEnum):
    """Whether a change gives anybody more possibilities, or fewer."""

    LOOSER = "looser"
    TIGHTER = "tighter"
    LATER = "later"
    """Neither today: it holds for what is made later."""


@dataclass(frozen=True, slots=True)
class SettingChange:
    """A setting that changes."""

    effect: Effect
    """``looser``: something becomes possible; ``tighter``: something is no longer possible;
    ``later``: it holds for what is made later."""
    key: str
    """Its key in sros.toml, or ``domain``."""
    before: str
    """The value before."""
    after: str
    """The value after."""
    meaning: str
    """What that means in ROS terms, as a clause."""

    def __str__(self) -> str:
        return f"{self.key} {self.before} -> {self.after}: {self.meaning}"


_PROPERTIES: dict[ProtectionKind, frozenset[str]] = {
    ProtectionKind.NONE: frozenset(),
    ProtectionKind.SIGN: frozenset({"integrity"}),
    ProtectionKind.ENCRYPT: frozenset({"integrity", "secrecy"}),
    ProtectionKind.SIGN_WITH_ORIGIN_AUTHENTICATION: frozenset({"integrity", "origin"}),
    ProtectionKind.ENCRYPT_WITH_ORIGIN_AUTHENTICATION: frozenset(
        {"integrity", "secrecy", "origin"}
    ),
}
"""What each protection kind gives (DDS-Security 1.1, 9.4.1.2.3)."""

_LOSS = {
    "secrecy": "no longer encrypted",
    "integrity": "no longer signed",
    "origin": "no longer proven to come from one writer",
}
_GAIN = {
    "secrecy": "encrypted",
    "integrity": "signed",
    "origin": "proven to come from one writer",
}
_ROS_WORDS = {
    "rtps_protection_kind": "whole messages",
    "discovery_protection_kind": "who publishes and subscribes what",
    "liveliness_protection_kind": "who is alive",
    "metadata_protection_kind": "submessages of {}",
    "data_protection_kind": "the payload of {}",
}
_FLAG_WORDS = {
    "allow_unauthenticated_participants": (
        "participants without a certificate may join",
        "participants without a certificate are refused",
    ),
    "enable_join_access_control": (
        "whoever has a certificate may join, whatever its permissions",
        "joining needs permissions",
    ),
    "enable_discovery_protection": (
        "who publishes and subscribes {} is announced unprotected",
        "who publishes and subscribes {} is announced with protection",
    ),
    "enable_liveliness_protection": (
        "who is alive on {} is said unprotected",
        "who is alive on {} is said with protection",
    ),
    "enable_read_access_control": (
        "every enclave may read {}",
        "reading {} needs permissions",
    ),
    "enable_write_access_control": (
        "every enclave may write {}",
        "writing {} needs permissions",
    ),
}
"""For each flag, the clauses for its open and its protecting value."""


# ── governance ─────────────────────────────────────────────────────────────────────────────


def compare_governance(old: Governance, new: Governance) -> tuple[SettingChange, ...]:
    """Return what changes between two governances, in ROS terms.

    The protection of a topic is that of the first rule that matches it, so rules are compared by
    what they decide, not by their text.
    """
    return tuple(dict.fromkeys(_governance_changes(old, new)))


def _governance_changes(old: Governance, new: Governance) -> Iterator[SettingChange]:
    before, after = old.domains().closed(), new.domains().closed()
    for effect, domains, meaning in (
        (Effect.LOOSER, _without(after, before), "enclaves may also join domain {}"),
        (Effect.TIGHTER, _without(before, after), "no enclave may join domain {} any more"),
    ):
        if domains.ranges:
            yield SettingChange(effect, "domain", str(before), str(after), meaning.format(domains))
    pairs = dict.fromkeys(
        (_rule_of(old, domain), _rule_of(new, domain)) for domain in before if domain in after
    )
    for one, other in pairs:
        yield from attribute_changes(one, other, "protection", "")
        for expression, first, second in _topic_pairs(one, other):
            key, name = _key_and_name(expression)
            if first and second:
                yield from attribute_changes(first, second, key, name)
            elif second:
                yield SettingChange(Effect.LOOSER, key, "no rule", "a rule", f"{name} can be used")
            else:
                text = f"{name} can no longer be used"
                yield SettingChange(Effect.TIGHTER, key, "a rule", "no rule", text)


def _without(one: DomainSet, other: DomainSet) -> DomainSet:
    return DomainSet.of(*((each, each) for each in one if each not in other))


def _rule_of(governance: Governance, domain: int) -> DomainRule:
    return next(each for each in governance.domain_access_rules if domain in each.domains.closed())


def _topic_pairs(
    old: DomainRule, new: DomainRule
) -> Iterator[tuple[str, TopicRule | None, TopicRule | None]]:
    """Yield topic expressions with the different rules that decide on them before and after."""
    rules = (*old.topic_access_rules, *new.topic_access_rules)
    expressions = list(dict.fromkeys(each.topic_expression for each in rules))
    # A name without wildcards is covered by what it overlaps with.
    for one, other in combinations(filter(is_expression, expressions), 2):
        parted = overlap(one, other) and not covers(one, other) and not covers(other, one)
        # Which of the two decides depends on their order, so ask for a topic of both.
        if parted and (name := common_name((one, other), absolute=False)):
            expressions.append(name)
    before_of, after_of = _deciding(old), _deciding(new)
    for each in expressions:
        before, after = before_of(each), after_of(each)
        if (before is None) != (after is None) or (before and after and not _equal(before, after)):
            yield each, before, after


def _deciding(domain: DomainRule) -> Callable[[str], TopicRule | None]:
    """Return the function that returns the first rule that covers a topic expression."""
    numbered = list(enumerate(domain.topic_access_rules))
    own = {each.topic_expression: (number, each) for number, each in reversed(numbered)}
    wide = [(number, each) for number, each in numbered if is_expression(each.topic_expression)]

    def rule_for(expression: str) -> TopicRule | None:
        place, found = own.get(expression, (len(numbered), None))
        for number, each in wide:
            if number > place:
                break
            if covers(each.topic_expression, expression):
                return each
        return found

    return rule_for


def _equal(one: TopicRule, other: TopicRule) -> bool:
    return all(
        getattr(one, each.name) == getattr(other, each.name) for each in attributes(TopicRule)
    )


def _key_and_name(expression: str) -> tuple[str, str]:
    """Return the prefix of the settings' keys for a topic expression, and its name in ROS terms."""
    if expression == "*":
        return "protection.default", "everything without protection of its own"
    service, _ = service_of(expression)
    if "/_action/" in expression:
        action = (service or expression[2:]).partition("/_action/")[0]
        return f"protection.action {action}", f"action {action}"
    if service:
        return f"protection.service {service}", f"service {service}"
    if expression.startswith("rt/"):
        return f"protection.topic {expression[2:]}", f"topic {expression[2:]}"
    return f"protection of {expression}", f"DDS topic {expression}"


def attribute_changes(
    old: DomainRule | TopicRule, new: DomainRule | TopicRule, prefix: str, name: str
) -> Iterator[SettingChange]:
    """Yield what changes between two rules of a kind; keys begin with ``prefix``.

    ``name`` are the topics of topic rules, in ROS terms.
    """
    for each in attributes(type(old)):
        before, after = getattr(old, each.name), getattr(new, each.name)
        if before == after:
            continue
        key, one, other = f"{prefix}.{each.term}", _text(before), _text(after)
        if each.is_flag:
            effect = Effect.LOOSER if after == each.open else Effect.TIGHTER
            meaning = _FLAG_WORDS[each.name][effect is Effect.TIGHTER].format(name)
            yield SettingChange(effect, key, one, other, meaning)
            continue
        subject = _ROS_WORDS[each.name].format(name)
        lost = _PROPERTIES[before] - _PROPERTIES[after]
        gained = _PROPERTIES[after] - _PROPERTIES[before]
        for effect, found, words in (
            (Effect.LOOSER, lost, _LOSS),
            (Effect.TIGHTER, gained, _GAIN),
        ):
            if found:
                meaning = " and ".join(text for word, text in words.items() if word in found)
                yield SettingChange(effect, key, one, other, f"{subject}: {meaning}")


def _text(value: bool | ProtectionKind) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


@dataclass(frozen=True, slots=True)
class Mismatch:
    """What does not communicate while one process has the old governance, another one the new.

    Measured on Cyclone DDS 0.10.2, Fast DDS 2.9.1 and 2.14.5, which agree: two participants with
    any difference in the kinds of protection of the domain do not communicate at all, and two with
    any difference in a topic rule not on its topics.  Join access control, unauthenticated
    participants and further domains disturb nobody.  ``everything`` says that nothing communicates;
    ``names`` are topics, services and actions in ROS terms.
    """

    everything: bool = False
    names: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        return self.everything or bool(self.names)


_DISTURBING = {
    "discovery_protection_kind",
    "liveliness_protection_kind",
    "rtps_protection_kind",
}


def mismatch(old: Governance, new: Governance) -> Mismatch:
    """Return what does not communicate between processes with ``old`` and with ``new``."""
    domains = [each for each in old.domains().closed() if each in new.domains().closed()]
    names: dict[str, None] = {}
    for one, other in dict.fromkeys((_rule_of(old, d), _rule_of(new, d)) for d in domains):
        if any(getattr(one, each) != getattr(other, each) for each in _DISTURBING):
            return Mismatch(everything=True)
        for expression, _, _ in _topic_pairs(one, other):
            if expression == "*":
                return Mismatch(everything=True)  # also `ros_discovery_info`, which every node has
            names[_key_and_name(expression)[1]] = None
    return Mismatch(names=tuple(names))


# ── settings ───────────────────────────────────────────────────────────────────────────────


def compare_settings(old: Template, new: Template, now: datetime) -> tuple[SettingChange, ...]:
    """Return what changes between two settings, apart from protection and names."""
    return tuple(_settings_changes(old, new, now))


def _settings_changes(old: Template, new: Template, now: datetime) -> Iterator[SettingChange]:
    for key, name, what in (
        ("certificates.validity", "certificate_validity", "certificates"),
        ("permissions.validity", "permissions_validity", "permissions"),
    ):
        before, after = getattr(old, name), getattr(new, name)
        if before != after:
            longer = _end(after, now) > _end(before, now)
            effect = Effect.LOOSER if longer else Effect.TIGHTER
            meaning = f"{what} expire {'later' if longer else 'earlier'}"
            yield SettingChange(effect, key, span_text(before), span_text(after), meaning)
    yield from _short_lived_changes(old, new)
    for key, name, open_value, words in _CHOICES:
        before, after = getattr(old, name), getattr(new, name)
        if before != after:
            effect = Effect.LOOSER if after == open_value else Effect.TIGHTER
            one, other = _choice_text(key, before), _choice_text(key, after)
            yield SettingChange(effect, key, one, other, words[effect is Effect.TIGHTER])
    yield from _zenoh_changes(old.zenoh, new.zenoh)
    rotated = "holds for the CAs that `sros rotate_ca` makes"
    listed = "holds for the next revocation list, also of `sros crl --refresh`"
    for key, one, other, meaning in (
        (
            "authorities.validity",
            span_text(old.authority_validity),
            span_text(new.authority_validity),
            rotated,
        ),
        ("authorities.name", old.authority_name, new.authority_name, rotated),
        (
            "revocation.validity",
            span_text(old.revocation_validity),
            span_text(new.revocation_validity),
            listed,
        ),
    ):
        if one != other:
            yield SettingChange(Effect.LATER, key, one, other, meaning)


def _short_lived_changes(old: Template, new: Template) -> Iterator[SettingChange]:
    """Yield the changes of enclaves that expire earlier than others."""
    lists = [{each.name: each.validity for each in side.short_lived} for side in (old, new)]
    for name in dict.fromkeys(name for side in lists for name in side):
        before, after = (side.get(name) for side in lists)
        if before == after:
            continue
        longer = after is None or (before is not None and after > before)
        effect = Effect.LOOSER if longer else Effect.TIGHTER
        one, other = (duration_text(each) if each else "as others" for each in (before, after))
        meaning = f"what is issued for {name} expires {'later' if longer else 'earlier'}"
        yield SettingChange(effect, f"enclaves {name}.validity", one, other, meaning)


def _zenoh_changes(old: ZenohNetwork | None, new: ZenohNetwork | None) -> Iterator[SettingChange]:
    """Yield what changes in a Zenoh network."""
    if old is None or new is None:
        if old != new:
            one, other = (each.mode.value if each else "none" for each in (old, new))
            meaning = "enclaves get files for Zenoh" if new else "no files for Zenoh are kept"
            yield SettingChange(Effect.LATER, "zenoh", one, other, meaning)
        return
    for key, meaning in (
        ("router", "the other enclaves trust this one as the router"),
        ("endpoints", "sessions connect there"),
        ("listen", "the router listens there"),
        ("mode", "how sessions reach each other"),
        ("domains", "ROS domains of the network, within those of the governance"),
    ):
        before, after = getattr(old, key), getattr(new, key)
        if before != after:
            one, other = (
                ",".join(map(str, each)) or "(as usual)" if isinstance(each, tuple) else str(each)
                for each in (before, after)
            )
            yield SettingChange(Effect.LATER, f"zenoh.{key}", one, other, meaning)


_CHOICES = (
    (
        "certificates.unique_subject",
        "unique_subject",
        False,
        (
            "earlier permissions fit every later certificate",
            "earlier permissions do not fit a certificate that is issued again",
        ),
    ),
    (
        "permissions.default",
        "default_permissions",
        EVERYTHING,
        (
            "an enclave without a policy may do everything",
            "an enclave without a policy may only start",
        ),
    ),
    (
        "authorities.layout",
        "separate_authorities",
        False,
        (
            "an enclave can sign its own permissions",
            "no enclave can sign permissions, once the permissions CA is replaced",
        ),
    ),
)
"""Keys of settings, with their fields, open values, and clauses for looser and for tighter."""


def _choice_text(key: str, value: bool | str) -> str:
    if key == "authorities.layout":
        return "separate" if value else "single"
    return str(value).lower() if isinstance(value, bool) else value


def _end(span: Span, now: datetime) -> datetime:
    try:
        return window(now, span).not_after
    except UsageError:  # a fixed date that is over
        return now
