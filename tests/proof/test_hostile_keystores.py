"""Keystores in which a requirement seems to hold, or nothing seems to be new, and it is not so."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.serialization import Encoding, load_pem_private_key

from sros_tool.automata import Automaton, SearchLimit
from sros_tool.errors import DocumentError
from sros_tool.pki import smime
from sros_tool.pki.certificates import load_certificate, validity_of
from sros_tool.pki.crl import load_crl, sign_crl
from sros_tool.pki.keys import load_key
from sros_tool.proof.worlds import Side, Topics, names_of_expression
from tests.support.harness import copy_of, sros

POLICY = """<policy version="0.2.0"><enclaves>
<enclave path="/web"><profiles><profile ns="/" node="web">
<topics publish="ALLOW"><topic>/status</topic></topics>
<topics subscribe="ALLOW"><topic>/cmd_vel</topic></topics>
</profile></profiles></enclave>
<enclave path="/mux"><profiles><profile ns="/" node="mux">
<topics publish="ALLOW"><topic>/cmd_vel</topic></topics>
</profile></profiles></enclave>
</enclaves></policy>"""
REQUIREMENTS = '[[only]]\npublish = ["/cmd_vel"]\nenclaves = ["/mux"]\n'
WEB = "enclaves/web/permissions.p7s"
ROUTER = "enclaves/router/router.json5"


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sound")
    (folder / "robot.xml").write_text(POLICY)
    (folder / "req.toml").write_text(REQUIREMENTS)
    strict = "--set permissions.default=node_basics --set certificates.unique_subject=true"
    for words in (
        "create_keystore ks",
        f"update_keystore ks {strict}",
        "generate_artifacts -k ks -p robot.xml",
        "zenoh ks",
    ):
        sros(*words.split(), cwd=folder).ok()
    for name in ("/lost", "/stolen"):
        sros("create_enclave", "ks", name, cwd=folder).ok()
        sros("revoke", "ks", name, cwd=folder).ok()
        if name == "/lost":
            shutil.copy(folder / "ks/public/identity_ca.crl.pem", folder / "earlier.pem")
    assert required(folder, "ks") == (0, "nothing found\n")
    assert sros("diff_policy", "--no-new-access", "ks", "ks", cwd=folder).status == 0
    return folder


def required(folder: Path, name: str) -> tuple[int, str]:
    words = ("--requirements", "req.toml", "--include", "requirement.*")
    ended = sros("check", name, *words, cwd=folder)
    return ended.status, ended.out + ended.err


def signed(keystore: Path, file: str, change: Callable[[bytes], bytes]) -> None:
    """Let the permissions CA sign a changed document in place of a file."""
    authority = x509.load_pem_x509_certificate(
        (keystore / "public/permissions_ca.cert.pem").read_bytes()
    )
    key = load_pem_private_key((keystore / "private/permissions_ca.key.pem").read_bytes(), None)
    document = change(smime.parse((keystore / file).read_bytes()).document)
    (keystore / file).unlink()
    (keystore / file).write_bytes(smime.sign(document, authority, key))  # type: ignore[arg-type]


def drives(document: bytes) -> bytes:
    return document.replace(b"rt/status", b"rt/cmd_vel")


def in_another_domain(keystore: Path) -> None:
    def more(document: bytes) -> bytes:
        rule = re.search(rb"<allow_rule>.*?</allow_rule>", document, re.DOTALL)
        assert rule
        other = drives(rule[0].replace(b"<id>0<", b"<id>7<"))
        return document.replace(rule[0], rule[0] + other)

    signed(keystore, WEB, more)
    for each in ("", "/web", "/mux", "/router"):
        file = f"enclaves{each}/governance.p7s"
        signed(keystore, file, lambda old: old.replace(b"<id>0<", b"<id>0</id><id>7<"))


def in_a_relay(keystore: Path) -> None:
    """Peers on Fast DDS let a reader of /web subscribe, if /web does not ask its own rules."""
    relay = b"<relay><topics><topic>rt/cmd_vel</topic></topics></relay></allow_rule>"
    signed(keystore, WEB, lambda document: document.replace(b"</allow_rule>", relay))


def from_later_on(keystore: Path) -> None:
    begin = re.compile(rb"(<not_before>)\d{4}")
    signed(keystore, WEB, lambda old: begin.sub(rb"\g<1>2035", drives(old)))


def at_many_times(keystore: Path) -> None:
    def grants(document: bytes) -> bytes:
        grant = re.search(rb"<grant .*?</grant>", document, re.DOTALL)
        assert grant
        begin = re.compile(rb"(<not_before>)\d{4}-\d\d-\d\d")
        later = (begin.sub(b"\\g<1>2030-%02d-01" % month, grant[0]) for month in range(1, 12))
        return document.replace(grant[0], grant[0] + b"".join(later))

    signed(keystore, WEB, grants)


def without_keys(keystore: Path) -> None:
    signed(keystore, WEB, drives)
    for each in ("web", "mux", "router"):
        (keystore / "enclaves" / each / "key.pem").unlink()
    shutil.rmtree(keystore / "private")


def a_hidden_enclave(keystore: Path) -> None:
    """DDS loads a copy of /mux, and the keystore does not list it."""
    shutil.copytree(keystore / "enclaves/mux", keystore / "enclaves/.h")
    signed(keystore, "enclaves/.h/permissions.p7s", lambda old: old.replace(b"/mux", b"/.h"))


def rules(keystore: Path, change: Callable[[dict[str, object]], None]) -> None:
    document = json.loads((keystore / ROUTER).read_text())
    change(document)
    (keystore / ROUTER).write_text(json.dumps(document))


def a_grant_in_the_permissions_of_another(keystore: Path) -> None:
    """Only Cyclone DDS was thought to take it, and only what /mux itself may do."""
    web = drives(smime.parse((keystore / WEB).read_bytes()).document)
    grant = web[web.index(b"<grant") : web.index(b"</permissions>")]

    def lends(document: bytes) -> bytes:
        return document.replace(b"</permissions>", grant + b"</permissions>")

    signed(keystore, "enclaves/mux/permissions.p7s", lends)


def a_name_without_an_enclave(keystore: Path) -> None:
    def ghost(document: dict) -> None:  # type: ignore[type-arg]
        access = document["access_control"]
        allowed = next(each for each in access["policies"] if each["subjects"] == ["/mux"])
        access["subjects"].append({"id": "ghost", "cert_common_names": ["/ghost"]})
        access["policies"].append({**allowed, "subjects": ["ghost"]})

    rules(keystore, ghost)


def a_link_without_tls(keystore: Path) -> None:
    text = (keystore / ROUTER).read_text().replace('"tls/', '"tcp/').replace('"tls"\n', '"tcp"\n')
    (keystore / ROUTER).write_text(text)


def no_certificate_asked_for(keystore: Path) -> None:
    text = (keystore / ROUTER).read_text()
    (keystore / ROUTER).write_text(text.replace('"enable_mtls": true', '"enable_mtls": false'))


def a_subject_with_a_condition(keystore: Path) -> None:
    def narrowed(document: dict) -> None:  # type: ignore[type-arg]
        subject = {"id": "more", "cert_common_names": ["/web"], "interfaces": ["lo"]}
        access = document["access_control"]
        access["subjects"].append(subject)
        access["policies"].append({**access["policies"][0], "subjects": ["more"]})

    rules(keystore, narrowed)


def the_history_of_a_topic(keystore: Path) -> None:
    def asked(document: dict) -> None:  # type: ignore[type-arg]
        access = document["access_control"]
        rule = {"permission": "allow", "key_exprs": ["0/cmd_vel/*/*/@adv/**"]}
        access["rules"] += [
            {**rule, "id": "ask", "flows": ["ingress"], "messages": ["query"]},
            {**rule, "id": "get", "flows": ["egress"], "messages": ["reply"]},
        ]
        access["policies"].append({"rules": ["ask", "get"], "subjects": ["/web"]})

    rules(keystore, asked)


def a_denial(keystore: Path) -> None:
    def denied(document: dict) -> None:  # type: ignore[type-arg]
        access = document["access_control"]
        rule = {**access["rules"][0], "id": "denied", "permission": "deny"}
        access["rules"].append(rule)
        access["policies"].append({"rules": ["denied"], "subjects": ["/web"]})

    rules(keystore, denied)


def a_namespace(keystore: Path) -> None:
    rules(keystore, lambda document: document.update(namespace="r1"))


def a_second_router(keystore: Path) -> None:
    shutil.copy(keystore / ROUTER, keystore / "enclaves/web/router.json5")


def a_router_that_the_settings_do_not_name(keystore: Path) -> None:
    """Both routers know each other, and the first one lets the second one drive."""

    def driven(document: dict) -> None:  # type: ignore[type-arg]
        for each in document["access_control"]["policies"]:
            if each["subjects"] == ["/mux"]:
                each["subjects"].append("/web")

    rules(keystore, driven)
    text = (keystore / ROUTER).read_text()
    (keystore / "enclaves/web/router.json5").write_text(text.replace("/web", "/router"))


def a_weaker_governance_of_one_enclave(keystore: Path) -> None:
    weak = "enclaves/mux/governance.p7s"
    signed(keystore, weak, lambda old: old.replace(b">true<", b">false<"))


def another_authority(keystore: Path) -> None:
    other = (keystore / "public/permissions_ca.cert.pem").read_bytes()
    file = keystore / "enclaves/mux/identity_ca.cert.pem"
    content = file.read_bytes()
    file.unlink()
    file.write_bytes(content + other)


def another_router(keystore: Path) -> None:
    for each in ("router.json5", "router.p7s"):
        (keystore / "enclaves/router" / each).rename(keystore / "enclaves/web" / each)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (in_another_domain, "/web: may publish /cmd_vel, but"),
        (from_later_on, "/web: may publish /cmd_vel, but"),
        (without_keys, "/web: may publish /cmd_vel, but"),
        (a_hidden_enclave, "/.h: may publish /cmd_vel with the permissions of /mux, but"),
        (
            a_grant_in_the_permissions_of_another,
            "/mux: its permissions are also for /web, which can",
        ),
        (a_name_without_an_enclave, "/ghost: may publish /cmd_vel, but"),
        (a_router_that_the_settings_do_not_name, "/web: may publish /cmd_vel, but"),
        (a_weaker_governance_of_one_enclave, "/router: may publish /cmd_vel, and so may /web"),
        (in_a_relay, "/web: this answer ignores its <relay>"),
        (at_many_times, "become valid at more than 10 different times"),
        (a_link_without_tls, "is not known"),
        (no_certificate_asked_for, "is not known"),
        (a_subject_with_a_condition, "is not known"),
        (the_history_of_a_topic, "is not known"),
        (a_denial, "is not known"),
        (a_namespace, "is not known"),
        (a_second_router, "has the files of several routers"),
    ],
)
def test_no_requirement_holds_that_does_not(
    sound: Path, change: Callable[[Path], None], said: str
) -> None:
    keystore = sound / f"req-{change.__name__}"
    copy_of(sound / "ks", keystore)
    change(keystore)
    status, text = required(sound, keystore.name)
    assert status == (1 if "may" in said else 2), text
    assert said in text
    assert "Traceback" not in text


def without_the_list(keystore: Path) -> None:
    (keystore / "enclaves/mux/crl.pem").unlink()


def an_earlier_list(keystore: Path) -> None:
    """A list that the CA signed before: without the enclave that was revoked since."""
    for each in ("web", "mux", "router"):
        file = keystore / "enclaves" / each / "crl.pem"
        file.unlink()
        shutil.copy(keystore.parent / "earlier.pem", file)


def an_earlier_list_for_later_enclaves(keystore: Path) -> None:
    """Enclaves keep theirs, and those that are created later get the earlier one."""
    for each in ("web", "mux", "router"):
        file = keystore / "enclaves" / each / "crl.pem"
        content = file.read_bytes()
        file.unlink()
        file.write_bytes(content)
    shutil.copy(keystore.parent / "earlier.pem", keystore / "public/identity_ca.crl.pem")


def a_list_of_another_ca(keystore: Path) -> None:
    sros("create_keystore", "other", cwd=keystore.parent)
    sros("create_enclave", "other", "/x", cwd=keystore.parent)
    sros("revoke", "other", "/x", cwd=keystore.parent)
    file = keystore / "enclaves/mux/crl.pem"
    file.unlink()
    shutil.copy(keystore.parent / "other/public/identity_ca.crl.pem", file)


def lists(keystore: Path, own: bytes | None, embedded: bytes) -> None:
    """Replace the revocation lists of /mux: its own one, and that among its CAs."""
    folder = keystore / "enclaves/mux"
    content = (folder / "identity_ca.cert.pem").read_bytes() + embedded
    for name, data in (("crl.pem", own), ("identity_ca.cert.pem", content)):
        (folder / name).unlink()
        if data is not None:
            (folder / name).write_bytes(data)


def a_list_next_to_the_one_that_counts(keystore: Path) -> None:
    """OpenSSL takes one list of a CA, and not what any of them revokes."""
    present = (keystore / "enclaves/mux/crl.pem").read_bytes()
    lists(keystore, (keystore.parent / "earlier.pem").read_bytes(), present)


def a_list_that_does_not_begin_a_line(keystore: Path) -> None:
    """OpenSSL does not find it."""
    lists(keystore, None, b"# " + (keystore / "enclaves/mux/crl.pem").read_bytes())


def an_entry_that_undoes_another(keystore: Path) -> None:
    """OpenSSL takes the first entry of a certificate, which is that it is not revoked."""
    authority = load_certificate((keystore / "public/identity_ca.cert.pem").read_bytes(), "")
    key = load_key((keystore / "private/identity_ca.key.pem").read_bytes(), "")
    found = load_crl((keystore / "enclaves/mux/crl.pem").read_bytes(), "")
    entries = [each._replace(reason="removeFromCRL") for each in found.revoked] + [*found.revoked]
    begin, end = found.this_update, found.next_update
    text = sign_crl(authority, key, entries, number=99, this_update=begin, next_update=end)
    lists(keystore, text, b"")


def a_damaged_list(keystore: Path) -> None:
    file = keystore / "enclaves/mux/crl.pem"
    file.unlink()
    file.write_bytes(b"")


def without_the_files_of_zenoh(keystore: Path) -> None:
    for each in (*keystore.rglob("router.*"), *keystore.rglob("session.*")):
        each.unlink()


def rules_that_nobody_signed(keystore: Path) -> None:
    """They state the same as before."""
    rules(keystore, lambda document: None)


def without_the_signature(keystore: Path) -> None:
    (keystore / ROUTER).with_suffix(".p7s").unlink()


def setting(path: str, value: object) -> Callable[[Path], None]:
    """Return the change of a setting in the file of Zenoh's router."""

    def change(keystore: Path) -> None:
        def set_in(document: dict) -> None:  # type: ignore[type-arg]
            *parents, last = path.split("/")
            for each in parents:
                document = document.setdefault(each, {})
            document[last] = value

        rules(keystore, set_in)

    change.__name__ = path.replace("/", "-")
    return change


