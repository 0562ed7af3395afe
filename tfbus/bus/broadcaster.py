"""A publisher of transforms under one authority."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any, Protocol, cast

import numpy as np
import numpy.typing as npt

from tfbus.bus.bus import Bus, ThreadPublisher
from tfbus.bus.topology import Invalid, as_invalid
from tfbus.errors import BusClosedError, UnknownFrameError
from tfbus.frames import as_prefix
from tfbus.geometry.columns import Names
from tfbus.geometry.covariance import Covariance, Kind, as_covariance, as_kind
from tfbus.geometry.stamped import TransformStamped, shifted
from tfbus.geometry.transform import Transform
from tfbus.geometry.uncertain import Belief, with_belief
from tfbus.stamps import StampLike, StampsLike, as_offset, as_stamp, as_stamps, from_seconds
from tfbus.tf2_names import says_ours


class Awaits(Protocol):
    """A buffer, as `TransformBroadcaster.correct` needs it."""

    async def lookup(
        self, target: str, source: str, at: StampLike, /, *, timeout: float | None = None
    ) -> TransformStamped:
        """The transform from `source` to `target` at a stamp, as soon as it is known."""


@says_ours
class TransformBroadcaster:
    """Publishes samples that carry its authority.

    Parameters
    ----------
    bus : Bus or ThreadPublisher
        With the result of `Bus.threadsafe`, any thread may send. The loop of the bus then publishes the samples, leaves
        out those that the bus refuses, counts and logs them.
    authority : str
        The name of the sender, which errors and tools show.
    prefix : str, optional
        The prefix of this broadcaster's frames on the bus, such as ``"robot1/"``, so that several robots with the same
        frames can share a bus. The methods take names without it.
    shared : iterable of str
        Names without a prefix, because they are the same for all robots, such as ``{"map"}``.
    invalid : {"raise", "drop"}
        The fate of a sample that the bus refuses, as in `Bus.publish`. ``"drop"`` is for a program that must survive
        contradicting edges of others: the sample is left out, counted, and logged once. A bad name, stamp or transform
        still raises an error.
    offset : float
        Added to each stamp of a moving sample, in s, also to the clock's now: ``-0.04`` for a camera whose images are
        stamped 40 ms late. Clocks that differ are measured by links.

    Raises
    ------
    ValueError
        If the prefix, or a shared name, is empty or starts with a slash, or a shared name starts with the prefix; or
        if `invalid` is neither, or `offset` is not finite.
    TypeError
        If an argument is of another type, or there are shared names but no prefix.

    Examples
    --------
    >>> with Bus() as bus, Buffer(bus) as buffer:
    ...     broadcaster = TransformBroadcaster(bus, "driver", prefix="r17/", shared={"map"})
    ...     broadcaster.send("map", "base_link", Transform((1.0, 2.0, 0.0)), at=0)
    ...     sample = buffer.lookup_nowait("map", "r17/base_link")
    >>> sample.child, sample.stamp
    ('r17/base_link', 0)

    In a thread, such as that of a driver:

    >>> async def run_driver(bus: Bus) -> None:
    ...     with bus.threadsafe() as publish:
    ...         driver = TransformBroadcaster(publish, "driver")
    ...         await anyio.to_thread.run_sync(driver.send, "odom", "base_link", Transform())
    """

    def __init__(
        self,
        bus: Bus | ThreadPublisher,
        authority: str = "",
        *,
        prefix: str | None = None,
        shared: Iterable[str] = (),
        invalid: Invalid = "raise",
        offset: float = 0.0,
    ) -> None:
        if not isinstance(authority, str):
            raise TypeError(f"authority must be a str, not {authority!r}")
        self.bus: Bus = bus if isinstance(bus, Bus) else bus.bus
        self._to = bus
        self.authority = authority
        self._prefix = as_prefix(prefix, shared)
        self._invalid = as_invalid(invalid)
        self._offset = as_offset(offset)

    def send(
        self,
        parent: str,
        child: str,
        transform: Transform,
        at: StampLike | None = None,
        covariance: Covariance | None = None,
        kind: Kind = "independent",
    ) -> None:
        """Publish where `child` is, seen from `parent`.

        Parameters
        ----------
        parent, child : str
        transform : Transform
            Maps `child` coordinates into `parent`.
        at : int, optional
            ns; by default the clock's now.
        covariance : Covariance, optional
            The size of the sample's error. Lookups with ``covariance=True`` use it.
        kind : {"independent", "drift", "constant"}
            The relation of the errors of this edge at two stamps, as `UncertainSample` says.

        Raises
        ------
        InvalidTransformError
            If a name or the stamp is bad, or the bus refuses the sample, as `Bus.publish` says. Nothing is stored.
        ValueError
            If the kind is another.
        BusClosedError, TypeError

        Examples
        --------
        >>> bus = Bus(clock=SimulatedClock())
        >>> broadcaster = TransformBroadcaster(bus, authority="odometry")
        >>> with Buffer(bus) as buffer:
        ...     broadcaster.send("map", "cart", Transform((1.0, 2.0, 0.0)), at=from_seconds(0.5))
        ...     print(buffer.lookup_nowait("map", "cart").stamp)
        500000000
        """
        if self._prefix is not None:
            parent, child = self._on_bus(parent), self._on_bus(child)
        sample = TransformStamped(parent, child, self._stamp(at), transform, self.authority)
        if covariance is not None:
            sample = with_belief(sample, Belief(as_covariance(covariance), as_kind(kind)))
        self._to.publish(sample, self._invalid)

    def send_all(
        self, samples: Iterable[TransformStamped | tuple[str, str, Transform]], at: StampLike | None = None
    ) -> None:
        """Publish several samples as one batch: readers see all of them or none.

        Parameters
        ----------
        samples : iterable of (parent, child, transform) or TransformStamped
            Tuples get the stamp `at`; samples keep their stamp, and get this authority.
        at : int, optional
            ns; by default the clock's now, the same for all.

        Raises
        ------
        InvalidTransformError
            If one of them is bad. Nothing is stored.
        BusClosedError, TypeError

        Examples
        --------
        >>> bus = Bus(SimulatedClock())
        >>> with Buffer(bus) as buffer:
        ...     TransformBroadcaster(bus).send_all([("map", "odom", Transform()), ("odom", "cart", Transform())], at=0)
        ...     print(buffer.can_transform("map", "cart"))
        True
        """
        stamp = self._stamp(at)
        self._to.publish([self._sample(sample, stamp) for sample in samples], self._invalid)

    def send_message(self, message: object, child: str | None = None, *, invert: bool = False) -> None:
        """Publish the transform that a message holds, such as odometry, or the pose of a frame, at its own stamp.

        Parameters
        ----------
        message : object or mapping
            A ``TransformStamped``, ``TFMessage``, ``Odometry``, ``PoseStamped`` or ``PoseWithCovarianceStamped`` of
            ROS, as `tfbus.data.from_message` reads it, or data of `tfbus` with that name. A ``TFMessage`` is one batch.
            A covariance that is known goes with its pose: that of odometry as a drift, that of a pose as independent.
        child : str, optional
            The frame that is at a pose. Needed for a pose, and refused for the others, which name it.
        invert : bool
            Whether the child becomes the parent: for a second source of odometry, whose body has a parent already.

        Raises
        ------
        TypeError
            If the message does not say where a frame is; or `child` is missing, or given although the message names it.
        ValueError
            As `tfbus.data.from_message`.
        InvalidTransformError, BusClosedError
            As `send`.

        Examples
        --------
        >>> from tfbus.data import PoseStamped
        >>> with Bus(SimulatedClock()) as bus, Buffer(bus) as buffer:
        ...     TransformBroadcaster(bus).send_message(PoseStamped("map", 5, Transform((1.0, 0.0, 0.0))), "camera")
        ...     print(buffer.lookup_nowait("map", "camera").stamp)
        5
        """
        # Only programs that send messages load the types of all messages.
        from tfbus.data.messages import samples_of

        self.send_all(samples_of(message, child, invert=invert))

    def send_columns(
        self,
        parents: Names,
        children: Names,
        translations: npt.ArrayLike,
        rotations: npt.ArrayLike,
        at: StampLike | StampsLike | None = None,
    ) -> None:
        """Publish the samples in some arrays as one batch; see `Bus.publish_columns`.

        Parameters
        ----------
        parents, children : str, or sequence of n str
            One name for all rows, or a name for each.
        translations : array of shape (n, 3)
            In m.
        rotations : array of shape (n, 4)
            Unit quaternions (x, y, z, w).
        at : int, or integer array of shape (n,), optional
            ns; one stamp for all rows, or one for each. By default the clock's now, the same for all.

        Raises
        ------
        InvalidTransformError, BusClosedError, TypeError, ValueError
            As `Bus.publish_columns`.

        Examples
        --------
        >>> bus = Bus(SimulatedClock())
        >>> places, turns = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0)], [(0.0, 0.0, 0.0, 1.0)] * 2
        >>> with Buffer(bus) as buffer:
        ...     TransformBroadcaster(bus).send_columns("map", "cart", places, turns, [0, 10])
        ...     print(buffer.lookup_nowait("map", "cart", 5).transform.translation)
        (0.5, 0.0, 0.0)
        """
        above, below = (
            (self._on_bus(names) if isinstance(names, str) else [*map(self._on_bus, names)])
            if self._prefix is not None
            else names
            for names in (parents, children)
        )
        stamps: StampLike | StampsLike
        if at is None or np.ndim(cast(Any, at)) == 0:
            stamps = self._stamp(cast("StampLike | None", at))
        else:
            stamps = (
                [stamp + self._offset for stamp in as_stamps(cast("StampsLike", at)).tolist()] if self._offset else at
            )
        self._to.publish_columns(above, below, stamps, translations, rotations, self.authority, invalid=self._invalid)

    def send_static(
        self, parent: str, child: str, transform: Transform, *, covariance: Covariance | None = None
    ) -> None:
        """Publish a transform that holds at every stamp. Later subscribers get it too; sending it again replaces it.

        A `covariance` is that of one constant error.

        Raises
        ------
        InvalidTransformError, BusClosedError, TypeError
            As `send`.

        Examples
        --------
        >>> bus = Bus(SimulatedClock())
        >>> TransformBroadcaster(bus).send_static("base_link", "laser", Transform((0.1, 0.0, 0.2)))
        >>> with Buffer(bus) as late:
        ...     print(late.lookup_nowait("base_link", "laser").static)
        True
        """
        parent, child = self._on_bus(parent), self._on_bus(child)
        sample = TransformStamped(parent, child, self.bus.clock.now(), transform, self.authority, static=True)
        if covariance is not None:
            sample = with_belief(sample, Belief(as_covariance(covariance), "constant"))
        self._to.publish(sample, self._invalid)

    async def correct(
        self,
        parent: str,
        child: str,
        *,
        base: str,
        pose: Transform,
        at: StampLike,
        buffer: Awaits,
        timeout: float | None = None,
        post_date: float = 0.0,
    ) -> TransformStamped:
        """Publish where `child` is in `parent`, such as ``odom`` in ``map``, so that `base` is at a pose at a stamp.

        A localisation knows where the base is in the map, but the base has a parent already: the frame of its odometry.
        So it sends that frame. This waits for the odometry of the very instant, and sends
        ``parent_from_base @ base_from_child``. The difference of two poses is another point, unless the two have the
        same heading.

        Parameters
        ----------
        parent, child : str
        base : str
            A frame below `child`.
        pose : Transform
            The estimate: maps `base` coordinates into `parent`.
        at : int
            ns, the stamp of the estimate.
        buffer : Buffer
            Answers where `child` is, seen from `base`, at that stamp, in the names that this method gets.
        timeout : float, optional
            The longest wait for the odometry, in s.
        post_date : float
            Stamp the sample so many s after `at`, as ``transform_tolerance`` of amcl, so that no listener waits for it.

        Returns
        -------
        TransformStamped
            The sample that was published.

        Raises
        ------
        LookupTimeoutError, PastExtrapolationError, DisconnectedError
            As `Buffer.lookup`. Nothing is published.
        InvalidTransformError, BusClosedError, TypeError
            As `send`.

        Examples
        --------
        >>> import anyio
        >>> async def localise() -> None:
        ...     with Bus() as bus, Buffer(bus) as buffer:
        ...         TransformBroadcaster(bus, "odometry").send("odom", "base", Transform((9.8, 0.0, 0.0)), at=5)
        ...         localisation = TransformBroadcaster(bus, "localisation")
        ...         estimate = Transform((10.0, 1.0, 0.0))
        ...         await localisation.correct("map", "odom", base="base", pose=estimate, at=5, buffer=buffer)
        ...         print(buffer.lookup_nowait("map", "base", 5).transform == estimate)
        >>> anyio.run(localise)
        True
        """
        taken = self._stamp(at)
        base_from_child = await buffer.lookup(base, child, taken, timeout=timeout)
        stamp = as_stamp(taken) + from_seconds(post_date)
        sample = TransformStamped(
            self._on_bus(parent), self._on_bus(child), stamp, pose @ base_from_child.transform, self.authority
        )
        self._to.publish(sample, self._invalid)
        return sample

    @contextmanager
    def owning(self, *frames: str) -> Iterator[None]:
        """Own frames inside a ``with``: no other authority may publish them, and at its end they are removed.

        No edge of another authority can displace them: see `Bus.reserve`.

        The end removes all samples of a frame, also older ones, whichever authority sent them. It skips a frame that
        was never published. Once the bus is closed, nothing is removed.

        Raises
        ------
        InvalidTransformError
            If another authority has reserved one of them; then none is reserved.
        TypeError
            If no frame is given.
        BusClosedError

        Examples
        --------
        >>> bus = Bus(SimulatedClock())
        >>> broadcaster = TransformBroadcaster(bus)
        >>> with Buffer(bus) as buffer:
        ...     with broadcaster.owning("tool0"):
        ...         broadcaster.send("flange", "tool0", Transform())
        ...     print("tool0" in buffer.tree)
        False
        """
        if not frames:
            raise TypeError("owning needs at least one frame")
        names = [self._on_bus(frame) for frame in frames]
        with ExitStack() as reservations:
            for name in names:
                reservations.enter_context(self.bus.reserve(name, self.authority))
            try:
                yield
            finally:
                for name in names:
                    with suppress(UnknownFrameError, BusClosedError):
                        self.bus.remove_frame(name)

    def _on_bus(self, name: str) -> str:
        """The name of a frame on the bus."""
        return name if self._prefix is None else self._prefix.on_bus(name)

    def _stamp(self, at: StampLike | None) -> StampLike:
        stamp = self.bus.clock.now() if at is None else at
        return as_stamp(stamp) + self._offset if self._offset else stamp

    def _sample(self, sample: TransformStamped | tuple[str, str, Transform], stamp: StampLike) -> TransformStamped:
        if isinstance(sample, TransformStamped):
            parent, child = self._on_bus(sample.parent), self._on_bus(sample.child)
            moved = shifted(sample, self._offset) if self._offset else sample
            return moved.replace(parent=parent, child=child, authority=self.authority)
        try:
            if isinstance(sample, str):
                raise TypeError
            parent, child, transform = sample
        except (TypeError, ValueError):
            raise TypeError(f"expected (parent, child, transform) or a TransformStamped, not {sample!r}") from None
        return TransformStamped(self._on_bus(parent), self._on_bus(child), stamp, transform, self.authority)
