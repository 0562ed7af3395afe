import math
import socket
import sys
from types import FrameType
from typing import Any

import anyio
import httpx
import numpy as np
import pytest

pytest.importorskip("viser", reason="the live page needs viser")

from anyio.lowlevel import checkpoint
from support.processes import free_ports, on_one_loop
from support.samples import moving, over, static
from support.viser_pages import CLICK, Browser, PageClient, in_browser, on_page

from tfbus import (
    LATEST,
    SECOND,
    Buffer,
    Bus,
    BusClosedError,
    InvalidRobotError,
    InvalidTransformError,
    PointCloud,
    SimulatedClock,
    Transform,
    TransformBroadcaster,
    TransformStamped,
)
from tfbus.view import View

pytestmark = pytest.mark.anyio


class Shown:
    """A bus on a simulated clock, and a page of it."""

    def __init__(self, *batch: TransformStamped, start: int = 100 * SECOND) -> None:
        self.clock = SimulatedClock(start)
        self.bus = Bus(self.clock)
        self.buffer = Buffer(self.bus)
        self.bus.publish(batch)

    def page(self, rate: float = 1_000.0, **options: Any) -> View:
        return View(self.bus, self.buffer, 0, rate=rate, **options)

    def publish(self, *batch: TransformStamped) -> None:
        """Publish from the thread of a browser."""
        anyio.from_thread.run_sync(self.bus.publish, batch)


@pytest.fixture
def shown() -> Shown:
    return Shown()


# The life of a page


@pytest.mark.every_loop
async def test_a_page_is_served_on_the_loopback_until_the_end(shown: Shown, capfd: pytest.CaptureFixture[str]) -> None:
    async with View(shown.bus, shown.buffer, 0) as view:
        assert view.address.startswith("http://127.0.0.1:")
        assert view.viewers == 0
        async with httpx.AsyncClient(trust_env=False) as client:
            answer = await client.get(view.address)
        assert answer.status_code == 200
        port = int(view.address.rpartition(":")[2])
    assert (view.address, capfd.readouterr()) == ("", ("", ""))
    with socket.create_server(("127.0.0.1", port)):
        pass


async def test_a_port_that_is_taken_gives_way_to_the_next_one(shown: Shown) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        async with View(shown.bus, shown.buffer, port) as view:
            assert int(view.address.rpartition(":")[2]) > port


async def test_an_address_of_another_machine_is_an_error_at_once(shown: Shown) -> None:
    with pytest.raises(OSError, match="assign requested address"):
        async with View(shown.bus, shown.buffer, 0, host="192.0.2.1"):
            pytest.fail("entered")


async def test_an_error_in_the_body_comes_out_as_it_is_and_ends_the_page(shown: Shown) -> None:
    [port] = free_ports(1)
    with pytest.raises(ZeroDivisionError):
        async with View(shown.bus, shown.buffer, port):
            raise ZeroDivisionError
    with socket.create_server(("127.0.0.1", port)):
        pass


async def test_a_view_is_entered_once_and_not_on_a_closed_bus(shown: Shown) -> None:
    view = View(shown.bus, shown.buffer, 0)
    async with view:
        pass
    with pytest.raises(RuntimeError, match="once"):
        await view.__aenter__()
    shown.bus.close()
    with pytest.raises(BusClosedError):
        await View(shown.bus, shown.buffer, 0).__aenter__()


async def test_a_page_outlives_its_bus(shown: Shown) -> None:
    async with View(shown.bus, shown.buffer, 0) as view:
        shown.bus.close()
        async with httpx.AsyncClient(trust_env=False) as client:
            assert (await client.get(view.address)).status_code == 200


# The page in a browser, and its controls


