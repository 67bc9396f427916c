"""The verbs that create and change keystores, enclaves and permissions, and list enclaves."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING

import click

from sros_tool.cli.changed import (
    MAX_NAMES,
    enclave_lines,
    json_form,
    print_changed,
    rights_lines,
    shown_names,
)
from sros_tool.cli.common import (
    PATH,
    SeveralValues,
    allow_refusal_option,
    change_options,
    chosen_enclaves,
    complete_template,
    dry_run_option,
    enclave_filter_options,
    fleet_option,
    fleet_policies,
    json_option,
    key_option,
    keyring,
    keystore_argument,
    keystore_arguments,
    keystore_from_environment,
    now,
    print_findings_after_signing,
    print_json,
    progress,
    robot_option,
    ros_domain,
    several_enclaves_options,
    split_root,
    verb,
)
from sros_tool.errors import Note, UsageError
from sros_tool.terminal import echo
from sros_tool.wording import counted, first_few

if TYPE_CHECKING:
    from sros_tool.checks.kind import Finding
    from sros_tool.dds.decision.vendors import Vendor
    from sros_tool.keystore.lifecycle.create import Creation
    from sros_tool.keystore.lifecycle.update import KeystoreUpdate


@verb("create_enclave")
@keystore_arguments("[KEYSTORE] ENCLAVE...")
@key_option
@dry_run_option
@json_option
def create_enclave(arguments: tuple[str, ...], key: str, dry_run: bool, as_json: bool) -> None:
    """Create ENCLAVE... in KEYSTORE.

    An existing enclave keeps its key and its permissions; missing files are added. With --key, the
    key is on a PKCS#11 token and cannot be copied; without object= in URI, the label of the key is
    ENCLAVE.

    Example:
      $ sros create_enclave keystore /talker /listener
      created enclave /talker
      created enclave /listener
      $ sros create_enclave keystore /arm --key 'pkcs11:token=robot;object=arm'
      created enclave /arm
    """
    from sros_tool.keystore.lifecycle.create import create_enclaves

    root, names = split_root(arguments)
    if not names:
        raise UsageError("no enclave is named", "", "Name one or more, such as /talker.")
    with progress("signing", len(names)) as step:
        result = create_enclaves(
            root,
            names,
            domain=ros_domain(),
            key=key,
            progress=step,
            **change_options(dry_run=dry_run),
        )
    _show(result, as_json)


_revoke_old_option = click.option(
    "--revoke-old",
    is_flag=True,
    help="Revoke the replaced permissions: reissue the certificates, and revoke all earlier ones.",
)


@verb("create_permission")
@keystore_arguments("[KEYSTORE] [ENCLAVE...] POLICY_FILE")
@several_enclaves_options
@fleet_option("The robots that the placeholders of the policy stand for.")
@_revoke_old_option
@allow_refusal_option
@dry_run_option
@json_option
def create_permission(
    arguments: tuple[str, ...],
    patterns: tuple[str, ...],
    robots: tuple[str, ...],
    fleet_file: Path | None,
    revoke_old: bool,
    allow_refusal: tuple[Vendor, ...],
    dry_run: bool,
    as_json: bool,
) -> None:
    """Give ENCLAVE... the permissions that POLICY_FILE states for them.

    If this fails for an enclave, no enclave changes. A named ENCLAVE always gets new permissions;
    an enclave chosen by --robot, --match or --all gets them only if its rights change.

    Anyone who has copies of the replaced permissions, of the certificate and of the key can use
    these copies until the permissions or the certificate expires. With --revoke-old, processes that
    load the new crl.pem refuse these copies.

    Example:
      $ sros create_permission keystore /talker_listener/talker policy.xml
      replaced the permissions of enclave /talker_listener/talker
      $ sros create_permission keystore --match '/arm/*' policy.xml
      $ sros create_permission keystore --robot r7 robot.xml --fleet fleet.toml
    """
    from sros_tool.keystore.lifecycle.create import create_permission as create
    from sros_tool.keystore.reader import OpenedKeystore
    from sros_tool.policy.document import read_policy

    root, rest = split_root(arguments)
    if len(rest) < (1 if patterns or robots else 2):
        raise UsageError(
            "create_permission takes a keystore, one or more enclaves and a policy",
            "",
            _ORDER_REMEDY,
        )
    *given, last = rest
    file = PATH.convert(last, None, None)
    _check_order(root, given, file)
    for_fleet = fleet_policies([file], fleet_file)[0] if fleet_file else None
    policy = for_fleet.policy() if for_fleet else read_policy(file)
    keystore = OpenedKeystore(root)
    chosen = chosen_enclaves(keystore, given, patterns, robots)
    result = create(
        root,
        chosen,
        for_fleet or policy,
        domain=ros_domain(),
        revoke_old=revoke_old,
        keep_same=not given,
        **change_options(dry_run=dry_run, allow_refusal=allow_refusal),
    )
    left_out = [
        name
        for name in for_fleet or ()
        if for_fleet and (robot := for_fleet.stated_enclave(name)[1])
        if robot.name in robots and name not in chosen
    ]
    if left_out:
        text = (
            "left out, because the keystore lacks these enclaves, or because they belong to no "
            "robot of its fleet: "
        )
        text += f"{shown_names(left_out)}. `sros generate_artifacts --robot` creates them, too."
        result = replace(result, notes=(*result.notes, Note("enclave.left-out", text)))
    _show(result, as_json, [policy])


_ORDER_REMEDY = (
    "Write the arguments in this order: `sros create_permission KEYSTORE ENCLAVE... POLICY_FILE`."
)


def _check_order(root: Path, names: Sequence[str], file: Path) -> None:
    """Raise `UsageError` if a keystore, enclave or policy is in the place of another word."""
    from sros_tool.keystore.layout import is_keystore

    paths = [
        word
        for word in names
        if is_keystore(Path(word)) or (not word.startswith("/") and os.path.lexists(word))
    ]
    if not (paths or is_keystore(file) or root.is_file()):
        return
    wrong, place = (paths[0], "an enclave") if paths else (str(file), "the policy file")
    if not root.is_dir():
        wrong, place = str(root), "the keystore"
    raise UsageError(f"'{wrong}' stands where {place} belongs", "", _ORDER_REMEDY)


class _SeveralEnclavesAndPolicies(SeveralValues):
    several = ("-e", "--enclaves", "-p", "--policy-files")


@verb("generate_artifacts", cls=_SeveralEnclavesAndPolicies)
@click.option("-k", "--keystore-root-path", type=PATH, help="The keystore; created if missing.")
@click.option("-e", "--enclaves", multiple=True, metavar="ENCLAVE...", help="Enclaves to create.")
@click.option(
    "-p",
    "--policy-files",
    multiple=True,
    type=PATH,
    metavar="FILE...",
    help="Policies whose enclaves are created, with the permissions that the policies state.",
)
@fleet_option(
    "The robots that the placeholders of the policies stand for: a TOML file, or an Ansible "
    "inventory."
)
@robot_option("Only the enclaves of this robot; the enclaves of other robots do not change.")
@click.option(
    "--template",
    "template_name",
    metavar="NAME|FILE",
    help="Template for a keystore that does not exist yet: a name, or a TOML file.  "
    "[default: development]",
    shell_complete=complete_template,
)
@_revoke_old_option
@allow_refusal_option
@dry_run_option
@json_option
def generate_artifacts(
    keystore_root_path: Path | None,
    enclaves: tuple[str, ...],
    policy_files: tuple[Path, ...],
    fleet_file: Path | None,
    robots: tuple[str, ...],
    template_name: str | None,
    revoke_old: bool,
    allow_refusal: tuple[Vendor, ...],
    dry_run: bool,
    as_json: bool,
) -> None:
    r"""Create enclaves, with the permissions that policies state for them: all or nothing.

    The permissions in a policy replace the current permissions of an enclave, unless the current
    permissions state the same and have more than a third of their validity left. To sign them again
    in any case, name the enclave in `sros create_permission` or `sros renew`. `sros
    create_permission --help` explains --revoke-old. If a policy demands more protection for a name
    than the keystore gives, the governance of all enclaves is signed again.

    Example:
      $ sros generate_artifacts -k keystore -e /spare \
            -p talker_listener.xml mobile_robot.xml
      created enclave /spare
      created enclave /talker_listener/talker
      ...
      $ sros generate_artifacts -k keystore -p robot.xml --fleet fleet.toml
      $ sros generate_artifacts -k keystore -p robot.xml --fleet fleet.toml \
            --robot r7
    """
    from sros_tool.fleet.expansion import FleetPolicy
    from sros_tool.keystore.layout import is_keystore
    from sros_tool.keystore.lifecycle.create import generate_artifacts as generate
    from sros_tool.keystore.lifecycle.create import refuse_other_template
    from sros_tool.keystore.template import DEFAULT_TEMPLATE, load_template
    from sros_tool.policy.document import read_policy

    root = keystore_root_path or keystore_from_environment()
    if not enclaves and not policy_files:
        raise UsageError(
            "neither an enclave nor a policy is named", "", "Give -e ENCLAVE... or -p FILE... ."
        )
    if fleet_file and not policy_files:
        raise UsageError(
            ("--fleet fills in placeholders of policies, but no policy is named"),
            "",
            "Give -p FILE... .",
        )
    if robots and not fleet_file:
        raise UsageError("--robot needs --fleet", "", "Add --fleet FILE.")
    if fleet_file:
        policies: list[Policy | FleetPolicy] = [*fleet_policies(policy_files, fleet_file, robots)]
    else:
        policies = [read_policy(path) for path in policy_files]
    template = load_template(template_name or DEFAULT_TEMPLATE)
    if template_name is not None and is_keystore(root):
        refuse_other_template(root, template)
    total = len(enclaves) + sum(
        len(policy if isinstance(policy, FleetPolicy) else policy.enclaves) for policy in policies
    )
    with progress("signing", total) as step:
        result = generate(
            root,
            enclaves=enclaves,
            policies=policies,
            domain=ros_domain(),
            create=template,
            revoke_old=revoke_old,
            progress=step,
            **change_options(dry_run=dry_run, allow_refusal=allow_refusal),
        )
    if result.new_keystore and not dry_run:
        echo(f"'{root}' is not a valid keystore, creating new keystore", err=True)
        if not as_json:
            for line in _new_keystore_lines(result):
                echo(line)
    _show(result, as_json, policies)
    if result.new_keystore:
        _print_open_rights(root, template)


def _show(
    result: Creation,
    as_json: bool,
    policies: Sequence[Policy | FleetPolicy] = (),
) -> None:
    from sros_tool.keystore.lifecycle.replaced import lasting_text, old_program_text

    root = result.root
    findings: list[tuple[Finding, ...]] = []
    if policies:
        from sros_tool.checks.policies.policy import signed_findings

        signed = {*result.created, *result.changed, *result.kept}
        findings = signed_findings(policies, signed, os.environ.get("ROS_DISTRO", ""))
    shown = None
    if as_json:
        from sros_tool.checks.policies.policy import as_note

        notes = [as_note(finding) for finding in findings]
        shown = json_form(result, "MadeEnclaves", notes=notes)
    print_changed(
        result,
        shown,
        _created_lines(result),
        first=_next_step_hints(result, as_json),
        after=filter(None, (old_program_text(result.rights), lasting_text(root, result.rights))),
    )
    if findings and not as_json:
        print_findings_after_signing(findings, [policy.file for policy in policies])


def _created_lines(result: Creation) -> Iterator[str]:
    """Yield what was done with each enclave."""
    unchanged = {
        rights.enclave
        for rights in result.rights
        if not (rights.lost_text() or rights.gained_text())
    }
    signed_again = [name for name in result.changed if name in unchanged]
    replaced = [name for name in result.changed if name not in unchanged]
    for names, text in (
        (result.created, "created enclave {}"),
        (replaced, "replaced the permissions of enclave {}"),
        (signed_again, "signed the permissions of enclave {} again, with the same rights"),
        (result.completed, "completed enclave {}"),
    ):
        yield from enclave_lines(names, text)


def _next_step_hints(result: Creation, as_json: bool) -> Iterator[str]:
    """Yield hints for standard error: how enclaves get to robots, and unchanged enclaves."""
    from sros_tool.fleet.robots import robot_of
    from sros_tool.keystore.fleet import load_fleet, publish_command
    from sros_tool.keystore.layout import EARLIER_FILES, FLEET, remedy_in_closed_robot
    from sros_tool.keystore.reader import OpenedKeystore

    published = "" if as_json or result.dry_run else publish_command(result.root)

    def has_robot(names: Iterable[str]) -> bool:
        fleet = load_fleet(OpenedKeystore(result.root))
        return fleet is not None and any(robot_of(fleet, name) for name in names)

    if published and has_robot(result.created):
        yield (
            "no release has the keys of new enclaves; bring them by hand, also to robots that "
            f"fetch: run `sros distribute_key {quote(str(result.root))} --robot NAME FOLDER "
            "--force`, and bring FOLDER to the robot"
        )
    elif len(result.created) > MAX_NAMES and not (as_json or result.dry_run):
        selection = "--robot NAME" if (result.root / FLEET).exists() else "ENCLAVE..."
        yield (
            f"to export these enclaves: `sros distribute_key {quote(str(result.root))} {selection} "
            "FOLDER`"
        )
    if published and has_robot((*result.changed, *result.completed)):
        yield f"robots that fetch get the changed files after {published}"
    elif result.changed and not (as_json or result.dry_run):
        yield remedy_in_closed_robot(
            result.root,
            f"{EARLIER_FILES}: restart them; first export again if they use an export",
        )
    if result.revoked:
        verb = "would revoke" if result.dry_run else "revoked"
        yield f"{verb} {counted(result.revoked, 'earlier certificate')}"
    if result.kept:
        yield f"unchanged: {counted(len(result.kept), 'enclave')}: {shown_names(result.kept)}"


@verb("list_enclaves")
@click.argument("root", metavar="[KEYSTORE]", type=PATH, required=False)
@enclave_filter_options()
@click.option(
    "-p",
    "--policy",
    "policy_files",
    type=PATH,
    multiple=True,
    metavar="FILE",
    help="List the enclaves of this policy, not of a keystore.  Can be repeated.",
)
@fleet_option("The robots that the placeholders of the policies stand for.")
@json_option
def list_enclaves(
    root: Path | None,
    patterns: tuple[str, ...],
    robots: tuple[str, ...],
    policy_files: tuple[Path, ...],
    fleet_file: Path | None,
    as_json: bool,
) -> None:
    """List the enclaves of KEYSTORE, or of policies, sorted.

    Example:
      $ sros list_enclaves keystore
      /listener
      /talker
      $ sros list_enclaves -p robot.xml --fleet fleet.toml --robot r7
      /r7/base
      /r7/camera
    """
    from sros_tool.keystore.layout import check_keystore, enclave_names, hidden_enclaves

    if policy_files:
        if root:
            raise UsageError(
                f"the keystore '{root}' and a policy are named",
                "",
                "Leave out the one whose enclaves you do not want.",
            )
        _list_enclaves_of_policies(policy_files, fleet_file, patterns, robots, as_json)
        return
    if fleet_file:
        raise UsageError(
            "--fleet fills in placeholders of policies, but no policy is named",
            "The fleet of a keystore is in the keystore.",
            "Leave --fleet out, or add -p FILE.",
        )
    root = root or keystore_from_environment()
    check_keystore(root)
    if patterns or robots:
        from sros_tool.keystore.reader import OpenedKeystore
        from sros_tool.keystore.selection import select_enclaves

        names = tuple(sorted(select_enclaves(OpenedKeystore(root), (), patterns, robots=robots)))
        hidden = hidden_enclaves(root)
    else:
        every_name = enclave_names(root, hidden=True)
        hidden = hidden_enclaves(root, every_name)
        names = tuple(name for name in every_name if "/." not in name)
    if as_json:
        from sros_tool.keystore.reader import OpenedKeystore
        from sros_tool.keystore.selection import EnclaveList, robots_of

        print_json(EnclaveList(root, names, hidden, robots_of(OpenedKeystore(root), names)))
        return
    for name in names:
        echo(name)
    if hidden:
        where = "a hidden folder" if len(hidden) == 1 else "hidden folders"
        echo(
            f"not listed, but loaded by DDS: {counted(len(hidden), 'enclave')} in {where}: "
            f"{first_few(hidden, 5)}. `sros check {quote(str(root))}` says what to do.",
            err=True,
        )


if TYPE_CHECKING:
    from sros_tool.fleet.expansion import FleetPolicy
    from sros_tool.keystore.template import NamedValues, Template
    from sros_tool.policy.model import Policy


def _list_enclaves_of_policies(
    files: Sequence[Path],
    fleet_file: Path | None,
    patterns: Sequence[str],
    robots: Sequence[str],
    as_json: bool,
) -> None:
    """Print the enclaves of policies."""
    from fnmatch import fnmatchcase

    from sros_tool.keystore.selection import EnclaveList
    from sros_tool.policy.document import read_policy

    if robots and not fleet_file:
        raise UsageError("--robot needs --fleet for a policy", "", "Add --fleet FILE.")
    robot_of: dict[str, str] | None = None
    chosen = set[str]()
    if fleet_file:
        policies = fleet_policies(files, fleet_file, robots)
        if robots:
            chosen.update(name for policy in policies for name in policy)
        if robots and patterns:  # both are added up, as for a keystore
            policies = fleet_policies(files, fleet_file)
        stated = {name: policy.stated_enclave(name)[1] for policy in policies for name in policy}
        robot_of = {name: robot.name for name, robot in stated.items() if robot}
        names = {*stated}
    else:
        names = {enclave.path for file in files for enclave in read_policy(file).enclaves}
    for pattern in patterns:
        fitting = {name for name in names if fnmatchcase(name, pattern)}
        if not fitting:
            raise UsageError(
                f"no enclave of the policies matches {pattern!r}",
                "",
                "List them all: repeat this command without --match and --robot.",
            )
        chosen |= fitting
    listed = sorted(chosen if patterns or robots else names)
    if robot_of is not None:
        robot_of = {name: robot_of[name] for name in listed if name in robot_of}
    if as_json:
        print_json(EnclaveList(None, listed, (), robot_of))
        return
    for name in listed:
        echo(name)


@verb("create_keystore")
@click.argument("root", type=PATH, metavar="KEYSTORE")
@click.option(
    "--template",
    "template_name",
    default="development",
    show_default=True,
    metavar="NAME|FILE",
    help="Template: development, production, sros2, or a TOML file.",
    shell_complete=complete_template,
)
@click.option(
    "--domain",
    metavar="IDS",
    help="ROS domains of the keystore's enclaves, such as 0 or 0,7 or 10-19. [default: "
    "$ROS_DOMAIN_ID, or 0]",
)
@click.option(
    "--ca-layout",
    type=click.Choice(["separate", "single"]),
    help="Separate CAs for identities and permissions, or one for both.",
)
@click.option(
    "--ca-validity",
    metavar="SPAN",
    help="Validity of the CAs: a duration (5y), an expiry date (2031-01-01), or an "
    "interval (2026-12-01/5y).",
)
@click.option(
    "--validity",
    metavar="SPAN",
    help="Validity of certificates, such as 90d or 1y. Without --permissions-validity, permissions "
    "are valid for at most as long.",
)
@click.option(
    "--permissions-validity",
    metavar="SPAN",
    help="Validity of permissions, such as 90d or 1y.",
)
@click.option(
    "--identity-ca",
    type=PATH,
    help="Certificate of an existing identity CA, with its chain; needs --identity-key.",
)
@click.option(
    "--permissions-ca",
    type=PATH,
    help="Certificate of an existing permissions CA; needs --permissions-key.",
)
@click.option(
    "--identity-key",
    metavar="URI",
    help="Private key of the identity CA, created if missing: file:PATH or pkcs11:...; "
    "or issuer:NAME, the CA service that your program sros-issuer-NAME asks.",
)
@click.option(
    "--permissions-key",
    metavar="URI",
    help="Private key of the permissions CA, created if missing: file:PATH or pkcs11:...",
)
@click.option(
    "--encrypt-ca-keys", is_flag=True, help="Protect new CA keys in files with a passphrase."
)
@dry_run_option
@json_option
def create_keystore(
    root: Path,
    template_name: str,
    domain: str | None,
    ca_layout: str | None,
    ca_validity: str | None,
    validity: str | None,
    permissions_validity: str | None,
    identity_ca: Path | None,
    permissions_ca: Path | None,
    identity_key: str | None,
    permissions_key: str | None,
    encrypt_ca_keys: bool,
    dry_run: bool,
    as_json: bool,
) -> None:
    """Create a keystore in the folder KEYSTORE, with the settings of a template.

    Passphrases of CA keys come from a prompt, from $SROS_CA_PASSPHRASE or from the file
    $SROS_CA_PASSPHRASE_FILE; the PIN of a token from a prompt or $SROS_PKCS11_PIN. A new
    passphrase has at least 12 characters, unless you set SROS_SHORT_PASSPHRASE=1.

    Example:
      $ sros create_keystore keystore
      created keystore 'keystore' for domain 0
        template development: encrypted and authenticated; every enclave may ...
        identity CA and permissions CA: separate, valid for 3650d; ...
        identity CA SHA-256 5fe417aaed47cccd3f4a6b3e8e94db185bfc8e1003ee5b8c...
        permissions CA SHA-256 e15ab4af9ee8c94bd8a5e4c6c10bb86fb7ac17e2cdd91...
      $ sros create_keystore fleet --template production --domain 10-19
    """
    from sros_tool.dds.domains import DomainSet
    from sros_tool.keystore.lifecycle.create import create_keystore as create

    present_domain = ros_domain() if domain is None else None
    domains = DomainSet.parse(domain, "--domain") if domain is not None else None
    if present_domain is not None:
        domains = DomainSet.of((present_domain, present_domain))
    template = _chosen_template(
        template_name, ca_layout, ca_validity, validity, permissions_validity
    )
    imported = _imported_cas({"identity": identity_ca, "permissions": permissions_ca})
    result = create(
        root,
        template=template,
        domains=domains,
        now=now(),
        keyring=keyring(identity_key, permissions_key, encrypt=encrypt_ca_keys),
        imported_cas=imported,
        dry_run=dry_run,
    )
    shown = None
    if as_json:
        from sros_tool.keystore.lifecycle.shown import shown_keystore

        shown = shown_keystore(result, imported, _open_rights_notes(root, template))
    print_changed(result, shown, _new_keystore_lines(result, frozenset(imported)))
    if not dry_run:
        _print_open_rights(root, template)


def _chosen_template(
    template_name: str,
    ca_layout: str | None,
    ca_validity: str | None,
    validity: str | None,
    permissions_validity: str | None,
) -> Template:
    from dataclasses import replace
    from datetime import timedelta

    from sros_tool.keystore.template import load_template
    from sros_tool.validity import parse_span

    template = load_template(template_name)
    if ca_layout:
        template = replace(template, separate_authorities=ca_layout == "separate")
    if ca_validity is not None:
        template = replace(template, authority_validity=parse_span(ca_validity))
    if validity is not None:
        span, permissions = parse_span(validity), template.permissions_validity
        template = replace(template, certificate_validity=span)
        if not isinstance(span, timedelta):
            template = replace(template, permissions_validity=span)
        elif isinstance(permissions, timedelta):
            template = replace(template, permissions_validity=min(span, permissions))
    if permissions_validity is not None:
        template = replace(template, permissions_validity=parse_span(permissions_validity))
    return template


def _imported_cas(files: dict[str, Path | None]) -> dict[str, bytes]:
    from sros_tool.xml import read_bytes

    return {
        role: read_bytes(path, "CA certificate") for role, path in files.items() if path is not None
    }


def _new_keystore_lines(result: Creation, imported: frozenset[str] = frozenset()) -> Iterator[str]:
    """Yield the new keystore's domains, template, CAs, validity and CA fingerprints."""
    from sros_tool.keystore.layout import ROLES
    from sros_tool.keystore.reader import OpenedKeystore
    from sros_tool.pki.certificates import digest, validity_of
    from sros_tool.validity import iso, span_text

    root, template = result.root, result.template
    layout = (
        "identity CA and permissions CA: separate"
        if template.separate_authorities
        else "one CA for identity and permissions"
    )
    yield f"created keystore '{root}' for domain {result.domains}"
    yield f"  template {template.name}: {template.description}"
    roles = ROLES if template.separate_authorities else ROLES[:1]
    if not imported.issuperset(roles):
        new = "a new one " if imported else ""
        layout += f", {new}valid for {span_text(template.authority_validity)}"
    yield (
        f"  {layout}; certificates "
        f"{span_text(template.certificate_validity)}, permissions "
        f"{span_text(template.permissions_validity)}"
    )
    # A robot's operator compares them with the CAs of an answer: see `sros import --ca`.
    for role in roles:
        name = f"{role} CA" if template.separate_authorities else "CA"
        certificate = OpenedKeystore(root).ca_certificate(role)
        yield f"  {name} SHA-256 {digest(certificate)}"
        if role in imported:
            yield f"    imported, valid until {iso(validity_of(certificate).not_after)}"


