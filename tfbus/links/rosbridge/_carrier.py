"""The carrier of links through rosbridge."""

import random
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from math import inf
from time import monotonic
from typing import Any, Final, Literal
from uuid import uuid4

import anyio

from tfbus._aio.task_groups import close_task_group
from tfbus.geometry.stamped import TransformStamped
from tfbus.links._provenance import ReceivedTransform
from tfbus.links._receive_queue import Presence, Received
from tfbus.links.ros._carrier import MAX_SIZE, RosCarrier, RosMessage
from tfbus.links.ros.settings import RosSettings
from tfbus.links.rosbridge._confirmation import Confirmation
from tfbus.links.rosbridge._protocol import (
    CLOCK_TYPE,
    JOINT_TYPE,
    TEXT_TYPE,
    Incoming,
    LargeMessage,
    advertise,
    decode_content,
    decode_content_in_parts,
    decode_joints,
    is_large,
    is_of_ros2,
    publish,
    read,
    read_large,
    subscribe,
    unsubscribe,
)
from tfbus.links.rosbridge._websocket import WebSocket
from tfbus.tf_message import Decoded, MalformedMessageError

MOST_QUEUED = 1_000
"""So many messages wait for a slow server; then the oldest are dropped."""
MOST_SAID: Final = 20
"""So many different things that a server says of itself are logged for one connection."""
Encoding = Literal["cbor", "cbor-raw"]
CONNECT_TIME = 5.0
SILENCE = 10.0
"""s; a server that does not even answer a ping for so long is gone."""
FIRST_PAUSE, LONGEST_PAUSE = 0.25, 5.0
"""s between two attempts to connect."""
LINGER_TIME = 11.0
"""s; a server of ROS 2 keeps the publisher of a client that has gone for 10, and then ROS takes a while."""
ECHO_TIME = 2.0
"""s; a server of ROS 2 gives the last second of its own clients to those who come, so it may come from this link."""
_CLOSING_TIME = 1.0
_MISS_PERIODS = (1.0, 2.0, 4.0, 8.0, 16.0)
"""s; while a lookup waits, the static frames are asked for again so often, and then after the last of these."""


