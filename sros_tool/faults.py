"""The faults that the files of an enclave can have, each with title, effect and remedy.

Reading, checking and explaining a keystore reports these faults; messages of DDS vendors are mapped
to some of them.  A command in a remedy works on a keystore with that fault, and repairs it.
"""

from __future__ import annotations

import re
from enum import Enum

_SOURCE_RCL = "rcl 9 (security.c) and the RMWs of ROS 2 Jazzy."
_SOURCE_TESTS = "Fast DDS 2.6 to 3.6, Cyclone DDS 0.10 and 11.0; tested."
_CLOCK_BEHIND = "Often the clock of the robot is behind."

_RESTORE_FILE = "Restore {path} from a backup."
_RENEW_ENCLAVE = "Renew the enclave: `sros renew {root} {enclave}`."
_NEW_KEY = "Give the enclave another key: `sros renew {root} {enclave} --new-key`."
_LOST_KEY = (
    "Restore the key from a backup, or give the enclave another key: `sros renew {root} {enclave} "
    "--new-key`."
)
_SET_CLOCK = (
    "Set the clock of this host; if the clock is right, renew the enclave: `sros renew {root} "
    "{enclave}`."
)
_SET_CLOCK_FOR_CRL = (
    "Set the clock of this host; if the clock is right, sign the list again: `sros crl {root} "
    "--refresh`, and export it to the robots again."
)
_SIGN_PERMISSIONS = "Sign the permissions again: `sros create_permission {root} {enclave} POLICY`."
_CREATE_MISSING_FILE = "Create the missing file: `sros create_enclave {root} {enclave}`."
REPLACE = (
    "Replace the file with `rm {path} && sros create_enclave {root} {enclave}`: this links the "
    "keystore's file, or issues the file again."
)
_SET_DOMAIN = (
    "Set ROS_DOMAIN_ID to a domain of the keystore: `sros env {root} {enclave} --domain ID` prints "
    "the variables."
)
_SET_OR_ADD_DOMAIN = (
    f"{_SET_DOMAIN} To add a domain, name all domains in `sros update_keystore {{root}} --domain "
    "IDS --allow-looser`."
)
ORIGINAL_KEYSTORE = "keystore that has the CA keys"
"""How the remedies for an export name the keystore that issued it."""
KEY_MADE_ON_ROBOT = (
    " If the key was made on its robot, revoke the enclave, and make a new key there "
    "(docs/howto/one_robot.md: Keys that are made on the robot)."
)
"""Follows a remedy with `sros renew --new-key`, which replaces only the keys of the keystore."""
REFUSE_STRANGERS = (
    "`sros update_keystore KEYSTORE --set protection.allow_unauthenticated_participants=false`"
)
"""The command after which a keystore admits no process without an identity."""

_REMEDIES_IN_EXPORT = {
    _SET_CLOCK: "Set the clock of this host; if the clock is right, renew the enclave in the "
    "keystore that has the CA keys: `sros renew {root} {enclave}`. Then export the enclave again.",
    _SET_CLOCK_FOR_CRL: "Set the clock of this host; if the clock is right, sign the list again "
    "in the keystore that has the CA keys: `sros crl {root} --refresh`. Then export the enclave "
    "again.",
    _SET_OR_ADD_DOMAIN: f"{_SET_DOMAIN} To add a domain, name all domains in the "
    f"{ORIGINAL_KEYSTORE}: `sros update_keystore KEYSTORE --domain IDS "
    "--allow-looser`. Then export the enclave again.",
}
"""Remedies for an export, which has no CA keys, that differ from the remedies for a keystore."""
_REPAIR_GOVERNANCE = (
    "Every enclave depends on the governance. Restore {root}/enclaves/governance.p7s from a "
    "backup, or read {root}/enclaves/governance.xml and sign it again: `openssl smime -sign -text "
    "-in {root}/enclaves/governance.xml -out {root}/enclaves/governance.p7s -signer "
    "{root}/public/permissions_ca.cert.pem -inkey {root}/private/permissions_ca.key.pem`."
)
_INTACT_IN_KEYSTORE = (
    *(_SIGN_PERMISSIONS, _CREATE_MISSING_FILE, _LOST_KEY),
    *(REPLACE, _REPAIR_GOVERNANCE),
)
"""Remedies for faults that mostly only an export has: files that were edited, damaged or lost."""
_REPLACE_CA = (
    "Replace the CA and the files that expired: `sros rotate_ca {root} --finish && sros renew "
    "{root} --all-expiring 30d`; then restart all processes together."
)
_SIGN_CRL = "Sign the list again: `sros crl {root} --refresh`, and export it to the robots again."
_MAKE_KEY = (
    "The key was made on this robot, and nothing else has it: restore it from a backup of the "
    "robot. Without a backup, make another key with `sros create_request {enclave} "
    "NEW_FOLDER`, sign its request.pem with `sros sign_request {root} request.pem --renew`, and "
    "install the answer with `sros import ANSWER NEW_FOLDER`."
)
_AUTHORITY_FILES = ("identity_ca.cert.pem", "permissions_ca.cert.pem")


