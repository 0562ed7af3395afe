"""`RosbridgeLink`: the transforms of ROS 1 or ROS 2 on a bus, and those of the bus there, through a rosbridge server.

`RosbridgeCarrier` holds one connection at a time, and a few tasks for as long as it lasts: one reads, one writes what
waits, one pings, and three work around faults of servers. When the first of them fails, all end, the peer is lost, and
the carrier connects again. All runs in the event loop, and all times are those of its clock.

Texts wait in three places to be written. Requests go first, in their order. Of the static frames only the newest
message waits, because each holds all of them. Moving frames are a queue whose oldest give way.

A server tells nobody about a message that it refuses: rosbridge_suite writes that to its own log, and then a static
frame never arrives. A server of ROS 2 whose logger has failed refuses the next client that advertises a topic whose
last client has just left; it forgets that topic after ten seconds. But a server sends a client its own messages back,
if the client subscribes to their topic. So `Confirmation` compares the static frames that come with those that were
sent; a frame that does not come back was refused.

A server of ROS 2 subscribes to a topic as it finds publishers there, and its own are latched: a subscription that meets
one of them never hears the nodes of ROS. It keeps the publisher of a client that has gone for ten seconds. So after a
break, a link to ROS 2 that had published moving frames holds them back until the server has forgotten that publisher,
or gives it the moving frames of others.

Such a server gives latched messages to no later subscriber if it has asked ROS for that topic before there was a
publisher; and only latched messages if it has asked while another client published there. So while a lookup waits on
the bus, the link subscribes anew now and then.
"""

import logging
import random
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from math import inf
from typing import Any, Final, Literal, Unpack, get_args
from uuid import uuid4

import anyio

from tfbus._aio.task_groups import close_task_group
from tfbus._aio.websocket import WebSocket, check_url
from tfbus.bus.bus import Bus
from tfbus.geometry.stamped import TransformStamped
from tfbus.links.replica import FromLink, ReceivedTransform
from tfbus.links.ros.ros_link import MAX_SIZE, RosCarrier, RosLink, RosMessage
from tfbus.links.ros.settings import RosOptions, RosSettings, settings_of
from tfbus.links.rosbridge.protocol import (
    OTHER_TYPES,
    Incoming,
    LargeMessage,
    advertise,
    decode_content,
    decode_content_in_parts,
    decode_joints,
    decode_odometry_of,
    is_large,
    is_of_ros2,
    publish,
    read,
    read_large,
    subscribe,
    unsubscribe,
)
from tfbus.links.seams import Joined, Left, Received, SendReport
from tfbus.tf_message import Decoded, MalformedMessageError

CONFIRM_TIME, LONGEST_CONFIRM_TIME = 2.0, 30.0
"""s; static frames that have not come back for so long are sent again, and then after twice that time each."""


class Confirmation:
    """Looks whether a server has taken the static frames of a link, and has them published again until it has.

    Parameters
    ----------
    carrier : RosbridgeCarrier
        Publishes the static frames.

    Attributes
    ----------
    doubted : bool
        Whether the server may have refused the topic, so that it has to be advertised again.
    """

    def __init__(self, carrier: "RosbridgeCarrier") -> None:
        self._carrier = carrier
        self._missing: dict[str, TransformStamped] = {}
        self._sent = anyio.Event()
        self._complete = anyio.Event()
        self.doubted: bool = False

    def expect(self, samples: Sequence[TransformStamped]) -> None:
        """Expect all static frames back, which are published now."""
        self._missing = {sample.child: sample for sample in samples}

    def sent(self) -> None:
        """Note that the message with the static frames has been sent."""
        self._sent.set()

    def heard(self, samples: Sequence[TransformStamped | None]) -> None:
        """Static frames have come, with their names in ROS."""
        if not self._missing:
            return
        for sample in samples:
            own = None if sample is None else self._missing.get(sample.child)
            if sample is None or own is None or (own.parent, own.stamp) != (sample.parent, sample.stamp):
                continue
            if own.transform.is_close(sample.transform):
                del self._missing[own.child]
        if not self._missing:
            self._complete.set()

    async def run(self, report: SendReport) -> None:
        """Publish the static frames again that do not come back, and report them, until cancelled."""
        pause, told = CONFIRM_TIME, False
        while True:
            await self._sent.wait()
            self._sent, self._complete = anyio.Event(), anyio.Event()
            if self._missing:
                with anyio.move_on_after(pause):
                    await self._complete.wait()
            if not self._missing:
                if told:
                    logging.getLogger("tfbus").warning("%s has taken all static frames now", self._carrier.url)
                pause, told, self.doubted = CONFIRM_TIME, False, False
            elif not self._sent.is_set():
                if not told:
                    report.refused("not confirmed", self._error(), len(self._missing))
                told = self.doubted = True
                pause = min(2 * pause, LONGEST_CONFIRM_TIME)
                self._carrier.publish_statics()
            # Otherwise more was sent meanwhile, and has its time too.

    def _error(self) -> ConnectionError:
        count, some = len(self._missing), next(iter(self._missing))
        what = f"the static frame {some!r}" if count == 1 else f"{count} static frames, such as {some!r},"
        why = f"within {CONFIRM_TIME:g} s, so it has not taken it: its log may say why"
        return ConnectionError(f"{self._carrier.url} has not given back {what} {why}; the link tries again")


