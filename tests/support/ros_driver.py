"""The half of a driver that is the same in ROS 1 and ROS 2, run by a Python that need not have tfbus.

It sends ``odom:base``, x = t, at 100 Hz; it asks for ``odom:tool`` 100 times a second, which needs the frames of the
other side. So many seconds after the first answer, when the two have met, it ends with one line of JSON.
"""

import argparse
import json
import math
import time
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable
from threading import Lock

RATE = 100
MEETING_TIME = 60.0
"""s; whoever has not met by then never will."""

Answer = tuple[int, float]
"""The stamp of a transform in ns, and its x in m."""


def seconds(stamp: int) -> float:
    """Seconds since some day: between two samples tf2 is exact, however late the second one is."""
    return (stamp - 1_750_000_000 * 10**9) / 1e9


class Driver:
    """Counts what it sends, hears and is answered; `x` is that of the static ``base:laser``."""

    def __init__(self) -> None:
        parser = argparse.ArgumentParser()
        parser.add_argument("--seconds", type=float, default=10.0)
        parser.add_argument("--x", type=float, default=0.5, help="of the laser")
        options = parser.parse_args()
        self.x: float = options.x
        self._seconds: float = options.seconds
        self._received: Counter[str] = Counter()
        self._latencies: list[int] = []

    def hear(self, child: str, stamp: int) -> None:
        """Count a transform that was received, with its stamp in ns."""
        self._received[child] += 1
        if child == "arm":
            self._latencies.append(time.time_ns() - stamp)

    def run(self, send: Callable[[int, float], None], ask: Callable[[], Answer | None]) -> None:
        """Send and ask until the time is over; `ask` gives None where there is no answer."""
        print(json.dumps({"event": "up"}), flush=True)
        answered = failed = wrong = sent = 0
        due = time.monotonic()
        end = due + MEETING_TIME
        while (now := time.monotonic()) < end:
            time.sleep(max(0.0, due - now))
            due = max(due + 1 / RATE, now - 1 / RATE)
            stamp = time.time_ns()
            send(stamp, seconds(stamp))
            sent += 1
            answer = ask()
            if answer is None:
                # Before the two have met, nothing can be answered.
                failed += answered > 0
                continue
            if not answered:
                end = time.monotonic() + self._seconds
                self._latencies.clear()
            answered += 1
            at, x = answer
            wrong += abs(x - (3 * seconds(at) + 0.1)) > 1e-6
        facts = {"sent": sent, "answered": answered, "failed": failed, "wrong": wrong, "received": self._received}
        median = sorted(self._latencies)[len(self._latencies) // 2] / 1e6 if self._latencies else None
        print(json.dumps({"event": "end", **facts, "latency_ms": median}), flush=True)


# The transform of ``odom:tool`` for drivers that have no tf2, run by a Python that need not have tfbus

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


# The half of a robot that is the same in ROS 1 and ROS 2, run by a Python that need not have tfbus

JOINTS = ["shoulder", "elbow"]


def play(move: Callable[[int, list[float]], None], tell: Callable[[float], None], is_heard: Callable[[], int]) -> None:
    """Move the joints and tell the time for ever.

    Parameters
    ----------
    move : callable
        Publishes the positions of `JOINTS`, sin(t) and cos(t), with their stamp in ns.
    tell : callable
        Publishes the time in s. It begins at 100, and jumps back to 50 after somebody has listened to it for 1.5 s.
    is_heard : callable
        Whether somebody listens to the time: the number of those.
    """
    print("up", flush=True)
    start, listened = time.monotonic(), 0.0
    while True:
        time.sleep(0.02)
        stamp = time.time_ns()
        move(stamp, [math.sin(stamp / 10**9), math.cos(stamp / 10**9)])
        if is_heard() and not listened:
            listened = time.monotonic()
        ended = listened + 1.5 if listened else math.inf
        now = time.monotonic()
        tell(100 + now - start if now < ended else 50 + now - ended)
