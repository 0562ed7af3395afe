"""Trajectories as lines of text, in the formats of the TUM, KITTI and EuRoC benchmarks: reading and writing.

* TUM: ``stamp x y z qx qy qz qw``, the stamp in s.
* KITTI: the upper three rows of a homogeneous matrix, twelve numbers. It has no stamps: they are the lines of a file
  ``times.txt`` beside it, in s, or else the poses are 0.1 s apart, as KITTI's are.
* EuRoC: ``stamp,x,y,z,qw,qx,qy,qz``, the stamp in ns; further columns are not read.

Lines that begin with ``#`` are comments. The formats have no names of frames: a file is a recording of ``base_link`` in
``map``, one message for each pose. `TrajectoryStorage` writes these messages in CDR, so all readers of recordings read
trajectories as well. A line that is no pose is lost, and the report has its number.
"""

import math
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple

import numpy as np

from tfbus.errors import InvalidTransformError, RecordingError
from tfbus.geometry.transform import Transform
from tfbus.recording.formats.copies import CannotWriteError
from tfbus.recording.formats.covariances import holds_covariances
from tfbus.recording.formats.storage import (
    Channel,
    Packed,
    Stored,
    StoredMessage,
    Wanted,
    in_order,
    lost_message,
)
from tfbus.recording.formats.transforms import RawTransform, holds_transforms, parser_of, write_cdr
from tfbus.rows import NORM_TOLERANCE, Row
from tfbus.stamps import SECOND, STAMP_MAX, STAMP_MIN, format_seconds

PARENT: Final = "map"
CHILD: Final = "base_link"
MAX_LINE: Final = 4_096
"""The length in bytes of a line; the file is not read behind a longer one."""
MAX_POSES: Final = 5_000_000
_SHOWN: Final = 60
_BLOCK: Final = 2**16
"""The number of poses that are decoded at once."""
_MOST_NAMES: Final = 5
_MOST_REPORTS: Final = 1_000
"""The number of wrong lines that are reported one by one."""
_KITTI_PERIOD: Final = SECOND // 10
_LIMIT: Final = 2**31 * SECOND
"""The seconds of a stamp of a message have 32 bits."""


class Format(NamedTuple):
    """A format of lines with one pose each."""

    name: str
    expected: str
    """The line that is expected, in words."""
    read: Callable[[list[bytes]], tuple[int | None, Iterable[float]]]
    """The stamp in ns, if there is one, and x, y, z, qx, qy, qz, qw of the fields of a line; raises `ValueError`."""
    header: str
    write: Callable[[int, Row], str]
    """The line of a stamp in ns and a transform."""


def stamp_of(text: bytes) -> int:
    """The stamp in ns of a decimal number of seconds, exact to the ns; raises `ValueError`."""
    try:
        seconds = Decimal(text.decode("ascii"))
        if abs(seconds) < 2**31:
            return int((seconds * SECOND).to_integral_value())
    except InvalidOperation:
        pass
    raise ValueError(f"{text[:_SHOWN]!r} is no stamp")


def _read_tum(fields: list[bytes]) -> tuple[int | None, Iterable[float]]:
    stamp, x, y, z, qx, qy, qz, qw = fields
    return stamp_of(stamp), map(float, (x, y, z, qx, qy, qz, qw))


def _write_tum(stamp: int, row: Row) -> str:
    return " ".join((format_seconds(stamp), *map(repr, row)))


def _read_kitti(fields: list[bytes]) -> tuple[int | None, Iterable[float]]:
    matrix = np.eye(4)
    matrix[:3] = np.array(list(map(float, fields))).reshape(3, 4)
    pose = Transform.from_matrix(matrix)
    return None, (*pose.translation, *pose.rotation)


def _write_kitti(_: int, row: Row) -> str:
    matrix = Transform(row[:3], row[3:]).matrix()
    return " ".join(map(repr, matrix[:3].ravel().tolist()))


def _read_euroc(fields: list[bytes]) -> tuple[int | None, Iterable[float]]:
    stamp, x, y, z, qw, qx, qy, qz, *_ = fields
    return int(stamp), map(float, (x, y, z, qx, qy, qz, qw))


def _write_euroc(stamp: int, row: Row) -> str:
    x, y, z, qx, qy, qz, qw = map(repr, row)
    return ",".join((str(stamp), x, y, z, qw, qx, qy, qz))


TUM: Final = Format("TUM", "stamp x y z qx qy qz qw, a unit quaternion", _read_tum, "", _write_tum)
KITTI: Final = Format("KITTI", "the 12 numbers of a matrix with a rotation", _read_kitti, "", _write_kitti)
EUROC: Final = Format(
    "EuRoC",
    "stamp,x,y,z,qw,qx,qy,qz, the stamp in ns, a unit quaternion",
    _read_euroc,
    "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []",
    _write_euroc,
)
FORMATS: Final[Mapping[str, Format]] = {".tum": TUM, ".kitti": KITTI, ".euroc": EUROC}
"""By the ending of a file that is written."""


