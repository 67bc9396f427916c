"""Confirmations of robots: what is in them, and that nothing else is taken from a hostile one."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft202012Validator

from sros_tool.errors import DocumentError, KeystoreError
from sros_tool.keystore.confirmation import (
    CONFIRMED_FILES,
    LONGEST_PROBLEM,
    MAX_BYTES,
    MOST_PROBLEMS,
    MOST_REQUESTS,
    LibraryUse,
    RobotDds,
    RobotLibrary,
    make_confirmation,
    parse_confirmation,
    render_confirmation,
    shortened_dds,
)
from sros_tool.keystore.reader import read_certificate
from sros_tool.pki.certificates import digest
from tests.support.harness import sros
from tools.json_page import SCHEMAS

NOW = datetime(2027, 5, 21, 12, 50, 48, tzinfo=UTC)
DIGEST = "0123456789abcdef" * 4


@pytest.fixture(scope="module")
def export(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An export of two enclaves."""
    folder = tmp_path_factory.mktemp("confirmation")
    sros("generate_artifacts", "-k", "ks", "-e", "/r7/base", "/", cwd=folder).ok()
    sros("distribute_key", "ks", "--all", "robot", cwd=folder).ok()
    return folder / "robot"


def test_a_confirmation_names_all_files_but_keys(export: Path) -> None:
    (export / "enclaves/r7/base/notes.txt").write_text("mine")
    (export / "enclaves/my-backup").mkdir(exist_ok=True)
    (export / "enclaves/my-backup/key.pem").write_text("not an enclave")
    dds = RobotDds((RobotLibrary("Fast DDS", "", "/libfastdds.so", LibraryUse.INSTALLED),) * 102, 3)
    made = replace(make_confirmation(export, "r7", now=NOW), dds=shortened_dds(dds))
    assert made.dds == RobotDds(dds.libraries[:100], 5), "what it does not name counts as unseen"
    wanted = {
        f"{folder}/{file}": hashlib.sha256((export / folder / file).read_bytes()).hexdigest()
        for folder in ("enclaves", "enclaves/r7/base")
        for file in CONFIRMED_FILES
        if (export / folder / file).exists()
    }
    assert made.files == wanted and len(wanted) == 10
    own = read_certificate(export / "enclaves/r7/base/cert.pem")
    assert made.certificates["enclaves/r7/base/cert.pem"] == (digest(own),)
    data = render_confirmation(made)
    assert parse_confirmation(data, "it") == made
    assert "key.pem" not in data.decode() and "notes" not in data.decode()
    schema = json.loads((SCHEMAS / "confirmation.json").read_text())
    Draft202012Validator(schema).validate(json.loads(data))


def test_a_file_that_cannot_be_confirmed_is_an_error(export: Path, tmp_path: Path) -> None:
    folder = tmp_path / "robot/enclaves/a"
    folder.mkdir(parents=True)
    (folder / "cert.pem").write_text("damaged")
    made = make_confirmation(tmp_path / "robot", "r7", now=NOW)
    assert made.certificates == {"enclaves/a/cert.pem": ()}
    (folder / "crl.pem").symlink_to(export / "enclaves/r7/base/cert.pem")
    with pytest.raises(KeystoreError, match="link out of"):
        make_confirmation(tmp_path / "robot", "r7", now=NOW)
    (folder / "crl.pem").unlink()
    os.mkfifo(folder / "crl.pem")
    with pytest.raises(OSError, match="regular file"):
        make_confirmation(tmp_path / "robot", "r7", now=NOW)
    with pytest.raises(DocumentError, match="not the name of a robot"):
        make_confirmation(tmp_path / "robot", "../r7", now=NOW)


