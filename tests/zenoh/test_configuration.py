"""A configuration is JSON in which each rule has a line, and reads back as it was."""

from __future__ import annotations

import json

import pytest

from sros_tool.zenoh.access import AccessControl, AccessRule, Flow, Message, RemoteRights
from sros_tool.zenoh.configuration import Configuration, Mode, SettingsEdition, parse_rendered

PUT = (Message.PUT, Message.DELETE)
RIGHTS = RemoteRights(
    '/a"\\\n',
    (
        AccessRule(Flow.INGRESS, PUT, ("0/b/*/*", '0/"/**')),
        AccessRule(Flow.EGRESS, PUT, ("0/\u00e9",)),
    ),
)


@pytest.mark.parametrize("remotes", [(), (RIGHTS,), (RIGHTS, RemoteRights("/b", ()))])
@pytest.mark.parametrize("settings", SettingsEdition)
@pytest.mark.parametrize("mode", Mode)
def test_it_reads_back_as_it_was(
    mode: Mode, settings: SettingsEdition, remotes: tuple[RemoteRights, ...]
) -> None:
    written = Configuration(mode, ("tls/a:1",), ("tls/b:2",), AccessControl(remotes))
    data = written.render(settings)
    assert parse_rendered(data, "file") == written
    control = json.loads(data)["access_control"]
    assert (control["enabled"], control["default_permission"]) == (True, "deny")
    for rule in control["rules"]:
        assert sum(json.dumps(rule["id"]) in line for line in data.decode().splitlines()) == 2
