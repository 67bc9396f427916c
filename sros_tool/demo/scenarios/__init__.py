"""The scenarios that ship with sros, and the format of users' scenario files.

A scenario file is TOML: parties, rows, and the policy of their enclaves.

::

    title = "who sees the camera"
    policy = "robot.xml"                  # relative to this file

    [[party]]
    name = "camera"
    role = "talker"                       # a value of `sros_tool.demo.scenarios.model.Role`
    enclave = "/arm/camera"               # without enclave: unsecured
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
environment variables; `_VARIABLES` has the names that are allowed.  The log of a party has the
party's name.  A claim that something does not happen needs another claim or a control that
something does happen.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from sros_tool.demo.scenarios.attacks import ATTACKS
from sros_tool.demo.scenarios.communication import (
    ACTIONS,
    COMPOSITION,
    GOVERNANCE,
    ISOLATION,
    SERVICES,
)
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
    check_topic,
)
from sros_tool.demo.scenarios.on_zenoh import ZENOH_SCENARIOS
from sros_tool.errors import DocumentError, SrosError, UsageError
from sros_tool.files import read_toml
from sros_tool.policy.document import read_policy
from sros_tool.policy.model import Policy
from sros_tool.policy.rights import Rules, policy_rights
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
"""Relation → keys that name the parties of its claim: the subject first, then the other party."""

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

_ROLES_OF_KEY: Mapping[str, tuple[Role, ...]] = {
    "talker": (Role.TALKER, Role.COMPOSED),
    "listener": (Role.LISTENER, Role.COMPOSED),
    "observer": (Role.OBSERVER,),
    "client": (Role.CLIENT, Role.ACTION_CLIENT),
    "server": (Role.SERVER, Role.ACTION_SERVER, Role.COMPOSED),
    "party": tuple(Role),
}
"""Key of a claim → roles that the named party may have."""

_ROLES_WITH_NAMES = (Role.SERVER, Role.CLIENT, Role.ACTION_SERVER, Role.ACTION_CLIENT)
"""Roles of parties that have to name a service or an action."""

_ZENOH_ROLES = (Role.ROUTER, Role.RELAY, Role.FLOODER, Role.ERASER)
"""Roles that parties of users' scenarios cannot have: they run only on Zenoh."""

_VARIABLES = (DOMAIN, ENABLE, ENCLAVE, KEYSTORE, STRATEGY)
"""Environment variables that a party may set; others, such as LD_PRELOAD, could run code."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9 ._-]{0,63}")
"""Pattern of party names; they become file names in one folder."""

_KEYS = {
    "": {"title", "policy", "party", "row"},
    "party": {"name", "role", "enclave", "keystore", "topic", "variables"},
    "row": {"name", "claim", "control", "because"},
}


def read_scenario(path: Path) -> Scenario:
    """Read a scenario from a TOML file.

    Raises:
        DocumentError: the file is not a valid scenario; the message has the line.
    """
    content = read_bytes(path, "scenario")
    data = read_toml(content, f"the scenario '{path}'", "Correct the file.")
    return _read_scenario(_Table(path, content.decode().splitlines(), "", 0, data))


class _Table(NamedTuple):
    """A table of a scenario file.

    ``kind`` is "party", "row" and so on ("": top level); ``place`` is its index among the tables of
    this kind, to find the line for an error.  ``lines`` are all lines of the file, and ``data`` has
    the values of the table by key.
    """

    path: Path
    lines: Sequence[str]
    kind: str
    place: int
    data: Mapping[str, Any]

    def tables(self, kind: str) -> Iterator[_Table]:
        """Yield the tables of a kind; raise if there is none."""
        tables = self.data.get(kind)
        if (
            not isinstance(tables, list)
            or not tables
            or not all(isinstance(table, dict) for table in tables)
        ):
            problem, remedy = f"the scenario needs {kind} tables", f"Write [[{kind}]] tables."
            raise self.error(kind, problem, remedy)
        for place, data in enumerate(tables):
            table = self._replace(kind=kind, place=place, data=data)
            table.check_keys()
            yield table

    def check_keys(self) -> None:
        """Raise if the table has an unknown key."""
        for key in self.data:
            if key in ("claims", "controls"):
                problem = f"{key!r} is not a key here; write tables [[row.{key[:-1]}]]"
                raise self.error(key, problem, _EXAMPLE)
            if key not in _KEYS[self.kind]:
                known = ", ".join(sorted(_KEYS[self.kind]))
                raise self.error(key, f"{key!r} is not a key here; use one of {known}")

    def text(self, key: str, default: str | None = None) -> str:
        """Return the string value of a key."""
        value = self.data.get(key, default)
        if not isinstance(value, str) or (default is None and not value):
            lacks = f"the {self.kind or 'scenario'} has no {key}"
            present = f"{key} is {value!r}, not a string" if value else f"{key} is empty"
            raise self.error(key, present if key in self.data else lacks)
        return value

    def error(self, key: str, problem: str, remedy: str = "") -> DocumentError:
        """Return an error about a key of the table, with its line."""
        return DocumentError(
            f"the scenario '{self.path}', line {self._line(key)}: {problem}", "", remedy
        )

    def _line(self, key: str) -> int:
        """Return the line number of a key; for a missing key, the line of the table's header."""
        head = rf"\s*\[\[{self.kind}\]\]"
        heads = [number for number, text in enumerate(self.lines) if re.match(head, text)]
        start = heads[self.place] if self.kind and self.place < len(heads) else 0
        ends = (
            number
            for number in range(start + 1, len(self.lines))
            if re.match(r"\s*\[\[\s*\w+\s*\]\]", self.lines[number])
        )
        name = re.escape(key)
        line = rf"\s*([\"']?{name}[\"']?\s*[=.]|\[\[row\.{name}\]\])"
        for number in range(start, next(ends, len(self.lines))):
            if re.match(line, self.lines[number]):
                return number + 1
        return start + 1


