"""Decide on rights as Zenoh does: by the configurations in a keystore, link by link.

Zenoh reports no denial as an error: a process that denies a message drops it.  In client mode, the
router and the session itself decide on a right; in peer mode, the sessions of all other enclaves
decide.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from enum import StrEnum
from functools import cache
from pathlib import Path
from shlex import quote
from typing import Annotated, Literal, NamedTuple

from sros_tool.dds.decision.vendors import Vendor
from sros_tool.dds.domains import DomainSet
from sros_tool.errors import KeystoreError, Note, SrosError, UsageError
from sros_tool.explain.answer import (
    Answer,
    Evaluator,
    PolicyChange,
    Question,
    StatedInPolicy,
    influencing_parts,
    text_of_parts,
)
from sros_tool.explain.asking import (
    AskedEnclave,
    AskedQuestion,
    AskingContext,
    ZenohInBrief,
    note_on_action,
    note_on_lacking_keys,
    question_meant,
    rights_naming,
)
from sros_tool.explain.explanation import explain
from sros_tool.faults import Fault
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    IDENTITY_CA_FILE,
    KEY_FILE,
    PERMISSIONS,
    PERMISSIONS_CA_FILE,
    PUBLIC,
    ROUTER_FILE,
    SESSION_FILE,
    enclave_path,
    has_zenoh_files,
    is_keystore,
    is_original_keystore,
    remedy_in_keystore,
)
from sros_tool.keystore.participant import JoinContext
from sros_tool.keystore.reader import OpenedKeystore, Problem
from sros_tool.keystore.rights import check_routers
from sros_tool.keystore.selection import missing_enclave_error
from sros_tool.keystore.zenoh_files import (
    Drift,
    enclaves_with_rights,
    is_signed,
    signed_path,
    zenoh_drift,
)
from sros_tool.pki.certificates import common_name_of, validity_of
from sros_tool.policy.model import ALLOW
from sros_tool.policy.rights import Right, parts
from sros_tool.translate_zenoh.graph import GRAPH, example_token
from sros_tool.translate_zenoh.rights import ANY_TYPE, untyped
from sros_tool.values import shows
from sros_tool.zenoh.access import AccessControl, Enforcement, Flow, Message, MessageFilter, Remote
from sros_tool.zenoh.configuration import Mode, RenderedReader
from sros_tool.zenoh.delivery import (
    Check,
    Delivery,
    Route,
    ZenohProcess,
    query_delivery,
    route,
    sample_delivery,
    token_delivery,
)
from sros_tool.zenoh.document import ZenohEndpoint, parse_configuration
from sros_tool.zenoh.key_expressions import includes

_TLS_FILES = (CERTIFICATE_FILE, KEY_FILE, IDENTITY_CA_FILE)
"""Names of the enclave files that a process on Zenoh needs for TLS."""


class _Outcome(StrEnum):
    """The outcome for an enclave's messages on Zenoh."""

    ALLOWED = "allowed"
    DROPPED = "dropped"
    """A process on a link drops the messages, and no process gets an error."""
    REFUSED = "refused"
    """The process of the enclave opens no session, or gets no link."""

    @property
    def ok(self) -> bool:
        """Whether data can flow."""
        return self is _Outcome.ALLOWED


class ZenohFile(NamedTuple):
    """The configuration of an enclave's process, as read from the keystore.

    ``process`` is None if the process opens no session, for the reason ``problem``.  ``until`` is
    the time at which the certificate expires.  ``endpoints`` are the addresses to which a session
    connects, or at which a router listens.
    """

    enclave: str
    file: str
    process: ZenohProcess | None
    problem: str
    until: datetime | None = None
    endpoints: tuple[ZenohEndpoint, ...] = ()


@shows("enclave", "problem", null_if_empty=("problem",))
class ReachableEnclave(NamedTuple):
    """An enclave that has the right at the other end, such as to subscribe to a published topic."""

    enclave: str
    """The enclave."""
    deliveries: tuple[Delivery, ...]
    problem: str
    """Why the process of the enclave opens no session; empty (null in JSON) if it opens one."""


class DecidingWildcard(NamedTuple):
    """A key expression with a wildcard on which the decision depends."""

    expression: str
    """The key expression."""
    reaches: tuple[str, ...]
    """The enclaves that receive a put or a query with this key expression."""


class CheckedLink(NamedTuple):
    """A link between two processes on which a right is decided."""

    enclaves: tuple[str, str]
    """The enclaves at both ends."""
    passes: bool
    """Whether every message passes."""
    checks: tuple[Check, ...]
    """The decisions on the messages, in order."""


_OutcomeWord = Annotated[
    _Outcome,
    "What happens: messages vanish (`dropped`), or the process opens no session (`refused`).",
]


