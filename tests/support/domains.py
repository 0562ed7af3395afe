"""Whole domains in one process and in simulated time: links of tfbus over networks that lose, cut, stop and kill.

Everything but the event loop and the sockets is real. A run is given by its seed, and takes some milliseconds.
"""

import heapq
import random
from itertools import count

from tfbus import Bus, SimulatedClock, Transform, TransformStamped, UnknownFrameError
from tfbus.geometry.stamped import Batch
from tfbus.links.carrier import Received, ReceiveQueue
from tfbus.links.domain import DomainEnd
from tfbus.links.wire import Joined, Left, WireItem
from tfbus.tf_message import MalformedMessageError

SECOND = 10**9
BACKLOG = 100
"""So many messages wait for a process that is stopped; the others are lost."""


class World:
    """The time, the networks and the processes."""

    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)
        # The library draws pauses.
        random.seed(seed)
        self.now = 1_000.0
        self.processes: list[Process] = []
        self.published: set[tuple[str, int]] = set()
        self._numbers = count()
        self._events: list[tuple[float, int, Wire, str, WireItem]] = []
        self._arrivals: dict[tuple[str, str], float] = {}

    def process(self, *networks: "Network", drop_lost: bool = False) -> "Process":
        """Start a process with a link to each of some networks."""
        process = Process(self, networks, drop_lost)
        self.processes.append(process)
        process.start()
        return process

    def kill(self, process: "Process") -> None:
        self.processes.remove(process)
        for wire in process.wires:
            wire.network.wires.remove(wire)
            for other in wire.network.wires:
                other.part(wire)

    def arrive(self, wire: "Wire", sender: str, item: WireItem, delay: float = 0.0) -> None:
        """Let an item arrive after a while, and behind all that came from its sender before."""
        when = max(self.now + delay, self._arrivals.get((sender, wire.id), 0.0))
        self._arrivals[sender, wire.id] = when
        heapq.heappush(self._events, (when, next(self._numbers), wire, sender, item))

    def run(self, seconds: float) -> None:
        """Let time pass."""
        end = self.now + seconds
        while True:
            running = [process for process in self.processes if not process.stopped]
            due = min((process.due for process in running), default=end + 1)
            due = min(due, self._events[0][0] if self._events else end + 1)
            if due > end:
                break
            self.now = max(self.now, due)
            while self._events and self._events[0][0] <= self.now:
                _, _, wire, sender, item = heapq.heappop(self._events)
                if wire in wire.network.wires:
                    wire.process.take(wire, sender, item)
            for process in running:
                if process.due <= self.now and process in self.processes:
                    process.work()
        self.now = end


