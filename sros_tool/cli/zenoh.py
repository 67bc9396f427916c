"""The verb `zenoh`: the Zenoh network of a keystore, and the files by which Zenoh enforces it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from sros_tool.cli.changed import enclave_lines, print_files, print_follow_up, print_plan
from sros_tool.cli.common import (
    PATH,
    change_options,
    check_output,
    dry_run_option,
    echo_findings,
    force_option,
    json_option,
    keystore_from_environment,
    output_option,
    print_json,
    print_notes,
    progress,
    save,
    verb,
)
from sros_tool.errors import Note, PolicyError, UsageError
from sros_tool.terminal import echo
from sros_tool.values import FileChange, file_change
from sros_tool.wording import counted, first_few

if TYPE_CHECKING:
    from sros_tool.keystore.template import Template
    from sros_tool.translate_zenoh.rights import RightsOfSubject
    from sros_tool.zenoh.configuration import ZenohNetwork
    from sros_tool.zenoh.document import ConfigurationDocument

_DONE_WORDS = {"create": "wrote", "replace": "replaced", "remove": "removed"}
_FOUND_WORDS = {"create": "missing", "replace": "out of date", "remove": "no longer needed"}


@verb("zenoh")
@click.argument("root", type=PATH, metavar="[KEYSTORE]", required=False)
@click.option(
    "--router",
    "routers",
    multiple=True,
    metavar="NAME[=HOST:PORT]",
    help="NAME: the enclave of the router, /router by default. NAME=HOST:PORT: add a router for "
    "another robot or host; /r1/router=r1.local:7447 is the router of the enclaves /r1/*. NAME=: "
    "remove that router. May be repeated.",
)
@click.option(
    "--endpoint",
    "endpoints",
    multiple=True,
    metavar="HOST:PORT",
    help="Where sessions connect to the router; by default at localhost:7447. May be repeated.",
)
@click.option(
    "--listen",
    multiple=True,
    metavar="HOST:PORT",
    help="Where the router listens, if not at --endpoint. May be repeated.",
)
@click.option(
    "--cross",
    "crossing",
    multiple=True,
    metavar="NAME",
    help=(
        "Let only these topics and services, such as '/fleet/*', pass between routers; by default "
        "all names for which enclaves at both ends have rights. May be repeated; '' restores the "
        "default."
    ),
)
@click.option(
    "--mode",
    type=click.Choice(["client", "peer"]),
    help=(
        "client (default): sessions connect only to the router. peer: sessions on one host also "
        "connect to each other."
    ),
)
@click.option("--domain", metavar="IDS", help="ROS domains; by default the keystore's.")
@click.option(
    "--off",
    is_flag=True,
    help="Remove the Zenoh files, and the Zenoh network from the keystore's settings, so that no "
    "verb writes such files any more.",
)
@click.option(
    "--check",
    "only_check",
    is_flag=True,
    help="Write nothing; report missing and outdated files, and enclaves without a file, with the "
    "reasons.",
)
@click.option(
    "--from",
    "existing",
    type=PATH,
    metavar="FILE",
    help=(
        "Show the rights of each subject in an existing Zenoh configuration, and what the "
        "configuration leaves open to everybody."
    ),
)
@output_option("With --from: write the allowed rights to FILE, as a policy.")
@force_option
@dry_run_option
@json_option
def zenoh(
    root: Path | None,
    routers: tuple[str, ...],
    endpoints: tuple[str, ...],
    listen: tuple[str, ...],
    crossing: tuple[str, ...],
    mode: str | None,
    domain: str | None,
    off: bool,
    only_check: bool,
    existing: Path | None,
    output: Path | None,
    force: bool,
    dry_run: bool,
    as_json: bool,
) -> None:
    """Write the files with which Zenoh enforces the rights of KEYSTORE (rmw_zenoh).

    Every enclave gets session.json5, and the router's enclave gets router.json5; a signed copy is
    next to each file. The files state the same rights as the signed permissions. The options are
    stored in the keystore's settings; from then on, every verb that changes the keystore also
    updates the files.

    Example:
      $ sros zenoh keystore
      created enclave /router
      wrote keystore/enclaves/router/router.json5
      wrote keystore/enclaves/talker/session.json5
      $ sros zenoh keystore --endpoint robot:7447 --listen [::]:7447
      $ sros zenoh keystore --router /r1/router=r1.local:7447
      $ sros zenoh keystore --check
      $ sros zenoh --from session.json5 -o policy.xml

    Exit status: 0 if the files are written, or up to date. With --check, 1 if a file is missing or
    out of date, or an enclave of the network's ROS domains has no file, for example because it has
    no permissions. With --from, 1 if the configuration lets anybody in, or does not work. 2 if sros
    cannot write the files, for example because Zenoh cannot enforce a right.
    """
    from sros_tool.keystore.layout import ZENOH_FILES, check_keystore
    from sros_tool.keystore.lifecycle.update import set_zenoh
    from sros_tool.keystore.reader import OpenedKeystore, read_consistently
    from sros_tool.keystore.zenoh_files import OTHER_DOMAINS

    if existing:
        _refuse_with_from(
            root, *routers, *endpoints, *listen, *crossing, mode, domain, off, only_check
        )
        raise SystemExit(
            _show_from(existing, output, force=force, dry_run=dry_run, as_json=as_json)
        )
    if output or force:
        raise UsageError("--output and --force are for --from only", "", "Leave them out.")
    root = root or keystore_from_environment()
    check_keystore(root)
    settings = OpenedKeystore(root).template
    chosen = {
        "router": ",".join(name for name in routers if "=" not in name),
        "endpoints": ",".join(endpoints),
        "listen": ",".join(listen),
        "mode": mode,
        "domains": _parse_domains(domain),
    }
    chosen_settings = {f"zenoh.{key}": text for key, text in chosen.items() if text}
    further = [name.partition("=")[::2] for name in routers if "=" in name]
    if off and (chosen_settings or further or crossing):
        raise UsageError(
            "--off takes no options of the network", "", "Leave --off or these options out."
        )
    network = None if off else _network(settings, chosen_settings, further, crossing)
    with progress("writing the Zenoh files"):
        work = read_consistently(set_zenoh) if only_check else set_zenoh
        result = work(root, network, **change_options(dry_run=dry_run or only_check))
    # A document and the signed one next to it are written together.
    actions = {
        change.path: change.action
        for change in result.changes
        if Path(change.path).name in ZENOH_FILES
    }
    changed = dict.fromkeys(map(_document_path, actions))
    if as_json:
        from sros_tool.keystore.lifecycle.shown import shown_zenoh

        print_json(shown_zenoh(result, result.template.zenoh, changed))
    elif dry_run and not only_check:
        print_plan(root, result.changes)
    else:
        for line in enclave_lines(
            result.created, f"{'missing:' if only_check else 'created'} enclave {{}}"
        ):
            echo(line)
        for action, done in _DONE_WORDS.items():
            words = f"{_FOUND_WORDS[action]}:" if only_check else done
            of_action = [path for path in changed if actions.get(path, "replace") == action]
            print_files(root, words, of_action)
    left_out = result.zenoh.left_out
    if only_check and not as_json:
        for name, why in left_out.items():
            echo(f"no file: enclave {name}: {why}")
        notes = tuple(note for note in result.notes if note.id != "zenoh.left-out")
        result = replace(result, notes=notes)
    if not result.changes:
        have = "has" if len(left_out) == 1 else "have"
        without = f"; {counted(len(left_out), 'enclave')} {have} no file" if left_out else ""
        echo(f"the Zenoh files are up to date{without}", err=True)
    print_follow_up(result, restart=not (dry_run or only_check))
    if only_check and (result.changes or {*left_out.values()} - {OTHER_DOMAINS}):
        raise SystemExit(1)


def _refuse_with_from(*options: object) -> None:
    if any(options):
        raise UsageError(
            "--from takes no keystore and no options of the network",
            "--from reads one configuration, and changes no keystore.",
            "Leave them out.",
        )


def _network(
    settings: Template,
    given_values: dict[str, str],
    routers: Sequence[tuple[str, str]],
    crossing: Sequence[str],
) -> ZenohNetwork:
    """Return the network of the settings, or the default network, changed by ``given_values``.

    ``routers`` are further routers with their endpoints; an empty endpoint removes a router.
    """
    from sros_tool.keystore.template import with_values
    from sros_tool.zenoh.configuration import ZenohNetwork

    network = settings.zenoh or ZenohNetwork()
    if crossing:
        network = replace(network, crossing=tuple(filter(None, crossing)))
    for name, endpoint in routers:
        network = _with_router(network, name, endpoint)
    chosen = with_values(replace(settings, zenoh=network), list(given_values.items())).zenoh
    return chosen or network


def _with_router(network: ZenohNetwork, name: str, endpoint: str) -> ZenohNetwork:
    """Return the network with a router at ``endpoint``; if that is empty, without the router."""
    from sros_tool.zenoh.configuration import ZenohRouter

    known = {router.name: router for router in network.routers}
    if not endpoint:
        if known.pop(name, None) is None:
            raise UsageError(
                f"the network has no further router {name}",
                f"It has {', '.join(known) or 'none'} besides {network.router}.",
                f"{'Name one of these, or leave' if known else 'Leave'} the option out.",
            )
        return replace(network, routers=tuple(known.values()))
    folder = name.rpartition("/")[0]
    if name not in known and not folder:
        raise UsageError(
            f"the enclaves that connect to the router {name} are not known",
            "A router with an endpoint serves the enclaves in its folder, such as /r1/* for "
            "/r1/router, not the enclaves of all hosts.",
            "Name a router such as /r1/router, or state its enclaves in sros.toml, at "
            f'[zenoh.routers."{name}"].',
        )
    router = known.get(name) or ZenohRouter(name, (), (), (f"{folder}/*",))
    known[name] = replace(router, endpoints=(endpoint,))
    return replace(network, routers=tuple(known.values()))


def _parse_domains(text: str | None) -> str:
    """Return domain ids with every range written out: ``3,4,5,9`` for ``3-5,9``; "" for no text."""
    from sros_tool.dds.domains import DomainSet

    return ",".join(map(str, DomainSet.parse(text, "--domain"))) if text else ""


def _document_path(path: str) -> str:
    """Return the path of the document to which a Zenoh file belongs."""
    return path.removesuffix(".p7s").removesuffix(".json5") + ".json5"


# ── zenoh --from ──────────────────────────────────────────────────────────────────────────────


_MOST_KEYS = 5


def _show_from(
    file: Path, output: Path | None, *, force: bool, dry_run: bool, as_json: bool
) -> int:
    """Say what the configuration ``file`` allows, and write it as a policy to ``output``.

    Returns 1 if the configuration is open or does not work (a finding that is an error), else 0.
    """
    from sros_tool.checks.kind import ERROR, WARNING
    from sros_tool.checks.zenoh import ReadConfiguration, document_findings, subject_rights
    from sros_tool.policy.document import policy_xml
    from sros_tool.translate_zenoh.rights import policy_of, rights_of_subjects
    from sros_tool.xml import read_bytes
    from sros_tool.zenoh.document import parse_configuration

    if output:
        check_output(output, force=force)
    document = parse_configuration(read_bytes(file, "Zenoh configuration"), str(file))
    rights = rights_of_subjects(document)
    findings = sorted(
        document_findings(document),
        key=lambda finding: (-finding.severity.weight, finding.line or 0),
    )
    shown = [finding for finding in findings if finding.severity >= WARNING]
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
        notes = tuple(_notes_on_lost_rules(rights))
        changes = file_change(output, existed=output.exists())
        saved = "" if dry_run else save(output, policy_xml(policy))
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
        for line in _configuration_lines(document, rights):
            echo(line)
        for finding in shown:
            echo_findings([finding])
        if output and dry_run:
            echo(f"would {changes[0].action} {output}")
    print_notes(notes)
    if saved:
        echo(saved, err=True)
    return 1 if any(finding.severity >= ERROR for finding in findings) else 0


def _configuration_lines(
    document: ConfigurationDocument, subjects: Sequence[RightsOfSubject]
) -> Iterator[str]:
    from sros_tool.checks.zenoh import VERBS

    yield f"{document.name}: the configuration of a {_kind(document)}"
    for rights in subjects:
        if not (rights.rights or rights.unsaid or rights.denied):
            continue
        obeys = "; no other process enforces these rules" if rights.self_limiting else ""
        yield f"{_subject_text(rights)}{obeys}"
        for right in VERBS:
            for stated in (stated for stated in rights.rights if stated.right == right):
                domain = "" if stated.domain == "0" else f" (domain {stated.domain})"
                lacks = (
                    (f" (without effect, because no rule allows {', '.join(stated.lacks)})")
                    if stated.lacks
                    else ""
                )
                yield f"  may {VERBS[right]} {stated.name}{domain}{lacks}"
        yield from _key_lines("may also {} the keys {}", rights.unsaid)
        yield from _key_lines("may {} the keys {} only by a message with a wildcard", rights.denied)


def _key_lines(clause: str, pairs: Sequence[tuple[str, str]]) -> Iterator[str]:
    from sros_tool.checks.zenoh import VERBS

    for right, word in VERBS.items():
        keys = [key for of, key in pairs if of == right]
        if keys:
            yield f"  {clause.format(word, first_few(keys, _MOST_KEYS))}"


def _kind(document: ConfigurationDocument) -> str:
    mode = document.mode.value
    return mode if mode == "router" else f"session (mode {mode})"


def _subject_text(rights: RightsOfSubject) -> str:
    if rights.self_limiting:
        return f"the process itself ({rights.subject})"
    if rights.names is None:
        return f"everybody who gets a connection{f' ({rights.subject})' if rights.subject else ''}"
    return first_few(rights.names, _MOST_KEYS)


def _why_no_policy(subjects: Sequence[RightsOfSubject]) -> str:
    """Return a sentence on the subjects that have rights but are not enclaves."""
    strangers = [_subject_text(rights) for rights in subjects if rights.rights]
    if not strangers:
        return "The rules let nobody publish, subscribe, call or serve any ROS name."
    return (
        f"The rules allow something to {first_few(strangers, _MOST_KEYS)}, but to no enclave: "
        "cert_common_names has no name of an enclave, such as /talker."
    )


def _notes_on_lost_rules(subjects: Sequence[RightsOfSubject]) -> Iterator[Note]:
    """Yield notes about what the rules allow or deny but the policy does not state."""
    from sros_tool.translate_zenoh.rights import enclaves_of_subject

    for rights in subjects:
        if (rights.rights or rights.unsaid) and not enclaves_of_subject(rights):
            yield Note(
                "zenoh.no-enclave",
                f"the policy leaves out {_subject_text(rights)}, because a policy gives rights "
                "only to enclaves",
            )
        elif rights.unsaid:
            keys = ", ".join(key for _, key in rights.unsaid[:_MOST_KEYS])
            yield Note(
                "zenoh.unsaid",
                f"{_subject_text(rights)}: the policy lacks {counted(len(rights.unsaid), 'right')} "
                f"to keys that no ROS name expresses exactly: {keys}",
            )
    domains = sorted(
        {right.domain for rights in subjects for right in rights.rights} - {"0", "*"}, key=int
    )
    if domains:
        yield Note(
            "zenoh.domains",
            "a policy names no domains: a keystore that is made from this policy gives the rights "
            f"of domain {' and '.join(domains)} in every domain. If the rights differ by domain, "
            "write one policy for each domain.",
        )
    yield Note(
        "zenoh.node-names",
        "Zenoh rules do not name nodes: in the policy, the name of each node is the last part of "
        "its enclave's name, and all names of topics and services are absolute. Write the real "
        "namespaces and names of the nodes into the policy: on Zenoh, others do not see a node "
        "that "
        "the policy does not name.",
    )
