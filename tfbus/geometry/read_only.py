"""Arrays that cannot be written to."""

from typing import Any

import numpy as np
import numpy.typing as npt


def read_only(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """A read-only view of an array that its owner may still write to; a read-only array is returned as it is."""
    if not array.flags.writeable:
        return array
    view = array.view()
    view.flags.writeable = False
    return view


def locked(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """An array of numbers that nobody can make writable again, nor any view of it; the caller gives up the original.

    Clearing the array's own ``writeable`` flag is not enough: the owner of the memory can set it again.
    """
    return np.asarray(array.data.toreadonly())
