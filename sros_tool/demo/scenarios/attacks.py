"""The scenario of all known attacks on DDS.

The attacker is the intruder of a row.  A row that expects the attack to fail has a control: the
same listener must hear the permitted talker at the same time.  For each attack there is also a row
with ``defence_removed``, which shows that the attack succeeds without that defense: an attack that
never works would prove nothing.

Most parameters of the functions for rows are fields of `Row`.  ``attacker`` is the identity of the
attacker, and ``victims`` is the keystore of the other parties.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from sros_tool.demo import forger
from sros_tool.demo.forger import Forge, Undefended
from sros_tool.demo.scenarios.model import (
    FOREIGN,
    GUEST,
    OWN,
    SERVICE,
    UNSECURED,
    Claim,
    Condition,
    Identity,
    KeystoreChoice,
    Party,
    Relation,
    Role,
    Row,
    RowStatus,
    Scenario,
    Variant,
    Wire,
    answered,
    attacked_policy,
    hears,
    known_open,
    talker_and_listener,
    tries,
)

# ── kinds of attacks ───────────────────────────────────────────────────────────────────────
# Each function returns a row with the party "attacker".  The victims, and the controls unless
# noted, have enclaves in the keystore `victims`: by default the attacker's, if a defense is
# removed there, otherwise the scenario's own.

_ATTACKER = "attacker"

_LET_IN = (
    "the template admits unauthenticated participants, and does not protect the topic",
    "remove allow_unauthenticated_participants from the template, and encrypt the topic",
)
_UNCONTROLLED = (
    "the template does not control access to this topic",
    "switch read_access_control and write_access_control on in the template",
)


def _variants_without_defense(success: RowStatus, expected: RowStatus) -> tuple[Variant, ...]:
    """Return variants of a row that expect ``success`` if the template does not stop the attack."""
    if expected is RowStatus.REFUSED:
        return (Variant((Condition.UNCONTROLLED,), success, *_UNCONTROLLED),)
    if expected is success or expected is RowStatus.NOT_LET_IN:
        return ()
    return (Variant((Condition.UNAUTHENTICATED,), success, *_LET_IN),)


def _victims(attacker: Identity, defence_removed: str) -> KeystoreChoice:
    return attacker.keystore if defence_removed and attacker.keystore is not None else OWN


def _injection_row(
    name: str,
    attacker: Identity,
    expected: RowStatus,
    mechanism: str,
    *variants: Variant,
    defence_removed: str = "",
    victims: KeystoreChoice | None = None,
) -> Row:
    """Return a row that shows whether the attacker is heard on the topic.

    The row also has a permitted talker on the same topic, which shows that the listener can hear.
    With ``defence_removed`` (a defense is switched off), the row has no such talker.
    """
    talker, listener = talker_and_listener(victims or _victims(attacker, defence_removed))
    return Row(
        name,
        expected,
        mechanism,
        (
            Party(_ATTACKER, Role.TALKER, attacker, intruder=True),
            listener,
            *(() if defence_removed else (talker,)),
        ),
        (hears("listener", _ATTACKER).expecting(expected),),
        () if defence_removed else (hears("listener", "talker"),),
        brief=True,
        variants=(*variants, *_variants_without_defense(RowStatus.HEARD, expected)),
        defence_removed=defence_removed,
    )


def _tampered_files_row(
    name: str, expected: RowStatus, mechanism: str, victims: KeystoreChoice
) -> Row:
    """Return a row in which an unsecured attacker talks to a listener with changed files.

    The listener may fail to start; the control is another listener with unchanged files.
    """
    row = _injection_row(name, UNSECURED, expected, mechanism, victims=victims)
    attacker, listener, _ = row.parties
    talker, untouched = talker_and_listener(OWN)
    untouched = replace(untouched, name="untouched listener")
    return replace(
        row,
        parties=(attacker, replace(listener, intruder=True), untouched, talker),
        controls=(hears("untouched listener", "talker"),),
    )


def _successful_injection_row(name: str, attacker: Identity, defence_removed: str) -> Row:
    """Return a row in which the listener hears the attacker, because a defense was removed.

    The files of the attacker are valid.
    """
    mechanism = "an attacker with valid files is heard"
    return _injection_row(
        name, attacker, RowStatus.HEARD, mechanism, defence_removed=defence_removed
    )


def _listening_row(
    name: str,
    attacker: Identity,
    expected: RowStatus,
    mechanism: str,
    *,
    defence_removed: str = "",
    victims: KeystoreChoice | None = None,
) -> Row:
    """Return a row that shows whether the attacker hears the topic."""
    return Row(
        name,
        expected,
        mechanism,
        (
            Party(_ATTACKER, Role.LISTENER, attacker, intruder=True),
            *talker_and_listener(victims or _victims(attacker, defence_removed)),
        ),
        (hears(_ATTACKER, "talker").expecting(expected),),
        (hears("listener", "talker"),),
        brief=True,
        variants=_variants_without_defense(RowStatus.HEARD, expected),
        defence_removed=defence_removed,
    )


def _discovery_row(
    name: str,
    attacker: Identity,
    expected: RowStatus,
    mechanism: str,
    *variants: Variant,
    defence_removed: str = "",
    victims: KeystoreChoice = OWN,
) -> Row:
    """Return a row that shows whether the attacker discovers a publisher of the topic.

    The control is another publisher that an unsecured attacker discovers; or, if a secured attacker
    has to fail, an enclave that may listen and discovers the publisher.
    """
    others: tuple[Party, ...] = ()
    controls: tuple[Claim, ...] = ()
    if attacker.keystore is None:
        others = (Party("unsecured talker", Role.TALKER, other_topic=True),)
        controls = (Claim(Relation.SEES, _ATTACKER, "unsecured talker"),)
    elif expected is not RowStatus.VISIBLE:
        others = (Party("looking listener", Role.OBSERVER, Identity(OWN, "listener")),)
        controls = (Claim(Relation.SEES, "looking listener", "talker"),)
    talker, _ = talker_and_listener(victims)
    return Row(
        name,
        expected,
        mechanism,
        (Party(_ATTACKER, Role.OBSERVER, attacker, intruder=True), talker, *others),
        (Claim(Relation.SEES, _ATTACKER, "talker").expecting(expected),),
        controls,
        brief=True,
        variants=variants,
        defence_removed=defence_removed,
    )


def _service_party(role: Role, identity: Identity, name: str = "") -> Party:
    """Return a client or server of the service; with a ``name``, the party is the attacker."""
    return Party(name or role.value, role, identity, SERVICE, intruder=bool(name))


def _call_row(
    name: str, attacker: Identity, expected: RowStatus, mechanism: str, *, defence_removed: str = ""
) -> Row:
    """Return a row that shows whether a service answers the attacker."""
    victims = _victims(attacker, defence_removed)
    return Row(
        name,
        expected,
        mechanism,
        (
            _service_party(Role.CLIENT, attacker, _ATTACKER),
            _service_party(Role.SERVER, Identity(victims, "server")),
            _service_party(Role.CLIENT, Identity(victims, "client")),
        ),
        (answered(_ATTACKER, "server").expecting(expected),),
        (answered("client", "server"),),
        brief=True,
        variants=() if defence_removed else _variants_without_defense(RowStatus.ANSWERED, expected),
        defence_removed=defence_removed,
    )


def _false_server_row(
    name: str, attacker: Identity, expected: RowStatus, mechanism: str, *, defence_removed: str = ""
) -> Row:
    """Return a row that shows whether a client accepts answers from an attacker."""
    victims = _victims(attacker, defence_removed)
    rightful = _service_party(Role.SERVER, Identity(victims, "server"))
    return Row(
        name,
        expected,
        mechanism,
        (
            _service_party(Role.SERVER, attacker, _ATTACKER),
            _service_party(Role.CLIENT, Identity(victims, "client")),
            *(() if defence_removed else (rightful,)),
        ),
        (answered("client", _ATTACKER).expecting(expected),),
        () if defence_removed else (answered("client", "server"),),
        brief=True,
        variants=() if defence_removed else _variants_without_defense(RowStatus.ANSWERED, expected),
        defence_removed=defence_removed,
    )


# ── from the network ───────────────────────────────────────────────────────────────────────

_IN_CLEAR = Undefended(template=forger.unprotected)
_OPEN_GOVERNANCE = Undefended(forger.weaker_governance)
_STRANGERS_REFUSED = "a governance that refuses unauthenticated participants"


def _eavesdropping_row(
    name: str,
    expected: RowStatus,
    mechanism: str,
    keystore: KeystoreChoice,
    wire: Wire = Wire.TEXT,
    *,
    brief: bool = True,
) -> Row:
    """Return a row that looks for a text in the packets of a talker."""
    return Row(
        name,
        expected,
        mechanism,
        talker_and_listener(keystore),
        (Claim(Relation.READABLE, "talker", wire=wire).expecting(expected),),
        (hears("listener", "talker"),),
        wire=True,
        brief=brief,
    )


def _forged_packets_row(
    name: str, relation: Relation, expected: RowStatus, mechanism: str, keystore: KeystoreChoice
) -> Row:
    """Return a row in which a talker's packets are sent again, unchanged or changed."""
    is_repeated = relation is Relation.HEARS_AGAIN
    return Row(
        name,
        expected,
        mechanism,
        talker_and_listener(keystore),
        (Claim(relation, "listener", "talker").expecting(expected),),
        (hears("listener", "talker"),),
        replay="talker" if is_repeated else "",
        impersonate="" if is_repeated else "talker",
        brief=True,
    )


