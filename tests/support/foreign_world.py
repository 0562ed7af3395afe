"""A world in memory that works as ROS does, and the carrier of a link to it."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from tfbus import InvalidTransformError, Transform, TransformStamped
from tfbus.links.replica import OutgoingBatch, ReceivedTransform
from tfbus.links.ros.foreign_end import Carrier, ReceivedMessage, Turn
from tfbus.links.seams import Received, SendReport
from tfbus.tf_message import MalformedMessageError


class ForeignTransform(NamedTuple):
    parent: str
    child: str
    stamp: int
    x: float


class ForeignMessage(NamedTuple):
    static: bool
    transforms: Sequence[ForeignTransform]


class ForeignWorld:
    """Two topics, for moving and for static frames; every node hears what the others publish."""

    def __init__(self) -> None:
        self.published: list[tuple[str, ForeignMessage]] = []
        self._latched: dict[str, ForeignMessage] = {}
        self._nodes: dict[str, Callable[[str, ForeignMessage], object]] = {}

    def publish(self, node: str, message: ForeignMessage) -> None:
        self.published.append((node, message))
        if message.static:
            self._latched[node] = message
        for other in list(self._nodes):
            if other != node:
                self.deliver(node, other, message)

    def say(self, *transforms: ForeignTransform, node: str = "driver", static: bool = False) -> None:
        """Publish as a node of that world does."""
        self.publish(node, ForeignMessage(static, transforms))

    def deliver(self, sender: str, node: str, message: ForeignMessage) -> None:
        """Hand a message to a node, if it is there."""
        if node in self._nodes:
            self._nodes[node](sender, message)

    def subscribe(self, node: str, hear: Callable[[str, ForeignMessage], object]) -> None:
        self._nodes[node] = hear
        for other, message in self._latched.items():
            self.deliver(other, node, message)

    def unsubscribe(self, node: str) -> None:
        self._nodes.pop(node, None)


class ForeignCarrier(Carrier):
    """One node of the world."""

    def __init__(self, world: ForeignWorld, node: str = "tfbus") -> None:
        self.id = node
        self._world = world
        self._statics: dict[str, ForeignTransform] = {}

    async def open(self, receive: Callable[[Received], object], report: SendReport) -> None:
        self._report = report
        self._world.subscribe(
            self.id, lambda node, message: receive(Received(node, message, moving=not message.static))
        )

    def send(self, turn: Turn) -> None:
        for entry in turn.entries:
            if isinstance(entry, OutgoingBatch):
                transforms = [_foreign(sample) for sample in entry.samples if not sample.static]
                if transforms:
                    self._publish(static=False, transforms=transforms)
            elif entry.frame not in self._statics:
                self._report.refused("removal", ValueError(f"nobody can be told that {entry.frame!r} is removed"))
        for frame, change in turn.statics.items():
            if change is not None:
                self._statics[frame] = _foreign(change)
            else:
                self._statics.pop(frame, None)
        if turn.statics:
            self._publish(static=True, transforms=list(self._statics.values()))

    def read(self, content: ForeignMessage) -> ReceivedMessage:
        if not content.transforms:
            raise MalformedMessageError("empty", "a message without a transform")
        samples, errors = [], []
        for parent, child, stamp, x in content.transforms:
            try:
                transform = Transform((x, 0.0, 0.0))
                samples.append(ReceivedTransform(parent, child, stamp, transform, "foreign", content.static))
            except InvalidTransformError as error:
                errors.append(error)
        return ReceivedMessage(samples, errors=errors)

    async def run(self) -> None:
        """Nothing takes time."""

    async def close(self) -> None:
        self._world.unsubscribe(self.id)

    def _publish(self, static: bool, transforms: list[ForeignTransform]) -> None:
        self._world.publish(self.id, ForeignMessage(static, transforms))
        self._report.sent(len(transforms))


def _foreign(sample: TransformStamped) -> ForeignTransform:
    return ForeignTransform(sample.parent, sample.child, sample.stamp, sample.transform.translation[0])
