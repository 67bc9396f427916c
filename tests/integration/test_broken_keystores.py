"""Every broken keystore: vendors show it late or not at all, `sros check` says it beforehand."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from zoneinfo import ZoneInfo

import pytest

from sros_tool.dds.decision.vendors import CYCLONE_DDS, FAST_DDS, Vendor
from sros_tool.explain.answer import Evaluator
from sros_tool.explain.answer import ask as question
from sros_tool.keystore.participant import JoinContext, load_enclave
from tests.checks.bench import SECRET, Bench
from tests.integration.broken_keystores import HARMLESS, MATCHED, MORE, ROWS, Breakage
from tests.integration.fastdds import fastdds_vendor
from tests.integration.vendor_oracle import (
    Pair,
    Reply,
    ask_cyclone_folders,
    ask_fastdds_folders,
    cyclone_vendor,
    with_patience,
)
from tests.support.harness import copy_of, policy_text, publish, sros
from tests.support.long_form import some

pytestmark = pytest.mark.dds

CONTROL = Breakage("nothing", lambda bench: None, MATCHED, MATCHED, "")
ALL = (CONTROL, *HARMLESS, *ROWS, *MORE)
TOPIC = "rt/chatter"
HEARS = '<topics subscribe="ALLOW"><topic>/chatter</topic></topics>'
BASICS = publish("/rosout", "/parameter_events")


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A keystore in which nothing is to be found, beside its policy."""
    folder = tmp_path_factory.mktemp("sound")
    policy = {"/base": BASICS + publish("/chatter"), "/arm": BASICS + HEARS}
    (folder / "policy.xml").write_text(policy_text(policy))
    root, env = folder / "ks", {"SROS_CA_PASSPHRASE": SECRET}
    words = ("--template", "production", "--encrypt-ca-keys")
    sros("create_keystore", root, *words, env=env).ok()
    sros("generate_artifacts", "-k", root, "-p", folder / "policy.xml", env=env).ok()
    return root


@pytest.fixture(scope="module")
def broken(sound: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Bench]:
    """A keystore for each way to break it."""
    made = {}
    for each in ALL:
        folder = tmp_path_factory.mktemp("broken")
        copy_of(sound, folder / "ks")
        shutil.copy(sound.with_name("policy.xml"), folder)
        made[each.name] = Bench(folder / "ks", datetime.now(UTC).replace(microsecond=0))
        each.work(made[each.name])
    return made


def pairs(sound: Path, broken: dict[str, Bench]) -> list[Pair]:
    """The broken enclave and the one that listens, which is sound unless both are concerned."""
    return [
        (
            broken[each.name].path("enclaves/base"),
            (broken[each.name].root if each.shared else sound) / "enclaves/arm",
            each.zone,
        )
        for each in ALL
    ]


def test_what_cyclone_does(sound: Path, broken: dict[str, Bench]) -> None:
    def ask(some: Sequence[Pair], seconds: float) -> list[Reply]:
        return ask_cyclone_folders(some, TOPIC, sound / "enclaves/arm", seconds=seconds)

    does = [each.on_cyclone(cyclone_vendor()) for each in ALL]
    expected = [({answer}, alternatives(says)) for answer, says in does]
    compare(ask, pairs(sound, broken), expected)


def test_what_fast_dds_does(
    sound: Path, broken: dict[str, Bench], tmp_path_factory: pytest.TempPathFactory
) -> None:
    program_folder = tmp_path_factory.mktemp("oracle")

    def ask(some: Sequence[Pair], seconds: float) -> list[Reply]:
        return ask_fastdds_folders(some, TOPIC, program_folder, seconds=seconds)

    expected = []
    for each in ALL:
        answer, says = each.on_fast(fastdds_vendor())
        race = each.race if answer != MATCHED else ""
        expected.append(({answer, race or answer}, (says,)))
    compare(ask, pairs(sound, broken), expected)


def alternatives(says: str | tuple[str, ...]) -> tuple[str, ...]:
    return (says,) if isinstance(says, str) else says


def compare(
    ask: Callable[[Sequence[Pair], float], list[Reply]],
    asked: list[Pair],
    expected: Sequence[tuple[set[str], tuple[str, ...]]],
) -> None:
    def wrong(place: int, reply: Reply) -> bool:
        answers, says = expected[place]
        observed = reply.answers[0] if reply.end == "joined" else reply.end
        return observed not in answers or not any(text in reply.log for text in says)

    replies = with_patience(ask, asked, wrong)
    contradictions = [
        f"{ALL[place].name}: {reply}, and not {expected[place]}"
        for place, reply in enumerate(replies)
        if wrong(place, reply)
    ]
    assert not contradictions, "\n".join(contradictions)
    assert ALL[0] is CONTROL
    assert expected[0][0] == {MATCHED}


def findings(bench: Bench, zone: str) -> set[str]:
    """What `sros check` finds, on a host in that time zone, and the exit status that it gives."""
    policy = bench.root.with_name("policy.xml")
    options = ("--domain", "0", "--policy", policy, "--exclude", "policy.*", "--json")
    words = ("check", "keystore", bench.root, *options)  # its nodes are no ROS 2 nodes
    before = os.environ.get("TZ")
    try:
        os.environ["TZ"] = zone
        time.tzset()
        ended = sros(*words)
    finally:
        os.environ.pop("TZ") if before is None else os.environ.update(TZ=before)
        time.tzset()
    found = {each["id"] for each in json.loads(ended.out)["findings"]}
    assert ended.status == (1 if found else 0), ended
    return found


@pytest.mark.parametrize("each", some([*ROWS, *MORE], 20), ids=lambda each: each.name)
def test_check_names_the_cause(each: Breakage, broken: dict[str, Bench]) -> None:
    assert each.finding in findings(broken[each.name], each.zone)


AT_PEERS = {"peers of different CAs", "revoked at its peers"}
"""What lies with others, and cannot be seen in the enclave itself."""
AT_PEERS_OF_ONE = {
    Vendor.CYCLONE_11: {"permissions CA expired", "permissions CA below a root"},
}
"""The same, on a vendor that does not verify the permissions CA of its own enclave."""


@pytest.mark.parametrize("each", ALL, ids=lambda each: each.name)
def test_explain_says_what_each_vendor_does(each: Breakage, broken: dict[str, Bench]) -> None:
    bench = broken[each.name]
    material = load_enclave("/base", bench.path("enclaves/base"), moment=bench.now)
    setting = JoinContext(0, bench.now, ZoneInfo(each.zone))
    does = {
        **{vendor: each.on_fast(vendor)[0] for vendor in FAST_DDS},
        **{vendor: each.on_cyclone(vendor)[0] for vendor in CYCLONE_DDS},
    }
    for vendor, word in does.items():
        said = Evaluator(vendor, material, setting).answer(question("publish", "/chatter"))
        at_peers = each.name in AT_PEERS | AT_PEERS_OF_ONE.get(vendor, set())
        assert said.allowed == (word == MATCHED or at_peers), (vendor, said)


@pytest.mark.parametrize("each", [CONTROL, *HARMLESS], ids=lambda each: each.name)
def test_check_finds_nothing_in_what_works(each: Breakage, broken: dict[str, Bench]) -> None:
    # What the keystore did not sign itself is remarked on, whatever it says.
    assert findings(broken[each.name], each.zone) <= {"keystore.not-in-ledger"}
