"""The public functions and classes of the Python API, which ``import sros_tool`` exports.

Each function converts its arguments (a path, the name of a template) to the types of the package,
supplies the current time, and calls the function that does the work.  Nothing here prints,
prompts, or reads environment variables; ``PKCS11_MODULE_PATH`` of a key on a token is the only
exception.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta, tzinfo
from functools import wraps
from os import PathLike, fspath
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, ParamSpec, TypeVar

from sros_tool.errors import Note, PolicyError, UsageError

if TYPE_CHECKING:
    from sros_tool.checks.kind import Finding
    from sros_tool.explain.answer import Question
    from sros_tool.explain.asking import AskedEnclave, AskingContext
    from sros_tool.fleet.expansion import FleetPolicy
    from sros_tool.keystore.fleet_status import FleetStatus
    from sros_tool.keystore.issuing.keyring import Keyring
    from sros_tool.keystore.lifecycle.change import Changed
    from sros_tool.keystore.lifecycle.create import Creation
    from sros_tool.keystore.lifecycle.revoke import Revocation
    from sros_tool.keystore.participant import JoinContext
    from sros_tool.keystore.template import Template
    from sros_tool.policy.merge import Merged
    from sros_tool.policy.model import Policy
    from sros_tool.policy.rights import Right
    from sros_tool.proof.growth import Growth

AnyPath = str | PathLike[str]
Secrets = Callable[[str], str]
"""A callback that gets a prompt, such as "the PIN of the token X", and returns the secret."""

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def _with_checked_arguments(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Decorate a public function so that arguments of a wrong type raise `UsageError`."""
    code, annotations = function.__code__, function.__annotations__
    positional = code.co_varnames[: code.co_argcount]
    # The first is an argument such as "*paths".
    others = code.co_varnames[code.co_argcount + code.co_kwonlyargcount :]

    @wraps(function)
    def call(*arguments: Parameters.args, **named: Parameters.kwargs) -> Result:
        names = [*positional, *[*others[:1]] * len(arguments)][: len(arguments)]
        given: list[Any] = [
            _checked_argument(name, annotations.get(name, ""), argument)
            for name, argument in zip(names, arguments, strict=True)
        ]
        for name, argument in named.items():
            named[name] = _checked_argument(name, annotations.get(name, ""), argument)
        return function(*given, **named)

    return call


_TYPES: dict[str, type | tuple[type, ...]] = {
    "Literal": str,
    "None": type(None),
    **{kind.__name__: kind for kind in (str, int, bool, datetime, timedelta, tzinfo)},
}
_TYPE_TEXTS = {
    "AnyPath": "a path (str or os.PathLike)",
    "Literal": "a string",
    "None": "None",
    "Secrets": "a function",
    "bool": "True or False",
    "int": "an integer",
    "str": "a string",
}


def _checked_argument(name: str, annotation: str, argument: Any) -> Any:
    """Return an argument after a check of its type; a list becomes a tuple.

    Raises:
        UsageError: the argument or an item of it has another type than annotated.
    """
    texts = []
    for kind, items in re.findall(r"(\w+)(?:\[([^\]]*)\])?", annotation):
        if kind in ("Iterable", "Sequence"):
            texts.append("a list")
            if isinstance(argument, Iterable) and not isinstance(argument, str | bytes):
                return tuple(
                    _checked_argument(f"an item of {name}", items, item) for item in argument
                )
        elif _is_of_type(argument, kind):
            if kind == "AnyPath" and "\0" in fspath(argument):
                raise UsageError(f"{name} has a NUL character", "", "Pass the path of a file.")
            return argument
        else:
            texts.append(_TYPE_TEXTS.get(kind, f"a {kind}"))
    if not annotation:  # an unknown argument, which Python itself refuses
        return argument
    wanted, is_one = " or ".join(texts), isinstance(argument, str) and "a list" in texts
    raise UsageError(
        f"{name} is {'one string' if is_one else f'of type {type(argument).__name__}'}",
        "",
        f"Pass {wanted}: [{argument!r}]." if is_one else f"Pass {wanted}.",
    )


def _is_of_type(argument: Any, kind: str) -> bool:
    """Return whether an argument has the type that an annotation names."""
    if kind == "AnyPath":
        return isinstance(argument, str) or (
            isinstance(argument, PathLike) and isinstance(fspath(argument), str)
        )
    if kind == "Secrets":
        return callable(argument)
    if kind in _TYPES:
        is_truth = isinstance(argument, bool)
        return isinstance(argument, _TYPES[kind]) and (not is_truth or kind == "bool")
    return any(
        of.__name__ == kind and of.__module__.startswith("sros_tool.")
        for of in type(argument).__mro__
    )


@dataclass(frozen=True, slots=True)
class Keystore:
    """A keystore folder, accepted wherever a path is expected.

    ``notes`` are remarks from the creation of the keystore, such as names on which DDS vendors
    differ.
    """

    path: Path
    notes: tuple[Note, ...] = field(default=(), compare=False)

    @property
    def enclaves(self) -> tuple[str, ...]:
        """The sorted names of the enclaves, read from the folder at each access."""
        from sros_tool.keystore.layout import list_enclaves

        return list_enclaves(Path(self.path))

    def __fspath__(self) -> str:
        return fspath(self.path)


