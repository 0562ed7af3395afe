"""`Finding`, one thing that is wrong with a frame or with the whole tree."""

from dataclasses import dataclass

from tfbus.plain import printable
from tfbus.stamps import format_stamp

ADVICE = {
    "translation": "no robot is there: look for an uninitialised or diverged estimate at its sender",
    "jump": "the sender has reset, or mixes two estimates: look at it, or leave these out with max_speed=",
    "turn": "the sender has reset, or two estimates disagree: look at what it does then",
    "stamps go back": "messages overtake each other, or a clock was set back: use one sender, and one clock",
    "ahead": "the clock of the sender is ahead of that of the recorder: synchronise them",
    "duplicate stamps": "the last one wins: give each transform a stamp of its own, or send it once",
    "gap": "lookups interpolate across it: look for what stopped the sender, or refuse with max_gap=",
    "rate": "the sender is overloaded, or messages are lost on the way",
    "two authorities": "each overwrites the other: let one of them send the frame",
    "two parents": "a frame has one parent: give it one, or a name for each",
    "rotation": "normalise quaternions before they are sent",
    "static changes": "a static transform is sent once: send it as a moving one",
    "two kinds": "a frame is static or moving: the last kind wins, and drops the history of the other",
    "never moves": "if it is fixed, send it once as a static transform; if it only stood still, all is well",
    "disconnected": "nothing can be looked up between these trees: a transform is missing",
    "refused": "these are left out",
    "unfinished": "copy the file again; if its writer was killed, this is what can be read",
}
"""The advice for each kind of finding."""
HINTS = frozenset(("never moves",))
"""The kinds that may be as they are meant."""


@dataclass(frozen=True, slots=True)
class Finding:
    """Something that is wrong.

    Parameters
    ----------
    kind : str
        The kind, such as ``"jump"``.
    frame : str or None
        The child frame; None for the whole tree.
    count : int
        How often it happens.
    first : int or None
        The stamp of the first time, in ns.
    worst : float or None
        The worst case, in `unit`.
    unit : str
        ``"m"``, ``"s"``, ``"m/s"``, ``"rad/s"``, ``"Hz"``, or empty.
    detail : str
        What happens, in words.
    at : int or None
        The stamp of the worst case, in ns.
    """

    kind: str
    frame: str | None
    count: int
    first: int | None
    worst: float | None
    unit: str
    detail: str
    at: int | None = None

    @property
    def is_hint(self) -> bool:
        """Whether it may be as it is meant, rather than wrong."""
        return self.kind in HINTS

    @property
    def advice(self) -> str:
        """The advice for this kind of finding."""
        return ADVICE[self.kind]

    def __str__(self) -> str:
        name = "" if self.frame is None else f"{self.frame!r}: "
        worst = "" if self.worst is None else f", worst {self.worst:.4g} {self.unit}".rstrip()
        at = "" if self.at is None or self.worst is None else f" at {format_stamp(self.at)}"
        first = "" if self.first is None else f", first at {format_stamp(self.first)}"
        return printable(f"{name}{self.detail}, {self.count:,} x{worst}{at}{first}")
