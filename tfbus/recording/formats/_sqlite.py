"""Reading SQLite files of ROS 2, finished or not."""

import sqlite3
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final
from urllib.parse import quote

from tfbus.errors import RecordingError
from tfbus.recording.formats._bounds import MAX_OTHER_MESSAGE
from tfbus.recording.formats._storage import Channel, StoredMessage, Wanted, lost_message, select, shortfalls

MAGIC: Final = b"SQLite format 3\0"

_DAMAGE = (sqlite3.Error, UnicodeDecodeError)
_BLOCK: Final = 256


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

    complete: Final = True
    remarks: Final = ()

    def __init__(self, path: Path) -> None:
        self._path = path
        log = path.with_name(f"{path.name}-wal")
        self.finished = not (log.exists() and log.stat().st_size)
        # Without "immutable", SQLite would create an empty log beside the recording.
        mode = "immutable=1" if self.finished else "mode=ro"
        try:
            self._file = sqlite3.connect(f"file:{quote(str(path))}?{mode}", uri=True, check_same_thread=False)
            try:
                # A computed column could claim any size, and call any function.
                self._file.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_OTHER_MESSAGE)
                self._file.execute("PRAGMA trusted_schema = OFF")
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
        definitions = self._definitions() if "message_definitions" in tables else {}
        columns = {row[1] for row in self._file.execute("PRAGMA table_info(topics)")}
        quality = "offered_qos_profiles" if "offered_qos_profiles" in columns else "''"
        topics = self._file.execute(f"SELECT id, name, type, serialization_format, {quality} FROM topics")
        self._numbered: dict[int, Channel] = {}
        for number, name, kind, encoding, profiles in topics:
            schema_encoding, schema = definitions.get(kind, ("", b""))
            metadata = {"offered_qos_profiles": str(profiles)} if profiles else {}
            self._numbered[number] = Channel(str(name), str(kind), str(encoding), schema_encoding, schema, metadata)
        ends = "SELECT (SELECT MIN(timestamp) FROM messages), (SELECT MAX(timestamp) FROM messages)"
        self.start: int | None
        self.end: int | None
        self.start, self.end = self._file.execute(ends).fetchone()
        # The table itself is counted: an index of it may be damaged.
        self._counts: dict[int, int] = dict(
            self._file.execute("SELECT topic_id, COUNT(*) FROM messages NOT INDEXED GROUP BY topic_id")
        )

    def _definitions(self) -> dict[str, tuple[str, bytes]]:
        """Encoding and text of the definition of each type; files before ROS 2 Iron have none."""
        rows = self._file.execute("SELECT topic_type, encoding, encoded_message_definition FROM message_definitions")
        return {str(kind): (str(encoding), str(text).encode()) for kind, encoding, text in rows}

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    @property
    def channels(self) -> Mapping[Channel, int | None]:
        """All topics, with the number of their messages."""
        return {channel: self._counts.get(number, 0) for number, channel in self._numbered.items()}

    def messages(self, wanted: Wanted, since: int | None = None, until: int | None = None) -> Iterator[StoredMessage]:
        """Iterate over messages, as `Storage.messages`."""
        read: Counter[Channel] = Counter()
        now = self.start or 0
        for stored in select(self._blocks(wanted, since, until), since, until, read):
            now = stored[0]
            yield stored
        if since is None and until is None:
            lost = sum(count for number, count in self._counts.items() if number not in self._numbered)
            if lost:
                yield lost_message(now, f"{lost:,} messages are on topics that the file does not describe")
            promised = {channel: count or 0 for channel, count in self.channels.items() if wanted(channel)}
            yield from shortfalls(now, promised, read)

    def _blocks(self, wanted: Wanted, since: int | None, until: int | None) -> Iterator[list[StoredMessage]]:
        chosen = {number: channel for number, channel in self._numbered.items() if wanted(channel)}
        limits = [("timestamp >= ?", since), ("timestamp <= ?", until)]
        conditions = [
            f"topic_id IN ({', '.join('?' * len(chosen))})",
            *(text for text, limit in limits if limit is not None),
        ]
        values = [*chosen, *(limit for _, limit in limits if limit is not None)]
        query = f"SELECT timestamp, topic_id, CAST(data AS BLOB) FROM messages WHERE {' AND '.join(conditions)}"
        now = self.start or 0
        try:
            rows = self._file.execute(f"{query} ORDER BY timestamp, id", values)
            while block := rows.fetchmany(_BLOCK):
                now = block[-1][0]
                yield [(received, chosen[number], payload or b"") for received, number, payload in block]
        except _DAMAGE as error:
            yield [lost_message(now, f"nothing more can be read: {error}")]
