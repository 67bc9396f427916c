"""``sros explain --vendor zenoh``: by the files as they are, link by link."""

from __future__ import annotations

import json
import random
import shutil
from itertools import product
from pathlib import Path
from typing import Any

import pytest

from sros_tool.cli.common import now
from sros_tool.explain.answer import ask
from sros_tool.explain.zenoh import ZenohEvaluator
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.policy.document import read_policy
from sros_tool.policy.rights import Rules, policy_rights, split_actions
from tests.explain.zenoh_policies import NAMES, OTHER_END, WORD, drawn_policy
from tests.support.children import LONG
from tests.support.harness import Ended, copy_of, policy_text, publish, sros
from tests.support.long_form import some

HERE = {"RMW_IMPLEMENTATION": "rmw_fastrtps_cpp", "TZ": "UTC"}
POLICY = policy_text(
    {
        "/talker": publish("/chatter"),
        "/listener": publish("/chatter").replace("publish", "subscribe"),
        "/wide": publish("/cam*") + '<services request="ALLOW"><service>/add</service>'
        "<service>/go/_action/send_goal</service></services>",
        "/recorder": publish("/*").replace("publish", "subscribe"),
        "/server": '<services reply="ALLOW"><service>/add</service></services>'
        '<actions execute="ALLOW"><action>/go</action></actions>',
        "/client": '<actions call="ALLOW"><action>/go</action></actions>',
    }
)
MODES = ("client", "peer")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Keystores named after the modes of their sessions; and the policy."""
    folder = tmp_path_factory.mktemp("zenoh")
    (folder / "policy.xml").write_text(POLICY)
    for mode in MODES:
        sros("create_keystore", folder / mode, "--template", "production").ok()
        sros("generate_artifacts", "-k", folder / mode, "-p", folder / "policy.xml").ok()
        sros("zenoh", folder / mode, "--mode", mode).ok()
    return folder


@pytest.fixture
def keystore(made: Path, tmp_path: Path) -> Path:
    return copy_of(made / "client", tmp_path / "ks")


def explain(*words: object, env: dict[str, str | None] | None = None) -> Ended:
    return sros("explain", *words, env={**HERE, **(env or {})})


def zenoh(*words: object) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(explain(*words, "--vendor", "zenoh", "--json").out)
    return found


ALLOWED = [
    ("/talker publish /chatter", ["/listener", "/recorder"]),
    ("/listener subscribe /chatter", ["/talker"]),
    ("/recorder subscribe /chatter", ["/talker"]),
    ("/wide publish /camera", ["/recorder"]),
    ("/wide call /add", ["/server"]),
    ("/server serve /add", ["/wide"]),
    ("/client call /go", ["/server"]),
    ("/server execute /go", ["/client"]),
    ("/talker join", []),
]
DENIED = [
    "/listener publish /chatter",
    "/talker subscribe /chatter",
    "/client call /add",
    "/server call /add",
    "/client execute /go",
    "/talker publish /camera",
]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(("words", "reached"), some(ALLOWED, 4))
def test_what_is_allowed_and_whom_it_reaches(
    made: Path, mode: str, words: str, reached: list[str]
) -> None:
    found = zenoh(made / mode, *words.split())
    assert (found["outcome"], found["mode"]) == ("allowed", mode)
    assert [each["enclave"] for each in found["reached"]] == reached
    assert all(check["rules"] for link in found["links"] for check in link["checks"])
    assert (found["out_of_date"], found["unsigned"], found["permitted"]) == ([], [], True)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("words", some(DENIED, 3))
def test_what_is_denied_is_dropped_without_an_error(made: Path, mode: str, words: str) -> None:
    shown = explain(made / mode, *words.split(), "--vendor", "zenoh")
    assert shown.status == 1
    assert "silently dropped" in shown.out
    found = zenoh(made / mode, *words.split())
    assert found["outcome"] == "dropped"
    assert found["change"], found
    for link in found["links"]:
        enforcers = {each["enforcer"] for each in link["checks"] if not each["allowed"]}
        assert enforcers == set(link["enclaves"]), "the session itself and the router"


def test_each_link_is_shown_with_who_enforces_it_by_which_rule(made: Path) -> None:
    shown = explain(made / "client", "/talker", "publish", "/chatter", "--vendor", "zenoh").ok()
    assert shown.out.startswith(
        "yes: /talker may publish topic /chatter, on Zenoh in client mode (as asked)\n"
    )
    assert "put 0/chatter/any::type/hash: leaving /talker by rule /router#" in shown.out
    assert ", entering /router by rule /talker#" in shown.out
    assert "heard by  /listener, /recorder" in shown.out


def test_the_line_of_the_policy_is_shown(made: Path) -> None:
    policy = made / "policy.xml"
    asked = (made / "client", "/talker", "publish", "/chatter", "--policy", policy)
    shown = explain(*asked, "--vendor", "zenoh").ok()
    assert f"from      {policy}:1: ALLOW publish /chatter" in shown.out


@pytest.mark.parametrize("mode", MODES)
def test_what_a_wildcard_reaches(made: Path, mode: str) -> None:
    """A put on all of /cam* gets to whom may subscribe to as much, and to nobody else."""
    found = zenoh(made / mode, "/wide", "publish", "/camera")
    assert found["wildcards"] == [
        {"expression": "0/cam$*/**/$*::$*/*/**", "reaches": ["/recorder"]}
    ]
    exact = zenoh(made / mode, "/talker", "publish", "/chatter")
    assert exact["wildcards"] == []


@pytest.mark.parametrize("mode", MODES)
def test_who_may(made: Path, mode: str) -> None:
    found = zenoh(made / mode, "--who", "subscribe", "/chatter")
    able = {each["enclave"]: each["wildcard"] for each in found["enclaves"] if each["allowed"]}
    wide = "0/*/**/$*::$*/*/**"
    assert able == {"/listener": None, "/recorder": wide, "/router": None}
    shown = explain(made / mode, "--who", "subscribe", "/chatter", "--vendor", "zenoh").ok()
    assert f"/recorder  by the wildcard {wide}\n/router\n3 of 7 enclaves may" in shown.out
    assert explain(made / mode, "--who", "call", "/nope", "--vendor", "zenoh").status == 1


@pytest.mark.parametrize("vendor", ["zenoh", "fastdds"])
def test_who_may_command_an_action_without_calling_the_whole(made: Path, vendor: str) -> None:
    """/wide may send goals by a right to a service, which moves the robot."""
    by = ("--vendor", vendor)
    lines = explain(made / "client", "--who", "call", "/go", *by).ok().out.splitlines()
    whole = ["/client", "/router"] if vendor == "zenoh" else ["/client"]
    assert lines[:-1] == ["/wide  in part: send_goal", *whole]
    count = f"1 of 7 enclaves may call action /go in part, {len(whole)} as a whole"
    assert lines[-1] == count
    shown = json.loads(explain(made / "client", "--who", "call", "/go", *by, "--json").out)
    parts = {each["enclave"]: each["in_part"] for each in shown["enclaves"] if each["in_part"]}
    assert parts == {"/wide": ["send_goal"]}
    alone = explain(made / "client", "/wide", "call", "/go", *by)
    assert alone.status == 1
    assert "may do a part of the action, which is enough to command the server: " in alone.err
    assert "in-part" not in explain(made / "client", "/talker", "call", "/go", *by).err


def test_a_part_of_an_action_that_no_enclave_names_is_noted(tmp_path: Path) -> None:
    policy = tmp_path / "p.xml"
    policy.write_text(
        policy_text({"/ui": '<services request="ALLOW"><service>/go/*</service></services>'})
    )
    keystore = tmp_path / "ks"
    sros("generate_artifacts", "-k", keystore, "-p", policy).ok()
    sros("zenoh", keystore).ok()
    on_zenoh = ("--vendor", "zenoh")
    questions = ("--who", "call", "/go"), ("/ui", "call", "/go")
    for (place, vendor), words in product(((policy, ()), (keystore, on_zenoh)), questions):
        asked = explain(place, *words, *vendor)
        assert asked.status == 1 and "may do a part of 'call action /go': add --type" in asked.err
    of_service = explain(keystore, "/ui", "call", "/go", *on_zenoh, "--type", "service")
    assert "explain.an-action" not in of_service.err


def test_who_may_says_what_each_enclave_is_told(made: Path) -> None:
    evaluator = ZenohEvaluator(OpenedKeystore(made / "client"), moment=now(), domain=0)
    outcomes = set()
    for enclave, words in product(evaluator.names, ("publish /chatter", "call /add", "join")):
        question = ask(*words.split())
        brief = evaluator.answer(enclave, question, reach=False, brief=True)
        whole = evaluator.answer(enclave, question)
        assert brief.in_brief == whole.in_brief, (enclave, words)
        outcomes.add(whole.outcome)
    assert outcomes == {"allowed", "dropped"}


def test_who_may_reads_the_files_of_each_enclave(keystore: Path) -> None:
    """An enclave that cannot start is refused, also if the router would drop its message."""
    (keystore / "enclaves/listener/cert.pem").write_text("no certificate")
    outcome = {}
    for right in ("subscribe", "publish"):
        asked = zenoh(keystore, "--who", right, "/chatter")
        outcome[right] = {e["enclave"]: e["outcome"] for e in asked["enclaves"]}["/listener"]
    assert outcome == {"subscribe": "refused", "publish": "refused"}
    missing = keystore / "enclaves/wide/session.json5"
    missing.unlink()
    asked = zenoh(keystore, "--who", "publish", "/chatter")
    assert {e["enclave"]: e["outcome"] for e in asked["enclaves"]}["/wide"] == "refused"


@pytest.mark.parametrize("mode", MODES)
def test_reach_follows_the_rules_of_zenoh(made: Path, tmp_path: Path, mode: str) -> None:
    asked = ("--reach", "/client", "--vendor", "zenoh", "--json")
    answered = explain(made / mode, *asked).ok()
    found = json.loads(answered.out)
    on_dds = explain(made / mode, *asked[:2], "--json").ok()
    assert found == json.loads(on_dds.out)
    follow = "This is not followed: `--reach /router` shows whom the router reaches."
    assert follow in answered.err and "router" not in on_dds.err
    assert [each["enclave"] for each in found["influences"]] == ["/recorder", "/server", "/wide"]
    if mode == "client":
        changed = copy_of(made / mode, tmp_path / "ks")
        router = changed / "enclaves/router/router.json5"
        router.write_text(router.read_text().replace("/go/_action/", "/went/_action/", 1))
        assert json.loads(explain(changed, *asked).ok().out) != found


@pytest.mark.parametrize("mode", MODES)
def test_the_rules_of_zenoh_are_the_rights_of_the_keystore(made: Path, mode: str) -> None:
    router = made / mode / "enclaves/router/router.json5"
    sros("diff_policy", made / mode, router).ok()
    sros("diff_policy", made / "policy.xml", router).ok()


def test_diff_and_view_show_where_the_worlds_differ(keystore: Path, tmp_path: Path) -> None:
    router = keystore / "enclaves/router/router.json5"
    router.write_text(router.read_text().replace("0/chatter/$*::", "0/other/$*::"))
    shown = sros("diff_policy", keystore, router)
    assert shown.status == 1
    assert "- /talker ALLOW publish topic /chatter\n" in shown.out
    assert "+ /talker ALLOW publish topic /other\n" in shown.out
    picture = json.loads(sros("view", keystore, router, "--format", "json").ok().out)
    assert picture["overlay"]["kind"] == "worlds"
    marks = {each["text"]: each["mark"] for each in picture["differences"]}
    assert marks["/talker ALLOW publish topic /other"] == "second"
    alone = json.loads(sros("view", router, "--format", "json").ok().out)
    assert [each["path"] for each in alone["enclaves"]] == sorted(
        ["/client", "/listener", "/recorder", "/server", "/talker", "/wide"]
    )


def test_rules_that_enforce_nothing_are_noted(keystore: Path) -> None:
    router = keystore / "enclaves/router/router.json5"
    document = json.loads(router.read_text())
    document["access_control"]["enabled"] = False
    router.write_text(json.dumps(document))
    assert "note [rights.zenoh-open]" in sros("diff_policy", keystore, router).err


# ── files that are not as they should be ───────────────────────────────────────────────────


def test_without_its_file_an_enclave_opens_no_session(keystore: Path) -> None:
    (keystore / "enclaves/listener/session.json5").unlink()
    found = zenoh(keystore, "/listener", "subscribe", "/chatter")
    assert found["outcome"] == "refused"
    assert "it has no session.json5" in found["text"]
    assert found["out_of_date"] == ["enclaves/listener/session.json5"]
    assert "sros zenoh" in found["remedy"]
    talker = zenoh(keystore, "/talker", "publish", "/chatter")
    assert talker["allowed"]
    assert [each["enclave"] for each in talker["reached"] if each["problem"]] == ["/listener"]


def test_the_answer_is_by_the_file_as_it_is(keystore: Path) -> None:
    """Whoever changes the router's file gives rights: the answer says so, and the notes why."""
    router = keystore / "enclaves/router/router.json5"
    session = keystore / "enclaves/talker/session.json5"
    for file in (router, session):
        file.write_text(file.read_text().replace("0/chatter/", "0/other/"))
    found = zenoh(keystore, "/talker", "publish", "/other")
    assert (found["allowed"], found["permitted"]) == (True, False)
    assert found["unsigned"] == ["/talker/session.json5", "/router/router.json5"]
    assert found["out_of_date"] == [
        "enclaves/router/router.json5",
        "enclaves/talker/session.json5",
    ]
    shown = explain(keystore, "/talker", "publish", "/other", "--vendor", "zenoh")
    for note in ("explain.zenoh-differs", "explain.zenoh-out-of-date", "explain.zenoh-unsigned"):
        assert f"note [{note}]" in shown.err
    assert zenoh(keystore, "/talker", "publish", "/chatter")["outcome"] == "dropped"