def _read_scenario(table: _Table) -> Scenario:
    table.check_keys()
    try:
        policy = read_policy(table.path.parent / table.text("policy"))
    except (SrosError, ValueError) as error:  # ValueError: NUL in the file name
        raise table.error("policy", str(error)) from error
    parties: dict[str, Party] = {}
    for party_table in table.tables("party"):
        party = _read_party(party_table, policy)
        file = party.name.replace(" ", "_")
        if twin := next((name for name in parties if name.replace(" ", "_") == file), ""):
            spelt = "" if twin == party.name else f": {twin!r} counts as the same name"
            raise party_table.error("name", f"there are two parties {party.name!r}{spelt}")
        parties[party.name] = party
    rules = Rules(policy_rights(policy))
    rows = tuple(_read_row(row_table, parties, rules) for row_table in table.tables("row"))
    title = table.text("title", table.path.stem)
    return Scenario(table.path.stem, title, rows, policy=lambda _topic: policy)


def _read_party(table: _Table, policy: Policy) -> Party:
    name = table.text("name")
    if not _NAME.fullmatch(name):
        problem = f"{name!r} cannot be the name of a party"
        remedy = (
            "Start with a letter or digit, and use at most 64 letters, digits, blanks, '.', '_'"
            " and '-'."
        )
        raise table.error("name", problem, remedy)
    roles = {role.value: role for role in Role if role not in _ZENOH_ROLES}
    word = table.text("role")
    if word not in roles:
        raise table.error("role", f"{word!r} is not a role; use one of {', '.join(roles)}")
    role = roles[word]
    topic = table.text("topic", "")
    if not topic and role in _ROLES_WITH_NAMES:
        problem = f"the {word} {name!r} needs topic=, with the name of its service or action"
        raise table.error("name", problem)
    try:
        topic = check_topic(topic) if topic else ""
    except SrosError as error:
        raise table.error("topic", str(error)) from error
    return Party(name, role, _read_identity(table, policy), topic)


