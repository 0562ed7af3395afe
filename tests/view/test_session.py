import json
import math
import random
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.samples import moving, over, static, tree_of
from support.shown_pages import Shown

from tfbus import (
    LATEST,
    SECOND,
    Covariance,
    PointCloud,
    Transform,
    TransformStamped,
    TransformTree,
    UncertainSample,
)
from tfbus.events import FrameLive, FrameRemoved, PeerLost
from tfbus.view.session import EVENTS_KEPT, MAX_TRAILS, Edit, Film, Page, Points, Save, Session

GREY = np.array((9, 9, 9), np.uint8)


def driven(end: int = 10) -> TransformTree:
    """The base at x = t, sampled each second, and a lidar 1 m ahead of it."""
    return tree_of(*over("map", "base", range(0, (end + 1) * SECOND, SECOND), speed=1e-9), static("base", "lidar", 1.0))


class Browser(Shown):
    """A browser of a page, whose pictures are made when they are looked at."""

    def __init__(self, tree: TransformTree, page: Page | None = None, **options: Any) -> None:
        super().__init__()
        self.page = page or Page(tree, **options)
        self.session = Session(self.page)
        self.elapsed = 0
        self.look()

    def look(self, now: int = 0, seconds: float = 0.0) -> "Browser":
        self.elapsed += round(seconds * SECOND)
        return self.take(self.session.picture(now, self.elapsed))

    def do(self, name: str, **values: Any) -> "Browser":
        self.wish = self.session.do(self.session.read(json.dumps({"do": name, **values})))
        return self.look()

    @property
    def time(self) -> tuple[str, float]:
        """The mode, and the stamp in s."""
        return self.said["time"]["mode"], int(self.said["time"]["at"]) / SECOND

    @property
    def facts(self) -> dict[str, str]:
        facts: dict[str, str] = self.said["selection"]["facts"]
        return facts


# Frames


def test_the_frames_of_the_largest_tree_come_first_and_the_others_have_no_pose() -> None:
    browser = Browser(tree_of(static("map", "base", 2.0), static("base", "lidar", 1.0), static("zoo", "ape")))
    assert browser.parents == {"map": None, "base": "map", "lidar": "base", "ape": "zoo", "zoo": None}
    assert browser.x == {"map": 0.0, "base": 2.0, "lidar": 3.0}
    assert (browser.said["frames"]["fixed"], browser.said["frames"]["chosen_fixed"]) == ("map", None)
    browser.page.tree.insert_many([static("zoo", "bat", 1.0), static("zoo", "cat", 2.0), static("zoo", "dog", 3.0)])
    assert browser.look().x == {"zoo": 0.0, "ape": 0.0, "bat": 1.0, "cat": 2.0, "dog": 3.0}
    assert browser.do("fixed", frame="lidar").x == {"lidar": 0.0, "base": -1.0, "map": -3.0}
    assert browser.do("fixed", frame=None).said["frames"]["fixed"] == "zoo"


def test_poses_are_positions_and_quaternions_with_w_last_and_exact_near_the_fixed_frame() -> None:
    turned = Transform((1, 2, 3), (0.1, 0.3, 0.5, 0.8062257748298549))
    tree = tree_of(TransformStamped("site", "base", 0, turned), static("map", "site", 4e8))
    assert Browser(tree, fixed="site").rows[1] == pytest.approx([1, 2, 3, 0.1, 0.3, 0.5, 0.8062257748298549])
    tree.insert(static("site", "near", 0.001))
    assert Browser(tree, fixed="site").x["near"] == np.float32(0.001)


def test_a_page_without_frames_waits_and_one_whose_fixed_frame_is_gone_says_so() -> None:
    tree = TransformTree()
    browser = Browser(tree)
    assert (browser.said["frames"]["names"], browser.said["frames"]["waiting"]) == ([], True)
    tree.insert_many([static("map", "base"), static("map", "dock")])
    browser.page.clouds["scan"] = Points(PointCloud("dock", LATEST, np.zeros((1, 3))), 0.02, GREY)
    assert browser.look().do("fixed", frame="base").x == {"base": 0.0, "map": 0.0, "dock": 0.0, "scan": 0.0}
    tree.remove_frame("base")
    browser.look()
    assert (browser.said["frames"]["fixed"], browser.said["frames"]["names"]) == ("base", ["dock", "map"])
    assert browser.x == {}


