"""Explain security messages in a log, and examine the enclaves that the log names.

The log may mix lines of several processes, with labels of ros2 launch, journald or Docker Compose,
and may contain colors and tracebacks.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

from sros_tool.errors import Note, SrosError, UsageError
from sros_tool.explain.asking import (
    AskingContext,
    fleet_of,
    is_enclave,
    not_in_policy_error,
    planned_enclave,
    policy_to_ask,
    signed_enclave,
)
from sros_tool.explain.denials import read_denials
from sros_tool.explain.log_causes import Examiner, LogFinding
from sros_tool.explain.log_drops import dropped_message_findings
from sros_tool.explain.log_lines import grouped_hits, lines_naming
from sros_tool.explain.log_sources import AskedPolicy, FindEnclave, SearchedKeystore
from sros_tool.keystore.layout import is_keystore
from sros_tool.keystore.participant import JoinContext, LoadedEnclave
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.names import check_enclave_name
from sros_tool.runtime.environment import RMW_ZENOH
from sros_tool.runtime.log_texts import UNKNOWN
from sros_tool.runtime.vendor_log import labeled_line, log_lines, plain_text, security_directory
from sros_tool.runtime.zenoh_log import ZENOH_LINE
from sros_tool.wording import first_few


class ExplainedLog(NamedTuple):
    """The security messages of a log, explained."""

    log: str
    """Path of the log."""
    findings: Sequence[LogFinding]
    """The security messages, each of them once."""
    secured: bool | None
    """Whether a line says that a node of the named enclave ran secured; null if no enclave is
    named, or if RMW_IMPLEMENTATION or the log shows that the node uses Zenoh, which logs no such
    line.
    """
    notes: Sequence[Note]
    """Notes, which text output prints on standard error."""


_MOST_FOLDERS = 5
"""Maximum number of folders that a note names."""


def explain_log_file(
    log: str,
    text: str,
    keystore: OpenedKeystore | None,
    name: str,
    asking: AskingContext,
    policy_file: Path | None = None,
    rmw: str = "",
) -> ExplainedLog:
    """Return the explained messages of a log; examines the enclaves that the log names.

    ``name`` is the enclave, or its folder, whose processes wrote the log; "" if the log names the
    enclave, or if ``keystore`` is the folder of a single enclave.  With ``policy_file`` and no
    keystore, only denials are examined: by the rights in the policy.  With both, the keystore
    decides, and findings have lines of the policy. ``rmw`` is the RMW of the environment, or "".

    Raises:
        UsageError: ``name`` is an enclave, and there is no keystore.
        PolicyError: the policy cannot be read, or does not have the enclave ``name``.
    """
    named: LoadedEnclave | None = None
    policy: AskedPolicy | None = None
    by_policy = policy_file is not None and keystore is None
    original = stated = None
    if policy_file:
        original, stated = policy_to_ask(policy_file, fleet_of(asking.fleet_file, keystore))
    folder = keystore.root if keystore and not name else None
    if folder and is_enclave(folder) and not is_keystore(folder):
        keystore, name = None, str(folder)

    def with_policy(enclave: LoadedEnclave) -> LoadedEnclave:
        of_policy = stated.enclave(enclave.name) if stated else None
        if of_policy is None:
            return enclave
        return enclave._replace(
            keystore=keystore,
            policy=of_policy,
            policy_file=policy_file,
            has_placeholders=stated != original,
        )

    if by_policy and stated and policy_file:
        policy = AskedPolicy(str(policy_file), stated, name)
        if name and not policy.namespace_and_path(name)[1]:
            raise not_in_policy_error(stated, name, policy_file)
    elif name:
        named = signed_enclave(keystore, name, asking.at)
        if named is None and not name.startswith("/"):
            raise UsageError(
                f"'{name}' does not exist", "", "Name a keystore, or an enclave's folder."
            )
        if named is None:
            raise UsageError(
                f"the keystore of enclave {name} is missing in the command",
                "",
                "Write the keystore before the enclave.",
            )

    if named and stated and policy_file:
        if named.name and stated.enclave(named.name) is None:
            raise not_in_policy_error(stated, named.name, policy_file)
        named = with_policy(named)

    # Cached, because a log may name any number of enclaves, any number of times.
    @cache
    def find(enclave: str) -> LoadedEnclave | None:
        if named is not None and enclave in ("", named.name):
            return named
        # Without its certificate, an enclave's folder does not tell the name of the enclave.
        if named and not named.name and str(Path(name).absolute()).endswith(f"/enclaves{enclave}"):
            return with_policy(named._replace(name=enclave))
        if policy is None and (keystore is None or not enclave):
            return None
        try:
            if policy is not None:
                of_robot = policy.enclave(check_enclave_name(enclave or name))
                return planned_enclave(of_robot, None, asking) if of_robot else None
            check_enclave_name(enclave)
            signed = signed_enclave(keystore, enclave, asking.at, planned=True)
            return with_policy(signed) if signed else None
        except SrosError:  # the log names an enclave of another keystore, or a path
            return None

    findings = explain_log(
        text,
        find,
        lambda enclave: asking.context(enclave.joined_domains),
        str(keystore.root) if keystore else "",
        SearchedKeystore(keystore) if keystore and is_keystore(keystore.root) else None,
        policy,
    )
    plain = plain_text(text)
    named_folders = filter(None, map(security_directory, log_lines(plain)))
    started = [(line["enclave"] or "/", line["folder"]) for line in named_folders]

    def is_named(enclave: str) -> bool:
        if policy:
            namespace, path = policy.namespace_and_path(name)
            return enclave == name if namespace else policy.namespace_and_path(enclave)[1] == path
        loaded = find(enclave)
        return loaded is not None and named is not None and loaded.folder == named.folder

    secured = None
    # Zenoh files in the enclave show nothing: a node on DDS leaves them unused.
    of_zenoh = rmw.startswith(RMW_ZENOH) if rmw else not started and _has_zenoh_line(plain)
    if name and not (plain.strip() and of_zenoh):
        secured = any(is_named(enclave) for enclave, _ in started)
    examined = named.folder if named and not keystore else keystore and keystore.root
    notes = [*_other_folder_notes(examined, [folder for _, folder in started])] if examined else []
    if any(finding.found for finding in findings):
        notes.append(_note_on_text(_ONLY_FOUND))
    elif started and not findings and secured is not False:
        notes.append(_note_on_text(_NO_PROOF))
    return ExplainedLog(log, findings, secured, notes)


def _has_zenoh_line(log: str) -> bool:
    """Return whether a log has a line of Zenoh; a bridge, or a message's text, can have it, too."""
    return any(ZENOH_LINE.search(labeled_line(line)[1]) for line in log_lines(log))


