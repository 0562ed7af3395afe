"""Links without network and event loop: buses joined by wires, on which a test delivers, delays or loses packets."""

from collections import deque
from collections.abc import Callable, Collection, Sequence, Set, Sized
from itertools import combinations
from types import TracebackType
from typing import Any, NamedTuple

from hypothesis import strategies as st
from support.samples import moving, static

from tfbus import Bus, InvalidTransformError, SimulatedClock, Transform, TransformStamped
from tfbus.links._carrier import SendReport
from tfbus.links._clock_follower import HearsTime
from tfbus.links._endpoint import LONGEST_CLAIM_PERIOD, Endpoint
from tfbus.links._entries import OutgoingBatch
from tfbus.links._inbox import ReceivedBatch, ReceivedMessage
from tfbus.links._message import Message, MessageWriter, can_hold, read_message, write_answer
from tfbus.links._outbox import Turn
from tfbus.links._part_writer import PartWriter
from tfbus.links._provenance import ReceivedTransform
from tfbus.links._receive_queue import Answer, HistoryAnswer, HistoryQuestion, Presence, Question, Received
from tfbus.links._relay import relay_of
from tfbus.links._state import StateEntry, StateStep
from tfbus.tf_message import MalformedMessageError

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


# A random life of a network of links: steps given by numbers, and checks for the end

Step = tuple[str, int, int, list[int]]
"""A kind of step, the number of a bus, the number of a place, and some more numbers."""


def frames_of(bus: Bus) -> set[str]:
    """The children that a bus knows now: those of the events that a new reader would get."""
    with bus.events() as events:
        return {event.frame for event in iter(events.queue.get, None) if hasattr(event, "frame")}


def steps_of(*more: str) -> st.SearchStrategy[list[Step]]:
    """Short and long lists of steps; `more` are kinds of steps besides the usual ones."""
    kinds = ("publish", "publish", "remove", "send", "send", "deliver", "deliver", "deliver", *more)
    number = st.integers(0, 11)
    step = st.tuples(st.sampled_from(kinds), number, number, st.lists(number, min_size=1, max_size=4))
    return st.lists(step, max_size=10) | st.lists(step, min_size=30, max_size=80)


