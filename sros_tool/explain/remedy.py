"""What to do where it is not the policy that keeps an enclave out, by the word for the fault.

A command in a remedy is one that runs on a keystore with that fault, and mends it.
"""

from __future__ import annotations

from pathlib import Path
from shlex import quote

from sros_tool.errors import SrosError
from sros_tool.keystore.layout import (
    GOVERNANCE_P7S,
    IDENTITY,
    LEDGER,
    PERMISSIONS,
    PRIVATE,
    ca_certificate,
    enclave_path,
)
from sros_tool.keystore.lifecycle.rotation.state import Stage, read_rotation

_RENEW = "Renew it: `sros renew {root} {enclave}`."
_NEW_KEY = "Give the enclave another key: `sros renew {root} {enclave} --new-key`."
_CLOCK = "Set the clock of this host; if it is right, sign again: `sros renew {root} {enclave}`."
_SIGN = "Sign the permissions again: `sros create_permission {root} {enclave} POLICY`."
_COMPLETE = "Make what is missing: `sros create_enclave {root} {enclave}`."
_REPLACE = (
    "Put a good one in its place: `rm {path} && sros create_enclave {root} {enclave}` takes that "
    "of the keystore, or issues it again."
)
_GOVERNANCE = (
    "Every enclave depends on it: restore {root}/enclaves/governance.p7s from a backup, or, once "
    "you have read {root}/enclaves/governance.xml, sign that again: `openssl smime -sign -text -in "
    "{root}/enclaves/governance.xml -out {root}/enclaves/governance.p7s -signer "
    "{root}/public/permissions_ca.cert.pem -inkey {root}/private/permissions_ca.key.pem`."
)
_DOMAIN = (
    "Set ROS_DOMAIN_ID to a domain of the keystore: `sros env {root} {enclave} --domain ID` prints "
    "the variables; for another domain, make a keystore with `sros create_keystore --domain`."
)
_AUTHORITY = (
    "Replace the CA and what expired with it: `sros rotate_ca {root} --finish && sros renew {root} "
    "--all-expiring 30d`; then restart all processes together."
)
_ROTATION = (
    "The CAs of this keystore are being replaced: do the next stage with `sros rotate_ca {root} "
    "--next`, and restart the processes after it."
)
_REVOKED = (
    "It is meant to be kept out. If not, give it a new key and certificate: `sros renew {root} "
    "{enclave} --new-key`."
)
_CRL = "Sign the list again: `sros crl {root} --refresh`, and export it to the robots again."
_VENDOR = "Write it as every vendor reads it: `sros create_permission {root} {enclave} POLICY`."

_BY_WORD = {
    "certificate-expired": _RENEW,
    "certificate-not-yet-valid": _CLOCK,
    "certificate-issuer": _REPLACE,
    "certificate-malformed": _REPLACE,
    "ca-expired": _AUTHORITY,
    "ca-not-yet-valid": "Set the clock of this host.",
    "key-mismatch": _NEW_KEY,
    "key-encrypted": f"DDS asks for no passphrase: store it without one, mode 0600. {_NEW_KEY}",
    "key-malformed": _NEW_KEY,
    "key-algorithm": "Use keys of EC prime256v1, which every vendor takes.",
    "signature-hash": "Issue the certificate anew with SHA-256, which every vendor takes.",
    "ca-chain": "Use a self-signed CA with keyCertSign, first in its file.",
    "document-size": "Make the permissions smaller, with wildcards, or split the enclave.",
    "long-name": "Use a shorter name: on DDS at most 251 characters, prefix and suffix included.",
    "file-missing": _COMPLETE,
    "file-empty": _REPLACE,
    "file-unreadable": "Let the user that runs the node read the file.",
    "link-dangling": _COMPLETE,
    "crl-malformed": _CRL,
    "crl-issuer": _CRL,
    "crl-not-yet-valid": _CLOCK,
    "crl-expired": _CRL,
    "revoked": _REVOKED,
    "signature": _SIGN,
    "not-signed": _SIGN,
    "expired": _RENEW,
    "not-yet-valid": _CLOCK,
    "permissions-expired": _RENEW,
    "permissions-not-yet-valid": _CLOCK,
    "permissions-subject": _SIGN,
    "permissions-domain": _SIGN,
    "permissions-malformed": _SIGN,
    "no-grant": _SIGN,
    "malformed": _VENDOR,
    "open-range": _VENDOR,
    "empty-topic": _VENDOR,
    "governance-malformed": _GOVERNANCE,
    "governance-domain": _DOMAIN,
    "domain-not-in-governance": _DOMAIN,
    "peer-refuses-participant": _SIGN,
    "no-topic-rule": "Make a keystore from a template: its governance has a rule for every topic.",
    "unauthenticated-with-rtps-protection": _GOVERNANCE,
    "invalid-name": "Use a name of letters, digits, '_' and '/'.",
    "partition": "Say nothing of partitions in permissions; sros never does.",
}
_BY_FILE = {
    ("governance.p7s", "signature"): _GOVERNANCE,
    ("governance.p7s", "not-signed"): _GOVERNANCE,
    ("governance.p7s", "file-empty"): _GOVERNANCE,
    ("identity_ca.cert.pem", "certificate-malformed"): "Restore {path} from a backup.",
    ("permissions_ca.cert.pem", "certificate-malformed"): "Restore {path} from a backup.",
    ("identity_ca.cert.pem", "file-empty"): "Restore {path} from a backup.",
    ("permissions_ca.cert.pem", "file-empty"): "Restore {path} from a backup.",
    ("key.pem", "file-empty"): _NEW_KEY,
    ("permissions.p7s", "file-empty"): _SIGN,
    ("permissions.p7s", "file-missing"): _SIGN,
    ("permissions.p7s", "link-dangling"): _SIGN,
}
"""Where the same fault is another one's matter, by the file that it lies in."""

