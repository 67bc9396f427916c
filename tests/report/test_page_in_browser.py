"""The page in a real browser: from disk, without a network, by mouse and by keyboard."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise, product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from sros_tool.files import templates_dir
from sros_tool.keystore.layout import enclave_names
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.rights import load_rights
from sros_tool.policy.document import read_policy
from sros_tool.policy.rights import policy_rights
from sros_tool.reach import OF_EVERY_NODE, QUESTIONS, Network, unguarded_topics
from sros_tool.report.compose import PictureSource, compose
from sros_tool.report.layout import scenes_of
from sros_tool.report.pages import render_page
from sros_tool.report.picture import PicturedFinding, SourceTitle, UnreadUnits, Validity
from tests.report.pictures import (
    HOSTILE,
    MOBILE_ROBOT,
    NOW,
    group,
    hostile_permissions,
    large_policy,
    new_page,
)
from tests.support.harness import policy_text, publish, sros, subscribe
from tests.support.long_form import some

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytest_plugins = ["tests.report.browsing"]

TAKEN_TOGETHER = "a browser"

pytestmark = pytest.mark.browser
PRODUCTION = templates_dir() / "production.toml"
ASKED_FOR_FLOW = ("/cmd_vel", "/scan", "/navigate_to_pose", "/lifecycle_manager/is_active")
SIZES = {"desk": (1440, 900), "phone": (390, 844)}
_TABS: dict[Browser, Page] = {}
"""The tab of a browser that no test uses now."""


@contextmanager
def opened(
    browser: Browser, path: Path, size: str = "desk", *, kept: bool = True
) -> Iterator[Page]:
    """The page, opened from disk; afterwards nothing may have failed, or have been asked for.

    A new tab costs twice as much as what it shows, so the tab is ``kept`` for the next test unless
    this one fails, or gives the tab what cannot be taken back.
    """
    said: list[str] = []
    asked: list[str] = []
    listeners: dict[Any, Callable[[Any], None]] = {
        "console": lambda message: said.append(message.text),
        "pageerror": lambda error: said.append(str(error)),
        "request": lambda request: asked.append(request.url),
    }
    page = _TABS.pop(browser, None) or new_page(browser)
    width, height = SIZES[size]
    page.set_viewport_size({"width": width, "height": height})
    for event, listener in listeners.items():
        page.on(event, listener)
    try:
        page.goto(path.as_uri())
        page.wait_for_selector("body[data-ready]")
        yield page
        assert not said
        assert set(asked) == {path.as_uri()}
        for event, listener in listeners.items():
            page.remove_listener(event, listener)
        if kept:
            page.goto("about:blank")
            _TABS[browser] = page
    finally:
        if browser not in _TABS:
            page.close()


@pytest.fixture(scope="module")
def robot_page(robot_keystore: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "robot.html"
    sros("view", robot_keystore, "-o", path).ok()
    return path


def details(page: Page) -> str:
    return page.inner_text("#details")


def texts(page: Page, selector: str) -> set[str]:
    return {text.strip() for text in page.locator(selector).all_text_contents()}


def lines(page: Page) -> int:
    return page.locator("#map path.link").count()


def test_search_finds_enclaves_and_names_and_shows_who_may_do_what(
    browser: Browser, robot_page: Path
) -> None:
    with opened(browser, robot_page) as page:
        page.fill("#search", "velocity_m")
        assert "/mobile_robot/velocity_mux" in page.inner_text("#results button >> nth=0")
        page.fill("#search", "cmd_vel")
        results = page.locator("#results button").all_inner_texts()
        assert [result.split("\n")[-1] for result in results] == [
            "/cmd_vel",
            "/cmd_vel_nav",
            "/cmd_vel_teleop",
        ]
        assert "cmd_<wbr>vel" in page.inner_html("#results")  # a line ends between words of a name
        page.click("#results button:has-text('/cmd_vel') >> nth=0")
        text = details(page)
        assert "May publish (1)" in text and "/mobile_robot/velocity_mux" in text
        assert "May subscribe (3)" in text and "/mobile_robot/base" in text
        assert "mobile_<wbr>robot/<wbr>base" in page.inner_html("#details")
        assert "encrypted" in text
        shown = "#map .card.enclave:not(.faded)"
        assert len(texts(page, shown)) == 4, texts(page, shown)
        assert page.locator(f"{shown}:has-text('recorder')").count() == 1, "it reads by a wildcard"
        page.fill("#search", "no such thing")
        assert "No name matches." in page.inner_text("#results")


def test_an_enclave_tells_its_rights_certificate_validity_and_findings(
    browser: Browser, robot_page: Path
) -> None:
    with opened(browser, robot_page) as page:
        page.click("#map .card.enclave:has-text('recorder')")
        text = details(page)
        for wanted in (
            "/mobile_robot/recorder",
            "CN=/mobile_robot/recorder",
            "days left",
            "Denied: subscribe (3)",
            "/front_camera/image_raw",
            "by /*",
            "subscribe /* fits",
        ):
            assert wanted in text, wanted
        # What has nothing to do with it fades.
        assert page.locator("#map .card.faded").count() > 10
        page.keyboard.press("Escape")
        assert page.locator("#details").is_hidden()
        assert page.locator("#map .faded").count() == 0


def test_filters_leave_what_fits(browser: Browser, robot_page: Path) -> None:
    with opened(browser, robot_page) as page:
        assert "; A: also subscribed by /mobile_robot/recorder" in page.inner_text("#summary")
        everything = lines(page)
        page.select_option("#filter-enclave", "/mobile_robot/velocity_mux")
        few = lines(page)
        assert 0 < few < everything
        assert texts(page, "#map .card.names") == {
            "/cmd_vel",
            "/cmd_vel_nav",
            "/cmd_vel_teleop",
            "/emergency_stop",
            "/diagnostics",
        }
        page.select_option("#filter-direction", "send")
        assert 0 < lines(page) < few
        page.select_option("#filter-protection", "encrypt")
        assert lines(page) > 0
        page.click("#back")
        assert lines(page) == everything
        assert page.evaluate("document.activeElement.matches('#map .card')"), "the button is gone"
        page.select_option("#filter-namespace", "/front_camera")
        shown = " ".join(texts(page, "#map .card.names"))
        assert "/front_camera/image_raw" in shown and "/scan" not in shown
        page.select_option("#filter-direction", "deny")
        assert page.locator("#map path.link.deny").count() == lines(page) > 0
        assert "denied" in page.inner_text("#legend") and "allowed" not in page.inner_text(
            "#legend"
        )


@pytest.fixture(scope="module")
def open_keystores(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Keystores of the mobile robot whose governance leaves writing open, or some names."""
    text = PRODUCTION.read_text()
    some = "".join(
        f'\n[[protection.{kind}]]\nnames = ["{name}"]\n{control}_access_control = false\n'
        for kind, name, control in (
            ("topic", "/cmd_vel", "write"),
            ("topic", "/scan", "read"),
            ("service", "/lifecycle_manager/is_active", "write"),
        )
    )
    folder = tmp_path_factory.mktemp("open")
    default = "[protection.default]\n"
    assert default in text
    for name, template in {
        "some names": text + some,
        "writing": text.replace(default, f"{default}write_access_control = false\n"),
    }.items():
        (folder / "open.toml").write_text(template)
        sros("create_keystore", folder / name, "--template", folder / "open.toml").ok()
        sros("generate_artifacts", "-k", folder / name, "-p", MOBILE_ROBOT).ok()
    return {path.name: path for path in folder.iterdir() if path.is_dir()}


