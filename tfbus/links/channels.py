"""The channels of a link: one for everything, one for each filter of a peer, and one for the newest samples.

A channel numbers its live messages 1, 2, 3, so that each peer, which hears one channel, notices gaps. ``all`` carries
everything. A filter is a set of frames that some peer has asked for; its channel has the name of the filter, and
carries the samples and removals of its frames. ``slow`` carries the newest sample of each moving frame, at the slow
rate; its messages have no numbers. A message for a channel without listeners is numbered, but not written.
"""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from typing import Final

from tfbus.links.endpoint import MAX_PEERS
from tfbus.links.message import (
    Entry,
    Kind,
    Outgoing,
    Way,
    can_hold,
    reason_not_to_send,
    size_of,
    write_message,
)
from tfbus.links.relay import OutgoingBatch, RemovedFrame, Turn
from tfbus.links.replica import Replica, hash_bytes
from tfbus.links.seams import SendReport, Wire

ALL: Final = "all"
SLOW: Final = "slow"
QUIET: Final = "none"
"""Only signs of life go there, for a link that asks lookups and wants nothing else."""
MOST_FILTERS = 100
LONGEST_FILTER = 2**16
"""Bytes; a link whose names take more receives all frames, and drops the unwanted ones."""
FULL_MESSAGE = 5_000
"""A message with so many samples and removals is full; the batch that fills it is still whole."""
_FORGOTTEN = 30.0
"""s after which a filter without listeners is forgotten."""
_PER_MESSAGE = 1_000


def filter_name(frames: Collection[str]) -> str:
    """The name of the channel of a filter; `ALL` if its names are too long."""
    text = "\0".join(sorted(frames)).encode("utf-8", "surrogatepass")
    return hash_bytes(text, 16).hex() if len(text) <= LONGEST_FILTER else ALL


class _Channel:
    """One numbered channel."""

    __slots__ = ("frames", "heard_at", "name", "number")

    def __init__(self, name: str, frames: frozenset[str] | None, now: float) -> None:
        self.name = name
        self.frames = frames
        self.number = 0
        self.heard_at = now

    def part(self, entries: Sequence[Entry]) -> Sequence[Entry]:
        """The part of some entries that goes here."""
        frames = self.frames
        if frames is None:
            return entries
        found: list[Entry] = []
        for entry in entries:
            if isinstance(entry, RemovedFrame):
                if entry.frame in frames:
                    found.append(entry)
                continue
            samples = tuple(sample for sample in entry.samples if sample._fields[1] in frames)
            if samples:
                found.append(OutgoingBatch(entry.origin, entry.sequence, samples))
        return found


