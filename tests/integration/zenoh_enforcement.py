"""What a real router lets through by random rules, next to what sros says of them."""

from __future__ import annotations

import json
import random
import tempfile
from pathlib import Path
from typing import Any

import zenoh

from sros_tool.zenoh.access import Message, Remote
from sros_tool.zenoh.document import parse_configuration
from tests.integration.zenoh_world import MESSAGES, PAUSE, drawn_rule, observed_cases

CASES = 60
REMOTES = {
    "/talker": Remote("/talker", "tls", "tom", ("lo",), "a1"),
    "/listener": Remote("/listener", "tls", "mary", ("lo",), "b2"),
}
SUBJECTS: tuple[dict[str, list[str]], ...] = (
    {"cert_common_names": ["/talker"]},
    {"cert_common_names": ["/listener"]},
    {"cert_common_names": ["/talker", "/listener"]},
    {"cert_common_names": ["/talker"], "link_protocols": ["tls", "quic"]},
    {"cert_common_names": ["/talker"], "link_protocols": ["tcp"]},
    {"cert_common_names": ["/other"]},
    {"usernames": ["tom"]},
    {"usernames": ["mary", "tom"]},
    {"zids": ["a1", "c3"]},
    {"interfaces": ["lo"]},
    {"interfaces": ["eth9"]},
    {"link_protocols": ["tls"]},
    {"link_protocols": ["tcp", "udp"], "usernames": ["tom"]},
    {},
)


def configuration(keystore: Path, enclave: str, **settings: Any) -> dict[str, Any]:
    """The configuration of a process of an enclave, that obeys no rules unless they are given."""
    folder = keystore / "enclaves" / enclave[1:]
    tls: dict[str, Any] = {
        "enable_mtls": True,
        "verify_name_on_connect": False,
        "root_ca_certificate": str(folder / "identity_ca.cert.pem"),
    }
    for side in ("connect", "listen"):
        tls |= {
            f"{side}_private_key": str(folder / "key.pem"),
            f"{side}_certificate": str(folder / "cert.pem"),
        }
    transport = {"link": {"protocols": ["tls"], "tls": tls}, "shared_memory": {"enabled": False}}
    return {
        "mode": "client",
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {**transport, **settings.pop("transport", {})},
        **settings,
    }


def opened(document: dict[str, Any]) -> Any:
    return zenoh.open(zenoh.Config.from_json5(json.dumps(document)))


def drawn_control(draw: random.Random, default: str) -> dict[str, Any]:
    """Random rules for each case, and random subjects, of which several may be the same."""
    subjects = draw.choices(SUBJECTS, k=draw.choice((1, 2, 3, 6, 14)))
    if default == "deny":
        subjects += [SUBJECTS[0], SUBJECTS[1]]
    rules: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []

    def rule(permission: str, flows: list[str], message: str, keys: tuple[str, ...]) -> None:
        rules.append(
            {
                "id": f"r{len(rules)}",
                "permission": permission,
                "flows": flows,
                "messages": [message],
                "key_exprs": list(keys),
            }
        )
        if draw.random() < 0.1:
            del rules[-1]["flows"]
        some = draw.sample(range(len(subjects)), draw.randint(1, min(3, len(subjects))))
        policies.append({"rules": [rules[-1]["id"]], "subjects": [f"s{each}" for each in some]})

    for number in range(CASES):
        base = f"t/{number}"
        for who, flow, message, _ in {each for of in MESSAGES.values() for each in of}:
            if default == "deny" and draw.random() < 0.93:
                rule("allow", [flow.value], message.value, drawn_rule(draw, base))
                named = len(subjects) - (2 if who == "/talker" else 1)
                policies[-1]["subjects"] = [f"s{named}"]
            if draw.random() < (0.15 if default == "deny" else 0.3):
                permission = draw.choices(("deny", "allow"), (2, 1))[0]
                rule(permission, [flow.value], message.value, drawn_rule(draw, base))
    draw.shuffle(rules)
    draw.shuffle(policies)
    return {
        "enabled": True,
        "default_permission": default,
        "rules": rules,
        "subjects": [{"id": f"s{number}", **each} for number, each in enumerate(subjects)],
        "policies": policies,
    }


def world(keystore: Path, port: int, draw: random.Random, default: str) -> dict[str, Any]:
    """Compare what is said of one random router with what it does."""
    control = drawn_control(draw, default)
    access = parse_configuration(json.dumps({"access_control": control}).encode(), "drawn").access
    cases = []
    for number in range(CASES):
        base = f"t/{number}"
        asked, declared = (f"{base}/{draw.choices(('a', '*', '**'), (6, 1, 1))[0]}" for _ in "12")
        cases.append((asked, declared, f"{base}/a"))
    with tempfile.NamedTemporaryFile("w", suffix=".txt") as users:
        users.write("tom:secret\nmary:secret\n")
        users.flush()
        endpoint = f"tls/127.0.0.1:{port}"
        router = opened(
            configuration(
                keystore,
                "/router",
                mode="router",
                listen={"endpoints": [endpoint]},
                transport={"auth": {"usrpwd": {"dictionary_file": users.name}}},
                access_control=control,
            )
        )
        to_router = {"endpoints": [endpoint], "timeout_ms": 60_000, "exit_on_failure": True}
        talker, listener = (
            opened(
                configuration(
                    keystore,
                    who,
                    id=remote.zid,
                    connect=to_router,
                    transport={"auth": {"usrpwd": {"user": remote.username, "password": "secret"}}},
                )
            )
            for who, remote in REMOTES.items()
        )
        seen = observed_cases(talker, listener, cases, 2 * PAUSE)
        for session in (talker, listener, router):
            session.close()
    told = {
        what: {
            number
            for number, names in enumerate(cases)
            if all(
                access.decide(REMOTES[who], flow, message, names[place]).allowed
                or (message is Message.DECLARE_SUBSCRIBER and who == "/talker" and "*" in names[0])
                for who, flow, message, place in of
            )
        }
        for what, of in MESSAGES.items()
    }
    told["reply"] &= told["query"]
    return {
        "different": [
            [default, what, *cases[n], "said" if n in told[what] else "seen"]
            for what in seen
            for n in sorted(told[what] ^ seen[what])
        ],
        "subjects": control["subjects"],
        "happened": sum(map(len, seen.values())),
        "decisions": 3 * CASES,
    }


def worlds(keystore: Path, port: int, count: int) -> list[dict[str, Any]]:
    """Return what was observed in so many worlds, and where sros says something else."""
    return [
        world(keystore, port, random.Random(number), ("deny", "allow")[number % 2])
        for number in range(count)
    ]
