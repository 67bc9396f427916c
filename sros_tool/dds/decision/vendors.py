"""The vendors of DDS Security, and the differences of their decisions, as data.

The decisions of Fast DDS 2.6.12, 2.9.1, 2.14.5, 2.14.6, 3.2.5 and 3.6.2 and Cyclone DDS 0.10.2,
0.10.5 and 11.0.1 were tested with the real libraries; Fast DDS 2.14.5 and 2.14.6 decide alike, and
so do Cyclone DDS 0.10.2 and 0.10.5.  Vendors that were never tested, such as OpenDDS and Connext,
are assumed to follow the standard, as their manuals say.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import Enum, StrEnum, auto


class Style(Enum):
    """The rules by which a topic expression with wildcards matches names."""

    FNMATCH = auto()
    """POSIX fnmatch of glibc, without escapes, where ``*`` crosses ``/``."""
    CYCLONE = auto()
    """The matching of Cyclone DDS for ``*``, ``?`` and ``[..]``."""


class Subjects(Enum):
    """The rule by which a grant's subject matches the subject of a certificate."""

    EXACT = auto()
    """The same attributes in the same order; spaces around attributes do not count."""
    WHOLE_ATTRIBUTES = auto()
    """Equal texts between commas, even escaped ones; spaces around texts are ignored (2.6, 2.9)."""
    ANY_ORDER = auto()
    """The same attributes in any order (Fast DDS 2.14)."""
    SUBSET = auto()
    """Each part of the certificate's subject, split at ``, / |``, is in the grant's subject."""
    TRIMMED_SUBSET = auto()
    """Each part of the certificate's subject, split at ``, / |``, is in the grant's subject.

    Spaces around a part are ignored.
    """


class DateRule(Enum):
    """The rule by which a vendor reads the dates in a grant."""

    STANDARD = auto()
    """A date has the offset that it states, or is in UTC."""
    LOCAL = auto()
    """A date is in the host's standard time; its offset is ignored (Fast DDS)."""
    CYCLONE = auto()
    """As in the standard, but a date is past if it is incomplete, before 1970 or after 2262."""


class OpenRange(Enum):
    """The meaning of a range of domains with only a minimum or only a maximum."""

    OPEN = auto()
    """``min N`` without a maximum means N and above; ``max N`` without a minimum means 0 to N."""
    SINGLE = auto()
    """``min N`` without a maximum means N; ``max N`` without a minimum means 0 to N (Fast DDS)."""
    CRASHES = auto()
    """``min N`` without a maximum means N; without a minimum, the process crashes (Cyclone DDS)."""


class TopicNames(Enum):
    """The characters that a topic's name may have."""

    ANY = auto()
    WORDS = auto()
    """Letters, digits, ``_`` and ``/``; the first is not a digit (Cyclone DDS 0.10)."""
    PRINTABLE = auto()
    """Printable ASCII characters except spaces, quotes and ``* ? [ ] # $`` (Cyclone DDS 11)."""


class DenyPartitions(Enum):
    """The partitions that a deny rule must name to apply to an endpoint."""

    ANY_OR_ALL = auto()
    """One of the endpoint's partitions; a rule without partitions applies to all endpoints."""
    ANY_OR_DEFAULT = auto()
    """One of the endpoint's partitions; without partitions, a rule applies to the default one."""
    IGNORED = auto()
    """None: a deny rule applies in all partitions, whatever partitions it names (Fast DDS)."""


class Signers(Enum):
    """The signers of governance and permissions that a vendor accepts."""

    AUTHORITY = auto()
    """The permissions CA itself, whose certificate is in the message."""
    LISTED = auto()
    """Anyone whose certificate is in the permissions CA's file; no chain is needed (2.14)."""
    CHAIN = auto()
    """Anyone whose certificate is in the signed document and chains to the permissions CA."""


class Hashes(Enum):
    """The signature algorithms that the certificates of CAs and enclaves may have."""

    ANY = auto()
    SHA256 = auto()
    """SHA-256 with EC or RSA (not RSA-PSS), and SHA-1 with RSA (Fast DDS)."""


class Keys(Enum):
    """The kinds of keys that enclaves and their CA may have."""

    ANY = auto()
    EC_AND_RSA = auto()
    """EC keys and RSA keys of any size, but not Ed25519 (Fast DDS)."""
    SMALL = auto()
    """EC keys of 256 bits and RSA keys of 2048 bits (Cyclone DDS)."""


