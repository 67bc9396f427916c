"""The names that other programs may build on: lazy, typed, and enough for a first script."""

from __future__ import annotations

import inspect
import json
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any

import pytest

import sros_tool
from sros_tool import DocumentError, KeystoreError, PolicyError, UsageError
from sros_tool.files import policies_dir
from tests.support.children import apart
from tests.support.harness import copy_of, policy_text, publish, sros
from tests.support.long_form import sometimes

PROJECT = Path(__file__).parents[1]
TALKER = "/talker_listener/talker"
POLICY = policies_dir() / "talker_listener.xml"


def first_script() -> tuple[str, str]:
    """The script of docs/python.md, and what is said there that it prints."""
    text = (PROJECT / "docs" / "python.md").read_text(encoding="utf-8")
    found = re.search(r"```python\n(.+?)```.+?```\n(.+?)```", text, re.DOTALL)
    assert found
    return found[1], found[2]


def in_another_process(code: str, folder: Path) -> str:
    return subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(PROJECT)!r})\n{code}"],
        cwd=folder,
        check=True,
        capture_output=True,
        text=True,
    ).stdout


@pytest.fixture(scope="module")
def keystore(tmp_path_factory: pytest.TempPathFactory) -> sros_tool.Keystore:
    made = sros_tool.create_keystore(tmp_path_factory.mktemp("api") / "ks", template="production")
    sros_tool.generate(made, POLICY)
    return made


def test_the_first_script_prints_what_the_document_says(tmp_path: Path) -> None:
    script, printed = first_script()
    (tmp_path / "policies").symlink_to(policies_dir())
    assert in_another_process(script, tmp_path) == printed
    assert (tmp_path / "robot.tar.gz").is_file()


@sometimes("a type checker")
def test_a_type_checker_knows_the_names_and_finds_a_wrong_call(tmp_path: Path) -> None:
    api = pytest.importorskip("mypy.api")
    script = tmp_path / "script.py"
    wrong = 'sros_tool.generate("ks", 7)\nsros_tool.gnerate("ks")\n'
    script.write_text(first_script()[0] + wrong, encoding="utf-8")
    words = ["--strict", "--config-file", str(PROJECT / "pyproject.toml"), str(script)]
    # In a fork: mypy changes the environment and the recursion limit of its process.
    out, _, status = apart(lambda: api.run(words))
    errors = [line for line in out.splitlines() if "error:" in line]
    assert status == 1
    assert len(errors) == 2
    assert "[arg-type]" in errors[0]
    assert "[attr-defined]" in errors[1]


def test_importing_the_package_imports_nothing_else(tmp_path: Path) -> None:
    code = "before = set(sys.modules); import sros_tool; print(set(sys.modules) - before)"
    assert in_another_process(code, tmp_path) == "{'sros_tool'}\n"


def test_a_question_imports_nothing_that_writes(
    keystore: sros_tool.Keystore, tmp_path: Path
) -> None:
    code = (
        f"import sros_tool; sros_tool.check({str(keystore.path)!r})\n"
        "print('sros_tool.keystore.lifecycle.create' in sys.modules)"
    )
    assert in_another_process(code, tmp_path) == "False\n"


@pytest.mark.parametrize("name", sros_tool.__all__)
def test_every_name_is_there_and_documented(name: str) -> None:
    value = getattr(sros_tool, name)
    assert name in dir(sros_tool)
    assert inspect.getdoc(value)
    if inspect.isfunction(value):
        text = inspect.getdoc(value) or ""
        assert all(part in text for part in ("Raises:", "Example:"))
        _, found, arguments = text.partition("\nArgs:\n")
        stated = re.findall(r"^    (\w+): ", arguments.partition("\n\n")[0], re.MULTILINE)
        assert not found or stated == [*inspect.signature(value).parameters]
        assert {*re.findall(r"\b\w+Error(?=: )", text)} <= {*sros_tool.__all__}
    elif value.__module__ == "sros_tool.api":
        page = (PROJECT / "docs/python.md").read_text(encoding="utf-8")
        row = page.partition(f"\n| `{name}` |")[2].partition("\n")[0]
        assert {field.name for field in fields(value)} <= {*re.findall(r"`(\w+)`", row)}