@shows(
    *("in_brief", "outcome", "links", "reached", "wildcards", "until", "unsigned"),
    spread=("in_brief",),
)
@dataclass(frozen=True, slots=True)
class ZenohAnswer:
    """The decision of Zenoh on a question about an enclave.

    ``text`` is the reason, as a clause.  ``checks`` are the decisions on the messages of the right
    itself.  ``domains`` are the ROS domains in which the right is allowed, if several domains were
    decided.
    """

    enclave: str
    question: Question
    mode: Mode | None
    outcome: _OutcomeWord
    text: str
    checks: tuple[Check, ...] = ()
    reached: tuple[ReachableEnclave, ...] = ()
    """The enclaves with the matching right, such as the right to subscribe to a published topic.
    """
    wildcards: tuple[DecidingWildcard, ...] = ()
    """Key expressions with wildcards on which the decision depends."""
    until: datetime | None = None
    """The expiry of the certificate, or null."""
    unsigned: tuple[str, ...] = ()
    """The deciding files that the permissions CA has not signed."""
    domains: str = ""
    in_part: tuple[str, ...] = ()
    """If the enclave has only a part of a right to an action: the parts, such as ``send_goal``,
    with which it can command the server (for ``call``) or inform the clients (for ``execute``).
    """

    @property
    def anybody(self) -> bool:
        """Whether the rules also give the right to processes without an identity."""
        return False

    @property
    def by_permissions_of(self) -> tuple[str, ...]:
        """Always empty: Zenoh reads no permissions."""
        return ()

    @property
    def in_brief(self) -> ZenohInBrief:
        """The decision of Zenoh, with its reason as a clause."""
        mode = self.mode.value if self.mode else None
        return ZenohInBrief(self.allowed, mode, self.text, self.outcome)

    @property
    def allowed(self) -> bool:
        """Whether data can flow."""
        return self.outcome.ok

    @property
    def wildcard(self) -> str:
        """The first key expression with a wildcard that decides a check, or ""."""
        return self.wildcards[0].expression if self.wildcards else ""

    @property
    def why_stopped(self) -> str:
        """The reason that the enclave's process opens no session, or ""."""
        return self.text if self.outcome is _Outcome.REFUSED else ""

    @property
    def is_of_router(self) -> bool:
        """Whether the enclave is the enclave of a router."""
        return self.mode is Mode.ROUTER

    @property
    def dropping_check(self) -> Check | None:
        """The check that drops a message, or None; `_check_to_report` chooses from several."""
        return _check_to_report((check for check in self.checks if not check.allowed), self.enclave)

    @property
    def deciding(self) -> Check | None:
        """The check whose rule decides the answer; None without checks."""
        return self.dropping_check or _check_to_report(self.checks, self.enclave)

    @property
    def links(self) -> tuple[CheckedLink, ...]:
        """The links on which the right is decided."""
        by_ends: dict[tuple[str, str], list[Check]] = {}
        for check in self.checks:
            other = check.remote if check.enforcer == self.enclave else check.enforcer
            by_ends.setdefault((self.enclave, other), []).append(check)
        return tuple(
            CheckedLink(ends, all(check.allowed for check in checks), tuple(checks))
            for ends, checks in by_ends.items()
        )


@shows(
    *("enclave", "in_brief", "in_part", "outcome", "wildcard", "domains"),
    null_if_empty=("wildcard", "domains"),
    spread=("in_brief",),
)
class ZenohEnclaveOutcome(NamedTuple):
    """The decision of Zenoh for one enclave."""

    enclave: str
    """The enclave."""
    in_brief: ZenohInBrief
    outcome: _OutcomeWord
    wildcard: str
    """The key expression that allows the right, if it is a wildcard; otherwise empty (null in
    JSON).
    """
    domains: str
    """The ROS domains in which the enclave has the right, such as ``10`` or ``10,20``.

    Empty (null in JSON) if the enclave has the right in no domain.
    """
    in_part: Sequence[str] = ()
    """If the enclave has only a part of a right to an action: the parts, such as ``send_goal``,
    with which it can command the server (for ``call``) or inform the clients (for ``execute``).
    """


class WhoOnZenoh(NamedTuple):
    """The decision of Zenoh for every enclave of a keystore."""

    question: str
    """The question."""
    vendor: Literal["zenoh"]
    """Always ``"zenoh"``."""
    vendor_why: str
    """Reason for the choice of Zenoh."""
    domain: int | None
    """The ROS domain of ``--domain``; null for every domain."""
    enclaves: Sequence[ZenohEnclaveOutcome]
    """All enclaves. The enclave of the router may do whatever passes through the router."""
    export: bool = False
    """Whether the question was about an export, which may lack enclaves of its keystore."""