async def test_what_happens_is_drawn_while_somebody_looks_and_nothing_listens_after_that(
    caplog: pytest.LogCaptureFixture,
) -> None:
    shown = Shown(static("map", "dock"))
    async with shown.page() as view:

        def steps(page: PageClient) -> None:
            page.wait("2 of 2 frames", "none so far")
            # Sent a second after its stamp.
            shown.publish(moving("map", "tool", 99 * SECOND, 2.0))
            page.wait("3 of 3 frames", "'tool' is new")
            anyio.from_thread.run(shown.clock.advance, 4.0)
            page.use("Frame", "tool", "2.000000 0.000000", '<td style="word-break: break-word">1 s</td>')
            assert "'dock' is new" not in page.texts
            # A picture that fails is told, and the next one is drawn.
            torn = PointCloud("map", LATEST, np.zeros((1, 3)))
            anyio.from_thread.run_sync(view.add_points, torn)
            page.wait_until(lambda: page.nodes["/points/1"]["visible"])
            object.__setattr__(torn, "frame", None)
            page.use("Mode", "Pause")
            while "could not be drawn" not in caplog.text:
                page.wait_until(lambda: True)
            anyio.from_thread.run_sync(view.remove_points)
            anyio.from_thread.run_sync(shown.bus.remove_frame, "tool")
            page.use("Mode", "Live", "2 of 2 frames", "'tool' was removed")
            assert [queue.kind for queue in shown.bus.statistics().queues] == ["events"]

        await on_page(view, steps)
        while view.viewers or shown.bus.statistics().queues:  # noqa: ASYNC110 - a browser that leaves sets no event
            await anyio.sleep(0.001)


async def test_no_turn_of_the_loop_does_the_work_of_a_page() -> None:
    shown = Shown(*(moving(f"f{k // 2}", f"f{k + 1}", 99 * SECOND) for k in range(300)))
    calls, most, ended = 0, 0, False

    def count(_frame: FrameType, kind: str, _what: object) -> None:
        nonlocal calls
        calls += kind == "call"

    async def watch() -> None:
        nonlocal calls, most
        while not ended:
            most, calls = max(most, calls), 0
            await checkpoint()

    def steps(page: PageClient) -> None:
        page.wait("301 of 301 frames")
        for _ in range(5):
            page.send(*(page.update("Mode", mode) for mode in ("Live", "Pause", "Play", "Live")))
            page.send(page.update("Search", "9"), page.update("Labels", "all"), page.update("Frame", "f9"))
            page.send(page.update("Step", "◀"), page.update("Trail on or off", True))
        page.use("Mode", "Pause", "paused at")

    async with shown.page() as view, anyio.create_task_group() as tasks:
        # It counts in this thread, that of the loop.
        sys.setprofile(count)
        try:
            tasks.start_soon(watch)
            await on_page(view, steps)
        finally:
            sys.setprofile(None)
            ended = True
    # The events of so many new frames take 900 calls, and a copy of the tree or its text 5,400.
    assert most < 2_000
    assert view.statistics().conflated > 0
    assert view.statistics().dropped == 0


async def test_a_click_or_a_search_selects_a_frame() -> None:
    shown = Shown(moving("map", "base", 100 * SECOND, 1.0, "odometry"), static("base", "lidar", 2.0))
    async with shown.page() as view:

        def steps(page: PageClient) -> None:
            page.wait_until(lambda: len(page.nodes["/axes"]["batched_positions"]) == 3)
            page.send(*(CLICK | {"instance_index": place} for place in (99, 2)))
            page.wait("3.000000 0.000000 0.000000 m", "lidar → base → map")
            page.wait_until(lambda: page.controls["Frame"]["value"] == "lidar")
            assert page.nodes["/chain"]["points"].reshape(-1, 2, 3)[:, :, 0].tolist() == [[3, 1], [1, 0]]
            page.use("Frame", "(none)", "Click on a frame")
            page.send(page.update("Search", "a"))
            page.wait_until(lambda: page.controls["Frame"]["options"] == ["(none)", "base", "lidar", "map"])
            page.use("Search", "BAS", "odometry")
            page.wait_until(lambda: page.controls["Frame"]["options"] == ["(none)", "base"])
            assert page.controls["Frame"]["value"] == "base"

        await on_page(view, steps)


