"""The security messages that DDS vendors, Zenoh, rcl and the RMWs log, and their meanings.

Fast DDS writes coloured text to standard output, Cyclone DDS writes to its log sink or to standard
error.  With ROS_SECURITY_LOG_FILE, Fast DDS writes the reasons of refusals to that file instead, in
another format.  Each text was seen in a real log of Fast DDS 2.9.1, 2.14.5 or 3.6.2
(Permissions.cpp, SecurityManager.cpp, PKIDH.cpp), Cyclone DDS 0.10.2 (access_control.c,
authentication.c, q_omg_security.c), or rcl of Jazzy.

rmw_zenoh prints warnings and errors of nodes, and also informative messages of its router;
RUST_LOG=zenoh=debug makes a process say why a connection failed, and RUST_LOG=zenoh=trace which
messages access control drops.  Each text was seen in a log of Zenoh 1.10.2; texts of
rmw_zenoh_cpp are from its source code.

To add a vendor, add its rows to `LOG_TEXTS`, the text that it puts around a reason to
`_AROUND_REASON`, and its words for writers and readers to `DIRECTIONS`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from enum import Enum, auto
from typing import NamedTuple

from sros_tool.dds.decision.vendors import Vendor
from sros_tool.faults import Fault

# ── the kinds of rows ──────────────────────────────────────────────────────────────────────


class Refused(Enum):
    """The object that DDS Security refused, according to a log message."""

    ALL_SECURITY = auto()
    """Every secured participant: DDS Security is not built in."""
    PARTICIPANT = auto()
    """The participant of the process: its files or its domain are not accepted."""
    TOPIC = auto()
    """A topic, a DataWriter or a DataReader."""


_ROS = None
"""The vendor of texts that rcl or an RMW prints, whichever DDS is used."""


class LogText(NamedTuple):
    """A text in logs, and its meaning.

    ``pattern`` is searched in a line without colours; its groups are fields such as ``path``,
    ``domain`` and ``topic``.  ``cause`` and ``remedy`` may use these fields in braces; ``cause`` is
    "" if the text alone does not show a cause.  ``faults`` are the faults of an enclave that can
    cause the text; ``unseen`` is the remedy if the enclave has none of these faults.

    ``vagueness`` is 0 for a text that names a cause, and higher for less specific texts: of all
    texts of a process, only those with the lowest value count.  ``refuses`` is None if the text
    alone does not prove that DDS Security refused something.
    """

    id: str
    vendor: Vendor | None
    pattern: re.Pattern[str]
    cause: str = ""
    remedy: str = ""
    faults: tuple[Fault, ...] = ()
    unseen: str = ""
    vagueness: int = 0
    refuses: Refused | None = None


def _log_text(
    name: str,
    vendor: Vendor | None,
    pattern: str,
    cause: str = "",
    remedy: str = "",
    faults: tuple[Fault, ...] = (),
    *,
    unseen: str = "",
    vagueness: int = 0,
    refuses: Refused | None = None,
) -> LogText:
    expression = re.compile(pattern, re.IGNORECASE)
    return LogText(name, vendor, expression, cause, remedy, faults, unseen, vagueness, refuses)


# ── the table ──────────────────────────────────────────────────────────────────────────────

_CERTIFICATE = (
    Fault.CERTIFICATE_EXPIRED,
    Fault.CERTIFICATE_NOT_YET_VALID,
    Fault.CERTIFICATE_ISSUER,
)
_CA = (Fault.CA_EXPIRED, Fault.CA_NOT_YET_VALID)
_CRL = (
    Fault.CRL_EXPIRED,
    Fault.CRL_MALFORMED,
    Fault.CRL_ISSUER,
    Fault.CRL_PARTIAL,
    Fault.CRL_NOT_YET_VALID,
    Fault.REVOKED,
)
_FILES = (
    Fault.FILE_MISSING,
    Fault.FILE_EMPTY,
    Fault.FILE_UNREADABLE,
    Fault.FILE_NO_FILE,
    Fault.LINK_DANGLING,
)
_KEY = (Fault.KEY_ENCRYPTED, Fault.KEY_MALFORMED)
_SIGNATURE = (Fault.SIGNATURE, Fault.NOT_SIGNED)
_GRANT = (Fault.PERMISSIONS_EXPIRED, Fault.PERMISSIONS_NOT_YET_VALID, Fault.PERMISSIONS_SUBJECT)
_DOCUMENT = (Fault.PERMISSIONS_MALFORMED, Fault.GOVERNANCE_MALFORMED)
_ALL_FAULTS = (
    *_CERTIFICATE, Fault.CERTIFICATE_MALFORMED, *_CA, *_CRL, *_FILES, *_KEY, Fault.KEY_MISMATCH,
    *_SIGNATURE, *_GRANT, *_DOCUMENT, Fault.GOVERNANCE_DOMAIN, Fault.PERMISSIONS_DOMAIN,
)  # fmt: skip

_EXPLAIN_REMEDY = "`sros explain KEYSTORE ENCLAVE --log LOG` finds the cause in the enclave."
_LOG_FILE_REMEDY = "If ROS_SECURITY_LOG_FILE names a file, run `sros explain --log FILE` with it."
_EXPLAIN_OR_LOG_FILE = f"{_EXPLAIN_REMEDY} {_LOG_FILE_REMEDY}"
_RENEW = "Renew the enclave: `sros renew KEYSTORE ENCLAVE`."
_SIGN = "Sign the permissions again: `sros create_permission KEYSTORE ENCLAVE POLICY`."
_SIGN_DOCUMENT = (
    f"`sros explain KEYSTORE ENCLAVE --log LOG` names the document. {_SIGN} Restore a governance "
    "from a backup: every enclave depends on it."
)
_READABLE = (
    "Allow the user that runs the node to read it, and to enter the folders above it: `ls -lL "
    "{path}`, run as that user, shows whether this works."
)
_MAKE_READABLE_FOR_USER = (
    "As the user that runs the node, run `sros check KEYSTORE`: it names what this user cannot "
    "read. If the folder is an export, give it to that user: `sudo chown -R USER KEYSTORE`. If it "
    "has the CA keys, which no node should be able to read, export the enclave into a folder of "
    "that user."
)
_SET_DOMAIN = (
    "Set ROS_DOMAIN_ID to a domain of the keystore: `sros env KEYSTORE ENCLAVE --domain ID` prints "
    "the variables."
)
_PEER = r"(?P<peer>[0-9a-f]{2}(?:\.[0-9a-f]{2}){11})\|\S*"
"""A remote participant in a line of Fast DDS; its GUID begins with a digest of its subject name."""
_PEER_OF_CYCLONE = r"remote participant (?P<peer>[0-9a-f]{1,8}(?::[0-9a-f]{1,8}){2}):\S+"
_REFUSED_PEER = rf"(?:permissions for {_PEER} \()?"
_RENEW_PEER = (
    "`sros inspect KEYSTORE` shows how long each enclave is valid, and `sros renew KEYSTORE PEER` "
    "renews the peer's enclave; then restart the peer."
)
_OTHER_SIGNER = (
    "its permissions are not signed by a permissions CA that this process has loaded. This process "
    "was not restarted since stage 1 of a rotation (`sros rotate_ca`), or the peer was not "
    "restarted since stage 2; or they have enclaves of different keystores, or a file was changed"
)
_PEERS = "Give both sides enclaves of the same keystore; `sros inspect` shows the CA of each."
_FAST, _CYCLONE = Vendor.FAST, Vendor.CYCLONE
_DENIED_ENDPOINT = (
    "the permissions deny a publisher, subscription, client or server; this message does not name "
    "the topic (`invalid allocator` has nothing to do with memory)"
)
_ASK_FOR_TOPIC = (
    "Look for an earlier line that names the topic, on standard output or in the file of "
    "ROS_SECURITY_LOG_FILE; or run the node without security, and `sros audit KEYSTORE`, which "
    "names everything that the node would be denied."
)

LOG_TEXTS: tuple[LogText, ...] = (
    # ── rcl and the RMWs ───────────────────────────────────────────────────────────────────
    _log_text(
        "not-built-in", _ROS, r"doesn't have the security libraries|compile Fast DDS using the"
        r"|-DSECURITY=ON|security (?:is )?not supported|compiled without security",
        "this DDS was built without DDS Security, so no secured node can start with it",
        "Use the ROS 2 packages of the distribution; `sros doctor` shows which DDS enforces.",
        refuses=Refused.ALL_SECURITY,
    ),
    _log_text(
        "keystore-inside", _ROS,
        r"SECURITY ERROR: directory '(?P<keystore>[^']*)/enclaves/enclaves(?:/[^']*)?' does not",
        "ROS_SECURITY_KEYSTORE names the folder `enclaves` of {keystore}, and has to name the "
        "keystore",
        "Set it to the folder of the keystore: `sros env KEYSTORE ENCLAVE` prints all variables.",
    ),
    _log_text(
        "enclave-missing", _ROS,
        r"rcl: SECURITY ERROR: directory '(?P<path>[^']*)' does not exist",
        "the enclave's folder {path} does not exist: ROS_SECURITY_KEYSTORE or the enclave's name "
        "is wrong", "Correct it: `sros list_enclaves KEYSTORE` shows the names.",
    ),
    _log_text(
        "runs-unsecured", _ROS, r"SECURITY ERROR: directory '(?P<path>[^']*)' does not exist",
        "the enclave's folder {path} does not exist, and as ROS_SECURITY_STRATEGY is not exactly "
        "Enforce, the node RUNS UNSECURED",
        "Start it with `sros run`, which runs it secured or not at all.",
    ),
    _log_text(
        "keystore-unset", _ROS, r"failed to initialize rcl: error not set",
        "security is on, and ROS_SECURITY_KEYSTORE is unset or empty",
        "Set it to the folder of the keystore: `sros env KEYSTORE ENCLAVE` prints all variables.",
    ),
    _log_text(
        "files-missing", _ROS, r"couldn't find all security files",
        "a file of the enclave is missing or a broken link; the message does not say which",
        "`sros explain KEYSTORE ENCLAVE join` names the file and the command that restores it; on "
        "a robot, export the enclave again.", _FILES,
        refuses=Refused.PARTICIPANT,
    ),
    _log_text(
        "file-unreadable", _ROS,
        r"filesystem error: [\w ]{1,40}: Permission denied "
        r"\[(?P<path>[^\]]*/(?:key\.p11|[a-z_.]+\.(?:pem|p7s)))\]",
        "the user that runs this process may not read {path}, or enter one of the folders above it",
        _MAKE_READABLE_FOR_USER,
    ),
    _log_text(
        "enclave-missing", _ROS,
        r"SECURITY ERROR: unable to find a folder matching the (?:\w+ )?name '(?P<path>[^']*)'",
        "the keystore has no folder for the enclave {path}",
        "Correct the name: `sros list_enclaves KEYSTORE` shows all names.",
    ),
    _log_text(
        "not-started", _ROS, r"Unable to (?:run the command|print the environment): (?P<why>.+)",
        "sros did not start the process: {why}",
        "Repair what the line names, and start the process again.",
    ),
    # ── Cyclone DDS, meeting peers ─────────────────────────────────────────────────────────
    _log_text(
        "peer-refused", _CYCLONE, r"(?:Begin|Process) handshake (?:request |reply )?failed: "
        r"Certificate not valid: error: (?P<why>[^;]+)",
        "a PEER was refused, not this process: its certificate is not accepted ({why}); if the CAs "
        "differ, the peer logs the same message or nothing",
        _PEERS,
    ),
    _log_text(
        "peer-handshake", _CYCLONE, r"(?:Begin|Process) handshake (?:request |reply )?failed"
        r"|FSM: handshake (?:failed|timeout)|handshake \(lguid=\S+ rguid=\S+\) failed",
        "a PEER failed to authenticate: most often its key.pem is not the key of its cert.pem, "
        "which Cyclone DDS does not check for its own enclave; or it runs another DDS or version",
        "Run `sros verify` or `sros inspect` on the enclave of every peer.", (Fault.KEY_MISMATCH,),
    ),
    _log_text(
        "peer-governance", _CYCLONE, r"security_attributes mismatch",
        "a PEER was refused: its governance has other protection than the governance of this "
        "process. The processes have enclaves of different keystores, or one was started before "
        "the governance changed",
        f"{_PEERS} It also shows the governance. Export the enclaves again, and restart both "
        "processes.",
    ),
    _log_text(
        "peer-unsecured", _CYCLONE, r"Non secure remote (?:reader|writer) \S+ is not allowed"
        r"|from unauthenticated participant|downgrade participant \S+ to non-secure",
        "a PEER was refused: it runs without DDS Security, or is not authenticated yet",
        "Start the peer in its enclave: `sros run KEYSTORE ENCLAVE -- COMMAND`.",
    ),
    _log_text(
        "peer-permissions", _CYCLONE, rf"{_PEER_OF_CYCLONE} permissions from plugin: "
        r"Permissions validity period (?:expired|has not started)",
        "a PEER was refused: by the clock of this host its permissions have expired or are not "
        "valid yet", _RENEW_PEER,
    ),
    _log_text(
        "peer-signature", _CYCLONE,
        rf"{_PEER_OF_CYCLONE} permissions from plugin: .*(?:PKCS7|SMIME)",
        f"a PEER was refused: {_OTHER_SIGNER}",
        "Restart all processes together after stage 2 of `sros rotate_ca`. If this continues: "
        f"{_PEERS}",
    ),
    _log_text(
        "peer-refused", _CYCLONE, rf"{_PEER_OF_CYCLONE} permissions from plugin: (?P<why>\w.+)",
        "a PEER was refused, not this process: its permissions are not accepted ({why})", _PEERS,
    ),
    # ── Cyclone DDS, starting ──────────────────────────────────────────────────────────────
    _log_text(
        "plugin", _CYCLONE, r"Could not load (?:Authentication|Access Control|Cryptographic|"
        r"security)\b|Could not find the function: \S+|security plugin (?:library path|init "
        r"function|finalize function) is undefined"
        r"|Error occurred while initializing [\w ]{1,40} plugin",
        "a plugin of DDS Security (authentication, access control, cryptography) cannot be loaded, "
        "so no secured process starts",
        "Install Cyclone DDS with its plugins, as the distribution packages it; `sros doctor` "
        "shows whether it enforces.",
    ),
    _log_text(
        "property", _CYCLONE, r"required security property (?P<property>\S+) missing",
        "the program secures its participant without naming {property}",
        "Start it through an RMW of ROS 2, in an enclave: `sros run KEYSTORE ENCLAVE -- COMMAND`.",
    ),
    _log_text(
        "certificate-expired", _CYCLONE, r"Certificate not valid: error: certificate has expired",
        "the certificate of the enclave or of its identity CA has expired; the message "
        "does not say which",
        _RENEW, (Fault.CERTIFICATE_EXPIRED, Fault.CA_EXPIRED),
    ),
    _log_text(
        "certificate-not-yet-valid", _CYCLONE, r"Certificate not valid: error: certificate is not "
        r"yet valid", "the certificate of the enclave or of its identity CA is not valid yet",
        "Set the clock of the host.", (Fault.CERTIFICATE_NOT_YET_VALID, Fault.CA_NOT_YET_VALID),
    ),
    _log_text(
        "certificate-issuer", _CYCLONE, r"Certificate not valid: error: unable to get "
        r"(?:local )?issuer certificate|Certificate not valid: error: self.signed",
        "the certificate was not issued by the identity CA next to it",
        "Use the files of one keystore together.", (Fault.CERTIFICATE_ISSUER,),
    ),
    _log_text(
        "revoked", _CYCLONE, r"Certificate not valid: error: certificate revoked",
        "the certificate of the enclave is revoked",
        "Revoked enclaves are refused on purpose. To use the enclave again, create it with a new "
        "key: `sros create_enclave KEYSTORE ENCLAVE`.",
        (Fault.REVOKED,),
    ),
    _log_text(
        "crl-expired", _CYCLONE, r"Certificate not valid: error: CRL (?:has expired|is not yet)",
        "the CRL has expired or is not valid yet, so that every participant is refused",
        "Sign it again: `sros crl KEYSTORE --refresh`.",
        (Fault.CRL_EXPIRED, Fault.CRL_NOT_YET_VALID),
    ),
    _log_text(
        "crl-unreadable", _CYCLONE, r"Failed to read CRL",
        "crl.pem is not a CRL, so that every participant is refused",
        "Sign it again: `sros crl KEYSTORE --refresh`.", (Fault.CRL_MALFORMED,),
    ),
    _log_text(
        "key-encrypted", _CYCLONE, r"Failed to parse certificate: .*(?:bad decrypt|empty password)",
        "key.pem is encrypted, and DDS does not ask for a passphrase (the message wrongly says "
        "certificate)",
        "Store key.pem without a passphrase, mode 0600.", (Fault.KEY_ENCRYPTED,),
    ),
    _log_text(
        "pem-unreadable", _CYCLONE, r"Failed to parse (?:certificate|private key)"
        r"|Certificate is invalid: ",
        "a certificate or key.pem is not a PEM file (the message says certificate for all)",
        "Restore the file.", (Fault.CERTIFICATE_MALFORMED, *_KEY, *_FILES),
    ),
    _log_text(
        "signature", _CYCLONE, r"PKCS7_signatureVerify:digest failure",
        "governance.p7s or permissions.p7s was changed after it was signed",
        _SIGN_DOCUMENT, _SIGNATURE,
    ),
    _log_text(
        "signer", _CYCLONE, r"PKCS7_verify:certificate verify error",
        "governance.p7s or permissions.p7s was signed by another CA than the permissions CA "
        "next to it", f"Use the files of one keystore together. {_SIGN_DOCUMENT}", _SIGNATURE,
    ),
    _log_text(
        "not-signed", _CYCLONE, r"SMIME_read_ASN1_ex:no content type|SMIME_read_ASN1",
        "governance.p7s or permissions.p7s is plain XML or damaged, and not a signed document",
        _SIGN_DOCUMENT, _SIGNATURE,
    ),
    _log_text(
        "permissions-expired", _CYCLONE, r"Permissions validity period expired(?P<when>[^)]*\))?",
        "the permissions have expired", _RENEW, (Fault.PERMISSIONS_EXPIRED,),
    ),
    _log_text(
        "permissions-not-yet-valid", _CYCLONE, r"Permissions validity period has not started",
        "the permissions are not valid yet", "Set the clock of the host.",
        (Fault.PERMISSIONS_NOT_YET_VALID,),
    ),
    _log_text(
        "permissions-subject", _CYCLONE, r"Subject name is invalid",
        "the permissions have no grant for the subject of this certificate: they belong to another "
        "enclave, or to an earlier certificate", _SIGN, (Fault.PERMISSIONS_SUBJECT,),
    ),
    _log_text(
        "domain", _CYCLONE, r"Could not find domain (?P<domain>\d{1,9}) in governance",
        "the governance is not for domain {domain}",
        _SET_DOMAIN, (Fault.GOVERNANCE_DOMAIN,),
        refuses=Refused.PARTICIPANT,
    ),
    _log_text(
        "malformed", _CYCLONE, r"Can not parse (?P<what>governance|permissions) file",
        "Cyclone DDS does not accept the {what} document, although it is signed correctly",
        "Generate it with sros; `sros check` reports what vendors read differently.",
        _DOCUMENT,
    ),
    _log_text(
        "file-missing", _CYCLONE, r"File could not be found, opened or is empty, path: "
        r"(?P<path>\S+)",
        "the file {path} is missing, empty or not readable", "Restore it.", _FILES,
    ),
    _log_text(
        "peer-refused", _CYCLONE, r"Remote secure participant \S+ not allowed"
        r"|Plugin does not allow remote participant|Could not authenticate_peer_credential_token"
        r"|Could not get remote participant \S+ permissions",
        "a PEER was refused, not this process; another line, of this process or of the peer, says "
        "why", _PEERS, vagueness=1,
    ),
    _log_text(
        "participant", _CYCLONE, r"rmw_create_node: failed to create (?:DomainParticipant|domain)",
        "the process could not join its domain, and this line does not say whether DDS Security, "
        "the network interface or the domain is the reason: Cyclone DDS says it in an earlier "
        "line, on standard error", _EXPLAIN_REMEDY, _ALL_FAULTS, vagueness=2,
    ),
    # ── Fast DDS, meeting peers ────────────────────────────────────────────────────────────
    _log_text(
        "peer-permissions-ca", _FAST,
        rf"{_REFUSED_PEER}Remote participant PermissionsCA differs from local",
        "a PEER was refused: it has another permissions CA than this process. The processes have "
        "enclaves of different keystores, or one was started before the CA was replaced and the "
        "other after it",
        _PEERS + " Restart both after each stage of `sros rotate_ca KEYSTORE`.",
    ),
    _log_text(
        "peer-version", _FAST, r"Remote participant PermissionsCA algorithm differs from local",
        "a PEER was refused: it runs another version of Fast DDS, or its permissions CA has "
        "another type of key", "Run one version of Fast DDS on all hosts of the robot.",
    ),
    _log_text(
        "peer-permissions", _FAST,
        rf"{_REFUSED_PEER}Remote participant doesn't found in its permissions file",
        "a PEER was refused: by the clock and the time zone of this host its permissions have "
        "expired or are not valid yet, or they have no grant for its certificate",
        "Compare clocks and time zones of both hosts: Fast DDS reads dates in local time. "
        f"{_RENEW_PEER}",
    ),
    _log_text(
        "peer-signature", _FAST, rf"{_REFUSED_PEER}Cannot read as PKCS7 the permissions file",
        f"a PEER was refused: {_OTHER_SIGNER}",
        f"Restart this process, and then the peer. If this continues: {_PEERS}",
    ),
    _log_text(
        "peer-malformed", _FAST,
        r"Error validating remote permissions for \S+ \(Malformed permissions file",
        "a PEER was refused: Fast DDS does not accept its permissions, although signed correctly",
        "Generate them again with sros: `sros create_permission KEYSTORE ENCLAVE POLICY`.",
    ),
    _log_text(
        "peer-domain", _FAST, r"Error checking remote participant"
        r"|Not found a rule allowing to use the domain_id.*check_remote_participant"
        r"|check_remote_participant.*Not found a rule allowing to use the domain_id",
        "a PEER was refused: its permissions are not for this domain",
        "Sign the peer's permissions again, with this domain: `sros create_permission KEYSTORE "
        "ENCLAVE POLICY` takes the domains of the keystore.",
    ),
    _log_text(
        "peer-refused", _FAST, r"Error validating remote permissions for"
        r"|Remote participant doesn't sent the signed permissions|Not receive remote permissions",
        "a PEER was refused, not this process: its permissions did not arrive or were not accepted",
        _PEERS,
    ),
    _log_text(
        "crypto", _FAST, r"\[SECURITY_CRYPTO (?:Error|Warning)\]|EVP_(?:De|En)crypt|AESGCMGMAC"
        r"|(?:Invalid|Malformed) Crypto(?:Token|Handle)|in fastcdr trying to (?:de)?"
        r"(?:serialize|cipher)",
        "a message of a peer could not be decrypted or verified: one side restarted, or has "
        "another governance, or a packet was damaged or forged",
        f"If this continues, restart both sides. {_PEERS}",
    ),
    _log_text(
        "peer-governance", _FAST, r"Security manager returns an error for (?:reader|writer)",
        "a publisher or subscription of a PEER was refused. Without another line with the reason, "
        "the governance of the peer protects the topic differently: the processes have enclaves "
        "of different keystores, or one was started before the governance changed",
        "`sros check KEYSTORE OTHER`, with the keystore or export of the peer, names the topic. "
        "Export the enclaves of both processes again, from the same keystore, and restart both "
        "processes.", vagueness=1,
    ),
    # ── Fast DDS, starting ─────────────────────────────────────────────────────────────────
    _log_text(
        "identity", _FAST, r"SECURITY\s*Error\]\s*->\s*Function validate_local_identity"
        r"|PKIDH::validate_local_identity :\s*\Z",
        "the identity is refused, and the message gives no reason: the certificate or its CA is "
        "out of date, from another CA, damaged or revoked, or crl.pem is out of date or damaged",
        _EXPLAIN_REMEDY, (*_CERTIFICATE, Fault.CERTIFICATE_MALFORMED, *_CA, *_CRL),
    ),
    _log_text(
        "ca", _FAST, r"Error '(?P<number>\d+)' verifying CA certificate"
        r"(?: for \S.*?: (?P<why>[a-z][\w ,()-]*?))?(?= \(\S+:\d+\)|\Z)",
        "the first certificate of a CA's file is not accepted (OpenSSL's error {number}: {why})",
        _EXPLAIN_REMEDY, (*_CA, Fault.CERTIFICATE_MALFORMED),
        refuses=Refused.PARTICIPANT,
    ),
    _log_text(
        "key-mismatch", _FAST, r"Error verifying private key",
        "key.pem is not the key of cert.pem",
        "Restore the key, or give the enclave a new one: `sros renew KEYSTORE ENCLAVE --new-key`.",
        (Fault.KEY_MISMATCH,),
        refuses=Refused.PARTICIPANT,
    ),
    _log_text(
        "token", _FAST, r"Error opening the private key \w+=|Error retrieving 'pkcs11' engine"
        r"|Error initializing the HSM provider library|Error setting the PIN in the 'pkcs11'",
        "the key is on a PKCS#11 token that Fast DDS cannot use: the token, OpenSSL's engine "
        "(libengine-pkcs11-openssl), its module or the PIN is missing or wrong",
        "`sros verify DIR --tokens` asks the token for the key.", (Fault.TOKEN_URI,),
        refuses=Refused.PARTICIPANT,
    ),
    _log_text(
        "key-unreadable", _FAST, r"Error obtaining private key",
        "key.pem is encrypted, damaged or empty", "Store it as PEM without a passphrase.",
        (*_KEY, *_FILES),
        refuses=Refused.PARTICIPANT,
    ),
    _log_text(
        "file-missing", _FAST, r"OpenSSL library cannot read file (?P<path>\S+)",
        "the file {path} is missing or not readable", _READABLE, _FILES, unseen=_READABLE,
    ),
    _log_text(
        "file-missing", _FAST, r"Cannot (?:read|find) file file://(?P<path>\S+)",
        "the file {path} is missing or not readable", _READABLE, _FILES, unseen=_READABLE,
    ),
    _log_text(
        "signature", _FAST, r"PKCS7 data verification failed",
        "governance.p7s or permissions.p7s was changed, or signed by another CA than the "
        "permissions CA next to it; the message does not say which",
        _SIGN_DOCUMENT, _SIGNATURE,
        refuses=Refused.PARTICIPANT,
    ),
    _log_text(
        "not-signed", _FAST, r"Input data has not PKCS7 S/MIME format",
        "governance.p7s or permissions.p7s is not a signed document: plain XML, or damaged; the "
        "message does not say which", _SIGN_DOCUMENT, _SIGNATURE,
        refuses=Refused.PARTICIPANT,
    ),
    _log_text(
        "grant", _FAST, r"Not found the identity subject name in permissions file",
        "one of three causes: the permissions have expired, are not valid yet, or have no grant "
        "for this subject name. Fast DDS reads their dates in the local time of the host",
        _EXPLAIN_REMEDY, _GRANT,
        refuses=Refused.PARTICIPANT,
    ),
    _log_text(
        "domain-of-permissions", _FAST, r"Not found a rule allowing to use the domain_id",
        "the permissions are not for the domain of this process", _SET_DOMAIN,
        (Fault.PERMISSIONS_DOMAIN,),
        refuses=Refused.PARTICIPANT,
    ),
    _log_text(
        "domain", _FAST, r"Not found topic access rule for topic (?P<topic>[^\s)]+)",
        "the governance has no rule for the topic in the domain of this process: most often "
        "because it does not list that domain (ROS_DOMAIN_ID)", _SET_DOMAIN,
        (Fault.GOVERNANCE_DOMAIN,),
        refuses=Refused.TOPIC,
    ),
    _log_text(
        "malformed", _FAST, r"Malformed (?P<what>permissions|governance) file"
        r"|Error loading (?:Permissions|Governance) XML|XMLPARSER\s*Error\].*Function "
        r"parse_(?:grant|rule|criteria|permissions|domain|topic|participant|governance)",
        "Fast DDS does not accept a document, although it is signed correctly",
        "Generate it with sros; `sros check` reports what vendors read differently.",
        _DOCUMENT,
        refuses=Refused.PARTICIPANT,
    ),
    _log_text(
        "partition", _FAST, r"partition not found in rule",
        "a rule names the topic, but not the partitions of this publisher or subscriber",
        "Leave partitions out of permissions; sros never writes them.",
        refuses=Refused.TOPIC,
    ),
    _log_text(
        "endpoint-gone", _FAST, r"Cannot find (?:local|remote) (?:reader|writer|participant)\b",
        "a message could not be protected, because its writer, its reader or the peer is not known "
        "yet or has just gone: seen when a process starts or ends",
        "Do nothing if it stops. If this continues, restart the process and its peers.",
        vagueness=1,
    ),
    # ── messages that follow others ────────────────────────────────────────────────────────
    _log_text(
        "plugin-unset", _FAST, r"Authentication plugin not configured. Security will be disabled",
        "the process RUNS UNSECURED: it has no enclave",
        "Start it with `sros run KEYSTORE ENCLAVE -- COMMAND`, secured or not at all.",
    ),
    _log_text(
        "participant", _FAST, r"Error while configuring security plugin"
        r"|Participant is not allowed with its own permissions file"
        r"|SecurityManager::init :\s*\Z|Cryptography plugin not configured",
        "the process may not join; Fast DDS 2.14 gives the reason in another line, or in the file "
        "of ROS_SECURITY_LOG_FILE, and neither is in this log", _EXPLAIN_OR_LOG_FILE, _ALL_FAULTS,
        unseen=_LOG_FILE_REMEDY, vagueness=1,
    ),
    _log_text(
        "participant", _FAST, r"Cannot create participant due to initialization error"
        r"|Problem creating RTPSParticipant|failed to create participant",
        "the process may not join, and this log gives no reason: Fast DDS 2.6 and 2.9 log "
        "nothing about signatures, expired permissions and subjects, later releases log them on "
        "standard output or in the file of ROS_SECURITY_LOG_FILE",
        _EXPLAIN_OR_LOG_FILE, _ALL_FAULTS,
        unseen=_LOG_FILE_REMEDY, vagueness=2,
    ),
    _log_text(
        "service", _ROS, r"(?:could not|failed to) create (?:service|client)"
        r"|create_(?:service|client)\(\) failed",
        "the permissions deny a service or client, and this message does not name it. If the node "
        "fails when it is created, a standard service of the node is denied: the node has another "
        "name or namespace than in the policy",
        "Compare the node's name and namespace with the policy's profile (ns, node); the line that "
        "names the topic is on standard output or in the file of ROS_SECURITY_LOG_FILE.",
        vagueness=2,
    ),
    _log_text(
        "endpoint", _ROS, r"Not Allowed By Security", _DENIED_ENDPOINT, _ASK_FOR_TOPIC,
        vagueness=3,
        refuses=Refused.TOPIC,
    ),
    _log_text(
        "endpoint", _ROS, r"invalid allocator|Problem creating associated (?:Reader|Writer)"
        r"|(?:could not|failed to) create (?:publisher|subscription|topic)"
        r"|create_(?:publisher|subscription)\(\) could not create",
        _DENIED_ENDPOINT, _ASK_FOR_TOPIC, vagueness=3,
    ),
    # ── denied topics: nearby lines show the denied right and the node ─────────────────────
    _log_text(
        # Matched only at the start of a word, for speed: a line may be one very long word.
        "topic-denied", _FAST, r"(?<![^\s(])(?P<topic>[^\s(]+) topic "
        r"(?P<how>not found in allow|denied by deny) rule",
        refuses=Refused.TOPIC,
    ),
    _log_text(
        "topic-denied", _CYCLONE,
        r"(?:Local topic permission denied|Writer is not permitted|Reader is not permitted): "
        r"(?P<topic>\S+) (?P<how>denied by default rule|found in deny_rule)",
        refuses=Refused.TOPIC,
    ),
    _log_text(  # the nodes of `sros demo`
        "topic-denied", _CYCLONE,
        r"cannot create (?:topic|a (?:writer|reader) on) (?P<topic>\S+)\. "
        r"(?P<how>Not Allowed By Security)",
        refuses=Refused.TOPIC,
    ),
    # ── refusals without a cause ───────────────────────────────────────────────────────────
    _log_text("refusal", _FAST, r"validate_local_identity|verifying CA certificate",
          refuses=Refused.PARTICIPANT),
    _log_text("refusal", _CYCLONE, r"Error occurred while validating local (?:permission|identity)"
          r"|validate_local_identity", refuses=Refused.PARTICIPANT),
    _log_text("refusal", _FAST, r"topic (?:not found in allow|denied by deny) rule",
          refuses=Refused.TOPIC),
    _log_text("refusal", _CYCLONE, r"denied by default rule|found in deny_rule",
          refuses=Refused.TOPIC),
)  # fmt: skip
"""All known log texts, in order: the first text that matches a line counts."""

_OF_DDS_SECURITY = (
    r"DDS[-:. ]?sec|dds_sec|ROS_SECURITY_|identity[_ ]ca|permissions[_ ]ca"
    r"|(?:cert|key|crl)\.pem|(?:governance|permissions)\.(?:p7s|xml)|\.p7s\b"
    r"|validate_(?:local|remote)_|PKCS ?#?7|\bS/?MIME|X\.?509|TRUSTED CERTIFICATE"
)
"""Words that occur in the log of a robot only because of DDS Security and its files."""
_SUBJECT = (
    rf"{_OF_DDS_SECURITY}|\bsecurity|non.?secure|permissions?[_ ]ca|\bgovernance\b|\bpermissions\b"
    r"|\bPEM\b|handshake|certificate|private key|authenticated\b|crypto|decrypt"
    r"|access[ _]?control|\benclave|keystore|\bCRL\b"
)
"""Words about DDS Security, or about the security or packages of something else."""
_MIDDLEWARE = (
    r"\b(?:rcl|rmw)\w{0,40}\b|fast.?(?:dds|rtps)|cyclone|\bdds|openssl|\bwhat\(\): "
    r"|\[\w{1,40} (?:Error|Warning)\]"
)
"""The origins of a message of the middleware: loggers, libraries, categories of Fast DDS."""
_TROUBLE = (
    r"error|fail|cannot|can't|could not|couldn't|unable|invalid|refus|denied|expired|reject"
    r"|disabled|not (?:allowed|found|valid|trusted|permitted|supported)|missing|mismatch|unknown"
    r"|expect"
)

UNKNOWN = LogText(
    "not-understood",
    _ROS,
    re.compile(
        r"\[\w{0,40}SECURITY\w{0,40} (?:Error|Warning)\]"
        # Any line of the file of ROS_SECURITY_LOG_FILE: without trouble, it stays empty.
        r"|\[[A-Z]{4,13}\] [^\s|]+\|[^\s|]+ \d+ \w+::\w+ :"
        # Cyclone DDS; what it traces of success is no trouble.
        r"|\A\d+\.\d+ \[\d*\]\s+\S+: (?!.*(?:DDS Security plugins have been loaded"
        r"|using security settings from|allow non-secure remote|FSM: |handshake (?:delete|resend)"
        r"|\) (?:processed|send tokens|succeeded)))"
        rf".*(?:{_SUBJECT}|plugin|not allowed|token|encoded|authenticat|Could not (?:load|find))"
        r"|SECURITY ERROR"
        # Any other program that speaks of DDS Security and of trouble, or the middleware that
        # speaks of security and of trouble, at no level that means none, but not the source in a
        # traceback.  A node may have a package, a list or a key of its own that has such a name.
        rf"|\A(?! {{4}}|(?:\[[\w.-]+\] )*\[(?:INFO|DEBUG)\])(?=.*?(?:{_TROUBLE}))"
        rf"(?:(?=.*?(?:{_MIDDLEWARE})).*?(?:{_SUBJECT})|.*?(?:{_OF_DDS_SECURITY}))",
        re.IGNORECASE,
    ),
    "a line of DDS Security that sros does not know",
    "Read the line: it may matter. If it kept a node from starting, `sros check KEYSTORE` and "
    "`sros explain KEYSTORE ENCLAVE join` check all that DDS checks.",
)
"""The meaning of a line that looks like a DDS Security message but is not in `LOG_TEXTS`."""

_NAME_ENCLAVE = (
    "start the process with `sros run KEYSTORE ENCLAVE -- COMMAND`, or name its enclave in "
    "ROS_SECURITY_ENCLAVE_OVERRIDE or `--ros-args --enclave`. Do not create an enclave /: every "
    "process that names none would run in it."
)
NO_ENCLAVE = _log_text(
    "no-enclave", _ROS, "",
    "no enclave is named for this process, so it looked for the files of the enclave /, and the "
    "keystore has none",
    f"Name one: {_NAME_ENCLAVE}",
    refuses=Refused.PARTICIPANT,
)  # fmt: skip
"""The meaning of `files-missing` in a process that named no enclave."""
RUNS_OPEN = _log_text(
    "runs-open", _ROS, "",
    "no enclave is named for this process: unless the keystore has an enclave /, it RUNS UNSECURED "
    "if ROS_SECURITY_STRATEGY is not exactly Enforce, without any further message; with Enforce it "
    "does not start",
    f"If it runs, stop it. Then {_NAME_ENCLAVE}", vagueness=4,
)  # fmt: skip
"""The meaning of rcl's line about the enclave /, in a log without an error after it."""

