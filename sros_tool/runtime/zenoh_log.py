"""The security messages that Zenoh logs, their meanings, and the messages that it drops.

rmw_zenoh prints warnings and errors of nodes, and also informative messages of its router.  With
RUST_LOG=zenoh=debug, a process logs why a connection failed.  With RUST_LOG=zenoh=trace, it logs
the messages that access control drops.  Each text was seen in a log of Zenoh 1.10.2; texts of
rmw_zenoh_cpp are from its source code.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from sros_tool.runtime.log_texts import LogText

_RUN_IN_ENCLAVE = "Start the process in its enclave: `sros run KEYSTORE ENCLAVE -- COMMAND`."
_RUN_PEER = "Start that process in its enclave: `sros run KEYSTORE PEER -- COMMAND`."
_SAME_KEYSTORE = (
    "Give both sides enclaves of the same keystore, and restart both after each stage of `sros "
    "rotate_ca KEYSTORE`; `sros inspect` shows the CA of an enclave."
)
_WRITE_AGAIN = "Let `sros zenoh KEYSTORE` write the configuration, and do not edit it."

ZENOH_IDS = "zenoh-"
"""Prefix of the ids of Zenoh's log texts."""
ZENOH_LINE = re.compile(r"\A\s*(?:\S+Z\s+)?(?:TRACE|DEBUG|INFO|WARN|ERROR)\b.*?\bzenoh[\w:]*: ")
"""Pattern of a line of Zenoh's log; lines that match no text are no security problem."""


def _zenoh_text(name: str, pattern: str, cause: str, remedy: str, vagueness: int = 0) -> LogText:
    return LogText(
        f"{ZENOH_IDS}{name}", None, re.compile(pattern), cause, remedy, vagueness=vagueness
    )


_LISTENING_TEXTS = (
    _zenoh_text(
        "peer-no-certificate", r"zenoh_link\S*: .*peer sent no certificates",
        "a PEER was refused: it showed no certificate", _RUN_PEER,
    ),
    _zenoh_text(
        "foreign-ca", r"zenoh_link\S*: received fatal alert: UnknownCA"
        r"|invalid peer certificate: UnknownIssuer",
        "a PEER was refused, or refused this process: the two certificates are of different CAs",
        _SAME_KEYSTORE,
    ),
    _zenoh_text(
        "not-tls", r"zenoh_link\S*: received corrupt message of type InvalidContentType",
        "something without TLS connected to an endpoint with TLS: a process with an endpoint "
        "tcp/..., or another program",
        f"{_RUN_PEER} Many such connections a second keep all other processes out: use a firewall, "
        "or listen on localhost.",
    ),
    _zenoh_text(
        "peer-expired", r"invalid peer certificate: certificate expired",
        "a PEER was refused: its certificate has expired, by the clock of this host",
        "`sros inspect KEYSTORE` shows which certificate has expired, and `sros renew KEYSTORE "
        "PEER` renews the peer's enclave; then restart the peer.",
    ),
    _zenoh_text(
        "peer-not-yet-valid", r"invalid peer certificate: certificate not valid yet",
        "a PEER was refused: its certificate is not valid yet, by the clock of this host",
        "Set the clocks of both hosts.",
    ),
    _zenoh_text(
        "closed-expired", r"Closing \S+ link .{1,200}remote certificate chain expired",
        "a connection was closed, because the certificate of the other side has expired",
        "Renew the enclave of that process, `sros renew KEYSTORE PEER`, and restart the process.",
    ),
    _zenoh_text(
        "alert", r"zenoh_link\S*: received fatal alert: (?P<alert>\w{1,40})",
        "a PEER closed the connection: it does not accept the certificate of this process "
        "({alert}). Most often the peer compares the name of the endpoint with the certificate "
        "(verify_name_on_connect), but certificates of enclaves name no host",
        f"Look at the configuration of the peer. {_WRITE_AGAIN}",
    ),
    _zenoh_text(
        "no-subject", r"(?P<zid>[0-9a-f]{1,32}) did not match any configured ACL subject\. "
        r"Default permission `Deny`",
        "a PEER is connected, and may do nothing: no rule of this process is for the name in the "
        "peer's certificate",
        "`sros zenoh KEYSTORE --check` shows whether the files are up to date; restart the "
        "processes that it names. If the peer is the router, it runs in another enclave than the "
        "router enclave of the keystore.",
    ),
    _zenoh_text(
        "no-subject-open", r"(?P<zid>[0-9a-f]{1,32}) did not match any configured ACL subject\. "
        r"Default permission `Allow`",
        "a PEER is connected, and may do everything: the default of access_control is to allow",
        _WRITE_AGAIN,
    ),
)  # fmt: skip

