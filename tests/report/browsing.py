"""Keystores and browsers for the tests of pictures."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from tests.report.pictures import MOBILE_ROBOT, WEB
from tests.support.children import PATIENCE, run
from tests.support.harness import sros

if TYPE_CHECKING:
    from playwright.sync_api import Browser

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
FLAGS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]


@pytest.fixture(scope="session")
def robot_keystore(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A keystore of the mobile robot, in which something was revoked, so that there is a list."""
    root = tmp_path_factory.mktemp("robot") / "robot-keys"
    sros("create_keystore", root, "--template", "production").ok()
    sros("generate_artifacts", "-k", root, "-p", MOBILE_ROBOT).ok()
    sros("create_enclave", root, "/spare").ok()
    sros("revoke", root, "/spare").ok()
    return root


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    """Debian's Chromium, driven by Playwright."""
    playwright: Any = pytest.importorskip("playwright.sync_api", reason="needs playwright")
    if CHROMIUM is None:
        pytest.skip("needs chromium (on Debian: apt-get install chromium)")
    with playwright.sync_playwright() as driver:
        running = driver.chromium.launch(
            executable_path=CHROMIUM, args=FLAGS, timeout=PATIENCE * 1000
        )
        yield running
        running.close()


@pytest.fixture(scope="session")
def axe(request: pytest.FixtureRequest) -> str:
    """The script of axe-core, which pytest keeps between runs: npm takes long to fetch packages."""
    lock = json.loads((WEB / "package-lock.json").read_text())
    key = f"axe-core/{lock['packages']['node_modules/axe-core']['integrity'].replace('/', '_')}"
    cache = request.config.cache
    script: str | None = cache.get(key, None) if cache else None
    if not script:
        built: Path = request.getfixturevalue("built")
        script = (built / "node_modules/axe-core/axe.min.js").read_text()
        if cache:
            cache.set(key, script)
    return script


@pytest.fixture(scope="session")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of web/ with its packages, by its lock file."""
    npm = shutil.which("npm")
    if npm is None:
        pytest.skip("needs npm (on Debian: apt-get install npm)")
    copy = tmp_path_factory.mktemp("web") / "web"
    shutil.copytree(WEB, copy, ignore=shutil.ignore_patterns("node_modules"))
    # The build of esbuild comes as a package of its own; no script of a package is run.
    command = [npm, "ci", "--ignore-scripts", "--no-audit", "--no-fund"]
    done = run(command, cwd=copy, status=None)
    if done.returncode:
        pytest.skip(f"npm could not fetch the packages: {done.stderr.strip()[-300:]}")
    return copy
