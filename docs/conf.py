"""How Sphinx builds the documentation site: `./dev site`, or `sphinx-build -W -c docs . FOLDER`.

The source folder is the project's, so that a link holds in the checkout and on the site.
"""

import re
import sys
import tomllib
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

_PROJECT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(_PROJECT))  # autodoc imports sros_tool, which may not be installed

project = "sros"
author = "the sros developers"
release = tomllib.loads((_PROJECT / "pyproject.toml").read_text("utf-8"))["project"]["version"]
version = release

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
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
nitpick_ignore_regex = [("py:.*", ".*")]  # types in signatures, of which most are not on the site
highlight_language = "none"  # what has no language is a terminal or a log, not Python
default_role = "code"  # `name` in docstrings
smartquotes = False  # they would change the dashes of options and the quotes of attributes
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
suppress_warnings = ["misc.highlighting_failure"]  # elided XML and JSON in examples

html_theme = "furo"
html_title = f"sros {release}"
html_copy_source = False
html_show_copyright = False
html_static_path = ["_static"]
html_search_scorer = str(Path(__file__).with_name("scorer.js"))
html_css_files = ["site.css"]
html_extra_path = ["_root"]
html_theme_options = {"navigation_with_keys": True}


_HEAD = re.compile(r"<th\b[^>]*>(.*?)</th>", re.DOTALL)
_LONG = 30  # letters; a longer name would make its column wide at the cost of the others


def _mark_lines(code: re.Match[str]) -> str:
    """Mark commands, and lines of code so that the rest of a long line is indented further."""
    marked = []
    for line in code[2].splitlines(keepends=True):
        text = re.sub(r"<[^>]+>", "", line)
        rest = min(len(text) - len(text.lstrip(" ")), 12) + 2
        kind = "line command" if text.startswith("$ ") else "line"
        marked.append(f'<span class="{kind}" style="--rest: {rest}ch">{line}</span>')
    return f"{code[1]}{''.join(marked)}</pre>"


def _part_long_name(code: re.Match[str]) -> str:
    """Let lines end between the words of a long name, so that its column leaves room for others."""
    if len(re.sub(r"<[^>]+>", "", code[0])) <= _LONG:
        return code[0]
    return re.sub(r"(?:(?<=[\w)][_/|])|(?<=::))(?=[\w(])", "<wbr>", code[0])


def _label_cells(table: re.Match[str]) -> str:
    """Give each cell after the first the words above its column, for phones; part long names."""
    heads = [re.sub(r"<[^>]+>", "", head).strip() for head in _HEAD.findall(table[0])]
    labels = heads if len(heads) > 2 else []

    def labelled(row: re.Match[str]) -> str:
        above = iter(["", *labels[1:]])
        return re.sub("<td", lambda _: f'<td data-label="{next(above, "")}"', row[0])

    rows = re.sub(r"<tr.*?</tr>", labelled, table[0], flags=re.DOTALL)
    return re.sub(r"<code .*?</code>", _part_long_name, rows, flags=re.DOTALL)


def _mark_code(
    _app: Sphinx, _page: str, _template: str, context: dict[str, Any], _tree: object
) -> None:
    """Mark cells, lines of code, and options in commands, in which no line may be broken."""
    context["body"] = re.sub(
        r"<pre>.*?</pre>|<code .*?</code>",
        lambda pre: re.sub(
            r"(?<=[\s>])--?[a-z][\w-]*", r'<span class="option">\g<0></span>', pre[0]
        ),
        context.get("body", ""),
        flags=re.DOTALL,
    )
    context["body"] = re.sub(r"<table.*?</table>", _label_cells, context["body"], flags=re.DOTALL)
    # Pygments closes every span at the end of a line.
    context["body"] = re.sub(
        r"(<pre><span></span>)(.*?)</pre>", _mark_lines, context["body"], flags=re.DOTALL
    )


def _give_captions_a_level(
    _app: Sphinx, _page: str, _template: str, context: dict[str, Any], _tree: object
) -> None:
    """Give each heading of the table of contents the level that a screen reader needs."""
    tree = context["furo_navigation_tree"]
    context["furo_navigation_tree"] = tree.replace(
        'role="heading"', 'role="heading" aria-level="2"'
    )


def setup(app: Sphinx) -> None:
    """Connect to Sphinx, which calls this."""
    app.connect("html-page-context", _mark_code)
    app.connect("html-page-context", _give_captions_a_level, priority=900)  # after the theme