_LINE_FORMATS = (
    (Vendor.CYCLONE, re.compile(r"\A\d+\.\d+ \[\d*\]\s+\S+: ")),
    (
        Vendor.FAST,
        re.compile(
            r"\[\w{0,40} (?:Error|Warning)\]|\[[A-Z]{4,13}\] [^\s|]+\|[^\s|]+ \d+ \w+::\w+ :"
        ),
    ),
)


def style_of(line: str) -> Vendor | None:
    """Return the vendor whose log has lines of this form, or None.

    ``line`` has no label of its process any more.
    """
    return next((vendor for vendor, style in _LINE_FORMATS if style.search(line)), None)


# ── the lines around a text ────────────────────────────────────────────────────────────────

SECURITY_DIRECTORY = re.compile(
    r"Found security directory: (?P<folder>\S*?/enclaves(?P<enclave>/\S*)?)(?:\s|\Z)"
)
"""The line in which rcl names the enclave of a process, and its folder (groups)."""

_PROCESS_LABEL = re.compile(
    r"\[(?P<launch>[\w.-]+-\d+)\] "  # ros2 launch: [talker-1]
    r"|(?:\S+ +){2,4}?(?P<journald>[\w.@-]+\[\d+\]): "  # Nov 21 06:00:00 robot talker[12]:
    r"|(?P<compose>[\w.-]+) +\| "  # Docker Compose: talker-1  |
)
"""The label at the start of a line that distinguishes the processes in one log."""

