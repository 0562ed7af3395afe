"""What a tree is asked: where one frame is, seen from another, at one stamp or at many, and how it moves."""

import threading
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from tfbus.data import PointCloud, TwistStamped
from tfbus.errors import DisconnectedError, ExtrapolationError, TransformLookupError
from tfbus.geometry.stamped import TransformStamped, answer_of, qualified_answer
from tfbus.geometry.transform_array import TransformArray, from_rows
from tfbus.stamps import LATEST, as_stamp, as_stamps
from tfbus.tree._extrapolation import Leniency
from tfbus.tree._lookup import GO_TOGETHER, At, resolve, resolve_travel
from tfbus.tree._lookup_many import FEW, Answers, Leg, OutOfRange, join, resolve_few, take
from tfbus.tree._velocity import twist
from tfbus.tree.explanation import Explanation, explain
from tfbus.tree.forest import Forest
from tfbus.tree.policy import Hold, Policy, policy_of

_AT_LATEST_ONLY = "not_before goes with LATEST: an answer at a given stamp never gets newer"


class TreeReader:
    """The questions about transforms that a `TransformTree` answers.

    The lock is held for one lookup, or while the samples for many are copied; never while numpy works on them.
    """

    def __init__(self, forest: Forest) -> None:
        self._lock = threading.Lock()
        self.forest = forest

    def lookup(
        self,
        target: str,
        source: str,
        at: At = LATEST,
        *,
        source_at: At | None = None,
        fixed: str | None = None,
        not_before: int | None = None,
        tolerance: float = 0.0,
        max_gap: float | None = None,
        extrapolate: Hold | None = None,
    ) -> TransformStamped:
        """Where `source` is, seen from `target`: the transform that maps source's data into target.

        Parameters
        ----------
        target, source : str
        at : int or LATEST
            ns. `LATEST` is the newest stamp that every moving edge on the path can answer; with `extrapolate`, the
            newest stamp of any of them, as far as the lagging one may be held.
        source_at : int or LATEST, optional
            Take source at this stamp instead, and carry it to `at` through `fixed`.
        fixed : str, optional
            The frame that is held still between the two stamps.
        not_before : int, optional
            Count a `LATEST` answer older than this (ns) as not yet arrived.
        tolerance : float
            Where an edge does not cover the stamp, or only by a gap that is too long, let its nearest sample within so
            many s stand in.
        max_gap : float, optional
            Refuse to interpolate between samples that are more than so many s apart.
        extrapolate : Hold, optional
            Where an edge has no sample after the stamp, or none that `max_gap` lets it interpolate to, let the one
            before it stand in, for a while.

        Returns
        -------
        TransformStamped
            Parent is target and child is source; its stamp is `at`, or the one that `LATEST` found. An answer whose
            whole path is static has ``static=True`` and, for `LATEST`, the newest stamp among its samples. In time
            travel, a `LATEST` that only static edges answer takes the stamp of source's leg. With a tolerance, a gap or
            a hold, `extrapolated_by` and `gap` say what was done.

        Raises
        ------
        UnknownFrameError, DisconnectedError, FutureExtrapolationError
            If it cannot be answered now, but may be later.
        PastExtrapolationError
            If it is older than an edge's window.
        GapError
            If it lies in a gap that is too long.
        TypeError
            If a stamp is a float, a frame is not a string, only one of `source_at` and `fixed` is given, or
            `not_before` comes without a `LATEST`.
        """
        policy = policy_of(tolerance, max_gap, extrapolate)
        return self.answer(target, source, at, source_at, fixed, not_before, policy)

    def answer(
        self,
        target: str,
        source: str,
        at: At,
        source_at: At | None,
        fixed: str | None,
        not_before: int | None,
        policy: Policy | None,
    ) -> TransformStamped:
        """As `lookup`, without keywords: every one of them would cost a twentieth of a lookup."""
        if not_before is not None and at is not LATEST and source_at is not LATEST:
            raise TypeError(_AT_LATEST_ONLY)
        if type(at) is not int and at is not LATEST:
            at = as_stamp(at)
        lenient = None if policy is None else Leniency(policy)
        with self._lock:
            if source_at is None and fixed is None:
                stamp, row, static = resolve(self.forest, target, source, at, not_before, lenient)
            else:
                stamp, row, static = resolve_travel(
                    self.forest, target, source, at, source_at, fixed, not_before, lenient
                )
        if lenient is None:
            return answer_of(target, source, stamp, row, static)
        return qualified_answer(target, source, stamp, row, static, lenient.extrapolated_by, lenient.gap)

    def can_transform(self, target: str, source: str, at: At = LATEST, **question: Any) -> bool:
        """Whether `lookup` with the same arguments has an answer now."""
        try:
            self.lookup(target, source, at, **question)
        except TransformLookupError:
            return False
        return True

    def explain(
        self,
        target: str,
        source: str,
        at: At = LATEST,
        *,
        not_before: int | None = None,
        tolerance: float = 0.0,
        max_gap: float | None = None,
        extrapolate: Hold | None = None,
        now: int | None = None,
    ) -> Explanation:
        """How `lookup` with these arguments comes to its answer, or all that keeps it from one; made to be printed.

        Parameters
        ----------
        target, source, at, not_before, tolerance, max_gap, extrapolate
            As `lookup`. Each leg of a time travel is a question of its own.
        now : int, optional
            The stamp that ages are counted from, in ns; by default the newest in the tree.

        Raises
        ------
        TypeError
            As `lookup`. What a lookup has no answer to is no error here.
        """
        policy = policy_of(tolerance, max_gap, extrapolate)
        if not_before is not None and at is not LATEST:
            raise TypeError(_AT_LATEST_ONLY)
        if at is not LATEST:
            at = as_stamp(at)
        with self._lock:
            return explain(self.forest, target, source, at, not_before, policy, now)

    def lookup_many(
        self,
        target: str,
        source: str,
        stamps: npt.ArrayLike,
        *,
        source_at: npt.ArrayLike | None = None,
        fixed: str | None = None,
        out_of_range: OutOfRange = "raise",
        tolerance: float = 0.0,
        max_gap: float | None = None,
        extrapolate: Hold | None = None,
    ) -> TransformArray:
        """As `lookup`, at many stamps at once.

        Parameters
        ----------
        target, source : str
        stamps : integer array of shape (n,)
            ns, in any order.
        source_at : int, or integer array of shape (n,), optional
            Take source at these stamps instead, and carry it to `stamps` through `fixed`.
        fixed : str, optional
            The frame that is held still between the two stamps.
        out_of_range : {"raise", "nan"}
            What becomes of stamps without an answer: an error that names the first, or NaN in their places.
        tolerance, max_gap, extrapolate
            As `lookup`.

        Returns
        -------
        TransformArray
            One transform a stamp, in the order of `stamps`; its `extrapolated_by` and `gap` say what was done.

        Raises
        ------
        UnknownFrameError
        DisconnectedError
            If there is no path at some stamp; with ``"nan"``, only if there is none at any.
        ExtrapolationError
            If a stamp is outside an edge's window; `index` says which.
        TypeError
            If stamps are not integers, or only one of `source_at` and `fixed` is given.
        ValueError
            If shapes do not agree.
        """
        asked = as_stamps(stamps)
        if (source_at is None) != (fixed is None):
            raise TypeError(GO_TOGETHER)
        source_stamps = None if source_at is None else _as_many(source_at, len(asked))
        policy = policy_of(tolerance, max_gap, extrapolate)
        _check_out_of_range(out_of_range)
        if len(asked) <= FEW and policy is None:
            try:
                with self._lock:
                    rows = resolve_few(self.forest, target, source, asked, source_stamps, fixed)
            except (ExtrapolationError, DisconnectedError):
                pass
            else:
                return from_rows(rows)

        def ask(place: int) -> None:
            source_stamp = None if source_stamps is None else int(source_stamps[place])
            self.answer(target, source, int(asked[place]), source_stamp, fixed, None, policy)

        legs = [Leg(target, source, asked)]
        if source_stamps is not None and fixed is not None:
            legs = [Leg(target, fixed, asked), Leg(fixed, source, source_stamps)]
        return join(self._work_out(legs, ask, policy, out_of_range))

    def _work_out(
        self, legs: list[Leg], ask: Callable[[int], object], policy: Policy | None, out_of_range: OutOfRange
    ) -> list[Answers]:
        """The answers on each leg; `ask` is called for a place without one, and raises the scalar lookup's error."""
        while True:
            ends = [leg.ends() for leg in legs]
            with self._lock:
                taken = [take(self.forest, leg.target, leg.source, end) for leg, end in zip(legs, ends, strict=True)]
            answers = [Answers(its, leg, policy) for its, leg in zip(taken, legs, strict=True)]
            missing = [its.first_missing for its in answers if its.first_missing is not None]
            if not missing:
                return answers
            cut_off = [leg for its, leg in zip(answers, legs, strict=True) if not its.connected]
            if out_of_range == "nan" and not cut_off:
                return answers
            first = min(missing)
            try:
                if out_of_range == "raise":
                    ask(first)
                else:
                    self._ask_again(cut_off[0], first)
            except TransformLookupError as error:
                error.index = first
                raise
            # What was missing has come meanwhile.

    def _ask_again(self, leg: Leg, place: int) -> None:
        self.answer(leg.target, leg.source, int(leg.stamps[place]), None, None, None, None)

    def deskew(self, cloud: PointCloud, target: str, fixed: str, *, out_of_range: OutOfRange = "raise") -> PointCloud:
        """A cloud from a moving sensor, as if all points had been seen at once, at the stamp of the cloud.

        Each point goes by the transform of its own stamp into `fixed`, and from there into `target` at the stamp of the
        cloud.

        Parameters
        ----------
        cloud : PointCloud
            With a stamp for each point. If its own is `LATEST`, that of the newest point is meant.
        target : str
            The frame of the result; often that of the cloud.
        fixed : str
            The frame that stands still meanwhile, such as ``"odom"``.
        out_of_range : {"raise", "nan"}
            As for `lookup_many`; points without an answer become NaN. The stamp of the cloud itself has to be covered.

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
        """
        if cloud.stamps is None:
            raise ValueError("the points of the cloud have no stamps")
        at = cloud.stamp
        if at is LATEST and len(cloud):
            at = int(cloud.stamps.max())
        _check_out_of_range(out_of_range)
        found = self.answer(target, fixed, at, None, None, None, None)
        leg = Leg(fixed, cloud.frame, cloud.stamps)
        (answers,) = self._work_out([leg], partial(self._ask_again, leg), None, out_of_range)
        points = answers.apply(cloud.points, found.transform._row)
        return PointCloud(target, found.stamp, points, fields=cloud.fields)

    def twist(self, frame: str, reference: str, at: At = LATEST, *, expressed_in: str | None = None) -> TwistStamped:
        """How `frame` moves, seen from `reference`: the derivative of what `lookup` interpolates.

        Parameters
        ----------
        frame, reference : str
        at : int or LATEST
            ns. `LATEST` is the newest stamp at which all that is needed can be answered.
        expressed_in : str, optional
            The frame along whose axes the velocities are told; by default `reference`.

        Returns
        -------
        TwistStamped
            Its frame is `expressed_in`, but `linear` is the velocity of the origin of `frame` in m/s, whatever the
            axes; `angular` is the angular velocity in rad/s. At a sample it is the derivative from before, at the first
            of an edge's window or of a new parent that from after. From the last sample with one parent to the first
            with another an edge stands still.

        Raises
        ------
        TransformLookupError
            As `lookup`; and `FutureExtrapolationError` at an edge's newest sample if it is the only one, or the only
            one with its parent.

        Notes
        -----
        Move only an answer with ``expressed_in=frame`` by `do_transform`: it is the twist of the body that the frame is
        fixed to, told at the frame's own origin, and can be told at other frames of that body. In other axes, as by
        default, it is not told at the origin of its frame, and `do_transform` would give a wrong velocity.

        tf2's `lookupVelocity` gives other numbers: it rotates what is in the observer's axes once more by the body's
        rotation.
        """
        axes = reference if expressed_in is None else expressed_in
        if at is not LATEST:
            at = as_stamp(at)
        with self._lock:
            stamp, linear, angular = twist(self.forest, frame, reference, at, axes)
        return TwistStamped(axes, stamp, linear, angular)

    def latest_common_stamp(self, target: str, source: str) -> int | None:
        """The stamp that `LATEST` means for these two frames, in ns; None where the whole path is static.

        Raises
        ------
        UnknownFrameError, DisconnectedError, FutureExtrapolationError
            As `lookup`.
        """
        with self._lock:
            path = self.forest.find_path(target, source, LATEST)
            return path.newest_common()[0] if path.moving else None

    def chain(self, target: str, source: str, at: At = LATEST) -> list[str]:
        """The frames on the path, from target to source, both included.

        Raises
        ------
        UnknownFrameError, DisconnectedError
        """
        if at is not LATEST:
            at = as_stamp(at)
        with self._lock:
            return list(self.forest.find_path(target, source, at).frames)


def _check_out_of_range(value: OutOfRange) -> None:
    if value not in ("raise", "nan"):
        raise ValueError(f"out_of_range must be 'raise' or 'nan', not {value!r}")


def _as_many(source_at: npt.ArrayLike, count: int) -> npt.NDArray[np.int64]:
    """As many stamps as there are questions, from one for all or one for each."""
    if np.ndim(source_at) == 0:
        return np.full(count, as_stamp(source_at))
    stamps = as_stamps(source_at)
    if len(stamps) != count:
        raise ValueError(f"source_at must be one stamp, or have shape ({count},) as stamps has, got {stamps.shape}")
    return stamps
