"""The analysis of trees that are complete: a doctor, and the comparison of trajectories.

`diagnose` tells what in a tree cannot be right; an `Examiner` is fed with samples as they arrive, and so also sees what
a tree does not keep, such as duplicates and stamps that go back. `compare` gives the absolute and the relative pose
error of a frame between two trees, as the benchmarks for SLAM define them. `Arrivals` measures rates and delays.
"""

from tfbus.analysis.arrivals import Arrival, Arrivals
from tfbus.analysis.compare import Alignment, Comparison, PoseErrors, Statistics, compare
from tfbus.analysis.examiner import Examiner, Finding, Limits, diagnose

__all__ = [
    "Alignment",
    "Arrival",
    "Arrivals",
    "Comparison",
    "Examiner",
    "Finding",
    "Limits",
    "PoseErrors",
    "Statistics",
    "compare",
    "diagnose",
]
