"""What crosses between Zenoh routers is compared: settings, fleets, and the rules of routers."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.proof.test_review import Change
from tests.support.harness import copy_of, policy_text, publish, sros

OFFICE = publish("/fleet/state", "/r1/scan").replace("publish", "subscribe")
POLICY = policy_text({"/r1/base": publish("/fleet/state", "/r1/scan"), "/office": OFFICE})
ROUTERS = ("--endpoint", "office:7447", "--router", "/r1/router=r1.local:7447")
NAME = "/r1/router"


@pytest.fixture(scope="module")
def routed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A keystore ``narrow`` in which /fleet/* crosses, and ``wide`` in which everything does."""
    folder = tmp_path_factory.mktemp("routed")
    (folder / "robot.xml").write_text(POLICY)
    sros("create_keystore", "narrow", cwd=folder).ok()
    sros("generate_artifacts", "-k", "narrow", "-p", "robot.xml", cwd=folder).ok()
    sros("zenoh", "narrow", *ROUTERS, cwd=folder).ok()
    copy_of(folder / "narrow", folder / "wide")
    sros("zenoh", "narrow", "--cross", "/fleet/*", cwd=folder).ok()
    return folder


def no_new_access(folder: Path, *words: str) -> tuple[int, str]:
    ended = sros("diff_policy", "--no-new-access", *words, cwd=folder)
    return ended.status, ended.out + ended.err


def settings(before: str, after: str) -> Callable[[Path, Path], None]:
    def change(keystore: Path, _: Path) -> None:
        text = (keystore / "sros.toml").read_text()
        assert before in text
        (keystore / "sros.toml").write_text(text.replace(before, after))

    return change


ALL = 'crossing = ["/fleet/*"]\n'


def rules_of_the_wide_one(keystore: Path, folder: Path) -> None:
    """Replace signed rules of routers, and leave the settings; both have the same CA."""
    for router in ("router", "r1/router"):
        for name in ("router.json5", "router.p7s"):
            place = Path("enclaves") / router / name
            shutil.copy(folder / "wide" / place, keystore / place)


def without_settings(keystore: Path, _: Path) -> None:
    (keystore / "sros.toml").unlink()


@pytest.mark.parametrize(
    ("change", "status", "said"),
    [
        (settings("/fleet/*", "/*"), 1, f"crossing of router {NAME} /fleet/* -> /*: /"),
        (settings(ALL, ""), 1, f"crossing of router {NAME} /fleet/* -> everything: /"),
        (settings("/fleet/*", "/fleet/state"), 0, "- more protection: crossing of router /r1"),
        (settings('["/fleet/*"]', '["/fleet/*", "/fleet/a"]'), 0, "nobody gets more access"),
        (settings(ALL, f"{ALL}domains = [0]\n"), 0, "nobody gets more access"),
        (
            settings('enclaves = ["/r1/*"]', 'enclaves = ["/r1/router"]'),
            1,
            "router of /r1/base /r1/router, passing on /fleet/* -> /router: /",
        ),
        (
            settings('enclaves = ["/r1/*"]', 'enclaves = ["/r1/*"]\ncrossing = ["/fleet/state"]'),
            0,
            "- more protection: crossing of router /r1/router",
        ),
        (without_settings, 1, "Zenoh settings limit crossing -> missing: it is not"),
        (rules_of_the_wide_one, 1, "rules of router /router for router /r1/router without -> wi"),
    ],
)
def test_what_crosses_in_a_keystore_is_compared(
    routed: Path, tmp_path: Path, change: Callable[[Path, Path], None], status: int, said: str
) -> None:
    keystore = tmp_path / "head"
    copy_of(routed / "narrow", keystore)
    change(keystore, routed)
    ended = no_new_access(routed, "narrow", str(keystore))
    assert (ended[0], said in ended[1]) == (status, True), ended


def test_a_router_that_is_gone_lets_all_pass_only_where_that_was_limited(
    routed: Path, tmp_path: Path
) -> None:
    for name, cause in (("narrow", True), ("wide", False)):
        copy_of(routed / name, tmp_path / name)
        sros("zenoh", name, "--router", f"{NAME}=", cwd=tmp_path).ok()
        status, said = no_new_access(routed, name, str(tmp_path / name))
        assert status == 1
        assert ("+ less protection: router of /r1/base" in said) is cause
    assert no_new_access(routed, "wide", "narrow")[0] == 0
    status, said = no_new_access(routed, "narrow", "wide")
    assert (status, "/fleet/* -> everything" in said) == (1, True)


