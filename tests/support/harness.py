"""What the tests of keystores and of the program share: running it, and looking at what it left."""

from __future__ import annotations

import io
import os
import signal
import stat
import sys
from collections.abc import Mapping
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

from cryptography import x509
from cryptography.hazmat.primitives import serialization

from sros_tool.cli import main
from sros_tool.dds.permissions import parse_permissions
from sros_tool.keystore.layout import REQUIRED_FILES
from sros_tool.pki import smime

STAGES = (".sros-transaction", ".sros-")


@dataclass(frozen=True)
class Ended:
    """How a run of the program ended, and what it said."""

    status: int
    out: str
    err: str

    def ok(self) -> Ended:
        """Itself, if the program succeeded."""
        assert self.status == 0, self
        return self


def sros(
    *arguments: object, env: Mapping[str, str | None] | None = None, cwd: Path | None = None
) -> Ended:
    """Run the program in this process; a value None in ``env`` unsets the variable."""
    words = [str(argument) for argument in arguments]
    before = dict(os.environ), Path.cwd(), sys.argv, signal.getsignal(signal.SIGTERM), os.execve
    out = io.TextIOWrapper(io.BytesIO(), "utf-8", write_through=True)
    err = io.TextIOWrapper(io.BytesIO(), "utf-8", "backslashreplace", write_through=True)
    try:
        for name, value in (env or {}).items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
        if cwd:
            os.chdir(cwd)
        sys.argv = ["sros", *words]
        os.execve = _refuse_to_execute  # type: ignore[assignment]
        with redirect_stdout(out), redirect_stderr(err):
            try:
                main(words)
            except SystemExit as end:
                status = end.code if isinstance(end.code, int) else 1
    finally:
        os.environ.clear()
        os.environ.update(before[0])
        os.chdir(before[1])
        sys.argv = before[2]
        signal.signal(signal.SIGTERM, before[3])
        os.execve = before[4]
    said = [stream.buffer.getvalue().decode(errors="replace") for stream in (out, err)]
    return Ended(status, *said)


def _refuse_to_execute(*_: object) -> NoReturn:
    # It would end the tests, and with the status of the command.
    raise AssertionError("a command was executed")


def snapshot(folder: Path) -> dict[str, tuple[int, bytes]]:
    """Everything below a folder: kind and mode, and the bytes or the target of a link."""
    found = {}
    for parent, folders, files in os.walk(folder):
        for name in (*folders, *files):
            path = Path(parent, name)
            mode = path.lstat().st_mode
            if stat.S_ISLNK(mode):
                content = os.fsencode(os.readlink(path))
            else:
                content = path.read_bytes() if stat.S_ISREG(mode) else b""
            found[os.path.relpath(path, folder)] = (mode, content)
    return found


def remains(folder: Path) -> list[str]:
    """Stages of transactions that were left below a folder, or beside a keystore in it."""
    return [path for path in snapshot(folder) if ".sros-" in path]


def topics_of(enclave: Path) -> frozenset[str]:
    """The DDS topics of an enclave's signed permissions, as DDS would load them."""
    signed = smime.parse((enclave / "permissions.p7s").read_bytes())
    signed.verify(certificate(enclave / "permissions_ca.cert.pem"))
    return frozenset(
        topic
        for grant in parse_permissions(signed.document).grants
        for rule in grant.rules
        for criteria in (*rule.publish, *rule.subscribe)
        for topic in criteria.topics
    )


def certificate(path: Path) -> x509.Certificate:
    return x509.load_pem_x509_certificate(path.read_bytes())


def check_whole(keystore: Path) -> None:
    """Assert what must hold of a keystore at any moment, before anything tidies it up."""
    for parent, folders, files in os.walk(keystore):
        folders[:] = [name for name in folders if name != STAGES[0]]
        for name in files:
            path = Path(parent, name)
            assert not path.exists() or path.stat().st_size, f"{path} is empty"
        if all(Path(parent, name).exists() for name in REQUIRED_FILES):
            check_enclave_whole(Path(parent))
    for path in keystore.glob("private/*"):
        name = path.name.replace(".key.", ".cert.")
        check_pair(path, keystore / "public" / name)


def check_enclave_whole(enclave: Path) -> None:
    """Assert that every file of an enclave is there and fits the others."""
    check_pair(enclave / "key.pem", enclave / "cert.pem")
    authority = certificate(enclave / "identity_ca.cert.pem")
    certificate(enclave / "cert.pem").verify_directly_issued_by(authority)
    for name in ("permissions", "governance"):
        signed = smime.parse((enclave / f"{name}.p7s").read_bytes())
        signed.verify(certificate(enclave / "permissions_ca.cert.pem"))
        beside = enclave / f"{name}.xml"
        if beside.exists():
            assert beside.read_bytes() == signed.document.replace(b"\r\n", b"\n"), beside


def check_pair(key: Path, cert: Path) -> None:
    """Assert that a private key is its owner's alone, and that of a certificate."""
    assert key.stat().st_mode & 0o777 == 0o600, key
    loaded = serialization.load_pem_private_key(key.read_bytes(), None)
    assert loaded.public_key() == certificate(cert).public_key(), key


def policy_text(enclaves: Mapping[str, str]) -> str:
    """A policy in which each enclave has one node, and the groups that are given as XML."""
    bodies = "".join(
        f'<enclave path="{path}"><profiles><profile ns="/" node="n">{groups}</profile></profiles>'
        "</enclave>"
        for path, groups in enclaves.items()
    )
    return f'<policy version="0.2.0"><enclaves>{bodies}</enclaves></policy>'


def publish(*names: str) -> str:
    """A group of topics to publish, as XML."""
    topics = "".join(f"<topic>{name}</topic>" for name in names)
    return f'<topics publish="ALLOW">{topics}</topics>'


def with_includes(policy: str) -> str:
    """A policy's text in which the prefix xi is that of includes."""
    return policy.replace("<policy", '<policy xmlns:xi="http://www.w3.org/2001/XInclude"', 1)
