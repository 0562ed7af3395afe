"""The names of topics, and those of frames on the bus and in ROS."""

import re
from collections.abc import Iterable

from tfbus.errors import InvalidTransformError
from tfbus.frames import Prefix, as_prefix
from tfbus.geometry.stamped import TransformStamped

_TOPIC = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")


def as_topics(topics: str | Iterable[str], name: str) -> tuple[str, ...]:
    """One topic or several, each with a slash in front.

    Raises
    ------
    ValueError
        If there is none, or one cannot be the name of a topic.
    TypeError
        If one is no string.
    """
    several = (topics,) if isinstance(topics, str) else tuple(topics)
    for topic in several:
        if not isinstance(topic, str):
            raise TypeError(f"a topic must be a str, not {topic!r}")
    found = tuple(dict.fromkeys(topic if topic.startswith("/") else f"/{topic}" for topic in several))
    for topic in found:
        if not _TOPIC.fullmatch(topic):
            raise ValueError(f"{topic!r} cannot be the name of a topic: words of letters, digits and _, with / between")
    if not found:
        raise ValueError(f"{name} must name a topic")
    return found


class FrameNames:
    """The names of frames on the bus for those in ROS, and the other way round.

    Parameters
    ----------
    prefix : str or None
        In front of each name on the bus, and of none in ROS.
    shared : iterable of str
        Names without it.
    """

    def __init__(self, prefix: str | None = None, shared: Iterable[str] = ()) -> None:
        self._prefix: Prefix | None = as_prefix(prefix, shared)

    def put_on_bus(self, sample: TransformStamped) -> None:
        """Give a sample that nobody else has yet the names on the bus.

        Raises
        ------
        InvalidTransformError
            With the reason ``"prefix"``, for a name that has the prefix in ROS too: another link has brought it there.
        """
        if self._prefix is None:
            return
        parent, child, stamp, row, authority, static = sample._fields
        for name in (parent, child):
            if name.startswith(self._prefix.prefix):
                raise InvalidTransformError(
                    f"frame name {name!r} has the prefix {self._prefix.prefix!r} in ROS already",
                    reason="prefix",
                    parent=parent,
                    child=child,
                    authority=authority,
                )
        sample._fields = self._prefix.on_bus(parent), self._prefix.on_bus(child), stamp, row, authority, static

    def is_local(self, child: str) -> bool:
        """Whether a child on the bus has a name in ROS; without the prefix it is another robot's."""
        return self._prefix is None or not self._prefix.local(child).startswith("/")

    def localise(self, sample: TransformStamped) -> TransformStamped:
        """A sample with its names in ROS.

        Raises
        ------
        InvalidTransformError
            With the reason ``"prefix"``, if the parent has no name there.
        """
        if self._prefix is None:
            return sample
        parent, child, stamp, row, authority, static = sample._fields
        local = self._prefix.local(parent)
        if local.startswith("/"):
            raise InvalidTransformError(
                f"frame {child!r} has the prefix {self._prefix.prefix!r}, its parent {parent!r} has not:"
                f" shared={{{parent!r}}} lets it pass",
                reason="prefix",
                parent=parent,
                child=child,
                authority=authority,
            )
        renamed = TransformStamped.__new__(TransformStamped)
        renamed._fields = local, self._prefix.local(child), stamp, row, authority, static
        return renamed
