"""The keystore on disk: making it, adding to it, exporting from it, and looking into it.

The functions are imported when they are first used: listing enclaves needs no cryptography.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sros_tool.keystore.create import (
        Result,
        create_enclaves,
        create_keystore,
        create_permission,
        generate_artifacts,
        list_enclaves,
    )

__all__ = [
    "Result",
    "create_enclaves",
    "create_keystore",
    "create_permission",
    "generate_artifacts",
    "list_enclaves",
]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from sros_tool.keystore import create

    return getattr(create, name)
