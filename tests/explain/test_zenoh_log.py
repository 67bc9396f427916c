"""Lines that Zenoh 1.10.2 logged become causes and remedies."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from sros_tool.explain.log import explain_log
from sros_tool.explain.log_causes import LogFinding
from tests.support.harness import sros

FRAME = "2026-11-22T16:20:55.041714Z  "
LISTENER = f"{FRAME}WARN acc-0 ThreadId(05) zenoh_link_tls::unicast: "
HINT = ". Hint: increase the system open file limit."
CONNECT = f"{FRAME}DEBUG ThreadId(01) zenoh::net::runtime::orchestrator: "
PEER = f"{CONNECT}Unable to connect to configured peer tls/127.0.0.1:7447! "
END = " at /cargo/zenoh-link-tls/src/unicast.rs:226.. Retry in 1s."
LINKED = "Can not create a new TLS link bound to IpAddress(V4(Ipv4Addr([127, 0, 0, 1]))): "
FILES = "Cannot create a new TLS listener to tls/127.0.0.1:7447#enable_mtls=true: "
SUBJECT = "access_control: 3e781491ba73b7ee did not match any configured ACL subject. Default "

LINES = {
    "zenoh-peer-no-certificate": f"{LISTENER}peer sent no certificates{HINT}",
    "zenoh-foreign-ca": f"{LISTENER}received fatal alert: UnknownCA{HINT}",
    "zenoh-not-tls": f"{LISTENER}received corrupt message of type InvalidContentType{HINT}",
    "zenoh-peer-expired": f"{LISTENER}invalid peer certificate: certificate expired: verification "
    f"time 1795364553 (UNIX), but certificate is not valid after 1795360951{HINT}",
    "zenoh-closed-expired": f"{FRAME}WARN acc-0 ThreadId(05) zenoh_link_commons::tls::expiration: "
    "Closing TLS link 127.0.0.1:17890 => 127.0.0.1:44052 : remote certificate chain expired",
    "zenoh-alert": f"{LISTENER}received fatal alert: BadCertificate{HINT}",
    "zenoh-no-subject": f"{FRAME}INFO acc-0 zenoh::net::routing::interceptor::{SUBJECT}"
    "permission `Deny` will be applied on all messages",
    "zenoh-no-subject-open": f"{FRAME}INFO acc-0 zenoh::net::routing::interceptor::{SUBJECT}"
    "permission `Allow` will be applied on all messages",
    "zenoh-no-certificate": f"{PEER}received fatal alert: CertificateRequired{END}",
    "zenoh-expired": f"{PEER}received fatal alert: CertificateExpired{END}",
    "zenoh-refused": f"{PEER}received fatal alert: CertificateUnknown{END}",
    "zenoh-name": f"{PEER}{LINKED}invalid peer certificate: certificate not valid for name "
    f'"127.0.0.1"; certificate is not valid for any names{END}',
    "zenoh-no-paths": f"{PEER}{FILES}Missing TLS private key.{END}",
    "zenoh-key-mismatch": f"{PEER}{FILES}Bad certificate/key: keys may not be consistent: "
    f"KeyMismatch{END}",
    "zenoh-file": f"{PEER}{FILES}Invalid TLS certificate file: No such file or directory (os error "
    f"2){END}",
    "zenoh-tcp-to-tls": f"{CONNECT}Unable to connect to configured peer tcp/127.0.0.1:7447! Read "
    f"error on TCP link 127.0.0.1:35034 => 127.0.0.1:7447: early eof{END}",
    "zenoh-protocol": f"{CONNECT}Unable to open listener tcp/127.0.0.1:0: Unsupported protocol: "
    f"tcp. Supported protocols are: [Tls]{END}",
    "zenoh-not-there": f"{PEER}{LINKED}[127.0.0.1:1: Connection refused (os error 111){END}",
    "zenoh-port-taken": f"{CONNECT}Unable to open listener tls/127.0.0.1:7447: Can not create a "
    f"new TLS listener on 127.0.0.1:7447: Address already in use (os error 98){END}",
    "zenoh-rules": "ZError: Access control not enabled due to: Rule 'x' in policy #0 does not "
    "exist in rules list at /cargo/authorization.rs:551.",
    "zenoh-no-rules": f"{FRAME}WARN zenoh::net::routing::interceptor::authorization: Access "
    "control rules list is empty in config file",
    "zenoh-setting": "ZError: unknown field `acces_control`, expected one of `id`, `metadata`",
    "zenoh-expression": "ZError: Invalid Key Expr `**/*`: `**/*` must be replaced by `*/**` to "
    "reach canon-form at /cargo/borrowed.rs:777.",
    "zenoh-no-connection": f"{FRAME}WARN zenoh::net::runtime::orchestrator: Unable to connect to "
    f"any of [Single(tls/127.0.0.1:7447)]. Timeout!{END}",
}
HARMLESS = (
    f"{FRAME}WARN ThreadId(01) zenoh_link_tls::utils: Skipping name verification of TLS server",
    f"{FRAME}INFO zenoh::net::runtime::orchestrator: Zenoh can be reached at: tls/127.0.0.1:7447",
    f"{FRAME}DEBUG zenoh::net::routing::interceptor::access_control: Access control is enabled",
    f"{FRAME}DEBUG zenoh_link_tls::utils: Loading client authentication key and certificate...",
)


def explained(text: str) -> tuple[LogFinding, ...]:
    def no_context(_: object) -> object:
        raise AssertionError("no enclave is examined")

    return explain_log(text, lambda _: None, no_context)  # type: ignore[arg-type]


@pytest.mark.parametrize(("id", "line"), LINES.items())
def test_causes(id: str, line: str) -> None:  # noqa: A002
    (found,) = explained("\n".join([*HARMLESS, line, line]))
    assert (found.id, found.line, found.count, found.zenoh) == (id, len(HARMLESS) + 1, 2, True)
    assert found.cause
    assert found.remedy


def test_a_reason_counts_more_than_a_timeout() -> None:
    found = explained(LINES["zenoh-no-connection"] + "\n" + LINES["zenoh-no-certificate"])
    assert [each.id for each in found] == ["zenoh-no-certificate"]


def test_what_is_no_trouble_is_not_reported() -> None:
    assert explained("\n".join(HARMLESS)) == ()


ZID = "476cc12834c14bf9c8f305d392020e5b"
RULE = f"{FRAME}TRACE  rx-1 zenoh::net::routing::interceptor::access_control: "
NAMED = f"{RULE}{ZID} on Interface(lo)+CertCommonName(/talker)+Transport(Tls)+{ZID} is "
CACHED = f"{RULE}Using cached result: {ZID} is unauthorized to "
SECRET = "0/secret/std_msgs::msg::dds_::String_/RIHS01_0"


def dropped(*lines: str) -> list[str]:
    return [each.cause.partition(": the process")[0] for each in explained("\n".join(lines))]


def test_dropped_messages() -> None:
    found = explained(
        "\n".join(
            [
                f"{NAMED}unauthorized to Put (ingress) on {SECRET}",
                f"{NAMED}unauthorized to Declare/Undeclare Subscriber (ingress) on {SECRET}",
                f"{NAMED}authorized to Put (ingress) on 0/chatter/t/h",
                f"{CACHED}Put (ingress) on {SECRET}",
                f"{CACHED}Put (ingress) on {SECRET}",
                f"{CACHED}Declare Subscriber (ingress) on 0/ns/map/t/h",
                f"{CACHED}Query (ingress) on 0/map/t/h/@adv/pub/a1/0/_",
            ]
        )
    )
    assert [(each.id, each.line, each.count, each.enclave) for each in found] == [
        ("zenoh-dropped", 4, 2, "/talker"),
        ("zenoh-dropped", 6, 1, "/talker"),
        ("zenoh-dropped", 7, 1, "/talker"),
    ]
    assert found[0].cause.startswith("/talker may not publish /secret: the process that logged")
    assert found[0].remedy.startswith(
        "`sros explain KEYSTORE /talker publish /secret --vendor zenoh`"
    )
    assert found[1].cause.startswith("/talker may not subscribe /ns/map")


def test_a_key_that_was_tried_at_its_declaration_is_no_message() -> None:
    tried = [
        f"{NAMED}unauthorized to {each} (ingress) on {SECRET}"
        for each in ("Query", "Put", "Declare/Undeclare Subscriber")
    ]
    assert dropped(*tried) == []
    # The key of a put was not declared: the line is the message.
    assert dropped(*tried, f"{NAMED}unauthorized to Put (ingress) on 0/other/t/h") == [
        "/talker may not publish /other"
    ]


@pytest.mark.parametrize(
    ("line", "cause"),
    [
        (f"{CACHED}Put (egress) on 0/a/t/h", "subscribe /a"),
        (f"{CACHED}Declare Subscriber (egress) on 0/a/t/h", "publish /a"),
        (f"{CACHED}Query (egress) on 0/a/t/h", "serve /a"),
        (f"{CACHED}Reply (egress) on 0/a/t/h", "call /a"),
        (f"{CACHED}Declare Queryable (ingress) on 0/a/t/h", "serve /a"),
        (f"{CACHED}Liveliness Query (ingress) on @ros2_lv/0/**", "ask for the graph"),
        (f"{CACHED}Put (ingress) on free/form", "pass Put of free/form"),
    ],
)
def test_who_may_not(line: str, cause: str) -> None:
    assert dropped(line) == [f"the process with the zid {ZID} may not {cause}"]


def test_the_verb_and_its_json(tmp_path: Path) -> None:
    log = tmp_path / "router.log"
    log.write_text(f"{LINES['zenoh-foreign-ca']}\n{CACHED}Put (ingress) on {SECRET}\n")
    ended = sros("explain", "--log", log)
    assert "means     Zenoh: a PEER was refused" in ended.out
    found = json.loads(sros("explain", "--log", log, "--json").out)["findings"]
    assert [(each["id"], each["vendor"]) for each in found] == [
        ("zenoh-foreign-ca", "zenoh"),
        ("zenoh-dropped", "zenoh"),
    ]


def test_hostile_lines_end_soon() -> None:
    text = "\n".join(
        [
            f"{FRAME}WARN " + "zenoh_link " * 50_000,
            "zenoh:" * 100_000,
            "Unable to connect to configured peer " * 10_000,
            CACHED + "Put (ingress) on " + "x/" * 100_000,
            f"{RULE}{'a' * 100_000} is unauthorized to Put",
        ]
    )
    assert len(explained(text)) <= 2


@pytest.mark.parametrize(
    ("message", "right"), [("Put (egress)", "publish"), ("Put (ingress)", "subscribe")]
)
def test_a_node_that_drops_what_it_has_for_its_router_lacks_the_right_itself(
    keystore: Path, tmp_path: Path, message: str, right: str
) -> None:
    log = tmp_path / "talker.log"
    named = NAMED.replace("/talker)", "/router)")
    log.write_text(f"{named}unauthorized to {message} on 0/x/t/h\n{CACHED}{message} on {SECRET}\n")
    for enclave, who in (("/a", "/a"), ("", "ENCLAVE")):
        place = [keystore, enclave] if enclave else [keystore]
        found = json.loads(sros("explain", *place, "--log", log, "--json").out)["findings"]
        assert all(each["enclave"] == (enclave or None) for each in found)
        assert f"may not {right} /secret" in found[-1]["cause"]
        assert not found[-1]["cause"].startswith("/router")
        command = f"sros explain {keystore} {who} {right} /secret --vendor zenoh"
        assert command in found[-1]["remedy"]
