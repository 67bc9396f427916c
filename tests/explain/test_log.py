"""Logs of vendors become causes: real ones of broken enclaves, alone and with the enclave."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from itertools import groupby
from pathlib import Path
from typing import Any

import pytest

from sros_tool.dds.decision.vendors import Vendor
from sros_tool.explain import asking
from sros_tool.explain.log import explain_log, explain_log_file
from sros_tool.explain.log_causes import LogFinding
from sros_tool.files import policies_dir
from sros_tool.keystore.ledger import Ledger, LedgerFile
from sros_tool.keystore.participant import LoadedEnclave, load_enclave_of
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.names import PARAMETER_SERVICES
from sros_tool.pki.certificates import identity_of, load_certificate
from sros_tool.policy.document import read_policy
from sros_tool.policy.model import Policy
from sros_tool.runtime.log_texts import LOG_TEXTS, UNKNOWN, LogText
from sros_tool.runtime.zenoh_log import ZENOH_TEXTS
from tests.explain.broken import BREAKAGES, ENCLAVE, OTHER, Enclave, make_keystore
from tests.support.children import python, run
from tests.support.harness import Ended, copy_of, policy_text, publish, sros, subscribe
from tests.support.long_form import some

LOGS = Path(__file__).with_name("logs")
CYCLONE_LINE = "1795242829.914522 [0]     recvUC: "
_HANDSHAKE = f"{CYCLONE_LINE}Process handshake failed: Certificate not valid: error: "
FAST_LINE = "2026-01-01 12:00:00.000 [SECURITY Error] "
NEXT = f"\n{' ' * 12}"
"""Between two alternatives of a remedy, each of which begins a line."""
FILE_LINE = "[1795309573.65] [EMERGENCY] 01.0f.78|0.0.1.c1 0 "
FAST, FAST_14, CYCLONE = "fastdds_2.9.1", "fastdds_2.14.5", "cyclone_0.10.2"
FAST_3 = "fastdds_3.6.2"

CAUSES = {
    "certificate expired": ("cert.pem: it expired",),
    "certificate not yet valid": ("cert.pem: it is not valid before",),
    "certificate of another CA": ("cert.pem: it was not issued by the identity CA",),
    "certificate garbage": ("cert.pem: it is not a PEM certificate",),
    "revoked": ("cert.pem: it is revoked",),
    "crl expired": ("crl.pem: it expired",),
    "crl garbage": ("crl.pem: it is not a revocation list",),
    "ca expired": ("identity_ca.cert.pem: it expired",),
    "key of another enclave": ("key.pem: it is not the key of cert.pem",),
    "key garbage": ("key.pem: it has no line '-----BEGIN PRIVATE KEY-----'",),
    "key encrypted": ("key.pem: ",),
    "governance tampered": ("governance.p7s: its signature does not match",),
    "permissions tampered": ("permissions.p7s: its signature does not match",),
    "permissions of another CA": ("permissions.p7s: it is signed by CN=a foreign CA",),
    "governance unsigned": ("governance.p7s: it is not an S/MIME",),
    "permissions unsigned": ("permissions.p7s: it is not an S/MIME",),
    "permissions expired": ("expired at",),
    "permissions not yet valid": ("is valid only from",),
    "permissions of another enclave": ("no grant of the permissions names the subject",),
    "domain not in governance": ("the governance does not list domain 0",),
    "permissions malformed": ("refuses the permissions",),
    "permissions without default": ("refuses the permissions",),
    "governance malformed": ("refuses the governance",),
    "file missing": ("permissions.p7s: missing",),
    "link to nothing": ("identity_ca.cert.pem: it is a broken link",),
    "file empty": ("key.pem: it is empty",),
}
"""What `explain --log` is to find in an enclave with each breakage."""

SILENT_ON_CYCLONE = {
    "key of another enclave",  # it joins, and its peers log
    "permissions without default",  # it accepts them
    "file missing",  # our binding sees it first
    "link to nothing",
}


def nothing(_: str) -> None:
    return None


def explained(text: str) -> tuple[LogFinding, ...]:
    return explain_log(text, nothing, lambda _: pytest.fail("nothing is there to be looked at"))


def said_of(text: str, folder: Path, *asked: object, **more: Any) -> Ended:
    """What `sros explain` says about a log with this text, asked in a folder."""
    (log := folder / "robot.log").write_text(text)
    return sros("explain", *asked, "--log", log, **more)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A keystore in which nothing is broken; only to be copied."""
    return make_keystore(tmp_path_factory.mktemp("whole") / "ks", datetime.now(UTC))


@pytest.fixture
def keystore(whole: Path, tmp_path: Path) -> Path:
    return copy_of(whole, tmp_path / "ks")


def log_of(vendor: str, breakage: str) -> Path:
    return LOGS / f"{vendor}.{breakage.replace(' ', '_')}.log"


def recorded() -> list[tuple[str, Path]]:
    """Every breakage with each log of it; of Fast DDS 2.14 also ROS_SECURITY_LOG_FILE's."""
    return [
        (breakage, path)
        for breakage in BREAKAGES
        for vendor in (FAST, FAST_14, CYCLONE)
        for path in (log_of(vendor, breakage), log_of(vendor, f"{breakage}.security"))
        if path.exists()
    ]


def one_of_each(logs: list[tuple[str, Path]]) -> list[tuple[str, Path]]:
    """Return one log of each breakage, drawn anew in every run; in the long form all."""
    by_breakage = groupby(logs, lambda log: log[0])
    return [log for _, of_one in by_breakage for log in some([*of_one], 1)]


def test_every_breakage_has_a_cause_and_its_logs() -> None:
    assert set(CAUSES) == set(BREAKAGES)
    for name in BREAKAGES:
        assert log_of(FAST, name).exists(), name
        assert log_of(FAST_14, name).exists(), name
        assert log_of(CYCLONE, name).exists() == (name not in SILENT_ON_CYCLONE), name


@pytest.mark.parametrize("breakage", BREAKAGES)
def test_logs_of_fast_dds_3_mean_what_those_of_2_14_mean(breakage: str) -> None:
    of_2, of_3 = (explained(log_of(vendor, breakage).read_text()) for vendor in (FAST_14, FAST_3))
    if breakage in ("file missing", "link to nothing"):
        assert "does not say which" in of_2[0].cause
        assert "/robot/keystore/enclaves/talker_listener/talker/" in of_3[0].cause
    else:
        assert of_2[0].cause == of_3[0].cause


@pytest.mark.parametrize(
    ("breakage", "log"), one_of_each(recorded()), ids=lambda each: getattr(each, "name", each)
)
def test_the_true_cause_is_found_in_the_enclave(breakage: str, log: Path, keystore: Path) -> None:
    asked = ("explain", keystore, ENCLAVE, "--log", log, "--domain", "0")
    whole = sros(*asked)
    assert whole.status == 1
    if log in (
        log_of(FAST, "domain not in governance"),
        log_of(FAST_14, "domain not in governance"),
    ):
        assert "the governance is for domain 0: the process was in " in whole.out
    else:
        assert "\n  found " not in whole.out
        assert "has no fault that would explain the message" in whole.out
    BREAKAGES[breakage](Enclave(keystore))
    broken = sros(*asked)
    assert broken.status == 1
    for cause in CAUSES[breakage]:
        assert cause in broken.out, broken.out
    assert "Finish replacing" not in broken.out
    assert "Fast DDS 2.9 does not say why" not in broken.out
    assert "Traceback" not in broken.err


@pytest.mark.parametrize("breakage", some([*BREAKAGES], 3))
def test_the_remedy_runs_and_mends_it(breakage: str, keystore: Path) -> None:
    BREAKAGES[breakage](Enclave(keystore))
    asked = ("explain", keystore, ENCLAVE, "--log", log_of(FAST_14, breakage), "--domain", "0")
    remedies = [line for line in sros(*asked).out.splitlines() if "  remedy " in line]
    commands = re.findall("`(.+?)`", " ".join(remedies))
    assert commands, remedies
    policy = policies_dir() / "talker_listener.xml"
    command = commands[0].replace("POLICY", str(policy))
    in_shell(command)
    after = sros(*asked).out
    assert "has no fault" in after or "the governance is for domain 0: the process" in after, after


def in_shell(command: str) -> None:
    """Run commands of a shell, in which sros is the program under test."""
    for part in command.split(" && "):
        words = shlex.split(part)
        if words[0] == "sros":
            assert shlex.join(words) == part, "a shell would do more with it"
            sros(*words[1:]).ok()
        else:
            run(["sh", "-c", part])


def own_keystore(keystore: Path) -> None:
    """Make the governance of the keystore itself plain XML."""
    document = Enclave(keystore).document("governance")
    (keystore / "enclaves/governance.p7s").write_bytes(document)


def test_a_governance_as_plain_xml_is_not_mended_by_permissions(keystore: Path) -> None:
    own_keystore(keystore)
    asked = ("explain", keystore, ENCLAVE, "--log", log_of(FAST_14, "governance unsigned"))
    found = sros(*asked).out
    assert "create_permission" not in found
    command = re.findall("`(openssl .+?)`", found)[0]
    in_shell(command)
    assert "has no fault that would explain the message" in sros(*asked).out


def test_the_remedy_for_a_ca_that_expired_does_not_presume_a_rotation(tmp_path: Path) -> None:
    keystore = make_keystore(tmp_path / "ks", datetime.now(UTC) - timedelta(days=3700))
    asked = ("explain", keystore, ENCLAVE, "--log", log_of(FAST_14, "ca expired"))
    found = sros(*asked).out
    assert "identity_ca.cert.pem: it expired" in found
    command = re.findall("`(sros rotate_ca .+?)`", found)[0]
    in_shell(command)
    assert "has no fault that would explain the message" in sros(*asked).out


def test_during_a_rotation_the_remedy_is_its_next_stage(keystore: Path) -> None:
    sros("rotate_ca", keystore, "--next").ok()
    BREAKAGES["certificate of another CA"](Enclave(keystore))
    asked = ("explain", keystore, ENCLAVE, "--log", log_of(FAST_14, "certificate of another CA"))
    assert f"sros rotate_ca {keystore} --next" in sros(*asked).out


def test_a_remedy_on_a_robot_is_for_the_keystore_at_home(keystore: Path) -> None:
    BREAKAGES["permissions expired"](Enclave(keystore))
    shutil.rmtree(keystore / "private")
    (keystore / "ledger.jsonl").unlink()
    log = log_of(FAST_14, "permissions expired")
    found = sros("explain", keystore, ENCLAVE, "--log", log).out
    assert (
        f"In the keystore that has the CA keys: Renew the enclave: `sros renew KEYSTORE {ENCLAVE}`"
    ) in found


def test_a_remedy_that_ends_on_the_robot_is_not_for_the_keystore_alone(keystore: Path) -> None:
    shutil.rmtree(keystore / "private")
    (keystore / "ledger.jsonl").unlink()
    log = keystore.with_name("log")
    log.write_text("Unable to run the command: a process cannot run in enclave /a. It expired\n")
    found = sros("explain", keystore, "--log", log).out
    assert "  Repair what the line names (if a file expired: `sros renew KEYSTORE " in found
    assert ", and start the process again. KEYSTORE is the keystore that has the CA keys." in found


def test_a_clock_is_set_on_the_robot_and_not_at_home(keystore: Path) -> None:
    BREAKAGES["permissions not yet valid"](Enclave(keystore))
    shutil.rmtree(keystore / "private")
    (keystore / "ledger.jsonl").unlink()
    log = log_of(FAST_14, "permissions not yet valid")
    found = sros("explain", keystore, ENCLAVE, "--log", log).out
    verified = sros("verify", keystore).out
    for said in (found, verified):
        assert (
            "Set the clock of this host; if the clock is right, renew the enclave in the keystore "
            f"that has the CA keys: `sros renew KEYSTORE {ENCLAVE}`. Then export the enclave again."
            in said
        )
        assert "CA keys: Set the clock" not in said


@pytest.mark.dds
@pytest.mark.parametrize(
    "breakage", some([name for name in BREAKAGES if name not in SILENT_ON_CYCLONE], 2)
)
def test_what_cyclone_says_now(breakage: str, keystore: Path, tmp_path: Path) -> None:
    """The very log of a process that could not start, as Cyclone DDS prints it here."""
    program = Path(__file__).with_name("join_cyclone.py")
    enclave = Enclave(keystore)
    BREAKAGES[breakage](enclave)
    done = python(program, enclave.folder, status=1)
    log = tmp_path / "robot.log"
    log.write_text(done.stdout + done.stderr)
    found = sros("explain", keystore, ENCLAVE, "--log", log, "--domain", "0")
    for cause in CAUSES[breakage]:
        assert cause in found.out, (found, done.stderr)


