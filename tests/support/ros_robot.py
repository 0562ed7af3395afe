"""The half of a robot that is the same in ROS 1 and ROS 2, run by a Python that need not have tfbus."""

import math
import time
from collections.abc import Callable

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
