"""A network of one's own, in a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from sros_tool.runtime.netns import try_isolation

CODE = """
import os, socket
from sros_tool.runtime.netns import enter_isolation
before = os.readlink("/proc/self/ns/net")
enter_isolation()
assert os.readlink("/proc/self/ns/net") != before
assert [name for _, name in socket.if_nameindex()] == ["lo"]
with socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM, socket.htons(0x0800)):
    pass
group = socket.inet_aton("239.255.0.1")
with (
    socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one,
    socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other,
):
    one.bind(("", 7400))
    one.settimeout(60)
    one.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, group + socket.inet_aton("0.0.0.0"))
    other.sendto(b"hello", ("239.255.0.1", 7400))
    assert one.recv(10) == b"hello"
if os.access("/proc/sys/net/ipv4/ip_local_port_range", os.W_OK):
    for _ in range(500):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_port:
            any_port.bind(("", 0))
            assert any_port.getsockname()[1] < 7400, "DDS needs this port"
print(os.getuid(), os.getgid())
"""


@pytest.fixture(autouse=True)
def _needs_isolation() -> None:
    isolation = try_isolation()
    if not isolation.isolated:
        pytest.skip(f"no network of its own here: {isolation.reason}")


def test_the_caller_of_a_trial_stays_where_it_is() -> None:
    before = os.readlink("/proc/self/ns/net")
    assert try_isolation().isolated
    assert os.readlink("/proc/self/ns/net") == before


@pytest.mark.parametrize("user", [None, 65534])
def test_loopback_multicast_and_packets(user: int | None) -> None:
    if user is not None and os.getuid() != 0:
        pytest.skip("only root can become somebody else")
    if user is not None and not _may_enter(user):
        pytest.skip("this Python or its user namespaces are not open to others")
    done = subprocess.run(
        [sys.executable, "-c", CODE],
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
        user=user,
        group=user,
        extra_groups=None if user is None else [],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == [str(user or os.getuid()), str(user or os.getgid())]


def _may_enter(user: int) -> bool:
    code = "from sros_tool.runtime.netns import try_isolation as t; print(t().isolated)"
    try:
        done = subprocess.run(
            [sys.executable, "-c", code],
            env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
            user=user,
            group=user,
            extra_groups=[],
            capture_output=True,
            text=True,
        )
    except OSError:
        return False
    return done.stdout.strip() == "True"
