"""What attackers make of files that they have, by name; and what is left when a defence is gone.

Each works on a copy of a keystore.  Those of `FORGERIES` leave the defences of the keystore as
they are; those of `REMOVALS` take one away, and show that the attack works then.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from sros_tool.demo import forged_governance as governance
from sros_tool.demo import forged_identities as identities
from sros_tool.demo import forged_permissions as permissions
from sros_tool.demo.bench import Bench, Forge
from sros_tool.keystore.template import EVERYTHING, Template
from sros_tool.policy.protection import Level, TopicProtection


@dataclass(frozen=True)
class Removal:
    """A forgery on a keystore whose template was ``weakened`` first."""

    forge: Forge
    weakened: Callable[[Template], Template] = lambda template: template


def _as_it_is(_bench: Bench) -> None:
    pass


def _one_ca(template: Template) -> Template:
    return replace(template, separate_authorities=False)


def _shared_subjects(template: Template) -> Template:
    return replace(template, unique_subject=False)


def _open_default(template: Template) -> Template:
    return replace(template, default_permissions=EVERYTHING)


def protected(level: Level) -> Callable[[Template], Template]:
    """Templates with access control, and with messages protected by that level everywhere.

    A payload is signed with the submessage that it is in: Fast DDS loses payloads that are signed
    by themselves (`governance.signed-payload`).
    """
    discovered = level is not Level.NONE
    payload = level if level is Level.ENCRYPT else Level.NONE

    def change(template: Template) -> Template:
        topics = TopicProtection(payload, level, discovery=discovered, liveliness=discovered)
        protection = replace(
            template.protection,
            rtps=level,
            discovery=level,
            liveliness=level,
            default=topics,
            named=(),
        )
        return replace(template, protection=protection)

    return change


in_clear = protected(Level.NONE)

FORGERIES: Mapping[str, Forge] = {
    "expired": identities.expired,
    "not yet valid": identities.not_yet_valid,
    "key of another": identities.key_of_another,
    "talker revoked": identities.talker_revoked,
    "guest revoked": identities.guest_revoked,
    "stolen": identities.stolen,
    "permissions of another": permissions.of_another,
    "permissions edited": permissions.edited,
    "permissions unsigned": permissions.unsigned,
    "permissions of another CA": permissions.signed_by_another_ca,
    "own permissions CA": permissions.own_permissions_ca,
    "signed by itself": permissions.signed_by_itself,
    "signed by itself, own trust": permissions.signed_by_itself_and_trusting_itself,
    "borrowed": permissions.borrowed,
    "old permissions": permissions.signed_by_the_ca,
    "old permissions after renewal": permissions.old_permissions_after_renewal,
    "permissions for another domain": permissions.for_another_domain,
    "file missing": permissions.file_missing,
    "governance edited": governance.governance_edited,
    "governance of another CA": governance.governance_of_another_ca,
    "old governance": governance.weaker_governance,
}

REMOVALS: Mapping[str, Removal] = {
    "made": Removal(_as_it_is),
    "in date": Removal(identities.in_date),
    "revocation not delivered": Removal(identities.not_delivered_of_the_talker),
    "guest's revocation not delivered": Removal(identities.not_delivered_of_the_guest),
    "keys readable for all": Removal(identities.readable_for_all),
    "signed by the CA": Removal(permissions.signed_by_the_ca),
    "guest may do everything": Removal(permissions.every_topic("guest")),
    "talker may do everything": Removal(permissions.every_topic("talker")),
    "listener may do everything": Removal(permissions.every_topic("listener")),
    "client may do everything": Removal(permissions.every_topic("client")),
    "another CA trusted": Removal(permissions.trusted_by_the_listener_too),
    "one CA": Removal(permissions.signed_by_itself, _one_ca),
    "trusted as signer": Removal(permissions.trusted_as_signer),
    "borrowed with the subject": Removal(permissions.borrowed_with_the_subject),
    "borrowed with shared subjects": Removal(permissions.borrowed, _shared_subjects),
    "renewed with shared subjects": Removal(
        permissions.old_permissions_after_renewal, _shared_subjects
    ),
    "open default": Removal(_as_it_is, _open_default),
    "in clear": Removal(_as_it_is, in_clear),
    "strangers allowed": Removal(governance.weaker_governance),
    "file missing, permissive": Removal(permissions.file_missing),
    "protection none": Removal(_as_it_is, in_clear),
    "protection sign": Removal(_as_it_is, protected(Level.SIGN)),
    "protection encrypt": Removal(_as_it_is, protected(Level.ENCRYPT)),
}
