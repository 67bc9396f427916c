"""The security messages that DDS vendors, rcl and the RMWs log, with their meanings.

Each text was seen in a real log of Fast DDS 2.9.1, 2.14.5 or 3.6.2 (Permissions.cpp,
SecurityManager.cpp, PKIDH.cpp), Cyclone DDS 0.10.2 (access_control.c, authentication.c,
q_omg_security.c), or rcl of Jazzy; texts of rmw_cyclonedds were seen with Cyclone DDS 0.10.5.

To add a vendor, add rows to `LOG_TEXTS`; `sros_tool.runtime.vendor_log` reads the lines.
"""

from __future__ import annotations

import re
from enum import Enum, auto
from typing import NamedTuple

from sros_tool.dds.decision.vendors import Vendor
from sros_tool.faults import BEFORE_DDS, Fault
from sros_tool.runtime.rmw import denial_trace_variables


class RefusedObject(Enum):
    """The object that DDS Security refused, according to a log message."""

    ALL_SECURITY = auto()
    """Every secured participant, because DDS Security is not built in."""
    PARTICIPANT = auto()
    """The participant of the process, because of its files or its domain."""
    TOPIC = auto()
    """A topic, a DataWriter or a DataReader."""


_ROS = None
"""The vendor of texts that rcl or an RMW prints with any DDS."""


class LogText(NamedTuple):
    """A text in logs, and its meaning.

    ``pattern`` is searched in a line without colors; its groups are fields such as ``path``,
    ``domain`` and ``topic``.  ``cause`` and ``remedy`` may use these fields in braces; ``cause`` is
    "" if the text alone does not show a cause.  ``faults`` are the faults of an enclave that can
    cause the text; ``remedy_without_fault`` is the remedy if the enclave has none of these faults.

    ``vagueness`` is 0 for a text that names a cause, and higher for less specific texts: of all
    texts of a process, only the texts with the lowest value count.  ``refuses`` is None if the text
    alone does not prove that DDS Security refused something.
    """

    id: str
    vendor: Vendor | None
    pattern: re.Pattern[str]
    cause: str = ""
    remedy: str = ""
    faults: tuple[Fault, ...] = ()
    remedy_without_fault: str = ""
    vagueness: int = 0
    refuses: RefusedObject | None = None


def _log_text(
    name: str,
    vendor: Vendor | None,
    pattern: str,
    cause: str = "",
    remedy: str = "",
    faults: tuple[Fault, ...] = (),
    *,
    remedy_without_fault: str = "",
    vagueness: int = 0,
    refuses: RefusedObject | None = None,
) -> LogText:
    expression = re.compile(pattern, re.IGNORECASE)
    return LogText(
        name, vendor, expression, cause, remedy, faults, remedy_without_fault, vagueness, refuses
    )


_CERTIFICATE_FAULTS = (
    Fault.CERTIFICATE_EXPIRED,
    Fault.CERTIFICATE_NOT_YET_VALID,
    Fault.CERTIFICATE_ISSUER,
)
_CA_FAULTS = (Fault.CA_EXPIRED, Fault.CA_NOT_YET_VALID)
_CRL_FAULTS = (
    Fault.CRL_EXPIRED,
    Fault.CRL_MALFORMED,
    Fault.CRL_ISSUER,
    Fault.CRL_PARTIAL,
    Fault.CRL_NOT_YET_VALID,
    Fault.REVOKED,
)
_FILE_FAULTS = (
    *BEFORE_DDS,
    Fault.FILE_EMPTY,
    Fault.FILE_UNREADABLE,
)
_KEY_FAULTS = (Fault.KEY_ENCRYPTED, Fault.KEY_MALFORMED)
_SIGNATURE_FAULTS = (Fault.SIGNATURE, Fault.NOT_SIGNED)
_GRANT_FAULTS = (
    Fault.PERMISSIONS_EXPIRED,
    Fault.PERMISSIONS_NOT_YET_VALID,
    Fault.PERMISSIONS_SUBJECT,
)
_DOCUMENT_FAULTS = (Fault.PERMISSIONS_MALFORMED, Fault.GOVERNANCE_MALFORMED)
_ALL_FAULTS = (
    *_CERTIFICATE_FAULTS, Fault.CERTIFICATE_MALFORMED, *_CA_FAULTS, *_CRL_FAULTS, *_FILE_FAULTS,
    *_KEY_FAULTS, Fault.KEY_MISMATCH, *_SIGNATURE_FAULTS, *_GRANT_FAULTS, *_DOCUMENT_FAULTS,
    Fault.GOVERNANCE_DOMAIN, Fault.PERMISSIONS_DOMAIN,
)  # fmt: skip

