"""Issuing: validity that the CA's expiry shortens is reported, large permissions are shortened."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from sros_tool.dds.permissions import MAX_SIGNED_BYTES
from sros_tool.errors import Note
from sros_tool.keystore.delivery.signing import sign_request
from sros_tool.keystore.lifecycle.create import create_enclaves, create_keystore
from sros_tool.keystore.lifecycle.rotate import rotate_ca
from sros_tool.keystore.template import load_template
from tests.support.harness import create_request, policy_text, publish, sros, topics_of
from tests.support.long_form import ONLY_LONG, sometimes

NOW = datetime(2026, 6, 1, tzinfo=UTC)
LATE = NOW + timedelta(days=1800)  # CAs of the production template are valid for 1825 days


@pytest.fixture
def root(tmp_path: Path) -> Path:
    create_keystore(tmp_path / "ks", template=load_template("production"), now=NOW)
    create_enclaves(tmp_path / "ks", ["/a"], now=NOW)
    return tmp_path / "ks"


def early(notes: tuple[Note, ...]) -> list[str]:
    return [each.text for each in notes if each.id == "keystore.ends-with-ca"]


def test_an_answer_near_the_expiry_of_the_ca_gets_a_note(root: Path, tmp_path: Path) -> None:
    made = create_request(tmp_path / "robot", "/r")
    data = made.file.read_bytes()
    assert len(early(sign_request(root, data, now=LATE).notes)) == 2
    assert not early(sign_request(root, data, now=NOW, renew=True).notes)


@pytest.mark.parametrize(("days", "said"), [(90, 2), (300, 1), (2000, 0)])
def test_reissuing_with_a_short_lived_ca_gives_a_note(days: int, said: int, root: Path) -> None:
    """Certificates are valid for 365 days, permissions for 180."""
    done = rotate_ca(root, finish=True, validity=timedelta(days=days), now=NOW)
    assert len(early(done.notes)) == said


def test_a_validity_shortened_by_less_than_one_percent_gets_no_note(tmp_path: Path) -> None:
    """In the development template, CAs, certificates and permissions are valid for ten years."""
    root = tmp_path / "ks"
    create_keystore(root, template=load_template("development"), now=NOW)
    for days, said in ((0, 0), (30, 0), (60, 2)):
        notes = create_enclaves(root, [f"/e{days}"], now=NOW + timedelta(days=days)).notes
        assert len(early(notes)) == said


# ── large permissions ──────────────────────────────────────────────────────────────────────

NAMES = tuple(f"/sensors/{'very_' * 3}long_{number}" for number in range(1000))


@pytest.mark.parametrize(
    ("names", "listed", "fits"),
    [
        (("/sensors/a", "/sensors/*"), 2, True),
        pytest.param((*NAMES, "/sensors/*"), 1, True, marks=ONLY_LONG),
        (NAMES, 1000, True),  # with indentation it would be too large
        pytest.param(
            (*NAMES, *(f"{each}_more" for each in NAMES)), 2000, False, marks=sometimes("large")
        ),
    ],
)
def test_large_permissions_are_as_small_as_they_can_be(
    names: tuple[str, ...], listed: int, fits: bool, tmp_path: Path
) -> None:
    keystore, policy = tmp_path / "ks", tmp_path / "policy.xml"
    policy.write_text(policy_text({"/a": publish(*names)}))
    sros("create_keystore", keystore).ok()
    sros("create_enclave", keystore, "/a").ok()
    done = sros("create_permission", keystore, "/a", policy).ok()
    signed = keystore / "enclaves" / "a" / "permissions.p7s"
    assert (signed.stat().st_size < MAX_SIGNED_BYTES) is fits
    assert ("sros minimize_policy" in done.err) is not fits
    topics = {topic for topic in topics_of(signed.parent) if "/sensors/" in topic}
    assert len(topics) == listed
    # The keystore has what the policy says, also where it lists less.
    sros("diff_policy", policy, keystore).ok()
    stale = ("check", keystore, "--policy", policy, "--include", "enclave.stale-permissions")
    sros(*stale).ok()
    other = tmp_path / "other.xml"
    other.write_text(policy_text({"/a": publish(*names[1:], "/elsewhere")}))
    assert sros("diff_policy", other, keystore).status == 1
    stale = ("check", keystore, "--policy", other, "--include", "enclave.stale-permissions")
    assert sros(*stale).status == 1
