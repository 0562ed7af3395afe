import json
import math
import socket
import sys
from pathlib import Path
from types import FrameType
from typing import Any

import anyio
import httpx
import numpy as np
import pytest

pytest.importorskip("trimesh", reason="the live page needs trimesh")
pytest.importorskip("wsproto", reason="the live page needs wsproto")

from anyio.lowlevel import checkpoint
from hypothesis import given
from hypothesis import strategies as st
from support.processes import free_ports, new_domain, on_one_loop, until
from support.samples import moving, static
from support.shown_pages import PageClient
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus
from websockets.typing import Origin

import tfbus
from tfbus import (
    LATEST,
    SECOND,
    AuthorityConflict,
    Buffer,
    Bus,
    BusClosedError,
    InvalidRobotError,
    InvalidTransformError,
    LocalLink,
    PointCloud,
    SimulatedClock,
    Transform,
    TransformStamped,
    load_static,
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


# The page in its browsers


@pytest.mark.every_loop
async def test_what_happens_is_drawn_while_somebody_looks_and_nothing_listens_or_runs_after_that(
    caplog: pytest.LogCaptureFixture,
) -> None:
    shown = Shown(static("map", "dock"))
    async with shown.page() as view, PageClient.open(view.address) as page:
        await page.until(lambda: page.x == {"map": 0.0, "dock": 0.0} and shown.bus.statistics().queues)
        assert view.viewers == 1
        # Sent a second after its stamp.
        shown.bus.publish(moving("map", "tool", 99 * SECOND, 2.0))
        await page.until(lambda: page.x["tool"] == 2.0 and page.events)
        assert [(event["kind"], event["frame"]) for event in page.events] == [("FrameAdded", "tool")]
        await page.do("select", frame="tool")
        await page.until(lambda: page.said["selection"]["facts"]["delay"] == "1 s")
        # A picture that fails is told, and the next one is drawn.
        torn = PointCloud("map", LATEST, np.zeros((1, 3)))
        view.add_points(torn)
        await page.until(lambda: "points" in page.x)
        object.__setattr__(torn, "frame", None)
        view.add_points(PointCloud("map", LATEST, np.zeros((1, 3))), "other")
        await until(lambda: "could not be drawn" in caplog.text)
        view.remove_points()
        shown.bus.remove_frame("tool")
        await page.until(lambda: page.x == {"map": 0.0, "dock": 0.0, "other": 0.0})
        await page.socket.close()
        await until(lambda: not view.viewers and not shown.bus.statistics().queues)
        with anyio.fail_after(30.0):
            await anyio.wait_all_tasks_blocked()


async def test_each_browser_has_a_selection_a_time_and_a_fixed_frame_of_its_own() -> None:
    shown = Shown(*(moving("map", "base", stamp * SECOND, float(stamp)) for stamp in range(91, 101)))
    async with shown.page() as view, PageClient.open(view.address) as one, PageClient.open(view.address) as other:
        await one.do("select", frame="base")
        await one.do("seek", ns=str(95 * SECOND))
        await one.do("fixed", frame="base")
        await one.until(lambda: one.x == {"base": 0.0, "map": -95.0} and one.said["time"]["mode"] == "paused")
        shown.bus.publish(moving("map", "base", 101 * SECOND, 7.0))
        await other.until(lambda: other.x == {"map": 0.0, "base": 7.0})
        assert (other.said["selection"]["frame"], other.said["time"]["mode"]) == (None, "live")
        assert view.viewers == 2
        await one.do("fly")
        await one.until(lambda: "one of fixed" in one.said["error"]["text"])
        assert ("error" in other.said, view.refused) == (False, 1)


ROBOT = """<robot name="r"><link name="base"><visual><origin xyz="0 0 0.5"/><geometry><box size="1 2 3"/></geometry>
<material name="red"><color rgba="1 0 0 0.5"/></material></visual></link><link name="tool"><visual><geometry>
<sphere radius="0.5"/></geometry></visual><visual><origin xyz="1 0 0"/><geometry><box size="0.1 0.1 0.1"/></geometry>
</visual></link></robot>"""


async def test_the_shapes_of_a_robot_are_sent_once_with_one_mesh_for_equal_triangles() -> None:
    async with Shown(static("map", "base")).page(urdf=ROBOT) as view, PageClient.open(view.address) as page:
        await page.until(lambda: page.x)
        assert page.said["hello"]["robot"] is True
        placed = [(solid["mesh"], solid["link"], solid["xyz"], solid["scale"]) for solid in page.solids]
        assert placed == [
            (0, "base", [0.0, 0.0, 0.5], [1.0, 2.0, 3.0]),
            (1, "tool", [0.0, 0.0, 0.0], [0.5, 0.5, 0.5]),
            (0, "tool", [1.0, 0.0, 0.0], [0.1, 0.1, 0.1]),
        ]
        assert (page.solids[0]["colour"], page.solids[0]["opacity"]) == ([255, 0, 0], 0.5)
        (vertices, faces), _ = page.meshes
        # The volume by the divergence theorem.
        assert np.linalg.det(vertices[faces].astype(float)).sum() / 6.0 == pytest.approx(1.0)
        assert page.received.count("kind 4") == 1


async def test_a_frame_is_moved_for_the_whole_domain_and_saved_to_the_file_that_the_program_names(
    tmp_path: Path,
) -> None:
    domain, file = new_domain(), tmp_path / "moved.yaml"
    shown = Shown(static("base", "camera", 1.0, authority="robot"), static("base", "lidar", 2.0))
    with Bus() as other, Buffer(other) as seen:
        async with (
            LocalLink(shown.bus, domain) as link,
            LocalLink(other, domain),
            shown.page(edit=["camera"], save=file) as view,
            PageClient.open(view.address) as page,
        ):
            await page.until(lambda: page.said["hello"]["hears"] == "1 peer")
            assert page.said["hello"]["where"] == f"domain {domain!r}"
            assert page.said["hello"]["edit"] == ["camera"]
            await page.until(lambda: page.said["edited"]["xyz"] == [1.0, 0.0, 0.0])
            await page.do("edit", frame="lidar", xyz=[9, 9, 9], xyzw=[0, 0, 0, 1])
            await page.until(lambda: "those that can: camera" in page.said["error"]["text"])
            await page.do("edit", frame="camera", xyz=[1e13, 0, 0], xyzw=[0, 0, 0, 1])
            await page.until(lambda: "1e+13" in page.said["error"]["text"])
            await page.do("edit", frame="camera", xyz=[1, 2, 3], xyzw=[0, 0, 0.6, 0.8])
            await page.until(lambda: page.said["edited"]["xyz"] == [1.0, 2.0, 3.0])
            assert page.said["edited"]["xyzw"] == [0.0, 0.0, 0.6, 0.8]
            await until(
                lambda: (
                    "camera" in seen.tree
                    and seen.lookup_nowait("base", "camera").transform.translation == (1.0, 2.0, 3.0)
                )
            )
            assert {edge.child: edge.authority for edge in seen.tree.edges()} == {"camera": "view", "lidar": ""}
            await page.do("save")
            await page.until(
                lambda: (page.said["saved"]["path"], page.said["saved"]["frames"]) == (str(file), ["camera"])
            )
            assert load_static(file) == [
                TransformStamped("base", "camera", 0, Transform((1, 2, 3), (0, 0, 0.6, 0.8)), "view", static=True)
            ]
            await page.until(lambda: any(event["kind"] == AuthorityConflict.__name__ for event in page.events))
            assert link.peers


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({"edit": ["base"]}, "names no file"),
        ({"edit": ["gone"], "save": "moved.yaml"}, "none of the frames.*: gone"),
        ({"edit": ["base"], "save": "nowhere/moved.yaml"}, "nowhere/moved.yaml"),
    ],
)
async def test_what_cannot_be_saved_is_told(options: dict[str, Any], why: str, tmp_path: Path) -> None:
    if "save" in options:
        options = options | {"save": tmp_path / options["save"]}
    async with Shown(static("map", "base")).page(**options) as view, PageClient.open(view.address) as page:
        await page.do("save")
        await page.until(lambda: page.said["error"])
        page.said["error"]["text"].index(why.partition(".*")[0])
        assert why.rpartition(".*")[2] in page.said["error"]["text"]
        assert not (tmp_path / "moved.yaml").exists()


