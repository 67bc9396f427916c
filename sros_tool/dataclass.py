"""Dataclasses that take little time to define.

`dataclasses.dataclass` compiles six methods for each class, which takes more than half a
millisecond; a verb imports up to a hundred and thirty classes, and makes values of few of them.
Here each method is compiled when it is called first.  Everything else is as in `dataclasses`, whose
`field`, `fields` and `replace` work with these classes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
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
            methods: dict[str, Any] = {"__repr__": _text}
            methods["__init__"] = _compiled_when_called(cls, "__init__", frozen)
            if eq:
                methods["__eq__"] = _compiled_when_called(cls, "__eq__")
                methods["__hash__"] = _compiled_when_called(cls, "__hash__") if frozen else None
            for name in _ORDER if order else ():
                methods[name] = _compiled_when_called(cls, name)
            if frozen:
                methods |= {"__setattr__": _refuse_change, "__delattr__": _refuse_change}
                if slots:
                    methods |= {"__getstate__": _state, "__setstate__": _restore}
            written = {name for name, method in vars(cls).items() if method is not None}
            for name in methods.keys() - written:
                setattr(cls, name, methods[name])
            return cls

        return define if cls is None else define(cls)


_ORDER = {"__lt__": "<", "__le__": "<=", "__gt__": ">", "__ge__": ">="}
_COMPARISONS = {"__eq__": "==", **_ORDER}


def _compiled_when_called(cls: Any, name: str, frozen: bool = False) -> Callable[..., Any]:
    """Return a method that replaces itself by a compiled one."""

    def compile_and_call(self: Any, *args: Any, **kwargs: Any) -> Any:
        names: dict[str, Any] = {}
        source = _init(cls, frozen, names) if name == "__init__" else _comparison(cls, name)
        exec(source, names)  # noqa: S102  only names of fields are in it
        names[name].__qualname__ = f"{cls.__qualname__}.{name}"
        setattr(cls, name, names[name])
        return names[name](self, *args, **kwargs)

    return compile_and_call


def _init(cls: Any, frozen: bool, names: dict[str, Any]) -> str:
    """Return ``__init__`` for the fields of a class, and put the defaults into ``names``."""
    names |= {"_dataclass_set": object.__setattr__, "_dataclass_missing": dataclasses.MISSING}
    assign = "_dataclass_set(self, {0!r}, {1})" if frozen else "self.{0} = {1}"
    positional, lines = ["self"], []
    keywords: list[str] = []
    for each in dataclasses.fields(cls):
        parameter = value = each.name
        given = f"_default_{each.name}"
        if each.default is not dataclasses.MISSING:
            names[given] = each.default
            parameter += f"={given}"
        elif each.default_factory is not dataclasses.MISSING:
            names[given] = each.default_factory
            parameter += "=_dataclass_missing"
            value = f"{given}() if {each.name} is _dataclass_missing else {each.name}"
        (keywords if each.kw_only else positional).append(parameter)
        lines.append(assign.format(each.name, value))
    if hasattr(cls, "__post_init__"):
        lines.append("self.__post_init__()")
    parameters = ", ".join([*positional, *(["*", *keywords] if keywords else [])])
    return f"def __init__({parameters}):\n  " + "\n  ".join(lines or ["pass"])


def _comparison(cls: Any, name: str) -> str:
    """Return a method that compares values of a class by its fields, or hashes them."""
    compared = [each.name for each in dataclasses.fields(cls) if each.compare]
    own, others = ("".join(f"{of}.{each}, " for each in compared) for of in ("self", "other"))
    if name == "__hash__":
        return f"def __hash__(self):\n  return hash(({own}))"
    return (
        f"def {name}(self, other):\n"
        "  if other.__class__ is not self.__class__:\n"
        "    return NotImplemented\n"
        f"  return ({own}) {_COMPARISONS[name]} ({others})"
    )


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
