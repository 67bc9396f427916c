"""Which back ends of the demo enforce DDS Security on this machine."""

from __future__ import annotations

from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from sros_tool.dds.domains import DomainSet
from sros_tool.demo.backend import CYCLONE, RCLPY, Backend, choose_backend
from sros_tool.demo.keystores import KeystoreSpec, create_keystores
from sros_tool.demo.scenarios.communication import ISOLATION
from sros_tool.demo.scenarios.model import DEFAULT_TOPIC
from sros_tool.errors import UnavailableError
from sros_tool.keystore.template import load_template

BACKENDS = (CYCLONE, RCLPY)
DOMAIN = 189


@cache
def _found(name: str) -> Backend | str:
    with TemporaryDirectory() as folder:
        domains, template = DomainSet.of((DOMAIN, DOMAIN)), load_template("production")
        spec = KeystoreSpec(DEFAULT_TOPIC, domains, template, datetime.now(UTC))
        keystores = create_keystores(Path(folder), ISOLATION, spec)
        try:
            return choose_backend(name, keystores.probe(DEFAULT_TOPIC, DOMAIN))
        except UnavailableError as error:
            return str(error)


def enforces(name: str) -> bool:
    """Whether the back end of that name enforces security, found by trying."""
    return not isinstance(_found(name), str)


def enforcing_backend(name: str) -> Backend:
    """The back end of that name, found by trying; skips the test where it enforces nothing."""
    found = _found(name)
    if isinstance(found, str):
        pytest.skip(found)
    return found
