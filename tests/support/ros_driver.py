"""The half of a driver that is the same in ROS 1 and ROS 2, run by a Python that need not have tfbus.

It sends ``odom:base``, x = sin(t), at 100 Hz; it asks for ``odom:tool`` 100 times a second, which needs the frames of
the other side; and it ends after so many seconds, with one line of JSON.
"""

import argparse
import json
import math
import time
from collections import Counter
from collections.abc import Callable

RATE = 100

Answer = tuple[float, float]
"""The stamp of a transform in s, and its x in m."""


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
        start = due = time.monotonic()
        while (now := time.monotonic()) - start < self._seconds:
            time.sleep(max(0.0, due - now))
            due = max(due + 1 / RATE, now - 1 / RATE)
            stamp = time.time_ns()
            send(stamp, math.sin(stamp / 1e9))
            sent += 1
            answer = ask()
            if answer is None:
                # Before the two have met, nothing can be answered.
                failed += answered > 0
                continue
            answered += 1
            t, x = answer
            wrong += abs(x - (math.sin(t) + math.cos(t) + 0.1)) > 1e-3
        facts = {"sent": sent, "answered": answered, "failed": failed, "wrong": wrong, "received": self._received}
        median = sorted(self._latencies)[len(self._latencies) // 2] / 1e6 if self._latencies else None
        print(json.dumps({"event": "end", **facts, "latency_ms": median}), flush=True)