REQUIRED = """[[apart]]
from = ["/r1/base"]
to = ["/office"]
[[must]]
enclave = "/r1/base"
publish = ["/r1/scan"]
[[only]]
subscribe = ["/r1/scan"]
enclaves = ["/office"]
"""


FOUND = frozenset({"requirement.not-crossing"})
"""The kind of finding that the next test brings about."""


def test_requirements_and_pictures_know_of_routers(routed: Path, tmp_path: Path) -> None:
    """On DDS, and with all names crossing, the one influences the other; with none, it does not."""
    (tmp_path / "robot.toml").write_text(REQUIRED)
    copy_of(routed / "narrow", tmp_path / "none")
    sros("zenoh", "none", "--cross", "/nothing", cwd=tmp_path).ok()
    scan, state = (f"/r1/base -publish {name}-> /office" for name in ("/r1/scan", "/fleet/state"))
    kept = "the routers do not pass /r1/scan from /r1/base to /office"
    for keystore, said, not_said in (
        (routed / "wide", (scan,), (kept,)),
        (routed / "narrow", (state, kept), (scan,)),
        (tmp_path / "none", (kept,), (scan, state)),
    ):
        words = ("check", str(keystore), "--requirements", "robot.toml", "--vendor", "zenoh")
        out = sros(*words, cwd=tmp_path).out
        assert all(text in out for text in said), out
        assert not any(text in out for text in (*not_said, "router: may")), out
        assert all((f"[{identity}]" in out) is (kept in said) for identity in FOUND), out
    drawn = sros("view", str(routed / "wide"), "--focus", "/r1/scan", "-o", tmp_path / "wide.svg")
    assert "what passes between the 2 Zenoh routers is not considered" in drawn.err


def test_a_review_compares_what_crosses(routed: Path, tmp_path: Path) -> None:
    reviewed = tmp_path / "repository/ks"
    reviewed.parent.mkdir()
    change = Change(reviewed.parent)
    said = f"crossing of router {NAME}"
    for number, keystore in enumerate(("narrow", "narrow", "wide")):
        shutil.rmtree(reviewed, ignore_errors=True)
        copy_of(routed / keystore, reviewed)
        for key in [*reviewed.glob("**/key.pem"), *reviewed.glob("**/*.key.pem")]:
            key.unlink()
        change.commit({"README": str(number)})
        if number:
            summary = tmp_path / f"{number}.md"
            assert change.review("--keystore", "ks", "--summary", str(summary)).status == 1
            assert (said in summary.read_text()) is (keystore == "wide")


def test_a_policy_says_nothing_of_crossing_and_that_is_said(routed: Path) -> None:
    said = "what BASE lets pass between Zenoh routers"
    assert said in no_new_access(routed, "narrow", "robot.xml")[1]
    assert said not in no_new_access(routed, "wide", "robot.xml")[1]


FLEET = """[robots.r1]
router = "r1.local:7447"
crossing = ["/fleet/*"]
"""


@pytest.mark.parametrize(
    ("head", "status", "said"),
    [
        (FLEET, 0, ""),
        (FLEET.replace("/fleet/*", "/fleet/state"), 0, "- more protection: crossing of router"),
        (FLEET.replace("/fleet/*", "/r1/*"), 1, "crossing of router /r1/router /fleet/* -> /r1/*"),
        ("[robots.r1]\n", 1, "router of /r1/base /r1/router, passing on /fleet/* -> /router"),
    ],
)
def test_what_crosses_by_a_fleet_file_is_compared(
    tmp_path: Path, head: str, status: int, said: str
) -> None:
    (tmp_path / "fleet.xml").write_text(POLICY.replace("/r1/base", "/{robot}/base"))
    (tmp_path / "base.toml").write_text(FLEET)
    (tmp_path / "head.toml").write_text(head)
    fleets = ("--fleet", "base.toml", "--fleet", "head.toml")
    ended = no_new_access(tmp_path, "fleet.xml", "fleet.xml", *fleets)
    assert (ended[0], said in ended[1]) == (status, True), ended
