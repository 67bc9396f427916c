"""Random sides of a comparison as files, and what they give, asked name by name.

Nothing here uses `sros_tool.proof.growth`: the engine of each vendor, and the access control of
Zenoh, decide single questions.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Iterator, Sequence, Set
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from functools import cache
from itertools import product
from pathlib import Path
from random import Random
from typing import Any

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.serialization import Encoding

from sros_tool.dds.decision.access import Access, AccessVerb, GovernedDomain
from sros_tool.dds.decision.expressions import matches
from sros_tool.dds.decision.vendors import CYCLONE_DDS, Style, Vendor
from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import (
    DomainRule,
    Governance,
    ProtectionKind,
    TopicRule,
    attributes,
    render_governance,
)
from sros_tool.dds.permissions import render_permissions
from sros_tool.errors import PolicyError
from sros_tool.keystore.template import load_template, render_template
from sros_tool.names import SERVICE_ENDS, dds_names
from sros_tool.pki import smime
from sros_tool.policy.document import policy_xml
from sros_tool.policy.model import (
    ALLOW,
    RIGHTS,
    Enclave,
    Group,
    Level,
    Policy,
    Profile,
    Profiles,
    Qualifier,
)
from sros_tool.policy.rights import policy_rights
from sros_tool.translate import governance_for, permissions_for
from sros_tool.translate_zenoh.rights import remote_of, stated_rights
from sros_tool.validity import window
from sros_tool.zenoh.access import Enforcement, Flow, Message, Remote
from sros_tool.zenoh.configuration import Mode, render_configuration, render_rights
from sros_tool.zenoh.document import parse_configuration

VERBS = (AccessVerb.PUBLISH, AccessVerb.SUBSCRIBE)
DOMAINS = (0, 7, 8, 9)
"""Two that keystores have, one that only robots have, and one that nobody names."""
ENCLAVES = ("/a", "/a/b", "/r1", "/r2")
HIDDEN = "/.h"
AT = datetime(2026, 1, 1, tzinfo=UTC)
NAMES = (
    "/a", "/b", "/ab", "/a/b", "/*", "/a*", "/*b", "/?", "/[ab]", "/[!a]", "/[a-b]?", "/a?*",
    "/*a*", "/a/*", "/[!b]*", "/?b", "/ab*",
)  # fmt: skip
PROTECTED = ("/a", "/ab", "/b", "/*b")
THREE = ("a/b", "abb", "bab", "aab", "b/a")
SHORT = [
    name
    for length in (1, 2, 3)
    for name in ("/" + "".join(letters) for letters in product("abc/", repeat=length))
    if "//" not in name and not name.endswith("/") and (length < 3 or name[1:] in THREE)
]
TOPICS = [
    *(f"rt{name}" for name in SHORT),
    *(f"{begin}{name}{end}" for begin, end in SERVICE_ENDS.items() for name in SHORT[:6]),
]

# ── what is drawn ──────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class Drawn:
    """A side of a comparison: a policy, a keystore, or a Zenoh file.

    ``robots`` are the domains of r1 and r2 in a fleet file, or None without one: of a policy, or as
    the keystore recorded them.  ``domains`` are those of the signed permissions of enclaves.
    ``flips`` are the places in `FLIPS` of Zenoh settings.
    """

    kind: str
    policy: Policy
    robots: tuple[int | None, int | None] | None = None
    domains: dict[str, DomainSet] = field(default_factory=dict)
    governance: Governance | None = None
    zenoh: str = ""
    flips: frozenset[int] = frozenset()
    signed: bool = True
    settings: int = 0


FLIPS: tuple[tuple[str, object, str], ...] = (
    ("adminspace/enabled", True, "loose"),
    ("transport/link/tls/close_link_on_expiration", False, "loose"),
    ("transport/shared_memory/enabled", True, "loose"),
    ("plugins/rest/http_port", 8000, "loose"),
    ("transport/auth/usrpwd/user", "u", "loose"),
    ("downsampling", [], "unknown"),
    ("queries_default_timeout", 5, "harmless"),
)
"""Zenoh settings with a value that is not the usual one, and what that means."""
SETTINGS = ("production", "development", "sros2")
"""What later enclaves get: each template gives them more than the one before."""


def draw(dice: Random) -> Drawn:
    kind = dice.choice(("policy", "policy", "keystore", "keystore", "zenoh"))
    if kind == "zenoh":
        return _on_zenoh(Drawn(kind, drawn_policy(dice, plain=True)), dice)
    if kind == "policy":
        robots = None
        if dice.random() < 0.5:
            one, two = (dice.choice((None, None, 0, 7, 8)) for _ in "12")
            robots = one, two
        return Drawn(kind, drawn_policy(dice, robots=robots is not None), robots)
    on_zenoh = dice.random() < 0.3
    drawn = Drawn(
        kind,
        policy := drawn_policy(dice, plain=on_zenoh, hidden=not on_zenoh and dice.random() < 0.2),
        (dice.choice((None, 7)), None) if dice.random() < 0.2 else None,
        {each.path: _some_domains(dice) for each in policy.enclaves},
        drawn_governance(dice),
        settings=dice.randrange(3),
    )
    return _on_zenoh(drawn, dice) if on_zenoh else drawn


def _on_zenoh(drawn: Drawn, dice: Random) -> Drawn:
    """The side with other domains, settings and signature of its Zenoh file."""
    flips = frozenset(dice.sample(range(len(FLIPS)), dice.choice((0, 0, 1, 2))))
    domains, signed = dice.choice(("0", "7", "0,7")), dice.random() < 0.85
    return replace(drawn, zenoh=domains, flips=flips, signed=signed)


def changed(drawn: Drawn, dice: Random) -> Drawn:
    """The side with one thing changed, or another one."""
    other = draw(dice)
    if dice.random() < 0.5:
        return other
    again = {"policy": 0.6, "keystore": 0.35, "zenoh": 0.4}[drawn.kind]
    if dice.random() < again:
        return replace(drawn, policy=_changed_policy(drawn, dice))
    if drawn.kind == "policy":
        if drawn.robots is None:
            return replace(drawn, policy=_changed_policy(drawn, dice))
        one, two = (dice.choice((None, 0, 7, 8)), drawn.robots[1])
        return replace(drawn, robots=(one, two))
    if drawn.kind == "keystore" and dice.random() < 0.75:
        governance = _changed_governance(drawn.governance, dice)
        what = dice.choice(("governance", "governance", "domains", "settings"))
        if what == "governance":
            return replace(drawn, governance=governance)
        if what == "settings":
            return replace(drawn, settings=dice.randrange(3))
        paths = [each.path for each in drawn.policy.enclaves]
        return replace(drawn, domains={**drawn.domains, dice.choice(paths): _some_domains(dice)})
    return _on_zenoh(drawn, dice) if drawn.zenoh else other


def drawn_policy(
    dice: Random, *, robots: bool = False, plain: bool = False, hidden: bool = False
) -> Policy:
    """A policy of few enclaves; of robots by a placeholder, ``plain`` without what Zenoh lacks."""
    paths = ["/a", "/{robot}"] if robots else dice.sample(ENCLAVES, dice.randint(1, 3))
    enclaves = [drawn_enclave(dice, path, plain) for path in paths]
    if hidden:
        enclaves.append(drawn_enclave(dice, HIDDEN, plain, protect=False))
    return Policy(tuple(enclaves))


def drawn_enclave(dice: Random, path: str, plain: bool, *, protect: bool = True) -> Enclave:
    groups = [drawn_group(dice, plain) for _ in range(dice.randint(1, 2))]
    if protect and not plain and dice.random() < 0.3:
        level = dice.choice((Level.SIGN, Level.ENCRYPT))
        rights = (("publish", ALLOW),)
        groups.append(Group("topics", rights, (dice.choice(PROTECTED),), level))
    return Enclave(path, (Profiles((Profile("/", "n", tuple(groups)),)),))


def drawn_group(dice: Random, plain: bool) -> Group:
    kind = dice.choice(("topics", "topics", "topics", "services"))
    rights = dice.sample(RIGHTS[kind], dice.randint(1, 2))
    qualifier = ALLOW if plain else dice.choices(tuple(Qualifier), (3, 1))[0]
    names = dice.sample(NAMES[:5] if plain else NAMES, dice.randint(1, 2))
    return Group(kind, tuple((r, qualifier) for r in sorted(rights)), tuple(names))


def _changed_policy(drawn: Drawn, dice: Random) -> Policy:
    """The policy with a group changed, removed or added."""
    enclaves = list(drawn.policy.enclaves)
    at = dice.randrange(len(enclaves))
    profile = enclaves[at].profiles[0].profiles[0]
    groups = list(profile.groups)
    one = dice.randrange(len(groups))
    plain = bool(drawn.zenoh)
    what = dice.random()
    if what < 0.4:
        names = dice.sample(NAMES[:5] if plain else NAMES, dice.randint(1, 3))
        groups[one] = replace(groups[one], names=tuple(names), lines=())
    elif what < 0.6 and not plain and enclaves[at].path != HIDDEN:
        level = dice.choice((None, Level.SIGN, Level.ENCRYPT))
        groups[one] = replace(groups[one], protect=level)
    elif what < 0.8 and len(groups) > 1:
        del groups[one]
    else:
        groups.append(drawn_group(dice, plain))
    kept = replace(profile, groups=tuple(groups))
    enclaves[at] = replace(enclaves[at], profiles=(Profiles((kept,)),))
    return Policy(tuple(enclaves))


def _some_domains(dice: Random) -> DomainSet:
    return DomainSet.of(*((each, each) for each in dice.choice(((0,), (0,), (7,), (0, 7)))))


def drawn_governance(dice: Random) -> Governance:
    """A governance of one or two domain rules, most attributes as strict as a template's."""
    sets = dice.choice((((0,),), ((0, 7),), ((0, 7),), ((0,), (7,)), ((7,), (0, 7))))
    return Governance(tuple(_drawn_domain_rule(dice, each) for each in sets))


