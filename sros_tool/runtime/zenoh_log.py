"""The messages about security that Zenoh and rmw_zenoh log, and their meanings.

rmw_zenoh prints what is a warning or worse for nodes, and what is informative for its router;
RUST_LOG=zenoh=debug makes a process say why a connection failed, and RUST_LOG=zenoh=trace which
messages access control drops.  Each text was seen in a log of Zenoh 1.10.2, but for those of
rmw_zenoh_cpp, which are from its source.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from sros_tool.runtime.vendor_log import LogText

_RUN = "Start it in its enclave: `sros run KEYSTORE ENCLAVE -- COMMAND`."
_RUN_PEER = "Start that process in its enclave: `sros run KEYSTORE ENCLAVE -- COMMAND`."
_SAME = (
    "Give both sides enclaves of the same keystore, and restart both after each stage of `sros "
    "rotate_ca KEYSTORE`; `sros inspect` shows the CA of each."
)
_WRITTEN = "Let `sros zenoh KEYSTORE` write the file, and do not edit it."

ZENOH_IDS = "zenoh-"
"""How the ids of texts of Zenoh begin."""
ZENOH_LINE = re.compile(r"\A\s*(?:\S+Z\s+)?(?:TRACE|DEBUG|INFO|WARN|ERROR)\b.*?\bzenoh[\w:]*: ")
"""A line of Zenoh's log: what is not in the table is no trouble of security."""


def _text(name: str, pattern: str, cause: str, remedy: str, weak: int = 0) -> LogText:
    return LogText(f"{ZENOH_IDS}{name}", None, re.compile(pattern), cause, remedy, weak=weak)


_TEXTS: tuple[LogText, ...] = (
    # ── the side that listens ──────────────────────────────────────────────────────────────
    _text(
        "peer-no-certificate", r"zenoh_link\S*: .*peer sent no certificates",
        "a PEER was refused: it showed no certificate", _RUN_PEER,
    ),
    _text(
        "foreign-ca", r"zenoh_link\S*: received fatal alert: UnknownCA"
        r"|invalid peer certificate: UnknownIssuer",
        "a PEER was refused, or refused this process: their certificates are of different CAs",
        _SAME,
    ),
    _text(
        "not-tls", r"zenoh_link\S*: received corrupt message of type InvalidContentType",
        "something without TLS connected to an endpoint with TLS: a process with an endpoint "
        "tcp/..., or another program",
        f"{_RUN_PEER} Many such lines a second keep everybody out: use a firewall, or listen on "
        "localhost.",
    ),
    _text(
        "peer-expired", r"invalid peer certificate: certificate expired",
        "a PEER was refused: its certificate has expired, by the clock of this host",
        "Renew it, and restart the peer: `sros inspect KEYSTORE` shows which one, `sros renew "
        "KEYSTORE ENCLAVE` renews it.",
    ),
    _text(
        "peer-not-yet-valid", r"invalid peer certificate: certificate not valid yet",
        "a PEER was refused: its certificate is not valid yet, by the clock of this host",
        "Set the clocks of both hosts.",
    ),
    _text(
        "closed-expired", r"Closing \S+ link .{1,200}remote certificate chain expired",
        "a connection was closed, because the certificate of the other side has expired",
        "Renew it, and restart that process: `sros renew KEYSTORE ENCLAVE`.",
    ),
    _text(
        "alert", r"zenoh_link\S*: received fatal alert: (?P<alert>\w{1,40})",
        "a PEER closed the connection: it does not accept the certificate of this process "
        "({alert}); most often it compares the name of the endpoint with it "
        "(verify_name_on_connect), and certificates of enclaves name no host",
        f"Look at the configuration of the peer. {_WRITTEN}",
    ),
    _text(
        "no-subject", r"(?P<zid>[0-9a-f]{1,32}) did not match any configured ACL subject\. "
        r"Default permission `Deny`",
        "a PEER is connected, and may do nothing: no rule here has the name of its certificate",
        "`sros zenoh KEYSTORE --check` shows whether the files are up to date; restart the "
        "processes that it names. If the peer is the router, its enclave is not the one that the "
        "keystore names.",
    ),
    _text(
        "no-subject-open", r"(?P<zid>[0-9a-f]{1,32}) did not match any configured ACL subject\. "
        r"Default permission `Allow`",
        "a PEER is connected, and may do everything: the default of access_control is to allow",
        _WRITTEN,
    ),
    # ── the side that connects ─────────────────────────────────────────────────────────────
    _text(
        "no-certificate", r"received fatal alert: CertificateRequired",
        "this process showed no certificate", _RUN,
    ),
    _text(
        "expired", r"received fatal alert: CertificateExpired",
        "the certificate of this process has expired", "Renew it: `sros renew KEYSTORE ENCLAVE`.",
    ),
    _text(
        "refused", r"received fatal alert: (?P<alert>\w{1,40})",
        "the other side does not accept the certificate of this process ({alert})", _SAME,
    ),
    _text(
        "name", r"invalid peer certificate: certificate not valid for name (?P<name>\"[^\"]*\")",
        "this process compares {name} with the certificate there (verify_name_on_connect), and "
        "certificates of enclaves name no host",
        _WRITTEN,
    ),
    _text(
        "no-paths", r"Missing TLS (?P<what>private key|certificate)",
        "the configuration does not say where the {what} is: ZENOH_CONFIG_OVERRIDE is missing",
        _RUN,
    ),
    _text(
        "key-mismatch", r"Bad certificate/key: keys may not be consistent",
        "the private key is not that of the certificate",
        "Restore the key, or give the enclave a new one: `sros renew KEYSTORE ENCLAVE --new-key`.",
    ),
    _text(
        "file", r"Invalid TLS (?P<what>[\w ]{1,40}?)(?: file)?: (?P<why>[^/]{1,80}?) at /",
        "the file of the {what} cannot be read: {why}",
        f"Restore the file, or correct the path in ZENOH_CONFIG_OVERRIDE. {_RUN}",
    ),
    _text(
        "tcp-to-tls", r"Unable to connect to configured peer (?P<endpoint>tcp/\S+)! Read error on "
        r"TCP link .{1,120}early eof",
        "the other side closed a connection without TLS to {endpoint}: it listens with TLS", _RUN,
    ),
    _text(
        "protocol", r"Unsupported protocol: (?P<protocol>\w{1,20})\. Supported protocols are",
        "an endpoint has the protocol {protocol}, which the configuration excludes",
        "Write tls/HOST:PORT. " + _WRITTEN,
    ),
    _text(
        "not-there",
        r"Unable to connect to configured peer (?P<endpoint>\S+)! .*Connection refused",
        "nothing listens at {endpoint}: the router does not run, or has another address",
        "Start the router: `sros run KEYSTORE /router -- ros2 run rmw_zenoh_cpp rmw_zenohd`.",
    ),
    _text(
        "port-taken", r"Unable to open listener (?P<endpoint>\S+): .*Address already in use",
        "another process listens at {endpoint} already", "Stop it: it may be another router.",
    ),
    # ── configurations ─────────────────────────────────────────────────────────────────────
    _text(
        "rules", r"Access control not enabled due to: (?P<why>.{1,200}?) at /",
        "access_control is not valid, so the session does not open: {why}",
        f"`sros check FILE` examines it. {_WRITTEN}",
    ),
    _text(
        "no-rules", r"Access control (?P<what>rules|subjects|policies) list is empty",
        "access_control has no {what}: no message passes",
        f"`sros check FILE` examines it. {_WRITTEN}",
    ),
    _text(
        "setting", r"unknown field `(?P<field>[^`]{1,60})`, expected one of",
        "the configuration has a setting that this Zenoh does not have: {field}",
        f"`sros check FILE` examines it. {_WRITTEN}",
    ),
    _text(
        "expression", r"Invalid Key Expr `(?P<key>[^`]{1,200})`: (?P<why>.{1,200}?) at /",
        "the key expression {key} is not valid ({why}), so the session does not open",
        f"`sros check FILE` examines it. {_WRITTEN}",
    ),
    _text(
        "configuration", r"Invalid configuration file (?P<path>\S{1,300})",
        "rmw_zenoh does not accept the configuration {path}",
        f"`sros check FILE` examines it. {_WRITTEN}",
    ),
    # ── without a reason ───────────────────────────────────────────────────────────────────
    _text(
        "no-connection", r"Unable to connect to any of \[(?:Single\()?(?P<endpoint>[^\])]{1,200})"
        r"|Unable to connect to a Zenoh router",
        "no connection to the router: it does not run, or one side refused the other",
        "Read the log of the router, which says whom it refused; or start this process with "
        "RUST_LOG=zenoh=debug.",
        weak=1,
    ),
)  # fmt: skip


