"""A stranger without any right, whose certificate has an empty subject, against Fast DDS 2.9.1."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import pytest

from sros_tool.dds.decision.vendors import Vendor
from tests.integration.fastdds import build, fastdds_vendor, isolated
from tests.integration.trust.trusts import ISSUER, LEAF, SIGNING_CA, TOPIC, Trust, own
from tests.support.children import run
from tests.support.raw_pki import name

pytestmark = pytest.mark.dds

HERE = Path(__file__).parent
ABORTED, ENDED = 134, 0


def stranger(subject: str) -> Trust:
    """What somebody makes with CAs of their own; its grant is for the subject that it feigns."""
    made = own()
    made.rekey(ISSUER, "p256 22")
    made.rekey(SIGNING_CA, "p256 23")
    made.rename(ISSUER, name("CN=stranger"))
    made.rename(LEAF, name(subject) if subject else ())
    made.grants = ["CN=/t"]
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
    if fastdds_vendor() is not Vendor.FAST_2_9:
        pytest.skip("only Fast DDS 2.9.1 was seen to end")
    program, now = build("fastdds_oracle.cpp", tmp_path), datetime.now(UTC).replace(microsecond=0)
    feign = tmp_path / "nameless.so"
    run(["g++", "-x", "c", "-shared", "-fPIC", HERE / "nameless.c", "-o", feign, "-ldl"])
    folders = {}
    for who, made in (("node", own()), ("far", stranger("CN=/t")), ("stranger", stranger(subject))):
        made.write(tmp_path / who, tmp_path / f"{who}'s peer", now)
        folders[who] = tmp_path / who
    # The node waits for somebody whom it refuses; meanwhile the stranger starts.
    (tmp_path / "node.txt").write_text(asking(folders["node"], folders["far"], 12_000))
    (tmp_path / "stranger.txt").write_text(asking(folders["stranger"], folders["stranger"], 8_000))
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
    done = run(isolated(both), status=None)
    assert (tmp_path / "stranger.out").read_text().split() == ["joined", "matched"]
    assert done.returncode == ends, (tmp_path / "node.err").read_text()
    said = (tmp_path / "node.out").read_text().split()
    assert said == ([] if subject == "" else ["joined", "unmatched"])
