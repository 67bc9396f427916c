"""Whether earlier permissions of an enclave may allow what its present ones deny."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from datetime import datetime
from shlex import quote

from sros_tool.errors import Note, SrosError
from sros_tool.keystore.known_keys import IssuedEarlier
from sros_tool.keystore.layout import LEDGER
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.pki.crl import SUPERSEDED
from sros_tool.validity import iso
from sros_tool.wording import first_few


def note_on_earlier_permissions(
    keystore: OpenedKeystore, denied: Collection[str], now: datetime
) -> Iterator[Note]:
    """Yield a note on enclaves that are ``denied`` now, if earlier permissions may allow it.

    Permissions cannot be revoked: earlier ones work with a certificate that they fit, until one of
    the two expires or the certificate is revoked.  The ledger does not have the rights of earlier
    permissions; those that were signed from the same policy as the present ones do not count.  If
    the ledger or a revocation list cannot be read, or lines are missing, the note says so.
    """
    if not denied or not keystore.has(LEDGER):  # an export, or a keystore of ros2/sros2
        return
    ends: dict[str, str] = {}
    try:
        issued = IssuedEarlier(keystore, denied)
    except SrosError as error:
        yield _unknown(error.what)
        return
    if issued.ledger.gaps:
        yield _unknown(f"{LEDGER}: {first_few(issued.ledger.gaps, 1)}")
    for name in denied:
        permissions = issued.permissions(name)
        for earlier, end in permissions:
            if earlier.policy != permissions[-1][0].policy and end > iso(now):
                ends[name] = max(end, ends.get(name, ""))
    if ends:
        names, root = sorted(ends), quote(str(keystore.root))
        which = quote(names[0]) if len(names) == 1 else "ENCLAVE..."
        text = (
            f"{first_few(names, 3)}: earlier permissions, signed from another policy, may allow it "
            f"until {max(ends.values())} to whoever kept them and the key. To end that, run `sros "
            f"renew {root} {which} --revoke-old`."
        )
        yield Note("explain.earlier-permissions", text)


def note_on_revoked_enclaves(keystore: OpenedKeystore, now: datetime) -> Iterator[Note]:
    """Yield a note on revoked enclaves, which processes without the revocation list still accept.

    Only enclaves count of which a certificate and permissions have not expired.  The note does not
    say whether an enclave had the right that is asked about.
    """
    if not keystore.has(LEDGER):
        return
    try:
        revocations = keystore.ledger_with("what", "revocation").entries
        ends = {
            entry.enclave: entry.not_after
            for entry in sorted(revocations, key=lambda entry: entry.not_after)
            if entry.what == "revocation"
            and entry.reason != SUPERSEDED
            and entry.not_after > iso(now)
            and entry.enclave
            and not keystore.has_enclave(entry.enclave)
        }
        issued = keystore.ledger_file.with_values("enclave", ends).entries if ends else ()
    except SrosError as error:
        text = f"whether processes still accept revoked enclaves is not known: {error.what}."
        yield Note("explain.revoked-enclaves", f"{text} {error.remedy}".rstrip())
        return
    permissions_until: dict[str, str] = {}
    for entry in issued:
        if entry.what == "permissions" and entry.not_after > iso(now):
            last = permissions_until.get(entry.enclave, "")
            permissions_until[entry.enclave] = max(last, entry.not_after)
    names = sorted(ends.keys() & permissions_until.keys())
    if names:
        until = max(min(ends[name], permissions_until[name]) for name in names)
        text = (
            f"revoked enclaves do not count: {first_few(names, 3)}. A process without the current "
            "revocation list still accepts them, with the rights that they had, until "
            f"{until}: each process has to load the list at a restart (with a fleet, `sros fleet "
            f"status {quote(str(keystore.root))}` says where it is in force)."
        )
        yield Note("explain.revoked-enclaves", text)


def _unknown(reason: str) -> Note:
    text = f"whether earlier permissions may still allow it is not known: {reason}."
    return Note("explain.earlier-permissions", text)