_NETWORK_ROWS: tuple[Row, ...] = (
    *tries(
        "eavesdropping on the wire",
        replace(
            _eavesdropping_row(
                "payload read on the wire",
                RowStatus.NOT_READABLE,
                "every packet with data is encrypted, with keys that only authenticated peers get",
                OWN,
                brief=False,
            ),
            variants=(
                Variant(
                    (Condition.IN_CLEAR,),
                    RowStatus.READABLE,
                    "the template does not encrypt the payload of this topic",
                    'set data = "ENCRYPT" for this topic in the template',
                ),
            ),
        ),
        replace(
            _eavesdropping_row(
                "payload read on the wire, not encrypted",
                RowStatus.READABLE,
                "with the protection kind NONE, access is controlled but nothing is encrypted",
                _IN_CLEAR,
            ),
            defence_removed="encryption",
        ),
    ),
    *tries(
        "replay of captured packets",
        replace(
            _forged_packets_row(
                "packets of a secured talker sent again",
                Relation.HEARS_AGAIN,
                RowStatus.NOT_HEARD_AGAIN,
                "each pair of participants agrees on new keys, so old packets are rejected",
                OWN,
            ),
            variants=(
                Variant(
                    (Condition.UNAUTHENTICATED, Condition.FAST),
                    RowStatus.NOT_HEARD_AGAIN,
                    mechanism=(
                        "the packets announce an identity, so Fast DDS waits until their "
                        "sender authenticates"
                    ),
                ),
                *_variants_without_defense(RowStatus.HEARD_AGAIN, RowStatus.NOT_HEARD_AGAIN),
            ),
        ),
        replace(
            _forged_packets_row(
                "packets of an unsecured talker sent again",
                Relation.HEARS_AGAIN,
                RowStatus.HEARD_AGAIN,
                "nothing in an unsecured packet proves when or by whom it was sent",
                OWN,
            ),
            parties=(Party("talker", Role.TALKER), Party("listener", Role.LISTENER)),
            defence_removed="security",
        ),
    ),
    *tries(
        "changed packets",
        replace(
            _forged_packets_row(
                "packets of a secured talker changed",
                Relation.BELIEVES,
                RowStatus.NOT_DECEIVED,
                "every packet has a message authentication code, which nobody without the keys can"
                " make",
                OWN,
            ),
            variants=(
                Variant(
                    (Condition.UNSIGNED,),
                    RowStatus.DECEIVED,
                    "the template neither signs nor encrypts the messages of this topic",
                    'set rtps = "SIGN" or "ENCRYPT" in the template, or protect this topic',
                ),
            ),
        ),
        replace(
            _forged_packets_row(
                "packets of a secured talker changed, not signed",
                Relation.BELIEVES,
                RowStatus.DECEIVED,
                "with the protection kind NONE, nothing in a packet proves who sent it",
                _IN_CLEAR,
            ),
            defence_removed="signatures and encryption",
        ),
    ),
    *tries(
        "what the handshake reveals",
        *(
            known_open(
                _eavesdropping_row(
                    f"{what} read in the handshake",
                    RowStatus.READABLE,
                    "certificates and permissions are sent unencrypted before the participants "
                    "agree on keys",
                    OWN,
                    wire,
                ),
                "DDS Security 1.1 sends certificates and permissions unencrypted",
                "do not put secrets into names, and admit only trusted machines to the network",
            )
            for what, wire in (("topic names", Wire.TOPIC), ("certificates", Wire.CERTIFICATE))
        ),
    ),
    *tries(
        "an unsecured node listens",
        _listening_row(
            "an unsecured node listens",
            UNSECURED,
            RowStatus.NOT_HEARD,
            "a node that cannot authenticate gets no keys and no messages",
        ),
        _listening_row(
            "an unsecured node listens, open governance",
            UNSECURED,
            RowStatus.HEARD,
            "the governance admits everybody and protects nothing",
            defence_removed=_STRANGERS_REFUSED,
            victims=_OPEN_GOVERNANCE,
        ),
    ),
    *tries(
        "an unsecured node lists topics",
        _discovery_row(
            "an unsecured node lists topics",
            UNSECURED,
            RowStatus.NOT_VISIBLE,
            "endpoint discovery is encrypted: the node sees no publisher of the topic",
            Variant(
                (Condition.UNAUTHENTICATED_SEE,),
                RowStatus.VISIBLE,
                "the template admits unauthenticated participants",
                "remove allow_unauthenticated_participants from the template",
            ),
        ),
        _discovery_row(
            "an unsecured node lists topics, open governance",
            UNSECURED,
            RowStatus.VISIBLE,
            "discovery is not protected, and everybody may join",
            defence_removed=_STRANGERS_REFUSED,
            victims=_OPEN_GOVERNANCE,
        ),
    ),
    *tries(
        "an unsecured node injects",
        _injection_row(
            "an unsecured node injects",
            UNSECURED,
            RowStatus.NOT_HEARD,
            "a secured listener ignores a talker that cannot authenticate",
        ),
        _injection_row(
            "an unsecured node injects, open governance",
            UNSECURED,
            RowStatus.HEARD,
            "the governance admits everybody and protects nothing",
            defence_removed=_STRANGERS_REFUSED,
            victims=_OPEN_GOVERNANCE,
        ),
    ),
    *tries(
        "an authenticated node looks around",
        known_open(
            _discovery_row(
                "an enclave without rights lists topics",
                Identity(OWN, "guest"),
                RowStatus.VISIBLE,
                "endpoints are announced to every authenticated participant",
            ),
            "DDS Security 1.1 does not hide endpoints from authenticated participants",
            "give an identity only to those who may see all endpoints of the robot",
        ),
    ),
)


