"""The environment that makes a process run secured: variables, arguments and containers.

ROS_SECURITY_ENCLAVE_OVERRIDE decides which enclave secures a process.  The ROS graph shows the
enclave of ``--ros-args --enclave`` instead, which can be different.

rmw_zenoh_cpp also reads ZENOH_SESSION_CONFIG_URI, the configuration of nodes, and
ZENOH_ROUTER_CONFIG_URI, the configuration of the router; without a value, it uses a default
configuration, which is open. ZENOH_CONFIG_OVERRIDE has the form ``KEY=VALUE;KEY=VALUE``, with
values in JSON5, and is applied after either file. Earlier versions of rmw_zenoh_cpp do not read
ZENOH_CONFIG_OVERRIDE, so that a session with the configuration of an enclave does not open.

A service of Docker Compose and the objects of Kubernetes add the enclave to a container, and take
away what a ROS node does not need.  ROS writes its logs to /tmp, the only place that stays
writable.

Sources: rcl 9.x ``security.c``, ``context.c`` and ``domain_id.c``; rmw_zenoh_cpp
``zenoh_config.cpp`` and ``zenohd/main.cpp`` (2025); the Compose Specification; the API of
Kubernetes 1.31 (core/v1, apps/v1).
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
import re
import shlex
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

from sros_tool.errors import KeystoreError, Note, UsageError
from sros_tool.runtime.rmw import RMW
from sros_tool.runtime.variables import DOMAIN, ENABLE, ENCLAVE, KEYSTORE, STRATEGY
from sros_tool.values import Notes, yaml_text
from sros_tool.wording import first_few

RMW_ZENOH = "rmw_zenoh_cpp"
SESSION_URI, ROUTER_URI = "ZENOH_SESSION_CONFIG_URI", "ZENOH_ROUTER_CONFIG_URI"
OVERRIDE = "ZENOH_CONFIG_OVERRIDE"
_VARIABLES = (SESSION_URI, ROUTER_URI, OVERRIDE)

NO_CONFIGURATION = "/dev/null/refused-by-sros.json5"
"""A path that can never exist: a process that has to read a configuration from it exits."""

_TLS_SETTING = "transport/link/tls"
_LINE_ENDS = {point: f"\\u{point:04x}" for point in (0x2028, 0x2029)}
"""Escapes for characters that JSON allows in a string, and JSON5 does not."""
_MOST_KEYS = 5
_MOST_CHARACTERS = 60

REFUSING_ZENOH: Mapping[str, str] = {SESSION_URI: NO_CONFIGURATION, ROUTER_URI: NO_CONFIGURATION}
"""Variables that keep nodes and routers of rmw_zenoh_cpp from opening a session."""


class PrintedEnvironment(NamedTuple):
    """The environment of an enclave.

    ``--format json`` prints only the object in ``variables``. After an error, the variables let no
    node start.
    """

    keystore: Path | None
    """Path of the keystore, as given on the command line; null after an error."""
    enclave: str | None
    """Name of the enclave; null after an error."""
    variables: Mapping[str, str]
    """The environment variables and their values."""
    notes: Notes


def secured_environment(root: Path, enclave: str, domain: int) -> dict[str, str]:
    """Return the variables with which a process runs secured in an enclave, or does not start."""
    return {
        KEYSTORE: str(root.absolute()),
        ENABLE: "true",
        STRATEGY: "Enforce",
        ENCLAVE: enclave,
        DOMAIN: str(domain),
    }


def without_own_libraries(environment: Mapping[str, str]) -> dict[str, str]:
    """Return an environment for a command that may use another ROS than the Python of sros.

    The PyPI wheels of ROS start a Python again with their libraries in LD_LIBRARY_PATH, and mark
    this in the environment; a node of another ROS would load these libraries, without DDS Security.
    A Python of the same wheels adds the libraries again.
    """
    kept = dict(environment)
    if kept.pop("_ROS_WHEELS_BOOTSTRAP_COMPLETE", None):
        own = Path(sys.prefix).resolve()
        folders = kept.pop("LD_LIBRARY_PATH", "").split(os.pathsep)
        if others := [f for f in folders if f and not Path(f).resolve().is_relative_to(own)]:
            kept["LD_LIBRARY_PATH"] = os.pathsep.join(others)
    return kept


REFUSING_DDS: Mapping[str, str] = {KEYSTORE: "", ENABLE: "true", STRATEGY: "Enforce"}
"""Variables that keep rcl from starting nodes."""
REFUSING: Mapping[str, str] = {**REFUSING_DDS, **REFUSING_ZENOH}
"""Variables that keep rcl from starting nodes, and rmw_zenoh_cpp from starting a router."""


def render_refusal(form: str) -> str:
    """Return text in the format ``form`` that keeps nodes from starting, for output after an error.

    Empty output would let nodes start unsecured, for example through a shell or jq: see `REFUSING`.
    In a shell, the text also fails as a command, even if ``eval $(...)`` without quotes makes it a
    single line.  In a unit, the text keeps systemd from starting the service.  Compose and
    Kubernetes refuse the text.
    """
    if form in CONTAINER_FORMS:
        return yaml_text({"refused-by-sros": "the enclave cannot be used"})
    text = render_environment(REFUSING, form)
    if form in ("sh", "fish"):
        return "; ".join((*text.splitlines(), "false")) + "\n"
    return text + ("ExecStartPre=/bin/false\n" if form == "systemd" else "")


def render_environment(variables: Mapping[str, str], form: str) -> str:
    """Return variables as text in the format ``form``: sh, fish, json, systemd or docker.

    ``docker`` is an env-file, ``systemd`` the lines of a unit.

    Raises:
        UsageError: in this format, not all programs would read the same value.
    """
    for name, value in variables.items():
        if form in _INEXPRESSIBLE_IN and _INEXPRESSIBLE_IN[form](value):
            raise UsageError(
                f"{name} cannot be written in the format {form}: {value!r}",
                "A program that reads this format would get another value, or several values.",
                "Move the keystore to a path of letters, digits and /._- only, or use `sros run`.",
            )
    if form == "json":
        return json.dumps(dict(variables), indent=2) + "\n"
    return "".join(_LINE_RENDERERS[form](name, value) for name, value in variables.items())


def _fish(name: str, value: str) -> str:
    quoted = value.replace("\\", "\\\\").replace("'", "\\'")
    return f"set -gx {name} '{quoted}'\n"


def _systemd(name: str, value: str) -> str:
    # systemd.exec(5): C escapes inside double quotes; % starts a specifier.
    quoted = value.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%")
    return f'Environment="{name}={quoted}"\n'


def _sh(name: str, value: str) -> str:
    return f"export {name}={shlex.quote(value)}\n"


def _docker(name: str, value: str) -> str:
    return f"{name}={value}\n"


_LINE_RENDERERS = {"sh": _sh, "fish": _fish, "systemd": _systemd, "docker": _docker}


def _is_not_unicode(value: str) -> bool:
    return any("\ud800" <= letter <= "\udfff" for letter in value)


def _is_not_printable(value: str) -> bool:
    # systemd also ends a line at a carriage return (read_line in fileio.c), and ignores a line
    # that is not UTF-8.
    return not value.isprintable()


def _is_interpreted(value: str) -> bool:
    # `docker run` takes a value as it is; Compose replaces variables, and cuts comments and spaces.
    return not value.isprintable() or "$" in value or " #" in value or value != value.strip()


_INEXPRESSIBLE_IN: dict[str, Callable[[str], bool]] = {
    "json": _is_not_unicode,
    "systemd": _is_not_printable,
    "docker": _is_interpreted,
}
"""Format → function that returns whether the format cannot express a value; absent: it can."""

# ── the command line of a node ─────────────────────────────────────────────────────────────

ROS_ARGS = "--ros-args"
_ENCLAVE_OPTION = re.compile(r"(?:-e|--enclave)\Z")
_ZENOH_ROUTER = "rmw_zenohd"
_PYTHON = re.compile(r"python[\d.]*\Z")


def with_enclave(command: Sequence[str], enclave: str) -> tuple[str, ...]:
    """Return a command with ``--ros-args --enclave``, if it certainly starts a ROS node.

    A command certainly starts a ROS node if it is ``ros2 run``, runs an executable or Python script
    of a ROS package (``lib/PACKAGE/NAME``), or has ``--ros-args``.  Other commands, the router of
    rmw_zenoh_cpp, and commands that already name an enclave, are returned unchanged.
    """
    command = tuple(command)
    ros_args = command[command.index(ROS_ARGS) :] if ROS_ARGS in command else ()
    if not starts_nodes(command) or any(_ENCLAVE_OPTION.match(word) for word in ros_args):
        return command
    return (*command, ROS_ARGS, "--enclave", enclave)


def starts_nodes(command: Sequence[str]) -> bool:
    """Return whether a command certainly starts ROS nodes; see `with_enclave`."""
    if any(Path(word).name == _ZENOH_ROUTER for word in command):
        return False
    if Path(command[0]).name == "ros2":
        return _is_ros2_run(command)
    return ROS_ARGS in command or _is_of_package(command)


def enclave_argument(command: Sequence[str]) -> str:
    """Return the enclave of ``--ros-args --enclave`` in a command, or "/", the default of rcl."""
    return named_enclave(command) or "/"


def named_enclave(command: Sequence[str]) -> str:
    """Return the enclave that ``--ros-args --enclave`` names in a command, or "".

    The last occurrence counts. ``--`` ends the arguments for ROS until the next ``--ros-args``
    (rcl/src/rcl/arguments.c).
    """
    enclave, of_ros = "", False
    for before, word in pairwise(("", *command)):
        if of_ros and _ENCLAVE_OPTION.match(before):
            enclave = word
        elif word == ROS_ARGS:
            of_ros = True
        elif word == "--":
            of_ros = False
    return enclave


_REMAP_OPTIONS = ("-r", "--remap")
_NODE_RULES, _NAMESPACE_RULE = ("__node", "__name"), "__ns"


def node_argument(command: Sequence[str]) -> tuple[str, str] | None:
    """Return namespace and name that a command certainly gives its node, or None.

    Without a rule for the namespace, the namespace is "/".
    """
    nodes = possible_nodes(command)
    return nodes[""] if "" in nodes and len({*nodes.values()}) == 1 else None


def possible_nodes(command: Sequence[str]) -> dict[str, tuple[str, str]]:
    """Map a node's own name to the namespace and the name that a command gives it.

    The key "" stands for every name that is not listed; without this key, such nodes keep their own
    name.
    """
    names, namespaces = _node_rules(command)
    nodes = {}
    for own, name in names.items():
        # rcl looks up the rule for the namespace by the node's new name (rcl/src/rcl/node.c).
        ns = next((ns for of, ns in namespaces.items() if of in ("", name)), "/")
        nodes[own] = (ns, name)
        if not own:
            break
    return nodes


def started_nodes(command: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield namespace and name that a command may give a node; "" if the command does not set one.

    The last pair is for nodes whose own name no rule names (``-r talker:__node:=NAME``).
    """
    names, namespaces = _node_rules(command)
    for own in (*filter(None, dict.fromkeys((*names, *namespaces))), ""):
        name = next((new for of, new in names.items() if of in ("", own)), own)
        yield next((ns for of, ns in namespaces.items() if of in ("", name)), ""), name