async def test_axes_dots_and_lines_follow_the_frames() -> None:
    shown = Shown(moving("map", "base", 99 * SECOND, 1.0), static("base", "lidar", 2.0))
    async with shown.page() as view:

        def steps(page: PageClient) -> None:
            def at(*places: float) -> bool:
                scene, lines = page.nodes, page.nodes["/edges"]["points"].reshape(-1, 2, 3)[:, :, 0].tolist()
                x = [scene[name]["batched_positions"][:, 0].tolist() for name in ("/axes", "/origins")]
                return x == [list(places)] * 2 and lines == [
                    [places[1], 0.0],
                    *([end, places[1]] for end in places[2:]),
                ]

            page.wait_until(lambda: at(0.0, 1.0, 3.0))
            # A quarter of the mean of 1 m and 2 m.
            assert page.controls["Axes [m]"]["value"] == pytest.approx(0.38)
            assert page.camera["look_at"] == [1.5, 0.0, 0.0]
            shown.publish(moving("map", "base", 100 * SECOND, 5.0))
            page.wait_until(lambda: at(0.0, 5.0, 7.0))
            shown.publish(static("base", "arm", 1.0))
            page.wait_until(lambda: at(0.0, 5.0, 6.0, 7.0) or at(0.0, 5.0, 7.0, 6.0))
            assert len(page.nodes["/axes"]["batched_wxyzs"]) == len(page.nodes["/origins"]["batched_colors"]) == 4
            assert page.camera["look_at"] == [1.5, 0.0, 0.0]
            page.send(page.update("Axes [m]", 0.5))
            page.wait_until(lambda: page.nodes["/axes"]["axes_length"] == pytest.approx(0.5))
            vertices = page.nodes["/origins"]["vertices"].astype(np.float64)
            volume = np.linalg.det(vertices[page.nodes["/origins"]["faces"]]).sum() / 6.0
            # A regular icosahedron whose faces look outward.
            edge = 0.12 * 0.5 / math.sin(2.0 * math.pi / 5.0)
            assert volume == pytest.approx(5.0 / 12.0 * (3.0 + math.sqrt(5.0)) * edge**3, rel=1e-5)
            assert np.linalg.norm(vertices, axis=1) == pytest.approx(np.full(12, 0.06))

        await on_page(view, steps)


async def test_labels_follow_their_frames_and_hide_when_they_are_not_wanted() -> None:
    shown = Shown(moving("map", "base", 99 * SECOND, 1.0))
    async with shown.page() as view:

        def steps(page: PageClient) -> None:
            def labels() -> dict[str, float]:
                found = [page.nodes[f"/labels/{k}"] for k in range(2) if f"/labels/{k}" in page.nodes]
                return {each["text"]: each["position"][0] for each in found if each["visible"]}

            page.send(page.update("Labels", "all"))
            page.wait_until(lambda: labels() == {"map": 0.0, "base": 1.0})
            shown.publish(moving("map", "base", 100 * SECOND, 4.0))
            page.wait_until(lambda: labels() == {"map": 0.0, "base": 4.0})
            page.send(page.update("Frame", "map"), page.update("Labels", "selection"))
            page.wait_until(lambda: labels() == {"map": 0.0})
            page.send(page.update("Labels", "none"))
            page.wait_until(lambda: labels() == {})

        await on_page(view, steps)


async def test_the_controls_of_time_move_the_page() -> None:
    shown = Shown(*over("map", "base", range(90 * SECOND, 101 * SECOND, SECOND), speed=1e-9))
    async with shown.page(trails=["base"]) as view:

        def steps(page: PageClient) -> None:
            page.send(page.update("Speed", "× 0.1"))
            page.wait_until(lambda: len(page.nodes["/trails"]["points"]) > 100)
            page.wait("live")
            assert page.controls["Time [s]"]["disabled"]
            page.use("Mode", "Pause", "paused at 100.000 s, 10.000 s from the start")
            slider = page.controls["Time [s]"]
            page.wait_until(lambda: (slider["disabled"], slider["max"], slider["value"]) == (False, 10.0, 10.0))
            shown.publish(moving("map", "base", 120 * SECOND, 7.0))
            page.use("Step", "◀", "paused at 99.000 s")
            page.use("Step", "▶", "paused at 100.000 s")
            page.use("Time [s]", 2.5, "paused at 92.500 s")
            page.wait_until(lambda: page.nodes["/axes"]["batched_positions"][1, 0] == 92.5)
            page.use("Mode", "Play", "playing × 0.1 at")
            page.use("Time [s]", 3.0, "paused at 93.000 s")
            page.use("Mode", "Live", "live")
            page.wait_until(lambda: page.nodes["/axes"]["batched_positions"][1, 0] == 7.0)

        await on_page(view, steps)


