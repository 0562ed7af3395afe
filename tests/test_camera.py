"""Pixels beside OpenCV, pictures of moving cameras, and messages of cameras."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from tfbus import Buffer, Bus, PointCloud, SimulatedClock, Transform, TransformBroadcaster, from_seconds
from tfbus.axes import BODY_FROM_OPTICAL
from tfbus.camera import Camera

pytestmark = pytest.mark.anyio

MATRIX = [[520.0, 0.0, 331.0], [0.0, 515.0, 236.5], [0.0, 0.0, 1.0]]
LENSES = [
    ("plumb_bob", ()),
    ("plumb_bob", (-0.28, 0.07, 1e-3, -5e-4, 0.01)),
    ("rational_polynomial", (0.6, -0.4, 1e-4, 2e-4, -0.05, 0.9, -0.25, -0.1)),
    ("rational_polynomial", (0.6, -0.4, 1e-4, 2e-4, -0.05, 0.9, -0.25, -0.1, 1e-3, -2e-4, 5e-4, 1e-4)),
    ("equidistant", (-0.02, 0.01, -0.005, 0.001)),
]


def points_in_view(count: int) -> npt.NDArray[np.float64]:
    random = np.random.default_rng(3)
    depth = random.uniform(0.2, 50.0, count)
    return np.stack((random.uniform(-0.6, 0.6, count) * depth, random.uniform(-0.45, 0.45, count) * depth, depth), -1)


def pixels_of_opencv(points: npt.NDArray[np.float64], model: str, lens: tuple[float, ...]) -> Any:
    cv2 = pytest.importorskip("cv2", reason="needs opencv-python-headless")
    matrix, none = np.array(MATRIX), np.zeros(3)
    if model == "equidistant":
        return cv2.fisheye.projectPoints(points[:, np.newaxis], none, none, matrix, np.array(lens))[0][:, 0]
    return cv2.projectPoints(points, none, none, matrix, np.array(lens) if lens else None)[0][:, 0]


@pytest.mark.parametrize(("model", "lens"), LENSES)
def test_pixels_are_those_of_opencv_and_lead_back_to_their_points(model: str, lens: tuple[float, ...]) -> None:
    camera, points = Camera("optical", 640, 480, MATRIX, model, lens), points_in_view(2_000)
    if model == "equidistant":
        # A fisheye sees points at 77 degrees.
        points[:, :2] *= 6.0
    pixels, depth = camera.project(points)
    assert camera.deproject(pixels, depth) == pytest.approx(points, abs=1e-8)
    rays = camera.ray(pixels)
    assert np.cross(rays, points / np.linalg.norm(points, axis=1)[:, np.newaxis]) == pytest.approx(0.0, abs=1e-9)
    assert pixels == pytest.approx(pixels_of_opencv(points, model, lens), abs=1e-9, rel=0.0)


def test_a_point_behind_the_camera_has_no_pixel_and_a_pixel_beyond_the_lens_no_ray() -> None:
    camera = Camera("optical", 640, 480, MATRIX, "plumb_bob", (-0.3,))
    pixels, depth = camera.project([[0.1, 0.1, -2.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert np.isnan(pixels[:2]).all()
    assert pixels[2].tolist() == [331.0, 236.5]
    assert depth.tolist() == [-2.0, 0.0, 1.0]
    # x (1 - 0.3 x^2) is 0.7027 at most.
    assert np.isnan(camera.ray([[331.0 + 520.0 * 0.71, 236.5]])).all()
    assert camera.ray([[331.0 + 520.0 * 0.7 * (1 - 0.3 * 0.49), 236.5]])[0] == pytest.approx(
        np.array((0.7, 0.0, 1.0)) / math.hypot(0.7, 1.0)
    )


def message(**changes: Any) -> dict[str, Any]:
    fields = {
        "header": {"stamp": {"sec": 1, "nanosec": 0}, "frame_id": "/optical"},
        "width": 640,
        "height": 480,
        "distortion_model": "plumb_bob",
        "d": [-0.28, 0.07, 1e-3, -5e-4, 0.01],
        "k": [number for row in MATRIX for number in row],
        "r": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        "p": [400.0, 0.0, 300.0, -40.0, 0.0, 400.0, 220.0, 0.0, 0.0, 0.0, 1.0, 0.0],
        "binning_x": 0,
        "binning_y": 0,
        "roi": {"x_offset": 0, "y_offset": 0, "width": 0, "height": 0, "do_rectify": False},
    }
    return {**fields, **changes}


def test_the_message_of_a_camera_says_its_pixels() -> None:
    points = points_in_view(100)
    expected = Camera("optical", 640, 480, MATRIX, "plumb_bob", (-0.28, 0.07, 1e-3, -5e-4, 0.01)).project(points)[0]
    ros1 = {name.upper() if name in "dkrp" else name: value for name, value in message().items()}
    ros1["header"], ros1["roi"] = SimpleNamespace(**ros1["header"]), SimpleNamespace(**ros1["roi"])
    for sent in (message(), SimpleNamespace(**ros1)):
        camera = Camera.from_message(sent)
        assert (camera.frame, camera.width, camera.height) == ("optical", 640, 480)
        assert camera.project(points)[0] == pytest.approx(expected)
    region = {"x_offset": 100, "y_offset": 40, "width": 320, "height": 200, "do_rectify": False}
    part = Camera.from_message(message(roi=region, binning_x=2, binning_y=4))
    assert (part.width, part.height) == (160, 50)
    assert part.project(points)[0] == pytest.approx((expected - (100.0, 40.0)) / (2.0, 4.0))


def test_the_rectified_picture_of_the_right_camera_of_a_pair_is_shifted_by_the_base_line() -> None:
    camera = Camera.from_message(message(), rectified=True)
    # 0.1 m to the left of a camera with 400 pixels a unit.
    assert camera.project([[0.5, 0.2, 2.0]])[0][0] == pytest.approx((400.0 * 0.4 / 2.0 + 300.0, 400.0 * 0.1 + 220.0))
    assert camera.deproject(*camera.project([[0.5, 0.2, 2.0]])) == pytest.approx(np.array([[0.5, 0.2, 2.0]]))


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"k": [0.0] * 9}, "not calibrated"),
        ({"distortion_model": "double_sphere"}, "'double_sphere', not one of 'plumb_bob'"),
        ({"d": [0.1] * 6}, "has 5 coefficients, got 6"),
    ],
)
def test_a_camera_that_is_not_calibrated_or_of_another_model_is_refused(changes: dict[str, Any], why: str) -> None:
    with pytest.raises(ValueError, match=why):
        Camera.from_message(message(**changes))
    with pytest.raises(ValueError, match="projection matrix P"):
        Camera.from_message(message(p=[0.0] * 12), rectified=True)


@pytest.mark.parametrize("row_time", [0.0, 50e-6])
async def test_a_scan_of_a_moving_robot_is_where_the_picture_shows_the_wall(row_time: float) -> None:
    # The robot drives to its left at 2 m/s; the lidar at its origin sees marks on a wall 5 m ahead, one each 10 ms; the
    # camera takes its picture at 0.5 s.
    marks = np.stack((np.full(50, 5.0), np.linspace(-1.0, 2.0, 50), np.linspace(-1.0, 1.0, 50)), axis=-1)
    stamps = from_seconds(0.3) + np.arange(50) * 10_000_000
    clock = SimulatedClock(start=0)
    with Bus(clock) as bus, Buffer(bus) as buffer:
        robot = TransformBroadcaster(bus, "robot")
        robot.send_static("base", "camera", Transform((0.0, 0.1, 0.0)))
        robot.send_static("camera", "optical", BODY_FROM_OPTICAL)
        for tick in range(11):
            robot.send("odom", "base", Transform((0.0, 0.2 * tick, 0.0)), at=from_seconds(0.1 * tick))
        seen = marks - np.stack((np.zeros(50), 2.0 * stamps / 1e9, np.zeros(50)), axis=-1)
        camera = Camera("optical", 640, 480, [[400.0, 0.0, 320.0], [0.0, 400.0, 240.0], [0.0, 0.0, 1.0]])
        picture = await camera.project_cloud(
            buffer,
            PointCloud("base", int(stamps[0]), seen, stamps),
            at=from_seconds(0.5),
            fixed="odom",
            row_time=row_time,
            timeout=1.0,
        )
    rows = 240.0 - 400.0 * marks[:, 2] / 5.0
    when = 0.5 + row_time * np.rint(rows)
    columns = 320.0 - 400.0 * (marks[:, 1] - 2.0 * when - 0.1) / 5.0
    assert picture.pixels == pytest.approx(np.stack((columns, rows), axis=-1), abs=1e-6)
    assert picture.depth == pytest.approx(5.0)
    assert picture.visible.tolist() == ((columns >= -0.5) & (columns < 639.5)).tolist()


async def test_a_point_that_the_polynomials_of_the_lens_fold_into_the_picture_is_not_visible() -> None:
    camera = Camera("optical", 640, 480, MATRIX, "plumb_bob", (-0.3,))
    # At x = 1.8, x (1 - 0.3 x^2) is 0.05.
    cloud = PointCloud("optical", 5, np.array([[1.8, 0.0, 1.0], [0.3, 0.0, 1.0], [0.0, 0.0, -1.0], [5.0, 0.0, 9.0]]))
    with Bus(SimulatedClock(start=0)) as bus, Buffer(bus) as buffer:
        TransformBroadcaster(bus, "rig").send_static("odom", "optical", Transform())
        picture = await camera.project_cloud(buffer, cloud, at=5, fixed="odom")
    assert 0.0 < picture.pixels[0, 0] < 640.0
    assert picture.visible.tolist() == [False, True, False, True]
