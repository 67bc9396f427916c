"""The environment, container definition or systemd units of an enclave, checked to be loadable."""

from __future__ import annotations

import hashlib
import os
import stat
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from itertools import islice
from pathlib import Path, PurePosixPath
from shlex import quote
from typing import TYPE_CHECKING

from sros_tool.errors import KeystoreError, Note, UsageError
from sros_tool.faults import KEY_MADE_ON_ROBOT
from sros_tool.keystore.layout import PERMISSIONS_FILE, is_original_keystore, remedy_in_keystore
from sros_tool.keystore.reader import read_consistently
from sros_tool.owners import (
    closing_command,
    link_of_stranger,
    other_writers_clause,
    steps_to,
    user_name,
)
from sros_tool.wording import capitalized, first_few

if TYPE_CHECKING:
    from datetime import datetime, tzinfo

    from sros_tool.dds.decision.vendors import Vendor
    from sros_tool.dds.domains import DomainSet
    from sros_tool.keystore.participant import JoinContext
    from sros_tool.keystore.reader import OpenedEnclave, OpenedKeystore
    from sros_tool.keystore.zenoh_files import OpenedZenoh
    from sros_tool.pki.token import TokenUri
    from sros_tool.policy.model import Policy
    from sros_tool.policy.rights import NodeName
    from sros_tool.zenoh.configuration import Configuration

RMWS = (
    "rmw_connextdds",
    "rmw_cyclonedds_cpp",
    "rmw_fastrtps_cpp",
    "rmw_fastrtps_dynamic_cpp",
    "rmw_zenoh_cpp",
)
"""The RMWs that ``--rmw`` takes: those that enforce security with the files of an enclave."""


@dataclass(frozen=True, slots=True)
class EnclaveEnvironment:
    """The environment variables of an enclave, and notes on them.

    ``enclave_notes`` are for nodes that are not started with ``--ros-args --enclave``.
    ``needs_pin``: the key is on a token, and only an environment variable can give its PIN.
    """

    variables: dict[str, str]
    notes: tuple[Note, ...] = ()
    enclave_notes: tuple[Note, ...] = ()
    needs_pin: bool = False