async def test_a_browser_that_reads_nothing_costs_no_pictures_and_then_gets_the_newest() -> None:
    # Some fifty pictures of 170 kB fit into the buffers of the system.
    shown = Shown(*(static("map", f"f{number}") for number in range(6_000)))
    published = 200
    async with shown.page() as view, PageClient.open(view.address) as page:
        await page.until(lambda: page.x)
        page.received.clear()
        for number in range(published):
            shown.bus.publish(moving("map", "base", (100 + number) * SECOND, float(number)))
            # Each would be drawn for a browser that reads.
            await anyio.sleep(0.006)
        await page.until(lambda: page.x["base"] == published - 1)
        assert page.received.count("kind 1") < published / 2


async def test_a_flood_of_orders_waits_at_its_own_connection_and_none_is_lost() -> None:
    shown = Shown(*(moving("map", f"f{number}", 99 * SECOND) for number in range(9)))
    # Between two pictures, much more can arrive than may wait.
    async with shown.page(rate=50.0) as view, PageClient.open(view.address) as page, anyio.create_task_group() as tasks:
        most = 0

        async def flood() -> None:
            nonlocal most
            for number in range(1_000):
                await page.do("select", frame=f"f{number % 7}")
                most = max(most, view.statistics().pending)
            await page.do("select", frame="f8")

        tasks.start_soon(flood)
        await page.until(lambda: page.said["selection"]["frame"] == "f8")
        assert 0 < most <= view.statistics().capacity
        assert (view.statistics().dropped, view.refused) == (0, 0)


