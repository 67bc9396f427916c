"""Attacks with permissions and governance: edited, signed by the wrong CA, borrowed, outdated."""

from __future__ import annotations

from sros_tool.demo import forger
from sros_tool.demo.forger import Undefended
from sros_tool.demo.scenarios.attacks.kinds import discovering, injection, open_to, succeeds
from sros_tool.demo.scenarios.model import UNSECURED, Condition, Identity, Row, RowStatus, Variant

_ITSELF = "permissions signed by the enclave itself"
_BORROWED = "permissions borrowed from a longer enclave name"

_TRUSTED_AS_SIGNER = injection(
    "permissions signed by the enclave itself, a trusted signer",
    Identity(Undefended(forger.enclave_among_the_signers), "guest"),
    RowStatus.HEARD,
    "every certificate in the file of the permissions CA may sign",
    attack=_ITSELF,
    removed="a permissions CA file with only the CA in it",
    victims=Undefended(forger.enclave_among_the_signers),
)
_SAME_SUBJECT = injection(
    "permissions borrowed, the same subject",
    Identity(Undefended(forger.borrowed_permissions_and_subject), "guest"),
    RowStatus.HEARD,
    "the same permissions are valid for two certificates with one subject name",
    attack=_BORROWED,
    removed="a unique subject name",
    victims=Undefended(forger.borrowed_permissions_and_subject),
)
_SIGNED_WRONG = "the attacker's DDS verifies the signature with the permissions CA"

