"""Every verb that changes trust, over drawn keystores with live Cyclone DDS nodes.

After a verb that ends with 0, whoever should talk talks, and who was revoked is not heard.  Nothing
that is sound is refused.  ``SROS_LIVES=200 SROS_LIVES_SEED=7`` is a long run.
"""

from __future__ import annotations

import os
from collections import Counter
from pathlib import Path
from random import Random

import pytest

from sros_tool.keystore.layout import ROLES
from tests.integration.lives import Life, play
from tests.support.children import LONG
from tests.support.long_form import some

pytestmark = pytest.mark.dds

LIVES = int(os.environ.get("SROS_LIVES", 40 if LONG else 2))
PLAYED = range(LIVES) if "SROS_LIVES" in os.environ else some(range(LIVES), 1)
SEED = int(os.environ.get("SROS_LIVES_SEED", 45))
AT_ONCE = 8

MAY_REFUSE = {"no cRLSign": "lacks cRLSign"}
"""The kinds of CA for which verbs may refuse a keystore, and the reason; each other is a defect."""
NOTHING_TO_DO, NOBODY = "nothing changes in the keystore", "no DDS vendor would accept"


def test_whoever_should_talk_talks_after_each_verb(tmp_path: Path) -> None:
    verbs: Counter[str] = Counter()
    kinds: Counter[str] = Counter()
    scenes = refused = heard = silent = 0
    wrong: list[str] = []
    for begin in range(0, len(PLAYED), AT_ONCE):
        lives = [
            Life(f"life {number}", tmp_path / str(number), Random(f"{SEED} {number}"))
            for number in PLAYED[begin : begin + AT_ONCE]
        ]
        for life in lives:
            life.live()
            verbs.update(life.verbs)
            kinds.update(set(life.kinds.values()) or {"made by sros"})
            refused += len(life.refused)
            reason = MAY_REFUSE.get(life.kinds.get("identity", ""))
            reasons = [NOTHING_TO_DO, *([reason] if reason else [])]
            reasons += [NOBODY] * (len(life.kinds) == len(ROLES))  # each vendor refuses one CA
            wrong += [each for each in life.refused if not any(one in each for one in reasons)]
        shown = [scene for life in lives for scene in life.scenes]
        for scene, answers in zip(shown, play(shown), strict=True):
            scenes += 1
            heard += len(scene.heard)
            silent += len(scene.silent)
            for name, answer in answers.items():
                if (answer == "heard") != (name in scene.heard):
                    wrong.append(f"{scene.title}: {name}: {answer}")
        if len(PLAYED) > AT_ONCE:
            print(f"{begin + len(lives)} lives, {scenes} scenes, wrong: {wrong}", flush=True)
    print(f"seed {SEED}: {len(PLAYED)} keystores, CAs {dict(kinds)}")
    print(f"verbs {dict(verbs)}, of them refused {refused}; {scenes} times nodes were started,")
    print(f"{heard} to be heard and {silent} not to be")
    assert not wrong, "\n\n".join(wrong)
    assert scenes >= len(PLAYED)