def lines_of(rows: Iterable[tuple[int, Row]], kind: Format) -> Iterator[str]:
    """The lines of a file, from stamps in ns and transforms."""
    if kind.header:
        yield kind.header
    for stamp, row in rows:
        yield kind.write(stamp, row)


def is_text(first: bytes) -> bool:
    """Whether a file that begins with these bytes can be a trajectory: its first field is a number, or a comment."""
    line = first.lstrip()
    field = line.replace(b",", b" ").split(maxsplit=1)[:1]
    try:
        return line.startswith(b"#") or bool(field and float(field[0]) == float(field[0]))
    except ValueError:
        return False


def _fields(line: bytes) -> list[bytes]:
    return line.split(b",") if b"," in line else line.split()


def _format_of(line: bytes) -> Format | None:
    """The format of the first line that is no comment."""
    count = len(_fields(line))
    if b"," in line:
        return EUROC if count >= 8 else None
    return {8: TUM, 12: KITTI}.get(count)


class TrajectoryStorage:
    """A `Storage` of a trajectory.

    Parameters
    ----------
    path : Path

    Raises
    ------
    RecordingError
        If the first line is no pose.
    """

    finished: Final = True
    complete: Final = True

    def __init__(self, path: Path) -> None:
        self._lost: list[StoredMessage] = []
        self.remarks: tuple[str, ...] = ()
        with path.open("rb") as file:
            kind, stamps, rows = self._read(file, path)
        if kind is KITTI:
            stamps = self._kitti_stamps(path, len(stamps))
        order = np.argsort(stamps, kind="stable")
        self._messages = _packed(stamps[order], rows[order])
        received = self._messages.received
        self.start = int(received[0]) if len(received) else None
        self.end = int(received[-1]) if len(received) else None
        self.channels: Mapping[Channel, int | None] = {self._messages.channels[0]: len(received)}

    def messages(self, wanted: Wanted, since: int | None = None, until: int | None = None) -> Iterator[StoredMessage]:
        """Iterate over the poses from one log time, which is their stamp, to another, inclusive."""
        for block in self.packed(wanted, since, until):
            yield from block.stored() if isinstance(block, Packed) else block

    def packed(self, wanted: Wanted, since: int | None = None, until: int | None = None) -> Iterator[Stored]:
        """The messages of `messages`, many at once."""
        messages = self._messages
        if wanted(messages.channels[0]):
            low, high = STAMP_MIN if since is None else since, STAMP_MAX if until is None else until
            for first in range(0, messages.size, _BLOCK):
                part = np.arange(first, min(first + _BLOCK, messages.size))
                yield from in_order(messages.chosen(part), low, high)
            if since is None and until is None and self._lost:
                yield self._lost

    def close(self) -> None:
        """Nothing: the file is closed already."""

    def _lose(self, why: str) -> None:
        self._lost.append(lost_message(0, why))

    def _read(self, file: BinaryIO, path: Path) -> tuple[Format, Any, Any]:
        """The format, the stamps in ns, and the transforms, shape (n, 7)."""
        kind: Format | None = None
        stamps, values = array("q"), array("d")
        wrong = 0
        for number, line in enumerate(iter(lambda: file.readline(MAX_LINE + 1), b""), 1):
            if len(line) > MAX_LINE or len(stamps) == MAX_POSES:
                most = f"a line has at most {MAX_LINE:,} bytes, and a file {MAX_POSES:,} poses"
                self._lose(f"line {number}: it is not read from here on: {most}")
                break
            line = line.strip()
            if not line or line.startswith(b"#"):
                continue
            kind = kind or _format_of(line)
            if kind is None:
                formats = "; ".join(f"{each.name}: {each.expected}" for each in FORMATS.values())
                problem = f"line {number} is no pose, expected a line of {formats}; got {_shown(line)}"
                raise RecordingError(problem, path=str(path), reason="foreign")
            try:
                stamp, row = kind.read(_fields(line))
                stamp = 0 if stamp is None else stamp
                x, y, z, qx, qy, qz, qw = row
                # NaN is neither.
                if not (x - x == y - y == z - z == 0.0) or not (
                    abs(math.sqrt(qx * qx + qy * qy + qz * qz + qw * qw) - 1.0) <= NORM_TOLERANCE
                ):
                    raise ValueError
                if not -_LIMIT <= stamp < _LIMIT:
                    raise ValueError
            except (ValueError, InvalidTransformError):
                wrong += 1
                if wrong <= _MOST_REPORTS:
                    self._lose(f"line {number}: expected {kind.expected}; got {_shown(line)}")
                continue
            stamps.append(stamp)
            values.extend((x, y, z, qx, qy, qz, qw))
        if wrong > _MOST_REPORTS:
            self._lose(f"{wrong - _MOST_REPORTS:,} more lines are no poses")
        if kind is None:
            raise RecordingError("there is no line but comments", path=str(path), reason="empty")
        return kind, np.array(stamps, np.int64), np.array(values).reshape(-1, 7)

    def _kitti_stamps(self, path: Path, count: int) -> Any:
        """The stamps of KITTI's poses, in ns."""
        times = path.with_name("times.txt")
        try:
            with times.open("rb") as file:
                lines = file.read((MAX_POSES + 1) * 32).split()
            stamps = np.array([stamp_of(line) for line in lines], np.int64)
            if len(stamps) == count:
                return stamps
            self.remarks = (f"times.txt is ignored: it has {len(stamps):,} stamps, and there are {count:,} poses",)
        except FileNotFoundError:
            self.remarks = ("poses of KITTI have no stamps, and there is no times.txt: they are taken 0.1 s apart",)
        except (OSError, ValueError) as error:
            self.remarks = (f"times.txt is ignored: {error}",)
        return np.arange(count, dtype=np.int64) * _KITTI_PERIOD


