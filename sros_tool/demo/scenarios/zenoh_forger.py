"""Forgeries of Zenoh files: as an attacker would change them, or without a defense.

Rows of scenarios refer to these functions; each changes a copy of the keystore (see `forger`).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from sros_tool.demo.forger import KeystoreCopy, keep_stolen
from sros_tool.demo.scenarios.model import zenoh_policy
from sros_tool.keystore.layout import (
    CERTIFICATE_FILE,
    IDENTITY_CA_FILE,
    KEY_FILE,
    ROUTER_FILE,
    SESSION_FILE,
    enclave_names,
    enclave_path,
)
from sros_tool.keystore.lifecycle.create import generate_artifacts
from sros_tool.keystore.lifecycle.revoke import revoke
from sros_tool.keystore.lifecycle.update import set_zenoh
from sros_tool.policy.model import Policy
from sros_tool.runtime.environment import OVERRIDE, ROUTER_URI, SESSION_URI, zenoh_environment
from sros_tool.runtime.variables import DOMAIN
from sros_tool.validity import Window
from sros_tool.zenoh.access import Message
from sros_tool.zenoh.configuration import Mode, ZenohNetwork, ZenohRouter

_Document = dict[str, Any]
_Change = Callable[[_Document], None]

_EVERYBODY = "everybody"
_FLOWS = ("ingress", "egress")


def _files(copy: KeystoreCopy) -> dict[str, Path]:
    """Return the Zenoh files of a keystore by enclave."""
    folders = {name: enclave_path(copy.root, name) for name in enclave_names(copy.root)}
    places = {
        name: folder / (ROUTER_FILE if name == copy.router else SESSION_FILE)
        for name, folder in folders.items()
    }
    return {name: path for name, path in places.items() if path.is_file()}


def _edit(path: Path, change: _Change) -> None:
    document = json.loads(path.read_bytes())
    change(document)
    path.write_text(json.dumps(document), encoding="utf-8")


def _edit_all(copy: KeystoreCopy, change: _Change, *, router: bool = True) -> None:
    for name, path in _files(copy).items():
        if router or name != copy.router:
            _edit(path, change)


def _edit_talker(copy: KeystoreCopy, change: _Change) -> None:
    _edit(copy.folder("talker") / SESSION_FILE, change)


def _remove_rules(document: _Document) -> None:
    document.pop("access_control", None)


def _tls(document: _Document) -> _Document:
    tls: _Document = document["transport"]["link"]["tls"]
    return tls


# ── who enforces ───────────────────────────────────────────────────────────────────────────


def through_the_router(copy: KeystoreCopy) -> None:
    """Let the sessions connect only to the router."""
    start_network(copy.root, copy.router, copy.endpoint, Mode.CLIENT, copy.now)


def rules_at_the_router_only(copy: KeystoreCopy) -> None:
    """Take the rules out of all sessions, which connect to each other directly."""
    _edit_all(copy, _remove_rules, router=False)


def sessions_that_limit_themselves(copy: KeystoreCopy) -> None:
    """Let each session only limit itself, by its own rights; the router enforces nothing."""
    through_the_router(copy)
    for name, path in _files(copy).items():
        _edit(
            path, _remove_rules if name == copy.router else _give_rights_to_everybody(copy.router)
        )


def _give_rights_to_everybody(router: str) -> _Change:
    """Return a change by which a file gives every enclave the rights of the router."""

    def change(document: _Document) -> None:
        control = document["access_control"]
        for subject in control["subjects"]:
            if subject["id"] == router:
                del subject["cert_common_names"]

    return change


def subject_for_everybody(copy: KeystoreCopy) -> None:
    """Let another enclave be the router, and let the sessions accept every enclave as router."""
    another_router(copy)
    for name, path in _files(copy).items():
        if name not in (copy.router, copy.enclave("guest")):
            _edit(path, _give_rights_to_everybody(copy.router))


def another_router(copy: KeystoreCopy) -> None:
    """Let the guest listen in place of the router."""
    router = json.loads((enclave_path(copy.root, copy.router) / ROUTER_FILE).read_bytes())
    _remove_rules(router)
    (copy.folder("guest") / SESSION_FILE).write_text(json.dumps(router), encoding="utf-8")


FAR_ROUTER = "/far/router"
"""The router of a second host, for the listener and the admin."""


def far_router(copy: KeystoreCopy) -> None:
    """Give the listener's host its own router, and let the topic pass between the routers."""
    _add_far_router(copy, copy.topic)


def far_router_without_the_topic(copy: KeystoreCopy) -> None:
    """Give the listener's host its own router, and let only another name pass."""
    _add_far_router(copy, f"{copy.topic}/other")


