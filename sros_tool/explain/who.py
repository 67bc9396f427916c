"""Decide a question for all enclaves of a keystore, and find the enclaves that one influences."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar

from sros_tool.dds.decision.access import is_open_to_unauthenticated
from sros_tool.dds.decision.grants import other_fitting_enclaves
from sros_tool.dds.decision.vendors import CYCLONE_DDS, TESTED
from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import Governance
from sros_tool.errors import KeystoreError, Note, SrosError
from sros_tool.explain.answer import Question, ask, question_about_action
from sros_tool.explain.asking import notes_on_question_about_action
from sros_tool.faults import REFUSE_STRANGERS
from sros_tool.fleet.robots import Fleet
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    enclave_names,
    enclave_path,
    is_original_keystore,
    remedy_in_keystore,
)
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.rights import RightsSource, notes_on_hidden_enclaves, rights_by_domains
from sros_tool.keystore.selection import likely_names, missing_enclave_error
from sros_tool.names import is_expression
from sros_tool.pki.certificates import load_certificate, subject_text
from sros_tool.policy.model import ALLOW
from sros_tool.policy.rights import Right
from sros_tool.reach import (
    OF_EVERY_NODE,
    QUESTIONS,
    HopPath,
    Network,
    Reach,
    Unguarded,
    unguarded_topics,
)
from sros_tool.values import shows
from sros_tool.wording import first_few, perhaps_meant
from sros_tool.xml import read_bytes


class EnclaveOutcome(Protocol):
    """The decision for one enclave."""

    @property
    def enclave(self) -> str:
        """Name of the enclave."""

    @property
    def allowed(self) -> bool:
        """Whether the enclave has the right in question."""

    @property
    def anybody(self) -> bool:
        """Whether processes without an identity have the right, too."""

    @property
    def wildcard(self) -> str:
        """The expression that allows the access, if it is a wildcard, or ""."""

    @property
    def why_stopped(self) -> str:
        """The reason that no process can run in the enclave with its current files, or ""."""

    @property
    def domains(self) -> str:
        """The ROS domains in which the enclave has the right, such as 10,20; "" for none."""

    @property
    def in_part(self) -> Sequence[str]:
        """The `influencing_parts` of an action that the enclave may use without the whole right."""

    @property
    def by_permissions_of(self) -> Sequence[str]:
        """Other enclaves whose permissions fit this enclave's certificate, and allow the access."""


_Outcome = TypeVar("_Outcome", bound=EnclaveOutcome)


class Decider(Protocol):
    """A DDS vendor, or Zenoh, with the keystore or policy that has the enclaves to decide on."""

    @property
    def title(self) -> str:
        """Name of the decider, and the reason to choose it."""

    def outcomes(self, question: Question) -> Sequence[EnclaveOutcome]:
        """Return the decision for each enclave, sorted by name."""

    def rights_naming(self, name: str) -> Iterable[Right]:
        """Return all rights to a ROS name, and perhaps further rights."""

    def printed(self, question: Question, outcomes: Sequence[Any], /) -> NamedTuple:
        """Return the outcomes in the form that ``--json`` prints."""

    def notes(self, question: Question, outcomes: Sequence[Any], /) -> Iterator[Note]:
        """Yield notes on the outcomes."""


class AnswerForAll(NamedTuple):
    """The question that was answered, the decision for each enclave, and notes."""

    question: Question
    outcomes: Sequence[Any]
    """An `EnclaveOutcome` for each enclave."""
    notes: tuple[Note, ...]

    @property
    def allowed(self) -> bool:
        """Whether any enclave, or any process without an identity, has the right."""
        return any(
            outcome.allowed or outcome.anybody or outcome.by_permissions_of
            for outcome in self.outcomes
        )


def notes_on_enclaves_left_out(keystore: OpenedKeystore) -> Iterator[Note]:
    """Yield notes on enclaves in hidden folders, and on those that an export may lack."""
    yield from notes_on_hidden_enclaves(keystore.root)
    if not is_original_keystore(keystore.root):
        text = (
            f"'{keystore.root}' is an export, which may lack enclaves: enclaves that are elsewhere "
            "may have the right, too. Ask the keystore that it comes from."
        )
        yield Note("explain.export", text)


def answer_for_all(decider: Decider, question: Question, kind: str | None) -> AnswerForAll:
    """Return the decisions on all enclaves; for the name of an action, they are about the action.

    ``kind`` is the kind of the name (topic, service or action) if the user gave it.
    """
    outcomes = decider.outcomes(question)
    taken: tuple[Note, ...] = ()
    # If an enclave has an exact right to the service, the name is a service; a wildcard shows
    # nothing.
    unclear = all(outcome.wildcard for outcome in outcomes if outcome.allowed)
    if not kind and unclear and question.type == "service":
        rights = decider.rights_naming(question.name)
        if action := question_about_action(question, rights):
            taken = notes_on_question_about_action(question, action)
            question, outcomes = action, decider.outcomes(action)
    return AnswerForAll(question, outcomes, (*taken, *decider.notes(question, outcomes)))