@pytest.mark.dds
def test_cyclone_says_nothing_of_a_whole_enclave(keystore: Path, tmp_path: Path) -> None:
    program = Path(__file__).with_name("join_cyclone.py")
    done = python(program, Enclave(keystore).folder)
    assert done.stdout == "joined\n", done
    ended = said_of(done.stdout + done.stderr, tmp_path, keystore, ENCLAVE)
    assert ended.out.startswith("no line of the log says that a node runs secured")


# ── texts ──────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("file", "ids"),
    [
        ("rclpy.not_built_in.log", ["not-built-in"]),
        ("rclpy.no_enclave.log", ["enclave-missing"]),
        ("rclpy.permissive.log", ["runs-unsecured"]),
        ("rclpy.unset_keystore.log", ["keystore-unset"]),
        ("rclpy.no_enclave_named.log", ["no-enclave"]),
        ("rclpy.permissive_no_enclave_named.log", ["runs-open"]),
        ("fastdds_2.14.5.node_of_another_enclave.log", ["topic-denied"]),
        ("fastdds_2.14.5.peer_after_stage_2.log", ["peer-signature"]),
        ("fastdds_2.14.5.peer_expired.log", ["peer-permissions"]),
        ("cyclone_0.10.2.peer_after_stage_2.log", ["peer-signature"]),
        ("cyclone_0.10.2.peer_expired.log", ["peer-permissions"]),
        ("cyclone_0.10.2.peer_another_ca_2.log", ["peer-refused"]),
        ("cyclone_0.10.2.peer_key_mismatch_1.log", ["peer-handshake"]),
        ("fastdds_2.9.1.working.log", ["topic-denied", "topic-denied"]),
        ("fastdds_2.9.1.domain_not_in_governance.log", ["domain"]),
        ("fastdds_2.9.1.key_without_its_token.log", ["token"]),
        ("fastdds_2.9.1.permissions_expired.log", ["participant"]),
        ("fastdds_2.9.1.permissions_without_default.log", ["malformed"]),
        ("fastdds_2.9.1.revoked.log", ["identity"]),
        ("fastdds_2.14.5.governance_unsigned.log", ["not-signed"]),
        ("fastdds_2.14.5.governance_unreadable.log", ["file-missing"]),
        ("fastdds_2.14.5.permissions_expired.log", ["grant"]),
        ("fastdds_2.14.5.permissions_of_another_CA.log", ["signature"]),
        ("fastdds_2.14.5.revoked.log", ["identity"]),
        ("fastdds_2.14.5.revoked.security.log", ["identity"]),
        ("fastdds_2.14.5.ca_expired.security.log", ["ca"]),
        ("fastdds_2.14.5.domain_not_in_governance.security.log", ["domain"]),
        ("fastdds_2.14.5.reason_elsewhere.log", ["participant"]),
        ("fastdds_2.14.5.node_name_differs.log", ["topic-denied"]),
        ("fastdds_2.14.5.node_name_differs.security.log", ["topic-denied"]),
        ("fastdds_2.14.5.peer_of_another_permissions_CA.log", ["peer-permissions-ca"]),
        ("fastdds_2.14.5.peer_of_a_CA_of_the_same_name.log", ["peer-signature"]),
        ("fastdds_2.14.5.peer_permissions_expired.log", ["peer-permissions"]),
        ("fastdds_2.14.5.peer_of_another_domain.log", ["peer-domain"]),
        ("fastdds_2.14.5.permissions_ca_der.log", ["participant"]),
        ("fastdds_2.14.5.permissions_ca_der.security.log", ["participant"]),
        ("fastdds_2.14.5.certificate_der.security.log", ["identity"]),
        ("cyclone_0.10.2.certificate_der.log", ["pem-unreadable"]),
        ("cyclone_0.10.2.permissions_ca_der.log", ["pem-unreadable"]),
        ("cyclone_0.10.2.plugin_missing.log", ["plugin"]),
        ("cyclone_0.10.2.crypto_plugin_missing.log", ["plugin"]),
        ("cyclone_0.10.2.plugin_without_init.log", ["plugin"]),
        ("cyclone_0.10.2.property_missing.log", ["property"]),
        ("cyclone_0.10.2.peer_of_another_governance.log", ["peer-governance"]),
        ("cyclone_0.10.2.peer_of_other_data_protection.log", ["peer-governance"]),
        ("cyclone_0.10.2.key_encrypted.log", ["key-encrypted"]),
        ("cyclone_0.10.2.governance_tampered.log", ["signature"]),
    ],
)
def test_without_a_keystore(file: str, ids: list[str]) -> None:
    assert [each.id for each in explained((LOGS / file).read_text())] == ids


@pytest.mark.parametrize(
    "line",
    [
        f"{FAST_LINE}OpenSSL library cannot read file %s",
        f"{FAST_LINE}Cannot read file file://%s",
        f"{CYCLONE_LINE}File could not be found, opened or is empty, path: %s",
    ],
)
def test_a_file_that_only_the_user_of_the_node_cannot_read_is_the_first_suspect(
    line: str, keystore: Path, tmp_path: Path
) -> None:
    key = Enclave(keystore).folder / "key.pem"
    ended = said_of(line % key, tmp_path, keystore, ENCLAVE)
    assert "  remedy    Allow the user of the node to read the file" in ended.out
    assert f"can be read. Enclave {ENCLAVE} now has no fault" in ended.out


@pytest.mark.parametrize(
    "line",
    [
        "config: Domain/SSL/CertificateVerification/#text: true {}",
        "validate_local_identity: candidate_guid: 1:2:3:1c1 adjusted_guid: 8:9:d:1c1",
        'PARTICIPANT 8:9:d:1c1 QOS={user_data=10<"enclave=/;">,property_list={0:"dds.sec.auth"}}',
        "SPDP ST3 8:9:d:1c1 unknown not allowed",
        "cleanup participant 8:9:d:1c1 security attributes",
        "send crypto tokens(8:9:d:ff0202c3 --> f:1:4:ff0202c4)",
        " set participant tokens src(d:d:e:1c1) dst(f:5:7:1c1)",
        "set_remote_writer_crypto_tokens d:d:e:ff0101c2 with reader f:5:7:ff0101c7",
        "match_remote_reader d:d:e:c2 with writer f:5:7:c7: tokens available",
        "match_remote_reader: proxypp_crypto=14 wr_crypto=94 prd_crypto=14",
        "connect_proxy_writer_with_reader (pwr f:1:4:c2) with (rd 8:9:d:c7) waiting for approval "
        "by security",
    ],
)
def test_a_trace_of_success_is_no_trouble(line: str) -> None:
    assert not explained(f"1795877133.730803 [43] python: {line}")


def test_lines_that_are_not_understood_are_one_finding_after_the_known_ones() -> None:
    unknown = [f"{CYCLONE_LINE}token {word} 1:2" for word in ("lost", "late", "lost")]
    known = f"{CYCLONE_LINE}Non secure remote writer 1:2:3:403 is not allowed."
    first, last = explained("\n".join((*unknown, known)))
    assert (first.id, last.id, last.line, last.count) == ("peer-unsecured", UNKNOWN.id, 1, 3)
    assert last.cause == "2 different lines of DDS Security that sros does not know: lines 1, 2"


@pytest.mark.parametrize("text", [*LOG_TEXTS, *ZENOH_TEXTS], ids=lambda text: text.id)
def test_what_a_peer_needs_is_not_advised_for_the_enclave_that_logged_it(text: LogText) -> None:
    of_peer = text.id.startswith("peer-") or "PEER was" in text.cause
    assert not (of_peer and re.search(r"\bENCLAVE\b", text.remedy))


def test_a_peer_without_security_is_to_be_started_in_an_enclave_of_its_own(
    keystore: Path, tmp_path: Path
) -> None:
    line = f"{CYCLONE_LINE}Non secure remote writer 1:2:3:4 is not allowed"
    said = said_of(line, tmp_path, keystore, ENCLAVE).out
    assert f"Start the peer in its enclave: `sros run {keystore} PEER -- COMMAND`." in said


@pytest.mark.parametrize(
    ("line", "name"),
    [
        ("couldn't find all security files!", "files-missing"),
        ("[SECURITY Error] PKCS7 data verification failed -> Function load", "signature"),
        ("[SECURITY Error] Input data has not PKCS7 S/MIME format", "not-signed"),
        ("[SECURITY Error] Not found the identity subject name in permissions file.", "grant"),
        ("Not found a rule allowing to use the domain_id", "domain-of-permissions"),
        ("Error '10' verifying CA certificate", "ca"),
        ("[SECURITY Error] Malformed permissions file", "malformed"),
        ("File could not be found, opened or is empty, path: /k/a.pem(code: 117)", "file-missing"),
        ("partition not found in rule", "partition"),
        ("[RTPS_EDP Error] Security manager returns an error for writer bd.e6.f5.35|0.0.13.3 -> "
         "Function operator()", "peer-governance"),
        ("RuntimeError: filesystem error: status: Permission denied [/k/enclaves/a/governance.p7s]",
         "file-unreadable"),
        ("rclpy._rclpy_pybind11.RCLError: Failed to create subscription: invalid allocator",
         "endpoint"),
        ("[INFO] [1.2] [rmw_cyclonedds_cpp]: could not find all security files", "files-missing"),
        ("ValueError: Failed to create action server: failed to create writer", "endpoint"),
        ("ValueError: Failed to create action client: rcl node is invalid", "service"),
    ],
)  # fmt: skip
def test_single_lines(line: str, name: str) -> None:
    (found,) = explained(f"before\n\x1b[31m{line}\x1b[0m\nafter")
    assert (found.id, found.line, found.count) == (name, 2, 1)
    assert found.cause and found.remedy and "\x1b" not in found.text


def test_what_rmw_cyclonedds_does_without_a_file_depends_on_the_strategy() -> None:
    """As it did with rclpy on Cyclone DDS 0.10.5, with Enforce and with Permissive."""
    (found,) = explained("[INFO] [1.2] [rmw_cyclonedds_cpp]: could not find all security files")
    assert "=Enforce, no node starts; with any other value, the node RUNS UNSECURED" in found.cause


@pytest.mark.parametrize(
    "line",
    [
        "2026-01-01 12:00:00.000 [SECURITY Error] Cannot find the local writer 01.0f|0.0.1.c1",
        "2026-01-01 12:00:00.000 [RTPS_SECURITY Error] Bad thing -> Function set",
        "[1795309573.65] [INFORMATIONAL] 01.0f|0.0.1.c1 0 SecurityManager::init : Bad thing",
        "[1795309573.65] [EMERGENCY] 01.0f|0.0.1.c1 0 PKIDH::begin_handshake_request : Bad thing",
        "talker-1  | 1795242829.9 [0] python: Bad handshake",
        "1795242829.9 [0] python: Remote permissions could not be decoded by the security plugin",
        "1795242829.9 [0] recvUC: Something of the Authentication plugin",
        "1795242829.9 [0] dq.builtin: Access Control says no",
        "1795242829.9 [0] recv: encoded submessage from a stranger",
        "rclpy.RCLError: error creating node: SECURITY ERROR: something new",
        "[ERROR] [1.0] [rmw_fastrtps_cpp]: failed to load identity_ca.cert.pem",
        "[talker-1] [WARN] [1.0] [rmw_cyclonedds_cpp]: invalid security file governance.p7s",
        "  what():  could not read permissions.p7s",
        "  what():  failed to use the enclave",
        "[ERROR] [1.0] [rclcpp_lifecycle]: failed with the security of the node",
        "robot | Expecting: TRUSTED CERTIFICATE",
        "Nov 21 06:00:00 robot talker[12]: X509 certificate rejected",
        "2026-01-01 12:00:00.000 [SECURITY Error] Not found the identity subj",
    ],
)
def test_what_is_not_understood_is_shown(line: str, tmp_path: Path) -> None:
    (found,) = explained(f"before\n{line}\n{line}\nafter")
    assert (found.id, found.line, found.count) == ("not-understood", 2, 2)
    both = f"{line}\n[SECURITY Error] PKCS7 data verification failed -> Function init\n"
    assert [each.id for each in explained(both)] == ["signature", "not-understood"]
    said = said_of(line, tmp_path)
    assert said.status == 1 and " ".join(line.split())[-20:] in said.out


