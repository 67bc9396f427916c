"""A table of all verbs, made from the program: none lacks what the others have.

Each verb has help with an example, ``--json``, ``--dry-run`` where it writes, completion of its
arguments, progress where its work grows with the keystore, and the exit status 0 for yes or done,
1 for no, 2 for what could not be asked or done.
"""

from __future__ import annotations

import inspect
import json
import shutil
from importlib import import_module
from pathlib import Path

import click
import pytest

from tests.conftest import POLICY
from tests.keystore.test_confirmation import DDS
from tests.support.harness import copy_of, policy_text, publish, sros
from tests.support.long_form import some
from tests.support.tables import for_every
from tests.support.verbs import COMMANDS, module_of

# What a verb does not have, and why.
NO_JSON = {
    "run": "its output is that of the command",
    "completion": "its output is a script",
    "fleet report": "its output is the JSON of a confirmation",
    "fleet inventory": "its output is an Ansible inventory",
}
READS = {
    "list_enclaves", "inspect", "verify", "diff_policy", "explain", "check", "doctor", "env",
    "completion", "fleet report", "fleet inventory", "review", "agent status",
}  # fmt: skip
RUNS = {"run", "demo", "agent run"}
GROWS = {
    "create_enclave", "generate_artifacts", "update_keystore", "renew", "revoke", "rotate_ca",
    "distribute_key", "verify", "diff_policy", "explain", "view", "check", "metrics", "units",
    "review", "zenoh", "fleet report", "fleet status",
}  # fmt: skip


def options(verb: str) -> set[str]:
    command = COMMANDS[verb]
    return {word for parameter in command.params for word in parameter.opts}


@for_every(COMMANDS)
def test_every_verb_has_an_example_with_its_name(verb: str) -> None:
    command = COMMANDS[verb]
    assert command.epilog
    assert "Example" in command.epilog
    assert f"sros {verb}" in command.epilog


@for_every(COMMANDS)
def test_every_verb_has_json(verb: str) -> None:
    assert ("--json" in options(verb)) != (verb in NO_JSON)


@for_every(COMMANDS)
def test_every_verb_that_writes_has_a_dry_run(verb: str) -> None:
    assert ("--dry-run" in options(verb)) != (verb in READS | RUNS)


@for_every(COMMANDS)
def test_every_argument_completes(verb: str) -> None:
    command = COMMANDS[verb]
    for parameter in command.params:
        if not isinstance(parameter, click.Argument):
            continue
        found = parameter.shell_complete(click.Context(command), "")
        assert found, f"{verb} {parameter.name}"


@pytest.mark.parametrize("verb", sorted(GROWS))
def test_work_that_grows_with_the_keystore_shows_progress(verb: str) -> None:
    module = import_module(module_of(verb))
    assert "with progress(" in inspect.getsource(module)


# ── exit status ────────────────────────────────────────────────────────────────────────────


