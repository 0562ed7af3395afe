"""The side panel of the page, in viser: what people choose, and what they read."""

from collections.abc import Awaitable, Callable
from typing import Any, Protocol

import viser

from tfbus.plain import printable
from tfbus.stamps import SECOND, from_seconds
from tfbus.view._page import Page, Texts
from tfbus.view._timeline import SPEEDS

LARGEST = "(root of the largest tree)"
NONE = "(none)"
_SLIDER_STEP = 0.001
"""s."""


class Post(Protocol):
    """A function that has another one called on the event loop, and the page drawn anew."""

    def __call__(self, control: Callable[[], object], /) -> None: ...


class Panel:
    """The controls and texts of a page.

    Parameters
    ----------
    server : viser.ViserServer
    page : Page
        Changed by the controls, through `post`.
    post : callable
        May be called in any thread.
    """

    def __init__(self, server: viser.ViserServer, page: Page, post: Post) -> None:
        self._page = page
        self._post = post
        gui = server.gui
        self._status = gui.add_html("")
        self._fixed = gui.add_dropdown("Fixed frame", (LARGEST,), hint="The frame that stands still")
        self._search = gui.add_text("Search", "", hint="Part of the name of a frame")
        self._frame = gui.add_dropdown("Frame", (NONE,), hint="The selected frame; those that match the search")
        with gui.add_folder("Selected frame"):
            self._selection = gui.add_html("")
            trail = gui.add_button("Trail on or off", hint="Draw where this frame was in the last ten seconds")
        with gui.add_folder("Time"):
            names = ("Live", "Pause", "Play") if page.live else ("Pause", "Play")
            self._mode = gui.add_button_group("Mode", names)
            self._step = gui.add_button_group("Step", ("◀", "▶"), hint="To the sample before, or the next one")
            self._speed = gui.add_dropdown("Speed", tuple(f"× {speed:g}" for speed in SPEEDS), initial_value="× 1")
            self._slider = gui.add_slider(
                "Time [s]", 0.0, 1.0, _SLIDER_STEP, 0.0, disabled=page.live, hint="Seconds from the oldest sample"
            )
        with gui.add_folder("Show"):
            self._labels = gui.add_dropdown("Labels", ("selection", "all", "none"))
            self.axes_length = gui.add_slider("Axes [m]", 0.01, 2.0, 0.01, 0.2)
            self.robot = gui.add_slider(
                "Robot", 0.0, 1.0, 0.05, 0.5, visible=False, hint="Opacity of the robot: 0 hides it"
            )
        with gui.add_folder("Tree"):
            self._tree = gui.add_html("")
        with gui.add_folder("Events"):
            self._events = gui.add_html("")
        self._chosen(self._fixed, lambda value: page.choose_fixed(None if value == LARGEST else self._named(value)))
        self._chosen(self._frame, lambda value: page.select(None if value == NONE else self._named(value)))
        self._chosen(self._search, self._find)
        self._chosen(self._labels, lambda value: setattr(page, "labels", value))
        self._chosen(
            self._speed, lambda value: setattr(page.timeline, "speed", SPEEDS[self._speed.options.index(value)])
        )
        self._chosen(self._slider, self._seek)
        self._chosen(self.axes_length, lambda _: None)
        self._chosen(self.robot, lambda _: None)
        modes = {"Live": page.go_live, "Pause": page.freeze, "Play": page.play}
        self._pressed(self._mode, lambda value: modes[value]())
        self._pressed(self._step, lambda value: page.step(value == "▶"))
        self._pressed(trail, lambda _: page.toggle_trail())

    def show(self, texts: Texts) -> None:
        """Bring the panel to these texts."""
        self._status.content = texts.status
        self._selection.content = texts.selection
        self._tree.content = texts.tree
        self._events.content = texts.events
        _choices(self._fixed, LARGEST, texts.frames, texts.fixed)
        _choices(self._frame, NONE, texts.matches, texts.selected)

    def show_time(self, chosen: tuple[int, int, int] | None) -> None:
        """Bring the slider to the chosen stamp of a span, which begins and ends at two others, in ns."""
        self._slider.disabled = chosen is None
        if chosen is not None:
            stamp, start, end = chosen
            length = max((end - start) / SECOND, _SLIDER_STEP)
            if self._slider.max != length:
                self._slider.max = length
            set_value(self._slider, (stamp - start) / SECOND)

    def _chosen(self, control: Any, choose: Callable[[Any], object]) -> None:
        """Call a function on the event loop with each value that somebody chooses in a browser."""
        control.on_update(self._callback(choose))

    def _pressed(self, control: Any, choose: Callable[[Any], object]) -> None:
        """Call a function on the event loop with the name of each button that somebody presses."""
        control.on_click(self._callback(choose))

    def _callback(self, choose: Callable[[Any], object]) -> Callable[[Any], Awaitable[None]]:
        # viser calls an async function on its own loop, in the order of the events, and others in many threads.
        async def used(event: Any) -> None:
            # What the program itself sets has no client.
            if event.client_id is not None:
                value = event.target.value
                self._post(lambda: choose(value))

        return used

    def _named(self, shown: str) -> str:
        """The frame that an option stands for."""
        tree = self._page.tree
        return shown if shown in tree else next((frame for frame in tree.frames() if printable(frame) == shown), shown)

    def _find(self, text: str) -> None:
        page = self._page
        page.search = text
        matches = [frame for frame in page.tree.frames() if text.casefold() in frame.casefold()]
        if len(matches) == 1 and text:
            page.select(matches[0])

    def _seek(self, seconds: float) -> None:
        line = self._page.timeline
        line.pause()
        line.seek(line.start + from_seconds(seconds))


def _choices(dropdown: viser.GuiDropdownHandle[str], first: str, names: tuple[str, ...], chosen: str | None) -> None:
    """Offer the names, with the chosen one even if it is none of them."""
    # A browser takes no option twice.
    names = tuple(dict.fromkeys(map(printable, names)))
    options = (first, *(name for name in names if name != first))
    shown = first if chosen is None else printable(chosen)
    if shown not in options:
        options = (*options, shown)
    if dropdown.options != options:
        dropdown.options = options
    set_value(dropdown, shown)


def set_value(control: Any, value: Any) -> None:
    """Set the value of a control of viser, whose types call it read-only."""
    control.value = value
