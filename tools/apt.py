"""Packages of Debian and Ubuntu: installed as root, or else only unpacked."""

from __future__ import annotations

import functools
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from tools import steps
from tools.steps import APT_LOG, output_of, root_prefix, say

_PATIENT = ["-o", "Acquire::Retries=2", "-o", "DPkg::Lock::Timeout=300"]

succeeds = functools.partial(steps.succeeds, log_name=APT_LOG)


def available() -> bool:
    """Return whether this system has apt and dpkg."""
    return all(shutil.which(tool) for tool in ("apt-get", "apt-cache", "dpkg", "dpkg-query"))


def install(pattern: str, lock: int | None = None) -> bool:
    """Install, as root, the package whose whole name matches ``pattern``; return the success.

    Updates the package lists first.  Fails without root, without such a package, or if apt fails;
    `APT_LOG` has the output of apt.
    """
    return install_all([pattern], lock) == []


def install_all(patterns: Sequence[str], lock: int | None = None) -> list[str]:
    """Install several packages together; return the patterns that could not be installed."""
    prefix = root_prefix()
    if prefix is None or not available():
        return list(patterns)
    apt_get = [*prefix, "env", "DEBIAN_FRONTEND=noninteractive", "apt-get", *_PATIENT]
    # Continue: one unreachable third-party source makes `update` fail for all.
    succeeds([*apt_get, "update"], keep_open=lock)
    names = {pattern: find(pattern) for pattern in patterns}
    found = [name for name in names.values() if name]
    if found:
        say(f"installing {', '.join(found)} through apt")
        command = [*apt_get, "install", "-y", "--no-install-recommends"]
        if not succeeds([*command, *found], keep_open=lock):
            # Try each one: perhaps only one of them is broken.
            lost = {name for name in found if not succeeds([*command, name], keep_open=lock)}
            return [each for each, name in names.items() if name is None or name in lost]
    return [pattern for pattern, name in names.items() if name is None]


def _command(*names: str) -> Callable[[], bool]:
    return lambda: any(shutil.which(name) for name in names)


def _library(name: str) -> Callable[[], bool]:
    return lambda: any(Path("/usr/lib").glob(f"*/{name}"))


CYCLONE_DDS = r"libddsc0\w*"
"""Cyclone DDS 0.10 with its security plugins: libddsc0debian, libddsc0t64, or similar."""

CHOSEN_DDS = "SROS_CYCLONEDDS_DIR"
"""The variable with which a user names the folder of the DDS to use."""


def has_chosen_dds() -> bool:
    """Return whether the user names the DDS to use, so that none is installed."""
    return bool(os.environ.get(CHOSEN_DDS))


FOR_TESTS: tuple[tuple[str, str, Callable[[], bool]], ...] = (
    ("openssl", "OpenSSL", _command("openssl")),
    ("softhsm2", "a PKCS#11 token in software", _command("softhsm2-util")),
    (
        "libengine-pkcs11-openssl",
        "keys on tokens for Fast DDS",
        lambda: any(Path("/usr/lib").glob("*/engines-3/pkcs11.so")),
    ),
    (r"g\+\+", "a C++ compiler, for the programs that ask Fast DDS", _command("g++")),
    (
        "libfastrtps-dev",
        "Fast DDS for C++, as a second vendor",
        Path("/usr/include/fastdds/dds/domain/DomainParticipant.hpp").exists,
    ),
    ("openssh-server", "robots that Ansible reaches", Path("/usr/sbin/sshd").exists),
    ("openssh-client", "the way there", _command("ssh")),
    ("libfaketime", "a robot with a wrong clock", _library("faketime/libfaketime.so.1")),
    ("nginx-light", "a web server from which robots fetch", Path("/usr/sbin/nginx").exists),
    ("golang-cfssl", "a CA service that issues certificates", _command("cfssl")),
    ("zsh", "a shell that evaluates what env prints", _command("zsh")),
    ("fish", "another shell that does", _command("fish")),
    ("systemd", "systemd, which verifies its units", _command("systemd-analyze")),
    ("chromium", "a browser for the pages", _command("chromium")),
    (
        CYCLONE_DDS,
        "Cyclone DDS, which enforces security",
        lambda: has_chosen_dds() or _library("libddsc.so.*")(),
    ),
)
"""Programs and libraries for the tests: package pattern, description, test of existence."""