DOMAIN_OF_LINE = re.compile(r"\] \S+\|\S+ (\d{1,9}) \w+::\w+ :")
"""The domain in a line of ROS_SECURITY_LOG_FILE, after the participant's identifier."""

CONTINUED = re.compile(r"^(?:[0-9A-F]{8,}:error:|\(code: )")
"""The start of a line that continues the line before it: OpenSSL's error stack."""

PEER = re.compile(r"check_remote_data|remote (?:writer|reader)")
"""The words that show that a peer's permissions deny a topic, not the process's permissions."""

DIRECTIONS: Mapping[str, re.Pattern[str]] = {
    "writer": re.compile(
        r"Writer is not|local writer|create a writer on|check_create_datawriter|datawriter_sec"
        r"|associated Writer|DATA_WRITER|create(?:_p| p|P)ublisher|register_local_writer"
    ),
    "reader": re.compile(
        r"Reader is not|local reader|create a reader on|check_create_datareader|datareader_sec"
        r"|associated Reader|DATA_READER|create(?:_s| s|S)ubscri|register_local_reader"
    ),
    "client": re.compile(r"create(?:_c| c|C)lient"),
    "server": re.compile(r"create(?:_s| s|S)ervice"),
}
"""The words in lines near a denied topic that show the kind of the denied endpoint."""