def _print_open_rights(root: Path, template: Template) -> None:
    for note in _open_rights_notes(root, template):
        echo(f"still open: {note.text}", err=True)


def _open_rights_notes(root: Path, template: Template) -> list[Note]:
    """Return warnings about rights that a template gives and that should be restricted."""
    from sros_tool.keystore.template import EVERYTHING

    change = f"`sros update_keystore {quote(str(root))} --template production`"
    notes = []
    if template.default_permissions == EVERYTHING:
        text = (
            f"with the template {template.name}, an enclave without a policy may publish, "
            "subscribe and call everything; restrict it with `sros create_permission` and a "
            f"policy, or the whole keystore with {change}."
        )
        notes.append(Note("keystore.open-permissions", text))
    if not template.separate_authorities:
        text = (
            "with one CA for identities and permissions, an enclave can sign its own permissions, "
            "and Cyclone DDS 0.10.2 and Fast DDS 2.9.1 accept them; create the keystore with "
            f"`--ca-layout separate`, or change it with {change}."
        )
        notes.append(Note("keystore.single-ca", text))
    return notes


@verb("update_keystore")
@keystore_argument()
@click.option(
    "--template",
    "template_name",
    metavar="NAME|FILE",
    help="Apply all settings of a template: a name, or a TOML file.",
    shell_complete=complete_template,
)
@click.option(
    "--set",
    "values",
    multiple=True,
    metavar="KEY=VALUE",
    help="Change one setting, such as protection.rtps=ENCRYPT or permissions.validity=90d. "
    "Can be repeated.",
)
@click.option(
    "--rule",
    "rules",
    multiple=True,
    metavar="RULE",
    help="Set the protection of a topic, service or action: 'topic /camera/* data=NONE "
    "metadata=SIGN'. Can be repeated.",
)
@click.option(
    "--drop-rule",
    "dropped",
    multiple=True,
    metavar="RULE",
    help="Remove a rule that --rule made: 'topic /camera/*'. Can be repeated.",
)
@click.option(
    "--domain",
    metavar="IDS",
    help="New ROS domains of the keystore's enclaves, such as 0 or 0,7 or 10-19.",
)
@click.option(
    "--take-edits",
    is_flag=True,
    help="Apply the edits in sros.toml or governance.xml. ([[enclaves]] of sros.toml can be "
    "changed only by editing the file.)",
)
@click.option(
    "--discard-edits", is_flag=True, help="Undo the edits in sros.toml and governance.xml."
)
@click.option(
    "--next", "next_stage", is_flag=True, help="Make the change in stages: do only the next stage."
)
@click.option(
    "--allow-looser",
    is_flag=True,
    help="Allow changes that permit more or protect less than before.",
)
@_revoke_old_option
@allow_refusal_option
@json_option
@dry_run_option
def update_keystore(
    root: Path,
    template_name: str | None,
    values: tuple[str, ...],
    rules: tuple[str, ...],
    dropped: tuple[str, ...],
    domain: str | None,
    take_edits: bool,
    discard_edits: bool,
    next_stage: bool,
    allow_looser: bool,
    revoke_old: bool,
    allow_refusal: tuple[Vendor, ...],
    as_json: bool,
    dry_run: bool,
) -> int:
    r"""Change the settings of KEYSTORE, and sign the affected files again.

    KEY is a setting of sros.toml. Prints which settings become looser and which tighter; looser
    settings need --allow-looser. The enclaves keep their keys and their rights.

    By default, everything changes together. With --next, the change has two stages. The first stage
    signs certificates and permissions; then restart the processes one by one, or all together if
    files that they loaded have expired. The second stage, with the same command, signs the
    governance. If the governance changes the protection of messages, processes with the old and
    with the new governance do not communicate (Cyclone DDS 0.10.2, Fast DDS 2.14.5): restart them
    together.

    The exit status of a dry run is 1 if --allow-looser is needed and missing.

    Example:
      $ sros update_keystore keystore --template production --dry-run
      would update keystore 'keystore': template development -> production
        tighter  protection.rtps SIGN -> ENCRYPT: whole messages: encrypted
        ...
      $ sros update_keystore keystore --template production --next
      $ sros update_keystore keystore --template production --next
      $ sros update_keystore keystore --domain 0,7 --allow-looser
      $ sros update_keystore keystore --set permissions.validity=90d \
            --rule 'topic /camera/* data=NONE metadata=SIGN' --allow-looser
    """
    from sros_tool.dds.domains import DomainSet
    from sros_tool.keystore.lifecycle.update import edited_settings
    from sros_tool.keystore.lifecycle.update import update_keystore as work
    from sros_tool.keystore.reader import OpenedKeystore
    from sros_tool.keystore.settings import present_settings
    from sros_tool.keystore.template import load_template, with_values

    if take_edits and (template_name is not None or discard_edits):
        raise UsageError("--take-edits excludes --template and --discard-edits")
    chosen = (template_name, values, rules, dropped, domain, take_edits, discard_edits)
    if not any(value not in (None, (), False) for value in chosen):
        command = f"sros update_keystore {quote(str(root))} --template production --next"
        raise UsageError(
            "no change is named",
            "The keystore does not record which settings the next stage has to change."
            if next_stage
            else "",
            f"Repeat the options of the first stage, for example `{command}`."
            if next_stage
            else "Name one with --template, --set, --rule or --domain.",
        )
    if take_edits and next_stage:
        raise UsageError(
            "--take-edits excludes --next",
            "The first stage would write sros.toml, and so undo the edits that belong to the "
            "second stage.",
            "Copy sros.toml elsewhere, undo the edits with --discard-edits, and name the copy with "
            "--template.",
        )
    keystore = OpenedKeystore(root)
    present = present_settings(keystore)
    domains = None
    if template_name is not None:
        target = load_template(template_name)
    elif take_edits:
        target, domains = edited_settings(keystore, present)
    else:
        target = present.settings_without_edits() if discard_edits else present.settings_to_change()
    target = with_values(
        target,
        [_key_and_value(value) for value in values],
        [_named_rule(rule) for rule in rules],
        [_kind_and_name(words.split()) for words in dropped],
    )
    if domain is not None:
        domains = DomainSet.parse(domain, "--domain")
    with progress("signing") as step:
        update = work(
            root,
            target,
            domains,
            next_stage=next_stage,
            allow_looser=allow_looser,
            revoke_old=revoke_old,
            replace_edits=take_edits or discard_edits,
            seen_settings=present,
            progress=step,
            **change_options(dry_run=dry_run, allow_refusal=allow_refusal),
        )
    layout = any(key == "authorities.layout" for key, _ in map(_key_and_value, values))
    shared = next((r.text for r in update.remarks if r.id == "keystore.one-authority"), "")
    if layout and shared and not update.done:
        raise UsageError("update_keystore cannot do more to separate the CAs", shared)
    undone = present.edits.clauses() if discard_edits else ()
    # The next stage replaces permissions, which --revoke-old revokes, only for another domain.
    options = {
        "--template": [template_name] if template_name is not None else [],
        "--set": values,
        "--rule": rules,
        "--drop-rule": dropped,
        "--domain": [domain] if domain is not None else [],
    }
    flags = ("--next", *(["--allow-looser"] * allow_looser))
    flags += ("--revoke-old",) * (revoke_old and domain is not None)
    words = [word for name, given in options.items() for value in given for word in (name, value)]
    command = " ".join(map(quote, ("sros", "update_keystore", str(root), *words, *flags)))
    _show_update(update, undone, command, as_json)
    refused = bool(update.looser) and not allow_looser
    if refused:  # only in a dry run; else an error was raised
        echo("this change would be refused: it needs --allow-looser", err=True)
    return 1 if refused else 0


