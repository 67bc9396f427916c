"""A stranger without any right, whose certificate has an empty subject, against Fast DDS."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import pytest

from tests.integration.fastdds import build, run_isolated_program
from tests.integration.trust.trusts import (
    IDENTITY_FILE,
    ISSUER,
    LEAF,
    SIGNING_CA,
    TOPIC,
    Trust,
    own,
)
from tests.support.children import run
from tests.support.raw_pki import name

pytestmark = pytest.mark.dds

HERE = Path(__file__).parent
ABORTED, ENDED = 134, 0


def stranger(subject: str, key: str, now: datetime) -> Trust:
    """What somebody makes with CAs of their own; its grant is for the subject that it feigns.

    It also trusts the CA of the node: else it refuses a handshake that the node begins, and no
    certificate is sent.  ``key`` is that of its identity CA.
    """
    made = own()
    made.rekey(ISSUER, key)
    made.rekey(SIGNING_CA, "p256 23")
    made.rename(ISSUER, name("CN=stranger"))
    made.rename(LEAF, name(subject) if subject else ())
    made.grants = ["CN=/t"]
    made.files[IDENTITY_FILE].append(own().contents(now)[IDENTITY_FILE])
    return made


def asking(enclave: Path, peer: Path, milliseconds: int) -> str:
    """The line by which ``fastdds_oracle`` has an enclave wait so long for a peer."""
    question = f"publish\x1f{TOPIC}"
    return f"{enclave}\t{enclave}\t0\tUTC\t{peer}\t{peer}\t{milliseconds}\t{question}\n"


@pytest.mark.parametrize(("subject", "ends"), [("", ABORTED), ("CN=/t", ENDED)])
def test_a_stranger_with_an_empty_subject_crashes_fast_dds(
    subject: str, ends: int, tmp_path: Path
) -> None:
    """It ends at the certificate before it verifies it; twin: with a subject, it refuses it.

    Nothing that sros writes prevents that: whoever reaches the port of the node can send it.
    """
    program, now = build("fastdds_oracle.cpp", tmp_path), datetime.now(UTC).replace(microsecond=0)
    feign = tmp_path / "nameless.so"
    run(["g++", "-x", "c", "-shared", "-fPIC", HERE / "nameless.c", "-o", feign, "-ldl"])
    folders = {}
    far, near = stranger("CN=/t", "p256 22", now), stranger(subject, "p256 24", now)
    for who, made in (("node", own()), ("far", far), ("stranger", near)):
        made.write(tmp_path / who, tmp_path / f"{who}'s peer", now)
        folders[who] = tmp_path / who
    # Both wait for somebody whom they refuse, so that they stay for a handshake with each other.
    (tmp_path / "node.txt").write_text(asking(folders["node"], folders["far"], 12_000))
    (tmp_path / "stranger.txt").write_text(asking(folders["stranger"], folders["far"], 8_000))
    both = tmp_path / "both"
    both.write_text(f"""#!/bin/sh
cd '{tmp_path}'
'{program}' < node.txt > node.out 2> node.err & node=$!
sleep 2
LD_PRELOAD='{feign}' '{program}' < stranger.txt > stranger.out &
wait $node
ended=$?
wait
exit $ended
""")
    both.chmod(0o755)
    done = run_isolated_program(both, status=None)
    assert (tmp_path / "stranger.out").read_text().split() == ["joined", "unmatched"]
    why = (tmp_path / "node.err").read_text()
    assert done.returncode == ends, why
    assert ("std::length_error" in why) is (subject == "")
    said = (tmp_path / "node.out").read_text().split()
    assert said == ([] if subject == "" else ["joined", "unmatched"])