_EXPLAIN_REMEDY = "`sros explain KEYSTORE ENCLAVE --log LOG` finds the cause in the enclave."
_LOG_FILE_REMEDY = "If ROS_SECURITY_LOG_FILE names a FILE, run `sros explain --log FILE`."
_EXPLAIN_OR_LOG_FILE = f"{_EXPLAIN_REMEDY} {_LOG_FILE_REMEDY}"
_RESTORE_FILE = (
    "`sros explain KEYSTORE ENCLAVE join` names the file and the command that restores the file. "
    "If the enclave is on a robot, export the enclave from its keystore again."
)
_RENEW_ENCLAVE = "Renew the enclave: `sros renew KEYSTORE ENCLAVE`."
_SIGN_PERMISSIONS = "Sign the permissions again: `sros create_permission KEYSTORE ENCLAVE POLICY`."
_SIGN_DOCUMENT = (
    "`sros explain KEYSTORE ENCLAVE --log LOG` names the document. If it is permissions.p7s, sign "
    "it again: `sros create_permission KEYSTORE ENCLAVE POLICY`. If it is governance.p7s, restore "
    "it from a backup, because every enclave depends on it."
)
_MAKE_READABLE = (
    "Allow the user of the node to read the file, and to enter the folders above the file: `ls -lL "
    "{path}`, run as this user, shows whether the file can be read."
)
_MAKE_READABLE_FOR_USER = (
    "As the user that runs the node, run `sros check KEYSTORE`, which names the files that this "
    "user cannot read. If the folder is an export, give the folder to this user: `sudo chown -R "
    "USER KEYSTORE`. If the folder has the CA keys, which no node should be able to read, export "
    "the enclave into a folder of the user."
)
_NO_FOLDER = "rcl does not find the enclave's folder {path}"
_WHY_NO_FOLDER = (
    "ROS_SECURITY_KEYSTORE or the enclave's name is wrong, or the user of the node cannot enter "
    "the folder"
)
_SHOW_MODES = "`namei -l {path}` shows who may enter each folder."
CHANGE_OWNER_REMEDY = (
    f"{_SHOW_MODES} Give the export to the user of the node: `sudo chown -R USER KEYSTORE`. If the "
    "folder was made after the node started, restart the node."
)
"""The remedy if an export has a folder that rcl did not find."""
EXPORT_FOR_USER_REMEDY = (
    f"{_SHOW_MODES} This keystore has the CA keys, which no node should be able to read: export "
    "the enclave into a folder of the user of the node. If the folder was made after the node "
    "started, restart the node."
)
"""The remedy if a keystore with CA keys has a folder that rcl did not find."""
_SET_DOMAIN = (
    "Set ROS_DOMAIN_ID to a domain of the keystore: `sros env KEYSTORE ENCLAVE --domain ID` prints "
    "the variables."
)
_FAST_PARTICIPANT = r"(?P<participant>[0-9a-f]{2}(?:\.[0-9a-f]{2}){11})\|\S*"
"""A remote participant in a line of Fast DDS; the GUID begins with a digest of the subject name."""
_CYCLONE_PARTICIPANT = r"remote participant (?P<participant>[0-9a-f]{1,8}(?::[0-9a-f]{1,8}){2}):\S+"
_REFUSED_PARTICIPANT = rf"(?:permissions for {_FAST_PARTICIPANT} \()?"
_RENEW_PARTICIPANT = (
    "`sros inspect KEYSTORE` shows how long each enclave is valid, and `sros renew KEYSTORE PEER` "
    "renews the peer's enclave; then restart the peer."
)
_OTHER_PERMISSIONS_CA = (
    "its permissions are not signed by a permissions CA that this process has loaded. This process "
    "was not restarted since the stage distribute of a rotation (`sros rotate_ca`), or the peer "
    "was not restarted since the stage reissue. Or the two processes have enclaves of different "
    "keystores, or the peer's permissions.p7s was changed after it was signed"
)
_SAME_KEYSTORE = (
    "Give both sides enclaves of the same keystore; `sros inspect` shows the CA of an enclave."
)
_FAST, _CYCLONE = Vendor.FAST, Vendor.CYCLONE
_CYCLONE_TRACE = denial_trace_variables("stderr")["CYCLONEDDS_URI"]
_DENIED_ENDPOINT = (
    "the permissions deny a publisher, subscription, client or server; this message does not name "
    "the topic (`invalid allocator` has nothing to do with memory)"
)
_FIND_TOPIC = (
    "Look for an earlier line that names the topic, on standard output or in the file of "
    "ROS_SECURITY_LOG_FILE. Or run the node without security: `sros audit KEYSTORE` then names "
    "everything that the permissions would deny the node."
)