def _add_far_router(copy: KeystoreCopy, crossing: str) -> None:
    host, _, port = copy.endpoint.rpartition(":")
    far = int(port) + 2
    router = ZenohRouter(
        FAR_ROUTER, (f"far:{far}",), enclaves=(copy.enclave("listener"), copy.enclave("admin"))
    )
    network = ZenohNetwork(
        copy.router, (copy.endpoint,), mode=Mode.CLIENT, routers=(router,), crossing=(crossing,)
    )
    set_zenoh(copy.root, network, now=copy.now)

    def listen_here(document: _Document) -> None:
        for side in ("listen", "connect"):
            endpoints = document[side]["endpoints"]
            document[side]["endpoints"] = [
                f"tls/{host}:{far}" if endpoint.endswith(f":{far}") else endpoint
                for endpoint in endpoints
            ]

    # The second host is this machine, so its router needs another port.
    _edit_all(copy, listen_here)
    _edit(enclave_path(copy.root, FAR_ROUTER) / ROUTER_FILE, listen_here)


def another_far_router(copy: KeystoreCopy) -> None:
    """Let the guest play the router of the second host."""
    far_router(copy)
    file = enclave_path(copy.root, FAR_ROUTER) / ROUTER_FILE
    _edit(file, _remove_rules)
    (copy.folder("guest") / SESSION_FILE).write_bytes(file.read_bytes())


def guest_as_far_router(copy: KeystoreCopy) -> None:
    """Let the guest play the router of the second host.

    The first router gives every enclave the rights of that router.
    """
    another_far_router(copy)
    _edit(enclave_path(copy.root, copy.router) / ROUTER_FILE, _give_rights_to_everybody(FAR_ROUTER))


def talkative_router(copy: KeystoreCopy) -> None:
    """Let whoever has the router's key also publish and subscribe."""
    through_the_router(copy)
    folder = enclave_path(copy.root, copy.router)
    router = json.loads((folder / ROUTER_FILE).read_bytes())
    _remove_rules(router)
    (folder / ROUTER_FILE).write_text(json.dumps(router), encoding="utf-8")


# ── rules ──────────────────────────────────────────────────────────────────────────────────


def _rule(name: str, keys: Iterable[str], permission: str = "allow", flow: str = "") -> _Document:
    return {
        "id": name,
        "permission": permission,
        "flows": [flow] if flow else list(_FLOWS),
        "messages": [message.value for message in Message],
        "key_exprs": list(keys),
    }


def _allow_everything(document: _Document) -> None:
    """Let everybody do everything."""
    control = document["access_control"]
    control["rules"].append(_rule(_EVERYBODY, ("**", "@ros2_lv/**")))
    control["subjects"].append({"id": _EVERYBODY})
    control["policies"].append({"rules": [_EVERYBODY], "subjects": [_EVERYBODY]})


def denial_in_a_wildcard(copy: KeystoreCopy) -> None:
    """Allow every enclave everything, but deny the guest the topic and the service by name."""
    names = [f"{copy.domain}{name}/**" for name in (copy.topic, "/add_two_ints")]
    guest = copy.enclave("guest")

    def change(document: _Document) -> None:
        control = document["access_control"] = {
            "enabled": True,
            "default_permission": "deny",
            "rules": [],
            "subjects": [],
            "policies": [],
        }
        for name in enclave_names(copy.root):
            control["subjects"].append({"id": name, "cert_common_names": [name]})
        subjects = [subject["id"] for subject in control["subjects"]]
        control["rules"] += [
            _rule(_EVERYBODY, ("**", "@ros2_lv/**")),
            _rule("denied", names, "deny", "ingress"),
        ]
        control["policies"] += [
            {"rules": [_EVERYBODY], "subjects": subjects},
            {"rules": ["denied"], "subjects": [guest]},
        ]

    through_the_router(copy)
    _edit_all(copy, change)


def guest_may_use_the_topic(copy: KeystoreCopy) -> None:
    """Give the guest the rights of talker and listener, by another policy."""
    _change_rights(copy, zenoh_policy(copy.topic, guest_talks=True))


def tokens_of_any_enclave(copy: KeystoreCopy) -> None:
    """Let every enclave announce nodes under any enclave's name."""
    _widen_tokens(copy, lambda _: f"@ros2_lv/{copy.domain}/**")


def tokens_of_any_name(copy: KeystoreCopy) -> None:
    """Let every enclave announce any node and any name, but only under the enclave's own name."""

    def widened_key(key: str) -> str:
        chunks = key.split("/")
        enclave = chunks[6] if len(chunks) > 6 else ""  # else a key that all may see
        return f"@ros2_lv/{copy.domain}/*/*/*/*/{enclave}/**" if enclave else key

    _widen_tokens(copy, widened_key)


def tokens_of_any_name_through_the_router(copy: KeystoreCopy) -> None:
    """Let the sessions connect only to the router, and announce any node and any name."""
    through_the_router(copy)
    tokens_of_any_name(copy)


