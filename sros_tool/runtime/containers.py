"""A process in an enclave as a service of Docker Compose, or as objects of Kubernetes.

What is here adds the enclave to a container and takes away what a ROS node does not need.  ROS
writes its logs to /tmp, the only place that stays writable.

Sources: the Compose Specification; the API of Kubernetes 1.31 (core/v1, apps/v1).
"""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sros_tool.errors import KeystoreError, UsageError
from sros_tool.values import yaml_text

COMPOSE, KUBERNETES, SECRET = "compose", "kubernetes", "kubernetes-secret"
FORMS = (COMPOSE, KUBERNETES, SECRET)

MAX_SECRET = 1024 * 1024
"""Largest size of the files in a Secret, in bytes (MaxSecretSize of core/v1)."""

_USER = 1000
"""The user and group of the process: that of the user in most images for ROS."""
_OWNER_READS = 0o400
_LOGS = {"ROS_LOG_DIR": "/tmp"}  # noqa: S108 (a path in the container, which has it alone)
_ENCLAVE_VOLUME, _LOG_VOLUME = "sros-enclave", "tmp"
_NAME_LABEL = "app.kubernetes.io/name"

_SERVICE = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*\Z")
_RFC_1123 = re.compile(r"[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?\Z")
_PLAIN = re.compile(r"(/[a-z][a-z0-9]*)+\Z")
_LONGEST_PLAIN = 40


@dataclass(frozen=True, slots=True)
class Container:
    """A container whose process runs in an enclave.

    ``folder`` is the absolute path of the enclave's files, in the container and, for Compose, on
    the machine that runs it.  Without ``image`` the result is to be merged with a definition that
    has one.
    """

    enclave: str
    name: str
    variables: Mapping[str, str]
    folder: str
    image: str = ""


def object_name(enclave: str) -> str:
    """Return a name for an enclave that no other enclave has, of at most 58 characters (RFC 1123).

    Names of enclaves distinguish capitals and have "_" and "/".  Where that is lost, the first 64
    bits of the enclave's SHA-256 follow after "--", which no other name has.
    """
    words = "-".join(re.findall(r"[a-z0-9]+", enclave.lower()))
    if _PLAIN.match(enclave) and len(words) <= _LONGEST_PLAIN:
        return words
    digest = hashlib.sha256(enclave.encode()).hexdigest()[:16]
    return f"{words[:_LONGEST_PLAIN].rstrip('-') or 'root'}--{digest}"


def secret_name(enclave: str) -> str:
    """Return the name of the Secret with the files of an enclave."""
    return f"sros-{object_name(enclave)}"


def check_name(name: str, form: str) -> str:
    """Return the name of a service or an object if it is valid in this form.

    Raises:
        UsageError: it is not.
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
            "Use at most 63 small letters, digits and '-', and begin and end with none of '-'.",
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
                f"{value!r} cannot be written in the form {form}",
                "",
                "Use a path of letters, digits and /._- only.",
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
            f"the files of enclave {enclave} have {size} bytes, and a Secret holds {MAX_SECRET}",
            "Kubernetes refuses a larger one.",
            "Give the enclave fewer rights, or bring its files to the node of the cluster: `sros "
            "distribute_key`.",
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
        name: value.replace("$", "$$") for name, value in {**container.variables, **_LOGS}.items()
    }
    folder = container.folder.replace("$", "$$")
    mount = {
        "type": "bind",
        "source": folder,
        "target": folder,
        "read_only": True,
        # Docker would make an empty folder of root, and say nothing.
        "bind": {"create_host_path": False},
    }
    service = {
        **({"image": container.image.replace("$", "$$")} if container.image else {}),
        "environment": variables,
        "volumes": [mount],
        "read_only": True,
        "tmpfs": list(_LOGS.values()),
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
            for name, value in {**container.variables, **_LOGS}.items()
        ],
        "securityContext": {
            "allowPrivilegeEscalation": False,
            "readOnlyRootFilesystem": True,
            "capabilities": {"drop": ["ALL"]},
        },
        "volumeMounts": [
            {"name": _ENCLAVE_VOLUME, "mountPath": container.folder, "readOnly": True},
            *({"name": _LOG_VOLUME, "mountPath": path} for path in _LOGS.values()),
        ],
    }
    files = {"secretName": secret_name(container.enclave), "defaultMode": _OWNER_READS}
    return {
        "automountServiceAccountToken": False,
        "securityContext": {
            "runAsNonRoot": True,
            "runAsUser": _USER,
            "runAsGroup": _USER,
            "fsGroup": _USER,
            "seccompProfile": {"type": "RuntimeDefault"},
        },
        "containers": [process],
        "volumes": [
            {"name": _ENCLAVE_VOLUME, "secret": files},
            {"name": _LOG_VOLUME, "emptyDir": {}},
        ],
    }