@dataclass(frozen=True, slots=True)
class AccessAnswer:
    """The decision of one DDS vendor, or of Zenoh, on an access, and the reason.

    ``outcome`` is "allowed", "denied" (the endpoint is not created), "peer denies" (the endpoint is
    created, and no peer matches it), "refused" (no node of the enclave starts) or "crashes". For
    Zenoh, it is "allowed", "dropped" (messages vanish) or "refused" (the process opens no session).
    ``reason`` is a clause for people.  ``expression`` is the DDS topic expression of the deciding
    rule, or for Zenoh the key expression with a wildcard that allows the access, or "".
    ``policy_lines`` are the places ``FILE:LINE`` in the given policy that the rule comes from.
    ``until`` is the first expiry among the enclave's files, in UTC.  ``remedy`` says what to do if
    the cause of a denial is not the policy.  ``counts_key`` says that the enclave's key is not
    here, and was assumed to exist: on its robot, or in the keystore from which this copy was made.
    ``assumption`` says which distribution decided in place of an unsupported one, or is "".
    """

    allowed: bool
    outcome: str
    reason: str
    vendor: str
    expression: str = ""
    policy_lines: tuple[str, ...] = ()
    until: datetime | None = None
    remedy: str = ""
    counts_key: bool = False
    assumption: str = ""

    def __bool__(self) -> bool:
        return self.allowed


@_with_checked_arguments
def create_keystore(
    path: AnyPath,
    template: AnyPath | Template = "development",
    *,
    domains: int | str = 0,
    identity_ca: AnyPath | None = None,
    identity_key: str | None = None,
    permissions_key: str | None = None,
    encrypt_ca_keys: bool = False,
    short_passphrase: bool = False,
    secrets: Secrets | None = None,
    now: datetime | None = None,
) -> Keystore:
    """Create a keystore in the folder ``path``, with its CAs and its governance.

    Args:
        path: The folder; it must not hold a keystore or a part of one.
        template: The keystore template: "development", "production", "sros2", the path of a TOML
            file, or a `Template` from `load_template`.
        domains: The ROS domain ids of the keystore, such as 0, "0,7" or "10-19".
        identity_ca: The certificate (PEM) of an existing CA, which then is the identity CA.
        identity_key: The key of the identity CA: ``issuer:NAME`` for a CA service, ``pkcs11:...``
            or ``file:PATH``; a missing file is created.
        permissions_key: The key of the permissions CA: ``pkcs11:...`` or ``file:PATH``.
        encrypt_ca_keys: Encrypt the CA keys with the passphrase that ``secrets`` returns.
        short_passphrase: Accept a passphrase of less than 12 characters, which is soon guessed.
        secrets: Called for the passphrase of a CA key, or the PIN of a token.
        now: The time from which validities count; the current time by default.

    Raises:
        KeystoreError: The folder holds a keystore or a part of one, or a CA key cannot be used.
        DocumentError: The template or ``identity_ca`` does not exist, or is malformed.
        UsageError: ``domains`` are not domain ids, or the passphrase is too short.

    Example:
        >>> keystore = sros_tool.create_keystore("ks", template="production")
    """
    from sros_tool.dds.domains import DomainSet
    from sros_tool.keystore.lifecycle import create

    result = create.create_keystore(
        Path(path),
        template=load_template(template) if isinstance(template, str | PathLike) else template,
        domains=DomainSet.parse(str(domains), "domains"),
        now=_time_or_now(now),
        keyring=_make_keyring(
            secrets,
            identity_key,
            permissions_key,
            encrypt=encrypt_ca_keys,
            short_passphrase=short_passphrase,
        ),
        imported_cas={} if identity_ca is None else {"identity": _read_file(identity_ca)},
    )
    return Keystore(result.root, result.notes)


@_with_checked_arguments
def open_keystore(path: AnyPath) -> Keystore:
    """Return the keystore in the folder ``path``, whether sros or ros2/sros2 created it.

    Raises:
        KeystoreError: The folder is not a keystore.

    Example:
        >>> sros_tool.open_keystore("ks").enclaves
        ('/talker_listener/listener', '/talker_listener/talker')
    """
    from sros_tool.keystore.layout import check_keystore

    check_keystore(Path(path))
    return Keystore(Path(path))


@_with_checked_arguments
def load_template(choice: AnyPath) -> Template:
    """Return the keystore template named ``choice`` ("production"), or in the TOML file ``choice``.

    Change a setting of the template with `dataclasses.replace`.

    Raises:
        DocumentError: The template does not exist, or is malformed.

    Example:
        >>> template = sros_tool.load_template("production")
        >>> template = dataclasses.replace(template, certificate_validity=timedelta(days=90))
    """
    from sros_tool.keystore import template

    return template.load_template(fspath(choice))


@_with_checked_arguments
def read_policy(path: AnyPath) -> Policy:
    """Return the policy in the file ``path``, with the files that it includes.

    Raises:
        PolicyError: The policy does not exist or cannot be read, is no XML or malformed,
            contradicts itself, or includes a file outside of its folder.

    Example:
        >>> policy = sros_tool.read_policy("policies/talker_listener.xml")
        >>> [enclave.path for enclave in policy.enclaves]
        ['/talker_listener/talker', '/talker_listener/listener']
    """
    from sros_tool.policy import document

    try:
        return document.read_policy(Path(path))
    except PolicyError as error:
        if error.remedy != document.NAME_THE_FLEET:
            raise
        raise PolicyError(
            error.what,
            error.why,
            "Do not read the policy: pass its path to a function with fleet=, such as "
            "generate(keystore, path, fleet=FLEET_FILE).",
        ) from error


