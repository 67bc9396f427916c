"""The layers of docs/architecture.md hold, no import is circular, and public names are needed."""

from __future__ import annotations

import ast
import gc
import re
import tomllib
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from graphlib import CycleError, TopologicalSorter
from itertools import product
from pathlib import Path
from typing import Any

import pytest

from tools.json_schemas import printed_classes

PROJECT = Path(__file__).parents[1]
PACKAGE = PROJECT / "sros_tool"

LAYERS = {
    1: {
        "automata",
        "errors",
        "faults",
        "names",
        "owners",
        "spelling",
        "validity",
        "values",
        "wording",
    }
    | {"xml", "files", "folders", "parallel", "prometheus", "markdown", "terminal"},
    2: {"pki", "policy", "dds", "zenoh"},
    3: {"distributions", "fleet", "translate", "translate_zenoh"},
    4: {"reach", "keystore", "graph", "runtime"},
    5: {"checks", "explain", "demo"},
    6: {"proof", "enclave_environment"},
    7: {"report", "agent", "close"},
    8: {"api", "cli"},
    9: {"launch", "__init__", "__main__"},
}
LAYER_OF = {package: layer for layer, packages in LAYERS.items() for package in packages}

# Where a process of its own runs the nodes of rclpy. Nothing else may need ROS.
ROS_PACKAGES = {"graph", "demo"}
ROS_MODULES = {"runtime/stacks.py"}


@pytest.fixture(scope="module", autouse=True)
def no_search_for_garbage() -> Iterator[None]:
    """The millions of nodes of all modules stay, and going through them again takes as long."""
    gc.disable()
    yield
    tree_of.cache_clear()
    nodes_of.cache_clear()
    nodes_by_kind.cache_clear()
    modules_of.cache_clear()
    gc.enable()


@cache
def tree_of(source: str) -> ast.Module:
    """Return the syntax of a module, which several tests look at; it is not changed."""
    return ast.parse(source)


@cache
def nodes_of(tree: ast.AST) -> tuple[ast.AST, ...]:
    """Return the nodes of a tree, which several tests go through, but for `Load` and `Store`."""
    nodes = [tree]
    for node in nodes:  # which grows: `ast.walk` does the same in twice the time
        for name in node._fields:
            value = getattr(node, name, None)
            if isinstance(value, list):
                nodes += [each for each in value if isinstance(each, ast.AST)]
            elif isinstance(value, ast.AST) and name != "ctx":
                nodes.append(value)
    return tuple(nodes)


@cache
def nodes_by_kind(tree: ast.AST) -> Mapping[type[ast.AST], list[Any]]:
    """Return the nodes of a tree by their class: most tests look at few of them."""
    found: defaultdict[type[ast.AST], list[Any]] = defaultdict(list)
    for node in nodes_of(tree):
        found[type(node)].append(node)
    return found


def of_kind(tree: ast.AST, *kinds: type[ast.AST]) -> Iterator[Any]:
    """Yield the nodes of a tree that are of one of these classes."""
    found = nodes_by_kind(tree)
    for kind in kinds:
        yield from found.get(kind, ())


def imported(source: str, module: tuple[str, ...]) -> Iterator[tuple[int, str]]:
    """Line and absolute name of each import in the text of `module`; also inside functions."""
    yield from imported_names(tree_of(source), module)


def imported_names(tree: ast.Module, module: tuple[str, ...]) -> Iterator[tuple[int, str]]:
    """Line and absolute name of each import in the syntax of `module`; also inside functions."""
    for node in of_kind(tree, ast.Import, ast.ImportFrom):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, name.name) for name in node.names)
        else:
            above = module[: len(module) - node.level] if node.level else ()
            origin = ".".join((*above, *([node.module] if node.module else [])))
            yield from ((node.lineno, f"{origin}.{name.name}") for name in node.names)


