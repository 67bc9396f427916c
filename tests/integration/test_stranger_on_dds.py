"""A stranger without any right, whose certificate has an empty subject, against Fast DDS."""

from __future__ import annotations

import os
import signal
import subprocess
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from tests.integration.fastdds import build
from tests.integration.trust.trusts import IDENTITY_FILE, ISSUER, LEAF, SIGNING_CA, Trust, own
from tests.support.children import apart, run, wait_for
from tests.support.raw_pki import name

pytestmark = pytest.mark.dds

HERE = Path(__file__).parent
ABORTED, ENDED = -signal.SIGABRT, 0
REFUSED = "Error verifying certificate"


def stranger(subject: str, now: datetime) -> Trust:
    """What somebody makes with CAs of their own; its grant is for the subject that it feigns.

    It also trusts the CA of the node: else it refuses a handshake that the node begins, and no
    certificate is sent.
    """
    made = own()
    made.rekey(ISSUER, "p256 24")
    made.rekey(SIGNING_CA, "p256 23")
    made.rename(ISSUER, name("CN=stranger"))
    made.rename(LEAF, name(subject) if subject else ())
    made.grants = ["CN=/t"]
    made.files[IDENTITY_FILE].append(own().contents(now)[IDENTITY_FILE])
    return made


def meet(program: Path, feign: Path, folder: Path) -> tuple[int, str]:
    """Let the node and the stranger of a folder meet; return how the node ends, and what it says.

    Both stay until the node refuses the stranger, or crashes.
    """
    said = folder / "said"

    def begin(who: str, **more: Any) -> subprocess.Popen[bytes]:
        words = [str(program), "0", str(folder / who)]
        return subprocess.Popen(words, stdin=subprocess.PIPE, stderr=subprocess.STDOUT, **more)

    with said.open("w") as out, begin("node", stdout=out) as node:
        wait_for(lambda: "joined\n" in said.read_text(), "a node that joined")
        feigning = {**os.environ, "LD_PRELOAD": str(feign)}
        with begin("stranger", env=feigning, stdout=subprocess.DEVNULL) as other:
            wait_for(lambda: node.poll() is not None or REFUSED in said.read_text(), "a handshake")
    assert other.returncode == 0, "the stranger crashed itself"
    return node.returncode, said.read_text()


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
    for who, made in (("node", own()), ("stranger", stranger(subject, now))):
        made.write(tmp_path / who, tmp_path / f"{who}'s peer", now)
    status, said = apart(partial(meet, program, feign, tmp_path))
    assert status == ends, said
    assert ("std::length_error" in said, REFUSED in said) == (subject == "", subject != "")