# ── reading ────────────────────────────────────────────────────────────────────────────────


def log_lines(text: str) -> list[str]:
    r"""Return the lines of a log, which end only with ``\n``.

    A process can print any other line separator, such as ``\r``, in the middle of a line, and
    behind it a label that makes the text look like that of another process.
    """
    return [line.removesuffix("\r") for line in text.split("\n")]


def labelled_line(line: str) -> tuple[str, str]:
    """Return the process that the label of a line names, and the text after it.

    A line without a label gives ("", line).
    """
    label = _PROCESS_LABEL.match(line)
    return (label[label.lastgroup or 0], line[label.end() :]) if label else ("", line)


def missing_security(text: str) -> str:
    """Return the message of a DDS that it was built without DDS Security, or ""."""
    return _first_refusal(Refused.ALL_SECURITY, text)


def participant_refusal(text: str) -> str:
    """Return the message that refuses a participant's files or domain, or ""."""
    return _first_refusal(Refused.PARTICIPANT, text)


def endpoint_refusal(text: str) -> str:
    """Return the message that denies a topic, a writer or a reader, or ""."""
    return _first_refusal(Refused.TOPIC, text)


def _first_refusal(refused: Refused, text: str) -> str:
    patterns = [text.pattern for text in LOG_TEXTS if text.refuses is refused]
    for line in plain_text(text).splitlines():
        if any(pattern.search(line) for pattern in patterns):
            return plain_refusal(line)
    return ""


