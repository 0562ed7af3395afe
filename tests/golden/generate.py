"""Records what the real tf2 answers, or compares tfbus with it directly.

It needs Debian's python3-tf2, python3-rospy and python3-geometry-msgs (python3-tf2-ros brings them), and for the bags
python3-rosbag, but no ROS master::

    /usr/bin/python3 tests/golden/generate.py           # write the recordings
    /usr/bin/python3 tests/golden/generate.py --check   # say whether they are still what tf2 answers

Where the same interpreter has tfbus too, both are asked side by side, and nothing is written::

    /usr/bin/python3 tests/golden/generate.py --live --seed 1000 --rounds 500
"""

import argparse
import sys
from collections import Counter
from collections.abc import Iterator

import bags
import scenarios_random
from design_rules import annotated
from real_tf2 import record
from steps import FOLDER, TRANSLATION, Step, as_text, scenarios_in

BY_HAND = ("shapes", "windows", "latest", "changes", "names", "values")
"""The recordings whose steps were written by hand; to add one, write its line into the file, without an answer."""
SEED, ROUNDS = 0, 110


def themes(seed: int, rounds: int) -> Iterator[tuple[str, list[Step]]]:
    """The name of each recording and what tf2 answers now; a bag that is not there is left out."""
    for name in BY_HAND:
        yield name, [record(scenario) for scenario in scenarios_in(FOLDER / f"{name}.json")]
    trees = scenarios_random.random_trees(seed, rounds)
    yield "random", [annotated(record(scenario), TRANSLATION) for scenario in trees]
    for name in scenarios_random.BAGS:
        if bags.is_there(name):
            asked = scenarios_random.bag_scenarios(name)
            yield name.removesuffix(".bag"), [annotated(record(scenario), TRANSLATION) for scenario in asked]
        else:
            print(f"no {bags.FOLDER / name}: left as it is", file=sys.stderr)


def write() -> int:
    """Write the recordings."""
    for name, scenarios in themes(SEED, ROUNDS):
        path = FOLDER / f"{name}.json"
        path.write_text(as_text(scenarios), encoding="utf-8")
        print(f"{path.name}: {_summary(scenarios)}")
    return 0


def check() -> int:
    """Say which recordings are not what tf2 answers now."""
    differing = 0
    for name, scenarios in themes(SEED, ROUNDS):
        path = FOLDER / f"{name}.json"
        same = path.is_file() and path.read_text(encoding="utf-8") == as_text(scenarios)
        differing += not same
        print(f"{path.name}: {'as recorded' if same else 'NOT AS RECORDED'}, {_summary(scenarios)}")
    return 1 if differing else 0


def live(seed: int, rounds: int) -> int:
    """Ask tf2 and tfbus side by side."""
    try:
        from tfbus_replay import disagreements
    except ImportError as error:
        print(f"{sys.executable} has no tfbus to compare with: {error}", file=sys.stderr)
        return 2
    found = 0
    for name, scenarios in themes(seed, rounds):
        lines = [line for scenario in scenarios for line in disagreements(scenario)]
        found += len(lines)
        print(f"{name}: {_summary(scenarios)}: {len(lines)} disagreements")
        print("".join(f"    {line}\n" for line in lines), end="")
    return 1 if found else 0


def _summary(scenarios: list[Step]) -> str:
    steps = [step for scenario in scenarios for step in scenario["steps"]]
    inserted = sum(next(iter(step)).startswith("insert") for step in steps)
    deviations = Counter(step["deviation"] for step in steps if "deviation" in step)
    return (
        f"{len(scenarios)} scenarios, {inserted} samples, {len(steps) - inserted} questions, "
        f"{deviations.total()} answers where tfbus deviates as stated"
    )


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    mode = parser.add_mutually_exclusive_group()
    mode.add_argument("--check", action="store_true", help="compare the recordings with tf2; write nothing")
    mode.add_argument("--live", action="store_true", help="compare tfbus with tf2; write nothing")
    parser.add_argument("--seed", type=int, default=SEED, help="of the first random tree, with --live")
    parser.add_argument("--rounds", type=int, default=ROUNDS, help="how many random trees, with --live")
    options = parser.parse_args()
    if options.live:
        return live(options.seed, options.rounds)
    return check() if options.check else write()


if __name__ == "__main__":
    sys.exit(main())
