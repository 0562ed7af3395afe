"""`Connection`: the socket between two links, its frames, and the queues of a full socket. `Poll` waits for many."""

import hmac
import re
import secrets
import selectors
import socket
import struct
from collections import deque
from collections.abc import Awaitable, Callable, Iterator
from contextlib import suppress
from hashlib import blake2b
from selectors import EVENT_READ, EVENT_WRITE
from time import monotonic
from typing import Any, Final, NamedTuple

import anyio
import anyio.lowlevel

from tfbus.links.seams import MAX_MESSAGE
from tfbus.tf_message import MalformedMessageError

MOST_PUBLISHED: Final = 2**23
"""Bytes of published messages that wait for one link, before the oldest are dropped."""
MOST_SENT: Final = 2**24
"""Bytes of sent messages that wait for one link, before further ones are refused."""
LONGEST_HELLO: Final = 2**14
MOST_AT_ONCE: Final = 2**18
"""Bytes that are written to one socket before others have their turn."""
LENGTH: Final = struct.Struct("<I")
_PROTOCOL = b"tfbus local 1\n"
_HELLO = struct.Struct(f"{len(_PROTOCOL)}s16s32s16s")
_PROOF = 32
_LINK = re.compile("[0-9a-f]{32}")
_CHANNEL = re.compile("[A-Za-z0-9_-]{0,32}")
_ROBOT = re.compile(r"[\w.-]{0,200}", re.ASCII)
_FLAGS = getattr(socket, "MSG_NOSIGNAL", 0)


def frame_of(message: bytes) -> bytes:
    """A message as it stands in a connection."""
    return LENGTH.pack(len(message)) + message


class Hello(NamedTuple):
    """The first message of a link, which names it.

    Attributes
    ----------
    link : str
        Its id.
    robot : str
    content : bytes
        The message, for the proofs.
    """

    link: str
    robot: str
    content: bytes

    @classmethod
    def write(cls, domain: str, link: str, robot: str) -> "Hello":
        """A hello for one connection."""
        start = _HELLO.pack(_PROTOCOL, _digest(domain), link.encode(), secrets.token_bytes(16))
        return cls(link, robot, start + robot.encode())

    @classmethod
    def read(cls, content: bytes, domain: str) -> "Hello":
        """The hello of another; raises `ValueError` if it is none, or of another domain."""
        if len(content) < _HELLO.size:
            raise ValueError("a hello is too short")
        protocol, digest, link, _ = _HELLO.unpack_from(content)
        if protocol != _PROTOCOL:
            raise ValueError(f"a link speaks {protocol!r}, and this one {_PROTOCOL!r}")
        if digest != _digest(domain) or not _LINK.fullmatch(link.decode("ascii")):
            raise ValueError("a hello is of another domain, or has no id")
        robot = content[_HELLO.size :].decode()
        if not _ROBOT.fullmatch(robot):
            raise ValueError("a hello has no name of a robot")
        return cls(link.decode("ascii"), robot, content)