def test_a_peer_whose_file_is_not_signed_is_named(made: Path, tmp_path: Path) -> None:
    changed = copy_of(made / "peer", tmp_path / "ks")
    (changed / "enclaves/listener/session.p7s").unlink()
    found = zenoh(changed, "/talker", "publish", "/chatter")
    assert found["out_of_date"] == ["enclaves/listener/session.p7s"]


def test_a_peer_with_other_rules_is_named(made: Path, tmp_path: Path) -> None:
    """Each peer decides by its own file: one that differs drops what the others let through."""
    changed = copy_of(made / "peer", tmp_path / "ks")
    file = changed / "enclaves/listener/session.json5"
    file.write_text(file.read_text().replace("0/chatter/", "0/other/"))
    found = zenoh(changed, "/talker", "publish", "/chatter")
    assert [each["enclave"] for each in found["reached"]] == ["/recorder"]
    assert found["out_of_date"] == ["enclaves/listener/session.json5"]


def test_peers_that_let_through_what_the_router_denies_are_named(
    made: Path, tmp_path: Path
) -> None:
    changed = copy_of(made / "peer", tmp_path / "ks")
    for name in ("talker", "listener"):
        file = changed / f"enclaves/{name}/session.json5"
        file.write_text(file.read_text().replace("0/chatter/", "0/other/"))
    found = zenoh(changed, "/talker", "publish", "/other")
    assert (found["outcome"], found["permitted"]) == ("allowed", False)
    assert [each["enclaves"] for each in found["links"]] == [["/talker", "/listener"]]
    assert zenoh(changed, "/wide", "publish", "/other")["outcome"] == "dropped"


