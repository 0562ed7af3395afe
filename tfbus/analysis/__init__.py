"""The analysis of complete trees: their faults, and the comparison of trajectories.

`diagnose` lists the faults of a tree. An `Examiner` gets the samples as they arrive, so it also finds faults that a
tree does not show, such as duplicates and stamps that go back. `compare` gives the absolute and the relative pose error
of a frame between two trees, as the benchmarks for SLAM define them. `Arrivals` measures rates and delays. `nees` tests
covariances with the truth, and `fuse` finds the transform that fits several answers best.
"""

from tfbus.analysis.arrivals import Arrival, Arrivals
from tfbus.analysis.compare import Alignment, Comparison, PoseErrors, Statistics, compare
from tfbus.analysis.consistency import Consistency, nees
from tfbus.analysis.examiner import Examiner, Finding, Limits, diagnose
from tfbus.analysis.fusion import Fusion, fuse

__all__ = [
    "Alignment",
    "Arrival",
    "Arrivals",
    "Comparison",
    "Consistency",
    "Examiner",
    "Finding",
    "Fusion",
    "Limits",
    "PoseErrors",
    "Statistics",
    "compare",
    "diagnose",
    "fuse",
    "nees",
]
