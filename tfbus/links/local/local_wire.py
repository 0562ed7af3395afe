"""`LocalWire`: the wire between the processes of one user on one machine.

Every two links share one connection: a Unix stream socket in a directory that only the user can enter, see
`tfbus.links.local.meeting_place`. The order of their start does not matter, and no other program takes part.

The protocol
------------
Each side of a connection sends frames: a length (u32, little-endian) and as many bytes.

======  ======================  ============================================================================
frame   what it is              its bytes
======  ======================  ============================================================================
first   hello                   ``tfbus local 3\\n``, id (32), half of the key (16), robot; then for each `Hearing`
                                of its sender, in their order: ``\\n``, the pattern, a space, the channel
others  messages                what `publish` and `send` were given
======  ======================  ============================================================================

The side that has connected says hello first, and the other side answers with its own. A connection is *met* for a side
that has read the other's hello, and nothing goes before a hello, so no message can come too early. For Unix sockets
the key is zeros, and the kernel tells the user of the other process. On the loopback the key stands in the file that
names the port; the side that has connected says the first half, and the side that listens answers with the second. So a
program that listens at the port of a link that has gone learns only a half that nobody asks for any more, and cannot
answer.

Connecting
----------
The younger link connects to the older ones, when it opens and whenever it looks into the directory; one that was missed
is met at the next look. A link looks often at first, and then every two seconds. Two links never greet each other on
two connections:

* Only the younger link says hello first. It has at most one connection to each older link, and waits on it for the
  answer as long as the connection lasts, however late the answer is: the older link may be stopped, and go on later and
  read the hello. So the side that listens is met when it has read the hello: the other has not gone meanwhile.
* The older link chooses. It may end a connection whose hello it has not read, and the younger one then connects again.
  An id in use is not taken over: another connection of that id is refused while the first one is there.

A younger link that has not connected after some looks may have been killed. The older one connects to it and says
nothing, only to find out whether anybody listens; if nobody does, it removes the name.

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
that are not met, the newest 64 are kept, for 10 s. A hello has at most 256 KiB, which is room for 1,000 names of robots
that its sender hears. One turn of the event loop reads for about a millisecond, and one read more.
"""

import os
import secrets
import socket
from collections import deque
from collections.abc import Callable, Sequence
from random import uniform
from selectors import EVENT_READ, EVENT_WRITE, SelectorKey
from time import monotonic
from typing import Final
from weakref import WeakSet

import anyio
import anyio.lowlevel

from tfbus._aio.turn_budget import TurnBudget
from tfbus.links.local.connection import Connection, Poll, frame_of
from tfbus.links.local.meeting_place import MeetingPlace
from tfbus.links.seams import MAX_MESSAGE, Hearing, Joined, Left, Receive, Wire
from tfbus.tf_message import MalformedMessageError