PATH = "enclaves/r7/cert.pem"
LIBRARY = {
    "product": "Cyclone DDS",
    "version": "11.0.1",
    "path": "/opt/ros/lyrical/lib/libddsc.so.11.0.1",
    "seen": "process",
}
"""A library without known vulnerabilities."""
DDS: dict[str, Any] = {"libraries": [LIBRARY], "unseen": 0}
VALID: dict[str, Any] = {
    "format": 1,
    "robot": "r7",
    "time": "2027-05-21T12:50:48Z",
    "files": {PATH: DIGEST},
    "certificates": {PATH: [DIGEST]},
    "restart": ["/r7"],
    "crl_restart": [],
    "waiting": ["/r7"],
    "boot": DIGEST,
    "dds": DDS,
    "sequence": 7,
    "release": 0,
    "expiry": {"/r7": {"certificate": "2027-06-21T12:50:48Z", "permissions": None}},
    "running": {"/r7": "not_seen"},
    "clock": "synchronized",
    "problems": ["The disk is full."],
    "requests": ["-----BEGIN CERTIFICATE REQUEST-----\nMA==\n-----END CERTIFICATE REQUEST-----\n"],
}
OF_AGENT = (
    "boot",
    "crl_restart",
    "waiting",
    "sequence",
    "release",
    "expiry",
    "running",
    "clock",
    "problems",
    "requests",
)
OPTIONAL = ("certificates", "restart", "dds", *OF_AGENT)
CONTROLS = "\x1b[2J\x9b\u202e\udc9b\x00\n"
NO_LIBRARIES: Any = {
    "product": ("DDS", "", None, [], CONTROLS),
    "version": ("2.14", "v2.14.5", "1" * 5000, CONTROLS, None, []),
    "path": ("", "lib", "/" * 201, f"/{CONTROLS}", "/a\n", None, []),
    "seen": ("", "both", None, [], {}),
    CONTROLS: (1,),
}
"""Values of a library that nobody may take for one."""


