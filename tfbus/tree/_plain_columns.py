"""The plain answers of the kernel at many stamps."""

from collections.abc import Sequence

import numpy as np

from tfbus.errors import TransformLookupError
from tfbus.geometry.which_kernel import kernel
from tfbus.stamps import LATEST
from tfbus.tree._copied_paths import Query
from tfbus.tree._kernel import Held
from tfbus.tree._segments import Floats
from tfbus.tree.forest import Forest


def plain_columns(forest: Forest, queries: Sequence[Query], with_nan: bool) -> list[Floats] | None:
    """The answers of each query as columns of shape (7, n), with the bits of a lookup at each stamp.

    All are of one moment. The lock is held for no more than taking references to the samples.

    Parameters
    ----------
    forest : Forest
    queries : sequence of Query
    with_nan : bool
        Whether a stamp without an answer gives NaN.

    Returns
    -------
    list of array, or None
        None if an answer is not plain, there is none without `with_nan`, or the kernel gives none at many stamps.
    """
    if kernel == "python":
        # Its chains hold nothing, which would be found out after the paths.
        return None
    held: list[Held] = []
    try:
        with forest.lock:
            for target, source, _ in queries:
                path = forest.find_path(target, source, LATEST)
                samples = path.hold() if path.permanent else None
                if samples is None:
                    return None
                # A stamp that this path does not cover may have an answer on another way round a loop of parents.
                with_nan = with_nan and path.root not in forest.frames
                held.append(samples)
    except TransformLookupError:
        return None
    found: list[Floats] = []
    for samples, (_, _, stamps) in zip(held, queries, strict=True):
        columns = np.empty((7, len(stamps)))
        missing = samples.rows(np.ascontiguousarray(stamps), columns)
        if missing is None or (missing >= 0 and not with_nan):
            return None
        found.append(columns)
    return found
