"""The last seconds of moving frames, for a link that joins late and wants to look back.

The link asks each peer once, in chunks of whole frames in the order of their names. Live messages of the peer wait
meanwhile, so that the samples of each frame come in order. The answers have the number of the newest sample of each
frame, so a sample that comes both live and in an answer is published once.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from math import inf

from tfbus.bus.bus import Bus
from tfbus.bus.subscribers import SeenKeys
from tfbus.geometry.stamped import TransformStamped
from tfbus.links.message import Heard, Kind, PastQuestion, can_hold, write_body, write_question
from tfbus.links.replica import Known, OutgoingBatch, ReceivedBatch
from tfbus.stamps import from_seconds
from tfbus.tree.history import samples_of

CHUNK = 2_000
"""The most samples in one answer."""
MOST_OF_FRAME = CHUNK
"""The most samples of one frame in an answer, the newest."""
LONGEST_HISTORY = 3_600.0
"""s."""
MOST_HELD = 1_000
"""The most live messages of one peer that wait for its past; with more, the link waits no longer."""
MOST_HELD_SAMPLES = 100_000
"""The most samples and removals in the waiting messages of all peers together; with more, the link waits no longer."""
PATIENCE = 5.0
"""s; the longest wait for one answer."""
LONGEST_ASKING = 60.0
"""s; then the link asks a peer for no more of its past."""
MOST_REMEMBERED = 10_000
"""The most peers that are remembered as asked."""


def chunk_of_past(bus: Bus, brought: Iterable[Known], seconds: float, after: str) -> tuple[list[OutgoingBatch], bool]:
    """The moving samples of the last seconds that a link tells to a peer, and whether these are all.

    Parameters
    ----------
    bus : Bus
        Its buffers hold the samples.
    brought : iterable of Known
        The frames that the link brings.
    seconds : float
    after : str
        The chunk begins with the first frame whose name comes after this one.
    """
    # Most frames may be static, and have no past: each question would sort them and look for one.
    moving = [known for known in brought if known.frame > after and known.sample and not known.sample.static]
    told: list[OutgoingBatch] = []
    count = 0
    for known in sorted(moving, key=lambda known: known.frame):
        samples = _recent(bus, known.frame, seconds)
        if not samples:
            continue
        if count + len(samples) > CHUNK:
            return told, False
        source = known.source
        told.append(OutgoingBatch(source.origin, source.sequence, samples, source.clock, source.shift))
        count += len(samples)
    return told, True


def _recent(bus: Bus, frame: str, seconds: float) -> list[TransformStamped]:
    """The newest samples of a frame that a message can hold, of the buffer that holds the longest history of it."""
    held = (live.forest.frames.get(frame) for live in bus._trees)
    histories = [history for history in held if history is not None and history.oldest is not None]
    if not histories:
        return []
    history = min(histories, key=lambda history: history.oldest or 0)
    newest = history.newest or 0
    low = newest - from_seconds(seconds)
    stamps = history.samples_between(low, newest).stamps[-MOST_OF_FRAME:]
    low = max(low, int(stamps[0]))
    return [sample for sample in samples_of(history, low, newest) if sample.stamp >= low and can_hold(sample)]


@dataclass(slots=True)
class _Open:
    ends: float
    due: float = 0.0
    after: str = ""
    held: list[Heard] = field(default_factory=list)


class HistoryAsker:
    """Asks each peer once for its last seconds, and holds back its live messages meanwhile.

    Parameters
    ----------
    seconds : float
        0 to ask nobody.
    send : callable
        Sends a message to a peer.
    now : callable
        Returns a monotonic time in s.

    Attributes
    ----------
    open : dict
        The open questions, by the ids of the asked peers.
    """

    def __init__(self, seconds: float, send: Callable[[str, bytes], object], now: Callable[[], float]) -> None:
        self._seconds = seconds
        self._send = send
        self._now = now
        self._asked = SeenKeys(MOST_REMEMBERED)
        self.open: dict[str, _Open] = {}
        self._size = 0

    def joined(self, peer: str) -> None:
        """Ask a peer, if it was not asked before."""
        if self._seconds and self._asked.add(peer):
            self._ask(peer, "")

    def holds(self, peer: str, message: Heard) -> bool:
        """Hold a live message of an asked peer back; returns whether there is room."""
        waiting, size = self.open[peer], _size(message)
        if len(waiting.held) >= MOST_HELD or self._size + size > MOST_HELD_SAMPLES:
            return False
        waiting.held.append(message)
        self._size += size
        return True

    def goes_on(self, peer: str, message: Heard) -> bool:
        """Take an answer, and ask for more if there is more; returns whether there is."""
        waiting = self.open.get(peer)
        if waiting is None or message.claim.final:
            return False
        batches = (entry for entry in message.entries if isinstance(entry, ReceivedBatch))
        last = max((sample.child for batch in batches for sample in batch.samples), default="")
        if last <= waiting.after or waiting.ends <= self._now():
            return False
        self._ask(peer, last)
        return True

    def _ask(self, peer: str, after: str) -> None:
        now = self._now()
        waiting = self.open.setdefault(peer, _Open(now + LONGEST_ASKING))
        waiting.after, waiting.due = after, now + PATIENCE
        self._send(peer, write_body(Kind.PAST_QUESTION, write_question(PastQuestion(self._seconds, after))))

    def end(self, peer: str) -> list[Heard]:
        """Stop waiting for the answer of a peer; returns its messages that were held back."""
        held = self.open.pop(peer).held
        self._size -= sum(map(_size, held))
        return held

    def overdue(self) -> list[str]:
        """The peers whose answers have not come in time."""
        now = self._now()
        return [peer for peer, waiting in self.open.items() if waiting.due <= now]

    def next_due(self) -> float:
        """The time at which `overdue` is to be called next."""
        return min((waiting.due for waiting in self.open.values()), default=inf)


def _size(message: Heard) -> int:
    return sum(1 + entry.size for entry in message.entries)