_ROS_TEXTS = (
    _log_text(
        "not-built-in", _ROS, r"doesn't have the security libraries|compile Fast DDS using the"
        r"|-DSECURITY=ON|does not have security support|security (?:is )?not supported"
        r"|compiled without security",
        "this DDS was built without DDS Security, so no secured node can start with it",
        "Use the ROS 2 packages of the distribution; `sros doctor` shows which DDS enforces "
        "security.",
        refuses=RefusedObject.ALL_SECURITY,
    ),
    _log_text(
        "keystore-inside", _ROS,
        r"SECURITY ERROR: directory '(?P<keystore>[^']*)/enclaves/enclaves(?:/[^']*)?' does not",
        "ROS_SECURITY_KEYSTORE names the folder `enclaves` of {keystore}, and has to name the "
        "keystore",
        "Set the variable to the keystore: `sros env KEYSTORE ENCLAVE` prints all variables.",
    ),
    _log_text(
        "enclave-missing", _ROS,
        r"rcl: SECURITY ERROR: directory '(?P<path>[^']*)' does not exist",
        f"{_NO_FOLDER}: {_WHY_NO_FOLDER}",
        "Correct the name: `sros list_enclaves KEYSTORE` shows all names. If the folder is there: "
        f"{_SHOW_MODES} If it is in an export, give the export to the user of the node; if it is "
        "next to the CA keys, which no node should be able to read, export the enclave into a "
        "folder of the user.",
    ),
    _log_text(
        "runs-unsecured", _ROS, r"SECURITY ERROR: directory '(?P<path>[^']*)' does not exist",
        f"{_NO_FOLDER} ({_WHY_NO_FOLDER}), and as ROS_SECURITY_STRATEGY is not exactly Enforce, "
        "the node RUNS UNSECURED",
        "Start the node with `sros run`, which runs a node secured or not at all.",
    ),
    _log_text(
        "keystore-unset", _ROS, r"failed to initialize rcl: error not set",
        "security is on, and ROS_SECURITY_KEYSTORE is unset or empty",
        "Set the variable to the keystore: `sros env KEYSTORE ENCLAVE` prints all variables.",
    ),
    _log_text(
        "files-missing", _ROS, r"couldn't find all security files",
        "a file of the enclave is missing or a broken link; the message does not say which",
        _RESTORE_FILE, _FILE_FAULTS,
        refuses=RefusedObject.PARTICIPANT,
    ),
    _log_text(  # rmw_cyclonedds
        "files-missing", _ROS, r"could not find all security files",
        "a file of the enclave is missing, a broken link, or closed to the user of this process; "
        "the message does not say which. With ROS_SECURITY_STRATEGY=Enforce, no node starts; with "
        "any other value, the node RUNS UNSECURED",
        _RESTORE_FILE, _FILE_FAULTS,
        refuses=RefusedObject.PARTICIPANT,
    ),
    _log_text(
        "file-unreadable", _ROS,
        r"filesystem error: [\w ]{1,40}: Permission denied "
        r"\[(?P<path>[^\]]*/(?:key\.p11|[a-z_.]+\.(?:pem|p7s)))\]",
        "the user that runs this process is not allowed to read {path}, or to enter one of the "
        "folders above it",
        _MAKE_READABLE_FOR_USER,
    ),
    _log_text(
        "enclave-missing", _ROS,
        r"SECURITY ERROR: unable to find a folder matching the (?:\w+ )?name '(?P<path>[^']*)'",
        "the keystore has no folder for the enclave {path}",
        "Correct the name: `sros list_enclaves KEYSTORE` shows all names.",
    ),
    _log_text(
        "not-started", _ROS,
        r"Unable to (?:run the command|print the environment): (?P<reason>a process cannot run in "
        r"enclave (?P<enclave>/[\w/]*).+)",
        "sros did not start the process: {reason}",
        "Repair what the line names (if a file expired: `sros renew KEYSTORE ENCLAVE`, and export "
        "the enclave again), and start the process again.",
        _ALL_FAULTS,
    ),
    _log_text(
        "not-started", _ROS, r"Unable to (?:run the command|print the environment): (?P<reason>.+)",
        "sros did not start the process: {reason}",
        "Repair what the line names, and start the process again.",
    ),
)  # fmt: skip

_CYCLONE_PARTICIPANT_TEXTS = (
    _log_text(
        "peer-revoked", _CYCLONE, r"(?:Begin|Process) handshake (?:request |reply )?failed: "
        r"Certificate not valid: error: certificate revoked",
        "a PEER was refused, not this process: the peer's certificate is revoked. The line names "
        "the subject of this certificate",
        "If the certificate was replaced (`sros renew --revoke-old`), restart the processes of the "
        "peer's enclave, with its new files. If none of your processes still has the certificate, "
        "somebody tries to use it: the refusal is right.",
    ),
    _log_text(
        "peer-expired", _CYCLONE, r"(?:Begin|Process) handshake (?:request |reply )?failed: "
        r"Certificate not valid: error: certificate (?P<reason>has expired|is not yet valid)",
        "a PEER was refused, not this process: by the clock of this host, the peer's certificate "
        "{reason}",
        f"Compare the clocks of both hosts. {_RENEW_PARTICIPANT}",
    ),
    _log_text(
        "peer-refused", _CYCLONE, r"(?:Begin|Process) handshake (?:request |reply )?failed: "
        r"Certificate not valid: error: (?P<reason>[^;]+)",
        "a PEER was refused, not this process: the peer's certificate is not accepted ({reason}); "
        "if the two processes have different CAs, the peer logs the same message or nothing",
        _SAME_KEYSTORE,
    ),
    _log_text(
        "peer-handshake", _CYCLONE, r"(?:Begin|Process) handshake (?:request |reply )?failed"
        r"|FSM: handshake (?:failed|timeout)|handshake \(lguid=\S+ rguid=\S+\) failed",
        "a PEER failed to authenticate: most often the peer's key.pem does not belong to its "
        "cert.pem (Cyclone DDS does not check this when the peer starts); or the peer runs another "
        "DDS, or another version",
        "Run `sros verify` or `sros inspect` on the enclave of every peer.", (Fault.KEY_MISMATCH,),
    ),
    _log_text(
        "peer-governance", _CYCLONE, r"security_attributes mismatch",
        "a PEER was refused: its governance demands other protection than the governance of "
        "this process. The processes have enclaves of different keystores, or one process was "
        "started before the governance changed",
        f"{_SAME_KEYSTORE} `sros inspect` also shows the governance. Export the enclaves again, "
        "and restart both processes.",
    ),
    _log_text(
        "peer-unsecured", _CYCLONE, r"Non secure remote (?:reader|writer) \S+ is not allowed"
        r"|from unauthenticated participant|downgrade participant \S+ to non-secure",
        "a PEER was refused: the peer runs without DDS Security, or is not authenticated yet",
        "Start the peer in its enclave: `sros run KEYSTORE PEER -- COMMAND`.",
    ),
    _log_text(
        "peer-permissions", _CYCLONE, rf"{_CYCLONE_PARTICIPANT} permissions from plugin: "
        r"Permissions validity period (?:expired|has not started)",
        "a PEER was refused: by the clock of this host, its permissions have expired or are not "
        "valid yet", _RENEW_PARTICIPANT,
    ),
    _log_text(
        "peer-signature", _CYCLONE,
        rf"{_CYCLONE_PARTICIPANT} permissions from plugin: .*(?:PKCS7|SMIME)",
        f"a PEER was refused: {_OTHER_PERMISSIONS_CA}",
        "Restart all processes together after the stage reissue of `sros rotate_ca`. If this "
        f"continues: {_SAME_KEYSTORE}",
    ),
    _log_text(
        "peer-refused", _CYCLONE,
        rf"{_CYCLONE_PARTICIPANT} permissions from plugin: (?P<reason>\w.+)",
        "a PEER was refused, not this process: the peer's permissions are not accepted ({reason})",
        _SAME_KEYSTORE,
    ),
)  # fmt: skip
"""Refusals of remote participants."""

