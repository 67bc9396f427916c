"""The Zenoh configurations of a keystore: existing files, their faults, and files that it needs.

Zenoh itself verifies nothing, so each configuration must be identical to the document in the signed
message next to it, and state the rights of the enclave's signed permissions.
`sros_tool.keystore.lifecycle.change` writes the configurations.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from enum import Enum, StrEnum
from functools import cached_property
from pathlib import Path
from shlex import quote
from typing import NamedTuple, TypeVar

from cryptography import x509

from sros_tool.dds.domains import DomainSet
from sros_tool.dds.permissions import Grant
from sros_tool.errors import KeystoreError, PolicyError, SrosError, UsageError, check_meaning
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    CRL_FILE,
    PERMISSIONS_FILE,
    ROUTER_FILE,
    SESSION_FILE,
    ZENOH_SIGNED,
    enclave_folder,
)
from sros_tool.keystore.ledger import Entry, Ledger
from sros_tool.keystore.reader import FilesReadOnce, OpenedEnclave, OpenedKeystore
from sros_tool.keystore.rights import RecordedRights, SignedRights
from sros_tool.keystore.zenoh_permissions import (
    grant_for_all_vendors,
    joined_domains,
    rights_in_domain,
)
from sros_tool.names import is_expression
from sros_tool.parallel import map_slices
from sros_tool.pki import smime
from sros_tool.pki.certificates import common_name_of, subject_text, validity_of
from sros_tool.pki.crl import SUPERSEDED, RevocationList, load_crl
from sros_tool.policy.model import ALLOW, RIGHTS, Enclave
from sros_tool.policy.rights import Rules, nodes_from_text
from sros_tool.translate_zenoh.graph import GRAPH, AnnouncedNodes, announced_nodes, nodes_in_rules
from sros_tool.translate_zenoh.rights import (
    ANY_TYPE,
    StatedRight,
    crossing_rules,
    domains_of,
    remote_of,
    remote_rights,
    rights_given_to_router,
    stated_names,
)
from sros_tool.validity import iso
from sros_tool.zenoh.access import (
    AccessControl,
    Flow,
    Message,
    RemoteRights,
    RightsBetween,
    is_within,
    joined,
    joined_rights,
    narrowed_rights,
)
from sros_tool.zenoh.configuration import (
    Configuration,
    Mode,
    RenderedReader,
    RenderedRights,
    ZenohNetwork,
    parse_rendered,
    render_configuration,
    render_rights,
)
from sros_tool.zenoh.key_expressions import KeyExpressions, TooManyExpressions, names_of


class ZenohFault(Enum):
    """The faults that the Zenoh configurations of an enclave can have, by stable id."""

    MISSING = "missing"
    UNREADABLE = "unreadable"
    UNSIGNED = "unsigned"
    SIGNATURE = "signature"
    OTHER_DOCUMENT = "other-document"
    MALFORMED = "malformed"
    OUT_OF_DATE = "out-of-date"
    OTHER_NAME = "other-name"


@dataclass(frozen=True, slots=True)
class ZenohProblem:
    """A fault of a Zenoh configuration: the file with the fault, and the reason as a clause."""

    file: str
    text: str
    fault: ZenohFault

    def __str__(self) -> str:
        return f"{self.file}: {self.text}"


@dataclass(frozen=True, slots=True)
class OpenedZenoh:
    """The Zenoh configurations of an enclave by file name, and their problems.

    ``files`` are the existing files; ``configurations`` are the configurations that were read and
    verified.
    """

    files: tuple[str, ...]
    configurations: Mapping[str, Configuration]
    problems: tuple[ZenohProblem, ...]

    def domains(self) -> tuple[int, ...]:
        """Return the ROS domains for which the configurations are, sorted."""
        controls = (configuration.access_control for configuration in self.configurations.values())
        return tuple(sorted(set().union(*map(domains_of, controls))))


def open_zenoh(folder: Path, name: str, state: OpenedEnclave) -> OpenedZenoh:
    """Return the Zenoh configurations of the enclave ``name`` in ``folder``, and their problems.

    The configurations are only compared with the enclave's own files in ``state``, so this works on
    a robot, too.  An enclave without any configuration has the problem `ZenohFault.MISSING`.
    """
    present = tuple(
        file
        for file, signed in ZENOH_SIGNED.items()
        if any(map(_exists, (folder / file, folder / signed)))
    )
    configurations: dict[str, Configuration] = {}
    problems: list[ZenohProblem] = []
    certified = common_name_of(state.certificate.subject) if state.certificate else name
    identity = certified if certified.startswith("/") else name
    if not present:
        text = "the enclave has neither this file nor router.json5"
        problems.append(ZenohProblem(SESSION_FILE, text, ZenohFault.MISSING))
    for file in present:
        read = _read_configuration(folder, file, state)
        if isinstance(read, ZenohProblem):
            problems.append(read)
            continue
        configurations[file] = read
        if (text := _before_revocation_clause(read, state)) or (
            text := _out_of_date_clause(read, file, identity, state)
        ):
            problems.append(ZenohProblem(file, text, ZenohFault.OUT_OF_DATE))
    if configurations and certified != name:
        text = (
            f"Zenoh identifies the process by the common name here, {certified or '(none)'}, not "
            f"{name}"
        )
        problems.append(ZenohProblem(CERTIFICATE_FILE, text, ZenohFault.OTHER_NAME))
    return OpenedZenoh(present, configurations, tuple(problems))


def is_signed(
    path: Path,
    document: bytes,
    authority: x509.Certificate,
    files: FilesReadOnce | None = None,
) -> bool:
    """Return whether the file next to ``path`` is ``document``, signed by the permissions CA."""
    files = files or FilesReadOnce()
    try:
        message = files.read(path.with_name(ZENOH_SIGNED[path.name]), "signed document")
        signed = files.signed_document(message)
        signed.verify(authority)
    except SrosError:
        return False
    return signed.text == document


def _exists(path: Path) -> bool:
    return path.exists() or path.is_symlink()


def _read_configuration(
    folder: Path, file: str, state: OpenedEnclave
) -> Configuration | ZenohProblem:
    """Return a configuration that the permissions CA signed, or the problem with it."""
    signed_file = ZENOH_SIGNED[file]
    for needed, fault in ((file, ZenohFault.MISSING), (signed_file, ZenohFault.UNSIGNED)):
        if not _exists(folder / needed):
            return ZenohProblem(needed, "missing", fault)
    try:
        document = state.read_once.read(folder / file, "Zenoh configuration")
        message = state.read_once.read(folder / signed_file, "signed document")
    except SrosError as error:
        return ZenohProblem(file, str(error), ZenohFault.UNREADABLE)
    try:
        signed = state.read_once.signed_document(message)
        if state.permissions_ca is None:
            text = (
                "the permissions CA of the enclave is missing, so the signature cannot be verified"
            )
            return ZenohProblem(signed_file, text, ZenohFault.SIGNATURE)
        signed.verify(state.permissions_ca)
    except SrosError as error:
        return ZenohProblem(signed_file, str(error).rstrip("."), ZenohFault.SIGNATURE)
    if signed.text != document:
        text = f"it is not the document that the permissions CA signed in {signed_file}"
        return ZenohProblem(file, text, ZenohFault.OTHER_DOCUMENT)
    try:
        return parse_rendered(document, "it")
    except SrosError as error:
        return ZenohProblem(file, error.what, ZenohFault.MALFORMED)


def _before_revocation_clause(configuration: Configuration, state: OpenedEnclave) -> str:
    """Return a clause if a configuration's rules for other enclaves predate a revocation, or ""."""
    data = state.files.get(CRL_FILE)
    if configuration.mode is Mode.CLIENT or data is None:
        return ""
    try:
        crl = load_crl(data, CRL_FILE)
    except SrosError:
        return ""  # another check reports this problem of the enclave
    if configuration.revoked >= _last_revocation(lists=(crl,)):
        return ""
    return f"it is older than the last revocation in {CRL_FILE}: revoked enclaves may keep rights"


