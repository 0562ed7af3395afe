"""Reading SQLite files of ROS 2, finished or not."""

import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Final
from urllib.parse import quote

from tfbus.errors import RecordingError
from tfbus.recording.formats._storage import Channel, StoredMessage, channel_of, lost_message

MAGIC: Final = b"SQLite format 3\0"

_DAMAGE = (sqlite3.Error, UnicodeDecodeError)


class SqliteStorage:
    """A `Storage` of one SQLite file.

    Parameters
    ----------
    path : Path

    Attributes
    ----------
    finished : bool
        Whether there is no write-ahead log beside the file; a writer that is killed leaves one.

    Raises
    ------
    RecordingError
        If the file is damaged, or no recording.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        log = path.with_name(f"{path.name}-wal")
        self.finished = not (log.exists() and log.stat().st_size)
        # Without "immutable", SQLite would create an empty log beside the recording.
        mode = "immutable=1" if self.finished else "mode=ro"
        try:
            self._file = sqlite3.connect(f"file:{quote(str(path))}?{mode}", uri=True, check_same_thread=False)
            try:
                self._read()
            except BaseException:
                self._file.close()
                raise
        except _DAMAGE as error:
            raise RecordingError(
                f"it cannot be read as a recording of ROS 2: {error}", path=str(path), reason="damaged"
            ) from error

    def _read(self) -> None:
        tables = {name for (name,) in self._file.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if not tables >= {"topics", "messages"}:
            raise RecordingError("an SQLite file, but no recording of ROS 2", path=str(self._path), reason="foreign")
        topics = self._file.execute("SELECT id, name, type FROM topics WHERE serialization_format = 'cdr'")
        found = {number: channel_of(str(name), str(kind), {}) for number, name, kind in topics}
        self._channels: dict[int, Channel] = {number: channel for number, channel in found.items() if channel}
        ends = "SELECT (SELECT MIN(timestamp) FROM messages), (SELECT MAX(timestamp) FROM messages)"
        self.start: int | None
        self.end: int | None
        self.start, self.end = self._file.execute(ends).fetchone()
        count = f"SELECT COUNT(*) FROM messages WHERE topic_id IN ({self._placeholders(self._channels)})"
        self.count: int | None = self._file.execute(count, [*self._channels]).fetchone()[0]

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def messages(self, since: int | None, until: int | None, only_static: bool = False) -> Iterator[StoredMessage]:
        """Iterate over messages, as `Storage.messages`."""
        wanted = {number: channel for number, channel in self._channels.items() if channel.static or not only_static}
        limits = [("timestamp >= ?", since), ("timestamp <= ?", until)]
        conditions = [
            f"topic_id IN ({self._placeholders(wanted)})",
            *(text for text, limit in limits if limit is not None),
        ]
        values = [*wanted, *(limit for _, limit in limits if limit is not None)]
        query = f"SELECT timestamp, topic_id, CAST(data AS BLOB) FROM messages WHERE {' AND '.join(conditions)}"
        now = self.start or 0
        try:
            for now, number, payload in self._file.execute(f"{query} ORDER BY timestamp, id", values):
                yield now, wanted[number], payload or b""
        except _DAMAGE as error:
            yield lost_message(now, f"nothing more can be read: {error}")

    @staticmethod
    def _placeholders(channels: dict[int, Channel]) -> str:
        return ", ".join("?" * len(channels))
