"""Comparison of two trees: how far the trajectory of a frame in one is from that in the other.

`compare` gives the absolute and the relative pose error over time, as the benchmarks for SLAM define them.
"""

from tfbus.comparison.alignment import Alignment
from tfbus.comparison.compare import Comparison, compare
from tfbus.comparison.errors import PoseErrors, Statistics

__all__ = ["Alignment", "Comparison", "PoseErrors", "Statistics", "compare"]
