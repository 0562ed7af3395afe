"""Folders of ROS 2: one recording in several files, which may be compressed."""

import heapq
import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from operator import itemgetter
from pathlib import Path
from tempfile import NamedTemporaryFile, TemporaryDirectory, gettempdir
from typing import Any, BinaryIO, Final, cast

from tfbus.errors import MissingRecordingError, RecordingError
from tfbus.recording.formats._bounds import MAX_METADATA, max_unpacked
from tfbus.recording.formats._packed import Packed, Stored, batches, blocks_of
from tfbus.recording.formats._storage import (
    Channel,
    Storage,
    StoredMessage,
    Wanted,
    lost_message,
    shortfalls,
)
from tfbus.recording.formats._unfold import UnfoldError, unfold_file

SUFFIXES: Final = (".mcap", ".db3")
COMPRESSED: Final = ".zstd"
METADATA: Final = "metadata.yaml"


class FolderStorage:
    """A `Storage` of the recording in one folder: the files that ``metadata.yaml`` names.

    Without it, because the writer was killed, these are all files with the endings of recordings; of a compressed file
    and an uncompressed one of the same name, the uncompressed one.

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
        self.finished = not refused and all(file.finished for file in self._files)

    def _choose(self, path: Path) -> list[Path]:
        """The files of the recording; those that are not read are noted as remarks."""
        present = sorted(file for file in path.iterdir() if Path(file.name.removesuffix(COMPRESSED)).suffix in SUFFIXES)
        metadata = self._read_metadata(path / METADATA)
        if metadata is not None:
            names, self._promised = metadata
            chosen = [path / name for name in names]
            why = f"{METADATA} does not name it"
        else:
            plain = {file.name for file in present}
            chosen = [file for file in present if file.name.removesuffix(COMPRESSED) not in plain - {file.name}]
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
        # A parser of YAML raises many kinds of errors; deep nesting is one of recursion.
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
        """The channels of all files; while some file has not told all of its own, no count is known."""
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
        """The messages of `messages`, many at once; those of a single file are packed if that file packs them."""
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
        """A report for each topic of which the metadata promise messages that the files neither promise nor have."""
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
    """A name in the metadata; a text of anything else, such as of lists that are in each other, could be endless."""
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
        # What reads it keeps it open; nothing of it stays if the program is killed.
        return open_file(file)


@contextmanager
def _unpacked(path: Path) -> Iterator[Path]:
    """A path of the unpacked file for as long as it takes to open it.

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
    """A temporary file that can get a name, where the system has such files; else one that has a name already."""
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