@read_consistently
def loadable_environment(
    keystore: OpenedKeystore,
    name: str,
    domain_text: str | None = None,
    rmw: str | None = None,
    *,
    environment: Mapping[str, str],
    now: datetime,
    zone: tzinfo,
    accept_key: bool | None = None,
    target: Path | None = None,
) -> EnclaveEnvironment:
    """Return the environment of an enclave after checking that a process can run in it.

    Args:
        keystore: the opened keystore, or an export of it.
        name: the enclave.
        domain_text: the value of --domain; None stands for $ROS_DOMAIN_ID.
        rmw: the value of --rmw; None stands for $RMW_IMPLEMENTATION.
        environment: the variables of the process as they are.
        now: the current time.
        zone: the time zone of this machine.
        accept_key: accept a private key, or the PIN of its token, that other users can read; None
            if the verb has no option for this.
        target: the absolute path of the keystore where the process will run; None stands for this
            machine. A key that was made on the other machine need not be on this one.

    Raises:
        UsageError: the domain, the RMW or the enclave's name is invalid.
        KeystoreError: the enclave does not exist, a process cannot run in it, or other users can
            read its private key.
    """
    from sros_tool.distributions import unknown_distribution_notes
    from sros_tool.keystore.known_keys import other_enclave
    from sros_tool.keystore.layout import KEY_FILE, enclave_path
    from sros_tool.keystore.participant import JoinContext
    from sros_tool.keystore.selection import missing_enclave_error
    from sros_tool.names import check_enclave_name
    from sros_tool.pki.token import MODULE_VARIABLE, pin_notes
    from sros_tool.runtime.environment import REFUSING_ZENOH, RMW_ZENOH, secured_environment
    from sros_tool.runtime.rmw import (
        RMW,
        chosen_rmw,
        rmw_implementations,
        shipped_vendor,
        vendor_here,
        vendor_of,
    )
    from sros_tool.runtime.variables import DOMAIN, domain_from

    if domain_text == "":
        raise UsageError("--domain is empty", "", "Name a domain, or leave the option out.")
    wanted = domain_from(environment if domain_text is None else {DOMAIN: domain_text})
    used = chosen_rmw(rmw, environment)
    with_zenoh = _uses_zenoh(rmw, used)
    if with_zenoh and not target:
        _check_release(environment)
    check_enclave_name(name)
    keystore.check()
    if not keystore.has_enclave(name):
        raise missing_enclave_error(keystore, name, keystore.names)
    folder = keystore.folder(name)
    state = keystore.enclave(name, now=now)
    domains, joined = state.domains(), state.joined_domains()
    zenoh = _opened_zenoh(keystore, name, state, now) if with_zenoh and not state.token else None
    if zenoh and joined:
        wanted = _zenoh_domain(keystore, zenoh, wanted, joined)
    domain = _choose_domain(domains, joined, wanted, keystore) if domains and joined else 0
    state = keystore.enclave(name, now=now, domain=domain)
    if not with_zenoh:
        vendor = vendor_of(used) if target else shipped_vendor(used, environment)
        state = _with_join_faults(name, folder, state, vendor, JoinContext(domain, now, zone))
    problems = state.problems_in_keystore if target else state.problems
    if problems:
        from sros_tool.explain.explanation import remedy

        root = keystore.root
        remedies = [remedy(problem.fault, str(root), name, problem.file) for problem in problems]
        raise KeystoreError(
            f"a process cannot run in enclave {name}",
            "; ".join(str(problem).rstrip(".") for problem in problems) + ".",
            " ".join(dict.fromkeys(filter(None, remedies))),
        )
    how_to_accept = "" if accept_key is None else _ACCEPT_ADVICE
    if state.token:
        _check_rmw_reads_tokens(state.token, name, used)
        if not (accept_key or target):
            _check_pin(state.token, name, how_to_accept)
    elif not accept_key and not (target and state.key_on_robot):
        _refuse_key_readable_by_others(folder / KEY_FILE, keystore, name, how_to_accept)
    if not target:
        if not accept_key:
            _refuse_folders_writable_by_others(keystore, folder, name, how_to_accept)
        if not zenoh:
            vendor = shipped_vendor(used, environment) or vendor_here(environment)[0]
            _check_dates_here(name, keystore, vendor, JoinContext(domain, now, zone))
    variables = secured_environment(target or keystore.root, name, domain)
    if zenoh:
        place = enclave_path(target or keystore.root, name)
        enclave_environment = _zenoh_environment(place, name, zenoh, variables, environment)
        return (
            replace(enclave_environment, notes=()) if target else enclave_environment
        )  # the notes are about this process
    if (target and not rmw) or RMW_ZENOH in rmw_implementations(environment):
        # If Zenoh is chosen later, such as in a launch file, no node starts.
        variables |= REFUSING_ZENOH
    if rmw:
        variables[RMW] = rmw
    notes = () if target else tuple(unknown_distribution_notes(environment))
    if state.certificate and (other := other_enclave(keystore, name, state.certificate)):
        text = (
            f"a process in enclave {name} has the rights of {other}, because the folder of {name} "
            f"has the files of {other}. See `sros check {quote(str(keystore.root))}`."
        )
        notes += (Note("env.other-enclave", text),)
    if wanted is None and any(other_domain != domain for other_domain in joined or ()):
        text = (
            f"a process in enclave {name} may run in any of the domains {joined}, and runs in "
            f"{domain}: for another domain, add --domain ID."
        )
        notes += (Note("env.several-domains", text),)
    if not state.token:
        return EnclaveEnvironment(variables, notes)
    # Only the module that the user names for this process is passed on, because loading it runs its
    # code.
    module = environment.get(MODULE_VARIABLE)
    if module and not target:
        variables[MODULE_VARIABLE] = module
    notes += (_missing_token_note(name, state.token),) if target else tuple(pin_notes(state.token))
    return EnclaveEnvironment(variables, notes, needs_pin=not state.token.pin_source)


_ACCEPT_ADVICE = " To run the process nevertheless, add --accept-readable-key."


def _refuse_key_readable_by_others(
    key: Path, keystore: OpenedKeystore, enclave: str, how_to_accept: str
) -> None:
    """Raise `KeystoreError` if users other than the owner can read the enclave's private key."""
    mode = stat.S_IMODE(key.stat().st_mode)
    if mode & 0o077:
        renew = f"`sros renew KEYSTORE {enclave} --new-key --revoke-old`."
        on_robot = "" if is_original_keystore(keystore.root) else KEY_MADE_ON_ROBOT
        raise KeystoreError(
            f"others can read the private key of enclave {enclave}",
            f"The mode of '{key}' is {mode:04o}: whoever has read the key can act as the enclave.",
            f"Run `chmod 600 {quote(str(key))}`. If others had access, give the enclave another "
            f"key. {remedy_in_keystore(keystore.root, renew)}{on_robot}{how_to_accept}",
        )


