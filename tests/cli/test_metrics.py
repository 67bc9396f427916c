"""The verb metrics: moments and counts as the files have them, read as Prometheus reads them."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families

from sros_tool.pki.certificates import validity_of
from sros_tool.runtime.processes import Process, ProcessTable, RunningProcesses, UnseenProcess
from tests.support.harness import certificate, policy_text, publish, sros

KINDS = {"certificate", "permissions", "governance", "identity_ca", "permissions_ca"}


def read(text: str) -> dict[str, dict[tuple[str, ...], float]]:
    """Return the values of each metric by the values of its labels but the keystore's."""
    return {
        family.name: {
            tuple(value for name, value in each.labels.items() if name != "keystore"): each.value
            for each in family.samples
        }
        for family in text_string_to_metric_families(text)
    }


def seconds(path: Path) -> float:
    return validity_of(certificate(path)).not_after.timestamp()


def test_the_expiry_of_every_file_and_the_findings(keystore: Path) -> None:
    sros("create_enclave", keystore, "/c").ok()
    sros("revoke", keystore, "/c").ok()
    found = read(sros("metrics", keystore).ok().out)
    expiry = found["sros_expiry_timestamp_seconds"]
    assert {kind for kind, _ in expiry} == {*KINDS, "crl"}
    for name in ("a", "b"):
        wanted = seconds(keystore / f"enclaves/{name}/cert.pem")
        assert expiry["certificate", f"/{name}"] == wanted
        assert ("permissions", f"/{name}") in expiry
    for role in ("identity", "permissions"):
        wanted = seconds(keystore / f"public/{role}_ca.cert.pem")
        assert expiry[f"{role}_ca", ""] == wanted
    assert expiry["governance", ""] == expiry["permissions_ca", ""]
    earliest = found["sros_earliest_expiry_timestamp_seconds"]
    for kind in (*KINDS, "crl"):
        assert earliest[kind,] == min(at for (each, _), at in expiry.items() if each == kind)
    assert found["sros_enclaves"][()] == 2
    assert found["sros_unreadable_enclaves"][()] == 0
    counts = json.loads(sros("check", keystore, "--severity", "note", "--json").out)["counts"]
    shown = {word: float(counts[word]) for word in ("error", "warning", "note")}
    assert {word: number for (word,), number in found["sros_findings"].items()} == shown
    assert sum(found.get("sros_findings_of_kind", {}).values()) == sum(shown.values())


def test_short_lived_enclaves_do_not_expire_first(tmp_path: Path) -> None:
    """They expire all the time, and a person renews them when they are needed."""
    home = tmp_path / "home"
    sros("create_keystore", home, "--template", "production").ok()
    sros("create_enclave", home, "/operator/anna", "/base").ok()
    found = read(sros("metrics", home).ok().out)
    earliest = found["sros_earliest_expiry_timestamp_seconds"]
    for kind in ("certificate", "permissions"):
        expiry = found["sros_expiry_timestamp_seconds"]
        assert expiry[kind, "/operator/anna"] < earliest[kind,] == expiry[kind, "/base"]