def rules_that_a_session_does_not_enforce(keystore: Path) -> None:
    file = keystore / "enclaves/web/session.json5"
    text = file.read_text().replace('"enabled": true,\n  "default', '"enabled": false,\n  "default')
    file.write_text(text)


def a_session_that_routes(keystore: Path) -> None:
    """What it lets others do is compared as well as what the router does."""
    file = keystore / "enclaves/web/session.json5"
    text = (keystore / ROUTER).read_text().replace("0/cmd_vel/", "0/cmd_$*/")
    file.write_text(text)


def a_certificate_of_another_name(keystore: Path) -> None:
    """The CA certified the key of /web as /mux: whoever has it can use the permissions of /mux."""
    authority = load_certificate((keystore / "public/identity_ca.cert.pem").read_bytes(), "")
    key = load_key((keystore / "private/identity_ca.key.pem").read_bytes(), "")
    file = keystore / "enclaves/web/cert.pem"
    present = load_certificate(file.read_bytes(), "")
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "/mux")])
    made = x509.CertificateBuilder(authority.subject, name, present.public_key(), 77)
    made = made.not_valid_before(validity_of(present).not_before)
    made = made.not_valid_after(validity_of(present).not_after)
    file.write_bytes(made.sign(key, SHA256()).public_bytes(Encoding.PEM))


