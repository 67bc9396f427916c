"""The messages that Zenoh dropped by its rules, with the rights that senders lacked."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from shlex import quote

from sros_tool.explain.log_causes import LogFinding
from sros_tool.explain.log_lines import MAX_LINE_LENGTH
from sros_tool.explain.log_sources import SearchedKeystore
from sros_tool.keystore.layout import is_original_keystore
from sros_tool.runtime.vendor_log import labeled_line
from sros_tool.runtime.zenoh_log import DroppedMessage, dropped_messages
from sros_tool.translate_zenoh.rights import name_of_key

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


def dropped_message_findings(
    lines: Iterable[str], root: str, own_enclave: str, keystore: SearchedKeystore | None
) -> Iterator[LogFinding]:
    """Yield a finding for each missing right for which Zenoh dropped messages.

    ``own_enclave`` is the enclave of the process that wrote the log, "" if unknown. ``root`` is the
    path of the keystore for remedies, or "".

    If the process drops a message to or from its router, the process itself lacks the right: its
    configuration allows the router only what the process's own rights need.
    """
    numbered = ((n, *labeled_line(line[:MAX_LINE_LENGTH])) for n, line in enumerate(lines, 1))
    groups: dict[tuple[str, str, bool, str], list[DroppedMessage]] = {}
    dropped = [*dropped_messages(numbered)]
    routers = keystore.zenoh_routers if keystore and dropped else frozenset[str]()
    for message in dropped:
        # Routers check each other, too: a process without a known name may be a router.
        is_node = own_enclave not in routers if own_enclave else len(routers) == 1
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
            enclave, lacking = own_enclave, own_enclave or "the process that wrote this log"
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
            "If the process runs in an enclave of the keystore, `sros zenoh KEYSTORE --check` "
            "shows whether the files are up to date."
        ).replace(
            "KEYSTORE", quote(root) if root and is_original_keystore(Path(root)) else "KEYSTORE"
        )
    verb, _, name = asked.partition(" ")
    who = quote(enclave) if enclave else "ENCLAVE"
    command = f"sros explain {quote(root) if root else 'KEYSTORE'} {who}"
    shown = f"`{command} {verb} {quote(name)} --vendor zenoh` shows what is missing in the policy"
    return f"{shown}." if enclave else f"{shown}; ENCLAVE is the enclave of that process."
