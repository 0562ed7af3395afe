"""A ROS 2 node with zenoh-ros2-sdk, for the tests of `tfbus.links.rmw_zenoh`, in a process of its own.

It publishes ``odom:base`` on /tf a hundred times, 50 a second, and then says how many transforms of ``arm`` have come.
The SDK sends no message that late joiners get, so it has no static frames. Its argument is the port of the router.
"""

import json
import sys
import time
from typing import Any

from rosbags.typesys import Stores, get_typestore
from zenoh_ros2_sdk import ROS2Publisher, ROS2Subscriber
from zenoh_ros2_sdk.session import ZenohSession

TYPE = "tf2_msgs/msg/TFMessage"


def main() -> None:
    port, domain = int(sys.argv[1]), int(sys.argv[2])
    # By itself, it fetches the definitions of messages from the net.
    session = ZenohSession.get_instance("127.0.0.1", port)
    session.store = get_typestore(Stores.ROS2_JAZZY)
    session._registered_types[TYPE] = TYPE
    where = {"router_port": port, "domain_id": domain, "type_hash": session.store.hash_rihs01(TYPE)}
    heard: list[tuple[str, str, float]] = []

    def hear(message: Any) -> None:
        heard.extend(
            (each.header.frame_id, each.child_frame_id, each.transform.translation.x) for each in message.transforms
        )

    subscription = ROS2Subscriber("/tf", TYPE, hear, **where)
    publisher = ROS2Publisher("/tf", TYPE, **where)
    types = session.store.types
    stamped, transform, vector, quaternion = (
        types[f"geometry_msgs/msg/{name}"] for name in ("TransformStamped", "Transform", "Vector3", "Quaternion")
    )
    header, stamp = types["std_msgs/msg/Header"], types["builtin_interfaces/msg/Time"]
    print(json.dumps({"event": "up"}), flush=True)
    for number in range(100):
        sec, nanosec = divmod(time.time_ns(), 10**9)
        row = stamped(
            header=header(stamp=stamp(sec=sec, nanosec=nanosec), frame_id="odom"),
            child_frame_id="base",
            transform=transform(
                translation=vector(x=float(number), y=0.0, z=0.0), rotation=quaternion(x=0.0, y=0.0, z=0.0, w=1.0)
            ),
        )
        publisher.publish(transforms=[row])
        time.sleep(0.02)
    arms = [x for parent, child, x in heard if (parent, child) == ("base", "arm")]
    print(json.dumps({"event": "end", "arms": arms}), flush=True)
    del subscription


if __name__ == "__main__":
    main()