class DocumentReader(Enum):
    """The parser for governance and permissions (`sros_tool.dds.decision.documents`)."""

    STANDARD = auto()
    """The schema of the standard."""
    FAST = auto()
    """TinyXML-2, as Fast DDS uses it."""
    CYCLONE = auto()
    """The XML parser of Cyclone DDS."""


@dataclass(frozen=True, slots=True, eq=False)
class VendorTraits:
    """The names of one vendor, and its decisions where vendors differ.

    The default of a field is the behavior that the standard demands.
    """

    title: str
    """The name and version, for messages."""
    product: str = ""
    """The product name without a version, common to all releases."""
    tested: bool = False
    """Whether these traits were compared with the decisions of the real library."""
    reader: DocumentReader = DocumentReader.STANDARD
    style: Style = Style.FNMATCH
    governance_both_ways: bool = False
    """A rule also applies if the topic's name is a pattern that matches the rule's expression."""
    trims_texts: bool = False
    """Spaces around the text of an XML element are ignored."""
    subjects: Subjects = Subjects.EXACT
    escapes_subjects: bool = False
    r"""Characters of a subject beyond ASCII are compared as escapes (``\C3\B6``)."""
    longest_subject: int | None = None
    """Number of bytes at the beginning of a certificate's subject that are compared; None: all."""
    drops_expired: bool = False
    """Running participants lose each other when the certificate of one of them expires.

    This is so since Fast DDS 2.6.12 and 3.2.5 (CVE-2025-67108); with 2.14.6 and 3.6.2, participants
    stay connected (all tested).
    """
    expiry_overflows: bool = False
    """A certificate that expires more than 292 years from now counts as expired.

    The expiry time in nanoseconds overflows 64 bits and wraps around, so that the certificate is
    valid again from 584 years on, and so on.
    """
    crashes_on_empty_subject: bool = False
    """A certificate with an empty subject crashes its own process and the processes of peers."""
    date_rule: DateRule = DateRule.STANDARD
    passes_over_outdated_grants: bool = False
    """If the first grant for a subject is not valid now, a later grant is used."""
    open_range: OpenRange = OpenRange.OPEN
    filters_own_domain: bool = True
    """A participant ignores those rules of its own permissions that are for domains other than
    the one that it joins. (Its peers always ignore them.)
    """
    relays_count_for_readers: bool = False
    """For a reader, peers look at the ``<subscribe>`` of a rule, and then at its ``<relay>``."""
    topic_decides: bool = False
    """The first rule that names the topic decides, even if its partitions do not match."""
    deny_partitions: DenyPartitions = DenyPartitions.ANY_OR_ALL
    honors_default: bool = True
    """The ``<default>`` of the grant decides if no rule matches."""
    crashes_on_missing_content: bool = False
    """An empty document or element crashes the process; most vendors only refuse the document.

    The elements are ``<topic_expression>`` and ``<not_after>`` (Fast DDS before 3).
    """
    crashes_on_empty_texts: bool = False
    """A decision that reads an expression or a default without text crashes the process."""
    topic_names: TopicNames = TopicNames.ANY
    longest_topic_name: int | None = None
    """Longest topic name that rules match, in bytes; longer names can still be created."""
    creates_topics: bool = False
    """Creating an endpoint first creates its topic; this needs a right to publish or subscribe.

    The first rule that names the topic decides, for publishing or for subscribing.
    """
    asks_both_directions: bool = False
    """A topic can be created if either the rules to publish or the rules to subscribe allow it."""
    always_needs_allow_rule: bool = False
    """A participant without allow rules never starts, even if joining is not controlled."""
    needs_domain_rule: bool = True
    """A participant does not start in a domain that the governance does not list."""
    shares_open_topics: bool = False
    """A participant still exchanges data on unprotected topics with peers that refuse it.

    Access control in the topic's other direction prevents this (tested).
    """
    ignores_unauthenticated: bool = False
    """Participants without an identity are refused even if governance allows them (2.9)."""
    controls_unauthenticated: bool = True
    """Access control applies to participants without an identity.

    If False, access control does not apply to these participants, but topics with
    enable_discovery_protection are hidden from them, even if discovery_protection_kind is NONE
    (Cyclone DDS 0.10.2).
    """
    refuses_open_rtps: bool = False
    """RTPS protection is refused in a governance that allows unauthenticated participants."""
    signers: Signers = Signers.AUTHORITY
    reads_first_authority: bool = False
    """Only the first CA in a file is trusted."""
    reads_lists_of_authorities: bool = False
    """Revocation lists in the file of the identity CA count in addition to ``crl.pem``."""
    verifies_authorities: bool = False
    """The first certificate of a CA file is strictly verified when the file is loaded.

    If the vendor does not accept the certificate's hash, the process crashes (use after free).
    """
    verifies_policies: bool = False
    """Certificate policies and the root CA's own signature are verified (Fast DDS)."""
    reads_trusted_certificates: bool = True
    """A certificate may be in a PEM block ``TRUSTED CERTIFICATE``."""
    reads_files_as_text: bool = False
    """A zero byte in a certificate file or a revocation list ends the line, or the whole file."""
    hashes: Hashes = Hashes.ANY
    keys: Keys = Keys.ANY
    reads_tokens: bool = True
    """The key of an enclave can be on a PKCS#11 token that ``key.p11`` names."""
    largest_document: int | None = None
    """Largest signed permissions, in bytes, with which handshakes always finish; None: no limit."""