# ── by an enclave that tries more than its permissions allow ───────────────────────────────

_NOT_ALLOWED = "its signed permissions do not allow the topic"
_OTHER_DIRECTION = "its signed permissions allow the topic only in the other direction"
_NEITHER_ALLOWED = "its signed permissions allow neither the request nor the reply"
_EVERY_TOPIC = "permissions for * allow every topic"
_BOTH_DIRECTIONS = "permissions for * allow both directions"


def _trespass_rows(
    make_row: Callable[..., Row],
    attack: str,
    part: str,
    mechanism: str,
    forge: Forge,
    opened: str,
) -> tuple[Row, ...]:
    """Return rows in which an enclave exceeds its rights, and control rows with wider rights.

    ``make_row`` returns a row. ``forge`` gives the enclave of the ``part`` wide permissions, and
    ``opened`` names these permissions.
    """
    unless_granted = " that it was not given" if attack.startswith("an enclave ") else ""
    done = RowStatus.ANSWERED if make_row in (_call_row, _false_server_row) else RowStatus.HEARD
    return tries(
        attack,
        make_row(f"{attack}{unless_granted}", Identity(OWN, part), RowStatus.REFUSED, mechanism),
        make_row(
            f"{attack}, wildcard permissions",
            Identity(Undefended(forge), part),
            done,
            opened,
            defence_removed="least privilege",
        ),
    )