class Fault(Enum):
    """A fault of an enclave's files that keeps a process from running in it.

    ``id`` is stable, for programs.  ``title`` is a clause.  ``why`` (how DDS reacts), ``source``
    (where the reaction is specified or was tested) and ``remedy`` (what to do) are sentences.
    ``{root}``, ``{enclave}`` and ``{path}`` in a remedy stand for the keystore, the enclave and the
    file.
    """

    FILE_MISSING = (
        "file-missing",
        "a file that an enclave needs is missing",
        "With ROS_SECURITY_STRATEGY=Enforce the node fails; otherwise it runs unsecured. Fast DDS "
        "says \"couldn't find all "
        'security files!" and never names the file.',
        _SOURCE_RCL,
        _CREATE_MISSING_FILE,
        {"key.pem": _LOST_KEY, "permissions.p7s": _SIGN_PERMISSIONS},
    )
    LINK_DANGLING = (
        "link-dangling",
        "a file of an enclave is a broken link",
        "DDS treats it as missing. This happens when an enclave is copied without the files that "
        "it links to; `sros distribute_key` exports files in place of links.",
        _SOURCE_RCL,
        _CREATE_MISSING_FILE,
        {"key.pem": _LOST_KEY, "permissions.p7s": _SIGN_PERMISSIONS},
    )
    FILE_UNREADABLE = (
        "file-unreadable",
        "a file of an enclave cannot be read",
        "A node of the same user cannot read it either.",
        _SOURCE_RCL,
        "Allow the user that runs the node to read the file.",
    )
    FILE_NO_FILE = (
        "file-no-file",
        "a folder or a pipe in place of a file of an enclave",
        "DDS cannot read it. If a file to be mounted into a container does not exist, some "
        "container programs make a folder with its name.",
        _SOURCE_RCL,
        f"Remove the folder or pipe. {_RESTORE_FILE}",
    )
    FILE_EMPTY = (
        "file-empty",
        "a file of an enclave is empty",
        "The content was lost, perhaps because the disk was full.",
        _SOURCE_RCL,
        REPLACE,
        {
            "governance.p7s": _REPAIR_GOVERNANCE,
            "key.pem": _NEW_KEY,
            "permissions.p7s": _SIGN_PERMISSIONS,
            **dict.fromkeys(_AUTHORITY_FILES, _RESTORE_FILE),
        },
    )
    CERTIFICATE_MALFORMED = (
        "certificate-malformed",
        "a certificate that cannot be read",
        "Every vendor refuses it.",
        "RFC 5280; RFC 7468 (PEM).",
        REPLACE,
        dict.fromkeys(_AUTHORITY_FILES, _RESTORE_FILE),
    )
    CERTIFICATE_EXPIRED = (
        "certificate-expired",
        "the certificate of an enclave has expired",
        "Fast DDS refuses it with an empty reason, Cyclone DDS with code 200.",
        _SOURCE_TESTS,
        _RENEW_ENCLAVE,
    )
    CERTIFICATE_NOT_YET_VALID = (
        "certificate-not-yet-valid",
        "the certificate of an enclave is not valid yet",
        f"Fast DDS refuses it with an empty reason. {_CLOCK_BEHIND}",
        _SOURCE_TESTS,
        _SET_CLOCK,
    )
    CERTIFICATE_ISSUER = (
        "certificate-issuer",
        "a certificate that another CA issued",
        "The node itself refuses it; Fast DDS gives an empty reason.",
        "DDS-Security 1.1, 9.3; Fast DDS 2.6 to 3.6, Cyclone DDS 0.10 and 11.0; tested.",
        REPLACE,
    )
    CA_EXPIRED = (
        "ca-expired",
        "a CA that an enclave trusts has expired",
        "Nothing that it issued or signed is accepted any more (Fast DDS: Error '10' verifying "
        "CA certificate); only Cyclone DDS 11 still accepts documents of an expired permissions "
        "CA.",
        _SOURCE_TESTS,
        _REPLACE_CA,
    )
    CA_NOT_YET_VALID = (
        "ca-not-yet-valid",
        "a CA that an enclave trusts is not valid yet",
        f"Nothing that it issued or signed is accepted. {_CLOCK_BEHIND}",
        _SOURCE_TESTS,
        "Set the clock of this host.",
    )
    KEY_MALFORMED = (
        "key-malformed",
        "a private key that cannot be read",
        'Fast DDS says "Error obtaining private key".',
        _SOURCE_TESTS,
        _NEW_KEY,
    )
    KEY_ENCRYPTED = (
        "key-encrypted",
        "a private key that is protected by a passphrase",
        "No RMW can supply a passphrase, so no node can use the key (Fast DDS: "
        '"Error obtaining private key").',
        "rmw_fastrtps 8.4 and rmw_cyclonedds 2.2 (they set no password property).",
        f"{_NEW_KEY} Or remove the passphrase: `openssl pkey -in "
        "{path} -out NEW_FILE && chmod 600 NEW_FILE && mv NEW_FILE {path}`.",
    )
    KEY_MISMATCH = (
        "key-mismatch",
        "a private key that does not belong to the certificate",
        "With Fast DDS the node does not start; with Cyclone DDS it starts, and every peer aborts "
        "the handshake.",
        'Fast DDS 2.14.5 ("Error verifying private key"), Cyclone DDS 0.10.2; tested.',
        _NEW_KEY,
    )
    TOKEN_URI = (
        "token-uri",
        "a key.p11 that names no key on a token, or contains the PIN",
        "Either no ROS 2 node finds the key, or whoever can read the file has the PIN.",
        "RFC 7512; rmw_dds_common of ROS 2 Jazzy (security.cpp); libp11 0.4.12 (eng_parse.c).",
        "Write one line into {path}: pkcs11:token=TOKEN;object=LABEL;type=private. If the "
        "PIN is in a file, add ?pin-source=file:PATH at the end.",
    )
    KEY_TWICE = (
        "key-twice",
        "an enclave with two keys, one in a file and one on a token",
        "rmw_fastrtps of ROS 2 Jazzy and later uses the key on the token; every other RMW uses "
        "the file, which can be copied.",
        "rmw_dds_common of ROS 2 Jazzy (security.cpp).",
        "Keep the key that belongs to cert.pem: delete the other one (key.pem or {path}).",
    )
    CRL_MALFORMED = (
        "crl-malformed",
        "a revocation list that cannot be read",
        "With Fast DDS the node does not start, and its log has an empty reason.",
        "Fast DDS 2.6 to 3.6 (PKIDH.cpp); tested.",
        _SIGN_CRL,
    )
    CRL_ISSUER = (
        "crl-issuer",
        "a revocation list of another CA",
        "No certificate can be verified with it, so every participant is refused.",
        "RFC 5280, 6.3.3; Fast DDS 2.6 to 3.6; tested.",
        _SIGN_CRL,
    )
    CRL_USAGE = (
        "crl-usage",
        "a revocation list of a CA that may not sign lists",
        "The keyUsage of the CA lacks cRLSign, so with this list, every vendor refuses every "
        "participant.",
        "RFC 5280, 4.2.1.3; OpenSSL 3 (x509_vfy.c); Fast DDS 2.9.1 and 2.14.5, Cyclone DDS 0.10.2; "
        "tested.",
        "Replace the CA with one whose keyUsage has cRLSign. Until then, nodes start if you remove "
        "the list (`rm {path}`), but trust revoked enclaves again.",
    )
    CRL_PARTIAL = (
        "crl-partial",
        "a revocation list that is not the whole list of its CA",
        "No certificate can be verified with it, so every participant is refused. OpenSSL "
        "ignores delta lists, lists for one distribution point or for some certificates, and lists "
        "with an unknown critical extension.",
        "RFC 5280, 5.2; OpenSSL 3 (x_crl.c, x509_vfy.c); Fast DDS 2.9.1, Cyclone DDS 0.10.2; "
        "tested.",
        _SIGN_CRL,
    )
    CRL_NOT_YET_VALID = (
        "crl-not-yet-valid",
        "a revocation list that is not valid yet",
        f"Every participant is refused. {_CLOCK_BEHIND}",
        "RFC 5280, 5.1.2.4; Fast DDS 2.14.5.",
        _SET_CLOCK_FOR_CRL,
    )
    CRL_EXPIRED = (
        "crl-expired",
        "a revocation list that has expired",
        "Every participant is refused, and Fast DDS does not report it.",
        "RFC 5280, 5.1.2.5; Fast DDS 2.6 to 3.6; tested.",
        _SIGN_CRL,
    )
    CRL_LEFT_OUT = (
        "crl-left-out",
        "a folder, a pipe or a broken link in place of a revocation list",
        "ROS 2 ignores it: nodes start, and continue to communicate with revoked enclaves. "
        "`sros run` refuses the enclave. If a file to be mounted into a container does not exist, "
        "some container programs make a folder with its name.",
        "rmw_dds_common of ROS 2 Jazzy (security.cpp).",
        f"Move {{path}} away. {_SIGN_CRL}",
    )
    REVOKED = (
        "revoked",
        "an enclave whose certificate is revoked",
        "Every participant with this crl.pem refuses the enclave; Fast DDS does not report it.",
        "RFC 5280, 5; Fast DDS 2.6 to 3.6; tested.",
        "If the enclave should not be revoked, give it a new key and certificate: `sros renew "
        "{root} {enclave} --new-key`.",
    )
    NOT_SIGNED = (
        "not-signed",
        "a document that is not signed",
        'Fast DDS says "Input data has not PKCS7 S/MIME format".',
        "DDS-Security 1.1, 9.4.1.1; tested.",
        _SIGN_PERMISSIONS,
        {"governance.p7s": _REPAIR_GOVERNANCE},
    )
    SIGNATURE = (
        "signature",
        "a document whose signature does not verify",
        "The document was changed, or another CA signed it: find out who did this. The node fails "
        "(Fast "
        "DDS: PKCS7 data verification failed). With a single CA, an enclave may have signed its "
        "own permissions, which some vendors accept.",
        "DDS-Security 1.1, 9.4.1.1; Fast DDS 2.14.5; CVE-2023-24011 for Cyclone DDS 0.10.2.",
        _SIGN_PERMISSIONS,
        {"governance.p7s": _REPAIR_GOVERNANCE},
    )
    SIGNER_NO_CA = (
        "signer-no-ca",
        "a document that no CA signed, but that some vendors accept",
        "Cyclone DDS 0.10 and Fast DDS 2.9.1 accept every signer whose certificate the "
        "permissions CA issued. If that CA also issues identities, each enclave can sign rights "
        "for itself.",
        "CVE-2023-24011; Fast DDS 2.6 to 3.6, Cyclone DDS 0.10 and 11.0; tested.",
        "Unless you signed the document on purpose, treat the signer's key as stolen, and revoke "
        "the signer's enclave, as in `sros revoke {root} {enclave}`. If one CA is for identities "
        "and documents, use separate CAs, as the remedy of keystore.one-authority says.",
        {"governance.p7s": f"Find out who signed the governance. {_REPAIR_GOVERNANCE}"},
    )
    GOVERNANCE_MALFORMED = (
        "governance-malformed",
        "a governance document that cannot be read",
        'The node fails (Fast DDS: "Malformed governance file").',
        "DDS-Security 1.1, 9.4.1.2 and omg_shared_ca_governance.xsd.",
        _REPAIR_GOVERNANCE,
    )
    PERMISSIONS_MALFORMED = (
        "permissions-malformed",
        "a permissions document that cannot be read",
        'The node fails (Fast DDS: "Malformed permissions file"; Cyclone DDS: code 137, 138).',
        "DDS-Security 1.1, 9.4.1.3 and omg_shared_ca_permissions.xsd.",
        _SIGN_PERMISSIONS,
    )
    GOVERNANCE_DOMAIN = (
        "governance-domain",
        "governance that does not name the domain",
        'The node dies with "Not found topic access rule for topic ros_discovery_info" (Fast '
        'DDS) or "Could not find domain in governance" (Cyclone DDS, code 141).',
        "DDS-Security 1.1, 9.4.1.2; tested.",
        _SET_OR_ADD_DOMAIN,
    )
    PERMISSIONS_EXPIRED = (
        "permissions-expired",
        "permissions that have expired",
        'Fast DDS says "Not found the identity subject name in permissions file", Cyclone DDS '
        "code 147.",
        _SOURCE_TESTS,
        _RENEW_ENCLAVE,
    )
    PERMISSIONS_NOT_YET_VALID = (
        "permissions-not-yet-valid",
        "permissions that are not valid yet",
        f'Fast DDS says "Not found the identity subject name in permissions file". {_CLOCK_BEHIND}',
        _SOURCE_TESTS,
        _SET_CLOCK,
    )
    PERMISSIONS_SUBJECT = (
        "permissions-subject",
        "permissions for another subject",
        "No grant fits the certificate. This happens when permissions of an earlier certificate, "
        "or of another enclave, were put in place.",
        'DDS-Security 1.1, 9.4.1.3; Fast DDS ("Not found the identity subject name"), Cyclone '
        "DDS code 146.",
        _SIGN_PERMISSIONS,
    )
    PERMISSIONS_DOMAIN = (
        "permissions-domain",
        "permissions that allow nothing in the domain",
        "With Fast DDS the node starts, and every peer refuses it; with Cyclone DDS it does not "
        "start.",
        "DDS-Security 1.1, 9.4.1.3; tested.",
        "Set ROS_DOMAIN_ID to a domain that the permissions name, or sign them for this domain. "
        f"{_SIGN_PERMISSIONS}",
    )
    CERTIFICATE_FILE = (
        "certificate-file",
        "a file of certificates that a vendor cannot read",
        "Fast DDS reads the whole CA file, and refuses it if any part is damaged; Cyclone DDS "
        "reads only the first certificate, and no block of the kind 'TRUSTED CERTIFICATE'.",
        "OpenSSL 3.0 (pem_info.c); Fast DDS 2.6 to 3.6, Cyclone DDS 0.10 and 11.0; tested.",
        "Keep only certificates in the file, each under the line '-----BEGIN CERTIFICATE-----'.",
    )
    CA_CRASH = (
        "ca-crash",
        "a CA file that crashes Fast DDS",
        "If the first certificate of a CA file is not signed with SHA-256, Fast DDS (except 2.9.1) "
        "uses memory that it has already freed.",
        "Fast DDS 2.6 to 3.6 (FileProvider.cpp); tested.",
        "Put a CA certificate that is signed with SHA-256 first in the file.",
    )
    CERTIFICATE_CRASH = (
        "certificate-crash",
        "a certificate that crashes Fast DDS",
        "Fast DDS crashes on a certificate with an empty subject, even on the certificate of a "
        "peer that is not verified yet.",
        "Fast DDS 2.6 to 3.6 (PKIDH.cpp); tested.",
        "Issue a certificate with the common name of the enclave.",
    )
    CERTIFICATE_LASTS = (
        "certificate-lasts",
        "a certificate that expires more than 292 years from now",
        "Fast DDS 2.6 and 3.2 set a timer for the expiry, and its nanoseconds overflow: the node "
        "is refused as if the certificate had expired, or crashes.",
        "Fast DDS 2.6.12 and 3.2.5 (PKIDH.cpp, arm_identity_expiry); tested.",
        "Issue a certificate for a shorter time: `sros renew {root} {enclave}`.",
    )
    CA_CHAIN = (
        "ca-chain",
        "a CA certificate that a vendor refuses",
        "Fast DDS (except 2.9.1) also verifies the CA certificate, by the strict rules of OpenSSL.",
        "RFC 5280, 6.1; Fast DDS 2.6 to 3.6 (FileProvider.cpp); tested.",
        "Use a self-signed CA with keyCertSign, and put its certificate first in the CA file.",
    )
    SIGNATURE_HASH = (
        "signature-hash",
        "a certificate that is not signed with SHA-256",
        "Fast DDS refuses other digests, and RSA-PSS, in the certificate of a CA or an enclave.",
        "Fast DDS 2.6 to 3.6 (PKIDH.cpp); tested.",
        "Issue the certificate again with SHA-256, which every vendor accepts.",
    )
    KEY_ALGORITHM = (
        "key-algorithm",
        "a key that not every vendor accepts",
        "Cyclone DDS accepts only EC prime256v1 and RSA of exactly 2048 bits; with Ed25519, the "
        "handshake of Fast DDS fails.",
        "DDS-Security 1.1, 9.3.1; Cyclone DDS 0.10 and 11.0, Fast DDS 2.6 to 3.6; tested.",
        "Use EC prime256v1 keys, which every vendor accepts.",
    )
    KEY_ON_TOKEN = (
        "key-on-token",
        "a key on a token, which only Fast DDS uses",
        "Only rmw_fastrtps of ROS 2 Jazzy and later reads key.p11. Without key.pem, nodes on other "
        "RMWs and nodes of ROS 2 Humble and Iron do not start.",
        "rmw_fastrtps_shared_cpp 8.4 (participant.cpp), rmw_cyclonedds 2.2 and rmw_connextdds "
        "0.22 (they ask rmw_dds_common only for files); Fast DDS 2.9.1, tested.",
        "Use rmw_fastrtps_cpp, or a key in a file.",
    )
    DOCUMENT_SIZE = (
        "document-size",
        "permissions that are too large for a handshake",
        "The node starts, and the handshake with its peers never finishes, if the permissions and "
        "the certificate do not fit into one message of 64 KB.",
        "Fast DDS 2.9.1; tested.",
        "Make the permissions smaller (use wildcards), or split the enclave into several enclaves.",
    )

    def __new__(cls, identifier: str, *_: object) -> Fault:
        """Create the member whose value is ``identifier``."""
        fault = object.__new__(cls)
        fault._value_ = identifier
        return fault

    def __init__(
        self,
        identifier: str,
        title: str,
        why: str,
        source: str,
        remedy: str,
        remedies: dict[str, str] | None = None,
    ) -> None:
        self.id = identifier
        self.title = title
        self.why = why
        self.source = source
        self.remedy = remedy
        self._remedies = remedies or {}

    def remedy_in(self, file: str) -> str:
        """Return the remedy for this fault in ``file``, with its ``{fields}`` not filled in."""
        return self._remedies.get(file, self.remedy)

    def remedy_in_export(self, file: str, *, key_made_here: bool = False) -> str:
        """Return the remedy for this fault in ``file`` of an export, which has no CA keys.

        ``key_made_here`` says that the export has the request for a key that was made here.
        """
        if key_made_here and self is Fault.FILE_MISSING and file == "key.pem":
            return _MAKE_KEY
        text = self.remedy_in(file)
        if "`" not in text:
            return text
        if text in _REMEDIES_IN_EXPORT:
            return _REMEDIES_IN_EXPORT[text]
        if text in _INTACT_IN_KEYSTORE:
            return (
                f"Export the enclave again from the {ORIGINAL_KEYSTORE}: `sros distribute_key "
                "{root} {enclave} TARGET --force`. If `sros check {root}` finds an error there, "
                "first do what it says."
            )
        return remedy_in_original_keystore(text)


