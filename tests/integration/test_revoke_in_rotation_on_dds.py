"""Whom two DDS still hear when an enclave is revoked in the middle of a rotation of CAs."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path

import pytest

from sros_tool.keystore.layout import enclave_path
from sros_tool.keystore.lifecycle.renew import renew
from sros_tool.keystore.lifecycle.revoke import revoke
from sros_tool.keystore.lifecycle.rotate import rotate_ca
from sros_tool.keystore.lifecycle.rotation import RotationStage
from tests.integration.test_life_on_dds import (
    ANY,
    DOMAIN,
    HEARD,
    NOT_HEARD,
    Ask,
    Question,
    ask,
    copy,
    make,
    open_template,
    probe,
)
from tests.support import made_by_ros2
from tests.support.long_form import ONLY_LONG, some

__all__ = ["ask", "probe"]

pytestmark = pytest.mark.dds

LISTENER, TALKER, LOST = "/listener", "/talker", "/lost"


def now() -> datetime:
    return datetime.now(UTC)


def with_earlier_identity(trust: Path, earlier: Path, name: str) -> Path:
    """A thief's keystore: an earlier identity of the lost enclave, and whom to trust from now."""
    folder = copy(trust, name)
    for file in ("cert.pem", "key.pem", "permissions.p7s"):
        shutil.copy(enclave_path(earlier, LOST) / file, enclave_path(folder, LOST) / file)
    return folder


Talkers = dict[str, tuple[Path, str]]


def hears(ask: Ask, root: Path, talkers: Talkers, heard: Mapping[str, bool | None]) -> None:
    """Assert whom the listener, started now, hears (None: maybe); who does not start is not."""
    answers = {True: HEARD, False: NOT_HEARD, None: ANY}
    ask(
        {
            Question(who, (root, LISTENER), f"/{name}"): answers[heard[name]]
            for name, who in talkers.items()
        }
    )


def vendor(request: pytest.FixtureRequest) -> str:
    return str(request.node.callspec.params["ask"]).split()[0]


@pytest.mark.parametrize(
    ("stage", "template", "earlier"),
    [
        # Whether there is a list already decides whether Fast DDS asks for one of every CA.
        *some(
            [
                (RotationStage.DISTRIBUTE, "production", False),
                (RotationStage.REISSUE, "production", True),
            ],
            1,
        ),
        pytest.param(RotationStage.REISSUE, "sros2", True, marks=ONLY_LONG),
    ],
)
def test_a_revocation_takes_effect_in_every_stage(
    stage: RotationStage,
    template: str,
    earlier: bool,
    ask: Ask,
    request: pytest.FixtureRequest,
    tmp_path: Path,
) -> None:
    """Once the listener is restarted; what was heard before, and others, show that it listens."""
    root = tmp_path / "ks"
    make(root, open_template(template), {}, TALKER, LISTENER, LOST, "/other")
    if earlier:
        revoke(root, ["/other"], now=now())
    before = copy(root, "before")
    rotate_ca(root, RotationStage.DISTRIBUTE, now=now())
    thieves = {"distributed": (copy(root, "distributed"), LOST)}
    both_trusted = vendor(request) == "Fast" or stage is RotationStage.DISTRIBUTE
    if stage is RotationStage.REISSUE:
        rotate_ca(root, stage, now=now())
        reissued = copy(root, "reissued")
        thieves["reissued"] = (reissued, LOST)
        thieves["mixed"] = (with_earlier_identity(reissued, before, "mixed"), LOST)
    heard = {name: both_trusted or name == "reissued" for name in thieves}
    restarted = {"restarted": (root, TALKER)}
    friends = dict(restarted)
    if both_trusted:  # one who runs since the previous stage
        friends["running"] = (copy(thieves["distributed"][0], "running"), TALKER)
    hears(ask, root, thieves | friends, heard | dict.fromkeys(friends, True))
    assert not revoke(root, [LOST], now=now()).remarks
    refused = dict.fromkeys(thieves, False)
    hears(ask, root, thieves | friends, refused | dict.fromkeys(friends, True))
    if stage is RotationStage.DISTRIBUTE:  # it stays so when the other CA issues
        rotate_ca(root, RotationStage.REISSUE, now=now())
        hears(ask, root, thieves | restarted, refused | {"restarted": True})
    rotate_ca(root, RotationStage.RETIRE, now=now())
    hears(ask, root, thieves | restarted, refused | {"restarted": True})


def test_without_the_old_key_it_takes_effect_with_the_end_of_the_rotation(
    ask: Ask, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    """What `--until-retired` accepts, and what it is that a list of the old CA prevents."""
    root = tmp_path / "ks"
    make(root, open_template("production"), {}, TALKER, LISTENER, LOST, "/other")
    revoke(root, ["/other"], now=now())
    rotate_ca(root, RotationStage.DISTRIBUTE, now=now())
    old = {"old": (copy(root, "distributed"), LOST)}
    rotate_ca(root, RotationStage.REISSUE, now=now(), delete_old_key=True)
    new = {"new": (copy(root, "reissued"), LOST)}
    assert revoke(root, [LOST], now=now(), until_retired=True).remarks
    friend = {"friend": (root, TALKER)}
    trusted = vendor(request) == "Fast"
    expected = {"old": trusted, "new": False, "friend": True}
    hears(ask, root, old | new | friend, expected)
    rotate_ca(root, RotationStage.RETIRE, now=now())
    hears(ask, root, old | new | friend, expected | {"old": False})


def test_the_keystore_of_ros2(ask: Ask, tmp_path: Path) -> None:
    """Its CA has no key identifier and the name of the next, so openssl may take one for the other.

    All are restarted after each stage, as `rotate_ca` says for it; `renew` and `revoke` work, too.
    """
    root = tmp_path / "ks"
    made_by_ros2.make(root, TALKER, LISTENER, LOST, "/other", now=now(), domain=DOMAIN)
    friend = {"friend": (root, TALKER)}
    thieves = {"before": (copy(root, "before"), LOST)}
    hears(ask, root, friend | thieves, {"friend": True, "before": True})
    renew(root, [TALKER], now=now())
    revoke(root, ["/other"], now=now())
    hears(ask, root, friend | thieves, {"friend": True, "before": True})
    rotate_ca(root, RotationStage.DISTRIBUTE, now=now())
    hears(ask, root, friend | thieves, {"friend": True, "before": True})
    rotate_ca(root, RotationStage.REISSUE, now=now())
    thieves["reissued"] = (copy(root, "reissued"), LOST)
    mixed = with_earlier_identity(thieves["reissued"][0], thieves["before"][0], "mixed")
    thieves["mixed"] = (mixed, LOST)
    others = dict.fromkeys(thieves)
    hears(ask, root, friend | thieves, {**others, "friend": True, "reissued": True})
    assert not revoke(root, [LOST], now=now()).remarks
    silent = dict.fromkeys(thieves, False)
    hears(ask, root, friend | thieves, {"friend": True, **silent})
    rotate_ca(root, RotationStage.RETIRE, now=now())
    hears(ask, root, friend | thieves, {"friend": True, **silent})
