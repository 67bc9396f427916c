"""The verb `demo`: show on a real DDS what security keeps apart."""

from __future__ import annotations

import json
import sys
from datetime import UTC, datetime
from pathlib import Path

import click


@click.command("demo")
@click.option(
    "--backend",
    type=click.Choice(["auto", "rclpy", "cyclone"]),
    default="auto",
    show_default=True,
    help="What the nodes run on; auto takes rclpy where its RMW enforces security.",
)
@click.option("--topic", default="/chatter", show_default=True, help="ROS topic to talk on.")
@click.option(
    "--domain",
    type=int,
    default=80,
    show_default=True,
    help="First domain id; each row takes one.",
)
@click.option(
    "--template",
    default="production",
    show_default=True,
    help="Keystore template: a name or a TOML file.",
)
@click.option(
    "--network",
    type=click.Choice(["auto", "host"]),
    default="auto",
    show_default=True,
    help="auto takes a network namespace of its own where the system allows it.",
)
@click.option(
    "--keep",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help="Leave keystores, reports and logs in DIR.",
)
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
def demo(
    backend: str,
    topic: str,
    domain: int,
    template: str,
    network: str,
    keep: Path | None,
    as_json: bool,
) -> None:
    """Show on a real DDS that secured nodes are among themselves."""
    from sros_tool.demo.program import DemoOptions, run_demo
    from sros_tool.demo.table import demo_table
    from sros_tool.keystore.template import load_template

    options = DemoOptions(
        template=load_template(template),
        backend=backend,
        topic=topic,
        domain=domain,
        network=network,
        keep=keep,
    )
    result = run_demo(options, datetime.now(UTC), _progress)
    text = json.dumps(result.as_json(), indent=2) if as_json else demo_table(result)
    click.echo(text)
    if not result.as_expected:
        sys.exit(1)


def _progress(line: str) -> None:
    if sys.stderr.isatty():
        click.echo(line, err=True)