def nodes_with_rules(command: Sequence[str]) -> list[str]:
    """Return the nodes for which a command has remapping rules (``-r talker:a:=b``)."""
    return [node for node in dict.fromkeys(node for node, _, _ in remapping_rules(command)) if node]


def _node_rules(command: Sequence[str]) -> tuple[dict[str, str], dict[str, str]]:
    """Return two maps from the nodes in remapping rules: to new names, and to namespaces.

    The key "" stands for every node.  The rules are ``-r __node:=NAME`` and ``-r __ns:=NAMESPACE``
    behind ``--ros-args``.  The order is the order in the command: rcl takes the first rule that
    matches a node (``remap.c``).
    """
    names: dict[str, str] = {}
    namespaces: dict[str, str] = {}
    for node, what, value in remapping_rules(command):
        if value and what in _NODE_RULES:
            names.setdefault(node, value)
        elif value and what == _NAMESPACE_RULE:
            namespaces.setdefault(node, value)
    return names, namespaces


def remapping_rules(command: Sequence[str]) -> Iterator[tuple[str, str, str]]:
    """Yield the node ("": all nodes), the left and the right side of each remapping rule."""
    of_ros = False
    for before, word in pairwise(("", *command)):
        if word == ROS_ARGS:
            of_ros = True
        elif word == "--":
            of_ros = False
        elif of_ros and before in _REMAP_OPTIONS:
            rule, _, value = word.partition(":=")
            # rcl allows rostopic:// or rosservice:// in front of the name (lexer.c).
            node, _, what = re.sub("ros(topic|service)://", "", rule).rpartition(":")
            yield node, what, value


