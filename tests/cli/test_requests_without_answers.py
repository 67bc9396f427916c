"""Many requests signed at once, and enclaves exported without the keys that are on their robots."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from tests.support.children import run
from tests.support.harness import policy_text, publish, snapshot, sros, topics_of

pytestmark = pytest.mark.skipif(not shutil.which("openssl"), reason="the program openssl is needed")

A, B = "/r1/arm", "/r2/arm"


def ask(robot: Path, name: str) -> bytes:
    """Make a key and a request as a robot without sros does; return the request."""
    folder = robot / f"enclaves{name}"
    folder.mkdir(parents=True)
    for each in (folder, *folder.parents[:2]):
        each.chmod(0o700)
    settings = folder / "name.cnf"
    settings.write_text(f"[req]\nprompt=no\ndistinguished_name=name\n[name]\nCN={name}\n")
    key, request = folder / "key.pem", folder / "request.pem"
    curve = ("-pkeyopt", "ec_paramgen_curve:P-256")
    run(["openssl", "genpkey", "-algorithm", "EC", *curve, "-out", key])
    run(["openssl", "req", "-new", "-key", key, "-config", settings, "-out", request])
    key.chmod(0o600)
    settings.unlink()
    return request.read_bytes()


def test_requests_of_a_fleet(keystore: Path, tmp_path: Path) -> None:
    (tmp_path / "p.xml").write_text(policy_text({A: publish("one"), B: publish("two")}))
    robots = {A: tmp_path / "r1", B: tmp_path / "r2"}
    both = tmp_path / "both.pem"
    requests = {name: ask(robot, name) for name, robot in robots.items()}
    both.write_bytes(b"".join(requests.values()))
    words = ("sign_request", keystore, both, "--no-answer", "-p", tmp_path / "p.xml")
    before = snapshot(keystore)

    for bad, why in {
        b"".join([*requests.values(), requests[A]]): f"two requests are for enclave {A}",
        requests[A] + b"junk": "number 2",
        b" ": "the input has no signing request",
    }.items():
        (tmp_path / "bad.pem").write_bytes(bad)
        ended = sros("sign_request", keystore, tmp_path / "bad.pem", "--no-answer")
        assert (ended.status, why in ended.err) == (2, True), ended
    ended = sros(*words, "-o", tmp_path / "x.tgz")
    assert "leave out -o and --force" in ended.err
    for only in ([B, "/other"], [A], [A, B, B]):  # a robot chooses what its request says
        ended = sros(*words, *(word for each in only for word in ("--enclave", each)))
        why = f"number 1 is for enclave {A}, not for {B}, /other" if "/other" in only else "for "
        assert (ended.status, why in ended.err) == (2, True), ended
    sros(*words, "--dry-run").ok()
    assert snapshot(keystore) == before

    named = (*words, "--enclave", B, "--enclave", A)
    said = json.loads(sros(*named, "--json").ok().out)
    assert [(each["name"], each["outcome"]) for each in said["enclaves"]] == [
        (A, "created"),
        (B, "created"),
    ]
    assert said["answer"] is None
    after = snapshot(keystore)
    said = json.loads(sros(*named, "--json").ok().out)
    assert {each["outcome"] for each in said["enclaves"]} == {"kept"}
    assert snapshot(keystore) == after

    # One key for two enclaves is refused, with all other requests.
    third = ask(tmp_path / "r3", "/r3/arm")
    shutil.copytree(tmp_path / "r1/enclaves/r1/arm", tmp_path / "r4/enclaves/r4/arm")
    key = tmp_path / "r4/enclaves/r4/arm/key.pem"
    copied = run(["openssl", "req", "-new", "-key", key, "-subj", r"/CN=\/r4\/arm"]).stdout
    (tmp_path / "bad.pem").write_bytes(third + copied.encode())
    ended = sros("sign_request", keystore, tmp_path / "bad.pem", "--no-answer")
    assert (ended.status, "is the key of enclave" in ended.err) == (2, True), ended
    assert snapshot(keystore) == after

    # Exports bring what is missing next to the key.
    ended = sros("distribute_key", keystore, "--match", "/r1/*", tmp_path / "out")
    assert (ended.status, "They were made on their robots" in ended.err) == (2, True)
    for name, robot in robots.items():
        pattern = name.replace("arm", "*")
        said = sros("distribute_key", keystore, "--match", pattern, robot, "--keyless").ok().err
        assert "export.keys-included" not in said, "none is in the keystore"
        kept = (robot / f"enclaves{name}/key.pem").read_bytes()
        sros("distribute_key", keystore, "--match", pattern, robot, "--keyless", "--force").ok()
        assert (robot / f"enclaves{name}/key.pem").read_bytes() == kept, "the only copy"
        assert f"{name}  loadable" in sros("verify", robot).ok().out
        assert not (keystore / f"enclaves{name}/key.pem").exists()
    together = sros("distribute_key", keystore, A, B, tmp_path / "both", "--keyless").ok().err
    assert f"{A}, {B}: without their keys, which were made on their robots" in together
    assert topics_of(robots[B] / f"enclaves{B}") == {"rt/two", "ros_discovery_info"}

    # Renewing needs no new request, and so does --renew with one.
    sros("renew", keystore, A).ok()
    said = json.loads(sros(*words, "--renew", "--json").ok().out)
    assert {each["outcome"] for each in said["enclaves"]} == {"renewed"}