def distances(network: Network, name: str, upstream: bool) -> dict[str, int]:
    """The enclaves that a name is reached from (or that it reaches), each with its hops."""
    hops = [hop() for enclave in network.enclaves for _, hop in network.links(enclave, ())]
    distance = {(hop.source if upstream else hop.target): 1 for hop in hops if hop.name == name}
    for enclave in list(distance):
        reach = network.reach(enclave)
        for other, path in (reach.learns_from if upstream else reach.influences).items():
            distance[other] = min(distance.get(other, 99), 1 + len(path))
    return distance


@pytest.mark.parametrize("open_to_all", some(["nothing", "some names", "writing"], 1))
def test_the_flow_agrees_with_the_one_that_explain_follows(
    browser: Browser,
    robot_page: Path,
    open_keystores: dict[str, Path],
    tmp_path: Path,
    open_to_all: str,
) -> None:
    by_permissions = Network(
        policy_rights(read_policy(MOBILE_ROBOT)), excluded=OF_EVERY_NODE, questions=QUESTIONS
    )
    network, path = by_permissions, robot_page
    if root := open_keystores.get(open_to_all):
        network = Network(
            load_rights(root).rights,
            excluded=OF_EVERY_NODE,
            questions=QUESTIONS,
            unguarded=unguarded_topics(OpenedKeystore(root).governance),
            everybody=enclave_names(root),
        )
        path = tmp_path / "open.html"
        sros("view", root, "-o", path).ok()
    with opened(browser, path) as page:
        for name, upstream in product(ASKED_FOR_FLOW, (True, False)):
            distance = distances(network, name, upstream)
            assert distance
            # By permissions, too, whatever one of these names reaches comes to most enclaves.
            differs = {"writing": upstream, "some names": (name, upstream) == ("/scan", False)}
            if differs.get(open_to_all):
                assert distance != distances(by_permissions, name, upstream)
            assert shown_flow(page, name, upstream) == counts(distance), (name, upstream)


def counts(distance: dict[str, int]) -> tuple[int, int]:
    """How many enclaves are within two hops, and how many at all."""
    return sum(hops <= 2 for hops in distance.values()), len(distance)


def shown_flow(page: Page, name: str, upstream: bool) -> tuple[int, int]:
    """What the page says after a click, as `counts` does."""
    page.fill("#search", name)
    page.keyboard.press("Enter")
    assert page.inner_text("#details h2") == name
    page.click("text=Who can influence it" if upstream else "text=Whom it influences")
    summary = page.inner_text("#summary")
    counts_shown = re.search(r"(\d+) enclaves? can .* within 2 hops(?:, (\d+) over)?", summary)
    assert counts_shown, summary
    page.click("#back")
    return int(counts_shown[1]), int(counts_shown[2] or counts_shown[1])


OF_ROBOTS = {
    "/{robot:seeing}/eye": subscribe("/lift") + publish("/scan"),
    "/{robot:driving}/pilot": subscribe("/scan") + publish("/go"),
    "/{robot:lifting}/boss": publish("/lift"),
}
ROBOTS = """
[groups]
seeing = {}
driving = {}
lifting = {}
[robots]
a = { groups = ["seeing", "driving"], domain = 10 }
b = { groups = ["driving"], domain = 20 }
c = { groups = ["seeing", "lifting"], domain = 30 }
"""


