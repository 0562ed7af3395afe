"""`convert`, which writes recordings to a new one: in another format, a part of one, or several merged."""

import heapq
import os
import struct
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from itertools import groupby
from json import dumps
from operator import itemgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal, TypeVar

import numpy as np

from tfbus.errors import InvalidTransformError, RecordingError, pip_install
from tfbus.frames import check_frame
from tfbus.geometry.transform_array import TransformArray
from tfbus.plain import printable
from tfbus.recording.formats.copies import (
    BagCopy,
    CannotWriteError,
    Copy,
    FoxgloveCopy,
    McapCopy,
    SqliteCopy,
    transform_channel,
    write_transforms,
)
from tfbus.recording.formats.covariances import (
    SUFFIX,
    RawCovariance,
    covariance_channel,
    holds_covariances,
    read_covariances,
    write_covariances,
)
from tfbus.recording.formats.storage import (
    AUTHORITIES,
    Channel,
    Storage,
    StoredMessage,
    UnfoldError,
    Wanted,
)
from tfbus.recording.formats.trajectories import FORMATS, TrajectoryCopy, lines_of
from tfbus.recording.formats.transforms import (
    ChannelDecoder,
    RawTransform,
    bounded,
    decompressed,
    holds_transforms,
)
from tfbus.recording.recording import MAX_DETAILS, open_storage
from tfbus.tf_message import MalformedMessageError

Raw = TypeVar("Raw", RawTransform, RawCovariance)


@dataclass(frozen=True, slots=True)
class Edits:
    """The changes that `convert` makes to transforms; numbers and stamps stay.

    Parameters
    ----------
    frames : collection of str, optional
        Only the transforms of these child frames stay, by the names in the recording.
    rename : mapping of str to str
        New names of frames.
    prefix : str
        A prefix for the names of all frames that are not renamed.
    drop_static : bool
        Whether static transforms are left out.

    Raises
    ------
    ValueError
        If a new name is empty, or a new name or the prefix starts with a slash.

    Examples
    --------
    >>> import tempfile
    >>> from tfbus.recording import Edits, convert, load
    >>> path = tempfile.mkdtemp() + "/run.mcap"
    >>> _ = convert(["small.bag"], path, edits=Edits(rename={"base_link": "base"}))
    >>> "base" in load(path)
    True
    """

    frames: Collection[str] | None = None
    rename: Mapping[str, str] = field(default_factory=dict)
    prefix: str = ""
    drop_static: bool = False

    def __post_init__(self) -> None:
        try:
            for name in (*self.rename.values(), *((self.prefix,) if self.prefix else ())):
                check_frame(name)
        except InvalidTransformError as error:
            raise ValueError(str(error)) from None

    @property
    def changes_messages(self) -> bool:
        """Whether messages with transforms change; static ones that are left out do not count."""
        return self.frames is not None or bool(self.rename) or bool(self.prefix)

    def keeps(self, transform: RawTransform | RawCovariance) -> bool:
        """Whether a transform stays."""
        return self.frames is None or _bare(transform.child) in self.frames

    def apply(self, transform: Raw) -> Raw:
        """A transform or a covariance with the new names of its frames."""
        if not (self.rename or self.prefix):
            return transform
        return transform._replace(parent=self._rename(transform.parent), child=self._rename(transform.child))

    def _rename(self, name: bytes) -> bytes:
        bare = _bare(name)
        new = self.rename.get(bare, self.prefix + bare)
        return name if new == bare else new.encode(errors="surrogateescape")


def _bare(name: bytes) -> str:
    return name.decode(errors="surrogateescape").lstrip("/")


_COPIES: dict[str, Callable[[Path, str], Copy]] = {
    ".mcap": McapCopy,
    ".bag": BagCopy,
    ".db3": SqliteCopy,
    **dict.fromkeys(FORMATS, TrajectoryCopy),
}
_NUMBERS = struct.Struct("<7d")


@dataclass(frozen=True, slots=True)
class StaticTransform:
    """A static transform of a recording, with its numbers unchanged.

    Examples
    --------
    >>> from tfbus.recording import StaticTransform
    >>> StaticTransform("base_link", "laser", (0.1, 0.0, 0.2), (0.0, 0.0, 0.0, 1.0)).child
    'laser'
    """

    parent: str
    child: str
    translation: tuple[float, float, float]
    rotation: tuple[float, float, float, float]
    """(x, y, z, w)."""


