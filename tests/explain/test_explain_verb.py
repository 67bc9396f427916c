"""``sros explain`` as it is used: answers, exit statuses, JSON, and what is refused."""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from sros_tool.api import create_keystore, explain_access, generate, renew
from sros_tool.cli.common import now
from sros_tool.dds.decision.vendors import Vendor
from sros_tool.files import policies_dir, templates_dir
from sros_tool.policy.document import read_policy
from sros_tool.policy.rights import policy_rights
from tests.explain.broken import BREAKAGES, ENCLAVE, OTHER, Enclave, make_keystore
from tests.support.children import python, run
from tests.support.harness import (
    Ended,
    copy_of,
    policy_text,
    publish,
    sros,
    subscribe,
    with_includes,
)
from tests.support.long_form import some

POLICY = policies_dir() / "talker_listener.xml"
HERE = {"RMW_IMPLEMENTATION": "rmw_fastrtps_cpp", "TZ": "UTC"}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_keystore(tmp_path_factory.mktemp("whole") / "ks", now())


@pytest.fixture
def keystore(whole: Path, tmp_path: Path) -> Path:
    return copy_of(whole, tmp_path / "ks")


def explain(*words: object, env: dict[str, str | None] | None = None) -> Ended:
    return sros("explain", *words, env={**HERE, **(env or {})})


def answer(*words: object, env: dict[str, str | None] | None = None) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(explain(*words, "--json", env=env).out)
    return found


def test_yes_with_its_reasons(whole: Path) -> None:
    found = explain(whole, ENCLAVE, "publish", "/chatter", "--policy", POLICY)
    assert found.status == 0
    assert found.out.startswith(f"yes: {ENCLAVE} may publish topic /chatter, on Fast DDS 2.14 (")
    assert "talker_listener.xml:11: ALLOW publish chatter" in found.out
    assert POLICY.read_text().splitlines()[10].strip() == "<topic>chatter</topic>"
    assert "payload ENCRYPT" in found.out
    assert "RTPS messages SIGN" in found.out
    assert "until" in found.out
    assert found.err == ""


def test_a_question_loads_only_what_answers_it(whole: Path) -> None:
    code = (
        "import sys; from sros_tool.cli import main\n"
        f"try: main(['explain', {str(whole)!r}, {ENCLAVE!r}, 'publish', '/chatter'])\n"
        "except SystemExit: print(*(name for name in sys.modules if name.startswith('sros_tool')))"
    )
    *lines, names = run([sys.executable, "-c", code]).stdout.splitlines()
    assert lines[0].startswith("yes")
    assert len(names.split()) <= 74
    assert not set(names.split()).intersection(
        f"sros_tool.{each}"
        for each in (
            "explain.who",
            "explain.zenoh",
            "keystore.transaction",
            "reach",
            "runtime.stacks",
        )
    )


def test_no_with_a_change_that_works(keystore: Path, tmp_path: Path) -> None:
    """What it prints is done word for word, and then the answer is yes."""
    policy = tmp_path / "robot.xml"
    shutil.copytree(policies_dir() / "common", tmp_path / "common")
    policy.write_text(POLICY.read_text())
    sros("create_permission", keystore, ENCLAVE, policy).ok()
    asked = (keystore, ENCLAVE, "call", "/reset", "--policy", policy)
    found = explain(*asked)
    assert found.status == 1
    told = answer(*asked)
    assert told["allowed"] is False
    before = policy_rights(read_policy(policy))
    (tmp_path / "allow.xml").write_text(told["change"]["document"])
    for command in told["commands"]:
        name, *words = command.split()
        assert name == "sros"
        sros(*words, cwd=tmp_path).ok()
    assert explain(*asked).status == 0
    added = policy_rights(read_policy(policy)) - before
    assert [str(right) for right in added] == [f"{ENCLAVE} ALLOW request service /reset"]
    assert explain(keystore, ENCLAVE, "serve", "/reset").status == 1
    assert "sros merge_policy" in found.out and "<service>reset</service>" in found.out
    private = explain(keystore, ENCLAVE, "serve", "/talker/reset", "--policy", policy)
    assert "<service>~/reset</service>" in private.out
    here = sros("explain", policy, ENCLAVE, "serve", "/talker/reset", cwd=tmp_path)
    assert "sros merge_policy robot.xml allow.xml --in-place\n" in here.out
    shutil.copytree(tmp_path / "common", tmp_path / "folder/common")
    shutil.copy(policy, tmp_path / "folder")
    in_folder = sros("explain", "folder", ENCLAVE, "serve", "/talker/reset", cwd=tmp_path)
    assert "sros merge_policy folder/robot.xml allow.xml --in-place\n" in in_folder.out


def test_the_policy_of_a_fleet_is_changed_where_it_is_and_issued_for_all(tmp_path: Path) -> None:
    policy = tmp_path / "robot.xml"
    policy.write_text(policy_text({"/{robot}/base": publish("{namespace}/odom")}))
    (tmp_path / "fleet.toml").write_text('[robots.r1]\nnamespace = "/r1"\n')
    issue = f"generate_artifacts -k {tmp_path / 'ks'} -p {policy} --fleet {tmp_path / 'fleet.toml'}"
    sros(*issue.split()).ok()
    asked = (tmp_path / "ks", "/r1/base", "publish", "/r1/map", "--policy", policy)
    found = explain(*asked)
    assert found.status == 1 and f"    add at {policy}:1, with placeholders for the" in found.out
    assert "allow.xml" not in found.out
    policy.write_text(
        policy.read_text().replace("</topics>", "<topic>{namespace}/map</topic></topics>")
    )
    for command in answer(*asked[:-2], "--policy", policy)["commands"]:
        sros(*command.split()[1:]).ok()
    assert explain(*asked).status == 0
    found = explain(*asked[:3], "/r1/other")
    fleet = f"-p POLICY --fleet {tmp_path / 'ks' / 'fleet.toml'}"
    assert f"sros generate_artifacts -k {tmp_path / 'ks'} {fleet}" in found.out
    assert "add to the fleet's policy, with placeholders" in found.out
    assert "merge_policy" not in found.out and "create_permission" not in found.out
    single = tmp_path / "single.xml"
    single.write_text(policy_text({"/z": publish("/a"), "/r1/base": publish("/r1/odom", "/b")}))
    found = explain(*asked[:3], "/r1/other", "--policy", single)
    assert f"sros merge_policy {single} allow.xml --in-place" in found.out, "it has no placeholders"


def test_everything_that_an_enclave_may_do_is_shown_by_inspect(keystore: Path) -> None:
    refused = explain(keystore, ENCLAVE)
    command = refused.err.partition("`sros inspect ")[2].partition("`")[0]
    assert refused.status == 2 and "publish topics" in sros("inspect", command).ok().out
    above = sros("inspect", Path(command).parent)
    assert above.status == 2 and f"It contains {OTHER}" in above.err
    named = above.err.partition("`sros inspect ")[2].partition("`")[0]
    assert "subscribe topics" in sros("inspect", named).ok().out
    chosen = explain(keystore, "--robot", "r1")
    assert chosen.status == 2 and "`sros list_enclaves KEYSTORE --robot r1`" in chosen.err


