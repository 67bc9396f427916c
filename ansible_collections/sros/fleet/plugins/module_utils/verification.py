"""Whether enclaves on a robot can be used: asked of `sros verify`, or else of OpenSSL.

And whether their revocation lists are older than those that the robot has: asked of OpenSSL.
"""

from __future__ import annotations

import contextlib
import datetime
import json
import os
import re
import shutil
import ssl
import subprocess
import time
from typing import Callable, NamedTuple

from ansible_collections.sros.fleet.plugins.module_utils.exports import (
    AUTHORITY_FILES,
    CERTIFICATE_FILE,
    KEY_FILE,
    KEY_URI_FILE,
    REQUEST_FILE,
    SIGNED_FILES,
    TRUST_FILES,
    Files,
    RefusedError,
    authorities,
    enclaves_in,
    folder_of,
)

_LONGEST = 300
"""Seconds after which a program is taken to hang."""

_DATES = re.compile(r"<not_(before|after)>\s*([0-9T:+Z-]{10,40})\s*</not_")
_SUBJECT = re.compile(r"<subject_name>([^<]{1,2000})</subject_name>")
_REASON = re.compile(r"(?:depth lookup|Verify error): ?(.+)")
_MOST_SHOWN = 1000
_CERTIFICATE, _LIST = (
    re.compile(rb"-----BEGIN %b-----[A-Za-z0-9+/=\s]+-----END %b-----\n?" % (label, label))
    for label in (b"CERTIFICATE", b"X509 CRL")
)
_TRUST = AUTHORITY_FILES[0]
_MOST = 8
_NUMBER = re.compile(r"X509v3 CRL Number: (?:critical)?\s+(\w+)")
_SERIAL = re.compile(r"^ {4}Serial Number: (\w+)", re.MULTILINE)


def verify(folder: str, enclaves: list[str], program: list[str]) -> dict:
    """Return whether a process can run in each of these enclaves.

    Args:
        folder: the keystore of the robot.
        enclaves: the enclaves that are to be usable.
        program: the command that runs sros; where it does not exist, OpenSSL is asked.

    Returns:
        ``by`` ("sros" or "openssl"), ``ok``, ``problems`` (why an enclave cannot be used) and
        ``remarks`` (what else sros found).

    Raises:
        RefusedError: neither program is there, or it could not be asked.
    """
    openssl = shutil.which("openssl")
    if shutil.which(program[0]):
        answer = _by_sros(folder, enclaves, program)
        answer["problems"] += _on_tokens(openssl, folder, enclaves) if openssl else []
        return {**answer, "ok": not answer["problems"]}
    if not openssl:
        raise RefusedError(
            "The enclaves cannot be verified: this robot has neither sros nor openssl. Install the"
            " package openssl on it."
        )
    problems = _on_tokens(openssl, folder, enclaves)
    for name in enclaves:
        found = _by_openssl(openssl, os.path.join(folder, folder_of(name)), name)
        problems += [f"{name}: {problem}" for problem in found]
    return {"by": "openssl", "ok": not problems, "problems": problems, "remarks": []}


def check_lists(before: Files, after: Files, spare: str) -> list[str]:
    """Return remarks on certificates that new revocation lists lack and the current ones have.

    The owner of the enclaves can write whatever into the current files.  So only a list counts that
    is signed by a CA that the new files trust.

    Args:
        before: the files that the robot has.
        after: the files that are to be installed.
        spare: a folder of this user alone, for files of OpenSSL.

    Raises:
        RefusedError: a new list is older, or missing; revoked enclaves would be trusted again.
    """
    lists, remarks = _newest_lists(after, spare), {}
    for name in sorted(set(enclaves_in(before)) & set(enclaves_in(after))):
        found = lists(after, name)
        for authority, present in lists(before, name).items():
            if remark := _remark_on_lost(name, present, found.get(authority)):
                remarks[present] = remark
    return list(remarks.values())


