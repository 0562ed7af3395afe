"""The tree of all frames: where one frame is, seen from another.

`TransformTree` has no clock, no event loop and no input or output: it answers or it raises.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, Literal, TypedDict, Unpack, cast, overload

import numpy as np
import numpy.typing as npt

from tfbus.data import PointCloud, TwistArray, TwistStamped
from tfbus.errors import TransformLookupError
from tfbus.geometry.columns import Names, SampleColumns
from tfbus.geometry.stamped import (
    MAX_TRANSLATION,
    TransformStamped,
    as_batch,
    as_max_translation,
    check_translations,
    is_within,
)
from tfbus.geometry.transform_array import TransformArray, from_columns, locked, with_stamps
from tfbus.stamps import (
    LATEST,
    STAMP_MAX,
    STAMP_MIN,
    AtLike,
    Latest,
    StampLike,
    Stamps,
    StampsLike,
    as_duration,
    as_stamp,
    as_stamps,
    format_stamp,
    from_seconds,
)
from tfbus.tf2_names import says_ours
from tfbus.tree.explanation import Explanation, explain
from tfbus.tree.forest import Forest
from tfbus.tree.history import Edge, FrameHistory, Outcome, SavedFrame, samples_of, save_frame
from tfbus.tree.lookup import AT_LATEST_ONLY, GO_TOGETHER, Hold, Options, answer, bounds_of, policy_of
from tfbus.tree.lookup_many import OutOfRange, deskew, lookup_many
from tfbus.tree.rendering import cell, counted, describe, to_dot, to_html, to_yaml
from tfbus.tree.twist import twist, twist_many
from tfbus.tree.uncertain import uncertain_answer, uncertain_many
from tfbus.tree.uncertain_twist import uncertain_twist
from tfbus.uncertainty.answers import UncertainTransform, UncertainTransformArray
from tfbus.uncertainty.data import UncertainTwist
from tfbus.which_kernel import plain_first


class _Options(Options, total=False):
    not_before: StampLike | None
    not_after: StampLike | None


class _ManyOptions(TypedDict, total=False):
    source_at: StampLike | StampsLike | None
    fixed: str | None
    out_of_range: OutOfRange
    tolerance: float
    max_gap: float | None
    extrapolate: Hold | None


_LONGEST_WINDOW = 100_000_000
"""The longest `keep` in s, about three years; a greater number was meant as nanoseconds."""


@says_ours
class TransformTree:
    """The transforms between any two frames, over the last few seconds.

    Any thread may read it while another one inserts. A copy, `edges` and the texts show the tree at one moment; an
    explanation reads its edges one after the other. A finaliser (``__del__``) or a signal handler must not use the
    tree: if it interrupts a call of its own thread that holds the lock of the tree, it waits for ever.

    Parameters
    ----------
    keep : float or None
        Length of the history of each frame, in s before that frame's newest stamp; None keeps everything. A late
        sample then costs more the longer the history is, because all samples after it are moved: in the middle of a
        million samples some ms.
    max_translation : float
        The greatest magnitude of a translation, in m, at most 1e100; a longer one is refused as not physical, so that
        every answer is finite.

    Raises
    ------
    TypeError, ValueError
        If `keep` is negative, NaN, or finite and above 1e8, or `max_translation` is not greater than zero and at most
        1e100.

    Attributes
    ----------
    keep : float or None
    max_translation : float

    Examples
    --------
    >>> tree = TransformTree()
    >>> tree.insert(TransformStamped("base_link", "base_laser", 0, Transform((0.1, 0.0, 0.2))))
    <Outcome.INSERTED: 'inserted'>
    >>> tree.lookup("base_link", "base_laser", 0).transform.translation
    (0.1, 0.0, 0.2)
    """

    def __init__(self, keep: float | None = 10.0, *, max_translation: float = MAX_TRANSLATION) -> None:
        self.keep = keep
        self.max_translation: float = as_max_translation(max_translation)
        self._stand_on(Forest(window_of(keep)))
        self._filled_by_bus = False

    def _stand_on(self, forest: Forest) -> None:
        self._forest = forest
        self._paths = forest.paths

    # Insertion

    def insert(self, sample: TransformStamped) -> Outcome:
        """Store one sample.

        Raises
        ------
        InvalidTransformError
            If it would close a loop of parents, or its translation is not finite or longer than `max_translation`.
            Nothing is stored.
        TypeError
            If it is not a `TransformStamped`.

        Examples
        --------
        >>> tree = TransformTree()
        >>> tree.insert(TransformStamped("map", "cart", 0, Transform((1.0, 2.0, 0.0))))
        <Outcome.INSERTED: 'inserted'>
        >>> tree.insert(TransformStamped("map", "cart", 0, Transform((3.0, 4.0, 0.0))))
        <Outcome.REPLACED: 'replaced'>
        """
        if not self._filled_by_bus and isinstance(sample, TransformStamped) and is_within(sample, self.max_translation):
            # The usual case, and much faster.
            return self._forest.insert((sample,))[0]
        return self.insert_many((sample,))[0]

    def insert_many(self, samples: Iterable[TransformStamped]) -> list[Outcome]:
        """Store a batch, all of it or nothing: loops are judged after the whole batch.

        Raises
        ------
        InvalidTransformError
            If a sample would close a loop of parents, or a translation is not finite or longer than `max_translation`.
        TypeError
            If something in it is not a `TransformStamped`.

        Examples
        --------
        >>> tree = TransformTree()
        >>> tree.insert_many([TransformStamped("map", "cart", stamp, Transform()) for stamp in (0, 10)])
        [<Outcome.INSERTED: 'inserted'>, <Outcome.INSERTED: 'inserted'>]
        """
        self._check_writable("use bus.publish, or a copy() of the tree")
        batch = as_batch(samples)
        check_translations(batch, self.max_translation)
        return self._forest.insert(batch)

    def insert_columns(
        self,
        parents: Names,
        children: Names,
        stamps: StampLike | StampsLike,
        translations: npt.ArrayLike,
        rotations: npt.ArrayLike,
        authority: str = "",
        *,
        static: bool = False,
    ) -> list[Outcome]:
        """Store the samples in some arrays, all of them or nothing, as `insert_many` does with objects.

        Parameters
        ----------
        parents, children : str, or sequence of n str
            One name for all rows, such as one frame's at many stamps, or a name for each row.
        stamps : int, or integer array of shape (n,)
            ns. One stamp for all rows, such as many frames' at once, or a stamp for each row.
        translations : array of shape (n, 3)
            In m; each maps the origin of the child into its parent.
        rotations : array of shape (n, 4)
            Unit quaternions (x, y, z, w). A norm within 1 % of one is normalised; the sign stays as given.
        authority : str
            The sender of all rows.
        static : bool
            Whether the rows hold at every stamp.

        Returns
        -------
        list of Outcome
            One for each row.

        Raises
        ------
        InvalidTransformError
            If a row cannot be a sample, which the message then names by its index, or as `insert_many`.
        TypeError, ValueError
            If a column has not one value for all rows or for each, or something in it has another type.

        Examples
        --------
        >>> tree = TransformTree(keep=None)
        >>> outcomes = tree.insert_columns("map", "base_link", [0, 100], [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]],
        ...                                [[0.0, 0.0, 0.0, 1.0]] * 2)
        >>> tree.lookup("map", "base_link", 50).transform.translation
        (0.5, 0.0, 0.0)
        """
        self._check_writable("use bus.publish_columns, or a copy() of the tree")
        columns = SampleColumns(
            parents, children, stamps, translations, rotations, authority, static, self.max_translation
        )
        forest = self._forest
        if columns.plain is None:
            return forest.insert(columns.samples())
        if forest.paths.commit(forest.frames, forest.readers, columns.plain):
            return [Outcome.INSERTED] * len(columns)
        if len(columns) > 1 and isinstance(parents, str) and isinstance(children, str):
            # Usually the frame is new: behind its first sample, which alone can close a loop, the others are plain.
            outcomes = forest.insert(columns.part(slice(1)).samples())
            rest = columns.part(slice(1, None))
            if forest.paths.commit(forest.frames, forest.readers, rest.plain):
                return outcomes + [Outcome.INSERTED] * len(rest)
            return outcomes + forest.insert(rest.samples())
        return forest.insert(columns.samples())

    @property
    def inserted(self) -> int:
        """Number of samples at a new stamp."""
        return self._forest.paths.inserted

    @property
    def replaced(self) -> int:
        """Number of samples that replaced another one at the same stamp."""
        return self._forest.replaced

    @property
    def expired(self) -> int:
        """Number of samples that were older than the window of their frame."""
        return self._forest.expired

    @property
    def looped(self) -> int:
        """Number of samples that formed a loop of parents at a past stamp when they came; see `lookup`."""
        return self._forest.looped

    # Questions about transforms

    @overload
    def lookup(
        self, target: str, source: str, at: AtLike = ..., *, covariance: Literal[True], **options: Unpack[_Options]
    ) -> UncertainTransform: ...

    @overload
    def lookup(
        self, target: str, source: str, at: AtLike = ..., *, covariance: bool = ..., **options: Unpack[_Options]
    ) -> TransformStamped: ...

    @plain_first
    def lookup(
        self,
        target: str,
        source: str,
        at: AtLike = LATEST,
        *,
        source_at: AtLike | None = None,
        fixed: str | None = None,
        not_before: StampLike | None = None,
        not_after: StampLike | None = None,
        tolerance: float = 0.0,
        max_gap: float | None = None,
        extrapolate: Hold | None = None,
        covariance: bool = False,
    ) -> TransformStamped:
        """The transform from `source` to `target`: it maps the coordinates of source into target.

        Parameters
        ----------
        target, source : str
        at : int or LATEST
            ns. `LATEST` is the newest stamp that every moving edge on the path can answer; with `extrapolate`, the
            newest stamp of any of them, as far as the lagging edge may be held.
        source_at : int or LATEST, optional
            Take source at this stamp instead, and carry it to `at` through `fixed`.
        fixed : str, optional
            The frame that stands still between the two stamps.
        not_before : int, optional
            Count a `LATEST` answer older than this (ns) as not yet arrived.
        not_after : int, optional
            Refuse a `LATEST` answer newer than this (ns), such as one from a clock that is ahead.
        tolerance : float
            In s. If an edge does not cover the stamp, or only by a gap that is too long, its nearest sample within this
            distance stands in.
        max_gap : float, optional
            In s. Samples that are further apart are not interpolated.
        extrapolate : Hold, optional
            If an edge has no sample after the stamp, or `max_gap` forbids to interpolate to it, the sample before the
            stamp stands in for some time.
        covariance : bool
            Whether the answer is an `UncertainTransform`, whose covariance is computed from the covariances of its
            samples. A sample that stands in counts with its own error.

        Returns
        -------
        TransformStamped
            Parent is target and child is source; its stamp is `at`, or the stamp that `LATEST` found. An answer whose
            whole path is static has ``static=True`` and, for `LATEST`, the newest stamp among its samples. In time
            travel, a `LATEST` that only static edges answer takes the stamp of source. With a policy, `extrapolated_by`
            and `gap` say how far the answer departs from its stamp.

        Raises
        ------
        UnknownFrameError, DisconnectedError, FutureExtrapolationError
            If there is no answer now, but there may be one later.
        PastExtrapolationError
            If the stamp is older than an edge's window.
        GapError
            If the stamp lies in a gap that is too long.
        AheadError
            If the `LATEST` answer is newer than `not_after`.
        TypeError
            If a stamp is a float, a frame is not a string, only one of `source_at` and `fixed` is given, or
            `not_before` or `not_after` comes without a `LATEST`.

        Notes
        -----
        The newest parents never form a loop. The parents at an older stamp may, if samples came late, and then two ways
        lead from source to target. If the way by the newest parents has samples for the stamp, it gives the answer;
        otherwise the way that has samples does. If two other ways have samples, the frames count as not connected at
        that stamp. `looped` counts the samples that form such loops. The answer depends on the samples only, never on
        earlier questions.

        Examples
        --------
        >>> tree = TransformTree()
        >>> _ = tree.insert(TransformStamped("map", "cart", 0, Transform()))
        >>> _ = tree.insert(TransformStamped("map", "cart", 10, Transform((1.0, 0.0, 0.0))))
        >>> tree.lookup("map", "cart", 5).transform.translation
        (0.5, 0.0, 0.0)
        """
        policy = policy_of(tolerance, max_gap, extrapolate)
        bounds = bounds_of(not_before, not_after)
        ask: Callable[..., TransformStamped] = uncertain_answer if covariance else answer
        return ask(self._forest, target, source, at, source_at, fixed, bounds, policy)

    def can_transform(
        self,
        target: str,
        source: str,
        at: AtLike = LATEST,
        *,
        source_at: AtLike | None = None,
        fixed: str | None = None,
        not_before: StampLike | None = None,
        not_after: StampLike | None = None,
        tolerance: float = 0.0,
        max_gap: float | None = None,
        extrapolate: Hold | None = None,
    ) -> bool:
        """Whether `lookup` with the same arguments has an answer now.

        Examples
        --------
        >>> tree = TransformTree()
        >>> _ = tree.insert(TransformStamped("map", "cart", 10, Transform()))
        >>> tree.can_transform("map", "cart", 11)
        False
        >>> tree.can_transform("map", "cart", 11, tolerance=0.1)
        True
        """
        travels = source_at is not None or fixed is not None
        bounded = not_before is not None or not_after is not None
        if not (travels or bounded or tolerance or max_gap is not None or extrapolate is not None):
            known = self._paths.can_answer(target, source, at)
            if known is not None:
                return known
        try:
            self.lookup(
                target,
                source,
                at,
                source_at=source_at,
                fixed=fixed,
                not_before=not_before,
                not_after=not_after,
                tolerance=tolerance,
                max_gap=max_gap,
                extrapolate=extrapolate,
            )
        except TransformLookupError:
            return False
        return True

    def explain(
        self,
        target: str,
        source: str,
        at: AtLike = LATEST,
        *,
        not_before: StampLike | None = None,
        not_after: StampLike | None = None,
        tolerance: float = 0.0,
        max_gap: float | None = None,
        extrapolate: Hold | None = None,
        now: int | None = None,
    ) -> Explanation:
        """An explanation of the answer of `lookup`, or of everything that blocks it; made to be printed.

        Parameters
        ----------
        target, source, at, not_before, not_after, tolerance, max_gap, extrapolate
            As `lookup`. Time travel has two halves; explain each of them.
        now : int, optional
            The stamp that ages are counted from, in ns; by default the newest in the tree.

        Raises
        ------
        TypeError
            As `lookup`. Here, a lookup without an answer is not an error.

        Examples
        --------
        >>> tree = TransformTree()
        >>> _ = tree.insert(TransformStamped("map", "cart", 10, Transform()))
        >>> print(tree.explain("map", "cart", 11))
        'cart' in 'map' at 0.000000011 s: no answer
        ! map <- cart  one sample  age 0 ns  0.00000001 s ..
        ! frame 'cart': asked for 0.000000011 s, newest sample is 0.00000001 s (1 ns short)
        """
        policy = policy_of(tolerance, max_gap, extrapolate)
        bounds = bounds_of(not_before, not_after)
        if bounds is not None and at is not LATEST:
            raise TypeError(AT_LATEST_ONLY)
        if at is not LATEST:
            at = as_stamp(at)
        return explain(self._forest, target, source, at, bounds, policy, now)

    @overload
    def lookup_many(
        self,
        target: str,
        source: str,
        stamps: StampsLike,
        *,
        covariance: Literal[True],
        **options: Unpack[_ManyOptions],
    ) -> UncertainTransformArray: ...

    @overload
    def lookup_many(
        self, target: str, source: str, stamps: StampsLike, *, covariance: bool = ..., **options: Unpack[_ManyOptions]
    ) -> TransformArray: ...

    @partial(plain_first, many=TransformArray)
    def lookup_many(
        self,
        target: str,
        source: str,
        stamps: StampsLike,
        *,
        source_at: StampLike | StampsLike | None = None,
        fixed: str | None = None,
        out_of_range: OutOfRange = "raise",
        tolerance: float = 0.0,
        max_gap: float | None = None,
        extrapolate: Hold | None = None,
        covariance: bool = False,
    ) -> TransformArray:
        """The transforms from `source` to `target` at many stamps.

        Parameters
        ----------
        target, source : str
        stamps : integer array of shape (n,)
            ns, in any order.
        source_at : int, or integer array of shape (n,), optional
            Take source at these stamps instead, and carry it to `stamps` through `fixed`.
        fixed : str, optional
            The frame that stands still between the two stamps.
        out_of_range : {"raise", "nan"}
            Stamps without an answer raise an error that names the first, or give NaN.
        tolerance, max_gap, extrapolate
            As `lookup`.
        covariance : bool
            Whether the answer is an `UncertainTransformArray`, which has a covariance for each transform.

        Returns
        -------
        TransformArray
            One transform for each stamp, in the order of `stamps`, which it has as its own `stamps`. With a policy, its
            `extrapolated_by` and `gap` say how far each answer departs from its stamp.

        Raises
        ------
        UnknownFrameError
        DisconnectedError
            If there is no path at some stamp; with ``"nan"``, only if there is none at all stamps.
        ExtrapolationError
            If a stamp is outside an edge's window; `index` says which.
        TypeError
            If stamps are not integers, or only one of `source_at` and `fixed` is given.
        ValueError
            If shapes do not agree.

        Examples
        --------
        >>> tree = TransformTree()
        >>> for stamp in (0, 100):
        ...     outcome = tree.insert(TransformStamped("map", "base_link", stamp, Transform((stamp / 10, 0.0, 0.0))))
        >>> tree.lookup_many("map", "base_link", [0, 50, 100]).translations
        array([[ 0.,  0.,  0.],
               [ 5.,  0.,  0.],
               [10.,  0.,  0.]])
        """
        asked = as_stamps(stamps)
        if (source_at is None) != (fixed is None):
            raise TypeError(GO_TOGETHER)
        source_stamps = None if source_at is None else _as_many(source_at, len(asked))
        policy = policy_of(tolerance, max_gap, extrapolate)
        ask: Callable[..., TransformArray] = uncertain_many if covariance else lookup_many
        return with_stamps(ask(self._forest, target, source, asked, source_stamps, fixed, out_of_range, policy), asked)

    def deskew(
        self,
        cloud: PointCloud,
        target: str,
        fixed: str,
        *,
        out_of_range: OutOfRange = "raise",
        tolerance: float = 0.0,
        max_gap: float | None = None,
        extrapolate: Hold | None = None,
    ) -> PointCloud:
        """A cloud from a moving sensor, corrected as if all points had been seen at the stamp of the cloud.

        Each point is moved into `fixed` by the transform at its own stamp, and from there into `target` by the
        transform at the stamp of the cloud.

        Parameters
        ----------
        cloud : PointCloud
            With a stamp for each point. If the stamp of the cloud is `LATEST`, the stamp of the newest point is used.
        target : str
            The frame of the result; often the frame of the cloud.
        fixed : str
            The frame that stands still meanwhile, such as ``"odom"``.
        out_of_range : {"raise", "nan"}
            As for `lookup_many`; points without an answer become NaN. The stamp of the cloud itself must have an
            answer.
        tolerance, max_gap, extrapolate
            As `lookup`.

        Returns
        -------
        PointCloud
            In `target`, without stamps for the points, of the same float type and with the same fields.

        Raises
        ------
        TransformLookupError
            As for `lookup_many`.
        ValueError
            If the points have no stamps.
        TypeError
            If `cloud` is no `PointCloud`: ``to_points`` makes one of a `LaserScan`.

        Examples
        --------
        >>> tree = TransformTree()
        >>> _ = tree.insert(TransformStamped("odom", "laser", 0, Transform()))
        >>> _ = tree.insert(TransformStamped("odom", "laser", 10, Transform((1.0, 0.0, 0.0))))
        >>> cloud = PointCloud("laser", 10, np.zeros((2, 3)), np.array([0, 10]))
        >>> tree.deskew(cloud, "laser", "odom").points
        array([[-1.,  0.,  0.],
               [ 0.,  0.,  0.]])
        """
        policy = policy_of(tolerance, max_gap, extrapolate)
        return deskew(self._forest, cloud, target, fixed, out_of_range, policy)

    @overload
    def twist(
        self,
        frame: str,
        reference: str,
        at: AtLike = ...,
        *,
        expressed_in: str | None = ...,
        covariance: Literal[False] = ...,
    ) -> TwistStamped: ...

    @overload
    def twist(
        self,
        frame: str,
        reference: str,
        at: AtLike = ...,
        *,
        expressed_in: str | None = ...,
        covariance: Literal[True],
    ) -> UncertainTwist: ...

    def twist(
        self,
        frame: str,
        reference: str,
        at: AtLike = LATEST,
        *,
        expressed_in: str | None = None,
        covariance: bool = False,
    ) -> TwistStamped | UncertainTwist:
        """The velocity of `frame` in `reference`: the derivative of the interpolation of `lookup`.

        Parameters
        ----------
        frame, reference : str
        at : int or LATEST
            ns. `LATEST` is the newest stamp that every moving edge on the paths can answer.
        expressed_in : str, optional
            The frame along whose axes the velocities are given; by default `reference`.
        covariance : bool
            Whether the answer is an `UncertainTwist`, with the covariance of its error by those of the samples around
            the stamp. The axes must be those of `reference` or of `frame`.

        Returns
        -------
        TwistStamped
            Its frame is `expressed_in`. For any axes, `linear` is the velocity of the origin of `frame` in m/s;
            `angular` is the angular velocity in rad/s. At a sample it is the left derivative; at the first sample of a
            window or of a new parent, the right derivative. Between the last sample with one parent and the first with
            another, an edge stands still.

        Raises
        ------
        TransformLookupError
            As `lookup`; and `FutureExtrapolationError` at an edge's newest sample if it is the only one, or the only
            one with its parent.
        ValueError
            If a covariance is asked along the axes of a third frame.

        Notes
        -----
        Use `do_transform` only on an answer with ``expressed_in=frame``. That answer is the twist of a rigid body at
        the origin of `frame`, and `do_transform` gives it at another frame of the body. In other axes, as by default,
        the twist does not refer to the origin of its own frame, and `do_transform` would give a wrong velocity.

        tf2's `lookupVelocity` gives other numbers: its velocity is in the observer's axes already, and it rotates it
        once more, by the rotation of the body.

        Examples
        --------
        >>> tree = TransformTree()
        >>> _ = tree.insert(TransformStamped("map", "cart", 0, Transform()))
        >>> _ = tree.insert(TransformStamped("map", "cart", from_seconds(1.0), Transform((2.0, 0.0, 0.0))))
        >>> tree.twist("cart", "map", from_seconds(0.5)).linear
        (2.0, 0.0, 0.0)
        """
        axes = reference if expressed_in is None else expressed_in
        if at is not LATEST:
            at = as_stamp(at)
        self._forest.search(reference, frame)
        self._forest.search(axes, reference)
        if covariance:
            if axes not in (frame, reference):
                raise ValueError(f"a covariance is along the axes of {reference!r} or {frame!r}, not of {axes!r}")
            with self._forest.lock:
                found = uncertain_twist(self._forest, frame, reference, at, axes != reference)
            stamp, linear, angular, matrix, exact = found
            return UncertainTwist(axes, stamp, linear, angular, matrix, tuple(exact))
        with self._forest.lock:
            stamp, linear, angular = twist(self._forest, frame, reference, at, axes)
        return TwistStamped(axes, stamp, linear, angular)

    def twist_many(
        self,
        frame: str,
        reference: str,
        stamps: StampsLike,
        *,
        expressed_in: str | None = None,
        out_of_range: OutOfRange = "raise",
    ) -> TwistArray:
        """The velocities of `frame` in `reference` at many stamps, as `twist` gives them at one.

        Parameters
        ----------
        frame, reference, expressed_in : str
            As `twist`.
        stamps : integer array of shape (n,)
            ns, in any order.
        out_of_range : {"raise", "nan"}
            As for `lookup_many`.

        Raises
        ------
        TransformLookupError
            As `twist`; `index` says at which stamp. With ``"nan"``, only if there is no path at all stamps.
        TypeError, ValueError
            As for `lookup_many`.

        Examples
        --------
        >>> tree = TransformTree()
        >>> outcomes = tree.insert_columns("map", "base_link", [0, SECOND], [[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]],
        ...                                [[0.0, 0.0, 0.0, 1.0]] * 2)
        >>> tree.twist_many("base_link", "map", [0, SECOND // 2]).linear
        array([[2., 0., 0.],
               [2., 0., 0.]])
        """
        axes = reference if expressed_in is None else expressed_in
        asked = locked(as_stamps(stamps).copy())
        self._forest.search(reference, frame)
        self._forest.search(axes, reference)
        found = locked(twist_many(self._forest, frame, reference, asked, axes, out_of_range))
        return TwistArray(axes, asked, found[:3].T, found[3:].T)

    def latest_common_stamp(self, target: str, source: str) -> int | None:
        """The stamp that `LATEST` means for two frames, in ns; None if the whole path is static.

        Raises
        ------
        UnknownFrameError, DisconnectedError, FutureExtrapolationError
            As `lookup`.

        Examples
        --------
        >>> tree = TransformTree()
        >>> _ = tree.insert(TransformStamped("map", "odom", 10, Transform()))
        >>> _ = tree.insert(TransformStamped("odom", "cart", 20, Transform()))
        >>> tree.latest_common_stamp("map", "cart")
        10
        """
        self._forest.search(target, source)
        with self._forest.lock:
            path = self._forest.find_path(target, source, LATEST)
            return path.newest_common()[0] if path.moving else None

    def chain(self, target: str, source: str, at: AtLike = LATEST) -> list[str]:
        """The frames on the path, from target to source, both included.

        Raises
        ------
        UnknownFrameError, DisconnectedError

        Examples
        --------
        >>> tree = TransformTree()
        >>> _ = tree.insert(TransformStamped("map", "odom", 10, Transform()))
        >>> _ = tree.insert(TransformStamped("odom", "cart", 10, Transform()))
        >>> tree.chain("map", "cart")
        ['map', 'odom', 'cart']
        """
        if at is not LATEST:
            at = as_stamp(at)
        self._forest.search(target, source)
        with self._forest.lock:
            return list(self._forest.find_path(target, source, at).frames)

    # Questions about the tree itself

    def frames(self) -> list[str]:
        """Every frame that a sample in the tree names, sorted.

        Examples
        --------
        >>> tree = TransformTree()
        >>> _ = tree.insert(TransformStamped("map", "cart", 10, Transform()))
        >>> tree.frames()
        ['cart', 'map']
        """
        return list(self._forest.known_frames())

    def parent(self, frame: str, at: AtLike = LATEST) -> str | None:
        """The frame's parent: at a stamp, or the newest one. None for a root.

        Raises
        ------
        UnknownFrameError
        ExtrapolationError
            If the stamp is outside the frame's window.

        Examples
        --------
        >>> tree = TransformTree()
        >>> _ = tree.insert(TransformStamped("map", "cart", 10, Transform()))
        >>> tree.parent("cart")
        'map'
        """
        if at is not LATEST:
            at = as_stamp(at)
        with self._forest.lock:
            self._forest.check_known(frame)
            history = self._forest.frames.get(frame)
            if history is None:
                return None
            if isinstance(at, Latest):
                return history.parent
            if not history.covers(at):
                raise history.extrapolation_error(at)
            return history.parent_at(at)

    def samples_around(self, frame: str, at: StampLike) -> tuple[TransformStamped | None, TransformStamped | None]:
        """The two samples of a frame around a stamp that a lookup interpolates, as they were sent.

        Parameters
        ----------
        frame : str
        at : int
            ns.

        Returns
        -------
        before, after : TransformStamped or None
            None where there is none on that side. Twice the same if a sample has the very stamp, or is static.

        Raises
        ------
        UnknownFrameError
        TypeError, ValueError
            If `at` is not a stamp.

        Examples
        --------
        >>> tree = TransformTree()
        >>> _ = tree.insert_many([TransformStamped("map", "cart", stamp, Transform()) for stamp in (0, 10)])
        >>> [sample.stamp for sample in tree.samples_around("cart", 4)]
        [0, 10]
        """
        stamp = as_stamp(at)
        with self._forest.lock:
            self._forest.check_known(frame)
            history = self._forest.frames.get(frame)
            found = [] if history is None else list(samples_of(history, stamp, stamp))
        before = [sample for sample in found if sample.static or sample.stamp <= stamp]
        after = [sample for sample in found if sample.static or sample.stamp >= stamp]
        return (before[-1] if before else None), (after[0] if after else None)

    def samples(self, frame: str, start: StampLike | None = None, stop: StampLike | None = None) -> TransformArray:
        """The samples of a frame in its parent, as they were sent, at their own stamps.

        Parameters
        ----------
        frame : str
        start, stop : int, optional
            The first and the last stamp, in ns, both included; by default all in the window.

        Returns
        -------
        TransformArray
            In the order of the stamps. A static frame has one sample, at any `start` and `stop`; a root has none.

        Raises
        ------
        UnknownFrameError
        ValueError
            If the samples name several parents. The message has the stamps at which the parent changes, as bounds for
            `start` and `stop`.
        TypeError, ValueError
            If a bound is not a stamp.

        Examples
        --------
        >>> tree = TransformTree()
        >>> outcomes = tree.insert_columns("map", "base_link", [0, 100], [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]],
        ...                                [[0.0, 0.0, 0.0, 1.0]] * 2)
        >>> tree.samples("base_link", start=50).stamps
        array([100])
        """
        low, high = _bounds(start, stop)
        with self._forest.lock:
            self._forest.check_known(frame)
            history = self._forest.frames.get(frame)
            if history is not None and history.static:
                return from_columns(np.array([history.static_row]).T, stamps=np.array([history.static_stamp or 0]))
            samples = None if history is None else history.samples_between(low, high)
        if samples is None:
            return from_columns(np.empty((7, 0)), stamps=np.empty(0, np.int64))
        here = (low <= samples.stamps) & (samples.stamps <= high)
        if samples.parents is not None:
            named = [parent for parent, kept in zip(samples.parents, here.tolist(), strict=True) if kept]
            stamps = samples.stamps[here]
            changes = [i for i in range(1, len(named)) if named[i] != named[i - 1]]
            if changes:
                where = "; ".join(f"{named[i]!r} from {format_stamp(int(stamps[i]))}" for i in changes[:_SHOWN])
                raise ValueError(
                    f"frame {frame!r} has samples in several parents: {named[0]!r} first, {where}: give start and stop "
                    "between two changes"
                )
        return from_columns(np.ascontiguousarray(samples.rows[here].T), stamps=samples.stamps[here])

    def stamps(self, target: str, source: str, start: StampLike | None = None, stop: StampLike | None = None) -> Stamps:
        """The stamps at which the way between two frames was recorded, for `lookup_many` and `twist_many`.

        Parameters
        ----------
        target, source : str
        start, stop : int, optional
            The first and the last stamp, in ns, both included.

        Returns
        -------
        integer array of shape (n,)
            In ns, ascending: the stamps of the moving edge with the most samples on the newest path, as far as all
            moving edges on it have data. None of an all-static path.

        Raises
        ------
        UnknownFrameError, DisconnectedError
        TypeError, ValueError
            If a bound is not a stamp.

        Examples
        --------
        >>> tree = TransformTree()
        >>> for stamp in (0, 100):
        ...     outcome = tree.insert(TransformStamped("map", "base_link", stamp, Transform()))
        >>> tree.stamps("base_link", "map")
        array([  0, 100])
        """
        low, high = _bounds(start, stop)
        edges = moving_edges(self, target, source)
        oldest = [edge.oldest for edge in edges if edge.oldest is not None]
        newest = [edge.newest for edge in edges if edge.newest is not None]
        if not edges or len(oldest) < len(edges):
            return np.empty(0, np.int64)
        low, high = max(low, *oldest), min(high, *newest)
        densest = max(edges, key=lambda edge: edge.samples)
        with self._forest.lock:
            samples = self._forest.frames[densest.child].samples_between(low, high)
        stamps = samples.stamps
        return stamps[(low <= stamps) & (stamps <= high)]

    def edges(self) -> list[Edge]:
        """Every frame that has a parent, with its newest edge, sorted by name.

        Examples
        --------
        >>> tree = TransformTree()
        >>> _ = tree.insert(TransformStamped("map", "cart", 10, Transform(), "odometry"))
        >>> [(edge.parent, edge.child, edge.samples, edge.authority) for edge in tree.edges()]
        [('map', 'cart', 1, 'odometry')]
        """
        edges = self._forest.read_all(FrameHistory.edge)
        return [edges[child] for child in sorted(edges)]

    def __contains__(self, frame: object) -> bool:
        with self._forest.lock:
            return frame in self._forest.names

    # Changes other than samples

    def remove_frame(self, frame: str) -> None:
        """Take a frame off its parent and forget its samples; frames below it stay, as a tree of their own.

        Raises
        ------
        UnknownFrameError

        Examples
        --------
        >>> tree = TransformTree()
        >>> _ = tree.insert(TransformStamped("map", "cart", 10, Transform()))
        >>> tree.remove_frame("cart")
        >>> tree.frames()
        []
        """
        self._check_writable("use bus.remove_frame, or a copy() of the tree")
        self._forest.remove(frame)

    def clear(self) -> None:
        """Drop all moving samples. Static ones and the frames' names stay.

        Examples
        --------
        >>> tree = TransformTree()
        >>> _ = tree.insert(TransformStamped("map", "cart", 10, Transform()))
        >>> tree.clear()
        >>> tree
        <TransformTree of 2 frames, 0 samples>
        """
        self._check_writable("clear a copy() of it")
        self._forest.clear()

    def forget_before(self, stamp: StampLike) -> None:
        """Drop all moving samples that are older than a stamp, in ns; static ones and names stay.

        Later insertions are judged as before: a sample inside the window of its frame is stored, however old it is.

        Raises
        ------
        TypeError, ValueError
            If `stamp` is not a stamp.

        Examples
        --------
        >>> tree = TransformTree(keep=None)
        >>> _ = tree.insert_many([TransformStamped("map", "cart", stamp, Transform()) for stamp in (0, 10, 20)])
        >>> tree.forget_before(10)
        >>> tree
        <TransformTree of 2 frames, 2 samples, 0.00000001 s to 0.00000002 s>
        """
        self._check_writable("its samples leave it after `keep` seconds; or use a copy() of the tree")
        self._forest.rebuild(partial(save_frame, oldest=as_stamp(stamp)))

    def copy(self) -> TransformTree:
        """An independent copy with the same samples, such as a snapshot to analyse elsewhere.

        Examples
        --------
        >>> tree = TransformTree()
        >>> copied = tree.copy()
        >>> _ = tree.insert(TransformStamped("map", "cart", 10, Transform()))
        >>> copied.frames()
        []
        """
        twin = TransformTree(self.keep, max_translation=self.max_translation)
        twin._stand_on(self._forest.copy())
        return twin

    def __deepcopy__(self, memo: object) -> TransformTree:
        return self.copy()

    __copy__ = copy

    def __getstate__(self) -> dict[str, Any]:
        frames = self._forest.read_all(save_frame)
        return {"keep": self.keep, "max_translation": self.max_translation, "frames": list(map(tuple, frames.values()))}

    def __setstate__(self, state: dict[str, Any]) -> None:
        # As a copy: it can be changed, and its counters start at zero.
        self.__init__(state["keep"], max_translation=state["max_translation"])  # type: ignore[misc]
        for frame in state["frames"]:
            self._forest.add_saved(SavedFrame(*frame))

    # Text

    def describe(self, now: int | None = None) -> str:
        """The tree as text, with each edge's rate, age, span and authority.

        Parameters
        ----------
        now : int, optional
            The stamp that ages are counted from, in ns; by default the newest in the tree.

        Examples
        --------
        >>> tree = TransformTree()
        >>> _ = tree.insert(TransformStamped("map", "dock", 0, Transform(), "survey", static=True))
        >>> print(tree.describe())
        map
        └── dock  static  from 'survey'
        """
        return describe(self.edges(), now)

    def to_dot(self, now: int | None = None) -> str:
        """The tree in Graphviz's language; static edges are dashed.

        Parameters
        ----------
        now : int, optional
            With it, each edge has the colour of its state at this stamp (ns), and its age and span in the label.

        Examples
        --------
        >>> tree = TransformTree()
        >>> _ = tree.insert(TransformStamped("map", "dock", 0, Transform(), static=True))
        >>> tree.to_dot().splitlines()[0]
        'digraph tf {'
        """
        return to_dot(self.edges(), now)

    def to_yaml(self) -> str:
        """The tree as YAML with tf2's keys; stamps in s.

        Examples
        --------
        >>> tree = TransformTree()
        >>> _ = tree.insert(TransformStamped("map", "dock", 0, Transform(), static=True))
        >>> tree.to_yaml().splitlines()[0]
        '"dock":'
        """
        return to_yaml(self.edges())

    def __repr__(self) -> str:
        edges = self.edges()
        stamps = [stamp for edge in edges for stamp in (edge.oldest, edge.newest) if stamp is not None]
        span = f", {format_stamp(min(stamps))} to {format_stamp(max(stamps))}" if stamps else ""
        samples = counted(sum(edge.samples for edge in edges), "sample")
        return f"<TransformTree of {counted(len(self.frames()), 'frame')}, {samples}{span}>"

    def _repr_html_(self) -> str:
        """The tree as notebooks show it, with ages counted from the newest stamp in it."""
        edges = self.edges()
        return cell(to_html(edges, max((edge.newest for edge in edges if edge.newest is not None), default=0)))

    def _check_writable(self, instead: str) -> None:
        if self._filled_by_bus:
            raise RuntimeError(f"a bus feeds this tree: {instead}")


def tree_of(forest: Forest, keep: float | None, max_translation: float = MAX_TRANSLATION) -> TransformTree:
    """The tree over a forest that a bus fills. It cannot be changed, because a change would wake no waiting lookup."""
    tree = TransformTree(keep, max_translation=max_translation)
    tree._stand_on(forest)
    tree._filled_by_bus = True
    return tree


def moving_edges(tree: TransformTree, target: str, source: str) -> list[Edge]:
    """The moving edges on the newest path between two frames; raises as `TransformTree.chain`."""
    frames = set(tree.chain(target, source))
    return [edge for edge in tree.edges() if not edge.static and {edge.parent, edge.child} <= frames]


def forest_of(tree: TransformTree) -> Forest:
    """The forest behind a tree."""
    return tree._forest


def window_of(keep: float | None) -> int | None:
    """The length of history in ns for `keep` in s; None keeps everything.

    Raises
    ------
    ValueError
        If `keep` is negative or NaN, or a finite number above 1e8 s, which are three years.
    """
    seconds = None if keep is None else as_duration(keep, "keep")
    if seconds is None or seconds == math.inf:
        return None
    if seconds > _LONGEST_WINDOW:
        raise ValueError(
            f"keep must be at most {_LONGEST_WINDOW:,} s, or None for everything, got {keep!r}: "
            "nanoseconds passed as seconds?"
        )
    return from_seconds(seconds)


_SHOWN = 5


def _bounds(start: StampLike | None, stop: StampLike | None) -> tuple[int, int]:
    """The first and the last stamp, in ns; None is no bound."""
    return STAMP_MIN if start is None else as_stamp(start), STAMP_MAX if stop is None else as_stamp(stop)


def _as_many(source_at: StampLike | StampsLike, count: int) -> Stamps:
    """An array of `count` stamps, made of one stamp for all or of one each."""
    if np.ndim(cast(Any, source_at)) == 0:
        return np.full(count, as_stamp(source_at))
    stamps = as_stamps(cast(Any, source_at))
    if len(stamps) != count:
        raise ValueError(f"source_at must be one stamp, or have shape ({count},) as stamps has, got {stamps.shape}")
    return stamps
