"""Checks of the variables that choose security, and of the enclaves and files that they name."""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from datetime import datetime, tzinfo
from pathlib import Path

from sros_tool.checks.keystores.keystore import keystore_findings
from sros_tool.checks.keystores.opened import Circumstances
from sros_tool.checks.kind import ERROR, NOTE, WARNING, Finding, FindingKind
from sros_tool.checks.zenoh import MALFORMED, document_findings
from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import parse_governance
from sros_tool.distributions import ROS_DISTRO
from sros_tool.errors import KeystoreError, SrosError
from sros_tool.faults import Fault
from sros_tool.graph.observation import PROFILE_VARIABLES
from sros_tool.keystore.fleet import stated_distributions
from sros_tool.keystore.layout import (
    GOVERNANCE_P7S,
    IDENTITY,
    PERMISSIONS,
    ca_key_path,
    is_keystore,
    refuse_flat_keystore,
    search_enclaves,
)
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.runtime.environment import (
    NO_CONFIGURATION,
    OVERRIDE,
    RMW_ZENOH,
    ROUTER_URI,
    SESSION_URI,
    override_pairs,
)
from sros_tool.runtime.rmw import RMW, package_version
from sros_tool.runtime.variables import DOMAIN, ENABLE, ENCLAVE, KEYSTORE, STRATEGY, domain_from
from sros_tool.wording import enumerated
from sros_tool.xml import read_bytes
from sros_tool.zenoh.document import (
    ENDINGS,
    ConfigurationDocument,
    UnreadConfigurationError,
    parse_configuration,
)
from sros_tool.zenoh.releases import version_text, why_too_old

_RCL_SOURCE = "rcl 9 (rcl/src/rcl/security.c); tested with ROS 2 Jazzy."
_NAME_ENCLAVE_REMEDY = (
    "Start each process with `sros run KEYSTORE ENCLAVE -- COMMAND...`, or set its enclave in the "
    "launch file."
)
_ENV_REMEDY = '`eval "$(sros env KEYSTORE ENCLAVE)"` sets all variables.'

