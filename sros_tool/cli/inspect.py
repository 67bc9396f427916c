"""The verb `inspect`: show the contents of a keystore, an enclave or a single file."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

from sros_tool.cli.common import PATH, json_option, now, print_json
from sros_tool.terminal import echo
from sros_tool.values import as_plain

_INDENT = "  "


@click.command(
    "inspect",
    epilog="""\b
Example:
  $ sros inspect keystore/enclaves/talker/permissions.p7s
  permissions keystore/enclaves/talker/permissions.p7s
    signed by CN=sros permissions CA 5f0c3a1e (SHA-256 8e1d22c4), ...
    grant /talker for CN=/talker
      valid from 2026-11-20T05:59:44Z to 2027-05-20T05:59:44Z
      ALLOW in domain 0
        publish topics: /chatter, /parameter_events, /rosout
        ...
  $ sros inspect keystore --history
  2026-11-20T05:59:44Z  certificate  current     /talker  until 2027-11-20...
  ...""",
)
@click.argument("path", type=PATH)
@click.option(
    "--ca",
    "authority",
    type=PATH,
    help="Permissions CA certificate that verifies a signed document.",
)
@click.option(
    "--history",
    is_flag=True,
    help="Show everything that the keystore PATH ever issued, with its current state.",
)
@json_option
def inspect(path: Path, authority: Path | None, history: bool, as_json: bool) -> int:
    """Show the contents of PATH.

    PATH is a keystore, an enclave's folder, a file of certificates, a revocation list, a private
    key, a Zenoh configuration or a signed document (.p7s). The exit status is 1 if an enclave
    cannot run, a signature does not verify or is missing (in a .p7s file, or with --ca), a Zenoh
    configuration does not fit its signature or its enclave, a certificate or signed document is
    missing from the keystore's ledger, or lines of the ledger are missing or were changed.
    """
    from sros_tool.errors import DocumentError, UsageError
    from sros_tool.keystore.describe import describe

    if not path.exists():
        raise DocumentError(f"'{path}' does not exist")
    if history:
        return _show_history(path, as_json)
    described = describe(path, now=now(), authority=authority)
    if authority and "signed" not in described:
        raise UsageError(
            f"--ca verifies a signed document, and '{path}' is of the kind {described['kind']}",
            "",
            "Leave --ca out, or name a governance.p7s, permissions.p7s or session.p7s.",
        )
    if as_json:
        print_json(described)
    else:
        for line in _TEXT[described["kind"]](described):
            echo(line)
    zenoh = described.get("zenoh") or described
    if zenoh.get("problems"):
        return 1
    if described.get("signed") is False:  # documents in clear, such as governance.xml, exist
        return 1 if authority or path.suffix == ".p7s" else 0
    return 1 if described.get("problems") or described.get("signature_verified") is False else 0


def _show_history(root: Path, as_json: bool) -> int:
    from sros_tool.keystore.describe import history

    found = history(root, now=now())
    if as_json:
        print_json(
            {
                "kind": "history",
                "path": str(root),
                "entries": [
                    {**as_plain(item.entry), "status": item.status, "path": item.path}
                    for item in found.items
                ],
                "unexplained": list(found.unexplained),
                "gaps": list(found.gaps),
            }
        )
    else:
        for item in found.items:
            entry = item.entry
            until = f"until {entry.not_after}" if entry.not_after else ""
            named = f" (SHA-256 {entry.sha256[:8]})" if entry.what == "ca" else ""
            subject = f"{entry.enclave or entry.subject}{named}"
            words = (subject, until, entry.serial, entry.reason)
            line = "  ".join(word for word in words if word)
            shown = f"{entry.time}  {entry.what:11}  {item.status:10}  {line}"
            echo(shown.rstrip())
        for name in found.unexplained:
            echo(f"NOT IN THE LEDGER  {name}")
        for gap in found.gaps:
            echo(f"LEDGER DAMAGED  {gap}")
    return 1 if found.unexplained or found.gaps else 0


def _keystore(d: dict[str, Any]) -> Iterator[str]:
    template = d["template"]
    yield f"keystore {d['path']}, " + (
        f"template {template}" if template else "no template: not made by sros, or an export"
    )
    for role, authority in d["authorities"].items():
        if "error" in authority:
            yield f"  {role} CA: {authority['error']}"
            continue
        key = "key here" if authority["key_present"] else "key elsewhere"
        yield (
            f"  {role} CA {_named(authority)}, {authority['key']}, {key}, "
            f"valid until {authority['not_after']}"
        )
        for other in authority.get("further", ()):
            yield (
                f"    next to it {_named(other)}, {other['key']}, "
                f"valid until {other['not_after']}, serial {other['serial']}"
            )
        if "crl" in authority:
            yield from _indented(_indented(_list(authority["crl"])))
    if d["governance"]:
        if "error" in d["governance"]:
            yield f"  governance: {d['governance']['error']}"
        else:
            yield from _indented(_governance(d["governance"]))
    if network := d["zenoh"]:
        yield (
            f"  Zenoh in {network['mode']} mode: router {network['router']} at "
            f"{', '.join(network['endpoints'])}"
        )
    if d["ledger"]:
        yield f"  LEDGER DAMAGED: {'; '.join(d['ledger'])}"
    yield f"  {len(d['enclaves'])} enclave{'' if len(d['enclaves']) == 1 else 's'}"
    for enclave in d["enclaves"]:
        until = enclave["expires"]
        state = "loadable" if enclave["loadable"] else "NOT LOADABLE"
        if enclave["key_on_robot"] and not enclave["problems"]:
            state = "key on its robot"
        elif enclave["token"]:
            state += f", key on the token {enclave['token']['token']}"
        yield f"    {enclave['name']}  {state}, expires {until or 'at an unknown time'}"
        for problem in enclave["problems"]:
            yield f"      {problem}"
    for problem in d["unreadable"]:
        yield f"    {problem}"


def _named(d: dict[str, Any], key: str = "") -> str:
    """Return the subject of a CA with the first digits of its SHA-256, as `authority_text` does."""
    subject, sha256 = d[key or "subject"], d[f"{key}_sha256" if key else "sha256"]
    return f"{subject} (SHA-256 {sha256[:8]})" if sha256 else str(subject)


def _enclave(d: dict[str, Any]) -> Iterator[str]:
    yield f"enclave {d['path']}: {'loadable' if d['loadable'] else 'NOT LOADABLE'}"
    for problem in d["problems"]:
        yield f"  {problem}"
    yield f"  subject {d['subject']}, expires {d['expires'] or 'at an unknown time'}"
    identity, permissions = _named(d, "identity_ca"), _named(d, "permissions_ca")
    yield f"  identity CA {identity}, permissions CA {permissions}"
    yield f"  domains {d['domains']}"
    if token := d["token"]:
        yield f"  {_place(token)}"
    for grant in d["permissions"] or ():
        yield from _indented(_grant(grant))
    if zenoh := d["zenoh"]:
        yield f"  Zenoh: {', '.join(each['file'] for each in zenoh['files']) or 'NOT USABLE'}"
        for problem in zenoh["problems"]:
            yield f"    {problem}"


def _certificate(d: dict[str, Any]) -> Iterator[str]:
    kind = "CA certificate" if d["is_ca"] else "certificate"
    yield f"{kind} {d['path']}"
    yield from _indented(_facts(d))
    for other in d.get("further", ()):
        yield "next to it, in the same file"
        yield from _indented(_facts(other))
    if "crl" in d:
        yield from _list(d["crl"])


def _facts(d: dict[str, Any]) -> Iterator[str]:
    yield f"subject {d['subject']}"
    yield f"issuer {d['issuer']}"
    yield f"serial {d['serial']}"
    yield f"{d['key']}, signed with {d['signature']}"
    valid = "valid now" if d["valid_now"] else "NOT VALID NOW"
    yield f"from {d['not_before']} to {d['not_after']}: {valid}"
    yield f"SHA-256 {d['sha256']}"


def _revocation_list(d: dict[str, Any]) -> Iterator[str]:
    yield from _list(d)
    for serial in d["revoked"]:
        yield f"  {serial}"


def _list(d: dict[str, Any]) -> Iterator[str]:
    valid = "" if d["valid_now"] else ": NOT VALID NOW"
    yield (
        f"revocation list {d['number']} of {d['issuer']}, until {d['not_after']}{valid}, "
        f"{len(d['revoked'])} revoked"
    )


def _key(d: dict[str, Any]) -> Iterator[str]:
    yield f"private key {d['path']}: {d['algorithm']}, mode {d['mode']}"
    if d["mode"] not in ("0600", "0400"):
        yield "  others can read it: chmod 600"


def _place(d: dict[str, Any]) -> str:
    pin = f", PIN in {d['pin_source']}" if d["pin_source"] else ""
    return f"key {d['object']} on the token {d['token']}{pin}"


def _key_on_token(d: dict[str, Any]) -> Iterator[str]:
    yield f"{d['path']}: {_place(d)}"


def _permissions(d: dict[str, Any]) -> Iterator[str]:
    yield f"permissions {d['path']}"
    yield from _indented(_signature(d))
    for grant in d["grants"]:
        yield from _indented(_grant(grant))


def _governance_file(d: dict[str, Any]) -> Iterator[str]:
    yield f"governance {d['path']}"
    yield from _indented(_signature(d))
    yield from _indented(_governance(d))


def _zenoh_configuration(d: dict[str, Any]) -> Iterator[str]:
    yield f"Zenoh configuration {d['path']}"
    yield from _indented(_signature(d))
    for problem in d["problems"]:
        yield f"  {problem}"
    if not d["made_by_sros"]:
        yield "  not as sros writes it: see `sros check` of the file"
    places = [
        f"{word} {', '.join(d[key])}"
        for word, key in (("listens at", "listen"), ("connects to", "connect"))
        if d[key]
    ]
    yield f"  {d['mode']}, {', '.join(places) or 'without an endpoint'}"
    access = d["access_control"]
    state = "" if access["enabled"] else "OFF: "
    yield (
        f"  access control: {state}{_counted(access['rules'], 'rule')} for "
        f"{_counted(access['subjects'], 'subject')}, everything else: {access['default'].upper()}"
    )
    if d["domains"]:
        yield f"  domain {', '.join(map(str, d['domains']))}"
    for each in d["rights"]:
        yield from _indented(_remote(each))


def _counted(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def _remote(d: dict[str, Any]) -> Iterator[str]:
    if d["own_rights_by_router"]:
        yield f"through the router {d['enclave']} this enclave may"
        for kind, rights in sorted(d["may"].items()):
            for right, names in rights.items():
                yield f"  {right} {kind}: {', '.join(names)}"
        return
    counts = [
        f"{right} {_counted(len(names), kind.removesuffix('s'))}"
        for kind, rights in sorted(d["may"].items())
        for right, names in rights.items()
    ]
    yield f"processes of {d['enclave']} may {', '.join(counts) or 'only see the graph'}"


def _signature(d: dict[str, Any]) -> Iterator[str]:
    if not d["signed"]:
        yield "not signed"
        return
    verified = {True: "signature verified", False: "SIGNATURE NOT VERIFIED", None: "not verified"}
    yield (
        f"signed by {_named(d, 'signer')}, {d['digest']}, {d['bytes']} bytes: "
        f"{verified[d['signature_verified']]}"
    )
    if d["signature_problem"]:
        yield f"  {d['signature_problem']}"


def _grant(grant: dict[str, Any]) -> Iterator[str]:
    yield f"grant {grant['name']} for {grant['subject']}"
    expired = "" if grant.get("valid_now", True) else ": NOT VALID NOW"
    yield f"  valid from {grant['not_before']} to {grant['not_after']}{expired}"
    for rule in grant["rules"]:
        where = f" in partitions {', '.join(rule['partitions'])}" if rule["partitions"] else ""
        yield f"  {rule['qualifier']} in domain {rule['domains']}{where}"
        for kind, rights in sorted(rule["rights"].items()):
            for right, names in rights.items():
                yield f"    {right} {kind}: {', '.join(names)}"
    yield f"  everything else: {grant['default']}"


def _governance(d: dict[str, Any]) -> Iterator[str]:
    for rule in d["domain_rules"]:
        yield f"governance of domain {rule['domains']}"
        yield (
            f"  rtps {rule['rtps_protection_kind']}, discovery "
            f"{rule['discovery_protection_kind']}, liveliness "
            f"{rule['liveliness_protection_kind']}"
        )
        joins = "checked" if rule["enable_join_access_control"] else "NOT CHECKED"
        strangers = "ALLOWED" if rule["allow_unauthenticated_participants"] else "refused"
        yield f"  permission to join {joins}, unauthenticated participants {strangers}"
        for topic in rule["topic_rules"]:
            checks = [
                word for word in ("read", "write") if not topic[f"enable_{word}_access_control"]
            ]
            unchecked = f", {' and '.join(checks)} NOT CHECKED" if checks else ""
            yield (
                f"  topics {topic['topic_expression']}: data {topic['data_protection_kind']}, "
                f"metadata {topic['metadata_protection_kind']}{unchecked}"
            )


def _indented(lines: Iterator[str]) -> Iterator[str]:
    return (_INDENT + line for line in lines)


_TEXT = {
    "keystore": _keystore,
    "enclave": _enclave,
    "certificate": _certificate,
    "private key": _key,
    "key on a token": _key_on_token,
    "revocation list": _revocation_list,
    "permissions": _permissions,
    "governance": _governance_file,
    "Zenoh configuration": _zenoh_configuration,
}