@pytest.mark.parametrize(
    ("text", "name"),
    [
        (f"{_HANDSHAKE}certificate revoked; subject: /CN=\\/a(code: 200)", "peer-revoked"),
        (f"{_HANDSHAKE}certificate has expired; subject: /CN=\\/a(code: 200)", "peer-expired"),
        (f"{_HANDSHAKE}certificate is not yet valid; subject: /CN=a(code: 2)", "peer-expired"),
        (f"{CYCLONE_LINE}Could not load Access Control plugin.", "plugin"),
        (f"{CYCLONE_LINE}Could not load Cryptographic library", "plugin"),
        (f"{CYCLONE_LINE}Could not load security", "plugin"),
        (f"{CYCLONE_LINE}Could not find the function: init_crypto", "plugin"),
        (f"{CYCLONE_LINE}Error occurred while initializing Authentication plugin", "plugin"),
        (f"{CYCLONE_LINE}Authentication security plugin library path is undefined", "plugin"),
        (f"{CYCLONE_LINE}Non secure remote writer 1:2:3:403 is not allowed.", "peer-unsecured"),
        (f"{CYCLONE_LINE}downgrade participant 1:2:3:1c1 to non-secure", "peer-unsecured"),
        (
            f"{CYCLONE_LINE}received encoded rtps message from unauthenticated participant",
            "peer-unsecured",
        ),
        (f"{CYCLONE_LINE}Remote secure participant 1:2:3:1c1 not allowed", "peer-refused"),
        (f"{CYCLONE_LINE}Plugin does not allow remote participant 1:2:3:1c1", "peer-refused"),
        (
            f"{CYCLONE_LINE}Could not get remote participant 1:2:3:1c1 permissions from plugin",
            "peer-refused",
        ),
        (
            f"{CYCLONE_LINE}handshake (lguid=1:2:3:1c1 rguid=2:3:4:1c1) failed: (10) Timed out",
            "peer-handshake",
        ),
        (
            f"{CYCLONE_LINE}match_remote_writer 1:2:3:403 with reader 1:2:3:504 "
            "security_attributes mismatch: 0x8000007f.0x80000003 - 0x8000004f.0x80000001",
            "peer-governance",
        ),
        ("RCLError: rmw_create_node: failed to create domain, error Error", "participant"),
        (f"{FILE_LINE}SecurityManager::init : ", "participant"),
        (f"{FILE_LINE}SecurityManager::init : Cryptography plugin not configured", "participant"),
        (
            f"{FILE_LINE}PKIDH::validate_local_identity : Error verifying private key",
            "key-mismatch",
        ),
        (
            f"{FILE_LINE}AccessControl::validate_remote_permissions : Remote participant "
            "PermissionsCA differs from local",
            "peer-permissions-ca",
        ),
        (f"{FAST_LINE}Remote participant PermissionsCA differs from local", "peer-permissions-ca"),
        (
            "[SECURITY Info] Authentication plugin not configured. Security will be disabled",
            "plugin-unset",
        ),
        ("[SECURITY_CRYPTO Error] Invalid CryptoToken -> Function set_tokens", "crypto"),
        (f"{FAST_LINE}Malformed CryptoTokenSequence", "crypto"),
        (
            f"{FAST_LINE}Cannot find local reader 01.0f.78|0.0.1c.7 -> Function "
            "encode_reader_submessage",
            "endpoint-gone",
        ),
        (
            f"{CYCLONE_LINE}Could not get remote participant 1:2:3:1c1 permissions from plugin: "
            "Subject name is invalid(code: 146)",
            "peer-refused",
        ),
        (f"{FAST_LINE}Error in fastcdr trying to deserialize SecureDataHeader", "crypto"),
        (
            "[SECURITY_CRYPTO Warning] Unable to decode the payload. EVP_DecryptFinal function "
            "returns an error",
            "crypto",
        ),
        (
            "rcl: SECURITY ERROR: directory '/k/enclaves/enclaves/a' does not exist",
            "keystore-inside",
        ),
        (
            "SECURITY ERROR: unable to find a folder matching the name '/x' in '/ks/enclaves'.",
            "enclave-missing",
        ),
        (
            "Unable to run the command: a process cannot run in enclave /a. cert.pem: it expired",
            "not-started",
        ),
        # Broken in two, by a terminal or by a log that cuts long lines.
        (f"{FAST_LINE}Not found the identity subj\nect name in permissions file. CN=/t", "grant"),
        (f"{FAST_LINE}Not found the identity\nsubject name in permissions file. CN=/t", "grant"),
        (f"{CYCLONE_LINE}Certificate not\nvalid: error: certificate revoked", "revoked"),
        (f"a-1 | {FAST_LINE}PKCS7 data verifi\na-1 | cation failed", "signature"),
        (f"{CYCLONE_LINE}Permissions validity period exp\nired", "permissions-expired"),
        (f"{FILE_LINE}PKIDH::init : Error obtaining private\n key /k/key.pem", "key-unreadable"),
    ],
)
def test_every_shape_has_its_cause_and_a_remedy(text: str, name: str, tmp_path: Path) -> None:
    (found,) = explained(f"before\n{text}\nafter")
    assert (found.id, found.line) == (name, 2)
    assert found.cause and found.remedy
    assert said_of(text, tmp_path).status == 1


@pytest.mark.parametrize(
    "line",
    [
        "[ERROR] [launch]: Could not find a package called security_tools",
        "[launch] [ERROR] Access control list loaded",
        "[ERROR] [1.0] [door]: access control denied a visitor, the certificate is missing",
        "Error: insufficient permissions to open /dev/ttyUSB0",
        "crypto wallet not found in the keystore",
    ],
)
def test_a_bare_word_of_another_program_is_no_message_of_dds_security(line: str) -> None:
    assert explained(line) == ()
    (found,) = explained(f"{line}: [rmw_fastrtps_cpp] failed")  # the middleware says it
    assert found.id == "not-understood"


@pytest.mark.parametrize(
    ("line", "vendor"),
    [
        ("2026-01-01 12:00:00.000 [SECURITY Error] Bad thing -> Function set", Vendor.FAST),
        ("talker-1  | [RTPS_SECURITY Error] Bad thing -> Function set", Vendor.FAST),
        ("[1795309573.65] [EMERGENCY] 01.0f|0.0.1.c1 0 PKIDH::init : Bad thing", Vendor.FAST),
        ("1795242829.9 [0] python: Bad handshake", Vendor.CYCLONE),
        ("[ERROR] [1.0] [rmw_fastrtps_cpp]: failed to load identity_ca.cert.pem", None),
    ],
)
def test_an_unknown_line_has_the_vendor_of_its_form(line: str, vendor: Vendor | None) -> None:
    (found,) = explained(line)
    assert (found.id, found.vendor) == ("not-understood", vendor)


def test_a_remedy_names_the_keystore_and_the_enclave_that_the_user_named(
    keystore: Path, tmp_path: Path
) -> None:
    (tmp_path / "robot.log").write_text("[SECURITY Error] Bad thing -> Function set\n")
    named = sros("explain", keystore, ENCLAVE, "--log", tmp_path / "robot.log").out
    assert f"`sros explain {keystore} {ENCLAVE} join`" in named
    assert "KEYSTORE" not in named and " ENCLAVE" not in named
    (tmp_path / "denied.log").write_text(
        "1795242829.9 [0] python: Local topic permission denied: rt/x denied by default rule\n"
    )
    denied = sros("explain", keystore, ENCLAVE, "--log", tmp_path / "denied.log").out
    assert f"`sros explain {keystore} {ENCLAVE} publish /x`" in denied
    unnamed = sros("explain", "--log", tmp_path / "robot.log").out
    assert "`sros explain KEYSTORE ENCLAVE join`" in unnamed
    started = "[INFO] [1.0] [rcl]: Found security directory: /robot/keystore/enclaves/a/b\n"
    of_log = said_of(f"{started}[SECURITY Error] Bad thing -> Function set\n", tmp_path).out
    assert "`sros explain KEYSTORE /a/b join`" in of_log
    of_folder = sros("explain", f"{keystore}/enclaves{ENCLAVE}", "--log", tmp_path / "denied.log")
    assert f"`sros explain KEYSTORE {ENCLAVE} publish /x`" in of_folder.out
    line = f"filesystem error: status: Permission denied [{keystore}/enclaves/a/governance.p7s]"
    (tmp_path / "user.log").write_text(f"RuntimeError: {line}\n")
    unreadable = sros("explain", keystore, ENCLAVE, "--log", tmp_path / "user.log").out
    assert f"is not allowed to read {keystore}/enclaves/a/governance.p7s" in unreadable
    assert f"As the user that runs the node, run `sros check {keystore}`" in unreadable


def test_tests_of_declared_keys_are_not_called_nothing(tmp_path: Path) -> None:
    # Lines of a router on Zenoh 1.10.2 that dropped a subscription: none says which message it was.
    module = (
        "\x1b[35mTRACE\x1b[0m rx-0 ThreadId(10) "
        "\x1b[2mzenoh::net::routing::interceptor::access_control\x1b[0m\x1b[2m:\x1b[0m "
    )
    where = "(ingress) on 0/cmd_vel/t/h"
    (tmp_path / "router.log").write_text(
        f"{module}ACL (ingress): caching permissions for `0/cmd_vel/t/h` ...\n"
        f"{module}ef on Interface(lo)+CertCommonName(/listener)+Transport(Tls)+ef is unauthorized "
        f"to Declare/Undeclare Subscriber {where}\n"
    )
    ended = sros("explain", "--log", tmp_path / "router.log").ok()
    assert "this does not show which message was dropped" in ended.err
    (tmp_path / "other.log").write_text("one\n")
    assert (
        "how Zenoh tested declared names"
        not in sros("explain", "--log", tmp_path / "other.log").ok().err
    )


def test_a_line_that_follows_an_unknown_one_is_not_swallowed() -> None:
    unknown, known = f"{FAST_LINE}Something new", f"{FAST_LINE}PKCS7 data verification failed"
    assert [each.id for each in explained(f"{unknown}\n{known}\n{unknown}")] == [
        "signature", "not-understood",
    ]  # fmt: skip
    other = f"a-1 | {FAST_LINE}PKCS7 data verifi\nb-1 | cation failed"
    assert [each.id for each in explained(other)] == ["not-understood"]


def test_nothing_found_is_said_of_what_was_read(tmp_path: Path) -> None:
    none = "no message of DDS Security, and no denial by Zenoh, in"
    for text, said in (
        ("", "the log is empty: it shows nothing about its node."),
        ("one\ntwo\n", f"{none} 2 lines, and no line 'Found security directory'\n"),
        ("one", f"{none} 1 line, and no line 'Found security directory'\n"),
    ):
        ended = said_of(text, tmp_path).ok()
        assert ended.err.startswith(said)
    assert "\nnot shown: whether a node runs open (`sros check runtime` on its machi" in ended.err
    assert "denials on Zenoh, because a log has them only with RUST_LOG=zenoh=trace" in ended.err
    variables = {"RMW_IMPLEMENTATION": "rmw_zenoh_cpp"}
    on_zenoh = sros("explain", "--log", tmp_path / "robot.log", env=variables)
    assert "in 1 line\nnot shown: whether a node runs open (`sros check" in on_zenoh.ok().err
    for found in ("[INFO] [1.0] [rcl]: Found", "[talker]"):  # rcl, and a node of `sros demo`
        line = f"{found} security directory: /k/enclaves/talker\n"
        ended = said_of(line, tmp_path).ok()
        first, second, third = ended.err.splitlines()
        said = f"{none} 1 line; the log says that a node found its enclave '/k/enclaves/talker'"
        assert first == said
        assert second.startswith("not shown: whether peers drop the node's messages (explain the")
        assert "`sros check FOLDER OTHER`" in second
        assert len(second) < 200
        assert third.startswith("note [log.only-text]: a process can print any line, true or false")
        assert "this log does not prove that its node runs secured. An open listener" in third


STARTED = "[INFO] [1.0] [rcl]: Found security directory: {}/enclaves{}\n"
OF_ZENOH = "2027-01-01T00:00:00Z DEBUG ThreadId(01) zenoh::net::runtime: Zenoh Rust API v1.10.2\n"


