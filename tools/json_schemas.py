"""Write sros_tool/schemas: the JSON Schemas of what ``--json`` prints, from the types of values.

A class becomes an object, its fields and the properties that it shows become keys, and their
docstrings the descriptions: there is no key without one.
"""

from __future__ import annotations

import ast
import inspect
import json
import sys
import textwrap
import types
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from datetime import datetime
from enum import Enum
from functools import cache, cached_property
from importlib import import_module
from itertools import pairwise
from pathlib import PurePath
from typing import (
    Annotated,
    Any,
    Literal,
    NamedTuple,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

from sros_tool.values import Words, key_of, shown
from tools.json_page import SCHEMAS, SHARED

Schema = dict[str, Any]


class Shapes(NamedTuple):
    """The shapes that the JSON object of a verb has; ``classes`` maps options and such to them."""

    description: str
    classes: Mapping[str, str]


_LIFECYCLE = "sros_tool.keystore.lifecycle.shown"
_DESCRIBE = "sros_tool.keystore.describe"

SHARED_PARTS: dict[str, str] = {
    "change": "sros_tool.values:FileChange",
    "note": "sros_tool.errors:Note",
    "right": "sros_tool.policy.rights:Right",
    "finding": "sros_tool.checks.kind:Finding",
    "authority": "sros_tool.keystore.outcomes:AuthorityFacts",
    "replaced_rights": "sros_tool.keystore.lifecycle.replaced:ReplacedRights",
}
"""The classes of parts that several verbs share, as MODULE:CLASS, by their names."""

VERBS: Mapping[str, str | Shapes] = {
    "check": Shapes(
        "Findings on policies, keystores and the runtime. `--sarif` prints SARIF 2.1.0 instead.",
        {
            "findings": "sros_tool.checks.kind:ShownFindings",
            "--list": "sros_tool.checks.kind:AllKinds",
            "--needs-renewal": "sros_tool.keystore.expiry:ExpiringEnclaves",
            "--watch": "sros_tool.checks.runtime:FindingChange",
        },
    ),
    "demo": Shapes(
        "What was shown on a real DDS, or on Zenoh.",
        {
            "the result": "sros_tool.demo.result:DemoResult",
            "--list": "sros_tool.demo.result:ScenarioList",
        },
    ),
    "doctor": "sros_tool.cli.check:MachineReport",
    "review": "sros_tool.proof.review:ReviewResult",
    "verify": "sros_tool.checks.keystores.arrival:VerifiedFolder",
    "audit": "sros_tool.explain.audit:AuditResult",
    "close": "sros_tool.close.state:CloseState",
    "fleet status": "sros_tool.cli.fleet:ComparedFleet",
    "explain": Shapes(
        "What DDS or Zenoh decides, by which rule, and why.",
        {
            "a question": "sros_tool.explain.vendors:VendorExplanation",
            "--all-vendors, --all-distros": "sros_tool.explain.vendors:Comparison",
            "--vendor zenoh": "sros_tool.explain.zenoh:ZenohExplanation",
            "--who": "sros_tool.explain.vendors:WhoByVendor",
            "--who --vendor zenoh": "sros_tool.explain.zenoh:WhoOnZenoh",
            "--reach": "sros_tool.explain.who:FollowedReach",
            "--log": "sros_tool.explain.log:ExplainedLog",
        },
    ),
    "view": Shapes(
        "Who may do what; `-o FILE` writes the picture to FILE instead.",
        {
            "the picture": "sros_tool.report.picture:Picture",
            "--dry-run": "sros_tool.values:PlannedFiles",
        },
    ),
    "policies": Shapes(
        "The policies that ship with sros.",
        {
            "the list": "sros_tool.policy.document:ShippedPolicies",
            "--copy": "sros_tool.policy.document:CopiedPolicies",
        },
    ),
    "diff_policy": Shapes(
        "The rights that differ between A and B, or what B adds to A.",
        {
            "the difference": "sros_tool.keystore.rights:PolicyDifference",
            "--no-new-access": "sros_tool.proof.growth:NewAccess",
        },
    ),
    "list_enclaves": "sros_tool.keystore.selection:EnclaveList",
    "inspect": Shapes(
        "What is in a keystore, an enclave or a file.",
        {
            "a keystore": f"{_DESCRIBE}:DescribedKeystore",
            "the folder of an enclave": f"{_DESCRIBE}:DescribedEnclave",
            "certificates": f"{_DESCRIBE}:DescribedCertificates",
            "a revocation list": f"{_DESCRIBE}:DescribedList",
            "a private key": f"{_DESCRIBE}:DescribedKey",
            "key on a token": f"{_DESCRIBE}:DescribedKeyOnToken",
            "permissions": f"{_DESCRIBE}:DescribedPermissions",
            "governance": f"{_DESCRIBE}:DescribedGovernance",
            "a Zenoh configuration": f"{_DESCRIBE}:DescribedConfiguration",
            "--history": f"{_DESCRIBE}:History",
        },
    ),
    "env": "sros_tool.runtime.environment:PrintedEnvironment",
    "zenoh": Shapes(
        "The Zenoh configurations of a keystore's enclaves, or an existing configuration.",
        {
            "KEYSTORE": f"{_LIFECYCLE}:KeystoreZenoh",
            "--from": "sros_tool.checks.zenoh:ReadConfiguration",
        },
    ),
    "agent init": "sros_tool.agent.state:InitializedAgent",
    "agent run": "sros_tool.agent.agent:Round",
    "agent status": "sros_tool.agent.state:AgentStatus",
    "units": "sros_tool.runtime.units:WrittenUnits",
    "fleet collect": "sros_tool.keystore.delivery.collect:CollectedInbox",
    "fleet confirm": "sros_tool.keystore.confirmation:KeptConfirmation",
    "fleet publish": "sros_tool.keystore.delivery.publish:PublishedFleet",
    "metrics": "sros_tool.prometheus:KeystoreMetrics",
    "merge_policy": "sros_tool.policy.merge:MergedPolicy",
    "minimize_policy": "sros_tool.keystore.issuing.size:PolicyMinimization",
    "generate_policy": "sros_tool.graph.learn:LearnedPolicy",
    "create_request": "sros_tool.keystore.delivery.robot:MadeRequests",
    "distribute_key": "sros_tool.keystore.delivery.export:ExportedEnclaves",
    "sign_request": "sros_tool.keystore.delivery.signing:SignedRequest",
    "import": "sros_tool.keystore.delivery.robot:ImportedAnswer",
    "create_keystore": f"{_LIFECYCLE}:NewKeystore",
    "create_enclave": f"{_LIFECYCLE}:CreatedEnclaves",
    "create_permission": f"{_LIFECYCLE}:ChangedEnclave",
    "generate_artifacts": f"{_LIFECYCLE}:MadeEnclaves",
    "renew": f"{_LIFECYCLE}:RenewedEnclaves",
    "revoke": f"{_LIFECYCLE}:RevokedEnclaves",
    "update_keystore": f"{_LIFECYCLE}:UpdatedKeystore",
    "crl": f"{_LIFECYCLE}:KeystoreLists",
    "rotate_ca": Shapes(
        "The state of a CA rotation, or what a stage of it did.",
        {
            "--status": f"{_LIFECYCLE}:RotationState",
            "--next, --to, --finish or --same-key": f"{_LIFECYCLE}:RotationChange",
        },
    ),
}
"""What the verbs print: a class, as MODULE:CLASS, or several."""


_DIALECT = "https://json-schema.org/draft/2020-12/schema"
_VERSION = {
    "const": 1,
    "description": "The version of the format. It is raised if a key is removed or changes its "
    "meaning, but not if a key is added.",
}
_PLAIN = {str: "string", int: "integer", float: "number", bool: "boolean", type(None): "null"}


def printed_classes() -> set[str]:
    """Return the classes whose shapes are described, as MODULE:CLASS."""
    places = {*SHARED_PARTS.values()}
    for shapes in VERBS.values():
        places |= {shapes} if isinstance(shapes, str) else {*shapes.classes.values()}
    return places


def schemas() -> dict[str, Schema]:
    """Return all schemas that follow from types, by the names of their files."""
    found = {f"{verb.replace(' ', '_')}.json": _of_verb(verb) for verb in VERBS}
    parts = _Parts({})
    by_hand = json.loads((SCHEMAS / f"{SHARED}.json").read_text("utf-8"))["$defs"]
    found[f"{SHARED}.json"] = {
        "$schema": _DIALECT,
        "title": SHARED,
        "description": "Parts that several verbs share.",
        "$defs": {
            **by_hand,
            "version": _VERSION,
            **{name: parts.object(_named(place)) for name, place in SHARED_PARTS.items()},
        },
    }
    return found


def object_schema(kind: Any) -> Schema:
    """Return the schema of the object that a class becomes."""
    return _Parts({}).object(kind)


def text_of(schema: Schema) -> str:
    """Return a schema as the text of its file."""
    return json.dumps(schema, indent=2, ensure_ascii=False) + "\n"


def _of_verb(verb: str) -> Schema:
    shapes = VERBS[verb]
    head = {"$schema": _DIALECT, "title": verb}
    if isinstance(shapes, str):
        kind = _named(shapes)
        parts = _Parts(_repeated((kind,)))
        return {**head, **parts.root(kind), **parts.definitions()}
    kinds = {title: _named(place) for title, place in shapes.classes.items()}
    parts = _Parts(_repeated(kinds.values()))
    named = {_name_of(kind): {"title": title, **parts.root(kind)} for title, kind in kinds.items()}
    return {
        **head,
        "description": shapes.description,
        "oneOf": [{"$ref": f"#/$defs/{name}"} for name in named],
        "$defs": {**named, **parts.definitions().get("$defs", {})},
    }


@cache
def _named(place: str) -> Any:
    module, _, name = place.partition(":")
    return getattr(import_module(module), name)


def _name_of(kind: Any) -> str:
    """Return the name of a class in small letters, with underscores between its words."""
    name = _class_of(_bare(kind)).__name__
    return "".join(f"_{letter.lower()}" if letter.isupper() else letter for letter in name)[1:]


class _Parts:
    """The schemas of types; those of classes that have a name refer to it."""

    def __init__(self, named: Mapping[type, str]) -> None:
        """Take the names of the classes that a document defines once."""
        self._named = named
        self._shared = {_named(place): name for name, place in SHARED_PARTS.items()}

    def definitions(self) -> Schema:
        """Return the named classes under ``$defs``; nothing if there are none."""
        defined = {name: self.object(kind) for kind, name in self._named.items()}
        return {"$defs": defined} if defined else {}

    def root(self, kind: Any) -> Schema:
        """Return the schema of a whole object, which begins with the version."""
        schema = self.object(kind)
        reference = {"$ref": f"{SHARED}.json#/$defs/version"}
        schema["properties"] = {"version": reference, **schema["properties"]}
        schema["required"].insert(0, "version")
        return schema

    def object(self, kind: Any) -> Schema:
        """Return the schema of the object that a class becomes."""
        properties: Schema = {}
        required: list[str] = []
        for key, value in _unique(_keys(kind)).items():
            schema = self.of(value.kind)
            if value.null_if_empty:
                schema = _or_null(schema)
            properties[key] = {**schema, "description": value.description}
            if not value.optional:
                required.append(key)
        return {
            "type": "object",
            "description": _summary(kind),
            "additionalProperties": False,
            "required": required,
            "properties": properties,
        }

    def of(self, kind: Any) -> Schema:
        """Return the schema of a type."""
        if get_origin(kind) is Annotated:
            words = [each for each in kind.__metadata__ if isinstance(each, Words)]
            return _one_of(tuple(words[0])) if words else self.of(kind.__origin__)
        kind = _bare(kind)
        origin, arguments = get_origin(kind), get_args(kind)
        if kind in _PLAIN:
            return {"type": _PLAIN[kind]}
        if origin is Literal:
            return _one_of(arguments)
        if origin in (Union, types.UnionType):
            return self._union(arguments)
        if isinstance(origin, type) and shown(origin):
            return self.object(kind)
        if isinstance(origin, type) and issubclass(origin, Mapping):
            return {"type": "object", "additionalProperties": self.of(arguments[1])}
        if isinstance(origin, type) and issubclass(origin, (Sequence, Set)):
            members = [each for each in arguments if each is not Ellipsis]
            return {"type": "array", "items": self._union(tuple(dict.fromkeys(members)))}
        if not isinstance(kind, type):
            raise TypeError(f"{kind} has no JSON Schema")
        if issubclass(kind, Enum):
            return _one_of(tuple(each.value for each in kind))
        if kind in self._shared:
            return {"$ref": f"{SHARED}.json#/$defs/{self._shared[kind]}"}
        if kind in self._named:
            return {"$ref": f"#/$defs/{self._named[kind]}"}
        if shown(kind):
            return self.object(kind)
        if issubclass(kind, datetime):
            return {"type": "string", "format": "date-time"}
        if issubclass(kind, PurePath):
            return {"type": "string"}
        if element := _element(kind):
            return {"type": "array", "items": self.of(element)}
        raise TypeError(f"{kind} has no JSON Schema")

    def _union(self, members: tuple[Any, ...]) -> Schema:
        """Return the schema of any of several types."""
        if float in members:  # which has all integers
            members = tuple(each for each in members if each is not int)
        schemas = [self.of(each) for each in members if each is not type(None)]
        schema = schemas[0]
        if len(schemas) > 1:
            schema = {"anyOf": schemas}
            if all(set(each) == {"type"} for each in schemas):
                schema = {"type": [each["type"] for each in schemas]}
        return _or_null(schema) if type(None) in members else schema


def _or_null(schema: Schema) -> Schema:
    """Return a schema that null fits, too."""
    if "type" not in schema:
        return {"anyOf": [*schema.get("anyOf", [schema]), {"type": "null"}]}
    kinds = schema["type"] if isinstance(schema["type"], list) else [schema["type"]]
    more = {"enum": [*schema["enum"], None]} if "enum" in schema else {}
    return {**schema, **more, "type": [*kinds, "null"]}


def _one_of(values: tuple[Any, ...]) -> Schema:
    """Return the schema of one of several words or numbers."""
    if len(values) == 1 and not isinstance(values[0], str):
        return {"const": values[0]}
    (kind,) = {_PLAIN[type(each)] for each in values if each is not None}
    schema = {"type": kind, "enum": [each for each in values if each is not None]}
    return _or_null(schema) if None in values else schema


# ── the types of keys, and what their docstrings say ─────────────────────────────────────────


class _Key(NamedTuple):
    kind: Any
    description: str
    optional: bool
    null_if_empty: bool


def _keys(kind: Any) -> Iterator[tuple[str, _Key]]:
    """Yield the keys of the object that a class becomes, those of spread attributes among them."""
    kind, given = _class_of(_bare(kind)), _arguments(_bare(kind))
    shape = shown(kind)
    if shape is None:
        raise TypeError(f"{kind} becomes no object")
    for name in shape.names:
        declared = _filled(_declared(kind, name), given)
        if name in shape.spread:
            inner, maybe = _spread(declared)
            for key, value in _keys(inner):
                yield key, value._replace(optional=value.optional or maybe)
            continue
        yield (
            key_of(name),
            _Key(
                _not_none(declared) if name in shape.optional else declared,
                _description(kind, name, declared),
                name in shape.optional,
                name in shape.null_if_empty,
            ),
        )


def _unique(keys: Iterable[tuple[str, _Key]]) -> dict[str, _Key]:
    """Return keys once; a later one replaces an earlier one, which is there without it."""
    unique: dict[str, _Key] = {}
    for key, value in keys:
        before = unique.get(key, value)
        unique[key] = value._replace(optional=value.optional and before.optional)
    return unique


def _class_of(kind: Any) -> Any:
    """Return a class without the types that it was given."""
    return get_origin(kind) or kind


def _arguments(kind: Any) -> dict[TypeVar, Any]:
    """Return the types that a generic class was given, by the variables that they stand for."""
    parameters = getattr(get_origin(kind), "__parameters__", ())
    return dict(zip(parameters, get_args(kind), strict=True)) if parameters else {}


def _filled(kind: Any, given: Mapping[TypeVar, Any]) -> Any:
    """Return a type with other types in place of its variables."""
    if isinstance(kind, TypeVar):
        return given.get(kind, kind)
    parameters = getattr(kind, "__parameters__", ())
    return kind[tuple(given.get(each, each) for each in parameters)] if parameters else kind


def _spread(declared: Any) -> tuple[Any, bool]:
    """Return the class of a spread attribute, and whether it may be None."""
    inner = _bare(_not_none(declared))
    return inner, inner is not _bare(declared)


def _not_none(kind: Any) -> Any:
    """Return a type without None."""
    if get_origin(kind) not in (Union, types.UnionType):
        return kind
    return Union[tuple(each for each in get_args(kind) if each is not type(None))]  # noqa: UP007


def _bare(kind: Any) -> Any:
    """Return a type without its annotation, and the bound of a variable."""
    if get_origin(kind) is Annotated:
        return _bare(get_args(kind)[0])
    return kind.__bound__ if isinstance(kind, TypeVar) else kind


def _declared(kind: type, name: str) -> Any:
    """Return the type of a field or property."""
    attribute = inspect.getattr_static(kind, name, None)
    if isinstance(attribute, property):
        return _hints(attribute.fget)["return"]
    if isinstance(attribute, cached_property):
        return _hints(attribute.func)["return"]
    return _hints(kind)[name]


def _element(kind: Any) -> Any:
    """Return the type of the elements of a class that is a sequence; None for any other."""
    for base in getattr(kind, "__orig_bases__", ()):
        if isinstance(get_origin(base), type) and issubclass(get_origin(base), Sequence):
            return get_args(base)[0]
    return None


@cache
def _hints(kind: Any) -> dict[str, Any]:
    """Return the types that a class or function names, also those imported only for type checks."""
    owners = kind.__mro__ if isinstance(kind, type) else (kind,)
    names: dict[str, Any] = {}
    for owner in owners:
        names |= _names_for_type_checks(owner.__module__)
    return get_type_hints(kind, localns=names, include_extras=True)


@cache
def _names_for_type_checks(module: str) -> dict[str, Any]:
    """Return what a module imports below ``if TYPE_CHECKING``."""
    names: dict[str, Any] = {}
    if module.partition(".")[0] not in ("sros_tool", "tests"):
        return names
    for node in _tree(module).body:
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            exec(compile(ast.Module(node.body, []), module, "exec"), names)  # noqa: S102
    return names


def _description(kind: type, name: str, declared: Any) -> str:
    """Return what the docstring of a field or property says, or else that of its type."""
    for owner in kind.__mro__:
        attribute = vars(owner).get(name)
        if isinstance(attribute, (property, cached_property)):
            text = inspect.getdoc(attribute) or ""
        else:
            text = docstrings_of_fields(owner).get(name, "")
        if text:
            return _sentence(text)
    for each in getattr(declared, "__metadata__", ()):
        if isinstance(each, str):
            return each
    raise TypeError(f"{kind.__module__}.{kind.__qualname__}.{name} has no docstring")


@cache
def _tree(module: str) -> ast.Module:
    return ast.parse(inspect.getsource(sys.modules[module]))


@cache
def _classes(module: str) -> dict[str, ast.stmt]:
    """Return the classes of a module, by their names in it."""
    return {node.name: node for node in _tree(module).body if isinstance(node, ast.ClassDef)}


@cache
def docstrings_of_fields(kind: type) -> dict[str, str]:
    """Return the strings after the fields of a class, or the members of an enumeration."""
    if kind.__module__.partition(".")[0] not in ("sros_tool", "tests"):
        return {}
    written = _classes(kind.__module__).get(kind.__qualname__)
    if written is None:  # in a function
        (written,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    assert isinstance(written, ast.ClassDef)
    body = written.body
    return {
        target.id: after.value.value
        for field, after in pairwise(body)
        if isinstance(field, ast.AnnAssign | ast.Assign)
        for target in (field.targets if isinstance(field, ast.Assign) else [field.target])
        if isinstance(target, ast.Name)
        and isinstance(after, ast.Expr)
        and isinstance(after.value, ast.Constant)
        and isinstance(after.value.value, str)
    }


def _summary(kind: Any) -> str:
    """Return what an object is: the description in its annotation, or else its docstring."""
    for each in getattr(kind, "__metadata__", ()):
        if isinstance(each, str):
            return each
    return _sentence(inspect.cleandoc(vars(_class_of(_bare(kind))).get("__doc__") or ""))


def _sentence(text: str) -> str:
    """Return the first paragraph of a docstring, as Markdown."""
    return " ".join(text.partition("\n\n")[0].split()).replace("``", "`")


def _repeated(kinds: Iterable[Any]) -> dict[type, str]:
    """Return names for the classes that occur more than once below others, and are not shared."""
    uses: Counter[Any] = Counter()
    shared = {_named(place) for place in SHARED_PARTS.values()}

    def visit(kind: Any) -> None:
        kind = _bare(kind)
        for argument in get_args(kind):
            visit(argument)
        owner = _class_of(kind)
        if not isinstance(owner, type) or owner in shared or issubclass(owner, Enum):
            return
        if owner is not kind and shown(owner):
            for _, value in _keys(kind):
                visit(value.kind)
        elif element := _element(kind):
            visit(element)
        elif shown(kind):
            uses[kind] += 1
            if uses[kind] == 1:
                for _, value in _keys(kind):
                    visit(value.kind)

    for root in kinds:
        for _, value in _keys(root):
            visit(value.kind)
    return {kind: _name_of(kind) for kind, number in uses.items() if number > 1}


if __name__ == "__main__":
    for name, schema in schemas().items():
        (SCHEMAS / name).write_text(text_of(schema), encoding="utf-8")
