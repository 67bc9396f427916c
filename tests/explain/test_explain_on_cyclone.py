"""What `sros explain` says of Cyclone DDS is what Cyclone DDS does, for a sample of the policies.

One process for each enclave asks for topics that the policy allows, and for such that it denies.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from sros_tool.cli.common import now
from sros_tool.dds.decision.vendors import Vendor
from sros_tool.explain.answer import Evaluator, Part, Question, ask
from sros_tool.files import policies_dir
from sros_tool.keystore.lifecycle.create import create_keystore, generate_artifacts
from sros_tool.keystore.participant import JoinContext, load_enclave
from sros_tool.keystore.template import load_template
from sros_tool.policy.document import read_policy
from tests.integration.cyclone_rights import refusals
from tests.support.harness import sros
from tests.support.long_form import some

pytestmark = pytest.mark.dds

QUESTIONS = {
    "talker_listener": {
        "/talker_listener/talker": [("publish", "/chatter"), ("subscribe", "/chatter")],
        "/talker_listener/listener": [("subscribe", "/chatter"), ("publish", "/chatter")],
    },
    "add_two_ints": {
        "/add_two_ints/server": [("serve", "/add_two_ints"), ("call", "/add_two_ints")],
        "/add_two_ints/client": [("call", "/add_two_ints"), ("serve", "/add_two_ints")],
    },
    "fibonacci": {
        "/fibonacci/server": [("execute", "/fibonacci"), ("call", "/fibonacci")],
        "/fibonacci/client": [("call", "/fibonacci"), ("execute", "/fibonacci")],
    },
    "mobile_robot": {
        "/mobile_robot/recorder": [
            ("subscribe", "/scan"),
            ("subscribe", "/front_camera/image_raw"),
            ("publish", "/scan"),
        ],
        "/mobile_robot/velocity_mux": [("publish", "/cmd_vel"), ("publish", "/cmd_vel_nav")],
    },
}


@pytest.mark.parametrize("policy", some([*QUESTIONS], 2))
def test_cyclone_does_as_told(policy: str, tmp_path: Path) -> None:
    keystore = tmp_path / "ks"
    file = policies_dir() / f"{policy}.xml"
    create_keystore(keystore, template=load_template("production"), now=now())
    generate_artifacts(keystore, policies=[read_policy(file)], now=now())
    seen = set()
    for enclave, asked in QUESTIONS[policy].items():
        folder = keystore / "enclaves" / enclave[1:]
        questions = [_question(policy, *words) for words in asked]
        parts = [part for each in questions for part in each.parts]
        refused = refusals(folder, 0, map(_key, parts))
        allowed = {_key(part): _key(part) not in refused for part in parts}
        for question, words in zip(questions, asked, strict=True):
            expected = all(allowed[_key(part)] for part in question.parts)
            kind = ("--type", question.type)
            found = sros("explain", keystore, enclave, *words, *kind, "--vendor", "cyclonedds")
            assert found.status == (0 if expected else 1), (found, allowed)
            seen.add(expected)
        context = JoinContext(0, now())
        evaluator = Evaluator(Vendor.CYCLONE, load_enclave(enclave, folder, moment=now()), context)
        for question in questions:
            for part, decision in evaluator.answer(question).parts:
                assert decision.outcome.ok == allowed[_key(part)], part
    assert seen == {True, False}


def _question(policy: str, word: str, name: str) -> Question:
    return ask(word, name, "action" if policy == "fibonacci" else None)


def _key(part: Part) -> tuple[str, str]:
    return part.verb.value, part.topic
