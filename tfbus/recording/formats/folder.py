"""SQLite files of ROS 2, and folders of ROS 2: one recording in several files, which may be compressed.

A writer that is killed leaves a journal beside its SQLite file, and SQLite needs it to recover the file. The recovery
writes into both, so SQLite gets a copy. If the writer may still be running, the original is read, under SQLite's locks.
A column of SQLite holds values of any type, whatever its declaration: timestamps that are not integers are counted.

`FolderStorage` opens the files that ``metadata.yaml`` names, SQLite or MCAP, and merges their messages.
"""

import heapq
import os
import shutil
import sqlite3
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from operator import itemgetter
from pathlib import Path
from tempfile import NamedTemporaryFile, TemporaryDirectory, gettempdir
from typing import Any, BinaryIO, Final, cast
from urllib.parse import quote

from tfbus.errors import MissingRecordingError, RecordingError
from tfbus.recording.formats.storage import (
    DESCRIPTION,
    MAX_DESCRIBED,
    MAX_METADATA,
    MAX_OTHER_MESSAGE,
    MIB,
    Channel,
    Packed,
    Storage,
    Stored,
    StoredMessage,
    UnfoldError,
    Wanted,
    batches,
    blocks_of,
    lost_message,
    max_unpacked,
    select,
    shortfalls,
    unfinished,
    unfold_file,
)

_DAMAGE = (sqlite3.Error, UnicodeDecodeError, MemoryError)
_BLOCK: Final = 256
_BLOCK_BYTES: Final = 16 * MIB
_STEPS: Final = 100_000
"""Steps of SQLite's virtual machine between two checks of their number."""
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
        If the file is damaged, or is not a recording.
    """

    complete: Final = True
    remarks: Final = ()

    def __init__(self, path: Path) -> None:
        self._path = path
        self._steps = 0
        journals = [each for each in (_beside(path, "-journal"), _beside(path, "-wal")) if _is_used(each)]
        self.finished: bool = not journals
        try:
            if not journals:
                # Without "immutable", SQLite would create an empty log beside the recording.
                self._open(path, "immutable=1")
            elif _beside(path, "-wal") in journals and not _beside(path, "-shm").exists():
                # Nobody else has it open, and SQLite would create the file "-shm".
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
        """Open a file and read its topics."""
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
        """Open a copy of a file, in which SQLite has undone the unfinished transaction of its journal."""
        # Where open files cannot be removed, the folder stays until the system empties it.
        with TemporaryDirectory(prefix="tfbus-", ignore_cleanup_errors=True) as folder:
            copy = Path(folder, "copy.db3")
            shutil.copyfile(path, copy)
            for journal in journals:
                suffix = journal.name.removeprefix(path.name)
                shutil.copyfile(journal, _beside(copy, suffix))
                if suffix == "-journal":
                    # The end of a journal could name another file, which SQLite would remove: overwrite it.
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
                # Its messages are counted as messages of a topic that is not described.
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
                yield lost_message(now, f"{self._untimed:,} messages have a timestamp that is not an integer")
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
                # SQLite also finds a number of another type; the count at the end reports such a message.
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
    """Whether a journal has content; SQLite may leave an old one, empty or with a head of zeros."""
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


SUFFIXES: Final = (".mcap", ".db3")
COMPRESSED: Final = ".zstd"
METADATA: Final = "metadata.yaml"


class FolderStorage:
    """A `Storage` of the recording in one folder: the files that ``metadata.yaml`` names.

    If it is missing, because the writer was killed, all files with the endings of recordings are read. If a file is
    there compressed and uncompressed, the uncompressed one is read.

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
        self._files: list[Storage] = []
        self._refused: list[str] = []
        self.remarks: list[str] = []
        self._promised: dict[str, int] | None = None
        refused: list[RecordingError] = []
        try:
            for file in self._choose(path):
                try:
                    self._files.append(_open(file, open_file))
                except RecordingError as error:
                    refused.append(error)
                except FileNotFoundError:
                    refused.append(MissingRecordingError(path=str(file)))
            if not self._files:
                if refused:
                    raise refused[0]
                raise RecordingError(
                    "a folder without files that end in .mcap or .db3", path=str(path), reason="foreign"
                )
        except BaseException:
            self.close()
            raise
        self._refused = list(map(str, refused))
        self.finished: bool = not refused and all(file.finished for file in self._files)

    def _choose(self, path: Path) -> list[Path]:
        """The files of the recording; a remark is noted for each ignored file."""
        present = sorted(file for file in path.iterdir() if Path(file.name.removesuffix(COMPRESSED)).suffix in SUFFIXES)
        metadata = self._read_metadata(path / METADATA)
        if metadata is not None:
            named, self._promised = metadata
            chosen = [path / name for name in named]
            why = f"{METADATA} does not name it"
        else:
            names = {file.name for file in present}
            chosen = [file for file in present if file.name.removesuffix(COMPRESSED) not in names - {file.name}]
            why = "the uncompressed file of the same name is there"
        self.remarks += [f"{file.name} is ignored: {why}" for file in present if file not in chosen]
        return chosen

    def _read_metadata(self, path: Path) -> tuple[list[str], dict[str, int]] | None:
        """The names of the files, and the number of messages by topic; None if there are no usable metadata."""
        try:
            if path.stat().st_size > MAX_METADATA:
                raise ValueError(f"it has more than {MAX_METADATA:,} bytes, which is the bound")
            known = _as_yaml(path.read_bytes())["rosbag2_bagfile_information"]
            # Old versions of ROS 2 put the name of the folder before it.
            names = [Path(_text(name)).name for name in known["relative_file_paths"]]
            counts = Counter[str]()
            for topic in known.get("topics_with_message_count") or ():
                counts[_text(topic["topic_metadata"]["name"])] += int(topic["message_count"])
            if not names:
                raise ValueError("it names no file")
        except FileNotFoundError:
            return None
        # A parser of YAML raises many kinds of errors; deep nesting is a `RecursionError`.
        except Exception as error:  # noqa: BLE001
            reason = " ".join(str(error).split())[:200] or type(error).__name__
            self.remarks.append(f"{METADATA} is ignored, as it cannot be read: {reason}")
            return None
        return list(dict.fromkeys(names)), dict(counts)

    @property
    def start(self) -> int | None:
        """The log time of the first message, in ns."""
        return min((file.start for file in self._files if file.start is not None), default=None)

    @property
    def end(self) -> int | None:
        """The log time of the last message, in ns."""
        return max((file.end for file in self._files if file.end is not None), default=None)

    @property
    def complete(self) -> bool:
        """Whether all files are complete."""
        return all(file.complete for file in self._files)

    @property
    def channels(self) -> Mapping[Channel, int | None]:
        """The channels of all files; no count is known until every file knows all of its channels."""
        complete = self.complete
        return {
            channel: count if complete else None for file in self._files for channel, count in file.channels.items()
        }

    def close(self) -> None:
        """Close the files."""
        for file in self._files:
            file.close()

    def messages(self, wanted: Wanted, since: int | None = None, until: int | None = None) -> Iterator[StoredMessage]:
        """Iterate over the messages of all files, as `Storage.messages`."""
        now = (self.start or 0) if since is None else since
        for problem in self._refused:
            yield lost_message(now, problem)
        read: Counter[Channel] = Counter()
        files = [file.messages(wanted, since, until) for file in self._files]
        for stored in files[0] if len(files) == 1 else heapq.merge(*files, key=itemgetter(0)):
            now = stored[0]
            read[cast(Channel, stored[1])] += 1
            yield stored
        if since is None and until is None and self._promised is not None:
            yield from self._shortfalls(now, wanted, read)

    def packed(self, wanted: Wanted, since: int | None = None, until: int | None = None) -> Iterator[Stored]:
        """The messages of `messages`, many at once; packed if a single file has them and packs them."""
        if len(self._files) > 1 or self._refused:
            yield from batches(self.messages(wanted, since, until))
            return
        read: Counter[Channel] = Counter()
        now = (self.start or 0) if since is None else since
        for block in blocks_of(self._files[0], wanted, since, until):
            if isinstance(block, Packed):
                read.update(block.counts())
                now = int(block.received[-1])
            else:
                read.update(cast(Channel, channel) for _, channel, _ in block)
                now = block[-1][0]
            yield block
        if since is None and until is None and self._promised is not None:
            yield from batches(self._shortfalls(now, wanted, read))

    def _shortfalls(self, now: int, wanted: Wanted, read: Counter[Channel]) -> Iterator[StoredMessage]:
        """Report each topic whose messages the metadata promise, but the files neither promise nor have."""
        assert self._promised is not None
        known: dict[str, list[Channel]] = {}
        for channel in self.channels:
            known.setdefault(channel.topic, []).append(channel)
        for topic, count in self._promised.items():
            channels = known.get(topic, [])
            if not channels and count:
                yield lost_message(now, f"{METADATA} promises {count:,} messages on {topic!r}, which no file has")
            elif channels and all(map(wanted, channels)):
                found = dict.fromkeys(channels, 0)
                yield from shortfalls(now, {**found, channels[0]: count}, read)