ENABLE_MISSPELT = FindingKind(
    "runtime.enable-misspelt",
    ERROR,
    "ROS_SECURITY_ENABLE is neither true nor false",
    "Only the exact value `true` enables security. With any other value every node runs "
    "unsecured, and does not report it.",
    _RCL_SOURCE,
    f"Write ROS_SECURITY_ENABLE=true. {_ENV_REMEDY}",
)
NOT_ENABLED = FindingKind(
    "runtime.not-enabled",
    WARNING,
    "security is configured but not enabled",
    "Without ROS_SECURITY_ENABLE=true every node runs unsecured, whatever the other variables are.",
    _RCL_SOURCE,
    f"Write ROS_SECURITY_ENABLE=true, or unset the other variables. {_ENV_REMEDY}",
)
MISSPELT = FindingKind(
    "runtime.variable-misspelt",
    ERROR,
    "a misspelled or obsolete variable, which ROS 2 ignores",
    "The name looks like a misspelled or old name of a variable that rcl reads. rcl ignores it "
    "without a message.",
    _RCL_SOURCE,
    "Correct the name.",
)
STRATEGY_MISSPELT = FindingKind(
    "runtime.strategy-misspelt",
    ERROR,
    "ROS_SECURITY_STRATEGY is neither Enforce nor Permissive",
    "Only the exact value `Enforce` enforces security. With any other value a node runs "
    "unsecured if its enclave, or a file of the enclave, is missing.",
    _RCL_SOURCE,
    f"Write ROS_SECURITY_STRATEGY=Enforce. {_ENV_REMEDY}",
)
NOT_ENFORCED = FindingKind(
    "runtime.not-enforced",
    WARNING,
    "security is enabled but not enforced",
    "A node runs unsecured if its enclave, or a file of the enclave, is missing, even if the "
    "node logs that it found a security directory.",
    _RCL_SOURCE,
    f"Write ROS_SECURITY_STRATEGY=Enforce. {_ENV_REMEDY}",
)
KEYSTORE_UNSET = FindingKind(
    "runtime.keystore-unset",
    ERROR,
    "security is enabled, but ROS_SECURITY_KEYSTORE is not set",
    'With ROS_SECURITY_STRATEGY=Enforce, no node starts (rcl says "error not set"); otherwise, '
    "every node runs unsecured.",
    _RCL_SOURCE,
    f"Set ROS_SECURITY_KEYSTORE. {_ENV_REMEDY}",
)
KEYSTORE_NOT_FOUND = FindingKind(
    "runtime.keystore-not-found",
    ERROR,
    "ROS_SECURITY_KEYSTORE is not a keystore",
    "With ROS_SECURITY_STRATEGY=Enforce, no node starts; otherwise, every node runs unsecured.",
    _RCL_SOURCE,
    f"Correct the path. {_ENV_REMEDY}",
)
KEYSTORE_RELATIVE = FindingKind(
    "runtime.keystore-relative",
    WARNING,
    "ROS_SECURITY_KEYSTORE is a relative path",
    "Each process resolves the path in its working directory, so a systemd unit, for instance, "
    "looks in another folder.",
    _RCL_SOURCE,
    f"Write the absolute path. {_ENV_REMEDY}",
)
OTHER_DISTRIBUTION = FindingKind(
    "runtime.other-distribution",
    WARNING,
    "ROS_DISTRO is none of the distributions that the keystore is for",
    "`sros check` decides by the rules of the DDS that the keystore's distributions ship. "
    "Another distribution can allow or deny other accesses, without any message.",
    "sros: `distributions` in the settings of a keystore, `distribution` in its fleet file.",
    "Source one of these distributions. Or check your distribution (`sros check KEYSTORE` with "
    "`--upgrade-to`), and then name it: for the keystore, with `sros update_keystore KEYSTORE "
    "--set distributions=NAME,...`; for one robot, as `distribution` in the fleet file.",
)
ENCLAVE_NOT_FOUND = FindingKind(
    "runtime.enclave-not-found",
    ERROR,
    "the enclave is not in the keystore",
    "With ROS_SECURITY_STRATEGY=Enforce, the node does not start; otherwise, it runs unsecured. "
    "Names are case-sensitive.",
    _RCL_SOURCE,
    "Correct the name, or create the enclave with `sros create_enclave KEYSTORE ENCLAVE`.",
)
NO_ENCLAVE = FindingKind(
    "runtime.enclave-unset",
    WARNING,
    "ROS_SECURITY_ENCLAVE_OVERRIDE is not set",
    "A process without `--ros-args --enclave ENCLAVE` uses the enclave /, which the keystore does "
    "not have, so the process does not start.",
    _RCL_SOURCE,
    _NAME_ENCLAVE_REMEDY,
)
UNSECURED_WITHOUT_ENCLAVE = FindingKind(
    "runtime.unsecured-without-enclave",
    ERROR,
    "ROS_SECURITY_ENCLAVE_OVERRIDE is not set, and nodes run unsecured",
    "A process without `--ros-args --enclave ENCLAVE` uses the enclave /, which the keystore does "
    "not have. The process runs UNSECURED, because ROS_SECURITY_STRATEGY is not exactly "
    "`Enforce`.",
    _RCL_SOURCE,
    f"Write ROS_SECURITY_STRATEGY=Enforce. {_NAME_ENCLAVE_REMEDY}",
)
DOMAIN_MALFORMED = FindingKind(
    "runtime.domain-malformed",
    ERROR,
    "ROS_DOMAIN_ID is not a valid domain id",
    "Nodes do not start. But if the value has a leading zero, they read it as octal, and join "
    "another domain.",
    "rcl 9 (rcl/src/rcl/domain_id.c: strtoul with base 0); Cyclone DDS refuses domains above 230.",
    "Write one whole number from 0 to 230, without leading zeros.",
)
DOMAIN_NOT_GOVERNED = FindingKind(
    "runtime.domain-not-governed",
    ERROR,
    "the keystore does not cover this domain",
    'No node starts: Fast DDS says "Not found topic access rule for topic ros_discovery_info", '
    'Cyclone DDS "Could not find domain in governance".',
    "DDS-Security 1.1, 9.4.1.2; tested.",
    Fault.GOVERNANCE_DOMAIN.remedy.format(root="KEYSTORE", enclave="ENCLAVE"),
)
CA_KEY_HERE = FindingKind(
    "runtime.ca-key-present",
    NOTE,
    "nodes use the keystore that holds the CA keys",
    "An attacker who takes over a node can create any enclave, with any rights.",
    "ROS 2 design, ROS 2 Security Enclaves; NIST SP 800-57 part 1, 6.",
    "Run nodes with an export (`sros distribute_key KEYSTORE ENCLAVE TARGET`), and keep this "
    "keystore on another machine.",
)