def test_a_flow_stays_in_its_ros_domain(browser: Browser, tmp_path: Path) -> None:
    (tmp_path / "p.xml").write_text(policy_text(OF_ROBOTS))
    (tmp_path / "f.toml").write_text(ROBOTS)
    sros("view", "p.xml", "--fleet", "f.toml", "-o", "p.html", cwd=tmp_path).ok()
    with opened(browser, tmp_path / "p.html") as page:
        # Both pilots, and the eye of a: no eye is in the domain of b.
        assert shown_flow(page, "/go", True) == (3, 3)
        # Both eyes, and the pilot of a: the pilot of b hears no eye.
        assert shown_flow(page, "/lift", False) == (3, 3)


def test_hops_can_be_added_up_to_all(browser: Browser, robot_page: Path) -> None:
    with opened(browser, robot_page) as page:
        page.fill("#search", "/cmd_vel")
        page.keyboard.press("Enter")
        page.click("text=Who can influence it")
        assert "3 enclaves can influence /cmd_vel within 2 hops" in page.inner_text("#summary")
        assert page.locator("#map .card.enclave").count() == 3
        page.click("#hops-less")
        assert page.locator("#map .card.enclave").count() == 1
        for _ in range(6):
            page.click("#hops-more")
        assert page.locator("#map .card.enclave").count() == 13
        page.click("#back")
        assert page.locator("#hops").is_hidden()


def test_the_timeline_holds_everything_that_ends(browser: Browser, robot_page: Path) -> None:
    with opened(browser, robot_page) as page:
        page.click("#tab-timeline")
        text = page.inner_text("#timeline")
        assert "identity CA" in text and "permissions CA" in text and "revocation list" in text
        assert page.locator("#timeline tbody tr").count() < 13
        ends = page.locator("#timeline time").all_inner_texts()
        assert ends == sorted(ends)
        page.click("#timeline summary >> nth=0")
        page.click("#timeline button:has-text('/mobile_robot/camera') >> nth=0")
        assert "/mobile_robot/camera" in details(page)
        page.click("#close")
        assert page.locator("#panel-timeline").is_visible()


def test_what_ends_on_the_same_day_is_one_row(browser: Browser, tmp_path: Path) -> None:
    source = tmp_path / "large.xml"
    source.write_text(large_policy(10, 10, 2))
    picture = compose(
        PictureSource(SourceTitle("large", "keystore"), policy_rights(read_policy(source)))
    )
    paths = [enclave.path for enclave in picture.enclaves]
    begin, end = "2026-01-01T00:00:00Z", "2036-01-01T00:00:00Z"
    validities = [
        Validity(end, begin, kind, p, p) for kind in ("certificate", "permissions") for p in paths
    ]
    validities[0] = replace(validities[0], not_after="2035-01-01T00:00:00Z")
    picture = replace(picture, validities=tuple(sorted(validities)))
    path = tmp_path / "large.html"
    path.write_text(render_page(picture, scenes_of(picture), NOW))
    with opened(browser, path) as page:
        page.click("#tab-timeline")
        rows = [row.split("\n")[0] for row in page.locator("#timeline tbody tr").all_inner_texts()]
        assert len(rows) == 3
        assert f"certificate {paths[0]}" in rows[0].replace("\t", " ")
        assert "certificate of 100 enclaves" in rows[1]
        assert "permissions of 101 enclaves" in rows[2]


def test_what_ended_is_seen_on_the_day_on_which_one_looks(
    browser: Browser, robot_page: Path
) -> None:
    with opened(browser, robot_page, kept=False) as page:
        page.click("#tab-timeline")
        assert page.locator("#timeline .chip.error").count() == 0
        page.clock.install(time="2039-01-01T00:00:00Z")
        page.reload()
        page.wait_for_selector("body[data-ready]")
        page.click("#tab-timeline")
        rows = page.locator("#timeline tbody tr").count()
        assert page.locator("#timeline .chip.error").count() == rows
        assert "Looks wrong: 29 expired" in page.inner_text("#headlines")


def test_everything_can_be_done_with_the_keyboard(browser: Browser, robot_page: Path) -> None:
    with opened(browser, robot_page) as page:
        page.keyboard.press("/")
        page.keyboard.type("teleop")
        page.keyboard.press("ArrowDown")
        page.keyboard.press("Escape")
        assert page.evaluate("document.activeElement.id") == "search"
        page.keyboard.type(" ")
        page.keyboard.press("ArrowDown")
        page.keyboard.press("Enter")
        assert page.evaluate("document.activeElement.textContent") == "/mobile_robot/teleop"
        page.keyboard.press("Escape")
        assert "card" in page.evaluate("document.activeElement.getAttribute('class')")
        first = page.evaluate("document.activeElement.getAttribute('aria-label')")
        page.keyboard.press("ArrowDown")
        second = page.evaluate("document.activeElement.getAttribute('aria-label')")
        page.keyboard.press("ArrowRight")
        third = page.evaluate("document.activeElement.getAttribute('aria-label')")
        assert first.startswith("enclave ") and second.startswith("enclave ") and first != second
        assert third.startswith(("topic ", "service ", "action "))
        page.keyboard.press("Enter")
        assert page.locator("#details").is_visible()
        page.keyboard.press("Escape")
        assert page.evaluate("document.activeElement.getAttribute('aria-label')") == third
        page.focus("#tab-map")
        page.keyboard.press("ArrowRight")
        assert page.locator("#panel-names").is_visible()
        page.keyboard.press("ArrowRight")
        assert page.locator("#panel-timeline").is_visible()
        page.keyboard.press("ArrowRight")
        assert page.locator("#panel-findings").is_visible()


