"""What ``--json`` prints fits the schema of the verb, which docs/json.md shows."""

from __future__ import annotations

import json
import os
import shutil
import signal
from collections.abc import Iterator, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft202012Validator
from referencing import Registry, Resource

from sros_tool.demo import doctor
from sros_tool.demo import program as demo
from sros_tool.demo.casting import CastMember
from sros_tool.demo.doctor import Diagnosis, SecurityProvider
from sros_tool.demo.result import KeystoreSummary, used_libraries
from sros_tool.runtime.processes import Process, ProcessTable, RunningProcesses
from tests.checks.test_doctor_findings import CYCLONE, RMW
from tests.cli.json_cases import (
    BINARY,
    CASES,
    ERRORS,
    SHARED_PARTS,
    WITHOUT_JSON,
    Case,
    make_folder,
)
from tests.cli.test_audit import FINE, LOUD, POLICY, SHORT
from tests.demo.test_demo_result import CLOSED, OLD, OPEN, TWIN, result
from tests.graph.fake_graph import Beside, graph
from tests.support.harness import Ended, copy_of, snapshot, sros
from tests.support.long_form import drawn, some
from tests.support.verbs import COMMANDS
from tools.json_page import SCHEMAS, SHARED, page

pytest_plugins = ["tests.graph.beside"]

VERBS = [*COMMANDS]
Schema = Mapping[str, Any]
DOCUMENTS: dict[str, Schema] = {
    path.name: json.loads(path.read_text()) for path in sorted(SCHEMAS.glob("*.json"))
}
REGISTRY: Registry[Any] = Registry().with_resources(
    (name, Resource.from_contents(schema)) for name, schema in DOCUMENTS.items()
)

FORMATS = {"confirmation"}
"""The schemas of documents that robots make, too: they are no output of ``--json``."""

# ── the schemas ────────────────────────────────────────────────────────────────────────────


def test_every_verb_prints_json_or_says_why_not() -> None:
    with_option = set()
    for verb, command in COMMANDS.items():
        if any("--json" in parameter.opts for parameter in command.params):
            with_option.add(verb)
    assert set(VERBS) - with_option == set(WITHOUT_JSON)
    names = {verb.replace(" ", "_") for verb in with_option}
    assert {Path(name).stem for name in DOCUMENTS} == {*names, *FORMATS, SHARED}


def objects(schema: Any) -> Iterator[Schema]:
    """Yield every schema of an object in a schema."""
    if isinstance(schema, dict):
        if "properties" in schema and isinstance(schema.get("type"), str | list):
            yield schema
        for value in schema.values():
            yield from objects(value)
    elif isinstance(schema, list):
        for value in schema:
            yield from objects(value)


@pytest.mark.parametrize("name", some([*DOCUMENTS], 12))
def test_a_schema_is_closed_and_describes_every_property(name: str) -> None:
    Draft202012Validator.check_schema(DOCUMENTS[name])
    for schema in objects(DOCUMENTS[name]):
        assert schema["additionalProperties"] is False, schema
        for key, value in schema["properties"].items():
            text = "" if "$ref" in value else value["description"]
            assert "$ref" in value or text.endswith("."), key
        assert set(schema["required"]) <= set(schema["properties"])


@pytest.mark.parametrize(
    "name", sorted({Path(name).stem for name in DOCUMENTS} - {*FORMATS, SHARED})
)
def test_every_shape_begins_with_the_version(name: str) -> None:
    schema = DOCUMENTS[f"{name}.json"]
    shapes = [schema["$defs"][each["$ref"].rpartition("/")[2]] for each in schema.get("oneOf", ())]
    for shape in shapes or [schema]:
        assert next(iter(shape["properties"])) == shape["required"][0] == "version"


def test_the_page_is_made_from_the_schemas() -> None:
    path = SCHEMAS.parents[1] / "docs" / "json.md"
    assert path.read_text() == page(), "run `python -m tools.json_page > docs/json.md`"


# ── what is printed ────────────────────────────────────────────────────────────────────────