def test_a_denial_is_lifted_by_an_edit(tmp_path: Path) -> None:
    text = with_includes(
        policy_text(
            {
                "/a": '<topics publish="ALLOW"><topic>*</topic></topics>\n'
                '<topics publish="DENY" subscribe="DENY">\n<topic>secret</topic>\n'
                "<topic>hidden</topic></topics>"
            }
        )
    )
    policy = tmp_path / "robot.xml"
    policy.write_text(text)
    found = explain("/a", "publish", "/secret", "--policy", policy)
    assert found.status == 1
    assert "robot.xml:3: DENY publish secret" in found.out
    told = answer("/a", "publish", "/secret", "--policy", policy, "--vendor", "fastdds")
    assert [(each["qualifier"], each["right"]) for each in told["change"]["lift"]] == [
        ("DENY", "publish")
    ]
    (edit,) = told["change"]["edits"]
    assert edit["line"] == 2
    start, end = text.index('<topics publish="DENY"'), text.index("</topics></profile>")
    policy.write_text(text[:start] + edit["xml"] + text[end + len("</topics>") :])
    assert (
        explain("/a", "publish", "/secret", "--policy", policy, "--vendor", "fastdds").status == 0
    )
    assert explain("/a", "publish", "/hidden", "--policy", policy).status == 1
    assert explain("/a", "subscribe", "/secret", "--policy", policy).status == 1
    # Cyclone DDS denies the topic as a whole, and is told so.
    other = explain("/a", "publish", "/secret", "--policy", policy, "--vendor", "fastdds")
    assert "note [explain.vendors-differ]" in other.err
    cyclone = answer("/a", "publish", "/secret", "--policy", policy, "--vendor", "cyclonedds")
    assert [each["right"] for each in cyclone["change"]["lift"]] == ["subscribe"]


def test_parts_of_a_service_are_told(tmp_path: Path) -> None:
    policy = tmp_path / "robot.xml"
    policy.write_text(
        policy_text(
            {
                "/a": '<services request="ALLOW"><service>add</service></services>'
                '<services request="DENY"><service>add</service></services>'
            }
        )
    )
    found = explain("/a", "call", "/add", "--policy", policy)
    assert "part      publish its requests (rq/addRequest): denied" in found.out
    assert "part      subscribe its replies (rr/addReply): denied" in found.out


@pytest.mark.parametrize("breakage", some([*BREAKAGES], 8))
def test_what_cannot_load_is_denied_everything(breakage: str, keystore: Path) -> None:
    BREAKAGES[breakage](Enclave(keystore))
    verbs = [("publish", "/chatter"), ("join",)]
    for words in verbs:
        for vendor in ("fastdds", "cyclonedds"):
            found = explain(keystore, ENCLAVE, *words, "--vendor", vendor, "--domain", "0")
            lenient = breakage == "permissions without default" and vendor == "cyclonedds"
            assert found.status == (0 if lenient else 1), (found, vendor)
            assert lenient or "denied by" in found.out
    assert explain(keystore, OTHER, "subscribe", "/chatter").status == (
        1 if "governance" in breakage and not (Enclave(keystore).folder / "governance.p7s").exists()
        else 0
    )  # fmt: skip


@pytest.mark.parametrize("make", [Path.mkdir, lambda path: path.symlink_to("nowhere")])
def test_a_list_that_ros_leaves_out_stops_only_sros_run(
    make: Callable[[Path], None], keystore: Path
) -> None:
    """rmw_dds_common gives DDS a crl.pem only if it is a regular file, and a node starts."""
    make(Enclave(keystore).folder / "crl.pem")
    found = explain(keystore, ENCLAVE, "join")
    assert found.status == 0
    assert "continue to communicate with revoked enclaves" in found.err
    refused = sros("run", keystore, ENCLAVE, "--", "true")
    assert refused.status == 2
    assert "so ROS 2 ignores it" in refused.err


def test_expired_at_a_moment_to_come(whole: Path) -> None:
    asked = (whole, ENCLAVE, "publish", "/chatter")
    told = answer(*asked)
    assert told["until_file"] == "cert.pem" or told["until_file"] == "permissions.p7s"
    assert explain(*asked, "--at", told["until"].replace("2036", "2035")).status == 0
    late = explain(*asked, "--at", "20y")
    assert late.status == 1 and "expired" in late.out and "`sros renew" in late.out


def test_an_expired_right_is_renewed_and_not_added(keystore: Path) -> None:
    """Twin: a right that the expired permissions lack is also missing in the policy."""
    BREAKAGES["permissions expired"](Enclave(keystore))
    for name, is_there in (("/chatter", True), ("/other", False)):
        said = explain(keystore, ENCLAVE, "publish", name).out
        assert f"grant '{ENCLAVE}' expired at " in said
        assert ("sros renew" in said, "merge_policy" in said) == (is_there, not is_there), said


def test_a_clock_in_the_first_year(whole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sros_tool.cli.common._clock", lambda: datetime(1, 1, 1, tzinfo=UTC))
    assert explain(whole, ENCLAVE, "publish", "/chatter").status == 1


def test_the_time_zone_of_the_robot_counts_on_fast_dds(keystore: Path) -> None:
    enclave = Enclave(keystore)
    enclave.validity(enclave.now - timedelta(minutes=5), enclave.now + timedelta(days=1))
    asked = (keystore, ENCLAVE, "publish", "/chatter")
    assert explain(*asked).status == 0
    west = explain(*asked, "--time-zone", "America/Los_Angeles")
    assert west.status == 1
    assert "local time" in west.out
    assert "note [explain.vendors-differ]" in west.err
    cyclone = ("--vendor", "cyclonedds", "--time-zone", "America/Los_Angeles")
    assert explain(*asked, *cyclone).status == 0
    assert explain(*asked, "--time-zone", "-08:00").status == 1
    assert explain(*asked, "--time-zone", "Nowhere/Land").status == 2


def test_all_vendors_and_where_they_differ(tmp_path: Path) -> None:
    policy = tmp_path / "robot.xml"
    policy.write_text(
        policy_text(
            {
                "/a": '<topics publish="DENY" subscribe="ALLOW"><topic>status</topic></topics>',
            }
        )
    )
    found = explain("/a", "subscribe", "/status", "--policy", policy, "--all-vendors")
    assert found.status == 0
    assert "VENDORS DIFFER" in found.out and "Cyclone DDS 0.10 (denied)" in found.out
    told = answer("/a", "subscribe", "/status", "--policy", policy, "--all-vendors")
    assert told["differ"] is True
    assert {each["vendor"]: each["outcome"] for each in told["vendors"]} == {
        "standard": "allowed",
        "fastdds": "allowed",
        "fastdds-2.6": "allowed",
        "fastdds-2.9": "allowed",
        "fastdds-3.2": "allowed",
        "fastdds-3.6": "allowed",
        "cyclonedds": "denied",
        "cyclonedds-11": "allowed",
        "opendds": "allowed",
        "connext": "allowed",
    }
    assert {each["vendor"] for each in told["vendors"] if each["documented_only"]} == {
        "opendds",
        "connext",
    }
    asked = ("/a", "subscribe", "/status", "--policy", policy, "--all-distros")
    assert {
        each["distribution"]: each["outcome"]
        for each in answer(*asked)["distributions"]
        if each["release"].startswith("Cyclone DDS")
    } == {"humble": "denied", "jazzy": "denied", "kilted": "denied", "lyrical": "allowed"}
    differ = "DISTRIBUTIONS DIFFER: Humble with Fast DDS 2.6 (allowed), but Humble with Cyclone DDS"
    assert differ in explain(*asked).out
    alike = explain("/a", "publish", "/other", "--policy", policy, "--all-vendors")
    assert alike.status == 1 and "all vendors decide alike" in alike.out


def test_where_running_nodes_lose_their_peers_when_a_certificate_expires(tmp_path: Path) -> None:
    root = tmp_path / "ks"
    sros("create_keystore", root, "--validity", "20d", "--permissions-validity", "90d").ok()
    sros("create_enclave", root, "/a").ok()
    until = {
        vendor: explain(root, "/a", "join", "--vendor", vendor).ok().out
        for vendor in ("fastdds", "fastdds-2.6", "fastdds-3.2", "fastdds-3.6")
    }
    assert all("when cert.pem expires" in text for text in until.values())
    losing = {vendor for vendor, text in until.items() if "running nodes lose their peers" in text}
    assert losing == {"fastdds-2.6", "fastdds-3.2"}


def test_the_vendor_of_this_machine(whole: Path) -> None:
    asked = (whole, ENCLAVE, "publish", "/chatter")
    by_rmw = answer(*asked, env={"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"})
    assert by_rmw["vendor"] == "cyclonedds"
    assert by_rmw["vendor_why"] == "RMW_IMPLEMENTATION is rmw_cyclonedds_cpp"
    lyrical: dict[str, str | None] = {
        "RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp",
        "ROS_DISTRO": "lyrical",
    }
    assert answer(*asked, env=lyrical)["vendor"] == "cyclonedds-11"
    named = answer(*asked, "--distro", "lyrical", "--vendor", "cyclonedds")
    assert (named["vendor"], named["vendor_why"]) == ("cyclonedds-11", "as in ROS 2 Lyrical")
    jazzy = answer(*asked, "--distro", "jazzy", env=lyrical)
    assert jazzy["vendor"] == "cyclonedds"
    assert answer(*asked, "--vendor", "opendds")["documented_only"] is True


def test_a_distribution_that_is_none_is_no_choice(whole: Path) -> None:
    asked = (whole, ENCLAVE, "publish", "/chatter")
    text = "note [distribution.unknown]: ROS_DISTRO is 'jazy', which sros does not know"
    for words in (asked, (whole, "--who", "publish", "/chatter")):
        assert text in explain(*words, env={"ROS_DISTRO": "jazy"}).ok().err
        assert text not in explain(*words, env={"ROS_DISTRO": "jazzy"}).ok().err
        assert (
            text not in explain(*words, "--distro", "kilted", env={"ROS_DISTRO": "jazy"}).ok().err
        )


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("--distro", "lunar"), "sros knows ardent, bouncy"),
        (("--distro", "jazzy", "--vendor", "fastdds-2.9"), "does not ship Fast DDS 2.9.1"),
        (("--distro", "jazzy", "--vendor", "zenoh"), "On Zenoh, the decision is the same"),
        (("--distro", "jazzy", "--all-distros"), "exclude each other"),
        (("--vendor", "fastdds", "--all-distros"), "exclude each other"),
    ],
)
def test_a_distribution_that_cannot_be_asked(words: tuple[str, ...], why: str, whole: Path) -> None:
    asked = (whole, ENCLAVE, "publish", "/chatter")
    refused = explain(*asked, *words)
    assert refused.status == 2 and why in refused.err
    explain(*asked, "--distro", "jazzy").ok()