def test_a_copy_without_keys_is_answered_as_if_they_were_there(keystore: Path) -> None:
    for key in keystore.glob("enclaves/**/key.pem"):
        key.unlink()
    for words in (("/talker", "publish", "/chatter"), ("--who", "publish", "/chatter")):
        said = explain(keystore, *words, "--vendor", "zenoh").ok()
        assert "note [explain.without-keys]: no enclave in" in said.err
    assert zenoh(keystore, "/talker", "publish", "/chatter")["counts_key"] is True
    assert zenoh(keystore, "/talker", "join")["counts_key"] is False


def test_an_export_is_answered_by_its_own_cas(keystore: Path, tmp_path: Path) -> None:
    export = tmp_path / "export"
    sros("distribute_key", keystore, "--all", export).ok()
    questions = (("/talker", "publish", "/chatter"), ("--who", "publish", "/chatter"))
    for words in questions:
        said = explain(export, *words, "--vendor", "zenoh").ok()
        assert "zenoh-unsigned" not in said.err
    assert "note [explain.export]" in said.err
    with (export / "enclaves/router/router.json5").open("a") as file:
        file.write(" ")
    for words in questions:
        said = explain(export, *words, "--vendor", "zenoh").ok()
        assert "CA has not signed /router/router.json5: anyone who can write" in said.err


