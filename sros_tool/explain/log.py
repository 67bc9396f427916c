"""Explain security messages in a log, and examine the enclaves that the log names.

The log may mix lines of several processes, with labels of ros2 launch, journald or Docker Compose,
and may contain colors and tracebacks.
"""

from __future__ import annotations

import os
import re
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import islice
from pathlib import Path
from shlex import quote
from typing import NamedTuple

from sros_tool.dds.decision.access import AccessVerb
from sros_tool.dds.decision.vendors import Vendor
from sros_tool.errors import Note, SrosError, UsageError
from sros_tool.explain.answer import Answer, Evaluator, Part, Question, ask, with_article
from sros_tool.explain.asking import (
    AskingContext,
    fleet_of,
    is_enclave,
    not_in_policy_error,
    planned_enclave,
    policy_to_ask,
    signed_enclave,
)
from sros_tool.explain.denials import (
    PARAMETER_CLIENT_TEXT,
    Denial,
    node_denied_own_service,
    read_denials,
)
from sros_tool.explain.explanation import (
    likely_names,
    meaning_of_other_kind,
    named_rights,
    remedy,
)
from sros_tool.faults import NEEDS_CA_KEYS, ORIGINAL_KEYSTORE, Fault, remedy_in_original_keystore
from sros_tool.graph.observation import PUBLISH, SUBSCRIBE
from sros_tool.keystore.known_keys import enclaves_by_identity
from sros_tool.keystore.layout import (
    KEY_FILE,
    ROUTER_FILE,
    ZENOH_SIGNED,
    is_keystore,
    is_original_keystore,
    remedy_in_closed_robot,
)
from sros_tool.keystore.lifecycle.rotation import RotationStage, read_rotation
from sros_tool.keystore.loading import starts_without_security
from sros_tool.keystore.participant import JoinContext, LoadedEnclave
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.rights import RightsSource, load_rights
from sros_tool.keystore.selection import likely_names as likely_enclaves
from sros_tool.names import (
    PARAMETER_SERVICES,
    action_part,
    check_enclave_name,
    expand,
    is_expression,
    nodes_served,
    right_to_use,
    service_of,
)
from sros_tool.pki.certificates import IDENTITY_DIGITS
from sros_tool.policy.model import (
    ALLOW,
    PEER_RIGHT,
    Enclave,
    Policy,
    below_namespace,
    policy_in_namespace,
)
from sros_tool.policy.patterns import Names, covers
from sros_tool.policy.remapping import Remapping, renamed_action_text
from sros_tool.policy.rights import Right, placed_rights, policy_rights
from sros_tool.runtime.environment import RMW_ZENOH
from sros_tool.runtime.log_texts import (
    CHANGE_OWNER_REMEDY,
    EXPORT_FOR_USER_REMEDY,
    NO_ENCLAVE,
    RAN_OPEN,
    RUNS_OPEN,
    STARTS,
    UNKNOWN,
    UNNOTICED_FAULT,
    LogText,
)
from sros_tool.runtime.vendor_log import (
    CONTINUATION,
    LINE_DOMAIN,
    denied_topic,
    labeled_line,
    log_lines,
    logging_node,
    matching_text,
    plain_refusal,
    plain_text,
    security_directory,
    vendor_of_line,
)
from sros_tool.runtime.zenoh_log import (
    ZENOH_IDS,
    ZENOH_LINE,
    DroppedMessage,
    dropped_messages,
    matching_zenoh_text,
)
from sros_tool.spelling import is_spelled_alike, is_typing_error
from sros_tool.translate import grant_rights
from sros_tool.translate_zenoh.rights import name_of_key
from sros_tool.values import shows
from sros_tool.wording import enumerated, first_few

_WORD_PATTERNS = (re.compile(r"[\w/]+"), re.compile(r"[^\s(]+"), re.compile(r"\S+"))
"""Patterns that split a log line into words: without punctuation, or with that of topics."""
_CHANGING_NUMBERS = re.compile(r"\b[0-9a-f]{2}(?:\.[0-9a-f]{2}){5,}\S*|\d+")
_MAX_LINE_LENGTH = 8000
"""Maximum number of characters read from a line, because a line may have many megabytes."""


@shows(
    *("id", "vendor", "line", "count", "text", "process", "enclave", "cause", "checked", "found"),
    "remedy",
    null_if_empty=("process", "enclave"),
)
@dataclass(frozen=True, slots=True)
class LogFinding:
    """A security message in a log, with its cause and remedy.

    ``dds`` is the vendor that printed the message, None for rcl and Zenoh; ``zenoh`` is true for
    messages of Zenoh.
    """

    id: str
    """Stable id of the message."""
    dds: Vendor | None
    line: int
    """First line of the log with the message, from 1."""
    count: int
    """Number of log lines with the message."""
    text: str
    """Text of the first line."""
    process: str
    """The process that printed the message, or null."""
    enclave: str
    """The enclave of the process, or null."""
    cause: str
    """Meaning of the message."""
    remedy: str
    """What to do about the cause."""
    found: tuple[str, ...] = ()
    """Causes that sros found in the enclave."""
    checked: bool = False
    """Whether the enclave was examined."""
    zenoh: bool = False

    @property
    def vendor(self) -> str | None:
        """The DDS vendor that printed the message, zenoh, or null for ROS 2."""
        if self.zenoh:
            return "zenoh"
        return self.dds.value if self.dds else None


class ExplainedLog(NamedTuple):
    """The security messages of a log, explained."""

    log: str
    """Path of the log."""
    findings: Sequence[LogFinding]
    """The different security messages."""
    secured: bool | None
    """Whether a line says that a node of the named enclave ran secured; null if no enclave is
    named, and on Zenoh, which logs no such line.
    """
    notes: Sequence[Note]
    """Notes, which text output prints on standard error."""


class SearchedKeystore:
    """An index of the enclaves of a keystore, by peers and nodes that a log names."""

    def __init__(self, keystore: OpenedKeystore) -> None:
        self._keystore = keystore

    def peer(self, guid: str) -> str:
        """Return the enclave of a participant by its GUID, as a vendor prints it, or ""."""
        identity = guid.replace(".", "")
        if ":" in guid:
            identity = "".join(word.zfill(8) for word in guid.split(":"))
        return self._by_identity.get(identity[:IDENTITY_DIGITS], "")

    def enclaves_meant(self, enclave: str) -> tuple[str, ...]:
        """Return the enclaves that a name may mean; () if the keystore has the enclave."""
        names = self._keystore.names
        return () if enclave in names else likely_enclaves(enclave, names)

    def enclaves_for(self, node: str) -> tuple[str, ...]:
        """Return the enclaves whose permissions are only for the node with this full name."""
        return self._by_node.get(node, ())

    def has_other_side(self, right: Right) -> bool | None:
        """Return whether an enclave states, by exact name, the right that peers of ``right`` need.

        Returns None if permissions cannot be read, so that this is not known, or if an enclave has
        the right only by a wildcard. In an export, the enclave with the right may be missing (see
        `place`).
        """
        exact, expressions = self._allowed_names[PEER_RIGHT[right.right]]
        if right.name in exact:
            return True
        with suppress(SrosError):  # too many wildcards to compare
            if self._rights and self._rights.sound and not expressions.cover(right.name):
                return False
        return None

    @cached_property
    def zenoh_routers(self) -> frozenset[str]:
        """The enclaves of Zenoh routers.

        These are the routers listed in the keystore's Zenoh settings (without such settings: the
        default router), and the enclaves with a router file.
        """
        from sros_tool.zenoh.configuration import ZenohNetwork  # most logs do not come from Zenoh

        network = None
        with suppress(SrosError):  # `sros check` reports the error
            network = settings.zenoh if (settings := self._keystore.settings) else None
        names = set((network or ZenohNetwork()).router_names())
        for name in self._keystore.names:
            if (self._keystore.folder(name) / ROUTER_FILE).exists():
                names.add(name)
        return frozenset(names)

    @cached_property
    def rotates(self) -> bool:
        """Whether a CA rotation is in the stage after which all files are from the new CAs."""
        try:
            return read_rotation(self._keystore).stage is RotationStage.REISSUE
        except SrosError:
            return False

    @cached_property
    def _by_identity(self) -> Mapping[str, str]:
        return enclaves_by_identity(self._keystore)

    @cached_property
    def _rights(self) -> RightsSource | None:
        with suppress(SrosError):  # without readable documents, the rights are unknown
            return load_rights(self._keystore)
        return None

    @property
    def place(self) -> str:
        """A word for the source of the enclaves: keystore or export."""
        is_whole = self._rights is not None and self._rights.scope is None
        return "keystore" if is_whole else "export"

    @cached_property
    def _allowed_names(self) -> Mapping[str, tuple[frozenset[str], Names]]:
        """Map each right to the exact names, and the wildcards, for which enclaves have it."""
        names: dict[str, set[str]] = {right: set() for right in PEER_RIGHT}
        for right in self._rights.rights if self._rights else ():
            if right.qualifier is ALLOW and right.right in names:
                names[right.right].add(right.name)
        return {
            right: (frozenset(stated), Names(filter(is_expression, stated)))
            for right, stated in names.items()
        }

    @cached_property
    def _by_node(self) -> Mapping[str, tuple[str, ...]]:
        enclaves_by_node: dict[str, set[str]] = {}
        for right in self._rights.rights if self._rights else ():
            if right.qualifier is ALLOW:
                for node in nodes_served([(right.right, right.name)]):
                    enclaves_by_node.setdefault(node, set()).add(right.enclave)
        return {node: tuple(sorted(enclaves)) for node, enclaves in enclaves_by_node.items()}


