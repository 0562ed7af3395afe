"""The handle that a registering call returns."""

from collections.abc import Callable
from types import TracebackType


class Registration:
    """The result of a call that registers something; `close` or the end of its ``with`` ends the registration.

    Parameters
    ----------
    undo : callable
        Ends the registration; called once.
    """

    __slots__ = ("_undo",)

    def __init__(self, undo: Callable[[], object]) -> None:
        self._undo: Callable[[], object] | None = undo

    def close(self) -> None:
        """End the registration; a second call does nothing."""
        undo, self._undo = self._undo, None
        if undo is not None:
            undo()

    def __enter__(self) -> "Registration":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()
