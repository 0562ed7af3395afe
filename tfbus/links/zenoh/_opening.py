"""The beginning of zenoh's sessions, and the door for all that zenoh's threads bring from strangers.

zenoh prints what a callback raises and counts nothing; so nothing may come so far. See `directly`.
"""

import re
from collections.abc import Callable
from typing import Any, TypeVar

import zenoh

from tfbus.links._receive_queue import Received
from tfbus.links.zenoh._closing import use_zenoh
from tfbus.links.zenoh._settings import without_source_location
from tfbus.tf_message import MalformedMessageError

_LONGEST_SHOWN_ERROR = 200

T = TypeVar("T")


class OpenQuestion:
    """A question of a peer; it is open until it is answered, or nobody refers to it any more.

    Attributes
    ----------
    query : zenoh.Query
    kind : str
        The kind of key that was asked. The asker may have asked several by an expression.
    """

    __slots__ = ("__weakref__", "kind", "query")

    def __init__(self, query: zenoh.Query, kind: str) -> None:
        self.query = query
        self.kind = kind

    def drop(self) -> None:
        """End the question, whether or not it was answered."""
        self.query.drop()


def open_session(config: zenoh.Config) -> zenoh.Session:
    """Open a session; blocks.

    Raises
    ------
    OSError
        If it cannot listen where it should, or as a client reaches nobody; with its `errno`, if there is one.
    RuntimeError
        If this process was forked from one that uses zenoh.
    """
    use_zenoh()
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        text = f"zenoh cannot open a session: {without_source_location(error)}"
        number = re.search(r"\(os error (\d+)\)", text)
        raise (OSError(int(number[1]), text) if number else OSError(text)) from error


def directly(
    callback: Callable[[Any], object], failed: Callable[[Exception], object], end: Callable[[], object] | None = None
) -> Any:
    """Have `callback` called in zenoh's threads, `failed` with each `Exception` that it raises, and then `end`."""

    def call(thing: Any) -> None:
        try:
            callback(thing)
        except Exception as error:  # noqa: BLE001 - zenoh would print it, and count nothing
            failed(error)

    # Otherwise each subscriber has a thread of its own, and one overtakes the other.
    return zenoh.handlers.Callback(call, end, indirect=False)


def refusal(error: Exception, sender: str = "") -> Received:
    """The item by which a link counts that something of a stranger could not be used."""
    if not isinstance(error, MalformedMessageError):
        detail = f"{type(error).__name__}: {error}"[:_LONGEST_SHOWN_ERROR]
        error = MalformedMessageError("unreadable", detail)
    # The traceback would keep what was sent.
    return Received(sender, error.with_traceback(None))


def guarded(receive: Callable[[Received], object], sender: str, do: Callable[..., T], *args: Any) -> T | None:
    """Do something with what a stranger has sent; None, and the refusal is received, if that raises."""
    try:
        return do(*args)
    except Exception as error:  # noqa: BLE001 - no peer may end a task
        receive(refusal(error, sender))
        return None
