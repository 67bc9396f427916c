"""A narrowed policy allows no more than before, loses nothing that was observed, keeps denials."""

from __future__ import annotations

from itertools import count
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sros_tool.keystore.issuing.size import SizeEstimator, minimized_policy, right_bytes
from sros_tool.names import is_expression
from sros_tool.policy.document import policy_xml, read_policy
from sros_tool.policy.minimize import EnclaveUse, minimize, propose_wildcards
from sros_tool.policy.model import ALLOW, Group, Policy
from sros_tool.policy.rights import Right, Rules, policy_rights
from tests.policy.drawn_policies import effective, exact_names, listed, meant, policies

COMMON = (
    Group("topics", (("publish", ALLOW),), ("/rosout",)),
    Group("services", (("reply", ALLOW),), ("~/get_parameters",)),
)


def policy(groups: str, more: str = "", node: str = "n") -> Policy:
    text = (
        '<policy version="0.2.0"><enclaves><enclave path="/a"><profiles>'
        f'<profile ns="/ns" node="{node}">{groups}</profile>'
        f"</profiles></enclave>{more}</enclaves></policy>"
    )
    return read_policy(Path("/nowhere/a.xml"), text.encode())


def group(kind: str, names: str, rights: str) -> str:
    items = "".join(f"<{kind[:-1]}>{name}</{kind[:-1]}>" for name in names.split())
    attributes = " ".join(
        f'{right.strip("-")}="{"DENY" if right[0] == "-" else "ALLOW"}"' for right in rights.split()
    )
    return f"<{kind} {attributes}>{items}</{kind}>"


def seen(*rights: str) -> frozenset[Right]:
    return frozenset(Right("/a", ALLOW, *right.split()) for right in rights)


def use(given_policy: Policy, *rights: str, common: tuple[Group, ...] = ()) -> EnclaveUse:
    return minimize(given_policy, seen(*rights), common).uses[0]


@given(
    policies(),
    st.one_of(policies(qualifier=st.just(ALLOW)), policies(exact_names, st.just(ALLOW))),
    st.booleans(),
)
def test_between_what_was_observed_and_what_was_allowed(
    before: Policy, observed: Policy, strict: bool
) -> None:
    result = minimize(before, policy_rights(observed), () if strict else COMMON)
    for path, enclave_use in zip((each.path for each in before.enclaves), result.uses, strict=True):
        old, new = effective(before, path), effective(result.policy, path)
        assert new <= old
        assert old & meant(observed, path, allow=True) <= new
        assert listed(before, path, allow=False) == listed(result.policy, path, allow=False)
        assert enclave_use.observed <= enclave_use.remaining
        # An observed wildcard can complete an action for the one count and not for the other.
        if not any(is_expression(right.name) for right in policy_rights(observed)):
            assert enclave_use.remaining <= enclave_use.allowed
    again = minimize(result.policy, policy_rights(observed), () if strict else COMMON)
    assert policy_rights(again.policy) == policy_rights(result.policy)


def test_an_action_that_rests_on_names_and_a_wildcard_counts_once() -> None:
    before = policy(group("topics", "/x /*", "publish") + group("services", "/x /*", "reply"))
    found = use(before, "publish /*", "execute /x")
    assert found.observed <= found.remaining <= found.allowed