_RIGHTS_ROWS: tuple[Row, ...] = (
    *_trespass_rows(
        _injection_row,
        "an enclave publishes a topic",
        "guest",
        _NOT_ALLOWED,
        forger.guest_may_do_everything,
        _EVERY_TOPIC,
    ),
    *_trespass_rows(
        _listening_row,
        "an enclave hears a topic",
        "guest",
        _NOT_ALLOWED,
        forger.guest_may_do_everything,
        _EVERY_TOPIC,
    ),
    *_trespass_rows(
        _injection_row,
        "a listener publishes",
        "listener",
        _OTHER_DIRECTION,
        forger.listener_may_do_everything,
        _BOTH_DIRECTIONS,
    ),
    *_trespass_rows(
        _listening_row,
        "a talker listens",
        "talker",
        _OTHER_DIRECTION,
        forger.talker_may_do_everything,
        _BOTH_DIRECTIONS,
    ),
    *_trespass_rows(
        _call_row,
        "an enclave calls a service",
        "guest",
        _NEITHER_ALLOWED,
        forger.guest_may_do_everything,
        "permissions for * allow every service",
    ),
    *_trespass_rows(
        _false_server_row,
        "a client poses as the server",
        "client",
        "its signed permissions allow requests, not replies",
        forger.client_may_do_everything,
        "permissions for * allow replies as well",
    ),
    *tries(
        "an enclave without a policy",
        _injection_row(
            "an enclave without a policy publishes",
            Identity(OWN, "newcomer"),
            RowStatus.REFUSED,
            "the template denies every topic of the robot to an enclave without a policy",
            Variant(
                (Condition.OPEN_DEFAULT,),
                RowStatus.HEARD,
                "the template allows everything to an enclave without a policy",
                "give every enclave a policy, or use the template production",
            ),
        ),
        _injection_row(
            "an enclave without a policy publishes, open default",
            Identity(Undefended(template=forger.open_default), "newcomer"),
            RowStatus.HEARD,
            "an enclave without a policy may do everything",
            defence_removed="the template's default DENY",
        ),
    ),
)

