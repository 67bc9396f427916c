"""A question in ROS terms, and the DDS topics that its answer depends on.

Nodes speak of calling and serving; a policy says request and reply for services, and call and
execute for actions.  Mapping of names: ROS 2 design "Topic and Service name mapping to DDS".
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from sros_tool.dds.decision.answers import AccessVerb
from sros_tool.errors import UsageError
from sros_tool.names import (
    ROS_DISCOVERY_TOPIC,
    dds_names,
    expression_problem,
    is_expression,
    service_of,
)
from sros_tool.policy.model import ALLOW
from sros_tool.policy.rights import Right
from sros_tool.values import shows

_JOIN = "join"
TYPES = ("topic", "service", "action")
_RIGHTS = {
    ("publish", "topic"): "publish",
    ("subscribe", "topic"): "subscribe",
    ("call", "service"): "request",
    ("serve", "service"): "reply",
    ("call", "action"): "call",
    ("execute", "action"): "execute",
    ("request", "service"): "request",
    ("reply", "service"): "reply",
}
WORDS = (*dict.fromkeys(word for word, _ in _RIGHTS), _JOIN)
"""The words of questions; request and reply are the policy's words for call and serve."""

_ROLES = {"rq": "requests", "rr": "replies"}


@shows("verb", "topic", "role", null_if_empty=("role",))
class Part(NamedTuple):
    """One DDS endpoint that a right needs; ``role`` names it in ROS terms, "" for a topic."""

    verb: AccessVerb
    """Whether the endpoint publishes or subscribes."""
    topic: str
    """DDS topic of the endpoint."""
    role: str = ""
    """Role of the endpoint in ROS terms, such as ``requests``, or null."""

    def __str__(self) -> str:
        """Return text like ``publish its requests (rq/addRequest)``."""
        return f"{self.verb.value} its {self.role} ({self.topic})" if self.role else self.topic


OWN_PARTS = (
    Part(AccessVerb.PUBLISH, ROS_DISCOVERY_TOPIC, "node names"),
    Part(AccessVerb.SUBSCRIBE, ROS_DISCOVERY_TOPIC, "node names"),
)
"""The endpoints that every process of ROS 2 needs to start."""


@shows("word", "type", "right", "name", null_if_empty=("type", "right", "name"))
class Question(NamedTuple):
    """A question about an enclave, such as ``publish topic /chatter``.

    It asks whether the enclave may do ``word`` with ``name``, an absolute ROS name, or, if
    ``name`` is "", whether it may join.  ``only`` replaces the endpoints that the right needs.
    """

    word: str
    """The operation, such as `publish`."""
    type: str = ""
    """`topic`, `service` or `action`, or null."""
    right: str = ""
    """The right of the policy language, or null."""
    name: str = ""
    """The ROS name, or null."""
    only: tuple[Part, ...] = ()

    @property
    def parts(self) -> tuple[Part, ...]:
        """The endpoints that the right needs; none for joining."""
        if self.only or not self.right:
            return self.only
        names = dds_names(self.right, self.name)
        published = (
            Part(AccessVerb.PUBLISH, topic, _role(topic, self.type)) for topic in names.publish
        )
        read = (
            Part(AccessVerb.SUBSCRIBE, topic, _role(topic, self.type)) for topic in names.subscribe
        )
        return (*published, *read)

    def allowed(self, enclave: str) -> Right:
        """Return the right of an enclave that allows the access."""
        return Right(enclave, ALLOW, self.right, self.name)

    def __str__(self) -> str:
        """Return text like ``call service /add``."""
        return f"{self.word} {self.type} {self.name}" if self.right else "join the domain"


def ask(word: str, name: str = "", kind: str | None = None) -> Question:
    """Return the question for words of the command line such as ``call /add``.

    Args:
        word: One of `WORDS`.
        name: An absolute ROS name; "" for joining.
        kind: The type of the name: topic, service or action. By default, call means a service.

    Raises:
        UsageError: No node can do that, or no node could use the name.
    """
    if word not in WORDS:
        raise UsageError(
            f"unknown action {word!r}",
            "",
            f"Ask for {', '.join(WORDS[:-1])} or {WORDS[-1]}.",
        )
    if word == _JOIN:
        if name or kind:
            raise UsageError(
                "join takes no name and no type",
                "The question is whether the enclave may join the domain.",
            )
        return Question(_JOIN)
    fitting = [each for each in TYPES if (word, each) in _RIGHTS]
    chosen = kind or fitting[0]
    if chosen not in fitting:
        others = " or ".join(verb for verb, right in _RIGHTS if right == chosen)
        raise UsageError(
            f"nobody can {word} {_a(chosen)}",
            f"A node can {word} {' or '.join(map(_a, fitting))}, and {others} {_a(chosen)}.",
            f"Leave --type out, or write --type {fitting[0]}.",
        )
    return Question(word, chosen, _RIGHTS[word, chosen], _checked(name, word, chosen))


_OF_ACTIONS = {"call": "call", "serve": "execute"}


def about_action(question: Question, rights: Iterable[Right]) -> Question | None:
    """Return the question about the action with this name, if rights show that it is one.

    "call" and "serve" are for services and actions, whose names look the same.  Returns None if
    ``rights`` do not show an action, or if the question is about something else.
    """
    if question.type != "service" or question.word not in _OF_ACTIONS:
        return None
    kinds = {right.kind for right in rights if right.name == question.name}
    if "actions" not in kinds or "services" in kinds:
        return None
    return ask(_OF_ACTIONS[question.word], question.name, "action")


def _checked(name: str, word: str, kind: str) -> str:
    """Return the name; raise UsageError if no node can use it."""
    if not name:
        raise UsageError(f"{word} needs the name of {_a(kind)}", "", f"Write `{word} /NAME`.")
    problem = expression_problem(name)
    remedy = ""
    if not problem and is_expression(name):
        problem = "It has a wildcard, but a node uses one exact name."
        remedy = "Write one name, as the running robot shows it."
    elif not problem and not name.startswith("/"):
        problem = "It is relative to a node, and an enclave may have nodes of many namespaces."
        own = f"/NODE/{name[1:].lstrip('/') or 'NAME'}"
        remedy = f"Write {own if name.startswith('~') else f'/{name}'}, or /NAMESPACE/... in full."
    elif not problem and name == "/":
        problem = "It is a namespace."
    if problem:
        raise UsageError(f"{name!r} cannot be the name of {_a(kind)} here", problem, remedy)
    return name


def _a(kind: str) -> str:
    return f"an {kind}" if kind[0] in "aeiou" else f"a {kind}"


def _role(topic: str, kind: str) -> str:
    """Return the role of a DDS topic in a service or action, such as ``send_goal requests``."""
    if kind == "topic":
        return ""
    service, begin = service_of(topic)
    word = _ROLES.get(begin, "")
    last = (service or topic).rpartition("/")[2]
    return f"{last} {word}".rstrip() if kind == "action" else word