def _widen_tokens(copy: KeystoreCopy, wider: Callable[[str], str]) -> None:
    """Replace the key expressions for graph tokens in all files."""

    def change(document: _Document) -> None:
        for rule in document["access_control"]["rules"]:
            if "liveliness_token" in rule["messages"]:
                keys = rule["key_exprs"]
                wide = [wider(key) if key.startswith("@ros2_lv") else key for key in keys]
                rule["key_exprs"] = [*dict.fromkeys(wide)]

    _edit_all(copy, change)


def earlier_session_file(copy: KeystoreCopy) -> None:
    """Restore the guest's session file of an earlier policy, which gave the guest the topic."""
    path = copy.folder("guest") / SESSION_FILE
    path.write_bytes(_session_file_of_earlier_policy(copy))


def earlier_self_limiting_session_file(copy: KeystoreCopy) -> None:
    """Restore the guest's earlier file; each session enforces only its own rights."""
    earlier = json.loads(_session_file_of_earlier_policy(copy))
    sessions_that_limit_themselves(copy)
    _give_rights_to_everybody(copy.router)(earlier)
    (copy.folder("guest") / SESSION_FILE).write_text(json.dumps(earlier), encoding="utf-8")


def _session_file_of_earlier_policy(copy: KeystoreCopy) -> bytes:
    """Return the guest's session file of a policy that gives the guest the topic.

    The keystore gets this policy, and then the earlier policy again.
    """
    through_the_router(copy)
    _change_rights(copy, zenoh_policy(copy.topic, guest_talks=True))
    earlier = (copy.folder("guest") / SESSION_FILE).read_bytes()
    _change_rights(copy, zenoh_policy(copy.topic))
    return earlier


def _change_rights(copy: KeystoreCopy, policy: Policy) -> None:
    generate_artifacts(copy.root, policies=[policy], now=copy.now)


# ── identities and links ───────────────────────────────────────────────────────────────────


def identity_of_another_ca(copy: KeystoreCopy) -> None:
    """Give the talker the key and certificate of the talker of another CA."""
    other = enclave_path(copy.foreign, copy.enclave("talker"))
    for name in (KEY_FILE, CERTIFICATE_FILE):
        copy.put("talker", name, (other / name).read_bytes())


def both_cas_trusted(copy: KeystoreCopy) -> None:
    """Make everybody trust the other CA, too."""
    identity_of_another_ca(copy)
    other = (enclave_path(copy.foreign, copy.enclave("talker")) / IDENTITY_CA_FILE).read_bytes()
    for name in enclave_names(copy.root):
        file = enclave_path(copy.root, name) / IDENTITY_CA_FILE
        certificates = file.read_bytes() + other
        file.unlink()
        file.write_bytes(certificates)


def without_certificate(copy: KeystoreCopy) -> None:
    """Let the talker show no certificate."""
    for name in (KEY_FILE, CERTIFICATE_FILE):
        (copy.folder("talker") / name).unlink()

    def change(document: _Document) -> None:
        _tls(document)["enable_mtls"] = False
        document["listen"]["endpoints"] = []
        # The talker does not listen, so it has to connect, whichever id is greater.
        gossip = document["scouting"]["gossip"]
        gossip["autoconnect_strategy"]["peer"]["to_peer"] = "always"

    _edit_talker(copy, change)


def certificates_not_asked_for(copy: KeystoreCopy) -> None:
    """Demand no certificates, and allow everything; the talker shows no certificate."""

    def change(document: _Document) -> None:
        _tls(document)["enable_mtls"] = False
        _allow_everything(document)

    _edit_all(copy, change)
    without_certificate(copy)


def plain_tcp(copy: KeystoreCopy) -> None:
    """Let the talker speak TCP to the port of the router."""
    _edit_talker(copy, _set_plain_endpoint(f"tcp/{copy.endpoint}"))


def _set_plain_endpoint(endpoint: str) -> _Change:
    def change(document: _Document) -> None:
        document["mode"] = Mode.CLIENT.value
        document["connect"]["endpoints"] = [endpoint]
        document["listen"]["endpoints"] = []
        del document["transport"]["link"]

    return change


def tcp_next_to_tls(copy: KeystoreCopy) -> None:
    """Let the router also listen without TLS, and let everybody do everything at the router."""
    host, _, port = copy.endpoint.rpartition(":")
    endpoint = f"tcp/{host}:{int(port) + 1}"

    def change(document: _Document) -> None:
        document["listen"]["endpoints"].append(endpoint)
        del document["transport"]["link"]["protocols"]
        _allow_everything(document)

    through_the_router(copy)
    _edit(enclave_path(copy.root, copy.router) / ROUTER_FILE, change)
    _edit_talker(copy, _set_plain_endpoint(endpoint))


