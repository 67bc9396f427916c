"""``sros explain`` about all enclaves: who may do something, and whom one reaches."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from sros_tool.cli.common import keystore_from_environment, print_json, print_notes
from sros_tool.cli.explain_case import Place, vendor_of
from sros_tool.errors import KeystoreError, UsageError

if TYPE_CHECKING:
    from sros_tool.explain.flow import Path as FlowPath
    from sros_tool.explain.flow import Reach
    from sros_tool.explain.who import Standing
    from sros_tool.keystore.rights import RightsSource


def _keystore(root: Path | None) -> Path:
    from sros_tool.keystore.create import list_enclaves

    found = root or keystore_from_environment()
    list_enclaves(found)
    return found


def show_who(
    root: Path | None,
    rest: tuple[str, ...],
    kind: str | None,
    vendor: str | None,
    place: Place,
    as_json: bool,
) -> int:
    """Say which enclaves of the keystore may; 0 if any may."""
    from sros_tool.explain.question import ask
    from sros_tool.explain.who import who
    from sros_tool.notes import Note

    if not 1 <= len(rest) <= 2:
        raise UsageError(
            "--who takes what is to be done, and a name", "", "As in publish /cmd_vel."
        )
    question = ask(rest[0], rest[1] if len(rest) > 1 else "", kind)
    chosen, why = vendor_of(vendor)
    keystore = _keystore(root)
    found = who(keystore, question, chosen, place.setting, at=place.at)
    if as_json:
        print_json(
            {
                "question": str(question),
                "vendor": chosen.value,
                "vendor_why": why,
                "documented_only": chosen.documented_only,
                "enclaves": [_who_json(each) for each in found],
            }
        )
    else:
        for line in _who_lines(found):
            click.echo(line)
        documented = ", as documented" if chosen.documented_only else ""
        click.echo(f"{question}, on {chosen.title} ({why}{documented})", err=True)
        if question.word == "call" and not kind and not any(each.outcome.ok for each in found):
            action = ask("call", question.name, "action")
            if any(e.outcome.ok for e in who(keystore, action, chosen, place.setting, at=place.at)):
                told = f"enclaves may {action}: add --type action if that is what it is."
                print_notes([Note("explain.an-action", told)])
    return 0 if any(each.outcome.ok for each in found) else 1


def show_reach(
    enclave: str,
    root: Path | None,
    rest: tuple[str, ...],
    policy: Path | None,
    infrastructure: bool,
    as_json: bool,
) -> int:
    """Say whom an enclave can influence and learn from."""
    from sros_tool.explain.flow import OF_EVERY_NODE, Network
    from sros_tool.keystore.rights import load_rights

    if root is None and len(rest) == 1:
        root, rest = Path(rest[0]), ()
    if rest:
        raise UsageError("--reach takes one enclave, and no question")
    source = load_rights(root or policy or keystore_from_environment())
    without = () if infrastructure else OF_EVERY_NODE
    network = Network(source.rights, without=without, **_opened(source))
    if source.kind == "keystore":
        _check_there(source.path, enclave)
    if enclave not in network.enclaves:
        raise KeystoreError(
            f"enclave {enclave} has no rights in '{source.path}'",
            f"There are {', '.join(network.enclaves[:5]) or 'none'}.",
        )
    reach = network.reach(enclave)
    if as_json:
        print_json({"path": str(source.path), "left_out": list(without), **_reach_json(reach)})
    else:
        for line in _reach_lines(reach):
            click.echo(line)
    print_notes(source.notes)
    if without and not as_json:
        told = f"left out: {', '.join(without)}, which every node writes and reads"
        click.echo(f"{told} (--infrastructure counts it)", err=True)
    return 0


def _check_there(root: Path, enclave: str) -> None:
    from sros_tool.keystore.layout import enclave_names
    from sros_tool.keystore.missing import no_such_enclave

    there = tuple(enclave_names(root))
    if enclave not in there:
        raise no_such_enclave(root, enclave, there)


def _opened(source: RightsSource) -> dict[str, Any]:
    """What everybody in a keystore may do, because its governance does not control access."""
    if source.kind != "keystore":
        return {}
    from sros_tool.explain.unguarded import unguarded
    from sros_tool.keystore.layout import enclave_names
    from sros_tool.keystore.open import governance_of

    return {
        "unguarded": unguarded(governance_of(source.path)),
        "everybody": enclave_names(source.path),
    }


# ── telling ───────────────────────────────────────────────────────────────────────────────


def _who_lines(found: Sequence[Standing]) -> Iterator[str]:
    """The enclaves that may, by which wildcard, and how many may not."""
    able = [each for each in found if each.outcome.ok]
    for each in able:
        yield each.enclave + (f"  by the wildcard {each.wildcard}" if each.wildcard else "")
    broken = [each for each in found if each.outcome in ("refused", "crashes")]
    for each in broken:
        yield f"  not now: {each.enclave}  {each.text.partition(': ')[2]}"
    yield f"{len(able)} of {len(found)} enclaves may"


def _who_json(each: Standing) -> dict[str, Any]:
    """How one enclave stands to a question."""
    return {
        "enclave": each.enclave,
        "allowed": each.outcome.ok,
        "outcome": each.outcome.value,
        "reason": each.reason,
        "expression": each.expression or None,
        "wildcard": each.wildcard or None,
    }


def _reach_lines(reach: Reach) -> Iterator[str]:
    """Whom an enclave influences and learns from, each with a shortest path."""
    from sros_tool.explain.flow import path_text

    for what, paths in (
        ("can influence", reach.influences),
        ("can learn from", reach.learns_from),
    ):
        count = f"{len(paths)} enclave{'' if len(paths) == 1 else 's'}"
        yield f"{reach.enclave} {what} {count}"
        for _, path in sorted(paths.items(), key=lambda item: (len(item[1]), item[0])):
            yield f"  {path_text(path)}"


def _reach_json(reach: Reach) -> dict[str, Any]:
    """Whom an enclave influences and learns from, with the hops of a shortest path."""
    return {
        "enclave": reach.enclave,
        "influences": _paths_json(reach.influences),
        "learns_from": _paths_json(reach.learns_from),
    }


def _paths_json(paths: dict[str, FlowPath]) -> list[dict[str, Any]]:
    return [
        {
            "enclave": enclave,
            "path": [
                {
                    "from": hop.source,
                    "to": hop.target,
                    "kind": hop.kind,
                    "right": hop.right,
                    "name": hop.name,
                    "said": hop.said,
                    "heard": hop.heard,
                }
                for hop in path
            ],
        }
        for enclave, path in sorted(paths.items())
    ]