def test_tab_leads_through_every_control_and_out_of_the_map(
    browser: Browser, robot_page: Path
) -> None:
    with opened(browser, robot_page) as page:
        seen = []
        for _ in range(22):
            page.keyboard.press("Tab")
            seen.append(
                page.evaluate("document.activeElement.id || document.activeElement.tagName")
            )
        wanted = ["theme", "print", "tab-map", "search", "filter-enclave", "zoom-in", "canvas", "g"]
        # One stop for all cards, where the arrow keys do the rest; then the page begins again.
        assert [name for name in seen if name in wanted][: len(wanted)] == wanted
        assert seen[seen.index("g") + 1] not in ("g", "canvas")


@pytest.mark.parametrize("size", some([*SIZES], 1))
def test_axe_finds_nothing(browser: Browser, robot_page: Path, axe: str, size: str) -> None:
    with opened(browser, robot_page, size) as page:
        page.evaluate(axe)

        def check(where: str, part: str, **options: object) -> None:
            options = {"resultTypes": ["violations"], **options}
            result = page.evaluate("([part, options]) => axe.run(part, options)", [part, options])
            violations = [
                (
                    violation["id"],
                    violation["nodes"][0]["html"][:150],
                    violation["nodes"][0]["failureSummary"],
                )
                for violation in result["violations"]
            ]
            assert not violations, (where, violations)
            assert any(rule["id"] == "color-contrast" for rule in result["passes"])

        def check_in_both_themes(where: str, part: str = ".panel:not([hidden])") -> None:
            """Check a part, the contrast with it, and in the other theme the contrast alone."""
            page.select_option("#theme", "light")
            check(where, part)
            page.select_option("#theme", "dark")
            check(f"{where}, dark", part, runOnly=["color-contrast"])

        page.click("#tab-map")  # a phone shows the table first
        check_in_both_themes("map", "html")
        page.fill("#search", "cmd_vel")
        page.click("#results button >> nth=0")
        page.fill("#search", "cmd_vel")
        check_in_both_themes("search and details", ":is(#side, #details)")
        page.click("#tab-timeline")
        check_in_both_themes("timeline")
        page.click("#tab-findings")
        check("findings", "#findings")
        page.click("#tab-names")
        check_in_both_themes("table")


@pytest.mark.parametrize("size", SIZES)
def test_no_text_leaves_its_card_and_nothing_is_wider_than_the_window(
    browser: Browser, robot_page: Path, size: str
) -> None:
    width, _ = SIZES[size]
    outside = """() => [...document.querySelectorAll('#map .card')].filter(card => {
        const box = card.querySelector('rect').getBoundingClientRect();
        return [...card.querySelectorAll('text')].some(text => {
            const inner = text.getBoundingClientRect();
            return inner.right > box.right + 1 || inner.bottom > box.bottom + 1;
        });
    }).map(card => card.textContent)"""
    small = """() => [...document.querySelectorAll('#map text')].filter(
        text => parseFloat(getComputedStyle(text).fontSize) * text.getScreenCTM().a < 11
    ).map(text => text.textContent)"""
    sideways = "(map => map.scrollWidth > map.clientWidth)(document.querySelector('#canvas'))"
    with opened(browser, robot_page, size) as page:
        page.click("#tab-map")
        for scene in ("0", "1"):
            page.evaluate("document.querySelectorAll('.fold').forEach(f => f.open = true)")
            page.select_option("#scene", scene)
            assert page.evaluate(outside) == [] == page.evaluate(small)
            assert not page.evaluate(sideways)
        page.select_option("#filter-enclave", "/mobile_robot/planner")
        assert page.evaluate(outside) == [] == page.evaluate(small)
        page.click("#map .card.enclave >> nth=0")
        assert page.evaluate(outside) == [] == page.evaluate(small)
        page.click("#close")
        for tab in ("map", "names", "timeline", "findings"):
            page.click(f"#tab-{tab}")
            wide = page.evaluate("document.documentElement.scrollWidth")
            assert wide <= width, tab


def test_names_cannot_run_script(browser: Browser, tmp_path: Path) -> None:
    choose_everything = """text => {
        const search = document.querySelector("#search");
        const titles = [];
        for (let count = 1, at = 0; at < count; at += 1) {
            search.value = text;
            search.dispatchEvent(new Event("input"));
            const buttons = document.querySelectorAll("#results button");
            count = buttons.length;
            buttons[at]?.click();
            titles.push(document.querySelector("#details h2").textContent);
            const flow = document.querySelector(".actions button:nth-child(2)");
            if (!flow) continue;
            document.querySelector(".actions button").click();
            document.querySelector("#back").click();
        }
        return titles;
    }"""
    source = tmp_path / "<img src=x onerror=window.broken=9>.xml"
    source.write_text(hostile_permissions())
    path = tmp_path / "page.html"
    sros("view", source, "-o", path).ok()
    with opened(browser, path) as page:
        for text in HOSTILE:
            titles = page.evaluate(choose_everything, text[:40])
            assert len(titles) >= 2, text  # the enclave, and names
            assert all(text in title for title in titles), titles
        for tab in ("names", "timeline", "findings", "map"):
            page.click(f"#tab-{tab}")
        assert page.evaluate("window.broken") is None
        assert page.locator("img, #map script, body > script + script + script").count() == 0