def test_no_name_is_also_that_of_a_room() -> None:
    rooms = {path.stem for path in (PROJECT / "sros_tool").iterdir()}
    assert rooms.isdisjoint(sros_tool.__all__)


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="has no attribute 'gnerate'"):
        sros_tool.gnerate  # type: ignore[attr-defined]  # noqa: B018


def test_a_keystore_is_opened_and_is_a_path(keystore: sros_tool.Keystore) -> None:
    opened = sros_tool.open_keystore(str(keystore.path))
    assert opened == keystore
    assert Path(opened) == keystore.path
    assert opened.enclaves == ("/talker_listener/listener", TALKER)
    with pytest.raises(KeystoreError, match="not a valid keystore"):
        sros_tool.open_keystore(keystore.path / "elsewhere")


def test_an_answer_says_by_which_line_and_until_when(keystore: sros_tool.Keystore) -> None:
    yes = sros_tool.explain_access(keystore, TALKER, "publish", "/chatter", policy=POLICY)
    assert yes
    assert (yes.outcome, yes.vendor, yes.expression) == ("allowed", "fastdds", "rt/chatter")
    assert [line.rpartition(":")[0] for line in yes.policy_lines] == [str(POLICY)]
    assert yes.until
    no = sros_tool.explain_access(keystore, TALKER, "subscribe", "/chatter", vendor="cyclonedds")
    assert not no.allowed
    assert no.outcome == "denied"
    asked = keystore, TALKER, "publish", "/chatter"
    foxy = sros_tool.explain_access(*asked, distribution="foxy")
    assert (
        "not supported any more; sros assumes that access is decided as in Humble"
        in foxy.assumption
    )
    lyrical = sros_tool.explain_access(*asked, distribution="lyrical")
    assert (lyrical.allowed, lyrical.vendor) == (True, "fastdds-3.6")
    lyrical = sros_tool.explain_access(*asked, vendor="cyclonedds", distribution="lyrical")
    assert lyrical.vendor == "cyclonedds-11"
    later = sros_tool.explain_access(keystore, TALKER, "join", now=yes.until + timedelta(days=1))
    assert later.outcome == "refused"
    assert later.remedy


def test_zenoh_answers_by_the_files_in_the_keystore(
    keystore: sros_tool.Keystore, tmp_path: Path
) -> None:
    ask = partial(sros_tool.explain_access, vendor="zenoh")
    with pytest.raises(KeystoreError, match="no Zenoh configurations"):
        ask(keystore, TALKER, "publish", "/chatter")
    made = copy_of(keystore.path, tmp_path / "ks")
    sros("zenoh", made).ok()
    yes = ask(made, TALKER, "publish", "/chatter", policy=POLICY)
    assert yes and (yes.outcome, yes.vendor) == ("allowed", "zenoh") and yes.until
    assert [line.rpartition(":")[0] for line in yes.policy_lines] == [str(POLICY)]
    no = ask(made, TALKER, "subscribe", "/chatter")
    assert not no and no.outcome == "dropped"
    with pytest.raises(UsageError, match="needs a keystore"):
        ask(POLICY, TALKER, "publish", "/chatter")
    with pytest.raises(UsageError, match="takes no distribution"):
        ask(made, TALKER, "publish", "/chatter", distribution="lyrical")


def test_the_rights_of_a_policy_have_absolute_names(tmp_path: Path) -> None:
    (path := tmp_path / "robot.xml").write_text(policy_text({"/a": publish("x", "~/y")}))
    rights = [right for right in sros_tool.policy_rights(path) if right.right == "publish"]
    assert [str(right) for right in rights][-2:] == [
        "/a ALLOW publish topic /n/y",
        "/a ALLOW publish topic /x",
    ]
    policy = sros_tool.read_policy(path)
    assert sros_tool.policy_rights(policy) == sros_tool.policy_rights(path)
    assert sros_tool.explain_access(policy, "/a", "publish", "/x")


