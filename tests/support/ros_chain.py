"""The transform of ``odom:tool`` for drivers that have no tf2, run by a Python that need not have tfbus."""

from bisect import bisect_right
from threading import Lock

from ros_driver import Answer  # type: ignore[import-not-found]

KEPT = 1_000


class Chain:
    """Holds x of ``odom:base``, ``base:arm`` and ``arm:tool`` and adds them, as tf2 does; for any thread."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._moving: dict[str, list[tuple[int, float]]] = {"base": [], "arm": []}
        self._tool: float | None = None

    def take(self, parent: str, child: str, stamp: int, x: float, static: bool) -> None:
        """Take a transform, with its stamp in ns."""
        with self._lock:
            if (parent, child, static) == ("arm", "tool", True):
                self._tool = x
            elif not static and (parent, child) in (("odom", "base"), ("base", "arm")):
                samples = self._moving[child]
                samples.append((stamp, x))
                del samples[:-KEPT]

    def ask(self) -> Answer | None:
        """The newest transform that all three can answer; None if there is none."""
        with self._lock:
            if self._tool is None or not all(self._moving.values()):
                return None
            at = min(samples[-1][0] for samples in self._moving.values())
            parts = [_between(samples, at) for samples in self._moving.values()]
        return None if None in parts else (at, sum(filter(None, parts)) + self._tool)


def _between(samples: list[tuple[int, float]], at: int) -> float | None:
    after = bisect_right(samples, (at, float("inf")))
    if not after:
        return None
    before, x = samples[after - 1]
    if before == at or after == len(samples):
        return x if before == at else None
    stamp, further = samples[after]
    return x + (further - x) * (at - before) / (stamp - before)
