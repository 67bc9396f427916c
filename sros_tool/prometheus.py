"""Metrics in the Prometheus text format, for node_exporter's textfile collector.

Source: Prometheus, "Exposition formats", text format 0.0.4.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from sros_tool.values import DryRun, FileChange, NamedKeystore, Notes

_NAME = re.compile(r"[a-z][a-z0-9_]*\Z", re.ASCII)


@dataclass(frozen=True, slots=True)
class Sample:
    """A value with its labels; a label's value may be any text."""

    value: int | float
    """The value; moments are in seconds since 1970."""
    labels: Mapping[str, str] = field(default_factory=dict)
    """Label values by label name, such as ``keystore``."""


@dataclass(frozen=True, slots=True)
class Metric:
    """A Prometheus gauge with its help text and its samples.

    Raises:
        ValueError: a name has other characters than lower-case letters, digits and ``_``.
    """

    name: str
    """The name of the metric."""
    help: str
    """The help text of the metric."""
    samples: tuple[Sample, ...]
    """The values of the metric, one for each set of labels."""

    def __post_init__(self) -> None:
        for name in (self.name, *(label for sample in self.samples for label in sample.labels)):
            if not _NAME.match(name) or name.startswith("__"):
                raise ValueError(f"{name!r} is not a valid name in Prometheus")


class KeystoreMetrics(NamedTuple):
    """The metrics of a keystore. ``-o FILE`` also writes the metrics to a file, as text."""

    keystore: NamedKeystore
    metrics: Sequence[Metric]
    """The metrics; all are gauges."""
    dry_run: DryRun
    changes: Sequence[FileChange]
    """The file that was written or, with ``--dry-run``, would be; empty without ``-o``."""
    notes: Notes


def render_metrics(metrics: Iterable[Metric]) -> str:
    """Return metrics as text with help and type; metrics without samples are left out.

    Labels can hold names of files.  Characters that cannot be printed, and bytes that are not
    UTF-8, become visible escapes, because readers refuse the whole text for a single such byte.
    For the same reason a series that was given already is left out.
    """
    lines: list[str] = []
    for metric in metrics:
        series: dict[str, int | float] = {}
        for sample in metric.samples:
            series.setdefault(_series_text(metric.name, sample.labels), sample.value)
        if not series:
            continue
        lines += [f"# HELP {metric.name} {_escaped(metric.help)}", f"# TYPE {metric.name} gauge"]
        lines += [f"{name} {value}" for name, value in series.items()]
    return "".join(f"{line}\n" for line in lines)


def _series_text(name: str, labels: Mapping[str, str]) -> str:
    pairs = ",".join(f'{label}="{_quoted(value)}"' for label, value in labels.items())
    return f"{name}{{{pairs}}}" if pairs else name


def _quoted(value: str) -> str:
    return _escaped(value).replace('"', '\\"')


def _escaped(text: str) -> str:
    shown = "".join(
        character if character.isprintable() else _visible(character) for character in text
    )
    return shown.replace("\\", "\\\\")


def _visible(character: str) -> str:
    code = ord(character)
    if 0xDC80 <= code <= 0xDCFF:  # a byte of a file's name that is not UTF-8
        return f"\\x{code - 0xDC00:02x}"
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}"
