"""The engine against the vendors in what lies around the documents: certificates, lists, PEM.

Enclaves are drawn with one or two oddities over eleven bases (`tests.integration.trust`).  In the
long form, or with $SROS_TRUST (how many) and $SROS_TRUST_SEED (1), the libraries are asked; else
only about a few, and what they did with others is kept in ``trust/kept_replies.txt``.
"""

from __future__ import annotations

import os
from collections import Counter
from datetime import UTC, datetime
from pathlib import Path
from time import monotonic

import pytest

from sros_tool.dds.decision.vendors import Vendor
from tests.integration.fastdds import fastdds_vendor
from tests.integration.trust.drawing import FAMILIES, Case, controls, draw, make
from tests.integration.trust.replies import Compared, compare, engine_says, kept_replies, same
from tests.integration.vendor_oracle import cyclone_vendor
from tests.support.children import LONG
from tests.support.long_form import some
from tests.support.openssl import takes_changes_for_lists

COUNT = int(os.environ.get("SROS_TRUST", "1000" if LONG else "0"))
SEED = int(os.environ.get("SROS_TRUST_SEED", "1"))
AT_ONCE = 60
"""Enclaves that are written before they are asked about: certificates of a moment."""
FEW = 10

pytestmark = pytest.mark.filterwarnings("ignore")


def test_the_engine_says_what_vendors_were_observed_to_do(tmp_path: Path) -> None:
    kept, now = kept_replies(), datetime.now(UTC).replace(microsecond=0)
    wrong = []
    for number, (case, observed) in enumerate(some([*kept.items()], 70)):
        trust, text = make(case)
        folder = tmp_path / str(number)
        trust.write(folder / "own", folder / "peer", now)
        for vendor, (said, why) in engine_says(folder / "own", now, [*observed]).items():
            if not same(said, observed[vendor]):
                wrong.append(f"{case} ({text}): {vendor.title} {observed[vendor]}, not {why}")
    assert not wrong, "\n".join(wrong)
    assert {family for case in kept for family, _ in case.oddities} == set(FAMILIES)
    for vendor in (Vendor.FAST_2_9, Vendor.FAST, Vendor.CYCLONE):
        observed_words = Counter(words.get(vendor) for words in kept.values())
        assert min(observed_words["matched"], observed_words["refused"]) > len(kept) / 5


@pytest.mark.dds
@pytest.mark.parametrize("asked", ["Fast DDS", "Cyclone DDS"])
def test_drawn_enclaves(asked: str, tmp_path: Path) -> None:
    vendor = cyclone_vendor() if asked == "Cyclone DDS" else fastdds_vendor()
    cases = draw(SEED, COUNT) if COUNT else list(kept_replies())[:: len(kept_replies()) // FEW]
    cases += list(controls())[:: 1 if COUNT else 5]
    if takes_changes_for_lists():
        cases = [case for case in cases if " delta" not in make(case)[1]]
    begin, wrong = monotonic(), list[Compared]()
    count = Counter[str]()
    for start in range(0, len(cases), AT_ONCE):
        folder = tmp_path / str(start)
        for each in compare(
            vendor, cases[start : start + AT_ONCE], folder, program_folder=tmp_path
        ):
            count[each.did[-1]] += 1
            if not each.agreed:
                wrong.append(each)
                print(_shown(each), flush=True)
        if not COUNT:
            continue
        done = start + len(cases[start : start + AT_ONCE])
        rate = done / (monotonic() - begin)
        print(
            f"{vendor.title}: {done} enclaves, {rate:.1f} a second, {len(wrong)} differ", flush=True
        )
    print(f"{vendor.title}, seed {SEED}: {len(cases)} enclaves, {dict(count)}; {len(wrong)} differ")
    assert not wrong, "\n".join(map(_shown, wrong[:5]))
    assert count["matched"] and count["refused"]


def _shown(each: Compared) -> str:
    does = ", ".join(each.did)
    return f"{each.case} ({make(each.case)[1]}): {does}, not {each.said}: {each.why}; {each.log}"


def test_a_case_is_made_again_from_its_text() -> None:
    for case in draw(3, 20):
        assert Case.parse(str(case)) == case
        assert make(Case.parse(str(case)))[1] == make(case)[1]