_CYCLONE_START_TEXTS = (
    _log_text(
        "plugin", _CYCLONE, r"Could not load (?:Authentication|Access Control|Cryptographic|"
        r"security)\b|Could not find the function: \S+|security plugin (?:library path|init "
        r"function|finalize function) is undefined"
        r"|Error occurred while initializing [\w ]{1,40} plugin",
        "a plugin of DDS Security (authentication, access control, cryptography) cannot be loaded, "
        "so no secured process starts",
        "Install Cyclone DDS with its plugins, as the distribution packages it; `sros doctor` "
        "shows whether this DDS enforces security.",
    ),
    _log_text(
        "property", _CYCLONE, r"required security property (?P<property>\S+) missing",
        "the program secures its participant without naming {property}",
        "Start the program through an RMW of ROS 2, in an enclave: `sros run KEYSTORE ENCLAVE -- "
        "COMMAND`.",
    ),
    _log_text(
        "certificate-expired", _CYCLONE, r"Certificate not valid: error: certificate has expired",
        "the certificate of the enclave or of its identity CA has expired; the message "
        "does not say which",
        f"{_RENEW_ENCLAVE} If the CA has expired, first replace it: `sros rotate_ca KEYSTORE "
        "--finish`.", (Fault.CERTIFICATE_EXPIRED, Fault.CA_EXPIRED),
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
        "Revoked enclaves are refused on purpose. To use the enclave again, give the enclave a new "
        "key: `sros create_enclave KEYSTORE ENCLAVE`.",
        (Fault.REVOKED,),
    ),
    _log_text(
        "crl-expired", _CYCLONE, r"Certificate not valid: error: CRL (?:has expired|is not yet)",
        "the CRL has expired or is not valid yet, so every participant is refused",
        "Check the clock of the host. If it is right, sign the CRL again: `sros crl KEYSTORE "
        "--refresh`.",
        (Fault.CRL_EXPIRED, Fault.CRL_NOT_YET_VALID),
    ),
    _log_text(
        "crl-unreadable", _CYCLONE, r"Failed to read CRL",
        "crl.pem is not a CRL, so every participant is refused",
        "Sign the CRL again: `sros crl KEYSTORE --refresh`.", (Fault.CRL_MALFORMED,),
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
        "a certificate or key.pem is not a PEM file (for key.pem, the message may also say "
        "certificate)",
        "Restore the file.", (Fault.CERTIFICATE_MALFORMED, *_KEY_FAULTS, *_FILE_FAULTS),
    ),
    _log_text(
        "signature", _CYCLONE, r"PKCS7_signatureVerify:digest failure",
        "governance.p7s or permissions.p7s was changed after it was signed",
        _SIGN_DOCUMENT, _SIGNATURE_FAULTS,
    ),
    _log_text(
        "signer", _CYCLONE, r"PKCS7_verify:certificate verify error",
        "governance.p7s or permissions.p7s was signed by another CA than the permissions CA "
        "next to it", f"Use the files of one keystore together. {_SIGN_DOCUMENT}",
        _SIGNATURE_FAULTS,
    ),
    _log_text(
        "not-signed", _CYCLONE, r"SMIME_read_ASN1_ex:no content type|SMIME_read_ASN1",
        "governance.p7s or permissions.p7s is plain XML or damaged, and not a signed document",
        _SIGN_DOCUMENT, _SIGNATURE_FAULTS,
    ),
    _log_text(
        "permissions-expired", _CYCLONE, r"Permissions validity period expired(?P<moment>[^)]*\))?",
        "the permissions have expired", _RENEW_ENCLAVE, (Fault.PERMISSIONS_EXPIRED,),
    ),
    _log_text(
        "permissions-not-yet-valid", _CYCLONE, r"Permissions validity period has not started",
        "the permissions are not valid yet", "Set the clock of the host.",
        (Fault.PERMISSIONS_NOT_YET_VALID,),
    ),
    _log_text(
        "permissions-subject", _CYCLONE, r"Subject name is invalid",
        "the permissions have no grant for the subject of this certificate: they belong to another "
        "enclave, or to an earlier certificate", _SIGN_PERMISSIONS, (Fault.PERMISSIONS_SUBJECT,),
    ),
    _log_text(
        "domain", _CYCLONE, r"Could not find domain (?P<domain>\d{1,9}) in governance",
        "the governance is not for domain {domain}",
        _SET_DOMAIN, (Fault.GOVERNANCE_DOMAIN,),
        refuses=RefusedObject.PARTICIPANT,
    ),
    _log_text(
        "malformed", _CYCLONE, r"Can not parse (?P<document>governance|permissions) file",
        "Cyclone DDS does not accept the {document} document, although it is signed correctly",
        "Generate the document with sros; `sros check` reports what vendors read differently.",
        _DOCUMENT_FAULTS,
    ),
    _log_text(
        "file-missing", _CYCLONE, r"File could not be found, opened or is empty, path: "
        r"(?P<path>\S+)",
        "the file {path} is missing, empty or not readable", "Restore the file.", _FILE_FAULTS,
        remedy_without_fault=_MAKE_READABLE,
    ),
    _log_text(
        "peer-refused", _CYCLONE, r"Remote secure participant \S+ not allowed"
        r"|Plugin does not allow remote participant|Could not authenticate_peer_credential_token"
        r"|Could not get remote participant \S+ permissions",
        "a PEER was refused, not this process; another line, of this process or of the peer, says "
        "why", _SAME_KEYSTORE, vagueness=1,
    ),
    _log_text(
        "participant", _CYCLONE, r"rmw_create_node: failed to create (?:DomainParticipant|domain)",
        "the process could not join its domain. The reason is DDS Security, the network interface "
        "or the domain: an earlier line of Cyclone DDS, on standard error, says which",
        _EXPLAIN_REMEDY, _ALL_FAULTS, vagueness=2,
    ),
)  # fmt: skip

