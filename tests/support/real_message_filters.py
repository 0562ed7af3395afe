"""The sets that message_filters of ROS 2 finds; run by a Python that has it.

It reads streams of stamps in ns and the width of a set, which no set reaches, as JSON, and prints the sets.
"""

import json
import sys
from types import SimpleNamespace
from typing import Any

from message_filters import ApproximateTimeSynchronizer, SimpleFilter  # type: ignore[import-not-found]
from rclpy.time import Time

streams, width = json.load(sys.stdin)
filters = [SimpleFilter() for _ in streams]
sets: list[list[int]] = []


def take(*messages: Any) -> None:
    sets.append([message.header.stamp.nanoseconds for message in messages])


synchronizer = ApproximateTimeSynchronizer(filters, 30, width / 1e9)
synchronizer.registerCallback(take)
for stamp, number in sorted((stamp, number) for number, stamps in enumerate(streams) for stamp in stamps):
    filters[number].signalMessage(SimpleNamespace(header=SimpleNamespace(stamp=Time(nanoseconds=stamp))))
print(json.dumps(sets))
