"""Asks the real tf2 the questions of the recordings again.

It needs Debian's python3-tf2, python3-rospy and python3-geometry-msgs (python3-tf2-ros brings them), and for the bags
python3-rosbag, but no ROS master::

    /usr/bin/python3 tests/golden/generate.py           # write the recordings
    /usr/bin/python3 tests/golden/generate.py --check   # say whether they are still what tf2 answers

To add a scenario or a step, write its line into a recording, without an answer.
"""

import sys

import bags
from real_tf2 import record
from steps import FOLDER, as_text, scenarios_in


def main() -> int:
    """Write the recordings, or compare them; one of a bag that is not there is left as it is."""
    differing = 0
    for path in sorted(FOLDER.glob("*.json")):
        scenarios = scenarios_in(path)
        needed = {step["bag"][0] for scenario in scenarios for step in scenario.steps if "bag" in step}
        if not all(map(bags.is_there, needed)):
            print(f"{path.name}: left as it is, for want of {', '.join(needed)} in {bags.FOLDER}", file=sys.stderr)
            continue
        text = as_text(list(map(record, scenarios)))
        same = path.read_text(encoding="utf-8") == text
        differing += not same
        print(f"{path.name}: {len(scenarios)} scenarios, {'as recorded' if same else 'NOT AS RECORDED'}")
        if "--check" not in sys.argv[1:]:
            path.write_text(text, encoding="utf-8")
    return 1 if differing and "--check" in sys.argv[1:] else 0


if __name__ == "__main__":
    sys.exit(main())