class ZenohEvaluator:
    """An evaluator of questions about the enclaves of a keystore, reusable for many questions.

    Raises `KeystoreError` if the keystore has no Zenoh configurations, no configuration of a
    router, or routers without connection: the enforced rules are then unknown.
    """

    def __init__(
        self, keystore: OpenedKeystore, *, moment: datetime, domain: int, joining: bool = False
    ) -> None:
        """Read the routers.

        In a copy of a keystore without keys, all keys count as present, unless the question is
        whether an enclave may join (``joining``).
        """
        keystore.check()
        self._counts_keys = not (joining or keystore.has_keys)
        self.keystore = keystore
        self.root = keystore.root
        self.domain = domain
        self.names = keystore.names
        self._at = moment
        self._file = cache(self._read)
        self._rendered = RenderedReader()
        self._is_signed = cache(self._is_verified)
        self.routers = self._routers()

    def _routers(self) -> dict[str, ZenohFile]:
        """Map the enclaves of routers to their files.

        There is a single router, or there are several routers with connections to each other.

        Raises:
            KeystoreError: no router has a file, or the file of a router has no rules for another
            router with a file (`check_routers`).
        """
        routers = {
            name: self._file(name, ROUTER_FILE)
            for name in self.names
            if (enclave_path(self.root, name) / ROUTER_FILE).exists()
        }
        if routers:
            known = {
                name: file.process.access.names() for name, file in routers.items() if file.process
            }
            check_routers(self.keystore, known)
            return routers
        if has_zenoh_files(self.root):
            raise KeystoreError(
                f"keystore '{self.root}' has no {ROUTER_FILE}",
                "sros cannot know what the router enforces without the router's file.",
                "Ask about the keystore that this one was exported from, or write the files again. "
                f"{remedy_in_keystore(self.root, 'Run `sros zenoh KEYSTORE`.')}",
            )
        raise KeystoreError(
            f"keystore '{self.root}' has no Zenoh configurations",
            "Without these files, nodes in its enclaves cannot open a session; with the default "
            "files of rmw_zenoh, nodes run without any access control.",
            remedy_in_keystore(self.root, "Run `sros zenoh KEYSTORE`."),
        )

    def _router_of(self, enclave: str) -> ZenohFile:
        """Return the file of the router whose rules name an enclave, or of the first router."""
        for file in self.routers.values():
            if file.process and file.process.access.number_of_rules(enclave):
                return file
        return next(iter(self.routers.values()))

    def answer(
        self, enclave: str, question: Question, *, reach: bool = True, brief: bool = False
    ) -> ZenohAnswer:
        """Return the answer for one enclave.

        Args:
            enclave: the enclave.
            question: the question on a right.
            reach: also list the enclaves that have the matching right.
            brief: do not list unsigned files, and read the router's file in place of the files of
                peers, which have the same rights.
        """
        if enclave not in self.names:
            raise missing_enclave_error(self.keystore, enclave, self.names)
        own_file = self._file(enclave, self._file_of(enclave))
        answer = ZenohAnswer(
            enclave,
            question,
            own_file.process.mode if own_file.process else None,
            _Outcome.REFUSED,
            own_file.problem,
            until=own_file.until,
            unsigned=() if brief else self.unsigned_files(own_file),
        )
        if own_file.process is None:
            return answer
        if own_file.process.mode is Mode.ROUTER:
            return self._answer_for_router(answer, own_file.process, brief=brief)
        router = self._router_of(enclave)
        if router.process is None:
            text = f"no link to the router {router.enclave}: {router.problem}"
            return replace(answer, text=text)
        if not _addresses_meet(own_file.endpoints, router.endpoints):
            places = _places_text(own_file.endpoints)
            text = f"no link to the router: {own_file.file} connects to {places}, and "
            text += f"{ROUTER_FILE} listens at {_places_text(router.endpoints)}"
            return replace(answer, text=text)
        wanted = self._rights(enclave, question)
        checks = self._deciding_checks(own_file.process, router.process, wanted, brief=brief)
        answer = replace(answer, checks=checks)
        text = self._reason_text(answer.deciding)
        if answer.dropping_check:
            return replace(answer, outcome=_Outcome.DROPPED, text=text)
        reached = tuple(self._reached_enclaves(own_file, wanted)) if reach else ()
        return replace(
            answer,
            outcome=_Outcome.ALLOWED,
            text=text,
            reached=reached,
            wildcards=tuple(self._wildcards(own_file.process, wanted, checks, reached)),
        )

    def with_parts(self, answer: ZenohAnswer, *, brief: bool) -> ZenohAnswer:
        """Return a denial with the parts of the action that the enclave may use.

        Other answers are returned unchanged.

        For ``brief``, see `ZenohEvaluator.answer`.
        """
        if answer.outcome is not _Outcome.DROPPED:
            return answer
        parts = influencing_parts(answer.question).items()
        passing = [part for part, asked in parts if self._passes_part(answer.enclave, asked, brief)]
        return replace(answer, in_part=tuple(passing))

    def _passes_part(self, enclave: str, part: Question, brief: bool) -> bool:
        """Return whether Zenoh passes the data of an action's part.

        For a call, only the request counts, not the reply.
        """
        answer = self.answer(enclave, part, reach=False, brief=brief)
        needed = [c for c in answer.checks if part.word == "reply" or c.message != Message.REPLY]
        return bool(needed) and all(check.allowed for check in needed)

    def _reason_text(self, check: Check | None) -> str:
        """Return a clause that names the deciding check, its reason, and the file with the rule."""
        assert check
        file = self._file_of(check.enforcer)
        return f"{check}: {check.decision.why}, in {file} of {check.enforcer}"

    def outdated_files(self, answer: ZenohAnswer) -> tuple[str, ...] | None:
        """Return the deciding files of an answer that do not match the permissions.

        Only the rules that concern the question are compared.  Returns None if the files cannot be
        compared, as in an export.
        """
        try:
            network = self.keystore.template.zenoh
            if network is None:
                return None
            domains = self.keystore.domains
            authority = self.keystore.ca_certificate(PERMISSIONS)
            ours = {answer.enclave, *self.routers}
            deciding = ours | {check.enforcer for check in answer.checks}
            ends = self._enclaves_at_other_end(answer)
            if answer.mode is not Mode.CLIENT:
                deciding |= ends
            drifts = zenoh_drift(
                self.keystore,
                network,
                domains,
                authority,
                self._at,
                only_enclaves=deciding,
                # With several routers, what may pass between them depends on all enclaves.
                among=() if network.routers else deciding | self._enclaves_to_check(answer, ends),
                reader=self._rendered,
            ).files
        except SrosError:
            return None
        return tuple(
            sorted(
                signed_path(drift.path) if drift.kind is Drift.UNSIGNED else drift.path
                for drift in drifts
                # Unsigned files of the enclave itself and of the routers are reported elsewhere.
                if drift.enclave in deciding
                and not (drift.kind is Drift.UNSIGNED and drift.enclave in ours)
            )
        )

    def _enclaves_at_other_end(self, answer: ZenohAnswer) -> set[str]:
        """Return the enclaves with which an enclave may exchange the messages of the question.

        The enclave's file decides; for a client, the file of its router.
        """
        process = self._file(answer.enclave, self._file_of(answer.enclave)).process
        wanted = self._rights(answer.enclave, answer.question)
        if process is None or not wanted or (process.mode is Mode.CLIENT and not answer.allowed):
            return set()
        return {
            name
            for name in self.names
            if all(
                delivery.arrives
                for delivery in (
                    self._deliveries_between(
                        process, _unrestricted_process(name, Mode.CLIENT), wanted
                    )
                    if process.mode is Mode.CLIENT
                    else self._direct_deliveries(
                        process, _unrestricted_process(name, Mode.PEER), wanted
                    )
                )
            )
        }

    def _enclaves_to_check(self, answer: ZenohAnswer, ends: set[str]) -> set[str]:
        """Return the enclaves on whose rights an answer depends.

        A denial depends only on the enclave's own rights.  ``ends`` are the enclaves at the other
        end.
        """
        if not answer.allowed and not answer.is_of_router:
            return set()
        wanted = self._rights(answer.enclave, answer.question)
        return ends | enclaves_with_rights(self.keystore, {right.name for right in wanted})

    # ── files ──────────────────────────────────────────────────────────────────────────────

    def _file_of(self, enclave: str) -> str:
        return ROUTER_FILE if enclave in self.routers else SESSION_FILE

    def _read(self, enclave: str, file: str) -> ZenohFile:
        """Return the configuration of an enclave's process, or why it opens no session."""
        folder = enclave_path(self.root, enclave)
        if not (folder / file).exists():
            return _unusable_file(enclave, file, f"it has no {file}: its processes open no session")
        try:
            mode, access, endpoints = self._configuration(folder / file)
        except SrosError as error:
            return _unusable_file(
                enclave, file, f"Zenoh does not accept its {file}: {error.why}".strip()
            )
        identity = self.keystore.identity(enclave, now=self._at)
        certificate = identity.certificate
        faults = [
            problem
            for problem in identity.problems
            if problem.file in _TLS_FILES and not self._is_left_out(problem)
        ]
        if faults or certificate is None:
            problem = str(faults[0]) if faults else f"{CERTIFICATE_FILE} cannot be read"
            return _unusable_file(enclave, file, problem)
        name = common_name_of(certificate.subject) or ""
        if name != enclave:
            problem = f"Zenoh knows its processes by the common name {name!r} of {CERTIFICATE_FILE}"
            return _unusable_file(enclave, file, problem)
        until = validity_of(certificate).not_after
        return ZenohFile(enclave, file, ZenohProcess(name, mode, access), "", until, endpoints)

    def _is_left_out(self, problem: Problem) -> bool:
        """Return whether the problem is a missing key, in a copy of the keystore without keys."""
        lacks_key = (problem.file, problem.fault) == (KEY_FILE, Fault.FILE_MISSING)
        return lacks_key and self._counts_keys

    def _configuration(self, path: Path) -> tuple[Mode, MessageFilter, tuple[ZenohEndpoint, ...]]:
        """Return a process's mode, its access control, and its endpoints."""
        data = self.keystore.read(path, "Zenoh configuration")
        rendered = self._rendered.read(data)
        if rendered:
            texts = rendered.listen if rendered.mode is Mode.ROUTER else rendered.connect
            return rendered.mode, rendered.access_control, tuple(map(ZenohEndpoint, texts))
        document = parse_configuration(data, str(path), lines=False)
        endpoints = document.listen if document.mode is Mode.ROUTER else document.connect
        return document.mode, document.access, endpoints

    def _is_verified(self, path: Path) -> bool:
        try:
            document = self.keystore.read(path, "Zenoh configuration")
            authority = (
                self.keystore.ca_certificate(PERMISSIONS)
                if self.keystore.has(PUBLIC)
                else self.keystore.certificate(path.with_name(PERMISSIONS_CA_FILE))  # an export
            )
            return is_signed(path, document, authority, self.keystore.files)
        except SrosError:
            return False

    def unsigned_files(self, *zenoh_files: ZenohFile) -> tuple[str, ...]:
        """Return the files of processes and of routers that no permissions CA has signed."""
        return tuple(
            f"{file.enclave}/{file.file}"
            for file in dict.fromkeys((*zenoh_files, *self.routers.values()))
            if file.process
            and not self._is_signed(enclave_path(self.root, file.enclave) / file.file)
        )

    # ── decisions ──────────────────────────────────────────────────────────────────────────

    def _answer_for_router(
        self, answer: ZenohAnswer, process: ZenohProcess, *, brief: bool
    ) -> ZenohAnswer:
        """Return the answer for a router's enclave, which may use all that passes the router.

        Every session that may receive a message accepts it from the router, and also from a second
        process that has the router's key.
        """
        wanted = self._rights(answer.enclave, answer.question)
        believing: list[ReachableEnclave] = []
        for name in self.names if wanted else ():
            if name == process.name:
                continue
            # The router's rules, already read, state the same rights.
            deliveries = self._direct_deliveries(
                process, _unrestricted_process(name, Mode.CLIENT), wanted
            )
            other = self._file(name, self._file_of(name)) if not brief else None
            if other and other.process and all(delivery.arrives for delivery in deliveries):
                unrestricted = _unrestricted_process(process.name, Mode.ROUTER)
                deliveries = self._direct_deliveries(unrestricted, other.process, wanted)
            if all(delivery.arrives for delivery in deliveries):
                believing.append(ReachableEnclave(name, deliveries, other.problem if other else ""))
                if brief:
                    break
        if not believing:
            text = "a router only forwards messages, and no session accepts such a message from it"
            return replace(answer, outcome=_Outcome.DROPPED, text=text)
        checks = tuple(
            check
            for delivery in believing[0].deliveries
            for check in (*delivery.checks, *delivery.replies)
            if check.enforcer != process.name
        )
        text = (
            "sessions trust anyone with the router's key about everything that passes through the "
            "router"
        )
        return replace(
            answer,
            outcome=_Outcome.ALLOWED,
            text=text,
            checks=checks if not brief else (),
            reached=tuple(believing) if not brief else (),
        )

    def _direct_deliveries(
        self, process: ZenohProcess, other: ZenohProcess, wanted_rights: Sequence[Right]
    ) -> tuple[Delivery, ...]:
        return tuple(self._delivery((process, other), right) for right in wanted_rights)

    def _deciding_checks(
        self,
        process: ZenohProcess,
        router: ZenohProcess,
        wanted_rights: Sequence[Right],
        *,
        brief: bool,
    ) -> tuple[Check, ...]:
        """Return the checks that decide on the rights of an enclave.

        These are the checks on the enclave's link with the router.  If the router denies a right in
        peer mode, these are the checks on the enclave's link with the first peer that allows the
        right.
        """
        checks = tuple(self._link_checks(process, router, wanted_rights))
        if process.mode is not Mode.PEER or brief or all(check.allowed for check in checks):
            return checks
        for name in self.names:
            if name == process.name or name in self.routers:
                continue
            # The session's own decision comes first, because it needs no other file.
            alone = self._link_checks(
                process, _unrestricted_process(name, Mode.PEER), wanted_rights
            )
            if all(check.allowed for check in alone):
                other = self._file(name, SESSION_FILE).process
                if other and other.mode is Mode.PEER:
                    direct = tuple(self._link_checks(process, other, wanted_rights))
                    if all(check.allowed for check in direct):
                        return direct
        return checks

    def _rights(self, enclave: str, question: Question) -> tuple[Right, ...]:
        """Return the rights that a question needs; () for a question about joining."""
        return parts(Right(enclave, ALLOW, question.right, question.name)) if question.right else ()

    def _link_checks(
        self, process: ZenohProcess, other: ZenohProcess, wanted_rights: Sequence[Right]
    ) -> Iterator[Check]:
        """Yield the checks by which both ends of a link decide on rights, or on joining."""
        deliveries = self._direct_deliveries(process, other, wanted_rights)
        for delivery in deliveries or self._graph_deliveries(process, other):
            yield from (*delivery.checks, *delivery.replies)

    def _delivery(self, route: Route, right: Right, key: str = "") -> Delivery:
        """Return the delivery of a message, by a right of the first process on ``route``.

        ``key`` is the key of the message; "" stands for the key of the right.
        """
        key = key or f"{self.domain}{right.name}/{ANY_TYPE}"
        match right.right:
            case "publish":
                return sample_delivery(route, key)
            case "subscribe":
                return sample_delivery(route[::-1], key)
            case "request":
                return query_delivery(route, key)
            case _:
                return query_delivery(route[::-1], key)

    def _graph_deliveries(
        self, process: ZenohProcess, other: ZenohProcess
    ) -> tuple[Delivery, Delivery]:
        """Return two deliveries: of a token of ``process``, and of other tokens to ``process``."""
        whole_domain = f"@ros2_lv/{self.domain}/**"
        router = self._router_of(process.name).process
        assert router
        access, announcing = router.access, (Flow.INGRESS, Message.LIVELINESS_TOKEN)
        node = example_token(
            self.domain,
            process.name,
            access.allowed_keys(process.name, *announcing),
            lambda key: access.decide(Remote(process.name), *announcing, key).allowed,
        )
        return token_delivery((process, other), node, whole_domain), token_delivery(
            (other, process), whole_domain, whole_domain
        )

    def _reached_enclaves(
        self, zenoh_file: ZenohFile, wanted_rights: Sequence[Right]
    ) -> Iterator[ReachableEnclave]:
        """Yield the enclaves whose rules let them exchange the messages of ``wanted_rights``.

        The other end is the process of ``zenoh_file``.
        """
        for name in self.names if wanted_rights else ():
            if name == zenoh_file.enclave or name in self.routers:
                continue
            assert zenoh_file.process
            # The decision of the other processes comes first, because it needs no file of that
            # enclave.
            deliveries = self._deliveries_between(
                zenoh_file.process,
                _unrestricted_process(name, zenoh_file.process.mode),
                wanted_rights,
            )
            if not all(delivery.arrives for delivery in deliveries):
                continue
            other = self._file(name, SESSION_FILE)
            if other.process:
                deliveries = self._deliveries_between(
                    zenoh_file.process, other.process, wanted_rights
                )
            if all(delivery.arrives for delivery in deliveries):
                yield ReachableEnclave(name, deliveries, other.problem)

    def _deliveries_between(
        self,
        own_process: ZenohProcess,
        other: ZenohProcess,
        wanted_rights: Sequence[Right],
        key: str = "",
    ) -> tuple[Delivery, ...]:
        ends = [self._router_of(process.name).process for process in (own_process, other)]
        routers = [router for router in ends if router]
        way = route(own_process, other, routers[0], routers[-1])
        return tuple(self._delivery(way, right, key) for right in wanted_rights)

    def _wildcards(
        self,
        process: ZenohProcess,
        wanted_rights: Sequence[Right],
        checks: Sequence[Check],
        reached_enclaves: Sequence[ReachableEnclave],
    ) -> Iterator[DecidingWildcard]:
        """Yield the deciding wildcards, with the enclaves that a message on the wildcard reaches.

        Only a put or a query can have a wildcard as its key, and passes only if a rule includes the
        whole wildcard.
        """
        asked = [right for right in wanted_rights if right.right in ("publish", "request")]
        for wide in dict.fromkeys(filter(None, map(self._wildcard, checks))):
            enclaves = [
                reached.enclave
                for reached in reached_enclaves
                if (other := self._file(reached.enclave, SESSION_FILE).process)
                and any(
                    delivery.arrives
                    for delivery in self._deliveries_between(process, other, asked, wide)
                )
            ]
            yield DecidingWildcard(wide, tuple(enclaves))

    def _wildcard(self, check: Check) -> str:
        """Return the key expression that allows the data; "" if its name has no wildcard."""
        if check.message not in (Message.PUT, Message.QUERY) or not check.decision.rules:
            return ""
        file = self._file(check.enforcer, self._file_of(check.enforcer))
        if not file.process:
            return ""
        keys = file.process.access.key_expressions_of(check.decision.rules[0])
        wide = next((key for key in keys if includes(key, check.key)), "")
        return wide if "*" in untyped(wide).removesuffix("/*/*") else ""