def denied_topic(line: str) -> tuple[Vendor, re.Match[str]] | None:
    """Return the vendor that denies a topic, and the match with groups ``topic`` and ``how``."""
    for vendor, pattern in _TOPIC_DENIED:
        if match := pattern.search(line):
            return vendor, match
    return None


_TOPIC_DENIED = [
    (text.vendor, text.pattern) for text in LOG_TEXTS if text.id == "topic-denied" and text.vendor
]


def log_text(line: str) -> tuple[LogText, re.Match[str]] | None:
    """Return the text that explains a line, with its match, or None; see also `denied_topic`."""
    for text in LOG_TEXTS:
        if text.cause and (match := text.pattern.search(line)):
            return text, match
    return None


def plain_text(output: str) -> str:
    """Return the output of a process without ANSI color codes."""
    return _COLOUR.sub("", output)


def plain_refusal(line: str) -> str:
    """Return the message in a line of a DDS log, without time, severity and source positions.

    A line without a message gives the name of the failed function; only an empty line gives "".
    """
    line = " ".join(plain_text(line).split())
    if words := " ".join(_AROUND_REASON.sub("", line).split()):
        return words
    function = _FUNCTION.search(line)
    return _WITHOUT_REASON.format(function[1].replace("_", " ") + " failed") if function else line