def note_on_callable_action(decider: Decider, question: Question) -> Note | None:
    """Return a note if enclaves may call an action with the name of the service; else None."""
    if (question.word, question.type) == ("call", "service"):
        action = ask("call", question.name, "action")
        outcomes = decider.outcomes(action)
        whole = any(outcome.allowed for outcome in outcomes)
        if whole or any(outcome.in_part for outcome in outcomes):
            does = action if whole else f"do a part of '{action}'"
            text = f"enclaves may {does}: add --type action if it is an action."
            return Note("explain.an-action", text)
    return None


def note_on_names_meant(
    decider: Decider, question: Question, enclaves: Container[str]
) -> Note | None:
    """Return a note on names of ``enclaves`` that are similar to a mistyped name, or None."""
    names = sorted(
        {
            right.name
            for right in decider.rights_naming("/")
            if right.right == question.right and right.enclave in enclaves
        }
    )
    last = question.name.rpartition("/")[2]
    exact = [name for name in names if not is_expression(name)]
    same_last = [name for name in exact if name.rpartition("/")[2] == last]
    meant = same_last or likely_names(question.name, exact)
    if not meant or question.name in meant:  # the name is right, but its enclave cannot start
        return None
    text = f"some enclaves may {question.word} {first_few(meant, 3)}: {perhaps_meant(meant)}."
    return Note("explain.likely-name", text)


def first_allowing_domain(
    outcomes: Mapping[DomainSet, _Outcome],
) -> tuple[_Outcome, str, tuple[str, ...]]:
    """Return the first decision that gives the right, or else the first decision.

    Also returns text with the domains that give the right; or, if no domain gives the right, the
    parts of an action that at least one domain gives.
    """
    allowing = [domains for domains, outcome in outcomes.items() if outcome.allowed]
    shown = DomainSet.of(*((d, d) for domains in allowing for d in domains)) if allowing else ""
    in_part = () if allowing else dict.fromkeys(p for o in outcomes.values() for p in o.in_part)
    return outcomes[next(iter(allowing or outcomes))], str(shown), tuple(in_part)


def decide_each(names: Sequence[str], decide: Callable[[str], _Outcome]) -> tuple[_Outcome, ...]:
    """Return the decisions on the enclaves, sorted by name; uses all cores."""
    from sros_tool.parallel import map_slices, tick  # not needed for one enclave

    def work(part: Sequence[str]) -> list[_Outcome]:
        outcomes = []
        for name in part:
            outcomes.append(decide(name))
            tick()
        return outcomes

    outcomes = [outcome for _, part in map_slices(names, work) for outcome in part]
    return tuple(sorted(outcomes, key=lambda outcome: outcome.enclave))


# ── whom an enclave reaches ────────────────────────────────────────────────────────────────


class ReachedStep(NamedTuple):
    """A step of a path: an enclave sends, and another enclave receives."""

    from_: str
    """The enclave that sends."""
    to: str
    """The enclave that receives."""
    kind: str
    """Kind of the name: topic, service or action."""
    right: str
    """The right that the sender uses."""
    name: str
    """The ROS name."""
    said: str
    """The name or wildcard in the rights of the sender."""
    heard: str
    """The name or wildcard in the rights of the receiver."""


class ReachedEnclave(NamedTuple):
    """An enclave that can be reached, and the path to it."""

    enclave: str
    """Name of the enclave."""
    path: Sequence[ReachedStep]
    """A shortest path, step by step."""


@shows("path", "left_out", "domain", "enclave", "influences", "learns_from")
class FollowedReach(NamedTuple):
    """The enclaves that an enclave can influence, and the enclaves from which it can learn."""

    path: Path
    """Path of the keystore or policy."""
    left_out: Sequence[str]
    """Names that do not count: topics of every node, and services (as */NAME) whose requests only
    ask.
    """
    domain: int | None
    """The ROS domain in which information flows; null for every domain."""
    reach: Reach
    fleet: Fleet | None
    notes: Sequence[Note]

    @property
    def enclave(self) -> str:
        """The enclave."""
        return self.reach.enclave

    @property
    def influences(self) -> list[ReachedEnclave]:
        """The enclaves that the enclave can influence."""
        return list(_reached_enclaves(self.reach.influences))

    @property
    def learns_from(self) -> list[ReachedEnclave]:
        """The enclaves that the enclave can learn from."""
        return list(_reached_enclaves(self.reach.learns_from))


def _reached_enclaves(paths: Mapping[str, HopPath]) -> Iterator[ReachedEnclave]:
    for enclave, path in sorted(paths.items()):
        yield ReachedEnclave(enclave, [ReachedStep(*hop) for hop in path])


