"""`open_recording`, which reads the transforms of a file of ROS 1, ROS 2 or tfbus message by message, by log time."""

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Final, NamedTuple, Self, TypeAlias

from tfbus.errors import InvalidTransformError, MissingRecordingError, RecordingError, pip_install
from tfbus.frames import is_frame
from tfbus.geometry.stamped import Batch, TransformStamped
from tfbus.plain import printable
from tfbus.recording.formats.storage import Channel, Packed, Storage, Stored, StoredMessage, blocks_of, pack
from tfbus.recording.formats.transforms import (
    FOXGLOVE_TYPES,
    TF_TYPES,
    ChannelDecoder,
    ColumnDecoder,
    Columns,
    holds_transforms,
)
from tfbus.tf_message import MalformedMessageError


class RecordedMessage(NamedTuple):
    """The transforms of one message of a recording."""

    received: int
    """The log time in ns: the time of recording, not a stamp."""
    batch: Batch
    """The valid transforms."""
    errors: tuple[InvalidTransformError | MalformedMessageError, ...]
    """The reason why others were refused; with ``"damaged"``, the part of the file that is lost here, and with
    ``"unfinished"``, why messages may be missing at the end."""

    @property
    def is_report(self) -> bool:
        """Whether it stands for no message of the file, but for what is missing there."""
        return any(error.reason in ("damaged", "unfinished") for error in self.errors)


MOVING_TOPIC: Final = "tf"
STATIC_TOPIC: Final = "tf_static"

Topics: TypeAlias = str | Iterable[str] | Mapping[str, str] | None


class Choice(NamedTuple):
    """The way in which a channel is read."""

    static: bool
    prefix: str


class Selection:
    """Decides which channels are read.

    Parameters
    ----------
    topics : str, iterable of str, or mapping of str to str, optional
        Topics, with a prefix for each if it is a mapping. By default ``/tf``, ``/tf_static``, and all topics with
        Foxglove's transforms outside of namespaces.
    prefix : str
        Put before the names of all frames.
    namespaces : bool
        Whether ``tf`` and ``tf_static`` in all namespaces are read, each under the prefix of its namespace.

    Raises
    ------
    ValueError
        If both `topics` and `namespaces` are given, or a prefix begins with a slash.
    TypeError
        If a topic or a prefix is no string.
    """

    def __init__(self, topics: Topics = None, prefix: str = "", namespaces: bool = False) -> None:
        if topics is not None and namespaces:
            raise ValueError("topics and namespaces are two ways to choose: give one of them")
        if isinstance(topics, str):
            topics = (topics,)
        pairs = topics.items() if isinstance(topics, Mapping) else ((topic, "") for topic in topics or ())
        self._prefixes: dict[str, str] | None = None if topics is None else {}
        for topic, its_prefix in pairs:
            if not isinstance(topic, str):
                raise TypeError(f"a topic must be a str, not {topic!r}")
            assert self._prefixes is not None
            self._prefixes[topic.removeprefix("/")] = its_prefix
        self._prefix = prefix
        self._namespaces = namespaces
        for each in (prefix, *(self._prefixes or {}).values()):
            if each != "" and not is_frame(each):
                raise ValueError(f"a prefix must not start with '/', got {each!r}")

    @property
    def topics(self) -> list[str]:
        """The topics that were asked for by their names, without leading slashes."""
        return list(self._prefixes or ())

    def choose(self, channel: Channel) -> Choice | None:
        """The way in which a channel is read; None if it is not."""
        if not holds_transforms(channel):
            return None
        name = channel.topic.removeprefix("/")
        namespace, _, last = name.rpartition("/")
        static = last == STATIC_TOPIC or (last.endswith("_static") and channel.type in TF_TYPES)
        own = last in (MOVING_TOPIC, STATIC_TOPIC)
        if self._prefixes is not None:
            return Choice(static, self._prefix + self._prefixes[name]) if name in self._prefixes else None
        if self._namespaces:
            inner = f"{namespace}/" if namespace else ""
            return Choice(static, self._prefix + inner) if own and not inner.startswith("/") else None
        if name in (MOVING_TOPIC, STATIC_TOPIC) or (channel.type in FOXGLOVE_TYPES and not own):
            return Choice(static, self._prefix)
        return None