@dataclass(slots=True)
class Conversion:
    """The result of `convert`.

    Parameters
    ----------
    messages, transforms : int
        The number of messages on all topics, and of transforms in them, that were written.
    problems : Counter of str
        The number of messages that were left out, by reason.
    details : list of str
        The first losses, in words.
    statics : dict of str to StaticTransform
        The last static transform of each child frame, with its new names.

    Examples
    --------
    >>> import tempfile
    >>> from tfbus.recording import convert
    >>> convert(["small.bag"], tempfile.mkdtemp() + "/run.mcap").messages
    789
    """

    messages: int = 0
    transforms: int = 0
    problems: Counter[str] = field(default_factory=Counter)
    details: list[str] = field(default_factory=list)
    statics: dict[str, StaticTransform] = field(default_factory=dict)

    def note(self, reason: str, detail: str) -> None:
        """Count a problem."""
        self.problems[reason] += 1
        if len(self.details) < MAX_DETAILS and detail not in self.details:
            self.details.append(detail)


def convert(
    inputs: Sequence[str | os.PathLike[str]],
    output: str | os.PathLike[str],
    since: int | None = None,
    until: int | None = None,
    *,
    topics: Collection[str] | None = None,
    edits: Edits | None = None,
    overwrite: bool = False,
    schema: Literal["ros", "foxglove"] = "ros",
    progress: Callable[[int], object] | None = None,
) -> Conversion:
    """Write recordings to a new one, all messages in the order of their log times.

    Transforms keep every bit of their stamps and numbers, even invalid ones. Other messages, and messages whose
    transforms no edit changes, are copied unchanged. If the new format cannot hold their encoding, they are converted
    between CDR and ROS 1; a message that cannot be converted is left out and counted.

    Parameters
    ----------
    inputs : sequence of str or path-like
        As `open_recording`.
    output : str or path-like
        A file that ends in ``.mcap``, ``.bag`` (ROS 1) or ``.db3`` (ROS 2); or, for the trajectory of one moving frame,
        in ``.tum``, ``.kitti`` or ``.euroc``.
    since, until : int, optional
        The first and the last log time, in ns. With `since`, the static transforms from before come first.
    topics : collection of str, optional
        The topics to write; by default all.
    edits : Edits, optional
        The changes to transforms.
    overwrite : bool
        Whether to replace an existing file.
    schema : {"ros", "foxglove"}
        The schema of transforms. ``"ros"`` writes ROS's ``TFMessage``, but keeps messages in Foxglove's schema that
        nothing changes; ``"foxglove"`` writes ``FrameTransforms`` in Protocol Buffers, for MCAP only.
    progress : callable, optional
        Called with 1 for each message that is read.

    Returns
    -------
    Conversion

    Raises
    ------
    RecordingError
        If an input cannot be read, or the packages are missing.
    ValueError
        If the output has another ending, or is one of the inputs; if `schema` has another value, or does not fit the
        ending; if the output is a trajectory, and several frames move.
    FileExistsError
        If the output exists already.
    OSError
        If it cannot be written; then there is no output, and an existing file stays as it was.

    Examples
    --------
    >>> import tempfile
    >>> from tfbus.recording import convert
    >>> convert(["small.bag"], tempfile.mkdtemp() + "/run.mcap", until=from_seconds(100.0)).transforms
    4
    """
    target = Path(output)
    make = _COPIES.get(target.suffix)
    if make is None:
        raise ValueError(f"the output must end in {', '.join(_COPIES)}, not {target.name!r}")
    if schema not in ("ros", "foxglove"):
        raise ValueError(f"the schema must be 'ros' or 'foxglove', not {schema!r}")
    if schema == "foxglove":
        if make is not McapCopy:
            raise ValueError(f"only MCAP holds Foxglove's schema: the output must end in .mcap, not {target.name!r}")
        make = FoxgloveCopy
    if any(target.exists() and Path(path).exists() and target.samefile(path) for path in inputs):
        raise ValueError(f"{printable(str(target))} is an input as well")
    if target.exists() and not overwrite:
        raise FileExistsError(17, "it is there already", str(target))
    with ExitStack() as stack:
        part = stack.enter_context(new_file(target))
        storages = []
        for path in inputs:
            storages.append(open_storage(Path(path)))
            stack.callback(storages[-1].close)
        try:
            copy = make(part, target.name)
        except ImportError as error:
            extras = "bag,foxglove" if schema == "foxglove" else "bag"
            problem = f"to write it, tfbus needs more packages: {pip_install(extras)} ({error})"
            raise RecordingError(problem, path=str(target), reason="missing extra") from error
        stack.callback(copy.close)
        run = _Run(copy, Edits() if edits is None else edits, topics)
        for received, channel, payload in run.merged(storages, since, until):
            run.write(received, channel, payload)
            if progress is not None:
                progress(1)
        copy.finish()
    return run.result


