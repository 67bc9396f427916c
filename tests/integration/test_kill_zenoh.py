"""Death at every step of a verb: DDS and Zenoh never have different rights, not for a moment."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from sros_tool.keystore.lifecycle.create import create_permission
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.pki import smime
from sros_tool.policy.document import read_policy
from tests.integration.test_kill_life import DIED, copy, in_child
from tests.support.harness import policy_text, publish, remains, sros
from tests.support.long_form import few_steps

LATER = datetime.now(UTC) + timedelta(hours=1)


def see(root: Path) -> bool:
    """Whether /a may publish /z; the same for DDS, its session and the router, all of it signed."""
    authority = OpenedKeystore(root).ca_certificate("permissions")
    said = set()
    for folder, name in (("a", "permissions"), ("a", "session"), ("router", "router")):
        signed = smime.parse((root / f"enclaves/{folder}/{name}.p7s").read_bytes())
        signed.verify(authority)
        said.add(b"/z" in signed.document)
        if name != "permissions":
            document = (root / f"enclaves/{folder}/{name}.json5").read_bytes()
            assert document == signed.text
    assert len(said) == 1, "DDS and Zenoh differ"
    return said.pop()


def test_death_at_every_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sros_tool.folders.flush_file_system", lambda _: None)
    (tmp_path / "first.xml").write_text(policy_text({"/a": publish("/x")}))
    (tmp_path / "more.xml").write_text(policy_text({"/a": publish("/x", "/z")}))
    policy = read_policy(tmp_path / "more.xml")
    life, work = tmp_path / "life" / "ks", tmp_path / "work" / "ks"
    for each in (life, work):
        each.parent.mkdir()
    sros("create_keystore", life, "--template", "production").ok()
    sros("generate_artifacts", "-k", life, "-p", tmp_path / "first.xml").ok()
    sros("zenoh", life).ok()
    assert see(life) is False

    def change() -> None:
        create_permission(work, ["/a"], policy, now=LATER)

    copy(life, work)
    status, steps = in_child(change)
    assert (status, see(work)) == (0, True)
    outcomes = set()
    for step in few_steps(range(1, steps + 1)):
        copy(life, work)
        assert in_child(change, step) == (DIED, 0), step
        outcomes.add(see(work))
        change()
        assert see(work)
        assert not remains(work.parent)
    assert outcomes == {True, False}
    assert steps > 30