_CONNECTING_TEXTS = (
    _zenoh_text(
        "no-certificate", r"received fatal alert: CertificateRequired",
        "this process showed no certificate", _RUN_IN_ENCLAVE,
    ),
    _zenoh_text(
        "expired", r"received fatal alert: CertificateExpired",
        "the certificate of this process has expired",
        "Renew the enclave: `sros renew KEYSTORE ENCLAVE`.",
    ),
    _zenoh_text(
        "refused", r"received fatal alert: (?P<alert>\w{1,40})",
        "the other side does not accept the certificate of this process ({alert})", _SAME_KEYSTORE,
    ),
    _zenoh_text(
        "name", r"invalid peer certificate: certificate not valid for name (?P<name>\"[^\"]*\")",
        "this process compares {name} with the certificate of the other side "
        "(verify_name_on_connect), but certificates of enclaves name no host",
        _WRITE_AGAIN,
    ),
    _zenoh_text(
        "no-paths", r"Missing TLS (?P<part>private key|certificate)",
        "the configuration does not say where the {part} is: ZENOH_CONFIG_OVERRIDE is missing",
        _RUN_IN_ENCLAVE,
    ),
    _zenoh_text(
        "key-mismatch", r"Bad certificate/key: keys may not be consistent",
        "the private key does not belong to the certificate",
        "Restore the key, or give the enclave a new one: `sros renew KEYSTORE ENCLAVE --new-key`.",
    ),
    _zenoh_text(
        "file", r"Invalid TLS (?P<part>[\w ]{1,40}?)(?: file)?: (?P<reason>[^/]{1,80}?) at /",
        "the file of the {part} cannot be read: {reason}",
        f"Restore the file, or correct the path in ZENOH_CONFIG_OVERRIDE. {_RUN_IN_ENCLAVE}",
    ),
    _zenoh_text(
        "tcp-to-tls", r"Unable to connect to configured peer (?P<endpoint>tcp/\S+)! Read error on "
        r"TCP link .{1,120}early eof",
        "the other side closed a connection without TLS to {endpoint}, where it listens with TLS",
        _RUN_IN_ENCLAVE,
    ),
    _zenoh_text(
        "protocol", r"Unsupported protocol: (?P<protocol>\w{1,20})\. Supported protocols are",
        "an endpoint has the protocol {protocol}, which the configuration excludes",
        "Write tls/HOST:PORT. " + _WRITE_AGAIN,
    ),
    _zenoh_text(
        "not-there",
        r"Unable to connect to configured peer (?P<endpoint>\S+)! .*Connection refused",
        "nothing listens at {endpoint}: the router does not run, or has another address",
        "Start the router: `sros run KEYSTORE /router -- ros2 run rmw_zenoh_cpp rmw_zenohd`.",
    ),
    _zenoh_text(
        "port-taken", r"Unable to open listener (?P<endpoint>\S+): .*Address already in use",
        "another process listens at {endpoint} already",
        "Stop that process: it may be another router.",
    ),
)  # fmt: skip

