"""Links to ROS 2 over DDS, without ROS: `DdsLink`, with the extra ``tfbus[dds]``."""

from tfbus.errors import pip_install

try:
    import cyclonedds  # noqa: F401 - the inner modules need it
except ImportError:
    raise ImportError(f"a link over DDS needs one more package: {pip_install('dds')}") from None

from tfbus.links.dds.dds_link import DdsLink

__all__ = ["DdsLink"]