_VARIABLES_READ = (
    ENABLE, STRATEGY, KEYSTORE, ENCLAVE, DOMAIN, "RMW_IMPLEMENTATION", "ROS_SECURITY_LOG_FILE",
    "ROS_SECURITY_LOG_VERBOSITY", "ROS_SECURITY_LOG_PUBLISH",
)  # fmt: skip
_OBSOLETE_VARIABLES = {
    "ROS_SECURITY_ROOT_DIRECTORY": KEYSTORE,
    "ROS_SECURITY_NODE_DIRECTORY": ENCLAVE,
    "ROS_SECURITY_LOOKUP_TYPE": ENCLAVE,
}
_LEAST_SIMILARITY = 0.88


def variable_findings(
    environment: Mapping[str, str], *, now: datetime, zone: tzinfo
) -> Iterator[Finding]:
    """Yield findings about the environment variables and the enclave that they name."""
    yield from _spelling_findings(environment)
    if environment.get(ENABLE) != "true":
        return
    if environment.get(STRATEGY) != "Enforce" and environment.get(STRATEGY) in (
        None, "", "Permissive",
    ):  # fmt: skip
        yield NOT_ENFORCED.found(STRATEGY, value_text(environment, STRATEGY))
    domain: int | None = None
    try:
        domain = domain_from(environment) or 0
    except SrosError as error:
        yield DOMAIN_MALFORMED.found(DOMAIN, error.what, remedy=error.remedy)
    text = environment.get(KEYSTORE, "")
    if not text:
        yield KEYSTORE_UNSET.found(KEYSTORE, value_text(environment, KEYSTORE))
        return
    root = Path(text)
    if not root.is_absolute():
        yield KEYSTORE_RELATIVE.found(KEYSTORE, value_text(environment, KEYSTORE))
    if not is_keystore(root):
        missing = "does not exist" if not root.exists() else "has no folder 'enclaves' with content"
        remedy = ""
        try:
            refuse_flat_keystore(root)
        except KeystoreError as error:
            missing, remedy = f"is not read. {error.why}".rstrip("."), error.remedy
        yield KEYSTORE_NOT_FOUND.found(KEYSTORE, f"'{root}' {missing}", remedy=remedy)
        return
    yield from _enclave_findings(environment, OpenedKeystore(root), domain, now=now, zone=zone)


def variables_without_enable(environment: Mapping[str, str]) -> list[str]:
    """Return the security variables that are set although ROS_SECURITY_ENABLE is not set."""
    if ENABLE in environment:
        return []
    return [name for name in (STRATEGY, KEYSTORE, ENCLAVE) if environment.get(name)]


def _spelling_findings(environment: Mapping[str, str]) -> Iterator[Finding]:
    enable, strategy = environment.get(ENABLE), environment.get(STRATEGY)
    if enable not in (None, "", "true", "false"):
        yield ENABLE_MISSPELT.found(ENABLE, value_text(environment, ENABLE))
    elif named := variables_without_enable(environment):
        yield NOT_ENABLED.found(
            ENABLE,
            f"{enumerated(named)} {'is' if len(named) == 1 else 'are'} set, and {ENABLE} is not",
        )
    if strategy not in (None, "", "Enforce", "Permissive"):
        yield STRATEGY_MISSPELT.found(STRATEGY, value_text(environment, STRATEGY))
    for name in sorted(environment):
        if name in _VARIABLES_READ or not name.upper().startswith(("ROS", "RMW")):
            continue
        close = difflib.get_close_matches(
            name.upper(), _VARIABLES_READ, n=1, cutoff=_LEAST_SIMILARITY
        )
        known_name = _OBSOLETE_VARIABLES.get(name) or (close[0] if close else "")
        if known_name:
            yield MISSPELT.found(name, f"{name} is set; ROS 2 reads {known_name}")