def _text(name: bytes) -> str:
    return name.decode(errors="replace")


def _shown(line: bytes) -> str:
    text = _text(line)
    return repr(text if len(text) <= _SHOWN else f"{text[:_SHOWN]}…")


def _packed(stamps: Any, rows: Any) -> Packed:
    """A message for each pose; all differ in their stamp and numbers only."""
    message = write_cdr([RawTransform(0, 0, PARENT.encode(), CHILD.encode(), bytes(56))])
    count, size = len(stamps), len(message)
    payloads = np.tile(np.frombuffer(message, np.uint8), (count, 1))
    # Behind the header and the number of transforms.
    payloads[:, 8:12] = (stamps // SECOND).astype("<i4")[:, None].view(np.uint8)
    payloads[:, 12:16] = (stamps % SECOND).astype("<u4")[:, None].view(np.uint8)
    payloads[:, -56:] = np.ascontiguousarray(rows, "<f8").view(np.uint8).reshape(count, 56)
    ends = np.arange(1, count + 1, dtype=np.int64) * size
    channel = Channel("/tf", "tf2_msgs/msg/TFMessage", "cdr")
    # No log time is before 1970.
    received = np.maximum(stamps, 0)
    return Packed(payloads.tobytes(), (channel,), np.zeros(count, np.int64), received, ends - size, ends)


class TrajectoryCopy:
    """A `tfbus.recording.formats.copies.Copy` as a trajectory of one moving frame.

    Parameters
    ----------
    path : Path
    name : str
        Its ending is one of `FORMATS`.
    """

    encoding = "cdr"

    def __init__(self, path: Path, name: str) -> None:
        self._kind = FORMATS[Path(name).suffix]
        self._file = path.open("w", encoding="utf-8", newline="\n")
        if self._kind.header:
            print(self._kind.header, file=self._file)
        self._edges: dict[tuple[bytes, bytes], None] = {}

    def holds(self, _: Channel) -> bool:
        """False."""
        return False

    def write(self, channel: Channel, _: int, payload: bytes) -> None:
        """Write the poses of a message; raises `CannotWriteError` for anything else."""
        if not holds_transforms(channel) or channel.topic.endswith("_static"):
            what = "static frames" if holds_transforms(channel) else "other topics"
            if holds_covariances(channel):
                what = "covariances"
            raise CannotWriteError(f"a trajectory has no {what}")
        for raw in parser_of(channel)(payload):
            self._edges.setdefault((raw.parent, raw.child))
            x, y, z, qx, qy, qz, qw = np.frombuffer(raw.numbers, "<f8").tolist()
            print(self._kind.write(raw.seconds * SECOND + raw.nanoseconds, (x, y, z, qx, qy, qz, qw)), file=self._file)

    def finish(self) -> None:
        """Close the file.

        Raises
        ------
        ValueError
            If several frames moved, or one of them had several parents.
        """
        self.close()
        if len(self._edges) > 1:
            names = [f"{_text(child)} in {_text(parent)}" for parent, child in self._edges]
            raise ValueError(
                f"a trajectory has the path of one frame, and {', '.join(names[:_MOST_NAMES])} move: choose one by the "
                "name of its child frame, or save the way between any two with save_trajectory"
            )

    def close(self) -> None:
        """Close the file."""
        self._file.close()
