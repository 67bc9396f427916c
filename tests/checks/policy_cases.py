"""Each finding about policies: groups of a node that bring it about, and a twin that does not."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Case:
    """The content of a profile with the finding, and one like it without; ``ns`` of the node.

    ``line`` is where it is found, counted from the first line of the content.
    """

    id: str
    bad: str
    good: str
    line: int | None = 1
    ns: str = "/"
    basics: bool = True


def topics(right: str, *names: str, qualifier: str = "ALLOW") -> str:
    items = "".join(f"<topic>{name}</topic>" for name in names)
    return f'<topics {right}="{qualifier}">{items}</topics>'


def services(right: str, *names: str, qualifier: str = "ALLOW") -> str:
    items = "".join(f"<service>{name}</service>" for name in names)
    return f'<services {right}="{qualifier}">{items}</services>'


def deny(right: str, *names: str) -> str:
    return topics(right, *names, qualifier="DENY")


PARAMETERS = (
    "~/describe_parameters",
    "~/get_parameter_types",
    "~/get_parameters",
    "~/list_parameters",
    "~/set_parameters",
    "~/set_parameters_atomically",
)
TYPES = "~/get_type_description"
LOG = topics("publish", "/rosout")
EVENTS = topics("publish", "/parameter_events")
BASICS = f"{LOG}{EVENTS}{services('reply', TYPES, *PARAMETERS)}"
OTHER = '</profile><profile ns="/" node="m">' + BASICS
GOAL = "dock/_action/send_goal"
DOCK = '<actions call="ALLOW"><action>dock</action></actions>'
MANY = tuple(f"{'very_' * 8}long_{index}" for index in range(1200))

CASES = [
    Case("policy.contradiction", f"{topics('publish', 'a')}\n{deny('publish', 'a')}",
         f"{topics('publish', '/x/*')}\n{deny('publish', '/x/a')}"),
    Case("policy.unreachable-rule", f"{topics('publish', '/x/a')}\n{deny('publish', '/x/*')}",
         f"{topics('publish', '/x/*')}\n{deny('publish', '/x/a')}"),
    Case("policy.deny-without-effect", deny("publish", "a"),
         f"{topics('publish', '/x/*')}\n{deny('publish', '/x/a')}"),
    Case("policy.redundant-rule", topics("publish", "/x/*", "/x/a"),
         topics("publish", "/x/*", "/y/a")),
    Case("policy.action-in-part", services("request", GOAL),
         DOCK),
    Case("policy.action-in-part", services("request", "dock/_action/*"),
         services("request", "dock/_action/*") + topics("subscribe", "dock/_action/*")),
    Case("policy.action-in-part", topics("publish", "dock/_action/feedback"),
         topics("subscribe", "dock/_action/feedback")),
    Case("policy.action-in-part", services("reply", "dock/_action/get_result"),
         services("request", "dock/_action/get_result")),
    Case("policy.action-in-part", f"{DOCK}\n{deny('subscribe', 'dock/_action/feedback')}",
         f"{DOCK}\n{deny('subscribe', 'mow/_action/feedback')}"),
    Case("policy.no-type-description", f"{LOG}{EVENTS}{services('reply', *PARAMETERS)}", BASICS,
         line=0, basics=False),
    Case("policy.no-rosout", f"{EVENTS}{services('reply', TYPES, *PARAMETERS)}", BASICS,
         line=0, basics=False),
    Case("policy.no-parameter-events", f"{LOG}{services('reply', TYPES, *PARAMETERS)}", BASICS,
         line=0, basics=False),
    Case("policy.no-parameter-services",
         f"{LOG}{EVENTS}{services('reply', TYPES, *PARAMETERS[:5])}", BASICS, line=0, basics=False),
    Case("policy.without-parameters", f"{LOG}{EVENTS}{services('reply', TYPES)}", BASICS, line=0,
         basics=False),
    Case("policy.relative-global-name", topics("publish", "rosout"), topics("publish", "/rosout"),
         ns="/arm"),
    Case("policy.other-nodes-parameters", services("reply", "/camera/set_parameters"),
         services("reply", "~/set_parameters")),
    Case("policy.protection-contradicts",
         topics("publish", '/x/*<?sros protect="sign"?>', '/x/a<?sros protect="encrypt"?>'),
         topics("publish", '/x/*<?sros protect="sign"?>', '/x/a<?sros protect="sign"?>')),
    Case("policy.name-never-matches", topics("publish", "/x/[0-9]*"), topics("publish", "/x/a?")),
    Case("policy.dds-name", topics("publish", "rt/scan"), topics("publish", "rta/scan")),
    Case("policy.wrong-kind", services("request", "/tf"), services("request", "/tf2")),
    Case("policy.everything", topics("publish", "/*"), topics("publish", "/x/*")),
    Case("policy.wide-wildcard", topics("publish", "/cam*"), topics("publish", "/cam/*")),
    Case("policy.reads-everything", topics("subscribe", "/*"), topics("subscribe", "/x/*")),
    Case("policy.sets-all-parameters", services("request", "/*/set_parameters"),
         services("request", "/*/get_parameters")),
    Case("policy.sets-all-parameters", services("request", "/*/set_parameters_atomically"),
         services("request", "/*/get_parameters")),
    Case("policy.sets-clock", topics("publish", "/clock"), topics("subscribe", "/clock")),
    Case("policy.no-counterpart", topics("subscribe", "a"),
         f"{topics('subscribe', 'a')}{topics('publish', 'a')}"),
    Case("policy.no-counterpart", services("request", "/*/get_sate"),
         services("request", "/*/get_state")),
    Case("policy.name-misspelt",
         services("request", "gripper/set") + OTHER + services("reply", "griper/set"),
         services("request", "gripper/set") + OTHER + services("reply", "gripper/set")),
    Case("policy.not-offered", EVENTS + OTHER + services("request", "n/release"),
         services("reply", "~/release") + OTHER + services("request", "n/release")),
    Case("policy.not-offered", services("request", "old/release") + OTHER
         + services("reply", "~/release"),
         services("request", "/x/old/release") + OTHER + services("reply", "~/release")),
    Case("policy.side-mistaken", services("request", "~/home"), services("reply", "~/home")),
    Case("policy.several-profiles",
         '</profile></profiles><profiles><profile ns="/" node="m">' + BASICS,
         OTHER, line=None),
    Case("policy.several-instances",
         '</profile><profile ns="/left" node="n">' + BASICS,
         '</profile><profile ns="/left" node="m">' + BASICS, line=None),
    Case("portable.document-size", topics("publish", *MANY), topics("publish", *MANY[:100]),
         line=None),
    Case("portable.long-name", topics("publish", f"/{'n' * 249}"),
         topics("publish", f"/{'n' * 248}"), line=None),
    Case("portable.deny-blocks-topic", f"{topics('publish', 'a')}{deny('subscribe', 'a')}",
         f"{topics('publish', '/x/*')}{deny('publish', '/x/a')}", line=None),
    Case("portable.character-set", topics("publish", "/x/[ab]"), topics("publish", "/x/?"),
         line=None),
]  # fmt: skip
