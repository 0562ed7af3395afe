import numpy as np
import pytest

pytest.importorskip("viser", reason="the live page needs viser")

from support.samples import moving, static, tree_of
from support.viser_pages import viser_page

from tfbus import LATEST, SECOND, PointCloud
from tfbus.view.page import Page
from tfbus.view.screen import Points, Screen


def shown(page: Page, server: object) -> Screen:
    return Screen(server, page, (), lambda control: control())  # type: ignore[arg-type]


def draw(screen: Screen, elapsed: int, texts: bool = False) -> None:
    screen.show(screen.read(0, elapsed, texts))


def test_the_texts_are_written_at_once_if_wanted_else_twice_a_second() -> None:
    tree = tree_of(static("map", "base", 1.0))
    page = Page(tree)
    with viser_page() as server:
        screen = shown(page, server)
        draw(screen, 10 * SECOND)
        page.select("base")
        draw(screen, 10 * SECOND + SECOND // 4)
        assert "Click" in screen._panel._selection.content
        draw(screen, 10 * SECOND + SECOND // 2)
        assert "base" in screen._panel._selection.content
        page.select(None)
        draw(screen, 10 * SECOND + SECOND // 2, texts=True)
        assert "Click" in screen._panel._selection.content


def test_the_first_frames_decide_the_camera_and_the_length_of_the_axes() -> None:
    tree = tree_of(static("map", "a", 4.0), static("map", "b", -2.0))
    with viser_page() as server:
        screen = shown(Page(tree), server)
        draw(screen, 0, texts=True)
        # A quarter of the mean of 4 m and 2 m.
        assert screen._panel.axes_length.value == pytest.approx(0.75)
        assert server.initial_camera.look_at.tolist() == [1.0, 0.0, 0.0]
        tree.insert(static("map", "c", 100.0))
        draw(screen, 0, texts=True)
        assert server.initial_camera.look_at.tolist() == [1.0, 0.0, 0.0]


def test_points_with_a_stamp_stay_where_their_frame_was_and_others_move_with_it() -> None:
    tree = tree_of(moving("map", "base", 0, 1.0), static("map", "site", 1.0), keep=5.0)
    page = Page(tree)
    points = np.zeros((2, 3))
    with viser_page() as server:
        screen = shown(page, server)
        screen.set_points(
            {
                "then": Points(PointCloud("base", 0, points), 0.1, (1, 2, 3)),
                "now": Points(PointCloud("base", LATEST, points), 0.1, (1, 2, 3)),
                "never": Points(PointCloud("nobody", LATEST, points), 0.1, (1, 2, 3)),
            }
        )

        def places() -> dict[str, float | None]:
            draw(screen, 0)
            clouds = screen._canvas._clouds
            return {name: cloud.position[0] if cloud.visible else None for name, cloud in clouds.items()}

        assert places() == {"then": 1.0, "now": 1.0, "never": None}
        # The stamp leaves the history.
        tree.insert(moving("map", "base", 9 * SECOND, 2.0))
        assert places() == {"then": 1.0, "now": 2.0, "never": None}
        page.choose_fixed("site")
        assert places() == {"then": None, "now": 1.0, "never": None}
        screen.set_points({})
        assert places() == {}
