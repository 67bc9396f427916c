"""Bad input ends with status 1 or 2 and one paragraph, and leaves every file as it was."""

from __future__ import annotations

import errno
import json
import os
import pickle
import resource
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec, ed25519

from sros_tool.pki import smime
from sros_tool.pki.certificates import common_name, issue_ca, pem
from sros_tool.pki.keys import generate_key, key_pem, load_key
from sros_tool.runtime.environment import render_refusal
from sros_tool.validity import Window
from tests.support.children import LONG
from tests.support.harness import (
    Ended,
    copy_of,
    forked,
    policy_text,
    publish,
    snapshot,
    sros,
    with_includes,
)
from tests.support.long_form import drawn, some, sometimes
from tests.support.users import as_users_of_sros

Words = list[object]
Files = dict[str, tuple[int, bytes]]

GOOD = policy_text({"/a": publish("good")})
NOBODY = 65534


def check_refused(ended: Ended, why: str) -> None:
    assert ended.status in (1, 2), ended
    assert ended.out in ("", render_refusal("sh")), ended  # the latter is of `env`
    assert ended.err.strip(), ended
    assert ended.err.count("\n") == 1, f"not one paragraph: {ended.err}"
    assert "Traceback" not in ended.err
    assert "defect of sros" not in ended.err
    assert why in ended.err


def check_unchanged(folder: Path, before: Files) -> None:
    after = snapshot(folder)
    assert after.keys() == before.keys()
    assert after == before


# ── files ──────────────────────────────────────────────────────────────────────────────────


