"""Keystores of users: which enclaves the demo casts, what is open by rights, what is not tried."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest

from sros_tool.demo import forger, program
from sros_tool.demo.casting import UserKeystore, open_user_keystore
from sros_tool.demo.forger import KeystoreCopy
from sros_tool.demo.program import DemoOptions, run_demo
from sros_tool.demo.result import KeystoreSummary, demo_table, summary_page
from sros_tool.demo.scenarios.attacks import ATTACKS
from sros_tool.demo.scenarios.model import RowStatus, check_topic
from sros_tool.errors import KeystoreError, UsageError
from sros_tool.keystore.layout import CRL_FILE, REQUIRED_FILES
from tests.demo.test_demo_result import CLOSED, OPEN, TWIN, result
from tests.demo.weak_robots import GIVEN, OTHERS, OWN_PART, WEAK, WIDEST, Place
from tests.support.harness import copy_of, policy_text, publish, sros

HEARS = '<topics subscribe="ALLOW"><topic>/image</topic></topics>'
SERVES = '<services reply="ALLOW"><service>/map</service></services>'
CALLS = '<services request="ALLOW"><service>/map</service></services>'
ROBOT = {
    "/camera": publish("/image"),
    "/eye/viewer": HEARS,
    "/map/client": CALLS,
    "/map/server": SERVES,
    "/odd/other": publish("/b"),
    "/odd/victim": publish("/c"),
    "/quiet": publish("/a"),
}
NOW = datetime(2026, 1, 1, tzinfo=UTC)


def make_keystore(
    folder: Path, rights: dict[str, str], template: str | Path = "production", name: str = "ks"
) -> Path:
    """Create a keystore with an enclave for each key, which may do what its policy says."""
    root = folder / name
    (folder / "policy.xml").write_text(policy_text(rights))
    sros("create_keystore", root, "--template", template).ok()
    sros("generate_artifacts", "-k", root, "-p", folder / "policy.xml").ok()
    return root


def opened(root: Path, topic: str = "/image") -> UserKeystore:
    return open_user_keystore(root, topic, ATTACKS, datetime.now(UTC))


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A robot's keystore, and one of other CAs with the same enclaves."""
    folder = tmp_path_factory.mktemp("robot")
    return make_keystore(folder, ROBOT), make_keystore(folder, ROBOT, name="foreign")


@pytest.fixture
def place(pair: tuple[Path, Path], tmp_path: Path) -> Place:
    root = tmp_path / "robot"
    copy_of(pair[0], root)
    return Place(root, pair[1], "/odd/victim", "/odd/other")


def test_in_a_sound_keystore_nothing_is_open_and_the_widest_is_tried(place: Place) -> None:
    user = opened(place.root)
    assert user.cast["guest"] == "/odd/other", "the first without another part"
    assert user.cast["widest publisher"] not in ("/camera", "/eye/viewer", "/odd/other")
    assert [row.name for row in user.rows] == list(WIDEST)
    rows = [*ATTACKS.rows, *user.rows]
    assert [row.name for row in rows if user.row_if_allowed(row, user.topic) is not row] == []
    assert (user.enclaves, user.elsewhere, user.not_tried) == (7, 0, ())


BY_RIGHTS = {*GIVEN, *WIDEST, *OWN_PART}


@pytest.mark.parametrize("name", WEAK)
def test_what_the_files_of_a_keystore_open_is_expected_to_be_open(name: str, place: Place) -> None:
    """What a governance opens, and who is not stopped by a list, only a DDS shows."""
    weak = WEAK[name]
    weak.weaken(place)
    user = opened(place.root)
    rows = [*ATTACKS.rows, *user.rows]
    found = {row.name: row for row in rows if user.row_if_allowed(row, user.topic) is not row}
    by_files = weak.broken if "wild" in name or "everything" in name else ()
    assert set(found) == BY_RIGHTS.intersection(by_files)
    for row in found.values():
        open_row = user.row_if_allowed(row, user.topic)
        assert open_row.expected in (RowStatus.HEARD, RowStatus.ANSWERED)
        assert open_row.claims[0].expected is open_row.expected
        assert "wildcard *)" in open_row.open_because or "/image" in open_row.open_because
        assert open_row.remedy
    joins = [row for row in user.rows if OTHERS in row.name]
    assert [row.parties[0].identity.enclave for row in joins] == [place.victim] * weak.joins
    assert place.victim not in user.cast.values() or not weak.joins
    assert user.not_tried == ()


