"""Links with no network between them: buses joined by wires, on which a test itself lets things come, late or never."""

from collections import deque
from collections.abc import Collection, Iterator, Sequence, Sized
from types import TracebackType

from tfbus import Bus, SimulatedClock, TransformStamped
from tfbus.links.inbox import Inbox
from tfbus.links.outbox import Message, Outbox
from tfbus.links.peers import Peers
from tfbus.links.provenance import ReceivedTransform
from tfbus.links.relay import join, leave

Batch = tuple[TransformStamped, ...]
Packet = Message | bool
"""A message, or whether its sender is there now."""
Graph = Sequence[Sequence[int]]
"""Which buses are in each of several domains."""

PAIR: Graph = [[0, 1]]
MESH: Graph = [[0, 1, 2, 3]]
CHAIN: Graph = [[0, 1], [1, 2], [2, 3]]
RING: Graph = [[0, 1], [1, 2], [2, 0]]
CIRCLE: Graph = [[0, 1], [1, 2], [2, 3], [3, 0]]
RING_WITH_A_TAIL: Graph = [[0, 1], [1, 2], [2, 0], [0, 3]]
TWO_BRIDGES: Graph = [[0, 1, 2], [1, 2, 3]]


class End:
    """One link of one bus, as `ZenohLink` puts it together, with what zenoh keeps for those who join late."""

    def __init__(
        self, name: str, bus: Bus, frames: Collection[str] | None, max_frames: int = 10_000, drop_lost: bool = False
    ) -> None:
        self.id = name
        self.bus = bus
        self.refused: list[Exception] = []
        self.reports: list[tuple[str, str]] = []
        self.losses: list[tuple[str, tuple[str, ...]]] = []
        self.cache: dict[str, Message] = {}
        self.outbox = Outbox(frames, lambda: None, self.refused.append)
        self.peers = Peers(lambda peer, reason, _: self.reports.append((peer, reason)))
        self.relay = join(bus, self.outbox)
        self.inbox = Inbox(bus, self.relay, self.outbox, frames, max_frames, self.peers)
        self._drop_lost = drop_lost

    def messages(self) -> Iterator[Message]:
        """All that goes out now: the live messages, and behind them what has changed of the static frames."""
        yield from self.outbox.flush()
        while changes := self.outbox.take_statics(100):
            for frame, message in changes.items():
                if message is None:
                    self.cache.pop(frame, None)
                else:
                    self.cache[frame] = message
                    yield message

    def bury(self) -> None:
        """Keep no tombstones any more."""
        self.cache = {frame: message for frame, message in self.cache.items() if message.samples}

    def take_in(self, sender: str, packet: Packet) -> None:
        if isinstance(packet, Message):
            self.inbox.receive(sender, packet.payload, packet.attachment)
        elif packet:
            peer = self.peers.find(sender)
            assert peer is not None
            peer.present = True
        elif (gone := self.peers.forget(sender)) is not None:
            self.losses.append((sender, self.relay.lose(gone, self.outbox, self._drop_lost)))

    def leave(self) -> None:
        leave(self.bus, self.outbox)
        for peer in self.peers.forget_all():
            self.relay.lose(peer, self.outbox, drop=False)


class Wire:
    """From one end to another: what was sent and has not come yet."""

    def __init__(self, sender: End, receiver: End) -> None:
        self.sender = sender
        self.receiver = receiver
        self.packets: deque[Packet] = deque([True, *sender.cache.values()])

    def deliver(self, place: int = 0) -> None:
        packet = self.packets[place]
        del self.packets[place]
        self.receiver.take_in(self.sender.id, packet)


