"""The verbs env and run for rmw_zenoh_cpp: the variables that they give, and when they refuse."""

from __future__ import annotations

import json
import shutil
import socket
import sys
from pathlib import Path

import pytest

from sros_tool.keystore import zenoh_files
from sros_tool.keystore.reader import OpenedEnclave
from sros_tool.pki import smime
from sros_tool.runtime.environment import NO_CONFIGURATION, REFUSING, render_refusal
from tests.support.children import importing
from tests.support.harness import Ended, copy_of, forked, policy_text, publish, sros
from tests.support.zenoh_configurations import with_rmw_zenoh

ZENOH = ("--rmw", "rmw_zenoh_cpp")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a keystore that has Zenoh files; only to be copied."""
    folder = tmp_path_factory.mktemp("zenoh")
    (folder / "p.xml").write_text(policy_text({"/a": publish("/x"), "/b": publish("/y")}))
    (folder / "more.xml").write_text(policy_text({"/a": publish("/x", "/more")}))
    sros("generate_artifacts", "-k", "ks", "-p", "p.xml", cwd=folder).ok()
    sros("zenoh", "ks", "--mode", "peer", cwd=folder).ok()
    return folder


@pytest.fixture
def keystore(made: Path, tmp_path: Path) -> Path:
    return Path(copy_of(made, tmp_path / "w"), "ks")


def test_the_variables_of_a_session_and_of_a_router(keystore: Path) -> None:
    folder = keystore / "enclaves/a"
    shown = json.loads(sros("env", keystore, "/a", *ZENOH, "--json").ok().out)
    found = shown["variables"]
    assert found["RMW_IMPLEMENTATION"] == "rmw_zenoh_cpp"
    assert found["ZENOH_SESSION_CONFIG_URI"] == str(folder / "session.json5")
    assert found["ZENOH_ROUTER_CONFIG_URI"] == NO_CONFIGURATION
    assert f'connect_private_key="{folder}/key.pem"' in found["ZENOH_CONFIG_OVERRIDE"]
    assert found["ROS_SECURITY_STRATEGY"] == "Enforce"  # for another RMW in the same environment
    assert [each["id"] for each in shown["notes"]] == ["zenoh.enclave-argument"]
    shown = json.loads(sros("env", keystore, "/router", *ZENOH, "--json").ok().out)
    router = str(keystore / "enclaves/router/router.json5")
    assert shown["variables"]["ZENOH_ROUTER_CONFIG_URI"] == router
    assert shown["variables"]["ZENOH_SESSION_CONFIG_URI"] == NO_CONFIGURATION
    assert shown["notes"] == []


def test_a_client_whose_router_does_not_run_is_told_that_its_node_waits(keystore: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as router:
        endpoint = f"localhost:{router.getsockname()[1]}"
        sros("zenoh", keystore, "--mode", "client", "--endpoint", endpoint).ok()
        assert "zenoh.no-router" not in sros("env", keystore, "/a", *ZENOH).ok().err
    said = sros("env", keystore, "/a", *ZENOH).ok().err
    assert f"note [zenoh.no-router]: nothing listens at {endpoint}, the endpoint of the " in said
    assert "zenoh.no-router" not in sros("env", keystore, "/router", *ZENOH).ok().err
    sros("zenoh", keystore, "--endpoint", "robot.example:7447").ok()  # another machine: not asked
    assert "zenoh.no-router" not in sros("env", keystore, "/a", *ZENOH).ok().err


@pytest.mark.parametrize(
    ("version", "least", "said"),
    [
        ("0.1.1", "0.1.2", ""),
        ("0.1.2", "", "topics and services."),
        ("0.2.2", "0.2.3", ""),
        ("0.2.10", "", "topics and services."),
        ("0.5.0", "0.6.0", ""),
        ("0.6.7", "", "topics and services."),
        ("0.10.5", "", "topics and services, and send it no images."),
        ("0.11.0", "", "topics and services, and send it no images."),
        ("of today", "", "topics and services."),
    ],
)
def test_the_installed_rmw_zenoh_has_to_be_recent_enough(
    version: str, least: str, said: str, keystore: Path
) -> None:
    env = with_rmw_zenoh(keystore.parent / "ros", version)
    answer = sros("env", keystore, "/a", *ZENOH, env=env)
    if least:
        assert answer.status == 2 and "RMW_IMPLEMENTATION" not in answer.out
        assert f"Install rmw_zenoh_cpp {least} or later." in answer.err
    else:
        assert said in answer.ok().err
    # Where the process will run, another version may be installed.
    sros("env", keystore, "/a", *ZENOH, "--target", "/etc/keystore", env=env).ok()


def test_the_environment_chooses_too_and_the_option_wins(keystore: Path) -> None:
    zenoh = {"RMW_IMPLEMENTATION": "rmw_zenoh_cpp"}
    said = sros("env", keystore, "/a", *ZENOH).ok().out
    assert sros("env", keystore, "/a", env=zenoh).ok().out == said
    for environment, words in (
        (zenoh, ["--rmw", "rmw_cyclonedds_cpp"]),
        ({"RMW_IMPLEMENTATION": None}, []),
    ):
        dds = sros("env", keystore, "/a", *words, env=environment).ok().out
        assert "ZENOH" not in dds
        assert ("export RMW_IMPLEMENTATION=rmw_cyclonedds_cpp" in dds) is bool(words)


def test_the_only_rmw_that_is_installed_chooses_too(
    keystore: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    index = tmp_path / "share/ament_index/resource_index/rmw_typesupport"
    index.mkdir(parents=True)
    (index / "rmw_zenoh_cpp").touch()
    env = {"RMW_IMPLEMENTATION": None, "AMENT_PREFIX_PATH": ""}
    assert "ZENOH_SESSION" in sros("env", keystore, "/a", env=env).ok().out
    (index / "rmw_cyclonedds_cpp").touch()
    either = sros("env", keystore, "/a", env=env).ok().out
    assert "ZENOH_CONFIG_OVERRIDE" not in either
    # What chooses Zenoh after that, such as a launch file, starts no node.
    assert f"export ZENOH_SESSION_CONFIG_URI={NO_CONFIGURATION}" in either
    (index / "rmw_zenoh_cpp").unlink()
    assert "ZENOH" not in sros("env", keystore, "/a", env=env).ok().out


@pytest.mark.parametrize("form", ["sh", "fish", "systemd", "docker", "json"])
def test_every_form_has_them(form: str, keystore: Path) -> None:
    said = sros("env", keystore, "/a", *ZENOH, "--format", form).ok().out
    for text in ("RMW_IMPLEMENTATION", "listen_certificate", NO_CONFIGURATION):
        assert text in said


def session(keystore: Path) -> Path:
    return keystore / "enclaves/a/session.json5"


def remove_both(keystore: Path) -> None:
    session(keystore).unlink()
    session(keystore).with_suffix(".p7s").unlink()


def make_folder(keystore: Path) -> None:
    session(keystore).unlink()
    session(keystore).mkdir()


def sign_by_enclave(keystore: Path) -> None:
    """Sign another document with the enclave's own key, as whoever has the robot can."""
    from sros_tool.keystore.reader import read_certificate
    from sros_tool.pki.keys import load_key

    document = session(keystore).read_bytes().replace(b"deny", b"allow")
    session(keystore).write_bytes(document)
    key = load_key((keystore / "enclaves/a/key.pem").read_bytes(), "key")
    certificate = read_certificate(keystore / "enclaves/a/cert.pem")
    signed = smime.sign(document, certificate, key)
    session(keystore).with_suffix(".p7s").write_bytes(signed)


