"""The settings of a robot's agent (``agent.toml``), and the folder that the agent keeps to itself.

`sros agent init` writes the settings, and people can edit them.  The folder decides from where
files come and which programs run, so only its owner may be able to change it.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

from sros_tool.errors import DocumentError, InvalidNameError, KeystoreError
from sros_tool.files import read_toml, replace_file
from sros_tool.fleet.robots import name_problem
from sros_tool.folders import Folder
from sros_tool.keystore.layout import AGENT
from sros_tool.names import check_enclave_name
from sros_tool.owners import (
    closing_command,
    other_writers_clause,
    replaceable_on_the_way,
    user_name,
)
from sros_tool.wording import capitalized
from sros_tool.xml import read_bytes

SETTINGS_FILE = "agent.toml"
_UNIT_NAME = re.compile(r"[A-Za-z0-9:_.\\@-]{1,250}\.(?:service|target)\Z")
_DIGEST = re.compile(r"[0-9a-f]{64}\Z")
_SOURCE = re.compile(r"(?:https?://[!-~]+|/.*)\Z")


class Unit(NamedTuple):
    """A systemd unit, and the enclaves in which its processes run."""

    name: str
    """Name of the unit, such as ``camera.service``."""
    enclaves: tuple[str, ...]
    """Enclaves in which processes of the unit run."""


@dataclass(frozen=True, slots=True)
class AgentSettings:
    """The settings of a robot's agent.

    ``source`` and ``inbox`` are URLs (https, http) or absolute paths of folders.  ``authorities``
    are the SHA-256 of permissions CAs that are trusted in addition to the CAs in the folder.
    ``tls_ca`` is a file with the CAs of the servers, or "" for the CAs of the system.  With
    ``new_key``, the agent makes a new key for each renewal.  With ``restart``, the agent restarts
    units: ``units``, and active units from `sros units`; ``restart_if`` is a command that exits
    with 0 if a restart is possible now, and ``systemctl`` the command that restarts a unit.
    """

    robot: str
    source: str
    inbox: str
    authorities: tuple[str, ...] = ()
    tls_ca: str = ""
    new_key: bool = False
    restart: bool = False
    restart_if: tuple[str, ...] = ()
    systemctl: tuple[str, ...] = ("systemctl",)
    units: tuple[Unit, ...] = ()

    def options(self, *, without: Container[str] = ()) -> list[str]:
        """Return the options of `sros agent init` that set these settings.

        Fields in ``without``, and fields with their default, are left out.
        """
        return [
            f"--{_OPTIONS.get(field.name, field.name.replace('_', '-'))}"
            for field in fields(self)
            if field.name not in without and getattr(self, field.name) != field.default
        ]


_OPTIONS = {"source": "from", "authorities": "ca", "units": "unit"}
"""Field of `AgentSettings` → its option, if it has another name."""


def agent_folder(folder: Path) -> Path:
    """Return the folder of the agent in the security folder ``folder``."""
    return folder / AGENT


def check_owner(folder: Path) -> None:
    """Raise `KeystoreError` unless only the user who runs the agent can change its folder.

    An agent that runs as root in a folder of another user would run programs which that user
    chooses.
    """
    user = os.geteuid()
    state = folder.stat()
    if state.st_uid != user:
        raise KeystoreError(
            f"'{folder}' belongs to {user_name(state.st_uid)}",
            "The agent runs as the owner of the security folder, and needs no root rights.",
            "Run it as that user.",
        )
    agents_folder = agent_folder(folder)
    trusted = frozenset({0, user})
    places = [
        (step, why) for step, why in replaceable_on_the_way(agents_folder / "x", trusted) if why
    ]
    places += [
        (path, other_writers_clause(path.lstat(), trusted))
        for path in (agents_folder, agents_folder / SETTINGS_FILE)
        if os.path.lexists(path)
    ]
    for path, why in places:
        if why:
            raise KeystoreError(
                f"others can change '{path}'",
                f"{capitalized(why)}. Such users could choose whom the agent trusts, and "
                "which commands it runs.",
                f"Run `{closing_command(path, trusted)}`, or set up the agent in a folder that "
                "only this user and root can change.",
            )


def make_agent_folder(folder: Path) -> None:
    """Make the agent's folder in the security folder ``folder``, if it does not exist."""
    with Folder(folder) as opened:
        if not opened.is_folder(AGENT):
            opened.mkdir(AGENT, 0o700)


def write_settings(folder: Path, settings: AgentSettings) -> None:
    """Write the settings of the agent of ``folder``, which has an agent's folder.

    Raises:
        OSError: the settings cannot be written; earlier settings stay.
    """
    replace_file(agent_folder(folder) / SETTINGS_FILE, render_settings(settings))