async def test_the_fixed_frame_is_chosen_and_frames_that_are_gone_stay_chosen() -> None:
    none, largest = "(none)", "(root of the largest tree)"
    shown = Shown(static("map", "base", 1.0), static("map", none), static("map", largest))
    async with shown.page() as view:

        def steps(page: PageClient) -> None:
            page.use("Fixed frame", "base", "connected with 'base'")
            page.use("Frame", "base", "0.000000 0.000000 0.000000 m")
            # A frame with the name of a choice is offered once.
            options = [page.controls[label]["options"] for label in ("Fixed frame", "Frame")]
            assert [len(each) for each in options] == [len(set(each)) for each in options]
            anyio.from_thread.run_sync(shown.bus.remove_frame, "base")
            page.wait("'base' is not known: choose another one")
            page.wait_until(lambda: "base" not in page.controls["Frame"]["options"][1:-1])
            assert [page.controls[label]["value"] for label in ("Fixed frame", "Frame")] == ["base", "base"]
            page.use("Fixed frame", largest, "connected with 'map'")

        await on_page(view, steps)


async def test_points_with_a_stamp_stay_where_their_frame_was_and_others_move_with_it() -> None:
    shown = Shown(moving("map", "base", 99 * SECOND, 1.0), static("map", "site", 1.0))
    cloud = np.array([[0.0, 1.0, 2.0], [np.nan, 0.0, 0.0], [3.0, 4.0, 5.0]])
    colours = np.array([[1, 1, 1], [2, 2, 2], [300, 3, 3]])
    async with shown.page() as view:
        view.add_points(PointCloud("base", 99 * SECOND, cloud), "then", colour=colours)
        view.add_points(PointCloud("base", LATEST, cloud), "now")
        view.add_points(PointCloud("nobody", LATEST, cloud), "never")

        def steps(page: PageClient) -> None:
            def at(*places: float | None) -> bool:
                found = [page.nodes[name] for name in sorted(page.nodes) if name.startswith("/points/")]
                return [each["position"][0] if each["visible"] else None for each in found] == list(places)

            page.wait_until(lambda: at(1.0, 1.0, None))
            then = page.nodes["/points/1"]
            assert (then["points"].tolist(), then["colors"].tolist()) == (
                cloud[[0, 2]].tolist(),
                [[1] * 3, [255, 3, 3]],
            )
            # The stamp leaves the history.
            shown.publish(moving("map", "base", 119 * SECOND, 2.0))
            page.wait_until(lambda: at(1.0, 2.0, None))
            page.send(page.update("Fixed frame", "site"))
            page.wait_until(lambda: at(None, 1.0, None))
            anyio.from_thread.run_sync(view.remove_points, "now")
            page.wait_until(lambda: at(None, None))

        await on_page(view, steps)


ROBOT = """<robot name="r"><link name="base"><visual><origin xyz="0 0 0.5"/><geometry><box size="1 2 3"/></geometry>
<material name="red"><color rgba="1 0 0 1"/></material></visual></link><link name="tool"><visual><geometry>
<sphere radius="0.5"/></geometry></visual><visual><origin xyz="1 0 0"/><geometry><box size="0.1 0.1 0.1"/></geometry>
</visual></link></robot>"""


async def test_the_shapes_of_a_robot_are_drawn_at_their_links_one_object_for_equal_triangles() -> None:
    turned = Transform((0.0, 0.0, 0.0), (2 / 9, 4 / 9, 5 / 9, 6 / 9))
    shown = Shown(static("map", "base", 2.0), TransformStamped("base", "tool", 0, turned, static=True))
    async with shown.page(urdf=ROBOT) as view:

        def steps(page: PageClient) -> None:
            page.wait_until(lambda: {"/robot/0", "/robot/1"} <= page.nodes.keys())
            boxes, spheres = page.nodes["/robot/0"], page.nodes["/robot/1"]
            # The box of the tool is 1 m along x of the tool: the first column of the matrix of (2, 4, 5, 6) / 9.
            x, y, z = 1 - 2 * (4 * 4 + 5 * 5) / 81, 2 * (2 * 4 + 5 * 6) / 81, 2 * (2 * 5 - 4 * 6) / 81
            positions = np.array([[2.0, 0.0, 0.5], [2.0 + x, y, z]])
            assert boxes["batched_positions"] == pytest.approx(positions, abs=1e-6)
            assert boxes["batched_wxyzs"][1] == pytest.approx([6 / 9, 2 / 9, 4 / 9, 5 / 9])
            assert boxes["batched_scales"] == pytest.approx(np.array([[1.0, 2.0, 3.0], [0.1, 0.1, 0.1]]))
            assert boxes["batched_colors"].tolist()[0] == [255, 0, 0]
            assert spheres["batched_positions"].tolist() == [[2.0, 0.0, 0.0]]
            shown.publish(static("map", "base", 3.0))
            page.wait_until(lambda: spheres["batched_positions"].tolist() == [[3.0, 0.0, 0.0]])
            page.send(page.update("Robot", 0.25))
            page.wait_until(lambda: boxes["opacity"] == spheres["opacity"] == 0.25)
            anyio.from_thread.run_sync(shown.bus.remove_frame, "tool")
            page.wait_until(
                lambda: "/robot/1" not in page.nodes and len(page.nodes["/robot/0"]["batched_positions"]) == 1
            )
            page.send(page.update("Robot", 0.0))
            page.wait_until(lambda: "/robot/0" not in page.nodes)

        await on_page(view, steps)