def _key_and_value(text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not (key and equals):
        raise UsageError(f"{text!r} is not KEY=VALUE", "", "Write protection.rtps=ENCRYPT.")
    return key, value


def _kind_and_name(words: Sequence[str]) -> tuple[str, str]:
    if len(words) != 2 or words[0] not in ("topic", "service", "action"):
        raise UsageError(
            f"{' '.join(words)!r} names no topic, service or action",
            "",
            "Write for example 'topic /camera/*'.",
        )
    return words[0], words[1]


def _named_rule(text: str) -> NamedValues:
    from sros_tool.keystore.template import NamedValues

    words = text.split()
    if len(words) < 3:
        raise UsageError(
            f"{text!r} is not a rule",
            "",
            "Write for example 'topic /camera/* data=NONE metadata=SIGN'.",
        )
    kind, name = _kind_and_name(words[:2])
    return NamedValues(kind, name, tuple(_key_and_value(word) for word in words[2:]))


def _show_update(
    update: KeystoreUpdate, undone: Sequence[str], command: str, as_json: bool
) -> None:
    """Print an update.

    ``undone`` are clauses about the edits by hand that the update undoes, ``command`` is the
    command of the remaining stage.
    """
    if as_json:
        from sros_tool.keystore.lifecycle.shown import TemplateChange

        value = json_form(
            update,
            "UpdatedKeystore",
            needs_allow_looser=bool(update.looser),
            template=TemplateChange(update.before, update.after),
            notes=[Note("keystore.edit-undone", clause) for clause in undone],
        )
        print_json(value)
        return
    if not (update.done or update.changes):
        for line in ("nothing is left to do", *(remark.text for remark in update.remarks)):
            echo(line, err=True)
        return
    for line in _update_lines(update, undone):
        echo(line)
    print_changed(
        update,
        lines=_issued_lines(update),
        first=_replaced_lines(update),
        rights=False,
        exported=False,
        restart=not update.dry_run,
    )
    if update.left:
        echo(
            f"stage {update.done[-1]} {'would be' if update.dry_run else 'is'} done; left: "
            f"{', '.join(update.left)}. Once the processes have been restarted, run `{command}`.",
            err=True,
        )


def _update_lines(update: KeystoreUpdate, undone: Sequence[str]) -> Iterator[str]:
    """Yield what changes in the settings and rights of a keystore.

    ``undone`` are clauses about the edits by hand that the update undoes.
    """
    template = f": template {update.before} -> {update.after}"
    verb = "would update" if update.dry_run else "updated"
    yield f"{verb} keystore '{update.root}'{template if update.before != update.after else ''}"
    for clause in undone:
        yield f"  {'undone':7}  {clause}"
    for change in update.settings:
        yield f"  {change.effect:7}  {change}"
    yield from rights_lines(update.root, update.rights, dry_run=update.dry_run)


def _issued_lines(update: KeystoreUpdate) -> Iterator[str]:
    for outcome, done in (("renewed", "renewed"), ("signed", "signed the permissions of")):
        if names := update.names(outcome):
            yield f"{done} {shown_names(names)}"


def _replaced_lines(update: KeystoreUpdate) -> Iterator[str]:
    """Yield lines that say how long replaced files still work, and how to revoke them."""
    from sros_tool.validity import iso

    if update.works_until:
        names = tuple(update.outcomes)
        shown = " ".join(map(quote, names)) if len(names) <= _NAMES_SHOWN else "ENCLAVE..."
        ends = f"run `sros renew {quote(str(update.root))} {shown} --revoke-old`"
        if update.left:
            ends = f"add --revoke-old to the command of the stage {update.left[-1]}, or {ends}"
        yield (
            "the replaced certificates and permissions, with their earlier rights, work until "
            f"{iso(update.works_until)} for anyone who kept copies of these files and of the key. "
            f"To revoke the certificates, {ends}."
        )


_NAMES_SHOWN = 5
