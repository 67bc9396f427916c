"""Find out which DDS enforces security here, and which package provides `ros2 security`.

ros2cli takes the last of the packages that have the command.  Source: ros2cli 0.32,
``entry_points.py``: entry points by name, in the order of ``sys.path``.

The report to attach to a question says what runs here, and nothing that is secret or private:
only a few known values are shown; secrets, keys, tokens, names of hosts and users, and paths are
removed from all other text, such as what a DDS logged.
"""

from __future__ import annotations

import importlib.metadata
import json
import platform
import pwd
import re
import shlex
import shutil
import socket
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from os import getuid
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from sros_tool import __version__
from sros_tool.dds.domains import DomainSet
from sros_tool.demo.keystores import KeystoreSpec, create_keystores
from sros_tool.demo.scenarios.communication import ISOLATION
from sros_tool.demo.scenarios.model import DEFAULT_TOPIC
from sros_tool.keystore.template import load_template
from sros_tool.runtime.cyclone import INSTALL_ADVICE
from sros_tool.runtime.processes import MappedLibrary
from sros_tool.runtime.rmw import RMW
from sros_tool.runtime.stacks import ROS_ADVICE, Stack, survey
from sros_tool.values import shows

_PROBE_DOMAIN = 80
_TEMPLATE = "production"


@shows("enforces", "ros_enforces", "stacks", "advice")
class Diagnosis(NamedTuple):
    """The stacks of this machine, and advice if none enforces security."""

    stacks: tuple[Stack, ...]
    """The DDS stacks that were tried, each with the result."""

    @property
    def enforces(self) -> bool:
        """Whether at least one DDS here enforces security."""
        return any(stack.enforces for stack in self.stacks)

    @property
    def ros(self) -> Stack | None:
        """The RMW that ROS nodes use here; None if no RMW is installed."""
        return next((stack for stack in self.stacks if stack.kind == "rmw" and stack.present), None)

    @property
    def ros_enforces(self) -> bool | None:
        """Whether the RMW of ROS nodes enforces security; null without an RMW or a result."""
        return self.ros.enforces if self.ros else None

    @property
    def sound(self) -> bool:
        """Whether the RMW of ROS nodes enforces security; without an RMW, whether any DDS does."""
        return self.enforces if self.ros is None else self.ros.enforces is True

    @property
    def libraries(self) -> tuple[MappedLibrary, ...]:
        """The libraries of the DDS stacks that were tried; an unknown version is ""."""
        return tuple(
            MappedLibrary(stack.dds, ".".join(stack.version.split(".")[:3]), stack.where)
            for stack in self.stacks
            if stack.present and stack.where.startswith("/") and "lib" in stack.where
        )

    @property
    def conclusion(self) -> str:
        """Sentences that say which DDS and RMWs here enforce security, and which do not."""
        if not self.enforces:
            return f"Nothing here enforces DDS Security. {self.advice}"
        named = " and ".join(stack.name for stack in self.stacks if stack.enforces)
        able = f"DDS Security can be enforced here, by {named}"
        ros = self.ros
        if ros is None:
            return f"{able}. No RMW is installed here, so ROS nodes were not tried."
        if ros.enforces:
            return f"{able}."
        fault = "does not enforce it" if ros.enforces is False else "could not be tried"
        other = next((e.rmw for e in self.stacks if e.kind == "rmw" and e.enforces and e.rmw), "")
        advice = f"Set {RMW}={other}, which enforces it." if other else ROS_ADVICE
        return f"{able}, but NOT by ROS nodes: {ros.rmw or 'their RMW'} {fault}. {advice}"

    @property
    def advice(self) -> str:
        """What to install if no DDS here enforces security, or an empty string."""
        return "" if self.enforces else f"{INSTALL_ADVICE} {ROS_ADVICE}"


def examine(now: datetime) -> Diagnosis:
    """Try every DDS stack with a temporary keystore, and return the diagnosis."""
    with TemporaryDirectory(prefix="sros-doctor-") as folder:
        domains = DomainSet.of((_PROBE_DOMAIN, _PROBE_DOMAIN))
        template = load_template(_TEMPLATE)
        spec = KeystoreSpec(DEFAULT_TOPIC, domains, template, now)
        keystores = create_keystores(Path(folder), ISOLATION, spec)
        stacks = survey(keystores.probe(DEFAULT_TOPIC, _PROBE_DOMAIN))
    return Diagnosis(stacks)


def diagnosis_text(diagnosis: Diagnosis) -> str:
    """Return the diagnosis as text: the conclusion, then each stack with evidence and advice."""
    width = max(len(stack.name) for stack in diagnosis.stacks)
    lines = [diagnosis.conclusion, ""]
    for stack in diagnosis.stacks:
        identity = f"{stack.dds} {stack.version}".strip() if stack.present else ""
        lines.append(f"{stack.name:<{width}}  {_answer(stack):<19}  {identity}".rstrip())
        is_concluded = stack.advice in diagnosis.conclusion
        lines += _indented_lines(
            [stack.evidence, stack.where, "" if is_concluded else stack.advice]
        )
    return "\n".join(lines)