def _out_of_date_clause(
    configuration: Configuration, file: str, name: str, state: OpenedEnclave
) -> str:
    """Return how a configuration differs from its enclave's permissions, as a clause, or ""."""
    is_session = file == SESSION_FILE
    if is_session is (configuration.mode is Mode.ROUTER):
        present, wanted = ("router", "session") if is_session else ("session", "router")
        return f"it is the configuration of a {present}, not of a {wanted}"
    if not is_session or state.grant is None:
        return ""
    control = configuration.access_control
    domains = joined_domains(state.grant, domains_of(control))
    # The nodes of a policy are only known in the keystore; here, the nodes that the permissions CA
    # signed count.
    nodes = nodes_in_rules((rule for remote in control.remotes for rule in remote.rules), name)
    try:
        stated = {domain: rights_in_domain(name, state.grant, domain) for domain in domains}
        own_rights = remote_of(name, stated, nodes)
    except SrosError as error:
        return f"Zenoh cannot state the permissions of the enclave: {error.what}"
    # The router may do what the enclave allows to it, and other processes nothing beyond this.
    mirrored = joined(rule.mirrored() for rule in own_rights.rules)
    if not any(remote.rules == mirrored for remote in control.remotes) or not all(
        is_within(remote, own_rights) for remote in control.remotes
    ):
        names = stated_names(own_rights.rules)
        if any(
            stated_names(rule.mirrored() for rule in remote.rules) == names
            for remote in control.remotes
        ):
            # The file is refused anyway, because the earlier rules may allow more to others.
            return (
                f"it has the topics and services of {PERMISSIONS_FILE}, but an earlier version of "
                "sros wrote it, with other rules than this version"
            )
        return f"it does not state the rights of {PERMISSIONS_FILE}"
    return ""


_ANY_PORT_HERE = "tls/localhost:0"
"""Where sessions listen for direct connections: on their own host, as in rmw_zenoh."""
_MOST_BYTES = 512 << 20
_BATCH_SIZE = 50
"""Number of enclaves that are read together, step by step.

The code of a step then stays in the caches of the processor.  This takes a third less time than
reading one enclave after the other, and little memory.
"""
_MOST_DOMAINS = 16
"""Maximum number of ROS domains in a network, because every right is written once per domain."""