class Seen:
    """Checks what verbs print against their schemas, and remembers the properties it has."""

    def __init__(self) -> None:
        self._seen: set[str] = set()

    def check(self, verb: str, ended: Ended) -> None:
        """Fail unless the output is one object that fits the schema of the verb."""
        value = json.loads(ended.out)
        assert next(iter(value.items())) == ("version", 1)
        name = verb.replace(" ", "_")
        problems = [
            f"{each.json_path}: {each.message}"
            for problem in _validator(f"{name}.json").iter_errors(value)
            for each in (problem, *(problem.context or ()))
        ]
        assert problems == [], ended.out
        self._walk(DOCUMENTS[f"{name}.json"], value, f"{name}.json", "")

    def unseen(self, name: str) -> list[str]:
        """Return the properties of a schema that no output had."""
        name = name.replace(" ", "_")
        return sorted(set(_properties(DOCUMENTS[f"{name}.json"], f"{name}.json#")) - self._seen)

    def _walk(self, schema: Schema, value: Any, file: str, place: str) -> None:
        if "$ref" in schema:
            name, _, pointer = schema["$ref"].partition("#")
            file, place = name or file, pointer
            schema = DOCUMENTS[file]
            for part in pointer.strip("/").split("/"):
                schema = schema[part]
        for word in ("oneOf", "anyOf"):
            for index, each in enumerate(schema.get(word, ())):
                under = f"{place}/{word}/{index}"
                if _validator(f"{file}#{under}").is_valid(value):
                    self._walk(each, value, file, under)
        if isinstance(value, dict):
            for key, each in value.items():
                if key in schema.get("properties", {}):
                    under = f"{place}/properties/{key}"
                    self._seen |= {f"{file}#{under}", f"{file}#{under}={each}"}
                    self._walk(schema["properties"][key], each, file, under)
                elif isinstance(schema.get("additionalProperties"), dict):
                    under = f"{place}/additionalProperties"
                    self._walk(schema["additionalProperties"], each, file, under)
        elif isinstance(value, list) and "items" in schema:
            for each in value:
                self._walk(schema["items"], each, file, f"{place}/items")


@cache
def _validator(reference: str) -> Draft202012Validator:
    return Draft202012Validator({"$ref": reference}, registry=REGISTRY)


def _properties(schema: Any, place: str) -> Iterator[str]:
    """Yield the places of all properties in a schema, and of all values of outcomes."""
    if isinstance(schema, dict):
        if "properties" in schema and "required" in schema:
            yield from (f"{place}/properties/{key}" for key in schema["properties"])
            outcomes = schema["properties"].get("outcome", {}).get("enum", ())
            if "denied" not in outcomes:  # the outcomes of vendors have tests of their own
                yield from (f"{place}/properties/outcome={each}" for each in outcomes)
        for key, value in schema.items():
            yield from _properties(value, f"{place}/{key}")
    elif isinstance(schema, list):
        for index, value in enumerate(schema):
            yield from _properties(value, f"{place}/{index}")


