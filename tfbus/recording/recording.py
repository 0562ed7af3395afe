"""`open_recording`, which reads the transforms of a file of ROS 1, ROS 2 or tfbus message by message, by log time."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Final, NamedTuple, Self

from tfbus.errors import InvalidTransformError, RecordingError
from tfbus.geometry.stamped import Batch, TransformStamped
from tfbus.recording.formats._storage import Channel, Storage, StoredMessage
from tfbus.tf_message import Decoded, MalformedMessageError

_FIRST_BYTES: Final = 16


class RecordedMessage(NamedTuple):
    """The transforms of one message of a recording."""

    received: int
    """The log time in ns: the time of recording, not a stamp."""
    batch: Batch
    """The valid transforms."""
    errors: tuple[InvalidTransformError | MalformedMessageError, ...]
    """Why the other transforms were refused; with ``reason="damaged"``, which part of the file is lost here."""


class Recording:
    """An open recording, as `open_recording` gives it; close it, or use it in a ``with``.

    Parameters
    ----------
    path : Path
    storage : Storage
    decode_payload : callable
        Gives the samples and errors of a stored message.

    Attributes
    ----------
    path : Path
    finished : bool
        Whether the writer finished the file. If not, the last messages may be missing.
    """

    def __init__(
        self, path: Path, storage: Storage, decode_payload: Callable[[Channel, bytes], Decoded[TransformStamped]]
    ) -> None:
        self.path = path
        self.finished = storage.finished
        self._storage: Storage | None = storage
        self._decode = decode_payload

    @property
    def start(self) -> int | None:
        """The log time of the first message on any topic, in ns; None if there is none."""
        return self._opened.start

    @property
    def end(self) -> int | None:
        """The log time of the last message on any topic, in ns; None if there is none."""
        return self._opened.end

    @property
    def count(self) -> int | None:
        """The number of messages with transforms; None if only reading the whole file would tell."""
        return self._opened.count

    def messages(self, since: int | None = None, until: int | None = None) -> Iterator[RecordedMessage]:
        """Iterate over the messages on ``/tf`` and ``/tf_static``, in the order of their log times.

        Damage raises nothing: it is reported in the `errors` of a message, and reading continues behind it. A file that
        has no index, because its writer was killed, is read in the order of the file.

        Parameters
        ----------
        since, until : int, optional
            The first and the last log time, in ns. With `since`, the newest static transform of each frame from before
            comes first, each as a message received at `since`.

        Raises
        ------
        ValueError
            If the recording is closed.
        OSError
            If the file can no longer be read.
        """
        return self._messages(self._opened, since, until)

    def _messages(self, storage: Storage, since: int | None, until: int | None) -> Iterator[RecordedMessage]:
        if since is not None:
            latched: dict[str, TransformStamped] = {}
            for stored in storage.messages(None, since - 1, only_static=True):
                for sample in self._message(stored).batch:
                    # In the order of the samples that stay.
                    latched.pop(sample.child, None)
                    latched[sample.child] = sample
            for sample in latched.values():
                yield RecordedMessage(since, (sample,), ())
        yield from map(self._message, storage.messages(since, until))

    def _message(self, stored: StoredMessage) -> RecordedMessage:
        received, channel, payload = stored
        if isinstance(channel, MalformedMessageError):
            return RecordedMessage(received, (), (channel,))
        try:
            samples, errors = self._decode(channel, payload)
        except MalformedMessageError as error:
            return RecordedMessage(received, (), (error,))
        return RecordedMessage(received, tuple(filter(None, samples)), tuple(errors))

    def close(self) -> None:
        """Close the file; closing again does nothing."""
        storage, self._storage = self._storage, None
        if storage is not None:
            storage.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    @property
    def _opened(self) -> Storage:
        if self._storage is None:
            raise ValueError(f"the recording {self.path} is closed")
        return self._storage


def open_recording(path: str | os.PathLike[str]) -> Recording:
    """Open a recording of ROS 1 (``.bag``) or ROS 2 (a folder, ``.db3``, ``.mcap``).

    The first bytes of the file decide which format it has, not its name. All formats but bags may be unfinished.

    Parameters
    ----------
    path : str or path-like

    Raises
    ------
    RecordingError
        If the file is missing or empty, cannot be read, was cut off before its first message, or is no recording; or if
        the packages that read it are not installed.
    """
    file = Path(path)
    try:
        from tfbus.recording.formats._payload import decode_payload

        return Recording(file, _open_storage(file, folders=True), decode_payload)
    except ImportError as error:
        problem = f'to read it, tfbus needs some packages more: pip install "tfbus[bag]" ({error})'
        raise RecordingError(problem, path=str(file), reason="missing extra") from error
    except FileNotFoundError as error:
        raise RecordingError("there is no such file", path=str(file), reason="missing") from error
    except OSError as error:
        raise RecordingError(
            f"it cannot be read: {error.strerror or error}", path=str(file), reason="unreadable"
        ) from error


def _open_storage(path: Path, folders: bool = False) -> Storage:
    if folders and path.is_dir():
        from tfbus.recording.formats._folder import FolderStorage

        return FolderStorage(path, _open_storage)
    with path.open("rb") as file:
        first = file.read(_FIRST_BYTES)
    if not first:
        raise RecordingError("the file is empty", path=str(path), reason="empty")
    from tfbus.recording.formats import _mcap, _ros1, _sqlite

    formats: list[tuple[bytes, Callable[[Path], Storage]]] = [
        (_mcap.MAGIC, _mcap.McapStorage),
        (_sqlite.MAGIC, _sqlite.SqliteStorage),
        (_ros1.MAGIC, _ros1.Ros1Storage),
    ]
    for magic, storage in formats:
        if first.startswith(magic):
            return storage(path)
        if magic.startswith(first):
            raise RecordingError(f"the file ends after {len(first)} bytes", path=str(path), reason="truncated")
    raise RecordingError("it is no recording of ROS 1 (.bag) or ROS 2 (.mcap, .db3)", path=str(path), reason="foreign")
