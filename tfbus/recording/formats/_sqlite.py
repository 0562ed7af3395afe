"""Reading SQLite files of ROS 2, finished or not.

A writer that is killed leaves a journal beside its file, and SQLite needs it to make the file whole. As it would write
into both, it gets a copy; where the writer may still be running, the file is read in its place, under SQLite's locks.

Columns of SQLite hold values of any type, whatever their declaration: a timestamp that is no integer is counted.
"""

import shutil
import sqlite3
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final
from urllib.parse import quote

from tfbus.errors import RecordingError
from tfbus.recording.formats._bounds import DESCRIPTION, MAX_DESCRIBED, MAX_OTHER_MESSAGE, MIB
from tfbus.recording.formats._storage import (
    Channel,
    StoredMessage,
    Wanted,
    lost_message,
    select,
    shortfalls,
    unfinished,
)

MAGIC: Final = b"SQLite format 3\0"

_DAMAGE = (sqlite3.Error, UnicodeDecodeError, MemoryError)
_BLOCK: Final = 256
_BLOCK_BYTES: Final = 16 * MIB
_STEPS: Final = 100_000
"""Steps of SQLite's virtual machine between two looks at their number."""
_STEPS_PER_BYTE: Final = 16
_MIN_STEPS: Final = 10_000_000
_IS_STAMP: Final = "typeof(timestamp) = 'integer'"


