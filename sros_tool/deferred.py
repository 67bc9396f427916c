"""Classes of values, and regular expressions, that cost little until they are used.

A verb uses few of the classes and expressions in the modules that it imports, and the processor of
a robot is slow.  Python takes about 0.3 ms for each frozen dataclass, and 0.1 ms for each named
tuple and regular expression, on a fast processor.  What is here has the meaning that it has in
Python, also to type checkers.
"""

from __future__ import annotations

import dataclasses
import re
from collections import namedtuple
from collections.abc import Callable, Sequence
from operator import attrgetter
from typing import TYPE_CHECKING, Any, NoReturn

_Method = Callable[..., Any]


def _dataclass(
    *,
    frozen: bool = False,
    slots: bool = False,
    order: bool = False,
    eq: bool = True,
    kw_only: bool = False,
) -> Callable[[type], type]:
    """Return a decorator like `dataclasses.dataclass`, which compiles no method of the class.

    ``__init__`` is compiled when the first value is made; the others need not be compiled.
    """

    def decorate(written: type) -> type:
        # The fields, with those of base classes, and the slots are as Python makes them.
        kind: type = dataclasses.dataclass(
            init=False, repr=False, eq=False, slots=slots, kw_only=kw_only
        )(written)
        fields = dataclasses.fields(kind)
        methods: dict[str, _Method] = {"__repr__": _repr}
        methods["__init__"] = _deferred_init(kind, fields, frozen=frozen)
        if eq:
            methods |= _comparisons([each.name for each in fields if each.compare], order=order)
            if not frozen:
                kind.__hash__ = None  # type: ignore[assignment]
                del methods["__hash__"]
        if frozen:
            methods |= {"__setattr__": _refuse, "__delattr__": _refuse}
        if frozen and slots:
            methods |= {"__getstate__": _state, "__setstate__": _set_state}
        for name in methods.keys() - kind.__dict__.keys():
            setattr(kind, name, methods[name])
        return kind

    return decorate


def _deferred_init(
    kind: type, fields: Sequence[dataclasses.Field[Any]], *, frozen: bool
) -> _Method:
    def first(self: object, *values: object, **named: object) -> None:
        kind.__init__ = compiled = _compiled_init(kind, fields, frozen)  # type: ignore[misc]
        compiled(self, *values, **named)

    return first


def _compiled_init(kind: type, fields: Sequence[dataclasses.Field[Any]], frozen: bool) -> _Method:
    missing = dataclasses.MISSING
    names: dict[str, Any] = {"_set": object.__setattr__, "_MISSING": missing}
    positional, named, body = ["self"], list[str](), list[str]()
    for field in fields:
        name, default, value = field.name, "", field.name
        if field.default is not missing:
            names[f"_default_{name}"], default = field.default, f"=_default_{name}"
        elif field.default_factory is not missing:
            names[f"_make_{name}"], default = field.default_factory, "=_MISSING"
            value = f"_make_{name}() if {name} is _MISSING else {name}"
        (named if field.kw_only else positional).append(f"{name}{default}")
        body.append(f"_set(self, {name!r}, {value})" if frozen else f"self.{name} = {value}")
    if hasattr(kind, "__post_init__"):
        body.append("self.__post_init__()")
    parameters = ", ".join([*positional, *(["*", *named] if named else [])])
    exec(f"def __init__({parameters}):\n " + "\n ".join(body or ["pass"]), names)  # noqa: S102
    made: _Method = names["__init__"]
    return made


def _repr(self: Any) -> str:
    shown = (field.name for field in dataclasses.fields(self) if field.repr)
    return f"{type(self).__qualname__}({', '.join(f'{x}={getattr(self, x)!r}' for x in shown)})"


def _comparisons(names: Sequence[str], *, order: bool) -> dict[str, _Method]:
    # Of a single name, `attrgetter` makes no tuple.
    values = attrgetter(*names, *names[:1]) if names else lambda _value: ()

    def equal(self: object, other: object) -> bool:
        same = self.__class__ is other.__class__
        return bool(values(self) == values(other)) if same else NotImplemented

    def less(self: object, other: object) -> bool:
        same = self.__class__ is other.__class__
        return bool(values(self) < values(other)) if same else NotImplemented

    def less_or_equal(self: object, other: object) -> bool:
        same = self.__class__ is other.__class__
        return bool(values(self) <= values(other)) if same else NotImplemented

    methods: dict[str, _Method] = {"__eq__": equal, "__hash__": lambda self: hash(values(self))}
    # Python takes greater, and greater or equal, from these.
    return methods | ({"__lt__": less, "__le__": less_or_equal} if order else {})


def _refuse(_self: object, name: str, *_value: object) -> NoReturn:
    raise dataclasses.FrozenInstanceError(f"the field {name!r} cannot be changed")


def _state(self: Any) -> list[Any]:
    return [getattr(self, field.name) for field in dataclasses.fields(self)]


def _set_state(self: Any, state: Sequence[Any]) -> None:
    for field, value in zip(dataclasses.fields(self), state, strict=True):
        object.__setattr__(self, field.name, value)


class _NamedTupleKind(type):
    """The class of `NamedTuple`, which makes a plain named tuple of each class that has it as base.

    In contrast to `typing.NamedTuple`, it compiles no annotation.
    """

    def __new__(cls, name: str, bases: tuple[type, ...], body: dict[str, Any]) -> type:
        names = body.get("__annotations__", {})
        named: Any = {"module": body["__module__"]}
        named["defaults"] = [body.pop(each) for each in names if each in body]
        made: type = namedtuple(name, names, **named)  # type: ignore[misc]
        if len(bases) > 1:  # generic, too
            return type(name, (made, *bases[1:]), body)
        for attribute, value in body.items():
            setattr(made, attribute, value)
        return made


class _Regex:
    """A regular expression that is compiled when one of its attributes is used first."""

    def __init__(self, pattern: Any, flags: int = 0) -> None:
        self._written = pattern, flags

    def __getattr__(self, name: str) -> Any:
        value = getattr(re.compile(*self._written), name)
        setattr(self, name, value)
        return value


if TYPE_CHECKING:
    from dataclasses import dataclass as dataclass
    from re import compile as regex
    from typing import NamedTuple as NamedTuple
else:
    dataclass = _dataclass
    regex = _Regex
    NamedTuple = type.__new__(_NamedTupleKind, "NamedTuple", (), {})

__all__ = ["NamedTuple", "dataclass", "regex"]
