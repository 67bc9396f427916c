"""What libraries do with drawn enclaves, and what the engine says of the same folders.

`python -m tests.integration.trust.replies CASE [FOLDER]` tells both of one case, such as
"own | ca extension 17", and leaves its files in the folder.  Fast DDS is Debian's, or the one in
$SROS_FASTDDS_PREFIX.
"""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

from sros_tool.dds.decision.access import Outcome
from sros_tool.dds.decision.vendors import Vendor
from sros_tool.explain.answer import Evaluator
from sros_tool.explain.answer import ask as question
from sros_tool.keystore.participant import JoinContext, load_enclave
from tests.integration.fastdds import fastdds_vendor
from tests.integration.trust.drawing import Case, make
from tests.integration.trust.trusts import DOMAIN, LEAF, TOPIC, own
from tests.integration.vendor_oracle import (
    MATCH_SECONDS,
    Reply,
    ask_cyclone_folders,
    ask_fastdds_folders,
    cyclone_vendor,
)
from tests.support.children import run
from tests.support.raw_pki import pem, private_der

VENDORS = (Vendor.FAST_2_9, Vendor.FAST, Vendor.CYCLONE)
WORDS = {
    Outcome.ALLOWED: "matched",
    Outcome.DENIED: "denied",
    Outcome.REFUSED: "refused",
    Outcome.PEER_DENIES: "unmatched",
    Outcome.CRASHES: "crashed",
}


def word(reply: Reply) -> str:
    """Return what a library did in a word: matched, unmatched, denied, refused, crashed, …"""
    return reply.answers[0] if reply.end == "joined" else reply.end


def same(said: str, observed: str) -> bool:
    """Return whether what the engine says is what a library was observed to do.

    A peer that crashes is a crash, whomever it hits.  Where only the peer is refused, since its own
    name is not one that a name constraint permits, the enclave itself has joined.
    """
    if observed == "peer refused":
        return said != "refused"
    return said == observed.removeprefix("peer ").replace("hung", "crashed")


def engine_says(
    folder: Path, at: datetime, vendors: Sequence[Vendor] = VENDORS
) -> dict[Vendor, tuple[str, str]]:
    """Return what the engine says of an enclave's folder, in a word and a sentence, by vendor."""
    try:
        enclave = load_enclave("/t", folder, moment=at)
        asked = question("publish", f"/{TOPIC.removeprefix('rt/')}")
        context = JoinContext(DOMAIN, at)
        answers = {each: Evaluator(each, enclave, context).answer(asked) for each in vendors}
    except Exception:  # a traceback is an answer, too: a wrong one
        return dict.fromkeys(vendors, ("raises", traceback.format_exc()[-500:]))
    return {each: (WORDS[made.outcome], made.decision.text) for each, made in answers.items()}


# ── kept replies ───────────────────────────────────────────────────────────────────────────

KEPT = Path(__file__).with_name("kept_replies.txt")
_LETTERS = {"m": "matched", "u": "unmatched", "d": "denied", "r": "refused", "c": "crashed"}


def kept_replies() -> dict[Case, dict[Vendor, str]]:
    """Return what libraries were observed to do with cases: a line each, a letter a vendor.

    A dot stands for a vendor that was not asked.
    """
    kept = {}
    for line in KEPT.read_text().splitlines():
        letters, _, text = line.partition(" ")
        kept[Case.parse(text)] = {
            vendor: _LETTERS[letter]
            for vendor, letter in zip(VENDORS, letters, strict=True)
            if letter != "."
        }
    return kept


# ── real replies ───────────────────────────────────────────────────────────────────────────


MODULES = ("/usr/lib/softhsm/libsofthsm2.so", "/usr/lib/x86_64-linux-gnu/softhsm/libsofthsm2.so")
MODULE = next((path for path in MODULES if Path(path).exists()), "")


