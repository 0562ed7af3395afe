"""`TransformArray`, many transforms at once.

It holds seven columns, ``tx, ty, tz, qx, qy, qz, qw``, each an array over the transforms. The functions of
`tfbus.rows` take columns as well as the seven floats of a row, so each formula is written once.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from importlib import import_module
from typing import Any, overload

import numpy as np
import numpy.typing as npt

from tfbus.errors import InvalidTransformError, pip_install
from tfbus.geometry.transform import Transform, from_row
from tfbus.rows import NORM_TOLERANCE, ROUNDING, Columns, compose, invert, rotate
from tfbus.stamps import StampLike, StampsLike, as_array, as_stamp, as_stamps, format_stamp


def read_only(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """A read-only view of an array that its owner may still write to; a read-only array is returned itself."""
    if not array.flags.writeable:
        return array
    view = array.view()
    view.flags.writeable = False
    return view


def locked(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """An array of numbers; nobody can make it or a view of it writable again. The caller gives up the original.

    Clearing the array's own ``writeable`` flag is not enough: the owner of the memory can set it again.
    """
    return np.asarray(array.data.toreadonly())


_RECORD = 8 * 8
"""The bytes of a transform and its stamp."""
_FLOAT = np.dtype(np.float64)
_INTEGER = np.dtype(np.int64)
_ndarray = np.ndarray
_new = object.__new__

COLUMN_NAMES = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
"""The names of the seven columns in all tables: translation in m, and unit quaternion (x, y, z, w)."""

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]


def as_columns(translations: npt.ArrayLike, rotations: npt.ArrayLike) -> tuple[Floats, Floats]:
    """Translations of shape (n, 3) and rotations (n, 4); raises `InvalidTransformError` for other shapes."""
    moves = as_array(translations, "translations", np.float64)
    turns = as_array(rotations, "rotations", np.float64)
    if moves.ndim != 2 or moves.shape[1] != 3 or turns.shape != (len(moves), 4):
        raise InvalidTransformError(
            f"translations and rotations must have shapes (n, 3) and (n, 4), got {moves.shape} and {turns.shape}",
            reason="wrong length",
        )
    return moves, turns


class TransformArray:
    """A sequence of transforms in arrays, such as one frame's at many stamps. Immutable.

    Parameters
    ----------
    translations : array of shape (n, 3)
        In m.
    rotations : array of shape (n, 4)
        Unit quaternions (x, y, z, w). A norm within 1 % of one is normalised; the sign stays as given. NaN throughout,
        in a translation and its rotation, means that there is no transform.
    stamps : sequence or array of shape (n,), optional
        The stamp of each in ns, or dates as `TransformTree.lookup_many` accepts them.

    Raises
    ------
    InvalidTransformError
        If the shapes are wrong, or a row is not finite, or too far from a unit quaternion.
    TypeError, ValueError
        If the stamps are not stamps, or there is not one for each transform.

    Examples
    --------
    >>> steps = TransformArray([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], [[0.0, 0.0, 0.0, 1.0]] * 2)
    >>> steps[1]
    Transform(translation=(1.0, 0.0, 0.0), rotation=(0.0, 0.0, 0.0, 1.0))
    >>> steps.apply([[0.0, 2.0, 0.0], [0.0, 3.0, 0.0]])
    array([[0., 2., 0.],
           [1., 3., 0.]])
    """

    __array_ufunc__ = None
    __slots__ = ("_known_columns", "_known_policy_use", "_known_stamps", "_memory")
    _known_columns: Floats
    _known_policy_use: Integers | None
    _known_stamps: Integers | None
    _memory: bytes

    def __init__(self, translations: npt.ArrayLike, rotations: npt.ArrayLike, stamps: StampsLike | None = None) -> None:
        moves, turns = as_columns(translations, rotations)
        with np.errstate(over="ignore"):
            squares = np.square(turns).sum(axis=1)
        norms = np.sqrt(squares)
        missing = np.isnan(moves).all(axis=1) & np.isnan(turns).all(axis=1)
        wrong = ~(missing | (np.isfinite(moves).all(axis=1) & (np.abs(norms - 1.0) <= NORM_TOLERANCE)))
        if wrong.any():
            i = int(wrong.argmax())
            raise InvalidTransformError(
                f"transform {i} is not rigid: translation {moves[i]}, rotation {turns[i]}",
                reason="not a unit quaternion",
            )
        norms[np.abs(squares - 1.0) <= ROUNDING] = 1.0
        self._known_columns = locked(np.vstack((moves.T, turns.T / norms)))
        self._known_stamps = None
        if stamps is not None:
            instants = as_stamps(stamps)
            if len(instants) != len(moves):
                raise ValueError(f"there are {len(instants)} stamps for {len(moves)} transforms")
            self._known_stamps = locked(instants.copy())

    @classmethod
    def from_scipy(
        cls, translations: npt.ArrayLike, rotations: Any, stamps: StampsLike | None = None
    ) -> TransformArray:
        """From translations in m, shape (n, 3), and n rotations in a ``scipy.spatial.transform.Rotation``.

        Examples
        --------
        >>> from scipy.spatial.transform import Rotation
        >>> turns = Rotation.from_euler("z", [[0.0], [90.0]], degrees=True)
        >>> TransformArray.from_scipy(np.zeros((2, 3)), turns, [10, 20])
        <TransformArray of 2 from 0.00000001 s to 0.00000002 s>
        """
        return cls(translations, rotations.as_quat(), stamps)

    @property
    def _columns(self) -> Floats:
        """All transforms, shape (7, n). Made of `_memory` when first read, as making an array takes as long as a few
        answers."""
        columns: Floats | None = getattr(self, "_known_columns", None)
        if columns is None:
            memory = self._memory
            self._known_columns = columns = _ndarray((7, len(memory) // _RECORD), _FLOAT, memory)
        return columns

    @property
    def _stamps(self) -> Integers | None:
        memory = getattr(self, "_memory", None)
        if memory is not None and not hasattr(self, "_known_stamps"):
            count = len(memory) // _RECORD
            self._known_stamps = _ndarray((count,), _INTEGER, memory, 7 * 8 * count)
        return self._known_stamps

    @property
    def _policy_use(self) -> Integers | None:
        return getattr(self, "_known_policy_use", None)

    @property
    def stamps(self) -> Integers | None:
        """The stamp of each in ns: a read-only array of shape (n,); None if they have none."""
        return self._stamps

    @property
    def translations(self) -> Floats:
        """(x, y, z) of each in m: a read-only array of shape (n, 3), a view of columns and so not C-contiguous."""
        return self._columns[:3].T

    @property
    def rotations(self) -> Floats:
        """The unit quaternion (x, y, z, w) of each: a read-only array of shape (n, 4), a view as `translations`."""
        return self._columns[3:].T

    @property
    def valid(self) -> npt.NDArray[np.bool_]:
        """Whether each is a transform and not NaN: a new array of shape (n,)."""
        return np.asarray(np.isfinite(self._columns).all(axis=0))

    @property
    def extrapolated_by(self) -> Integers:
        """`TransformStamped.extrapolated_by` of each transform: a read-only array of shape (n,) in ns."""
        return locked(np.zeros(len(self), np.int64)) if self._policy_use is None else self._policy_use[0]

    @property
    def gap(self) -> Integers | None:
        """`TransformStamped.gap` of each transform: a read-only array of shape (n,) in ns; None without a policy.

        A gap of more than 2^63 - 1 ns is given as 2^63 - 1.
        """
        return None if self._policy_use is None else self._policy_use[1]

    def as_wxyz(self) -> Floats:
        """The rotations in transforms3d's order, (w, x, y, z): a new array of shape (n, 4).

        Examples
        --------
        >>> TransformArray([(1.0, 2.0, 3.0)], [(0.0, 0.0, 0.0, 1.0)]).as_wxyz()
        array([[1., 0., 0., 0.]])
        """
        return np.ascontiguousarray(self._columns[[6, 3, 4, 5]].T)

    def as_rpy(self) -> Floats:
        """Roll, pitch, yaw of each in rad, as `Transform.as_rpy` gives them: a new array of shape (n, 3).

        Examples
        --------
        >>> TransformArray([(1.0, 2.0, 3.0)], [(0.0, 0.0, 0.0, 1.0)]).as_rpy()
        array([[0., 0., 0.]])
        """
        x, y, z, w = self._columns[3:]
        # Their squares add up to two, so at most one of them is near zero.
        low, high = np.hypot(x + z, w - y), np.hypot(x - z, w + y)
        half_sum, half_difference = np.arctan2(x + z, w - y), np.arctan2(x - z, w + y)
        half_sum = np.where(low <= ROUNDING, half_difference, half_sum)
        half_difference = np.where(high <= ROUNDING, half_sum, half_difference)
        angles = half_sum + half_difference, half_sum - half_difference
        # To the same turn as `math.remainder`, which is exact.
        roll, yaw = (angle - math.tau * np.round(angle / math.tau) for angle in angles)
        return np.stack((roll, math.pi / 2.0 - 2.0 * np.arctan2(low, high), yaw), axis=1)

    def as_scipy(self) -> Any:
        """The rotations as a ``scipy.spatial.transform.Rotation``; needs scipy.

        Raises
        ------
        ImportError
            If scipy is not installed.
        ValueError
            If a transform is NaN: select the valid ones first.

        Examples
        --------
        >>> turns = TransformArray(np.zeros((2, 3)), [[0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 1.0, 0.0]])
        >>> np.degrees(turns.as_scipy().magnitude())
        array([  0., 180.])
        """
        from scipy.spatial.transform import Rotation

        if not self.valid.all():
            raise ValueError(f"transform {int(self.valid.argmin())} is NaN: select the others with [transforms.valid]")
        return Rotation.from_quat(self.rotations)

    def to_dataframe(self, library: str = "pandas", *, index: str | None = None, angles: bool = False) -> Any:
        """A data frame with one row for each transform; needs the library.

        Its columns are ``stamp_ns`` if there are stamps, ``x_m``, ``y_m``, ``z_m``, ``qx``, ``qy``, ``qz``, ``qw``, as
        in the tables of ``tfbus query``. A transform that is NaN has NaN in all but the first.

        Parameters
        ----------
        library : str
            ``"pandas"`` or ``"polars"``.
        index : str, optional
            ``"datetime"`` for dates in UTC in place of ``stamp_ns``, exact to the ns, with the name ``stamp``: the
            index in pandas, the first column in polars.
        angles : bool
            Whether there are the columns ``roll_rad``, ``pitch_rad`` and ``yaw_rad`` as well, from `as_rpy`.

        Raises
        ------
        ImportError
            If the library is not installed.
        ValueError
            If it is another library, or another index, or there are no stamps for it.

        Examples
        --------
        >>> steps = TransformArray([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], [[0.0, 0.0, 0.0, 1.0]] * 2, [0, SECOND])
        >>> steps.to_dataframe(index="datetime")["x_m"].diff().iloc[-1]
        np.float64(1.0)
        """
        if library not in ("pandas", "polars"):
            raise ValueError(f"library must be 'pandas' or 'polars', not {library!r}")
        if index not in (None, "datetime"):
            raise ValueError(f"index must be None or 'datetime', not {index!r}")
        stamps = self._stamps
        if index is not None and stamps is None:
            raise ValueError("these transforms have no stamps for an index")
        try:
            frames = import_module(library)
        except ImportError as error:
            raise ImportError(f"a data frame needs one more package: {pip_install(library)} ({error})") from error
        columns: dict[str, Any] = dict(zip(COLUMN_NAMES, self._columns, strict=True))
        if angles:
            columns |= zip(("roll_rad", "pitch_rad", "yaw_rad"), self.as_rpy().T, strict=True)
        if stamps is not None and index is None:
            columns = {"stamp_ns": stamps, **columns}
        if library == "polars":
            if stamps is not None and index is not None:
                columns = {"stamp": frames.Series(stamps).cast(frames.Datetime("ns", "UTC")), **columns}
            return frames.DataFrame(columns)
        dates = None
        if stamps is not None and index is not None:
            dates = frames.DatetimeIndex(stamps.view("M8[ns]"), name="stamp").tz_localize("UTC")
        # A copy, because a data frame may be written to.
        return frames.DataFrame(columns, dates, copy=True)

    def matrices(self) -> Floats:
        """New homogeneous matrices of shape (n, 4, 4).

        Examples
        --------
        >>> TransformArray([(1.0, 2.0, 3.0)], [(0.0, 0.0, 0.0, 1.0)]).matrices().shape
        (1, 4, 4)
        """
        matrices = np.zeros((len(self), 4, 4))
        rotation = (*self._columns[3:],)
        for axis, unit in enumerate(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))):
            matrices[:, :3, axis] = np.transpose(rotate(rotation, *unit))
        matrices[:, :3, 3] = self.translations
        matrices[:, 3, 3] = 1.0
        return matrices

    def apply(self, points: npt.ArrayLike) -> npt.NDArray[Any]:
        """Map each point by its own transform.

        Parameters
        ----------
        points : array of shape (n, 3)
            In m. float32 stays float32; integers become float64.

        Returns
        -------
        array of shape (n, 3)

        Raises
        ------
        ValueError
            If the shape is another. The message has the shape.

        Examples
        --------
        >>> two = TransformArray([(1.0, 0.0, 0.0), (2.0, 0.0, 0.0)], [(0.0, 0.0, 0.0, 1.0)] * 2)
        >>> two.apply(np.zeros((2, 3)))
        array([[1., 0., 0.],
               [2., 0., 0.]])
        """
        array = as_array(points, "points")
        if array.shape != (len(self), 3):
            raise ValueError(f"points must have shape ({len(self)}, 3), one for each transform, got {array.shape}")
        dtype = array.dtype if np.issubdtype(array.dtype, np.floating) else np.dtype(np.float64)
        moved = np.empty(array.shape, dtype)
        with np.errstate(invalid="ignore"):
            moved.T[:] = move((*self._columns,), *array.T.astype(np.float64))
        return moved

    def inverse(self) -> TransformArray:
        """The inverse of each transform at the same stamp, without `extrapolated_by` and `gap`.

        Examples
        --------
        >>> TransformArray([(1.0, 2.0, 3.0)], [(0.0, 0.0, 0.0, 1.0)]).inverse().translations
        array([[-1., -2., -3.]])
        """
        return from_columns(np.stack(invert((*self._columns,))), stamps=self._stamps)

    def __matmul__(self, other: TransformArray | Transform) -> TransformArray:
        """Compose with `other` one by one, or all with the same transform, without `extrapolated_by` and `gap`.

        If only one operand has stamps, the product has them. If both have stamps that differ, it has none.
        """
        columns = _columns_of(other, len(self))
        if columns is None:
            return NotImplemented
        stamps = self._stamps
        if isinstance(other, TransformArray) and other._stamps is not None:
            stamps = other._stamps if stamps is None or np.array_equal(stamps, other._stamps) else None
        return from_columns(np.stack(compose((*self._columns,), columns)), stamps=stamps)

    def __rmatmul__(self, other: Transform) -> TransformArray:
        columns = _columns_of(other, len(self))
        if columns is None:
            return NotImplemented
        return from_columns(np.stack(compose(columns, (*self._columns,))), stamps=self._stamps)

    def between(self, start: StampLike | None = None, stop: StampLike | None = None) -> TransformArray:
        """The transforms from one stamp to another.

        Parameters
        ----------
        start, stop : int, optional
            The first and the last stamp, in ns, both included; or dates, as `TransformTree.lookup` accepts them.

        Raises
        ------
        ValueError
            If the transforms have no stamps.
        TypeError, ValueError
            If a bound is not a stamp.

        Examples
        --------
        >>> path = TransformArray([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], [[0.0, 0.0, 0.0, 1.0]] * 2, [10, 20])
        >>> path.between(15).stamps
        array([20])
        """
        if self._stamps is None:
            raise ValueError("these transforms have no stamps: select them by indices")
        chosen = np.ones(len(self), np.bool_)
        if start is not None:
            chosen &= self._stamps >= as_stamp(start)
        if stop is not None:
            chosen &= self._stamps <= as_stamp(stop)
        return self[chosen]

    def __len__(self) -> int:
        return len(self._columns[0])

    @overload
    def __getitem__(self, index: int | np.integer[Any]) -> Transform: ...
    @overload
    def __getitem__(self, index: slice | list[int] | list[bool] | npt.NDArray[Any]) -> TransformArray: ...
    def __getitem__(self, index: Any) -> Transform | TransformArray:
        """One transform, or those selected by a slice, a mask or indices in a list or an array.

        Raises
        ------
        IndexError
            If the index is out of range, or of another kind, such as a tuple.
        InvalidTransformError
            If the selected transform is NaN.
        """
        try:
            columns = None if isinstance(index, tuple) else self._columns[:, index]
        except IndexError:
            columns = None
        if columns is None or columns.ndim > 2:
            raise IndexError(
                f"index {index!r} does not fit {len(self)} transforms: give an int, a slice, or a mask or indices in a "
                "list or an array"
            )
        if columns.ndim == 2:
            return from_columns(
                columns,
                None if self._policy_use is None else self._policy_use[:, index],
                None if self._stamps is None else self._stamps[index],
            )
        x, y, z, qx, qy, qz, qw = columns.tolist()
        if x != x:
            raise InvalidTransformError(f"transform {index} is NaN: it has no value", reason="not finite")
        return from_row((x, y, z, qx, qy, qz, qw))

    def __iter__(self) -> Iterator[Transform]:
        return (self[i] for i in range(len(self)))

    def __repr__(self) -> str:
        missing = len(self) - int(self.valid.sum())
        span = ""
        if self._stamps is not None and len(self):
            span = f" from {format_stamp(int(self._stamps.min()))} to {format_stamp(int(self._stamps.max()))}"
        return f"<TransformArray of {len(self)}{span}{f', {missing} are NaN' if missing else ''}>"

    def __reduce__(self) -> tuple[Any, ...]:
        return from_columns, (self._columns, self._policy_use, self._stamps)


def from_columns(columns: Floats, policy_use: Integers | None = None, stamps: Integers | None = None) -> TransformArray:
    """The transforms of valid columns, without a copy.

    Parameters
    ----------
    columns : array of shape (7, n)
        Must not be changed from now on.
    policy_use : integer array of shape (2, n), optional
        `extrapolated_by` and `gap` of each transform, in ns; must not be changed either.
    stamps : integer array of shape (n,), optional
        In ns; must not be changed either.
    """
    transforms = TransformArray.__new__(TransformArray)
    transforms._known_columns = locked(columns)
    transforms._known_policy_use = None if policy_use is None else locked(policy_use)
    transforms._known_stamps = None if stamps is None else locked(stamps)
    return transforms


def with_stamps(transforms: TransformArray, stamps: Integers) -> TransformArray:
    """Give new transforms, which nobody else has seen yet, a copy of their stamps in ns."""
    transforms._known_stamps = locked(stamps.copy())
    return transforms


def move(columns: Columns, x: Any, y: Any, z: Any) -> tuple[Any, Any, Any]:
    """Map points by coordinate, each with its own transform."""
    x, y, z = rotate(columns[3:], x, y, z)
    return columns[0] + x, columns[1] + y, columns[2] + z


def _columns_of(other: object, count: int) -> Columns | None:
    if isinstance(other, Transform):
        return other._row
    if not isinstance(other, TransformArray):
        return None
    if len(other) != count:
        raise ValueError(f"{count} and {len(other)} transforms cannot be combined one by one")
    return (*other._columns,)