def test_frames_are_static_moving_stale_or_silent_by_the_clock_or_by_the_chosen_stamp() -> None:
    tree = tree_of(*over("map", "base", (0, 9 * SECOND)), static("map", "dock"), moving("zoo", "ape", 9 * SECOND))
    live = Browser(tree, stale_after=1.0)
    moves = {"map": "static", "dock": "static", "zoo": "static", "base": "moving", "ape": "moving"}
    assert live.look(10 * SECOND, 1.0).states == moves
    assert live.look(10 * SECOND + 1, 1.0).states == moves | {"base": "stale", "ape": "stale"}
    recorded = Browser(tree, stale_after=1.0, live=False)
    for stamp, base, ape in (
        (1, "moving", "silent"),
        (2 * SECOND, "stale", "silent"),
        (9 * SECOND, "moving", "moving"),
    ):
        assert recorded.do("seek", ns=str(stamp)).states == moves | {"base": base, "ape": ape}
    late = tree_of(*over("map", "early", (0, 9)), *over("map", "late", (5, 9)), keep=None)
    assert Browser(late, live=False).states["late"] == "silent"


def test_a_stale_frame_whose_peer_is_gone_is_lost_until_it_is_live_again() -> None:
    browser = Browser(tree_of(moving("map", "base", 0), moving("zoo", "ape", 0)))
    browser.page.note_event(PeerLost(0, "local", "ab" * 16, ("odometry",), ("base", "ape")))
    assert {browser.look(0, 1.0).states[frame] for frame in ("base", "ape")} == {"moving"}
    assert {browser.look(9 * SECOND, 1.0).states[frame] for frame in ("base", "ape")} == {"lost"}
    browser.page.note_event(FrameLive(0, "base", 0, "odometry"))
    assert browser.look(9 * SECOND, 1.0).states["base"] == "stale"


def test_what_has_not_changed_is_not_sent_again() -> None:
    browser = Browser(driven())
    browser.do("select", frame="base").look(0, 1.0)
    browser.received.clear()
    browser.look(0, 0.1)
    assert browser.received == []
    # The sign of life.
    browser.look(0, 1.0)
    assert browser.received == ["time"]
    browser.page.tree.insert(moving("map", "base", 11 * SECOND, 11.0))
    browser.look(0, 0.1)
    assert browser.received == ["time", "kind 1"]
    browser.page.tree.insert(moving("lidar", "tip", 11 * SECOND, 1.0))
    browser.look(0, 0.01)
    assert browser.received == ["time", "kind 1", "frames", "states", "kind 1"]
    assert browser.x["tip"] == 13.0


# Time


def test_a_recording_starts_at_its_oldest_sample_and_cannot_go_live() -> None:
    browser = Browser(driven(), live=False)
    assert (browser.time, browser.x["base"]) == (("paused", 0.0), 0.0)
    with pytest.raises(ValueError, match="no live data"):
        browser.do("live")
    assert browser.do("seek", ns=str(4 * SECOND)).x["lidar"] == 5.0


def test_time_stands_still_on_a_copy_of_the_history_until_it_goes_live_again() -> None:
    browser = Browser(driven())
    assert (browser.time, browser.said["time"]["start"]) == (("live", 0.0), "0")
    browser.do("pause")
    browser.page.tree.insert(moving("map", "base", 40 * SECOND, 40.0))
    assert (browser.look(0, 1.0).time, browser.x["base"]) == (("paused", 10.0), 10.0)
    assert browser.do("home").time == ("paused", 0.0)
    assert browser.do("end").time == ("paused", 10.0)
    for chosen, shown in ((-5, 0), (99, 10)):
        assert browser.do("seek", ns=str(chosen * SECOND)).time == ("paused", shown)
    assert browser.do("live").x["base"] == 40.0
    assert browser.time[0] == "live"