@dataclass(frozen=True, slots=True)
class AskedPolicy:
    """The policy by which sros explains a log.

    The robot that wrote the log may use the policy in a namespace.
    ``file`` is the path of the policy, and ``name`` the enclave that the user named, or "".
    """

    file: str
    policy: Policy
    name: str

    def place(self, enclave: str) -> tuple[str, str]:
        """Return the namespace of the policy on the robot, and an enclave's path in the policy.

        ``enclave`` is the path on the robot.  The path in the policy is "" if no enclave fits.
        """
        paths = [stated.path for stated in self.policy.enclaves]
        if enclave in paths:
            return "", enclave
        fitting = [path for path in paths if path != "/" and enclave.endswith(path)]
        path = self.name if self.name in fitting else max(fitting, key=len, default="")
        return enclave.removesuffix(path) if path else "", path

    def likely_namespace(self, denied: Right) -> str:
        """Return the namespace in which the policy's relative names give a denied right, or "".

        "" also if the log states the namespace.
        """
        space, path = self.place(denied.enclave)
        stated = self.policy.enclave(path) if path and not space else None
        for placed in placed_rights(stated) if stated else ():
            own = placed.right
            is_relative = not placed.written.startswith(("/", "*"))
            allows = own.qualifier is ALLOW and own.right == denied.right and is_relative
            if allows and denied.name.endswith(own.name):
                return denied.name.removesuffix(own.name)
        return ""

    def possible_namespace(self, name: str, enclave: str) -> str:
        """Return the namespace of a name that may be a relative name on the robot, or "".

        "" if the policy itself has a name in this namespace.  The node's own name is no part of the
        namespace of its private names.
        """
        space = name.rpartition("/")[0]
        stated = self.policy.enclave(self.place(enclave)[1])
        for profile in stated.all_profiles() if stated else ():
            space = space.removesuffix(f"/{profile.node}")
        names = {right.name for right in policy_rights(self.policy)}
        return "" if any(name.startswith(f"{space}/") for name in names) else space

    def private_name(self, name: str, space: str, enclave: str) -> str:
        """Return a name on the robot as ``~/NAME`` if a node of the enclave has it, or "".

        ``space`` is the namespace of the policy on the robot.
        """
        stated = self.policy.enclave(self.place(enclave)[1])
        for profile in stated.all_profiles() if stated else ():
            own = below_namespace(expand("~", profile.ns, profile.node), space)
            if name.startswith(f"{own}/"):
                return f"~{name.removeprefix(own)}"
        return ""

    def enclaves_for(self, node: str, enclave: str) -> tuple[str, ...]:
        """Return the enclaves, under their paths on the robot, that the policy has for a node.

        ``enclave`` is the path on the robot of the enclave in which the node runs.
        """
        robot_ns = self.place(enclave)[0]
        if not node.startswith(f"{robot_ns}/"):
            return ()
        ns, _, name = node.removeprefix(robot_ns).rpartition("/")
        fitting = self.policy.enclaves_of_node(ns, name)
        return tuple(below_namespace(stated.path, robot_ns) for stated in fitting)

    def enclave(self, enclave: str) -> Enclave | None:
        """Return the policy's enclave, under its path on the robot; None if the policy lacks it."""
        ns, path = self.place(enclave)
        stated = self.policy.enclave(path) if path else None
        if stated is None:
            return None
        alone = replace(self.policy, enclaves=(stated,))  # the log may name many enclaves
        return policy_in_namespace(alone, ns).enclave(enclave)


FindEnclave = Callable[[str], LoadedEnclave | None]
"""Function that returns an enclave by name ("": the enclave that the user named), or None."""


def explain_log_of(
    log: str,
    text: str,
    keystore: OpenedKeystore | None,
    name: str,
    asking: AskingContext,
    policy_file: Path | None = None,
    rmw: str = "",
) -> ExplainedLog:
    """Return the explained messages of a log; examines the enclaves that the log names.

    ``name`` is the enclave, or its folder, whose processes wrote the log; "" if the log names the
    enclave, or if ``keystore`` is the folder of a single enclave.  With ``policy_file``, there is
    no keystore, and only denials are examined: by the rights in the policy. ``rmw`` is the RMW of
    the environment, or "".

    Raises:
        UsageError: ``name`` is an enclave, and there is no keystore.
        PolicyError: the policy cannot be read, or does not have the enclave ``name``.
    """
    named: LoadedEnclave | None = None
    policy: AskedPolicy | None = None
    folder = keystore.root if keystore and not name else None
    if folder and is_enclave(folder) and not is_keystore(folder):
        keystore, name = None, str(folder)
    if policy_file:
        _, stated = policy_to_ask(policy_file, fleet_of(asking.fleet_file, None))
        policy = AskedPolicy(str(policy_file), stated, name)
        if name and not policy.place(name)[1]:
            raise not_in_policy_error(stated, name, policy_file)
    elif name:
        named = signed_enclave(keystore, name, asking.at)
        if named is None and not name.startswith("/"):
            raise UsageError(
                f"'{name}' does not exist", "", "Name a keystore, or an enclave's folder."
            )
        if named is None:
            raise UsageError(
                f"the keystore of enclave {name} is missing in the command",
                "",
                "Write the keystore before the enclave.",
            )

    # Cached, because a log may name any number of enclaves, any number of times.
    @cache
    def find(enclave: str) -> LoadedEnclave | None:
        if named is not None and enclave in ("", named.name):
            return named
        # Without its certificate, an enclave's folder does not tell the name of the enclave.
        if named and not named.name and str(Path(name).absolute()).endswith(f"/enclaves{enclave}"):
            return named._replace(name=enclave)
        if policy is None and (keystore is None or not enclave):
            return None
        try:
            if policy is not None:
                of_robot = policy.enclave(check_enclave_name(enclave or name))
                return planned_enclave(of_robot, None, asking) if of_robot else None
            check_enclave_name(enclave)
            return signed_enclave(keystore, enclave, asking.at, planned=True)
        except SrosError:  # the log names an enclave of another keystore, or a path
            return None

    findings = explain_log(
        text,
        find,
        lambda enclave: asking.context(enclave.joined_domains),
        str(keystore.root) if keystore else "",
        SearchedKeystore(keystore) if keystore and is_keystore(keystore.root) else None,
        policy,
    )
    plain = plain_text(text)
    named_folders = filter(None, map(security_directory, log_lines(plain)))
    started = [(line["enclave"] or "/", line["folder"]) for line in named_folders]

    def is_named(enclave: str) -> bool:
        if policy:
            namespace, path = policy.place(name)
            return enclave == name if namespace else policy.place(enclave)[1] == path
        loaded = find(enclave)
        return loaded is not None and named is not None and loaded.folder == named.folder

    secured = None
    if name and not _is_of_zenoh(plain, rmw, named):
        secured = any(is_named(enclave) for enclave, _ in started)
    examined = named.folder if named and not keystore else keystore and keystore.root
    notes = [*_other_folder_notes(examined, [folder for _, folder in started])] if examined else []
    notes += _NOTES if any(finding.found for finding in findings) else ()
    return ExplainedLog(log, findings, secured, notes)


