"""Open the enclave of a question, and find out whether its name means a service or an action.

The enclave is in a keystore, a folder or a policy.  The command line and the Python API both use
this module.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from datetime import datetime, tzinfo
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.permissions import parse_permissions
from sros_tool.errors import KeystoreError, Note, PolicyError, SrosError
from sros_tool.explain.answer import Evaluator, Question, ask, question_about_action
from sros_tool.keystore.layout import CERTIFICATE_FILE, PERMISSIONS_FILE, is_keystore
from sros_tool.keystore.participant import (
    JoinContext,
    LoadedEnclave,
    deciding_enclave,
    loaded_enclave,
)
from sros_tool.keystore.reader import OpenedKeystore, open_enclave
from sros_tool.names import action_part, is_expression
from sros_tool.values import Words, shows

if TYPE_CHECKING:
    from sros_tool.dds.governance import Governance
    from sros_tool.dds.permissions import Grant
    from sros_tool.fleet.robots import Fleet
    from sros_tool.policy.model import Enclave, Policy
    from sros_tool.policy.rights import Right


class AskingContext(NamedTuple):
    """The time, time zone, domain and fleet for which a question is asked.

    ``domain`` None stands for a domain that the enclave may join; ``fleet_file`` names the robots
    for placeholders in a policy.
    """

    at: datetime
    zone: tzinfo
    domain: int | None = None
    fleet_file: Path | None = None

    def context(self, domains: DomainSet | None) -> JoinContext:
        """Return the context of the decision for an enclave that may join ``domains``."""
        domain = self.domain
        if domain is None:
            domain = domains.preferred() if domains else 0
        return JoinContext(domain, self.at, self.zone)


def domains_decided_alike(
    joined: DomainSet, governance: Governance | None, grant: Grant | None, domain: int | None
) -> Sequence[DomainSet]:
    """Return the ROS domains that an enclave may join, in sets of domains with the same rules.

    With ``domain``, only that domain is returned.
    """
    if domain is not None:
        return (DomainSet.of((domain, domain)),)
    sets = [joined]
    sets += [
        rule.domains.closed() for rule in (governance.domain_access_rules if governance else ())
    ]
    sets += [rule.domains.closed() for rule in (grant.rules if grant else ())]
    parts = DomainSet.partition(sets)
    return [part for part in parts if (part & joined).ranges]


def fleet_of(file: Path | None, keystore: OpenedKeystore | None) -> Fleet | None:
    """Return the fleet in ``file``, or else the fleet of the keystore; None if there is neither."""
    from sros_tool.keystore.fleet import load_fleet

    if file:
        from sros_tool.fleet.fleet_file import read_fleet

        return read_fleet(file)
    return load_fleet(keystore) if keystore else None


# ── the enclave ────────────────────────────────────────────────────────────────────────────


class AskedEnclave(NamedTuple):
    """An enclave to ask about, and the whole policy that the user named, if any."""

    enclave: LoadedEnclave
    policy: Policy | None = None

    @property
    def has_peers(self) -> bool:
        """Whether the policy or keystore has all peers of the enclave; an export lacks some."""
        keystore = self.enclave.keystore
        return self.policy is not None or bool(keystore and keystore.has_all_enclaves)

    def other_rights(self, name: str) -> frozenset[Right]:
        """Return all rights in the policy, and the rights to ``name`` in the keystore.

        Only permissions of the keystore that can be read count.
        """
        rights: frozenset[Right] = frozenset()
        if self.policy:
            from sros_tool.policy.rights import policy_rights

            rights = policy_rights(self.policy)
        keystore = self.enclave.keystore
        if keystore and is_keystore(keystore.root):
            rights |= frozenset(rights_naming(keystore, name))
        return rights

    def wildcard_matches(self, right: str, name: str) -> list[Right] | None:
        """Return the rights with a wildcard that match ``name``; None if they are not known.

        They are not known in a keystore with more than `_MOST_READ` enclaves, with permissions that
        cannot be read, or with wildcards for DDS topics, such as ``*``, which no policy states.
        """
        from sros_tool.policy.model import ALLOW
        from sros_tool.policy.patterns import matches
        from sros_tool.policy.rights import policy_rights, split_actions

        rights = set(policy_rights(self.policy)) if self.policy else set()
        keystore = self.enclave.keystore
        if keystore and len(keystore.names) > _MOST_READ:
            return None
        if keystore and is_keystore(keystore.root):
            try:
                for enclave in keystore.names:
                    rights.update(_rights_in(enclave, _read_permissions(keystore, enclave)))
            except (SrosError, OSError):
                return None
        allowed = [stated for stated in split_actions(rights) if stated.qualifier is ALLOW]
        if any(stated.kind == "dds" and is_expression(stated.name) for stated in allowed):
            return None
        return sorted(
            stated for stated in allowed if stated.right == right and matches(stated.name, name)
        )


_MOST_READ = 200
"""Number of enclaves up to which all permissions of a keystore are read for a note."""


def rights_naming(keystore: OpenedKeystore, name: str) -> Iterator[Right]:
    """Yield the rights in all permissions of a keystore whose text contains a ROS name.

    Unreadable permissions are left out; permissions without the name are not parsed.
    """
    for enclave in keystore.names:
        with suppress(SrosError, OSError):
            data = _read_permissions(keystore, enclave)
            if _may_contain_topic(data, name):
                yield from _rights_in(enclave, data)


def _read_permissions(keystore: OpenedKeystore, enclave: str) -> bytes:
    return keystore.read(keystore.folder(enclave) / PERMISSIONS_FILE, "permissions")


def _may_contain_topic(document: bytes, name: str) -> bool:
    """Return whether the text of a document has a DDS topic that may belong to a ROS name."""
    text = name.encode()
    return text in document and (
        b"rt" + text in document or b"rq" + text in document or b"rr" + text in document
    )


def _rights_in(enclave: str, data: bytes) -> Iterator[Right]:
    """Yield the rights in a permissions document; only the first grant of each subject is read."""
    from sros_tool.pki import smime
    from sros_tool.translate import grant_rights

    signed = b"multipart/signed" in data[:1000].lower()
    grants = parse_permissions(smime.parse(data).document if signed else data).grants
    for grant in {grant.subject: grant for grant in reversed(grants)}.values():
        yield from grant_rights(enclave, grant)


def is_enclave(folder: Path) -> bool:
    """Return whether a folder is the folder of an enclave."""
    return any((folder / name).exists() for name in (CERTIFICATE_FILE, PERMISSIONS_FILE))


def open_asked_enclave(
    keystore: OpenedKeystore | None, name: str, policy_file: Path | None, asking: AskingContext
) -> AskedEnclave:
    """Return an enclave to ask about: of a keystore, in a folder ``name``, or only of a policy.

    Raises:
        KeystoreError: the keystore does not have the enclave.
        PolicyError: the policy does not have the enclave.
    """
    policy = policy_enclave = stated = None
    if policy_file:
        stated, policy = policy_to_ask(policy_file, fleet_of(asking.fleet_file, keystore))
        policy_enclave = policy.enclave(name)
        if policy_enclave is None and not is_enclave(Path(name)):
            raise not_in_policy_error(policy, name, policy_file)
    enclave = signed_enclave(keystore, name, asking.at, planned=policy_enclave is not None)
    if enclave is None:
        assert policy_enclave is not None
        enclave = planned_enclave(policy_enclave, keystore, asking)
    elif policy_enclave is None and policy_file and policy:
        policy_enclave = policy.enclave(enclave.name)
        if policy_enclave is None and not is_enclave(Path(enclave.name)):
            raise not_in_policy_error(policy, enclave.name, policy_file)
    if policy_file and policy == stated:
        policy_file = _file_of_enclave(enclave.name, policy_file)
    enclave = enclave._replace(
        keystore=keystore,
        policy=policy_enclave,
        policy_file=policy_file,
        has_placeholders=policy != stated
        or (policy_file is None and keystore is not None and _is_of_robot(keystore, enclave.name)),
    )
    return AskedEnclave(enclave, policy)


def _file_of_enclave(enclave: str, policy: Path) -> Path:
    """Return the file that has an enclave, if ``policy`` is a folder; otherwise ``policy``."""
    if not policy.is_dir():
        return policy
    from sros_tool.policy.document import files_of_policies, read_policy

    files = files_of_policies(policy)
    fitting = (file for file in files if read_policy(file, placeholders=True).enclave(enclave))
    return next(fitting, policy)


def is_policy(path: Path) -> bool:
    """Return whether a path may be a policy: it is a file, or a folder of policies."""
    if not path.is_dir() or is_keystore(path) or is_enclave(path):
        return path.is_file()
    from sros_tool.policy.document import files_of_policies  # not needed for a keystore

    return any(files_of_policies(path))


def policy_to_ask(file: Path, fleet: Fleet | None) -> tuple[Policy, Policy]:
    """Return a policy as its file states it, and with its placeholders filled in for a fleet.

    Without a fleet, both are the same policy.
    """
    from sros_tool.fleet.expansion import FleetPolicy
    from sros_tool.policy.document import read_policy

    stated = read_policy(file, placeholders=fleet is not None)
    return stated, FleetPolicy(stated, fleet).policy() if fleet else stated


def _is_of_robot(keystore: OpenedKeystore, enclave: str) -> bool:
    """Return whether the keystore's fleet has a robot with this enclave."""
    from sros_tool.fleet.robots import robot_of

    fleet = fleet_of(None, keystore)
    return fleet is not None and robot_of(fleet, enclave) is not None


