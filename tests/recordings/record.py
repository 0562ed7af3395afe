"""Records what the real tf2 answers when it is fed a small bag, as a listener is.

It needs Debian's python3-tf2-ros and python3-rosbag, but no ROS master::

    /usr/bin/python3 tests/recordings/record.py           # write the answers to the questions of small.json
    /usr/bin/python3 tests/recordings/record.py --check   # say whether they are still what would be written

The bag has ten seconds of a robot, with what goes wrong on robots: names with leading slashes, several senders, a frame
that is handed from one parent to another and back, a gap, a sample that comes late, and transforms that nobody should
believe.
"""

import json
import sys
from pathlib import Path
from typing import Any

import rosbag  # type: ignore[import-not-found]
import rospy  # type: ignore[import-not-found]
import tf2_py  # type: ignore[import-not-found]

ANSWERS = Path(__file__).with_name("small.json")
DIGITS = 11


def fed() -> Any:
    core = tf2_py.BufferCore(rospy.Duration(1_000))
    with rosbag.Bag(str(ANSWERS.with_suffix(".bag"))) as bag:
        for topic, message, _ in bag.read_messages():
            insert = core.set_transform_static if topic == "/tf_static" else core.set_transform
            for one in message.transforms:
                insert(one, "bag")
    return core


def ask(core: Any, target: str, source: str, at: int | None) -> dict[str, Any]:
    """The answer at a stamp in ns, or the latest."""
    question = {"target": target, "source": source, "at": at}
    time = rospy.Time() if at is None else rospy.Time(*divmod(at, 1_000_000_000))
    try:
        found = core.lookup_transform_core(target, source, time)
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
    core, before = fed(), ANSWERS.read_text(encoding="utf-8")
    answers = [ask(core, *(each[key] for key in ("target", "source", "at"))) for each in json.loads(before)]
    text = "[\n" + ",\n".join(json.dumps(answer, separators=(",", ":")) for answer in answers) + "\n]\n"
    print(f"{ANSWERS.name}: {len(answers)} answers, {'as before' if text == before else 'NOT AS BEFORE'}")
    if "--check" in sys.argv[1:]:
        return int(text != before)
    ANSWERS.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
