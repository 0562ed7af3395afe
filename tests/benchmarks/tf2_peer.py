"""The real tf2's side of the benchmarks, under the Python that has `tf2_py`, of ROS 1 or of ROS 2.

Says ``ready``, or what is missing; then answers each `Case`, a JSON line, with what one pass gives.
"""

import json
import sys
from time import perf_counter
from typing import Any

from cases import AUTHORITY, BASE, KEEP, Case, Pass, Sample, Vector, history, insertions, questions

try:
    import tf2_py  # type: ignore[import-not-found]
    from geometry_msgs.msg import TransformStamped  # type: ignore[import-not-found]

    if len(sys.argv) > 1:
        from rclpy.duration import Duration
        from rclpy.time import Time
    else:
        from rospy import Duration, Time  # type: ignore[import-not-found]
except ImportError as error:
    print(error)
    sys.exit()


def time_parts(stamp: int) -> tuple[int, int]:
    return divmod(stamp, 1_000_000_000)


def seconds_of(seconds: int) -> Any:
    return Duration(seconds) if len(sys.argv) == 1 else Duration(seconds=seconds)


def time(*parts: int) -> Any:
    """The time of a question; in ROS 1 that of a message, too."""
    return Time(*parts) if len(sys.argv) == 1 else Time(seconds=parts[0], nanoseconds=parts[1]) if parts else Time()


def build(sample: Sample) -> Any:
    message = TransformStamped()
    message.header.frame_id = sample.parent
    stamp = time(*time_parts(sample.stamp))
    message.header.stamp = stamp.to_msg() if hasattr(stamp, "to_msg") else stamp
    message.child_frame_id = sample.child
    translation, rotation = message.transform.translation, message.transform.rotation
    translation.x, translation.y, translation.z = sample.translation
    rotation.x, rotation.y, rotation.z, rotation.w = sample.rotation
    return message


def translation_of(message: Any) -> Vector:
    translation = message.transform.translation
    return translation.x, translation.y, translation.z


def insert(kind: str) -> Pass:
    messages = [build(sample) for sample in insertions(kind)]
    parts = [(message, *time_parts(sample.stamp)) for message, sample in zip(messages, insertions(kind), strict=True)]

    def one_pass() -> tuple[float, Vector]:
        core = tf2_py.BufferCore(seconds_of(KEEP))
        set_transform = core.set_transform
        start = perf_counter()
        if kind == "insert stamped":
            for message, seconds, nanoseconds in parts:
                message.header.stamp = Time(seconds, nanoseconds)
                set_transform(message, AUTHORITY)
        else:
            for message in messages:
                set_transform(message, AUTHORITY)
        seconds_each = (perf_counter() - start) / len(messages)
        return seconds_each, translation_of(core.lookup_transform_core(BASE, "f0", time()))

    return one_pass


def lookup(case: Case) -> Pass:
    core = tf2_py.BufferCore(seconds_of(2 * KEEP))
    for sample in history(case.chain):
        (core.set_transform_static if sample.static else core.set_transform)(build(sample), AUTHORITY)
    stamps = questions(case.kind)
    times = [time() if case.kind == "lookup latest" else time(*time_parts(stamp)) for stamp in stamps]
    source = f"f{len(case.chain) - 1}"

    def one_pass() -> tuple[float, Vector]:
        ask = core.lookup_transform_core
        start = perf_counter()
        for time in times:
            found = ask(BASE, source, time)
        return (perf_counter() - start) / len(times), translation_of(found)

    return one_pass


print("ready", flush=True)
prepared: dict[str, Pass] = {}
for line in sys.stdin:
    if line not in prepared:
        case = Case(*json.loads(line))
        prepared = {line: lookup(case) if case.chain else insert(case.kind)}
    print(json.dumps(prepared[line]()), flush=True)
