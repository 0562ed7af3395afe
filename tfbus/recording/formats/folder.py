"""Folders of ROS 2: one recording in several files, which may be compressed."""

import heapq
from collections.abc import Callable, Iterator
from operator import itemgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from zstandard import ZstdDecompressor, ZstdError

from tfbus.errors import RecordingError
from tfbus.recording.formats.storage import Storage, Stored, lost

SUFFIXES: Final = (".mcap", ".db3")
COMPRESSED: Final = ".zstd"


class FolderStorage:
    """All files of a folder as one; `Storage` says what it tells.

    Which files there are, the folder itself says: ``metadata.yaml`` is missing where the writer was killed.

    Parameters
    ----------
    path : Path
    open_file : callable
        Opens one file.

    Raises
    ------
    RecordingError
        If there are no files of a recording, or not one of them can be read.
    """

    def __init__(self, path: Path, open_file: Callable[[Path], Storage]) -> None:
        self._unpacked = TemporaryDirectory(prefix="tfbus-")
        self._files: list[Storage] = []
        self._refused: list[RecordingError] = []
        try:
            for file in sorted(path.iterdir()):
                if Path(file.name.removesuffix(COMPRESSED)).suffix in SUFFIXES:
                    self._add(file, open_file)
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

    def _add(self, path: Path, open_file: Callable[[Path], Storage]) -> None:
        try:
            self._files.append(open_file(self._unpack(path) if path.suffix == COMPRESSED else path))
        except RecordingError as error:
            self._refused.append(error)

    def _unpack(self, path: Path) -> Path:
        unpacked = Path(self._unpacked.name, path.stem)
        try:
            with path.open("rb") as source, unpacked.open("wb") as target:
                ZstdDecompressor().copy_stream(source, target)
        except ZstdError as error:
            raise RecordingError(f"it cannot be decompressed: {error}", path=str(path), reason="damaged") from error
        return unpacked

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
        """How many messages of transforms there are, if every file tells."""
        counts = [file.count for file in self._files]
        return None if None in counts else sum(count for count in counts if count is not None)

    def close(self) -> None:
        """Close the files, and remove what was unpacked."""
        for file in self._files:
            file.close()
        self._unpacked.cleanup()

    def messages(self, since: int | None, until: int | None, only_static: bool = False) -> Iterator[Stored]:
        """As `Storage` has it."""
        now = (self.start or 0) if since is None else since
        for error in self._refused:
            yield lost(now, str(error))
        yield from heapq.merge(*(its.messages(since, until, only_static) for its in self._files), key=itemgetter(0))
