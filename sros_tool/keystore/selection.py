"""Selection of the enclaves on which a verb works: by name, by pattern, or by robot.

If an enclave is missing, the error says whether it was revoked, or which enclave has a similar
name.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime
from fnmatch import fnmatchcase
from functools import partial
from itertools import islice
from pathlib import Path
from shlex import quote
from typing import NamedTuple

from sros_tool.errors import InvalidNameError, KeystoreError, Note, SrosError
from sros_tool.fleet.robots import (
    Fleet,
    UnrecordedEnclaves,
    enclaves_of,
    folders_of_robots,
    robot_of,
    unrecorded_enclaves,
)
from sros_tool.keystore.delivery.published import may_have_later_releases, read_published
from sros_tool.keystore.fleet import arguments_for, checked_fleet, enclaves_of_robot, load_fleet
from sros_tool.keystore.known_keys import restored_at
from sros_tool.keystore.layout import (
    CLOSED_KEYSTORE,
    CLOSED_POLICY,
    FLEET,
    LEDGER,
    PERMISSIONS_FILE,
    PRIVATE,
    REVOKED,
    SETTINGS,
    enclave_path,
    enclaves_below,
    folder_of_closed_robot,
    how_to_learn_one_process,
)
from sros_tool.keystore.ledger import Entry
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.names import check_enclave_name
from sros_tool.pki.crl import signed_by
from sros_tool.validity import iso
from sros_tool.values import shows
from sros_tool.wording import capitalized, first_few


@shows(optional=("robots",))
class EnclaveList(NamedTuple):
    """The enclaves of a keystore, or of policies."""

    keystore: Path | None
    """Path of the keystore, as the user gave it; null for the enclaves of policies."""
    enclaves: Sequence[str]
    """Names of the enclaves, sorted."""
    hidden: Sequence[str]
    """Names of enclaves in hidden folders, sorted; DDS loads them, but sros leaves them out."""
    robots: Mapping[str, str] | None
    """Maps each enclave of a robot to the robot; null without a fleet."""


def robots_of(keystore: OpenedKeystore, names: Sequence[str]) -> dict[str, str] | None:
    """Map each enclave in ``names`` that belongs to a robot to this robot; None without a fleet."""
    fleet = load_fleet(keystore)
    if fleet is None:
        return None
    owners = ((name, robot_of(fleet, name)) for name in names)
    return {name: robot.name for name, robot in owners if robot}


def select_enclaves(
    keystore: OpenedKeystore,
    names: Sequence[str],
    patterns: Sequence[str] = (),
    *,
    robots: Sequence[str] = (),
    checked: bool = False,
) -> tuple[str, ...]:
    """Return ``names``, then the enclaves that match ``patterns``, then the enclaves of ``robots``.

    Each enclave is returned once.  In a pattern, ``*`` stands for any text, including "/", as in
    policies.  With ``checked``, ``robots`` are only accepted if nobody edited the fleet file.

    Raises:
        KeystoreError: a pattern matches no enclave, or a robot has no enclave.
        DocumentError: the fleet of the keystore has no such robot; the error names similar robots.
    """
    keystore.check()
    chosen = dict.fromkeys(names)
    root, existing = keystore.root, keystore.names if patterns else ()
    for pattern in patterns:
        fitting = [name for name in existing if fnmatchcase(name, pattern)]
        if not fitting:
            raise KeystoreError(
                f"no enclave of keystore '{root}' matches {pattern!r}",
                "",
                f"See `sros list_enclaves {quote(str(root))}`.",
            )
        chosen |= dict.fromkeys(fitting)
    return tuple(chosen | dict.fromkeys(_enclaves_of_robots(keystore, robots, checked, {})))


def select_enclaves_to_revoke(
    keystore: OpenedKeystore,
    names: Sequence[str],
    patterns: Sequence[str],
    robots: Sequence[str],
    *,
    now: datetime,
) -> tuple[tuple[str, ...], tuple[Note, ...]]:
    """Return the enclaves to revoke, and notes on other enclaves that ``robots`` may have.

    This works like `select_enclaves`, except that a robot also has all enclaves in its folder, such
    as ``/r3/spare``.  Enclaves that are revoked already are only noted.

    Raises:
        KeystoreError: as `select_enclaves`.
        DocumentError: as `select_enclaves`.
    """
    revoked = [name for name in names if _is_revoked(keystore, name, now)]
    names = [name for name in names if name not in revoked]
    if not (patterns or robots):
        # The verb reports what is wrong with a name.
        return tuple(names), tuple(_revoked_notes(revoked))
    with _telling_of_lost_certificates(keystore):
        chosen = dict.fromkeys(select_enclaves(keystore, names, patterns))
    unrecorded: dict[str, UnrecordedEnclaves] = {}
    by_name = partial(_advice_on_revoking_by_name, keystore, robots)
    if fleet := checked_fleet(keystore, by_name) if robots else None:
        possible = _possible_enclaves(keystore, fleet, robots)
        unrecorded = unrecorded_enclaves(fleet, possible, set(robots))
    left_robots = list(robots)
    for name in (name for name in robots if fleet and name in fleet.robots):
        assert fleet
        own = enclaves_of(fleet, fleet.robots[name])
        gone = [enclave for enclave in own if _is_revoked(keystore, enclave, now)]
        others = set(own).difference(gone)
        may_exist = any(
            keystore.has_enclave(enclave) or _valid_serials(keystore, enclave, now)
            for enclave in others
        )
        if gone and not unrecorded[name].below and not may_exist:
            left_robots.remove(name)
            revoked += gone
    with _telling_of_lost_certificates(keystore):
        chosen |= dict.fromkeys(_enclaves_of_robots(keystore, left_robots, True, unrecorded))
    below = [name for enclaves in unrecorded.values() for name in enclaves.below]
    left = {name for enclaves in unrecorded.values() for name in enclaves.naming} - chosen.keys()
    notes = [*_revoked_notes(revoked), *_unrecorded_notes(keystore, sorted(below), sorted(left))]
    return tuple(chosen), (*notes, *(_other_computers_notes(keystore, fleet, robots, chosen)))


@contextmanager
def _telling_of_lost_certificates(keystore: OpenedKeystore) -> Iterator[None]:
    """Add to the remedy of an error that the keystore may lack certificates to revoke."""
    try:
        yield
    except SrosError as error:
        error.remedy = _with_lost_certificates(keystore, error.remedy)
        raise


def _with_lost_certificates(keystore: OpenedKeystore, remedy: str) -> str:
    """Return how to end certificates that the keystore may lack, then ``remedy``.

    The keystore may lack certificates if it was restored from a backup, or is an old copy.
    """
    root, publish = quote(str(keystore.root)), ""
    if may_have_later_releases(keystore):
        folder = quote(read_published(keystore).folder)
        publish = (
            f"First run `sros fleet publish {root} {folder} --restored`, which records the "
            "certificates in this folder. "
        )
    elif not restored_at(keystore):
        return remedy
    flag = " --identity" if len(keystore.authority_files) > 1 else ""
    otherwise = f" If the name is wrong: {remedy[:1].lower()}{remedy[1:]}" if remedy else ""
    return (
        "The keystore was restored from a backup, or is a copy, and may lack certificates that "
        f"were issued after the backup. {publish}Nothing in this keystore can revoke certificates "
        "that it lacks: they are valid until they expire, or until you replace the identity CA "
        f"(`sros rotate_ca {root}{flag} --next` for each stage; docs/howto/keystore_is_lost.md, "
        f"Certificates were renewed after the backup).{otherwise}"
    )


def _is_revoked(keystore: OpenedKeystore, name: str, now: datetime) -> bool:
    """Return whether an enclave no longer exists, and all its valid certificates are revoked.

    The revocation list has to have these certificates, because an earlier list may have been put
    back, and the identity CA has to have signed the list.  The result is False in a rotation, which
    has several lists, and if the ledger may lack certificates.
    """
    if keystore.has_enclave(name) or not revocation_of(keystore, name):
        return False
    lists, file = keystore.revocation_lists, keystore.identity_file
    if file is None:
        return False
    authorities = keystore.certificates_of(file)
    if len(lists) != 1 or len(authorities) != 1 or not signed_by(lists[0].list, authorities[0]):
        return False
    ledger = keystore.ledger
    if ledger.gaps or restored_at(keystore):
        return False
    listed = {entry.serial for entry in lists[0].revoked}
    return _valid_serials(keystore, name, now) <= listed


def _valid_serials(keystore: OpenedKeystore, name: str, now: datetime) -> set[int]:
    """Return the serial numbers of the certificates of an enclave that have not expired."""
    return {
        int(entry.serial, 16)
        for entry in keystore.ledger_with("enclave", name).entries
        if entry.enclave == name
        and entry.what in ("certificate", "revocation")
        and entry.serial
        and not "" < entry.not_after <= iso(now)
    }


def _revoked_notes(names: Sequence[str]) -> Iterator[Note]:
    if names:
        verb = "was" if len(names) == 1 else "were"
        yield Note(
            "revoke.already-revoked",
            f"{first_few(sorted(names), _MOST_SHOWN)} {verb} revoked before: nothing to do.",
        )


def _advice_on_revoking_by_name(keystore: OpenedKeystore, robots: Sequence[str]) -> str:
    """Return sentences on how to revoke the enclaves of robots although the fleet was edited.

    The sentences name the enclaves that the edited file gives to the robots, and the enclaves with
    the robots' names in their paths.  Both lists are only proposals, because whoever edited the
    file may be the thief.
    """
    root, fleet = quote(str(keystore.root)), None
    with suppress(SrosError):
        fleet = load_fleet(keystore)
    arguments = []
    for name in robots:
        names = {*_enclaves_named_after(keystore, name)}
        if fleet and name in fleet.robots:
            names.update(enclaves_of_robot(keystore, fleet, fleet.robots[name]))
        if names:
            arguments.append(arguments_for(keystore, sorted(names)))
    command = f"sros revoke {root} {' '.join(arguments) or 'ENCLAVE...'}"
    return (
        f"To revoke now, name the enclaves: `{command}`; `sros list_enclaves {root}` shows "
        f"whether the {'robot has' if len(robots) == 1 else 'robots have'} other enclaves. "
    )


def _possible_enclaves(
    keystore: OpenedKeystore, fleet: Fleet, robots: Sequence[str]
) -> Sequence[str]:
    """Return all enclaves that may belong to ``robots``, and perhaps other enclaves.

    Without an index of the ledger, these are all enclaves.  With an index, they are the enclaves in
    the folders of the robots, and enclaves in the ledger whose path has the name of a robot or of
    such a folder.
    """
    folders = folders_of_robots(fleet, robots)
    recorded = keystore.ledger_file.recorded_enclaves_with(*robots, *folders)
    if recorded is None:
        return keystore.names
    possible = set(recorded)
    for folder in folders:
        possible.update((folder, *enclaves_below(keystore.root, folder)))
    return sorted(name for name in possible if keystore.has_enclave(name))


def _unrecorded_notes(
    keystore: OpenedKeystore, below: list[str], naming: list[str]
) -> Iterator[Note]:
    if below:
        yield Note(
            "fleet.revoked-unrecorded",
            "Enclaves in the folder of a robot that you revoke are also revoked, although the "
            f"fleet does not record them: {_names_text(below)}.",
        )
    if naming:
        yield Note(
            "fleet.unrecorded-enclaves",
            "Enclaves whose path contains the name of a robot that you revoke are still valid: "
            f"{_names_text(naming)}. The fleet does not record which robot has their keys. If the "
            "keys were on that robot, "
            f"run `sros revoke {quote(str(keystore.root))} {arguments_for(keystore, naming)}`.",
        )


def _other_computers_notes(
    keystore: OpenedKeystore,
    fleet: Fleet | None,
    robots: Sequence[str],
    revoked: Collection[str],
) -> Iterator[Note]:
    """Yield a note on robots in the namespaces of ``robots`` that have enclaves not ``revoked``."""
    asked = [fleet.robots[name] for name in robots if name in fleet.robots] if fleet else []
    for namespace, domain in dict.fromkeys((robot.namespace, robot.domain) for robot in asked):
        assert fleet
        in_namespace = [fleet.robots[name] for name in fleet.by_namespace[namespace]]
        valid = (
            robot.name
            for robot in in_namespace
            if robot.domain == domain and {*enclaves_of_robot(keystore, fleet, robot)} - {*revoked}
        )
        if others := [*islice(valid, _MOST_SHOWN)]:
            command = f"sros revoke {quote(str(keystore.root))} --robot {' --robot '.join(others)}"
            yield Note(
                "fleet.same-namespace",
                f"The enclaves of {', '.join(others)} are still valid, and use the namespace "
                f"{namespace} of a robot that you revoke. If they are for other computers of this "
                f"robot, and somebody may have their keys, run `{command}`.",
            )


def _names_text(names: list[str]) -> str:
    return first_few(names, _MOST_SHOWN)


def _enclaves_of_robots(
    keystore: OpenedKeystore,
    robots: Sequence[str],
    checked: bool,
    unrecorded: Mapping[str, UnrecordedEnclaves],
) -> list[str]:
    if not robots:
        return []
    root = keystore.root
    fleet = checked_fleet(keystore) if checked else load_fleet(keystore)
    if fleet is None and not any(map(keystore.has, (PRIVATE, SETTINGS))):
        raise KeystoreError(
            f"'{root}' is not a keystore with a fleet, so it has no robot {robots[0]!r}",
            "An export for a robot has only the enclaves of that robot, and not the fleet.",
            "Leave --robot out, choose enclaves with --match, or name the keystore from which "
            "this folder was exported.",
        )
    if fleet is None:
        raise KeystoreError(
            f"keystore '{root}' has no fleet, so it has no robot {robots[0]!r}",
            "",
            f"Give the keystore its fleet file with `sros generate_artifacts -k {quote(str(root))} "
            "-p POLICY_FILE --fleet FILE`, or choose enclaves with --match.",
        )
    enclaves: list[str] = []
    for name in robots:
        own_enclaves = (
            enclaves_of_robot(keystore, fleet, fleet.robots[name]) if name in fleet.robots else ()
        )
        own_enclaves += unrecorded[name].below if name in unrecorded else ()
        if not own_enclaves:
            if left := _enclaves_named_after(keystore, name):
                raise KeystoreError(
                    f"the fleet in keystore '{root}' gives no enclave to a robot {name}",
                    f"The keystore has {_names_text(left)}: perhaps the robot left the fleet or a "
                    "group, or the policy writes the path without {robot}.",
                    f"Name the enclaves themselves: {arguments_for(keystore, left)}.",
                )
            fleet.robot(name)
            raise KeystoreError(
                f"the robot {name} has no enclave in keystore '{root}'",
                "",
                f"See `sros list_enclaves {quote(str(root))}`.",
            )
        enclaves += own_enclaves
    return enclaves


def _enclaves_named_after(keystore: OpenedKeystore, robot: str) -> list[str]:
    """Return the enclaves that have the name of a robot as a part of their paths."""
    return [name for name in keystore.names if robot in name.split("/")[1:]]


_MOST_SHOWN = 5
"""Maximum number of enclaves that an error names."""
_SIMILARITY = 0.75
"""Lowest similarity (`difflib`) that counts as a typo: one of four letters differs."""
_FULL_NAME_SIMILARITY = 0.9
"""Lowest similarity for a typo in a full name, because names in a namespace begin alike."""


def missing_enclave_error(
    keystore: OpenedKeystore,
    name: str,
    existing_enclaves: Collection[str],
    *,
    may_create: bool = True,
) -> SrosError:
    """Return the error for the missing enclave ``name``, with similar ``existing_enclaves``.

    Without ``may_create``, the enclave is to be revoked: the error does not suggest creating it,
    also if it was revoked, and says whether the keystore may lack certificates.
    """
    error = _missing_enclave_error(keystore, name, existing_enclaves, may_create=may_create)
    if not (may_create or _has_certificate(keystore, name)):
        error.remedy = _with_lost_certificates(keystore, error.remedy)
    return error


def _missing_enclave_error(
    keystore: OpenedKeystore, name: str, existing_enclaves: Collection[str], *, may_create: bool
) -> SrosError:
    root = keystore.root
    if revocation := revocation_of(keystore, name):
        return _revoked_enclave_error(keystore, revocation, may_create=may_create)
    missing = f"enclave {name} does not exist in keystore '{root}'"
    names = sorted(existing_enclaves)
    if below := [existing for existing in names if name and existing.startswith(f"{name}/")]:
        return KeystoreError(
            missing,
            f"There are only enclaves below it: {first_few(below, _MOST_SHOWN)}.",
            f"Name an enclave; verbs that take several enclaves also have --match '{name}/*'.",
        )
    uses = _enclaves_using(keystore, name, names)
    if of_node := uses.pop("node"):
        return KeystoreError(
            missing,
            f"{name} is a node of {first_few(of_node, _MOST_SHOWN)}.",
            f"Name the enclave: {of_node[0]}.",
        )
    kind = next(iter(uses), "")
    why = (
        f"{name} is a {kind} in the permissions of {first_few(uses[kind], _MOST_SHOWN)}."
        if kind
        else ""
    )
    if meant := likely_names(name, existing_enclaves):
        return KeystoreError(missing, why, f"Perhaps you mean {' or '.join(meant)}.")
    if kind:
        verb = "publish" if kind == "topic" else "call"
        who = f"`sros explain {quote(str(root))} --who {verb} {quote(name)}`"
        return KeystoreError(missing, why, f"Name an enclave. {who} says who may {verb} {name}.")
    try:
        check_enclave_name(name)
    except InvalidNameError as error:
        return error
    why = f"The keystore has {first_few(names, _MOST_SHOWN) or 'no enclave'}."
    if not may_create:
        return KeystoreError(missing, why, _remedy_to_revoke(keystore, name))
    if robot := folder_of_closed_robot(root):
        folder, policy = quote(str(robot)), quote(str(robot / CLOSED_POLICY))
        if not keystore.is_original and _has_folder(enclave_path(robot / CLOSED_KEYSTORE, name)):
            return KeystoreError(
                missing,
                f"'{robot / CLOSED_KEYSTORE}' has the enclave, but this export does not: perhaps "
                "the enclave belongs to another machine (--elsewhere of `sros close`).",
                f"Start its process on that machine, or run `sros close {folder} --here "
                f"{quote(name)}`.",
            )
        with suppress(SrosError):
            from sros_tool.policy.document import read_policy

            if read_policy(robot / CLOSED_POLICY).enclave(name):
                unsigned = f"{policy} has the enclave, but the change is not signed yet."
                close = f"`sros close {folder}`"
                return KeystoreError(
                    missing, unsigned, f"Run {close}, which signs the change, or says why not."
                )
        return KeystoreError(
            missing,
            why,
            f"If the name is right, write the enclave's rights into {policy}, and run `sros close "
            f"{folder}`. To learn the rights, {how_to_learn_one_process(robot)}.",
        )
    if not keystore.is_original:
        where = f"`sros distribute_key KEYSTORE {quote(name)} {quote(str(root))}`"
        return KeystoreError(
            missing, why, f"If the name is right, export the enclave with {where}."
        )
    create = f"`sros create_enclave {quote(str(root))} {quote(name)}`"
    return KeystoreError(missing, why, f"If the name is right, create the enclave with {create}.")


def _has_folder(path: Path) -> bool:
    """Return whether ``path`` is a folder; False if this user may not look."""
    with suppress(OSError):
        return path.is_dir()
    return False


def _remedy_to_revoke(keystore: OpenedKeystore, name: str) -> str:
    """Return how to revoke the certificates of an enclave that the keystore does not have."""
    root, enclave = quote(str(keystore.root)), quote(name)
    see = f"see `sros list_enclaves {root}`."
    if not keystore.has(LEDGER):
        return capitalized(see)
    try:
        keystore.ledger_with("enclave", name)
    except SrosError:  # not readable
        return capitalized(see)
    if _has_certificate(keystore, name):
        return (
            "The ledger has a certificate of the enclave, whose folder was removed. To revoke it, "
            f"create the enclave again (`sros create_enclave {root} {enclave}`), and run `sros "
            f"revoke {root} {enclave}`."
        )
    return f"Correct the name, because the ledger has no certificate of this name: {see}"


def _has_certificate(keystore: OpenedKeystore, name: str) -> bool:
    """Return whether the ledger can be read, and has a certificate of an enclave."""
    with suppress(SrosError):
        entries = keystore.ledger_with("enclave", name).entries
        return any(entry.what == "certificate" and entry.enclave == name for entry in entries)
    return False


_PERMISSION_TEXTS = {
    "node": ">rr{}/get_parametersReply<",
    "topic": ">rt{}<",
    "service": ">rq{}Request<",
    "action": ">rq{}/_action/send_goalRequest<",
}
"""Maps a kind of ROS name to the DDS topic in the permissions of enclaves that use the name."""


def _enclaves_using(
    keystore: OpenedKeystore, name: str, names: Sequence[str]
) -> dict[str, list[str]]:
    """Map kinds of names to the enclaves whose permissions use ``name`` as this kind.

    The kind "node" is always in the result.  A node belongs to the enclaves that may serve its
    parameters.
    """
    uses: dict[str, list[str]] = {"node": []}
    for enclave in names:
        with suppress(SrosError, OSError):
            document = keystore.read(keystore.folder(enclave) / PERMISSIONS_FILE, "permissions")
            for kind, topic in _PERMISSION_TEXTS.items():
                if os.fsencode(topic.format(name)) in document:  # the name may not be UTF-8
                    uses.setdefault(kind, []).append(enclave)
    return uses


def revocation_of(keystore: OpenedKeystore, name: str) -> Entry | None:
    """Return the ledger entry of an enclave's revocation; None if it has a later certificate."""
    try:
        entries = keystore.ledger_with("enclave", name).entries
    except SrosError:
        return None  # only the missing enclave is to be reported here
    of_enclave = [
        e for e in entries if e.enclave == name and e.what in ("certificate", "revocation")
    ]
    if not of_enclave or of_enclave[-1].what != "revocation":
        return None
    # A revocation has an entry for each certificate, but only one of these has files.
    kept = (e for e in reversed(of_enclave) if e.serial and keystore.has(f"{REVOKED}/{e.serial}"))
    return next(kept, of_enclave[-1])


