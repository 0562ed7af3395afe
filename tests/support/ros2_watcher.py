"""Prints the other nodes that ROS 2 sees, each with the topics that it publishes; a line for each change.

`tests/integration/test_ros2.py` runs it by a Python that has rclpy. ``ros2 node list`` and ``ros2 node info`` ask the
same.
"""

import time

import rclpy
from rclpy.node import Node


def main() -> None:
    rclpy.init()
    node = Node("watcher")
    shown = None
    while True:
        found = []
        for name, namespace in node.get_node_names_and_namespaces():
            if name != "watcher":
                topics = node.get_publisher_names_and_types_by_node(name, namespace)
                found.append(" ".join([f"{namespace.rstrip('/')}/{name}", *sorted(topic for topic, _ in topics)]))
        if found != shown:
            print(*sorted(found), flush=True)
            shown = found
        time.sleep(0.1)


if __name__ == "__main__":
    main()
