"""Scenarios of the user's own: a TOML file of parties and rows over a policy of theirs.

::

    title = "who sees the camera"
    policy = "robot.xml"                  # relative to this file

    [[party]]
    name = "camera"
    role = "talker"                       # a role of `sros_tool.demo.model.Role`
    enclave = "/arm/camera"               # left out: unsecured
    topic = "/image"                      # or the name of a service or action

    [[party]]
    name = "spy"
    role = "listener"
    topic = "/image"

    [[row]]
    name = "a spy does not see the camera"
    claims = ["spy does not hear camera"]
    controls = ["viewer hears camera"]    # what makes the silence believable
    because = "..."                       # what brings it about, for the table

``keystore = "foreign"`` gives a party the identity of another CA; ``variables`` is a table of
environment variables.  Whatever is expected not to happen needs a claim or control beside it that
does happen.
"""

from __future__ import annotations

import difflib
import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sros_tool.demo.model import (
    FOREIGN,
    OWN,
    SPEAKING,
    UNSECURED,
    Claim,
    Identity,
    Party,
    Relation,
    Role,
    Row,
    Scenario,
    Status,
)
from sros_tool.demo.policies import check_topic
from sros_tool.errors import DocumentError, SrosError
from sros_tool.files import parse_toml
from sros_tool.policy import Policy, read_policy
from sros_tool.xml import read_bytes

_PHRASES: tuple[tuple[str, Relation, bool], ...] = (
    ("is not readable on the wire", Relation.READABLE, False),
    ("is readable on the wire", Relation.READABLE, True),
    ("is not answered by", Relation.IS_ANSWERED, False),
    ("is answered by", Relation.IS_ANSWERED, True),
    ("does not hear", Relation.HEARS, False),
    ("does not see", Relation.SEES, False),
    ("is refused", Relation.IS_REFUSED, True),
    ("hears", Relation.HEARS, True),
    ("sees", Relation.SEES, True),
    ("starts", Relation.STARTS, True),
)
_ALONE = (Relation.READABLE, Relation.IS_REFUSED, Relation.STARTS)
_ASKING = (Role.CLIENT, Role.ACTION_CLIENT)
_SERVING = (Role.SERVER, Role.ACTION_SERVER, Role.COMPOSED)
_HEARING = (Role.LISTENER, Role.COMPOSED)
_NAMED = (Role.SERVER, Role.CLIENT, Role.ACTION_SERVER, Role.ACTION_CLIENT)
_KEYS = {
    "": {"title", "policy", "party", "row"},
    "party": {"name", "role", "enclave", "keystore", "topic", "variables"},
    "row": {"name", "claims", "controls", "because"},
}


def read_scenario(path: Path) -> Scenario:
    """Read a scenario file; raises `DocumentError` with the line of what is not understood."""
    try:
        text = read_bytes(path, "scenario").decode()
        data = parse_toml(text)
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise DocumentError(
            f"the scenario '{path}' is not valid TOML", f"{error}.", "Correct it there."
        ) from error
    return _Reader(path, text).scenario(data)


