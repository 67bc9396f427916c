"""The page of a demo: every row; names in it stay names."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from lxml import html

from sros_tool.cli.demo import _write_report
from sros_tool.report.pages import render_demo_page, render_fleet_page, without_folders
from sros_tool.terminal import visible_line
from tests.report.pictures import HOSTILE, new_page

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytest_plugins = ["tests.report.browsing"]

TAKEN_TOGETHER = "a browser"


def row(name: str, **values: Any) -> dict[str, Any]:
    usual = {
        "name": name,
        "expected": "not heard",
        "observed": "not heard",
        "as_expected": True,
        "mechanism": "who cannot authenticate is sent nothing",
        "detail": "heard 0 of 50; control: heard 50 of 50",
        "domain": 80,
        "seconds": 5.0,
        "attack": "",
        "defence_removed": "",
        "open_because": "",
        "remedy": "",
        "scenario": "attacks",
    }
    return {**usual, **values}


def result(*rows: dict[str, Any]) -> dict[str, Any]:
    scenario = {"name": "attacks", "title": "every way in", "as_expected": True, "cost": None}
    return {
        "backend": "cyclone",
        "dds": "Cyclone DDS 0.10.2",
        "vulnerabilities": HOSTILE[0],
        "why": "",
        "template": "production",
        "topic": "/chatter",
        "names": ["topic /chatter"],
        "own_network": True,
        "network_reason": "",
        "as_expected": all(row["as_expected"] for row in rows),
        "scenarios": [{**scenario, "rows": list(rows)}],
        "rows": list(rows),
    }


def test_what_was_not_tried_is_said_and_nothing_of_it_is_green() -> None:
    skipped = row("a", observed="skipped", detail="no key")
    shown = result(row("b"), skipped) | {"left_out": 3, "as_expected": False}
    keystore = {"enclaves": 7, "elsewhere": 1, "not_tried": ["a", HOSTILE[0]]}
    cast = [{"part": "guest", "enclave": "/a", "nodes": [], "why": f"why {HOSTILE[0]}"}]
    shown["scenarios"] = [{**shown["scenarios"][0], "keystore": keystore, "cast": cast}] * 2
    page = html.fromstring(render_demo_page(shown, ""))
    for scenario in page.cssselect("details.scenario"):
        assert "open" in scenario.attrib
        (summary,) = scenario.cssselect("summary")[:1]
        assert summary.text_content() == "Every way in 1 of 2 as expected"
        assert not summary.cssselect(".good")
    assert page.cssselect("h1")[0].text_content() == "sros demo: 1 of 2 attempts ended as expected"
    tiles = {tile.text_content() for tile in page.cssselect("li.tile")}
    assert {"1 skipped", "3 left out", "4 not tried, but needed for a proof"} == tiles
    text = page.text_content()
    assert f"Not tried, and needed for a proof: a; {HOSTILE[0]}." in text
    assert f"guest /a (why {HOSTILE[0]})" in text
    assert "The demo used 1 of the keystore's 7 enclaves; the keys of 1 are elsewhere." in text
    assert not page.cssselect("script")


def test_every_row_is_told_with_what_came_of_it() -> None:
    page = render_demo_page(
        result(
            row("an unsecured node listens", attack="joining"),
            row(
                "the same, strangers allowed",
                attack="joining",
                defence_removed="the refusal of strangers",
                expected="heard",
                observed="heard",
            ),
            row("names read", attack="looking", open_because="names are in clear", remedy="none"),
            row("something else", observed="heard", as_expected=False),
            row("not here", observed="skipped"),
        ),
        "made by sros 1.2.3 on 2027-01-01",
    )
    assert "Made by sros 1.2.3 on 2027-01-01." in html.fromstring(page).text_content()
    rows = html.fromstring(page).xpath("//table[@class='rows']//tr[td]")
    texts = [" ".join(" ".join(row.itertext()).split()) for row in rows]
    assert len(texts) == 5
    assert texts[0].startswith("ok an unsecured node listens not heard not heard who cannot")
    assert "without the refusal of strangers heard heard" in texts[1]
    assert texts[2].startswith("open names read")
    assert "4 of 5" not in page and "in 1 of the attempts a defense is removed" in page.lower()
    assert texts[3].startswith("differs something else not heard heard")
    assert texts[4].startswith("skipped")
    assert "3 of 5" in page and "heard 0 of 50; control" in page
    attacks = html.fromstring(page).xpath("//tr[@class='attack']")
    assert [attack.text_content() for attack in attacks] == ["joining", "looking"]


def test_scenarios_are_folded_unless_something_needs_a_look() -> None:
    known = row("names read", open_because="names are in clear")
    wrong = row("heard", observed="heard", as_expected=False)
    shown = result(row("a"), known, wrong)
    rows_of = ([row("a")], [row("a"), known], [row("a"), wrong])
    shown["scenarios"] = [
        {**shown["scenarios"][0], "rows": rows, "as_expected": wrong not in rows}
        for rows in rows_of
    ]
    page = html.fromstring(render_demo_page(shown, ""))
    summaries = [
        ("open" in scenario.attrib, [chip.text for chip in scenario.cssselect("summary > .chip")])
        for scenario in page.cssselect("details.scenario")
    ]
    assert summaries == [
        (False, ["1 of 1 as expected"]),
        (False, ["2 of 2 as expected", "1 open"]),
        (True, ["1 of 2 as expected"]),
    ]


def test_what_is_open_comes_first_with_what_to_do_and_is_never_green() -> None:
    known = {"open_because": "names are in clear", "remedy": "keep secrets out of `names`"}
    page = html.fromstring(
        render_demo_page(
            result(
                row("names read", **known),
                row("subjects read", **known),
                row("heard here", **known, open_here=True, as_expected=False),
                row("closed here", **known, observed="heard", as_expected=False),
                row("accepted", accepted=True, observed="heard"),
                row("closed"),
            ),
            "",
        )
    )
    what_to_do = "Names are in clear. Keep secrets out of names."
    assert [item.text_content() for item in page.cssselect("ul.open li")] == [
        f"open in this keystore heard here{what_to_do}",
        f"open names readopen subjects read{what_to_do}",
    ]
    pills = [(pill.text, str(pill.get("class"))) for pill in page.cssselect("td:first-child .chip")]
    assert [text for text, _ in pills] == ["open", "open", "open", "differs", "open", "ok"]
    assert [kind for _, kind in pills if "good" in (kind or "")] == ["chip good"]
    assert "1 ended otherwise" in [tile.text_content() for tile in page.cssselect("li.tile")]


def test_no_place_of_the_machine_is_told() -> None:
    value = {"a": ["in /home/me/ks/log", 3], "b": {"c": "/home/me"}, "d": None}
    assert without_folders(value, ["/home/me", "/"]) == {
        "a": ["in …/ks/log", 3],
        "b": {"c": "…"},
        "d": None,
    }


def test_no_place_of_the_machine_is_written(tmp_path: Path) -> None:
    kept = tmp_path / "kept"
    places = (Path.home(), Path.cwd(), Path(tempfile.gettempdir()), kept)
    detail = " ".join(f"'{place}/log'" for place in places)
    page, shown = tmp_path / "demo.html", result(row("a row", detail=detail))
    _write_report(page, shown, kept)
    text = page.read_text()
    assert "…/log" in text
    assert [place for place in places if str(place) in text] == []


def fleet_page(
    robots: Sequence[str] = HOSTILE[:1], paths: Sequence[str] = (f"/opt/{60 * 'library'}",)
) -> str:
    """A fleet's status with long and hostile names, in a state of each class."""
    name = HOSTILE[0]
    findings = [
        {"subject": name, "text": f"1 known; on r1; in '{path}': CVE-1-2", "remedy": name}
        for path in paths
    ]
    states = ("revoked", "earlier", "current")
    counts = {"current": 1, "earlier": 1, "revoked": 1}
    status: dict[str, Any] = {"keystore": name, "at": "2027-01-01T00:00:00Z", "counts": counts}
    rows = [
        (state, robots[0], "2027-01-01T00:00:00Z", "", "deliver", 60 * "file") for state in states
    ]
    status |= {"robots": states, "outdated_dds": ["r1"], "findings": findings}
    deliver = f"`sros distribute_key --force` {name}"
    return render_fleet_page(
        status,
        {"earlier": "an earlier one"},
        [name],
        rows,
        {"deliver": deliver},
        f"on 1 of 2{name} until 2036-11-27",
    )


