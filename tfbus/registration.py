"""The handle that a registering call returns, and a warning about objects that nobody has entered."""

import logging
import os
from collections.abc import Callable
from types import TracebackType
from typing import NoReturn
from weakref import finalize


class Registration:
    """The result of a call that registers something; `close` or the end of its ``with`` ends the registration.

    Parameters
    ----------
    undo : callable
        Ends the registration; called once.

    Examples
    --------
    >>> bus, seen = Bus(SimulatedClock()), []
    >>> with bus.subscribe(seen.append):
    ...     bus.publish(TransformStamped("map", "cart", 0, Transform()))
    >>> bus.publish(TransformStamped("map", "cart", 1, Transform()))
    >>> len(seen)
    1
    """

    __slots__ = ("_undo",)

    def __init__(self, undo: Callable[[], object]) -> None:
        self._undo: Callable[[], object] | None = undo

    def close(self) -> None:
        """End the registration; a second call does nothing.

        Examples
        --------
        >>> bus, seen = Bus(SimulatedClock()), []
        >>> registration = bus.subscribe(seen.append)
        >>> registration.close()
        >>> bus.publish(TransformStamped("map", "cart", 1, Transform()))
        >>> seen
        []
        """
        undo, self._undo = self._undo, None
        if undo is not None:
            undo()

    def __enter__(self) -> "Registration":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()


class AsyncOnly:
    """A base of classes that own a task or a socket, and so are entered once, by ``async with``.

    A plain ``with`` raises a `TypeError`. When an object that nobody has entered is deleted, a line of log says so. The
    constructor ends with `_warn_unless_entered`, and ``__aenter__`` calls `_enter_once`.
    """

    def _warn_unless_entered(self) -> None:
        self._never_entered = finalize(self, _warn_never_entered, type(self).__name__, os.getpid())

    def _enter_once(self) -> None:
        if self._never_entered.detach() is None:
            raise RuntimeError(f"a {type(self).__name__} is entered once: make another one")

    def _refuse_with(self, *_: object) -> NoReturn:
        name = type(self).__name__
        raise TypeError(f"a {name} owns a task or a socket: write `async with {name}(...)`, not `with`")

    # Type checkers should not take it for something that has a `with`.
    vars().update(__enter__=_refuse_with, __exit__=_refuse_with)


def _warn_never_entered(name: str, process: int) -> None:
    # A child made by `fork` has copies of what its parent is about to enter.
    if os.getpid() == process:
        logging.getLogger("tfbus").warning(
            "a %s was made and never entered, so it has done nothing: write `async with %s(...)`", name, name
        )