def _other_folder_notes(examined: Path, folders: Iterable[str]) -> Iterator[Note]:
    """Yield a note if a log names folders of enclaves outside of the ``examined`` folder."""
    inside = examined.resolve()
    other = [
        folder
        for folder in dict.fromkeys(folders)
        # Path.resolve() fails for a link to itself, which the log may name.
        if Path(folder).is_absolute() and not Path(os.path.realpath(folder)).is_relative_to(inside)
    ]
    if other:
        shown = first_few(other, _MOST_FOLDERS)
        yield Note("log.other-folder", f"the log names another folder than {examined}: {shown}")


_ONLY_FOUND = "only the rows 'found' are what sros itself found in the enclave"
_NO_PROOF = (
    "this log does not prove that its node runs secured. An open listener in the same domain has "
    "to hear nothing from the node: `sros demo listener --topic NAME --for 10s`"
)


def _note_on_text(text: str) -> Note:
    return Note("log.only-text", f"a process can print any line, true or false: {text}")


def explain_log(
    text: str,
    find: FindEnclave,
    context: Callable[[LoadedEnclave], JoinContext],
    root: str = "",
    keystore: SearchedKeystore | None = None,
    policy: AskedPolicy | None = None,
) -> tuple[LogFinding, ...]:
    """Return the different security messages of a log, in the order of the log.

    Lines that are not understood follow at the end, with one finding for each process.

    ``find`` loads an enclave; ``context`` returns the domain and time for a loaded enclave.
    ``root`` is the path of the keystore as suggested commands name it.  The enclaves of peers and
    nodes in the log are looked up in ``keystore``.  ``policy`` is set if the enclaves are from a
    policy.
    """
    plain = plain_text(text)
    lines = log_lines(plain)
    examiner = Examiner(find, context, root, keystore, policy, lines)
    denied = read_denials(plain)
    naming = lines_naming(lines, denied)
    reported = {denial.process for denial in denied}
    findings = [
        finding
        for hits in grouped_hits(lines, reported)
        if (finding := examiner.message_finding(hits)) is not None
    ]
    lacking = examiner.missing_namespaces(denied)
    findings += [
        examiner.denial_finding(
            denial, naming[denial], lacking.get((denial.process, denial.enclave), "")
        )
        for denial in denied
    ]
    own_enclave = find("")
    findings += dropped_message_findings(
        lines, root, own_enclave.name if own_enclave else "", keystore
    )
    findings.sort(key=lambda finding: (finding.id == UNKNOWN.id, finding.line))
    return tuple(_without_restarts(findings))


def _without_restarts(findings: Iterable[LogFinding]) -> Iterator[LogFinding]:
    """Yield the findings, but those of an enclave's later processes with the first equal one.

    A unit that restarts its process repeats the same messages.
    """
    alike: dict[object, list[LogFinding]] = {}
    for finding in findings:
        is_alone = not finding.enclave or finding.id == UNKNOWN.id
        key = finding if is_alone else replace(finding, line=0, count=0, text="", process="")
        alike.setdefault(key, []).append(finding)
    for first, *later in alike.values():
        yield replace(first, count=first.count + sum(other.count for other in later))
