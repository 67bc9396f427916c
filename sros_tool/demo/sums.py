"""What servers of the demo compute, and clients check."""

from __future__ import annotations


def operands(number: int) -> tuple[int, int]:
    """The two numbers that the request of that number asks about; each request has its own sum."""
    return number, 3 * number + 1


def fibonacci(order: int) -> list[int]:
    """The sequence of Fibonacci's numbers up to the one of that order, from 0 and 1."""
    sequence = [0, 1]
    while len(sequence) <= order:
        sequence.append(sequence[-1] + sequence[-2])
    return sequence[: order + 1]