def test_a_log_of_an_enclave_has_to_show_that_its_node_runs_secured(
    keystore: Path, tmp_path: Path
) -> None:
    log, policy = tmp_path / "robot.log", policies_dir() / "talker_listener.xml"
    node = "[INFO] [1.0] [talker]: up\n"
    own, folder = STARTED.format(keystore, ENCLAVE), f"{keystore}/enclaves{ENCLAVE}"
    moved = STARTED.format("/k", f"/left{ENCLAVE}")
    zenoh = {"RMW_IMPLEMENTATION": "rmw_zenoh_cpp"}
    dds = {"RMW_IMPLEMENTATION": "rmw_fastrtps_cpp"}
    # A keystore for DDS and Zenoh, whose node runs open on DDS.
    (Path(folder) / "session.json5").write_text("{}")
    quoted = own.replace("[rcl]: ", "[talker]: I heard: [").replace("\n", " ]\n")
    (tmp_path / "loop").symlink_to("loop")
    for asked, text, variables, secured in (
        ([keystore, ENCLAVE], own + node, {}, True),
        ([keystore, ENCLAVE], node, {}, False),
        ([keystore, ENCLAVE], "", {}, False),
        ([keystore, ENCLAVE], STARTED.format(keystore, "/other") + node, {}, False),
        ([keystore, ENCLAVE], f"Nov 21 06:00:00 r d[1]: r-1 | [r-1] {own}", {}, True),
        ([keystore, ENCLAVE], STARTED.format(tmp_path / "loop", ENCLAVE), {}, True),
        ([keystore, ENCLAVE], quoted, {}, False),
        ([keystore, ENCLAVE], own.replace("[rcl]", "[talker]"), {}, False),
        ([keystore, ENCLAVE], own.replace("[rcl]", "[talker]: x[1]"), {}, False),
        ([keystore, ENCLAVE], f"x\r{own}", {}, False),
        ([keystore, ENCLAVE], STARTED.format("/a/.." * 10**6, ENCLAVE), {}, False),
        ([keystore, ENCLAVE], own.replace("\n", "\0\n"), {}, False),
        ([folder], own + node, {}, True),
        ([folder], node, {}, False),
        ([policy, ENCLAVE], moved + node, {}, True),
        ([policy, f"/left{ENCLAVE}"], moved + node, {}, True),
        ([policy, f"/right{ENCLAVE}"], moved + node, {}, False),
        ([policy, ENCLAVE], node, {}, False),
        ([keystore, ENCLAVE], node, zenoh, None),
        ([keystore, ENCLAVE], OF_ZENOH + node, {}, None),
        ([keystore, ENCLAVE], OF_ZENOH + node, dds, False),
        ([keystore, ENCLAVE], OF_ZENOH + STARTED.format(keystore, "/other") + node, {}, False),
        ([keystore, ENCLAVE], OF_ZENOH + own + node, {}, True),
        ([keystore, ENCLAVE], " \n", zenoh, False),
        ([keystore], node, {}, None),
    ):
        ended = said_of(text, tmp_path, *asked, env=variables)
        whole = sros("explain", *asked, "--log", log, "--json", env=variables)
        assert json.loads(whole.out)["secured"] is secured, (asked, text)
        assert ended.status == whole.status == (secured is False), (asked, text)
        said = "perhaps the node runs open" if text.strip() else "the log is empty"
        assert (said in ended.out) is (secured is False)
        named = "If the node uses rmw_zenoh, which logs no such line, set RMW_IMPLEMENTATION="
        assert (named in ended.out) is (bool(text.strip()) and not variables and secured is False)


def test_a_log_that_names_another_folder_is_said_to_do_so(keystore: Path, tmp_path: Path) -> None:
    ended = said_of(STARTED.format("/robot", ENCLAVE), tmp_path, keystore, ENCLAVE).ok()
    named = f"the log names another folder than {keystore}: /robot/enclaves{ENCLAVE}\n"
    assert ended.err.startswith(f"note [log.other-folder]: {named}")
    ended = said_of(STARTED.format(keystore, ENCLAVE), tmp_path, keystore, ENCLAVE).ok()
    assert "other-folder" not in ended.err


def test_what_the_nodes_of_the_demo_print_names_the_topic() -> None:
    for what, verb in (("topic", "use"), ("a writer on", "publish"), ("a reader on", "subscribe")):
        (found,) = explained(f"refused: cannot create {what} rt/chatter. Not Allowed By Security.")
        assert found.id == "topic-denied"
        assert f"may not {verb} /chatter" in found.cause, found.cause


def test_what_tells_more_counts() -> None:
    log = (
        "[SECURITY Error] rt/other topic not found in allow rule. -> Function "
        "check_create_datareader\nRCLError: invalid allocator\n"
    )
    assert [each.id for each in explained(log)] == ["topic-denied"]
    assert [each.id for each in explained("RCLError: invalid allocator\n")] == ["endpoint"]


def test_mixed_processes_are_told_apart() -> None:
    log = (
        "[a-1] [INFO] [1.0] [rcl]: Found security directory: /k/enclaves/robot/a\n"
        "[b-2] [INFO] [1.0] [rcl]: Found security directory: /k/enclaves/robot/b\n"
        "[b-2] [SECURITY Error]  -> Function validate_local_identity\n"
        "[a-1] RCLError: invalid allocator\n"
        "[b-2] [RTPS_PARTICIPANT Error] Cannot create participant due to initialization error\n"
        "[b-2] [SECURITY Error]  -> Function validate_local_identity\n"
    )
    assert [(each.id, each.enclave, each.line, each.count) for each in explained(log)] == [
        ("identity", "/robot/b", 3, 2),
        ("endpoint", "/robot/a", 4, 1),
    ]


@pytest.mark.parametrize(
    "text",
    [
        "",
        "all is well\n",
        "[INFO] [1.0] [talker]: the security of the building is checked\n",
        "Segmentation fault\n",
        "[INFO] [1.0] [web]: the TLS certificate was not found in the cache\n",
        f"{CYCLONE_LINE}DDS Security plugins have been loaded\n",
        f"{CYCLONE_LINE}handshake (lguid=1:2:3:1c1 rguid=2:3:4:1c1) succeeded\n",
        '    raise SrosError(f"cannot read the enclave {name}")\n',
        "[INFO] [1.0] [rcl]: Found security directory: /k",
    ],
)
def test_nothing_to_tell(text: str) -> None:
    assert explained(text) == ()


# ── domains and nodes ──────────────────────────────────────────────────────────────────────


def test_a_wrong_domain_is_told_without_the_option(keystore: Path) -> None:
    log = log_of(FAST_14, "domain not in governance")
    found = sros("explain", keystore, ENCLAVE, "--log", log, env={"ROS_DOMAIN_ID": None}).out
    assert "the governance is for domain 0: the process was in another domain" in found
    assert "Set ROS_DOMAIN_ID to a domain of the keystore, such as 0" in found
    assert "clock" not in found
    (command, _) = re.findall("`(sros .+?)`", found)
    in_shell(command.replace(" ID", " 0"))


def test_the_log_file_names_the_domain(keystore: Path, tmp_path: Path) -> None:
    text = log_of(FAST_14, "domain not in governance.security").read_text()
    (tmp_path / "log").write_text(text.replace("|0.0.1.c1 0 ", "|0.0.1.c1 42 "))
    found = sros("explain", keystore, ENCLAVE, "--log", tmp_path / "log").out
    assert "the process was in domain 42" in found


def merged_as_advised(found: str, name: str, folder: Path) -> Policy:
    """Return a package's policy with the node ``name``, merged by the command in ``found``."""
    enclaves = {"/e": publish("chatter"), "/other": publish("x")}
    other = policy_text(enclaves).replace('node="n"', f'node="{name}"', 1)
    (folder / "other.xml").write_text(other)
    (folder / "empty.xml").write_text('<policy version="0.2.0"><enclaves/></policy>')
    (options,) = re.findall("`sros merge_policy POLICY OTHER ([^`]*)`", found)
    renaming = re.search("; if the node is NAME in OTHER, write `([^`]*)`", found)
    if f"--node {name}" not in options:
        assert renaming
        options = re.sub("--node [^ ]+", renaming[1].replace("NAME", name), options)
    sros("merge_policy", "empty.xml", "other.xml", *options.split(), "-o", "m.xml", "--force",
         cwd=folder).ok()  # fmt: skip
    return read_policy(folder / "m.xml")


@pytest.mark.parametrize(
    ("log", "node"),
    [
        ("node_name_differs", "/foo"),
        ("node_name_differs.security", "/foo"),
        ("namespace_differs", "/hall/talker"),
    ],
)
def test_a_node_of_another_name_is_told(
    keystore: Path, log: str, node: str, tmp_path: Path
) -> None:
    path = LOGS / f"{FAST_14}.{log}.log"
    found = sros("explain", keystore, ENCLAVE, "--log", path).out
    assert f"the permissions are for the node /talker, and this is the node {node}" in found
    assert "`--ros-args -r __node:=talker -r __ns:=/`" in found
    assert f"in the policy of {ENCLAVE}, or in an enclave of its own" in found
    for name in ("foo", "talker") if node == "/foo" else ("talker",):
        assert merged_as_advised(found, name, tmp_path).nodes() == {ENCLAVE: (node,)}
    assert f"here it belongs to node {node}" in sros("explain", "--log", path).out


def test_one_of_several_nodes_is_renamed_alone(keystore: Path, tmp_path: Path) -> None:
    """A rule without the name of a node would rename all nodes of the process."""
    served = "".join(
        f"<service>{node}/{name}</service>"
        for node in ("/camera/food", "/talker")
        for name in PARAMETER_SERVICES
    )
    both = policy_text({ENCLAVE: f'<services reply="ALLOW">{served}</services>'})
    (tmp_path / "both.xml").write_text(both)
    sros("create_permission", keystore, ENCLAVE, tmp_path / "both.xml").ok()
    log = LOGS / f"{FAST_14}.node_name_differs.log"
    found = sros("explain", keystore, ENCLAVE, "--log", log).out
    assert "the permissions are for the nodes /camera/food, /talker, and this is the node /foo" in (
        found
    )
    assert "`--ros-args -r foo:__node:=food -r food:__ns:=/camera`" in found
    for name in ("foo", "food"):
        assert merged_as_advised(found, name, tmp_path).nodes() == {ENCLAVE: ("/foo",)}
    assert "-r __node:=food" not in found and "-r __node:=talker" not in found


def test_a_process_without_its_namespace_gets_it_as_a_whole(keystore: Path, tmp_path: Path) -> None:
    services = "".join(
        f"<service>/left/{node}/{name}</service>"
        for node in ("foo", "talker")
        for name in PARAMETER_SERVICES
    )
    rights = f'<services reply="ALLOW">{services}</services>{publish("/left/scan")}'
    (tmp_path / "left.xml").write_text(policy_text({ENCLAVE: rights}))
    sros("create_permission", keystore, ENCLAVE, tmp_path / "left.xml").ok()
    log = tmp_path / "log"
    line = "[SECURITY Error] {} topic not found in allow rule. -> Function check_create_data{}\n"
    service = line.format("rq/foo/get_parametersRequest", "reader")
    log.write_text(service + line.format("rt/scan", "writer"))
    found = sros("explain", keystore, ENCLAVE, "--log", log).out
    assert found.count("start it with `--ros-args -r __ns:=/left`") == 2
    assert "-r /scan:=" not in found and "foo:__ns:=" not in found
    log.write_text(service + line.format("rt/other", "writer"))
    assert "foo:__ns:=/left" in sros("explain", keystore, ENCLAVE, "--log", log).out


def test_rcl_alone_makes_one_look_at_the_name(keystore: Path, tmp_path: Path) -> None:
    log = tmp_path / "stderr.log"
    log.write_text("RCLError: failed to create service: create_service() failed to create ...\n")
    found = sros("explain", keystore, ENCLAVE, "--log", log).out
    assert "another name or namespace than in the policy" in found
    assert "the permissions are for the node /talker" in found


def test_a_missing_common_part_is_told(keystore: Path, tmp_path: Path) -> None:
    bare = tmp_path / "bare.xml"
    bare.write_text(policy_text({ENCLAVE: publish("chatter")}))
    sros("create_permission", keystore, ENCLAVE, bare).ok()
    log = LOGS / f"{FAST_14}.common_part_missing.log"
    found = sros("explain", keystore, ENCLAVE, "--log", log).out
    assert "the permissions lack the rights that every node needs" in found
    assert 'href="common/node.xml"' in found


@pytest.mark.parametrize(
    ("word", "name", "part"),
    [
        ("publish", "/n/transition_event", "lifecycle_node"),
        ("serve", "/n/change_state", "lifecycle_node"),
        ("serve", "/n/get_state", "lifecycle_node"),
        ("serve", "/n/get_available_states", "lifecycle_node"),
        ("serve", "/n/get_available_transitions", "lifecycle_node"),
        ("serve", "/n/get_transition_graph", "lifecycle_node"),
        ("serve", "/n/_container/load_node", "component_container"),
        ("subscribe", "/n/transition_event", ""),
        ("call", "/n/change_state", ""),
        ("serve", "/m/change_state", ""),  # the policy has no node /m
        ("serve", "/n/open", ""),
    ],
)
def test_the_common_part_for_a_kind_of_node_is_named_and_no_remapping(
    word: str, name: str, part: str, tmp_path: Path
) -> None:
    own = "".join(f"<service>~/{service}</service>" for service in ("get_parameters", "set_state"))
    policy, log = tmp_path / "p.xml", tmp_path / "robot.log"
    rights = f'<services reply="ALLOW">{own}</services>{publish("/rate")}'
    policy.write_text(policy_text({"/n": rights}))
    topic = f"rt{name}" if word in ("publish", "subscribe") else f"rq{name}Request"
    kind = "writer" if word in ("publish", "call") else "reader"
    log.write_text(f"{topic} topic not found in allow rule. -> check_create_data{kind}\n")
    include = f"f /n is a {part.replace('_', ' ')}, include common/{part}.xml in its profile, in p"
    for said in (
        sros("explain", policy, "/n", "--log", log).out,
        sros("explain", policy, "/n", word, name).err,
    ):
        assert (include in said) is bool(part), said
        assert ("remapping" in said) is (not part), said