Result = TypeVar("Result")
OTHER_DOMAINS = "its permissions are for no domain of the Zenoh network"
"""Why an enclave gets no configuration if the network's domains are stated in the settings."""


@dataclass(frozen=True, slots=True)
class ZenohDocuments:
    """The configurations that a keystore should have.

    ``files`` maps the paths of configurations to their content, and ``enclaves`` maps the paths to
    the enclaves.  ``left_out`` maps enclaves without a configuration, and without rights in other
    configurations, to the reason (a clause).  ``nodes`` maps all other enclaves to the nodes that
    they may announce in the graph.  ``existing`` are the enclaves of the keystore, and ``ledger``
    is its ledger.  ``unread`` are enclaves whose rights were not read, so that the files have no
    rules for them.
    """

    files: Mapping[str, bytes]
    enclaves: Mapping[str, str]
    left_out: Mapping[str, str]
    nodes: Mapping[str, AnnouncedNodes]
    existing: tuple[str, ...]
    ledger: Ledger
    unread: frozenset[str] = frozenset()


@dataclass(frozen=True, slots=True)
class ZenohChange:
    """The changes of a transaction on which the Zenoh configurations of a keystore depend.

    ``issued`` are the new permissions of enclaves.  ``revoked`` are the revoked enclaves, and
    ``replaced`` the enclaves whose earlier certificates are revoked.  ``recorded`` are the entries
    that the transaction adds to the ledger.  ``stated`` are the policies of the enclaves, whose
    lines errors name.
    """

    issued: Mapping[str, SignedRights] = field(default_factory=dict)
    revoked: Collection[str] = ()
    replaced: Collection[str] = ()
    stated: Mapping[str, Enclave | None] = field(default_factory=dict)
    recorded: Sequence[Entry] = ()


_NO_CHANGE = ZenohChange()


class Drift(StrEnum):
    """The ways in which a configuration can differ from the needed configuration."""

    MISSING = "missing"
    DIFFERS = "differs"
    UNSIGNED = "unsigned"
    """The permissions CA has not signed the document next to the configuration."""
    STALE = "stale"
    """The enclave should not have the configuration."""
    FOREIGN = "foreign"
    """As `STALE`, but without a signed document: perhaps the user's own file, which stays."""


@dataclass(frozen=True, slots=True)
class DriftedConfiguration:
    """A configuration that differs from the needed one; ``path`` is relative to the keystore."""

    enclave: str
    path: str
    kind: Drift


def drifted_configurations(
    keystore: OpenedKeystore,
    wanted_documents: ZenohDocuments,
    authority: x509.Certificate,
    revoked_enclaves: Collection[str] = (),
    reader: RenderedReader | None = None,
) -> tuple[DriftedConfiguration, ...]:
    """Return the configurations that differ from ``wanted_documents``, or lack a valid signature.

    Configurations of enclaves in ``revoked_enclaves`` do not count, nor do rules for unread
    enclaves. ``reader`` may already have read the files.
    """
    reader = reader or RenderedReader()

    def compare(paths: Sequence[str]) -> list[DriftedConfiguration]:
        differing = []
        for path in paths:
            document, present = wanted_documents.files[path], _present_file(keystore, path)
            kind = None
            if present is None:
                kind = Drift.MISSING
            elif _without_rules_for(present, wanted_documents.unread, reader) != document:
                kind = Drift.DIFFERS
            elif not is_signed(keystore.root / path, present, authority, keystore.files):
                kind = Drift.UNSIGNED
            if kind:
                differing.append(DriftedConfiguration(wanted_documents.enclaves[path], path, kind))
        return differing

    files = [file for _, part in map_slices(list(wanted_documents.files), compare) for file in part]
    stale = stale_files(keystore.root, wanted_documents.files, wanted_documents.existing)
    files += (file for file in stale if file.enclave not in revoked_enclaves)
    return tuple(files)


def _without_rules_for(
    document: bytes, names: Collection[str], reader: RenderedReader
) -> bytes | None:
    """Return a configuration without the rules for the enclaves ``names``.

    The result is None if ``names`` is not empty and this version of sros did not write the file.
    """
    if not names:
        return document
    configuration = reader.read(document)
    if configuration is None:
        return None
    remotes = configuration.access_control.remotes
    kept = tuple(rights for rights in remotes if rights.common_name not in names)
    return replace(configuration, access_control=AccessControl(kept)).render()


class ZenohDrift(NamedTuple):
    """The configurations of a keystore that have drifted from the needed ones.

    ``left_out`` maps enclaves that get no configuration to the reason (a clause).  ``nodes`` maps
    all other enclaves to the nodes that they may announce in the graph.
    """

    files: tuple[DriftedConfiguration, ...]
    left_out: Mapping[str, str]
    nodes: Mapping[str, AnnouncedNodes]


