"""Ten thousand positions and a few velocities of a tool, from a tree that has never seen an event loop.

A turntable drives along x at 0.5 m/s and turns at 1 rad/s; a tool is fixed to it, 2 m from the axis. So the tool moves
on a cycloid: its position and velocity have closed forms, which are printed beside the answers of the tree.

Run it with `python demos/path_and_velocity.py`.
"""

import cmath
import math

import numpy as np

import tfbus

SPEED, TURN, ARM = 0.5, 1.0, 2.0


def drive() -> tfbus.TransformTree:
    """Ten seconds of samples at 100 Hz, all of them kept."""
    tree = tfbus.TransformTree(keep=None)
    tree.insert(tfbus.TransformStamped("table", "tool", 0, tfbus.Transform((ARM, 0.0, 0.0)), static=True))
    for tick in range(1001):
        seconds = tick / 100
        place = tfbus.Transform.from_axis_angle((0, 0, 1), TURN * seconds, (SPEED * seconds, 0.0, 0.0))
        tree.insert(tfbus.TransformStamped("map", "table", tfbus.from_seconds(seconds), place, "encoder"))
    return tree


def closed_form(seconds: float) -> tuple[complex, complex]:
    """Position and velocity of the tool, the map's plane taken for the complex one."""
    arm = ARM * cmath.exp(1j * TURN * seconds)
    return SPEED * seconds + arm, SPEED + 1j * TURN * arm


def main() -> None:
    tree = drive()
    stamps = np.linspace(0, 10 * tfbus.SECOND, 10_001).astype(np.int64)
    path = tree.lookup_many("map", "tool", stamps)
    length = np.linalg.norm(np.diff(path.translations, axis=0), axis=1).sum()
    print(f"{len(path)} positions, a path of {length:.3f} m")

    for second in (1, 3, 5):
        twist = tree.twist("tool", "map", second * tfbus.SECOND)
        velocity = closed_form(second)[1]
        print(
            f"at {second} s: {math.hypot(*twist.linear):.3f} m/s, by the closed form {abs(velocity):.3f} m/s; "
            f"{twist.angular[2]:.3f} rad/s"
        )

    # The same body, told at another of its frames: only a twist in the frame's own axes may be moved.
    table = tree.twist("table", "map", 5 * tfbus.SECOND, expressed_in="table")
    tool = tfbus.do_transform(table, tree.lookup("tool", "table", table.stamp))
    print(f"the table at {math.hypot(*table.linear):.3f} m/s carries the tool at {math.hypot(*tool.linear):.3f} m/s")

    late = tree.lookup_many("map", "tool", [5 * tfbus.SECOND, 11 * tfbus.SECOND], out_of_range="nan")
    print(f"at 5 s and 11 s there is an answer: {late.valid.tolist()}")


if __name__ == "__main__":
    main()
