"""A boat drives a circle of 50 m and reports fixes and NED headings; its map is ENU, as maps of ROS are.

The boat's place is shown in the map, and the buoy that it sees 20 m ahead as latitude and longitude.
"""

import math

import anyio

import tfbus
from tfbus.axes import ENU_FROM_NED, FRD_FROM_FLU
from tfbus.earth import Datum

DATUM = Datum(54.3213, 10.1348, 40.0)


def fixes() -> list[tuple[int, tfbus.NavSatFix, float]]:
    """A stamp, a fix and the heading in degrees, clockwise from north, at each tenth of the circle."""
    found = []
    for step in range(10):
        angle = math.tau * step / 10
        # To the north first, and then to the left.
        latitude, longitude, height = DATUM.from_map((50.0 * math.cos(angle), 50.0 * math.sin(angle), 1.0))
        stamp = tfbus.from_seconds(step)
        found.append((stamp, tfbus.NavSatFix("gps", stamp, latitude, longitude, height), -math.degrees(angle)))
    return found


async def main() -> None:
    with tfbus.Bus(tfbus.SimulatedClock()) as bus, tfbus.Buffer(bus) as buffer:
        boat = tfbus.TransformBroadcaster(bus, "receiver")
        bus.publish(DATUM.sample("map"))
        for stamp, fix, heading in fixes():
            place = DATUM.point(fix).point
            ned_from_frd = tfbus.Transform.from_euler("ZYX", (heading, 0.0, 0.0), degrees=True)
            enu_from_flu = ENU_FROM_NED @ ned_from_frd @ FRD_FROM_FLU
            boat.send("map", "base_link", tfbus.Transform(place, enu_from_flu.rotation), at=stamp)
            buoy = tfbus.PointStamped("base_link", stamp, (20.0, 0.0, 0.0))
            in_map = await buffer.transform(buoy, "map", timeout=1.0)
            latitude, longitude, _ = DATUM.from_map(in_map.point)
            print(
                f"at ({place[0]:6.1f}, {place[1]:6.1f}) m, heading {heading % 360:3.0f}: {latitude:.6f} {longitude:.6f}"
            )


if __name__ == "__main__":
    anyio.run(main)
