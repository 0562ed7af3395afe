"""Links to ROS 1 and ROS 2 through rosbridge, a websocket: `RosbridgeLink`, with the extra ``tfbus[rosbridge]``."""

try:
    import cbor2  # noqa: F401 - the inner modules need them
    import wsproto  # noqa: F401
except ImportError as error:
    raise ImportError(
        f'a link through rosbridge needs more packages: pip install "tfbus[rosbridge]" ({error})'
    ) from None

from tfbus.links.rosbridge.rosbridge_link import RosbridgeLink

__all__ = ["RosbridgeLink"]