def test_the_policy_of_the_page_stops_what_the_escaping_would_miss(
    browser: Browser, robot_page: Path, tmp_path: Path
) -> None:
    broken = tmp_path / "broken.html"
    hole = "<script>window.broken=1</script><img src=x onerror=window.broken=2></body>"
    broken.write_text(robot_page.read_text().replace("</body>", hole))
    page = new_page(browser)
    page.goto(broken.as_uri())
    page.wait_for_selector("body[data-ready]")
    assert page.evaluate("window.broken") is None
    page.close()


def test_a_hundred_enclaves_and_a_thousand_names_can_be_explored(
    browser: Browser, tmp_path: Path
) -> None:
    """How long it takes to open is in the benchmarks."""
    source, path = tmp_path / "large.xml", tmp_path / "large.html"
    source.write_text(large_policy(10, 10, 10))
    sros("view", source, "-o", path).ok()
    assert path.stat().st_size < 2_000_000
    with opened(browser, path) as page:
        # Nine robots are equal, and drawn as one next to the one that differs.
        assert "9 equal namespaces are drawn as one" in page.inner_text("#headlines")
        assert page.locator("#map .card.enclave").count() < 50
        page.click("#map .card.enclave:has-text('part3') >> nth=-1")
        assert "9 ENCLAVES ALIKE" in details(page)
        page.click("#details .link-button >> nth=1")
        assert page.inner_text("#details h2") == "/robot1/part3"
        page.fill("#search", "/robot7/part3/t4")
        page.keyboard.press("Enter")
        assert "/robot7/part3" in details(page)


def test_what_all_names_have_in_common_is_said_once(
    browser: Browser, robot_page: Path, tmp_path: Path
) -> None:
    policy, mixed = tmp_path / "p.xml", tmp_path / "mixed.html"
    names = (f'/{word}<?sros protect="{word}"?>' for word in ("sign", "encrypt"))
    policy.write_text(policy_text({"/a": publish(*names)}))
    sros("view", policy, "-o", mixed).ok()
    with opened(browser, robot_page, "phone") as page:
        page.click("#tab-map")
        summary = page.inner_text("#summary")
        assert ", all encrypted; left out: " in summary
        assert summary.endswith("; A: also subscribed by /mobile_robot/recorder")
        assert page.locator("#map .lock").count() == 0
        # A line of a card ends within a word only if the word is longer than the line.
        drawn = page.locator("#map .card tspan, #map .card text").all_text_contents()
        for line, rest in pairwise(drawn):
            if rest.startswith("  ") and not (line.strip()[-1] == "_" or rest.strip()[0] == "/"):
                assert not set("/_").intersection(line.strip()[1:]), (line, rest)
        # Names that an enclave receives stand below those that it sends: each column has its head.
        page.click("#map .card.enclave:has-text('velocity_mux')")
        left_edges = "cards => new Set(cards.map(card => card.getBoundingClientRect().left)).size"
        assert page.locator("#map .card.names").count() > 2
        assert page.eval_on_selector_all("#map .card.names", left_edges) == 1
        page.click("#close")
        # A line of a name ends after a part of it, and what is tapped is large enough.
        page.click("#tab-names")
        assert page.locator("#names .link-button wbr").count() > 50
        titles = page.locator("#names .group b").all_inner_texts()
        assert titles[0] == "Usually moves the robot:"
        assert titles[1:] == sorted(titles[1:]) and len(titles) > 5
    with opened(browser, mixed, "phone") as page:
        page.click("#tab-map")
        assert page.locator("#map .lock").count() > 1
        assert ", all" not in page.inner_text("#summary")


def test_of_equal_robots_it_says_who_drives_and_shows_the_names_of_all(
    browser: Browser, tmp_path: Path
) -> None:
    enclaves, last = {}, "r9_of_the_long_hall_at_the_end_of_the_road"
    for robot in (*(f"/r{number}" for number in range(1, 9)), f"/{last}"):
        enclaves[f"{robot}/mux"] = publish(f"{robot}/cmd_vel", f"{robot}/state")
        enclaves[f"{robot}/base"] = subscribe(f"{robot}/cmd_vel")
        enclaves[f"{robot}/recorder"] = subscribe("/*")
    policy, path = tmp_path / "fleet.xml", tmp_path / "fleet.html"
    policy.write_text(policy_text(enclaves))
    sros("view", policy, "-o", path).ok()
    # What ties have in common, and with whom, is written once for all names.
    assert path.read_text().count('"right":"publish"') < 4
    with opened(browser, path) as page:
        said = page.inner_text("#headlines")
        assert f"May publish /{{r1…{last}}}/cmd_vel: /{{r1…{last}}}/mux\n" in said
        assert ": nobody" not in said
        assert page.evaluate(
            "(side => side.scrollWidth <= side.clientWidth)(document.querySelector('#side'))"
        )
        page.click("#tab-names")
        moving = page.locator("#names .group", has_text="Moves the robot").locator("tbody th")
        shown = moving.all_inner_texts() or page.locator("#names tbody th").all_inner_texts()
        assert not any("cmd_vel" in text and "state" in text for text in shown)
        # Each robot is found by its own name, also in rows on names of the others.
        for name, number in (("/r7/CMD", "2 names in 2 rows"), ("r7/base", "1 name in")):
            page.fill("#search-names", name)
            said = page.inner_text("#names [role=status]")
            assert said.startswith(number) and "; those of equal namespaces count once." in said
            assert f"/{{r1…{last}}}/cmd_vel" in page.inner_text("#names tbody")
        page.fill("#search-names", "r10")
        assert page.inner_text("#names [role=status]") == "No name matches."
        page.click("#headlines .link-button >> nth=0")
        assert f"9 TOPICS ALIKE\n\n/{{r1…{last}}}/cmd_vel\n" in details(page)
        assert "/r7/cmd_vel" in details(page)
    with opened(browser, path, "phone") as page:
        # No robot is drawn as one that uses the names of the others.
        page.click("#headlines .link-button >> nth=0")
        assert "/r1/" not in " ".join(texts(page, "#map .card.enclave"))
        assert "/r7/cmd_vel" in details(page)


