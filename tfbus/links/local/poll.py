"""`Poll`, which waits for many sockets at once, on every event loop."""

import selectors
import socket
from collections.abc import Awaitable, Callable
from selectors import EVENT_READ, EVENT_WRITE
from typing import Any

import anyio
import anyio.lowlevel


class Poll:
    """The sockets of one wire, with the object that each is for.

    The system's own poll object is a file that the event loop can wait for, so one task serves all sockets, wakes once
    for all that are ready together, and keeps to one budget. Where it is no file, as on Windows, the event loop waits
    for each socket, which costs more with each of them.
    """

    def __init__(self) -> None:
        self._selector = selectors.DefaultSelector()
        fileno = getattr(self._selector, "fileno", None)
        self._file: int | None = None if fileno is None else fileno()
        self._changed = anyio.Event()
        # An asyncio loop watches the file all the time: to begin and end that for each message costs a third more.
        loop = anyio.lowlevel.current_token().native_token
        self._loop: Any = loop if self._file is not None and hasattr(loop, "add_reader") else None
        self._ready: Any = None
        if self._loop is not None:
            self._loop.add_reader(self._file, self._wake)

    def add(self, sock: socket.socket, owner: object) -> None:
        """Wait for bytes on a socket too."""
        self._selector.register(sock, EVENT_READ, owner)
        self._changed.set()

    def change(self, sock: socket.socket, owner: object, *, read: bool = True, write: bool = False) -> None:
        """Wait on a socket for bytes, for room, or for both."""
        self._selector.modify(sock, EVENT_READ * read | EVENT_WRITE * write, owner)
        self._changed.set()

    def remove(self, sock: socket.socket) -> None:
        """Wait for a socket no more; to call before it is closed."""
        try:
            self._selector.unregister(sock)
        except KeyError:
            return
        if self._file is None:
            anyio.notify_closing(sock)

    def ready(self) -> list[tuple[Any, bool, bool]]:
        """The owners of the sockets that are ready, with whether there are bytes to read, and room to write."""
        found = self._selector.select(0.0) if self._selector.get_map() else []
        return [(key.data, bool(events & EVENT_READ), bool(events & EVENT_WRITE)) for key, events in found]

    async def wait(self) -> None:
        """Wait until a socket may be ready."""
        if self._loop is not None:
            self._ready = self._loop.create_future()
            await self._ready
            return
        if self._file is not None:
            await anyio.wait_readable(self._file)
            return
        self._changed = anyio.Event()
        async with anyio.create_task_group() as tasks:

            async def watch(wait: Callable[[], Awaitable[object]]) -> None:
                try:
                    await wait()
                except (anyio.ClosedResourceError, OSError):
                    # It was removed.
                    await anyio.lowlevel.checkpoint()
                tasks.cancel_scope.cancel()

            tasks.start_soon(watch, self._changed.wait)
            for key in self._selector.get_map().values():
                if key.events & EVENT_READ:
                    tasks.start_soon(watch, lambda sock=key.fileobj: anyio.wait_readable(sock))
                if key.events & EVENT_WRITE:
                    tasks.start_soon(watch, lambda sock=key.fileobj: anyio.wait_writable(sock))

    def _wake(self) -> None:
        if self._ready is not None and not self._ready.done():
            self._ready.set_result(None)

    def close(self) -> None:
        """Wait for nothing any more."""
        if self._loop is not None:
            self._loop.remove_reader(self._file)
        self.abandon()

    def abandon(self) -> None:
        """Close the file in a child process, and leave what the parent waits for as it is."""
        self._selector.close()
