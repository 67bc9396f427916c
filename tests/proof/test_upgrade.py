"""`check --upgrade-to` names what an update changes in a keystore: that, and nothing else."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import permutations
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes

from sros_tool.checks.keystores.opened import Circumstances
from sros_tool.cli.common import now
from sros_tool.dds.advisories import parse_advisories
from sros_tool.dds.decision.vendors import TESTED
from sros_tool.distributions import SUPPORTED, Distribution, Shipped, find_distribution
from sros_tool.errors import DocumentError
from sros_tool.files import policies_dir
from sros_tool.fleet.fleet_file import read_fleet
from sros_tool.keystore.fleet import stated_distributions
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.proof.upgrade import changes, check_distributions, check_upgrade, signed_files
from tests.checks.bench import DAY, SECRET, Bench, name_of
from tests.checks.keystore_cases import IS_CA, own_signature, with_zenoh
from tests.checks.test_vendor_refusals import (
    code_signing,
    crashing_first,
    signed_below,
    without_constraints,
)
from tests.support.harness import policy_text, sros
from tests.support.long_form import some

pytest_plugins = ["tests.checks.sound_keystore"]

# Releases that were tested and differ, whatever the distributions ship.
BEFORE = find_distribution("jazzy")._replace(fast="2.9.1", cyclone="0.10.5")
AFTER = find_distribution("lyrical")._replace(fast="2.14.5", cyclone="11.0.1")
ALLOW, DISCOVERY, STATUS = (
    "<allow_rule>",
    "<topic>ros_discovery_info</topic>",
    "<topic>rt/status</topic>",
)
HEARD = "<topic>rt/x</topic>"
LARGE = STATUS + "".join(f"<topic>rt/{'x' * 100}{number}</topic>" for number in range(700))
OPPOSITE = {
    "opens": "closes",
    "closes": "opens",
    "refused": "accepted",
    "accepted": "refused",
}


def denied(publish: str = "", subscribe: str = "") -> tuple[str, str]:
    """The change of permissions that puts a deny rule first."""
    parts = "".join(
        f"<{verb}><topics><topic>{topic}</topic></topics></{verb}>"
        for verb, topic in (("publish", publish), ("subscribe", subscribe))
        if topic
    )
    domains = "<domains><id>0</id></domains>"
    return ALLOW, f"<deny_rule>{domains}{parts}</deny_rule>{ALLOW}"


def self_signed(bench: Bench) -> None:
    """Take one CA for both jobs, and have an enclave sign its own permissions."""
    usage = x509.KeyUsage(True, False, False, False, False, True, True, False, False)
    both = bench.new_authority(IS_CA, (usage, True))
    for role in ("identity", "permissions"):
        bench.adopt(role, both)
    own_signature(bench)


def expired_authority(bench: Bench) -> None:
    """Take a permissions CA that expired yesterday."""
    _, key = bench.new_authority(IS_CA)
    name = name_of(("CN", "old CA"))
    builder = x509.CertificateBuilder(
        name, name, key.public_key(), 99, bench.now - 99 * DAY, bench.now - DAY
    )
    certificate = builder.add_extension(*IS_CA).sign(key, hashes.SHA256())
    bench.adopt("permissions", (certificate, key))


def reversed_subject(text: str) -> str:
    def backwards(found: re.Match[str]) -> str:
        return ",".join(reversed(found[0].split(",")))

    return re.sub("(?<=<subject_name>)[^<]*", backwards, text)


def denied_status(bench: Bench, name: str) -> None:
    bench.permissions(denied(subscribe="rt/status"), name=name)


def several(bench: Bench) -> None:
    denied_status(bench, "arm")
    bench.governance(("participants>false", "participants>true"))


def earlier_zenoh_files(bench: Bench) -> None:
    """Write the rules for topics as sros did before Lyrical."""
    with_zenoh(bench)
    router = bench.path("enclaves/router/router.json5")
    text = router.read_text()
    assert "$*::$*/*/**" in text
    router.write_text(text.replace("$*::$*/*/**", "$*::$*/*"))


FAST, CYCLONE = "Fast DDS", "Cyclone DDS"
PLANTED: dict[str, tuple[Callable[[Bench], object], set[tuple[str, str, str]]]] = {
    "a topic that is denied to publish, and may be heard": (
        lambda b: b.permissions(
            denied(publish="rt/x"), (DISCOVERY, f"{DISCOVERY}<topic>rt/x</topic>")
        ),
        {("opens", CYCLONE, "/base: subscribe topic /x")},
    ),
    "a topic that is denied to hear, and may be published": (
        lambda b: b.permissions(denied(subscribe="rt/status")),
        {("opens", CYCLONE, "/base: publish topic /status")},
    ),
    "the same of both enclaves": (
        lambda b: list(map(partial(denied_status, b), ("base", "arm"))),
        {("opens", CYCLONE, "/arm, /base: publish topic /status")},
    ),
    "the same inside of wildcards": (
        lambda b: b.permissions(denied(subscribe="rt/st?t*"), (STATUS, "<topic>rt/s*s</topic>")),
        {("opens", CYCLONE, "/base: publish topic /status")},
    ),
    "a name with a hyphen": (
        lambda b: b.permissions((STATUS, "<topic>rt/a-b</topic>")),
        {("opens", CYCLONE, "/base: publish topic /a-b")},
    ),
    "a topic of no ROS node": (
        lambda b: b.permissions((STATUS, "<topic>9/x</topic>")),
        {("opens", CYCLONE, "/base: publish DDS topic 9/x")},
    ),
    "a permissions CA for code signing": (
        code_signing,
        {("accepted", FAST, "/arm, /base"), ("accepted", CYCLONE, "/arm, /base")},
    ),
    "a signer below the permissions CA": (
        signed_below,
        {("refused", FAST, "/arm, /base"), ("refused", CYCLONE, "/arm, /base")},
    ),
    "permissions that an enclave gave itself": (
        self_signed,
        {("refused", FAST, "/base"), ("refused", CYCLONE, "/base")},
    ),
    "an identity CA without basicConstraints": (
        without_constraints("identity"),
        {("refused", FAST, "/arm, /base")},
    ),
    "a permissions CA without basicConstraints": (
        without_constraints("permissions"),
        {("refused", FAST, "/arm, /base")},
    ),
    "a CA that crashes the process": (crashing_first, {("refused", FAST, "/arm, /base")}),
    "an expired permissions CA": (
        expired_authority,
        {("accepted", CYCLONE, "/arm, /base")},
    ),
    "unauthenticated participants with protected RTPS": (
        lambda b: b.governance(("participants>false", "participants>true")),
        {("refused", FAST, "/arm, /base")},
    ),
    "permissions that are too large": (
        lambda b: b.permissions((STATUS, LARGE)),
        {("accepted", FAST, "/base")},
    ),
    "blanks in the subject of a grant": (
        lambda b: b.permissions(("<subject_name>CN=", "<subject_name>CN = ")),
        {("accepted", FAST, "/base"), ("accepted", CYCLONE, "/base")},
    ),
    "a subject in another order": (
        lambda b: b.sign("enclaves/base/permissions.p7s", reversed_subject),
        {("accepted", FAST, "/base")},
    ),
    "differences of two kinds": (
        several,
        {("refused", FAST, "/arm, /base"), ("opens", CYCLONE, "/arm: publish topic /status")},
    ),
    "Zenoh files of before": (
        earlier_zenoh_files,
        {("zenoh-buffers", "", "for /parameter_events, /rosout, /status")},
    ),
    "nothing": (lambda b: None, set()),
}


VULNERABLE, EXPIRED = "upgrade.vulnerabilities", "upgrade.expired-peers"
FOUND = {
    *(f"upgrade.{kind}" for _, wanted in PLANTED.values() for kind, *_ in wanted),
    *("upgrade.closes", "upgrade.zenoh-release", "upgrade.node-cannot-start"),
    *("distribution.not-measured", "distribution.differ", "distribution.refused"),
    *(VULNERABLE, EXPIRED),
}
"""The ids of findings that the tests of this file bring about."""


def changed(
    bench: Bench, before: Distribution = BEFORE, after: Distribution = AFTER
) -> set[tuple[str, str, str]]:
    """The findings, each as its kind, the product that it is about, and how its text begins."""
    changes = set()
    found = check_upgrade(bench.root, after, Circumstances(bench.now), present=before)
    for finding in found.findings:
        kind = finding.id.removeprefix("upgrade.")
        if kind in ("zenoh-release", "vulnerabilities", "expired-peers"):
            continue
        product = next((name for name in (FAST, CYCLONE) if name in finding.text), "")
        text = f"{finding.subject}: {finding.text}".partition(": open on")[0]
        assert "KEYSTORE" not in finding.text and finding.remedy
        if kind in ("refused", "accepted"):
            text = finding.subject
        elif not product:
            text = finding.text
        changes.add((kind, product, text))
    return changes


@pytest.mark.parametrize("name", some([*PLANTED], 6))
def test_an_update_changes_what_was_planted(name: str, bench: Bench) -> None:
    plant, wanted = PLANTED[name]
    plant(bench)
    assert changed(bench) == wanted
    back = {(OPPOSITE[kind], *rest) for kind, *rest in wanted if kind in OPPOSITE}
    assert changed(bench, AFTER, BEFORE) == back
    assert changed(bench, BEFORE, BEFORE._replace(until="")) == set()


def test_an_update_changes_nothing_of_shipped_policies(tmp_path: Path) -> None:
    """For all ROS names, all tested vendors decide alike on the form that sros writes."""
    root = tmp_path / "ks"
    sros("create_keystore", root, "--template", "production").ok()
    policies = [word for file in sorted(policies_dir().glob("*.xml")) for word in ("-p", file)]
    sros("generate_artifacts", "-k", root, *policies).ok()
    keystore = OpenedKeystore(root)
    assert len(keystore.names) > 20
    first, *others = (
        Shipped(vendor.traits.product, vendor.release, vendor, SUPPORTED[0]) for vendor in TESTED
    )
    files = signed_files(keystore, Circumstances(now()))
    # Many wildcards take long, unless both vendors have the same style of them.
    few = files.only_for(name for name in keystore.names if not name.startswith("/operator"))
    for other in some(others, 1):
        alike = other.vendor.traits.style is first.vendor.traits.style
        assert list(changes(files if alike else few, first, other)) == []
    at = Circumstances(now())
    for before, after in some(list(permutations(SUPPORTED, 2)), 1):
        found = check_upgrade(root, after, at, present=before).findings
        assert {each.id for each in found} <= {"distribution.not-measured", VULNERABLE, EXPIRED}


@pytest.mark.parametrize(
    ("before", "after", "does"),
    [
        ("jazzy", "kilted", "lose each other"),
        ("kilted", "lyrical", "keep communicating"),
        ("jazzy", "lyrical", ""),
    ],
)
def test_an_update_changes_what_an_expiry_does(
    before: str, after: str, does: str, bench: Bench
) -> None:
    found = check_upgrade(
        bench.root, find_distribution(after), Circumstances(bench.now), vendor="fastdds",
        present=find_distribution(before),
    ).findings  # fmt: skip
    texts = [finding.text for finding in found if finding.id == EXPIRED]
    wanted = f"with the new release, running processes {does} when the certificate of one of them "
    wanted += "expires"
    assert texts == ([wanted] if does else [])


def test_an_update_mends_and_brings_known_vulnerabilities(bench: Bench) -> None:
    jazzy, lyrical = find_distribution("jazzy"), find_distribution("lyrical")
    at = Circumstances(bench.now)
    texts = [
        {
            finding.subject: finding.text
            for finding in check_upgrade(bench.root, after, at, present=before).findings
            if finding.id == VULNERABLE
        }
        for before, after in ((jazzy, lyrical), (lyrical, jazzy), (jazzy, jazzy._replace(until="")))
    ]
    there, back = "Fast DDS 2.14.6 to 3.6.2", "Fast DDS 3.6.2 to 2.14.6"
    assert texts[0][there].startswith("9 stay; fixed: CVE-")
    assert texts[1][back] == texts[0][there].replace("fixed", "new")
    assert texts[0]["Cyclone DDS 0.10.5 to 11.0.1"] == "fixed: CVE-2023-24011"
    assert texts[2] == {}
    releases = {"introduced": "2.14.0"}, {"fixed": "3.0.0"}
    record: dict[str, object] = {
        "id": "CVE-2030-12345",
        "affected": [
            {
                "package": {"name": "github.com/eProsima/Fast-DDS"},
                "ranges": [{"type": "SEMVER", "events": releases}],
            }
        ],
    }
    for lines, said in (([], "fixed: "), (["3.6"], "not known for 3.6.2: ")):
        record["database_specific"] = {"unclear_lines": lines}
        advisories = parse_advisories(json.dumps(record).encode(), "it")
        asked = replace(at, advisories=advisories)
        (finding,) = (
            finding
            for finding in check_upgrade(bench.root, lyrical, asked, present=jazzy).findings
            if finding.id == VULNERABLE
        )
        assert finding.text == f"{said}CVE-2030-12345"


def test_what_an_update_cannot_show_is_said(bench: Bench) -> None:
    """A release that was not tested, and the versions of rmw_zenoh that the files need."""
    with_zenoh(bench)
    unknown = AFTER._replace(fast="99.1.0")
    found = check_upgrade(bench.root, unknown, Circumstances(bench.now), present=BEFORE).findings
    ids = [each.id for each in found if each.id not in (VULNERABLE, EXPIRED)]
    assert ids == ["distribution.not-measured", "upgrade.zenoh-release"]
    assert "Fast DDS 99.1, assumed to decide as Fast DDS" in found[0].text


def test_nodes_of_a_later_distribution_need_more(bench: Bench) -> None:
    humble, jazzy = find_distribution("humble"), find_distribution("jazzy")
    same = humble._replace(fast=jazzy.fast, cyclone=jazzy.cyclone)
    assert changed(bench, same, jazzy) == set()
    service = "get_type_description"
    bench.permissions((service, "get_other"))
    found = check_upgrade(bench.root, jazzy, Circumstances(bench.now), present=same).findings
    assert {each.id for each in found} == {"upgrade.node-cannot-start"}
    assert f"in ROS 2 Jazzy, no node may offer ~/{service}" in found[0].text
    assert changed(bench, jazzy, same) == set()


def test_a_keystore_says_for_which_distributions_it_is(bench: Bench) -> None:
    secret = {"SROS_CA_PASSPHRASE": SECRET}
    denied_status(bench, "base")
    checked = partial(check_distributions, at=Circumstances(bench.now))
    assert checked(OpenedKeystore(bench.root)) == []
    words = ("update_keystore", bench.root, "--set", "distributions=lyrical,jazzy")
    sros(*words, env=secret).ok()
    assert 'distributions = ["jazzy", "lyrical"]' in bench.path("sros.toml").read_text()
    (found,) = checked(OpenedKeystore(bench.root))
    assert (found.id, found.subject) == ("distribution.differ", "/base")
    assert (
        "publish topic /status: open on Lyrical with Cyclone DDS 11.0, closed on Jazzy"
        in found.text
    )
    assert "[distribution.differ]" in sros("check", bench.root).out
    update = sros("check", bench.root, "--upgrade-to", "lyrical", "--json")
    assert update.status == 1
    assert "upgrade.opens" in {each["id"] for each in json.loads(update.out)["findings"]}


def test_an_enclave_that_one_distribution_refuses(bench: Bench) -> None:
    words = ("update_keystore", bench.root, "--set", "distributions=jazzy,lyrical")
    sros(*words, env={"SROS_CA_PASSPHRASE": SECRET}).ok()
    assert check_distributions(OpenedKeystore(bench.root), Circumstances(bench.now)) == []
    expired_authority(bench)
    (found,) = check_distributions(OpenedKeystore(bench.root), Circumstances(bench.now))
    assert found.id == "distribution.refused"
    assert found.text.startswith("Jazzy with Cyclone DDS 0.10 refuses it (permissions_ca.cert.pem")


def test_a_robot_of_a_fleet_has_a_distribution_of_its_own(tmp_path: Path) -> None:
    fleet = tmp_path / "fleet.toml"
    fleet.write_text(
        '[groups.old]\ndistribution = "humble"\n[robots]\nr1 = { groups = ["old"] }\nr2 = {}\n'
    )
    policy = tmp_path / "policy.xml"
    policy.write_text(
        policy_text({"/{robot}/base": '<topics publish="ALLOW"><topic>x</topic></topics>'})
    )
    root = tmp_path / "ks"
    sros("create_keystore", root).ok()
    sros("generate_artifacts", "-k", root, "-p", policy, "--fleet", fleet).ok()
    refused = sros("check", root, "--upgrade-to", "jazzy", env={"ROS_DISTRO": None})
    assert "from which distribution /r2/base is updated to Jazzy" in refused.err
    assert refused.status == 2
    sros("update_keystore", root, "--set", "distributions=jazzy").ok()
    keystore = OpenedKeystore(root)
    assert stated_distributions(keystore, "/r1/base") == ("humble",)
    assert stated_distributions(keystore, "/r2/base") == ("jazzy",)
    compared = sros("check", root, "--upgrade-to", "jazzy", env={"ROS_DISTRO": None}).ok()
    assert compared.err.splitlines()[0] == "compared 1 enclave; 1 enclave is already for Jazzy"
    fleet.write_text('[robots]\nr1 = { distribution = "Humble" }\n')
    with pytest.raises(DocumentError, match="It is not a ROS 2 distribution that sros knows"):
        read_fleet(fleet)


@pytest.mark.parametrize(
    ("words", "why"),
    [
        ((), "it is not known from which distribution"),
        (("--distro", "lyrical"), "it is not known from which distribution"),
        (("--distro", "jazzy", "--all-distros"), "exclude each other"),
        (("--distro", "jazzy", "--suggest"), "exclude each other"),
    ],
)
def test_an_update_that_cannot_be_compared(words: tuple[str, ...], why: str, bench: Bench) -> None:
    asked = ("check", bench.root, "--upgrade-to", "lyrical")
    here: dict[str, str | None] = {"ROS_DISTRO": None}
    refused = sros(*asked, *words, env=here)
    assert refused.status == 2 and why in refused.err
    compared = sros(*asked, "--distro", "jazzy", env=here).ok()
    assert re.match(r"compared [1-9]\d* enclaves\n", compared.err)


def test_all_policies_of_a_folder_are_compared(tmp_path: Path) -> None:
    folder = tmp_path / "policies"
    (folder / "arm").mkdir(parents=True)
    words = ("check", folder, "--distro", "jazzy", "--upgrade-to", "lyrical")
    assert "takes one policy file, folder of policies or keystore" in sros(*words).err
    rights = '<topics subscribe="ALLOW"><topic>*</topic></topics>'
    rights += '<topics publish="DENY"><topic>x</topic></topics>'
    for file in (folder / "base.xml", folder / "arm/hand.xml"):
        file.write_text(policy_text({f"/{file.stem}": rights}))
    update = sros(*words, "--json")
    assert "compared 2 enclaves\n" in update.err
    found = [(each["id"], each["subject"]) for each in json.loads(update.out)["findings"]]
    assert found.count(("upgrade.vulnerabilities", "Cyclone DDS 0.10.5 to 11.0.1")) == 1
    assert {subject for kind, subject in found if kind == "upgrade.opens"} == {"/base", "/hand"}


def test_an_empty_keystore_says_how_many_enclaves_were_compared(tmp_path: Path) -> None:
    sros("create_keystore", tmp_path / "ks").ok()
    words = ("check", tmp_path / "ks", "--distro", "jazzy", "--upgrade-to", "kilted")
    assert "compared 0 enclaves\n" in sros(*words).ok().err
