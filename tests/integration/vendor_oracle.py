"""Ask real DDS vendors in bulk what signed documents let an identity do.

A `Case` is a pair of documents as bytes, an identity, a domain and a time zone, with questions.
`Workshop` signs the documents once each; `ask_fastdds` and `ask_cyclone` answer all cases, in the
order of the cases.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from functools import cache, partial
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar

from sros_tool.dds.decision.vendors import Vendor
from sros_tool.pki import smime
from sros_tool.pki.certificates import Issuer, common_name, issue_ca, parse_subject, pem
from sros_tool.pki.keys import generate_key, key_pem
from sros_tool.runtime.cyclone import load_cyclone
from sros_tool.validity import Window
from tests.integration import cyclone_oracle
from tests.integration.fastdds import build, fastdds_stack, openssl, run_isolated_program
from tests.integration.kept.forms import form_of, form_of_text
from tests.integration.kept.replies import answered
from tests.support.children import LATE, together

MATCH_SECONDS = 2.5
"""How long a match is waited for; those that come take a tenth of a second."""


@dataclass(frozen=True, slots=True)
class Question:
    """Whether a topic may be opened; ``verb`` is publish or subscribe."""

    verb: str
    topic: str
    partitions: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Case:
    """Documents, and who asks what where; with ``peer``, whether a permitted peer matches too."""

    governance: bytes
    permissions: bytes
    questions: tuple[Question, ...]
    subject: str = "CN=/t"
    domain: int = 42
    zone: str = "UTC"
    peer: bool = False


@dataclass(frozen=True, slots=True)
class Reply:
    """What a vendor does.

    ``end`` is joined, refused, crashed, hung, or "peer refused", "peer crashed" (Cyclone DDS, whose
    participants are processes of their own); ``answers`` has for each question
    denied, created, or with a peer matched, unmatched, "peer denied"; ``log`` is the vendor's.
    """

    end: str
    answers: tuple[str, ...] = ()
    log: str = ""


@dataclass
class Workshop:
    """Two authorities, identities by their subject, and signed documents, all in one folder."""

    root: Path
    _identities: dict[str, Path] = field(default_factory=dict)
    _documents: dict[bytes, Path] = field(default_factory=dict)
    _form: str = ""

    def __post_init__(self) -> None:
        now = datetime.now(UTC).replace(microsecond=0)
        self.window = Window(now - timedelta(days=30), now + timedelta(days=30))
        self.keys = {name: generate_key() for name in ("identity", "permissions")}
        self.authorities = {
            name: issue_ca(key, common_name(f"{name} CA"), self.window)
            for name, key in self.keys.items()
        }
        self._issuer = Issuer(self.authorities["identity"], self.keys["identity"])

    def identity(self, subject: str) -> Path:
        """A folder with all files of an identity; its documents are those of nobody."""
        if subject not in self._identities:
            folder = self._folder(f"identity {subject}".encode())
            key = generate_key()
            certificate = self._issuer.issue(parse_subject(subject), key.public_key(), self.window)
            (folder / "key.pem").write_bytes(key_pem(key))
            (folder / "cert.pem").write_bytes(pem(certificate))
            for each, authority in self.authorities.items():
                (folder / f"{each}_ca.cert.pem").write_bytes(pem(authority))
            for each in ("governance.p7s", "permissions.p7s"):
                (folder / each).touch()
            self._identities[subject] = folder
        return self._identities[subject]

    def documents(self, governance: bytes, permissions: bytes) -> Path:
        """A folder with governance.p7s and permissions.p7s, signed."""
        folder = self._folder(governance + permissions)
        for name, document in (("governance", governance), ("permissions", permissions)):
            link = folder / f"{name}.p7s"
            if not link.exists():
                link.hardlink_to(self._signed(document))
        return folder

    def form(self, case: Case) -> str:
        """What the answer to a case depends on: texts, and the form of what this workshop makes."""
        if not self._form:
            sample = self.identity("CN=/sample"), self.documents(b"<dds></dds>", PEER_PERMISSIONS)
            self._form = form_of(sample, datetime.now(UTC))
        texts = [case.governance.decode("latin-1"), case.permissions.decode("latin-1")]
        asked = repr((case.questions, case.subject, case.domain, case.zone, case.peer))
        return "\n".join([self._form, asked, form_of_text("\n".join(texts), datetime.now(UTC))])

    def _signed(self, document: bytes) -> Path:
        if document not in self._documents:
            path = self.root / f"{len(self._documents)}.p7s"
            certificate, key = self.authorities["permissions"], self.keys["permissions"]
            path.write_bytes(smime.sign(document, certificate, key))
            self._documents[document] = path
        return self._documents[document]

    def _folder(self, content: bytes) -> Path:
        folder = self.root / sha256(content).hexdigest()[:20]
        folder.mkdir(exist_ok=True)
        return folder


PEER = "CN=peer"
PEER_PERMISSIONS = b"""<?xml version="1.0" encoding="UTF-8"?>
<dds><permissions><grant name="peer"><subject_name>CN=peer</subject_name>
<validity><not_before>2020-01-01T00:00:00</not_before><not_after>2037-01-01T00:00:00</not_after>
</validity>
<allow_rule><domains><id_range><min>0</min><max>230</max></id_range></domains>
<publish><topics><topic>*</topic></topics><partitions><partition>*</partition></partitions></publish>
<subscribe><topics><topic>*</topic></topics><partitions><partition>*</partition></partitions>
</subscribe></allow_rule>
<default>DENY</default></grant></permissions></dds>
"""


_PATIENCE = 3600.0  # a full run asks thousands of questions of one process

Asked = TypeVar("Asked")


def with_patience(
    ask: Callable[[Sequence[Asked], float], list[Reply]],
    asked: Sequence[Asked],
    doubtful: Callable[[int, Reply], bool],
) -> list[Reply]:
    """The replies; where a match is missing that was expected, it is waited for longer.

    ``ask`` is given the seconds for a match, ``doubtful`` a place in ``asked`` and the reply to it.
    On a busy machine a match may come late; what is really refused stays so.
    """
    replies = ask(asked, MATCH_SECONDS)
    late = [
        place
        for place, reply in enumerate(replies)
        if "unmatched" in reply.answers and doubtful(place, reply)
    ]
    again = ask([asked[place] for place in late], LATE)
    for place, reply in zip(late, again, strict=True):
        replies[place] = reply
    return replies


# ── Fast DDS ───────────────────────────────────────────────────────────────────────────────


def ask_fastdds(
    workshop: Workshop,
    cases: Sequence[Case],
    *,
    at_once: int = 2,
    seconds: float = MATCH_SECONDS,
) -> list[Reply]:
    """What Fast DDS does with each case; a process answers many, and a new one follows a crash.

    A match is waited for so many seconds.
    """

    def ask(places: list[int]) -> list[Reply]:
        program = build("fastdds_oracle.cpp", workshop.root)
        lines = [_line(workshop, cases[place], seconds) for place in places]
        return _spread(lines, at_once, partial(_ask_programs, program))

    return _replies(fastdds_stack(), [workshop.form(case) for case in cases], ask, seconds)


def _line(workshop: Workshop, case: Case, seconds: float) -> str:
    peer = ["-", "-"]
    if case.peer:
        documents = workshop.documents(case.governance, PEER_PERMISSIONS)
        peer = [str(workshop.identity(PEER)), str(documents)]
    questions = ["\x1f".join((each.verb, each.topic, *each.partitions)) for each in case.questions]
    fields = [
        workshop.identity(case.subject),
        workshop.documents(case.governance, case.permissions),
        case.domain,
        case.zone,
        *peer,
        int(seconds * 1000),
        *questions,
    ]
    return "\t".join(map(str, fields))


def _ask_programs(program: Path, hands: Sequence[Sequence[str]]) -> list[list[Reply]]:
    with ThreadPoolExecutor(len(hands)) as pool:
        return list(pool.map(partial(_ask_one_program, program), hands))


def _ask_one_program(program: Path, lines: Sequence[str]) -> list[Reply]:
    replies: list[Reply] = []
    while len(replies) < len(lines):
        rest = lines[len(replies) :]
        said = "\n".join(rest) + "\n"
        done = run_isolated_program(program, said=said, status=None, patience=_PATIENCE)
        replies += [_reply(line) for line in done.stdout.splitlines()]
        if len(replies) < len(lines):
            assert done.returncode < 0, (done.returncode, done.stderr)
            replies.append(Reply("crashed", log=done.stderr))
    return replies


def _reply(line: str) -> Reply:
    end, *rest = line.split("\t")
    return Reply(end, tuple(rest)) if end == "joined" else Reply(end, log="".join(rest))


# ── Cyclone DDS ────────────────────────────────────────────────────────────────────────────


@cache
def cyclone_vendor() -> Vendor:
    """Which of the releases that sros knows the Cyclone DDS is that is asked."""
    return Vendor.CYCLONE if load_cyclone().version.startswith("0.") else Vendor.CYCLONE_11


@cache
def cyclone_stack() -> str:
    """The name under which the replies of this Cyclone DDS are kept."""
    return f"cyclone-{load_cyclone().version}-{openssl()}"


def ask_cyclone(
    workshop: Workshop,
    cases: Sequence[Case],
    *,
    at_once: int = 2,
    seconds: float = MATCH_SECONDS,
) -> list[Reply]:
    """What Cyclone DDS does with each case; every participant is a process of its own."""

    def ask(places: list[int]) -> list[Reply]:
        return ask_cyclone_records(
            [_record(workshop, cases[place], seconds) for place in places], at_once
        )

    return _replies(cyclone_stack(), [workshop.form(case) for case in cases], ask, seconds)


def ask_cyclone_records(records: Sequence[dict[str, Any]], at_once: int) -> list[Reply]:
    """What Cyclone DDS does with cases in the form of `cyclone_oracle`."""

    def ask(hands: Sequence[Sequence[dict[str, Any]]]) -> list[list[Reply]]:
        asked = together(
            [partial(cyclone_oracle.answers, hand) for hand in hands], patience=_PATIENCE
        )
        return [[_reply_of(report) for report in reports] for reports in asked]

    return _spread(records, at_once, ask)


def _reply_of(report: dict[str, Any]) -> Reply:
    assert report["end"] != "failed", report
    return Reply(report["end"], tuple(report["answers"]), report["log"])


def _record(workshop: Workshop, case: Case, seconds: float) -> dict[str, Any]:
    peer = None
    if case.peer:
        documents = workshop.documents(case.governance, PEER_PERMISSIONS)
        peer = [str(workshop.identity(PEER)), str(documents)]
    return {
        "whole": str(workshop.identity(PEER)),
        "identity": str(workshop.identity(case.subject)),
        "documents": str(workshop.documents(case.governance, case.permissions)),
        "domain": case.domain,
        "zone": case.zone,
        "questions": [(each.verb, each.topic, each.partitions) for each in case.questions],
        "peer": peer,
        "seconds": seconds,
    }


# ── whole enclaves ─────────────────────────────────────────────────────────────────────────

Pair = tuple[Path, Path, str]
"""Two enclaves' folders and the host's time zone: whether the first publishes to the second."""


def ask_fastdds_folders(
    pairs: Sequence[Pair],
    topic: str,
    program_folder: Path,
    *,
    domain: int = 0,
    seconds: float = MATCH_SECONDS,
    at_once: int = 6,
    made: datetime | None = None,
) -> list[Reply]:
    """What Fast DDS does with each pair of enclaves, whose dates count from ``made`` (now)."""
    lines = [
        f"{own}\t{own}\t{domain}\t{zone}\t{peer}\t{peer}\t{int(seconds * 1000)}\tpublish\x1f{topic}"
        for own, peer, zone in pairs
    ]

    def ask(places: list[int]) -> list[Reply]:
        program = build("fastdds_oracle.cpp", program_folder)
        asked = [lines[place] for place in places]
        return _spread(asked, at_once, partial(_ask_programs, program))

    return _replies(fastdds_stack(), _forms_of_pairs(pairs, topic, domain, made), ask, seconds)


def ask_cyclone_folders(
    pairs: Sequence[Pair],
    topic: str,
    whole: Path,
    *,
    domain: int = 0,
    seconds: float = MATCH_SECONDS,
    at_once: int = 6,
    made: datetime | None = None,
) -> list[Reply]:
    """What Cyclone DDS does with each pair of enclaves, whose dates count from ``made`` (now).

    ``whole`` is an enclave that lacks nothing.
    """
    records = [
        {
            "whole": str(whole),
            "identity": str(own),
            "documents": str(own),
            "domain": domain,
            "zone": zone,
            "questions": [("publish", topic, ())],
            "peer": [str(peer), str(peer)],
            "seconds": seconds,
        }
        for own, peer, zone in pairs
    ]

    def ask(places: list[int]) -> list[Reply]:
        return ask_cyclone_records([records[place] for place in places], at_once)

    return _replies(cyclone_stack(), _forms_of_pairs(pairs, topic, domain, made), ask, seconds)


def _forms_of_pairs(
    pairs: Sequence[Pair], topic: str, domain: int, made: datetime | None
) -> list[str]:
    now = datetime.now(UTC)
    return [
        f"{topic} {domain} {zone}\n{form_of((own, peer), now, made)}" for own, peer, zone in pairs
    ]


# ── both ───────────────────────────────────────────────────────────────────────────────────


def _replies(
    stack: str, forms: list[str], ask: Callable[[list[int]], list[Reply]], seconds: float
) -> list[Reply]:
    """The kept replies, and those to what is asked; who waits longer than usual asks for all."""

    def words(places: list[int]) -> list[tuple[str, ...]]:
        return [(each.end, each.log, *each.answers) for each in ask(places)]

    patient = seconds > MATCH_SECONDS
    found = answered(stack, forms, words, believe=lambda place, reply: not patient)
    return [Reply(end, tuple(answers), log) for end, log, *answers in found]


def _spread(
    items: Sequence[Asked],
    at_once: int,
    ask: Callable[[Sequence[Sequence[Asked]]], list[list[Reply]]],
) -> list[Reply]:
    """Deal the items out to ``at_once`` processes, and put the replies in order again."""
    hands = [items[start::at_once] for start in range(at_once) if items[start::at_once]]
    replies: list[Reply] = [Reply("")] * len(items)
    for start, found in enumerate(ask(hands)):
        replies[start::at_once] = found
    return replies
