"""What only the long form of the tests runs."""

from __future__ import annotations

import pytest

from tests.support.children import LONG

ONLY_LONG = pytest.mark.skipif(not LONG, reason="only in the long form")
"""Marks cases whose mechanism another case shows in the short form, too."""