def _unrestricted_process(enclave: str, mode: Mode) -> ZenohProcess:
    return ZenohProcess(enclave, mode, Enforcement())


_DATA_MESSAGES = (Message.PUT, Message.QUERY, Message.LIVELINESS_TOKEN)
"""The messages that transport data or announce a node; other messages only prepare these."""


def _check_to_report(checks: Iterable[Check], enclave: str) -> Check | None:
    """Return the check that an answer reports; None without checks.

    Checks of data come before other checks; then checks by other enclaves come before checks by
    ``enclave`` itself.
    """
    return min(
        checks,
        key=lambda check: (check.message not in _DATA_MESSAGES, check.enforcer == enclave),
        default=None,
    )


def _addresses_meet(connect: Sequence[ZenohEndpoint], listen: Sequence[ZenohEndpoint]) -> bool:
    """Return whether a process may connect to an address at which another process listens.

    Only ports and protocols are compared: a host can have several names.
    """
    ports = {(endpoint.protocol, endpoint.address.rpartition(":")[2]) for endpoint in listen}
    return any(
        (endpoint.protocol, endpoint.address.rpartition(":")[2]) in ports for endpoint in connect
    )


def _places_text(endpoints: Sequence[ZenohEndpoint]) -> str:
    return ", ".join(endpoint.text for endpoint in endpoints[:3]) or "nothing"


