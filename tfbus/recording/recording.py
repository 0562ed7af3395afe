"""From a file to a tree: `open_recording` gives the messages of a recording one by one, `load` inserts all of them.

The first bytes of a file choose a `Storage` in `tfbus.recording.formats`, which gives the payloads of messages by log
time. `Selection` chooses the channels. Then two ways lead from bytes to samples, and both give the same bits:

* `Recording.messages` decodes one message after the other (`ChannelDecoder`), with an error for each bad transform.
* `Recording.blocks` gives many messages at once. `Block.columns` decodes all of them with numpy (`ColumnDecoder`), if
  nothing in the block has to be judged; otherwise `Block.messages` decodes them one by one.

`fill` tries the columns first, and appends them to histories that exist already. Where an edge is new or changes, each
sample is judged: by `max_translation`, by `SpeedLimit`, and by `without_loops`. Damage raises nothing anywhere: it is
a message without samples whose errors say what is lost, and `Problems` counts it.
"""

import logging
import math
import os
from collections import Counter
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from pathlib import Path
from types import TracebackType
from typing import Final, NamedTuple, Self, TypeAlias

from tfbus.errors import InvalidTransformError, MissingRecordingError, RecordingError, pip_install
from tfbus.frames import is_frame
from tfbus.geometry.stamped import MAX_TRANSLATION, Batch, TransformStamped, is_within, not_physical
from tfbus.geometry.uncertain import Belief, with_belief
from tfbus.plain import printable
from tfbus.recording.formats.covariances import SUFFIX, Key, beliefs_in, holds_covariances
from tfbus.recording.formats.storage import Channel, Packed, Storage, Stored, StoredMessage, blocks_of, pack
from tfbus.recording.formats.trajectories import TrajectoryStorage, is_text
from tfbus.recording.formats.transforms import (
    FOXGLOVE_TYPES,
    TF_TYPES,
    ChannelDecoder,
    ColumnDecoder,
    Columns,
    bounded,
    holds_transforms,
    needs_child,
)
from tfbus.rows import Row
from tfbus.stamps import SECOND, is_real
from tfbus.tf_message import MalformedMessageError
from tfbus.tree.cycles import NewestEdge, admit
from tfbus.tree.forest import Forest
from tfbus.tree.tree import TransformTree, forest_of


class RecordedMessage(NamedTuple):
    """The transforms of one message of a recording.

    Examples
    --------
    >>> from tfbus.recording import open_recording
    >>> with open_recording("small.bag") as recording:
    ...     message = next(iter(recording.messages()))
    >>> format_stamp(message.received)
    '99.000 s'
    """

    received: int
    """The log time in ns: the time of recording, not a stamp."""
    batch: Batch
    """The valid transforms."""
    errors: tuple[InvalidTransformError | MalformedMessageError, ...]
    """The reasons for refusing the other transforms. An error with the reason ``"damaged"`` says which part of the file
    is lost here, one with ``"unfinished"`` why messages may be missing at the end."""

    @property
    def is_report(self) -> bool:
        """Whether this is not a message of the file, but the report of a loss there."""
        return any(error.reason in ("damaged", "unfinished") for error in self.errors)


MOVING_TOPIC: Final = "tf"
STATIC_TOPIC: Final = "tf_static"

Topics: TypeAlias = str | Iterable[str] | Mapping[str, str] | None
OdometryTopics: TypeAlias = str | Iterable[str] | Mapping[str, str | None] | None


class Choice(NamedTuple):
    """The way in which a channel is read."""

    static: bool
    prefix: str
    child: str | None = None
    invert: bool = False