def _too_large(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(17 * 1024 * 1024)


def _circle(path: Path) -> None:
    path.symlink_to(path.with_name("other"))
    path.with_name("other").symlink_to(path)


NOT_FILES: dict[str, tuple[Callable[[Path], object], str]] = {
    "missing": (lambda path: None, "does not exist"),
    "a folder": (Path.mkdir, "not a regular file"),
    "empty": (Path.touch, ""),
    "binary": (lambda path: path.write_bytes(os.urandom(2000) + b"\0"), ""),
    "Latin-1": (lambda path: path.write_bytes(b"<policy a='\xe9'/>"), ""),
    "UTF-16 cut short": (lambda path: path.write_bytes("<p/>".encode("utf-16")[:-1]), ""),
    "null bytes": (lambda path: path.write_bytes(bytes(100)), ""),
    "too large": (_too_large, "too large"),
    "a FIFO": (os.mkfifo, "not a regular file"),
    "/dev/zero": (lambda path: path.symlink_to("/dev/zero"), "not a regular file"),
    "a link to nothing": (lambda path: path.symlink_to("nowhere"), "does not exist"),
    "a link to itself": (_circle, "does not exist"),
    "below a file": (lambda path: path.parent.joinpath("f").touch(), ""),
}


@pytest.mark.parametrize("what", ["policy", "template", "inspect", "authority"])
@pytest.mark.parametrize("kind", NOT_FILES)
def test_file(what: str, kind: str, keystore: Path, tmp_path: Path) -> None:
    make, why = NOT_FILES[kind]
    path = tmp_path / ("f/below.xml" if kind == "below a file" else "file.xml")
    make(tmp_path / "file.xml")
    words: dict[str, Words] = {
        "policy": ["create_permission", keystore, "/a", path],
        "template": ["create_keystore", tmp_path / "new", "--template", path],
        "inspect": ["inspect", path],
        "authority": ["inspect", keystore / "enclaves/a/permissions.p7s", "--ca", path],
    }
    if kind == "a folder":
        others = {"inspect": "neither a keystore nor an enclave", "policy": "holds no policy"}
        why = others.get(what, why)
    before = snapshot(tmp_path)
    check_refused(sros(*words[what]), why)
    check_unchanged(tmp_path, before)


@pytest.mark.parametrize(
    "name",
    ["new\nline.xml", "‮lmx.olleh", "a b.xml", "\udcff.xml", "-p.xml", "x" * 255, "x" * 300],
)
def test_file_with_an_odd_name(name: str, keystore: Path, tmp_path: Path) -> None:
    before = snapshot(tmp_path)
    check_refused(sros("create_permission", keystore, "/a", tmp_path / name), "")
    check_unchanged(tmp_path, before)
    if len(name) < 256:
        (tmp_path / name).write_text(GOOD)
        sros("create_permission", keystore, "/a", tmp_path / name).ok()


# ── policies ───────────────────────────────────────────────────────────────────────────────


def _groups(groups: str) -> str:
    return policy_text({"/a": groups})


def _topic(name: str) -> str:
    return _groups(publish(name))


def _include(attributes: str, content: str = "") -> str:
    return with_includes(_groups(f"<xi:include {attributes}>{content}</xi:include>"))


_PARTS = 'xpointer="xpointer(/profile/*)"'
_LAUGHS = "".join(
    f'<!ENTITY l{n} "{f"&l{n - 1};" * 10}">' if n else '<!ENTITY l0 "ha">' for n in range(10)
)
POLICIES: dict[str, tuple[str | Callable[[], str], str]] = {
    "another root": ("<robot/>", "not a policy"),
    "a fragment": ("<profile/>", "fragment"),
    "cut short": (GOOD[:-20], "not well-formed"),
    "end tag of another case": ("<Policy></policy>", "mismatch: Policy line 1 and policy"),
    "two roots": (GOOD + GOOD, "not well-formed"),
    "too deep": (lambda: "<a>" * 100_000 + "</a>" * 100_000, "not well-formed"),
    "DOCTYPE": ("<!DOCTYPE policy>" + GOOD, "document type"),
    "external DTD": ('<!DOCTYPE policy SYSTEM "file:///etc/passwd">' + GOOD, "document type"),
    "remote DTD": ('<!DOCTYPE policy SYSTEM "http://127.0.0.1:9/x">' + GOOD, "document type"),
    "billion laughs": (f"<!DOCTYPE policy [{_LAUGHS}]>" + _topic("&l9;"), ""),
    "billion laughs in an attribute": (
        f"<!DOCTYPE policy [{_LAUGHS}]>" + GOOD.replace("/a", "/&l9;"),
        "",
    ),
    "unknown entity": (_topic("&nbsp;"), "not well-formed"),
    "unknown encoding": ('<?xml version="1.0" encoding="klingon"?>' + GOOD, "not well-formed"),
    "no version": (GOOD.replace(' version="0.2.0"', ""), "version"),
    "version 0.1.0": (GOOD.replace("0.2.0", "0.1.0"), "write each <profile> into"),
    "nodes in place of enclaves": ("<profiles/>", "write each <profile> into"),
    "version 9": (GOOD.replace("0.2.0", "9"), "'9'"),
    "version 0.2.x": (GOOD.replace("0.2.0", "0.2.x"), "'0.2.x'"),
    "version with a space": (GOOD.replace("0.2.0", "0.2.0 "), "'0.2.0 '"),
    "two <enclaves>": (GOOD.replace("</policy>", "<enclaves/></policy>"), "exactly one"),
    "no <enclaves>": ('<policy version="0.2.0"/>', "exactly one"),
    "no enclave": ('<policy version="0.2.0"><enclaves/></policy>', "no enclave"),
    "unknown element": (_groups("<parameters/>"), "<parameters>"),
    "unknown attribute": (GOOD.replace("<profile ", '<profile typ="x" '), "'typ'"),
    "unknown right": (_groups('<topics write="ALLOW"><topic>x</topic></topics>'), "'write'"),
    "right of another kind": (_groups('<topics reply="ALLOW"><topic>x</topic></topics>'), "reply"),
    "lower case": (_groups('<topics publish="allow"><topic>x</topic></topics>'), "'allow'"),
    "item of another kind": (
        _groups('<topics publish="ALLOW"><service>x</service></topics>'),
        "<service>",
    ),
    "namespace of elements": (GOOD.replace("<policy", '<policy xmlns="urn:x"'), "not a policy"),
    "enclave twice": (
        policy_text({"/a": publish("x")}) * 0
        + GOOD.replace(
            "</enclaves>",
            GOOD[GOOD.index("<enclave path") : GOOD.index("</enclaves>")] + "</enclaves>",
        ),
        "twice",
    ),
    "enclave without a path": (GOOD.replace(' path="/a"', ""), "path"),
    "enclave with a relative path": (GOOD.replace("/a", "a"), "start with '/'"),
    "enclave in Cyrillic": (GOOD.replace("/a", "/а"), "letters, digits"),
    "enclave without profiles": (
        '<policy version="0.2.0"><enclaves><enclave path="/a"/></enclaves></policy>',
        "no <profiles>",
    ),
    "profiles without a profile": (
        '<policy version="0.2.0"><enclaves><enclave path="/a"><profiles/></enclave></enclaves>'
        "</policy>",
        "no <profile>",
    ),
    "loose text": (GOOD.replace("<topics", "chatter<topics"), "loose text"),
    "loose text at the end": (GOOD.replace("</profile>", "x</profile>"), "loose text"),
    "slash": (_groups('<topics publish="ALLOW"><topic>/</topic></topics>'), "ends with '/'"),
    "no rights": (_groups("<topics><topic>x</topic></topics>"), "allows nor denies"),
    "no names": (_groups('<topics publish="ALLOW"></topics>'), "no topic"),
    "empty name": (_topic(""), "empty"),
    "white space": (_topic(" \t "), "white space"),
    "white space around": (_topic(" x\n"), "white space"),
    "white space inside": (_topic("x y"), "white space"),
    "no-break space": (_topic("x\u00a0y"), "white space"),
    "zero-width space": (_topic("x\u200by"), "not allowed in ROS names"),
    "right-to-left": (_topic("x\u202ey"), "not allowed in ROS names"),
    "umlaut": (_topic("kühler"), "not allowed in ROS names"),
    "full-width letter": (_topic("ｘ"), "not allowed in ROS names"),
    "dot": (_topic("a.b"), "not allowed in ROS names"),
    "hyphen": (_topic("a-b"), "not allowed in ROS names"),
    "substitution": (_topic("$(node)/x"), "not allowed in ROS names"),
    "placeholder": (_topic("{node}/x"), "write {robot}, {namespace}"),
    "home without a slash": (_topic("~x"), "'~'"),
    "home in the middle": (_topic("x/~"), "not allowed in ROS names"),
    "caret set": (_topic("[^a]x"), "vendors interpret"),
    "class": (_topic("[[:digit:]]"), "vendors interpret"),
    "open set": (_topic("[ab"), "not allowed in ROS names"),
    "empty set": (_topic("[]"), "not allowed in ROS names"),
    "backward range": (_topic("[z-a]"), "in reverse order"),
    "double slash": (_topic("/a//b"), "//"),
    "slash at the end": (_topic("/a/"), "ends with"),
    "only a slash": (_topic("/"), "ends with"),
    "digit first": (_topic("/a/1b"), "starts with a digit"),
    "element in a name": (_topic("a<b/>c"), "It contains <b>, and a name is text."),
    "include in a name": (
        _topic('<i:include xmlns:i="http://www.w3.org/2001/XInclude" href="a"/>'),
        "It contains <include>, and a name is text.",
    ),
    "attribute on a name": (
        _groups('<topics publish="ALLOW"><topic type="x">x</topic></topics>'),
        "'type'",
    ),
    "private name, no node": (
        GOOD.replace('node="n"', 'node=""').replace("good", "~/x"),
        "private",
    ),
    "no node": (GOOD.replace(' node="n"', ""), "node="),
    "no ns": (GOOD.replace(' ns="/"', ""), "ns="),
    "slash in the node": (GOOD.replace('node="n"', 'node="a/b"'), "not a valid node name"),
    "tilde as the node": (GOOD.replace('node="n"', 'node="~"'), "not a valid node name"),
    "hyphen in the node": (GOOD.replace('node="n"', 'node="a-b"'), "not a valid node name"),
    "a node name that ROS refuses": (
        GOOD.replace('node="n"', f'node="{"n" * 256}"'),
        "It has 256 characters, more than 255",
    ),
    "relative ns": (GOOD.replace('ns="/"', 'ns="a"'), "starts with '/'"),
    "double slash as ns": (GOOD.replace('ns="/"', 'ns="//"'), "not a valid namespace"),
    "dots in ns": (GOOD.replace('ns="/"', 'ns="/../x"'), "not a valid namespace"),
    "metadata in the middle": (
        GOOD.replace("<profile ", "<metadata/><profile "),
        "nothing may follow",
    ),
    "include of nothing": (_include('href="missing.xml"'), "does not exist"),
    "include outside": (_include('href="../outside.xml"'), "leaves the folder"),
    "include of an absolute path": (_include('href="/etc/passwd"'), "leaves the folder"),
    "include, encoded": (_include('href="%2e%2e/outside.xml"'), "leaves the folder"),
    "include of a null byte": (_include('href="%00"'), "is not a valid path"),
    "include of a URL": (_include('href="http://127.0.0.1:9/x.xml"'), "leaves the folder"),
    "include of a file URL": (_include('href="file:///etc/passwd"'), "leaves the folder"),
    "include through a link": (_include('href="link.xml"'), "leaves the folder"),
    "include of a folder": (_include('href="."'), "not a regular file"),
    "include of a FIFO": (_include('href="fifo"'), "not a regular file"),
    "include of links in a circle": (_include('href="circle"'), "does not exist"),
    "include of a long name": (
        _include(f'href="{"x" * 300}"'),
        "' cannot be read. File name too long",
    ),
    "include of text": (_include('href="part.xml" parse="text"'), "plain text"),
    "include of itself": (
        _include('xpointer="xpointer(/policy/enclaves/enclave/profiles/profile/*)"'),
        "back to itself",
    ),
    "include of its root": (_include('href=""'), "<policy>"),
    "include below xml:base": (_include('href="part.xml" xml:base="x/"'), "is below an xml:base"),
    "include of an xml:base": (
        _include(f'href="base.xml" {_PARTS}'),
        "base.xml:1: the include of 'part.xml'",
    ),
    "include from a link": (_include(f'href="inner.xml" {_PARTS}'), "included by a link"),
    "include up and down": (_include('href="x/../part.xml"'), "Write the shortest path"),
    "include of a fragment": (_include('href="part.xml#x"'), "is not a plain path"),
    "include of a long path": (
        lambda: _include(f'href="{"a/" * 1_000_000}"'),
        "is not a valid path",
    ),
    "include with more in it": (
        _include('href="part.xml"', "<xi:fallback/><xi:fallback/>"),
        "only one <fallback>",
    ),
    "includes of one file": (
        with_includes(_groups(f'<xi:include href="many.xml" {_PARTS}/>' * 30)),
        "too large",
    ),
    "a name without end": (lambda: _topic("a/" * 1_000_000 + "a"), "has 2000001 characters"),
    "many elements": (
        lambda: GOOD.replace("<topics", "<a/>" * 400_000 + "<topics"),
        "too large",
    ),
    "include in a circle": (
        _include('href="round.xml" xpointer="xpointer(/profile/*)"'),
        "back to itself",
    ),
    "loose text that is included": (
        _include(f'href="loose.xml" {_PARTS}'),
        "loose.xml:2: <profile> contains loose text. 'chatter' is",
    ),
    "loose text in an include": (_include(f'href="part.xml" {_PARTS}', "x"), "loose text"),
    "loose text in a fallback": (
        _include('href="missing.xml"', f"<xi:fallback>x{publish('x')}</xi:fallback>"),
        "<fallback> contains loose text",
    ),
    "include of a broken file": (_include('href="broken.xml"'), "not well-formed"),
    "include of an entity": (_include('href="entity.xml"'), "document type"),
    "fallback that is wrong": (
        _include('href="missing.xml"', "<xi:fallback><nonsense/></xi:fallback>"),
        "<nonsense>",
    ),
    **{
        f"xpointer {pointer}": (_include(f'href="part.xml" xpointer="{pointer}"'), "xpointer")
        for pointer in (
            "element(/1)",
            "xpointer(",
            "xpointer()",
            "xpointer(//[)",
            "xpointer(1)",
            "xpointer(string(/))",
            "xpointer(//@ns)",
            "xpointer(//text())",
            "xpointer(/nothing)",
            "xpointer(document('/etc/passwd'))",
            "xpointer(unknown())",
            "xpointer(//topics)",
            "xpointer(/profile/*[count(//*[count(//*[count(//*)>1])>1])>1])",
            "xpointer($x)",
            "xpointer(x:y)",
        )
    },
    "a long xpointer": (
        lambda: _include(f'href="part.xml" xpointer="xpointer(/profile/*{"/*" * 1_000_000})"'),
        "xpointer",
    ),
}
"""Policies, or functions that return large ones only when they are tried, with what is said."""


MANY = "".join(f"<topic>t{number}</topic>" for number in range(8000))
"""Topics of which thirty times as many are more than a policy may have."""


@pytest.fixture
def includes(tmp_path: Path) -> Path:
    """A folder with files to include, some of which cannot be."""
    folder = tmp_path / "policies"
    folder.mkdir()
    (tmp_path / "outside.xml").write_text(f"<profile>{publish('x')}</profile>")
    (folder / "part.xml").write_text(f"<profile>{publish('x')}</profile>")
    (folder / "link.xml").symlink_to("../outside.xml")
    (folder / "loose.xml").write_text(f"<!-- 1 -->\n<profile>{publish('x')}chatter</profile>")
    (folder / "broken.xml").write_text("<profile>")
    (folder / "entity.xml").write_text("<!DOCTYPE profile><profile/>")
    (folder / "round.xml").write_text(
        '<profile xmlns:xi="http://www.w3.org/2001/XInclude">'
        '<xi:include href="round.xml" xpointer="xpointer(/profile/*)"/></profile>'
    )
    (folder / "base.xml").write_text(
        '<profile xmlns:xi="http://www.w3.org/2001/XInclude" xml:base="x/">'
        '<xi:include href="part.xml"/></profile>'
    )
    (folder / "inner.xml").symlink_to("round.xml")
    (folder / "many.xml").write_text(f'<profile><topics publish="ALLOW">{MANY}</topics></profile>')
    os.mkfifo(folder / "fifo")
    (folder / "circle").symlink_to("circle")
    return folder


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(case, marks=sometimes(case)) if case == "includes of one file" else case
        for case in some([*POLICIES], 30)
    ],
)
def test_policy(case: str, keystore: Path, includes: Path, tmp_path: Path) -> None:
    text, why = POLICIES[case]
    policy = includes / "policy.xml"
    policy.write_text(text if isinstance(text, str) else text())
    before = snapshot(tmp_path)
    verbs: list[tuple[object, ...]] = [
        ("create_permission", keystore, "/a", policy),
        ("generate_artifacts", "-k", keystore, "-p", policy),
    ]
    for words in verbs if LONG else [verbs[drawn(case, 1 / 2)]]:
        check_refused(sros(*words), why)
    check_unchanged(tmp_path, before)


