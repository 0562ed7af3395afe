"""The buffer: a tree that a bus fills, and lookups that wait for missing transforms."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from types import TracebackType
from typing import Any, Literal, SupportsIndex, TypedDict, TypeVar, Unpack, cast, overload

from tfbus._aio.loops import checkpoint
from tfbus.buffer.lookups import LocalNames, Lookups
from tfbus.buffer.watch import Watch
from tfbus.bus.bus import Bus
from tfbus.data import PointCloud, Stamped, do_transform
from tfbus.errors import LookupTimeoutError, TransformLookupError, clock_named
from tfbus.frames import as_prefix, is_frame
from tfbus.geometry.stamped import TransformStamped, renamed
from tfbus.registration import Registration
from tfbus.stamps import LATEST, AtLike, as_at, as_duration
from tfbus.tf2_names import says_ours
from tfbus.tree.explanation import Explanation
from tfbus.tree.forest import Forest
from tfbus.tree.history import Edge
from tfbus.tree.lookup import Hold, Options, Question, answer, policy_of, question_of
from tfbus.tree.lookup_many import deskew, deskew_stamps
from tfbus.tree.rendering import cell, counted, describe, to_html
from tfbus.tree.tree import TransformTree, forest_of, tree_of, window_of
from tfbus.tree.uncertain import uncertain_answer
from tfbus.uncertainty import UncertainTransform
from tfbus.uncertainty.data import with_error_of
from tfbus.waiting.live_tree import LiveTree, PendingLookup
from tfbus.which_kernel import plain_first

DataT = TypeVar("DataT", bound=Stamped)


class _Options(Options, total=False):
    max_age: float | None


class _WaitOptions(_Options, total=False):
    timeout: float | None


class _TransformOptions(TypedDict, total=False):
    timeout: float | None
    max_age: float | None
    at: AtLike | None
    fixed: str | None
    tolerance: float
    max_gap: float | None
    extrapolate: Hold | None


_DESCRIBED = 10
"""The number of waiting lookups that `describe` shows; each may have to search all frames for similar names."""


@says_ours
class Buffer:
    """A few seconds of every frame on a bus, and the transforms between them.

    Parameters
    ----------
    bus : Bus
        It fills the buffer from now on, first with the latched samples, and holds it until `close`. If the bus has had
        a newer sample of a frame with another parent before the buffer joined, a late sample of that frame is left out
        and counted as `superseded`: the buffer would take it for the newest.
    keep : float or None
        Length of the history of each frame, in s before that frame's newest stamp; None keeps everything. A late
        sample then costs more the longer the history is, because all samples after it are moved: in the middle of a
        million samples some ms.
    prefix : str, optional
        The prefix of this buffer's frames on the bus, such as ``"robot1/"``, so that several robots with the same
        frames can share a bus. All methods take and give names without it.
    shared : iterable of str
        Names without a prefix, because they are the same for all robots, such as ``{"map"}``.
    prefill : Buffer or TransformTree, optional
        Start with a copy of its history, as far as `keep` reaches. With a buffer of the same bus, the new buffer
        answers as if it had been there from the beginning. Otherwise the latched samples of this bus are added, and
        both must have stamps of the same clock: a sample older than its window expires. A closed buffer still has the
        frames that were removed after it was closed. Where the prefill contradicts the bus, the bus is right: a frame
        with another newest parent, or with an edge that would close a loop on the bus, is left out or removed.

    Raises
    ------
    BusClosedError
        If the bus is closed.
    ValueError
        If `keep` is negative, or finite and above 1e8; if the prefix, or a shared name, is empty or starts with a
        slash, or a shared name starts with the prefix.
    TypeError
        If an argument is of another type, or there are shared names but no prefix.

    Notes
    -----
    Buffers of one bus with the same `keep` share their samples, in memory and at work, if they would hold the same: if
    no sample came between their beginnings, or the later one was prefilled from the earlier one. When one of them is
    closed and still used, the next sample costs one copy of all.

    Any thread may use the methods that only read. `lookup`, `transform`, `watch` and `close` belong to the event loop
    of the bus.

    With a prefix, the frames of another robot have no name here: to ask for them, use a buffer without a prefix. `tree`
    and all errors have the names of the bus. Texts and explanations write a frame of another robot with a slash in
    front.

    Examples
    --------
    >>> with Bus() as bus, Buffer(bus) as buffer:
    ...     TransformBroadcaster(bus).send_static("base_link", "laser", Transform((0.1, 0.0, 0.2)))
    ...     print(buffer.describe())
    base_link
    └── laser  static
    """

    def __init__(
        self,
        bus: Bus,
        keep: float | None = 10.0,
        *,
        prefix: str | None = None,
        shared: Iterable[str] = (),
        prefill: Buffer | TransformTree | None = None,
    ) -> None:
        self.bus = bus
        self._clock = bus.clock
        named = as_prefix(prefix, shared)
        self._local_names = None if named is None else LocalNames(named)
        window = window_of(keep)
        self._share = bus._attach(window, self._prefilled(prefill, window))
        self._tree = tree_of(self._share.live.forest, keep, bus.max_translation)
        self._lookups = Lookups(self._share, bus, self._local_names)
        self._stand_on(self._share.live.forest)

    def _prefilled(self, prefill: Buffer | TransformTree | None, window: int | None) -> Forest | LiveTree | None:
        """Nothing to begin with, or the live tree of a buffer that has all it would have, or a copy of a buffer."""
        if prefill is None:
            return None
        tree = prefill
        if isinstance(prefill, Buffer):
            share, tree = prefill._share, prefill.tree
            if prefill.bus is self.bus and share.end_reason is None and share.live.forest.window == window:
                return share.live
        if not isinstance(tree, TransformTree):
            raise TypeError(f"prefill must be a Buffer or a TransformTree, not {prefill!r}")
        self.bus._check_thread()
        return forest_of(tree).copy_within(window)

    def _stand_on(self, forest: Forest) -> None:
        self._forest = self._lookups.forest = forest
        self._paths = forest.paths if self._local_names is None else forest.local_paths()
        self._paths.now = self._lookups.now
        self._paths.clock_namers = self.bus._clock_namers
        plain = self._local_names is None and forest is self._share.live.forest
        self._feed = self._lookups.feed if plain else None

    @property
    def tree(self) -> TransformTree:
        """The tree behind this buffer. It can only be read: its samples come from the bus."""
        return self._tree

    @overload
    def lookup_nowait(
        self, target: str, source: str, at: AtLike = ..., *, covariance: Literal[True], **options: Unpack[_Options]
    ) -> UncertainTransform: ...

    @overload
    def lookup_nowait(
        self, target: str, source: str, at: AtLike = ..., *, covariance: bool = ..., **options: Unpack[_Options]
    ) -> TransformStamped: ...

    @plain_first
    def lookup_nowait(
        self,
        target: str,
        source: str,
        at: AtLike = LATEST,
        *,
        max_age: float | None = None,
        source_at: AtLike | None = None,
        fixed: str | None = None,
        tolerance: float = 0.0,
        max_gap: float | None = None,
        extrapolate: Hold | None = None,
        covariance: bool = False,
    ) -> TransformStamped:
        """The transform from `source` to `target`, or an error at once. See `TransformTree.lookup`.

        Parameters
        ----------
        target, source : str
        at : int or LATEST
            ns.
        max_age : float, optional
            Count a `LATEST` answer older than this many s as not yet arrived, and refuse an answer that is further than
            this ahead of the clock.
        source_at, fixed, tolerance, max_gap, extrapolate, covariance
            As `TransformTree.lookup`.

        Raises
        ------
        TransformLookupError, TypeError
            As `TransformTree.lookup`.

        Examples
        --------
        >>> with Bus() as bus, Buffer(bus) as buffer:
        ...     broadcaster = TransformBroadcaster(bus)
        ...     broadcaster.send("map", "base_link", Transform((1.0, 2.0, 0.0)))
        ...     broadcaster.send_static("base_link", "laser", Transform((0.1, 0.0, 0.2)))
        ...     buffer.lookup_nowait("map", "laser").transform.translation
        (1.1, 2.0, 0.2)
        """
        bounds = None if max_age is None else self._lookups.bounds(max_age, as_at(at), as_at(source_at))
        names = self._local_names
        policy = policy_of(tolerance, max_gap, extrapolate)
        ask: Callable[..., TransformStamped] = uncertain_answer if covariance else answer
        try:
            if names is None:
                return ask(self._forest, target, source, at, source_at, fixed, bounds, policy)
            via = None if fixed is None else names.on_bus(fixed)
            above, below = names.on_bus(target), names.on_bus(source)
            found = ask(self._forest, above, below, at, source_at, via, bounds, policy)
            # The next such lookup is as plain as one without a prefix.
            self._forest.keep_locally(self._paths, (target, source), above, below)
        except TransformLookupError as error:
            self._lookups.complete(error, max_age, bounds)
            raise
        # Not `names.answer`, which costs a fifth of this lookup: the local names are at hand.
        return renamed(found, target, source)

    @overload
    async def lookup(
        self, target: str, source: str, at: AtLike = ..., *, covariance: Literal[True], **options: Unpack[_WaitOptions]
    ) -> UncertainTransform: ...

    @overload
    async def lookup(
        self, target: str, source: str, at: AtLike = ..., *, covariance: bool = ..., **options: Unpack[_WaitOptions]
    ) -> TransformStamped: ...

    async def lookup(
        self,
        target: str,
        source: str,
        at: AtLike = LATEST,
        *,
        timeout: float | None = None,
        max_age: float | None = None,
        source_at: AtLike | None = None,
        fixed: str | None = None,
        tolerance: float = 0.0,
        max_gap: float | None = None,
        extrapolate: Hold | None = None,
        covariance: bool = False,
    ) -> TransformStamped:
        """The transform from `source` to `target`, as soon as it is known.

        If the answer is known, it comes after one checkpoint. If waiting cannot help, the lookup fails at once: a stamp
        older than an edge's window raises `PastExtrapolationError`. Otherwise it waits; for a frame that nobody
        publishes, it waits for ever unless there is a timeout, and is logged after 5 s.

        Parameters
        ----------
        target, source : str
        at : int or LATEST
            ns. `LATEST` is the newest stamp that every moving edge on the path can answer.
        timeout : float, optional
            In s on the bus's clock; None waits for ever.
        max_age : float, optional
            Count a `LATEST` answer older than this many s as not yet arrived, so that the last sample of a dead
            broadcaster does not answer for ever. Refuse an answer that is further than this ahead of the clock.
        source_at : int or LATEST, optional
            Take source at this stamp instead, and carry it to `at` through `fixed`.
        fixed : str, optional
            The frame that stands still between the two stamps.
        tolerance, max_gap, extrapolate
            As `TransformTree.lookup`. The wait ends at the first moment at which they allow an answer.
        covariance : bool
            As `TransformTree.lookup`.

        Returns
        -------
        TransformStamped
            Parent is target and child is source.

        Raises
        ------
        LookupTimeoutError
            If the timeout ran out; its ``__cause__`` says what was still missing.
        PastExtrapolationError
            If it is older than an edge's window.
        GapError
            If the stamp lies in a gap that is too long.
        AheadError
            If the answer is further ahead of the clock than `max_age`.
        BusClosedError
            If there is no answer and no more samples will come.
        ClockResetError
            If the clock jumped back meanwhile.
        UnknownFrameError
            At once, if a name cannot be the name of a frame: empty, or with a leading slash.
        TypeError
            If a stamp is a float, or `max_age` comes without a `LATEST`.

        Examples
        --------
        >>> clock = SimulatedClock()
        >>> bus = Bus(clock)
        >>> with Buffer(bus) as buffer:
        ...     TransformBroadcaster(bus).send("map", "cart", Transform((1.0, 2.0, 0.0)))
        ...     print((await buffer.lookup("map", "cart", clock.now(), timeout=1.0)).transform.translation)
        (1.0, 2.0, 0.0)
        """
        if covariance:
            question = Question(
                target, source, as_at(at), as_at(source_at), fixed, max_age, policy_of(tolerance, max_gap, extrapolate)
            )
            return await self._uncertain(self._on_bus(question), timeout)
        waits_plainly = max_age is None and source_at is None and fixed is None and not tolerance
        if self._feed is None or not waits_plainly or max_gap is not None or extrapolate is not None:
            policy = policy_of(tolerance, max_gap, extrapolate)
            question = Question(target, source, as_at(at), as_at(source_at), fixed, max_age, policy)
            return await self._lookups.lookup(self._on_bus(question), timeout)
        live = self._share.live
        last_reset = live.last_reset
        wait = self._feed.ask(target, source, at, timeout)
        if wait is None and timeout is not None:
            wait = self._feed.ask(target, source, at, as_duration(timeout, "timeout"))
        try:
            await wait
            found: TransformStamped | None = wait.answer
            if found is None or live.last_reset is not last_reset:
                wait.asked = Question(target, source, as_at(at))
                if wait.names is None:
                    # The kernel has not parked it.
                    wait.since = self._clock.now()
                return await self._lookups.go_on(wait, last_reset)
        except BaseException:
            self._lookups.end(wait)
            raise
        if wait.cancel_end is not None:
            wait.cancel_end()
        return found

    @overload
    async def transform(
        self, data: Stamped, target: str, *, covariance: Literal[True], **options: Unpack[_TransformOptions]
    ) -> Any: ...

    @overload
    async def transform(
        self, data: DataT, target: str, *, covariance: Literal[False] = ..., **options: Unpack[_TransformOptions]
    ) -> DataT: ...

    async def transform(
        self,
        data: Any,
        target: str,
        *,
        timeout: float | None = None,
        max_age: float | None = None,
        at: AtLike | None = None,
        fixed: str | None = None,
        tolerance: float = 0.0,
        max_gap: float | None = None,
        extrapolate: Hold | None = None,
        covariance: bool = False,
    ) -> Any:
        """`data` in the frame `target`, by the transform at their own stamp, as soon as it is known.

        Parameters
        ----------
        data : any type of `tfbus.data` but LaserScan, or a type registered with `do_transform`
            With `frame` and `stamp`; the stamp may be `LATEST`.
        target : str
            Data that are in this frame already stay as they are, even if the buffer does not know the frame.
        timeout, max_age : float, optional
            As `lookup`.
        at : int or LATEST, optional
            Move the data from their own stamp to this one (ns), through `fixed`.
        fixed : str, optional
            The frame that stands still between the two stamps.
        tolerance, max_gap, extrapolate
            As `lookup`. The result does not say whether samples were held or extrapolated; if that matters, look the
            transform up.
        covariance : bool
            Whether the error of the transform is added to the data's own: for an `Odometry`, a
            `PoseWithCovarianceStamped` or a `PointWithCovarianceStamped`, or a `PoseStamped` or `PointStamped`, which
            becomes one.

        Returns
        -------
        same type as `data`
            Its frame is `target`, and its stamp is the stamp of the transform. With `covariance`, a pose or a point
            without one comes back with one.

        Raises
        ------
        TypeError
            If `data` are of a type that is not registered or has no frame and stamp, or only one of `at` and `fixed`
            is given.
        TransformError
            As `lookup`.

        Examples
        --------
        >>> bus = Bus(SimulatedClock())
        >>> TransformBroadcaster(bus).send_static("base_link", "laser", Transform((0.1, 0.0, 0.2)))
        >>> with Buffer(bus) as buffer:
        ...     print(await buffer.transform(PointStamped("laser", 0, (1.0, 0.0, 0.0)), "base_link", timeout=1.0))
        PointStamped(frame='base_link', stamp=0, point=(1.1, 0.0, 0.2))
        """
        question = question_of(data, target, as_at(at), fixed, max_age, policy_of(tolerance, max_gap, extrapolate))
        if self._is_in_place(question):
            await checkpoint()
            return data
        if covariance:
            return with_error_of(data, await self._uncertain(self._on_bus(question), timeout))
        return do_transform(data, await self._lookups.lookup(self._on_bus(question), timeout))

    async def _uncertain(self, question: Question, timeout: float | None) -> UncertainTransform:
        """The answer to a question in the names of the bus, with its error, as soon as it is known."""
        await self._lookups.lookup(question, timeout)
        # Nothing is awaited from here on: the edges are read as they are now.
        return cast(UncertainTransform, self._lookups.lookup_nowait(question, uncertain_answer))

    async def deskew(
        self,
        cloud: PointCloud,
        target: str,
        *,
        fixed: str,
        timeout: float | None = None,
        tolerance: float = 0.0,
        max_gap: float | None = None,
        extrapolate: Hold | None = None,
    ) -> PointCloud:
        """A cloud from a moving sensor as if all points had been seen at its stamp, as soon as that is known.

        It waits for the transforms of the newest point and of the stamp of the cloud. If the oldest point has no
        transform any more, it fails at once. `TransformTree.deskew` does the rest, and can leave such points out:
        ``buffer.tree.deskew(cloud, target, fixed, out_of_range="nan")``.

        Parameters
        ----------
        cloud : PointCloud
            With a stamp for each point; `LaserScan.to_points` gives such a cloud.
        target : str
            The frame of the result; often the frame of the cloud.
        fixed : str
            The frame that stands still meanwhile, such as ``"odom"``.
        timeout : float, optional
            In s on the bus's clock, for everything together; None waits for ever.
        tolerance, max_gap, extrapolate
            As `lookup`, for each point.

        Returns
        -------
        PointCloud
            In `target`, without stamps for the points, of the same float type and with the same fields.

        Raises
        ------
        TransformError
            As `lookup`; `index` says which point has no answer.
        ValueError
            If the points have no stamps.
        TypeError
            If `cloud` is no `PointCloud`.

        Examples
        --------
        >>> async def straighten(buffer: Buffer, scan: LaserScan) -> PointCloud:
        ...     return await buffer.deskew(scan.to_points(), "base_link", fixed="odom", timeout=0.2)
        """
        at, stamps = deskew_stamps(cloud)
        policy = policy_of(tolerance, max_gap, extrapolate)
        # The oldest one first: it may fail at once.
        ends = (int(stamps.min()), int(stamps.max())) if len(stamps) else ()
        questions = [self._on_bus(Question(fixed, cloud.frame, end, policy=policy)) for end in ends]
        questions.append(self._on_bus(Question(target, fixed, at, policy=policy)))
        patience = math.inf if timeout is None else as_duration(timeout, "timeout")
        with self._clock.move_on_after(patience) as all_of_them:
            for question in questions:
                await self._lookups.lookup(question, None)
        for question in questions if all_of_them.cancelled_caught else ():
            try:
                await self._lookups.lookup(question, 0.0)
            except LookupTimeoutError as error:
                error.timeout = patience
                raise
        if self._local_names is None:
            return deskew(self._forest, cloud, target, fixed, "raise", policy)
        above, below, still = map(self._local_names.on_bus, (target, cloud.frame, fixed))
        found = deskew(self._forest, replace(cloud, frame=below), above, still, "raise", policy)
        return replace(found, frame=target)

    def transform_nowait(
        self,
        data: DataT,
        target: str,
        *,
        max_age: float | None = None,
        at: AtLike | None = None,
        fixed: str | None = None,
        tolerance: float = 0.0,
        max_gap: float | None = None,
        extrapolate: Hold | None = None,
    ) -> DataT:
        """As `transform`, or an error at once.

        Raises
        ------
        TransformLookupError
            As `lookup_nowait`, if there is no answer now.
        TypeError
            As `transform`.

        Examples
        --------
        >>> bus = Bus(SimulatedClock())
        >>> TransformBroadcaster(bus).send_static("base_link", "laser", Transform((0.1, 0.0, 0.2)))
        >>> with Buffer(bus) as buffer:
        ...     print(buffer.transform_nowait(PointStamped("laser", 0, (1.0, 0.0, 0.0)), "base_link").point)
        (1.1, 0.0, 0.2)
        """
        policy = policy_of(tolerance, max_gap, extrapolate)
        if at is None and fixed is None and max_age is None and policy is None:
            plain = self._paths.answer(target, getattr(data, "frame", ""), getattr(data, "stamp", None))
            if plain is not None:
                return do_transform(data, plain)
        question = question_of(data, target, as_at(at), fixed, max_age, policy)
        if self._is_in_place(question):
            return data
        return do_transform(data, self._lookups.lookup_nowait(self._on_bus(question)))

    async def can_transform_within(
        self,
        target: str,
        source: str,
        timeout: float | None,
        at: AtLike = LATEST,
        *,
        max_age: float | None = None,
        source_at: AtLike | None = None,
        fixed: str | None = None,
        tolerance: float = 0.0,
        max_gap: float | None = None,
        extrapolate: Hold | None = None,
    ) -> bool:
        """Whether `lookup` with the same arguments has an answer within a time; tf2's ``can_transform`` with a timeout.

        Parameters
        ----------
        target, source, at, max_age, source_at, fixed, tolerance, max_gap, extrapolate
            As `lookup`.
        timeout : float or None
            In s, on the bus's clock; None waits for ever.

        Returns
        -------
        bool
            False once the time is up, or at once if waiting cannot help.

        Raises
        ------
        BusClosedError, ClockResetError, TypeError
            As `lookup`.

        Examples
        --------
        >>> with Bus(SimulatedClock()) as bus, Buffer(bus) as buffer:
        ...     print(await buffer.can_transform_within("map", "cart", 0.0))
        False
        """
        try:
            await self.lookup(
                target,
                source,
                at,
                timeout=timeout,
                max_age=max_age,
                source_at=source_at,
                fixed=fixed,
                tolerance=tolerance,
                max_gap=max_gap,
                extrapolate=extrapolate,
            )
        except TransformLookupError:
            return False
        return True

    def can_transform(
        self,
        target: str,
        source: str,
        at: AtLike = LATEST,
        *,
        max_age: float | None = None,
        source_at: AtLike | None = None,
        fixed: str | None = None,
        tolerance: float = 0.0,
        max_gap: float | None = None,
        extrapolate: Hold | None = None,
    ) -> bool:
        """Whether `lookup_nowait` with the same arguments has an answer now.

        Examples
        --------
        >>> bus = Bus(SimulatedClock())
        >>> with Buffer(bus) as buffer:
        ...     TransformBroadcaster(bus).send("map", "cart", Transform(), at=10)
        ...     print([buffer.can_transform("map", "cart", stamp) for stamp in (10, 11)])
        ...     print(buffer.can_transform("map", "cart", 11, tolerance=0.1))
        [True, False]
        True
        """
        travels = source_at is not None or fixed is not None
        if not (travels or tolerance or max_age is not None or max_gap is not None or extrapolate is not None):
            known = self._paths.can_answer(target, source, at)
            if known is not None:
                return known
        try:
            self.lookup_nowait(
                target,
                source,
                at,
                max_age=max_age,
                source_at=source_at,
                fixed=fixed,
                tolerance=tolerance,
                max_gap=max_gap,
                extrapolate=extrapolate,
            )
        except TransformLookupError:
            return False
        return True

    def watch(
        self,
        target: str,
        source: str,
        *,
        min_translation: float = 0.0,
        min_rotation: float = 0.0,
        max_rate: float | None = None,
        max_age: float | None = None,
        tolerance: float = 0.0,
        max_gap: float | None = None,
        extrapolate: Hold | None = None,
    ) -> Watch:
        """The answer at `LATEST` whenever it has changed: ``with buffer.watch(...) as w: async for transform in w``.

        It starts with the present answer, and compares each later one with the last answer that it gave. A slow reader
        gets the newest answer when it reads. An insertion elsewhere in the tree wakes no watch. While there is no
        answer, the watch waits as `lookup` does. It raises none of the errors of `lookup`: at `LATEST` no stamp is too
        old or in a gap for good, so the watch waits for the lagging edge.

        Parameters
        ----------
        target, source : str
        min_translation : float
            In m. Give an answer when source has moved by this much.
        min_rotation : float
            In rad. Give an answer when source has turned by this much. With both thresholds, one is enough; without
            any, the watch gives every answer with another stamp or value.
        max_rate : float, optional
            Give at most this many answers per s on the bus's clock. Only the last answer, after the end, may come
            sooner.
        max_age : float, optional
            Ignore answers that are older than this many s, or further ahead of the clock. An answer that was given is
            not withdrawn when it gets old.
        tolerance, max_gap, extrapolate
            As `lookup`.

        Returns
        -------
        Watch
            It belongs to the buffer until it is closed. When the clock jumps back, it raises `ClockResetError` once and
            starts over. When the watch, the buffer or the bus is closed, it gives a pending change, then ends.

        Raises
        ------
        UnknownFrameError
            If a name cannot be the name of a frame: empty, or with a leading slash.
        TypeError, ValueError
            If a threshold is negative or an angle of more than pi, a rate is not greater than zero, or something is not
            a number.

        Examples
        --------
        >>> bus = Bus(SimulatedClock())
        >>> with Buffer(bus) as buffer, buffer.watch("map", "cart") as changes:
        ...     TransformBroadcaster(bus).send("map", "cart", Transform((1.0, 0.0, 0.0)), at=10)
        ...     async for transform in changes:
        ...         print(transform)
        ...         break
        map <- cart at 0.00000001 s: Transform(translation=(1.0, 0.0, 0.0), rotation=(0.0, 0.0, 0.0, 1.0))
        """
        self.bus._check_thread()
        question = Question(target, source, LATEST, max_age=max_age, policy=policy_of(tolerance, max_gap, extrapolate))
        return Watch(
            self._on_bus(question),
            min_translation,
            min_rotation,
            max_rate,
            self._lookups,
        )

    def explain(
        self,
        target: str,
        source: str,
        at: AtLike = LATEST,
        *,
        max_age: float | None = None,
        tolerance: float = 0.0,
        max_gap: float | None = None,
        extrapolate: Hold | None = None,
    ) -> Explanation:
        """An explanation of the answer of `lookup_nowait`, or of everything that blocks it.

        See `TransformTree.explain`; ages are counted from the clock's now.

        Examples
        --------
        >>> bus = Bus(SimulatedClock())
        >>> with Buffer(bus) as buffer:
        ...     TransformBroadcaster(bus).send("map", "cart", Transform(), at=0)
        ...     print(buffer.explain("map", "cart", 0).answerable)
        True
        """
        instant = as_at(at)
        asked = self._on_bus(Question(target, source, instant))
        bounds = None if max_age is None else self._lookups.bounds(max_age, instant, None)
        found = self.tree.explain(
            asked.target,
            asked.source,
            at,
            not_before=None if bounds is None else bounds.not_before,
            not_after=None if bounds is None else bounds.not_after,
            tolerance=tolerance,
            max_gap=max_gap,
            extrapolate=extrapolate,
            now=self._clock.now(),
        )
        for error in found.errors:
            self._lookups.complete(error, max_age, bounds)
        namers = self.bus._clock_namers
        edges = (replace(edge, clock=clock_named(namers, edge.child)) for edge in found.edges)
        found = replace(found, edges=tuple(edges))
        return found if self._local_names is None else self._local_names.explanation(found, target, source)

    def pending(self) -> tuple[PendingLookup, ...]:
        """The lookups that wait now, and the watches without an answer, each with the error that blocks it.

        Examples
        --------
        >>> bus = Bus(SimulatedClock())
        >>> with Buffer(bus) as buffer:
        ...     print(list(buffer.pending()))
        []
        """
        return tuple(self._pending(None))

    def describe(self) -> str:
        """The tree as text, with each edge's rate, age, span and authority, and some of the lookups that wait.

        Examples
        --------
        >>> bus = Bus(SimulatedClock())
        >>> with Buffer(bus) as buffer:
        ...     TransformBroadcaster(bus).send_static("map", "dock", Transform())
        ...     print(buffer.describe())
        map
        └── dock  static
        """
        lines = [describe(self._edges(), self._clock.now())]
        lines += [f"waiting: {lookup}" for lookup in self._pending(_DESCRIBED)]
        more = len(self._share.waiters) - _DESCRIBED
        if more > 0:
            lines.append(f"waiting: {more} more lookups, see pending()")
        return "\n".join(lines)

    def on_close(self, callback: Callable[[], object]) -> Registration:
        """Call `callback` once, on the event loop: when this buffer or its bus is closed, or now if one is.

        Examples
        --------
        >>> bus = Bus(SimulatedClock())
        >>> with Buffer(bus) as buffer:
        ...     registration = buffer.on_close(lambda: print("no more samples come"))
        ...     bus.close()
        no more samples come
        """
        return self._share.on_end(callback)

    def close(self) -> None:
        """Leave the bus; waiting lookups end with `BusClosedError`. Buffered transforms can still be looked up.

        Examples
        --------
        >>> buffer = Buffer(Bus(SimulatedClock()))
        >>> buffer.close()
        >>> buffer
        <Buffer of 0 frames, keeps 10 s, closed>
        """
        if self.bus._detach(self._share):
            self._share.live.keep_for(self, self._tree)
        self._share.end("the buffer is closed")
        self._lookups.close()
        self._share.call_end_callbacks()

    def __repr__(self) -> str:
        keep = "everything" if self.tree.keep is None else f"{self.tree.keep:g} s"
        waiting = counted(len(self._share.waiters), "lookup")
        state = "closed" if self._share.end_reason is not None else f"{waiting} waiting"
        return f"<Buffer of {counted(len(self.tree.frames()), 'frame')}, keeps {keep}, {state}>"

    def __reduce_ex__(self, protocol: SupportsIndex) -> str | tuple[Any, ...]:
        raise TypeError("a buffer belongs to its bus and cannot be copied or pickled: use buffer.tree.copy()")

    def _repr_html_(self) -> str:
        """The tree as notebooks show it, with ages counted from the clock's now."""
        return cell(to_html(self._edges(), self._clock.now()))

    def _pending(self, most: int | None) -> Iterable[PendingLookup]:
        pending = self._lookups.pending(most)
        return pending if self._local_names is None else map(self._local_names.pending, pending)

    def _edges(self) -> list[Edge]:
        """The newest edges, with the names of this buffer."""
        edges = self.tree.edges()
        if self._local_names is None:
            return edges
        return sorted(map(self._local_names.edge, edges), key=lambda edge: edge.child)

    def _is_in_place(self, question: Question) -> bool:
        """Whether data are in the target frame already, and stay as they are because the buffer does not know it."""
        target = question.target
        if target != question.source or question.fixed is not None or not is_frame(target):
            return False
        return self._on_bus(question).target not in self.tree

    def _on_bus(self, question: Question) -> Question:
        """A question with the names of the bus."""
        return question if self._local_names is None else self._local_names.question(question)

    def __enter__(self) -> Buffer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()
