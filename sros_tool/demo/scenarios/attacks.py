"""The attacks: every way in that is known, each with a control, and once without its defence.

An attacker is an intruder in the row.  The control of a row that expects a closed door is the
rightful talker, whom the same listener hears at the same time.  A row with ``removed`` shows the
same attack succeed where the defence is gone: an attack that never works would prove nothing.
"""

from __future__ import annotations

from sros_tool.demo.forgeries import STOLEN
from sros_tool.demo.model import (
    FOREIGN,
    OWN,
    UNSECURED,
    Case,
    Claim,
    Condition,
    Identity,
    Party,
    Relation,
    Role,
    Row,
    Scenario,
    Status,
    Wire,
)
from sros_tool.demo.policies import GUEST, SERVICE, attacked_policy
from sros_tool.demo.scenarios.kinds import (
    injection,
    listening,
    looking,
    served,
    succeeds,
    with_service,
)

_ENABLE, _STRATEGY = "ROS_SECURITY_ENABLE", "ROS_SECURITY_STRATEGY"
_STRANGERS = Case(
    (Condition.STRANGERS,),
    Status.HEARD,
    "the template lets unauthenticated participants in",
    "leave out allow_unauthenticated_participants, or protect the topic",
)
_FAST_LOOKS_AT_THE_SIGNER = Case(
    (Condition.FAST,),
    Status.SKIPPED,
    skipped="Fast DDS accepts the permissions CA itself as signer only: there is nothing to remove",
)

_ON_THE_WIRE = (
    Row(
        "payload read on the wire",
        Status.NOT_READABLE,
        "every packet with data is encrypted, with keys that only authenticated peers get",
        (Party("talker", Role.TALKER, Identity(OWN, "talker")),
         Party("listener", Role.LISTENER, Identity(OWN, "listener"))),
        (Claim(Relation.READABLE, "talker", holds=False),),
        (Claim(Relation.HEARS, "listener", "talker"),),
        wire=True,
        cases=(
            Case(
                (Condition.IN_CLEAR,),
                Status.READABLE,
                "the template does not encrypt the payload of this topic",
                'set data = "ENCRYPT" for it',
            ),
        ),
        attack="eavesdropping on the wire",
    ),
    Row(
        "payload read on the wire, not encrypted",
        Status.READABLE,
        "with the protection kinds NONE, access is controlled but nothing is hidden",
        (Party("talker", Role.TALKER, Identity("in clear", "talker")),
         Party("listener", Role.LISTENER, Identity("in clear", "listener"))),
        (Claim(Relation.READABLE, "talker"),),
        (Claim(Relation.HEARS, "listener", "talker"),),
        wire=True,
        brief=True,
        attack="eavesdropping on the wire",
        removed="encryption",
    ),
    Row(
        "packets of a secured talker sent again",
        Status.NOT_HEARD_AGAIN,
        "keys are agreed on anew with each peer, so that old packets fit nobody's",
        (Party("talker", Role.TALKER, Identity(OWN, "talker")),
         Party("listener", Role.LISTENER, Identity(OWN, "listener"))),
        (Claim(Relation.HEARS_AGAIN, "listener", "talker", holds=False),),
        (Claim(Relation.HEARS, "listener", "talker"),),
        replay="talker",
        brief=True,
        attack="replay of captured packets",
    ),
    Row(
        "packets of an unsecured talker sent again",
        Status.HEARD_AGAIN,
        "nothing in a packet proves when it was sent, nor by whom",
        (Party("talker", Role.TALKER), Party("listener", Role.LISTENER)),
        (Claim(Relation.HEARS_AGAIN, "listener", "talker"),),
        (Claim(Relation.HEARS, "listener", "talker"),),
        replay="talker",
        brief=True,
        attack="replay of captured packets",
        removed="security",
    ),
    *(
        Row(
            f"{what} read in the handshake",
            Status.READABLE,
            "identity and permissions travel in clear before there are keys",
            (Party("talker", Role.TALKER, Identity(OWN, "talker")),
             Party("listener", Role.LISTENER, Identity(OWN, "listener"))),
            (Claim(Relation.READABLE, "talker", wire=wire),),
            (Claim(Relation.HEARS, "listener", "talker"),),
            wire=True,
            brief=True,
            attack="what the handshake reveals",
            open_because="DDS Security 1.1 sends certificates and permissions unencrypted",
            remedy="put no secrets into names, and keep strangers off the network",
        )
        for what, wire in (("topic names", Wire.TOPIC), ("certificates", Wire.CERTIFICATE))
    ),
)  # fmt: skip