@_with_checked_arguments
def policy_rights(policy: AnyPath | Policy) -> tuple[Right, ...]:
    """Return the sorted rights that a policy states, with absolute names.

    Returns:
        Rights with ``enclave``, ``qualifier`` (``ALLOW`` or ``DENY``), ``right`` (such as
        "publish") and ``name``, perhaps with wildcards.

    Raises:
        PolicyError: The policy cannot be read.

    Example:
        >>> [str(right) for right in sros_tool.policy_rights(policy) if right.name == "/chatter"]
        ['/talker_listener/listener ALLOW subscribe topic /chatter',
         '/talker_listener/talker ALLOW publish topic /chatter']
    """
    from sros_tool.policy import rights

    return tuple(sorted(rights.policy_rights(_as_policy(policy)), key=rights.order))


@_with_checked_arguments
def merge_policies(
    policy: AnyPath,
    *others: AnyPath | Policy,
    namespace: str | None = None,
    remaps: Sequence[str] = (),
    enclave: str | None = None,
    nodes: Sequence[str] = (),
) -> Merged:
    """Return the policy file ``policy`` with the rights of other policies added; write nothing.

    Args:
        policy: A policy file, which can be without enclaves (``<enclaves/>``).
        others: The policies whose rights are added.
        namespace: A namespace such as "/left" for the enclaves and nodes of the others, with all
            names that do not begin with "/".
        remaps: Remappings of names in the others, as their nodes are started with, such as
            "image:=/front/image" or "__node:=front"; they apply after ``namespace``.
        enclave: The enclave for all nodes of the others, if one process composes these nodes.
        nodes: The only nodes that are taken from the others, by name; all by default.

    Returns:
        The ``document`` (bytes) for the folder of ``policy``, whose includes it keeps; the rights
        that were ``added``; all ``rights``; the ``contradictions`` between an ALLOW and a DENY,
        which wins; and ``notes``, for instance on a DENY that wins.

    Raises:
        PolicyError: (or another `DocumentError`) A policy cannot be read, or rights cannot be added
            to it.
        InvalidNameError: A namespace or an enclave is not valid.
        UsageError: A remapping is not valid, or no policy has the name that it remaps; or no policy
            has one of ``nodes``.

    Example:
        >>> merged = sros_tool.merge_policies("own.xml", "gripper.xml", namespace="/left")
        >>> for note in merged.notes:
        ...     print(note)
        >>> pathlib.Path("robot.xml").write_bytes(merged.document)
    """
    from sros_tool.graph import learn

    additions = list(map(_as_policy, others))
    return learn.merge_policies(Path(policy), additions, namespace, remaps, enclave, nodes)


@_with_checked_arguments
def generate(
    keystore: AnyPath,
    *policies: AnyPath | Policy,
    fleet: AnyPath | None = None,
    enclaves: Iterable[str] = (),
    domain: int | None = None,
    identity_key: str | None = None,
    permissions_key: str | None = None,
    secrets: Secrets | None = None,
    now: datetime | None = None,
    dry_run: bool = False,
) -> Creation:
    """Create the enclaves that policies name, and sign their permissions.

    All or nothing: an error leaves the keystore unchanged.  An existing enclave keeps its key, and
    gets new permissions if a policy names it.

    Args:
        keystore: An existing keystore, or its path.
        policies: Policies, or the paths of policy files.
        fleet: The file with the robots that the placeholders of policies stand for; then all
            policies have to be paths.
        enclaves: Names of more enclaves, which get the default permissions of the template.
        domain: The ROS domain id that the enclaves will be used in; the governance must name it.
        identity_key: The place of the identity CA's key if it is kept elsewhere: ``file:PATH``,
            ``pkcs11:...``, or ``issuer:NAME`` for a CA service.
        permissions_key: The place of the permissions CA's key, likewise; not a CA service.
        secrets: Called for the passphrase of an encrypted CA key, or the PIN of a token.
        now: The time from which validities count; the current time by default.
        dry_run: Report the changes without making them.

    Returns:
        The names of the enclaves that were ``created``, ``changed`` (given new permissions),
        ``completed`` (a missing file added) and ``kept`` (left as they were), and ``notes``.

    Raises:
        KeystoreError: The keystore does not exist, is busy or broken, or is not for ``domain``.
        PolicyError: Two policies differ on an enclave, or a policy file is malformed.
        InvalidNameError: An enclave's name is not valid.
        UsageError: No policy and no enclave is given, or ``fleet`` is given with a policy that is
            already read.

    Example:
        >>> sros_tool.generate(keystore, "policies/talker_listener.xml").created
        ('/talker_listener/talker', '/talker_listener/listener')
    """
    from sros_tool.keystore.lifecycle import create

    names = tuple(enclaves)
    if not (policies or names):
        text = "no policy and no enclave is given"
        raise UsageError(text, "", "Pass at least one policy or enclave.")
    return create.generate_artifacts(
        Path(keystore),
        enclaves=names,
        policies=_fleet_policies(policies, fleet) if fleet else [_as_policy(e) for e in policies],
        now=_time_or_now(now),
        domain=_checked_domain(domain),
        keyring=_make_keyring(secrets, identity_key, permissions_key),
        dry_run=dry_run,
    )