class RosbridgeCarrier(RosCarrier):
    """Talks with a rosbridge server; see `RosCarrier`.

    Parameters
    ----------
    url : str
    settings : RosSettings
    encoding : {"cbor", "cbor-raw"}
        The encoding that is asked for; a server that does not know it uses another.
    lookup_waits : callable
        Whether a lookup on the bus waits for something.
    """

    def __init__(
        self,
        url: str,
        settings: RosSettings,
        encoding: Encoding = "cbor",
        lookup_waits: Callable[[], bool] = lambda: False,
    ) -> None:
        super().__init__(f"rosbridge:{uuid4().hex}", settings)
        self._url = url
        self._wanted: Encoding = encoding
        self._encoding: Encoding = encoding
        self._lookup_waits = lookup_waits
        self._socket: WebSocket | None = None
        self._moving: deque[tuple[str, int]] = deque()
        self._changed_statics: str | None = None
        self._requests: deque[str] = deque()
        self._said: set[str] = set()
        self._confirmation = Confirmation(url, self._publish_statics)
        self._woken = anyio.Event()
        self._of_ros2 = False
        self._advertised = self._heard_moving = False
        self._connected_at = self._broken_at = self._held_until = -inf
        # Made when the server is there: anyio makes none without an event loop.
        self._writing: anyio.CancelScope
        self._ending: bool

    async def _connect(self) -> None:
        self._socket = await WebSocket.connect(self._url, MAX_SIZE, CONNECT_TIME)
        self._encoding = self._wanted
        if self._of_ros2 and self._advertised:
            self._held_until = self._broken_at + LINGER_TIME
        self._advertised = self._heard_moving = False
        self._connected_at = monotonic()
        self._moving.clear()
        self._requests.clear()
        self._said.clear()
        # First of all: what is latched may come only once, and moving frames come again.
        for topic in (*self.settings.tf_static, *self.settings.tf):
            self._request(subscribe(topic, self._encoding))
        for topic in self.settings.joint_topic:
            # In CBOR, a server of ROS 1 fails at the names of the joints, an array of strings.
            self._request(subscribe(topic, "none" if self._encoding == "cbor" else self._encoding, JOINT_TYPE))
        for topic in self.settings.clock_topic:
            self._request(subscribe(topic, self._encoding, CLOCK_TYPE))
        for topic in self.settings.description_topic:
            self._request(subscribe(topic, self._encoding, TEXT_TYPE))
        if self.settings.send:
            self._request(advertise(self.settings.tf_static[0], static=True))
            self._publish_statics()
        self._receive(Received(self._url, Presence.JOINED))

    async def run(self) -> None:
        """Talk with the server, and connect again whenever it has gone."""
        while True:
            if self._socket is not None:
                await self._talk(self._socket)
            await self._come_back()

    async def close(self) -> None:
        """Send what is left, and close."""
        socket, self._socket = self._socket, None
        if socket is None:
            return
        with anyio.move_on_after(_CLOSING_TIME, shield=True):
            try:
                await self._send_all(socket)
            except OSError:
                pass
            finally:
                await socket.close()

    def _publish(self, samples: Sequence[TransformStamped], static: bool) -> bool:
        if static:
            self._changed_statics = publish(self.settings.tf_static[0], samples, static=True)
            self._confirmation.expect(samples)
            if self._confirmation.doubted:
                # Else a server that has forgotten the topic takes them, and keeps them for nobody.
                self._request(advertise(self.settings.tf_static[0], static=True))
        elif self._socket is None:
            error = ConnectionError(f"{self._url} is not connected")
            self._report.refused("not connected", error, len(samples))
            return False
        elif monotonic() < self._held_until:
            error = ConnectionError(f"{self._url} was away, and still has a publisher of that time, which hides others")
            self._report.refused("rejoining", error, len(samples))
            return False
        else:
            if not self._advertised:
                # Not before there is something: a server of ROS 2 then gives later clients only what is latched.
                self._advertised = True
                self._request(advertise(self.settings.tf[0], static=False))
            if len(self._moving) >= MOST_QUEUED:
                _, dropped = self._moving.popleft()
                self._report.refused("congested", OSError(f"{self._url} is too slow for what is published"), dropped)
            self._moving.append((publish(self.settings.tf[0], samples), len(samples)))
        self._woken.set()
        return True

    def _decode(self, payload: Any) -> Decoded[ReceivedTransform]:
        return decode_content(payload)

    def _heard(self, samples: Sequence[ReceivedTransform | None], static: bool) -> None:
        if static:
            self._confirmation.heard(samples)

    def _is_large(self, payload: Any) -> bool:
        return isinstance(payload, LargeMessage) or (isinstance(payload, bytes) and super()._is_large(payload))

    def _decode_in_parts(self, payload: Any) -> Iterator[Decoded[ReceivedTransform]]:
        return decode_content_in_parts(payload)

    def _decode_joints(self, payload: Any) -> tuple[int, dict[str, float]]:
        return decode_joints(payload)

    async def _talk(self, socket: WebSocket) -> None:
        """Send and receive until the server is gone."""
        # What is being sent when the link ends goes out whole, or later messages could not be read.
        self._writing, self._ending = anyio.CancelScope(shield=True), False
        tasks = anyio.create_task_group()
        await tasks.__aenter__()
        for work in (self._read_all, self._write_all, self._keep_alive):
            tasks.start_soon(self._until_gone, work, socket, tasks.cancel_scope)
        tasks.start_soon(self._ask_again)
        tasks.start_soon(self._end_holding)
        tasks.start_soon(self._confirm_statics)
        tasks.start_soon(self._end_writing)
        await close_task_group(tasks)
        # Not when the link ends: then there is still something to send.
        self._socket = None
        self._broken_at = monotonic()
        self._receive(Received(self._url, Presence.LEFT))
        await socket.close()

    async def _until_gone(self, work: Callable[[WebSocket], Any], socket: WebSocket, scope: anyio.CancelScope) -> None:
        try:
            await work(socket)
        except OSError as error:
            self._report.failed(ConnectionError(f"{self._url}: {error}"))
            scope.cancel()

    async def _come_back(self) -> None:
        pause = FIRST_PAUSE
        while self._socket is None:
            # Not all clients of a server come back in the same instant.
            await anyio.sleep(pause * random.uniform(0.5, 1.0))
            pause = min(2 * pause, LONGEST_PAUSE)
            try:
                await self._connect()
            except OSError as error:
                self._report.failed(ConnectionError(f"{self._url}: {error}"))

    async def _read_all(self, socket: WebSocket) -> None:
        while True:
            message = await socket.receive()
            try:
                large = is_large(message)
                self._take(await read_large(message, socket.give_way) if large else read(message), len(message))
            except MalformedMessageError as error:
                # Thousands of them, each with what it was read from, would be work for the collector.
                error.__context__ = None
                self._receive(Received(self._url, error.with_traceback(None)))

    def _take(self, incoming: Incoming, size: int) -> None:
        if not incoming.topic:
            if incoming.content not in self._said and len(self._said) == MOST_SAID:
                raise MalformedMessageError("status", f"the server says more than {MOST_SAID} things of itself")
            if incoming.content not in self._said:
                self._said.add(incoming.content)
                # Not to end the line, or to turn it around.
                said = incoming.content.encode("unicode_escape").decode()
                self._report.failed(ConnectionError(f"{self._url} says: {said}"))
            return
        others = {
            "joints": self.settings.joint_topic,
            "clock": self.settings.clock_topic,
            "description": self.settings.description_topic,
        }
        for kind, topics in others.items():
            if incoming.topic in topics:
                other = RosMessage(incoming.content, static=False, authority="", **{kind: True})
                # What is latched comes once.
                self._receive(Received(self._url, other, size, moving=kind != "description"))
                return
        static = incoming.topic in self.settings.tf_static
        if not static and incoming.topic not in self.settings.tf:
            raise MalformedMessageError("topic", f"a message on {incoming.topic[:100]!r}, which nobody asked for")
        if self._encoding == "cbor-raw" and incoming.encoding == "none":
            self._ask_for_cbor()
        self._of_ros2 = self._of_ros2 or is_of_ros2(incoming.content)
        if not static:
            self._heard_moving = True
            if monotonic() > self._connected_at + ECHO_TIME:
                self._held_until = -inf
        payload = incoming.content
        if isinstance(payload, dict):
            # Samples take less memory than what they are read from.
            payload = decode_content(payload)
        self._receive(Received(self._url, RosMessage(payload, static, "rosbridge"), size, moving=not static))

    def _ask_for_cbor(self) -> None:
        """Subscribe anew: a server that answers ``cbor-raw`` in JSON may know ``cbor``, which is older."""
        self._encoding = "cbor"
        self._subscribe_again((*self.settings.tf_static, *self.settings.tf))

    async def _write_all(self, socket: WebSocket) -> None:
        with self._writing:
            while True:
                self._woken = anyio.Event()
                await self._send_all(socket)
                if self._ending:
                    return
                await self._woken.wait()

    async def _end_writing(self) -> None:
        """Give `_write_all` a little time at the end, for the text that it has begun and for those that wait."""
        try:
            await anyio.sleep_forever()
        finally:
            self._ending = True
            self._writing.deadline = anyio.current_time() + _CLOSING_TIME
            self._woken.set()

    async def _send_all(self, socket: WebSocket) -> None:
        while True:
            if self._requests:
                await socket.send(self._requests.popleft())
            elif self._changed_statics is not None:
                text, self._changed_statics = self._changed_statics, None
                await socket.send(text)
                self._confirmation.sent()
            elif self._moving:
                await socket.send(self._moving.popleft()[0])
            else:
                return

    async def _keep_alive(self, socket: WebSocket) -> None:
        while True:
            await anyio.sleep(SILENCE / 4)
            if monotonic() - socket.heard > SILENCE:
                raise ConnectionResetError(f"nothing has come for {SILENCE:g} s")
            await socket.ping()

    async def _ask_again(self) -> None:
        """Subscribe once more while a lookup waits, to the static frames, and to the moving ones if none has come.

        A rosbridge of ROS 2 gives latched messages to no later subscriber if it has asked ROS for that topic before
        there was a publisher; and only latched messages if it has asked while another client published there.
        """
        misses = 0
        while True:
            await anyio.sleep(_MISS_PERIODS[min(misses, len(_MISS_PERIODS) - 1)])
            if not self._lookup_waits():
                misses = 0
                continue
            misses += 1
            self._subscribe_again(self.settings.tf_static)
            # Beside a publisher of this link, the new subscription would hear nobody else.
            if not (self._heard_moving or self._advertised):
                self._subscribe_again(self.settings.tf)

    async def _end_holding(self) -> None:
        """Send moving frames again when those of others are heard, or the former publisher of this link has gone.

        A server of ROS 2 subscribes to a topic as it finds publishers there, and its own are latched: a subscription
        that meets one of them never hears the nodes of ROS. It keeps the publisher of a client for 10 s after that.
        """
        await anyio.sleep(max(0.0, self._held_until - monotonic()))
        if self._held_until > -inf:
            self._subscribe_again(self.settings.tf)
            self._held_until = -inf

    async def _confirm_statics(self) -> None:
        if self._of_ros2 and self._broken_at > -inf:
            # Until then, they come from the publisher of the connection that broke.
            await anyio.sleep(max(0.0, self._broken_at + LINGER_TIME - monotonic()))
            self._confirmation.doubted = True
            self._publish_statics()
        await self._confirmation.run(lambda *what: self._report.refused(*what))

    def _subscribe_again(self, topics: Iterable[str]) -> None:
        for topic in topics:
            self._request(unsubscribe(topic))
            self._request(subscribe(topic, self._encoding))

    def _request(self, text: str) -> None:
        self._requests.append(text)
        self._woken.set()
