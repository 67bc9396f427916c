"""What arrives on real Zenoh is what sros says: for random rules and links, and random policies."""

from __future__ import annotations

import random
import socket
from pathlib import Path

import pytest

from sros_tool.cli.common import now
from sros_tool.explain.answer import ask
from sros_tool.explain.zenoh import ZenohEvaluator
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.zenoh.configuration import Mode
from tests.explain.zenoh_policies import NAMES, OTHER_END, WORD, drawn_policy
from tests.support.children import LONG
from tests.support.harness import policy_text, publish, sros
from tests.support.long_form import some

pytest.importorskip("zenoh", reason="the wheel eclipse-zenoh is missing")

pytestmark = pytest.mark.zenoh
POLICY = policy_text({"/talker": publish("/chatter"), "/listener": publish("/chatter")})


def make_keystore(folder: Path, policy: str, mode: str) -> Path:
    """Make a keystore with Zenoh files for a policy, and for a port of its own."""
    (folder / "policy.xml").write_text(policy)
    sros("create_keystore", folder / "ks", "--template", "production").ok()
    sros("generate_artifacts", "-k", folder / "ks", "-p", folder / "policy.xml").ok()
    with socket.socket() as free:  # where no network of its own is allowed
        free.bind(("127.0.0.1", 0))
        endpoint = f"localhost:{free.getsockname()[1]}"
    sros("zenoh", folder / "ks", "--mode", mode, "--endpoint", endpoint).ok()
    return folder / "ks"


@pytest.fixture(scope="module")
def keystore(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A keystore with Zenoh files, whose access control the worlds replace."""
    return make_keystore(tmp_path_factory.mktemp("zenoh"), POLICY, "peer")


MIXED = [("client", "peer"), ("peer", "client")] if LONG else []


@pytest.mark.parametrize(
    ("talker", "listener"), [*some([("client", "client"), ("peer", "peer")], 1), *MIXED]
)
@pytest.mark.parametrize("seed", range(1, 6) if LONG else [1])
def test_what_arrives_is_what_the_engine_says(
    keystore: Path, talker: str, listener: str, seed: int
) -> None:
    from tests.integration import zenoh_deliveries as live
    from tests.integration.zenoh_world import observed_apart

    modes = {
        live.ROUTER: Mode.ROUTER,
        live.TALKER: Mode(talker),
        live.LISTENER: Mode(listener),
    }
    count = 250 if LONG else 80
    observed = observed_apart(lambda: live.compared(keystore, modes, seed, count))
    assert not any(observed["different"].values()), observed["different"]
    # Both sides were up, and each kind of delivery was both allowed and dropped.
    assert min(observed["arrived"].values()) >= 5, observed["arrived"]
    assert min(observed["dropped"].values()) >= 5, observed["dropped"]


@pytest.mark.parametrize("mode", ["client", "peer"])
@pytest.mark.parametrize("seed", range(8 if LONG else 1))
def test_what_explain_answers_is_what_happens(tmp_path: Path, mode: str, seed: int) -> None:
    """Each enclave of a random policy tries every name in every direction, also with no rules."""
    policy = drawn_policy(random.Random(f"live {seed}"))
    keystore = make_keystore(tmp_path, policy, mode)
    evaluator = ZenohEvaluator(OpenedKeystore(keystore), moment=now(), domain=0)
    answers = {
        enclave: {
            right: [
                name
                for name in NAMES
                if evaluator.answer(enclave, ask(WORD[right], name), reach=False).outcome.ok
            ]
            for right in OTHER_END
        }
        for enclave in evaluator.names
        if enclave != "/router"
    }
    from tests.integration import zenoh_matrix as live
    from tests.integration.zenoh_world import observed_apart

    matrix = live.read_matrix({"topics": NAMES, "services": NAMES, "rights": answers})
    observed = observed_apart(lambda: live.observed(keystore, matrix, enforced=True))
    assert observed["up"]
    assert observed["different"] == {}
    assert observed["allowed"]["heard"] > 0
