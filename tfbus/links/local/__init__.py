"""The wire between the processes of one user on one machine; it needs no other program, no port and no extra."""

from tfbus.links.local.local_wire import LocalWire

__all__ = ["LocalWire"]
