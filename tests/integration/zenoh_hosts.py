"""Hosts of a network, each with Zenoh processes of its own; started as a process of its own.

    python -P tests/integration/zenoh_hosts.py PLAY KEYSTORE

Prints what was observed as JSON, or why there are no hosts.  The process enters a network of its
own; each host is another one, with an interface on a switch that this process has.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from sros_tool.runtime.netns import enter_isolation, try_isolation

HOSTS = {"desk": "10.9.0.1", "r1": "10.9.0.2", "r2": "10.9.0.3"}
"""The names of the hosts, and their addresses."""
_SWITCH = "switch"


def ip(*words: str) -> None:
    """Run iproute2 in the network of this process."""
    subprocess.run(["ip", *words], check=True, capture_output=True)


class Host:
    """A host, which carries out methods of `Sessions`."""

    def __init__(self, number: int, address: str, keystore: Path) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-P", __file__, "host", address, str(keystore)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self._answer()  # it is in its network
        link = f"host{number}"
        ip("link", "add", "link", _SWITCH, "name", link, "type", "macvlan", "mode", "bridge")
        ip("link", "set", link, "netns", str(self._process.pid))
        self.do("plug", link)

    def do(self, method: str, *arguments: object) -> Any:
        """Carry out a method on the host, and return its result."""
        assert self._process.stdin
        print(json.dumps([method, *arguments]), file=self._process.stdin, flush=True)
        return self._answer()

    def _answer(self) -> Any:
        assert self._process.stdout
        return json.loads(self._process.stdout.readline())

    def end(self) -> None:
        """End the processes of the host."""
        self._process.kill()
        self._process.wait()


class Sessions:
    """The Zenoh processes of a host, as sessions by the names that they are opened with."""

    def __init__(self, address: str, keystore: Path) -> None:
        self._address = address
        self._keystore = keystore
        self._sessions: dict[str, Any] = {}
        self._kept: list[Any] = []
        self._got: dict[str, set[str]] = {}

    def plug(self, link: str) -> None:
        """Give an interface the address of the host."""
        ip("link", "set", link, "name", "eth0")
        ip("addr", "add", f"{self._address}/24", "dev", "eth0")
        ip("link", "set", "eth0", "up")

    def open(self, name: str, enclave: str, file: str, how: dict[str, Any]) -> None:
        """Open a session of an enclave; ``how`` is for `zenoh_world.configured`."""
        import zenoh

        from tests.integration.zenoh_world import configured

        self._sessions[name] = zenoh.open(configured(self._keystore, enclave, file, **how))
        self._got[name] = set()

    def close(self, name: str) -> None:
        """Close a session."""
        self._sessions.pop(name).close()

    def hear(self, name: str, topic: str) -> None:
        """Subscribe a topic."""
        from tests.integration.zenoh_world import key, text

        got = self._got[name]
        keys = key(topic) if topic.startswith("/") else topic
        session = self._sessions[name]
        self._kept.append(session.declare_subscriber(keys, lambda sample: got.add(text(sample))))

    def serve(self, name: str, service: str) -> None:
        """Offer a service, whose requests count as heard."""
        from tests.integration.zenoh_world import serve

        self._kept.append(serve(self._sessions[name], service, name, self._got[name]))

    def call(self, name: str, service: str) -> list[str]:
        """Return who replies to a call."""
        from tests.integration.zenoh_world import replies

        return sorted(replies(self._sessions[name], service, name))

    def say(self, name: str, topic: str, message: str) -> None:
        """Publish a message."""
        from tests.integration.zenoh_world import key

        self._sessions[name].put(key(topic), message)

    def announce(self, name: str, enclave: str, node: str) -> None:
        """Announce a node in the graph."""
        from tests.integration.zenoh_world import token

        self._kept.append(token(self._sessions[name], enclave, node))

    def nodes(self, name: str) -> list[str]:
        """Return the nodes that a session sees."""
        from tests.integration.zenoh_world import nodes

        return sorted(nodes(self._sessions[name]))

    def heard(self, name: str) -> list[str]:
        """Return what a session got."""
        return sorted(self._got[name])


@contextmanager
def hosts(keystore: Path) -> Iterator[dict[str, Host]]:
    """The hosts, all on one switch."""
    enter_isolation()
    ip("link", "add", _SWITCH, "type", "bridge")
    ip("link", "set", _SWITCH, "up")
    found: dict[str, Host] = {}
    try:
        for number, (name, address) in enumerate(HOSTS.items()):
            found[name] = Host(number, address, keystore)
        yield found
    finally:
        for host in found.values():
            host.end()


def until(happened: Callable[[], bool], again: Callable[[], object] = lambda: None) -> bool:
    """Do something again and again until something happens; False if it never does."""
    from tests.integration.zenoh_world import until

    return until(happened, again)


def routers(keystore: Path) -> dict[str, object]:
    """Each robot has a router; what enclaves at both ends may do passes, if its name may cross.

    Each denied message is sent before an allowed one that is waited for.
    """
    told: dict[str, object] = {}
    with hosts(keystore) as at:
        desk, r1, r2 = at.values()
        for host, router in ((desk, "/router"), (r1, "/r1/router"), (r2, "/r2/router")):
            host.do("open", "router", router, "router.json5", {})
        for host, name in (
            (desk, "/desk"),
            (r1, "/r1/talker"),
            (r1, "/r1/client"),
            (r2, "/r2/listener"),
            (r2, "/r2/near"),
            (r2, "/r2/server"),
        ):
            host.do("open", name.rpartition("/")[2], name, "session.json5", {})
        # Another robot's router that obeys no rules, with a key that is in the keystore.
        ignores_rules = {
            "rules": False,
            "mode": "client",
            "connect": {"endpoints": [f"tls/{HOSTS['r2']}:7447"]},
            "listen": {"endpoints": []},
        }
        desk.do("open", "ignores_rules", "/r1/router", "router.json5", ignores_rules)
        for topic in ("/chatter", "/secret", "/inner"):
            r2.do("hear", "listener", topic)
        desk.do("hear", "desk", "/chatter")
        desk.do("hear", "desk", "/status")
        for keys in ("/status", "/secret", "0/**"):
            desk.do("hear", "ignores_rules", keys)
        r2.do("serve", "server", "/add")
        r1.do("announce", "talker", "/r1/talker", "n")

        def say(host: Host, name: str, topic: str, listener: tuple[Host, str]) -> bool:
            return until(
                lambda: name + topic in listener[0].do("heard", listener[1]),
                lambda: host.do("say", name, topic, name + topic),
            )

        for _ in range(3):
            for topic in ("/secret", "/inner", "/status"):
                desk.do("say", "ignores_rules", topic, f"ignores_rules{topic}")
            r1.do("say", "talker", "/inner", "talker/inner")
            r2.do("say", "near", "/inner", "near/inner")
        told["chatter"] = say(r1, "talker", "/chatter", (r2, "listener"))
        told["chatter at the desk"] = say(r1, "talker", "/chatter", (desk, "desk"))
        told["secret"] = say(r2, "near", "/secret", (r2, "listener"))
        told["status"] = say(r2, "near", "/status", (desk, "desk"))
        told["as the robot"] = say(desk, "ignores_rules", "/chatter", (r2, "listener"))
        answers: set[str] = set()
        told["reply"] = until(
            lambda: "server" in answers, lambda: answers.update(r1.do("call", "client", "/add"))
        )
        told["graph"] = until(lambda: "n" in r2.do("nodes", "listener"))
        r2.do("close", "router")
        r2.do("open", "router", "/r2/router", "router.json5", {})
        told["after a restart"] = until(
            lambda: "again" in r2.do("heard", "listener"),
            lambda: r1.do("say", "talker", "/chatter", "again"),
        )
        told["listener"] = r2.do("heard", "listener")
        told["ignores_rules"] = desk.do("heard", "ignores_rules")
    return told


def one_router(keystore: Path) -> dict[str, bool]:
    """Two hosts have no router, and sessions that connect to that of the third."""
    with hosts(keystore) as at:
        desk, r1, r2 = at.values()
        desk.do("open", "router", "/router", "router.json5", {})
        r1.do("open", "talker", "/r1/talker", "session.json5", {})
        r2.do("open", "listener", "/r2/listener", "session.json5", {})
        r2.do("hear", "listener", "/chatter")
        heard = until(
            lambda: r2.do("heard", "listener") == ["chatter"],
            lambda: r1.do("say", "talker", "/chatter", "chatter"),
        )
        return {"heard": heard}


PLAYS: dict[str, Callable[[Path], Any]] = {"routers": routers, "one_router": one_router}


def main(play: str, *words: str) -> None:
    """Be a host, or a network of hosts."""
    if play == "host":
        address, keystore = words
        sessions = Sessions(address, Path(keystore))
        enter_isolation()
        print("true", flush=True)
        for line in sys.stdin:
            method, *arguments = json.loads(line)
            print(json.dumps(getattr(sessions, method)(*arguments)), flush=True)
        return
    if not (isolation := try_isolation()).isolated:
        print(json.dumps(isolation.reason), flush=True)
        return
    try:
        print(json.dumps(PLAYS[play](Path(words[0]))), flush=True)
    except (OSError, subprocess.CalledProcessError) as error:
        print(json.dumps(f"no network of hosts: {error}"), flush=True)


if __name__ == "__main__":
    with suppress(KeyboardInterrupt):
        main(*sys.argv[1:])
    sys.stdout.flush()
    os._exit(0)  # threads of a session that hangs would keep the process
