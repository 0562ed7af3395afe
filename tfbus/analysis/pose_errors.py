"""`PoseErrors`, the errors of a trajectory over time, and their statistics."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True, slots=True)
class Statistics:
    """Statistics of errors, in m or rad; the standard deviation is that of the population."""

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float


@dataclass(frozen=True, slots=True, eq=False)
class PoseErrors:
    """The error of each pose, or of each step between two poses.

    Parameters
    ----------
    stamps : int64 array of shape (n,)
        The stamps in the reference, in ns; of a step, that of its end.
    translation : float64 array of shape (n,)
        m.
    rotation : float64 array of shape (n,)
        rad, from 0 to pi.
    """

    stamps: npt.NDArray[np.int64]
    translation: npt.NDArray[np.float64]
    rotation: npt.NDArray[np.float64]

    def statistics(self) -> tuple[Statistics, Statistics]:
        """The statistics of translation and rotation.

        Raises
        ------
        ValueError
            If there are no errors, because there is only one pose.
        """
        if not len(self.stamps):
            raise ValueError("there are no errors: a step needs two poses")
        return _statistics(self.translation), _statistics(self.rotation)


def _statistics(values: npt.NDArray[np.float64]) -> Statistics:
    return Statistics(
        float(np.sqrt(np.mean(values**2))),
        float(np.mean(values)),
        float(np.median(values)),
        float(np.std(values)),
        float(np.min(values)),
        float(np.max(values)),
    )
