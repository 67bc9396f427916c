"""Every change of a keystore keeps its files for Zenoh in step, and names what to restart."""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.permissions import Criteria, Grant, Rule
from sros_tool.errors import PolicyError
from sros_tool.files import templates_dir
from sros_tool.keystore.lifecycle.update import set_zenoh
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.zenoh_permissions import rights_in_domain
from sros_tool.pki import smime
from sros_tool.zenoh.configuration import ZenohNetwork
from tests.support.harness import copy_of, policy_text, publish, snapshot, sros
from tests.support.long_form import some

FIRST = policy_text({"/a": publish("/x"), "/b": publish("/y")})
MORE = policy_text({"/a": publish("/x", "/z")})
NEW = policy_text({"/new": publish("/n")})
HOLE = policy_text(
    {"/hole": publish("/c*") + '\n<topics publish="DENY"><topic>/*x*</topic></topics>'}
)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a keystore in each mode; only to be copied."""
    folder = tmp_path_factory.mktemp("kept")
    for name, text in (("first", FIRST), ("more", MORE), ("new", NEW), ("hole", HOLE)):
        (folder / f"{name}.xml").write_text(text)
    for mode in ("client", "peer"):
        sros("create_keystore", mode, "--template", "production", cwd=folder).ok()
        sros("generate_artifacts", "-k", mode, "-p", "first.xml", cwd=folder).ok()
        sros("zenoh", mode, "--mode", mode, cwd=folder).ok()
    return folder


@pytest.fixture
def folder(made: Path, tmp_path: Path) -> Path:
    return copy_of(made, tmp_path / "w")


def in_step(root: Path) -> None:
    """The files are what the keystore needs, and signed by its permissions CA."""
    assert sros("zenoh", root, "--check").status == 0
    authority = OpenedKeystore(root).ca_certificate("permissions")
    documents = list((root / "enclaves").rglob("*.json5"))
    assert documents
    for each in documents:
        smime.parse(each.with_suffix(".p7s").read_bytes()).verify(authority)


ALL = ["/a", "/b", "/router"]


@pytest.mark.parametrize(
    ("words", "client", "peer"),
    some(
        [
            (("generate_artifacts", "-k", "{}", "-p", "more.xml"), ["/a", "/router"], ALL),
            (("generate_artifacts", "-k", "{}", "-p", "first.xml"), [], []),
            (("generate_artifacts", "-k", "{}", "-p", "new.xml"), ["/router"], ALL),
            (("create_enclave", "{}", "/c"), ["/router"], ALL),
            (("create_permission", "{}", "/a", "more.xml"), ["/a", "/router"], ALL),
            (("renew", "{}", "/a"), [], []),
            (("renew", "{}", "/a", "--new-key"), [], []),
            (("update_keystore", "{}", "--set", "zenoh.endpoints=localhost:7449"), ALL, ALL),
            (
                ("update_keystore", "{}", "--set", "zenoh.listen=[::]:7447"),
                ["/router"],
                ["/router"],
            ),
            (("zenoh", "{}"), [], []),
        ],
        4,
    ),
)
def test_the_files_follow_and_exactly_what_changed_is_restarted(
    words: tuple[str, ...], client: list[str], peer: list[str], folder: Path
) -> None:
    for mode, expected in (("client", client), ("peer", peer)):
        root = folder / mode
        before = {path: path.read_bytes() for path in root.rglob("*.json5")}
        shown = sros(*(each.format(mode) for each in words), "--json", cwd=folder).ok()
        in_step(root)
        assert sorted(json.loads(shown.out)["restart"]) == expected
        changed = {path for path in before if path.read_bytes() != before[path]}
        assert {"/" + each.parent.name for each in changed} == set(expected)


def test_a_missing_file_comes_back_without_new_permissions(folder: Path) -> None:
    root = folder / "client"
    words = ("generate_artifacts", "-k", "client", "-p", "first.xml")
    before = snapshot(root)
    assert "unchanged: 2 enclaves" in sros(*words, cwd=folder).ok().err
    assert snapshot(root) == before
    (root / "enclaves/a/session.json5").unlink()
    sros(*words, cwd=folder).ok()
    in_step(root)
    after = snapshot(root)
    changed = {path for path in after if before[path] != after[path]}
    assert changed <= {"enclaves/a/session.p7s"}


def test_a_revoked_enclave_has_no_rights_any_more(folder: Path) -> None:
    for mode in ("client", "peer"):
        shown = sros("revoke", mode, "/a", "--json", cwd=folder).ok()
        assert json.loads(shown.out)["restart"] == ["/b", "/router"]
        in_step(folder / mode)
        assert "/a#" not in (folder / mode / "enclaves/router/router.json5").read_text()
        assert not (folder / mode / "enclaves/a").exists()


def test_a_signed_request_brings_its_files(folder: Path) -> None:
    (folder / "far.xml").write_text(policy_text({"/far": publish("/f")}))
    sros("create_request", "/far", "robot", cwd=folder).ok()
    request = "robot/enclaves/far/request.pem"
    answer = ("-p", "far.xml", "-o", "far.tar.gz")
    sros("sign_request", "client", request, *answer, cwd=folder).ok()
    in_step(folder / "client")
    sros("import", "far.tar.gz", "robot", cwd=folder).ok()
    for name in ("session.json5", "session.p7s"):
        here, there = (folder / each / "enclaves/far" / name for each in ("client", "robot"))
        assert here.read_bytes() == there.read_bytes()


def test_a_rotation_of_both_cas_ends_in_step_at_every_stage(folder: Path) -> None:
    sros("revoke", "peer", "/b", cwd=folder).ok()
    before = (folder / "peer/enclaves/a/session.p7s").read_bytes()
    for _ in range(3):
        sros("rotate_ca", "peer", "--next", cwd=folder).ok()
        in_step(folder / "peer")
    assert (folder / "peer/enclaves/a/session.p7s").read_bytes() != before
    sros("rotate_ca", "client", "--finish", cwd=folder).ok()
    in_step(folder / "client")


def test_more_domains_reach_the_rules(folder: Path) -> None:
    sros("update_keystore", "client", "--domain", "0,7", "--allow-looser", cwd=folder).ok()
    in_step(folder / "client")
    text = (folder / "client/enclaves/router/router.json5").read_text()
    assert '"7/x/$*::$*/*/**"' in text and '"0/x/$*::$*/*/**"' in text


def test_rights_that_zenoh_cannot_enforce_are_refused_with_their_line(folder: Path) -> None:
    before = snapshot(folder)
    ended = sros("generate_artifacts", "-k", "client", "-p", "hole.xml", cwd=folder)
    assert ended.status == 2 and "hole.xml:2: DENY publish" in ended.err
    assert snapshot(folder) == before


def test_the_routers_enclave_gets_no_rights(folder: Path) -> None:
    (folder / "router.xml").write_text(policy_text({"/router": publish("/x")}))
    before = snapshot(folder)
    ended = sros("create_permission", "client", "/router", "router.xml", cwd=folder)
    assert ended.status == 2 and "/router, the enclave of the Zenoh router" in ended.err
    assert snapshot(folder) == before


def test_permissions_that_were_put_back_give_no_rights(folder: Path) -> None:
    """Their signature is as valid as ever, but the ledger knows later ones."""
    root = folder / "client"
    sros("create_permission", "client", "/a", "more.xml", cwd=folder).ok()
    kept = (root / "enclaves/a/permissions.p7s").read_bytes()
    sros("create_permission", "client", "/a", "first.xml", cwd=folder).ok()
    (root / "enclaves/a/permissions.p7s").write_bytes(kept)
    ended = sros("create_enclave", "client", "/c", cwd=folder).ok()
    assert "/a gets no configuration for Zenoh" in ended.err
    assert "/z/" not in (root / "enclaves/router/router.json5").read_text()
    assert not (root / "enclaves/a/session.json5").exists()


def test_expired_permissions_give_no_rights(folder: Path) -> None:
    """As on DDS: Zenoh itself looks at the certificate alone, which is valid for longer."""
    root = folder / "client"
    set_zenoh(root, ZenohNetwork(), now=datetime.now(UTC) + timedelta(days=179))
    in_step(root)
    later = datetime.now(UTC) + timedelta(days=181)
    due = set_zenoh(root, ZenohNetwork(), now=later, dry_run=True)
    assert "/a, /b get no configuration for Zenoh" in due.notes[0].text
    assert "its permissions expired at" in due.notes[0].text
    set_zenoh(root, ZenohNetwork(), now=later)
    router = json.loads((root / "enclaves/router/router.json5").read_text())
    assert router["access_control"]["subjects"] == []
    assert not (root / "enclaves/a/session.json5").exists()


def test_who_has_no_valid_certificate_either_keeps_its_rules(folder: Path) -> None:
    """Nobody gets a connection with it, and a router that starts each day would be out of date."""
    (folder / "operator.xml").write_text(policy_text({"/operator/x": publish("/x")}))
    sros("generate_artifacts", "-k", "client", "-p", "operator.xml", cwd=folder).ok()
    root = folder / "client"
    due = set_zenoh(root, ZenohNetwork(), now=datetime.now(UTC) + timedelta(days=2), dry_run=True)
    # The policies of all enclaves here name the same node.
    assert due.changes == ()
    assert {note.id for note in due.notes} == {"zenoh.shared-node"}


def test_a_template_may_choose_the_network(folder: Path) -> None:
    text = (templates_dir() / "production.toml").read_text()
    (folder / "robot.toml").write_text(
        f'{text}\n[zenoh]\nrouter = "/way"\nendpoints = ["[::1]:7449"]\nmode = "peer"\n'
    )
    sros("create_keystore", "ks", "--template", "robot.toml", cwd=folder).ok()
    ended = sros("generate_artifacts", "-k", "ks", "-p", "first.xml", cwd=folder).ok()
    assert "created enclave /way" in ended.out
    in_step(folder / "ks")
    session = json.loads((folder / "ks/enclaves/a/session.json5").read_text())
    assert (session["mode"], session["connect"]["endpoints"]) == ("peer", ["tls/[::1]:7449"])


@pytest.mark.parametrize(
    ("line", "text"),
    [
        ('mode = "router"', "zenoh.mode is 'router', not one of client, peer"),
        ("endpoints = []", "zenoh.endpoints is not a list"),
        ('endpoints = ["tls/robot:1"]', "which is not HOST:PORT"),
        ('router = "router"', "zenoh.router"),
        ("domains = [231]", "zenoh.domains is not a list of numbers from 0 to 230"),
        ("port = 1", "zenoh.port is not a known key"),
    ],
)
def test_a_template_with_another_network_is_refused(line: str, text: str, folder: Path) -> None:
    production = (Path(__file__).parents[2] / "keystore_templates/production.toml").read_text()
    (folder / "robot.toml").write_text(f"{production}\n[zenoh]\n{line}\n")
    ended = sros("create_keystore", "ks", "--template", "robot.toml", cwd=folder)
    assert ended.status == 2 and text in ended.err
    assert not (folder / "ks").exists()


def test_a_table_that_was_taken_out_by_hand_is_no_silent_end(folder: Path) -> None:
    path = folder / "client/sros.toml"
    text = path.read_text()
    path.write_text(text[: text.index("\n[zenoh]")] + "\n")
    ended = sros("update_keystore", "client", "--take-edits", cwd=folder)
    assert ended.status == 2 and "sros zenoh client --off" in ended.err
    sros("update_keystore", "client", "--discard-edits", cwd=folder).ok()
    in_step(folder / "client")


@pytest.mark.parametrize(
    ("topics", "names"),
    [
        (["rt/a", "rt*/chatter"], ["*/chatter", "/a"]),
        (["rt*"], ["*"]),
        (["ros_discovery_info", "other/*"], []),
        (["r*/chatter"], None),
        (["*chatter"], None),
        (["?t/a"], None),
        (["*"], None),  # without the right to subscribe it, no service of ROS works
    ],
)
def test_a_wildcard_of_dds_is_said_exactly_or_refused(
    topics: list[str], names: list[str] | None
) -> None:
    """What another program signed may have a wildcard in the prefix of a topic."""
    domain = DomainSet.of((0, 0))
    rules = (Rule(allow=True, domains=domain, publish=(Criteria(tuple(topics)),)),)
    grant = Grant("/n", "CN=/n", "", "", rules)
    if names is None:
        with pytest.raises(PolicyError, match="cannot be expressed in Zenoh"):
            rights_in_domain("/n", grant, 0)
    else:
        stated = rights_in_domain("/n", grant, 0)
        assert [(each.right.right, each.right.name) for each in stated] == [
            ("publish", name) for name in names
        ]


def test_what_permissions_allow_by_default_is_refused() -> None:
    domain = DomainSet.of((0, 0))
    rules = (Rule(allow=True, domains=domain, publish=(Criteria(("rt/a",)),)),)
    grant = Grant("/n", "CN=/n", "", "", rules)
    assert [each.right.name for each in rights_in_domain("/n", grant, 0)] == ["/a"]
    with pytest.raises(PolicyError, match="the permissions of /n: <default>ALLOW</default> cannot"):
        rights_in_domain("/n", grant._replace(default_allow=True), 0)


@pytest.mark.parametrize(
    ("words", "why"),
    [
        ("--endpoint robot:7447", ""),
        ("--endpoint robot:7447 --mode peer", "peer mode cannot reach both a router at robot"),
        ("--mode peer --endpoint 127.0.0.1:7447 --endpoint [::1]:7447", ""),
        ("--endpoint one:7447 --endpoint two:7447", "cannot listen at one and two"),
        ("--endpoint one:7447 --endpoint two:7447 --listen [::]:7447", ""),
        ("--endpoint localhost:7447 --endpoint robot:7447", "cannot listen at localhost and robot"),
        ("--endpoint robot:7447 --listen [::]:7448", "no session connects to port 7448"),
        ("--endpoint robot:7447 --listen localhost:7447", "only on its own host"),
        ("--endpoint robot:7447 --endpoint localhost:1 --listen localhost:1", ""),
    ],
)
def test_a_network_that_cannot_work_is_refused_when_it_is_asked_for(
    words: str, why: str, folder: Path
) -> None:
    before = snapshot(folder / "client")
    ended = sros("zenoh", "client", *words.split(), cwd=folder)
    if not why:
        ended.ok()
        return
    assert (ended.status, why in ended.err) == (2, True), ended.err
    assert snapshot(folder / "client") == before