def _answer(stack: Stack) -> str:
    if not stack.present:
        return "not installed"
    if stack.enforces is None:
        return "could not be tried"
    return "enforces security" if stack.enforces else "does not enforce it"


def _indented_lines(texts: Sequence[str]) -> list[str]:
    return [f"    {text}" for text in texts if text]


_SROS_PACKAGES = ("sros_tool", "sros_ros2_security")
"""Python packages that provide the `ros2 security` of sros; the second package is for workspaces.
"""
_PROVIDER_SECONDS = 60.0
_PROVIDER_PROGRAM = """
import sys
sys.path[:] = [path for path in sys.path if path]  # not the working folder: anybody may own it
import json, importlib.metadata as metadata
entries = metadata.entry_points(group="ros2cli.command", name="security")
print(json.dumps([entry.dist.name for entry in entries if entry.dist]))
"""


@dataclass(frozen=True, slots=True)
class SecurityProvider:
    """The Python package whose `ros2 security` runs, and the packages that it hides."""

    provider: str
    """The package whose command runs; ``sros_tool`` and ``sros_ros2_security`` belong to sros."""
    hidden: tuple[str, ...]
    """Other packages that have `ros2 security`, but whose command does not run."""

    @property
    def is_from_sros(self) -> bool:
        """Whether the `ros2 security` that runs belongs to sros."""
        return self.provider in _SROS_PACKAGES

    def __str__(self) -> str:
        if self.is_from_sros:
            return "`ros2 security` comes from sros."
        return (
            f"`ros2 security` comes from {self.provider}, not from sros: ros2cli takes the package "
            "that Python finds last. The command `sros` is not affected."
        )


def security_provider(environment: Mapping[str, str]) -> SecurityProvider | None:
    """Return the provider of `ros2 security`, or None if that cannot be found out."""
    program = shutil.which("ros2", path=environment.get("PATH"))
    words = _interpreter(Path(program)) if program else []
    if not words:
        return None
    with suppress(OSError, ValueError, subprocess.SubprocessError):
        ended = subprocess.run(
            [*words, "-c", _PROVIDER_PROGRAM],
            env=dict(environment),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            timeout=_PROVIDER_SECONDS,
            check=True,
        )
        names = [str(package) for package in json.loads(ended.stdout)]
        if names:
            hidden = {name for name in names if name != names[-1] and name not in _SROS_PACKAGES}
            return SecurityProvider(names[-1], tuple(sorted(hidden)))
    return None


def _interpreter(script: Path) -> list[str]:
    """Return the words of a script's ``#!`` line if they name a Python; otherwise none."""
    with suppress(OSError, ValueError), script.open("rb") as file:
        first = file.readline(512)
        if first.startswith(b"#!") and b"python" in first:
            return shlex.split(first[2:].decode())
    return []


_NUMBER = re.compile(r"\d{1,3}\Z", re.ASCII)
_VERSION = re.compile(r"v?\d[\w.+!-]{0,40}\Z", re.ASCII)
_KNOWN_VALUES: Mapping[str, frozenset[str] | re.Pattern[str]] = {
    "ROS_DISTRO": frozenset(("humble", "iron", "jazzy", "kilted", "lyrical", "rolling")),
    "ROS_DOMAIN_ID": _NUMBER,
    "ROS_SECURITY_ENABLE": frozenset(("true", "false")),
    "ROS_SECURITY_STRATEGY": frozenset(("Enforce", "Permissive")),
    "ROS_LOCALHOST_ONLY": _NUMBER,
    "ROS_AUTOMATIC_DISCOVERY_RANGE": frozenset(("SUBNET", "LOCALHOST", "OFF", "SYSTEM_DEFAULT")),
    "RMW_IMPLEMENTATION": frozenset(
        f"rmw_{middleware}"
        for middleware in (
            "connextdds",
            "cyclonedds_cpp",
            "fastrtps_cpp",
            "fastrtps_dynamic_cpp",
            "zenoh_cpp",
        )
    ),
}
"""Environment variables with their values that are safe to show; other values are private."""
_PRESENCE_ONLY_VARIABLES = (
    "AMENT_PREFIX_PATH",
    "CYCLONEDDS_URI",
    "FASTDDS_PKCS11_PIN",
    "FASTRTPS_DEFAULT_PROFILES_FILE",
    "PKCS11_MODULE_PATH",
    "PYTHONPATH",
    "ROS_SECURITY_ENCLAVE_OVERRIDE",
    "ROS_SECURITY_KEYSTORE",
    "ROS_SECURITY_LOG_FILE",
    "ZENOH_CONFIG_OVERRIDE",
    "ZENOH_ROUTER_CONFIG_URI",
    "ZENOH_SESSION_CONFIG_URI",
)
"""Environment variables that are reported as set or not set, without their values."""
_PACKAGES = (
    "click",
    "cryptography",
    "lxml",
    "ansible-core",
    "eclipse-zenoh",
    "python-pkcs11",
    "rclpy",
    "ros2cli",
    "sros2",
)
_SECRET_NAME = re.compile(r"PASS|PIN\b|_PIN|SECRET|TOKEN|KEY|CREDENTIAL|AUTH", re.IGNORECASE)
_SYSTEM_FOLDERS = ("/dev/", "/etc/", "/lib/", "/lib64/", "/opt/ros/", "/proc/", "/sys/", "/usr/")


