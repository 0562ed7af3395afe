"""`Examiner`, which notes samples as they arrive, and lists their faults."""

from array import array
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields
from itertools import repeat
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tfbus.analysis.arrivals import ANOTHER_CLOCK
from tfbus.geometry.stamped import TransformStamped
from tfbus.plain import printable
from tfbus.rows import Row
from tfbus.stamps import SECOND, STAMP_MAX, STAMP_MIN, format_stamp, is_real, time_between, to_seconds
from tfbus.tree.history import Edge, FrameHistory, Samples
from tfbus.tree.tree import TransformTree, forest_of

ADVICE = {
    "translation": "no robot is there: look for an uninitialised or diverged estimate at its sender",
    "jump": "the sender has reset, or mixes two estimates: look at it, or leave these out with max_speed=",
    "turn": "the sender has reset, or two estimates disagree: look at its state then",
    "stamps go back": "messages overtake each other, or a clock was set back: use one sender, and one clock",
    "clock": "synchronise the two clocks, by chrony or NTP, or move the stamps by an offset",
    "ahead": "the clock of the sender is ahead of the recorder's clock: synchronise them",
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
    "unfinished": "copy the file again; if its writer was killed, no more can be read",
}
"""The advice for each kind of finding."""
HINTS = frozenset(("never moves",))
"""The kinds of findings that may be intended."""