def _enclave_findings(
    environment: Mapping[str, str],
    keystore: OpenedKeystore,
    domain: int | None,
    *,
    now: datetime,
    zone: tzinfo,
) -> Iterator[Finding]:
    root = keystore.root
    names, wanted = set(search_enclaves(root)[0]), environment.get(ENCLAVE, "")
    governed = _governed_domains(keystore)
    if governed and domain is not None and domain not in governed:
        text = f"the governance of '{root}' is for domain {governed}, not for {domain}"
        yield DOMAIN_NOT_GOVERNED.found(DOMAIN, text)
        domain = None  # reported here, so not again for the enclave
    for role in (IDENTITY, PERMISSIONS):
        if (root / ca_key_path(role)).exists():
            yield CA_KEY_HERE.found(KEYSTORE, f"'{root / ca_key_path(role)}' exists")
            break
    if not wanted and "/" not in names:
        enforced = environment.get(STRATEGY) == "Enforce"
        kind = NO_ENCLAVE if enforced else UNSECURED_WITHOUT_ENCLAVE
        yield kind.found(ENCLAVE, f"'{root}' has no enclave /")
        return
    name = wanted or "/"
    if name not in names and not keystore.folder(name).is_dir():
        close = difflib.get_close_matches(name, names, n=1)
        hint = f"; it has {close[0]}" if close else ""
        enforced = environment.get(STRATEGY) == "Enforce"
        effect = "" if enforced else f"; nodes RUN UNSECURED, as {STRATEGY} is not 'Enforce'"
        yield ENCLAVE_NOT_FOUND.found(ENCLAVE, f"'{root}' has no enclave {name}{hint}{effect}")
        return
    sourced = environment.get(ROS_DISTRO, "")
    stated: tuple[str, ...] = ()
    with suppress(SrosError):  # what cannot be read is a finding of the keystore
        stated = stated_distributions(keystore, name)
    if sourced and stated and sourced not in stated:
        text = f"{value_text(environment, ROS_DISTRO)}; {name} is for {', '.join(stated)}"
        yield OTHER_DISTRIBUTION.found(ROS_DISTRO, text)
    findings = keystore_findings(keystore, Circumstances(now, zone, domain), only_enclaves=(name,))
    for finding in findings:
        if finding.id == "enclave.governance-domain":
            text = f"the governance of {name}: {finding.text}"
            yield DOMAIN_NOT_GOVERNED.found(DOMAIN, text, finding.file)
        else:
            yield finding


def _governed_domains(keystore: OpenedKeystore) -> DomainSet | None:
    """Return the ROS domains of a keystore's governance, or None if it is unreadable."""
    try:
        message = keystore.read(GOVERNANCE_P7S, "governance document")
        signed = keystore.files.signed_document(message)
        return parse_governance(signed.document).domains().closed()
    except SrosError:  # reported for each enclave, which has a copy of the file in an export
        return None


def value_text(environment: Mapping[str, str], name: str) -> str:
    """Return a clause with the variable's value, such as ``ROS_DOMAIN_ID is '7'``."""
    value = environment.get(name)
    return f"{name} is not set" if value is None else f"{name} is {value!r}"


_ZENOH_SOURCE = "rmw_zenoh_cpp (zenoh_config.cpp); Zenoh 1.10.2, tested."
OWN_CONFIGURATION = (
    "On the machine with the CA keys, `sros zenoh KEYSTORE` writes the configuration of each "
    "enclave; `sros env KEYSTORE ENCLAVE` and `sros run KEYSTORE ENCLAVE -- COMMAND...` set the "
    "variables of an enclave."
)

