"""The keystore on disk: making it, adding to it, exporting from it, and looking into it."""

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
