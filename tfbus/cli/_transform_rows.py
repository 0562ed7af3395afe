"""The rows of transforms that ``tfbus query`` prints or writes."""

import json
from collections.abc import Callable, Iterable, Iterator
from itertools import chain, islice
from pathlib import Path
from typing import Any, Literal, NamedTuple

from tfbus.cli._width import terminal_width, wrapped
from tfbus.cli.arguments import UsageError
from tfbus.cli.output import csv_name, csv_writer, format_seconds, say
from tfbus.errors import pip_install

Format = Literal["table", "csv", "json", "tum"]
_BLOCK = 65_536
_STAMP, _NUMBER = 20, 12
"""The widths of a stamp and of a number in a table."""
_NUMBERS = ("x", "y", "z", "qx", "qy", "qz", "qw")


class Row(NamedTuple):
    """A transform at a stamp in ns."""

    target: str
    source: str
    stamp: int
    translation: list[float]
    rotation: list[float]


def print_rows(rows: Iterable[Row], kind: Format, several: bool) -> None:
    """Print rows; with `several`, they are of several pairs of frames, and each line begins with its pair."""
    # With the first row, because a lookup that fails prints nothing.
    rows = iter(rows)
    for first in islice(rows, 1):
        _PRINTERS[kind](chain((first,), rows), several)


def write_parquet(rows: Iterator[Row], path: Path) -> None:
    """Write rows to a Parquet file with the columns target, source, stamp (int64, ns), x, y, z, qx, qy, qz and qw.

    Raises
    ------
    UsageError
        If the file cannot be written, or the extra is missing.
    """
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError:
        raise UsageError(f"--parquet needs a package more: {pip_install('parquet')}") from None
    names = pa.dictionary(pa.int32(), pa.string())
    fields = [("target", names), ("source", names), ("stamp", pa.int64())]
    schema = pa.schema(fields + [(name, pa.float64()) for name in _NUMBERS])
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
    out.writerow((*(("target", "source") if several else ()), "stamp", *_NUMBERS))
    for row in rows:
        pair = (csv_name(row.target), csv_name(row.source)) if several else ()
        out.writerow((*pair, format_seconds(row.stamp), *row.translation, *row.rotation))


def _print_json(rows: Iterator[Row], _: bool) -> None:
    for row in rows:
        print(json.dumps({**row._asdict(), "stamp": format_seconds(row.stamp)}))


def _print_tum(rows: Iterator[Row], _: bool) -> None:
    for row in rows:
        print(format_seconds(row.stamp), *row.translation, *row.rotation)


def _print_table(rows: Iterator[Row], several: bool) -> None:
    """Print a line a row, or two lines where the terminal is too narrow for the numbers of one."""
    width = terminal_width()
    between = "" if width is None or width >= _STAMP + _NUMBER * len(_NUMBERS) else "\n" + " " * (_STAMP - _NUMBER)
    pair = None
    for row in rows:
        if pair != row[:2]:
            if several:
                heading = f"{row.source} in {row.target}"
                print(*([] if pair is None else [""]), *wrapped(heading, width, 2), sep="\n")
            titles = [f"{name:>{_NUMBER}}" for name in ("x [m]", "y [m]", "z [m]", *_NUMBERS[3:])]
            print(f"{'stamp [s]':>{_STAMP}}{''.join(titles[:3])}{between}{''.join(titles[3:])}")
            pair = row[:2]
        values = [_number(value) for value in (*row.translation, *row.rotation)]
        print(f"{format_seconds(row.stamp):>{_STAMP}}{''.join(values[:3])}{between}{''.join(values[3:])}")


def _number(value: float) -> str:
    text = f"{value:z{_NUMBER}.6f}"
    return text if len(text) <= _NUMBER else f" {value:{_NUMBER - 1}.4e}"


_PRINTERS: dict[Format, Callable[[Iterator[Row], bool], None]] = {
    "table": _print_table,
    "csv": _print_csv,
    "json": _print_json,
    "tum": _print_tum,
}
