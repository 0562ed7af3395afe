"""Records a small bag as ROS 1 does, and what the real tf2 answers when it is fed the same messages.

It needs Debian's python3-tf2-ros and python3-rosbag, but no ROS master::

    /usr/bin/python3 tests/recordings/record.py           # write both files
    /usr/bin/python3 tests/recordings/record.py --check   # say whether they are still what would be written

Ten seconds of a robot, with what goes wrong on robots: names with leading slashes, several senders, a frame that is
handed from one parent to another and back, a gap, a sample that comes late, and transforms that nobody should
believe.
"""

import json
import math
import random
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import rosbag  # type: ignore[import-not-found]
import rospy  # type: ignore[import-not-found]
import tf2_py  # type: ignore[import-not-found]
from geometry_msgs.msg import TransformStamped  # type: ignore[import-not-found]
from tf2_msgs.msg import TFMessage  # type: ignore[import-not-found]

FOLDER = Path(__file__).resolve().parent
BAG = "small.bag"
ANSWERS = "small.json"

SECOND = 1_000_000_000
START = 100 * SECOND
LENGTH = 10
DELAY = 2_000_000
"""From a stamp to the log time of its message, in ns."""

FRAMES = ("map", "odom", "base_link", "laser", "camera", "arm", "gripper", "table", "box", "dock")
NOBODY = "nobody"
QUESTIONS = 400
SEED = 6
DIGITS = 11

Numbers = tuple[float, ...]


@dataclass(frozen=True)
class Sample:
    """One transform; its stamp in ns."""

    parent: str
    child: str
    stamp: int
    translation: Numbers
    rotation: Numbers


@dataclass(frozen=True)
class Sent:
    """One message; its log time in ns."""

    sender: str
    received: int
    samples: tuple[Sample, ...]
    static: bool = False


def turned(angle: float, axis: Numbers = (0.0, 0.0, 1.0)) -> Numbers:
    """A quaternion x y z w."""
    size = math.hypot(*axis)
    return (*(math.sin(angle / 2) * part / size for part in axis), math.cos(angle / 2))


def ticks(rate: int, first: float = 0.0, last: float = LENGTH) -> Iterator[tuple[int, float]]:
    """Stamps in ns, and s since the start."""
    for k in range(round(first * rate), round(last * rate)):
        stamp = START + k * SECOND // rate
        yield stamp, (stamp - START) / SECOND


def moving() -> Iterator[Sent]:
    """The transforms that a robot sends."""

    def now(sender: str, stamp: int, *samples: Sample) -> Sent:
        return Sent(sender, stamp + DELAY, samples)

    for stamp, t in ticks(10):
        place = (0.3 * math.sin(t), 0.2 * math.cos(t), 0.0)
        yield now("/slam", stamp, Sample("/map", "/odom", stamp, place, turned(0.5 * math.sin(t) + 0.05 * t)))
    for stamp, t in (*ticks(50, 0, 4), *ticks(50, 5.5, LENGTH)):
        base = Sample("odom", "base_link", stamp, (t, 0.1 * t * t, 0.0), turned(0.9 * t))
        yield now("/odometry", stamp, base)
    for stamp, t in ticks(20):
        tilt = Sample("arm", "gripper", stamp, (0.4, 0.0, 0.1 * t), turned(-1.7 * t, (1.0, 2.0, -0.5)))
        # Two in one message, of which one belongs to a tree of its own.
        alone = Sample("island", "palm", stamp, (0.0, t, 0.0), turned(t))
        yield now("/arm", stamp, tilt, alone)
    for stamp, t in ticks(5):
        holder = "gripper" if 3.0 <= t < 7.0 else "table"
        yield now("/perception", stamp, Sample(holder, "box", stamp, (0.1, t, 0.0), turned(2.0 + t, (0.0, 1.0, 1.0))))


def out_of_order() -> Iterator[Sent]:
    """A sample between two that are there already, half a second late."""
    stamp = START + 2_370_000_000
    late = Sample("odom", "base_link", stamp, (2.4, 0.6, 0.1), turned(2.2))
    yield Sent("/odometry", stamp + SECOND // 2, (late,))


def statics() -> Iterator[Sent]:
    """The static transforms; the first ones are from before everything else, one comes late."""
    mounted = (
        Sample("/base_link", "/laser", START, (0.1, 0.0, 0.2), turned(0.0)),
        Sample("base_link", "camera", START, (0.3, 0.0, 0.5), turned(math.pi / 2, (1.0, -1.0, 1.0))),
    )
    yield Sent("/calibration", START - SECOND, mounted, static=True)
    described = (
        Sample("base_link", "arm", START, (0.2, 0.0, 0.4), turned(0.3, (0.0, 1.0, 0.0))),
        Sample("map", "table", START, (2.0, 1.0, 0.7), turned(-1.0)),
    )
    yield Sent("/description", START - SECOND // 2, described, static=True)
    late = Sample("map", "dock", START, (-1.0, -1.0, 0.0), turned(3.0))
    yield Sent("/calibration", START + 6 * SECOND, (late,), static=True)


def wrong() -> Iterator[Sent]:
    """Invalid transforms, each beside a good one; tf2 refuses all but the last three kinds."""
    upright = turned(0.0)
    nan, infinite = math.nan, math.inf
    kinds = [
        ("odom", "base_link", (nan, 0.0, 0.0), upright),
        ("odom", "base_link", (0.0, 0.0, 0.0), (0.0, nan, 0.0, 1.0)),
        ("arm", "gripper", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)),
        ("arm", "gripper", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 2.0)),
        ("base_link", "/base_link", (0.0, 0.0, 0.0), upright),
        ("map", "", (0.0, 0.0, 0.0), upright),
        ("", "odom", (0.0, 0.0, 0.0), upright),
        ("map", "endless", (infinite, 0.0, 0.0), upright),
        ("hen", "egg", (0.0, 0.0, 0.0), upright),
        ("egg", "hen", (0.0, 0.0, 0.0), upright),
    ]
    for place, (parent, child, translation, rotation) in enumerate(kinds):
        stamp = START + SECOND + place * 500_000_000 + 7_000_000
        good = Sample("map", "beacon", stamp, (float(place), 0.0, 0.0), upright)
        bad = Sample(parent, child, stamp, translation, rotation)
        yield Sent("/confused", stamp + DELAY, (bad, good))


