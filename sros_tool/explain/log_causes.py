"""The causes of security messages in a log, found in the enclaves that the log names."""

from __future__ import annotations

import os
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from shlex import quote

from sros_tool.dds.decision.access import AccessVerb
from sros_tool.dds.decision.vendors import Vendor
from sros_tool.errors import SrosError
from sros_tool.explain.answer import Answer, Evaluator, Part, Question, ask, with_article
from sros_tool.explain.asking import signed_enclave
from sros_tool.explain.denials import PARAMETER_CLIENT_TEXT, Denial, node_denied_own_service
from sros_tool.explain.explanation import (
    explain,
    lacking_part,
    likely_names,
    likely_unused_name,
    meaning_of_other_kind,
    named_rights,
    remedy,
)
from sros_tool.explain.log_lines import LogHit
from sros_tool.explain.log_sources import AskedPolicy, FindEnclave, SearchedKeystore
from sros_tool.faults import NEEDS_CA_KEYS, ORIGINAL_KEYSTORE, Fault, remedy_in_original_keystore
from sros_tool.graph.observation import PUBLISH, SUBSCRIBE
from sros_tool.keystore.layout import (
    KEY_FILE,
    RobotEnclaves,
    enclaves_of_closed_robot,
    folder_of_closed_robot,
    how_to_learn_one_process,
    is_keystore,
    is_original_keystore,
    remedy_in_closed_robot,
)
from sros_tool.keystore.loading import starts_without_security
from sros_tool.keystore.participant import JoinContext, LoadedEnclave
from sros_tool.keystore.selection import likely_names as likely_enclaves
from sros_tool.names import (
    PARAMETER_SERVICES,
    action_part,
    expand,
    is_expression,
    nodes_served,
    right_to_use,
    service_of,
)
from sros_tool.policy.model import PEER_RIGHT
from sros_tool.policy.patterns import covers
from sros_tool.policy.remapping import Remapping, renamed_action_text
from sros_tool.policy.rights import Right
from sros_tool.runtime.environment import remapping_rules
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
    labeled_line,
    logging_node,
    plain_refusal,
    security_directory,
    vendor_of_line,
)
from sros_tool.runtime.zenoh_log import ZENOH_IDS
from sros_tool.spelling import is_spelled_alike, is_typing_error
from sros_tool.translate import grant_rights
from sros_tool.values import shows
from sros_tool.wording import capitalized, enumerated, first_few, perhaps_meant

_CHANGING_NUMBERS = re.compile(r"\b[0-9a-f]{2}(?:\.[0-9a-f]{2}){5,}\S*|\d+")


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
    """Number of log lines with the message, also by later processes of the enclave."""
    text: str
    """Text of the first line."""
    process: str
    """The process that printed the message; empty (null in JSON) if it is unknown."""
    enclave: str
    """The enclave of the process; empty (null in JSON) if it is unknown."""
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
        """The DDS vendor that printed the message; ``zenoh`` for Zenoh, null for ROS 2."""
        if self.zenoh:
            return "zenoh"
        return self.dds.value if self.dds else None