_CONFIGURATION_TEXTS = (
    _zenoh_text(
        "rules", r"Access control not enabled due to: (?P<reason>.{1,200}?) at /",
        "access_control is not valid, so the session does not open: {reason}",
        f"`sros check FILE` examines the file. {_WRITE_AGAIN}",
    ),
    _zenoh_text(
        "no-rules", r"Access control (?P<part>rules|subjects|policies) list is empty",
        "access_control has no {part}: no message passes",
        f"`sros check FILE` examines the file. {_WRITE_AGAIN}",
    ),
    _zenoh_text(
        "setting", r"unknown field `(?P<field>[^`]{1,60})`, expected one of",
        "the configuration has a setting that this Zenoh does not have: {field}",
        f"`sros check FILE` examines the file. {_WRITE_AGAIN}",
    ),
    _zenoh_text(
        "expression", r"Invalid Key Expr `(?P<key>[^`]{1,200})`: (?P<reason>.{1,200}?) at /",
        "the key expression {key} is not valid ({reason}), so the session does not open",
        f"`sros check FILE` examines the file. {_WRITE_AGAIN}",
    ),
    _zenoh_text(
        "configuration", r"Invalid configuration file (?P<path>\S{1,300})",
        "rmw_zenoh does not accept the configuration {path}",
        f"`sros check FILE` examines the file. {_WRITE_AGAIN}",
    ),
)  # fmt: skip

_REASONLESS_TEXTS = (
    _zenoh_text(
        "no-connection", r"Unable to connect to any of \[(?:Single\()?(?P<endpoint>[^\])]{1,200})"
        r"|Unable to connect to a Zenoh router",
        "no connection to the router: it does not run, or one side refused the other",
        "Read the log of the router, which says whom it refused; or start this process with "
        "RUST_LOG=zenoh=debug.",
        vagueness=1,
    ),
)  # fmt: skip

ZENOH_TEXTS: tuple[LogText, ...] = (
    *_LISTENING_TEXTS,
    *_CONNECTING_TEXTS,
    *_CONFIGURATION_TEXTS,
    *_REASONLESS_TEXTS,
)


def matching_zenoh_text(line: str) -> tuple[LogText, re.Match[str]] | None:
    """Return the text that explains a line of Zenoh's log, with its match, or None."""
    for text in ZENOH_TEXTS:
        if match := text.pattern.search(line):
            return text, match
    return None


class DroppedMessage(NamedTuple):
    """A message that access control dropped, as the log of the enforcing process reports it.

    ``line`` counts from 1; ``name`` is the common name of the remote process, "" if the log does
    not show a name; ``message`` is Zenoh's name for the message, such as "Declare Subscriber".
    ``process`` is the label of the enforcing process in the log, ``zid`` the Zenoh id of the remote
    process, and ``key`` the key expression.  ``ingress`` says that the enforcing process received
    the message; otherwise, it was to send the message.
    """

    line: int
    process: str
    zid: str
    name: str
    message: str
    ingress: bool
    key: str


_DENIED = re.compile(
    r"(?P<cached>Using cached result: )?(?P<zid>[0-9a-f]{1,32}) (?:on (?P<subject>\S{1,400}) )?"
    r"is unauthorized to (?P<message>[A-Z][\w/ ]{1,40}) \((?P<flow>ingress|egress)\) on "
    r"(?:Some\()?(?P<key>[^\s)]{1,1000})"
)
_NAME = re.compile(r"CertCommonName\((?P<name>[^)]{1,200})\)")
_DECLARED_OR_UNDECLARED = "Declare/Undeclare"


def dropped_messages(lines: Iterable[tuple[int, str, str]]) -> Iterator[DroppedMessage]:
    """Yield the dropped messages in lines (number, process, text) of a log.

    When a key is declared, Zenoh tests all kinds of messages for this key and logs every result.
    These lines, which contain "Declare/Undeclare", are about no message. The lines "Using cached
    result", and lines for keys that were not declared, are about messages.
    """
    declarations = []
    names: dict[tuple[str, str], str] = {}
    declared: set[tuple[str, str, str]] = set()
    for number, process, text in lines:
        if "is unauthorized to" not in text or not (match := _DENIED.search(text)):
            continue
        denial = process, match["zid"], match["key"]
        if match["subject"] and (named := _NAME.search(match["subject"])):
            names[process, match["zid"]] = named["name"]
        if match["message"].startswith(_DECLARED_OR_UNDECLARED):
            declared.add(denial)
        else:
            declarations.append((number, denial, match))
    for number, (process, zid, key), match in declarations:
        if match["cached"] or (process, zid, key) not in declared:
            name, ingress = names.get((process, zid), ""), match["flow"] == "ingress"
            yield DroppedMessage(number, process, zid, name, match["message"], ingress, key)
