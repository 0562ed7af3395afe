"""Writing an MCAP file as `ros2 bag record` does, in small chunks.

Every write goes to the operating system at once, and each chunk is complete in itself. So flushed samples can be read
even if the process is killed. All functions block.

A transform of ROS has no authority. So each authority has a channel of its own, and so has each sequence of authorities
within one message. The metadata of the channel hold them, under a key that other tools ignore (`Channels`).
"""

import json
import os
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from io import FileIO
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from stat import S_ISREG
from typing import Any, cast

from tfbus.bus.queues import TimedBatch
from tfbus.errors import InvalidTransformError, pip_install
from tfbus.geometry.stamped import Batch, TransformStamped
from tfbus.geometry.uncertain import are_uncertain
from tfbus.recording.formats.covariances import (
    MAX_COVARIANCES,
    SUFFIX,
    covariance_channel,
    covariances_of,
    write_covariances,
)
from tfbus.recording.formats.storage import AUTHORITIES
from tfbus.tf_message import encode, refusal

MAX_CHANNELS = 1_000
MAX_SHARED_CHANNELS = 500
_MAX_RUNS = 32

Runs = Sequence[tuple[str, int]]
"""Pairs of an authority and the number of successive samples that it sent."""

TYPE_HASH = "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"
"""The type hash of ``tf2_msgs/msg/TFMessage`` in ROS 2 (REP 2016)."""


class Channels:
    """A bounded number of channels by topic and authorities, registered at their first use.

    Parameters
    ----------
    register : callable
        Adds a channel with a topic and metadata to the file, and returns its number.
    """

    def __init__(self, register: Callable[[str, dict[str, str]], int]) -> None:
        self._register_in_file = register
        self._known: dict[tuple[str, tuple[tuple[str, int], ...]], int] = {}

    def find(self, topic: str, runs: Runs) -> int | None:
        """The channel of a message; None if the limit of channels is reached."""
        # A single authority stands for a message of any length.
        key = tuple(runs) if len(runs) > 1 else ((runs[0][0], 1),)
        if not any(authority for authority, _ in key):
            key = ()
        known = self._known.get((topic, key))
        if known is None and self._has_room_for(key):
            known = self._register(topic, key)
        return known

    def anonymous(self, topic: str) -> int:
        """The channel of messages without an authority."""
        known = self._known.get((topic, ()))
        return self._register(topic, ()) if known is None else known

    def _has_room_for(self, key: tuple[tuple[str, int], ...]) -> bool:
        limit = MAX_CHANNELS if len(key) <= 1 else MAX_SHARED_CHANNELS
        return not key or (len(key) <= _MAX_RUNS and len(self._known) < limit)

    def _register(self, topic: str, key: tuple[tuple[str, int], ...]) -> int:
        metadata = {
            "offered_qos_profiles": _quality_of_service(static=topic == "/tf_static"),
            "topic_type_hash": TYPE_HASH,
        }
        if key:
            metadata[AUTHORITIES] = json.dumps(key)
        channel = self._register_in_file(topic, metadata)
        self._known[topic, key] = channel
        return channel


def _quality_of_service(static: bool) -> str:
    """The profile of tf2's broadcasters: reliable with a depth of 100, or latched for static transforms."""
    infinite = "{sec: 9223372036, nsec: 854775807}"
    keep_last, reliable, automatic = 1, 1, 1
    depth, durability = (1, 1) if static else (100, 2)
    return (
        f"- history: {keep_last}\n  depth: {depth}\n  reliability: {reliable}\n  durability: {durability}\n"
        f"  deadline: {infinite}\n  lifespan: {infinite}\n"
        f"  liveliness: {automatic}\n  liveliness_lease_duration: {infinite}\n"
        "  avoid_ros_namespace_conventions: false"
    )


CHUNK_SIZE = 32 * 1024

