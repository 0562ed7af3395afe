"""The half of a driver that is the same in ROS 1 and ROS 2, run by a Python that need not have tfbus.

It sends ``odom:base``, x = t, at 100 Hz; it asks for ``odom:tool`` 100 times a second, which needs the frames of the
other side. So many seconds after the first answer, when the two have met, it ends with one line of JSON.
"""

import argparse
import json
import time
from collections import Counter
from collections.abc import Callable

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
