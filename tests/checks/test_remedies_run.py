"""The commands that a finding names are done, not refused, where the finding was made."""

from __future__ import annotations

import importlib
import os
import pkgutil
import re
import shlex
import shutil
import sys
from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import pytest

from sros_tool import cli
from sros_tool.checks.keystores.keystore import keystore_findings
from sros_tool.checks.keystores.opened import Circumstances
from sros_tool.checks.kind import Finding, all_kinds
from sros_tool.checks.policies.policy import policy_file_findings
from sros_tool.checks.runtime import RuntimeState, runtime_findings
from sros_tool.keystore.reader import OpenedKeystore
from tests.checks import policy_cases, runtime_cases
from tests.checks.bench import DAY, SECRET, Bench
from tests.checks.keystore_cases import CASES
from tests.checks.sound_keystore import NOW
from tests.checks.test_policy_findings import enclave
from tests.checks.test_policy_findings import policy as policy_of
from tests.support.harness import Ended, copy_of, forked, sros
from tests.support.long_form import some

pytest_plugins = ["tests.checks.sound_keystore"]

ENVIRONMENT = {"SROS_CA_PASSPHRASE": SECRET}
_EDITED = "the case signs a governance that no settings state, which has to be settled first"
_UNKNOWN = "the case signs permissions that no ledger has, which `sros renew` never signs again"
ELSEWHERE = {
    "keystore.home-or-robot": "its command is for the keystore from which the export came",
    "keystore.older-than-robots": "the keystore of the case has no fleet, as one with robots has",
    "keystore.weak-cryptography": "the case puts in the certificate of a CA without its key",
    "enclave.certificate-not-yet-valid": "the clock is wrong, and so the CA is not valid either",
    "enclave.crl-left-out": "the folder has to be moved away first, as the remedy says",
    "enclave.permissions-not-yet-valid": _UNKNOWN,
    "enclave.subject-not-unique": _UNKNOWN,
    "governance.unauthenticated": _EDITED,
    "governance.unauthenticated-kept-out": _EDITED,
    "governance.no-join-control": _EDITED,
    "governance.no-access-control": _EDITED,
    "governance.no-encryption": _EDITED,
    "governance.no-authenticity": _EDITED,
    "governance.discovery-open": _EDITED,
    "governance.liveliness-open": _EDITED,
    "governance.xml-differs": "the case writes a governance that cannot be carried out",
}
"""Why the commands for a finding cannot be run where a case makes it, by its id."""


def commands(finding: Finding, policy: Path, target: Path, **others: object) -> list[list[str]]:
    """The commands of a remedy with arguments, with the names that a person fills in."""
    name = finding.subject.split(",")[0] if finding.subject.startswith("/") else "/base"
    words: dict[str, object] = {
        "POLICY_FILE": policy,
        "POLICY": policy,
        "OBSERVED": policy,
        "FLEET_FILE": target.with_name("fleet.toml"),
        "TARGET": target,
        "ENCLAVE": name,
        "ENCLAVE...": name,
        "distributions=NAME,...": "distributions=kilted",
        "IDS": 0,
        "ID": 0,
        **others,
    }
    found = re.findall(r"`(?:eval \"\$\()?(sros [^`]+?)(?:\)\")?`", finding.remedy)
    split = (shlex.split(part)[1:] for each in found for part in each.split(" && "))
    whole = (each for each in split if any(not word.startswith("-") for word in each[1:]))
    return [[str(words.get(word, word)) for word in each] for each in whole]


def edit_settings(root: Path) -> None:
    """Edit the settings of a keystore as remedies with --take-edits ask for."""
    path = root / "sros.toml"
    text = path.read_text()
    path.write_text(re.sub(r'(\[permissions\][^[]*?validity = )"\w+"', r'\1"400d"', text))
    assert path.read_text() != text


