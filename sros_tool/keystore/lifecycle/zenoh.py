"""Zenoh configurations of a keystore's enclaves, made from policies: the only writer of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from shlex import quote

from cryptography import x509

from sros_tool.errors import KeystoreError, Note, PolicyError, SrosError, UsageError
from sros_tool.keystore.authorities.authority import Authority, check_meaning, load_authority
from sros_tool.keystore.authorities.keyring import IN_KEYSTORE, Keyring
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    PERMISSIONS,
    ROUTER_FILE,
    SESSION_FILE,
    ZENOH_SIGNED,
    check_keystore,
    enclave_folder,
    enclave_names,
    enclave_path,
)
from sros_tool.keystore.ledger import read_ledger
from sros_tool.keystore.lifecycle.create import rights_by_enclave
from sros_tool.keystore.missing import no_such_enclave
from sros_tool.keystore.reader import (
    load_ca_certificate,
    load_settings,
    open_enclave,
    read_certificate,
)
from sros_tool.keystore.transaction.recovery import tidy
from sros_tool.keystore.transaction.stage import Change
from sros_tool.keystore.transaction.transaction import Transaction
from sros_tool.names import is_expression
from sros_tool.pki import smime
from sros_tool.pki.certificates import common_name_of
from sros_tool.policy.model import Enclave, Policy
from sros_tool.policy.rights import KIND_OF, Rules, compare
from sros_tool.translate import grant_rights
from sros_tool.translate_zenoh import (
    control_of_router,
    control_of_session,
    remote_rights,
    stated_rights,
)
from sros_tool.validity import iso
from sros_tool.xml import read_bytes
from sros_tool.zenoh.access import AccessControl, Flow, Message, RemoteRights
from sros_tool.zenoh.configuration import Configuration, Mode

_ANY_PORT_HERE = "tls/localhost:0"
"""Where sessions listen for direct connections, as those of rmw_zenoh do: on their own host."""


@dataclass(frozen=True, slots=True)
class ZenohNetwork:
    """The choices for a network of Zenoh processes.

    ``router`` is the enclave of the router, which listens at ``endpoint`` (``HOST:PORT``);
    ``mode`` is that of the sessions, peer or client; ``domain`` the ROS domain.
    """

    router: str
    endpoint: str
    mode: Mode
    domain: int


@dataclass(frozen=True, slots=True)
class ZenohFiles:
    """The result of writing Zenoh configurations; with ``dry_run``, the result it would have.

    ``files`` maps the enclaves to their files, relative to ``folder``.  ``restart`` are the
    enclaves whose processes have to be restarted, because their rules changed.
    """

    folder: Path
    files: Mapping[str, str]
    changes: tuple[Change, ...]
    restart: tuple[str, ...]
    notes: tuple[Note, ...]


def write_zenoh_files(
    root: Path,
    policies: Sequence[Policy],
    network: ZenohNetwork,
    *,
    now: datetime,
    output: Path | None = None,
    keyring: Keyring = IN_KEYSTORE,
    dry_run: bool = False,
) -> ZenohFiles:
    """Write the configuration of the router and of every enclave of the policies: all or none.

    Files that are as they would be written, with a valid signature, stay as they are; those of
    enclaves that no policy states any more are removed.  They go into the enclaves of the keystore
    ``root``, or into the same places of the folder ``output``.

    Raises:
        KeystoreError: an enclave is missing, or its signed permissions are not those of the policy.
        PolicyError: a policy states what Zenoh cannot enforce.
        UsageError: the router's enclave has rights of its own.
    """
    if not dry_run:
        tidy(root)
    check_keystore(root)
    stated = _stated(root, policies, network.router, now)
    documents = _documents(stated, network)
    folder = output or root
    certificate = load_ca_certificate(root, PERMISSIONS)
    outdated = {
        path: document
        for path, document in documents.items()
        if not _is_current(folder / path, document, certificate)
    }
    stale = _stale(root, folder, documents)
    authority = None
    if outdated and not dry_run:
        authority = load_authority(root, PERMISSIONS, load_settings(root), keyring, now)
    with Transaction(folder, fresh=output is not None, dry_run=dry_run) as transaction:
        for path, document in outdated.items():
            transaction.write(path, document)
            transaction.write(_signed_path(path), _signed(authority, document))
        for path in stale:
            transaction.remove(path)
            transaction.remove(_signed_path(path))
        transaction.commit()
        changes = tuple(transaction.changes)
    names = {_router_path(network.router): network.router}
    names |= {_session_path(name): name for name in stated}
    without = {path: name for name in enclave_names(root) for path in _paths(name) if path in stale}
    return ZenohFiles(
        folder,
        {names[path]: path for path in documents},
        changes,
        tuple(sorted({names[path] for path in outdated} | set(without.values()))),
        (*_notes(root, stated, network), *_revoked_names(root, (*stated, network.router), now)),
    )


def _stated(
    root: Path, policies: Sequence[Policy], router: str, now: datetime
) -> dict[str, Enclave]:
    """Return the enclaves of the policies by name, all of which the keystore has."""
    stated = {name: each for name, each in rights_by_enclave((), policies).items() if each}
    if not stated:
        raise PolicyError("the policies have no enclaves", "", "Name a policy with an enclave.")
    if router in stated:
        raise UsageError(
            f"the enclave {router} of the router has rights in a policy",
            "The router passes on what all others say, so it would have the rights of all.",
            "Give the router an enclave of its own, and name it with --router.",
        )
    existing = set(enclave_names(root))
    for name in (router, *stated):
        if name not in existing:
            raise no_such_enclave(root, name, existing)
        subject = read_certificate(enclave_path(root, name) / CERTIFICATE_FILE).subject
        if common_name_of(subject) != name:
            raise KeystoreError(
                f"the certificate of enclave {name} has the common name "
                f"{common_name_of(subject) or '(none)'!r}",
                "Zenoh knows a process by the common name of its certificate.",
                f"Renew it: `sros renew {quote(str(root))} {name}`.",
            )
    for name, enclave in stated.items():
        _check_permissions(root, name, enclave, now)
    return dict(sorted(stated.items()))


def _check_permissions(root: Path, name: str, enclave: Enclave, now: datetime) -> None:
    """Raise `KeystoreError` unless the signed permissions give the rights of the policy."""
    grant = open_enclave(enclave_path(root, name), now=now).grant
    signed = grant_rights(name, grant) if grant else frozenset()
    different = compare(signed, (each.right for each in stated_rights(enclave)))
    if different:
        sign, first = different.lines()[0]
        side = "permissions" if sign == "-" else "policy"
        raise KeystoreError(
            f"the permissions of enclave {name} are not those of the policy",
            f"Only the {side} has: {first.qualifier} {first.describe()}. DDS and Zenoh would "
            "enforce different rights.",
            f"Run `sros generate_artifacts -k {quote(str(root))} -p "
            f"{quote(enclave.source.file or 'POLICY')}` first.",
        )


def _documents(stated: Mapping[str, Enclave], network: ZenohNetwork) -> dict[str, bytes]:
    """Return the configurations by their paths in a keystore."""
    remotes = {name: remote_rights(each, network.domain) for name, each in stated.items()}
    _prove(stated, remotes, network.domain)
    endpoint = f"tls/{network.endpoint}"
    router = Configuration(Mode.ROUTER, (endpoint,), (), control_of_router(remotes))
    documents = {_router_path(network.router): router.render()}
    direct = network.mode is Mode.PEER
    for name in stated:
        control = control_of_session(name, network.router, remotes, direct=direct)
        listen = (_ANY_PORT_HERE,) if direct else ()
        session = Configuration(network.mode, listen, (endpoint,), control)
        documents[_session_path(name)] = session.render()
    return documents


def _stale(root: Path, folder: Path, documents: Mapping[str, bytes]) -> list[str]:
    """Return the files that sros made for enclaves that no policy states any more."""
    return [
        path
        for name in enclave_names(root)
        for path in _paths(name)
        if path not in documents
        and (folder / path).is_file()
        and (folder / _signed_path(path)).is_file()
    ]


def _paths(name: str) -> tuple[str, str]:
    return _router_path(name), _session_path(name)


def _router_path(name: str) -> str:
    return f"{enclave_folder(name)}/{ROUTER_FILE}"


def _session_path(name: str) -> str:
    return f"{enclave_folder(name)}/{SESSION_FILE}"


def _signed_path(path: str) -> str:
    folder, _, file = path.rpartition("/")
    return f"{folder}/{ZENOH_SIGNED[file]}"


def _signed(authority: Authority | None, document: bytes) -> bytes:
    return authority.sign(document, "a Zenoh configuration") if authority else b""


def _is_current(path: Path, document: bytes, authority: x509.Certificate) -> bool:
    """Return whether a file has this content, and is signed next to it."""
    try:
        if read_bytes(path, "Zenoh configuration") != document:
            return False
        signed = smime.parse(read_bytes(path.with_name(ZENOH_SIGNED[path.name]), "signed document"))
        signed.verify(authority)
    except SrosError:
        return False
    return signed.document.replace(b"\r\n", b"\n") == document


def _notes(root: Path, stated: Mapping[str, Enclave], network: ZenohNetwork) -> tuple[Note, ...]:
    others = [each for each in enclave_names(root) if each not in stated and each != network.router]
    if not others:
        return ()
    named = ", ".join(others[:5]) + (" ..." if len(others) > 5 else "")
    return (
        Note(
            "zenoh.without-policy",
            f"no policy states what {named} may do on Zenoh: these enclaves get no file, and the "
            "others deny them everything.",
        ),
    )


def _revoked_names(root: Path, names: Sequence[str], now: datetime) -> tuple[Note, ...]:
    """Return a note on names that revoked certificates have, too, until they expire."""
    entries = read_ledger(root).entries
    revoked = {each.serial for each in entries if each.what == "revocation"}
    again = sorted(
        {
            each.enclave
            for each in entries
            if each.what == "certificate"
            and each.serial in revoked
            and each.enclave in names
            and each.not_after >= iso(now)
        }
    )
    if not again:
        return ()
    return (
        Note(
            "zenoh.revoked-name",
            f"a revoked certificate of {', '.join(again)} has not expired: Zenoh has no revocation "
            "list, and gives whoever has it the rights of that enclave. Give the enclave another "
            "name, or replace the identity CA with `sros rotate_ca`.",
        ),
    )


# ── the proof ──────────────────────────────────────────────────────────────────────────────

_PROOF = {
    "publish": (Flow.INGRESS, Message.PUT),
    "subscribe": (Flow.EGRESS, Message.PUT),
    "request": (Flow.INGRESS, Message.QUERY),
    "reply": (Flow.EGRESS, Message.QUERY),
}
"""The message that is the use of each right; on purpose not taken from the translation."""


def _prove(stated: Mapping[str, Enclave], remotes: Mapping[str, RemoteRights], domain: int) -> None:
    """Raise `PkiError` if the rules decide otherwise than the policy about a name that it has.

    Every enclave is asked about its own names, and one with wildcards about those of all others.
    """
    rights = {
        name: [each.right for each in stated_rights(enclave)] for name, enclave in stated.items()
    }
    names = {
        name: {(KIND_OF[e.right], e.name) for e in of if not is_expression(e.name)}
        for name, of in rights.items()
    }
    everything = set().union(*names.values())
    for enclave, of in rights.items():
        rules = Rules(of)
        control = AccessControl((remotes[enclave],))
        wild = any(is_expression(each.name) for each in of)
        for kind, name in sorted(everything if wild else names[enclave]):
            for right, (flow, message) in _PROOF.items():
                if KIND_OF[right] == kind:
                    key = f"{domain}{name}/type/hash"
                    check_meaning(
                        control.allows(enclave, flow, message, key),
                        rules.allow(enclave, right, name),
                        f"the right of {enclave} to {right} {name}",
                    )