class _Reader:
    def __init__(self, path: Path, text: str) -> None:
        self._path = path
        self._lines = text.splitlines()

    def scenario(self, data: Mapping[str, Any]) -> Scenario:
        self._known(data, "", 0)
        file = self._path.parent / self._text(data, "policy", "", 0)
        try:
            policy = read_policy(file)
        except (SrosError, ValueError) as error:  # a name that holds NUL is of no file
            raise self._error("", 0, "policy", str(error)) from error
        parties = {}
        for place, table in enumerate(self._tables(data, "party")):
            party = self._party(table, place, policy)
            if party.name in parties:
                raise self._error("party", place, "name", f"there are two parties {party.name!r}")
            parties[party.name] = party
        rows = tuple(
            self._row(table, place, parties)
            for place, table in enumerate(self._tables(data, "row"))
        )
        title = self._text(data, "title", "", 0, self._path.stem)
        return Scenario(self._path.stem, title, rows, policy=lambda _topic: policy)

    def _party(self, table: Mapping[str, Any], place: int, policy: Policy) -> Party:
        self._known(table, "party", place)
        name = self._text(table, "name", "party", place)
        roles = {role.value: role for role in Role}
        word = self._text(table, "role", "party", place)
        if word not in roles:
            problem = f"{word!r} is not a role; there are {', '.join(roles)}"
            raise self._error("party", place, "role", problem)
        role = roles[word]
        topic = self._text(table, "topic", "party", place, "")
        if not topic and role in _NAMED:
            raise self._error(
                "party", place, "name", f"the {word} {name!r} needs a topic: its name"
            )
        try:
            topic = check_topic(topic) if topic else ""
        except SrosError as error:
            raise self._error("party", place, "topic", str(error)) from error
        return Party(name, role, self._identity(table, place, policy), topic)

    def _identity(self, table: Mapping[str, Any], place: int, policy: Policy) -> Identity:
        enclave = self._text(table, "enclave", "party", place, "")
        keystore = self._text(table, "keystore", "party", place, OWN)
        if keystore not in (OWN, FOREIGN):
            problem = f"{keystore!r} is not a keystore; there are {OWN} and {FOREIGN}"
            raise self._error("party", place, "keystore", problem)
        if not enclave:
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
            raise self._error("party", place, "variables", "variables is not a table of texts")
        return Identity(keystore, enclave, tuple(variables.items()))

    def _row(self, table: Mapping[str, Any], place: int, parties: Mapping[str, Party]) -> Row:
        self._known(table, "row", place)
        name = self._text(table, "name", "row", place)
        claims = self._claims(table, "claims", place, parties)
        controls = self._claims(table, "controls", place, parties)
        if not claims:
            raise self._error("row", place, "name", f"the row {name!r} has no claims")
        self._check_controls(claims, controls, place)
        used = {word for claim in (*claims, *controls) for word in (claim.subject, claim.talker)}
        expected = claims[0].expected if len(claims) == 1 else Status.UNDISTURBED
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
        texts = table.get(key, [])
        if not isinstance(texts, list) or not all(isinstance(text, str) for text in texts):
            raise self._error("row", place, key, f"{key} is not a list of texts")
        return tuple(self._claim(text, key, place, parties) for text in texts)

    def _claim(self, text: str, key: str, place: int, parties: Mapping[str, Party]) -> Claim:
        for phrase, relation, holds in _PHRASES:
            found = re.fullmatch(rf"(.+?) {phrase}(?: (.+))?", text.strip())
            if not found or bool(found[2]) is (relation in _ALONE):
                continue
            subject, other = found[1], found[2] or ""
            for name in filter(None, (subject, other)):
                if name not in parties:
                    problem = f"{text!r}: there is no party {name!r}; there are"
                    raise self._error("row", place, key, f"{problem} {', '.join(parties)}")
            claim = Claim(relation, subject, other, holds)
            if problem := _misfit(claim, parties):
                raise self._error("row", place, key, f"{text!r}: {problem}")
            return claim
        phrases = ", ".join(f"'X {p}{'' if r in _ALONE else ' Y'}'" for p, r, _ in _PHRASES)
        raise self._error("row", place, key, f"{text!r} is not a claim; claims are {phrases}")

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
                who = f" somebody else hears {claim.talker}" if claim.talker else " something works"
                raise self._error(
                    "row",
                    place,
                    "claims",
                    f"nothing shows that{who} at the same time: a crash would look the same",
                    "Add a control, such as the rightful listener that hears the same talker.",
                )

    # ── tables and lines ───────────────────────────────────────────────────────────────────

    def _tables(self, data: Mapping[str, Any], kind: str) -> list[dict[str, Any]]:
        tables = data.get(kind, [])
        if not isinstance(tables, list) or not tables or not isinstance(tables[0], dict):
            raise self._error("", 0, kind, f"there is no {kind}", f"Add a table [[{kind}]].")
        return tables

    def _known(self, table: Mapping[str, Any], kind: str, place: int) -> None:
        for key in table:
            if key not in _KEYS[kind]:
                known = ", ".join(sorted(_KEYS[kind]))
                problem = f"{key!r} is not a key here; there are {known}"
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
            raise self._error(kind, place, key, what or f"{key} is {value!r}, not a text")
        return value

    def _error(
        self, kind: str, place: int, key: str, problem: str, remedy: str = ""
    ) -> DocumentError:
        line = self._line(kind, place, key)
        return DocumentError(f"the scenario '{self._path}', line {line}: {problem}", "", remedy)

    def _line(self, kind: str, place: int, key: str) -> int:
        """The line of a key in the table of that kind and place, or that of the table."""
        heads = [n for n, text in enumerate(self._lines) if re.match(rf"\s*\[\[{kind}\]\]", text)]
        start = heads[place] if kind and place < len(heads) else 0
        end = next(
            (n for n in range(start + 1, len(self._lines)) if self._lines[n].lstrip()[:1] == "["),
            len(self._lines),
        )
        for number in range(start, end):
            if re.match(rf"\s*[\"']?{re.escape(key)}[\"']?\s*[=.]", self._lines[number]):
                return number + 1
        return start + 1


def _happens(claim: Claim) -> bool:
    """Whether a claim is of something that works, not of a silence or a refusal."""
    return claim.holds and claim.relation is not Relation.IS_REFUSED


def _misfit(claim: Claim, parties: Mapping[str, Party]) -> str:
    """Why the roles of its parties do not fit a claim, or ""."""
    subject = parties[claim.subject].role
    needed: dict[Relation, tuple[Role, ...]] = {
        Relation.HEARS: _HEARING,
        Relation.IS_ANSWERED: _ASKING,
        Relation.SEES: (Role.OBSERVER,),
        Relation.READABLE: tuple(SPEAKING),
    }
    if subject not in needed.get(claim.relation, tuple(Role)):
        return f"a {subject} cannot do that"
    if not claim.talker:
        return ""
    other = parties[claim.talker].role
    answering = claim.relation is Relation.IS_ANSWERED
    fitting = _SERVING if answering else (Role.TALKER, Role.COMPOSED)
    return "" if other in fitting else f"{claim.talker} is a {other}"