class Model:
    """Drives a network by steps; each bus has three frames of its own, and all share one."""

    def __init__(self, net: Network) -> None:
        self.net = net
        self._stamp = 0
        self._frozen: set[Bus] = set()

    def do(self, step: str, who: int, where: int, numbers: list[int]) -> None:
        net = self.net
        bus = net.buses[who % len(net.buses)]
        wires = net.wires
        if step == "publish":
            bus.publish([self._sample(who % len(net.buses), number) for number in numbers])
        elif step == "remove":
            if f"{who % len(net.buses)}.{where % 3}" in frames_of(bus):
                bus.remove_frame(f"{who % len(net.buses)}.{where % 3}")
        elif step == "takeover":
            # Buses agree on the last publisher only if no two publish at once.
            net.settle()
            self._stamp += 1
            bus.publish((static if where % 2 else moving)("map", "shared", stamp=self._stamp, x=float(self._stamp)))
            net.settle()
        elif step == "contend":
            self._stamp += 1
            bus.publish(static("map", "contended", stamp=self._stamp, x=float(self._stamp)))
        elif step == "freeze":
            self._frozen.symmetric_difference_update({bus})
        elif step == "expel":
            if frames := sorted(frames_of(bus)):
                bus.remove_frame(frames[where % len(frames)])
        elif step == "banish":
            net.settle()
            if frames := sorted(frames_of(bus)):
                bus.remove_frame(frames[where % len(frames)])
            net.settle()
        elif step == "send":
            net.send(bus)
        elif step == "join":
            net.domains[where % len(net.domains)].join(net.add_bus())
        elif step in ("part", "meet"):
            domain = net.domains[where % len(net.domains)]
            one, other = domain.ends[who % len(domain.ends)], domain.ends[numbers[0] % len(domain.ends)]
            if one is not other and ((one, other) in domain.wires) == (step == "part"):
                (domain.part if step == "part" else domain.meet)(one, other)
        elif step == "flush":
            for wire in wires:
                while wire.packets:
                    wire.deliver()
        elif wires:
            wire = wires[where % len(wires)]
            place = numbers[0] % len(wire.packets)
            if step in ("deliver", "overtake"):
                if wire.receiver.bus not in self._frozen:
                    wire.deliver(place if step == "overtake" else 0)
            elif isinstance(wire.packets[place], Presence):
                # The network tells for sure who is there.
                return
            elif step == "drop":
                del wire.packets[place]
            elif step == "repeat":
                wire.packets.append(wire.packets[place])

    def live(self, steps: list[Step]) -> None:
        """Do all steps, have all peers meet again and receive what they missed, and check that all buses agree."""
        for step in steps:
            self.do(*step)
        for domain in self.net.domains:
            for one, other in combinations(domain.ends, 2):
                if (one, other) not in domain.wires:
                    domain.meet(one, other)
        self.net.settle()
        self.net.recover()
        self.check_nothing_went_wrong()
        self.check_nothing_older_came(say_again=True)
        self.check_no_echo()
        self.move_on()
        self.check_all_agree()

    def _sample(self, member: int, number: int) -> TransformStamped:
        self._stamp += 1
        kind = static if number % 4 == 3 else moving
        parent, child = ("map", "odom")[number % 2], f"{member}.{number % 3}"
        return kind(parent, child, stamp=self._stamp, x=float(self._stamp), authority=("", "slam")[number // 6])

    def move_on(self) -> None:
        """Publish all frames that have turned moving once more, so that every bus hears of the change."""
        for member, bus in enumerate(self.net.buses):
            for frame in sorted(frames_of(bus) - latched(bus).keys()):
                if frame.startswith(f"{member}."):
                    bus.publish(moving("map", frame, 10**9))
        self.net.settle()

    def check_nothing_went_wrong(self) -> None:
        for bus in self.net.buses:
            assert bus.statistics().callbacks_failed == 0
            assert bus.statistics().rejected == {}
        for end in self.net.ends:
            assert (end.carrier.refused, end.endpoint.peers.rejected) == ([], {})

    def check_nothing_older_came(self, say_again: bool = False) -> None:
        """Check that each bus has heard ever newer samples of each frame."""
        for heard in self.net.heard:
            newest: dict[str, int] = {}
            for batch in heard:
                last = {sample.child: sample.stamp for sample in batch if sample.child != "contended"}
                for child, stamp in last.items():
                    known = newest.get(child, -1)
                    assert stamp > known or (say_again and stamp == known)
                newest |= last

    def check_no_echo(self) -> None:
        for member, heard in enumerate(self.net.heard):
            for batch in heard:
                own = [sample.child.startswith(f"{member}.") for sample in batch if sample.child != "contended"]
                assert all(own) if type(batch[0]) is TransformStamped else not any(own)

    def check_all_agree(self) -> None:
        """Check that all buses have the same frames, and the same static samples."""
        first = self.net.buses[0]
        for other in self.net.buses[1:]:
            assert frames_of(other) == frames_of(first)
            assert latched(other) == latched(first)


# A world in memory that works as ROS does, and the carrier of a link to it


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
        for other, hear in self._nodes.items():
            if other != node:
                hear(node, message)

    def say(self, *transforms: ForeignTransform, node: str = "driver", static: bool = False) -> None:
        """Publish as a node of that world does."""
        self.publish(node, ForeignMessage(static, transforms))

    def subscribe(self, node: str, hear: Callable[[str, ForeignMessage], object]) -> None:
        self._nodes[node] = hear
        for other, message in self._latched.items():
            hear(other, message)

    def unsubscribe(self, node: str) -> None:
        self._nodes.pop(node, None)


class ForeignCarrier:
    """One node of the world."""

    def __init__(self, world: ForeignWorld, node: str = "tfbus") -> None:
        self.id = node
        self._world = world
        self._statics: dict[str, ForeignTransform] = {}

    async def open(self, receive: Callable[[Received], object], report: SendReport) -> None:
        self.connect(receive, report)

    def connect(self, receive: Callable[[Received], object], report: SendReport) -> None:
        """Subscribe; for tests without an event loop."""
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
            if isinstance(change, OutgoingBatch):
                self._statics[frame] = _foreign(change.samples[0])
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
        return ReceivedMessage([ReceivedBatch(samples, {"foreign"})], errors=errors)

    async def run(self) -> None:
        """Nothing takes time."""

    async def close(self) -> None:
        self._world.unsubscribe(self.id)

    def _publish(self, static: bool, transforms: list[ForeignTransform]) -> None:
        self._world.publish(self.id, ForeignMessage(static, transforms))
        self._report.sent(len(transforms))


def _foreign(sample: TransformStamped) -> ForeignTransform:
    return ForeignTransform(sample.parent, sample.child, sample.stamp, sample.transform.translation[0])