NO_SESSION_FILE = FindingKind(
    "runtime.zenoh-open",
    ERROR,
    "rmw_zenoh runs open although security is enabled",
    "rmw_zenoh ignores the ROS_SECURITY_* variables. Without a configuration in "
    "ZENOH_SESSION_CONFIG_URI, every node uses the default of rmw_zenoh_cpp: no TLS, no access "
    "control.",
    _ZENOH_SOURCE,
    f"Set ZENOH_SESSION_CONFIG_URI to the session.json5 of the enclave. {OWN_CONFIGURATION}",
)
FILE_NOT_FOUND = FindingKind(
    "runtime.zenoh-file-not-found",
    ERROR,
    "a variable of rmw_zenoh names no file that Zenoh can read",
    "If the variable is ZENOH_SESSION_CONFIG_URI, no node starts; if it is "
    "ZENOH_ROUTER_CONFIG_URI, no router starts.",
    _ZENOH_SOURCE,
    f"Correct the path. {OWN_CONFIGURATION}",
)
UNREAD = FindingKind(
    "runtime.zenoh-unread",
    WARNING,
    "a Zenoh configuration that sros cannot read",
    "Zenoh reads files that sros cannot read: YAML that is not JSON, TOML, lists in place of "
    "objects, pipes, and files of more than 16 MiB. So sros does not know whether the "
    "configuration enforces anything.",
    _ZENOH_SOURCE,
    f"Write it as JSON5 objects into a file of at most 16 MiB. {OWN_CONFIGURATION}",
)
TOO_OLD = FindingKind(
    "runtime.zenoh-too-old",
    ERROR,
    "an rmw_zenoh that is too old for the files that sros writes",
    "No session opens in an enclave: such an rmw_zenoh does not read ZENOH_CONFIG_OVERRIDE, and "
    "its Zenoh does not accept all settings in the files.",
    "Changelogs of rmw_zenoh_cpp; Zenoh wheels, tested.",
    "Install a later version of rmw_zenoh for the same distribution.",
)
OVERRIDDEN = FindingKind(
    "runtime.zenoh-overridden",
    WARNING,
    "ZENOH_CONFIG_OVERRIDE changes what a Zenoh configuration protects",
    "Zenoh applies the variable after the file, in nodes and in the router, so the variable can "
    "switch off access control, TLS and everything else that the file states.",
    _ZENOH_SOURCE,
    "Leave in the variable only the paths of certificates and keys, and the address of the "
    f"router. {OWN_CONFIGURATION}",
)
NO_CERTIFICATE = FindingKind(
    "runtime.zenoh-no-certificate",
    ERROR,
    "a Zenoh configuration with TLS, but without the paths of certificates and keys",
    "No session opens with it, and no router starts.",
    "Zenoh 1.10.2, tested.",
    f"Name the paths in ZENOH_CONFIG_OVERRIDE. {OWN_CONFIGURATION}",
)
PROCESS_OPEN = FindingKind(
    "runtime.zenoh-process-open",
    ERROR,
    "a process of rmw_zenoh that runs open although security is enabled",
    "The process has no Zenoh configuration, or one without access control: whoever connects to "
    "the process, or impersonates its router, can read everything from it and send it anything.",
    _ZENOH_SOURCE,
    f"Stop it, and start it again. {OWN_CONFIGURATION}",
)

_NEEDED_TLS_FILES = {
    "listen": ("listen_private_key", "listen_certificate"),
    "connect": ("connect_private_key", "connect_certificate"),
}