def _is_ros2_run(command: Sequence[str]) -> bool:
    """Return whether a command is ``ros2 run [--prefix PREFIX] PACKAGE EXECUTABLE ...``."""
    if Path(command[0]).name != "ros2" or tuple(command[1:2]) != ("run",):
        return False
    words = list(command[2:])
    if words[:1] == ["--prefix"]:
        words = words[2:]
    elif words and words[0].startswith("--prefix="):
        words = words[1:]
    return len(words) >= 2 and not any(word.startswith("-") for word in words[:2])


def _is_of_package(command: Sequence[str]) -> bool:
    """Return whether the program, or the script that Python runs, belongs to a ROS package."""
    script = command[1] if _PYTHON.match(Path(command[0]).name) and len(command) > 1 else ""
    path = Path(script or shutil.which(command[0]) or command[0])
    if path.parent.parent.name != "lib" or not path.is_file():
        return False
    prefix, package = path.parent.parent.parent, path.parent.name
    return (prefix / "share" / package / "package.xml").is_file()


# ── Zenoh ────────────────────────────────────────────────────────────────────────────────────────


def zenoh_environment(
    configurations: Mapping[str, str], authority: Path, certificate: Path, key: Path
) -> dict[str, str]:
    """Return variables with which rmw_zenoh_cpp runs in an enclave, or exits if that is impossible.

    Args:
        configurations: maps `SESSION_URI` and `ROUTER_URI` to absolute paths of files; processes of
            a kind that is left out do not start.
        authority: the absolute path of the CA file.
        certificate: the absolute path of the certificate.
        key: the absolute path of the key.

    Raises:
        KeystoreError: a path is not UTF-8, or has a ";" or "?", so that Zenoh would read another
            path.
    """
    files = {"root_ca_certificate": authority}
    for side in ("connect", "listen"):
        files |= {f"{side}_private_key": key, f"{side}_certificate": certificate}
    return {
        RMW: RMW_ZENOH,
        SESSION_URI: configurations.get(SESSION_URI, NO_CONFIGURATION),
        ROUTER_URI: configurations.get(ROUTER_URI, NO_CONFIGURATION),
        OVERRIDE: ";".join(f"{_TLS_SETTING}/{name}={_text(path)}" for name, path in files.items()),
    }