@pytest.mark.parametrize(
    "text",
    [
        GOOD,
        _topic("/*"),
        _topic("[!a-c]x?"),
        GOOD.replace('ns="/"', 'ns=""'),
        GOOD.replace("<topics", "<!-- c --><topics"),
        GOOD.replace("</profiles>", "<metadata><x>y</x></metadata></profiles>"),
        _include('href="part.xml" xpointer="xpointer(/profile/*)"'),
        _include('href="./part.xml" xpointer="xpointer(/profile/topics)" parse="xml"'),
        _include('href="missing.xml"', f"<xi:fallback>{publish('x')}</xi:fallback>"),
    ],
)
def test_policy_that_is_good(text: str, keystore: Path, includes: Path) -> None:
    policy = includes / "policy.xml"
    policy.write_text(text)
    sros("create_permission", keystore, "/a", policy).ok()


# ── names, domains, durations ──────────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    "name",
    [
        *("", "/", "a", "//", "/a/", "/a//b", "/1a", "/a b", "/a\n", "/ä", "/a\u202eb", "/a;rm"),
        *("/$HOME", "/a*", "/a[b]", "/.", "/..", "/a/..", "/-a", "/a-b", "/%2e%2e", "/a\\b"),
        "/" + "x" * 64,
    ],
)
def test_enclave_name(name: str, keystore: Path, tmp_path: Path) -> None:
    if name == "/":
        sros("create_enclave", keystore, name).ok()
        return
    before = snapshot(tmp_path)
    for words in (
        ["create_enclave", keystore, name],
        ["create_enclave", keystore, "/fine", name],
        ["generate_artifacts", "-k", keystore, "-e", name],
        ["distribute_key", keystore, name, tmp_path / "out"],
        ["env", keystore, name],
        ["run", keystore, name, "--", "true"],
    ):
        check_refused(sros(*words), "not a valid enclave name" if name else "")
    check_unchanged(tmp_path, before)