def _unusable_file(enclave: str, file: str, problem: str) -> ZenohFile:
    return ZenohFile(enclave, file, None, problem)


# ── all enclaves ───────────────────────────────────────────────────────────────────────────


_ROUTERS_KEY = Note(
    "explain.zenoh-router",
    "anyone with the router's key may send and receive everything that passes through the "
    "router, whatever the router's permissions say, because forwarding needs this. In peer "
    "mode, every session also trusts a second process with that key, besides the router. Give "
    "the key to no other process.",
)


def _domains(keystore: OpenedKeystore, now: datetime) -> DomainSet:
    """Return the ROS domains of a keystore; for an export, the domains in its enclaves' governance.

    Without any governance, return domain 0.
    """
    if keystore.has_all_enclaves:
        return keystore.domains
    governed = (keystore.enclave(name, now=now).domains() for name in keystore.names)
    numbers = {number for domains in governed if domains for number in domains}
    return DomainSet.of(*((number, number) for number in numbers or {0}))


def _with_equal_rules(evaluator: ZenohEvaluator, domains: DomainSet) -> Iterator[DomainSet]:
    """Yield parts of ``domains``; routers have the same rules in all domains of a part."""
    keys: dict[str, set[object]] = defaultdict(set)
    for router, file in evaluator.routers.items():
        for rule, expressions in _rules(file.process.access) if file.process else ():
            for key in expressions:
                domain, _, rest = key.removeprefix(f"{GRAPH}/").partition("/")
                keys[domain].add((router, rule, rest))
    parts: dict[frozenset[object], list[int]] = defaultdict(list)
    for number in domains:
        parts[frozenset(keys.get(str(number), ()))].append(number)
    for numbers in parts.values():
        yield DomainSet.of(*((number, number) for number in numbers))