def misplaced(source: str, path: str) -> list[str]:
    """Imports that the module `path`, relative to the package, may not have."""
    parts = ("sros_tool", *Path(path).with_suffix("").parts)
    package = parts[1]
    found = []
    for line, name in imported(source, parts):
        first, *rest = name.split(".")
        if first == "rclpy" and package not in ROS_PACKAGES and path not in ROS_MODULES:
            found.append(f"{path}:{line} imports rclpy")
        if first != "sros_tool" or not rest or rest[0] == package or rest[0] == "__version__":
            continue
        # Packages of one layer do not import each other, except the small modules of layer 1.
        if LAYER_OF[rest[0]] >= LAYER_OF[package] and LAYER_OF[package] != 1:
            found.append(f"{path}:{line} imports {name}, which is not below it")
        elif LAYER_OF[rest[0]] > LAYER_OF[package]:
            found.append(f"{path}:{line} imports {name}, which is above it")
    return found


MODULES = sorted(str(path.relative_to(PACKAGE)) for path in PACKAGE.rglob("*.py"))


def test_every_package_has_a_layer() -> None:
    assert {Path(module).with_suffix("").parts[0] for module in MODULES} == set(LAYER_OF)


def test_nothing_imports_from_above_or_beside() -> None:
    assert [
        line for module in MODULES for line in misplaced((PACKAGE / module).read_text(), module)
    ] == []


@pytest.mark.parametrize(
    ("source", "path", "found"),
    [
        ("from sros_tool.errors import SrosError", "policy/model.py", []),
        ("from sros_tool.policy.document import read", "policy/model.py", []),
        ("from .reader import read", "policy/model.py", []),
        ("from sros_tool import translate", "keystore/enclave.py", []),
        ("import rclpy.node", "demo/ros_node.py", []),
        (
            "from sros_tool.keystore.layout import Keystore",
            "policy/model.py",
            ["sros_tool.keystore.layout.Keystore"],
        ),
        (
            "def late():\n    import sros_tool.cli.program",
            "demo/program.py",
            ["sros_tool.cli.program"],
        ),
        ("from ..cli import program", "demo/program.py", ["sros_tool.cli.program"]),
        ("from sros_tool import dds", "policy/model.py", ["sros_tool.dds"]),
        ("from sros_tool.pki import keys", "errors.py", ["sros_tool.pki.keys"]),
        ("import rclpy", "runtime/rmw.py", ["rclpy"]),
        ("from rclpy.node import Node", "cli/observing.py", ["rclpy"]),
    ],
)
def test_the_search_sees_what_is_misplaced_and_only_that(
    source: str, path: str, found: list[str]
) -> None:
    lines = misplaced(source, path)
    assert len(lines) == len(found)
    assert all(name in line for line, name in zip(lines, found, strict=True))


CLOCKS = {"datetime.now", "datetime.utcnow", "datetime.today", "date.today", "time.time"}
CLOCK_MODULES = {"cli/common.py", "api.py"}
"""`now`, `_moment`, and the offset of a machine whose zone has no name."""


def clocks(source: str) -> list[int]:
    """The lines that ask what time it is."""
    return [
        node.lineno
        for node in of_kind(tree_of(source), ast.Attribute)
        if any(clock.endswith(f".{node.attr}") for clock in CLOCKS)
        and f"{ast.unparse(node.value).rpartition('.')[2]}.{node.attr}" in CLOCKS
    ]


def test_only_the_command_line_and_the_api_ask_the_clock() -> None:
    found = {module for module in MODULES if clocks((PACKAGE / module).read_text())}
    assert found == CLOCK_MODULES
    assert clocks("import datetime\nnow = datetime.datetime.now") == [2]
    assert clocks("time.monotonic(); now()") == []


def test_the_modules_that_may_need_ros_are_the_ones_that_do() -> None:
    users = {
        module
        for module in MODULES
        for _, name in imported((PACKAGE / module).read_text(), ("sros_tool", *Path(module).parts))
        if name.split(".")[0] == "rclpy"
    }
    assert not ROS_MODULES - users
    assert {Path(module).parts[0] for module in users - ROS_MODULES} == ROS_PACKAGES


def test_the_documentation_has_the_same_layers() -> None:
    text = (PROJECT / "docs" / "architecture.md").read_text()
    rows = re.findall(r"^\| ([1-9]) \| (.+?) \|", text, re.MULTILINE)
    documented = {
        package.removesuffix("/").removesuffix(".py"): int(layer)
        for layer, packages in rows
        for package in re.findall(r"`([^`]+)`", packages)
    }
    assert documented == {
        package: layer for package, layer in LAYER_OF.items() if not package.startswith("__")
    }