@pytest.mark.parametrize(
    "domain",
    [
        *("99999", "231", " 7 ", "-1", "7-3", "", "a", "1.0", "1e2", "0x1", "+1", "1,", ",1"),
        *("1,,2", "1-", "-", "1-2-3", "0-231", "1;2", "1 2", "²", "٣", "9" * 400),
    ],
)
def test_domain(domain: str, keystore: Path, tmp_path: Path) -> None:
    before = snapshot(tmp_path)
    check_refused(sros("create_keystore", tmp_path / "new", f"--domain={domain}"), "")
    check_refused(sros("env", keystore, "/a", f"--domain={domain}"), "")
    if domain:  # in the environment, empty is unset
        for verb in (["create_keystore", tmp_path / "new"], ["create_enclave", keystore, "/c"]):
            check_refused(sros(*verb, env={"ROS_DOMAIN_ID": domain}), "")
    check_unchanged(tmp_path, before)


@pytest.mark.parametrize("domain", ["010", "00", "0,1", "1-2"])
def test_domain_of_the_environment_that_rcl_reads_otherwise(domain: str, tmp_path: Path) -> None:
    ended = sros("create_keystore", tmp_path / "new", env={"ROS_DOMAIN_ID": domain})
    check_refused(ended, "not a domain id")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "duration",
    ["", "0d", "-1d", "1", "d", "1 d", "1.5d", "1D", "1mo", "101y", "9" * 30 + "s", "٣d", "1d1h"],
)
@pytest.mark.parametrize("option", ["--ca-validity", "--validity", "--permissions-validity"])
def test_duration(option: str, duration: str, tmp_path: Path) -> None:
    check_refused(sros("create_keystore", tmp_path / "new", f"{option}={duration}"), "a duration")
    assert not list(tmp_path.iterdir())


# ── templates ──────────────────────────────────────────────────────────────────────────────

TEMPLATE = """
description = "é 😀 \\u007f"
[authorities]
layout = "separate"
name = "me"
validity = "10y"
[certificates]
validity = "1001h"
[permissions]
validity = "3600001s"
default = "everything"
[protection]
rtps = "SIGN"
discovery = "ENCRYPT"
liveliness = "ENCRYPT"
[protection.default]
data = "ENCRYPT"
[[protection.topic]]
names = ["/camera/*"]
data = "SIGN"
"""

TEMPLATES: dict[str, tuple[str, str, str]] = {
    "not TOML": ("[authorities]", "[authorities", "not valid TOML"),
    "a key twice": ('rtps = "SIGN"', 'rtps = "SIGN"\nrtps = "NONE"', "not valid TOML"),
    "unknown table": ("[authorities]", "[x]\n[authorities]", "x is not a known key"),
    "unknown key": ('rtps = "SIGN"', 'rtps = "SIGN"\nrtsp = "NONE"', "protection.rtsp"),
    "unknown key of a topic": ('data = "SIGN"', 'dta = "SIGN"', "dta"),
    "missing key": ('layout = "separate"', "", "authorities.layout"),
    "missing table": ("[certificates]\n", "", ""),
    "number for text": ('name = "me"', "name = 7", "not a str"),
    "text for a table": ("[certificates]", 'certificates = "x"\n[other]', ""),
    "text for a flag": ("[protection.default]", '[protection.default]\ndiscovery = "yes"', "bool"),
    "number for a flag": ("[protection.default]", "[protection.default]\ndiscovery = 1", "bool"),
    "table for a list": ("[[protection.topic]]", "[protection.topic]", "[[protection.topic]]"),
    "text for a list": ('names = ["/camera/*"]', 'names = "/camera/*"', "not a list"),
    "empty list": ('names = ["/camera/*"]', "names = []", "not a list"),
    "numbers in a list": ('names = ["/camera/*"]', "names = [1]", "not a list"),
    "bad name": ('"/camera/*"', '"/camera//*"', "not a valid topic name"),
    "private name": ('"/camera/*"', '"~/x"', "private"),
    "bad duration": ('validity = "10y"', 'validity = "10 years"', "authorities.validity"),
    "bad layout": ('"separate"', '"triple"', "'triple'"),
    "bad level": ('rtps = "SIGN"', 'rtps = "sign"', "'sign'"),
    "level that data has not": (
        'data = "ENCRYPT"',
        'data = "ENCRYPT_WITH_ORIGIN_AUTHENTICATION"',
        "protection.default.data",
    ),
    "bad default": ('default = "everything"', 'default = "nothing"', "'nothing'"),
    "path as the default": ('default = "everything"', 'default = "../x"', "'../x'"),
    "strangers with rtps": (
        "[protection]",
        "[protection]\nallow_unauthenticated_participants = true",
        "allow_unauthenticated",
    ),
    "empty CA name": ('name = "me"', 'name = ""', "authorities.name"),
    "long CA name": ('name = "me"', f'name = "{"x" * 41}"', "authorities.name"),
    "line break in a CA name": ('name = "me"', 'name = "a\\nb"', "authorities.name"),
}


