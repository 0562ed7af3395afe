"""The composition of many poses: the twin of `compose_paths` in the compiled kernel, with the same bits."""

import numpy as np
import numpy.typing as npt

from tfbus.geometry.rows import Row, compose


def compose_paths(rows: npt.NDArray[np.float64], origins: npt.NDArray[np.int64]) -> None:
    """Replace each row, which is seen from the place of its origin, by the one that is seen from the first place.

    Parameters
    ----------
    rows : contiguous array of shape (n, 7)
    origins : int64 array of shape (n,)
        The place of each origin, which comes before; 0 leaves a row as it is.

    Raises
    ------
    ValueError
        If an origin does not come before its row, or there is not one for each.
    """
    if len(rows) != len(origins):
        raise ValueError("each row of seven floats needs an origin before it")
    composed: list[Row] = list(map(tuple, rows.tolist()))
    for place, origin in enumerate(origins.tolist()):
        if origin and not 0 < origin < place:
            raise ValueError("each row of seven floats needs an origin before it")
        if origin:
            composed[place] = compose(composed[origin], composed[place])
    rows[:] = composed
