"""RSA keys that a CA must not certify, because they are easy to break."""

from __future__ import annotations

import math

import pytest
from cryptography.hazmat.primitives.asymmetric import rsa

from sros_tool.pki.keys import generate_key, key_problem

PRODUCT = math.prod(n for n in range(3, 168) if all(n % d for d in range(2, n)))


def number(bits: int, remainder: int) -> int:
    """Return an odd number of this size by its remainder modulo the product of small primes."""
    first = remainder if remainder % 2 else remainder + PRODUCT
    return first + ((3 << (bits - 2)) // (2 * PRODUCT)) * 2 * PRODUCT


SOUND = number(2048, 2)
NEAR = number(1024, 2)
WEAK = {
    "public exponent, 3,": (SOUND, 3),
    "public exponent, 65535,": (SOUND, 65535),
    "public exponent, very large,": (SOUND, (1 << 256) + 1),
    "a small factor": (number(2048, 2 * 167), 65537),
    "a faulty chip": (number(2048, pow(65537, 5, PRODUCT)), 65537),
    "primes are too close": (NEAR * (NEAR + 2 * PRODUCT), 65537),
}


@pytest.mark.parametrize("why", WEAK)
def test_a_weak_key_is_named(why: str) -> None:
    modulus, exponent = WEAK[why]
    assert why in key_problem(rsa.RSAPublicNumbers(exponent, modulus).public_key())


def test_a_sound_key_is_not() -> None:
    for key in (rsa.RSAPublicNumbers(65537, SOUND).public_key(), generate_key().public_key()):
        assert key_problem(key) == ""
    assert key_problem(rsa.generate_private_key(65537, 2048).public_key()) == ""
