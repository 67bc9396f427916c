"""A short run of the fuzzer, and that it notices what it looks for."""

from __future__ import annotations

import random
import time
from pathlib import Path

import pytest

from tests.fuzz import runner
from tests.fuzz.corpus import Corpus, make_corpus
from tests.fuzz.readers import READERS, Place, Reader
from tests.support.children import LONG
from tests.support.long_form import some

COUNT = 20_000 if LONG else 500


@pytest.fixture(scope="module")
def corpus(tmp_path_factory: pytest.TempPathFactory) -> Corpus:
    return make_corpus(tmp_path_factory.mktemp("corpus"))


@pytest.mark.parametrize("name", some([*runner.WEIGHTS], 10))
def test_fuzz(name: str, corpus: Corpus) -> None:
    count = runner.shares(COUNT, list(runner.WEIGHTS))[name]
    findings = runner.try_range(name, corpus, range(count), "short", lambda _: None)
    assert findings.found == {}
    assert findings.tried == count


@pytest.mark.parametrize("name", READERS)
def test_the_whole_documents_are_read(name: str, corpus: Corpus, tmp_path: Path) -> None:
    reader = READERS[name]
    reader.read(corpus.read(*reader.corpus)[0], Place(corpus, tmp_path))


def test_inputs_depend_on_their_seed_alone(corpus: Corpus, tmp_path: Path) -> None:
    attempt = runner.attempts("policy", corpus, tmp_path)
    first, second, third = (attempt(random.Random(seed))[0] for seed in ("a", "a", "b"))
    assert first == second != third


def _waste(_data: bytes, _place: Place) -> None:
    began = time.process_time()
    while time.process_time() - began < 0.3:
        pass


@pytest.mark.parametrize(
    ("read", "fault"),
    [
        (lambda data, place: 1 // 0, "ZeroDivisionError"),
        (lambda data, place: bytearray(b"x" * (300 << 20)), "takes too much memory"),
        (_waste, "takes too much CPU"),
    ],
)
def test_what_is_wrong_is_found(
    read: object, fault: str, corpus: Corpus, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runner, "MOST_CPU", 0.2)
    monkeypatch.setitem(READERS, "policy", Reader(read, ("policy.xml",)))  # type: ignore[arg-type]
    findings = runner.try_range("policy", corpus, range(1), "", lambda _: None)
    assert any(fault in each for each in findings.found), findings.found
