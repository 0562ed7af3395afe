"""``tfbus query``."""

import csv
import json
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
from cyclopts import Parameter

from tfbus.cli.arguments import Instant, JsonFlag, Step, UsageError
from tfbus.cli.output import format_counts, format_seconds, track, warn
from tfbus.errors import DisconnectedError
from tfbus.recording.load import fill
from tfbus.recording.recording import open_recording
from tfbus.stamps import LATEST, to_seconds
from tfbus.tree.tree import TransformTree

MAX_ROWS = 10_000_000
_CHUNK = 4_096
_FIELDS = ("stamp", "x", "y", "z", "qx", "qy", "qz", "qw")


class Row(NamedTuple):
    """A transform at a stamp in ns."""

    stamp: int
    translation: list[float]
    rotation: list[float]


def query(
    file: Path,
    target: str,
    source: str,
    /,
    *,
    at: Instant | None = None,
    every: Step | None = None,
    as_csv: Annotated[bool, Parameter(name="--csv", negative="", show_default=False)] = False,
    as_json: JsonFlag = False,
) -> None:
    """Print the transform of SOURCE in TARGET from a recording: the newest, at an instant, or at regular intervals.

    Instants are stamps in s, exact to the nanosecond. Translations are in m, rotations are unit quaternions x y z w.
    With --every, instants at which the two frames are not connected are left out, and standard error says how many.

    Example: tfbus query run.mcap map base_link --every 0.1 --csv

    Parameters
    ----------
    file
        A recording: .mcap, .db3 or .bag, or a folder of ROS 2.
    target
        The frame in which the transform is expressed.
    source
        The frame whose position and orientation are printed.
    at
        The instant; by default the newest one for which all frames between the two have data.
    every
        The interval; the first and the last instant are those for which all frames between the two have data.
    as_csv
        Print comma-separated values with a header.
    as_json
        Print one JSON object a line.
    """
    if as_csv and as_json:
        raise UsageError("--csv and --json are two ways to print the same: give one of them")
    if at is not None and every is not None:
        raise UsageError("--at and --every are two questions: give one of them")
    tree = load_tree(file)
    rows = _rows_at_intervals(tree, target, source, every) if every is not None else _one_row(tree, target, source, at)
    if as_csv:
        _print_csv(rows)
    elif as_json:
        _print_json(rows, target, source)
    else:
        _print_table(rows)


def load_tree(file: Path) -> TransformTree:
    """A whole recording as a tree, with warnings about what is not in it."""
    tree = TransformTree(keep=None)
    problems: Counter[str] = Counter()
    with open_recording(file) as recording:
        if not recording.finished:
            warn(f"{file} was not finished by its writer: this is what can be read")
        fill(tree, track(recording.messages(), recording.count, "reading"), problems)
    if problems:
        warn(f"left out of {file}: {format_counts(problems)}")
    return tree


def _one_row(tree: TransformTree, target: str, source: str, at: int | None) -> Iterator[Row]:
    """The transform at a stamp, or the newest one."""
    found = tree.lookup(target, source, LATEST if at is None else at)
    yield Row(found.stamp, [*found.transform.translation], [*found.transform.rotation])


def _rows_at_intervals(tree: TransformTree, target: str, source: str, step: int) -> Iterator[Row]:
    """The transforms every `step` ns over the span that all moving edges between the two frames cover."""
    frames = set(tree.chain(target, source))
    edges = [edge for edge in tree.edges() if not edge.static and {edge.parent, edge.child} <= frames]
    starts = [edge.oldest for edge in edges if edge.oldest is not None]
    ends = [edge.newest for edge in edges if edge.newest is not None]
    if not starts:
        yield from _one_row(tree, target, source, None)
        return
    start, end = max(starts), min(ends)
    count = max(0, (end - start) // step + 1)
    if count > MAX_ROWS:
        raise UsageError(
            f"from {format_seconds(start)} s to {format_seconds(end)} s there would be {count:,} lines: "
            f"give --every more than {to_seconds(step):g} s"
        )
    chunks = range(0, count, _CHUNK)
    missing = 0
    # On a terminal, the rows themselves show the progress.
    for first in chunks if sys.stdout.isatty() else track(chunks, len(chunks), "looking up"):
        stamps = start + step * np.arange(first, min(first + _CHUNK, count), dtype=np.int64)
        try:
            found = tree.lookup_many(target, source, stamps, out_of_range="nan")
        except DisconnectedError:
            missing += len(stamps)
            continue
        valid = found.valid
        missing += int(np.count_nonzero(~valid))
        columns = (stamps[valid], found.translations[valid], found.rotations[valid])
        yield from map(Row, *(column.tolist() for column in columns))
    if missing == count:
        # This lookup raises the error that says why.
        yield from _one_row(tree, target, source, start)
    elif missing > 0:
        warn(f"{missing:,} of {count:,} instants are left out, the frames are not connected there")


def _print_csv(rows: Iterator[Row]) -> None:
    out = csv.writer(sys.stdout, lineterminator="\n")
    # With the first row, because a lookup that fails prints nothing.
    for number, row in enumerate(rows):
        if number == 0:
            out.writerow(_FIELDS)
        out.writerow((format_seconds(row.stamp), *row.translation, *row.rotation))


def _print_json(rows: Iterator[Row], target: str, source: str) -> None:
    for row in rows:
        print(json.dumps({"target": target, "source": source, **row._asdict(), "stamp": format_seconds(row.stamp)}))


def _print_table(rows: Iterator[Row]) -> None:
    for number, row in enumerate(rows):
        if number == 0:
            print(f"{'stamp [s]':>20}" + "".join(f"{name:>12}" for name in ("x [m]", "y [m]", "z [m]", *_FIELDS[4:])))
        values = "".join(f"{value:z12.6f}" for value in (*row.translation, *row.rotation))
        print(f"{format_seconds(row.stamp):>20}{values}")
