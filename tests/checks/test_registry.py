"""Every kind of finding is data that is complete, and has a test that brings it about."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from sros_tool.checks.formats import sarif
from sros_tool.checks.kind import ERROR, NOTE, WARNING, FindingFilter, Severity, all_kinds
from sros_tool.dds.decision.vendors import Vendor
from sros_tool.errors import UsageError
from sros_tool.runtime.processes import ProcessTable, RunningProcesses, UnseenProcess
from tests.checks import (
    keystore_cases,
    policy_cases,
    runtime_cases,
    test_policy_findings,
    test_trust,
    zenoh_cases,
)
from tests.checks.bench import Bench
from tests.cli import test_requirements
from tests.fleet import test_status
from tests.proof import test_crossing, test_decisions, test_review, test_upgrade
from tests.support.harness import sros
from tests.support.tables import for_every

pytest_plugins = ["tests.checks.sound_keystore"]


def test_every_finding_has_a_test_that_brings_it_about() -> None:
    """Each of these tables is run by a test that sees the finding, and does not see it before."""
    tested = {
        *(case.id for case in policy_cases.CASES),
        *test_policy_findings.FOUND_OTHERWISE,
        *test_trust.FOUND,
        *keystore_cases.CASES,
        *runtime_cases.CASES,
        *zenoh_cases.CASES,
        *test_requirements.CASES,
        *test_crossing.FOUND,
        *test_decisions.FOUND,
        *test_upgrade.FOUND,
        *test_review.FOUND,
        *test_status.FOUND,
    }
    assert tested == set(all_kinds())
    assert len(all_kinds()) >= 50


@for_every(all_kinds().values(), lambda kind: kind.id)
def test_kinds_are_complete(kind: Any) -> None:
    assert re.fullmatch(
        r"(policy|requirement|keystore|enclave|permissions|governance|portable|zenoh|runtime"
        r"|upgrade|distribution|review)\."
        r"[a-z0-9]+(-[a-z0-9]+)*",
        kind.id,
    )
    assert kind.title
    assert not kind.title.endswith(".")
    for text in (kind.why, kind.source, kind.remedy):
        assert text.endswith((".", ")")), text
        assert "  " not in text
    assert set(kind.vendors) <= {str(each) for each in Vendor}


def test_list() -> None:
    lines = sros("check", "--list").ok().out.splitlines()
    assert len(lines) == len(all_kinds())
    listed = json.loads(sros("check", "--list", "--json", "--include", "policy.*").ok().out)[
        "kinds"
    ]
    assert {each["id"] for each in listed} == {i for i in all_kinds() if i.startswith("policy.")}
    assert set(listed[0]) == {
        "id", "severity", "title", "why", "source", "remedy", "vendors",
    }  # fmt: skip


ONE, OTHER = all_kinds()["keystore.one-authority"], all_kinds()["portable.grant-name"]


@pytest.mark.parametrize(
    ("selection", "wanted"),
    [
        (FindingFilter(), {ONE, OTHER}),
        (FindingFilter(include=("keystore.*",)), {ONE}),
        (FindingFilter(exclude=("keystore.one-authority",)), {OTHER}),
        (FindingFilter(include=("keystore.*",), exclude=("*.one-*",)), set()),
        (FindingFilter(vendors=("cyclonedds",)), {ONE}),
        (FindingFilter(vendors=("fastdds",)), {ONE, OTHER}),
        (FindingFilter(severity=ERROR), set()),
    ],
)
def test_selection(selection: FindingFilter, wanted: set[Any]) -> None:
    found = [ONE.found("x", "y"), OTHER.found("x", "y")]
    assert {each.kind for each in selection.choose(found).shown} == wanted


def test_what_was_accepted_is_named_and_does_not_count() -> None:
    found = [ONE.found("x", "y", accepted="template sros2")]
    chosen = FindingFilter().choose(found)
    assert (chosen.shown, len(chosen.accepted)) == ((), 1)
    assert not chosen.fails(WARNING)
    assert FindingFilter(strict=True).choose(found).fails(WARNING)
    shown = FindingFilter(severity=NOTE).choose(found)
    assert [each.severity for each in shown.shown] == [NOTE]
    assert shown.fails(NOTE)
    assert not shown.fails(WARNING)


def test_an_id_that_there_is_not() -> None:
    with pytest.raises(UsageError):
        FindingFilter(include=("policy.nonsense",))


def test_groups_stand_for_their_kinds() -> None:
    kinds = [
        k for k in all_kinds().values() if FindingFilter(include=("enclave.not-loadable",)).wants(k)
    ]
    assert len(kinds) > 20
    assert all(kind.severity is Severity.ERROR for kind in kinds)


@pytest.mark.parametrize("one", ["note", "warning", "error"])
@pytest.mark.parametrize("other", ["note", "warning", "error"])
def test_a_severity_is_its_word_and_compares_by_weight(one: str, other: str) -> None:
    severity, weights = Severity(one), {"note": 1, "warning": 2, "error": 3}
    assert (severity == other) is (one == other)
    assert (severity >= other, severity > other, severity <= other, severity < other) == (
        weights[one] >= weights[other],
        weights[one] > weights[other],
        weights[one] <= weights[other],
        weights[one] < weights[other],
    )
    assert f"{severity}" == one == json.loads(json.dumps(severity))
    with pytest.raises(ValueError, match="loud"):
        assert severity < "loud"


# ── the command line ───────────────────────────────────────────────────────────────────────


def test_text_json_and_status(bench: Bench) -> None:
    sros("check", bench.root).ok()
    bench.path("enclaves/base/key.pem").chmod(0o644)
    ended = sros("check", bench.root)
    assert ended.status == 1
    assert "enclaves/base/key.pem: error: " in ended.out
    assert "1 error" in ended.err
    told = json.loads(sros("check", bench.root, "--json").out)
    assert told["counts"] == {
        "error": 1, "warning": 0, "note": 0, "accepted": 0, "hidden": 0,
    }  # fmt: skip
    (finding,) = told["findings"]
    assert set(finding) == {
        "id", "severity", "subject", "file", "line", "text", "remedy", "source", "accepted",
        "related",
    }  # fmt: skip
    assert finding["file"] == str(bench.path("enclaves/base/key.pem"))


@pytest.mark.parametrize(
    ("options", "status", "shown"),
    [
        ((), 1, True),
        (("--fail-on", "error"), 0, True),
        (("--fail-on", "never"), 0, True),
        (("--severity", "error"), 0, False),
        (("--exclude", "keystore.folder-open"), 0, False),
        (("--include", "keystore.*"), 1, True),
        (("--severity", "note", "--fail-on", "note"), 1, True),
        (("--severity", "error", "--fail-on", "warning"), 1, True),
    ],
)
def test_thresholds(options: tuple[str, ...], status: int, shown: bool, bench: Bench) -> None:
    bench.path("private").chmod(0o755)
    ended = sros("check", bench.root, *options)
    assert ended.status == status
    assert ("keystore.folder-open" in ended.out) == shown
    # A warning that is not shown is not called a note.
    assert ("not shown: 1 finding," in ended.err) is (options == ("--severity", "error"))


def without_types(bench: Bench) -> Path:
    """Take a right that every node needs out of the policy, and return its path."""
    policy = bench.root.with_name("policy.xml")
    policy.write_text(policy.read_text().replace("<service>~/get_type_description</service>", ""))
    return policy


def test_it_finds_out_what_a_path_is(bench: Bench, tmp_path: Path) -> None:
    bench.path("enclaves/base/key.pem").write_bytes(b"")
    policy = without_types(bench)
    for target in (bench.root, bench.path("enclaves/base"), bench.path("enclaves/base/cert.pem")):
        assert "enclave.file-empty" in sros("check", target).out
    for target in (policy, policy.parent / "policy.xml"):
        assert "policy.no-type-description" in sros("check", target).out
    assert "enclave.file-empty" not in sros("check", bench.path("enclaves/arm")).out
    both = sros("check", policy, bench.root).out
    assert "enclave.file-empty" in both
    assert "policy.no-type-description" in both
    (tmp_path / "policies").mkdir()
    (tmp_path / "policies/one.xml").write_text(policy.read_text())
    (tmp_path / "policies/part.xml").write_text("<profile/>")
    assert "policies/one.xml:1: error" in sros("check", "policies", cwd=tmp_path).out
    (tmp_path / "empty").mkdir()
    for wrong in ("gone", "empty"):
        assert sros("check", wrong, cwd=tmp_path).status == 2
        assert "Unable to check" in sros("check", wrong, cwd=tmp_path).err


def test_the_runtime_and_the_keystore_it_names(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ProcessTable, "look", lambda *_: RunningProcesses())
    env = {"ROS_SECURITY_ENABLE": "True", "ROS_SECURITY_KEYSTORE": str(bench.root)}
    ended = sros("check", env=env)
    assert ended.status == 1
    assert "runtime.enable-misspelt" in ended.out
    bench.path("enclaves/arm/key.pem").write_bytes(b"")
    assert "enclave.file-empty" in sros("check", env=env).out
    assert "enclave.file-empty" not in sros("check", "runtime", env=env).out


def test_what_could_not_be_looked_at_is_neither_nothing_nor_a_finding(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    unseen = UnseenProcess(9, ("talker", "--ros-args"), "Permission denied", uses_ros=True)
    monkeypatch.setattr(ProcessTable, "look", lambda *_: RunningProcesses(unseen=(unseen,)))
    ended = sros("check", "runtime")
    assert ended.status == 2
    assert "process 9 (talker): warning: processes that sros could not examine" in ended.out
    assert "Run the check as root" in ended.out
    by_root = RunningProcesses(unseen=(unseen,), is_run_by_root=True)
    monkeypatch.setattr(ProcessTable, "look", lambda *_: by_root)
    told = sros("check", "runtime").out
    assert "Run it as root" not in told and "CAP_SYS_PTRACE" in told
    assert sros("check", "runtime", env={"ROS_SECURITY_ENABLE": "True"}).status == 1
    for accepted in (("--exclude", "runtime.process-not-seen"), ("--fail-on", "error")):
        assert sros("check", "runtime", *accepted).status == 0


def test_at_domain_and_policy(bench: Bench) -> None:
    assert "enclave.certificate-expired" in sros("check", bench.root, "--at", "2099-01-01").out
    assert "enclave.governance-domain" in sros("check", bench.root, "--domain", "9").out
    policy = bench.root.with_name("policy.xml")
    sros("check", bench.root, "--policy", policy).ok()
    policy.write_text(policy.read_text().replace("status", "state"))
    assert "enclave.stale-permissions" in sros("check", bench.root, "--policy", policy).out
    env = {"ROS_SECURITY_ENABLE": "true", "ROS_SECURITY_KEYSTORE": str(bench.root)}
    earlier = sros("check", "runtime", "--at", "2020-01-01", env=env).out
    assert "runtime.clock-behind" not in earlier
    due = ("check", "keystore", bench.root, "--needs-renewal", "30d")
    sros(*due).ok()
    assert "/base" in sros(*due, "--at", "2099-01-01").out
    as_json = sros(*due, "--at", "2099-01-01", "--format", "json").out
    assert {each["enclave"] for each in json.loads(as_json)["enclaves"]} >= {"/base"}
    assert "/base" in sros(*due, "--at", "9000d").out
    for refused in ("--sarif", bench.root):
        assert sros(*due, refused).status == 2
    assert sros("check", "policy", bench.root, *due[-2:]).status == 2
    for wrong in (("--at", "soon"), ("--domain", "x"), ("--domain", ""), ("runtime", bench.root)):
        assert sros("check", *wrong).status == 2


def test_sarif(bench: Bench) -> None:
    """The properties that SARIF 2.1.0 requires, and those that code hosts need."""
    folder = without_types(bench).parent
    log = json.loads(sros("check", "policy.xml", "ks", "--sarif", cwd=folder).out)
    assert log["version"] == "2.1.0"
    assert log["$schema"].endswith("sarif-2.1.0.json")
    (run,) = log["runs"]
    driver = run["tool"]["driver"]
    assert driver["name"] == "sros"
    rules = driver["rules"]
    assert [each["id"] for each in rules] == list(all_kinds())
    for rule in rules:
        assert rule["defaultConfiguration"]["level"] in ("error", "warning", "note")
        assert all(rule[each]["text"] for each in ("shortDescription", "fullDescription", "help"))
    assert run["results"]
    for result in run["results"]:
        assert rules[result["ruleIndex"]]["id"] == result["ruleId"]
        assert result["level"] in ("error", "warning", "note")
        assert result["message"]["text"]
        (location,) = result["locations"]
        place = location["physicalLocation"]
        assert place["artifactLocation"]["uri"] == "policy.xml"
        assert place["region"]["startLine"] >= 1
        assert place["artifactLocation"]["uriBaseId"] in run["originalUriBaseIds"]


@pytest.mark.parametrize(
    ("subject", "shown"),
    [
        ("[read this](http://example.org)", r"\[read this\](http://example.org)"),
        (r"\[a](b)", r"\\\[a\](b)"),
        ("rt/[ab]", "rt/[ab]"),
    ],
)
def test_no_name_becomes_a_link_in_sarif(subject: str, shown: str, tmp_path: Path) -> None:
    """A viewer shows [text](target) in a message as a link (SARIF 2.1.0, 3.11.6)."""
    kind = next(iter(all_kinds().values()))
    log = sarif([kind.found(subject, "it is open")], [kind], version="1", base=tmp_path)
    (result,) = log["runs"][0]["results"]
    assert result["message"]["text"].startswith(f"{shown}: it is open")


def test_sarif_shows_what_was_accepted_as_suppressed(tmp_path: Path) -> None:
    sros("create_keystore", tmp_path / "ks", "--template", "sros2").ok()
    log = json.loads(sros("check", "ks", "--sarif", cwd=tmp_path).ok().out)
    (result,) = [r for r in log["runs"][0]["results"] if r["ruleId"] == "keystore.one-authority"]
    assert result["suppressions"][0]["justification"] == "template sros2"
    uri = result["locations"][0]["physicalLocation"]["artifactLocation"]["uri"]
    assert (tmp_path / uri).exists()
