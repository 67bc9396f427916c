"""How ``sros explain --log`` reads a log, and what it prints."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sros_tool.cli.common import print_json
from sros_tool.cli.explain_case import Place, signed_material
from sros_tool.cli.log import read_log
from sros_tool.cli.visible import visible
from sros_tool.errors import SrosError, UsageError

if TYPE_CHECKING:
    from sros_tool.explain.log import Finding
    from sros_tool.explain.material import Material


def show_log(
    log: str, root: Path | None, rest: tuple[str, ...], place: Place, *, as_json: bool
) -> int:
    """Explain the lines of a file, or of standard input for "-"; 1 if they tell of a fault."""
    from sros_tool.explain.log import explain_log

    if len(rest) > 1:
        raise UsageError("--log takes a keystore and an enclave at most, and no question")
    named = rest[0] if rest else ""
    given: Material | None = None
    if named:
        given = signed_material(root, named, place)
        if given is None:
            raise UsageError(
                f"no keystore is named to look for {named} in", "", "Write it before the enclave."
            )

    def look(enclave: str) -> Material | None:
        if given is not None and enclave in ("", given.enclave):
            return given
        if root is None or not enclave:
            return None
        try:
            return signed_material(root, enclave, place)
        except SrosError:  # of another keystore
            return None

    findings = explain_log(
        read_log(log), look, lambda material: place.setting(material.domains), str(root or "")
    )
    if as_json:
        print_json({"log": log, "findings": [_json(each) for each in findings]})
    else:
        for finding in findings:
            for line in _lines(finding):
                click.echo(visible(line))
        if not findings:
            click.echo("nothing in it tells of DDS Security refusing anything", err=True)
    return 1 if findings else 0


def _lines(finding: Finding) -> Iterator[str]:
    times = f"  ({finding.count} times)" if finding.count > 1 else ""
    yield f"line {finding.line}: {finding.text[:160]}{times}"
    of = f" [{finding.enclave}]" if finding.enclave else ""
    source = finding.vendor.title.split()[0] + " DDS" if finding.vendor else "ROS 2"
    yield f"  means     {source}{of}: {finding.cause}"
    yield from (f"  found     {each}" for each in finding.found)
    yield f"  remedy    {finding.remedy}"


def _json(finding: Finding) -> dict[str, Any]:
    return {
        "id": finding.id,
        "vendor": finding.vendor.value if finding.vendor else None,
        "line": finding.line,
        "count": finding.count,
        "text": finding.text,
        "enclave": finding.enclave or None,
        "cause": finding.cause,
        "checked": finding.checked,
        "found": list(finding.found),
        "remedy": finding.remedy,
    }
