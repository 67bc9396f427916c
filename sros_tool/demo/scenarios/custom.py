"""User-defined scenarios: a TOML file with parties and rows, and the policy of their enclaves.

::

    title = "who sees the camera"
    policy = "robot.xml"                  # relative to this file

    [[party]]
    name = "camera"
    role = "talker"                       # a value of `sros_tool.demo.scenarios.model.Role`
    enclave = "/arm/camera"               # without it: unsecured
    topic = "/image"                      # or the name of a service or action

    [[party]]
    name = "spy"
    role = "listener"
    topic = "/image"

    [[row]]
    name = "a spy does not see the camera"
    because = "..."                       # the reason, shown as the mechanism

    [[row.claim]]
    listener = "spy"
    talker = "camera"
    expected = "not heard"

    [[row.control]]                       # proves that the silence is not a crash
    listener = "viewer"
    talker = "camera"
    expected = "heard"

``expected`` is a status of the demo's table; the keys for the parties of a claim depend on it
(`_PARTIES`).
``keystore = "foreign"`` gives a party the identity of another CA; ``variables`` is a table of
environment variables, of those in `_VARIABLES`.  The name of a party is also that of its log.  A
claim that something does not happen needs another claim or a control that something does happen.
"""

from __future__ import annotations

import difflib
import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sros_tool.demo.scenarios.model import (
    OWN,
    SPEAKING,
    UNSECURED,
    Claim,
    Identity,
    Party,
    Relation,
    Role,
    Row,
    RowStatus,
    Scenario,
    SoundKeystore,
)
from sros_tool.demo.scenarios.policies import check_topic
from sros_tool.errors import DocumentError, SrosError
from sros_tool.files import parse_toml
from sros_tool.policy.document import read_policy
from sros_tool.policy.model import Policy
from sros_tool.runtime.variables import DOMAIN, ENABLE, ENCLAVE, KEYSTORE, STRATEGY
from sros_tool.xml import read_bytes

_PARTIES: Mapping[Relation, tuple[str, ...]] = {
    Relation.HEARS: ("listener", "talker"),
    Relation.IS_ANSWERED: ("client", "server"),
    Relation.SEES: ("observer", "talker"),
    Relation.READABLE: ("party",),
    Relation.IS_REFUSED: ("party",),
    Relation.STARTS: ("party",),
}
"""The keys that name the parties of a claim: first its subject, then the other party."""

_CLAIMS: Mapping[str, tuple[Relation, bool]] = {
    "heard": (Relation.HEARS, True),
    "not heard": (Relation.HEARS, False),
    "answered": (Relation.IS_ANSWERED, True),
    "not answered": (Relation.IS_ANSWERED, False),
    "visible": (Relation.SEES, True),
    "not visible": (Relation.SEES, False),
    "readable": (Relation.READABLE, True),
    "not readable": (Relation.READABLE, False),
    "refused": (Relation.IS_REFUSED, True),
    "started": (Relation.STARTS, True),
}
_EXAMPLE = 'Write a table: listener = "spy", talker = "camera", expected = "not heard".'

_FITTING: Mapping[str, tuple[Role, ...]] = {
    "talker": (Role.TALKER, Role.COMPOSED),
    "listener": (Role.LISTENER, Role.COMPOSED),
    "observer": (Role.OBSERVER,),
    "client": (Role.CLIENT, Role.ACTION_CLIENT),
    "server": (Role.SERVER, Role.ACTION_SERVER, Role.COMPOSED),
    "party": tuple(Role),
}
"""The roles of a party that a key of a claim can name."""

_NAMED = (Role.SERVER, Role.CLIENT, Role.ACTION_SERVER, Role.ACTION_CLIENT)
"""The roles that need the name of their service or action."""