def _text(value: object) -> str:
    """A name in the metadata; `ValueError` for other types, because the text of a recursive list could be endless."""
    if not isinstance(value, str):
        raise TypeError(f"a name is a {type(value).__name__}")
    return value


def _as_yaml(text: bytes) -> Any:
    from ruamel.yaml import YAML

    return YAML(typ="safe").load(text)


def _open(path: Path, open_file: Callable[[Path], Storage]) -> Storage:
    if path.suffix != COMPRESSED:
        return open_file(path)
    with _unpacked(path) as file:
        # The reader keeps the open file, whose name is removed: nothing stays if the program is killed.
        return open_file(file)


@contextmanager
def _unpacked(path: Path) -> Iterator[Path]:
    """A path of the unpacked file, until the end of the ``with``; an open file stays readable.

    Raises
    ------
    RecordingError
        If the file is damaged, or unfolds to more than `max_unpacked`.
    """
    with path.open("rb") as source, _nameless_file() as target:
        try:
            unfold_file(source, target, max_unpacked(path.stat().st_size))
        except UnfoldError as error:
            raise RecordingError(str(error), path=str(path), reason="damaged") from error
        target.flush()
        # Where open files cannot be removed, the folder stays until the system empties it.
        with TemporaryDirectory(prefix="tfbus-", ignore_cleanup_errors=True) as folder:
            name = Path(folder, path.stem)
            _give_name(target, name)
            yield name


def _nameless_file() -> BinaryIO:
    """A temporary file without a name; where the system has no such files, one with a name."""
    with suppress(OSError, AttributeError):
        return os.fdopen(os.open(gettempdir(), os.O_TMPFILE | os.O_RDWR, 0o600), "w+b")
    return cast(BinaryIO, NamedTemporaryFile(prefix="tfbus-"))


def _give_name(file: BinaryIO, name: Path) -> None:
    """Give an open file a further name."""
    if isinstance(file.name, str):
        os.link(file.name, name)
        return
    # Without a descriptor of a folder, `os.link` would link to the symbolic link.
    folder = os.open(name.parent, os.O_RDONLY)
    try:
        os.link(f"/proc/self/fd/{file.fileno()}", name, src_dir_fd=folder, follow_symlinks=True)
    finally:
        os.close(folder)