def render_settings(settings: AgentSettings) -> bytes:
    """Return settings as a TOML document, which `read_settings` reads."""
    lines = [
        "# The agent of this robot (`sros agent`); docs/fetching.md describes each setting.",
        f"robot = {_toml_text(settings.robot)}",
        f"from = {_toml_text(settings.source)}",
        f"inbox = {_toml_text(settings.inbox)}",
    ]
    if settings.authorities:
        lines.append(f"authorities = {_toml_list(settings.authorities)}")
    if settings.tls_ca:
        lines.append(f"tls_ca = {_toml_text(settings.tls_ca)}")
    lines += [
        f"new_key = {_toml_boolean(settings.new_key)}",
        f"restart = {_toml_boolean(settings.restart)}",
    ]
    if settings.restart_if:
        lines.append(f"restart_if = {_toml_list(settings.restart_if)}")
    lines.append(f"systemctl = {_toml_list(settings.systemctl)}")
    for unit in settings.units:
        lines += [
            "",
            "[[unit]]",
            f"name = {_toml_text(unit.name)}",
            f"enclaves = {_toml_list(unit.enclaves)}",
        ]
    return ("\n".join(lines) + "\n").encode()


def _toml_text(text: str) -> str:
    return json.dumps(text, ensure_ascii=True).replace("\\/", "/")


def _toml_list(texts: Sequence[str]) -> str:
    return f"[{', '.join(map(_toml_text, texts))}]"


def _toml_boolean(value: bool) -> str:
    return "true" if value else "false"


def read_settings(folder: Path, *, to_run: bool = True) -> AgentSettings:
    """Return the settings of the agent of ``folder``.

    ``to_run`` says that the caller runs the agent: other users must not be able to change the
    settings then.

    Raises:
        KeystoreError: there are no settings, or other users can change them.
        DocumentError: the settings are malformed.
    """
    path = agent_folder(folder) / SETTINGS_FILE
    if not path.exists():
        raise KeystoreError(
            f"'{folder}' has no agent",
            f"'{path}' does not exist.",
            "Run `sros agent init`.",
        )
    if to_run:
        check_owner(folder)
    shown_path = f"'{path}'"
    return settings_from(read_toml(read_bytes(path, "agent's settings"), shown_path), shown_path)


_TEXT_KEYS = {"robot": "robot", "from": "source", "inbox": "inbox", "tls_ca": "tls_ca"}
_BOOLEAN_KEYS = {"new_key", "restart"}
_LIST_KEYS = {"authorities", "restart_if", "systemctl"}


def settings_from(value: Mapping[str, Any], label: str) -> AgentSettings:
    """Return the settings in a TOML document; ``label`` names the document in errors.

    Raises:
        DocumentError: a key is missing, unknown or of another form.
    """
    values: dict[str, Any] = {}
    for key, entry in value.items():
        if key in _TEXT_KEYS and isinstance(entry, str):
            values[_TEXT_KEYS[key]] = entry
        elif key in _BOOLEAN_KEYS and isinstance(entry, bool):
            values[key] = entry
        elif key in _LIST_KEYS and _is_list_of_texts(entry):
            values[key] = tuple(entry)
        elif key == "unit" and isinstance(entry, list):
            values["units"] = tuple(_unit_from_table(unit, label) for unit in entry)
        else:
            raise _invalid_settings_error(
                label, f"{key} is not a known key, or its value has the wrong form"
            )
    if missing := [key for key in ("robot", "from", "inbox") if _TEXT_KEYS[key] not in values]:
        raise _invalid_settings_error(label, f"It lacks {', '.join(missing)}")
    settings = AgentSettings(**values)
    if problem := name_problem(settings.robot):
        raise _invalid_settings_error(
            label, f"{settings.robot!r} is not the name of a robot: {problem}"
        )
    for place in (settings.source, settings.inbox):
        if not _SOURCE.match(place):
            raise _invalid_settings_error(
                label, f"{place!r} is neither a URL (https, http) nor an absolute path"
            )
    if not all(map(_DIGEST.match, settings.authorities)):
        raise _invalid_settings_error(
            label, "authorities has an entry that is not a SHA-256 in lower-case hexadecimal"
        )
    if not settings.systemctl:
        raise _invalid_settings_error(label, "systemctl is empty")
    return settings


def _unit_from_table(value: Any, label: str) -> Unit:
    if not isinstance(value, dict) or value.keys() != {"name", "enclaves"}:
        raise _invalid_settings_error(
            label, "An entry of `unit` has other keys than name and enclaves, or lacks one of them"
        )
    name, enclaves = value["name"], value["enclaves"]
    if not isinstance(name, str) or not _UNIT_NAME.match(name):
        raise _invalid_settings_error(
            label, f"{name!r} is not the name of a service or target of systemd"
        )
    if not _is_list_of_texts(enclaves):
        raise _invalid_settings_error(label, f"The enclaves of {name} are not a list of names")
    try:
        return Unit(name, tuple(map(check_enclave_name, enclaves)))
    except InvalidNameError as error:
        raise _invalid_settings_error(label, str(error)) from error


def _is_list_of_texts(value: object) -> bool:
    return isinstance(value, list) and all(isinstance(entry, str) for entry in value)


def _invalid_settings_error(name: str, why: str) -> DocumentError:
    return DocumentError(f"{name} are not the settings of an agent", f"{why}.", "Correct the file.")
