"""Dataclasses that take little time to define.

`dataclasses.dataclass` compiles six methods for each class, which takes more than half a
millisecond; a verb imports up to a hundred and thirty classes, and makes values of few of them.
Here comparison, hash and text need nothing compiled, and ``__init__`` is compiled when the first
value is made.  Everything else is as in `dataclasses`, whose `field`, `fields` and `replace` work
with these classes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from operator import attrgetter, ge, gt, le, lt
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dataclasses import dataclass as dataclass
else:

    def dataclass(
        cls: type | None = None,
        /,
        *,
        frozen: bool = False,
        slots: bool = False,
        eq: bool = True,
        order: bool = False,
        kw_only: bool = False,
    ) -> Any:
        """Make a class a dataclass; the arguments are those of `dataclasses.dataclass`."""

        def define(cls: type) -> type:
            # Without methods, which are added below, and so that assigning is not refused yet.
            define_fields = dataclasses.dataclass(
                init=False, repr=False, eq=False, slots=slots, kw_only=kw_only
            )
            cls = define_fields(cls)
            methods = {"__init__": _compiled_when_called(cls, frozen), "__repr__": _text}
            if eq:
                methods |= _comparison(cls, order=order, hashable=frozen)
            if frozen:
                methods |= {"__setattr__": _refuse_change, "__delattr__": _refuse_change}
                if slots:
                    methods |= {"__getstate__": _state, "__setstate__": _restore}
            written = {name for name, method in vars(cls).items() if method is not None}
            for name in methods.keys() - written:
                setattr(cls, name, methods[name])
            return cls

        return define if cls is None else define(cls)


def _compiled_when_called(cls: Any, frozen: bool) -> Callable[..., None]:
    """Return an ``__init__`` that replaces itself by a compiled one."""

    def compile_and_call(self: Any, *args: Any, **kwargs: Any) -> None:
        cls.__init__ = _init(cls, frozen)
        cls.__init__(self, *args, **kwargs)

    return compile_and_call


def _init(cls: Any, frozen: bool) -> Callable[..., None]:
    """Compile ``__init__`` for the fields of a class."""
    names: dict[str, Any] = {"_set": object.__setattr__, "_MISSING": dataclasses.MISSING}
    positional, lines = ["self"], []
    keywords: list[str] = []
    for each in dataclasses.fields(cls):
        name, value, default = each.name, each.name, ""
        if each.default is not dataclasses.MISSING:
            names[f"_{name}"] = each.default
            default = f"=_{name}"
        elif each.default_factory is not dataclasses.MISSING:
            names[f"_{name}"] = each.default_factory
            default, value = "=_MISSING", f"_{name}() if {name} is _MISSING else {name}"
        (keywords if each.kw_only else positional).append(name + default)
        lines.append(f"_set(self, {name!r}, {value})" if frozen else f"self.{name} = {value}")
    if hasattr(cls, "__post_init__"):
        lines.append("self.__post_init__()")
    parameters = ", ".join([*positional, *(["*", *keywords] if keywords else [])])
    source = f"def __init__({parameters}):\n  " + "\n  ".join(lines or ["pass"])
    exec(source, names)  # noqa: S102  only names of fields are in it
    method: Callable[..., None] = names["__init__"]
    method.__qualname__ = f"{cls.__qualname__}.__init__"
    return method


def _comparison(cls: Any, *, order: bool, hashable: bool) -> dict[str, Any]:
    """Return the methods that compare values of a class by its fields."""
    compared = [each.name for each in dataclasses.fields(cls) if each.compare]
    key: Callable[[Any], Any] = attrgetter(*compared) if compared else _nothing

    def equal(self: Any, other: object) -> Any:
        return key(self) == key(other) if _alike(self, other) else NotImplemented

    def hashed(self: Any) -> int:
        return hash(key(self))

    methods: dict[str, Any] = {"__eq__": equal, "__hash__": hashed if hashable else None}
    for test in (lt, le, gt, ge) if order else ():
        methods[f"__{test.__name__}__"] = _ordering(test, key)
    return methods


def _ordering(
    test: Callable[[Any, Any], bool], key: Callable[[Any], Any]
) -> Callable[[Any, object], Any]:
    def compare(self: Any, other: object) -> Any:
        return test(key(self), key(other)) if _alike(self, other) else NotImplemented

    return compare


def _alike(one: object, other: object) -> bool:
    """Return whether two values are of the same class: others are not compared."""
    return one.__class__ is other.__class__


def _nothing(_value: object) -> tuple[()]:
    return ()


def _text(self: Any) -> str:
    shown = (f"{f.name}={getattr(self, f.name)!r}" for f in dataclasses.fields(self) if f.repr)
    return f"{type(self).__qualname__}({', '.join(shown)})"


def _refuse_change(self: object, name: str, *_value: object) -> None:
    raise dataclasses.FrozenInstanceError(f"cannot change field {name!r}")


def _state(self: Any) -> list[Any]:
    return [getattr(self, each.name) for each in dataclasses.fields(self)]


def _restore(self: Any, state: list[Any]) -> None:
    for each, value in zip(dataclasses.fields(self), state, strict=True):
        object.__setattr__(self, each.name, value)