def test_every_policy_that_cannot_be_read_is_the_same_kind_of_error(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "link").mkdir()
    (tmp_path / "link" / "inner").symlink_to(tmp_path / "empty")
    for name, content in (
        ("gone.xml", None),
        ("not_closed.xml", "<policy><x/>"),
        ("nothing.xml", ""),
        ("latin.xml", "<?xml version='1.0' encoding='UTF-7'?><policy/>"),
        ("other.xml", "<profile/>"),
        ("old.xml", policy_text({"/a": publish("/x")}).replace("0.2.0", "0.1.0")),
        ("empty", None),
        ("link", None),
        ("empty/..", None),
    ):
        if content is not None:
            (tmp_path / name).write_text(content)
        for read in (sros_tool.read_policy, sros_tool.policy_rights):
            with pytest.raises(PolicyError):
                read(tmp_path / name)


def test_findings_are_for_the_nodes_of_a_distribution(tmp_path: Path) -> None:
    policy = tmp_path / "robot.xml"
    policy.write_text(policy_text({"/a": publish("/x")}))
    ids = [
        {each.id for each in sros_tool.check(policy, severity="note", distribution=name)}
        for name in ("humble", "lyrical", "")
    ]
    assert ids[1] - ids[0] == {"policy.no-type-description"} and ids[1] == ids[2]
    with pytest.raises(UsageError, match="sros knows ardent"):
        sros_tool.check(policy, distribution="lunar")


def test_an_action_is_found_out_as_on_the_command_line(tmp_path: Path) -> None:
    file = tmp_path / "robot.xml"
    actions = "".join(
        f'<enclave path="/{name}"><profiles><profile ns="/" node="{name}">'
        f'<actions {right}="ALLOW"><action>/pick</action></actions></profile></profiles></enclave>'
        for name, right in (("arm", "execute"), ("planner", "call"))
    )
    file.write_text(f'<policy version="0.2.0"><enclaves>{actions}</enclaves></policy>')
    made = sros_tool.create_keystore(tmp_path / "ks", template="production")
    sros_tool.generate(made, file)
    assert sros_tool.explain_access(made, "/planner", "call", "/pick")
    assert sros_tool.explain_access(made, "/arm", "serve", "/pick", policy=file)
    assert not sros_tool.explain_access(made, "/arm", "call", "/pick")
    assert not sros_tool.explain_access(made, "/planner", "call", "/pick", kind="service")
    for policy in (file, sros_tool.read_policy(file)):  # as if it were signed
        answer = sros_tool.explain_access(policy, "/planner", "call", "/pick")
        assert answer and answer.policy_lines == (f"{file}:1",)
        assert not sros_tool.explain_access(policy, "/arm", "call", "/pick")
        with pytest.raises(PolicyError, match="unable to find enclave /web"):
            sros_tool.explain_access(policy, "/web", "call", "/pick")
        with pytest.raises(UsageError, match="two policies are named"):
            sros_tool.explain_access(policy, "/arm", "call", "/pick", policy=file)


def test_a_fleet_has_one_policy_and_one_status(tmp_path: Path) -> None:
    policy, fleet = tmp_path / "robot.xml", tmp_path / "fleet.toml"
    policy.write_text(policy_text({"/{robot}/a": publish("/{robot}/x")}))
    fleet.write_text("[robots.r1]\n[robots.r2]\n")
    made = sros_tool.create_keystore(tmp_path / "ks")
    assert sros_tool.generate(made, policy, fleet=fleet).created == ("/r1/a", "/r2/a")
    found = sros_tool.fleet_status(made, max_age=timedelta(days=1))
    assert [each.state.value for each in found.robots] == ["never", "never"]
    assert not found.complete and not found.overdue
    assert [each.robot for each in sros_tool.fleet_status(made, ["r2"]).robots] == ["r2"]
    with pytest.raises(UsageError, match="one string"):
        sros_tool.fleet_status(made, "r2")
    with pytest.raises(UsageError, match="already parsed policy"):
        sros_tool.generate(made, sros_tool.read_policy(POLICY), fleet=fleet)
    for read in (sros_tool.read_policy, partial(sros_tool.generate, made)):
        with pytest.raises(PolicyError, match=r"generate\(keystore, path, fleet=FLEET_FILE\)"):
            read(policy)


