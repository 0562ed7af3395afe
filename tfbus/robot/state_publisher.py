"""`RobotStatePublisher`, which sends a robot's fixed joints once, and its moving joints with each state."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
import numpy.typing as npt

from tfbus.bus.bus import Bus
from tfbus.bus.subscribers import OnceLogger
from tfbus.frames import as_prefix
from tfbus.robot.model import Position, RobotModel
from tfbus.stamps import StampLike
from tfbus.statistics import RobotStatistics


class RobotStatePublisher:
    """Publishes the transforms of a robot for given positions of its joints.

    The constructor publishes the fixed joints as static samples, which the bus latches for later subscribers.

    Parameters
    ----------
    bus : Bus
    model : RobotModel
    prefix : str
        The prefix of this robot's frames, such as ``"robot1/"``, so that several robots with the same frames can share
        a bus. The names of joints have no prefix.
    authority : str
        The sender: shown in errors and tools.
    invalid : {"raise", "drop"}
        The treatment of a frame that the bus refuses, as in `Bus.publish`.

    Raises
    ------
    InvalidTransformError
        If the bus refuses a fixed joint, because it would close a loop of parents or belongs to another authority.
    ValueError
        If the prefix starts with a slash, or `invalid` has another value.
    BusClosedError, TypeError

    Examples
    --------
    >>> bus = Bus(SimulatedClock())
    >>> model = RobotModel("rig", ["rail", "cart"], [Joint("slide", "prismatic", "rail", "cart")])
    >>> publisher = RobotStatePublisher(bus, model)
    >>> publisher.publish({"slide": 0.5}, 0)
    >>> bus.statistics().samples
    1
    """

    def __init__(
        self,
        bus: Bus,
        model: RobotModel,
        prefix: str = "",
        authority: str = "robot_state_publisher",
        *,
        invalid: Literal["raise", "drop"] = "raise",
    ) -> None:
        as_prefix(prefix or None, ())
        self.bus = bus
        self.model = model
        self.prefix = prefix
        self.authority = authority
        self._invalid = invalid
        self._messages = 0
        self._unknown = 0
        self._violations: Counter[str] = Counter()
        self._log = OnceLogger(logging.getLogger("tfbus"))
        bus.publish(model.fixed_transforms(bus.clock.now(), authority, prefix), invalid)

    def publish(self, positions: Mapping[str, Position], stamp: StampLike | None = None) -> None:
        """Publish the transforms of the moving joints as one batch.

        A joint is left out if neither it nor the joint that it mimics has a position. Unknown joints, and positions
        outside of the limits, are counted and logged once; nothing is clamped.

        Parameters
        ----------
        positions : mapping of str to float, sequence of floats, or Transform
            By name of joint, as `Joint.transform` takes them.
        stamp : int, optional
            The instant of the positions, in ns; by default the clock's now.

        Raises
        ------
        InvalidTransformError
            If a position is not finite, has a wrong length or holds no unit quaternion, the stamp is invalid, or the
            bus refuses a frame. Nothing is sent.
        BusClosedError, TypeError

        Examples
        --------
        >>> bus = Bus(SimulatedClock())
        >>> model = RobotModel("rig", ["rail", "cart"], [Joint("slide", "prismatic", "rail", "cart")])
        >>> with Buffer(bus) as buffer:
        ...     RobotStatePublisher(bus, model).publish({"slide": 0.5}, 0)
        ...     print(buffer.lookup_nowait("rail", "cart").transform.translation)
        (0.5, 0.0, 0.0)
        """
        stamp = self.bus.clock.now() if stamp is None else stamp
        self.bus.publish(self.model.moving_transforms(positions, stamp, self.authority, self.prefix), self._invalid)
        self._messages += 1
        for name in self.model.unknown_joints(positions):
            self._unknown += 1
            self._log.warning(("unknown", name), "robot %r has no joint %r", self.model.name, name)
        for violation in self.model.violations(positions):
            self._violations[violation.joint] += 1
            self._log.warning(("limits", violation.joint), "robot %r, %s", self.model.name, violation)

    def publish_state(
        self,
        names: Sequence[str],
        positions: Sequence[float] | npt.NDArray[np.floating],
        stamp: StampLike | None = None,
    ) -> None:
        """Publish as `publish` does, with parallel sequences as in a ``JointState`` of ROS.

        Raises
        ------
        ValueError
            If there are not as many positions as names, or a name occurs twice.
        InvalidTransformError, BusClosedError, TypeError
            As `publish`.

        Examples
        --------
        >>> model = RobotModel("rig", ["rail", "cart"], [Joint("slide", "prismatic", "rail", "cart")])
        >>> with Bus(SimulatedClock()) as bus, Buffer(bus) as buffer:
        ...     RobotStatePublisher(bus, model).publish_state(["slide"], [0.5])
        ...     print(buffer.lookup_nowait("rail", "cart").transform.translation)
        (0.5, 0.0, 0.0)
        """
        if len(names) != len(positions):
            raise ValueError(f"there are {len(names)} names of joints, but {len(positions)} positions")
        values = positions.tolist() if isinstance(positions, np.ndarray) else positions
        paired = dict(zip(names, values, strict=True))
        if len(paired) < len(names):
            twice = sorted(name for name, count in Counter(names).items() if count > 1)
            raise ValueError(f"a joint has one position, but there are several of {', '.join(map(repr, twice))}")
        self.publish(paired, stamp)

    def statistics(self) -> RobotStatistics:
        """All counters, as they are now.

        Examples
        --------
        >>> model = RobotModel("rig", ["rail", "cart"], [Joint("slide", "prismatic", "rail", "cart")])
        >>> publisher = RobotStatePublisher(Bus(SimulatedClock()), model)
        >>> publisher.publish({"slide": 0.5}, 0)
        >>> publisher.statistics()
        RobotStatistics(messages=1)
        """
        return RobotStatistics(self._messages, self._unknown, dict(self._violations))