_STRANGERS_ROWS = (
    listening(
        "an unsecured node listens",
        UNSECURED,
        Status.NOT_HEARD,
        "who cannot authenticate gets no keys, and is sent nothing",
        attack="an unsecured node listens",
        cases=(_STRANGERS,),
    ),
    listening(
        "an unsecured node listens, strangers allowed",
        UNSECURED,
        Status.HEARD,
        "the governance lets everybody in and protects nothing",
        attack="an unsecured node listens",
        removed="the governance's refusal of strangers",
        victims="strangers allowed",
    ),
    looking(
        "an unsecured node lists topics",
        UNSECURED,
        Status.NOT_VISIBLE,
        "discovery of endpoints is encrypted: it counts no publisher of the topic",
        attack="an unsecured node lists topics",
        cases=(
            Case(
                (Condition.STRANGERS,),
                Status.VISIBLE,
                "the template lets unauthenticated participants in",
                "leave out allow_unauthenticated_participants",
            ),
        ),
    ),
    looking(
        "an unsecured node lists topics, strangers allowed",
        UNSECURED,
        Status.VISIBLE,
        "discovery is not protected, and open to everybody",
        attack="an unsecured node lists topics",
        removed="the governance's refusal of strangers",
        victims="strangers allowed",
    ),
    injection(
        "an unsecured node injects",
        UNSECURED,
        Status.NOT_HEARD,
        "a listener in a closed domain ignores a talker that cannot authenticate",
        attack="an unsecured node injects",
        cases=(_STRANGERS,),
    ),
    injection(
        "an unsecured node injects, strangers allowed",
        UNSECURED,
        Status.HEARD,
        "the governance lets everybody in and protects nothing",
        attack="an unsecured node injects",
        removed="the governance's refusal of strangers",
        victims="strangers allowed",
    ),
    looking(
        "an enclave without rights lists topics",
        Identity(OWN, "guest"),
        Status.VISIBLE,
        "endpoints are announced to every authenticated participant",
        attack="an authenticated node looks around",
        open_because="DDS Security 1.1 does not hide endpoints from authenticated participants",
        remedy="give an identity to nobody who must not know what there is",
    ),
)

_BEYOND_ITS_RIGHTS = (
    injection(
        "an enclave publishes a topic that it was not given",
        Identity(OWN, "guest"),
        Status.REFUSED,
        "its signed permissions do not allow the topic",
        attack="an enclave publishes a topic",
    ),
    injection(
        "an enclave publishes a topic, wildcard permissions",
        Identity("guest may do everything", "guest"),
        Status.HEARD,
        "permissions for * allow every topic",
        attack="an enclave publishes a topic",
        removed="least privilege",
        victims="guest may do everything",
    ),
    listening(
        "an enclave hears a topic that it was not given",
        Identity(OWN, "guest"),
        Status.REFUSED,
        "its signed permissions do not allow the topic",
        attack="an enclave hears a topic",
    ),
    listening(
        "an enclave hears a topic, wildcard permissions",
        Identity("guest may do everything", "guest"),
        Status.HEARD,
        "permissions for * allow every topic",
        attack="an enclave hears a topic",
        removed="least privilege",
        victims="guest may do everything",
    ),
    injection(
        "a listener publishes",
        Identity(OWN, "listener"),
        Status.REFUSED,
        "its signed permissions allow the topic in the other direction only",
        attack="a listener publishes",
    ),
    injection(
        "a listener publishes, wildcard permissions",
        Identity("listener may do everything", "listener"),
        Status.HEARD,
        "permissions for * allow both directions",
        attack="a listener publishes",
        removed="least privilege",
        victims="listener may do everything",
    ),
    listening(
        "a talker listens",
        Identity(OWN, "talker"),
        Status.REFUSED,
        "its signed permissions allow the topic in the other direction only",
        attack="a talker listens",
    ),
    listening(
        "a talker listens, wildcard permissions",
        Identity("talker may do everything", "talker"),
        Status.HEARD,
        "permissions for * allow both directions",
        attack="a talker listens",
        removed="least privilege",
        victims="talker may do everything",
    ),
    with_service(
        "an enclave calls a service that it was not given",
        Identity(OWN, "guest"),
        Status.REFUSED,
        "its signed permissions allow neither the request nor the reply",
        attack="an enclave calls a service",
    ),
    with_service(
        "an enclave calls a service, wildcard permissions",
        Identity("guest may do everything", "guest"),
        Status.ANSWERED,
        "permissions for * allow every service",
        attack="an enclave calls a service",
        removed="least privilege",
        victims="guest may do everything",
    ),
    served(
        "a client poses as the server",
        Identity(OWN, "client"),
        Status.REFUSED,
        "its signed permissions allow to ask, not to reply",
        attack="a client poses as the server",
    ),
    served(
        "a client poses as the server, wildcard permissions",
        Identity("client may do everything", "client"),
        Status.ANSWERED,
        "permissions for * allow to reply as well",
        attack="a client poses as the server",
        removed="least privilege",
        victims="client may do everything",
    ),
    injection(
        "an enclave without a policy publishes",
        Identity(OWN, "newcomer"),
        Status.REFUSED,
        "the template gives an enclave without a policy no topic of the robot",
        attack="an enclave without a policy",
        cases=(
            Case(
                (Condition.OPEN_DEFAULT,),
                Status.HEARD,
                "the template lets an enclave without a policy do everything",
                "give every enclave a policy, or use the template production",
            ),
        ),
    ),
    injection(
        "an enclave without a policy publishes, open default",
        Identity("open default", "newcomer"),
        Status.HEARD,
        "an enclave without a policy may do everything",
        attack="an enclave without a policy",
        removed="the template's denial of what no policy allows",
        victims="open default",
    ),
)

