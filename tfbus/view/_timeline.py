"""The stamp that the page shows: the newest, or a chosen one that stands still or runs on."""

from tfbus.stamps import SECOND
from tfbus.tree.forest import Forest

SPEEDS = (0.1, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0)
"""The speeds that the page offers, as multiples of real time."""


class Timeline:
    """A stamp that follows the newest data, stands still, or runs through a span at some speed.

    Attributes
    ----------
    stamp : int or None
        The chosen stamp, in ns; None while the page is live.
    start, end : int
        The span in which a stamp can be chosen, in ns.
    playing : bool
        Whether the chosen stamp runs.
    speed : float
        Relative to real time.
    """

    def __init__(self) -> None:
        self.stamp: int | None = None
        self.start = 0
        self.end = 0
        self.playing = False
        self.speed = 1.0

    def choose(self, stamp: int, span: tuple[int, int]) -> None:
        """Stand still at a stamp of a span, both in ns."""
        self.start, self.end = span
        self.stamp = min(max(stamp, self.start), self.end)
        self.playing = False

    def go_live(self) -> None:
        """Follow the newest data."""
        self.stamp = None
        self.playing = False

    def seek(self, stamp: int) -> None:
        """Go to another stamp of the span; while live, nothing happens."""
        if self.stamp is not None:
            self.stamp = min(max(stamp, self.start), self.end)

    def play(self) -> None:
        """Run from the chosen stamp, or from the start if that is the end; while live, nothing happens."""
        if self.stamp is not None:
            self.playing = True
            if self.stamp >= self.end:
                self.stamp = self.start

    def pause(self) -> None:
        """Stand still where the timeline is."""
        self.playing = False

    def advance(self, elapsed: float) -> None:
        """Run for so many s of real time, and stop at the end of the span."""
        if self.stamp is not None and self.playing:
            self.stamp = min(self.stamp + round(elapsed * self.speed * SECOND), self.end)
            self.playing = self.stamp < self.end

    def step(self, forest: Forest, forward: bool) -> None:
        """Go to the next stamp, or the one before, at which some frame has a sample."""
        if self.stamp is None:
            return
        self.playing = False
        with forest.lock:
            if forward:
                later = [history.neighbours(self.stamp + 1)[1] for history in forest.frames.values()]
                self.seek(min((stamp for stamp in later if stamp is not None), default=self.stamp))
            else:
                earlier = [history.neighbours(self.stamp - 1)[0] for history in forest.frames.values()]
                self.seek(max((stamp for stamp in earlier if stamp is not None), default=self.stamp))


def span_of(forest: Forest) -> tuple[int, int] | None:
    """The oldest and the newest stamp of any moving sample, in ns; None if there is none."""
    with forest.lock:
        oldest = [history.oldest for history in forest.frames.values()]
        newest = [history.newest for history in forest.frames.values()]
    stamps = [stamp for stamp in (*oldest, *newest) if stamp is not None]
    return (min(stamps), max(stamps)) if stamps else None
