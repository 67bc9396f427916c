"""The verb `doctor`: which DDS stacks are here, and which of them enforce security."""

from __future__ import annotations

import os
import sys

import click

from sros_tool.cli.common import json_option, now, print_json


@click.command(
    "doctor",
    epilog="""\b
Example:
  $ sros doctor
  rclpy with rmw_fastrtps_cpp  does not enforce   Fast DDS 2.14.5
      a secured participant fails: RCLError: error creating node: This Fast DDS version
      doesn't have the security libraries
  Cyclone DDS (libddsc)        enforces security  Cyclone DDS 0.10.2
      in an enclave made by sros it created the allowed writer on /chatter, and refused
      writer and reader on /sros_not_allowed: ... Not Allowed By Security
  DDS Security can be enforced here.

Exit status: 1 if nothing here enforces security, or if a finding is an error; else 0.""",
)
@json_option
def doctor(as_json: bool) -> None:
    """Find the DDS stacks and RMWs of this machine that enforce security.

    Each is tried, in a process of its own and in an enclave made for the purpose; a name or a
    version says nothing about how it was built. Also tells what `sros check runtime` finds:
    misspelt ROS_SECURITY_* values, files that are missing, a clock that is off.
    """
    from sros_tool.checks.kind import ERROR, WARNING
    from sros_tool.cli.check import findings_here
    from sros_tool.cli.findings import finding_lines
    from sros_tool.demo.doctor import diagnosis_text, examine

    moment = now()
    diagnosis = examine(moment)
    insecure = {
        stack.rmw: stack.evidence
        for stack in diagnosis.stacks
        if stack.rmw and stack.enforces is False
    }
    findings = findings_here(os.environ, moment, insecure)
    if as_json:
        shown = [each.as_json() for each in findings]
        print_json({**diagnosis.as_json(), "findings": shown})
    else:
        click.echo(diagnosis_text(diagnosis))
        for each in findings:
            if each.severity >= WARNING:
                click.echo("\n".join(("", *finding_lines(each))))
    if not diagnosis.enforces or any(each.severity >= ERROR for each in findings):
        sys.exit(1)
