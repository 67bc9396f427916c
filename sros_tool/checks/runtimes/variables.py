"""The ROS_SECURITY_* variables: what they make of a process, and what they do not."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping
from pathlib import Path

from sros_tool.checks.keystores.keystore import keystore_findings
from sros_tool.checks.kind import ERROR, NOTE, WARNING, Finding, Kind, by_id
from sros_tool.checks.runtimes.setting import Setting
from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import parse_governance
from sros_tool.errors import SrosError
from sros_tool.keystore.enclave import enclave_path
from sros_tool.keystore.layout import (
    GOVERNANCE_P7S,
    IDENTITY,
    PERMISSIONS,
    ca_key,
    enclave_names,
    is_keystore,
)
from sros_tool.pki import smime
from sros_tool.runtime.environment import DOMAIN, ENABLE, ENCLAVE, KEYSTORE, STRATEGY, domain_from
from sros_tool.xml import read_bytes

_RCL = "rcl 9 (rcl/src/rcl/security.c); ran with ROS 2 Jazzy."
_NAME_IT = (
    "Start each process with `sros run ROOT NAME -- COMMAND...`, or set its enclave in the launch "
    "file."
)
_ENV = '`eval "$(sros env ROOT NAME)"` sets all of them.'

ENABLE_MISSPELT = Kind(
    "runtime.enable-misspelt",
    ERROR,
    "ROS_SECURITY_ENABLE is neither true nor false",
    "Only exactly `true` switches security on; with anything else every node runs unsecured, and "
    "says nothing about it.",
    _RCL,
    f"Write ROS_SECURITY_ENABLE=true. {_ENV}",
)
NOT_ENABLED = Kind(
    "runtime.not-enabled",
    WARNING,
    "security is prepared and not switched on",
    "Without ROS_SECURITY_ENABLE=true nodes run unsecured, whatever the other variables say.",
    _RCL,
    f"Write ROS_SECURITY_ENABLE=true, or unset the others. {_ENV}",
)
MISSPELT = Kind(
    "runtime.variable-misspelt",
    ERROR,
    "a variable that nobody reads",
    "It is all but the name of one that rcl reads, so what it says is ignored in silence.",
    _RCL,
    "Correct the name.",
)
STRATEGY_MISSPELT = Kind(
    "runtime.strategy-misspelt",
    ERROR,
    "ROS_SECURITY_STRATEGY is neither Enforce nor Permissive",
    "Only exactly `Enforce` enforces; with anything else a node whose enclave is missing runs "
    "unsecured.",
    _RCL,
    f"Write ROS_SECURITY_STRATEGY=Enforce. {_ENV}",
)
NOT_ENFORCED = Kind(
    "runtime.not-enforced",
    WARNING,
    "security is on and not enforced",
    "A node whose enclave, or one of whose files, is missing runs unsecured, even while it logs "
    "that it found a security directory.",
    _RCL,
    f"Write ROS_SECURITY_STRATEGY=Enforce. {_ENV}",
)
KEYSTORE_UNSET = Kind(
    "runtime.keystore-unset",
    ERROR,
    "security is on and no keystore is named",
    "With Enforce no node starts (error not set); without, all run unsecured.",
    _RCL,
    f"Set ROS_SECURITY_KEYSTORE. {_ENV}",
)
KEYSTORE_NOT_FOUND = Kind(
    "runtime.keystore-not-found",
    ERROR,
    "ROS_SECURITY_KEYSTORE names no keystore",
    "With Enforce no node starts; without, all run unsecured.",
    _RCL,
    f"Correct the path. {_ENV}",
)
KEYSTORE_RELATIVE = Kind(
    "runtime.keystore-relative",
    WARNING,
    "ROS_SECURITY_KEYSTORE is a relative path",
    "It means something else to each process that is started in another folder, as services are.",
    _RCL,
    f"Write the whole path. {_ENV}",
)
ENCLAVE_NOT_FOUND = Kind(
    "runtime.enclave-not-found",
    ERROR,
    "the enclave is not in the keystore",
    "With Enforce the node does not start; without, it runs unsecured. Names are compared exactly.",
    _RCL,
    "Correct the name, or make it with `sros create_enclave`.",
)
NO_ENCLAVE = Kind(
    "runtime.enclave-unset",
    WARNING,
    "no enclave is named",
    "Every process has to say --ros-args --enclave NAME; one that does not uses the enclave /, "
    "which the keystore does not have, and does not start.",
    _RCL,
    _NAME_IT,
)
UNSECURED_WITHOUT_ENCLAVE = Kind(
    "runtime.unsecured-without-enclave",
    ERROR,
    "no enclave is named, and nodes run unsecured",
    "A process that does not say --ros-args --enclave NAME uses the enclave /, which the keystore "
    "does not have; as ROS_SECURITY_STRATEGY is not exactly `Enforce`, it then runs UNSECURED.",
    _RCL,
    f"Write ROS_SECURITY_STRATEGY=Enforce. {_NAME_IT}",
)
DOMAIN_MALFORMED = Kind(
    "runtime.domain-malformed",
    ERROR,
    "ROS_DOMAIN_ID is no domain id",
    "Nodes do not start, or with a leading zero join another domain than it seems.",
    "rcl 9 (rcl/src/rcl/domain_id.c: strtoul with base 0); domains above 230 Cyclone DDS refuses.",
    "Write one whole number from 0 to 230, without leading zeros.",
)
DOMAIN_NOT_GOVERNED = Kind(
    "runtime.domain-not-governed",
    ERROR,
    "the keystore is not made for this domain",
    'No node starts: Fast DDS says "Not found topic access rule for topic ros_discovery_info", '
    'Cyclone DDS "Could not find domain in governance".',
    "DDS-Security 1.1, 9.4.1.2; measured.",
    "Set ROS_DOMAIN_ID to a domain of the keystore, or make one with --domain.",
)
CA_KEY_HERE = Kind(
    "runtime.ca-key-present",
    NOTE,
    "nodes run with the keystore that has the keys of the CAs",
    "Who breaks into a node can make any enclave, with any rights.",
    "ROS 2 design, ROS 2 Security Enclaves; NIST SP 800-57 part 1, 6.",
    "Run them with an export (`sros distribute_key`), and keep the keystore elsewhere.",
)

KINDS = by_id(
    ENABLE_MISSPELT, NOT_ENABLED, MISSPELT, STRATEGY_MISSPELT, NOT_ENFORCED, KEYSTORE_UNSET,
    KEYSTORE_NOT_FOUND, KEYSTORE_RELATIVE, ENCLAVE_NOT_FOUND, NO_ENCLAVE,
    UNSECURED_WITHOUT_ENCLAVE, DOMAIN_MALFORMED, DOMAIN_NOT_GOVERNED, CA_KEY_HERE,
)  # fmt: skip

_READ = (
    ENABLE, STRATEGY, KEYSTORE, ENCLAVE, DOMAIN, "RMW_IMPLEMENTATION", "ROS_SECURITY_LOG_FILE",
    "ROS_SECURITY_LOG_VERBOSITY", "ROS_SECURITY_LOG_PUBLISH",
)  # fmt: skip
_OLD = {
    "ROS_SECURITY_ROOT_DIRECTORY": KEYSTORE,
    "ROS_SECURITY_NODE_DIRECTORY": ENCLAVE,
    "ROS_SECURITY_LOOKUP_TYPE": ENCLAVE,
}
_CLOSE = 0.88


def check_variables(setting: Setting) -> Iterator[Finding]:
    """The variables, and the enclave that they name, as a node would load it."""
    environment = setting.environment
    yield from _spelling(environment)
    if environment.get(ENABLE) != "true":
        return
    if environment.get(STRATEGY) != "Enforce" and environment.get(STRATEGY) in (
        None, "", "Permissive",
    ):  # fmt: skip
        yield NOT_ENFORCED.found(STRATEGY, _value(environment, STRATEGY))
    domain: int | None = None
    try:
        domain = domain_from(environment) or 0
    except SrosError as error:
        yield DOMAIN_MALFORMED.found(DOMAIN, error.what, remedy=error.remedy)
    text = environment.get(KEYSTORE, "")
    if not text:
        yield KEYSTORE_UNSET.found(KEYSTORE, _value(environment, KEYSTORE))
        return
    root = Path(text)
    if not root.is_absolute():
        yield KEYSTORE_RELATIVE.found(KEYSTORE, _value(environment, KEYSTORE))
    if not is_keystore(root):
        missing = "does not exist" if not root.exists() else "has no enclaves folder in use"
        yield KEYSTORE_NOT_FOUND.found(KEYSTORE, f"'{root}' {missing}")
        return
    yield from _enclave(setting, root, domain)


def _spelling(environment: Mapping[str, str]) -> Iterator[Finding]:
    enable, strategy = environment.get(ENABLE), environment.get(STRATEGY)
    if enable not in (None, "", "true", "false"):
        yield ENABLE_MISSPELT.found(ENABLE, _value(environment, ENABLE))
    elif enable is None and (strategy or environment.get(KEYSTORE) or environment.get(ENCLAVE)):
        named = [name for name in (STRATEGY, KEYSTORE, ENCLAVE) if environment.get(name)]
        yield NOT_ENABLED.found(ENABLE, f"{', '.join(named)} are set, and {ENABLE} is not")
    if strategy not in (None, "", "Enforce", "Permissive"):
        yield STRATEGY_MISSPELT.found(STRATEGY, _value(environment, STRATEGY))
    for name in sorted(environment):
        if name in _READ or not name.upper().startswith(("ROS", "RMW")):
            continue
        close = difflib.get_close_matches(name.upper(), _READ, n=1, cutoff=_CLOSE)
        meant = _OLD.get(name) or (close[0] if close else "")
        if meant:
            yield MISSPELT.found(name, f"{name} is set; {meant} is meant")


def _enclave(setting: Setting, root: Path, domain: int | None) -> Iterator[Finding]:
    names, wanted = set(enclave_names(root)), setting.environment.get(ENCLAVE, "")
    governed = _governed(root)
    if governed and domain is not None and domain not in governed:
        text = f"the governance of '{root}' is for domain {governed}, not for {domain}"
        yield DOMAIN_NOT_GOVERNED.found(DOMAIN, text)
        domain = None  # this is said
    for role in (IDENTITY, PERMISSIONS):
        if (root / ca_key(role)).exists():
            yield CA_KEY_HERE.found(KEYSTORE, f"'{root / ca_key(role)}' is there")
            break
    if not wanted and "/" not in names:
        enforced = setting.environment.get(STRATEGY) == "Enforce"
        kind = NO_ENCLAVE if enforced else UNSECURED_WITHOUT_ENCLAVE
        yield kind.found(ENCLAVE, f"it is not set, and '{root}' has no enclave /")
        return
    name = wanted or "/"
    if name not in names and not enclave_path(root, name).is_dir():
        close = difflib.get_close_matches(name, names, n=1)
        hint = f"; it has {close[0]}" if close else ""
        yield ENCLAVE_NOT_FOUND.found(ENCLAVE, f"'{root}' has no enclave {name}{hint}")
        return
    found = keystore_findings(root, now=setting.now, zone=setting.zone, domain=domain, only=(name,))
    for each in found:
        if each.id == "enclave.governance-domain":
            yield DOMAIN_NOT_GOVERNED.found(DOMAIN, each.text, each.file)
        else:
            yield each


def _governed(root: Path) -> DomainSet | None:
    """The domains that the governance of a keystore names, as far as it can be read."""
    try:
        signed = smime.parse(read_bytes(root / GOVERNANCE_P7S, "governance document"))
        return parse_governance(signed.document).domains().closed()
    except SrosError:  # told of the enclave; an export has a copy in each
        return None


def _value(environment: Mapping[str, str], name: str) -> str:
    value = environment.get(name)
    return f"{name} is not set" if value is None else f"{name} is {value!r}"