_COLOUR = re.compile(r"\x1b\[[0-9;]*m")

_AROUND_REASON = re.compile(
    # Fast DDS: time, `[SECURITY Error]`, source position, and function.
    r"^\d{4}-\d\d-\d\d \d\d:\d\d:\d\d[.\d]* (?=\[)|\[SECURITY\w* (?:Error|Warning)\]\s*"
    r"|\s*\([^()\s]+\.(?:cpp|h|hpp|ipp):\d+\)|\s*-> Function \w+\Z|, at \S+\.(?:cpp|c):\d+"
    # The file of ROS_SECURITY_LOG_FILE: time, severity, participant, domain, and function.
    r"|^\S+ \[[A-Z]+\] \S+ \d+ \w+::\w+ :\s*"
    # Cyclone DDS and OpenSSL: time and thread, numbers, and source positions.
    r"|^\d+\.\d+ \[\d*\]\s+\S+: |(?:candidate|adjusted)_guid: \S+ "
    r"|Remote secure participant \S+ not allowed\. ?|[0-9A-F]{16}:error:[0-9A-F]+:[\w ]+:"
    r"|:\.\./\S+\.c:\d+|\[\w+\] failed: |validate_local_identity: |Error\. (?=Error|validate)"
)
"""The text that vendors put around the reason of a refusal, such as times and positions."""