def test_a_vendor_that_was_never_measured_is_marked(whole: Path) -> None:
    asked = (whole, ENCLAVE, "publish", "/chatter")
    who = (whole, "--who", "publish", "/chatter")
    for vendor, marked in (("connext", True), ("opendds", True), ("fastdds", False)):
        assert ("as documented" in explain(*asked, "--vendor", vendor).ok().out) is marked
        assert ("as documented" in explain(*who, "--vendor", vendor).ok().err) is marked
        assert answer(*who, "--vendor", vendor)["documented_only"] is marked


def test_faults_of_files_are_not_marked_as_documented(whole: Path, tmp_path: Path) -> None:
    root = tmp_path / "ks"
    copy_of(whole, root)
    asked = (root, ENCLAVE, "publish", "/chatter")
    marks = "(as documented)"
    assert explain(*asked, "--all-vendors").ok().out.count(marks) == 2
    (root / f"enclaves{ENCLAVE}/permissions.p7s").unlink()
    table = explain(*asked, "--all-vendors")
    assert table.status == 1 and table.out.count("permissions.p7s: missing") == len(Vendor)
    assert marks not in table.out
    one = explain(*asked, "--vendor", "opendds")
    assert one.status == 1 and "on OpenDDS (as asked)" in one.out


def test_json_of_one_answer(whole: Path) -> None:
    told = answer(whole, ENCLAVE, "publish", "/chatter", "--policy", POLICY, "--domain", "0")
    assert {
        "enclave", "question", "domain", "at", "time_zone", "vendor", "vendor_title", "vendor_why",
        "documented_only", "allowed", "outcome", "reason", "text", "denied_by", "rule", "wildcard",
        "policy", "protection", "until", "until_file", "problems", "parts", "remedy", "change",
        "commands", "counts_key", "policy_sha256", "version",
    } == set(told)  # fmt: skip
    assert told["rule"] == {
        "grant": 0,
        "grant_name": ENCLAVE,
        "rule": 0,
        "allow": True,
        "expression": "rt/chatter",
    }
    assert told["policy"]["provenance"] == "same"
    assert told["policy"]["lines"][0]["line"] == 11
    assert told["protection"]["data"] == "ENCRYPT"
    assert told["question"]["right"] == "publish"


def test_a_policy_that_has_changed(whole: Path, tmp_path: Path) -> None:
    policy = tmp_path / "robot.xml"
    policy.write_text(policy_text({ENCLAVE: publish("/chatter", "/other")}))
    found = explain(whole, ENCLAVE, "publish", "/other", "--policy", policy)
    assert found.status == 1
    assert "note [explain.policy-changed]" in found.err
    assert f"sros create_permission {whole} {ENCLAVE} {policy}" in found.out
    assert "merge_policy" not in found.out
    told = answer(whole, ENCLAVE, "publish", "/other", "--policy", policy)
    assert told["policy"]["would_allow"] is True and told["change"] is None


def test_a_policy_before_anything_is_signed(tmp_path: Path) -> None:
    words = ("publish", "/chatter", "--policy", POLICY)
    assert explain(ENCLAVE, *words).status == 0
    assert explain(OTHER, *words).status == 1
    assert answer(ENCLAVE, *words)["policy"]["provenance"] == "planned"
    assert answer(ENCLAVE, *words)["until"] is None
    # A keystore of the environment does not come between.
    env: dict[str, str | None] = {"ROS_SECURITY_KEYSTORE": str(tmp_path / "none")}
    assert explain(ENCLAVE, *words, env=env).status == 0
    assert explain("/nobody", *words).status == 2


def test_an_enclave_that_is_not_signed_yet_under_its_keystore(keystore: Path) -> None:
    shutil.rmtree(Enclave(keystore).folder)
    words = ("publish", "/chatter", "--policy", POLICY)
    assert answer(keystore, ENCLAVE, *words)["policy"]["provenance"] == "planned"
    assert explain(keystore, ENCLAVE, "publish", "/chatter").status == 2


def test_by_environment_option_and_folder(whole: Path, tmp_path: Path) -> None:
    words = ("publish", "/chatter")
    env: dict[str, str | None] = {"ROS_SECURITY_KEYSTORE": str(whole)}
    assert explain(ENCLAVE, *words, env=env).status == 0
    assert explain(ENCLAVE, *words, "--keystore", whole).status == 0
    folder = whole / "enclaves" / ENCLAVE[1:]
    assert explain(folder, *words).status == 0
    assert explain(ENCLAVE, *words, "--keystore", folder).status == 0
    assert explain(OTHER, *words, "--keystore", folder).status == 2
    sros("distribute_key", whole, ENCLAVE, tmp_path / "robot").ok()
    assert explain(tmp_path / "robot", ENCLAVE, *words).status == 0
    denied = (ENCLAVE, "publish", "/denied")
    found = explain(tmp_path / "robot", *denied)
    assert found.out.rstrip().endswith(f"sros distribute_key KEYSTORE {ENCLAVE} TARGET --force")
    assert "note [explain.exported]" in found.err, "the keystore may allow it by now"
    assert f"then `sros distribute_key KEYSTORE {ENCLAVE} TARGET --force` alone is" in found.err
    assert "note [explain.exported]" not in explain(whole, *denied).err