class Domain:
    """Ends that are joined to one another, each to each."""

    def __init__(self) -> None:
        self.ends: list[End] = []
        self.wires: dict[tuple[End, End], Wire] = {}
        self._names = iter(range(10**6))

    def join(
        self, bus: Bus, frames: Collection[str] | None = None, max_frames: int = 10_000, drop_lost: bool = False
    ) -> End:
        """A new end; what the others have in their caches is on its way to it."""
        new = End(f"{id(self)} {next(self._names)}", bus, frames, max_frames, drop_lost)
        for other in self.ends:
            self.meet(other, new)
        self.ends.append(new)
        return new

    def meet(self, one: End, other: End) -> None:
        """Connect two ends."""
        for pair in ((one, other), (other, one)):
            self.wires[pair] = Wire(*pair)

    def part(self, one: End, other: End) -> None:
        """Cut two ends off from each other: what was on its way is lost, and each notices."""
        for sender, receiver in ((one, other), (other, one)):
            if self.wires.pop((sender, receiver), None):
                receiver.take_in(sender.id, False)

    def kill(self, end: End) -> None:
        """An end dies; what is on its way from it still comes, and then that it has gone."""
        self.ends.remove(end)
        for sender, receiver in list(self.wires):
            if sender is end:
                self.wires[sender, receiver].packets.append(False)
            elif receiver is end:
                del self.wires[sender, receiver]

    def send(self, sender: End) -> None:
        """The turn of an end's event loop is over."""
        for message in sender.messages():
            for wire in self.wires.values():
                if wire.sender is sender:
                    wire.packets.append(message)


class Network:
    """Buses in a graph of domains, and what each of them hears, beginning with its own."""

    def __init__(self, graph: Graph, drop_lost: bool = False) -> None:
        self.buses: list[Bus] = []
        self.heard: list[list[Batch]] = []
        for _ in {member for members in graph for member in members}:
            self.add_bus()
        self.domains = [Domain() for _ in graph]
        for domain, members in zip(self.domains, graph, strict=True):
            for member in members:
                domain.join(self.buses[member], drop_lost=drop_lost)
        self.settle()

    def __enter__(self) -> "Network":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        for domain in self.domains:
            for end in domain.ends:
                end.leave()

    def add_bus(self) -> Bus:
        bus = Bus(SimulatedClock())
        heard: list[Batch] = []
        bus.subscribe(heard.append)
        self.buses.append(bus)
        self.heard.append(heard)
        return bus

    @property
    def ends(self) -> list[End]:
        return [end for domain in self.domains for end in domain.ends]

    @property
    def wires(self) -> list[Wire]:
        """Those on which something is."""
        return [wire for domain in self.domains for wire in domain.wires.values() if wire.packets]

    def send(self, bus: Bus) -> None:
        """The turn of a bus's event loop is over."""
        for domain in self.domains:
            for end in domain.ends:
                if end.bus is bus:
                    domain.send(end)

    def settle(self) -> None:
        """Everything is sent and comes, until nothing moves any more; an echo would go on for ever."""
        for _ in range(100):
            for bus in self.buses:
                self.send(bus)
            if not self.wires:
                return
            for wire in self.wires:
                while wire.packets:
                    wire.deliver()
        raise AssertionError("the network does not come to rest")

    def recover(self) -> None:
        """What receivers have missed of the static frames comes."""
        for domain in self.domains:
            for wire in domain.wires.values():
                wire.packets.extend(wire.sender.cache.values())
        self.settle()

    def published(self, member: int) -> list[Batch]:
        """What a bus has published itself."""
        return [batch for batch in self.heard[member] if type(batch[0]) is TransformStamped]

    def received(self, member: int, origin: int) -> list[Batch]:
        """What has come to a bus of those batches that another one has published."""
        ends = [end for end in self.ends if end.bus is self.buses[origin]]
        return [
            batch
            for batch in self.heard[member]
            if isinstance(batch[0], ReceivedTransform) and batch[0]._source.origin == ends[0].relay.origin
        ]


def size_of(*things: object) -> int:
    """How many entries all containers in some objects have."""
    return sum(len(value) for thing in things for value in vars(thing).values() if isinstance(value, Sized))


def latched(bus: Bus) -> dict[str, TransformStamped]:
    """The static samples that a bus gives to late joiners."""
    got: list[Batch] = []
    bus.subscribe(got.append).close()
    return {sample.child: sample for batch in got for sample in batch}