_WITHOUT_REASON = "{}, and Fast DDS gives no reason"
_FUNCTION = re.compile(r"(?:-> Function |::)(\w+)(?: :)?\s*\Z")
"""The failed function, in a line of Fast DDS without a message."""


# ── Zenoh ────────────────────────────────────────────────────────────────────────────────────────

_RUN_IN_ENCLAVE = "Start it in its enclave: `sros run KEYSTORE ENCLAVE -- COMMAND`."
_RUN_PEER = "Start that process in its enclave: `sros run KEYSTORE ENCLAVE -- COMMAND`."
_SAME_KEYSTORE = (
    "Give both sides enclaves of the same keystore, and restart both after each stage of `sros "
    "rotate_ca KEYSTORE`; `sros inspect` shows the CA of each."
)
_WRITE_AGAIN = "Let `sros zenoh KEYSTORE` write the file, and do not edit it."

ZENOH_IDS = "zenoh-"
"""Prefix of the ids of Zenoh's log texts."""
ZENOH_LINE = re.compile(r"\A\s*(?:\S+Z\s+)?(?:TRACE|DEBUG|INFO|WARN|ERROR)\b.*?\bzenoh[\w:]*: ")
"""Pattern of a line of Zenoh's log; lines that match no text are no security problem."""


def _zenoh_text(name: str, pattern: str, cause: str, remedy: str, vagueness: int = 0) -> LogText:
    return LogText(
        f"{ZENOH_IDS}{name}", None, re.compile(pattern), cause, remedy, vagueness=vagueness
    )


