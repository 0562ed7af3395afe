"""A model of a bus: what it gives each buffer, worked out anew from the list of all that has happened."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from support.oracle.plain_tree import PlainTree, Sample, climb


@dataclass(frozen=True)
class Published:
    batch: tuple[Sample, ...]


@dataclass(frozen=True)
class Removed:
    frame: str


@dataclass(frozen=True)
class Reset:
    """The clock has jumped back."""


@dataclass(frozen=True)
class Joined:
    """A buffer has joined, with a window of `keep` ns, and the history of another one if `prefill` is its number."""

    buffer: int
    keep: int | None
    prefill: int | None = None


@dataclass(frozen=True)
class Left:
    buffer: int


Entry = Published | Removed | Reset | Joined | Left


@dataclass(frozen=True)
class Newest:
    """The newest edge of a child: `stamp` is None if it is static."""

    parent: str
    stamp: int | None


def note(edges: dict[str, Newest], sample: Sample) -> None:
    """Of two kinds the last one wins, of moving samples the newest."""
    before = edges.get(sample.child)
    if sample.static:
        edges[sample.child] = Newest(sample.parent, None)
    elif before is None or before.stamp is None or sample.stamp >= before.stamp:
        edges[sample.child] = Newest(sample.parent, sample.stamp)


def has_loop(edges: dict[str, Newest]) -> bool:
    parents = {child: edge.parent for child, edge in edges.items()}
    return any(name in climb(parents, parents[name]) for name in parents)


@dataclass
class Held:
    """One buffer. `unseen` has the newest moving edges of the bus that it has not seen, because it joined later."""

    tree: PlainTree
    unseen: dict[str, Newest]
    counted: Counter[str] = field(default_factory=Counter)
    on_the_bus: bool = True

    def offer(self, sample: Sample) -> None:
        """Store a sample, unless it is late and would wrongly be taken for the newest."""
        unseen = self.unseen.get(sample.child)
        late = unseen is not None and unseen.stamp is not None and not sample.static and sample.stamp < unseen.stamp
        if unseen is not None and late and sample.parent != unseen.parent:
            self.counted.update(("superseded", "expired"))
            return
        if not late:
            self.unseen.pop(sample.child, None)
        self.counted[self.tree.store(sample).value] += 1

    def remove(self, frame: str) -> None:
        self.tree.remove(frame)
        self.unseen.pop(frame, None)

    def reset(self) -> None:
        self.tree.reset()
        self.unseen.clear()


class PlainBus:
    """The list of all that has happened, and what follows from it."""

    def __init__(self) -> None:
        self.record: list[Entry] = []

    def newest(self) -> dict[str, Newest]:
        """The newest edge of each child."""
        edges: dict[str, Newest] = {}
        for entry in self.record:
            if isinstance(entry, Published):
                for sample in entry.batch:
                    note(edges, sample)
            elif isinstance(entry, Removed):
                edges.pop(entry.frame, None)
            elif isinstance(entry, Reset):
                edges = {child: edge for child, edge in edges.items() if edge.stamp is None}
        return edges

    def refuses(self, batch: Sequence[Sample]) -> bool:
        """Whether the newest edges would form a loop after the batch."""
        edges = self.newest()
        for sample in batch:
            note(edges, sample)
        return has_loop(edges)

    def knows(self, frame: str) -> bool:
        """Whether the bus or a buffer on it knows a frame."""
        edges = self.newest()
        held = [buffer for buffer in self.buffers().values() if buffer.on_the_bus]
        return any(frame in (child, edge.parent) for child, edge in edges.items()) or any(
            frame in buffer.tree.names() for buffer in held
        )

    def on_the_bus(self) -> list[int]:
        """The buffers that have joined and not left."""
        left = [entry.buffer for entry in self.record if isinstance(entry, Left)]
        joined = [entry.buffer for entry in self.record if isinstance(entry, Joined)]
        return [buffer for buffer in joined if buffer not in left]

    def buffers(self) -> dict[int, Held]:
        """Every buffer that has ever joined, as it has to be now."""
        held: dict[int, Held] = {}
        edges: dict[str, Newest] = {}
        latched: dict[str, Sample] = {}
        for entry in self.record:
            on_the_bus = [buffer for buffer in held.values() if buffer.on_the_bus]
            if isinstance(entry, Published):
                for sample in entry.batch:
                    note(edges, sample)
                    latched.pop(sample.child, None)
                    if sample.static:
                        latched[sample.child] = sample
                    for buffer in on_the_bus:
                        buffer.offer(sample)
            elif isinstance(entry, Removed):
                edges.pop(entry.frame, None)
                latched.pop(entry.frame, None)
                for buffer in on_the_bus:
                    buffer.remove(entry.frame)
            elif isinstance(entry, Reset):
                edges = {child: edge for child, edge in edges.items() if edge.stamp is None}
                for buffer in on_the_bus:
                    buffer.reset()
            elif isinstance(entry, Joined):
                held[entry.buffer] = joined(entry, held, edges, latched)
            else:
                held[entry.buffer].on_the_bus = False
        return held


def joined(entry: Joined, held: dict[int, Held], edges: dict[str, Newest], latched: dict[str, Sample]) -> Held:
    """A buffer that joins: it has what it is prefilled with, then the latched samples."""
    if entry.prefill is None:
        late = Held(PlainTree(entry.keep), {child: edge for child, edge in edges.items() if edge.stamp is not None})
    else:
        other = held[entry.prefill]
        late = Held(other.tree.within(entry.keep), dict(other.unseen))
    for sample in latched.values():
        late.offer(sample)
    return late