MOST_QUEUED = 1_000
"""So many messages wait for a slow server; then the oldest are dropped."""
MOST_SAID: Final = 20
"""So many different texts of a server about itself are logged for one connection."""
Encoding = Literal["cbor", "cbor-raw"]
CONNECT_TIME = 5.0
SILENCE = 10.0
"""s; a server that does not even answer a ping for so long is gone."""
FIRST_PAUSE, LONGEST_PAUSE = 0.25, 5.0
"""s between two attempts to connect."""
LINGER_TIME = 11.0
"""s; a server of ROS 2 keeps the publisher of a client that has gone for 10, and then ROS takes a while."""
ECHO_TIME = 2.0
"""s; a server of ROS 2 gives a new client the last second of its other clients, so that may come from this link."""
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
    bus : Bus
        While a lookup waits on it, the server is asked again.
    """

    def __init__(self, url: str, settings: RosSettings, encoding: Encoding, bus: Bus) -> None:
        super().__init__(f"rosbridge:{uuid4().hex}", settings)
        self.url = url
        self._wanted: Encoding = encoding
        self._encoding: Encoding = encoding
        self._bus = bus
        self._socket: WebSocket | None = None
        self._moving: deque[tuple[str, int]] = deque()
        self._changed_statics: str | None = None
        self._requests: deque[str] = deque()
        self._said: set[str] = set()
        self._confirmation = Confirmation(self)
        self._woken = anyio.Event()
        self._of_ros2 = False
        self._advertised = self._heard_moving = False
        self._connected_at = self._broken_at = self._held_until = -inf
        # Made when the server is there: anyio makes none without an event loop.
        self._writing: anyio.CancelScope
        self._ending: bool

    async def _connect(self) -> None:
        self._socket = await WebSocket.connect(self.url, MAX_SIZE, CONNECT_TIME)
        self._encoding = self._wanted
        if self._of_ros2 and self._advertised:
            self._held_until = self._broken_at + LINGER_TIME
        if self._held_until <= anyio.current_time():
            self._held_until = -inf
        self._advertised = self._heard_moving = False
        self._connected_at = anyio.current_time()
        self._moving.clear()
        self._requests.clear()
        self._said.clear()
        # First of all: what is latched may come only once, and moving frames come again.
        for topic in (*self.settings.tf_static, *self.settings.tf):
            self._request(subscribe(topic, self._encoding))
        for other, topics in self.settings.others.items():
            # In CBOR, a server of ROS 1 fails at the names of the joints, an array of strings.
            plain = other == "joints" and self._encoding == "cbor"
            for topic in topics:
                self._request(subscribe(topic, "none" if plain else self._encoding, OTHER_TYPES[other]))
        if self.settings.send:
            self._request(advertise(self.settings.tf_static[0], static=True))
            self.publish_statics()
        self._receive(Received(self.url, Joined()))

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
            error = ConnectionError(f"{self.url} is not connected")
            self._report.refused("not connected", error, len(samples))
            return False
        elif self._held_until > -inf:
            error = ConnectionError(f"{self.url} was away, and still has a publisher of that time, which hides others")
            self._report.refused("rejoining", error, len(samples))
            return False
        else:
            if not self._advertised:
                # Not before there is something: a server of ROS 2 then gives later clients only what is latched.
                self._advertised = True
                self._request(advertise(self.settings.tf[0], static=False))
            if len(self._moving) >= MOST_QUEUED:
                _, dropped = self._moving.popleft()
                self._report.refused("congested", OSError(f"{self.url} is too slow for what is published"), dropped)
            self._moving.append((publish(self.settings.tf[0], samples), len(samples)))
        self._woken.set()
        return True

    def _decode(self, payload: Any) -> Decoded[ReceivedTransform]:
        return decode_content(payload)

    def _heard(self, samples: Sequence[FromLink | None], static: bool) -> None:
        if static:
            self._confirmation.heard(samples)

    def _is_large(self, payload: Any) -> bool:
        return isinstance(payload, LargeMessage) or (isinstance(payload, bytes) and super()._is_large(payload))

    def _decode_in_parts(self, payload: Any) -> Iterator[Decoded[ReceivedTransform]]:
        return decode_content_in_parts(payload)

    def _decode_joints(self, payload: Any) -> tuple[int, dict[str, float]]:
        return decode_joints(payload)

    def _decode_odometry(self, payload: Any) -> Decoded[FromLink]:
        return decode_odometry_of(payload)

    async def _talk(self, socket: WebSocket) -> None:
        """Send and receive until the server is gone."""
        # A message that is being sent when the link ends goes out whole, or later ones could not be read.
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
        self._broken_at = anyio.current_time()
        self._receive(Received(self.url, Left()))
        await socket.close()

    async def _until_gone(self, work: Callable[[WebSocket], Any], socket: WebSocket, scope: anyio.CancelScope) -> None:
        try:
            await work(socket)
        except OSError as error:
            self._report.failed(ConnectionError(f"{self.url}: {error}"))
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
                self._report.failed(ConnectionError(f"{self.url}: {error}"))

    async def _read_all(self, socket: WebSocket) -> None:
        while True:
            message = await socket.receive()
            try:
                large = is_large(message)
                self._take(await read_large(message, socket.give_way) if large else read(message), len(message))
            except MalformedMessageError as error:
                # Thousands of them, each with what it was read from, would be work for the collector.
                error.__context__ = None
                self._receive(Received(self.url, error.with_traceback(None)))

    def _take(self, incoming: Incoming, size: int) -> None:
        if not incoming.topic:
            if incoming.content not in self._said and len(self._said) == MOST_SAID:
                raise MalformedMessageError("status", f"the server says more than {MOST_SAID} things of itself")
            if incoming.content not in self._said:
                self._said.add(incoming.content)
                # Not to end the line, or to turn it around.
                said = incoming.content.encode("unicode_escape").decode()
                self._report.failed(ConnectionError(f"{self.url} says: {said}"))
            return
        for other, topics in self.settings.others.items():
            if incoming.topic in topics:
                message = RosMessage(incoming.content, False, incoming.topic, other)
                # A latched message comes once.
                self._receive(Received(self.url, message, size, moving=other != "description"))
                return
        static = incoming.topic in self.settings.tf_static
        if not static and incoming.topic not in self.settings.tf:
            raise MalformedMessageError("topic", f"a message on {incoming.topic[:100]!r}, which nobody asked for")
        if self._encoding == "cbor-raw" and incoming.encoding == "none":
            self._ask_for_cbor()
        self._of_ros2 = self._of_ros2 or is_of_ros2(incoming.content)
        if not static:
            self._heard_moving = True
            if anyio.current_time() > self._connected_at + ECHO_TIME:
                self._held_until = -inf
        payload = incoming.content
        if isinstance(payload, dict):
            # Samples take less memory than what they are read from.
            payload = decode_content(payload)
        self._receive(Received(self.url, RosMessage(payload, static, "rosbridge"), size, moving=not static))

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
        """Give `_write_all` a little time at the end, for the text that it has begun and for the texts that wait."""
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
            if anyio.current_time() - socket.heard > SILENCE:
                raise ConnectionResetError(f"nothing has come for {SILENCE:g} s")
            with anyio.move_on_after(SILENCE) as waited:
                await socket.ping()
            if waited.cancelled_caught:
                # It sends, so it is not silent.
                raise ConnectionResetError(f"it has read nothing for {SILENCE:g} s")

    async def _ask_again(self) -> None:
        """While a lookup waits, subscribe anew to the static frames, and to the moving ones if none has come."""
        misses = 0
        while True:
            await anyio.sleep(_MISS_PERIODS[min(misses, len(_MISS_PERIODS) - 1)])
            if not any(buffer.waiting for buffer in self._bus.statistics().buffers):
                misses = 0
                continue
            misses += 1
            self._subscribe_again(self.settings.tf_static)
            # Beside a publisher of this link, the new subscription would hear nobody else.
            if not (self._heard_moving or self._advertised):
                self._subscribe_again(self.settings.tf)

    async def _end_holding(self) -> None:
        """Send moving frames again when the server has forgotten the former publisher of this link."""
        await anyio.sleep(max(0.0, self._held_until - anyio.current_time()))
        if self._held_until > -inf:
            self._subscribe_again(self.settings.tf)
            self._held_until = -inf

    async def _confirm_statics(self) -> None:
        if self._of_ros2 and self._broken_at > -inf:
            # Until then, they come from the publisher of the connection that broke.
            await anyio.sleep(max(0.0, self._broken_at + LINGER_TIME - anyio.current_time()))
            self._confirmation.doubted = True
            self.publish_statics()
        await self._confirmation.run(self._report)

    def _subscribe_again(self, topics: Iterable[str]) -> None:
        for topic in topics:
            self._request(unsubscribe(topic))
            self._request(subscribe(topic, self._encoding))

    def _request(self, text: str) -> None:
        self._requests.append(text)
        self._woken.set()


class RosbridgeLink(RosLink):
    """Joins a bus to ``/tf`` and ``/tf_static`` of ROS 1 or ROS 2: ``async with RosbridgeLink(bus, url) as link``.

    A rosbridge server, from the package ``rosbridge_suite``, has to run beside ROS. Nothing of ROS is needed here. When
    the server goes, the link connects again, with pauses from a quarter of a second to five seconds.

    Parameters
    ----------
    bus : Bus
    url : str
        Such as ``ws://192.168.1.5:9090``, which is the port if none is given, or ``wss://...`` for a server with TLS.
    encoding : {"cbor", "cbor-raw"}
        The encoding in which messages are asked for; a server that does not know it sends JSON, which is read too. See
        the notes before you take ``"cbor-raw"``.
    **options
        All links to ROS share them: see `tfbus.links.ros.RosLink`. By default, the authority of all samples is
        ``"rosbridge"``, because the server does not tell who has published them.

    Attributes
    ----------
    bus : Bus
    url : str
    id : str
        The name of this end.

    Raises
    ------
    ValueError
        If it is no URL of a websocket, the encoding is neither of the two, or as `tfbus.links.ros.RosLink`.
    TypeError
        If an argument has the wrong type.
    OSError
        On entering, if the server cannot be reached.
    BusClosedError, RuntimeError
        On entering, if the bus is closed; if it belongs to another thread, or the link was entered before.
    ImportError
        On import, without the extra: ``pip install "tfbus[rosbridge]"``.

    Notes
    -----
    One message larger than 4 MiB ends the connection. A large message is read and published in parts, so that other
    tasks have their turn whatever the server sends; one with CBOR that no message of ROS has is refused. The only peer
    is the server. While a lookup waits on the bus, the static frames are asked for now and then, because a server for
    ROS 2 may have had them before this link came.

    A server asks ROS once for each topic, for all its clients, as the first of them wants it: decoded, or as bytes.
    With ``"cbor"`` this link and clients that want JSON, such as roslib in a browser, hear the same topics side by
    side. ``"cbor-raw"`` passes on the bytes of ROS, which costs the server half as much for messages of 20 transforms,
    and hardly less for one; but beside a client that wants anything else, the second of the two hears nothing, and no
    server tells it. Take ``"cbor-raw"`` for a server of your own, or for one whose other clients take it too. Positions
    of joints are asked for in JSON, unless you take it, because a server of ROS 1 cannot put their names into CBOR.

    A server keeps one latched message of ``/tf_static`` for all its clients. So of several programs that send static
    frames through one server, late joiners hear only the last.

    A server tells its clients nothing of what it refuses, but gives back what it takes. Static frames that do not come
    back within 2 s are told in a log line, counted in `LinkStatistics.not_sent` as ``"not confirmed"``, and advertised
    and sent again until they do.

    Every program that reaches the server can publish and read everything.
    """

    def __init__(self, bus: Bus, url: str, *, encoding: Encoding = "cbor", **options: Unpack[RosOptions]) -> None:
        if not isinstance(url, str):
            raise TypeError(f"a URL must be a str, not {url!r}")
        check_url(url)
        if encoding not in get_args(Encoding):
            raise ValueError(f"encoding must be 'cbor' or 'cbor-raw', not {encoding!r}")
        self.url = url
        super().__init__(bus, url, RosbridgeCarrier(url, settings_of(options), encoding, bus), **options)