def zenoh_drift(
    keystore: OpenedKeystore,
    network: ZenohNetwork,
    domains: DomainSet,
    authority: x509.Certificate,
    now: datetime | None,
    *,
    only_enclaves: Collection[str] = (),
    among: Collection[str] = (),
    reader: RenderedReader | None = None,
) -> ZenohDrift:
    """Return the drifted configurations of a keystore, and the enclaves without a configuration.

    If ``now`` is None, permissions that have expired count, too.  Only the
    files of ``only_enclaves`` are examined, and in these files only the rights of the enclaves
    ``among``; for both, empty means all enclaves.  ``reader`` may have read the files already.

    Raises:
        SrosError: the rights of an enclave cannot be stated to Zenoh, or the router has no enclave.
    """
    wanted = zenoh_documents(
        keystore, network, domains, authority, now, only_enclaves=only_enclaves, among=among
    )
    files = drifted_configurations(keystore, wanted, authority, reader=reader)
    return ZenohDrift(files, wanted.left_out, wanted.nodes)


def zenoh_documents(
    keystore: OpenedKeystore,
    network: ZenohNetwork,
    domains: DomainSet,
    authority: x509.Certificate,
    now: datetime | None,
    change: ZenohChange = _NO_CHANGE,
    *,
    existing: tuple[str, ...] | None = None,
    only_enclaves: Collection[str] = (),
    among: Collection[str] = (),
) -> ZenohDocuments:
    """Return the configurations that the enclaves of a keystore need.

    Args:
        keystore: the keystore.
        network: the Zenoh network in the keystore's settings.
        domains: the ROS domains of the governance.
        authority: the permissions CA.
        now: the current time; if None, permissions that have expired count, too.
        change: what a transaction changes.
        existing: the enclaves of the keystore; None searches for them.
        only_enclaves: the enclaves whose configurations are made; only these count as
            existing; () for all.
        among: the enclaves whose rights are written to these configurations; () for all.
    """
    root = keystore.root
    of_network = _domains(network, domains, keystore)
    existing = keystore.names if existing is None else existing
    names = sorted({*existing, *change.issued}.difference(change.revoked))
    for router in network.router_names():
        if router not in names:
            raise KeystoreError(
                f"keystore '{root}' has no enclave {router}, and the Zenoh router needs it",
                "By the certificate of this enclave, all other processes recognize the router.",
                f"Create it with `sros create_enclave {quote(str(root))} {router}`, name another "
                "enclave with `sros zenoh --router NAME`, or remove the Zenoh files with `sros "
                f"zenoh {quote(str(root))} --off`.",
            )
        if change.stated.get(router):
            raise UsageError(
                f"a policy has rights for {router}, the enclave of the Zenoh router",
                "The router forwards all messages, so a node in this enclave would have the "
                "rights of all enclaves.",
                f"In the policy, give the nodes of {router} another enclave.",
            )
        names.remove(router)
    unread = frozenset(names).difference(among) if among else frozenset[str]()
    names = [name for name in names if name not in unread]
    reader = _RightsReader(keystore, authority, of_network, network, now, change, only_enclaves)
    read: dict[str, _RulesOfEnclave | str] = {}
    for _, of_enclaves in map_slices(names, reader.read):
        read |= of_enclaves
    rules = {
        name: of_enclave for name, of_enclave in read.items() if not isinstance(of_enclave, str)
    }
    left_out = {name: why for name, why in read.items() if isinstance(why, str)}
    recorded = (*reader.ledger.entries, *change.recorded)
    revoked = _last_revocation(recorded, keystore.revocation_lists)
    try:
        files = _router_files(network, of_network, rules, revoked)
    except TooManyExpressions:
        raise PolicyError(
            "the rules of a Zenoh router for another router would have too many key expressions",
            "A message passes between routers if an enclave on one side may send it and an enclave "
            "on the other side may receive it. The wildcards in the rights of these enclaves "
            "combine in too many ways.",
            "Use fewer wildcards in the policies, or list the names that may pass between "
            "routers: `sros zenoh --cross NAME`.",
        ) from None
    direct = network.mode is Mode.PEER
    listen = (_ANY_PORT_HERE,) if direct else ()
    between = RightsBetween(
        of_enclave.rights for of_enclave in rules.values() if of_enclave.rights and direct
    )

    def session(name: str) -> bytes:
        router = rules[name].router
        assert router
        return render_configuration(
            network.mode,
            listen,
            _tls_endpoints(network.router_of(name).endpoints),
            _rights_for_peers(name, router, between) if direct else (router,),
            revoked if direct else "",
        )

    def sessions(names: Sequence[str]) -> dict[str, bytes]:
        return {_session_path(name): session(name) for name in names}

    size = 0
    chosen = [name for name in rules if not only_enclaves or name in only_enclaves]
    for _, part in map_slices(chosen, sessions):
        size += sum(map(len, part.values()))
        files |= part
    if direct and size > _MOST_BYTES:
        raise UsageError(
            f"the files of {len(rules)} enclaves would be larger than {_MOST_BYTES >> 20} MB",
            "In peer mode, a file has the rights of all enclaves that the file's enclave may "
            "reach.",
            f"Use client mode: `sros zenoh {quote(str(root))} --mode client`.",
        )
    enclaves = {_router_path(name): name for name in network.router_names()}
    enclaves |= {_session_path(name): name for name in chosen}
    if only_enclaves:
        existing = tuple(name for name in existing if name in only_enclaves)
    nodes = {name: of_enclave.nodes for name, of_enclave in rules.items()}
    return ZenohDocuments(files, enclaves, left_out, nodes, existing, reader.ledger, unread)


