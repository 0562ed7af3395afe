"""``tfbus query``."""

import json
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain, islice
from pathlib import Path
from typing import Any, Literal, NamedTuple

from tfbus.cli.arguments import (
    CsvFlag,
    Flag,
    Instant,
    JsonFlag,
    Positive,
    Step,
    UsageError,
)
from tfbus.cli.lazy_imports import lazy_imports
from tfbus.cli.output import csv_name, csv_writer, say, terminal_width, track, warn, wrapped
from tfbus.cli.recordings import DEFAULT_TOPICS, TopicOptions, load_tree

with lazy_imports():
    import numpy as np
    import numpy.typing as npt

    from tfbus.errors import DisconnectedError, pip_install
    from tfbus.geometry.transform_array import COLUMN_NAMES
    from tfbus.recording.formats import trajectories
    from tfbus.recording.header_stamps import header_stamps
    from tfbus.rows import Quaternion, Vector
    from tfbus.stamps import LATEST, format_seconds, to_seconds
    from tfbus.tree.tree import TransformTree, moving_edges

MAX_ROWS = 10_000_000
_CHUNK = 4_096
Format = Literal["table", "csv", "json", "tum", "kitti", "euroc"]
_TRAJECTORIES: tuple[Format, ...] = ("tum", "kitti", "euroc")
_BLOCK = 65_536
_STAMP, _NUMBER = 20, 12
"""The widths of a stamp and of a number in a table."""


class Row(NamedTuple):
    """A transform at a stamp in ns."""

    target: str
    source: str
    stamp: int
    translation: Vector
    rotation: Quaternion
    sigmas: tuple[float, ...] = ()
    """The standard deviations of the error, in the order of `SIGMA_NAMES`, if they were asked for."""


SIGMA_NAMES = ("sigma_x_m", "sigma_y_m", "sigma_z_m", "sigma_roll", "sigma_pitch", "sigma_yaw")


def query(
    file: Path,
    target: str,
    source: str,
    /,
    *further: str,
    at: Instant | None = None,
    every: Step | None = None,
    stamps_of: str | None = None,
    own_stamps: Flag = False,
    as_csv: CsvFlag = False,
    as_json: JsonFlag = False,
    tum: Flag = False,
    kitti: Flag = False,
    euroc: Flag = False,
    parquet: Path | None = None,
    sigmas: Flag = False,
    max_speed: Positive | None = None,
    topics: TopicOptions = DEFAULT_TOPICS,
) -> None:
    """Print the transform of SOURCE in TARGET from a recording: the newest, at an instant, or at many.

    Instants are exact to the nanosecond. Translations are in m, rotations are unit quaternions x y z w. With --every,
    --own-stamps and --stamps-of, instants without an answer are left out, and standard error says how many.

    Example: tfbus query run.mcap map base_link --every 0.1 --csv

    Parameters
    ----------
    file
        A recording: .mcap, .db3 or .bag, a folder of ROS 2, or a trajectory of TUM, KITTI or EuRoC.
    target
        The frame in which the transform is expressed.
    source
        The frame whose position and orientation are printed.
    further
        More pairs of TARGET and SOURCE.
    at
        The instant, by default the newest one for which all frames between the two have data: seconds from the
        beginning of the recording, such as 12.5; a stamp in seconds, such as 1396293888.05; or a date, such as
        2014-03-31T19:24:50.
    every
        The interval in s; the first and the last instant are those for which all frames between the two have data.
    stamps_of
        Take the instants from the headers of the messages on this topic.
    own_stamps
        Take the instants at which the frame between the two with the most samples was recorded.
    as_csv
        Print comma-separated values with a header; stamps in ns, the names as in a data frame of TransformArray.
    as_json
        Print one JSON object a line.
    tum
        Print lines of stamp x y z qx qy qz qw, the format of TUM's trajectories.
    kitti
        Print the upper three rows of each matrix, the format of KITTI's trajectories, which has no stamps.
    euroc
        Print lines of stamp,x,y,z,qw,qx,qy,qz, the format of EuRoC's trajectories, with stamps in ns.
    parquet
        Write a Parquet file instead.
    sigmas
        Add the standard deviations of the error, in m and rad, as --odometry brings them. Edges without any count as
        exact, and standard error names them.
    max_speed
        Leave out transforms that a frame can only have reached at a higher speed than this, in m/s.
    """
    pairs = _pairs(target, source, further)
    given: dict[Format, bool] = {"csv": as_csv, "json": as_json, "tum": tum, "kitti": kitti, "euroc": euroc}
    kinds = [kind for kind, wanted in given.items() if wanted]
    if len(kinds) + (parquet is not None) > 1:
        ways = ", ".join(f"--{name}" for name in given)
        raise UsageError(f"{ways} and --parquet are ways to write the same: give one of them")
    if sum(each is not None for each in (at, every, stamps_of)) + own_stamps > 1:
        raise UsageError("--at, --every, --own-stamps and --stamps-of are different questions: give one of them")
    if kinds and kinds[0] in _TRAJECTORIES and len(pairs) > 1:
        raise UsageError(f"--{kinds[0]} has no names of frames: ask for one pair")
    if sigmas and (parquet is not None or (kinds and kinds[0] in _TRAJECTORIES)):
        raise UsageError("--sigmas is for tables, --csv and --json: no other format has a place for them")
    tree, start = load_tree(file, topics, max_speed)
    stamps = None if stamps_of is None else _stamps_of(file, stamps_of)

    def rows() -> Iterator[Row]:
        for pair in pairs:
            if own_stamps and len(own := tree.stamps(*pair)):
                found = _rows_at(tree, *pair, own)
            elif every is not None:
                found = _rows_at_intervals(tree, *pair, every)
            elif stamps is not None:
                found = _rows_at(tree, *pair, stamps)
            else:
                found = _one_row(tree, *pair, None if at is None else at.stamp(start))
            yield from _with_sigmas(tree, pair, found) if sigmas else found

    if parquet is not None:
        write_parquet(rows(), parquet)
    else:
        print_rows(rows(), kinds[0] if kinds else "table", several=len(pairs) > 1)


