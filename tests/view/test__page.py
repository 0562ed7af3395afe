from html import unescape

import numpy as np
from support.samples import moving, over, static, tree_of

from tfbus import SECOND, Buffer, Bus, SimulatedClock, TransformTree
from tfbus.events import FrameRemoved
from tfbus.view.page import EVENTS_KEPT, Page, Texts


def line(end: int = 10) -> TransformTree:
    """The base at x = t, sampled each second."""
    return tree_of(*over("map", "base", range(0, (end + 1) * SECOND, SECOND), speed=1e-9), static("base", "lidar", 1.0))


def x_of(page: Page, frame: str) -> float:
    scene = page.picture(0).scene
    place = scene.place(frame)
    assert place is not None
    return float(scene.positions[place, 0])


def texts(page: Page, now: int = 0) -> Texts:
    return page.texts(now, page.picture(now).scene)


def test_a_live_page_shows_the_newest_data() -> None:
    tree = line()
    page = Page(tree)
    assert x_of(page, "base") == 10.0
    tree.insert(moving("map", "base", 11 * SECOND, 11.0))
    assert x_of(page, "base") == 11.0
    assert "live" in texts(page).status


def test_a_recording_starts_at_its_oldest_sample_and_cannot_go_live() -> None:
    page = Page(line(), live=False)
    page.go_live()
    assert x_of(page, "base") == 0.0
    assert "paused at 0.000 s, 0.000 s from the start" in texts(page).status
    page.timeline.seek(4 * SECOND)
    assert x_of(page, "lidar") == 5.0


def test_a_pause_keeps_the_history_that_there_was() -> None:
    clock = SimulatedClock(10 * SECOND)
    bus = Bus(clock)
    with Buffer(bus, keep=5.0) as buffer:
        bus.publish(over("map", "base", range(0, 11 * SECOND, SECOND), speed=1e-9))
        page = Page(buffer.tree)
        page.freeze()
        bus.publish(moving("map", "base", 100 * SECOND, 100.0))
        page.timeline.seek(6 * SECOND)
        assert x_of(page, "base") == 6.0
        page.timeline.play()
        page.freeze()
        assert (page.timeline.playing, page.timeline.stamp) == (False, 6 * SECOND)
        page.go_live()
        assert x_of(page, "base") == 100.0


def test_playing_while_live_plays_the_history_from_its_start() -> None:
    page = Page(line())
    page.play()
    page.timeline.advance(2.5)
    assert x_of(page, "base") == 2.5
    assert "playing × 1 at 2.500 s" in texts(page).status


def test_a_step_while_live_goes_back_from_the_newest_sample() -> None:
    page = Page(line())
    page.step(forward=False)
    assert x_of(page, "base") == 9.0
    page.step(forward=True)
    assert x_of(page, "base") == 10.0


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


def test_a_fixed_frame_that_is_not_known_draws_nothing_and_says_so() -> None:
    page = Page(line(), fixed="mop")
    assert page.picture(0).scene.frames == ()
    assert "the fixed frame 'mop' is not known" in unescape(texts(page).status)


def test_a_page_without_frames_waits() -> None:
    page = Page(TransformTree())
    assert page.picture(0).scene.frames == ()
    assert "waiting for transforms" in texts(page).status
    assert "no frames" in texts(page).tree


def test_labels_are_on_the_chain_of_the_selection_or_all_or_none() -> None:
    page = Page(line())
    assert page.picture(0).labels == ()
    page.select("base")
    assert page.picture(0).labels == ("base", "map")
    page.labels = "all"
    assert page.picture(0).labels == ("map", "base", "lidar")
    page.labels = "none"
    assert page.picture(0).labels == ()


def test_the_selected_frame_is_described_and_marked_in_the_tree() -> None:
    page = Page(line())
    assert "Click on a frame" in texts(page).selection
    page.delays = {"base": 0.25}
    page.select("base")
    shown = texts(page, 12 * SECOND)
    assert all(fact in shown.selection for fact in ("10.000000 0.000000 0.000000 m", "2 s", "250 ms"))
    assert shown.tree.count("background") == 1
    page.select(None)
    assert "Click on a frame" in texts(page).selection
    assert texts(page).tree.count("background") == 0


def test_the_facts_are_those_of_the_chosen_stamp() -> None:
    page = Page(line(), live=False)
    page.timeline.seek(4 * SECOND)
    page.select("lidar")
    assert "5.000000 0.000000 0.000000 m" in texts(page, 99 * SECOND).selection


def test_trails_are_drawn_for_the_frames_that_were_chosen() -> None:
    page = Page(line(), trails=["base"])
    alone = page.picture(0).trails
    assert len(alone) > 10
    page.toggle_trail()
    assert np.array_equal(page.picture(0).trails, alone)
    page.select("lidar")
    page.toggle_trail()
    assert len(page.picture(0).trails) == 2 * len(alone)
    page.toggle_trail()
    assert list(page.trails) == ["base"]


def test_the_search_finds_parts_of_names_in_any_case() -> None:
    page = Page(line())
    assert texts(page).matches == texts(page).frames == ("base", "lidar", "map")
    page.search = "A"
    assert texts(page).matches == ("base", "lidar", "map")
    page.search = "DAR"
    assert texts(page).matches == ("lidar",)


def test_the_newest_events_come_first_and_the_oldest_are_forgotten() -> None:
    page = Page(line())
    assert "none so far" in texts(page).events
    for number in range(EVENTS_KEPT + 1):
        page.note_event(FrameRemoved(number, f"<f{number}>"))
    shown = unescape(texts(page).events)
    assert shown.index(f"<f{EVENTS_KEPT}>") < shown.index("<f1>")
    assert "<f0>" not in shown
    assert "<f1>" not in texts(page).events


def test_the_tree_follows_changes_of_state_and_parent() -> None:
    tree = line()
    page = Page(tree, stale_after=1.0)
    before = texts(page, 10 * SECOND).tree
    assert texts(page, 10 * SECOND).tree is before
    assert texts(page, 12 * SECOND).tree != before
    tree.insert(static("map", "lidar", 1.0))
    assert texts(page, 10 * SECOND).tree != before


def test_how_many_frames_are_connected_is_told() -> None:
    page = Page(tree_of(static("map", "a"), static("map", "b"), static("world", "c")))
    assert "3 of 5 frames are connected with 'map'" in unescape(texts(page).status)