class Channels:
    """Writes what a link publishes, and hands it to the wire.

    Parameters
    ----------
    wire : Wire
    bus : bytes
        The sender's own bus.
    partial : bool
        Whether this link sends and takes some frames only.
    report : SendReport
    """

    def __init__(self, wire: Wire, bus: bytes, partial: bool, report: SendReport) -> None:
        self._wire = wire
        self._bus = bus
        self._partial = partial
        self._report = report
        self._all = _Channel(ALL, None, 0.0)
        self._filters: dict[str, _Channel] = {}
        # The names of filters beyond the bound.
        self._whole: dict[str, None] = {}
        self._newest: dict[str, OutgoingBatch] = {}
        self._time: int | None = None

    def serve(self, frames: frozenset[str], now: float) -> None:
        """Publish a filter from now on; beyond `MOST_FILTERS`, its listeners receive everything."""
        name = filter_name(frames)
        if name in self._filters or name == ALL:
            return
        if len(self._filters) < MOST_FILTERS:
            self._filters[name] = _Channel(name, frames, now)
        elif name not in self._whole:
            unheard = [each for each in self._whole if not self._wire.is_heard(each)]
            for each in unheard:
                del self._whole[each]
            if len(self._whole) < MAX_PEERS:
                self._whole[name] = None

    def send(self, turn: Turn, now: float) -> None:
        """Publish what one turn has gathered."""
        if turn.time is not None:
            self._time = turn.time
        if self._wire.is_heard(SLOW):
            self._note_newest(turn.entries)
        for channel in (self._all, *list(self._filters.values())):
            entries = channel.part(turn.entries)
            if not entries and turn.time is None:
                continue
            if self._is_heard(channel, now):
                self._write(channel, entries)
            else:
                channel.number += 1

    def sign(self, replica: Replica, now: float, reach: Sequence[Way], serves: bool) -> None:
        """Publish a sign of life on each channel."""
        unnumbered = (_Channel(name, None, now) for name in (SLOW, QUIET))
        for channel in (self._all, *list(self._filters.values()), *unnumbered):
            if self._is_heard(channel, now):
                claim = replica.claim(now, channel.frames)._replace(partial=self._partial)
                sign = Outgoing(Kind.SIGN, self._bus, channel.number, claim, self._time, reach, serves)
                self._wire.publish(channel.name, write_message(sign))
                if channel is self._all and self._whole:
                    # A copy of some frames is not to be compared with that of all.
                    sign = replace(sign, claim=claim._replace(partial=True))
                    for name in self._whole:
                        self._wire.publish(name, write_message(sign))

    def send_slowly(self) -> None:
        """Publish the newest sample of each moving frame that was sent since this was called last."""
        if not self._newest or not self._wire.is_heard(SLOW):
            return
        batches = [batch for batch in self._newest.values() if can_hold(batch.samples[0])]
        self._newest.clear()
        for first in range(0, len(batches), _PER_MESSAGE):
            self._write(_Channel(SLOW, None, 0.0), batches[first : first + _PER_MESSAGE])

    def _is_heard(self, channel: _Channel, now: float) -> bool:
        if self._wire.is_heard(channel.name) or (channel is self._all and any(map(self._wire.is_heard, self._whole))):
            channel.heard_at = now
            return True
        if channel.frames is not None and now - channel.heard_at > _FORGOTTEN:
            del self._filters[channel.name]
        return False

    def _note_newest(self, entries: Iterable[Entry]) -> None:
        newest = self._newest
        for entry in entries:
            if isinstance(entry, RemovedFrame):
                newest.pop(entry.frame, None)
                continue
            for sample in entry.samples:
                fields = sample._fields
                newest.pop(fields[1], None)
                if not fields[5]:
                    newest[fields[1]] = OutgoingBatch(entry.origin, entry.sequence, (sample,))

    def _write(self, channel: _Channel, entries: Sequence[Entry]) -> None:
        gathered: list[Entry] = []
        size = 0
        for entry in entries:
            gathered.append(entry)
            size += size_of(entry)
            if size >= FULL_MESSAGE:
                self._write_one(channel, gathered)
                gathered, size = [], 0
        if gathered or not entries:
            self._write_one(channel, gathered)

    def _write_one(self, channel: _Channel, entries: list[Entry]) -> None:
        """One message of all entries if possible, else several; what cannot be sent is left out and reported."""
        number = 0 if channel.name == SLOW else channel.number + 1
        out = Outgoing(Kind.LIVE, self._bus, number, time=self._time)
        try:
            message = write_message(out, entries)
        except ValueError as error:
            failure: Exception = error
        else:
            channel.number = number
            self._wire.publish(channel.name, message)
            if channel is self._all:
                for name in self._whole:
                    self._wire.publish(name, message)
            self._report.sent(sum(map(size_of, entries)))
            return
        sendable = [kept for kept in map(self._sendable, entries) if kept is not None]
        if sendable != entries:
            if sendable:
                self._write_one(channel, sendable)
        elif len(entries) > 1:
            middle = len(entries) // 2
            self._write_one(channel, entries[:middle])
            self._write_one(channel, entries[middle:])
        else:
            self._report.refused("oversized", failure, size_of(entries[0]))

    def _sendable(self, entry: Entry) -> Entry | None:
        """The part of an entry that a message can hold: the entry itself if that is all, None if it is nothing."""
        if isinstance(entry, RemovedFrame):
            try:
                write_message(Outgoing(Kind.LIVE, self._bus), [entry])
            except ValueError as error:
                self._report.refused("frame name", error)
                return None
            return entry
        errors = list(map(reason_not_to_send, entry.samples))
        if not any(errors):
            return entry
        for refused in filter(None, errors):
            self._report.refused(refused.reason, refused)
        kept = tuple(sample for sample, error in zip(entry.samples, errors, strict=True) if error is None)
        return OutgoingBatch(entry.origin, entry.sequence, kept) if kept else None
