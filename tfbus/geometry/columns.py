"""Samples from arrays: names, stamps, translations and rotations in columns, each row checked as if it came alone.

The kernel takes the columns as a batch if all rows are plain. Otherwise each row becomes an object here, and a row that
cannot be a sample raises the error that it would raise alone.
"""

from collections.abc import Callable, Sequence
from copy import copy
from typing import Any, TypeAlias, cast

import numpy as np
import numpy.typing as npt

from tfbus.errors import InvalidTransformError
from tfbus.geometry.stamped import Batch, TransformStamped, is_within, not_physical
from tfbus.geometry.transform import Transform
from tfbus.geometry.transform_array import as_columns
from tfbus.stamps import StampLike, StampsLike, as_stamp, as_stamps
from tfbus.which_kernel import columns

Names: TypeAlias = str | Sequence[str] | npt.NDArray[Any]
"""One name for all rows, or a name for each."""


class SampleColumns:
    """The samples of one sender in some arrays.

    Parameters
    ----------
    parents, children : str, or sequence of n str
    stamps : int, or integer array of shape (n,)
        ns.
    translations : array of shape (n, 3)
        In m.
    rotations : array of shape (n, 4)
        Unit quaternions (x, y, z, w). A norm within 1 % of one is normalised; the sign stays as given.
    authority : str
    static : bool
    max_translation : float
        The greatest length of a translation, in m.

    Raises
    ------
    InvalidTransformError
        If translations or rotations have another shape.
    TypeError, ValueError
        If another column has not one value for all rows or one for each, or a stamp or the authority is of another
        type.

    Attributes
    ----------
    plain : Columns or None
        All samples as a batch for the kernel, if no row needs a closer look.
    """

    def __init__(
        self,
        parents: Names,
        children: Names,
        stamps: StampLike | StampsLike,
        translations: npt.ArrayLike,
        rotations: npt.ArrayLike,
        authority: str,
        static: bool,
        max_translation: float,
    ) -> None:
        moves, turns = as_columns(translations, rotations)
        if not isinstance(authority, str):
            raise TypeError(f"authority must be a str, not {authority!r}")
        count = len(moves)
        self._rows = np.empty((count, 7))
        self._rows[:, :3] = moves
        self._rows[:, 3:] = turns
        self._parents = _as_names(parents, "parents", count)
        self._children = _as_names(children, "children", count)
        self._stamps = _as_stamps(stamps, count)
        self._authority = str(authority)
        self._static = bool(static)
        self._bound = max_translation
        self._make_plain()

    def _make_plain(self) -> None:
        # A square this near to the bound can disagree with the length.
        square = 0.99 * self._bound**2
        self.plain: Any = columns(
            self._parents, self._children, self._stamps, self._rows, self._authority, self._static, square
        )

    def __len__(self) -> int:
        return len(self._stamps)

    def part(self, rows: slice) -> "SampleColumns":
        """Some of the rows, which share the memory of all; for all of them, parents and children have one name."""
        part = copy(self)
        part._rows, part._stamps = self._rows[rows], self._stamps[rows]
        part._make_plain()
        return part

    def samples(self, refuse: Callable[[InvalidTransformError], object] | None = None) -> Batch:
        """The samples as objects, in order.

        Parameters
        ----------
        refuse : callable, optional
            Gets the error of each row that cannot be a sample, which is left out. Without it, the first is raised.

        Raises
        ------
        InvalidTransformError
            If a row cannot be a sample. The message begins with the index of the row.
        TypeError
            If a name is not a string.
        """
        if self.plain is not None:
            return cast(Batch, self.plain.samples(TransformStamped))
        samples = []
        for index, (row, stamp) in enumerate(zip(self._rows.tolist(), self._stamps.tolist(), strict=True)):
            parent = self._parents if isinstance(self._parents, str) else self._parents[index]
            child = self._children if isinstance(self._children, str) else self._children[index]
            try:
                transform = Transform(tuple(row[:3]), tuple(row[3:]))
                sample = TransformStamped(parent, child, stamp, transform, self._authority, self._static)
                if not is_within(sample, self._bound):
                    raise not_physical(sample, self._bound)
                samples.append(sample)
            except InvalidTransformError as error:
                named = InvalidTransformError(
                    f"row {index}: {error}",
                    reason=error.reason,
                    parent=parent,
                    child=child,
                    authority=self._authority,
                )
                if refuse is None:
                    raise named from None
                refuse(named)
        return tuple(samples)


def _as_names(names: Names, what: str, count: int) -> str | tuple[str, ...]:
    if isinstance(names, str):
        return str(names)
    listed: tuple[str, ...] = tuple(names.tolist() if isinstance(names, np.ndarray) else names)
    if len(listed) != count:
        raise ValueError(f"{what} must be one name, or one for each of {count} rows, got {len(listed)}")
    return listed


def _as_stamps(stamps: StampLike | StampsLike, count: int) -> npt.NDArray[np.int64]:
    if type(stamps) is int or np.ndim(cast(Any, stamps)) == 0:
        return np.full(count, as_stamp(cast(StampLike, stamps)), np.int64)
    instants = as_stamps(cast(StampsLike, stamps))
    if len(instants) != count:
        raise ValueError(f"stamps must be one stamp, or one for each of {count} rows, got {len(instants)}")
    # A copy, because the caller may write to the array meanwhile.
    return np.array(instants)
