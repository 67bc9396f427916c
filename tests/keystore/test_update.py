"""Changing a keystore: all of it follows the new settings, or nothing changes."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from sros_tool.checks.keystores.keystore import keystore_findings
from sros_tool.checks.keystores.opened import Circumstances
from sros_tool.checks.kind import NOTE
from sros_tool.dds.domains import DomainSet
from sros_tool.errors import KeystoreError, SrosError, UsageError
from sros_tool.files import policies_dir, templates_dir
from sros_tool.keystore.comparison import Mismatch
from sros_tool.keystore.describe import history
from sros_tool.keystore.expiry import IF_EXPIRED
from sros_tool.keystore.issuing.authority import load_authorities
from sros_tool.keystore.issuing.keyring import IN_KEYSTORE
from sros_tool.keystore.layout import enclave_path, list_enclaves
from sros_tool.keystore.lifecycle.create import (
    create_enclaves,
    create_keystore,
    generate_artifacts,
    restart_note,
)
from sros_tool.keystore.lifecycle.renew import renew
from sros_tool.keystore.lifecycle.rotate import rotate_ca
from sros_tool.keystore.lifecycle.update import (
    KeystoreUpdate,
    UpdateStage,
    edited_settings,
    update_keystore,
)
from sros_tool.keystore.reader import OpenedKeystore, open_enclave
from sros_tool.keystore.settings import lengthening_remedy, present_settings
from sros_tool.keystore.template import (
    NamedValues,
    ShortLivedEnclaves,
    Template,
    load_template,
    with_values,
)
from sros_tool.pki.certificates import validity_of
from sros_tool.policy.document import read_policy
from sros_tool.translate import governance_for
from sros_tool.validity import parse_span
from tests.support import made_by_ros2
from tests.support.harness import (
    certificate,
    check_enclave_whole,
    check_whole,
    copy_of,
    policy_text,
    publish,
    remains,
    snapshot,
    sros,
    topics_of,
)
from tests.support.tables import for_every

NOW = datetime.now(UTC)
LATER = NOW + timedelta(hours=1)
ZERO = DomainSet.of((0, 0))


def make(folder: Path, template: str = "development") -> Path:
    """A keystore in which /free has no policy, and /robot one."""
    root = folder / "ks"
    create_keystore(root, template=load_template(template), now=NOW)
    create_enclaves(root, ["/free"], now=NOW)
    policy = folder / "policy.xml"
    policy.write_text(policy_text({"/robot": publish("/scan", "/odom")}))
    generate_artifacts(root, policies=[read_policy(policy)], now=NOW)
    return root


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The keystore of `make`; only to be copied."""
    return make(tmp_path_factory.mktemp("made"))


@pytest.fixture
def root(made: Path, tmp_path: Path) -> Path:
    shutil.copy(made.with_name("policy.xml"), tmp_path)
    return copy_of(made, tmp_path / "ks")


def change(root: Path, *values: tuple[str, str], **options: object) -> KeystoreUpdate:
    """Change single settings, with everything allowed."""
    target = with_values(present_settings(OpenedKeystore(root)).settings, values)
    return to(root, target, **options)


def to(root: Path, target: Template | str, *domains: int, **options: object) -> KeystoreUpdate:
    template = load_template(target) if isinstance(target, str) else target
    chosen = DomainSet.of(*((each, each) for each in domains)) if domains else None
    settings: dict[str, Any] = {"allow_looser": True, **options}
    done = update_keystore(root, template, chosen, now=LATER, **settings)
    sound(root)
    return done


def sound(root: Path) -> None:
    """DDS loads every enclave, nothing is left behind, and the ledger knows every file."""
    assert not remains(root.parent)
    check_whole(root)
    for name in list_enclaves(root):
        assert open_enclave(enclave_path(root, name), now=LATER).problems_in_keystore == (), name
    # No ledger has the CA that ros2/sros2 made.
    left = set(history(OpenedKeystore(root), now=LATER).unexplained)
    assert left <= {"public/identity_ca.cert.pem", "public/permissions_ca.cert.pem"}


def told(update: KeystoreUpdate) -> str:
    return " ".join(each.text for each in update.remarks)


def found(root: Path) -> set[str]:
    every = keystore_findings(OpenedKeystore(root), Circumstances(LATER))
    return {each.id for each in every if each.kind.severity > NOTE} - {"enclave.node-cannot-start"}


def until(root: Path, name: str) -> tuple[int, int]:
    """The days for which certificate and permissions of an enclave are valid."""
    state = open_enclave(enclave_path(root, name), now=LATER)
    assert state.certificate
    assert state.grant
    ends = (validity_of(state.certificate).not_after, state.grant.validity.not_after)
    one, other = ((each - LATER).days + 1 for each in ends)
    return one, other


# ── what changes ───────────────────────────────────────────────────────────────────────────


