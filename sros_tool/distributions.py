"""The ROS 2 distributions: the DDS and Zenoh that they ship, and the vendors whose rules decide.

Source: ``ros2.repos`` of the branches of ros2/ros2 and their release tags, November 2026; REP-2000.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from sros_tool.dds.decision.vendors import TESTED, Vendor
from sros_tool.errors import Note, UsageError
from sros_tool.names import DISTRIBUTIONS, distribution_problem
from sros_tool.wording import enumerated
from sros_tool.zenoh.releases import RELEASES, RmwZenohRelease

ROS_DISTRO = "ROS_DISTRO"
"""The variable with the name of the distribution that is sourced."""


class Shipped(NamedTuple):
    """A DDS that a distribution ships.

    ``latest`` is its latest version; ``vendor`` has the rules by which sros decides: the rules of
    another release if ``latest`` was not tested.
    """

    product: str
    latest: str
    vendor: Vendor
    distribution: Distribution

    @property
    def title(self) -> str:
        """Text such as ``Kilted with Fast DDS 3.2``."""
        return f"{self.distribution.title} with {self.release}"

    @property
    def release(self) -> str:
        """The product and the release, such as ``Fast DDS 3.6``."""
        return f"{self.product} {_minor_version(self.latest)}"

    @property
    def tested(self) -> bool:
        """Whether sros decides by rules that were tested with this release."""
        return _minor_version(self.vendor.release) == _minor_version(self.latest)

    def __str__(self) -> str:
        """Return text such as ``Fast DDS 3.6, assumed to decide as Fast DDS 2.14``."""
        return self.release + ("" if self.tested else f", assumed to decide as {self.vendor.title}")


class Distribution(NamedTuple):
    """A ROS 2 distribution.

    ``until`` is the month in which its support ends.  ``stands_for`` is an unsupported distribution
    that this distribution replaces, or "".
    """

    name: str
    until: str
    fast: str
    cyclone: str
    stands_for: str = ""

    @property
    def given_name(self) -> str:
        """The name as the user wrote it."""
        return self.stands_for or self.name

    @property
    def title(self) -> str:
        """The name for messages, such as ``Lyrical``."""
        return self.given_name.capitalize()

    @property
    def title_with_assumption(self) -> str:
        """The title, with the distribution that decides in place of an unsupported one."""
        like = self.stands_for and f", which is assumed to be like {self.name.capitalize()}"
        return self.title + like

    @property
    def shipped(self) -> tuple[Shipped, ...]:
        """The DDS products that the distribution ships, the default first."""
        products = (("Fast DDS", self.fast), ("Cyclone DDS", self.cyclone))
        return tuple(
            Shipped(product, version, _tested_vendor(product, version), self)
            for product, version in products
        )

    @property
    def vendors(self) -> tuple[Vendor, ...]:
        """The vendors that decide for nodes of the distribution, the default first."""
        return tuple(shipped.vendor for shipped in self.shipped)

    @property
    def zenoh(self) -> RmwZenohRelease:
        """The release of rmw_zenoh that the distribution ships."""
        return next(release for release in RELEASES if release.distribution.lower() == self.name)

    @property
    def assumption(self) -> str:
        """A sentence on the rules that an unsupported distribution is assumed to have, or ""."""
        if not self.stands_for:
            return ""
        why = "has no releases" if self.stands_for == _ROLLING else "is not supported any more"
        return (
            f"ROS 2 {self.title} {why}; sros assumes that access is decided as in "
            f"{self.name.capitalize()}."
        )

    def reason_for(self, vendor: Vendor) -> str:
        """Return why a vendor decides, such as ``as in ROS 2 Jazzy``, with the assumptions."""
        parts = [f"as in ROS 2 {self.title_with_assumption}"]
        parts += (
            f"whose {shipped.release} was not tested"
            for shipped in self.shipped
            if shipped.vendor is vendor and not shipped.tested
        )
        return ", ".join(parts)

    def shipped_product(self, product: str) -> Shipped | None:
        """Return the release of a product that this distribution ships, or None."""
        return next((shipped for shipped in self.shipped if shipped.product == product), None)

    def shipped_vendor_product(self, vendor: Vendor) -> Shipped:
        """Return the release of a vendor's product (``cyclonedds``) that the distribution ships.

        Raises:
            UsageError: the distribution ships another release than ``vendor`` names, or none that
                sros knows.
        """
        shipped = self.shipped_product(vendor.traits.product)
        if shipped and (shipped.vendor is vendor or "-" not in vendor.value):
            return shipped
        raise UsageError(
            f"ROS 2 {self.title} does not ship {vendor.title}",
            f"It ships {' and '.join(known.release for known in self.shipped)}.",
            "Name only the distribution, only the vendor, or a vendor that the distribution ships.",
        )


SUPPORTED = (
    Distribution("humble", "May 2027", fast="2.6.12", cyclone="0.10.5"),
    Distribution("jazzy", "May 2029", fast="2.14.6", cyclone="0.10.5"),
    Distribution("kilted", "December 2026", fast="3.2.5", cyclone="0.10.5"),
    Distribution("lyrical", "May 2031", fast="3.6.2", cyclone="11.0.1"),
)
"""The supported distributions, the earliest first."""
_ROLLING = "rolling"


def find_distribution(name: str) -> Distribution:
    """Return a distribution by its name.

    An unsupported distribution counts as the next supported one, and Rolling as the latest.

    Raises:
        UsageError: there is no distribution of this name.
    """
    if distribution_problem(name):
        raise UsageError(
            f"{name!r} is not a ROS 2 distribution that sros knows",
            f"sros knows {', '.join(DISTRIBUTIONS)}.",
            "Name one of them.",
        )
    later = DISTRIBUTIONS[DISTRIBUTIONS.index(name) :]
    like = next((supported for supported in SUPPORTED if supported.name in later), SUPPORTED[-1])
    return like if like.name == name else like._replace(stands_for=name)


def shipped_title(vendor: Vendor, distributions: Sequence[Distribution]) -> str:
    """Return the title of a vendor, with the distributions for which the vendor decides.

    An example is ``Fast DDS 2.14 of Jazzy and Fast DDS 3.2 of Kilted``.
    """
    by_release: dict[str, list[str]] = {}
    for distribution in distributions:
        for shipped in distribution.shipped:
            if shipped.vendor is vendor:
                by_release.setdefault(shipped.release, []).append(distribution.title)
    titles = [f"{release} of {enumerated(names)}" for release, names in by_release.items()]
    return enumerated(titles) if titles else vendor.title


def selected_vendors(vendor: str, distributions: Sequence[Distribution]) -> tuple[str, ...]:
    """Return the name of the chosen vendor, or the names of the vendors of distributions.

    The result is () if ``vendor`` is "" and there are no distributions.

    If there are both, the result is the releases of the vendor that the distributions ship.

    Raises:
        UsageError: a distribution does not ship the vendor.
    """
    if not vendor:
        every = (dds.value for known in distributions for dds in known.vendors)
        return tuple(dict.fromkeys(every))
    if not distributions:
        return (vendor,)
    shipped = (known.shipped_vendor_product(Vendor(vendor)).vendor.value for known in distributions)
    return tuple(dict.fromkeys(shipped))


def sourced_distribution(environment_value: str | None) -> Distribution | None:
    """Return the distribution that $ROS_DISTRO names; None if sros does not know it."""
    return find_distribution(environment_value) if environment_value in DISTRIBUTIONS else None


def unknown_distribution_notes(environment: Mapping[str, str]) -> list[Note]:
    """Return a note if $ROS_DISTRO names an unknown distribution, and so selects no vendor."""
    name = environment.get(ROS_DISTRO, "")
    if not name or not distribution_problem(name):
        return []
    text = f"{ROS_DISTRO} is {name!r}, which sros does not know, so sros ignores this variable. "
    return [
        Note(
            "distribution.unknown",
            f"{text}Set {ROS_DISTRO} to the sourced distribution, such as jazzy.",
        )
    ]


def _tested_vendor(product: str, version: str) -> Vendor:
    """Return the tested vendor of a version's release, or of the latest release before it.

    If all tested releases are later, the result is the vendor of the first one.
    """
    vendors = sorted(
        (vendor for vendor in TESTED if vendor.traits.product == product),
        key=lambda vendor: _numbers(vendor.release),
    )
    release = _numbers(_minor_version(version))
    not_later = [
        vendor for vendor in vendors if _numbers(_minor_version(vendor.release)) <= release
    ]
    return not_later[-1] if not_later else vendors[0]


def _minor_version(version: str) -> str:
    """Return the first two numbers of a version, by which releases differ."""
    return ".".join(version.split(".")[:2])


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(map(int, version.split(".")))
