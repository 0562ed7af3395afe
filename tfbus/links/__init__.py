"""Links join a bus to the buses of other processes, and to other worlds such as ROS.

`tfbus.LocalLink` joins the processes of one machine, ``tfbus.links.zenoh`` those of several; both are a `DomainLink`,
and over both a `BufferServer` answers the lookups of others. ``tfbus.links.dds``, ``tfbus.links.rosbridge`` and
``tfbus.links.rmw_zenoh`` join buses to ROS. Each of them but the first needs an extra.

A message passes wire or carrier, the link's queue, its end, the relay of the bus, and is on the bus.
"""

from tfbus.links.link import DomainLink, Link
from tfbus.links.lookups import BufferServer

__all__ = ["BufferServer", "DomainLink", "Link"]