def _text(path: Path) -> str:
    """Return a path as a JSON string.

    Zenoh appends paths to the text of an endpoint, behind "#"; there, ";" and "?" also have a
    meaning (tested with 1.10.2).
    """
    text = str(path)
    if set(text) & set(";?") or any("\ud800" <= letter <= "\udfff" for letter in text):
        raise KeystoreError(
            f"the path {text!r} cannot be given to Zenoh",
            "Zenoh reads a path as UTF-8 text, and does not accept ';' or '?' in it.",
            "Move the keystore to a path without such characters.",
        )
    return json.dumps(text, ensure_ascii=False).translate(_LINE_ENDS)


def override_pairs(text: str) -> Iterator[tuple[str, str]]:
    """Yield key and value of each entry of ZENOH_CONFIG_OVERRIDE, as rmw_zenoh_cpp splits the text.

    A value ends at a line end; an entry without key or value is skipped.
    """
    for pair in text.split(";"):
        key, _, value = pair.partition("=")
        value = value.partition("\n")[0]
        if key and value:
            yield key, value


def replaced_notes(environment: Mapping[str, str], variables: Mapping[str, str]) -> Iterator[Note]:
    """Yield a note for each Zenoh variable of ``environment`` that ``variables`` replaces.

    For ZENOH_CONFIG_OVERRIDE, the note names the keys, because the replaced value could switch
    access control off.
    """
    for name in _VARIABLES:
        before = environment.get(name)
        if not before or before == variables.get(name):
            continue
        if name != OVERRIDE:
            yield Note(
                "zenoh.replaced",
                f"sros replaces the value of {name}, which was {_shortened_text(before)}.",
            )
            continue
        keys = [key.strip().strip("/") for key, _ in override_pairs(before)]
        shown = first_few([_shortened_text(key) for key in keys], _MOST_KEYS) or "nothing"
        yield Note(
            "zenoh.replaced", f"sros replaces the value of {OVERRIDE}, which changed {shown}."
        )
        if any(key.partition("/")[0] == "access_control" for key in keys):
            yield Note(
                "zenoh.access-control-override",
                f"WARNING: the replaced {OVERRIDE} changed access_control: a process with this "
                "value does not enforce the rules of its file. Nodes that are started without sros "
                f"still get the value: find out what sets {OVERRIDE}, and remove it there.",
            )


