"""The recipe for nginx in docs/howto/fleet_server.md, with a real nginx between robots and home."""

from __future__ import annotations

import http.client
import re
import socket
import ssl
import subprocess
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import pytest

from sros_tool.agent.fetch import ClientCertificate, fetch_release, pin_root
from sros_tool.agent.inbox import send
from sros_tool.errors import SrosError, UnavailableError
from sros_tool.keystore.confirmation import MAX_BYTES, MESSAGE_FILE
from tests.support.harness import policy_text, publish, sros
from tests.support.messages import said_by, signed_message
from tests.support.nginx import NGINX, certify_server, nginx_of_page
from tests.support.pages import PROJECT

pytestmark = pytest.mark.skipif(not Path(NGINX).exists(), reason="nginx is needed")


@dataclass
class Server:
    """Home with the web server of the recipe: a keystore, what is published, and an inbox."""

    folder: Path
    run: Path
    """Folder of the configuration and the process of nginx."""
    port: int = 0
    command: Sequence[str] = ()

    @property
    def address(self) -> str:
        return f"https://127.0.0.1:{self.port}"

    @property
    def tls_ca(self) -> Path:
        return self.folder / "etc/server.cert.pem"

    def certificate(self, robot: str) -> ClientCertificate:
        """Return the files with which a robot identifies itself: those of its enclave."""
        place = self.folder / robot / f"enclaves/{robot}/base"
        return ClientCertificate(place / "cert.pem", place / "key.pem")

    def put(self, robot: str, message: bytes, to: str = "") -> None:
        """Send a message as the agent of ``robot``, to the inbox of ``to``."""
        send(
            f"{self.address}/inbox",
            to or robot,
            message,
            client_certificate=self.certificate(robot),
            tls_ca=self.tls_ca,
        )

    def ask(self, robot: str, method: str, path: str, body: bytes = b"") -> int:
        """Return the status that the server answers to a request of a robot; "" is nobody."""
        context = ssl.create_default_context(cafile=str(self.tls_ca))
        if robot:
            context.load_cert_chain(*self.certificate(robot))
        connection = http.client.HTTPSConnection("127.0.0.1", self.port, context=context)
        try:
            connection.request(method, path, body or None)
            return connection.getresponse().status
        finally:
            connection.close()

    def message(self, robot: str) -> bytes:
        folder = self.folder / robot
        said = said_by(folder, robot, datetime.now(UTC))
        return signed_message(folder, f"/{robot}/base", said)

    def reload(self, *, adds: bool = False) -> None:
        """Copy CAs and list, or add them to the copies, and let nginx read them, as the page
        says."""
        for file in ("identity_ca.cert.pem", "identity_ca.crl.pem"):
            with (self.folder / "etc" / file).open("ab" if adds else "wb") as copy:
                copy.write((self.folder / "ks/public" / file).read_bytes())
        subprocess.run([*self.command, "-s", "reload"], check=True, capture_output=True)

    def answers(self, robot: str, status: int) -> bool:
        """Return whether the server soon answers so: a reload takes a moment."""
        end = time.monotonic() + 10
        while self.ask(robot, "GET", "/pub/metadata/timestamp.json") != status:
            if time.monotonic() > end:
                return False
            time.sleep(0.05)
        return True

    def start(self) -> None:
        """Start nginx as the page says, with the paths and a free port of this machine."""
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        listen = f"127.0.0.1:{self.port}"
        self.command = nginx_of_page(self.folder, self.run, listen=listen)
        ended = subprocess.run(self.command, capture_output=True, check=False)
        assert ended.returncode == 0, (self.run / "error.log").read_text()

    def stop(self) -> None:
        subprocess.run([*self.command, "-s", "stop"], capture_output=True, check=False)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    folder = tmp_path_factory.mktemp("nginx")
    made = Server(folder, folder / "nginx")
    (folder / "fleet.toml").write_text("[robots]\nr1 = {}\nr2 = {}\nr3 = {}\n")
    (folder / "policy.xml").write_text(policy_text({"/{robot}/base": publish("/x")}))
    for line in (
        "create_keystore ks --template production",
        "generate_artifacts -k ks -p policy.xml --fleet fleet.toml",
        "crl ks --refresh",
        *(f"distribute_key ks --robot {robot} {robot}" for robot in ("r1", "r2", "r3")),
        "fleet publish ks srv/pub",
    ):
        sros(*line.split(), cwd=folder).ok()
    (folder / "srv/inbox").mkdir()
    certify_server(folder, folder / "ks")
    made.start()
    yield made
    made.stop()


def test_a_robot_writes_its_own_message_alone(server: Server) -> None:
    """Whoever else writes, reads or lists is refused; the message is what home takes in."""
    message = server.message("r1")
    place = server.folder / "srv/inbox"
    for other in ("r2", "r9", "..", "r1/..%2fr2"):
        with pytest.raises(UnavailableError, match=r"answers 40[034]"):
            server.put("r1", message, to=other)
    assert list(place.iterdir()) == []
    server.put("r1", message)
    assert (place / "r1" / MESSAGE_FILE).read_bytes() == message
    server.put("r2", server.message("r2"))
    path = f"/inbox/r1/{MESSAGE_FILE}"
    for robot in ("r1", "r2"):
        assert server.ask(robot, "GET", path) == 403
        assert server.ask(robot, "DELETE", path) == 403
    for path in ("/inbox/", "/inbox/r1/", "/inbox/r1/other", "/ks/sros.toml", "/"):
        assert {server.ask("r1", method, path, b"x") for method in ("GET", "PUT")} == {404}, path
    assert server.ask("r1", "PUT", f"/inbox/r1/{MESSAGE_FILE}", bytes(MAX_BYTES + 1)) == 413
    assert (place / "r1" / MESSAGE_FILE).read_bytes() == message
    ended = sros("fleet", "collect", "ks", "srv/inbox", cwd=server.folder).ok()
    assert ended.out.startswith("3 robots: 2 kept, 1 without a message (or delivered by hand)")