def _fleet_policies(policies: Iterable[AnyPath | Policy], fleet: AnyPath) -> list[FleetPolicy]:
    from sros_tool.fleet.expansion import FleetPolicy
    from sros_tool.fleet.fleet_file import read_fleet
    from sros_tool.policy.document import read_policy

    robots, read = read_fleet(Path(fleet)), []
    for policy in policies:
        if not isinstance(policy, str | PathLike):
            raise UsageError(
                "an already parsed policy cannot be expanded for a fleet",
                "",
                "Pass the path of its file.",
            )
        read.append(FleetPolicy(read_policy(Path(policy), placeholders=True), robots))
    return read


@_with_checked_arguments
def create_enclaves(
    keystore: AnyPath,
    enclaves: Iterable[str],
    *,
    domain: int | None = None,
    identity_key: str | None = None,
    permissions_key: str | None = None,
    secrets: Secrets | None = None,
    now: datetime | None = None,
    dry_run: bool = False,
) -> Creation:
    """Create enclaves with the default permissions of the keystore's template, all or none.

    An existing enclave keeps its key and its permissions.

    Args:
        keystore: An existing keystore, or its path.
        enclaves: The names of the enclaves.
        domain: The ROS domain id that the enclaves will be used in; the governance must name it.
        identity_key: The place of the identity CA's key if it is kept elsewhere: ``file:PATH``,
            ``pkcs11:...``, or ``issuer:NAME`` for a CA service.
        permissions_key: The place of the permissions CA's key, likewise; not a CA service.
        secrets: Called for the passphrase of an encrypted CA key, or the PIN of a token.
        now: The time from which validities count; the current time by default.
        dry_run: Report the changes without making them.

    Raises:
        KeystoreError: The keystore does not exist, is busy or broken, or is not for ``domain``.
        InvalidNameError: An enclave's name is not valid.

    Example:
        >>> sros_tool.create_enclaves(keystore, ["/camera"]).created
        ('/camera',)
    """
    return generate(
        keystore,
        enclaves=enclaves,
        domain=domain,
        identity_key=identity_key,
        permissions_key=permissions_key,
        secrets=secrets,
        now=now,
        dry_run=dry_run,
    )


@_with_checked_arguments
def renew(
    keystore: AnyPath,
    enclaves: Iterable[str] = (),
    *,
    expiring: timedelta | None = None,
    new_key: bool = False,
    revoke_old: bool = False,
    identity_key: str | None = None,
    permissions_key: str | None = None,
    secrets: Secrets | None = None,
    now: datetime | None = None,
    dry_run: bool = False,
) -> Changed:
    """Renew the certificates and permissions of enclaves, with the same rights, all or none.

    Args:
        keystore: The keystore, or its path.
        enclaves: The names of enclaves.
        expiring: Also renew the enclaves that expire within this time, except those with a
            validity of their own.
        new_key: Give the enclaves new keys.
        revoke_old: Revoke the earlier certificates, which otherwise work until they expire.
        identity_key: The place of the identity CA's key if it is kept elsewhere: ``file:PATH``,
            ``pkcs11:...``, or ``issuer:NAME`` for a CA service.
        permissions_key: The place of the permissions CA's key, likewise; not a CA service.
        secrets: Called for the passphrase of an encrypted CA key, or the PIN of a token.
        now: The time from which validities count; the current time by default.
        dry_run: Report the changes without making them.

    Returns:
        ``names("renewed")``, ``restart`` (the enclaves whose processes have to be restarted) and
        ``works_until`` (until when the last replaced certificate works).

    Raises:
        KeystoreError: An enclave does not exist or cannot be renewed.
        UsageError: Neither ``enclaves`` nor ``expiring`` is given.

    Example:
        >>> sros_tool.renew(keystore, expiring=timedelta(days=30)).names("renewed")
        ('/camera',)
    """
    from sros_tool.keystore.expiry import Threshold
    from sros_tool.keystore.lifecycle import renew as lifecycle

    names = tuple(enclaves)
    if not names and expiring is None:
        raise UsageError("no enclaves are given", "", "Pass enclaves, or expiring=timedelta(...).")
    return lifecycle.renew(
        Path(keystore),
        names,
        now=_time_or_now(now),
        expiring=None if expiring is None else Threshold(remaining=expiring),
        new_key=new_key,
        revoke_old=revoke_old,
        keyring=_make_keyring(secrets, identity_key, permissions_key),
        dry_run=dry_run,
    )


@_with_checked_arguments
def revoke(
    keystore: AnyPath,
    enclaves: Iterable[str],
    *,
    reason: str = "unspecified",
    crl: AnyPath | None = None,
    identity_key: str | None = None,
    permissions_key: str | None = None,
    secrets: Secrets | None = None,
    now: datetime | None = None,
    dry_run: bool = False,
) -> Revocation:
    """Revoke all certificates of enclaves, and move their files away, all or none.

    The other enclaves get the revocation list. Their processes accept the revoked enclaves until
    these processes are restarted with the list.

    Args:
        keystore: The keystore, or its path.
        enclaves: The names of the enclaves.
        reason: Why, as RFC 5280 names reasons: ``keyCompromise``, ``cessationOfOperation``, ...
        crl: The revocation list (PEM) of a CA service; only the service can sign it.
        identity_key: The place of the identity CA's key if it is kept elsewhere: ``file:PATH``,
            ``pkcs11:...``, or ``issuer:NAME`` for a CA service.
        permissions_key: The place of the permissions CA's key, likewise; not a CA service.
        secrets: Called for the passphrase of an encrypted CA key, or the PIN of a token.
        now: The time of the revocation; the current time by default.
        dry_run: Report the changes without making them.

    Returns:
        ``names("revoked")``, ``restart`` (the enclaves whose processes have to be restarted) and
        ``next_update`` (when the revocation list expires).

    Raises:
        KeystoreError: An enclave does not exist, the key of the identity CA is missing, or ``crl``
            is missing or does not revoke these enclaves.
        UsageError: No enclave is given, or ``reason`` is unknown.

    Example:
        >>> sros_tool.revoke(keystore, ["/camera"], reason="keyCompromise").restart
        ('/driver',)
    """
    from sros_tool.keystore.lifecycle import revoke as lifecycle

    names = tuple(enclaves)
    if not names:
        raise UsageError("no enclave is given to revoke", "", "Pass at least one enclave name.")
    return lifecycle.revoke(
        Path(keystore),
        names,
        now=_time_or_now(now),
        reason=reason,
        crl=b"" if crl is None else _read_file(crl),
        keyring=_make_keyring(secrets, identity_key, permissions_key),
        dry_run=dry_run,
    )