def _drawn_domain_rule(dice: Random, domains: Sequence[int]) -> DomainRule:
    topics = [
        TopicRule(topic_expression=each, **_values(dice, TopicRule))
        for each in dice.sample(("rt/a", "rt/a*", "rt/*", "rq/*"), dice.choice((0, 0, 1, 2)))
    ]
    if dice.random() < 0.95:
        topics.append(TopicRule(topic_expression="*", **_values(dice, TopicRule)))
    return DomainRule(
        **_values(dice, DomainRule),
        domains=DomainSet.of(*((each, each) for each in domains)),
        topic_access_rules=tuple(topics),
    )


def _values(dice: Random, rule: type[DomainRule | TopicRule]) -> dict[str, Any]:
    return {
        each.name: dice.choice(each.values) if dice.random() < 0.08 else each.portable
        for each in attributes(rule)
    }


def _changed_governance(governance: Governance | None, dice: Random) -> Governance:
    assert governance
    rules = list(governance.domain_access_rules)
    at = dice.randrange(len(rules))
    rule = rules[at]
    topics = list(rule.topic_access_rules)
    if topics and dice.random() < 0.5:
        place = dice.randrange(len(topics))
        attribute = dice.choice(attributes(TopicRule))
        value = {attribute.name: dice.choice(attribute.values)}
        topics[place] = replace(topics[place], **value)  # type: ignore[arg-type]
        rules[at] = replace(rule, topic_access_rules=tuple(topics))
    elif dice.random() < 0.7:
        attribute = dice.choice(attributes(DomainRule))
        value = {attribute.name: dice.choice(attribute.values)}
        rules[at] = replace(rule, **value)  # type: ignore[arg-type]
    else:
        rules[at] = replace(rule, domains=_some_domains(dice))
    return Governance(tuple(rules))