def _refuse_folders_writable_by_others(
    keystore: OpenedKeystore, folder: Path, enclave: str, how_to_accept: str
) -> None:
    """Raise `KeystoreError` if other users can replace the enclave's folders."""
    users = frozenset({0, os.geteuid()})
    trusted = users | {keystore.root.stat().st_uid}
    reasons = [
        (path, other_writers_clause(path.stat(), trusted), trusted)
        for path in (folder, *folder.parents)
        if path.is_relative_to(keystore.root)
    ]
    if link := link_of_stranger(steps_to(folder), users):  # it may lead to a keystore of this user
        reasons.append((link, f"it is a link of {user_name(link.lstat().st_uid)}", users))
    for path, why, allowed in reasons:
        if why:
            raise KeystoreError(
                f"others can replace the files of enclave {enclave}",
                f"'{path}': {why}. Whoever replaces files decides whom the process trusts.",
                f"Run `{closing_command(path, allowed)}`, then `sros verify "
                f"{quote(str(keystore.root))}`.{how_to_accept}",
            )


def _with_join_faults(
    enclave: str, folder: Path, state: OpenedEnclave, vendor: Vendor | None, context: JoinContext
) -> OpenedEnclave:
    """Return an enclave with its faults for a DDS vendor; for all vendors if ``vendor`` is None.

    Raises:
        KeystoreError: each of these vendors refuses the enclave for a reason that is not a fault of
            the enclave.
    """
    from sros_tool.dds.decision.vendors import TESTED
    from sros_tool.faults import Fault
    from sros_tool.keystore.participant import evaluate_enclave

    vendors = (vendor,) if vendor else TESTED
    evaluation = evaluate_enclave(
        enclave, folder, state, moment=context.at, domain=context.domain, vendors=vendors
    )
    # `_check_rmw_reads_tokens` says that a vendor reads no token.
    refusals = evaluation.refusal_sentences(ignored=(Fault.KEY_ON_TOKEN.id,))
    if evaluation.state.problems or not refusals:
        return evaluation.state
    raise KeystoreError(
        f"a process cannot run in enclave {enclave}",
        refusals,
        f"See `sros check {quote(str(folder))}`.",
    )


def _check_dates_here(
    name: str, keystore: OpenedKeystore, vendor: Vendor, context: JoinContext
) -> None:
    """Raise `KeystoreError` if the local time zone makes DDS see valid permissions as expired.

    Fast DDS reads their dates, which are in UTC, as local time.
    """
    from sros_tool.explain.answer import Evaluator, ask
    from sros_tool.keystore.participant import load_enclave_of
    from sros_tool.keystore.settings import lengthening_remedy

    if not context.zone.utcoffset(context.at.replace(tzinfo=None)):
        return
    enclave = load_enclave_of(keystore, name, moment=context.at)
    answer = Evaluator(vendor, enclave, context).answer(ask("join"))
    if not answer.allowed and answer.decision.reason in ("expired", "not-yet-valid"):
        raise KeystoreError(
            f"a process cannot run in enclave {name} in this time zone",
            f"{answer.decision.text.removesuffix('.')}.",
            "Set the time zone of the process to UTC (`TZ=UTC`), or renew the enclave (`sros renew "
            f"KEYSTORE {quote(name)}`). {lengthening_remedy(keystore.settings, name)}".rstrip(),
        )


# ── keys on tokens ─────────────────────────────────────────────────────────────────────────


def _missing_token_note(enclave: str, token_uri: TokenUri) -> Note:
    pin = f"the PIN in '{token_uri.pin_source}'" if token_uri.pin_source else "the PIN"
    return Note(
        "token.there",
        f"the key of {enclave} is on the token {token_uri.token!r}: the process needs the device "
        f"or socket of this token, the token's PKCS #11 module, and {pin}. This output contains "
        "none of them.",
    )


def _check_rmw_reads_tokens(token_uri: TokenUri, enclave: str, rmw: str) -> None:
    """Raise `KeystoreError` if the key is on a token and the RMW reads keys only from files."""
    from sros_tool.runtime.rmw import vendor_of

    vendor = vendor_of(rmw)
    if rmw and not (vendor and vendor.traits.reads_tokens):
        raise KeystoreError(
            f"a process of {rmw} cannot run in enclave {enclave}",
            f"The key of the enclave is on the token {token_uri.token!r}, but {rmw} reads keys "
            "only from key.pem.",
            "Use rmw_fastrtps_cpp of ROS 2 Jazzy or later, or an enclave with a key in a file.",
        )


def _check_pin(token_uri: TokenUri, enclave: str, how_to_accept: str) -> None:
    """Raise `KeystoreError` if other users can read a token's PIN file, or this user cannot."""
    from sros_tool.pki.token import pin_file_problem

    if problem := pin_file_problem(token_uri):
        raise KeystoreError(
            f"the PIN for the key of enclave {enclave} is missing or not protected",
            f"{capitalized(problem)}.",
            how_to_accept.lstrip(),
        )