_STANDARD = VendorTraits("DDS-Security 1.1")
_FAST_2_14 = VendorTraits(
    "Fast DDS 2.14",
    product="Fast DDS",
    tested=True,
    reader=DocumentReader.FAST,
    governance_both_ways=True,
    subjects=Subjects.ANY_ORDER,
    longest_subject=1024,
    crashes_on_empty_subject=True,
    date_rule=DateRule.LOCAL,
    longest_topic_name=251,
    passes_over_outdated_grants=True,
    open_range=OpenRange.SINGLE,
    filters_own_domain=False,
    relays_count_for_readers=True,
    topic_decides=True,
    deny_partitions=DenyPartitions.IGNORED,
    honors_default=False,
    crashes_on_missing_content=True,
    always_needs_allow_rule=True,
    needs_domain_rule=False,
    refuses_open_rtps=True,
    signers=Signers.LISTED,
    reads_lists_of_authorities=True,
    verifies_authorities=True,
    verifies_policies=True,
    reads_files_as_text=True,
    hashes=Hashes.SHA256,
    keys=Keys.EC_AND_RSA,
)
_CYCLONE_0_10 = VendorTraits(
    "Cyclone DDS 0.10",
    product="Cyclone DDS",
    tested=True,
    controls_unauthenticated=False,
    reader=DocumentReader.CYCLONE,
    style=Style.CYCLONE,
    trims_texts=True,
    subjects=Subjects.SUBSET,
    escapes_subjects=True,
    date_rule=DateRule.CYCLONE,
    open_range=OpenRange.CRASHES,
    deny_partitions=DenyPartitions.ANY_OR_DEFAULT,
    crashes_on_empty_texts=True,
    topic_names=TopicNames.WORDS,
    creates_topics=True,
    shares_open_topics=True,
    signers=Signers.CHAIN,
    reads_first_authority=True,
    keys=Keys.SMALL,
    reads_tokens=False,
    reads_trusted_certificates=False,
)