@pytest.mark.parametrize("words", [("publish", "/chatter"), ("subscribe", "/chatter"), ("join",)])
def test_who_may_by_a_policy_alone_is_who_may_once_it_is_signed(
    words: tuple[str, ...], whole: Path, tmp_path: Path
) -> None:
    for vendor in ("fastdds", "cyclonedds"):
        asked = ("--who", *words, "--vendor", vendor)
        of_keystore, of_policy = explain(whole, *asked), explain(POLICY, *asked)
        assert of_policy.out == of_keystore.out and of_policy.status == of_keystore.status
        assert explain("--policy", POLICY, *asked).out == of_policy.out
    one = explain(POLICY, "--who", *words, "--match", ENCLAVE)
    assert "of 1 enclave may" in one.out
    assert explain(POLICY, ENCLAVE, *words).status == explain(whole, ENCLAVE, *words).status


def test_a_node_or_nothing_in_place_of_an_enclave(whole: Path, tmp_path: Path) -> None:
    node = read_policy(POLICY).enclaves[0].all_profiles()[0]
    name = f"{node.ns.rstrip('/')}/{node.node}"
    found = explain(whole, name, "publish", "/chatter")
    assert f"{name} is a node of {ENCLAVE}. Name the enclave: {ENCLAVE}." in found.err
    found = explain(whole, "publish", "/chatter")
    assert f"`sros explain {whole} --who publish /chatter`" in found.err and found.status == 2


def test_who_may_in_an_export(whole: Path, tmp_path: Path) -> None:
    sros("distribute_key", whole, ENCLAVE, tmp_path / "robot").ok()
    words = ("publish", "/chatter")
    found = explain(tmp_path / "robot", "--who", *words)
    assert found.out == f"{ENCLAVE}\n1 of 1 enclave in this export may publish topic /chatter\n"
    assert "is an export, which may lack enclaves" in found.err
    assert "Ask the keystore that it comes from" in found.err
    assert answer(tmp_path / "robot", "--who", *words)["export"] is True
    assert answer(whole, "--who", *words)["export"] is False
    assert "export" not in explain(whole, "--who", *words).err
    refused = explain(tmp_path / "robot", "--reach", ENCLAVE)
    assert refused.status == 2 and "is an export, which may lack enclaves" in refused.err


def test_domains(whole: Path) -> None:
    for vendor in ("fastdds", "cyclonedds"):
        asked = (whole, ENCLAVE, "publish", "/chatter", "--vendor", vendor)
        assert explain(*asked).status == 0
        found = explain(*asked, "--domain", "7")
        assert found.status == 1
        assert "the governance does not list domain 7" in found.out
        assert "ROS_DOMAIN_ID" in found.out
        assert explain(*asked, env={"ROS_DOMAIN_ID": "7"}).status == 1
    assert explain(whole, ENCLAVE, "join", "--domain", "x").status == 2


def test_access_control_that_is_off_is_told(tmp_path: Path) -> None:
    template = tmp_path / "open.toml"
    shipped = templates_dir() / "development.toml"
    text = shipped.read_text().replace(
        "[protection.default] ", "[protection.default]\nwrite_access_control = false\n#"
    )
    template.write_text(text)
    sros("create_keystore", tmp_path / "ks", "--template", template).ok()
    sros("generate_artifacts", "-k", tmp_path / "ks", "-p", POLICY).ok()
    found = explain(tmp_path / "ks", ENCLAVE, "publish", "/anything")
    assert found.status == 0
    assert "ACCESS CONTROL OFF for writing" in found.out
    # What it may do so, it also reaches: the listener has no right to publish.
    reach = explain(tmp_path / "ks", "--reach", OTHER)
    assert f"{OTHER} -publish /chatter-> {ENCLAVE}" not in reach.out  # who does not read it
    by = f"{ENCLAVE} -publish /chatter-> {OTHER}"
    assert by in reach.out
    reached = answer(tmp_path / "ks", "--reach", OTHER)["influences"]
    assert {each["enclave"] for each in reached} == {ENCLAVE}


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["/a", "publish"], "publish needs the name of a topic"),
        (["/a", "fly", "/x"], "fly"),
        (["/a", "call", "x"], "the name 'x' is not valid in a question"),
        (["/a", "publish", "x"], "Write /x"),
        (["/a", "publish", "/*"], "wildcard"),
        (["/a", "publish", "/x y"], "white space"),
        (["/a", "publish", "/x", "--type", "service"], "nobody can publish a service"),
        (["/a", "serve", "/x", "--type", "action"], "nobody can serve an action"),
        (["/a", "execute", "/x", "--type", "service"], "nobody can execute a service"),
        (["/a", "join", "/x"], "join takes no name"),
        (["/a", "publish", "/x", "--at", "soon"], "--at 'soon' is not a date"),
        (["/a", "publish", "/x", "--at", "9999-12-31"], "is not a date"),
        (["/a", "publish", "/x", "--at", "0001-01-01"], "is not a date"),
        (["--who", "publish", "/x", "--reach", "/a"], "exclude each other"),
        (["--reach", "/a", "--vendor", "fastdds"], "--reach takes only --vendor zenoh"),
        (["--reach", "/a", "--at", "90d"], "--reach takes no --at"),
        (["--log", "-", "--vendor", "zenoh"], "Leave it out. RMW_IMPLEMENTATION can say which"),
        (["--who", "publish", "/x", "--all-vendors"], "--who takes no --all-vendors"),
        (["--who", "publish", "/x", "--policy", "p.xml"], "p.xml' does not exist"),
        (
            ["ks", "--who", "publish", "/x", "--policy", "p.xml"],
            "takes either a keystore or a policy",
        ),
        (["--who", "join", "--policy", "p.xml", "--vendor", "zenoh"], "on Zenoh takes no policy"),
        (["--who", "join", "--policy", "p.xml", "--robot", "r1"], "--robot takes a keystore"),
        (["--log", "-", "--policy", "p.xml"], "the log '-' cannot be read"),
        ([str(POLICY), "--log", "l", "--policy", "p.xml"], "two policies are named, '"),
        (["/a", "publish", "/x", "--infrastructure"], "goes with --reach only"),
        ([], "no keystore is named"),
    ],
)
def test_wrong_usage(words: list[str], said: str) -> None:
    found = explain(*words, "--policy", POLICY) if words and words[0] == "/a" else explain(*words)
    assert found.status == 2, found
    assert said in found.err or not words
    assert "Traceback" not in found.err


def test_call_is_of_a_service_unless_said_otherwise(whole: Path) -> None:
    assert answer(whole, ENCLAVE, "call", "/go")["question"]["type"] == "service"
    action = answer(whole, ENCLAVE, "call", "/go", "--type", "action")
    assert action["question"]["right"] == "call"
    assert len(action["parts"]) == 8
    assert answer(whole, ENCLAVE, "request", "/go")["question"]["right"] == "request"


SERVER, CLIENT = "/fibonacci/server", "/fibonacci/client"