def test_overlays_can_be_filtered_and_listed(browser: Browser, tmp_path: Path) -> None:
    allowed = group("topics", "publish", "/x", "/unused") + group("topics", "subscribe", "/z*")
    used = group("topics", "publish", "/x", "/forbidden") + group("topics", "subscribe", "/z1")
    (tmp_path / "robot.xml").write_text(policy_text({"/a": allowed}))
    (tmp_path / "seen.xml").write_text(policy_text({"/a": used}))
    path = tmp_path / "use.html"
    sros("view", tmp_path / "robot.xml", "--observed", tmp_path / "seen.xml", "-o", path).ok()
    with opened(browser, path) as page:
        said = "2 differences: 1 allowed, never observed; 1 observed, not allowed"
        assert page.inner_text("#headlines") == said
        assert page.locator("#map path.link.first").count() == 1
        assert page.locator("#map path.link.second").count() == 1
        page.select_option("#filter-mark", "first")
        assert lines(page) == 1
        assert "/unused" in texts(page, "#map .card.names").pop()
        page.click("#map .card.enclave")
        assert "allowed 3, observed 2" in details(page)
        page.click("#tab-differences")
        text = page.inner_text("#differences")
        assert "allowed, never observed" in text and "observed, not allowed" in text
    with opened(browser, path, "phone") as page:
        assert page.locator("#panel-differences").is_visible()
        page.set_viewport_size({"width": 280, "height": 600})
        right = "tabs => Math.max(...tabs.map(tab => tab.getBoundingClientRect().right))"
        assert page.eval_on_selector_all("[role=tab]", right) <= 280
    sros("view", tmp_path / "robot.xml", tmp_path / "robot.xml", "-o", path, "--force").ok()
    with opened(browser, path, "phone") as page:
        # Where nothing differs, it begins with what may be used.
        assert page.inner_text("#headlines") == "There is no difference."
        assert page.locator("#panel-names").is_visible()


@pytest.mark.parametrize("size", SIZES)
def test_fit_shows_the_whole_map(browser: Browser, robot_page: Path, size: str) -> None:
    _, height = SIZES[size]
    with opened(browser, robot_page, size) as page:
        page.click("#tab-map")
        page.click("#zoom-fit")
        box = page.locator("#map").bounding_box()
        room = page.locator("#canvas").bounding_box()
        assert box and room
        assert box["width"] <= room["width"] and box["height"] <= height
        assert box["height"] <= room["height"] + 1


def test_a_focus_says_its_answer_and_shows_what_leads_to_it(
    browser: Browser, robot_keystore: Path, tmp_path: Path
) -> None:
    path = tmp_path / "focus.html"
    sros("view", robot_keystore, "--focus", "/cmd_vel", "-o", path).ok()
    with opened(browser, path) as page:
        said = page.inner_text("#headlines")
        assert said.startswith("only /mobile_robot/velocity_mux may publish /cmd_vel; ")
        assert texts(page, "#map .card.chosen") == {"/cmd_vel"}
        assert "/scan" not in " ".join(texts(page, "#map .card"))
        assert {"2 HOPS BEFORE", "MAY PUBLISH", "MAY SUBSCRIBE"} == texts(page, "#map text.head")
        # Elsewhere on the page, too, rights that do not lead to the focus are left out.
        extract = "This page has only rights that lead to or from /cmd_vel; without --focus, "
        page.locator("#map .card.chosen").click()
        assert extract in page.inner_text("#details-content")
        page.click("#tab-names")
        assert extract in page.inner_text("#names")
    with opened(browser, path, "phone") as page:
        # The flow goes from top to bottom, all of it in sight, and the keyboard leads along it.
        assert page.evaluate(
            "(it => it.scrollWidth <= it.clientWidth)(document.querySelector('#canvas'))"
        )
        places: dict[str, Any] = {
            (card.text_content() or "").split()[0]: card.bounding_box() or {}
            for card in page.locator("#map .card").all()
        }
        tops = [places[name]["y"] for name in ("controller", "velocity_mux", "/cmd_vel", "base")]
        assert tops == sorted(set(tops))
        # No link goes through a card as if it were its own; it only touches those at its ends.
        through = """() => [...document.querySelectorAll('#map .link')].map(link => {
            const step = link.getTotalLength() / 59;
            const points = Array.from({length: 60}, (_, n) => link.getPointAtLength(step * n));
            return [...document.querySelectorAll('#map .card')].filter(card => {
                const {e: x, f: y} = card.transform.baseVal[0].matrix;
                const {width, height} = card.querySelector('rect').getBBox();
                return points.some(point => x + 2 < point.x && point.x < x + width - 2
                    && y + 2 < point.y && point.y < y + height - 2);
            }).length;
        })"""
        assert set(page.evaluate(through)) == {0}
        page.focus("#map .card.chosen")
        page.keyboard.press("ArrowUp")
        assert "velocity_mux" in page.evaluate("document.activeElement.textContent")


