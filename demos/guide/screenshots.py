"""Makes the pictures of the guide: ``python demos/guide/screenshots.py DATA PACKAGES``.

DATA is a folder with `pr2.urdf` and `pr2_tf.bag` (a PR2's URDF, and a recording of its transforms) and `turtlesim.bag`
(the two turtles of the tf tutorial). PACKAGES is a folder with the package `pr2_description`, in which the meshes are.
It needs ``pip install "tfbus[view,plot,bag]" playwright``, and Chromium.
"""

import shutil
import sys
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import anyio
import anyio.to_thread
from PIL import Image
from playwright.sync_api import Page, sync_playwright

import tfbus
from tfbus.cli.commands.tutorial import send_laser
from tfbus.plot import plot_transforms
from tfbus.recording import load
from tfbus.view import View

STATIC = Path(__file__).with_name("_static")
SIZE = {"width": 1200, "height": 800}
COLOURS = 256


def write(name: str, picture: bytes) -> None:
    """Write a PNG with few colours, which makes it small."""
    image = Image.open(BytesIO(picture)).convert("RGB").quantize(COLOURS, method=Image.Quantize.FASTOCTREE)
    image.save(STATIC / name, optimize=True)


def control(page: Page, name: str) -> Any:
    """The input of a control of the page."""
    return page.locator(f"xpath=//label[normalize-space()='{name}']/ancestor::div[2]//input[not(@type='hidden')]")


def photograph(address: str, name: str, prepare: Callable[[Page], None]) -> None:
    """Open a page, prepare it, and write a picture of it."""
    with sync_playwright() as player:
        browser = player.chromium.launch(
            executable_path=shutil.which("chromium"),
            args=["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"],
        )
        page = browser.new_page(viewport=SIZE)  # type: ignore[arg-type]
        page.set_default_timeout(120_000)
        page.goto(address)
        page.wait_for_selector("text=are connected with")
        # A note about missing graphics hardware, which is about the machine that makes the pictures.
        note = page.get_by_text("Software WebGL rendering detected")
        if note.count():
            page.locator("[role=alert] button, .mantine-Notification-closeButton").first.click()
        prepare(page)
        page.wait_for_timeout(4_000)
        write(name, page.screenshot())
        browser.close()


async def pr2(data: Path, packages: Path) -> None:
    """The PR2 of a recording, with the chain of its left gripper."""

    def prepare(page: Page) -> None:
        control(page, "Search").fill("l_gripper_tool_frame")
        page.wait_for_selector("text=l_gripper_palm_link")
        control(page, "Time [s]").fill("3")
        control(page, "Time [s]").press("Enter")
        canvas = page.locator("canvas").first.bounding_box()
        assert canvas is not None
        page.mouse.move(canvas["x"] + canvas["width"] / 2, canvas["y"] + canvas["height"] / 2)
        for _ in range(4):
            page.mouse.wheel(0, -200)
            page.wait_for_timeout(300)

    tree = load(data / "pr2_tf.bag")
    with tfbus.Bus() as bus, tfbus.Buffer(bus, keep=None, prefill=tree) as buffer:
        async with View(bus, buffer, 0, live=False, urdf=data / "pr2.urdf", package_paths=[packages]) as view:
            await anyio.to_thread.run_sync(photograph, view.address, "view_pr2.png", prepare)


async def tutorial() -> None:
    """The robot of the tf tutorial, live."""

    def prepare(page: Page) -> None:
        control(page, "Search").fill("base_laser")
        page.wait_for_selector("text=robot_tf_publisher")

    with tfbus.Bus() as bus, tfbus.Buffer(bus) as buffer:
        async with View(bus, buffer, 0, rate=5.0) as view, anyio.create_task_group() as robot:
            robot.start_soon(send_laser, bus)
            await anyio.to_thread.run_sync(photograph, view.address, "view_tutorial.png", prepare)
            robot.cancel_scope.cancel()


def turtles(data: Path) -> None:
    """The coordinates of the two turtles over time."""
    picture = BytesIO()
    figure = plot_transforms(load(data / "turtlesim.bag"), "world", "turtle1", "turtle2", recording="turtlesim.bag")
    figure.savefig(picture, dpi=90)
    write("plot_transforms.png", picture.getvalue())


def main() -> None:
    data, packages = map(Path, sys.argv[1:])
    turtles(data)
    anyio.run(tutorial)
    anyio.run(pr2, data, packages)


if __name__ == "__main__":
    main()