@pytest.fixture(scope="module")
def fibonacci(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("fibonacci") / "ks"
    sros("create_keystore", root, "--template", "production").ok()
    sros("generate_artifacts", "-k", root, "-p", policies_dir() / "fibonacci.xml").ok()
    return root


@pytest.mark.parametrize(
    ("enclave", "word", "question", "status"),
    [
        (CLIENT, "call", "call action /fibonacci", 0),
        (SERVER, "call", "call action /fibonacci", 1),
        (SERVER, "serve", "execute action /fibonacci", 0),
        (CLIENT, "serve", "execute action /fibonacci", 1),
    ],
)
@pytest.mark.parametrize("by", ["keystore", "policy"])
def test_a_name_that_is_an_action_is_asked_about_as_one(
    enclave: str, word: str, question: str, status: int, by: str, fibonacci: Path
) -> None:
    place = (fibonacci,) if by == "keystore" else ("--policy", policies_dir() / "fibonacci.xml")
    words = (enclave, word, "/fibonacci")
    found = explain(*place, *words) if by == "keystore" else explain(*words, *place)
    assert found.status == status
    assert f" {question}, on " in found.out.splitlines()[0]
    assert ("note [explain.an-action]" in found.err) == (word == "serve")
    assert "<service>" not in found.out, "no right to a service is proposed"
    chosen = explain(*place, *words, "--type", "service")
    assert chosen.status == 1 and f"{word} service /fibonacci" in chosen.out
    assert "an-action" not in chosen.err


def test_permissions_of_another_enclave_that_fit_are_said(tmp_path: Path) -> None:
    """Cyclone DDS takes the permissions of /robot/mux for /mux, unless subjects are unique."""
    enclaves = {"/mux": publish("/t"), "/robot/mux": publish("/cmd_vel"), "/base": publish("/b")}
    (tmp_path / "p.xml").write_text(policy_text(enclaves))
    for template in ("sros2", "production"):
        keystore = tmp_path / template
        sros("create_keystore", keystore, "--template", template).ok()
        sros("generate_artifacts", "-k", keystore, "-p", tmp_path / "p.xml").ok()
        for vendor in ("cyclonedds", "fastdds"):
            fits = (template, vendor) == ("sros2", "cyclonedds")
            words = ("publish", "/cmd_vel", "--vendor", vendor)
            who = explain(keystore, "--who", *words).ok().out.splitlines()
            line = (
                "/mux  with the permissions of /robot/mux, which fit the certificate of /mux, too"
            )
            assert who[:-1] == [line] * fits + ["/robot/mux"]
            assert who[-1].endswith(
                "; 1 more may do so with the permissions of another enclave" if fits else "/cmd_vel"
            )
            assert explain(keystore, "--who", *words, "--match", "/mux").status == 1 - fits
            single = explain(keystore, "/mux", *words)
            assert ("with the permissions of /robot/mux: they fit the" in single.err) is fits
        reach = explain(keystore, "--reach", "/mux").ok().err
        assert ("can also use the permissions of /robot/mux" in reach) is (template == "sros2")
        shutil.move(keystore / "enclaves/robot/mux/key.pem", tmp_path / "key.pem")
        single = explain(keystore, "/mux", "publish", "/cmd_vel", "--vendor", "cyclonedds")
        assert ("with the permissions of /robot/mux" in single.err) is (template == "sros2")
        (keystore / "enclaves/mux/cert.pem").write_text("broken")
        reach = explain(keystore, "--reach", "/mux").ok().err
        assert "the permissions of /robot/mux" not in reach  # no process can run as /mux


def test_permissions_of_another_enclave_fit_no_expired_certificate(tmp_path: Path) -> None:
    """The other enclave was renewed."""
    enclaves = {"/mux": publish("/t"), "/robot/mux": publish("/cmd_vel")}
    (tmp_path / "p.xml").write_text(policy_text(enclaves))
    text = (templates_dir() / "sros2.toml").read_text()
    authority, *others = text.split("10y")
    (tmp_path / "t.toml").write_text(f"{authority}10y{'365d'.join(others)}")
    keystore, then = tmp_path / "ks", now() - timedelta(days=300)
    create_keystore(keystore, str(tmp_path / "t.toml"), now=then)
    generate(keystore, tmp_path / "p.xml", now=then)
    renew(keystore, ["/robot/mux"])
    asked = ("publish", "/cmd_vel", "--vendor", "cyclonedds")
    for later, fits in (("1d", True), ("90d", False)):
        who = explain(keystore, "--who", *asked, "--at", later).ok().out
        single = explain(keystore, "/mux", *asked, "--at", later).err
        assert [" the permissions of /robot/mux" in said for said in (who, single)] == [fits] * 2


def test_a_name_that_is_an_action_is_asked_about_as_one_of_everybody(fibonacci: Path) -> None:
    for word, right, who in (("call", "call", CLIENT), ("serve", "execute", SERVER)):
        found = explain(fibonacci, "--who", word, "/fibonacci")
        may = f"1 of 2 enclaves may {right} action /fibonacci\n"
        assert (found.status, found.out) == (0, f"{who}\n{may}")
        assert ("note [explain.an-action]" in found.err) == (word == "serve")
    as_action = explain(fibonacci, "--who", "call", "/fibonacci", "--type", "action")
    assert as_action.out.splitlines()[0] == CLIENT
    assert "an-action" not in as_action.err
    assert "an-action" not in explain(fibonacci, "--who", "call", "/nothing").err
    assert "an-action" not in explain(fibonacci, CLIENT, "call", "/nothing").err


def test_a_topic_that_is_an_action_is_noted(fibonacci: Path) -> None:
    for word in ("publish", "subscribe"):
        found = explain(fibonacci, CLIENT, word, "/fibonacci")
        assert found.status == 1
        assert "note [explain.no-topic]" in found.err
        assert "/fibonacci is an action, not a topic: ask about call" in found.err
    assert "no-topic" not in explain(fibonacci, CLIENT, "publish", "/nothing").err


def test_a_part_of_an_action_is_told_as_the_action(fibonacci: Path) -> None:
    """A subscription alone does not give the right to command the server."""
    for enclave, word, part, added, asked in (
        (CLIENT, "publish", "feedback", '<actions execute="ALLOW">', "execute"),
        (SERVER, "call", "send_goal", '<actions call="ALLOW">', "call"),
        (SERVER, "subscribe", "status", '<topics subscribe="ALLOW">', "call"),
    ):
        found = explain(fibonacci, enclave, word, f"/fibonacci/_action/{part}")
        assert found.status == 1 and added in found.out
        assert f"ask about `{asked} /fibonacci --type action`" in found.err
    meant = "the enclave may call action /fibonacci: perhaps the right name (add --type action)"
    assert f"[explain.likely-name]: {meant}." in explain(fibonacci, CLIENT, "call", "/fibonaci").err
    allowed = explain(fibonacci, CLIENT, "subscribe", "/fibonacci/_action/status")
    assert allowed.status == 0 and "part-of-action" not in allowed.err


def test_an_action_is_one_where_wildcards_allow_services(tmp_path: Path) -> None:
    root = tmp_path / "ks"
    sros("create_keystore", root).ok()
    sros("generate_artifacts", "-k", root, "-p", policies_dir() / "fibonacci.xml").ok()
    sros("create_enclave", root, "/everything").ok()
    found = explain(root, "--who", "call", "/fibonacci")
    assert CLIENT in found.out and "/everything  by the wildcard" in found.out
    assert "may call action /fibonacci" in found.out


def test_a_name_that_is_a_service_as_well_stays_one(tmp_path: Path) -> None:
    policy = tmp_path / "p.xml"
    policy.write_text(
        '<policy version="0.2.0"><enclaves><enclave path="/a"><profiles>'
        '<profile ns="/" node="a"><actions call="ALLOW"><action>/go</action></actions>'
        '<services reply="ALLOW"><service>/go</service></services></profile>'
        "</profiles></enclave></enclaves></policy>"
    )
    found = explain("/a", "call", "/go", "--policy", policy)
    assert found.status == 1 and "may not call service /go" in found.out
    assert "add --type action" in found.err


@pytest.mark.parametrize("by_policy", [False, True])
def test_a_change_invents_no_node(by_policy: bool, tmp_path: Path) -> None:
    root, policy = tmp_path / "ks", tmp_path / "p.xml"
    sros("create_keystore", root, "--template", "production").ok()
    sros("create_enclave", root, "/arm/driver").ok()
    if by_policy:  # one whose permissions name no node, not even by a wildcard
        policy.write_text(
            '<policy version="0.2.0"><enclaves><enclave path="/arm/driver"><profiles>'
            '<profile ns="/" node="n"><topics publish="ALLOW"><topic>/y</topic></topics></profile>'
            "</profiles></enclave></enclaves></policy>"
        )
        sros("create_permission", root, "/arm/driver", policy).ok()
    found = explain(root, "/arm/driver", "publish", "/x")
    assert '<profile ns="/" node="*">' in found.out


def test_a_policy_that_is_asked_in_place_of_the_keystore_of_the_environment_is_said(
    whole: Path,
) -> None:
    asked = (ENCLAVE, "publish", "/chatter", "--policy", POLICY)
    note = "note [explain.policy-alone]"
    assert note in explain(*asked, env={"ROS_SECURITY_KEYSTORE": str(whole)}).err
    assert note not in explain(*asked).err
    assert note not in explain(whole, *asked, env={"ROS_SECURITY_KEYSTORE": str(whole)}).err


def test_a_change_is_for_the_node_that_the_permissions_are_for(whole: Path) -> None:
    node = read_policy(POLICY).enclaves[0].all_profiles()[0]
    found = explain(whole, ENCLAVE, "publish", "/nothing")
    assert f'<profile ns="{node.ns}" node="{node.node}">' in found.out
    own = f"{node.ns.rstrip('/')}/{node.node}/get_parameters"
    meant = explain(whole, ENCLAVE, "serve", "/elsewhere/get_parameters")
    assert f"note [explain.likely-name]: the enclave may serve {own}" in meant.err
    assert "may publish /chatter: " in explain(whole, ENCLAVE, "publish", "/chater").err
    rules = "-r /front/chatter:=/chatter, or the policy may lack --remap /chatter:=/front/chatter, "
    rules += "or a remapping or parameter makes the node use the wrong /front/chatter)."
    assert rules in explain(whole, ENCLAVE, "publish", "/front/chatter").err
    assert "may publish /chatter: " in explain(whole, "--who", "publish", "/chater").err
    assert "may publish /chatter: " in explain(whole, ENCLAVE, "publish", "/chattre").err
    assert "likely-name" not in found.err
    unused = (
        "[explain.not-used]: no enclave that was read has a right to subscribe exactly /nothing"
    )
    assert unused in found.err and "this node lacks a remapping" in found.err
    assert "/nothing, nor a wildcard that matches it: perhaps no other node needs" in found.err
    assert "not-used" not in explain(whole, ENCLAVE, "publish", "/rosout").err


_MAY_MATCH = ", but a right with a wildcard may match it. If none does, perhaps"


@pytest.mark.parametrize(
    ("most", "others", "said"),
    [
        (
            200,
            "rt/map_*",
            "; by a wildcard, /b may subscribe topic /map_*. If /b does not use /map_a, perhaps",
        ),
        (200, "rt/cap_*", ", nor a wildcard that matches it: perhaps"),
        (200, "*", _MAY_MATCH),  # as permissions that sros did not write
        (200, "</topic>", _MAY_MATCH),  # no permissions
        (0, "rt/map_*", _MAY_MATCH),  # not read
    ],
)
def test_a_wildcard_that_matches_a_name_of_nobody_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most: int, others: str, said: str
) -> None:
    monkeypatch.setattr("sros_tool.explain.asking._MOST_READ", most)
    enclaves = {"/a": publish("/x"), "/b": subscribe("/map_*")}
    (policy := tmp_path / "p.xml").write_text(policy_text(enclaves))
    sros("create_keystore", tmp_path / "ks").ok()
    sros("generate_artifacts", "-k", tmp_path / "ks", "-p", policy).ok()
    permissions = tmp_path / "ks" / "enclaves" / "b" / "permissions.p7s"
    permissions.write_bytes(permissions.read_bytes().replace(b"rt/map_*", others.encode()))
    assert said in explain(tmp_path / "ks", "/a", "publish", "/map_a").err
    if most and others == "rt/map_*":
        assert said in explain(policy, "/a", "publish", "/map_a").err