def test_a_fleet_begins_with_how_many_are_current_and_says_it_once() -> None:
    page = html.fromstring(fleet_page())
    assert page.cssselect("h1")[0].text_content() == "1 of 3 robots current"
    tiles = [tile.text_content() for tile in page.cssselect("li.tile")]
    assert tiles == ["1 revoked", "1 an earlier one", "1 with a DDS to upgrade"]
    chips = [chip.text_content() for chip in page.cssselect("tbody .chip")]
    assert chips == ["revoked", "an earlier one", "current"]
    (wrong,) = page.cssselect("p.wrong")
    assert wrong.text_content().startswith(
        f"On 1 of 2{HOSTILE[0]} until 2036-11-27. Until the current revocation"
    )
    (library,) = page.cssselect("section > details")
    assert library.cssselect("summary")[0].text_content() == f"{HOSTILE[0]}: 1 known; on r1"
    assert "In '/opt/library" in library.text_content() and "CVE-1-2." in library.text_content()
    assert "r_<wbr>1" in fleet_page(["r_1"])
    # Builds of one release differ in their path only.
    builds = html.fromstring(fleet_page(["r_1"], paths=("/opt/a", "/opt/b")))
    said = [summary.text_content() for summary in builds.cssselect("section summary")]
    assert said == [f"{HOSTILE[0]}: 1 known; on r1; in '/opt/{build}'" for build in "ab"]
    # A line of a phone does not end within an option: "--" and "force" are no words.
    assert [option.text for option in page.cssselect("dd code .id")] == ["--force"]
    assert [date.text for date in page.cssselect(".wrong .id")] == ["2036-11-27"]