def test_a_robot_reads_what_is_published_and_writes_nothing_there(
    server: Server, tmp_path: Path
) -> None:
    pub = server.folder / "srv/pub"
    now = datetime.now(UTC)
    pin_root(tmp_path, (pub / "metadata/1.root.json").read_bytes(), now=now)
    fetched = fetch_release(
        tmp_path,
        f"{server.address}/pub",
        "r1",
        now=now,
        client_certificate=server.certificate("r1"),
        tls_ca=server.tls_ca,
    )
    assert fetched and fetched.robot == "r1"
    timestamp = (pub / "metadata/timestamp.json").read_bytes()
    for method in ("PUT", "DELETE"):
        assert server.ask("r1", method, "/pub/metadata/timestamp.json", b"{}") == 403
    assert (pub / "metadata/timestamp.json").read_bytes() == timestamp
    assert server.ask("r1", "GET", "/pub/") == 403, "nothing is listed"
    with pytest.raises(SrosError):
        fetch_release(tmp_path, f"{server.address}/pub", "r1", now=now, tls_ca=server.tls_ca)


def test_the_robot_that_a_subject_names() -> None:
    """The map of the page, for subjects as nginx writes them."""
    page = (PROJECT / "docs/howto/fleet_server.md").read_text()
    (written,) = re.findall(r'"~(\^.*CN=.*\$)" \$name;', page)
    expression = re.compile(written.replace("(?<", "(?P<").removesuffix("$") + r"\Z")
    unique = "0123456789abcdef"
    for subject, robot in {
        "CN=/r1/base": "r1",
        "CN=/office1": "office1",
        f"OU={unique},CN=/r1/arm/left": "r1",
        f"CN=/office1,OU={unique}": "office1",
        "CN=/r1/": None,
        "CN=/": None,
        "CN=r1": None,
        "CN=/r2,CN=/r1": None,
        "CN=/r2/x,O=/r1": None,
        "CN=/r1.base": None,
        "CN=/r1\n/base": None,
    }.items():
        found = expression.search(subject)
        assert (found and found["name"]) == robot, subject


def test_who_has_no_certificate_of_the_keystore(server: Server) -> None:
    """Nobody, another keystore, and a robot that was revoked, once nginx has read the list."""
    path = "/pub/metadata/timestamp.json"
    assert server.ask("", "GET", path) == 400
    other = server.folder / "other"
    sros("create_keystore", other).ok()
    sros("create_enclave", other, "/other/base").ok()
    assert server.ask("other", "GET", path) == 400
    assert server.ask("r3", "GET", path) == 200
    sros("revoke", "ks", "--robot", "r3", cwd=server.folder).ok()
    server.reload()
    assert server.answers("r3", 400)
    assert server.ask("r2", "GET", path) == 200


def test_robots_of_both_cas_are_served_while_the_ca_is_replaced(server: Server) -> None:
    """The list of the other CA is in the file of the CAs."""
    for _ in range(2):
        sros("rotate_ca", "ks", "--next", "--allow-unconfirmed", cwd=server.folder).ok()
        sros("distribute_key", "ks", "--robot", "r1", "r1", "--force", cwd=server.folder).ok()
        server.reload()
        assert server.answers("r1", 200) and server.answers("r2", 200) and server.answers("r3", 400)
    sros("rotate_ca", "ks", "--next", "--allow-unconfirmed", cwd=server.folder).ok()
    server.reload(adds=True)
    assert server.answers("r3", 400) and server.answers("r2", 200) and server.answers("r1", 200)
    server.reload()
    assert server.answers("r2", 400) and server.answers("r1", 200)


def test_robots_fetch_after_all_stages_at_once_and_revoked_ones_do_not(server: Server) -> None:
    """The server keeps the CA and the list of before until the robots have fetched."""
    sros("distribute_key", "ks", "--robot", "r2", "r2", "--force", cwd=server.folder).ok()
    sros("revoke", "ks", "--robot", "r2", cwd=server.folder).ok()
    server.reload()
    assert server.answers("r2", 400) and server.answers("r1", 200)
    words = ("rotate_ca", "ks", "--identity", "--finish", "--allow-unconfirmed")
    ended = sros(*words, cwd=server.folder).ok()
    assert "A web server that has only the new identity CA refuses" in ended.err
    server.reload(adds=True)
    assert server.answers("r1", 200) and server.answers("r2", 400)
    sros("distribute_key", "ks", "--robot", "r1", "r1", "--force", cwd=server.folder).ok()
    assert server.answers("r1", 200) and server.answers("r2", 400)
    server.reload()
    assert server.answers("r1", 200)