def security_clauses(environment: Mapping[str, str], folder: Path) -> Iterator[str]:
    """Yield clauses on settings in ``environment`` that secure nodes.

    ``folder`` is the working directory of the nodes.
    """
    if environment.get(ENABLE) == "true":
        yield f"{ENABLE} is set"
    if is_zenoh(environment):
        yield from _zenoh_security_clauses(environment, folder)
        return
    value = environment.get("CYCLONEDDS_URI", "")
    inline = value.lstrip().startswith("<") and "$" not in value
    for part in [value] if inline else filter(None, value.split(",")):
        path = folder / part.strip().removeprefix("file://")
        yield from _configuration_security_clauses(
            _CYCLONE_SECURITY, "CYCLONEDDS_URI", part.encode() if inline else path
        )
    for name in (*PROFILE_VARIABLES, "FASTDDS_ENVIRONMENT_FILE"):
        if text := environment.get(name, ""):
            sought = _PROFILE_SECURITY if name in PROFILE_VARIABLES else _NAMES_PROFILES
            yield from _configuration_security_clauses(sought, name, folder / text)
    for path in map(folder.joinpath, _DEFAULT_PROFILES):
        if path.exists():
            yield from _configuration_security_clauses(
                _PROFILE_SECURITY, f"'{path.name}' in this folder", path
            )


def _zenoh_security_clauses(environment: Mapping[str, str], folder: Path) -> Iterator[str]:
    """Yield a clause if variables give rmw_zenoh certificates, rules or a password.

    Also yield a clause if the configuration that the variables name cannot be read.
    """
    uri, override = environment.get(SESSION_URI, ""), environment.get(OVERRIDE, "")
    named = " with ".join(name for name in (SESSION_URI, OVERRIDE) if environment.get(name))
    try:
        data = read_bytes(folder / uri, "Zenoh configuration") if uri else b"{}"
        document = parse_configuration(data, uri or OVERRIDE, override_pairs(override), lines=False)
    except SrosError as error:
        yield f"{named} cannot be read ({error.what})"
        return
    has_password = any(
        name.startswith("transport/auth/") and value not in ("null", "{}")
        for name, value in document.settings.items()
    )
    options = [endpoint for endpoint in document.connect if endpoint.options]
    if document.tls.named or document.access.enabled or has_password or options:
        yield f"{named} has security"


def _configuration_security_clauses(
    sought_text: bytes, name: str, content: bytes | Path
) -> Iterator[str]:
    """Yield a clause if a configuration contains ``sought_text``, a pattern, or cannot be read.

    ``name`` names the configuration in the clause; ``content`` is the content of the configuration,
    or the path of its file.
    """
    try:
        data = content if isinstance(content, bytes) else read_bytes(content, "configuration")
    except SrosError as error:
        yield f"{name} cannot be read ({error.what})"
        return
    if re.search(sought_text, data):
        yield f"{name} has security"


_CYCLONE_SECURITY = rb"(?i)<(?:\w+:)?(?:dds)?security\b"
"""The element that secures every participant (Cyclone DDS 0.10, ``cfgelems.h``)."""
_PROFILE_SECURITY = rb"dds\.sec\.|&#"
"""The properties that secure a participant of Fast DDS, or an escape that may hide them."""
_NAMES_PROFILES = rb"_PROFILES_FILE|\\u"
"""Variables that name profiles, as text in a file of variables, or an escape that may hide them."""
_DEFAULT_PROFILES = ("DEFAULT_FASTRTPS_PROFILES.xml", "DEFAULT_FASTDDS_PROFILES.xml")
"""The files that Fast DDS reads from its working directory (Fast DDS 2.14, ``XMLProfileManager``).
Security properties in a default profile apply to every participant of rmw_fastrtps.
"""


def is_zenoh(environment: Mapping[str, str]) -> bool:
    """Return whether processes in an environment use rmw_zenoh."""
    return environment.get(RMW, "").startswith(RMW_ZENOH)


def _named_files(environment: Mapping[str, str]) -> Iterator[tuple[str, Path]]:
    """Yield each variable that names a Zenoh configuration file, and the path of the file."""
    for name in (SESSION_URI, ROUTER_URI):
        text = environment.get(name, "")
        if text and text != NO_CONFIGURATION:
            yield name, Path(text)