@pytest.mark.parametrize("case", TEMPLATES)
def test_template(case: str, tmp_path: Path) -> None:
    old, new, why = TEMPLATES[case]
    assert old in TEMPLATE
    path = tmp_path / "mine.toml"
    path.write_text(TEMPLATE.replace(old, new, 1))
    before = snapshot(tmp_path)
    check_refused(sros("create_keystore", tmp_path / "new", "--template", path), why)
    check_unchanged(tmp_path, before)


def test_template_that_is_good_is_kept_by_the_keystore(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(TEMPLATE)
    sros("create_keystore", tmp_path / "new", "--template", path).ok()
    sros("create_enclave", tmp_path / "new", "/a").ok()


def test_template_that_does_not_exist(tmp_path: Path) -> None:
    check_refused(sros("create_keystore", tmp_path / "new", "--template", "prodcution"), "sros has")
    assert not list(tmp_path.iterdir())


# ── keystores ──────────────────────────────────────────────────────────────────────────────


def _edit(path: Path, old: bytes, new: bytes) -> None:
    data = path.read_bytes()
    assert old in data
    path.unlink()  # it may be a link, or shared with other tests
    path.write_bytes(data.replace(old, new, 1))


def _encrypt(keystore: Path) -> None:
    path = keystore / "private/identity_ca.key.pem"
    key = load_key(path.read_bytes(), "")
    encrypted = serialization.BestAvailableEncryption(b"secret")
    form = serialization.PrivateFormat.PKCS8
    path.write_bytes(key.private_bytes(serialization.Encoding.PEM, form, encrypted))


def _expire(keystore: Path, role: str) -> None:
    key = load_key((keystore / f"private/{role}_ca.key.pem").read_bytes(), "")
    end = datetime.now(UTC) - timedelta(days=1)
    certificate = issue_ca(key, common_name("old"), Window(end - timedelta(days=9), end))
    (keystore / f"public/{role}_ca.cert.pem").write_bytes(pem(certificate))


def _resign_governance(keystore: Path, role: str) -> None:
    """Governance that is fine, but for who signed it."""
    document = (keystore / "enclaves/governance.xml").read_bytes()
    path = keystore / f"public/{role}_ca.cert.pem"
    key = load_key((keystore / f"private/{role}_ca.key.pem").read_bytes(), "")
    message = smime.sign(document, x509.load_pem_x509_certificate(path.read_bytes()), key)
    (keystore / "enclaves/governance.p7s").write_bytes(message)


def _other_kind_of_key(keystore: Path) -> None:
    key = ed25519.Ed25519PrivateKey.generate().private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )
    (keystore / "private/identity_ca.key.pem").write_bytes(key)


def _replace(path: Path, make: Callable[[Path], object]) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink()
    make(path)


def _link_out(keystore: Path) -> None:
    outside = keystore.parent / "outside"
    (keystore / "enclaves/b").rename(outside)
    (keystore / "enclaves/b").symlink_to(outside)
    (outside / "permissions.p7s").unlink()


def _mutated_certificate(keystore: Path) -> None:
    """A CA certificate whose key lies on a curve that does not exist."""
    path = keystore / "public/identity_ca.cert.pem"
    der = x509.load_pem_x509_certificate(path.read_bytes()).public_bytes(serialization.Encoding.DER)
    curve = bytes.fromhex("06082a8648ce3d030107")
    assert curve in der
    body = subprocess.run(
        ["openssl", "base64"],
        input=der.replace(curve, curve[:-1] + b"\x7f"),
        capture_output=True,
        check=True,
    ).stdout
    path.write_bytes(b"-----BEGIN CERTIFICATE-----\n" + body + b"-----END CERTIFICATE-----\n")


