"""The attacks of TUF's specification on a robot that fetches, each with a twin that is accepted.

The Update Framework, 1.5.2: what a client has to withstand.
"""

from __future__ import annotations

import os
import shutil
import ssl
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from http.server import BaseHTTPRequestHandler, SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from tuf.api import exceptions

from sros_tool.agent import connection
from sros_tool.agent.fetch import (
    ClientCertificate,
    FetchError,
    FetchProblem,
    _fetch_error,
    pin_root,
)
from sros_tool.errors import UnavailableError, UsageError
from sros_tool.keystore.delivery.release import (
    Release,
    pack_release,
    read_release,
    seal_problem,
    seal_releases,
)
from sros_tool.keystore.issuing.authority import Authority
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.pki.certificates import common_name, issue_ca
from sros_tool.pki.keys import generate_key
from sros_tool.validity import window
from tests.agent.published import DAY, LATER, ROLES, Home, Thief


def test_a_release_has_all_files_of_a_robot_and_no_key(publisher: Home) -> None:
    release = publisher.robot("r2").gets()
    enclave = publisher.root / "enclaves/r2/base"
    there = {
        path.name for path in enclave.iterdir() if path.name not in ("key.pem", "permissions.xml")
    }
    assert {*release.enclaves()["/r2/base"]} == there
    for path, data in release.files.items():
        assert (publisher.root / path).read_bytes() == data
    assert (
        seal_problem(release, [OpenedKeystore(publisher.root).ca_certificate("permissions")]) == ""
    )
    assert read_release(pack_release(release)) == release


def test_what_is_installed_is_not_fetched_again(publisher: Home) -> None:
    robot = publisher.robot()
    release = robot.gets()
    shutil.rmtree(publisher.pub / "targets")
    assert robot.fetch(installed=release.number) is None
    assert robot.gets() == release  # the archive is kept until it is installed
    assert publisher.robot().refuses(FetchProblem.UNREACHABLE)


def test_another_release_with_the_number_of_the_installed_one(publisher: Home) -> None:
    """A home that was restored gives a number again, and the robot must not take it for its own."""
    robot = publisher.robot()
    release = robot.gets()
    (seal,) = seal_releases([("r1", release.number, release.files)], publisher.permissions_ca())
    other = replace(release, seal=seal)
    Thief(publisher, publisher.pub, *ROLES).put("r1", pack_release(other), release.number)
    for _ in range(2):
        assert robot.gets(installed=release.number) == other
    assert read_release((robot.state / "release.tar.gz").read_bytes()) == release


# ── older ──────────────────────────────────────────────────────────────────────────────────


def test_rollback_of_everything(publisher: Home) -> None:
    before, robot = publisher.kept("before"), publisher.robot()
    publisher.publish()
    robot.gets()
    robot.refuses(FetchProblem.ROLLED_BACK, before)
    publisher.robot().gets(before)  # who has seen nothing later cannot know


def test_rollback_with_the_timestamp_key(publisher: Home) -> None:
    publisher.run("renew", "ks", "/r1/base")
    publisher.publish(after=5 * DAY)
    robot = publisher.robot()
    robot.gets()
    thief = Thief(publisher, publisher.pub, "timestamp")
    thief.point_at(2)
    robot.gets()
    thief.point_at(1)
    robot.refuses(FetchProblem.ROLLED_BACK)


def test_rollback_of_a_bin_with_the_keys_of_timestamp_and_snapshot(publisher: Home) -> None:
    publisher.run("renew", "ks", "/r1/base")
    publisher.publish()
    robot = publisher.robot()
    release = robot.gets()
    thief = Thief(publisher, publisher.pub, "timestamp", "snapshot")
    name = thief.bin_of("r1")
    thief.lead_to({name: 2})
    assert robot.gets() == release
    thief.lead_to({name: 1})
    robot.refuses(FetchProblem.ROLLED_BACK)