def _last_revocation(entries: Iterable[Entry] = (), lists: Iterable[RevocationList] = ()) -> str:
    """Return when any enclave was last revoked, by the ledger and revocation lists; "" if never.

    The time is in ISO 8601 (UTC).  Replaced certificates, with the reason `SUPERSEDED`, do not
    count.
    """
    moments = [
        entry.time for entry in entries if entry.what == "revocation" and entry.reason != SUPERSEDED
    ]
    moments += [
        iso(revoked.date)
        for revocations in lists
        for revoked in revocations.revoked
        if revoked.reason != SUPERSEDED
    ]
    return max(moments, default="")


def _rights_for_peers(
    name: str, router: RenderedRights, between: RightsBetween
) -> list[RenderedRights]:
    """Return the rights that a session gives to the router and to every other session, in order.

    Raises:
        PolicyError: the common rights of two enclaves take too many key expressions.
    """
    try:
        # Zenoh accepts no policy without rules.
        rendered = [
            render_rights(rights) for rights in between.rights_for_others(name) if rights.rules
        ]
    except TooManyExpressions:
        raise PolicyError(
            f"the common rights of {name} and another enclave cannot be expressed in Zenoh",
            "In peer mode, the file of an enclave states, for each other enclave, the rights that "
            "the two have in common. The wildcards in these rights combine into too many key "
            "expressions.",
            "Use fewer wildcards, or client mode: `sros zenoh --mode client`.",
        ) from None
    rendered.append(router)
    return sorted(rendered, key=lambda rights: rights.name)


def _tls_endpoints(endpoints: Iterable[str]) -> tuple[str, ...]:
    return tuple(f"tls/{endpoint}" for endpoint in endpoints)


def _router_files(
    network: ZenohNetwork,
    domains: Sequence[int],
    rules: Mapping[str, _RulesOfEnclave],
    revoked: str,
) -> dict[str, bytes]:
    """Map the paths of all routers' configurations to their content.

    ``revoked`` is the time of the last revocation, which is written to the files.  A router gives
    another router the rights that the enclaves at both ends have in common.

    Raises:
        TooManyExpressions: these rights take too many key expressions.
    """
    routers, connects = network.every_router(), network.connects()
    sides: dict[str, list[str]] = {router.name: [] for router in routers}
    for name in rules:
        sides[network.router_of(name).name].append(name)
    together = {
        router: joined_rights(router, (rights for n in enclaves if (rights := rules[n].rights)))
        for router, enclaves in sides.items()
        if network.routers
    }
    for router in routers if network.routers else ():
        for names in filter(None, (network.crossing, router.crossing)):
            most = crossing_rules(names, domains)
            together[router.name] = narrowed_rights(together[router.name], most, GRAPH)
    between = RightsBetween(together.values())
    files = {}
    for router in routers:
        remotes = [rules[name].remote for name in sides[router.name]]
        remotes += [
            render_rights(rights)
            for rights in (between.rights_for_others(router.name) if together else ())
            if rights.rules and rights.common_name != router.name
        ]
        files[_router_path(router.name)] = render_configuration(
            Mode.ROUTER,
            _tls_endpoints(router.listening()),
            _tls_endpoints(connects[router.name]),
            remotes,
            revoked,
        )
    return files


def _domains(
    network: ZenohNetwork, domains: DomainSet, keystore: OpenedKeystore
) -> tuple[int, ...]:
    """Return the ROS domains of the network, after checking that the governance has all of them."""
    root = keystore.root
    if unserved := [domain for domain in network.domains if domain not in domains]:
        raise UsageError(
            f"the Zenoh network has domain {unserved[0]}, but keystore '{root}' is only for "
            f"domain {domains}",
            "DDS and Zenoh would enforce different rights.",
            f"Name other domains with `sros zenoh --domain`, or add the domain with `sros "
            f"update_keystore {quote(str(root))} --domain {domains},{unserved[0]} --allow-looser`.",
        )
    chosen = network.domains or tuple(domains)
    if len(chosen) > _MOST_DOMAINS:
        raise UsageError(
            f"keystore '{root}' is for {len(chosen)} domains, but a Zenoh network can have at most "
            f"{_MOST_DOMAINS}",
            "The rules of the network state every right once for each domain.",
            "Name the domains that run on Zenoh with `sros zenoh --domain`.",
        )
    return chosen


# ── the rights of each enclave ─────────────────────────────────────────────────────────────


_NEEDS_PARSING = re.compile(rb"[\x00\x80-\xff*?\[&]|<!|ALLOW")
"""Matches text in permissions that may give a right to a name that is not in the text.

This can be a wildcard, markup that splits or encodes a name, or a default that allows.
"""
_XML_DECLARATION = b'<?xml version="1.0" encoding="UTF-8"?>'


