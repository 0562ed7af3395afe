"""Links to other machines by zenoh's routers; with ``tfbus[zenoh]``."""

from tfbus.errors import pip_install

try:
    import zenoh  # noqa: F401 - the inner modules need it
except ImportError:
    raise ImportError(f"a link over zenoh needs one more package: {pip_install('zenoh')}") from None

from tfbus.links.zenoh.zenoh_link import ZenohLink
from tfbus.links.zenoh.zenoh_router import ZenohRouter

__all__ = ["ZenohLink", "ZenohRouter"]
