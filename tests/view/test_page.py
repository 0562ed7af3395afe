import math
from html import unescape

import numpy as np
import pytest
from support.samples import moving, over, static, tree_of

from tfbus import LATEST, SECOND, Latest, Transform, TransformStamped, TransformTree
from tfbus.events import FrameRemoved
from tfbus.tree.history import EdgeState
from tfbus.tree.tree import forest_of
from tfbus.view.page import EVENTS_KEPT, SAMPLES, Page, Scene, SceneReader, Texts, Timeline, selection_facts, trail


def driven(end: int = 10) -> TransformTree:
    """The base at x = t, sampled each second."""
    return tree_of(*over("map", "base", range(0, (end + 1) * SECOND, SECOND), speed=1e-9), static("base", "lidar", 1.0))


def x_of(page: Page, frame: str) -> float:
    scene = page.picture(0).scene
    place = scene.place(frame)
    assert place is not None
    return float(scene.positions[place, 0])


def texts(page: Page, now: int = 0) -> Texts:
    return page.texts(now, page.picture(now).scene)


def test_a_recording_starts_at_its_oldest_sample_and_cannot_go_live() -> None:
    page = Page(driven(), live=False)
    page.go_live()
    assert x_of(page, "base") == 0.0
    assert "paused at 0.000 s, 0.000 s from the start" in texts(page).status
    page.timeline.seek(4 * SECOND)
    assert x_of(page, "lidar") == 5.0


def test_playing_while_live_plays_the_history_from_its_start() -> None:
    page = Page(driven())
    page.play()
    page.timeline.advance(2.5)
    assert x_of(page, "base") == 2.5
    assert "playing × 1 at 2.500 s" in texts(page).status


def test_a_tree_without_moving_frames_stays_live() -> None:
    page = Page(tree_of(static("map", "a", 1.0)))
    page.freeze()
    page.play()
    page.step(forward=True)
    assert page.timeline.stamp is None
    assert Page(tree_of(static("map", "a")), live=False).timeline.stamp == 0


def test_the_fixed_frame_is_the_root_of_the_largest_tree_until_one_is_chosen() -> None:
    tree = tree_of(static("odom", "base"))
    page = Page(tree)
    assert page.fixed == "odom"
    tree.insert(static("map", "odom", 3.0))
    assert page.fixed == "map"
    page.choose_fixed("base")
    assert page.picture(0).scene.frames[0] == "base"
    page.choose_fixed(None)
    assert page.fixed == "map"


def test_a_page_without_frames_waits() -> None:
    page = Page(TransformTree())
    assert page.picture(0).scene.frames == ()
    assert "waiting for transforms" in texts(page).status
    assert "no frames" in texts(page).tree


def test_the_newest_events_come_first_and_the_oldest_are_forgotten() -> None:
    page = Page(driven())
    assert "none so far" in texts(page).events
    for number in range(EVENTS_KEPT + 1):
        page.note_event(FrameRemoved(number, f"<f{number}>"))
    shown = unescape(texts(page).events)
    assert shown.index(f"<f{EVENTS_KEPT}>") < shown.index("<f1>")
    assert "<f0>" not in shown
    assert "<f1>" not in texts(page).events


def test_the_tree_follows_changes_of_state_and_parent() -> None:
    tree = driven()
    page = Page(tree, stale_after=1.0)
    before = texts(page, 10 * SECOND).tree
    assert texts(page, 10 * SECOND).tree is before
    assert texts(page, 12 * SECOND).tree != before
    tree.insert(static("map", "lidar", 1.0))
    assert texts(page, 10 * SECOND).tree != before


# The timeline

SPAN = (10 * SECOND, 20 * SECOND)


def at(stamp: int) -> Timeline:
    line = Timeline()
    line.choose(stamp, SPAN)
    return line