def in_a_dot_folder(keystore: Path) -> None:
    """DDS loads an enclave from any folder."""
    copy_of(keystore / "enclaves/web", keystore / "enclaves/.h")
    for each in (keystore / "enclaves/.h").glob("*.json5"):
        each.unlink()

    def hidden(document: bytes) -> bytes:
        return drives(document).replace(b"/web", b"/.h")

    signed(keystore, "enclaves/.h/permissions.p7s", hidden)


def settings(old: str, new: str) -> Callable[[Path], None]:
    """Return an edit of the settings, which later enclaves follow."""

    def change(keystore: Path) -> None:
        text = (keystore / "sros.toml").read_text()
        assert old in text
        (keystore / "sros.toml").write_text(text.replace(old, new, 1))

    change.__name__ = f"set-{new.partition(' ')[0]}"
    return change


def without_settings(keystore: Path) -> None:
    """Then those of the template for ros2/sros2 hold."""
    (keystore / "sros.toml").unlink()


LESS = "+ less protection: "
OPEN_SETTINGS = [
    ("transport/link/tls/enable_mtls", False, "it asks for no certificate"),
    ("transport/link/tls/close_link_on_expiration", False, LESS),
    ("transport/link/tls/verify_name_on_connect", False, ""),
    ("transport/link/tls/root_ca_certificate", "/tmp/ca.pem", "a certificate of that CA gets a"),
    ("transport/link/protocols", ["tls", "quic"], "without -> with quic"),
    ("transport/link/protocols", None, "without -> with all"),
    ("transport/shared_memory/enabled", True, LESS),
    ("scouting/multicast/enabled", True, LESS),
    ("adminspace/enabled", True, "adminspace/permissions/read of /router router.json5 false -> "),
    ("adminspace", {"enabled": True, "permissions": {"write": True}}, "others may change its"),
    ("plugins/rest/http_port", 8000, "plugins/rest/http_port of /router router.json5 missing ->"),
    ("plugins_loading/enabled", True, "it loads plugins"),
    ("transport/auth/usrpwd/password", "hush", "transport/auth/usrpwd/password of /router"),
    ("listen/endpoints", ["tls/0.0.0.0:1"], "without -> with tls/0.0.0.0:1: it listens there"),
    ("connect/endpoints", ["tls/evil:7447"], "it connects to the process there"),
    (
        "downsampling",
        [],
        "the setting downsampling of /router router.json5, whose effect sros does not",
    ),
    ("scouting/gossip/target/peer", ["peer"], "the setting scouting/gossip/target/peer of"),
    ("queries_default_timeout", 1, ""),
    ("metadata", {"name": "x"}, ""),
]
"""Settings of the router with what is said of them; nothing for those that give nobody anything."""