# ── enclaves that a log names by a node, by a GUID, or not at all ──────────────────────────


def test_a_unit_that_restarts_gets_each_answer_once(tmp_path: Path) -> None:
    """Twin: processes of unknown enclaves, which may be those of several nodes."""
    log = "".join(
        f"Nov 30 18:00:0{second} robot python3[10{second}]: {message}\n"
        for second in range(3)
        for message in (
            "[INFO] [1764500000.1] [rcl]: Found security directory: /ks/enclaves/weed",
            "rt/odometry topic not found in allow rule. -> Function check_create_datawriter",
        )
    )
    (finding,) = explained(log)
    assert (finding.line, finding.count, finding.process) == (2, 3, "python3[100]")
    assert [each.count for each in explained(re.sub("Found .*", "", log))] == [1, 1, 1]


def test_a_node_in_the_enclave_of_another_node_is_no_reason_to_widen_the_policy(
    tmp_path: Path,
) -> None:
    own = '<services reply="ALLOW"><service>~/get_parameters</service></services>'
    (tmp_path / "p.xml").write_text(policy_text({"/n": own, "/other": publish("/x")}))
    sros("generate_artifacts", "-k", "ks", "-p", "p.xml", cwd=tmp_path).ok()
    said = sros("explain", "ks", "/other", "serve", "/n/get_parameters", cwd=tmp_path).err
    assert "a service of the node /n, for which there is /n: start the node in that encla" in said
    (tmp_path / "log").write_text(
        "[INFO] [1764500000.1] [rcl]: Found security directory: /ks/enclaves/other\n"
        "rr/n/get_parametersReply topic not found in allow rule. check_create_datawriter\n"
    )
    said = sros("explain", "--log", "log", cwd=tmp_path).out
    assert "remedy    Perhaps the process runs in the wrong enclave, or /n has another name" in said


def test_of_several_enclaves_that_of_the_whole_process_is_named_first(tmp_path: Path) -> None:
    own = '<services reply="ALLOW"><service>~/get_parameters</service></services>'
    profile = '<profile ns="/alone" node="{}">' + own + "</profile>"
    enclaves = "".join(
        f'<enclave path="{path}"><profiles>{"".join(map(profile.format, nodes))}</profiles>'
        "</enclave>"
        for path, *nodes in (("/alone/watchdog", "watchdog"), ("/pipeline", "driver", "watchdog"))
    )
    policy = policy_text({"/other": own}).replace("</enclaves>", f"{enclaves}</enclaves>")
    (tmp_path / "p.xml").write_text(policy)
    sros("generate_artifacts", "-k", "ks", "-p", "p.xml", cwd=tmp_path).ok()
    (tmp_path / "log").write_text(
        "[INFO] [1764500000.1] [alone.driver]: up\n"
        "rr/alone/watchdog/get_parametersReply topic not found in allow rule. "
        "check_create_datawriter\n"
    )
    said = sros("explain", "ks", "/other", "--log", "log", cwd=tmp_path).out
    there = "this is the node /alone/watchdog, for which there are the enclaves /pipeline and /al"
    assert there in said and "`sros run ks /pipeline -- COMMAND`" in said, said


def test_the_enclave_of_a_node_that_runs_in_another_one_is_named(keystore: Path) -> None:
    log = LOGS / f"{FAST_14}.node_of_another_enclave.log"
    found = sros("explain", keystore, "--log", log).out
    assert f"this is the node /listener, for which there is the enclave {OTHER}" in found
    assert f"`sros run {keystore} {OTHER} -- COMMAND`" in found
    assert "__node:=" not in found and "profile of" not in found
    # Without that enclave, the name is what is wrong.
    shutil.rmtree(keystore / "enclaves" / OTHER.lstrip("/"))
    assert (
        "`--ros-args -r __node:=talker -r __ns:=/`" in sros("explain", keystore, "--log", log).out
    )


@pytest.mark.parametrize("name", ["no_enclave_named", "permissive_no_enclave_named"])
def test_no_enclave_for_everybody_is_advised(name: str, keystore: Path, tmp_path: Path) -> None:
    log = LOGS / f"rclpy.{name}.log"
    for words in ((), (keystore,), (keystore, ENCLAVE)):
        ended = sros("explain", *words, "--log", log)
        assert ended.status == 1
        assert "no enclave is named for this process" in ended.out
        assert "sros create_enclave" not in ended.out
        assert f"`sros run {words[0] if words else 'KEYSTORE'} ENCLAVE -- COMMAND`" in ended.out
        assert ("RUNS UNSECURED" in ended.out) is name.startswith("permissive")
    sros("create_enclave", keystore, "/").ok()  # what it names is there, then
    ended = sros("explain", keystore, "--log", log)
    assert "no enclave is named" not in ended.out
    assert ended.status == (0 if name.startswith("permissive") else 1)


def start_log(folder: Path, enclave: str) -> Path:
    """The log of a node that rcl started in an enclave, as with the strategy Permissive."""
    log = folder / "start.log"
    directory = folder / f"ks/enclaves{enclave}"
    log.write_text(f"[INFO] [1.0] [rcl]: Found security directory: {directory}\n[INFO] [2.0] up\n")
    return log


def folder_in_place(file: Path) -> None:
    file.unlink()
    file.mkdir()


@pytest.mark.parametrize(
    ("file", "damage"),
    [
        ("permissions.p7s", Path.unlink),
        ("key.pem", folder_in_place),
        ("cert.pem", lambda file: (file.unlink(), file.symlink_to("nowhere"))),
    ],
)
def test_a_node_that_started_without_a_file_ran_open(
    file: str, damage: Callable[[Path], object], keystore: Path, tmp_path: Path
) -> None:
    """As rclpy of Jazzy does with the strategy Permissive: Fast DDS logs nothing about it."""
    log = start_log(tmp_path, ENCLAVE)
    assert sros("explain", keystore, ENCLAVE, "--log", log).status == 0
    folder = Enclave(keystore).folder
    damage(folder / file)
    for words in ((keystore, ENCLAVE), (keystore,), (folder,)):
        ended = sros("explain", *words, "--log", log)
        assert ended.status == 1
        assert "on DDS the node RAN UNSECURED" in ended.out
        assert f"  found     {file}: " in ended.out
        assert f"{ENCLAVE} -- COMMAND`, which runs a node secured or not at all" in ended.out
    denied = log.read_text() + f"{FAST_LINE}rt/x topic not found in allow rule.\n"
    assert "RAN UNSECURED" not in "".join(each.cause for each in explained(denied))
    asked = sros("explain", keystore, ENCLAVE, "publish", "/x").out
    assert "starts with the strategy Enforce; with Permissive, every node starts open\n" in asked


@pytest.mark.parametrize("refused", [True, False])
def test_the_only_key_of_a_robot_is_missing(refused: bool, keystore: Path, tmp_path: Path) -> None:
    """An export of one enclave without its key looks like a copy without keys. Twin: a copy."""
    robot = tmp_path / "robot"
    sros("distribute_key", keystore, ENCLAVE, robot).ok()
    (folder := robot / "enclaves" / ENCLAVE[1:]).joinpath("key.pem").unlink()
    copy, log = copy_of(robot, tmp_path / "copy"), tmp_path / "robot.log"
    refusal = "RCLError: error creating node: couldn't find all security files!\n" * refused
    here = said_of(STARTED.format(robot, ENCLAVE) + refusal, tmp_path, robot, ENCLAVE)
    assert here.status == 1
    assert "  found     key.pem: missing\n" in here.out
    assert ("on DDS the node RAN UNSECURED" in here.out) is not refused
    elsewhere = sros("explain", copy, ENCLAVE, "--log", log)
    row = "  found     key.pem: missing, as in a copy without keys; on the robot, this is the fault"
    assert (row in elsewhere.out) is refused
    for ended in (here, elsewhere)[: 1 + refused]:
        assert "  remedy    Export the enclave again from the keystore" in ended.out
    (folder / "request.pem").touch()  # the key was made on the robot
    assert "  found     key.pem: missing\n" in sros("explain", robot, ENCLAVE, "--log", log).out


def test_a_fault_of_which_a_log_says_nothing_is_no_proof_of_an_open_node(
    keystore: Path, tmp_path: Path
) -> None:
    (Enclave(keystore).folder / "cert.pem").write_text("garbage")
    ended = sros("explain", keystore, ENCLAVE, "--log", start_log(tmp_path, ENCLAVE))
    assert ended.status == 1
    assert "Either the fault came after the start, or only the node's peers" in ended.out
    assert "  found     cert.pem: " in ended.out and "UNSECURED" not in ended.out
    asked = sros("explain", keystore, ENCLAVE, "publish", "/x").out
    assert "no node of the enclave starts\n" in asked


def test_an_error_says_more_than_that_no_enclave_is_named() -> None:
    line = "[INFO] [1.0] [rcl]: Found security directory: /ks/enclaves\n"
    for error, name in (("RCLError: invalid allocator", "endpoint"), (f"{FAST_LINE}X", "not-")):
        names = [each.id for each in explained(line + error)]
        assert any(each.startswith(name) for each in names)
        assert ("runs-open" in names) is (name == "not-")


def log_about(peer: Path, name: str, folder: Path) -> Path:
    """A log in which the GUID of the peer is that of an enclave."""
    subject = load_certificate((peer / "cert.pem").read_bytes(), "cert").subject
    digits = identity_of(subject.public_bytes())
    text = (LOGS / name).read_text()
    bytes_ = ".".join(digits[each : each + 2] for each in range(0, 12, 2))
    text = re.sub(r"[0-9a-f]{2}(?:\.[0-9a-f]{2}){5}(?=\.[0-9a-f.]+\|0\.0\.1\.c1)", bytes_, text)
    text = re.sub(
        r"[0-9a-f]{8}:[0-9a-f]{4}(?=[0-9a-f]{4}:[0-9a-f]+:1c1)", f"{digits[:8]}:{digits[8:]}", text
    )
    assert text != (LOGS / name).read_text()
    (folder / "peer.log").write_text(text)
    return folder / "peer.log"


@pytest.mark.parametrize("vendor", [FAST_14, CYCLONE])
def test_the_peer_whose_permissions_expired_is_named(
    vendor: str, keystore: Path, tmp_path: Path
) -> None:
    peer = Enclave(keystore, OTHER)
    log = log_about(peer.folder, f"{vendor}.peer_expired.log", tmp_path)
    fine = sros("explain", keystore, ENCLAVE, "--log", log).out
    assert f"the peer is enclave {OTHER}, whose current files have no fault" in fine
    BREAKAGES["permissions expired"](peer)
    found = sros("explain", keystore, ENCLAVE, "--log", log).out
    assert f"the peer is enclave {OTHER}: " in found and "expired at" in found
    commands = re.findall("`(sros .+?)`", found)
    assert commands and all(f"{keystore} {OTHER}" in each for each in commands[:1]), found
    assert f"{keystore} {ENCLAVE}" not in found
    unnamed = sros("explain", "--log", log).out
    assert "`sros renew KEYSTORE PEER`" in unnamed
    sros("distribute_key", keystore, ENCLAVE, tmp_path / "robot").ok()
    exported = sros("explain", tmp_path / "robot", ENCLAVE, "--log", log).out
    assert "`sros renew KEYSTORE PEER`" in exported  # an export has no CA keys
    assert f"`sros inspect {tmp_path / 'robot'}`" in exported
    assert "KEYSTORE is the keystore that has the CA keys: export the enclave again" in exported


