"""The channels of a link: one for everything, one for each filter of a peer, and one for the newest samples.

A channel numbers its live messages 1, 2, 3, so that each peer, which hears one channel, notices gaps. ``all`` carries
everything. A filter is a set of frames that some peer has asked for; its channel has the name of the filter, and
carries the samples and removals of its frames. ``slow`` carries the newest sample of each moving frame, at the slow
rate; its messages have no numbers. A message for a channel without listeners is numbered, but not written.
"""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from math import inf
from typing import Final

from tfbus.links.endpoint import MAX_PEERS
from tfbus.links.message import Kind, Outgoing, Way, write_message
from tfbus.links.replica import Entry, OutgoingBatch, RemovedFrame, View, hash_bytes
from tfbus.links.seams import SendReport, Wire

ALL: Final = "all"
SLOW: Final = "slow"
MOST_FILTERS = 100
LONGEST_FILTER = 2**16
"""Bytes; a link whose names take more receives all frames, and drops the unwanted ones."""
_FORGOTTEN = 30.0
"""s after which a filter without listeners is forgotten."""


def filter_name(frames: Collection[str]) -> str:
    """The name of the channel of a filter; `ALL` if its names are too long."""
    text = "\0".join(sorted(frames)).encode("utf-8", "surrogatepass")
    return hash_bytes(text, 16).hex() if len(text) <= LONGEST_FILTER else ALL


QUIET: Final = filter_name(())
"""The filter of no frames, for a link that asks lookups and wants nothing else."""


@dataclass(eq=False, slots=True)
class _Channel:
    """One stream of messages about some frames, None for all, and the names by which peers hear it."""

    frames: frozenset[str] | None
    names: list[str]
    heard_at: float = inf
    number: int = 0


class Channels:
    """Writes what a link publishes, and hands it to the wire.

    Parameters
    ----------
    wire : Wire
    bus : bytes
        The sender's own bus.
    slow_rate : float
        How often the newest samples are sent, in Hz.
    report : SendReport
    """

    def __init__(self, wire: Wire, bus: bytes, slow_rate: float, report: SendReport) -> None:
        self._wire = wire
        self._bus = bus
        self._report = report
        self._all = _Channel(None, [ALL])
        self._slow = _Channel(None, [SLOW])
        self._channels = [self._all, self._slow, _Channel(frozenset(), [QUIET])]
        self._newest: dict[str, OutgoingBatch] = {}
        self._slow_period = 1 / slow_rate
        self._slow_due = -inf
        self._time: int | None = None

    def serve(self, frames: frozenset[str], now: float) -> None:
        """Publish a filter from now on; beyond `MOST_FILTERS`, its listeners receive everything."""
        name = filter_name(frames)
        if any(name in channel.names for channel in self._channels):
            return
        if len(self._channels) < MOST_FILTERS + 3:
            self._channels.append(_Channel(frames, [name], now))
        else:
            heard = filter(self._wire.is_heard, self._all.names[1:])
            self._all.names = [ALL, *heard, name][: 1 + MAX_PEERS]

    def send(self, gathered: Sequence[Entry], time: int | None, now: float) -> None:
        """Publish what one turn has gathered, and the time of the clock if it has to be told."""
        if time is not None:
            self._time = time
        for channel in list(self._channels):
            if channel is self._slow:
                self._note_newest(gathered, now)
                continue
            parts = (entry.within(channel.frames) for entry in gathered)
            entries = [part for part in parts if part is not None]
            if not entries and time is None:
                continue
            if self._is_heard(channel, now):
                self._write(channel, entries)
            else:
                channel.number += 1

    def sign(self, view: View, is_whole: bool, now: float, reach: Sequence[Way], serves: bool, clocks: bytes) -> None:
        """Publish a sign of life on each channel; `is_whole` says whether no answers are being fetched."""
        for channel in list(self._channels):
            if self._is_heard(channel, now):
                claim = view.claim(now, channel.frames)._replace(final=is_whole)
                sign = Outgoing(Kind.SIGN, self._bus, channel.number, claim, self._time, reach, serves, clocks)
                message = write_message(sign)
                for name in channel.names:
                    self._wire.publish(name, message)

    def send_slowly(self, now: float) -> float:
        """Publish the newest sample of each moving frame if it is time; returns the next time for that."""
        if not self._wire.is_heard(SLOW):
            return inf
        if now >= self._slow_due:
            self._slow_due = now + self._slow_period
            if self._newest:
                self._write(self._slow, list(self._newest.values()))
                self._newest.clear()
        return self._slow_due

    def _is_heard(self, channel: _Channel, now: float) -> bool:
        if any(map(self._wire.is_heard, channel.names)):
            channel.heard_at = max(channel.heard_at, now)
            return True
        if now - channel.heard_at > _FORGOTTEN:
            self._channels.remove(channel)
        return False

    def _note_newest(self, entries: Iterable[Entry], now: float) -> None:
        newest = self._newest
        if not self._is_heard(self._slow, now):
            newest.clear()
            return
        for entry in entries:
            if isinstance(entry, RemovedFrame):
                newest.pop(entry.frame, None)
                continue
            for sample in entry.samples:
                newest.pop(sample.child, None)
                if not sample.static:
                    newest[sample.child] = OutgoingBatch(
                        entry.origin, entry.sequence, (sample,), entry.clock, entry.shift
                    )

    def _write(self, channel: _Channel, entries: Sequence[Entry]) -> None:
        """One message of all entries if possible, else several; a batch that is too large is left out and reported."""
        size = sum(entry.size for entry in entries)
        number = 0 if channel is self._slow else channel.number + 1
        out = Outgoing(Kind.LIVE, self._bus, number, time=self._time)
        try:
            message = write_message(out, entries)
        except ValueError as error:
            middle = len(entries) // 2
            if middle:
                self._write(channel, entries[:middle])
                self._write(channel, entries[middle:])
            else:
                self._report.refused("oversized", error, size)
            return
        channel.number = number
        for name in channel.names:
            self._wire.publish(name, message)
        self._report.sent(size)
