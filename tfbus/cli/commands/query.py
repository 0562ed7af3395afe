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

from tfbus.cli.commands.info import left_out
from tfbus.cli.domain import UnusableError, say
from tfbus.cli.instants import Instant, Step, seconds
from tfbus.cli.progress import watched
from tfbus.errors import DisconnectedError
from tfbus.recording.load import fill
from tfbus.recording.recording import open_recording
from tfbus.stamps import LATEST, to_seconds
from tfbus.tree.tree import TransformTree

MOST_ROWS = 10_000_000
_AT_ONCE = 4_096
_FIELDS = ("stamp", "x", "y", "z", "qx", "qy", "qz", "qw")


class Row(NamedTuple):
    """A transform at an instant."""

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
    as_csv: Annotated[bool, Parameter(name="--csv", negative="")] = False,
    as_json: Annotated[bool, Parameter(name="--json", negative="")] = False,
) -> None:
    """Print where SOURCE was, seen from TARGET: at an instant, or every so many seconds; or at last.

    Instants are stamps in s, exact to the nanosecond. Translations are in m, rotations unit quaternions x y z w. Where
    the two frames are not connected for a while, there are no lines with --every, and it is said how many.

    Example: tfbus query run.mcap map base_link --every 0.1 --csv

    Parameters
    ----------
    file
        A recording: .mcap, .db3 or .bag, or a folder of ROS 2.
    target
        The frame that is looked from.
    source
        The frame that is looked for.
    at
        The instant; by default the newest one that everything between the two frames reaches.
    every
        From the first instant that everything between the two frames covers to the last one.
    as_csv
        Print comma-separated values with a header.
    as_json
        Print a JSON object on each line.
    """
    if as_csv and as_json:
        raise UnusableError("--csv and --json are two ways to print the same: give one of them")
    if at is not None and every is not None:
        raise UnusableError("--at and --every are two questions: give one of them")
    tree = TransformTree(keep=None)
    problems: Counter[str] = Counter()
    with open_recording(file) as recording:
        if not recording.finished:
            say(f"tfbus: {file} was not finished by its writer: this is what can be read")
        fill(tree, watched(recording.messages(), recording.count, "reading"), problems)
    if problems:
        say(f"tfbus: left out of {file}: {left_out(problems)}")
    rows = _every(tree, target, source, every) if every is not None else _once(tree, target, source, at)
    if as_csv:
        _print_csv(rows)
    elif as_json:
        _print_json(rows, target, source)
    else:
        _print_text(rows)


def _once(tree: TransformTree, target: str, source: str, at: int | None) -> Iterator[Row]:
    found = tree.lookup(target, source, LATEST if at is None else at)
    yield Row(found.stamp, [*found.transform.translation], [*found.transform.rotation])


def _every(tree: TransformTree, target: str, source: str, step: int) -> Iterator[Row]:
    """The transforms over the span that all moving edges between the two frames cover."""
    frames = set(tree.chain(target, source))
    edges = [edge for edge in tree.edges() if not edge.static and {edge.parent, edge.child} <= frames]
    starts = [edge.oldest for edge in edges if edge.oldest is not None]
    ends = [edge.newest for edge in edges if edge.newest is not None]
    if not starts:
        yield from _once(tree, target, source, None)
        return
    start, end = max(starts), min(ends)
    count = (end - start) // step + 1
    if count > MOST_ROWS:
        raise UnusableError(
            f"from {seconds(start)} s to {seconds(end)} s there would be {count:,} lines: give --every more than "
            f"{to_seconds(step):g} s"
        )
    places = range(0, max(0, count), _AT_ONCE)
    missing = 0
    # On a terminal, the lines themselves show how far it is.
    for first in places if sys.stdout.isatty() else watched(places, len(places), "looking up"):
        stamps = start + step * np.arange(first, min(first + _AT_ONCE, count), dtype=np.int64)
        try:
            found = tree.lookup_many(target, source, stamps, out_of_range="nan")
        except DisconnectedError:
            missing += len(stamps)
            continue
        valid = found.valid
        missing += int(np.count_nonzero(~valid))
        parts = (stamps[valid], found.translations[valid], found.rotations[valid])
        yield from map(Row, *(part.tolist() for part in parts))
    if missing >= count:
        # Its error says why.
        yield from _once(tree, target, source, start)
    elif missing:
        say(f"tfbus: {missing:,} of {count:,} instants are left out, the frames are not connected there")


def _print_csv(rows: Iterator[Row]) -> None:
    out = csv.writer(sys.stdout, lineterminator="\n")
    for place, row in enumerate(rows):
        if place == 0:
            out.writerow(_FIELDS)
        out.writerow((seconds(row.stamp), *row.translation, *row.rotation))


def _print_json(rows: Iterator[Row], target: str, source: str) -> None:
    for row in rows:
        facts = {"target": target, "source": source, **row._asdict(), "stamp": seconds(row.stamp)}
        print(json.dumps(facts))


def _print_text(rows: Iterator[Row]) -> None:
    for place, row in enumerate(rows):
        if place == 0:
            print(f"{'stamp [s]':>20}" + "".join(f"{name:>12}" for name in ("x [m]", "y [m]", "z [m]", *_FIELDS[4:])))
        print(f"{seconds(row.stamp):>20}" + "".join(f"{number:z12.6f}" for number in (*row.translation, *row.rotation)))