def enclaves_with_rights(keystore: OpenedKeystore, names: Collection[str]) -> set[str]:
    """Return all enclaves that may have a right to one of ``names``, and perhaps other enclaves.

    No signature is verified and no XML parsed: the bytes of the permissions are searched for the
    names.
    """
    texts = [name.encode() for name in names]

    def may_have_rights(enclave: str) -> bool:
        path = keystore.folder(enclave) / PERMISSIONS_FILE
        try:
            message = keystore.read(path, "permissions document")
        except SrosError:
            return True
        if any(text in message for text in texts):
            return True
        return bool(_NEEDS_PARSING.search(message.replace(_XML_DECLARATION, b"", 1)))

    return {enclave for enclave in keystore.names if may_have_rights(enclave)}


class _RulesOfEnclave(NamedTuple):
    """The rights that other processes give to an enclave, and that the enclave gives to the router.

    ``remote`` are the rights that other processes give to the enclave; ``rights`` are the same
    rights as a value, if more than one file needs them.  ``router`` are the rights that the enclave
    gives to the router; None if the enclave's own file is not needed.  ``nodes`` are the nodes that
    the enclave may announce.
    """

    remote: RenderedRights
    router: RenderedRights | None
    nodes: AnnouncedNodes
    rights: RemoteRights | None


@dataclass(frozen=True)
class _RightsReader:
    """A reader of enclaves' rights, in the form of other processes' rules.

    Only the last permissions that the permissions CA signed count, until they expire.  An enclave
    whose files have older or other permissions gets no rules.
    """

    keystore: OpenedKeystore
    authority: x509.Certificate
    domains: Sequence[int]
    network: ZenohNetwork
    now: datetime | None
    change: ZenohChange
    only_enclaves: Collection[str]

    @property
    def ledger(self) -> Ledger:
        """The ledger of the keystore."""
        return self.keystore.ledger

    @cached_property
    def _recorded(self) -> RecordedRights:
        return RecordedRights(self.keystore, self.ledger)

    @cached_property
    def _revoked(self) -> frozenset[int]:
        lists = self.keystore.revocation_lists
        return frozenset(entry.serial for crl in lists for entry in crl.revoked)

    def read(self, names: Sequence[str]) -> dict[str, _RulesOfEnclave | str]:
        """Map enclaves to their rules, or to the reason why they get none (a clause)."""
        rules: dict[str, _RulesOfEnclave | str] = {}
        for begin in range(0, len(names), _BATCH_SIZE):
            rules |= self._read_some(names[begin : begin + _BATCH_SIZE])
        return rules

    def _read_some(self, names: Sequence[str]) -> dict[str, _RulesOfEnclave | str]:
        """Return the results of `read`, doing each step for all enclaves before the next step."""
        left_out: dict[str, str] = {}

        def results_of(names: Iterable[str], step: Callable[[str], Result]) -> dict[str, Result]:
            done = {}
            for name in names:
                try:
                    done[name] = step(name)
                except SrosError as error:
                    left_out[name] = error.what
            return done

        issued = {name: rights for name in names if (rights := self.change.issued.get(name))}
        certificates = results_of((e for e in names if e not in issued), self._certificate)
        messages = results_of(certificates, self._message)
        signed = results_of(
            messages, lambda name: self.keystore.files.signed_document(messages[name])
        )
        verified = results_of(signed, lambda name: self._verify(name, messages[name], signed[name]))
        grants = results_of(
            verified, lambda name: self._grant(name, signed[name].document, certificates[name])
        )
        grants |= {name: rights.grant for name, rights in issued.items()}
        joined = results_of(grants, lambda name: self._domains_of_grant(grants[name]))
        stated = {
            name: {domain: rights_in_domain(name, grants[name], domain) for domain in domains}
            for name, domains in joined.items()
        }
        remotes = {name: self._remote(name, rights) for name, rights in stated.items()}
        asked = [name for name in remotes if not self.only_enclaves or name in self.only_enclaves]
        for name in asked:
            _check_rules_match(name, remotes[name], stated[name])
        routers = {
            name: render_rights(
                rights_given_to_router(self.network.router_of(name).name, remotes[name])
            )
            for name in asked
        }
        rendered = {name: render_rights(rights) for name, rights in remotes.items()}
        return {
            name: left_out[name]
            if name in left_out
            else _RulesOfEnclave(
                rendered[name],
                routers.get(name),
                announced_nodes(remotes[name].rules, name),
                remotes[name] if self.network.mode is Mode.PEER or self.network.routers else None,
            )
            for name in names
        }

    def _certificate(self, name: str) -> x509.Certificate:
        path = self.keystore.folder(name) / CERTIFICATE_FILE
        try:
            certificate = self.keystore.certificate(path)
        except SrosError as error:
            raise error if path.exists() else KeystoreError("it has no certificate yet") from None
        if certificate.serial_number in self._revoked:
            raise KeystoreError("its certificate is revoked")
        if (certified := common_name_of(certificate.subject)) != name:
            raise KeystoreError(
                f"Zenoh identifies a process by the common name of its certificate: here, this is "
                f"{certified or '(none)'!r}, not the name of the enclave"
            )
        return certificate

    def _message(self, name: str) -> bytes:
        path = self.keystore.folder(name) / PERMISSIONS_FILE
        try:
            return self.keystore.read(path, "permissions document")
        except SrosError as error:
            raise error if path.exists() else KeystoreError("it has no permissions") from None

    def _verify(self, name: str, message: bytes, signed: smime.SignedDocument) -> None:
        signed.verify(self.authority)
        self._recorded.policy(name, hashlib.sha256(message).hexdigest())

    def _grant(self, name: str, document: bytes, certificate: x509.Certificate) -> Grant:
        subject = subject_text(certificate.subject)
        grant = grant_for_all_vendors(document, f"the permissions of {name}", subject)
        if grant is None:
            raise KeystoreError("its permissions are not for its certificate")
        now = self.now
        # Without a valid certificate, the enclave gets no connection, so changing its rules would
        # be useless.
        if now and grant.validity.not_after < now <= validity_of(certificate).not_after:
            raise KeystoreError(f"its permissions expired at {grant.not_after}")
        return grant

    def _domains_of_grant(self, grant: Grant) -> tuple[int, ...]:
        domains = joined_domains(grant, self.domains)
        if not domains:
            elsewhere = "its permissions are for no domain of the keystore"
            raise KeystoreError(OTHER_DOMAINS if self.network.domains else elsewhere)
        return domains

    def _nodes(self, name: str) -> str:
        issued = self.change.issued.get(name)
        return issued.nodes if issued else self._recorded.nodes(name)

    def _remote(
        self, name: str, stated_rights: Mapping[int, Sequence[StatedRight]]
    ) -> RemoteRights:
        try:
            return remote_of(name, stated_rights, nodes_from_text(self._nodes(name)))
        except PolicyError:
            if policy := self.change.stated.get(name):
                remote_rights(policy, min(stated_rights))  # the error names the line of the policy
            raise