def _rules(access: MessageFilter) -> Iterator[tuple[object, tuple[str, ...]]]:
    """Yield each rule of access control without its key expressions, and the key expressions."""
    if isinstance(access, Enforcement):
        for subject in access.subjects:
            for rule in access.rules_of(subject.id):
                without_keys = subject, rule.allows, rule.flows, rule.messages
                yield without_keys, rule.key_expressions
    elif isinstance(access, AccessControl):
        for remote in access.remotes:
            for stated in remote.rules:
                yield (
                    (remote.common_name, stated._replace(key_expressions=())),
                    (stated.key_expressions),
                )


class ZenohOfKeystore:
    """The decisions of Zenoh for the enclaves ``names``, or for all enclaves and the router."""

    def __init__(
        self,
        keystore: OpenedKeystore,
        why: str,
        asking: AskingContext,
        names: Sequence[str] | None = None,
    ) -> None:
        self._keystore = keystore
        self._reason_text = why
        self._asking, self._domain = asking, asking.domain
        self._asks_all = names is None
        domains = _domains(keystore, asking.at)
        first = asking.context(domains).domain
        evaluator = ZenohEvaluator(keystore, moment=asking.at, domain=first)
        self._evaluators = {first: evaluator}
        self._parts: Sequence[DomainSet] = (DomainSet.of((first, first)),)
        if asking.domain is None:
            self._parts = tuple(_with_equal_rules(evaluator, domains))
            for domain in (next(iter(part)) for part in self._parts):
                if domain != first:
                    self._evaluators[domain] = ZenohEvaluator(
                        keystore, moment=asking.at, domain=domain
                    )
        self._names = names or evaluator.names

    @property
    def title(self) -> str:
        """The name Zenoh, and the reason to ask it."""
        return f"Zenoh ({self._reason_text})"

    def outcomes(self, question: Question) -> tuple[ZenohAnswer, ...]:
        """Return an answer for each enclave; the answers do not list who is at the other end."""
        # Imported here, because a question about one enclave does not need them.
        from sros_tool.explain.who import decide_each, first_allowing_domain

        def answer(enclave: str) -> ZenohAnswer:
            def decided(domain: int) -> ZenohAnswer:
                evaluator = self._evaluators[domain]
                answered = evaluator.answer(enclave, question, reach=False, brief=True)
                return evaluator.with_parts(answered, brief=True)

            decisions = {domains: decided(next(iter(domains))) for domains in self._parts}
            decision, domains, in_part = first_allowing_domain(decisions)
            return replace(decision, domains=domains, in_part=in_part)

        return decide_each(self._names, answer)

    def rights_naming(self, name: str) -> Iterator[Right]:
        """Return the rights in all permissions whose text contains ``name``."""
        return rights_naming(self._keystore, name)

    def printed(self, question: Question, outcomes: Sequence[ZenohAnswer]) -> WhoOnZenoh:
        """Return these answers in the form that ``--json`` prints."""
        shown = [
            ZenohEnclaveOutcome(
                outcome.enclave,
                outcome.in_brief,
                outcome.outcome,
                outcome.wildcard,
                outcome.domains,
                outcome.in_part,
            )
            for outcome in outcomes
        ]
        is_export = not is_original_keystore(self._keystore.root)
        return WhoOnZenoh(str(question), "zenoh", self._reason_text, self._domain, shown, is_export)

    def notes(self, question: Question, outcomes: Sequence[ZenohAnswer]) -> Iterator[Note]:
        """Yield notes on what the answer assumes or leaves out.

        They are about enclaves that may be left out, missing keys, unsigned files, the router's
        key, the files of peers, and enclaves that may still have the right although they were
        revoked or removed.
        """
        from sros_tool.explain.earlier import note_on_revoked_enclaves  # as in `outcomes`
        from sros_tool.explain.who import notes_on_enclaves_left_out

        yield from notes_on_enclaves_left_out(self._keystore)
        yield from note_on_lacking_keys(self._keystore)
        yield from _note_on_unsigned(next(iter(self._evaluators.values())).unsigned_files())
        if any(outcome.is_of_router and outcome.allowed for outcome in outcomes):
            yield _ROUTERS_KEY
        if any(outcome.mode is Mode.PEER for outcome in outcomes):
            text = (
                "peers decide by their own files, but this answer uses only the router's file, "
                "which has the same rights if `sros zenoh --check` finds it up to date. A question "
                "about one enclave also reads the files at the other end."
            )
            yield Note("explain.zenoh-by-router", text)
        if self._asks_all:
            allowed = {outcome.enclave for outcome in outcomes if outcome.allowed}
            yield from note_on_revoked_enclaves(
                self._keystore, question, None, self._asking, allowed
            )


