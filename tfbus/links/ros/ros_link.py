"""`RosLink`, the base of all links to ROS, and `RosCarrier`, the half of a carrier that they share.

A carrier sorts samples and messages by topic; a subclass connects, publishes and closes. A received message is a
`RosMessage`: bytes that the link decodes in its turn, in parts if they are many.

A publisher of ROS keeps its last message on ``/tf_static`` for late joiners. So each message to that topic holds all
static frames that this link sends. ROS has no message that removes a frame: a removed static frame is missing in the
next message, which late joiners get; the removal of a moving frame is not sent.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Unpack

from tfbus.bus.bus import Bus
from tfbus.errors import InvalidTransformError
from tfbus.geometry.stamped import TransformStamped
from tfbus.links.link import Link
from tfbus.links.replica import FromLink, OutgoingBatch, ReceivedTransform, received
from tfbus.links.ros.foreign_end import Carrier, ForeignEnd, ReceivedMessage, Turn
from tfbus.links.ros.messages import decode_clock, decode_odometry, decode_text
from tfbus.links.ros.settings import Other, RosOptions, RosSettings
from tfbus.links.seams import Received, SendReport
from tfbus.robot.joint_state_message import decode_joint_state
from tfbus.tf_message import Decoded, MalformedMessageError, decode, decode_in_parts, refusal

MAX_SIZE = 2**22
"""The largest message that is received, in bytes."""
MAX_OTHER_SIZE = 2**15
"""The largest message of joints, of odometry or of the time, in bytes."""
AT_ONCE = 2**13
"""A message of transforms beyond so many bytes or characters is read in parts."""
PART = 40
"""So many transforms of a large message are decoded and published at once."""
MOST_TRANSFORMS = 1_000
"""So many moving transforms go into one message."""


@dataclass(frozen=True, slots=True)
class RosMessage:
    """One message from a topic, as it came.

    Attributes
    ----------
    payload : Any
        Bytes of CDR, or `Decoded` for a part of a large message; a carrier with other messages decodes them itself.
    static : bool
        Whether the topic is one of static frames.
    authority : str
        The node that has published it, or what is known of it.
    other : str
        Its content, see `Other`; None for transforms.
    continues : bool
        Whether it is a later part of a large message.
    """

    payload: Any
    static: bool
    authority: str
    other: Other | None = None
    continues: bool = False


class RosCarrier(Carrier, ABC):
    """A carrier to ROS, see `tfbus.links.seams.Carrier`; a subclass connects, publishes and closes.

    Parameters
    ----------
    id : str
        The name of this end.
    settings : RosSettings
    """

    def __init__(self, id: str, settings: RosSettings) -> None:  # noqa: A002 - the protocol calls it so
        self.id = id
        self.settings = settings
        self._receive: Callable[[Received], object]
        self._report: SendReport
        self._statics: dict[str, TransformStamped] = {}

    async def open(self, receive: Callable[[Received], object], report: SendReport) -> None:
        """Connect; raises `OSError` if there is no connection."""
        self._receive, self._report = receive, report
        await self._connect()

    def send(self, turn: Turn) -> None:
        """Publish the moving frames of a turn, and all static ones if any of them has changed."""
        if not self.settings.send:
            return
        moving: list[TransformStamped] = []
        for entry in turn.entries:
            if isinstance(entry, OutgoingBatch):
                moving += filter(None, (self._outgoing(sample) for sample in entry.samples if not sample.static))
            elif entry.frame not in self._statics and self.settings.names.is_local(entry.frame):
                error = ValueError(f"ROS cannot be told that the moving frame {entry.frame!r} was removed")
                self._report.refused("removal", error)
        for first in range(0, len(moving), MOST_TRANSFORMS):
            self._put(moving[first : first + MOST_TRANSFORMS], static=False)
        changed = False
        for frame, change in turn.statics.items():
            sample = None if change is None else self._outgoing(change)
            if sample is not None:
                self._statics[frame] = sample
                changed = True
            elif self._statics.pop(frame, None) is not None:
                changed = True
        if changed:
            self._put(list(self._statics.values()), static=True)

    def split(self, content: Any) -> Iterator[Any]:
        """The parts of a large message of transforms, each of `PART` of them; anything else is its only part."""
        if not isinstance(content, RosMessage) or content.other or not self._is_large(content.payload):
            yield content
            return
        continues = False
        for decoded in self._decode_in_parts(content.payload):
            yield replace(content, payload=decoded, continues=continues)
            continues = True

    def read(self, content: RosMessage) -> ReceivedMessage:
        """The samples of a message by their names on the bus, or the time; positions of joints are handed on."""
        if content.other not in (None, "description") and isinstance(content.payload, bytes):
            size = len(content.payload)
            if size > MAX_OTHER_SIZE:
                raise MalformedMessageError("oversized", f"{size} bytes, more than {MAX_OTHER_SIZE}")
        if content.other == "clock":
            return ReceivedMessage([], time=decode_clock(content.payload))
        if content.other == "joints":
            stamp, positions = self._decode_joints(content.payload)
            if self.settings.joint_states is not None:
                self.settings.joint_states(positions, stamp + self.settings.names.offset)
            return ReceivedMessage([])
        if content.other == "description":
            description = decode_text(content.payload)
            if self.settings.robot_description is not None:
                self.settings.robot_description(description)
            return ReceivedMessage([])
        if content.other == "odometry":
            decoded: Decoded[Any] = self._decode_odometry(content.payload)
            if self.settings.invert:
                decoded.samples[:] = [sample and received(sample.inverse()) for sample in decoded.samples]
        else:
            decoded = content.payload if isinstance(content.payload, Decoded) else self._decode(content.payload)
        self._heard(decoded.samples, content.static)
        errors = decoded.errors
        samples: list[FromLink] = []
        authority = content.authority if self.settings.authority is None else self.settings.authority
        for error in errors:
            error.authority = authority
        for sample in decoded.samples:
            if sample is None:
                continue
            sample._fields = *sample._fields[:4], authority, content.static
            try:
                self.settings.names.put_on_bus(sample)
            except InvalidTransformError as error:
                errors.append(error.with_traceback(None))
            else:
                samples.append(sample)
        return ReceivedMessage(samples, errors=errors, continues=content.continues)

    async def run(self) -> None:
        """Do nothing that takes time."""

    @abstractmethod
    async def close(self) -> None:
        """Disconnect."""

    @abstractmethod
    async def _connect(self) -> None:
        """Connect, and subscribe; raises `OSError` if there is no connection."""

    @abstractmethod
    def _publish(self, samples: Sequence[TransformStamped], static: bool) -> bool:
        """Publish one message, without blocking; returns whether the network took it, and reports it if not."""

    def _decode(self, payload: Any) -> Decoded[ReceivedTransform]:
        """The transforms of a message; raises `MalformedMessageError`."""
        return decode(payload, kind=ReceivedTransform, bare_names=True)

    def _is_large(self, payload: Any) -> bool:
        """Whether a message of transforms takes too long for one turn."""
        return len(payload) > AT_ONCE

    def _decode_in_parts(self, payload: Any) -> Iterator[Decoded[ReceivedTransform]]:
        """The transforms of a large message, `PART` at a time; raises `MalformedMessageError` at the first fault."""
        return decode_in_parts(payload, PART, ReceivedTransform, bare_names=True)

    def _heard(self, samples: Sequence[FromLink | None], static: bool) -> None:
        """Take note of transforms by their names in ROS."""

    def _decode_joints(self, payload: Any) -> tuple[int, dict[str, float]]:
        """The stamp and the positions of joints of a message; raises `MalformedMessageError`."""
        return decode_joint_state(payload, ros1=False)

    def _decode_odometry(self, payload: Any) -> Decoded[FromLink]:
        """The transform of odometry; raises `MalformedMessageError`."""
        return decode_odometry(payload, ros1=False)

    def _pass_on(self, sender: str, message: RosMessage) -> None:
        """Hand a message of bytes to the link, or the refusal of one that is too large; any thread may call this."""
        size = len(message.payload)
        if size > MAX_SIZE:
            error = MalformedMessageError("oversized", f"{size} bytes, more than {MAX_SIZE}")
            self._receive(Received(sender, error))
        else:
            # A latched message comes once.
            moving = not (message.static or message.other == "description")
            self._receive(Received(sender, message, size, moving=moving))

    def publish_statics(self) -> None:
        """Publish the static frames once more, for a server that has come back or has not taken them."""
        if self._statics:
            self._put(list(self._statics.values()), static=True)

    def _put(self, samples: Sequence[TransformStamped], static: bool) -> None:
        if self._publish(samples, static):
            self._report.sent(len(samples))

    def _outgoing(self, sample: TransformStamped) -> TransformStamped | None:
        """A sample with its names in ROS; None if it is another robot's, or a message cannot hold it."""
        if not self.settings.names.is_local(sample.child):
            return None
        error = refusal(sample)
        if error is None:
            try:
                return self.settings.names.localise(sample)
            except InvalidTransformError as no_name:
                error = no_name.with_traceback(None)
        self._report.refused(error.reason, error)
        return None