# ── as files ───────────────────────────────────────────────────────────────────────────────


_KEY = ec.generate_private_key(ec.SECP256R1())
"""The key of the CA that signs everything."""


@cache
def certificate(name: str) -> x509.Certificate:
    """A certificate of the CA for the CA itself ("ca"), or for the own key of an enclave."""
    key = _KEY if name == "ca" else ec.generate_private_key(ec.SECP256R1())
    subject, issuer = (
        x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, each)]) for each in (name, "ca")
    )
    return (
        x509.CertificateBuilder(issuer, subject, key.public_key(), 1)
        .not_valid_before(AT - timedelta(days=9))
        .not_valid_after(AT + timedelta(days=9000))
        .sign(_KEY, SHA256())
    )


def _pem(name: str) -> bytes:
    return certificate(name).public_bytes(Encoding.PEM)


def _sign(document: bytes) -> bytes:
    return smime.sign(document, certificate("ca"), _KEY)


def write(drawn: Drawn, folder: Path) -> tuple[Path, Path | None]:
    """Write a side; return its path, and that of its fleet file if it is a policy with one."""
    folder.mkdir()
    if drawn.kind == "policy":
        path = folder / "policy.xml"
        path.write_bytes(policy_xml(drawn.policy))
        if drawn.robots is None:
            return path, None
        (folder / "fleet.toml").write_text(_fleet(drawn.robots))
        return path, folder / "fleet.toml"
    if drawn.kind == "zenoh":
        (folder / "router.json5").write_bytes(configuration(drawn))
        return folder / "router.json5", None
    _write_keystore(drawn, folder)
    return folder, None