@pytest.fixture(scope="module")
def made(made_keystore: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with all that the lines below name; only to be copied."""
    folder = tmp_path_factory.mktemp("table")
    copy_of(made_keystore, folder / "ks")
    (folder / "p.xml").write_text(POLICY)
    (folder / "wide.xml").write_text(policy_text({"/a": publish("*")}))
    (folder / "q.xml").write_text(policy_text({"/a": publish("new")}))
    (folder / "crew.xml").write_text(policy_text({"/{robot}": publish("/x")}))
    (folder / "crew.toml").write_text("[robots.a]\n[robots.b]\n")
    (folder / "empty").mkdir()
    (folder / "hostile/a/confirmation.p7s").mkdir(parents=True)
    (folder / "broken.xml").write_text("<policy")
    (folder / "log").write_text("[rcl]: couldn't find all security files!\n")
    for line in (
        "create_keystore strict --template production",
        "generate_artifacts -k strict -p p.xml",
        "distribute_key strict --all robot",
        "distribute_key strict --all damaged",
        "create_request /r asking",
        "sign_request ks asking/enclaves/r/request.pem -o answer.tar.gz",
        "generate_artifacts -k late -p p.xml",
        "generate_artifacts -k zenoh -p p.xml",
        "generate_artifacts -k crew -p crew.xml --fleet crew.toml",
        "distribute_key crew /a alone",
    ):
        sros(*line.split(), cwd=folder).ok()
    (folder / "damaged/enclaves/a/cert.pem").write_text("damaged")
    copy_of(folder / "crew", folder / "fleet")
    for name in ("a", "b"):
        said = sros("fleet", "report", "alone", "--robot", name, cwd=folder).ok()
        confirmed = {**json.loads(said.out), "dds": DDS}  # not that of this machine
        (folder / f"{name}.json").write_text(json.dumps(confirmed))
    sros("fleet", "confirm", "fleet", "a.json", "--robot", "a", cwd=folder).ok()
    shutil.copy(folder / "asking/enclaves/r/request.pem", folder / "request.pem")
    return folder


NEVER = ""
SIGNED, OTHER_CA = "strict/enclaves/a/permissions.p7s", "strict/public/identity_ca.cert.pem"
STATUS: dict[str, tuple[str, str, str]] = {
    # verb: yes or done, no, could not be asked or done
    "create_keystore": ("new", NEVER, "ks"),
    "create_enclave": ("ks /new", NEVER, "nothing /new"),
    "create_permission": ("ks /a p.xml", NEVER, "ks /a broken.xml"),
    "generate_artifacts": ("-k ks -p p.xml", NEVER, "-k ks -p broken.xml"),
    "update_keystore": (
        "ks --template production",
        "ks --set protection.rtps=NONE --dry-run",
        "ks --set protection.rtps=NONE",
    ),
    "list_enclaves": ("ks", NEVER, "nothing"),
    "inspect": (SIGNED, f"{SIGNED} --ca {OTHER_CA}", "nothing"),
    "renew": ("ks /a", NEVER, "ks /nobody"),
    "revoke": ("ks /a", NEVER, "ks /nobody"),
    "rotate_ca": ("ks --next", NEVER, "nothing --next"),
    "crl": ("ks", NEVER, "nothing"),
    "zenoh": ("zenoh", "zenoh --check", "nothing"),
    "distribute_key": ("ks /a out", NEVER, "ks /nobody out"),
    "verify": ("robot", "damaged", "nothing"),
    "create_request": ("/new out", NEVER, "/r asking"),
    "sign_request": ("strict request.pem -o new.tar.gz", NEVER, "ks p.xml"),
    "import": ("answer.tar.gz asking", NEVER, "p.xml asking"),
    "merge_policy": ("p.xml q.xml -o new.xml", NEVER, "p.xml broken.xml"),
    "diff_policy": ("p.xml p.xml", "p.xml q.xml", "p.xml nothing"),
    "explain": ("strict /a publish /old_a", "strict /a publish /no", "strict /nobody join"),
    "view": ("p.xml -o new.svg", NEVER, "nothing"),
    "policies": ("", NEVER, "--copy ks"),
    "check": (
        "keystore strict --exclude enclave.node-cannot-start --severity error",
        "damaged",
        "nothing",
    ),
    "metrics": ("damaged -o new.prom", NEVER, "nothing -o new.prom"),
    "units": ("ks /a new --dry-run", NEVER, "nothing /a new"),
    "env": ("ks /a", NEVER, "nothing /a"),
    "fleet inventory": ("fleet", NEVER, "ks"),
    "fleet report": ("robot --robot a", NEVER, "nothing --robot a"),
    "fleet confirm": ("fleet b.json --robot b", NEVER, "fleet b.json --robot a"),
    "fleet collect": ("crew empty", "crew hostile", "ks empty"),
    "fleet status": ("fleet --robot a", "fleet", "ks"),
    "completion": ("bash", NEVER, "powershell"),
}
ELSEWHERE = {
    "agent init": "tests/agent/test_agent_verbs.py",
    "agent run": "tests/agent/test_agent_verbs.py",
    "agent status": "tests/agent/test_agent_verbs.py",
    "generate_policy": "tests/graph", "minimize_policy": "tests/policy",
    "audit": "tests/cli/test_audit.py", "close": "tests/cli/test_close.py",
    "doctor": "tests/checks", "run": "tests/runtime",
    "demo": "tests/demo", "fleet publish": "tests/agent", "review": "tests/test_pull_requests.py",
}  # fmt: skip
"""Verbs that need a robot, a repository or another program, and where their status is tested."""


def test_the_status_of_every_verb_is_tested() -> None:
    assert STATUS.keys() | ELSEWHERE.keys() == COMMANDS.keys()
    assert not STATUS.keys() & ELSEWHERE.keys()
    assert all(Path(__file__).parents[2].joinpath(path).exists() for path in ELSEWHERE.values())


@pytest.mark.parametrize("verb", some([*STATUS], 12))
def test_status(verb: str, made: Path, tmp_path: Path) -> None:
    folder = copy_of(made, tmp_path / "w")
    for wanted in (2, 1, 0):  # what is done last may change the folder
        words = STATUS[verb][wanted]
        if words == NEVER and wanted == 1:
            continue
        ended = sros(*verb.split(), *words.split(), cwd=folder)
        assert ended.status == wanted, ended
        assert not (wanted == 2 and ended.out and verb != "env"), ended
        usage = sros(*verb.split(), "--no-such-option", cwd=folder)
        assert usage.status == 2 and f"sros {verb}" in usage.err