_IDENTITIES = (
    injection(
        "identity of another CA",
        Identity(FOREIGN, "talker"),
        Status.NOT_HEARD,
        "a certificate of another CA proves nothing here: no handshake, no keys",
        attack="identity of another CA",
    ),
    succeeds(
        "identity of another CA, to a listener of that CA",
        Identity(FOREIGN, "talker"),
        attack="identity of another CA",
        removed="the difference of the CAs",
        victims=FOREIGN,
    ),
    injection(
        "expired identity",
        Identity("expired", "talker"),
        Status.NOT_LET_IN,
        "its DDS checks the dates of the certificate before anything else",
        attack="identity out of date",
    ),
    injection(
        "identity not yet valid",
        Identity("not yet valid", "talker"),
        Status.NOT_LET_IN,
        "its DDS checks the dates of the certificate before anything else",
        attack="identity out of date",
    ),
    succeeds(
        "the same identity in date",
        Identity("in date", "talker"),
        attack="identity out of date",
        removed="the wrong dates",
        victims="in date",
    ),
    injection(
        "revoked identity",
        Identity(OWN, "talker"),
        Status.NOT_HEARD,
        "the listener's crl.pem names the certificate",
        attack="revoked identity",
        victims="talker revoked",
    ),
    injection(
        "revoked identity, list not delivered",
        Identity("revocation not delivered", STOLEN),
        Status.HEARD,
        "who has no crl.pem knows of no revocation",
        attack="revoked identity",
        removed="the listener's crl.pem",
        victims="revocation not delivered",
    ),
    injection(
        "certificate with the key of another enclave",
        Identity("key of another", "talker"),
        Status.NOT_HEARD,
        "the handshake proves that the key belongs to the certificate",
        attack="key and certificate do not belong together",
        cases=(
            Case(
                (Condition.FAST,),
                Status.NOT_LET_IN,
                mechanism="its own DDS compares the key with the certificate",
            ),
        ),
    ),
    succeeds(
        "certificate with its own key",
        Identity("made", "talker"),
        attack="key and certificate do not belong together",
        removed="the wrong key",
        victims="made",
    ),
    injection(
        "identity copied by another user of the robot",
        Identity("stolen", "talker"),
        Status.NOT_LET_IN,
        "the file modes keep the key from other users, and without it nothing starts",
        attack="world-readable keys",
    ),
    injection(
        "identity copied by another user, modes opened",
        Identity("keys readable for all", "talker"),
        Status.HEARD,
        "no DDS looks at file modes: who can read the key is the enclave",
        attack="world-readable keys",
        removed="the modes of files and folders",
        victims="keys readable for all",
    ),
)

_SIGNED_WRONG = "its own DDS verifies the signature of the permissions CA"

