"""The Cyclone binding over the real library: it speaks, and what it may not do is refused."""

from __future__ import annotations

import io
import os
import subprocess
import sys
import textwrap
from collections.abc import Callable
from contextlib import redirect_stdout
from datetime import UTC, datetime
from pathlib import Path

import pytest

from sros_tool.dds.domains import DomainSet
from sros_tool.demo.keystores import KeystoreSet, KeystoreSpec, create_keystores
from sros_tool.demo.scenarios.communication import ISOLATION, LISTENER, TALKER, TALKER_DENIED
from sros_tool.demo.scenarios.model import OWN, UNSECURED, Identity
from sros_tool.errors import UnavailableError
from sros_tool.keystore.template import load_template
from sros_tool.runtime import cyclone
from sros_tool.runtime.cyclone import load_cyclone
from tests.support.children import apart

pytestmark = pytest.mark.dds

DOMAIN = 110

PREAMBLE = """
import os, time
from pathlib import Path
from sros_tool.runtime.cyclone import DdsError, DiscoveredEndpoint, Participant
from sros_tool.runtime.cyclone import SecurityRefusedError
from sros_tool.runtime.variables import choose_enclave, domain_of
def join():
    return Participant(domain_of(os.environ), choose_enclave(os.environ).enclave)
def attempt(make, topic):
    try:
        make(topic)
    except SecurityRefusedError:
        return "refused"
    except DdsError as error:
        return f"failed: {error}"
    return "made"
"""


@pytest.fixture(scope="module", autouse=True)
def _needs_cyclone() -> None:
    try:
        load_cyclone.cache_clear()
        library = load_cyclone()
    except UnavailableError as error:
        pytest.skip(str(error))
    if library.plugins is None:
        pytest.skip("Cyclone DDS is here without its security plugins")


@pytest.fixture(scope="module")
def keystores(tmp_path_factory: pytest.TempPathFactory) -> KeystoreSet:
    folder = tmp_path_factory.mktemp("keystores")
    domains, template = DomainSet.of((DOMAIN, DOMAIN)), load_template("production")
    spec = KeystoreSpec("/chatter", domains, template, datetime.now(UTC))
    return create_keystores(folder, ISOLATION, spec)


@pytest.fixture
def child(keystores: KeystoreSet) -> Callable[[Identity, str], list[str]]:
    """Runs code in a process of its own with an identity; returns the lines that it prints."""

    def run(identity: Identity, code: str, domain: int = DOMAIN) -> list[str]:
        def work() -> list[str]:
            os.environ.clear()
            os.environ.update(keystores.environment(identity, domain))
            said = io.StringIO()
            with redirect_stdout(said):
                exec(PREAMBLE + textwrap.dedent(code), {})
            return said.getvalue().splitlines()

        return apart(work)

    return run


ATTEMPTS = """
p = join()
for topic in ("rt/chatter", "rt/other", "rq/chatterRequest", "ros_discovery_info"):
    print("writer", topic, attempt(p.writer, topic))
    print("reader", topic, attempt(p.reader, topic))
"""


@pytest.mark.parametrize(
    ("identity", "made"),
    [
        (TALKER, {"writer rt/chatter"}),
        (LISTENER, {"reader rt/chatter"}),
        (TALKER_DENIED, set()),
    ],
)
def test_permissions_decide(
    child: Callable[[Identity, str], list[str]], identity: Identity, made: set[str]
) -> None:
    answers = dict(line.rsplit(" ", 1) for line in child(identity, ATTEMPTS))
    graph = {"writer ros_discovery_info", "reader ros_discovery_info"}
    assert {question for question, answer in answers.items() if answer == "made"} == made | graph
    assert {answer for answer in answers.values() if answer != "made"} == {"refused"}


def test_without_security_every_name_can_be_used(
    child: Callable[[Identity, str], list[str]],
) -> None:
    lines = child(UNSECURED, ATTEMPTS)
    assert len(lines) == 8
    assert all(line.endswith(" made") for line in lines)


