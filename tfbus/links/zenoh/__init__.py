"""Links over zenoh, peer to peer or through a router: `ZenohLink`, with the extra ``tfbus[zenoh]``."""

from tfbus.links.zenoh.router import ZenohRouter
from tfbus.links.zenoh.zenoh_link import ZenohLink

__all__ = ["ZenohLink", "ZenohRouter"]