@pytest.mark.parametrize(("path", "value", "said"), OPEN_SETTINGS)
def test_settings_of_zenoh_are_compared(sound: Path, path: str, value: object, said: str) -> None:
    keystore = sound / f"set-{path.replace('/', '-')}-{type(value).__name__}"
    copy_of(sound / "ks", keystore)
    setting(path, value)(keystore)
    authority = load_certificate((keystore / "public/permissions_ca.cert.pem").read_bytes(), "")
    key = load_key((keystore / "private/permissions_ca.key.pem").read_bytes(), "")
    message = smime.sign((keystore / ROUTER).read_bytes(), authority, key)
    (keystore / ROUTER).with_suffix(".p7s").write_bytes(message)
    words = ("diff_policy", "--no-new-access", "ks", keystore.name)
    ended = sros(*words, cwd=sound)
    assert said in ended.out + ended.err
    assert "hush" not in ended.out + ended.err
    refused = "whose effect sros does not know" in ended.err or "cannot be compared" in ended.err
    assert ended.status == (2 if refused else int(bool(said))), ended


@pytest.mark.parametrize(
    ("change", "status", "said"),
    [
        (rules_that_nobody_signed, 1, "signature of /router router.json5 holds -> broken: anybody"),
        (without_the_signature, 1, "signature of /router router.json5 holds -> missing: anybody"),
        (rules_that_a_session_does_not_enforce, 1, "access_control/enabled of /web session.json5"),
        (a_session_that_routes, 1, "+ /mux publish topic /cmd_*: such as /cmd_"),
        (a_certificate_of_another_name, 1, "certificate of /web /web -> /mux: anyone who has"),
        (in_a_dot_folder, 1, "+ /.h publish topic /cmd_vel"),
        (
            settings('default = "node_basics"', 'default = "everything"'),
            1,
            "later enclaves: permissions.default node_basics -> everything: an enclave without a",
        ),
        (
            settings('rtps = "SIGN"', 'rtps = "NONE"'),
            1,
            "later enclaves: protection.rtps SIGN -> NONE: whole messages: no longer",
        ),
        (settings("unique_subject = true", "unique_subject = false"), 1, "fit later certificates"),
        (settings('validity = "1d"', 'validity = "2d"'), 0, "not covered: dates, "),
        (without_settings, 1, "later enclaves: permissions.default node_basics -> everything"),
        (
            without_the_list,
            1,
            "revoked -> trusted: /mux again trusts anyone who has the key",
        ),
        (
            an_earlier_list,
            1,
            "revoked -> trusted: 3 enclaves again trust anyone who has the key",
        ),
        (
            an_earlier_list_for_later_enclaves,
            1,
            "trusted: the keystore again trusts anyone who has the key",
        ),
        (
            a_list_of_another_ca,
            2,
            "its revocation list makes DDS refuse every enclave: another CA signed it",
        ),
        (a_list_next_to_the_one_that_counts, 2, "several revocation lists of one CA"),
        (a_list_that_does_not_begin_a_line, 1, "/mux again trusts anyone who has the key"),
        (an_entry_that_undoes_another, 2, "has entries that vendors may ignore"),
        (a_damaged_list, 2, "mux' cannot be compared: the revocation list crl.pem cannot be read"),
        (without_the_files_of_zenoh, 1, "+ less protection: Zenoh files present -> missing"),
        (a_name_without_an_enclave, 1, "+ /ghost publish topic /cmd_vel; with Zenoh"),
        (another_authority, 1, "+ less protection: identity CA"),
        (another_router, 1, "+ less protection: Zenoh router /router -> /web"),
        (a_weaker_governance_of_one_enclave, 2, "is not the governance of the keystore"),
        (a_link_without_tls, 2, "without TLS"),
        (no_certificate_asked_for, 2, "it asks for no certificate"),
        (a_subject_with_a_condition, 2, "conditions besides the name: interfaces"),
        (the_history_of_a_topic, 2, "gets only earlier messages (the history) of '0/cmd_vel/*/*'"),
        (a_denial, 2, "it has deny rules"),
        (a_namespace, 2, "puts a namespace before all Zenoh keys"),
        (in_a_relay, 2, "/web: this answer ignores its <relay>"),
        (a_second_router, 2, "has the files of several routers"),
    ],
)
def test_new_access_is_found_or_not_compared(
    sound: Path, change: Callable[[Path], None], status: int, said: str
) -> None:
    keystore = sound / f"new-{change.__name__}"
    copy_of(sound / "ks", keystore)
    change(keystore)
    ended = sros("diff_policy", "--no-new-access", "ks", keystore.name, cwd=sound)
    assert ended.status == status, ended
    assert said in ended.out + ended.err


