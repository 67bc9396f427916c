"""What pages are made of is built from its sources, by the lock file, and shows what it should."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.report.pictures import WEB, hostile_permissions, new_page
from tests.support.children import run
from tests.support.harness import sros
from tests.support.long_form import sometimes

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytest_plugins = ["tests.report.browsing"]

TAKEN_TOGETHER = "a browser"

ASSETS = WEB.parent / "sros_tool" / "report" / "assets"


def test_the_lock_file_pins_every_package_and_names_no_host() -> None:
    lock = json.loads((WEB / "package-lock.json").read_text())
    packages = {path: package for path, package in lock["packages"].items() if path}
    assert len(packages) > 10
    for path, package in packages.items():
        assert "resolved" not in package, path
        assert package["integrity"].startswith("sha512-"), path


def test_every_library_in_the_script_has_its_licence_beside_it() -> None:
    licences = (ASSETS / "view.js.LICENSES.txt").read_text()
    lock = json.loads((WEB / "package-lock.json").read_text())["packages"]
    for name in json.loads((WEB / "package.json").read_text())["dependencies"]:
        version = lock[f"node_modules/{name}"]["version"]
        assert f"{name} {version}\n" in licences
    assert "Permission" in licences


@sometimes("building the script of the pages")
@pytest.mark.browser
def test_building_gives_the_very_files_that_ship(built: Path, tmp_path: Path) -> None:
    node = shutil.which("node")
    assert node is not None
    run([node, "build.mjs", tmp_path], cwd=built)
    made = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    shipped = {path.name: path.read_bytes() for path in ASSETS.iterdir()}
    del shipped["view.html"]  # it is written by hand
    assert made.keys() == shipped.keys()
    for name, content in shipped.items():
        assert made[name] == content, f"{name}: run `npm ci && npm run build` in web/"


@sometimes("Mermaid renders")
@pytest.mark.browser
def test_mermaid_renders(
    browser: Browser, built: Path, robot_keystore: Path, tmp_path: Path
) -> None:
    hostile = tmp_path / "hostile.xml"
    hostile.write_text(hostile_permissions())
    page = new_page(browser)
    page.set_content("<div id=out></div>")
    page.add_script_tag(path=built / "node_modules/@mermaid-js/tiny/dist/mermaid.tiny.js")
    for source in (robot_keystore, hostile):
        text = sros("view", source, "--format", "mermaid").ok().out
        page.evaluate("mermaid.initialize({startOnLoad: false, maxTextSize: 1e6, maxEdges: 5000})")
        drawn = page.evaluate("async text => (await mermaid.render('it', text)).svg", text)
        assert len(re.findall(r'class="[^"]*flowchart-link', drawn)) == text.count('|"')
        assert page.evaluate("window.broken") is None
        if source is robot_keystore:
            assert "/cmd_vel" in drawn and "DENY subscribe" in drawn
        else:
            shown = page.evaluate(
                "svg => { document.body.innerHTML = svg; return document.body.textContent }", drawn
            )
            assert "<img src=x onerror=window.broken=3>" in shown
            assert page.evaluate("window.broken") is None
    page.close()