def follow_reach(
    source: RightsSource, enclave: str, *, infrastructure: bool, domain: int | None = None
) -> FollowedReach:
    """Return the enclaves that an enclave can influence and learn from, by the rights of a source.

    ``infrastructure`` says whether to include topics that every node has, and requests that only
    read. Information goes from enclave to enclave in any common ROS domain, or only in ``domain``.

    Raises:
        KeystoreError: the keystore does not have the enclave, or the enclave has no rights.
    """
    of_keystore = source.kind == "keystore"
    if of_keystore and not is_original_keystore(source.path):
        raise KeystoreError(
            f"'{source.path}' is an export, which may lack enclaves",
            "Information can also flow through enclaves that it does not have.",
            "Ask the keystore that it comes from.",
        )
    names = enclave_names(source.path) if of_keystore or source.kind == "zenoh" else ()
    without, questions = ((), ()) if infrastructure else (OF_EVERY_NODE, QUESTIONS)
    rights = {
        domains: (*some, *_rights_of_router(source, some, enclave))
        for domains, some in rights_by_domains(source).items()
        if domain is None or domains is None or domain in domains
    }
    opened = tuple(unguarded_topics(OpenedKeystore(source.path).governance)) if of_keystore else ()
    network = Network(
        rights,
        excluded=without,
        questions=questions,
        unguarded=opened if domain is None else _access_in_domain(opened, domain),
        everybody=names if of_keystore else (),
        links=source.links,
    )
    if names and enclave not in names:
        raise missing_enclave_error(OpenedKeystore(source.path), enclave, names)
    if enclave not in network.enclaves:
        meant = likely_names(enclave, network.enclaves)
        where = "" if domain is None else f", domain {domain}"
        raise KeystoreError(
            f"enclave {enclave} has no rights in '{source.path}'{where}",
            f"Enclaves with rights: {', '.join(network.enclaves[:5]) or 'none'}.",
            f"Perhaps you mean {' or '.join(meant)}." if meant else "",
        )
    reach = network.reach(enclave)
    # Reach follows each domain, so this note does not apply.
    notes = [note for note in source.notes if note.id != "rights.domains"]
    if of_keystore and _admits_processes_without_identity(OpenedKeystore(source.path).governance):
        refuse = remedy_in_keystore(source.path, f"Run {REFUSE_STRANGERS}.")
        text = (
            "processes without an identity may use some names, too, because the governance admits "
            f"them: their influence is not followed. {refuse}"
        )
        notes.append(Note("explain.anybody", text))
    if of_keystore and (holders := _enclaves_with_fitting_permissions(source, enclave)):
        text = (
            f"on Cyclone DDS, whoever has the key of {enclave} can also use the permissions of "
            f"{first_few(holders, 3)}, which fit the certificate of {enclave}, too: this is not "
            "followed."
        )
        notes.append(Note("explain.fitting-permissions", text))
    if source.routers and enclave not in source.routers:
        routers = first_few(list(source.routers), 3)
        text = (
            f"whoever has the key of a router ({routers}) can send and read everything that passes "
            "through this router, whatever the permissions say. This is not followed: `--reach "
            f"{source.routers[0]}` shows whom the router reaches."
        )
        notes.append(Note("explain.zenoh-router", text))
    return FollowedReach(source.path, (*without, *questions), domain, reach, source.fleet, notes)


def _enclaves_with_fitting_permissions(source: RightsSource, enclave: str) -> list[str]:
    """Return the other enclaves of a keystore whose permissions fit an enclave's certificate.

    Compares only enclaves whose paths have all parts of the enclave's path.
    """
    parts = {*enclave.split("/")}
    granted = {
        name: [grant.subject for grant in permissions.grants]
        for name, permissions in source.documents.items()
        if name != enclave and parts <= {*name.split("/")}
    }
    file = enclave_path(source.path, enclave) / CERTIFICATE_FILE
    if not granted:
        return []
    try:
        certificate = load_certificate(read_bytes(file, "certificate"), f"'{file}'")
    except SrosError:  # no process can use an unreadable certificate
        return []
    certified = {enclave: subject_text(certificate.subject)}
    fitting = (other_fitting_enclaves(v.traits, certified, granted) for v in CYCLONE_DDS)
    return sorted({holder for of in fitting for holder in of.get(enclave, ())})


def _admits_processes_without_identity(governance: Governance) -> bool:
    """Return whether a tested DDS vendor lets processes without an identity use some name."""
    return any(
        is_open_to_unauthenticated(domain, rule, vendor)
        for domain in governance.domain_access_rules
        for rule in domain.topic_access_rules
        for vendor in TESTED
    )


def _access_in_domain(unguarded_access: Iterable[Unguarded], domain: int) -> Iterator[Unguarded]:
    """Yield the access that the governance of a domain leaves open, as rights in this domain."""
    only = DomainSet.of((domain, domain))
    for topics in unguarded_access:
        if topics.domains is None or domain in topics.domains:
            yield replace(topics, domains=only)


def _rights_of_router(
    source: RightsSource, rights: Iterable[Right], router: str
) -> Iterator[Right]:
    """Yield rights to all that a router may send and receive; nothing for any other enclave.

    By ``rights``, a router may receive what its enclaves may send, and send what its enclaves may
    receive. The router also has the rights that other routers give.
    """
    if router not in source.routers:
        return
    links = source.links
    for right in rights:
        if right.qualifier is ALLOW and (
            links is None or links.router_of.get(right.enclave) == router
        ):
            yield right.peer_right(router)
    for passing in links.passing.values() if links else ():
        for right in passing:
            if right.qualifier is ALLOW and right.enclave == router:
                yield right
