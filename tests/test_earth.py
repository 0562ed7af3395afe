"""Places on the earth, beside pyproj; and a local map."""

import math

import numpy as np
import pytest

from tfbus import Buffer, Bus, NavSatFix, Transform
from tfbus.earth import Datum, from_ecef, to_ecef

MICROMETRE = 1e-6
POLE = 6_356_752.314245


def places() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Everywhere on the earth, poles and equator included, from the bottom of the sea to satellites."""
    random = np.random.default_rng(5)
    latitude = np.concatenate((random.uniform(-90.0, 90.0, 20_000), [90.0, -90.0, 0.0, 1e-9, 89.999_999_999]))
    longitude = random.uniform(-180.0, 180.0, len(latitude))
    height = random.choice([-11_000.0, 0.0, 450.0, 400_000.0, 36_000_000.0], len(latitude))
    return latitude, longitude, height


def test_earth_centred_coordinates_are_those_of_pyproj() -> None:
    pyproj = pytest.importorskip("pyproj", reason="needs pyproj")
    latitude, longitude, height = places()
    there = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978")
    expected = np.stack(there.transform(latitude, longitude, height), axis=-1)
    assert np.abs(to_ecef(latitude, longitude, height) - expected).max() < MICROMETRE
    ours = from_ecef(expected)
    assert np.abs(ours[2] - height).max() < MICROMETRE
    metres = np.radians(ours[0] - latitude) * 6.4e6
    assert np.abs(metres).max() < MICROMETRE
    assert np.abs(to_ecef(*ours) - expected).max() < MICROMETRE


def test_the_poles_the_equator_and_the_centre() -> None:
    assert to_ecef(90.0, 123.0, 10.0) == pytest.approx((0.0, 0.0, POLE + 10.0), abs=MICROMETRE)
    assert from_ecef((0.0, 0.0, -POLE)) == pytest.approx((-90.0, 0.0, 0.0), abs=MICROMETRE)
    assert from_ecef((0.0, 6_378_137.0, 0.0)) == pytest.approx((0.0, 90.0, 0.0), abs=1e-9)
    assert all(math.isnan(number) for number in from_ecef((10.0, 0.0, 10.0))[::2])


def test_a_local_map_has_east_north_and_up_at_its_datum() -> None:
    datum = Datum(48.0, 11.0, 500.0)
    step = 1e-7
    # The radii of curvature of the ellipsoid: north along the meridian, east across it.
    e2 = 0.006_694_379_990_141_316
    w = math.sqrt(1.0 - e2 * math.sin(math.radians(48.0)) ** 2)
    north = math.radians(step) * (6_378_137.0 * (1.0 - e2) / w**3 + 500.0)
    east = math.radians(step) * (6_378_137.0 / w + 500.0) * math.cos(math.radians(48.0))
    assert datum.to_map(48.0 + step, 11.0, 500.0) == pytest.approx((0.0, north, 0.0), abs=1e-7)
    assert datum.to_map(48.0, 11.0 + step, 500.0) == pytest.approx((east, 0.0, 0.0), abs=1e-7)
    assert datum.to_map(48.0, 11.0, 502.0) == pytest.approx((0.0, 0.0, 2.0), abs=MICROMETRE)
    ned = Datum(48.0, 11.0, 500.0, ned=True)
    assert ned.to_map(48.0 + step, 11.0, 501.0) == pytest.approx((north, 0.0, -1.0), abs=MICROMETRE)
    points = np.random.default_rng(1).uniform(-5_000.0, 5_000.0, (100, 3))
    assert datum.to_map(*datum.from_map(points)) == pytest.approx(points, abs=MICROMETRE)


def test_a_fix_is_a_point_of_the_map_and_the_map_hangs_below_the_earth() -> None:
    datum = Datum(48.0, 11.0, 500.0)
    fix = NavSatFix("gps", 5, 48.001, 11.0, 500.0)
    point = datum.point(fix)
    assert (point.frame, point.stamp) == ("map", 5)
    with Bus() as bus, Buffer(bus) as buffer:
        bus.publish(datum.sample())
        found = buffer.transform_nowait(point, "earth")
    assert found.point == pytest.approx(to_ecef(48.001, 11.0, 500.0), abs=MICROMETRE, rel=0.0)
    with pytest.raises(ValueError, match="no position"):
        datum.point(NavSatFix("gps", 5, 0.0, 0.0, 0.0, status=-1))
    with pytest.raises(ValueError, match="latitude from -90 to 90"):
        Datum(91.0, 0.0)
    assert Datum(0.0, 0.0).earth_from_map.is_close(
        Transform((6_378_137.0, 0.0, 0.0), (0.5, 0.5, 0.5, 0.5)), translation_tolerance=MICROMETRE
    )