def _read_identity(table: _Table, policy: Policy) -> Identity:
    enclave = table.text("enclave", "")
    word = table.text("keystore", OWN)
    keystores = {keystore.value: keystore for keystore in SoundKeystore}
    if word not in keystores:
        problem = f"{word!r} is not a keystore; use one of {', '.join(keystores)}"
        raise table.error("keystore", problem)
    if not enclave:
        for key in ("keystore", "variables"):
            if key in table.data:
                problem = f"the key {key} needs an enclave, but this party is unsecured"
                raise table.error(key, problem, "Give the party an enclave.")
        return UNSECURED
    if policy.enclave(enclave) is None:
        paths = [known.path for known in policy.enclaves]
        close = difflib.get_close_matches(enclave, paths, n=1)
        hint = f"; did you mean {close[0]}?" if close else f"; its enclaves are {', '.join(paths)}"
        raise table.error("enclave", f"the policy has no enclave {enclave!r}{hint}")
    variables = table.data.get("variables", {})
    if not isinstance(variables, dict) or not all(
        isinstance(value, str) for value in variables.values()
    ):
        raise table.error("variables", "variables is not a table of strings")
    for variable in variables:
        if variable not in _VARIABLES:
            problem = f"a party cannot set {variable!r}, only {', '.join(_VARIABLES)}"
            raise table.error("variables", problem)
    return Identity(keystores[word], enclave, tuple(variables.items()))


def _read_row(table: _Table, parties: Mapping[str, Party], rules: Rules) -> Row:
    name = table.text("name")
    claims = _read_claims(table, "claim", parties)
    controls = _read_claims(table, "control", parties)
    if not claims:
        raise table.error("name", f"the row {name!r} has no claim", _EXAMPLE)
    _check_controls(table, claims, controls, parties, rules)
    used = {word for claim in (*claims, *controls) for word in (claim.subject, claim.talker)}
    return Row(
        name,
        claims[0].expected if len(claims) == 1 else RowStatus.UNDISTURBED,
        table.text("because", ""),
        tuple(party for party in parties.values() if party.name in used),
        claims,
        controls,
        wire=any(claim.relation is Relation.READABLE for claim in (*claims, *controls)),
    )


def _read_claims(table: _Table, key: str, parties: Mapping[str, Party]) -> tuple[Claim, ...]:
    claims = table.data.get(key, [])
    claims = [claims] if isinstance(claims, dict) else claims
    if not isinstance(claims, list):
        raise table.error(key, f"{key} is not a table", _EXAMPLE)
    return tuple(_read_claim(table, key, claim, parties) for claim in claims)


def _read_claim(table: _Table, key: str, claim: Any, parties: Mapping[str, Party]) -> Claim:
    if not isinstance(claim, dict):
        raise table.error(key, f"{claim!r} is not a table", _EXAMPLE)
    expected = claim.get("expected")
    if not isinstance(expected, str) or expected not in _CLAIMS:
        problem = f"{expected!r} is not a status that can be expected"
        if expected is None:
            problem = f"a {key} has no expected status"
        raise table.error(key, f"{problem}; use one of {', '.join(_CLAIMS)}")
    relation, holds = _CLAIMS[expected]
    sides = _PARTIES[relation]
    if set(claim) != {*sides, "expected"}:
        problem = f"a {key} {expected!r} needs {', '.join(sides)} and expected, and no other keys"
        fitting = [
            repr(other)
            for other, (relation_of_other, does_happen) in _CLAIMS.items()
            if set(claim) == {*_PARTIES[relation_of_other], "expected"} and does_happen is holds
        ]
        remedy = f"With these keys, write {' or '.join(fitting)}." if fitting else ""
        raise table.error(key, f"{problem}; it has {', '.join(claim)}", remedy)
    names = [claim[side] for side in sides]
    for side, name in zip(sides, names, strict=True):
        if not isinstance(name, str) or name not in parties:
            problem = f"there is no party {name!r}; use one of {', '.join(parties)}"
            raise table.error(key, problem)
        role = parties[name].role
        if role not in (SPEAKING if relation is Relation.READABLE else _ROLES_OF_KEY[side]):
            problem = (
                f"{name} has the role {role}, so it cannot be the {side} of a claim {expected!r}"
            )
            raise table.error(key, problem)
    if relation is Relation.IS_ANSWERED:
        client, server = (parties[name].role for name in names)
        if (client is Role.ACTION_CLIENT) is not (server is Role.ACTION_SERVER):
            problem = f"{names[0]} has the role {client}, and {names[1]} the role {server}"
            remedy = (
                "For an action, use the roles action_client and action_server; for a service, "
                "client and server."
            )
            raise table.error(key, problem, remedy)
    return Claim(relation, names[0], names[1] if len(names) > 1 else "", holds)


