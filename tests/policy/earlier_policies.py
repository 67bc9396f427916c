"""Policies in the shapes that are found in public, with names of our own.

Each shape is a function from a robot's namespace and two nodes to a policy; the files that it
includes are `FRAGMENTS`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

XI = 'xmlns:xi="http://www.w3.org/2001/XInclude"'
FRAGMENTS = {
    "common/node.xml": f"""<profile {XI}>
  <xi:include href="node/logging.xml" xpointer="xpointer(/profile/*)"/>
  <xi:include href="node/parameters.xml" xpointer="xpointer(/profile/*)"/>
</profile>""",
    "common/node/logging.xml": """<profile>
  <topics publish="ALLOW" ><topic>rosout</topic></topics>
</profile>""",
    "common/node/parameters.xml": """<profile>
  <topics publish="ALLOW" subscribe="ALLOW" ><topic>parameter_events</topic></topics>
  <services reply="ALLOW" request="ALLOW" >
    <service>~get_parameters</service>
    <service>~set_parameters</service>
  </services>
</profile>""",
    "pumps.xml": """<policy version="0.1.0"><profiles>
  <profile ns="/plant" node="pump"><topics publish="ALLOW"><topic>flow</topic></topics></profile>
  <profile ns="/plant" node="valve"><topics subscribe="ALLOW"><topic>flow</topic></topics></profile>