def _remark_on_lost(name: str, present: _List, new: _List | None) -> str:
    """Return a remark on what a new list of the same CA lacks, or ""."""
    if new and new.text == present.text:
        return ""
    if not new or new.number <= present.number:
        number = f"the number {new.number}" if new else "none"
        raise RefusedError(
            f"The revocation list for {name} is older than the one of this robot, which has the"
            f" number {present.number}; the keystore has {number}. Revoked enclaves would be"
            f" trusted again. The keystore may come from a backup: copy {present.file} of {name} on"
            " this robot to the keystore machine, run `sros crl KEYSTORE --refresh --crl FILE`"
            " with this copy, and deliver again. If the older list is right, set"
            " allow_older_lists (sros_allow_older_lists)."
        )
    lost = present.serials - new.serials
    if not lost:
        return ""
    return (
        f"The current revocation list has {len(lost)} serial numbers that the new one"
        f" lacks, such as {min(lost).lower()}. This is right if these certificates have"
        " expired, which the robot cannot tell, but `sros inspect KEYSTORE --history` can. If a"
        " certificate has not expired, or is not there, the keystore comes from a backup: then take"
        " the list over from another robot, with `sros crl KEYSTORE --refresh --crl FILE`, and"
        " deliver again."
    )


def check_authorities(before: Files, after: Files, spare: str) -> None:
    """Raise `RefusedError` if an enclave would trust again a CA that a later one has replaced.

    A CA is later than the CA that it replaces (`retired_authorities` of sros).  The arguments are
    those of `check_lists`.
    """
    if not authorities(before) & authorities(after):
        return  # another keystore, which is refused otherwise
    for name in sorted(set(enclaves_in(before)) & set(enclaves_in(after))):
        for file in AUTHORITY_FILES:
            path = folder_of(name) + "/" + file
            present, new = (
                {b"".join(block.split()): block for block in _CERTIFICATE.findall(content)[:_MOST]}
                for content in (before.get(path, b""), after[path])
            )
            added = [new[key] for key in set(new) - set(present)]
            if not (added and present):
                continue
            newest = max(_start(block, spare) for block in present.values())
            if any(_start(block, spare) < newest for block in added):
                raise RefusedError(
                    f"This robot has a later CA in {file} of {name} than the keystore. It would"
                    " trust the earlier CA again, and everything that was revoked since. Nothing"
                    " was changed. The keystore may come from a backup:"
                    " docs/howto/keystore_is_lost.md of sros"
                    " says how to go on. If the keystore's CA is right, set replace_authorities"
                    " (sros_replace_authorities)."
                )


def _start(authority: bytes, spare: str) -> float:
    """Return when the validity of a CA (PEM) began, in seconds since 1970; 0 if it is damaged."""
    openssl, path = shutil.which("openssl"), os.path.join(spare, "ca.pem")
    if not openssl:
        raise RefusedError(
            "CAs cannot be compared: this robot lacks openssl. Install the package openssl on it."
        )
    with open(path, "wb") as file:
        file.write(authority)
    done = _run([openssl, "x509", "-in", path, "-noout", "-startdate"])
    with contextlib.suppress(ValueError):
        return ssl.cert_time_to_seconds(done.stdout.decode().strip().partition("=")[2])
    return 0.0


def same_trust(before: Files, after: Files, spare: str) -> set[str]:
    """Return the enclaves whose processes accept the same others with the new files as before.

    Of a revocation list that a CA of the new files signed, only what it revokes counts.  The
    arguments are those of `check_lists`.
    """
    lists, same = _newest_lists(after, spare), set()
    for name in set(enclaves_in(before)) & set(enclaves_in(after)):
        paths = [f"{folder_of(name)}/{file}" for file in TRUST_FILES]
        different = [path for path in paths if before.get(path) != after.get(path)]
        if different == [f"{folder_of(name)}/crl.pem"] and shutil.which("openssl"):
            contents = [files.get(different[0], b"") for files in (before, after)]
            present, new = (
                {authority: found.serials for authority, found in lists(files, name).items()}
                for files in (before, after)
            )
            alone = all(len(_LIST.findall(content)) == 1 for content in contents)
            if alone and present and present == new:
                different = []
        if not different:
            same.add(name)
    return same


def _newest_lists(after: Files, spare: str) -> Callable[[Files, str], dict[bytes, _List]]:
    """Return a function for the newest list of an enclave by each CA of the new files (PEM).

    In a rotation, the list of the second CA is in the file of the CAs.
    """
    asked: dict[tuple, _List | None] = {}

    def newest(files: Files, name: str) -> dict[bytes, _List]:
        found: dict[bytes, _List] = {}
        for authority in _CERTIFICATE.findall(_content(after, name, _TRUST))[:_MOST]:
            known = []
            for file in ("crl.pem", _TRUST):
                for block in _LIST.findall(_content(files, name, file))[:_MOST]:
                    if (block, authority) not in asked:
                        asked[block, authority] = _read_list(block, authority, file, spare)
                    known.append(asked[block, authority])
            last = max(filter(None, known), default=None)
            if last:
                found[authority] = last
        return found

    return newest