def test_a_file_that_zenoh_does_not_accept(keystore: Path) -> None:
    (keystore / "enclaves/router/router.json5").write_text('{"mode": "router\x1b"}')
    shown = explain(keystore, "/talker", "publish", "/chatter", "--vendor", "zenoh")
    assert shown.status == 1
    assert "no link to the router /router: Zenoh does not accept its router.json5" in shown.out
    assert "\x1b" not in shown.out


def test_sessions_that_connect_elsewhere_have_no_link(keystore: Path) -> None:
    file = keystore / "enclaves/talker/session.json5"
    file.write_text(file.read_text().replace("localhost:7447", "localhost:7448"))
    found = zenoh(keystore, "/talker", "publish", "/chatter")
    assert found["outcome"] == "refused"
    assert "connects to tls/localhost:7448" in found["text"]


def test_an_expired_certificate_gets_no_link(made: Path) -> None:
    found = zenoh(made / "client", "/talker", "publish", "/chatter", "--at", "3y")
    assert found["outcome"] == "refused"
    assert "expired" in found["text"]


def test_a_certificate_of_another_enclave_gets_no_link(keystore: Path) -> None:
    """Zenoh gives its process the rights of the other enclave."""
    for file in ("cert.pem", "key.pem"):
        shutil.copy(keystore / "enclaves/listener" / file, keystore / "enclaves/talker")
    found = zenoh(keystore, "/talker", "publish", "/chatter")
    assert found["outcome"] == "refused"
    assert "by the common name '/listener' of cert.pem" in found["text"]


