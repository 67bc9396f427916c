"""The rights that the ledger of a keystore says were last signed for its enclaves."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from shlex import quote

from sros_tool.dds.permissions import Grant
from sros_tool.errors import KeystoreError
from sros_tool.keystore.layout import SETTINGS
from sros_tool.keystore.ledger import Entry, Ledger
from sros_tool.keystore.of_ros2 import is_of_ros2
from sros_tool.keystore.reader import Keystore, as_keystore


@dataclass(frozen=True, slots=True)
class EarlierRights:
    """The rights in permissions that were signed before.

    ``policy`` is the SHA-256 of the policy that they were made from, or "" if the ledger does not
    have it.
    """

    grant: Grant
    policy: str


class RecordedRights:
    """The rights that the ledger says were last signed for each enclave.

    The signature of older permissions is as valid as ever, so whoever puts them back could have
    their rights signed again, with a new date.
    """

    def __init__(self, root: Path | Keystore, ledger: Ledger | None = None) -> None:
        keystore = as_keystore(root)
        ledger = ledger or keystore.ledger_with("what", "permissions")
        self._root = keystore.root
        self._gaps = ledger.gaps
        self._unchained = ledger.unchained
        chained = ledger.entries[ledger.unchained :]
        self._chained = {each.enclave for each in chained if each.what == "permissions"}
        # A keystore of ros2/sros2 has enclaves that no ledger records.
        self._complete = keystore.has(SETTINGS) or not (is_of_ros2(keystore) or ledger.lines)
        self._last = {each.enclave: each for each in ledger.entries if each.what == "permissions"}
        self._certain = {each.enclave for each in ledger.certain if each.what == "permissions"}

    def of(self, name: str, digest: str, grant: Grant) -> EarlierRights:
        """Return the rights in the permissions of an enclave, to sign them again.

        ``grant`` are the rights; otherwise as `policy`.
        """
        return EarlierRights(grant, self.policy(name, digest))

    def latest(self, name: str, digest: str) -> Entry | None:
        """Return the entry of permissions if they are certainly the last ones of an enclave.

        ``name`` and ``digest`` are as for `policy`.
        """
        with suppress(KeystoreError):
            self.policy(name, digest)
            return self._last.get(name)
        return None

    def unproven(self) -> dict[str, Entry]:
        """Return the last entries of enclaves that only lines from before the chain vouch for."""
        if not self._unchained:
            return {}
        return {name: each for name, each in self._last.items() if name not in self._chained}

    def policy(self, name: str, digest: str) -> str:
        """Return the SHA-256 of the policy of an enclave's permissions, or "".

        Args:
            name: the enclave.
            digest: the SHA-256 of its present permissions document, in hexadecimal.

        Raises:
            KeystoreError: it is not the last document that the ledger has for the enclave.
        """
        last, trust = self._last.get(name), ""
        if last and last.sha256 != digest:
            why = (
                f"The ledger has others, signed at {last.time}. Perhaps older ones were put back, "
                "with rights that were taken away since."
            )
        elif self._gaps and name not in self._certain:
            why = f"The ledger has gaps ({'; '.join(self._gaps)}), so later ones may be missing."
        elif self._unchained and name not in self._chained:
            why = (
                f"Nothing shows whether a line was removed from the first {self._unchained} of the "
                "ledger, so later ones may be missing."
            )
            trust = (
                " If you know that nobody else could change the ledger since version 0.1 of sros "
                f"wrote it, run `sros update_keystore {quote(str(self._root))} --trust-records`."
            )
        elif not last and self._complete:
            why = "The ledger has none for this enclave."
        else:
            return last.policy if last else ""
        raise KeystoreError(
            f"it is not certain that the permissions of enclave {name} are its latest",
            why,
            f"State its rights with `sros create_permission {quote(str(self._root))} {name} "
            "POLICY_FILE`, and "
            f"try again.{trust}",
        )