def save_trajectory(path: str | os.PathLike[str], transforms: TransformArray, *, overwrite: bool = False) -> None:
    """Write transforms as a trajectory for the tools of benchmarks, such as evo; `load` reads it as well.

    Parameters
    ----------
    path : str or path-like
        Ends in ``.tum``, ``.kitti`` or ``.euroc``. KITTI's has no stamps.
    transforms : TransformArray
        With stamps, such as an answer of ``lookup_many``. Numbers keep every bit, stamps their nanoseconds.
    overwrite : bool
        Whether to replace an existing file.

    Raises
    ------
    ValueError
        If the path has another ending, or a transform is NaN or has no stamp.
    FileExistsError
        If the file exists already.
    OSError
        If it cannot be written.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> steps = TransformArray([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], [[0.0, 0.0, 0.0, 1.0]] * 2, [0, 1_000_000_000])
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = pathlib.Path(folder) / "steps.tum"
    ...     save_trajectory(file, steps)
    ...     print(file.read_text(), end="")
    0.000000000 0.0 0.0 0.0 0.0 0.0 0.0 1.0
    1.000000000 1.0 0.0 0.0 0.0 0.0 0.0 1.0
    """
    target = Path(path)
    kind = FORMATS.get(target.suffix)
    if kind is None:
        raise ValueError(f"a trajectory must end in {', '.join(FORMATS)}, not {target.name!r}")
    if transforms.stamps is None:
        raise ValueError("these transforms have no stamps")
    if not transforms.valid.all():
        raise ValueError(f"transform {int(transforms.valid.argmin())} is NaN: take the others with [transforms.valid]")
    if target.exists() and not overwrite:
        raise FileExistsError(17, "it is there already", str(target))
    rows = map(tuple, np.hstack((transforms.translations, transforms.rotations)).tolist())
    with new_file(target) as part, part.open("w", encoding="utf-8", newline="\n") as file:
        file.writelines(f"{line}\n" for line in lines_of(zip(transforms.stamps.tolist(), rows, strict=True), kind))


@contextmanager
def new_file(target: Path) -> Iterator[Path]:
    """A path for a new file that replaces the target at the end of the ``with``, if nothing fails.

    It is in a new folder that only this user may enter, so no symbolic link of another user can redirect it.

    Raises
    ------
    OSError
        If there can be no folder beside the target, or it cannot be replaced.
    """
    with TemporaryDirectory(prefix=".tfbus-", dir=target.parent) as folder:
        part = Path(folder, target.name)
        yield part
        part.replace(target)