_DECIDING_MESSAGES = {
    "publish": (Flow.INGRESS, Message.PUT),
    "subscribe": (Flow.EGRESS, Message.PUT),
    "request": (Flow.INGRESS, Message.QUERY),
    "reply": (Flow.EGRESS, Message.QUERY),
}
"""Maps each right to its message, as the translation does: two sources show an error in one."""
_RIGHTS_BY_TOKEN_KIND = {
    "NN": "",
    "MP": "publish",
    "MS": "subscribe",
    "SC": "request",
    "SS": "reply",
}
"""Maps the kind of a graph token to the right that it announces; "" for a node."""
_GRAPH_TOKEN = re.compile(r"@ros2_lv/([0-9]+)/\*/\*/\*/(..)/([^/]+)/[^/]+/[^/]+(?:/([^/]+)/\*\*)?")


def _check_rules_match(
    enclave: str, remote: RemoteRights, stated_rights: Mapping[int, Sequence[StatedRight]]
) -> None:
    """Raise `PkiError` if rules and rights decide differently on a name.

    For names with wildcards, examples are tried.
    """
    control = AccessControl((remote,))
    passing = {right: control.passing(enclave, *use) for right, use in _DECIDING_MESSAGES.items()}
    tokens = control.passing(enclave, Flow.INGRESS, Message.LIVELINESS_TOKEN)
    announced = _announced_names(tokens, enclave)
    foreign = announced is None
    check_meaning(foreign, False, f"that {enclave} announces nodes of another enclave")
    if _have_equal_keys(passing, stated_rights):
        announces_more = announced != _allowed_announcements(stated_rights)
        check_meaning(
            announces_more, False, f"that {enclave} announces names that it has no right to"
        )
        return
    nodes = _example_nodes(enclave, control)
    kinds = {right: kind for kind, right in _RIGHTS_BY_TOKEN_KIND.items()}

    def is_announced(domain: int, right: str, name: str) -> bool:
        last = (name.replace("/", "%"), "type/hash/qos")
        ns, _, node_name = name.rpartition("/")[0].rpartition("/")
        # Only the node itself may announce its own services.
        its_own = tuple(part.replace("/", "%") for part in (enclave, ns or "/", node_name))
        tokens = (
            "/".join((f"@ros2_lv/{domain}/z/0/1", kinds[right], *node, *last))
            for node in (*nodes, its_own)
        )
        announcing = (enclave, Flow.INGRESS, Message.LIVELINESS_TOKEN)
        return any(control.allows(*announcing, token) for token in tokens)

    for domain, rights in stated_rights.items():
        rules = Rules([stated_right.right for stated_right in rights])
        names = {(e.right.kind, name) for e in rights for name in _example_names(e.right.name)}
        for kind, name in names:
            for right in RIGHTS[kind]:
                passes = passing[right].include(f"{domain}{name}/{ANY_TYPE}")
                if passes != (meant := rules.allow(enclave, right, name)):
                    check_meaning(passes, meant, f"the right of {enclave} to {right} {name}")
                if nodes and is_announced(domain, right, name) != meant:
                    check_meaning(not meant, meant, f"that {enclave} announces {right} {name}")