def test_a_policy_of_a_fleet_is_checked(tmp_path: Path) -> None:
    policy, fleet = tmp_path / "robot.xml", tmp_path / "fleet.toml"
    policy.write_text(policy_text({"/{robot}/a": publish("/{robot}/x")}))
    fleet.write_text("[robots.r1]\n[robots.r2]\n")
    made = sros_tool.create_keystore(tmp_path / "ks")
    sros_tool.generate(made, policy, fleet=fleet)

    def stale() -> list[str]:
        findings = sros_tool.check(made, policy, policies=[policy], fleet=fleet)
        assert not {"policy.unreadable", "policy.malformed"} & {each.id for each in findings}
        return [each.subject for each in findings if each.id == "enclave.stale-permissions"]

    assert stale() == []
    policy.write_text(policy_text({"/{robot}/a": publish("/{robot}/x", "/y")}))
    assert stale() == ["/r1/a", "/r2/a"]


def test_a_choice_of_a_template_is_found_only_when_asked_for(tmp_path: Path) -> None:
    made = sros_tool.create_keystore(tmp_path / "ks", template="sros2", domains="0,7")
    assert sros_tool.check(made) == ()
    found = sros_tool.check(made, strict=True, severity="warning")
    assert "keystore.one-authority" in [each.id for each in found]
    assert {each.severity for each in found} == {"warning"}
    assert all("note" < each.severity < "error" for each in found)
    assert sros_tool.check(made, strict=True, severity=found[0].severity.value) == found


def test_a_dry_run_changes_nothing(keystore: sros_tool.Keystore) -> None:
    planned = sros_tool.generate(keystore, enclaves=["/spare"], dry_run=True)
    assert planned.created == ("/spare",)
    assert len(repr(planned).replace(str(keystore.path), "")) < 250, planned
    assert "/spare" not in keystore.enclaves


def test_enclaves_are_created_renewed_and_revoked(keystore: sros_tool.Keystore) -> None:
    assert sros_tool.create_enclaves(keystore, ["/c"]).created == ("/c",)
    certificate = keystore.path / "enclaves/c/cert.pem"
    first = certificate.read_bytes()
    assert sros_tool.renew(keystore, expiring=timedelta(days=1)).names("renewed") == ()
    assert sros_tool.renew(keystore, ["/c"], dry_run=True).names("renewed") == ("/c",)
    assert certificate.read_bytes() == first
    assert sros_tool.renew(keystore, ["/c"]).names("renewed") == ("/c",)
    assert certificate.read_bytes() != first
    gone = sros_tool.revoke(keystore, ["/c"], reason="keyCompromise")
    assert gone.names("revoked") == ("/c",) and "/c" not in keystore.enclaves
    assert set(gone.restart) == set(keystore.enclaves)
    with pytest.raises(UsageError, match="no enclaves are given"):
        sros_tool.renew(keystore)
    with pytest.raises(UsageError, match="unknown reason"):
        sros_tool.revoke(keystore, ["/c"], reason="spring")
    with pytest.raises(UsageError, match="one string"):
        sros_tool.revoke(keystore, "/c")


def test_an_encrypted_key_is_asked_for(tmp_path: Path) -> None:
    asked: list[str] = []

    def secrets(what: str) -> str:
        asked.append(what)
        return "swordfish swordfish"

    made = sros_tool.create_keystore(
        tmp_path / "ks",
        sros_tool.load_template("development"),
        encrypt_ca_keys=True,
        secrets=secrets,
    )
    with pytest.raises(KeystoreError, match="passphrase"):
        sros_tool.generate(made, enclaves=["/a"])
    asked.clear()
    assert sros_tool.generate(made, enclaves=["/a"], secrets=secrets).created == ("/a",)
    assert "the passphrase of the identity CA key" in asked