def test_a_key_that_stays_on_its_robot(keystore: Path, tmp_path: Path) -> None:
    sros("create_request", "/arm", tmp_path / "robot").ok()
    request = tmp_path / "robot/enclaves/arm/request.pem"
    sros("sign_request", keystore, request, "-o", tmp_path / "a.tar.gz").ok()
    assert not (keystore / "enclaves/arm/key.pem").exists()
    assert explain(keystore, "/arm", "publish", "/chatter").status == 0
    assert "/arm" in explain(keystore, "--who", "publish", "/chatter").out
    (keystore / "enclaves/arm/request.pem").unlink()
    missing = explain(keystore, "/arm", "publish", "/chatter")
    assert missing.status == 1 and "key.pem: missing" in missing.out


def test_the_policy_that_is_not_named_is_told_by_its_digest(whole: Path) -> None:
    digest = read_policy(POLICY).enclaves[0].digest
    found = explain(whole, ENCLAVE, "publish", "/chatter")
    assert f"digest {digest[:12]}" in found.out
    assert answer(whole, ENCLAVE, "publish", "/chatter")["policy_sha256"] == digest
    named = explain(whole, ENCLAVE, "publish", "/chatter", "--policy", POLICY)
    assert digest[:12] not in named.out


@pytest.mark.parametrize("template", ["development", "production"])
def test_the_default_of_the_template_is_no_policy_file(template: str, tmp_path: Path) -> None:
    root = tmp_path / "ks"
    sros("create_keystore", root, "--template", template).ok()
    sros("create_enclave", root, "/plain").ok()
    found = explain(root, "/plain", "publish", "/parameter_events")
    assert found.status == 0
    assert "from      the default of the keystore's template" in found.out
    assert "digest" not in found.out and "--policy" not in found.out


def test_a_name_that_is_no_utf_8_is_refused(keystore: Path) -> None:
    for words in (("/\udcff", "join"), ("--reach", "/\udcff")):
        found = explain(keystore, *words)
        assert found.status == 2 and "is not a valid enclave name" in found.err, found


# ── who, and reach ─────────────────────────────────────────────────────────────────────────


def test_who(keystore: Path) -> None:
    found = explain(keystore, "--who", "publish", "/chatter")
    may = "enclaves may publish topic /chatter\n"
    assert (found.status, found.out) == (0, f"{ENCLAVE}\n1 of 2 {may}")
    assert found.err.startswith("decided by Fast DDS 2.14 (")
    env: dict[str, str | None] = {"ROS_SECURITY_KEYSTORE": str(keystore)}
    assert explain("--who", "subscribe", "/chatter", env=env).out.startswith(OTHER)
    nobody = explain(keystore, "--who", "publish", "/nothing")
    assert (nobody.status, nobody.out) == (1, "0 of 2 enclaves may publish topic /nothing\n")
    told = answer(keystore, "--who", "publish", "/chatter")
    assert {each["enclave"]: each["allowed"] for each in told["enclaves"]} == {
        ENCLAVE: True,
        OTHER: False,
    }


def revoked_notes(*words: str | Path) -> str:
    """Return the notes on revoked enclaves that ``explain`` prints."""
    lines = explain(*words).err.splitlines()
    return "\n".join(line for line in lines if "explain.revoked-enclaves" in line)


def test_a_revoked_enclave_that_processes_without_the_list_still_accept(
    keystore: Path, tmp_path: Path
) -> None:
    asked = (keystore, "--who", "publish", "/chatter")
    assert not revoked_notes(*asked)
    sros("revoke", keystore, ENCLAVE).ok()
    assert explain(*asked).out == "0 of 1 enclave may publish topic /chatter\n"
    note = f"revoked certificates of {ENCLAVE} have the right. A process without the current rev"
    assert note in revoked_notes(*asked)
    assert not revoked_notes(*asked, "--at", "2090-01-01")
    # What its permissions deny is not said of it, and what they lack is not known.
    assert not revoked_notes(keystore, "--who", "publish", "/nothing")
    (permissions,) = (keystore / "revoked").glob("*/permissions.p7s")
    kept = permissions.read_bytes()
    permissions.write_bytes(kept + b"changed")
    other = (keystore, "--who", "publish", "/nothing")
    assert (
        "work with permissions that are not here, whose rights are not known. A"
        in revoked_notes(*other)
    )
    permissions.write_bytes(kept)
    (keystore / "ledger.jsonl").rename(keystore / "kept")
    assert "accept revoked certificates: ledger.jsonl is missing" in revoked_notes(*other)
    (keystore / "kept").rename(keystore / "ledger.jsonl")
    # An enclave whose certificate ends much earlier has a date of its own.
    settings = keystore / "sros.toml"
    entry = '[[enclaves]]\nnames = ["/brief"]\nvalidity = "3d"\n'
    settings.write_text(settings.read_text() + entry)
    (policy := tmp_path / "brief.xml").write_text(policy_text({"/brief": publish("/chatter")}))
    sros("generate_artifacts", "-k", keystore, "-p", policy).ok()
    sros("revoke", keystore, "/brief").ok()
    day = "[0-9-]{10}T[0-9:]{8}Z"
    dates = rf"accepts them, until {day} \({ENCLAVE}\), {day} \(/brief\): each process"
    assert re.search(dates, revoked_notes(*asked))


