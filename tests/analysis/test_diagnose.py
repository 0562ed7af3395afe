from support.samples import moving, static, tree_of

from tfbus import SECOND, diagnose
from tfbus.analysis import Limits


def test_a_tree_is_examined_with_its_senders_and_parents() -> None:
    drive = [moving("odom", "base", k * SECOND, float(k), "odometry") for k in range(10)]
    tree = tree_of(static("base", "laser"), *drive, keep=None)
    assert diagnose(tree) == []
    tree.insert(moving("odom", "base", 10 * SECOND, 1e10, "slam"))
    tree.insert(static("x", "y"))
    assert [(each.kind, each.frame, each.count, each.first) for each in diagnose(tree)] == [
        ("disconnected", None, 2, None),
        ("two authorities", "base", 1, 10 * SECOND),
        ("translation", "base", 1, 10 * SECOND),
    ]
    assert [each.kind for each in diagnose(tree, Limits(speed=0.5)) if each.frame == "base"][-1] == "jump"


def test_each_sample_has_its_own_sender_even_if_it_came_late() -> None:
    tree = tree_of(*(moving("odom", "base", k * SECOND, float(k), "odometry") for k in range(0, 10, 2)), keep=None)
    tree.insert_many([moving("odom", "base", k * SECOND, float(k), "slam") for k in (3, 7)])
    found = [(each.kind, each.frame, each.count, each.first) for each in diagnose(tree)]
    assert found == [("two authorities", "base", 4, 3 * SECOND)]


def test_only_the_window_is_examined() -> None:
    tree = tree_of(moving("a", "b", 0, 1e10), *(moving("a", "b", k * SECOND) for k in range(11, 15)))
    assert diagnose(tree) == []


def test_a_frame_that_was_cleared_has_nothing_wrong() -> None:
    tree = tree_of(moving("a", "b", 0, 1e10))
    tree.clear()
    assert diagnose(tree) == []
