"""Frame names, and the prefixes that keep the names of several robots apart on one bus."""

import logging
from collections.abc import Iterable

from tfbus.errors import InvalidTransformError


def is_frame(name: object) -> bool:
    """Whether `name` can name a frame; `TypeError` if it is not a string."""
    if not isinstance(name, str):
        raise TypeError(f"a frame name must be a str, not {name!r}")
    return bool(name) and not name.startswith("/")


def check_frame(name: str, parent: str | None = None, child: str | None = None, authority: str | None = None) -> None:
    """Raise `InvalidTransformError` unless `name` can name a frame; the other arguments are for the error."""
    if not is_frame(name):
        bare = name.lstrip("/")
        hint = f": write {bare!r}" if bare else ""
        why = f"must not start with '/', got {name!r}{hint}" if name else "must not be empty"
        raise InvalidTransformError(
            f"a frame name {why}", reason="frame name", parent=parent, child=child, authority=authority
        )


class Prefix:
    """A map between the local names of a robot and the names on the bus.

    Parameters
    ----------
    prefix : str
        The text before each local name. A slash between the two must be part of the prefix, as in ``"robot1/"``; a
        prefix that ends in a letter or a digit is logged.
    shared : iterable of str
        Names that are the same for all robots, such as ``{"map"}``.

    Raises
    ------
    ValueError
        If the prefix, or a shared name, is empty or starts with a slash; or if a shared name starts with the prefix,
        because two local names would then be the same on the bus.
    TypeError
        If they are not strings, or `shared` is a single string.
    """

    def __init__(self, prefix: str, shared: Iterable[str] = ()) -> None:
        if isinstance(shared, str):
            raise TypeError(f"shared must be a set of frame names, not the one name {shared!r}")
        self.prefix = prefix
        self.shared: frozenset[str] = frozenset(shared)
        for name in (prefix, *self.shared):
            if not is_frame(name):
                raise ValueError(f"a prefix or shared name must not be empty or start with '/', got {name!r}")
        for name in self.shared:
            if name.startswith(prefix):
                raise ValueError(f"the shared name {name!r} starts with the prefix {prefix!r}")
        if prefix[-1].isalnum():
            logging.getLogger("tfbus").warning(
                "the prefix %r makes the frame %r of 'base_link': the slash is part of a prefix, as in %r",
                prefix,
                f"{prefix}base_link",
                f"{prefix}/",
            )

    def on_bus(self, name: str) -> str:
        """The name on the bus for a local name. An invalid name is returned unchanged, and the bus refuses it."""
        return name if name in self.shared or not is_frame(name) else self.prefix + name

    def local(self, name: str) -> str:
        """The local name for a name on the bus. A frame of another robot has none and gets a leading slash."""
        if name in self.shared:
            return name
        rest = name.removeprefix(self.prefix)
        return rest if rest != name and is_frame(rest) and rest not in self.shared else f"/{name}"


def as_prefix(prefix: str | None, shared: Iterable[str]) -> Prefix | None:
    """The arguments `prefix` and `shared` of a broadcaster or a buffer, checked; None without a prefix.

    Raises
    ------
    ValueError, TypeError
        As `Prefix`; and `TypeError` if there are shared names but no prefix.
    """
    if prefix is not None:
        return Prefix(prefix, shared)
    if isinstance(shared, str) or tuple(shared):
        raise TypeError(f"shared names need a prefix, got shared={shared!r} alone")
    return None