def _fleet(robots: Sequence[int | None], enclaves: str = "") -> str:
    lines = [enclaves]
    for name, domain in zip(("r1", "r2"), robots, strict=True):
        lines.append(f"[robots.{name}]" + ("" if domain is None else f"\ndomain = {domain}"))
    return "\n".join(lines) + "\n"


def _write_keystore(drawn: Drawn, root: Path) -> None:
    pem = _pem("ca")
    assert drawn.governance
    governance = _sign(render_governance(drawn.governance))
    (root / "public").mkdir()
    for role in ("identity", "permissions"):
        (root / "public" / f"{role}_ca.cert.pem").write_bytes(pem)
    (root / "enclaves").mkdir()
    (root / "enclaves" / "governance.p7s").write_bytes(governance)
    template = load_template(SETTINGS[drawn.settings])
    (root / "sros.toml").write_text(render_template(template))
    if drawn.robots is not None:
        (root / "fleet.toml").write_text(_fleet(drawn.robots, 'enclaves = ["/{robot}"]'))
    for each in drawn.policy.enclaves:
        folder = root / f"enclaves{each.path}"
        folder.mkdir(parents=True, exist_ok=True)
        permissions = permissions_for(
            each,
            subject=f"CN={each.path}",
            validity=window(AT, timedelta(days=300)),
            domains=drawn.domains[each.path],
        )
        files = {
            "permissions.p7s": _sign(render_permissions(permissions)),
            "governance.p7s": governance,
            "cert.pem": _pem(each.path),
            "identity_ca.cert.pem": pem,
            "permissions_ca.cert.pem": pem,
        }
        for name, content in files.items():
            (folder / name).write_bytes(content)
    if drawn.zenoh:
        folder = root / "enclaves" / "router"
        folder.mkdir()
        document = configuration(drawn)
        signed = _sign(document if drawn.signed else b"{}")
        nothing = permissions_for(
            Enclave("/router", ()),
            subject="CN=/router",
            validity=window(AT, timedelta(days=300)),
            domains=DomainSet.of((0, 0)),
        )
        for name, content in {
            "router.json5": document,
            "router.p7s": signed,
            "cert.pem": _pem("/router"),
            "permissions_ca.cert.pem": pem,
            "permissions.p7s": _sign(render_permissions(nothing)),
        }.items():
            (folder / name).write_bytes(content)


def configuration(drawn: Drawn) -> bytes:
    """The file of the Zenoh router, which allows what the policy does in some domains."""
    rights = []
    for each in drawn.policy.enclaves:
        stated = {int(domain): stated_rights(each) for domain in drawn.zenoh.split(",")}
        try:
            rights.append(render_rights(remote_of(each.path, stated)))
        except PolicyError:
            continue  # what Zenoh cannot say
    data = render_configuration(Mode.ROUTER, ("tls/localhost:7447",), (), rights)
    document = json.loads(data)
    for place in sorted(drawn.flips):
        path, value, _ = FLIPS[place]
        inner = document
        *parents, last = path.split("/")
        for one in parents:
            inner = inner.setdefault(one, {})
        inner[last] = value
    return data if not drawn.flips else json.dumps(document).encode()


# ── name by name ───────────────────────────────────────────────────────────────────────────

_STRICT = governance_for(load_template("production").protection, DomainSet.of((0, 0)))
_ANY = DomainSet.of((0, 230))


