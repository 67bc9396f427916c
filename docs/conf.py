"""How Sphinx builds the documentation site: `./dev site`, or `sphinx-build -W -c docs . FOLDER`.

The source folder is the project's, so that a link holds in the checkout and on the site.
"""

import tomllib
from pathlib import Path

_PROJECT = Path(__file__).resolve().parent.parent

project = "sros"
author = "the sros developers"
release = tomllib.loads((_PROJECT / "pyproject.toml").read_text("utf-8"))["project"]["version"]
version = release

extensions = ["myst_parser"]
root_doc = "docs/index"
include_patterns = [
    "*.md",
    "docs/**/*.md",
    "docs/*.md",
    "policies/README.md",
    "ansible_collections/sros/fleet/README.md",
]
exclude_patterns = [".*", "web", "tests", "benchmarks", "build", "dist"]

myst_heading_anchors = 4
nitpicky = True
suppress_warnings = ["misc.highlighting_failure"]  # elided XML and JSON in examples

html_theme = "furo"
html_title = f"sros {release}"
html_copy_source = False
html_show_copyright = False
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_extra_path = ["_root"]
html_theme_options = {"navigation_with_keys": True}
