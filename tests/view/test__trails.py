import numpy as np
import pytest
from support.samples import moving, over, static, tree_of

from tfbus import SECOND
from tfbus.view.page import SAMPLES, trail


def test_a_trail_ends_at_the_newest_answer_and_begins_a_duration_before() -> None:
    tree = tree_of(*over("map", "a", (0, 10 * SECOND), speed=1e-9), static("a", "tip", 1.0))
    lines = trail(tree, "map", "tip", None, 4.0)
    assert lines.shape == (SAMPLES - 1, 2, 3)
    assert lines[0, 0, 0] == pytest.approx(7.0)
    assert lines[-1, 1, 0] == pytest.approx(11.0)
    assert np.array_equal(lines[1:, 0], lines[:-1, 1])


def test_a_trail_ends_at_the_chosen_stamp() -> None:
    tree = tree_of(*over("map", "a", (0, 10 * SECOND), speed=1e-9))
    assert trail(tree, "map", "a", 5 * SECOND, 2.0)[[0, -1], [0, 1], 0].tolist() == pytest.approx([3.0, 5.0])


def test_a_trail_has_a_break_where_there_is_no_answer() -> None:
    tree = tree_of(*over("map", "a", (8 * SECOND, 10 * SECOND), speed=1e-9))
    lines = trail(tree, "map", "a", None, 8.0)
    assert 0 < len(lines) < SAMPLES / 2
    assert lines.min(axis=(0, 1))[0] >= 8.0


def test_there_is_no_trail_of_a_static_or_unknown_frame() -> None:
    tree = tree_of(static("map", "a"), moving("world", "b", 0))
    for frame in ("a", "nobody", "b"):
        assert trail(tree, "map", frame, None, 5.0).shape == (0, 2, 3)
