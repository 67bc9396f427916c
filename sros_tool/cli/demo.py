"""The verb `demo`: show on a real DDS that secured nodes are isolated."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import click
from click.core import ParameterSource

from sros_tool import __version__
from sros_tool.cli.common import (
    PATH,
    advisories_of,
    advisories_option,
    check_output,
    complete_template,
    force_option,
    json_option,
    now,
    print_json,
    secrets,
    verb,
)
from sros_tool.errors import UsageError
from sros_tool.terminal import echo, echo_lines

if TYPE_CHECKING:
    from sros_tool.demo.scenarios.model import Scenario


def _complete_scenario(
    _context: click.Context, _parameter: click.Parameter, incomplete: str
) -> list[str]:
    from sros_tool.demo.scenarios import ALL, SCENARIOS
    from sros_tool.demo.scenarios.on_zenoh import ZENOH_SCENARIOS

    on_zenoh = _context.params.get("backend") == "zenoh"
    chosen = ZENOH_SCENARIOS if on_zenoh else SCENARIOS
    names = [ALL, *(scenario.name for scenario in chosen)]
    return [name for name in names if name.startswith(incomplete)]


@verb("demo")
@click.argument("role", required=False, type=click.Choice(["talker", "listener", "router"]))
@click.option(
    "--backend",
    type=click.Choice(["auto", "rclpy", "cyclone", "zenoh"]),
    default="auto",
    show_default=True,
    help="Middleware of the nodes; auto uses rclpy if its RMW enforces security, else Cyclone DDS; "
    "for a talker or listener without security, auto uses Cyclone DDS if it is installed.",
)
@click.option(
    "--scenario",
    "scenarios",
    multiple=True,
    metavar="NAME",
    shell_complete=_complete_scenario,
    help="Scenario to run: a name from --list, `all`, or your own TOML file (not on Zenoh); "
    "can be repeated.",
)
@click.option("--list", "list_them", is_flag=True, help="List the scenarios.")
@click.option(
    "--only",
    multiple=True,
    metavar="WORD",
    help="Run only rows and attacks with WORD in their name; can be repeated.",
)
@click.option(
    "--keystore",
    type=PATH,
    metavar="KEYSTORE",
    help=(
        "Attack a copy of this keystore (with --scenario attacks); the keystore itself is only "
        "read."
    ),
)
@click.option(
    "--accept-open",
    multiple=True,
    metavar="ROW",
    help="Exit with 0 even if this attack succeeds or cannot be tried in your keystore; "
    "can be repeated.",
)
@click.option(
    "--topic",
    help="ROS topic of talkers and listeners, with std_msgs/msg/String; a listener also counts "
    "the messages of other types.  [default: /chatter]",
)
@click.option(
    "--type",
    "message_type",
    metavar="TYPE",
    help="Type of the talker's messages, such as geometry_msgs/msg/Twist: their fields have "
    "default values. Needs rclpy.",
)
@click.option(
    "--for",
    "duration",
    metavar="DURATION",
    help="Stop the talker, listener or router after DURATION, such as 10s.  [default: at Ctrl-C]",
)
@click.option(
    "--domain",
    type=int,
    default=80,
    show_default=True,
    help="Domain id of the first row; every following row uses the next id.",
)
@click.option(
    "--template",
    default="",
    help="Keystore template: a name or a TOML file.  [default: production]",
    shell_complete=complete_template,
)
@click.option(
    "--network",
    type=click.Choice(["auto", "host"]),
    default="auto",
    show_default=True,
    help="Network of the nodes; auto uses a separate network namespace if the system allows it.",
)
@click.option(
    "--keep",
    type=PATH,
    metavar="DIR",
    help="Keep keystores, reports and logs in DIR.",
)
@click.option(
    "--summary",
    type=PATH,
    metavar="FILE.md",
    help="Write a summary for reviewers, in Markdown.",
)
@click.option(
    "--report",
    type=PATH,
    metavar="FILE.html",
    help="Write all results as one HTML page.",
)
@advisories_option
@force_option
@json_option
@click.pass_context
def demo(
    ctx: click.Context,
    role: str | None,
    backend: str,
    scenarios: tuple[str, ...],
    list_them: bool,
    only: tuple[str, ...],
    keystore: Path | None,
    accept_open: tuple[str, ...],
    topic: str | None,
    message_type: str | None,
    duration: str | None,
    domain: int,
    template: str,
    network: str,
    keep: Path | None,
    summary: Path | None,
    report: Path | None,
    advisories: Path | None,
    force: bool,
    as_json: bool,
) -> None:
    """Show on a real DDS or Zenoh that nodes without permission cannot talk to secured nodes.

    Creates keystores, starts nodes with and without enclaves, and compares expected and observed
    results. The scenario `isolation` takes about 10 s on Cyclone DDS and 20 s on rclpy. The
    scenario `attacks` tries all attacks that sros knows, and repeats each attack without the
    defense that stops it; this takes about 30 s on Cyclone DDS and 60 s on rclpy. On Zenoh
    (--backend zenoh), the demo has scenarios of its own, and runs all of them by default, in about
    25 s. A scenario file of yours and --keystore work only on a DDS.

    With talker, listener or router, run only this node until Ctrl-C (or --for DURATION), with the
    current environment variables, so that you can see who hears whom. The node runs on Cyclone DDS,
    rclpy, or Zenoh, which also needs a router. The node first says whether it is secured. In an
    enclave, this node needs only the right for its topic; the node names in the enclave's policy do
    not matter. A listener reads std_msgs/msg/String, and counts the messages of any other type that
    the topic has. A talker sends std_msgs/msg/String or the type of --type, and reports if no node
    can read this type. Of the options, only --backend, --topic, --type and --for apply.

    Example:
      $ sros demo --topic /camera/image
      Cyclone DDS 0.10.2, topic /camera/image, in a separate network namespace
            what was tried                        expected      observed
      ok    secured talker to secured listener    heard         heard
            secured listener heard 49 of 50 messages of the secured talker ...
      ok    secured talker to unsecured listener  not heard     not heard
            unsecured listener heard 0 of 50 messages of the secured talker ...
      ...
      11 of 11 rows as expected.
      $ sros demo --scenario attacks --keystore ~/robot --summary attacks.md
      $ sros demo --scenario governance
      $ sros demo --scenario all
      $ sros demo --backend zenoh --summary zenoh.md
      $ sros run keystore /talker_listener/talker -- sros demo talker
      talker on Cyclone DDS, topic /chatter, domain 0: secured, in the enclave ...
      ready
      sent   Hello World from /talker_listener/talker: 1

    Exit status: 0 if every row is as expected or was skipped for a stated reason, else 1. A row
    marked "open" shows an attack that is known to succeed, and counts as expected. OPEN marks an
    attack that succeeds because of your own keystore (--keystore), and would fail with narrow
    permissions and the template production: the exit status is 1 unless --accept-open names the
    row. With --keystore, the exit status is 2 if an attack that has to fail could not be tried.
    """
    if role is not None:
        _run_by_hand(ctx, role, backend, topic, message_type, duration)
    if message_type is not None:
        raise UsageError("--type is for `sros demo talker`", "", "Leave it out.")
    if duration is not None:
        raise UsageError("--for is for a talker, listener or router", "", "Leave it out.")
    from sros_tool.demo.program import DemoOptions, run_demo
    from sros_tool.demo.result import demo_table
    from sros_tool.demo.scenarios import choose_scenarios
    from sros_tool.files import replace_file
    from sros_tool.keystore.template import load_template

    if list_them:
        _list(backend, as_json)
        return
    options = DemoOptions(
        scenarios=choose_scenarios(scenarios, on_zenoh=backend == "zenoh"),
        only=only,
        keystore=keystore,
        accept_open=accept_open,
        template=load_template(template) if template else None,
        backend=backend,
        topic=topic,
        domain=domain,
        network=network,
        keep=keep,
        advisories=advisories_of(advisories),
        secrets=secrets(),
    )
    for path in (summary, report):
        if path is not None:  # fail before the demo runs, not after it
            check_output(path, force=force)
    if keep is not None and keep.exists() and not keep.is_dir():
        raise UsageError(f"--keep '{keep}' is not a folder", "It is a file.", "Name a folder.")
    moment = now()
    result = run_demo(options, moment, _progress)
    if report is not None:
        from sros_tool.values import as_plain

        _write_report(report, as_plain(result), keep)
    if summary is not None:
        from sros_tool.demo.result import summary_page

        replace_file(summary, summary_page(result, moment).encode())
    if as_json:
        print_json(result)
    else:
        echo_lines(demo_table(result))
    sys.exit(result.exit_status)


def _run_by_hand(
    ctx: click.Context,
    role: str,
    backend: str,
    topic: str | None,
    message_type: str | None,
    duration: str | None,
) -> NoReturn:
    """Run a node until it is stopped, and end with its exit status."""
    from sros_tool.demo.backend import RCLPY, HandNode, backend_by_hand, run_by_hand
    from sros_tool.demo.nodes import STRING
    from sros_tool.demo.scenarios.model import DEFAULT_TOPIC, Role, check_topic
    from sros_tool.validity import parse_duration

    for parameter in ctx.command.params:
        chosen = ctx.get_parameter_source(parameter.name or "")
        parameters = ("role", "backend", "topic", "message_type", "duration")
        takes = parameter.name in parameters or not parameter.expose_value
        if not takes and chosen is not ParameterSource.DEFAULT:
            option = parameter.opts[0]
            raise UsageError(f"a {role} takes no {option}", "", "Leave it out.")
    if backend == "auto":
        backend = RCLPY if message_type else backend_by_hand(Role(role), os.environ)
    asked = check_topic(DEFAULT_TOPIC if topic is None else topic)
    node = HandNode(Role(role), backend, asked, STRING if message_type is None else message_type)
    sys.exit(run_by_hand(node, echo, None if duration is None else parse_duration(duration)))


def _list(backend: str, as_json: bool) -> None:
    """Print the scenarios of a backend, or of all backends ("auto")."""
    from sros_tool.demo.scenarios import SCENARIOS
    from sros_tool.demo.scenarios.on_zenoh import ZENOH_SCENARIOS

    on_dds = () if backend == "zenoh" else SCENARIOS
    on_zenoh = ZENOH_SCENARIOS if backend in ("auto", "zenoh") else ()
    if as_json:
        from sros_tool.demo.result import ListedScenario, ScenarioList

        listed = [
            ListedScenario(scenario.name, scenario.title, len(scenario.rows), zenoh)
            for scenarios, zenoh in ((on_dds, False), (on_zenoh, True))
            for scenario in scenarios
        ]
        print_json(ScenarioList(listed))
        return
    _echo_scenarios(on_dds)
    if on_dds and on_zenoh:
        echo("")
        echo("with --backend zenoh:")
    _echo_scenarios(on_zenoh)


def _echo_scenarios(scenarios: Sequence[Scenario]) -> None:
    width = max((len(scenario.name) for scenario in scenarios), default=0)
    for scenario in scenarios:
        echo(f"{scenario.name:<{width}}  {len(scenario.rows):>3} rows  {scenario.title}")


def _write_report(report: Path, result: dict[str, Any], keep: Path | None) -> None:
    """Write the HTML page, with the paths of folders on this machine removed."""
    from sros_tool.files import replace_file
    from sros_tool.report.pages import render_demo_page, without_folders

    places = [Path.home(), Path.cwd(), Path(tempfile.gettempdir()), *([keep] if keep else [])]
    folders = [str(place.absolute()) for place in places]
    made = f"made by sros {__version__} on {now():%Y-%m-%d}"
    replace_file(report, render_demo_page(without_folders(result, folders), made).encode())


def _progress(line: str) -> None:
    if sys.stderr.isatty():
        echo(line, err=True)