_FAST_PARTICIPANT_TEXTS = (
    _log_text(
        "peer-permissions-ca", _FAST,
        rf"{_REFUSED_PARTICIPANT}Remote participant PermissionsCA differs from local",
        "a PEER was refused: the peer has another permissions CA than this process. The processes "
        "have enclaves of different keystores, or only one process was restarted since the CA was "
        "replaced",
        _SAME_KEYSTORE + " Restart both processes after each stage of `sros rotate_ca KEYSTORE`.",
    ),
    _log_text(
        "peer-version", _FAST, r"Remote participant PermissionsCA algorithm differs from local",
        "a PEER was refused: the peer runs another version of Fast DDS, or has a permissions CA "
        "with another type of key", "Run one version of Fast DDS on all hosts of the robot. "
        f"If the versions are the same: {_SAME_KEYSTORE}",
    ),
    _log_text(
        "peer-permissions", _FAST,
        rf"{_REFUSED_PARTICIPANT}Remote participant doesn't found in its permissions file",
        "a PEER was refused: by the clock and the time zone of this host, its permissions have "
        "expired or are not valid yet, or the permissions have no grant for its certificate",
        "Compare clocks and time zones of both hosts: Fast DDS reads dates in local time. "
        f"{_RENEW_PARTICIPANT}",
    ),
    _log_text(
        "peer-signature", _FAST,
        rf"{_REFUSED_PARTICIPANT}Cannot read as PKCS7 the permissions file",
        f"a PEER was refused: {_OTHER_PERMISSIONS_CA}",
        f"Restart this process, and then the peer. If this continues: {_SAME_KEYSTORE}",
    ),
    _log_text(
        "peer-malformed", _FAST,
        r"Error validating remote permissions for \S+ \(Malformed permissions file",
        "a PEER was refused: Fast DDS does not accept its permissions, although these are signed "
        "correctly",
        "Sign the peer's permissions again: `sros create_permission KEYSTORE PEER POLICY`.",
    ),
    _log_text(
        "peer-domain", _FAST, r"Error checking remote participant"
        r"|Not found a rule allowing to use the domain_id.*check_remote_participant"
        r"|check_remote_participant.*Not found a rule allowing to use the domain_id",
        "a PEER was refused: its permissions are not for this domain",
        "Sign the peer's permissions again: `sros create_permission KEYSTORE PEER POLICY` signs "
        "them for all domains of the keystore.",
    ),
    _log_text(
        "peer-refused", _FAST, r"Error validating remote permissions for"
        r"|Remote participant doesn't sent the signed permissions|Not receive remote permissions",
        "a PEER was refused, not this process: the peer's permissions did not arrive or were not "
        "accepted",
        _SAME_KEYSTORE,
    ),
    _log_text(
        "crypto", _FAST, r"\[SECURITY_CRYPTO (?:Error|Warning)\]|EVP_(?:De|En)crypt|AESGCMGMAC"
        r"|(?:Invalid|Malformed) Crypto(?:Token|Handle)|in fastcdr trying to (?:de)?"
        r"(?:serialize|cipher)",
        "a message of a peer could not be decrypted or verified: one side restarted, or has "
        "another governance, or a packet was damaged or forged",
        f"If this continues, restart both sides. {_SAME_KEYSTORE}",
    ),
    _log_text(
        "peer-governance", _FAST, r"Security manager returns an error for (?:reader|writer)",
        "a publisher or subscription of a PEER was refused. If no other line gives the reason, "
        "the governance of the peer protects the topic differently: the processes have enclaves "
        "of different keystores, or one process was started before the governance changed",
        "`sros check KEYSTORE OTHER`, with the keystore or export of the peer as OTHER, names the "
        "topic. "
        "Export the enclaves of both processes again, from the same keystore, and restart both "
        "processes.", vagueness=1,
    ),
)  # fmt: skip
"""Refusals of remote participants."""

