"""``tfbus info``."""

import json
import sys
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from tfbus.cli.instants import seconds
from tfbus.cli.printable import printable
from tfbus.cli.progress import watched
from tfbus.recording.recording import open_recording
from tfbus.recording.summary import FrameSummary, RecordingSummary, summarise
from tfbus.stamps import SECOND, format_duration, from_seconds


def info(file: Path, /, *, as_json: Annotated[bool, Parameter(name="--json", negative="")] = False) -> None:
    """Print what there is in a recording: its frames with their parents, rates, gaps and senders, and what is wrong.

    Example: tfbus info run.mcap

    Parameters
    ----------
    file
        A recording: .mcap, .db3 or .bag, or a folder of ROS 2.
    as_json
        Print a JSON object instead of a table: times in s, instants as text with all their digits.
    """
    with open_recording(file) as recording:
        summary = summarise(recording, watched(recording.messages(), recording.count, "reading"))
    if as_json:
        print(json.dumps(_as_data(summary), indent=2))
    else:
        _print_table(summary)


def left_out(problems: Mapping[str, int]) -> str:
    """What is wrong with a recording, in one line; empty if nothing is."""
    return ", ".join(f"{count:,} x {reason}" for reason, count in problems.items())


def _as_data(summary: RecordingSummary) -> dict[str, Any]:
    return {
        **asdict(summary),
        "path": str(summary.path),
        "start": _text(summary.start),
        "end": _text(summary.end),
        "duration": summary.duration,
        "frames": [
            {
                **asdict(frame),
                "kind": frame.kind,
                "oldest": _text(frame.oldest),
                "newest": _text(frame.newest),
                "span": frame.span,
            }
            for frame in summary.frames
        ],
    }


def _text(stamp: int | None) -> str | None:
    return None if stamp is None else seconds(stamp)


def _print_table(summary: RecordingSummary) -> None:
    from rich.console import Console
    from rich.table import Table

    for line in _head(summary):
        print(line)
    if not summary.frames:
        return
    print()
    table = Table(box=None, pad_edge=False, header_style="")
    right = ("samples", "rate", "span", "longest gap")
    for column in ("frame", "parent", "kind", *right, "authority"):
        table.add_column(column, justify="right" if column in right else "left", overflow="fold")
    for frame in summary.frames:
        table.add_row(*_row(frame))
    # Names are shown as they are; and nobody wants lines that are broken where a program reads them.
    width = None if sys.stdout.isatty() else 10_000
    console = Console(markup=False, emoji=False, highlight=False, width=width)
    # Rich would end the process itself if nobody reads the lines any more.
    with console.capture() as text:
        console.print(table)
    for line in text.get().splitlines():
        print(line.rstrip())


def _head(summary: RecordingSummary) -> list[str]:
    lines = [printable(f"{summary.path}") + ("" if summary.finished else ", not finished by its writer")]
    if summary.start is not None and summary.end is not None:
        lines.append(f"start     {seconds(summary.start)} s{_date(summary.start)}")
        lines.append(f"end       {seconds(summary.end)} s{_date(summary.end)}")
        lines.append(f"duration  {seconds(summary.end - summary.start)} s")
    below = f", below {_names(summary.roots)}" if summary.roots else ""
    lines.append(f"contents  {summary.transforms:,} transforms in {summary.messages:,} messages")
    lines.append(f"frames    {len(summary.frames):,}{below}")
    if summary.problems:
        lines.append(f"left out  {left_out(summary.problems)}")
    return lines


def _date(stamp: int) -> str:
    try:
        return f"  {datetime.fromtimestamp(stamp // SECOND, UTC):%Y-%m-%d %H:%M:%S} UTC"
    except (ValueError, OverflowError):
        return ""


def _row(frame: FrameSummary) -> tuple[str, ...]:
    return (
        printable(frame.frame),
        _names(frame.parents),
        "static, moving" if frame.kind == "both" else frame.kind,
        f"{frame.static + frame.moving:,}",
        "" if frame.rate is None else f"{frame.rate:.1f} Hz",
        "" if frame.span is None else format_duration(from_seconds(frame.span)),
        "" if frame.longest_gap is None else format_duration(from_seconds(frame.longest_gap)),
        _names(frame.authorities),
    )


def _names(names: Iterable[str]) -> str:
    return ", ".join(map(printable, names))
