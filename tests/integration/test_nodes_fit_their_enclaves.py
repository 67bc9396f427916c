"""What rclpy nodes put on the DDS is what the signed permissions of their enclave allow.

This is how a DDS that enforces security would judge them, seen without one: the nodes run
unsecured, everything that they write and read is taken from the ROS graph, and the decision engine
for the Fast DDS of ROS 2 Jazzy is asked about each of it.  A demo node whose name is not one that
its enclave allows, or a policy without a right that every node needs, fails here on every machine.
"""

from __future__ import annotations

import importlib.util
from collections import defaultdict
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from sros_tool.dds.decision.access import Access, AccessVerb, Outcome
from sros_tool.dds.decision.vendors import Vendor
from sros_tool.dds.domains import DomainSet
from sros_tool.demo.backend import RCLPY, Backend, conditions
from sros_tool.demo.casting import DEFAULT_NODE_NAMES
from sros_tool.demo.keystores import KeystoreSet, KeystoreSpec, create_keystores
from sros_tool.demo.scenarios import SCENARIOS
from sros_tool.demo.scenarios.model import DENIALS, Party, Relation, Role, Row, RowStatus, Scenario
from sros_tool.files import policies_dir
from sros_tool.keystore.layout import enclave_path
from sros_tool.keystore.lifecycle.create import generate_artifacts
from sros_tool.keystore.template import load_template
from sros_tool.names import NODE_SERVICES, ROS_DISCOVERY_TOPIC, dds_names, expand
from sros_tool.pki import smime
from sros_tool.pki.certificates import load_certificate, subject_text
from sros_tool.policy.document import read_policy
from sros_tool.policy.model import Enclave
from tests.dds.decision_documents import access_of as access_of_documents
from tests.integration.test_policies_live import all_dds_endpoints, observed_in, without
from tests.integration.test_policies_live import observe as look
from tests.support.children import LONG
from tests.support.long_form import ONLY_LONG, some
from tests.support.users import as_root

pytestmark = [
    pytest.mark.dds,
    pytest.mark.skipif(importlib.util.find_spec("rclpy") is None, reason="rclpy is not here"),
    as_root,
]

TOPIC = "/chatter"
DOMAIN = 7
BACKEND = Backend(RCLPY, "Fast DDS 2.14.5", "a test")
RIGHT = {
    Role.TALKER: "publish",
    Role.LISTENER: "subscribe",
    Role.SERVER: "reply",
    Role.CLIENT: "request",
    Role.ACTION_SERVER: "execute",
    Role.ACTION_CLIENT: "call",
}
"""The right that a process of one node needs beside those of every node."""

Endpoint = tuple[AccessVerb, str]
Key = tuple[Role, tuple[str, ...], str]
"""What decides which endpoints a process has: its role, the names of its nodes, its ROS name."""


# ── deciding ───────────────────────────────────────────────────────────────────────────────


def access_of(root: Path, enclave: str) -> Access:
    """What Fast DDS 2.14 decides for an enclave by the documents that lie in its folder."""
    folder = enclave_path(root, enclave)
    governance, permissions = (
        smime.parse((folder / f"{name}.p7s").read_bytes()).document
        for name in ("governance", "permissions")
    )
    certificate = load_certificate((folder / "cert.pem").read_bytes(), enclave)
    subject, now = subject_text(certificate.subject), datetime.now(UTC)
    access = access_of_documents(
        Vendor.FAST, governance, permissions, subject, domain=DOMAIN, at=now
    )
    assert isinstance(access, Access), access
    return access


def denied(access: Access, endpoints: set[Endpoint]) -> set[Endpoint]:
    """The endpoints that the node's own DDS does not create."""
    created = (Outcome.ALLOWED, Outcome.PEER_DENIES)
    return {
        (verb, topic)
        for verb, topic in endpoints
        if access.decide(verb, topic).outcome not in created
    }


