"""Commands for `tests/cli/test_json.py`, and the folder in which they run."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from sros_tool.files import templates_dir
from sros_tool.keystore.confirmation import MESSAGE_FILE
from sros_tool.pki.certificates import make_request
from tests.keystore.test_confirmation import DDS
from tests.support.harness import copy_of, policy_text, publish, sros
from tests.support.messages import key_of, said_by, signed_message
from tests.support.zenoh_configurations import denying, self_limiting

WITHOUT_JSON = {
    "run": "it becomes the command that it runs, whose output is the result",
    "completion": "it prints the script of a shell",
    "fleet inventory": "it prints an inventory, which is JSON of Ansible",
    "fleet report": "it prints a confirmation, which is JSON of a format of its own",
}
"""The verbs without ``--json``, and why."""


@dataclass(frozen=True)
class Case:
    """A command without ``--json``, its exit status, and the commands that run before it."""

    words: str
    status: int = 0
    before: tuple[str, ...] = ()


LOGS = Path(__file__).parents[1] / "explain"
DENIALS = LOGS / "denial_logs" / "fastdds_2.9.1.log"
EXPIRED = LOGS / "logs" / "cyclone_0.10.2.certificate_expired.log"

_WILD = """<topics publish="ALLOW" subscribe="ALLOW"><topic>/*</topic></topics>
<services request="ALLOW"><service>/s*</service></services>"""
_SUBSCRIBE = '<topics subscribe="ALLOW"><topic>/x</topic></topics>'
_DENIED = '<topics publish="DENY"><topic>/x</topic></topics>'
POLICIES = {
    "crew.xml": policy_text({"/{robot}": publish("/x")}),
    "policy.xml": policy_text({"/a": publish("/x"), "/b": publish("/y") + _SUBSCRIBE}),
    "other.xml": policy_text({"/a": publish("/x", "/z"), "/new": publish("/x")}),
    "protected.xml": policy_text({"/a": publish('/x<?sros protect="sign"?>')}),
    "denied.xml": policy_text({"/a": _DENIED, "/b": publish("/x")}),
    "guarded.xml": policy_text(
        {"/a": _WILD + _DENIED.replace("topic", "service").replace("publish", "request")}
    ),
    "moved.xml": policy_text({"/a": f'{_WILD}</profile><profile ns="/" node="m">{publish("/x")}'}),
    "wild.xml": policy_text({"/a": _WILD, "/b": publish("/x")}),
    "relative.xml": policy_text({"/a": publish("x"), "/b": publish("/y") + _SUBSCRIBE}),
    "quiet.xml": policy_text({"/a": publish("/x"), "/quiet": ""}),
    "silent.xml": policy_text({"/a": "", "/b": publish("/x")}),
    "large.xml": policy_text({"/a": publish(*(f"/{'n' * 60}/x{i}" for i in range(900)))}),
    "equal.xml": policy_text(
        {f"/r{n}": publish(*(f"/r{n}/{e}" for e in ("xyq" if n == 4 else "xyz"))) for n in range(5)}
    ),
}


def make_folder(folder: Path) -> None:
    """Fill a folder with what the cases name: keystores in several states, a robot, policies."""
    for name, text in POLICIES.items():
        (folder / name).write_text(text)
    settings = (templates_dir() / "production.toml").read_text()
    half_over = f'"{datetime.now(UTC).year - 8}-01-01T00:00:00Z/15y"'
    (folder / "old.toml").write_text(re.sub('"[0-9]+[05][yd]"|"5y"', half_over, settings))
    (folder / "crew.toml").write_text('[robots.a]\nrenewal = "allowed"\n[robots.b]\n')
    for name, domain in (("near.toml", 1), ("far.toml", 2)):
        (folder / name).write_text(f"[robots.a]\ndomain = {domain}\n")
    (folder / "required.toml").write_text('[[nobody]]\npublish = ["/x"]\n')
    (folder / "quiet.log").write_text("nothing to see\n")
    for line in (
        "create_keystore ks",
        "create_keystore empty",
        "create_keystore single --ca-layout single",
        "generate_artifacts -k ks -p policy.xml -e /c",
        "revoke ks /c",
        "create_request /r robot",
        "create_request /s robot",
        "sign_request ks robot/enclaves/r/request.pem -o r.tgz",
        "sign_request single robot/enclaves/r/request.pem -o single.tgz",
        "distribute_key ks /a out",
        "create_enclave single /a",
        "revoke single /a",
        "rotate_ca single --next",
        "generate_artifacts -k zenoh -p policy.xml -e /spare",
        "create_keystore elsewhere --identity-key file:identity.pem",
        "create_keystore crew --template old.toml",
        "generate_artifacts -k crew -p crew.xml --fleet crew.toml",
        "generate_artifacts -k fresh -p crew.xml --fleet crew.toml",
    ):
        sros(*line.split(), cwd=folder).ok()
    for copy in ("turned", "broken", "lost", "wrecked", "partial", "fleet"):
        copy_of(folder / "ks", folder / copy)
    sros("rotate_ca", "turned", "--next", cwd=folder).ok()
    shutil.copytree(folder / "out", folder / "token")
    (folder / "token/enclaves/a/key.pem").unlink()
    (folder / "token/enclaves/a/key.p11").write_text("pkcs11:token=t;object=o;type=private\n")
    (folder / "fleet/fleet.toml").write_text('enclaves = ["/{robot}"]\n[robots.a]\n')
    with (folder / "fleet/fleet.toml").open("a") as fleet:
        fleet.write("[robots.b]\n")
    for robot in ("a", "b"):
        said = sros("fleet", "report", "out", "--robot", robot, cwd=folder).ok()
        confirmed = {**json.loads(said.out), "dds": DDS}  # not that of this machine
        (folder / f"{robot}.json").write_text(json.dumps(confirmed, indent=1))
    make_inboxes(folder)
    slow = (folder / "a.json").read_text().replace('"time": "20', '"time": "19')
    (folder / "slow.json").write_text(slow)
    (folder / "partial/enclaves/a/permissions.p7s").unlink()
    copy_of(folder / "zenoh", folder / "closed")
    sros("zenoh", "closed", cwd=folder).ok()
    copy_of(folder / "zenoh", folder / "lacking")
    (folder / "lacking/enclaves/b/permissions.p7s").unlink()
    (folder / "closed/enclaves/b/session.json5").unlink()
    (folder / "open.json5").write_text("{mode: 'router'}")
    repository = folder / "git"
    repository.mkdir()
    for name in ("policy.xml", "required.toml"):
        shutil.copy(folder / name, repository)
    person = ("-c", "user.name=a", "-c", "user.email=a@example.org")
    for words in (["init", "-q"], ["add", "--all"], [*person, "commit", "-q", "-m", "first"]):
        subprocess.run(["git", "-C", str(repository), *words], check=True)
    (folder / "self_limiting.json5").write_text(self_limiting())
    (folder / "denying.json5").write_text(denying())
    (folder / "lost/public/identity_ca.crl.pem").unlink()
    (folder / "broken/enclaves/b/cert.pem").write_text("x")
    (folder / "broken/published.json").write_text("x")
    ledger = folder / "broken/ledger.jsonl"
    ledger.write_bytes(b"".join(ledger.read_bytes().splitlines(keepends=True)[1:]))
    for file in ("public/identity_ca.cert.pem", "public/permissions_ca.cert.pem"):
        (folder / "wrecked" / file).write_text("x")
    (folder / "wrecked/enclaves/governance.p7s").write_text("x")


def make_inboxes(folder: Path) -> None:
    """Make inboxes with what robots of the keystores `crew` and `fresh` say and ask for."""
    for keystore in ("crew", "fresh"):
        robot = folder / f"of_{keystore}"
        sros("distribute_key", keystore, "/a", "/b", robot, cwd=folder).ok()
        requests = tuple(make_request(key_of(robot, name), name).decode() for name in ("/a", "/b"))
        for name in ("a", "b"):
            said = said_by(robot, name, datetime(2026, 1, 1, tzinfo=UTC), requests=requests)
            (folder / f"from_{keystore}" / name).mkdir(parents=True)
            message = signed_message(robot, f"/{name}", said)
            (folder / f"from_{keystore}" / name / MESSAGE_FILE).write_bytes(message)
    (folder / "good/a").mkdir(parents=True)
    message = signed_message(robot, "/a", said_by(robot, "a", datetime.now(UTC), sequence=2))
    (folder / "good/a" / MESSAGE_FILE).write_bytes(message)
    # The last message of an inbox that the robot used before.
    (folder / "older/a").mkdir(parents=True)
    before = datetime.now(UTC) - timedelta(hours=1)
    message = signed_message(robot, "/a", said_by(robot, "a", before))
    (folder / "older/a" / MESSAGE_FILE).write_bytes(message)
    os.utime(folder / "older/a" / MESSAGE_FILE, (before.timestamp(),) * 2)
    (folder / "from_fresh/b" / MESSAGE_FILE).write_bytes(b"no message")
    (folder / "from_fresh/stranger").mkdir()
    copy_of(folder / "crew", folder / "unable")
    copy_of(folder / "fresh", folder / "edited")
    (folder / "edited/enclaves/b/permissions.p7s").write_bytes(b"no message")
    for key in folder.glob("unable/private/*.key.pem"):
        key.unlink()


CASES: dict[str, tuple[Case, ...]] = {
    "create_keystore": (
        Case("new"),
        Case("new --dry-run --ca-layout single --domain 3"),
        Case(
            "new --identity-ca ks/public/identity_ca.cert.pem --identity-key file:ks/private/"
            "identity_ca.key.pem"
        ),
        Case(
            "new --dry-run --identity-ca ks/public/identity_ca.cert.pem --identity-key file:ks/"
            "private/identity_ca.key.pem"
        ),
    ),
    "create_enclave": (
        Case("ks /a /new"),
        Case("ks /a /new --dry-run"),
        Case("ks /a /A"),
        Case("partial /a"),
    ),
    "create_permission": (Case("ks /a policy.xml"), Case("ks /a policy.xml --dry-run")),
    "generate_artifacts": (
        Case("-k ks -p other.xml -e /spare"),
        Case("-k ks -p policy.xml"),
        Case("-k ks -e /a"),
        Case("-k partial -e /a"),
        Case("-k new -p policy.xml"),
        Case("-k new -p policy.xml --dry-run"),
    ),
    "update_keystore": (
        Case("ks --template production --dry-run"),
        Case("ks --template production --next --revoke-old"),
        Case("ks --set protection.rtps=NONE --dry-run", 1),
        Case("ks --domain 0,7 --set authorities.validity=20y --allow-looser"),
        Case("ks --template development"),
    ),
    "list_enclaves": (
        Case("ks"),
        Case("empty"),
        Case("fleet --robot a"),
        Case("ks --match *"),
        Case("-p policy.xml"),
    ),
    "inspect": (
        Case("ks"),
        Case("token"),
        Case("token/enclaves/a"),
        Case("token/enclaves/a/key.p11"),
        Case("turned"),
        Case("broken", 1),
        Case("wrecked", 1),
        Case("single"),
        Case("robot", 1),
        Case("ks/enclaves/a"),
        Case("ks/enclaves/b/cert.pem"),
        Case("turned/public/identity_ca.cert.pem"),
        Case("ks/public/identity_ca.crl.pem"),
        Case("ks/private/identity_ca.key.pem"),
        Case("ks/enclaves/a/permissions.p7s"),
        Case("ks/enclaves/a/permissions.xml"),
        Case("ks/enclaves/governance.p7s"),
        Case("ks/enclaves/governance.xml"),
        Case("closed"),
        Case(
            "zenoh",
            before=("zenoh zenoh --endpoint a:1 --router /r1/router=b:1 --cross /x",),
        ),
        Case("zenoh/enclaves/a", before=("zenoh zenoh",)),
        Case("zenoh/enclaves/a/session.json5", before=("zenoh zenoh",)),
        Case("zenoh/enclaves/router/router.p7s", before=("zenoh zenoh --mode peer",)),
        Case("ks --history"),
        Case("broken --history", 1),
    ),
    "renew": (
        Case("ks /a"),
        Case("ks /a --dry-run"),
        Case("ks --all-expiring 1d"),
        Case("ks /a /b --revoke-old"),
    ),
    "revoke": (
        Case("ks /a --reason key_compromise"),
        Case("ks /a --dry-run"),
        Case("broken /a"),
    ),
    "crl": (
        Case("ks"),
        Case("empty"),
        Case("turned"),
        Case("ks --refresh"),
        Case("ks --refresh --dry-run"),
        Case("lost --refresh"),
    ),
    "zenoh": (
        Case("zenoh"),
        Case("zenoh --dry-run --mode peer"),
        Case("zenoh --endpoint a:7447 --router /r1/router=r1.local:7447 --cross /x"),
        Case("zenoh --check", 1),
        Case("zenoh --check", before=("zenoh zenoh",)),
        Case("lacking --check", 1),
        Case("--from closed/enclaves/router/router.json5 -o found.xml"),
        Case("--from closed/enclaves/a/session.json5 -o found.xml --dry-run"),
        Case("--from self_limiting.json5", 1),
        Case("--from open.json5", 1),
        Case("--from denying.json5", 1),
    ),
    "rotate_ca": (
        Case("ks"),
        Case("turned --status"),
        Case("ks --next"),
        Case("ks --next --dry-run"),
        Case("turned --next"),
        Case("ks --finish"),
        Case("ks --same-key"),
        Case("elsewhere --finish --identity-key file:new.pem"),
    ),
    "distribute_key": (
        Case("ks /a out"),
        Case("ks /b out"),
        Case("ks --all out.tar.gz"),
        Case("ks /b out --dry-run"),
        Case("ks /b new.tar.gz --dry-run"),
        Case("ks /a - --dry-run"),
    ),
    "verify": (Case("out"), Case("out --domain 7 --at 2000-01-01", 1)),
    "create_request": (
        Case("/r new"),
        Case("/r /t new --dry-run"),
        Case("/r robot --again"),
    ),
    "sign_request": (
        Case("ks robot/enclaves/r/request.pem -o answer.tgz --renew"),
        Case("ks robot/enclaves/s/request.pem -o answer.tgz"),
        Case("ks robot/enclaves/s/request.pem -o answer.tgz --dry-run"),
        Case("empty robot/enclaves/s/request.pem -o - --dry-run"),
        Case("ks robot/enclaves/r/request.pem --no-answer"),
    ),
    "import": (
        Case("r.tgz robot"),
        Case("r.tgz robot --dry-run"),
        Case("r.tgz robot", before=("import r.tgz robot",)),
        Case("r.tgz robot --ca ks/public/permissions_ca.cert.pem"),
        Case("single.tgz robot"),
    ),
    "generate_policy": (
        Case(f"--enclave /a --from-log {DENIALS}"),
        Case(f"new.xml --enclave /a --from-log {DENIALS} --accept"),
        Case(f"new.xml --enclave /a --from-log {DENIALS} --dry-run"),
        Case(f"new.xml --enclave /a --from-log {DENIALS} --dry-run --accept"),
        Case(f"new.xml --from-log {EXPIRED}", 1),
    ),
    "merge_policy": (
        Case("policy.xml other.xml"),
        Case("policy.xml other.xml -o new.xml"),
        Case("policy.xml other.xml --in-place --dry-run"),
        Case("policy.xml policy.xml --in-place"),
        Case("policy.xml denied.xml"),
    ),
    "diff_policy": (
        Case("policy.xml policy.xml"),
        Case("policy.xml other.xml", 1),
        Case("policy.xml ks", 1),
        Case("ks/enclaves/a/permissions.xml ks/enclaves/a", 0),
        Case("wild.xml policy.xml", 1),
        Case("policy.xml quiet.xml", 1),
        Case("relative.xml policy.xml", 1),
        Case("protected.xml policy.xml", 1),
        Case("crew.xml crew.xml --fleet near.toml --fleet far.toml", 1),
        Case("--no-new-access policy.xml policy.xml"),
        Case("--no-new-access policy.xml wild.xml", 1),
        Case("--no-new-access relative.xml policy.xml", 1),
        Case("--no-new-access guarded.xml moved.xml", 1),
        Case("--no-new-access denied.xml silent.xml"),
        Case("--no-new-access ks wild.xml", 1),
        Case("--no-new-access protected.xml policy.xml", 1),
        Case("--no-new-access policy.xml protected.xml"),
    ),
    "minimize_policy": (
        Case("policy.xml --observed other.xml"),
        Case("wild.xml --observed policy.xml other.xml -o new.xml"),
        Case("wild.xml --observed policy.xml -o new.xml --dry-run"),
        Case("large.xml --observed large.xml"),
    ),
    "policies": (
        Case(""),
        Case("--copy mine"),
        Case("--copy mine --dry-run"),
    ),
    "explain": (
        Case("ks /a publish /x --policy policy.xml"),
        Case("ks /a publish /nope --policy policy.xml", 1),
        Case("ks /a publish /x --policy denied.xml", 0),
        Case("ks /a join"),
        Case("broken /b publish /x", 1),
        Case("/a publish /x --policy denied.xml", 1),
        Case("/a publish /x --policy protected.xml"),
        Case("/a publish /x --policy protected.xml --all-vendors"),
        Case("ks /a publish /x --all-vendors"),
        Case("ks /a publish /x --policy policy.xml --all-vendors"),
        Case("ks /a publish /nope --policy policy.xml --all-vendors", 1),
        Case("/a publish /x --policy denied.xml --all-vendors", 1),
        Case("broken /b publish /x --all-vendors", 1),
        Case("ks /a publish /x --all-distros"),
        Case("closed /a publish /x --all-distros"),
        Case("broken /b publish /x --all-distros", 1),
        Case("ks --who publish /x"),
        Case("out --who publish /x"),
        Case("closed /a publish /x"),
        Case("closed /a publish /x --all-vendors"),
        Case("closed /a publish /x --vendor zenoh --policy policy.xml"),
        Case("closed /b publish /y --vendor zenoh", 1),
        Case(
            "zenoh /a publish /x --vendor zenoh --policy denied.xml",
            1,
            before=("create_permission zenoh /a denied.xml", "zenoh zenoh"),
        ),
        Case(
            "zenoh /a publish /nope --vendor zenoh",
            before=("create_permission zenoh /a wild.xml", "zenoh zenoh"),
        ),
        Case("closed --who publish /x --vendor zenoh"),
        Case("closed --who call /nope --vendor zenoh --match /a", 1),
        Case("ks --reach /a"),
        Case("ks --reach /b"),
        Case(f"ks /a --log {EXPIRED}", 1),
        Case("--log quiet.log"),
    ),
    "view": (
        Case("equal.xml"),
        Case("ks"),
        Case("policy.xml"),
        Case("policy.xml denied.xml"),
        Case("wild.xml --observed policy.xml"),
        Case("policy.xml --focus /x /a /b"),
        Case("out --focus /x"),
        Case("policy.xml --requirements required.toml"),
        Case("broken"),
        Case("ks -o new.json --dry-run"),
        Case("ks --dry-run"),
    ),
    "check": (
        Case("ks", 1),
        Case("ks --severity note", 1),
        Case("broken", 1),
        Case("policy.xml --requirements required.toml", 1),
        Case("out --requirements required.toml", 1),
        Case("empty --list"),
        Case("--list --include policy.*"),
        Case("keystore ks --needs-renewal 1d"),
        Case("keystore ks --needs-renewal 99y", 1),
        Case("keystore broken --needs-renewal 1d", 2),
    ),
    "units": (
        Case("ks /a new"),
        Case("ks --job check --sros /bin/sros new --dry-run"),
        Case("zenoh /a new --rmw rmw_zenoh_cpp", before=("zenoh zenoh",)),
    ),
    "close": (Case("none --dry-run"),),
    "review": (
        Case("--base none --policy policy.xml --repository git", 1),
        Case("--base none --policy policy.xml --requirements required.toml --repository git", 1),
        Case("--base none --policy none.xml --repository git", 2),
    ),
    "metrics": (
        Case("ks"),
        Case("broken -o new.prom"),
        Case("out --earliest -o new.prom --dry-run"),
    ),
    "agent init": (),
    "agent run": (),
    "agent status": (),
    "fleet confirm": (
        Case("fleet a.json --robot a"),
        Case("fleet slow.json --robot a"),
        Case("fleet a.json --robot a --dry-run"),
    ),
    "fleet collect": (
        Case("crew from_crew", 1),
        Case("crew from_crew --dry-run", 1),
        Case("fresh good --publish pub", before=("fleet collect fresh good",)),
        Case("fresh from_fresh", 1),
        Case("fresh from_fresh", 1, before=("renew fresh /a",)),
        Case("fresh good", before=("revoke fresh /b",)),
        Case("fresh older", before=("fleet collect fresh good",)),
        Case("unable from_crew", 2),
    ),
    "fleet publish": (
        Case("fresh pub"),
        Case("fresh pub --dry-run"),
        Case("fresh pub", before=("fleet publish fresh pub", "revoke fresh /b")),
        Case("edited pub", 1),
        Case("fresh pub --rotate-key snapshot", before=("fleet publish fresh pub",)),
    ),
    "fleet status": (
        Case("fleet", 1),
        Case("fleet --robot a", 1, before=("fleet confirm fleet a.json --robot a",)),
        Case("fleet", 1, before=("fleet confirm fleet b.json --robot b",)),
        Case("fresh", 1, before=("fleet publish fresh pub",)),
    ),
    "env": (
        Case("ks /a"),
        Case("ks /a --domain 0"),
        Case("zenoh /a --rmw rmw_zenoh_cpp", before=("zenoh zenoh",)),
        Case("ks /a --rmw rmw_zenoh_cpp", 2),
        Case("ks /none", 2),
        Case("ks /a /b", 2),
    ),
    "demo": (Case("--list"),),
    "doctor": (),
    "audit": (),
}
"""The commands of each verb; those of `doctor` and `audit` need more than a folder."""

SHARED_PARTS = {
    "check": Case("policy.xml --requirements required.toml", 1),
    "crl": Case("lost --refresh"),
    "import": Case("r.tgz robot"),
    "merge_policy": Case("policy.xml other.xml"),
    "update_keystore": Case("ks --template production"),
}
"""Commands whose outputs together have every shared part."""

ERRORS = {
    "create_keystore": "ks",
    "create_enclave": "none /a",
    "create_permission": "ks /a none.xml",
    "generate_artifacts": "-k ks -p none.xml",
    "update_keystore": "ks --set protection.rtps=NONE",
    "list_enclaves": "none",
    "inspect": "none",
    "renew": "ks /none",
    "revoke": "ks /none",
    "rotate_ca": "ks --to retire --next",
    "crl": "none",
    "zenoh": "none",
    "distribute_key": "ks /none out",
    "verify": "none",
    "create_request": "/r robot",
    "sign_request": "ks none.pem",
    "import": "none.tgz robot",
    "generate_policy": "new.xml --from-log none.log",
    "merge_policy": "policy.xml none.xml",
    "diff_policy": "policy.xml none.xml",
    "minimize_policy": "policy.xml --observed none.xml",
    "policies": "--copy ks",
    "explain": "ks /none publish /x",
    "view": "none",
    "metrics": "none",
    "review": "--base none --policy policy.xml --repository ks",
    "agent init": "none --robot r1 --from pub --inbox inbox --root root.json",
    "agent run": "none --once",
    "agent status": "none",
    "fleet confirm": "fleet b.json --robot a",
    "fleet publish": "ks pub",
    "fleet collect": "ks good",
    "fleet status": "ks",
    "units": "none /a new",
    "close": "none --apply",
    "check": "none",
    "audit": "none",
    "doctor": "surplus",
    "demo": "--scenario none",
}
"""A command of each verb that fails, in the folder of the cases; `env` prints JSON all the same."""

BINARY = (
    "distribute_key ks /a -",
    "sign_request ks robot/enclaves/s/request.pem -o -",
)
"""Commands whose standard output is an archive."""