class _Run:
    """One conversion, and its result so far."""

    def __init__(self, copy: Copy, edits: Edits, topics: Collection[str] | None) -> None:
        self.result = Conversion()
        self._copy = copy
        self._edits = edits
        self._topics = None if topics is None else {topic.removeprefix("/") for topic in topics}
        self._decoders: dict[Channel, ChannelDecoder] = {}
        self._outputs: dict[tuple[Channel, tuple[tuple[str, int], ...]], Channel] = {}

    def merged(self, storages: Sequence[Storage], since: int | None, until: int | None) -> Iterator[StoredMessage]:
        """The wanted messages of all recordings in the order of their log times, with the statics from before."""
        if since is not None:
            for storage in storages:
                latched: dict[tuple[Channel, bytes], None] = {}
                for _, channel, payload in storage.messages(self._is_static, None, since - 1):
                    if isinstance(channel, Channel):
                        # In the order of the newest copies.
                        latched.pop((channel, payload), None)
                        latched[channel, payload] = None
                yield from ((since, channel, payload) for channel, payload in latched)
        wanted: Wanted = self._is_wanted
        yield from heapq.merge(*(each.messages(wanted, since, until) for each in storages), key=itemgetter(0))

    def write(self, received: int, channel: Channel | MalformedMessageError, payload: bytes) -> None:
        """Write one message, or count the reason for leaving it out."""
        if isinstance(channel, MalformedMessageError):
            self.result.note(channel.reason, channel.detail)
            return
        try:
            if holds_transforms(channel):
                self._write_transforms(received, channel, payload)
            elif holds_covariances(channel) and (self._edits.changes_messages or self._edits.drop_static):
                self._write_covariances(received, channel, payload)
            else:
                self._copy.write(channel, received, decompressed(channel, payload))
                self.result.messages += 1
        except MalformedMessageError as error:
            self.result.note(error.reason, error.detail)
        except UnfoldError as error:
            self.result.note("damaged", str(error))
        except CannotWriteError as error:
            self.result.note("format", str(error))
        except ValueError as error:
            self.result.note("type", str(error))

    def _write_transforms(self, received: int, channel: Channel, payload: bytes) -> None:
        decoder = self._decoder(channel)
        payload = bounded(payload)
        unchanged = self._copy.holds(channel) and not self._edits.changes_messages
        if unchanged and not decoder.static:
            # The payload is copied unread; only its transforms are counted, if they can be.
            count = 0
            with suppress(MalformedMessageError):
                count = decoder.count(payload)
            self._copy.write(channel, received, payload)
            self.result.messages += 1
            self.result.transforms += count
            return
        try:
            transforms = decoder.parse(payload)
        except MalformedMessageError:
            if not unchanged:
                raise
            # The payload is copied unread.
            transforms = []
        kept = [
            (self._edits.apply(each), decoder.authority_of(place, len(transforms)))
            for place, each in enumerate(transforms)
            if self._edits.keeps(each)
        ]
        if decoder.static:
            self._note_statics([each for each, _ in kept])
            if self._edits.drop_static:
                return
        if unchanged:
            self._copy.write(channel, received, payload)
        elif kept or not transforms:
            runs = tuple((name, len(list(run))) for name, run in groupby(authority for _, authority in kept))
            message = write_transforms([each for each, _ in kept], self._copy.encoding)
            self._copy.write(self._output(channel, runs), received, message)
        else:
            return
        self.result.messages += 1
        self.result.transforms += len(kept)

    def _write_covariances(self, received: int, channel: Channel, payload: bytes) -> None:
        found = read_covariances(bounded(payload), channel.encoding == "ros1")
        kept = [self._edits.apply(each) for each in found if self._edits.keeps(each)]
        if kept and not (self._edits.drop_static and self._is_static(channel)):
            key = channel, ()
            if key not in self._outputs:
                self._outputs[key] = covariance_channel(channel.topic, dict(channel.metadata))
            self._copy.write(self._outputs[key], received, write_covariances(kept))
            self.result.messages += 1

    def _output(self, channel: Channel, runs: tuple[tuple[str, int], ...]) -> Channel:
        """The output channel for the transforms of an input channel, from the given authorities."""
        runs = runs if len(runs) > 1 else tuple((name, 1) for name, _ in runs)
        key = channel, runs
        if key not in self._outputs:
            metadata = {name: value for name, value in channel.metadata.items() if name == "offered_qos_profiles"}
            if self._copy.encoding == "ros1" and len(runs) == 1 and runs[0][0]:
                metadata["callerid"] = "/" + runs[0][0]
            elif any(name for name, _ in runs):
                metadata[AUTHORITIES] = dumps(runs)
            self._outputs[key] = transform_channel(channel, self._copy.encoding, metadata)
        return self._outputs[key]

    def _note_statics(self, transforms: Sequence[RawTransform]) -> None:
        for each in transforms:
            parent, child = (name.decode(errors="replace").lstrip("/") for name in (each.parent, each.child))
            x, y, z, i, j, k, w = _NUMBERS.unpack(each.numbers)
            self.result.statics[child] = StaticTransform(parent, child, (x, y, z), (i, j, k, w))

    def _decoder(self, channel: Channel) -> ChannelDecoder:
        if channel not in self._decoders:
            self._decoders[channel] = ChannelDecoder(channel, self._is_static(channel))
        return self._decoders[channel]

    def _is_wanted(self, channel: Channel) -> bool:
        return self._topics is None or _topic_of(channel).removeprefix("/") in self._topics

    def _is_static(self, channel: Channel) -> bool:
        holds = holds_transforms(channel) or holds_covariances(channel)
        return self._is_wanted(channel) and holds and _topic_of(channel).endswith("_static")


def _topic_of(channel: Channel) -> str:
    """The topic of a channel; for covariances, that of their transforms."""
    return channel.topic.removesuffix(SUFFIX) if holds_covariances(channel) else channel.topic
