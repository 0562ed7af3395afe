"""The live messages of a link for peers that want only some frames.

Such peers hear a part of each turn: what it has published and removed of their frames, numbered like the whole. If that
is not all that has changed of the link's state, the part tells no more of the state than its number; then whoever has
it asks for the rest, as after a loss. So everything that heals a link does so for these peers too.
"""

from collections.abc import Iterator, Mapping, Set

from tfbus.geometry.stamped import TransformStamped
from tfbus.links._carrier import SendReport
from tfbus.links._entries import OutgoingBatch, RemovedFrame
from tfbus.links._message import Message, MessageWriter
from tfbus.links._outbox import Turn
from tfbus.links._state import StateStep


class PartWriter:
    """Writes, for each of several sets of frames, the part of a link's live messages that is about them.

    Parameters
    ----------
    report : SendReport
        Is told of what cannot be in a message.
    """

    def __init__(self, report: SendReport) -> None:
        self._report = report
        self._time: int | None = None
        self._writers: dict[str, MessageWriter] = {}
        self._told: dict[str, int] = {}
        self._wanting: dict[str, list[str]] = {}

    def serve(self, wanted: Mapping[str, Set[str]]) -> None:
        """Write parts for these sets of frames from now on; each has a name, by which its messages are told apart."""
        self._writers = {name: self._writers.get(name) or MessageWriter(self._report) for name in wanted}
        self._told = {name: self._told.get(name, -1) for name in wanted}
        self._wanting = {}
        for name, frames in wanted.items():
            for frame in frames:
                self._wanting.setdefault(frame, []).append(name)

    def write(self, turn: Turn) -> Iterator[tuple[str, Message]]:
        """The messages for one turn, each with the name of its set; none of a set about which nothing is to tell."""
        if turn.time is not None:
            self._time = turn.time
        if not self._writers:
            return
        total, entries = self._split(turn)
        for name, writer in self._writers.items():
            taken, step = entries.get(name, []), turn.step
            if step is not None and sum(map(_size, taken)) < total:
                step = step._replace(since=step.number)
            told = self._told[name]
            number = told if step is None else step.number
            if taken or turn.time is not None or number != told:
                self._told[name] = number
                for message in writer.write(taken, step, self._time):
                    yield name, message

    def claim(self, step: StateStep) -> Iterator[tuple[str, Message]]:
        """A message for each set, without a number and without entries, which claims a state."""
        for name, writer in self._writers.items():
            self._told[name] = step.number
            yield name, writer.claim(step)

    def _split(self, turn: Turn) -> tuple[int, dict[str, list[OutgoingBatch | RemovedFrame]]]:
        """The size of all entries, and the entries for each set that has any."""
        wanting, total = self._wanting, 0
        entries: dict[str, list[OutgoingBatch | RemovedFrame]] = {}
        for entry in turn.entries:
            total += _size(entry)
            if isinstance(entry, RemovedFrame):
                for name in wanting.get(entry.frame, ()):
                    entries.setdefault(name, []).append(entry)
                continue
            taken: dict[str, list[TransformStamped]] = {}
            for sample in entry.samples:
                for name in wanting.get(sample._fields[1], ()):
                    taken.setdefault(name, []).append(sample)
            for name, samples in taken.items():
                entries.setdefault(name, []).append(OutgoingBatch(entry.origin, entry.sequence, tuple(samples)))
        return total, entries


def _size(entry: OutgoingBatch | RemovedFrame) -> int:
    return len(entry.samples) if isinstance(entry, OutgoingBatch) else 1