@pytest.mark.parametrize("mode", MODES)
def test_the_routers_key_may_do_what_passes_through_it(made: Path, mode: str) -> None:
    keystore = made / mode
    found = zenoh(keystore, "/router", "publish", "/chatter")
    assert (found["outcome"], found["change"]) == ("allowed", None)
    assert [each["enclave"] for each in found["reached"]] == ["/listener", "/recorder"]
    assert zenoh(keystore, "/router", "call", "/nope")["outcome"] == "dropped"
    shown = explain(keystore, "/router", "publish", "/chatter", "--vendor", "zenoh").ok()
    assert "put 0/chatter/any::type/hash: entering /listener by rule " in shown.out
    assert "note [explain.zenoh-router]" in shown.err
    assert "zenoh-differs" not in shown.err
    who = explain(keystore, "publish", "/chatter", "--who", "--vendor", "zenoh").ok()
    assert who.out == "/router\n/talker\n2 of 7 enclaves may publish topic /chatter\n"
    assert "note [explain.zenoh-router]" in who.err
    reach = json.loads(
        explain("--reach", "/router", keystore, "--vendor", "zenoh", "--json").ok().out
    )
    assert "/listener" in [each["enclave"] for each in reach["influences"]]
    assert "/talker" in [each["enclave"] for each in reach["learns_from"]]