def support_report(
    environment: Mapping[str, str], sections: Mapping[str, Sequence[str]], *, secrets: Iterable[str]
) -> str:
    """Return the report without private data: versions, system, environment, and ``sections``.

    ``secrets`` are values that no section may show, in addition to those of ``environment``.
    """
    without_private = _PrivateDataRemover(environment, secrets)
    parts = {
        "Versions": _versions(),
        "System": _system(),
        "Environment": _environment(environment),
        **{title: [without_private(line) for line in lines] for title, lines in sections.items()},
    }
    lines: list[str] = []
    for title, body in parts.items():
        lines += ["", f"## {title}", "", *(f"- {line}" for line in body or ("none",))]
    return "\n".join(["# sros support report", *lines]) + "\n"


def _versions() -> list[str]:
    versions = []
    for name in _PACKAGES:
        with suppress(importlib.metadata.PackageNotFoundError):
            version = importlib.metadata.version(name)
            versions.append(
                f"{name} {version if _VERSION.match(version) else '(local version, not shown)'}"
            )
    return [f"sros {__version__}", f"Python {platform.python_version()}", *versions]


def _system() -> list[str]:
    release = "unknown system"
    with suppress(OSError):
        about = platform.freedesktop_os_release()
        version = about.get("VERSION_ID", "")
        known = re.match(r"[a-z]{2,20}\Z", about.get("ID", ""))
        release = " ".join(
            (known[0] if known else "Linux", version if _VERSION.match(version) else "")
        )
    kernel = re.match(r"\d+\.\d+", platform.release())
    return [release.strip(), f"kernel {kernel[0] if kernel else '?'}", platform.machine()]


def _environment(environment: Mapping[str, str]) -> list[str]:
    lines = []
    for name, known in _KNOWN_VALUES.items():
        value = environment.get(name)
        if value is not None:
            fits = known.match(value) if isinstance(known, re.Pattern) else value in known
            unknown = f"{name} has a value that sros does not know (not shown)"
            lines.append(f"{name}={value}" if fits else unknown)
    return lines + [f"{name} is set" for name in _PRESENCE_ONLY_VARIABLES if name in environment]


class _PrivateDataRemover:
    """Removes private data from texts: secrets, keys, tokens, hosts, users, and paths."""

    def __init__(self, environment: Mapping[str, str], secrets: Iterable[str]) -> None:
        user = pwd.getpwuid(getuid()) if _is_user_known() else None
        values = {value for name, value in environment.items() if _SECRET_NAME.search(name)}
        words = dict.fromkeys((*values, *secrets), "SECRET")
        homes = (environment.get("HOME", ""), user.pw_dir if user else "", str(Path.home()))
        words |= dict.fromkeys((home.rstrip("/") for home in homes), "~")
        names = (environment.get(name, "") for name in ("USER", "LOGNAME", "SUDO_USER"))
        words |= dict.fromkeys((*names, user.pw_name if user else ""), "USER")
        hosts = (socket.gethostname(), environment.get("HOSTNAME", ""))
        words |= dict.fromkeys((*hosts, *(host.split(".")[0] for host in hosts)), "HOST")
        self._words = {
            word: replacement for word, replacement in words.items() if word not in ("", "root")
        }

    def __call__(self, text: str) -> str:
        """Return the text on one line, without private data."""
        text = re.sub(r"-----BEGIN.*?(-----END[^-]*-----|\Z)", "KEY", text, flags=re.DOTALL)
        for word in sorted(self._words, key=len, reverse=True):
            replacement = self._words[word]
            bound = replacement in ("USER", "HOST") or len(word) < 4
            pattern = rf"(?<!\w){re.escape(word)}(?!\w)" if bound else re.escape(word)
            text = re.sub(pattern, replacement, text)
        text = re.sub(r"pkcs11:\S+", "pkcs11:…", text)
        text = re.sub(r"\b\d{1,3}(\.\d{1,3}){3}\b(?!\.)", "ADDRESS", text)
        text = re.sub(r"\b[0-9a-fA-F]{0,4}(:[0-9a-fA-F]{0,4}){4,7}\b", "ADDRESS", text)
        text = re.sub(r"(?:~|(?<![\w.~]))/[^\s'\"`,;()<>]+", self._path, text)
        return " ".join(text.split())

    def _path(self, match: re.Match[str]) -> str:
        path = match[0]
        return path if path.startswith(_SYSTEM_FOLDERS) and ".." not in path else "PATH"


def _is_user_known() -> bool:
    """Return whether the user is in the user database; in containers some users are not."""
    try:
        pwd.getpwuid(getuid())
    except KeyError:
        return False
    return True
