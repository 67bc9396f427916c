"""Benchmarks of drawing a picture of 100 enclaves and 1000 names, and of opening its page.

There are two fleets.  In the usual one, most names are used only within a robot.  In the other one,
two random enclaves read each name, so that no two names have the same readers and nothing can be
folded.
"""

from __future__ import annotations

import importlib.util
import random
import shutil
import statistics
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path

from sros_tool.policy.document import read_policy
from sros_tool.policy.rights import policy_rights
from sros_tool.report.compose import PictureSource, compose
from sros_tool.report.folding import Folding
from sros_tool.report.formats import render_svg
from sros_tool.report.pages import render_page
from sros_tool.report.picture import SourceTitle

ROBOTS, PARTS, TOPICS = 10, 10, 10
_NOW = datetime(2026, 6, 15, 12, tzinfo=UTC)
_LIMIT_SECONDS, _LIMIT_BYTES = 2.0, 2_000_000
_FLAGS = ["--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking"]

Figure = tuple[str, float, float | None, str, bool, str]
"""The task, its figure, the floor, the limit, whether it is kept, and the unit."""


def picturing(folder: Path, rounds: int) -> Iterator[Figure]:
    """Measure making a page from a policy file, its size, and opening it in a browser."""
    for kind, text in (("within robots", _robots()), ("at random", _random())):
        file, page = folder / "pictured.xml", folder / "pictured.html"
        file.write_text(text)

        def draw(file: Path = file, page: Path = page) -> None:
            page.write_text(_page(file))

        what = f"{ROBOTS * PARTS} enclaves, {ROBOTS * PARTS * TOPICS} names {kind}"
        taken = _median(draw, rounds)
        limit = f"{_LIMIT_SECONDS:.0f} s"
        yield f"{what}: page", taken, None, limit, taken < _LIMIT_SECONDS, "s"
        taken = _median(lambda file=file: _svg(file), rounds)  # type: ignore[misc]
        yield "... as SVG", taken, None, limit, taken < _LIMIT_SECONDS, "s"
        size = page.stat().st_size
        yield "... its size, in MB", size / 1e6, None, "2 MB", size < _LIMIT_BYTES, "MB"
        if (opened := _opened(page, rounds)) is not None:
            yield "... opened in Chromium", opened, None, limit, opened < _LIMIT_SECONDS, "s"


def _picture(file: Path) -> tuple[str, PictureSource]:
    return file.name, PictureSource(
        SourceTitle(file.name, "policy"), policy_rights(read_policy(file))
    )


def _page(file: Path) -> str:
    picture = compose(_picture(file)[1])
    folding = Folding.of(picture)
    return render_page(picture, folding.scenes(), _NOW, folding.picture)


def _svg(file: Path) -> str:
    picture = compose(_picture(file)[1])
    return render_svg(picture, Folding.of(picture).scenes()[0])


def _median(work: Callable[[], object], rounds: int) -> float:
    return statistics.median(_seconds(work) for _ in range(rounds))


def _seconds(work: Callable[[], object]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def _opened(page: Path, rounds: int) -> float | None:
    """Return the seconds until the page can be used; None without Playwright or Chromium."""
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if importlib.util.find_spec("playwright") is None or chromium is None:
        return None
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=_FLAGS)

        def show() -> None:
            tab = browser.new_page()
            tab.goto(page.as_uri())
            tab.wait_for_selector("body[data-ready]")
            tab.close()

        taken = _median(show, rounds)
        browser.close()
    return taken


# ── policies ───────────────────────────────────────────────────────────────────────────────


def _name(robot: int, part: int, number: int) -> str:
    return f"/robot{robot}/part{part}/topic{number}"


def _robots() -> str:
    """Return a policy: two parts of its robot read each part, and the next robot three parts."""

    def read(robot: int, part: int) -> list[str]:
        near = [
            _name(robot, (part + step) % PARTS, n) for step in (1, 3) for n in range(TOPICS // 2)
        ]
        return near + ([_name((robot + 1) % ROBOTS, part, 0)] if part < 3 else [])

    return _policy(read)


def _random() -> str:
    """Return a policy in which two random enclaves read each name; the same in every run."""
    draw = random.Random(7)
    readers: dict[tuple[int, int], list[str]] = {}
    for robot in range(ROBOTS):
        for part in range(PARTS):
            for number in range(TOPICS):
                for _ in range(2):
                    reader = draw.randrange(ROBOTS), draw.randrange(PARTS)
                    readers.setdefault(reader, []).append(_name(robot, part, number))
    return _policy(lambda robot, part: readers.get((robot, part), []))


def _policy(read: Callable[[int, int], list[str]]) -> str:
    enclaves = "".join(
        f'<enclave path="/robot{robot}/part{part}"><profiles><profile ns="/" node="n">'
        + _topics("publish", [_name(robot, part, number) for number in range(TOPICS)])
        + _topics("subscribe", read(robot, part))
        + "</profile></profiles></enclave>"
        for robot in range(ROBOTS)
        for part in range(PARTS)
    )
    return f'<policy version="0.2.0"><enclaves>{enclaves}</enclaves></policy>'


def _topics(right: str, names: list[str]) -> str:
    if not names:
        return ""
    listed = "".join(f"<topic>{name}</topic>" for name in names)
    return f'<topics {right}="ALLOW">{listed}</topics>'
