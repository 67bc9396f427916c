"""What breaks a requirement is what the real stacks allow: Cyclone DDS, Fast DDS and Zenoh.

How many witnesses: $SROS_WITNESSES (12, in the long form 200).
"""

from __future__ import annotations

import json
import os
import random
import socket
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from sros_tool.checks.keystores.opened import Circumstances
from sros_tool.dds.decision.vendors import Vendor
from sros_tool.dds.domains import DomainSet
from sros_tool.dds.governance import render_governance
from sros_tool.dds.permissions import render_permissions
from sros_tool.errors import PolicyError
from sros_tool.keystore.template import DEFAULT_TEMPLATE, load_template
from sros_tool.policy.document import read_policy
from sros_tool.policy.model import Enclave, Policy
from sros_tool.proof.decide import Use, decide
from sros_tool.proof.requirements import Must
from sros_tool.proof.system import policy_system
from sros_tool.translate import governance_for, permissions_for
from sros_tool.translate_zenoh.rights import remote_rights
from sros_tool.validity import window
from sros_tool.zenoh.access import AccessControl
from sros_tool.zenoh.configuration import Configuration, Mode
from tests.integration.fastdds import fastdds_vendor
from tests.integration.vendor_oracle import (
    Case,
    Question,
    Workshop,
    ask_cyclone,
    ask_fastdds,
    cyclone_vendor,
    with_patience,
)
from tests.proof.test_against_brute_force import ENCLAVES, draw_policy, draw_requirement
from tests.support.children import LONG
from tests.support.harness import policy_text, sros

COUNT = int(os.environ.get("SROS_WITNESSES", "200" if LONG else "12"))
DOMAIN = 42
OPPOSITE = {True: "publish", False: "subscribe"}
ASK = {fastdds_vendor(): ask_fastdds, cyclone_vendor(): ask_cyclone}


def witnesses(world: str, domain: int = DOMAIN) -> Iterator[tuple[Policy, Use, bool]]:
    """Yield uses of witnesses in a world, each with its policy and whether it is allowed."""
    number = 0
    left = {True: COUNT // 6, False: COUNT - COUNT // 6}  # witnesses of `Must`, which is denied
    while any(left.values()):
        draw = random.Random(f"witness {number}")
        number += 1
        policy = draw_policy(draw)
        try:
            system = policy_system(
                policy, Circumstances(datetime.now(UTC), domain=domain, vendors=(world,))
            )
        except PolicyError:
            continue  # Zenoh cannot carry it out
        for requirement in (draw_requirement(draw) for _ in range(10)):
            witness = decide(requirement, system.worlds[0]).witness
            known = {each.path for each in policy.enclaves}
            denied = isinstance(requirement, Must)
            if witness and witness.uses[0].enclave in known and left[denied]:
                left[denied] -= 1
                yield from ((policy, use, not denied) for use in witness.uses)


@pytest.mark.dds
@pytest.mark.parametrize("vendor", ASK)
def test_a_vendor_of_dds_does_what_a_witness_says(vendor: Vendor, tmp_path: Path) -> None:
    domains = DomainSet.of((DOMAIN, DOMAIN))
    governance = render_governance(
        governance_for(load_template(DEFAULT_TEMPLATE).protection, domains)
    )
    now = datetime.now(UTC).replace(microsecond=0)
    drawn = list(witnesses(vendor.value))

    def case(enclave: Enclave, use: Use) -> Case:
        permissions = permissions_for(
            enclave,
            subject=f"CN={enclave.path}",
            validity=window(now - timedelta(days=1), timedelta(days=9)),
            domains=domains,
        )
        question = Question(OPPOSITE[use.writes], use.topic)
        xml = render_permissions(permissions)
        return Case(governance, xml, (question,), f"CN={use.enclave}", DOMAIN, peer=True)

    # Cyclone DDS takes the permissions of an enclave below for those of the enclave, too; what an
    # enclave must be able to do is asked of its own permissions.
    asked = [
        (place, enclave, use)
        for place, (policy, use, allowed) in enumerate(drawn)
        for enclave in policy.enclaves
        if enclave.path == use.enclave or (allowed and enclave.path.startswith(f"{use.enclave}/"))
    ]
    workshop = Workshop(tmp_path)
    replies = with_patience(
        lambda some, seconds: ASK[vendor](workshop, some, at_once=3, seconds=seconds),
        [case(enclave, use) for _, enclave, use in asked],
        lambda number, _: drawn[asked[number][0]][2],
    )
    matched = set()
    for (place, enclave, use), reply in zip(asked, replies, strict=True):
        assert reply.end == "joined" or enclave.path != use.enclave, (use, reply)
        if reply.answers == ("matched",):
            matched.add(place)
    wrong = [
        (use, allowed)
        for place, (_, use, allowed) in enumerate(drawn)
        if (place in matched) is not allowed
    ]
    assert wrong == []
    assert {allowed for _, _, allowed in drawn} == {True, False}


ALL = "".join(
    f'<{kind}s {right}="ALLOW"><{kind}>/*</{kind}></{kind}s>'
    for kind, rights in (("topic", ("publish", "subscribe")), ("service", ("request", "reply")))
    for right in rights
)


@pytest.mark.zenoh
def test_zenoh_does_what_a_witness_says(tmp_path: Path) -> None:
    pytest.importorskip("zenoh", reason="the wheel eclipse-zenoh is missing")
    (tmp_path / "all.xml").write_text(policy_text({"/probe": ALL, "/twin": ALL}))
    keystore = tmp_path / "ks"
    sros("create_keystore", keystore).ok()
    for enclave in ("/router", *ENCLAVES):
        sros("create_enclave", keystore, enclave).ok()
    sros("generate_artifacts", "-k", keystore, "-p", tmp_path / "all.xml").ok()
    with socket.socket() as free:  # where no network of its own is allowed
        free.bind(("127.0.0.1", 0))
        endpoint = f"localhost:{free.getsockname()[1]}"
    sros("zenoh", keystore, "--endpoint", endpoint, "--mode", "client").ok()
    others = read_policy(tmp_path / "all.xml").enclaves
    worlds: dict[str, Any] = {}
    for policy, use, allowed in witnesses("zenoh", domain=0):
        remotes = [remote_rights(each, 0) for each in (*policy.enclaves, *others)]
        written = Configuration(Mode.ROUTER, (), (), AccessControl(tuple(remotes)))
        control = json.loads(written.render())["access_control"]
        of = worlds.setdefault(json.dumps(control), {"access_control": control, "uses": []})
        of["uses"].append([use.enclave, use.writes, use.topic, allowed])
    from tests.integration.zenoh_witnesses import observe
    from tests.integration.zenoh_world import observed_apart

    observed = observed_apart(lambda: [observe(keystore, each) for each in worlds.values()])
    wrong = [
        use
        for of, happened in zip(worlds.values(), observed, strict=True)
        for use, found in zip(of["uses"], happened, strict=True)
        if found is not use[3]
    ]
    assert wrong == []
    assert {use[3] for of in worlds.values() for use in of["uses"]} == {True, False}