def test_ca_keys_that_are_kept_elsewhere_are_named(tmp_path: Path) -> None:
    roles = ("identity", "permissions")
    places: dict[str, Any] = {f"{role}_key": f"file:{tmp_path / role}.pem" for role in roles}
    made = sros_tool.create_keystore(tmp_path / "ks", template="production", **places)
    for role in roles:
        (tmp_path / f"{role}.pem").rename(tmp_path / f"{role}-moved.pem")
    elsewhere: dict[str, Any] = {
        name: place.replace(".pem", "-moved.pem") for name, place in places.items()
    }
    changes: tuple[Callable[..., object], ...] = (
        partial(sros_tool.generate, made, POLICY),
        partial(sros_tool.create_enclaves, made, ["/a"]),
        partial(sros_tool.renew, made, ["/a"]),
        partial(sros_tool.revoke, made, ["/a"]),
    )
    for change in changes:
        with pytest.raises(KeystoreError, match=r"identity\.pem"):
            change()
        change(**elsewhere)


def test_a_short_passphrase_needs_insisting(tmp_path: Path) -> None:
    root = tmp_path / "ks"
    with pytest.raises(UsageError, match="too short"):
        sros_tool.create_keystore(root, encrypt_ca_keys=True, secrets=lambda _: "short")
    assert not root.exists()
    sros_tool.create_keystore(
        root, encrypt_ca_keys=True, short_passphrase=True, secrets=lambda _: "short"
    )
    key = (root / "private/identity_ca.key.pem").read_text()
    assert "BEGIN ENCRYPTED PRIVATE KEY" in key


@pytest.mark.parametrize(
    ("call", "error", "text"),
    [
        (lambda ks: sros_tool.generate(ks), UsageError, "no policy and no enclave"),
        (lambda ks: sros_tool.generate(ks, enclaves="/spare"), UsageError, "one string"),
        (lambda ks: sros_tool.generate(ks, POLICY, domain=9), KeystoreError, "domain"),
        (lambda ks: sros_tool.export_enclaves(ks, [], "robot.tar.gz"), UsageError, "no enclave"),
        (lambda ks: sros_tool.check(), UsageError, "no path"),
        (
            lambda ks: sros_tool.check(ks, severity="bad"),  # type: ignore[arg-type]
            UsageError,
            "note, warning, error",
        ),
        (lambda ks: sros_tool.check(ks / "private"), DocumentError, "neither a keystore"),
        (lambda ks: sros_tool.create_keystore(ks), KeystoreError, "already exists"),
        (lambda ks: sros_tool.create_keystore(ks, "prod"), DocumentError, "no template"),
        (
            lambda ks: sros_tool.check(ks, now=datetime(2027, 1, 1)),
            UsageError,
            "no time zone",
        ),
        (
            lambda ks: sros_tool.explain_access(ks, TALKER, "publish", "chatter"),
            UsageError,
            "Write /chatter",
        ),
        (
            lambda ks: sros_tool.explain_access(ks, "/taker", "join"),
            KeystoreError,
            TALKER,
        ),
        *(
            (call, UsageError, "0 to 230")
            for call in (
                lambda ks: sros_tool.explain_access(ks, TALKER, "join", domain=-1),
                lambda ks: sros_tool.check(ks, domain=231),
                lambda ks: sros_tool.generate(ks, POLICY, domain=-1),
                lambda ks: sros_tool.check_requirements(ks, ks, domain=-1),
            )
        ),
        *(
            (call, UsageError, text)
            for name, text in (("lunar", "sros knows ardent"), ("kilted", "ships"))
            for call in (
                lambda ks, of=name: sros_tool.explain_access(
                    ks, TALKER, "join", vendor="fastdds-2.9", distribution=of
                ),
                lambda ks, of=name: sros_tool.check_requirements(
                    ks, ks, vendor="fastdds-2.9", distribution=of
                ),
            )
        ),
        (
            lambda ks: sros_tool.explain_access(ks, TALKER, "join", vendor="rti"),
            UsageError,
            "unknown vendor",
        ),
    ],
)
def test_what_cannot_be_meant_is_refused_with_a_remedy(
    keystore: sros_tool.Keystore, call: object, error: type[Exception], text: str
) -> None:
    assert callable(call)
    with pytest.raises(error, match=text):
        call(keystore.path)


