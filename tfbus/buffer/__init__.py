"""The buffer: a tree that a bus fills, lookups that wait for data, and watches that follow a transform."""

from tfbus.buffer.buffer import Buffer
from tfbus.buffer.watch import Watch

__all__ = ["Buffer", "Watch"]
