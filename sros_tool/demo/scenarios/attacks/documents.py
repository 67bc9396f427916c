"""Attacks with permissions: copied, edited, signed by the wrong one, borrowed, outdated."""

from __future__ import annotations

from sros_tool.demo.forger import STOLEN
from sros_tool.demo.model import UNSECURED, Case, Condition, Identity, Row, Status
from sros_tool.demo.scenarios.attacks.kinds import injection, succeeds

_ITSELF = "permissions signed by the enclave itself"
_BORROWED = "permissions borrowed from a longer name"

_TRUSTED_AS_SIGNER = injection(
    "permissions signed by the enclave itself, a trusted signer",
    Identity("trusted as signer", "guest"),
    Status.HEARD,
    "who stands in the file of the permissions CA may sign",
    attack=_ITSELF,
    removed="a file of the permissions CA that holds the CA alone",
    victims="trusted as signer",
)
_SAME_SUBJECT = injection(
    "permissions borrowed, the same subject",
    Identity("borrowed with the subject", "guest"),
    Status.HEARD,
    "two certificates of one subject fit the same permissions",
    attack=_BORROWED,
    removed="a subject of its own",
    victims="borrowed with the subject",
)
_SIGNED_WRONG = "its own DDS verifies the signature of the permissions CA"

ROWS: tuple[Row, ...] = (
    injection(
        "permissions copied from another enclave",
        Identity("permissions of another", "guest"),
        Status.NOT_LET_IN,
        "the subject of the permissions is not that of the certificate",
        attack="forged permissions",
    ),
    injection(
        "permissions edited",
        Identity("permissions edited", "guest"),
        Status.NOT_LET_IN,
        _SIGNED_WRONG,
        attack="forged permissions",
    ),
    injection(
        "permissions unsigned",
        Identity("permissions unsigned", "guest"),
        Status.NOT_LET_IN,
        _SIGNED_WRONG,
        attack="forged permissions",
    ),
    injection(
        "permissions signed by another CA",
        Identity("permissions of another CA", "guest"),
        Status.NOT_LET_IN,
        _SIGNED_WRONG,
        attack="forged permissions",
    ),
    succeeds(
        "the same permissions, signed by the permissions CA",
        Identity("signed by the CA", "guest"),
        attack="forged permissions",
        removed="the wrong signature",
        victims="signed by the CA",
    ),
    injection(
        "a permissions CA of its own",
        Identity("own permissions CA", "guest"),
        Status.NOT_HEARD,
        "its own DDS is satisfied; its peers verify its permissions with the CA that they trust",
        attack="a permissions CA of its own",
    ),
    injection(
        "a permissions CA of its own, trusted by the listener",
        Identity("another CA trusted", "guest"),
        Status.HEARD,
        "whom the permissions CA trusts is let in",
        attack="a permissions CA of its own",
        removed="the listener's permissions CA",
        victims="another CA trusted",
        crowd=False,
    ),
    *(
        injection(
            name,
            Identity(label, "guest"),
            closed,
            mechanism,
            attack=_ITSELF,
            cases=(
                Case((Condition.EXACT_SIGNER,), closed, mechanism=exact),
                Case(
                    (Condition.ONE_CA,),
                    Status.HEARD,
                    "with one CA for both jobs, this DDS takes any enclave's certificate for a"
                    " signer of permissions (the class of CVE-2023-24011)",
                    "use a keystore with separate CAs (template development or production)",
                ),
            ),
        )
        for name, label, closed, mechanism, exact in (
            (
                _ITSELF,
                "signed by itself",
                Status.NOT_LET_IN,
                "the permissions CA is on nobody's certificate path: it signs documents only",
                "Fast DDS takes no signer but the permissions CA itself",
            ),
            (
                "permissions and governance signed by itself",
                "signed by itself, own trust",
                Status.NOT_HEARD,
                "its own DDS is made to agree; its peers verify with the permissions CA",
                "its own DDS is made to agree; its peers take no signer but the permissions CA",
            ),
        )
    ),
    injection(
        "permissions signed by the enclave itself, one CA",
        Identity("one CA", "guest"),
        Status.HEARD,
        "Cyclone DDS 0.10 accepts every signer whose certificate comes from the CA",
        attack=_ITSELF,
        removed="a permissions CA of its own",
        victims="one CA",
        cases=(Case((Condition.EXACT_SIGNER,), Status.HEARD, instead=_TRUSTED_AS_SIGNER),),
    ),
    injection(
        _BORROWED,
        Identity("borrowed", "guest"),
        Status.NOT_LET_IN,
        "each subject has a part that no other has",
        attack=_BORROWED,
        cases=(
            Case(
                (Condition.FAST,),
                Status.NOT_LET_IN,
                mechanism="Fast DDS compares whole subjects, and no two of them are the same",
            ),
            Case(
                (Condition.SHARED_SUBJECTS, Condition.CYCLONE),
                Status.HEARD,
                "Cyclone DDS 0.10 takes a subject for its own that contains its parts",
                "use the template production (unique_subject), or names that do not contain others",
            ),
        ),
    ),
    injection(
        "permissions borrowed, subjects not unique",
        Identity("borrowed with shared subjects", "guest"),
        Status.HEARD,
        "Cyclone DDS compares parts of names, so those of /guest/admin fit /guest",
        attack=_BORROWED,
        removed="unique subjects",
        victims="borrowed with shared subjects",
        cases=(Case((Condition.FAST,), Status.HEARD, instead=_SAME_SUBJECT),),
    ),
    injection(
        "old permissions put back",
        Identity("old permissions", "guest"),
        Status.HEARD,
        "what the CA has signed holds until it expires",
        attack="old permissions put back",
        open_because="DDS Security 1.1 cannot revoke permissions (sros2#275)",
        remedy="after taking rights away: `sros renew` with the template production, or `sros"
        " revoke` and a new enclave",
    ),
    injection(
        "old permissions put back after renewal",
        Identity("old permissions after renewal", "guest"),
        Status.NOT_LET_IN,
        "the renewed certificate has another subject, which the old permissions do not fit",
        attack="old permissions put back after renewal",
        cases=(
            Case(
                (Condition.SHARED_SUBJECTS,),
                Status.HEARD,
                "the renewed certificate has the same subject as the old one",
                "use the template production (unique_subject), or `sros revoke` and a new enclave",
            ),
        ),
    ),
    injection(
        "old permissions put back after renewal, subjects not unique",
        Identity("renewed with shared subjects", "guest"),
        Status.HEARD,
        "the same subject fits old and new permissions",
        attack="old permissions put back after renewal",
        removed="unique subjects",
        victims="renewed with shared subjects",
    ),
    injection(
        "old permissions put back after revocation",
        Identity("old permissions", "guest"),
        Status.NOT_HEARD,
        "the listener's crl.pem names the certificate that they were signed for",
        attack="old permissions put back after revocation",
        victims="guest revoked",
    ),
    injection(
        "old permissions put back after revocation, list not delivered",
        Identity("guest's revocation not delivered", STOLEN),
        Status.HEARD,
        "who has no crl.pem knows of no revocation",
        attack="old permissions put back after revocation",
        removed="the listener's crl.pem",
        victims="guest's revocation not delivered",
    ),
    injection(
        "permissions for another domain",
        Identity("permissions for another domain", "guest"),
        Status.NOT_LET_IN,
        "no rule of the permissions is for this domain",
        attack="permissions for another domain",
        cases=(
            Case(
                (Condition.OPEN_JOIN, Condition.UNCONTROLLED),
                Status.HEARD,
                "the template controls neither who joins nor who uses the topic",
                "leave join_access_control and the access control of topics on",
            ),
            Case((Condition.OPEN_JOIN,), Status.REFUSED),
            Case(
                (Condition.FAST,),
                Status.NOT_HEARD,
                mechanism="Fast DDS lets it start; its peers find no rule for the domain",
            ),
        ),
    ),
    succeeds(
        "the same permissions for this domain",
        Identity("signed by the CA", "guest"),
        attack="permissions for another domain",
        removed="the wrong domain",
        victims="signed by the CA",
    ),
)


GOVERNANCE_ROWS: tuple[Row, ...] = (
    *(
        injection(
            label,
            UNSECURED,
            Status.NOT_LET_IN,
            "the listener's DDS verifies the signature of the permissions CA",
            attack="weaker governance",
            victims=label,
            tampered=True,
        )
        for label in ("governance edited", "governance of another CA")
    ),
    injection(
        "an older, weaker governance put back",
        UNSECURED,
        Status.HEARD,
        "what the CA has signed holds for ever: governance has no dates",
        attack="weaker governance",
        victims="old governance",
        tampered=True,
        open_because="DDS Security 1.1 cannot revoke a governance document",
        remedy="after strengthening the governance: `sros rotate_ca`, so that nobody trusts the CA"
        " that signed the weaker one",
    ),
    injection(
        "weaker governance, signed by the permissions CA",
        UNSECURED,
        Status.HEARD,
        "the listener lets everybody in",
        attack="weaker governance",
        removed="the wrong signature",
        victims="strangers allowed",
        crowd=False,
    ),
)
