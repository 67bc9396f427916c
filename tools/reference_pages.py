"""Write docs/reference/ and docs/distributions.md: pages that are made from the program.

`python -m tools.reference_pages` writes them; tests/test_pages.py compares them with the program.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import click

from sros_tool.checks.kind import all_kinds
from sros_tool.keystore.template import load_template, settings_values, template_names
from sros_tool.policy.model import Level
from sros_tool.runtime.log_texts import LOG_TEXTS, STARTS
from tools.distributions_page import distributions_page
from tools.page_parts import cell, page_text, table_text
from tools.steps import CHECKOUT
from tools.template_keys import ABOUT, KEYS, Key, without
from tools.verbs import families

FOLDER = CHECKOUT / "docs" / "reference"


def pages() -> Mapping[str, str]:
    """Return the text of each page by its file name."""
    return {
        "options.md": _options(),
        "findings.md": _findings(),
        "log_texts.md": _log_texts(),
        "template.md": _template(),
        "../distributions.md": distributions_page(),
    }


# ── verbs and options ──────────────────────────────────────────────────────────────────────


def _options() -> str:
    parts = [
        "What `sros VERB --help` prints, of all verbs. The exit status of every verb is 0 for yes "
        "or done, 1 for no, denied, different or findings, 2 if sros could not answer or do it.",
    ]
    for family, verbs in families():
        parts.append(f"## {family}")
        for name, command in verbs.items():
            parts += _verb(f"sros {name}", command)
    return page_text("Verbs and options", *parts)


def _verb(name: str, command: click.Command) -> Iterator[str]:
    # Click keeps the help option that a command first has, also for those who call it later.
    context = click.Context(command, info_name=name, help_option_names=["-h", "--help"])
    usage = " ".join([name, *command.collect_usage_pieces(context)])
    yield f"### {name}"
    yield f"```text\n{usage}\n```"
    help_parts = (command.help or "").replace("\b", "").split("\n\n")
    yield "\n\n".join(map(cell, help_parts))
    if rows := [_row(each, context) for each in command.params if isinstance(each, click.Option)]:
        yield table_text("option", "meaning", rows=iter(rows))
    if isinstance(command, click.Group):
        for part, each in command.commands.items():
            yield from _verb(f"{name} {part}", each)


def _row(option: click.Option, context: click.Context) -> tuple[str, str]:
    words, meaning = option.get_help_record(context) or (", ".join(option.opts), "")
    return f"`{words.replace('|', ' or ')}`", cell(meaning)


# ── findings ───────────────────────────────────────────────────────────────────────────────


def _findings() -> str:
    families: dict[str, list[str]] = {}
    for kind in all_kinds().values():
        family = kind.id.partition(".")[0]
        text = (
            f"### {kind.id}\n\n**{kind.severity}**: {cell(kind.title)}.\n\n{cell(kind.why)}\n\n"
            f"*Remedy:* {cell(kind.remedy)}\n\n*Source:* {cell(kind.source)}"
        )
        families.setdefault(family, []).append(text)
    parts = [
        "What `sros check` finds, by id (`sros check --list`). `--include` and `--exclude` take "
        "these ids.",
    ]
    for family, texts in families.items():
        parts += [f"## {family}", *texts]
    return page_text("Findings", *parts)


# ── texts in logs ──────────────────────────────────────────────────────────────────────────


def _log_texts() -> str:
    parts = [
        "The security messages of DDS vendors, rcl and the RMWs, and what each means. `sros "
        "explain KEYSTORE --log FILE` finds them in a log, and looks for the cause in the enclave. "
        "A text is a regular expression that is searched in a line.",
        "`Found security directory` does not prove that a node is secured. Unless "
        "`ROS_SECURITY_STRATEGY` is exactly `Enforce` (`Permissive` is the usual other value), a "
        "node that lacks its enclave or one of its files then runs unsecured, and with Fast DDS "
        "nothing else is logged. `sros check runtime` finds such processes.",
    ]
    by_vendor: dict[str, list[tuple[str, ...]]] = {}
    for each in (*STARTS, *LOG_TEXTS):
        vendor = each.vendor.title if each.vendor else "rcl and RMWs, with every DDS"
        causes = [fault.title for fault in each.faults]
        meaning = each.cause or "; or ".join(causes) or "the text alone does not show a cause"
        text = each.pattern.pattern.replace("`", "'").replace("|", "\\|")
        row = (f"`{text}`", cell(meaning), cell(each.remedy or each.remedy_without_fault))
        by_vendor.setdefault(vendor, []).append(row)
    for vendor, rows in by_vendor.items():
        parts += [f"## {vendor}", table_text("text", "meaning", "what to do", rows=iter(rows))]
    return page_text("Texts in logs, by vendor", *parts)


# ── templates ──────────────────────────────────────────────────────────────────────────────


def _template() -> str:
    parts = [
        "A keystore template is a TOML file with these keys; `sros create_keystore keystore "
        "--template FILE` uses it. The keystore keeps the keys in its `sros.toml`, and `sros "
        "update_keystore keystore --set protection.rtps=ENCRYPT` changes a key later. Unknown keys "
        "are refused. [Keystores](../keystores.md#templates) describes the templates that ship "
        "with sros.",
        "A *validity* is a duration that counts from the creation (`90d`; also `s`, `m`, `h`, `w` "
        "and `y`, which is 365 days), an expiry (`2027-06-01`), or both ends "
        "(`2026-12-01/2027-06-01`, `2026-12-01/90d`).",
        "The *levels* are `NONE`; `SIGN`, against change; `ENCRYPT`, also against reading; and "
        "both with `_WITH_ORIGIN_AUTHENTICATION`, which also proves which writer a message came "
        "from.",
    ]
    for table in dict.fromkeys(key.table for key in KEYS):
        parts.append(f"## `{table}`" if table else "## At the top of the file")
        if table in ABOUT:
            parts.append(ABOUT[table])
        rows = (
            (f"`{key.name}`", _values(key), without(key), key.meaning)
            for key in KEYS
            if key.table == table
        )
        parts.append(table_text("key", "value", "without it", "meaning", rows=rows))
    parts += ["## The templates that ship with sros", _shipped_templates()]
    return page_text("Keys of keystore templates", *parts)


def _values(key: Key) -> str:
    if isinstance(key.values, str):
        return key.values
    return "a level" if key.values == tuple(Level) else " or ".join(f"`{v}`" for v in key.values)


def _shipped_templates() -> str:
    names = template_names()
    values = [settings_values(load_template(name)) for name in names]
    paths = dict.fromkeys(path for each in values for path in each)
    rows = (
        (f"`{path}`", *(each.get(path, "") for each in values))
        for path in paths
        if path not in ("name", "description")
    )
    return table_text("key", *(f"`{name}`" for name in names), rows=rows)


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for name, text in pages().items():
        (FOLDER / name).write_text(text, "utf-8")