_PERMISSIONS = (
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
            attack="permissions signed by the enclave itself",
            cases=(
                Case(
                    (Condition.ONE_CA, Condition.CYCLONE),
                    Status.HEARD,
                    "with one CA for both jobs, Cyclone DDS 0.10 takes any enclave's certificate"
                    " for a signer of permissions (the class of CVE-2023-24011)",
                    "use a keystore with separate CAs (template development or production)",
                ),
                Case(
                    (Condition.ONE_CA, Condition.FAST),
                    Status.NOT_LET_IN,
                    mechanism="Fast DDS accepts the permissions CA itself as signer only",
                ),
            ),
        )
        for name, label, closed, mechanism in (
            (
                "permissions signed by the enclave itself",
                "signed by itself",
                Status.NOT_LET_IN,
                "the permissions CA is on nobody's certificate path: it signs documents only",
            ),
            (
                "permissions and governance signed by itself",
                "signed by itself, own trust",
                Status.NOT_HEARD,
                "its own DDS is made to agree; its peers verify with the permissions CA",
            ),
        )
    ),
    injection(
        "permissions signed by the enclave itself, one CA",
        Identity("one CA", "guest"),
        Status.HEARD,
        "Cyclone DDS 0.10 accepts every signer whose certificate comes from the CA",
        attack="permissions signed by the enclave itself",
        removed="a permissions CA of its own",
        victims="one CA",
        cases=(_FAST_LOOKS_AT_THE_SIGNER,),
    ),
    injection(
        "permissions borrowed from a longer name",
        Identity("borrowed", "guest"),
        Status.NOT_LET_IN,
        "each subject has a part that no other has",
        attack="permissions borrowed from a longer name",
        cases=(
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
        attack="permissions borrowed from a longer name",
        removed="unique subjects",
        victims="borrowed with shared subjects",
        cases=(
            Case(
                (Condition.FAST,),
                Status.SKIPPED,
                skipped="Fast DDS compares whole subjects: there is nothing to remove",
            ),
        ),
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

_GOVERNANCE = (
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

_PERMISSIVE = (_STRATEGY, "Permissive")


def _in_the_open(
    name: str,
    identity: Identity,
    expected: Status,
    mechanism: str,
    *,
    attack: str,
    removed: str = "",
    open_because: str = "",
    remedy: str = "",
) -> Row:
    """Whether a talker that should be secured is heard by an unsecured listener."""
    parties = (
        Party("misled talker", Role.TALKER, identity, intruder=True),
        Party("unsecured listener", Role.LISTENER),
        Party("unsecured talker", Role.TALKER),
    )
    claim = Claim(Relation.HEARS, "unsecured listener", "misled talker").expecting(expected)
    return Row(
        name,
        expected,
        mechanism,
        parties,
        (claim,),
        (Claim(Relation.HEARS, "unsecured listener", "unsecured talker"),),
        brief=True,
        attack=attack,
        removed=removed,
        open_because=open_because,
        remedy=remedy,
    )


_VARIABLES = (
    _in_the_open(
        "a file of the enclave missing, Enforce",
        Identity("file missing", "talker"),
        Status.NOT_LET_IN,
        "with Enforce, a node without all of its files does not start",
        attack="a file of the enclave missing",
    ),
    _in_the_open(
        "a file of the enclave missing, Permissive",
        Identity("file missing, permissive", "talker", (_PERMISSIVE,)),
        Status.HEARD,
        "with Permissive, it runs unsecured, and everybody hears it",
        attack="a file of the enclave missing",
        removed="ROS_SECURITY_STRATEGY=Enforce",
    ),
    _in_the_open(
        "variables spelt right",
        Identity(OWN, "talker"),
        Status.NOT_HEARD,
        "the talker runs secured, and sends strangers nothing",
        attack="misspelt security variables",
    ),
    *(
        _in_the_open(
            f"{variable}={value}{' and a file missing' if variable == _STRATEGY else ''}",
            Identity(
                "file missing" if variable == _STRATEGY else OWN, "talker", ((variable, value),)
            ),
            Status.HEARD,
            mechanism,
            attack="misspelt security variables",
            open_because="rcl takes every other spelling for no, and a node says nothing about it",
            remedy="start nodes with `sros run`, which sets the variables; `sros doctor` finds"
            " misspelt ones",
        )
        for variable, value, mechanism in (
            (_ENABLE, "True", "anything but 'true' is off: the talker runs unsecured"),
            (_STRATEGY, "enforce", "anything but 'Enforce' is permissive: it runs unsecured"),
        )
    ),
)

ROWS: tuple[Row, ...] = (
    *_ON_THE_WIRE,
    *_STRANGERS_ROWS,
    *_BEYOND_ITS_RIGHTS,
    *_IDENTITIES,
    *_PERMISSIONS,
    *_GOVERNANCE,
    *_VARIABLES,
)

ATTACKS = Scenario(
    "attacks",
    "every known way in, tried; and each again without the defence that closes it",
    ROWS,
    {
        "talker": "/talker_listener/talker",
        "listener": "/talker_listener/listener",
        "guest": GUEST,
        "admin": f"{GUEST}/admin",
        "server": f"{SERVICE}/server",
        "client": f"{SERVICE}/client",
        "newcomer": "/talker_listener/newcomer",
    },
    attacked_policy,
    unpermitted=("/talker_listener/newcomer",),
    any_keystore=True,
)