def provide_for_tests(lock: int | None = None) -> None:
    """Install what is missing of `FOR_TESTS`; the tests of a package that fails are skipped."""
    missing = {package: what for package, what, there in FOR_TESTS if not there()}
    if "openssh-server" in missing and Path("/run/systemd/system").exists():
        say("not installing openssh-server, which would open a port of this machine from now on:"
            " without it the tests of robots that Ansible reaches are skipped")  # fmt: skip
        del missing["openssh-server"]
    if root_prefix() is None:
        missing.pop(CYCLONE_DDS, None)  # which is unpacked later, without root
    if not missing:
        return
    for what in missing.values():
        say(f"missing, but some tests need it: {what}")
    for package in install_all(list(missing), lock):
        say(f"{missing[package]} ({package}) cannot be installed; continuing without it")


def find(pattern: str, options: Sequence[str] = ()) -> str | None:
    """Return the first installable package whose whole name matches ``pattern``, or None."""
    stem = re.match(r"[a-z0-9.+-]*", pattern)
    names = output_of(["apt-cache", *options, "pkgnames", stem.group() if stem else ""]) or ""
    for name in sorted(names.split()):
        if re.fullmatch(pattern, name) and _has_candidate(name, options):
            return name
    return None


def unpack(pattern: str, folder: Path, lock: int | None = None) -> bool:
    """Unpack the package that matches ``pattern`` into ``folder``, without root.

    Also unpacks its dependencies that are not installed.  Fetches private package lists if the
    system's lists lack the package or are outdated.  Returns the success.
    """
    if not available():
        return False
    with tempfile.TemporaryDirectory(prefix="sros-apt-") as name:
        work = Path(name)
        if _download(pattern, work, [], lock):
            return _extract(work, folder, lock)
        private = _private_lists(work)
        succeeds(["apt-get", *_PATIENT, *private, "update"], keep_open=lock)
        return _download(pattern, work, private, lock) and _extract(work, folder, lock)


def needed(
    package: str, depends: Callable[[str], str], installed: Callable[[str], bool]
) -> list[str]:
    """Return ``package`` and all its direct and indirect dependencies that are not installed.

    ``depends`` returns the output of `apt-cache depends --important`.  If a dependency has
    alternatives, an installed one is enough; otherwise the first real package is taken.
    """
    wanted = [package]
    for name in wanted:
        for alternatives in _alternatives(depends(name)):
            if any(installed(other) for other in alternatives):
                continue
            real = [other for other in alternatives if not other.startswith("<")]
            if real and real[0] not in wanted:
                wanted.append(real[0])
    return wanted


def _alternatives(answer: str) -> list[list[str]]:
    groups: list[list[str]] = []
    open_group = False
    for line in answer.splitlines():
        found = re.match(r"^ (\||\s)(?:Pre)?Depends: (\S+)", line)
        if not found:
            continue
        name = found.group(2).removesuffix(":any")
        if open_group:
            groups[-1].append(name)
        else:
            groups.append([name])
        open_group = found.group(1) == "|"
    return groups


def _has_candidate(name: str, options: Sequence[str]) -> bool:
    answer = output_of(["apt-cache", *options, "policy", name]) or ""
    return bool(re.search(r"^\s+Candidate: (?!\(none\))\S", answer, re.MULTILINE))


def _installed(name: str) -> bool:
    answer = output_of(["dpkg-query", "-W", "-f", "${db:Status-Status}\n", name]) or ""
    return "installed" in answer.split()


def _download(pattern: str, folder: Path, options: Sequence[str], lock: int | None) -> bool:
    package = find(pattern, options)
    if package is None:
        return False

    def depends(name: str) -> str:
        return output_of(["apt-cache", *options, "depends", "--important", name]) or ""

    names = needed(package, depends, _installed)
    say(f"downloading {', '.join(names)}")
    return succeeds(
        ["apt-get", *_PATIENT, *options, "download", *names], cwd=folder, keep_open=lock
    )


def _extract(source: Path, target: Path, lock: int | None) -> bool:
    archives = sorted(source.glob("*.deb"))
    return bool(archives) and all(
        succeeds(["dpkg", "-x", archive, target], keep_open=lock) for archive in archives
    )


def _private_lists(work: Path) -> list[str]:
    for part in ("state/lists/partial", "cache/archives/partial"):
        (work / part).mkdir(parents=True)
    return ["-o", f"Dir::State={work}/state", "-o", f"Dir::Cache={work}/cache"]
