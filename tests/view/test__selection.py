import math

from support.samples import moving, over, static, tree_of

from tfbus import LATEST, SECOND, Transform, TransformStamped
from tfbus.view.page import selection_facts


def test_the_pose_is_in_m_degrees_and_a_quaternion_with_w_last() -> None:
    tree = tree_of(
        TransformStamped("map", "base", SECOND, Transform.from_xyz_rpy((1, -2, 0.5), (0, 0, math.pi / 2)), "odometry")
    )
    facts = selection_facts(tree, "map", "base", LATEST, 3 * SECOND, 0.25)
    assert facts == {
        "frame": "base",
        "in": "map",
        "xyz": "1.000000 -2.000000 0.500000 m",
        "rpy": "0.000000 0.000000 90.000000 deg",
        "quaternion": "0.000000 0.000000 0.707107 0.707107 (x y z w)",
        "at": "1.000 s",
        "chain": "base → map",
        "parent": "map",
        "rate": "one sample",
        "age": "2 s",
        "delay": "250 ms",
        "authority": "odometry",
    }


def test_a_static_pose_is_of_any_time_and_has_no_age() -> None:
    facts = selection_facts(tree_of(static("map", "a")), "map", "a", LATEST, 0)
    assert (facts["at"], facts["rate"], facts["authority"]) == ("any time", "static", "not known")
    assert not {"age", "delay"} & facts.keys()


def test_the_pose_is_that_of_the_chosen_stamp() -> None:
    tree = tree_of(*over("map", "a", (0, SECOND), speed=1e-9))
    facts = selection_facts(tree, "map", "a", SECOND // 4, SECOND)
    assert facts["xyz"] == "0.250000 0.000000 0.000000 m"
    assert facts["at"] == "0.250 s"
    assert facts["rate"] == "1.0 Hz"


def test_a_frame_without_a_pose_says_why_and_keeps_the_other_facts() -> None:
    tree = tree_of(moving("map", "a", SECOND), static("world", "b"))
    late = selection_facts(tree, "map", "a", 3 * SECOND, 3 * SECOND)
    assert "2 s short" in late["pose"]
    assert late["parent"] == "map"
    assert "different trees" in selection_facts(tree, "map", "b", LATEST, 0)["pose"]
    assert "not known" in selection_facts(tree, "map", "gone", LATEST, 0)["pose"]
    assert selection_facts(tree, None, "a", LATEST, 0)["pose"] == "there is no fixed frame"


def test_a_stamp_ahead_of_the_clock_is_told() -> None:
    facts = selection_facts(tree_of(moving("map", "a", 3 * SECOND)), "map", "a", LATEST, SECOND)
    assert facts["age"] == "2 s ahead"


def test_a_root_has_no_parent() -> None:
    facts = selection_facts(tree_of(static("map", "a", 2.0)), "a", "map", LATEST, 0)
    assert facts["parent"] == "none, it is a root"
    assert facts["xyz"] == "-2.000000 0.000000 0.000000 m"