class Vendor(StrEnum):
    """A DDS implementation, or the specification itself.

    To add a vendor that decides by the standard, add an entry here: options, texts and comparisons
    use all entries.  `sros_tool.runtime.rmw` maps RMWs to vendors.  In options, a product without a
    version means the first entry of this product.
    """

    traits: VendorTraits

    def __new__(cls, word: str, traits: VendorTraits = _STANDARD) -> Vendor:
        """Create the member whose value is ``word``."""
        member = str.__new__(cls, word)
        member._value_ = word
        member.traits = traits
        return member

    STANDARD = "standard"
    FAST = "fastdds", _FAST_2_14
    FAST_2_6 = (
        "fastdds-2.6",
        replace(
            _FAST_2_14,
            title="Fast DDS 2.6",
            drops_expired=True,
            expiry_overflows=True,
            subjects=Subjects.WHOLE_ATTRIBUTES,
            crashes_on_missing_content=False,
            largest_document=60 * 1024 - 1,
        ),
    )
    FAST_2_9 = (
        "fastdds-2.9",
        replace(
            _FAST_2_14,
            title="Fast DDS 2.9.1",
            subjects=Subjects.WHOLE_ATTRIBUTES,
            ignores_unauthenticated=True,
            refuses_open_rtps=False,
            signers=Signers.CHAIN,
            verifies_authorities=False,
            largest_document=60 * 1024 - 1,
        ),
    )
    FAST_3_2 = (
        "fastdds-3.2",
        replace(
            _FAST_2_14,
            title="Fast DDS 3.2",
            drops_expired=True,
            expiry_overflows=True,
            crashes_on_missing_content=False,
        ),
    )
    FAST_3_6 = (
        "fastdds-3.6",
        replace(_FAST_2_14, title="Fast DDS 3.6", crashes_on_missing_content=False),
    )
    CYCLONE = "cyclonedds", _CYCLONE_0_10
    CYCLONE_11 = (
        "cyclonedds-11",
        replace(
            _CYCLONE_0_10,
            title="Cyclone DDS 11.0",
            subjects=Subjects.TRIMMED_SUBSET,
            topic_names=TopicNames.PRINTABLE,
            asks_both_directions=True,
            signers=Signers.LISTED,
        ),
    )
    OPENDDS = "opendds", VendorTraits("OpenDDS", product="OpenDDS", reads_tokens=False)
    CONNEXT = (
        "connext",
        VendorTraits("Connext 6.1.1 and later", product="Connext", reads_tokens=False),
    )

    @property
    def title(self) -> str:  # type: ignore[override]
        """The name and version for messages, such as ``Fast DDS 2.14``."""
        return self.traits.title

    @property
    def release(self) -> str:
        """The version in the title, such as ``2.14``; only for tested vendors."""
        return self.title.removeprefix(self.traits.product).strip()

    @property
    def documented_only(self) -> bool:
        """Whether the vendor was never tested, so that the standard's rules are assumed."""
        return not self.traits.tested and self is not Vendor.STANDARD


TESTED = tuple(vendor for vendor in Vendor if vendor.traits.tested)
"""The vendors whose decisions were compared with the real library."""

ZENOH = "zenoh"
"""The word for Zenoh in options and checks that take the names of vendors."""

DEFAULT_RELEASES = tuple({vendor.traits.product: vendor for vendor in reversed(TESTED)}.values())[
    ::-1
]
"""The release of each tested product that options without a version mean."""


def _releases(product: str) -> tuple[Vendor, ...]:
    return tuple(vendor for vendor in Vendor if vendor.traits.product == product)


FAST_DDS = _releases("Fast DDS")
"""All releases of Fast DDS."""

CYCLONE_DDS = _releases("Cyclone DDS")
"""All releases of Cyclone DDS."""


WHOLE_PRODUCTS = {
    f"all-{vendor.value}": tuple(
        release for release in TESTED if release.traits.product == vendor.traits.product
    )
    for vendor in DEFAULT_RELEASES
}
"""Word for all tested releases of a product, such as ``all-fastdds`` → these releases."""


def words_of(vendors: Iterable[Vendor]) -> list[str]:
    """Return the fewest option values that together name exactly these vendors."""
    left = list(vendors)
    words = []
    for word, releases in WHOLE_PRODUCTS.items():
        if set(releases) <= set(left):
            words.append(word)
            left = [vendor for vendor in left if vendor not in releases]
    return [*words, *(vendor.value for vendor in left)]


def joined_titles(titles: Iterable[str]) -> list[str]:
    """Return titles of vendors, with the releases of a product joined into one title.

    If all tested releases are present, the title is the name of the product; otherwise the title
    names the releases, such as ``Fast DDS 2.14/3.6``.  Other texts, such as ``Zenoh``, stay as they
    are.
    """
    of_title = {vendor.title: vendor for vendor in TESTED}
    releases: dict[str, list[Vendor]] = {}
    for title in titles:
        vendor = of_title.get(title)
        named = releases.setdefault(vendor.traits.product if vendor else title, [])
        named += [vendor] if vendor else []
    return [
        product if set(named) == _tested_releases(product) else f"{product} {_releases_text(named)}"
        for product, named in releases.items()
    ]


def _tested_releases(product: str) -> set[Vendor]:
    return {vendor for vendor in TESTED if vendor.traits.product == product}


def _releases_text(vendors: Iterable[Vendor]) -> str:
    """Return the releases of vendors, earliest first, such as ``2.9.1/2.14``."""
    releases = (vendor.release for vendor in vendors)
    return "/".join(sorted(releases, key=lambda release: [*map(int, release.split("."))]))
