"""The site builds without a warning, and every command of a page does what the page shows."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from sros_tool.keystore.template import load_template, parse_template, settings_values, with_values
from tests.report.pictures import new_page
from tests.support.children import python
from tests.support.long_form import some, sometimes
from tests.support.pages import PROJECT, PageError, alike, blocks, fits, outcome_of
from tools import man_page
from tools.reference_pages import FOLDER, pages
from tools.template_keys import KEYS, template_text

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytest_plugins = ["tests.report.browsing"]

PAGES = sorted(
    path.relative_to(PROJECT)
    for path in (
        *PROJECT.glob("*.md"),
        *PROJECT.glob("docs/**/*.md"),
        *PROJECT.glob("policies/*.md"),
    )
    if any(block.commands for block in blocks(path.read_text("utf-8")))
)


@pytest.mark.parametrize("page", some(PAGES, 2), ids=str)
def test_the_commands_of_a_page_do_what_it_shows(page: Path, tmp_path: Path) -> None:
    if page.name == "ca_service.md" and not shutil.which("cfssl"):
        pytest.skip("the program cfssl is needed")
    wrong = outcome_of(PROJECT / page, tmp_path)
    assert not wrong, wrong


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, which builds without a warning."""
    pytest.importorskip("furo")
    folder = tmp_path_factory.mktemp("site")
    python("-m", "sphinx", "-q", "-W", "--keep-going", "-d", folder / "trees", "-c", "docs", ".",
           folder / "site", cwd=PROJECT)  # fmt: skip
    return folder / "site"


@sometimes("the site")
def test_the_site_builds_without_a_warning_and_loads_nothing_from_elsewhere(site: Path) -> None:
    page = (site / "docs" / "zenoh.html").read_text("utf-8")
    assert "sros zenoh" in page
    options = (site / "docs" / "reference" / "options.html").read_text("utf-8")
    assert "--all-vendors" in options and not set("\u2013\u2014\u201c\u201d") & set(options)
    assert '<span class="line" style="--rest: 4ch">  ' in page  # long lines are indented further
    assert '<td data-label="what to do">' in page  # a phone has no columns
    assert (site / "index.html").exists()
    data = (site / "_static/language_data.js").read_text("utf-8")
    assert (PROJECT / "docs/scorer.js").read_text("utf-8") in data  # recipes before references
    loaded = subprocess.run(
        ["grep", "-rlE", r"(src|href)=\"https?://[^\"]+\.(js|css|woff2?)", site],
        capture_output=True,
        text=True,
        check=False,
    )
    assert loaded.stdout == ""


@sometimes("the site")
@pytest.mark.browser
def test_the_site_fits_its_screen_and_shows_where_the_keyboard_is(
    browser: Browser, site: Path
) -> None:
    wide = "tables => tables.filter(table => table.scrollWidth > table.clientWidth + 1).length"
    page = new_page(browser)
    page.set_viewport_size({"width": 1280, "height": 900})
    for name in ("security", "zenoh", "json"):
        page.goto((site / f"docs/{name}.html").as_uri())
        assert page.eval_on_selector_all("article table", wide) == 0, name
    for _ in range(5):
        page.keyboard.press("Tab")
        outline = "getComputedStyle(document.activeElement).outlineStyle"
        assert page.evaluate(outline) != "none", page.evaluate("document.activeElement.className")
    page.set_viewport_size({"width": 390, "height": 844})
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    # On a phone, the words above the first column stay, and a cell without content is no line.
    page.goto((site / "docs/fetching.html").as_uri())
    heads = page.locator("article th:visible").all_inner_texts()
    assert "stolen" in heads and "what to do" not in heads
    assert page.locator("article td:has(p:empty):visible").count() == 0
    page.close()


def test_the_search_of_the_site_ranks_titles_and_recipes_first() -> None:
    if (node := shutil.which("node")) is None:
        pytest.skip("needs node")
    hits = [
        ["docs/reference/options", "Verbs and options", "", "", 15],
        ["docs/howto/laptop", "A laptop in the fleet", "", "", 5],
        ["docs/concepts", "Concepts", "", "", 5],
        ["docs/howto/close", "Close", "", "", 15],  # with the word in a heading
        ["docs/life_of_keys", "The life of keys", "", "", 15],
        ["docs/howto/stolen_robot", "Revoke a stolen robot", "", "", 15],
    ]
    script = (PROJECT / "docs/scorer.js").read_text("utf-8")
    script += f"""
        globalThis.location = {{ search: "?q=revoke" }};
        const hits = {json.dumps(hits)}.map((hit) => [Scorer.score(hit), hit[0]]);
        console.log(hits.sort((a, b) => b[0] - a[0]).map((hit) => hit[1]).join(" "));"""
    ranked = subprocess.run([node, "-e", script], capture_output=True, text=True, check=True).stdout
    assert [page.rpartition("/")[2] for page in ranked.split()] == [
        "stolen_robot",
        "close",
        "life_of_keys",
        "laptop",
        "concepts",
        "options",
    ]


def test_the_reference_is_made_from_the_program() -> None:
    for name, text in pages().items():
        assert (FOLDER / name).read_text("utf-8") == text, "run `python -m tools.reference_pages`"


def test_the_page_of_templates_has_the_keys_and_values_of_the_program() -> None:
    written = settings_values(parse_template(template_text(), ""))
    known = {key.path for key in KEYS}
    for table in ("enclaves", "protection.topic"):  # the program writes their names into the key
        known.remove(f"{table}.names")
    stated = {re.sub(r" [^ ]+\.", ".", key) for key in written}
    assert known == {re.sub(r"\.(/[^.]+)\.", r'."\1".', key) for key in stated}
    template = load_template("production")
    for key in KEYS:
        if key.table in ("[authorities]", "[permissions]", "[protection]", "[protection.default]"):
            for value in key.values if not isinstance(key.values, str) else ():
                if key.name != "allow_unauthenticated_participants":
                    assert with_values(template, [(key.path, value)])


def test_the_manual_page_is_made_from_the_program() -> None:
    assert man_page.PAGE.read_text("utf-8") == man_page.page(), "run `python -m tools.man_page`"


def test_a_page_that_shows_something_else_is_found(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("```\n$ sros completion bash\nsomething else\n```\n", "utf-8")
    assert "expected:\nsomething else" in outcome_of(page, tmp_path)


def test_what_may_differ_between_two_runs_and_what_may_not() -> None:
    assert alike("until 2027-05-21T05:21:15Z") == alike("until 2031-01-01T00:00:00Z")
    assert fits(
        ("created 'a'", "...", "SHA-256 0123456789abcdef"),
        "created 'a'\nx\ny\nSHA-256 ffff0000ffff0000\n",
    )
    assert not fits(("created enclave /a",), "created enclave /b\n")
    assert not fits(("created enclave /a",), "created enclave /a\nand a note\n")


def test_a_comment_that_is_not_understood_is_refused() -> None:
    with pytest.raises(PageError, match="not understood"):
        list(blocks("<!-- not-run: mistyped -->\n"))