def _revoked_enclave_error(
    keystore: OpenedKeystore, entry: Entry, *, may_create: bool
) -> SrosError:
    root = keystore.root
    again = f"sros generate_artifacts -k {quote(str(root))} -e {entry.enclave} -p POLICY_FILE"
    again += " --fleet FLEET_FILE" if (root / FLEET).exists() else ""
    remedy = f"To use it again, with another key: `{again}`."
    if not may_create:
        remedy = (
            "If the revocation list may lack its certificate, sign the list again: `sros crl "
            f"{quote(str(root))} --refresh`."
        )
    reason = "" if entry.reason in ("", "unspecified") else f" ({entry.reason})"
    folder = root / REVOKED / entry.serial
    return KeystoreError(
        f"enclave {entry.enclave} of keystore '{root}' was revoked at {entry.time}{reason}",
        f"Its files are in '{folder}'." if folder.is_dir() else "",
        remedy,
    )


def likely_names(name: str, existing_enclaves: Collection[str]) -> tuple[str, ...]:
    """Return at most three enclaves that a mistyped ``name`` may mean.

    These are the enclaves whose names end with ``name``, because people leave out the namespace. If
    there are none, the result is the enclaves whose last part is similar, or else the enclaves
    whose full name is similar.  Upper and lower case count as equal.
    """
    end = "/" + name.strip("/").lower()
    if end == "/":
        return ()
    lower = {enclave: enclave.lower() for enclave in existing_enclaves}
    similar_names = [enclave for enclave in existing_enclaves if lower[enclave].endswith(end)]
    if not similar_names:
        last = {enclave: text.rpartition("/")[2] for enclave, text in lower.items()}
        similar_names = _similar_enclaves(end.rpartition("/")[2], last, _SIMILARITY)
    return tuple(sorted(similar_names or _similar_enclaves(end, lower, _FULL_NAME_SIMILARITY))[:3])


def _similar_enclaves(text: str, texts: Mapping[str, str], least: float) -> list[str]:
    """Return the enclaves (keys of ``texts``) whose value is similar to ``text``.

    ``least`` is the lowest similarity that counts, from 0 to 1.
    """
    import difflib

    similar_texts = difflib.get_close_matches(text, set(texts.values()), n=3, cutoff=least)
    return [enclave for enclave, written in texts.items() if written in similar_texts]
