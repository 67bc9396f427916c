"""Attacks with certificates and keys: of another CA, out of date, revoked, mixed, copied."""

from __future__ import annotations

from sros_tool.demo import forger
from sros_tool.demo.forger import Undefended
from sros_tool.demo.scenarios.attacks.kinds import injection, succeeds
from sros_tool.demo.scenarios.model import (
    FOREIGN,
    OWN,
    Condition,
    Identity,
    Row,
    RowStatus,
    Variant,
)

ROWS: tuple[Row, ...] = (
    injection(
        "identity of another CA",
        Identity(FOREIGN, "talker"),
        RowStatus.NOT_HEARD,
        "the listener does not trust the other CA: the handshake fails, and no keys are sent",
        attack="identity of another CA",
    ),
    succeeds(
        "identity of another CA, to a listener of that CA",
        Identity(FOREIGN, "talker"),
        attack="identity of another CA",
        removed="a different CA",
        victims=FOREIGN,
    ),
    injection(
        "expired identity",
        Identity(forger.expired_identity, "talker"),
        RowStatus.NOT_LET_IN,
        "the attacker's DDS checks the dates of the certificate first",
        attack="identity out of date",
    ),
    injection(
        "identity not yet valid",
        Identity(forger.identity_not_yet_valid, "talker"),
        RowStatus.NOT_LET_IN,
        "the attacker's DDS checks the dates of the certificate first",
        attack="identity out of date",
    ),
    succeeds(
        "the same identity in date",
        Identity(Undefended(forger.identity_in_date), "talker"),
        attack="identity out of date",
        removed="the wrong dates",
        victims=Undefended(forger.identity_in_date),
    ),
    injection(
        "revoked identity",
        Identity(OWN, "talker"),
        RowStatus.NOT_HEARD,
        "the listener's crl.pem lists the certificate",
        attack="revoked identity",
        victims=forger.talker_revoked,
    ),
    injection(
        "revoked identity, list not delivered",
        Identity(Undefended(forger.talker_revocation_not_delivered), forger.STOLEN),
        RowStatus.HEARD,
        "without crl.pem, DDS does not check for revocation",
        attack="revoked identity",
        removed="the listener's crl.pem",
        victims=Undefended(forger.talker_revocation_not_delivered),
    ),
    injection(
        "certificate with the key of another enclave",
        Identity(forger.key_of_another_enclave, "talker"),
        RowStatus.NOT_HEARD,
        "the handshake fails if the key does not belong to the certificate",
        attack="key and certificate do not belong together",
        variants=(
            Variant(
                (Condition.FAST,),
                RowStatus.NOT_LET_IN,
                mechanism="the attacker's DDS compares the key with the certificate",
            ),
        ),
    ),
    succeeds(
        "certificate with its own key",
        Identity(Undefended(), "talker"),
        attack="key and certificate do not belong together",
        removed="the wrong key",
        victims=Undefended(),
    ),
    injection(
        "identity copied by another user of the robot",
        Identity(forger.identity_copied_by_another_user, "talker"),
        RowStatus.NOT_LET_IN,
        "the file modes deny other users the key, and without the key no node starts",
        attack="world-readable keys",
    ),
    injection(
        "identity copied by another user, modes opened",
        Identity(Undefended(forger.files_readable_for_all), "talker"),
        RowStatus.HEARD,
        "no DDS checks file modes: any user that can read the key can pose as the enclave",
        attack="world-readable keys",
        removed="the modes of files and folders",
        victims=Undefended(forger.files_readable_for_all),
    ),
)
