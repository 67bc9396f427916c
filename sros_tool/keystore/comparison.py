"""Comparison of two governances, or two settings: the changes that allow more or less."""

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
    """Whether a change allows more (looser) or less (tighter), or applies only later."""

    LOOSER = "looser"
    TIGHTER = "tighter"
    LATER = "later"
    """The change has no effect now, but applies to files that are made later."""


@dataclass(frozen=True, slots=True)
class SettingChange:
    """A setting that changes."""

    effect: Effect
    """``looser``: more is allowed; ``tighter``: less is allowed; ``later``: the change applies only
    to files that are made later.
    """
    key: str
    """Key of the setting in sros.toml, or ``domain``."""
    before: str
    """Value before the change."""
    after: str
    """Value after the change."""
    meaning: str
    """Meaning of the change in ROS terms, as a clause."""

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
"""Maps a protection kind to the properties it gives messages (DDS-Security 1.1, 9.4.1.2.3)."""

_LOSS_TEXTS = {
    "secrecy": "no longer encrypted",
    "integrity": "no longer signed",
    "origin": "no longer proven to come from the writer that they name",
}
_GAIN_TEXTS = {
    "secrecy": "encrypted",
    "integrity": "signed",
    "origin": "proven to come from the writer that they name",
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
        "any participant with a certificate may join, whatever its permissions",
        "joining needs permissions",
    ),
    "enable_discovery_protection": (
        "publishers and subscriptions of {} are announced unprotected",
        "publishers and subscriptions of {} are announced with protection",
    ),
    "enable_liveliness_protection": (
        "liveliness messages of {} are unprotected",
        "liveliness messages of {} are protected",
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
"""Maps a flag of governance to the clauses for its open value and its protecting value."""


# ── governance ─────────────────────────────────────────────────────────────────────────────


def compare_governance(old: Governance, new: Governance) -> tuple[SettingChange, ...]:
    """Return the changes from governance ``old`` to ``new``, in ROS terms.

    Only the first rule that matches a topic protects the topic.  So the comparison is of the
    protection that topics get, not of the text of rules.
    """
    return tuple(dict.fromkeys(_governance_changes(old, new)))


def _governance_changes(old: Governance, new: Governance) -> Iterator[SettingChange]:
    before, after = old.domains().closed(), new.domains().closed()
    for effect, domains, meaning in (
        (
            Effect.LOOSER,
            _remaining_domains(after, before),
            "enclaves may also join domain {}, unless their permissions are only for other domains",
        ),
        (
            Effect.TIGHTER,
            _remaining_domains(before, after),
            "no enclave may join domain {} any more",
        ),
    ):
        if domains.ranges:
            yield SettingChange(effect, "domain", str(before), str(after), meaning.format(domains))
    pairs = dict.fromkeys(
        (_rule_for_domain(old, domain), _rule_for_domain(new, domain))
        for domain in before
        if domain in after
    )
    for old_rule, new_rule in pairs:
        yield from attribute_changes(old_rule, new_rule, "protection", "")
        for expression, old_topic_rule, new_topic_rule in _topic_pairs(old_rule, new_rule):
            key, name = _key_and_name(expression)
            if old_topic_rule and new_topic_rule:
                yield from attribute_changes(old_topic_rule, new_topic_rule, key, name)
            elif new_topic_rule:
                yield SettingChange(Effect.LOOSER, key, "no rule", "a rule", f"{name} can be used")
            else:
                text = f"{name} can no longer be used"
                yield SettingChange(Effect.TIGHTER, key, "a rule", "no rule", text)


def _remaining_domains(domains: DomainSet, removed_domains: DomainSet) -> DomainSet:
    return DomainSet.of(*((domain, domain) for domain in domains if domain not in removed_domains))


def _rule_for_domain(governance: Governance, domain: int) -> DomainRule:
    return next(rule for rule in governance.domain_access_rules if domain in rule.domains.closed())


def _topic_pairs(
    old: DomainRule, new: DomainRule
) -> Iterator[tuple[str, TopicRule | None, TopicRule | None]]:
    """Yield (topic expression, old rule, new rule) for topics to which different rules apply.

    A rule is None if no rule of the domain covers the expression.
    """
    rules = (*old.topic_access_rules, *new.topic_access_rules)
    expressions = list(dict.fromkeys(rule.topic_expression for rule in rules))
    # If an expression overlaps a name without wildcards, it covers the name, so only wildcards
    # matter here.
    for first, second in combinations(filter(is_expression, expressions), 2):
        parted = overlap(first, second) and not covers(first, second) and not covers(second, first)
        # The order of two overlapping rules decides, so a topic that both match is compared, too.
        if parted and (name := common_name((first, second), absolute=False)):
            expressions.append(name)
    before_of, after_of = _first_covering_rule(old), _first_covering_rule(new)
    for expression in expressions:
        before, after = before_of(expression), after_of(expression)
        if (before is None) != (after is None) or (
            before and after and not _protect_alike(before, after)
        ):
            yield expression, before, after


def _first_covering_rule(domain: DomainRule) -> Callable[[str], TopicRule | None]:
    """Return a function from a topic expression to the first rule that covers it, or None."""
    numbered = list(enumerate(domain.topic_access_rules))
    own = {rule.topic_expression: (number, rule) for number, rule in reversed(numbered)}
    wide = [(number, rule) for number, rule in numbered if is_expression(rule.topic_expression)]

    def rule_for(expression: str) -> TopicRule | None:
        place, exact = own.get(expression, (len(numbered), None))
        for number, rule in wide:
            if number > place:
                break
            if covers(rule.topic_expression, expression):
                return rule
        return exact

    return rule_for


def _protect_alike(first: TopicRule, second: TopicRule) -> bool:
    return all(
        getattr(first, attribute.name) == getattr(second, attribute.name)
        for attribute in attributes(TopicRule)
    )


def _key_and_name(expression: str) -> tuple[str, str]:
    """Return the prefix of setting keys for a topic expression, and the ROS name with its kind.

    An example of the name is "service /add".
    """
    if expression == "*":
        return "protection.default", "every name without a rule of its own"
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
    """Yield the changes between two domain rules or two topic rules.

    Args:
        old: the rule before.
        new: the rule after, of the same class.
        prefix: beginning of the setting keys of the changes.
        name: ROS name of the topics that a topic rule covers; "" for domain rules.
    """
    for attribute in attributes(type(old)):
        before, after = getattr(old, attribute.name), getattr(new, attribute.name)
        if before == after:
            continue
        key, before_text, after_text = (
            f"{prefix}.{attribute.term}",
            _value_text(before),
            _value_text(after),
        )
        if attribute.is_flag:
            effect = Effect.LOOSER if after == attribute.open else Effect.TIGHTER
            meaning = _FLAG_WORDS[attribute.name][effect is Effect.TIGHTER].format(name)
            yield SettingChange(effect, key, before_text, after_text, meaning)
            continue
        subject = _ROS_WORDS[attribute.name].format(name)
        lost = _PROPERTIES[before] - _PROPERTIES[after]
        gained = _PROPERTIES[after] - _PROPERTIES[before]
        for effect, properties, words in (
            (Effect.LOOSER, lost, _LOSS_TEXTS),
            (Effect.TIGHTER, gained, _GAIN_TEXTS),
        ):
            if properties:
                meaning = " and ".join(text for word, text in words.items() if word in properties)
                yield SettingChange(effect, key, before_text, after_text, f"{subject}: {meaning}")


def _value_text(value: bool | ProtectionKind) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


@dataclass(frozen=True, slots=True)
class Mismatch:
    """Communication that fails between a process with the old governance and one with the new.

    Tested with Cyclone DDS 0.10.2, Fast DDS 2.9.1 and 2.14.5, which agree: two participants whose
    domain rules differ in a protection kind do not communicate at all.  Participants whose rules
    for a topic differ do not communicate on this topic.  Differences in join access control,
    unauthenticated participants and domains do no harm.  ``everything`` says that nothing is
    communicated any more; ``names`` are the topics, services and actions (ROS names) that fail.
    """

    everything: bool = False
    names: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        return self.everything or bool(self.names)


_MUST_AGREE = {
    "discovery_protection_kind",
    "liveliness_protection_kind",
    "rtps_protection_kind",
}


def mismatch(old: Governance, new: Governance) -> Mismatch:
    """Return the communication that fails between processes with ``old`` and with ``new``."""
    domains = [domain for domain in old.domains().closed() if domain in new.domains().closed()]
    names: dict[str, None] = {}
    pairs = dict.fromkeys((_rule_for_domain(old, d), _rule_for_domain(new, d)) for d in domains)
    for old_rule, new_rule in pairs:
        if any(getattr(old_rule, kind) != getattr(new_rule, kind) for kind in _MUST_AGREE):
            return Mismatch(everything=True)
        for expression, _, _ in _topic_pairs(old_rule, new_rule):
            if expression == "*":
                # This includes `ros_discovery_info`, which every node needs.
                return Mismatch(everything=True)
            names[_key_and_name(expression)[1]] = None
    return Mismatch(names=tuple(names))


# ── settings ───────────────────────────────────────────────────────────────────────────────


def compare_settings(old: Template, new: Template, now: datetime) -> tuple[SettingChange, ...]:
    """Return the changes between two settings of a keystore.

    Changes in the protection of topics and in the names of CAs are left out.
    """
    return tuple(_settings_changes(old, new, now))


def _settings_changes(old: Template, new: Template, now: datetime) -> Iterator[SettingChange]:
    for key, name, setting in (
        ("certificates.validity", "certificate_validity", "certificates"),
        ("permissions.validity", "permissions_validity", "permissions"),
    ):
        before, after = getattr(old, name), getattr(new, name)
        if before != after:
            longer = _expiry_of_span(after, now) > _expiry_of_span(before, now)
            effect = Effect.LOOSER if longer else Effect.TIGHTER
            meaning = f"{setting} expire {'later' if longer else 'earlier'}"
            yield SettingChange(effect, key, span_text(before), span_text(after), meaning)
    yield from _short_lived_changes(old, new)
    for key, name, open_value, words in _CHOICE_EFFECTS:
        before, after = getattr(old, name), getattr(new, name)
        if before != after:
            effect = Effect.LOOSER if after == open_value else Effect.TIGHTER
            first, second = _choice_text(key, before), _choice_text(key, after)
            yield SettingChange(effect, key, first, second, words[effect is Effect.TIGHTER])
    yield from _zenoh_changes(old.zenoh, new.zenoh)
    rotated = "applies to the CAs that `sros rotate_ca` makes"
    listed = "applies to the next revocation list; `sros crl --refresh` signs one"
    for key, first, second, meaning in (
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
        if first != second:
            yield SettingChange(Effect.LATER, key, first, second, meaning)


def _short_lived_changes(old: Template, new: Template) -> Iterator[SettingChange]:
    """Yield the changes in the settings for short-lived enclaves."""
    lists = [
        {short_lived.name: short_lived.validity for short_lived in side.short_lived}
        for side in (old, new)
    ]
    for name in dict.fromkeys(name for side in lists for name in side):
        before, after = (side.get(name) for side in lists)
        if before == after:
            continue
        longer = after is None or (before is not None and after > before)
        effect = Effect.LOOSER if longer else Effect.TIGHTER
        first, second = (
            duration_text(lifetime) if lifetime else "as others" for lifetime in (before, after)
        )
        meaning = f"new files of {name} expire {'later' if longer else 'earlier'}"
        yield SettingChange(effect, f"enclaves {name}.validity", first, second, meaning)


def _zenoh_changes(old: ZenohNetwork | None, new: ZenohNetwork | None) -> Iterator[SettingChange]:
    """Yield the changes between two Zenoh networks; None means that the keystore has no network."""
    if old is None or new is None:
        if old != new:
            first, second = (network.mode.value if network else "none" for network in (old, new))
            meaning = "enclaves get files for Zenoh" if new else "no files for Zenoh are kept"
            yield SettingChange(Effect.LATER, "zenoh", first, second, meaning)
        return
    for key, meaning in (
        ("router", "the other enclaves trust this enclave as the router"),
        ("endpoints", "sessions connect to these endpoints"),
        ("listen", "the router listens on these endpoints"),
        ("mode", "how sessions reach each other"),
        ("domains", "the network is used in these domains of the governance"),
        ("routers", "further routers, each with the enclaves whose sessions connect to it"),
        ("crossing", "names that pass from one router to another"),
    ):
        before, after = getattr(old, key), getattr(new, key)
        if before != after:
            first, second = (
                ",".join(map(str, setting)) or "(default)"
                if isinstance(setting, tuple)
                else str(setting)
                for setting in (before, after)
            )
            yield SettingChange(Effect.LATER, f"zenoh.{key}", first, second, meaning)


_CHOICE_EFFECTS = (
    (
        "certificates.unique_subject",
        "unique_subject",
        False,
        (
            "earlier permissions also fit later certificates of the enclave",
            "earlier permissions do not fit later certificates of the enclave",
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
"""Settings with a few values: key, field, open value, and the clauses for looser and tighter."""


def _choice_text(key: str, value: bool | str) -> str:
    if key == "authorities.layout":
        return "separate" if value else "single"
    return str(value).lower() if isinstance(value, bool) else value


def _expiry_of_span(span: Span, now: datetime) -> datetime:
    try:
        return window(now, span).not_after
    except UsageError:  # a fixed date that has passed
        return now