async def test_several_browsers_show_the_same_page() -> None:
    async with Shown(static("map", "base", 1.0), static("base", "lidar", 1.0)).page() as view:

        def steps(page: PageClient) -> None:
            page.use("Search", "lid", "lidar → base → map")
            with PageClient(view.address) as other:
                other.wait("lidar → base → map", "2.000000 0.000000")
                other.use("Frame", "(none)", "Click on a frame")
                page.wait("Click on a frame")
                assert view.viewers == 2

        await on_page(view, steps)


async def test_a_recording_offers_no_live_data() -> None:
    async with Shown(static("map", "base")).page(live=False) as view:
        await on_page(view, lambda page: page.wait_until(lambda: page.controls["Mode"]["options"] == ["Pause", "Play"]))


# Strangers


@pytest.mark.every_loop
async def test_what_pages_send_cannot_end_the_program(caplog: pytest.LogCaptureFixture) -> None:
    shown = Shown(static("map", "dock"), *over("map", "base", [99 * SECOND, 100 * SECOND]))
    async with shown.page() as view:

        def steps(page: PageClient) -> None:
            for label, *values in (
                ("Speed", "no option", "× 1000", math.nan),
                ("Mode", "no option", "Stop", True),
                ("Time [s]", math.nan, math.inf, -1e300, "now"),
                ("Fixed frame", "nowhere", 1),
            ):
                page.send(*(page.update(label, value) for value in values))
            page.use("Mode", "Pause", "paused at", "connected with 'map'")
            page.use("Mode", "Play", "playing × 1 ")
            assert view.refused == 12

        await on_page(view, steps)
    assert [record for record in caplog.records if record.levelname == "ERROR"] == []


async def test_the_origins_that_may_use_the_page_are_named(shown: Shown, caplog: pytest.LogCaptureFixture) -> None:
    async with View(shown.bus, shown.buffer, 0, origins=["http://robot.example"]) as view:
        for host, status in (("robot.example", 200), ("evil.example", 403)):
            async with httpx.AsyncClient(trust_env=False) as client:
                assert (await client.get(view.address, headers={"Host": host})).status_code == status
        assert view.refused == 1

        def steps(page: PageClient) -> None:
            with PageClient(view.address, "http://robot.example") as other:
                other.wait_until(lambda: other.nodes.keys() >= page.nodes.keys())

        await on_page(view, steps)
    assert "evil.example" in caplog.text


