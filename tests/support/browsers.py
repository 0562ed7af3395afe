"""A real browser that opens a page; tests that use it are skipped where there is none."""

import os
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

import anyio.to_thread
import pytest

T = TypeVar("T")

PATIENCE = 60.0
"""Seconds; drawing without a graphics card is slow."""

_ARGUMENTS = (
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--no-sandbox",
    # Whatever the page wants from elsewhere must fail.
    "--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1",
)


class Browser:
    """An open page.

    Attributes
    ----------
    requests : list of str
        The addresses of everything that the page has asked for.
    """

    def __init__(self, page) -> None:  # type: ignore[no-untyped-def]
        self.page = page
        self.requests: list[str] = []
        page.on("request", lambda request: self.requests.append(request.url))
        page.set_default_timeout(PATIENCE * 1_000)

    def open(self, address: str) -> None:
        """Open a page, and wait until it shows frames."""
        self.page.goto(address)
        self.page.wait_for_selector("text=are connected with")

    def wait_for(self, text: str) -> None:
        """Wait for a text, given as a regular expression."""
        self.page.get_by_text(re.compile(text)).first.wait_for()

    def enter(self, name: str, text: str) -> None:
        """Enter a text into the control of a name."""
        control = self.page.locator(
            f"xpath=//label[normalize-space()='{name}']/ancestor::div[2]//input[not(@type='hidden')]"
        )
        control.fill(text)
        control.press("Enter")

    def click_in_the_middle(self) -> None:
        """Click in the middle of the 3D part."""
        box = self.page.locator("canvas").first.bounding_box()
        assert box is not None
        self.page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)

    def facts(self) -> dict[str, str]:
        """The facts about the selected frame; empty if none is selected."""
        rows = self.page.locator("table tr").all_inner_texts()
        return dict(row.split("\t", 1) for row in rows)

    def wait_for_fact(self, name: str, pattern: str) -> dict[str, str]:
        """Wait until a fact about the selected frame matches a regular expression; all facts."""
        cells = self.page.locator("tr", has=self.page.get_by_text(re.compile(f"^{name}$")))
        cells.filter(has_text=re.compile(pattern)).first.wait_for()
        return self.facts()


@contextmanager
def browser() -> Iterator[Browser]:
    """A browser, for a thread without an event loop."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="a real browser needs playwright")
    with sync_api.sync_playwright() as player:
        path = chromium(player.chromium.executable_path)
        found = player.chromium.launch(executable_path=path, args=_ARGUMENTS)
        try:
            yield Browser(found.new_page(viewport={"width": 1200, "height": 800}))
        finally:
            found.close()


def chromium(own: str) -> str:
    """The path of a chromium: the system's, or playwright's own."""
    for path in (shutil.which("chromium"), shutil.which("chromium-browser"), shutil.which("google-chrome"), own):
        if path is not None and os.path.exists(path):  # noqa: PTH110
            return path
    pytest.skip("there is no chromium: apt install chromium, or playwright install chromium")


async def in_browser(steps: Callable[[Browser], T]) -> T:
    """Do some steps in a new browser, in a worker thread."""

    def run() -> T:
        with browser() as opened:
            return steps(opened)

    return await anyio.to_thread.run_sync(run)