def test_time_stands_still_where_all_frames_have_a_pose_that_are_not_stale() -> None:
    tree = tree_of(*(moving("map", f"{age}", (100 - age) * SECOND // 10) for age in (0, 1, 2, 11)))
    browser = Browser(tree, stale_after=1.0)
    assert browser.do("pause").time == ("paused", 9.8)
    assert browser.said["time"]["end"] == str(10 * SECOND)
    assert browser.do("play").time == ("playing", 8.9)
    assert browser.do("end").time == ("paused", 9.8)


def test_a_tree_without_moving_frames_stays_live() -> None:
    browser = Browser(tree_of(static("map", "a", 1.0)))
    for order in ({"name": "pause"}, {"name": "play"}, {"name": "step", "forward": True}, {"name": "home"}):
        assert browser.do(**order).time[0] == "live"
    assert Browser(tree_of(static("map", "a")), live=False).time == ("paused", 0.0)


def test_playing_runs_with_the_speed_to_the_end_and_begins_anew_there() -> None:
    browser = Browser(driven())
    assert browser.do("play", speed=2.0).time == ("playing", 0.0)
    assert browser.look(0, 1.25).x["base"] == 2.5
    assert browser.look(0, 60.0).time == ("paused", 10.0)
    assert browser.do("play").time == ("playing", 0.0)
    assert browser.do("seek", ns=str(SECOND)).time == ("paused", 1.0)


def test_a_step_goes_to_the_nearest_sample_of_a_frame_or_of_any() -> None:
    tree = tree_of(*over("map", "a", (10, 30)), *over("map", "b", (20,)), static("a", "c"), keep=None)
    browser = Browser(tree, live=False)
    for frame, stamps in ((None, [20, 30, 30, 20, 10, 10]), ("a", [30, 30, 30, 10, 10, 10])):
        found = []
        for forward in (True, True, True, False, False, False):
            browser.do("step", forward=forward, frame=frame)
            found.append(int(browser.said["time"]["at"]))
        assert found == stamps
    # A static frame has no samples of its own.
    assert browser.do("step", forward=True, frame="c").said["time"]["at"] == "20"


# The selection, trails, events


def test_a_selection_has_the_ellipsoid_of_its_error_if_an_edge_has_told_one() -> None:
    error = Covariance.of(xyz=(0.1, 0.2, 0.3))
    tree = tree_of(UncertainSample("map", "base", 0, Transform((1, 0, 0)), covariance=error), static("base", "lidar"))
    browser = Browser(tree)
    axes, turned = browser.do("select", frame="lidar").said["selection"]["ellipsoid"]
    assert (axes, turned) == (pytest.approx([0.2, 0.4, 0.6]), pytest.approx([0, 0, 0, 1]))
    assert browser.do("select", frame="map").said["selection"]["ellipsoid"] is None


def test_the_facts_of_a_selection_are_its_pose_and_the_edge_above_it() -> None:
    pose = Transform.from_xyz_rpy((1, -2, 0.5), (0, 0, math.pi / 2))
    browser = Browser(tree_of(TransformStamped("map", "base", SECOND, pose, "odometry"), static("base", "lidar", 2.0)))
    browser.page.delays = {"base": 0.25}
    browser.do("select", frame="base")
    browser.look(3 * SECOND, 1.0)
    assert browser.facts == {
        "frame": "base",
        "in": "map",
        "xyz": "1.000000 -2.000000 0.500000 m",
        "rpy": "0.000000 0.000000 90.000000 deg",
        "quaternion": "0.000000 0.000000 0.707107 0.707107 (x y z w)",
        "at": "1.000 s",
        "parent": "map",
        "rate": "one sample",
        "age": "2 s",
        "delay": "250 ms",
        "authority": "odometry",
    }
    chosen = browser.do("select", frame="lidar").said["selection"]
    assert (chosen["parent"], chosen["xyz"], chosen["chain"]) == ("base", [2.0, 0.0, 0.0], ["lidar", "base", "map"])
    assert browser.do("select", frame="map").facts["parent"] == "none, it is a root"
    assert browser.do("select", frame=None).facts == {}


def test_a_frame_without_a_pose_says_why_and_keeps_the_other_facts() -> None:
    browser = Browser(tree_of(*over("map", "a", (0, SECOND)), *over("map", "b", (0, 9)), static("zoo", "c"), keep=None))
    browser.do("select", frame="b").do("seek", ns=str(SECOND))
    assert "short" in browser.facts["pose"]
    assert browser.facts["parent"] == "map"
    assert "different trees" in browser.do("select", frame="c").facts["pose"]
    browser.page.tree.remove_frame("c")
    assert "not known" in browser.do("live").facts["pose"]


def test_a_trail_is_the_path_of_some_seconds_with_gaps_and_static_frames_have_none() -> None:
    browser = Browser(driven(), trails=["lidar"])
    assert browser.trails["lidar"][[0, -1], 0].tolist() == [1.0, 11.0]
    browser.do("trail", frame="base", on=True, seconds=4.0)
    assert browser.trails["base"][[0, -1], 0] == pytest.approx([6.0, 10.0])
    browser.do("seek", ns=str(2 * SECOND))
    gap = np.isnan(browser.trails["base"][:, 0])
    assert gap[0]
    assert browser.trails["base"][~gap][[0, -1], 0] == pytest.approx([0.0, 2.0], abs=0.02)
    browser.do("trail", frame="map", on=True)
    assert len(browser.trails["map"]) == 0
    assert list(browser.do("trail", frame="lidar", on=False).trails) == ["base", "map"]


def test_events_come_once_the_oldest_first_and_a_new_browser_gets_the_last_ones() -> None:
    browser = Browser(driven())
    for number in range(EVENTS_KEPT + 1):
        browser.page.note_event(FrameRemoved(number, f"f{number}"))
    assert [event["frame"] for event in browser.look().events] == [f"f{number + 1}" for number in range(EVENTS_KEPT)]
    browser.page.note_event(PeerLost(7 * SECOND, "local", "0123456789abcdef" * 2, ("a",), ()))
    assert browser.look().events[EVENTS_KEPT:] == [
        {
            "at": str(7 * SECOND),
            "kind": "PeerLost",
            "frame": None,
            "text": "peer 01234567 is lost on local, who spoke for 'a': 0 frames",
            "peer": "01234567",
        }
    ]
    late = Shown().take(Session(browser.page).picture(0, 0))
    assert late.events == browser.events[1:]


# Points


def test_points_with_a_stamp_stay_where_their_frame_was_and_others_move_with_it() -> None:
    tree = tree_of(*over("map", "base", (0, SECOND), speed=1e-9), static("map", "site", 1.0))
    browser = Browser(tree)
    cloud = np.array([[0.0, 1.0, 2.0], [np.nan, 0.0, 0.0], [3.0, 4.0, 5.0]])
    colours = np.array([[1, 1, 1], [2, 2, 2], [255, 3, 3]], np.uint8)
    clouds = browser.page.clouds
    clouds["never"] = Points(PointCloud("nobody", LATEST, cloud), 0.02, GREY)
    clouds["now"] = Points(PointCloud("base", LATEST, cloud), 0.02, GREY)
    clouds["then"] = Points(PointCloud("base", 0, cloud), 0.05, colours)
    browser.look()
    assert browser.points["then"].tolist() == cloud[[0, 2]].tolist()
    assert browser.said["points"] == {
        "name": "then",
        "size": 0.05,
        "count": 2,
        "colours": True,
        "bytes": colours[[0, 2]].tobytes(),
    }
    assert {name: browser.x.get(name) for name in clouds} == {"never": None, "now": 1.0, "then": 0.0}
    # The stamp leaves the history, so the points keep their last pose there, and have none in another fixed frame.
    tree.insert(moving("map", "base", 19 * SECOND, 2.0))
    browser.received.clear()
    assert {name: browser.look().x.get(name) for name in clouds} == {"never": None, "now": 2.0, "then": 0.0}
    assert browser.received == ["kind 1"]
    assert "then" not in browser.do("fixed", frame="site").x
    clouds["then"] = Points(PointCloud("base", 0, cloud), 0.05, colours)
    assert "then" not in browser.do("fixed", frame=None).x
    del clouds["now"]
    assert browser.look().said["clouds"]["names"] == ["never", "then"]


def test_of_many_clouds_the_newest_up_to_the_moment_is_shown_unless_it_is_old() -> None:
    browser = Browser(driven(), live=False)
    clouds = [PointCloud("base", at * SECOND, np.full((1, 3), float(at))) for at in (4, 2)]
    browser.page.clouds["scan"] = Film([Points(cloud, 0.02, GREY) for cloud in clouds], longest=1.0)
    for seconds, shown in ((1.9, None), (2.0, 2.0), (3.0, 2.0), (3.5, None), (4.5, 4.0)):
        browser.do("seek", ns=str(round(seconds * SECOND)))
        assert browser.x.get("scan") == shown
        assert shown is None or browser.points["scan"].tolist() == [[shown] * 3]


def test_a_recording_lasts_as_long_as_its_frames_and_its_clouds() -> None:
    page = Page(tree_of(static("map", "lidar", 1.0)), live=False)
    clouds = [PointCloud("lidar", at * SECOND, np.full((1, 3), float(at))) for at in (4, 9)]
    page.clouds["scan"] = Film([Points(cloud, 0.02, GREY) for cloud in clouds], longest=1.0)
    browser = Browser(page.tree, page=page)
    assert (browser.time, browser.points["scan"][0, 0]) == (("paused", 4.0), 4.0)
    assert browser.do("end").x == {"map": 0.0, "lidar": 1.0, "scan": 1.0}
    assert (browser.time, browser.points["scan"][0, 0]) == (("paused", 9.0), 9.0)


# Frames that are moved by hand


def test_a_frame_that_may_be_moved_is_told_by_its_pose_in_its_parent_and_followed_in_a_history() -> None:
    browser = Browser(driven(), edit=["lidar", "base", "gone"])
    assert browser.said["edited"] == {"type": "edited", "frame": "lidar", "xyz": [1.0, 0.0, 0.0], "xyzw": [0, 0, 0, 1]}
    browser.do("edit", frame="lidar", xyz=[2, 0, 0.5], xyzw=[0, 0, 0, 1])
    assert browser.wish == Edit("base", "lidar", Transform((2.0, 0.0, 0.5)))
    assert browser.do("save").wish == Save()
    browser.do("pause")
    browser.page.tree.insert(browser.page.edited()[0]._replace(transform=Transform((3.0, 0.0, 0.0))).sample(0, "view"))
    assert browser.look(0, 1.0).x["lidar"] == 13.0
    assert browser.said["edited"]["xyz"] == [3.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("values", "why"),
    [
        ({"frame": "base"}, "'base' is not static"),
        ({"frame": "gone"}, "'gone' is not static"),
        ({"frame": "map"}, "those that can: lidar, base, gone"),
        ({"frame": ["lidar"]}, "cannot be moved"),
        ({"xyz": [1, 2]}, "3 numbers"),
        ({"xyz": [1, 2, "3"]}, "3 numbers"),
        ({"xyz": [1, 2, True]}, "3 numbers"),
        ({"xyzw": [0, 0, 0, 0]}, "quaternion"),
        ({"xyzw": [0, 0, 0, 2]}, "quaternion"),
    ],
)
def test_only_static_frames_that_were_named_can_be_moved_and_only_to_a_pose(values: Any, why: str) -> None:
    browser = Browser(driven(), edit=["lidar", "base", "gone"])
    with pytest.raises(ValueError, match=why):
        browser.do("edit", **{"frame": "lidar", "xyz": [0, 0, 0], "xyzw": [0, 0, 0, 1], **values})


# Strangers


@pytest.mark.parametrize(
    ("order", "why"),
    [
        ('{"do": "fly"}', "one of fixed, select"),
        ('["do"]', "one of fixed"),
        ("{", "delimiter|property name"),
        ('{"do": "play", "speed": NaN}', "NaN is not a number"),
        ("[" * 50_000, "deeply"),
        ("x" * 70_000, "65,536"),
        (b"{}", "a text"),
        ('{"do": "play", "speed": 0}', "above 0"),
        ('{"do": "play", "speed": "fast"}', "above 0"),
        ('{"do": "seek", "ns": 5}', "text of digits"),
        ('{"do": "seek"}', "missing a required argument: 'ns'"),
        ('{"do": "live", "now": 1}', "unexpected keyword"),
        ('{"do": "select", "frame": "nobody"}', "no frame is called 'nobody'"),
        ('{"do": "select", "frame": {}}', "no frame is called"),
        ('{"do": "trail", "frame": "base", "on": 1}', "on or off"),
        ('{"do": "trail", "frame": "base", "on": true, "seconds": 1e9}', "3600"),
        ('{"do": "trail", "frame": null, "on": true}', "needs a frame"),
        ('{"do": "step", "forward": "yes"}', "forward or not"),
        ('{"do": "edit", "frame": "lidar", "xyz": [1e400, 0, 0], "xyzw": [0, 0, 0, 1]}', "finite"),
    ],
)
def test_an_order_that_is_none_is_an_error_that_says_why_and_changes_nothing(order: str | bytes, why: str) -> None:
    browser = Browser(driven(), edit=["lidar"])
    with pytest.raises((ValueError, TypeError), match=why):
        browser.session.do(browser.session.read(order))
    assert browser.look().time[0] == "live"


def test_the_number_of_trails_has_a_bound() -> None:
    browser = Browser(tree_of(*(static("map", f"f{k}") for k in range(MAX_TRAILS + 1))))
    for number in range(MAX_TRAILS):
        browser.do("trail", frame=f"f{number}", on=True)
    with pytest.raises(ValueError, match="remove one"):
        browser.do("trail", frame=f"f{MAX_TRAILS}", on=True)
    browser.do("trail", frame="f0", on=True, seconds=1.0)


def test_any_number_of_people_see_the_same_frames_whatever_else_they_do() -> None:
    page = Page(driven(), edit=["lidar"])
    draw = random.Random(1)
    browsers = [Session(page) for _ in range(3)]
    orders = [
        *('{"do": "pause"}', '{"do": "play"}', '{"do": "live"}', '{"do": "home"}', '{"do": "select", "frame": "base"}'),
        *('{"do": "fixed", "frame": "lidar"}', '{"do": "step", "forward": true}', '{"do": "seek", "ns": "3000000000"}'),
        *('{"do": "fixed", "frame": null}', '{"do": "trail", "frame": "base", "on": true}'),
    ]
    shown = [Shown() for _ in browsers]
    for turn in range(200):
        session = draw.choice(browsers)
        session.do(session.read(draw.choice(orders)))
        for each, browser in zip(shown, browsers, strict=True):
            each.take(browser.picture(10 * SECOND, turn * SECOND // 10))
            assert sorted(each.said["frames"]["names"]) == ["base", "lidar", "map"]
            assert each.x["lidar"] - each.x["base"] == pytest.approx(1.0)


json_values = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5) | st.sampled_from(["map", "lidar"]),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)
fields = st.dictionaries(
    st.sampled_from(["frame", "ns", "speed", "on", "seconds", "forward", "xyz", "xyzw", "do", "self"]), json_values
)


@given(
    st.lists(
        st.text(max_size=50).map(str.encode)
        | st.text(max_size=50)
        | st.builds(
            lambda name, rest: json.dumps({**rest, "do": name}),
            st.sampled_from(["fixed", "select", "trail", "play", "seek", "step", "edit", "save", "pause", "live"]),
            fields,
        ),
        max_size=8,
    )
)
def test_whatever_a_browser_sends_the_next_picture_is_whole(orders: list[str | bytes]) -> None:
    browser = Browser(driven(), edit=["lidar"])
    for order in orders:
        try:
            browser.session.do(browser.session.read(order))
        except (ValueError, TypeError, ArithmeticError):
            continue
        browser.look(0, 0.5)
    browser.do("live").do("fixed", frame=None)
    assert browser.x == {"map": 0.0, "base": 10.0, "lidar": 11.0}
