"""`LocalWire`: the wire between the processes of one user on one machine.

Every two links share one connection: a Unix stream socket in a directory that only the user can enter, see
`tfbus.links.local.meeting_place`. The order of their start does not matter, and no other program takes part.

The protocol
------------
Each side of a connection sends frames: a length (u32, little-endian) and as many bytes.

======  ======================  ============================================================================
frame   what it is              its bytes
======  ======================  ============================================================================
first   hello                   ``tfbus local 1\\n``, hash of the domain (16), id (32), number (16), robot
second  welcome                 proof (32), the channel that its sender hears of the other; empty for none
others  messages                what `publish` and `send` were given
======  ======================  ============================================================================

The side that has connected says hello first. The other side answers with hello and welcome, and the first side with
its welcome. A connection is *met* for a side when it has both, so nothing that is sent after `Joined` can come too
early. The proof is an HMAC of both hellos, whose random numbers make each of them new. For Unix sockets its key is
empty, and the kernel tells the user of the other process; on the loopback the key stands in the file that names the
port.

Connecting
----------
The younger link connects to the older ones, when it opens and whenever the folder of the domain has changed; so two
links never connect to each other, and one that was missed is met at the next look. A link looks often at first, and
then once a second, which costs one question to the system while nothing has changed. A younger link that has not
connected within a second may have been killed: a connection on which nothing is said finds that out, and then its name
is removed. An id in use is not taken over: another connection of that id is refused while the first one is there. A
newer one replaces one that is not met yet.

Present and lost
----------------
The kernel knows the present links. A link has left when its connection has ended. If its process is killed, the others
see this at once, after all messages that it has written. A process that is stopped or busy is present: its socket
fills, then a bounded number of messages waits for it here, and it reads them all when it goes on.

Bounds
------
Each connection queues at most 8 MiB of published messages, and then drops the oldest, and at most 16 MiB of sent
messages, which go first; a frame whose writing has begun is finished before. A message is at most `MAX_MESSAGE` long; a
longer one ends its connection. All unfinished messages have at most 64 MiB together; beyond that, the connection whose
message has not grown for the longest time is closed. There are at most 1,000 connections. Of the incoming connections
that are not met, the newest 64 are kept, for 10 s. One turn of the event loop reads for about a millisecond.
"""

import os
import secrets
import socket
from collections.abc import Callable, Sequence
from random import uniform
from time import monotonic
from typing import Final
from weakref import WeakSet

import anyio
import anyio.lowlevel

from tfbus._aio.turn_budget import TurnBudget
from tfbus.links.local.connection import Connection, Hello, Poll, frame_of
from tfbus.links.local.meeting_place import MeetingPlace
from tfbus.links.seams import MAX_MESSAGE, Hearing, Joined, Left, Receive, Wire
from tfbus.tf_message import MalformedMessageError

MOST_CONNECTIONS: Final = 1_000
MOST_STRANGERS: Final = 64
"""The most incoming connections that are not met yet."""
MOST_UNFINISHED: Final = 2**26
"""Bytes of all unfinished messages together."""
PATIENCE: Final = 10.0
"""s until a connection has to be met."""
READ_BUFFER: Final = 2**17
_OFTEN, _RARELY = 0.01, 1.0
_FIRST_RETRY, _LAST_RETRY = 0.05, 10.0
_STEADY = 5.0
"""s; a connection that has lasted for so long may be made again at once."""
_FLUSH_TIME = 1.0