def links_in_the_clear(copy: KeystoreCopy) -> None:
    """Let everybody speak TCP, without access control."""

    def change(document: _Document) -> None:
        _remove_rules(document)
        del document["transport"]["link"]
        for side in ("listen", "connect"):
            endpoints = document[side]["endpoints"]
            document[side]["endpoints"] = [
                endpoint.replace("tls/", "tcp/") for endpoint in endpoints
            ]

    _edit_all(copy, change)


def short_lived(_copy: KeystoreCopy) -> None:
    """Leave the keystore unchanged: the runner gives the talker a certificate that expires."""


def links_that_outlive_certificates(copy: KeystoreCopy) -> None:
    """Leave links open when a certificate expires."""

    def change(document: _Document) -> None:
        _tls(document)["close_link_on_expiration"] = False

    _edit_all(copy, change)


def room_for_few_handshakes(copy: KeystoreCopy) -> None:
    """Set the router's limit of simultaneous handshakes to the low default of Zenoh."""

    def change(document: _Document) -> None:
        document["transport"].pop("unicast", None)

    _edit_all(copy, change)


def allow_shared_memory(copy: KeystoreCopy) -> None:
    """Let processes of the host exchange large messages in shared memory."""

    def change(document: _Document) -> None:
        document["transport"]["shared_memory"]["enabled"] = True

    _edit_all(copy, change)


# ── revocation ─────────────────────────────────────────────────────────────────────────────


def revoked_talker(copy: KeystoreCopy) -> None:
    """Revoke the talker; a thief has a copy of the talker's enclave."""
    keep_stolen(copy, _revoke_talker(copy))


def revoked_talker_in_the_rules(copy: KeystoreCopy) -> None:
    """Revoke the talker, but leave the files of all other enclaves as they were."""
    before = {path: path.read_bytes() for path in _files(copy).values()}
    stolen = _revoke_talker(copy)
    for path, data in before.items():
        if path.parent.is_dir():
            path.write_bytes(data)
    keep_stolen(copy, stolen)


def revoked_name_in_use_again(copy: KeystoreCopy) -> None:
    """Revoke the talker, and create a new enclave with the same name."""
    stolen = _revoke_talker(copy)
    talker, policy = copy.enclave("talker"), zenoh_policy(copy.topic)
    generate_artifacts(copy.root, enclaves=[talker], policies=[policy], now=copy.now)
    keep_stolen(copy, stolen)


def rights_taken_away(copy: KeystoreCopy) -> None:
    """Take away the talker's right to the topic in the keystore, while all processes run."""
    _change_rights(copy, zenoh_policy(copy.topic, silent=copy.enclave("talker")))


def rights_to_take_away(_copy: KeystoreCopy) -> None:
    """Leave the keystore unchanged: `rights_taken_away` changes it while the row runs."""


def _revoke_talker(copy: KeystoreCopy) -> dict[str, bytes]:
    """Revoke the talker; return the files of the talker before that."""
    stolen = {file.name: file.read_bytes() for file in copy.folder("talker").iterdir()}
    revoke(copy.root, [copy.enclave("talker")], now=copy.now, keyring=copy.keyring)
    return stolen


def valid_certificate(copy: KeystoreCopy) -> None:
    """Issue the talker's certificate again, valid from yesterday to tomorrow."""
    day = timedelta(days=1)
    copy.reissue("talker", Window(copy.now - day, copy.now + day))


# ── the network, and the variables that its processes read ───────────────────────────────────────

_WITHOUT_RULES = "access_control/enabled=false"


def start_network(root: Path, router: str, endpoint: str, mode: Mode, now: datetime) -> None:
    """Give a keystore a Zenoh network whose router listens at ``endpoint``.

    `sros zenoh` does the same.
    """
    set_zenoh(root, ZenohNetwork(router, (endpoint,), mode=mode), now=now)


def zenoh_variables(
    root: Path, enclave: str, domain: int, *, router: bool, ignores_rules: bool
) -> Mapping[str, str]:
    """Return the variables with which rmw_zenoh uses the files of an enclave as they are written.

    A process that ``ignores_rules`` does not enforce its own file. A process without a key shows no
    certificate.
    """
    folder = enclave_path(root, enclave).absolute()
    file = str(folder / (ROUTER_FILE if router else SESSION_FILE))
    places = {SESSION_URI: file, **({ROUTER_URI: file} if router else {})}
    files = (folder / name for name in (IDENTITY_CA_FILE, CERTIFICATE_FILE, KEY_FILE))
    variables = zenoh_environment(places, *files)
    override = variables[OVERRIDE]
    if not (folder / KEY_FILE).exists():
        override, _, _ = override.partition(";")  # keep only the CA, which is first
    if ignores_rules:
        override = f"{override};{_WITHOUT_RULES}"
    return {**variables, DOMAIN: str(domain), OVERRIDE: override}
