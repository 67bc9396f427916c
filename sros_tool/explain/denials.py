"""Read denied topics in the logs of secured nodes, and propose the missing rights.

The texts of the logs are in `sros_tool.runtime.log_texts`.  Fast DDS names the topic and, in a line
nearby, the kind of endpoint: writer or reader. Cyclone DDS first checks whether a topic may be used
at all; only the next message, of rcl, has the direction.  Cyclone DDS logs nothing if the
governance protects the discovery of the topic.

A log is no proof: a process can print any line, even a line that looks like a denial, and so ask
for rights that the process should not have.  So each denial names the process that printed it, and
a person decides.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from pathlib import Path

from sros_tool.dds.decision.vendors import Vendor
from sros_tool.errors import Note, UsageError
from sros_tool.files import policies_dir
from sros_tool.graph.learn import (
    CommonParts,
    DenialLine,
    Learned,
    LearnedProfile,
    NodeRight,
    RightsOrigin,
    common_parts,
    groups_of,
)
from sros_tool.graph.observation import PUBLISH, SUBSCRIBE
from sros_tool.names import (
    ACTION_SEPARATOR,
    ACTION_TOPICS,
    PARAMETER_SERVICES,
    check_enclave_name,
    expand,
    expression_problem,
    is_expression,
    namespace_problem,
    node_of_service,
    nodes_served,
    right_to_use,
    service_of,
)
from sros_tool.policy.model import ALLOW, Policy
from sros_tool.policy.patterns import covers
from sros_tool.policy.rights import Right, Rules, action_right, profile_rights
from sros_tool.runtime.vendor_log import (
    ENDPOINT_KINDS,
    REMOTE_ENDPOINT,
    denied_topic,
    labeled_line,
    log_lines,
    logging_node,
    plain_text,
    security_directory,
)
from sros_tool.wording import enumerated

_MAX_LINES_TO_DIRECTION = 3
"""Number of log lines after a denial that are searched for its direction."""


@dataclass(frozen=True, slots=True)
class Denial:
    """A denied DDS topic, and ``direction``: "publish", "subscribe", or "" if unknown.

    ``by_rule`` says whether a deny rule denies the topic, so that an allow rule would not help
    (None: unknown).  ``remote`` says whether the permissions of a peer deny the topic.  ``enclave``
    is "" if the log does not name the enclave.  ``process`` is the label of the process that
    printed the denial, or "", and ``lines`` the numbers of its lines, from 1.  ``folder`` is the
    folder from which the process loaded its enclave, or "".  ``neither`` says that the process may
    use the topic in neither direction.
    """

    topic: str
    direction: str
    enclave: str = ""
    by_rule: bool | None = False
    remote: bool = False
    vendor: Vendor = field(default=Vendor.FAST, compare=False)
    process: str = ""
    lines: tuple[int, ...] = field(default=(), compare=False)
    folder: str = field(default="", compare=False)
    neither: bool = field(default=False, compare=False)


@dataclass(frozen=True, slots=True)
class MissingRights:
    """The rights that nodes lack according to denials in logs, by enclave ("" if unknown).

    No rights are proposed for other denials: denials without a direction (``unclear``), by a deny
    rule (``by_rule``), by the permissions of a peer (``remote``), and of topics without a ROS name
    (``foreign``).
    """

    rights: dict[str, frozenset[NodeRight]]
    unclear: tuple[Denial, ...] = ()
    by_rule: tuple[Denial, ...] = ()
    remote: tuple[Denial, ...] = ()
    foreign: tuple[Denial, ...] = ()


def read_denials(text: str) -> tuple[Denial, ...]:
    """Return the denied topics in a log without colors; every topic once for each process.

    The labels that ros2 launch, journald or Docker Compose put before lines distinguish the
    processes in a log; the enclave that one process names is not used for other processes.
    """
    processes: dict[str, list[tuple[int, str]]] = {}
    for number, line in enumerate(log_lines(text), 1):
        process, rest = labeled_line(line)
        processes.setdefault(process, []).append((number, rest))
    lines: dict[Denial, list[int]] = {}
    for item in processes.items():
        for denial in _denials_of(*item):
            lines.setdefault(denial, []).extend(denial.lines)
    denials = [replace(denial, lines=tuple(numbers)) for denial, numbers in lines.items()]
    known = {
        replace(denial, direction=direction, by_rule=by_rule)
        for denial in denials
        for direction in {denial.direction, ""}
        for by_rule in {denial.by_rule, None}
        if (direction, by_rule) != (denial.direction, denial.by_rule)
    }
    return tuple(denial for denial in denials if denial not in known)


def _denials_of(process: str, numbered: list[tuple[int, str]]) -> Iterator[Denial]:
    """Yield the denials in lines of one process, given as pairs of number and text."""
    enclave = folder = ""
    lines = [line for _, line in numbered]
    for index, (number, line) in enumerate(numbered):
        if named := security_directory(line):
            enclave, folder = named["enclave"] or "/", named["folder"]
        if denied := denied_topic(line):
            vendor, match = denied
            topic = match["topic"]
            remote, direction = _direction(
                lines[index : index + 1 + _MAX_LINES_TO_DIRECTION], topic
            )
            rule, neither = match.groupdict().get("rule"), match.groupdict().get("neither")
            yield Denial(
                topic,
                direction,
                enclave,
                by_rule="deny" in rule.lower() if rule else None,
                remote=remote,
                vendor=vendor,
                process=process,
                lines=(number,),
                folder=folder,
                neither=bool(neither),
            )


def _direction(lines: list[str], topic: str) -> tuple[bool, str]:
    """Return, from a denial and the lines after it, whether a peer denies, and the direction."""
    for line in lines:
        other = denied_topic(line)
        if other and other[1]["topic"] != topic:
            break
        if REMOTE_ENDPOINT.search(line):
            return True, PUBLISH if "riter" in line else SUBSCRIBE
        named = {kind: bool(words.search(line)) for kind, words in ENDPOINT_KINDS.items()}
        writer, reader = named["writer"], named["reader"]
        if topic.startswith(("rq/", "rr/")) and not (writer or reader):
            # A client writes requests and reads replies, a server does the opposite.
            client, server = named["client"], named["server"]
            writer, reader = (client, server) if topic[1] == "q" else (server, client)
        if writer != reader:
            return False, PUBLISH if writer else SUBSCRIBE
    return False, ""


def propose(denials: Iterable[Denial]) -> MissingRights:
    """Return the rights whose lack caused the denials, as far as the log shows this.

    A node stops at the first refusal. So a denied topic of a service leads to a right to the
    service, and a denied service of an action to a right to the action.
    """
    rights: dict[str, set[NodeRight]] = {}
    skipped: dict[str, list[Denial]] = {"unclear": [], "by_rule": [], "remote": [], "foreign": []}
    for denial in denials:
        kind = (
            "remote" if denial.remote
            else "by_rule" if denial.by_rule
            else "foreign" if not _has_ros_name(denial.topic)
            else "unclear" if not denial.direction
            else ""
        )  # fmt: skip
        if kind:
            skipped[kind].append(denial)
        else:
            rights.setdefault(denial.enclave, set()).add(_right_to_denied_topic(denial))
    return MissingRights(
        {enclave: _without_parts(right) for enclave, right in rights.items()},
        **{kind: tuple(denials_of_kind) for kind, denials_of_kind in skipped.items()},
    )


def node_denied_own_service(denial: Denial) -> str:
    """Return the full name of a node that was denied a service that every node offers, or ""."""
    service, begin = service_of(denial.topic)
    if denial.remote or not service:
        return ""
    offered = (begin == "rq") == (denial.direction == SUBSCRIBE)
    return node_of_service(service) if denial.direction and offered else ""


def _has_ros_name(topic: str) -> bool:
    if is_expression(topic) or expression_problem(topic[2:]):
        return False  # a topic named like a wildcard must not become a wildcard
    return topic.startswith("rt/") or bool(service_of(topic)[0])


def _right_to_denied_topic(denial: Denial) -> NodeRight:
    right, name = right_to_use(denial.topic, writes=denial.direction == PUBLISH)
    return NodeRight(*action_right(right, name))


def _without_parts(rights: set[NodeRight]) -> frozenset[NodeRight]:
    """Return the rights without the topics of an action that is among the rights."""
    parts = {
        NodeRight(SUBSCRIBE, f"{right.name}{ACTION_SEPARATOR}{topic}")
        for right in rights
        if right.right == "call"
        for topic in ACTION_TOPICS
    }
    return frozenset(rights - parts)


_ANY_NODE = ("/", "*")
"""Namespace and name of a profile for any node, in an enclave that also has named nodes."""

_NO_PROFILE_TEXT = (
    "not proposed, because the policy has no profile for nodes with these names; start them with "
    "the names in the policy (--ros-args -r __node:=NAME -r __ns:=NAMESPACE), or add a profile "
    "with --node /NAMESPACE/NAME: {}"
)
_ASSUMED_NODE_TEXT = (
    "the log does not name the node, so sros takes the last part of the enclave's name as the "
    "node's name, in the namespace /; if this is wrong, name the node with --node "
    "/NAMESPACE/NAME: {}"
)
_ALL_BASIC_RIGHTS_TEXT = (
    "a node needs all rights of these common parts, so all of them are proposed together, instead "
    "of one after each restart: {}"
)
_OTHER_ENCLAVE_TEXT = "not proposed, because the log names another enclave than --enclave: {}"
PARAMETER_CLIENT_TEXT = (
    "a parameter client of rclpy needs all six parameter services of the other node, and a log may "
    "have only the first that is denied: for such a client, also add {}"
)
_SEVERAL_ENCLAVES_NOTE = Note(
    "log.several-enclaves",
    "the log names several enclaves, and each denial is assigned to the enclave that its process "
    "named last. Check that no two processes wrote to the log at the same time without a label, "
    "such as the [talker-1] of ros2 launch",
)

_COMMON_NODE_FILES = ("common/node.xml", "common/node/parameters.xml")
"""Files to include, the largest first; a node without a right of a file lacks this include."""
_LIFECYCLE_NODE = "common/lifecycle_node.xml"


def learned_from_logs(
    logs: Mapping[Path, str],
    *,
    file: Path | None,
    enclave: str,
    node: tuple[str, str] | None,
    present: Policy | None,
) -> tuple[Learned, list[DenialLine], bool]:
    """Return rights that logs report missing, the log lines, and whether a right was denied.

    Args:
        logs: the texts of the logs by their paths.
        file: the policy to which the rights are to be added, for the paths of common parts.
        enclave: the enclave of processes whose log does not name their enclave, or "".
        node: namespace and name of the node whose profile gets the rights, or None.
        present: the content of ``file``, if it exists.
    """
    denials = {log: read_denials(plain_text(text)) for log, text in logs.items()}
    missing = propose(denial for denied in denials.values() for denial in denied)
    common = common_parts(file.parent if file else policies_dir(), policies_dir())
    learned = as_learned(
        missing,
        enclave,
        node,
        present,
        common,
        written=file is not None,
        logged_nodes=_logged_nodes(logs, denials),
    )
    asked = {profile.enclave for profile in learned.profiles}
    lines = [
        DenialLine(
            log,
            denial.lines[0],
            process=denial.process or None,
            enclave=denial.enclave or enclave or None,
            direction=denial.direction,
            topic=denial.topic,
        )
        for log, denied in denials.items()
        for denial in denied
        if propose([denial]).rights and (denial.enclave or enclave) in asked
    ]
    return learned, lines, any(denials.values())


def _logged_nodes(
    logs: Mapping[Path, str], denials: Mapping[Path, Sequence[Denial]]
) -> dict[str, set[str]]:
    """Map each enclave ("" if unknown) to the nodes that logged in processes with denials."""
    nodes: dict[str, set[str]] = {}
    for log, text in logs.items():
        enclaves: dict[str, set[str]] = {}
        for denial in denials[log]:
            enclaves.setdefault(denial.process, set()).add(denial.enclave)
        for process, message in map(labeled_line, log_lines(plain_text(text))):
            if process in enclaves and (node := logging_node(message)):
                for enclave in enclaves[process]:
                    nodes.setdefault(enclave, set()).add(node)
    return nodes


def lines_asking_for(added: Iterable[Right], lines: Iterable[DenialLine]) -> list[DenialLine]:
    """Return the log lines that ask for any of the rights ``added``.

    Leaves out lines whose right the policy already states or denies.
    """
    rules = Rules(added)

    def asks(line: DenialLine) -> bool:
        asked = propose([Denial(line.topic, line.direction, line.enclave or "")]).rights
        return any(
            rules.overlaps(Right(enclave, ALLOW, right.right, right.name))
            for enclave, rights in asked.items()
            for right in rights
        )

    return list(filter(asks, lines))


def as_learned(
    missing_rights: MissingRights,
    enclave: str,
    node: tuple[str, str] | None,
    policy: Policy | None,
    common: CommonParts | None = None,
    *,
    written: bool = False,
    logged_nodes: Mapping[str, Collection[str]] | None = None,
) -> Learned:
    """Return the proposed rights as profiles.

    With ``enclave``, only this enclave gets rights: from denials that name this enclave, or no
    enclave. ``node`` (namespace and name) names the profile. Without ``node``, the rights go to the
    node whose standard services were denied, else to the only profile of the enclave in ``policy``,
    else to a profile for any node: DDS checks only the enclave. If ``policy`` does not have the
    enclave, the last part of its name is assumed to be the node's name, in the namespace of the
    only logger with this name in ``logged_nodes`` (full names by enclave), else in / with a note.
    A node that is not in the policy gets a note instead of rights. ``common`` are the rights that
    every node needs. A node that has none of these rights gets all of them in two cases: one of
    these rights was denied to the node, or the profile is new in a policy that is ``written``.

    Raises:
        UsageError: The log does not name the enclave of a denial, and ``enclave`` is "".
    """
    profiles, assumed = [], dict[str, str]()
    other_nodes, parts_by_profile = dict[str, str](), dict[str, str]()
    parameter_clients = dict[str, str]()
    for path, rights in sorted(_rights_by_enclave(missing_rights, enclave).items()):
        present = _stated_rights_by_profile(policy, path)
        for profile, denied in sorted(_rights_by_profile(rights, node, present).items()):
            if present and node is None and profile not in (_ANY_NODE, *present):
                profile_names = ", ".join(sorted(map(_full_name, present)))
                other_nodes[_full_name(profile)] = f"enclave {path} has {profile_names}"
                continue
            if profile == _ANY_NODE and not present and path != "/":
                end = path[path.rindex("/") :]
                logged = logged_nodes or {}
                named = {*logged.get(path, ()), *logged.get("", ())}
                fitting = [
                    full_name
                    for full_name in named
                    if full_name.endswith(end) and not namespace_problem(full_name)
                ]
                profile = _profile_of_node(fitting[0] if len(fitting) == 1 else end, ())
                if profile[0] == "/":  # perhaps the logger of a library
                    assumed[path] = _full_name(profile)
            has = present.get(profile, frozenset())
            parts: tuple[str, ...] = ()
            if common:
                is_new = written and not present
                parts = _missing_common_part(None if is_new else denied, profile, has, common)
            node_rights = (
                common.included_rights(parts, *profile) if common else frozenset[NodeRight]()
            )
            if parts:
                parts_by_profile[_full_name(profile)] = ", ".join(parts)
            if lacking := _lacking_services_text(denied, denied | has):
                parameter_clients[f"to {_full_name(profile)}"] = lacking
            groups = groups_of(denied - node_rights, *profile)
            profiles.append(LearnedProfile(path, *profile, denied | node_rights, parts, groups))
    elsewhere = {
        path: f"{len(rights)} right{'s' * (len(rights) > 1)}"
        for path, rights in sorted(missing_rights.rights.items())
        if enclave and path not in ("", enclave)
    }
    notes = [
        Note(name, text.format("; ".join(f"{who}: {reason}" for who, reason in reasons.items())))
        for name, text, reasons in (
            ("log.node-assumed", _ASSUMED_NODE_TEXT, assumed),
            ("log.other-node", _NO_PROFILE_TEXT, other_nodes),
            ("log.common-part", _ALL_BASIC_RIGHTS_TEXT, parts_by_profile),
            ("log.other-enclave", _OTHER_ENCLAVE_TEXT, elsewhere),
            ("log.parameter-client", PARAMETER_CLIENT_TEXT, parameter_clients),
        )
        if reasons
    ]
    return Learned(
        tuple(profiles),
        (*_notes_on_missing_rights(missing_rights), *notes),
        source=RightsOrigin.LOG,
    )


def _lacking_services_text(denied: Set[NodeRight], rights: Set[NodeRight]) -> str:
    """Return text with the parameter services of other nodes that ``rights`` lack, or "".

    Only nodes of which such a service was ``denied`` count.
    """
    asked = [right.name.rpartition("/") for right in denied if right.right == "request"]
    nodes = sorted({node for node, _, service in asked if service in PARAMETER_SERVICES})
    lacking = {
        node: [
            service
            for service in PARAMETER_SERVICES
            if NodeRight("request", f"{node}/{service}") not in rights
        ]
        for node in nodes
    }
    return ", ".join(f"{enumerated(names)} of {node}" for node, names in lacking.items() if names)


def _rights_by_enclave(
    missing_rights: MissingRights, enclave: str
) -> dict[str, frozenset[NodeRight]]:
    """Return the rights by enclave; with ``enclave``, only the rights of that enclave."""
    rights_by_enclave: dict[str, frozenset[NodeRight]] = {}
    for named, rights in missing_rights.rights.items():
        if enclave and named not in ("", enclave):
            continue
        if not (named or enclave):
            raise UsageError(
                "the log does not say in which enclave the node ran",
                "rcl's line 'Found security directory', which names it, is missing.",
                "Name the enclave with --enclave.",
            )
        path = check_enclave_name(named or enclave)
        rights_by_enclave[path] = rights_by_enclave.get(path, frozenset()) | rights
    return rights_by_enclave


def _rights_by_profile(
    rights: frozenset[NodeRight],
    node: tuple[str, str] | None,
    present: Mapping[tuple[str, str], frozenset[NodeRight]],
) -> dict[tuple[str, str], frozenset[NodeRight]]:
    """Return the rights by the profile that gets them: namespace and node name."""
    if node is not None:
        return {node: rights}
    nodes = nodes_served((right.right, right.name) for right in rights)
    rights_by_profile: dict[tuple[str, str], set[NodeRight]] = {}
    (only,) = present if len(present) == 1 else (None,)
    (node_served,) = nodes if len(nodes) == 1 else (None,)
    default = only or (
        _profile_of_node(node_served, present) if node_served and not present else _ANY_NODE
    )
    for right in rights:
        served = nodes_served([(right.right, right.name)])
        profile = _profile_of_node(served[0], present) if served else default
        rights_by_profile.setdefault(profile, set()).add(right)
    return {profile: frozenset(node_rights) for profile, node_rights in rights_by_profile.items()}


def _profile_of_node(fqn: str, present: Iterable[tuple[str, str]]) -> tuple[str, str]:
    """Return namespace and name of the profile for the node ``fqn``, perhaps with wildcards."""
    ns, _, name = fqn.rpartition("/")
    return next((place for place in present if covers(_full_name(place), fqn)), (ns or "/", name))


def _full_name(profile: tuple[str, str]) -> str:
    return f"{profile[0].rstrip('/')}/{profile[1]}"


def _missing_common_part(
    denied: frozenset[NodeRight] | None,
    profile: tuple[str, str],
    node_rights: frozenset[NodeRight],
    common: CommonParts,
) -> tuple[str, ...]:
    """Return a tuple with the common part that a profile needs and does not include; or ().

    A profile needs a part if a right of the part was ``denied`` (None counts as any right), and
    lacks the part if the profile has no right of the part. A lifecycle node, which first asks for
    its transition_event, also lacks its part if the profile has only the rights of every node.
    """
    if is_expression(profile[1]):
        return ()
    if {_LIFECYCLE_NODE, _COMMON_NODE_FILES[0]} <= common.rights.keys():
        ordinary = common.included_rights(_COMMON_NODE_FILES[:1], *profile)
        of_lifecycle = common.included_rights([_LIFECYCLE_NODE], *profile) - ordinary
        event = NodeRight("publish", expand("~/transition_event", *profile))
        if event in (denied or ()) and node_rights & (ordinary | of_lifecycle) == ordinary:
            return (_LIFECYCLE_NODE,)
    for part in _COMMON_NODE_FILES:
        if part in common.rights:
            rights = common.included_rights([part], *profile)
            if (denied is None or rights & denied) and not rights & node_rights:
                return (part,)
    return ()


def _stated_rights_by_profile(
    policy: Policy | None, path: str
) -> dict[tuple[str, str], frozenset[NodeRight]]:
    """Return the rights of each profile of an enclave, by namespace and node name."""
    enclave = policy.enclave(path) if policy else None
    profiles: dict[tuple[str, str], frozenset[NodeRight]] = {}
    for profile in enclave.all_profiles() if enclave else ():
        rights = frozenset(NodeRight(r.right, r.name) for r in profile_rights(path, profile))
        profiles[profile.ns, profile.node] = (
            profiles.get((profile.ns, profile.node), frozenset()) | rights
        )
    return profiles


def _notes_on_missing_rights(missing_rights: MissingRights) -> tuple[Note, ...]:
    texts = {
        "log.unclear": (
            missing_rights.unclear,
            "not proposed, because the log does not say whether these topics were published or "
            "subscribed: {}",
        ),
        "log.denied-by-rule": (
            missing_rights.by_rule,
            "not proposed, because a DENY in the policy refuses these topics, and an ALLOW would "
            "not help: {}",
        ),
        "log.of-a-peer": (
            missing_rights.remote,
            "not proposed, because these topics were denied to a peer, and the log does not name "
            "its enclave: {}",
        ),
        "log.no-ros-name": (
            missing_rights.foreign,
            "not proposed, because a policy cannot name these topics: {}",
        ),
    }
    several = len(missing_rights.rights) > 1
    return (_SEVERAL_ENCLAVES_NOTE,) * several + tuple(
        Note(name, text.format(", ".join(dict.fromkeys(map(_denial_text, denials)))))
        for name, (denials, text) in texts.items()
        if denials
    )


def _denial_text(denial: Denial) -> str:
    return f"{denial.direction} {denial.topic}".strip() + (
        f" in {denial.enclave}" if denial.enclave else ""
    )