def endpoints_of(nodes: list[dict[str, Any]]) -> set[Endpoint]:
    """What these nodes write and read as the graph has it, and what every participant does."""
    found = {(AccessVerb(way), topic) for each in nodes for way, topic in raw(each)}
    return found | {
        (AccessVerb.PUBLISH, ROS_DISCOVERY_TOPIC),
        (AccessVerb.SUBSCRIBE, ROS_DISCOVERY_TOPIC),
    }


def raw(node: dict[str, Any]) -> Iterator[tuple[str, str]]:
    yield from ((way, topic) for way in ("publish", "subscribe") for topic in node["raw"][way])


def named(right: str, name: str) -> set[Endpoint]:
    topics = dds_names(right, name)
    return {(AccessVerb.PUBLISH, topic) for topic in topics.publish} | {
        (AccessVerb.SUBSCRIBE, topic) for topic in topics.subscribe
    }


# ── the nodes of the demo ──────────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class Casting:
    """A secured party of a row, in the keystores that were made for its scenario."""

    row: Row
    party: Party
    keystores: KeystoreSet

    @property
    def key(self) -> Key:
        return (
            self.party.role,
            self.keystores.node_names(self.party),
            self.keystores.topic(self.party, TOPIC),
        )

    @property
    def refused(self) -> RowStatus | None:
        """The denial that the row expects of this party."""
        for claim in self.row.claims:
            if claim.relation is Relation.IS_REFUSED and claim.subject == self.party.name:
                return RowStatus.REFUSED
            if claim.denied in DENIALS and self.party.intruder:
                return claim.denied
        return None


def castings(scenario: Scenario, folder: Path) -> Iterator[Casting]:
    template = load_template("production")
    rows = tuple(
        row.with_expected_status(conditions(BACKEND, template, "rt/chatter"))
        for row in scenario.rows
    )
    spec = KeystoreSpec(TOPIC, DomainSet.of((DOMAIN, DOMAIN)), template, datetime.now(UTC))
    keystores = create_keystores(folder, replace(scenario, rows=rows), spec)
    assert not keystores.missing
    for row in rows:
        yield from (
            Casting(row, party, keystores)
            for party in row.parties
            if party.identity.keystore is not None
        )


PLAYED = [each for each in SCENARIOS if each.name == "services" or each in some(SCENARIOS, 1)]
"""The scenario with clients, and one that is drawn; in the long form all."""


@pytest.fixture(scope="module")
def cast(tmp_path_factory: pytest.TempPathFactory) -> list[Casting]:
    folder = tmp_path_factory.mktemp("cast")
    return [each for s in PLAYED for each in castings(s, folder / s.name)]


@pytest.fixture(scope="module")
def seen(cast: list[Casting]) -> dict[Key, list[dict[str, Any]]]:
    """The nodes of every process that differs, as the graph shows them."""
    keys = some(sorted({each.key for each in cast}), 2)
    # The graph knows nodes by their names, so that those of one name go into separate networks.
    rounds: defaultdict[int, dict[str, Key]] = defaultdict(dict)
    borne: defaultdict[str, int] = defaultdict(int)
    for number, key in enumerate(keys):
        place = max(borne[name] for name in key[1])
        rounds[place][f"/process_{number}"] = key
        borne.update(dict.fromkeys(key[1], place + 1))
    with ThreadPoolExecutor(2) as several:
        shown = list(several.map(observe, rounds.values(), range(len(rounds))))
    return {key: nodes for found in shown for key, nodes in found.items()}


def known(role: Role, name: str, topic: str) -> set[str]:
    """The DDS topics without which a node is not yet seen whole."""
    endpoints = {pair for each in NODE_SERVICES for pair in named("reply", f"{name}/{each}")}
    if role in RIGHT:
        endpoints |= named(RIGHT[role], topic)
    return {dds_topic for _, dds_topic in endpoints}