# ── every module of a tree by its name, and the names in it ────────────────────────────────

Modules = Mapping[str, ast.Module]
"""Parsed modules by their full names; a package has the name of its folder."""


@cache
def modules_of(folder: str) -> Modules:
    """Parse every module below a folder of the project."""
    found = {}
    for path in sorted((PROJECT / folder).rglob("*.py")):
        parts = path.relative_to(PROJECT).with_suffix("").parts
        found[".".join(part for part in parts if part != "__init__")] = tree_of(path.read_text())
    return found


def parse(**sources: str) -> Modules:
    """Parse modules that are given as text; `__` in a name stands for a dot."""
    return {name.replace("__", "."): ast.parse(text) for name, text in sources.items()}


def statements(body: Sequence[ast.stmt]) -> Iterator[ast.stmt]:
    """Yield the statements that run when a module is imported, also those in an `if` or a `try`."""
    for node in body:
        yield node
        if isinstance(node, (ast.If, ast.Try, ast.With)):
            for_types = isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
            for name in ("body", "orelse", "handlers", "finalbody"):
                inner = getattr(node, name, []) if not for_types or name != "body" else []
                for each in inner:
                    handler = isinstance(each, ast.excepthandler)
                    yield from statements(each.body if handler else [each])


# ── no import circle ───────────────────────────────────────────────────────────────────────

_KEYSTORE = "sros_tool.keystore"
LEFT: dict[str, set[str]] = {}
"""Imports inside functions, or for types, that still close a circle: no new ones."""


def imported_at_once(name: str, modules: Modules) -> set[str]:
    """Return the modules that have to be there before `name` can be imported."""
    found = set()
    for node in statements(modules[name].body):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            inside = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= inside & modules.keys()
            if not inside <= modules.keys():
                found.add(node.module)
    # With a module the packages that it is in are imported, but for those `name` is in itself.
    for each in list(found):
        parts = each.split(".")
        found |= {".".join(parts[:length]) for length in range(1, len(parts))}
    return {each for each in found & modules.keys() if not f"{name}.".startswith(f"{each}.")}


def imported_at_all(name: str, modules: Modules) -> set[str]:
    """Return the modules that a module imports, also inside functions and for types alone."""
    package = tuple(name.split("."))
    named = {full for _, full in imported_names(modules[name], package)}
    # Of `from MODULE import NAME`, the name is a module or stands in one.
    found = {full if full in modules else full.rpartition(".")[0] for full in named}
    return {each for each in found & modules.keys() if not f"{name}.".startswith(f"{each}.")}


def circle(
    modules: Modules, imports: Callable[[str, Modules], set[str]] = imported_at_once
) -> list[str]:
    """Return modules each of which imports the next one, the last one the first; or none."""
    graph = {name: imports(name, modules) - LEFT.get(name, set()) for name in modules}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1][::-1])
    return []


def test_a_folder_has_few_modules() -> None:
    folders = {path.parent for path in PACKAGE.rglob("*.py")}
    crowded = {folder.name for folder in folders if len([*folder.glob("*.py")]) > 25}
    assert crowded == set()


def test_no_module_imports_itself_through_others() -> None:
    assert circle(modules_of("sros_tool"), imported_at_all) == []


def test_each_import_that_is_left_would_close_a_circle(monkeypatch: pytest.MonkeyPatch) -> None:
    """The list only becomes shorter: an entry that is needed no more has to go."""
    modules = modules_of("sros_tool")
    for name, others in LEFT.items():
        for other in others:
            assert other in imported_at_all(name, modules)
            monkeypatch.setitem(LEFT, name, others - {other})
            assert circle(modules, imported_at_all), f"{name} may import {other}"
            monkeypatch.setitem(LEFT, name, others)


