"""What keeps a process from running in an enclave: each of the checks that DDS makes, by name."""

from __future__ import annotations

from collections.abc import Iterator

from sros_tool.checks.keystores.opened import OpenedEnclave
from sros_tool.checks.kind import ERROR, Finding, Kind, by_id

NOT_LOADABLE = "enclave.not-loadable"
"""The id that stands for all of them in `--include` and `--exclude`."""

_RENEW = "Renew it with `sros renew ROOT NAME`."
_RESTORE = "Restore it from a backup, or make the enclave anew."
_RCL = "rcl 9 (security.c) and the RMWs of ROS 2 Jazzy."
_BOTH = "Fast DDS 2.9.1 and 2.14.5, Cyclone DDS 0.10.2; measured."


def _kind(code: str, title: str, why: str, source: str, remedy: str) -> Kind:
    return Kind(f"enclave.{code}", ERROR, title, why, source, remedy, NOT_LOADABLE)


KINDS = by_id(
    _kind(
        "file-missing",
        "a file that an enclave needs is missing",
        "The node fails, or without Enforce runs unsecured; Fast DDS says \"couldn't find all "
        'security files!" and never which.',
        _RCL,
        "`sros create_enclave ROOT NAME` completes an enclave; keys come from a backup only.",
    ),
    _kind(
        "link-dangling",
        "a file of an enclave is a link to nothing",
        "It counts as missing. It happens where an enclave is copied without what it links to.",
        _RCL,
        "Export enclaves with `sros distribute_key`, which resolves links.",
    ),
    _kind("file-unreadable", "a file of an enclave cannot be read", "DDS cannot read it either.",
          _RCL, "Correct its mode or its owner, or restore it."),
    _kind("file-empty", "a file of an enclave is empty", "It was lost, perhaps on a full disk.",
          _RCL, _RESTORE),
    _kind("certificate-malformed", "a certificate that cannot be read",
          "Every vendor refuses it.", "RFC 5280; RFC 7468 (PEM).", _RESTORE),
    _kind(
        "certificate-expired",
        "the certificate of an enclave has expired",
        "Fast DDS refuses it with an empty reason, Cyclone DDS with code 200.",
        _BOTH,
        _RENEW,
    ),
    _kind(
        "certificate-not-yet-valid",
        "the certificate of an enclave is not valid yet",
        "Fast DDS refuses it with an empty reason. Often the clock of the robot is behind.",
        _BOTH,
        "Set the clock, before the node starts.",
    ),
    _kind(
        "ca-expired",
        "a CA that an enclave trusts has expired",
        "Nothing that it issued or signed is accepted any more (Fast DDS: Error '10' verifying "
        "CA certificate).",
        _BOTH,
        "Replace the CA with `sros rotate_ca ROOT`.",
    ),
    _kind(
        "ca-not-yet-valid",
        "a CA that an enclave trusts is not valid yet",
        "Nothing that it issued or signed is accepted. Often the clock of the robot is behind.",
        _BOTH,
        "Set the clock, before the node starts.",
    ),
    _kind(
        "certificate-issuer",
        "a certificate that another CA issued",
        "Its own node refuses it; Fast DDS with an empty reason.",
        "DDS-Security 1.1, 9.3; Fast DDS 2.14.5, Cyclone DDS 0.10.2; measured.",
        "Restore the certificate that belongs to this keystore, or make the enclave anew.",
    ),
    _kind("key-malformed", "a private key that cannot be read",
          "Fast DDS says \"Error obtaining private key\".", _BOTH, _RESTORE),
    _kind(
        "key-encrypted",
        "a private key that is protected by a passphrase",
        "No RMW can give a passphrase, so no node can use it (Fast DDS: \"Error obtaining private "
        "key\").",
        "rmw_fastrtps 8.4 and rmw_cyclonedds 2.2 (they set no password property).",
        "Decrypt it with `openssl pkey -in key.pem -out key.plain`, and protect it by its mode.",
    ),
    _kind(
        "key-mismatch",
        "a private key that is not that of the certificate",
        "Fast DDS refuses it; Cyclone DDS starts, and every peer ends the handshake.",
        "Fast DDS 2.14.5 (\"Error verifying private key\"), Cyclone DDS 0.10.2; measured.",
        "Restore the pair from a backup, or make the enclave anew.",
    ),
    _kind("crl-malformed", "a revocation list that cannot be read",
          "Fast DDS refuses itself and everybody, with an empty reason.",
          "Fast DDS 2.14.5 (PKIDH.cpp); measured.", "Sign it anew with `sros crl ROOT --refresh`."),
    _kind("crl-issuer", "a revocation list of another CA",
          "No certificate can be verified with it, so everybody is refused.",
          "RFC 5280, 6.3.3; Fast DDS 2.14.5; measured.",
          "Export the list of this keystore again, with `sros distribute_key`."),
    _kind("crl-not-yet-valid", "a revocation list that is not valid yet",
          "Everybody is refused. Often the clock of the robot is behind.",
          "RFC 5280, 5.1.2.4; Fast DDS 2.14.5.", "Set the clock, before the node starts."),
    _kind("crl-expired", "a revocation list that has expired",
          "Everybody is refused, and Fast DDS says nothing about it.",
          "RFC 5280, 5.1.2.5; Fast DDS 2.14.5; measured.",
          "Sign it anew with `sros crl ROOT --refresh`, and export it to the robots."),
    _kind("revoked", "an enclave whose certificate is revoked",
          "Everybody who reads crl.pem drops it, Fast DDS in silence.",
          "RFC 5280, 5; Fast DDS 2.14.5; measured.",
          "Make an enclave with a new key, under another name or after `sros revoke`."),
    _kind("not-signed", "a document that is not signed",
          'Fast DDS says "Input data has not PKCS7 S/MIME format".',
          "DDS-Security 1.1, 9.4.1.1; measured.",
          "Sign it with `sros generate_artifacts` or `sros renew`."),
    _kind(
        "signature",
        "a document whose signature does not verify",
        "It was changed, or another CA signed it; the node fails (Fast DDS: PKCS7 data "
        "verification failed). With one CA for both jobs it may be an enclave that signed for "
        "itself, which DDS accepts.",
        "DDS-Security 1.1, 9.4.1.1; Fast DDS 2.14.5; CVE-2023-24011 for Cyclone DDS 0.10.2.",
        "Find out who changed it; then sign it anew with `sros renew ROOT NAME`.",
    ),
    _kind("governance-malformed", "a governance document that cannot be read",
          'The node fails (Fast DDS: "Malformed governance file").',
          "DDS-Security 1.1, 9.4.1.2 and omg_shared_ca_governance.xsd.", _RESTORE),
    _kind("permissions-malformed", "a permissions document that cannot be read",
          'The node fails (Fast DDS: "Malformed permissions file"; Cyclone DDS: code 137, 138).',
          "DDS-Security 1.1, 9.4.1.3 and omg_shared_ca_permissions.xsd.",
          "Sign them anew, with `sros create_permission ROOT NAME POLICY_FILE`."),
    _kind(
        "governance-domain",
        "governance that does not name the domain",
        "The node dies with \"Not found topic access rule for topic ros_discovery_info\" (Fast "
        "DDS) or \"Could not find domain in governance\" (Cyclone DDS, code 141).",
        "DDS-Security 1.1, 9.4.1.2; measured.",
        "Set ROS_DOMAIN_ID to a domain of the keystore.",
    ),
    _kind("permissions-expired", "permissions that have expired",
          "Fast DDS says \"Not found the identity subject name in permissions file\", Cyclone DDS "
          "code 147.", _BOTH, _RENEW),
    _kind("permissions-not-yet-valid", "permissions that are not valid yet",
          "Fast DDS says \"Not found the identity subject name in permissions file\". Often the "
          "clock of the robot is behind.", _BOTH, "Set the clock, before the node starts."),
    _kind("permissions-subject", "permissions for another subject",
          "No grant fits the certificate. It happens where permissions of an earlier certificate, "
          "or of another enclave, were put in place.",
          "DDS-Security 1.1, 9.4.1.3; Fast DDS (\"Not found the identity subject name\"), Cyclone "
          "DDS code 146.", _RENEW),
    _kind("permissions-domain", "permissions that allow nothing in the domain",
          "The node starts on Fast DDS, and every peer refuses it; Cyclone DDS refuses it itself.",
          "DDS-Security 1.1, 9.4.1.3; measured.", "Set ROS_DOMAIN_ID to a domain of the keystore."),
)  # fmt: skip


def check_loading(enclave: OpenedEnclave) -> Iterator[Finding]:
    """Every problem of an enclave; that its key is on its robot, where it stays, is none."""
    for problem in enclave.state.problems:
        if enclave.born_elsewhere and problem.file == "key.pem":
            continue
        kind = KINDS[f"enclave.{problem.code}"]
        text = problem.text if problem.text != "missing" else f"{problem.file} is missing"
        yield kind.found(enclave.name, text, enclave.file(problem.file))
