"""``tfbus info``."""

import json
from collections.abc import Iterable
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from tfbus.cli.arguments import Flag, JsonFlag
from tfbus.cli.lazy_imports import lazy_imports
from tfbus.cli.output import (
    Column,
    format_counts,
    format_span,
    progress,
    table_lines,
    terminal_width,
    wrapped,
)
from tfbus.cli.recordings import DEFAULT_TOPICS, TopicOptions

with lazy_imports():
    from tfbus.recording.recording import RecordedTopic
    from tfbus.recording.summary import FrameSummary, RecordingSummary, SenderSummary, Spread, summarise
    from tfbus.stamps import SECOND, format_seconds

_SPREADS = tuple(
    Column(f"{what} {value}", right=True) for what in ("period", "delay") for value in ("mean", "p99", "max")
)
# The least important column has the lowest number: the mean period only repeats the rate.
_IMPORTANCE = (1, 2, 4, 3, 5, 6)
_TIMES = tuple(column._replace(importance=importance) for column, importance in zip(_SPREADS, _IMPORTANCE, strict=True))
_INDENT = 10
"""The column at which the facts of the heading begin."""
_FRAMES = (
    Column("frame"),
    Column("parent"),
    Column("kind", importance=5),
    Column("samples", right=True, importance=3),
    Column("rate", right=True, importance=6),
    Column("span", right=True, importance=1),
    Column("longest gap", right=True, importance=2),
    Column("authority", importance=4),
)
_SENDERS = (Column("sender"), Column("frames", right=True, importance=7), Column("samples", right=True, importance=8))
_TOPICS = (Column("topic"), Column("type", importance=1), Column("messages", right=True, importance=2), Column("read"))


def info(
    file: Path, /, *, as_json: JsonFlag = False, wide: Flag = False, topics: TopicOptions = DEFAULT_TOPICS
) -> None:
    """Print the contents of a recording: its topics, its frames with parents, rates, gaps and delays, and its senders.

    A period is the time between two stamps; a delay is the time from a stamp to the log time. The tables show the mean,
    the 99th percentile and the maximum of each. Columns that do not fit the terminal are left out.

    Example: tfbus info run.mcap

    Parameters
    ----------
    file
        A recording: .mcap, .db3 or .bag, a folder of ROS 2, or a trajectory of TUM, KITTI or EuRoC.
    as_json
        Print a JSON object instead of tables, with times in s and instants as text with all digits.
    wide
        Print all columns, however long the lines are.
    """
    with topics.open(file) as recording, progress(recording.count, "reading") as advance:
        summary = summarise(recording, progress=advance)
    if as_json:
        print(json.dumps(_to_json(summary), indent=2))
        return
    width = None if wide else terminal_width()
    for line in _heading(summary):
        print("\n".join(wrapped(line, width, _INDENT)))
    frames = [_frame_row(frame) for frame in summary.frames]
    timed = [frame for frame in summary.frames if frame.moving]
    times = [(frame.frame, *_times(frame.period, frame.delay)) for frame in timed]
    senders = [_sender_row(sender) for sender in summary.senders]
    tables = (
        (_FRAMES, frames),
        ((_FRAMES[0], *_TIMES), times),
        ((*_SENDERS, *_TIMES), senders),
        (_TOPICS, [_topic_row(topic) for topic in summary.topics]),
    )
    for columns, rows in tables:
        if rows:
            print()
            for line in table_lines(columns, rows, width):
                print(line)


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


def _heading(summary: RecordingSummary) -> list[str]:
    lines = [f"{summary.path}" + ("" if summary.finished else ", cut or not finished by its writer")]
    if summary.start is not None and summary.end is not None:
        lines.append(f"start     {format_seconds(summary.start)} s{_format_date(summary.start)}")
        lines.append(f"end       {format_seconds(summary.end)} s{_format_date(summary.end)}")
        lines.append(f"duration  {format_seconds(summary.end - summary.start)} s")
    below = f", below {_join_names(summary.roots)}" if summary.roots else ""
    lines.append(f"contents  {summary.transforms:,} transforms in {summary.messages:,} messages")
    lines.append(f"frames    {len(summary.frames):,}{below}")
    if summary.problems:
        lines.append(f"left out  {format_counts(summary.problems)}")
    lines += [f"          {detail}" for detail in summary.details]
    lines += [f"note      {remark}" for remark in summary.remarks]
    return lines


def _format_date(stamp: int) -> str:
    try:
        return f"  {datetime.fromtimestamp(stamp // SECOND, UTC):%Y-%m-%d %H:%M:%S} UTC"
    except (ValueError, OverflowError):
        return ""


def _frame_row(frame: FrameSummary) -> tuple[str, ...]:
    return (
        frame.frame,
        _join_names(frame.parents),
        "static, moving" if frame.kind == "both" else frame.kind,
        f"{frame.static + frame.moving:,}",
        "" if frame.rate is None else f"{frame.rate:.1f} Hz",
        format_span(frame.span),
        format_span(frame.longest_gap),
        _join_names(frame.authorities),
    )


def _sender_row(sender: SenderSummary) -> tuple[str, ...]:
    name = sender.authority or "(unknown)"
    count = sender.static + sender.moving
    return name, f"{len(sender.frames):,}", f"{count:,}", *_times(sender.period, sender.delay)


def _topic_row(topic: RecordedTopic) -> tuple[str, ...]:
    count = "" if topic.count is None else f"{topic.count:,}"
    read = "yes" if topic.read else "no, it may hold transforms" if topic.ignored else "no"
    return topic.name, topic.type, count, read


def _times(*spreads: Spread | None) -> list[str]:
    return [
        format_span(value)
        for spread in spreads
        for value in ((None, None, None) if spread is None else (spread.mean, spread.p99, spread.max))
    ]


def _join_names(names: Iterable[str]) -> str:
    return ", ".join(names)