@pytest.mark.parametrize("vendor", ["fastdds", "zenoh"])
def test_an_enclave_that_was_removed_without_a_revocation(vendor: str, keystore: Path) -> None:
    asked = ("explain", keystore, "--who", "publish", "/chatter", "--vendor", vendor)
    sros("zenoh", keystore).ok()
    assert "removed-enclaves" not in sros(*asked).ok().err
    shutil.rmtree(keystore / f"enclaves{ENCLAVE}")
    note = f"note [explain.removed-enclaves]: {ENCLAVE} was removed from the keystore, and not "
    assert note in sros(*asked).err
    assert "removed-enclaves" not in sros(*asked, "--at", "2090-01-01").err
    again = f"create the enclave again (`sros create_enclave {keystore} {ENCLAVE}`), and run `sros"
    assert again in sros("revoke", keystore, ENCLAVE).err
    sros("create_enclave", keystore, ENCLAVE).ok()
    sros("revoke", keystore, ENCLAVE).ok()
    assert "removed-enclaves" not in sros(*asked).err


def test_a_revoked_enclave_with_earlier_permissions(keystore: Path, tmp_path: Path) -> None:
    policy = tmp_path / "robot.xml"
    policy.write_text(policy_text({ENCLAVE: publish("/other")}))
    sros("create_permission", keystore, ENCLAVE, policy).ok()
    sros("revoke", keystore, ENCLAVE).ok()
    asked = (keystore, "--who", "publish")
    assert (
        f"certificates of {ENCLAVE} work with permissions that are not here, whose"
        in revoked_notes(*asked, "/chatter")
    )
    assert f"certificates of {ENCLAVE} have the right" in revoked_notes(*asked, "/other")


@pytest.mark.parametrize("template", ["development", "production"])
def test_a_certificate_that_was_revoked_when_its_enclave_got_another(
    template: str, tmp_path: Path
) -> None:
    """In production, the permissions of the new certificate do not fit the revoked one."""
    keystore = tmp_path / "ks"
    sros("create_keystore", keystore, "--template", template).ok()
    sros("generate_artifacts", "-k", keystore, "-e", ENCLAVE, "-p", POLICY).ok()
    asked = (keystore, "--who", "publish")
    assert not revoked_notes(*asked, "/chatter")
    sros("renew", keystore, ENCLAVE, "--new-key", "--revoke-old").ok()
    note = f"revoked certificates of {ENCLAVE} have the right. A process without the current revoc"
    assert note in revoked_notes(*asked, "/chatter")
    assert not revoked_notes(*asked, "/nothing")
    assert not revoked_notes(*asked, "/chatter", "--at", "2090-01-01")


def test_a_revoked_certificate_on_zenoh(keystore: Path) -> None:
    asked = (keystore, "--who", "publish", "/chatter", "--vendor", "zenoh")
    sros("zenoh", keystore).ok()
    assert not revoked_notes(*asked)
    sros("revoke", keystore, ENCLAVE).ok()
    note = f"revoked certificates of {ENCLAVE} have the right. A process without the current Zenoh"
    assert note in revoked_notes(*asked)
    assert not revoked_notes(keystore, "--who", "publish", "/nothing", "--vendor", "zenoh")
    sros("generate_artifacts", "-k", keystore, "-e", ENCLAVE, "-p", POLICY).ok()
    again = f"whoever kept a revoked certificate of {ENCLAVE} and its key may do it, too"
    assert again in revoked_notes(*asked)
    note = f"revoked certificates of {ENCLAVE} have the right. A process without the current revoc"
    assert note in revoked_notes(keystore, "--who", "publish", "/chatter")
    sros("rotate_ca", keystore, "--finish").ok()
    assert not revoked_notes(*asked)


def test_earlier_permissions_that_still_allow_it(keystore: Path, tmp_path: Path) -> None:
    policy = tmp_path / "robot.xml"
    policy.write_text(policy_text({ENCLAVE: publish("/other")}))
    asked = ("publish", "/chatter")
    assert "earlier-permissions" not in explain(keystore, OTHER, *asked).err
    sros("create_permission", keystore, ENCLAVE, policy).ok()
    for words in ((keystore, ENCLAVE), (keystore, "--who")):
        denied = explain(*words, *asked)
        assert denied.status == 1
        assert f"the rights in earlier permissions of {ENCLAVE} are not known here: " in denied.err
        assert "signed from an earlier policy" in denied.err
    assert "earlier-permissions" not in explain(keystore, "--who", "publish", "/other").err
    settings = keystore / "sros.toml"
    brief = '[[enclaves]]\nnames = ["/brief"]\nvalidity = "3d"\n'
    settings.write_text(settings.read_text() + brief)
    for topic in ("/chatter", "/other"):
        policy.write_text(policy_text({"/brief": publish(topic)}))
        sros("generate_artifacts", "-k", keystore, "-p", policy).ok()
    day = "[0-9-]{10}T[0-9:]{8}Z"
    dates = rf"has the rights until {day} \({ENCLAVE}\), {day} \(/brief\)\. To end this"
    assert re.search(dates, explain(keystore, "--who", *asked).err)
    sros("revoke", keystore, "/brief").ok()
    ledger = keystore / "ledger.jsonl"
    lines = ledger.read_text().splitlines(keepends=True)
    earlier = next(
        n for n, line in enumerate(lines) if f'permissions","enclave":"{ENCLAVE}' in line
    )
    ledger.write_text("".join((*lines[:earlier], "damaged\n", *lines[earlier + 1 :])))
    denied = explain(keystore, "--who", *asked)
    assert (
        "it is not known whether earlier permissions may still allow it: ledger.jsonl:"
        in denied.err
    )
    ledger.write_text("".join(lines))
    sros("renew", keystore, ENCLAVE, "--revoke-old").ok()
    assert "earlier-permissions" not in explain(keystore, "--who", *asked).err
    ledger.write_text("damaged")
    for _ in range(2):
        denied = explain(keystore, "--who", *asked)
        assert denied.status == 1
        for unknown in ("earlier permissions may still allow it", "still accept revoked certifi"):
            (line,) = (line for line in denied.err.splitlines() if unknown in line)
            assert "it is not known whether " in line
            assert "`sros check " in line or "Restore" in line, line
        if ledger.is_file():
            ledger.unlink()
            ledger.mkdir()


@pytest.mark.parametrize("vendor", ["fastdds", "cyclonedds"])
def test_earlier_files_of_an_enclave_whose_present_files_have_expired(
    vendor: str, keystore: Path
) -> None:
    note = f"the present files of {ENCLAVE} do not work, but whoever kept earlier files may still"
    asked = ("publish", "/chatter", "--vendor", vendor)
    settings = keystore / "sros.toml"
    settings.write_text(
        settings.read_text().replace('"/operator/*"', f'"/operator/*", "{ENCLAVE}"')
    )
    sros("update_keystore", keystore, "--take-edits").ok()
    assert note not in explain(keystore, "--who", *asked).ok().err
    renew(keystore, [ENCLAVE], now=now() - timedelta(days=3))
    for words in ((keystore, ENCLAVE), (keystore, "--who")):
        denied = explain(*words, *asked)
        assert denied.status == 1 and note in denied.err, denied
        assert note not in explain(*words, "publish", "/other", *asked[2:]).err
        assert note not in explain(*words, *asked, "--at", "2090-01-01").err
    assert note in explain(keystore, ENCLAVE, "join", *asked[2:]).err
    renew(keystore, [ENCLAVE], revoke_old=True, now=now() - timedelta(days=3))
    assert note not in explain(keystore, "--who", *asked).err