def test_freezing(publisher: Home) -> None:
    frozen, robot = publisher.kept("frozen"), publisher.robot()
    robot.gets(now=publisher.now + DAY - LATER)
    error = robot.refuses(FetchProblem.EXPIRED, now=publisher.now + DAY + LATER)
    assert "clock" in error.remedy
    publisher.publish(after=DAY + LATER)
    robot.gets()
    robot.refuses(FetchProblem.ROLLED_BACK, frozen)
    publisher.robot().refuses(FetchProblem.EXPIRED, frozen)


# ── mixed ──────────────────────────────────────────────────────────────────────────────────


def test_mixing_versions(publisher: Home) -> None:
    publisher.run("renew", "ks", "/r1/base")
    publisher.publish()
    metadata = publisher.pub / "metadata"
    name = Thief(publisher, publisher.pub).bin_of("r1")
    for old, new, problem in (
        ("1.snapshot.json", "2.snapshot.json", FetchProblem.NOT_SIGNED),
        (f"1.{name}.json", f"2.{name}.json", FetchProblem.ROLLED_BACK),
    ):
        kept = (metadata / new).read_bytes()
        (metadata / new).write_bytes((metadata / old).read_bytes())
        publisher.robot().refuses(problem)
        (metadata / new).write_bytes(kept)
    (foreign := metadata / "2.root.json").write_bytes((metadata / "1.root.json").read_bytes())
    assert "puts altered files right" in publisher.robot().refuses(FetchProblem.NOT_SIGNED).remedy
    foreign.unlink()
    publisher.robot().gets()


def test_a_bin_that_signs_the_target_of_another(publisher: Home) -> None:
    """Only the bin of its path speaks for a robot, whatever the other bins say."""
    thief = Thief(publisher, publisher.pub, *ROLES)
    robot = "r5"
    assert thief.bin_of(robot) != thief.bin_of("r1")
    archive, number = thief.archive(robot)
    version = thief.sign(thief.bin_of(robot), lambda signed: signed.targets.clear())
    thief.lead_to({thief.bin_of(robot): version})
    thief.put(robot, archive, number, into=thief.bin_of("r1"))
    publisher.robot(robot).refuses(FetchProblem.NOT_FOR_ROBOT)
    thief.put(robot, archive, number)
    publisher.robot(robot).gets()


def test_a_bin_that_a_key_signs_which_is_not_delegated(publisher: Home) -> None:
    thief = Thief(publisher, publisher.pub, *ROLES)
    archive, number = thief.archive("r1")
    own = thief.signers["targets"]
    thief.signers["targets"] = thief.signers["snapshot"]
    thief.put("r1", archive, number)
    error = publisher.robot().refuses(FetchProblem.NOT_SIGNED)
    assert "`sros agent init` with --force and the new root.json" in error.remedy
    thief.signers["targets"] = own
    thief.put("r1", archive, number)
    publisher.robot().gets()


def test_damaged_files(publisher: Home) -> None:
    for file in ("timestamp.json", "1.targets.json", "1.snapshot.json"):
        path = publisher.pub / "metadata" / file
        kept = path.read_bytes()
        for damaged in (
            b"",
            b"[" * 300,
            b"{}",
            b"\xff",
            kept.replace(b'version":"1.0', b'version":"1.9'),
        ):
            path.write_bytes(damaged)
            assert publisher.robot().refuses(FetchProblem.NOT_SIGNED)
        path.write_bytes(kept)
    publisher.robot().gets()


# ── stolen keys ────────────────────────────────────────────────────────────────────────────


def test_versions_that_ran_ahead_are_mended_by_new_keys(publisher: Home) -> None:
    """A thief of online keys lets robots believe in versions that home never gets to."""
    robot = publisher.robot()
    Thief(publisher, publisher.pub, "timestamp", "snapshot").lead_to({}, 2**31)
    stolen = publisher.kept("stolen")
    robot.gets()
    (publisher.pub / "metadata" / f"{2**31}.snapshot.json").unlink()
    shutil.rmtree(publisher.pub)
    publisher.publish(new_folder=True)
    robot.refuses(FetchProblem.ROLLED_BACK)
    publisher.publish(rotate=("timestamp", "snapshot"))
    robot.gets()
    robot.refuses(FetchProblem.NOT_SIGNED, stolen)