KEYSTORES: dict[str, tuple[Callable[[Path], object], str]] = {
    "missing": (shutil.rmtree, "not a valid keystore"),
    "empty": (lambda ks: _replace(ks, Path.mkdir), "not a valid keystore"),
    "a file": (lambda ks: _replace(ks, Path.touch), "not a valid keystore"),
    "a link to nothing": (
        lambda ks: _replace(ks, lambda p: p.symlink_to("no")),
        "not a valid keystore",
    ),
    "no CA keys": (lambda ks: shutil.rmtree(ks / "private"), "the key of the identity CA"),
    "no identity CA key": (
        lambda ks: (ks / "private/identity_ca.key.pem").unlink(),
        "the key of the identity CA",
    ),
    "no permissions CA key": (
        lambda ks: (ks / "private/permissions_ca.key.pem").unlink(),
        "the key of the permissions CA",
    ),
    "no CA certificates": (lambda ks: shutil.rmtree(ks / "public"), "does not exist"),
    "no CA": (
        lambda ks: list(map(shutil.rmtree, (ks / "public", ks / "private"))),
        "has no identity CA",
    ),
    "another CA key": (
        lambda ks: (ks / "private/identity_ca.key.pem").write_bytes(key_pem(generate_key())),
        "do not belong together",
    ),
    "CA keys swapped": (
        lambda ks: shutil.copy(
            ks / "private/identity_ca.key.pem", ks / "private/permissions_ca.key.pem"
        ),
        "do not belong together",
    ),
    "encrypted CA key": (_encrypt, "passphrase"),
    "Ed25519 CA key": (_other_kind_of_key, "neither"),
    "empty CA key": (
        lambda ks: (ks / "private/identity_ca.key.pem").write_bytes(b""),
        "is an empty file",
    ),
    "CA key is a folder": (
        lambda ks: _replace(ks / "private/identity_ca.key.pem", Path.mkdir),
        "not a regular file",
    ),
    "CA key is a FIFO": (
        lambda ks: _replace(ks / "private/identity_ca.key.pem", os.mkfifo),
        "not a regular file",
    ),
    "garbage for a CA certificate": (
        lambda ks: (ks / "public/identity_ca.cert.pem").write_bytes(b"garbage"),
        "cannot be read",
    ),
    "CA certificate on no curve": (_mutated_certificate, "do not belong together"),
    "expired identity CA": (lambda ks: _expire(ks, "identity"), "not valid now"),
    "expired permissions CA": (lambda ks: _expire(ks, "permissions"), "not valid now"),
    "tampered governance": (
        lambda ks: _edit(ks / "enclaves/governance.p7s", b"ENCRYPT", b"NONE"),
        "does not match",
    ),
    "governance signed by the identity CA": (
        lambda ks: _resign_governance(ks, "identity"),
        "not by the permissions CA",
    ),
    "unsigned governance": (
        lambda ks: shutil.copy(ks / "enclaves/governance.xml", ks / "enclaves/governance.p7s"),
        "not an S/MIME",
    ),
    "garbage for governance": (
        lambda ks: (ks / "enclaves/governance.p7s").write_bytes(os.urandom(999)),
        "cannot be used",
    ),
    "no governance": (lambda ks: (ks / "enclaves/governance.p7s").unlink(), "does not exist"),
    "garbage for sros.toml": (lambda ks: (ks / "sros.toml").write_bytes(b"\xff="), "TOML"),
    "sros.toml is a folder": (lambda ks: _replace(ks / "sros.toml", Path.mkdir), "regular file"),
    "an enclave outside": (_link_out, "does not follow"),
    "a file for an enclave": (lambda ks: _replace(ks / "enclaves/b", Path.touch), ""),
    "an enclave's key is lost": (lambda ks: (ks / "enclaves/b/key.pem").unlink(), "no key"),
    "an enclave's certificate is garbage": (
        lambda ks: (ks / "enclaves/b/cert.pem").write_bytes(b"garbage"),
        "cannot be read",
    ),
    "an enclave's certificate is of another CA": (
        lambda ks: shutil.copy(ks / "public/permissions_ca.cert.pem", ks / "enclaves/b/cert.pem"),
        "was not issued by",
    ),
}


@pytest.mark.parametrize("case", KEYSTORES)
def test_keystore(case: str, keystore: Path, tmp_path: Path) -> None:
    spoil, why = KEYSTORES[case]
    policy = tmp_path / "policy.xml"
    policy.write_text(policy_text(dict.fromkeys(("/a", "/b", "/c"), publish("x"))))
    spoil(keystore)
    before = snapshot(tmp_path)
    if "valid keystore" in why:
        check_refused(sros("create_enclave", keystore, "/b", "/c"), why)
        check_refused(sros("list_enclaves", keystore), why)
    else:
        check_refused(sros("generate_artifacts", "-k", keystore, "-p", policy), why)
        check_refused(sros("create_enclave", keystore, "/b", "/c"), why)
        check_refused(sros("create_keystore", keystore), "")
    check_unchanged(tmp_path, before)


ENCLAVES: dict[str, tuple[Callable[[Path], object], str]] = {
    **{
        f"no {name}": (lambda folder, name=name: (folder / name).unlink(), f"{name}: missing")  # type: ignore[misc]
        for name in ("cert.pem", "permissions.p7s", "governance.p7s", "identity_ca.cert.pem")
    },
    "no key.pem": (lambda folder: (folder / "key.pem").unlink(), "key.pem: missing"),
    "another key": (
        lambda folder: (folder / "key.pem").write_bytes(key_pem(generate_key())),
        "not the key of cert.pem",
    ),
    "empty key": (lambda folder: (folder / "key.pem").write_bytes(b""), "key.pem: it is empty"),
    "permissions of another enclave": (
        lambda folder: shutil.copy(folder.parent / "b/permissions.p7s", folder),
        "no grant for CN=/a, only for CN=/b",
    ),
    "tampered permissions": (
        lambda folder: _edit(folder / "permissions.p7s", b"rt/old_a", b"rt/new_a"),
        "does not match",
    ),
    "permissions signed by itself": (lambda folder: _sign_own(folder), "not by the permissions CA"),
    "unsigned permissions": (
        lambda folder: shutil.copy(folder / "permissions.xml", folder / "permissions.p7s"),
        "not an S/MIME",
    ),
    "garbage for a CRL": (lambda folder: (folder / "crl.pem").write_text("x"), "crl.pem"),
    "a link to nothing": (
        lambda folder: _replace(folder / "cert.pem", lambda path: path.symlink_to("no")),
        "broken link",
    ),
    "a damaged certificate after that of the CA": (
        lambda folder: _add_damaged(folder / "identity_ca.cert.pem"),
        "certificate after the first one is damaged",
    ),
}


def _add_damaged(path: Path) -> None:
    data = path.read_bytes()
    path.unlink()
    path.write_bytes(
        data + b"-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n",
    )


def _sign_own(folder: Path) -> None:
    document = (folder / "permissions.xml").read_bytes()
    certificate = x509.load_pem_x509_certificate((folder / "cert.pem").read_bytes())
    key = load_key((folder / "key.pem").read_bytes(), "")
    (folder / "permissions.p7s").write_bytes(smime.sign(document, certificate, key))


@pytest.mark.parametrize("case", ENCLAVES)
def test_enclave_that_cannot_run(case: str, keystore: Path, tmp_path: Path) -> None:
    spoil, why = ENCLAVES[case]
    sros("env", keystore, "/a").ok()
    spoil(keystore / "enclaves/a")
    before = snapshot(tmp_path)
    check_refused(sros("env", keystore, "/a"), why)
    check_refused(sros("run", keystore, "/a", "--", "touch", tmp_path / "ran"), why)
    check_refused(sros("distribute_key", keystore, "/a", tmp_path / "out"), why)
    check_unchanged(tmp_path, before)
    assert '"/b"' in sros("view", keystore, "--json").ok().out
    inspected = sros("inspect", keystore, "--json")
    assert inspected.status == 1
    assert any(why in problem for problem in json.loads(inspected.out)["problems"])