def observe(processes: dict[str, Key], number: int) -> dict[Key, list[dict[str, Any]]]:
    question = {
        label: {
            "command": BACKEND.command(role, ["--topic", topic], names),
            "nodes": len(names),
            "topics": {name: sorted(known(role, name, topic)) for name in names},
        }
        for label, (role, names, topic) in processes.items()
    }
    nodes = look(220 + number, question)
    return {
        key: [each for each in nodes if each["enclave"] == label]
        for label, key in processes.items()
    }


def test_demo_nodes_bear_their_names_and_offer_their_services(
    seen: dict[Key, list[dict[str, Any]]],
) -> None:
    """What is missing in the graph could not be found to be denied."""
    assert len(seen) > (15 if LONG else 1)
    for (role, names, topic), nodes in seen.items():
        shown = {expand(each["name"], each["ns"], "") for each in nodes}
        assert shown == set(names), role
        endpoints = endpoints_of(nodes)
        for name in names:
            for service in NODE_SERVICES:
                assert named("reply", f"{name}/{service}") <= endpoints, (role, name, service)
        if role in RIGHT:
            assert named(RIGHT[role], topic) <= endpoints, role


def test_demo_nodes_do_what_their_enclave_allows_and_are_denied_what_the_row_wants(
    cast: list[Casting], seen: dict[Key, list[dict[str, Any]]]
) -> None:
    wrong = []
    asked: list[set[Endpoint]] = []
    for each in cast:
        if each.refused is RowStatus.NOT_LET_IN or each.row.attack == "world-readable keys":
            continue  # the documents or the files do not get as far as a right
        if each.key not in seen:
            continue  # not drawn
        identity = each.party.identity
        assert identity.keystore is not None
        root = each.keystores.keystores[identity.keystore]
        enclave = each.keystores.enclave(identity)
        if not (enclave_path(root, enclave) / "permissions.p7s").exists():
            continue  # the row takes them away
        access = access_of(root, enclave)
        endpoints = endpoints_of(seen[each.key])
        asked.append(endpoints)
        refused = denied(access, endpoints)
        role, _, topic = each.key
        of_the_row = (
            {pair for one in RIGHT.values() for pair in named(one, topic)}
            | named("reply", "/add_two_ints")
            if role is Role.COMPOSED
            else named(RIGHT.get(role, "subscribe"), topic)
        )
        if each.refused is None and refused:
            wrong.append(f"{each.row.name}: {each.party.name} is denied {sorted(refused)}")
        if each.refused is RowStatus.REFUSED and not refused:
            wrong.append(f"{each.row.name}: {each.party.name} is denied nothing")
        if refused - of_the_row:
            others = sorted(refused - of_the_row)
            wrong.append(f"{each.row.name}: {each.party.name} is denied {others} besides")
    assert wrong == []
    assert len(asked) > (100 if LONG else 0)
    assert all(len(endpoints) > 15 for endpoints in asked), "those of every node, at least"


def test_it_would_see_a_node_under_another_name(cast: list[Casting]) -> None:
    """The names that the demo's nodes have by themselves are not those of the shipped policies."""
    client = next(each for each in cast if each.party.role is Role.CLIENT)
    (own,), (name,) = DEFAULT_NODE_NAMES[Role.CLIENT], client.key[1]
    assert name == "/add_two_ints_client" != f"/{own}"
    identity = client.party.identity
    assert identity.keystore is not None
    access = access_of(client.keystores.keystores[identity.keystore], "/add_two_ints/client")
    services = {pair for each in NODE_SERVICES for pair in named("reply", f"{name}/{each}")}
    assert not denied(access, services)
    elsewhere = {pair for each in NODE_SERVICES for pair in named("reply", f"/{own}/{each}")}
    assert denied(access, elsewhere) == elsewhere


# ── the nodes of the shipped policies ──────────────────────────────────────────────────────

