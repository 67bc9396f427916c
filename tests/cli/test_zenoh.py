"""The verb zenoh: what it writes, keeps, compares and refuses."""

from __future__ import annotations

import json
import shutil
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from sros_tool.keystore import zenoh_files
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.pki import smime
from sros_tool.pki.crl import RevocationEntry, sign_crl
from sros_tool.pki.keys import load_key
from sros_tool.policy.rights import NodeName
from sros_tool.translate_zenoh.rights import StatedRight, remote_of
from sros_tool.zenoh.access import AccessRule, Flow, Message, Remote, RemoteRights, sorted_rules
from sros_tool.zenoh.document import parse_configuration
from tests.support.harness import copy_of, policy_text, publish, snapshot, sros

TOKEN = (Message.LIVELINESS_TOKEN,)
SESSION, ROUTER = "enclaves/a/session.json5", "enclaves/router/router.json5"
SIGNED = {SESSION: "enclaves/a/session.p7s", ROUTER: "enclaves/router/router.p7s"}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a keystore and its policy; only to be copied."""
    folder = tmp_path_factory.mktemp("zenoh")
    subscribe = publish("/x").replace("publish", "subscribe")
    (folder / "p.xml").write_text(policy_text({"/a": publish("/x"), "/b": subscribe}))
    (folder / "router.xml").write_text(policy_text({"/router": publish("/x")}))
    hole = publish("/c*") + '\n<topics publish="DENY"><topic>/cd</topic></topics>'
    (folder / "hole.xml").write_text(policy_text({"/hole": hole}))
    sros("generate_artifacts", "-k", "ks", "-p", "p.xml", "-e", "/router", cwd=folder).ok()
    sros("update_keystore", "ks", "--set", "permissions.default=node_basics", cwd=folder).ok()
    return folder


@pytest.fixture
def folder(made: Path, tmp_path: Path) -> Path:
    return copy_of(made, tmp_path / "w")


def control(folder: Path, path: str) -> Any:
    return json.loads((folder / path).read_text())["access_control"]


def test_files_are_signed_whole_and_the_same_again(folder: Path) -> None:
    ended = sros("zenoh", "ks", cwd=folder).ok()
    assert ended.out.splitlines() == [
        "wrote ks/enclaves/router/router.json5",
        "wrote ks/enclaves/a/session.json5",
        "wrote ks/enclaves/b/session.json5",
    ]
    assert "restart the processes of 3 enclaves" in ended.err
    authority = OpenedKeystore(folder / "ks").ca_certificate("permissions")
    for path, signed in SIGNED.items():
        document = (folder / "ks" / path).read_bytes()
        message = smime.parse((folder / "ks" / signed).read_bytes())
        message.verify(authority)
        assert message.document.replace(b"\r\n", b"\n") == document
        assert b"PRIVATE" not in document and str(folder).encode() not in document
        assert b".pem" not in document
    before = snapshot(folder)
    again = sros("zenoh", "ks", cwd=folder).ok()
    assert (again.out, "up to date" in again.err) == ("", True)
    assert snapshot(folder) == before


def test_many_files_are_counted(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sros_tool.cli.changed.MAX_NAMES", 2)
    names = ("router/router.json5", "a/session.json5", "b/session.json5")
    files = ", ".join(f"ks/enclaves/{each}" for each in names) + " (-v lists all)\n"
    checked, written = (sros("zenoh", "ks", *more, cwd=folder) for more in (("--check",), ()))
    assert (checked.out, written.out) == (f"missing: 3 files: {files}", f"wrote 3 files: {files}")


def test_a_router_without_rights_of_its_own_does_not_differ_from_the_policy(folder: Path) -> None:
    compare = ("diff_policy", "p.xml", "ks")
    assert "+ /router ALLOW publish" in sros(*compare, cwd=folder).out
    sros("zenoh", "ks", cwd=folder).ok()
    ended = sros(*compare, cwd=folder).ok()
    left_out = "left out: 1 Zenoh router that is not in the policy and has only the rights that"
    assert (ended.out, f"{left_out} every node needs: /router." in ended.err) == (
        "",
        True,
    )
    (folder / "known.xml").write_text(policy_text({"/a": "", "/b": "", "/router": ""}))
    known = sros("diff_policy", "known.xml", "ks", cwd=folder)
    assert "left out" not in known.err and "+ /router ALLOW publish topic /rosout" in known.out
    sros(
        "update_keystore",
        "ks",
        "--set",
        "permissions.default=everything",
        "--allow-looser",
        cwd=folder,
    ).ok()
    assert "+ /router ALLOW publish topic /*" in sros(*compare, cwd=folder).out


def test_every_file_has_the_rights_of_all_by_name_and_denies_the_rest(folder: Path) -> None:
    sros("zenoh", "ks", "--mode", "peer", cwd=folder).ok()
    names = {
        path: [each["cert_common_names"] for each in control(folder / "ks", path)["subjects"]]
        for path in SIGNED
    }
    assert names == {ROUTER: [["/a"], ["/b"]], SESSION: [["/a"], ["/b"], ["/router"]]}
    for path in SIGNED:
        said = control(folder / "ks", path)
        assert (said["enabled"], said["default_permission"]) == (True, "deny")
        assert {each["permission"] for each in said["rules"]} == {"allow"}
    sros("zenoh", "ks", "--mode", "client", cwd=folder).ok()
    subjects = control(folder / "ks", SESSION)["subjects"]
    assert [each["cert_common_names"] for each in subjects] == [["/router"]]


def test_the_choices_reach_the_files(folder: Path) -> None:
    words = ("--endpoint", "10.0.0.1:7000", "--listen", "[::]:7000", "--json")
    shown = json.loads(sros("zenoh", "ks", *words, cwd=folder).ok().out)
    assert shown["network"] == {
        "router": "/router",
        "endpoints": ["10.0.0.1:7000"],
        "listen": ["[::]:7000"],
        "mode": "client",
        "domains": [0],
        "routers": [],
        "crossing": [],
    }
    session = json.loads((folder / "ks" / SESSION).read_text())
    router = json.loads((folder / "ks" / ROUTER).read_text())
    assert (session["mode"], router["mode"]) == ("client", "router")
    assert session["connect"]["endpoints"] == ["tls/10.0.0.1:7000"]
    assert session["listen"]["endpoints"] == []
    assert router["listen"]["endpoints"] == ["tls/[::]:7000"]
    for each in (session, router):
        link = each["transport"]["link"]
        assert (link["protocols"], link["tls"]["enable_mtls"]) == (["tls"], True)
        assert link["tls"]["close_link_on_expiration"] is True
        assert each["transport"]["shared_memory"]["enabled"] is False
        assert each["scouting"]["multicast"]["enabled"] is False
        assert each["adminspace"]["enabled"] is False


@pytest.mark.parametrize("path", SIGNED)
@pytest.mark.parametrize("change", ["document", "signature", "missing"])
def test_what_was_changed_is_out_of_date_and_written_again(
    path: str, change: str, folder: Path
) -> None:
    sros("zenoh", "ks", cwd=folder).ok()
    sros("zenoh", "ks", "--check", cwd=folder).ok()
    file = folder / "ks" / (SIGNED[path] if change == "signature" else path)
    if change == "missing":
        file.unlink()
    else:
        file.write_bytes(file.read_bytes().replace(b"allow", b"deny") + b"\n")
    if change == "signature":
        file.write_bytes(b"x")
    before = snapshot(folder)
    checked = sros("zenoh", "ks", "--check", cwd=folder)
    word = "missing" if change == "missing" else "out of date"
    assert (checked.status, checked.out) == (1, f"{word}: ks/{path}\n")
    assert snapshot(folder) == before
    verb = "wrote" if change == "missing" else "replaced"
    assert sros("zenoh", "ks", cwd=folder).ok().out == f"{verb} ks/{path}\n"
    sros("zenoh", "ks", "--check", cwd=folder).ok()


def test_what_was_never_written_is_missing(folder: Path) -> None:
    before = snapshot(folder)
    checked = sros("zenoh", "ks", "--check", "--router", "/way", cwd=folder)
    lines = checked.out.splitlines()
    assert (checked.status, lines[0]) == (1, "missing: enclave /way")
    assert f"missing: ks/{SESSION}" in lines
    assert {line.partition(":")[0] for line in lines} == {"missing"}
    assert snapshot(folder) == before
    sros("zenoh", "ks", cwd=folder).ok()
    unwanted = sros("zenoh", "ks", "--off", "--check", cwd=folder)
    assert f"no longer needed: ks/{SESSION}" in unwanted.out.splitlines()


def test_a_dry_run_says_what_is_written(folder: Path) -> None:
    before = snapshot(folder)
    would = sros("zenoh", "ks", "--dry-run", cwd=folder).ok()
    assert f"would create ks/{SESSION}" in would.out.splitlines()
    assert snapshot(folder) == before


def test_the_keystore_may_be_that_of_the_environment(folder: Path) -> None:
    env = {"ROS_SECURITY_KEYSTORE": str(folder / "ks")}
    sros("zenoh", env=env, cwd=folder).ok()
    assert (folder / "ks" / SESSION).exists()


def test_the_enclave_of_the_router_is_made_with_what_every_node_needs(folder: Path) -> None:
    ended = sros("zenoh", "ks", "--router", "/way", cwd=folder).ok()
    assert ended.out.splitlines()[0] == "created enclave /way"
    assert "/way" not in ended.err, "no process of it runs yet"
    shown = sros("explain", "ks", "/way", "publish", "/x", cwd=folder)
    assert shown.status == 1, shown.out
    assert not (folder / "ks" / ROUTER).exists()


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("ks", "--router", "/a"), "a policy gave enclave /a rights"),
        (("ks", "--router", "way"), "zenoh.router"),
        (("ks", "--endpoint", "tcp/localhost:1"), "is not HOST:PORT"),
        (("ks", "--endpoint", "localhost:70000"), "is not HOST:PORT"),
        (
            ("ks", "--domain", "7"),
            "the Zenoh network has domain 7, but keystore 'ks' is only for domain 0",
        ),
        (("ks", "--off", "--mode", "peer"), "--off takes no options of the network"),
        (("nothing",), "is not a valid keystore"),
        ((), "ROS_SECURITY_KEYSTORE"),
    ],
)
def test_refused_and_nothing_is_written(words: tuple[str, ...], text: str, folder: Path) -> None:
    before = snapshot(folder)
    ended = sros("zenoh", *words, env={"ROS_SECURITY_KEYSTORE": None}, cwd=folder)
    assert (ended.status, ended.out) == (2, "")
    assert text in ended.err
    assert snapshot(folder) == before


def test_a_revoked_certificate_that_zenoh_still_accepts_is_noted(folder: Path) -> None:
    sros("zenoh", "ks", cwd=folder).ok()
    sros("revoke", "ks", "/a", cwd=folder).ok()
    assert not (folder / "ks" / SESSION).exists()
    again = ("generate_artifacts", "-k", "ks", "-p", "p.xml", "-e", "/a")
    notes = sros(*again, cwd=folder).ok().err
    assert "revoked certificates of /a have not expired" in notes


def test_an_enclave_without_a_file_is_told_and_not_up_to_date(folder: Path) -> None:
    sros("zenoh", "ks", cwd=folder).ok()
    (folder / "ks/enclaves/b/permissions.p7s").unlink()
    written = sros("zenoh", "ks", cwd=folder).ok()
    assert "note [zenoh.left-out]: /b gets no configuration" in written.err
    checked = sros("zenoh", "ks", "--check", cwd=folder)
    assert (checked.status, checked.out) == (1, "no file: enclave /b: it has no permissions\n")
    assert checked.err == "the Zenoh files are up to date; 1 enclave has no file\n"
    told = sros("zenoh", "ks", "--check", "--json", cwd=folder)
    assert (told.status, json.loads(told.out)["left_out"]) == (
        1, [{"enclave": "/b", "why": "it has no permissions"}],
    )  # fmt: skip
    sros("revoke", "ks", "/b", cwd=folder).ok()
    sros("zenoh", "ks", "--check", cwd=folder).ok()


def test_enclaves_outside_the_domains_of_the_network_lack_no_file(tmp_path: Path) -> None:
    (tmp_path / "fleet.toml").write_text("[robots]\nd1 = { domain = 0 }\nz1 = { domain = 5 }\n")
    (tmp_path / "p.xml").write_text(policy_text({"/{robot}": publish("x")}))
    for line in (
        "create_keystore ks --template production --domain 0,5",
        "generate_artifacts -k ks -p p.xml --fleet fleet.toml",
        "zenoh ks --domain 5",
        "zenoh ks --check",
    ):
        ended = sros(*line.split(), cwd=tmp_path).ok()
    said = "no file: enclave /d1: its permissions are for no domain of the Zenoh network\n"
    assert ended.out == said
    for name, notes in (("d1", 1), ("z1", 0)):
        found = sros("check", f"ks/enclaves/{name}", "--severity", "note", cwd=tmp_path).out
        assert found.count("[zenoh.other-domain]") == notes, found
    (tmp_path / "ks/enclaves/z1/permissions.p7s").unlink()
    sros("zenoh", "ks", cwd=tmp_path).ok()
    assert sros("zenoh", "ks", "--check", cwd=tmp_path).status == 1


def test_the_router_is_moved_before_its_enclave_is_revoked(folder: Path) -> None:
    sros("zenoh", "ks", cwd=folder).ok()
    refused = sros("revoke", "ks", "/router", cwd=folder)
    assert (refused.status, "is the enclave of the Zenoh router" in refused.err) == (2, True)
    assert "`sros zenoh ks --router /router2`" in refused.err
    moved = sros("zenoh", "ks", "--router", "/router2", cwd=folder).ok()
    assert "stop the router that runs in /router, and start it in /router2" in moved.err
    sros("revoke", "ks", "/router", cwd=folder).ok()
    sros("zenoh", "ks", "--check", cwd=folder).ok()


def test_a_file_of_before_a_revocation_is_refused_where_the_list_is_newer(folder: Path) -> None:
    """A peer's file has the rights of others, validly signed: those of before are no longer."""
    sros("zenoh", "ks", "--mode", "peer", cwd=folder).ok()
    sros("distribute_key", "ks", "/a", "before", cwd=folder).ok()
    sros("verify", "before", cwd=folder).ok()
    sros("revoke", "ks", "/b", cwd=folder).ok()
    sros("zenoh", "ks", "--check", cwd=folder).ok()
    sros("renew", "ks", "/a", cwd=folder).ok()
    sros("zenoh", "ks", "--check", cwd=folder).ok()
    sros("distribute_key", "ks", "/a", "robot", cwd=folder).ok()
    sros("verify", "robot", cwd=folder).ok()
    for name in ("session.json5", "session.p7s"):
        shutil.copy(folder / "before/enclaves/a" / name, folder / "robot/enclaves/a" / name)
    checked = sros("verify", "robot", cwd=folder)
    assert (checked.status, "zenoh.out-of-date" in checked.out) == (1, True)
    assert "it is older than the last revocation in crl.pem" in checked.out
    refused = sros("env", "robot", "/a", "--rmw", "rmw_zenoh_cpp", cwd=folder)
    assert (refused.status, "older than the last revocation" in refused.err) == (2, True)


