"""``tfbus info``."""

import json
import sys
from collections.abc import Iterable
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from tfbus.cli.arguments import JsonFlag
from tfbus.cli.output import format_counts, format_seconds, printable, track
from tfbus.recording.recording import open_recording
from tfbus.recording.summary import FrameSummary, RecordingSummary, summarise
from tfbus.stamps import SECOND, format_duration, from_seconds


def info(file: Path, /, *, as_json: JsonFlag = False) -> None:
    """Print the contents of a recording: its frames with their parents, rates, gaps, authorities and errors.

    Example: tfbus info run.mcap

    Parameters
    ----------
    file
        A recording: .mcap, .db3 or .bag, or a folder of ROS 2.
    as_json
        Print a JSON object instead of a table, with times in s and instants as text with all digits.
    """
    with open_recording(file) as recording:
        summary = summarise(recording, track(recording.messages(), recording.count, "reading"))
    if as_json:
        print(json.dumps(_to_json(summary), indent=2))
    else:
        _print_table(summary)


def _to_json(summary: RecordingSummary) -> dict[str, Any]:
    return {
        **asdict(summary),
        "path": str(summary.path),
        "start": _format_instant(summary.start),
        "end": _format_instant(summary.end),
        "duration": summary.duration,
        "frames": [
            {
                **asdict(frame),
                "kind": frame.kind,
                "oldest": _format_instant(frame.oldest),
                "newest": _format_instant(frame.newest),
                "span": frame.span,
            }
            for frame in summary.frames
        ],
    }


def _format_instant(stamp: int | None) -> str | None:
    return None if stamp is None else format_seconds(stamp)


def _print_table(summary: RecordingSummary) -> None:
    from rich.console import Console
    from rich.table import Table

    for line in _heading(summary):
        print(line)
    if not summary.frames:
        return
    print()
    table = Table(box=None, pad_edge=False, header_style="")
    numeric = ("samples", "rate", "span", "longest gap")
    for column in ("frame", "parent", "kind", *numeric, "authority"):
        table.add_column(column, justify="right" if column in numeric else "left", overflow="fold")
    for frame in summary.frames:
        table.add_row(*_row(frame))
    # Frame names are no markup; and rows are not wrapped where a program reads them.
    width = None if sys.stdout.isatty() else 10_000
    console = Console(markup=False, emoji=False, highlight=False, width=width)
    # Rich would end the program by itself if the reader has closed the pipe.
    with console.capture() as drawn:
        console.print(table)
    for line in drawn.get().splitlines():
        print(line.rstrip())


def _heading(summary: RecordingSummary) -> list[str]:
    lines = [printable(f"{summary.path}") + ("" if summary.finished else ", not finished by its writer")]
    if summary.start is not None and summary.end is not None:
        lines.append(f"start     {format_seconds(summary.start)} s{_format_date(summary.start)}")
        lines.append(f"end       {format_seconds(summary.end)} s{_format_date(summary.end)}")
        lines.append(f"duration  {format_seconds(summary.end - summary.start)} s")
    below = f", below {_join_names(summary.roots)}" if summary.roots else ""
    lines.append(f"contents  {summary.transforms:,} transforms in {summary.messages:,} messages")
    lines.append(f"frames    {len(summary.frames):,}{below}")
    if summary.problems:
        lines.append(f"left out  {format_counts(summary.problems)}")
    return lines


def _format_date(stamp: int) -> str:
    try:
        return f"  {datetime.fromtimestamp(stamp // SECOND, UTC):%Y-%m-%d %H:%M:%S} UTC"
    except (ValueError, OverflowError):
        return ""


def _row(frame: FrameSummary) -> tuple[str, ...]:
    return (
        printable(frame.frame),
        _join_names(frame.parents),
        "static, moving" if frame.kind == "both" else frame.kind,
        f"{frame.static + frame.moving:,}",
        "" if frame.rate is None else f"{frame.rate:.1f} Hz",
        "" if frame.span is None else format_duration(from_seconds(frame.span)),
        "" if frame.longest_gap is None else format_duration(from_seconds(frame.longest_gap)),
        _join_names(frame.authorities),
    )


def _join_names(names: Iterable[str]) -> str:
    return ", ".join(map(printable, names))