def hostile() -> list[tuple[str, bytes]]:
    """Confirmations that nobody may take for one, each with its name."""
    found: list[tuple[str, bytes]] = [
        ("huge", json.dumps({**VALID, "time": "x" * MAX_BYTES}).encode()),
        ("deep", b"[" * 100_000),
        ("deep files", b'{"format":1,"files":' + b'{"a":' * 50_000),
        ("number", b'{"format":' + b"1" * 100_000 + b"}"),
        ("not UTF-8", b'{"format":1,"robot":"\xff"}'),
        ("no JSON", b"robot: r7"),
        ("empty", b""),
        ("list", b"[]"),
    ]
    faults: dict[str, tuple[object, ...]] = {
        "format": (True, "1", 2, 1.0, None, [1]),
        "robot": (7, "", "a" * 65, "r7/..", "r7\n", "r-7", CONTROLS, None, {}),
        "time": (
            0, "", "2027-05-21", "2027-13-01T00:00:00Z", "0000-00-00T00:00:00Z",
            "2027-05-21T12:50:48+01:00", "2027-05-21T12:50:48Z\n", CONTROLS, None,
        ),
        "files": (
            [], None, "", {PATH: 1}, {PATH: DIGEST.upper()}, {PATH: f"{DIGEST}\n"},
            {PATH: CONTROLS},
            {"enclaves/r7/key.pem": DIGEST}, {"/enclaves/r7/cert.pem": DIGEST},
            {"enclaves/../private/cert.pem": DIGEST}, {"enclaves//cert.pem": DIGEST},
            {"enclaves/r7/../cert.pem": DIGEST}, {"private/cert.pem": DIGEST},
            {"cert.pem": DIGEST}, {"": DIGEST}, {f"enclaves/{CONTROLS}/cert.pem": DIGEST},
            {f"enclaves/r7/{CONTROLS}": DIGEST}, {f"enclaves/{'a' * 65}/cert.pem": DIGEST},
        ),
        "certificates": (
            [], None, {PATH: DIGEST}, {PATH: [1]}, {PATH: [DIGEST] * 33}, {PATH: [CONTROLS]},
            {"enclaves/r7/permissions.p7s": [DIGEST]}, {"enclaves/r8/cert.pem": [DIGEST]},
        ),
        **dict.fromkeys(
            ("restart", "crl_restart", "waiting"),
            ({}, None, "/r7", [1], [[]], [""], ["r7"], ["/r7/.."], [CONTROLS]),
        ),
        "dds": (
            [], None, {}, {"libraries": []}, {**DDS, "more": 1}, {**DDS, "libraries": {}},
            *({**DDS, "unseen": wrong} for wrong in (-1, True, 1.0, "1", 10**9, None)),
            {**DDS, "libraries": [LIBRARY] * 101}, {**DDS, "libraries": [[]]},
            *(
                {**DDS, "libraries": [{**LIBRARY, part: wrong}]}
                for part, wrongs in NO_LIBRARIES.items()
                for wrong in wrongs
            ),
        ),
        "boot": ("", DIGEST[1:], DIGEST.upper(), f"{DIGEST}\n", CONTROLS, None, 1, []),
        "sequence": (0, -1, True, 1.0, "1", 2**53, 10**400, None, []),
        "release": (-1, True, 1.0, "1", 2**53, None, []),
        "expiry": (
            [], None, {"/r7": None}, {"/r7": {}}, {"r7": VALID["expiry"]["/r7"]},
            {"/r7": {"certificate": None}}, {"/r7": {"certificate": None, "permissions": 0}},
            {"/r7": {"certificate": CONTROLS, "permissions": None}},
        ),
        "running": ([], None, {"/r7": "running"}, {"/r7": []}, {"/r7": None}, {"r7": "current"}),
        "clock": ("right", "", None, [], {}, 1),
        "problems": (
            {}, None, "it", [1], [""], [CONTROLS], ["a" * (LONGEST_PROBLEM + 1)],
            ["a"] * (MOST_PROBLEMS + 1),
        ),
        "requests": (
            {}, None, [1], [""], ["x"], VALID["requests"] * (MOST_REQUESTS + 1),
            ["".join(VALID["requests"] * 2)], [VALID["requests"][0] + "\n"], [CONTROLS],
            [VALID["requests"][0].replace("MA==", "MA==" * 5000)],
        ),
        CONTROLS: (1,),
    }  # fmt: skip
    for key, values in faults.items():
        found += [(f"{key} {each!r}"[:60], _json({**VALID, key: each})) for each in values]
        if key in VALID and key not in OPTIONAL:
            found.append((f"no {key}", _json({k: v for k, v in VALID.items() if k != key})))
    return found


def _json(value: object) -> bytes:
    return json.dumps(value).encode()


def test_a_hostile_confirmation_is_refused_in_one_paragraph() -> None:
    valid = parse_confirmation(_json(VALID), "it")
    assert valid.certificates == {PATH: (DIGEST,)}
    assert json.loads(render_confirmation(valid)) == VALID, "all of it is written again"
    schema = json.loads((SCHEMAS / "confirmation.json").read_text())
    Draft202012Validator(schema).validate(VALID)
    without = parse_confirmation(
        _json({key: VALID[key] for key in VALID if key not in OPTIONAL}), "it"
    )
    assert (without.certificates, without.restart, without.dds) == ({}, None, None), (
        "as earlier versions write it"
    )
    assert not any(getattr(without, key) for key in OF_AGENT)
    for later in ({"dds", *OF_AGENT}, {"boot", "crl_restart", "waiting"}):  # than 0.2.0, than 0.3.0
        earlier = {key: value for key, value in VALID.items() if key not in later}
        assert json.loads(render_confirmation(parse_confirmation(_json(earlier), "it"))) == earlier
    with pytest.raises(DocumentError, match="later release of sros, update sros here first"):
        parse_confirmation(_json({**VALID, "of_a_later_release": 1}), "it")
    for name, data in hostile():
        with pytest.raises(DocumentError) as caught:
            parse_confirmation(data, "it")
        text = str(caught.value)
        assert text.isascii() and text.isprintable() and len(text) < 400, name