def test_the_table_has_every_name_and_those_that_only_one_side_may_use(
    browser: Browser, tmp_path: Path
) -> None:
    policy, path = tmp_path / "robot.xml", tmp_path / "table.html"
    enclaves = {"/a": group("topics", "publish", "/lost", "/used")}
    enclaves["/b"] = group("topics", "subscribe", "/used")
    policy.write_text(policy_text(enclaves))
    sros("view", policy, "-o", path).ok()
    with opened(browser, path) as page:
        page.click("#tab-names")
        assert "only names that one side may use (1)" in page.inner_text("#names")
        rows = page.locator("#names tbody tr")
        assert ["/lost" in row for row in rows.all_inner_texts()] == [False, True]
        page.fill("#search-names", "USED")
        assert rows.count() == 1
        page.check("#only-lacking")
        said = page.inner_text("#names [role=status]")
        assert said == "A name matches, but not these choices."
        page.fill("#search-names", "")
        assert "nobody may subscribe" in "".join(rows.all_inner_texts()) and rows.count() == 1
        page.click("#names .link-button")
        assert "nobody may subscribe" in details(page)


def test_a_group_of_the_table_says_how_much_of_it_is_left_out(
    browser: Browser, tmp_path: Path
) -> None:
    own = [[f"/{'ab'[n % 2]}/t{n}" for n in range(1, 512) if n >> at & 1] for at in range(9)]
    own.append(["/c/last"])
    enclaves = {f"/e{at}": group("topics", "publish", *names) for at, names in enumerate(own)}
    policy, path = tmp_path / "robot.xml", tmp_path / "table.html"
    policy.write_text(policy_text(enclaves))
    sros("view", policy, "-o", path).ok()
    with opened(browser, path) as page:
        page.click("#tab-names")
        assert "512 names in 512 rows; shown are the first 400." in page.inner_text("#names")
        shown = page.locator("#names .group").evaluate_all(
            "groups => groups.map(it => [it.querySelectorAll('tbody tr').length,"
            " it.querySelector('.soft').textContent])"
        )
        assert sum(rows for rows, _ in shown) == 400
        said = [
            f"{rows} of {names} name{'s' * (names > 1)}"
            for (rows, _), names in zip(shown, (255, 256, 1), strict=True)
        ]
        assert shown[-1][0] == 0
        assert [text.split(",")[0] for _, text in shown] == said


def test_a_phone_shows_first_who_may_drive_and_what_everybody_may_do(
    browser: Browser, open_keystores: dict[str, Path], tmp_path: Path
) -> None:
    path = tmp_path / "open.html"
    sros("view", open_keystores["some names"], "-o", path).ok()
    shown = sros("view", open_keystores["some names"], "--format", "markdown").out
    who = "everybody with an identity, `/mobile_robot/velocity_mux`"
    assert f"| topic `/cmd_vel` (encrypted) | {who} |" in shown
    with opened(browser, path, "phone") as page:
        # What needs a look is unfolded; a search unfolds all, and paper has all.
        rows = page.locator("#names tbody tr:visible")
        assert 0 < rows.count() < 9
        page.evaluate("dispatchEvent(new Event('beforeprint'))")
        printed = rows.count()
        page.evaluate("dispatchEvent(new Event('afterprint'))")
        assert printed > 50 and rows.count() < 9
        page.fill("#search-names", "/mobile_robot/monitor")
        assert rows.count() > 20
        page.fill("#search-names", "")
        page.evaluate("document.querySelectorAll('.group').forEach(it => { it.open = true; })")
        first, *others = rows.all_inner_texts()
        assert first.split()[1:9] == [
            *("/cmd_vel", "everybody", "with", "an", "identity"),
            *("/mobile_robot/velocity_mux", "/mobile_robot/base", "/mobile_robot/monitor"),
        ]
        (scan,) = (row for row in others if "/scan" in row.split())
        assert scan.split()[1:7] == [
            *("/scan", "/mobile_robot/lidar", "everybody", "with", "an", "identity"),
        ]
        page.click("#names .link-button >> nth=0")
        assert "everybody may publish" in details(page)
        assert "everybody may publish" in " ".join(texts(page, "#map .card.names"))
        page.click("#tab-map")
        said = page.inner_text("#headlines")
        driver = "May publish /cmd_vel: everybody with an identity, /mobile_robot/velocity_mux"
        anybody = "On DDS, everybody with an identity may use some names without a right: 3 names"
        assert said.startswith(anybody) and driver in said
        # What was chosen stands alone with its neighbors, all in sight.
        canvas = "document.querySelector('#canvas')"
        fits = f"{canvas}.scrollWidth <= {canvas}.clientWidth"
        assert page.locator("#map .card").count() == 5 and page.evaluate(fits)
        page.click("#close")
        assert page.locator("#map .card").count() > 50 and page.locator("#back").is_hidden()