def test_a_stamp_outside_of_the_span_becomes_its_nearest_end_and_playing_ends_there_and_begins_anew() -> None:
    assert (at(5 * SECOND).stamp, at(15 * SECOND).stamp, at(30 * SECOND).stamp) == (SPAN[0], 15 * SECOND, SPAN[1])
    line = at(11 * SECOND)
    line.seek(0)
    assert line.stamp == SPAN[0]
    line.seek(19 * SECOND)
    line.play()
    line.advance(5.0)
    assert (line.stamp, line.playing) == (SPAN[1], False)
    line.play()
    assert (line.stamp, line.playing) == (SPAN[0], True)


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


# Scenes


def read(
    tree: TransformTree, fixed: str = "map", at: int | Latest = LATEST, now: int = 0, selected: str | None = None
) -> Scene:
    return SceneReader(forest_of(tree), stale_after=1.0).read(fixed, at, now, selected)


def states(scene: Scene) -> dict[str, EdgeState]:
    return dict(zip(scene.frames, scene.states, strict=True))


def test_poses_are_positions_and_quaternions_with_w_first() -> None:
    tree = TransformTree()
    tree.insert(TransformStamped("map", "base", 0, Transform((1, 2, 3), (0.1, 0.3, 0.5, 0.8062257748298549))))
    scene = read(tree)
    assert scene.frames == ("map", "base")
    assert scene.positions.tolist() == [[0, 0, 0], [1, 2, 3]]
    assert scene.wxyzs[1] == pytest.approx([0.8062257748298549, 0.1, 0.3, 0.5])


def test_a_line_goes_from_each_frame_to_its_parent_in_the_colour_of_the_frame() -> None:
    scene = read(tree_of(moving("map", "odom", 0, 1.0), static("odom", "base", 2.0)), fixed="odom")
    assert scene.frames == ("odom", "base", "map")
    # From odom to map, and from base to odom.
    assert scene.lines[:, :, 0].tolist() == [[0, -1], [2, 0]]
    green, blue = [0x00, 0x9E, 0x73], [0x00, 0x72, 0xB2]
    assert scene.line_colours.tolist() == [[green, green], [blue, blue]]
    assert scene.colours.tolist() == [green, blue, blue]
    assert scene.parents.tolist() == [2, 0, -1]


def test_live_frames_are_stale_by_the_clock() -> None:
    tree = tree_of(moving("map", "old", 0), moving("map", "new", SECOND), static("map", "anchor"))
    assert states(read(tree, now=SECOND + 1)) == {
        "map": EdgeState.STATIC,
        "old": EdgeState.STALE,
        "new": EdgeState.MOVING,
        "anchor": EdgeState.STATIC,
    }
    assert states(read(tree, now=SECOND))["old"] is EdgeState.MOVING


def test_at_a_chosen_stamp_frames_are_stale_by_that_stamp() -> None:
    tree = tree_of(*over("map", "base", (0, 9 * SECOND)))
    far = 100 * SECOND
    assert states(read(tree, at=SECOND, now=far))["base"] is EdgeState.MOVING
    assert states(read(tree, at=2 * SECOND, now=far))["base"] is EdgeState.STALE
    assert states(read(tree, at=9 * SECOND, now=far))["base"] is EdgeState.MOVING
    assert states(read(tree, at=-SECOND, now=far))["base"] is EdgeState.SILENT


def test_frames_without_a_pose_are_not_drawn_but_the_others_are() -> None:
    tree = tree_of(moving("map", "base", 0), static("base", "lidar"), static("map", "anchor", 1.0))
    tree.clear()
    scene = read(tree)
    assert scene.frames == ("map", "anchor")
    assert scene.lines[:, :, 0].tolist() == [[1, 0]]
    assert scene.place("anchor") == 1
    assert scene.place("lidar") is None


def test_the_chain_of_the_selected_frame_leads_to_the_fixed_one() -> None:
    tree = tree_of(static("map", "a", 1.0), static("a", "b", 1.0), static("map", "c", -1.0), static("c", "d", -1.0))
    assert read(tree, "d", selected="b").chain == ("b", "a", "map", "c", "d")
    assert read(tree, "map", selected="b").chain == ("b", "a", "map")
    assert read(tree, "b", selected="map").chain == ("map", "a", "b")
    assert read(tree, "a", selected="b").chain == ("b", "a")
    assert read(tree, "a", selected="a").chain == ("a",)
    assert read(tree, "map", selected="b").chain_lines[:, :, 0].tolist() == [[2, 1], [1, 0]]