@dataclass(frozen=True, slots=True)
class Finding:
    """A fault that was found.

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
        The fault in words.
    at : int or None
        The stamp of the worst case, in ns.

    Examples
    --------
    >>> tree = TransformTree()
    >>> _ = tree.insert(TransformStamped("map", "cart", 0, Transform((2e8, 0.0, 0.0))))
    >>> print(diagnose(tree)[0].detail)
    farther than 1e+08 m
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
        """Whether it may be intended, rather than a fault."""
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


@dataclass(frozen=True, slots=True)
class Limits:
    """The bounds of an examination.

    Parameters
    ----------
    translation : float
        The longest translation, in m. The default is larger than the Earth, for frames at its centre.
    speed : float
        The highest speed of a frame in its parent, in m/s.
    turn_rate : float
        The highest angular speed of a frame in its parent, in rad/s.
    ahead : float
        How far a stamp may lie ahead of the time at which it arrives, in s.
    gap : float
        The shortest time between two stamps that counts as a gap, in s; a gap must also be ten times the usual period.
    norm : float
        How far the norm of a quaternion may be from one.

    Raises
    ------
    TypeError, ValueError
        If one of them is not a number greater than zero.

    Examples
    --------
    >>> from tfbus.analysis import Limits
    >>> tree = TransformTree()
    >>> _ = tree.insert(TransformStamped("map", "cart", 0, Transform((20.0, 0.0, 0.0))))
    >>> diagnose(tree, Limits(translation=10.0))[0].kind
    'translation'
    """

    translation: float = 1e8
    speed: float = 100.0
    turn_rate: float = 100.0
    ahead: float = 0.05
    gap: float = 0.5
    norm: float = 1e-4

    def __post_init__(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)
            if not is_real(value):
                raise TypeError(f"{each.name} must be a number, not {value!r}")
            if not value > 0:
                raise ValueError(f"{each.name} must be greater than zero, got {value!r}")


_OUTLIER = 20.0
"""The least speed of a jump, as a multiple of the median speed of its frame."""
_MIN_MOVES = 20
"""The least number of moves whose median counts as usual."""
_MIN_STEP = 0.1
_MIN_TURN = 0.5
"""In m and rad: a smaller move is no jump, unless its speed is beyond the bound."""
_WINDOWS = 10
_MIN_IN_WINDOW = 5
_GAP = 10.0


@dataclass(frozen=True, slots=True)
class MovingSamples:
    """The moving samples of a frame in the order of their arrival, or of their stamps.

    Parameters
    ----------
    frame : str
    stamps : int64 array of shape (n,)
        ns.
    rows : float64 array of shape (n, 7)
    parents : int array of shape (n,)
        The number of the parent of each.
    authorities : int array of shape (n,)
    received : int64 array of shape (n,), optional
        The arrival of each, in ns; None if they are in the order of their stamps.
    """

    frame: str
    stamps: npt.NDArray[np.int64]
    rows: npt.NDArray[np.float64]
    parents: npt.NDArray[np.int64]
    authorities: npt.NDArray[np.int64]
    received: npt.NDArray[np.int64] | None

    def findings(self, limits: Limits) -> Iterator[Finding]:
        """All faults."""
        yield from self._arrivals(limits)
        order = np.argsort(self.stamps, kind="stable")
        stamps, rows, parents = self.stamps[order], self.rows[order], self.parents[order]
        with np.errstate(over="ignore", invalid="ignore"):
            lengths = np.sqrt((rows[:, :3] ** 2).sum(axis=1))
        far = ~(lengths <= limits.translation)
        yield from self._at("translation", far, stamps, lengths, "m", f"farther than {limits.translation:g} m")
        last = np.append(stamps[1:] != stamps[:-1], True)
        yield from self._at("duplicate stamps", ~last, stamps, None, "", "stamps that came before")
        # If samples share a stamp, the last one holds. A sample that is too far away does not count as a jump as well.
        good = last & ~far
        stamps, rows, parents = stamps[good], rows[good], parents[good]
        # The difference of stamps that are centuries apart does not fit 64 bits.
        if len(stamps) < 2 or int(stamps[-1]) - int(stamps[0]) > STAMP_MAX:
            return
        yield from self._jumps(limits, stamps, rows, parents)
        yield from self._rates(limits, stamps)

    def _arrivals(self, limits: Limits) -> Iterator[Finding]:
        if self.received is None:
            return
        newest = np.maximum.accumulate(self.stamps)
        back = time_between(self.stamps, newest)
        yield from self._at("stamps go back", back > 0, self.stamps, back / SECOND, "s", "older than one before")
        ahead = time_between(self.received, self.stamps) / SECOND
        yield from self._at("ahead", ahead > limits.ahead, self.stamps, ahead, "s", "stamped ahead of its arrival")

    def _jumps(
        self,
        limits: Limits,
        stamps: npt.NDArray[np.int64],
        rows: npt.NDArray[np.float64],
        parents: npt.NDArray[np.int64],
    ) -> Iterator[Finding]:
        # Another parent means other coordinates.
        same = parents[1:] == parents[:-1]
        times = (np.diff(stamps) / SECOND)[same]
        after = stamps[1:][same]
        steps = np.sqrt((np.diff(rows[:, :3], axis=0) ** 2).sum(axis=1))[same]
        cosine = np.abs((rows[1:, 3:] * rows[:-1, 3:]).sum(axis=1))[same]
        # The distance of the quaternions is exact for small angles, where the cosine is not.
        difference = np.minimum(
            ((rows[1:, 3:] - rows[:-1, 3:]) ** 2).sum(axis=1), ((rows[1:, 3:] + rows[:-1, 3:]) ** 2).sum(axis=1)
        )[same]
        angles = np.where(cosine < 0.9, 2 * np.arccos(np.minimum(cosine, 1.0)), 4 * np.arcsin(np.sqrt(difference) / 2))
        for kind, moves, least, bound, unit, what in (
            ("jump", steps, _MIN_STEP, limits.speed, "m/s", "moves faster than it can"),
            ("turn", angles, _MIN_TURN, limits.turn_rate, "rad/s", "turns faster than it can"),
        ):
            speeds = moves / times
            usual = speeds[speeds > 0]
            outlying = np.zeros(len(speeds), bool)
            if len(usual) >= _MIN_MOVES:
                outlying = (speeds > _OUTLIER * np.median(usual)) & (moves > least)
            yield from self._at(kind, (speeds > bound) | outlying, after, speeds, unit, what)

    def _rates(self, limits: Limits, stamps: npt.NDArray[np.int64]) -> Iterator[Finding]:
        times = np.diff(stamps) / SECOND
        usual = float(np.median(times))
        pauses = times > _GAP * usual
        yield from self._at(
            "gap",
            pauses & (times > limits.gap),
            stamps[:-1],
            times,
            "s",
            f"no sample for long, usually every {usual:.4g} s",
        )
        counts, edges = np.histogram(stamps - stamps[0], _WINDOWS)
        width = to_seconds(int(stamps[-1] - stamps[0])) / _WINDOWS
        expected = float(np.median(counts))
        # A window that a pause explains is not reported twice.
        lost = np.zeros(_WINDOWS)
        for start, length in zip(stamps[:-1][pauses], times[pauses], strict=True):
            first = to_seconds(int(start - stamps[0])) / width
            for window in range(int(first), min(_WINDOWS, int(first + length / width) + 1)):
                lost[window] += max(0.0, min(window + 1, first + length / width) - max(window, first))
        low = (counts < expected / 2 * (1 - lost)) & (expected >= _MIN_IN_WINDOW) & (lost < 0.9)
        if low.any():
            worst = int(np.argmin(np.where(low, counts, expected)))
            first = int(stamps[0] + edges[int(np.argmax(low))])
            detail = f"its rate breaks down from {expected / width:.4g} Hz for a tenth of the time"
            at = int(stamps[0] + edges[worst])
            yield Finding("rate", self.frame, int(low.sum()), first, float(counts[worst]) / width, "Hz", detail, at)

    def _at(
        self,
        kind: str,
        wrong: npt.NDArray[np.bool_],
        stamps: npt.NDArray[np.int64],
        values: npt.NDArray[np.float64] | None,
        unit: str,
        detail: str,
    ) -> Iterator[Finding]:
        """The finding for the faulty samples, if there are any."""
        places = np.flatnonzero(wrong)
        if not len(places):
            return
        first = int(stamps[places[0]])
        if values is None:
            yield Finding(kind, self.frame, len(places), first, None, unit, detail)
            return
        worst = int(places[np.argmax(values[places])])
        yield Finding(kind, self.frame, len(places), first, float(values[worst]), unit, detail, int(stamps[worst]))


_FIT = 20
"""The windows of a fit; the smallest delay in each is least disturbed by the network."""
_SHORTEST_FIT = 60.0
_LEAST_DRIFT = 20e-6


@dataclass(frozen=True, slots=True)
class ClockFit:
    """The clock of a sender beside the clock that the arrivals were noted by, as far as one-way delays tell.

    Attributes
    ----------
    authority : str
    ahead : float
        How far it is ahead, in s, at least: the smallest time from an arrival to its stamp, with the sign changed.
    drift : float or None
        How fast it gains, in s per s; None for less than a minute, or where the delays leave it open.
    """

    authority: str
    ahead: float
    drift: float | None

    @classmethod
    def of(cls, authority: str, stamps: npt.NDArray[np.int64], received: npt.NDArray[np.int64]) -> "ClockFit":
        """The line through the greatest leads of some windows of the arrivals, least squares."""
        order = np.argsort(received, kind="stable")
        times, leads = received[order], time_between(received, stamps)[order] / SECOND
        at = time_between(np.broadcast_to(times[0], times.shape), times) / SECOND
        span, drift = float(at[-1]), None
        if span >= _SHORTEST_FIT:
            window = np.minimum((at / span * _FIT).astype(np.int64), _FIT - 1)
            windows = (np.flatnonzero(window == number) for number in range(_FIT))
            best = [part[np.argmax(leads[part])] for part in windows if len(part)]
            if len(best) > _FIT // 2:
                x, y = at[best] - at[best].mean(), leads[best] - leads[best].mean()
                slope = float((x * y).sum() / (x * x).sum())
                noise = float(np.sqrt(((y - slope * x) ** 2).mean() / (x * x).sum()))
                if abs(slope) > max(_LEAST_DRIFT, 6 * noise):
                    drift = slope
        return cls(authority, float(leads.max()), drift)

    def __str__(self) -> str:
        if abs(self.ahead) > ANOTHER_CLOCK:
            return f"{self.authority!r} stamps by another clock (simulated?)"
        side = "ahead, or more" if self.ahead >= 0 else "behind, or less"
        text = f"the clock of {self.authority!r} is {abs(self.ahead):.3g} s {side}"
        if self.drift is None:
            return text
        return f"{text}, and {'gains' if self.drift > 0 else 'loses'} {abs(self.drift) * 1e6:.0f} us a second"


_SHOWN = 5
_MANY = 10
"""The least number of samples in one place that prove that a frame never moves."""


class Examiner:
    """Collects samples: ``examiner.add(batch, received)``; then ``examiner.findings()``. Keeps about 90 bytes of each.

    Parameters
    ----------
    limits : Limits, optional

    Examples
    --------
    >>> from tfbus.analysis import Examiner
    >>> examiner = Examiner()
    >>> examiner.add([TransformStamped("map", "cart", 0, Transform((2e8, 0.0, 0.0)))])
    >>> [finding.kind for finding in examiner.findings()]
    ['translation']
    """

    def __init__(self, limits: Limits | None = None) -> None:
        self._limits = Limits() if limits is None else limits
        self._frames: dict[str, _Frame] = {}
        self._refused: Counter[str] = Counter()
        self._uneven: dict[str, tuple[int, int, float]] = {}

    def add(self, batch: Iterable[TransformStamped], received: int | None = None) -> None:
        """Note samples.

        Parameters
        ----------
        batch : iterable of TransformStamped
        received : int, optional
            The time of their arrival, in ns. Without it, they are taken to arrive in the order of their stamps.

        Examples
        --------
        >>> from tfbus.analysis import Examiner
        >>> examiner = Examiner()
        >>> examiner.add([TransformStamped("map", "cart", 0, Transform())], received=10)
        >>> examiner.findings()
        []
        """
        for sample in batch:
            frame = self._frames.get(sample.child)
            if frame is None:
                frame = self._frames[sample.child] = _Frame(sample.child)
            frame.add(sample, received)

    def add_refused(self, reasons: Iterable[str]) -> None:
        """Note samples or messages that were refused, by reason.

        Examples
        --------
        >>> from tfbus.analysis import Examiner
        >>> examiner = Examiner()
        >>> examiner.add_refused(["not finite"])
        >>> [finding.detail for finding in examiner.findings()]
        ['not accepted: not finite']
        """
        self._refused.update(reasons)

    def add_norm(self, frame: str, stamp: int, norm: float) -> None:
        """Note the norm that a quaternion had before it was normalised.

        Examples
        --------
        >>> from tfbus.analysis import Examiner
        >>> examiner = Examiner()
        >>> examiner.add([TransformStamped("map", "cart", 0, Transform())])
        >>> examiner.add_norm("cart", 0, 1.005)
        >>> [finding.detail for finding in examiner.findings()]
        ['a quaternion whose norm is not one']
        """
        off = abs(norm - 1.0)
        if off > self._limits.norm:
            count, first, worst = self._uneven.get(frame, (0, stamp, 0.0))
            self._uneven[frame] = count + 1, first, max(worst, off)

    def findings(self) -> list[Finding]:
        """All faults: first the faults of the whole tree, then the faults of each frame.

        Examples
        --------
        >>> from tfbus.analysis import Examiner
        >>> Examiner().findings()
        []
        """
        found = list(self._of_the_tree())
        for name in sorted(self._frames):
            found += self._frames[name].findings(self._limits)
            if name in self._uneven:
                count, first, worst = self._uneven[name]
                found.append(Finding("rotation", name, count, first, worst, "", "a quaternion whose norm is not one"))
        return found

    def _of_the_tree(self) -> Iterator[Finding]:
        parents = {name: frame.parent for name, frame in self._frames.items()}
        roots = sorted({parent for parent in parents.values() if parent not in parents})
        if len(roots) > 1:
            shown = ", ".join(map(repr, roots[:_SHOWN])) + (", ..." if len(roots) > _SHOWN else "")
            yield Finding("disconnected", None, len(roots), None, None, "", f"separate trees, below {shown}")
        yield from self._of_clocks()
        for reason, count in sorted(self._refused.items()):
            yield Finding("refused", None, count, None, None, "", f"not accepted: {reason}")

    def _of_clocks(self) -> Iterator[Finding]:
        arrivals: dict[str, list[npt.NDArray[np.int64]]] = {}
        for frame in self._frames.values():
            for authority, times in frame.arrivals():
                arrivals.setdefault(authority, []).append(times)
        for authority, parts in sorted(arrivals.items()):
            stamps, received = np.concatenate(parts, axis=1)
            fit = ClockFit.of(authority, stamps, received)
            usual = float(np.quantile(time_between(received, stamps), 0.1)) / SECOND
            if usual > self._limits.ahead or fit.drift is not None or fit.ahead < -ANOTHER_CLOCK:
                yield Finding("clock", None, len(stamps), None, fit.ahead, "s", str(fit))


class _Frame:
    """All samples of one child frame."""

    def __init__(self, name: str) -> None:
        self._name = name
        self.parent = ""
        self._newest: int | None = None
        self._parents: dict[str, int] = {}
        self._authorities: dict[str, int] = {}
        self._stamps = array("q")
        self._received = array("q")
        self._rows = array("d")
        self._parent_numbers = array("H")
        self._authority_numbers = array("H")
        self._static: tuple[str, Row] | None = None
        self._statics = 0
        self._static_changes = 0
        self._first_change: int | None = None

    def add(self, sample: TransformStamped, received: int | None) -> None:
        """Note a sample."""
        parent, _, stamp, row, authority, static = sample._fields
        authority_number = _number(self._authorities, authority)
        parent_number = _number(self._parents, parent)
        if static:
            self._statics += 1
            if self._static is not None and self._static != (parent, row):
                self._static_changes += 1
                self._first_change = stamp if self._first_change is None else self._first_change
            self._static = parent, row
            self.parent = parent
            return
        self._stamps.append(stamp)
        if received is not None:
            self._received.append(received)
        self._rows.extend(row)
        self._parent_numbers.append(parent_number)
        self._authority_numbers.append(authority_number)
        if self._newest is None or stamp >= self._newest:
            self._newest, self.parent = stamp, parent

    def arrivals(self) -> Iterator[tuple[str, npt.NDArray[np.int64]]]:
        """The stamps and arrivals of each sender of moving samples, two rows in ns."""
        if not self._stamps or len(self._received) < len(self._stamps):
            return
        times, numbers = np.array([self._stamps, self._received], np.int64), np.array(self._authority_numbers, np.int64)
        for authority, number in self._authorities.items():
            if (chosen := numbers == number).any():
                yield authority, times[:, chosen]

    def findings(self, limits: Limits) -> Iterator[Finding]:
        """All faults of this frame."""
        yield from self._of_senders()
        if self._static is not None:
            x, y, z = self._static[1][:3]
            length = float(np.hypot(np.hypot(x, y), z))
            if length > limits.translation:
                detail = f"farther than {limits.translation:g} m"
                yield Finding("translation", self._name, self._statics, None, length, "m", detail)
        if self._static_changes:
            detail = "static, and sent with another value"
            yield Finding("static changes", self._name, self._static_changes, self._first_change, None, "", detail)
        if self._statics and self._stamps:
            detail = f"static, {self._statics:,} x, and moving"
            yield Finding("two kinds", self._name, len(self._stamps), self._stamps[0], None, "", detail)
        if self._stamps:
            yield from self._moving().findings(limits)
        if not self._statics:
            yield from self._at_rest()

    def _at_rest(self) -> Iterator[Finding]:
        """A hint, if a frame is sent as moving and has the same place in the same parent all the time."""
        rows = np.array(self._rows, np.float64).reshape(-1, 7)
        if len(rows) >= _MANY and len(self._parents) == 1 and (rows == rows[0]).all():
            span = (max(self._stamps) - min(self._stamps)) / SECOND
            detail = f"sent as moving for {span:.4g} s, and never moves"
            yield Finding("never moves", self._name, len(rows), min(self._stamps), None, "", detail)

    def _of_senders(self) -> Iterator[Finding]:
        for kind, names, numbers in (
            ("two parents", self._parents, self._parent_numbers),
            ("two authorities", self._authorities, self._authority_numbers),
        ):
            if len(names) > 1:
                changes = np.flatnonzero(np.diff(np.array(numbers, np.int64))) + 1
                shown = ", ".join(map(repr, list(names)[:_SHOWN])) + (", ..." if len(names) > _SHOWN else "")
                first = self._stamps[changes[0]] if len(changes) else None
                word = "parents" if kind == "two parents" else "senders"
                yield Finding(kind, self._name, max(1, len(changes)), first, None, "", f"{len(names)} {word}: {shown}")

    def _moving(self) -> MovingSamples:
        received = None if len(self._received) < len(self._stamps) else np.array(self._received, np.int64)
        return MovingSamples(
            self._name,
            np.array(self._stamps, np.int64),
            np.array(self._rows, np.float64).reshape(-1, 7),
            np.array(self._parent_numbers, np.int64),
            np.array(self._authority_numbers, np.int64),
            received,
        )


def _number(numbers: dict[str, int], name: str) -> int:
    """The number of a name; the 65,536th and all further names share one."""
    return numbers.setdefault(name, min(len(numbers), 65_535))


def diagnose(tree: TransformTree, limits: Limits | None = None) -> list[Finding]:
    """Examine a tree: impossible translations and speeds, gaps, rates that break down, senders that disagree.

    A tree keeps the samples of a frame in the order of their stamps, one for each stamp, and its last static value. So
    duplicates, changes of statics and stamps that go back are found only while samples arrive: see
    `tfbus.analysis.Examiner`, and ``tfbus check``.

    Parameters
    ----------
    tree : TransformTree
    limits : Limits, optional

    Returns
    -------
    list of Finding
        Empty if nothing is wrong.

    Examples
    --------
    >>> tree = TransformTree()
    >>> _ = tree.insert(TransformStamped("map", "cart", 0, Transform((2e8, 0.0, 0.0))))
    >>> [finding.kind for finding in diagnose(tree)]
    ['translation']
    """
    examiner = Examiner(limits)
    forest = forest_of(tree)
    with forest.lock:
        frames = [_Seen.of(history) for history in forest.frames.values()]
    examiner.add([sample for frame in frames for sample in frame.samples()])
    return examiner.findings()


class _Seen(NamedTuple):
    """The samples of one frame as they were at one moment."""

    edge: Edge
    static: TransformStamped | None
    moving: Samples

    @classmethod
    def of(cls, history: FrameHistory) -> "_Seen":
        """The present samples; numpy copies most of them later, without the lock."""
        edge, static = history.edge(), None
        if edge.static and history.static_stamp is not None:
            row = history.static_row
            static = _sample(edge.parent, edge.child, history.static_stamp, row, edge.authority, static=True)
        return cls(edge, static, history.samples_between(STAMP_MIN, STAMP_MAX))

    def samples(self) -> Iterator[TransformStamped]:
        """The static sample, or the moving ones in the order of their stamps."""
        if self.static is not None:
            yield self.static
        moving = self.moving
        parents = repeat(self.edge.parent) if moving.parents is None else moving.parents
        authorities = repeat(self.edge.authority) if moving.authorities is None else moving.authorities
        columns = zip(moving.stamps.tolist(), moving.rows.tolist(), parents, authorities, strict=False)
        for stamp, (x, y, z, i, j, k, w), parent, authority in columns:
            yield _sample(parent, self.edge.child, stamp, (x, y, z, i, j, k, w), authority, static=False)


def _sample(parent: str, child: str, stamp: int, row: Row, authority: str, static: bool) -> TransformStamped:
    # The samples of a tree are valid.
    sample = TransformStamped.__new__(TransformStamped)
    sample._fields = parent, child, stamp, row, authority, static
    return sample