@pytest.mark.parametrize("target", [".", "..", "../..", "/", "/etc/hostname", "a/b"])
@pytest.mark.parametrize("role", ["identity", "permissions"])
def test_a_link_for_a_ca_certificate(role: str, target: str, keystore: Path) -> None:
    _replace(keystore / f"public/{role}_ca.cert.pem", lambda path: path.symlink_to(target))
    check_refused(sros("rotate_ca", keystore), f"has no {role} CA")


# ── targets of an export ───────────────────────────────────────────────────────────────────


def _other_keystore(path: Path) -> None:
    sros("create_keystore", path).ok()


def _export_of_another(path: Path) -> None:
    sros("create_keystore", path.with_name("other")).ok()
    sros("create_enclave", path.with_name("other"), "/z").ok()
    sros("distribute_key", path.with_name("other"), "/z", path).ok()


TARGETS: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "the keystore": ("ks", lambda path: None, "keystore itself"),
    "in the keystore": ("ks/out", lambda path: None, "keystore itself"),
    "through a link": ("link/out", lambda path: path.parent.symlink_to("ks"), "keystore itself"),
    "another keystore": ("new", _other_keystore, "CA keys"),
    "an export of another keystore": ("new", _export_of_another, "another keystore"),
    "a file": ("new", Path.touch, "in the way"),
    "a link to nothing": ("new", lambda path: path.symlink_to("no"), "in the way"),
    "a link to itself": ("new", lambda path: path.symlink_to("new"), "in the way"),
    "below a file": ("file/new", lambda path: path.parent.touch(), ""),
    "an archive that is a folder": ("new.tar.gz", Path.mkdir, "in the way"),
    "an archive that is a FIFO": ("new.tar.gz", os.mkfifo, "in the way"),
    "an archive that is another file": ("new.tar.gz", Path.touch, "already exists"),
    "an archive in a folder that is missing": ("no/new.tar.gz", lambda path: None, ""),
}


@pytest.mark.parametrize("case", TARGETS)
def test_target(case: str, keystore: Path, tmp_path: Path) -> None:
    name, make, why = TARGETS[case]
    target = tmp_path / name
    make(target)
    before = snapshot(tmp_path)
    check_refused(sros("distribute_key", keystore, "/a", target), why)
    check_unchanged(tmp_path, before)


# ── wrong usage ────────────────────────────────────────────────────────────────────────────

MISUSE: dict[str, tuple[str, str]] = {
    "no such verb": ("fly x", "No such command"),
    "a mistyped verb": ("create-keystor x", "Did you mean 'create_keystore'?"),
    "no such option": ("create_keystore new --frobnicate", "No such option"),
    "no keystore": ("create_enclave", ""),
    "empty keystore": ("create_keystore ''", "empty"),
    "no enclave": ("create_enclave ks", "no enclave"),
    "a keystore too many": ("create_keystore new newer", "unexpected extra"),
    "no policy": ("create_permission ks /a", "takes"),
    "two policies": (
        "create_permission ks /a p.xml p.xml",
        "'p.xml' stands where an enclave belongs",
    ),
    "the enclave first": ("create_permission /a ks p.xml", "'/a' stands where the keystore"),
    "the enclave last": ("create_permission ks p.xml /a", "'p.xml' stands where an enclave"),
    "the keystore last": ("create_permission ks /a ks", "'ks' stands where the policy file"),
    "the policy first": ("create_permission p.xml ks /a", "'p.xml' stands where the keystore"),
    "an absolute keystore that is missing": ("create_permission /x/ks /a p.xml", "does not exist"),
    "empty policy": ("create_permission ks /a ''", "empty"),
    "enclave that is missing": ("create_permission ks /c p.xml", "does not exist"),
    "enclave not in the policy": ("create_permission ks /b p.xml", "unable to find enclave /b"),
    "nothing to generate": ("generate_artifacts -k ks", "neither"),
    "option without a value": (
        "generate_artifacts -k ks -e",
        "requires an argument. See `sros generate_artifacts --help`.",
    ),
    "option of a verb's verb without a value": (
        "-v fleet status --robot",
        "See `sros fleet status --help`.",
    ),
    "empty keystore option": ("generate_artifacts -k '' -e /c", "empty"),
    "loose word": ("generate_artifacts -k ks --dry-run -p p.xml -- /c", ""),
    "bad layout": ("create_keystore new --ca-layout triple", "triple"),
    "no target": ("distribute_key ks /a", "takes"),
    "a pattern as an enclave": ("distribute_key ks '/a/*' out", "--match '/a/*'"),
    "a policy as the keystore": ("check keystore p.xml", "It is a file."),
    "two logs": ("explain --log p.txt --log p.xml", "one log"),
    "empty target": ("distribute_key ks /a ''", "empty"),
    "env of nothing": ("env ks", "takes"),
    "env of two": ("env ks /a /b", "takes"),
    "env of a missing enclave": ("env ks /c", "does not exist"),
    "env in another form": ("env ks /a --format powershell", "powershell"),
    "env for another domain": ("env ks /a --domain 7", "for domain 0"),
    "env for an empty domain": ("env ks /a --domain ''", "empty"),
    "run nothing": ("run ks /a", "no command"),
    "run nothing after --": ("run ks /a --", "no command"),
    "run what is not there": ("run ks /a -- no-such-command", "not found"),
    "run a folder": ("run ks /a -- ./ks", "not found"),
    "run a missing enclave": ("run ks /c -- touch ran", "does not exist"),
    "run in another domain": ("run --domain 7 ks /a -- touch ran", "for domain 0"),
    "inspect nothing": ("inspect nothing", "does not exist"),
    "inspect without a path": ("inspect", "Missing argument"),
    "inspect any folder": ("inspect .", "neither"),
    "inspect text": ("inspect p.txt", "neither"),
    "copy onto something": ("policies --copy ks", "already exists"),
    "completion of another shell": ("completion tcsh", "tcsh"),
}


@pytest.mark.parametrize("case", MISUSE)
def test_misuse(case: str, keystore: Path, tmp_path: Path) -> None:
    line, why = MISUSE[case]
    (tmp_path / "p.xml").write_text(GOOD)
    (tmp_path / "p.txt").write_text("hello")
    before = snapshot(tmp_path)
    check_refused(sros(*shlex.split(line), cwd=tmp_path), why)
    check_unchanged(tmp_path, before)


