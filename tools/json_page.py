"""Print docs/json.md, the page on what ``--json`` prints, from sros_tool/schemas."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping
from typing import Any

from tools.steps import CHECKOUT

SCHEMAS = CHECKOUT / "sros_tool" / "schemas"
SHARED = "common"
"""The schema of the parts that several verbs share."""

_BEGINNING = """\
# What `--json` prints

Every verb but `run`, `completion`, `fleet inventory` and `fleet report` takes `--json`, and \
prints one JSON object on standard output. Its first key is `version`, which is 1: the \
number is raised when a key is removed or changes its meaning. It is not raised when a key is \
added, so ignore keys that you do not know.

- The exit status is the same as without `--json`; look at it first. After an error, standard \
output is empty, and standard error has one paragraph. The exception is `env`: \
after an error, it prints variables that keep every node from starting.
- Notes and messages for people still go to standard error; `notes` has the notes, too.
- With `--dry-run`, `dry_run` is true, and the object says what would be done.
- Moments are in UTC, as `2027-05-21T12:50:48Z`; serial numbers and SHA-256 are lower-case \
hexadecimal. Serial numbers have no leading zeros here and in the ledger; texts for people show an \
even number of digits, as OpenSSL does.

Each verb has a JSON Schema (draft 2020-12) in `sros_tool/schemas/`. A schema allows only the keys \
that it names, and belongs to the sros with which it ships. `python -m tools.json_page` makes this \
page from the schemas. A key followed by `?` is left out if it has no value. `[]` stands for each \
element of a list. In an "object of moment", each value is a moment, and the keys are names, such \
as enclaves; `*` stands for these keys.

<!-- not run: jq is not part of sros; tests/cli/test_json.py compares outputs and schemas -->
```sh
sros create_enclave keystore /talker --json | jq -r '.enclaves[] | .folder + " " + .valid_until'
sros check keystore --json | jq -r '.findings[] | select(.severity == "error") | .text'
```
"""


def page() -> str:
    """Return the text of docs/json.md."""
    schemas = {path.stem: json.loads(path.read_text("utf-8")) for path in SCHEMAS.glob("*.json")}
    shared = schemas.pop(SHARED)
    parts = [_BEGINNING]
    parts += [_verb(name, schemas[name]) for name in sorted(schemas)]
    parts.append(f"## Shared parts\n\n{shared['description']}\n")
    for name, part in sorted(shared["$defs"].items()):
        if "properties" in part:
            parts.append(f"### {name}\n\n{part['description']}\n\n{_table(part)}")
    return "\n".join(parts)


def _verb(name: str, schema: Mapping[str, Any]) -> str:
    text = f"## {schema['title']}\n\n{schema['description']}\n"
    if "properties" in schema:
        text += f"\n{_table(schema)}"
    named = schema.get("$defs", {})
    shapes = [each["$ref"].rpartition("/")[2] for each in schema.get("oneOf", ())]
    for shape in shapes:
        text += f"\n**{_code(named[shape]['title'])}**: {named[shape]['description']}\n"
        text += f"\n{_table(named[shape])}"
    for part in named:
        if part not in shapes:
            text += f"\n**{part}**: {named[part]['description']}\n\n{_table(named[part])}"
    return text


def _code(title: str) -> str:
    return f"`{title}`" if title.startswith("--") else title


def _table(schema: Mapping[str, Any]) -> str:
    rows = "".join(f"| `{key}` | {kind} | {text} |\n" for key, kind, text in _rows(schema, ""))
    return f"| key | value | meaning |\n| --- | --- | --- |\n{rows}"


def _rows(schema: Mapping[str, Any], place: str) -> Iterator[tuple[str, str, str]]:
    """Yield key, kind and meaning of each property, and of the properties in it."""
    for name, value in schema.get("properties", {}).items():
        if name == "version":  # said once, at the beginning
            continue
        key = f"{place}{name}" + ("" if name in schema["required"] else "?")
        inner, suffix = _inner(value)
        yield key, _kind(value), value.get("description") or _shared(value)
        for each in inner:
            yield from _rows(each, f"{key}{suffix}.")


def _inner(value: Mapping[str, Any]) -> tuple[list[Mapping[str, Any]], str]:
    """Return the objects in a value, and what stands for their place in a key."""
    if "items" in value:
        inner, suffix = _inner(value["items"])
        return inner, f"[]{suffix}"
    if isinstance(value.get("additionalProperties"), dict):
        inner, suffix = _inner(value["additionalProperties"])
        return inner, f".*{suffix}"
    return [each for each in value.get("anyOf", [value]) if "properties" in each], ""


def _shared(value: Mapping[str, Any]) -> str:
    schema = json.loads((SCHEMAS / f"{SHARED}.json").read_text("utf-8"))
    found: str = schema["$defs"][value["$ref"].rpartition("/")[2]]["description"]
    return found


_NAMES = {"array": "list", "null": "null", "date-time": "moment"}


def _kind(value: Mapping[str, Any]) -> str:
    """Return the kind of a value in words, with a link if it is a shared object."""
    if "$ref" in value:
        file, _, name = value["$ref"].partition("#/$defs/")
        if name == "dry_run":
            return "boolean"
        return f"[{name}](#{name})" if file else name
    if "anyOf" in value:
        return " or ".join(dict.fromkeys(_kind(each) for each in value["anyOf"]))
    if "const" in value:
        return f"`{json.dumps(value['const'])}`"
    if "enum" in value:
        return ", ".join("null" if each is None else f"`{each}`" for each in value["enum"])
    types: list[str] = value["type"] if isinstance(value["type"], list) else [value["type"]]
    if "format" in value:
        types = [value["format"] if each == "string" else each for each in types]
    words = [_NAMES.get(each, each) for each in types]
    if "items" in value:
        words[0] = f"list of {_kind(value['items'])}"
    if isinstance(value.get("additionalProperties"), dict):
        words[0] = f"object of {_kind(value['additionalProperties'])}"
    return " or ".join(words)


if __name__ == "__main__":
    sys.stdout.write(page())
