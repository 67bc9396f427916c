"""What to do where it is not the policy that keeps an enclave out, by the word for the fault."""

from __future__ import annotations

_RENEW = "Renew it: `sros renew {root} {enclave}`."
_RESTORE = "Restore the file from the keystore or a backup, or export the enclave again."
_COMPLETE = (
    "Make what is missing with `sros create_enclave {root} {enclave}`, or export the enclave again."
)
_CLOCK = "Set the clock of this host; if it is right, wait, or sign anew with `sros renew`."
_SIGN = "Sign the permissions anew: `sros create_permission {root} {enclave} POLICY`."
_GOVERNANCE = (
    "Restore enclaves/governance.p7s of the keystore from a backup; every enclave depends on it."
)
_DOMAIN = (
    "Set ROS_DOMAIN_ID to a domain of the keystore (`sros env {root} {enclave}` prints it), or "
    "make a keystore with --domain."
)
_AUTHORITY = "Finish replacing the CA: `sros rotate_ca {root}`, or export the enclave again."
_REVOKED = (
    "It is meant to be kept out. If not, make the enclave anew: `sros create_enclave {root} "
    "{enclave}` with another key."
)
_CRL = "Sign the list anew: `sros crl {root} --refresh`, and export it to the robots again."
_VENDOR = "Write it as every vendor reads it: `sros create_permission {root} {enclave} POLICY`."

_BY_WORD = {
    "certificate-expired": _RENEW,
    "certificate-not-yet-valid": _CLOCK,
    "certificate-issuer": _AUTHORITY,
    "certificate-malformed": _RESTORE,
    "ca-expired": _AUTHORITY,
    "ca-not-yet-valid": _CLOCK,
    "key-mismatch": "Restore the key that belongs to cert.pem, or make the enclave anew.",
    "key-encrypted": "DDS never asks for a passphrase: store key.pem without one, mode 0600.",
    "key-malformed": _RESTORE,
    "file-missing": _COMPLETE,
    "file-empty": _RESTORE,
    "file-unreadable": "Let the user that runs the node read the file.",
    "link-dangling": _COMPLETE,
    "crl-malformed": _CRL,
    "crl-issuer": _CRL,
    "crl-not-yet-valid": _CLOCK,
    "crl-expired": _CRL,
    "revoked": _REVOKED,
    "signature": "Sign it anew, or restore it; it was changed, or another CA signed it.",
    "not-signed": _SIGN,
    "expired": _RENEW,
    "not-yet-valid": "Set the clock and time zone of the host; else sign anew with `sros renew`.",
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


def remedy(word: str, root: str, enclave: str) -> str:
    """One sentence on what to do about a fault, or "" where only the policy can help.

    ``word`` is the code of a `Problem` or the reason of a decision.
    """
    return _BY_WORD.get(word, "").format(root=root or "KEYSTORE", enclave=enclave)


def known_words() -> frozenset[str]:
    """The words for which there is a remedy."""
    return frozenset(_BY_WORD)