@pytest.fixture(scope="session")
def made_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that the cases run in; only to be copied."""
    folder = tmp_path_factory.mktemp("json")
    make_folder(folder)
    return folder


def copied(case: Case, made: Path, folder: Path) -> Path:
    """Copy all files of a made folder, and of its folders those that a case names."""
    words = f"{case.words} {case.before}"
    others = [each.name for each in made.iterdir() if each.is_dir() and each.name not in words]

    def left_out(where: str, names: list[str]) -> list[str]:
        return others if where == str(made) else []

    return Path(shutil.copytree(made, folder, symlinks=True, ignore=left_out))


def both_ways(verb: str, case: Case, made: Path, place: Path) -> Ended:
    """Run a case with --json, in a new copy of the folder; return what it prints.

    Of every fourth case, and in the long form of each, the exit status without --json is the same.
    """
    options: list[list[str]] = [["--json"]]
    if drawn(f"{verb} {case.words}", 1 / 4):
        options = [[], *options]
    for number, option in enumerate(options):
        folder = copied(case, made, place / str(number))
        for before in case.before:
            sros(*before.split(), cwd=folder).ok()
        shown = sros(*verb.split(), *case.words.split(), *option, cwd=folder)
        shutil.rmtree(folder)
        assert shown.status == case.status, (option, shown)
    return shown


WITH_A_GRAPH = {
    "generate_policy": (
        ("robot.xml", graph(LOUD), 0),
        ("new.xml", graph(LOUD), 0),
        ("new.xml --dry-run", graph(LOUD), 0),
        ("new.xml", graph(), 1),
    ),
    "audit": (
        ("robot.xml", graph(FINE), 0),
        ("robot.xml --patch add.xml", graph(LOUD), 1),
        ("robot.xml --patch add.xml --dry-run", graph(LOUD), 1),
        ("ks", graph(("/b", "/", "n", "01", ["publish rt/y"])), 1),
    ),
}


ON_A_ROBOT = {verb for verb in CASES if verb.startswith("agent ") or verb == "close"}
"""They need a publishing folder (tests/agent/test_agent_verbs.py), or processes (test_close.py)."""


@pytest.mark.parametrize(
    "verb", sorted({*CASES} - {"check", "demo", "doctor", *WITH_A_GRAPH, *ON_A_ROBOT})
)
def test_what_a_verb_prints(verb: str, made_folder: Path, tmp_path: Path) -> None:
    seen = Seen()
    whole = drawn(verb, 1 / 4)
    for case in CASES[verb] if whole else CASES[verb][:1]:
        seen.check(verb, both_ways(verb, case, made_folder, tmp_path))
    # Only a restored keystore has later changes: tests/agent/test_publish.py restores one.
    later = "fleet_publish.json#/properties/later/items/"
    assert not whole or [at for at in seen.unseen(verb) if not at.startswith(later)] == []


@pytest.mark.parametrize("verb", WITH_A_GRAPH)
def test_what_a_verb_prints_beside_a_graph(
    verb: str, made_folder: Path, tmp_path: Path, beside_graph: Beside
) -> None:
    seen = Seen()
    for case in CASES[verb]:
        seen.check(verb, both_ways(verb, case, made_folder, tmp_path))
    copy_of(made_folder / "broken", tmp_path / "ks")
    for words, there, status in WITH_A_GRAPH[verb]:
        (tmp_path / "robot.xml").write_text(POLICY)
        for file in ("new.xml", "add.xml"):
            (tmp_path / file).unlink(missing_ok=True)
        ended = beside_graph(verb, there, *words.split(), *SHORT, "--json")
        assert ended.status == status, ended
        seen.check(verb, ended)
    # Only a graph that changes has them: tests/graph/test_generate_policy_observing.py.
    changing = "generate_policy.json#/properties/intermittent/items/"
    assert [at for at in seen.unseen(verb) if not at.startswith(changing)] == []


def test_what_check_prints(
    made_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = Seen()
    for case in CASES["check"]:
        seen.check("check", both_ways("check", case, made_folder, tmp_path))
    elsewhere = Process(7, ("talker",), {}, datetime.now(UTC), network="net:[1]")
    monkeypatch.setattr(ProcessTable, "look", lambda *_: RunningProcesses((elsewhere,)))
    monkeypatch.setattr(signal, "sigtimedwait", lambda *_: True)
    watched = sros("check", "runtime", "--watch", "--json", env={"ROS_SECURITY_ENABLE": None}).ok()
    for line in watched.out.splitlines():
        seen.check("check", replace(watched, out=line))
    assert watched.out.count("\n") == 2
    assert seen.unseen("check") == []


def test_what_doctor_prints(made_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ProcessTable, "look", lambda *_: RunningProcesses())
    seen = Seen()
    for stacks, status in (((RMW, CYCLONE), 1), ((RMW,), 1), ((CYCLONE,), 0)):
        monkeypatch.setattr(doctor, "examine", lambda *_, found=stacks: Diagnosis(found))
        provider = SecurityProvider("sros_tool", ("sros2",)) if status else None
        monkeypatch.setattr(doctor, "security_provider", lambda *_, found=provider: found)
        wrong = {"ROS_SECURITY_ENABLE": "yes"} if status else {}
        ended = sros("doctor", "--json", env=wrong, cwd=made_folder)
        assert ended.status == status, ended
        seen.check("doctor", ended)
    assert seen.unseen("doctor") == []


def test_what_demo_prints(
    made_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = Seen()
    for case in CASES["demo"]:
        seen.check("demo", both_ways("demo", case, made_folder, tmp_path))
    shown = result(CLOSED, TWIN, OPEN)
    cast = (CastMember("listener", "/a", ("/n",)),)
    keystore = KeystoreSummary(3, not_tried=("/b with another governance",))
    scenario = replace(shown.scenarios[0], cast=cast, attacked=keystore)
    unproved = replace(shown, scenarios=(scenario,))
    run = replace(OPEN, unaccepted=True, libraries=frozenset({OLD}))
    opened = replace(result(run), libraries=used_libraries([run]))
    for each, status in ((shown, 0), (opened, 1), (unproved, 2)):
        monkeypatch.setattr(demo, "run_demo", lambda *_, found=each: found)
        ended = sros("demo", "--json", cwd=tmp_path)
        assert ended.status == status, ended
        seen.check("demo", ended)
    assert seen.unseen("demo") == []


def test_every_shared_part_is_seen(made_folder: Path, tmp_path: Path) -> None:
    seen = Seen()
    for verb, case in SHARED_PARTS.items():
        seen.check(verb, both_ways(verb, case, made_folder, tmp_path))
    assert seen.unseen(SHARED) == []


DRY_RUNS = [
    (verb, case)
    for verb, cases in CASES.items()
    for case in cases
    if "--dry-run" in case.words.split() and " - " not in f"{case.words} " and verb != "view"
]


@pytest.mark.parametrize(
    ("verb", "case"), [pytest.param(*each, id=each[0]) for each in some(DRY_RUNS, 15)]
)
def test_a_dry_run_says_what_would_be_done(
    verb: str, case: Case, made_folder: Path, tmp_path: Path
) -> None:
    folder = copied(case, made_folder, tmp_path / "made")
    before = snapshot(folder)
    words = [each for each in case.words.split() if each != "--dry-run"]
    would = json.loads(sros(*verb.split(), *words, "--dry-run", "--json", cwd=folder).out)
    assert snapshot(folder) == before
    done = json.loads(sros(*verb.split(), *words, "--json", cwd=folder).out or "{}")
    if not done:  # what needs a choice is shown by a dry run, and refused
        return
    assert (would["dry_run"], done["dry_run"]) == (True, False)
    if done.get("accepted") is False:
        assert (done["changes"], snapshot(folder)) == ([], before)
        return
    assert would["changes"] == done["changes"]
    named = [[_named(each) for each in shown.get("enclaves", ())] for shown in (would, done)]
    assert named[0] == named[1]
    for change in done["changes"]:
        assert os.path.lexists(folder / change["path"]) != (change["action"] == "remove"), change


def _named(enclave: Any) -> Any:
    """Return what a dry run knows of an enclave."""
    keys = ("name", "outcome", "folder", "enclave")
    return [enclave.get(key) for key in keys] if isinstance(enclave, dict) else enclave


def test_a_property_that_no_schema_has_is_found(made_folder: Path) -> None:
    ended = sros("list_enclaves", "ks", "--json", cwd=made_folder)
    seen = Seen()
    seen.check("list_enclaves", ended)
    more = json.dumps({**json.loads(ended.out), "more": 1})
    with pytest.raises(AssertionError, match="more"):
        seen.check("list_enclaves", replace(ended, out=more))


def test_what_a_template_leaves_open_is_in_the_notes(made_folder: Path, tmp_path: Path) -> None:
    open_ = ["keystore.open-permissions", "keystore.single-ca"]
    for template, layout, wanted in (
        ("development", "single", open_),
        ("development", "separate", open_[:1]),
        ("production", "separate", []),
    ):
        words = ("--template", template, "--ca-layout", layout, "--json", "--dry-run")
        shown = json.loads(sros("create_keystore", tmp_path / "ks", *words).ok().out)
        ids = [each["id"] for each in shown["notes"]]
        assert [each for each in ids if each in open_] == wanted


@pytest.mark.parametrize(
    "words",
    [
        "env ks /a --format fish",
        "view ks --format svg",
        "check ks --format text",
        "check ks --sarif",
    ],
)
def test_json_and_another_format_exclude_each_other(words: str, made_folder: Path) -> None:
    ended = sros(*words.split(), "--json", cwd=made_folder)
    assert ended.status == 2
    assert "exclude each other" in ended.err
    verb, *target = words.split()[: 2 + words.startswith("env")]
    assert sros(verb, *target, "--json", "--format", "json", cwd=made_folder).status < 2


def test_a_path_that_no_json_holds_is_not_in_an_environment(
    made_folder: Path, tmp_path: Path
) -> None:
    root = tmp_path / os.fsdecode(b"k\xff")
    copy_of(made_folder / "ks", root)
    ended = sros("env", root, "/a", "--json")
    assert ended.status == 2
    assert json.loads(ended.out)["enclave"] is None


# ── errors, and standard output that is an archive ─────────────────────────────────────────


@pytest.mark.parametrize("verb", some(sorted({*VERBS} - {*WITHOUT_JSON, "env"}), 15))
def test_an_error_prints_no_json(verb: str, made_folder: Path, tmp_path: Path) -> None:
    folder = copy_of(made_folder, tmp_path / "made")
    text = sros(*verb.split(), *ERRORS[verb].split(), cwd=folder)
    shown = sros(*verb.split(), *ERRORS[verb].split(), "--json", cwd=folder)
    assert (shown.status, shown.out) == (text.status, "")
    assert shown.status in (1, 2)
    assert len(shown.err.splitlines()) == 1


@pytest.mark.parametrize("command", BINARY)
def test_an_archive_and_json_do_not_share_standard_output(command: str, made_folder: Path) -> None:
    ended = sros(*command.split(), "--json", cwd=made_folder)
    assert (ended.status, ended.out) == (2, "")
    assert "--json and an archive" in ended.err
    (shown,) = json.loads(sros(*command.split(), "--json", "--dry-run", cwd=made_folder).ok().out)[
        "enclaves"
    ]
    assert shown["name"] in ("/a", "/s")
