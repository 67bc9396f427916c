"""Certificate chains are accepted where OpenSSL accepts them, and refused for a reason."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime

import pytest

from sros_tool.pki.certificates import load_der_certificate
from sros_tool.pki.chains import Checks, chain_fault
from tests.integration.libcrypto import POLICY_CHECK, libcrypto
from tests.support.raw_pki import (
    PRINTABLE,
    Attribute,
    Certificate,
    Extension,
    basic_constraints,
    name,
    name_der,
    oid,
    sequence,
    tagged,
)

NOW = datetime.now(UTC).replace(microsecond=0)
CA = (basic_constraints(ca=True),)
ROOT = Certificate(name("CN=root"), name("CN=root"), "p256 0", "p256 0", 1, CA)
MIDDLE = Certificate(name("CN=middle"), name("CN=root"), "p256 1", "p256 0", 2, CA)
LEAF = Certificate(name("CN=robot"), name("CN=middle"), "p256 2", "p256 1", 3)
EMPTY_RDN = ()
NO_POLICIES = Extension("2.5.29.32", sequence())
A_POLICY = Extension("2.5.29.32", sequence(sequence(oid("2.5.29.32.0"))))
DEMANDED_AFTER_ONE, DEMANDED_AFTER_TWO = (
    Extension("2.5.29.36", sequence(tagged(0, bytes([certificates]), constructed=False)))
    for certificates in (1, 2)
)
DAMAGED_POLICIES = Extension("2.5.29.54", b"\4\0")


def for_robots() -> Extension:
    """The name constraint that below a CA a name begins with CN=robot."""
    subtree = tagged(4, name_der(name("CN=robot")))
    return Extension("2.5.29.30", sequence(tagged(0, sequence(subtree))), critical=True)


def middle(*extensions: Extension) -> Certificate:
    """The intermediate CA with these extensions, too."""
    return replace(MIDDLE, extensions=(*MIDDLE.extensions, *extensions))


CHAINS = {
    "plain": ((LEAF, MIDDLE, ROOT), ""),
    "as long as the root allows": (
        (LEAF, MIDDLE, ROOT.with_extension(basic_constraints(ca=True, length=1))),
        "",
    ),
    "longer": (
        (LEAF, MIDDLE, ROOT.with_extension(basic_constraints(ca=True, length=0))),
        "the chain is longer than the pathlen of CN=root allows",
    ),
    "an empty part in the name of the issuer": (
        (replace(LEAF, issuer=(EMPTY_RDN, *LEAF.issuer)), MIDDLE, ROOT),
        "",
    ),
    "a renewed CA next to one with a date that cannot be read": (
        (LEAF, replace(MIDDLE, times=("", "4901010000Z")), MIDDLE, ROOT),
        "",
    ),
    "a damaged key": (
        (replace(LEAF, key_form="damaged"), MIDDLE, ROOT),
        "the public key of CN=robot is damaged",
    ),
    "names that are allowed": ((LEAF, middle(for_robots()), ROOT), ""),
    "a name that cannot be compared": (
        (
            replace(LEAF, subject=((Attribute("CN", "rob\xe9t", PRINTABLE),),)),
            middle(for_robots()),
            ROOT,
        ),
        "do not allow the names of CN=rob",
    ),
    "no name that a constraint is about": (
        (replace(LEAF, subject=(EMPTY_RDN,)), middle(for_robots()), ROOT),
        "",
    ),
    "a policy that is demanded, and that each certificate has": (
        (LEAF.with_extension(A_POLICY), middle(A_POLICY, DEMANDED_AFTER_ONE), ROOT),
        "a certificate demands a certificate policy",
    ),
    "a policy that a longer chain would have to have": (
        (LEAF.with_extension(A_POLICY), middle(A_POLICY, DEMANDED_AFTER_TWO), ROOT),
        "",
    ),
    "damaged policies next to a list of none": (
        (LEAF.with_extension(NO_POLICIES).with_extension(DAMAGED_POLICIES), MIDDLE, ROOT),
        "",
    ),
}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("case", CHAINS)
def test_a_chain_is_accepted_as_by_openssl(case: str) -> None:
    certificates, fault = CHAINS[case]
    leaf, *authorities = (each.der(NOW) for each in certificates)
    found = chain_fault(
        load_der_certificate(leaf),
        [load_der_certificate(each) for each in authorities],
        moment=NOW,
        checks=Checks.POLICIES,
    )
    assert fault in found if fault else not found
    if openssl := libcrypto():
        assert bool(openssl.fault(leaf, authorities, flags=POLICY_CHECK)) == bool(found)