def _is_of_zenoh(log: str, rmw: str, named: LoadedEnclave | None) -> bool:
    """Return whether a log may be of a node on Zenoh, which logs nothing about its security."""
    if rmw:  # stated by the user; a bridge, or the text of a message, can put such a line in a log
        return rmw.startswith(RMW_ZENOH)
    if any(ZENOH_LINE.search(labeled_line(line)[1]) for line in log_lines(log)):
        return True
    folder = named.folder if named else None
    return folder is not None and any((folder / file).exists() for file in ZENOH_SIGNED)


def _other_folder_notes(examined: Path, folders: Iterable[str]) -> Iterator[Note]:
    """Yield a note if a log names folders of enclaves outside of the ``examined`` folder."""
    inside = examined.resolve()
    other = [
        folder
        for folder in dict.fromkeys(folders)
        # Path.resolve() fails for a link to itself, which the log may name.
        if Path(folder).is_absolute() and not Path(os.path.realpath(folder)).is_relative_to(inside)
    ]
    if other:
        shown = first_few(other, _MAX_PEERS)
        yield Note("log.other-folder", f"the log names another folder than {examined}: {shown}")


_NOTES = (
    Note(
        "log.only-text",
        "a process can print any line, true or false: only the rows 'found' are what sros itself "
        "found in the enclave",
    ),
)


def explain_log(
    text: str,
    find: FindEnclave,
    context: Callable[[LoadedEnclave], JoinContext],
    root: str = "",
    keystore: SearchedKeystore | None = None,
    policy: AskedPolicy | None = None,
) -> tuple[LogFinding, ...]:
    """Return the different security messages of a log, in the order of the log.

    Lines that are not understood follow at the end, with one finding for each process.

    ``find`` loads an enclave; ``context`` returns the domain and time for a loaded enclave.
    ``root`` is the path of the keystore as suggested commands name it.  The enclaves of peers and
    nodes in the log are looked up in ``keystore``.  ``policy`` is set if the enclaves are from a
    policy.
    """
    plain = plain_text(text)
    lines = log_lines(plain)
    examiner = _Examiner(find, context, root, keystore, policy, lines)
    denied = read_denials(plain)
    naming = _lines_naming(lines, denied)
    reported = {denial.process for denial in denied}
    hits = _strongest_hits(_log_hits(_joined_lines(lines)), reported)
    findings = [
        finding for group in _grouped_hits(hits) if (finding := examiner.message(group)) is not None
    ]
    lacking = examiner.missing_namespaces(denied)
    findings += [
        examiner.denial(denial, naming[denial], lacking.get((denial.process, denial.enclave), ""))
        for denial in denied
    ]
    own_enclave = find("")
    findings += _dropped_message_findings(
        lines, root, own_enclave.name if own_enclave else "", keystore
    )
    return tuple(sorted(findings, key=lambda finding: (finding.id == UNKNOWN.id, finding.line)))


# ── reading ────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, slots=True)
class _Hit:
    """A log line with a known text; ``fields`` are the groups that the text's pattern matched."""

    line: int
    text: str
    process: str
    enclave: str
    meaning: LogText
    fields: Mapping[str, str]

    @property
    def cause(self) -> str:
        return self.meaning.cause.format(**self.fields)

    @property
    def quoted(self) -> Mapping[str, str]:
        """The fields, quoted for a shell command because a log can contain any text."""
        return {name: quote(text) for name, text in self.fields.items()}

    @property
    def kind(self) -> str:
        """A key that is equal for lines that are reported as one finding."""
        return f"{self.meaning.id} {self.cause}"


def _joined_lines(lines: list[str]) -> Iterator[tuple[int, str]]:
    """Yield lines with their numbers; an error stack of OpenSSL is joined to the line before."""
    number, current = 0, ""
    for index, line in enumerate(lines, 1):
        if current and CONTINUATION.match(line):
            if len(current) < _MAX_LINE_LENGTH:
                current += " " + line
            continue
        if current:
            yield number, current[:_MAX_LINE_LENGTH]
        number, current = index, line
    if current:
        yield number, current[:_MAX_LINE_LENGTH]


def _log_hits(lines: Iterable[tuple[int, str]]) -> Iterator[_Hit]:
    enclaves: dict[str, str] = {}
    following = deque(lines)
    while following:
        number, line = following.popleft()
        process, rest = labeled_line(line)
        if named := security_directory(line):
            enclaves[process] = named["enclave"] or "/"
            text = " ".join(rest.split())
            yield _Hit(number, text, process, enclaves[process], RUNS_OPEN, {})
            continue
        if following and (rejoined := _rejoined_message(process, line, rest, following[0][1])):
            following.popleft()
            line = rest = rejoined
        text = " ".join(rest.split())
        meaning, match = _meaning_of(line, rest)
        if match:
            fields = {name: value or "" for name, value in match.groupdict().items()}
            if domain := LINE_DOMAIN.search(line):
                fields["domain"] = domain[1]
            enclave = enclaves.get(process) or fields.get("enclave", "")
            yield _Hit(number, text, process, enclave, meaning, fields)


def _rejoined_message(process: str, line: str, rest: str, following: str) -> str:
    """Return the joined message if ``line`` and ``following`` are its halves; otherwise "".

    ``line`` counts as broken if neither ``line`` nor ``following`` has a known meaning, but the
    joined lines have one.
    """
    if not UNKNOWN.pattern.search(rest):  # checked first, because this check is fast
        return ""
    other, end = labeled_line(following)
    if other not in ("", process) or matching_text(line) or matching_text(following):
        return ""
    if denied_topic(line) or denied_topic(following) or security_directory(following):
        return ""
    return next(
        (candidate for candidate in (rest + end, f"{rest} {end}") if matching_text(candidate)), ""
    )


def _meaning_of(line: str, rest: str) -> tuple[LogText, re.Match[str] | None]:
    """Return the meaning of a line, and its match, if any; ``rest`` is the line without label."""
    if meaning := matching_zenoh_text(line):
        return meaning
    if ZENOH_LINE.search(rest):  # other lines of Zenoh's log are no security problem
        return UNKNOWN, None
    if meaning := matching_text(line):
        return meaning
    return UNKNOWN, None if denied_topic(line) else UNKNOWN.pattern.search(rest)


def _strongest_hits(hits: Iterable[_Hit], reported: set[str]) -> Iterator[_Hit]:
    """Yield the hits, without weak hits of processes that also have a stronger hit.

    ``reported`` are the processes whose denied topics are reported separately.
    """
    all_hits = list(hits)
    least = dict.fromkeys(reported, 0)
    for hit in all_hits:
        if hit.meaning is not UNKNOWN:
            least[hit.process] = min(
                hit.meaning.vagueness, least.get(hit.process, hit.meaning.vagueness)
            )
    return (hit for hit in all_hits if hit.meaning.vagueness <= least.get(hit.process, 0))


def _grouped_hits(hits: Iterable[_Hit]) -> Iterator[list[_Hit]]:
    groups: dict[tuple[str, str, str], list[_Hit]] = {}
    for hit in hits:
        groups.setdefault((hit.process, hit.enclave, hit.kind), []).append(hit)
    return iter(groups.values())


