"""Whether earlier permissions of an enclave may allow what its present ones deny."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from datetime import datetime
from itertools import product
from shlex import quote

from sros_tool.errors import Note
from sros_tool.keystore.known_keys import revoked_serials
from sros_tool.keystore.layout import LEDGER
from sros_tool.keystore.ledger import Entry
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.validity import iso
from sros_tool.wording import first_few


def note_on_earlier_permissions(
    keystore: OpenedKeystore, denied: Collection[str], now: datetime
) -> Iterator[Note]:
    """Yield a note on enclaves that are ``denied`` now, if earlier permissions may allow it.

    Permissions cannot be revoked: earlier ones work with a certificate that they fit, until one of
    the two expires or the certificate is revoked.  The ledger does not have the rights of earlier
    permissions; those that were signed from the same policy as the present ones do not count.
    """
    ends: dict[str, str] = {}
    for name, entries in _issued(keystore, denied).items():
        permissions = [entry for entry in entries if entry.what == "permissions"]
        certificates = [entry for entry in entries if entry.what == "certificate"]
        for earlier, certificate in product(permissions, certificates):
            end = min(earlier.not_after, certificate.not_after)
            other = earlier.policy != permissions[-1].policy
            if other and earlier.subject == certificate.subject and end > iso(now):
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


def _issued(keystore: OpenedKeystore, names: Collection[str]) -> Mapping[str, Sequence[Entry]]:
    """Return what the ledger has of each of the enclaves, except for revoked certificates."""
    issued: defaultdict[str, list[Entry]] = defaultdict(list)
    if names and keystore.has(LEDGER):
        revoked = revoked_serials(keystore)
        for entry in keystore.ledger_file.with_values("enclave", names).entries:
            if entry.enclave in names and not (entry.serial and int(entry.serial, 16) in revoked):
                issued[entry.enclave].append(entry)
    return issued
