"""Sending transforms under one name."""

from collections.abc import Iterable

from tfbus.bus import Bus
from tfbus.geometry import Transform
from tfbus.stamped import TransformStamped


class TransformBroadcaster:
    """Publishes samples that carry its authority.

    Parameters
    ----------
    bus : Bus
    authority : str
        Who says so: shown in errors and tools.
    """

    def __init__(self, bus: Bus, authority: str = "") -> None:
        if not isinstance(authority, str):
            raise TypeError(f"authority must be a str, not {authority!r}")
        self.bus = bus
        self.authority = authority

    def send(self, parent: str, child: str, transform: Transform, at: int | None = None) -> None:
        """Publish where `child` is, seen from `parent`.

        Parameters
        ----------
        parent, child : str
        transform : Transform
            Maps `child` coordinates into `parent`.
        at : int, optional
            ns; by default the clock's now.

        Raises
        ------
        InvalidTransformError
            If a name or the stamp is bad, or the edge would close a loop of parents. Nothing is stored.
        BusClosedError, TypeError
        """
        self.bus.publish(TransformStamped(parent, child, self._stamp(at), transform, self.authority))

    def send_all(self, samples: Iterable[TransformStamped | tuple[str, str, Transform]], at: int | None = None) -> None:
        """Publish several at once; they are seen all or not at all.

        Parameters
        ----------
        samples : iterable of (parent, child, transform) or TransformStamped
            The former are stamped with `at`; the latter keep their stamp and get this authority.
        at : int, optional
            ns; by default the clock's now, one for all.

        Raises
        ------
        InvalidTransformError
            If one of them is bad. Nothing is stored.
        BusClosedError, TypeError
        """
        stamp = self._stamp(at)
        self.bus.publish([self._sample(sample, stamp) for sample in samples])

    def send_static(self, parent: str, child: str, transform: Transform) -> None:
        """Publish a transform that holds at every stamp. Whoever joins later gets it too; sending it again replaces it.

        Raises
        ------
        InvalidTransformError, BusClosedError, TypeError
            As `send`.
        """
        self.bus.publish(TransformStamped(parent, child, self.bus.clock.now(), transform, self.authority, static=True))

    def _stamp(self, at: int | None) -> int:
        return self.bus.clock.now() if at is None else at

    def _sample(self, sample: TransformStamped | tuple[str, str, Transform], stamp: int) -> TransformStamped:
        if isinstance(sample, TransformStamped):
            return sample.replace(authority=self.authority)
        try:
            if isinstance(sample, str):
                raise TypeError
            parent, child, transform = sample
        except (TypeError, ValueError):
            raise TypeError(f"expected (parent, child, transform) or a TransformStamped, not {sample!r}") from None
        return TransformStamped(parent, child, stamp, transform, self.authority)