WIDEST_PUBLISHER, WIDEST_SUBSCRIBER = "widest publisher", "widest subscriber"
WIDEST_CLIENT, WIDEST_SERVER = "widest client", "widest server"
_OF_THE_WIDEST: tuple[tuple[str, Callable[..., Row], str, str, str], ...] = (
    (
        WIDEST_PUBLISHER,
        _injection_row,
        "an enclave publishes a topic",
        "publishes a topic that it was not given",
        _NOT_ALLOWED,
    ),
    (
        WIDEST_SUBSCRIBER,
        _listening_row,
        "an enclave hears a topic",
        "hears a topic that it was not given",
        _NOT_ALLOWED,
    ),
    (
        WIDEST_CLIENT,
        _call_row,
        "an enclave calls a service",
        "calls a service that it was not given",
        _NEITHER_ALLOWED,
    ),
    (
        WIDEST_SERVER,
        _false_server_row,
        "a client poses as the server",
        "poses as the server",
        "its signed permissions do not allow replies",
    ),
)
WIDEST: dict[str, Row] = {
    part: row
    for part, kind, attack, does, mechanism in _OF_THE_WIDEST
    for row in tries(
        attack,
        kind(f"the widest enclave {does}", Identity(OWN, part), RowStatus.REFUSED, mechanism),
    )
}
"""Part → attack by the enclave with the widest permissions in a user's keystore."""


def faulty_enclave_row(enclave: str, fault: str) -> Row:
    """Return a row that shows whether an enclave with faulty files can join the other enclaves.

    The talker's DDS announces endpoints only to participants that it has authenticated.
    """
    name = f"{enclave} joins the other enclaves"
    return _discovery_row(name, Identity(OWN, enclave), RowStatus.VISIBLE, fault)


def revoked_enclave_row(enclave: str, has_list: bool) -> Row:
    """Return a row that shows whether a revoked enclave can join the other enclaves.

    ``has_list`` says whether the enclave itself has the revocation list with its certificate.
    """
    return _discovery_row(
        f"{enclave}, revoked, joins the other enclaves",
        Identity(OWN, enclave),
        RowStatus.NOT_LET_IN if has_list else RowStatus.NOT_VISIBLE,
        "the keystore's revocation list contains the certificate of this enclave",
    )


# ── with certificates and keys ─────────────────────────────────────────────────────────────

_DATES_CHECKED = "before the attacker's own DDS joins, it checks the dates of the certificate"
_NO_LIST = "without crl.pem, DDS does not check for revocation"

_IDENTITY_ROWS: tuple[Row, ...] = (
    *tries(
        "identity of another CA",
        _injection_row(
            "identity of another CA",
            Identity(FOREIGN, "talker"),
            RowStatus.NOT_HEARD,
            "the listener does not trust the other CA: the handshake fails, and no keys are sent",
        ),
        _successful_injection_row(
            "identity of another CA, to a listener of that CA",
            Identity(FOREIGN, "talker"),
            "the wrong CA",
        ),
    ),
    *tries(
        "identity out of date",
        _injection_row(
            "expired identity",
            Identity(forger.expired_identity, "talker"),
            RowStatus.NOT_LET_IN,
            _DATES_CHECKED,
        ),
        _injection_row(
            "identity not yet valid",
            Identity(forger.identity_not_yet_valid, "talker"),
            RowStatus.NOT_LET_IN,
            _DATES_CHECKED,
        ),
        _successful_injection_row(
            "the same identity with the right dates",
            Identity(Undefended(forger.identity_in_date), "talker"),
            "the wrong dates",
        ),
    ),
    *tries(
        "revoked identity",
        _injection_row(
            "revoked identity",
            Identity(OWN, "talker"),
            RowStatus.NOT_HEARD,
            "the listener's crl.pem lists the certificate",
            victims=forger.talker_revoked,
        ),
        _injection_row(
            "revoked identity, list not delivered",
            Identity(Undefended(forger.talker_revocation_not_delivered), forger.STOLEN),
            RowStatus.HEARD,
            _NO_LIST,
            defence_removed="the listener's crl.pem",
        ),
    ),
    *tries(
        "key and certificate do not belong together",
        _injection_row(
            "certificate with the key of another enclave",
            Identity(forger.key_of_another_enclave, "talker"),
            RowStatus.NOT_HEARD,
            "the handshake fails if the key does not belong to the certificate",
            Variant(
                (Condition.FAST,),
                RowStatus.NOT_LET_IN,
                mechanism="the attacker's DDS compares the key with the certificate",
            ),
        ),
        _successful_injection_row(
            "certificate with its own key", Identity(Undefended(), "talker"), "the wrong key"
        ),
    ),
    *tries(
        "world-readable keys",
        _injection_row(
            "identity copied by another user of the robot",
            Identity(forger.identity_copied_by_another_user, "talker"),
            RowStatus.NOT_LET_IN,
            "the file modes deny other users the key, and without the key no node starts",
        ),
        _injection_row(
            "identity copied by another user, modes opened",
            Identity(Undefended(forger.files_readable_for_all), "talker"),
            RowStatus.HEARD,
            "no DDS checks file modes: any user that can read the key can pose as the enclave",
            defence_removed="restrictive modes of files and folders",
        ),
    ),
)