def _content(files: Files, name: str, file: str) -> bytes:
    return files.get(folder_of(name) + "/" + file, b"")


class _List(NamedTuple):
    """A revocation list: its number, its PEM, its serial numbers, and the file that has it."""

    number: int
    text: bytes
    serials: frozenset
    file: str


def _read_list(block: bytes, authority: bytes, name: str, spare: str) -> _List | None:
    """Return a revocation list (PEM) if a CA (PEM) signed it, else None."""
    openssl = shutil.which("openssl")
    if not openssl:
        raise RefusedError(
            "Revocation lists cannot be compared: this robot lacks openssl. Install the package"
            " openssl on it."
        )
    at = {file: os.path.join(spare, file) for file in ("list.pem", "ca.pem")}
    for path, content in zip(at.values(), (block, authority)):
        with open(path, "wb") as file:
            file.write(content)
    command = [openssl, "crl", "-in", at["list.pem"], "-noout"]
    done = _run([*command, "-CAfile", at["ca.pem"], "-no-CApath"])
    if done.returncode or b"verify OK" not in done.stderr:
        return None
    text = _run([*command, "-text"]).stdout.decode(errors="replace")
    number = _NUMBER.search(text)
    serials = frozenset(_SERIAL.findall(text))
    return _List(int(number.group(1), 0) if number else 0, block, serials, name)


def _by_sros(folder: str, enclaves: list[str], program: list[str]) -> dict:
    done = _run([*program, "verify", folder, "--json"])
    try:
        answer = json.loads(done.stdout)
        loadable = {enclave["name"]: bool(enclave["loadable"]) for enclave in answer["enclaves"]}
        texts: dict[str, list[str]] = {}
        for finding in answer["findings"]:
            texts.setdefault(finding["enclave"] or "", []).append(str(finding["text"]))
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise RefusedError(
            "`sros verify` gave no answer: {}".format(_short(done.stderr.decode(errors="replace")))
        ) from error
    problems: list[str] = []
    remarks: list[str] = list(texts.pop("", []))
    for name in enclaves:
        found = texts.pop(name, [])
        if loadable.get(name):
            remarks += [f"{name}: {problem}" for problem in found]
        else:
            problems += [f"{name}: {problem}" for problem in found or ["it is not loadable"]]
    return {"by": "sros", "ok": not problems, "problems": problems, "remarks": remarks}


def _by_openssl(openssl: str, folder: str, name: str) -> list[str]:
    """Return why an enclave cannot be used, as far as OpenSSL can tell."""
    at = {file: os.path.join(folder, file) for file in (KEY_FILE, CERTIFICATE_FILE, "crl.pem")}
    identity, permissions = (os.path.join(folder, file) for file in AUTHORITY_FILES)
    problems: list[str] = []
    chain = [openssl, "verify", "-no-CApath", "-partial_chain", "-CAfile", identity]
    if os.path.exists(at["crl.pem"]):
        chain += ["-crl_check", "-CRLfile", at["crl.pem"]]
    done = _run([*chain, at[CERTIFICATE_FILE]])
    if done.returncode:
        problems.append(f"cert.pem: {_why(done)}")
    shown = _run([openssl, "x509", "-in", at[CERTIFICATE_FILE], "-noout", "-pubkey"])
    own = _run([openssl, "pkey", "-in", at[KEY_FILE], "-pubout"])
    if not os.path.lexists(at[KEY_FILE]) and os.path.exists(os.path.join(folder, KEY_URI_FILE)):
        pass  # on a token: see _on_tokens
    elif own.returncode:
        problems.append(f"key.pem: {_why(own)}")
    elif shown.stdout.split() != own.stdout.split():
        problems.append("key.pem: it is not the key of cert.pem")
    subject = _run(
        [openssl, "x509", "-in", at[CERTIFICATE_FILE], "-noout", "-subject", "-nameopt", "RFC2253"]
    )
    if not _names(subject.stdout.decode(errors="replace").partition("=")[2], name):
        problems.append("cert.pem: it is not for this enclave")
    for file in SIGNED_FILES:
        path = os.path.join(folder, file)
        done = _run(
            [
                openssl,
                "smime",
                "-verify",
                "-in",
                path,
                "-no-CApath",
                "-partial_chain",
                "-CAfile",
                permissions,
                "-nointern",
                "-certfile",
                permissions,
                "-purpose",
                "any",
            ]
        )
        if done.returncode:
            problems.append(f"{file}: {_why(done)}")
        elif file == "permissions.p7s":
            problems += [f"{file}: {problem}" for problem in _permissions(done.stdout, name)]
    return problems


