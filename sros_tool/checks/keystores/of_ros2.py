"""One cause for the findings in what ros2/sros2 made: a whole keystore, or enclaves in one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from shlex import quote

from sros_tool.checks.keystores.authorities import ONE_AUTHORITY
from sros_tool.checks.keystores.documents import TIME_FORMAT
from sros_tool.checks.keystores.enclaves import EVERYTHING, LONG_PERMISSIONS, NOT_UNIQUE
from sros_tool.checks.keystores.files import FOLDER_OPEN, KEY_READABLE
from sros_tool.checks.keystores.issued import UNEXPLAINED
from sros_tool.checks.kind import WARNING, Cause, Finding, some_names
from sros_tool.keystore.layout import KEY_FILE, enclave_path
from sros_tool.keystore.of_ros2 import is_of_ros2
from sros_tool.keystore.reader import Keystore

_OF_A_KEYSTORE = (KEY_READABLE, FOLDER_OPEN, TIME_FORMAT, LONG_PERMISSIONS, ONE_AUTHORITY)
"""What ros2/sros2 writes into every keystore, and `update_keystore --template sros2` ends."""
_OF_AN_ENCLAVE = (UNEXPLAINED, KEY_READABLE, TIME_FORMAT, NOT_UNIQUE, LONG_PERMISSIONS, EVERYTHING)
"""What ros2/sros2 writes into every enclave, and `create_permission --revoke-old` ends."""
_MOST_NAMED = 3


def with_cause_of_ros2(findings: Sequence[Finding], keystore: Keystore) -> list[Finding]:
    """Return the findings; those in what ros2/sros2 made get one cause, if there are several."""
    root = keystore.root
    if is_of_ros2(keystore):
        chosen = [each for each in findings if each.kind in _OF_A_KEYSTORE]
        text = f"It has neither sros.toml nor ledger.jsonl. Found: {_kinds(chosen)}."
        return _with(
            findings,
            chosen,
            root,
            "a keystore that ros2/sros2 made",
            text,
            f"Run `sros update_keystore {quote(str(root))} --template sros2`, which takes it over "
            "with its CA, keys and rights, closes the keys to other users, and signs the "
            "permissions again.",
        )
    unknown = {each.subject for each in findings if each.kind is UNEXPLAINED}
    names = sorted(name for name in unknown if _is_plain(findings, name))
    keys = {f"{enclave_path(root, name)}/{KEY_FILE}" for name in names}
    chosen = [
        each
        for each in findings
        if each.kind in _OF_AN_ENCLAVE and (each.subject in names or each.file in keys)
    ]
    shown = " ".join(map(quote, names)) if len(names) <= _MOST_NAMED else "NAME..."
    command = f"sros create_permission {quote(str(root))} {shown} POLICY_FILE --revoke-old"
    return _with(
        findings,
        chosen,
        root,
        f"{len(names)} enclaves that the keystore never issued"
        if len(names) > 1
        else "an enclave that the keystore never issued",
        f"{some_names(names)}: neither certificate nor permissions are in the ledger, as "
        f"`ros2 security create_enclave` leaves them. Found: {_kinds(chosen)}.",
        f"If you made it, state its rights by `{command}`, which also issues the certificate "
        "again. If nobody did, somebody else has the CA key: revoke the enclave, and replace the "
        "CA (`sros rotate_ca`).",
    )


def _is_plain(findings: Sequence[Finding], name: str) -> bool:
    """Return whether both files of an enclave are not in the ledger: it is new altogether."""
    return sum(each.kind is UNEXPLAINED and each.subject == name for each in findings) > 1


def _with(
    findings: Sequence[Finding],
    chosen: Sequence[Finding],
    root: Path,
    title: str,
    text: str,
    remedy: str,
) -> list[Finding]:
    """Return the findings, with a common cause for those of ``chosen`` that count by default."""
    together = {id(each) for each in chosen if each.severity >= WARNING}
    if len(together) < 2:
        return list(findings)
    cause = Cause(title, text, remedy, len(together), str(root))
    return [replace(each, cause=cause) if id(each) in together else each for each in findings]


def _kinds(findings: Sequence[Finding]) -> str:
    """Return the titles of the kinds of findings, with their numbers."""
    counted = Counter(each.kind.title for each in findings if each.severity >= WARNING)
    return "; ".join(
        f"{title} ({number} times)" if number > 1 else title for title, number in counted.items()
    )