# ── Zenoh ──────────────────────────────────────────────────────────────────────────────────


def _uses_zenoh(named: str | None, rmw: str) -> bool:
    """Return whether a process with the RMW ``rmw`` uses Zenoh.

    ``named`` is the RMW that the user named with --rmw; None if the environment chose ``rmw``.

    Raises:
        UsageError: the process would use an RMW that sros does not know to enforce security.
    """
    from sros_tool.runtime.environment import RMW_ZENOH
    from sros_tool.runtime.rmw import RMW, vendor_of

    if named is not None and named not in RMWS:
        raise UsageError(
            f"--rmw {named!r} is not an RMW that is known to enforce security",
            "",
            f"Choose one of {', '.join(RMWS)}.",
        )
    if rmw == RMW_ZENOH:
        return True
    if rmw and not vendor_of(rmw):
        raise UsageError(
            f"the process would use {rmw!r}, which is not an RMW that is known to enforce security",
            "",
            f"Set {RMW} to another RMW, or name one of {', '.join(RMWS)} with --rmw.",
        )
    return False


def _check_release(environment: Mapping[str, str]) -> None:
    """Raise `UsageError` if the rmw_zenoh of this machine is too old for an enclave's files."""
    from sros_tool.runtime.environment import RMW_ZENOH
    from sros_tool.runtime.rmw import package_version
    from sros_tool.zenoh.releases import release_of, version_text, why_too_old

    version = package_version(RMW_ZENOH, environment)
    if version and (why := why_too_old(version)):
        raise UsageError(
            f"{RMW_ZENOH} {version_text(version)} cannot run in an enclave",
            why,
            f"Install {RMW_ZENOH} {version_text(release_of(version).least)} or later.",
        )


def _opened_zenoh(
    keystore: OpenedKeystore, enclave: str, state: OpenedEnclave, now: datetime
) -> OpenedZenoh:
    """Return the Zenoh configurations of an enclave.

    Raises:
        KeystoreError: the enclave has no configuration, or the signature of a configuration is not
            valid, or a configuration does not state the rights in the permissions.
    """
    from sros_tool.keystore.layout import PUBLIC
    from sros_tool.keystore.zenoh_files import ZenohFault, open_zenoh

    root, opened_zenoh = keystore.root, open_zenoh(keystore.folder(enclave), enclave, state)
    if not opened_zenoh.problems:
        _refuse_outdated(keystore, enclave, now)
        return opened_zenoh
    write = f"`sros zenoh {quote(str(root))}`"
    if not (root / PUBLIC).is_dir():
        write = "`sros zenoh KEYSTORE` where the CA keys are, and export the enclave again"
    if opened_zenoh.problems[0].fault is ZenohFault.MISSING and not opened_zenoh.files:
        raise KeystoreError(
            f"enclave {enclave} has no configuration for rmw_zenoh_cpp",
            "rmw_zenoh_cpp ignores ROS_SECURITY_*: without session.json5 the process would run "
            "unsecured.",
            f"Write it: {write}. For DDS, name another RMW with --rmw.",
        )
    raise KeystoreError(
        f"a process of rmw_zenoh_cpp cannot run in enclave {enclave}",
        "; ".join(map(str, opened_zenoh.problems)) + ".",
        f"Write the files again: {write}.",
    )


def _refuse_outdated(keystore: OpenedKeystore, enclave: str, now: datetime) -> None:
    """Raise `KeystoreError` if the enclave's Zenoh file lacks current rights of other enclaves.

    A router, and a session in peer mode, enforces the rights of other enclaves: an outdated file,
    though validly signed, would enforce outdated rights.  An export cannot be checked for this.
    """
    from sros_tool.keystore.layout import PERMISSIONS, SETTINGS
    from sros_tool.keystore.zenoh_files import zenoh_drift
    from sros_tool.zenoh.configuration import Mode

    if not keystore.has(SETTINGS):
        return
    network = keystore.settings.zenoh if keystore.settings else None
    if network is None or (enclave not in network.router_names() and network.mode is Mode.CLIENT):
        return
    authority = keystore.ca_certificate(PERMISSIONS)

    def has_drifted(moment: datetime | None) -> bool:
        drift = zenoh_drift(keystore, network, keystore.domains, authority, moment)
        return any(file.enclave == enclave for file in drift.files)

    # Differences that only come from expired permissions of other enclaves do not count.
    if has_drifted(now) and has_drifted(None):
        where = quote(str(keystore.root))
        raise KeystoreError(
            f"the Zenoh configuration of enclave {enclave} does not match the keystore",
            "For other enclaves, it has rights that differ from their permissions.",
            f"Run `sros zenoh {where}`, and restart the processes that this command names.",
        )


