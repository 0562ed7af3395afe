import pytest
from support.samples import moving, over, static, tree_of

from tfbus import SECOND
from tfbus.tree.tree import forest_of
from tfbus.view.page import Timeline, span_of

SPAN = (10 * SECOND, 20 * SECOND)


def at(stamp: int) -> Timeline:
    line = Timeline()
    line.choose(stamp, SPAN)
    return line


def test_it_is_live_until_a_stamp_is_chosen_and_again_after_that() -> None:
    line = Timeline()
    assert line.stamp is None
    line.choose(12 * SECOND, SPAN)
    assert line.stamp == 12 * SECOND
    line.play()
    line.go_live()
    assert (line.stamp, line.playing) == (None, False)


@pytest.mark.parametrize(("asked", "found"), [(5, 10), (10, 10), (15, 15), (20, 20), (30, 20)])
def test_a_stamp_outside_of_the_span_becomes_its_nearest_end(asked: int, found: int) -> None:
    assert at(asked * SECOND).stamp == found * SECOND
    line = at(11 * SECOND)
    line.seek(asked * SECOND)
    assert line.stamp == found * SECOND


def test_a_chosen_stamp_stands_still_until_it_plays_at_its_speed() -> None:
    line = at(12 * SECOND)
    line.advance(1.0)
    assert line.stamp == 12 * SECOND
    line.play()
    line.speed = 0.5
    line.advance(3.0)
    assert line.stamp == 13_500_000_000
    line.pause()
    line.advance(1.0)
    assert line.stamp == 13_500_000_000


def test_playing_ends_at_the_end_and_begins_anew_from_there() -> None:
    line = at(19 * SECOND)
    line.play()
    line.advance(5.0)
    assert (line.stamp, line.playing) == (20 * SECOND, False)
    line.play()
    assert (line.stamp, line.playing) == (10 * SECOND, True)


def test_live_there_is_nothing_to_play_seek_or_step() -> None:
    line = Timeline()
    line.play()
    line.seek(5)
    line.advance(1.0)
    line.step(forest_of(tree_of(moving("map", "a", 5))), forward=True)
    assert (line.stamp, line.playing) == (None, False)


def test_a_step_goes_to_the_nearest_sample_of_any_frame() -> None:
    forest = forest_of(tree_of(*over("map", "a", (10, 30)), *over("map", "b", (20,)), static("a", "c"), keep=None))
    line = Timeline()
    line.choose(10, (10, 30))
    line.play()
    stamps = []
    for forward in (True, True, True, False, False, False):
        line.step(forest, forward)
        stamps.append(line.stamp)
    assert stamps == [20, 30, 30, 20, 10, 10]
    assert not line.playing
    line.seek(25)
    line.step(forest, forward=False)
    assert line.stamp == 20


def test_a_step_reaches_a_sample_one_nanosecond_away() -> None:
    forest = forest_of(tree_of(*over("map", "a", (10, 11)), keep=None))
    line = Timeline()
    line.choose(10, (10, 11))
    for forward, stamp in ((True, 11), (False, 10)):
        line.step(forest, forward)
        assert line.stamp == stamp


def test_the_span_reaches_from_the_oldest_to_the_newest_sample_of_any_frame() -> None:
    assert span_of(forest_of(tree_of(*over("map", "a", (10, 30)), *over("map", "b", (5, 20))))) == (5, 30)
    assert span_of(forest_of(tree_of(static("map", "a")))) is None


def test_the_span_leaves_out_what_has_left_the_window() -> None:
    tree = tree_of(moving("map", "a", 0), keep=1.0)
    tree.insert(moving("map", "a", 2 * SECOND))
    assert span_of(forest_of(tree)) == (2 * SECOND, 2 * SECOND)
