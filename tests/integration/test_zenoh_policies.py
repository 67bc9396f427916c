"""The shipped policies on real Zenoh: each allowed pair of enclaves communicates, and no other one.

Each pair of (enclave, name, direction) of a policy is tried between all of its enclaves, and with
an enclave that may do everything, in client and in peer mode, and after `sros distribute_key`.
Besides the names of a policy, its wildcards stand for some names that they match, or nearly match.
"""

from __future__ import annotations

import socket
from itertools import product
from pathlib import Path
from typing import Any

import pytest

from sros_tool.files import policies_dir
from sros_tool.names import is_expression
from sros_tool.policy.document import read_policy
from sros_tool.policy.model import RIGHTS
from sros_tool.policy.rights import KIND_OF, Rules, policy_rights, split_actions
from tests.support.children import LONG
from tests.support.harness import policy_text, publish, sros
from tests.support.long_form import some

pytest.importorskip("zenoh", reason="the wheel eclipse-zenoh is missing")

pytestmark = pytest.mark.zenoh
KINDS = ("topics", "services")
ROBOT = "mobile_robot.xml"
SHIPPED = sorted(each.name for each in policies_dir().glob("*.xml"))
WITNESS = policy_text(
    {
        "/witness": publish("/*")
        + publish("/*").replace("publish", "subscribe")
        + '<services request="ALLOW" reply="ALLOW"><service>/*</service></services>'
    }
)


def matrix_of(policies: list[Path]) -> dict[str, Any]:
    """Return the names of policies, and the rights of their enclaves to each of them."""
    rights = split_actions(right for each in policies for right in policy_rights(read_policy(each)))
    names: dict[str, set[str]] = {kind: {"/elsewhere", "/else/where"} for kind in KINDS}
    for each in rights:
        names[KIND_OF[each.right]].update(examples(each.name))
    rules = Rules(rights)
    if not LONG:
        names["services"] = set(sorted(names["services"])[::6])
    return {
        **{kind: sorted(names[kind]) for kind in KINDS},
        "rights": {
            enclave: {
                right: [name for name in sorted(names[kind]) if rules.allow(enclave, right, name)]
                for kind in KINDS
                for right in RIGHTS[kind]
            }
            for enclave in sorted({each.enclave for each in rights})
        },
    }


def examples(name: str) -> list[str]:
    """Return names that an expression matches, or nearly matches; or the name itself."""
    if not is_expression(name):
        return [name]
    filled = {name.replace("*", each) for each in ("x", "a/b", "_9")}
    return sorted(each.replace("//", "/") for each in filled | {name.split("*")[0].rstrip("/")}
                  if each)  # fmt: skip


def keystore_of(folder: Path, policies: list[Path], *, mode: str) -> Path:
    """Make a keystore with Zenoh files for policies, and a port of its own."""
    with socket.socket() as free:  # where no network of its own is allowed
        free.bind(("127.0.0.1", 0))
        endpoint = f"localhost:{free.getsockname()[1]}"
    root = folder / "ks"
    sros("create_keystore", root, "--template", "production").ok()
    options = [word for each in policies for word in ("-p", each)]
    sros("generate_artifacts", "-k", root, *options).ok()
    sros("zenoh", root, "--mode", mode, "--endpoint", endpoint).ok()
    return root


def tried(keystore: Path, policies: list[Path], *, enforced: bool = True) -> Any:
    """Return what was observed on sessions with the files of a keystore."""
    from tests.integration import zenoh_matrix as live
    from tests.integration.zenoh_world import observed_apart

    matrix = live.read_matrix(matrix_of(policies))
    return observed_apart(lambda: live.observed(keystore, matrix, enforced=enforced))


SMALL = "talker_listener.xml"
CASES = [
    *some([(ROBOT, "client", False), (SMALL, "client", True)], 1),
    (SMALL, "peer", False),
]
if LONG:
    CASES = [*product(SHIPPED, ("client", "peer"), (False, True))]


@pytest.mark.parametrize(("file", "mode", "exported"), CASES)
def test_every_allowed_pair_communicates_and_no_other_one(
    file: str, mode: str, exported: bool, tmp_path: Path
) -> None:
    (tmp_path / "witness.xml").write_text(WITNESS)
    policies = [policies_dir() / file, tmp_path / "witness.xml"]
    keystore = keystore_of(tmp_path, policies, mode=mode)
    if exported:
        sros("distribute_key", keystore, "--all", tmp_path / "elsewhere").ok()
        keystore.rename(tmp_path / "gone")
        keystore = tmp_path / "elsewhere"
    observed = tried(keystore, policies)
    print(file, mode, "exported" if exported else "", observed["allowed"], "of", observed["tried"])
    assert observed["up"]
    assert observed["different"] == {}
    assert min(observed["allowed"].values()) > 0


def test_without_rules_others_communicate_too(tmp_path: Path) -> None:
    (tmp_path / "witness.xml").write_text(WITNESS)
    policies = [policies_dir() / "talker_listener.xml", tmp_path / "witness.xml"]
    observed = tried(keystore_of(tmp_path, policies, mode="client"), policies, enforced=False)
    assert all(observed["different"][what]["too much"] for what in ("heard", "executed", "replied"))
