"""What reads a keystore imports nothing that writes one, directly or indirectly."""

from __future__ import annotations

from pathlib import Path

import pytest

from sros_tool.files import policies_dir
from tests.support.children import python
from tests.support.harness import sros
from tests.support.long_form import some

READERS = (
    "sros_tool.keystore.layout",
    "sros_tool.keystore.reader",
    "sros_tool.keystore.loading",
    "sros_tool.keystore.describe",
    "sros_tool.keystore.expiry",
    "sros_tool.keystore.selection",
    "sros_tool.keystore.ledger",
    "sros_tool.keystore.rights",
    "sros_tool.keystore.zenoh_files",
    "sros_tool.explain.earlier",
)
WRITERS = ("transaction", "issuing", "lifecycle", "delivery")

_LIST = "import sys, {0}; print(*(name for name in sys.modules if name.startswith('sros_tool')))"


def loaded_by(module: str) -> list[str]:
    """The modules of sros that a fresh process has after it imported one."""
    return python("-c", _LIST.format(module)).stdout.split()


@pytest.mark.parametrize("module", some(READERS, 1))
def test_reading_imports_nothing_that_writes(module: str) -> None:
    rooms = tuple(f"sros_tool.keystore.{room}" for room in WRITERS)
    assert not [name for name in loaded_by(module) if name.startswith(rooms)]


VERBS = {
    "check": ("sros_tool.checks.policies", "sros_tool.keystore.expiry", "ctypes", "tarfile"),
    "explain": ("sros_tool.keystore.expiry", "ctypes", "logging", "tarfile", "pickle"),
}
"""Verbs that are often run, and modules that they load only in rare cases."""
_VERB = """
import gc, sys
from sros_tool.cli import main
begun = []
gc.callbacks.append(lambda phase, _about: begun.append(phase))
try:
    main(sys.argv[1:])
finally:
    print(len(begun) // 2, *sys.modules, file=sys.stderr)
"""


@pytest.mark.parametrize("verb", some(tuple(VERBS), 1))
def test_a_verb_loads_what_it_needs(verb: str, tmp_path: Path) -> None:
    root = tmp_path / "ks"
    policy = policies_dir() / "talker_listener.xml"
    sros("generate_artifacts", "-k", root, "-p", policy).ok()
    question = ("/talker_listener/talker", "publish", "/x") if verb == "explain" else ()
    done = python("-c", _VERB, verb, root, *question, status=None)
    collections, *loaded = done.stderr.splitlines()[-1].split()
    assert "sros_tool.keystore.reader" in loaded
    assert not {*VERBS[verb]} & {*loaded}
    assert int(collections) < 10, "nearly all objects stay, and are searched for garbage"


def test_what_writes_is_seen_by_this_search() -> None:
    assert "sros_tool.keystore.transaction" in loaded_by("sros_tool.keystore.lifecycle.renew")
