"""The report to attach to a question: what runs here, and nothing that is secret or private.

Values are shown only where they are one of a few known ones; all other text, such as what a DDS
logged, is made neutral first: secrets, keys, tokens, names of hosts and users, and paths.
"""

from __future__ import annotations

import importlib.metadata
import platform
import pwd
import re
import socket
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from os import getuid
from pathlib import Path

from sros_tool import __version__

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
        f"rmw_{each}"
        for each in (
            "connextdds",
            "cyclonedds_cpp",
            "fastrtps_cpp",
            "fastrtps_dynamic_cpp",
            "zenoh_cpp",
        )
    ),
}
"""Variables whose values say nothing about their user, if they are among these."""
_PRESENT = (
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
"""Variables of which it is reported only whether they are set."""
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
_SYSTEM = ("/dev/", "/etc/", "/lib/", "/lib64/", "/opt/ros/", "/proc/", "/sys/", "/usr/")


def support_report(
    environment: Mapping[str, str], sections: Mapping[str, Sequence[str]], *, secrets: Iterable[str]
) -> str:
    """Return the report as text: versions, system, environment, and ``sections`` made neutral.

    ``secrets`` are values that no section may show, in addition to those of ``environment``.
    """
    neutral = _Neutral(environment, secrets)
    parts = {
        "Versions": _versions(),
        "System": _system(),
        "Environment": _environment(environment),
        **{title: [neutral(line) for line in lines] for title, lines in sections.items()},
    }
    lines: list[str] = []
    for title, body in parts.items():
        lines += ["", f"## {title}", "", *(f"- {line}" for line in body or ("none",))]
    return "\n".join(["# sros support report", *lines]) + "\n"


def _versions() -> list[str]:
    found = []
    for name in _PACKAGES:
        with suppress(importlib.metadata.PackageNotFoundError):
            version = importlib.metadata.version(name)
            found.append(f"{name} {version if _VERSION.match(version) else 'of a local version'}")
    return [f"sros {__version__}", f"Python {platform.python_version()}", *found]


def _system() -> list[str]:
    release = "another system than Linux"
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
            lines.append(f"{name}={value}" if fits else f"{name} has another value")
    return lines + [f"{name} is set" for name in _PRESENT if name in environment]


class _Neutral:
    """Take out of a text what it says about its user; it stays readable."""

    def __init__(self, environment: Mapping[str, str], secrets: Iterable[str]) -> None:
        user = pwd.getpwuid(getuid()) if _has_entry() else None
        values = {value for name, value in environment.items() if _SECRET_NAME.search(name)}
        words = dict.fromkeys((*values, *secrets), "SECRET")
        homes = (environment.get("HOME", ""), user.pw_dir if user else "", str(Path.home()))
        words |= dict.fromkeys((home.rstrip("/") for home in homes), "~")
        names = (environment.get(each, "") for each in ("USER", "LOGNAME", "SUDO_USER"))
        words |= dict.fromkeys((*names, user.pw_name if user else ""), "USER")
        hosts = (socket.gethostname(), environment.get("HOSTNAME", ""))
        words |= dict.fromkeys((*hosts, *(host.split(".")[0] for host in hosts)), "HOST")
        self._words = {word: instead for word, instead in words.items() if word not in ("", "root")}

    def __call__(self, text: str) -> str:
        """Return the text on one line, without them."""
        text = re.sub(r"-----BEGIN.*?(-----END[^-]*-----|\Z)", "KEY", text, flags=re.DOTALL)
        for word in sorted(self._words, key=len, reverse=True):
            instead = self._words[word]
            bound = instead in ("USER", "HOST") or len(word) < 4
            pattern = rf"(?<!\w){re.escape(word)}(?!\w)" if bound else re.escape(word)
            text = re.sub(pattern, instead, text)
        text = re.sub(r"pkcs11:\S+", "pkcs11:…", text)
        text = re.sub(r"\b\d{1,3}(\.\d{1,3}){3}\b(?!\.)", "ADDRESS", text)
        text = re.sub(r"\b[0-9a-fA-F]{0,4}(:[0-9a-fA-F]{0,4}){4,7}\b", "ADDRESS", text)
        text = re.sub(r"(?:~|(?<![\w.~]))/[^\s'\"`,;()<>]+", self._path, text)
        return " ".join(text.split())

    def _path(self, match: re.Match[str]) -> str:
        path = match[0]
        return path if path.startswith(_SYSTEM) and ".." not in path else "PATH"


def _has_entry() -> bool:
    """Return whether this user has an entry in the list of users; in containers some have none."""
    try:
        pwd.getpwuid(getuid())
    except KeyError:
        return False
    return True
