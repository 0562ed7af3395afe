"""Arrays that are not to be written to."""

from typing import Any

import numpy as np
import numpy.typing as npt


def read_only(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """A read-only view of an array whose owner keeps it, or the array itself if nobody can write to it as it is."""
    if not array.flags.writeable:
        return array
    view = array.view()
    view.flags.writeable = False
    return view


def locked(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """An array of numbers that nobody else has, for good: it and what is cut out of it cannot be made writable again.

    To lock the array itself is not enough: whoever owns the memory may unlock it, or still write to it where the array
    is a view.
    """
    return np.asarray(array.data.toreadonly())