def _digest(domain: str) -> bytes:
    return blake2b(domain.encode(), digest_size=16).digest()


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

    async def wait(self) -> list[tuple[Any, bool, bool]]:
        """Wait until a socket may be ready; returns as `ready`."""
        if self._loop is not None:
            self._ready = self._loop.create_future()
            found: list[tuple[Any, bool, bool]] = await self._ready
            return found
        if self._file is not None:
            await anyio.wait_readable(self._file)
            return self.ready()
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
    connected : bool
        Whether the socket is connected already.

    Attributes
    ----------
    hello, theirs : Hello or None
        Of this side and of the other.
    heard : str or None
        The channel that this link hears of the other.
    hears : str or None
        The channel that the other hears of this one.
    met, closed : bool
    begun : float
        In s of `time.monotonic`.
    """

    def __init__(self, sock: socket.socket, poll: Poll, key: bytes, dialled: str = "", connected: bool = True) -> None:
        self.sock = sock
        self._poll = poll
        self._key = key
        self.dialled = dialled
        self.begun = monotonic()
        self.link = ""
        self.hello: Hello | None = None
        self.theirs: Hello | None = None
        self.heard: str | None = None
        self.hears: str | None = None
        self.met = self.closed = False
        self.tail = bytearray()
        # Whether a write is tried at once; nothing waits then.
        self._room = connected
        self._rest: memoryview | None = None
        self._sent: deque[bytes] = deque()
        self._published: deque[bytes] = deque()
        self._size_sent = self._size_published = 0
        poll.add(sock, self)
        if not connected:
            poll.change(sock, self, write=True)

    @property
    def waits(self) -> bool:
        """Whether anything waits for room."""
        return not self._room and not self.closed

    # Writing

    def publish(self, frame: bytes) -> None:
        """Write a frame at once, or have it wait; the oldest that wait are dropped."""
        if self._room and self._write_at_once(frame):
            return
        self._published.append(frame)
        self._size_published += len(frame)
        while self._size_published > MOST_PUBLISHED:
            self._size_published -= len(self._published.popleft())

    def send(self, frame: bytes) -> bool:
        """Write a frame at once, or have it wait before all that are published; False if there is no room."""
        if self._room and self._write_at_once(frame):
            return True
        if self.closed or self._size_sent + len(frame) > MOST_SENT:
            return False
        self._sent.append(frame)
        self._size_sent += len(frame)
        return True

    def _write_at_once(self, frame: bytes) -> bool:
        """Whether the frame need not wait: it is written, in part at least, or the other side has stopped reading."""
        try:
            written = self.sock.send(frame, _FLAGS)
        except BlockingIOError:
            written = 0
        except OSError:
            # The reading finds the end, after all that the other has written before.
            self._stop_writing()
            return True
        if written == len(frame):
            return True
        self._room = False
        self._poll.change(self.sock, self, write=True)
        if written:
            self._rest = memoryview(frame)[written:]
        return written > 0

    def flush(self) -> None:
        """Write the waiting frames, as far as there is room."""
        most = MOST_AT_ONCE
        try:
            while most > 0:
                queue = self._sent or self._published
                if self._rest is None and not queue:
                    self._room = True
                    self._poll.change(self.sock, self)
                    return
                frame = self._rest if self._rest is not None else memoryview(queue[0])
                written = self.sock.send(frame, _FLAGS)
                if self._rest is None:
                    # From here on nothing goes before the rest of this frame.
                    self._take_first(queue)
                self._rest = frame[written:] if written < len(frame) else None
                most -= written
        except BlockingIOError:
            return
        except OSError:
            self._stop_writing()

    def _take_first(self, queue: deque[bytes]) -> None:
        size = len(queue.popleft())
        if queue is self._sent:
            self._size_sent -= size
        else:
            self._size_published -= size

    def _stop_writing(self) -> None:
        """Write no more, because the other side does not read; the end of the stream tells it so."""
        self._sent.clear()
        self._published.clear()
        self._rest = None
        self._size_sent = self._size_published = 0
        self._room = True
        with suppress(OSError):
            self._poll.change(self.sock, self)
            self.sock.shutdown(socket.SHUT_WR)

    def stop_reading(self) -> None:
        """Wait for room only, while anything waits."""
        if self.waits:
            self._poll.change(self.sock, self, read=False, write=True)
        else:
            self._poll.remove(self.sock)

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
        if data is chunk:
            self.tail += chunk[at:]
        else:
            del self.tail[:at]

    # Meeting

    def prove(self) -> bytes:
        """This side's proof that it knows the key: a code over both hellos, each with a random number."""
        return self._proof(bool(self.dialled))

    def believes(self, proof: bytes) -> bool:
        """Whether the other side's proof is right."""
        return hmac.compare_digest(self._proof(not self.dialled), proof)

    def _proof(self, of_dialler: bool) -> bytes:
        assert self.hello is not None
        assert self.theirs is not None
        ours, theirs = self.hello.content, self.theirs.content
        first, second = (ours, theirs) if self.dialled else (theirs, ours)
        said = b"dialler" if of_dialler else b"listener"
        return hmac.digest(self._key, b"".join((said, LENGTH.pack(len(first)), first, second)), "sha256")

    def write_welcome(self) -> bytes:
        """The second message: the proof, and the channel that this link hears of the other."""
        return self.prove() + (self.heard or "").encode()

    def read_welcome(self, content: bytes) -> None:
        """Take the other's second message; raises `ValueError` if it does not know the key."""
        channel = content[_PROOF:].decode("ascii")
        if not self.believes(content[:_PROOF]) or not _CHANNEL.fullmatch(channel):
            raise ValueError("a link does not know the key, or names no channel")
        self.hears = channel or None

    def close(self) -> None:
        """Close the socket; waiting frames are lost."""
        if not self.closed:
            self.closed = True
            self._room = False
            self._sent.clear()
            self._published.clear()
            self._rest = None
            self._poll.remove(self.sock)
            self.sock.close()

    def abandon(self) -> None:
        """Close the socket in a child process; it goes on in the parent."""
        self.closed = True
        self._room = False
        self.sock.close()