def set_up_token(folder: Path, keys: Iterable[str]) -> None:
    """Have the processes to come find these keys on tokens; without SoftHSM, they find none.

    Each key has a token of its own: one of a kind that libp11 does not know hides all others.
    """
    if not MODULE:
        return
    tokens, configuration = folder / "tokens", folder / "softhsm2.conf"
    os.environ |= {"SOFTHSM2_CONF": str(configuration), "PKCS11_MODULE_PATH": MODULE}
    utility = ["softhsm2-util", "--pin", "1234"]
    tokens.mkdir(exist_ok=True)
    configuration.write_text(f"directories.tokendir = {tokens}\nobjectstore.backend = file\n")
    for label in keys:
        file = folder / f"{label}.pem"
        if not file.exists():
            file.write_bytes(pem(*private_der(label)))
            name = label.replace(" ", "-")
            run(
                [*utility, "--init-token", "--free", "--label", f"robot-{name}", "--so-pin", "5678"]
            )
            words = ["--token", f"robot-{name}", "--label", name, "--id", "01"]
            # A kind of key that SoftHSM does not take is a key that is not there.
            run([*utility, "--import", file, *words], status=None)


@dataclass(frozen=True)
class Compared:
    """A case, what the engine says, and what a library did whenever it was asked."""

    case: Case
    said: str
    why: str
    did: tuple[str, ...]
    log: str

    @property
    def agreed(self) -> bool:
        return any(same(self.said, each) for each in self.did)


def ask(
    vendor: Vendor,
    folders: Sequence[Path],
    whole: Path,
    program_folder: Path,
    *,
    seconds: float = MATCH_SECONDS,
    at_once: int = 6,
) -> list[Reply]:
    """Ask a library about folders with own/ and peer/; ``whole`` is an enclave without oddity."""
    pairs = [(each / "own", each / "peer", "UTC") for each in folders]
    if vendor.traits.product == Vendor.CYCLONE.traits.product:
        return ask_cyclone_folders(
            pairs, TOPIC, whole, domain=DOMAIN, seconds=seconds, at_once=at_once
        )
    return ask_fastdds_folders(
        pairs, TOPIC, program_folder, domain=DOMAIN, seconds=seconds, at_once=at_once
    )


@patch.dict(os.environ)  # what names the tokens goes with the comparison
def compare(
    vendor: Vendor,
    cases: Sequence[Case],
    folder: Path,
    *,
    program_folder: Path,
    at_once: int = 6,
) -> list[Compared]:
    """Ask engine and library about cases, whose files are written into a folder.

    What differs is asked three times, with more and more time: a difference is one that stays.
    """
    now = datetime.now(UTC).replace(microsecond=0)
    folders = [folder / str(number) for number in range(len(cases))]
    trusts = [make(case)[0] for case in cases]
    for each, trust in zip(folders, trusts, strict=True):
        trust.write(each / "own", each / "peer", now)
    on_token = [each for each in trusts if each.on_token]
    if on_token:
        keys = {each.key or each.certificates[LEAF].key for each in on_token}
        set_up_token(program_folder, sorted({*keys, "p256 28"}))
    whole = folder / "whole"
    own().write(whole / "own", whole / "peer", now)
    said = [engine_says(each / "own", now, [vendor])[vendor] for each in folders]
    did: list[list[Reply]] = [[] for _ in cases]
    open_ones = list(range(len(cases)))
    for seconds, together in ((MATCH_SECONDS, at_once), (6.0, 3), (12.0, 2)):
        replies = ask(
            vendor,
            [folders[each] for each in open_ones],
            whole / "own",
            program_folder,
            seconds=seconds,
            at_once=together,
        )
        for number, reply in zip(open_ones, replies, strict=True):
            did[number].append(reply)
        open_ones = [each for each in open_ones if not same(said[each][0], word(did[each][-1]))]
        if not open_ones:
            break
    return [
        Compared(case, *says, tuple(map(word, replies)), max(each.log for each in replies))
        for case, says, replies in zip(cases, said, did, strict=True)
    ]


def main() -> None:
    """Tell of one case what engine and libraries do."""
    case = Case.parse(sys.argv[1])
    with TemporaryDirectory() as temporary:
        folder = Path(sys.argv[2] if len(sys.argv) > 2 else temporary)
        folder.mkdir(parents=True, exist_ok=True)
        print(make(case)[1] or "no oddity")
        for vendor in (fastdds_vendor(), cyclone_vendor()):
            place = folder / vendor.value
            place.mkdir()
            (made,) = compare(vendor, [case], place, program_folder=folder)
            verdict = "agree" if made.agreed else "DIFFER"
            print(f"{vendor.title}: {verdict}: engine {made.said}, library {', '.join(made.did)}")
            print(f"  engine: {made.why}")
            print(f"  library: {made.log.strip()}")


if __name__ == "__main__":
    main()
