import math
import socket
from queue import Queue
from typing import Any

import anyio
import httpx
import numpy as np
import pytest

pytest.importorskip("viser", reason="the live page needs viser")

import msgspec
import viser
from support.browsers import Browser, in_browser
from support.processes import free_ports
from support.samples import moving, over, static
from support.viser_pages import CAMERA
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from tfbus import (
    LATEST,
    SECOND,
    Buffer,
    Bus,
    BusClosedError,
    FrameAdded,
    InvalidRobotError,
    InvalidTransformError,
    PointCloud,
    SimulatedClock,
    Transform,
    TransformBroadcaster,
    TransformTree,
)
from tfbus.view import View
from tfbus.view.screen import Screen, Sight

pytestmark = pytest.mark.anyio


class Shown:
    """A bus on a simulated clock, and a page of it."""

    def __init__(self, start: int = 100 * SECOND) -> None:
        self.clock = SimulatedClock(start)
        self.bus = Bus(self.clock)
        self.buffer = Buffer(self.bus)


# The life of a page


@pytest.mark.every_loop
async def test_a_page_is_served_on_the_loopback_until_the_end() -> None:
    shown = Shown()
    async with View(shown.bus, shown.buffer, 0) as view:
        assert view.address.startswith("http://127.0.0.1:")
        assert view.viewers == 0
        async with httpx.AsyncClient(trust_env=False) as client:
            answer = await client.get(view.address)
        assert answer.status_code == 200
        port = int(view.address.rpartition(":")[2])
    assert view.address == ""
    with socket.create_server(("127.0.0.1", port)):
        pass


async def test_it_prints_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    shown = Shown()
    async with View(shown.bus, shown.buffer, 0):
        pass
    assert capfd.readouterr() == ("", "")


async def test_a_port_that_is_taken_gives_way_to_the_next_one() -> None:
    shown = Shown()
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        async with View(shown.bus, shown.buffer, port) as view:
            assert int(view.address.rpartition(":")[2]) > port


async def test_an_address_of_another_machine_is_an_error_at_once() -> None:
    shown = Shown()
    with pytest.raises(OSError, match="assign requested address"):
        async with View(shown.bus, shown.buffer, 0, host="192.0.2.1"):
            pytest.fail("entered")


async def test_an_error_in_the_body_comes_out_as_it_is_and_ends_the_page() -> None:
    shown = Shown()
    [port] = free_ports(1)
    with pytest.raises(ZeroDivisionError):
        async with View(shown.bus, shown.buffer, port):
            raise ZeroDivisionError
    with socket.create_server(("127.0.0.1", port)):
        pass


async def test_a_view_is_entered_once_and_not_on_a_closed_bus() -> None:
    shown = Shown()
    view = View(shown.bus, shown.buffer, 0)
    async with view:
        pass
    with pytest.raises(RuntimeError, match="once"):
        await view.__aenter__()
    shown.bus.close()
    with pytest.raises(BusClosedError):
        await View(shown.bus, shown.buffer, 0).__aenter__()


async def test_a_page_outlives_its_bus() -> None:
    shown = Shown()
    async with View(shown.bus, shown.buffer, 0) as view:
        shown.bus.close()
        async with httpx.AsyncClient(trust_env=False) as client:
            assert (await client.get(view.address)).status_code == 200


async def test_a_page_that_nobody_looks_at_listens_to_nothing() -> None:
    shown = Shown()
    async with View(shown.bus, shown.buffer, 0):
        before = len(shown.bus._subscribers.callbacks)
        await anyio.wait_all_tasks_blocked()
        assert (before, len(shown.bus._subscribers.callbacks)) == (0, 0)
        assert [queue for queue in shown.bus.statistics().queues if queue.kind == "events"] == []