def not_in_policy_error(policy: Policy, name: str, file: Path) -> PolicyError:
    """Return the error for an enclave that a policy does not have."""
    from sros_tool.keystore.selection import likely_names

    known_enclaves = [enclave.path for enclave in policy.enclaves]
    meant = likely_names(name, known_enclaves)
    return PolicyError(
        f"unable to find enclave {name} in the policy '{file}'",
        f"It has {', '.join(known_enclaves)}.",
        f"Perhaps you mean {' or '.join(meant)}." if meant else "",
    )


def note_on_lacking_keys(keystore: OpenedKeystore) -> Iterator[Note]:
    """Yield a note for a keystore or export in which no enclave has its key."""
    if is_keystore(keystore.root) and not keystore.has_keys:
        text = (
            f"no enclave in '{keystore.root}' has its key: sros answers as if the keys were "
            "there. On the robot, `sros verify FOLDER`, with the folder of its enclaves, says "
            "whether the keys are there."
        )
        yield Note("explain.without-keys", text)


def signed_enclave(
    keystore: OpenedKeystore | None, name: str, moment: datetime, *, planned: bool = False
) -> LoadedEnclave | None:
    """Load an enclave from a keystore, or from the folder ``name``.

    Returns None if there is neither keystore nor folder, or, with ``planned``, if the keystore does
    not have the enclave yet.
    """
    if keystore is None:
        folder = Path(name)
        return _load_enclave(folder, moment) if is_enclave(folder) else None
    root = keystore.root
    if is_enclave(root) and not (root / "enclaves").is_dir():
        enclave = _load_enclave(root, moment)
        if enclave.name != name:
            found_name = enclave.name or "no enclave"
            raise KeystoreError(f"'{root}' is the folder of {found_name}, not of {name}")
        return enclave
    keystore.check()
    if keystore.has_enclave(name):
        return deciding_enclave(keystore, name, moment=moment)
    if planned:
        return None
    from sros_tool.keystore.selection import missing_enclave_error

    raise missing_enclave_error(keystore, name, keystore.names)