def _lines_naming(
    lines: list[str], denials: Sequence[Denial]
) -> Mapping[Denial, list[tuple[int, str]]]:
    """Map denials to the numbers and texts of lines that name the denied topic.

    If a process was denied a topic for several causes, a line that reports no denial belongs to the
    last denial before it.
    """
    of_topic = defaultdict[tuple[str, str], list[Denial]](list)
    for denial in denials:
        of_topic[denial.process, denial.topic].append(denial)
    topics = {topic for _, topic in of_topic}
    denial_at = {number: denial for denial in denials for number in denial.lines}
    lines_of = defaultdict[Denial, list[tuple[int, str]]](list)
    for number, line in enumerate(lines, 1):
        process, text = labeled_line(line)
        words = (word for pattern in _WORD_PATTERNS for word in pattern.findall(text))
        for topic in topics.intersection(words):
            causes = of_topic[process, topic]
            own = [denial for denial in causes if denial_at.get(number) == denial]
            if own or len(causes) == 1 or (causes and not denied_topic(text)):
                last = (own or causes)[0]
                lines_of[last].append((number, text))
                of_topic[process, topic] = sorted(causes, key=lambda denial: denial != last)
    return lines_of


# ── what Zenoh drops ───────────────────────────────────────────────────────────────────────

_RIGHT_OF_DROPPED_MESSAGE: Mapping[tuple[str, bool], str] = {
    ("Put", True): "publish",
    ("Delete", True): "publish",
    ("Declare Subscriber", True): "subscribe",
    ("Query", True): "call",
    ("Reply", True): "serve",
    ("Declare Queryable", True): "serve",
    ("Put", False): "subscribe",
    ("Delete", False): "subscribe",
    ("Declare Subscriber", False): "publish",
    ("Query", False): "serve",
    ("Reply", False): "call",
    ("Declare Queryable", False): "call",
}
"""Kind of message and whether the message was incoming → right that the remote process lacks."""
_GRAPH_RIGHTS: Mapping[tuple[str, bool], str] = {
    ("Liveliness Token", True): "announce this node, topic or service in the graph",
    ("Liveliness Token", False): "see this node, topic or service in the graph",
    ("Liveliness Query", True): "ask for the graph",
    ("Declare Liveliness Subscriber", True): "ask for the graph",
}


def _dropped_message_findings(
    lines: Iterable[str], root: str, own_name: str, keystore: SearchedKeystore | None
) -> Iterator[LogFinding]:
    """Yield a finding for each missing right for which Zenoh dropped messages.

    ``own_name`` is the enclave of the process that wrote the log, "" if unknown. If the process
    drops a message to or from its router, the process itself lacks the right: its configuration
    allows the router only what the process's own rights need.
    """
    numbered = ((n, *labeled_line(line[:_MAX_LINE_LENGTH])) for n, line in enumerate(lines, 1))
    groups: dict[tuple[str, str, bool, str], list[DroppedMessage]] = {}
    dropped = [*dropped_messages(numbered)]
    routers = keystore.zenoh_routers if keystore and dropped else frozenset[str]()
    for message in dropped:
        # Routers check each other, too: a process without a known name may be a router.
        is_node = own_name not in routers if own_name else len(routers) == 1
        lacks_own = message.name in routers and is_node
        kind = message.message, message.ingress is not lacks_own
        _, name = name_of_key(message.key)
        right = _RIGHT_OF_DROPPED_MESSAGE.get(kind, "") if name else ""
        dropped_right = f"{right} {name}" if right else _GRAPH_RIGHTS.get(kind, "")
        dropped_right = dropped_right or f"pass {message.message} of {message.key}"
        group = message.process, message.name or message.zid, lacks_own, dropped_right
        groups.setdefault(group, []).append(message)
    for (process, who, lacks_own, dropped_right), messages in groups.items():
        first = messages[0]
        if lacks_own:
            enclave, lacking = own_name, own_name or "the process that wrote this log"
        else:
            enclave = first.name
            lacking = enclave or f"the process with the zid {who}"
        yield LogFinding(
            "zenoh-dropped",
            None,
            first.line,
            len(messages),
            f"{first.message} ({'ingress' if first.ingress else 'egress'}) on {first.key}",
            process,
            enclave,
            f"{lacking} may not {dropped_right}: the process that logged this drops the message "
            "by its rules, and reports it nowhere else",
            _remedy_for_dropped(first, enclave, dropped_right, root),
            zenoh=True,
        )


def _remedy_for_dropped(
    dropped: DroppedMessage, enclave: str, dropped_right: str, root: str
) -> str:
    """Return the remedy for a dropped message if ``enclave`` ("": unknown) lacks the right."""
    if not dropped.name:
        return (
            "The log line with `on Interface(...)+CertCommonName(...)` and this zid has the name "
            "of the process. No rule applies to a process without a name."
        )
    asked = dropped_right if name_of_key(dropped.key)[1] else ""
    if not asked:
        return (
            "If it is an enclave of the keystore, `sros zenoh KEYSTORE --check` shows whether the "
            "files are up to date."
        ).replace(
            "KEYSTORE", quote(root) if root and is_original_keystore(Path(root)) else "KEYSTORE"
        )
    verb, _, name = asked.partition(" ")
    who = quote(enclave) if enclave else "ENCLAVE"
    command = f"sros explain {quote(root) if root else 'KEYSTORE'} {who}"
    shown = f"`{command} {verb} {quote(name)} --vendor zenoh` shows what is missing in the policy"
    return f"{shown}." if enclave else f"{shown}; ENCLAVE is the enclave of that process."


# ── examining ──────────────────────────────────────────────────────────────────────────────