def test_positions_far_away_are_exact_in_a_fixed_frame_that_is_near() -> None:
    tree = tree_of(static("map", "site", 4e8), static("site", "base", 0.001))
    assert read(tree, "site").positions[1, 0] == np.float32(0.001)


# Trails


def test_a_trail_ends_at_the_newest_answer_and_begins_a_duration_before() -> None:
    tree = tree_of(*over("map", "a", (0, 10 * SECOND), speed=1e-9), static("a", "tip", 1.0))
    lines = trail(tree, "map", "tip", None, 4.0)
    assert lines.shape == (SAMPLES - 1, 2, 3)
    assert lines[0, 0, 0] == pytest.approx(7.0)
    assert lines[-1, 1, 0] == pytest.approx(11.0)
    assert np.array_equal(lines[1:, 0], lines[:-1, 1])


def test_a_trail_of_a_chosen_stamp_ends_there_and_has_a_break_where_there_is_no_answer() -> None:
    tree = tree_of(*over("map", "a", (8 * SECOND, 10 * SECOND), speed=1e-9))
    lines = trail(tree, "map", "a", None, 8.0)
    assert trail(tree, "map", "a", 9 * SECOND, 1.0)[[0, -1], [0, 1], 0].tolist() == pytest.approx([8.0, 9.0])
    assert 0 < len(lines) < SAMPLES / 2
    assert lines.min(axis=(0, 1))[0] >= 8.0


def test_there_is_no_trail_of_a_static_or_unknown_frame() -> None:
    tree = tree_of(static("map", "a"), moving("world", "b", 0))
    for frame in ("a", "nobody", "b"):
        assert trail(tree, "map", frame, None, 5.0).shape == (0, 2, 3)


# The selected frame


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


def test_a_frame_without_a_pose_says_why_and_keeps_the_other_facts() -> None:
    tree = tree_of(moving("map", "a", SECOND), static("world", "b"))
    late = selection_facts(tree, "map", "a", 3 * SECOND, 3 * SECOND)
    assert "2 s short" in late["pose"]
    assert late["parent"] == "map"
    assert "different trees" in selection_facts(tree, "map", "b", LATEST, 0)["pose"]
    assert "not known" in selection_facts(tree, "map", "gone", LATEST, 0)["pose"]
    assert selection_facts(tree, None, "a", LATEST, 0)["pose"] == "there is no fixed frame"


# The texts about the page as a whole


def test_a_root_has_no_parent_and_a_stamp_ahead_of_the_clock_is_told() -> None:
    tree = tree_of(moving("map", "a", 3 * SECOND, 2.0))
    assert selection_facts(tree, "map", "a", LATEST, SECOND)["age"] == "2 s ahead"
    facts = selection_facts(tree, "a", "map", LATEST, 0)
    assert (facts["parent"], facts["xyz"]) == ("none, it is a root", "-2.000000 0.000000 0.000000 m")


def test_the_fixed_frame_of_trees_of_one_size_is_the_first_by_name_and_the_connected_frames_are_counted() -> None:
    tree = tree_of(static("zoo", "a"), static("world", "b"))
    page = Page(tree)
    assert page.fixed == "world"
    tree.insert(static("zoo", "c"))
    assert "3 of 5 frames are connected with 'zoo'" in unescape(texts(Page(tree)).status)


def test_trails_are_toggled_for_the_selected_frame() -> None:
    page = Page(driven(), trails=["base"])
    page.toggle_trail()
    alone = len(page.picture(0).trails)
    page.select("lidar")
    page.toggle_trail()
    assert len(page.picture(0).trails) == 2 * alone > 20
    page.toggle_trail()
    assert list(page.trails) == ["base"]