class Selection:
    """Decides which channels are read.

    Parameters
    ----------
    topics : str, iterable of str, or mapping of str to str, optional
        Topics, with a prefix for each if it is a mapping. By default ``/tf``, ``/tf_static``, and all topics with
        Foxglove's transforms outside of namespaces.
    prefix : str
        A prefix for the names of all frames.
    namespaces : bool
        Whether ``tf`` and ``tf_static`` in all namespaces are read, each under the prefix of its namespace.
    odometry, invert
        As `open_recording`.

    Raises
    ------
    ValueError
        If both `topics` and `namespaces` are given, or a prefix begins with a slash.
    TypeError
        If a topic or a prefix is not a string.
    """

    def __init__(
        self,
        topics: Topics = None,
        prefix: str = "",
        namespaces: bool = False,
        odometry: OdometryTopics = None,
        invert: bool = False,
    ) -> None:
        odometry = (odometry,) if isinstance(odometry, str) else odometry or ()
        children = odometry if isinstance(odometry, Mapping) else dict.fromkeys(odometry)
        self.odometry = {topic.removeprefix("/"): child for topic, child in children.items()}
        self._invert = invert
        for child in self.odometry.values():
            if child is not None and not is_frame(child):
                raise ValueError(f"the child of a pose must be the name of a frame, got {child!r}")
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
        if holds_covariances(channel):
            # As the topic that they belong to.
            channel = replace(channel, topic=channel.topic.removesuffix(SUFFIX), type="tf2_msgs/msg/TFMessage")
        name = channel.topic.removeprefix("/")
        if name in self.odometry and needs_child(channel) is (self.odometry[name] is not None):
            return Choice(False, self._prefix, self.odometry[name], self._invert)
        if not holds_transforms(channel):
            return None
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
        Decodes one message; gives None for one that tells of later ones.
    pending : mapping
        It is empty, unless messages before have told of these.
    """

    def __init__(
        self,
        content: Stored,
        columns: ColumnDecoder,
        decode: Callable[[StoredMessage], RecordedMessage | None],
        pending: Mapping[Key, Belief],
    ) -> None:
        self._content = content
        self._columns = columns
        self._decode = decode
        self._pending = pending

    def __len__(self) -> int:
        return self._content.size if isinstance(self._content, Packed) else len(self._content)

    @property
    def stored(self) -> list[StoredMessage]:
        """The messages as they are in the file."""
        return self._content.stored() if isinstance(self._content, Packed) else self._content

    def columns(self) -> list[Columns] | None:
        """All samples, by frame and authority; None if the messages have to be decoded one by one."""
        if self._pending:
            return None
        packed = self._content if isinstance(self._content, Packed) else pack(self._content)
        return None if packed is None else self._columns.decode(packed)

    def messages(self) -> Iterator[RecordedMessage]:
        """All messages, one by one."""
        return filter(None, map(self._decode, self.stored))


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


MAX_PENDING: Final = 10_000
"""The most covariances that wait for their transforms."""
_FIRST_BYTES: Final = 64
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
        Whether it is not read although its name or its type promises transforms.

    Examples
    --------
    >>> from tfbus.recording import open_recording
    >>> with open_recording("small.bag") as recording:
    ...     print(recording.topics[0].type)
    tf2_msgs/TFMessage
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
        Whether its writer finished the file. If not, the last messages may be missing, and a reading of the end reports
        ``"unfinished"``.

    Examples
    --------
    >>> from tfbus.recording import open_recording
    >>> with open_recording("small.bag") as recording:
    ...     print([topic.name for topic in recording.topics if topic.read])
    ['/tf', '/tf_static']
    """

    def __init__(self, path: Path, storage: Storage, selection: Selection) -> None:
        self.path = path
        self.finished: bool = storage.finished
        self._storage: Storage | None = storage
        self._selection = selection
        self._decoders: dict[Channel, ChannelDecoder] = {}
        # The channels of covariances, and the ways in which the topics that they belong to are read.
        self._covariances: dict[Channel, Choice] = {}
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
        counts = self._opened.channels.items()
        return sum(count or 0 for each, count in counts if self._is_wanted(each) and each in self._decoders)

    @property
    def topics(self) -> tuple[RecordedTopic, ...]:
        """All known topics, sorted by name; without an index, only the topics that a reading has met so far."""
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
        without limits, the number of messages is compared with the number that the file promises. At the end of a file
        without its index, a reading ends with a report, an error whose reason is ``"unfinished"``.

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

        Examples
        --------
        >>> from tfbus.recording import open_recording
        >>> with open_recording("small.bag") as recording:
        ...     print(next(iter(recording.messages())).batch[0].child)
        laser
        """
        return self._messages(self._opened, since, until)

    def _messages(self, storage: Storage, since: int | None, until: int | None) -> Iterator[RecordedMessage]:
        if since is not None:
            yield from self._latched(storage, since)
        yield from filter(None, map(self._decoding({}), storage.messages(self._is_wanted, since, until)))

    def blocks(self, since: int | None = None, until: int | None = None) -> Iterator[Block | DecodedBlock]:
        """All messages as `messages` gives them, in blocks that can be decoded at once; for `load` and `summarise`.

        Examples
        --------
        >>> from tfbus.recording import open_recording
        >>> with open_recording("small.bag") as recording:
        ...     print(sum(len(block) for block in recording.blocks()))
        789
        """
        storage = self._opened
        columns = ColumnDecoder(self._decoders)
        pending: dict[Key, Belief] = {}
        decode = self._decoding(pending)
        if since is not None:
            yield DecodedBlock(list(self._latched(storage, since)))
        for content in blocks_of(storage, self._is_wanted, since, until):
            yield Block(content, columns, decode, pending)

    def _latched(self, storage: Storage, since: int) -> Iterator[RecordedMessage]:
        """The newest static transform of each frame from before a log time."""
        latched: dict[str, TransformStamped] = {}
        before = storage.messages(self._is_static, None, since - 1)
        for message in filter(None, map(self._decoding({}), before)):
            for sample in message.batch:
                # In the order of the newest samples.
                latched.pop(sample.child, None)
                latched[sample.child] = sample
        for sample in latched.values():
            yield RecordedMessage(since, (sample,), ())

    def _is_wanted(self, channel: Channel) -> bool:
        if channel in self._decoders or channel in self._covariances:
            return True
        if channel in self._unwanted:
            return False
        choice = self._selection.choose(channel)
        if choice is None:
            self._unwanted.add(channel)
        elif holds_covariances(channel):
            self._covariances[channel] = choice
        else:
            self._decoders[channel] = ChannelDecoder(channel, *choice)
        return choice is not None

    def _is_static(self, channel: Channel) -> bool:
        return self._is_wanted(channel) and (self._decoders.get(channel) or self._covariances[channel]).static

    def _decoding(self, pending: dict[Key, Belief]) -> Callable[[StoredMessage], RecordedMessage | None]:
        """A function that decodes the messages of one reading; it gives None for covariances, and keeps them."""
        decoders, covariances = self._decoders, self._covariances

        def decode(stored: StoredMessage) -> RecordedMessage | None:
            received, channel, payload = stored
            if isinstance(channel, MalformedMessageError):
                return RecordedMessage(received, (), (channel,))
            decoder = decoders.get(channel)
            plain = None if decoder is None or decoder.decode_plain is None else decoder.decode_plain(payload)
            if plain is not None:
                return RecordedMessage(received, _believed(plain, pending) if pending else plain, ())
            try:
                if decoder is None:
                    _note_beliefs(pending, channel, payload, covariances[channel].prefix)
                    return None
                samples, errors = decoder.decode(payload)
            except MalformedMessageError as error:
                # Its traceback would keep the payload.
                return RecordedMessage(received, (), (MalformedMessageError(error.reason, error.detail),))
            batch = tuple(filter(None, samples))
            return RecordedMessage(received, _believed(batch, pending) if pending else batch, tuple(errors))

        return decode

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

        for topic, child in self._selection.odometry.items() if storage.complete else ():
            its = [each for each in storage.channels if each.topic.removeprefix("/") == topic]
            if not any(needs_child(each) is (child is not None) for each in its):
                its_types = " and ".join(sorted({each.type for each in its}))
                why = "is not there"
                if any(needs_child(each) is not None for each in its):
                    fault = "needs the name of its child" if child is None else "names its child itself"
                    why = f"of type {its_types} {fault}"
                elif its:
                    why = f"has type {its_types}, which is no odometry and no pose"
                known = sorted({each.topic for each in storage.channels if needs_child(each) is not None})
                there = f"; topics with odometry or poses: {', '.join(known[:_SHOWN])}" if known else ""
                raise RecordingError(f"topic {topic!r} {why}{there}", path=str(self.path), reason="no such topic")

    def close(self) -> None:
        """Close the file; closing again does nothing.

        Examples
        --------
        >>> from tfbus.recording import open_recording
        >>> recording = open_recording("small.bag")
        >>> recording.close()
        """
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


def _note_beliefs(pending: dict[Key, Belief], channel: Channel, payload: bytes, prefix: str) -> None:
    """Keep the covariances of a message for the next transforms; raises `MalformedMessageError`."""
    found = beliefs_in(bounded(payload), channel.encoding == "ros1", prefix)
    lost = len(pending) if len(pending) + len(found) > MAX_PENDING else 0
    if lost:
        pending.clear()
    pending |= found
    if lost:
        raise MalformedMessageError("covariance", f"{lost:,} covariances have come without their transforms")


def _believed(batch: Batch, pending: dict[Key, Belief]) -> Batch:
    """The batch with those of its covariances that have come."""
    beliefs = ((sample, pending.pop(sample._fields[:3], None)) for sample in batch)
    return tuple(sample if belief is None else with_belief(sample, belief) for sample, belief in beliefs)


def _remark(topic: RecordedTopic) -> str:
    count = "" if topic.count is None else f"{topic.count:,} messages on "
    return f"not read: {count}topic {topic.name} of type {topic.type or 'unknown'}"


def _remark_on_joints(topic: RecordedTopic) -> str:
    return f"no transforms, but {topic.name} has the positions of joints: load_joint_states reads them with a URDF"


def open_recording(
    path: str | os.PathLike[str],
    *,
    topics: Topics = None,
    prefix: str = "",
    namespaces: bool = False,
    odometry: OdometryTopics = None,
    invert: bool = False,
) -> Recording:
    """Open a recording of ROS 1 (``.bag``), of ROS 2 (a folder, ``.db3``, ``.mcap``) or of Foxglove (``.mcap``).

    The first bytes of the file decide which format it has, not its name. It may be unfinished, cut off or damaged. A
    text file with a trajectory of TUM, KITTI or EuRoC is a recording of ``base_link`` in ``map``; poses of KITTI, which
    have no stamps, take them from a file ``times.txt`` beside it, or are 0.1 s apart.

    Parameters
    ----------
    path : str or path-like
    topics : str, iterable of str, or mapping of str to str, optional
        The topics to read; a mapping gives each a prefix for the names of its frames: ``{"/robot1/tf": "robot1/"}``. A
        topic is static if its name ends with ``_static``. By default ``/tf``, ``/tf_static``, and all topics of
        Foxglove's ``FrameTransform`` and ``FrameTransforms`` that are no ``tf`` of a namespace.
    prefix : str
        A prefix for the names of all frames.
    namespaces : bool
        Read ``tf`` and ``tf_static`` of all namespaces; the frames of ``/robot1/tf`` get the prefix ``robot1/``.
    odometry : str, iterable of str, or mapping of str to str, optional
        Topics of ``nav_msgs/Odometry`` that are read as transforms, beside the others; with the name of the child also
        ``PoseStamped`` and ``PoseWithCovarianceStamped``: ``{"/odom": None, "/camera/pose": "camera"}``.
    invert : bool
        Whether the child of each odometry becomes the parent, because it has a parent already.

    Raises
    ------
    RecordingError
        If the file is missing or empty, cannot be read, was cut off before its first message, or is not a recording; if
        a topic in `topics` is not there, or has no transforms; or if the packages that read it are not installed.
    ValueError, TypeError
        If both `topics` and `namespaces` are given, or a prefix begins with a slash.

    Notes
    -----
    The sizes that a file claims or unfolds to are bounded; data beyond a bound are left out and reported. The bounds
    are 8 MiB for a message with transforms, 256 MiB for any other, for a chunk (and a million messages in it) and for a
    value in SQLite, and 4 MiB for ``metadata.yaml``. A compressed file in a folder unfolds to at most 100 times its
    size, or 64 MiB if that is more, in a nameless temporary file. An index of more than 64 MiB is not used. The
    descriptions of all channels and types take at most 64 MiB. All compressed chunks together unfold to at most 1,000
    times the size of the file, or 1 GiB if that is more; later chunks are left out. Messages of chunks that overlap in
    time are sorted in memory up to 512 MiB; 10,000 covariances wait for their transforms. A trajectory has at most 5
    million poses, and 4,096 bytes a line. So reading a hostile file takes at most 2 GiB of memory.

    If a writer has left a journal beside an SQLite file, the file is copied to a temporary folder, where SQLite undoes
    the last transaction. If the writer still runs, the original is read.

    Examples
    --------
    >>> from tfbus.recording import open_recording
    >>> with open_recording("small.bag") as recording:
    ...     print(sum(len(message.batch) for message in recording.messages()))
    993
    """
    file = Path(path)
    selection = Selection(topics, prefix, namespaces, odometry, invert)
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
        problem = f"to read it, tfbus needs more packages: {pip_install('bag')} ({error})"
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
    for magic, open_format in _FORMATS.items():
        if first.startswith(magic):
            return open_format(path)
        if magic.startswith(first):
            raise RecordingError(f"the file ends after {len(first)} bytes", path=str(path), reason="truncated")
    if is_text(first):
        return TrajectoryStorage(path)
    raise RecordingError(
        "it is not a recording of ROS 1 (.bag) or ROS 2 (.mcap, .db3), nor a trajectory of TUM, KITTI or EuRoC",
        path=str(path),
        reason="foreign",
    )


# Each format imports packages of its own, so only the one of the file is imported.
def _open_mcap(path: Path) -> Storage:
    from tfbus.recording.formats.mcap import McapStorage

    return McapStorage(path)


def _open_sqlite(path: Path) -> Storage:
    from tfbus.recording.formats.folder import SqliteStorage

    return SqliteStorage(path)


def _open_bag(path: Path) -> Storage:
    from tfbus.recording.formats.ros1 import Ros1Storage

    return Ros1Storage(path)


_FORMATS: Final[dict[bytes, Callable[[Path], Storage]]] = {
    b"\x89MCAP0\r\n": _open_mcap,
    b"SQLite format 3\0": _open_sqlite,
    b"#ROSBAG V": _open_bag,
}
"""By the first bytes of a file."""

_MAX_CANDIDATES = 16


class SpeedLimit:
    """Decides for each moving sample whether its frame can have moved there since its last kept sample.

    Parameters
    ----------
    speed : float
        In m/s.

    Attributes
    ----------
    dropped : Counter
        The number of samples left out, under ``"speed"``.

    Raises
    ------
    TypeError, ValueError
        If the speed is not a number greater than zero.
    """

    def __init__(self, speed: float) -> None:
        if not is_real(speed):
            raise TypeError(f"max_speed must be a number of m/s, not {speed!r}")
        if not speed > 0:
            raise ValueError(f"max_speed must be greater than zero, got {speed!r}")
        self.dropped: Counter[str] = Counter()
        self._speed = float(speed)
        self._kept: dict[tuple[str, str], tuple[int, Row]] = {}
        self._candidates: dict[tuple[str, str], list[TransformStamped]] = {}

    def admit(self, batch: Batch) -> Batch:
        """The kept samples of a batch, after the earlier samples that this batch has confirmed."""
        kept: list[TransformStamped] = []
        for sample in batch:
            if sample.static:
                kept.append(sample)
            else:
                kept += self._judge(sample)
        return tuple(kept)

    def undecided(self) -> Batch:
        """At the end of all samples: the first sample of each frame without two samples that agree."""
        kept = []
        for candidates in self._candidates.values():
            kept.append(candidates[0])
            self._drop(len(candidates) - 1)
        self._candidates.clear()
        return tuple(kept)

    def _judge(self, sample: TransformStamped) -> list[TransformStamped]:
        parent, child, stamp, row, _, _ = sample._fields
        key = parent, child
        last = self._kept.get(key)
        if last is not None:
            if not self._reaches(*last, stamp, row):
                self._drop(1)
                return []
            self._kept[key] = stamp, row
            return [sample]
        candidates = self._candidates.setdefault(key, [])
        for candidate in candidates:
            if self._reaches(candidate.stamp, candidate._fields[3], stamp, row):
                del self._candidates[key]
                self._drop(len(candidates) - 1)
                self._kept[key] = stamp, row
                return [candidate, sample]
        candidates.append(sample)
        if len(candidates) > _MAX_CANDIDATES:
            del candidates[0]
            self._drop(1)
        return []

    def _reaches(self, stamp: int, row: Row, other_stamp: int, other: Row) -> bool:
        # Samples of one stamp replace each other: no speed is known.
        time = abs(other_stamp - stamp)
        return time == 0 or math.dist(row[:3], other[:3]) <= self._speed * time / SECOND

    def _drop(self, count: int) -> None:
        if count:
            self.dropped["speed"] += count


MAX_DETAILS = 20


class Problems(Counter[str]):
    """The number of transforms and messages that were left out, by reason.

    Attributes
    ----------
    details : list of str
        The losses at the first damaged places, in words; at most `MAX_DETAILS`.
    """

    def __init__(self) -> None:
        super().__init__()
        self.details: list[str] = []

    def note(self, errors: tuple[InvalidTransformError | MalformedMessageError, ...]) -> None:
        """Count the errors of a message."""
        for error in errors:
            self[error.reason] += 1
            if isinstance(error, MalformedMessageError) and len(self.details) < MAX_DETAILS:
                self.details.append(error.detail)

    def noting(self, messages: Iterable[RecordedMessage]) -> Iterator[RecordedMessage]:
        """The same messages; their errors are counted as they pass."""
        for message in messages:
            self.note(message.errors)
            yield message


def load(
    path: str | os.PathLike[str],
    since: int | None = None,
    until: int | None = None,
    *,
    topics: Topics = None,
    prefix: str = "",
    namespaces: bool = False,
    odometry: OdometryTopics = None,
    invert: bool = False,
    max_speed: float | None = None,
    problems: Counter[str] | None = None,
    max_translation: float = MAX_TRANSLATION,
) -> TransformTree:
    """Read all transforms of a recording, or of a part of it, into a tree that keeps them all.

    Invalid transforms, transforms that would close a loop of parents, and transforms that are further than
    `max_translation`, are left out and counted, as are the damaged parts of a file.

    Parameters
    ----------
    path : str or path-like
        As `open_recording`.
    since, until : int, optional
        The first and the last log time, in ns. Static transforms from before `since` are in the tree as well.
    topics, prefix, namespaces, odometry, invert
        As `open_recording`.
    max_speed : float, optional
        In m/s. A moving sample is left out, and counted as ``"speed"``, if its frame cannot have come there from its
        last kept sample, by stamp, at this speed. If the first samples of a frame contradict each other, the first
        sample that a later one confirms is kept.
    problems : Counter, optional
        Gets the number of transforms and messages that were left out, by reason. Without it, a warning logs them, and
        topics and files that were not read although they may hold transforms.
    max_translation : float
        The greatest magnitude of a translation, in m, at most 1e100.

    Returns
    -------
    TransformTree
        With ``keep=None``.

    Raises
    ------
    RecordingError
        If the recording cannot be read at all, or as `open_recording`.
    ValueError, TypeError
        If `max_speed` or `max_translation` is not greater than zero, or `max_translation` is greater than 1e100; or as
        `open_recording`.

    Examples
    --------
    >>> tree = load("small.bag")
    >>> tree.chain("map", "laser")
    ['map', 'odom', 'base_link', 'laser']
    """
    limit = None if max_speed is None else SpeedLimit(max_speed)
    found = Problems()
    tree = TransformTree(keep=None, max_translation=max_translation)
    with open_recording(
        path, topics=topics, prefix=prefix, namespaces=namespaces, odometry=odometry, invert=invert
    ) as recording:
        fill(tree, recording, found, since, until, limit=limit)
        remarks = recording.remarks
    if problems is not None:
        problems.update(found)
        if isinstance(problems, Problems):
            problems.details += found.details
        return tree
    logger = logging.getLogger("tfbus")
    if found:
        reasons = ", ".join(f"{count} x {reason}" for reason, count in found.most_common())
        left_out = printable("; ".join([reasons, *found.details]))
        logger.warning("left out of %s: %s", printable(os.fspath(path)), left_out)
    for remark in remarks:
        logger.warning("%s: %s", printable(os.fspath(path)), printable(remark))
    return tree


def fill(
    tree: TransformTree,
    recording: Recording,
    problems: Problems,
    since: int | None = None,
    until: int | None = None,
    *,
    limit: SpeedLimit | None = None,
    progress: Callable[[int], object] | None = None,
) -> None:
    """Insert the samples of a recording into a tree, and count the refused ones by reason.

    Parameters
    ----------
    tree : TransformTree
    recording : Recording
    problems : Problems
    since, until : int, optional
        As `load`.
    limit : SpeedLimit, optional
    progress : callable, optional
        Called with the number of messages in each block that has been inserted.
    """
    forest = forest_of(tree)
    for block in recording.blocks(since, until):
        columns = block.columns() if limit is None else None
        if columns is None or not _append(forest, columns, tree.max_translation):
            _commit(forest, block, problems, tree.max_translation, limit)
        if progress is not None:
            progress(len(block))
    if limit is not None:
        forest.commit(
            without_loops(forest.frames, limit.undecided(), forest.names.parents, problems, tree.max_translation)
        )
        problems.update(limit.dropped)
    forest.forget_changes()


def _append(forest: Forest, columns: list[Columns], max_translation: float) -> bool:
    """Insert the samples of a block unless they change an edge; returns whether they were inserted."""
    together: dict[str, list[Columns]] = {}
    for each in columns:
        x, y, z = each.rows[:, :3].T
        near = (x * x + y * y + z * z).max() <= max_translation**2
        history = forest.frames.get(each.child)
        if not near or history is None or (history.parent, history.static) != (each.parent, each.static):
            return False
        together.setdefault(each.child, []).append(each)
    for child, parts in together.items():
        first = parts[0]
        if len(parts) == 1 and forest.can_append(first.parent, child, first.authority, first.stamps):
            forest.append(child, first.stamps, first.rows)
        else:
            # The unusual case, such as a repeated stamp, or several authorities.
            samples = [
                (place, sample) for part in parts for place, sample in zip(part.order, _samples(part), strict=True)
            ]
            forest.commit(tuple(sample for _, sample in sorted(samples, key=itemgetter(0))))
    return True


def _samples(columns: Columns) -> Iterator[TransformStamped]:
    for stamp, row in zip(columns.stamps.tolist(), columns.rows.tolist(), strict=True):
        sample = TransformStamped.__new__(TransformStamped)
        sample._fields = columns.parent, columns.child, stamp, tuple(row), columns.authority, columns.static
        yield sample


def _commit(
    forest: Forest,
    block: Block | DecodedBlock,
    problems: Problems,
    max_translation: float,
    limit: SpeedLimit | None,
) -> None:
    for _, batch, errors in block.messages():
        if errors:
            problems.note(errors)
        if limit is not None:
            batch = limit.admit(_near(batch, problems, max_translation))
        forest.commit(without_loops(forest.frames, batch, forest.names.parents, problems, max_translation))


def without_loops(
    edges: Mapping[str, NewestEdge],
    batch: Batch,
    parents: Container[str],
    problems: Counter[str],
    max_translation: float = MAX_TRANSLATION,
) -> Batch:
    """The batch without samples that are too far away or would close a loop of parents; these are counted.

    Parameters
    ----------
    edges : mapping of child to its newest edge
        Every edge has a sample, because nothing is ever removed from a recording.
    batch : tuple of TransformStamped
    parents : container of str
        The parents of the edges.
    problems : Counter
    max_translation : float
        In m.
    """
    square = max_translation**2
    for sample in batch:
        parent, child, _, row, _, _ = sample._fields
        edge = edges.get(child)
        x, y, z, _, _, _, _ = row
        # Not `>`, which is false for NaN.
        if edge is None or edge.parent != parent or not x * x + y * y + z * z <= square:
            break
    else:
        # The usual case: no child has got another parent, so there is no new loop.
        return batch
    accepted, refused = admit(edges, _near(batch, problems, max_translation), parents)
    problems.update(error.reason for error in refused)
    return accepted


def _near(batch: Batch, problems: Counter[str], max_translation: float) -> Batch:
    """The batch without the samples that are too far away, which are counted."""
    far = [sample for sample in batch if not is_within(sample, max_translation)]
    if not far:
        return batch
    problems.update(not_physical(sample, max_translation).reason for sample in far)
    return tuple(sample for sample in batch if is_within(sample, max_translation))
