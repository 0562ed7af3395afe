"""`Connection`: the socket between two links, its frames, and the queues of a full socket. `Poll` waits for many."""

import hmac
import re
import selectors
import socket
import struct
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from selectors import EVENT_READ, EVENT_WRITE
from time import monotonic
from typing import Any, Final

import anyio
import anyio.lowlevel
import anyio.to_thread

from tfbus.links.seams import MAX_MESSAGE, Hearing, first_match
from tfbus.tf_message import MalformedMessageError

MOST_PUBLISHED: Final = 2**23
"""Bytes of published messages that wait for one link, before the oldest are dropped."""
MOST_SENT: Final = 2**24
"""Bytes of sent messages that wait for one link, before further ones are refused."""
LONGEST_HELLO: Final = 2**18
MOST_AT_ONCE: Final = 2**18
"""Bytes that are written to one socket before others have their turn."""
READ_AT_ONCE: Final = 2**15
"""Bytes that are read from one socket before others have their turn."""
KEY: Final = 32
"""Bytes of a key; the side that connects says the first half, and the other side the second half."""
LENGTH: Final = struct.Struct("<I")
_LOOK_AGAIN: Final = 0.02
_PROTOCOL = b"tfbus local 3\n"
_HEARS = rb"(?P<hears>(?:\n[\w.*-]{0,200} [\w-]{1,32})*)"
_HELLO = re.compile(_PROTOCOL + rb"(?P<link>[0-9a-f]{32})(?P<key>.{16})(?P<robot>[\w.-]{0,200})" + _HEARS, re.DOTALL)
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

    def watch(self, sock: socket.socket, owner: object, events: int) -> None:
        """Wait on a socket for bytes, for room, for both, or no more; the last before it is closed."""
        # After `close` there is no map.
        if sock in (self._selector.get_map() or ()):
            self._selector.unregister(sock)
        if events:
            self._selector.register(sock, events, owner)

    def ready(self, patience: float = 0.0) -> list[tuple[selectors.SelectorKey, int]]:
        """The sockets that are ready, with whether there are bytes to read, and room to write."""
        return self._selector.select(patience) if self._selector.get_map() else []

    async def run(self, serve: Callable[[], object]) -> None:
        """Call `serve` when any socket is ready, until cancelled; again in the next turn if it leaves any."""
        if not hasattr(self._selector, "fileno"):
            thread = anyio.CapacityLimiter(1)
            while True:
                # A socket that is closed meanwhile may end the wait with an error.
                with suppress(OSError):
                    await anyio.to_thread.run_sync(self.ready, _LOOK_AGAIN, abandon_on_cancel=True, limiter=thread)
                serve()
        file: int = self._selector.fileno()
        loop: Any = anyio.lowlevel.current_token().native_token
        if hasattr(loop, "add_reader"):
            # To begin and end that for each message costs a third more.
            loop.add_reader(file, serve)
            try:
                await anyio.sleep_forever()
            finally:
                loop.remove_reader(file)
        while True:
            await anyio.wait_readable(file)
            serve()

    def close(self) -> None:
        """Close the file; in a child process, the parent goes on waiting with its own."""
        self._selector.close()


class Frames:
    """A queue of frames, with the bytes of all of them."""

    def __init__(self) -> None:
        self.size: int = 0
        self._frames: deque[bytes] = deque()

    def put(self, frame: bytes) -> None:
        """Append a frame."""
        self._frames.append(frame)
        self.size += len(frame)

    def take(self) -> bytes:
        """Remove and return the oldest frame; empty if there is none."""
        frame = self._frames.popleft() if self._frames else b""
        self.size -= len(frame)
        return frame