_ZENOH_TEXTS: tuple[LogText, ...] = (
    # ── the side that listens ──────────────────────────────────────────────────────────────
    _zenoh_text(
        "peer-no-certificate", r"zenoh_link\S*: .*peer sent no certificates",
        "a PEER was refused: it showed no certificate", _RUN_PEER,
    ),
    _zenoh_text(
        "foreign-ca", r"zenoh_link\S*: received fatal alert: UnknownCA"
        r"|invalid peer certificate: UnknownIssuer",
        "a PEER was refused, or refused this process: their certificates are of different CAs",
        _SAME_KEYSTORE,
    ),
    _zenoh_text(
        "not-tls", r"zenoh_link\S*: received corrupt message of type InvalidContentType",
        "something without TLS connected to an endpoint with TLS: a process with an endpoint "
        "tcp/..., or another program",
        f"{_RUN_PEER} Many such lines a second keep everybody out: use a firewall, or listen on "
        "localhost.",
    ),
    _zenoh_text(
        "peer-expired", r"invalid peer certificate: certificate expired",
        "a PEER was refused: its certificate has expired, by the clock of this host",
        "Renew it, and restart the peer: `sros inspect KEYSTORE` shows which one, `sros renew "
        "KEYSTORE ENCLAVE` renews it.",
    ),
    _zenoh_text(
        "peer-not-yet-valid", r"invalid peer certificate: certificate not valid yet",
        "a PEER was refused: its certificate is not valid yet, by the clock of this host",
        "Set the clocks of both hosts.",
    ),
    _zenoh_text(
        "closed-expired", r"Closing \S+ link .{1,200}remote certificate chain expired",
        "a connection was closed, because the certificate of the other side has expired",
        "Renew it, and restart that process: `sros renew KEYSTORE ENCLAVE`.",
    ),
    _zenoh_text(
        "alert", r"zenoh_link\S*: received fatal alert: (?P<alert>\w{1,40})",
        "a PEER closed the connection: it does not accept the certificate of this process "
        "({alert}); most often it compares the name of the endpoint with it "
        "(verify_name_on_connect), but certificates of enclaves name no host",
        f"Look at the configuration of the peer. {_WRITE_AGAIN}",
    ),
    _zenoh_text(
        "no-subject", r"(?P<zid>[0-9a-f]{1,32}) did not match any configured ACL subject\. "
        r"Default permission `Deny`",
        "a PEER is connected, and may do nothing: no rule here has the name of its certificate",
        "`sros zenoh KEYSTORE --check` shows whether the files are up to date; restart the "
        "processes that it names. If the peer is the router, it runs in another enclave than the "
        "keystore names.",
    ),
    _zenoh_text(
        "no-subject-open", r"(?P<zid>[0-9a-f]{1,32}) did not match any configured ACL subject\. "
        r"Default permission `Allow`",
        "a PEER is connected, and may do everything: the default of access_control is to allow",
        _WRITE_AGAIN,
    ),
    # ── the side that connects ─────────────────────────────────────────────────────────────
    _zenoh_text(
        "no-certificate", r"received fatal alert: CertificateRequired",
        "this process showed no certificate", _RUN_IN_ENCLAVE,
    ),
    _zenoh_text(
        "expired", r"received fatal alert: CertificateExpired",
        "the certificate of this process has expired",
        "Renew the enclave: `sros renew KEYSTORE ENCLAVE`.",
    ),
    _zenoh_text(
        "refused", r"received fatal alert: (?P<alert>\w{1,40})",
        "the other side does not accept the certificate of this process ({alert})", _SAME_KEYSTORE,
    ),
    _zenoh_text(
        "name", r"invalid peer certificate: certificate not valid for name (?P<name>\"[^\"]*\")",
        "this process compares {name} with the certificate of the other side "
        "(verify_name_on_connect), but certificates of enclaves name no host",
        _WRITE_AGAIN,
    ),
    _zenoh_text(
        "no-paths", r"Missing TLS (?P<what>private key|certificate)",
        "the configuration does not say where the {what} is: ZENOH_CONFIG_OVERRIDE is missing",
        _RUN_IN_ENCLAVE,
    ),
    _zenoh_text(
        "key-mismatch", r"Bad certificate/key: keys may not be consistent",
        "the private key does not belong to the certificate",
        "Restore the key, or give the enclave a new one: `sros renew KEYSTORE ENCLAVE --new-key`.",
    ),
    _zenoh_text(
        "file", r"Invalid TLS (?P<what>[\w ]{1,40}?)(?: file)?: (?P<why>[^/]{1,80}?) at /",
        "the file of the {what} cannot be read: {why}",
        f"Restore the file, or correct the path in ZENOH_CONFIG_OVERRIDE. {_RUN_IN_ENCLAVE}",
    ),
    _zenoh_text(
        "tcp-to-tls", r"Unable to connect to configured peer (?P<endpoint>tcp/\S+)! Read error on "
        r"TCP link .{1,120}early eof",
        "the other side closed a connection without TLS to {endpoint}: it listens with TLS",
        _RUN_IN_ENCLAVE,
    ),
    _zenoh_text(
        "protocol", r"Unsupported protocol: (?P<protocol>\w{1,20})\. Supported protocols are",
        "an endpoint has the protocol {protocol}, which the configuration excludes",
        "Write tls/HOST:PORT. " + _WRITE_AGAIN,
    ),
    _zenoh_text(
        "not-there",
        r"Unable to connect to configured peer (?P<endpoint>\S+)! .*Connection refused",
        "nothing listens at {endpoint}: the router does not run, or has another address",
        "Start the router: `sros run KEYSTORE /router -- ros2 run rmw_zenoh_cpp rmw_zenohd`.",
    ),
    _zenoh_text(
        "port-taken", r"Unable to open listener (?P<endpoint>\S+): .*Address already in use",
        "another process listens at {endpoint} already", "Stop it: it may be another router.",
    ),
    # ── configurations ─────────────────────────────────────────────────────────────────────
    _zenoh_text(
        "rules", r"Access control not enabled due to: (?P<why>.{1,200}?) at /",
        "access_control is not valid, so the session does not open: {why}",
        f"`sros check FILE` examines it. {_WRITE_AGAIN}",
    ),
    _zenoh_text(
        "no-rules", r"Access control (?P<what>rules|subjects|policies) list is empty",
        "access_control has no {what}: no message passes",
        f"`sros check FILE` examines it. {_WRITE_AGAIN}",
    ),
    _zenoh_text(
        "setting", r"unknown field `(?P<field>[^`]{1,60})`, expected one of",
        "the configuration has a setting that this Zenoh does not have: {field}",
        f"`sros check FILE` examines it. {_WRITE_AGAIN}",
    ),
    _zenoh_text(
        "expression", r"Invalid Key Expr `(?P<key>[^`]{1,200})`: (?P<why>.{1,200}?) at /",
        "the key expression {key} is not valid ({why}), so the session does not open",
        f"`sros check FILE` examines it. {_WRITE_AGAIN}",
    ),
    _zenoh_text(
        "configuration", r"Invalid configuration file (?P<path>\S{1,300})",
        "rmw_zenoh does not accept the configuration {path}",
        f"`sros check FILE` examines it. {_WRITE_AGAIN}",
    ),
    # ── without a reason ───────────────────────────────────────────────────────────────────
    _zenoh_text(
        "no-connection", r"Unable to connect to any of \[(?:Single\()?(?P<endpoint>[^\])]{1,200})"
        r"|Unable to connect to a Zenoh router",
        "no connection to the router: it does not run, or one side refused the other",
        "Read the log of the router, which says whom it refused; or start this process with "
        "RUST_LOG=zenoh=debug.",
        vagueness=1,
    ),
)  # fmt: skip


def zenoh_text(line: str) -> tuple[LogText, re.Match[str]] | None:
    """Return the text that explains a line of Zenoh, with its match, or None."""
    for text in _ZENOH_TEXTS:
        if match := text.pattern.search(line):
            return text, match
    return None


# ── denied messages ────────────────────────────────────────────────────────────────────────


class DroppedMessage(NamedTuple):
    """A message that access control dropped, as the log of the enforcing process reports it.

    ``line`` counts from 1; ``name`` is the common name of the remote process, "" if the log does
    not show it; ``message`` is as Zenoh writes it, such as "Declare Subscriber".
    """

    line: int
    process: str
    zid: str
    name: str
    message: str
    ingress: bool
    key: str


_DENIED = re.compile(
    r"(?P<cached>Using cached result: )?(?P<zid>[0-9a-f]{1,32}) (?:on (?P<subject>\S{1,400}) )?"
    r"is unauthorized to (?P<message>[A-Z][\w/ ]{1,40}) \((?P<flow>ingress|egress)\) on "
    r"(?:Some\()?(?P<key>[^\s)]{1,1000})"
)
_NAME = re.compile(r"CertCommonName\((?P<name>[^)]{1,200})\)")
_DECLARED_OR_UNDECLARED = "Declare/Undeclare"


def dropped_messages(lines: Iterable[tuple[int, str, str]]) -> Iterator[DroppedMessage]:
    """Yield the dropped messages in lines (number, process, text) of a log.

    When a key is declared, Zenoh tries all kinds of messages for it and logs each result.  These
    lines, which contain "Declare/Undeclare", report no message; the lines "Using cached result",
    and lines for keys that were not declared, do.
    """
    declarations = []
    names: dict[tuple[str, str], str] = {}
    declared: set[tuple[str, str, str]] = set()
    for number, process, text in lines:
        if "is unauthorized to" not in text or not (match := _DENIED.search(text)):
            continue
        place = process, match["zid"], match["key"]
        if match["subject"] and (named := _NAME.search(match["subject"])):
            names[process, match["zid"]] = named["name"]
        if match["message"].startswith(_DECLARED_OR_UNDECLARED):
            declared.add(place)
        else:
            declarations.append((number, place, match))
    for number, (process, zid, key), match in declarations:
        if match["cached"] or (process, zid, key) not in declared:
            name, ingress = names.get((process, zid), ""), match["flow"] == "ingress"
            yield DroppedMessage(number, process, zid, name, match["message"], ingress, key)
