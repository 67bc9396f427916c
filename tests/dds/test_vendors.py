"""Vendors: what follows from an entry in their table."""

import pytest

from sros_tool.dds.decision.vendors import CYCLONE_DDS, DEFAULT_RELEASES, FAST_DDS, TESTED, Vendor


def test_the_measured_vendors() -> None:
    assert TESTED == FAST_DDS + CYCLONE_DDS
    assert DEFAULT_RELEASES == (Vendor.FAST, Vendor.CYCLONE)
    assert {each.release for each in FAST_DDS} == {"2.6", "2.9.1", "2.14", "3.2", "3.6"}
    assert CYCLONE_DDS == (Vendor.CYCLONE, Vendor.CYCLONE_11)


@pytest.mark.parametrize("vendor", [each for each in Vendor if each not in TESTED])
def test_vendors_that_were_not_tested_decide_by_the_standard(vendor: Vendor) -> None:
    names = {"title", "product", "reads_tokens"}  # what its RMW reads is known from its source
    for name in set(type(vendor.traits).__slots__) - names:
        assert getattr(vendor.traits, name) == getattr(Vendor.STANDARD.traits, name)
    assert vendor.documented_only is (vendor is not Vendor.STANDARD)