def test_the_release_of_another_robot(publisher: Home) -> None:
    thief = Thief(publisher, publisher.pub, *ROLES)
    own = thief.archive("r1")
    thief.put("r1", *thief.archive("r2"))
    publisher.robot().refuses(FetchProblem.NOT_FOR_ROBOT)
    thief.put("r1", *own)
    publisher.robot().gets()


def test_all_keys_of_publishing_install_nothing(publisher: Home) -> None:
    """Who has them leads a robot to any archive, but the permissions CA has not sealed it."""
    trusted = [OpenedKeystore(publisher.root).ca_certificate("permissions")]
    original = publisher.robot().gets()
    assert seal_problem(original, trusted) == ""
    thief = Thief(publisher, publisher.pub, *ROLES)
    path = "enclaves/r1/base/permissions.p7s"
    files = {**original.files, path: b"every right"}
    changed = replace(original, files=files)
    thief.put("r1", pack_release(changed), changed.number)
    publisher.robot().refuses(FetchProblem.NOT_SIGNED)

    key = generate_key()
    own = Authority(issue_ca(key, common_name("own"), window(publisher.now, DAY)), key)
    number = original.number + 1
    (seal,) = seal_releases([("r1", number, files)], own)
    forged = Release("r1", number, files, seal)
    thief.put("r1", pack_release(forged), number)
    assert publisher.robot().gets() == forged  # fetched, and by its seal not to be installed
    assert seal_problem(forged, trusted)
    assert seal_problem(forged, [own.certificate]) == ""
    for other in ({"robot": "r2"}, {"number": number}, {"files": files}):
        assert seal_problem(replace(original, **other), trusted)


def test_a_number_that_the_seal_does_not_have(publisher: Home) -> None:
    """Else what a thief says to be installed already would never be looked at."""
    thief = Thief(publisher, publisher.pub, *ROLES)
    archive, number = thief.archive("r1")
    thief.put("r1", archive, number + 1)
    assert publisher.robot().refuses(FetchProblem.NOT_SIGNED).remedy
    thief.put("r1", archive, number)
    publisher.robot().gets()


# ── servers ────────────────────────────────────────────────────────────────────────────────