# ── with permissions and governance ────────────────────────────────────────────────────────

_SIGNED_BY_CA = Identity(Undefended(forger.permissions_signed_by_the_ca), "guest")
_SIGNED_WRONG = "the attacker's DDS verifies the signature with the permissions CA"
_UNIQUE_SUBJECTS = "unique subjects"
_ONE_CA = Variant(
    (Condition.ONE_CA,),
    RowStatus.HEARD,
    "with one CA for identity and permissions, this DDS accepts permissions that any enclave has"
    " signed (as in CVE-2023-24011)",
    "use a keystore with separate CAs (template development or production)",
)
_TRUSTED_AS_SIGNER = _injection_row(
    "permissions signed by the enclave itself, a trusted signer",
    Identity(Undefended(forger.enclave_among_the_signers), "guest"),
    RowStatus.HEARD,
    "DDS accepts every certificate in the file of the permissions CA as signer",
    defence_removed="a permissions CA file that contains only the CA",
)
_SAME_SUBJECT = _injection_row(
    "permissions borrowed, the same subject",
    Identity(Undefended(forger.borrowed_permissions_and_subject), "guest"),
    RowStatus.HEARD,
    "permissions are valid for every certificate with their subject name",
    defence_removed="a unique subject name",
)

_PERMISSIONS_ROWS: tuple[Row, ...] = (
    *tries(
        "forged permissions",
        _injection_row(
            "permissions copied from another enclave",
            Identity(forger.permissions_of_another, "guest"),
            RowStatus.NOT_LET_IN,
            "the permissions are for another subject name than the certificate's",
        ),
        *(
            _injection_row(name, Identity(forge, "guest"), RowStatus.NOT_LET_IN, _SIGNED_WRONG)
            for name, forge in (
                ("permissions edited", forger.edited_permissions),
                ("permissions unsigned", forger.unsigned_permissions),
                ("permissions signed by another CA", forger.permissions_of_another_ca),
            )
        ),
        _successful_injection_row(
            "the same permissions, signed by the permissions CA",
            _SIGNED_BY_CA,
            "the wrong permissions",
        ),
    ),
    *tries(
        "the attacker's own permissions CA",
        _injection_row(
            "the attacker's own permissions CA",
            Identity(forger.own_permissions_ca, "guest"),
            RowStatus.NOT_HEARD,
            "the attacker's DDS accepts this CA, but its peers trust only the real CA",
            Variant((Condition.FAST,), RowStatus.NOT_HEARD),
        ),
        _injection_row(
            "the attacker's own permissions CA, trusted by the listener",
            Identity(Undefended(forger.another_permissions_ca_trusted), "guest"),
            RowStatus.HEARD,
            "the listener trusts this CA, so it accepts the permissions",
            defence_removed="the listener's refusal of other permissions CAs",
        ),
    ),
    *tries(
        "permissions signed by the enclave itself",
        _injection_row(
            "permissions signed by the enclave itself",
            Identity(forger.permissions_signed_by_itself, "guest"),
            RowStatus.NOT_LET_IN,
            "DDS accepts only signers whose certificate the permissions CA issued",
            Variant(
                (Condition.EXACT_SIGNER,),
                RowStatus.NOT_LET_IN,
                mechanism="only the permissions CA itself is accepted as signer",
            ),
            _ONE_CA,
        ),
        _injection_row(
            "permissions and governance signed by the enclave",
            Identity(forger.permissions_and_governance_signed_by_itself, "guest"),
            RowStatus.NOT_HEARD,
            "the attacker changes only its own CA file; its peers verify with the real CA",
            Variant(
                (Condition.EXACT_SIGNER, Condition.CYCLONE),
                RowStatus.NOT_LET_IN,
                mechanism="Cyclone DDS 11 reads only the first CA of the file",
            ),
            Variant(
                (Condition.EXACT_SIGNER,),
                RowStatus.NOT_HEARD,
                mechanism="the attacker changes only its own CA file; its peers accept only the"
                " real CA",
            ),
            _ONE_CA,
        ),
        _injection_row(
            "permissions signed by the enclave itself, one CA",
            Identity(Undefended(forger.permissions_signed_by_itself, forger.one_ca), "guest"),
            RowStatus.HEARD,
            "Cyclone DDS 0.10 accepts every signer whose certificate the CA issued",
            Variant(
                (Condition.EXACT_SIGNER, Condition.CYCLONE),
                RowStatus.NOT_LET_IN,
                mechanism="Cyclone DDS 11 accepts only the permissions CA itself as signer",
            ),
            Variant((Condition.EXACT_SIGNER,), RowStatus.HEARD, instead=_TRUSTED_AS_SIGNER),
            defence_removed="a separate permissions CA",
        ),
    ),
    *tries(
        "permissions borrowed from a longer enclave name",
        _injection_row(
            "permissions borrowed from a longer enclave name",
            Identity(forger.borrowed_permissions, "guest"),
            RowStatus.NOT_LET_IN,
            "every subject name has a unique part, so none contains another",
            Variant(
                (Condition.FAST,),
                RowStatus.NOT_LET_IN,
                mechanism="Fast DDS compares whole subject names, and no two are equal",
            ),
            Variant(
                (Condition.SHARED_SUBJECTS, Condition.CYCLONE),
                RowStatus.HEARD,
                "Cyclone DDS 0.10 accepts permissions for a longer subject name that contains all"
                " parts of the subject name in the certificate",
                "use the template production (unique_subject), or enclave names that do not contain"
                " each other",
            ),
        ),
        _injection_row(
            "permissions borrowed, subjects not unique",
            Identity(Undefended(forger.borrowed_permissions, forger.shared_subjects), "guest"),
            RowStatus.HEARD,
            "Cyclone DDS compares parts of subject names: /guest may use the permissions of "
            "/guest/admin",
            Variant((Condition.FAST,), RowStatus.HEARD, instead=_SAME_SUBJECT),
            defence_removed=_UNIQUE_SUBJECTS,
        ),
    ),
    *tries(
        "old permissions put back",
        known_open(
            _injection_row(
                "old permissions put back",
                Identity(forger.permissions_signed_by_the_ca, "guest"),
                RowStatus.HEARD,
                "permissions that the CA has signed are valid until they expire",
            ),
            "DDS Security 1.1 cannot revoke permissions (sros2#275)",
            "after you take rights away, run `sros renew` (template production), or `sros revoke`"
            " and make a new enclave",
        ),
    ),
    *tries(
        "old permissions put back after renewal",
        _injection_row(
            "old permissions put back after renewal",
            Identity(forger.old_permissions_after_renewal, "guest"),
            RowStatus.NOT_LET_IN,
            "the renewed certificate has another subject name than the old permissions",
            Variant(
                (Condition.SHARED_SUBJECTS,),
                RowStatus.HEARD,
                "the renewed certificate has the same subject name as the old one",
                "use the template production (unique_subject), or run `sros revoke` and make a new"
                " enclave",
            ),
        ),
        _injection_row(
            "old permissions put back after renewal, subjects not unique",
            Identity(
                Undefended(forger.old_permissions_after_renewal, forger.shared_subjects), "guest"
            ),
            RowStatus.HEARD,
            "the old and new permissions are for the same subject name",
            defence_removed=_UNIQUE_SUBJECTS,
        ),
    ),
    *tries(
        "old permissions put back after revocation",
        _injection_row(
            "old permissions put back after revocation",
            Identity(forger.permissions_signed_by_the_ca, "guest"),
            RowStatus.NOT_HEARD,
            "the listener's crl.pem lists the certificate for which the permissions were signed",
            victims=forger.guest_revoked,
        ),
        _injection_row(
            "old permissions put back after revocation, list not delivered",
            Identity(Undefended(forger.guest_revocation_not_delivered), forger.STOLEN),
            RowStatus.HEARD,
            _NO_LIST,
            defence_removed="the listener's crl.pem",
        ),
    ),
    *tries(
        "permissions for another domain",
        _injection_row(
            "permissions for another domain",
            Identity(forger.permissions_for_another_domain, "guest"),
            RowStatus.NOT_LET_IN,
            "the permissions have no rule for this domain",
            Variant(
                (Condition.OPEN_JOIN, Condition.UNCONTROLLED),
                RowStatus.HEARD,
                "the template controls neither who joins the domain nor who uses the topic",
                "switch join_access_control, read_access_control and write_access_control on in the"
                " template",
            ),
            Variant(
                (Condition.FAST,),
                RowStatus.NOT_HEARD,
                mechanism="the attacker's Fast DDS starts, but its peers find no rule for the "
                "domain",
            ),
            Variant(
                (Condition.OPEN_JOIN,),
                RowStatus.REFUSED,
                "the template does not control who joins the domain",
                "switch join_access_control on in the template",
                mechanism="the attacker's DDS joins, but finds no rule for the topic in this"
                " domain",
            ),
            *_variants_without_defense(RowStatus.HEARD, RowStatus.NOT_HEARD),
            Variant(
                (Condition.UNCONTROLLED,),
                RowStatus.NOT_HEARD,
                mechanism="the attacker's DDS checks no topics; its peers find no rule for the"
                " domain",
            ),
        ),
        _discovery_row(
            "an enclave of another domain lists topics",
            Identity(forger.permissions_for_another_domain, "guest"),
            RowStatus.NOT_LET_IN,
            "the permissions have no rule for this domain",
            Variant(
                (Condition.OPEN_JOIN,),
                RowStatus.VISIBLE,
                "the template does not control who joins the domain",
                "switch join_access_control on in the template",
            ),
            Variant(
                (Condition.FAST,),
                RowStatus.NOT_VISIBLE,
                mechanism="the attacker's Fast DDS starts, but its peers find no rule for the "
                "domain",
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
                mechanism="the attacker's DDS checks no topics; its peers find no rule for the"
                " domain",
            ),
        ),
        _successful_injection_row(
            "the same permissions for this domain", _SIGNED_BY_CA, "the wrong domain"
        ),
    ),
    *tries(
        "weaker governance",
        *(
            _tampered_files_row(
                name,
                RowStatus.NOT_LET_IN,
                "the listener's DDS verifies the signature of the permissions CA",
                forge,
            )
            for name, forge in (
                ("governance edited", forger.edited_governance),
                ("governance of another CA", forger.governance_of_another_ca),
            )
        ),
        known_open(
            _tampered_files_row(
                "an older, weaker governance put back",
                RowStatus.HEARD,
                "a governance that the CA has signed never expires: it has no dates",
                forger.weaker_governance,
            ),
            "DDS Security 1.1 cannot revoke a governance document",
            "after you strengthen the governance (`sros update_keystore`), run `sros rotate_ca "
            "--permissions`: then nobody trusts the CA that signed the weaker governance",
        ),
        _injection_row(
            "weaker governance, signed by the permissions CA",
            UNSECURED,
            RowStatus.HEARD,
            "the governance admits everybody and protects nothing",
            defence_removed="the wrong signature",
            victims=_OPEN_GOVERNANCE,
        ),
    ),
)