@pytest.mark.parametrize(
    ("vendor", "remedy"),
    [
        (FAST_14, "Restart this process of enclave /talker_listener/talker: it was not restarted"),
        (
            CYCLONE,
            "Restart this process and the peer: one of them was not restarted since the stage ",
        ),
    ],
)
def test_a_process_that_was_not_restarted_in_a_rotation_is_named(
    vendor: str, remedy: str, keystore: Path, tmp_path: Path
) -> None:
    for _ in range(2):
        sros("rotate_ca", keystore, "--permissions", "--next").ok()
    log = log_about(Enclave(keystore, OTHER).folder, f"{vendor}.peer_after_stage_2.log", tmp_path)
    found = sros("explain", keystore, "--log", log).out
    assert "the CAs of this keystore are being replaced, and the stage reissue is done" in found
    assert f"  remedy    {remedy}" in found
    # After the rotation, or about a peer that this keystore does not know, it is not certain.
    stranger = sros("explain", keystore, "--log", LOGS / f"{vendor}.peer_after_stage_2.log").out
    assert "was not restarted since the stage distribute of a rotation" in stranger
    assert "  found " not in stranger
    sros("rotate_ca", keystore, "--next").ok()
    after = sros("explain", keystore, "--log", log).out
    assert f"the peer is enclave {OTHER}, whose current files have no fault" in after
    assert f"Restart the processes of {OTHER}, and then this process" in after


# ── denials ────────────────────────────────────────────────────────────────────────────────


def test_a_log_is_explained_by_a_policy_alone(tmp_path: Path) -> None:
    """Its maintainer does not have the keystore of the user who sends the log."""
    policy, log = tmp_path / "p.xml", tmp_path / "robot.log"
    policy.write_text(policy_text({"/a": publish("/y")}))
    denied = "[SECURITY Error] rt/{} topic not found in allow rule. -> check_create_datawriter\n"
    log.write_text(
        denied.format("x") + denied.format("y") + f"{FAST_LINE}PKCS7 data verification f"
    )
    said = sros("explain", policy, "/a", "--log", log).out
    assert f"`sros explain {policy} /a publish /x` shows what is missing in the policy" in said
    assert "no rule allows publish rt/x" in said and "the policy allows it" in said
    assert "now has no fault" not in said
    assert sros("explain", "--policy", policy, "/a", "--log", log).out == said
    assert "unable to find enclave /b" in sros("explain", policy, "/b", "--log", log).err
    absent = sros("explain", tmp_path / "none", "/a", "--log", log)
    assert (absent.status, "none' does not exist" in absent.err) == (2, True), absent


@pytest.mark.parametrize("named", [(), ("/a",), ("/left/a",)])
def test_a_log_of_a_robot_that_has_the_policy_in_a_namespace(
    named: tuple[str, ...], tmp_path: Path
) -> None:
    policy, log = tmp_path / "p.xml", tmp_path / "robot.log"
    policy.write_text(policy_text({"/a": publish("y")}))
    log.write_text(
        "[INFO] [1.0] [rcl]: Found security directory: /k/enclaves/left/a\n"
        "[SECURITY Error] rt/left/x topic not found in allow rule. -> check_create_datawriter\n"
        "[SECURITY Error] rt/left/y topic not found in allow rule. -> check_create_datawriter\n"
    )
    said = sros("explain", policy, *named, "--log", log).out
    assert f"`sros explain {policy} /a publish /x` shows what is missing in the policy" in said
    assert "add it as x, without a / at its beginning: the robot of the log" in said
    assert "no rule allows publish rt/left/x" in said
    assert "the policy allows it to /a, which is /left/a in namespace /left\n" in said
    assert "merged with --remap, and the process lacks the remapping. Ask for the robot's" in said


@pytest.mark.parametrize(
    ("topic", "advice"),
    [
        ("rq/left/new/purgeRequest", "~/purge: it"),
        ("rt/left/n/x", "~/x: it"),
        ("rr/left/new/purgeReply", "new/purge, without a / at"),  # the node calls it
        ("rq/left/newer/purgeRequest", "newer/purge, without a / at"),
    ],
)
def test_a_private_name_is_not_written_with_the_name_of_the_node(
    topic: str, advice: str, tmp_path: Path
) -> None:
    """The node is renamed where it runs, which only the log shows: its logger has the new name."""
    policy = tmp_path / "p.xml"
    policy.write_text(policy_text({"/a": publish("y")}))
    denied = f"{FAST_LINE}{topic} topic not found in allow rule. -> check_create_datareader\n"
    started = STARTED.format("/k", "/left/a")
    logged = "[INFO] [1.0] [left.new]: up\n"
    assert f"add it as {advice}" in said_of(started + logged + denied, tmp_path, policy).out
    said = said_of(logged + denied, tmp_path, policy, "/a").out
    assert ("add it as ~/purge: it" in said) is (topic == "rq/left/new/purgeRequest")


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (
            "[rmw_cyclonedds_cpp]: failed to create topic [rq/homeRequest] for unknown reasons",
            "the policy allows it in one direction, which is enough to create the topic\n",
        ),
        (
            "Writer is not permitted: rq/homeRequest denied by default rule(code: 145)",
            "no rule names publish rq/homeRequest",
        ),
    ],
)
def test_a_topic_of_cyclone_dds_that_one_direction_would_create(
    line: str, said: str, tmp_path: Path
) -> None:
    """Then the process has files of another policy. Twin: only its writer is denied."""
    policy = tmp_path / "p.xml"
    served = '<services reply="ALLOW"><service>home</service></services>'
    policy.write_text(policy_text({"/a": served}))
    ended = said_of(line, tmp_path, policy, "/a")
    assert said in ended.out, ended
    is_older = "The process loaded permissions of another policy" in ended.out
    assert is_older == ("failed" in line), ended


def test_a_node_of_another_version_than_its_policy(tmp_path: Path) -> None:
    """A name unlike all others is seldom a renamed one, so that this is said last."""
    policy = tmp_path / "p.xml"
    names = "<action>/grasp</action><action>/lift*</action>"
    policy.write_text(policy_text({"/a": f'<actions execute="ALLOW">{names}</actions>'}))
    denied = "[SECURITY Error] rq/calibrate/_action/send_goalRequest topic not found in allow rule"
    said = said_of(f"{denied}. -> check_create_datareader\n", tmp_path, policy, "/a").out
    assert "remedy    If the policy is for another version of the node, use the policy" in said
    assert (
        f"missing in the policy: add it.{NEXT}If the policy means this action by /grasp: " in said
    )
    assert "by exact name, the enclave may execute only action /grasp\n" in said


def test_a_log_without_the_namespace_that_its_names_show(tmp_path: Path) -> None:
    """Not a new name first: all instances would share it. Twin: a name that cannot move."""
    policy, log = tmp_path / "p.xml", tmp_path / "robot.log"
    log.write_text(
        "[SECURITY Error] rt/left/y topic not found in allow rule. -> check_create_datawriter\n"
    )
    policy.write_text(policy_text({"/a": publish("y")}))
    said = sros("explain", policy, "/a", "--log", log).out
    assert "found     in the namespace /left, the policy allows it\n" in said
    assert "remedy    Perhaps the robot has the policy in /left (`--namespace /left` of" in said
    assert "/left/y:=/y" not in said
    policy.write_text(policy_text({"/a": publish("/y")}))
    said = sros("explain", policy, "/a", "--log", log).out
    assert "in the namespace" not in said and "remedy    If the node lacks a remapping" in said


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("left/speed", "Perhaps /left is the namespace of the node: then write speed in"),
        ("left/n/speed", "Perhaps /left is the namespace of the node: then write ~/speed in"),
        *((name, "") for name in ("n/speed", "speed", "fixed/speed")),
    ],
)
@pytest.mark.parametrize("side", ["check_create_datawriter", "check_create"])
def test_a_new_name_in_a_log_without_the_namespace(
    side: str, name: str, said: str, tmp_path: Path
) -> None:
    """An absolute name in a package would be one name for all instances. Twin: rcl's line."""
    policy, log = tmp_path / "p.xml", tmp_path / "robot.log"
    policy.write_text(policy_text({"/a": publish("width", "/fixed/x")}))
    line = f"[SECURITY Error] rt/{name} topic not found in allow rule. -> {side}\n"
    found = said_of(line, tmp_path, policy, "/a").out
    assert f"sros explain {policy} /a publish /{name}`" in found
    assert (f"remedy    {said}" in found) if said else "is the namespace of" not in found
    log.write_text(f"[rcl]: Found security directory: /k/enclaves/a\n{line}")
    assert "is the namespace of" not in sros("explain", policy, "/a", "--log", log).out


@pytest.mark.parametrize("namespace", ["", "/front"])
@pytest.mark.parametrize("logs", ["", "guard", "other"])
def test_a_node_in_another_enclave_of_a_policy_without_a_keystore(
    logs: str, namespace: str, tmp_path: Path
) -> None:
    """Perhaps one process runs both nodes; a line of a node of the enclave shows that it does."""
    policy, log = tmp_path / "p.xml", tmp_path / "robot.log"
    served = "".join(f"<service>~/{name}</service>" for name in PARAMETER_SERVICES)
    reply = f'<services reply="ALLOW">{served}</services>'
    text = policy_text({"/blade": reply, "/guard": reply})
    for node in ("blade", "guard"):
        text = text.replace('node="n"', f'node="{node}"', 1)
    policy.write_text(text)
    logger = f"{namespace}/{logs}".strip("/").replace("/", ".")
    log.write_text(
        f"[INFO] [1.0] [rcl]: Found security directory: /k/enclaves{namespace}/guard\n"
        f"[SECURITY Error] rq{namespace}/blade/get_parametersRequest topic not found in allow rule."
        f" -> check_create_datareader\n[INFO] [1.1] [{logger or 'rcl'}]: ready\n"
    )
    found = sros("explain", policy, "/guard", "--log", log).out
    where = f"{namespace}/blade"
    assert f"this is the node {where}, for which there is the enclave {where}" in found
    together = logs == "guard"
    shown = f"the log shows that the process also runs {namespace}/guard, but a process runs in"
    assert (shown in found) is together
    space = f"--namespace {namespace} " * bool(namespace)
    nodes = f"--enclave {namespace}/NEW --node blade --node guard`"
    assert f"`sros merge_policy POLICY OTHER {space}{nodes}" in found
    run = f"`sros run KEYSTORE {where} -- COMMAND`"
    if together:
        assert "remedy    Give these nodes one enclave: " in found
        assert (
            f"{NEXT}If these are several processes, start the node in its enclave: {run}" in found
        )
    else:
        assert f"remedy    Start the node in its enclave: {run}" in found
        assert f"{NEXT}If one process runs {where} and {namespace}/guard, give these nodes" in found


@pytest.mark.parametrize("is_logged", [False, True])
def test_a_node_of_another_instance_in_an_enclave(is_logged: bool, tmp_path: Path) -> None:
    """Its namespace is wrong; unless the log shows that the process runs both instances."""
    policy, log = tmp_path / "p.xml", tmp_path / "robot.log"
    served = "".join(f"<service>~/{name}</service>" for name in PARAMETER_SERVICES)
    reply = f'<services reply="ALLOW">{served}</services>'
    text = policy_text({"/left/charger": reply, "/right/charger": reply})
    for ns in ("left", "right"):
        text = text.replace('ns="/" node="n"', f'ns="/{ns}" node="charger"', 1)
    policy.write_text(text)
    log.write_text(
        "[INFO] [1.0] [rcl]: Found security directory: /k/enclaves/left/charger\n"
        "[SECURITY Error] rq/right/charger/get_parametersRequest topic not found in allow rule."
        " -> check_create_datareader\n" + "[INFO] [1.1] [left.charger]: ready\n" * is_logged
    )
    found = sros("explain", policy, "/left/charger", "--log", log).out
    wrong = "If the node should be /left/charger, its namespace is wrong: start it with `--ros-args"
    assert (f"remedy    {wrong} -r __ns:=/left`" in found) is not is_logged
    merge = "`sros merge_policy POLICY OTHER --namespace NS --enclave /NEW --node NODE`, once for"
    assert (merge in found) is is_logged


def test_a_denial_by_a_rule_is_not_said_to_miss_something(tmp_path: Path) -> None:
    policy, log = tmp_path / "p.xml", tmp_path / "robot.log"
    policy.write_text(policy_text({"/a": publish("/x").replace("ALLOW", "DENY")}))
    log.write_text("[SECURITY Error] rt/x topic denied by deny rule. -> check_create_datawriter\n")
    said = sros("explain", policy, "/a", "--log", log).out
    assert f"`sros explain {policy} /a publish /x` shows the DENY, and where the policy" in said
    assert "is missing" not in said


def test_a_refusal_of_sros_names_the_enclave_as_the_robot_has_it(tmp_path: Path) -> None:
    policy, log = tmp_path / "p.xml", tmp_path / "robot.log"
    policy.write_text(policy_text({"/a": publish("y")}))
    log.write_text(
        "Unable to run the command: a process cannot run in enclave /left/a. It expired\n"
    )
    said = sros("explain", policy, "/a", "--log", log).out
    assert "`sros renew KEYSTORE /left/a`" in said


