"""A real browser; tests that use it are skipped where there is none."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

PATIENCE = 30.0
"""Seconds; drawing without a graphics card is slow."""
_ARGUMENTS = (
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--no-sandbox",
    # A page must not load anything from elsewhere.
    "--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1",
)


@contextmanager
def browser() -> Iterator[Any]:
    """A chromium of playwright, for a thread without an event loop."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="a real browser needs playwright")
    with sync_api.sync_playwright() as player:
        found = player.chromium.launch(executable_path=chromium(player.chromium.executable_path), args=_ARGUMENTS)
        try:
            yield found
        finally:
            found.close()


def chromium(own: str) -> str:
    """The path of a chromium: the system's, or playwright's own."""
    for path in (shutil.which("chromium"), shutil.which("chromium-browser"), shutil.which("google-chrome"), own):
        if path is not None and os.path.exists(path):  # noqa: PTH110
            return path
    pytest.skip("there is no chromium: apt install chromium, or playwright install chromium")