SCHEMA_NAME = "tf2_msgs/msg/TFMessage"
_SEPARATOR = f"\n{'=' * 80}\n"
SCHEMA = _SEPARATOR.join(
    (
        "geometry_msgs/TransformStamped[] transforms",
        "MSG: geometry_msgs/TransformStamped\n"
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform",
        "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id",
        "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec",
        "MSG: geometry_msgs/Transform\ngeometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation",
        "MSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z",
        "MSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
    )
)

_authority = attrgetter("authority")
_BURST = 16
_PAUSE = 1e-5


class McapOutput:
    """Writes batches to a new MCAP file; for one thread at a time.

    Parameters
    ----------
    path : str
    overwrite : bool
        Whether to replace an existing file.

    Attributes
    ----------
    samples, messages : int
        Samples and messages that the operating system has; none, once the file was removed or cut.
    buffered : int
        Samples in the unfinished chunk.
    unattributed : int
        Samples written without their authority.
    refused : Counter
        Samples that a message cannot hold, by reason.

    Raises
    ------
    OSError
        If the file cannot be created; `FileExistsError` if it exists.
    ImportError
        If the extra is missing.
    """

    def __init__(self, path: str, overwrite: bool) -> None:
        try:
            from mcap.writer import Writer
        except ImportError:
            raise ImportError(f"recording needs one more package: {pip_install('bag')}") from None
        self.samples: int = 0
        self.messages: int = 0
        self.buffered: int = 0
        self.unattributed: int = 0
        self.refused: Counter[str] = Counter()
        self._buffered_messages = 0
        self._file = _UnbufferedFile(path, overwrite)
        try:
            # Not all functions of the writer have types.
            self._writer = writer = cast(Any, Writer(cast(Any, self._file), CHUNK_SIZE))
            writer.start(profile="ros2", library="tfbus")
            # As in ROS 2 Humble: newer versions also read profiles as numbers, and older ones read nothing else.
            writer.add_metadata("rosbag2", {})
        except BaseException:
            self._file.close()
            raise
        schema = writer.register_schema(SCHEMA_NAME, "ros2msg", SCHEMA.encode())
        self._channels = Channels(lambda topic, metadata: writer.register_channel(topic, "cdr", schema, metadata))
        self._covariances: dict[str, int] = {}
        self._written = self._file.size

    def write(self, batches: Iterable[TimedBatch], flush: bool = False) -> None:
        """Write batches: the static samples of a batch become one message, its moving samples another.

        Parameters
        ----------
        batches : iterable of (int, Batch)
            Log times in ns, and batches.
        flush : bool
            Whether to end the chunk, so that all samples are in the file.

        Raises
        ------
        OSError
            If the disk fails, or somebody removed, replaced or cut the file; then the file can only be closed.
        """
        self._check_file()
        messages = ((received, samples) for received, batch in batches for samples in _by_kind(batch))
        for number, (received, samples) in enumerate(messages, 1):
            self._write("/tf_static" if samples[0].static else "/tf", received, samples)
            if number % _BURST == 0:
                # Let the event loop run: without a pause, this thread would hold the interpreter for 5 ms.
                time.sleep(_PAUSE)
        if flush:
            self._writer.flush()
            self._count_written()

    def finish(self) -> None:
        """Write the index, and close the file.

        Raises
        ------
        OSError
            As `write`; also if the file is whole, and was moved meanwhile.
        """
        with self._file:
            self.write((), flush=True)
            self._writer.finish()
            self._check_file()
            self._file.check_path()

    def close(self) -> None:
        """Close the file without an index."""
        self._file.close()

    def _write(self, topic: str, received: int, samples: Sequence[TransformStamped]) -> None:
        uncertain = are_uncertain(samples)
        if uncertain and len(samples) > MAX_COVARIANCES:
            for first in range(0, len(samples), MAX_COVARIANCES):
                self._write(topic, received, samples[first : first + MAX_COVARIANCES])
            return
        try:
            data = encode(samples)
        except InvalidTransformError:
            refusals = [(sample, refusal(sample)) for sample in samples]
            self.refused.update(error.reason for _, error in refusals if error is not None)
            samples = [sample for sample, error in refusals if error is None]
            if not samples:
                return
            data = encode(samples)
        runs = [(authority, list(run)) for authority, run in groupby(samples, _authority)]
        channel = self._channels.find(topic, [(authority, len(run)) for authority, run in runs])
        if channel is None and len(runs) > 1:
            for _, run in runs:
                self._write(topic, received, run)
            return
        if channel is None:
            channel = self._channels.anonymous(topic)
            self.unattributed += len(samples)
        # The format has no time before 1970.
        log_time = max(0, received)
        if uncertain:
            self._write_covariances(topic + SUFFIX, log_time, samples)
        # Registering the channel may have ended the chunk.
        self._count_written()
        self.buffered += len(samples)
        self._buffered_messages += 1
        self._writer.add_message(channel, log_time, data, log_time)
        self._count_written()

    def _write_covariances(self, topic: str, log_time: int, samples: Sequence[TransformStamped]) -> None:
        if topic not in self._covariances:
            profiles = {"offered_qos_profiles": _quality_of_service(static="static" in topic)}
            channel = covariance_channel(topic, profiles)
            schema = self._writer.register_schema(channel.type, channel.schema_encoding, channel.schema)
            self._covariances[topic] = self._writer.register_channel(topic, channel.encoding, schema, profiles)
        self._writer.add_message(
            self._covariances[topic], log_time, write_covariances(covariances_of(samples)), log_time
        )

    def _check_file(self) -> None:
        """Raise `OSError` if the file lacks data that were written, and count their samples as not written."""
        try:
            self._file.check()
        except OSError:
            self.samples = self.messages = 0
            raise

    def _count_written(self) -> None:
        if self._file.size > self._written:
            self._written = self._file.size
            self.samples += self.buffered
            self.messages += self._buffered_messages
            self.buffered = self._buffered_messages = 0