SYSTEMS = ("add_two_ints", "composition", "fibonacci", "mobile_robot", "talker_listener")
WITH_MOST = ("composition", "mobile_robot")
"""Those that have all that the others have: topics, services, actions, many nodes in a process."""


@pytest.fixture(scope="module")
def keystore(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("shipped") / "keystore"
    generate_artifacts(
        root,
        policies=[read_policy(policies_dir() / f"{system}.xml") for system in SYSTEMS],
        now=datetime.now(UTC),
        create=load_template("production"),
        domains=DomainSet.of((DOMAIN, DOMAIN)),
    )
    return root


def nodes_of(enclave: Enclave) -> list[dict[str, Any]]:
    """The nodes of an enclave's profiles, with everything that the policy names for them."""
    nodes = []
    for profile in enclave.all_profiles():
        rights: dict[str, list[str]] = {}
        for group in profile.groups:
            for right, word in group.rights:
                if word == "ALLOW":
                    names = (name for name in group.names if not set(name) & set("*?["))
                    rights.setdefault(right, []).extend(names)
        managed = "~/change_state" in rights.get("reply", ())
        given = {
            right: sorted({name for name in names if not is_of_every_node(name, managed=managed)})
            for right, names in rights.items()
        }
        nodes.append({"name": profile.node, "ns": profile.ns, "managed": managed, **given})
    return nodes


def is_of_every_node(name: str, *, managed: bool) -> bool:
    """Whether a node has this by itself."""
    own = name.removeprefix("~/")
    basic = name in ("/rosout", "/parameter_events", "/clock") or own in NODE_SERVICES
    states = ("change_state", "get_state", "get_available_states", "get_available_transitions",
              "get_transition_graph", "transition_event")  # fmt: skip
    return basic or "/_action/" in name or (managed and own in states)


@pytest.mark.parametrize(
    "system",
    [
        *some([*WITH_MOST], 1),
        *(pytest.param(each, marks=ONLY_LONG) for each in SYSTEMS if each not in WITH_MOST),
    ],
)
def test_the_nodes_of_a_shipped_policy_are_denied_nothing(system: str, keystore: Path) -> None:
    enclaves = some(read_policy(policies_dir() / f"{system}.xml").enclaves, 2)
    processes = {each.path: nodes_of(each) for each in enclaves}
    seen = look(230, processes)
    for enclave in enclaves:
        nodes = [each for each in seen if each["enclave"] == enclave.path]
        assert len(nodes) == len(processes[enclave.path])
        endpoints = endpoints_of(nodes)
        for node in nodes:
            own = expand(node["name"], node["ns"], "")
            for service in NODE_SERVICES:
                assert named("reply", f"{own}/{service}") <= endpoints
        access = access_of(keystore, enclave.path)
        assert access.join().outcome is Outcome.ALLOWED, access.join()
        assert denied(access, endpoints) == set(), enclave.path


@pytest.mark.parametrize(
    ("right", "name"),
    [
        ("publish", "/rosout"),
        ("publish", "/parameter_events"),
        ("subscribe", "/clock"),
        *(("reply", f"~/{service}") for service in NODE_SERVICES),
    ],
)
def test_a_policy_without_what_every_node_needs_is_found(
    right: str, name: str, tmp_path: Path
) -> None:
    policy = read_policy(policies_dir() / "talker_listener.xml")
    path = "/talker_listener/talker"
    enclave = policy.enclave(path)
    assert enclave is not None
    lacking = without(enclave, right, expand(name, "/", "talker"))
    root = tmp_path / "keystore"
    generate_artifacts(
        root,
        policies=[replace(policy, enclaves=(lacking,))],
        now=datetime.now(UTC),
        create=load_template("production"),
        domains=DomainSet.of((DOMAIN, DOMAIN)),
    )
    nodes = observed_in("talker_listener", path)
    assert len(all_dds_endpoints(nodes)) > 15
    found = denied(access_of(root, path), endpoints_of(nodes))
    assert found == named(right, expand(name, "/", "talker"))