class Side:
    """A drawn side next to the other one of its pair: what it gives, by single questions."""

    def __init__(self, own: Drawn, other: Drawn) -> None:
        self.own, self._other = own, other
        self._stated = {each.path: each for each in _expanded(own).enclaves}
        self._access: dict[tuple[object, ...], Access] = {}
        self._rules: Enforcement | None = None
        if own.zenoh:
            self._rules = parse_configuration(configuration(own), "it").access
        self._rights = policy_rights(Policy(tuple(self._stated.values())))

    def enclaves(self) -> Set[str]:
        """The enclaves that it has, or has Zenoh rules for."""
        return self._stated.keys()

    def _in_domain(self, enclave: str, domain: int) -> bool:
        """Whether a policy is for a domain: the robot's own one, or those of the other side."""
        if self._other.governance is None:
            return domain in self._of_robots(enclave, (domain,))
        return domain in self._of_robots(enclave, self._other.governance.domains())

    def _of_robots(self, enclave: str, others: Iterable[int]) -> set[int | None]:
        """The domain of the enclave's robot, or else ``others``, and those of all robots."""
        robots = self.own.robots or self._other.robots or (None, None)
        fixed = dict(zip(("/r1", "/r2"), robots, strict=True))
        own = fixed.get(enclave)
        if own is not None:
            return {own}
        return {*others, *(fixed[each] for each in fixed if each in self._stated)}

    def dds(self, vendor: Vendor, enclave: str, domain: int, verb: AccessVerb, topic: str) -> bool:
        """Whether a vendor lets an enclave use a topic in a domain, also as another enclave."""
        if enclave not in self._stated:
            return False
        return any(
            self._by_permissions(vendor, each, domain, verb, topic)
            for each in (enclave, *self._fitting_others(vendor, enclave))
        )

    def _fitting_others(self, vendor: Vendor, enclave: str) -> Iterator[str]:
        """The enclaves whose permissions Cyclone DDS takes for those of another one."""
        if vendor in CYCLONE_DDS and not self._is_unique(enclave):
            parts = set(enclave.split("/"))
            yield from (e for e in self._stated if e != enclave and parts < {*e.split("/")})

    def _is_unique(self, enclave: str) -> bool:
        """Whether a policy's enclave is created later, in a keystore of the template production."""
        other = self._other
        return (
            self.own.kind == "policy"
            and other.kind == "keystore"
            and other.settings == SETTINGS.index("production")
            and all(each.path != enclave for each in _expanded(other).enclaves)
        )

    def _by_permissions(
        self, vendor: Vendor, enclave: str, domain: int, verb: AccessVerb, topic: str
    ) -> bool:
        """Whether the permissions of an enclave let it use a topic in a domain."""
        if self.own.kind == "policy":
            if not self._in_domain(enclave, domain):
                return False
            domain = 0
        key = vendor, enclave, domain
        if key not in self._access:
            domains = self.own.domains.get(enclave, _ANY)
            permissions = permissions_for(
                self._stated[enclave],
                subject=f"CN={enclave}",
                validity=window(AT, timedelta(days=300)),
                domains=domains,
            )
            governance = self.own.governance or _STRICT
            governed = GovernedDomain(vendor, governance, domain)
            self._access[key] = Access(governed, permissions, f"CN={enclave}", moment=AT)
        return self._access[key].decide(verb, topic).outcome.ok

    def on_zenoh(self, enclave: str, domain: int, verb: AccessVerb, topic: str) -> bool:
        """Whether Zenoh lets an enclave use the key of a topic, or would by the rights."""
        writes = verb is AccessVerb.PUBLISH
        if self._rules is not None:
            remote = Remote(enclave)
            return all(
                self._rules.decide(remote, *message).allowed
                for message in _messages(topic, domain, writes)
            )
        if self.own.kind == "policy":
            if not self._in_zenoh_domain(enclave, domain):
                return False
        elif domain not in self.own.domains.get(enclave, DomainSet(())):
            return False
        allowed, denied = (
            any(
                matches(Style.FNMATCH, expression, topic)
                for each in self._rights
                if each.enclave == enclave and (each.qualifier is ALLOW) is allows
                for expression in _of_right(each.right, each.name, writes)
            )
            for allows in (True, False)
        )
        return allowed and not denied

    def _in_zenoh_domain(self, enclave: str, domain: int) -> bool:
        network = map(int, self._other.zenoh.split(","))
        return domain in self._of_robots(enclave, network)