class Examiner:
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
        """Return the enclave; a missing key counts if a process of the log started in its folder.

        A folder without any keys may be a copy of the robot's folder.  If the log names this very
        folder, it is no copy, and the missing key counts.
        """
        if enclave is None or enclave.folder is None or not enclave.key_elsewhere:
            return enclave
        is_started = os.path.realpath(enclave.folder) in self._started_folders
        return enclave._replace(key_elsewhere=not is_started)

    def _meaning(self, hit: LogHit, enclave: LoadedEnclave | None) -> LogText | None:
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

    def message_finding(self, hits: list[LogHit]) -> LogFinding | None:
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
        if meaning.id in _FOLDER_IDS and (place := _keystore_of_file(path)):
            text = EXPORT_FOR_USER_REMEDY if is_original_keystore(place) else CHANGE_OWNER_REMEDY
            advice = self._with_names(_with_name(text, "KEYSTORE", str(place)), named, first)
            if meaning.id != _FOLDER_IDS[0]:
                advice = f"{advice} {remedy_of}"
            return replace(
                plain, found=("the folder exists on this machine",), checked=True, remedy=advice
            )
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
        nothing_found = f"{remedy} {_nothing_found_text(enclave)}".lstrip()
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
            f"ROS_SECURITY_KEYSTORE names {place}, but has to name {self._root}: `{command}` "
            "prints all variables."
        )

    def _with_names(self, text: str, enclave: LoadedEnclave | None, hit: LogHit) -> str:
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

    def _with_peer_causes(self, finding: LogFinding, hits: Sequence[LogHit]) -> LogFinding:
        """Return the finding with causes and remedies in the enclaves of the peers in the log."""
        shown = dict.fromkeys(
            hit.fields["participant"] for hit in hits if hit.fields.get("participant")
        )
        names = (
            [self._keystore.enclave_of_peer(peer) for peer in islice(shown, _MAX_PEERS)]
            if self._keystore
            else []
        )
        peers = {name: self._find(name) for name in names if name}
        known: list[str] = []
        remedies: list[str] = []
        rotating = self._keystore.is_reissuing if self._keystore else False
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
            known.append(
                "the CAs of this keystore are being replaced, and the stage reissue is done"
            )
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
        """Return whether a denied topic is allowed only with the namespace ``ns`` before it."""
        if not denial.direction or denial.topic[2:3] != "/":
            return False
        moved = replace(denial, topic=f"{denial.topic[:2]}{ns}{denial.topic[2:]}")
        now, then = (
            self._answer(enclave, denial.vendor, _question(asked_denial))
            for asked_denial in (denial, moved)
        )
        return then.allowed and not now.allowed

    def denial_finding(
        self, denial: Denial, named: list[tuple[int, str]], ns: str = ""
    ) -> LogFinding:
        """Return the finding for a denied topic; ``named`` are the lines that name the topic.

        ``ns`` is the namespace that is missing in all names of the process, or "".
        """
        line, text = named[0][0], " ".join(named[0][1].split())
        right, name, kind = _operation_in_ros_terms(denial)
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
            self._commands_to_ask(denial, name),
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
                "The process loaded permissions of another policy, perhaps of an earlier or "
                "an edited version of this policy. Or this policy was merged with "
                "--remap, and the process lacks the remapping. Ask for the robot's policy, and "
                "name it in place of this one. If this is the robot's policy, sign it, export "
                "the enclave, and restart the process."
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
                f"`--ros-args -r __ns:={quote(ns)}`, or with `namespace=` in its launch file. "
                f"{_otherwise(finding.remedy)}"
            )
        else:
            other, better = self._other_node_cause(denial, answer)
            if not other:
                other, better = self._similar_name_cause(denial, name, enclave, finding.remedy)
            asked = [question.needed_right(enclave.name) for question in _questions_to_ask(denial)]
            if likely := self._policy.likely_namespace(asked[0]) if self._policy and asked else "":
                other = [f"in the namespace {likely}, the policy allows it"]
                better = (
                    f"Perhaps the robot has the policy in {likely} (`--namespace {quote(likely)}` "
                    "of `sros merge_policy`). If so, rcl's line `Found security directory` in the "
                    f"whole log names an enclave in {likely}. {_otherwise(finding.remedy)}"
                )
            elif not other:
                better = self._remedy_in_a_namespace(denial, name, better or finding.remedy)
            lines, sign = self._policy_facts(enclave, denial)
            facts = [answer.decision.text, *lines, *other * (not sign)]
            remedy = sign or better or finding.remedy
        return replace(finding, found=tuple(facts), checked=True, remedy=remedy)

    def _policy_facts(self, enclave: LoadedEnclave, denial: Denial) -> tuple[list[str], str]:
        """Return what the policy given with a keystore states about a denied topic, and a remedy.

        The remedy is "" unless the policy allows the topic, so that it has to be signed.
        """
        if self._policy or enclave.policy is None:
            return [], ""
        evaluator = Evaluator(denial.vendor, enclave, self._context(enclave))
        answer = explain(evaluator, _question(denial))
        facts = [f"{line.source}: {line.stated}" for line in answer.lines]
        if not answer.sign:
            return facts, ""
        facts.append(
            f"'{enclave.policy_file}' allows it: the permissions are older, or from another policy"
        )
        commands = ", then ".join(f"`{command}`" for command in answer.commands)
        return facts, f"Sign the policy ({commands}), and restart the process."

    def _remedy_in_a_namespace(self, denial: Denial, name: str, remedy: str) -> str:
        """Return ``remedy``; for a package's policy, after a remedy for a missing namespace."""
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
            f"security directory` shows the namespace. {_otherwise(remedy)}"
        )

    def _namespace_clause(self, enclave: LoadedEnclave) -> str:
        """Return a clause with the name that the policy has for an enclave, or "".

        "" unless the policy was put into a namespace, so that the names differ.
        """
        space, path = self._policy.namespace_and_path(enclave.name) if self._policy else ("", "")
        return f" to {path}, which is {enclave.name} in namespace {space}" if space else ""

    def _other_folder_cause(self, denial: Denial, enclave: LoadedEnclave) -> tuple[list[str], str]:
        """Return causes and a remedy if the process loaded files from another folder; or [], ""."""
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
        """Return causes and a remedy if the permissions are for another node's name; or [], ""."""
        node, nodes = node_denied_own_service(denial), _served_names(answer)
        if node and not any(covers(own_node, node) for own_node in nodes):
            beginning = f"the permissions are for {_nodes_text(nodes)}, and " if nodes else ""
            if enclaves := self._enclaves_for_process(node, denial):
                are = "is" if len(enclaves) == 1 else "are"
                cause = f"{beginning}this is the node {node}, for which there {are} "
                cause += _enclaves_text(enclaves)
                advice = (
                    "Start the node in its enclave: `sros run "
                    f"{quote(self._root or 'KEYSTORE')} {quote(enclaves[0])} -- COMMAND`."
                )
                if meant := self._same_name_elsewhere(denial, node, nodes):
                    ns = meant.rpartition("/")[0] or "/"
                    return [cause, f"{meant} has the same name in another namespace"], (
                        f"If the node should be {meant}, its namespace is wrong: start it with "
                        f"`--ros-args -r __ns:={quote(ns)}`, or with `namespace=` in its launch "
                        f"file. If it should be {node}, {_within_sentence(advice)}"
                    )
                return self._composed_cause(denial, node, nodes, cause, advice)
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

    def _same_name_elsewhere(self, denial: Denial, node: str, nodes: Sequence[str]) -> str:
        """Return the only node of ``nodes`` whose name differs by the namespace, or "".

        The result is "" if the log shows that the process runs this node, too.
        """
        same = [other for other in nodes if _last_part(other) == _last_part(node)]
        is_known = len(same) == 1 and not is_expression(same[0])
        logged = self._logging_nodes.get(denial.process, ())
        return same[0] if is_known and same[0] not in logged else ""

    def _enclaves_for(self, node: str, enclave: str) -> tuple[str, ...]:
        """Return the enclaves for a node; ``enclave`` is the one in which its process runs."""
        if self._keystore:
            return self._keystore.enclaves_for(node)
        return self._policy.enclaves_for(node, enclave) if self._policy else ()

    def _enclaves_for_process(self, node: str, denial: Denial) -> Sequence[str]:
        """Return the enclaves for a node, first those that are also for the process's other nodes.

        The other nodes are known from the log.
        """
        enclaves = self._enclaves_for(node, denial.enclave)
        if len(enclaves) < 2:
            return enclaves
        others = [
            self._enclaves_for(other, denial.enclave)
            for other in self._logging_nodes.get(denial.process, ())
        ]
        return sorted(enclaves, key=lambda name: sum(name not in of_other for of_other in others))

    def _composed_cause(
        self, denial: Denial, node: str, nodes: Sequence[str], cause: str, advice: str
    ) -> tuple[list[str], str]:
        """Return causes and a remedy that also say what to do if one process runs several nodes.

        ``nodes`` are the nodes of the enclave; ``cause`` and ``advice`` are about ``node`` alone.
        """
        exact = [other for other in nodes if not is_expression(other)]
        is_one_process = bool(denial.process) or len(self._started_folders) == 1
        logged = [
            other
            for other in self._logging_nodes.get(denial.process, ())
            if is_one_process and other in exact
        ]
        together = sorted({node, *(logged or exact)})
        if len(together) == 1:
            return [cause], advice
        composed = _composing_advice(together)
        if not logged:
            return [cause], f"{advice} If one process runs {enumerated(together)}, {composed}"
        only = "but a process runs in only one enclave"
        fact = f"the log shows that the process also runs {enumerated(logged)}, {only}"
        several = f"If these are several processes, {_within_sentence(advice)}"
        return [cause, fact], f"{capitalized(composed)} {several}"

    def _similar_name_cause(
        self, denial: Denial, name: str, enclave: LoadedEnclave, remedy: str
    ) -> tuple[list[str], str]:
        """Return causes and a remedy if the enclave has rights to similar names; or [], ""."""
        questions = _questions_to_ask(denial)
        if len(questions) != 1 or denial.by_rule:
            return [], ""
        (question,) = questions
        asked = self._answer(enclave, denial.vendor, question)
        denied = question.needed_right(enclave.name)
        if other := meaning_of_other_kind(denied, named_rights(asked)):
            return [f"{other}, but {name} is {with_article(question.type)}"], ""
        if part := lacking_part(denied, named_rights(asked)):
            advice = capitalized(part.advice)
            return [part.reason], f"{advice}. {_otherwise(remedy)}"
        if rules := self._missing_rules(enclave.name, name, _served_names(asked)):
            return [f"the process had {enumerated(rules)} in its command when sros watched it"], (
                f"Add this to its command in {unit}, and restart the unit."
                if (unit := self._closed_robot().units.get(enclave.name))
                else f"Start the process by its command in {_COMMANDS}."
            )
        is_used = self._keystore.has_other_side(denied) if self._keystore else None
        names = likely_names(asked)
        if is_used:  # a name that peers have a right to is probably no mistake
            if misspelled := self._misspelled_in_policy(denied, named_rights(asked)):
                nobody = f"which no enclave may {PEER_RIGHT[denied.right]}"
                use = f"{question.word} {misspelled}, {nobody}"
                return [f"the enclave may {use}: perhaps {name} is meant"], (
                    f"If the policy misspells the name, write {name} in place of {misspelled} "
                    f"there. {_otherwise(remedy)}"
                )
            names = tuple(other for other in names if _last_part(other) == _last_part(name))
        own = [right.name for right in named_rights(asked) if right.right == denied.right]
        meant = names[0] if names else own[0] if len(own) == 1 else "NEW"
        rule = Remapping("", name, meant)
        add, renamed, only = f", add `--ros-args -r {quote(str(rule))}`.", "", list[str]()
        new_name = (
            " If a remapping or a parameter is missing or wrong, correct it, or give "
            f"the name to the policy: `sros merge_policy POLICY OTHER --remap OLD:={quote(name)}`."
        )
        if question.type == "action" and (not is_used or len(own) == 1):
            add = f": {renamed_action_text(rule)}"
            renamed = f" If the node's command renames the action{add}"
            if len(own) == 1:
                only = [f"by exact name, the enclave may {question.word} only action {meant}"]
                renamed = f" If the policy means this action by {meant}{add}"
        if names:
            may = f"the enclave may {question.word} {enumerated(names)}"
            facts = [f"{may}: {perhaps_meant(names)}"]
            if is_used:
                return facts, (
                    f"{remedy} Or, if the node lacks a remapping that its policy has{add} "
                    f"{_remapping_advice(name, meant)}"
                )
            misspelled = ""
            if is_typing_error(name, meant):
                misspelled = f"If the program misspells the name, write {meant} there. "
            return facts, (
                f"{misspelled}If the node lacks a remapping{add} {_remapping_advice(name, meant)} "
                f"If only the policy lacks this remapping, merge the policy with `--remap "
                f"{quote(meant)}:={quote(name)}`. {_otherwise(remedy)}"
            )
        is_unknown = is_used is False or not self._keystore
        likely = self._unused_name(denial, question, own) if is_unknown else ""
        facts, start = list[str](), ""
        if likely:
            facts = [
                f"{enclave.name} may {question.word} {likely}; perhaps a remapping or a parameter "
                "is missing"
            ]
            start = f"If the node should use {likely}, start it with the remapping or the parameter"
            start += " for this name."
        if is_used is False and self._keystore:
            place = self._keystore.kind
            facts.append(f"no enclave of the {place} may {PEER_RIGHT[denied.right]} {name}")
            if len(own) == 1 and not likely:
                facts.append(f"by exact name, the enclave may {question.word} only {own[0]}")
            if place == "export":
                elsewhere = (
                    "If the enclave at the other end is not in this export (it may be on another "
                    "machine), ask the whole keystore: `sros explain KEYSTORE --log LOG`."
                )
                remedy = (
                    f"{remedy} {elsewhere}"
                    if self._closed_robot().commands
                    else f"{elsewhere} {_otherwise(remedy)}"
                )
            if commands := self._closed_robot().commands:
                place = self._closed_robot().units.get(enclave.name) or _COMMANDS
                lacks = "the node lacks a remapping, or has a wrong one"
                # No other node need have a right to a name that only this node brings.
                is_own = denied.right == "reply" or _is_private(name, _served_names(asked))
                if is_own or not [*remapping_rules(commands.get(enclave.name, ()))]:
                    return facts, f"{remedy} Or, if {lacks}, correct its command in {place}."
                start = f"Probably {lacks}: look at its command in {place}."
            elif not start:
                start = (
                    "Perhaps a remapping or a parameter is missing or wrong: compare the node's "
                    "command with the robot's launch files."
                )
            return facts, f"{start}{renamed} {_otherwise(remedy)}"
        if likely:
            return facts, f"{start} {_otherwise(remedy)}"
        if renamed and is_used:  # its peers may mean the new name, or the old one
            return only, f"{remedy}{renamed}{new_name}"
        return only, f"{remedy}{renamed or new_name}"

    def _unused_name(self, denial: Denial, question: Question, own: Sequence[str]) -> str:
        """Return the allowed name that is probably meant in place of a denied name, or "".

        ``own`` are the names of the enclave for the denied right. Names that the log of the process
        shows do not count.
        """
        name = question.name
        if question.type == "action":
            return ""
        if self._policy and self._policy.possible_namespace(name, denial.enclave):
            return ""
        logged = self._logged_names[denial.process]
        return likely_unused_name(name, [other for other in own if other not in logged])

    @cached_property
    def _logged_names(self) -> Mapping[str, Set[str]]:
        """Map each process to the names that its lines have."""
        names = defaultdict[str, set[str]](set)
        for process, message in map(labeled_line, self._lines):
            names[process].update(_NAME.findall(message))
        return names

    def _missing_rules(self, enclave: str, name: str, nodes: Iterable[str]) -> list[str]:
        """Return the remapping rules for a denied name in the command of a closed robot's process.

        ``nodes`` are the full names of the nodes of the enclave.
        """
        commands = self._closed_robot().commands
        places = [node.rpartition("/") for node in nodes or ("/",)]
        return [
            f"`-r {of_node}{':' * bool(of_node)}{old}:={new}`"
            for of_node, old, new in remapping_rules(commands.get(enclave, ()))
            if any(name in (old, expand(old, ns or "/", node)) for ns, _, node in places)
        ]

    def _closed_robot(self) -> RobotEnclaves:
        """Return the enclaves that `sros close` remembers, if it made the folder."""
        return enclaves_of_closed_robot(Path(self._root)) if self._root else RobotEnclaves()

    def _misspelled_in_policy(self, denied: Right, named: Iterable[Right]) -> str:
        """Return an allowed name that is similar to the denied name, and no peer may use; or ""."""
        for right in named:
            is_alike = right.right == denied.right and is_spelled_alike(denied.name, right.name)
            if is_alike and self._keystore and self._keystore.has_other_side(right) is False:
                return right.name
        return ""

    def _commands_to_ask(self, denial: Denial, name: str) -> str:
        """Return the commands that show which rights a policy lacks for a denied topic."""
        root, enclave = self._root or "KEYSTORE", denial.enclave or "ENCLAVE"
        asked, advice = self._policy.file if self._policy else root, ""
        if self._policy:
            ns, path = self._policy.namespace_and_path(denial.enclave or self._policy.name)
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
        known = None if denial.remote or self._policy else self._find(denial.enclave)
        lines = f" --policy {quote(str(known.policy_file))}" if known and known.policy_file else ""
        commands = [
            f"`sros explain {quote(asked)} {quote(enclave)} {question.word} {quote(name)}"
            f"{' --type action' * (question.type == 'action')}{lines}`"
            for question in _questions_to_ask(denial)
        ]
        if commands:
            show = f"{' and '.join(commands)} {'shows' if len(commands) == 1 else 'show'}"
            if denial.by_rule:
                return f"{show} the DENY, and where the policy has it: no ALLOW helps against it."
            robot = folder_of_closed_robot(Path(self._root)) if self._root else None
            other_version = (
                "If the policy is for another version of the node, use the policy of the node's "
                "version."
                if robot is None
                else "If the program has a new version, which needs more rights: "
                f"{how_to_learn_one_process(robot)}. If the right was taken away on purpose, start "
                "a program that does not use it."
            )
            node = node_denied_own_service(denial)
            if node and not (self._root or self._policy) and denial.enclave not in ("", node):
                other_version = (
                    f"Perhaps the process runs in the wrong enclave, or {node} has another name or "
                    "namespace than in the policy: `sros explain KEYSTORE --log LOG` compares them."
                )
            return (
                f"{other_version} Otherwise, {show} what is missing in the policy: add it{advice}."
                f"{_parameter_client_hint(denial, name)}"
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

        The nodes are those that logged and those in the policy, both in the namespace ``space``.
        """
        if self._policy is None or denial.remote or _operation_in_ros_terms(denial)[0] == "call":
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
        """Yield the enclave's faults that are in ``faults``, with remedies.

        If there are none, yield all faults of the enclave; without any fault, the reason of a
        denial.
        """
        fitting = [problem for problem in answer.problems if problem.fault in faults]
        for problem in fitting or answer.problems:
            yield str(problem), remedy(problem.fault, self._root, enclave.name, problem.file)
        if not answer.problems and not answer.allowed:
            decision = answer.decision
            yield decision.text, remedy(decision.reason, self._root, enclave.name)

    def _missing_key_cause(self, enclave: LoadedEnclave, hit: LogHit) -> Iterator[tuple[str, str]]:
        """Yield cause and remedy for a missing file if only the key is missing in a folder without
        any keys, which may be a copy of the robot's folder.
        """
        names_other_file = KEY_FILE not in hit.fields.get("path", KEY_FILE)
        if names_other_file or Fault.FILE_MISSING not in hit.meaning.faults:
            return
        if enclave.key_elsewhere and not enclave.on_this_machine.key_elsewhere:
            yield (
                f"{KEY_FILE}: missing, as in a copy without keys; on the robot, this is the fault",
                remedy(Fault.FILE_MISSING, self._root, enclave.name, KEY_FILE),
            )

    def _wrong_domain_cause(
        self, enclave: LoadedEnclave, answer: Answer, hit: LogHit
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


def _is_private(name: str, nodes: Iterable[str]) -> bool:
    """Return whether a name is a private name (``~/NAME``) of one of the nodes."""
    return any(name.startswith(f"{node}/") for node in nodes)


def _remapping_advice(name: str, meant: str) -> str:
    """Return what to change in a command that remaps to ``name`` in place of ``meant``."""
    return (
        f"If its command already sets the name by `-r OLD:={quote(name)}` or a parameter, write "
        f"{meant} there instead: ROS applies only one rule to a name."
    )


def _otherwise(remedy: str) -> str:
    """Return a remedy after "Otherwise," or "Or,", to follow remedies for other causes."""
    # Such a remedy often has an "Otherwise" of its own.
    return f"{'Or' if remedy.startswith('If ') else 'Otherwise'}, {_within_sentence(remedy)}"


def _within_sentence(remedy: str) -> str:
    """Return a remedy with a small first letter, to continue a sentence."""
    return f"{remedy[:1].lower()}{remedy[1:]}"


def _keystore_of_file(path: str) -> Path | None:
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


def _unknown_cause(hits: Iterable[LogHit]) -> str:
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


_NAME = re.compile(r"/[\w/]+")
_COMMAND = re.compile(r"(`sros\b[^`]*`)")
_COMMANDS = "start/commands.txt of the robot's folder"
_MOST_LINES = 20
_MAX_PEERS = 5
"""Maximum number of peers that are examined for one message."""
_ROTATION_IDS = ("peer-signature", "peer-permissions-ca")
_NOT_RESTARTED = {
    Vendor.FAST: "Restart this process{of}: it was not restarted since the stage distribute, and "
    "so does not know the new CA.",
    Vendor.CYCLONE: "Restart this process{of} and the peer: one of them was not restarted since "
    "the stage reissue, and Cyclone DDS trusts one CA at a time.",
}
_OLDER_FILES = (
    "Restart the processes of {peer}, and then this process: one of them loaded older files."
)
_FOLDER_IDS = ("enclave-missing", "runs-unsecured")
_DOMAIN_IDS = ("domain", "domain-of-permissions")
_EVERY_NODE = "the rights that every node needs: parameter services, /rosout, /parameter_events"
_TOPICS_OF_EVERY_NODE = ("rt/rosout", "rt/parameter_events")


def _nodes_clause(answer: Answer) -> tuple[str, ...]:
    """Return one clause: the nodes that an enclave's permissions name, or that they name none."""
    nodes = _served_names(answer)
    if nodes:
        return (f"the permissions are for {_nodes_text(nodes)}",)
    return (f"the permissions lack {_EVERY_NODE}",)


def _parameter_client_hint(denial: Denial, name: str) -> str:
    """Return a sentence on the other services that a parameter client needs; or "".

    The denial is of a service of the node whose parameters the client uses.
    """
    node, _, service = name.rpartition("/")
    is_client = service_of(denial.topic)[0] and not node_denied_own_service(denial)
    if service not in PARAMETER_SERVICES or not is_client:
        return ""
    others = enumerated([other for other in PARAMETER_SERVICES if other != service])
    text = PARAMETER_CLIENT_TEXT.format(f"{others} of {node}")
    return f" {capitalized(text)}."


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
    start = f"Start the node as {meant[0]} ({rules})"
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
        other_name = ""
        if name != (new_name := _last_part(wrong)):
            rule = quote(f"__node:={new_name}")
            other_name = f"; if the node is NAME in OTHER, write `--node NAME --remap {rule}`"
        renamed = (
            f". If the new name is wanted, write {wrong} in the profile of {meant[0]}. If the "
            "profile was merged from the policy of a package, merge that policy again instead: "
            f"`sros merge_policy POLICY OTHER {_merge_options([wrong], enclave)}` (into a policy "
            f"without {meant[0]}, if this node no longer runs){other_name}"
        )
    return (
        f"{start}{renamed}. A further node needs a profile with common/node.xml: in the policy of "
        f"{enclave}, or in an enclave of its own if it is another program."
    )


def _composing_advice(nodes: Sequence[str]) -> str:
    """Return the remedy for one process that runs ``nodes`` although they have several enclaves."""
    spaces = {node.rpartition("/")[0] for node in nodes}
    if len(spaces) == 1:
        options, each = _merge_options(nodes, f"{spaces.pop()}/NEW"), ""
    else:
        options, each = "--namespace NS --enclave /NEW --node NODE", ", once for each node"
    return (
        "give these nodes one enclave: write their profiles into one <enclave> of the policy. "
        "Profiles from the policy of a package, merge again into a policy without these nodes: "
        f"`sros merge_policy POLICY OTHER {options}`{each}. Then start the process in "
        "the new enclave."
    )


def _merge_options(nodes: Sequence[str], enclave: str) -> str:
    """Return the options with which `sros merge_policy` puts nodes of a package into an enclave.

    The ``nodes`` are full names in one namespace.
    """
    ns = nodes[0].rpartition("/")[0]
    options = [f"--namespace {quote(ns)}"] * bool(ns) + [f"--enclave {quote(enclave)}"]
    return " ".join([*options, *(f"--node {quote(_last_part(node))}" for node in nodes)])


def _enclaves_text(enclaves: Sequence[str]) -> str:
    return f"the enclave{'s' * (len(enclaves) > 1)} {' and '.join(enclaves)}"


def _nodes_text(nodes: Sequence[str]) -> str:
    return f"the node{'s' * (len(nodes) > 1)} {', '.join(nodes)}"


def _nothing_found_text(enclave: LoadedEnclave) -> str:
    return (
        f"Enclave {enclave.name} now has no fault that would explain the message: "
        "check the files on the robot itself, its clock and its time zone."
    )


def _operation_in_ros_terms(denial: Denial) -> tuple[str, str, str]:
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
    right, name, kind = _operation_in_ros_terms(denial)
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