FUNCTIONS = [
    value for name in sros_tool.__all__ if inspect.isfunction(value := getattr(sros_tool, name))
]
VALID = {
    **dict.fromkeys(("keystore", "path", "policy", "base", "head", "target", "requirements"), "ks"),
    "enclave": "/a",
    "action": "join",
}


@pytest.mark.parametrize("function", FUNCTIONS, ids=lambda function: function.__name__)
def test_an_argument_of_another_type_is_refused_with_the_type_to_pass(
    function: Callable[..., object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, parameter in inspect.signature(function).parameters.items():
        lists = "Iterable" in parameter.annotation or "Sequence" in parameter.annotation
        for wrong in (1.5, b"x", object(), *([[None]] if lists else [])):
            arguments: list[object] = []
            named: dict[str, object] = {
                key: text for key, text in VALID.items() if key in function.__annotations__
            }
            if parameter.kind is parameter.VAR_POSITIONAL:
                arguments, named = ["ks", wrong], {}
            else:
                named[name] = wrong
            with pytest.raises(UsageError, match=rf"^(an item of )?{name} is of type .*Pass "):
                function(*arguments, **named)
    assert not list(tmp_path.iterdir())


def test_what_is_not_annotated_is_a_type_error_and_a_path_is_a_template(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="unexpected keyword argument 'patch'"):
        sros_tool.open_keystore(patch="ks")  # type: ignore[call-arg]
    with pytest.raises(TypeError, match="positional argument"):
        sros_tool.open_keystore("ks", "ks")  # type: ignore[call-arg]
    with pytest.raises(UsageError, match="path has a NUL character"):
        sros_tool.open_keystore("k\0s")
    with pytest.raises(DocumentError, match="template"):
        sros_tool.create_keystore(tmp_path / "ks", tmp_path / "gone.toml")
    with pytest.raises(UsageError, match="the return value of secrets is of type NoneType"):
        sros_tool.create_keystore(
            tmp_path / "ks",
            encrypt_ca_keys=True,
            secrets=lambda _: None,  # type: ignore[arg-type, return-value]
        )


def test_a_moment_of_another_zone_is_as_good(keystore: sros_tool.Keystore) -> None:
    then = datetime(2090, 1, 1, tzinfo=UTC)
    assert sros_tool.check(keystore, now=then)


READS = publish("/left/x").replace("publish", "subscribe")


def test_requirements_are_decided(tmp_path: Path) -> None:
    policy, required = tmp_path / "robot.xml", tmp_path / "required.toml"
    policy.write_text(policy_text({"/a": publish("/x*"), "/b": publish("/y")}))
    required.write_text('[[nobody]]\npublish = ["/xyz"]\n[[nobody]]\npublish = ["/z"]\n')
    broken, unnamed = sros_tool.check_requirements(policy, required)
    assert (broken.id, broken.subject, broken.line) == ("requirement.violated", "/a", 1)
    assert broken.text == "may publish /xyz by /x*, but nobody may publish /xyz"
    assert [str(each) for each in broken.related] == [f"{required}:1"]
    assert (unnamed.id, unnamed.file, unnamed.line) == ("requirement.unnamed", str(required), 3)
    assert sros_tool.check_requirements(policy, required, vendor="zenoh") == (broken, unnamed)
    policy.write_text(policy_text({"/{robot}/a": publish("/{robot}/x")}))
    fleet, more = tmp_path / "fleet.toml", tmp_path / "more.toml"
    fleet.write_text("[robots.r1]\n")
    required.write_text('[[nobody]]\npublish = ["/r1/x"]\n')
    more.write_text('[[protected]]\ntopics = ["/r1/x"]\nlevel = "sign"\n')
    found = sros_tool.check_requirements(policy, [required, more], fleet=fleet)
    assert [each.id for each in found] == ["requirement.violated", "requirement.assumed"]
    (known,) = sros_tool.check_requirements(policy, [more, required], fleet=fleet, template="sros2")
    assert known.subject == "/r1/a"
    with pytest.raises(UsageError, match="unknown vendor"):
        sros_tool.check_requirements(policy, required, vendor="none")
    policy.write_text(
        policy_text({"/left/a": publish("/left/x"), "/b": publish("/right/x") + READS})
    )
    required.write_text('[[only]]\nname = "x"\nwhy = "x"\npublish = ["x"]\nenclaves = ["/a"]\n')
    assert not sros_tool.check_requirements(policy, required, namespaces=["/left"])
    found = sros_tool.check_requirements(policy, required, namespaces=["/left", "/right"])
    assert "/b" in [each.subject for each in found]
    with pytest.raises(sros_tool.SrosError, match="has a wildcard"):
        sros_tool.check_requirements(policy, required, namespaces=["/r*"])
    remaps = ["x:=/right/x"]
    found = sros_tool.check_requirements(policy, required, namespaces=["/left"], remaps=remaps)
    assert "/b" in [each.subject for each in found]


def test_policies_are_merged_as_by_the_verb(tmp_path: Path) -> None:
    own, other = tmp_path / "own.xml", tmp_path / "other.xml"
    own.write_text(policy_text({"/a": publish("/x")}))
    other.write_text(policy_text({"/b": publish("x", "y")}))
    merged = sros_tool.merge_policies(
        own, other, namespace="/left", remaps=["x:=/z"], enclave="/c", nodes=["n"]
    )
    words = ("--namespace", "/left", "--remap", "x:=/z", "--enclave", "/c", "--node", "n", "--json")
    ended = json.loads(sros("merge_policy", own, other, *words).ok().out)
    assert merged.document.decode() == ended["document"]
    assert [note.text for note in merged.notes] == [note["text"] for note in ended["notes"]] != []
    assert [right.name for right in merged.added] == ["/left/y", "/z"]
    plain = sros_tool.merge_policies(own, sros_tool.read_policy(other))
    assert [right.name for right in plain.added] == ["/x", "/y"]
    with pytest.raises(UsageError, match="no policy to merge has a node"):
        sros_tool.merge_policies(own, other, nodes=["m"])


def test_new_access_is_what_a_change_adds(tmp_path: Path) -> None:
    base, head = tmp_path / "base.xml", tmp_path / "head.xml"
    base.write_text(policy_text({"/a": publish("/x"), "/{robot}/b": publish("/y")}))
    head.write_text(policy_text({"/a": publish("/x*"), "/{robot}/b": publish("/y")}))
    fleet = tmp_path / "fleet.toml"
    fleet.write_text("[robots.r1]\n")
    found = sros_tool.new_access(base, head, fleet=fleet)
    (gain,) = found.added
    assert (gain.enclaves, gain.action, str(gain.place)) == (("/a",), "publish", f"{head}:1")
    assert gain.name.startswith("/x") and found
    less = sros_tool.new_access(head, base, fleet=fleet)
    assert not less and less.left_out[0] == "dates" and less.assumed
    moved = tmp_path / "moved.toml"
    moved.write_text("[robots.r1]\ndomain = 7\n")
    assert not sros_tool.new_access(base, base, fleet=moved, base_fleet=fleet)
    assert sros_tool.new_access(base, base, fleet=fleet, base_fleet=moved).domains == (0, 7)
    with pytest.raises(DocumentError, match="placeholder"):
        sros_tool.new_access(base, head)
