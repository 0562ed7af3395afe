"""Links over zenoh, peer to peer or through a router, and lookups in other processes; with ``tfbus[zenoh]``."""

from tfbus.errors import pip_install

try:
    import zenoh  # noqa: F401 - the inner modules need it
except ImportError:
    raise ImportError(f"a link over zenoh needs a package more: {pip_install('zenoh')}") from None

from tfbus.links.zenoh.buffer_client import BufferClient
from tfbus.links.zenoh.buffer_server import BufferServer
from tfbus.links.zenoh.router import ZenohRouter
from tfbus.links.zenoh.zenoh_link import ZenohLink

__all__ = ["BufferClient", "BufferServer", "ZenohLink", "ZenohRouter"]
