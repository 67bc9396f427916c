"""Of a large keystore, what is drawn is the same although equal robots are not all read."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import pytest

from sros_tool.report import sampling
from sros_tool.report.folding import Folding
from sros_tool.report.picture import Picture
from sros_tool.report.sources import PictureRequest, draw
from tests.report.pictures import group
from tests.support.harness import Ended, made_once, policy_text, sros
from tests.support.long_form import some

UNREAD = {"/a4/base", "/a4/nav"}
"""Enclaves of which nothing is read as long as their robot is like the others."""


def publishes(*names: str) -> str:
    return group("topics", "publish", *names)


def subscribes(*names: str) -> str:
    return group("topics", "subscribe", *names)


def families() -> dict[str, str]:
    """Return units with rights of each kind by their first letter, and a dispatcher of many."""
    enclaves: dict[str, str] = {}
    for n in range(1, 7):
        a, b, c, d, e, f = (f"/{letter}{n}" for letter in "abcdef")
        enclaves |= {
            f"{a}/base": publishes(f"{a}/odom", "/fleet/state"),
            f"{a}/nav": subscribes(f"{a}/odom", f"{a}/goal"),
            f"{b}/arm": publishes(f"{b}/pose", *([f"{b}/extra"] if n == 3 else [])),
            f"{c}/tool": subscribes(f"{c}/cmd"),
            f"{d}/peer": subscribes(*(f"/d{other}/pose" for other in range(1, 7))),
            f"{e}/follower": subscribes("/a2/odom"),
            f: publishes(f"/state/of_{f[1:]}"),
        }
    goals = publishes(*(f"/a{n}/goal" for n in range(1, 7)), "/c1/cmd", "/c2/cmd", "/c3/cmd")
    half = publishes(*(f"/c{n}/cmd" for n in range(4, 7))).replace("ALLOW", "DENY")
    return {**enclaves, "/dispatcher": goals + half + subscribes("/fleet/*", "/state/*")}


def make(root: Path) -> None:
    policy = root.with_name("families.xml")
    policy.write_text(policy_text(families()))
    # Its subjects are unique, as those of most keystores.
    words = ("-k", root, "-p", policy, "--template", "production")
    sros("generate_artifacts", *words).ok()


@pytest.fixture
def large(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A keystore of which a sample is read."""
    monkeypatch.setattr(sampling, "_MAX_READ_IN_FULL", 20)
    return made_once(tmp_path / "ks", make)


def drawing(keystore: Path, *, sampled: bool) -> tuple[Picture, Folding]:
    """Return the picture of all enclaves, or of a sample."""
    return draw(PictureRequest([keystore], datetime.now(UTC), UTC, sampled=sampled))


def test_a_sample_draws_what_all_enclaves_draw(large: Path) -> None:
    all_of_them, whole = drawing(large, sampled=False)
    part_of_them, sample = drawing(large, sampled=True)
    assert not all_of_them.unread
    read = {enclave.path for enclave in part_of_them.enclaves}
    assert len(read) < len(all_of_them.enclaves) - 10
    assert {"/b3/arm", *(f"/d{n}/peer" for n in range(1, 7)), "/a2/nav"} <= read
    assert not UNREAD & read
    assert {units.like: units.members for units in part_of_them.unread} == {
        "a1": ("a3", "a4", "a5"),
        "b1": ("b2", "b4", "b5"),
        "c1": ("c2",),
        "c4": ("c5",),
        "f1": ("f2", "f3", "f4", "f5"),
    }
    for part in ("equal", "different"):
        assert getattr(sample, part) == getattr(whole, part)
    for part in ("names", "edges"):
        assert getattr(sample.picture, part) == getattr(whole.picture, part)
    assert cards(sample) == cards(whole)


def cards(folding: Folding) -> set[tuple[str, str, str]]:
    return {(enclave.path, enclave.group, enclave.note) for enclave in folding.picture.enclaves}


@pytest.mark.parametrize(
    ("enclave", "more"),
    some(
        [
            ("/a4/nav", {"/a4/nav": publishes("/a4/loud")}),
            ("/a4/base", {"/dispatcher": subscribes("/a4/odom")}),
            ("/a4/nav", {"/a4/extra": publishes("/a4/loud")}),
            ("/a4/nav", {"/a4/nav": group("topics", "publish", "/a4/x", qualifier="DENY")}),
        ],
        2,
    ),
)
def test_a_unit_of_which_anything_differs_is_read(
    large: Path, enclave: str, more: dict[str, str]
) -> None:
    assert enclave in UNREAD
    policy = large.with_name("more.xml")
    policy.write_text(policy_text({p: t + families().get(p, "") for p, t in more.items()}))
    sros("generate_artifacts", "-k", large, "-p", policy).ok()
    _, whole = drawing(large, sampled=False)
    part_of_them, sample = drawing(large, sampled=True)
    assert enclave in {each.path for each in part_of_them.enclaves}
    assert (sample.equal, sample.picture.edges) == (whole.equal, whole.picture.edges)


@pytest.mark.parametrize("file", ["permissions.p7s", "cert.pem"])
def test_a_unit_whose_files_are_broken(large: Path, file: str) -> None:
    """Permissions are compared; of the rest, nothing is known and that is said."""
    (large / "enclaves/a4/nav" / file).write_bytes(b"x")
    picture, _ = drawing(large, sampled=True)
    assert ("/a4/nav" in {enclave.path for enclave in picture.enclaves}) == (
        file == "permissions.p7s"
    )
    assert any("signatures, certificates" in line for line in picture.headlines)


def test_the_verb_says_what_was_only_compared(large: Path) -> None:
    ended = sros("view", large, "--format", "svg").ok()
    assert "a1 … a6: 5 equal namespaces are drawn as one\n" in ended.err
    said = (
        "12 namespaces with 15 enclaves (a3, a4, a5, b2, b4 and 7 more) were only compared: "
        "their permissions have the same text as the permissions of a1, b1 and 3 more, except for "
        "names."
    )
    assert said in ended.err
    assert "were only compared" in ended.out
    page = sros("view", large).ok().out
    assert said in page
    assert "The page lacks findings and expiry of 15 enclaves, only compared with others." in page
    assert '"unread":15' in page  # the headline says where no error was found
    assert '"/a4/nav"' not in page
    wanted = sros("view", large, "--robot", "a4").ok().out
    assert '"/a4/nav"' in wanted and '"/a5/nav"' not in wanted


def test_what_is_asked_for_is_read(large: Path) -> None:
    """Values for programs, and questions that go beyond what is drawn."""
    said: dict[str, Ended] = {}
    for more in (("--json",), ("--focus", "/a1/odom")):
        said[more[0]] = ended = sros("view", large, *more).ok()
        assert "were only compared" not in ended.out + ended.err
    assert '"/a4/nav"' in said["--json"].out
    refused = sros("view", large, "--robot", "a9")
    assert refused.status == 2 and "has no enclaves of a robot 'a9'" in refused.err
    assert "It has a1, a2, a3, a4, a5 and" in refused.err
    policy = large.with_name("policy.xml")
    policy.write_text(policy_text(families()))
    assert sros("view", policy, "--robot", "a1").status == 2
