"""The page in a real browser: the tests click, type and measure pixels as a person would."""

import itertools
import math
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pytest
from anyio.from_thread import BlockingPortal, start_blocking_portal
from support.browsers import PATIENCE, browser
from support.processes import new_domain
from support.samples import moving, over

from tfbus import LATEST, SECOND, Buffer, Bus, LocalLink, PointCloud, SimulatedClock, Transform, TransformStamped
from tfbus.tree.history import EdgeState

pytest.importorskip("PIL", reason="pixels are read by pillow")
pytest.importorskip("trimesh", reason="the live page needs trimesh")

from PIL import Image

from tfbus.view import View

BEGIN = 1_790_000_000 * SECOND
"""In 2026."""
CANVAS_EDGE = 48
"""In pixels: the toolbar above the picture, and the legend below it."""
thorough = pytest.mark.thorough


class Box(NamedTuple):
    """In pixels."""

    left: float
    top: float
    right: float
    bottom: float


class Window:
    """A bus with a page in another thread, and a window of the browser that shows the page."""

    def __init__(self, chromium: Any, portal: BlockingPortal, stack: ExitStack) -> None:
        self._chromium, self._portal, self._stack = chromium, portal, stack
        self.clock = SimulatedClock(BEGIN)
        self.bus: Bus = portal.call(Bus, self.clock)
        self.buffer: Buffer = portal.call(Buffer, self.bus)
        self.errors: list[str] = []
        self.answers: list[Any] = []

    def open(
        self, *batch: TransformStamped, size: tuple[int, int] = (1280, 720), dark: bool = False, **options: Any
    ) -> None:
        """Publish samples, and open their page; it is the window's page from now on."""
        self.publish(*batch)
        self.ending, self.view = self.serve(**options)
        self.page = self._chromium.new_page(
            viewport={"width": size[0], "height": size[1]}, color_scheme="dark" if dark else "light"
        )
        self._stack.callback(self.page.close)
        self.page.set_default_timeout(PATIENCE * 1_000)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("response", lambda answer: self.answers.append(answer))
        self.page.goto(self.view.address)
        self.page.wait_for_function(
            "!document.getElementById('nothing').hidden || document.querySelector('.dot.static')"
        )
        if batch:
            count = len({name for sample in batch for name in (sample.parent, sample.child)})
            self.until(lambda: self.page.locator("#shown-count").text_content() == f"{count} frames")

    def serve(self, port: int = 0, **options: Any) -> tuple[ExitStack, View]:
        view: View = self._portal.call(lambda: View(self.bus, self.buffer, port, rate=1_000.0, **options))
        return self.entered(self._portal.wrap_async_context_manager(view)), view

    def entered(self, what: AbstractContextManager[Any]) -> ExitStack:
        """Enter it, until the end of the test or until the end of the stack that is returned."""
        ending = self._stack.enter_context(ExitStack())
        ending.enter_context(what)
        return ending

    def link(self, bus: Bus, domain: str) -> ExitStack:
        link = self._portal.call(lambda: LocalLink(bus, domain))
        return self.entered(self._portal.wrap_async_context_manager(link))

    def call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call a function in the thread of the bus."""
        return self._portal.call(function, *arguments)

    def publish(self, *batch: TransformStamped) -> None:
        self.call(self.bus.publish, batch)

    def until(self, condition: Callable[..., object], *arguments: object) -> None:
        """Look again until a condition holds for some arguments."""
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            if condition(*arguments):
                return
            self.page.wait_for_timeout(50)
        assert condition(*arguments)

    def row(self, frame: str) -> Any:
        """The row of a frame in the tree."""
        return self.page.locator(f'[role=treeitem][title="{frame}"]')

    def rows(self) -> list[str]:
        found = [row.text_content() for row in self.page.locator("[role=treeitem] .name").all()]
        return sorted(found)

    def facts(self) -> dict[str, str]:
        texts = self.page.locator("#facts > *").all_inner_texts()
        return dict(zip(texts[::2], texts[1::2], strict=True))

    def names(self) -> dict[str, Box]:
        """The names in the picture, with their boxes."""
        script = """[...document.querySelectorAll('#names span')].map(each => {
            const { left, top, right, bottom } = each.getBoundingClientRect();
            return [each.textContent, [left, top, right, bottom]]; })"""
        return {name: Box(*box) for name, box in self.page.evaluate(script)}

    def pixels(self, *colours: str, near: int = 6) -> npt.NDArray[np.intp]:
        """The places at which the picture has a colour, x and y in pixels of the canvas, shape (n, 2)."""
        picture = np.asarray(Image.open(BytesIO(self.page.locator("main").screenshot())).convert("RGB"), int)
        wanted = np.array([[int(colour[k : k + 2], 16) for k in (1, 3, 5)] for colour in colours])
        found = (np.abs(picture[:, :, None, :] - wanted).max(axis=3) <= near).any(axis=2)
        found[:CANVAS_EDGE] = found[-CANVAS_EDGE:] = False
        return np.argwhere(found)[:, ::-1]

    def extent(self) -> tuple[float, float]:
        """The part of the canvas's width, and of its height, that the frames span."""
        found = self.pixels(EdgeState.STATIC.value, EdgeState.MOVING.value)
        box = self.page.locator("#canvas").bounding_box()
        width, height = found.max(axis=0) - found.min(axis=0) if len(found) else (0, 0)
        return width / box["width"], height / box["height"]

    def pressed(self) -> list[str]:
        return list(self.page.locator("#time [aria-pressed=true]").all_inner_texts())

    def seconds(self) -> str:
        return str(self.page.locator("#seconds").input_value())

    def drag(self, begin: tuple[float, float], way: tuple[float, float]) -> None:
        """Drag from a point of the canvas, by a way, in pixels."""
        box = self.page.locator("#canvas").bounding_box()
        x, y = box["x"] + begin[0], box["y"] + begin[1]
        self.page.mouse.move(x, y)
        self.page.wait_for_timeout(100)  # The handle looks for the pointer when a picture is drawn.
        self.page.mouse.down()
        for k in range(1, 6):
            self.page.mouse.move(x + way[0] * k / 5, y + way[1] * k / 5)
        self.page.mouse.up()


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    with browser() as found:
        yield found