MOST_CONNECTIONS: Final = 1_000
MOST_STRANGERS: Final = 64
"""The most incoming connections that are not met yet."""
MOST_HEARINGS: Final = 1_000
"""The most names of robots that a link hears, so that its hello is not too long."""
MOST_UNFINISHED: Final = 2**26
"""Bytes of all unfinished messages together."""
PATIENCE: Final = 10.0
"""s until an incoming connection has to be met."""
_OFTEN, _RARELY = 0.01, 2.0
_FLUSH_TIME = 1.0
_ACCEPTED_AT_ONCE = 16


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

    Attributes
    ----------
    turn : callable
        Calls the function that it gets, which receives for one turn of the event loop. A link has what was received
        handled in the same turn.
    """

    # A connection drops only the oldest waiting messages, so the last one before a silence arrives.
    rest: float = 12.0

    def __init__(
        self, domain: str, robot: str = "", *, directory: str | None = None, loopback: bool | None = None
    ) -> None:
        self.id: str = secrets.token_hex(16)
        self._robot = robot
        self._place = MeetingPlace(domain, self.id, directory, loopback)
        self._listener: socket.socket | None = None
        # All connections, the oldest first; and the met ones, by the ids of the other links.
        self._connections: dict[Connection, None] = {}
        self._links: dict[str, Connection] = {}
        self._budget = TurnBudget()
        self.turn: Callable[[Callable[[], object]], object] = lambda receive: receive()
        self._ready: deque[tuple[SelectorKey, int]] = deque()

    async def open(self, hears: Sequence[Hearing], receive: Receive, warn: Callable[[Exception], object]) -> None:
        if len(hears) > MOST_HEARINGS:
            raise OSError(f"a link hears {MOST_HEARINGS} names of robots at most, and {len(hears)} are given")
        self._hears, self._receive, self._warn = tuple(hears), receive, warn
        self._poll = Poll()
        _open_wires.add(self)
        self._look()
        await anyio.lowlevel.checkpoint()

    async def run(self) -> None:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(self._poll.run, lambda: self.turn(self._serve))
            tasks.start_soon(self._meet)

    def is_heard(self, channel: str) -> bool:
        return any(connection.hears == channel for connection in self._links.values())

    def is_behind(self) -> bool:
        return any(events & EVENT_READ for _, events in self._poll.ready())

    def publish(self, channel: str, message: bytes) -> None:
        if len(message) <= MAX_MESSAGE:
            frame = frame_of(message)
            for connection in self._links.values():
                if connection.hears == channel:
                    connection.publish(frame)

    def send(self, link: str, message: bytes) -> bool:
        connection = self._links.get(link)
        return connection is not None and len(message) <= MAX_MESSAGE and connection.send(frame_of(message))

    async def close(self) -> None:
        if self not in _open_wires:
            return
        _open_wires.discard(self)
        self._place.close()
        try:
            with anyio.move_on_after(_FLUSH_TIME, shield=True):
                async with anyio.create_task_group() as tasks:
                    for connection in self._links.values():
                        tasks.start_soon(connection.drain)
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Close all sockets at once, and leave the name; a child process does no more, for all is its parent's."""
        # The poll object first: a child process shares it with its parent, for which it has to stay as it is.
        self._poll.close()
        self._stop_listening()
        for connection in self._connections:
            connection.close()
        self._connections.clear()
        self._links.clear()

    # Listening and dialling

    def _stop_listening(self) -> None:
        if self._listener is not None:
            self._poll.watch(self._listener, None, 0)
            self._listener.close()

    async def _meet(self) -> None:
        """Look for older links, and end incoming connections that are not met in time."""
        pause = _OFTEN
        while True:
            await anyio.sleep(pause * uniform(0.8, 1.2))
            pause = min(3 * pause, _RARELY)
            begun = monotonic() - PATIENCE
            for stranger in self._strangers():
                if stranger.begun < begun:
                    self._end(stranger)
            try:
                # A younger link connects by itself, unless it was killed.
                self._look(younger=pause == _RARELY)
            except OSError as error:
                self._warn(error)

    def _look(self, younger: bool = False) -> None:
        """Connect to the older links that are not met, or to all, and show this link's name unless it is there."""
        # The directory is trusted once it has been opened.
        names = [] if self._listener is None else self._place.names()
        if self._listener is None or self._place.name not in names:
            listener = self._place.open()
            self._stop_listening()
            self._listener, names = listener, self._place.names()
        # Again, because there may be free files after there were none.
        self._poll.watch(self._listener, self._listener, EVENT_READ)
        # A name ends with the beginning of the id.
        known = {self.id[:8], *(each.dialled[-8:] or each.link[:8] for each in self._connections)}
        for name in names:
            if name[-8:] not in known and (younger or name < self._place.name) and not self._is_full():
                self._dial(name)

    def _is_full(self) -> bool:
        full = len(self._connections) >= MOST_CONNECTIONS
        if full:
            self._warn(ConnectionError(f"there are more than {MOST_CONNECTIONS} links; some are not met"))
        return full

    def _dial(self, name: str) -> None:
        try:
            sock, key = self._place.dial(name)
        except (ConnectionRefusedError, FileNotFoundError, BlockingIOError):
            # The other link has gone, or has no room for now.
            return
        except OSError as error:
            self._warn(error)
            return
        connection = Connection(sock, self._poll, key, name, waits=self._place.loopback)
        self._connections[connection] = None
        if name < self._place.name:
            connection.say_hello(self.id, self._robot, self._hears)

    def _accept(self, listener: socket.socket) -> None:
        """Accept connections that wait, some at once: on a crowded machine the next turn may be far."""
        for _ in range(_ACCEPTED_AT_ONCE):
            try:
                sock = self._place.accept(listener)
            except (BlockingIOError, ConnectionAbortedError):
                return
            except OSError as error:
                self._warn(error)
                if not isinstance(error, PermissionError):
                    # There are too many open files. Existing connections go on, and the next look tries again.
                    self._poll.watch(listener, listener, 0)
                return
            strangers = self._strangers()
            if len(strangers) >= MOST_STRANGERS:
                self._end(strangers[0])
            if self._is_full():
                sock.close()
                return
            self._connections[Connection(sock, self._poll, self._place.key)] = None

    def _strangers(self) -> list[Connection]:
        """The incoming connections that are not met, the oldest first."""
        return [each for each in self._connections if not each.dialled and not each.link]

    # Moving bytes

    def _serve(self) -> None:
        """Read connections, and write the frames that wait for room, for one turn of the event loop."""
        self._budget.begin()
        # The connections that a turn leaves come first in the next one.
        self._ready = self._ready or deque(self._poll.ready())
        while self._ready and not self._budget.spent:
            key, events = self._ready.popleft()
            if self._listener and key.data is self._listener:
                self._accept(self._listener)
            # The reading first: it tells the error of a socket, and ends its connection.
            if events & EVENT_READ and key.data in self._connections:
                self._read(key.data)
            if events & EVENT_WRITE and key.data in self._connections:
                key.data.flush()

    def _read(self, connection: Connection) -> None:
        try:
            for content in connection.read():
                if connection.link:
                    self._receive(connection.link, content)
                else:
                    self._greet(connection, content)
        except BlockingIOError:
            return
        except OSError as error:
            if isinstance(error, ConnectionRefusedError):
                # Only a socket of the loopback says so late.
                self._place.remove(connection.dialled)
            self._end(connection)
        except ValueError as error:
            self._refuse(connection, error)
        else:
            # All messages that have begun to arrive have one bound.
            while connection.tail and sum(len(each.tail) for each in self._connections) > MOST_UNFINISHED:
                idle = min((each for each in self._connections if each.tail), key=lambda each: each.grown)
                self._refuse(idle, MalformedMessageError("oversized", "unfinished messages of all links are too large"))

    def _refuse(self, connection: Connection, error: ValueError) -> None:
        if connection.link and isinstance(error, MalformedMessageError):
            self._receive(connection.link, error)
        else:
            self._warn(error)
        self._end(connection)

    def _end(self, connection: Connection) -> None:
        """Close a connection, and say that its link has left."""
        connection.close()
        del self._connections[connection]
        if self._links.get(connection.link) is connection:
            del self._links[connection.link]
            if connection.heard:
                self._receive(connection.link, Left())

    def _greet(self, connection: Connection, content: bytes) -> None:
        """Take a hello, and answer it unless this side has connected.

        Raises
        ------
        ValueError
            If it is no hello, or does not know the key.
        ConnectionAbortedError
            If its link is connected already.
        """
        connection.take_hello(content, self._robot, self._hears)
        if connection.link == self.id or connection.link in self._links:
            raise ConnectionAbortedError(f"the link {connection.link} is connected already")
        if not connection.dialled:
            connection.say_hello(self.id, self._robot, self._hears)
        self._links[connection.link] = connection
        if connection.heard:
            self._receive(connection.link, Joined(connection.robot))


_open_wires: WeakSet[LocalWire] = WeakSet()


def _abandon_all() -> None:
    while _open_wires:
        _open_wires.pop().abandon()


if hasattr(os, "register_at_fork"):
    # Otherwise a child would hold the connections open, and the others would not see the end of its parent.
    os.register_at_fork(after_in_child=_abandon_all)