def remedy_in_original_keystore(remedy: str) -> str:
    """Return the remedy for an export: do ``remedy`` in the original keystore, then export again.

    If ``remedy`` itself says to export and to do more afterwards, the result is ``remedy``, with a
    sentence on which keystore is meant.
    """
    if "export the enclave again" in remedy.lower().removesuffix("export the enclave again."):
        return f"{remedy} KEYSTORE is the {ORIGINAL_KEYSTORE}."
    then = "" if remedy.endswith("export the enclave again.") else " Then export the enclave again."
    return f"In the {ORIGINAL_KEYSTORE}: {remedy}{then}"


NEEDS_CA_KEYS = re.compile(
    r"`sros (create_(?!request)\w+|generate_artifacts|update_keystore|renew|revoke|rotate_ca"
    r"|distribute_key|crl KEYSTORE --refresh|zenoh) "
)
"""The beginning of a command that works only in the keystore that has the CA keys."""


WAIT_FOR_CA = (
    "Set the clock of this machine. If it is right, it was ahead when the CA was made: wait until "
    "the CA is valid, or create a new keystore."
)
"""The remedy for a CA that is not valid yet: a CA that replaces it would begin no earlier."""
NOT_IN_THE_FILE = (Fault.CA_NOT_YET_VALID, Fault.FILE_UNREADABLE, Fault.FILE_NO_FILE)
"""Faults that remain if a link to the keystore's file replaces the faulty file."""
FAULTS = {fault.id: fault for fault in Fault}
"""All faults, by id."""

VENDOR_FAULTS = (
    Fault.CERTIFICATE_FILE,
    Fault.CA_CRASH,
    Fault.CERTIFICATE_CRASH,
    Fault.CERTIFICATE_LASTS,
    Fault.CA_CHAIN,
    Fault.SIGNATURE_HASH,
    Fault.KEY_ALGORITHM,
    Fault.KEY_ON_TOKEN,
    Fault.DOCUMENT_SIZE,
)
"""The faults for which only some vendors refuse an enclave."""
BEFORE_DDS = (Fault.FILE_MISSING, Fault.LINK_DANGLING, Fault.FILE_NO_FILE)
"""Faults that end a process before DDS reads a file: the RMW checks first that all files exist.

Source: rmw_dds_common of ROS 2 Jazzy (security.cpp); tested with rmw_fastrtps 8.4.
"""