@pytest.mark.parametrize("role", ["--permissions", "--identity"])
def test_earlier_permissions_of_a_ca_that_is_retired(
    keystore: Path, role: str, tmp_path: Path
) -> None:
    policy = tmp_path / "robot.xml"
    policy.write_text(policy_text({ENCLAVE: publish("/other")}))
    sros("create_permission", keystore, ENCLAVE, policy).ok()
    asked = (keystore, "--who", "publish", "/chatter")
    sros("rotate_ca", keystore, role, "--to", "distribute").ok()
    assert "earlier-permissions" in explain(*asked).err
    sros("rotate_ca", keystore, role, "--finish").ok()
    # with a new identity CA alone, earlier permissions fit the certificate from the new one
    assert ("earlier-permissions" in explain(*asked).err) is (role == "--identity")


def test_who_tells_wildcards_and_what_cannot_run(keystore: Path) -> None:
    sros("create_enclave", keystore, "/open").ok()
    BREAKAGES["certificate expired"](Enclave(keystore))
    found = explain(keystore, "--who", "publish", "/chatter")
    assert "/open  by the wildcard rt/*" in found.out
    assert f"cannot start: {ENCLAVE}  cert.pem: it expired" in found.out
    assert "1 of 3 enclaves may publish topic /chatter" in found.out


def test_reach(whole: Path) -> None:
    found = explain(whole, "--reach", ENCLAVE)
    assert found.status == 0
    assert f"{ENCLAVE} can influence 1 enclave\n" in found.out
    assert f"  {ENCLAVE} -publish /chatter-> {OTHER}\n" in found.out
    assert f"{ENCLAVE} can learn from 0 enclaves\n" in found.out
    assert "/parameter_events" in found.err
    told = answer(whole, "--reach", ENCLAVE, "--infrastructure")
    assert [each["enclave"] for each in told["learns_from"]] == [OTHER]
    assert told["learns_from"][0]["path"][0]["name"] == "/parameter_events"
    policy = answer("--reach", ENCLAVE, "--policy", POLICY)
    assert [each["enclave"] for each in policy["influences"]] == [OTHER]
    assert explain(whole, "--reach", "/nobody").status == 2


# ── completion ─────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("line", "offered"),
    some(
        [
            ("{ks} /", [ENCLAVE, OTHER]),
            ("{ks} /a p", ["publish"]),
            ("{ks} /a publish /cha", ["/chatter"]),
            ("{ks} /a execute /", []),
            ("/a s", ["subscribe", "serve"]),
            ("--keystore {ks} /talker_listener/t", [ENCLAVE]),
            ("--reach /talker_listener/l", [OTHER]),
            ("{ks} --reach /talker_listener/l", [OTHER]),
            ("{ks} --who s", ["subscribe", "serve"]),
        ],
        3,
    ),
)
def test_completion(line: str, offered: list[str], whole: Path) -> None:
    words = f"sros explain {line.format(ks=whole)}"
    environment = {
        **os.environ,
        "ROS_SECURITY_KEYSTORE": str(whole) if "{ks}" not in line else "",
        "_SROS_COMPLETE": "bash_complete",
        "COMP_WORDS": words,
        "COMP_CWORD": str(len(words.split()) - 1),
    }
    script = "from sros_tool.cli import main; main()"
    ended = python("-c", script, env=environment)
    assert set(ended.stdout.split()) == {f"plain,{each}" for each in offered}, ended


@pytest.mark.parametrize(
    ("fault", "remedy"),
    [("governance unsigned", "governance.p7s"), ("permissions unsigned", "create_permission")],
)
def test_the_remedy_is_for_the_file_that_is_at_fault(
    fault: str, remedy: str, keystore: Path
) -> None:
    BREAKAGES[fault](Enclave(keystore))
    told = explain(keystore, ENCLAVE, "publish", "/chatter")
    assert told.status == 1
    assert remedy in told.out.partition("  remedy ")[2], told.out


def test_the_distribution_of_the_robot_decides(tmp_path: Path) -> None:
    (tmp_path / "policy.xml").write_text(policy_text({"/{robot}/a": publish("/x")}))
    (tmp_path / "fleet.toml").write_text('[robots]\nr1 = { distribution = "humble" }\nr2 = {}\n')
    root = tmp_path / "ks"
    sros("create_keystore", root).ok()
    made = ("-k", root, "-p", tmp_path / "policy.xml", "--fleet", tmp_path / "fleet.toml")
    sros("generate_artifacts", *made).ok()
    asked = ("/r1/a", "publish", "/x")
    assert "as in ROS 2 Humble)" in explain(root, *asked).out
    assert "on Fast DDS 3.6" in explain(root, *asked, "--distro", "lyrical").out
    assert "Humble" not in explain(root, "/r2/a", "publish", "/x").out
    who = explain(root, "--who", "publish", "/x")
    assert "Fast DDS 2.6 for enclaves whose distribution is stated" in who.err
    assert "is stated" not in explain(root, "--who", "publish", "/x", "--distro", "lyrical").err
    only = explain(root, "--who", "publish", "/x", "--robot", "r1", env={"ROS_DISTRO": "foo"})
    assert "decided by Fast DDS 2.6 (" in only.err and "is stated" not in only.err
    assert "foo" not in explain(root, *asked, env={"ROS_DISTRO": "foo"}).err
    (root / "sros.toml").write_text("[")  # which `sros check` reports
    assert explain(root, *asked).ok().out.startswith("yes")


def test_a_copy_without_keys_is_answered_as_if_they_were_there(whole: Path, tmp_path: Path) -> None:
    """Or who gets a copy to find out why a node is silent learns nothing."""
    copy = tmp_path / "copy"
    sros("distribute_key", whole, "--all", copy).ok()
    for key in copy.glob("enclaves/**/key.pem"):
        key.unlink()
    said = explain(copy, ENCLAVE, "publish", "/chatter").ok()
    assert "note [explain.without-keys]: no enclave in" in said.err
    assert "On the robot, `sros verify FOLDER`" in said.err, "the path here is of this machine"
    assert (
        "\n  key       missing here; the answer assumes that the process has the key\n" in said.out
    )
    assert answer(copy, ENCLAVE, "publish", "/chatter")["counts_key"]
    assert not answer(whole, ENCLAVE, "publish", "/chatter")["counts_key"]
    assert "no rule allows" in explain(copy, ENCLAVE, "publish", "/nothing").out
    found = sros("check", copy).out
    assert "If this is a copy without keys, nothing is wrong: `--exclude enclave.file" in found
    assert "hides this finding. Otherwise: " in found
    assert "key.pem: missing" in explain(copy, ENCLAVE, "join").out
    who = explain(copy, "--who", "publish", "/chatter")
    assert ENCLAVE in who.out and "explain.without-keys" in who.err
    assert explain_access(copy, ENCLAVE, "publish", "/chatter").counts_key
    assert not explain_access(copy, ENCLAVE, "join").counts_key
    assert "without-keys" not in explain(whole, ENCLAVE, "publish", "/chatter").ok().err
    (copy / f"enclaves{ENCLAVE}/request.pem").touch()  # its key was made on the robot
    assert "without-keys" not in explain(copy, ENCLAVE, "publish", "/chatter").ok().err
