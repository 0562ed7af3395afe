"""Links to ROS 2 over DDS, without ROS: `DdsLink`, with the extra ``tfbus[dds]``."""

try:
    import cyclonedds  # noqa: F401 - the inner modules need it
except ImportError:
    raise ImportError('a link over DDS needs one more package: pip install "tfbus[dds]"') from None

from tfbus.links.dds.dds_link import DdsLink

__all__ = ["DdsLink"]