def _with_sigmas(tree: TransformTree, pair: tuple[str, str], rows: Iterator[Row]) -> Iterator[Row]:
    """The rows with the standard deviations of their errors."""
    exact: dict[tuple[str, str], None] = {}
    while part := list(islice(rows, _CHUNK)):
        found = tree.lookup_many(*pair, [row.stamp for row in part], covariance=True)
        exact |= dict.fromkeys(found.exact)
        deviations = np.sqrt(np.maximum(found.covariances.diagonal(axis1=1, axis2=2), 0.0)).tolist()
        for row, sigmas in zip(part, deviations, strict=True):
            yield row._replace(sigmas=tuple(sigmas))
    if exact:
        names = ", ".join(f"{parent} -> {child}" for parent, child in exact)
        warn(f"no covariance, and taken as exact: {names}")


def _pairs(target: str, source: str, further: Sequence[str]) -> list[tuple[str, str]]:
    if len(further) % 2:
        raise UsageError(f"frames come in pairs of TARGET and SOURCE, and {further[-1]!r} has no SOURCE")
    return [(target, source), *zip(further[::2], further[1::2], strict=True)]


def _stamps_of(file: Path, topic: str) -> npt.NDArray[np.int64]:
    found = header_stamps(file, topic)
    if not found.from_headers:
        warn(f"the messages on {topic} have no headers: their log times are used")
    if found.unreadable:
        messages = "1 message" if found.unreadable == 1 else f"{found.unreadable:,} messages"
        warn(f"{messages} on {topic} cannot be read")
    return found.stamps


def _one_row(tree: TransformTree, target: str, source: str, at: int | None) -> Iterator[Row]:
    """The transform at a stamp, or the newest one."""
    found = tree.lookup(target, source, LATEST if at is None else at)
    yield Row(target, source, found.stamp, found.transform.translation, found.transform.rotation)


def _rows_at_intervals(tree: TransformTree, target: str, source: str, step: int) -> Iterator[Row]:
    """The transforms every `step` ns over the span that all moving edges between the two frames cover."""
    edges = moving_edges(tree, target, source)
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
    yield from _rows_at(tree, target, source, start + step * np.arange(count, dtype=np.int64), start)


def _rows_at(
    tree: TransformTree, target: str, source: str, stamps: npt.NDArray[np.int64], fallback: int | None = None
) -> Iterator[Row]:
    """The transforms at some stamps; without a single answer, the error at the first of them, or at `fallback`."""
    count = len(stamps)
    chunks = range(0, count, _CHUNK)
    missing = 0
    # On a terminal, the rows themselves show the progress.
    for first in chunks if sys.stdout.isatty() else track(chunks, len(chunks), "looking up"):
        part = stamps[first : first + _CHUNK]
        try:
            found = tree.lookup_many(target, source, part, out_of_range="nan")
        except DisconnectedError:
            missing += len(part)
            continue
        valid = found.valid
        missing += int(np.count_nonzero(~valid))
        columns = (part[valid], found.translations[valid], found.rotations[valid])
        for stamp, translation, rotation in zip(*(column.tolist() for column in columns), strict=True):
            yield Row(target, source, stamp, tuple(translation), tuple(rotation))
    if missing == count:
        # This lookup raises the error that says why.
        yield from _one_row(tree, target, source, int(stamps[0]) if fallback is None else fallback)
    elif missing > 0:
        warn(f"{missing:,} of {count:,} instants are left out, the frames are not connected there")