@pytest.mark.skipif(tfbus.kernel == "python", reason="a picture takes as many calls as a copy of the tree")
async def test_no_turn_of_the_loop_copies_a_tree() -> None:
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

    async with shown.page() as view, anyio.create_task_group() as tasks, PageClient.open(view.address) as page:
        # The events of so many new frames take more.
        await page.until(lambda: len(page.x) == 301 and shown.bus.statistics().queues)
        # It counts in this thread, that of the loop.
        sys.setprofile(count)
        try:
            tasks.start_soon(watch)
            for mode in ("pause", "live", "play", "live", "pause"):
                await page.do(mode)
            await page.do("select", frame="f9")
            await page.until(lambda: page.said["selection"]["frame"] == "f9")
        finally:
            sys.setprofile(None)
            ended = True
    assert page.said["time"]["mode"] == "paused"
    # A picture takes 2,300 calls, and a copy of the tree 5,400.
    assert most < 4_000


# Strangers


@on_one_loop
async def test_pages_of_other_sites_and_other_names_get_nothing(shown: Shown) -> None:
    async with shown.page() as view:
        port = int(view.address.rpartition(":")[2])
        for origin in ("http://evil.example", "null", f"http://127.0.0.1:{port + 1}", f"http://192.0.2.1:{port}"):
            with pytest.raises(InvalidStatus, match="403"):
                await connect(f"ws://127.0.0.1:{port}/socket", origin=Origin(origin), proxy=None)
        for own in (None, f"http://127.0.0.1:{port}", f"http://localhost:{port}"):
            origin_of_own = None if own is None else Origin(own)
            async with connect(f"ws://127.0.0.1:{port}/socket", origin=origin_of_own, proxy=None) as client:
                assert json.loads(await client.recv())["type"] == "hello"
        async with httpx.AsyncClient(trust_env=False) as client:
            for host, status in (("evil.example", 403), (f"evil.example:{port}", 403), (f"localhost:{port}", 200)):
                assert (await client.get(view.address, headers={"Host": host})).status_code == status
        assert view.refused == 6


@on_one_loop
async def test_the_origins_that_may_use_the_page_are_named(shown: Shown, caplog: pytest.LogCaptureFixture) -> None:
    async with View(shown.bus, shown.buffer, 0, origins=["http://robot.example"]) as view:
        async with httpx.AsyncClient(trust_env=False) as client:
            for host, status in (("robot.example", 200), ("evil.example", 403)):
                assert (await client.get(view.address, headers={"Host": host})).status_code == status
        address = view.address.replace("http", "ws") + "/socket"
        async with connect(address, origin=Origin("http://robot.example"), proxy=None) as client:
            assert json.loads(await client.recv())["type"] == "hello"
        assert view.refused == 1
    assert "evil.example" in caplog.text


@given(st.lists(st.text(max_size=30) | st.binary(max_size=30), max_size=5))
async def test_whatever_a_browser_sends_the_view_goes_on(texts: list[str | bytes]) -> None:
    shown = Shown(static("map", "dock"), moving("map", "base", 99 * SECOND))
    async with shown.page(edit=["dock"]) as view, PageClient.open(view.address) as page:
        for text in texts:
            await page.socket.send(text)
        await page.do("select", frame="base")
        await page.until(lambda: page.said["selection"]["frame"] == "base")
        assert view.refused == len(texts)


async def test_a_message_that_is_too_long_ends_its_own_connection_only(shown: Shown) -> None:
    async with shown.page() as view, PageClient.open(view.address) as page, PageClient.open(view.address) as other:
        await page.socket.send("x" * 70_000)
        with pytest.raises(OSError, match=r"closed|gone"):
            await page.until(lambda: False)
        await other.until(lambda: view.viewers == 1)


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
        ({"edit": "base"}, TypeError),
        ({"edit": ["/base"]}, InvalidTransformError),
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
        ([PointCloud("map", LATEST, np.zeros((2, 3)))], {}, ValueError),
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