def test_a_circle_is_seen_where_it_would_stop_an_import_and_only_there() -> None:
    def found(second: str, package: str = "") -> set[str]:
        modules = parse(p=package, p__a="from p.b import x", p__b=second, q="import p.a")
        return set(circle(modules))

    assert found("from p.a import y") == {"p.a", "p.b"}
    assert found("import p.a") == {"p.a", "p.b"}
    assert found("from p import a") == {"p.a", "p.b"}
    assert found("try:\n    import p.a\nexcept ImportError:\n    pass") == {"p.a", "p.b"}
    assert found("import q") == {"p.a", "p.b", "q"}
    assert found("def late():\n    from p.a import y") == set()
    assert found("if TYPE_CHECKING:\n    from p.a import y\nelse:\n    y = 1") == set()
    assert found("x = 1", package="from p.a import x") == set()

    def closed(second: str) -> set[str]:
        modules = parse(p="", p__a="from p.b import x", p__b=second)
        return set(circle(modules, imported_at_all))

    assert closed("def late():\n    from p.a import y") == {"p.a", "p.b"}
    assert closed("if TYPE_CHECKING:\n    from p.a import y") == {"p.a", "p.b"}
    assert closed("from p import a") == {"p.a", "p.b"}
    assert closed("import p") == set()


# ── every file is written by two modules ───────────────────────────────────────────────────

WRITERS = {"files.py", "folders.py"}
"""They follow no link of another user, and leave the whole file or nothing."""

OTHER_WRITERS = {
    "cli/__init__.py": "opens /dev/null",
    "parallel.py": "opens a pipe",
    "runtime/netns.py": "writes to /proc",
    "runtime/stacks.py": "logs of probes, in a temporary folder of its own",
    "runtime/events.py": "reports of the demo's processes, in the demo's folder",
    "demo/": "a temporary folder of its own, or the new folder of --keep",
}

_OS = {
    *("mkdir", "makedirs", "mkfifo", "mknod", "link", "symlink", "replace", "rename", "renames"),
    *("unlink", "remove", "rmdir", "removedirs", "truncate"),
    *("chmod", "lchmod", "chown", "lchown", "utime"),
}
_SHUTIL = {
    *("copy", "copy2", "copyfile", "copymode", "copystat", "copytree", "move", "rmtree", "chown"),
    *("make_archive", "unpack_archive"),
}
_PATH = {
    **dict.fromkeys(("write_text", "write_bytes", "touch", "symlink_to", "hardlink_to"), range(9)),
    **dict.fromkeys(("unlink", "rmdir"), range(1)),
    **dict.fromkeys(("mkdir", "chmod", "lchmod"), range(2)),
    **dict.fromkeys(("rename", "replace"), range(1, 2)),
}
"""Methods of a path, with their numbers of positional arguments: those of a `Folder` and of a
text have others."""

_CLASSES = {"FileHandler", "ZipFile", "TarFile", "extract", "extractall"}

_READING = {"O_RDONLY", "O_DIRECTORY", "O_CLOEXEC", "O_NOFOLLOW", "O_NONBLOCK", "O_PATH"}


def is_writing(call: ast.Call) -> bool:
    """Return whether a call changes what is at a path."""
    owner, _, name = ast.unparse(call.func).rpartition(".")
    keywords = {each.arg for each in call.keywords}
    if (owner, name) == ("os", "open"):
        flags = {each.attr for each in ast.walk(call.args[1]) if isinstance(each, ast.Attribute)}
        return not flags or not flags <= _READING
    if owner in ("os", "shutil"):
        return name in (_OS if owner == "os" else _SHUTIL)
    if name == "open" and "fileobj" not in keywords:
        given = [*call.args, *(each.value for each in call.keywords)]
        modes = [each.value for each in given if isinstance(each, ast.Constant)]
        chosen = [each.value for each in call.keywords if each.arg == "mode"]
        chosen += call.args[1:2] if not owner else []
        return any(re.fullmatch(r"(?=.*[wax+])[rwaxbt+:|gz]+", str(each)) for each in modes) or any(
            not isinstance(each, ast.Constant) for each in chosen
        )
    if name in _CLASSES:
        return True
    return bool(owner) and len(call.args) in _PATH.get(name, ())


