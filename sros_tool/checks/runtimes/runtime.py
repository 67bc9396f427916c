"""All checks of the runtime."""

from __future__ import annotations

from sros_tool.checks.keystores.keystore import joined
from sros_tool.checks.kind import Finding
from sros_tool.checks.runtimes.host import check_host
from sros_tool.checks.runtimes.setting import Setting
from sros_tool.checks.runtimes.variables import check_variables


def runtime_findings(setting: Setting) -> list[Finding]:
    """Everything that is found in an environment and on its host."""
    return joined([*check_variables(setting), *check_host(setting)])
