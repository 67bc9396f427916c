"""The enclave of a secured node is found by its identifier where the graph does not show it."""

from __future__ import annotations

from cryptography import x509

from sros_tool.graph.learn import learn
from sros_tool.graph.observe import with_certified_enclaves
from sros_tool.pki.certificates import common_name, identity_of
from tests.graph.graphs import graph, node

# As Fast DDS 2.14.5 gave them to participants of these enclaves.
TALKER = "daf710ced9771cd6134cada3"
LISTENER = "bbdd199c75228623f41ce8bb"
UNSECURED = "010f7f01f44ad24700000000"


def subject(name: str) -> bytes:
    found: x509.Name = common_name(name)
    return found.public_bytes()


ENCLAVES = {
    identity_of(subject(name)): name
    for name in ("/talker_listener/talker", "/talker_listener/listener", "/")
}


def test_the_identity_is_that_of_the_library() -> None:
    assert ENCLAVES[TALKER[:12]] == "/talker_listener/talker"
    assert ENCLAVES[LISTENER[:12]] == "/talker_listener/listener"


def test_nodes_with_the_enclave_in_a_variable_are_told_apart() -> None:
    seen = graph(
        node("/talker", "publish chatter", participant=TALKER, enclave="/"),
        node("/listener", "subscribe chatter", participant=LISTENER, enclave="/"),
        node("/viewer", "subscribe chatter", participant=UNSECURED, enclave="/"),
    )
    found = {each.name: each.enclaves for each in with_certified_enclaves(seen, ENCLAVES).nodes}
    assert found == {
        "talker": ("/talker_listener/talker",),
        "listener": ("/talker_listener/listener",),
        "viewer": ("/",),
    }


def test_what_a_node_announces_counts_less_than_its_certificate() -> None:
    seen = graph(node("/talker", "publish chatter", participant=TALKER, enclave="/boss"))
    (found,) = with_certified_enclaves(seen, ENCLAVES).nodes
    assert found.enclaves == ("/talker_listener/talker",)


def test_a_secured_node_of_unknown_enclave_is_left_out_and_said() -> None:
    seen = graph(
        node("/talker", "publish chatter", participant=TALKER, enclave="/"),
        node("/other", "publish x", participant="ff" * 12, enclave="/"),
        node("/named", "publish y", participant="ee" * 12, enclave="/named"),
    )
    learned = learn(with_certified_enclaves(seen, ENCLAVES))
    assert {each.enclave for each in learned.profiles} == {"/talker_listener/talker", "/named"}
    (note,) = learned.notes
    assert note.id == "graph.unknown-enclave"
    assert ": /other. " in note.text and "--keystore" in note.text
