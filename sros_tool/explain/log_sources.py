"""The keystore or the policy in which the enclaves, peers and nodes of a log are looked up."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

from sros_tool.errors import SrosError
from sros_tool.keystore.known_keys import enclaves_by_identity
from sros_tool.keystore.layout import ROUTER_FILE
from sros_tool.keystore.lifecycle.rotation import RotationStage, read_rotation
from sros_tool.keystore.participant import LoadedEnclave
from sros_tool.keystore.reader import OpenedKeystore
from sros_tool.keystore.rights import RightsSource, load_rights
from sros_tool.keystore.selection import likely_names as likely_enclaves
from sros_tool.names import is_expression, nodes_served
from sros_tool.pki.certificates import IDENTITY_DIGITS
from sros_tool.policy.model import (
    ALLOW,
    PEER_RIGHT,
    Enclave,
    Policy,
    below_namespace,
    policy_in_namespace,
)
from sros_tool.policy.patterns import Names
from sros_tool.policy.rights import Right, placed_rights, policy_rights


class SearchedKeystore:
    """An index of the enclaves of a keystore, by peers and nodes that a log names."""

    def __init__(self, keystore: OpenedKeystore) -> None:
        self._keystore = keystore

    def enclave_of_peer(self, guid: str) -> str:
        """Return the enclave of the participant with a GUID, as a vendor prints the GUID, or ""."""
        identity = guid.replace(".", "")
        if ":" in guid:
            identity = "".join(word.zfill(8) for word in guid.split(":"))
        return self._by_identity.get(identity[:IDENTITY_DIGITS], "")

    def enclaves_meant(self, enclave: str) -> tuple[str, ...]:
        """Return the enclaves that a name may mean; () if the keystore has the enclave."""
        names = self._keystore.names
        return () if enclave in names else likely_enclaves(enclave, names)

    def enclaves_for(self, node: str) -> tuple[str, ...]:
        """Return the enclaves whose permissions are only for the node with this full name."""
        return self._by_node.get(node, ())

    def has_other_side(self, right: Right) -> bool | None:
        """Return whether an enclave states, by exact name, the right that peers of ``right`` need.

        Returns None if permissions cannot be read, so that this is not known, or if an enclave has
        the right only by a wildcard. In an export, the enclave with the right may be missing (see
        `kind`).
        """
        exact, expressions = self._allowed_names[PEER_RIGHT[right.right]]
        if right.name in exact:
            return True
        with suppress(SrosError):  # too many wildcards to compare
            if self._rights and self._rights.sound and not expressions.cover(right.name):
                return False
        return None

    @cached_property
    def zenoh_routers(self) -> frozenset[str]:
        """The enclaves of Zenoh routers.

        These are the routers listed in the keystore's Zenoh settings (without such settings: the
        default router), and the enclaves with a router file.
        """
        from sros_tool.zenoh.configuration import ZenohNetwork  # most logs do not come from Zenoh

        network = None
        with suppress(SrosError):  # `sros check` reports the error
            network = settings.zenoh if (settings := self._keystore.settings) else None
        names = set((network or ZenohNetwork()).router_names())
        for name in self._keystore.names:
            if (self._keystore.folder(name) / ROUTER_FILE).exists():
                names.add(name)
        return frozenset(names)

    @cached_property
    def is_reissuing(self) -> bool:
        """Whether a CA rotation is in the stage after which all files are from the new CAs."""
        try:
            return read_rotation(self._keystore).stage is RotationStage.REISSUE
        except SrosError:
            return False

    @cached_property
    def _by_identity(self) -> Mapping[str, str]:
        return enclaves_by_identity(self._keystore)

    @cached_property
    def _rights(self) -> RightsSource | None:
        with suppress(SrosError):  # without readable documents, the rights are unknown
            return load_rights(self._keystore)
        return None

    @property
    def kind(self) -> str:
        """The kind of the source: "keystore", or "export" if enclaves may be missing."""
        is_whole = self._rights is not None and self._rights.scope is None
        return "keystore" if is_whole else "export"

    @cached_property
    def _allowed_names(self) -> Mapping[str, tuple[frozenset[str], Names]]:
        """Map each right to the exact names, and the wildcards, for which enclaves have it."""
        names: dict[str, set[str]] = {right: set() for right in PEER_RIGHT}
        for right in self._rights.rights if self._rights else ():
            if right.qualifier is ALLOW and right.right in names:
                names[right.right].add(right.name)
        return {
            right: (frozenset(stated), Names(filter(is_expression, stated)))
            for right, stated in names.items()
        }

    @cached_property
    def _by_node(self) -> Mapping[str, tuple[str, ...]]:
        enclaves_by_node: dict[str, set[str]] = {}
        for right in self._rights.rights if self._rights else ():
            if right.qualifier is ALLOW:
                for node in nodes_served([(right.right, right.name)]):
                    enclaves_by_node.setdefault(node, set()).add(right.enclave)
        return {node: tuple(sorted(enclaves)) for node, enclaves in enclaves_by_node.items()}


@dataclass(frozen=True, slots=True)
class AskedPolicy:
    """The policy by which sros explains a log.

    The robot that wrote the log may use the policy in a namespace.
    ``file`` is the path of the policy, and ``name`` the enclave that the user named, or "".
    """

    file: str
    policy: Policy
    name: str

    def namespace_and_path(self, enclave: str) -> tuple[str, str]:
        """Return the namespace of the policy on the robot, and an enclave's path in the policy.

        ``enclave`` is the path on the robot.  The path in the policy is "" if no enclave fits.
        """
        paths = [stated.path for stated in self.policy.enclaves]
        if enclave in paths:
            return "", enclave
        fitting = [path for path in paths if path != "/" and enclave.endswith(path)]
        path = self.name if self.name in fitting else max(fitting, key=len, default="")
        return enclave.removesuffix(path) if path else "", path

    def likely_namespace(self, denied: Right) -> str:
        """Return the namespace in which the policy's relative names give a denied right, or "".

        The result is also "" if the log states the namespace.
        """
        space, path = self.namespace_and_path(denied.enclave)
        stated = self.policy.enclave(path) if path and not space else None
        for placed in placed_rights(stated) if stated else ():
            own = placed.right
            is_relative = not placed.written.startswith(("/", "*"))
            allows = own.qualifier is ALLOW and own.right == denied.right and is_relative
            if allows and denied.name.endswith(own.name):
                return denied.name.removesuffix(own.name)
        return ""

    def possible_namespace(self, name: str, enclave: str) -> str:
        """Return the namespace of a name that may be a relative name on the robot, or "".

        The result is also "" if the policy itself has a name in this namespace.  The node's own
        name is no part of the namespace of its private names.
        """
        space = name.rpartition("/")[0]
        stated = self.policy.enclave(self.namespace_and_path(enclave)[1])
        for profile in stated.all_profiles() if stated else ():
            space = space.removesuffix(f"/{profile.node}")
        names = {right.name for right in policy_rights(self.policy)}
        return "" if any(name.startswith(f"{space}/") for name in names) else space

    def private_name(self, name: str, space: str, enclave: str) -> str:
        """Return a name on the robot as ``~/NAME`` if a node of the enclave has it, or "".

        ``space`` is the namespace of the policy on the robot.
        """
        stated = self.policy.enclave(self.namespace_and_path(enclave)[1])
        for profile in stated.all_profiles() if stated else ():
            own = below_namespace(profile.full_name, space)
            if name.startswith(f"{own}/"):
                return f"~{name.removeprefix(own)}"
        return ""

    def enclaves_for(self, node: str, enclave: str) -> tuple[str, ...]:
        """Return the enclaves, under their paths on the robot, that the policy has for a node.

        ``enclave`` is the path on the robot of the enclave in which the node runs.
        """
        robot_ns = self.namespace_and_path(enclave)[0]
        if not node.startswith(f"{robot_ns}/"):
            return ()
        ns, _, name = node.removeprefix(robot_ns).rpartition("/")
        fitting = self.policy.enclaves_of_node(ns, name)
        return tuple(below_namespace(stated.path, robot_ns) for stated in fitting)

    def enclave(self, enclave: str) -> Enclave | None:
        """Return the policy's enclave, under its path on the robot; None if the policy lacks it."""
        ns, path = self.namespace_and_path(enclave)
        stated = self.policy.enclave(path) if path else None
        if stated is None:
            return None
        alone = replace(self.policy, enclaves=(stated,))  # the log may name many enclaves
        return policy_in_namespace(alone, ns).enclave(enclave)


FindEnclave = Callable[[str], LoadedEnclave | None]
"""Function that returns an enclave by name ("": the enclave that the user named), or None."""
