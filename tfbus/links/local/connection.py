"""`Connection`: the socket between two links, its frames, and the queues of a full socket. `Poll` waits for many."""

import hmac
import re
import selectors
import socket
import struct
from collections import deque
from collections.abc import Iterator
from selectors import EVENT_READ, EVENT_WRITE
from time import monotonic
from typing import Any, Final

import anyio
import anyio.lowlevel
import anyio.to_thread

from tfbus.links.seams import MAX_MESSAGE
from tfbus.tf_message import MalformedMessageError

MOST_PUBLISHED: Final = 2**23
"""Bytes of published messages that wait for one link, before the oldest are dropped."""
MOST_SENT: Final = 2**24
"""Bytes of sent messages that wait for one link, before further ones are refused."""
LONGEST_HELLO: Final = 2**14
MOST_AT_ONCE: Final = 2**18
"""Bytes that are written to one socket before others have their turn."""
KEY: Final = 32
"""Bytes of a key; the side that connects says the first half, and the other side the second half."""
LENGTH: Final = struct.Struct("<I")
_LOOK_AGAIN: Final = 0.02
_PROTOCOL = b"tfbus local 2\n"
_HELLO = struct.Struct(f"{len(_PROTOCOL)}s32s{KEY // 2}s")
_LINK = re.compile("[0-9a-f]{32}")
_CHANNEL = re.compile("[A-Za-z0-9_-]{0,32}")
_ROBOT = re.compile(r"[\w.-]{0,200}", re.ASCII)
_FLAGS = getattr(socket, "MSG_NOSIGNAL", 0)


def frame_of(message: bytes) -> bytes:
    """A message as it stands in a connection."""
    return LENGTH.pack(len(message)) + message


class Poll:
    """The sockets of one wire, with the object that each is for.

    The system's own poll object is a file that the event loop can wait for, so one task serves all sockets, wakes once
    for all that are ready together, and keeps to one budget. Where it is no file, as on Windows, a thread waits, which
    looks every 20 ms for what has changed meanwhile.
    """

    def __init__(self) -> None:
        self._selector = selectors.DefaultSelector()
        fileno = getattr(self._selector, "fileno", None)
        self._file: int | None = None if fileno is None else fileno()
        # An asyncio loop watches the file all the time: to begin and end that for each message costs a third more.
        loop = anyio.lowlevel.current_token().native_token
        self._loop: Any = loop if self._file is not None and hasattr(loop, "add_reader") else None
        self._ready: Any = None
        self._threads = anyio.CapacityLimiter(1)
        if self._loop is not None:
            self._loop.add_reader(self._file, self._wake)

    def watch(self, sock: socket.socket, owner: object, events: int) -> None:
        """Wait on a socket for bytes, for room, for both, or no more; the last before it is closed."""
        try:
            if events:
                self._selector.modify(sock, events, owner)
            else:
                self._selector.unregister(sock)
        except KeyError:
            if events:
                self._selector.register(sock, events, owner)

    def ready(self, patience: float = 0.0) -> list[tuple[Any, bool, bool]]:
        """The owners of the sockets that are ready, with whether there are bytes to read, and room to write."""
        found = self._selector.select(patience) if self._selector.get_map() else []
        return [(key.data, bool(events & EVENT_READ), bool(events & EVENT_WRITE)) for key, events in found]

    async def wait(self) -> list[tuple[Any, bool, bool]]:
        """Wait until a socket may be ready; returns as `ready`."""
        if self._loop is not None:
            self._ready = self._loop.create_future()
            found: list[tuple[Any, bool, bool]] = await self._ready
            return found
        if self._file is None:
            return await anyio.to_thread.run_sync(
                self.ready, _LOOK_AGAIN, abandon_on_cancel=True, limiter=self._threads
            )
        await anyio.wait_readable(self._file)
        return self.ready()

    def _wake(self) -> None:
        # The loop may have seen the file before the task has read all.
        if self._ready is not None and not self._ready.done() and (found := self.ready()):
            self._ready.set_result(found)

    def close(self) -> None:
        """Stop waiting, and close the file."""
        if self._loop is not None:
            self._loop.remove_reader(self._file)
        self.abandon()

    def abandon(self) -> None:
        """Close the file in a child process; the parent goes on waiting with its own."""
        self._selector.close()