class SqliteStorage:
    """A `Storage` of one SQLite file.

    Parameters
    ----------
    path : Path

    Attributes
    ----------
    finished : bool
        Whether there is no journal beside the file; a writer that is killed leaves one.

    Raises
    ------
    RecordingError
        If the file is damaged, or no recording.
    """

    complete: Final = True
    remarks: Final = ()

    def __init__(self, path: Path) -> None:
        self._path = path
        self._steps = 0
        journals = [each for each in (_beside(path, "-journal"), _beside(path, "-wal")) if _is_used(each)]
        self.finished = not journals
        try:
            if not journals:
                # Without "immutable", SQLite would create an empty log beside the recording.
                self._open(path, "immutable=1")
            elif _beside(path, "-wal") in journals and not _beside(path, "-shm").exists():
                # Nobody else has it open, and SQLite would create that file.
                self._recover(path, journals)
            else:
                try:
                    self._open(path, "mode=ro")
                except sqlite3.OperationalError:
                    self._recover(path, journals)
        except _DAMAGE as error:
            raise RecordingError(
                f"it cannot be read as a recording of ROS 2: {_in_words(error)}", path=str(path), reason="damaged"
            ) from error

    def _open(self, path: Path, mode: str) -> None:
        """Open a file and read what it holds."""
        self._file = sqlite3.connect(f"file:{quote(str(path))}?{mode}", uri=True, check_same_thread=False)
        try:
            self._most_steps = _MIN_STEPS + _STEPS_PER_BYTE * path.stat().st_size
            # A computed column could claim any size, and call any function.
            self._file.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_OTHER_MESSAGE)
            self._file.execute("PRAGMA trusted_schema = OFF")
            # A damaged tree of pages may lead to the same pages for ever.
            self._file.set_progress_handler(self._has_gone_too_far, _STEPS)
            self._read()
        except BaseException:
            self._file.close()
            raise

    def _has_gone_too_far(self) -> bool:
        self._steps += _STEPS
        return self._steps > self._most_steps

    def _query(self, statement: str, values: list[Any] | None = None) -> sqlite3.Cursor:
        self._steps = 0
        return self._file.execute(statement, values or [])

    def _recover(self, path: Path, journals: list[Path]) -> None:
        """Open a copy of a file, of which SQLite has undone what its journal says was not finished."""
        # Where open files cannot be removed, the folder stays until the system empties it.
        with TemporaryDirectory(prefix="tfbus-", ignore_cleanup_errors=True) as folder:
            copy = Path(folder, "copy.db3")
            shutil.copyfile(path, copy)
            for journal in journals:
                suffix = journal.name.removeprefix(path.name)
                shutil.copyfile(journal, _beside(copy, suffix))
                if suffix == "-journal":
                    # At its very end it could name another file, which SQLite would remove.
                    with _beside(copy, suffix).open("ab") as file:
                        file.write(bytes(16))
            with closing(sqlite3.connect(copy)) as database:
                database.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
                database.execute("SELECT COUNT(*) FROM sqlite_master").fetchall()
            self._open(copy, "immutable=1")

    def _read(self) -> None:
        tables = {name for (name,) in self._file.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if not tables >= {"topics", "messages"}:
            raise RecordingError("an SQLite file, but no recording of ROS 2", path=str(self._path), reason="foreign")
        definitions = self._definitions() if "message_definitions" in tables else {}
        columns = {row[1] for row in self._file.execute("PRAGMA table_info(topics)")}
        quality = "offered_qos_profiles" if "offered_qos_profiles" in columns else "''"
        topics = self._query(f"SELECT id, name, type, serialization_format, {quality} FROM topics")
        self._numbered: dict[int, Channel] = {}
        for number, name, kind, encoding, profiles in _bounded(topics):
            if not all(isinstance(text, str) for text in (name, kind, encoding)):
                # Its messages are counted as those of a topic that is not described.
                continue
            schema_encoding, schema = definitions.get(kind, ("", b""))
            metadata = {"offered_qos_profiles": str(profiles)} if profiles else {}
            self._numbered.setdefault(number, Channel(name, kind, encoding, schema_encoding, schema, metadata))
        ends = ", ".join(f"(SELECT {each}(timestamp) FROM messages WHERE {_IS_STAMP})" for each in ("MIN", "MAX"))
        self.start: int | None
        self.end: int | None
        self.start, self.end = self._query(f"SELECT {ends}").fetchone()
        # The table itself is counted: an index of it may be damaged.
        counted = f"SELECT topic_id, COUNT(*) FROM messages NOT INDEXED WHERE {_IS_STAMP} GROUP BY topic_id"
        self._counts: dict[Any, int] = dict(_bounded(self._query(counted)))
        untimed = f"SELECT COUNT(*) FROM messages NOT INDEXED WHERE NOT {_IS_STAMP}"
        (self._untimed,) = self._query(untimed).fetchone()

    def _definitions(self) -> dict[str, tuple[str, bytes]]:
        """Encoding and text of the definition of each type; files before ROS 2 Iron have none."""
        rows = self._query("SELECT topic_type, encoding, encoded_message_definition FROM message_definitions")
        return {str(kind): (str(encoding), str(text).encode()) for kind, encoding, text in _bounded(rows)}

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
            if self._untimed:
                yield lost_message(now, f"{self._untimed:,} messages have a timestamp that is no integer")
            promised = {channel: count or 0 for channel, count in self.channels.items() if wanted(channel)}
            yield from shortfalls(now, promised, read)
        if not self.finished and (until is None or until >= (self.end or 0)):
            yield unfinished(now, read, "its writer did not finish it, and its last transaction is undone")

    def _blocks(self, wanted: Wanted, since: int | None, until: int | None) -> Iterator[list[StoredMessage]]:
        chosen = {number: channel for number, channel in self._numbered.items() if wanted(channel)}
        limits = [("timestamp >= ?", since), ("timestamp <= ?", until)]
        conditions = [
            _IS_STAMP,
            f"topic_id IN ({', '.join('?' * len(chosen))})",
            *(text for text, limit in limits if limit is not None),
        ]
        values = [*chosen, *(limit for _, limit in limits if limit is not None)]
        query = f"SELECT timestamp, topic_id, CAST(data AS BLOB) FROM messages WHERE {' AND '.join(conditions)}"
        now = self.start or 0
        block: list[StoredMessage] = []
        size = 0
        try:
            for received, number, payload in self._query(f"{query} ORDER BY timestamp, id", values):
                # A number that only SQLite takes for that of a topic is missed at the end.
                if (channel := chosen.get(number)) is not None:
                    block.append((received, channel, payload or b""))
                    size += len(payload or b"")
                if len(block) == _BLOCK or size > _BLOCK_BYTES:
                    now = received
                    yield block
                    block, size = [], 0
        except _DAMAGE as error:
            now = block[-1][0] if block else now
            block.append(lost_message(now, f"nothing more can be read: {_in_words(error)}"))
        yield block


def _in_words(error: Exception) -> str:
    return "it takes more steps than a file of its size needs" if str(error) == "interrupted" else str(error)


def _beside(path: Path, suffix: str) -> Path:
    """The path of a file that SQLite has beside another one."""
    return path.with_name(f"{path.name}{suffix}")


def _is_used(journal: Path) -> bool:
    """Whether a journal has content; one that is no longer needed may stay, empty or with a head of zeros."""
    if not journal.is_file():
        return False
    with journal.open("rb") as file:
        return file.read(1) not in (b"", b"\0")


def _bounded(rows: sqlite3.Cursor) -> Iterator[tuple[Any, ...]]:
    """The rows of a table that is kept in memory; raises `sqlite3.DataError` beyond `MAX_DESCRIBED`."""
    size = 0
    for row in rows:
        size += DESCRIPTION + sum(len(value) for value in row if isinstance(value, (str, bytes)))
        if size > MAX_DESCRIBED:
            raise sqlite3.DataError(f"its topics take more than {MAX_DESCRIBED:,} bytes, which is the bound")
        yield row
