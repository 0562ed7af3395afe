import pytest

pytest.importorskip("matplotlib", reason="plots need matplotlib")

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from tfbus.plot.plots import show_in_window


@pytest.mark.parametrize(("display", "why"), [("", "there is no display"), (":0", "has no window here")])
def test_without_a_window_nothing_is_drawn(display: str, why: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plt, "get_backend", lambda: "agg")
    monkeypatch.setenv("DISPLAY", display)
    with pytest.raises(RuntimeError, match=why):
        show_in_window(lambda _: pytest.fail("drawn"))


def test_the_figure_is_drawn_and_then_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[object] = []
    plt.switch_backend("agg")
    monkeypatch.setattr(plt, "get_backend", lambda: "tkagg")
    monkeypatch.setattr(plt, "show", lambda: drawn.append("shown"))
    show_in_window(drawn.append)
    figure, last = drawn
    assert isinstance(figure, Figure)
    assert last == "shown"
    plt.close("all")
