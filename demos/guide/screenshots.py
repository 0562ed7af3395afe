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
SIZE = {"width": 1280, "height": 800}
COLOURS = 256


def write(name: str, picture: bytes) -> None:
    """Write a PNG with few colours, which makes it small."""
    image = Image.open(BytesIO(picture)).convert("RGB").quantize(COLOURS, method=Image.Quantize.FASTOCTREE)
    image.save(STATIC / name, optimize=True)


def select(page: Page, frame: str) -> None:
    """Select a frame in the tree of the page."""
    page.get_by_label("Filter the frames by a pattern").fill(frame)
    page.locator(f'[role=treeitem][title="{frame}"]').click()
    page.get_by_label("Filter the frames by a pattern").fill("")
    page.get_by_text("authority").wait_for()
    # A name is marked under the pointer.
    page.mouse.move(SIZE["width"] / 2, SIZE["height"] - 5)


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
        page.locator("[role=treeitem]").first.wait_for()
        prepare(page)
        page.wait_for_timeout(4_000)
        write(name, page.screenshot())
        browser.close()


async def pr2(data: Path, packages: Path) -> None:
    """The PR2 of a recording, with the chain of its left gripper."""

    def prepare(page: Page) -> None:
        select(page, "l_gripper_tool_frame")
        page.get_by_label("Seconds from the start").fill("3.2")
        page.keyboard.press("Enter")

    tree = load(data / "pr2_tf.bag")
    with tfbus.Bus() as bus, tfbus.Buffer(bus, keep=None, prefill=tree) as buffer:
        async with View(bus, buffer, 0, live=False, urdf=data / "pr2.urdf", package_paths=[packages]) as view:
            await anyio.to_thread.run_sync(photograph, view.address, "view_pr2.png", prepare)


async def tutorial() -> None:
    """The robot of the tf tutorial, live."""

    def prepare(page: Page) -> None:
        select(page, "base_laser")

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
