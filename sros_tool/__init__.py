"""sros: the security toolkit for ROS 2 robots.

The names in ``__all__`` are the public API: they are documented in docs/python.md, and change only
with a new minor version and an entry in CHANGELOG.md.  Everything else in this package may change
at any time.

Example:
    >>> import sros_tool
    >>> keystore = sros_tool.create_keystore("ks", template="production")
    >>> sros_tool.generate(keystore, "policies/talker_listener.xml")
    >>> sros_tool.explain_access(
    ...     keystore, "/talker_listener/talker", "publish", "/chatter"
    ... ).allowed
    True
    >>> sros_tool.check(keystore)
    ()

Importing this module imports no other module: a name is loaded when it is first used.
"""

TYPE_CHECKING = False  # type checkers read it as True; importing typing would take too long here

if TYPE_CHECKING:
    from sros_tool.api import (
        AccessAnswer,
        Keystore,
        check,
        check_requirements,
        create_enclaves,
        create_keystore,
        explain_access,
        export_enclaves,
        fleet_status,
        generate,
        load_template,
        merge_policies,
        new_access,
        open_keystore,
        policy_rights,
        read_policy,
        renew,
        revoke,
    )
    from sros_tool.checks.kind import Finding
    from sros_tool.errors import (
        DocumentError,
        InvalidNameError,
        KeystoreError,
        PolicyError,
        SrosError,
        UsageError,
    )
    from sros_tool.keystore.fleet_status import FleetStatus
    from sros_tool.keystore.lifecycle.change import Changed
    from sros_tool.keystore.lifecycle.create import Creation
    from sros_tool.keystore.lifecycle.revoke import Revocation
    from sros_tool.keystore.template import Template
    from sros_tool.policy.merge import Merged
    from sros_tool.policy.model import Policy
    from sros_tool.policy.rights import Right
    from sros_tool.proof.growth import Growth

__version__ = "0.4.0.dev0"

__all__ = [
    "AccessAnswer",
    "Changed",
    "Creation",
    "DocumentError",
    "Finding",
    "FleetStatus",
    "Growth",
    "InvalidNameError",
    "Keystore",
    "KeystoreError",
    "Merged",
    "Policy",
    "PolicyError",
    "Revocation",
    "Right",
    "SrosError",
    "Template",
    "UsageError",
    "check",
    "check_requirements",
    "create_enclaves",
    "create_keystore",
    "explain_access",
    "export_enclaves",
    "fleet_status",
    "generate",
    "load_template",
    "merge_policies",
    "new_access",
    "open_keystore",
    "policy_rights",
    "read_policy",
    "renew",
    "revoke",
]

_ELSEWHERE = {
    "Changed": "sros_tool.keystore.lifecycle.change",
    "Creation": "sros_tool.keystore.lifecycle.create",
    "Finding": "sros_tool.checks.kind",
    "FleetStatus": "sros_tool.keystore.fleet_status",
    "Growth": "sros_tool.proof.growth",
    "Merged": "sros_tool.policy.merge",
    "Policy": "sros_tool.policy.model",
    "Revocation": "sros_tool.keystore.lifecycle.revoke",
    "Right": "sros_tool.policy.rights",
    "Template": "sros_tool.keystore.template",
    **dict.fromkeys((name for name in __all__ if name.endswith("Error")), "sros_tool.errors"),
}
"""The modules of the public names that `sros_tool.api` does not define."""


if not TYPE_CHECKING:  # with `__getattr__`, type checkers would accept names that do not exist

    def __getattr__(name: str) -> object:
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from importlib import import_module

        value = getattr(import_module(_ELSEWHERE.get(name, "sros_tool.api")), name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
