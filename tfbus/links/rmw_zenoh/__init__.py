"""Links to ROS 2 over zenoh, as its middleware rmw_zenoh speaks it: `RmwZenohLink`, with the extra ``tfbus[zenoh]``."""

from tfbus.errors import pip_install

try:
    import zenoh  # noqa: F401 - the inner modules need it
except ImportError:
    raise ImportError(f"a link to rmw_zenoh needs one more package: {pip_install('zenoh')}") from None

from tfbus.links.rmw_zenoh.rmw_zenoh_link import RmwZenohLink

__all__ = ["RmwZenohLink"]