def test_one_wide_enclave_is_cast_however_many_are_narrow(place: Place) -> None:
    WEAK["one enclave that may do everything"].weaken(place)
    user = opened(place.root)
    wide = [part for part, enclave in user.cast.items() if enclave == place.victim]
    assert wide == ["widest publisher", "widest subscriber", "widest client", "widest server"]
    assert user.why["widest publisher"] == "may publish /image by a wildcard"
    (row,) = (each for each in user.rows if each.name == WIDEST[0])
    assert user.row_if_allowed(row, "/image").open_because == (
        "the permissions of /odd/victim allow it to publish /image (by the wildcard *)"
    )


def test_a_right_by_name_that_everybody_has_is_open_too(tmp_path: Path) -> None:
    both = f"{publish('/image')}{HEARS}"
    user = opened(make_keystore(tmp_path, {"/a": both, "/b": both, "/c": publish("/x")}))
    (row,) = (each for each in ATTACKS.rows if each.name == "a talker listens")
    assert user.row_if_allowed(row, "/image").open_because == (
        "the permissions of /a allow it to subscribe /image"
    )


def test_a_part_is_given_to_whom_it_fits_best(tmp_path: Path) -> None:
    """Who may do both tells nothing by doing both, if there is somebody else."""
    both = f"{publish('/image')}{HEARS}"
    policies = {"/a": both, "/b": publish("/image"), "/c": both, "/d": HEARS, "/e": publish("/x")}
    user = opened(make_keystore(tmp_path, policies))
    parts = ("talker", "listener", "guest")
    assert [user.cast[part] for part in parts] == ["/b", "/d", "/e"]


def test_services_that_the_nodes_of_the_demo_have_are_not_attacked(tmp_path: Path) -> None:
    """On rclpy they have another type there; the services of lifecycle nodes are attacked."""
    services = "".join(
        f"<service>/eye/{name}</service>"
        for name in ("get_type_description", "set_parameters", "x")
    )
    robot = {
        "/a": f'{publish("/image")}<services reply="ALLOW">{services}</services>',
        "/b": f'{HEARS}<services request="ALLOW">{services}</services>',
    }
    user = opened(make_keystore(tmp_path, robot))
    assert (user.service, user.cast["server"], user.cast["client"]) == ("/eye/x", "/a", "/b")
    assert check_topic("eye/change_state") == "/eye/change_state"
    with pytest.raises(UsageError, match="the demo cannot use /eye/set_parameters"):
        check_topic("eye/set_parameters")


def test_whoever_lacks_the_revocation_list_is_the_listener_or_said_to_be_untried(
    place: Place,
) -> None:
    sros("revoke", place.root, place.other).ok()
    assert opened(place.root).not_tried == ()
    (place.root / "enclaves/quiet" / CRL_FILE).unlink()
    assert opened(place.root).not_tried == ("/quiet without the newest revocation list",)
    (place.root / "enclaves/eye/viewer" / CRL_FILE).unlink()
    user = opened(place.root)
    assert (user.cast["listener"], user.not_tried) == ("/eye/viewer", ())
    copy = KeystoreCopy(
        place.root, place.foreign, user.cast, "/image", 0, datetime.now(UTC), user.keyring()
    )
    forger.talker_revoked(copy)
    assert (copy.folder("guest") / CRL_FILE).exists()
    assert not (copy.folder("listener") / CRL_FILE).exists(), "it does not get the next one, either"


def test_a_governance_of_an_enclave_alone_is_said_to_be_untried(place: Place) -> None:
    copy = replace(place.copy(), cast={"talker": place.victim, "listener": place.victim})
    forger.weaker_governance(copy)
    assert opened(place.root).not_tried == (
        "/odd/victim with another governance than the other enclaves",
    )


def test_where_faults_leave_nobody_the_error_names_one(tmp_path: Path) -> None:
    root = make_keystore(tmp_path, {"/a": publish("/image"), "/b": HEARS})
    (root / "enclaves/b/permissions.p7s").write_text("x")
    with pytest.raises(KeystoreError, match=r"/b is left out: permissions\.p7s"):
        opened(root)


def test_an_enclave_alone_in_its_namespace_is_revoked_in_the_copy(tmp_path: Path) -> None:
    """A revocation also removes the folder of the namespace, if nothing is left in it."""
    root = make_keystore(tmp_path, {"/a/talker": publish("/image"), "/b/listener": HEARS})
    cast = {"talker": "/a/talker", "listener": "/b/listener"}
    copy = KeystoreCopy(root, root, cast, "/image", 0, datetime.now(UTC))
    before = copy.certificate("talker")
    forger.talker_revoked(copy)
    assert copy.certificate("talker").serial_number != before.serial_number
    for part in cast:
        files = {path.name for path in copy.folder(part).iterdir()}
        assert files >= {*REQUIRED_FILES, CRL_FILE}