# ── one question ───────────────────────────────────────────────────────────────────────────


@shows(
    *("asked", "vendor", "vendor_title", "vendor_why", "answer", "out_of_date", "policy"),
    *("permitted", "remedy", "change", "commands", "counts_key"),
    null_if_empty=("remedy",),
    spread=("asked", "answer"),
)
class ZenohExplanation(NamedTuple):
    """The decision of Zenoh by the files in the keystore.

    ``stated`` is the decision by the signed permissions, from which these files are made.
    """

    asked: AskedQuestion
    vendor_why: str
    """Reason for the choice of Zenoh."""
    answer: ZenohAnswer
    out_of_date: tuple[str, ...] | None
    """The deciding files whose answer to the question differs from that of the permissions; null
    if this is not known.
    """
    stated: Answer
    keystore: OpenedKeystore
    notes: tuple[Note, ...]

    @property
    def vendor(self) -> Literal["zenoh"]:
        """Always ``"zenoh"``."""
        return "zenoh"

    @property
    def vendor_title(self) -> str:
        """Always ``Zenoh``."""
        return "Zenoh"

    @property
    def allowed(self) -> bool:
        """Whether Zenoh lets the messages through."""
        return self.answer.allowed

    @property
    def policy(self) -> StatedInPolicy | None:
        """The part of the policy file of `--policy` that the answer concerns; null without
        `--policy`.
        """
        return self.stated.policy

    @property
    def permitted(self) -> bool:
        """Whether the signed permissions allow the right."""
        return self.stated.allowed

    @property
    def wants_rights(self) -> bool:
        """Whether more rights would help; never for a router, whose enclave has no rights."""
        return not self.allowed and not self.permitted and not self.answer.is_of_router

    @property
    def remedy(self) -> str:
        """What to do if no change of the policy helps; otherwise empty (null in JSON)."""
        return self.files_remedy or (self.stated.remedy if self.wants_rights else "")

    @property
    def files_remedy(self) -> str:
        """What to do if the Zenoh files do not match the permissions, or ""."""
        if self.answer.is_of_router:
            return "" if self.allowed else "Give the node an enclave of its own."
        if self.allowed is self.permitted and not self.out_of_date:
            return ""
        text = "Bring the Zenoh files up to date"
        if self.out_of_date:
            text = "Write the Zenoh files again from the permissions"
        command = f"sros zenoh {quote(str(self.keystore.root))}"
        return f"{text}: `{command}`; then restart the processes that it names."

    @property
    def change(self) -> PolicyChange | None:
        """The smallest change of the policy that would allow the access, or null."""
        return self.stated.change if self.wants_rights else None

    @property
    def commands(self) -> list[str]:
        """Commands that apply the change."""
        return self.stated.commands if self.wants_rights else []

    @property
    def counts_key(self) -> bool:
        """Whether the answer assumes that the enclave has its key, which is not here."""
        return self.asked.question.word != "join" and self.stated.counts_key


