"""Say how sure an answer is: a robot picks a bottle after 30 s of odometry that drifts.

The robot drives along x at 0.5 m/s. Its odometry gathers an error with each step, its localisation knows the start to
2 cm and half a degree, and its arm is mounted with a calibration of 1 mm. It sees a bottle, drives on for a second, and
asks three things: where is the bottle in the map, where is it from the robot now, and how much of each error is from
which edge?

Run it with `python demos/how_sure.py`. It ends at once and always prints the same.
"""

import anyio

import tfbus
from tfbus import Covariance, Transform, from_seconds
from tfbus.geometry.covariance import compose_jacobians

RATE = 10
STEP = Transform((0.5 / RATE, 0.0, 0.0))
SLIP = Covariance.of(xyz=(0.002, 0.001, 0.0), rpy=(0.0, 0.0, 0.001))


def drive(odometry: tfbus.TransformBroadcaster, seconds: int) -> None:
    """Send the odometry, each pose with the covariance of all slips until then."""
    pose, error = Transform(), Covariance.of()
    for tick in range(RATE * seconds + 1):
        odometry.send("odom", "base", pose, from_seconds(tick / RATE), covariance=error, kind="drift")
        older, newer = compose_jacobians(pose, STEP)
        error = Covariance(older @ error.matrix @ older.T + newer @ SLIP.matrix @ newer.T)
        pose = pose @ STEP


def tell(what: str, covariance: Covariance) -> None:
    x, y, z = (1000.0 * covariance.sigmas[:3]).tolist()
    print(f"{what:24} {x:5.1f} mm along x, {y:5.1f} mm along y, {z:3.1f} mm along z")


async def main() -> None:
    with tfbus.Bus(tfbus.SimulatedClock()) as bus, tfbus.Buffer(bus, keep=60.0) as buffer:
        robot = tfbus.TransformBroadcaster(bus, "robot")
        robot.send_static("map", "odom", Transform(), covariance=Covariance.of((0.02, 0.02, 0.0), (0.0, 0.0, 0.009)))
        robot.send_static("base", "camera", Transform((0.2, 0.0, 0.5)), covariance=Covariance.of(xyz=0.001))
        drive(robot, 30)

        seen = tfbus.PointStamped("camera", from_seconds(29), (2.0, 0.0, 0.0))
        in_map = await buffer.transform(seen, "map", covariance=True)
        x, y, z = (1000.0 * in_map.covariance.diagonal() ** 0.5).tolist()
        print(f"{'bottle in the map':24} {x:5.1f} mm along x, {y:5.1f} mm along y, {z:3.1f} mm along z")

        # The camera of a second ago, seen from the camera now: only the drift of that second counts.
        now = from_seconds(30)
        moved = buffer.lookup_nowait("camera", "camera", now, source_at=seen.stamp, fixed="odom", covariance=True)
        tell("camera, a second ago", moved.covariance)
        in_camera = await buffer.transform(seen, "camera", at=now, fixed="odom", covariance=True)
        print(f"{'bottle from here':24} sigma of y {1000.0 * in_camera.covariance[1, 1] ** 0.5:.1f} mm")

        found = buffer.lookup_nowait("map", "camera", covariance=True)
        for share in found.shares():
            part = share.matrix[1, 1] / found.covariance.matrix[1, 1]
            print(f"{part:4.0%} of the variance along y is from {share.parent} -> {share.child}")


if __name__ == "__main__":
    anyio.run(main)
