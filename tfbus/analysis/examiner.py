"""`Examiner`, which notes samples as they arrive, and tells what is wrong with them."""

from array import array
from collections import Counter
from collections.abc import Iterable, Iterator

import numpy as np

from tfbus.analysis._motion import MovingSamples
from tfbus.analysis.finding import Finding
from tfbus.analysis.limits import Limits
from tfbus.geometry.stamped import TransformStamped
from tfbus.rows import Row
from tfbus.stamps import SECOND

_SHOWN = 5
_MANY = 10
"""Fewer samples in one place do not tell that a frame never moves."""


class Examiner:
    """Collects samples: ``examiner.add(batch, received)``; then ``examiner.findings()``. Keeps about 90 bytes of each.

    Parameters
    ----------
    limits : Limits, optional
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
            When they arrived, in ns. Without it, they count as being in the order of their stamps.
        """
        for sample in batch:
            frame = self._frames.get(sample.child)
            if frame is None:
                frame = self._frames[sample.child] = _Frame(sample.child)
            frame.add(sample, received)

    def add_refused(self, reasons: Iterable[str]) -> None:
        """Note samples or messages that were refused, by reason."""
        self._refused.update(reasons)

    def add_norm(self, frame: str, stamp: int, norm: float) -> None:
        """Note the norm of a quaternion as it was sent, before it was normalised."""
        off = abs(norm - 1.0)
        if off > self._limits.norm:
            count, first, worst = self._uneven.get(frame, (0, stamp, 0.0))
            self._uneven[frame] = count + 1, first, max(worst, off)

    def findings(self) -> list[Finding]:
        """All that is wrong: first that of the whole tree, then by frame."""
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
        for reason, count in sorted(self._refused.items()):
            yield Finding("refused", None, count, None, None, "", f"not accepted: {reason}")


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

    def findings(self, limits: Limits) -> Iterator[Finding]:
        """All that is wrong with this frame."""
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