def test_the_name_of_an_accepted_row_is_checked(place: Place) -> None:
    options = DemoOptions(scenarios=(ATTACKS,), keystore=place.root)
    for accepted in ("wire", "an enclave publishes a topic, wildcard permissions"):
        with pytest.raises(UsageError, match="no row of an attack is named"):
            run_demo(replace(options, accept_open=(accepted,)), datetime.now(UTC), print)


SKIPPED = replace(CLOSED, observed=RowStatus.SKIPPED, detail="no key")


@pytest.mark.parametrize(
    ("row", "proved"),
    [
        (CLOSED, True),
        (SKIPPED, False),
        (replace(SKIPPED, accepted=True), True),
        (replace(SKIPPED, applies=False), True),
        (replace(TWIN, observed=RowStatus.SKIPPED), True),
        (replace(OPEN, observed=RowStatus.SKIPPED), True),
        (replace(OPEN, observed=RowStatus.SKIPPED, unaccepted=True), False),
    ],
)
def test_a_keystore_is_not_proved_by_what_was_not_tried(row: object, proved: bool) -> None:
    played = result(row, CLOSED)  # type: ignore[arg-type]
    assert played.exit_status == 0, "the demo's own keystores prove nothing of others"
    scenario = replace(played.scenarios[0], attacked=KeystoreSummary(7, elsewhere=2))
    shown = replace(played, scenarios=(scenario,), left_out=3)
    assert shown.exit_status == (0 if proved else 2)
    assert shown.as_expected is proved
    last = demo_table(shown).splitlines()[-1]
    took_part = "0 of 7 enclaves took part, 2 could not (no key in the keystore)"
    assert f"3 left out with --only, {took_part}" in last
    assert ("because these were not tested" in last) is not proved
    verdict = "as expected" if proved else "as expected in all rows that ran"
    assert f"**{verdict}, " in summary_page(shown, NOW)
    wrong = replace(scenario, rows=(replace(CLOSED, observed=RowStatus.HEARD), *scenario.rows))
    assert replace(shown, scenarios=(wrong,)).exit_status == 1


def test_an_enclave_with_a_file_of_the_kernel_is_neither_copied_nor_started(
    place: Place, tmp_path: Path
) -> None:
    for enclave, file in (("/odd/victim", "permissions.p7s"), ("/odd/other", "crl.pem")):
        path = place.root / f"enclaves{enclave}" / file
        path.unlink(missing_ok=True)
        path.symlink_to("/dev/zero")
    user = opened(place.root)
    assert user.not_tried == ("/odd/other and 1 more with files that cannot be read",)
    assert [row.name for row in user.rows if OTHERS in row.name] == []
    assert not {place.victim, place.other} & {*user.cast.values()}
    user.copy(tmp_path / "copy")
    assert not (tmp_path / "copy/enclaves/odd").exists()


def test_enclaves_of_other_domains_are_sound_and_not_tried(tmp_path: Path) -> None:
    root, fleet = tmp_path / "ks", tmp_path / "fleet.toml"
    rights = {"/{robot}/eye": publish("/image"), "/{robot}/viewer": HEARS}
    rights["/{robot}/other"] = publish("/b")
    (tmp_path / "policy.xml").write_text(policy_text(rights))
    fleet.write_text("[robots]\nr1 = { domain = 10 }\nr2 = { domain = 20 }\n")
    sros("create_keystore", root, "--domain", "10,20", "--template", "production").ok()
    sros("generate_artifacts", "-k", root, "-p", tmp_path / "policy.xml", "--fleet", fleet).ok()
    user = opened(root)
    assert {name.split("/")[1] for name in user.cast.values()} == {"r1"}
    assert not [row.name for row in user.rows if "joins the other enclaves" in row.name]
    assert user.not_tried == ("/r2/eye and 2 more outside domain 10",)


def test_encrypted_ca_keys_are_opened_with_the_secrets_of_the_user(tmp_path: Path) -> None:
    root, secret = make_keystore(tmp_path, ROBOT), "correct horse battery"
    options = DemoOptions(scenarios=(ATTACKS,), keystore=root, secrets=lambda _: secret)
    user = program._user_keystore(options, datetime.now(UTC))
    assert user and user.keyring().secrets("the passphrase of the identity CA key") == secret
