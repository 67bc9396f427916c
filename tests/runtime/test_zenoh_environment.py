"""The variables of rmw_zenoh_cpp, and what is said about those that they replace."""

from __future__ import annotations

from pathlib import Path

import pytest

from sros_tool.errors import KeystoreError
from sros_tool.runtime.environment import (
    NO_CONFIGURATION,
    OVERRIDE,
    ROUTER_URI,
    SESSION_URI,
    override_pairs,
    replaced_notes,
    zenoh_environment,
)

FILES = (Path("/k/ca.pem"), Path("/k/cert.pem"), Path("/k/key.pem"))


def test_the_paths_of_a_session() -> None:
    found = zenoh_environment({SESSION_URI: "/k/session.json5"}, *FILES)
    assert (found[SESSION_URI], found[ROUTER_URI]) == ("/k/session.json5", NO_CONFIGURATION)
    assert dict(override_pairs(found[OVERRIDE])) == {
        "transport/link/tls/root_ca_certificate": '"/k/ca.pem"',
        "transport/link/tls/connect_private_key": '"/k/key.pem"',
        "transport/link/tls/connect_certificate": '"/k/cert.pem"',
        "transport/link/tls/listen_private_key": '"/k/key.pem"',
        "transport/link/tls/listen_certificate": '"/k/cert.pem"',
    }


def test_no_file_can_be_where_a_refused_configuration_is_looked_for() -> None:
    with pytest.raises(NotADirectoryError):
        Path(NO_CONFIGURATION).write_text("{}")


@pytest.mark.parametrize("name", ["a;b", "a?b", "a\udcff"])
def test_a_path_that_zenoh_would_read_as_another(name: str) -> None:
    with pytest.raises(KeystoreError, match="cannot be given to Zenoh"):
        zenoh_environment({}, Path("/", name), *FILES[1:])


def test_how_the_override_is_divided() -> None:
    text = 'mode="peer";;=1;a;b=;c=d=e;f=1\n2; g/h =[1]'
    assert list(override_pairs(text)) == [
        ("mode", '"peer"'), ("c", "d=e"), ("f", "1"), (" g/h ", "[1]"),
    ]  # fmt: skip


def said(**environment: str) -> list[str]:
    found = zenoh_environment({SESSION_URI: "/k/session.json5"}, *FILES)
    return [each.id for each in replaced_notes({**environment, "MINE": "1"}, found)]


def test_what_is_replaced_is_said_and_louder_where_it_opened() -> None:
    assert said() == []
    assert said(**zenoh_environment({SESSION_URI: "/k/session.json5"}, *FILES)) == []
    assert said(ZENOH_SESSION_CONFIG_URI="", ZENOH_CONFIG_OVERRIDE="") == []
    assert said(ZENOH_SESSION_CONFIG_URI="/x") == ["zenoh.replaced"]
    assert said(ZENOH_CONFIG_OVERRIDE='mode="peer"') == ["zenoh.replaced"]
    for key in (
        "access_control",
        "access_control/enabled",
        "/access_control/enabled",
        " access_control ",
    ):
        opening = f'mode="peer";{key}=false'
        assert said(ZENOH_CONFIG_OVERRIDE=opening) == [
            "zenoh.replaced",
            "zenoh.access-control-override",
        ]


def test_a_long_override_is_said_in_a_line() -> None:
    before = {OVERRIDE: ";".join(f"{'k' * 1000}{number}=1" for number in range(100_000))}
    (note,) = replaced_notes(before, {OVERRIDE: "x"})
    assert len(note.text) < 600
    assert "and 99995 more" in note.text