def print_rows(rows: Iterable[Row], kind: Format, several: bool) -> None:
    """Print rows; with `several`, they are of several pairs of frames, and each line begins with its pair."""
    # With the first row, because a lookup that fails prints nothing.
    rows = iter(rows)
    for first in islice(rows, 1):
        _PRINTERS[kind](chain((first,), rows), several)


def write_parquet(rows: Iterator[Row], path: Path) -> None:
    """Write rows to a Parquet file with the columns target, source, stamp_ns, and those of `COLUMN_NAMES`.

    Raises
    ------
    UsageError
        If the file cannot be written, or the extra is missing.
    """
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError:
        raise UsageError(f"--parquet needs one more package: {pip_install('parquet')}") from None
    names = pa.dictionary(pa.int32(), pa.string())
    fields = [("target", names), ("source", names), ("stamp_ns", pa.int64())]
    schema = pa.schema(fields + [(name, pa.float64()) for name in COLUMN_NAMES])
    # A lookup that fails writes nothing.
    rows = iter(rows)
    first = list(islice(rows, _BLOCK))
    count = 0
    try:
        with parquet.ParquetWriter(path, schema) as writer:
            block = first
            while block:
                columns: list[Any] = [
                    pa.array([row.target for row in block]).dictionary_encode(),
                    pa.array([row.source for row in block]).dictionary_encode(),
                    pa.array([row.stamp for row in block], pa.int64()),
                    *(pa.array([row.translation[at] for row in block]) for at in range(3)),
                    *(pa.array([row.rotation[at] for row in block]) for at in range(4)),
                ]
                writer.write_table(pa.Table.from_arrays(columns, schema=schema))
                count += len(block)
                block = list(islice(rows, _BLOCK))
    except OSError as error:
        raise UsageError(f"cannot write {path}: {error.strerror or error}") from None
    say(f"{count:,} rows in {path}")


def _print_csv(rows: Iterator[Row], several: bool) -> None:
    out = csv_writer()
    for first in islice(rows, 1):
        names = SIGMA_NAMES if first.sigmas else ()
        out.writerow((*(("target", "source") if several else ()), "stamp_ns", *COLUMN_NAMES, *names))
        for row in chain((first,), rows):
            pair = (csv_name(row.target), csv_name(row.source)) if several else ()
            out.writerow((*pair, row.stamp, *row.translation, *row.rotation, *row.sigmas))


def _print_json(rows: Iterator[Row], _: bool) -> None:
    for row in rows:
        fields = {**row._asdict(), "stamp": format_seconds(row.stamp)}
        if not row.sigmas:
            del fields["sigmas"]
        print(json.dumps(fields))


def _print_trajectory(name: Format) -> Callable[[Iterator[Row], bool], None]:
    def print_lines(rows: Iterator[Row], _: bool) -> None:
        kind = (trajectories.TUM, trajectories.KITTI, trajectories.EUROC)[_TRAJECTORIES.index(name)]
        for line in trajectories.lines_of(((row.stamp, (*row.translation, *row.rotation)) for row in rows), kind):
            print(line)

    return print_lines


def _print_table(rows: Iterator[Row], several: bool) -> None:
    """Print a line a row, or two lines where the terminal is too narrow for the numbers of one."""
    width = terminal_width()
    between = "" if width is None or width >= _STAMP + _NUMBER * len(COLUMN_NAMES) else "\n" + " " * (_STAMP - _NUMBER)
    pair = None
    for row in rows:
        if pair != row[:2]:
            if several:
                heading = f"{row.source} in {row.target}"
                print(*([] if pair is None else [""]), *wrapped(heading, width, 2), sep="\n")
            titles = [f"{name:>{_NUMBER}}" for name in ("x [m]", "y [m]", "z [m]", *COLUMN_NAMES[3:])]
            titles += [f"{name.removeprefix('sigma_'):>{_NUMBER - 2}} ±" for name in SIGMA_NAMES[: len(row.sigmas)]]
            print(f"{'stamp [s]':>{_STAMP}}{''.join(titles[:3])}{between}{''.join(titles[3:])}")
            pair = row[:2]
        values = [_number(value) for value in (*row.translation, *row.rotation, *row.sigmas)]
        print(f"{format_seconds(row.stamp):>{_STAMP}}{''.join(values[:3])}{between}{''.join(values[3:])}")


def _number(value: float) -> str:
    text = f"{value:z{_NUMBER}.6f}"
    return text if len(text) <= _NUMBER else f" {value:{_NUMBER - 1}.4e}"


_PRINTERS: dict[Format, Callable[[Iterator[Row], bool], None]] = {
    "table": _print_table,
    "csv": _print_csv,
    "json": _print_json,
    **{name: _print_trajectory(name) for name in _TRAJECTORIES},
}
