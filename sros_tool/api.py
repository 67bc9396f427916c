"""The functions that other programs may call; `import sros_tool` offers them by name.

Thin on purpose: a function here turns the arguments of a script (a path, the name of a template)
into the values of the package, supplies the present moment, and calls one function below.
Nothing here prints, asks a person, or reads an environment variable.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, tzinfo
from os import PathLike, fspath
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeVar

from sros_tool.errors import Note, UsageError

if TYPE_CHECKING:
    from sros_tool.checks.kind import Finding
    from sros_tool.keystore.authorities.keyring import Keyring
    from sros_tool.keystore.lifecycle.create import Creation
    from sros_tool.keystore.template import Template
    from sros_tool.policy.model import Policy

AnyPath = str | PathLike[str]
Item = TypeVar("Item")
Secrets = Callable[[str], str]
"""Answers with the passphrase or PIN that its argument asks for, in words for a person."""


@dataclass(frozen=True, slots=True)
class Keystore:
    """The folder of a keystore; it can be passed wherever a path is expected.

    ``notes`` are remarks on what was created, such as names on which DDS vendors differ.
    """

    path: Path
    notes: tuple[Note, ...] = field(default=(), compare=False)

    @property
    def enclaves(self) -> tuple[str, ...]:
        """The names of the enclaves that it has at this moment, sorted."""
        from sros_tool.keystore.layout import list_enclaves

        return list_enclaves(self.path)

    def __fspath__(self) -> str:
        return fspath(self.path)


@dataclass(frozen=True, slots=True)
class AccessAnswer:
    """One vendor's decision on an access, and the reason.

    ``outcome`` is "allowed", "denied" (the endpoint is not created), "peer-denies" (it is created,
    and no peer talks to it), "refused" (no node of the enclave starts) or "crashes".  ``reason`` is
    a clause for people; ``expression`` is the DDS topic expression of the rule that decided, or
    "".  ``policy_lines`` are the places ``FILE:LINE`` in the policy that the rule comes from, where
    a policy was given.  ``until`` is when the first of the enclave's files expires, in UTC.
    ``remedy`` says what to do about a denial that no policy change would lift.
    """

    allowed: bool
    outcome: str
    reason: str
    vendor: str
    expression: str = ""
    policy_lines: tuple[str, ...] = ()
    until: datetime | None = None
    remedy: str = ""

    def __bool__(self) -> bool:
        return self.allowed


def create_keystore(
    path: AnyPath,
    template: str | Template = "development",
    *,
    domains: int | str = 0,
    encrypt_ca_keys: bool = False,
    secrets: Secrets | None = None,
    now: datetime | None = None,
) -> Keystore:
    """Create a keystore in the folder ``path``, with its CAs and its governance.

    Args:
        path: The folder; it must not hold a keystore, nor any part of one.
        template: The choices to create it by: "development", "production", "sros2", the path of
            a TOML file, or what `load_template` returned.
        domains: The ROS domains that it is for: 0, or "0,7", or "10-19".
        encrypt_ca_keys: Encrypt the keys of the CAs with the passphrase that ``secrets`` answers.
        secrets: Called for the passphrase of a CA key, or the PIN of a token.
        now: The moment from which validities count; the present one by default.

    Raises:
        KeystoreError: Something is in the way, or a key cannot be used.
        DocumentError: There is no such template, or it is not understood.
        UsageError: ``domains`` are not domain ids.

    Example:
        >>> keystore = sros_tool.create_keystore("ks", template="production")
    """
    from sros_tool.dds.domains import DomainSet
    from sros_tool.keystore.lifecycle import create

    result = create.create_keystore(
        Path(path),
        template=load_template(template) if isinstance(template, str) else template,
        domains=DomainSet.parse(str(domains), "domains"),
        now=_moment(now),
        keyring=_keyring(secrets, encrypt=encrypt_ca_keys),
    )
    return Keystore(result.root, result.notes)


def open_keystore(path: AnyPath) -> Keystore:
    """Return the keystore in the folder ``path``; one that ros2/sros2 created is as good.

    Raises:
        KeystoreError: The folder is not a keystore.

    Example:
        >>> sros_tool.open_keystore("ks").enclaves
        ('/talker_listener/listener', '/talker_listener/talker')
    """
    from sros_tool.keystore.layout import check_keystore

    check_keystore(Path(path))
    return Keystore(Path(path))


def load_template(choice: AnyPath) -> Template:
    """Return the keystore template of that name ("production"), or in the TOML file of that path.

    Change one of its choices with `dataclasses.replace`.

    Raises:
        DocumentError: There is none, or it holds something that is not understood.

    Example:
        >>> template = sros_tool.load_template("production")
        >>> template = dataclasses.replace(template, certificate_validity=timedelta(days=90))
    """
    from sros_tool.keystore import template

    return template.load_template(fspath(choice))


def read_policy(path: AnyPath) -> Policy:
    """Return the policy in the file ``path``, with everything that it includes.

    Raises:
        PolicyError: It is malformed, contradicts itself, or includes a file outside of its folder.
        DocumentError: It cannot be read.

    Example:
        >>> policy = sros_tool.read_policy("policies/talker_listener.xml")
        >>> [enclave.path for enclave in policy.enclaves]
        ['/talker_listener/talker', '/talker_listener/listener']
    """
    from sros_tool.policy import document

    return document.read_policy(Path(path))


def generate(
    keystore: AnyPath,
    *policies: AnyPath | Policy,
    enclaves: Iterable[str] = (),
    domain: int | None = None,
    secrets: Secrets | None = None,
    now: datetime | None = None,
    dry_run: bool = False,
) -> Creation:
    """Create the enclaves of policies, and sign the permissions that the policies state for them.

    All or nothing: after an error the keystore is as it was.  An enclave that exists keeps its key,
    and gets new permissions if a policy names it.

    Args:
        keystore: An existing keystore, or its path.
        policies: Policies, or the paths of policy files.
        enclaves: Names of further enclaves, whose permissions are the template's default.
        domain: The ROS domain that the enclaves will be used in; it must be one of the keystore's.
        secrets: Called for the passphrase of an encrypted CA key, or the PIN of a token.
        now: The moment from which validities count; the present one by default.
        dry_run: Report what would be done, and change nothing.

    Returns:
        The names of the enclaves that were ``created``, ``changed`` (given new permissions),
        ``completed`` (a missing file added) and ``kept`` (left as they were), and ``notes``.

    Raises:
        KeystoreError: There is no keystore, it is busy or broken, or is not for that domain.
        PolicyError: Two policies disagree on an enclave, or a policy file is malformed.
        InvalidNameError: An enclave's name is not valid.
        UsageError: Neither a policy nor an enclave is given.

    Example:
        >>> sros_tool.generate(keystore, "policies/talker_listener.xml").created
        ('/talker_listener/talker', '/talker_listener/listener')
    """
    from sros_tool.keystore.lifecycle import create

    names = tuple(_several("enclaves", enclaves))
    if not (policies or names):
        raise UsageError("neither a policy nor an enclave is given to generate for")
    return create.generate_artifacts(
        Path(keystore),
        enclaves=names,
        policies=[_policy(each) for each in policies],
        now=_moment(now),
        domain=domain,
        keyring=_keyring(secrets),
        dry_run=dry_run,
    )


def export_enclaves(
    keystore: AnyPath,
    enclaves: Iterable[str],
    target: AnyPath,
    *,
    force: bool = False,
    now: datetime | None = None,
) -> Path:
    """Export enclaves for their robot to ``target`` and return it; no CA key is exported.

    Args:
        keystore: The keystore, or its path.
        enclaves: The names of the enclaves.
        target: A file name that ends in ``.tar.gz``, or a folder, which is created.
        force: Replace files of another version in ``target``.
        now: The moment at which the enclaves have to be valid; the present one by default.

    Raises:
        KeystoreError: An enclave does not exist or could not run, or ``target`` holds other files.

    Example:
        >>> sros_tool.export_enclaves(keystore, ["/talker_listener/talker"], "robot.tar.gz")
        PosixPath('robot.tar.gz')
    """
    from sros_tool.keystore.delivery.export import distribute

    names = tuple(_several("enclaves", enclaves))
    if not names:
        raise UsageError("no enclave is given to export")
    return distribute(Path(keystore), names, Path(target), now=_moment(now), force=force).target


def explain_access(
    keystore: AnyPath,
    enclave: str,
    action: str,
    name: str = "",
    *,
    kind: Literal["topic", "service", "action"] | None = None,
    vendor: str = "fastdds",
    policy: AnyPath | Policy | None = None,
    domain: int | None = None,
    now: datetime | None = None,
    zone: tzinfo = UTC,
) -> AccessAnswer:
    """Return whether DDS will allow an access, as the vendor decides by the signed documents.

    Args:
        keystore: The keystore, or its path.
        enclave: The name of the enclave, such as "/talker".
        action: "publish", "subscribe", "call", "serve", "execute" or "join".
        name: The absolute ROS name of the topic, service or action; none for "join".
        kind: What ``name`` is; "call" alone means a service.
        vendor: "fastdds" (2.14), "fastdds-2.9", "cyclonedds", "standard", "opendds" or "connext".
        policy: The policy, or its file, to find the lines in that the deciding rule comes from.
        domain: The ROS domain; by default 0, or the first that the keystore is for.
        now: The moment that is asked about; the present one by default.
        zone: The time zone of the robot, in which some vendors read dates.

    Raises:
        KeystoreError: There is no such keystore or enclave.
        UsageError: No node can do that, or the name, vendor or domain is not valid.

    Example:
        >>> answer = sros_tool.explain_access(keystore, "/talker", "publish", "/chatter")
        >>> answer.allowed, answer.reason
        (True, 'rule 1 allows publish rt/chatter by rt/chatter')
    """
    from sros_tool.dds.decision.vendors import Vendor
    from sros_tool.explain.evaluator import Evaluator, JoinContext, load_enclave
    from sros_tool.explain.question import ask
    from sros_tool.keystore.layout import enclave_path, list_enclaves
    from sros_tool.keystore.missing import no_such_enclave
    from sros_tool.runtime.environment import choose_domain

    question = ask(action, name, kind)
    vendors = [each.value for each in Vendor]
    if vendor not in vendors:
        raise UsageError(f"unknown vendor {vendor!r}", "", f"Choose {', '.join(vendors)}.")
    root = Path(keystore)
    names = list_enclaves(root)
    if enclave not in names:
        raise no_such_enclave(root, enclave, names)
    at = _moment(now)
    own = _policy(policy).enclave(enclave) if policy is not None else None
    loaded = replace(
        load_enclave(enclave, enclave_path(root, enclave), at=at), root=root, policy=own
    )
    if domain is None:
        domain = choose_domain(loaded.domains, None, root) if loaded.domains else 0
    answer = Evaluator(Vendor(vendor), loaded, JoinContext(domain, at, zone)).explain(question)
    decision = answer.decision
    _, colon, reason = decision.text.partition(": ")
    return AccessAnswer(
        answer.allowed,
        answer.outcome.value,
        (reason if colon else decision.text).removesuffix("."),
        vendor,
        decision.expression or "",
        tuple(str(each.source) for each in answer.lines),
        answer.until,
        answer.remedy,
    )


def check(
    *paths: AnyPath,
    policies: Iterable[AnyPath | Policy] = (),
    severity: Literal["note", "warning", "error"] = "warning",
    strict: bool = False,
    domain: int | None = None,
    now: datetime | None = None,
    zone: tzinfo = UTC,
) -> tuple[Finding, ...]:
    """Return what is wrong or weak in keystores, enclaves and policies, the worst first.

    Args:
        paths: Keystores, folders of enclaves, policy files, or folders of policy files.
        policies: Policies, or their files, to compare the permissions of keystores with.
        severity: The lowest severity that is returned.
        strict: Report in full also the weaknesses that a keystore's template accepts.
        domain: The ROS domain that enclaves have to join.
        now: The moment that is asked about; the present one by default.
        zone: The time zone of the robot, in which some vendors read dates.

    Returns:
        Findings with ``id``, ``severity``, ``file``, ``line`` (from 1, or None), ``subject``,
        ``text`` and ``remedy``.

    Raises:
        DocumentError: A path is neither a policy, nor a keystore, nor an enclave.
        UsageError: No path is given, or the severity is unknown.

    Example:
        >>> for finding in sros_tool.check("ks"):
        ...     print(finding.place, finding.id, finding.text, finding.remedy)
    """
    from sros_tool.checks.kind import Severity
    from sros_tool.checks.registry import FindingFilter
    from sros_tool.checks.targets import Circumstances, path_findings

    levels = {each.word: each for each in Severity}
    if not paths:
        raise UsageError("no path is given to check")
    if severity not in levels:
        raise UsageError(f"unknown severity {severity!r}", "", f"Choose {', '.join(levels)}.")
    read = tuple(_policy(each) for each in _several("policies", policies))
    at = Circumstances(_moment(now), zone, domain, read)
    found = dict.fromkeys(each for path in paths for each in path_findings(Path(path), at))
    return FindingFilter(severity=levels[severity], strict=strict).choose(found).shown


def _moment(now: datetime | None) -> datetime:
    """Return ``now``, which must have a time zone, or the present moment if it is None."""
    if now is None:
        return datetime.now(UTC)
    if now.tzinfo is None:
        raise UsageError(
            f"the moment {now.isoformat()} has no time zone", "", "Add one, such as tzinfo=UTC."
        )
    return now


def _policy(given: AnyPath | Policy) -> Policy:
    return read_policy(given) if isinstance(given, str | PathLike) else given


def _keyring(secrets: Secrets | None, *, encrypt: bool = False) -> Keyring:
    from sros_tool.keystore.authorities.keyring import Keyring, no_secrets

    return Keyring(secrets or no_secrets, encrypt=encrypt)


def _several(parameter: str, given: Iterable[Item]) -> Iterable[Item]:
    """Return ``given``; refuse a single string, whose letters would count as items."""
    if isinstance(given, str):
        raise UsageError(f"{parameter} is one string", "", f"Pass a list: [{given!r}].")
    return given