def test_a_log_with_many_enclaves_does_not_put_the_whole_policy_into_each_namespace(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy, log = tmp_path / "p.xml", tmp_path / "robot.log"
    policy.write_text(policy_text({f"/e{number}": publish("y") for number in range(50)}))
    log.write_text(
        "[INFO] [1.0] [rcl]: Found security directory: /k/enclaves/left/e7\n"
        "[SECURITY Error] rt/left/x topic not found in allow rule. -> check_create_datawriter\n"
    )
    placed: list[str] = []

    def below(path: str, namespace: str) -> str:
        placed.append(path)
        return f"{namespace}{path}".rstrip("/")

    monkeypatch.setattr("sros_tool.policy.model.below_namespace", below)
    at = asking.AskingContext(datetime.now(UTC), UTC)
    explained_log = explain_log_file("robot.log", log.read_text(), None, "", at, policy)
    assert explained_log.findings[0].checked and {*placed} == {"/", "/e7"}


def test_the_enclave_that_the_user_names_is_asked_about_another_one(tmp_path: Path) -> None:
    policy, log = tmp_path / "p.xml", tmp_path / "robot.log"
    policy.write_text(policy_text({"/a": publish("y")}))
    log.write_text(
        "[INFO] [1.0] [rcl]: Found security directory: /k/enclaves/other\n"
        "[SECURITY Error] rt/x topic not found in allow rule. -> check_create_datawriter\n"
    )
    said = sros("explain", policy, "/a", "--log", log).out
    assert f"`sros explain {policy} /a publish /x` shows" in said


def test_a_topic_that_is_denied_in_either_direction_is_looked_up_in_both(
    keystore: Path, tmp_path: Path
) -> None:
    line = "cannot create topic rt/x. Not Allowed By Security"
    said = said_of(line, tmp_path, keystore, ENCLAVE).out
    assert "no rule allows it" not in said.partition("found")[0]
    for direction in ("publish", "subscribe"):
        assert f"  found     Cyclone DDS 0.10: no rule names {direction} rt/x" in said


def test_a_denied_topic_is_compared_with_what_is_signed(keystore: Path, tmp_path: Path) -> None:
    log = tmp_path / "robot.log"
    log.write_text(
        "[SECURITY Error] rt/chatter topic not found in allow rule. -> check_create_datawriter\n"
        "[SECURITY Error] rt/other topic not found in allow rule. -> check_create_datawriter\n"
    )
    found = sros("explain", keystore, ENCLAVE, "--log", log)
    assert found.status == 1
    assert "the current permissions allow it" in found.out
    assert "Restart the process" in found.out
    assert "no rule allows publish rt/other" in found.out
    assert f"sros explain {keystore} {ENCLAVE} publish /other" in found.out


def test_a_process_that_runs_from_another_folder_is_told(keystore: Path, tmp_path: Path) -> None:
    log, export, topic = tmp_path / "robot.log", tmp_path / "export", "chatter"
    shutil.copytree(keystore, export)
    for name, told in (
        (ENCLAVE, f"the process runs from '{export}/enclaves{ENCLAVE}', whose permissions also"),
        (OTHER, f"the process runs from '{export}/enclaves{ENCLAVE}', and there "),
    ):
        permissions = (keystore / f"enclaves{name}" / "permissions.p7s").read_bytes()
        (export / f"enclaves{ENCLAVE}" / "permissions.p7s").write_bytes(permissions)
        log.write_text(
            f"[INFO] [1.0] [rcl]: Found security directory: {export}/enclaves{ENCLAVE}\n"
            f"[SECURITY Error] rt/{topic} topic not found in allow rule. check_create_datawriter\n"
        )
        assert told in sros("explain", keystore, "--log", log).out
    log.write_text(log.read_text().replace(str(export), str(keystore)))
    assert "runs from '" not in sros("explain", keystore, "--log", log).out


def test_a_folder_that_is_missing_is_looked_for_in_the_keystore(
    keystore: Path, tmp_path: Path
) -> None:
    log = tmp_path / "robot.log"
    for folder, told in (
        (f"/tmp/nowhere/enclaves{ENCLAVE}", f"names /tmp/nowhere, but has to name {keystore}: "),
        (f"{keystore}/enclaves{ENCLAVE}x", f"Perhaps you mean {ENCLAVE}."),
        (f"{keystore}/enclaves/qqq", "Correct the name: `sros list_enclaves"),
    ):
        log.write_text(f"rcl: SECURITY ERROR: directory '{folder}' does not exist\n")
        ended = sros("explain", keystore, ENCLAVE, "--log", log)
        assert told in ended.out and "only-text" not in ended.err


def test_a_folder_that_is_there_has_the_right_name(keystore: Path, tmp_path: Path) -> None:
    """rcl says the same of a folder that does not exist and of one that the user cannot enter."""
    log, folder = tmp_path / "robot.log", keystore / f"enclaves{ENCLAVE}"
    sros("distribute_key", keystore, ENCLAVE, export := tmp_path / "export").ok()
    exported = export / f"enclaves{ENCLAVE}"
    for place, words in ((folder, [keystore]), (folder, []), (exported, [keystore])):
        for begin, unsecured in (("rcl: ", False), ("", True)):
            log.write_text(f"{begin}SECURITY ERROR: directory '{place}' does not exist.\n")
            found = sros("explain", *words, "--log", log).out
            assert f"`namei -l {place}` shows who may enter each folder. " in found
            gives = f"`sudo chown -R USER {export}`" in found
            assert gives is (place == exported), "nobody gets the CA keys"
            assert ("This keystore has the CA keys" in found) is not gives
            assert "the folder exists on this machine\n" in found and "restart the node" in found
            assert "Correct the name" not in found and "has to be" not in found
            assert ("RUNS UNSECURED" in found) is ("with `sros run`" in found) is unsecured
    (other := tmp_path / "other/enclaves/a").mkdir(parents=True)
    for hostile in ("/", "/etc", other, f"{keystore}/enclaves/../../other", f"{folder}\0"):
        log.write_text(f"rcl: SECURITY ERROR: directory '{hostile}' does not exist.\n")
        found = sros("explain", keystore, "--log", log).out
        assert "Correct the name: " in found and "chown" not in found


def test_a_forgotten_remapping_is_shown(keystore: Path, tmp_path: Path) -> None:
    log = tmp_path / "robot.log"
    meant = ": perhaps the right name"
    typo = "If the program misspells the name, write /chatter th"
    for topic, why in (
        ("front/chatter", meant),
        ("chater", meant),
        ("odom", ""),  # another name, though it is the only one
        ("tf", ""),
    ):
        log.write_text(
            f"[SECURITY Error] rt/{topic} topic not found in allow rule. check_create_datawriter\n"
        )
        found = sros("explain", keystore, ENCLAVE, "--log", log).out
        perhaps = "may publish /chatter; perhaps a remapping or a parameter is missing\n"
        assert (perhaps in found) is (topic == "odom")
        assert (f"the enclave may publish /chatter{why}\n" in found) is bool(why)
        assert (f"`--ros-args -r /{topic}:=/chatter`" in found) is bool(why)
        assert (typo in found) is (topic == "chater")
        assert (
            f"lacks this remapping, merge the policy with `--remap /chatter:=/{topic}" in found
        ) is bool(why)
        assert (f"`--remap /chatter:=/{topic}`" in found) is bool(why)
        assert f"`sros explain {keystore} {ENCLAVE} publish /{topic}`" in found


@pytest.mark.parametrize(
    ("rights", "why", "found", "remedy"),
    [
        # The permissions decide, not the policy next to them.
        (
            publish("/y"),
            "not found in allow",
            "' allows it: the perm",
            "{ks} /a {file}`), and rest",
        ),
        (
            publish("/x"),
            "not found in allow",
            "no rule allows",
            "{ks} /a publish /y --policy {file}`",
        ),
        (
            publish("/y").replace("ALLOW", "DENY"),
            "denied by deny",
            "(p).xml:1: DENY publish /y",
            "",
        ),
    ],
)
def test_the_policy_next_to_a_keystore_gives_lines(
    rights: str, why: str, found: str, remedy: str, tmp_path: Path
) -> None:
    policy, log, keystore = tmp_path / "$(p).xml", tmp_path / "robot.log", tmp_path / "ks"
    sros("create_keystore", keystore, "--template", "production").ok()
    policy.write_text(policy_text({"/a": publish("/x")}))
    sros("generate_artifacts", "-k", keystore, "-p", policy).ok()
    policy.write_text(policy_text({"/a": rights}))
    if "deny" in why:
        sros("generate_artifacts", "-k", keystore, "-p", policy).ok()
    log.write_text(f"rt/y topic {why} rule. -> check_create_datawriter\n")
    for root, enclave in ((keystore, ["/a"]), (keystore / "enclaves/a", [])):
        said = sros("explain", root, *enclave, "--log", log, "--policy", policy)
        assert said.status == 1 and found in said.out, said
        asked = remedy.format(ks=root if enclave else "KEYSTORE", file=shlex.quote(str(policy)))
        assert asked in said.out, said
    (keystore / "enclaves/a/cert.pem").unlink()  # so the folder does not name its enclave
    assert sros("explain", root, "--log", log, "--policy", policy).status == 1
    missing = sros("explain", keystore, "/b", "--log", log, "--policy", policy)
    assert missing.status == 2 and "/b" in missing.err


@pytest.mark.parametrize(
    ("names", "line", "meant"),
    [
        (("gimbal/cmd", "state"), "", "/right/gimbal/cmd"),  # it shares a word
        (("state", "speed"), "", ""),
        (("state", "speed"), "[driver]: publishes /right/speed", "/right/state"),
        (("gimbal/cmd", "old_cmd"), "", ""),
    ],
)
def test_a_missing_parameter_is_said_before_a_new_right(
    names: tuple[str, ...], line: str, meant: str, tmp_path: Path
) -> None:
    policy = tmp_path / "p.xml"
    allowed = publish("/rosout", "/parameter_events", *(f"/right/{name}" for name in names))
    policy.write_text(policy_text({"/right/driver": allowed}))
    denied = "rt/right/motor_cmd topic not found in allow rule. -> check_create_datawriter"
    said = said_of(f"{line}\n{denied}\n", tmp_path, policy, "/right/driver").out
    found = f"found     /right/driver may publish {meant}; perhaps a remapping or a parameter is "
    remedy = (
        f"  remedy    If the node should use {meant}, start it with the remapping or the parameter "
        f"for this name.{NEXT}Or, if the policy is for another version of the node, use the policy "
        f"of the node's version.{NEXT}Otherwise, `sros explain "
    )
    assert (found in said, remedy in said) == (bool(meant), bool(meant)), said
    assert ("missing or wrong, correct it" in said) is (not meant)
    assert len(said.partition("  remedy ")[2].split()) <= 60


def test_the_other_side_of_a_name_tells_whether_a_remapping_may_be_forgotten(
    tmp_path: Path,
) -> None:
    """A name that a peer has is no mistake; without any, the right alone gives a silent node."""
    drawer = '<services reply="ALLOW"><service>/drawer/open</service></services>'
    calls = '<services request="ALLOW"><service>/drawer/opn</service></services>'
    dock, park = (
        f'<actions {does}="ALLOW"><action>/{name}</action></actions>'
        for does, name in (("execute", "dock"), ("call", "park"))
    )
    camera = publish("/front/image", "/rear/image", "/map_*") + drawer + dock
    enclaves = {"/camera": camera, "/weed": subscribe("/front/image") + calls + park}
    (policy := tmp_path / "policy.xml").write_text(policy_text(enclaves))
    keystore, log = tmp_path / "keystore", tmp_path / "robot.log"
    sros("create_keystore", keystore).ok()
    sros("generate_artifacts", "-k", keystore, "-p", policy).ok()
    rear = "Or, if the node lacks a remapping that its policy has, add `--ros-args -r /rear/image:="
    for topic, facts in (
        (
            "/rear/image",
            (rear, "sets the name by `-r OLD:=/rear/image` or a parameter, write "),
        ),
        (
            "/map_a",
            ("If a remapping or a parameter is missing or wrong, correct it, or ",),
        ),
        (
            "/frnt/image",
            (
                "-r /frnt/image:=/front/image",
                "already sets the name by `-r OLD:=/frnt/image` or a parameter, write /front/image "
                "there instead: ROS applies only one rule to a name.",
                "lacks this remapping, merge the policy with `--remap /front/image:=/frnt/image`.",
            ),
        ),
        (
            "/odometry",
            (
                "/weed may subscribe /front/image; perhaps a remapping or a parameter is missing\n",
                "no enclave of the keystore may publish /odometry\n",
                "  remedy    If the node should use /front/image, start it with the remapping or "
                f"the parameter for this name.{NEXT}Or, if the policy is for another version of ",
            ),
        ),
    ):
        log.write_text(f"rt{topic} topic not found in allow rule. check_create_datareader\n")
        found = sros("explain", keystore, "/weed", "--log", log).out
        for fact in ("-r /frnt/image:=", "no enclave ", "lacks a remapping, or"):
            assert (fact in found) is any(fact in each for each in facts), (topic, found)
        assert all(fact in found for fact in facts) and "subscribe" in found
        assert ("-r /rear/image:=/front/image" in found) is (rear in facts)
        notes = sros("explain", keystore, "/weed", "subscribe", topic).err
        assert (
            "not-offered]: no enclave that was read has a right to publish exactly /odom" in notes
        ) is (topic == "/odometry")
        assert ("[explain.likely-name]" in notes) is (topic == "/frnt/image")
    client, export = tmp_path / "client.log", tmp_path / "export"
    for service, fact in (
        ("drawer/open", "call /drawer/opn, which no enclave may reply: perhaps /drawer/open is me"),
        ("dock/_action/send_goal", "-r /dock/_action/send_goal:=/park/_action/send_goal -r /dock/"),
        ("camera/get_parameters", "set_parameters and set_parameters_atomically of /camera."),
    ):
        client.write_text(
            f"rq/{service}Request topic not found in allow rule. check_create_datawriter\n"
        )
        assert fact in sros("explain", keystore, "/weed", "--log", client).out, service
    sros("distribute_key", keystore, "/weed", export).ok()
    found = sros("explain", export, "--log", log, "/weed").out
    assert "no enclave of the export may publish /odometry\n" in found
    asked = "ask the whole keystore: `sros explain KEYSTORE --log LOG`."
    assert f"{asked}{NEXT}Or, if the policy" in found
    assert "remedy    If the node should use /fr" in found and "therwise, If" not in found
    command = ["weed", "--ros-args", "-r", "odometry:=front/image"]
    listed = {"processes": [{"enclave": "/weed", "command": command}], "not_here": []}
    (tmp_path / "processes.json").write_text(json.dumps(listed))
    found = sros("explain", export, "--log", log, "/weed").out
    assert "had `-r odometry:=front/image` in its command when sros watched it\n" in found
    assert "Start the process by its command in start/commands.txt of" in found
    other = ["weed", "--ros-args", "-r", "a:=b"]
    listed["processes"] = [{"enclave": "/weed", "command": other}]
    (tmp_path / "processes.json").write_text(json.dumps(listed))
    found = sros("explain", export, "--log", log, "/weed").out
    wrong = "Probably the node lacks a remapping, or has a wrong one: look at its command in"
    assert f"{wrong} start/commands.txt of the robot's folder." in found
    client.write_text("rr/weedingReply topic not found in allow rule. check_create_datawriter\n")
    served = sros("explain", export, "--log", client, "/weed").out
    assert "Or, if the node lacks a remapping, or has a wrong one, correct its command" in served
    assert "remedy    If the program has a new version, which needs more rights: let the" in served
    assert "Probably" not in served
    listed["processes"] = [{"enclave": "/weed", "command": other, "unit": "weed.service"}]
    (tmp_path / "processes.json").write_text(json.dumps(listed))
    found = sros("explain", export, "--log", log, "/weed").out
    assert f"{wrong} weed.service." in found
    # Without any remapping, rather the program is another version.
    listed["processes"] = [{"enclave": "/weed", "command": ["weed"], "unit": "weed.service"}]
    (tmp_path / "processes.json").write_text(json.dumps(listed))
    found = sros("explain", export, "--log", log, "/weed").out
    assert "a wrong one, correct its command in weed.service." in found and wrong not in found
    listed["processes"] = [{"enclave": "/weed", "command": command, "unit": "weed.service"}]
    (tmp_path / "processes.json").write_text(json.dumps(listed))
    found = sros("explain", export, "--log", log, "/weed").out
    assert "Add this to its command in weed.service, and restart the unit." in found
    (tmp_path / "processes.json").unlink()
    (keystore / "enclaves/camera/permissions.p7s").write_text("damaged")
    found = sros("explain", keystore, "/weed", "--log", log).out
    assert "no enclave" not in found  # nothing follows for the name
    assert "no enclave" not in sros("explain", export, "/weed", "subscribe", "/odometry").err


def test_a_topic_without_a_ros_name_is_looked_up_in_the_folder_of_the_enclave(
    keystore: Path, tmp_path: Path
) -> None:
    log = tmp_path / "robot.log"
    log.write_text("rt/x;y topic not found in allow rule. -> Function check_create_datareader\n")
    found = sros("explain", keystore, ENCLAVE, "--log", log).out
    assert f"`sros inspect {keystore}/enclaves{ENCLAVE}`" in found


@pytest.mark.parametrize("topic", ["/x", "rtx"])
def test_a_topic_without_a_ros_name_is_not_asked_about_in_ros_terms(topic: str) -> None:
    (found,) = explained(f"{topic} topic not found in allow rule. -> check_create_datawriter")
    assert f"publish {topic}:" in found.cause
    assert "no policy in ROS terms can name this topic" in found.remedy


def test_an_action_is_no_service(keystore: Path, tmp_path: Path) -> None:
    """Neither the advised command nor a proposed name is about a service.

    A name that the node remaps may be denied, since not every rcl_action remaps it.
    """
    log, policy = tmp_path / "robot.log", tmp_path / "robot.xml"
    log.write_text(
        "rr/arm/_action/send_goalReply topic not found in allow rule. "
        "-> Function check_create_datareader\n"
    )
    rules = " ".join(
        f"-r /arm/_action/{part}:=/base/arm/_action/{part}"
        for part in ("cancel_goal", "get_result", "send_goal", "feedback", "status")
    )
    for group, name, told in (
        ("services request", "arm", "the policy has it as a service (request), but /arm is an"),
        ("services request", "inspect", f"`--ros-args {rules.replace('/base/arm', 'NEW')}`, which"),
        ("actions call", "base/arm", f": start its nodes with `--ros-args {rules}`, which"),
    ):
        kind = group.partition("s ")[0]
        rights = f'<{group}="ALLOW"><{kind}>/{name}</{kind}></{kind}s>'
        policy.write_text(policy_text({ENCLAVE: rights}))
        found = sros("explain", policy, ENCLAVE, "--log", log).out
        assert f"`sros explain {policy} {ENCLAVE} call /arm --type action` shows" in found
        assert told in found and "may call /inspect" not in found
        assert ("with late updates of Jazzy." in found) is (name != "arm")


def test_an_expired_enclave_is_renewed(keystore: Path, tmp_path: Path) -> None:
    """`sros run` names the command that renews it, and so does the explanation of its message."""
    BREAKAGES["certificate expired"](Enclave(keystore))
    refused, renew = sros("run", keystore, ENCLAVE, "--", "true"), f"`sros renew {keystore} "
    assert refused.status == 2 and f"{renew}{ENCLAVE}`." in refused.err
    log = tmp_path / "robot.log"
    log.write_text(refused.err.partition(": it expired")[0])
    assert f"{renew}{ENCLAVE}`." in sros("explain", keystore, ENCLAVE, "--log", log).out
    assert f"{renew}{ENCLAVE}`." in sros("explain", keystore, "--log", log).out


def test_a_known_line_is_shown_without_time_and_source() -> None:
    log = LOGS / f"{FAST_14}.node_of_another_enclave.log"
    shown = sros("explain", "--log", log).out.splitlines()[0]
    topic = "rq/listener/describe_parametersRequest topic not found in allow rule."
    assert shown == f"line 2: {topic}  (2 times)"


def test_each_cause_of_a_topic_has_its_own_lines(tmp_path: Path) -> None:
    """What names the topic without a cause belongs to the cause before it, a half cause to none."""
    fast = "[SECURITY Error] rt/a topic {} rule. (Permissions.cpp:1192) -> Function check_create_"
    (tmp_path / "fast.log").write_text(
        f"{fast.format('denied by deny')}datawriter\n"
        "[SECURITY Error] rt/b topic not found in allow rule. -> Function check_create_datawriter\n"
        f"{fast.format('not found in allow')}datareader\n"
        "failed to create subscription for rt/a\n"
    )
    by_default = "is not permitted: rt/a denied by default rule(code: 145)\n"
    (tmp_path / "cyclone.log").write_text(
        "Local topic permission denied: rt/a denied by default rule(code: 145)\n"
        "Local topic permission denied: rt/b found in deny_rule.(code: 145)\n"
        f"Writer {by_default}Reader {by_default}Reader {by_default}"
    )
    for log, told in (
        ("fast.log", [(1, 1, "publish /a"), (2, 1, "publish /b"), (3, 2, "subscribe /a")]),
        ("cyclone.log", [(2, 1, "use /b"), (3, 1, "publish /a"), (4, 2, "subscribe /a")]),
    ):
        ended = sros("explain", "--log", log, "--json", cwd=tmp_path)
        lines = (tmp_path / log).read_text().splitlines()
        found = json.loads(ended.out)["findings"]
        assert [
            (each["line"], each["count"], each["cause"].partition("may not ")[2].partition(":")[0])
            for each in found
        ] == told
        assert all(each["text"] in lines[each["line"] - 1] for each in found)


def test_halves_of_services_and_parts_of_actions_are_told_as_these() -> None:
    denied = "{} topic not found in allow rule. -> check_create_data{}"
    for topic, creates, told in (
        ("rq/addRequest", "writer", "call /add"),
        ("rr/addReply", "writer", "serve /add"),
        ("rq/go/_action/send_goalRequest", "reader", "execute action /go, of which {} is a part"),
        ("rt/go/_action/status", "reader", "call action /go, of which {} is a part"),
        ("rt/go/_action/feedback", "writer", "execute action /go, of which {} is a part"),
        ("rt/go/_action/path", "writer", "publish /go/_action/path"),
    ):
        (found,) = explained(denied.format(topic, creates))
        assert f"may not {told.format(topic)}: " in found.cause, found


def test_json(tmp_path: Path) -> None:
    import json

    found = sros("explain", "--log", LOGS / "fastdds_2.9.1.revoked.log", "--json")
    (finding,) = json.loads(found.out)["findings"]
    assert set(finding) == {
        "id", "vendor", "line", "count", "text", "process", "enclave", "cause", "checked",
        "found", "remedy",
    }  # fmt: skip
    assert (finding["id"], finding["vendor"], finding["checked"]) == ("identity", "fastdds", False)


def test_wrong_usage(tmp_path: Path) -> None:
    assert sros("explain", "--log", tmp_path / "none.log").status == 2
    assert sros("explain", "ks", "/a", "publish", "/x", "--log", "-").status == 2


def test_how_often_files_are_read_is_not_for_the_log_to_choose(
    keystore: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither by names that the keystore does not have, nor by many topics, nor by a path."""
    copy_of(keystore, tmp_path / "other")
    names = [ENCLAVE, *(f"/unknown{n}" for n in range(9)), f"/../../other/enclaves{ENCLAVE}"]
    lines = [
        f"[node-{number}] Found security directory: {keystore}/enclaves{name}\n"
        f"[node-{number}] rt/t{topic} topic not found in allow rule. local writer\n"
        for number, name in enumerate(names)
        for topic in range(3)
    ]
    (tmp_path / "log").write_text("".join(lines))
    read: list[str] = []

    def opened(opening: OpenedKeystore, name: str, *, moment: datetime) -> LoadedEnclave:
        read.append(name)
        return load_enclave_of(opening, name, moment=moment)

    def refuse(_file: LedgerFile, *_asked: str) -> Ledger:
        raise AssertionError("the ledger was read")

    monkeypatch.setattr(asking, "deciding_enclave", opened)
    monkeypatch.setattr(LedgerFile, "ledger", refuse)
    monkeypatch.setattr(LedgerFile, "with_field", refuse)
    findings = json.loads(sros("explain", keystore, "--log", tmp_path / "log", "--json").out)
    assert [each["checked"] for each in findings["findings"]].count(True) == 3
    assert read == [ENCLAVE]


def test_what_a_log_says_does_not_become_a_command() -> None:
    line = "[SECURITY Error] Cannot read file file:///tmp/x;rm${IFS}-rf${IFS}~ (a.cpp:1)"
    (found,) = explained(line)
    assert "'/tmp/x;rm${IFS}-rf${IFS}~'" in found.remedy
    denied = (
        "[rcl]: Found security directory: /ks/enclaves/a;reboot\n"
        "rt/x;reboot topic not found in allow rule. -> check_create_datawriter"
    )
    (found,) = explained(denied)
    assert "`sros inspect 'KEYSTORE/enclaves/a;reboot'`" in found.remedy
    (found,) = explained(denied.replace("rt/x;reboot", "rt/x"))
    assert "`sros explain KEYSTORE '/a;reboot' publish /x`" in found.remedy
