"""A ROS 2 node with zenoh-ros2-sdk, for the tests of `tfbus.links.rmw_zenoh`, in a process of its own.

It does what `ros_driver.py` says, and sends the static ``base:laser``, x = 0.5, which late joiners do not get: the SDK
cannot do that. Its own subscription to /tf_static has what was said before. ``ROUTER_PORT`` and ``ROS_DOMAIN_ID`` are
its settings.
"""

import os
import time
from typing import Any

from ros_driver import Chain, Driver  # type: ignore[import-not-found]
from rosbags.typesys import Stores, get_typestore
from zenoh_ros2_sdk import ROS2Publisher, ROS2Subscriber
from zenoh_ros2_sdk.qos import QosDurability, QosProfile
from zenoh_ros2_sdk.session import ZenohSession

TYPE = "tf2_msgs/msg/TFMessage"


def main() -> None:
    driver, chain = Driver(), Chain()
    port = int(os.environ["ROUTER_PORT"])
    # By itself, it fetches the definitions of messages from the net.
    session = ZenohSession.get_instance("127.0.0.1", port)
    session.store = get_typestore(Stores.ROS2_JAZZY)
    session._registered_types[TYPE] = TYPE
    where = {
        "router_port": port,
        "domain_id": int(os.environ["ROS_DOMAIN_ID"]),
        "type_hash": session.store.hash_rihs01(TYPE),
    }
    latched = QosProfile(durability=QosDurability.TRANSIENT_LOCAL)

    def hear(static: bool, message: Any) -> None:
        for each in message.transforms:
            stamp = each.header.stamp.sec * 10**9 + each.header.stamp.nanosec
            chain.take(each.header.frame_id, each.child_frame_id, stamp, each.transform.translation.x, static)
            driver.hear(each.child_frame_id, stamp)

    subscriptions = [
        ROS2Subscriber("/tf", TYPE, lambda message: hear(False, message), **where),
        ROS2Subscriber("/tf_static", TYPE, lambda message: hear(True, message), qos=latched, **where),
    ]
    moving = ROS2Publisher("/tf", TYPE, **where)
    statics = ROS2Publisher("/tf_static", TYPE, qos=latched, **where)
    types = session.store.types
    stamped, transform, vector, quaternion = (
        types[f"geometry_msgs/msg/{name}"] for name in ("TransformStamped", "Transform", "Vector3", "Quaternion")
    )
    header, stamp_type = types["std_msgs/msg/Header"], types["builtin_interfaces/msg/Time"]

    def publish(publisher: Any, parent: str, child: str, stamp: int, x: float) -> None:
        sec, nanosec = divmod(stamp, 10**9)
        row = stamped(
            header=header(stamp=stamp_type(sec=sec, nanosec=nanosec), frame_id=parent),
            child_frame_id=child,
            transform=transform(translation=vector(x=x, y=0.0, z=0.0), rotation=quaternion(x=0.0, y=0.0, z=0.0, w=1.0)),
        )
        publisher.publish(transforms=[row])

    publish(statics, "base", "laser", time.time_ns(), driver.x)
    driver.run(lambda stamp, x: publish(moving, "odom", "base", stamp, x), chain.ask)
    for subscription in subscriptions:
        subscription.close()


if __name__ == "__main__":
    main()