class _Examiner:
    """The search for causes of log messages in the enclaves that the log names."""

    def __init__(
        self,
        find: FindEnclave,
        context: Callable[[LoadedEnclave], JoinContext],
        root: str,
        keystore: SearchedKeystore | None,
        policy: AskedPolicy | None,
        lines: Sequence[str],
    ) -> None:
        self._find = find
        self._lines = lines
        self._policy = policy
        self._context = context
        self._root = root
        self._keystore = keystore
        self._evaluators: dict[tuple[Vendor, str, bool], Evaluator] = {}

    @cached_property
    def _started_folders(self) -> frozenset[str]:
        """The real paths of the folders from which processes of the log started."""
        named = filter(None, map(security_directory, self._lines))
        return frozenset(os.path.realpath(line["folder"]) for line in named)

    def _as_started(self, enclave: LoadedEnclave | None) -> LoadedEnclave | None:
        """Return an enclave as the process started in it.

        A folder without any keys may be a copy of the robot's folder.  If the log names this very
        folder, it is no copy, and the missing key counts.
        """
        if enclave is None or enclave.folder is None or not enclave.key_elsewhere:
            return enclave
        is_started = os.path.realpath(enclave.folder) in self._started_folders
        return enclave._replace(key_elsewhere=not is_started)

    def _meaning(self, hit: _Hit, enclave: LoadedEnclave | None) -> LogText | None:
        """Return the meaning of a hit in its enclave; None if the hit is no security message."""
        unnamed = hit.enclave == "/" and enclave is None
        if hit.meaning is not RUNS_OPEN:
            return NO_ENCLAVE if unnamed and hit.meaning.id == "files-missing" else hit.meaning
        if enclave is None or self._policy:
            return RUNS_OPEN if unnamed else None
        problems = self._answer(enclave, Vendor.FAST, ask("join")).problems
        if starts_without_security(problems):
            return RAN_OPEN
        return UNNOTICED_FAULT if problems else None

    def message(self, hits: list[_Hit]) -> LogFinding | None:
        """Return the finding for a group of equal messages; None if they show no problem."""
        named = self._as_started(self._find(hits[0].enclave))
        meaning = self._meaning(hits[0], named)
        if meaning is None:
            return None
        first = replace(hits[0], meaning=meaning)
        vendor = vendor_of_line(first.text) if meaning is UNKNOWN else meaning.vendor
        remedy_of = self._with_names(meaning.remedy, named, first)
        plain = LogFinding(
            meaning.id,
            vendor,
            first.line,
            len(hits),
            first.text,
            first.process,
            first.enclave,
            _unknown_cause(hits) if meaning is UNKNOWN else first.cause,
            remedy_of,
            zenoh=meaning.id.startswith(ZENOH_IDS),
        )
        if meaning.id.startswith("peer-"):
            return self._with_peer_causes(plain, hits)
        path = first.fields.get("path", "")
        if meaning.id in _FOLDER_IDS and (place := _keystore_with(path)):
            text = EXPORT_FOR_USER_REMEDY if is_original_keystore(place) else CHANGE_OWNER_REMEDY
            advice = self._with_names(_with_name(text, "KEYSTORE", str(place)), named, first)
            if meaning.id != _FOLDER_IDS[0]:
                advice = f"{advice} {remedy_of}"
            return replace(plain, found=("the folder is here",), checked=True, remedy=advice)
        if better := self._other_folder_remedy(path, remedy_of):
            return replace(plain, remedy=better)
        examined = meaning.faults or meaning.id == "service"
        enclave = named if examined and not self._policy else None
        if enclave is None:
            return plain
        answer = self._answer(enclave, meaning.vendor or Vendor.FAST, ask("join"))
        causes = list(self._causes(enclave, answer, meaning.faults))
        if meaning.id == "service" and not causes:
            return replace(plain, enclave=enclave.name, found=_nodes_clause(answer), checked=True)
        causes = causes or list(self._wrong_domain_cause(enclave, answer, first))
        causes = causes or list(self._missing_key_cause(enclave, first))
        remedies = list(dict.fromkeys(remedy for _, remedy in causes if remedy))
        remedies += [remedy_of] * (meaning in STARTS)
        remedy = self._with_names(meaning.remedy_without_fault, enclave, first)
        nothing_found = f"{remedy} {_nothing_found(enclave)}".lstrip()
        return replace(
            plain,
            enclave=enclave.name,
            found=tuple(text for text, _ in causes),
            checked=True,
            remedy=" ".join(remedies) if remedies else nothing_found,
        )

    def _other_folder_remedy(self, path: str, remedy: str) -> str:
        """Return the remedy for a folder that a log reports missing and this keystore lacks.

        The result is "" if sros knows no remedy.
        """
        place, inside, name = path.rpartition("/enclaves/")
        if not inside or self._keystore is None:
            return ""
        if meant := self._keystore.enclaves_meant(f"/{name}"):
            return f"Perhaps you mean {' or '.join(meant)}. {remedy}"
        if self._find(f"/{name}") is None or Path(place).resolve() == Path(self._root).resolve():
            return ""
        command = f"sros env {quote(self._root)} {quote(f'/{name}')}"
        return (
            f"ROS_SECURITY_KEYSTORE names {place} and has to be {self._root}: `{command}` prints "
            "all variables."
        )

    def _with_names(self, text: str, enclave: LoadedEnclave | None, hit: _Hit) -> str:
        """Return a remedy with keystore, enclave and the hit's fields in place of placeholders."""
        own_name = enclave.name if enclave else hit.enclave.rstrip("/")
        own_name = "" if hit.meaning in (NO_ENCLAVE, RUNS_OPEN) else own_name
        if self._is_export and NEEDS_CA_KEYS.search(text):
            text = remedy_in_closed_robot(Path(self._root), self._remedy_for_export(text))
        else:
            text = _with_name(text, "KEYSTORE", self._root)
        return _with_name(text, "ENCLAVE", own_name).format(**hit.quoted)

    @cached_property
    def _is_export(self) -> bool:
        return (
            bool(self._root)
            and is_keystore(root := Path(self._root))
            and not is_original_keystore(root)
        )

    def _remedy_for_export(self, text: str) -> str:
        """Return a remedy with this export as KEYSTORE, except in commands that need CA keys."""
        parts = _COMMAND.split(text)
        named = [
            part if NEEDS_CA_KEYS.match(part) else _with_name(part, "KEYSTORE", self._root)
            for part in parts
        ]
        if all(NEEDS_CA_KEYS.match(command) for command in parts[1::2]):
            return remedy_in_original_keystore("".join(named))
        return (
            f"{''.join(named)} KEYSTORE is the {ORIGINAL_KEYSTORE}: export the enclave again from "
            "there."
        )

    def _with_peer_causes(self, finding: LogFinding, hits: Sequence[_Hit]) -> LogFinding:
        """Return the finding with causes and remedies in the enclaves of the peers in the log."""
        shown = dict.fromkeys(
            hit.fields["participant"] for hit in hits if hit.fields.get("participant")
        )
        names = (
            [self._keystore.peer(peer) for peer in islice(shown, _MAX_PEERS)]
            if self._keystore
            else []
        )
        peers = {name: self._find(name) for name in names if name}
        known: list[str] = []
        remedies: list[str] = []
        rotating = self._keystore.rotates if self._keystore else False
        for name, peer in peers.items():
            if peer is None:
                continue
            answer = self._answer(peer, finding.dds or Vendor.FAST, ask("join"))
            causes = list(self._causes(peer, answer, ()))
            known += [f"the peer is enclave {name}: {cause}" for cause, _ in causes]
            remedies += [f"{cause} Then restart its processes." for _, cause in causes if cause]
            if not causes:
                known.append(f"the peer is enclave {name}, whose current files have no fault")
                if not (rotating and finding.id in _ROTATION_IDS):
                    remedies.append(_OLDER_FILES.format(peer=name))
        if peers and rotating and finding.id in _ROTATION_IDS:
            of = f" of enclave {finding.enclave}" if finding.enclave else ""
            known.append("the CAs of this keystore are being replaced, and stage 2 is done")
            remedies = [_NOT_RESTARTED[finding.dds or Vendor.FAST].format(of=of)]
        text = " ".join(dict.fromkeys(remedies)) or finding.remedy
        only = next(iter(peers)) if len(peers) == 1 else ""
        text = re.sub(r"\bPEER\b", lambda _: quote(only), text) if only else text
        return replace(finding, found=tuple(known), checked=bool(known), remedy=text)

    def missing_namespaces(self, denials: Iterable[Denial]) -> dict[tuple[str, str], str]:
        """Map pairs of process and enclave to the namespace that is missing in all denied names.

        Empty if no service that every node offers is among the names, because in that case a
        remapping may be missing, not the namespace of the process.
        """
        by_process = defaultdict[tuple[str, str], list[Denial]](list)
        for denial in denials:
            if not denial.remote:
                by_process[denial.process, denial.enclave].append(denial)
        missing = {}
        for process, denied in by_process.items():
            enclave = self._find(process[1])
            if enclave is None or not any(map(node_denied_own_service, denied)):
                continue
            answer = self._answer(enclave, denied[0].vendor, ask("join"))
            spaces = {node.rpartition("/")[0] for node in _served_names(answer)}
            ns = spaces.pop() if len(spaces) == 1 else ""
            if ns and all(self._is_allowed_in(ns, denial, enclave) for denial in denied):
                missing[process] = ns
        return missing

    def _is_allowed_in(self, ns: str, denial: Denial, enclave: LoadedEnclave) -> bool:
        """Return whether a denied topic would be allowed if its name had a namespace before it."""
        if not denial.direction or denial.topic[2:3] != "/":
            return False
        moved = replace(denial, topic=f"{denial.topic[:2]}{ns}{denial.topic[2:]}")
        now, then = (
            self._answer(enclave, denial.vendor, _question(asked_denial))
            for asked_denial in (denial, moved)
        )
        return then.allowed and not now.allowed

    def denial(self, denial: Denial, named: list[tuple[int, str]], ns: str = "") -> LogFinding:
        """Return the finding for a denied topic; ``named`` are the lines that name the topic.

        ``ns`` is the namespace that is missing in all names of the process, or "".
        """
        line, text = named[0][0], " ".join(named[0][1].split())
        right, name, kind = _in_ros_terms(denial)
        denied = f"action {name}, of which {denial.topic} is a part" if kind == "action" else name
        who = "a peer" if denial.remote else denial.enclave or "the process"
        if enclave := None if denial.remote else self._find(denial.enclave):
            denial = replace(denial, enclave=enclave.name)
        by = {
            True: "a rule of the policy denies it",
            False: "no rule allows it",
            None: "its permissions do not allow it",
        }[denial.by_rule]
        if node := node_denied_own_service(denial):
            by += f"; every node has this service, and here it belongs to node {node}"
        finding = LogFinding(
            "topic-denied",
            denial.vendor,
            line,
            len(named),
            text,
            denial.process,
            denial.enclave,
            f"{who} may not {right} {denied}: {by}",
            self._how_to_ask(denial, name),
        )
        if enclave is None:
            return finding
        directions = (denial.direction,) if denial.direction else (PUBLISH, SUBSCRIBE)
        answers = [
            self._answer(enclave, denial.vendor, _question(replace(denial, direction=direction)))
            for direction in directions
        ]
        answer = answers[0]
        is_allowed = any if denial.neither else all
        if is_allowed(answer.allowed for answer in answers):
            rules = "policy allows" if self._policy else "current permissions allow"
            one = "" if all(answer.allowed for answer in answers) else " in one direction"
            created = ", which is enough to create the topic" if one else ""
            facts = [f"the {rules} it{one}{self._namespace_clause(enclave)}{created}"]
            elsewhere, remedy = self._other_folder_cause(denial, enclave)
            facts += elsewhere
            remedy = remedy or (
                "The process loaded permissions of another policy. Perhaps that policy is earlier "
                "or edited. Or it was merged with --remap, and the process lacks the remapping. "
                "Ask for the robot's policy, and name it in place of this one. If this is the "
                "robot's policy, sign it, export the enclave, and restart the process."
                if self._policy
                else "Restart the process: it loaded earlier permissions. If it runs from an "
                "export, export the enclave again first."
            )
        elif not denial.direction:
            facts = [answer.decision.text for answer in answers]
            remedy = self._remedy_in_a_namespace(denial, name, finding.remedy)
        elif ns:
            facts = [answer.decision.text, f"the enclave may {right} {ns}{name}"]
            remedy = (
                f"All names that are denied to the process lack the namespace {ns}: start it with "
                f"`--ros-args -r __ns:={quote(ns)}`, or with `namespace=` in its launch file. If "
                f"{name} is right, {finding.remedy}"
            )
        else:
            other, better = self._other_node_cause(denial, answer)
            if not other:
                other, better = self._similar_name_cause(denial, name, enclave, finding.remedy)
            asked = [question.allowed(enclave.name) for question in _questions_to_ask(denial)]
            if likely := self._policy.likely_namespace(asked[0]) if self._policy and asked else "":
                other = [f"in the namespace {likely}, the policy allows it"]
                better = (
                    f"Perhaps the robot has the policy in {likely} (`--namespace {quote(likely)}` "
                    "of `sros merge_policy`). If so, rcl's line `Found security directory` in the "
                    f"whole log names an enclave in {likely}. Otherwise, {finding.remedy}"
                )
            elif not other:
                better = self._remedy_in_a_namespace(denial, name, better or finding.remedy)
            facts = [answer.decision.text, *other]
            remedy = better or finding.remedy
        return replace(finding, found=tuple(facts), checked=True, remedy=remedy)

    def _remedy_in_a_namespace(self, denial: Denial, name: str, remedy: str) -> str:
        """Return a remedy that asks for the namespace, if only the policy of a package is known."""
        if not self._policy or denial.folder or denial.by_rule:
            return remedy
        space = self._policy.possible_namespace(name, denial.enclave)
        if not space or self._private_name(denial, name, ""):
            return remedy
        written = self._private_name(denial, name, space) or name.removeprefix(f"{space}/")
        return (
            f"Perhaps {space} is the namespace of the node: then write "
            f"{written} in the policy, without a / at its beginning (if the "
            "policy is for this version of the node). Ask for the whole log: rcl's line `Found "
            f"security directory` shows the namespace. Otherwise: {remedy}"
        )

    def _namespace_clause(self, enclave: LoadedEnclave) -> str:
        """Return a clause that names the policy's enclave for an enclave in a namespace, or ""."""
        space, path = self._policy.place(enclave.name) if self._policy else ("", "")
        return f" to {path}, which is {enclave.name} in namespace {space}" if space else ""

    def _other_folder_cause(self, denial: Denial, enclave: LoadedEnclave) -> tuple[list[str], str]:
        """Return cause and remedy if the process loaded its files from another folder."""
        folder, loaded = Path(denial.folder), None
        with suppress(SrosError, OSError):  # the path comes from the log, so it may be anything
            if folder.is_absolute() and enclave.folder and not folder.samefile(enclave.folder):
                loaded = signed_enclave(None, str(folder), self._context(enclave).at)
        if loaded is None:
            return [], ""
        answer = Evaluator(denial.vendor, loaded, self._context(loaded)).answer(_question(denial))
        if answer.allowed:
            return [f"the process runs from '{folder}', whose permissions also allow it"], (
                "Restart the process: it loaded earlier permissions."
            )
        return [f"the process runs from '{folder}', and there {answer.decision.text}"], (
            f"Export enclave {enclave.name} again, install it there, and restart the process."
        )

    def _other_node_cause(self, denial: Denial, answer: Answer) -> tuple[list[str], str]:
        """Return causes and a remedy if the permissions are for a node with another name."""
        node, nodes = node_denied_own_service(denial), _served_names(answer)
        if node and not any(covers(own_node, node) for own_node in nodes):
            enclaves: tuple[str, ...] = ()
            if self._keystore:
                enclaves = self._keystore.enclaves_for(node)
            elif self._policy:
                enclaves = self._policy.enclaves_for(node, denial.enclave)
            beginning = f"the permissions are for {_listed_nodes(nodes)}, and " if nodes else ""
            if enclaves:
                return [
                    f"{beginning}this is the node {node}, for which there is "
                    f"{_enclaves_text(enclaves)}"
                ], (
                    "Start the node in its enclave: `sros run "
                    f"{quote(self._root or 'KEYSTORE')} {quote(enclaves[0])} -- COMMAND`."
                )
            if nodes:
                advice = _renaming_advice(nodes, node, denial.enclave)
                return [f"{beginning}this is the node {node}"], advice
        if not nodes and (node or denial.topic in _TOPICS_OF_EVERY_NODE):
            return [f"the permissions lack {_EVERY_NODE}"], (
                'Add <xi:include href="common/node.xml" xpointer="xpointer(/profile/*)"/> to the '
                "node's profile, or run `sros generate_policy POLICY --enclave "
                f"{quote(denial.enclave)} --from-log LOG`."
            )
        return [], ""

    def _similar_name_cause(
        self, denial: Denial, name: str, enclave: LoadedEnclave, remedy: str
    ) -> tuple[list[str], str]:
        """Return causes and a remedy if the enclave has rights to similarly spelled names."""
        questions = _questions_to_ask(denial)
        if len(questions) != 1 or denial.by_rule:
            return [], ""
        (question,) = questions
        asked = self._answer(enclave, denial.vendor, question)
        denied = question.allowed(enclave.name)
        if other := meaning_of_other_kind(denied, named_rights(asked)):
            return [f"{other}, but {name} is {with_article(question.type)}"], ""
        is_used = self._keystore.has_other_side(denied) if self._keystore else None
        names = likely_names(asked)
        if is_used:  # a name that peers have a right to is probably no mistake
            if misspelled := self._misspelled_in_policy(denied, named_rights(asked)):
                nobody = f"which no enclave may {PEER_RIGHT[denied.right]}"
                use = f"{question.word} {misspelled}, {nobody}"
                return [f"the enclave may {use}: perhaps {name} is meant"], (
                    f"If the policy misspells the name, write {name} in place of {misspelled} "
                    f"there. Otherwise, {remedy}"
                )
            names = tuple(other for other in names if _last_part(other) == _last_part(name))
        own = [right.name for right in named_rights(asked) if right.right == denied.right]
        meant = names[0] if names else own[0] if len(own) == 1 else "NEW"
        rule = Remapping("", name, meant)
        add, renamed = f", add `--ros-args -r {quote(str(rule))}`.", ""
        new_name = (
            f" If the node is started with `-r OLD:={quote(name)}`, its policy needs the same "
            f"remapping: `sros merge_policy POLICY OTHER --remap OLD:={quote(name)}`."
        )
        if question.type == "action" and not is_used:
            add = f": {renamed_action_text(rule)}"
            renamed = f" If the node's command renames the action{add}"
        if names:
            is_meant = f"{' and '.join(names)}: perhaps that is meant"
            facts = [f"the enclave may {question.word} {is_meant}"]
            if is_used:
                return facts, f"{remedy} Or, if the node lacks a remapping that its policy has{add}"
            misspelled = ""
            if is_typing_error(name, meant):
                misspelled = f"If the program misspells the name, write {meant} there. "
            return facts, (
                f"{misspelled}If the node lacks a remapping{add} If the policy lacks a remapping "
                f"that the node has, write {name} in place of {meant} in the policy, or merge the "
                f"policy with `--remap {quote(meant)}:={quote(name)}`. Otherwise, {remedy}"
            )
        if is_used is False and self._keystore:
            place = self._keystore.place
            return [f"no enclave of the {place} may {PEER_RIGHT[denied.right]} {name}"], (
                f"{remedy} Or, if another name is meant, the node lacks a remapping, or has a "
                "wrong one: compare the command that started it with the robot's own (after `sros "
                f"close`: start/commands.txt).{renamed or new_name}"
            )
        return [], f"{remedy}{renamed or new_name}"

    def _misspelled_in_policy(self, denied: Right, named: Iterable[Right]) -> str:
        """Return a name like the denied one that only the enclave may use, not its peers, or ""."""
        for right in named:
            is_alike = right.right == denied.right and is_spelled_alike(denied.name, right.name)
            if is_alike and self._keystore and self._keystore.has_other_side(right) is False:
                return right.name
        return ""

    def _how_to_ask(self, denial: Denial, name: str) -> str:
        """Return the commands that show which rights a policy lacks for a denied topic."""
        root, enclave = self._root or "KEYSTORE", denial.enclave or "ENCLAVE"
        asked, advice = self._policy.file if self._policy else root, ""
        if self._policy:
            ns, path = self._policy.place(denial.enclave or self._policy.name)
            enclave = path or self._policy.name or enclave
            private = self._private_name(denial, name, ns)
            if ns and name.startswith(f"{ns}/"):
                name = name.removeprefix(ns)
                advice = (
                    f" as {name[1:]}, without a / at its beginning: the robot of the log has the "
                    f"policy in namespace {ns}"
                )
            if private:
                advice = f" as {private}: it is a private name of the node"
        enclave = "PEER" if denial.remote else enclave
        commands = [
            f"`sros explain {quote(asked)} {quote(enclave)} {question.word} {quote(name)}"
            f"{' --type action' * (question.type == 'action')}`"
            for question in _questions_to_ask(denial)
        ]
        if commands:
            shows = "shows" if len(commands) == 1 else "show"
            if denial.by_rule:
                return (
                    f"{' and '.join(commands)} {shows} the DENY, and where the policy has it: no "
                    "ALLOW helps against it."
                )
            return (
                f"{' and '.join(commands)} {shows} what is missing in the policy. If the policy is "
                "for another version of the node, use the policy of the node's version; otherwise, "
                f"add what is missing{advice}.{_parameter_client_hint(denial, name)}"
            )
        folder = f"{root}/enclaves/{enclave.lstrip('/')}".rstrip("/")
        return (
            f"`sros inspect {quote(folder)}` shows what the permissions allow: no policy in ROS "
            "terms can name this topic."
        )

    @cached_property
    def _logging_nodes(self) -> Mapping[str, Sequence[str]]:
        """Map each process to the full names of the nodes that logged, shortest first."""
        nodes = defaultdict[str, set[str]](set)
        for process, message in map(labeled_line, self._lines):
            if node := logging_node(message):
                nodes[process].add(node)
        return {process: sorted(names, key=len) for process, names in nodes.items()}

    def _private_name(self, denial: Denial, name: str, space: str) -> str:
        """Return a denied name as ``~/NAME`` if it is private to a node of the process, or "".

        The log shows a renamed node, the policy any other one, in the namespace ``space``.
        """
        if self._policy is None or denial.remote or _in_ros_terms(denial)[0] == "call":
            return ""  # a node calls the services of other nodes
        for node in self._logging_nodes.get(denial.process, ()):
            if node.startswith(f"{space}/") and name.startswith(f"{node}/"):
                return f"~{name.removeprefix(node)}"
        return self._policy.private_name(name, space, denial.enclave or self._policy.name)

    def _answer(self, enclave: LoadedEnclave, vendor: Vendor, question: Question) -> Answer:
        of = vendor, enclave.name, enclave.key_elsewhere
        if of not in self._evaluators:
            self._evaluators[of] = Evaluator(vendor, enclave, self._context(enclave))
        return self._evaluators[of].answer(question)

    def _causes(
        self, enclave: LoadedEnclave, answer: Answer, faults: tuple[Fault, ...]
    ) -> Iterator[tuple[str, str]]:
        """Yield faults in ``faults`` with remedies; if there are none, all faults of the
        enclave.
        """
        fitting = [problem for problem in answer.problems if problem.fault in faults]
        for problem in fitting or answer.problems:
            yield str(problem), remedy(problem.fault, self._root, enclave.name, problem.file)
        if not answer.problems and not answer.allowed:
            decision = answer.decision
            yield decision.text, remedy(decision.reason, self._root, enclave.name)

    def _missing_key_cause(self, enclave: LoadedEnclave, hit: _Hit) -> Iterator[tuple[str, str]]:
        """Yield cause and remedy for a missing file if only the key is missing in a folder without
        any keys, which may be a copy of the robot's folder.
        """
        names_other_file = KEY_FILE not in hit.fields.get("path", KEY_FILE)
        if names_other_file or Fault.FILE_MISSING not in hit.meaning.faults:
            return
        if enclave.key_elsewhere and not enclave.as_here.key_elsewhere:
            yield (
                f"{KEY_FILE}: missing, as in a copy without keys; if this is the robot, it is the "
                "fault",
                remedy(Fault.FILE_MISSING, self._root, enclave.name, KEY_FILE),
            )

    def _wrong_domain_cause(
        self, enclave: LoadedEnclave, answer: Answer, hit: _Hit
    ) -> Iterator[tuple[str, str]]:
        """Yield the cause and remedy if a process was in a domain that its documents exclude."""
        topic, domain = hit.fields.get("topic", ""), hit.fields.get("domain", "")
        if hit.meaning.id == "domain" and topic:
            asked = _question(Denial(topic, PUBLISH))
            decision = self._answer(enclave, answer.vendor, asked).decision
            if decision.reason == "no-topic-rule":
                yield decision.text, remedy(decision.reason, self._root, enclave.name)
                return
        governed = enclave.domains
        if hit.meaning.id not in _DOMAIN_IDS or governed is None:
            return
        where = f"domain {domain}" if domain else "another domain"
        if domain and int(domain) in governed:
            return
        yield (
            f"the governance is for domain {governed}: the process was in {where}, or had loaded "
            "another governance",
            remedy(Fault.GOVERNANCE_DOMAIN, self._root, enclave.name).replace(
                "domain of the keystore", f"domain of the keystore, such as {next(iter(governed))}"
            ),
        )