_FAST_START_TEXTS = (
    _log_text(
        "identity", _FAST, r"SECURITY\s*Error\]\s*->\s*Function validate_local_identity"
        r"|PKIDH::validate_local_identity :\s*\Z",
        "the identity is refused, and the message gives no reason. The certificate, its CA or "
        "crl.pem has expired, is not valid yet or is damaged; or the certificate is revoked, or "
        "from another CA",
        _EXPLAIN_REMEDY,
        (*_CERTIFICATE_FAULTS, Fault.CERTIFICATE_MALFORMED, *_CA_FAULTS, *_CRL_FAULTS),
    ),
    _log_text(
        "ca", _FAST, r"Error '(?P<number>\d+)' verifying CA certificate"
        r"(?: for \S.*?(?P<reason>: [a-z][\w ,()-]*?))?(?= \(\S+:\d+\)|\Z)",
        "the first certificate in a CA file is not accepted (OpenSSL's error {number}{reason})",
        _EXPLAIN_REMEDY, (*_CA_FAULTS, Fault.CERTIFICATE_MALFORMED),
        refuses=RefusedObject.PARTICIPANT,
    ),
    _log_text(
        "key-mismatch", _FAST, r"Error verifying private key",
        "key.pem is not the key of cert.pem",
        "Restore the key, or give the enclave a new one: `sros renew KEYSTORE ENCLAVE --new-key`.",
        (Fault.KEY_MISMATCH,),
        refuses=RefusedObject.PARTICIPANT,
    ),
    _log_text(
        "token", _FAST, r"Error opening the private key \w+=|Error retrieving 'pkcs11' engine"
        r"|Error initializing the HSM provider library|Error setting the PIN in the 'pkcs11'",
        "the key is on a PKCS#11 token that Fast DDS cannot use: the token, OpenSSL's engine "
        "(libengine-pkcs11-openssl), the token's PKCS#11 module or the PIN is missing or wrong",
        "`sros verify DIR --tokens` asks the token for the key.", (Fault.TOKEN_URI,),
        refuses=RefusedObject.PARTICIPANT,
    ),
    _log_text(
        "key-unreadable", _FAST, r"Error obtaining private key",
        "key.pem is encrypted, damaged or empty",
        "Store the key as PEM without a passphrase. If it is damaged, give the enclave a "
        "new key: `sros renew KEYSTORE ENCLAVE --new-key`.",
        (*_KEY_FAULTS, *_FILE_FAULTS),
        refuses=RefusedObject.PARTICIPANT,
    ),
    _log_text(
        "file-missing", _FAST, r"OpenSSL library cannot read file (?P<path>\S+)",
        "the file {path} is missing or not readable", _MAKE_READABLE, _FILE_FAULTS,
        remedy_without_fault=_MAKE_READABLE,
    ),
    _log_text(
        "file-missing", _FAST, r"Cannot (?:read|find) file file://(?P<path>\S+)",
        "the file {path} is missing or not readable", _MAKE_READABLE, _FILE_FAULTS,
        remedy_without_fault=_MAKE_READABLE,
    ),
    _log_text(
        "signature", _FAST, r"PKCS7 data verification failed",
        "governance.p7s or permissions.p7s was changed, or signed by another CA than the "
        "permissions CA next to it; the message does not say which",
        _SIGN_DOCUMENT, _SIGNATURE_FAULTS,
        refuses=RefusedObject.PARTICIPANT,
    ),
    _log_text(
        "not-signed", _FAST, r"Input data has not PKCS7 S/MIME format",
        "governance.p7s or permissions.p7s is not a signed document: plain XML, or damaged; the "
        "message does not say which", _SIGN_DOCUMENT, _SIGNATURE_FAULTS,
        refuses=RefusedObject.PARTICIPANT,
    ),
    _log_text(
        "grant", _FAST, r"Not found the identity subject name in permissions file",
        "one of three causes: the permissions have expired, are not valid yet, or have no grant "
        "for this subject name. Fast DDS reads the dates in the local time of the host",
        _EXPLAIN_REMEDY, _GRANT_FAULTS,
        refuses=RefusedObject.PARTICIPANT,
    ),
    _log_text(
        "domain-of-permissions", _FAST, r"Not found a rule allowing to use the domain_id",
        "the permissions are not for the domain of this process", _SET_DOMAIN,
        (Fault.PERMISSIONS_DOMAIN,),
        refuses=RefusedObject.PARTICIPANT,
    ),
    _log_text(
        "domain", _FAST, r"Not found topic access rule for topic (?P<topic>[^\s)]+)",
        "the governance has no rule for the topic in the domain of this process: most often "
        "because the governance does not list the domain (ROS_DOMAIN_ID)", _SET_DOMAIN,
        (Fault.GOVERNANCE_DOMAIN,),
        refuses=RefusedObject.TOPIC,
    ),
    _log_text(
        "malformed", _FAST, r"Malformed (?P<document>permissions|governance) file"
        r"|Error loading (?:Permissions|Governance) XML|XMLPARSER\s*Error\].*Function "
        r"parse_(?:grant|rule|criteria|permissions|domain|topic|participant|governance)",
        "Fast DDS does not accept a document, although it is signed correctly",
        "Generate the document with sros; `sros check` reports what vendors read differently.",
        _DOCUMENT_FAULTS,
        refuses=RefusedObject.PARTICIPANT,
    ),
    _log_text(
        "partition", _FAST, r"partition not found in rule",
        "a rule names the topic, but not the partitions of this publisher or subscriber",
        "Leave partitions out of permissions; sros never writes them.",
        refuses=RefusedObject.TOPIC,
    ),
    _log_text(
        "endpoint-gone", _FAST, r"Cannot find (?:local|remote) (?:reader|writer|participant)\b",
        "a message could not be protected, because its writer, its reader or the peer is not known "
        "yet or has just gone: this happens when a process starts or ends",
        "Do nothing if such messages stop. If they continue, restart the process and its peers.",
        vagueness=1,
    ),
)  # fmt: skip

