"""The only writer of governance documents that are made from settings."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime

from sros_tool.dds.governance import Governance, parse_governance, render_governance
from sros_tool.errors import check_meaning
from sros_tool.keystore.authorities.authority import Authority, write_copies
from sros_tool.keystore.layout import GOVERNANCE_FILE, GOVERNANCE_P7S, GOVERNANCE_XML
from sros_tool.keystore.ledger import Entry, document_entry
from sros_tool.keystore.transaction.transaction import Transaction


def write_governance(
    transaction: Transaction,
    governance: Governance,
    permissions: Authority,
    names: Sequence[str],
    now: datetime,
) -> Entry:
    """Sign and stage the governance of a keystore; return its entry for the ledger.

    ``permissions`` is the permissions CA.  Of the enclaves ``names``, those that have a copy in
    place of the link get the new document, too.
    """
    document, what = render_governance(governance), "the governance document"
    check_meaning(parse_governance(document), governance, what)
    message = permissions.sign(document, what)
    transaction.write(GOVERNANCE_XML, document)
    transaction.write(GOVERNANCE_P7S, message)
    # The governance of the keystore itself is in the folder of the enclave /.
    below = [each for each in names if each != "/"]
    write_copies(transaction, below, GOVERNANCE_FILE, message)
    return document_entry(now, "governance", message)