# ── disks and owners ───────────────────────────────────────────────────────────────────────


def program(
    *words: object, preexec: Callable[[], object] | None = None, prefix: tuple[str, ...] = ()
) -> Ended:
    """Run the program in a process of its own."""
    if not prefix:
        return forked(*words, first=preexec)
    command = [*prefix, sys.executable, "-m", "sros_tool", *map(str, words)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    ended = subprocess.run(
        command, env=environment, capture_output=True, text=True, preexec_fn=preexec
    )
    return Ended(ended.returncode, ended.stdout, ended.stderr)


def test_run_of_a_file_that_is_no_program(keystore: Path, tmp_path: Path) -> None:
    noise = tmp_path / "noise"
    noise.write_bytes(bytes(range(256)))
    noise.chmod(0o755)
    check_refused(program("run", keystore, "/a", "--", noise), os.strerror(errno.ENOEXEC))


@pytest.mark.parametrize(
    "line",
    some(
        [
            "create_keystore {}/new",
            "create_enclave {}/ks /c",
            "generate_artifacts -k {}/ks -p {}/p.xml",
            "distribute_key {}/ks /a {}/out",
            "distribute_key {}/ks /a {}/out.tar.gz",
        ],
        2,
    ),
)
@pytest.mark.parametrize("size", [0, 300])
def test_files_that_may_not_grow(line: str, size: int, keystore: Path, tmp_path: Path) -> None:
    (tmp_path / "p.xml").write_text(GOOD)

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))

    words = line.replace("{}", str(tmp_path)).split()
    before = snapshot(tmp_path)
    check_refused(program(*words, preexec=limit), os.strerror(errno.EFBIG))
    check_unchanged(tmp_path, before)
    assert program(*words).status == 0


@as_users_of_sros
@pytest.mark.parametrize(
    ("line", "mode"),
    some(
        [
            ("create_keystore {}/dir/new", 0o555),
            ("create_enclave {}/dir /c", 0o555),
            ("generate_artifacts -k {}/dir -p {}/p.xml", 0o555),
            ("create_enclave {}/dir /c", 0o000),
            ("list_enclaves {}/dir", 0o000),
            ("inspect {}/dir", 0o000),
            ("env {}/dir /a", 0o000),
            ("distribute_key {}/dir /a {}/out", 0o000),
        ],
        3,
    ),
)
def test_folder_without_permission(line: str, mode: int, made_keystore: Path) -> None:
    with tempfile.TemporaryDirectory() as name:  # pytest's own folders are closed to others
        folder = Path(name)
        folder.chmod(0o755)
        if line.startswith("create_keystore"):  # a keystore cannot be in another one
            (folder / "dir").mkdir()
        else:
            copy_of(made_keystore, folder / "dir")
        (folder / "p.xml").write_text(GOOD)
        twin = copy_of(folder, folder / "twin")
        sros(*line.replace("{}", str(twin)).split()).ok()  # imports what nobody cannot read
        for path in [folder / "dir", *(folder / "dir").rglob("*")]:
            os.chown(path, NOBODY, NOBODY, follow_symlinks=False)
        before = snapshot(folder)
        (folder / "dir").chmod(mode)
        ended = as_nobody(*line.replace("{}", str(folder)).split())
        (folder / "dir").chmod(0o755)
        check_refused(ended, str(folder / "dir"))
        assert os.strerror(errno.EACCES) in ended.err or "not readable" in ended.err
        check_unchanged(folder, before)
        folder.chmod(0o777)
        as_nobody(*line.replace("{}", str(folder)).split()).ok()


def as_nobody(*words: object) -> Ended:
    """Run the program in a fork of this process that has no rights."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.setgroups([])
            os.setresgid(NOBODY, NOBODY, NOBODY)
            os.setresuid(NOBODY, NOBODY, NOBODY)
            with os.fdopen(writer, "wb") as pipe:
                pickle.dump(sros(*words), pipe)
        finally:
            os._exit(0)
    os.close(writer)
    with os.fdopen(reader, "rb") as pipe:
        ended: Ended = pickle.load(pipe)
    os.waitpid(child, 0)
    return ended


# ── the ends of the program itself ─────────────────────────────────────────────────────────


@pytest.mark.parametrize(
    ("redirection", "status"),
    [(">&-", 0), ("2>&-", 0), (">&- 2>&-", 0), ("<&-", 0), (">/dev/full", 2)],
)
def test_closed_and_full_outputs(redirection: str, status: int, keystore: Path) -> None:
    command = f'{sys.executable} -m sros_tool list_enclaves "$0" {redirection}'
    ended = subprocess.run(["sh", "-c", command, keystore], capture_output=True, text=True)
    assert ended.returncode == status, ended
    assert ended.stderr.count("\n") == (1 if status else 0)
    assert "defect" not in ended.stderr
    assert "Exception ignored" not in ended.stderr


def test_a_result_that_cannot_be_printed_is_not_told_as_nothing_changed(tmp_path: Path) -> None:
    command = f'{sys.executable} -m sros_tool create_keystore "$0" >/dev/full'
    ended = subprocess.run(["sh", "-c", command, tmp_path / "ks"], capture_output=True, text=True)
    assert ended.returncode == 2
    assert "Nothing was changed" not in ended.stderr
    assert os.strerror(errno.ENOSPC) in ended.stderr
    assert ended.stderr.count("\n") == 1
    assert (tmp_path / "ks/enclaves").is_dir()


def test_a_curve_that_is_not_ours_is_still_a_key(keystore: Path) -> None:
    """The positive twin of the keys that are refused: P-384 works with the vendors."""
    key = ec.generate_private_key(ec.SECP384R1())
    now = datetime.now(UTC)
    for role in ("identity", "permissions"):
        certificate = issue_ca(key, common_name(role), Window(now, now + timedelta(days=9)))
        (keystore / f"private/{role}_ca.key.pem").write_bytes(key_pem(key))
        (keystore / f"public/{role}_ca.cert.pem").write_bytes(pem(certificate))
        shutil.rmtree(keystore / "enclaves/a", ignore_errors=True)
    _resign_governance(keystore, "permissions")
    sros("create_enclave", keystore, "/c").ok()
    sros("env", keystore, "/c").ok()