def test_a_failure_that_is_no_refusal(child: Callable[[Identity, str], list[str]]) -> None:
    (line,) = child(UNSECURED, "print(attempt(join().writer, 'rt/not a name'))")
    assert line.startswith("failed")


def test_what_is_written_is_read_and_seen(child: Callable[[Identity, str], list[str]]) -> None:
    lines = child(
        UNSECURED,
        """
        with join() as p:
            reader, writer = p.reader("rt/chatter"), p.writer("rt/chatter")
            writer.write("Grüße")
            writer.write("")
            heard = []
            while len(heard) < 2:
                heard += reader.take()
            print(heard)
            print(p.publications() == (
                DiscoveredEndpoint("rt/chatter", "std_msgs::msg::dds_::String_"),))
            print([*p.process_ids().values()] == [os.getpid()])
        """,
    )
    assert lines == ["['Grüße', '']", "True", "True"]


@pytest.mark.parametrize("broken", ["permissions.p7s", "governance.p7s", "cert.pem", "key.pem"])
def test_a_broken_enclave_is_refused(
    child: Callable[[Identity, str], list[str]],
    keystores: KeystoreSet,
    tmp_path: Path,
    broken: str,
) -> None:
    enclave = keystores.keystores[OWN] / "enclaves/talker_listener/talker"
    code = "print(attempt(lambda _: Participant(110, Path({!r})), ''))"
    copy = tmp_path / "enclave"
    copy.mkdir()
    for name in (
        *("cert.pem", "key.pem", "permissions.p7s", "governance.p7s"),
        *("identity_ca.cert.pem", "permissions_ca.cert.pem"),
    ):
        (copy / name).write_bytes((enclave / name).read_bytes())
    assert child(UNSECURED, code.format(str(copy))) == ["made"]
    (copy / broken).write_bytes((copy / broken).read_bytes().replace(b"A", b"B"))
    assert child(UNSECURED, code.format(str(copy))) == ["refused"]
    (copy / broken).unlink()
    (line,) = child(UNSECURED, code.format(str(copy)))
    assert line.startswith("failed")
    assert broken in line


def test_a_domain_that_the_keystore_is_not_for(
    child: Callable[..., list[str]],
) -> None:
    code = "print(attempt(lambda _: join(), ''))"
    assert child(TALKER, code) == ["made"]
    assert child(TALKER, code, DOMAIN + 1) == ["refused"]


def test_libraries_are_loaded_after_those_that_they_need() -> None:
    """Otherwise the system's copy is loaded, as that of RouDi where cyclonedds-dev is installed."""
    order = ("hoofs", "posh", "posh_roudi", "posh_config", "posh_gateway", "binding_c")
    files = [Path(f"libiceoryx_{each}.so.2") for each in order]
    assert sorted(set(files), key=cyclone._load_order) == files


def test_unpacked_packages_are_used_alone(tmp_path: Path) -> None:
    """A folder as `dpkg -x` leaves it: nothing of the system's copy is loaded beside it."""
    library = load_cyclone()
    folder = tmp_path / "usr/lib/some-arch"
    folder.mkdir(parents=True)
    assert library.plugins is not None
    for file in (library.path, *library.path.parent.glob("libiceoryx_*.so.?")):
        (folder / file.name).write_bytes(file.read_bytes())
    plugins = folder / library.plugins.name if library.plugins != library.path.parent else folder
    plugins.mkdir(exist_ok=True)
    for file in library.plugins.glob("libdds_security_*.so"):
        (plugins / file.name).write_bytes(file.read_bytes())
    code = (
        "from sros_tool.runtime.cyclone import load_cyclone, loaded_libraries\n"
        "library = load_cyclone()\n"
        "print(library.plugins)\n"
        "print(*loaded_libraries('libddsc'), *loaded_libraries('libiceoryx'), sep='\\n')\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={
            "SROS_CYCLONEDDS_DIR": str(tmp_path),
            "PYTHONPATH": str(Path(__file__).parents[2]),
        },
        capture_output=True,
        text=True,
        check=True,
    )
    lines = done.stdout.splitlines()
    assert lines[0] == str(plugins)
    assert lines[1:]
    assert all(line.startswith(str(folder)) for line in lines[1:])