def _expanded(drawn: Drawn) -> Policy:
    """The policy with an enclave for each robot in place of the placeholder."""
    enclaves = []
    for each in drawn.policy.enclaves:
        paths = ("/r1", "/r2") if "{" in each.path else (each.path,)
        enclaves += [replace(each, path=path) for path in paths]
    return Policy(tuple(enclaves))


def _of_right(right: str, name: str, writes: bool) -> tuple[str, ...]:
    names = dds_names(right, name)
    return names.publish if writes else names.subscribe


def _messages(topic: str, domain: int, writes: bool) -> list[tuple[Flow, Message, str]]:
    """What a process sends or gets to use a topic (docs/zenoh.md), and by which key."""
    flow = Flow.INGRESS if writes else Flow.EGRESS
    begin = topic[:2]
    name = topic[2 : len(topic) - len({"rt": "", **SERVICE_ENDS}[begin])]
    key = f"{domain}{name}/any::type/hash"
    if begin == "rt":
        return [(flow, Message.PUT, key)]
    if begin == "rq":
        return [(flow, Message.QUERY, key)]
    return [(flow, Message.REPLY, key), (flow, Message.DECLARE_QUERYABLE, key)]


# ── protection ─────────────────────────────────────────────────────────────────────────────

_WORTH = {
    ProtectionKind.NONE: set(),
    ProtectionKind.SIGN: {"sign"},
    ProtectionKind.ENCRYPT: {"sign", "encrypt"},
    ProtectionKind.SIGN_WITH_ORIGIN_AUTHENTICATION: {"sign", "origin"},
    ProtectionKind.ENCRYPT_WITH_ORIGIN_AUTHENTICATION: {"sign", "encrypt", "origin"},
}


def loosened(base: Drawn, head: Drawn, styles: Collection[Style]) -> set[str]:
    """The terms of the settings by which HEAD protects less, such as "rtps" or "protect"."""
    found: set[str] = set()
    if "zenoh" not in (base.kind, head.kind):
        if base.governance and head.governance:
            found |= set(_looser_governance(base.governance, head.governance, styles))
        elif head.governance:
            found |= set(_less_than_stated(base, head.governance, styles))
        elif base.kind == head.kind == "policy":
            found |= {"protect"} if _states_less(base, head) else set()
    if base.kind == head.kind == "keystore":
        if head.settings > base.settings:
            found.add("later")
        if base.zenoh and not head.zenoh:
            found.add("files")
        one, other = (each.robots[0] if each.robots else None for each in (base, head))
        if base.robots and head.robots and one is not None and one != other:
            found.add("later")
    if head.zenoh:
        same = base.kind == head.kind and bool(base.zenoh)
        before = base.flips if same else frozenset()
        if any(FLIPS[each][2] == "loose" for each in head.flips - before):
            found.add("zenoh")
        # What is asked for at the door is another thing, whether it is more or less.
        if any(FLIPS[each][0].startswith("transport/auth") for each in before - head.flips):
            found.add("zenoh")
        lone = head.kind == "zenoh"
        known = base.signed if base.kind == "keystore" else base.kind != "zenoh"
        if (lone and not same and base.kind != "zenoh") or (
            not lone and not head.signed and (known or not same)
        ):
            found.add("signature")
    return found


def unknown(base: Drawn, head: Drawn) -> bool:
    """Whether HEAD has something that cannot be compared."""
    if head.kind == "policy" and _contradicts(head):
        return True
    if not head.zenoh:
        return False
    same = base.kind == head.kind and bool(base.zenoh)
    before = base.flips if same else frozenset()
    return any(FLIPS[each][2] == "unknown" for each in head.flips ^ before)


def _rule_of(governance: Governance, domain: int) -> DomainRule | None:
    rules = governance.domain_access_rules
    return next((each for each in rules if domain in each.domains), None)


def _topic_rule(rule: DomainRule, style: Style, topic: str) -> TopicRule | None:
    rules = rule.topic_access_rules
    return next((e for e in rules if matches(style, e.topic_expression, topic)), None)


def _less(before: object, after: object, *, protects: bool) -> bool:
    if isinstance(before, bool):
        return before is protects and after is not protects
    return bool(_WORTH[before] - _WORTH[after])  # type: ignore[index]


