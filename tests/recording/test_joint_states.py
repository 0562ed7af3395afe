import math
from collections import Counter
from pathlib import Path

import pytest
from support.joint_messages import KIND, joint_state
from support.processes import is_open
from support.recorded import real, write_mcap

from tfbus import Joint, RecordingError, RobotModel, Transform, TransformStamped
from tfbus.recording import load, load_joint_states

ARM = RobotModel(
    "arm",
    ["base", "upper", "tool"],
    [
        Joint("shoulder", "revolute", "base", "upper", axis=(0, 0, 1)),
        Joint("mount", "fixed", "upper", "tool", Transform((2.0, 0.0, 0.0))),
    ],
)


def write(path: Path, *payloads: bytes, topic: str = "/joint_states", schema: str = KIND) -> Path:
    return write_mcap(path, [(at, topic, payload) for at, payload in enumerate(payloads)], schema=schema)


def test_the_links_are_where_the_positions_put_them(tmp_path: Path) -> None:
    path = write(tmp_path / "run.mcap", *(joint_state(k, {"shoulder": k * math.pi / 4}) for k in range(3)))
    tree = load_joint_states(path, ARM, prefix="r/")
    for k, (x, y) in enumerate([(2.0, 0.0), (math.sqrt(2.0), math.sqrt(2.0)), (0.0, 2.0)]):
        assert tree.lookup("r/base", "r/tool", k).transform.translation == pytest.approx((x, y, 0.0), abs=1e-12)
    assert tree.lookup("r/upper", "r/tool").static
    fixed = TransformStamped("r/upper", "r/tool", 0, Transform((2.0, 0.0, 0.0)), static=True)
    assert fixed in tree.samples_around("r/tool", 2)


def test_what_cannot_be_used_is_counted_and_the_rest_is_read(tmp_path: Path) -> None:
    good = joint_state(5, {"shoulder": 1.0})
    path = write(
        tmp_path / "run.mcap",
        joint_state(1, {"shoulder": 0.5, "tail": 1.0}),
        joint_state(2, {"shoulder": math.nan}),
        good[:20],
        good,
    )
    problems: Counter[str] = Counter()
    tree = load_joint_states(path, ARM, problems=problems)
    assert problems == {"unknown joint": 1, "not finite": 1, "truncated": 1}
    assert tree.inserted == 3


def test_a_part_includes_both_ends_and_damage_is_counted(path: Path) -> None:
    payloads = [joint_state(k, {"shoulder": 0.1 * k, "tail": 1.0, "ear": 1.0}) for k in range(5)]
    write_mcap(path, [(k, "/joint_states", each) for k, each in enumerate(payloads)], schema=KIND, chunk_size=1)
    data = bytearray(path.read_bytes())
    data[data.index(payloads[2])] ^= 1
    path.write_bytes(data)
    problems = Counter({"damaged": 10})
    tree = load_joint_states(path, ARM, "joint_states", 1, 3, problems=problems)
    # The third message is lost, and two have two unknown joints each; one joint is fixed.
    assert problems == {"damaged": 11, "unknown joint": 4}
    assert tree.inserted == 3
    (edge,) = (edge for edge in tree.edges() if edge.child == "upper")
    assert (edge.samples, edge.oldest, edge.newest) == (2, 1, 3)


def test_a_recording_without_positions_is_refused_and_says_where_there_are_some(tmp_path: Path) -> None:
    path = write(tmp_path / "run.mcap", joint_state(1, {}), topic="/arm/joint_states")
    with pytest.raises(RecordingError, match="topics with them: /arm/joint_states") as raised:
        load_joint_states(path, ARM)
    assert raised.value.reason == "no such topic"
    # Its traceback still refers to the file.
    assert not is_open(path)
    assert load_joint_states(path, ARM, "arm/joint_states").inserted == 1


def test_the_transforms_of_a_real_robot_are_those_that_its_state_publisher_sent() -> None:
    path = real("pr2_tf.bag")
    published, computed = load(path), load_joint_states(path, real("pr2.urdf"), "/joint_states")
    compared = 0
    for edge in published.edges():
        stamp = edge.newest
        if edge.child not in computed or stamp is None or not computed.can_transform(edge.parent, edge.child, stamp):
            continue
        compared += 1
        theirs = published.lookup(edge.parent, edge.child, stamp).transform
        assert computed.lookup(edge.parent, edge.child, stamp).transform.is_close(theirs)
    assert compared > 30