_VARIABLES = (DOMAIN, ENABLE, ENCLAVE, KEYSTORE, STRATEGY)
"""The variables that a party can have: others, such as LD_PRELOAD, could run code of the author."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9 ._-]{0,63}")
"""The names of parties: those of files in one folder."""

_KEYS = {
    "": {"title", "policy", "party", "row"},
    "party": {"name", "role", "enclave", "keystore", "topic", "variables"},
    "row": {"name", "claim", "control", "because"},
}


def read_scenario(path: Path) -> Scenario:
    """Read a scenario file.

    Raises:
        DocumentError: the file is not a valid scenario; the message has the line.
    """
    try:
        text = read_bytes(path, "scenario").decode()
        data = parse_toml(text)
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise DocumentError(
            f"the scenario '{path}' is not valid TOML", f"{error}.", "Correct the file."
        ) from error
    return _Reader(path, text).scenario(data)


class _Reader:
    """A reader of one scenario file.

    Methods take the kind of a table ("party"; "": top level) and its index among the tables of that
    kind, to find the line for an error.
    """

    def __init__(self, path: Path, text: str) -> None:
        self._path = path
        self._lines = text.splitlines()

    def scenario(self, data: Mapping[str, Any]) -> Scenario:
        self._check_keys(data, "", 0)
        file = self._path.parent / self._text(data, "policy", "", 0)
        try:
            policy = read_policy(file)
        except (SrosError, ValueError) as error:  # ValueError: NUL in the file name
            raise self._error("", 0, "policy", str(error)) from error
        parties: dict[str, Party] = {}
        for place, table in enumerate(self._tables(data, "party")):
            party = self._party(table, place, policy)
            same = party.name.replace(" ", "_")
            if any(each.replace(" ", "_") == same for each in parties):
                raise self._error("party", place, "name", f"there are two parties {party.name!r}")
            parties[party.name] = party
        rows = tuple(
            self._row(table, place, parties)
            for place, table in enumerate(self._tables(data, "row"))
        )
        title = self._text(data, "title", "", 0, self._path.stem)
        return Scenario(self._path.stem, title, rows, policy=lambda _topic: policy)

    def _party(self, table: Mapping[str, Any], place: int, policy: Policy) -> Party:
        self._check_keys(table, "party", place)
        name = self._text(table, "name", "party", place)
        if not _NAME.fullmatch(name):
            problem = f"{name!r} is not the name of a party"
            remedy = "Use at most 64 letters, digits, blanks, '.', '_' and '-'."
            raise self._error("party", place, "name", problem, remedy)
        roles = {role.value: role for role in Role}
        word = self._text(table, "role", "party", place)
        if word not in roles:
            problem = f"{word!r} is not a role; use one of {', '.join(roles)}"
            raise self._error("party", place, "role", problem)
        role = roles[word]
        topic = self._text(table, "topic", "party", place, "")
        if not topic and role in _NAMED:
            problem = f"the {word} {name!r} needs a topic: the name of its service or action"
            raise self._error("party", place, "name", problem)
        try:
            topic = check_topic(topic) if topic else ""
        except SrosError as error:
            raise self._error("party", place, "topic", str(error)) from error
        return Party(name, role, self._identity(table, place, policy), topic)

    def _identity(self, table: Mapping[str, Any], place: int, policy: Policy) -> Identity:
        enclave = self._text(table, "enclave", "party", place, "")
        word = self._text(table, "keystore", "party", place, OWN)
        keystores = {each.value: each for each in SoundKeystore}
        if word not in keystores:
            problem = f"{word!r} is not a keystore; use one of {', '.join(keystores)}"
            raise self._error("party", place, "keystore", problem)
        if not enclave:
            for key in ("keystore", "variables"):
                if key in table:
                    problem = f"{key} needs an enclave, but this party is unsecured"
                    raise self._error("party", place, key, problem, "Give it an enclave.")
            return UNSECURED
        if policy.enclave(enclave) is None:
            paths = [each.path for each in policy.enclaves]
            close = difflib.get_close_matches(enclave, paths, n=1)
            hint = f"; did you mean {close[0]}?" if close else f"; it has {', '.join(paths)}"
            raise self._error(
                "party", place, "enclave", f"the policy has no enclave {enclave!r}{hint}"
            )
        variables = table.get("variables", {})
        if not isinstance(variables, dict) or not all(
            isinstance(value, str) for value in variables.values()
        ):
            raise self._error("party", place, "variables", "variables is not a table of strings")
        for variable in variables:
            if variable not in _VARIABLES:
                problem = f"{variable!r} is not a variable for a party; use {', '.join(_VARIABLES)}"
                raise self._error("party", place, "variables", problem)
        return Identity(keystores[word], enclave, tuple(variables.items()))

    def _row(self, table: Mapping[str, Any], place: int, parties: Mapping[str, Party]) -> Row:
        self._check_keys(table, "row", place)
        name = self._text(table, "name", "row", place)
        claims = self._claims(table, "claim", place, parties)
        controls = self._claims(table, "control", place, parties)
        if not claims:
            raise self._error("row", place, "name", f"the row {name!r} has no claim", _EXAMPLE)
        self._check_controls(claims, controls, place)
        used = {word for claim in (*claims, *controls) for word in (claim.subject, claim.talker)}
        expected = claims[0].expected if len(claims) == 1 else RowStatus.UNDISTURBED
        wire = any(claim.relation is Relation.READABLE for claim in (*claims, *controls))
        return Row(
            name,
            expected,
            self._text(table, "because", "row", place, ""),
            tuple(party for party in parties.values() if party.name in used),
            claims,
            controls,
            wire=wire,
        )

    def _claims(
        self, table: Mapping[str, Any], key: str, place: int, parties: Mapping[str, Party]
    ) -> tuple[Claim, ...]:
        tables = table.get(key, [])
        tables = [tables] if isinstance(tables, dict) else tables
        if not isinstance(tables, list):
            raise self._error("row", place, key, f"{key} is not a table", _EXAMPLE)
        return tuple(self._claim(each, key, place, parties) for each in tables)

    def _claim(self, table: Any, key: str, place: int, parties: Mapping[str, Party]) -> Claim:
        if not isinstance(table, dict):
            raise self._error("row", place, key, f"{table!r} is not a table", _EXAMPLE)
        expected = table.get("expected")
        if not isinstance(expected, str) or expected not in _CLAIMS:
            problem = (
                f"a {key} has no expected status"
                if expected is None
                else f"{expected!r} is not a status that can be expected"
            )
            raise self._error("row", place, key, f"{problem}; use one of {', '.join(_CLAIMS)}")
        relation, holds = _CLAIMS[expected]
        keys = _PARTIES[relation]
        if set(table) != {*keys, "expected"}:
            problem = (
                f"a {key} {expected!r} needs {', '.join(keys)} and expected, and no other keys"
            )
            raise self._error("row", place, key, f"{problem}; it has {', '.join(table)}")
        names = [table[each] for each in keys]
        for each, name in zip(keys, names, strict=True):
            if not isinstance(name, str) or name not in parties:
                problem = f"there is no party {name!r}; use one of {', '.join(parties)}"
                raise self._error("row", place, key, problem)
            role = parties[name].role
            if role not in (SPEAKING if relation is Relation.READABLE else _FITTING[each]):
                problem = f"{name} is a {role}, and cannot be the {each} of status {expected!r}"
                raise self._error("row", place, key, problem)
        return Claim(relation, names[0], names[1] if len(names) > 1 else "", holds)

    def _check_controls(
        self, claims: Sequence[Claim], controls: Sequence[Claim], place: int
    ) -> None:
        happening = [claim for claim in (*claims, *controls) if _happens(claim)]
        for claim in claims:
            if _happens(claim):
                continue
            fitting = [
                other
                for other in happening
                if claim.relation is not Relation.HEARS or other.talker == claim.talker
            ]
            if not fitting:
                who = f"a listener hears {claim.talker}" if claim.talker else "something works"
                raise self._error(
                    "row",
                    place,
                    "claim",
                    f"no claim or control shows that {who} meanwhile: a crash would look the same",
                    "Add a control, such as a permitted listener that hears the same talker.",
                )

    # ── tables and lines ───────────────────────────────────────────────────────────────────

    def _tables(self, data: Mapping[str, Any], kind: str) -> list[dict[str, Any]]:
        tables = data.get(kind, [])
        if (
            not isinstance(tables, list)
            or not tables
            or not all(isinstance(each, dict) for each in tables)
        ):
            raise self._error(
                "", 0, kind, f"the scenario needs {kind} tables", f"Write [[{kind}]] tables."
            )
        return tables

    def _check_keys(self, table: Mapping[str, Any], kind: str, place: int) -> None:
        for key in table:
            if key in ("claims", "controls"):
                problem = f"{key!r} is not a key here; write tables [[row.{key[:-1]}]]"
                raise self._error(kind, place, key, problem, _EXAMPLE)
            if key not in _KEYS[kind]:
                known = ", ".join(sorted(_KEYS[kind]))
                problem = f"{key!r} is not a key here; use one of {known}"
                raise self._error(kind, place, key, problem)

    def _text(
        self,
        table: Mapping[str, Any],
        key: str,
        kind: str,
        place: int,
        default: str | None = None,
    ) -> str:
        value = table.get(key, default)
        if not isinstance(value, str) or (default is None and not value):
            what = f"the {kind or 'scenario'} has no {key}" if key not in table else ""
            raise self._error(kind, place, key, what or f"{key} is {value!r}, not a string")
        return value

    def _error(
        self, kind: str, place: int, key: str, problem: str, remedy: str = ""
    ) -> DocumentError:
        line = self._line(kind, place, key)
        return DocumentError(f"the scenario '{self._path}', line {line}: {problem}", "", remedy)

    def _line(self, kind: str, place: int, key: str) -> int:
        """Return the line number of a key in a table, or of its head if it lacks the key."""
        heads = [n for n, text in enumerate(self._lines) if re.match(rf"\s*\[\[{kind}\]\]", text)]
        start = heads[place] if kind and place < len(heads) else 0
        ends = (
            n
            for n in range(start + 1, len(self._lines))
            if re.match(r"\s*\[\[\s*\w+\s*\]\]", self._lines[n])
        )
        for number in range(start, next(ends, len(self._lines))):
            if re.match(
                rf"\s*([\"']?{re.escape(key)}[\"']?\s*[=.]|\[\[row\.{re.escape(key)}\]\])",
                self._lines[number],
            ):
                return number + 1
        return start + 1


def _happens(claim: Claim) -> bool:
    """Return whether a claim expects that something works, not silence or a refusal."""
    return claim.holds and claim.relation is not Relation.IS_REFUSED