def _have_equal_keys(
    passing: Mapping[str, KeyExpressions], stated_rights: Mapping[int, Sequence[StatedRight]]
) -> bool:
    """Return whether the rights have no wildcards, and the rules have exactly the rights' keys.

    The keys for the history of a topic, below its key, are not compared.
    """
    keys: dict[str, set[str]] = {right: set() for right in _DECIDING_MESSAGES}
    for domain, rights in stated_rights.items():
        if is_expression("".join([stated_right.right.name for stated_right in rights])):
            return False
        for (_, qualifier, right, name), _ in rights:
            if qualifier is not ALLOW:
                return False
            keys[right].add(f"{domain}{name}")
    return all(
        keys[right]
        == {
            key.removesuffix("/**").removesuffix("/$*::$*/*")
            for key in expressions.all
            if not key.endswith("/@adv/**")
        }
        for right, expressions in passing.items()
    )


def _announced_names(tokens: KeyExpressions, enclave: str) -> set[tuple[str, str, str]] | None:
    """Return the announcements of graph tokens, as triples of domain, right and name.

    Right and name are "" for a node.  Returns None if a token is for another enclave.
    """
    announced = set()
    for key in tokens.all:
        if not key.endswith("/@adv/**"):
            token = _GRAPH_TOKEN.fullmatch(key)
            if not token or token[3] != enclave.replace("/", "%"):
                return None
            announced.add(
                (token[1], _RIGHTS_BY_TOKEN_KIND[token[2]], (token[4] or "").replace("%", "/"))
            )
    return announced


def _allowed_announcements(
    stated_rights: Mapping[int, Sequence[StatedRight]],
) -> set[tuple[str, str, str]]:
    """Return the announcements that rights without wildcards allow, as `_announced_names` does."""
    return {(str(domain), "", "") for domain in stated_rights} | {
        (str(domain), right, name)
        for domain, rights in stated_rights.items()
        for (_, _, right, name), _ in rights
    }


def _example_nodes(enclave: str, control: AccessControl) -> set[tuple[str, ...]]:
    """Return nodes that rules let an enclave announce: one example for each wildcard.

    A node is a tuple of the three parts of a graph token that name it.

    The result is empty if the rights of the enclave deny all its nodes.
    """
    announcing = (enclave, Flow.INGRESS, Message.LIVELINESS_TOKEN)
    nodes = [
        key
        for key in control.passing(*announcing).all
        if key.startswith("@ros2_lv/") and "/NN/" in key
    ]
    if denied := [key for key in control.denied(*announcing).all if key.split("/")[5] == "*"]:
        gone = names_of(denied)
        tokens = [token for key in nodes if (token := (names_of([key]) - gone).example())]
    else:
        tokens = [key.replace("$*", "a").replace("*", "a") for key in nodes]
    return {tuple(token.split("/")[6:9]) for token in tokens}


def _example_names(name: str) -> Iterable[str]:
    if not is_expression(name):
        return (name,)
    if not name.startswith("/") or "?" in name or "[" in name:
        return ()
    return (name.replace("*", "a"), name.replace("*", "a/b"))


# ── files ──────────────────────────────────────────────────────────────────────────────────


def _present_file(keystore: OpenedKeystore, path: str) -> bytes | None:
    if not os.path.lexists(keystore.root / path):
        return None
    try:
        return keystore.read(path, "Zenoh configuration")
    except SrosError:
        return None


def stale_files(
    root: Path, wanted_paths: Collection[str], names: Iterable[str]
) -> Iterable[DriftedConfiguration]:
    """Yield the configurations of the enclaves ``names`` that should not exist."""
    for name in names:
        for path in (_router_path(name), _session_path(name)):
            if path in wanted_paths:
                continue
            if (root / signed_path(path)).is_file():
                yield DriftedConfiguration(name, path, Drift.STALE)
            elif os.path.lexists(root / path):
                yield DriftedConfiguration(name, path, Drift.FOREIGN)


def router_enclaves(keystore: OpenedKeystore, now: datetime) -> frozenset[str]:
    """Return the enclaves of Zenoh routers, by the settings; in an export, by its signed files."""
    if settings := keystore.settings:
        return frozenset(settings.zenoh.router_names() if settings.zenoh else ())
    return frozenset(
        name
        for name in keystore.names
        if os.path.lexists(keystore.folder(name) / ROUTER_FILE)
        and _has_router_file(keystore, name, now)
    )


def _has_router_file(keystore: OpenedKeystore, name: str, now: datetime) -> bool:
    zenoh = open_zenoh(keystore.folder(name), name, keystore.enclave(name, now=now))
    return ROUTER_FILE in zenoh.configurations and not zenoh.problems


def _router_path(name: str) -> str:
    return f"{enclave_folder(name)}/{ROUTER_FILE}"


def _session_path(name: str) -> str:
    return f"{enclave_folder(name)}/{SESSION_FILE}"


def signed_path(path: str) -> str:
    """Return the path of the signed document next to a configuration."""
    folder, _, file = path.rpartition("/")
    return f"{folder}/{ZENOH_SIGNED[file]}"
