"""`Limits`, beyond which a transform cannot be right."""

from dataclasses import dataclass, fields

from tfbus.stamps import is_real


@dataclass(frozen=True, slots=True)
class Limits:
    """The bounds of an examination.

    Parameters
    ----------
    translation : float
        The longest translation, in m. The default is larger than the Earth, for frames at its centre.
    speed : float
        The highest speed of a frame in its parent, in m/s.
    turn_rate : float
        The highest angular speed of a frame in its parent, in rad/s.
    ahead : float
        How far a stamp may lie ahead of the time at which it arrives, in s.
    gap : float
        The shortest time between two stamps that counts as a gap, in s; it must also be ten times the usual one.
    norm : float
        How far the norm of a quaternion may be from one.

    Raises
    ------
    TypeError, ValueError
        If one of them is not a number greater than zero.
    """

    translation: float = 1e8
    speed: float = 100.0
    turn_rate: float = 100.0
    ahead: float = 0.05
    gap: float = 0.5
    norm: float = 1e-4

    def __post_init__(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)
            if not is_real(value):
                raise TypeError(f"{each.name} must be a number, not {value!r}")
            if not value > 0:
                raise ValueError(f"{each.name} must be greater than zero, got {value!r}")