def test_an_enclave_that_does_not_start_is_not_able_to_do_anything(sound: Path) -> None:
    keystore = sound / "idle"
    copy_of(sound / "ks", keystore)
    (sound / "must.toml").write_text('[[must]]\npublish = ["/cmd_vel"]\nenclave = "/mux"\n')
    words = ("check", "idle", "--requirements", "must.toml", "--include", "requirement.*")
    assert sros(*words, cwd=sound).status == 0
    (keystore / "enclaves/mux/key.pem").unlink()
    ended = sros(*words, cwd=sound)
    assert "/mux: cannot start" in ended.out
    assert ended.status == 1


def test_rules_of_zenoh_are_compared_key_by_key(sound: Path) -> None:
    """One part of a name is less than all of them, and one domain less than two."""
    for name, key in (
        ("part", "0/status/*/*/*"),
        ("all", "0/status/**"),
        ("seven", "7/status/*/*"),
    ):
        shutil.copy(sound / "ks" / ROUTER, sound / f"{name}.json5")
        text = (sound / f"{name}.json5").read_text()
        (sound / f"{name}.json5").write_text(text.replace('"0/status/$*::$*/*/**', f'"{key}'))
    shutil.copy(sound / "ks" / ROUTER, sound / "zero.json5")
    words = ("diff_policy", "--no-new-access")
    assert sros(*words, "part.json5", "part.json5", cwd=sound).status == 0
    assert sros(*words, "all.json5", "part.json5", cwd=sound).status == 0
    for base, head in (("part", "all"), ("zero", "seven")):
        ended = sros(*words, f"{base}.json5", f"{head}.json5", cwd=sound)
        assert ended.status == 1, ended
        assert "+ /web publish topic /status" in ended.out