def test_a_keystore_without_these_files(tmp_path: Path) -> None:
    sros("create_keystore", tmp_path / "ks").ok()
    sros("create_enclave", tmp_path / "ks", "/a").ok()
    asked = (tmp_path / "ks", "/a", "publish", "/x")
    shown = explain(*asked, "--vendor", "zenoh")
    assert shown.status == 2
    assert "has no Zenoh configurations" in shown.err
    assert "zenoh" not in explain(*asked).out
    assert "zenoh" not in json.loads(explain(*asked, "--json").out)


# ── next to DDS ────────────────────────────────────────────────────────────────────────────


def test_the_answer_for_dds_has_that_of_zenoh_next_to_it(made: Path) -> None:
    shown = explain(made / "client", "/talker", "publish", "/chatter").ok()
    assert "\n  zenoh     yes: put 0/chatter/any::type/hash from /talker: rule " in shown.out
    denied = explain(made / "client", "/talker", "publish", "/nope")
    assert "\n  zenoh     no, dropped: " in denied.out
    compared = explain(made / "client", "/talker", "publish", "/chatter", "--all-vendors").ok()
    assert "\n  zenoh     yes: " in compared.out


def test_zenoh_is_asked_where_ros_uses_it(made: Path) -> None:
    asked = (made / "client", "/talker", "publish", "/chatter")
    shown = explain(*asked, env={"RMW_IMPLEMENTATION": "rmw_zenoh_cpp"}).ok()
    assert "on Zenoh in client mode (RMW_IMPLEMENTATION is rmw_zenoh_cpp)" in shown.out
    dds = explain(*asked, "--vendor", "fastdds", env={"RMW_IMPLEMENTATION": "rmw_zenoh_cpp"}).ok()
    assert "on Fast DDS 2.14 (as asked)" in dds.out


# ── random policies ────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("seed", range(12 if LONG else 1))
def test_random_policies_are_answered_as_their_permissions_say(
    tmp_path: Path, mode: str, seed: int
) -> None:
    draw = random.Random(f"{mode} {seed}")
    policy = tmp_path / "policy.xml"
    policy.write_text(drawn_policy(draw))
    root = tmp_path / "ks"
    sros("create_keystore", root, "--template", "production").ok()
    sros("generate_artifacts", "-k", root, "-p", policy).ok()
    sros("zenoh", root, "--mode", mode).ok()
    rules = Rules(split_actions(policy_rights(read_policy(policy))))
    evaluator = ZenohEvaluator(OpenedKeystore(root), moment=now(), domain=0)
    enclaves = [each for each in evaluator.names if each != "/router"]
    allowed = denied = 0
    for enclave, (right, other), name in product(enclaves, OTHER_END.items(), NAMES):
        answer = evaluator.answer(enclave, ask(WORD[right], name))
        assert answer.outcome.ok is rules.allow(enclave, right, name), (enclave, right, name)
        able = [each for each in enclaves if each != enclave and rules.allow(each, other, name)]
        expected = able if answer.outcome.ok else []
        assert [each.enclave for each in answer.reached] == expected, (enclave, right, name)
        allowed, denied = allowed + answer.outcome.ok, denied + (not answer.outcome.ok)
    assert min(allowed, denied) > 5