@_with_checked_arguments
def fleet_status(
    keystore: AnyPath,
    robots: Iterable[str] = (),
    *,
    max_age: timedelta | None = None,
    now: datetime | None = None,
) -> FleetStatus:
    """Return the deployment status of each robot of a fleet, by its last confirmation.

    Args:
        keystore: A keystore with a fleet, or its path.
        robots: The names of some robots; all by default.
        max_age: A robot whose last confirmation is older is ``overdue`` and ``offline``. Without
            ``max_age``, a robot that fetches is overdue and offline after a day without a message,
            and no other robot is.
        now: The time from which ages count; the current time by default.

    Returns:
        The ``robots`` with ``robot``, ``state``, ``received`` and ``pending`` (the files that are
        not current), ``counts`` by state, ``overdue``, and ``complete``: whether every robot has
        confirmed that it has the current files.

    Raises:
        KeystoreError: The keystore does not exist, has no fleet, or cannot be read.
        DocumentError: The fleet has no such robot.

    Example:
        >>> status = sros_tool.fleet_status(keystore, max_age=timedelta(days=7))
        >>> [robot.robot for robot in status.robots if robot.state != "current"]
        ['r8']
    """
    from sros_tool.keystore import fleet_status as status
    from sros_tool.keystore.reader import OpenedKeystore

    moment = _time_or_now(now)
    fleet = status.fleet_status(OpenedKeystore(Path(keystore)), tuple(robots), moment)
    return fleet.with_overdue(moment, max_age)


@_with_checked_arguments
def export_enclaves(
    keystore: AnyPath,
    enclaves: Iterable[str],
    target: AnyPath,
    *,
    force: bool = False,
    now: datetime | None = None,
) -> Path:
    """Export enclaves to ``target`` for use on a robot, without CA keys; return ``target``.

    Args:
        keystore: The keystore, or its path.
        enclaves: The names of the enclaves.
        target: The path of a ``.tar.gz`` file, or of a folder, which is created.
        force: Replace files in ``target`` that differ.
        now: The time at which the enclaves have to be valid; the current time by default.

    Raises:
        KeystoreError: An enclave does not exist or is not usable, or ``target`` holds other files.
        UsageError: No enclave is given.

    Example:
        >>> sros_tool.export_enclaves(keystore, ["/talker_listener/talker"], "robot.tar.gz")
        PosixPath('robot.tar.gz')
    """
    from sros_tool.keystore.delivery.export import distribute
    from sros_tool.keystore.reader import OpenedKeystore

    names = tuple(enclaves)
    if not names:
        raise UsageError("no enclave is given to export", "", "Pass at least one enclave name.")
    return distribute(
        OpenedKeystore(Path(keystore)), names, Path(target), now=_time_or_now(now), force=force
    ).target