def explain_on_zenoh(
    asked_enclave: AskedEnclave,
    question: Question,
    why: str,
    context: JoinContext,
    *,
    kind: str | None = None,
) -> ZenohExplanation:
    """Return Zenoh's decision by the files, and the decision by the signed permissions.

    ``why`` is the reason to ask Zenoh; ``kind`` is the kind of the name (topic, service or action)
    if the user gave it.

    Raises:
        UsageError: the user named no keystore with the enclave.
    """
    enclave, keystore = asked_enclave.enclave, asked_enclave.enclave.keystore
    if keystore is None or enclave.state is None or not is_keystore(keystore.root):
        raise UsageError(
            "Zenoh needs a keystore with the enclave",
            "It decides by the files of the router and of other enclaves, which a policy does not "
            "have.",
            "Name the keystore before the enclave, after `sros generate_artifacts -k KEYSTORE -p "
            "POLICY` and `sros zenoh KEYSTORE`.",
        )
    stated = Evaluator(Vendor.STANDARD, enclave, context)
    question, taken = question_meant(stated, asked_enclave, question, kind)
    joins = question.word == "join"
    evaluator = ZenohEvaluator(keystore, moment=context.at, domain=context.domain, joining=joins)
    answer = evaluator.with_parts(evaluator.answer(enclave.name, question), brief=False)

    def decide(action: Question) -> tuple[bool, Sequence[str]]:
        decided = evaluator.answer(enclave.name, action, reach=False, brief=True)
        return decided.allowed, evaluator.with_parts(decided, brief=True).in_part

    outdated = evaluator.outdated_files(answer)
    by_permissions = explain(stated, question)
    notes = (
        *taken,
        *_notes(answer, by_permissions, outdated),
        *(() if answer.allowed else note_on_action(question, kind, decide)),
        *(() if joins else note_on_lacking_keys(keystore)),
    )
    asked = AskedQuestion(enclave.name, question, context)
    return ZenohExplanation(asked, why, answer, outdated, by_permissions, keystore, notes)


def _notes(answer: ZenohAnswer, stated: Answer, outdated: Sequence[str] | None) -> Iterator[Note]:
    if answer.is_of_router:
        if answer.allowed:
            yield _ROUTERS_KEY
    elif answer.allowed is not stated.allowed and not stated.problems:
        permissions, rules = (
            ("allow", "drops it") if stated.allowed else ("deny", "lets it through")
        )
        text = f"the signed permissions {permissions} it, but Zenoh {rules}."
        yield Note("explain.zenoh-differs", text)
    if answer.in_part:
        yield Note("explain.in-part", text_of_parts(answer.question, answer.in_part))
    if outdated:
        text = f"out of date: {', '.join(outdated)}. The answer follows these files as they are."
        yield Note("explain.zenoh-out-of-date", text)
    if outdated is None:
        text = (
            "the files were not compared with the permissions, because this needs the keystore's "
        )
        text += "settings and all its enclaves: the answer follows the files as they are."
        yield Note("explain.zenoh-not-compared", text)
    yield from _note_on_unsigned(answer.unsigned)


def _note_on_unsigned(files: Sequence[str]) -> Iterator[Note]:
    if files:
        text = (
            f"the permissions CA has not signed {', '.join(files)}: anyone who can write to an "
            "unsigned file can give rights, because Zenoh verifies no signature."
        )
        yield Note("explain.zenoh-unsigned", text)