def at(moment: datetime, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have the program take a moment for the current one."""
    for each in pkgutil.iter_modules(cli.__path__, "sros_tool.cli."):
        importlib.import_module(each.name)  # one that is imported later would keep the moment
    for name, module in list(sys.modules.items()):
        if name.startswith("sros_tool.cli.") and hasattr(module, "now"):
            monkeypatch.setattr(module, "now", lambda: moment)


NAMED = [each for each in CASES if "`sros " in all_kinds()[each].remedy and each not in ELSEWHERE]


@pytest.mark.parametrize("kind", some(NAMED, 8))
def test_no_remedy_names_a_command_that_refuses(
    kind: str, bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    CASES[kind](bench)
    options = {"now": bench.now, **bench.options}
    found = [
        each
        for each in keystore_findings(OpenedKeystore(bench.checked), Circumstances(**options))
        if each.id == kind
    ]
    assert found
    at(options["now"], monkeypatch)
    policy = bench.root.with_name("policy.xml")
    root = Path(os.path.abspath(bench.root))
    copy_of(root, tmp_path / "broken")
    if (root / "fleet.toml").exists():
        shutil.copy(root / "fleet.toml", tmp_path)
    else:
        (tmp_path / "fleet.toml").write_text("[robots]\nr1 = {}\n")

    def run(words: list[str]) -> Ended:
        if "--take-edits" in words:
            edit_settings(root)
        return sros(*words, env=ENVIRONMENT, cwd=tmp_path)

    for words in commands(found[0], policy, tmp_path / "target", KEYSTORE=root):
        ended = run(words)
        if ended.status > 1:  # perhaps the other choice was carried out before
            shutil.rmtree(root)
            copy_of(tmp_path / "broken", root)
            ended = run(words)
        assert ended.status < 2, (words, ended.err)


POLICIES = [each for each in policy_cases.CASES if "`sros " in all_kinds()[each.id].remedy]
SHOWN_ONLY = {"portable.document-size"}
"""The findings whose commands show what a person may change, and write nothing."""


@pytest.mark.parametrize("case", some(POLICIES, 3), ids=lambda case: case.id)
def test_the_remedy_of_a_policy_can_be_carried_out(case: policy_cases.Case, tmp_path: Path) -> None:
    written, observed, output = (tmp_path / f"{each}.xml" for each in ("robot", "seen", "narrow"))

    def write(path: Path, content: str) -> None:
        path.write_text(policy_of(enclave(content, ns=case.ns, basics=case.basics)))

    write(observed, case.good)
    write(written, case.bad)
    found = next(each for each in policy_file_findings(written) if each.id == case.id)
    named = commands(found, written, tmp_path, OBSERVED=observed, OUTPUT=output)
    assert named
    for words in named:
        sros(*words, cwd=tmp_path).ok()
    if include := re.search("<xi:include .*?/>", found.remedy):
        write(written, case.bad + include[0])
    left = policy_file_findings(output if output.exists() else written)
    assert (case.id in {each.id for each in left}) is (case.id in SHOWN_ONLY)


_MACHINE = "its command looks at this machine, and not at the one of the case"
NOT_HERE = {
    "runtime.container-alone": _MACHINE,
    "runtime.process-elsewhere": _MACHINE,
    "runtime.process-further-domain": _MACHINE,
    "runtime.process-not-seen": _MACHINE,
    "runtime.process-rmw-unknown": _MACHINE,
    "runtime.rmw-without-security": _MACHINE,
}
"""Why the commands for a finding about the runtime are not run, by its id."""
RUNTIME = {
    **{each: (each, change) for each, change in runtime_cases.CASES.items()},
    "expired, but not its CA": (
        "runtime.process-expired",
        lambda state, _: replace(state, now=state.now + 400 * DAY),
    ),
}
STARTS = ("env", "run")
"""The verbs that give a process its variables, which changes no file."""
STARTED, OTHERS = (
    [
        name
        for name, (kind, _) in RUNTIME.items()
        if "sros " in all_kinds()[kind].remedy and kind not in NOT_HERE
        if bool(re.search("sros (env|run) (?!.*update_keystore)", all_kinds()[kind].remedy))
        is starts
    ]
    for starts in (True, False)
)


@pytest.fixture(scope="module")
def robot(sound: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Bench, RuntimeState]:
    """A keystore with files for Zenoh, and a robot with an export; only to be read."""
    copy = tmp_path_factory.mktemp("robot") / "copy"
    copy_of(sound, copy)
    bench = Bench(copy / "ks", NOW)
    return bench, runtime_cases.SOUND(runtime_cases.sound_state(bench), bench)


def found_in(state: RuntimeState) -> list[Finding]:
    return runtime_findings(runtime_cases.seen(state))


def variables(verb: str, output: str) -> Iterator[tuple[str, str]]:
    """The variables that `sros env` prints for a shell, or `env` as they are."""
    for line in output.splitlines():
        name, _, value = line.removeprefix("export ").partition("=")
        yield name, "".join(shlex.split(value)) if verb == "env" else value


@pytest.mark.parametrize("name", some(STARTED, 4))
def test_what_starts_with_the_variables_of_a_remedy_is_mended(
    name: str, robot: tuple[Bench, RuntimeState], tmp_path: Path
) -> None:
    bench, sound = robot
    kind, change = RUNTIME[name]
    for index in range(len(sound.running.processes)):
        sound = runtime_cases.changed(index, environment=sound.environment)(sound, bench)
    state = change(sound, bench)
    found = next(each for each in found_in(state) if each.id == kind)
    node = state.running.processes[0]
    here = {**state.environment, **ENVIRONMENT}
    named = commands(found, tmp_path, bench.root, **{"KEYSTORE": bench.root, "COMMAND...": "env"})
    assert named
    for words in named:
        if words[0] == "zenoh" and bench.path("enclaves/router").exists():
            continue  # another finding had it write the files
        ended = forked(*words, env=here).ok()
        if words[0] in STARTS:
            given = {**state.environment, **dict(variables(words[0], ended.out))}
            started = replace(node, environment=given)
            fixed = replace(state, environment=given)
            again = runtime_cases.with_processes(fixed, started, sound.running.processes[1])
            assert kind not in {each.id for each in found_in(again)}, words


@pytest.mark.parametrize("name", some(OTHERS, 3))
def test_no_remedy_of_the_runtime_names_a_command_that_refuses(
    name: str, bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kind, change = RUNTIME[name]
    state = change(runtime_cases.SOUND(runtime_cases.sound_state(bench), bench), bench)
    found = next(each for each in found_in(state) if each.id == kind)
    at(state.now, monkeypatch)
    named = commands(found, tmp_path, tmp_path / "target", KEYSTORE=bench.root, IDS="0,7")
    assert named
    for words in named:
        if "--take-edits" in words:
            edit_settings(bench.root)
        sros(*words, env={**state.environment, **ENVIRONMENT}).ok()