def test_from_development_to_production(root: Path) -> None:
    names = ("/free", "/robot")
    keys = {each: (enclave_path(root, each) / "key.pem").read_bytes() for each in names}
    robot = topics_of(enclave_path(root, "/robot"))
    done = to(root, "production", allow_looser=False)
    assert (done.before, done.after, done.left) == ("development", "production", ())
    assert done.names("renewed") == ("/free", "/robot")
    assert not done.looser
    template = load_template("production")
    assert OpenedKeystore(root).governance == governance_for(template.protection, ZERO)
    assert OpenedKeystore(root).template == template
    for name, key in keys.items():
        folder = enclave_path(root, name)
        assert (folder / "key.pem").read_bytes() == key
        assert len(certificate(folder / "cert.pem").subject.rdns) == 2
        assert until(root, name) == (365, 180)
    assert topics_of(enclave_path(root, "/robot")) == robot  # the rights of a policy stay
    assert "rt/*" not in topics_of(enclave_path(root, "/free"))
    (lost,) = done.rights
    assert (lost.enclave, lost.gained) == ("/free", ())
    assert "publish topic /*" in [each.describe() for each in lost.lost]
    assert done.works_until
    assert (done.works_until - NOW).days >= 3649
    assert found(root) == set()


def test_and_back(tmp_path: Path) -> None:
    root = make(tmp_path, "production")
    before = snapshot(root)
    with pytest.raises(UsageError, match=r"looser.*/free gains publish topic"):
        to(root, "development", allow_looser=False)
    assert snapshot(root) == before
    done = to(root, "development")
    assert OpenedKeystore(root).template == load_template("development")
    assert len(certificate(enclave_path(root, "/robot") / "cert.pem").subject.rdns) == 1
    assert until(root, "/robot") == (5 * 365, 5 * 365)  # with the CAs, at the latest
    assert any("/free gains" in each for each in done.looser)
    assert found(root) == found(make(tmp_path / "other"))