@_with_checked_arguments
def explain_access(
    keystore: AnyPath | Policy,
    enclave: str,
    action: str,
    name: str = "",
    *,
    kind: Literal["topic", "service", "action"] | None = None,
    vendor: str = "fastdds",
    distribution: str = "",
    policy: AnyPath | Policy | None = None,
    domain: int | None = None,
    now: datetime | None = None,
    zone: tzinfo = UTC,
) -> AccessAnswer:
    """Return how a DDS vendor decides on an access, by the signed documents of the enclave.

    Zenoh decides by the files that `sros zenoh` has written into the keystore.

    Args:
        keystore: The keystore, or its path; or a policy or policy file, which counts as signed.
        enclave: The name of the enclave, such as "/talker".
        action: "publish", "subscribe", "call", "serve", "execute" or "join"; "request" and "reply",
            the words of policies, mean "call" and "serve" for a service.
        name: The absolute ROS name of the topic, service or action; "" for "join".
        kind: The kind of ``name``; without it, "call" and "serve" mean an action if the rights of
            the enclave, the policy or the keystore have an action and no service of that name.
        vendor: "fastdds" (2.14, or the release in ``distribution``), "cyclonedds" (0.10, or the
            release in ``distribution``), or another name that `sros explain --vendor` takes, such
            as "fastdds-3.2" or "zenoh".
        distribution: A ROS 2 distribution, such as "lyrical", whose release of ``vendor`` decides.
        policy: The policy of the enclave, or the path of its file, in which to find the
            ``policy_lines``.
        domain: The ROS domain id; by default 0, or the first domain of the governance.
        now: The time of the access; the current time by default.
        zone: The time zone of the robot, in which some vendors read dates.

    Raises:
        KeystoreError: The keystore or the enclave does not exist.
        PolicyError: The policy does not have the enclave.
        UsageError: The action is unknown or does not fit ``kind``, the name, vendor,
            distribution or domain is not valid, or Zenoh is asked about a policy only.

    Example:
        >>> answer = sros_tool.explain_access(keystore, "/talker", "publish", "/chatter")
        >>> answer.allowed, answer.reason
        (True, 'rule 1 allows publish rt/chatter by rt/chatter')
    """
    from sros_tool.dds.decision.vendors import ZENOH, Vendor
    from sros_tool.distributions import find_distribution
    from sros_tool.explain.answer import Evaluator, ask
    from sros_tool.explain.asking import AskingContext, question_meant
    from sros_tool.explain.explanation import explain

    question = ask(action, name, kind)
    domain = _checked_domain(domain)
    vendors = [*(known.value for known in Vendor), ZENOH]
    if vendor not in vendors:
        raise UsageError(f"unknown vendor {vendor!r}", "", f"Choose {', '.join(vendors)}.")
    if vendor == ZENOH and distribution:
        text = "On Zenoh, the decision is the same in every distribution."
        raise UsageError("vendor 'zenoh' takes no distribution", text, "Leave distribution= out.")
    (vendor,) = _selected_vendors(vendor, distribution)
    asking = AskingContext(_time_or_now(now), zone, domain)
    asked = _enclave_to_ask(keystore, enclave, policy, asking)
    context = asking.context(asked.enclave.joined_domains)
    if vendor == ZENOH:
        return _access_on_zenoh(asked, question, context, kind)
    signed = asked.enclave.on_this_machine if action == "join" else asked.enclave
    evaluator = Evaluator(Vendor(vendor), signed, context)
    question, _ = question_meant(evaluator, asked, question, kind)
    answer = explain(evaluator, question)
    _, colon, reason = answer.text.partition(": ")
    return AccessAnswer(
        answer.allowed,
        answer.outcome.value,
        (reason if colon else answer.text).removesuffix("."),
        vendor,
        answer.decision.expression or "",
        tuple(str(line.source) for line in answer.lines),
        answer.until,
        answer.remedy,
        answer.counts_key,
        find_distribution(distribution).assumption if distribution else "",
    )


def _access_on_zenoh(
    asked: AskedEnclave, question: Question, context: JoinContext, kind: str | None
) -> AccessAnswer:
    from sros_tool.dds.decision.vendors import ZENOH
    from sros_tool.explain.zenoh import explain_on_zenoh

    explanation = explain_on_zenoh(asked, question, "as asked", context, kind=kind)
    answer = explanation.answer
    return AccessAnswer(
        answer.allowed,
        answer.outcome.value,
        answer.text,
        ZENOH,
        answer.wildcard,
        tuple(str(line.source) for line in explanation.stated.lines),
        answer.until,
        explanation.remedy,
        explanation.counts_key,
    )


def _enclave_to_ask(
    keystore: AnyPath | Policy,
    enclave: str,
    policy: AnyPath | Policy | None,
    asking: AskingContext,
) -> AskedEnclave:
    """Return an enclave of a keystore, or of a policy as if it were signed."""
    from sros_tool.explain.asking import (
        AskedEnclave,
        is_policy,
        not_in_policy_error,
        planned_enclave,
        signed_enclave,
    )
    from sros_tool.keystore.reader import OpenedKeystore

    if not isinstance(keystore, str | PathLike) or is_policy(Path(keystore)):
        if policy is not None:
            why = "The first argument is a policy already."
            raise UsageError("two policies are named", why, "Leave policy= out.")
        alone = _as_policy(keystore)
        stated_enclave = alone.enclave(enclave)
        if stated_enclave is None:
            raise not_in_policy_error(alone, enclave, Path(alone.file))
        return AskedEnclave(
            planned_enclave(stated_enclave, None, asking)._replace(policy=stated_enclave), alone
        )
    opened = OpenedKeystore(Path(keystore))
    opened.check()
    signed = signed_enclave(opened, enclave, asking.at)
    assert signed
    stated = _as_policy(policy) if policy is not None else None
    stated_enclave = stated.enclave(enclave) if stated else None
    return AskedEnclave(signed._replace(keystore=opened, policy=stated_enclave), stated)