def test_a_robot_of_unknown_names_says_who_may_do_most_and_equal_findings_are_one(
    browser: Browser, tmp_path: Path
) -> None:
    enclaves = {"/a": publish("/a/in"), "/b": publish("/b/out"), "/c": publish("/c/state")}
    enclaves |= {"/writer": publish("/x", "/y"), "/reader": subscribe("/?", "/x")}
    (tmp_path / "p.xml").write_text(policy_text(enclaves))
    sros("create_keystore", "ks", "--template", "production", cwd=tmp_path).ok()
    sros("generate_artifacts", "-k", "ks", "-p", "p.xml", cwd=tmp_path)
    sros("view", "p.xml", "-o", "p.html", cwd=tmp_path).ok()
    sros("view", "ks", "-o", "ks.html", cwd=tmp_path).ok()
    most = (
        "May publish or call most names (2 of 5): /writer",
        "May subscribe to or serve most names (2 of 5): /reader",
    )
    with opened(browser, tmp_path / "p.html") as page:
        said = page.inner_text("#headlines").split("\n")
        unknown = "What strangers may do is not stated here: a keystore's governance says it."
        node = "/a: p.xml:1: node /n may not reply /n/get_type_description"
        wrong = f"Looks wrong: 20 errors, 1 warning ({node})"
        assert [line for line in said if line] == [*most, wrong, unknown]
    with opened(browser, tmp_path / "ks.html") as page:
        said = page.inner_text("#headlines").split("\n")
        closed = "On DDS, strangers, who have no identity, may use none of these names"
        assert any(line.startswith(closed) for line in said)
        page.click("#headlines .link-button >> nth=0")
        assert "/writer" in details(page)
        page.click("#tab-findings")
        assert "-topk8" in texts(page, "#findings code .unbroken")
        assert "5 enclaves" in page.inner_text("#findings")
        assert page.locator("#findings .finding").count() < 5


def test_only_what_was_checked_is_without_an_error(browser: Browser, tmp_path: Path) -> None:
    source, path = tmp_path / "p.xml", tmp_path / "p.html"
    source.write_text(policy_text({"/a": publish("/left/cmd_vel", "/right/cmd_vel")}))
    rights = policy_rights(read_policy(source))
    picture = compose(PictureSource(SourceTitle("p.xml", "policy"), rights))
    skipped = replace(picture, findings=(PicturedFinding("view.not-checked", "note", "why"),))
    sampled = replace(picture, unread=(UnreadUnits("robot", ("r2", "r3"), 4, "r1"),))
    for each, said in (
        (sampled, "No error or warning was found in the enclaves that were read."),
        (skipped, "Not all was checked: 1 note"),
    ):
        path.write_text(render_page(each, scenes_of(each), NOW))
        with opened(browser, path) as page:
            shown = page.inner_text("#headlines").split("\n")
        assert said in shown and "May publish /left/cmd_vel and 1 more: /a" in shown


def test_what_is_violated_comes_first_and_the_map_opens_where_it_is(
    browser: Browser, tmp_path: Path
) -> None:
    policy, wanted, path = (tmp_path / name for name in ("p.xml", "r.toml", "p.html"))
    enclaves = {f"/a{n}": publish(*(f"/n{n}/t{m}" for m in range(9))) for n in range(9)}
    for n in range(9):
        enclaves[f"/a{n}"] += subscribe(*(f"/n{(n + 1) % 9}/t{m}" for m in range(9)))
    policy.write_text(policy_text({**enclaves, "/mux": publish("/n8/t8")}))
    only = '[[only]]\npublish = ["/n8/t8"]\nenclaves = ["/mux"]\n'
    hold = '[[nobody]]\npublish = ["/n0/no"]\n[[protected]]\ntopics = ["/n0/t0"]\nlevel = "sign"\n'
    wanted.write_text(only + hold)
    sros("view", policy, "--requirements", wanted, "-o", path).ok()
    inside = """() => {
        const room = document.querySelector('#canvas').getBoundingClientRect();
        const {top, bottom} = document.querySelector('#map .violates').getBoundingClientRect();
        return room.top <= bottom && top <= room.bottom && top < innerHeight;
    }"""
    with opened(browser, path) as page:
        first, second, *others = filter(None, page.inner_text("#headlines").split("\n"))
        only_one = "; 1 of the others holds only under an assumption"
        assert first == f"1 of 3 requirements violated{only_one}"
        assert second == "/a8 may publish /n8/t8"
        # It is said once, and what looks wrong besides it is not called none.
        assert "may publish /n8/t8" not in " ".join(others)
        assert "No error" not in " ".join(others)
        assert page.evaluate(inside)
        # What can be pressed in a sentence is not told by its color alone.
        lines = "buttons => buttons.map(button => getComputedStyle(button).textDecorationLine)"
        assert set(page.eval_on_selector_all("#headlines button", lines)) == {"underline"}
        broken = "/a8: p.xml:1: may publish /n8/t8, but only /mux"
        for words, said in (
            ("1 of 3 requirements", broken),
            ("/a8 may publish", broken),
            ("under an assumption", "requirement.assumed"),
        ):
            page.click(f"#headlines .link-button:has-text('{words}')")
            assert said in page.inner_text("#findings .finding:focus")
            page.click("#tab-map")
    with opened(browser, path, "phone") as page:
        page.click("#tab-map")
        assert page.evaluate(inside)
    policy.write_text(policy_text({**enclaves, "/a8": publish("/z"), "/mux": publish("/n8/t8")}))
    sros("view", policy, "--requirements", wanted, "-o", path, "--force").ok()
    with opened(browser, path, "phone") as page:
        held = "3 requirements hold, 1 of them only under an assumption"
        assert page.inner_text("#headlines").startswith(held)
        # A long head is not cut off, and a tab brings what it shows into sight.
        page.evaluate("document.querySelector('h1').style.height = '700px'")
        page.click("#tab-findings")
        assert page.evaluate(
            "document.querySelector('#panel-findings').getBoundingClientRect().top < 100"
        )


def test_it_prints_every_part(browser: Browser, robot_page: Path) -> None:
    with opened(browser, robot_page, kept=False) as page:
        page.emulate_media(media="print")
        for part in ("#map", "#timeline", "#findings"):
            assert page.locator(part).is_visible(), part
        for control in ("#search", "#search-names", ".choices"):
            assert page.locator(control).is_hidden(), control
        assert len(page.pdf()) > 20_000