class LocalWire(Wire):
    """Moves messages between the links of one domain in the processes of one user on this machine.

    Parameters
    ----------
    domain : str
        Links with equal domains meet.
    robot : str
        The name under which others hear this link; empty for none.
    directory : str, optional
        The directory of the user in which links meet, by default that of the environment; see
        `tfbus.links.local.meeting_place`.
    loopback : bool, optional
        Whether to use ports of the loopback instead of Unix sockets; by default only where there are none, as on
        Windows. All links of a domain have to use the same.
    """

    # A connection drops only the oldest waiting messages, so the last one before a silence arrives.
    rest = 6.0

    def __init__(
        self, domain: str, robot: str = "", *, directory: str | None = None, loopback: bool | None = None
    ) -> None:
        self.id = secrets.token_hex(16)
        self._domain = domain
        self._robot = robot
        self._place = MeetingPlace(
            domain, self.id, directory, not hasattr(socket, "AF_UNIX") if loopback is None else loopback
        )
        self._listener: socket.socket | None = None
        self._accepts = False
        self._connections: set[Connection] = set()
        # The met connections, by the ids of the other links and by the channels that those hear.
        self._links: dict[str, Connection] = {}
        self._hearers: dict[str, list[Connection]] = {}
        # Incoming connections that are not met, the oldest first.
        self._strangers: dict[Connection, None] = {}
        # The size of the unfinished message of each connection; the message that has grown last is the last.
        self._unfinished: dict[Connection, int] = {}
        self._unfinished_size = 0
        self._dialled: dict[str, Connection] = {}
        # The time before which a name is not dialled again (s), and the pause after that, by the names.
        self._retries: dict[str, tuple[float, float]] = {}
        self._warned: set[tuple[type[Exception], object]] = set()

    async def open(self, hears: Sequence[Hearing], receive: Receive, warn: Callable[[Exception], object]) -> None:
        self._hears, self._receive, self._warn = tuple(hears), receive, warn
        self._buffer = memoryview(bytearray(READ_BUFFER))
        self._stirred = anyio.Event()
        self._poll = Poll()
        _open_wires.add(self)
        self._listen()
        self._look()
        await anyio.lowlevel.checkpoint()

    async def run(self) -> None:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(self._move)
            tasks.start_soon(self._meet)

    def is_heard(self, channel: str) -> bool:
        return bool(self._hearers.get(channel))

    def is_behind(self) -> bool:
        return any(readable for _, readable, _ in self._poll.ready())

    def publish(self, channel: str, message: bytes) -> None:
        hearers = self._hearers.get(channel)
        if hearers and len(message) <= MAX_MESSAGE:
            frame = frame_of(message)
            for connection in hearers:
                connection.publish(frame)

    def send(self, link: str, message: bytes) -> bool:
        connection = self._links.get(link)
        return connection is not None and len(message) <= MAX_MESSAGE and connection.send(frame_of(message))

    async def close(self) -> None:
        if self not in _open_wires:
            return
        _open_wires.discard(self)
        self._place.close()
        self._stop_listening()
        try:
            for connection in self._connections:
                connection.stop_reading()
            with anyio.move_on_after(_FLUSH_TIME, shield=True):
                while any(connection.waits for connection in self._links.values()):
                    for connection, _, _ in await self._poll.wait():
                        connection.flush()
                        connection.stop_reading()
        finally:
            for connection in self._connections:
                connection.close()
            self._poll.close()
            self._forget()

    def _forget(self) -> None:
        for held in (self._connections, self._links, self._hearers, self._strangers, self._unfinished, self._dialled):
            held.clear()
        self._buffer = memoryview(b"")

    # Listening and dialling

    def _listen(self) -> None:
        """Show the link's name, also when it has vanished."""
        listener = self._place.open()
        self._stop_listening()
        self._listener = listener
        self._accept_again()

    def _stop_listening(self) -> None:
        if self._listener is not None:
            self._poll.remove(self._listener)
            self._listener.close()
            self._listener = None
            self._accepts = False

    def _accept_again(self) -> None:
        if self._listener is not None and not self._accepts:
            self._poll.add(self._listener, None)
            self._accepts = True

    async def _meet(self) -> None:
        """Look for older links, and end connections that are not met in time."""
        pause = _OFTEN
        while True:
            with anyio.move_on_after(pause * uniform(0.8, 1.2)):
                await self._stirred.wait()
            if self._stirred.is_set():
                self._stirred = anyio.Event()
                pause = _OFTEN
            else:
                pause = min(3 * pause, _RARELY)
            self._accept_again()
            begun = monotonic() - PATIENCE
            for connection in [each for each in self._connections if not each.met and each.begun < begun]:
                self._end(connection)
            self._look()

    def _look(self) -> None:
        """Connect to the links that are not met and due, and show this link's name again if it has vanished."""
        try:
            names = self._place.others()
        except FileNotFoundError:
            try:
                self._listen()
                self._stirred.set()
            except OSError as error:
                self._warn_once(error)
            return
        except OSError as error:
            self._warn_once(error)
            return
        now, met = monotonic(), {link[:8] for link in self._links}
        for name in names:
            if name not in self._dialled and name[16:] not in met:
                if name > self._place.name and name not in self._retries:
                    # The younger link connects by itself, unless it was killed.
                    self._retries[name] = (now + _RARELY, _FIRST_RETRY)
                elif self._retries.get(name, (0.0,))[0] <= now:
                    self._dial(name)
        if len(self._retries) > len(names):
            self._retries = {name: self._retries[name] for name in names if name in self._retries}

    def _dial(self, name: str) -> None:
        _, pause = self._retries.get(name, (0.0, _FIRST_RETRY))
        self._retries[name] = (monotonic() + pause * uniform(0.8, 1.2), min(2 * pause, _LAST_RETRY))
        if len(self._connections) >= MOST_CONNECTIONS:
            self._warn_once(ConnectionError(f"there are more than {MOST_CONNECTIONS} links; some are not met"))
            return
        try:
            sock, key, connected = self._place.dial(name)
        except (ConnectionRefusedError, FileNotFoundError, BlockingIOError):
            # The other link has gone, or has no room for now.
            return
        except OSError as error:
            self._warn_once(error)
            return
        connection = self._dialled[name] = Connection(sock, self._poll, key, name, connected)
        self._connections.add(connection)
        if name < self._place.name:
            connection.hello = Hello.write(self._domain, self.id, self._robot)
            connection.send(frame_of(connection.hello.content))

    async def _accept(self, budget: TurnBudget) -> None:
        while self._listener is not None:
            try:
                sock, _ = self._listener.accept()
            except (BlockingIOError, ConnectionAbortedError):
                return
            except OSError as error:
                # There are too many open files. Existing connections go on, and the next look tries again.
                self._warn_once(error)
                self._poll.remove(self._listener)
                self._accepts = False
                return
            try:
                self._place.prepare(sock)
            except OSError as error:
                sock.close()
                self._warn_once(error)
                continue
            if len(self._strangers) >= MOST_STRANGERS:
                self._end(next(iter(self._strangers)))
            if len(self._connections) >= MOST_CONNECTIONS:
                sock.close()
                self._warn_once(ConnectionError(f"there are more than {MOST_CONNECTIONS} links; some are not met"))
                continue
            connection = Connection(sock, self._poll, self._place.key)
            self._connections.add(connection)
            self._strangers[connection] = None
            # Mostly the hello is there already, so links that connect all at once do not push each other out.
            await self._read(connection, budget)
            await budget.give_way()

    # Moving bytes

    async def _move(self) -> None:
        """Read all connections, and write the frames that wait for room."""
        budget = TurnBudget()
        while True:
            ready = await self._poll.wait()
            budget.begin()
            for connection, readable, writable in ready:
                if connection is None:
                    await self._accept(budget)
                else:
                    # The reading first: it tells the error of a socket, and ends its connection.
                    if readable and not connection.closed:
                        await self._read(connection, budget)
                    if writable and not connection.closed:
                        connection.flush()
                await budget.give_way()

    async def _read(self, connection: Connection, budget: TurnBudget) -> None:
        try:
            size = connection.sock.recv_into(self._buffer)
            if not size:
                self._end(connection)
                return
            for content in connection.frames(self._buffer[:size]):
                if connection.met:
                    self._receive(connection.link, content)
                    await budget.give_way()
                else:
                    self._greet(connection, content)
                if connection.closed:
                    return
        except BlockingIOError:
            return
        except MalformedMessageError as error:
            self._refuse(connection, error)
        except OSError as error:
            if isinstance(error, ConnectionRefusedError):
                # Only a socket of the loopback says so late.
                self._place.remove(connection.dialled)
            self._end(connection)
        except ValueError as error:
            self._warn_once(error)
            self._end(connection)
        else:
            self._note_unfinished(connection)

    def _note_unfinished(self, connection: Connection) -> None:
        """Keep to the bound of all messages that have begun to arrive."""
        size = len(connection.tail)
        if not size and connection not in self._unfinished:
            return
        self._unfinished_size += size - self._unfinished.pop(connection, 0)
        if size:
            self._unfinished[connection] = size
        while self._unfinished_size > MOST_UNFINISHED:
            idle = next(iter(self._unfinished))
            self._refuse(idle, MalformedMessageError("oversized", "unfinished messages of all links are too large"))

    def _refuse(self, connection: Connection, error: MalformedMessageError) -> None:
        if connection.met:
            self._receive(connection.link, error)
        else:
            self._warn_once(error)
        self._end(connection)

    def _end(self, connection: Connection) -> None:
        """Close a connection, and say that its link has left."""
        if connection.closed:
            return
        connection.close()
        self._connections.discard(connection)
        self._strangers.pop(connection, None)
        self._unfinished_size -= self._unfinished.pop(connection, 0)
        if connection.dialled:
            self._dialled.pop(connection.dialled, None)
            if connection.met and monotonic() - connection.begun > _STEADY:
                self._retries.pop(connection.dialled, None)
        if connection.dialled or connection.met:
            self._stirred.set()
        if connection.met:
            del self._links[connection.link]
            if connection.hears is not None:
                self._hearers[connection.hears].remove(connection)
            if connection.heard is not None:
                self._receive(connection.link, Left())

    # Meeting

    def _greet(self, connection: Connection, content: bytes) -> None:
        """Take a hello or a welcome; raises `ValueError` if it is none."""
        if connection.theirs is None:
            self._take_hello(connection, Hello.read(content, self._domain))
        elif connection.link in self._links:
            self._end(connection)
        else:
            connection.read_welcome(content)
            self._join(connection, connection.theirs)

    def _take_hello(self, connection: Connection, theirs: Hello) -> None:
        if theirs.link == self.id or theirs.link in self._links:
            self._end(connection)
            return
        for earlier in [each for each in self._strangers if each.link == theirs.link]:
            self._end(earlier)
        connection.theirs, connection.link = theirs, theirs.link
        if connection.hello is None:
            connection.hello = Hello.write(self._domain, self.id, self._robot)
            connection.send(frame_of(connection.hello.content))
        connection.heard = next((one.channel for one in self._hears if one.matches(theirs.robot)), None)
        connection.send(frame_of(connection.write_welcome()))

    def _join(self, connection: Connection, theirs: Hello) -> None:
        connection.met = True
        self._strangers.pop(connection, None)
        self._links[connection.link] = connection
        if connection.hears is not None:
            self._hearers.setdefault(connection.hears, []).append(connection)
        if connection.heard is not None:
            self._receive(connection.link, Joined(theirs.robot))

    def _warn_once(self, error: Exception) -> None:
        kind = (type(error), getattr(error, "errno", None))
        if kind not in self._warned:
            self._warned.add(kind)
            self._warn(error)

    def abandon(self) -> None:
        """Forget everything in a child process, where it belongs to the parent."""
        self._place.name = ""
        if self._listener is not None:
            self._listener.close()
            self._listener = None
        for connection in self._connections:
            connection.abandon()
        self._poll.abandon()
        self._forget()


_open_wires: WeakSet[LocalWire] = WeakSet()


def _abandon_all() -> None:
    for wire in _open_wires:
        wire.abandon()
    _open_wires.clear()


if hasattr(os, "register_at_fork"):
    # Otherwise a child would hold the connections open, and the others would not see the end of its parent.
    os.register_at_fork(after_in_child=_abandon_all)