_SHARED = {
    "governance.p7s": GOVERNANCE_P7S,
    "identity_ca.cert.pem": ca_certificate(IDENTITY),
    "permissions_ca.cert.pem": ca_certificate(PERMISSIONS),
}
"""Files of an enclave that are links to those of the keystore, unless somebody replaced them."""
_CA_FILE = "identity_ca.cert.pem"
_NOT_IN_THE_FILE = ("ca-not-yet-valid", "file-unreadable")
_OF_GOVERNANCE = ("governance-malformed", "governance-domain", "domain-not-in-governance")


def remedy(word: str, root: str, enclave: str, file: str = "") -> str:
    """What to do about a fault, or "" where only the policy can help.

    ``word`` is the code of a `Problem` or the reason of a decision, ``file`` that of the enclave
    which has the fault, where known.  A ``root`` without the keys of the CAs, on a robot, can only
    be mended where they are.
    """
    file = file or ("governance.p7s" if word in _OF_GOVERNANCE else "")
    keystore = Path(root) if root and Path(root).is_dir() else None
    text = _BY_FILE.get((file, word), _BY_WORD.get(word, ""))
    if keystore and not _has_authorities(keystore):
        if "`" not in text or text == _DOMAIN:
            return _filled(text, root, enclave, file)
        mended = _filled(text, "KEYSTORE", enclave, file)
        return f"In the keystore with the keys of the CAs: {mended} Then export the enclave again."
    if keystore and word == "certificate-issuer" and _is_own_copy(keystore, enclave, _CA_FILE):
        return _filled(_REPLACE, root, enclave, _CA_FILE)
    if keystore and word in ("ca-expired", "certificate-issuer") and _is_rotating(keystore):
        text = _ROTATION
    elif (
        keystore and text and word not in _NOT_IN_THE_FILE and _is_own_copy(keystore, enclave, file)
    ):
        text = _REPLACE
    return _filled(text, root or "KEYSTORE", enclave, file)


def _filled(text: str, root: str, enclave: str, file: str) -> str:
    path = enclave_path(Path(root), enclave) / (file or "cert.pem")
    # What is copied into a shell must not become another command there.
    return text.format(root=quote(root), enclave=quote(enclave), path=quote(str(path)))


def _is_own_copy(keystore: Path, enclave: str, file: str) -> bool:
    """Whether an enclave has a file of its own where a link to the keystore's should be."""
    own, common = enclave_path(keystore, enclave) / file, keystore / _SHARED.get(file, "")
    return file in _SHARED and own.is_file() and common.is_file() and not own.samefile(common)


def _is_rotating(keystore: Path) -> bool:
    try:
        return read_rotation(keystore).stage is not Stage.NONE
    except SrosError:
        return False


def _has_authorities(keystore: Path) -> bool:
    """Whether it is the keystore at home, and no export, nor the folder of an enclave."""
    return (keystore / PRIVATE).is_dir() or (keystore / LEDGER).is_file()


def known_words() -> frozenset[str]:
    """The words for which there is a remedy."""
    return frozenset(_BY_WORD)