class Network:
    """Links that may hear each other."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.wires: list[Wire] = []
        self.loss = 0.0
        self.cuts: set[tuple[Wire, Wire]] = set()

    def cut(self, wire: "Wire", *, inwards: bool = True, outwards: bool = True) -> None:
        """Cut a link off from all others, or one way only."""
        for other in self.wires:
            if other is not wire and inwards:
                self.cuts.add((other, wire))
                wire.part(other)
            if other is not wire and outwards:
                self.cuts.add((wire, other))
                other.part(wire)

    def heal(self) -> None:
        self.cuts.clear()
        self.loss = 0.0
        for wire in self.wires:
            for other in self.wires:
                if other is not wire:
                    wire.meet(other)


class Wire:
    """See `tfbus.links.wire.Wire`; the end of the link that uses it calls it without an event loop."""

    def __init__(self, process: "Process", network: Network) -> None:
        self.process = process
        self.network = network
        self.id = f"{network.world.random.getrandbits(128):032x}"
        self._met: set[str] = set()

    def meet(self, other: "Wire") -> None:
        if other.id not in self._met and (other, self) not in self.network.cuts:
            self._met.add(other.id)
            self.network.world.arrive(self, other.id, Joined(""))

    def part(self, other: "Wire") -> None:
        if other.id in self._met:
            self._met.remove(other.id)
            self.network.world.arrive(self, other.id, Left())

    def is_heard(self, channel: str) -> bool:
        return channel == "all" and len(self.network.wires) > 1

    def publish(self, channel: str, message: bytes) -> None:
        for other in self.network.wires:
            if channel == "all" and other is not self and self.id in other._met:
                self._carry(other, message)

    def send(self, link: str, message: bytes) -> bool:
        other = next((wire for wire in self.network.wires if wire.id == link), None)
        return other is not None and self._carry(other, message)

    def _carry(self, other: "Wire", message: bytes) -> bool:
        world = self.network.world
        if (self, other) in self.network.cuts:
            return False
        if world.random.random() >= self.network.loss:
            world.arrive(other, self.id, message, world.random.uniform(0.0001, 0.005))
        return True


class Process:
    """A bus with a link to each of some networks; the host of their ends, instead of an event loop."""

    def __init__(self, world: World, networks: tuple[Network, ...], drop_lost: bool) -> None:
        self.world = world
        self.bus = Bus(SimulatedClock(int(world.now * SECOND)))
        self.drop_lost = drop_lost
        self.stopped = False
        self.due = world.now
        self.wires = [Wire(self, network) for network in networks]
        self.ends = [
            DomainEnd(self.bus, "tf", wire, drop_lost=drop_lost, now=lambda: world.now) for wire in self.wires
        ]
        self.frames: dict[str, TransformStamped] = {}
        self.seen: list[TransformStamped] = []
        self._backlog: list[tuple[Wire, str, WireItem]] = []
        self._queue = ReceiveQueue(10_000)
        self._sending = False
        self.bus.subscribe(self._note, lambda frame: self.frames.pop(frame, None))

    def start(self) -> None:
        for wire, end in zip(self.wires, self.ends, strict=True):
            end.host = self
            end.attach()
            wire.network.wires.append(wire)
            for other in wire.network.wires:
                if other is not wire:
                    wire.meet(other)
                    other.meet(wire)
        self.work()

    def stop(self) -> None:
        self.stopped = True

    def go_on(self) -> None:
        self.stopped = False
        backlog, self._backlog = self._backlog, []
        for item in backlog:
            self.take(*item)
        self.work()

    def publish(self, frame: str, static: bool) -> None:
        """Publish a sample with a stamp that nobody else uses."""
        stamp = int(self.world.now * SECOND) + len(self.world.published)
        self.world.published.add((frame, stamp))
        self.bus.publish([TransformStamped("map", frame, stamp, Transform(), self.wires[0].id[:4], static)])
        self._flush()

    def remove(self, frame: str) -> None:
        try:
            self.bus.remove_frame(frame)
        except UnknownFrameError:
            return
        self._flush()

    def take(self, wire: Wire, sender: str, item: WireItem) -> None:
        if self.stopped:
            if len(self._backlog) < BACKLOG or not isinstance(item, bytes):
                self._backlog.append((wire, sender, item))
            return
        end = self.ends[self.wires.index(wire)]
        end.take(sender, item)
        while (received := self._queue.get()) is not None:
            try:
                for part in end.split(received):
                    if part is not None:
                        end.handle(received.sender, part)
            except MalformedMessageError as error:
                end.handle(received.sender, error)
        self._flush()

    def work(self) -> None:
        self.due = max(min(end.work() for end in self.ends), self.world.now + 0.0001)
        self._flush()

    def receive(self, item: Received) -> None:
        self._queue.put(item)

    def send_soon(self, pending: int) -> None:
        self._sending = True

    def stir(self) -> None:
        self.due = self.world.now

    def _flush(self) -> None:
        while self._sending:
            self._sending = False
            for end in self.ends:
                end.send()

    def _note(self, batch: Batch) -> None:
        for sample in batch:
            known = self.frames.get(sample.child)
            self.seen.append(sample)
            if known is None or sample.static != known.static or sample.stamp >= known.stamp or sample.static:
                self.frames[sample.child] = sample