def test_files_are_in_step_after_a_revocation(folder: Path) -> None:
    sros("zenoh", "ks", "--mode", "peer", cwd=folder).ok()
    refused = sros("revoke", "ks", "/b", "--reason", "superseded", cwd=folder)
    assert (refused.status, "is not a reason to revoke an enclave" in refused.err) == (2, True)
    sros("revoke", "ks", "/b", "--reason", "keyCompromise", cwd=folder).ok()
    sros("zenoh", "ks", "--check", cwd=folder).ok()
    sros("env", "ks", "/a", "--rmw", "rmw_zenoh_cpp", cwd=folder).ok()


def test_a_revocation_that_is_in_the_list_alone_counts(folder: Path) -> None:
    """The ledger does not have what another program put into the list."""
    sros("zenoh", "ks", "--mode", "peer", cwd=folder).ok()
    sros("revoke", "ks", "/b", cwd=folder).ok()
    home = folder / "ks"
    authority = OpenedKeystore(home).ca_certificate("identity")
    key = load_key((home / "private/identity_ca.key.pem").read_bytes(), "key")
    now = datetime.now(UTC)
    more = (RevocationEntry(99, now + timedelta(minutes=1)),)
    list_file = (home / "public/identity_ca.crl.pem").resolve()
    list_file.write_bytes(
        sign_crl(authority, key, more, number=9, this_update=now, next_update=now + timedelta(9))
    )
    env = ("env", "ks", "/a", "--rmw", "rmw_zenoh_cpp")
    assert "older than the last revocation" in sros(*env, cwd=folder).err
    sros("zenoh", "ks", cwd=folder).ok()
    sros(*env, cwd=folder).ok()