def writing(source: str) -> list[int]:
    """The lines that change what is at a path, or import a function that can under a new name."""
    return sorted(
        node.lineno
        for node in of_kind(tree_of(source), ast.Call, ast.ImportFrom, ast.Import)
        if (isinstance(node, ast.Call) and is_writing(node))
        or (
            isinstance(node, ast.ImportFrom)
            and node.module in ("os", "shutil")
            and {alias.name for alias in node.names} & {*_OS, *_SHUTIL, "open", "*"}
        )
        or (
            isinstance(node, ast.Import)
            and any(alias.asname and alias.name in ("os", "shutil") for alias in node.names)
        )
    )


def unsafe_pythons(source: str) -> list[int]:
    """Lines that start Python so that it imports modules from the working folder."""
    found = []
    for node in of_kind(tree_of(source), ast.List, ast.Tuple, ast.Set):
        words = [ast.unparse(each) for each in node.elts]
        for place, word in enumerate(words):
            if word == "sys.executable" and words[place + 1 : place + 2] != ["'-P'"]:
                found.append(node.lineno)
    return found


def test_python_is_started_without_the_working_folder() -> None:
    found = {module: unsafe_pythons((PACKAGE / module).read_text()) for module in MODULES}
    assert {module: lines for module, lines in found.items() if lines} == {}
    assert unsafe_pythons("[sys.executable, '-m', 'x']\n[sys.executable, '-P', '-m', 'x']") == [1]


def test_everything_is_written_by_two_modules() -> None:
    found = {module for module in MODULES if writing((PACKAGE / module).read_text())}
    assert found >= WRITERS
    others = {each for each in OTHER_WRITERS if any(module.startswith(each) for module in found)}
    assert others == set(OTHER_WRITERS)
    assert [each for each in found - WRITERS if not each.startswith(tuple(OTHER_WRITERS))] == []


@pytest.mark.parametrize(
    ("source", "seen"),
    [
        ("path.write_text(x)", True),
        ("(folder / name).write_bytes(x)", True),
        ("path.open('w')", True),
        ("open(path, mode='a')", True),
        ("path.open('r+b')", True),
        ("open(path, 'rb')", False),
        ("open(path, mode)", True),
        ("path.open(mode=mode)", True),
        ("path.open()", False),
        ("keyring.open(root, 'identity')", False),
        ("tarfile.open(fileobj=packed, mode='w')", False),
        ("tarfile.open(path, 'w:gz')", True),
        ("os.open(path, os.O_RDONLY | os.O_NOFOLLOW)", False),
        ("os.open(path, os.O_RDONLY | os.O_CREAT)", True),
        ("os.open(path, flags)", True),
        ("os.replace(a, b)", True),
        ("text.replace(a, b)", False),
        ("path.replace(b)", True),
        ("folder.replace(a, b)", False),
        ("moment.replace(microsecond=0)", False),
        ("folder.mkdir('a', 0o700)", False),
        ("path.mkdir(parents=True)", True),
        ("folder.unlink('a')", False),
        ("path.unlink(missing_ok=True)", True),
        ("shutil.copytree(a, b)", True),
        ("shutil.which(a)", False),
        ("from shutil import rmtree", True),
        ("from os import fspath", False),
        ("import os as system", True),
        ("archive.extractall(path)", True),
    ],
)  # fmt: skip
def test_writing_is_seen_and_nothing_else(source: str, seen: bool) -> None:
    assert bool(writing(source)) is seen


# ── everything is printed by one module ────────────────────────────────────────────────────

PRINTER = "terminal.py"
"""It makes names visible that could steer a terminal."""

_NODE = "a process of its own, without click; what it prints is read"

OTHER_PRINTERS = {
    "cli/__init__.py": "interrupted while the program is imported",
    "demo/cyclone_node.py": _NODE,
    "demo/ros_node.py": _NODE,
}

_CLICK = {"echo", "secho", "style", "prompt", "confirm", "echo_via_pager", "getchar", "pause"}
_LOGGING = {"StreamHandler", "basicConfig", "lastResort"}


def printing(source: str) -> list[int]:
    """The lines that write to the terminal, or import what does under another name."""
    nodes = of_kind(tree_of(source), ast.Call, ast.ImportFrom)
    return sorted({node.lineno for node in nodes if _is_printing(node)})