# ── on the files and environment variables with which a process starts ─────────────────────

_ENABLE, _STRATEGY = "ROS_SECURITY_ENABLE", "ROS_SECURITY_STRATEGY"


def _misconfiguration_row(
    name: str, identity: Identity, expected: RowStatus, mechanism: str, *, defence_removed: str = ""
) -> Row:
    """Return a row that shows whether a misconfigured talker is heard by an unsecured listener."""
    return Row(
        name,
        expected,
        mechanism,
        (
            Party("misconfigured talker", Role.TALKER, identity, intruder=True),
            Party("unsecured listener", Role.LISTENER),
            Party("unsecured talker", Role.TALKER),
        ),
        (hears("unsecured listener", "misconfigured talker").expecting(expected),),
        (hears("unsecured listener", "unsecured talker"),),
        brief=True,
        variants=_variants_without_defense(RowStatus.HEARD, expected),
        defence_removed=defence_removed,
    )


def _misspelt_setting_row(
    name: str, keystore: KeystoreChoice, variable: str, value: str, why: str
) -> Row:
    """Return a row with a misspelt setting: the talker then runs unsecured."""
    identity = Identity(keystore, "talker", ((variable, value),))
    mechanism = f"{why}: the talker runs unsecured"
    return known_open(
        _misconfiguration_row(name, identity, RowStatus.HEARD, mechanism),
        "rcl knows only the spellings `true` and `Enforce`, and ignores any other value without a "
        "warning",
        "start nodes with `sros run`, which sets the variables; `sros doctor` finds wrong values",
    )


