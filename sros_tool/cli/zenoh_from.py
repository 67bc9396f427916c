"""Reading an existing configuration of Zenoh: who may do what, and where it is open."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sros_tool.cli.common import check_output, print_json, print_notes, save
from sros_tool.cli.findings import echo_findings
from sros_tool.errors import Note, PolicyError
from sros_tool.terminal import echo
from sros_tool.written import FileChange, file_change

if TYPE_CHECKING:
    from sros_tool.translate_from_zenoh import RightsBehindRules
    from sros_tool.zenoh.document import ConfigurationDocument

_MOST_KEYS = 5


def show_from(file: Path, output: Path | None, *, force: bool, dry_run: bool, as_json: bool) -> int:
    """Say what the configuration ``file`` allows, and write it as a policy to ``output``.

    Returns 1 if the configuration is open or does not work (a finding that is an error), else 0.
    """
    from sros_tool.checks.kind import ERROR, WARNING
    from sros_tool.checks.zenoh import ReadConfiguration, document_findings, subject_rights
    from sros_tool.policy.document import write_policy
    from sros_tool.translate_from_zenoh import policy_of, rights_behind
    from sros_tool.xml import read_bytes
    from sros_tool.zenoh.document import parse_configuration

    if output:
        check_output(output, force=force)
    document = parse_configuration(read_bytes(file, "Zenoh configuration"), str(file))
    rights = rights_behind(document)
    findings = sorted(
        document_findings(document), key=lambda each: (-each.severity.weight, each.line or 0)
    )
    shown = [each for each in findings if each.severity >= WARNING]
    notes: tuple[Note, ...] = ()
    saved = ""
    changes: Sequence[FileChange] = ()
    if output:
        policy = policy_of(rights)
        if not policy.enclaves:
            raise PolicyError(
                f"the rules of '{file}' make no policy",
                _why_no_policy(rights),
                "`sros zenoh --from` without -o shows what the rules allow. `sros generate_policy` "
                "makes a policy from a running robot.",
            )
        notes = tuple(_left_out(rights))
        changes = file_change(output, existed=output.exists())
        saved = "" if dry_run else save(output, write_policy(policy))
    if as_json:
        print_json(
            ReadConfiguration(
                document.name,
                document.mode,
                document.access.enabled,
                subjects=[subject_rights(behind) for behind in rights],
                findings=shown,
                output=output if saved else None,
                dry_run=dry_run,
                changes=changes,
                notes=notes,
            )
        )
    else:
        for line in _lines(document, rights):
            echo(line)
        for each in shown:
            echo_findings([each])
        if output and dry_run:
            echo(f"would {changes[0].action} {output}")
    print_notes(notes)
    if saved:
        echo(saved, err=True)
    return 1 if any(each.severity >= ERROR for each in findings) else 0


def _lines(document: ConfigurationDocument, found: Sequence[RightsBehindRules]) -> Iterator[str]:
    from sros_tool.checks.zenoh import VERBS

    yield f"{document.name}: the configuration of a {_kind(document)}"
    for each in found:
        if not (each.rights or each.unsaid or each.denied):
            continue
        obeys = ", by rules that bind only itself" if each.own else ""
        yield f"{_who(each)}{obeys}"
        for right in VERBS:
            stated = [one for one in each.rights if one.right == right]
            for one in stated:
                domain = "" if one.domain == "0" else f" (domain {one.domain})"
                lacks = f" (of no use without {', '.join(one.lacks)})" if one.lacks else ""
                yield f"  may {VERBS[right]} {one.name}{domain}{lacks}"
        yield from _keys("may also", each.unsaid)
        yield from _keys("is denied, if no wildcard is used,", each.denied)


def _keys(what: str, pairs: Sequence[tuple[str, str]]) -> Iterator[str]:
    from sros_tool.checks.zenoh import VERBS

    for right, verb in VERBS.items():
        keys = [key for of, key in pairs if of == right]
        more = f" and {len(keys) - _MOST_KEYS} more" if len(keys) > _MOST_KEYS else ""
        if keys:
            yield f"  {what} {verb} the keys {', '.join(keys[:_MOST_KEYS])}{more}"


def _kind(document: ConfigurationDocument) -> str:
    mode = document.mode.value
    return mode if mode == "router" else f"session (mode {mode})"


def _who(found: RightsBehindRules) -> str:
    if found.own:
        return f"the process itself ({found.subject})"
    if found.names is None:
        return f"everybody who gets a connection{f' ({found.subject})' if found.subject else ''}"
    return ", ".join(found.names[:_MOST_KEYS]) + (
        f" and {len(found.names) - _MOST_KEYS} more" if len(found.names) > _MOST_KEYS else ""
    )


def _why_no_policy(found: Sequence[RightsBehindRules]) -> str:
    """Say which subjects have rights, but are no enclaves."""
    strangers = [_who(each) for each in found if each.rights]
    if not strangers:
        return "They allow no ROS name that anybody may publish, subscribe, call or serve."
    more = f" and {len(strangers) - _MOST_KEYS} more" if len(strangers) > _MOST_KEYS else ""
    return (
        f"They allow something to {', '.join(strangers[:_MOST_KEYS])}{more}: none is the name of "
        "an enclave, such as /talker, in cert_common_names."
    )


def _left_out(found: Sequence[RightsBehindRules]) -> Iterator[Note]:
    """Yield notes about what the rules allow or deny, and the policy does not state."""
    from sros_tool.translate_from_zenoh import enclave_of

    for each in found:
        if (each.rights or each.unsaid) and not enclave_of(each):
            yield Note("zenoh.no-enclave", f"{_who(each)}: no enclave, so not in the policy")
        elif each.unsaid:
            keys = ", ".join(key for _, key in each.unsaid[:_MOST_KEYS])
            yield Note(
                "zenoh.unsaid",
                f"{_who(each)}: the policy lacks {len(each.unsaid)} rights that no ROS name "
                f"states exactly: {keys}",
            )
    domains = sorted({one.domain for each in found for one in each.rights} - {"0", "*"}, key=int)
    if domains:
        yield Note(
            "zenoh.domains",
            f"a policy names no domains, and has the rights of domains {', '.join(domains)}, too: "
            "they hold in every domain of the keystore that is made from it. Make one for each "
            "domain if they shall differ.",
        )
    yield Note(
        "zenoh.node-names",
        "the rules name no nodes: each profile has the last part of its enclave's name, and "
        "absolute names",
    )