def _is_printing(node: ast.AST) -> bool:
    if isinstance(node, ast.ImportFrom):
        names = {alias.name for alias in node.names}
        of_sys = node.module == "sys" and bool(names & {"stdout", "stderr"})
        return of_sys or (node.module == "click" and bool(names & _CLICK))
    if not isinstance(node, ast.Call):
        return False
    owner, _, name = ast.unparse(node.func).rpartition(".")
    if owner in ("", "builtins") and name in ("print", "getpass"):
        return True
    if name in _LOGGING:
        return True
    if owner == "click":
        return name in _CLICK
    if owner in ("traceback", "getpass", "warnings"):
        return name in ("print_exc", "print_exception", "getpass", "showwarning")
    if (owner, name) == ("os", "write"):
        return "std" in ast.unparse(node.args[0]) or ast.unparse(node.args[0]) in ("1", "2")
    return name.startswith("write") and owner.startswith(("sys.std", "sys.__std"))


def test_everything_is_printed_by_one_module() -> None:
    found = {module for module in MODULES if printing((PACKAGE / module).read_text())}
    assert PRINTER in found
    others = {each for each in OTHER_PRINTERS if any(module.startswith(each) for module in found)}
    assert others == set(OTHER_PRINTERS)
    assert [
        each for each in sorted(found - {PRINTER}) if not each.startswith(tuple(OTHER_PRINTERS))
    ] == []


@pytest.mark.parametrize(
    ("source", "seen"),
    [
        ("print(x)", True),
        ("print_json(x)", False),
        ("click.echo(x)", True),
        ("click.style(x, fg='red')", True),
        ("echo(x)", False),
        ("from click import echo", True),
        ("from sros_tool.terminal import echo", False),
        ("sys.stdout.write(x)", True),
        ("sys.stdout.buffer.write(x)", True),
        ("sys.stderr.writelines(x)", True),
        ("sys.stdout.flush()", False),
        ("file.write(x)", False),
        ("os.write(sys.stderr.fileno(), x)", True),
        ("os.write(2, x)", True),
        ("os.write(pipe, x)", False),
        ("from sys import stderr", True),
        ("logging.StreamHandler()", True),
        ("logging.getLogger(x)", False),
        ("traceback.print_exc()", True),
        ("getpass.getpass()", True),
    ],
)
def test_printing_is_seen_and_nothing_else(source: str, seen: bool) -> None:
    assert bool(printing(source)) is seen


# ── a public class has one name, and the name one meaning ──────────────────────────────────


def meanings(modules: Modules) -> dict[str, list[str]]:
    """Return the public class names that are defined in several places, with the modules."""
    found = defaultdict(list)
    for name, tree in modules.items():
        for node in of_kind(tree, ast.ClassDef):
            if not node.name.startswith("_"):
                found[node.name].append(name)
    return {name: places for name, places in found.items() if len(places) > 1}


def test_a_class_name_has_one_meaning() -> None:
    assert meanings(modules_of("sros_tool")) == {}


def test_a_class_name_with_two_meanings_is_seen() -> None:
    text = "class Plan: ...\nclass _Own: ..."
    assert meanings(parse(p__a=text, p__b=text, p__c="Plan = 1")) == {"Plan": ["p.a", "p.b"]}


# ── a public name is used by another module ────────────────────────────────────────────────


def is_kind(value: ast.expr | None) -> bool:
    """Return whether a constant is a kind of finding: the registry takes all of its modules."""
    return isinstance(value, ast.Call) and ast.unparse(value.func) == "FindingKind"


def public_names(tree: ast.Module) -> set[str]:
    """Return the public names that a module defines, or passes on in its `__all__`."""
    found = set()
    for node in statements(tree.body):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            found.add(node.name)
        elif isinstance(node, (ast.Assign, ast.AnnAssign)) and not is_kind(node.value):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = {
                each.id
                for target in targets
                for each in ast.walk(target)
                if isinstance(each, ast.Name) and isinstance(each.ctx, ast.Store)
            }
            if names == {"__all__"} and node.value:
                names = set(ast.literal_eval(node.value))
            found |= names
    return {each for each in found if not each.startswith("_")}