class Connection:
    """One connection. It is *met* when the other side has said hello.

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
        Of the other side; `link` is empty until the connection is met.
    heard : bool
        Whether this link hears the other.
    hears : str or None
        The channel that the other hears of this one.
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
        self.heard: bool = False
        self.hears: str | None = None
        self.tail: bytearray = bytearray()
        self.waits: bool = waits
        # The rest of the frame that is written next: nothing goes before it.
        self._begun: bytes | memoryview = b""
        self._sent = Frames()
        self._published = Frames()
        self._watch()

    def _watch(self) -> None:
        self._poll.watch(self.sock, self, EVENT_READ | EVENT_WRITE * self.waits)

    # Writing

    def publish(self, frame: bytes) -> None:
        """Write a frame at once, or have it wait; the oldest that wait are dropped."""
        self._published.put(frame)
        while self._published.size > MOST_PUBLISHED:
            self._published.take()
        if not self.waits:
            self.flush()

    def send(self, frame: bytes) -> bool:
        """Write a frame at once, or have it wait before all that are published; False if there is no room."""
        if self._sent.size + len(frame) > MOST_SENT:
            return False
        self._sent.put(frame)
        if not self.waits:
            self.flush()
        return True

    def flush(self) -> None:
        """Write the waiting frames, as far as there is room."""
        most = MOST_AT_ONCE
        while frame := self._begun or self._sent.take() or self._published.take():
            self._begun = frame
            if most <= 0:
                break
            try:
                written = self.sock.send(frame, _FLAGS)
            except BlockingIOError:
                break
            except OSError:
                # The other side reads no more, or this machine has no memory, and the frame may have begun. The reading
                # finds the end, after all that the other has written before.
                with suppress(OSError):
                    self.sock.shutdown(socket.SHUT_WR)
                written = len(frame)
            self._begun = memoryview(frame)[written:] if written < len(frame) else b""
            most -= written
        waits = bool(self._begun)
        if waits is not self.waits:
            self.waits = waits
            self._watch()

    async def drain(self) -> None:
        """Wait until all that waits has been written, instead of the poll; on the loopback, until it has been read."""
        while self.waits:
            await anyio.wait_writable(self.sock)
            self.flush()
        if self.sock.family == socket.AF_INET:
            # To close a port with unread bytes would reset it, and lose what the other side has not read.
            with suppress(OSError):
                self.sock.shutdown(socket.SHUT_WR)
                await anyio.wait_readable(self.sock)
                while self.sock.recv(READ_AT_ONCE):
                    await anyio.wait_readable(self.sock)

    # Reading

    def read(self) -> Iterator[bytes]:
        """The messages that are complete with the bytes that are there; the beginning of another one is kept.

        Raises
        ------
        OSError
            If the connection has ended.
        MalformedMessageError
            If a message is longer than any; nothing more can be read.
        """
        chunk = self.sock.recv(READ_AT_ONCE)
        if not chunk:
            raise ConnectionResetError("the other side has ended the connection")
        self.tail += chunk
        at = 0
        while len(self.tail) - at >= LENGTH.size:
            (length,) = LENGTH.unpack_from(self.tail, at)
            longest = MAX_MESSAGE if self.link else LONGEST_HELLO
            if length > longest:
                raise MalformedMessageError("oversized", f"a message of {length} bytes, where {longest} are the most")
            start, end = at + LENGTH.size, at + LENGTH.size + length
            if end > len(self.tail):
                break
            yield bytes(memoryview(self.tail)[start:end])
            at = end
        del self.tail[:at]
        self.grown = monotonic()

    # Meeting

    def say_hello(self, link: str, robot: str, hears: Sequence[Hearing]) -> None:
        """Send the first message of a link, which names it and what it hears, and shows that it knows the key."""
        hearings = "".join(f"\n{one.robots} {one.channel}" for one in hears)
        self.send(frame_of(_PROTOCOL + link.encode() + self._said + f"{robot}{hearings}".encode()))

    def take_hello(self, content: bytes, robot: str, hears: Sequence[Hearing]) -> None:
        """Take the other's first message, for a link of this robot, which hears so.

        Raises
        ------
        ValueError
            If it is no hello, or does not know the key.
        """
        hello = _HELLO.fullmatch(content)
        if hello is None:
            parts = f"{_PROTOCOL!r}, an id, a key, a robot and hearings"
            raise ValueError(f"a link says {content[:100]!r}, and {parts} are a hello")
        if not hmac.compare_digest(hello["key"], self._awaited):
            raise ValueError("a link does not know the key")
        self.link, self.robot = hello["link"].decode(), hello["robot"].decode()
        self.heard = first_match(hears, self.robot) is not None
        others = [Hearing(*line.split(" ")) for line in hello["hears"].decode().split("\n")[1:]]
        hearing = first_match(others, robot)
        self.hears = hearing and hearing.channel

    def close(self) -> None:
        """Close the socket; waiting frames are lost."""
        self._poll.watch(self.sock, self, 0)
        self.sock.close()