# ── files of earlier permissions ───────────────────────────────────────────────────────────


def asked_in(root: Path) -> dict[tuple[str, str, str], tuple[tuple[Any, ...], Any]]:
    """Return the answer to each question in a keystore, and the files that are out of date."""
    evaluator = ZenohEvaluator(OpenedKeystore(root), moment=now(), domain=0)
    found = {}
    for enclave, right, name in product(evaluator.names, OTHER_END, NAMES[: None if LONG else 2]):
        answer = evaluator.answer(enclave, ask(WORD[right], name))
        reached = tuple(each.enclave for each in answer.reached)
        wide = tuple((each.expression, each.reaches) for each in answer.wildcards)
        told = (answer.outcome, reached, wide)
        found[enclave, right, name] = told, evaluator.outdated_files(answer)
    return found


@pytest.mark.parametrize("mode", some(MODES, 1))
@pytest.mark.parametrize("seed", range(12 if LONG else 1))
def test_files_of_other_rights_are_out_of_date_or_answer_the_same(
    tmp_path: Path, mode: str, seed: int
) -> None:
    """With files of an earlier policy, each answer is that of the current files, or it says so."""
    draw = random.Random(f"earlier {mode} {seed}")
    policy, current = tmp_path / "policy.xml", tmp_path / "ks"
    policy.write_text(drawn_policy(draw))
    sros("create_keystore", current, "--template", "production").ok()
    sros("generate_artifacts", "-k", current, "-p", policy).ok()
    sros("zenoh", current, "--mode", mode).ok()
    earlier = {path: path.read_bytes() for path in current.rglob("*.json5")}
    earlier |= {path.with_suffix(".p7s"): path.with_suffix(".p7s").read_bytes() for path in earlier}
    # Other rights of one enclave, to names without wildcards.
    rights = publish(*draw.sample(NAMES, 2)) + publish(*draw.sample(NAMES, 2)).replace(
        "publish", "subscribe"
    )
    policy.write_text(policy_text({"/e0": rights}))
    sros("generate_artifacts", "-k", current, "-p", policy).ok()
    fresh = asked_in(current)
    assert all(out_of_date == () for _, out_of_date in fresh.values())
    for path, data in earlier.items():
        path.unlink()
        path.write_bytes(data)
    noticed = unnoticed = 0
    for question, (answer, out_of_date) in asked_in(current).items():
        if answer != fresh[question][0]:
            assert out_of_date, question
            noticed += 1
        unnoticed += not out_of_date
    assert min(noticed, unnoticed) > 5


@pytest.mark.parametrize("mode", MODES)
def test_rules_of_others_that_do_not_concern_the_question_are_not_compared(
    made: Path, tmp_path: Path, mode: str
) -> None:
    changed = copy_of(made / mode, tmp_path / "ks")
    router = changed / "enclaves/router/router.json5"
    signed = router.with_suffix(".p7s")
    earlier = [(file, file.read_bytes()) for file in (router, signed)]
    policy = tmp_path / "policy.xml"
    policy.write_text(POLICY.replace("/go<", "/come<"))
    sros("generate_artifacts", "-k", changed, "-p", policy).ok()
    for file, data in earlier:
        file.unlink()
        file.write_bytes(data)
    assert zenoh(changed, "/talker", "publish", "/chatter")["out_of_date"] == []
    for name in ("/go", "/come"):
        assert zenoh(changed, "/client", "call", name)["out_of_date"] == [
            "enclaves/router/router.json5"
        ]


def test_a_rule_for_an_unknown_enclave_is_out_of_date(keystore: Path) -> None:
    router = keystore / "enclaves/router/router.json5"
    router.write_text(router.read_text().replace("/recorder", "/unknown"))
    found = zenoh(keystore, "/client", "call", "/go")
    assert found["out_of_date"] == ["enclaves/router/router.json5"]