def _load_enclave(folder: Path, moment: datetime) -> LoadedEnclave:
    """Load the enclave in a folder; its name is the common name of its certificate, or ""."""
    from sros_tool.pki.certificates import common_name_of

    state = open_enclave(folder, now=moment)
    name = common_name_of(state.certificate.subject) if state.certificate else ""
    return loaded_enclave(name, folder, state, moment=moment)


def planned_enclave(
    policy: Enclave, keystore: OpenedKeystore | None, asking: AskingContext
) -> LoadedEnclave:
    """Return the enclave as the policy would create it, with the keystore's governance.

    Without a keystore, the enclave gets the governance of the default template, with the protection
    that the policy demands.
    """
    from sros_tool.keystore.participant import plan_enclave
    from sros_tool.keystore.protection import governance_with_stated_protections
    from sros_tool.keystore.template import DEFAULT_TEMPLATE, load_template
    from sros_tool.policy.model import stated_protections

    if keystore:
        return plan_enclave(policy, keystore.governance, moment=asking.at)
    domain = asking.context(None).domain
    stated = stated_protections([policy])
    protection = load_template(DEFAULT_TEMPLATE).protection
    governance = governance_with_stated_protections(protection, stated, domain)
    return plan_enclave(policy, governance, moment=asking.at)


