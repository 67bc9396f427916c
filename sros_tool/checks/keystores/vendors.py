"""Where the vendors decide differently on what is signed, found by asking the decision engine."""

from __future__ import annotations

from collections.abc import Iterator

from sros_tool.checks.keystores.enclaves import grant_of
from sros_tool.checks.keystores.opened import OpenedEnclave
from sros_tool.checks.kind import WARNING, Finding, Kind, by_id
from sros_tool.dds.decision import Access, Refusal, Vendor, Verb
from sros_tool.dds.permissions import render_permissions
from sros_tool.names import ROS_DISCOVERY_TOPIC, is_expression
from sros_tool.pki import smime
from sros_tool.pki.certificates import subject_text

DIFFER = Kind(
    "portable.vendors-differ",
    WARNING,
    "vendors that decide differently on the same permissions",
    "What works with one RMW is denied, or open, with another.",
    "sros: its decision engine, compared with Fast DDS 2.9.1 and 2.14.5 and Cyclone DDS 0.10.2.",
    "Stay inside the portable profile; `sros explain --all-vendors` tells each decision.",
)

KINDS = by_id(DIFFER)

_COMPARED = (Vendor.FAST, Vendor.FAST_2_9, Vendor.CYCLONE)
_UNHEARD_OF = "rt/sros_nobody_has_this"
_MANY = 3


def check_vendors(enclave: OpenedEnclave, *, outside: bool) -> Iterator[Finding]:
    """Ask every vendor about every topic that the permissions name.

    Documents just as sros writes them are decided alike, unless something ``outside`` of the
    portable profile was found in them: they are not asked about, for that takes long.
    """
    state = enclave.state
    if not (state.certificate and state.governance and state.permissions_document):
        return
    if not outside and _is_as_sros_writes(enclave):
        return
    governance = smime.parse(state.files["governance.p7s"]).document
    domain = next(iter(state.governance.domains().closed()), 0)
    answers = {
        vendor: Access.of_documents(
            vendor,
            governance,
            state.permissions_document,
            subject_text(state.certificate.subject),
            domain=domain,
            at=enclave.keystore.now,
            zone=enclave.keystore.zone,
        )
        for vendor in _COMPARED
    }
    differing = list(_differences(answers, _topics(enclave)))
    if differing:
        more = f"; and {len(differing) - _MANY} more" if len(differing) > _MANY else ""
        text = f"on domain {domain}, {'; '.join(differing[:_MANY])}{more}"
        yield DIFFER.found(enclave.name, text, enclave.file("permissions.p7s"))


def _is_as_sros_writes(enclave: OpenedEnclave) -> bool:
    permissions = enclave.state.permissions
    written = enclave.state.permissions_document.replace(b"\r\n", b"\n").strip()
    return permissions is not None and render_permissions(permissions).strip() == written


def _differences(answers: dict[Vendor, Access | Refusal], topics: list[str]) -> Iterator[str]:
    questions = [(Verb.JOIN, "")]
    questions += [(verb, topic) for topic in topics for verb in (Verb.PUBLISH, Verb.SUBSCRIBE)]
    for verb, topic in questions:
        said = {
            vendor.title: (
                answer.decision() if isinstance(answer, Refusal) else answer.decide(verb, topic)
            )
            for vendor, answer in answers.items()
        }
        if len({each.outcome.ok for each in said.values()}) > 1:
            told = ", ".join(f"{title}: {each.outcome.value}" for title, each in said.items())
            yield f"{f'{verb.value} {topic}'.strip()} ({told})"
            if verb is Verb.JOIN:
                return  # everything else differs, too


def _topics(enclave: OpenedEnclave) -> list[str]:
    """The topics that are named, an example for each wildcard, and one that nobody names."""
    grant = grant_of(enclave)
    named: dict[str, None] = {ROS_DISCOVERY_TOPIC: None}
    for rule in grant.rules if grant else ():
        for criteria in (*rule.publish, *rule.subscribe):
            for topic in criteria.topics:
                named[_example(topic)] = None
    return [*named, _UNHEARD_OF]


def _example(expression: str) -> str:
    """A name that a plain wildcard means; sets of characters stand for their first one."""
    if not is_expression(expression):
        return expression
    name, index = "", 0
    while index < len(expression):
        letter = expression[index]
        end = expression.find("]", index + 2) if letter == "[" else -1
        if end > 0:
            members = expression[index + 1 : end].lstrip("!^")
            negated = expression[index + 1] in "!^"
            name += "x" if negated or not members[:1].isalnum() else members[0]
            index = end
        else:
            name += "x" if letter in "*?" else letter
        index += 1
    return name