def looks_like_transforms(channel: Channel) -> bool:
    """Whether a user may expect transforms on a channel: by its type, or by its name."""
    last = channel.topic.rpartition("/")[2]
    return channel.type in TF_TYPES or channel.type in FOXGLOVE_TYPES or last in (MOVING_TOPIC, STATIC_TOPIC)


class Block:
    """Some successive messages.

    Parameters
    ----------
    content : Packed or list of StoredMessage
    columns : ColumnDecoder
    decode : callable
        Decodes one message.
    """

    def __init__(
        self,
        content: Stored,
        columns: ColumnDecoder,
        decode: Callable[[StoredMessage], RecordedMessage],
    ) -> None:
        self._content = content
        self._columns = columns
        self._decode = decode

    def __len__(self) -> int:
        return self._content.size if isinstance(self._content, Packed) else len(self._content)

    @property
    def stored(self) -> list[StoredMessage]:
        """The messages as they are in the file."""
        return self._content.stored() if isinstance(self._content, Packed) else self._content

    def columns(self) -> list[Columns] | None:
        """All samples, by frame and authority; None if the messages have to be decoded one by one."""
        packed = self._content if isinstance(self._content, Packed) else pack(self._content)
        return None if packed is None else self._columns.decode(packed)

    def messages(self) -> Iterator[RecordedMessage]:
        """All messages, one by one."""
        return map(self._decode, self.stored)


class DecodedBlock:
    """Messages that are decoded already, such as those with the static transforms from before a reading."""

    def __init__(self, messages: Iterable[RecordedMessage]) -> None:
        self._messages = messages

    def __len__(self) -> int:
        return len(self._messages) if isinstance(self._messages, Sequence) else 0

    def columns(self) -> None:
        """None: they are decoded already."""

    def messages(self) -> Iterator[RecordedMessage]:
        """All messages, one by one."""
        return iter(self._messages)


_FIRST_BYTES: Final = 16
_SHOWN: Final = 10
_JOINT_TYPES: Final = ("sensor_msgs/msg/JointState", "sensor_msgs/JointState")


@dataclass(frozen=True, slots=True)
class RecordedTopic:
    """A topic of a recording.

    Parameters
    ----------
    name, type : str
    count : int or None
        The number of its messages; None if only reading the whole file would tell.
    read : bool
        Whether its messages are read as transforms.
    ignored : bool
        Whether its name or its type promises transforms, and it is not read.
    """

    name: str
    type: str
    count: int | None
    read: bool
    ignored: bool


