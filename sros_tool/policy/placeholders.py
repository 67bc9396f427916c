"""Placeholders in policy names, for names that differ between the robots of a fleet.

``{robot}`` and ``{namespace}`` stand for the name and the ROS namespace of a robot. A name with
``{robots}`` or ``{namespaces}`` stands for several names: a name for each robot.
``{robot:carriers}`` means the robots of the group carriers.

A placeholder must not be at a place where its value could widen a name: a part of a name with a
placeholder must have no wildcard, because ``/r1*`` would also match the names of a robot r10.
"""

from __future__ import annotations

import re
from functools import lru_cache
from typing import NamedTuple

_BRACES = re.compile(r"\{([^{}]*)\}")
_PLACEHOLDER = re.compile(r"(robot|namespace)(s?)(?::([A-Za-z_][A-Za-z0-9_]{0,63}))?", re.ASCII)
_WILDCARDS = frozenset("*?[]!")
_SAMPLES = {"robot": "r", "namespace": "/r"}


class Placeholder(NamedTuple):
    """A placeholder: ``value`` is "robot" or "namespace"; ``group`` is "" for the whole fleet."""

    value: str
    plural: bool = False
    group: str = ""

    def __str__(self) -> str:
        group = f":{self.group}" if self.group else ""
        return f"{{{self.value}{'s' * self.plural}{group}}}"


Parts = tuple[str | Placeholder, ...]
"""A name split into text and placeholders."""


def has_placeholder(text: str) -> bool:
    """Return whether ``text`` contains a brace, which names have only in placeholders."""
    return "{" in text or "}" in text


@lru_cache(maxsize=4096)
def parts_of(text: str) -> Parts:
    """Split a name into text and placeholders.

    Raises:
        ValueError: a brace does not belong to a placeholder, or a placeholder is not allowed in its
            place; the message is a sentence.
    """
    parts: list[str | Placeholder] = []
    end = 0
    for brace in _BRACES.finditer(text):
        kind = _PLACEHOLDER.fullmatch(brace[1])
        if not kind:
            raise ValueError(
                f"{brace[0][:80]!r} is not a placeholder: write {{robot}}, {{namespace}}, "
                "{robots} or {namespaces}, perhaps with a group, such as {robot:carriers}."
            )
        placeholder = Placeholder(kind[1], bool(kind[2]), kind[3] or "")
        if problem := _place_problem(placeholder, text[: brace.start()], text[brace.end() :]):
            raise ValueError(problem)
        parts += [text[end : brace.start()], placeholder]
        end = brace.end()
    parts.append(text[end:])
    kept = tuple(part for part in parts if part != "")
    if any(isinstance(part, str) and has_placeholder(part) for part in kept):
        raise ValueError("It has a brace outside of a placeholder such as {robot}.")
    if len({placeholder.group for placeholder in placeholders_of(kept) if placeholder.plural}) > 1:
        raise ValueError("It names robots of several groups, so it is unclear how to combine them.")
    return kept


def _place_problem(placeholder: Placeholder, before: str, after: str) -> str:
    """Return a sentence on why a placeholder is not allowed between two texts, or ""."""
    around = before.rpartition("/")[2] + after.partition("/")[0]
    in_set = before.rfind("[") > before.rfind("]")
    if in_set or not _WILDCARDS.isdisjoint(around):
        return (
            f"A wildcard is in the same part as {placeholder}, where it would also match names of "
            f"other robots: /r1* matches /r10. Put a '/' between them, as in {placeholder}/*."
        )
    if placeholder.value == "namespace" and (before.endswith("/") or after[:1] not in ("", "/")):
        return (
            f"{placeholder} begins with '/' and is a whole namespace: write no '/' directly "
            f"before it; if text follows, it has to begin with '/', as in {placeholder}/scan."
        )
    return ""


def placeholders_of(parts: Parts) -> tuple[Placeholder, ...]:
    """Return the placeholders of a name, in order."""
    return tuple(part for part in parts if isinstance(part, Placeholder))


def sample(parts: Parts) -> str:
    """Return the name with the shortest possible values for placeholders, to check the grammar."""
    return "".join(part if isinstance(part, str) else _SAMPLES[part.value] for part in parts)


def check_path(path: Parts) -> None:
    """Check that an enclave path stands for one enclave, or for one enclave of each robot.

    Raises:
        ValueError: the path stands for something else; the message is a sentence.
    """
    path_placeholders = placeholders_of(path)
    if plural := next((part for part in path_placeholders if part.plural), None):
        singular = plural._replace(plural=False)
        raise ValueError(
            f"{plural} names all robots, but a path names one enclave: write {singular}."
        )
    if len({part.group for part in path_placeholders}) > 1:
        raise ValueError("Its placeholders are of different groups.")


def check_name(name: Parts, path: Parts, *, several: bool) -> None:
    """Check that all placeholders of a name have a value in the name's enclave.

    Args:
        name: the name.
        path: the path of the enclave that states the name; `check_path` has accepted this path.
        several: whether the name may stand for several names, one for each robot.

    Raises:
        ValueError: a placeholder has no value; the message is a sentence.
    """
    of_path = placeholders_of(path)
    for placeholder in placeholders_of(name):
        if placeholder.plural:
            if not several:
                raise ValueError(
                    f"{placeholder} stands for several names, but only one can be here."
                )
        elif not of_path:
            suggestion = f" For the names of all robots, write {placeholder._replace(plural=True)}."
            raise ValueError(
                f"{placeholder} stands for one robot, but the enclave's path does not say which "
                f"one.{suggestion if several else ''}"
            )
        elif placeholder.group not in ("", of_path[0].group):
            only = str(placeholder._replace(value="robot"))
            raise ValueError(
                f"{placeholder} stands for a robot of a group, and the path of this enclave is not "
                "for this group alone: leave out the group, or write another enclave for the "
                f"group, with {only} in its path."
            )


def fill(parts: Parts, robot: str, namespace: str, *, plural: bool = False) -> Parts:
    """Fill in the singular placeholders of a name, or with ``plural``, the plural placeholders."""
    values = {"robot": robot, "namespace": namespace}
    if namespace == "/" and len(parts) > 1:
        values["namespace"] = ""  # in the root namespace, {namespace}/scan is /scan
    return tuple(
        values[part.value] if isinstance(part, Placeholder) and part.plural is plural else part
        for part in parts
    )