@pytest.mark.browser
def test_it_opens_from_disk_and_runs_nothing(browser: Browser, axe: str, tmp_path: Path) -> None:
    rows = [row(text, mechanism=text, attack=text, detail=text) for text in HOSTILE]
    messages: list[str] = []
    names = {"demo": HOSTILE, "fleet": 3 * HOSTILE[:1]}
    for kind, text in {"demo": render_demo_page(result(*rows), ""), "fleet": fleet_page()}.items():
        path = tmp_path / f"{kind}.html"
        path.write_text(text)
        page = new_page(browser)
        page.on("console", lambda message: messages.append(message.text))
        page.goto(path.as_uri())
        assert not messages
        shown = page.locator("tbody th[scope=row]").all_text_contents()
        assert shown == [*map(visible_line, names[kind])]
        assert page.evaluate("window.broken") is None
        page.evaluate(axe)
        page.evaluate("document.querySelectorAll('.scenario').forEach(fold => fold.open = true)")
        for scheme in ("light", "dark"):
            page.emulate_media(color_scheme=scheme)
            rules = {} if scheme == "light" else {"runOnly": ["color-contrast"]}
            checked = page.evaluate("rules => axe.run(document, rules)", rules)
            assert [violation["id"] for violation in checked["violations"]] == []
            assert any(rule["id"] == "color-contrast" for rule in checked["passes"])
        for width in (1280, 760, 390):
            page.set_viewport_size({"width": width, "height": 800})
            assert page.evaluate("document.documentElement.scrollWidth") <= width
        page.close()