def _shortened_text(text: str) -> str:
    shown = text if len(text) <= _MOST_CHARACTERS else f"{text[:_MOST_CHARACTERS]}..."
    return repr(shown)


COMPOSE, KUBERNETES, SECRET = "compose", "kubernetes", "kubernetes-secret"
CONTAINER_FORMS = (COMPOSE, KUBERNETES, SECRET)

MAX_SECRET = 1024 * 1024
"""Largest size of the files in a Secret, in bytes (MaxSecretSize of core/v1)."""

_CONTAINER_USER = 1000
"""User id and group id of the process in a container, as in most ROS images."""
_OWNER_READ_MODE = 0o400
_LOG_VARIABLES = {"ROS_LOG_DIR": "/tmp"}  # noqa: S108 (a path in the container, which has it alone)
_ENCLAVE_VOLUME, _LOG_VOLUME = "sros-enclave", "tmp"
_NAME_LABEL = "app.kubernetes.io/name"

_SERVICE = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*\Z")
_RFC_1123 = re.compile(r"[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?\Z")
_PLAIN_ENCLAVE = re.compile(r"(/[a-z][a-z0-9]*)+\Z")
_LONGEST_PLAIN = 40


@dataclass(frozen=True, slots=True)
class Container:
    """A container whose process runs in an enclave.

    ``name`` is the name of the service or object.  ``folder`` is the absolute path of the enclave's
    files in the container and, for Compose, also on the machine that runs the container.  Without
    ``image``, the YAML of the container has to be merged with a definition that has an image.
    """

    enclave: str
    name: str
    variables: Mapping[str, str]
    folder: str
    image: str = ""


def object_name(enclave: str) -> str:
    """Return a name of at most 58 characters (RFC 1123) that only this enclave has.

    Each "/" becomes "-".  If the enclave has other characters that the name cannot keep, such as
    capitals or "_", or is long, the name ends with "--" and the first 64 bits of the enclave's
    SHA-256, so that it is unique.
    """
    words = "-".join(re.findall(r"[a-z0-9]+", enclave.lower()))
    if _PLAIN_ENCLAVE.match(enclave) and len(words) <= _LONGEST_PLAIN:
        return words
    digest = hashlib.sha256(enclave.encode()).hexdigest()[:16]
    return f"{words[:_LONGEST_PLAIN].rstrip('-') or 'root'}--{digest}"


def secret_name(enclave: str) -> str:
    """Return the name of the Secret with the files of an enclave."""
    return f"sros-{object_name(enclave)}"


def check_name(name: str, form: str) -> str:
    """Return the name of a service or object if it is valid in the format ``form``.

    Raises:
        UsageError: the name is not valid.
    """
    if form == COMPOSE and not _SERVICE.match(name):
        raise UsageError(
            f"{name!r} is not a name of a service in Compose",
            "",
            "Use letters, digits, '.', '_' and '-', and begin with a letter or a digit.",
        )
    if form != COMPOSE and not _RFC_1123.match(name):
        raise UsageError(
            f"{name!r} is not a name of an object in Kubernetes (RFC 1123)",
            "",
            "Use at most 63 lower-case letters, digits and '-', "
            "and begin and end with a letter or digit.",
        )
    return name