def _on_tokens(openssl: str, folder: str, enclaves: list[str]) -> list[str]:
    """Return what is wrong with enclaves whose keys are on tokens.

    Only `sros verify --tokens` asks the token; the signing request says which key it has.
    """
    problems = []
    for name in enclaves:
        place = os.path.join(folder, folder_of(name))
        at = [os.path.join(place, file) for file in (KEY_URI_FILE, REQUEST_FILE, CERTIFICATE_FILE)]
        if not all(map(os.path.exists, at)) or os.path.lexists(os.path.join(place, KEY_FILE)):
            continue
        keys = [
            _run([openssl, kind, "-in", path, "-noout", "-pubkey"]).stdout.split()
            for kind, path in (("req", at[1]), ("x509", at[2]))
        ]
        if keys[0] != keys[1]:
            problems.append(
                f"{name}: cert.pem: it is not for the key that {REQUEST_FILE} was made with. Have"
                " the request signed again, with the play sros.fleet.requests"
            )
    return problems


def _permissions(document: bytes, name: str) -> list[str]:
    """Return what is wrong with a permissions document that is signed: dates and subject."""
    text = document.decode(errors="replace")
    problems = []
    if not any(_names(subject, name) for subject in _SUBJECT.findall(text)):
        problems.append("it is not for this enclave")
    now = datetime.datetime.fromtimestamp(time.time(), datetime.timezone.utc)
    for which, written in _DATES.findall(text):
        try:
            moment = datetime.datetime.fromisoformat(written.replace("Z", "+00:00"))
        except ValueError:
            problems.append(f"its date {written} cannot be read")
            continue
        if moment.tzinfo is None:
            moment = moment.replace(tzinfo=datetime.timezone.utc)
        if which == "before" and moment > now:
            problems.append(f"it is not valid before {written}")
        if which == "after" and moment < now:
            problems.append(f"it expired at {written}")
    return problems


def _names(subject: str, name: str) -> bool:
    """Return whether a subject's common name is that of an enclave."""
    parts = [part.strip() for part in subject.replace("/CN=", ",CN=").split(",")]
    return any(part == "CN=" + name for part in parts)


def _run(command: list[str]) -> subprocess.CompletedProcess:
    # No certificates but those of the enclave vouch for it.
    alone = {"SSL_CERT_FILE": os.devnull, "SSL_CERT_DIR": "/nonexistent", "LC_ALL": "C.UTF-8"}
    try:
        return subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            env={**os.environ, **alone},
            timeout=_LONGEST,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise RefusedError(f"{command[0]} did not end within {_LONGEST} s.") from error
    except OSError as error:
        raise RefusedError(f"{command[0]} cannot be run: {error.strerror}.") from error


def _why(done: subprocess.CompletedProcess) -> str:
    """Return the reason that OpenSSL gives, without the names of files and functions."""
    text = (done.stderr or done.stdout).decode(errors="replace")
    reason = _REASON.search(text)
    return _short(reason.group(1) if reason else text) or "it cannot be read"


def _short(text: str) -> str:
    shown = "".join(
        character if character.isprintable() else "?" for character in " ".join(text.split())
    )
    return shown if len(shown) <= _MOST_SHOWN else shown[:_MOST_SHOWN] + "..."


def clock_remark(here: float, home: float | None, longest: float) -> str:
    """Return what to say about a clock that differs by more than ``longest`` seconds, or ""."""
    if home is None or abs(here - home) <= longest:
        return ""
    ahead = datetime.timedelta(seconds=int(abs(here - home)))
    return "The clock of this robot is {} {}. Set it (such as with NTP).".format(
        ahead,
        "ahead" if here > home else "behind",
    )