def _choose_domain(
    domains: DomainSet, joined: DomainSet, wanted_domain: int | None, keystore: OpenedKeystore
) -> int:
    """Return the ROS domain for a process: ``wanted_domain``, or a default.

    ``wanted_domain`` comes from an option or ROS_DOMAIN_ID, ``domains`` are the domains of the
    keystore, and ``joined`` the domains that the enclave may join. The default is domain 0, as in
    ROS, if the enclave may join domain 0, or else the first domain of the enclave.

    Raises:
        KeystoreError: the keystore is not for ``wanted_domain``.
    """
    from sros_tool.keystore.layout import how_to_add_domains

    if wanted_domain is None:
        return joined.preferred()
    if wanted_domain in domains:
        return wanted_domain
    raise KeystoreError(
        f"keystore '{keystore.root}' is for domain {domains}, not for {wanted_domain}",
        "DDS would refuse the node.",
        f"Set ROS_DOMAIN_ID to {joined.preferred()}, or "
        f"{how_to_add_domains(keystore.root, f'{domains},{wanted_domain}')}.",
    )


def _zenoh_domain(
    keystore: OpenedKeystore, zenoh: OpenedZenoh, wanted_domain: int | None, domains: DomainSet
) -> int | None:
    """Return the ROS domain that the Zenoh configuration of a process has to name.

    Without ``wanted_domain``, the result is preferably one of ``domains``.

    If the configuration names no domain, the result is ``wanted_domain``, which may be None.

    Raises:
        KeystoreError: the configuration is not for ``wanted_domain``.
    """
    own = zenoh.domains()
    if not own:
        return wanted_domain
    if wanted_domain is None:
        return next((own_domain for own_domain in own if own_domain in domains), own[0])
    if wanted_domain not in own:
        raise KeystoreError(
            f"the Zenoh configuration is for domain {', '.join(map(str, own))}, not for "
            f"{wanted_domain}",
            "Its rules deny everything in any other domain.",
            f"Set ROS_DOMAIN_ID to {own[0]}, or write the files for more domains. "
            f"{remedy_in_keystore(keystore.root, '`sros zenoh KEYSTORE --domain ID`.')}",
        )
    return wanted_domain


def _zenoh_environment(
    folder: Path,
    enclave: str,
    zenoh: OpenedZenoh,
    variables: dict[str, str],
    environment: Mapping[str, str],
) -> EnclaveEnvironment:
    from sros_tool.keystore.layout import (
        CERTIFICATE_FILE,
        IDENTITY_CA_FILE,
        KEY_FILE,
        ROUTER_FILE,
        SESSION_FILE,
    )
    from sros_tool.runtime.environment import (
        RMW_ZENOH,
        ROUTER_URI,
        SESSION_URI,
        replaced_notes,
        zenoh_environment,
    )
    from sros_tool.runtime.rmw import package_version
    from sros_tool.zenoh.releases import release_of

    place = folder.absolute()
    uris = {SESSION_URI: SESSION_FILE, ROUTER_URI: ROUTER_FILE}
    variables |= zenoh_environment(
        {uri: str(place / file) for uri, file in uris.items() if file in zenoh.configurations},
        place / IDENTITY_CA_FILE,
        place / CERTIFICATE_FILE,
        place / KEY_FILE,
    )
    needed: tuple[Note, ...] = ()
    if SESSION_FILE in zenoh.configurations:
        version = package_version(RMW_ZENOH, environment)
        by_graph = version and release_of(version).below_topics
        images = ", and send it no images" if by_graph else ""
        text = (
            f"start every node with `--ros-args --enclave {enclave}`: if a node on Zenoh names "
            "another enclave or none, other nodes drop its graph token, and do not find its "
            f"topics and services{images}."
        )
        needed = (Note("zenoh.enclave-argument", text),)
    notes = (
        *replaced_notes(environment, variables),
        *_router_notes(zenoh.configurations.get(SESSION_FILE)),
    )
    return EnclaveEnvironment(variables, notes, needed)


def _router_notes(session: Configuration | None) -> Iterator[Note]:
    """Yield a note if a session connects to a router of this machine that does not run.

    A client waits for the router without any output.  A peer of rmw_zenoh starts, and itself
    reports the missing router.
    """
    from sros_tool.zenoh.configuration import Mode

    if session is None or session.mode is not Mode.CLIENT:
        return
    endpoints = [endpoint.rpartition("/")[2] for endpoint in session.connect]
    addresses = [endpoint.rpartition(":") for endpoint in endpoints]
    if any(host not in _THIS_MACHINE or _listens_here(int(port)) for host, _, port in addresses):
        return
    router = session.access_control.remotes[0].common_name if session.access_control.remotes else ""
    yield Note(
        "zenoh.no-router",
        f"nothing listens at {', '.join(endpoints)}, the endpoint of the router {router}: a node "
        "waits for the router, without any output. Start the router in its own enclave.",
    )


