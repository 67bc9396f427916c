"""What the enclaves of a policy say about the protection of names."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Annotated

from sros_tool.names import expand
from sros_tool.policy.model import RIGHTS, Enclave, Source
from sros_tool.policy.protection import Level
from sros_tool.values import Words, shows


@shows("enclave", "kind", "name", "level")
@dataclass(frozen=True, slots=True)
class StatedProtection:
    """The least protection of the topics, services or actions (``kind``) that match a name.

    ``name`` is absolute; ``enclave`` and ``source`` are where a policy says it.
    """

    enclave: str
    """The enclave that says it."""
    kind: Annotated[str, Words(RIGHTS)]
    """The kind of the name."""
    name: str
    """The absolute ROS name, perhaps with wildcards."""
    level: Level
    """The least protection of its messages."""
    source: Source = field(compare=False)

    def __str__(self) -> str:
        """Return kind and name, as in "topic /camera/*"."""
        return f"{self.kind.removesuffix('s')} {self.name}"

    @property
    def word(self) -> str:
        """The level as a policy writes it."""
        return self.level.lower()


def stated_protections(enclaves: Iterable[Enclave]) -> tuple[StatedProtection, ...]:
    """Return what enclaves say about the protection of names, in order.

    What an enclave says several times is returned once, with the first place.
    """
    found: dict[StatedProtection, None] = {}
    for enclave in enclaves:
        for profile in enclave.all_profiles():
            for group in profile.groups:
                if group.protect is None:
                    continue
                for index, written in enumerate(group.names):
                    name, source = expand(written, profile.ns, profile.node), group.source_of(index)
                    each = StatedProtection(enclave.path, group.kind, name, group.protect, source)
                    found.setdefault(each)
    return tuple(found)
