"""Tables of many cases, each of which takes less time than pytest takes for a test."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from inspect import signature
from typing import Any

_Test = Callable[..., None]


def for_every(values: Iterable[Any], name: Callable[[Any], str] = str) -> Callable[[_Test], _Test]:
    """Run a test for every value, as its first argument; report all that fail by their names."""
    table = list(values)

    def decorate(test: _Test) -> _Test:
        def run(**fixtures: Any) -> None:
            failed = []
            for value in table:
                try:
                    test(value, **fixtures)
                except AssertionError as error:
                    failed.append(f"{name(value)}: {error}")
            assert table
            assert not failed, "\n".join(failed)

        run.__name__, run.__doc__, run.__module__ = test.__name__, test.__doc__, test.__module__
        all_of = signature(test)
        run.__signature__ = all_of.replace(  # type: ignore[attr-defined]
            parameters=list(all_of.parameters.values())[1:]
        )
        return run

    return decorate