def test_a_name_without_letters_is_compared(tmp_path: Path) -> None:
    """The topic of a foreign document can be empty, which Cyclone DDS takes for all of them."""
    text = (
        "<dds><permissions><grant name='g'><subject_name>CN=/web</subject_name><validity>"
        "<not_before>2020-01-01T00:00:00</not_before><not_after>2040-01-01T00:00:00</not_after>"
        "</validity><allow_rule><domains><id>0</id></domains><publish><topics>{}</topics></publish>"
        "</allow_rule><default>DENY</default></grant></permissions></dds>"
    )
    (tmp_path / "base.xml").write_text(text.format("<topic>rt/a</topic>"))
    (tmp_path / "head.xml").write_text(text.format("<topic>**</topic><topic></topic>"))
    words = ("diff_policy", "--no-new-access", "base.xml", "head.xml")
    ended = sros(*words, cwd=tmp_path)
    assert ended.status in (1, 2), ended
    assert "/web" in ended.out + ended.err


def test_wildcards_that_are_compared_count() -> None:
    """A policy of many wildcards and many requirements must not take hours."""
    wild = {f"/e{each}": names_of_expression(f"rt/{each}*") for each in range(1000)}
    side, topics = Side(wild), Topics("rt", "/x*", "")
    for ask in (
        lambda limit: side.users_of_topics(topics, limit),
        lambda limit: side.possible_users([Automaton.sequence([None])], limit),
    ):
        with pytest.raises(DocumentError, match="too many wildcards"):
            ask(SearchLimit(100))
        assert ask(SearchLimit(10_000)) is not None
