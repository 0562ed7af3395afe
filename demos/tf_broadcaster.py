"""The first of the tutorial's two programs: it publishes the pose of the robot's laser 100 times a second.

Run it with `python demos/tf_broadcaster.py`, and `python demos/tf_listener.py` in another terminal, in any order. Kill
either program and start it again: the other one goes on by itself. Ctrl-C ends it. Programs on this machine find each
other; an argument names another domain. `tfbus broadcast` does the same with options.
"""

import sys

import anyio

import tfbus


async def main(domain: str) -> None:
    with tfbus.Bus() as bus:
        # On a shared domain, an edge of another program must not end this one: refused samples are left out.
        broadcaster = tfbus.TransformBroadcaster(bus, authority="robot_tf_publisher", invalid="drop")
        # The laser is mounted 0.1 m forward of the robot's base, and 0.2 m above it.
        base_from_laser = tfbus.Transform(translation=(0.1, 0.0, 0.2))
        async with tfbus.LocalLink(bus, domain):
            async for _ in bus.clock.ticks(100.0):
                broadcaster.send("base_link", "base_laser", base_from_laser)


if __name__ == "__main__":
    try:
        anyio.run(main, sys.argv[1] if len(sys.argv) > 1 else "tf")
    except KeyboardInterrupt:
        raise SystemExit(130) from None