def _looser_governance(
    base: Governance, head: Governance, styles: Collection[Style]
) -> Iterator[str]:
    for domain in DOMAINS:
        one, other = _rule_of(base, domain), _rule_of(head, domain)
        if one is None or other is None:
            continue
        yield from _looser_rule(one, other)
        for style, topic in product(styles, TOPICS):
            before, after = (_topic_rule(each, style, topic) for each in (one, other))
            if before and after:
                yield from _looser_rule(before, after)


def _looser_rule(before: DomainRule | TopicRule, after: DomainRule | TopicRule) -> Iterator[str]:
    for each in attributes(type(before)):
        values = getattr(before, each.name), getattr(after, each.name)
        if _less(*values, protects=not each.open):
            yield each.term


def _demanded(drawn: Drawn, topic: str) -> Level | None:
    """The level that a policy demands of a DDS topic, None if it says nothing."""
    return max(_levels(drawn, topic), key=(Level.SIGN, Level.ENCRYPT).index, default=None)


def _less_than_stated(base: Drawn, head: Governance, styles: Collection[Style]) -> Iterator[str]:
    demanded = {topic: _demanded(base, topic) for topic in TOPICS}
    for domain in DOMAINS:
        rule = _rule_of(head, domain)
        if rule is None:
            continue
        strict = _STRICT.domain_access_rules[0]
        signed = replace(strict, rtps_protection_kind=ProtectionKind.SIGN)
        yield from _looser_rule(signed, rule)
        for style, topic in product(styles, TOPICS):
            found = _topic_rule(rule, style, topic)
            if found is None:
                continue
            flags = replace(
                found,
                data_protection_kind=ProtectionKind.ENCRYPT,
                metadata_protection_kind=ProtectionKind.ENCRYPT,
            )
            yield from _looser_rule(strict.topic_access_rules[0], flags)
            kinds = (found.data_protection_kind, found.metadata_protection_kind)
            every = set().union(*(_WORTH[each] for each in (*kinds, rule.rtps_protection_kind)))
            level = demanded[topic]
            if level is None:
                if "encrypt" not in every or "encrypt" not in _WORTH[kinds[1]]:
                    yield "data or metadata"
            elif ("encrypt" if level is Level.ENCRYPT else "sign") not in every:
                yield "data"


def _states_less(base: Drawn, head: Drawn) -> bool:
    """Return whether all enclaves, or one that still has the right, demand less for a topic."""
    order = (None, Level.SIGN, Level.ENCRYPT)
    pairs = [(base, head)]
    for enclave in head.policy.enclaves:
        own = [each for each in base.policy.enclaves if each.path == enclave.path]
        pairs += [(_with_enclaves(base, own), _with_enclaves(head, [enclave]))]
    return any(
        order.index(_demanded(after, topic)) < order.index(_demanded(before, topic))
        for before, after in pairs
        for topic in TOPICS
        if before is base or _is_stated(after, topic)
    )


def _with_enclaves(drawn: Drawn, enclaves: Sequence[Enclave]) -> Drawn:
    return replace(drawn, policy=replace(drawn.policy, enclaves=tuple(enclaves)))


def _is_stated(drawn: Drawn, topic: str) -> bool:
    """Return whether an enclave is allowed to use a topic; a DENY of it does not count."""
    return any(
        matches(Style.FNMATCH, each, topic)
        for right in policy_rights(drawn.policy)
        if right.qualifier is ALLOW
        for names in (dds_names(right.right, right.name),)
        for each in (*names.publish, *names.subscribe)
    )


def _contradicts(drawn: Drawn) -> bool:
    """Whether it demands two levels of a name; certain only for names of few letters."""
    return any(len(_levels(drawn, topic)) > 1 for topic in TOPICS)


def _levels(drawn: Drawn, topic: str) -> set[Level]:
    return {
        group.protect
        for enclave in drawn.policy.enclaves
        for profile in enclave.all_profiles()
        for group in profile.groups
        if group.protect
        for right, name in product(RIGHTS[group.kind], group.names)
        for names in (dds_names(right, name),)
        if any(matches(Style.FNMATCH, each, topic) for each in (*names.publish, *names.subscribe))
    }