async def test_what_happens_is_drawn_while_somebody_looks(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    shown, viewers, sights = Shown(), 1, Queue[Sight]()
    draw = Screen.show

    def show(screen: Screen, sight: Sight) -> None:
        draw(screen, sight)
        sights.put(sight)

    async def next_sight_with(frames: set[str]) -> Sight:
        while True:
            sight = await anyio.to_thread.run_sync(sights.get)
            if set(sight.picture.scene.frames) == frames:
                return sight

    monkeypatch.setattr(Screen, "show", show)
    monkeypatch.setattr(View, "viewers", property(lambda _: viewers))
    shown.bus.publish(static("map", "dock"))
    async with View(shown.bus, shown.buffer, 0, rate=1_000.0) as view:
        await next_sight_with({"map", "dock"})
        # Sent a second after its stamp.
        shown.bus.publish(moving("map", "tool", 99 * SECOND, 2.0))
        await next_sight_with({"map", "dock", "tool"})
        assert view._page.delays == {"tool": 1.0}
        assert [type(event) for event in view._page._events] == [FrameAdded]
        # A picture that fails is told, and the next one is drawn.
        monkeypatch.setattr(view._page, "picture", lambda _: 1 / 0)
        view.add_points(PointCloud("map", LATEST, np.zeros((1, 3))))
        assert list(view._screen._points) == ["points"]
        while "could not be drawn" not in caplog.text:  # noqa: ASYNC110 - a log line sets no event
            await anyio.sleep(0.001)
        monkeypatch.delattr(view._page, "picture")
        shown.bus.remove_frame("tool")
        await next_sight_with({"map", "dock"})
        assert view._page.delays == {}
        viewers = 0
        view.remove_points()
        # Until nothing listens any more.
        while shown.bus._subscribers.callbacks or shown.bus.statistics().queues:  # noqa: ASYNC110
            await anyio.sleep(0.001)


@pytest.mark.every_loop
async def test_what_pages_send_cannot_end_the_program(caplog: pytest.LogCaptureFixture) -> None:
    shown = Shown()
    shown.bus.publish([static("map", "dock"), *over("map", "base", [99 * SECOND, 100 * SECOND])])

    def use(address: str) -> None:
        with connect(
            address.replace("http", "ws"),
            subprotocols=[Subprotocol(f"viser-v{viser.__version__}")],
            proxy=None,
            max_queue=None,
        ) as client:
            client.send(msgspec.msgpack.encode(CAMERA))
            for label, *values in (
                ("Speed", "no option", "× 1000", math.nan),
                ("Mode", "no option", "Stop", True),
                ("Time [s]", math.nan, math.inf, -1e300, "now"),
                ("Fixed frame", "nowhere", 1),
                ("Mode", "Pause"),
            ):
                control = next(each for each in controls() if each.label == label)
                for value in values:
                    message = {"type": "GuiUpdateMessage", "uuid": control._impl.uuid, "updates": {"value": value}}
                    client.send(msgspec.msgpack.encode(message))
            assert client.ping().wait(30.0)

    async with View(shown.bus, shown.buffer, 0) as view:
        assert view._server is not None
        handles = view._server.gui._gui_input_handle_from_uuid

        def controls() -> list[Any]:
            return list(handles.values())

        await anyio.to_thread.run_sync(use, view.address)
        with anyio.fail_after(30.0):
            # The last one is sound.
            while view._page.timeline.stamp is None:  # noqa: ASYNC110 - a control sets no event
                await anyio.sleep(0.01)
        assert (view._page.timeline.speed, view._page.chosen_fixed) == (1.0, None)
        assert view.refused == 12
    assert [record for record in caplog.records if record.levelname == "ERROR"] == []


async def test_the_origins_that_may_use_the_page_are_named(caplog: pytest.LogCaptureFixture) -> None:
    shown = Shown()
    async with View(shown.bus, shown.buffer, 0, origins=["http://robot.example"]) as view:
        for host, status in (("robot.example", 200), ("evil.example", 403)):
            async with httpx.AsyncClient(trust_env=False) as client:
                assert (await client.get(view.address, headers={"Host": host})).status_code == status
        assert view.refused == 1
    assert "evil.example" in caplog.text


# Arguments


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        ({"port": -1}, ValueError),
        ({"port": 65_536}, ValueError),
        ({"origins": ["robot"]}, ValueError),
        ({"origins": "http://robot"}, TypeError),
        ({"port": 80.0}, TypeError),
        ({"port": True}, TypeError),
        ({"rate": 0.0}, ValueError),
        ({"rate": math.nan}, ValueError),
        ({"rate": math.inf}, ValueError),
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
on_one_loop = pytest.mark.parametrize("anyio_backend", [("asyncio", {})], ids=["asyncio"])


@look
async def test_a_moving_frame_moves_and_a_click_shows_where_it_is() -> None:
    shown = Shown()
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
async def test_a_chosen_stamp_is_shown_and_stays_after_it_has_left_the_history() -> None:
    shown = Shown(start=10 * SECOND)
    shown.bus.publish(over("map", "base", range(0, 11 * SECOND, SECOND), speed=1e-9))
    async with View(shown.bus, shown.buffer, 0) as view:

        def pass_time() -> None:
            shown.clock.set(100 * SECOND)
            shown.bus.publish(moving("map", "base", 100 * SECOND, 100.0))

        def steps(browser: Browser) -> None:
            browser.open(view.address)
            browser.enter("Search", "base")
            browser.wait_for_fact("at", r"10\.000 s")
            browser.press("Pause")
            browser.wait_for("paused at 10.000 s")
            anyio.from_thread.run_sync(pass_time)
            browser.enter("Time [s]", "3.25")
            facts = browser.wait_for_fact("at", r"3\.250 s")
            assert numbers(facts["xyz"]) == pytest.approx([3.25, 0.0, 0.0], abs=1e-6)
            browser.press("◀")
            browser.wait_for_fact("at", r"3\.000 s")
            browser.press("▶")
            assert numbers(browser.wait_for_fact("at", r"4\.000 s")["xyz"])[0] == 4.0
            browser.press("Live")
            assert numbers(browser.wait_for_fact("at", r"100\.000 s")["xyz"])[0] == 100.0

        await in_browser(steps)


@look
@on_one_loop
async def test_stale_lost_and_new_frames_are_seen() -> None:
    shown = Shown()
    shown.bus.publish([moving("map", "base", 100 * SECOND, authority="odometry"), static("base", "lidar")])
    async with View(shown.bus, shown.buffer, 0) as view:
        advance = shown.clock.advance

        def steps(browser: Browser) -> None:
            green, vermilion = "rgb(0, 158, 115)", "rgb(213, 94, 0)"
            browser.open(view.address)
            base = browser.page.locator("pre span", has_text="base")
            browser.page.wait_for_function(COLOUR_OF, arg=["base", green])
            anyio.from_thread.run(advance, 3.0)
            browser.wait_for("'base' is stale, its newest sample from 'odometry' is 1 s old")
            browser.page.wait_for_function(COLOUR_OF, arg=["base", vermilion])
            anyio.from_thread.run_sync(shown.bus.publish, moving("map", "arm", 103 * SECOND, authority="a"))
            browser.wait_for("moving frame 'arm' is new under 'map'")
            anyio.from_thread.run_sync(shown.bus.publish, moving("map", "arm", 103 * SECOND, authority="b"))
            browser.wait_for("comes from two authorities, 'b' and 'a'")
            anyio.from_thread.run_sync(shown.bus.remove_frame, "base")
            browser.wait_for("frame 'base' was removed")
            base.wait_for()
            # Its child stays, as a tree of two frames beside that of the map.
            browser.wait_for("2 of 4 frames are connected")

        await in_browser(steps)


@look
@on_one_loop
async def test_a_recording_plays_to_its_end() -> None:
    tree = TransformTree(keep=None)
    tree.insert_many(over("map", "base", range(0, 3 * SECOND, SECOND // 10), speed=1e-9))
    with Bus() as bus, Buffer(bus, keep=None, prefill=tree) as buffer:
        async with View(bus, buffer, 0, live=False, trails=["base"]) as view:

            def steps(browser: Browser) -> None:
                browser.open(view.address)
                browser.enter("Search", "bas")
                assert numbers(browser.wait_for_fact("at", r"0\.000 s")["xyz"])[0] == 0.0
                browser.press("Play")
                browser.wait_for("playing × 1 at")
                browser.wait_for("paused at 2.900 s, 2.900 s from the start")
                assert numbers(browser.wait_for_fact("at", r"2\.900 s")["xyz"])[0] == pytest.approx(2.9)

            await in_browser(steps)


@look
@on_one_loop
async def test_several_browsers_show_the_same_page_and_when_they_leave_nothing_listens() -> None:
    shown = Shown()
    shown.bus.publish([static("map", "base", 1.0), static("base", "lidar", 1.0)])
    async with View(shown.bus, shown.buffer, 0) as view, anyio.create_task_group() as tasks:
        selected, seen = anyio.Event(), anyio.Event()

        def first(browser: Browser) -> None:
            browser.open(view.address)
            browser.enter("Search", "lid")
            browser.wait_for_fact("frame", "lidar")
            anyio.from_thread.run_sync(selected.set)
            anyio.from_thread.run(seen.wait)

        def second(browser: Browser) -> None:
            anyio.from_thread.run(selected.wait)
            browser.open(view.address)
            assert browser.wait_for_fact("frame", "lidar")["xyz"].startswith("2.000000 0.000000")
            assert view.viewers == 2
            anyio.from_thread.run_sync(seen.set)

        tasks.start_soon(in_browser, first)
        await in_browser(second)


@look
@on_one_loop
async def test_names_of_frames_are_texts_and_never_elements() -> None:
    evil = "<img src=x onerror=document.title='owned'>"
    shown = Shown()
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


COLOUR_OF = """([name, colour]) => [...document.querySelectorAll("pre span")].some(
    each => each.textContent === name && getComputedStyle(each).color === colour)"""


def numbers(text: str) -> list[float]:
    """The numbers at the beginning of a text."""
    found = []
    for word in text.split():
        try:
            found.append(float(word))
        except ValueError:
            break
    return found