@contextmanager
def serving(handler: Callable[..., BaseHTTPRequestHandler], tls: object = None) -> Iterator[str]:
    """Serve on a port of this machine; yield the address."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    server.daemon_threads = True
    if isinstance(tls, ssl.SSLContext):
        server.socket = tls.wrap_socket(server.socket, server_side=True)
    thread = threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True)
    thread.start()
    try:
        yield f"http{'s' if tls else ''}://127.0.0.1:{server.server_port}/fleet/"
    finally:
        server.shutdown()
        server.server_close()


class Quiet(SimpleHTTPRequestHandler):
    """A server of files that logs nothing and keeps connections."""

    protocol_version = "HTTP/1.1"
    seen: tuple[str, ...] = ()

    def log_message(self, *_words: object) -> None:
        pass

    def translate_path(self, path: str) -> str:
        return super().translate_path(path.removeprefix("/fleet"))


class Refusing(Quiet):
    """A server that answers as nginx to a certificate that it refuses."""

    def do_GET(self) -> None:
        self.send_error(400)


def test_a_web_server(publisher: Home) -> None:
    with serving(partial(Quiet, directory=str(publisher.pub))) as address:
        assert publisher.robot().gets(address) == publisher.robot().gets()
        shutil.rmtree(publisher.pub / "targets")
        assert "404" in publisher.robot().refuses(FetchProblem.UNREACHABLE, address).why
    assert publisher.robot().refuses(FetchProblem.UNREACHABLE, address)
    with serving(partial(Refusing, directory=str(publisher.pub))) as address:
        error = publisher.robot().refuses(FetchProblem.REFUSED, address)
        assert "answers 400" in error.why and "sros distribute_key" in error.remedy


def test_endless_data(publisher: Home) -> None:
    class Endless(Quiet):
        def do_GET(self) -> None:
            if self.path.endswith(self.endless):
                self.send_response(200)
                self.end_headers()
                with pytest.raises(OSError):
                    while True:
                        self.wfile.write(bytes(1 << 16))
                self.close_connection = True
            else:
                super().do_GET()

        endless = "/timestamp.json"

    with serving(partial(Endless, directory=str(publisher.pub))) as address:
        for Endless.endless in ("/timestamp.json", "/1.snapshot.json", ".r1.tar.gz"):
            refused = publisher.robot().refuses(FetchProblem.TOO_LARGE, address)
            assert "puts altered files right" in refused.remedy
            assert f"{Endless.endless} is larger than the " in refused.why
        Endless.endless = "nothing"
        publisher.robot().gets(address)


def test_large_files_in_a_folder(publisher: Home) -> None:
    with (publisher.pub / "metadata/timestamp.json").open("ab") as file:
        file.truncate(1 << 31)
    refused = publisher.robot().refuses(FetchProblem.TOO_LARGE)
    assert refused.why.startswith("The file metadata/timestamp.json is larger than the ")


@pytest.mark.parametrize(
    "name", ["metadata/timestamp.json", "metadata/root.json", "release.tar.gz"]
)
def test_what_has_no_end_in_the_agents_folder_is_fetched_again(publisher: Home, name: str) -> None:
    robot = publisher.robot()
    before, path = robot.gets(), robot.state / name
    for is_huge in (True, False):
        path.unlink()
        if is_huge:
            path.touch()
            os.truncate(path, 1 << 40)
        else:
            os.mkfifo(path)
        assert robot.gets() == before
        assert path.is_file() and path.stat().st_size < 1 << 20


@pytest.mark.parametrize("begin", [b"", b"HTTP/1.1 200 OK\r\nX: ", b"HTTP/1.1 200 OK\r\n\r\n"])
def test_data_that_comes_slowly(
    publisher: Home, monkeypatch: pytest.MonkeyPatch, begin: bytes
) -> None:
    """Each byte comes in time, and there is no end of them."""
    ended = threading.Event()

    class Slow(Quiet):
        def do_GET(self) -> None:
            with pytest.raises(OSError):
                self.wfile.write(begin)
                while not ended.wait(0.01):
                    self.wfile.write(b"x")
                raise BrokenPipeError
            self.close_connection = True

    monkeypatch.setattr(connection, "_MOST_SECONDS", 0.3)
    with serving(partial(Slow, directory=str(publisher.pub))) as address:
        publisher.robot().refuses(FetchProblem.UNREACHABLE, address)
        ended.set()


def test_tls_with_the_certificate_of_an_enclave(publisher: Home, tmp_path: Path) -> None:
    words = "req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -subj /CN=server -days 9"
    more = ("-addext", "subjectAltName=IP:127.0.0.1", "-keyout", "s.key", "-out", "s.pem")
    subprocess.run(
        ["openssl", *words.split(), *more], cwd=tmp_path, check=True, capture_output=True
    )
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.load_cert_chain(tmp_path / "s.pem", tmp_path / "s.key")
    context.load_verify_locations(publisher.root / "public/identity_ca.cert.pem")
    context.verify_mode = ssl.CERT_REQUIRED
    enclave = publisher.root / "enclaves/r1/base"
    own = ClientCertificate(enclave / "cert.pem", enclave / "key.pem")
    with serving(partial(Quiet, directory=str(publisher.pub)), context) as address:
        robot = publisher.robot()
        robot.gets(address, client_certificate=own, tls_ca=tmp_path / "s.pem")
        robot.refuses(FetchProblem.REFUSED, address, tls_ca=tmp_path / "s.pem")
        error = robot.refuses(FetchProblem.UNREACHABLE, address, client_certificate=own)
        assert "certificate" in error.why
        missing = own._replace(key=tmp_path / "none")
        robot.refuses(FetchProblem.UNREACHABLE, address, client_certificate=missing)


def test_a_wrong_clock_and_the_certificate_of_the_server() -> None:
    """Only for a date that is wrong, the clock may be the cause."""
    for code, clock_is_named in ((9, True), (10, True), (20, False)):
        cause = ssl.SSLCertVerificationError()
        cause.verify_code, cause.verify_message = code, "certificate is not valid"
        error = exceptions.DownloadError("its certificate is not valid")
        error.__cause__ = cause
        found = str(_fetch_error(error, "https://home/pub", datetime(2027, 1, 1, tzinfo=UTC)))
        assert ("The clock here shows 2027-01-01" in found) == clock_is_named, found
        assert ("Set the clock of this robot" in found) == clock_is_named, found


# ── on the robot ───────────────────────────────────────────────────────────────────────────


def test_links_in_a_folder_are_not_followed(publisher: Home, tmp_path: Path) -> None:
    file = publisher.pub / "metadata/timestamp.json"
    file.rename(tmp_path / "elsewhere")
    file.symlink_to(tmp_path / "elsewhere")
    publisher.robot().refuses(FetchProblem.UNREACHABLE)
    file.unlink()
    (tmp_path / "elsewhere").rename(file)
    publisher.robot().gets()


def test_addresses_and_names_that_are_none(publisher: Home) -> None:
    robot = publisher.robot()
    for address in (
        "ftp://host/x",
        "http://",
        "http://a:b@host",
        "http://host/?x",
        "http://h:99999",
    ):
        with pytest.raises(UsageError):
            robot.fetch(address)
    robot.name = "../r1"
    with pytest.raises(UsageError):
        robot.fetch()


def test_what_cannot_be_kept(publisher: Home, monkeypatch: pytest.MonkeyPatch) -> None:
    robot = publisher.robot()

    def full(*_words: object) -> str:
        raise OSError(28, "No space left on device", str(robot.state))

    with monkeypatch.context() as patched:
        patched.setattr("tuf.ngclient.Updater._persist_file", staticmethod(full))
        robot.refuses(FetchProblem.NOT_KEPT)
    robot.gets()


def test_trusted_metadata_that_was_damaged(publisher: Home) -> None:
    """As a machine leaves it that lost its power: it is fetched again."""
    robot = publisher.robot()
    release = robot.gets()
    for file in [*robot.state.rglob("*.json")]:
        if file.name != "root.json" or file.parent != robot.state:
            file.write_bytes(b"")
    (robot.state / "release.tar.gz").write_bytes(b"half")
    assert robot.gets() == release


def test_pinning(publisher: Home) -> None:
    robot = publisher.robot()
    root = (publisher.pub / "metadata/1.root.json").read_bytes()
    snapshot = (publisher.pub / "metadata/1.snapshot.json").read_bytes()
    for wrong in (b"", snapshot, root.replace(b'"threshold":1', b'"threshold":2', 1)):
        with pytest.raises(FetchError) as refused:
            pin_root(robot.state, wrong, now=publisher.now)
        assert refused.value.problem is FetchProblem.NOT_SIGNED
    with pytest.raises(FetchError) as refused:
        pin_root(robot.state, root, now=publisher.now + 366 * DAY)
    assert refused.value.problem is FetchProblem.EXPIRED
    robot.gets()  # what was pinned before is still there
    (robot.state / "root.json").unlink()
    robot.refuses(FetchProblem.NOT_SIGNED)


def test_without_tuf(publisher: Home, monkeypatch: pytest.MonkeyPatch) -> None:
    robot = publisher.robot()
    monkeypatch.setitem(sys.modules, "tuf.ngclient", None)
    with pytest.raises(UnavailableError):
        robot.fetch()