</profiles></policy>""",
}
COMMON = '<xi:include href="common/node.xml" xpointer="xpointer(/profile/*)"/>'


def _policy(body: str, version: str = "0.1.0") -> str:
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<policy version="{version}" {XI}>{body}</policy>'
    )


def _nodes(*profiles: tuple[str, str, str]) -> str:
    """Return a policy of version 0.1.0; each profile is a namespace, a node and its groups."""
    found = (f'<profile ns="{ns}" node="{node}">{body}</profile>' for ns, node, body in profiles)
    return _policy(f"<profiles>{''.join(found)}</profiles>")


def _enclave(path: str, *profiles: str, version: str = "0.2.0") -> str:
    block = f"<profiles>{''.join(profiles)}</profiles>"
    enclave = f'<enclave path="{path}">{block}</enclave>'
    return _policy(f"<enclaves>{enclave}</enclaves>", version)


def _two(ns: str, one: str, other: str) -> str:
    return _nodes(
        (ns, one, f'{COMMON}<topics publish="ALLOW" ><topic>level</topic></topics>'),
        (ns, other, f'{COMMON}<topics subscribe="ALLOW" ><topic>level</topic></topics>'),
    )


def _service(ns: str, one: str, other: str) -> str:
    return _nodes(
        (ns, one, '<services reply="ALLOW"><service>add</service></services>'),
        (ns, other, '<services request="ALLOW"><service>add</service></services>'),
    )


def _action(ns: str, one: str, other: str) -> str:
    return _nodes(
        (ns, one, '<actions execute="ALLOW"><action>fill</action></actions>'),
        (ns, other, '<actions call="ALLOW"><action>/plant/fill</action></actions>'),
    )


def _everything(ns: str, one: str, _other: str) -> str:
    return _nodes(
        (
            ns,
            one,
            '<topics publish="ALLOW" subscribe="ALLOW"><topic>/*</topic></topics>'
            '<services reply="ALLOW" request="ALLOW"><service>/*</service></services>'
            '<actions call="ALLOW" execute="ALLOW"><action>/*</action></actions>',
        )
    )


def _tool(ns: str, one: str, _other: str) -> str:
    star = '<topics publish="ALLOW" subscribe="ALLOW"><topic>*</topic></topics>'
    return _nodes(
        (ns, one, COMMON),
        (ns, "_ros2cli", f'{star}<services request="ALLOW"><service>*</service></services>'),
    )


def _denied(ns: str, one: str, other: str) -> str:
    return _nodes(
        (
            ns,
            one,
            '<topics publish="DENY" subscribe="ALLOW"><topic>secret</topic></topics>'
            '<topics publish="ALLOW"><topic>/all/*</topic></topics>',
        ),
        (ns, other, '<services reply="DENY"><service>~reset</service></services>'),
    )


def _private(ns: str, one: str, other: str) -> str:
    return _nodes(
        (ns, one, '<topics publish="ALLOW"><topic>~state</topic><topic>~/mode</topic></topics>'),
        (ns, other, '<actions execute="ALLOW"><action>~calibrate</action></actions>'),
    )


def _learned(ns: str, one: str, other: str) -> str:
    """As `ros2 security generate_policy` wrote it: attributes sorted, nodes without rights."""
    body = '<topics subscribe="ALLOW"><topic>level</topic></topics>'
    return _policy(
        f'<profiles><profile node="{one}" ns="{ns}"/>'
        f'<profile node="{other}" ns="{ns}">{body}</profile></profiles>'
    )


def _of_files(ns: str, one: str, _other: str) -> str:
    included = '<xi:include href="pumps.xml" xpointer="xpointer(/policy/profiles/*)"/>'
    return _policy(
        f'<profiles>{included}<profile ns="{ns}" node="{one}">{COMMON}</profile></profiles>'
    )


def _wrong_number(ns: str, one: str, other: str) -> str:
    """Enclaves, with the version of the format that had none."""
    group = '<topics publish="ALLOW" subscribe="DENY"><topic>out/*</topic></topics>'
    profile = f'<profile ns="{ns}" node="{one}">{group}</profile>'
    return _enclave(f"/{other}", profile, version="0.1.0")


def _contexts(ns: str, one: str, other: str) -> str:
    group = '<topics publish="ALLOW"><topic>level</topic></topics>'
    profile = f'<profiles><profile ns="{ns}" node="{one}">{group}</profile></profiles>'
    return _policy(
        f'<contexts><context path="/{other}">{profile}</context></contexts>', version="0.2.0"
    )


def _one_enclave(ns: str, one: str, other: str) -> str:
    return _enclave(
        f"/{one}",
        f'<profile ns="{ns}" node="{one}"><topics publish="ALLOW"><topic>level</topic></topics>'
        '<services reply="ALLOW"><service>~/get_parameters</service></services></profile>',
        f'<profile ns="{ns}" node="{other}"><topics subscribe="ALLOW"><topic>level</topic></topics>'
        '<actions call="ALLOW"><action>fill</action></actions></profile>',
    )


def _root_enclave(ns: str, one: str, _other: str) -> str:
    star = '<topics publish="ALLOW"><topic>*</topic><topic>*/*</topic></topics>'
    return _enclave("/", f'<profile node="{one}" ns="{ns}">{star}</profile>')


def _denied_otherwise(ns: str, one: str, other: str) -> str:
    return _enclave(
        f"/{other}",
        f'<profile ns="{ns}" node="{one}">'
        '<topics publish="ALLOW" subscribe="ALLOW"><topic>swarm/level</topic></topics>'
        '<topics publish="DENY" subscribe="DENY"><topic>**</topic></topics></profile>',
    )


Shape = Callable[[str, str, str], str]
EARLIER: tuple[Shape, ...] = (
    _two, _service, _action, _everything, _tool, _denied, _private, _learned, _of_files,
    _wrong_number, _contexts,
)  # fmt: skip
PRESENT: tuple[Shape, ...] = (_one_enclave, _root_enclave, _denied_otherwise)
_ROBOTS = (
    ("/", "gauge", "display"),
    ("/plant/", "mixer_3", "panel"),
    ("/a/b", "camera", "recorder"),
    ("/left_arm", "gripper", "planner"),
)


def policies(shapes: tuple[Shape, ...]) -> Iterator[tuple[str, str]]:
    """Yield an id and the text of each policy."""
    for shape in shapes:
        for ns, one, other in _ROBOTS:
            yield f"{shape.__name__[1:]}-{one}", shape(ns, one, other)