# Arguments


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        ({"port": 65_536}, ValueError),
        ({"origins": ["robot"]}, ValueError),
        ({"origins": "http://robot"}, TypeError),
        ({"port": 80.0}, TypeError),
        ({"rate": 0.0}, ValueError),
        ({"rate": math.nan}, ValueError),
        ({"rate": "fast"}, TypeError),
        ({"stale_after": -1.0}, ValueError),
        ({"fixed": "/map"}, InvalidTransformError),
        ({"trails": [""]}, InvalidTransformError),
        ({"trails": "base"}, TypeError),
    ],
)
def test_invalid_arguments_are_refused_at_once(arguments: dict[str, object], error: type[Exception]) -> None:
    shown = Shown()
    with pytest.raises(error):
        View(shown.bus, shown.buffer, **arguments)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("cloud", "rest", "error"),
    [
        ("points", {}, TypeError),
        (np.zeros((2, 3)), {}, TypeError),
        (PointCloud("map", LATEST, np.zeros((2, 3))), {"size": 0.0}, ValueError),
        (PointCloud("map", LATEST, np.zeros((2, 3))), {"size": "big"}, TypeError),
        (PointCloud("map", LATEST, np.zeros((2, 3))), {"colour": (1, 2)}, ValueError),
        (PointCloud("map", LATEST, np.zeros((2, 3))), {"colour": np.zeros((3, 3), int)}, ValueError),
        (PointCloud("map", LATEST, np.zeros((2, 3))), {"colour": (0.5, 0.5, 0.5)}, TypeError),
    ],
)
def test_invalid_points_are_refused_at_once(cloud: object, rest: dict[str, object], error: type[Exception]) -> None:
    shown = Shown()
    view = View(shown.bus, shown.buffer)
    with pytest.raises(error):
        view.add_points(cloud, **rest)  # type: ignore[arg-type]
    with pytest.raises(KeyError):
        view.remove_points()


@pytest.mark.parametrize(("urdf", "error"), [("<robot", InvalidRobotError), ("nowhere.urdf", FileNotFoundError)])
async def test_a_robot_that_cannot_be_read_is_an_error_on_entering(urdf: str, error: type[Exception]) -> None:
    shown = Shown()
    with pytest.raises(error):
        async with View(shown.bus, shown.buffer, 0, urdf=urdf):
            pytest.fail("entered")


# In a real browser

look = pytest.mark.thorough


@look
@on_one_loop
async def test_a_moving_frame_moves_and_a_click_shows_where_it_is(shown: Shown) -> None:
    # The camera looks at the middle, x = 5, where the tool is not at first.
    shown.bus.publish([static("map", "left", -20.0), static("map", "right", 30.0)])
    tf = TransformBroadcaster(shown.bus, "arm")
    tf.send("map", "tool", Transform((25.0, 0.0, 0.0)))
    async with View(shown.bus, shown.buffer, 0, fixed="left") as view:

        def move() -> None:
            shown.clock.set(101 * SECOND)
            tf.send("right", "tool", Transform.from_xyz_rpy((-25.0, 0.0, 0.0), (0.0, 0.0, math.pi / 6)))

        def steps(browser: Browser) -> None:
            browser.open(view.address)
            browser.page.wait_for_timeout(1_000)
            browser.click_in_the_middle()
            anyio.from_thread.run_sync(move)
            browser.wait_for("moves from 'map' to 'right'")
            assert browser.facts() == {}
            browser.page.wait_for_timeout(1_000)
            browser.click_in_the_middle()
            facts = browser.wait_for_fact("frame", "tool")
            assert numbers(facts["xyz"]) == pytest.approx([25.0, 0.0, 0.0], abs=1e-6)
            assert numbers(facts["rpy"]) == pytest.approx([0.0, 0.0, 30.0], abs=1e-6)
            expected = shown.buffer.lookup_nowait("left", "tool").transform.rotation
            assert numbers(facts["quaternion"]) == pytest.approx(expected, abs=1e-6)
            assert (facts["in"], facts["parent"], facts["authority"]) == ("left", "right", "arm")
            assert facts["chain"] == "tool → right → map → left"
            assert all(request.startswith((view.address, "data:", "blob:")) for request in browser.requests)

        await in_browser(steps)


@look
@on_one_loop
async def test_names_of_frames_are_texts_and_never_elements(shown: Shown) -> None:
    evil = "<img src=x onerror=document.title='owned'>"
    shown.bus.publish([static(evil, f"{evil}{{1+1}}", 1.0), static(evil, "**b**", 2.0)])
    async with View(shown.bus, shown.buffer, 0) as view:
        view.add_points(PointCloud("**b**", LATEST, np.zeros((3, 3))), name=evil)

        def steps(browser: Browser) -> None:
            browser.open(view.address)
            browser.enter("Search", "{1+1}")
            assert browser.wait_for_fact("frame", "1")["frame"] == f"{evil}{{1+1}}"
            assert browser.page.title() != "owned"
            assert browser.page.locator("img[src=x]").count() == 0

        await in_browser(steps)


def numbers(text: str) -> list[float]:
    """The numbers at the beginning of a text."""
    found = []
    for word in text.split():
        try:
            found.append(float(word))
        except ValueError:
            break
    return found
