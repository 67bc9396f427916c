"""The ROS 2 distributions, and the vendor by whose rules each one is decided."""

from __future__ import annotations

import pytest

from sros_tool.dds.decision.vendors import TESTED, Vendor
from sros_tool.distributions import SUPPORTED, find_distribution
from sros_tool.errors import UsageError
from sros_tool.names import DISTRIBUTIONS


def test_each_release_has_its_own_rules_or_is_called_not_tested() -> None:
    for known in SUPPORTED:
        assert find_distribution(known.name) is known and not known.assumption
        assert known.zenoh.distribution == known.title
        for shipped in known.shipped:
            assert shipped.vendor in TESTED
            assert shipped.vendor.traits.product == shipped.product
            own = [each for each in TESTED if shipped.vendor.title.startswith(shipped.release)]
            assert shipped.tested is bool(own)
            assert ("not tested" in known.reason_for(shipped.vendor)) is not shipped.tested
    assert find_distribution("lyrical").vendors[1] is Vendor.CYCLONE_11
    assert find_distribution("jazzy").vendors == (Vendor.FAST, Vendor.CYCLONE)


@pytest.mark.parametrize(
    ("name", "like"), [("foxy", "humble"), ("iron", "jazzy"), ("rolling", "lyrical")]
)
def test_what_is_assumed_of_others_is_said(name: str, like: str) -> None:
    taken = find_distribution(name)
    assert (taken.name, taken.title) == (like, name.capitalize())
    assert taken.vendors == find_distribution(like).vendors
    assert taken.assumption.endswith(f"assumes that access is decided as in {like.capitalize()}.")


def test_an_unknown_distribution_is_refused_with_all_that_are_known() -> None:
    with pytest.raises(UsageError) as refused:
        find_distribution("Jazzy")
    assert all(name in str(refused.value) for name in DISTRIBUTIONS)


def test_a_vendor_without_a_release_means_what_the_distribution_ships() -> None:
    lyrical = find_distribution("lyrical")
    assert lyrical.shipped_vendor_product(Vendor.CYCLONE).vendor is Vendor.CYCLONE_11
    with pytest.raises(UsageError, match="It ships Fast DDS"):
        lyrical.shipped_vendor_product(Vendor.CONNEXT)