# ── a service or an action ─────────────────────────────────────────────────────────────────


def _action_meant(
    evaluator: Evaluator, question: Question, read_other_rights: Callable[[], Iterable[Right]]
) -> Question | None:
    """Return the question about an action; None if no right is about an action of this name.

    The rights of the enclave are read first.  If these deny the service, ``read_other_rights`` is
    called for more rights, such as the rights in the policy and in the keystore.
    """
    if question.word not in ("call", "serve"):
        return None
    from sros_tool.translate import grant_rights  # needed only for names that may be actions

    answer = evaluator.answer(question)
    rights = set(grant_rights(evaluator.enclave.name, answer.grant)) if answer.grant else set()
    if not answer.allowed:
        rights.update(read_other_rights())
    return question_about_action(question, rights)


def notes_on_question_about_action(question: Question, action: Question) -> tuple[Note, ...]:
    """Return a note that a question about a service is answered for an action.

    Empty for ``call``, because policies use this word for actions only.
    """
    if action.word == question.word:
        return ()
    text = (
        f"{action.name} is an action in these rights, not a service: the answer is for '{action}'. "
        "To ask about a service, add --type service."
    )
    return (Note("explain.an-action", text),)


def note_on_action(
    question: Question, kind: str | None, decide: Callable[[Question], tuple[bool, Sequence[str]]]
) -> Iterator[Note]:
    """Yield a note if the denied name is a part of an action, or names an action that is allowed.

    ``kind`` is the kind of the name if the user gave it. ``decide`` returns whether the enclave has
    the right, and which parts of an action it may use without this right.
    """
    if name := action_part(question.name)[0]:
        word = "execute" if question.right in ("publish", "reply") else "call"
        text = f"this {question.type} is a part of action {name}, which a node needs as a whole: "
        yield Note("explain.part-of-action", f"{text}ask about `{word} {name} --type action`.")
    if (question.word, question.type, kind) == ("call", "service", None):
        action = ask("call", question.name, "action")
        whole, parts = decide(action)
        if whole or parts:
            does = action if whole else f"do a part of '{action}'"
            text = f"the enclave may {does}: add --type action if {question.name} is an action."
            yield Note("explain.an-action", text)


def question_meant(
    evaluator: Evaluator, asked_enclave: AskedEnclave, question: Question, kind: str | None
) -> tuple[Question, tuple[Note, ...]]:
    """Return the question to answer, with a note if the user asked a different question."""
    if not kind:
        action = _action_meant(
            evaluator, question, lambda: asked_enclave.other_rights(question.name)
        )
        if action:
            return action, notes_on_question_about_action(question, action)
    return question, ()


# ── what is answered ───────────────────────────────────────────────────────────────────────


@shows("enclave", "question", "domain", "at", "time_zone")
class AskedQuestion(NamedTuple):
    """The question, with its enclave, domain and time."""

    enclave: str
    """The enclave that is asked about."""
    question: Question
    """The question, such as ``publish topic /chatter``."""
    context: JoinContext

    @property
    def domain(self) -> int:
        """The ROS domain."""
        return self.context.domain

    @property
    def at(self) -> datetime:
        """The time for which the question is asked, in UTC."""
        return self.context.at

    @property
    def time_zone(self) -> str:
        """The time zone of the robot."""
        return str(self.context.zone)


@shows("allowed", "mode", "text")
class ZenohInBrief(NamedTuple):
    """The decision of Zenoh."""

    allowed: bool
    """Whether data can flow."""
    mode: Annotated[str, Words(("client", "peer", "router"))] | None
    """Mode of the process, such as ``client`` or ``peer``; null if its file cannot be used."""
    text: str
    """Reason of the decision, as a clause."""
    outcome: str