_THIS_MACHINE = ("localhost", "127.0.0.1", "[::1]")
_LISTENING = "0A"
"""The state of a listening socket in the kernel's tables of TCP sockets."""


def _listens_here(port: int) -> bool:
    """Return whether a TCP port of this machine has a listener; True if that is unknown.

    No connection is made, because a dropped connection pauses the listener of a router.
    """
    listening: set[int] = set()
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        try:
            with open(table, encoding="ascii") as lines:
                sockets = [line.split() for line in lines][1:]
        except FileNotFoundError:  # for example, without IPv6
            continue
        except (OSError, ValueError):
            return True
        listening |= {
            int(local.rpartition(":")[2], 16)
            for _, local, _, state, *_ in sockets
            if state == _LISTENING
        }
    return port in listening


# ── containers ─────────────────────────────────────────────────────────────────────────────

INSTALLED = "/etc/sros/keystore"
"""Where a robot or a container has its keystore, unless another path is named."""


def target_path(text: str) -> Path:
    """Parse the absolute path of a keystore on another machine.

    Raises:
        UsageError: the path is not absolute, or not in its shortest form.
    """
    path = PurePosixPath(text)
    if not path.is_absolute() or ".." in path.parts or str(path) != text or text.startswith("//"):
        raise UsageError(
            f"--target {text!r} is not the path of a keystore on another machine",
            "The path must be absolute, and have no '..', no '//' and no '/' at the end.",
            f"Write for example {INSTALLED}.",
        )
    return Path(text)


def container_text(
    keystore: OpenedKeystore,
    enclave: str,
    form: str,
    *,
    target: Path,
    variables: Mapping[str, str],
    name: str,
    image: str,
    now: datetime,
) -> str:
    """Return a Compose service or Kubernetes objects that run a process in an enclave.

    Args:
        keystore: the opened keystore.
        enclave: one of its enclaves, in which a process can run.
        form: one of `sros_tool.runtime.environment.CONTAINER_FORMS`.
        target: the keystore in the container and, for Compose, on the machine that runs the
            container.
        variables: the environment of the enclave in the container.
        name: the name of the service or object; "" stands for a name made from the enclave's name,
            which no other enclave gets.
        image: the image, or "".
        now: the current time.

    Raises:
        UsageError: a name is not valid.
        KeystoreError: the container would see the keys of other enclaves, or no files.
    """
    from sros_tool.keystore.delivery.export import exported_files
    from sros_tool.keystore.layout import enclave_path
    from sros_tool.runtime.environment import (
        COMPOSE,
        SECRET,
        Container,
        check_name,
        object_name,
        render_container,
        render_secret,
    )

    if form == SECRET:
        files = exported_files(keystore, (enclave,), now)
        return render_secret(enclave, {PurePosixPath(path).name: files[path] for path in files})
    if form == COMPOSE:
        _check_mounted(keystore, enclave, target)
    name = check_name(name, form) if name else object_name(enclave)
    folder = str(enclave_path(target, enclave))
    return render_container(Container(enclave, name, variables, folder, image), form)


def _check_mounted(keystore: OpenedKeystore, enclave: str, target: Path) -> None:
    """Raise `KeystoreError` if a container cannot use the mounted folder of an enclave.

    It cannot if the folder has other enclaves below it, or links to other files of the keystore.
    """
    from sros_tool.keystore.layout import enclaves_below

    export = f"`sros distribute_key {quote(str(keystore.root))} {quote(enclave)} DIR`"
    if inner := enclaves_below(keystore.root, enclave):
        raise KeystoreError(
            f"the folder of enclave {enclave} also has {first_few(inner, 3)}",
            "The container would get the private keys of all these enclaves.",
            f"Export only this enclave, {export}, and name DIR as the keystore.",
        )
    if keystore.is_original and target == keystore.root.absolute():
        raise KeystoreError(
            f"a container cannot use '{target}' itself",
            "Some files of an enclave are links to other files of the keystore, which the "
            "container would not have.",
            f"Export the enclave, {export}, and name the path of DIR with --target.",
        )


