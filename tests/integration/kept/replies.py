"""What vendors replied to the forms of earlier runs, and who is asked again.

`kept/STACK.txt`, whose name has the version of a vendor and the series of OpenSSL, has a line for
each form: its hash and the reply.  A form without a line is asked about; of the others a random
twentieth, in the long form all (`tests.support.long_form`).  With $SROS_KEEP_REPLIES all are asked
about, and what comes is written into the file.
"""

from __future__ import annotations

import fcntl
import json
import os
import re
from collections.abc import Callable, Sequence
from functools import cache
from hashlib import sha256
from pathlib import Path

from tests.support.long_form import drawn

HERE = Path(__file__).parent
KEEP = "SROS_KEEP_REPLIES" in os.environ
"""Whether all are asked, and their replies are written down."""

AGAIN = 1 / 20
"""The part of the kept replies that is asked for again."""

Reply = tuple[str, ...]

_TEMPORARY = re.compile(r"/[^\s:'\",]*/pytest-of-[^\s:'\",]*/")
_BUILT_IN = re.compile(r"\(/[^()]*/src/")
"""The folder in which a library was built, before the path of a source file in its errors."""


def answered(
    stack: str,
    forms: Sequence[str],
    ask: Callable[[list[int]], Sequence[Reply]],
    *,
    believe: Callable[[int, Reply], bool] = lambda place, reply: True,
) -> list[Reply]:
    """Return the reply of a stack ("cyclone-0.10.2-openssl-3.0") to each form.

    ``ask`` is given the places of the forms that the stack itself has to answer: those that are
    new, that were drawn, and those whose kept reply ``believe`` does not accept.
    """
    hashes = list(map(_hash, forms))
    kept = {} if KEEP else _kept(HERE / f"{stack}.txt")
    replies = {
        place: kept[name]
        for place, name in enumerate(hashes)
        if name in kept and not drawn(name, AGAIN) and believe(place, kept[name])
    }
    open_ones = [place for place in range(len(forms)) if place not in replies]
    if open_ones:
        asked = dict(zip(open_ones, ask(open_ones), strict=True))
        if KEEP:
            _assert_told_apart(forms, asked)
            _keep(HERE / f"{stack}.txt", {hashes[place]: each for place, each in asked.items()})
        replies |= asked
    return [replies[place] for place in range(len(forms))]


def _assert_told_apart(forms: Sequence[str], replies: dict[int, Reply]) -> None:
    """Assert that what has the same form was answered alike."""
    known: dict[str, Reply] = {}
    for place, (_, *answers) in replies.items():
        earlier = known.setdefault(forms[place], tuple(answers))
        assert earlier == tuple(answers), f"{earlier} and {answers} to {forms[place]}"


def kept_replies(stack: str, forms: Sequence[str]) -> list[Reply | None]:
    """Return the kept replies of a stack that is not at hand; None where there is none."""
    kept = _kept(HERE / f"{stack}.txt")
    return [kept.get(_hash(form)) for form in forms]


def _hash(form: str) -> str:
    return sha256(form.encode()).hexdigest()[:24]


@cache
def _kept(file: Path) -> dict[str, Reply]:
    if not file.exists():
        return {}
    with file.open(encoding="utf-8") as lines:
        parts = (line.rstrip("\n").partition(" ") for line in lines)
        return {name: tuple(json.loads(reply)) for name, _, reply in parts}


def _keep(file: Path, found: dict[str, Reply]) -> None:
    """Add replies to a file, which other processes may write, too."""
    with (HERE / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        _kept.cache_clear()
        plain = {name: tuple(map(_without_folders, reply)) for name, reply in found.items()}
        lines = (
            f"{name} {json.dumps(reply, ensure_ascii=False)}\n"
            for name, reply in sorted((_kept(file) | plain).items())
        )
        file.write_text("".join(lines), encoding="utf-8")
        _kept.cache_clear()
    (HERE / ".lock").unlink(missing_ok=True)


def _without_folders(text: str) -> str:
    return _BUILT_IN.sub("(./src/", _TEMPORARY.sub("", text))
