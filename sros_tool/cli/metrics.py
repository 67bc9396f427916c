"""The verb `metrics`: what Prometheus is told of a keystore."""

from __future__ import annotations

import os
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import click

from sros_tool.cli.common import (
    PATH,
    check_output,
    dry_run_option,
    fleet_option,
    json_option,
    keystore_from_environment,
    local_zone,
    now,
    output_option,
    policy_for,
    print_json,
    save,
)
from sros_tool.cli.progress import progress
from sros_tool.errors import UsageError
from sros_tool.terminal import echo, echo_document
from sros_tool.values import file_change

if TYPE_CHECKING:
    from sros_tool.prometheus import Metric

_SUFFIX = ".prom"
"""The only suffix of files that the textfile collector of node_exporter reads."""


@click.command(
    "metrics",
    epilog="""\b
Example:
  $ sros metrics keystore -o /var/lib/prometheus/node-exporter/sros.prom
  $ sros metrics keystore | grep earliest
  sros_earliest_expiry_timestamp_seconds{keystore="/home/robot/keystore",...

The exit status is 0 whatever is found. If the keystore cannot be examined it is
2 and FILE stays as it is: alert also on an old sros_examined_timestamp_seconds.""",
)
@click.argument("root", metavar="[ROOT]", type=PATH, required=False)
@output_option("Replace FILE at once, which ends in .prom, instead of printing.")
@click.option(
    "--earliest", is_flag=True, help="Leave out the files of single enclaves, for large keystores."
)
@click.option(
    "--policy",
    "policies",
    type=PATH,
    multiple=True,
    metavar="FILE",
    help="Also count where the keystore differs from this policy.  Can be repeated.",
)
@fleet_option("The robots that the placeholders of the policies stand for.")
@click.option(
    "--runtime", is_flag=True, help="Also count the running processes, by what they run with."
)
@dry_run_option
@json_option
def metrics(
    root: Path | None,
    output: Path | None,
    earliest: bool,
    policies: tuple[Path, ...],
    fleet_file: Path | None,
    runtime: bool,
    dry_run: bool,
    as_json: bool,
) -> None:
    """Give Prometheus the expiry of all files of a keystore, and its number of findings.

    ROOT is a keystore, or an export on a robot. The text is for the textfile collector of
    node_exporter.
    """
    from sros_tool.checks.keystores.keystore import keystore_findings
    from sros_tool.checks.keystores.metrics import keystore_metrics
    from sros_tool.keystore.reader import Keystore
    from sros_tool.prometheus import KeystoreMetrics, render_metrics

    root, moment = root or keystore_from_environment(), now()
    if output:
        check_suffix(output)
        check_output(output, force=True)
    if fleet_file and not policies:
        raise UsageError("--fleet is for the placeholders of a policy: add --policy FILE")
    wanted = tuple(policy_for(policy, fleet_file) for policy in policies)
    with progress("examining"):
        keystore = Keystore(root)
        findings = keystore_findings(
            keystore, now=moment, zone=local_zone(os.environ), policies=wanted
        )
        gauges = keystore_metrics(keystore, findings, now=moment, each_enclave=not earliest)
        gauges += _of_processes(moment) if runtime else ()
    text = render_metrics(gauges)
    changes = file_change(output, existed=output.exists()) if output else ()
    saved = save(output, text.encode()) if output and not dry_run else ""
    if as_json:
        print_json(KeystoreMetrics(root, gauges, dry_run, changes, ()))
    elif dry_run:
        echo(f"would write {output or 'to standard output'}: {len(text)} characters")
    elif output:
        echo(saved, err=True)
    else:
        echo_document(text)


def _of_processes(moment: datetime) -> tuple[Metric, ...]:
    from sros_tool.checks.processes import runtime_metrics
    from sros_tool.runtime.processes import ProcessTable

    running = ProcessTable().look(moment)
    return runtime_metrics(os.environ, running, now=moment, zone=local_zone(os.environ))


def check_suffix(output: Path) -> None:
    """Raise `UsageError` for a file that node_exporter would not read."""
    if output.suffix != _SUFFIX and (output.is_file() or not output.exists()):
        raise UsageError(
            f"'{output}' does not end in {_SUFFIX}",
            "node_exporter would not read it.",
            f"Name it for example '{output.with_suffix(_SUFFIX)}'.",
        )