def node_units(
    keystore: OpenedKeystore,
    names: Iterable[str],
    secure: Callable[[str], EnclaveEnvironment],
    *,
    target: Path,
    user: str,
    command: Sequence[str] = (),
    sros: str = "",
) -> tuple[dict[str, str], list[Note]]:
    """Return systemd units that run nodes in enclaves: file contents by path, and notes.

    Args:
        keystore: the opened keystore.
        names: the enclaves.
        secure: returns the environment of an enclave for a process that runs there.
        target: the absolute path of the keystore where the units run.
        user: who runs the nodes.
        command: the program of the nodes; by default a file with the path of the enclave.
        sros: the path of sros on that machine, which verifies an enclave before the node starts; ""
            for no such check.

    Raises:
        KeystoreError: a process cannot run in an enclave.
    """
    from sros_tool.keystore.layout import enclaves_below
    from sros_tool.runtime.units import TEMPLATE, node_settings, node_template, unit_instance

    files, notes = {TEMPLATE: node_template(user)}, list[Note]()
    for name in names:
        secured = secure(name)
        notes += [*secured.notes, *secured.enclave_notes]
        files[f"sros@{unit_instance(name)}.service.d/enclave.conf"] = node_settings(
            name,
            secured.variables,
            str(target),
            command=command,
            below=enclaves_below(keystore.root, name),
            sros=sros,
        )
    return files, notes


def enclave_of_node(file: Path, command: Sequence[str]) -> str:
    """Return the enclave that a policy assigns to the node which a command starts.

    Raises:
        UsageError: the command names no node, or renames only nodes with a certain name; or the
            policy has the node in no enclave or in several.
        PolicyError: the policy cannot be read.
    """
    from sros_tool.names import check_namespace, is_expression
    from sros_tool.policy.document import read_policy
    from sros_tool.policy.patterns import matches
    from sros_tool.runtime.environment import possible_nodes

    nodes = possible_nodes(command)
    policy = read_policy(file)
    if not nodes:
        raise _unnamed_node_error(policy, command)
    for ns, _ in nodes.values():
        if ns != check_namespace(ns):
            raise UsageError(
                f"the namespace {ns!r} ends with '/'",
                "ROS starts no node in it.",
                f"Write `-r __ns:={quote(check_namespace(ns))}`.",
            )
    enclave_paths = {
        tuple(e.path for e in policy.enclaves_of_node(*node)) for node in nodes.values()
    }
    if "" not in nodes or len(enclave_paths) > 1:
        raise _unknown_node_error(command, nodes, [*enclave_paths])
    (enclaves,) = enclave_paths
    if len(enclaves) == 1:
        return enclaves[0]
    ns, name = nodes[""]
    full = _full_name(ns, name)
    why = "A process runs in one enclave."
    remedy = f'Give the node a profile in exactly one enclave: `<profile ns="{ns}" node="{name}">`.'
    if enclaves:
        where = f"in {len(enclaves)} enclaves: {first_few(enclaves, 3)}"
    else:
        where = "in no enclave"
        stated = {known for nodes in policy.nodes().values() for known in nodes}
        every = {known for known in stated if not is_expression(known)}
        similar_names = sorted(known for known in every if known.endswith(f"/{name}"))
        if patterns := sorted(known for known in stated - every if matches(known, full)):
            why = f"Wildcards, as in {patterns[0]}, count only for the node of `ros2 launch`."
        elif similar_names:
            why = f"Similar nodes in the policy: {first_few(similar_names, 3)}."
            other = quote(similar_names[0].rpartition("/")[0] or "/")
            remedy = (
                f"Name the namespace: `-r __ns:={other}` after --ros-args. Or, if {full} is right, "
                f'give the node a profile: `<profile ns="{ns}" node="{name}">`.'
            )
        elif close := get_close_matches(full, every, 2):
            remedy = (
                f"Perhaps you mean {' or '.join(close)}. If {full} is right, give the node a "
                "profile in one enclave."
            )
    raise UsageError(f"the policy '{file}' has the node {full} {where}", why, remedy)


def _unnamed_node_error(policy: Policy, command: Sequence[str]) -> UsageError:
    """Return the error for a command that does not name its node.

    A rule for a node (``-r talker:a:=b``) does not show that the process has this node.
    """
    from sros_tool.runtime.environment import nodes_with_rules, started_nodes

    *_, (ns, _) = started_nodes(command)
    remedy = (
        "Start a launch file with `ros2 launch --secured KEYSTORE POLICY ...`: this finds the "
        "enclave of each node. Start any other command in an enclave of its own: `sros run "
        "KEYSTORE ENCLAVE -- COMMAND`."
    )
    for name in nodes_with_rules(command):
        enclaves = policy.enclaves_of_node(ns or "/", name)
        if len(enclaves) == 1:
            run = f"`sros run KEYSTORE {quote(enclaves[0].path)} -- COMMAND`"
            node = _full_name(ns, name)
            remedy = f"If the process has the node {node} (a remapping rule names it), run {run}."
    return UsageError(
        f"the command '{command[0]}' names no node",
        "The policy assigns enclaves to node names, and `--ros-args -r __node:=NAME` sets the "
        "name.",
        remedy,
    )


