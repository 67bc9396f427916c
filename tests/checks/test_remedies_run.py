"""The commands that a finding names are done, not refused, where the finding was made."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import sys
from datetime import datetime
from pathlib import Path

import pytest

from sros_tool.checks.keystores.keystore import keystore_findings
from sros_tool.checks.kind import Finding
from sros_tool.checks.registry import KINDS
from tests.checks.bench import SECRET, Bench
from tests.checks.keystore_cases import CASES
from tests.support.harness import Ended, sros

pytest_plugins = ["tests.checks.sound_keystore"]

ENVIRONMENT = {"SROS_CA_PASSPHRASE": SECRET}
_EDITED = "the case signs a governance that no settings state, which has to be settled first"
_UNKNOWN = "the case signs permissions that no ledger has, which `sros renew` never signs again"
ELSEWHERE = {
    "keystore.home-or-robot": "its command is for the keystore from which the export came",
    "keystore.weak-cryptography": "the case puts in the certificate of a CA without its key",
    "enclave.certificate-not-yet-valid": "the clock is wrong, and so the CA is not valid either",
    "enclave.permissions-not-yet-valid": _UNKNOWN,
    "enclave.subject-not-unique": _UNKNOWN,
    "governance.unauthenticated": _EDITED,
    "governance.no-join-control": _EDITED,
    "governance.no-access-control": _EDITED,
    "governance.no-encryption": _EDITED,
    "governance.no-authenticity": _EDITED,
    "governance.discovery-open": _EDITED,
    "governance.liveliness-open": _EDITED,
    "governance.xml-differs": "the case writes a governance that cannot be carried out",
}
"""Why the commands for a finding cannot be run where a case makes it, by its id."""


def commands(finding: Finding, policy: Path, target: Path) -> list[list[str]]:
    """The commands of a remedy with arguments, with the names that a person fills in."""
    name = finding.subject.split(",")[0] if finding.subject.startswith("/") else "/base"
    words = {
        "POLICY_FILE": policy,
        "POLICY": policy,
        "FLEET_FILE": target.with_name("fleet.toml"),
        "TARGET": target,
        "NAME": name,
        "NAME...": name,
        "IDS": 0,
        "ID": 0,
    }
    found = re.findall(r"`(sros [^`]+)`", finding.remedy)
    split = (shlex.split(part)[1:] for each in found for part in each.split(" && "))
    whole = (each for each in split if any(not word.startswith("-") for word in each[1:]))
    return [[str(words.get(word, word)) for word in each] for each in whole]


def at(moment: datetime, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have the program take a moment for the present one."""
    sros("--version")
    for name, module in list(sys.modules.items()):
        if name.startswith("sros_tool.cli.") and hasattr(module, "now"):
            monkeypatch.setattr(module, "now", lambda: moment)


NAMED = [each for each in CASES if "`sros " in KINDS[each].remedy and each not in ELSEWHERE]


@pytest.mark.parametrize("kind", NAMED)
def test_no_remedy_names_a_command_that_refuses(
    kind: str, bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    CASES[kind](bench)
    options = {"now": bench.now, **bench.options}
    found = [each for each in keystore_findings(bench.checked, **options) if each.id == kind]
    assert found
    at(options["now"], monkeypatch)
    policy = bench.root.with_name("policy.xml")
    root = Path(os.path.abspath(bench.root))
    shutil.copytree(root, tmp_path / "broken", symlinks=True)
    if (root / "fleet.toml").exists():
        shutil.copy(root / "fleet.toml", tmp_path)

    def run(words: list[str]) -> Ended:
        return sros(*words, env=ENVIRONMENT, cwd=tmp_path)

    for words in commands(found[0], policy, tmp_path / "target"):
        ended = run(words)
        if ended.status > 1:  # perhaps the other choice was carried out before
            shutil.rmtree(root)
            shutil.copytree(tmp_path / "broken", root, symlinks=True)
            ended = run(words)
        assert ended.status < 2, (words, ended.err)
