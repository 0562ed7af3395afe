"""Writing an MCAP file as `ros2 bag record` does, in small chunks.

Every write goes to the operating system at once, and each chunk is complete in itself. So flushed samples can be read
even if the process is killed. All functions block.
"""

import os
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from io import FileIO
from itertools import groupby
from typing import Any, cast

from tfbus.bus.queues import TimedBatch
from tfbus.errors import InvalidTransformError, pip_install
from tfbus.geometry.stamped import Batch, TransformStamped
from tfbus.recording.formats._channels import Channels
from tfbus.tf_message import encode, refusal

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
        Samples and messages that the operating system has.
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
            raise ImportError(f"to record needs a package more: {pip_install('bag')}") from None
        self.samples = 0
        self.messages = 0
        self.buffered = 0
        self.unattributed = 0
        self.refused: Counter[str] = Counter()
        self._buffered_messages = 0
        self._file = _UnbufferedFile(path, overwrite)
        try:
            # Not all functions of the writer have types.
            self._writer = writer = cast(Any, Writer(cast(Any, self._file), CHUNK_SIZE))
            writer.start(profile="ros2", library="tfbus")
            # As ROS 2 Humble has it: newer ones then read the profiles as numbers too, and older ones know no other.
            writer.add_metadata("rosbag2", {})
        except BaseException:
            self._file.close()
            raise
        schema = writer.register_schema(SCHEMA_NAME, "ros2msg", SCHEMA.encode())
        self._channels = Channels(lambda topic, metadata: writer.register_channel(topic, "cdr", schema, metadata))
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
            If the disk fails; then the file can only be closed.
        """
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
        """
        with self._file:
            self.write((), flush=True)
            self._writer.finish()

    def close(self) -> None:
        """Close the file without an index."""
        self._file.close()

    def _write(self, topic: str, received: int, samples: Sequence[TransformStamped]) -> None:
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
        # Registering the channel may have ended the chunk.
        self._count_written()
        self.buffered += len(samples)
        self._buffered_messages += 1
        self._writer.add_message(channel, log_time, data, log_time)
        self._count_written()

    def _count_written(self) -> None:
        if self._file.size > self._written:
            self._written = self._file.size
            self.samples += self.buffered
            self.messages += self._buffered_messages
            self.buffered = self._buffered_messages = 0


def _authority(sample: TransformStamped) -> str:
    return sample.authority


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
    """A file for the writer, each write of which is complete and goes to the operating system at once."""

    def __init__(self, path: str, overwrite: bool) -> None:
        self.size = 0
        self._file = FileIO(path, "w" if overwrite else "x")

    def write(self, data: bytes) -> int:
        rest = memoryview(data)
        while rest:
            written = os.write(self._file.fileno(), rest)
            self.size += written
            rest = rest[written:]
        return len(data)

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