def _keystore_with(path: str) -> Path | None:
    """Return the keystore that has the enclave folder ``path`` of a log, or None.

    The check is strict, because the log chooses the path, and the remedy changes the owner of the
    keystore.
    """
    place, _, name = path.rpartition("/enclaves/")
    with suppress(OSError, ValueError, SrosError):
        is_plain = place.startswith("/") and ".." not in Path(path).parts
        if is_plain and name and Path(path).is_dir() and is_keystore(Path(place)):
            return Path(place)
    return None


def _unknown_cause(hits: Iterable[_Hit]) -> str:
    """Return the cause for lines with unknown meaning: the different texts of these lines."""
    lines: dict[str, int] = {}
    for hit in hits:
        lines.setdefault(_CHANGING_NUMBERS.sub("", plain_refusal(hit.text)), hit.line)
    if len(lines) == 1:
        return UNKNOWN.cause
    shown = first_few([str(line) for line in lines.values()], _MOST_LINES)
    return f"{len(lines)} different lines of DDS Security that sros does not know: lines {shown}"


def _with_name(text: str, word: str, name: str) -> str:
    """Return a remedy with the quoted ``name`` in place of ``word``; unchanged if ``name`` is "".

    Braces are doubled, because the remedy is a format string.
    """
    if not name:
        return text
    plain = quote(name).replace("{", "{{").replace("}", "}}")
    # Whole words only: the word KEYSTORE also ends the variable ROS_SECURITY_KEYSTORE.
    return plain.join(re.split(rf"\b{word}\b", text))