def _by_kind(batch: Batch) -> Iterable[Sequence[TransformStamped]]:
    statics = [sample for sample in batch if sample.static]
    if not statics:
        return [batch]
    moving = [sample for sample in batch if not sample.static]
    if {sample.child for sample in statics}.isdisjoint(sample.child for sample in moving):
        return [samples for samples in (statics, moving) if samples]
    # A child of both kinds: keep the order, because its last kind wins.
    return [list(run) for _, run in groupby(batch, lambda sample: sample.static)]


class _UnbufferedFile:
    """A file for the writer. Each write is complete, and goes to the operating system at once."""

    def __init__(self, path: str, overwrite: bool) -> None:
        # The working directory may change.
        self._path = Path(path).absolute()
        self.size = 0
        self._file = FileIO(path, "w" if overwrite else "x")

    def write(self, data: bytes) -> int:
        rest = memoryview(data)
        while rest:
            written = os.write(self._file.fileno(), rest)
            self.size += written
            rest = rest[written:]
        return len(data)

    def check(self) -> None:
        """Raise `OSError` if somebody removed, replaced or cut the file."""
        status = os.fstat(self._file.fileno())
        # A pipe or a device has no size.
        if not S_ISREG(status.st_mode):
            return
        if not status.st_nlink:
            raise OSError("somebody removed or replaced the file while it was recorded: nothing is left of it")
        if status.st_size < self.size:
            raise OSError(
                f"somebody cut the file while it was recorded: it has {status.st_size:,} of {self.size:,} bytes"
            )

    def check_path(self) -> None:
        """Raise `OSError` if the file was moved."""
        status = os.fstat(self._file.fileno())
        try:
            moved = not os.path.samestat(self._path.stat(), status)
        except FileNotFoundError:
            moved = True
        if moved and S_ISREG(status.st_mode):
            raise OSError("somebody moved the file while it was recorded: it is whole, and elsewhere")

    def tell(self) -> int:
        return self.size

    def flush(self) -> None:
        pass

    def close(self) -> None:
        self._file.close()

    def __enter__(self) -> "_UnbufferedFile":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()