class Connection:
    """One connection. It is *met* when both sides have told who they are and what they hear.

    Parameters
    ----------
    sock : socket
        It does not block, and is closed with the connection.
    poll : Poll
    key : bytes
        The key of the side that listens.
    dialled : str
        The name to which this side has connected; empty for the side that listens.
    waits : bool
        Whether the socket is not connected yet.

    Attributes
    ----------
    link, robot : str
        Of the other side; empty until it has said them.
    heard : str or None
        The channel that this link hears of the other.
    hears : str or None
        The channel that the other hears of this one.
    met, closed : bool
    waits : bool
        Whether anything waits for room.
    begun, grown : float
        When it began, and when its unfinished message has grown last, in s of `time.monotonic`.
    tail : bytearray
        The beginning of a message whose end has not come.
    """

    def __init__(self, sock: socket.socket, poll: Poll, key: bytes, dialled: str = "", *, waits: bool = False) -> None:
        self.sock = sock
        self._poll = poll
        halves = key[: KEY // 2], key[KEY // 2 :]
        self._said, self._awaited = halves if dialled else halves[::-1]
        self.dialled = dialled
        self.begun: float = monotonic()
        self.grown: float = self.begun
        self.link: str = ""
        self.robot: str = ""
        self.heard: str | None = None
        self.hears: str | None = None
        self.met: bool = False
        self.closed: bool = False
        self.tail: bytearray = bytearray()
        self.waits: bool = waits
        self._reads = True
        # The rest of a frame whose writing has begun: nothing goes before it.
        self._rest: memoryview | None = None
        self._sent: deque[bytes] = deque()
        self._published: deque[bytes] = deque()
        self._size_sent = self._size_published = 0
        self._watch()

    def _watch(self) -> None:
        self._poll.watch(self.sock, self, EVENT_READ * self._reads | EVENT_WRITE * self.waits)

    # Writing

    def publish(self, frame: bytes) -> None:
        """Write a frame at once, or have it wait; the oldest that wait are dropped."""
        if self.waits or not self._write_at_once(frame):
            self._published.append(frame)
            self._size_published += len(frame)
            while self._size_published > MOST_PUBLISHED:
                self._size_published -= len(self._published.popleft())

    def send(self, frame: bytes) -> bool:
        """Write a frame at once, or have it wait before all that are published; False if there is no room."""
        if self.waits or not self._write_at_once(frame):
            if self._size_sent + len(frame) > MOST_SENT:
                return False
            self._sent.append(frame)
            self._size_sent += len(frame)
        return True

    def _write(self, data: bytes | memoryview) -> int:
        try:
            return self.sock.send(data, _FLAGS)
        except BlockingIOError:
            return 0
        except OSError:
            # The other side reads no more. The reading finds the end, after all that the other has written before.
            return len(data)

    def _write_at_once(self, frame: bytes) -> bool:
        """Whether a part of the frame is written; then the rest goes before all others."""
        written = self._write(frame)
        if written < len(frame):
            self._rest = memoryview(frame)[written:] if written else None
            self.waits = True
            self._watch()
        return written > 0

    def flush(self) -> None:
        """Write the waiting frames, as far as there is room."""
        most = MOST_AT_ONCE
        while most > 0:
            queue = self._sent or self._published
            if self._rest is None and not queue:
                self.waits = False
                self._watch()
                return
            frame = memoryview(queue[0]) if self._rest is None else self._rest
            written = self._write(frame)
            if not written:
                return
            if self._rest is None:
                self._size_sent -= len(frame) * (queue is self._sent)
                self._size_published -= len(frame) * (queue is self._published)
                queue.popleft()
            self._rest = frame[written:] if written < len(frame) else None
            most -= written

    def stop_reading(self) -> None:
        """Wait for room only, while anything waits."""
        self._reads = False
        self._watch()

    # Reading

    def frames(self, chunk: memoryview) -> Iterator[bytes]:
        """The messages that are complete with a chunk of bytes; the beginning of another one is kept.

        Raises
        ------
        MalformedMessageError
            If a message is longer than any; nothing more can be read.
        """
        data: bytearray | memoryview = chunk
        if self.tail:
            self.tail += chunk
            data = self.tail
        at, end = 0, len(data)
        while end - at >= 4:
            (length,) = LENGTH.unpack_from(data, at)
            longest = MAX_MESSAGE if self.met else LONGEST_HELLO
            if length > longest:
                raise MalformedMessageError("oversized", f"a message of {length} bytes, where {longest} are the most")
            if end - at - 4 < length:
                break
            start, at = at + 4, at + 4 + length
            yield bytes(memoryview(data)[start:at])
        if data is not chunk:
            del self.tail[:at]
        elif at < end:
            self.tail += chunk[at:]
        if self.tail:
            self.grown = monotonic()

    # Meeting

    def say_hello(self, link: str, robot: str) -> None:
        """Send the first message of a link, which names it, and shows that it knows the key."""
        self.send(frame_of(_HELLO.pack(_PROTOCOL, link.encode(), self._said) + robot.encode()))

    def take_hello(self, content: bytes) -> None:
        """Take the other's first message; raises `ValueError` if it is none, or does not know the key."""
        if len(content) < _HELLO.size:
            raise ValueError("a hello is too short")
        protocol, link, said = _HELLO.unpack_from(content)
        robot = content[_HELLO.size :].decode()
        if protocol != _PROTOCOL:
            raise ValueError(f"a link speaks {protocol!r}, and this one {_PROTOCOL!r}")
        if not hmac.compare_digest(said, self._awaited):
            raise ValueError("a link does not know the key")
        if not _LINK.fullmatch(link.decode("ascii")) or not _ROBOT.fullmatch(robot):
            raise ValueError("a hello has no id, or no name of a robot")
        self.link, self.robot = link.decode("ascii"), robot

    def say_welcome(self, heard: str | None) -> None:
        """Send the second message: the channel that this link hears of the other."""
        self.heard = heard
        self.send(frame_of((heard or "").encode()))

    def take_welcome(self, content: bytes) -> None:
        """Take the other's second message; raises `ValueError` if it names no channel."""
        channel = content.decode("ascii")
        if not _CHANNEL.fullmatch(channel):
            raise ValueError("a welcome names no channel")
        self.hears = channel or None
        self.met = True

    def close(self) -> None:
        """Close the socket; waiting frames are lost."""
        self.closed = True
        self.waits = False
        self._poll.watch(self.sock, self, 0)
        self.sock.close()