def zenoh_environment_findings(environment: Mapping[str, str]) -> Iterator[Finding]:
    """Yield findings about the variables of rmw_zenoh and the configuration files they name."""
    if not is_zenoh(environment):
        return
    version = package_version(RMW_ZENOH, environment)
    if version and (why := why_too_old(version)):
        yield TOO_OLD.found(RMW_ZENOH, f"{RMW_ZENOH} {version_text(version)} is installed. {why}")
    if environment.get(ENABLE) == "true" and not environment.get(SESSION_URI):
        yield NO_SESSION_FILE.found(SESSION_URI, f"{SESSION_URI} is not set")
    overrides = tuple(override_pairs(environment.get(OVERRIDE, "")))
    for name, path in _named_files(environment):
        if path.suffix not in ENDINGS:
            text = f"the name of '{path}' ends with none of {', '.join(ENDINGS)}"
            yield FILE_NOT_FOUND.found(name, text, str(path))
            continue
        try:
            data = read_bytes(path, "Zenoh configuration")
        except SrosError as error:
            kind = UNREAD if _is_readable(path) else FILE_NOT_FOUND
            yield kind.found(name, str(error))
            continue
        try:
            document = parse_configuration(data, str(path))
            effective = parse_configuration(data, str(path), overrides)
        except UnreadConfigurationError as error:
            yield UNREAD.found(name, str(error), str(path))
            continue
        except SrosError as error:
            yield MALFORMED.found(name, str(error), str(path))
            continue
        yield from document_findings(effective)
        yield from _override_findings(document, effective, overrides)
        yield from _certificate_file_findings(effective, name)


def _is_readable(path: Path) -> bool:
    """Return whether Zenoh could read a path that sros refuses to read, such as a pipe."""
    try:
        return not path.is_dir() and os.access(path, os.R_OK)
    except ValueError:  # a NUL
        return False


def why_no_access_control(environment: Mapping[str, str], variable: str) -> str:
    """Return why a process of rmw_zenoh has no access control, as a clause, or "".

    The result is also "" if the configuration file is unreadable, which another finding reports.
    ``variable`` is the environment variable that names the configuration file.
    """
    text = environment.get(variable, "")
    if not text:
        return f"{variable} is not set"
    with suppress(SrosError):  # a finding says what is wrong with the file
        data = read_bytes(Path(text), "Zenoh configuration")
        return why_configuration_is_open(data, text, environment.get(OVERRIDE, ""))
    return ""


def why_configuration_is_open(data: bytes, name: str, override: str) -> str:
    """Return why a configuration has no access control, as a clause; "" if it has access control.

    ``name`` is the name of the configuration file, ``override`` is the value of
    ZENOH_CONFIG_OVERRIDE.

    Raises:
        SrosError: sros cannot read the configuration.
    """
    document = parse_configuration(data, name, override_pairs(override), lines=False)
    return "" if document.access.enabled else f"access_control is off in '{name}' with {OVERRIDE}"


def _override_findings(
    document: ConfigurationDocument,
    effective: ConfigurationDocument,
    overrides: tuple[tuple[str, str], ...],
) -> Iterator[Finding]:
    """Yield a finding if the overrides change more than the router address and the TLS paths.

    ``effective`` is ``document`` after the overrides were applied.
    """
    unchanged = replace(
        effective, connect=document.connect, tls=replace(effective.tls, named=document.tls.named)
    )
    if unchanged != document:
        keys = ", ".join(dict.fromkeys(key.strip().strip("/")[:60] for key, _ in overrides))
        yield OVERRIDDEN.found(OVERRIDE, f"it has {keys[:300]}", effective.name)


def _certificate_file_findings(document: ConfigurationDocument, variable: str) -> Iterator[Finding]:
    missing: list[str] = []
    for side, needed in _NEEDED_TLS_FILES.items():
        endpoints = document.listen if side == "listen" else document.connect
        if any(endpoint.is_encrypted() for endpoint in endpoints):
            wanted = needed if side == "listen" or document.tls.mutual else ()
            missing += [
                setting
                for setting in ("root_ca_certificate", *wanted)
                if setting not in document.tls.named and setting not in missing
            ]
    if missing:
        text = f"{variable} and {OVERRIDE} name no {', '.join(missing)}"
        yield NO_CERTIFICATE.found(variable, text, document.name)