_CONSEQUENCE_TEXTS = (
    _log_text(
        "plugin-unset", _FAST, r"Authentication plugin not configured. Security will be disabled",
        "the process RUNS UNSECURED: it has no enclave",
        "Start the process with `sros run KEYSTORE ENCLAVE -- COMMAND`, which runs a process "
        "secured or not at all.",
    ),
    _log_text(
        "participant", _FAST, r"Error while configuring security plugin"
        r"|Participant is not allowed with its own permissions file"
        r"|SecurityManager::init :\s*\Z|Cryptography plugin not configured",
        "the process is not allowed to join; Fast DDS 2.14 gives the reason in another line, or "
        "in the file of ROS_SECURITY_LOG_FILE, and neither is in this log",
        _EXPLAIN_OR_LOG_FILE, _ALL_FAULTS,
        remedy_without_fault=_LOG_FILE_REMEDY, vagueness=1,
    ),
    _log_text(
        "participant", _FAST, r"Cannot create participant due to initialization error"
        r"|Problem creating RTPSParticipant|failed to create participant",
        "the process is not allowed to join, and this log gives no reason: Fast DDS 2.6 and 2.9 "
        "log nothing about signatures, expired permissions and subjects; later releases log why, "
        "on standard output or in the file of ROS_SECURITY_LOG_FILE",
        _EXPLAIN_OR_LOG_FILE, _ALL_FAULTS,
        remedy_without_fault=_LOG_FILE_REMEDY, vagueness=2,
    ),
    _log_text(
        "endpoint", _CYCLONE, r"failed to create (?:writer|reader)\b",
        "the permissions deny a publisher, subscription, client or server, but allow its topic in "
        "the other direction, for example to a client in place of a server; this message does not "
        "name the topic",
        f"Start the node with `CYCLONEDDS_URI='{_CYCLONE_TRACE}'` to see the topic, and explain "
        "the new log.",
        vagueness=3,
    ),
    _log_text(
        "service", _ROS, r"(?:could not|failed to) create (?:service|client|action \w+)"
        r"|create_(?:service|client)\(\) failed",
        "the permissions deny a service or client that this message does not name. If the node "
        "fails when it is created, a standard service of the node is denied: the node has another "
        "name or namespace than in the policy",
        "Compare the node's name and namespace with the policy's profile (ns, node); the line that "
        "names the topic is on standard output or in the file of ROS_SECURITY_LOG_FILE.",
        vagueness=2,
    ),
    _log_text(
        "endpoint", _ROS, r"Not Allowed By Security", _DENIED_ENDPOINT, _FIND_TOPIC,
        vagueness=3,
        refuses=RefusedObject.TOPIC,
    ),
    _log_text(
        "endpoint", _ROS, r"invalid allocator|Problem creating associated (?:Reader|Writer)"
        r"|(?:could not|failed to) create (?:publisher|subscription|topic)"
        r"|create_(?:publisher|subscription)\(\) could not create",
        _DENIED_ENDPOINT, _FIND_TOPIC, vagueness=3,
    ),
)  # fmt: skip
"""Messages that follow from an earlier message, which has the reason."""

_DENIED_TOPIC_TEXTS = (
    _log_text(
        # Matched only at the start of a word, for speed: a line may be one very long word.
        "topic-denied", _FAST, r"(?<![^\s(])(?P<topic>[^\s(]+) topic "
        r"(?P<rule>not found in allow|denied by deny) rule",
        refuses=RefusedObject.TOPIC,
    ),
    _log_text(
        "topic-denied", _CYCLONE,
        r"(?:(?P<neither>Local topic permission denied)|(?:Writer|Reader) is not permitted): "
        r"(?P<topic>\S+) (?P<rule>denied by default rule|found in deny_rule)",
        refuses=RefusedObject.TOPIC,
    ),
    _log_text(  # rmw_cyclonedds, which also has reasons other than a refusal
        "topic-denied", _CYCLONE,
        r"(?P<neither>failed to create topic) \[(?P<topic>[^\]\s]+)\] for unknown reasons",
        refuses=RefusedObject.TOPIC,
    ),
    _log_text(  # the nodes of `sros demo`
        "topic-denied", _CYCLONE,
        r"cannot create (?:(?P<neither>topic)|a (?:writer|reader) on) (?P<topic>\S+)\. "
        r"Not Allowed By Security",
        refuses=RefusedObject.TOPIC,
    ),
)  # fmt: skip
"""Messages about denied topics; nearby lines show the denied right and the node."""

_CAUSELESS_TEXTS = (
    _log_text("refusal", _FAST, r"validate_local_identity|verifying CA certificate",
          refuses=RefusedObject.PARTICIPANT),
    _log_text("refusal", _CYCLONE, r"Error occurred while validating local (?:permission|identity)"
          r"|validate_local_identity", refuses=RefusedObject.PARTICIPANT),
    _log_text("refusal", _FAST, r"topic (?:not found in allow|denied by deny) rule",
          refuses=RefusedObject.TOPIC),
    _log_text("refusal", _CYCLONE, r"denied by default rule|found in deny_rule",
          refuses=RefusedObject.TOPIC),
)  # fmt: skip
"""Messages about refusals, without a cause."""

LOG_TEXTS: tuple[LogText, ...] = (
    *_ROS_TEXTS,
    *_CYCLONE_PARTICIPANT_TEXTS,
    *_CYCLONE_START_TEXTS,
    *_FAST_PARTICIPANT_TEXTS,
    *_FAST_START_TEXTS,
    *_CONSEQUENCE_TEXTS,
    *_DENIED_TOPIC_TEXTS,
    *_CAUSELESS_TEXTS,
)
"""All known log texts, in order: the first text that matches a line counts."""