_COMMAND = re.compile(r"(`sros\b[^`]*`)")
_MOST_LINES = 20
_MAX_PEERS = 5
"""Maximum number of peers that are examined for one message."""
_ROTATION_IDS = ("peer-signature", "peer-permissions-ca")
_NOT_RESTARTED = {
    Vendor.FAST: "Restart this process{of}: it was not restarted since stage 1, and so does not "
    "know the new CA.",
    Vendor.CYCLONE: "Restart this process{of} and the peer: one of them was not restarted since "
    "stage 2, and Cyclone DDS trusts one CA at a time.",
}
_OLDER_FILES = (
    "Restart the processes of {peer}, and then this process: one of them loaded older files."
)
_FOLDER_IDS = ("enclave-missing", "runs-unsecured")
_DOMAIN_IDS = ("domain", "domain-of-permissions")
_EVERY_NODE = "the rights that every node needs: parameter services, /rosout, /parameter_events"
_TOPICS_OF_EVERY_NODE = ("rt/rosout", "rt/parameter_events")


def _nodes_clause(answer: Answer) -> tuple[str, ...]:
    """Return a tuple with a clause on the nodes that an enclave's permissions name; or ()."""
    nodes = _served_names(answer)
    if nodes:
        return (f"its permissions are for {_listed_nodes(nodes)}",)
    return (f"its permissions lack {_EVERY_NODE}",)