@_with_checked_arguments
def check(
    *paths: AnyPath,
    policies: Iterable[AnyPath | Policy] = (),
    fleet: AnyPath | None = None,
    severity: Literal["note", "warning", "error"] = "warning",
    strict: bool = False,
    distribution: str = "",
    domain: int | None = None,
    now: datetime | None = None,
    zone: tzinfo = UTC,
) -> tuple[Finding, ...]:
    """Return findings on errors and weaknesses in keystores, enclaves and policies, worst first.

    Args:
        paths: Keystores, enclave folders, policy files, or folders of policy files.
        policies: Policies, or paths of policy files; the permissions of keystores are compared with
            these policies.
        fleet: The file with the robots that the placeholders of policy files stand for.
        severity: The lowest severity that is returned. With "warning", notes that `sros check`
            shows without options are returned, too: a script that fails for findings has to
            compare ``finding.severity``.
        strict: Include the weaknesses that a keystore's template accepts.
        distribution: The ROS 2 distribution, such as "lyrical", whose nodes and DDS the findings
            are for; by default the latest for nodes in policies, and the distributions in the
            keystore's settings.  In place of one that is not supported any more, such as "foxy",
            the next supported one counts, and no finding says so.
        domain: The ROS domain id that the enclaves have to join.
        now: The time at which validities are checked; the current time by default.
        zone: The time zone of the robot, in which some vendors read dates.

    Returns:
        Findings with ``id``, ``severity``, ``file``, ``line`` (from 1, or None), ``subject``,
        ``text`` and ``remedy``.

    Raises:
        DocumentError: A path is neither a policy, nor a keystore, nor an enclave.
        UsageError: No path is given, the severity or the distribution is unknown, or ``domain`` is
            not a domain id.

    Example:
        >>> for finding in sros_tool.check("ks"):
        ...     print(finding.place, finding.id, finding.text, finding.remedy)
    """
    from sros_tool.checks.keystores.opened import Circumstances
    from sros_tool.checks.kind import FindingFilter, Severity
    from sros_tool.checks.targets import path_findings
    from sros_tool.distributions import find_distribution
    from sros_tool.fleet.expansion import read_policy_for
    from sros_tool.fleet.fleet_file import read_fleet

    levels = {level.word: level for level in Severity}
    if not paths:
        raise UsageError("no path is given", "", "Pass at least one path.")
    if severity not in levels:
        raise UsageError(f"unknown severity {severity!r}", "", f"Choose {', '.join(levels)}.")
    robots = read_fleet(Path(fleet)) if fleet else None
    read = tuple(
        read_policy_for(Path(policy), robots)
        if robots and isinstance(policy, str | PathLike)
        else _as_policy(policy)
        for policy in policies
    )
    at = Circumstances(
        _time_or_now(now),
        zone,
        _checked_domain(domain),
        read,
        find_distribution(distribution).given_name if distribution else "",
        _selected_vendors("", distribution),
        robots,
    )
    findings = path_findings(map(Path, paths), at)
    lowest = None if severity == "warning" else levels[severity]
    chosen = FindingFilter(severity=lowest, strict=strict, vendors=at.vendors)
    return chosen.choose(findings).shown


@_with_checked_arguments
def check_requirements(
    path: AnyPath | Sequence[AnyPath],
    requirements: AnyPath | Sequence[AnyPath],
    *,
    fleet: AnyPath | None = None,
    template: AnyPath = "",
    vendor: str = "",
    distribution: str = "",
    domain: int | None = None,
    now: datetime | None = None,
    zone: tzinfo = UTC,
    namespaces: Sequence[str] = ("/",),
    remaps: Sequence[str] = (),
) -> tuple[Finding, ...]:
    """Return a finding for each requirement that a policy or a keystore breaks, for all names.

    Args:
        path: A keystore, a policy file or a folder of policies; or several policies of one robot or
            fleet, which count as one policy.
        requirements: The TOML file of the requirements, or several.
        fleet: The file with the robots that the placeholders of a policy and its requirements stand
            for; a keystore has its own fleet.
        template: The keystore template, by name or file, whose protection is assumed for a policy.
            Without it, the default template is assumed where the policy states no protection, and a
            finding reports this.
        vendor: The only DDS vendor to decide for, or "zenoh"; every tested vendor and Zenoh by
            default.
        distribution: The ROS 2 distribution, such as "lyrical", whose DDS decides; without
            ``vendor``, all that it ships.  In place of one that is not supported any more, such as
            "foxy", the next supported one decides, and no finding says so.
        domain: The only ROS domain id to decide for; by default one of each group of domains that
            the keystore's documents treat alike.
        now: The time at which permissions have to be valid; the current time by default.
        zone: The time zone of the robot, in which some vendors read dates.
        namespaces: Namespaces such as "/left", in each of which the requirements have to hold: the
            enclaves of the requirements, and their names without a "/" or "*" at the beginning, are
            below it.
        remaps: Remappings of names in the requirements, as nodes were remapped in the policy, such
            as "image:=/front/image" or "gripper:__node:=front".

    Returns:
        Findings with ``subject``, ``text``, ``file`` and ``line``, and in ``related`` the other
        lines of the policy and the line of the requirement. The ``id`` of a requirement that does
        not hold is "requirement.violated"; other ids are about requirements that protect less than
        they state, and some are notes (``severity``).

    Raises:
        DocumentError: A file cannot be read, or there are too many wildcards to decide a
            requirement.
        InvalidNameError: A namespace is not valid, or has a wildcard.
        UsageError: There is no such vendor or distribution, ``domain`` is not a domain id, or a
            remapping is not valid, or is for a name that neither the requirements nor the policy
            have.

    Example:
        >>> for finding in sros_tool.check_requirements("robot.xml", "robot.requirements.toml"):
        ...     print(finding.place, finding.text)
    """
    from sros_tool.checks.keystores.opened import Circumstances
    from sros_tool.checks.kind import NOTE
    from sros_tool.fleet.fleet_file import read_fleet
    from sros_tool.keystore.template import load_template
    from sros_tool.names import check_plain_namespace
    from sros_tool.policy.remapping import parse_remapping_of_names
    from sros_tool.proof.findings import (
        left_out_robot_findings,
        requirement_findings,
        unused_remapping_findings,
    )
    from sros_tool.proof.requirements import read_all_requirements
    from sros_tool.proof.system import WORLDS, load_system

    if vendor and vendor not in WORLDS:
        raise UsageError(f"unknown vendor {vendor!r}", "", f"Choose {', '.join(WORLDS)}.")
    at = Circumstances(
        _time_or_now(now),
        zone,
        _checked_domain(domain),
        vendors=_selected_vendors(vendor, distribution),
        fleet=read_fleet(Path(fleet)) if fleet else None,
    )
    files = [requirements] if isinstance(requirements, str | PathLike) else requirements
    paths = [Path(file) for file in files]
    system = load_system(
        [Path(path)] if isinstance(path, str | PathLike) else list(map(Path, path)),
        at,
        load_template(fspath(template)) if template else None,
    )
    places = [check_plain_namespace(namespace) for namespace in namespaces] or ["/"]
    rules = [parse_remapping_of_names(remap) for remap in remaps]
    wanted = read_all_requirements(paths, system.fleet, places, rules)
    findings = [
        *requirement_findings(wanted, system),
        *left_out_robot_findings(system, places),
        *unused_remapping_findings(paths, system, places, rules),
    ]
    return tuple(
        finding for finding in findings if finding.severity > NOTE or finding.kind.prominent
    )


