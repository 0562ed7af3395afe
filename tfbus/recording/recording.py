"""Recordings of transforms, read from files of ROS 1, of ROS 2 and of our own: message after message, by log time."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Final, NamedTuple, Self

from tfbus.errors import InvalidTransformError, RecordingError
from tfbus.geometry.stamped import Batch, TransformStamped
from tfbus.recording.formats.storage import Channel, Storage, Stored
from tfbus.tf_message import Decoded, MalformedMessageError

_FIRST_BYTES: Final = 16


class RecordedMessage(NamedTuple):
    """What one message of a recording holds."""

    received: int
    """Its log time, in ns: when it was recorded, not a stamp."""
    batch: Batch
    """Its good transforms."""
    errors: tuple[InvalidTransformError | MalformedMessageError, ...]
    """Why the others were refused; or what part of the file is lost here (``reason="damaged"``)."""


class Recording:
    """An open recording; made by `open_recording`, and to be closed: it is a ``with`` of its own.

    Parameters
    ----------
    path : Path
    storage : Storage
    samples_of : callable
        Gives what a stored message holds.

    Attributes
    ----------
    path : Path
    finished : bool
        Whether its writer came to an end. What it wrote last may be missing if not.
    """

    def __init__(
        self, path: Path, storage: Storage, samples_of: Callable[[Channel, bytes], Decoded[TransformStamped]]
    ) -> None:
        self.path = path
        self.finished = storage.finished
        self._storage: Storage | None = storage
        self._samples_of = samples_of

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
        """How many messages of transforms there are; None if only reading all of it would tell."""
        return self._opened.count

    def messages(self, since: int | None = None, until: int | None = None) -> Iterator[RecordedMessage]:
        """The messages on ``/tf`` and ``/tf_static``, in the order of their log times.

        Damage is no error here: it is among the `errors` of a message, and the reading goes on behind it. Of a file
        without an index, because its writer was killed, the order is that of the file.

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
            If the file cannot be read any more.
        """
        return self._messages(self._opened, since, until)

    def _messages(self, storage: Storage, since: int | None, until: int | None) -> Iterator[RecordedMessage]:
        if since is not None:
            latched: dict[str, TransformStamped] = {}
            for stored in storage.messages(None, since - 1, only_static=True):
                for sample in self._message(stored).batch:
                    # The order is that of the newest ones.
                    latched.pop(sample.child, None)
                    latched[sample.child] = sample
            for sample in latched.values():
                yield RecordedMessage(since, (sample,), ())
        yield from map(self._message, storage.messages(since, until))

    def _message(self, stored: Stored) -> RecordedMessage:
        received, channel, payload = stored
        if isinstance(channel, MalformedMessageError):
            return RecordedMessage(received, (), (channel,))
        try:
            samples, errors = self._samples_of(channel, payload)
        except MalformedMessageError as error:
            return RecordedMessage(received, (), (error,))
        return RecordedMessage(received, tuple(filter(None, samples)), tuple(errors))

    def close(self) -> None:
        """Close the file; a second time does nothing."""
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
    """A recording of ROS 1 (``.bag``) or ROS 2 (a folder, ``.db3``, ``.mcap``), finished or, but for bags, not.

    Which one it is, is told by how it begins, not by its name.

    Parameters
    ----------
    path : str or path-like

    Raises
    ------
    RecordingError
        If it is missing or empty, cannot be read, was cut off before its first message, or is no recording; or if the
        packages that read it are missing.
    """
    place = Path(path)
    try:
        from tfbus.recording.formats.payload import samples_of

        return Recording(place, _storage(place, folders=True), samples_of)
    except ImportError as error:
        why = f'to read it, tfbus needs some packages more: pip install "tfbus[bag]" ({error})'
        raise RecordingError(why, path=str(place), reason="missing extra") from error
    except FileNotFoundError as error:
        raise RecordingError("there is no such file", path=str(place), reason="missing") from error
    except OSError as error:
        raise RecordingError(
            f"it cannot be read: {error.strerror or error}", path=str(place), reason="unreadable"
        ) from error


def _storage(path: Path, folders: bool = False) -> Storage:
    if folders and path.is_dir():
        from tfbus.recording.formats.folder import FolderStorage

        return FolderStorage(path, _storage)
    with path.open("rb") as file:
        first = file.read(_FIRST_BYTES)
    if not first:
        raise RecordingError("the file is empty", path=str(path), reason="empty")
    from tfbus.recording.formats import mcap, ros1, sqlite

    formats: list[tuple[bytes, Callable[[Path], Storage]]] = [
        (mcap.MAGIC, mcap.McapStorage),
        (sqlite.MAGIC, sqlite.SqliteStorage),
        (ros1.MAGIC, ros1.Ros1Storage),
    ]
    for magic, kind in formats:
        if first.startswith(magic):
            return kind(path)
        if magic.startswith(first):
            raise RecordingError(f"the file ends after {len(first)} bytes", path=str(path), reason="truncated")
    raise RecordingError("it is no recording of ROS 1 (.bag) or ROS 2 (.mcap, .db3)", path=str(path), reason="foreign")
