"""Who talks with whom while the CAs of a keystore are replaced, asked of two DDS that enforce."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from itertools import pairwise
from pathlib import Path

import pytest

from sros_tool.dds.domains import DomainSet
from sros_tool.keystore.lifecycle.create import create_enclaves, create_keystore
from sros_tool.keystore.lifecycle.revoke import revoke
from sros_tool.keystore.lifecycle.rotate import renew_identity_ca, rotate_ca
from sros_tool.keystore.template import load_template
from tests.integration.restarts import play
from tests.integration.test_life_on_dds import HEARD, SILENT, Question, ask_fast, compare, probe
from tests.support.children import apart
from tests.support.harness import copy_of
from tests.support.long_form import ONLY_LONG

__all__ = ["probe"]

pytestmark = pytest.mark.dds

DOMAIN = 141
ALL = {"running": True, "listener": True, "talker": True, "both": True}
TOGETHER = {"running": True, "listener": False, "talker": False, "both": True}


def make(root: Path, template: str, *, revoked: bool = False) -> None:
    now = datetime.now(UTC)
    choice = replace(load_template(template), default_permissions="everything")
    create_keystore(root, template=choice, domains=DomainSet.of((DOMAIN, DOMAIN)), now=now)
    create_enclaves(root, ["/talker", "/listener", "/lost"], now=now)
    if revoked:
        revoke(root, ["/lost"], now=now)


# ── Cyclone DDS: nodes that run, and are restarted one by one ──────────────────────────────


def restarts(root: Path, steps: dict[str, dict[str, bool]]) -> None:
    """Assert who hears whom after each step; who is to be heard is waited for."""
    assert apart(partial(play, root, DOMAIN, steps)) == steps


@pytest.mark.parametrize(
    ("template", "revoked"),
    [
        ("production", True),
        pytest.param("sros2", False, marks=ONLY_LONG),
        pytest.param("production", False, marks=ONLY_LONG),
    ],
)
def test_the_stages_on_cyclone(template: str, revoked: bool, tmp_path: Path) -> None:
    """It trusts one CA at a time: after the stage reissue, all have to be restarted together."""
    make(tmp_path / "ks", template, revoked=revoked)
    restarts(tmp_path / "ks", {"distribute": ALL, "reissue": TOGETHER, "retire": ALL})


def test_a_ca_with_the_same_key_disturbs_nobody_on_cyclone(tmp_path: Path) -> None:
    make(tmp_path / "ks", "production", revoked=True)
    restarts(tmp_path / "ks", {"same-key": ALL})


@ONLY_LONG
def test_all_stages_at_once_on_cyclone(tmp_path: Path) -> None:
    make(tmp_path / "ks", "production")
    restarts(tmp_path / "ks", {"finish": TOGETHER})


# ── Fast DDS: processes with the files of one moment, and of another ───────────────────────


def talk(program: Path, expected: str, *pairs: tuple[Path, Path]) -> None:
    """Assert whether the talker of one keystore is heard by the listener of another."""
    questions = {
        Question((talking, "/talker"), (listening, "/listener")): expected
        for talking, listening in pairs
    }
    compare(questions, ask_fast(program, questions, DOMAIN))


def moments(root: Path, steps: int) -> list[Path]:
    """Copies of a keystore: as it is, and after each of the stages.

    A process goes on with what it read when it was started, so whoever has not been restarted
    since is one that is started with the copy.
    """
    copies = [copy_of(root, root.with_name("before"))]
    for step in range(steps):
        rotate_ca(root, now=datetime.now(UTC))
        copies.append(copy_of(root, root.with_name(f"after{step}")))
    return copies


@pytest.mark.parametrize(
    ("template", "revoked"),
    [
        ("production", True),
        ("sros2", False),
        pytest.param("production", False, marks=ONLY_LONG),
        pytest.param("sros2", True, marks=ONLY_LONG),
    ],
)
def test_the_stages_on_fast_dds(template: str, revoked: bool, probe: Path, tmp_path: Path) -> None:
    """It trusts all CAs of a file: everybody talks, whoever was restarted since the last stage."""
    make(tmp_path / "ks", template, revoked=revoked)
    copies = moments(tmp_path / "ks", 3)
    pairs = [(one, one) for one in copies]
    for one, next_one in pairwise(copies):
        pairs += [(one, next_one), (next_one, one)]
    talk(probe, HEARD, *pairs)
    # Who missed a stage is left behind, so the answers above say something.
    talk(probe, SILENT, (copies[0], copies[2]), (copies[3], copies[1]))


def test_a_ca_with_the_same_key_disturbs_nobody_on_fast_dds(probe: Path, tmp_path: Path) -> None:
    root = tmp_path / "ks"
    make(root, "production", revoked=True)
    before = copy_of(root, tmp_path / "before")
    renew_identity_ca(root, now=datetime.now(UTC))
    talk(probe, HEARD, (before, root), (root, before), (root, root))