def _unknown_node_error(
    command: Sequence[str],
    nodes: Mapping[str, tuple[str, str]],
    enclave_paths: Sequence[tuple[str, ...]],
) -> UsageError:
    """Return the error for a command that does not show which node its program starts.

    ``nodes`` is the result of `sros_tool.runtime.environment.possible_nodes`, and ``enclave_paths``
    has the enclaves of each of these nodes.
    """
    cases = [f"{_full_name(*node)} if its own name is {own}" for own, node in nodes.items() if own]
    other = f"else {_full_name(*nodes[''])}" if "" in nodes else "else it keeps its own name"
    several = len(enclave_paths) > 1 or len(enclave_paths[0]) != 1
    enclave = "ENCLAVE" if several else quote(enclave_paths[0][0])
    return UsageError(
        f"sros cannot know which node the command '{command[0]}' starts",
        f"By the remapping rules, the node is {', '.join(cases)}, {other}.",
        f"Name the enclave: `sros run KEYSTORE {enclave} -- COMMAND`. Or, if the process has only "
        "one node, replace these rules with `-r __node:=NAME`.",
    )


def other_node_notes(
    keystore: OpenedKeystore, enclave: str, command: Sequence[str], *, now: datetime
) -> tuple[Note, ...]:
    """Return a note if a command gives its nodes a name that the enclave's permissions lack.

    A command without a namespace counts as one for "/", if it certainly starts nodes.  If the
    command's remapping rules depend on the node's own name, a note is returned only if none of the
    possible names is in the permissions.  If the ledger lacks the permissions, sros finds only
    those of their nodes that may offer the standard services.  Then, a note is returned only if one
    of these has the name in another namespace.
    """
    from sros_tool.keystore.rights import RecordedRights
    from sros_tool.policy.rights import nodes_from_text, nodes_of_rights
    from sros_tool.runtime.environment import started_nodes, starts_nodes
    from sros_tool.translate import grant_rights

    started = list(started_nodes(command))
    if started == [("", "")] and not starts_nodes(command):
        return ()
    state = keystore.enclave(enclave, now=now)
    grant = state.permissions.grant_of(state.subject) if state.permissions else None
    if grant is None or grant.default_allow:
        return ()
    known = nodes_of_rights(grant_rights(enclave, grant))
    digest = hashlib.sha256(state.files.get(PERMISSIONS_FILE, b"")).hexdigest()
    recorded = RecordedRights(keystore).latest_entry(enclave, digest)
    if recorded:
        known += nodes_from_text(recorded.nodes)
    notes = [_other_node_note(enclave, known, *node, all_known=bool(recorded)) for node in started]
    return tuple(islice(filter(None, notes), 1)) if all(notes) else ()


def _other_node_note(
    enclave: str, known: tuple[NodeName, ...], ns: str, name: str, *, all_known: bool
) -> Note | None:
    """Return a note if a node is not in ``known``, the nodes of an enclave; otherwise None.

    "" stands for any namespace or name.  Without ``all_known``, the enclave may have more nodes. In
    this case, a note is returned only if a known node has this name in another namespace.
    """
    from sros_tool.names import is_expression
    from sros_tool.policy.patterns import overlap

    if not all_known:
        known = tuple(node for node in known if name and overlap(node.name, name))
    named = [node for node in known if not name or overlap(node.name, name)]
    if not known or any(overlap(node.ns, f"/{ns.strip('/')}") for node in named):
        return None
    allowed = named or known
    nodes = first_few([_full_name(*node) for node in allowed], 3)
    if named and not ns:
        rule = "NAMESPACE" if is_expression(named[0].ns) else quote(named[0].ns)
        text = (
            f"the command names no namespace, and the permissions of enclave {enclave} are for "
            f"{nodes}: write `-r __ns:={rule}` after --ros-args, unless the program sets its "
            "namespace itself."
        )
        return Note("run.other-node", text)
    started = f"the node {_full_name(ns, name)}" if ns and name else f"a node in the namespace {ns}"
    if not ns:
        started = f"a node with the name {name}"
    text = (
        f"the command starts {started}, which is not allowed to offer its parameter services: the "
        f"permissions of enclave {enclave} are for the node{'s' * (len(allowed) > 1)} {nodes}. "
        "Correct `__ns:=` or `__node:=`, or start the node in its own enclave."
    )
    return Note("run.other-node", text)


def _full_name(ns: str, name: str) -> str:
    return f"/{ns.strip('/')}/{name}".replace("//", "/")