def render_container(container: Container, form: str) -> str:
    """Return a container as YAML, in the form `COMPOSE` or `KUBERNETES`.

    Raises:
        UsageError: the form cannot express a value.
    """
    for value in (container.folder, container.image, *container.variables.values()):
        if not value.isprintable() or (form == KUBERNETES and ":" in container.folder):
            raise UsageError(
                f"{value!r} cannot be written in the format {form}",
                "",
                "Leave control characters out of paths and names; for Kubernetes, also leave ':' "
                "out of the path.",
            )
    return yaml_text(_service(container) if form == COMPOSE else _deployment(container))


def render_secret(enclave: str, files: Mapping[str, bytes]) -> str:
    """Return the Secret with the files of an enclave, by their names, as YAML.

    Raises:
        KeystoreError: the files are larger than Kubernetes accepts.
    """
    size = sum(map(len, files.values()))
    if size > MAX_SECRET:
        raise KeystoreError(
            f"the files of enclave {enclave} have {size} bytes, but a Secret holds at most "
            f"{MAX_SECRET}",
            "Kubernetes refuses a larger Secret.",
            "Give the enclave fewer rights, or bring its files to the node of the cluster where "
            "it runs: `sros distribute_key`.",
        )
    return yaml_text(
        {
            "apiVersion": "v1",
            "kind": "Secret",
            "metadata": {
                "name": secret_name(enclave),
                "labels": {"app.kubernetes.io/managed-by": "sros"},
                "annotations": {"sros/enclave": enclave},
            },
            "type": "Opaque",
            "data": {name: base64.b64encode(data).decode() for name, data in files.items()},
        }
    )


def _service(container: Container) -> dict[str, Any]:
    # Compose replaces $NAME in every value; $$ stands for $.
    variables = {
        name: value.replace("$", "$$")
        for name, value in {**container.variables, **_LOG_VARIABLES}.items()
    }
    folder = container.folder.replace("$", "$$")
    mount = {
        "type": "bind",
        "source": folder,
        "target": folder,
        "read_only": True,
        # Otherwise Docker silently creates a missing folder, empty and owned by root.
        "bind": {"create_host_path": False},
    }
    service = {
        **({"image": container.image.replace("$", "$$")} if container.image else {}),
        "environment": variables,
        "volumes": [mount],
        "read_only": True,
        "tmpfs": list(_LOG_VARIABLES.values()),
        "cap_drop": ["ALL"],
        "security_opt": ["no-new-privileges:true"],
    }
    return {"services": {container.name: service}}


def _deployment(container: Container) -> dict[str, Any]:
    labels = {_NAME_LABEL: container.name}
    return {
        "apiVersion": "apps/v1",
        "kind": "Deployment",
        "metadata": {"name": container.name, "labels": labels},
        "spec": {
            "selector": {"matchLabels": labels},
            "template": {"metadata": {"labels": labels}, "spec": _pod(container)},
        },
    }


def _pod(container: Container) -> dict[str, Any]:
    process = {
        "name": container.name,
        **({"image": container.image} if container.image else {}),
        # Kubernetes replaces $(NAME) in every value; $$ stands for $.
        "env": [
            {"name": name, "value": value.replace("$", "$$")}
            for name, value in {**container.variables, **_LOG_VARIABLES}.items()
        ],
        "securityContext": {
            "allowPrivilegeEscalation": False,
            "readOnlyRootFilesystem": True,
            "capabilities": {"drop": ["ALL"]},
        },
        "volumeMounts": [
            {"name": _ENCLAVE_VOLUME, "mountPath": container.folder, "readOnly": True},
            *({"name": _LOG_VOLUME, "mountPath": path} for path in _LOG_VARIABLES.values()),
        ],
    }
    files = {"secretName": secret_name(container.enclave), "defaultMode": _OWNER_READ_MODE}
    return {
        "automountServiceAccountToken": False,
        "securityContext": {
            "runAsNonRoot": True,
            "runAsUser": _CONTAINER_USER,
            "runAsGroup": _CONTAINER_USER,
            "fsGroup": _CONTAINER_USER,
            "seccompProfile": {"type": "RuntimeDefault"},
        },
        "containers": [process],
        "volumes": [
            {"name": _ENCLAVE_VOLUME, "secret": files},
            {"name": _LOG_VOLUME, "emptyDir": {}},
        ],
    }