@pytest.fixture(autouse=True)
def other_folder(tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()


@pytest.mark.parametrize(
    ("value", "renewed", "signed", "governed"),
    [
        (("protection.rtps", "ENCRYPT"), False, False, True),
        (("protection.default.data", "NONE"), False, False, True),
        (("permissions.validity", "30d"), False, True, False),
        (("certificates.validity", "30d"), True, False, False),
        (("certificates.unique_subject", "true"), True, False, False),
        (("authorities.validity", "1y"), False, False, False),
        (("revocation.validity", "1y"), False, False, False),
    ],
)
def test_only_what_follows_from_a_setting_changes(
    value: tuple[str, str], renewed: bool, signed: bool, governed: bool, root: Path
) -> None:
    governance = (root / "enclaves/governance.p7s").read_bytes()
    done = change(root, value)
    names = ("/free", "/robot")
    assert (done.names("renewed"), done.names("signed")) == (
        names if renewed else (),
        names if signed else (),
    )
    assert ((root / "enclaves/governance.p7s").read_bytes() != governance) == governed
    assert done.restart == (names if renewed or signed or governed else ())
    assert value[1].replace("1y", "365d") in (root / "sros.toml").read_text()
    again = change(root, value)
    assert (again.done, again.changes) == ((), ())


def test_short_lived_enclaves_are_issued_again_alone(root: Path) -> None:
    settings = present_settings(OpenedKeystore(root)).settings
    short = (ShortLivedEnclaves("/free", timedelta(days=2)),)
    done = to(root, replace(settings, short_lived=short))
    assert (done.names("renewed"), done.names("signed")) == (("/free",), ())
    assert until(root, "/free") == (2, 2)
    assert to(root, settings).names("renewed") == ("/free",)
    assert until(root, "/free") == (3650, 3650)


def test_domains(root: Path) -> None:
    with pytest.raises(UsageError, match="may also join domain 7"):
        to(root, present_settings(OpenedKeystore(root)).settings, 0, 7, allow_looser=False)
    done = to(root, present_settings(OpenedKeystore(root)).settings, 0, 7)
    assert done.names("signed") == ("/free", "/robot")
    for name in list_enclaves(root):
        folder = enclave_path(root, name)
        assert not open_enclave(folder, now=LATER, domain=7).problems
    to(root, present_settings(OpenedKeystore(root)).settings, 7, allow_looser=False)
    assert open_enclave(enclave_path(root, "/robot"), now=LATER, domain=0).problems
    assert found(root) <= {"keystore.allow-everything", "enclave.long-permissions"}


def test_rules_for_names(root: Path) -> None:
    camera = NamedValues("topic", "/camera/*", (("data", "NONE"), ("metadata", "SIGN")))
    target = with_values(present_settings(OpenedKeystore(root)).settings, rules=[camera])
    done = to(root, target)
    assert "the processes that use topic /camera/*;" in told(done)
    expressions = [
        each.topic_expression
        for each in OpenedKeystore(root).governance.domain_access_rules[0].topic_access_rules
    ]
    assert expressions == ["rt/camera/*", "*"]
    to(
        root,
        with_values(
            present_settings(OpenedKeystore(root)).settings, dropped=[("topic", "/camera/*")]
        ),
    )
    assert OpenedKeystore(root).template == load_template("development")


SIGNED = ("data=NONE", "metadata=SIGN")


@pytest.mark.parametrize(
    ("first", "second", "named"),
    [
        ("topic /cam/*", "topic cam/*", "topic /cam/*"),
        ("topic cam/*", "topic /cam/*", "topic /cam/*"),
        ("service reset", "service reset", "service /reset"),
    ],
)
def test_a_rule_replaces_the_one_for_the_same_names(
    first: str, second: str, named: str, root: Path
) -> None:
    for name, values in ((first, SIGNED), (second, ("data=ENCRYPT",))):
        sros("update_keystore", root, "--rule", " ".join((name, *values)), "--allow-looser").ok()
    for settings in (
        OpenedKeystore(root).template,
        present_settings(OpenedKeystore(root)).settings,
    ):
        (rule,) = settings.protection.named
        assert (str(rule), rule.protection.data) == (named, "ENCRYPT")
    assert "governance.unreachable-rule" not in found(root)
    kind, _, name = first.partition(" ")
    sros("update_keystore", root, "--drop-rule", f"{kind} {name}").ok()
    assert OpenedKeystore(root).template.protection.named == ()


def test_a_rule_that_would_never_apply_is_refused(root: Path, tmp_path: Path) -> None:
    before = snapshot(root)
    rules = [x for data in ("NONE", "ENCRYPT") for x in ("--rule", f"topic /cam/* data={data}")]
    template = tmp_path / "mine.toml"
    text = (templates_dir() / "development.toml").read_text()
    text += '[[protection.topic]]\nnames = ["/cam/*", "cam/*"]\ndata = "SIGN"\n'
    template.write_text(text)
    for words in (rules, ("--template", template)):
        ended = sros("update_keystore", root, *words, "--allow-looser")
        assert (ended.status, "topic /cam/* twice" in ended.err) == (2, True), ended
        assert snapshot(root) == before
    # What a keystore has already does not stop other changes, and no template accepts it.
    sros("create_keystore", other := tmp_path / "other", "--template", template).ok()
    (finding,) = [
        each
        for each in keystore_findings(OpenedKeystore(other), Circumstances(LATER))
        if each.id == "governance.unreachable-rule"
    ]
    assert not finding.accepted
    sros("update_keystore", other, "--set", "permissions.validity=90d").ok()
    sros("update_keystore", other, "--rule", "topic cam/* data=ENCRYPT").ok()
    assert "governance.unreachable-rule" not in found(other)


@pytest.mark.parametrize(
    ("words", "name"),
    [
        (("--rule", "topic cam/* data=SIGN"), "topic /cam/*"),
        (("--set", "protection.default.data=SIGN"), "every name without"),
    ],
)
def test_signing_payloads_alone_is_warned_of(words: tuple[str, ...], name: str, root: Path) -> None:
    for dry_run in (("--dry-run",), ("--next",)):
        err = sros("update_keystore", root, *words, "--allow-looser", *dry_run).ok().err
        assert f"loses messages whose length is not a multiple of four (here: of {name}" in err
    assert "loses" not in sros("update_keystore", root, "--set", "permissions.validity=90d").err
    assert "governance.signed-payload" in found(root)


def test_own_copies_of_the_governance_follow(root: Path) -> None:
    own = enclave_path(root, "/robot") / "governance.p7s"
    data = own.read_bytes()
    own.unlink()
    own.write_bytes(data)
    change(root, ("protection.rtps", "ENCRYPT"))
    assert own.read_bytes() == (root / "enclaves/governance.p7s").read_bytes() != data


def test_an_enclave_whose_key_is_on_its_robot(root: Path) -> None:
    folder = enclave_path(root, "/robot")
    (folder / "key.pem").rename(folder / "request.pem")
    done = to(root, "production")
    assert "/robot" in done.names("renewed")
    assert "answer the request again" in told(done)


def test_rights_that_were_put_back_are_not_signed_again(root: Path) -> None:
    file = enclave_path(root, "/robot") / "permissions.p7s"
    before = file.read_bytes()
    renew(root, ["/robot"], now=NOW)
    file.write_bytes(before)
    state = snapshot(root)
    with pytest.raises(KeystoreError, match="not certain that enclave /robot has its"):
        update_keystore(root, load_template("production"), now=LATER)
    assert snapshot(root) == state


def test_expired_certificates_are_renewed_first(tmp_path: Path) -> None:
    """In a production keystore, whose certificates expire long before its CAs."""
    root, template = tmp_path / "ks", load_template("production")
    create_keystore(root, template=template, now=NOW - timedelta(days=400))
    create_enclaves(root, ["/a", "/b", "/operator/pc"], now=NOW - timedelta(days=400))
    ninety = with_values(template, [("permissions.validity", "90d")])
    for name in ("/a", "/operator/pc"):  # the second one is short-lived
        with pytest.raises(KeystoreError, match=f"certificate of enclave {name} has exp") as told:
            update_keystore(root, ninety, now=NOW)
        (command,) = re.findall("`sros (.*)`", told.value.remedy)
        sros(*shlex.split(command)).ok()
    update_keystore(root, ninety, now=LATER)


# ── stages ─────────────────────────────────────────────────────────────────────────────────


def test_the_stages(root: Path) -> None:
    target = load_template("production")
    governance = OpenedKeystore(root).governance
    first = to(root, target, next_stage=True)
    assert (first.done, first.left) == ((UpdateStage.CREDENTIALS,), (UpdateStage.GOVERNANCE,))
    assert OpenedKeystore(root).governance == governance
    assert OpenedKeystore(root).template.name == "development"
    assert "one by one" in first.remarks[0].text
    assert IF_EXPIRED in first.remarks[0].text
    assert IF_EXPIRED in restart_note(Mismatch(names=("topic /scan",))).text
    assert found(root) == set()
    # What is created between the stages follows the new settings already.
    create_enclaves(root, ["/late"], now=LATER)
    assert until(root, "/late") == (365, 180)
    second = to(root, target, next_stage=True)
    assert (second.done, second.left) == ((UpdateStage.GOVERNANCE,), ())
    assert (second.names("renewed"), second.names("signed")) == ((), ())
    assert "together" in second.remarks[0].text
    assert OpenedKeystore(root).template == target
    third = to(root, target, next_stage=True)
    assert (third.done, third.changes) == ((), ())


def printed(err: str) -> list[str]:
    """The words of the command that is printed for the stage that is left."""
    (command,) = re.findall("restarted, run `sros (.+?)`", err)
    return shlex.split(command)


def test_the_command_of_the_second_stage(root: Path) -> None:
    """It runs as it is printed, and revokes nothing that the first stage issued."""
    first = sros("update_keystore", root, "--template", "production", "--next", "--revoke-old").ok()
    assert "renewed /free, /robot" in first.out
    forgotten = sros("update_keystore", root, "--next")
    assert (forgotten.status, "Repeat the options of the first stage" in forgotten.err) == (2, True)
    second = sros(*printed(first.err)).ok()
    assert "renewed" not in second.out
    assert OpenedKeystore(root).template == load_template("production")
    crl = OpenedKeystore(root).revocation_list
    assert crl
    assert len(crl.revoked) == 2
    sound(root)


def test_another_domain_revokes_in_both_stages(root: Path) -> None:
    """The second one signs permissions for it, so those of the first stage are old, too."""
    words = ("--domain", "0,7", "--rule", "topic /a data=NONE", "--set", "permissions.validity=9d")
    first = sros("update_keystore", root, *words, "--next", "--allow-looser", "--revoke-old").ok()
    again = printed(first.err)
    assert {"topic /a data=NONE", "0,7", "--allow-looser", "--revoke-old"} <= set(again)
    assert "renewed /free, /robot" in sros(*again).ok().out
    assert str(present_settings(OpenedKeystore(root)).domains) == "0,7"


def test_revoking_the_old(root: Path) -> None:
    serials = {each: serial_of(root, each) for each in list_enclaves(root)}
    done = change(root, ("permissions.validity", "30d"), revoke_old=True)
    assert done.revoked == 2
    assert done.works_until is None
    crl = OpenedKeystore(root).revocation_list
    assert crl
    assert {each.serial for each in crl.revoked} == set(serials.values())
    assert "restart all processes together" in told(done)
    for name in serials:  # the permissions of before fit no certificate any more
        assert len(certificate(enclave_path(root, name) / "cert.pem").subject.rdns) == 2
    renew(root, ["/robot"], now=LATER)
    assert len(certificate(enclave_path(root, "/robot") / "cert.pem").subject.rdns) == 2
    with pytest.raises(UsageError, match="renew"):
        change(root, ("permissions.validity", "30d"), revoke_old=True)


def serial_of(root: Path, name: str) -> int:
    return certificate(enclave_path(root, name) / "cert.pem").serial_number


# ── the layout of the CAs ──────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("by_ros2", [False, True])
def test_one_ca_becomes_two(by_ros2: bool, tmp_path: Path) -> None:
    if by_ros2:
        root = tmp_path / "ks"
        made_by_ros2.make(root, "/free", "/robot", now=NOW)
        for key in root.glob("**/*key.pem"):
            key.chmod(0o600)
    else:
        root = make(tmp_path, "sros2")
    done = to(root, "production", allow_looser=False)
    assert "rotate_ca" in told(done)
    assert set(OpenedKeystore(root).authority_files) == {"identity_ca", "permissions_ca"}
    assert not list(root.glob("*/ca.*"))
    # The two files still hold one CA, and that is found until the permissions CA is replaced.
    assert found(root) - {"keystore.folder-open"} == {"keystore.one-authority"}
    before = present_settings(OpenedKeystore(root)).settings
    command = done.remarks[-1].text.partition("`sros ")[2].partition("`")[0].split()
    sros(*command).ok()
    for _ in range(2):
        rotate_ca(root, now=LATER)
        sound(root)
    assert present_settings(OpenedKeystore(root)).settings == before
    assert found(root) <= {"keystore.folder-open"}


def test_what_is_left_until_each_ca_has_its_own_key(tmp_path: Path) -> None:
    """Every command that is printed on the way runs as it is printed, though the CA is shorter."""
    root = make(tmp_path, "sros2")
    parting = ("update_keystore", root, "--set", "authorities.layout=separate")
    assert "`sros rotate_ca" in to(root, "production").remarks[-1].text
    for stage in ("none", "distribute"):
        words = f"sros rotate_ca {root}{' --permissions' if stage == 'none' else ''} --next"
        (remedy,) = [
            each.remedy
            for each in keystore_findings(OpenedKeystore(root), Circumstances(LATER))
            if each.id == "keystore.one-authority"
        ]
        assert re.findall("`(.+?)`", remedy) == [words]
        refused = sros(*parting)
        assert (refused.status, f"`{words}`" in refused.err) == (2, True), refused
        again = sros("update_keystore", root, "--template", "production").ok()
        assert ("nothing is left" in again.err, f"`{words}`" in again.err) == (True, True)
        sros(*words.split()[1:]).ok()
    assert "nothing is left" in sros(*parting).ok().err
    sros("rotate_ca", root, "--next").ok()
    assert found(root) == set()


def test_a_keystore_of_ros2_can_be_renewed_after_an_update(tmp_path: Path) -> None:
    """With settings, every right has to be in the ledger, so all are recorded."""
    root = tmp_path / "ks"
    made_by_ros2.make(root, "/free", "/robot", now=NOW)
    assert present_settings(OpenedKeystore(root)).without_settings
    target = with_values(
        present_settings(OpenedKeystore(root)).settings, [("protection.rtps", "ENCRYPT")]
    )
    assert update_keystore(root, target, now=LATER).names("signed") == ("/free", "/robot")
    renew(root, ["/robot"], now=LATER)
    check_whole(root)


def test_rights_of_a_policy_stay_even_if_they_are_the_default(root: Path) -> None:
    policy = root.with_name("all.xml")
    everything = (policies_dir() / "defaults/everything.xml").read_text()
    policy.write_text(everything.replace('path="/"', 'path="/stated"'))
    generate_artifacts(root, policies=[read_policy(policy)], now=NOW)
    (lost,) = to(root, "production").rights
    assert lost.enclave == "/free"
    assert "rt/*" in topics_of(enclave_path(root, "/stated"))


def test_two_cas_do_not_become_one(root: Path) -> None:
    before = snapshot(root)
    with pytest.raises(UsageError, match="cannot change back"):
        to(root, "sros2")
    assert snapshot(root) == before
    kept = with_values(load_template("sros2"), [("authorities.layout", "separate")])
    to(root, kept)
    assert OpenedKeystore(root).template.name == "sros2"


def test_a_key_is_not_moved(root: Path) -> None:
    target = replace(load_template("production"), identity_key="file:/elsewhere.pem")
    with pytest.raises(UsageError, match="does not move CA keys"):
        to(root, target)


# ── edits by hand ──────────────────────────────────────────────────────────────────────────


def _weaker_settings(root: Path) -> None:
    _put(root / "sros.toml", 'rtps = "SIGN"', 'rtps = "NONE"')


def _stronger_settings(root: Path) -> None:
    _put(root / "sros.toml", 'rtps = "SIGN"', 'rtps = "ENCRYPT"')


def _shorter(root: Path) -> None:
    _put(root / "sros.toml", '[permissions]\nvalidity = "3650d"', '[permissions]\nvalidity = "30d"')


def _governance(root: Path) -> None:
    kind = "<rtps_protection_kind>"
    _put(root / "enclaves/governance.xml", f"{kind}SIGN", f"{kind}NONE")


def _put(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


EDITS: dict[str, tuple[Callable[[Path], None], str, bool]] = {
    "weaker settings": (_weaker_settings, "keystore.settings-edited", True),
    "stronger settings": (_stronger_settings, "keystore.settings-edited", False),
    "another validity": (_shorter, "keystore.settings-edited", False),
    "another governance": (_governance, "governance.xml-differs", True),
}


@pytest.mark.parametrize("case", EDITS)
def test_an_edit_is_found_and_taken_over_or_undone(case: str, root: Path, tmp_path: Path) -> None:
    edit, finding, looser = EDITS[case]
    assert finding not in found(root)
    clean = {each: (root / each).read_bytes() for each in ("sros.toml", "enclaves/governance.xml")}
    edit(root)
    (kind,) = found(root) - {"enclave.long-permissions", "keystore.allow-everything"}
    assert kind == finding
    edited = snapshot(root)
    # Nothing that signs the governance or writes the settings undoes it.
    for refused in (
        lambda: rotate_ca(root, now=LATER),
        lambda: to(root, "production"),
    ):
        with pytest.raises(KeystoreError, match="edited by hand"):
            refused()
        assert snapshot(root) == edited
    (note,) = renew(root, ["/robot"], now=NOW).notes
    assert (note.id, "--take-edits" in note.text) == ("keystore.edited", True)
    (note,) = create_enclaves(root, ["/late"], now=NOW).notes
    assert note.id == "keystore.edited"
    target, domains = edited_settings(OpenedKeystore(root), present_settings(OpenedKeystore(root)))
    if looser:
        with pytest.raises(UsageError, match="looser"):
            update_keystore(root, target, domains, now=LATER, replace_edits=True)
    else:
        update_keystore(root, target, domains, now=LATER, replace_edits=True)
        assert finding not in found(root)
        edit_again = snapshot(root)
        assert edit_again != edited
        return
    update_keystore(
        root,
        present_settings(OpenedKeystore(root)).settings_without_edits(),
        now=LATER,
        replace_edits=True,
    )
    assert {each: (root / each).read_bytes() for each in clean} == clean
    assert finding not in found(root)
    edit(root)
    update_keystore(root, target, domains, now=LATER, allow_looser=True, replace_edits=True)
    assert finding not in found(root)
    assert OpenedKeystore(root).governance.domain_access_rules[0].rtps_protection_kind == "NONE"
    sound(root)


def _append(path: str, text: bytes) -> Callable[[Path], None]:
    def edit(root: Path) -> None:
        with (root / path).open("ab") as file:
            file.write(text)

    return edit


BROKEN: dict[str, tuple[Callable[[Path], None], str]] = {
    "no TOML": (_append("sros.toml", b"foo =\n"), "is not valid TOML"),
    "an unknown key": (_append("sros.toml", b"foo = 1\n"), "foo is not a known key"),
    "no text": (_append("sros.toml", b"\xff\xfe"), "is not valid TOML"),
    "no settings": (lambda root: (root / "sros.toml").unlink(), "there is no sros.toml"),
    "no XML": (_append("enclaves/governance.xml", b"</foo"), "differs from the signed governance"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_files_that_cannot_be_read_are_written_again(case: str, root: Path) -> None:
    damage, clause = BROKEN[case]
    clean = {each: (root / each).read_bytes() for each in ("sros.toml", "enclaves/governance.xml")}
    damage(root)
    assert "--discard-edits" in sros("check", root).out
    assert sros("update_keystore", root, "--take-edits").status == 2
    assert "--discard-edits" in sros("update_keystore", root, "--template", "production").err
    note = json.loads(
        sros("update_keystore", root, "--discard-edits", "--dry-run", "--json").ok().out
    )["notes"][0]
    assert (note["id"], clause in note["text"]) == ("keystore.edit-undone", True)
    done = sros("update_keystore", root, "--discard-edits").ok()
    assert "\n  undone   " in done.out
    assert clause in done.out
    assert {each: (root / each).read_bytes() for each in clean} == clean
    sound(root)


def test_settings_that_cannot_be_read_are_called_settings(root: Path) -> None:
    """Not a template, and with the command that writes them again, if the ledger has them."""
    _append("sros.toml", b"foo = 1\n")(root)
    for words in (("create_enclave", root, "/new"), ("renew", root, "/free"), ("inspect", root)):
        err = sros(*words).err
        assert f"the settings file '{root}/sros.toml' is not valid. " in err
        assert f"`sros update_keystore {root} --discard-edits`" in err
    ledger = root / "ledger.jsonl"
    lines = [x for x in ledger.read_text().splitlines() if '"what":"settings"' not in x]
    ledger.write_text("\n".join(lines) + "\n")
    refused = sros("update_keystore", root, "--discard-edits")
    assert (refused.status, "restore it from a backup" in refused.err) == (2, True)


def test_a_forged_record_does_not_hide_an_edit(root: Path) -> None:
    """A line that somebody adds to the ledger is a gap, and says nothing of the settings."""
    _weaker_settings(root)
    ledger = root / "ledger.jsonl"
    lines = ledger.read_text().splitlines()
    (line,) = [each for each in lines if '"what":"settings"' in each]
    forged = json.loads(line)
    forged["settings"] = forged["settings"].replace('rtps = "SIGN"', 'rtps = "NONE"')
    assert forged["settings"] in (root / "sros.toml").read_text()
    del forged["previous"]
    ledger.write_text("\n".join([*lines, json.dumps(forged)]) + "\n")
    assert {"keystore.ledger-damaged", "governance.not-as-settings"} <= found(root)


@pytest.mark.parametrize("stages", [1, 2])
def test_during_a_rotation(stages: int, root: Path) -> None:
    """The CA that issues then signs, and the rotation goes on."""
    for _ in range(stages):
        rotate_ca(root, now=NOW)
    target = with_values(load_template("production"), [("authorities.validity", "10y")])
    update_keystore(root, target, now=LATER, revoke_old=True)
    for name in list_enclaves(root):
        check_enclave_whole(enclave_path(root, name))
        assert not open_enclave(enclave_path(root, name), now=LATER).problems
    rotate_ca(root, now=LATER, finish=True)
    sound(root)
    assert OpenedKeystore(root).template == target


def test_settings_that_changed_meanwhile(root: Path) -> None:
    """Two changes at once: the later one would undo the first, from which it did not start."""
    seen = present_settings(OpenedKeystore(root))
    change(root, ("protection.rtps", "ENCRYPT"))
    state = snapshot(root)
    with pytest.raises(KeystoreError, match="have just changed"):
        update_keystore(root, seen.settings, now=LATER, seen_settings=seen, allow_looser=True)
    assert snapshot(root) == state


def test_a_governance_of_one_s_own_is_not_replaced_unasked(tmp_path: Path) -> None:
    root = tmp_path / "ks"
    made_by_ros2.make(root, "/free", now=NOW)
    _sign_governance(root, "<topic_expression>*<", "<topic_expression>rt/*<")
    before = snapshot(root)
    for words in (("--set", "permissions.validity=30d"), ("--domain", "0,7", "--allow-looser")):
        ended = sros("update_keystore", root, *words)
        assert (ended.status, "has rules that settings cannot express" in ended.err) == (2, True), (
            ended
        )
    assert snapshot(root) == before
    sros("update_keystore", root, "--template", "production", "--allow-looser").ok()


def _sign_governance(root: Path, old: str, new: str) -> None:
    """Edit the governance as its owner does who signs it with another tool."""
    _put(root / "enclaves/governance.xml", old, new)
    authorities = load_authorities(
        OpenedKeystore(root), OpenedKeystore(root).template, IN_KEYSTORE, NOW
    )
    document = (root / "enclaves/governance.xml").read_bytes()
    (root / "enclaves/governance.p7s").write_bytes(authorities.permissions.sign(document, "it"))


def test_a_governance_that_was_signed_elsewhere(root: Path) -> None:
    """The signed document counts: it is found, and undone or taken over."""
    _sign_governance(root, "<rtps_protection_kind>SIGN", "<rtps_protection_kind>NONE")
    assert "governance.not-as-settings" in found(root)
    sros("update_keystore", root, "--discard-edits").ok()
    assert OpenedKeystore(root).governance.domain_access_rules[0].rtps_protection_kind == "SIGN"
    assert "governance.not-as-settings" not in found(root)


def test_a_comment_is_no_edit(root: Path) -> None:
    with (root / "sros.toml").open("a") as file:
        file.write("\n# mine\n")
    assert "keystore.settings-edited" not in found(root)


def test_edits_that_contradict_each_other(root: Path) -> None:
    _stronger_settings(root)
    _governance(root)
    with pytest.raises(KeystoreError, match="differ"):
        edited_settings(OpenedKeystore(root), present_settings(OpenedKeystore(root)))


def test_without_an_edit_there_is_nothing_to_take(root: Path) -> None:
    with pytest.raises(KeystoreError, match=r"no file .* was edited"):
        edited_settings(OpenedKeystore(root), present_settings(OpenedKeystore(root)))


def test_a_keystore_from_before_the_record(root: Path) -> None:
    """Without the settings in the ledger, an edited protection is still found."""
    ledger = root / "ledger.jsonl"
    lines = [x for x in ledger.read_text().splitlines() if '"what":"settings"' not in x]
    ledger.write_text("\n".join(lines) + "\n")
    assert "governance.not-as-settings" not in found(root)
    _stronger_settings(root)
    assert "governance.not-as-settings" in found(root)


# ── the verb ───────────────────────────────────────────────────────────────────────────────


def test_a_dry_run_says_what_the_run_does_and_changes_nothing(root: Path) -> None:
    before = snapshot(root)
    words = ("update_keystore", root, "--template", "production")
    would = json.loads(sros(*words, "--dry-run", "--json").ok().out)
    text = sros(*words, "--dry-run").ok()
    assert snapshot(root) == before
    done = json.loads(sros(*words, "--json").ok().out)
    for key in ("settings", "rights", "changes", "restart", "done", "template"):
        assert would[key] == done[key], key
    named = [[(each["name"], each["outcome"]) for each in e["enclaves"]] for e in (would, done)]
    assert named[0] == named[1] != []
    assert "tighter  protection.rtps SIGN -> ENCRYPT: whole messages: encrypted" in text.out
    assert "/free would lose: publish topic /*" in text.out
    assert "would replace" in text.out
    assert "restart all processes together" in text.err
    assert "--revoke-old" in text.err


def test_enclaves_that_lose_the_same_share_a_line(root: Path) -> None:
    create_enclaves(root, [f"/free{number}" for number in range(9)], now=NOW)
    lines = sros("update_keystore", root, "--template", "production").ok().out.splitlines()
    (line,) = [each for each in lines if " lose: " in each]
    assert line.startswith(
        "/free, /free0, /free1, /free2, /free3 and 5 more lose: publish topic /*"
    )


def test_a_looser_dry_run_is_refused_as_the_run_is(root: Path) -> None:
    words = ("update_keystore", root, "--set", "protection.rtps=NONE")
    assert sros(*words, "--dry-run").status == 1
    assert sros(*words, "--dry-run", "--allow-looser").status == 0
    ended = sros(*words)
    assert (ended.status, "--allow-looser" in ended.err) == (2, True)
    sros(*words, "--allow-looser").ok()


def test_the_options(root: Path) -> None:
    sros(
        "update_keystore", root, "--domain", "0,7", "--rule",
        "topic /camera/* data=NONE metadata=SIGN", "--allow-looser",
    ).ok()  # fmt: skip
    assert str(present_settings(OpenedKeystore(root)).domains) == "0,7"
    sros("update_keystore", root, "--drop-rule", "topic /camera/*").ok()
    assert (
        OpenedKeystore(root)
        .governance.domain_access_rules[0]
        .topic_access_rules[0]
        .topic_expression
        == "*"
    )
    _stronger_settings(root)
    assert "--take-edits" in sros("update_keystore", root, "--set", "protection.rtps=NONE").err
    sros("update_keystore", root, "--take-edits").ok()
    assert OpenedKeystore(root).template.protection.rtps == "ENCRYPT"
    _put(root / "sros.toml", 'rtps = "ENCRYPT"', 'rtps = "NONE"')
    sros("update_keystore", root, "--discard-edits").ok()
    assert OpenedKeystore(root).template.protection.rtps == "ENCRYPT"


@pytest.mark.parametrize(
    "words",
    [
        (),
        ("--set", "protection.rtps"),
        ("--set", "protection.rtps=LOUD"),
        ("--rule", "topic /a"),
        ("--rule", "node /a data=NONE"),
        ("--drop-rule", "topic /a"),
        ("--domain", "x"),
        ("--template", "production", "--take-edits"),
        ("--take-edits", "--discard-edits"),
        ("--template", "production", "--take-edits", "--discard-edits"),
        ("--take-edits", "--next"),
    ],
)
def test_wrong_usage_changes_nothing(words: tuple[str, ...], root: Path) -> None:
    before = snapshot(root)
    assert sros("update_keystore", root, *words).status == 2
    assert snapshot(root) == before


def test_no_keystore(tmp_path: Path) -> None:
    with pytest.raises(SrosError):
        present_settings(OpenedKeystore(tmp_path))


def test_the_settings_are_in_the_ledger(root: Path) -> None:
    to(root, "production")
    entries = [each for each in OpenedKeystore(root).ledger.entries if each.what == "settings"]
    assert ['name = "production"' in each.settings for each in entries] == [False, True]


PERMISSIONS_VALIDITY = "KEYSTORE --set permissions.validity=2d --allow-looser`"


@for_every(
    [
        ("180d", {}, "/operator/anna", ""),
        ("180d", {"/operator/*": 1}, "/base", ""),
        ("180d", {"/operator/*": 48}, "/operator/anna", ""),
        ("2030-01-01", {}, "/base", ""),
        ("1d", {}, "/base", PERMISSIONS_VALIDITY),
        ("5h", {"/operator/*": 24}, "/operator/anna", PERMISSIONS_VALIDITY),
        ("180d", {"/operator/*": 1}, "/operator/anna", 'write validity = "2d" there, and run'),
        ("1d", {"/operator/*": 1}, "/operator/anna", 'write validity = "2d" there, and run'),
    ]
)
def test_the_setting_that_limits_permissions_is_the_one_to_lengthen(
    case: tuple[str, dict[str, int], str, str],
) -> None:
    usual, short, enclave, said = case
    settings = replace(
        load_template("production"),
        permissions_validity=parse_span(usual),
        short_lived=tuple(
            ShortLivedEnclaves(name, timedelta(hours=h)) for name, h in short.items()
        ),
    )
    remedy = lengthening_remedy(settings, enclave)
    assert (said in remedy) if said else not remedy, remedy


def test_without_settings_both_places_of_the_validity_are_named() -> None:
    assert "[[enclaves]]" in lengthening_remedy(None, "/a")
    assert "in [permissions]" in lengthening_remedy(None, "/a")
