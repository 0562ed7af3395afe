from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import anyio
import pytest

pytest.importorskip("viser", reason="the live page needs viser")

from support.samples import over, static, tree_of
from support.viser_pages import viser_page

from tfbus import SECOND
from tfbus.view.page import Page
from tfbus.view.screen import LARGEST, NONE, Panel


class Used:
    """A panel whose controls a test uses as a browser does."""

    def __init__(self, server: Any, live: bool) -> None:
        tree = tree_of(*over("map", "base", range(0, 11 * SECOND, SECOND)), static("base", "lidar"))
        self.page = Page(tree, live=live)
        self.panel = Panel(server, self.page, self._post)
        self.posted = 0

    def _post(self, control: Callable[[], object]) -> None:
        self.posted += 1
        control()

    def choose(self, control: Any, value: Any, client: int | None = 0) -> None:
        for callback in control._impl.update_cb:
            # A browser changes the value before the callbacks are called.
            control._impl.value = value
            anyio.run(self._call, callback, SimpleNamespace(client_id=client, target=SimpleNamespace(value=value)))

    async def _call(self, callback: Any, event: Any) -> None:
        await callback(event)

    def show(self) -> None:
        self.panel.show(self.page.texts(0, self.page.picture(0).scene))
        line = self.page.timeline
        self.panel.show_time(None if line.stamp is None else (line.stamp, line.start, line.end))


@pytest.fixture
def used() -> Iterator[Used]:
    with viser_page() as server:
        yield Used(server, live=True)


def test_what_is_chosen_reaches_the_page(used: Used) -> None:
    panel, page = used.panel, used.page
    used.choose(panel._fixed, "base")
    used.choose(panel._frame, "lidar")
    used.choose(panel._labels, "all")
    used.choose(panel._speed, "× 2")

    def choices() -> tuple[str | None, str | None, str, float]:
        return page.chosen_fixed, page.selected, page.labels, page.timeline.speed

    assert choices() == ("base", "lidar", "all", 2.0)
    used.choose(panel._fixed, LARGEST)
    used.choose(panel._frame, NONE)
    assert choices() == (None, None, "all", 2.0)


def test_what_the_program_sets_is_no_choice(used: Used) -> None:
    used.choose(used.panel._fixed, "base", client=None)
    used.show()
    assert (used.page.chosen_fixed, used.posted) == (None, 0)


def test_a_search_with_one_match_selects_it(used: Used) -> None:
    used.choose(used.panel._search, "a")
    used.show()
    assert used.panel._frame.value == NONE
    used.choose(used.panel._search, "LID")
    assert (used.page.selected, used.page.search) == ("lidar", "LID")
    used.show()
    assert used.panel._frame.options == (NONE, "lidar")
    assert used.panel._frame.value == "lidar"


def test_the_buttons_of_time_move_the_page(used: Used) -> None:
    panel, line = used.panel, used.page.timeline
    used.choose(panel._mode, "Pause")
    assert line.stamp == 10 * SECOND
    used.choose(panel._step, "◀")
    assert line.stamp == 9 * SECOND
    used.choose(panel._step, "▶")
    used.choose(panel._slider, 2.5)
    assert line.stamp == 2_500_000_000
    used.choose(panel._mode, "Play")
    assert line.playing
    used.choose(panel._slider, 3.0)
    assert (line.playing, line.stamp) == (False, 3 * SECOND)
    used.choose(panel._mode, "Live")
    assert line.stamp is None


def test_the_slider_shows_the_chosen_stamp(used: Used) -> None:
    used.show()
    assert used.panel._slider.disabled
    used.page.freeze()
    used.page.timeline.seek(4 * SECOND)
    used.show()
    slider = used.panel._slider
    assert (slider.disabled, slider.max, slider.value) == (False, 10.0, 4.0)


def test_a_chosen_frame_that_is_gone_stays_chosen(used: Used) -> None:
    used.page.choose_fixed("gone")
    used.page.select("lost")
    used.show()
    assert used.panel._fixed.value == "gone"
    assert used.panel._frame.value == "lost"


def test_a_frame_with_the_name_of_a_choice_is_offered_once(used: Used) -> None:
    used.page.tree.insert(static("map", NONE))
    used.page.tree.insert(static("map", LARGEST))
    used.show()
    assert used.panel._frame.options.count(NONE) == 1
    assert used.panel._fixed.options.count(LARGEST) == 1


def test_a_recording_offers_no_live_data() -> None:
    with viser_page() as server:
        assert Used(server, live=False).panel._mode.options == ("Pause", "Play")
