"""Read what the DDS vendors log about security: was it a refusal, or is security not built in?

Fast DDS writes coloured text to standard output, Cyclone DDS to its log sink or standard error.
The texts are those of Fast DDS 2.9 to 2.14 (Permissions.cpp, SecurityManager.cpp, PKIDH.cpp) and
of Cyclone DDS 0.10 (access_control.c, authentication.c, q_omg_security.c).

Each text was seen in a real log of Fast DDS 2.9.1 or 2.14.5, Cyclone DDS 0.10.2, or rcl of Jazzy.
With ROS_SECURITY_LOG_FILE the reasons of Fast DDS stand in that file, in another form, instead.
Many stand for several causes; `Meaning.codes` are the faults of an enclave (`Problem.code`) among
which the true one is found by looking at the enclave.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from sros_tool.dds.decision import Vendor

_COLOUR = re.compile(r"\x1b\[[0-9;]*m")

_FRAME = re.compile(
    # Fast DDS: when, `[SECURITY Error]`, the place in its sources, and the function.
    r"^\d{4}-\d\d-\d\d \d\d:\d\d:\d\d[.\d]* (?=\[)|\[SECURITY\w* (?:Error|Warning)\]\s*"
    r"|\s*\([^()\s]+\.(?:cpp|h|hpp|ipp):\d+\)|\s*-> Function \w+\Z|, at \S+\.(?:cpp|c):\d+"
    # The file of ROS_SECURITY_LOG_FILE: when, severity, participant, domain, and the function.
    r"|^\S+ \[[A-Z]+\] \S+ \d+ \w+::\w+ :\s*"
    # Cyclone DDS and OpenSSL: when and by which thread, numbers, and places in their sources.
    r"|^\d+\.\d+ \[\d*\]\s+\S+: |(?:candidate|adjusted)_guid: \S+ "
    r"|Remote secure participant \S+ not allowed\. ?|[0-9A-F]{16}:error:[0-9A-F]+:[\w ]+:"
    r"|:\.\./\S+\.c:\d+|\[\w+\] failed: |validate_local_identity: |Error\. (?=Error|validate)"
)
"""What is put around the reason of a refusal and says nothing to a person."""

CYCLONE_EXPLAINS = {
    "CYCLONEDDS_URI": "<CycloneDDS><Domain><Tracing><Category>fatal,error,warning,trace</Category>"
    "<OutputFile>stderr</OutputFile></Tracing></Domain></CycloneDDS>"
}
"""Makes Cyclone DDS say why it denies a topic, which it tells only its trace."""

_NO_REASON = "{}, and Fast DDS gives no reason"
_FUNCTION = re.compile(r"(?:-> Function |::)(\w+)(?: :)?\s*\Z")
"""Of a line of Fast DDS that has no text of its own, what did not succeed."""

_ENDPOINT_REFUSALS = (
    "topic not found in allow rule",
    "topic denied by deny rule",
    "partition not found in rule",
    "not found topic access rule for topic",
    "not allowed by security",
    "denied by default rule",
    "found in deny_rule",
)
_PARTICIPANT_REFUSALS = (
    "validate_local_identity",
    "error verifying private key",
    "error obtaining private key",
    "verifying ca certificate",
    "pkcs7 data verification failed",
    "input data has not pkcs7",
    "not found the identity subject name in permissions file",
    "not found a rule allowing to use the domain_id",
    "malformed permissions file",
    "malformed governance file",
    "error occurred while validating local permission",
    "error occurred while validating local identity",
    "could not find domain",
    "couldn't find all security files",
)
_NOT_BUILT_IN = (
    "doesn't have the security libraries",
    "-dsecurity=on",
    "compiled without security",
    "security not supported",
    "security is not supported",
)


def endpoint_refusal(text: str) -> str:
    """The words in which DDS Security denies a topic, a writer or a reader, or ""."""
    return _first_line_with(_ENDPOINT_REFUSALS, text)


def participant_refusal(text: str) -> str:
    """The words in which DDS Security refuses a participant's files or its domain, or ""."""
    return _first_line_with(_PARTICIPANT_REFUSALS, text)