class RosLink(Link):
    """Joins a bus to the transforms of a ROS system, both ways; what all links to ROS have in common.

    Parameters
    ----------
    bus : Bus
    name : str
        How events and log lines call the link.
    carrier : RosCarrier
        Connects to ROS.
    tf, tf_static : str or iterable of str
        The topics of the moving and of the static frames, by default ``/tf`` and ``/tf_static``. If there are several,
        all are heard, and the link publishes on the first.
    prefix : str, optional
        Put before each name that comes from ROS, such as ``"robot1/"``, and taken off each name that goes there. Frames
        of the bus without it do not go there.
    shared : iterable of str
        Names that are the same on the bus and in ROS in spite of the prefix, such as ``{"map"}``.
    frames : iterable of str, optional
        Send and take only these children, by their names on the bus; by default all.
    send : bool
        Whether anything goes to ROS; else the link only listens.
    authority : str, optional
        The authority of all that comes from ROS; by default the node that has published it, where the link knows it.
    joint_states : callable, optional
        Takes the positions of joints that come from ROS, by their names in rad or m, and the stamp in ns: such as
        `RobotStatePublisher.publish` of a robot. An error that it raises is counted in `LinkStatistics.rejected`.
    joint_topic : str
        The topic of these, by default ``/joint_states``.
    robot_description : callable, optional
        Takes the URDF of the robot, a str, where ROS has it as a topic, as ``robot_state_publisher`` does in ROS 2.
        An error that it raises is counted in `LinkStatistics.rejected`.
    description_topic : str
        The topic of that, by default ``/robot_description``.
    odometry : str or iterable of str, optional
        Topics of ``nav_msgs/Odometry``: the pose of each message is a moving transform, from its frame to its child,
        with the topic as its authority, and with its covariance if that is known, as a drift.
    invert : bool
        Whether the child of odometry becomes the parent, because it has a parent already.
    clock : SimulatedClock, optional
        Follows ``/clock``, the time of a simulation: it advances, and jumps where that time jumps; one jump back is one
        reset. Give the clock of the bus.
    drop_lost : bool
        Whether the frames that a lost peer was the last to publish leave the bus.
    max_frames : int
        How many frames one peer may have; samples of others are refused and counted.
    capacity : int
        How many messages of moving frames may wait for the event loop; then the oldest are dropped and counted.
    offset : float
        Added to each stamp that comes from ROS, in s, and taken off each that goes there, such as ``-0.3`` for a robot
        whose clock is 0.3 s ahead. All links of a bus to one system of ROS need the same.

    Raises
    ------
    ValueError
        If a name cannot be that of a topic, the prefix is not valid, or a number is out of range.
    TypeError
        If an argument has the wrong type.

    Notes
    -----
    Nothing in ROS tells where a message comes from. So the bus remembers the newest samples of each child that went
    over it, and takes none of them again: by its child, parent and stamp, a static one by its value as well. However
    the buses and the ROS systems are connected, nothing goes round.

    Static frames are latched both ways. Each message on ``/tf_static`` holds all that this link sends, because ROS
    keeps only the last message of each publisher. ROS has no message that removes a frame: a removed static frame is
    missing in the next message, which only late joiners notice, and a removed moving frame is counted in
    `LinkStatistics.not_sent`. A transform that ROS accepts and the bus refuses is counted by its reason and announced
    once, as `PeerRejected` or `SampleRejected`.
    """

    def __init__(self, bus: Bus, name: str, carrier: RosCarrier, **options: Unpack[RosOptions]) -> None:
        end = ForeignEnd(
            bus,
            name,
            carrier,
            frames=options.get("frames"),
            drop_lost=options.get("drop_lost", False),
            max_frames=options.get("max_frames", 10_000),
        )
        super().__init__(end, capacity=options.get("capacity", 10_000), clock=options.get("clock"))