def _check_controls(
    table: _Table,
    claims: Sequence[Claim],
    controls: Sequence[Claim],
    parties: Mapping[str, Party],
    rules: Rules,
) -> None:
    """Raise `DocumentError` if a row expects silence and has no claim that something works."""
    happening = [claim for claim in (*claims, *controls) if _expects_success(claim)]
    for claim in claims:
        heard = claim.relation is Relation.HEARS
        if _expects_success(claim) or any(not heard or e.talker == claim.talker for e in happening):
            continue
        who = f"a listener hears {claim.talker}" if claim.talker else "something works"
        remedy = "Add a control, such as a permitted listener that hears the same talker."
        if claim.relation is Relation.IS_ANSWERED:
            who = f"{claim.talker} answers a client"
            remedy = "Add a control, such as a permitted client whom the same server answers."
        problem = f"no claim or control shows that {who} at the same time"
        talker = parties[claim.talker or claim.subject]
        if claim.talker and not talker.identity.enclave:
            remedy = remedy.replace("a permitted", "an unsecured")
        elif claim.talker and not _may_send(talker, rules):
            problem = f"{talker.identity.enclave} may not send, so nobody hears it"
            remedy = (
                f'Claim the refusal: {{ party = "{talker.name}", expected = "refused" }}. '
                "Add a control, which shows that something works."
            )
        raise table.error("claim", f"{problem}: a crash would look the same", remedy)


def _may_send(party: Party, rules: Rules) -> bool:
    """Return whether a party's enclave may publish, serve or execute the party's name.

    True for a party without a topic, which cannot be checked.
    """
    right = {Role.TALKER: "publish", Role.SERVER: "reply", Role.ACTION_SERVER: "execute"}
    if party.role not in right or not party.topic:
        return True
    return rules.allow(party.identity.enclave, right[party.role], party.topic)


def _expects_success(claim: Claim) -> bool:
    """Return whether a claim expects that something works, not silence or a refusal."""
    return claim.holds and claim.relation is not Relation.IS_REFUSED


SCENARIOS: tuple[Scenario, ...] = (
    ISOLATION,
    SERVICES,
    ACTIONS,
    COMPOSITION,
    ATTACKS,
    GOVERNANCE,
)
_DEFAULT_SCENARIO = ISOLATION.name
ALL = "all"


def choose_scenarios(names: Sequence[str], *, on_zenoh: bool = False) -> tuple[Scenario, ...]:
    """Return the scenarios with the given names, or in the given TOML files, in order.

    Without names: the default scenario on DDS, or all scenarios ``on_zenoh``.

    Raises:
        UsageError: no scenario has a given name.
        DocumentError: a file is not a valid scenario.
    """
    known = {scenario.name: scenario for scenario in (ZENOH_SCENARIOS if on_zenoh else SCENARIOS)}
    chosen: dict[str, Scenario] = {}
    for name in names or (ALL if on_zenoh else _DEFAULT_SCENARIO,):
        if name == ALL:
            chosen |= known
        elif name.endswith(".toml") and on_zenoh:
            raise UsageError(
                f"the scenario {name} cannot run on Zenoh",
                "Scenario files run only on a DDS; on Zenoh, the demo has scenarios of its own.",
                f"Leave out --backend zenoh, or name {', '.join(known)}. To see what your policy "
                "allows on Zenoh, run `sros explain KEYSTORE ENCLAVE publish NAME --vendor zenoh`.",
            )
        elif name.endswith(".toml"):
            chosen[name] = read_scenario(Path(name))
        elif name in known:
            chosen[name] = known[name]
        else:
            raise UsageError(
                f"there is no scenario {name!r}",
                f"sros has {', '.join(known)}{' on Zenoh' if on_zenoh else ''}.",
                "Name one of them or `all`."
                if on_zenoh
                else "Name one of them, `all`, or a TOML file.",
            )
    return tuple(chosen.values())
