"""Links without network and event loop: buses joined by wires, on which a test delivers, delays or loses packets."""

from collections import deque
from collections.abc import Callable, Collection, Sequence, Set, Sized
from types import TracebackType
from typing import Any

from tfbus import Bus, SimulatedClock, TransformStamped
from tfbus.links._carrier import SendReport
from tfbus.links._clock_follower import HearsTime
from tfbus.links._endpoint import LONGEST_CLAIM_PERIOD, Endpoint
from tfbus.links._inbox import ReceivedMessage
from tfbus.links._message import Message, MessageWriter, can_hold, read_message, write_answer
from tfbus.links._outbox import Turn
from tfbus.links._part_writer import PartWriter
from tfbus.links._provenance import ReceivedTransform
from tfbus.links._receive_queue import Answer, HistoryAnswer, HistoryQuestion, Presence, Question, Received
from tfbus.links._relay import relay_of
from tfbus.links._state import StateEntry, StateStep

Batch = tuple[TransformStamped, ...]
Packet = Message | Presence | Question | Answer | HistoryQuestion | HistoryAnswer
Graph = Sequence[Sequence[int]]
"""The buses of each of several domains, by their numbers."""

PAIR: Graph = [[0, 1]]
MESH: Graph = [[0, 1, 2, 3]]
CHAIN: Graph = [[0, 1], [1, 2], [2, 3]]
RING: Graph = [[0, 1], [1, 2], [2, 0]]
CIRCLE: Graph = [[0, 1], [1, 2], [2, 3], [3, 0]]
RING_WITH_A_TAIL: Graph = [[0, 1], [1, 2], [2, 0], [0, 3]]
TWO_BRIDGES: Graph = [[0, 1, 2], [1, 2, 3]]
CIRCLE_OF_FIVE: Graph = [[0, 1], [1, 2], [2, 3], [3, 4], [4, 0]]
TRIANGLE: Graph = [[0, 1, 2], [1, 2, 3], [2, 3, 0]]


class WireCarrier:
    """Puts a link's messages, questions and answers on wires."""

    def __init__(
        self,
        id: str,  # noqa: A002 - the protocol calls it so
        put: Callable[[Message], object],
        put_to: Callable[[str, Packet], object],
        wanted: Callable[[], dict[str, Set[str]]],
    ) -> None:
        self.id = id
        self.refused: list[Exception] = []
        self._put = put
        self._put_to = put_to
        self._wanted = wanted
        self._writer = MessageWriter(SendReport(self.refused.append))
        self._parts = PartWriter(SendReport(self.refused.append))

    async def open(self, receive: Callable[[Received], object], report: SendReport) -> None:
        """A wire needs no opening."""

    def send(self, turn: Turn) -> None:
        for message in self._writer.write(turn.entries, turn.step, turn.time):
            self._put(message)
        self._parts.serve(self._wanted())
        for peer, message in self._parts.write(turn):
            self._put_to(peer, message)

    def read(self, content: Any) -> ReceivedMessage:
        return read_message(content.payload, content.attachment)

    def can_hold(self, sample: TransformStamped) -> bool:
        return can_hold(sample)

    def claim(self, step: StateStep) -> None:
        self._put(self._writer.claim(step))
        self._parts.serve(self._wanted())
        for peer, message in self._parts.claim(step):
            self._put_to(peer, message)

    def ask(self, peer: str, since: int) -> None:
        self._put_to(peer, Question(since, self.id))

    def write_answer(self, entries: Sequence[StateEntry], step: StateStep) -> Message:
        return write_answer(entries, step)

    def answer(self, question: Question | HistoryQuestion, message: Message) -> None:
        answer = Answer if isinstance(question, Question) else HistoryAnswer
        self._put_to(question.handle, answer(message))

    def ask_history(self, peer: str, seconds: float, after: str) -> None:
        self._put_to(peer, HistoryQuestion(seconds, after, self.id))

    async def run(self) -> None:
        """Nothing takes time."""

    async def close(self) -> None:
        """A wire needs no closing."""


class End:
    """One link of one bus."""

    def __init__(
        self,
        name: str,
        bus: Bus,
        domain: "Domain",
        frames: Collection[str] | None,
        max_frames: int = 10_000,
        drop_lost: bool = False,
        history: float | None = None,
        follower: HearsTime | None = None,
    ) -> None:
        self.id = name
        self.bus = bus
        self.frames = None if frames is None else frozenset(frames)
        self.carrier = WireCarrier(
            name,
            lambda message: domain.put(self, message),
            lambda peer, packet: domain.put_to(self, peer, packet),
            lambda: domain.wanted(self),
        )
        self.endpoint = Endpoint(
            bus,
            name,
            self.carrier,
            lambda: None,
            frames=frames,
            drop_lost=drop_lost,
            max_frames=max_frames,
            now=lambda: domain.time,
            history=history,
            follower=follower,
        )
        self.relay = relay_of(bus)
        self.endpoint.attach()

    def receive(self, sender: str, packet: Packet) -> None:
        self.endpoint.handle(Received(sender, packet))

    def leave(self) -> None:
        self.endpoint.detach()