def everything() -> list[Sent]:
    """All messages, in the order of their log times."""
    return sorted((*statics(), *moving(), *out_of_order(), *wrong()), key=lambda sent: sent.received)


def time_of(stamp: int) -> Any:
    return rospy.Time(*divmod(stamp, SECOND))


def message_of(sent: Sent) -> Any:
    message = TFMessage()
    for sample in sent.samples:
        one = TransformStamped()
        one.header.frame_id, one.child_frame_id = sample.parent, sample.child
        one.header.stamp = time_of(sample.stamp)
        place, turn = one.transform.translation, one.transform.rotation
        place.x, place.y, place.z = sample.translation
        turn.x, turn.y, turn.z, turn.w = sample.rotation
        message.transforms.append(one)
    return message


def write_bag(path: Path) -> None:
    """The messages as `rosbag record` writes them."""
    connections: dict[tuple[str, str], Any] = {}
    with rosbag.Bag(str(path), "w", compression=rosbag.Compression.BZ2, chunk_threshold=16_384) as bag:
        for sent in everything():
            topic = "/tf_static" if sent.static else "/tf"
            header = {
                "topic": topic,
                "type": TFMessage._type,
                "md5sum": TFMessage._md5sum,
                "message_definition": TFMessage._full_text,
                "callerid": sent.sender,
                "latching": "1" if sent.static else "0",
            }
            # This writer has one connection for a topic, where `rosbag record` has one for each sender.
            bag._topic_connections.pop(topic, None)
            if (topic, sent.sender) in connections:
                bag._topic_connections[topic] = connections[topic, sent.sender]
            bag.write(topic, message_of(sent), time_of(sent.received), connection_header=header)
            connections[topic, sent.sender] = bag._topic_connections[topic]


def answers() -> list[dict[str, Any]]:
    """The answers of tf2 once it has heard all of it, as a listener does."""
    core = tf2_py.BufferCore(rospy.Duration(1_000))
    for sent in everything():
        insert = core.set_transform_static if sent.static else core.set_transform
        for one in message_of(sent).transforms:
            insert(one, sent.sender)
    return [ask(core, *question) for question in questions()]


def questions() -> Iterator[tuple[str, str, int | None]]:
    """Two frames and a stamp in ns, or None for the latest."""
    rng = random.Random(SEED)
    for target, source in product(FRAMES, FRAMES):
        if target != source:
            yield target, source, None
    for _ in range(QUESTIONS):
        target, source = rng.sample(FRAMES, 2)
        yield target, source, START + rng.randrange(-SECOND // 2, (LENGTH + 1) * SECOND)
    # Beside the late sample, in the gap, and while the box is handed over.
    for t in (2_365_000_000, 2_372_000_000, 4_700_000_000):
        yield "odom", "base_link", START + t
    for t in (2_900_000_000, 3_000_000_000, 6_900_000_000, 7_100_000_000):
        yield "map", "box", START + t
    yield "map", "palm", START + 5 * SECOND
    yield "map", NOBODY, None
    yield "laser", "beacon", START + 3 * SECOND


def ask(core: Any, target: str, source: str, at: int | None) -> dict[str, Any]:
    question = {"target": target, "source": source, "at": at}
    try:
        found = core.lookup_transform_core(target, source, rospy.Time() if at is None else time_of(at))
    except tf2_py.TransformException as error:
        return {**question, "error": type(error).__name__}
    place, turn = found.transform.translation, found.transform.rotation
    return {
        **question,
        "stamp": found.header.stamp.to_nsec(),
        "translation": [round(part, DIGITS) for part in (place.x, place.y, place.z)],
        "rotation": [round(part, DIGITS) for part in (turn.x, turn.y, turn.z, turn.w)],
    }


def main() -> int:
    """The command line."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, BAG)
        write_bag(path)
        lines = ",\n".join(json.dumps(answer, separators=(",", ":")) for answer in answers())
        written = {BAG: path.read_bytes(), ANSWERS: f"[\n{lines}\n]\n".encode()}
    differing = 0
    for name, data in written.items():
        target = FOLDER / name
        same = target.is_file() and target.read_bytes() == data
        differing += not same
        if "--check" not in sys.argv[1:]:
            target.write_bytes(data)
        print(f"{name}: {len(data)} bytes, {'as before' if same else 'NOT AS BEFORE'}")
    return 1 if differing and "--check" in sys.argv[1:] else 0


if __name__ == "__main__":
    sys.exit(main())