NARROWINGS = {
    "unused": (group("topics", "/x /y", "publish"), ["publish /x"],
               group("topics", "/x", "publish")),
    "one direction": (group("topics", "/x", "publish subscribe"), ["publish /x"],
                      group("topics", "/x", "publish")),
    "wildcard": (group("topics", "/*", "subscribe"), ["subscribe /x", "subscribe /b"],
                 group("topics", "/b /x", "subscribe")),
    "relative wildcard": (group("topics", "sub/*", "subscribe"), ["subscribe /ns/sub/x"],
                          group("topics", "sub/x", "subscribe")),
    "private wildcard": (group("services", "~/*", "reply"), ["reply /ns/n/s"],
                         group("services", "~/s", "reply")),
    "wildcard beside the name": (group("topics", "/x /*", "publish"), ["publish /x"],
                                 group("topics", "/x", "publish")),
    "wildcard used as such": (group("topics", "/*", "publish"), ["publish /x*"],
                              group("topics", "/x*", "publish")),
    "wildcard used for more": (group("topics", "/x*", "publish"), ["publish /*"],
                               group("topics", "/x*", "publish")),
    "denial": (group("topics", "/*", "publish") + group("topics", "/x", "-publish"),
               ["publish /x", "publish /y"],
               group("topics", "/y", "publish") + group("topics", "/x", "-publish")),
    "denied and allowed": (group("topics", "/x /y", "publish -subscribe"), ["publish /y"],
                           group("topics", "/x", "-subscribe")
                           + group("topics", "/y", "publish -subscribe")),
    "action": (group("actions", "f g", "call execute"), ["call /ns/f"],
               group("actions", "f", "call")),
    "action by wildcards": (group("services", "/*", "request") + group("topics", "/*", "subscribe"),
                            ["call /f"], group("actions", "/f", "call")),
    "not allowed": (group("topics", "/x", "publish"), ["publish /x", "publish /y"],
                    group("topics", "/x", "publish")),
}  # fmt: skip


@pytest.mark.parametrize(("before", "observed", "after"), NARROWINGS.values(), ids=NARROWINGS)
def test_narrowed(before: str, observed: list[str], after: str) -> None:
    assert minimize(policy(before), seen(*observed)).policy == policy(after)


def test_an_enclave_that_was_never_observed_stays() -> None:
    given_policy = policy(group("topics", "/* /x", "publish"))
    result = minimize(given_policy, [Right("/b", ALLOW, "publish", "/x")])
    assert result.policy == given_policy
    (found,) = result.uses
    assert not found.observed_at_all
    assert found.ratio is None
    assert {right.name for right in found.never_observed} == {"/*", "/x"}


def test_what_every_node_needs_stays_unless_strict() -> None:
    given_policy = policy(
        group("topics", "/rosout /x", "publish") + group("services", "~/*", "reply")
    )
    mild = minimize(given_policy, seen("publish /x"), COMMON)
    assert mild.policy == policy(
        group("topics", "/rosout /x", "publish") + group("services", "~/get_parameters", "reply")
    )
    assert [right.name for right in mild.uses[0].kept_for_every_node] == ["/rosout"]
    (wide,) = mild.uses[0].wildcards
    assert (wide.used, [right.name for right in wide.replacement]) == ((), ["/ns/n/get_parameters"])
    strict = minimize(given_policy, seen("publish /x"))
    assert strict.policy == policy(group("topics", "/x", "publish"))


def test_what_is_told() -> None:
    given_policy = policy(
        group("topics", "/x /y /cam/*", "publish") + group("topics", "/cam/secret", "-publish")
    )
    found = use(given_policy, "publish /x", "publish /cam/a", "publish /cam/secret", "call /f")
    assert [right.describe() for right in found.never_observed] == ["publish topic /y"]
    assert [(w.rule.name, [r.name for r in w.used]) for w in found.wildcards] == [
        ("/cam/*", ["/cam/a"])
    ]
    assert {right.describe() for right in found.not_allowed} == {
        "publish topic /cam/secret",
        "call action /f",
    }


