"""The page docs/distributions.md: which distribution ships what, and where their DDS differ."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import fields
from enum import Enum

from sros_tool.checks.upgrade import ALL
from sros_tool.dds.decision.vendors import TESTED, VendorTraits, joined_titles
from sros_tool.distributions import SUPPORTED, Shipped
from sros_tool.names import has_type_descriptions
from sros_tool.zenoh.releases import version_text
from tools.json_schemas import docstrings_of_fields
from tools.page_parts import MADE, cell, table_text
from tools.steps import CHECKOUT

_NAMES = ("title", "product", "tested")
"""The traits that are no rules."""

_RELEASES = re.compile(r" \((?:Fast DDS|Cyclone|\d)[^)]*\)(?=\.$)|; None: [^.]*(?=\.$)")
"""The releases, or the meaning of None, at the end of a sentence: the page has its own words."""

_HEAD = re.compile(r".*?\n## DDS and rules of each distribution\n", re.DOTALL)
"""The part of the page that is written by hand."""


_NOT_TESTED = (
    " For a release that is *not tested*, sros uses the rules of another release, and does not see "
    "how the two releases differ."
)


def distributions_page() -> str:
    """Return the page as Markdown, with its hand-written part as it is."""
    written = _HEAD.match((CHECKOUT / "docs" / "distributions.md").read_text("utf-8"))
    assert written, "docs/distributions.md has no part '## DDS and rules of each distribution'"
    shipped = table_text(
        *("distribution", "supported until", "default DDS", "other DDS", "rmw_zenoh"),
        "nodes also serve",
        rows=_shipped(),
    )
    all_tested = all(shipped.tested for one in SUPPORTED for shipped in one.shipped)
    parts = [
        written[0].rstrip(),
        MADE,
        shipped,
        "The column rmw_zenoh has the first version that the distribution shipped, and the first "
        "version that reads the files of sros. Versions of Rolling count for the distribution that "
        "followed: Lyrical has 0.10, so 0.7 to 0.9 count for Lyrical. The versions of DDS are the "
        "latest as of November 2026; sros assumes that all patch versions of a release decide "
        "alike." + ("" if all_tested else _NOT_TESTED),
        "These rules are not the same in all tested releases:",
        table_text("rule", "where it holds", rows=_rules()),
        "`sros check --upgrade-to` reports what an update changes, and `sros check` reports what "
        "differs between the distributions of a keystore:",
        table_text("finding", "severity", "what it says", rows=_findings()),
    ]
    return "\n\n".join(parts) + "\n"


def _findings() -> Iterator[tuple[str, ...]]:
    for kind in ALL:
        anchor = kind.id.replace(".", "").lower()
        yield f"[`{kind.id}`](reference/findings.md#{anchor})", str(kind.severity), cell(kind.title)


def _shipped() -> Iterator[tuple[str, ...]]:
    for distribution in SUPPORTED:
        first, second = map(_release, distribution.shipped)
        release = distribution.zenoh
        zenoh = f"from {version_text(release.begin)}; sros needs {version_text(release.least)}"
        nodes = "`~/get_type_description`" if has_type_descriptions(distribution.name) else "-"
        yield distribution.title, distribution.until, first, second, zenoh, nodes


def _release(shipped: Shipped) -> str:
    text = f"{shipped.product} {shipped.latest}"
    if shipped.tested:
        return text
    return f"{text}, *not tested*: decided as {shipped.vendor.title}"


def _rules() -> Iterator[tuple[str, ...]]:
    texts = docstrings_of_fields(VendorTraits)
    for field in fields(VendorTraits):
        values = [getattr(vendor.traits, field.name) for vendor in TESTED]
        if field.name in _NAMES or len(set(values)) == 1:
            continue
        own = next((type(value).__doc__ for value in values if isinstance(value, Enum)), "")
        rule = (texts.get(field.name) or own or field.name).partition("\n\n")[0]
        yield _plain(rule), "<br>".join(_where(values))


def _where(values: Sequence[object]) -> Iterator[str]:
    """Yield the releases that have each of a trait's values, in words."""
    for value in dict.fromkeys(values):
        titles = [vendor.title for vendor, own in zip(TESTED, values, strict=True) if own == value]
        releases = ", ".join(joined_titles(titles))
        if value is True:
            yield releases
        elif isinstance(value, Enum):
            text = docstrings_of_fields(type(value)).get(value.name, value.name.lower())
            yield f"{releases}: {_plain(text)}"
        elif value is not False:
            yield f"{releases}: {'no limit' if value is None else value}"


def _plain(text: str) -> str:
    return cell(_RELEASES.sub("", text).replace("``", "`"))
