"""Draw enclaves with oddities of certificates, CA files, keys, PEM, lists, signatures, subjects.

`draw` gives a `Case`: a base (how a keystore is made: `BASES`) and one or two oddities, each of a
family of `FAMILIES` with a number.  A family draws from its number alone, so that a case can be
written down as text, "two CAs | ca extension 17 | list entries 4", and made again: `make` gives
its `Trust`, `Trust.write` the folders of the enclave and of a sound peer of the same CA files.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from tests.integration.trust.certificates import (
    Dice,
    ca_extension,
    certificate_dates,
    certificate_fields,
    certificate_key,
    certificate_signature,
    issuer_name,
    leaf_extension,
)
from tests.integration.trust.files import (
    ca_file,
    certificate_file,
    key_file,
    pem_form,
    trusted_certificate,
    zero_bytes,
)
from tests.integration.trust.lists import (
    list_dates,
    list_entries,
    list_extensions,
    list_files,
    list_issuer,
)
from tests.integration.trust.messages import (
    documents,
    message_algorithms,
    message_attributes,
    message_signers,
    message_structure,
)
from tests.integration.trust.subjects import ca_subject, grant_subject, leaf_subject
from tests.integration.trust.trusts import BASES, LEAF, Trust

Family = Callable[[Trust, Dice], str]
FAMILIES: dict[str, Family] = {
    "ca extension": ca_extension,
    "leaf extension": leaf_extension,
    "certificate signature": certificate_signature,
    "certificate key": certificate_key,
    "certificate dates": certificate_dates,
    "certificate fields": certificate_fields,
    "issuer name": issuer_name,
    "ca file": ca_file,
    "trusted certificate": trusted_certificate,
    "pem": pem_form,
    "zero bytes": zero_bytes,
    "certificate file": certificate_file,
    "key file": key_file,
    "list issuer": list_issuer,
    "list dates": list_dates,
    "list entries": list_entries,
    "list extensions": list_extensions,
    "list files": list_files,
    "message signers": message_signers,
    "message algorithms": message_algorithms,
    "message attributes": message_attributes,
    "message structure": message_structure,
    "documents": documents,
    "leaf subject": leaf_subject,
    "grant subject": grant_subject,
    "ca subject": ca_subject,
}
WEIGHTS = {
    "ca extension": 5,
    "leaf extension": 2,
    "ca file": 4,
    "pem": 4,
    "key file": 2,
    "leaf subject": 3,
    "list extensions": 2,
    "message signers": 2,
}
"""How often a family is drawn; the others once."""
NUMBERS = 100_000


@dataclass(frozen=True)
class Case:
    """A base with oddities: names of families with their numbers."""

    base: str
    oddities: tuple[tuple[str, int], ...]

    def __str__(self) -> str:
        return " | ".join([self.base, *(f"{family} {number}" for family, number in self.oddities)])

    @staticmethod
    def parse(text: str) -> Case:
        base, *rest = text.split(" | ")
        oddities = [each.rpartition(" ") for each in rest]
        return Case(base, tuple((family, int(number)) for family, _, number in oddities))


def draw(seed: int, count: int) -> list[Case]:
    """Return that many cases of one oddity, or two of different families; the same for a seed."""
    dice = Dice(seed)
    weights = [WEIGHTS.get(each, 1) for each in FAMILIES]
    cases: dict[Case, None] = {}
    while len(cases) < count:
        chosen = dict.fromkeys(dice.choices(list(FAMILIES), weights, k=dice.choice((1, 2))))
        oddities = tuple((family, dice.randrange(NUMBERS)) for family in chosen)
        cases[Case(dice.choice(list(BASES)), oddities)] = None
    return list(cases)


def make(case: Case) -> tuple[Trust, str]:
    """Return the trust of a case, and what is odd about it."""
    trust = BASES[case.base]()
    words = []
    for family, number in case.oddities:
        words.append(FAMILIES[family](trust, Dice(f"{family} {number}")))
    if (trust.key or trust.certificates[LEAF].key).startswith(("dsa", "ed")):
        trust.on_token = False  # SoftHSM takes no such key
    return trust, " & ".join(words)


def controls() -> Iterator[Case]:
    """Yield the bases without oddities."""
    for base in BASES:
        yield Case(base, ())