@pytest.mark.parametrize(
    ("given_groups", "observed_rights", "in_part"),
    [
        (group("topics", "/x", "publish"), ["publish /x"], []),
        (group("actions", "/f", "call"), ["call /f"], []),
        (group("actions", "/f", "call"), ["subscribe /f/_action/feedback"], ["call action /f"]),
        (group("topics", "/x", "publish"), ["publish /x*"], ["publish topic /x*"]),
        (
            group("topics", "/x*", "publish"),
            ["publish /*y"],
            ["publish topic /*y", "publish topic /x*"],
        ),
        (
            group("topics", "/*", "publish") + group("topics", "/y", "-publish"),
            ["publish /*"],
            ["publish topic /*"],
        ),
    ],
)
def test_what_is_used_only_in_part_is_a_difference(
    given_groups: str, observed_rights: list[str], in_part: list[str]
) -> None:
    found = use(policy(given_groups), *observed_rights)
    assert sorted(right.describe() for right in found.in_part) == in_part
    assert found.is_as_observed == (not in_part)


def test_a_policy_is_as_it_is() -> None:
    given_policy = policy(group("topics", "/*", "publish") + group("topics", "/y", "-publish"))
    assert minimize(given_policy, policy_rights(given_policy)).uses[0].is_as_observed


def test_what_an_observed_file_denies_is_told(tmp_path: Path) -> None:
    paths = tmp_path / "robot.xml", tmp_path / "used.xml"
    denied = group("topics", "/y", "-publish")
    for path, groups in zip(paths, ("", denied), strict=True):
        given_policy = policy(group("topics", "/*", "publish") + groups)
        path.write_bytes(policy_xml(given_policy))
    for given_path, told in ((paths[0], ["minimize.observed-denial"]), (paths[1], [])):
        minimized = minimized_policy(given_path, [paths[1]])
        assert [note.id for note in minimized.notes] == told
        assert minimized.is_as_observed == (not told)


def test_the_ratio_counts_known_names() -> None:
    other = (
        '<enclave path="/b"><profiles><profile ns="/" node="n">'
        + group("topics", "/p /q", "publish subscribe")
        + group("services", "/s", "reply")
        + "</profile></profiles></enclave>"
    )
    given_policy = policy(
        group("topics", "/*", "publish") + group("topics", "/q", "-publish")
        + group("topics", "/x /y", "subscribe"),
        other,
    )  # fmt: skip
    # publish /p /x /y (known topics but /q, which is denied), subscribe /x /y
    found = use(given_policy, "publish /x", "subscribe /x")
    assert (found.allowed, found.observed, found.remaining) == (5, 2, 2)
    assert found.ratio == 2.5


def test_what_every_node_needs_is_known() -> None:
    found = use(policy(group("topics", "/*", "publish")), "publish /x", common=COMMON)
    assert (found.allowed, found.observed, found.remaining) == (2, 1, 2)
    groups = group("topics", "/rosout /x", "publish")
    groups += group("services", "~/get_parameters", "reply")
    for node, kept in (("n", 2), ("_ros2cli_*", 2), ("*", 1)):
        found = use(policy(groups, node=node), "publish /x", common=COMMON)
        assert (len(found.kept_for_every_node), len(found.never_observed)) == (kept, 2 - kept)


def test_wildcards_of_services_and_topics_count_known_actions() -> None:
    given_policy = policy(group("services", "/*", "request") + group("topics", "/*", "subscribe"))
    found = use(given_policy, "call /f", "request /s", "subscribe /t")
    assert (found.allowed, found.observed) == (3, 3)
    assert found.ratio == 1.0


# ── size, and wildcards that help ──────────────────────────────────────────────────────────


def test_the_size_of_a_right_is_what_it_adds() -> None:
    """In a document so large that its size matters."""
    scale = SizeEstimator()
    bare = group("topics", "/x", "publish subscribe") + group("services", "/s", "request reply")
    bare += group("topics", " ".join(f"/long/name/n{number}" for number in range(1500)), "publish")
    before = scale.signed_bytes(policy(bare).enclaves[0])
    for right in ("publish /longer/name", "request /srv", "call /fibonacci", "execute /f"):
        word, name = right.split()
        kind = Right("/a", ALLOW, word, name).kind
        after = scale.signed_bytes(policy(bare + group(kind, name, word)).enclaves[0])
        assert abs(after - before - right_bytes(Right("/a", ALLOW, word, name))) <= 8