_VARIABLE_ROWS: tuple[Row, ...] = (
    *tries(
        "a file of the enclave missing",
        _misconfiguration_row(
            "a file of the enclave missing, Enforce",
            Identity(forger.missing_permissions, "talker"),
            RowStatus.NOT_LET_IN,
            "with Enforce, a node does not start if a file of its enclave is missing",
        ),
        _misconfiguration_row(
            "a file of the enclave missing, Permissive",
            Identity(
                Undefended(forger.missing_permissions), "talker", ((_STRATEGY, "Permissive"),)
            ),
            RowStatus.HEARD,
            "with Permissive, the talker runs unsecured, and everybody hears it",
            defence_removed="ROS_SECURITY_STRATEGY=Enforce",
        ),
    ),
    *tries(
        "misspelt security variables",
        _misconfiguration_row(
            "variables spelt right",
            Identity(OWN, "talker"),
            RowStatus.NOT_HEARD,
            "the talker runs secured, and sends nothing to unsecured nodes",
        ),
        _misspelt_setting_row(
            f"{_ENABLE}=True",
            OWN,
            _ENABLE,
            "True",
            "every value but 'true' switches security off",
        ),
        _misspelt_setting_row(
            f"{_STRATEGY}=enforce and a file missing",
            forger.missing_permissions,
            _STRATEGY,
            "enforce",
            "every value but 'Enforce' means Permissive",
        ),
    ),
)


ATTACKS = Scenario(
    "attacks",
    "all attacks that sros knows, also without the defenses that stop them",
    (*_NETWORK_ROWS, *_RIGHTS_ROWS, *_IDENTITY_ROWS, *_PERMISSIONS_ROWS, *_VARIABLE_ROWS),
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
