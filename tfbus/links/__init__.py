"""Links join a bus to the buses of other processes, and to other worlds such as ROS.

Each kind of link has a room of its own and needs an extra of its own: ``tfbus.links.zenoh`` joins buses to buses,
``tfbus.links.dds``, ``tfbus.links.rosbridge`` and ``tfbus.links.rmw_zenoh`` join them to ROS. All of them are a `Link`
over a network: the link knows the bus, its peers and what passed already; a `tfbus.links.wire.Wire` or a
`tfbus.links.carrier.Carrier` knows one network.
"""

from tfbus.links.link import Link

__all__ = ["Link"]