@pytest.fixture
def window(chromium: Any) -> Iterator[Window]:
    with start_blocking_portal() as portal, ExitStack() as stack:
        window = Window(chromium, portal, stack)
        yield window
        assert window.errors == []


def at(parent: str, child: str, x: float, y: float, z: float = 0.0, yaw: float = 0.0) -> TransformStamped:
    """A static sample."""
    return TransformStamped(parent, child, 0, Transform.from_xyz_rpy((x, y, z), (0.0, 0.0, yaw)), "test", static=True)


def robots(count: int, links: int) -> list[TransformStamped]:
    """Robots on a grid, each with a prefix and a chain of links."""
    found = []
    for k in range(count):
        found.append(at("map", f"robot{k}/base", 3.0 * (k % 5), 3.0 * (k // 5)))
        chain = [f"robot{k}/base", *(f"robot{k}/link{j}" for j in range(links))]
        found += [at(parent, child, 0.4, 0.0, 0.3) for parent, child in itertools.pairwise(chain)]
    return found


def apart(boxes: dict[str, Box]) -> bool:
    pairs = itertools.combinations(boxes.values(), 2)
    return all(a.right <= b.left or b.right <= a.left or a.bottom <= b.top or b.bottom <= a.top for a, b in pairs)


def test_the_page_shows_frames_and_asks_no_other_host(window: Window) -> None:
    window.open(at("map", "base", 1.0, 0.0), at("base", "lidar", 0.3, 0.0, 0.5), title="my robot")
    window.until(lambda: window.names().keys() == {"map", "base", "lidar"})
    assert window.page.title() == "my robot"
    icon = window.page.request.get(
        window.view.address + "/" + window.page.locator("link[rel=icon]").get_attribute("href")
    )
    assert icon.ok and icon.headers["content-type"] == "image/svg+xml"
    assert all(answer.ok and answer.url.startswith(window.view.address) for answer in window.answers)
    assert sum(len(answer.body()) for answer in window.answers) < 1_200_000


@thorough
def test_the_names_of_few_frames_are_shown_and_of_many_the_first_twenty(window: Window) -> None:
    window.open(*robots(4, 1))
    everyone = {"map", *(f"robot{k}/{name}" for k in range(4) for name in ("base", "link0"))}
    window.until(lambda: window.names().keys() == everyone)
    assert apart(window.names())
    window.publish(*robots(20, 14))
    window.until(lambda: len(window.names()) == 20)
    assert apart(window.names())
    window.row("map").click()
    window.page.get_by_label("Names").select_option("all")
    window.until(lambda: len(window.names()) > 30)
    assert apart(window.names())
    window.page.get_by_label("Names").select_option("none")
    window.until(lambda: window.names().keys() == {"map"})
    window.page.get_by_label("Filter the frames by a pattern").fill("robot3/*")
    window.row("robot3/link1").click()
    window.page.get_by_role("button", name="Show all").click()
    window.page.get_by_label("Names").select_option("chain")
    window.until(lambda: window.names().keys() == {"map", "robot3/base", "robot3/link0", "robot3/link1"})


@thorough
def test_the_camera_frames_what_there_is_until_somebody_moves_it(window: Window) -> None:
    window.open(at("map", "x", 5.0, 0.0), at("map", "y", 0.0, 5.0), at("map", "z", 0.0, 0.0, 3.0))
    window.until(lambda: max(window.extent()) > 0.45)
    window.publish(at("map", "far", 40.0, 9.0))
    window.until(lambda: "far" in window.names() and max(window.extent()) > 0.45)
    window.drag((300.0, 500.0), (60.0, 0.0))
    window.page.wait_for_timeout(300)
    before = window.names()
    window.publish(at("map", "farther", -400.0, 9.0))
    window.row("farther").wait_for()
    window.page.wait_for_timeout(300)
    assert window.names() == before
    window.page.get_by_role("button", name="Fit").click()
    window.until(lambda: {"farther", "far"} <= window.names().keys() and max(window.extent()) > 0.45)


@thorough
def test_the_camera_follows_a_frame_with_its_heading_if_that_is_wanted(window: Window) -> None:
    def drive(x: float, yaw: float) -> None:
        window.clock.set(window.clock.now() + SECOND)
        place = Transform.from_xyz_rpy((x, 0.0, 0.0), (0.0, 0.0, yaw))
        window.publish(TransformStamped("map", "base", window.clock.now(), place))

    def near(before: dict[str, Box], *names: str) -> bool:
        now = window.names()
        return all(name in now and math.dist(now[name][:2], before[name][:2]) < 3.0 for name in names)

    window.open(moving("map", "base", BEGIN, 10.0), at("base", "nose", 2.0, 0.0))
    window.row("base").click()
    window.until(lambda: len(window.names()) == 3)
    window.page.get_by_label("The camera follows").select_option("position")
    before = window.names()
    drive(300.0, 0.0)
    window.until(lambda: "300.000000" in window.facts().get("xyz", "") and near(before, "base", "nose"))
    assert "map" not in window.names()
    drive(300.0, 1.5)
    window.until(lambda: near(before, "base") and not near(before, "nose"))
    drive(300.0, 0.0)
    window.until(lambda: near(before, "nose"))
    window.page.get_by_label("The camera follows").select_option("heading")
    drive(-300.0, 1.5)
    window.until(lambda: "-300.000000" in window.facts()["xyz"] and near(before, "base", "nose"))


@thorough
def test_states_have_the_colours_of_every_other_picture_and_a_legend_of_four_words(window: Window) -> None:
    window.open(at("map", "dock", 2.0, 0.0), moving("map", "base", BEGIN, -2.0))
    colours = [EdgeState.STATIC.value, EdgeState.MOVING.value, EdgeState.STALE.value]
    window.until(lambda: [len(window.pixels(colour)) > 40 for colour in colours] == [True, True, False])
    window.call(window.clock.set, BEGIN + 9 * SECOND)
    window.until(lambda: [len(window.pixels(colour)) > 40 for colour in colours] == [True, False, True])
    words = window.page.locator("#legend span:not(.grid)")
    assert words.all_inner_texts() == ["static", "moving", "stale", "lost"]
    shown = words.locator("i").evaluate_all("each => each.map(dot => getComputedStyle(dot).backgroundColor)")
    assert shown[:3] == [f"rgb({', '.join(str(int(colour[k : k + 2], 16)) for k in (1, 3, 5))})" for colour in colours]


@thorough
def test_a_click_in_the_tree_selects_a_second_one_collapses_and_an_eye_hides(window: Window) -> None:
    window.open(at("map", "base", 1.0, 0.0), at("base", "arm", 0.5, 0.0, 0.5), at("arm", "hand", 0.5, 0.0, 0.5))
    window.row("arm").click()
    window.until(lambda: window.facts().get("parent") == "base")
    assert window.row("arm").get_attribute("aria-selected") == "true"
    assert window.page.locator("#chain").inner_text() == "arm → base → map"
    window.row("arm").click()
    window.until(lambda: window.rows() == ["arm", "base", "map"])
    assert window.row("arm").get_attribute("aria-expanded") == "false"
    window.row("arm").click()
    window.row("hand").wait_for()
    window.page.get_by_label("Hide arm").click()
    window.until(lambda: window.names().keys() == {"map", "base"})
    window.page.get_by_label("Hide arm").click()
    window.page.get_by_label("Hide base").click(modifiers=["Shift"])
    window.until(lambda: window.names().keys() == {"map", "arm", "hand"})
    window.page.get_by_role("button", name="Show all").click()
    window.until(lambda: len(window.names()) == 4)


@thorough
def test_a_click_on_a_dot_of_the_picture_selects_and_one_beside_it_does_not(window: Window) -> None:
    window.open(at("map", "base", 1.0, 0.0))
    window.until(lambda: len(window.pixels(EdgeState.STATIC.value)) > 40)
    dots = window.pixels(EdgeState.STATIC.value)
    box = window.page.locator("#canvas").bounding_box()
    chosen = set()
    for place in (dots[:, 0].argmin(), dots[:, 0].argmax()):
        window.page.mouse.click(box["x"] + float(dots[place, 0]), box["y"] + float(dots[place, 1]))
        window.page.locator("#selected").wait_for()
        chosen.add(window.page.locator("#selected-name").inner_text())
        window.page.mouse.click(box["x"] + 60, box["y"] + 400)
        window.page.locator("#selected").wait_for(state="hidden")
    assert chosen == {"map", "base"}


@thorough
def test_the_tree_is_filtered_by_patterns_and_grouped_by_the_prefixes_of_robots(window: Window) -> None:
    wheels = [
        at(f"robot{k}/base", f"robot{k}/{side}_wheel_link", 0.0, y) for k in (0, 1) for side, y in (("l", 1), ("r", -1))
    ]
    window.open(*robots(2, 1), *wheels)
    assert window.rows() == sorted(
        ["map", *2 * ["base", "l_wheel_link", "link0", "r_wheel_link"], "robot0/", "robot1/"]
    )
    both = {f"robot{k}/{name}" for k in (0, 1) for name in ("base", "link0", "l_wheel_link", "r_wheel_link")}
    filtered = window.page.get_by_label("Filter the frames by a pattern")
    for pattern, wanted in (
        ("robot1/*", {name for name in both if name.startswith("robot1")}),
        ("!*wheel*", {"map", *(name for name in both if "wheel" not in name)}),
        ("robot1/* !wheel", {"robot1/base", "robot1/link0"}),
        ("LINK0", {"robot0/link0", "robot1/link0"}),
        ("", {"map", *both}),
    ):
        filtered.fill(pattern)
        window.until(lambda wanted: window.names().keys() == wanted, wanted)
    window.page.locator("[role=treeitem].group", has_text="robot1/").locator(".eye").click()
    window.until(lambda: not any(name.startswith("robot1") for name in window.names()))
    window.page.get_by_role("button", name="Show all").click()
    window.row("robot0/link0").click()
    window.page.get_by_role("button", name="Only this chain").click()
    window.until(lambda: window.names().keys() == {"robot0/link0", "robot0/base", "map"})


@thorough
def test_a_thousand_frames_begin_as_a_few_rows(window: Window) -> None:
    window.open(*robots(20, 49))
    window.until(lambda: window.rows() == sorted(["map", *(f"robot{k}/" for k in range(20))]))
    assert window.page.locator("#shown-count").inner_text() == "1001 frames"
    window.page.locator(".group", has_text="robot7/").click()
    window.row("robot7/base").click()
    window.until(lambda: window.facts().get("authority") == "test")


@thorough
def test_time_is_always_in_sight_and_obeys_the_keys(window: Window) -> None:
    stamps = range(BEGIN, BEGIN + 10 * SECOND + 1, SECOND // 2)
    window.open(
        *(moving("map", "base", stamp, (stamp - BEGIN) / SECOND) for stamp in stamps),
        *over("map", "slow", range(BEGIN, BEGIN + 10 * SECOND + 1, 2 * SECOND), speed=0.0),
        live=False,
    )
    page = window.page
    page.locator("[role=treeitem][title=base]").click()
    window.until(lambda: "authority" in window.facts())
    for part in ("#time", "#slider", "#seconds", "#wall", "#play"):
        box = page.locator(part).bounding_box()
        assert box["y"] + box["height"] <= 720 and box["x"] + box["width"] <= 1280
    assert window.pressed() == ["Pause"]
    for key, seconds in (
        ("ArrowRight", "0.500"),
        ("ArrowRight", "1.000"),
        ("End", "10.000"),
        ("ArrowLeft", "9.500"),
        ("Home", "0.000"),
    ):
        page.keyboard.press(key)
        window.until(lambda text: window.seconds() == text, seconds)
    window.row("slow").click()
    page.keyboard.press("ArrowRight")
    window.until(lambda: window.seconds() == "2.000")
    window.row("base").click()
    page.get_by_label("Seconds from the start").fill("3.2")
    page.keyboard.press("Enter")
    window.until(lambda: "3.200000" in window.facts().get("xyz", ""))
    clock = page.locator("#wall").inner_text()
    assert clock.endswith(".200") and clock.count(":") == 2
    page.keyboard.press(" ")
    window.until(lambda: window.pressed() == ["Play"] and float(window.seconds()) > 3.3)
    page.get_by_role("button", name="Pause").click()
    window.until(lambda: window.pressed() == ["Pause"])
    page.keyboard.press(" ")
    window.until(lambda: window.pressed() == ["Play"])
    page.keyboard.press(" ")
    window.until(lambda: window.pressed() == ["Pause"])
    box = page.locator("#slider").bounding_box()
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    window.until(lambda: abs(float(window.seconds()) - 5.0) < 0.2)


@thorough
def test_a_trail_is_a_switch_at_the_selection_with_a_length_and_a_colour_of_its_own(window: Window) -> None:
    stamps = range(BEGIN - 9 * SECOND, BEGIN + 1, SECOND // 10)
    path = [
        moving("map", name, stamp, sign * (stamp - BEGIN) / SECOND)
        for name, sign in (("a", 1), ("b", -1))
        for stamp in stamps
    ]
    window.open(*path, at("map", "y", 0.0, 9.0))
    trails = ("#cc79a7", "#56b4e9")

    def drawn() -> list[int]:
        return [len(window.pixels(colour)) for colour in trails]

    window.row("a").click()
    assert drawn() == [0, 0]
    window.page.get_by_label("Trail", exact=True).check()
    window.until(lambda: drawn()[0] > 100)
    long = drawn()[0]
    window.row("b").click()
    window.page.get_by_label("Trail", exact=True).check()
    window.until(lambda: min(drawn()) > 100)
    window.row("a").click()
    window.page.get_by_label("Length of the trail in seconds").fill("3")
    window.page.keyboard.press("Enter")
    window.until(lambda: 0 < drawn()[0] < 0.6 * long)
    window.page.get_by_label("Trail", exact=True).uncheck()
    window.until(lambda: drawn()[0] == 0)


@thorough
@pytest.mark.parametrize("dark", [False, True])
def test_a_phone_shows_picture_panel_and_time_together_in_light_and_dark(window: Window, dark: bool) -> None:
    window.open(*robots(4, 1), size=(390, 844), dark=dark)
    page = window.page
    window.until(lambda: len(window.names()) > 3)
    sky = np.asarray(Image.open(BytesIO(page.locator("main").screenshot())).convert("L"), int)
    assert bool(sky.mean() < 80) is dark
    page.get_by_role("button", name="Frames").click()
    window.row("robot1/base").click()
    page.get_by_role("button", name="Selection", exact=True).click()
    window.until(lambda: window.facts().get("authority") == "test")
    assert page.locator("#canvas").bounding_box()["height"] > 0.33 * 844
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    for part in ("#time", "#slider", "#tabs", "#selected-name"):
        box = page.locator(part).bounding_box()
        assert box["x"] >= 0 and box["x"] + box["width"] <= 390 and box["y"] + box["height"] <= 844
    assert "robot1/base" in window.names()


@thorough
def test_every_control_has_a_name_for_screen_readers(window: Window) -> None:
    window.open(at("map", "base", 1.0, 0.0), edit=["base"])
    window.row("base").click()
    window.page.locator("#edit").wait_for()
    nameless = """[...document.querySelectorAll('button, input, select, [role=tree], [role=treeitem]')].filter(each => {
        const labels = [...(each.labels ?? [])].map(label => label.textContent);
        return ![each.getAttribute('aria-label') ?? '', each.textContent, ...labels].join('').trim();
    }).map(each => each.outerHTML)"""
    assert window.page.evaluate(nameless) == []
    assert window.page.get_by_role("slider", name="Time").count() == 1
    assert window.page.get_by_role("treeitem", name="base, static").get_attribute("aria-level") == "2"
    window.page.get_by_role("tree").focus()
    window.page.keyboard.press("ArrowUp")
    window.until(lambda: window.row("map").get_attribute("aria-selected") == "true")


@thorough
def test_an_event_has_a_time_of_day_and_a_click_goes_to_its_frame_and_moment(window: Window) -> None:
    window.open(*over("map", "base", range(BEGIN - 5 * SECOND, BEGIN + 1, SECOND), 0.0))
    window.call(window.clock.set, BEGIN + SECOND)
    window.publish(moving("map", "tool", BEGIN + SECOND, 2.0))
    window.call(window.clock.set, BEGIN + 3 * SECOND)
    window.publish(moving("map", "tool", BEGIN + 3 * SECOND, 4.0))
    event = window.page.locator("#event-list button", has_text="'tool'").last
    event.wait_for()
    assert event.locator("time").inner_text().count(":") == 2
    event.click()
    window.until(lambda: window.facts().get("xyz", "").replace(" ", "").startswith("x2.000000"))
    assert window.page.locator("#selected-name").inner_text() == "tool"
    assert window.pressed() == ["Pause"]


@thorough
def test_an_empty_page_says_where_it_listens_and_a_dead_broadcaster_is_lost(window: Window) -> None:
    domain = new_domain()
    window.link(window.bus, domain)
    window.open()
    text = window.page.locator("#nothing").inner_text()
    assert f"domain '{domain}'" in text and "tfbus static" in text and "0 peers" in text
    other = window.call(Bus, window.clock)
    ending = window.link(other, domain)
    window.page.get_by_text("hears 1 peer").wait_for()
    window.call(other.publish, [moving("map", "base", BEGIN, 1.0)])
    window.until(lambda: window.names().keys() == {"map", "base"})
    assert window.page.locator("#nothing").is_hidden()
    ending.close()
    window.call(window.clock.set, BEGIN + 9 * SECOND)
    window.until(lambda: window.row("base").locator(".dot.lost").count() == 1)
    window.until(lambda: len(window.pixels("#d0103f")) > 40)
    assert [len(peer) for peer in window.page.locator("#event-list code").all_inner_texts()][-1] == 8


@thorough
def test_a_server_that_is_gone_is_told_with_its_time_until_it_is_back(window: Window) -> None:
    window.open(at("map", "base", 1.0, 0.0))
    window.row("base").click()
    port = int(window.view.address.rpartition(":")[2])
    window.ending.close()
    alarm = window.page.get_by_role("alert")
    alarm.wait_for()
    assert "does not answer since" in alarm.inner_text() and alarm.inner_text().count(":") == 2
    assert window.page.title().startswith("no connection")
    window.publish(at("map", "base", 7.0, 0.0))
    window.serve(port)
    alarm.wait_for(state="hidden")
    window.until(lambda: "7.000000" in window.facts()["xyz"])


@thorough
def test_a_frame_is_moved_by_numbers_steps_and_a_handle_undone_and_saved(window: Window, tmp_path: Path) -> None:
    def pose() -> Transform:
        found: Transform = window.call(window.buffer.lookup_nowait, "base", "camera").transform
        return found

    window.open(
        at("map", "base", 3.0, 0.0, 0.0, 0.5),
        at("base", "camera", 0.3, 0.0, 0.4),
        edit=["camera"],
        save=tmp_path / "f.yaml",
    )
    page = window.page
    window.row("base").click()
    assert page.locator("#edit").is_hidden()
    window.row("camera").click()
    page.get_by_label("More x").click()
    window.until(lambda: pose().translation == (0.31, 0.0, 0.4))
    page.get_by_label("z in m").fill("0.123456789")
    page.keyboard.press("Enter")
    window.until(lambda: pose().translation == (0.31, 0.0, 0.123456789))
    page.get_by_label("yaw in deg").fill("90")
    page.keyboard.press("Enter")
    window.until(lambda: pose().is_close(Transform.from_xyz_rpy((0.31, 0.0, 0.123456789), (0.0, 0.0, math.pi / 2))))
    page.get_by_role("button", name="Undo").click()
    page.get_by_role("button", name="Undo").click()
    window.until(lambda: pose() == Transform((0.31, 0.0, 0.4)))
    # The red arrow of the handle, along the camera's own x, or its parent's: they are parallel here.
    for axes in ("local", "parent"):
        page.get_by_label("Axes of the handle").select_option(axes)
        before = pose().translation
        window.until(lambda: len(window.pixels("#ff0000", near=40)) > 20)
        red = window.pixels("#ff0000", near=40)
        tip = red[np.linalg.norm(red - np.median(red, axis=0), axis=1).argmax()]
        way = tip - red[np.linalg.norm(red - tip, axis=1).argmax()]
        way = way / np.linalg.norm(way)
        window.drag(tuple(tip - 4.0 * way), tuple(60.0 * way))
        window.until(lambda x: abs(pose().translation[0] - x) > 0.005, before[0])
        x, *rest = np.subtract(pose().translation, before)
        assert rest == pytest.approx([0.0, 0.0], abs=1e-15)
        assert x / 0.01 == pytest.approx(round(x / 0.01))
    page.get_by_role("button", name="Save").click()
    page.get_by_text("saved: camera").wait_for()
    assert f"{pose().translation[0]!r}" in (tmp_path / "f.yaml").read_text()


@thorough
def test_the_way_between_two_frames_is_measured(window: Window) -> None:
    window.open(at("map", "a", 1.0, 0.0, 0.0, math.pi / 2), at("map", "b", 1.0, 4.0, 3.0))
    window.row("a").click()
    window.page.get_by_role("button", name="Measure").click()
    window.row("b").click()
    window.until(lambda: "5.0000 m, 90.00°" in window.page.locator("#distance").inner_text())
    # In the axes of a, y of the map is x.
    text = window.page.locator("#distance").inner_text()
    assert "x y z 4.0000" in text and "3.0000 m" in text and "-90.00°" in text
    assert window.page.locator("#selected-name").inner_text() == "a"


@thorough
def test_points_and_the_shapes_of_a_robot_are_drawn_at_their_frames(window: Window) -> None:
    robot = '<robot name="r"><link name="base"><visual><geometry><box size="1 1 1"/></geometry><material name="m">\
<color rgba="1 0 1 1"/></material></visual></link></robot>'
    window.open(at("map", "base", 0.0, 0.0), at("map", "lidar", 0.0, 3.0), urdf=robot)

    def purple() -> int:
        picture = np.asarray(Image.open(BytesIO(window.page.locator("main").screenshot())).convert("RGB"), int)
        return int(((picture[:, :, 0] > 90) & (picture[:, :, 1] < 60) & (picture[:, :, 2] > 90)).sum())

    window.until(lambda: purple() > 2_000)
    cloud = PointCloud("lidar", LATEST, np.random.default_rng(1).uniform(-0.4, 0.4, (300, 3)))
    window.call(lambda: window.view.add_points(cloud, size=0.1, colour=(255, 200, 0)))
    window.until(lambda: len(window.pixels("#ffc800")) > 500)
    window.page.get_by_label("Opacity of the robot").fill("0")
    window.until(lambda: purple() == 0)
    window.page.get_by_label("Opacity of the robot").fill("1")
    window.page.get_by_label("Hide base").click()
    window.page.wait_for_timeout(300)
    assert purple() == 0


@thorough
def test_names_of_frames_are_texts_and_never_elements(window: Window) -> None:
    evil = "<img src=x onerror=document.title='owned'>"
    turned = "a\u202eb\nc"
    window.open(at(evil, turned, 1.0, 0.0), at(evil, f"{evil}{{1+1}}", 2.0, 0.0))
    window.until(lambda: window.rows() == sorted([evil, "a\\u{202e}b\\u{a}c", f"{evil}{{1+1}}"]))
    window.row("a\\\\u{202e}b\\\\u{a}c").click()
    window.until(lambda: "parent" in window.facts())
    window.page.get_by_role("button", name="Fixed").click()
    window.page.get_by_label("The camera follows").select_option("position")
    window.publish(moving(evil, "<img src=x>", BEGIN))
    window.page.locator("#event-list button").first.wait_for()
    assert window.page.locator("img").count() == 0
    assert window.page.title() == "tfbus"
