"""The link between the processes of one user on one machine; it needs no other program, no port and no extra."""

from tfbus.links.local.local_link import LocalLink

__all__ = ["LocalLink"]
