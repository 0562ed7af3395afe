"""A buffer that joined a bus after samples had been published, until it has caught up.

The invariant: each frame has the same newest parent and kind in a buffer as on its bus. A frame from a prefill may have
no edge on the bus; then it forms no loop with the edges of the bus. So no buffer ever holds a newest topology that the
bus would refuse.

A buffer that joined before the first sample keeps the invariant by itself, because it gets every accepted sample. A
buffer that joined late does not::

    published    c below a at 10,  c below b at 20,  [the buffer joins],  c below a at 15 (late)
    the bus      c below b: the newest stamp decides
    the buffer   would take c below a for the newest, because it has seen nothing else

So `LateBuffer` leaves out a late sample that names another parent than the newest edge of the bus, until the buffer has
seen a sample as new as that edge. If a frame of the prefill has another newest parent than on the bus, or closes a loop
with edges of the bus, `LateBuffer` removes it.
"""

from tfbus.bus.topology import Topology
from tfbus.geometry.stamped import Batch, TransformStamped
from tfbus.waiting.live_tree import LiveTree


class LateBuffer:
    """The differences between the newest edges of a bus and of a buffer that has just joined.

    Parameters
    ----------
    live : LiveTree
        The buffer, empty or prefilled. Edges in it that contradict the bus are removed.
    topology : Topology
        The newest edges of the bus.
    """

    def __init__(self, live: LiveTree, topology: Topology) -> None:
        self._live = live
        self._frames = live.forest.frames
        self._newest_edge = newest_edge = topology.newest
        # Frames of the prefill that the bus does not know, or knows only up to an older stamp.
        self._foreign: set[str] = set()
        for child, history in tuple(self._frames.items()):
            edge = newest_edge(child)
            if edge is None:
                if len(history):
                    self._foreign.add(child)
            elif (edge.newest is not None and history.newest is None) or history.parent != edge.parent:
                live.remove_frame(child)
            elif edge.newest is not None and history.newest is not None and history.newest > edge.newest:
                self._foreign.add(child)
        # Frames whose newest sample on the bus the buffer has not seen, with its parent and its stamp in ns.
        self._unseen = topology.moving()
        for child, history in self._frames.items():
            unseen = self._unseen.get(child)
            if unseen is not None and history.newest is not None and history.newest >= unseen[1]:
                del self._unseen[child]
        for child in tuple(self._foreign):
            self._open_loop(child)

    @property
    def has_caught_up(self) -> bool:
        """Whether the buffer keeps the invariant by itself from now on."""
        return not (self._unseen or self._foreign)

    def insert(self, batch: Batch) -> None:
        """Insert the samples of a batch that the bus has accepted, without the superseded ones."""
        wanted = tuple(sample for sample in batch if not self._is_superseded(sample))
        self._live.superseded += len(batch) - len(wanted)
        if self._foreign:
            for sample in wanted:
                self._yield_to(sample)
        if wanted:
            self._live.insert(wanted)

    def forget(self, frame: str) -> None:
        """Note that a frame was removed."""
        self._unseen.pop(frame, None)
        self._foreign.discard(frame)

    def clear_moving(self) -> None:
        """Note that the clock jumped back: the bus and the buffer have no moving samples any more."""
        self._unseen.clear()
        self._foreign = {frame for frame in self._foreign if self._frames[frame].static}

    def _is_superseded(self, sample: TransformStamped) -> bool:
        """Whether the bus had a newer sample with another parent before the buffer joined."""
        parent, child, stamp, _, _, static = sample._fields
        unseen = self._unseen.get(child)
        if unseen is None:
            return False
        if static or stamp >= unseen[1]:
            del self._unseen[child]
            return False
        return parent != unseen[0]

    def _yield_to(self, sample: TransformStamped) -> None:
        """Remove the frames of the prefill that contradict the newest edge of a sample's child on the bus."""
        child = sample.child
        edge, history = self._newest_edge(child), self._frames.get(child)
        if edge is None:
            return
        if child in self._foreign and history is not None:
            ahead = edge.newest is not None and history.newest is not None and history.newest > edge.newest
            if not ahead:
                self._foreign.discard(child)
            elif history.parent != edge.parent:
                self._foreign.discard(child)
                self._live.remove_frame(child)
        if history is None or history.parent != edge.parent or not len(history):
            self._open_loop(child)

    def _open_loop(self, child: str) -> None:
        """Remove the frames of the prefill that form a loop with a frame, by the newest edges of the bus."""
        walk: dict[str, None] = {}
        here: str | None = child
        while here is not None and here not in walk:
            walk[here] = None
            edge = self._newest_edge(here)
            if edge is None and here in self._foreign:
                edge = self._frames[here]
            here = None if edge is None else edge.parent
        if here is None:
            return
        frames = list(walk)
        for frame in frames[frames.index(here) :]:
            if frame in self._foreign and self._newest_edge(frame) is None:
                self._foreign.discard(frame)
                self._live.remove_frame(frame)