def test_the_running_processes_are_counted(keystore: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    process = Process(7, ("talker",), {}, datetime.now(UTC), network="net:[1]")
    asks = {"ROS_SECURITY_ENABLE": "true", "ROS_SECURITY_STRATEGY": "Enforce"}
    other = Process(9, ("gateway",), asks, datetime.now(UTC), frozenset({"libddsc"}))
    unknown = replace(other, libraries=frozenset({"librcl", "librmw_email_cpp", "libfastdds"}))
    unseen = UnseenProcess(8, ("init",), "Permission denied", uses_ros=False)
    running = RunningProcesses((process, other, unknown), (unseen,))
    monkeypatch.setattr(ProcessTable, "look", lambda *_: running)
    found = read(sros("metrics", keystore, "--runtime").ok().out)
    assert found["sros_processes"] == {("secured",): 0, ("open",): 1, ("unknown",): 2}
    assert found["sros_processes_not_seen"][()] == 1
    assert found["sros_process_findings"]["note", "runtime.process-elsewhere"] == 1
    assert "sros_processes" not in read(sros("metrics", keystore).ok().out)


def test_damage_is_counted_and_makes_no_error(keystore: Path) -> None:
    (keystore / "enclaves/a/cert.pem").write_text("damaged")
    found = read(sros("metrics", keystore).ok().out)
    assert found["sros_unreadable_enclaves"][()] == 1
    assert found["sros_findings"]["error",] >= 1
    assert found["sros_findings_of_kind"]["error", "enclave.certificate-malformed"] == 1
    assert ("certificate", "/a") not in found["sros_expiry_timestamp_seconds"]
    assert ("certificate", "/b") in found["sros_expiry_timestamp_seconds"]


def test_drift_from_a_policy_is_counted(keystore: Path, tmp_path: Path) -> None:
    policy = tmp_path / "p.xml"
    policy.write_text(policy_text({"/a": publish("new"), "/b": publish("old_b")}))
    found = read(sros("metrics", keystore, "--policy", policy).ok().out)
    assert found["sros_findings_of_kind"]["warning", "enclave.stale-permissions"] == 1
    assert sros("metrics", keystore, "--policy", tmp_path / "none").status == 2


def test_an_export_has_the_expiry_of_its_own_files(keystore: Path, tmp_path: Path) -> None:
    robot = tmp_path / "robot"
    sros("distribute_key", keystore, "/a", robot).ok()
    found = read(sros("metrics", robot).ok().out)
    names = {("certificate", "/a"), ("permissions", "/a")}
    names |= {("identity_ca", "/a"), ("permissions_ca", "/a")}
    assert found["sros_expiry_timestamp_seconds"].keys() == names
    found = read(sros("metrics", robot, "--earliest").ok().out)
    assert "sros_expiry_timestamp_seconds" not in found
    assert len(found["sros_earliest_expiry_timestamp_seconds"]) == 4


def test_a_file_is_replaced_at_once_and_others_can_read_it(keystore: Path, tmp_path: Path) -> None:
    output = tmp_path / "sros.prom"
    before = os.umask(0o022)
    try:
        sros("metrics", keystore, "-o", output, "--dry-run").ok()
        assert not output.exists()
        sros("metrics", keystore, "-o", output).ok()
        first = output.stat()
        sros("metrics", keystore, "-o", output).ok()
    finally:
        os.umask(before)
    assert output.stat().st_ino != first.st_ino
    assert output.stat().st_mode & 0o777 == 0o644
    assert read(output.read_text()).keys() >= {"sros_enclaves", "sros_findings"}
    assert list(tmp_path.glob("*.prom")) == [output]
    kept = output.read_text()
    refused = sros("metrics", tmp_path / "nothing", "-o", output)
    assert refused.status == 2 and len(refused.err.splitlines()) == 1
    assert output.read_text() == kept


@pytest.mark.parametrize("name", ["sros.txt", "sros", "policy.xml"])
def test_a_file_that_node_exporter_would_not_read_is_refused(
    name: str, keystore: Path, tmp_path: Path
) -> None:
    refused = sros("metrics", keystore, "-o", tmp_path / name)
    assert refused.status == 2 and "does not end in .prom" in refused.err
    assert not (tmp_path / name).exists()


def test_a_path_adds_no_series(keystore: Path, tmp_path: Path) -> None:
    odd = keystore.rename(tmp_path / 'k"} 1\nsros_findings{severity="error"} 0\x1b')
    shown = sros("metrics", odd).ok().out
    assert "\x1b" not in shown
    (family,) = (e for e in text_string_to_metric_families(shown) if e.name == "sros_enclaves")
    (sample,) = family.samples
    assert sample.value == 2
    assert sample.labels["keystore"].endswith('k"} 1\\x0asros_findings{severity="error"} 0\\x1b')