class Recording:
    """An open recording, as `open_recording` gives it; close it, or use it in a ``with``.

    Parameters
    ----------
    path : Path
    storage : Storage
    selection : Selection
        Decides which topics are read.

    Attributes
    ----------
    path : Path
    finished : bool
        Whether the file has the end that a writer gives it. If not, the last messages may be missing, and a reading of
        the end reports ``"unfinished"``.
    """

    def __init__(self, path: Path, storage: Storage, selection: Selection) -> None:
        self.path = path
        self.finished = storage.finished
        self._storage: Storage | None = storage
        self._selection = selection
        self._decoders: dict[Channel, ChannelDecoder] = {}
        self._unwanted: set[Channel] = set()
        self._check_topics(storage)

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
        if not self._opened.complete:
            return None
        return sum(count or 0 for channel, count in self._opened.channels.items() if self._is_wanted(channel))

    @property
    def topics(self) -> tuple[RecordedTopic, ...]:
        """All topics that are known, sorted by name; without an index, these are those met so far by reading."""
        found: dict[tuple[str, str], RecordedTopic] = {}
        for channel, count in self._opened.channels.items():
            key = channel.topic, channel.type
            before = found.get(key)
            if before is not None:
                count = None if count is None or before.count is None else before.count + count
            read = self._is_wanted(channel)
            found[key] = RecordedTopic(*key, count, read, not read and looks_like_transforms(channel))
        return tuple(found[key] for key in sorted(found))

    @property
    def remarks(self) -> tuple[str, ...]:
        """The ignored topics, and ignored files of a folder, that may hold transforms."""
        ignored = [topic for topic in self.topics if topic.ignored]
        joints = [] if any(topic.read for topic in self.topics) else [t for t in self.topics if t.type in _JOINT_TYPES]
        return (*self._opened.remarks, *map(_remark, ignored), *map(_remark_on_joints, joints))

    def messages(self, since: int | None = None, until: int | None = None) -> Iterator[RecordedMessage]:
        """Iterate over the messages on the chosen topics, in the order of their log times.

        Damage raises nothing: it is reported in the `errors` of a message, and reading continues behind it. An MCAP
        file without an index, because its writer was killed, is read in the order of the file. At the end of a reading
        without limits, the number of messages is compared with what the file promises. A reading that reaches the end
        of a file without its index ends with a report, an error whose reason is ``"unfinished"``.

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
            yield from self._latched(storage, since)
        yield from map(self._message, storage.messages(self._is_wanted, since, until))

    def blocks(self, since: int | None = None, until: int | None = None) -> Iterator[Block | DecodedBlock]:
        """All messages as `messages` gives them, in blocks that can be decoded at once; for `load` and `summarise`."""
        storage = self._opened
        columns = ColumnDecoder(self._decoders)
        if since is not None:
            yield DecodedBlock(list(self._latched(storage, since)))
        for content in blocks_of(storage, self._is_wanted, since, until):
            yield Block(content, columns, self._message)

    def _latched(self, storage: Storage, since: int) -> Iterator[RecordedMessage]:
        """The newest static transform of each frame from before a log time."""
        latched: dict[str, TransformStamped] = {}
        for stored in storage.messages(self._is_static, None, since - 1):
            for sample in self._message(stored).batch:
                # In the order of the samples that stay.
                latched.pop(sample.child, None)
                latched[sample.child] = sample
        for sample in latched.values():
            yield RecordedMessage(since, (sample,), ())

    def _is_wanted(self, channel: Channel) -> bool:
        if channel in self._decoders:
            return True
        if channel in self._unwanted:
            return False
        choice = self._selection.choose(channel)
        if choice is None:
            self._unwanted.add(channel)
        else:
            self._decoders[channel] = ChannelDecoder(channel, choice.static, choice.prefix)
        return choice is not None

    def _is_static(self, channel: Channel) -> bool:
        return self._is_wanted(channel) and self._decoders[channel].static

    def _message(self, stored: StoredMessage) -> RecordedMessage:
        received, channel, payload = stored
        if isinstance(channel, MalformedMessageError):
            return RecordedMessage(received, (), (channel,))
        try:
            samples, errors = self._decoders[channel].decode(payload)
        except MalformedMessageError as error:
            # Its traceback would keep the payload.
            return RecordedMessage(received, (), (MalformedMessageError(error.reason, error.detail),))
        return RecordedMessage(received, tuple(filter(None, samples)), tuple(errors))

    def _check_topics(self, storage: Storage) -> None:
        """Raise `RecordingError` if a topic that was asked for is not there, as far as the file tells."""
        for topic in self._selection.topics if storage.complete else ():
            read = any(
                self._is_wanted(channel) for channel in storage.channels if channel.topic.removeprefix("/") == topic
            )
            if not read:
                kinds = {channel.type for channel in storage.channels if channel.topic.removeprefix("/") == topic}
                with_transforms = sorted({each.topic for each in storage.channels if looks_like_transforms(each)})
                why = f"has type {' and '.join(sorted(kinds))}, which holds no transforms" if kinds else "is not there"
                there = f"; topics with transforms: {', '.join(with_transforms[:_SHOWN])}" if with_transforms else ""
                raise RecordingError(f"topic {topic!r} {why}{there}", path=str(self.path), reason="no such topic")

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
            raise ValueError(f"the recording {printable(str(self.path))} is closed")
        return self._storage


def _remark(topic: RecordedTopic) -> str:
    count = "" if topic.count is None else f"{topic.count:,} messages on "
    return f"not read: {count}topic {topic.name} of type {topic.type or 'unknown'}"


def _remark_on_joints(topic: RecordedTopic) -> str:
    return f"no transforms, but {topic.name} has the positions of joints: load_joint_states reads them with a URDF"


def open_recording(
    path: str | os.PathLike[str], *, topics: Topics = None, prefix: str = "", namespaces: bool = False
) -> Recording:
    """Open a recording of ROS 1 (``.bag``), of ROS 2 (a folder, ``.db3``, ``.mcap``) or of Foxglove (``.mcap``).

    The first bytes of the file decide which format it has, not its name. It may be unfinished, cut off or damaged.

    Parameters
    ----------
    path : str or path-like
    topics : str, iterable of str, or mapping of str to str, optional
        The topics to read; a mapping gives each a prefix for the names of its frames: ``{"/robot1/tf": "robot1/"}``. A
        topic is static if its name ends with ``_static``. By default ``/tf``, ``/tf_static``, and all topics of
        Foxglove's ``FrameTransform`` and ``FrameTransforms`` that are no ``tf`` of a namespace.
    prefix : str
        Put before the names of all frames.
    namespaces : bool
        Read ``tf`` and ``tf_static`` of all namespaces; the frames of ``/robot1/tf`` get the prefix ``robot1/``.

    Raises
    ------
    RecordingError
        If the file is missing or empty, cannot be read, was cut off before its first message, or is no recording; if a
        topic in `topics` is not there, or has no transforms; or if the packages that read it are not installed.
    ValueError, TypeError
        If both `topics` and `namespaces` are given, or a prefix begins with a slash.

    Notes
    -----
    The sizes that a file claims or unfolds to are bounded, and what exceeds its bound is left out and reported: 8 MiB
    for a message with transforms, 256 MiB for any other, for a chunk (and a million messages in it) and for a value in
    SQLite, 4 MiB for ``metadata.yaml``. A compressed file in a folder unfolds to at most 100 times its size, or 64 MiB
    if that is more, in a nameless temporary file. An index of more than 64 MiB is not used. The descriptions of all
    channels and types take at most 64 MiB. Messages of chunks that overlap in time are sorted in memory up to 512 MiB.
    With all that, reading a hostile file takes at most 2 GiB of memory.

    An SQLite file beside which a writer has left a journal is copied to a temporary folder, where SQLite undoes the
    last transaction; if the writer still runs, the file is read in its place.
    """
    file = Path(path)
    selection = Selection(topics, prefix, namespaces)
    storage = open_storage(file)
    try:
        return Recording(file, storage, selection)
    except BaseException:
        storage.close()
        raise


def open_storage(file: Path) -> Storage:
    """Open all channels of a recording; raises `RecordingError` as `open_recording`."""
    try:
        return _open_storage(file, folders=True)
    except ImportError as error:
        problem = f"to read it, tfbus needs some packages more: {pip_install('bag')} ({error})"
        raise RecordingError(problem, path=str(file), reason="missing extra") from error
    except FileNotFoundError as error:
        raise MissingRecordingError(path=str(file)) from error
    except OSError as error:
        raise RecordingError(
            f"it cannot be read: {error.strerror or error}", path=str(file), reason="unreadable"
        ) from error


def _open_storage(path: Path, folders: bool = False) -> Storage:
    if folders and path.is_dir():
        from tfbus.recording.formats.folder import FolderStorage

        return FolderStorage(path, _open_storage)
    with path.open("rb") as file:
        first = file.read(_FIRST_BYTES)
    if not first:
        raise RecordingError("the file is empty", path=str(path), reason="empty")
    from tfbus.recording.formats import folder, mcap, mcap_records, ros1

    formats: list[tuple[bytes, Callable[[Path], Storage]]] = [
        (mcap_records.MAGIC, mcap.McapStorage),
        (folder.MAGIC, folder.SqliteStorage),
        (ros1.MAGIC, ros1.Ros1Storage),
    ]
    for magic, storage in formats:
        if first.startswith(magic):
            return storage(path)
        if magic.startswith(first):
            raise RecordingError(f"the file ends after {len(first)} bytes", path=str(path), reason="truncated")
    raise RecordingError("it is no recording of ROS 1 (.bag) or ROS 2 (.mcap, .db3)", path=str(path), reason="foreign")