def test_a_file_of_an_earlier_version_is_refused_with_what_to_do(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def as_before(*rights: Any) -> RemoteRights:
        """Return rights whose graph tokens are bound to the enclave alone."""
        remote = remote_of(*rights)
        others = [
            rule for rule in remote.rules if (rule.flow, rule.messages) != (Flow.INGRESS, TOKEN)
        ]
        key = f"@ros2_lv/0/*/*/*/*/%{remote.common_name[1:]}/**"
        every = AccessRule(Flow.INGRESS, TOKEN, (key,))
        return replace(remote, rules=sorted_rules([*others, every]))

    with monkeypatch.context() as earlier:
        earlier.setattr(zenoh_files, "remote_of", as_before)
        earlier.setattr(zenoh_files, "_check_rules_match", lambda *_: None)
        sros("zenoh", "ks", cwd=folder).ok()
        sros("distribute_key", "ks", "/a", "robot", cwd=folder).ok()
        sros("verify", "robot", cwd=folder).ok()
    checked = sros("verify", "robot", cwd=folder)
    assert (checked.status, "zenoh.out-of-date" in checked.out) == (1, True)
    assert "an earlier version of sros wrote it" in checked.out
    refused = sros("env", "robot", "/a", "--rmw", "rmw_zenoh_cpp", cwd=folder)
    assert (refused.status, "an earlier version of sros wrote it" in refused.err) == (2, True)
    assert "`sros zenoh KEYSTORE` where the CA keys are, and export the enclave" in refused.err
    # Other permissions are told as that.
    (folder / "wider.xml").write_text(policy_text({"/a": publish("/x", "/y")}))
    sros("create_permission", "ks", "/a", "wider.xml", cwd=folder).ok()
    sros("distribute_key", "ks", "/a", "robot2", cwd=folder).ok()
    for name in ("session.json5", "session.p7s"):
        shutil.copy(folder / "robot/enclaves/a" / name, folder / "robot2/enclaves/a" / name)
    assert (
        "does not state the rights of permissions.p7s" in sros("verify", "robot2", cwd=folder).out
    )


def test_an_export_has_the_file_of_its_enclave_alone(folder: Path) -> None:
    sros("zenoh", "ks", cwd=folder).ok()
    sros("distribute_key", "ks", "/a", "robot", cwd=folder).ok()
    found = sorted(each.name for each in (folder / "robot").rglob("session.*"))
    assert found == ["session.json5", "session.p7s"]
    assert (folder / "robot" / SESSION).read_bytes() == (folder / "ks" / SESSION).read_bytes()
    sros("verify", "robot", cwd=folder).ok()
    assert "unknown" not in sros("check", "ks", "--severity", "note", cwd=folder).out


def test_off_removes_what_sros_made_and_keeps_no_file_in_step(folder: Path) -> None:
    sros("zenoh", "ks", cwd=folder).ok()
    by_hand = folder / "ks/enclaves/session.json5"
    by_hand.write_text("{}")
    ended = sros("zenoh", "ks", "--off", cwd=folder).ok()
    assert "removed ks/enclaves/b/session.json5" in ended.out.splitlines()
    assert "restart the processes of 3 enclaves" in ended.err
    assert [*(folder / "ks").rglob("session.*"), *(folder / "ks").rglob("router.*")] == [by_hand]
    sros("create_permission", "ks", "/a", "p.xml", cwd=folder).ok()
    assert not (folder / "ks" / SESSION).exists()


def test_a_signature_of_another_keystore_does_not_count(folder: Path) -> None:
    sros("generate_artifacts", "-k", "other", "-p", "p.xml", "-e", "/router", cwd=folder).ok()
    for keystore in ("ks", "other"):
        sros("zenoh", keystore, cwd=folder).ok()
    assert (folder / "other" / SESSION).read_bytes() == (folder / "ks" / SESSION).read_bytes()
    shutil.copy(folder / "other" / SIGNED[SESSION], folder / "ks" / SIGNED[SESSION])
    checked = sros("zenoh", "ks", "--check", cwd=folder)
    assert (checked.status, checked.out) == (1, f"out of date: ks/{SESSION}\n")


@pytest.mark.parametrize("wrong", ["lost", "wider", "announces more", "another enclave's"])
def test_rules_that_are_not_the_permissions_are_not_written(
    wrong: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    more = {
        "wider": AccessRule(Flow.EGRESS, (Message.PUT,), ("0/**",)),
        "announces more": AccessRule(Flow.INGRESS, TOKEN, ("@ros2_lv/0/*/*/*/MP/%a/%/n/%y/**",)),
        "another enclave's": AccessRule(Flow.INGRESS, TOKEN, ("@ros2_lv/0/*/*/*/NN/%b/%/n",)),
    }

    def made(
        enclave: str, stated: Mapping[int, Sequence[StatedRight]], nodes: Collection[NodeName]
    ) -> RemoteRights:
        rights = remote_of(enclave, stated, nodes)
        rules = rights.rules[1:] if wrong == "lost" else (*rights.rules, more[wrong])
        return replace(rights, rules=rules)

    monkeypatch.setattr(zenoh_files, "remote_of", made)
    before = snapshot(folder)
    ended = sros("zenoh", "ks", cwd=folder)
    assert (ended.status, "would not have the intended content" in ended.err) == (2, True)
    assert snapshot(folder) == before


def test_a_node_in_any_namespace_announces_its_own_services(folder: Path) -> None:
    """Of ``*/n/get_parameters``, the name ``/n/get_parameters`` is of the node /n alone."""
    (folder / "any.xml").write_text(
        '<policy version="0.2.0"><enclaves><enclave path="/a"><profiles><profile ns="*" node="n">'
        '<services reply="ALLOW"><service>~/get_parameters</service></services>'
        "</profile></profiles></enclave></enclaves></policy>"
    )
    sros("create_permission", "ks", "/a", "any.xml", cwd=folder).ok()
    sros("zenoh", "ks", cwd=folder).ok()
    access = parse_configuration((folder / "ks" / ROUTER).read_bytes(), ROUTER).access
    announcing = (Remote("/a"), Flow.INGRESS, Message.LIVELINESS_TOKEN)
    for node, service, announced in (
        ("%/n", "%n", True),
        ("%x/n", "%x%n", True),
        ("%x/n", "%n", False),
        ("%/m", "%m", False),
    ):
        token = f"@ros2_lv/0/z/0/1/SS/%a/{node}/{service}%get_parameters/type/hash/qos"
        assert access.decide(*announcing, token).allowed is announced, token


def test_tokens_that_are_allowed_and_denied_again_do_not_stop_an_export(folder: Path) -> None:
    groups = '<services reply="{}"><service>{}</service></services>'
    groups = groups.format("ALLOW", "/a*") + groups.format("DENY", "/*") + publish("/x")
    (folder / "denied.xml").write_text(policy_text({"/a": groups}))
    sros("create_permission", "ks", "/a", "denied.xml", cwd=folder).ok()
    sros("zenoh", "ks", cwd=folder).ok()
    sros("distribute_key", "ks", "/a", "robot", cwd=folder).ok()
    assert "[zenoh." not in sros("verify", "robot", cwd=folder).out