def zenoh_text(line: str) -> tuple[LogText, re.Match[str]] | None:
    """Return the text that explains a line of Zenoh, with its match, or None."""
    for text in _TEXTS:
        if match := text.pattern.search(line):
            return text, match
    return None


# ── denied messages ────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, slots=True)
class DroppedMessage:
    """A message that access control dropped, as the log of the enforcing process says.

    ``line`` counts from 1; ``name`` is the common name of the remote process, "" if the log does
    not tell it; ``message`` is as Zenoh writes it, such as "Declare Subscriber".
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
_BOTH = "Declare/Undeclare"


def dropped_messages(lines: Iterable[tuple[int, str, str]]) -> Iterator[DroppedMessage]:
    """Yield the dropped messages in lines: their numbers, processes and texts.

    When a key is declared, Zenoh tries all kinds of messages for it and logs each result.  These
    lines, which have "Declare/Undeclare" among them, are of no message: only "Using cached result"
    is, and lines for keys that were not declared.
    """
    found = []
    names: dict[tuple[str, str], str] = {}
    declared: set[tuple[str, str, str]] = set()
    for number, process, text in lines:
        if "is unauthorized to" not in text or not (match := _DENIED.search(text)):
            continue
        place = process, match["zid"], match["key"]
        if match["subject"] and (named := _NAME.search(match["subject"])):
            names[process, match["zid"]] = named["name"]
        if match["message"].startswith(_BOTH):
            declared.add(place)
        else:
            found.append((number, place, match))
    for number, (process, zid, key), match in found:
        if match["cached"] or (process, zid, key) not in declared:
            name, ingress = names.get((process, zid), ""), match["flow"] == "ingress"
            yield DroppedMessage(number, process, zid, name, match["message"], ingress, key)