ROWS: tuple[Row, ...] = (
    injection(
        "permissions copied from another enclave",
        Identity(forger.permissions_of_another, "guest"),
        RowStatus.NOT_LET_IN,
        "the permissions are for another subject name than the certificate's",
        attack="forged permissions",
    ),
    injection(
        "permissions edited",
        Identity(forger.edited_permissions, "guest"),
        RowStatus.NOT_LET_IN,
        _SIGNED_WRONG,
        attack="forged permissions",
    ),
    injection(
        "permissions unsigned",
        Identity(forger.unsigned_permissions, "guest"),
        RowStatus.NOT_LET_IN,
        _SIGNED_WRONG,
        attack="forged permissions",
    ),
    injection(
        "permissions signed by another CA",
        Identity(forger.permissions_of_another_ca, "guest"),
        RowStatus.NOT_LET_IN,
        _SIGNED_WRONG,
        attack="forged permissions",
    ),
    succeeds(
        "the same permissions, signed by the permissions CA",
        Identity(Undefended(forger.permissions_signed_by_the_ca), "guest"),
        attack="forged permissions",
        removed="the wrong signature",
        victims=Undefended(forger.permissions_signed_by_the_ca),
    ),
    injection(
        "the attacker's own permissions CA",
        Identity(forger.own_permissions_ca, "guest"),
        RowStatus.NOT_HEARD,
        "the attacker's DDS accepts this CA; its peers verify with the CA that they trust",
        attack="the attacker's own permissions CA",
        variants=(Variant((Condition.FAST,), RowStatus.NOT_HEARD),),
    ),
    injection(
        "the attacker's own permissions CA, trusted by the listener",
        Identity(Undefended(forger.another_permissions_ca_trusted), "guest"),
        RowStatus.HEARD,
        "the listener accepts what the permissions CA that it trusts has signed",
        attack="the attacker's own permissions CA",
        removed="the listener's permissions CA",
        victims=Undefended(forger.another_permissions_ca_trusted),
    ),
    *(
        injection(
            name,
            Identity(forge, "guest"),
            closed,
            mechanism,
            attack=_ITSELF,
            variants=(
                Variant((Condition.EXACT_SIGNER,), closed, mechanism=exact),
                Variant(
                    (Condition.ONE_CA,),
                    RowStatus.HEARD,
                    "with one CA for identity and permissions, this DDS accepts permissions that"
                    " any enclave has signed (the class of CVE-2023-24011)",
                    "use a keystore with separate CAs (template development or production)",
                ),
            ),
        )
        for name, forge, closed, mechanism, exact in (
            (
                _ITSELF,
                forger.permissions_signed_by_itself,
                RowStatus.NOT_LET_IN,
                "no enclave's certificate comes from the permissions CA: it signs only documents",
                "Fast DDS accepts only the permissions CA itself as signer",
            ),
            (
                "permissions and governance signed by the enclave",
                forger.permissions_and_governance_signed_by_itself,
                RowStatus.NOT_HEARD,
                "the attacker changes the CA file for its DDS; its peers verify with the real CA",
                "the attacker changes the CA file for its DDS; its peers accept only the real CA",
            ),
        )
    ),
    injection(
        "permissions signed by the enclave itself, one CA",
        Identity(Undefended(forger.permissions_signed_by_itself, forger.one_ca), "guest"),
        RowStatus.HEARD,
        "Cyclone DDS 0.10 accepts every signer whose certificate comes from the CA",
        attack=_ITSELF,
        removed="a separate permissions CA",
        victims=Undefended(forger.permissions_signed_by_itself, forger.one_ca),
        variants=(Variant((Condition.EXACT_SIGNER,), RowStatus.HEARD, instead=_TRUSTED_AS_SIGNER),),
    ),
    injection(
        _BORROWED,
        Identity(forger.borrowed_permissions, "guest"),
        RowStatus.NOT_LET_IN,
        "every subject name has a unique part",
        attack=_BORROWED,
        variants=(
            Variant(
                (Condition.FAST,),
                RowStatus.NOT_LET_IN,
                mechanism="Fast DDS compares whole subject names, and no two are equal",
            ),
            Variant(
                (Condition.SHARED_SUBJECTS, Condition.CYCLONE),
                RowStatus.HEARD,
                "Cyclone DDS 0.10 accepts permissions for a longer subject with the same parts",
                "use the template production (unique_subject), or enclave names that do not contain"
                " each other",
            ),
        ),
    ),
    injection(
        "permissions borrowed, subjects not unique",
        Identity(Undefended(forger.borrowed_permissions, forger.shared_subjects), "guest"),
        RowStatus.HEARD,
        "Cyclone DDS compares parts of subject names: /guest may use what is for /guest/admin",
        attack=_BORROWED,
        removed="unique subjects",
        victims=Undefended(forger.borrowed_permissions, forger.shared_subjects),
        variants=(Variant((Condition.FAST,), RowStatus.HEARD, instead=_SAME_SUBJECT),),
    ),
    injection(
        "old permissions put back",
        Identity(forger.permissions_signed_by_the_ca, "guest"),
        RowStatus.HEARD,
        "what the CA has signed is valid until it expires",
        attack="old permissions put back",
        open_because="DDS Security 1.1 cannot revoke permissions (sros2#275)",
        remedy="after taking rights away: `sros renew` with the template production, or `sros"
        " revoke` and a new enclave",
    ),
    injection(
        "old permissions put back after renewal",
        Identity(forger.old_permissions_after_renewal, "guest"),
        RowStatus.NOT_LET_IN,
        "the renewed certificate has another subject name than the old permissions",
        attack="old permissions put back after renewal",
        variants=(
            Variant(
                (Condition.SHARED_SUBJECTS,),
                RowStatus.HEARD,
                "the renewed certificate has the same subject name as the old one",
                "use the template production (unique_subject), or `sros revoke` and a new enclave",
            ),
        ),
    ),
    injection(
        "old permissions put back after renewal, subjects not unique",
        Identity(Undefended(forger.old_permissions_after_renewal, forger.shared_subjects), "guest"),
        RowStatus.HEARD,
        "the old and new permissions are for the same subject name",
        attack="old permissions put back after renewal",
        removed="unique subjects",
        victims=Undefended(forger.old_permissions_after_renewal, forger.shared_subjects),
    ),
    injection(
        "old permissions put back after revocation",
        Identity(forger.permissions_signed_by_the_ca, "guest"),
        RowStatus.NOT_HEARD,
        "the listener's crl.pem lists the certificate for which they were signed",
        attack="old permissions put back after revocation",
        victims=forger.guest_revoked,
    ),
    injection(
        "old permissions put back after revocation, list not delivered",
        Identity(Undefended(forger.guest_revocation_not_delivered), forger.STOLEN),
        RowStatus.HEARD,
        "without crl.pem, DDS does not check for revocation",
        attack="old permissions put back after revocation",
        removed="the listener's crl.pem",
        victims=Undefended(forger.guest_revocation_not_delivered),
    ),
    injection(
        "permissions for another domain",
        Identity(forger.permissions_for_another_domain, "guest"),
        RowStatus.NOT_LET_IN,
        "the permissions have no rule for this domain",
        attack="permissions for another domain",
        variants=(
            Variant(
                (Condition.OPEN_JOIN, Condition.UNCONTROLLED),
                RowStatus.HEARD,
                "the template controls neither who joins nor who uses the topic",
                "keep join_access_control and the access control of topics on",
            ),
            Variant(
                (Condition.FAST,),
                RowStatus.NOT_HEARD,
                mechanism="Fast DDS lets it start; its peers find no rule for the domain",
            ),
            Variant(
                (Condition.OPEN_JOIN,),
                RowStatus.REFUSED,
                "the template does not control who joins the domain",
                "keep join_access_control on",
                mechanism="its DDS joins, and then finds no rule for the topic in this domain",
            ),
            *open_to(RowStatus.HEARD, RowStatus.NOT_HEARD),
            Variant(
                (Condition.UNCONTROLLED,),
                RowStatus.NOT_HEARD,
                mechanism="its DDS controls no topic; its peers find no rule for the domain",
            ),
        ),
    ),
    discovering(
        "an enclave of another domain lists topics",
        Identity(forger.permissions_for_another_domain, "guest"),
        RowStatus.NOT_LET_IN,
        "the permissions have no rule for this domain",
        attack="permissions for another domain",
        variants=(
            Variant(
                (Condition.OPEN_JOIN,),
                RowStatus.VISIBLE,
                "the template does not control who joins the domain",
                "keep join_access_control on",
            ),
            Variant(
                (Condition.FAST,),
                RowStatus.NOT_VISIBLE,
                mechanism="Fast DDS lets it start; its peers find no rule for the domain",
            ),
            Variant(
                (Condition.UNAUTHENTICATED, Condition.UNAUTHENTICATED_SEE),
                RowStatus.VISIBLE,
                "the template admits unauthenticated participants, and does not protect the topic",
                "remove allow_unauthenticated_participants from the template",
            ),
            Variant(
                (Condition.UNCONTROLLED,),
                RowStatus.NOT_VISIBLE,
                mechanism="its DDS controls no topic; its peers find no rule for the domain",
            ),
        ),
    ),
    succeeds(
        "the same permissions for this domain",
        Identity(Undefended(forger.permissions_signed_by_the_ca), "guest"),
        attack="permissions for another domain",
        removed="the wrong domain",
        victims=Undefended(forger.permissions_signed_by_the_ca),
    ),
    *(
        injection(
            name,
            UNSECURED,
            RowStatus.NOT_LET_IN,
            "the listener's DDS verifies the signature of the permissions CA",
            attack="weaker governance",
            victims=forge,
            tampered=True,
        )
        for name, forge in (
            ("governance edited", forger.edited_governance),
            ("governance of another CA", forger.governance_of_another_ca),
        )
    ),
    injection(
        "an older, weaker governance put back",
        UNSECURED,
        RowStatus.HEARD,
        "a governance that the CA has signed never expires: it has no dates",
        attack="weaker governance",
        victims=forger.weaker_governance,
        tampered=True,
        open_because="DDS Security 1.1 cannot revoke a governance document",
        remedy="after strengthening the governance (`sros update_keystore`): `sros rotate_ca "
        "--permissions`, so that nobody trusts the CA that signed the weaker one",
    ),
    injection(
        "weaker governance, signed by the permissions CA",
        UNSECURED,
        RowStatus.HEARD,
        "the governance admits everybody and protects nothing",
        attack="weaker governance",
        removed="the wrong signature",
        victims=Undefended(forger.weaker_governance),
    ),
)
