"""The verb `inspect`: show the contents of a keystore, an enclave or a single file."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from datetime import datetime
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any

import click

from sros_tool.cli.common import (
    PATH,
    complete_keystore_and_enclave,
    json_option,
    now,
    print_json,
    print_notes,
    verb,
)
from sros_tool.terminal import echo
from sros_tool.validity import iso
from sros_tool.wording import counted, serial_text

if TYPE_CHECKING:
    from sros_tool.keystore.describe import (
        AuthorityFile,
        CertificateFacts,
        DescribedCertificates,
        DescribedConfiguration,
        DescribedEnclave,
        DescribedGovernance,
        DescribedKey,
        DescribedKeyOnToken,
        DescribedKeystore,
        DescribedList,
        DescribedPermissions,
        EnclaveFacts,
        GrantFacts,
        RemoteFacts,
        RevocationListFacts,
        RightNames,
        SignatureFacts,
        TokenPlace,
        UnreadableFile,
    )
    from sros_tool.keystore.reader import OpenedKeystore

_INDENT = "  "


@verb("inspect")
@click.argument("path", type=PATH)
@click.argument("enclave", required=False, shell_complete=complete_keystore_and_enclave)
@click.option(
    "--ca",
    "authority",
    type=PATH,
    help="Verify the signed document PATH with this permissions CA certificate.",
)
@click.option(
    "--history",
    is_flag=True,
    help="List all certificates and documents that the keystore PATH ever issued, with "
    "their current state.",
)
@click.option(
    "--policy",
    type=PATH,
    help="With --history: list only permissions that were signed from the present content of this "
    "policy file and of the files that it includes.",
)
@json_option
def inspect(
    path: Path,
    enclave: str | None,
    authority: Path | None,
    history: bool,
    policy: Path | None,
    as_json: bool,
) -> int:
    """Show the contents of PATH, or of an ENCLAVE of the keystore PATH.

    PATH is a keystore, an enclave's folder, a file of certificates, a revocation list, a private
    key, a Zenoh configuration or a signed document (.p7s). The exit status is 1 if an enclave
    cannot run, or a signature does not verify or is missing (in a .p7s file, or with --ca). It is 1
    if a Zenoh configuration does not fit its signature or its enclave. It is also 1 if the
    keystore's ledger lacks a CA, a certificate or a signed document, or if lines of the ledger are
    missing or were changed. With --policy, it is 1 if nothing was signed from that file.

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
      ...
      $ sros inspect keystore --history --policy robot.xml
      2026-11-20T05:59:44Z  permissions  current     /talker  until 2027-05-20...
      permissions of 1 enclave were signed from the current 'robot.xml'; ...
    """
    from sros_tool.errors import DocumentError, UsageError
    from sros_tool.keystore.describe import describe, problems_of
    from sros_tool.keystore.reader import OpenedKeystore

    if not path.exists():
        raise DocumentError(f"'{path}' does not exist")
    keystore = OpenedKeystore(path)
    if enclave is not None:
        if history:
            raise UsageError("--history is for a whole keystore", "", f"Leave {enclave} out.")
        path = _folder_of_enclave(keystore, enclave)
    if history:
        return _show_history(keystore, policy, as_json)
    if policy:
        raise UsageError("--policy is for --history", "", "Add --history.")
    opened = keystore if path == keystore.root else None
    described = describe(path, now=now(), authority=authority, keystore=opened)
    signature = getattr(described, "signature", None)
    if authority and signature is None:
        raise UsageError(
            f"--ca applies only to signed documents, not to '{path}' ({described.kind})",
            "",
            "Leave --ca out, or name a governance.p7s, permissions.p7s or session.p7s.",
        )
    if as_json:
        print_json(described)
    else:
        for line in _LINES_BY_KIND[described.kind](described):
            echo(line)
    print_notes([*keystore.ledger_file.clock_notes(now())] if keystore.root.is_dir() else [])
    if problems_of(described):
        return 1
    if signature and not signature.signed:  # documents in clear, such as governance.xml, exist
        return 1 if authority or path.suffix == ".p7s" else 0
    return 1 if signature and signature.signature_verified is False else 0


def _folder_of_enclave(keystore: OpenedKeystore, name: str) -> Path:
    """Return the folder of an enclave of a keystore."""
    from sros_tool.keystore.selection import missing_enclave_error

    keystore.check()
    names = keystore.names
    if name not in names:
        raise missing_enclave_error(keystore, name, names)
    return keystore.folder(name)


def _show_history(keystore: OpenedKeystore, policy: Path | None, as_json: bool) -> int:
    from sros_tool.keystore.describe import history
    from sros_tool.keystore.ledger import RESTORED

    changes = history(keystore, now=now())
    if policy:
        from sros_tool.policy.document import read_policy

        digests = {enclave.digest for enclave in read_policy(policy, placeholders=True).enclaves}
        signed = tuple(item for item in changes.entries if item.entry.policy in digests)
        changes = changes._replace(entries=signed)
    if as_json:
        print_json(changes)
    else:
        for item in changes.entries:
            entry = item.entry
            expires = entry.not_after and entry.what != "revocation"
            until = f"until {entry.not_after}" if expires else ""
            named = f" (SHA-256 {entry.sha256[:8]})" if entry.what == "ca" else ""
            subject = f"{entry.enclave or entry.subject}{named}"
            serial = serial_text(int(entry.serial, 16)) if entry.serial else ""
            source = f"policy {entry.policy[:12]}" if entry.policy else ""
            from_backup = "from a backup; entries may be missing" * (entry.what == RESTORED)
            words = (subject, until, serial, source, from_backup or entry.reason)
            line = "  ".join(word for word in words if word)
            shown = f"{entry.time}  {entry.what:11}  {item.status:10}  {line}"
            echo(shown.rstrip())
        for name in changes.unexplained:
            echo(f"NOT IN THE LEDGER  {name}")
        for gap in changes.gaps:
            echo(f"LEDGER DAMAGED  {gap}")
        if policy:
            number = counted(len({item.entry.enclave for item in changes.entries}), "enclave")
            echo(
                f"permissions of {number} were signed from the current '{policy}'; permissions "
                "from "
                "an earlier version can have the same rights: `sros diff_policy "
                f"{quote(str(policy))} "
                f"{quote(str(keystore.root))}` compares the rights",
                err=True,
            )
    no_entry = policy is not None and not changes.entries
    return 1 if changes.unexplained or changes.gaps or no_entry else 0


def _keystore_lines(keystore: DescribedKeystore) -> Iterator[str]:
    from sros_tool.keystore.describe import UnreadableFile

    template = keystore.template
    yield f"keystore {keystore.path}, " + (
        f"template {template}"
        if template
        else "no template: exports, and keystores made by other programs, have none"
    )
    for role, authority in keystore.authorities.items():
        yield from _authority_lines(role, authority)
    yield from (f"  UNKNOWN {authority}" for authority in keystore.unknown_authorities)
    if isinstance(keystore.governance, UnreadableFile):
        yield f"  governance: {keystore.governance.error}"
    elif keystore.governance:
        yield from _indented_lines(_domain_rule_lines(keystore.governance))
    if network := keystore.zenoh:
        yield (
            f"  Zenoh in {network.mode} mode: router {network.router} at "
            f"{', '.join(network.endpoints)}"
        )
        for router in network.routers:
            yield (
                f"    router {router.router} at {', '.join(router.endpoints)} for "
                f"{', '.join(router.enclaves)}"
            )
        if network.crossing:
            yield f"    between routers: {', '.join(network.crossing)}"
    if keystore.ledger:
        yield f"  LEDGER DAMAGED: {'; '.join(keystore.ledger)}"
    yield f"  {counted(len(keystore.enclaves), 'enclave')}"
    for enclave in keystore.enclaves:
        facts = enclave.facts
        state = _state_text(facts, key_on_robot=enclave.key_on_robot)
        if facts.token:
            state += f", key on the token {facts.token.token}"
        yield f"    {enclave.name}  {state}, expires {_moment_text(facts.expires)}"
        for problem in facts.problems:
            yield f"      {problem}"
    for problem in keystore.unreadable:
        yield f"    {problem}"


def _authority_lines(role: str, authority: AuthorityFile | UnreadableFile) -> Iterator[str]:
    from sros_tool.keystore.describe import UnreadableFile

    if isinstance(authority, UnreadableFile):
        yield f"  {role} CA: {authority.error}"
        return
    first = authority.file.first
    key = "key here" if authority.key_present else "key elsewhere"
    yield (
        f"  {role} CA {_authority_name(first.subject, first.sha256)}, {first.key}, {key}, "
        f"valid until {iso(first.not_after)}"
    )
    for further in authority.file.further or ():
        yield (
            f"    in the same file: {_authority_name(further.subject, further.sha256)}, "
            f"{further.key}, valid until {iso(further.not_after)}, "
            f"serial {serial_text(int(further.serial, 16))}"
        )
    if crl := authority.file.crl:
        yield f"    {_list_text(crl)}"


def _authority_name(subject: str | None, sha256: str | None) -> str:
    """Return the subject of a CA with the first digits of its SHA-256, as `authority_text` does."""
    return f"{subject} (SHA-256 {sha256[:8]})" if sha256 else str(subject)


def _moment_text(moment: datetime | None) -> str:
    return iso(moment) if moment else "at an unknown time"


def _state_text(facts: EnclaveFacts, *, key_on_robot: bool) -> str:
    if key_on_robot and not facts.problems:
        return "key on its robot"
    return "loadable" if facts.loadable else "NOT LOADABLE"


def _enclave_lines(enclave: DescribedEnclave) -> Iterator[str]:
    facts = enclave.facts
    yield f"enclave {enclave.path}: {_state_text(facts, key_on_robot=enclave.key_on_robot)}"
    for problem in facts.problems:
        yield f"  {problem}"
    yield f"  expires {_moment_text(facts.expires)} (the first of its files)"
    yield f"  subject {facts.subject}, certificate expires {_moment_text(facts.valid_until)}"
    identity = _authority_name(facts.identity_ca, facts.identity_ca_sha256)
    permissions = _authority_name(facts.permissions_ca, facts.permissions_ca_sha256)
    yield f"  identity CA {identity}, permissions CA {permissions}"
    yield f"  domains {facts.domains}"
    if facts.token:
        yield f"  {_token_place_text(facts.token)}"
    for grant in facts.permissions or ():
        yield from _indented_lines(_grant_lines(grant))
    if zenoh := enclave.zenoh:
        yield f"  Zenoh: {', '.join(file.file for file in zenoh.files) or 'NOT USABLE'}"
        for problem in zenoh.problems:
            yield f"    {problem}"


def _certificate_file_lines(certificates: DescribedCertificates) -> Iterator[str]:
    file = certificates.file
    yield f"{'CA certificate' if file.first.is_ca else 'certificate'} {certificates.path}"
    yield from _indented_lines(_certificate_lines(file.first))
    for further in file.further or ():
        yield "another certificate in the same file"
        yield from _indented_lines(_certificate_lines(further))
    if file.crl:
        yield _list_text(file.crl)


def _certificate_lines(certificate: CertificateFacts) -> Iterator[str]:
    yield f"subject {certificate.subject}"
    yield f"issuer {certificate.issuer}"
    yield f"serial {serial_text(int(certificate.serial, 16))}"
    yield f"{certificate.key}, signed with {certificate.signature}"
    valid = "valid now" if certificate.valid_now else "NOT VALID NOW"
    yield f"from {iso(certificate.not_before)} to {iso(certificate.not_after)}: {valid}"
    yield f"SHA-256 {certificate.sha256}"


def _revocation_list_lines(described_list: DescribedList) -> Iterator[str]:
    yield _list_text(described_list.facts)
    for serial in described_list.facts.revoked:
        yield f"  {serial_text(int(serial, 16))}"


def _list_text(crl: RevocationListFacts) -> str:
    valid = "" if crl.valid_now else ": NOT VALID NOW"
    return (
        f"revocation list {crl.number} of {crl.issuer}, until {iso(crl.not_after)}{valid}, "
        f"{len(crl.revoked)} revoked"
    )


def _key_lines(key: DescribedKey) -> Iterator[str]:
    yield f"private key {key.path}: {key.algorithm}, mode {key.mode}"
    if key.mode not in ("0600", "0400"):
        yield "  its mode should be 0600: run `chmod 600` on the file"


def _token_place_text(place: TokenPlace) -> str:
    pin = f", PIN in {place.pin_source}" if place.pin_source else ""
    return f"key {place.object} on the token {place.token}{pin}"


def _token_lines(described_token: DescribedKeyOnToken) -> Iterator[str]:
    yield f"{described_token.path}: {_token_place_text(described_token.place)}"


def _permissions_lines(permissions: DescribedPermissions) -> Iterator[str]:
    yield f"permissions {permissions.path}"
    yield from _indented_lines(_signature_lines(permissions.signature))
    for grant in permissions.grants:
        yield from _indented_lines(_grant_lines(grant))


def _governance_lines(governance: DescribedGovernance) -> Iterator[str]:
    yield f"governance {governance.path}"
    yield from _indented_lines(_signature_lines(governance.signature))
    yield from _indented_lines(_domain_rule_lines(governance))


def _configuration_lines(described_configuration: DescribedConfiguration) -> Iterator[str]:
    yield f"Zenoh configuration {described_configuration.path}"
    yield from _indented_lines(_signature_lines(described_configuration.signature))
    for problem in described_configuration.problems:
        yield f"  {problem}"
    if not described_configuration.made_by_sros:
        yield "  differs from what sros writes: run `sros check` on the file"
    places = [
        f"{word} {', '.join(endpoints)}"
        for word, endpoints in (
            ("listens at", described_configuration.listen),
            ("connects to", described_configuration.connect),
        )
        if endpoints
    ]
    yield f"  {described_configuration.mode}, {', '.join(places) or 'without an endpoint'}"
    access = described_configuration.access_control
    state = "" if access.enabled else "OFF: "
    yield (
        f"  access control: {state}{counted(access.rules, 'rule')} for "
        f"{counted(access.subjects, 'subject')}, everything else: {access.default.upper()}"
    )
    if described_configuration.domains:
        yield f"  domain {', '.join(map(str, described_configuration.domains))}"
    for remote in described_configuration.rights:
        yield from _indented_lines(_remote_lines(remote))


def _remote_lines(remote: RemoteFacts) -> Iterator[str]:
    if remote.own_rights_by_router:
        yield f"through the router {remote.enclave} this enclave may"
        yield from _indented_lines(_right_lines(remote.may))
        return
    counts = [
        f"{right} {counted(len(names), kind.removesuffix('s'))}"
        for kind, rights in sorted(remote.may.items())
        for right, names in rights.items()
    ]
    yield f"processes of {remote.enclave} may {', '.join(counts) or 'only see the ROS graph'}"


def _right_lines(table: RightNames) -> Iterator[str]:
    for kind, rights in sorted(table.items()):
        for right, names in rights.items():
            yield f"{right} {kind}: {', '.join(names)}"


def _signature_lines(signature: SignatureFacts) -> Iterator[str]:
    signer = signature.signer
    if signer is None:
        yield "not signed"
        return
    verified = {
        True: "signature verified",
        False: "SIGNATURE DOES NOT VERIFY",
        None: "not verified",
    }
    yield (
        f"signed by {_authority_name(signer.signer, signer.signer_sha256)}, {signer.digest}, "
        f"{signer.bytes} bytes: {verified[signature.signature_verified]}"
    )
    if signer.signature_problem:
        yield f"  {signer.signature_problem}"


def _grant_lines(grant: GrantFacts) -> Iterator[str]:
    yield f"grant {grant.name} for {grant.subject}"
    expired = ": NOT VALID NOW" if grant.valid_now is False else ""
    yield f"  valid from {grant.not_before} to {grant.not_after}{expired}"
    for rule in grant.rules:
        where = f" in partitions {', '.join(rule.partitions)}" if rule.partitions else ""
        yield f"  {rule.qualifier} in domain {rule.domains}{where}"
        yield from _indented_lines(_indented_lines(_right_lines(rule.rights)))
    yield f"  everything else: {grant.default}"


def _domain_rule_lines(governance: DescribedGovernance) -> Iterator[str]:
    for described in governance.domain_rules:
        rule = described.rule
        yield f"governance of domain {described.domains}"
        yield (
            f"  rtps {rule.rtps_protection_kind}, discovery {rule.discovery_protection_kind}, "
            f"liveliness {rule.liveliness_protection_kind}"
        )
        joins = "checked" if rule.enable_join_access_control else "NOT CHECKED"
        strangers = "ALLOWED" if rule.allow_unauthenticated_participants else "refused"
        yield f"  permission to join {joins}, unauthenticated participants {strangers}"
        for topic in described.topic_rules:
            open_to_all = {
                "read": not topic.enable_read_access_control,
                "write": not topic.enable_write_access_control,
            }
            words = [word for word, unchecked in open_to_all.items() if unchecked]
            unchecked = f", {' and '.join(words)} NOT CHECKED" if words else ""
            yield (
                f"  topics {topic.topic_expression}: data {topic.data_protection_kind}, "
                f"metadata {topic.metadata_protection_kind}{unchecked}"
            )


def _indented_lines(lines: Iterable[str]) -> Iterator[str]:
    return (_INDENT + line for line in lines)


_LINES_BY_KIND: dict[str, Callable[[Any], Iterator[str]]] = {
    "keystore": _keystore_lines,
    "enclave": _enclave_lines,
    "certificate": _certificate_file_lines,
    "private key": _key_lines,
    "key on a token": _token_lines,
    "revocation list": _revocation_list_lines,
    "permissions": _permissions_lines,
    "governance": _governance_lines,
    "Zenoh configuration": _configuration_lines,
}