def propose(names: list[str], foreign: list[str], needed: int) -> list[tuple[str, int, list[str]]]:
    own = [Right("/a", ALLOW, "publish", name) for name in names]
    known = own + [Right("/b", ALLOW, "subscribe", name) for name in foreign]
    found = propose_wildcards("/a", own, known, needed=needed, size=right_bytes)
    for each in found:
        assert all(Rules([each.rule]).cover(right) for right in each.replaces)
        assert each.saves == sum(map(right_bytes, each.replaces)) - right_bytes(each.rule)
    return [(p.rule.name, len(p.replaces), [r.name for r in p.adds]) for p in found]


FLEET = [f"/fleet/topic_{number}" for number in range(50)]


@pytest.mark.parametrize(
    ("names", "foreign", "proposed"),
    [
        (FLEET, [], [("/fleet/topic_*", 50, [])]),
        (FLEET, ["/fleet/stop"], [("/fleet/topic_*", 50, [])]),
        (FLEET, ["/fleet/topic_x"], [("/fleet/topic_*", 50, ["/fleet/topic_x"])]),
        ([*FLEET, "/fleet/a", "/fleet/b"], ["/other"], [("/fleet/*", 52, [])]),
        (
            [f"/robot{number}/scan" for number in range(9)],
            ["/robot1/stop"],
            [("/robot*/scan", 9, [])],
        ),
        (["/a", "/b", "/c", "/d"], [], []),
        (FLEET[:2], [], []),
        ([*FLEET, "/fleet/*"], [], []),  # a large document leaves these names out already
        ([*FLEET, "/fleet/topic_1*"], [], [("/fleet/topic_*", 39, [])]),
    ],
)
def test_proposed_wildcards(
    names: list[str], foreign: list[str], proposed: list[tuple[str, int, list[str]]]
) -> None:
    assert propose(names, foreign, 10_000) == proposed


def test_no_more_is_proposed_than_needed() -> None:
    names = [f"/{robot}/t{number}" for robot in ("p", "q", "r") for number in range(30)]
    assert len(propose(names, [], 100)) == 1
    assert len(propose(names, [], 100_000)) == 3


def test_a_wildcard_over_hidden_services_of_an_action_is_not_safe() -> None:
    own = [Right("/a", ALLOW, "request", f"/fleet/s{number}") for number in range(9)]
    own += [Right("/a", ALLOW, "request", f"/fleet/x/{name}") for name in "abcdefgh"]
    action = Right("/b", ALLOW, "execute", "/fleet/x/f")
    found = propose_wildcards("/a", own, [*own, action], needed=10**6, size=right_bytes)
    assert not any(each.adds == () for each in found if each.rule.name == "/fleet/*")


def test_an_enclave_that_does_not_change_has_one_size(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Signatures of the same permissions differ in length."""
    sizes = count(4000)
    monkeypatch.setattr(SizeEstimator, "signed_bytes", lambda *_: next(sizes))
    topics = '<topics publish="ALLOW"><topic>/x</topic>{}</topics>'
    paths = {}
    for name, more in (("robot", "<topic>/y</topic>"), ("used", "")):
        node = f'<profiles><profile ns="/" node="n">{topics.format(more)}</profile></profiles>'
        enclaves = "".join(f'<enclave path="{e}">{node}</enclave>' for e in ("/a", "/b"))
        paths[name] = tmp_path / f"{name}.xml"
        paths[name].write_text(
            f'<policy version="0.2.0"><enclaves>{enclaves}</enclaves></policy>'.replace(
                "/b" if name == "used" else "never", "/other"
            )
        )
    first, second = minimized_policy(paths["robot"], [paths["used"]]).enclaves
    assert first.bytes.before != first.bytes.after
    assert second.bytes.before == second.bytes.after
