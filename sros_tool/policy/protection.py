"""The protection of messages in ROS terms: by domain, topic, service and action."""

from __future__ import annotations

from enum import StrEnum

from sros_tool.dataclass import dataclass
from sros_tool.names import expand


class Level(StrEnum):
    """The strength of a protection; the long forms also prove which writer a message came from."""

    NONE = "NONE"
    SIGN = "SIGN"
    ENCRYPT = "ENCRYPT"
    SIGN_WITH_ORIGIN_AUTHENTICATION = "SIGN_WITH_ORIGIN_AUTHENTICATION"
    ENCRYPT_WITH_ORIGIN_AUTHENTICATION = "ENCRYPT_WITH_ORIGIN_AUTHENTICATION"


PROTECT: dict[str, Level] = {"sign": Level.SIGN, "encrypt": Level.ENCRYPT}
"""The levels that a policy can demand of a name, by their words in it."""


@dataclass(frozen=True, slots=True)
class TopicProtection:
    """The protection of a topic: its payload, its submessages, and its access control."""

    data: Level = Level.ENCRYPT
    metadata: Level = Level.ENCRYPT
    read_access_control: bool = True
    write_access_control: bool = True
    discovery: bool = True
    liveliness: bool = True


@dataclass(frozen=True, slots=True)
class NamedProtection:
    """The protection of the topics, services or actions (``kind``) that match a name."""

    kind: str
    name: str
    protection: TopicProtection

    def __str__(self) -> str:
        """Return kind and absolute name, as in "topic /camera/*"."""
        return f"{self.kind.removesuffix('s')} {expand(self.name, '/', '')}"


@dataclass(frozen=True, slots=True)
class DomainProtection:
    """The protection of a domain and of single names in it; ``default`` applies to other names."""

    rtps: Level = Level.SIGN
    discovery: Level = Level.ENCRYPT
    liveliness: Level = Level.ENCRYPT
    allow_unauthenticated_participants: bool = False
    join_access_control: bool = True
    default: TopicProtection = TopicProtection()
    named: tuple[NamedProtection, ...] = ()