@_with_checked_arguments
def new_access(
    base: AnyPath,
    head: AnyPath,
    *,
    fleet: AnyPath | None = None,
    base_fleet: AnyPath | None = None,
) -> Growth:
    """Return the access that ``head`` gives enclaves and ``base`` does not, decided for all names.

    Args:
        base: The state before the change: a policy, a folder of policies, a keystore, an exported
            enclave, permissions, a Zenoh configuration, or policies at a git revision, such as
            "git:main:policies/robot.xml", of the repository that the working directory is in.
        head: The state after the change: any of these.
        fleet: The file with the robots that the placeholders of policies stand for.
        base_fleet: The fleet file for ``base``, if it differs from ``fleet``.

    Returns:
        What is ``added`` and ``removed``, whom enclaves can influence now (``reach``), the nodes
        that get more rights in another enclave (``new_nodes``), the rights that are new only for
        users who put the node into another namespace (``elsewhere``: ``cmd`` became ``/cmd``), and
        the protection that is ``lost`` and ``gained``. As a condition, the result is false if there
        is no such access, and nothing is lost. Denials that ``head`` lacks
        (``dropped_denials``) do not count: nobody gets access yet, but other policies may allow
        the names now, so `sros review` fails. ``assumed`` and ``left_out`` state the assumptions: a
        policy counts as signed, with a governance that controls all access; a policy as ``base``
        also counts as protected by the default governance.

    Raises:
        SrosError: A path cannot be read, or the question cannot be decided, for instance because a
            signature does not verify; the new access is then unknown.

    Example:
        >>> for gain in sros_tool.new_access("git:main:robot.xml", "robot.xml").added:
        ...     print(*gain.enclaves, gain.action, gain.name, gain.source)
        /camera subscribe /cmd_vel robot.xml:12
    """
    from sros_tool.fleet.fleet_file import read_fleet
    from sros_tool.proof.growth import compare_access
    from sros_tool.proof.sources import load_side

    robots = read_fleet(Path(fleet)) if fleet else None
    earlier = read_fleet(Path(base_fleet)) if base_fleet else robots
    return compare_access(load_side(Path(base), earlier), load_side(Path(head), robots))


def _time_or_now(now: datetime | None) -> datetime:
    """Return ``now``, which must have a time zone, or the current time if ``now`` is None."""
    if now is None:
        return datetime.now(UTC)
    if now.tzinfo is None:
        raise UsageError(
            f"the time {now.isoformat()} has no time zone", "", "Add one, such as tzinfo=UTC."
        )
    return now


def _checked_domain(domain: int | None) -> int | None:
    """Return the ROS domain id, or None; raise `UsageError` for an id that is not valid."""
    from sros_tool.dds.domains import DomainSet

    return None if domain is None else DomainSet.parse(str(domain), "domain").only()


def _selected_vendors(vendor: str, distribution: str) -> tuple[str, ...]:
    """Return the vendors that a caller selects; () for all.

    Raises:
        UsageError: there is no such distribution, or it does not ship the vendor.
    """
    from sros_tool.dds.decision.vendors import ZENOH
    from sros_tool.distributions import find_distribution, selected_vendors

    named = (find_distribution(distribution),) if distribution else ()
    return selected_vendors(vendor, named if vendor != ZENOH else ())


def _as_policy(source: AnyPath | Policy) -> Policy:
    return read_policy(source) if isinstance(source, str | PathLike) else source


def _make_keyring(
    secrets: Secrets | None,
    identity_key: str | None,
    permissions_key: str | None,
    *,
    encrypt: bool = False,
    short_passphrase: bool = False,
) -> Keyring:
    from sros_tool.keystore.issuing.keyring import Keyring, absolute_place, no_secrets

    named = {"identity": identity_key, "permissions": permissions_key}
    places = {role: absolute_place(place) for role, place in named.items() if place}
    return Keyring(
        _checked_secrets(secrets) if secrets else no_secrets, places, encrypt, short_passphrase
    )


def _checked_secrets(secrets: Secrets) -> Secrets:
    """Wrap ``secrets`` so that any result but a string raises an error."""

    def secret(prompt: str) -> str:
        text: str = _checked_argument("the return value of secrets", "str", secrets(prompt))
        return text

    return secret


def _read_file(path: AnyPath) -> bytes:
    from sros_tool.xml import read_bytes

    return read_bytes(Path(path), "file")
