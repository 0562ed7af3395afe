"""The protocol of rosbridge over a websocket: `RosbridgeLink` to ROS, `RosbridgeServer` for web pages.

The extra is ``tfbus[rosbridge]``.
"""

from tfbus.errors import pip_install

try:
    import cbor2  # noqa: F401 - the inner modules need them
    import wsproto  # noqa: F401
except ImportError as error:
    raise ImportError(f"rosbridge needs more packages: {pip_install('rosbridge')} ({error})") from None

from tfbus.links.rosbridge.rosbridge_link import RosbridgeLink
from tfbus.links.rosbridge.rosbridge_server import RosbridgeServer

__all__ = ["RosbridgeLink", "RosbridgeServer"]