def _parameter_client_hint(denial: Denial, name: str) -> str:
    """Return which other services a parameter client needs, if it may not call one; or ""."""
    node, _, service = name.rpartition("/")
    is_client = service_of(denial.topic)[0] and not node_denied_own_service(denial)
    if service not in PARAMETER_SERVICES or not is_client:
        return ""
    others = enumerated([other for other in PARAMETER_SERVICES if other != service])
    text = PARAMETER_CLIENT_TEXT.format(f"{others} of {node}")
    return f" {text[0].upper()}{text[1:]}."


def _last_part(name: str) -> str:
    return name.rpartition("/")[2]


def _served_names(answer: Answer) -> tuple[str, ...]:
    rights = grant_rights("", answer.grant) if answer.grant else ()
    return nodes_served((right.right, right.name) for right in rights)


def _renaming_advice(nodes: Sequence[str], wrong: str, enclave: str) -> str:
    """Return the remedy for a node named ``wrong`` in an enclave that is for other ``nodes``.

    A rule without the name of a node renames all nodes of a process.
    """
    meant = likely_enclaves(wrong, nodes) or nodes
    ns, _, name = meant[0].rpartition("/")
    rules = f"`--ros-args -r __node:={quote(name)} -r __ns:={quote(ns or '/')}`"
    start = f"Start the node under that name ({rules})"
    if len(nodes) > 1:
        # rcl looks up the rule for the namespace by the node's new name.
        rules = f"`--ros-args -r {quote(wrong.rpartition('/')[2])}:__node:={quote(name)} "
        rules += f"-r {quote(name)}:__ns:={quote(ns or '/')}`"
        new_name = meant[0] if len(meant) == 1 else f"one of these names, such as {meant[0]}"
        start = (
            f"The enclave is for several nodes. Rename only this node, to {new_name}, in its code "
            f"or launch file, or with {rules}; `-r __node:=` would rename all nodes of the process"
        )
    renamed = ""
    if len(meant) == 1:
        renamed = (
            f". If the new name is wanted, write {wrong} in the profile of {meant[0]}, or, for the "
            "policy of a package, merge it again, into a policy without the node: `sros "
            f"merge_policy POLICY OTHER {_merge_options(meant[0], wrong)}`, with the name that "
            "OTHER has for the node before `:__node`"
        )
    return (
        f"{start}{renamed}. A further node needs a profile with common/node.xml: in the policy of "
        f"{enclave}, or in an enclave of its own if it is another program."
    )


def _merge_options(node: str, renamed: str) -> str:
    """Return the options with which `sros merge_policy` gives a node another full name."""
    (ns, _, name), (new_ns, _, new_name) = node.rpartition("/"), renamed.rpartition("/")
    rules = [f"{name}:__node:={new_name}"] * (name != new_name)
    rules += [f"{new_name}:__ns:={new_ns or '/'}"] * (ns != new_ns)
    return " ".join(f"--remap {quote(rule)}" for rule in rules)


def _enclaves_text(enclaves: Sequence[str]) -> str:
    return f"the enclave{'s' * (len(enclaves) > 1)} {' and '.join(enclaves)}"


def _listed_nodes(nodes: Sequence[str]) -> str:
    return f"the node{'s' * (len(nodes) > 1)} {', '.join(nodes)}"


def _nothing_found(enclave: LoadedEnclave) -> str:
    return (
        f"Enclave {enclave.name} now has no fault that would explain the message: "
        "check the files on the robot itself, its clock and its time zone."
    )


def _in_ros_terms(denial: Denial) -> tuple[str, str, str]:
    """Return the denied operation (one of `answer.WORDS`, or "use"), the ROS name, and its type.

    A topic or a service of an action counts as the action. For a topic without a ROS name, the name
    is the topic, and the type is "".
    """
    right, name = right_to_use(denial.topic, writes=denial.direction == PUBLISH)
    if not right:
        return denial.direction or "use", name, ""
    action, _ = action_part(name)
    word, kind = _WORD_AND_TYPE_OF_RIGHT[right]
    if action:
        word, kind = "execute" if right in ("publish", "reply") else "call", "action"
    return word if denial.direction else "use", action or name, kind


_WORD_AND_TYPE_OF_RIGHT = {
    "publish": (PUBLISH, "topic"),
    "subscribe": (SUBSCRIBE, "topic"),
    "request": ("call", "service"),
    "reply": ("serve", "service"),
}


_WORDS_OF_TYPES = {
    "topic": (PUBLISH, SUBSCRIBE),
    "service": ("call", "serve"),
    "action": ("call", "execute"),
}


def _questions_to_ask(denial: Denial) -> tuple[Question, ...]:
    """Return the questions to ask `sros explain` about a denied topic; () without a ROS name."""
    right, name, kind = _in_ros_terms(denial)
    if not kind:
        return ()
    words = _WORDS_OF_TYPES[kind] if right == "use" else (right,)
    try:
        return tuple(ask(word, name, kind) for word in words)
    except SrosError:  # not a valid ROS name
        return ()


def _question(denial: Denial) -> Question:
    """Return a question about the denied topic only."""
    part = Part(AccessVerb(denial.direction), denial.topic)
    return Question(denial.direction, "topic", denial.direction, denial.topic, (part,))