class Wire:
    """The way from one end to another, with the packets that were sent and not delivered yet."""

    def __init__(self, sender: End, receiver: End) -> None:
        self.sender = sender
        self.receiver = receiver
        self.packets: deque[Packet] = deque([Presence.JOINED])

    def deliver(self, place: int = 0) -> None:
        packet = self.packets[place]
        del self.packets[place]
        self.receiver.receive(self.sender.id, packet)


class Domain:
    """Ends that are joined to one another, each to each, in a time of their own."""

    def __init__(self) -> None:
        self.time = 0.0
        self.ends: list[End] = []
        self.wires: dict[tuple[End, End], Wire] = {}
        self._names = iter(range(10**6))

    def join(
        self,
        bus: Bus,
        frames: Collection[str] | None = None,
        max_frames: int = 10_000,
        drop_lost: bool = False,
        history: float | None = None,
        follower: HearsTime | None = None,
    ) -> End:
        """A new end."""
        new = End(f"{id(self)} {next(self._names)}", bus, self, frames, max_frames, drop_lost, history, follower)
        for other in self.ends:
            self.meet(other, new)
        self.ends.append(new)
        return new

    def meet(self, one: End, other: End) -> None:
        """Connect two ends."""
        for pair in ((one, other), (other, one)):
            self.wires[pair] = Wire(*pair)

    def part(self, one: End, other: End) -> None:
        """Cut two ends off from each other: packets on their way are lost, and each end notices."""
        for sender, receiver in ((one, other), (other, one)):
            if self.wires.pop((sender, receiver), None):
                receiver.receive(sender.id, Presence.LEFT)

    def kill(self, end: End) -> None:
        """End a peer: its packets on their way still arrive, and behind them that it has gone."""
        self.ends.remove(end)
        for sender, receiver in list(self.wires):
            if sender is end:
                self.wires[sender, receiver].packets.append(Presence.LEFT)
            elif receiver is end:
                del self.wires[sender, receiver]

    def put(self, sender: End, message: Message) -> None:
        """Send a live message to those that hear all."""
        for wire in self.wires.values():
            if wire.sender is sender and wire.receiver.frames is None:
                wire.packets.append(message)

    def wanted(self, sender: End) -> dict[str, Set[str]]:
        """The frames that each of the others wants, of those that want only some."""
        ends = (receiver for one, receiver in self.wires if one is sender)
        return {end.id: end.frames for end in ends if end.frames is not None}

    def put_to(self, sender: End, receiver: str, packet: Packet) -> None:
        for wire in self.wires.values():
            if wire.sender is sender and wire.receiver.id == receiver:
                wire.packets.append(packet)

    def pass_time(self) -> bool:
        """Let time pass until somebody asks a question; returns whether anybody does."""
        due = [time for end in self.ends if (time := end.endpoint.next_question()) is not None]
        self.time = max(self.time, *due, 0.0)
        for end in self.ends:
            end.endpoint.reconcile()
        return bool(due)

    def settle(self) -> None:
        """Deliver everything that is on its way, in order."""
        while waiting := [wire for wire in self.wires.values() if wire.packets]:
            for wire in waiting:
                wire.deliver()

    def claim(self) -> None:
        """Have all ends claim their states."""
        self.time += LONGEST_CLAIM_PERIOD
        for end in self.ends:
            end.endpoint.send()
            end.endpoint.reconcile()


class Network:
    """Buses in a graph of domains, and all batches that each of them has heard, its own included."""

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
        """The wires that hold packets."""
        return [wire for domain in self.domains for wire in domain.wires.values() if wire.packets]

    def send(self, bus: Bus) -> None:
        """End a turn of a bus's event loop."""
        for end in self.ends:
            if end.bus is bus:
                end.endpoint.send()

    def settle(self) -> None:
        """Send and deliver everything until nothing moves any more; an echo would go on for ever."""
        for _ in range(1_000):
            for end in self.ends:
                end.endpoint.send()
            for wire in self.wires:
                while wire.packets:
                    wire.deliver()
            asked = [domain.pass_time() for domain in self.domains]
            if not self.wires and not any(asked) and not any(end.endpoint.outbox.pending for end in self.ends):
                return
        raise AssertionError("the network does not come to rest")

    def recover(self) -> None:
        """Have all ends claim their states, so that each asks for what it has missed."""
        for domain in self.domains:
            domain.claim()
        self.settle()

    def published(self, member: int) -> list[Batch]:
        """The batches that a bus has published itself."""
        return [batch for batch in self.heard[member] if type(batch[0]) is TransformStamped]

    def received(self, member: int, origin: int) -> list[Batch]:
        """The batches of another bus that have come to a bus."""
        ends = [end for end in self.ends if end.bus is self.buses[origin]]
        return [
            batch
            for batch in self.heard[member]
            if isinstance(batch[0], ReceivedTransform) and batch[0]._provenance.origin == ends[0].relay.origin
        ]


def size_of(*things: object) -> int:
    """The number of entries in all containers that some objects have."""
    return sum(len(value) for thing in things for value in vars(thing).values() if isinstance(value, Sized))


def latched(bus: Bus) -> dict[str, TransformStamped]:
    """The static samples that a bus gives to late joiners."""
    got: list[Batch] = []
    bus.subscribe(got.append).close()
    return {sample.child: sample for batch in got for sample in batch}