_SECURITY_WORDS = (
    r"DDS[-:. ]?sec|dds_sec|ROS_SECURITY_|identity[_ ]ca|permissions[_ ]ca"
    r"|(?:cert|key|crl)\.pem|(?:governance|permissions)\.(?:p7s|xml)|\.p7s\b"
    r"|validate_(?:local|remote)_|PKCS ?#?7|\bS/?MIME|X\.?509|TRUSTED CERTIFICATE"
)
"""Words that occur in the log of a robot only because of DDS Security and its files."""
_AMBIGUOUS_WORDS = (
    rf"{_SECURITY_WORDS}|\bsecurity|non.?secure|permissions?[_ ]ca|\bgovernance\b|\bpermissions\b"
    r"|\bPEM\b|handshake|certificate|private key|authenticated\b|crypto|decrypt"
    r"|access[ _]?control|\benclave|keystore|\bCRL\b"
)
"""Words about DDS Security, or about the security or packages of other programs."""
_MIDDLEWARE_ORIGINS = (
    r"\b(?:rcl|rmw)\w{0,40}\b|fast.?(?:dds|rtps)|cyclone|\bdds|openssl|\bwhat\(\): "
    r"|\[\w{1,40} (?:Error|Warning)\]"
)
"""The origins of a message of the middleware: loggers, libraries, categories of Fast DDS."""
_FAILURE_WORDS = (
    r"error|fail|cannot|can't|could not|couldn't|unable|invalid|refus|denied|expired|reject"
    r"|disabled|not (?:allowed|found|valid|trusted|permitted|supported)|missing|mismatch|unknown"
    r"|expect"
)

UNKNOWN = LogText(
    "not-understood",
    _ROS,
    re.compile(
        r"\[\w{0,40}SECURITY\w{0,40} (?:Error|Warning)\]"
        # Any line of the file of ROS_SECURITY_LOG_FILE, which stays empty without problems.
        r"|\[[A-Z]{4,13}\] [^\s|]+\|[^\s|]+ \d+ \w+::\w+ :"
        # Cyclone DDS, except its trace of success.
        r"|\A\d+\.\d+ \[\d*\]\s+\S+: (?! *(?:set|send|remember) \w+ tokens"
        r"| *(?:set|match)_remote_|.*(?:DDS Security plugins have been loaded|is already loaded"
        r"|using security settings from|allow non-secure remote|FSM: |handshake (?:delete|resend)"
        r"|config: |(?:PARTICIPANT|WRITER|READER) \S+ QOS=|write_sample |data\(builtin"
        r"|validate_local_identity: candidate_guid|cleanup participant|SPDP ST"
        r"|crypto=\d|waiting for approval|\) (?:processed|send tokens|succeeded)))"
        rf".*(?:{_AMBIGUOUS_WORDS}|plugin|not allowed|token|encoded|authenticat"
        r"|Could not (?:load|find))"
        r"|SECURITY ERROR"
        # Any other program that speaks of DDS Security and of trouble, or the middleware that
        # speaks of security and of trouble, at no level that means none, but not the source in a
        # traceback.  A node may have a package, a list or a key of its own that has such a name.
        rf"|\A(?! {{4}}|(?:\[[\w.-]+\] )*\[(?:INFO|DEBUG)\])(?=.*?(?:{_FAILURE_WORDS}))"
        rf"(?:(?=.*?(?:{_MIDDLEWARE_ORIGINS})).*?(?:{_AMBIGUOUS_WORDS})|.*?(?:{_SECURITY_WORDS}))",
        re.IGNORECASE,
    ),
    "a line of DDS Security that sros does not know",
    "Read the line, which may matter. If a node did not start, `sros check KEYSTORE` and "
    "`sros explain KEYSTORE ENCLAVE join` check all that DDS checks.",
)
"""The meaning of a line that looks like a DDS Security message but is not in `LOG_TEXTS`."""

_NAME_ENCLAVE = (
    "start the process with `sros run KEYSTORE ENCLAVE -- COMMAND`, or name its enclave in "
    "ROS_SECURITY_ENCLAVE_OVERRIDE or `--ros-args --enclave`. Do not create an enclave /: every "
    "process that names no enclave would run in /."
)
NO_ENCLAVE = _log_text(
    "no-enclave", _ROS, "",
    "no enclave is named for this process, so it looked for the files of the enclave /, and the "
    "keystore has no enclave /",
    f"Name an enclave: {_NAME_ENCLAVE}",
    refuses=RefusedObject.PARTICIPANT,
)  # fmt: skip
"""The meaning of `files-missing` in a process that named no enclave."""
_AFTER_START = "security directory: "
RUNS_OPEN = _log_text(
    "runs-open", _ROS, _AFTER_START,
    "no enclave is named for this process, so it gets the enclave /. If the keystore has no "
    "enclave /, the process does not start with ROS_SECURITY_STRATEGY=Enforce; with any other "
    "value, it RUNS UNSECURED without a further message",
    f"If the process runs, stop the process. Then {_NAME_ENCLAVE}", vagueness=4,
)  # fmt: skip
"""The meaning of rcl's line about the enclave /, which is missing, without an error after it."""
RAN_OPEN = _log_text(
    "ran-open", _ROS, _AFTER_START,
    "the enclave lacks a file, yet this log shows no refusal that sros knows: on DDS the node RAN "
    "UNSECURED (ROS_SECURITY_STRATEGY is not exactly Enforce), unless the file went missing later",
    "Start the node with `sros run KEYSTORE ENCLAVE -- COMMAND`, which runs a node secured or "
    "not at all.",
    (*BEFORE_DDS, Fault.KEY_ON_TOKEN), vagueness=4,
)  # fmt: skip
"""The meaning of rcl's line about an enclave that lacks a file, without an error after it."""
UNNOTICED_FAULT = _log_text(
    "unnoticed-fault", _ROS, _AFTER_START,
    "the enclave has a fault, yet this log shows no refusal that sros knows. Either the fault came "
    "after the start, or only the node's peers notice it, or the node's DDS accepts it",
    "Correct the fault, and start the node again.", _ALL_FAULTS, vagueness=4,
)  # fmt: skip
"""The meaning of rcl's line about an enclave with another fault, without an error after it."""
STARTS = (RUNS_OPEN, RAN_OPEN, UNNOTICED_FAULT)
"""The meanings of rcl's line about the enclave, by the state of the enclave."""