DAMAGE = {
    "neither file": (remove_both, "has no configuration for rmw_zenoh_cpp"),
    "no document": (lambda ks: session(ks).unlink(), "session.json5: missing"),
    "no signature": (
        lambda ks: session(ks).with_suffix(".p7s").unlink(),
        "session.p7s: missing",
    ),
    "changed": (
        lambda ks: session(ks).write_bytes(session(ks).read_bytes().replace(b"deny", b"allow")),
        "session.json5: it is not the document that the permissions CA signed in session.p7s",
    ),
    "signed by the enclave": (sign_by_enclave, "session.p7s: "),
    "signature of the router's": (
        lambda ks: shutil.copy(ks / "enclaves/router/router.p7s", session(ks).with_suffix(".p7s")),
        "it is not the document that the permissions CA signed",
    ),
    "the router's, signed": (
        lambda ks: [
            shutil.copy(ks / f"enclaves/router/router.{end}", session(ks).with_suffix(f".{end}"))
            for end in ("json5", "p7s")
        ],
        "session.json5: it is the configuration of a router, not of a session",
    ),
    "a folder": (
        make_folder,
        "session.json5: ",
    ),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_nothing_starts_without_files_that_are_right(
    damage: str, keystore: Path, tmp_path: Path
) -> None:
    sros("env", keystore, "/a", *ZENOH).ok()
    spoil, why = DAMAGE[damage]
    spoil(keystore)
    marker = tmp_path / "ran"
    refused = sros("run", keystore, "/a", *ZENOH, "--", "touch", marker)
    assert refused.status == 2
    assert why in refused.err
    assert f"`sros zenoh {keystore}`" in refused.err
    assert len(refused.err.splitlines()) == 1
    assert not marker.exists()
    refused = sros("env", keystore, "/a", env={"RMW_IMPLEMENTATION": "rmw_zenoh_cpp"})
    assert (refused.status, refused.out) == (2, render_refusal("sh"))
    sros("env", keystore, "/a", env={"RMW_IMPLEMENTATION": None}).ok()  # DDS does not need it


@pytest.mark.parametrize("mode", ["peer", "client"])
@pytest.mark.parametrize("of", ["another enclave", "earlier permissions"])
def test_nothing_starts_with_signed_files_of_other_rights(
    of: str, mode: str, keystore: Path, tmp_path: Path
) -> None:
    sros("zenoh", keystore, "--mode", mode).ok()
    other = keystore / "enclaves/b"
    if of == "earlier permissions":
        other = Path(shutil.copytree(keystore / "enclaves/a", tmp_path / "earlier"))
        sros("create_permission", keystore, "/a", keystore.parent / "more.xml").ok()
    sros("env", keystore, "/a", *ZENOH).ok()
    for file in ("session.json5", "session.p7s"):
        shutil.copy(other / file, keystore / "enclaves/a" / file)
    refused = sros("env", keystore, "/a", *ZENOH)
    assert refused.status == 2
    assert "session.json5: it does not state the rights of permissions.p7s" in refused.err


@pytest.mark.parametrize(("name", "file"), [("/router", "router"), ("/b", "session")])
def test_nothing_starts_with_a_signed_file_from_before_another_enclave_changed(
    name: str, file: str, keystore: Path
) -> None:
    """A router, and a peer, enforces what the others may do: an earlier file, what they might."""
    folder = keystore / f"enclaves{name}"
    earlier = {each: each.read_bytes() for each in folder.glob(f"{file}.*")}
    sros("create_permission", keystore, "/a", keystore.parent / "more.xml").ok()
    sros("env", keystore, name, *ZENOH).ok()
    for path, content in earlier.items():
        path.write_bytes(content)
    ended = sros("env", keystore, name, *ZENOH)
    assert ended.status == 2 and "does not match the keystore" in ended.err
    sros("env", keystore, "/a", *ZENOH).ok()


@pytest.mark.parametrize(
    "words",
    [
        ("--rmw", "rmw_email_cpp"),
        ("--rmw", ""),
        ("--rmw", "rmw_zenoh_pico_cpp"),
        (*ZENOH, "--domain", "3"),
    ],
)
def test_what_zenoh_would_not_enforce_is_refused(words: tuple[str, ...], keystore: Path) -> None:
    refused = sros("env", keystore, "/a", *words)
    assert (refused.status, refused.out) == (2, render_refusal("sh"))
    assert len(refused.err.splitlines()) == 1


@pytest.mark.parametrize("rmw", ["rmw_zenoh_pico_cpp", "rmw_email_cpp"])
def test_an_unknown_rmw_in_the_environment_is_refused(keystore: Path, rmw: str) -> None:
    refused = sros("env", keystore, "/a", env={"RMW_IMPLEMENTATION": rmw})
    assert (refused.status, refused.out) == (2, render_refusal("sh"))


def test_a_refusal_also_keeps_zenoh_closed() -> None:
    assert REFUSING["ZENOH_SESSION_CONFIG_URI"] == NO_CONFIGURATION
    assert REFUSING["ZENOH_ROUTER_CONFIG_URI"] == NO_CONFIGURATION


SHOW = "import json, os, sys; print(json.dumps([dict(os.environ), sys.argv[1:]]))"
OPENING = 'mode="peer";access_control/enabled=false'


def test_run_replaces_what_was_inherited_and_says_so(keystore: Path) -> None:
    wanted = json.loads(sros("env", keystore, "/a", *ZENOH, "--json").ok().out)["variables"]
    environment = importing(ZENOH_CONFIG_OVERRIDE=OPENING, ZENOH_ROUTER_CONFIG_URI="/etc/r.json5")
    words = ("run", keystore, "/a", *ZENOH, "--", sys.executable, "-c", SHOW)
    done = forked(*words, env=environment).ok()
    seen, _ = json.loads(done.out)
    assert {name: seen[name] for name in wanted} == wanted
    replaced = "sros replaces the value of ZENOH_ROUTER_CONFIG_URI, which was '/etc/r.json5'"
    assert f"note [zenoh.replaced]: {replaced}" in done.err
    assert "WARNING: the replaced ZENOH_CONFIG_OVERRIDE changed access_control" in done.err
    assert "note [zenoh.enclave-argument]" in done.err


def test_run_says_nothing_of_the_enclave_where_the_command_names_it(
    keystore: Path, tmp_path: Path
) -> None:
    node = tmp_path / "lib/arm/driver"
    router = tmp_path / "lib/rmw_zenoh_cpp/rmw_zenohd"
    for package, program in (("arm", node), ("rmw_zenoh_cpp", router)):
        share = tmp_path / "share" / package
        share.mkdir(parents=True)
        (share / "package.xml").write_text("<package/>")
        program.parent.mkdir(parents=True)
        program.write_text("#!/bin/sh\necho $*\n")
        program.chmod(0o755)
    done = forked("run", keystore, "/a", *ZENOH, "--", node).ok()
    assert done.out == "--ros-args --enclave /a\n"
    assert "enclave-argument" not in done.err
    refused = forked("run", keystore, "/a", *ZENOH, "--", node, "--ros-args", "-e", "/b")
    assert refused.status == 2
    assert "the command names the enclave /b" in refused.err
    done = forked("run", keystore, "/router", *ZENOH, "--", router)
    assert done == Ended(0, "\n", "")


def test_completion_of_rmw(keystore: Path) -> None:
    env = {"_SROS_COMPLETE": "bash_complete", "COMP_WORDS": f"sros env {keystore} --rmw rmw_z"}
    completed = sros(env={**env, "COMP_CWORD": "4"})
    assert completed.out.split(",")[-1].split() == ["rmw_zenoh_cpp"], completed


def test_who_reads_while_another_writes_sees_one_state(
    keystore: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between the permissions and the Zenoh file, somebody changes both."""
    words = ("env", keystore, "/a", *ZENOH)
    before = sros(*words)
    real, waiting = zenoh_files.open_zenoh, ["more.xml"]

    def change_meanwhile(folder: Path, name: str, state: OpenedEnclave) -> object:
        if waiting:
            sros("create_permission", keystore, "/a", keystore.parent / waiting.pop()).ok()
        return real(folder, name, state)

    monkeypatch.setattr(zenoh_files, "open_zenoh", change_meanwhile)
    ended = sros(*words)
    assert not waiting
    assert (ended.status, ended.out) == (before.status, before.out), ended