def missing_security(text: str) -> str:
    """The words in which a DDS says that it was built without DDS Security, or ""."""
    return _first_line_with(_NOT_BUILT_IN, text)


def plain_text(output: str) -> str:
    """What a process printed, without colours."""
    return _COLOUR.sub("", output)


def plain_refusal(line: str) -> str:
    """The words of a line of a DDS log: without time, severity, and places in its sources.

    Never empty where the line is not: of a refusal without a reason it says what was refused.
    """
    line = " ".join(plain_text(line).split())
    if words := " ".join(_FRAME.sub("", line).split()):
        return words
    function = _FUNCTION.search(line)
    return _NO_REASON.format(function[1].replace("_", " ") + " failed") if function else line


def _first_line_with(marks: tuple[str, ...], text: str) -> str:
    for line in plain_text(text).splitlines():
        lowered = line.lower()
        if any(mark in lowered for mark in marks):
            return plain_refusal(line)
    return ""


ROS = None
"""The vendor of messages that rcl prints, whatever DDS lies below."""

_CERTIFICATE = ("certificate-expired", "certificate-not-yet-valid", "certificate-issuer")
_CA = ("ca-expired", "ca-not-yet-valid")
_CRL = ("crl-expired", "crl-malformed", "crl-issuer", "crl-not-yet-valid", "revoked")
_FILES = ("file-missing", "file-empty", "file-unreadable", "link-dangling")
_KEY = ("key-encrypted", "key-malformed")
_SIGNATURE = ("signature", "not-signed")
_GRANT = ("permissions-expired", "permissions-not-yet-valid", "permissions-subject")
_DOCUMENT = ("permissions-malformed", "governance-malformed")
_ALL = (
    *_CERTIFICATE, "certificate-malformed", *_CA, *_CRL, *_FILES, *_KEY, "key-mismatch",
    *_SIGNATURE, *_GRANT, *_DOCUMENT, "governance-domain", "permissions-domain",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Meaning:
    """What a message means.

    ``cause`` may use the groups of ``pattern``.  ``codes`` are the faults it can stand for, if it
    is about the enclave of the process itself; ``unseen`` is what to do where it has none of them.
    ``weak`` is 0 for a message that tells a cause, and higher the less it tells: of the messages
    of a process the least weak ones count.
    """

    id: str
    vendor: Vendor | None
    pattern: re.Pattern[str]
    cause: str
    remedy: str
    codes: tuple[str, ...] = ()
    unseen: str = ""
    weak: int = 0


def _meaning(
    name: str,
    vendor: Vendor | None,
    pattern: str,
    cause: str,
    remedy: str,
    codes: tuple[str, ...] = (),
    *,
    unseen: str = "",
    weak: int = 0,
) -> Meaning:
    expression = re.compile(pattern, re.IGNORECASE)
    return Meaning(name, vendor, expression, cause, remedy, codes, unseen, weak)


_CHECK = "Name the keystore and the enclave, and the true cause is looked for there."
_FILE = "Where ROS_SECURITY_LOG_FILE is set, give `sros explain --log` that file."
_CHECK_OR_FILE = f"{_CHECK} {_FILE}"
_RENEW = "Renew it: `sros renew KEYSTORE ENCLAVE`."
_SIGN = "Sign the permissions again: `sros create_permission KEYSTORE ENCLAVE POLICY`."
_SIGN_ONE = (
    f"Name the keystore and the enclave, and which of the two it is is looked for there. {_SIGN} "
    "A governance has to be restored from a backup: every enclave depends on it."
)
_READABLE = (
    "Let the user that runs the node read it, and enter the folders above it: `ls -lL {path}` run "
    "as that user shows whether it may."
)
_SET_DOMAIN = (
    "Set ROS_DOMAIN_ID to a domain of the keystore: `sros env KEYSTORE ENCLAVE --domain ID` prints "
    "the variables."
)
_PEERS = "Give both sides enclaves of the same keystore; `sros inspect` shows the CA of each."
_FAST, _CYCLONE = Vendor.FAST, Vendor.CYCLONE

MEANINGS: tuple[Meaning, ...] = (
    # ── rcl and the RMWs ───────────────────────────────────────────────────────────────────
    _meaning(
        "not-built-in", ROS, r"doesn't have the security libraries|compile Fast DDS using the"
        r"|security (?:is )?not supported|compiled without security",
        "this DDS was built without DDS Security, so no secured node can start with it",
        "Use the ROS 2 packages of the distribution; `sros doctor` tells which DDS enforces.",
    ),
    _meaning(
        "enclave-missing", ROS,
        r"rcl: SECURITY ERROR: directory '(?P<path>[^']*)' does not exist",
        "the enclave's folder {path} does not exist: ROS_SECURITY_KEYSTORE or the enclave's name "
        "is not right", "Correct it: `sros list_enclaves KEYSTORE` shows the names.",
    ),
    _meaning(
        "runs-unsecured", ROS, r"SECURITY ERROR: directory '(?P<path>[^']*)' does not exist",
        "the enclave's folder {path} does not exist, and as ROS_SECURITY_STRATEGY is not exactly "
        "Enforce, the node GOES ON UNSECURED",
        "Start it by `sros run`, which runs it secured or not at all.",
    ),
    _meaning(
        "keystore-unset", ROS, r"failed to initialize rcl: error not set",
        "security is on, and ROS_SECURITY_KEYSTORE is unset or empty",
        "Set it to the folder of the keystore: `sros env KEYSTORE ENCLAVE` prints all variables.",
    ),
    _meaning(
        "files-missing", ROS, r"couldn't find all security files",
        "a file of the enclave is missing or a link to nothing; which one, it does not say",
        "Complete it: `sros create_enclave KEYSTORE ENCLAVE`, or export it again.", _FILES,
    ),
    # ── Cyclone DDS, meeting peers ─────────────────────────────────────────────────────────
    _meaning(
        "peer-refused", _CYCLONE, r"(?:Begin|Process) handshake (?:request |reply )?failed: "
        r"Certificate not valid: error: (?P<why>[^;]+)",
        "a PEER was refused, not this process: its certificate is not accepted ({why}); with "
        "another CA on either side, the other one logs this or nothing",
        _PEERS,
    ),
    _meaning(
        "peer-handshake", _CYCLONE, r"(?:Begin|Process) handshake (?:request |reply )?failed",
        "a PEER failed to prove who it is: most often its key.pem is not the key of its cert.pem, "
        "which Cyclone DDS does not notice on its own side; or it is of another DDS or version",
        "Run `sros verify` or `sros inspect` on the enclave of every peer.", ("key-mismatch",),
    ),
    # ── Cyclone DDS, starting ──────────────────────────────────────────────────────────────
    _meaning(
        "certificate-expired", _CYCLONE, r"Certificate not valid: error: certificate has expired",
        "the certificate of the enclave or of its identity CA has expired; which, it does not say",
        _RENEW, ("certificate-expired", "ca-expired"),
    ),
    _meaning(
        "certificate-not-yet-valid", _CYCLONE, r"Certificate not valid: error: certificate is not "
        r"yet valid", "the certificate of the enclave or of its identity CA is not valid yet",
        "Set the clock of the host.", ("certificate-not-yet-valid", "ca-not-yet-valid"),
    ),
    _meaning(
        "certificate-issuer", _CYCLONE, r"Certificate not valid: error: unable to get "
        r"(?:local )?issuer certificate|Certificate not valid: error: self.signed",
        "the certificate was not issued by the identity CA that lies with it",
        "Use the files of one keystore together.", ("certificate-issuer",),
    ),
    _meaning(
        "revoked", _CYCLONE, r"Certificate not valid: error: certificate revoked",
        "the certificate of the enclave is revoked",
        "It is meant to be kept out; if it shall run again, make it again with another key: `sros "
        "create_enclave KEYSTORE ENCLAVE`.",
        ("revoked",),
    ),
    _meaning(
        "crl-expired", _CYCLONE, r"Certificate not valid: error: CRL (?:has expired|is not yet)",
        "the revocation list is out of date, so that everybody is refused",
        "Sign it again: `sros crl KEYSTORE --refresh`.", ("crl-expired", "crl-not-yet-valid"),
    ),
    _meaning(
        "crl-unreadable", _CYCLONE, r"Failed to read CRL",
        "crl.pem is not a revocation list, so that everybody is refused",
        "Sign it again: `sros crl KEYSTORE --refresh`.", ("crl-malformed",),
    ),
    _meaning(
        "key-encrypted", _CYCLONE, r"Failed to parse certificate: .*(?:bad decrypt|empty password)",
        "it says certificate and means the key: key.pem is encrypted, and no passphrase is asked",
        "Store key.pem without a passphrase, mode 0600.", ("key-encrypted",),
    ),
    _meaning(
        "pem-unreadable", _CYCLONE, r"Failed to parse (?:certificate|private key)",
        "cert.pem or key.pem is no PEM file; it says certificate for both",
        "Restore the file.", ("certificate-malformed", *_KEY, *_FILES),
    ),
    _meaning(
        "signature", _CYCLONE, r"PKCS7_signatureVerify:digest failure",
        "governance.p7s or permissions.p7s was changed after it was signed",
        _SIGN_ONE, _SIGNATURE,
    ),
    _meaning(
        "signer", _CYCLONE, r"PKCS7_verify:certificate verify error",
        "governance.p7s or permissions.p7s was signed by another CA than the permissions CA that "
        "lies with it", f"Use the files of one keystore together. {_SIGN_ONE}", _SIGNATURE,
    ),
    _meaning(
        "not-signed", _CYCLONE, r"SMIME_read_ASN1_ex:no content type|SMIME_read_ASN1",
        "governance.p7s or permissions.p7s is plain XML or damaged, and not a signed document",
        _SIGN_ONE, _SIGNATURE,
    ),
    _meaning(
        "permissions-expired", _CYCLONE, r"Permissions validity period expired(?P<when>[^)]*\))?",
        "the permissions have expired", _RENEW, ("permissions-expired",),
    ),
    _meaning(
        "permissions-not-yet-valid", _CYCLONE, r"Permissions validity period has not started",
        "the permissions are not valid yet", "Set the clock of the host.",
        ("permissions-not-yet-valid",),
    ),
    _meaning(
        "permissions-subject", _CYCLONE, r"Subject name is invalid",
        "the permissions have no grant for the subject of this certificate: they belong to another "
        "enclave, or to an earlier certificate", _SIGN, ("permissions-subject",),
    ),
    _meaning(
        "domain", _CYCLONE, r"Could not find domain (?P<domain>\d{1,9}) in governance",
        "the governance is not for domain {domain}",
        _SET_DOMAIN, ("governance-domain",),
    ),
    _meaning(
        "malformed", _CYCLONE, r"Can not parse (?P<what>governance|permissions) file",
        "the {what} document, although signed, is not one that Cyclone DDS accepts",
        "Have sros write it; `sros check` names what vendors read differently.",
        _DOCUMENT,
    ),
    _meaning(
        "file-missing", _CYCLONE, r"File could not be found, opened or is empty, path: "
        r"(?P<path>\S+)",
        "the file {path} is missing, empty or not readable", "Restore it.", _FILES,
    ),
    # ── Fast DDS, meeting peers ────────────────────────────────────────────────────────────
    _meaning(
        "peer-permissions-ca", _FAST, r"Remote participant PermissionsCA differs from local",
        "a PEER was refused: its permissions CA is not that of this process. The two have enclaves "
        "of different keystores, or one was started before the CA was replaced and one after",
        _PEERS + " Restart both after each stage of `sros rotate_ca KEYSTORE`.",
    ),
    _meaning(
        "peer-version", _FAST, r"Remote participant PermissionsCA algorithm differs from local",
        "a PEER was refused: it runs another version of Fast DDS, or its permissions CA has a key "
        "of another kind", "Run one version of Fast DDS on all hosts of the robot.",
    ),
    _meaning(
        "peer-permissions", _FAST, r"Remote participant doesn't found in its permissions file",
        "a PEER was refused: by the clock and the time zone of this host its permissions have "
        "expired or are not valid yet, or they have no grant for its certificate",
        "Compare clocks and time zones of both hosts, for Fast DDS reads dates in local time; "
        "`sros inspect KEYSTORE` shows how long each enclave is valid, and `sros renew KEYSTORE "
        "ENCLAVE` renews the peer's.",
    ),
    _meaning(
        "peer-signature", _FAST, r"Cannot read as PKCS7 the permissions file",
        "a PEER was refused: its permissions are not signed by the permissions CA of this process, "
        "although that has the same name: enclaves of two keystores, or a changed file", _PEERS,
    ),
    _meaning(
        "peer-malformed", _FAST,
        r"Error validating remote permissions for \S+ \(Malformed permissions file",
        "a PEER was refused: its permissions, although signed, are not such as Fast DDS accepts",
        "Have sros write those of the peer: `sros create_permission KEYSTORE ENCLAVE POLICY`.",
    ),
    _meaning(
        "peer-domain", _FAST, r"Error checking remote participant"
        r"|Not found a rule allowing to use the domain_id.*check_remote_participant"
        r"|check_remote_participant.*Not found a rule allowing to use the domain_id",
        "a PEER was refused: its permissions are not for this domain",
        "Sign those of the peer again, with this domain: `sros create_permission KEYSTORE ENCLAVE "
        "POLICY` takes the domains of the keystore.",
    ),
    _meaning(
        "peer-refused", _FAST, r"Error validating remote permissions for"
        r"|Remote participant doesn't sent the signed permissions|Not receive remote permissions",
        "a PEER was refused, not this process: its permissions did not arrive, or are not accepted",
        _PEERS,
    ),
    # ── Fast DDS, starting ─────────────────────────────────────────────────────────────────
    _meaning(
        "identity", _FAST, r"SECURITY\s*Error\]\s*->\s*Function validate_local_identity"
        r"|PKIDH::validate_local_identity :\s*\Z",
        "the identity is refused, and the reason is left out: the certificate or its CA is out of "
        "date, of another CA, damaged or revoked, or crl.pem is out of date or damaged",
        _CHECK, (*_CERTIFICATE, "certificate-malformed", *_CA, *_CRL),
    ),
    _meaning(
        "ca", _FAST, r"Error '(?P<number>\d+)' verifying CA certificate"
        r"(?: for \S.*?: (?P<why>[a-z][\w ,()-]*?))?(?= \(\S+:\d+\)|\Z)",
        "the first certificate of a CA's file is not accepted (OpenSSL's error {number}: {why})",
        _CHECK, (*_CA, "certificate-malformed"),
    ),
    _meaning(
        "key-mismatch", _FAST, r"Error verifying private key",
        "key.pem is not the key of cert.pem",
        "Restore the key, or give the enclave another: `sros renew KEYSTORE ENCLAVE --new-key`.",
        ("key-mismatch",),
    ),
    _meaning(
        "key-unreadable", _FAST, r"Error obtaining private key",
        "key.pem is encrypted, damaged or empty", "Store it as PEM without a passphrase.",
        (*_KEY, *_FILES),
    ),
    _meaning(
        "file-missing", _FAST, r"OpenSSL library cannot read file (?P<path>\S+)",
        "the file {path} is missing or not readable", _READABLE, _FILES, unseen=_READABLE,
    ),
    _meaning(
        "file-missing", _FAST, r"Cannot (?:read|find) file file://(?P<path>\S+)",
        "the file {path} is missing or not readable", _READABLE, _FILES, unseen=_READABLE,
    ),
    _meaning(
        "signature", _FAST, r"PKCS7 data verification failed",
        "governance.p7s or permissions.p7s was changed, or signed by another CA than the "
        "permissions CA that lies with it; which of the two, it does not say",
        _SIGN_ONE, _SIGNATURE,
    ),
    _meaning(
        "not-signed", _FAST, r"Input data has not PKCS7 S/MIME format",
        "governance.p7s or permissions.p7s is not a signed document: plain XML, or damaged; which "
        "of the two, it does not say", _SIGN_ONE, _SIGNATURE,
    ),
    _meaning(
        "grant", _FAST, r"Not found the identity subject name in permissions file",
        "one text for three causes: the permissions have expired, are not valid yet, or have no "
        "grant for this subject. Fast DDS reads their dates in the local time of the host",
        _CHECK, _GRANT,
    ),
    _meaning(
        "domain-of-permissions", _FAST, r"Not found a rule allowing to use the domain_id",
        "the permissions are not for the domain of this process", _SET_DOMAIN,
        ("permissions-domain",),
    ),
    _meaning(
        "domain", _FAST, r"Not found topic access rule for topic (?P<topic>[^\s)]+)",
        "the governance has no rule for the topic in the domain of this process: most often "
        "because it does not list that domain (ROS_DOMAIN_ID)", _SET_DOMAIN,
        ("governance-domain",),
    ),
    _meaning(
        "malformed", _FAST, r"Malformed (?P<what>permissions|governance) file"
        r"|Error loading (?:Permissions|Governance) XML|XMLPARSER\s*Error\].*Function "
        r"parse_(?:grant|rule|criteria|permissions|domain|topic|participant|governance)",
        "a document, although signed, is not one that Fast DDS accepts",
        "Have sros write it; `sros check` names what vendors read differently.",
        _DOCUMENT,
    ),
    _meaning(
        "partition", _FAST, r"partition not found in rule",
        "a rule names the topic, but not the partitions of this publisher or subscriber",
        "Say nothing of partitions in permissions; sros never does.",
    ),
    # ── what follows on others ─────────────────────────────────────────────────────────────
    _meaning(
        "participant", _FAST, r"Error while configuring security plugin"
        r"|Participant is not allowed with its own permissions file",
        "the process may not join; Fast DDS 2.14 says why in a line of its own, or in the file of "
        "ROS_SECURITY_LOG_FILE, and neither is in this log", _CHECK_OR_FILE, _ALL,
        unseen=_FILE, weak=1,
    ),
    _meaning(
        "participant", _FAST, r"Cannot create participant due to initialization error"
        r"|Problem creating RTPSParticipant|failed to create participant",
        "the process may not join, and this log does not say why: Fast DDS 2.9 is silent about "
        "signatures, expired permissions and subjects, 2.14 tells its standard output or the file "
        "of ROS_SECURITY_LOG_FILE", _CHECK_OR_FILE, _ALL, unseen=_FILE, weak=2,
    ),
    _meaning(
        "service", ROS, r"(?:could not|failed to) create (?:service|client)"
        r"|create_(?:service|client)\(\) failed",
        "a service or client is denied by the permissions, and this text does not say which. Of a "
        "node that fails when it is created it is a service of its own: it runs under another "
        "name, or in another namespace, than the policy's node",
        "Compare the node's name and namespace with the policy's profile (ns, node); the line that "
        "names the topic is on standard output or in the file of ROS_SECURITY_LOG_FILE.", weak=2,
    ),
    _meaning(
        "endpoint", ROS, r"invalid allocator|Problem creating associated (?:Reader|Writer)"
        r"|(?:could not|failed to) create (?:publisher|subscription|topic)"
        r"|create_(?:publisher|subscription)\(\) could not create|Not Allowed By Security",
        "a publisher, subscription, client or server is denied by the permissions; this text does "
        "not say of which topic (`invalid allocator` has nothing to do with memory)",
        "Look for the line before it that names the topic, on standard output or in the file of "
        "ROS_SECURITY_LOG_FILE; or ask `sros explain` for each topic of the node.", weak=3,
    ),
)  # fmt: skip
"""In the order in which they are tried: the first that matches a line counts."""

UNKNOWN = Meaning(
    "not-understood",
    ROS,
    re.compile(
        r"\[SECURITY\w* (?:Error|Warning)\]"
        r"|\[(?:EMERGENCY|ALERT|CRITICAL|ERROR|WARNING)\] \S+ \d+ \w+::\w+ :"
        r"|\A\d+\.\d+ \[\d*\]\s+\S+: "
        r".*(?:[Ss]ecurity|handshake|[Pp]ermission|[Cc]ertificate|crypto)"
        r"|SECURITY ERROR"
    ),
    "a line of DDS Security that sros does not know",
    "Read it as it stands; what it is about may matter. If it kept a node from starting, `sros "
    "check KEYSTORE` and `sros explain KEYSTORE ENCLAVE join` look at all that DDS looks at.",
)
"""For what looks like a message of DDS Security and is none of `MEANINGS`, nor a denied topic."""