def used_names(name: str, modules: Modules, known: Modules) -> set[tuple[str, str]]:
    """Return what the module `name` takes from each of the `known` modules, also later on."""
    tree = modules[name]
    found: set[tuple[str, str]] = set()
    aliases: dict[str, str] = {}
    for node in of_kind(tree, ast.Import, ast.ImportFrom):
        if isinstance(node, ast.Import):
            for alias in node.names:
                aliases[alias.asname or alias.name] = alias.name
        elif node.module:
            for alias in node.names:
                found.add((node.module, alias.name))
                aliases[alias.asname or alias.name] = f"{node.module}.{alias.name}"
    whole = [module for module in aliases.values() if module in known]
    folder = f"{name.rpartition('.')[0]}."
    beside = [each for each in known if each.startswith(folder) and each != name]
    # Of any module that is here whole: it may be asked as the variable of a loop.
    attributes = {node.attr for node in of_kind(tree, ast.Attribute)}
    found.update(product(whole, attributes))
    # A table of verbs, or of what is imported late, names what stands next to it.
    constants = (node.value for node in of_kind(tree, ast.Constant))
    words = {word for word in constants if isinstance(word, str) and word.isidentifier()}
    found.update(product(beside, words))
    return {(module, each) for module, each in found if module != name}


def loaded_names(*trees: ast.AST) -> set[str]:
    """Return the names that are read anywhere in the trees."""
    return {
        node.id
        for tree in trees
        for node in of_kind(tree, ast.Name)
        if isinstance(node.ctx, ast.Load)
    }


def types_of_signatures(tree: ast.Module) -> set[str]:
    """Return the names that stand in the annotations of a module."""
    found = set()
    for node in nodes_of(tree):
        for field in ("annotation", "returns"):
            if annotation := getattr(node, field, None):
                found |= loaded_names(annotation)
    return found


def unused(modules: Modules, users: Modules, tests: Modules) -> set[str]:
    """Return the public names that no other module and no user needs, as `module:name`.

    A name that the tests take is needed only where its own module uses it, too, and a type that
    its own module returns or takes is needed. What the first module of all passes on is for
    others, and `main` is for the interpreter.
    """
    everything = {**modules, **users}
    needed = {each for name in everything for each in used_names(name, everything, modules)}
    tested = {each for name in tests for each in used_names(name, tests, modules)}
    found = set()
    for name, tree in modules.items():
        loaded, types = loaded_names(tree), types_of_signatures(tree)
        for public in public_names(tree) - types - {"main"}:
            own = public in loaded and (name, public) in tested
            if "." in name and (name, public) not in needed and not own:
                found.add(f"{name}:{public}")
    return found


def test_every_public_name_is_needed_by_another_module() -> None:
    users = {**modules_of("benchmarks"), **modules_of("tools")}
    found = unused(modules_of("sros_tool"), users, modules_of("tests"))
    project = tomllib.loads((PROJECT / "pyproject.toml").read_text())["project"]
    groups = project["entry-points"].values()  # what other programs load
    found -= {each for group in groups for each in group.values()}
    assert sorted(found - printed_classes()) == []


def test_a_public_name_that_nobody_needs_is_seen() -> None:
    modules = parse(
        p="from p.a import exported\n__all__ = ['exported']",
        p__a="""
def exported(): ...
def taken(): ...
def by_module(): ...
def by_benchmark(): ...
def by_verb(): ...
def tested_and_own(): ...
def main(): ...
def tested_only(): ...
def own_only(): ...
def passed_on(): ...
def nobody() -> Returned: ...
class Returned: ...
_private = own_only, tested_and_own
if _private:
    also, nobody_either = 1, 2
""",
        p__b="""
from p import a as other
from p.a import taken, also, passed_on
VERBS = ["by_verb"]
def used(): return other.by_module
__all__ = ["passed_on"]
""",
    )
    users = parse(bench="import p.a\np.a.by_benchmark\nfrom p.b import used, VERBS")
    tests = parse(tests="from p.a import tested_and_own, tested_only")
    names = {"tested_only", "own_only", "nobody", "nobody_either"}
    assert unused(modules, users, tests) == {f"p.a:{name}" for name in names} | {"p.b:passed_on"}
