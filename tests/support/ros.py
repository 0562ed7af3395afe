"""A carrier to a ROS that is a list, and rows of transforms as ROS has them."""

import struct
from collections.abc import Callable, Sequence
from typing import Unpack

from tfbus import Bus, SimulatedClock, TransformStamped
from tfbus.links.ros import RosOptions
from tfbus.links.ros.foreign_end import ForeignEnd
from tfbus.links.ros.ros_link import RosCarrier, RosMessage
from tfbus.links.ros.settings import settings_of
from tfbus.links.seams import Joined, Left, Received, SendReport
from tfbus.tf_message import encode

Said = tuple[bool, list[tuple[str, str, int]]]
"""Whether a message is of static frames, and the parent, child and stamp of each transform."""


class ListCarrier(RosCarrier):
    """Notes what goes to ROS; `connect` is for tests without an event loop."""

    def __init__(self, options: RosOptions | None = None) -> None:
        super().__init__("list", settings_of(options or {}))
        self.said: list[Said] = []
        self.closed = False

    def connect(self, receive: Callable[[Received], object], report: SendReport) -> None:
        self._receive, self._report = receive, report

    def hear(self, message: RosMessage, moving: bool = False) -> None:
        """A message comes from the peer."""
        self._receive(Received("peer", message, len(message.payload), moving=moving))

    def meet(self, is_there: bool) -> None:
        """The peer comes or goes."""
        self._receive(Received("peer", Joined() if is_there else Left()))

    async def _connect(self) -> None:
        """A list is there."""

    async def close(self) -> None:
        self.closed = True

    def _publish(self, samples: Sequence[TransformStamped], static: bool) -> bool:
        self.said.append((static, [(sample.parent, sample.child, sample.stamp) for sample in samples]))
        return True


class RosEnd:
    """A bus with a link to such a ROS."""

    def __init__(self, **options: Unpack[RosOptions]) -> None:
        self.bus = Bus(SimulatedClock())
        self.heard: list[tuple[TransformStamped, ...]] = []
        self.bus.subscribe(self.heard.append)
        self.carrier = ListCarrier(options)
        self.endpoint = ForeignEnd(self.bus, "ros", self.carrier)
        self.endpoint.host = self
        self.errors: list[Exception] = []
        self.report = SendReport(self.errors.append)
        self.carrier.connect(self.receive, self.report)
        self.endpoint.relay.attach(self.endpoint)

    def receive(self, item: Received) -> None:
        self.endpoint.handle(item.sender, item.content)

    def send_soon(self, pending: int) -> None:
        """The test ends the turn."""

    def is_behind(self) -> bool:
        return False

    def stir(self) -> None:
        """Nothing is due."""

    def hear(self, *samples: TransformStamped, static: bool = False, authority: str = "/node") -> None:
        """A message comes from ROS."""
        self.hear_bytes(encode(samples), static, authority)

    def hear_bytes(self, payload: bytes, static: bool = False, authority: str = "/node") -> None:
        self.carrier.hear(RosMessage(payload, static, authority))

    def say(self, *samples: TransformStamped) -> None:
        """The bus publishes, and the turn ends."""
        self.bus.publish(samples)
        self.endpoint.send()


def named(payload: bytes, old: str, new: str) -> bytes:
    """A message with another name of the same length in it."""
    assert len(old) == len(new)
    return payload.replace(old.encode(), new.encode())


def ros1(*transforms: tuple[bytes, bytes, int, int, tuple[float, ...]]) -> bytes:
    """A message by the definition of ROS 1's serialization."""
    parts = [struct.pack("<I", len(transforms))]
    for number, (parent, child, seconds, nanoseconds, numbers) in enumerate(transforms):
        parts.append(struct.pack("<III", number, seconds, nanoseconds))
        parts += [struct.pack("<I", len(name)) + name for name in (parent, child)]
        parts.append(struct.pack("<7d", *numbers))
    return b"".join(parts)


def ros1_of(sample: TransformStamped) -> tuple[bytes, bytes, int, int, tuple[float, ...]]:
    numbers = *sample.transform.translation, *sample.transform.rotation
    return sample.parent.encode(), sample.child.encode(), *divmod(sample.stamp, 10**9), numbers
