"""Folders of ROS 2: one recording in several files, which may be compressed."""

import heapq
from collections.abc import Callable, Iterator
from operator import itemgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from zstandard import ZstdDecompressor, ZstdError

from tfbus.errors import RecordingError
from tfbus.recording.formats._storage import Storage, StoredMessage, lost_message

SUFFIXES: Final = (".mcap", ".db3")
COMPRESSED: Final = ".zstd"


class FolderStorage:
    """A `Storage` of all recordings in one folder.

    It lists the folder and does not read ``metadata.yaml``, which is missing if the writer was killed.

    Parameters
    ----------
    path : Path
    open_file : callable
        Opens one file.

    Raises
    ------
    RecordingError
        If the folder has no files of a recording, or none of them can be read.
    """

    def __init__(self, path: Path, open_file: Callable[[Path], Storage]) -> None:
        self._decompressed = TemporaryDirectory(prefix="tfbus-")
        self._files: list[Storage] = []
        self._refused: list[RecordingError] = []
        try:
            for file in sorted(path.iterdir()):
                if Path(file.name.removesuffix(COMPRESSED)).suffix in SUFFIXES:
                    self._open(file, open_file)
            if not self._files and self._refused:
                raise self._refused[0]
            if not self._files:
                raise RecordingError(
                    "a folder without files that end in .mcap or .db3", path=str(path), reason="foreign"
                )
        except BaseException:
            self.close()
            raise
        self.finished = not self._refused and all(file.finished for file in self._files)

    def _open(self, path: Path, open_file: Callable[[Path], Storage]) -> None:
        try:
            self._files.append(open_file(self._decompress(path) if path.suffix == COMPRESSED else path))
        except RecordingError as error:
            self._refused.append(error)

    def _decompress(self, path: Path) -> Path:
        decompressed = Path(self._decompressed.name, path.stem)
        try:
            with path.open("rb") as source, decompressed.open("wb") as target:
                ZstdDecompressor().copy_stream(source, target)
        except ZstdError as error:
            raise RecordingError(f"it cannot be decompressed: {error}", path=str(path), reason="damaged") from error
        return decompressed

    @property
    def start(self) -> int | None:
        """The log time of the first message, in ns."""
        return min((file.start for file in self._files if file.start is not None), default=None)

    @property
    def end(self) -> int | None:
        """The log time of the last message, in ns."""
        return max((file.end for file in self._files if file.end is not None), default=None)

    @property
    def count(self) -> int | None:
        """The number of messages with transforms, if all files know theirs."""
        counts = [file.count for file in self._files]
        return None if None in counts else sum(count for count in counts if count is not None)

    def close(self) -> None:
        """Close the files, and remove the decompressed copies."""
        for file in self._files:
            file.close()
        self._decompressed.cleanup()

    def messages(self, since: int | None, until: int | None, only_static: bool = False) -> Iterator[StoredMessage]:
        """Iterate over the messages of all files, as `Storage.messages`."""
        now = (self.start or 0) if since is None else since
        for error in self._refused:
            yield lost_message(now, str(error))
        yield from heapq.merge(*(file.messages(since, until, only_static) for file in self._files), key=itemgetter(0))
